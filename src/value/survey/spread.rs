//! From solved targets to their neighbours: solutions that are missing, and which ones lie on one
//! sheet.

use super::{MOST_SHEETS, PointStatus, Progress, Survey, Task, Wanted};
use crate::backend::BackendError;
use crate::shooting::Solver;
use crate::value::approach::Approach;
use crate::value::archive::{Archive, Index};
use crate::value::extremal::{Extremal, misfit};
use rustc_hash::{FxHashMap, FxHashSet};
use std::collections::BTreeMap;

/// Swept trajectories tried for a target that nothing else has led to.
const ATTEMPTS: usize = 3;
/// Ways in the shortest steps that are tried to one target.
const MOST_WAYS: usize = 4;

/// Ways between solved targets that are followed at first for each part of a sheet, and how many
/// times more each time.
const FIRST_JOINS: usize = 1;
const MORE_JOINS: usize = 8;

/// How ways from neighbours are tried.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(in crate::low_level::value) enum Effort {
    /// To states of a grid without a solution, from one to the next at once.
    Leaps,
    /// Each sheet to each neighbour, in steps that are usual.
    Neighbours,
    /// To targets without a solution whose V is of interest however high, a few ways in the
    /// shortest steps.
    Patient,
}

impl Effort {
    /// Shortest step, as a share of the way.
    pub(in crate::low_level::value) fn least(self) -> f64 {
        match self {
            Effort::Leaps => 1.0,
            Effort::Neighbours => 1.0 / 32.0,
            Effort::Patient => 1.0 / 4096.0,
        }
    }
}

/// How an extremal and those at a neighbouring target fit together.
enum Fit {
    /// It is on the sheet of one of them.
    Joined,
    /// It is on the sheet of none; the least misfit.
    Apart(f64),
}

/// A way from an extremal to a neighbouring target.
#[derive(Clone, Copy)]
struct Way {
    e: usize,
    to: usize,
    /// The extremal's sheet.
    root: usize,
    /// Square of its length, in widths.
    far: f64,
    misfit: f64,
    /// Whether the target has no solution.
    open: bool,
}

/// Ways that were followed, from an extremal to a target: once is enough.
#[derive(Default)]
pub(super) struct Followed {
    ways: FxHashSet<(usize, usize)>,
    ways_to: FxHashMap<usize, usize>,
}

impl Followed {
    fn note(&mut self, e: usize, to: usize) {
        self.ways.insert((e, to));
        *self.ways_to.entry(to).or_insert(0) += 1;
    }
}

/// The ways to follow now. To targets without a solution those from extremals found just now
/// (from `found` on): what is behind an obstacle comes from the first that is reached there. Of those
/// between solved targets so many a sheet, that fit best: two parts of a sheet are joined by one way,
/// and all others between them need not be followed.
fn ways_now(ways: Vec<Way>, found: usize, at_once: usize) -> Vec<Way> {
    let (mut now, mut joining): (Vec<Way>, Vec<Way>) = ways.into_iter().partition(|way| way.open);
    if now.iter().any(|way| way.e >= found) {
        now.retain(|way| way.e >= found);
    }
    let key = |way: &Way| (way.root, way.to);
    joining.sort_by(|a, b| a.misfit.total_cmp(&b.misfit).then(key(a).cmp(&key(b))));
    let mut of: FxHashMap<usize, usize> = FxHashMap::default();
    joining.retain(|way| {
        let count = of.entry(way.root).or_insert(0);
        *count += 1;
        *count <= at_once
    });
    now.extend(joining);
    now.sort_by_key(|way| (way.to, way.root));
    now
}

impl Survey<'_> {
    /// Continues every extremal to the neighbours of its target, as long as that gives new ones.
    pub(in crate::low_level::value) fn spread(
        &mut self,
        solver: &mut Solver,
        wanted: Wanted,
        effort: Effort,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        let neighbours = self.targets.neighbours();
        // What leads nowhere at once does not later either.
        let mut followed = match effort {
            Effort::Leaps => std::mem::take(&mut self.leapt),
            _ => Followed::default(),
        };
        let mut at_once = FIRST_JOINS;
        // Extremals from here on were found by the last ways.
        let mut before = usize::MAX;
        loop {
            let ways = self.ways(&neighbours, &mut followed, wanted, effort);
            let now = ways_now(ways, before, at_once);
            if now.is_empty() {
                if effort == Effort::Leaps {
                    self.leapt = followed;
                }
                return Ok(());
            }
            at_once = at_once.saturating_mul(MORE_JOINS);
            before = self.extremals.len();
            let tasks: Vec<Task> = (now.into_iter())
                .map(|Way { e, to, .. }| {
                    // Where a way leads nowhere, or to what is known, there is nothing left to do.
                    followed.note(e, to);
                    let Extremal { winding, path, .. } = &self.extremals[e];
                    let goal = self.state(to, *winding);
                    Task {
                        from: Some(e),
                        target: to,
                        winding: *winding,
                        way: Approach::from_solution(path.clone(), goal, effort.least()),
                    }
                })
                .collect();
            self.send(solver, tasks)?;
            progress("from neighbours", self.solved(), self.targets.len());
        }
    }

    /// Ways from extremals to neighbours that were not followed: of each sheet and target the
    /// shortest.
    fn ways(
        &mut self,
        neighbours: &[Vec<usize>],
        followed: &mut Followed,
        wanted: Wanted,
        effort: Effort,
    ) -> Vec<Way> {
        let mut ways: BTreeMap<(usize, usize), Way> = BTreeMap::new();
        for e in 0..self.extremals.len() {
            let (target, winding) = (self.extremals[e].target, self.extremals[e].winding);
            for &to in &neighbours[target] {
                let leaps = self.targets.gridded[to] && self.at[to].is_empty();
                if self.is_refused(to)
                    || (effort == Effort::Leaps && !leaps)
                    || followed.ways.contains(&(e, to))
                    || !self.same_base(target, to)
                {
                    continue;
                }
                let tried = followed.ways_to.get(&to).copied().unwrap_or(0);
                let limited = self.targets.limits[to] < f64::INFINITY;
                if effort == Effort::Patient && (tried >= MOST_WAYS || limited) {
                    continue;
                }
                let Fit::Apart(misfit) = self.fit(e, to) else {
                    continue;
                };
                if !self.wants(e, to, wanted) {
                    continue;
                }
                let root = self.joined.root(e);
                let (goal, start) = (self.state(to, winding), self.extremals[e].path.start());
                let far = (goal.iter().zip(start).zip(&self.plan.widths))
                    .map(|((g, s), w)| ((g - s) / w).powi(2))
                    .sum::<f64>();
                let way = Way {
                    e,
                    to,
                    root,
                    far,
                    misfit,
                    open: self.at[to].is_empty(),
                };
                let shortest = ways.entry((to, root)).or_insert(way);
                // The latest of equal ones.
                if far <= shortest.far {
                    *shortest = way;
                }
            }
        }
        ways.into_values().collect()
    }

    /// Whether an extremal is to be continued to a neighbouring target.
    pub(in crate::low_level::value) fn wants(&self, e: usize, to: usize, wanted: Wanted) -> bool {
        let extremal = &self.extremals[e];
        if self.at[to].is_empty() {
            let (from, goal) = (extremal.path.start(), self.state(to, extremal.winding));
            let change: f64 = (0..goal.len())
                .map(|i| extremal.adjoint()[i] * (goal[i] - from[i]))
                .sum();
            return extremal.value() + change.min(0.0) <= self.targets.limits[to];
        }
        // A single state has the same sheets in any company: ways to it only show which of them
        // belong together.
        let single = !self.targets.gridded[to] || !self.targets.gridded[extremal.target];
        if self.at[to].len() >= MOST_SHEETS || single && !self.plan.game {
            return false;
        }
        // The cheapest are joined to each other however much they cost, so that their labels agree.
        let highest = self.sheets_to(to, wanted);
        wanted.sheets && (extremal.value() <= highest || self.lowest(extremal.target) == Some(e))
    }

    /// Whether an extremal fits one at a neighbouring target, and joins them.
    pub(in crate::low_level::value) fn joins(&mut self, e: usize, to: usize) -> bool {
        matches!(self.fit(e, to), Fit::Joined)
    }

    /// The same with how far it is from fitting.
    fn fit(&mut self, e: usize, to: usize) -> Fit {
        let root = self.joined.root(e);
        let (mut least, mut nearest) = (f64::INFINITY, None);
        for q in 0..self.at[to].len() {
            let other = self.at[to][q];
            if self.extremals[other].winding != self.extremals[e].winding {
                continue;
            }
            if self.joined.root(other) == root {
                return Fit::Joined;
            }
            let m = misfit(&self.extremals[e], &self.extremals[other], &self.scales);
            if nearest.is_none() || m < least {
                (least, nearest) = (m, Some(other));
            }
        }
        match nearest {
            Some(other) if least < 1.0 && self.join(e, other) => Fit::Joined,
            _ => Fit::Apart(least),
        }
    }

    /// Targets still without a solution, in the shortest steps: from neighbours, from the swept
    /// points nearest to them, and from what that has given.
    pub(in crate::low_level::value) fn last_resort(
        &mut self,
        solver: &mut Solver,
        archive: &Archive,
        index: &Index,
        wanted: Wanted,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        let only = Wanted {
            sheets: false,
            ..wanted
        };
        for attempt in 0..=ATTEMPTS {
            let open = self.worth_trying();
            if open.is_empty() {
                return Ok(());
            }
            self.spread(solver, only, Effort::Patient, progress)?;
            if attempt == 0 {
                let tasks = self.linear_guesses(&solver.scheme.end, &open, Effort::Patient.least());
                self.send(solver, tasks)?;
            }
            if attempt < ATTEMPTS {
                let tasks = self.nearest_guesses(
                    &solver.scheme.end,
                    archive,
                    index,
                    &open,
                    attempt,
                    Effort::Patient.least(),
                );
                self.send(solver, tasks)?;
                progress("in short steps", self.solved(), self.targets.len());
            }
        }
        for target in 0..self.targets.len() {
            if self.at[target].is_empty() && self.misses[target].is_none() {
                let limited = self.targets.limits[target] < f64::INFINITY;
                let status = if limited {
                    PointStatus::AboveMax
                } else {
                    PointStatus::NoGuess
                };
                self.miss(target, status, None, f64::INFINITY);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What was found just now leads on to where nothing is known; parts of a sheet are joined by
    /// the ways that fit best.
    #[test]
    fn ways_are_followed_by_what_they_promise() {
        let way = |e: usize, to: usize, misfit: f64, open: bool| Way {
            e,
            to,
            root: e % 2,
            far: 1.0,
            misfit,
            open,
        };
        let followed = |ways: &[Way], found: usize, at_once: usize| -> Vec<(usize, usize)> {
            (ways_now(ways.to_vec(), found, at_once).iter())
                .map(|way| (way.e, way.to))
                .collect()
        };
        let open = [
            way(1, 5, 0.0, true),
            way(8, 6, 0.0, true),
            way(2, 7, 0.0, true),
        ];
        assert_eq!(followed(&open, usize::MAX, 1), [(1, 5), (8, 6), (2, 7)]);
        assert_eq!(followed(&open, 8, 1), [(8, 6)]);
        let joining = [
            way(0, 4, 3.0, false),
            way(2, 5, 2.0, false),
            way(1, 6, 9.0, false),
            way(4, 7, f64::INFINITY, false),
        ];
        assert_eq!(followed(&joining, usize::MAX, 1), [(2, 5), (1, 6)]);
        assert_eq!(followed(&joining, usize::MAX, 2), [(0, 4), (2, 5), (1, 6)]);
        // One of those is followed though ways to what is open are waiting.
        let both = [open[0], open[1], joining[0]];
        assert_eq!(followed(&both, 8, 1), [(0, 4), (8, 6)]);
    }
}
