//! Guesses for states of a grid from trajectories that are optimized directly, where nothing shows
//! which extremals there are: as many states as there is need for.

use super::handed::{Known, Origin};
use super::optimized::Asked;
use super::spread::Effort;
use super::{Progress, Survey, Wanted, times};
use crate::backend::BackendError;
use crate::numeric::random::uniform;
use crate::shooting::Solver;
use crate::value::direct::{CARRIED_FROM, Direct, Optimized, Round};

/// What is told to be done.
const FROM: &str = "from optimized trajectories";
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
/// From so many states of a system on trajectories are optimized at neighbours: a solution that is
/// continued there takes many times as long, and meets more folds.
const MANY_STATES: usize = 5;
/// Times that the states are looked at there.
const PASSES: u64 = 6;

impl Survey<'_> {
    /// Looks for cheaper ways from states of a grid, at random places, until so many in turn have
    /// none. What is found is tried at the neighbours: in few
    /// dimensions solutions are continued there, in many trajectories are optimized from there.
    /// Whether there are more sheets than are worth following.
    pub(super) fn search_in_company(
        &mut self,
        solver: &mut Solver,
        direct: &Direct<'_>,
        wanted: Wanted,
        progress: Progress<'_>,
    ) -> Result<bool, BackendError> {
        let mut order: Vec<usize> = (0..self.targets.len())
            .filter(|t| self.targets.gridded[*t] && !self.is_refused(*t))
            .filter(|t| !solver.scheme.end.covers(&self.state(*t, 0)))
            .collect();
        order.sort_by(|a, b| {
            let place = |t: &usize| uniform(*t as u64, 0);
            place(a).total_cmp(&place(b))
        });
        let hands_on = self.hands_on();
        let mut known = if hands_on {
            self.known(direct, &order)
        } else {
            Known::default()
        };
        let (mut quiet, mut looked) = (0, 0);
        let mut is_plain = true;
        for pass in 0..if hands_on { PASSES } else { 1 } {
            for together in order.chunks(TOGETHER) {
                let is_done = quiet >= QUIET.min(order.len()) || is_plain && looked >= PLAIN;
                let is_wanting =
                    |t: &usize| pass == 0 && self.is_wanting(*t) && known.is_empty_at(*t);
                let now: Vec<usize> = (together.iter().copied())
                    .filter(|t| !is_done || is_wanting(t))
                    .collect();
                if now.is_empty() {
                    continue;
                }
                let asked = self.in_turn(&now, looked as u64, pass, &known);
                let rounds = self.rounds(solver, direct, asked)?;
                let count = now.len();
                looked += count;
                is_plain &= rounds.iter().all(Round::is_plain);
                let mut cheaper = 0;
                if hands_on {
                    for (target, round) in now.iter().zip(rounds) {
                        let is_cheaper =
                            self.learn(&mut known, *target, round.found, Origin::Search);
                        cheaper += usize::from(is_cheaper);
                    }
                    self.hand_on(solver, direct, &mut known)?;
                    progress(FROM, self.solved(), self.targets.len());
                } else {
                    let found = rounds.into_iter().map(|round| round.found);
                    cheaper = self.solve_at_once(solver, direct, now.into_iter().zip(found))?;
                }
                if cheaper == 0 {
                    quiet += count;
                    continue;
                }
                (quiet, is_plain) = (0, false);
                if !hands_on {
                    self.spread(solver, wanted, Effort::Neighbours, progress)?;
                    progress(FROM, self.solved(), self.targets.len());
                }
            }
        }
        let found = self.still_unknown(known);
        let is_crowded = hands_on && !is_plain;
        // Sheets are too many to be joined by ways between their states.
        let wanted = Wanted {
            sheets: wanted.sheets && !is_crowded,
            ..wanted
        };
        if !found.is_empty() {
            self.solve_from(solver, direct, found)?;
            progress(FROM, self.solved(), self.targets.len());
            self.spread(solver, wanted, Effort::Neighbours, progress)?;
        }
        if self.follow_lost(solver)? {
            self.spread(solver, wanted, Effort::Neighbours, progress)?;
        }
        if hands_on {
            self.solve_images(solver, direct)?;
        }
        Ok(is_crowded)
    }

    /// Whether trajectories are handed on from state to state, rather than solutions.
    pub(super) fn hands_on(&self) -> bool {
        self.targets.states >= MANY_STATES
    }

    /// Solves from what was found; at how many states that is less than what was known.
    fn solve_at_once(
        &mut self,
        solver: &mut Solver,
        direct: &Direct<'_>,
        found: impl Iterator<Item = (usize, Vec<Optimized>)>,
    ) -> Result<usize, BackendError> {
        let mut before: Vec<(usize, f64)> = Vec::new();
        let mut unknown = Vec::new();
        for (target, found) in found {
            before.push((target, self.least_value(target)));
            let found = self.unknown(target, found).into_iter();
            unknown.extend(found.map(|one| (target, one)));
        }
        self.solve_from(solver, direct, unknown)?;
        let is_cheaper = |(t, before): &&(usize, f64)| {
            before.is_finite() && self.least_value(*t) < times(1.0 - CHEAPER, *before)
        };
        Ok(before.iter().filter(is_cheaper).count())
    }

    /// Whether a state has no solution, and is of interest however much it costs.
    pub(super) fn is_wanting(&self, target: usize) -> bool {
        self.is_open(target) && self.targets.limits[target] == f64::INFINITY
    }

    /// Guesses for targets, as the next ones in turn; at first those that are the same for all.
    fn in_turn(&self, targets: &[usize], turn: u64, pass: u64, known: &Known) -> Vec<Asked> {
        (targets.iter().enumerate())
            .map(|(k, target)| {
                let turn = pass * TURNS + (turn + k as u64) % TURNS;
                let first = if pass == 0 { 0..FIRST } else { 0..0 };
                let further = (0..FURTHER).map(|g| FIRST + turn * FURTHER + g);
                let carried = (0..CARRIED).map(|g| CARRIED_FROM + turn * CARRIED + g);
                Asked {
                    target: *target,
                    guesses: first.chain(further).chain(carried).collect(),
                    most: self
                        .least_known(known, *target)
                        .min(self.targets.limits[*target]),
                    known: None,
                }
            })
            .collect()
    }

    /// Trajectories that may cost less than what is known at their target, and are none of it: ways
    /// about an obstacle may begin with one adjoint, and only their costs tell them apart.
    fn unknown(&self, target: usize, found: Vec<Optimized>) -> Vec<Optimized> {
        let most = times(ABOVE, self.least_value(target));
        (found.into_iter())
            .filter(|o| o.cost <= most && !self.is_solved(target, o))
            .collect()
    }
}
