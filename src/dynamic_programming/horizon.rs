//! The finite horizon: backward in time from the terminal cost, slice by slice.

use super::cpu::points;
use super::equations::Equations;
use super::lattice::Lattice;
use super::level::{Level, STEEP, Stride, last, middle, ranges, spread};
use super::stationary::{Solution, outside};
use super::{Clock, Domain, DpError, Runner};
use crate::backend::cpu::Evaluator;
use crate::numeric::quantile::nearest_rank;

/// Cells that a step of a quick node (see `QUICK`) crosses at most.
const CELLS: f64 = 4.0;
/// The share of nodes that are slower than a quick one.
const QUICK: f64 = 0.75;
/// Steps in all.
const STEPS: [usize; 2] = [16, 40];
/// More of them, up to a number, where steps are worse than this: cells by which Kutta's
/// third-order method and the second-order one within it differ, at all but a share of the nodes.
const MOST_STEPS: usize = 320;
const DIFFER: f64 = 0.25;
const NEARLY_ALL: f64 = 0.9;
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
    controls
        .iter_mut()
        .filter(|u| !u.is_finite())
        .for_each(|u| *u = 0.0);
    let dead = outside(equations, &points, &controls);
    let (speed, running) = pace(equations, &lattice, &points, &controls, &dead);
    let largest = ends
        .iter()
        .map(|e| e[0].abs())
        .filter(|v| v.is_finite())
        .fold(0.0, f64::max);
    let ceiling = CEILING * (largest + time * running).max(f64::MIN_POSITIVE);
    let most = (NUMBERS / lattice.len()).clamp(STEPS[0], MOST_STEPS);
    let mut steps = ((time * speed / CELLS).ceil() as usize).clamp(STEPS[0], most.min(STEPS[1]));
    let flown = with_controls(&points, &controls, n, m);
    while steps < most
        && difference(equations, &lattice, &flown, &dead, time / steps as f64) > DIFFER
    {
        steps = (2 * steps).min(most);
    }
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
        .map(|(end, dead)| {
            if *dead || !end[0].is_finite() {
                ceiling
            } else {
                end[0]
            }
        })
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

fn with_controls(points: &[f64], controls: &[f64], n: usize, m: usize) -> Vec<f64> {
    (points.chunks(n).zip(controls.chunks(m)))
        .flat_map(|(s, u)| s.iter().chain(u).copied())
        .collect()
}

fn with_zeros(points: &[f64], n: usize) -> Vec<f64> {
    (points.chunks(n))
        .flat_map(|s| s.iter().copied().chain(std::iter::repeat_n(0.0, n)))
        .collect()
}

/// Cells by which the end of a step of Kutta's third-order method differs from that of the
/// second-order one within it, at all but a few nodes.
fn difference(
    equations: &Equations,
    lattice: &Lattice,
    inputs: &[f64],
    dead: &[bool],
    step: f64,
) -> f64 {
    let (n, m, width) = (equations.states, equations.controls, equations.width());
    let motion = Evaluator::new(&equations.motion);
    let first = motion.eval(inputs, n + m);
    let moved = |to: &dyn Fn(usize, &mut [f64])| {
        let mut points = inputs.to_vec();
        points
            .chunks_mut(n + m)
            .enumerate()
            .for_each(|(k, z)| to(k, &mut z[..n]));
        motion.eval(&points, n + m)
    };
    let at = |k: usize| &inputs[k * (n + m)..][..n];
    let second = moved(&|k, to| middle(at(k), &first[k * width..], step, to));
    let third = moved(&|k, to| last(at(k), &first[k * width..], &second[k * width..], step, to));
    let of = |k: usize| {
        let axes = lattice.axes.iter().enumerate();
        axes.fold(0.0f64, |most, (i, axis)| {
            let j = k * width + i;
            most.max((step * (first[j] - 2.0 * second[j] + third[j]) / (6.0 * axis.step)).abs())
        })
    };
    let alive = (0..dead.len()).filter(|k| !dead[*k]);
    let mut all: Vec<f64> = alive.map(of).filter(|d| d.is_finite()).collect();
    all.sort_by(f64::total_cmp);
    nearest_rank(&all, NEARLY_ALL)
}

/// Cells a unit of time of a quick node, and the largest running cost.
fn pace(
    equations: &Equations,
    lattice: &Lattice,
    points: &[f64],
    controls: &[f64],
    dead: &[bool],
) -> (f64, f64) {
    let (n, m) = (equations.states, equations.controls);
    let inputs = with_controls(points, controls, n, m);
    let rows = Evaluator::new(&equations.motion).eval(&inputs, n + m);
    let alive = || {
        rows.chunks(equations.width())
            .zip(dead)
            .filter(|(_, dead)| !**dead)
            .map(|(row, _)| row)
    };
    let mut speeds: Vec<f64> = alive()
        .map(|row| {
            (row.iter().zip(&lattice.axes))
                .fold(0.0f64, |most, (f, a)| most.max((f / a.step).abs()))
        })
        .collect();
    speeds.sort_by(f64::total_cmp);
    let quick = speeds
        .get((QUICK * speeds.len() as f64) as usize)
        .copied()
        .unwrap_or(0.0);
    (quick, alive().map(|row| row[n].abs()).fold(0.0, f64::max))
}
