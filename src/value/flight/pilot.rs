//! Flying: each thread flies some of the flights as one batch, period by period.

use super::course::{Air, Course};
use super::equations::Equations;
use super::{Flight, FlightEnd, Flown, costate};
use crate::backend::{BackendError, Deadline, Kernel, Legs, Status, Trajectories};
use crate::sweep::Plan;
use rayon::prelude::*;

/// Parts that the flights of a thread are divided into, and flights of a part at least and at most:
/// lanes are to be filled, and threads to be done together.
const PARTS: usize = 4;
const FEWEST: usize = 16;
const MOST: usize = 256;

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
    /// [`BackendError::OutOfTime`] only; a flight that does not come home has its [`FlightEnd`].
    pub fn fly(&mut self, flights: &[Flight<'_>]) -> Result<Vec<Flown>, BackendError> {
        let legs = (self.kernel.legs(&self.equations.run))
            .expect("a kernel of the CPU without stored samples has legs");
        let crew = Crew {
            legs: legs.as_ref(),
            equations: &self.equations,
            course: &self.course,
            deadline: self.deadline,
        };
        // Each thread flies its own, with no waiting for the others.
        let each = (flights.len() / (PARTS * rayon::current_num_threads())).clamp(FEWEST, MOST);
        let parts: Vec<Log> = (flights.par_chunks(each))
            .map(|part| crew.fly(part))
            .collect::<Result<_, _>>()?;
        let mut flown = Vec::with_capacity(flights.len());
        for part in parts {
            self.steps += part.steps;
            self.periods += part.periods;
            flown.extend(part.flown.into_iter().flatten());
        }
        Ok(flown)
    }
}

/// What a thread flies with.
struct Crew<'a> {
    legs: &'a dyn Legs,
    equations: &'a Equations,
    course: &'a Course,
    deadline: Deadline,
}

/// What became of some flights.
struct Log {
    flown: Vec<Option<Flown>>,
    steps: u64,
    periods: u64,
}

impl Crew<'_> {
    fn fly(&self, flights: &[Flight<'_>]) -> Result<Log, BackendError> {
        let mut air: Vec<Air> = (flights.iter().enumerate())
            .map(|(k, flight)| Air::new(k, &flight.start, self.course.first))
            .collect();
        let mut log = Log {
            flown: flights.iter().map(|_| None).collect(),
            steps: 0,
            periods: 0,
        };
        let (mut seeds, mut batch) = (Vec::new(), Trajectories::default());
        loop {
            air.retain_mut(|air| match self.course.steer(air, &flights[air.flight]) {
                Some(result) => {
                    log.flown[air.flight] = Some(result);
                    false
                }
                None => true,
            });
            if air.is_empty() {
                return Ok(log);
            }
            self.deadline.check()?;
            self.advance(&mut air, &mut seeds, &mut batch);
            log.steps += batch.steps.iter().map(|s| u64::from(*s)).sum::<u64>();
            log.periods += air.len() as u64;
            let mut status = batch.status.iter();
            air.retain(|air| {
                let end = match status.next() {
                    Some(Status::Reached) | None => return true,
                    Some(Status::Guard) => FlightEnd::LeftGuard,
                    Some(_) => FlightEnd::Failed,
                };
                log.flown[air.flight] = Some(Flown::failed(end));
                false
            });
        }
    }

    /// Integrates a period of all flights.
    fn advance(&self, air: &mut [Air], seeds: &mut Vec<f64>, batch: &mut Trajectories) {
        seeds.clear();
        // Whole periods are left out of the state.
        let n = air[0].s.len();
        let turns: Vec<f64> = air
            .iter()
            .flat_map(|air| self.course.turns(&air.s))
            .collect();
        let mut s = Vec::new();
        for (air, turns) in air.iter().zip(turns.chunks_exact(n)) {
            let (q, h) = air.law.as_ref().expect("its law was asked");
            s.clear();
            s.extend(air.s.iter().zip(turns).map(|(s, turn)| s - turn));
            let q = costate(q, h, turns);
            let (duration, _) = self.course.next(air);
            (self.equations).seed(&s, (&q, h), (duration, self.course.unit(air)), seeds);
        }
        self.legs.integrate(seeds, batch);
        let ends = batch.end.chunks_exact(batch.dim);
        for ((air, turns), end) in air.iter_mut().zip(turns.chunks_exact(n)).zip(ends) {
            air.t = self.course.next(air).1;
            let (s, cost) = self.equations.read(end);
            for ((to, s), turn) in air.s.iter_mut().zip(s).zip(turns) {
                *to = s + turn;
            }
            air.cost += cost;
            air.periods += 1;
        }
    }
}
