//! How far the stored samples are from the manifold of optimal solutions: against a reference in
//! f64 at rtol 1e-12 from the same seeds, and by H, which is 0 on it.
//!
//! Errors along the manifold only slide a sample to another point of it. They grow with the parting
//! of trajectories, so x - x_ref may be far larger than the error of V at the x stored, which is
//! what matters. It is taken out to first order by p_ref (the metric e_V), and to second order by
//! the mean of p and p_ref (the trapezoidal rule). What the two differ by is the curvature of V and
//! no error; it has to be a small share, or e_V would say nothing.

use crate::common_oracles;

use common_oracles::{Asked, F32, F64, Sweep, Worst, dot, minus, scene};
use costate::backend::cpu::Evaluator;
use costate::low_level::model::Model;
use costate::low_level::program::Program;

/// Tolerance of the reference: three digits better than the best run.
const REFERENCE: f64 = 1e-12;
/// Largest share of e_V that may be curvature of V.
const CURVATURE: f64 = 0.1;
/// Leaving the region is noticed at the end of a step, and the reference's steps are shorter: of
/// trajectories that leave, one of the two may have a few samples more. This share must exist in
/// both.
const IN_BOTH: f64 = 0.95;

fn off_manifold(name: &str, model: &Model, asked: Asked) {
    let start = std::time::Instant::now();
    let sweep = Sweep::of(model, asked);
    let swept = start.elapsed().as_secs_f64();
    let reference = sweep.again(REFERENCE);
    let (n, v) = (sweep.n, 2 * sweep.n);
    let (mut first, mut second, mut along) = <(Worst, Worst, Worst)>::default();
    let mut relative = Worst::default();
    let (mut compared, mut stored) = (0, 0);
    for i in 0..sweep.count() {
        for k in 0..sweep.levels() {
            let (a, b) = (&sweep.raw.sample(i, k)[1..], &reference.sample(i, k)[1..]);
            stored += usize::from(!a[0].is_nan());
            if a[0].is_nan() || b[0].is_nan() {
                continue;
            }
            compared += 1;
            let moved = minus(&a[..n], &b[..n]);
            let change = a[v] - b[v];
            let mean: Vec<f64> = a[n..v]
                .iter()
                .zip(&b[n..v])
                .map(|(p, q)| 0.5 * (p + q))
                .collect();
            let error = (change - dot(&b[n..v], &moved)).abs();
            first.see(error / b[v].max(1.0));
            second.see((change - dot(&mean, &moved)).abs() / b[v].max(1.0));
            relative.see(error / b[v]);
            along.see(
                moved
                    .iter()
                    .zip(&sweep.plan.widths)
                    .map(|(m, w)| (m / w).abs())
                    .fold(0.0, f64::max),
            );
        }
    }
    assert!(
        compared as f64 >= IN_BOTH * stored as f64,
        "{compared} of {stored} samples compared"
    );
    assert!(
        (first.worst - second.worst).abs() <= CURVATURE * first.worst,
        "e_V is {} and {} to second order",
        first.worst,
        second.worst
    );

    let what = |q| {
        format!(
            "{name} {} rtol {:e}: {q}",
            asked.precision.name(),
            asked.rtol
        )
    };
    println!(
        "{} trajectories, {compared} samples; {swept:.2} s",
        sweep.count()
    );
    println!(
        "{}: {:.2e}; moved along by {:.2e} of the region",
        what("e_V relative to V itself"),
        relative.worst,
        along.worst
    );
    first.at_most(asked.promised(), &what("e_V"));
    let (relative, allowed) = hamiltonian(&sweep);
    println!("{}: worst {:.2e}", what("|H|/(|p'f| + L)"), relative.worst);
    allowed.at_most(1.0, &what("share of the |H| that tolerances allow"));
}

/// |H| at the samples: relative to the terms that cancel in it, and to what the steps' tolerances allow.
///
/// The exact flow keeps H, so H at a sample is the sum of what the steps before it have added. A
/// step's error in each component is within its tolerance (in the mean square over the components,
/// so within sqrt(dim) of it), and changes H by dH/dp = x' times that of p and dH/dx = -p' times
/// that of s. The bound takes the largest such change at the samples so far for all steps.
fn hamiltonian(sweep: &Sweep) -> (Worst, Worst) {
    let (plan, n, v) = (&sweep.plan, sweep.n, 2 * sweep.n);
    let mut exprs = plan.system.rate.clone();
    exprs.push(plan.system.observer.hamiltonian);
    let program = Program::lower(&plan.system.graph, &plan.system.inputs, &exprs);
    let evaluator = Evaluator::new(&program);
    let values = evaluator.eval(&sweep.raw.samples[1..], v + 2);
    let (mut relative, mut allowed) = <(Worst, Worst)>::default();
    for i in 0..sweep.count() {
        let steps = f64::from(sweep.raw.steps[i]) * (sweep.raw.dim as f64).sqrt();
        let mut step = 0.0f64;
        for k in 0..sweep.levels() {
            let y = &sweep.raw.sample(i, k)[1..];
            if y[0].is_nan() {
                break;
            }
            let value = &values[(i * sweep.levels() + k) * (v + 2)..][..v + 2];
            let tolerance = |c: usize| plan.run.rtol * y[c].abs() + plan.run.atol[c];
            let change: f64 = (0..n)
                .map(|c| value[c].abs() * tolerance(n + c) + value[n + c].abs() * tolerance(c))
                .sum();
            step = step.max(change);
            let h = value[v + 1].abs();
            relative.see(h / (dot(&value[..n], &y[n..v]).abs() + value[v]));
            allowed.see(h / (steps * step));
        }
    }
    (relative, allowed)
}

fn compressor() -> Model {
    let mut model = scene("moore_greitzer", &[]);
    // The first rounds put seeds over all of every front; more seeds are no harder to integrate.
    model
        .shoot_out
        .as_mut()
        .expect("the scene has a sweep")
        .max_seeds = 2000;
    model
}

#[test]
fn pendulum_f64() {
    off_manifold("pendulum", &scene("pendulum", &[]), F64);
}

#[test]
fn pendulum_f32() {
    off_manifold("pendulum", &scene("pendulum", &[]), F32);
}

#[test]
fn compressor_f64() {
    off_manifold("moore_greitzer", &compressor(), F64);
}

#[test]
fn compressor_f32() {
    off_manifold("moore_greitzer", &compressor(), F32);
}
