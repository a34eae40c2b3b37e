//! First guesses from V on a grid: its greedy paths.

use super::{Mesh, Progress, Survey};
use crate::backend::{BackendError, Deadline};
use crate::dynamic_programming::GridValue;
use crate::shooting::{Path, Solver};
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use std::sync::Arc;

/// Shortest steps, as shares of the way, from a greedy path.
const FROM_GRID: f64 = 1.0 / 16.0;
/// Where a path is followed from its end its nodes are so many times closer together.
const PARTS: usize = 8;

/// What came of the greedy path from a target.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::low_level::value) struct Greedy {
    /// What its flight costs; `None` where the grid knows no way.
    pub cost: Option<f64>,
    /// The extremal found from it.
    pub extremal: Option<usize>,
}

impl Survey<'_> {
    /// The greedy paths from all targets.
    pub(super) fn try_grid(
        &mut self,
        solver: &mut Solver,
        grid: &GridValue,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        let targets: Vec<usize> = (0..self.targets.len())
            .filter(|t| !self.is_refused(*t))
            .collect();
        self.try_greedy(solver, grid, &targets)?;
        progress("from V on a grid", self.solved(), self.targets.len());
        Ok(())
    }

    /// The greedy paths from targets at which the search does not show the least, or found nothing;
    /// of a finer grid from those at which that leads to nothing either.
    pub(super) fn try_doubtful(
        &mut self,
        solver: &mut Solver,
        make: &mut dyn FnMut(Mesh) -> Option<Arc<GridValue>>,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        let doubtful: Vec<usize> = (0..self.targets.len())
            .filter(|t| !self.is_refused(*t) && !self.is_covered(*t))
            .collect();
        if doubtful.is_empty() {
            return Ok(());
        }
        let open = self.try_mesh(solver, make, Mesh::Coarse, doubtful)?;
        progress("from V on a grid", self.solved(), self.targets.len());
        if open.is_empty() {
            return Ok(());
        }
        self.try_mesh(solver, make, Mesh::Usual, open)?;
        progress("from V on a finer grid", self.solved(), self.targets.len());
        Ok(())
    }

    /// The greedy paths of a finer grid from targets of a list at which nothing shows the least, and whose
    /// own answer could not be flown along; whether that leads to anything cheaper.
    pub(super) fn try_lost(
        &mut self,
        solver: &mut Solver,
        make: &mut dyn FnMut(Mesh) -> Option<Arc<GridValue>>,
        progress: Progress<'_>,
    ) -> Result<bool, BackendError> {
        let is_lost = |t: &usize| self.flown[*t] == Some(f64::INFINITY) && !self.is_covered(*t);
        let lost: Vec<usize> = (0..self.targets.len()).filter(is_lost).collect();
        if lost.is_empty() {
            return Ok(false);
        }
        let before: Vec<f64> = lost.iter().map(|t| self.least_value(*t)).collect();
        self.try_mesh(solver, make, Mesh::Usual, lost.clone())?;
        progress("from V on a finer grid", self.solved(), self.targets.len());
        let is_cheaper = |(t, before): (&usize, f64)| self.least_value(*t) < before;
        Ok(lost.iter().zip(before).any(is_cheaper))
    }

    /// The greedy paths from some targets on a grid that is made for them; those among them that
    /// have no solution, and by the grid a V that is of interest.
    fn try_mesh(
        &mut self,
        solver: &mut Solver,
        make: &mut dyn FnMut(Mesh) -> Option<Arc<GridValue>>,
        mesh: Mesh,
        doubtful: Vec<usize>,
    ) -> Result<Vec<usize>, BackendError> {
        let Some(grid) = make(mesh) else {
            return Ok(Vec::new());
        };
        // Where V is above what is of interest there need be no solution.
        let (limits, least) = (&self.targets.limits, |t: usize| {
            grid.value(&self.state(t, 0))
        });
        let doubtful: Vec<usize> = (doubtful.into_iter())
            .filter(|t| !self.at[*t].is_empty() || least(*t).is_some_and(|v| v <= limits[*t]))
            .collect();
        self.try_greedy(solver, &grid, &doubtful)?;
        let open = doubtful.into_iter().filter(|t| self.is_open(*t));
        Ok(open.collect())
    }

    /// Solves from the greedy path of each of some targets.
    pub(in crate::low_level::value) fn try_greedy(
        &mut self,
        solver: &mut Solver,
        grid: &GridValue,
        targets: &[usize],
    ) -> Result<Vec<Greedy>, BackendError> {
        let flown = self.greedy_paths(grid, (targets, 1), solver.deadline)?;
        let costs: Vec<Option<f64>> = flown
            .iter()
            .map(|f| f.as_ref().map(|(cost, _)| *cost))
            .collect();
        let guesses =
            (targets.iter().zip(flown)).filter_map(|(t, flown)| Some((*t, flown?.1, FROM_GRID)));
        let mut found = self.try_paths(solver, guesses.collect())?;
        // What is too rough a guess as a whole is followed from its end.
        let rough: Vec<usize> = (targets.iter().zip(&costs))
            .filter(|(t, cost)| {
                !found.contains_key(t) && cost.is_some_and(|cost| self.would_be_least(**t, cost))
            })
            .map(|(t, _)| *t)
            .collect();
        let fine = self.greedy_paths(grid, (&rough, PARTS), solver.deadline)?;
        let fine = (rough.into_iter().zip(fine)).filter_map(|(t, flown)| Some((t, flown?.1)));
        let reached = self.send_grown(solver, fine.collect(), 1.0)?;
        found.extend(reached.into_iter().filter_map(|(t, e)| Some((t, e?))));
        Ok((targets.iter().zip(costs))
            .map(|(target, cost)| Greedy {
                cost,
                extremal: found.get(target).copied(),
            })
            .collect())
    }

    fn would_be_least(&self, target: usize, cost: f64) -> bool {
        self.lowest(target)
            .is_none_or(|e| cost < self.extremals[e].value())
    }

    /// Greedy paths with their costs, their nodes so many times closer together than usual.
    fn greedy_paths(
        &self,
        grid: &GridValue,
        (targets, parts): (&[usize], usize),
        deadline: Deadline,
    ) -> Result<Vec<Option<(f64, Path)>>, BackendError> {
        let starts: Vec<Vec<f64>> = targets.iter().map(|t| self.state(*t, 0)).collect();
        let terminal = self.plan.system.terminal.as_ref();
        let flown = |s: &Vec<f64>| {
            // Among obstacles the way from one state alone may take a second.
            if deadline.has_passed() {
                return None;
            }
            let (cost, mut path) = grid.greedy_in_parts(s, parts)?;
            if let Some(terminal) = terminal {
                path.set_horizon(terminal.time);
            }
            Some((cost, path))
        };
        let paths = starts.par_iter().map(flown).collect();
        deadline.check()?;
        Ok(paths)
    }

    /// Solves from a path from each of some targets, with the shortest step to try; the extremals
    /// found.
    fn try_paths(
        &mut self,
        solver: &mut Solver,
        guesses: Vec<(usize, Path, f64)>,
    ) -> Result<FxHashMap<usize, usize>, BackendError> {
        let tasks = (guesses.into_iter())
            .filter_map(|(target, path, least)| self.task_along(target, path, least));
        let tasks = tasks.collect();
        let reached = self.send(solver, tasks)?;
        Ok(reached
            .into_iter()
            .filter_map(|(t, e)| Some((t, e?)))
            .collect())
    }
}
