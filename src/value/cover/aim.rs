//! Trajectories aimed at a state: what a cell's trajectories cost at a state that lies between them
//! is a guess, a trajectory that passes through the state is not.

use super::cell::{Corners, OfSeeds};
use super::{Candidate, Cover, tangent};
use crate::backend::BackendError;
use crate::shooting::{End, Path};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Rounds in which a trajectory is corrected by how far it passed from the state.
const CORRECTIONS: usize = 8;
/// A trajectory that passes so near, relative to its cell's longest edge, is not corrected further.
const CLOSE: f64 = 1e-3;
/// A trajectory tells of a state that it passes so near, relative to the same.
const NEAR: f64 = 0.02;
/// Steps of arc length, from the one before its cell on, in which a trajectory is looked at closely;
/// points in each; and in each of those before.
const STEPS: usize = 3;
const POINTS: usize = 16;
const POINTS_BEFORE: usize = 4;
/// How far outside its cell, relative to it, a trajectory is aimed at most.
const OUTSIDE: f64 = 4.0;
/// Most that the aim is moved, in units of how far the state was missed.
const MOST_RELAXED: f64 = 8.0;

/// A trajectory that passes near a state, and what it says of it.
pub struct Aimed {
    /// `(s, p, V)`.
    seed: Vec<f64>,
    /// Level from which on it was looked at closely.
    from: usize,
    /// `(t, s, p, V)` where it passes.
    passes: Vec<f64>,
    /// How near, in widths of the region; and whether that is near enough to go by it.
    distance: f64,
    pub is_close: bool,
    /// V at the state, by V and p where it passes.
    pub value: f64,
}

impl Aimed {
    /// The adjoint where it passes.
    pub fn adjoint(&self) -> &[f64] {
        let n = self.passes.len() / 2 - 1;
        &self.passes[1 + n..=2 * n]
    }

    /// V at a state (a deviation) that it passes, by the mean of its adjoint and the one there.
    pub fn value_by(&self, goal: &[f64], adjoint: &[f64]) -> f64 {
        let way = |i: usize| goal[i] - self.passes[1 + i];
        let change = |i: usize| 0.5 * (self.adjoint()[i] + adjoint[i]) * way(i);
        self.passes[self.passes.len() - 1] + (0..goal.len()).map(change).sum::<f64>()
    }
}

/// A trajectory on its way to pass through a state.
struct Shot<'c> {
    candidate: &'c Candidate,
    /// Of its cell or of the part of it, and the longest edge between these, in widths of the region.
    corners: Corners,
    size: f64,
    /// Where it is aimed, in widths of the region.
    aim: Vec<f64>,
    weights: OfSeeds<f64>,
    /// By how far the trajectory before missed the state, in widths, and the share of it by which
    /// the aim was moved.
    missed: Option<(Vec<f64>, f64)>,
    best: Option<Aimed>,
    done: bool,
}

impl Shot<'_> {
    /// Moves the aim by a share of how far the last trajectory missed the state, which Aitken's
    /// delta-squared process takes from how far the one before did.
    fn relax(&mut self, missed: &[f64]) {
        let share = match &self.missed {
            None => 1.0,
            Some((before, share)) => {
                let change = before.iter().zip(missed).map(|(a, b)| b - a);
                let (along, square) =
                    (change.zip(before)).fold((0.0, 0.0), |(s, q), (c, a)| (s + a * c, q + c * c));
                (-share * along / square).clamp(-MOST_RELAXED, MOST_RELAXED)
            }
        };
        let share = if share.is_finite() { share } else { 1.0 };
        for (aim, missed) in self.aim.iter_mut().zip(missed) {
            *aim += share * missed;
        }
        self.missed = Some((missed.to_vec(), share));
    }
}

impl Cover<'_> {
    /// For each guess a trajectory of its cell that passes near its state, as near as can be; none
    /// where the cell does not show which.
    ///
    /// # Errors
    /// Device failures only.
    pub fn aim(&self, candidates: &[Candidate]) -> Result<Vec<Option<Aimed>>, BackendError> {
        let mut shots: Vec<Shot<'_>> = candidates.par_iter().map(|c| self.shot(c)).collect();
        for _ in 0..CORRECTIONS {
            // Those of one level are looked at at the same arc lengths.
            let mut of_level: BTreeMap<usize, Vec<&mut Shot<'_>>> = BTreeMap::new();
            for shot in shots.iter_mut().filter(|shot| !shot.done) {
                let level = shot.candidate.cell.level;
                of_level.entry(level).or_default().push(shot);
            }
            if of_level.is_empty() {
                break;
            }
            (of_level.into_par_iter()).try_for_each(|(level, shots)| self.shoot(level, shots))?;
        }
        Ok(shots.into_iter().map(|shot| shot.best).collect())
    }

    fn shot<'c>(&self, candidate: &'c Candidate) -> Shot<'c> {
        let widths = &self.fan.plan.widths;
        let of_cell = || candidate.cell.corners(&self.fan, self.stationary);
        let of_part = candidate.part.as_deref().cloned();
        let corners = of_part.unwrap_or_else(of_cell);
        let (seeds, n) = (candidate.cell.seeds.len(), widths.len());
        Shot {
            candidate,
            aim: (candidate.goal.iter().zip(widths))
                .map(|(x, w)| x / w)
                .collect(),
            weights: candidate.place.weights.clone(),
            missed: None,
            best: None,
            size: corners.longest(seeds, n).2,
            done: !corners.complete(),
            corners,
        }
    }

    /// One trajectory for each of these shots, whose cells begin at this level.
    fn shoot(&self, level: usize, shots: Vec<&mut Shot<'_>>) -> Result<(), BackendError> {
        let from = level.saturating_sub(usize::from(self.stationary));
        let levels = if self.stationary {
            evenly(
                self.fan.along_to(from),
                self.fan.along_to(from + STEPS),
                STEPS * POINTS,
            )
        } else {
            vec![self.fan.along_to(level)]
        };
        let flown: Vec<(&mut Shot<'_>, Vec<f64>)> = (shots.into_par_iter())
            .filter_map(|shot| {
                let seed = (self.fan).mean_seed(&shot.candidate.cell.seeds, &shot.weights);
                shot.done = seed.is_none();
                Some((shot, seed?))
            })
            .collect();
        let seeds: Vec<&[f64]> = flown.iter().map(|(_, seed)| seed.as_slice()).collect();
        let traces = self.fan.traces(&seeds, &levels)?;
        (flown.into_par_iter().zip(traces)).for_each(|((shot, seed), trace)| {
            if trace.is_empty() {
                shot.done = true;
            } else {
                self.correct(shot, seed, from, &trace);
            }
        });
        Ok(())
    }

    /// Keeps the nearest trajectory of a shot, and aims the next one.
    fn correct(&self, shot: &mut Shot<'_>, seed: Vec<f64>, from: usize, trace: &[f64]) {
        let widths = &self.fan.plan.widths;
        let (n, goal) = (widths.len(), &shot.candidate.goal);
        let passes = nearest(trace, goal, widths);
        let distance = off(&passes[1..], goal, widths);
        let missed: Vec<f64> = (0..n)
            .map(|i| (goal[i] - passes[1 + i]) / widths[i])
            .collect();
        shot.relax(&missed);
        if (shot.best.as_ref()).is_none_or(|best| distance < best.distance) {
            shot.best = Some(Aimed {
                seed,
                from,
                distance,
                is_close: distance <= NEAR * shot.size,
                value: tangent(&passes, n, |i| goal[i]),
                passes,
            });
        }
        if distance <= CLOSE * shot.size {
            shot.done = true;
            return;
        }
        let seeds = shot.candidate.cell.seeds.len();
        match shot.corners.locate(&shot.aim, seeds) {
            Some(place) if place.outside <= OUTSIDE => shot.weights = place.weights,
            _ => shot.done = true,
        }
    }

    /// The path of an aimed trajectory, from where it passes the state.
    ///
    /// # Errors
    /// Device failures only.
    pub fn path_of(&self, aimed: &Aimed, end: &End) -> Result<Path, BackendError> {
        let mut levels: Vec<f64> = Vec::new();
        let last = aimed.from + if self.stationary { STEPS } else { 0 };
        for level in 0..last {
            let step = [self.fan.along_to(level), self.fan.along_to(level + 1)];
            levels.extend(evenly(step[0], step[1], POINTS_BEFORE));
        }
        levels.dedup();
        let trace = self.fan.traces(&[&aimed.seed], &levels)?.remove(0);
        let first: Vec<f64> = std::iter::once(0.0)
            .chain(aimed.seed.iter().copied())
            .collect();
        let mut points: Vec<Vec<f64>> = std::iter::once(first.as_slice())
            .chain(trace.chunks_exact(aimed.passes.len()))
            .take_while(|point| point[0] < aimed.passes[0])
            .map(<[f64]>::to_vec)
            .collect();
        points.reverse();
        Ok(self.path_through(&aimed.passes, &points, 0.0, end))
    }
}

/// `count` numbers from one (not included) to another.
fn evenly(from: f64, to: f64, count: usize) -> Vec<f64> {
    (1..=count)
        .map(|k| from + (to - from) * k as f64 / count as f64)
        .collect()
}

/// Distance of two states in widths of the region.
fn off(a: &[f64], b: &[f64], widths: &[f64]) -> f64 {
    let part = |(i, w): (usize, &f64)| ((a[i] - b[i]) / w).powi(2);
    widths.iter().enumerate().map(part).sum::<f64>().sqrt()
}

/// Where a trace, points `(t, s, p, V)` one after the other, passes nearest to a state: on the
/// straight lines between its points, with V as p has it there.
fn nearest(trace: &[f64], goal: &[f64], widths: &[f64]) -> Vec<f64> {
    let n = goal.len();
    let points: Vec<&[f64]> = trace.chunks_exact(2 + 2 * n).collect();
    let mut best = points[0].to_vec();
    let mut least = off(&best[1..], goal, widths);
    for pair in points.windows(2) {
        let along = |i: usize| (pair[1][1 + i] - pair[0][1 + i]) / widths[i];
        let way = |i: usize| (goal[i] - pair[0][1 + i]) / widths[i];
        let length: f64 = (0..n).map(|i| along(i).powi(2)).sum();
        let share = (0..n).map(|i| along(i) * way(i)).sum::<f64>() / length;
        if !share.is_finite() {
            continue;
        }
        let share = share.clamp(0.0, 1.0);
        let mut point: Vec<f64> = (pair[0].iter().zip(pair[1]))
            .map(|(a, b)| a + share * (b - a))
            .collect();
        let distance = off(&point[1..], goal, widths);
        if distance < least {
            // From the nearer end, by the mean of the adjoints.
            let end = pair[usize::from(share > 0.5)];
            point[1 + 2 * n] = end[1 + 2 * n]
                + (0..n)
                    .map(|i| {
                        0.5 * (end[1 + n + i] + point[1 + n + i]) * (point[1 + i] - end[1 + i])
                    })
                    .sum::<f64>();
            (best, least) = (point, distance);
        }
    }
    best
}
