//! The error of solutions at states: some of them solved again, to a tolerance a hundred times
//! tighter.

use super::solve::{Answers, Entry, MOST_RTOL, scheme};
use crate::backend::BackendError;
use crate::backend::cpu::Cpu;
use crate::model::Precision;
use crate::numeric::random::random;
use crate::shooting::{Goal, Job, Solver};
use crate::sweep::Plan;
use crate::sweep::accuracy::{PROMISE, SMALL, Spread};

/// Solutions solved again at most.
const MOST: usize = 32;
const TIGHTER: f64 = 1e-2;
/// Least tolerances of Newton's method and of segments that f64 resolves.
const LEAST_TOLERANCE: f64 = 1e-12;
const LEAST_RTOL: f64 = 1e-14;

/// Errors of a sample of solutions, at the same states.
#[derive(Clone, Debug, PartialEq)]
pub struct SolvedAccuracy {
    /// Solutions solved again, and those that could not be.
    pub sampled: usize,
    pub failed: usize,
    /// Tolerance of the second solution.
    pub tolerance: f64,
    /// Relative to `|V| + SMALL value_scale`.
    pub value: Option<Spread>,
    /// Scaled by the region's widths, relative to `|p| + SMALL value_scale`.
    pub costate: Option<Spread>,
    /// Relative to each control's range over the sample.
    pub control: Option<Spread>,
    /// Largest error of V asked for.
    pub bound: f64,
    pub seconds: f64,
}

impl SolvedAccuracy {
    /// Whether the error asked for was met; `None` where nothing could be compared.
    pub fn met(&self) -> Option<bool> {
        self.value.map(|v| v.worst <= self.bound)
    }
}

/// Solves a random sample of the cheapest solutions again; `None` where there are none.
///
/// # Errors
/// What compiling the kernels refuses.
pub fn accuracy(plan: &Plan, answers: &Answers) -> Result<Option<SolvedAccuracy>, BackendError> {
    let clock = std::time::Instant::now();
    let mut entries: Vec<(u64, &Entry)> = (0..answers.targets.len())
        .filter_map(|t| answers.answer(t).map(|e| (random(plan.seed, t as u64), e)))
        .collect();
    entries.sort_by_key(|e| e.0);
    entries.truncate(MOST);
    if entries.is_empty() {
        return Ok(None);
    }
    let asked = plan.rtol_asked.min(MOST_RTOL);
    let tolerance = (TIGHTER * asked).max(LEAST_TOLERANCE);
    let rtol = (0.1 * tolerance).max(LEAST_RTOL);
    let cpu = Cpu::new();
    let scheme = scheme(plan, tolerance, &cpu);
    let mut solver = Solver::new(&cpu, Precision::F64, scheme, rtol)?;
    let mut jobs: Vec<Job> = (entries.iter())
        .map(|(_, e)| Job::new(e.path.clone(), Goal::State(e.path.start().to_vec())))
        .collect();
    solver.solve(&mut jobs)?;
    let n = plan.system.states;
    let control = |s: &[f64], p: &[f64]| plan.system.eval(&plan.system.observer.control, s, p);
    let relative = |error: f64, size: f64| if error == 0.0 { 0.0 } else { error / size };
    let (mut value, mut costate, mut controls) = (Vec::new(), Vec::new(), Vec::new());
    for ((_, entry), job) in entries.iter().zip(&jobs) {
        let Some(solved) = job.solved() else { continue };
        let p = job.path.adjoint();
        value.push(relative(
            (entry.value - solved.value).abs(),
            solved.value.abs() + SMALL * plan.value_scale,
        ));
        let norm = |at: &dyn Fn(usize) -> f64| {
            (0..n)
                .map(|i| (at(i) * plan.widths[i]).powi(2))
                .sum::<f64>()
                .sqrt()
        };
        costate.push(relative(
            norm(&|i| entry.p[i] - p[i]),
            norm(&|i| p[i]) + SMALL * plan.value_scale,
        ));
        controls.push((entry.u.clone(), control(job.path.start(), p)));
    }
    let mut control_errors = Vec::new();
    for k in 0..plan.system.observer.control.len() {
        let right = controls.iter().map(|(_, u)| u[k]);
        let (most, least) = (
            right.clone().fold(f64::NEG_INFINITY, f64::max),
            right.fold(f64::INFINITY, f64::min),
        );
        // A single state has no range: then the control's own size.
        let range = |u: f64| if most > least { most - least } else { u.abs() };
        control_errors.extend(
            controls
                .iter()
                .map(|(a, b)| relative((a[k] - b[k]).abs(), range(b[k]))),
        );
    }
    Ok(Some(SolvedAccuracy {
        sampled: jobs.len(),
        failed: jobs.iter().filter(|j| j.solved().is_none()).count(),
        tolerance,
        value: Spread::of(value),
        costate: Spread::of(costate),
        control: Spread::of(control_errors),
        bound: PROMISE * asked,
        seconds: clock.elapsed().as_secs_f64(),
    }))
}
