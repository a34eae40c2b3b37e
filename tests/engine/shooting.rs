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

/// A solver for the problems, and a job for each.
fn begin(problems: &Problems, backend: &dyn Backend, precision: Precision) -> (Solver, Vec<Job>) {
    let plan = &problems.plan;
    let (rtol, tolerance) = tolerances(precision);
    let value = plan.shoot_out.value_max.unwrap_or(1.0);
    let scheme = Scheme {
        // One column of variations at a time: a shader compiler's time grows with their number.
        equations: Equations::new(
            &plan.system,
            &plan.widths,
            value,
            (2 * plan.widths.len(), 12_000),
        ),
        end: End::new(&plan.system, plan.local.as_ref()),
        tolerance,
        duration: problems.duration,
    };
    let solver = Solver::new(backend, precision, scheme, rtol).unwrap();
    let jobs = (problems.guesses.iter())
        .map(|(path, target)| Job::new(path.clone(), Goal::State(target.clone())))
        .collect();
    (solver, jobs)
}

fn solve(problems: &Problems, backend: &dyn Backend, precision: Precision) -> Vec<Job> {
    let (mut solver, mut jobs) = begin(problems, backend, precision);
    let clock = std::time::Instant::now();
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

/// Whole iterations on the device lead to the reference's solutions, wherever they lead.
fn iterate(scene: &str, count: usize) {
    let problems = problems(scene, count);
    let reference = solve(&problems, &Cpu::new(), Precision::F64);
    let gpu = any_gpu();
    for precision in [Precision::F64, Precision::F32] {
        let (mut solver, mut jobs) = begin(&problems, &gpu, precision);
        // The first time pipelines are made.
        solver.refine(&mut jobs[..1].to_vec()).unwrap();
        let clock = std::time::Instant::now();
        let told = solver.refine(&mut jobs).unwrap();
        let seconds = clock.elapsed().as_secs_f64();
        // The same led by the host, step by step.
        let (mut led, mut steps) = begin(&problems, &gpu, precision);
        led.solve(&mut steps[..1]).unwrap();
        let clock = std::time::Instant::now();
        led.solve(&mut steps[1..]).unwrap();
        let by_steps = clock.elapsed().as_secs_f64();
        let allowed = 100.0 * tolerances(precision).1;
        let (mut solved, mut worst, mut iterations) = (0, 0.0f64, 0);
        for ((a, b), (is_solved, took)) in reference.iter().zip(&jobs).zip(&told) {
            assert!(*took <= 20 && b.outcome.is_none());
            if a.solved().is_none() || !is_solved {
                continue;
            }
            solved += 1;
            iterations += took;
            let size = (a.path.adjoint().iter()).fold(0.0f64, |most, p| most.max(p.abs()));
            for (p, q) in a.path.adjoint().iter().zip(b.path.adjoint()) {
                worst = worst.max((p - q).abs() / size);
            }
        }
        println!(
            "{scene} {precision:?}: {solved} of {count} in {iterations} iterations, {seconds:.2} s, p {worst:.1e}; led by the host {} in {} rounds, {by_steps:.2} s",
            steps.iter().filter(|job| job.solved().is_some()).count(),
            led.work.rounds,
        );
        assert!(
            solved * 10 >= count * 8,
            "{scene} {precision:?}: {solved} of {count}"
        );
        assert!(worst <= allowed, "{scene} {precision:?}: p {worst:e}");
        // The solutions are the guesses' own: a step of the host's changes them by the tolerance.
        let mut again: Vec<Job> = (jobs.iter().zip(&told))
            .filter(|(_, (is_solved, _))| *is_solved)
            .map(|(job, _)| Job::new(job.path.clone(), job.goal.clone()))
            .collect();
        let (mut host, _) = begin(&problems, &Cpu::new(), Precision::F64);
        host.solve(&mut again).unwrap();
        assert!(again.iter().all(|job| job.solved().is_some()));
    }
}

#[test]
fn the_device_iterates_by_itself() {
    iterate("pendulum", 400);
    iterate("moore_greitzer", 100);
}

/// What cannot be solved without damping, or is too long for a dispatch, is given back as it came.
#[test]
fn what_the_device_cannot_solve_stays() {
    let problems = problems("pendulum", 4);
    let (mut solver, mut jobs) = begin(&problems, &any_gpu(), Precision::F64);
    // Far beyond the region; not a number; of more nodes than an invocation takes.
    jobs[0].goal = Goal::State(vec![1e3, -1e3]);
    jobs[1].path.nodes[0] = f64::NAN;
    let last = jobs[2].path.last().to_vec();
    for _ in 0..9000 {
        jobs[2].path.push(0.01, &last);
    }
    let before: Vec<Path> = jobs.iter().map(|job| job.path.clone()).collect();
    let told = solver.refine(&mut jobs).unwrap();
    for k in 0..3 {
        assert!(!told[k].0, "{k}");
        let same = |(a, b): (&f64, &f64)| a.to_bits() == b.to_bits();
        assert!((jobs[k].path.nodes.iter().zip(&before[k].nodes)).all(same));
    }
    assert!(told[3].0);
}
