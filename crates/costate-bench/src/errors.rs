//! How wrong a result is.
//!
//! Integration errors along the manifold of optimal solutions only slide a point to another one of
//! it. They grow with the parting of trajectories, and do no harm: V and p belong to the x reached.
//! What matters is how far a point is off the manifold, and that is what is measured, at every
//! stored sample, in three ways:
//!
//! - V: `e_V = |V - V_ref - p_ref.(x - x_ref)| / max(1, V_ref)`;
//! - p: `e_p = |p - p_ref - S (x - x_ref)| / max(1, |p_ref|)` with the reference's slope `S =
//!   dp/dx` (see [`Slopes`]) and p in units of cost, each component times the region's width;
//! - H: `e_H = |H - H_ref| / L`, L the largest running cost of the trajectory. H itself is not 0
//!   but what the local solution has left at the seed.
//!
//! A trajectory's error is its largest. What e_V and e_p leave is of the second order in `x -
//! x_ref`.

use super::reference::{Reference, Slopes, follow};
use super::work::Work;
use costate::backend::cpu::Evaluator;
use costate::backend::{Status, Trajectories};
use costate::low_level::numeric::quantile::nearest_rank;
use costate::low_level::program::Program;

/// Median, 99 % and largest of an error over trajectories; NaN where there is none.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quantiles {
    pub median: f64,
    pub p99: f64,
    pub worst: f64,
}

impl Quantiles {
    /// By nearest rank; trajectories without a value (NaN) are left out.
    pub fn of(values: &[f64]) -> Self {
        let mut sorted: Vec<f64> = values.iter().copied().filter(|x| !x.is_nan()).collect();
        sorted.sort_by(f64::total_cmp);
        Self {
            median: nearest_rank(&sorted, 0.5),
            p99: nearest_rank(&sorted, 0.99),
            worst: nearest_rank(&sorted, 1.0),
        }
    }
}

/// Errors of a result.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Errors {
    pub value: Quantiles,
    pub costate: Quantiles,
    pub hamiltonian: Quantiles,
    /// Share of the reference's samples that the result has too.
    pub compared: f64,
    /// Trajectories lost: they failed (step floor, step limit, not finite) short of their
    /// reference, or went on past its end.
    pub failed: usize,
    /// Trajectories whose reference failed: they are not compared.
    pub reference_failed: usize,
}

/// Share of the reference's samples that a result must have: leaving the region is noticed at the
/// end of a step, so that of trajectories that leave one may have a few samples more.
pub const ENOUGH: f64 = 0.95;

impl Errors {
    /// Whether nothing was lost that the reference has.
    pub fn complete(&self) -> bool {
        self.failed == 0 && self.compared >= ENOUGH
    }
}

/// Whether a trajectory ended for a reason of the integration, not of the problem.
pub fn is_failure(status: Status) -> bool {
    matches!(
        status,
        Status::StepFloor | Status::StepLimit | Status::NotFinite
    )
}

/// Evaluates H and the running cost.
pub struct Meter {
    evaluator: Evaluator,
}

impl Meter {
    pub fn new(work: &Work) -> Self {
        let system = &work.plan.system;
        let roots = [system.observer.hamiltonian, system.rate[2 * system.states]];
        Self {
            evaluator: Evaluator::new(&Program::lower(&system.graph, &system.inputs, &roots)),
        }
    }

    /// H and the running cost at the samples, `[trajectory][level]`.
    pub fn values(&self, result: &Trajectories) -> (Vec<f64>, Vec<f64>) {
        if result.samples.is_empty() {
            return (Vec::new(), Vec::new());
        }
        let values = self.evaluator.eval(&result.samples[1..], 1 + result.dim);
        values.chunks_exact(2).map(|v| (v[0], v[1])).unzip()
    }
}

/// Where a trajectory leaves the region may differ by rounding; this many samples more than its
/// reference has, it is on a way of its own.
const PAST_THE_END: usize = 2;

/// Compares the leading trajectories that both have.
pub fn compare(
    work: &Work,
    meter: &Meter,
    reference: &Reference,
    slopes: Option<&Slopes>,
    result: &Trajectories,
) -> Errors {
    let (hamiltonian, _) = meter.values(result);
    let pair = Pair {
        work,
        reference,
        slopes,
        result,
        hamiltonian,
    };
    let count = result.count().min(reference.result.count());
    let mut worst = vec![Worst::default(); count];
    let mut counts = Counts::default();
    for (i, worst) in worst.iter_mut().enumerate() {
        pair.see(i, worst, &mut counts);
    }
    let of = |error: fn(&Worst) -> f64| Quantiles::of(&worst.iter().map(error).collect::<Vec<_>>());
    Errors {
        value: of(|w| w.value),
        costate: of(|w| w.costate),
        hamiltonian: of(|w| w.hamiltonian),
        compared: counts.both as f64 / counts.there.max(1) as f64,
        failed: counts.failed,
        reference_failed: counts.reference_failed,
    }
}

/// The largest errors of a trajectory; NaN where nothing was compared.
#[derive(Clone, Copy)]
struct Worst {
    value: f64,
    costate: f64,
    hamiltonian: f64,
}

impl Default for Worst {
    fn default() -> Self {
        Self {
            value: f64::NAN,
            costate: f64::NAN,
            hamiltonian: f64::NAN,
        }
    }
}

/// Samples of the reference, and those that the result has too; trajectories that failed.
#[derive(Default)]
struct Counts {
    there: usize,
    both: usize,
    failed: usize,
    reference_failed: usize,
}

/// A result and what it is compared with.
struct Pair<'a> {
    work: &'a Work,
    reference: &'a Reference,
    slopes: Option<&'a Slopes>,
    result: &'a Trajectories,
    /// H of the result, `[trajectory][level]`.
    hamiltonian: Vec<f64>,
}

impl Pair<'_> {
    /// One trajectory.
    fn see(&self, i: usize, worst: &mut Worst, counts: &mut Counts) {
        let (result, reference) = (self.result, &self.reference.result);
        let levels = reference.levels;
        let passed =
            |r: &Trajectories| (0..levels).filter(|l| !r.sample(i, *l)[0].is_nan()).count();
        let (mine, theirs) = (passed(result), passed(reference));
        let beyond = mine > theirs + PAST_THE_END;
        if is_failure(reference.status[i]) {
            counts.reference_failed += 1;
            counts.failed += usize::from(beyond);
            return;
        }
        let short = is_failure(result.status[i]) && mine < theirs;
        counts.failed += usize::from(short || beyond);
        for level in 0..levels {
            let [here, there] = [result, reference].map(|r| !r.sample(i, level)[0].is_nan());
            counts.there += usize::from(there);
            counts.both += usize::from(here && there);
            if here && there && !short {
                self.see_sample(i, level, worst);
            }
        }
    }

    /// The errors of a sample that both have.
    fn see_sample(&self, i: usize, level: usize, worst: &mut Worst) {
        let n = self.work.states();
        let [a, b] = [self.result, &self.reference.result].map(|r| &r.sample(i, level)[1..]);
        see(&mut worst.value, value_error(n, a, b));
        if let Some(slope) = self.slopes.and_then(|s| s.at(i, level)) {
            let widths = &self.work.plan.widths;
            see(&mut worst.costate, costate_error(n, a, b, slope, widths));
        }
        let at = i * self.reference.result.levels + level;
        let change = (self.hamiltonian[at] - self.reference.hamiltonian[at]).abs();
        // Where nothing is paid and nothing has changed.
        let drift = if change == 0.0 {
            0.0
        } else {
            change / self.reference.running[i]
        };
        see(&mut worst.hamiltonian, drift);
    }
}

/// Keeps the larger one; a value that is not a number though both points are there is an infinite
/// error.
fn see(worst: &mut f64, error: f64) {
    let error = if error.is_nan() { f64::INFINITY } else { error };
    *worst = worst.max(error);
}

/// `e_V` of a point `(x, p, V)` against a reference point.
pub fn value_error(n: usize, point: &[f64], reference: &[f64]) -> f64 {
    let along: f64 = (0..n)
        .map(|i| reference[n + i] * (point[i] - reference[i]))
        .sum();
    (point[2 * n] - reference[2 * n] - along).abs() / reference[2 * n].max(1.0)
}

/// `e_p` of a point against a reference point with its slope (of p in units of cost by x in
/// widths).
pub fn costate_error(
    n: usize,
    point: &[f64],
    reference: &[f64],
    slope: &[f64],
    widths: &[f64],
) -> f64 {
    let moved: Vec<f64> = (0..n)
        .map(|i| (point[i] - reference[i]) / widths[i])
        .collect();
    let expected = follow(slope, &moved);
    let (mut error, mut size) = (0.0, 0.0f64);
    for i in 0..n {
        let change = (point[n + i] - reference[n + i]) * widths[i];
        error += (change - expected[i]).powi(2);
        size += (reference[n + i] * widths[i]).powi(2);
    }
    error.sqrt() / size.sqrt().max(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_by_nearest_rank() {
        let values: Vec<f64> = (1..=200).rev().map(f64::from).chain([f64::NAN]).collect();
        let q = Quantiles::of(&values);
        assert_eq!((q.median, q.p99, q.worst), (100.0, 198.0, 200.0));
        let one = Quantiles::of(&[3.0]);
        assert_eq!((one.median, one.p99, one.worst), (3.0, 3.0, 3.0));
        assert!(Quantiles::of(&[f64::NAN]).worst.is_nan());
    }

    /// V = 3 (x^2 + x y + y^2): what slides along it is no error, what leaves it is, by as much as
    /// it leaves it.
    #[test]
    fn only_what_leaves_the_manifold_counts() {
        let widths = [2.0, 4.0];
        let on = |x: f64, y: f64| {
            [
                x,
                y,
                3.0 * (2.0 * x + y),
                3.0 * (x + 2.0 * y),
                3.0 * (x * x + x * y + y * y),
            ]
        };
        // dp/dx times the widths on both sides.
        let slope = [6.0 * 4.0, 3.0 * 8.0, 3.0 * 8.0, 6.0 * 16.0];
        let reference = on(0.7, -0.2);
        let moved = on(0.7 + 1e-5, -0.2 - 2e-5);
        // Of the second order: 3 (1 - 2 + 4) 1e-10 in V; p is linear.
        let second = value_error(2, &moved, &reference);
        assert!(
            (second - 9e-10 / reference[4].max(1.0)).abs() < 1e-13,
            "{second}"
        );
        assert!(costate_error(2, &moved, &reference, &slope, &widths) < 1e-14);
        let mut off = moved;
        off[4] += 1e-3;
        off[2] += 1e-3;
        let scale = reference[4].max(1.0);
        assert!((value_error(2, &off, &reference) - 1e-3 / scale).abs() < 1e-8);
        let size = ((reference[2] * 2.0f64).powi(2) + (reference[3] * 4.0).powi(2))
            .sqrt()
            .max(1.0);
        let error = costate_error(2, &off, &reference, &slope, &widths);
        assert!((error - 2e-3 / size).abs() < 1e-12, "{error}");
    }
}
