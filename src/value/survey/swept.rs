//! First guesses from swept trajectories.

use super::{MOST_SHEETS, SHORT, Survey, Task, Wanted};
use crate::backend::BackendError;
use crate::shooting::{End, Solver};
use crate::value::approach::Approach;
use crate::value::archive::{Archive, Index, Place};
use crate::value::extremal::{Extremal, is_elsewhere};
use rayon::prelude::*;

/// Shortest steps, as shares of the way, from a swept trajectory near the target.
const FROM_SWEEP: f64 = 1.0 / 4.0;
/// Swept points within this many spacings of a target show which sheets there are.
const REACH: f64 = 2.0;
/// Swept points that are looked at.
const MOST_NEAR: usize = 48;
/// Windings tried for a target that no swept point is near to.
const FAR_WINDINGS: usize = 3;

impl Survey<'_> {
    /// An index of the swept points near the targets.
    pub(super) fn index(&self, archive: &Archive) -> Index {
        let (plan, n) = (self.plan, self.targets.states);
        let bounds: Vec<[f64; 2]> = (0..n)
            .map(|i| {
                if plan.periodic[i] {
                    return [f64::NEG_INFINITY, f64::INFINITY];
                }
                let along = self.targets.x.iter().skip(i).step_by(n);
                let margin = REACH * plan.shoot_out.spacing * plan.widths[i];
                let [lo, hi] = along.fold([f64::INFINITY, f64::NEG_INFINITY], |[lo, hi], x| {
                    [lo.min(*x), hi.max(*x)]
                });
                // Nothing may lie near targets outside the sweep's reach: then the region's points
                // are all there is.
                let [region_lo, region_hi] = plan.region[i];
                let lo = (lo - plan.system.reference[i] - margin).min(region_hi);
                let hi = (hi - plan.system.reference[i] + margin).max(region_lo);
                [lo, hi]
            })
            .collect();
        let near = Index::new(archive, &plan.widths, &bounds, plan.shoot_out.spacing);
        if !near.is_empty() {
            return near;
        }
        let all = vec![[f64::NEG_INFINITY, f64::INFINITY]; n];
        Index::new(archive, &plan.widths, &all, plan.shoot_out.spacing)
    }

    /// Solves targets from the swept points near them.
    pub(super) fn swept(
        &mut self,
        solver: &mut Solver,
        archive: &Archive,
        index: &Index,
        targets: &[usize],
        wanted: Wanted,
    ) -> Result<(), BackendError> {
        let reach = REACH * self.plan.shoot_out.spacing;
        let first = self.first_guesses(&solver.scheme.end, archive, index, targets, reach, wanted);
        self.send(solver, first)?;
        if !wanted.sheets {
            return Ok(());
        }
        for _ in 1..MOST_SHEETS {
            let further = self.further_guesses(&solver.scheme.end, archive, index, targets, reach);
            if further.is_empty() {
                break;
            }
            let before = self.extremals.len();
            self.send(solver, further)?;
            if self.extremals.len() == before {
                break;
            }
        }
        Ok(())
    }

    /// One guess for each winding that has a swept point near the target; at least one.
    pub(super) fn first_guesses(
        &self,
        end: &End,
        archive: &Archive,
        index: &Index,
        targets: &[usize],
        reach: f64,
        wanted: Wanted,
    ) -> Vec<Task> {
        let open = targets
            .par_iter()
            .filter(|t| !self.is_refused(**t) && self.at[**t].is_empty());
        open.flat_map_iter(|&target| {
            let mut near: Vec<(usize, _, f64)> = (0..self.windings.len())
                .filter_map(|winding| {
                    let place = self.scaled(&self.state(target, winding));
                    let (place, distance) = index.near(&place, 0.0, 1).first().copied()?;
                    Some((winding, place, distance))
                })
                .collect();
            near.sort_by(|a, b| a.2.total_cmp(&b.2));
            let all = wanted.sheets;
            let anyhow = self.targets.limits[target] == f64::INFINITY;
            near.into_iter()
                .enumerate()
                .filter(move |(k, (_, _, distance))| {
                    let tried = *k == 0 || (all && *k < FAR_WINDINGS);
                    (tried && anyhow) || ((*k == 0 || all) && *distance <= reach)
                })
                .map(|(_, (winding, place, distance))| {
                    // Nothing near tells which sheets there are: each winding's is followed all the
                    // way.
                    let least = if distance > reach && anyhow {
                        SHORT
                    } else {
                        FROM_SWEEP
                    };
                    self.task(end, archive, target, winding, place, least)
                })
                .collect::<Vec<_>>()
        })
        .collect()
    }

    pub(super) fn task(
        &self,
        end: &End,
        archive: &Archive,
        target: usize,
        winding: usize,
        place: Place,
        least: f64,
    ) -> Task {
        let path = archive.path(place, end, archive.value(place), self.duration);
        Task {
            from: None,
            target,
            winding,
            way: Approach::new(path, self.state(target, winding), least),
        }
    }

    /// Guesses from swept points near targets that lie on none of the sheets known there.
    pub(super) fn further_guesses(
        &self,
        end: &End,
        archive: &Archive,
        index: &Index,
        targets: &[usize],
        reach: f64,
    ) -> Vec<Task> {
        let solved = targets.par_iter().filter(|t| !self.at[**t].is_empty());
        solved
            .flat_map_iter(|&target| {
                (0..self.windings.len()).filter_map(move |winding| {
                    let known: Vec<&Extremal> = (self.at[target].iter())
                        .map(|e| &self.extremals[*e])
                        .filter(|e| e.winding == winding)
                        .collect();
                    if known.is_empty() || known.len() >= MOST_SHEETS {
                        return None;
                    }
                    let place = self.scaled(&self.state(target, winding));
                    let near = index.near(&place, reach, MOST_NEAR);
                    let (place, _) = (near.into_iter()).find(|(place, distance)| {
                        let node = archive.node(*place);
                        *distance <= reach
                            && known.iter().all(|e| is_elsewhere(e, &node, &self.scales))
                    })?;
                    Some(self.task(end, archive, target, winding, place, FROM_SWEEP))
                })
            })
            .collect()
    }

    /// For each target the swept trajectory that is the `attempt`-th nearest to it.
    pub(super) fn nearest_guesses(
        &self,
        end: &End,
        archive: &Archive,
        index: &Index,
        targets: &[usize],
        attempt: usize,
        least: f64,
    ) -> Vec<Task> {
        let open = targets
            .par_iter()
            .filter(|t| self.at[**t].is_empty() && self.targets.limits[**t] == f64::INFINITY);
        open.filter_map(|&target| {
            let mut near: Vec<(usize, _, f64)> = (0..self.windings.len())
                .flat_map(|winding| {
                    let place = self.scaled(&self.state(target, winding));
                    let near = index.near(&place, f64::INFINITY, MOST_NEAR);
                    near.into_iter()
                        .map(move |(place, distance)| (winding, place, distance))
                })
                .collect();
            near.sort_by(|a, b| a.2.total_cmp(&b.2));
            let mut trajectories: Vec<usize> = Vec::new();
            let (winding, place, _) = near.into_iter().find(|(_, place, _)| {
                if trajectories.contains(&place.trajectory) {
                    return false;
                }
                trajectories.push(place.trajectory);
                trajectories.len() == attempt + 1
            })?;
            Some(self.task(end, archive, target, winding, place, least))
        })
        .collect()
    }
}
