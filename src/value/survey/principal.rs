//! The answer of a game: the sheet of the equilibrium.

use super::{COHORT, PointStatus, Progress, Survey, Wanted};
use crate::backend::BackendError;
use crate::shooting::Solver;
use crate::value::archive::{Archive, Index};

impl Survey<'_> {
    /// Of a game with an equilibrium: the sheet of the equilibrium, continued along the straight
    /// line to each target as long as it does not fold, and what other sheets the sweep shows
    /// there.
    pub(super) fn principal_sheet(
        &mut self,
        solver: &mut Solver,
        archive: &Archive,
        index: &Index,
        wanted: Wanted,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        self.principal = self.at.iter().map(|list| list.first().copied()).collect();
        let open: Vec<usize> = (0..self.targets.len())
            .filter(|t| self.is_open(*t))
            .collect();
        for part in open.chunks(COHORT) {
            // Where Newton's method fails for another reason than a fold, shorter steps may do.
            for longest in [1.0 / 8.0, 1.0 / 64.0] {
                let left: Vec<usize> = (part.iter().copied())
                    .filter(|t| {
                        self.principal[*t].is_none() && !self.missed_by(*t, PointStatus::Fold)
                    })
                    .collect();
                let tasks = self.rays(&solver.scheme.end, &left, longest);
                for (target, reached) in self.send(solver, tasks)? {
                    self.principal[target] = reached;
                }
            }
            progress("from the equilibrium", self.solved(), self.targets.len());
        }
        let reached: Vec<usize> = self.principal.iter().flatten().copied().collect();
        for pair in reached.windows(2) {
            self.join(pair[0], pair[1]);
        }
        if wanted.sheets {
            let misses = self.misses.clone();
            let all: Vec<usize> = (0..self.targets.len())
                .filter(|t| !self.is_refused(*t))
                .collect();
            for part in all.chunks(COHORT) {
                self.swept(solver, archive, index, part, wanted)?;
            }
            // What is found beside a principal sheet that ends does not make up for it.
            self.misses = misses;
        }
        self.label();
        Ok(())
    }
}
