//! Guesses for states of a grid from trajectories that are optimized directly, where nothing shows
//! which extremals there are: as many states as there is need for.

use super::optimized::Asked;
use super::spread::Effort;
use super::{Progress, Survey, Wanted, times};
use crate::backend::BackendError;
use crate::numeric::random::uniform;
use crate::shooting::Solver;
use crate::value::direct::{CARRIED_FROM, Optimized, Round};

/// States that are looked at together.
const TOGETHER: usize = 8;
/// Guesses for a state: the first ones are the same for all, the others, some of which hold their
/// controls at first, differ from one state to the next, since what is found at one is tried at its neighbours.
const FIRST: u64 = 2;
const FURTHER: u64 = 6;
const CARRIED: u64 = 4;
const TURNS: u64 = 8;
/// Of as many states in turn, at random places, none has to be found cheaper for the others to be
/// left.
const QUIET: usize = 64;
/// States, all guesses from which lead to about the same cost, after which no others are looked at
/// but those without a solution.
const PLAIN: usize = TOGETHER;
/// Trajectories that cost at most this many times the least are solved from.
const ABOVE: f64 = 1.01;
/// A state is found cheaper by this share of its cost.
const CHEAPER: f64 = 1e-6;

impl Survey<'_> {
    /// Looks for cheaper ways from states of a grid, at random places, until so many in turn have
    /// none; what is found is tried at the neighbours.
    pub(super) fn search_in_company(
        &mut self,
        solver: &mut Solver,
        wanted: Wanted,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        let Some(direct) = self.direct.take() else {
            return Ok(());
        };
        let mut order: Vec<usize> = (0..self.targets.len())
            .filter(|t| self.targets.gridded[*t] && !self.is_refused(*t))
            .filter(|t| !solver.scheme.end.covers(&self.state(*t, 0)))
            .collect();
        order.sort_by(|a, b| {
            let place = |t: &usize| uniform(*t as u64, 0);
            place(a).total_cmp(&place(b))
        });
        let (mut quiet, mut looked) = (0, 0);
        let mut is_plain = true;
        for together in order.chunks(TOGETHER) {
            let is_done = quiet >= QUIET || is_plain && looked >= PLAIN;
            let now: Vec<usize> = (together.iter().copied())
                .filter(|t| !is_done || self.is_wanting(*t))
                .collect();
            if now.is_empty() {
                continue;
            }
            let asked = self.in_turn(&now, looked as u64);
            let rounds = self.rounds(solver, &direct, asked)?;
            looked += now.len();
            is_plain &= rounds.iter().all(Round::is_plain);
            let before: Vec<f64> = now.iter().map(|t| self.least_value(*t)).collect();
            let mut found = Vec::new();
            for (&target, round) in now.iter().zip(rounds) {
                found.extend(self.unknown(target, round.found));
            }
            self.solve_from(solver, &direct, found)?;
            let is_cheaper =
                |(t, before): (&usize, f64)| self.least_value(*t) < times(1.0 - CHEAPER, before);
            let cheaper = now.iter().zip(before).filter(|x| is_cheaper(*x)).count();
            if cheaper == 0 {
                quiet += now.len();
                continue;
            }
            (quiet, is_plain) = (0, false);
            self.spread(solver, wanted, Effort::Neighbours, progress)?;
            progress(
                "from optimized trajectories",
                self.solved(),
                self.targets.len(),
            );
        }
        if self.follow_lost(solver)? {
            self.spread(solver, wanted, Effort::Neighbours, progress)?;
        }
        self.direct = Some(direct);
        Ok(())
    }

    /// Whether a state has no solution, and is of interest however much it costs.
    pub(super) fn is_wanting(&self, target: usize) -> bool {
        self.is_open(target) && self.targets.limits[target] == f64::INFINITY
    }

    /// Guesses for targets, as the next ones in turn.
    fn in_turn(&self, targets: &[usize], turn: u64) -> Vec<Asked> {
        (targets.iter().enumerate())
            .map(|(k, target)| {
                let turn = (turn + k as u64) % TURNS;
                let further = (0..FURTHER).map(|g| FIRST + turn * FURTHER + g);
                let carried = (0..CARRIED).map(|g| CARRIED_FROM + turn * CARRIED + g);
                Asked {
                    target: *target,
                    guesses: (0..FIRST).chain(further).chain(carried).collect(),
                    most: self.least_value(*target).min(self.targets.limits[*target]),
                    known: None,
                }
            })
            .collect()
    }

    /// Trajectories that may cost less than what is known at their target, and are none of it: ways
    /// about an obstacle may begin with one adjoint, and only their costs tell them apart.
    fn unknown(&self, target: usize, found: Vec<Optimized>) -> Vec<(usize, Optimized)> {
        let most = times(ABOVE, self.least_value(target));
        (found.into_iter())
            .filter(|o| o.cost <= most && !self.is_solved(target, o))
            .map(|o| (target, o))
            .collect()
    }
}
