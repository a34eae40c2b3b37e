//! The bicharacteristics linearized at the equilibrium.

use crate::hamiltonian::Hamiltonian;
use crate::model::Model;
use nalgebra::{DMatrix, DVector};

/// Second derivatives of H at the equilibrium: `s' = A s + G p`, `p' = -Q s - A'p`, each matrix `n
/// x n`.
#[derive(Clone, Debug, PartialEq)]
pub struct Linearization {
    pub a: DMatrix<f64>,
    /// `H_pp = -B R^-1 B'` (plus the disturbance's part in a game).
    pub g: DMatrix<f64>,
    /// `H_xx`.
    pub q: DMatrix<f64>,
}

/// Widths of the region.
pub(super) fn widths(model: &Model) -> DVector<f64> {
    DVector::from_iterator(
        model.region.len(),
        model.region.iter().map(|[lo, hi]| hi - lo),
    )
}

impl Linearization {
    /// At the scene's equilibrium, in coordinates scaled by the region's widths, so that units do
    /// not matter. Entries are not finite where H has no second derivatives there.
    pub fn new(hamiltonian: &Hamiltonian, model: &Model) -> Self {
        let n = hamiltonian.states();
        let h = hamiltonian.hessian_at(model);
        let block =
            |row: usize, col: usize, i: usize, j: usize| h[(row * n + i) * 2 * n + col * n + j];
        let w = widths(model);
        Self {
            a: DMatrix::from_fn(n, n, |i, j| block(1, 0, i, j) * w[j] / w[i]),
            g: DMatrix::from_fn(n, n, |i, j| block(1, 1, i, j) / (w[i] * w[j])),
            q: DMatrix::from_fn(n, n, |i, j| block(0, 0, i, j) * w[i] * w[j]),
        }
    }

    pub fn is_finite(&self) -> bool {
        let mut all = [&self.a, &self.g, &self.q]
            .into_iter()
            .flat_map(|m| m.iter());
        all.all(|x| x.is_finite())
    }

    /// `[A, G; -Q, -A']`.
    pub fn hamiltonian_matrix(&self) -> DMatrix<f64> {
        let n = self.a.nrows();
        let mut m = DMatrix::zeros(2 * n, 2 * n);
        m.view_mut((0, 0), (n, n)).copy_from(&self.a);
        m.view_mut((0, n), (n, n)).copy_from(&self.g);
        m.view_mut((n, 0), (n, n)).copy_from(&-&self.q);
        m.view_mut((n, n), (n, n)).copy_from(&-self.a.transpose());
        m
    }

    /// With adjoints scaled so that the Hamiltonian matrix's off-diagonal blocks are of like size,
    /// and the scale: P is so many times larger. Eigenvalues are unchanged.
    pub fn balanced(&self) -> (Self, f64) {
        let (g, q) = (self.g.norm(), self.q.norm());
        // Without one of them the other is made of the size of A.
        let a = self.a.norm();
        let factor = match (g > 0.0, q > 0.0) {
            (true, true) => (q / g).sqrt(),
            (false, true) if a > 0.0 => q / a,
            (true, false) if a > 0.0 => a / g,
            _ => 1.0,
        };
        let balanced = Self {
            a: self.a.clone(),
            g: &self.g * factor,
            q: &self.q / factor,
        };
        (balanced, factor)
    }

    /// The equation of `P^-1` in the form of that of P: `A Y + Y A' + Y Q Y + G = 0`.
    pub(super) fn dual(&self) -> Self {
        Self {
            a: self.a.transpose(),
            g: self.q.clone(),
            q: self.g.clone(),
        }
    }
}
