//! Where the bodies of a tree are and how they turn, as expressions of coordinates and rates.
//!
//! Each body has *working axes* at the origin of its frame, in which all of its vectors are
//! written. Revolute joints about parallel axes share their working axes: there an angle is a sum of
//! coordinates, a parent's vectors need no rotation, and for a planar mechanism the working axes are
//! the world's. Vectors are physical (classical velocities and accelerations of points), so nothing
//! depends on how the working axes move.

use super::algebra::{
    M3, Rotation, Turn, V3, add, clean, conjugate, constant, constants, cross, dot, rotate,
    rotate_back, rotate_columns, scale, symmetric, times, zero,
};
use super::tree::{Joint, Mount, Tree};
use crate::expr::{Graph, Id};
use glam::{DMat3, DQuat, DVec3};
use std::sync::Arc;

/// Components of a unit vector below this are rounding: it is a coordinate axis.
const ALIGNED: f64 = 1e-15;
/// Axes of joints are parallel where the cosine between them is above this.
const PARALLEL: f64 = 1.0 - 1e-12;

/// How the body's own axes lie in the working axes: turned about one of them after something
/// constant.
#[derive(Clone, Copy, Debug)]
struct Attitude {
    turned: Option<(usize, Id)>,
    constant: DMat3,
}

/// A body's frame in motion.
#[derive(Clone, Debug)]
pub struct Frame {
    /// From the working axes to the parent's.
    pub turn: Rotation,
    /// From the body's own axes to the working axes.
    pub attitude: Rotation,
    /// From the parent's origin to this one, in the parent's working axes.
    pub arm: V3,
    /// The joint's axis, in the working axes.
    pub axis: V3,
    /// The same where it is a coordinate axis: which one, and 1 or -1.
    pub aligned: Option<(usize, f64)>,
    /// First moment of mass about the origin, m c.
    pub moment: V3,
    /// Tensor of inertia about the origin.
    pub tensor: M3,
    /// Angular velocity.
    pub omega: V3,
    /// `[w]x [w]x`: `w x (w x r)` of a point r.
    pub centripetal: M3,
}

/// A point of a body.
#[derive(Clone, Copy, Debug)]
pub struct Point {
    /// `None`: of the world.
    pub body: Option<usize>,
    /// From the body's origin, in its working axes.
    pub arm: V3,
    /// In world axes.
    pub position: V3,
    pub velocity: V3,
}

/// A tree in motion.
#[derive(Clone, Debug)]
pub struct Motion {
    pub tree: Arc<Tree>,
    pub q: Vec<Id>,
    pub rates: Vec<Id>,
    pub frames: Vec<Frame>,
}

impl Motion {
    /// Of coordinates and their rates, one of each a body.
    pub fn new(g: &mut Graph, tree: &Arc<Tree>, q: &[Id], rates: &[Id]) -> Self {
        let mut motion = Self {
            tree: tree.clone(),
            q: q.to_vec(),
            rates: rates.to_vec(),
            frames: Vec::with_capacity(tree.bodies.len()),
        };
        let mut attitudes = Vec::with_capacity(tree.bodies.len());
        for i in 0..tree.bodies.len() {
            let (frame, attitude) = motion.frame(g, i, &attitudes);
            motion.frames.push(frame);
            attitudes.push(attitude);
        }
        motion
    }

    /// The frame of the body after those that there are.
    fn frame(&self, g: &mut Graph, i: usize, attitudes: &[Attitude]) -> (Frame, Attitude) {
        let body = &self.tree.bodies[i];
        let of_parent = body.parent.map_or(
            Attitude {
                turned: None,
                constant: DMat3::IDENTITY,
            },
            |p| attitudes[p],
        );
        // The joint in the parent's working axes, but for what these are turned by.
        let joint = clean(of_parent.constant * body.rotation);
        let place = of_parent.constant * body.place;
        let axis = joint * body.axis;
        let turned: Rotation = (of_parent.turned.iter())
            .map(|(k, angle)| Turn::about(g, *k, *angle))
            .collect();
        let mut arm = constant(g, clean_vector(place));
        arm = rotate(g, &turned, arm);

        let (turn, attitude, direction, aligned) = match body.joint {
            Joint::Prismatic => {
                let attitude = Attitude {
                    turned: of_parent.turned,
                    constant: joint,
                };
                let aligned = coordinate_axis(axis)
                    .filter(|(k, _)| of_parent.turned.is_none_or(|(about, _)| about == *k));
                let axis = constant(g, clean_vector(axis));
                let direction = rotate(g, &turned, axis);
                let way = scale(g, self.q[i], direction);
                arm = add(g, arm, way);
                (Vec::new(), attitude, direction, aligned)
            }
            Joint::Revolute => self.revolute(g, i, (of_parent.turned, turned), (joint, axis)),
        };

        let from_body: Rotation = [
            attitude.turned.map(|(k, angle)| Turn::about(g, k, angle)),
            Some(Turn::Constant(attitude.constant)),
        ]
        .into_iter()
        .flatten()
        .collect();
        let moment = constant(g, body.inertia.mass * body.inertia.com);
        let tensor = constants(g, body.inertia.about_origin());
        let before = self.omega_of(g, body.parent);
        let before = rotate_back(g, &turn, before);
        let omega = match body.joint {
            Joint::Prismatic => before,
            Joint::Revolute => {
                let own = scale(g, self.rates[i], direction);
                add(g, before, own)
            }
        };
        let frame = Frame {
            arm,
            axis: direction,
            aligned,
            moment: rotate(g, &from_body, moment),
            tensor: conjugate(g, &from_body, &tensor, true),
            omega,
            centripetal: centripetal(g, omega),
            attitude: from_body,
            turn,
        };
        (frame, attitude)
    }

    /// Working axes of a body with a revolute joint: how they turn against the parent's, how the
    /// body lies in them, and the joint's axis.
    #[allow(clippy::type_complexity)]
    fn revolute(
        &self,
        g: &mut Graph,
        i: usize,
        (of_parent, mut turn): (Option<(usize, Id)>, Rotation),
        (joint, axis): (DMat3, DVec3),
    ) -> (Rotation, Attitude, V3, Option<(usize, f64)>) {
        let (about, sign, levelled) = match coordinate_axis(axis) {
            Some((k, sign)) => (k, sign, DMat3::IDENTITY),
            None => {
                let arc = DQuat::from_rotation_arc(DVec3::Z, axis.normalize());
                (2, 1.0, DMat3::from_quat(arc))
            }
        };
        let own = if sign < 0.0 {
            g.neg(self.q[i])
        } else {
            self.q[i]
        };
        let direction = constant(g, DVec3::AXES[about] * sign);
        let aligned = Some((about, sign));
        let constant = clean(levelled.transpose() * joint);
        // About the axis that the parent's axes are turned about: the angles add up.
        if let Some((k, angle)) = of_parent
            && k == about
            && levelled == DMat3::IDENTITY
        {
            let turned = Some((k, g.add(angle, own)));
            return (
                Vec::new(),
                Attitude { turned, constant },
                direction,
                aligned,
            );
        }
        if levelled != DMat3::IDENTITY {
            turn.push(Turn::Constant(levelled));
        }
        if self.turns_alone(i) {
            turn.push(Turn::about(g, about, own));
            let attitude = Attitude {
                turned: None,
                constant,
            };
            return (turn, attitude, direction, aligned);
        }
        let turned = Some((about, own));
        (turn, Attitude { turned, constant }, direction, aligned)
    }

    /// Whether a body has children, none of which turns about a parallel axis: then it is cheaper to
    /// turn the working axes with it.
    fn turns_alone(&self, i: usize) -> bool {
        let axis = self.tree.bodies[i].axis;
        let mut children = (self.tree.bodies.iter())
            .filter(|b| b.parent == Some(i))
            .peekable();
        children.peek().is_some()
            && !children.any(|child| {
                child.joint == Joint::Revolute
                    && (child.rotation * child.axis).dot(axis).abs() > PARALLEL
            })
    }

    /// Angular velocity of a body, or of the world.
    fn omega_of(&self, g: &mut Graph, body: Option<usize>) -> V3 {
        match body {
            Some(p) => self.frames[p].omega,
            None => zero(g),
        }
    }

    /// The joint's velocity after the parent's: what adds to the angular acceleration in the working
    /// axes, and to the acceleration of the origin in the parent's, where all q'' are 0.
    pub fn joint_bias(&self, g: &mut Graph, i: usize) -> (V3, V3) {
        let (body, frame) = (&self.tree.bodies[i], &self.frames[i]);
        let none = zero(g);
        let mut linear = match body.parent {
            Some(p) => times(g, &self.frames[p].centripetal, frame.arm),
            None => none,
        };
        match body.joint {
            Joint::Revolute => {
                // (w of the parent) x axis q' = w x axis q'.
                let across = cross(g, frame.omega, frame.axis);
                (scale(g, self.rates[i], across), linear)
            }
            Joint::Prismatic => {
                let omega = self.omega_of(g, body.parent);
                let across = cross(g, omega, frame.axis);
                let two = g.constant(2.0);
                let twice = g.mul(two, self.rates[i]);
                let coriolis = scale(g, twice, across);
                linear = add(g, linear, coriolis);
                (none, linear)
            }
        }
    }

    /// From a body's working axes to the world's, one a body.
    pub fn orientations(&self, g: &mut Graph) -> Vec<M3> {
        let mut all: Vec<M3> = Vec::with_capacity(self.frames.len());
        for (body, frame) in self.tree.bodies.iter().zip(&self.frames) {
            let of_parent = match body.parent {
                Some(p) => all[p],
                None => constants(g, DMat3::IDENTITY),
            };
            // Row by row: (E T)' = T' E'.
            all.push(of_parent.map(|row| rotate_back(g, &frame.turn, row)));
        }
        all
    }

    /// Origins of all bodies, in world axes.
    pub fn origins(&self, g: &mut Graph, orientations: &[M3]) -> Vec<V3> {
        let mut all: Vec<V3> = Vec::with_capacity(self.frames.len());
        for (body, frame) in self.tree.bodies.iter().zip(&self.frames) {
            all.push(match body.parent {
                Some(p) => {
                    let turned = times(g, &orientations[p], frame.arm);
                    add(g, all[p], turned)
                }
                None => frame.arm,
            });
        }
        all
    }

    /// Velocities of the origins, in the working axes.
    pub fn velocities(&self, g: &mut Graph) -> Vec<V3> {
        let mut all: Vec<V3> = Vec::with_capacity(self.frames.len());
        for (i, body) in self.tree.bodies.iter().enumerate() {
            let frame = &self.frames[i];
            let mut velocity = match body.parent {
                Some(p) => {
                    let around = cross(g, self.frames[p].omega, frame.arm);
                    add(g, all[p], around)
                }
                None => zero(g),
            };
            if body.joint == Joint::Prismatic {
                let own = scale(g, self.rates[i], frame.axis);
                velocity = add(g, velocity, own);
            }
            all.push(rotate_back(g, &frame.turn, velocity));
        }
        all
    }

    /// A point of a mount from its body's origin, in the body's working axes (the world's, of the
    /// world).
    pub fn arm_of(&self, g: &mut Graph, mount: &Mount, at: DVec3) -> V3 {
        let point = constant(g, clean_vector(mount.point(at)));
        match mount.body {
            Some(i) => rotate(g, &self.frames[i].attitude, point),
            None => point,
        }
    }

    /// Axes of a mount as columns, in its body's working axes.
    pub fn axes_of(&self, g: &mut Graph, mount: &Mount) -> M3 {
        let axes = constants(g, mount.rotation);
        match mount.body {
            Some(i) => rotate_columns(g, &self.frames[i].attitude, &axes),
            None => axes,
        }
    }

    /// A point that is fixed to a mount.
    pub fn point(
        &self,
        g: &mut Graph,
        mount: &Mount,
        at: DVec3,
        (orientations, origins, velocities): (&[M3], &[V3], &[V3]),
    ) -> Point {
        let arm = self.arm_of(g, mount, at);
        let Some(i) = mount.body else {
            let velocity = zero(g);
            return Point {
                body: None,
                arm,
                position: arm,
                velocity,
            };
        };
        let turned = times(g, &orientations[i], arm);
        let around = cross(g, self.frames[i].omega, arm);
        let velocity = add(g, velocities[i], around);
        Point {
            body: Some(i),
            arm,
            position: add(g, origins[i], turned),
            velocity: times(g, &orientations[i], velocity),
        }
    }

    /// Acceleration of a point where all q'' are 0, in world axes: what its Jacobian's rate gives.
    pub fn point_bias(&self, g: &mut Graph, point: &Point, orientations: &[M3]) -> V3 {
        let still = zero(g);
        let accelerations = self.bias_accelerations(g, None, still);
        self.point_acceleration(g, point, &accelerations, orientations)
    }

    /// Acceleration of a point, in world axes, of those of the bodies.
    pub fn point_acceleration(
        &self,
        g: &mut Graph,
        point: &Point,
        accelerations: &[(V3, V3)],
        orientations: &[M3],
    ) -> V3 {
        let Some(i) = point.body else { return zero(g) };
        let (alpha, a) = accelerations[i];
        let around = cross(g, alpha, point.arm);
        let inward = times(g, &self.frames[i].centripetal, point.arm);
        let sum = add(g, a, around);
        let sum = add(g, sum, inward);
        times(g, &orientations[i], sum)
    }

    /// Kinetic energy.
    pub fn kinetic(&self, g: &mut Graph, velocities: &[V3]) -> Id {
        let mut terms = Vec::new();
        for (i, (body, frame)) in self.tree.bodies.iter().zip(&self.frames).enumerate() {
            let spun = times(g, &frame.tensor, frame.omega);
            terms.push(dot(g, frame.omega, spun));
            let mass = g.constant(body.inertia.mass);
            let squared = dot(g, velocities[i], velocities[i]);
            terms.push(g.mul(mass, squared));
            // 2 v . (w x m c)
            let around = cross(g, frame.omega, frame.moment);
            let mixed = dot(g, velocities[i], around);
            let two = g.constant(2.0);
            terms.push(g.mul(two, mixed));
            let rotor = g.constant(body.rotor);
            let square = g.powi(self.rates[i], 2);
            terms.push(g.mul(rotor, square));
        }
        let twice = g.sum(&terms);
        let half = g.constant(0.5);
        g.mul(half, twice)
    }

    /// Potential energy of gravity, 0 where all centres of mass are at the world's origin.
    pub fn potential(&self, g: &mut Graph, orientations: &[M3], origins: &[V3]) -> Id {
        let down = constant(g, self.tree.gravity);
        let mut terms = Vec::new();
        for (i, (body, frame)) in self.tree.bodies.iter().zip(&self.frames).enumerate() {
            let moment = times(g, &orientations[i], frame.moment);
            let mass = g.constant(body.inertia.mass);
            let carried = scale(g, mass, origins[i]);
            let all = add(g, moment, carried);
            let work = dot(g, down, all);
            terms.push(g.neg(work));
        }
        g.sum(&terms)
    }
}

/// `[w]x [w]x = w w' - |w|^2 I`.
fn centripetal(g: &mut Graph, omega: V3) -> M3 {
    let squares = omega.map(|w| g.powi(w, 2));
    symmetric(|i, j| {
        if i == j {
            let sum = g.add(squares[(i + 1) % 3], squares[(i + 2) % 3]);
            g.neg(sum)
        } else {
            g.mul(omega[i], omega[j])
        }
    })
}

/// Which coordinate axis a unit vector is, and its sign, if it is one.
fn coordinate_axis(axis: DVec3) -> Option<(usize, f64)> {
    let array = axis.to_array();
    (0..3)
        .find(|k| (0..3).all(|j| j == *k || array[j].abs() < ALIGNED))
        .map(|k| (k, array[k].signum()))
}

/// Without what is rounding against its length.
fn clean_vector(v: DVec3) -> DVec3 {
    const ROUNDING: f64 = 1e-15;
    let size = v.length();
    DVec3::from_array(
        v.to_array()
            .map(|c| if c.abs() < ROUNDING * size { 0.0 } else { c }),
    )
}
