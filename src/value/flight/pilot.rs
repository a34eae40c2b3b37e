//! Flying: all flights that are in the air go as one batch, period by period.

use super::course::{Air, Course};
use super::equations::Equations;
use super::{Flight, FlightEnd, Flown, costate};
use crate::backend::{BackendError, Deadline, Kernel, Status, batch_limit};
use crate::sweep::Plan;
use rayon::prelude::*;

/// Flies batches of flights of one scene.
pub struct Pilot {
    equations: Equations,
    kernel: Box<dyn Kernel>,
    course: Course,
    /// Accepted steps, and periods, of all flights so far.
    pub steps: u64,
    pub periods: u64,
    /// The plan's.
    deadline: Deadline,
}

impl Pilot {
    /// # Errors
    /// When the kernel cannot be compiled.
    pub fn new(plan: &Plan) -> Result<Self, BackendError> {
        Self::with_periods(plan, 1.0)
    }

    /// Flies in periods `fine` times as long as usual: closer to the laws, and more slowly.
    ///
    /// # Errors
    /// When the kernel cannot be compiled.
    pub fn with_periods(plan: &Plan, fine: f64) -> Result<Self, BackendError> {
        let equations = Equations::new(plan);
        Ok(Self {
            kernel: equations.compile()?,
            equations,
            course: Course::new(plan, fine),
            steps: 0,
            periods: 0,
            deadline: plan.deadline,
        })
    }

    /// Flies. A flight's result does not depend on the others.
    ///
    /// # Errors
    /// Device failures only; a flight that does not come home has its [`FlightEnd`].
    pub fn fly(&mut self, flights: &[Flight<'_>]) -> Result<Vec<Flown>, BackendError> {
        let mut air: Vec<Air> = (flights.iter().enumerate())
            .map(|(k, flight)| Air::new(k, &flight.start, self.course.first))
            .collect();
        let mut flown: Vec<Option<Flown>> = flights.iter().map(|_| None).collect();
        loop {
            let course = &self.course;
            let asked: Vec<Option<Flown>> = (air.par_iter_mut())
                .map(|air| course.steer(air, &flights[air.flight]))
                .collect();
            let mut asked = asked.into_iter();
            air.retain(|air| match asked.next().flatten() {
                Some(result) => {
                    flown[air.flight] = Some(result);
                    false
                }
                None => true,
            });
            if air.is_empty() {
                break;
            }
            let ends = self.advance(&mut air)?;
            let mut ends = ends.into_iter();
            air.retain(|air| match ends.next().flatten() {
                Some(end) => {
                    flown[air.flight] = Some(Flown::failed(end));
                    false
                }
                None => true,
            });
        }
        Ok(flown.into_iter().flatten().collect())
    }

    /// Integrates a period of all flights; the ends of those that failed.
    fn advance(&mut self, air: &mut [Air]) -> Result<Vec<Option<FlightEnd>>, BackendError> {
        self.deadline.check()?;
        let dim = self.equations.spec.dim();
        let mut ends = Vec::with_capacity(air.len());
        for part in air.chunks_mut(batch_limit(dim, 0)) {
            let turns: Vec<Vec<f64>> = part.iter().map(|air| self.course.turns(&air.s)).collect();
            let seeds: Vec<f64> = (part.iter().zip(&turns))
                .filter_map(|(air, turns)| Some(self.seed(air, air.law.as_ref()?, turns)))
                .flatten()
                .collect();
            let batch = self.kernel.integrate(&self.equations.run, &seeds)?;
            self.steps += batch.steps.iter().map(|s| u64::from(*s)).sum::<u64>();
            self.periods += part.len() as u64;
            for (i, air) in part.iter_mut().enumerate() {
                air.t = self.course.next(air).1;
                let (s, cost) = self.equations.read(&batch.end[i * dim..][..dim]);
                air.s = s.iter().zip(&turns[i]).map(|(s, turn)| s + turn).collect();
                air.cost += cost;
                air.periods += 1;
                ends.push(match batch.status[i] {
                    Status::Reached => None,
                    Status::Guard => Some(FlightEnd::LeftGuard),
                    _ => Some(FlightEnd::Failed),
                });
            }
        }
        Ok(ends)
    }

    /// The vector of a flight's next period, with whole periods left out of the state.
    fn seed(&self, air: &Air, (q, h): &(Vec<f64>, Vec<f64>), turns: &[f64]) -> Vec<f64> {
        let s: Vec<f64> = air.s.iter().zip(turns).map(|(s, turn)| s - turn).collect();
        let moved = (costate(q, h, turns), h.clone());
        let (duration, _) = self.course.next(air);
        self.equations
            .seed(&s, &moved, duration, self.course.unit(air))
    }
}
