//! A tree of rigid bodies in numbers: what a mechanism is made of once its parameters are known.

use crate::numeric::digits::plain;
use glam::{DMat3, DVec3};
use std::fmt;

/// How far an inertia may be from one that a body has, relative to its size: by rounding, and where
/// its digits are cut short.
const ROUNDING: f64 = 1e-9;
const CUT: f64 = 1e-3;

/// How a body moves against its parent, by one coordinate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Joint {
    /// Turns about the axis, by the coordinate in radians.
    Revolute,
    /// Slides along the axis, by the coordinate.
    Prismatic,
}

/// Mass, its centre, and the tensor of inertia about that.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Inertia {
    pub mass: f64,
    /// Centre of mass, in the body's frame.
    pub com: DVec3,
    /// About the centre of mass, along the body's axes.
    pub about_com: DMat3,
}

/// Why no body has an inertia.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Impossible {
    /// The tensor is not symmetric.
    NotSymmetric,
    /// A principal moment is negative.
    Negative { least: f64 },
    /// There are moments, but no mass.
    NoMass,
    /// The largest principal moment is above the sum of the others.
    TooLarge { largest: f64, others: f64 },
}

impl Impossible {
    /// Whether models in use have such: their equations are good nevertheless.
    #[must_use]
    pub fn is_usable(self) -> bool {
        matches!(self, Self::NoMass | Self::TooLarge { .. })
    }
}

impl fmt::Display for Impossible {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotSymmetric => f.write_str("it is not symmetric"),
            Self::Negative { least } => write!(f, "its least moment is {}", plain(*least)),
            Self::NoMass => f.write_str("it has no mass"),
            Self::TooLarge { largest, others } => write!(
                f,
                "its largest moment, {}, is above the sum of the others, {}",
                plain(*largest),
                plain(*others)
            ),
        }
    }
}

impl Inertia {
    pub const NONE: Self = Self {
        mass: 0.0,
        com: DVec3::ZERO,
        about_com: DMat3::ZERO,
    };

    /// Tensor about the origin of the body's frame (Steiner).
    #[must_use]
    pub fn about_origin(&self) -> DMat3 {
        self.about_com + self.mass * steiner(self.com)
    }

    /// Why no body has it whose density is nowhere below 0; in two dimensions only the moment about
    /// z is known.
    #[must_use]
    pub fn impossible(&self, planar: bool) -> Option<Impossible> {
        let tensor = &self.about_com;
        let size = (tensor.to_cols_array().iter()).fold(0.0f64, |a, v| a.max(v.abs()));
        let skew = (*tensor - tensor.transpose()).to_cols_array();
        let [least, middle, largest] = principal(tensor);
        let others = least + middle;
        if skew.iter().any(|v| v.abs() > ROUNDING * size) {
            Some(Impossible::NotSymmetric)
        } else if least < -ROUNDING * size {
            Some(Impossible::Negative { least })
        } else if self.mass == 0.0 && size > 0.0 {
            Some(Impossible::NoMass)
        } else if !planar && largest > others + CUT * size {
            Some(Impossible::TooLarge { largest, others })
        } else {
            None
        }
    }

    /// Of a body that is placed in another's frame.
    #[must_use]
    pub fn placed(&self, place: DVec3, rotation: DMat3) -> Self {
        Self {
            mass: self.mass,
            com: place + rotation * self.com,
            about_com: rotation * self.about_com * rotation.transpose(),
        }
    }

    /// Of two bodies that are one, both in the same frame.
    #[must_use]
    pub fn joined(&self, other: &Self) -> Self {
        let mass = self.mass + other.mass;
        if mass == 0.0 {
            return Self {
                about_com: self.about_com + other.about_com,
                ..*self
            };
        }
        let com = (self.mass * self.com + other.mass * other.com) / mass;
        let moved = |part: &Self| part.about_com + part.mass * steiner(part.com - com);
        Self {
            mass,
            com,
            about_com: moved(self) + moved(other),
        }
    }
}

/// `|c|^2 I - c c'`: what moving the point of reference by c adds to the tensor of a unit mass.
fn steiner(c: DVec3) -> DMat3 {
    let outer = DMat3::from_cols(c * c.x, c * c.y, c * c.z);
    DMat3::from_diagonal(DVec3::splat(c.length_squared())) - outer
}

/// A body with its joint. Its frame is the joint's frame, moved along or about the axis.
#[derive(Clone, Debug, PartialEq)]
pub struct Body {
    /// The coordinate's name.
    pub name: String,
    /// An earlier body; `None` is the world.
    pub parent: Option<usize>,
    pub joint: Joint,
    /// Of unit length, in the joint's frame.
    pub axis: DVec3,
    /// Origin of the joint's frame in the parent's.
    pub place: DVec3,
    /// Its axes there, as columns.
    pub rotation: DMat3,
    pub inertia: Inertia,
    /// What turns with the coordinate by a gear, as inertia at the joint.
    pub rotor: f64,
}

/// Bodies, parents before their children, and the acceleration of gravity (world axes).
#[derive(Clone, Debug, PartialEq)]
pub struct Tree {
    pub gravity: DVec3,
    pub bodies: Vec<Body>,
}

/// A frame that is fixed to a body of a [`Tree`], or to the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mount {
    pub body: Option<usize>,
    pub place: DVec3,
    pub rotation: DMat3,
}

impl Mount {
    pub const WORLD: Self = Self {
        body: None,
        place: DVec3::ZERO,
        rotation: DMat3::IDENTITY,
    };

    /// A point of this frame, in that of the body.
    #[must_use]
    pub fn point(&self, at: DVec3) -> DVec3 {
        self.place + self.rotation * at
    }
}

/// Principal moments, the least first.
fn principal(tensor: &DMat3) -> [f64; 3] {
    let matrix = nalgebra::Matrix3::from_column_slice(&tensor.to_cols_array());
    let mut moments = matrix.symmetric_eigenvalues();
    moments.as_mut_slice().sort_by(f64::total_cmp);
    [moments[0], moments[1], moments[2]]
}
