//! V near the equilibrium as one polynomial of a degree that is asked for, for laws that are to be
//! written down.

use super::seeds::{coordinates, part_sizes, short_of_kinks};
use super::series::{Basis, Equation};
use super::{LocalError, Riccati};
use crate::hamiltonian::System;
use crate::model::Model;
use nalgebra::{DMatrix, DVector};

/// Most coefficients of V, and of the longer series by which its error is told.
const MOST_TERMS: usize = 1000;
const MOST_LOOKED_AT: usize = 5005;
/// Parts of V after the last one kept that are looked at: the first is 0 where V is even.
const LOOK_AHEAD: usize = 2;
/// What is left out of V may be this share of its quadratic part where the polynomial counts as
/// known.
const SHARE: f64 = 1e-2;

/// V as a polynomial of `z = matrix (x - origin)`.
#[derive(Clone, Debug, PartialEq)]
pub struct LocalPolynomial {
    /// Total degree.
    pub degree: usize,
    /// The equilibrium.
    pub origin: Vec<f64>,
    /// Row-major.
    pub matrix: Vec<f64>,
    /// Of monomials of z by rising total degree, those of a degree in lexicographic order of their
    /// factors.
    pub coefficients: Vec<f64>,
    /// It counts as known where `z'z / 2` is at most this.
    pub reach: f64,
}

impl LocalPolynomial {
    /// Al'brekht's expansion through a total degree, at least 2.
    ///
    /// # Errors
    /// [`LocalError`]: `TooLong` and `NoSeries` where that degree cannot be had.
    pub fn new(
        system: &System,
        model: &Model,
        riccati: &Riccati,
        degree: usize,
    ) -> Result<Self, LocalError> {
        let n = system.states;
        let fits = |degree: usize| {
            Basis::size(n, degree) <= MOST_TERMS
                && Basis::size(n, degree + LOOK_AHEAD) <= MOST_LOOKED_AT
        };
        if !fits(degree) {
            return Err(LocalError::TooLong {
                degree,
                states: n,
                most: (2..degree).rev().find(|d| fits(*d)),
            });
        }
        let (t, l) = coordinates(model, riccati)?;
        let basis = Basis::new(n, degree + LOOK_AHEAD);
        let equation = Equation {
            graph: &system.graph,
            hamiltonian: system.observer.hamiltonian,
            inputs: &system.inputs,
        };
        let (mut value, known) = equation.expand(&basis, &t, riccati);
        if known < degree {
            return Err(LocalError::NoSeries { degree, known });
        }
        let sizes = part_sizes(&basis, &value, n);
        // The share grows with the radius.
        let left_out = |radius: f64| -> f64 {
            (degree + 1..=known)
                .map(|k| 2.0 * sizes[k] * radius.powi(k as i32 - 2))
                .sum()
        };
        let mut radius = region_radius(system, model, &l);
        while left_out(radius) > SHARE && radius > 1e-12 {
            radius *= 0.9;
        }
        let reach = short_of_kinks(system, riccati, &t, 0.5 * radius * radius);
        value.truncate(basis.start[degree + 1]);
        Ok(Self {
            degree,
            origin: system.reference.clone(),
            // z = t^-1 s = L's, by rows.
            matrix: l.as_slice().to_vec(),
            coefficients: value,
            reach,
        })
    }

    /// `z` of a state (absolute).
    fn place(&self, x: &[f64]) -> DVector<f64> {
        let n = x.len();
        let s = DVector::from_iterator(n, x.iter().zip(&self.origin).map(|(x, o)| x - o));
        DMatrix::from_row_slice(n, n, &self.matrix) * s
    }

    /// V and dV/dx at a state (absolute).
    pub fn at(&self, x: &[f64]) -> (f64, Vec<f64>) {
        let basis = Basis::new(x.len(), self.degree);
        let (z, n) = (self.place(x), x.len());
        let monomials = basis.monomials(z.as_slice());
        let dot = |c: &[f64]| c.iter().zip(&monomials).map(|(c, m)| c * m).sum::<f64>();
        let q =
            DVector::from_iterator(n, basis.gradient(&self.coefficients).iter().map(|g| dot(g)));
        let p = DMatrix::from_row_slice(n, n, &self.matrix).transpose() * q;
        (dot(&self.coefficients), p.as_slice().to_vec())
    }

    /// Whether the polynomial counts as known at a state (absolute).
    pub fn knows(&self, x: &[f64]) -> bool {
        0.5 * self.place(x).norm_squared() <= self.reach
    }
}

/// Radius of a ball of z that holds the region.
fn region_radius(system: &System, model: &Model, l: &DMatrix<f64>) -> f64 {
    (model.region.iter().zip(&system.reference).enumerate())
        .map(|(i, ([lo, hi], at))| (hi - at).abs().max((at - lo).abs()) * l.row(i).norm())
        .sum()
}
