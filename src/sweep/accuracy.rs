//! A run's own estimate of its error: some of its trajectories again, in f64, to a tolerance a
//! hundred times tighter, by another method where there is one.
//!
//! Errors along the manifold of optimal solutions slide a point to another point of it, where V and
//! p are right again. They grow with the parting of trajectories and are no errors of the answer,
//! so they are taken out: of V by the slope, `e_V = |dV - (p + p_ref)/2 . dx|` (the trapezoidal
//! rule: right to the third order in dx), of p by dp/dx along the manifold, which neighbours of the
//! reference trajectory show. What curvature these leave counts as error.

use super::plan::Plan;
use super::sample::Sample;
use crate::backend::cpu::Cpu;
use crate::backend::cpu::Evaluator;
use crate::backend::{Backend, BackendError, Status, Trajectories, batch_limit};
use crate::model::{Method, Precision};
use crate::numeric::quantile::median_p99_max;
use crate::program::Program;
use nalgebra::{DMatrix, DVector};

/// The reference's tolerance in units of the run's, and the least one that f64 resolves.
const TIGHTER: f64 = 1e-2;
const LEAST_RTOL: f64 = 1e-14;
/// The reference may take this many times the run's steps.
const MORE_STEPS: u32 = 20;
/// Sizes below this share of the largest V (of V per width of the region for p) are measured
/// against it.
pub const SMALL: f64 = 1e-3;
/// The asked error is met where the worst one of the sample is at most this many times the asked
/// tolerance. The tolerance bounds a step's error in the mean over the 2n + 1 components, so one
/// may take sqrt(2n + 1) of it, about 3; and off the manifold errors decay at the rates of the
/// closed loop, so that a point has those of some ten steps.
pub const PROMISE: f64 = 30.0;
/// Share of the sample that may end otherwise than the reference does (at a guard it may graze,
/// ...).
const MAY_DIFFER: f64 = 0.05;
/// Share of the points that may have slid too far to be compared.
const MAY_PART: f64 = 0.05;
/// An estimate below this many times what the curvature of V leaves in it cannot be told from that.
const CURVATURE: f64 = 3.0;
/// Trajectories with neighbours, and levels of each at which p and u are looked at.
const WITH_NEIGHBOURS: usize = 64;
const LEVELS: usize = 16;
/// Directions in which neighbours part less than this share of the most tell nothing.
const RANK: f64 = 1e-8;

/// Median, 99 % and largest of relative errors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    pub median: f64,
    pub p99: f64,
    pub worst: f64,
}

impl Spread {
    /// Of all errors; what is not a number counts as infinite. `None` of nothing.
    pub fn of(mut errors: Vec<f64>) -> Option<Self> {
        errors
            .iter_mut()
            .filter(|e| e.is_nan())
            .for_each(|e| *e = f64::INFINITY);
        let [median, p99, worst] = median_p99_max(&errors);
        (!errors.is_empty()).then_some(Self { median, p99, worst })
    }
}

/// What the comparison says.
#[derive(Clone, Debug, PartialEq)]
pub struct Accuracy {
    /// Trajectories integrated again, and how many of them had failed in the run.
    pub sampled: usize,
    pub failed: usize,
    /// Stored points compared, and those that have slid so far from their reference that what is
    /// left of their error after the correction for it would be curvature of V.
    pub compared: usize,
    pub parted: usize,
    pub method: Method,
    pub rtol: f64,
    /// Off-manifold error of V relative to `|V| + SMALL value_scale`, the seeds' own error
    /// included.
    pub value: Option<Spread>,
    /// Error of p, scaled by the region's widths, relative to `|p| + SMALL value_scale`.
    pub costate: Option<Spread>,
    /// Error of u relative to each control's range over the sample.
    pub control: Option<Spread>,
    /// Farthest that a point has slid along the manifold, in widths of the region: no error.
    pub slid: f64,
    /// Trajectories that end earlier or later than the reference does, which no error explains.
    pub differ: usize,
    /// Largest error of V that was asked for.
    pub bound: f64,
    pub seconds: f64,
}

/// Whether the error of V that was asked for was met, by the worst one of points that were compared,
/// of trajectories of which some ended otherwise than their references, and of points of which some
/// have parted from theirs; `None` where too little could be compared.
pub(crate) fn are_met(
    worst: f64,
    bound: f64,
    (sampled, differ): (usize, usize),
    (compared, parted): (usize, usize),
) -> Option<bool> {
    // (An error that is no number is not met.)
    let fails = worst.is_nan() || worst > bound || differ as f64 > MAY_DIFFER * sampled as f64;
    match fails {
        true => Some(false),
        false => (!part_fast(compared, parted)).then_some(true),
    }
}

/// Whether more points have parted from their reference than may.
fn part_fast(compared: usize, parted: usize) -> bool {
    parted as f64 > MAY_PART * (compared + parted) as f64
}

impl Accuracy {
    /// Whether the error asked for was met; `None` where too little could be compared to say so.
    pub fn met(&self) -> Option<bool> {
        let worst = self.value?.worst;
        are_met(
            worst,
            self.bound,
            (self.sampled, self.differ),
            (self.compared, self.parted),
        )
    }

    /// Whether more points have parted from their reference than may.
    #[must_use]
    pub fn parts_fast(&self) -> bool {
        part_fast(self.compared, self.parted)
    }
}

/// Largest error of V that a run asks for: [`PROMISE`] times its tolerance, that for small values
/// included.
pub fn bound(plan: &Plan) -> f64 {
    // Where the precision is too low for what was asked, both tolerances are larger than that.
    let raised = plan.run.rtol / plan.rtol_asked;
    PROMISE * plan.rtol_asked.max(plan.atol / raised / SMALL)
}

/// A method to check another one by.
fn other(method: Method) -> Method {
    if method == Method::Taylor {
        Method::Dop853
    } else {
        Method::Taylor
    }
}

/// Estimates a sweep's error from a sample of it.
///
/// # Errors
/// What compiling the reference's kernel refuses.
pub fn estimate(plan: &Plan, sample: &Sample) -> Result<Accuracy, BackendError> {
    let clock = std::time::Instant::now();
    let mut reference = Reference::new(plan)?;
    let seeds: Vec<&[f64]> = sample.kept.iter().map(|k| k.seed.as_slice()).collect();
    let again = reference.integrate(plan, &seeds)?;
    let mut comparison = Comparison::new(plan, sample, &again);
    comparison.values();
    if sample.levels > plan.inner {
        comparison.slopes(&mut reference)?;
    }
    let failures = [Status::StepFloor, Status::StepLimit, Status::NotFinite];
    Ok(Accuracy {
        sampled: sample.kept.len(),
        failed: sample
            .kept
            .iter()
            .filter(|k| failures.contains(&k.status))
            .count(),
        compared: comparison.value.len(),
        parted: comparison.parted,
        method: reference.method,
        rtol: reference.run.rtol,
        slid: comparison.slid,
        differ: comparison.differ,
        bound: bound(plan),
        value: Spread::of(comparison.value),
        costate: Spread::of(comparison.costate),
        control: Spread::of(comparison.control),
        seconds: clock.elapsed().as_secs_f64(),
    })
}

/// The same sweep's kernel, in f64 and finer.
struct Reference {
    kernel: Box<dyn crate::backend::Kernel>,
    run: crate::backend::Run,
    method: Method,
    dim: usize,
}

impl Reference {
    fn new(plan: &Plan) -> Result<Self, BackendError> {
        let mut spec = plan.spec.clone();
        spec.precision = Precision::F64;
        spec.method = other(plan.spec.method);
        spec.store = true;
        let rtol = (TIGHTER * plan.run.rtol.min(plan.rtol_asked)).max(LEAST_RTOL);
        let mut run = plan.run.clone();
        run.atol.iter_mut().for_each(|a| *a *= rtol / plan.run.rtol);
        run.rtol = rtol;
        run.max_steps = run.max_steps.saturating_mul(MORE_STEPS);
        Ok(Self {
            kernel: Cpu::new().compile(&spec)?,
            run,
            method: spec.method,
            dim: spec.dim(),
        })
    }

    fn integrate(&mut self, plan: &Plan, seeds: &[&[f64]]) -> Result<Trajectories, BackendError> {
        let mut all = Trajectories {
            dim: self.dim,
            levels: self.run.levels.len(),
            ..Trajectories::default()
        };
        for chunk in seeds.chunks(batch_limit(self.dim, self.run.levels.len())) {
            let mut batch = Vec::with_capacity(chunk.len() * self.dim);
            for seed in chunk {
                batch.extend(plan.start(seed));
            }
            let result = self.kernel.integrate(&self.run, &batch)?;
            all.end.extend(result.end);
            all.end_time.extend(result.end_time);
            all.status.extend(result.status);
            all.steps.extend(result.steps);
            all.rejected.extend(result.rejected);
            all.samples.extend(result.samples);
        }
        Ok(all)
    }
}

fn passed(batch: &Trajectories, i: usize) -> usize {
    (0..batch.levels)
        .take_while(|k| !batch.sample(i, *k)[0].is_nan())
        .count()
}

/// An error relative to a size; 0/0 counts as 0.
fn relative(error: f64, size: f64) -> f64 {
    if error == 0.0 { 0.0 } else { error / size }
}

struct Comparison<'a> {
    plan: &'a Plan,
    sample: &'a Sample,
    again: &'a Trajectories,
    n: usize,
    value: Vec<f64>,
    costate: Vec<f64>,
    control: Vec<f64>,
    slid: f64,
    parted: usize,
    differ: usize,
}

impl<'a> Comparison<'a> {
    fn new(plan: &'a Plan, sample: &'a Sample, again: &'a Trajectories) -> Self {
        Self {
            plan,
            sample,
            again,
            n: plan.system.states,
            value: Vec::new(),
            costate: Vec::new(),
            control: Vec::new(),
            slid: 0.0,
            parted: 0,
            differ: 0,
        }
    }

    /// Levels that both have, counted from the seed.
    fn common(&self, i: usize) -> usize {
        self.sample.passed(i).min(passed(self.again, i))
    }

    fn values(&mut self) {
        for i in 0..self.sample.kept.len() {
            for k in self.plan.inner..self.common(i) {
                let (a, b) = (&self.sample.point(i, k)[1..], &self.again.sample(i, k)[1..]);
                match self.value_error(a, b) {
                    Some(error) => self.value.push(error),
                    None => self.parted += 1,
                }
                self.slid = self.slid.max(self.slide(a, b));
            }
            self.differ += usize::from(self.ends_differ(i));
        }
    }

    /// Distance of a point from its reference, in widths of the region.
    fn slide(&self, a: &[f64], b: &[f64]) -> f64 {
        (0..self.n)
            .map(|j| ((a[j] - b[j]) / self.plan.widths[j]).abs())
            .fold(0.0, f64::max)
    }

    /// Relative error of V; `None` where it cannot be told from the curvature of V.
    fn value_error(&self, a: &[f64], b: &[f64]) -> Option<f64> {
        let (n, v) = (self.n, 2 * self.n);
        let seeds = self.plan.local.as_ref().map_or(0.0, |l| l.error);
        let size = b[v].abs() + SMALL * self.plan.value_scale;
        let along = |w: &dyn Fn(usize) -> f64| (0..n).map(|j| w(j) * (a[j] - b[j])).sum::<f64>();
        let error = (a[v] - b[v] - along(&|j| 0.5 * (a[n + j] + b[n + j]))).abs();
        // The second-order term is right to the third order: its share that changes over the
        // distance is not.
        let curvature = 0.5 * along(&|j| a[n + j] - b[n + j]).abs() * self.slide(a, b);
        let hidden = curvature > bound(self.plan) * size && error <= CURVATURE * curvature;
        (!hidden).then(|| relative(error + seeds, size))
    }

    /// Whether one of the two goes on where the other has ended. Ends outside the region are seen
    /// at the end of a step only, and a level next to an end may be passed on one side: such
    /// differences say nothing.
    fn ends_differ(&self, i: usize) -> bool {
        let (a, b) = (self.sample.passed(i), passed(self.again, i));
        let next = a.min(b) + 1;
        let point = if a > next {
            self.sample.point(i, next)
        } else if b > next {
            self.again.sample(i, next)
        } else {
            return false;
        };
        // A trajectory that failed is counted as that.
        let failed = matches!(
            self.sample.kept[i].status,
            Status::StepFloor | Status::StepLimit | Status::NotFinite
        );
        let inside =
            (point[1..].iter().zip(&self.plan.run.bounds)).all(|(x, [lo, hi])| lo < x && x < hi);
        inside && !(failed && b > a)
    }

    /// Errors of p and u.
    fn slopes(&mut self, reference: &mut Reference) -> Result<(), BackendError> {
        let plan = self.plan;
        let (n, count) = (self.n, self.sample.kept.len().min(WITH_NEIGHBOURS));
        // Large against the reference's errors, small against what the manifold bends over.
        let distance = (0.01 * reference.run.rtol.sqrt()).clamp(1e-8, 1e-4);
        let mut seeds = Vec::new();
        let mut first = vec![0];
        for kept in &self.sample.kept[..count] {
            let near = plan.surface.near(&kept.parameter, distance);
            seeds.extend(near.into_iter().filter(|s| plan.surface.inside(s)));
            first.push(seeds.len());
        }
        let near =
            reference.integrate(plan, &seeds.iter().map(Vec::as_slice).collect::<Vec<_>>())?;
        // Rates of (s, p): the manifold's tangent along the trajectory.
        let rates = Evaluator::new(&Program::lower(
            &plan.system.graph,
            &plan.system.inputs,
            &plan.system.rate[..2 * n],
        ));
        let (mut found, mut right) = (Vec::new(), Vec::new());
        for i in 0..count {
            let common = self.common(i).max(plan.inner);
            let every = (common - plan.inner).div_ceil(LEVELS).max(1);
            for k in (plan.inner..common).rev().step_by(every) {
                let (a, b) = (&self.sample.point(i, k)[1..], &self.again.sample(i, k)[1..]);
                if self.value_error(a, b).is_none() {
                    continue;
                }
                let beside = (first[i]..first[i + 1]).map(|j| &near.sample(j, k)[1..=2 * n]);
                let along = rates.eval(&b[..2 * n], 2 * n);
                let slope = self.along(&a[..n], &b[..2 * n], beside, &along);
                let wanted: Vec<f64> = (0..n).map(|j| b[n + j] + slope[j]).collect();
                let norm = |p: &mut dyn Iterator<Item = f64>| p.map(|x| x * x).sum::<f64>().sqrt();
                let error = norm(&mut (0..n).map(|j| (a[n + j] - wanted[j]) * plan.widths[j]));
                let size = norm(&mut (0..n).map(|j| wanted[j] * plan.widths[j]));
                self.costate
                    .push(relative(error, size + SMALL * plan.value_scale));
                found.extend_from_slice(&a[..2 * n]);
                right.extend_from_slice(&a[..n]);
                right.extend_from_slice(&wanted);
            }
        }
        self.controls(&found, &right);
        Ok(())
    }

    /// How p changes along the manifold from the reference's point `b` to where its state is `x`.
    fn along<'b>(
        &self,
        x: &[f64],
        b: &[f64],
        beside: impl Iterator<Item = &'b [f64]>,
        rate: &[f64],
    ) -> Vec<f64> {
        let (n, widths) = (self.n, &self.plan.widths);
        let mut columns: Vec<Vec<f64>> = beside
            .map(|z| z.iter().zip(b).map(|(z, b)| z - b).collect())
            .collect();
        columns.push(rate.to_vec());
        let mut tangents: Vec<(Vec<f64>, Vec<f64>)> = Vec::new();
        for c in columns {
            let dx: Vec<f64> = (0..n).map(|j| c[j] / widths[j]).collect();
            let norm = dx.iter().map(|x| x * x).sum::<f64>().sqrt();
            if norm > 0.0 && c.iter().all(|x| x.is_finite()) {
                let unit = |v: f64| v / norm;
                tangents.push((
                    dx.into_iter().map(unit).collect(),
                    c[n..2 * n].iter().copied().map(unit).collect(),
                ));
            }
        }
        if tangents.is_empty() {
            return vec![0.0; n];
        }
        let d = DMatrix::from_fn(n, tangents.len(), |i, j| tangents[j].0[i]);
        let e = DMatrix::from_fn(n, tangents.len(), |i, j| tangents[j].1[i]);
        let moved = DVector::from_fn(n, |i, _| (x[i] - b[i]) / widths[i]);
        let svd = d.svd(true, true);
        let least = RANK * svd.singular_values.max();
        svd.solve(&moved, least)
            .map_or_else(|_| vec![0.0; n], |c| (e * c).iter().copied().collect())
    }

    /// Errors of u at points `(s, p)`, given the right ones.
    fn controls(&mut self, found: &[f64], right: &[f64]) {
        let system = &self.plan.system;
        let m = system.observer.control.len();
        let program = Program::lower(&system.graph, &system.inputs, &system.observer.control);
        let evaluator = Evaluator::new(&program);
        let (u, wanted) = (
            evaluator.eval(found, 2 * self.n),
            evaluator.eval(right, 2 * self.n),
        );
        for control in 0..m {
            let of = |u: &[f64]| {
                u.iter()
                    .skip(control)
                    .step_by(m)
                    .copied()
                    .collect::<Vec<_>>()
            };
            let (u, wanted) = (of(&u), of(&wanted));
            let range = wanted.iter().copied().fold(f64::NEG_INFINITY, f64::max)
                - wanted.iter().copied().fold(f64::INFINITY, f64::min);
            (self.control).extend(
                u.iter()
                    .zip(&wanted)
                    .map(|(u, w)| relative((u - w).abs(), range)),
            );
        }
    }
}
