//! Around the folds in which sheets end between neighbours.

use super::spread::Effort;
use super::{MOST_SHEETS, Progress, Survey, Wanted};
use crate::backend::BackendError;
use crate::shooting::Solver;
use crate::value::extremal::Extremal;
use crate::value::fold;
use rustc_hash::FxHashSet;

/// Times that what was found behind folds is followed to further folds.
const FOLD_ROUNDS: usize = 3;

impl Survey<'_> {
    /// Follows sheets around the folds in which they end between neighbours, and what is found
    /// there on from there.
    pub(super) fn around_folds(
        &mut self,
        solver: &mut Solver,
        wanted: Wanted,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        let neighbours = self.targets.neighbours();
        let mut tried: FxHashSet<(usize, usize)> = FxHashSet::default();
        for _ in 0..FOLD_ROUNDS {
            let mut ways = Vec::new();
            for e in 0..self.extremals.len() {
                let from = self.extremals[e].target;
                // Single states are to have the same sheets in any company.
                let highest = self.sheets_to(from, wanted);
                if self.extremals[e].value() > highest || !self.targets.gridded[from] {
                    continue;
                }
                for &to in &neighbours[from] {
                    if !self.is_refused(to)
                        && self.targets.gridded[to]
                        && self.at[to].len() < MOST_SHEETS
                        && self.same_base(from, to)
                        && !tried.contains(&(e, to))
                        && !self.joins(e, to)
                    {
                        tried.insert((e, to));
                        ways.push((e, to));
                    }
                }
            }
            if ways.is_empty() {
                return Ok(());
            }
            let before = self.extremals.len();
            let starts: Vec<fold::Edge> = (ways.iter())
                .map(|(e, to)| fold::Edge {
                    path: self.extremals[*e].path.clone(),
                    to: self.state(*to, self.extremals[*e].winding),
                })
                .collect();
            for ((e, to), found) in ways.into_iter().zip(fold::around(solver, starts)?) {
                self.evaluations += u64::from(found.evaluations);
                let winding = self.extremals[e].winding;
                for (target, end) in [
                    (self.extremals[e].target, found.at_start),
                    (to, found.at_end),
                ] {
                    let Some((job, solved)) = end else { continue };
                    let highest = self.sheets_to(target, wanted);
                    if !self.valid(solver, &[&job.path])?[0] || solved.value > highest {
                        continue;
                    }
                    let (index, _) = self.add(Extremal {
                        target,
                        winding,
                        path: job.path,
                        solved,
                        iterations: found.evaluations,
                    });
                    // Without a fold between, the sheet goes on.
                    if found.folds.is_empty() {
                        self.join(e, index);
                    }
                }
                self.folds.extend(found.folds);
            }
            progress("around folds", self.solved(), self.targets.len());
            if self.extremals.len() == before {
                return Ok(());
            }
            self.spread(solver, wanted, Effort::Neighbours, progress)?;
        }
        Ok(())
    }
}
