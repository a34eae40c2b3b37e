//! Further extremals of a finite horizon: each known one is followed away from its target in several directions, around the
//! folds that its sheet may have there, and back.

use super::{MOST_SHEETS, Survey, Wanted};
use crate::backend::BackendError;
use crate::shooting::Solver;
use crate::value::extremal::Extremal;
use crate::value::fold;

/// How far, in widths of the region, and how many times what was found is followed again.
const REACH: f64 = 0.5;
const ROUNDS: usize = 2;
/// States of a system up to which this is done: there are twice as many directions.
const MOST_STATES: usize = 2;

impl Survey<'_> {
    /// Cells do not show extremals whose trajectories part too fast backward in time; their sheets join in folds.
    pub(super) fn from_folds_beside(&mut self, solver: &mut Solver, wanted: Wanted) -> Result<(), BackendError> {
        let n = self.targets.states;
        if self.plan.system.terminal.is_none() || !wanted.sheets || n > MOST_STATES {
            return Ok(());
        }
        let mut first = 0;
        for _ in 0..ROUNDS {
            let last = self.extremals.len();
            let (mut owners, mut edges) = (Vec::new(), Vec::new());
            for e in first..last {
                let extremal = &self.extremals[e];
                if self.at[extremal.target].len() >= MOST_SHEETS || self.targets.gridded[extremal.target] {
                    continue;
                }
                for (i, sign) in (0..n).flat_map(|i| [(i, -1.0), (i, 1.0)]) {
                    let mut to = extremal.path.start().to_vec();
                    to[i] += sign * REACH * self.plan.widths[i];
                    owners.push(e);
                    edges.push(fold::Edge {
                        path: extremal.path.clone(),
                        to,
                    });
                }
            }
            let found = fold::around(solver, edges)?;
            for (e, found) in owners.into_iter().zip(found) {
                self.evaluations += u64::from(found.evaluations);
                let Some((job, solved)) = found.at_start else { continue };
                if self.valid(solver, &[&job.path])?[0] {
                    let (target, winding) = (self.extremals[e].target, self.extremals[e].winding);
                    self.add(Extremal {
                        target,
                        winding,
                        path: job.path,
                        solved,
                        iterations: found.evaluations,
                    });
                }
            }
            first = last;
        }
        Ok(())
    }
}
