//! The same boundary value problems solved on both backends.

use crate::common;

use common::any_gpu;
use costate::backend::{Backend, BackendError, cpu::Cpu};
use costate::low_level::hamiltonian::Hamiltonian;
use costate::low_level::model::Precision;
use costate::low_level::shooting::{End, Equations, Goal, Job, Path, Scheme, Solver};
use costate::low_level::sweep::{Choices, Plan, sweep_keeping};
use costate::low_level::value::{Archive, Index};

/// First guesses from a sweep, with the states they are to reach.
struct Problems {
    plan: Plan,
    duration: f64,
    guesses: Vec<(Path, Vec<f64>)>,
}

/// Targets are the states of archived points moved by this share of the region's width.
const SHIFT: f64 = 0.01;

fn problems(scene: &str, count: usize) -> Problems {
    let path = format!("{}/scenarios/{scene}.toml", crate::ROOT);
    let model = costate::low_level::scenario::load(path.as_ref(), &[]).unwrap();
    let hamiltonian = Hamiltonian::derive(&model).unwrap();
    let cpu = Cpu::new();
    let choices = Choices {
        inner_levels: true,
        max_seeds: Some(400),
        ..Choices::default()
    };
    let plan = Plan::new(&model, &hamiltonian, &cpu, choices).unwrap();
    let mut archive = Archive::new(&plan);
    let keep = &mut |seeds: &[f64], batch: &_| archive.keep(seeds, batch);
    sweep_keeping::<BackendError>(&plan, &cpu, &mut |_, _| {}, keep, None).unwrap();
    let index = Index::new(&archive, &plan.widths, &plan.region, plan.shoot_out.spacing);
    let end = End::new(&plan.system, plan.local.as_ref());
    let duration = plan.segment_duration();
    let value = 0.01 * plan.shoot_out.value_max.unwrap_or(1.0);
    let guesses = (0..count)
        .map(|i| {
            // A sequence without repetition over the middle of the region.
            let at = |c: usize| 0.6 * (((i + 1) as f64 * (2.0 + c as f64).sqrt()).fract() - 0.5);
            let point: Vec<f64> = (plan.region.iter().enumerate())
                .map(|(c, [lo, hi])| 0.5 * (lo + hi) + at(c) * (hi - lo))
                .collect();
            let scaled: Vec<f64> = point.iter().zip(&plan.widths).map(|(s, w)| s / w).collect();
            let near = index.near(&scaled, 0.0, 1)[0].0;
            let path = archive.path(near, &end, value, duration);
            let target = path
                .start()
                .iter()
                .zip(&plan.widths)
                .map(|(s, w)| s + SHIFT * w);
            let target = target.collect();
            (path, target)
        })
        .collect();
    Problems {
        plan,
        duration,
        guesses,
    }
}

/// Relative accuracy of the segments and of Newton's method.
fn tolerances(precision: Precision) -> (f64, f64) {
    match precision {
        Precision::F32 => (1e-6, 1e-4),
        Precision::F64 => (1e-10, 1e-9),
    }
}

fn solve(problems: &Problems, backend: &dyn Backend, precision: Precision) -> Vec<Job> {
    let plan = &problems.plan;
    let (rtol, tolerance) = tolerances(precision);
    let value = plan.shoot_out.value_max.unwrap_or(1.0);
    let scheme = Scheme {
        // One column of variations at a time: a shader compiler's time grows with their number.
        equations: Equations::new(&plan.system, &plan.widths, value, 2 * plan.widths.len()),
        end: End::new(&plan.system, plan.local.as_ref()),
        tolerance,
        duration: problems.duration,
    };
    let clock = std::time::Instant::now();
    let mut solver = Solver::new(backend, precision, scheme, rtol).unwrap();
    let mut jobs: Vec<Job> = (problems.guesses.iter())
        .map(|(path, target)| Job::new(path.clone(), Goal::State(target.clone())))
        .collect();
    solver.solve(&mut jobs).unwrap();
    println!(
        "{} {precision:?}: {:.2} s, {:?}",
        backend.name(),
        clock.elapsed().as_secs_f64(),
        solver.work
    );
    jobs
}

fn compare(scene: &str, count: usize) {
    let problems = problems(scene, count);
    let gpu = any_gpu();
    let reference = solve(&problems, &Cpu::new(), Precision::F64);
    let solved = reference
        .iter()
        .filter(|job| job.solved().is_some())
        .count();
    assert!(
        solved * 10 >= count * 9,
        "{scene}: {solved} of {count} solved"
    );
    for precision in [Precision::F64, Precision::F32] {
        let jobs = solve(&problems, &gpu, precision);
        // V is of second order in the path's error, p of first; both sides have one, and the path's
        // is that of its segments, amplified by what a segment may grow.
        const AMPLIFICATION: f64 = 100.0;
        let (rtol, tolerance) = tolerances(precision);
        let allowed = (AMPLIFICATION * rtol).max(tolerance);
        let (mut worst_value, mut worst_adjoint) = (0.0f64, 0.0f64);
        for (i, (a, b)) in reference.iter().zip(&jobs).enumerate() {
            let (Some(a_solved), b_solved) = (a.solved(), b.solved()) else {
                continue;
            };
            let b_solved = b_solved
                .unwrap_or_else(|| panic!("{scene} {precision:?} job {i}: {:?}", b.failure()));
            let size = a
                .path
                .adjoint()
                .iter()
                .fold(0.0f64, |most, p| most.max(p.abs()));
            worst_value = worst_value.max((a_solved.value - b_solved.value).abs() / a_solved.value);
            for (p, q) in a.path.adjoint().iter().zip(b.path.adjoint()) {
                worst_adjoint = worst_adjoint.max((p - q).abs() / size);
            }
        }
        println!(
            "{scene} {precision:?}: V {worst_value:.1e}, p {worst_adjoint:.1e}, allowed {allowed:.1e}"
        );
        assert!(
            worst_value <= allowed,
            "{scene} {precision:?}: V {worst_value:e}"
        );
        assert!(
            worst_adjoint <= allowed,
            "{scene} {precision:?}: p {worst_adjoint:e}"
        );
    }
}

#[test]
fn pendulum_is_the_same_on_both_backends() {
    compare("pendulum", 40);
}

#[test]
fn compressor_is_the_same_on_both_backends() {
    compare("moore_greitzer", 20);
}
