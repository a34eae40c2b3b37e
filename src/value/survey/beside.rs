//! Further extremals of a finite horizon: each known one is followed away from its target in several directions, around the
//! folds that its sheet may have there, and back.

use super::{Errand, MOST_SHEETS, Survey};
use crate::backend::BackendError;
use crate::shooting::Solver;
use crate::value::extremal::Extremal;
use crate::value::flight::{Constant, Flight, Flown, Law, Pilot, Terminal};
use crate::value::fold;
use crate::value::grow::{adjoint_rate, with_adjoints};

/// How far, in widths of the region, and how many times what was found is followed again.
const REACH: f64 = 0.5;
const ROUNDS: usize = 2;
/// States of a system up to which this is done: there are twice as many directions.
const MOST_STATES: usize = 2;

/// Sizes of constant costates, in units of V's scale over a region's width.
const SIZES: [f64; 4] = [0.1, 0.4, 1.6, 6.4];
/// Shortest steps, as shares of the way, from a flown path.
const FROM_FLIGHT: f64 = 1.0 / 16.0;

impl Survey<'_> {
    /// Guesses from flights: under the terminal cost's gradient, which is the least effort, and to single states under
    /// constant costates of either sign; each with the adjoints that belong to its states.
    pub(super) fn try_flights(&mut self, solver: &mut Solver) -> Result<(), BackendError> {
        let n = self.targets.states;
        let Some(law) = Terminal::new(self.plan).filter(|_| n <= MOST_STATES) else {
            return Ok(());
        };
        let mut constant = Vec::new();
        for (i, size, sign) in (0..n).flat_map(|i| SIZES.into_iter().flat_map(move |z| [(i, z, -1.0), (i, z, 1.0)])) {
            let mut p = vec![0.0; n];
            p[i] = sign * size * self.plan.value_scale / self.plan.widths[i];
            constant.push(Constant { p });
        }
        let open: Vec<usize> = (0..self.targets.len()).filter(|t| !self.is_refused(*t)).collect();
        let mut flights: Vec<(usize, &dyn Law)> = open.iter().map(|t| (*t, &law as &dyn Law)).collect();
        for target in open.into_iter().filter(|t| !self.targets.gridded[*t]) {
            flights.extend(constant.iter().map(|law| (target, law as &dyn Law)));
        }
        let errands = self.flown_guesses(&flights)?;
        self.send(solver, errands)?;
        Ok(())
    }

    /// Flies from targets under laws; what came to the end gives guesses.
    fn flown_guesses(&mut self, wanted: &[(usize, &dyn Law)]) -> Result<Vec<Errand>, BackendError> {
        let flights: Vec<Flight<'_>> = (wanted.iter())
            .map(|(t, law)| Flight {
                start: self.state(*t, 0),
                law: *law,
                ceiling: f64::INFINITY,
            })
            .collect();
        let flown = Pilot::new(self.plan)?.fly(&flights)?;
        let rate = adjoint_rate(self.plan);
        let guess = |((target, _), flown): (&(usize, &dyn Law), Flown)| {
            let path = flown.path?;
            let end = path.segments();
            self.errand_along(*target, with_adjoints(path, end, &rate), FROM_FLIGHT)
        };
        Ok(wanted.iter().zip(flown).filter_map(guess).collect())
    }

    /// Cells do not show extremals whose trajectories part too fast backward in time; their sheets join in folds.
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
