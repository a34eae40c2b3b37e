//! Whether trajectories are admissible: inside the guards, and in a game without a fold along them.

use super::{PointStatus, Survey};
use crate::backend::BackendError;
use crate::shooting::{Path, Solver};
use crate::sweep::guard_holds as holds;
use std::sync::PoisonError;

/// Parts of a segment at whose ends guards are looked at.
const GUARD_PIECES: usize = 8;

impl Survey<'_> {
    /// Whether all nodes are inside the guards, but for rounding.
    pub(in crate::value) fn inside(&self, nodes: &[f64]) -> bool {
        let Some((guards, strict)) = &self.guards else {
            return true;
        };
        const ROUNDING: f64 = 1e-9;
        let (n, width) = (self.targets.states, 2 * self.targets.states);
        let values = guards.eval(nodes, width);
        nodes
            .chunks(width)
            .zip(values.chunks(strict.len()))
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
                        holds(guards.eval(&moved, width)[g], strict[g])
                    })
                })
            })
    }

    /// What is wrong with trajectories, if anything: that they leave a guard, or in a game that they have a fold.
    pub(in crate::value) fn wrong(
        &mut self,
        solver: &mut Solver,
        paths: &[&Path],
    ) -> Result<Vec<Option<PointStatus>>, BackendError> {
        let guarded = self.valid(solver, paths)?.into_iter();
        let mut wrong: Vec<_> = guarded.map(|v| (!v).then_some(PointStatus::LeavesGuard)).collect();
        if let Some(conjugate) = &mut self.conjugate {
            let conjugate = conjugate.get_mut().unwrap_or_else(PoisonError::into_inner);
            for (wrong, regular) in wrong.iter_mut().zip(conjugate.absent(paths)?) {
                *wrong = wrong.or((!regular).then_some(PointStatus::Fold));
            }
        }
        Ok(wrong)
    }

    /// Whether trajectories stay inside the guards, at their nodes and between them.
    pub(in crate::value) fn valid(&self, solver: &mut Solver, paths: &[&Path]) -> Result<Vec<bool>, BackendError> {
        if self.guards.is_none() {
            return Ok(vec![true; paths.len()]);
        }
        let between = solver.between_nodes(paths, GUARD_PIECES)?;
        Ok((paths.iter().zip(between))
            .map(|(path, between)| self.inside(&path.nodes) && self.inside(&between))
            .collect())
    }
}
