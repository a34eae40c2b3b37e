//! First guesses from V on a grid: its greedy paths.

use super::{Errand, Progress, Survey};
use crate::backend::BackendError;
use crate::dynamic_programming::GridValue;
use crate::shooting::{Path, Solver};
use crate::value::approach::Approach;
use rayon::prelude::*;
use std::collections::HashMap;

/// Shortest steps, as shares of the way, from a greedy path.
const FROM_GRID: f64 = 1.0 / 16.0;

/// What came of the greedy path from a target.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::value) struct Greedy {
    /// What its flight costs; `None` where the grid knows no way.
    pub cost: Option<f64>,
    /// The extremal found from it.
    pub extremal: Option<usize>,
}

impl Survey<'_> {
    /// The greedy paths from all targets, where there is V on a grid.
    pub(super) fn try_grid(&mut self, solver: &mut Solver, progress: Progress<'_>) -> Result<(), BackendError> {
        let Some(grid) = self.grid else { return Ok(()) };
        let targets: Vec<usize> = (0..self.targets.len()).filter(|t| !self.is_refused(*t)).collect();
        self.try_greedy(solver, grid, &targets)?;
        progress("from V on a grid", self.solved(), self.targets.len());
        Ok(())
    }

    /// Solves from the greedy path of each of some targets.
    pub(in crate::value) fn try_greedy(
        &mut self,
        solver: &mut Solver,
        grid: &GridValue,
        targets: &[usize],
    ) -> Result<Vec<Greedy>, BackendError> {
        let starts: Vec<Vec<f64>> = targets.iter().map(|t| self.state(*t, 0)).collect();
        let flown: Vec<Option<(f64, Path)>> = starts.par_iter().map(|s| grid.greedy(s)).collect();
        let costs: Vec<Option<f64>> = flown.iter().map(|f| f.as_ref().map(|(cost, _)| *cost)).collect();
        let mut errands = Vec::new();
        for ((&target, start), flown) in targets.iter().zip(&starts).zip(flown) {
            let Some((_, path)) = flown.filter(|(_, path)| path.nodes.iter().all(|x| x.is_finite())) else {
                continue;
            };
            let winding = self.winding_of(start, path.start());
            errands.push(Errand {
                from: None,
                target,
                winding,
                way: Approach::new(path, self.state(target, winding), FROM_GRID),
            });
        }
        let reached: HashMap<usize, Option<usize>> = self.send(solver, errands)?.into_iter().collect();
        Ok((targets.iter().zip(costs))
            .map(|(target, cost)| Greedy {
                cost,
                extremal: reached.get(target).copied().flatten(),
            })
            .collect())
    }

    /// The winding that leads from a state to a copy of it.
    fn winding_of(&mut self, from: &[f64], copy: &[f64]) -> usize {
        let turns: Vec<i32> = (from.iter().zip(copy).zip(&self.plan.periods))
            .map(|((from, copy), period)| period.map_or(0, |period| ((copy - from) / period).round() as i32))
            .collect();
        self.winding(&turns)
    }
}
