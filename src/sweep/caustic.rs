//! Points where the manifold folds, from trajectories that ended there.

use super::plan::Plan;
use crate::backend::Trajectories;
use crate::backend::cpu::Evaluator;
use crate::hamiltonian::Slope;

/// A point of the caustic: `det dx/dseed = 0`.
#[derive(Clone, Debug, PartialEq)]
pub struct FoldPoint {
    /// Index of the trajectory that ends there.
    pub trajectory: usize,
    /// Time as it happens (0 at the equilibrium, or the final time at the end).
    pub t: f64,
    pub x: Vec<f64>,
    pub p: Vec<f64>,
    pub value: f64,
}

/// Extrapolates ends to the folds that are just ahead of them.
pub(super) struct Folds {
    rates: Evaluator,
    first: usize,
}

impl Folds {
    pub fn new(plan: &Plan) -> Option<Self> {
        plan.slope.map(|first| Self {
            rates: Evaluator::new(&plan.spec.rate),
            first,
        })
    }

    /// The fold that trajectory `i` of a batch ends before: X grows as `C / (tau_fold - tau)`, so
    /// what is left of tau is `|X|^2 / (X . X')`; its square, relative to the time in which X
    /// changed, is neglected.
    pub fn ahead(
        &self,
        plan: &Plan,
        batch: &Trajectories,
        i: usize,
        trajectory: usize,
    ) -> Option<FoldPoint> {
        let n = plan.system.states;
        let end = &batch.end[i * batch.dim..][..batch.dim];
        let rate = self.rates.eval(end, batch.dim);
        let last = self.first + Slope::len(n);
        let (slope, change) = (&end[self.first..last], &rate[self.first..last]);
        let product = |other: &[f64]| Slope::product(slope, other, &plan.slope_units, n);
        let left = product(slope) / product(change);
        let left = if left.is_finite() && left >= 0.0 {
            left
        } else {
            0.0
        };
        let at = |k: usize| end[k] + left * rate[k];
        let end_time = plan.system.terminal.as_ref().map_or(0.0, |t| t.time);
        let point = FoldPoint {
            trajectory,
            t: end_time - batch.end_time[i] - left,
            x: (0..n).map(|k| plan.system.reference[k] + at(k)).collect(),
            p: (n..2 * n).map(at).collect(),
            value: at(2 * n),
        };
        let finite = point
            .x
            .iter()
            .chain(&point.p)
            .chain([&point.value])
            .all(|v| v.is_finite());
        finite.then_some(point)
    }
}
