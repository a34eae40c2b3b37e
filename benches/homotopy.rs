//! How the time and memory of values at chosen states grow with the number of states solved for,
//! and with the number of state variables.
//!
//! `cargo bench --bench homotopy [-- targets|states|box]`; each line is one run: warm-up is not
//! needed, as a run compiles nothing but its kernels, whose time is included.

#[path = "../tests/common_problems/mod.rs"]
mod common_problems;

use common_problems::linear::chain;
use costate::backend::{BackendError, cpu::Cpu};
use costate::low_level::hamiltonian::Hamiltonian;
use costate::low_level::model::Model;
use costate::low_level::sweep::{Choices, Plan, sweep_keeping};
use costate::low_level::value::{self, Archive, Grid, Request};
use std::path::Path;
use std::time::Instant;

/// Peak resident memory of this process, MiB; 0 where the system does not tell.
fn peak() -> usize {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    line.and_then(|l| l.split_whitespace().next()?.parse::<usize>().ok())
        .unwrap_or(0)
        >> 10
}

/// Forgets the peak so far.
fn reset_peak() {
    // Where this is not allowed the peak is that of all runs so far.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

fn scene(name: &str) -> Model {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("scenarios")
        .join(name)
        .with_extension("toml");
    costate::low_level::scenario::load(&path, &[]).expect("a shipped scene")
}

/// A chain of masses with cubic springs, pushed at its ends.
fn chain_of(masses: usize) -> Model {
    let text = chain(masses, 0.3);
    costate::low_level::scenario::parse(&text, "chain.toml", &[]).expect("a scene")
}

fn run(name: &str, model: &Model, request: &Request) {
    let gridded: usize = request.grids.iter().map(Grid::len).sum();
    let seeds = value::guess_seeds(
        model.states.len(),
        gridded + request.points.len() / model.states.len(),
    );
    reset_peak();
    let start = Instant::now();
    let cpu = Cpu::new();
    let hamiltonian = Hamiltonian::derive(model).expect("equations");
    let choices = Choices {
        inner_levels: true,
        max_seeds: Some(seeds),
        unasked: true,
        ..Choices::default()
    };
    let plan = Plan::new(model, &hamiltonian, &cpu, choices).expect("a plan");
    let mut archive = Archive::new(&plan);
    let keep =
        &mut |seeds: &[f64], batch: &costate::backend::Trajectories| archive.keep(seeds, batch);
    sweep_keeping::<BackendError>(&plan, &cpu, &mut |_, _| {}, keep, None).expect("the CPU works");
    let mut solver = value::solver(&plan, &cpu).expect("kernels");
    let answers = value::solve(
        &plan,
        model,
        &mut solver,
        &archive,
        request,
        &mut |_, _, _| {},
    )
    .expect("the CPU works");
    let seconds = start.elapsed().as_secs_f64();
    let targets = answers.targets.len();
    println!(
        "{name:28} {targets:7} states, {:7} solved, {:7} solutions: {seconds:8.2} s, {:7.0} states/s, {:5.1} integrations each, peak {} MiB",
        answers.solved(),
        answers.entries.len(),
        targets as f64 / seconds,
        answers.evaluations as f64 / targets as f64,
        peak()
    );
}

fn spaced(first: f64, last: f64, count: usize) -> Vec<f64> {
    (0..count)
        .map(|k| first + (last - first) * k as f64 / (count - 1) as f64)
        .collect()
}

fn main() {
    let wanted: Vec<String> = std::env::args()
        .skip(1)
        .filter(|a| !a.starts_with("--"))
        .collect();
    let asked = |what: &str| wanted.is_empty() || wanted.iter().any(|w| w == what);
    if asked("box") {
        let model = scene("moore_greitzer");
        let grid = Grid::homotopy(model.homotopy.as_ref().expect("the box"));
        let request = Request {
            grids: vec![grid],
            limits: vec![f64::INFINITY],
            ..Request::default()
        };
        run("moore_greitzer, the box", &model, &request);
    }
    if asked("targets") {
        for side in [10, 32, 100, 316] {
            let model = scene("pendulum");
            let request = Request {
                grids: vec![Grid {
                    axes: vec![spaced(-3.0, 1.5, side), spaced(-6.0, 6.0, side)],
                }],
                limits: vec![f64::INFINITY],
                ..Request::default()
            };
            run("pendulum", &model, &request);
        }
    }
    if asked("states") {
        let three = scene("moore_greitzer_unconstrained");
        for (name, model) in [
            ("2 states", chain_of(1)),
            ("3 states (compressor)", three),
            ("4 states", chain_of(2)),
            ("6 states", chain_of(3)),
            ("8 states", chain_of(4)),
        ] {
            let points = 200;
            let states: Vec<f64> = (0..points)
                .flat_map(|k| {
                    let region = &model.region;
                    region.iter().enumerate().map(move |(i, [lo, hi])| {
                        let fraction = ((k as f64 + 0.5) * (i as f64 + 2.0).sqrt()).fract();
                        lo + (hi - lo) * (0.25 + 0.5 * fraction)
                    })
                })
                .collect();
            let request = Request {
                points: states,
                one_sheet: true,
                ..Request::default()
            };
            run(name, &model, &request);
        }
    }
}
