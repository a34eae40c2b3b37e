//! V whose inequality is checked, and its gradient.

use super::{Chart, Laws, LoopError};
use crate::expr::Id;
use crate::hamiltonian::Hamiltonian;
use crate::model::Model;
use nalgebra::DMatrix;
use rayon::prelude::*;

/// Least eigenvalue of P, of its largest, which rounding may leave of 0.
const ROUNDING: f64 = 1e-10;

/// A value function that is to certify a gain.
pub enum Certificate<'c> {
    /// `1/2 s'P s` in deviations s: of a linear scene with a quadratic cost, where it is exact.
    Quadratic {
        p: DMatrix<f64>,
        reference: Vec<f64>,
    },
    Chart(&'c dyn Chart),
}

impl<'c> Certificate<'c> {
    /// The exact V where there is one, else the chart's.
    ///
    /// # Errors
    /// [`LoopError::NoValue`].
    pub fn of(laws: &Laws<'_>, chart: Option<&'c dyn Chart>) -> Result<Self, LoopError> {
        let exact = laws.riccati().filter(|_| is_linear(laws.model, laws.hamiltonian));
        let exact = exact.map(|r| &r.p).filter(|p| is_nonnegative(p));
        match (exact, chart) {
            (Some(p), _) => Ok(Self::Quadratic {
                p: p.clone(),
                reference: laws.model.reference().to_vec(),
            }),
            (None, Some(chart)) => Ok(Self::Chart(chart)),
            (None, None) => Err(LoopError::NoValue),
        }
    }

    /// In words.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Quadratic { .. } => "exact (linear scene)",
            Self::Chart(_) => "of the value map",
        }
    }

    /// V at a deviation, where it is a quadratic form.
    pub(super) fn quadratic(&self, s: &[f64]) -> Option<f64> {
        let p = self.matrix()?;
        let row = |i: usize| (0..s.len()).map(|j| p[(i, j)] * s[j]).sum::<f64>();
        Some(0.5 * (0..s.len()).map(|i| s[i] * row(i)).sum::<f64>())
    }

    pub(super) fn matrix(&self) -> Option<&DMatrix<f64>> {
        match self {
            Self::Quadratic { p, .. } => Some(p),
            Self::Chart(_) => None,
        }
    }

    pub(super) fn chart(&self) -> Option<&'c dyn Chart> {
        match self {
            Self::Quadratic { .. } => None,
            Self::Chart(chart) => Some(*chart),
        }
    }

    /// V and its gradient at a state, where they are known.
    pub fn local(&self, x: &[f64]) -> Option<(f64, Vec<f64>)> {
        match self {
            Self::Quadratic { p, reference } => {
                let s: Vec<f64> = x.iter().zip(reference).map(|(x, r)| x - r).collect();
                let gradient = (0..s.len()).map(|i| (0..s.len()).map(|j| p[(i, j)] * s[j]).sum());
                Some((self.quadratic(&s)?, gradient.collect()))
            }
            Self::Chart(chart) => chart.local(x).map(|here| (here.v, here.p)),
        }
    }

    /// V at states (`[state][n]`); NaN where it is not known.
    pub fn values(&self, x: &[f64], n: usize) -> Vec<f64> {
        (x.par_chunks_exact(n))
            .map(|x| match x.iter().all(|x| x.is_finite()) {
                true => self.local(x).map_or(f64::NAN, |(v, _)| v),
                false => f64::NAN,
            })
            .collect()
    }

    /// Estimated error of V at a state.
    pub(super) fn uncertainty(&self, x: &[f64]) -> f64 {
        match self {
            Self::Quadratic { .. } => 0.0,
            Self::Chart(chart) => chart.uncertainty(x),
        }
    }
}

/// Whether the bicharacteristics are linear everywhere, so that the local solution is V.
fn is_linear(model: &Model, hamiltonian: &Hamiltonian) -> bool {
    if model.controls.iter().any(|c| c.min.is_some() || c.max.is_some()) {
        return false;
    }
    let mut graph = hamiltonian.graph.clone();
    let variables: Vec<Id> = hamiltonian.x.iter().chain(&hamiltonian.p).copied().collect();
    let rates: Vec<Id> = (hamiltonian.state_rate.iter())
        .chain(&hamiltonian.adjoint_rate)
        .copied()
        .collect();
    rates.iter().all(|rate| {
        variables.iter().all(|a| {
            let slope = graph.diff(*rate, *a);
            !variables.iter().any(|b| graph.depends_on(&[slope], *b))
        })
    })
}

fn is_nonnegative(p: &DMatrix<f64>) -> bool {
    let eigenvalues = p.clone().symmetric_eigenvalues();
    eigenvalues.min() >= -ROUNDING * eigenvalues.max().abs()
}
