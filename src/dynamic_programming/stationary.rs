//! The infinite horizon: values around the equilibrium are given, all others follow by policy
//! iteration, from a coarse lattice to the one asked for.

use super::cpu::points;
use super::equations::Equations;
use super::lattice::{Lattice, MOST_STATES, by_states, interpolate};
use super::level::{Level, STEEP, Stride, ranges, spread};
use super::{Clock, Domain, DpError, Runner};
use crate::backend::cpu::Evaluator;
use crate::local::LocalSolution;

/// Cells that a step crosses, by the number of states: the coarser a lattice, the more errors of
/// interpolation weigh against those of a constant control.
const CELLS: [f64; MOST_STATES] = [1.5, 1.5, 2.0, 2.5];
/// Share of the fastest mode's time constant that a step lasts at most: its control is constant.
const LONGEST: f64 = 0.5;
/// Error of the local solution relative to V up to which nodes take their value from it.
const LOCAL_ERROR: f64 = 0.005;
/// Values count as not reached above half of this many times the largest quadratic V of a node.
const CEILING: f64 = 100.0;
/// Nodes of an axis on the coarsest lattice at least.
const COARSEST: usize = 11;
/// Evaluations of a policy between two improvements, by the number of states.
const EVALUATIONS: [usize; MOST_STATES] = [20, 20, 12, 10];
/// Relative change of a round below which a lattice is done: the finest one, and those before.
const DONE: f64 = 1e-4;
const DONE_COARSE: f64 = 2e-3;
/// The share of the values whose changes are looked at: a few, beside what is not reached, never
/// settle.
const NEARLY_ALL: f64 = 0.999;
/// Share of the median below which values count as zero.
const SMALL: f64 = 0.01;
/// Rounds on a lattice at most; the coarsest begins from nothing.
const ROUNDS: usize = 60;
const ROUNDS_COARSEST: usize = 100;
/// Rounds on a lattice at least.
const LEAST_ROUNDS: usize = 6;

/// What an iteration came to.
#[derive(Clone, Debug)]
pub(super) struct Solution {
    pub lattice: Lattice,
    pub values: Vec<f64>,
    pub controls: Vec<f64>,
    pub ceiling: f64,
    /// What nearly all relative changes of each round stay below.
    pub changes: Vec<f64>,
}

/// V up to which the local solution's values are taken.
pub(super) fn local_level(local: &LocalSolution) -> f64 {
    let mut level = local.value_within(f64::INFINITY, f64::INFINITY);
    while local.error_where(level) > LOCAL_ERROR * level && level > f64::MIN_POSITIVE {
        level *= 0.9;
    }
    level
}

pub(super) fn solve(
    domain: &Domain,
    equations: &Equations,
    local: &LocalSolution,
    device: &Runner,
    clock: &Clock,
) -> Result<Solution, DpError> {
    let mut solution: Option<Solution> = None;
    for (k, counts) in ladder(&domain.counts).into_iter().enumerate() {
        let lattice = domain.lattice(&counts);
        let finest = counts == domain.counts;
        let (mut level, mut values) = level(lattice, equations, local);
        let mut controls = level.linear.clone().unwrap_or_default();
        let mut changes = Vec::new();
        if let Some(coarse) = &solution {
            prolong(
                coarse,
                equations.controls,
                &level,
                &mut values,
                &mut controls,
            );
            changes.clone_from(&coarse.changes);
        }
        // From nothing first without bending, which then has something to go by.
        let phases: &[bool] = if k == 0 { &[false, true] } else { &[true] };
        for &bent in phases {
            level.bent_below = if bent {
                STEEP * level.ceiling
            } else {
                f64::NEG_INFINITY
            };
            let limit = if k == 0 { ROUNDS_COARSEST } else { ROUNDS };
            let aim = if finest { DONE } else { DONE_COARSE };
            let mut iteration = device.iteration(&level, equations)?;
            iteration.load(&values, &controls)?;
            for round in 0..limit {
                iteration.improve(&level.candidates(round))?;
                iteration.evaluate(EVALUATIONS[equations.states - 1])?;
                let next = iteration.values()?;
                let change = usual_change(&values, &next, level.ceiling);
                values = next;
                changes.push(change);
                if (change < aim && round >= LEAST_ROUNDS) || clock.is_over() {
                    break;
                }
            }
            controls = iteration.controls()?;
            solution = Some(Solution {
                lattice: level.lattice.clone(),
                values: values.clone(),
                controls: controls.clone(),
                ceiling: level.ceiling,
                changes: changes.clone(),
            });
        }
        if clock.is_over() {
            break;
        }
    }
    solution.ok_or(DpError::NoNodes)
}

/// Counts of the lattices, from coarse to the one asked for: intervals are halved.
fn ladder(counts: &[usize]) -> Vec<Vec<usize>> {
    let mut list = vec![counts.to_vec()];
    loop {
        let next: Vec<usize> = list[0]
            .iter()
            .map(|c| (c / 2 + 1).max(COARSEST.min(*c)))
            .collect();
        if next == list[0] || next.iter().all(|c| *c <= COARSEST) {
            return list;
        }
        list.insert(0, next);
    }
}

/// A lattice with what is known on it, and its values at the beginning.
fn level(lattice: Lattice, equations: &Equations, local: &LocalSolution) -> (Level, Vec<f64>) {
    let (n, m) = (equations.states, equations.controls);
    let points = points(&lattice);
    let near = local_level(local);
    let quadratic: Vec<f64> = points
        .chunks(n)
        .map(|s| local.quadratic(&lattice.wrapped(s)))
        .collect();
    let ceiling = CEILING * quadratic.iter().copied().fold(0.0, f64::max);
    let linear = linear_controls(&lattice, equations, local, &points);
    let ranges = ranges(&linear, m);
    let fastest = local
        .riccati
        .eigenvalues
        .iter()
        .map(|e| e.norm())
        .fold(0.0, f64::max);
    let dead = outside(equations, &points, &linear);
    let values: Vec<f64> = (points.chunks(n).zip(&quadratic).zip(&dead))
        .map(|((s, q), dead)| {
            let known = *q <= near || *q == 0.0;
            if *dead || !known {
                ceiling
            } else {
                local.expansion(&lattice.wrapped(s)).0
            }
        })
        .collect();
    let known = dead
        .iter()
        .zip(&values)
        .map(|(dead, v)| *dead || *v < ceiling)
        .collect();
    let level = Level {
        lattice,
        points,
        known,
        stride: Stride::Cells {
            cells: CELLS[n - 1],
            longest: LONGEST / fastest,
        },
        ceiling,
        linear: Some(linear),
        spread: spread(&ranges),
        ranges: ranges.iter().map(|[lo, hi]| hi - lo).collect(),
        bent_below: STEEP * ceiling,
    };
    (level, values)
}

/// `u*(s, P s)` at all nodes.
fn linear_controls(
    lattice: &Lattice,
    equations: &Equations,
    local: &LocalSolution,
    points: &[f64],
) -> Vec<f64> {
    let n = equations.states;
    let inputs: Vec<f64> = (points.chunks(n))
        .flat_map(|s| {
            let p = &local.riccati.p * nalgebra::DVector::from_vec(lattice.wrapped(s));
            s.iter()
                .copied()
                .chain(p.iter().copied().collect::<Vec<f64>>())
        })
        .collect();
    let mut controls = Evaluator::new(&equations.law).eval(&inputs, 2 * n);
    // Outside the model's domain there is none; such nodes are dead.
    controls
        .iter_mut()
        .filter(|u| !u.is_finite())
        .for_each(|u| *u = 0.0);
    controls
}

/// Which nodes lie outside the guards, or where the equations have no value.
pub(super) fn outside(equations: &Equations, points: &[f64], controls: &[f64]) -> Vec<bool> {
    let (n, m) = (equations.states, equations.controls);
    let inputs: Vec<f64> = (points.chunks(n).zip(controls.chunks(m)))
        .flat_map(|(s, u)| s.iter().chain(u).copied())
        .collect();
    let rows = Evaluator::new(&equations.motion).eval(&inputs, n + m);
    rows.chunks(equations.width())
        .map(|row| !equations.is_valid(row))
        .collect()
}

/// Values and controls of a coarser lattice at the nodes that are not known.
fn prolong(coarse: &Solution, m: usize, level: &Level, values: &mut [f64], controls: &mut [f64]) {
    by_states!(
        level.lattice.states(),
        prolong_in(coarse, m, level, values, controls)
    );
}

fn prolong_in<const N: usize>(
    coarse: &Solution,
    m: usize,
    level: &Level,
    values: &mut [f64],
    controls: &mut [f64],
) {
    let mut component = vec![0.0; coarse.values.len()];
    let cells: Vec<_> = (level.points.chunks(N))
        .map(|s| coarse.lattice.locate::<N>(s))
        .collect();
    for (k, cell) in cells.iter().enumerate().filter(|(k, _)| !level.known[*k]) {
        if let Some(cell) = cell {
            values[k] =
                interpolate(&coarse.values, cell, STEEP * coarse.ceiling).min(level.ceiling);
        }
    }
    for c in 0..m {
        component
            .iter_mut()
            .zip(coarse.controls.iter().skip(c).step_by(m))
            .for_each(|(to, u)| *to = *u);
        for (k, cell) in cells.iter().enumerate() {
            if let Some(cell) = cell {
                controls[k * m + c] = interpolate(&component, cell, f64::NEG_INFINITY);
            }
        }
    }
}

/// What the relative changes of nearly all values that are reached stay below; relative to the
/// value, or to a hundredth of the median where that is more.
pub(super) fn usual_change(before: &[f64], after: &[f64], ceiling: f64) -> f64 {
    let pairs = before
        .iter()
        .zip(after)
        .filter(|(_, v)| **v < 0.5 * ceiling);
    let pairs: Vec<(f64, f64)> = pairs.map(|(v, w)| (*v, *w)).collect();
    if pairs.is_empty() {
        return f64::INFINITY;
    }
    let at = |share: f64, mut list: Vec<f64>| {
        let place = ((list.len() - 1) as f64 * share) as usize;
        *list.select_nth_unstable_by(place, f64::total_cmp).1
    };
    let floor = SMALL * at(0.5, pairs.iter().map(|(_, w)| w.abs()).collect());
    at(
        NEARLY_ALL,
        pairs
            .iter()
            .map(|(v, w)| (v - w).abs() / (w.abs() + floor))
            .collect(),
    )
}
