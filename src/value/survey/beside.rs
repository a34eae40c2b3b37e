//! Extremals of a finite horizon beside those that cells and marching give: along flights; and each
//! known one is followed away from its target in several directions, around the folds that its
//! sheet may have there, and back.

use super::spread::Effort;
use super::{MOST_SHEETS, Progress, Survey, Wanted, times};
use crate::backend::BackendError;
use crate::numeric::random::{random, uniform};
use crate::shooting::{Path, Solver};
use crate::value::extremal::Extremal;
use crate::value::flight::{Drifting, Flight, Law, Pilot, Terminal};
use crate::value::fold;
use crate::value::grow::{adjoint_rate, grown, with_adjoints};
use std::collections::BTreeMap;

/// How far, in widths of the region, and how many times what was found is followed again.
const REACH: f64 = 0.5;
const ROUNDS: usize = 2;
/// States of a system up to which this is done: there are twice as many directions.
const MOST_STATES: usize = 2;

/// Sizes of costates that flights are made under, in units of V's scale over a region's width.
const SIZES: [f64; 4] = [0.1, 0.4, 1.6, 6.4];
/// States of a system up to which flights are made under a costate along each axis.
const MOST_AXES: usize = 4;
/// Rounds of flights to a single state at most, and flights of a round under costates chosen at
/// random.
const FLIGHT_ROUNDS: u64 = 8;
const DRIFTING: [u64; 6] = [0, 32, 64, 128, 128, 32];
/// Flights of a round that are followed from their ends: the cheapest. Both by the number of
/// states.
const GROWN: [usize; 6] = [0, 16, 32, 64, 64, 8];
/// Extremals that cost at most this many times the least are counted; and the share by which a new
/// least is lower.
const ABOUT: f64 = 1.25;
const NEW: f64 = 1e-9;
/// Targets that are flown to together.
const TOGETHER: usize = 128;
/// The same of a grid; so many in turn without anything cheaper are enough, and so many in all. A state
/// is found cheaper by this share of its cost.
const SIDE_BY_SIDE: usize = 8;
const QUIET: usize = 64;
const MOST_LOOKED: usize = 512;
const CHEAPER: f64 = 1e-6;
/// Shortest steps, as shares of the way, from a flown path.
const FROM_FLIGHT: f64 = 1.0 / 16.0;

impl Survey<'_> {
    /// Guesses from flights on a finite horizon: under the terminal cost's gradient, which is the
    /// least effort; and to single states, in rounds, under costates that are constant or go from
    /// one to another. A round that finds something new among the cheapest is followed by another.
    pub(super) fn try_flights(&mut self, solver: &mut Solver) -> Result<(), BackendError> {
        let Some(law) = Terminal::new(self.plan).filter(|_| !self.plan.game) else {
            return Ok(());
        };
        let open: Vec<usize> = (0..self.targets.len())
            .filter(|t| !self.is_refused(*t))
            .collect();
        let mut pilot = Pilot::new(self.plan)?;
        let rate = adjoint_rate(self.plan);
        let mut tasks = Vec::new();
        for (target, _, path) in self.fly(&mut pilot, &open, &[&law])? {
            let end = path.segments();
            tasks.extend(self.task_along(target, with_adjoints(path, end, &rate), FROM_FLIGHT));
        }
        self.send(solver, tasks)?;
        let listed: Vec<usize> = open
            .into_iter()
            .filter(|t| !self.targets.gridded[*t])
            .collect();
        for part in listed.chunks(TOGETHER) {
            self.fly_variously(solver, &mut pilot, part)?;
        }
        Ok(())
    }

    /// The same to states of a grid, at random places, until so many in turn have nothing cheaper, or
    /// the first ones nothing new; what is found is tried at the neighbours.
    pub(super) fn fly_in_company(
        &mut self,
        solver: &mut Solver,
        wanted: Wanted,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        if self.plan.game || self.plan.system.terminal.is_none() {
            return Ok(());
        }
        let mut order: Vec<usize> = (0..self.targets.len())
            .filter(|t| self.targets.gridded[*t] && !self.is_refused(*t))
            .collect();
        if order.is_empty() {
            return Ok(());
        }
        let place = |t: &usize| uniform(*t as u64, 1);
        order.sort_by(|a, b| place(a).total_cmp(&place(b)));
        let mut pilot = Pilot::new(self.plan)?;
        let (mut quiet, mut looked, mut is_plain) = (0, 0, true);
        for together in order.chunks(SIDE_BY_SIDE) {
            let is_done =
                quiet >= QUIET || looked >= MOST_LOOKED || is_plain && looked >= SIDE_BY_SIDE;
            let now: Vec<usize> = (together.iter().copied())
                .filter(|t| !is_done || self.is_wanting(*t))
                .collect();
            if now.is_empty() {
                continue;
            }
            let before: Vec<(usize, f64)> = now.iter().map(|t| self.cheapest(*t)).collect();
            self.fly_variously(solver, &mut pilot, &now)?;
            looked += now.len();
            let after = now.iter().map(|t| self.cheapest(*t));
            let (mut is_new, mut is_cheaper) = (false, false);
            for (before, after) in before.iter().zip(after) {
                is_new |= after.0 > before.0;
                is_cheaper |= after.1 < times(1.0 - CHEAPER, before.1);
            }
            is_plain &= !is_new && !is_cheaper;
            if !is_cheaper {
                quiet += now.len();
                continue;
            }
            quiet = 0;
            self.spread(solver, wanted, Effort::Neighbours, progress)?;
            progress("from flights", self.solved(), self.targets.len());
        }
        Ok(())
    }

    /// Flights to some targets under various laws, in rounds, as long as one finds something new.
    fn fly_variously(
        &mut self,
        solver: &mut Solver,
        pilot: &mut Pilot,
        targets: &[usize],
    ) -> Result<(), BackendError> {
        let mut left = targets.to_vec();
        for round in 0..FLIGHT_ROUNDS {
            if left.is_empty() {
                break;
            }
            solver.deadline.check()?;
            let laws = self.various(round);
            let laws: Vec<&dyn Law> = laws.iter().map(|law| law as &dyn Law).collect();
            let before: Vec<(usize, f64)> = left.iter().map(|t| self.cheapest(*t)).collect();
            let paths = self.fly(pilot, &left, &laws)?;
            self.grow(solver, paths)?;
            let mut before = before.into_iter();
            left.retain(|t| {
                let after = self.cheapest(*t);
                before.next().is_some_and(|before| {
                    after.0 > before.0 || after.1 < times(1.0 - NEW, before.1)
                })
            });
        }
        Ok(())
    }

    /// Extremals of a target that cost about the least, and the least.
    fn cheapest(&self, target: usize) -> (usize, f64) {
        let least = self.least_value(target);
        let near = |e: &&usize| self.extremals[**e].value() <= times(ABOUT, least);
        (self.at[target].iter().filter(near).count(), least)
    }

    /// Flies from targets under laws: what each flight that came to the end costs, and its path.
    fn fly(
        &self,
        pilot: &mut Pilot,
        targets: &[usize],
        laws: &[&dyn Law],
    ) -> Result<Vec<(usize, f64, Path)>, BackendError> {
        let pairs = targets
            .iter()
            .flat_map(|t| laws.iter().map(move |law| (*t, *law)));
        let flights: Vec<Flight<'_>> = (pairs.clone())
            .map(|(t, law)| Flight {
                start: self.state(t, 0),
                law,
                ceiling: f64::INFINITY,
            })
            .collect();
        let flown = pairs.zip(pilot.fly(&flights)?);
        Ok(flown
            .filter_map(|((target, _), flown)| Some((target, flown.cost, flown.path?)))
            .collect())
    }

    /// Solves along the cheapest flights of each target, from their ends to their starts: as a
    /// whole they are rough guesses.
    fn grow(
        &mut self,
        solver: &mut Solver,
        mut paths: Vec<(usize, f64, Path)>,
    ) -> Result<(), BackendError> {
        let most = by_states(&GROWN, self.targets.states);
        paths.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let cheapest = paths
            .chunk_by(|a, b| a.0 == b.0)
            .flat_map(|of| of.iter().take(most));
        let (targets, flown): (Vec<usize>, Vec<Path>) =
            cheapest.map(|(t, _, path)| (*t, path.clone())).unzip();
        let mut solved: BTreeMap<usize, Vec<(f64, Path)>> = BTreeMap::new();
        for (target, (path, evaluations)) in
            targets.into_iter().zip(grown(self.plan, solver, flown)?)
        {
            self.evaluations += u64::from(evaluations);
            self.starts[target] += 1;
            if let Some((path, value)) = path {
                solved.entry(target).or_default().push((value, path));
            }
        }
        // Of many extremals the cheapest are of interest: they are added in rising cost, those of
        // all targets side by side.
        for of in solved.values_mut() {
            of.sort_by(|a, b| a.0.total_cmp(&b.0));
            of.reverse();
        }
        while !solved.is_empty() {
            let mut tasks = Vec::new();
            for (target, of) in &mut solved {
                let Some((value, path)) = of.pop() else {
                    continue;
                };
                let few = self.at[*target].len() < MOST_SHEETS;
                if few || value <= times(ABOUT, self.least_value(*target)) {
                    tasks.extend(self.task_along(*target, path, FROM_FLIGHT));
                }
            }
            self.send(solver, tasks)?;
            solved.retain(|_, of| !of.is_empty());
        }
        Ok(())
    }

    /// Costates of a round: in the first one along each axis, of several sizes and either sign; in
    /// all pairs of them at random, the same for every state.
    fn various(&self, round: u64) -> Vec<Drifting> {
        let (n, plan) = (self.targets.states, self.plan);
        let time = plan.system.terminal.as_ref().map_or(1.0, |t| t.time);
        let scaled = |p: Vec<f64>| -> Vec<f64> {
            (p.iter().zip(&plan.widths))
                .map(|(p, w)| p * plan.value_scale / w)
                .collect()
        };
        let law = |from: Vec<f64>, to: Vec<f64>| Drifting {
            from: scaled(from),
            to: scaled(to),
            time,
        };
        let mut laws = Vec::new();
        let axes = if round == 0 && n <= MOST_AXES { n } else { 0 };
        for (i, size) in (0..axes)
            .flat_map(|i| SIZES.map(|z| [(i, -z), (i, z)]))
            .flatten()
        {
            let mut p = vec![0.0; n];
            p[i] = size;
            laws.push(law(p.clone(), p));
        }
        let count = by_states(&DRIFTING, n);
        for k in round * count..(round + 1) * count {
            let costate = |end: u64| -> Vec<f64> {
                let size = SIZES[(random(1, 2 * k + end) % SIZES.len() as u64) as usize];
                let numbers = (0..n as u64).map(|i| uniform(0, (2 * k + end) * n as u64 + i));
                numbers.map(|x| size * (2.0 * x - 1.0)).collect()
            };
            laws.push(law(costate(0), costate(1)));
        }
        laws
    }

    /// Cells do not show extremals whose trajectories part too fast backward in time; their sheets
    /// join in folds.
    pub(super) fn try_folds_beside(&mut self, solver: &mut Solver) -> Result<(), BackendError> {
        let n = self.targets.states;
        if self.plan.system.terminal.is_none() || n > MOST_STATES {
            return Ok(());
        }
        let mut first = 0;
        for _ in 0..ROUNDS {
            let last = self.extremals.len();
            let (mut owners, mut edges) = (Vec::new(), Vec::new());
            for e in first..last {
                let extremal = &self.extremals[e];
                if self.at[extremal.target].len() >= MOST_SHEETS
                    || self.targets.gridded[extremal.target]
                {
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
                let Some((job, solved)) = found.at_start else {
                    continue;
                };
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

/// An entry by the number of states; the last one for all above.
fn by_states<T: Copy>(list: &[T], states: usize) -> T {
    list[states.min(list.len() - 1)]
}
