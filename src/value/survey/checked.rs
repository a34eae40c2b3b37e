//! Whether any control that is known costs less than the least V found: laws are flown from every solved target.

use super::{Errand, Progress, SHORT, Survey};
use crate::backend::BackendError;
use crate::shooting::Solver;
use crate::value::approach::Approach;
use crate::value::flight::{Claim, Pilot, undercut};

/// Rounds in which what undercut a target was solved for.
const ROUNDS: usize = 4;
/// Neighbours along whose paths is flown to a target for which the search was not complete.
const NEIGHBOURS: usize = 3;
/// A solution found from a flight's path is its own where it costs at most this much more.
const ABOVE: f64 = 1e-6;

/// How well it is supported that the least V found at a target is the least there is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Support {
    /// First guesses tried.
    pub starts: u32,
    /// Controls flown.
    pub flights: u32,
    /// Cost below which every cell of the swept manifold over the target was followed up.
    pub covered_to: f64,
    /// Least cost of a flight that undercuts V, if one does.
    pub bound: Option<f64>,
}

impl Survey<'_> {
    /// Flies from the targets, solves for what undercuts them, and notes what remains undercut.
    pub(in crate::value) fn check_by_flights(
        &mut self,
        solver: &mut Solver,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        self.bounds = vec![None; self.targets.len()];
        self.flights = vec![0; self.targets.len()];
        if self.plan.game {
            return Ok(());
        }
        let mut pilot = Pilot::new(self.plan)?;
        let neighbours = self.targets.neighbours();
        let mut open: Vec<usize> = (0..self.targets.len()).filter(|t| !self.at[*t].is_empty()).collect();
        for _ in 0..ROUNDS {
            let undercut = self.flown(solver, &mut pilot, &open, &neighbours)?;
            if undercut.is_empty() {
                break;
            }
            progress("undercut by flights", self.solved(), self.targets.len());
            open = self.solve_for(solver, undercut)?;
        }
        Ok(())
    }

    /// Cost below which nothing over a target was left out of the search.
    pub(in crate::value) fn covered_to(&self, target: usize) -> f64 {
        self.searched[target].min(self.uncovered[target])
    }

    /// Whether the search shows that nothing at a target costs less than what was found.
    pub(in crate::value) fn is_covered(&self, target: usize) -> bool {
        self.lowest(target)
            .is_some_and(|e| self.extremals[e].value() <= self.covered_to(target))
    }

    /// Flies from targets; those undercut, each with the cost and the way from the flight's path.
    fn flown(
        &mut self,
        solver: &mut Solver,
        pilot: &mut Pilot,
        targets: &[usize],
        neighbours: &[Vec<usize>],
    ) -> Result<Vec<(usize, f64, Errand)>, BackendError> {
        // The targets flown from, then those whose paths are flown along.
        let mut place = vec![usize::MAX; self.targets.len()];
        let mut claimed: Vec<usize> = targets.to_vec();
        for (k, t) in targets.iter().enumerate() {
            place[*t] = k;
        }
        let mut along: Vec<Vec<usize>> = Vec::with_capacity(targets.len());
        for &t in targets {
            let mut near = Vec::new();
            for &to in neighbours[t]
                .iter()
                .filter(|to| !self.is_covered(t) && !self.at[**to].is_empty())
            {
                if place[to] == usize::MAX {
                    place[to] = claimed.len();
                    claimed.push(to);
                }
                near.push(place[to]);
            }
            along.push(near);
        }
        let claims: Vec<Claim<'_>> = (claimed.iter().enumerate())
            .filter_map(|(k, t)| {
                let lowest = &self.extremals[self.lowest(*t)?];
                Some(Claim {
                    value: if k < targets.len() {
                        lowest.value()
                    } else {
                        f64::NEG_INFINITY
                    },
                    path: &lowest.path,
                    neighbours: along.get(k).cloned().unwrap_or_default(),
                })
            })
            .collect();
        let said = undercut(self.plan, pilot, solver, &claims, NEIGHBOURS)?;
        let mut found = Vec::new();
        for (&target, said) in targets.iter().zip(said) {
            self.flights[target] += said.flown as u32;
            let Some(path) = said.path else { continue };
            let winding = self.lowest(target).map_or(0, |e| self.extremals[e].winding);
            let way = Approach::new(path, self.state(target, winding), SHORT);
            let errand = Errand {
                from: None,
                target,
                winding,
                way,
            };
            found.push((target, said.cost, errand));
        }
        Ok(found)
    }

    /// Solves from the paths of flights. Targets that have a lower V now; the others keep the bound.
    fn solve_for(
        &mut self,
        solver: &mut Solver,
        undercut: Vec<(usize, f64, Errand)>,
    ) -> Result<Vec<usize>, BackendError> {
        let value = |this: &Self, t: usize| this.lowest(t).map_or(f64::INFINITY, |e| this.extremals[e].value());
        let before: Vec<(usize, f64, f64)> = (undercut.iter())
            .map(|(t, cost, _)| (*t, *cost, value(self, *t)))
            .collect();
        self.send(solver, undercut.into_iter().map(|(_, _, errand)| errand).collect())?;
        let mut lower = Vec::new();
        for (target, cost, before) in before {
            let now = value(self, target);
            self.bounds[target] = (now > cost * (1.0 + ABOVE)).then_some(cost);
            // The search had been told that there was nothing.
            self.uncovered[target] = self.uncovered[target].min(cost);
            if now < before {
                lower.push(target);
            }
        }
        Ok(lower)
    }

    /// What supports the least V at a target.
    pub fn support(&self, target: usize) -> Support {
        Support {
            starts: self.starts[target],
            flights: self.flights[target],
            covered_to: self.covered_to(target),
            bound: self.bounds[target],
        }
    }
}
