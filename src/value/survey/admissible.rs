//! Whether trajectories are admissible: inside the guards, and in a game without a fold along them.

use super::{PointStatus, Survey};
use crate::backend::BackendError;
use crate::shooting::{Path, Solver};
use crate::sweep::guard_holds as holds;
use crate::value::clearance::{PARTS, samples};
use rayon::prelude::*;
use std::sync::PoisonError;

/// Where a margin is not convex it may be so many times lower than tangents tell.
const DEEPER: f64 = 2.0;

impl Survey<'_> {
    /// Whether all nodes are inside the guards, but for rounding.
    pub(in crate::low_level::value) fn inside(&self, nodes: &[f64]) -> bool {
        let Some((guards, _)) = &self.guards else {
            return true;
        };
        self.hold(nodes, &guards.margins(nodes))
    }

    /// Whether guards with these margins hold at nodes, but for rounding.
    fn hold(&self, nodes: &[f64], margins: &[f64]) -> bool {
        let Some((guards, strict)) = &self.guards else {
            return true;
        };
        const ROUNDING: f64 = 1e-9;
        let (n, width) = (self.targets.states, 2 * self.targets.states);
        nodes
            .chunks(width)
            .zip(margins.chunks(strict.len()))
            .all(|(node, values)| {
                values.iter().enumerate().all(|(g, v)| {
                    if holds(*v, strict[g]) {
                        return true;
                    }
                    // On the boundary rounding decides: a state a little to either side will do.
                    (0..2 * n).any(|q| {
                        let mut moved = node.to_vec();
                        let step = ROUNDING * self.scales[q / 2];
                        moved[q / 2] += if q % 2 == 0 { step } else { -step };
                        holds(guards.margins(&moved)[g], strict[g])
                    })
                })
            })
    }

    /// What is wrong with trajectories, if anything: that they leave a guard, or in a game that
    /// they have a fold.
    pub(in crate::low_level::value) fn wrong(
        &mut self,
        solver: &mut Solver,
        paths: &[&Path],
    ) -> Result<Vec<Option<PointStatus>>, BackendError> {
        let guarded = self.valid(solver, paths)?.into_iter();
        let mut wrong: Vec<_> = guarded
            .map(|v| (!v).then_some(PointStatus::LeavesGuard))
            .collect();
        if let Some(conjugate) = &mut self.conjugate {
            let conjugate = conjugate.get_mut().unwrap_or_else(PoisonError::into_inner);
            for (wrong, regular) in wrong.iter_mut().zip(conjugate.absent(paths)?) {
                *wrong = wrong.or((!regular).then_some(PointStatus::Fold));
            }
        }
        Ok(wrong)
    }

    /// Whether trajectories stay inside the guards, at their nodes and between them.
    pub(in crate::low_level::value) fn valid(
        &self,
        solver: &mut Solver,
        paths: &[&Path],
    ) -> Result<Vec<bool>, BackendError> {
        let Some((guards, _)) = &self.guards else {
            return Ok(vec![true; paths.len()]);
        };
        let between = solver.between_nodes(paths, PARTS)?;
        // What is thin lies between the samples: flights to where a guard's margin seems to be
        // least, if that is below 0.
        let looked_at: Vec<(bool, Vec<Path>)> = (paths.par_iter().zip(between))
            .map(|(path, between)| {
                let (times, nodes) = samples(path, &between);
                let margins = guards.margins(&nodes);
                let holds = self.hold(&nodes, &margins);
                let doubts = holds.then(|| self.doubts(&times, &nodes, &margins));
                (holds, doubts.unwrap_or_default())
            })
            .collect();
        let mut valid = Vec::with_capacity(paths.len());
        let mut doubts = Vec::new();
        for (k, (holds, parts)) in looked_at.into_iter().enumerate() {
            valid.push(holds);
            doubts.extend(parts.into_iter().map(|part| (k, part)));
        }
        if doubts.is_empty() {
            return Ok(valid);
        }
        let parts: Vec<&Path> = doubts.iter().map(|(_, part)| part).collect();
        for ((k, _), flown) in doubts.iter().zip(solver.ends_of(&parts, true)?) {
            valid[*k] &= flown.is_none_or(|(end, _)| self.inside(&end));
        }
        Ok(valid)
    }

    /// From samples of a trajectory before them, the ways to where a guard's margin is least
    /// between samples, if it is below 0 there: by cubics through the samples.
    fn doubts(&self, times: &[f64], nodes: &[f64], margins: &[f64]) -> Vec<Path> {
        let Some((guards, strict)) = &self.guards else {
            return Vec::new();
        };
        let width = 2 * self.targets.states;
        let parts = times.len() - 1;
        if parts == 0 {
            return Vec::new();
        }
        let length = |j: usize| times[j + 1] - times[j];
        let each = strict.len();
        let at = |g: usize, j: usize| margins[j * each + g];
        // Between three places a smooth margin falls by less than it rises to the highest of them;
        // from the first of a trajectory it falls, by a parabola through the next two, if it bends
        // by more than it rises.
        let may_fall = |g: usize, j: usize| {
            let inward = match j {
                0 => Some([1, 2]),
                j if j == parts => Some([parts - 1, parts - 2]),
                _ => None,
            };
            let here = at(g, j);
            match inward {
                Some([next, after]) => {
                    let rise = at(g, next) - here;
                    let bend = 0.5 * (at(g, after) - 2.0 * at(g, next) + here);
                    rise >= 0.0 && bend > rise && here <= bend
                }
                None => {
                    let (before, after) = (at(g, j - 1), at(g, j + 1));
                    here <= before && here <= after && here <= (before - here).max(after - here)
                }
            }
        };
        // Where it falls at the beginning of a part and rises at its end it is least within; of a
        // convex margin not below where the tangents meet.
        let slopes = guards.slopes(nodes, margins);
        let dips = |g: usize, j: usize| {
            let (falls, rises) = (slopes[j * each + g], slopes[(j + 1) * each + g]);
            let meet = (at(g, j + 1) - at(g, j) - rises * length(j)) / (falls - rises);
            falls < 0.0 && rises > 0.0 && at(g, j) + DEEPER * falls * meet < 0.0
        };
        let mut least: Vec<(usize, std::ops::RangeInclusive<usize>)> = Vec::new();
        for g in 0..each {
            let around = (0..=parts).filter(|j| may_fall(g, *j));
            least.extend(around.map(|j| (g, j.saturating_sub(1)..=(j + 1).min(parts))));
            least.extend((0..parts).filter(|j| dips(g, *j)).map(|j| (g, j..=j + 1)));
        }
        let mut found = Vec::new();
        for (g, around) in least {
            let places: Vec<(f64, &[f64])> = around
                .map(|k| (times[k], &nodes[k * width..][..width]))
                .collect();
            let [t, margin] = guards.least_between(g, &places);
            if !holds(margin, strict[g]) {
                let k = times[1..parts].partition_point(|at| *at <= t);
                let mut part = Path::new(&nodes[k * width..][..width]);
                part.push(t - times[k], &nodes[(k + 1) * width..][..width]);
                found.push(part);
            }
        }
        found
    }
}
