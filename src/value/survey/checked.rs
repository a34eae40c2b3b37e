//! Whether any control that is known costs less than the least V found: laws are flown from every
//! solved target.

use super::{Lost, Progress, SHORT, Survey, times};
use crate::backend::BackendError;
use crate::shooting::{Path, Solver};
use crate::value::direct::Optimized;
use crate::value::extremal::{expected_value, misfit};
use crate::value::flight::{Claim, Pilot, along_itself, precise, tolerance, undercut};
use crate::value::grow::{adjoint_rate, with_adjoints};
use rayon::prelude::*;

/// Rounds in which what undercut a target was solved for.
const ROUNDS: usize = 4;
/// Neighbours along whose paths is flown to a target.
const NEIGHBOURS: usize = 3;
/// A neighbour leads one to expect less where its sheet, continued, is this share of its change
/// below.
const CLEARLY: f64 = 0.05;
/// A solution found from a flight's path is its own where it costs at most this much more.
const ABOVE: f64 = 1e-6;

/// A flight that costs less than the least V of a target.
struct Undercutting {
    target: usize,
    cost: f64,
    path: Path,
    /// Whether it was tried to solve along it before.
    is_tried: bool,
}

/// How well it is supported that the least V found at a target is the least there is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Support {
    /// First guesses tried.
    pub starts: u32,
    /// Controls flown.
    pub flights: u32,
    /// Cost below which every cell of the swept manifold over the target was followed up.
    pub covered_to: f64,
    /// Least cost of a flight that undercuts V, if one does.
    pub bound: Option<f64>,
    /// Cost of a flight along the answer itself, of states that were listed; infinite where it did
    /// not come home.
    pub flown: Option<f64>,
}

impl Survey<'_> {
    /// Flies from the targets, solves for what undercuts them, and notes what remains undercut.
    pub(in crate::low_level::value) fn check_by_flights(
        &mut self,
        solver: &mut Solver,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        self.bounds = vec![None; self.targets.len()];
        self.flights = vec![0; self.targets.len()];
        self.flown = vec![None; self.targets.len()];
        if self.plan.game {
            return Ok(());
        }
        let mut pilot = Pilot::new(self.plan)?;
        let neighbours = self.targets.neighbours();
        let mut open: Vec<usize> = (0..self.targets.len())
            .filter(|t| !self.at[*t].is_empty())
            .collect();
        for _ in 0..ROUNDS {
            let undercut = self.flown(solver, &mut pilot, &open, &neighbours)?;
            if undercut.is_empty() {
                break;
            }
            progress("undercut by flights", self.solved(), self.targets.len());
            open = self.solve_for(solver, undercut)?;
            open.extend(self.lowered_by_images(solver)?);
        }
        let mut listed: Vec<usize> = (0..self.targets.len())
            .filter(|t| !self.targets.gridded[*t])
            .collect();
        if listed.is_empty() {
            return Ok(());
        }
        let mut pilot = precise(self.plan)?;
        for _ in 0..ROUNDS {
            let undercut = self.fly_itself(solver, &mut pilot, &listed)?;
            if undercut.is_empty() {
                break;
            }
            progress("undercut by flights", self.solved(), self.targets.len());
            listed = self.solve_for(solver, undercut)?;
        }
        Ok(())
    }

    /// Targets that have a lower V from mirror images of what was found.
    fn lowered_by_images(&mut self, solver: &mut Solver) -> Result<Vec<usize>, BackendError> {
        if !self.hands_on() {
            return Ok(Vec::new());
        }
        let lower = self.with_direct(|survey, direct| survey.solve_images(solver, direct))?;
        let lower = lower.unwrap_or_default();
        for target in &lower {
            let value = self.least_value(*target);
            let bound = &mut self.bounds[*target];
            *bound = bound.filter(|bound| value > times(1.0 + ABOVE, *bound));
        }
        Ok(lower)
    }

    /// Flies along the answers at targets; those undercut, as they part from their answer for
    /// something cheaper.
    fn fly_itself(
        &mut self,
        solver: &mut Solver,
        pilot: &mut Pilot,
        targets: &[usize],
    ) -> Result<Vec<Undercutting>, BackendError> {
        let solved: Vec<(usize, usize)> = (targets.iter())
            .filter_map(|t| Some((*t, self.lowest(*t)?)))
            .collect();
        let claims: Vec<Claim<'_>> = (solved.iter())
            .map(|(_, e)| Claim {
                value: self.extremals[*e].value(),
                path: &self.extremals[*e].path,
                neighbours: Vec::new(),
            })
            .collect();
        let flown = along_itself(self.plan, pilot, solver, &claims)?;
        let mut undercut = Vec::new();
        for ((target, e), flown) in solved.into_iter().zip(flown) {
            self.flown[target] = Some(flown.cost);
            self.flights[target] += 1;
            let least = self.extremals[e].value() - tolerance(self.plan, self.extremals[e].value());
            if let Some(path) = flown.path.filter(|_| flown.cost < least) {
                undercut.push(Undercutting {
                    target,
                    cost: flown.cost,
                    path,
                    is_tried: false,
                });
            }
        }
        self.admissible(solver, undercut)
    }

    /// Those whose flights stay inside the guards: a flight looks at them at the ends of its steps,
    /// and may leap over what is thin.
    fn admissible(
        &self,
        solver: &mut Solver,
        undercut: Vec<Undercutting>,
    ) -> Result<Vec<Undercutting>, BackendError> {
        let paths: Vec<&Path> = undercut.iter().map(|u| &u.path).collect();
        let valid = self.valid(solver, &paths)?;
        Ok((undercut.into_iter().zip(valid))
            .filter_map(|(undercut, valid)| valid.then_some(undercut))
            .collect())
    }

    /// Cost below which nothing over a target was left out of the search. Nothing is shown on a
    /// finite horizon: the image of a cell of terminal states may be folded where none of its
    /// corners tells.
    pub(in crate::low_level::value) fn covered_to(&self, target: usize) -> f64 {
        if self.plan.system.terminal.is_some() || self.stopped {
            return f64::NEG_INFINITY;
        }
        self.searched[target].min(self.uncovered[target])
    }

    /// Whether the search shows that nothing at a target costs less than what was found.
    pub(in crate::low_level::value) fn is_covered(&self, target: usize) -> bool {
        self.lowest(target)
            .is_some_and(|e| self.extremals[e].value() <= self.covered_to(target))
    }

    /// Whether the way along a neighbour's solution may cost less than what was found: where the
    /// search was not complete and the two are not known to be of one smooth sheet, or the
    /// neighbour's sheet leads one to expect it.
    fn may_undercut(&self, neighbour: usize, target: usize) -> bool {
        let (Some(from), Some(e)) = (self.lowest(neighbour), self.lowest(target)) else {
            return false;
        };
        let (from, e) = (&self.extremals[from], &self.extremals[e]);
        let fits = || from.winding == e.winding && misfit(from, e, &self.scales) < 1.0;
        let there = self.state(target, from.winding);
        (!self.is_covered(target) && !fits())
            || expected_value(from, &there, &self.scales)
                .is_some_and(|(value, change)| value < e.value() - CLEARLY * change)
    }

    /// Flies from targets; those undercut, each with the cost and the way from the flight's path.
    fn flown(
        &mut self,
        solver: &mut Solver,
        pilot: &mut Pilot,
        targets: &[usize],
        neighbours: &[Vec<usize>],
    ) -> Result<Vec<Undercutting>, BackendError> {
        // The targets flown from, then those whose paths are flown along.
        let mut place = vec![usize::MAX; self.targets.len()];
        let mut claimed: Vec<usize> = targets.to_vec();
        for (k, t) in targets.iter().enumerate() {
            place[*t] = k;
        }
        let mut along: Vec<Vec<usize>> = Vec::with_capacity(targets.len());
        for &t in targets {
            let mut near = Vec::new();
            for &to in neighbours[t].iter().filter(|to| self.may_undercut(**to, t)) {
                if place[to] == usize::MAX {
                    place[to] = claimed.len();
                    claimed.push(to);
                }
                near.push(place[to]);
            }
            along.push(near);
        }
        let mut claims: Vec<Claim<'_>> = (claimed.iter().enumerate())
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
        // What was optimized and not solved for comes first.
        for (target, Lost { path, .. }) in &self.lost {
            let k = place[*target];
            if k >= targets.len() {
                continue;
            }
            let lost = claims.len();
            claims[k].neighbours.insert(0, lost);
            claims.push(Claim {
                value: f64::NEG_INFINITY,
                path,
                neighbours: Vec::new(),
            });
        }
        let said = undercut(self.plan, pilot, solver, &claims, NEIGHBOURS)?;
        let mut found = Vec::new();
        for (&target, said) in targets.iter().zip(said) {
            self.flights[target] += said.flown as u32;
            // The controls that were optimized are simulated on their own steps, too.
            let least = self.least_value(target);
            let attained = self.lost.get(&target).and_then(|lost| {
                let cost = lost.attained?;
                let is_cheaper = cost < least - tolerance(self.plan, least) && cost < said.cost;
                is_cheaper.then(|| (cost, lost.path.clone()))
            });
            let is_tried = attained.is_some();
            let flown = said.path.map(|path| (said.cost, path));
            let Some((cost, path)) = attained.or(flown) else {
                continue;
            };
            found.push(Undercutting {
                target,
                cost,
                path,
                is_tried,
            });
        }
        self.admissible(solver, found)
    }

    /// Solves from the paths of flights. Targets that have a lower V now; the others keep the
    /// bound.
    fn solve_for(
        &mut self,
        solver: &mut Solver,
        undercut: Vec<Undercutting>,
    ) -> Result<Vec<usize>, BackendError> {
        let before: Vec<f64> = undercut
            .iter()
            .map(|u| self.least_value(u.target))
            .collect();
        // With the costates that the laws gave, and with those that belong to the states.
        let rate = adjoint_rate(self.plan);
        let hands_on = self.hands_on() && self.direct.is_some();
        if hands_on {
            self.smooth(solver, &undercut)?;
        }
        let mut tasks = Vec::new();
        let open: Vec<&Undercutting> = (undercut.iter())
            .filter(|u| !u.is_tried && !hands_on)
            .collect();
        for u in &open {
            let carried = with_adjoints(u.path.clone(), u.path.segments(), &rate);
            for path in [u.path.clone(), carried] {
                tasks.extend(self.task_along(u.target, path, SHORT));
            }
        }
        self.send(solver, tasks)?;
        // What is too rough a guess as a whole is followed from its end.
        let rough = open.into_iter().filter(|u| self.is_undercut(u));
        let rough = rough.map(|u| (u.target, u.path.clone())).collect();
        self.send_grown(solver, rough, SHORT)?;
        let mut lower = Vec::new();
        for (u, before) in undercut.iter().zip(before) {
            self.bounds[u.target] = self.is_undercut(u).then_some(u.cost);
            // The search had been told that there was nothing.
            self.uncovered[u.target] = self.uncovered[u.target].min(u.cost);
            if self.least_value(u.target) < before {
                lower.push(u.target);
            }
        }
        Ok(lower)
    }

    /// Solves from what flights come to by direct optimization: in many dimensions their paths are too
    /// rough for Newton's method, and long to follow from their ends.
    fn smooth(
        &mut self,
        solver: &mut Solver,
        undercut: &[Undercutting],
    ) -> Result<(), BackendError> {
        self.with_direct(|survey, direct| {
            let end = &solver.scheme.end;
            let found: Vec<(usize, Optimized)> = (undercut.par_iter().filter(|u| !u.is_tried))
                .filter_map(|u| Some((u.target, direct.smoothed(&u.path, u.cost, end)?)))
                .collect();
            solver.deadline.check()?;
            survey.solve_from(solver, direct, found)
        })?;
        Ok(())
    }

    fn is_undercut(&self, by: &Undercutting) -> bool {
        self.least_value(by.target) > times(1.0 + ABOVE, by.cost)
    }

    pub(super) fn least_value(&self, target: usize) -> f64 {
        self.lowest(target)
            .map_or(f64::INFINITY, |e| self.extremals[e].value())
    }

    /// What supports the least V at a target.
    pub fn support(&self, target: usize) -> Support {
        Support {
            starts: self.starts[target],
            flights: self.flights[target],
            covered_to: self.covered_to(target),
            bound: self.bounds[target],
            flown: self.flown[target],
        }
    }
}
