//! From solved targets to their neighbours: solutions that are missing, and which ones lie on one
//! sheet.

use super::{MOST_SHEETS, PointStatus, Progress, Survey, Task, Wanted};
use crate::backend::BackendError;
use crate::shooting::Solver;
use crate::value::approach::Approach;
use crate::value::archive::{Archive, Index};
use crate::value::extremal::misfit;
use rustc_hash::{FxHashMap, FxHashSet};
use std::collections::BTreeMap;

/// Swept trajectories tried for a target that nothing else has led to.
const ATTEMPTS: usize = 3;
/// Ways in the shortest steps that are tried to one target.
const MOST_WAYS: usize = 4;

/// How ways from neighbours are tried.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(in crate::low_level::value) enum Effort {
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
            Effort::Neighbours => 1.0 / 32.0,
            Effort::Patient => 1.0 / 4096.0,
        }
    }
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
        // Ways that were followed, from an extremal to a target: once is enough.
        let mut visited: FxHashSet<(usize, usize)> = FxHashSet::default();
        let mut ways_to: FxHashMap<usize, usize> = FxHashMap::default();
        loop {
            let mut tasks: BTreeMap<(usize, usize), (f64, Task)> = BTreeMap::new();
            for e in 0..self.extremals.len() {
                let (target, winding) = (self.extremals[e].target, self.extremals[e].winding);
                for &to in &neighbours[target] {
                    if self.is_refused(to)
                        || visited.contains(&(e, to))
                        || !self.same_base(target, to)
                    {
                        continue;
                    }
                    let tried = ways_to.get(&to).copied().unwrap_or(0);
                    let limited = self.targets.limits[to] < f64::INFINITY;
                    if effort == Effort::Patient && (tried >= MOST_WAYS || limited) {
                        continue;
                    }
                    if self.joins(e, to) {
                        continue;
                    }
                    if !self.wants(e, to, wanted) {
                        continue;
                    }
                    // One way a sheet and target at a time: the shortest.
                    let root = self.joined.root(e);
                    let goal = self.state(to, winding);
                    let path = &self.extremals[e].path;
                    let far = (goal.iter().zip(path.start()).zip(&self.plan.widths))
                        .map(|((g, s), w)| ((g - s) / w).powi(2))
                        .sum::<f64>();
                    if tasks
                        .get(&(to, root))
                        .is_none_or(|(shortest, _)| far < *shortest)
                    {
                        let task = Task {
                            from: Some(e),
                            target: to,
                            winding,
                            way: Approach::from_solution(path.clone(), goal, effort.least()),
                        };
                        tasks.insert((to, root), (far, task));
                    }
                }
            }
            if tasks.is_empty() {
                return Ok(());
            }
            let tasks: Vec<Task> = tasks.into_values().map(|(_, e)| e).collect();
            for task in &tasks {
                // Where a way leads nowhere, or to what is known, there is nothing left to do.
                visited.extend(task.from.map(|from| (from, task.target)));
                *ways_to.entry(task.target).or_insert(0) += 1;
            }
            self.send(solver, tasks)?;
            progress("from neighbours", self.solved(), self.targets.len());
        }
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
        let root = self.joined.root(e);
        let mut best: Option<(f64, usize)> = None;
        for q in 0..self.at[to].len() {
            let other = self.at[to][q];
            if self.extremals[other].winding != self.extremals[e].winding {
                continue;
            }
            if self.joined.root(other) == root {
                return true;
            }
            let m = misfit(&self.extremals[e], &self.extremals[other], &self.scales);
            if best.is_none_or(|(b, _)| m < b) {
                best = Some((m, other));
            }
        }
        match best {
            Some((m, other)) if m < 1.0 => self.join(e, other),
            _ => false,
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
