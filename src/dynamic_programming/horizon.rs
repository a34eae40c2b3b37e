//! The finite horizon: backward in time from the terminal cost, slice by slice.

use super::cpu::points;
use super::equations::Equations;
use super::level::{Level, STEEP, Stride, ranges, spread};
use super::stationary::{Solution, outside};
use super::{Clock, Domain, DpError, Runner};
use crate::backend::cpu::map::Evaluator;

/// Cells that a step of a quick node (see `QUICK`) crosses at most.
const CELLS: f64 = 4.0;
/// The share of nodes that are slower than a quick one.
const QUICK: f64 = 0.75;
/// Steps in all.
const STEPS: [usize; 2] = [16, 40];
/// Most numbers that all slices together hold.
const NUMBERS: usize = 40_000_000;
/// Rounds of improvement a slice, and for the first one.
const ROUNDS: usize = 2;
const FIRST_ROUNDS: usize = 12;
/// Values count as not reached above half of this many times what costs are there.
const CEILING: f64 = 100.0;

/// Values at `k T / steps` for k = 0.. steps, and the solution at 0.
pub(super) struct Slices {
    pub solution: Solution,
    pub values: Vec<Vec<f32>>,
    /// Time between two slices.
    pub step: f64,
}

pub(super) fn solve(
    domain: &Domain,
    equations: &Equations,
    time: f64,
    device: &Runner,
    clock: &Clock,
) -> Result<Slices, DpError> {
    let lattice = domain.lattice(&domain.counts);
    let (n, m) = (equations.states, equations.controls);
    let points = points(&lattice);
    let terminal = equations.terminal.as_ref().ok_or(DpError::NoNodes)?;
    let ends = Evaluator::new(terminal).eval(&with_zeros(&points, n), 2 * n);
    let ends: Vec<&[f64]> = ends.chunks(n + 1).collect();
    let inputs: Vec<f64> = (points.chunks(n).zip(&ends))
        .flat_map(|(s, end)| s.iter().chain(&end[1..]).copied())
        .collect();
    let mut controls = Evaluator::new(&equations.law).eval(&inputs, 2 * n);
    controls.iter_mut().filter(|u| !u.is_finite()).for_each(|u| *u = 0.0);
    let dead = outside(equations, &points, &controls);
    let (speed, running) = pace(equations, &lattice, &points, &controls, &dead);
    let largest = ends
        .iter()
        .map(|e| e[0].abs())
        .filter(|v| v.is_finite())
        .fold(0.0, f64::max);
    let ceiling = CEILING * (largest + time * running).max(f64::MIN_POSITIVE);
    let most = (NUMBERS / lattice.len()).clamp(STEPS[0], STEPS[1]);
    let steps = ((time * speed / CELLS).ceil() as usize).clamp(STEPS[0], most);
    let ranges = ranges(&controls, m);
    let level = Level {
        known: dead.clone(),
        stride: Stride::Fixed(time / steps as f64),
        ceiling,
        linear: None,
        spread: spread(&ranges),
        ranges: ranges.iter().map(|[lo, hi]| hi - lo).collect(),
        bent_below: STEEP * ceiling,
        lattice,
        points,
    };
    let first: Vec<f64> = (ends.iter().zip(&dead))
        .map(|(end, dead)| if *dead || !end[0].is_finite() { ceiling } else { end[0] })
        .collect();
    march(&level, equations, first, controls, steps, device, clock)
}

/// All slices from the last one on.
fn march(
    level: &Level,
    equations: &Equations,
    first: Vec<f64>,
    controls: Vec<f64>,
    steps: usize,
    device: &Runner,
    clock: &Clock,
) -> Result<Slices, DpError> {
    let Stride::Fixed(step) = level.stride else {
        return Err(DpError::NoNodes);
    };
    let mut iteration = device.iteration(level, equations)?;
    iteration.load(&first, &controls)?;
    let stored = |v: &[f64]| v.iter().map(|x| *x as f32).collect::<Vec<f32>>();
    let mut slices = vec![stored(&first)];
    let mut round = 0;
    for k in 0..steps {
        for _ in 0..if k == 0 { FIRST_ROUNDS } else { ROUNDS } {
            iteration.improve(&level.candidates(round))?;
            round += 1;
        }
        iteration.accept()?;
        slices.push(stored(&iteration.values()?));
        // A part of the horizon is no answer.
        if clock.is_over() && k + 1 < steps {
            return Err(DpError::OutOfTime);
        }
    }
    slices.reverse();
    Ok(Slices {
        solution: Solution {
            lattice: level.lattice.clone(),
            values: iteration.values()?,
            controls: iteration.controls()?,
            ceiling: level.ceiling,
            changes: Vec::new(),
        },
        values: slices,
        step,
    })
}

fn with_zeros(points: &[f64], n: usize) -> Vec<f64> {
    (points.chunks(n))
        .flat_map(|s| s.iter().copied().chain(std::iter::repeat_n(0.0, n)))
        .collect()
}

/// Cells a unit of time of a quick node, and the largest running cost.
fn pace(
    equations: &Equations,
    lattice: &super::lattice::Lattice,
    points: &[f64],
    controls: &[f64],
    dead: &[bool],
) -> (f64, f64) {
    let (n, m) = (equations.states, equations.controls);
    let inputs: Vec<f64> = (points.chunks(n).zip(controls.chunks(m)))
        .flat_map(|(s, u)| s.iter().chain(u).copied())
        .collect();
    let rows = Evaluator::new(&equations.motion).eval(&inputs, n + m);
    let alive = || {
        rows.chunks(equations.width())
            .zip(dead)
            .filter(|(_, dead)| !**dead)
            .map(|(row, _)| row)
    };
    let mut speeds: Vec<f64> = alive()
        .map(|row| (row.iter().zip(&lattice.axes)).fold(0.0f64, |most, (f, a)| most.max((f / a.step).abs())))
        .collect();
    speeds.sort_by(f64::total_cmp);
    let quick = speeds
        .get((QUICK * speeds.len() as f64) as usize)
        .copied()
        .unwrap_or(0.0);
    (quick, alive().map(|row| row[n].abs()).fold(0.0, f64::max))
}
