//! V whose inequality is checked, and its gradient.

use super::{Chart, Laws, LoopError};
use crate::expr::Id;
use crate::hamiltonian::Hamiltonian;
use crate::model::Model;
use nalgebra::DMatrix;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

/// Least eigenvalue of P, of its largest, which rounding may leave of 0.
const ROUNDING: f64 = 1e-10;

/// A value function that is to certify a gain.
pub enum Certificate<'c> {
    /// `1/2 s'P s` in deviations s: of a linear scene with a quadratic cost, where it is exact.
    Quadratic {
        p: DMatrix<f64>,
        reference: Vec<f64>,
    },
    /// Interpolated; at initial states also solved for, where there is a [`Solver`].
    Chart(&'c dyn Chart, Option<Solver<'c>>),
}

/// V at states (`[state][n]`), more exact than a chart's; NaN where no solution is found.
pub type Solver<'c> = &'c (dyn Fn(&[f64]) -> Result<Vec<f64>, LoopError> + Sync);

/// Where V at an initial state is from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    Exact,
    Solved,
    Interpolated,
    Unknown,
}

impl Origin {
    pub const ALL: [(&'static str, Self); 4] = [
        ("exact", Self::Exact),
        ("solved", Self::Solved),
        ("interpolated", Self::Interpolated),
        ("unknown", Self::Unknown),
    ];
}

/// States that are solved for, at most.
const MOST_SOLVED: usize = 2000;

impl<'c> Certificate<'c> {
    /// The exact V where there is one, else the chart's.
    ///
    /// # Errors
    /// [`LoopError::NoValue`].
    pub fn of(
        laws: &Laws<'_>,
        chart: Option<&'c dyn Chart>,
        solver: Option<Solver<'c>>,
    ) -> Result<Self, LoopError> {
        let exact = laws
            .riccati()
            .filter(|_| is_linear(laws.model, laws.hamiltonian));
        let exact = exact.map(|r| &r.p).filter(|p| is_nonnegative(p));
        match (exact, chart) {
            (Some(p), _) => Ok(Self::Quadratic {
                p: p.clone(),
                reference: laws.model.reference().to_vec(),
            }),
            (None, Some(chart)) => Ok(Self::Chart(chart, solver)),
            (None, None) => Err(LoopError::NoValue),
        }
    }

    /// In words.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Quadratic { .. } => "exact (linear scene)",
            Self::Chart(..) => "of the value map",
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
            Self::Chart(..) => None,
        }
    }

    pub(super) fn chart(&self) -> Option<&'c dyn Chart> {
        match self {
            Self::Quadratic { .. } => None,
            Self::Chart(chart, _) => Some(*chart),
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
            Self::Chart(chart, _) => chart.local(x).map(|here| (here.v, here.p)),
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

    /// V at initial states (`[case][n]`, many of them the same) and where it is from. At the
    /// equilibrium V = 0 by definition.
    ///
    /// # Errors
    /// What solving gives.
    pub(super) fn initial(
        &self,
        x: &[f64],
        reference: &[f64],
    ) -> Result<(Vec<f64>, Vec<Origin>), LoopError> {
        let n = reference.len();
        let mut number: FxHashMap<Vec<u64>, usize> = FxHashMap::default();
        let mut states = Vec::new();
        let of: Vec<usize> = (x.chunks_exact(n))
            .map(|x| {
                *number
                    .entry(x.iter().map(|x| x.to_bits()).collect())
                    .or_insert_with(|| {
                        states.extend_from_slice(x);
                        states.len() / n - 1
                    })
            })
            .collect();
        let mut v = self.values(&states, n);
        let interpolated = matches!(self, Self::Chart(..));
        let plain = if interpolated {
            Origin::Interpolated
        } else {
            Origin::Exact
        };
        let mut origin: Vec<Origin> = (v.iter())
            .map(|v| if v.is_nan() { Origin::Unknown } else { plain })
            .collect();
        let wanted: Vec<usize> = (0..v.len())
            .filter(|k| origin[*k] == Origin::Interpolated)
            .collect();
        let (rest, wanted): (Vec<usize>, Vec<usize>) =
            (wanted.into_iter()).partition(|k| states[k * n..][..n] == *reference);
        for k in rest {
            (v[k], origin[k]) = (0.0, Origin::Exact);
        }
        if let Self::Chart(_, Some(solve)) = self
            && (1..=MOST_SOLVED).contains(&wanted.len())
        {
            let asked: Vec<f64> = wanted
                .iter()
                .flat_map(|k| &states[k * n..][..n])
                .copied()
                .collect();
            for (k, solved) in wanted.into_iter().zip(solve(&asked)?) {
                if !solved.is_nan() {
                    (v[k], origin[k]) = (solved, Origin::Solved);
                }
            }
        }
        Ok((
            of.iter().map(|k| v[*k]).collect(),
            of.iter().map(|k| origin[*k]).collect(),
        ))
    }

    /// Estimated error of V at a state.
    pub(super) fn uncertainty(&self, x: &[f64]) -> f64 {
        match self {
            Self::Quadratic { .. } => 0.0,
            Self::Chart(chart, _) => chart.uncertainty(x),
        }
    }
}

/// Whether the bicharacteristics are linear everywhere, so that the local solution is V.
fn is_linear(model: &Model, hamiltonian: &Hamiltonian) -> bool {
    if model
        .controls
        .iter()
        .any(|c| c.min.is_some() || c.max.is_some())
    {
        return false;
    }
    let mut graph = hamiltonian.graph.clone();
    let variables: Vec<Id> = hamiltonian
        .x
        .iter()
        .chain(&hamiltonian.p)
        .copied()
        .collect();
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
