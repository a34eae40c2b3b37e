//! Where explicit methods, or shooting itself, are the wrong tool: rates too far apart.
//!
//! Shooting out follows all modes of the closed loop backward in time, where they grow. One that
//! grows much faster than the slowest multiplies any difference of two seeds, down to rounding,
//! before the slow one has come far: it is accuracy, not stability, that then limits the steps, and
//! the fronts' part along the slow modes comes from seeds that no number tells apart
//! ([`Separation`]). Stability limits the steps where a fast mode is absent: off the manifold,
//! where it decays backward in time, or exactly zero along a trajectory ([`held_steps`]). Boundary
//! value problems have segments as short as the fastest mode asks for ([`segments`]).

use super::plan::Plan;
use super::sample::Sample;
use crate::backend::cpu::Evaluator;
use crate::integrator::Scheme;
use crate::local::eigenvalues_of;
use crate::program::Program;
use nalgebra::{Complex, DMatrix};

/// Trajectories and points of each at which the rates are looked at.
const TRAJECTORIES: usize = 16;
const POINTS: usize = 8;
/// A trajectory over fewer time constants of its fastest mode is not stiff, whatever its steps.
const TIME_CONSTANTS: f64 = 300.0;
/// Mean |lambda| h over the boundary of stability from which on steps are held by it. Steps that
/// accuracy chooses are well below at any useful tolerance.
const HELD: f64 = 0.5;
/// Share of all steps that must be held so to be worth a word.
const SHARE: f64 = 0.5;
/// Ratio of rates and segments of a solution from which on solving is called stiff.
const RATIO: f64 = 50.0;
const MANY_SEGMENTS: f64 = 250.0;

/// How far apart the rates of the linearized closed loop are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Separation {
    pub fastest: Complex<f64>,
    pub slowest: Complex<f64>,
    /// Of their real parts.
    pub ratio: f64,
    /// Powers of ten by which the fastest mode outgrows the slowest from the seeds to the outermost
    /// front.
    pub digits: f64,
    /// Digits of the run's precision.
    pub resolved: f64,
}

impl Separation {
    /// Whether fronts along the slow modes come from seeds that the precision cannot tell apart.
    pub fn hides_fronts(&self) -> bool {
        self.digits > self.resolved
    }
}

/// The rates at the equilibrium; `None` on a finite horizon.
pub fn separation(plan: &Plan) -> Option<Separation> {
    let local = plan.local.as_ref()?;
    let by_rate = |a: &&Complex<f64>, b: &&Complex<f64>| a.re.total_cmp(&b.re);
    let fastest = *local.riccati.eigenvalues.iter().min_by(by_rate)?;
    let slowest = *local.riccati.eigenvalues.iter().max_by(by_rate)?;
    let ratio = fastest.re / slowest.re;
    // V grows twice as fast as the deviation.
    let slow = 0.5 * (plan.value_scale / local.seed_value).ln();
    Some(Separation {
        fastest,
        slowest,
        ratio,
        digits: (ratio - 1.0) * slow.max(0.0) / std::f64::consts::LN_10,
        resolved: -plan.spec.precision.epsilon().log10(),
    })
}

/// Steps that stability, not accuracy, has held down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HeldSteps {
    /// Share of all steps of the sample.
    pub share: f64,
    /// Mean |lambda| h of the trajectories concerned, with the largest |lambda| at each point.
    pub product: f64,
    /// Where the method becomes unstable on the negative real axis.
    pub boundary: f64,
    /// Largest |lambda| seen.
    pub rate: f64,
    /// Time constants of it that a trajectory lasts: mean.
    pub time_constants: f64,
}

/// Whether most steps of the sampled trajectories were held at the method's boundary of stability:
/// from the eigenvalues of the characteristics' Jacobian along them and the number of steps taken.
pub fn held_steps(plan: &Plan, sample: &Sample) -> Option<HeldSteps> {
    let boundary = real_boundary(plan.spec.method.scheme(plan.run.rtol));
    // A stiff trajectory of so many time constants has at least this many steps.
    let least = TIME_CONSTANTS / (2.0 * boundary);
    let candidates: Vec<usize> = (0..sample.kept.len())
        .filter(|i| f64::from(sample.kept[*i].steps) >= least)
        .collect();
    let examined: Vec<usize> = candidates.iter().copied().take(TRAJECTORIES).collect();
    let steps = |of: &[usize]| {
        of.iter()
            .map(|i| f64::from(sample.kept[*i].steps))
            .sum::<f64>()
    };
    let all = steps(&(0..sample.kept.len()).collect::<Vec<_>>());
    if examined.is_empty() || steps(&candidates) < SHARE * all {
        return None;
    }
    let jacobian = Jacobian::new(plan);
    let mut held: Vec<(usize, f64)> = Vec::new();
    let mut rate = 0.0f64;
    for i in &examined {
        let (constants, largest) = time_constants(plan, sample, *i, &jacobian);
        if constants >= TIME_CONSTANTS
            && constants / f64::from(sample.kept[*i].steps) >= HELD * boundary
        {
            held.push((*i, constants));
            rate = rate.max(largest);
        }
    }
    let concerned = steps(&held.iter().map(|h| h.0).collect::<Vec<_>>());
    let share = concerned / steps(&examined) * steps(&candidates) / all;
    let constants: f64 = held.iter().map(|h| h.1).sum();
    (share >= SHARE).then(|| HeldSteps {
        share,
        product: constants / concerned,
        boundary,
        rate,
        time_constants: constants / held.len() as f64,
    })
}

/// Integral of the largest |lambda| over a trajectory's time (from below: towards a singularity it
/// rises without limit between two points), and the largest of all.
fn time_constants(plan: &Plan, sample: &Sample, i: usize, jacobian: &Jacobian) -> (f64, f64) {
    let kept = &sample.kept[i];
    let width = 2 * plan.system.states;
    let mut points = vec![(0.0, &kept.seed[..width])];
    let passed = sample.passed(i);
    for k in (0..passed).step_by(passed.div_ceil(POINTS).max(1)) {
        let point = sample.point(i, k);
        points.push((point[0], &point[1..=width]));
    }
    points.push((kept.end_time, &kept.end[..width]));
    let rates: Vec<(f64, f64)> = (points.iter())
        .map(|(t, z)| (*t, jacobian.radius(z)))
        .filter(|(t, r)| t.is_finite() && r.is_finite())
        .collect();
    let integral = rates
        .windows(2)
        .map(|w| w[0].1.min(w[1].1) * (w[1].0 - w[0].0).max(0.0))
        .sum();
    (integral, rates.iter().map(|r| r.1).fold(0.0, f64::max))
}

/// The Jacobian of the characteristics' rates by `(s, p)`, in units of the region.
struct Jacobian {
    evaluator: Evaluator,
    scales: Vec<f64>,
}

impl Jacobian {
    fn new(plan: &Plan) -> Self {
        let system = &plan.system;
        let width = 2 * system.states;
        let mut graph = system.graph.clone();
        let mut entries = Vec::new();
        for input in &system.inputs {
            entries.extend(graph.diff_all(&system.rate[..width], *input));
        }
        let scales = (plan.widths.iter().copied())
            .chain(plan.widths.iter().map(|w| plan.value_scale / w))
            .collect();
        Self {
            evaluator: Evaluator::new(&Program::lower(&graph, &system.inputs, &entries)),
            scales,
        }
    }

    /// Largest |lambda| at a point.
    fn radius(&self, z: &[f64]) -> f64 {
        let width = self.scales.len();
        let values = self.evaluator.eval(z, width);
        let matrix = DMatrix::from_fn(width, width, |i, j| {
            values[j * width + i] * self.scales[j] / self.scales[i]
        });
        if matrix.iter().any(|x| !x.is_finite()) {
            return f64::NAN;
        }
        eigenvalues_of(&matrix)
            .iter()
            .map(|e| e.norm())
            .fold(0.0, f64::max)
    }
}

/// Where `|R(z)|` first exceeds 1 on the negative real axis, as a positive number.
pub fn real_boundary(scheme: Scheme) -> f64 {
    const STEP: f64 = 0.01;
    // R(z) of y' = lambda y with z = lambda h.
    let growth = |z: f64| match scheme {
        Scheme::RungeKutta(tableau) => {
            let mut stages = vec![z];
            let mut y = 1.0;
            for row in tableau.a {
                y = 1.0 + row.iter().zip(&stages).map(|(a, k)| a * k).sum::<f64>();
                stages.push(z * y);
            }
            y
        }
        Scheme::Taylor(order) => (1..=order)
            .rev()
            .fold(1.0, |sum, n| 1.0 + sum * z / n as f64),
    };
    let mut z = STEP;
    while growth(-z).abs() <= 1.0 && z < 100.0 {
        z += STEP;
    }
    z
}

/// Why solving at states is slow.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Segments {
    pub separation: Separation,
    /// Mean number of segments of a solution.
    pub mean: f64,
    /// States that would take more than are tried.
    pub beyond: usize,
}

/// Whether solutions take very many segments because the fastest mode is so much faster than the
/// slowest; `beyond`: states whose trajectories do not come near the equilibrium within the longest
/// horizon that is tried.
pub fn segments(
    plan: &Plan,
    counts: impl Iterator<Item = usize>,
    beyond: usize,
) -> Option<Segments> {
    let (mut sum, mut count) = (0, 0);
    for c in counts {
        (sum, count) = (sum + c, count + 1);
    }
    let mean = sum as f64 / count.max(1) as f64;
    separation(plan)
        .filter(|s| s.ratio >= RATIO && (mean >= MANY_SEGMENTS || beyond > 0))
        .map(|separation| Segments {
            separation,
            mean,
            beyond,
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Method;

    /// Known ends of the real stability intervals: 2.785 (any method of order 4 in 4 stages).
    #[test]
    fn stability_intervals() {
        assert!((real_boundary(Method::Rk4.scheme(1e-6)) - 2.785).abs() < 0.011);
        let tsit5 = real_boundary(Method::Tsit5.scheme(1e-6));
        let dop853 = real_boundary(Method::Dop853.scheme(1e-6));
        assert!(
            (3.0..4.0).contains(&tsit5) && (5.0..7.0).contains(&dop853),
            "{tsit5} {dop853}"
        );
        // Series of higher order: towards order / e.
        assert!((real_boundary(Scheme::Taylor(4)) - 2.785).abs() < 0.011);
        let high = real_boundary(Scheme::Taylor(20));
        assert!((8.0..9.5).contains(&high), "{high}");
    }
}
