//! Trajectories under the law of a chart: `p = q + H s`, set leg by leg at each trajectory's state.
//!
//! The CPU's lanes ask the chart as they go, each trajectory at times of its own (`legs`). A device
//! asks a map in pieces itself (`relayed`); games, whose answers are checked one by one, charts
//! that are no map in pieces, and maps larger than a device's buffers are asked here, with a round
//! trip a leg.

use super::equations::{Equations, set_chart};
use super::fallback::{Help, Plan, Rest};
use super::flights::{Starts, Watch};
use super::legs::Journey;
use super::simulate::{Batch, Ground, OUTSIDE_MAP};
use super::{Chart, Expansions, LoopError};
use crate::backend::{BackendError, Kernel, Legs, Relay, Run, Trajectories};
use crate::model::{ClosedLoop, Outside};
use rayon::prelude::*;

/// Trajectories that one thread flies from their start to their end: few enough to balance the
/// load, many enough that the kernel's lanes are full, also with the few that the chart has no
/// answer for.
const PART: usize = 1024;
/// Longest share of the final time over which the last answer is held for want of anything better,
/// unless that is the policy.
const HOLD: f64 = 0.25;
/// Attempted steps that a leg may take, however many legs there are.
const LEAST_STEPS: u32 = 10_000;

/// What flies trajectories over legs.
pub(super) struct Wings<'k> {
    by: By<'k>,
    run: &'k Run,
    /// Whether the kernel's vectors have the leg's length before J; else it is the run's.
    timed: bool,
    /// Flights of whole batches.
    pub trips: usize,
    seeds: Vec<f64>,
}

enum By<'k> {
    /// On this thread.
    Own(&'k dyn Legs),
    /// A batch as a whole.
    Whole(&'k mut dyn Kernel),
}

impl<'k> Wings<'k> {
    fn new(by: By<'k>, run: &'k Run, timed: bool) -> Self {
        Self {
            by,
            run,
            timed,
            trips: 0,
            seeds: Vec::new(),
        }
    }

    /// Flies trajectories from vectors of `dim` components, each over its length.
    pub fn fly(
        &mut self,
        (vectors, dim): (&[f64], usize),
        length: impl Fn(usize) -> f64,
        to: &mut Trajectories,
    ) -> Result<(), BackendError> {
        if self.timed {
            self.seeds.clear();
            for (j, vector) in vectors.chunks_exact(dim).enumerate() {
                self.seeds.extend_from_slice(&vector[..dim - 1]);
                self.seeds.extend([length(j), vector[dim - 1]]);
            }
        }
        let seeds = if self.timed { &self.seeds } else { vectors };
        match &mut self.by {
            By::Own(legs) => legs.integrate(seeds, to),
            By::Whole(kernel) => {
                *to = kernel.integrate(self.run, seeds)?;
                self.trips += 1;
            }
        }
        if self.timed {
            for j in 0..to.count() {
                to.end_time[j] *= length(j);
                let from = j * (dim + 1);
                to.end.copy_within(from..from + dim - 1, j * dim);
                to.end[j * dim + dim - 1] = to.end[from + dim];
            }
            to.end.truncate(to.count() * dim);
            to.dim = dim;
        }
        Ok(())
    }
}

/// Times between updates that are all the same.
#[derive(Clone, Copy)]
pub(super) struct Clock {
    pub step: f64,
    /// Updates between samples, and all.
    pub updates: usize,
    pub all: usize,
}

impl Clock {
    /// Of a period, or else a sample's interval.
    pub fn of(scene: &ClosedLoop) -> Self {
        let sampling = scene.interval();
        let updates = scene
            .period
            .map_or(1, |p| (sampling / p - 1e-9).ceil().max(1.0) as usize);
        Self {
            step: sampling / updates as f64,
            updates,
            all: scene.samples * updates,
        }
    }
}

/// What is known of a batch's trajectories from one update of their law to the next.
pub(super) struct Pilots<'p> {
    pub chart: &'p dyn Chart,
    pub outside: Outside,
    pub asked: Asked,
    patience: usize,
    room: Expansions,
    plans: Vec<Option<Plan>>,
    waited: Vec<usize>,
}

impl Pilots<'_> {
    /// Notes that the chart had an answer.
    pub fn found(&mut self, i: usize) {
        (self.plans[i], self.waited[i]) = (None, 0);
    }
}

/// When some trajectories get their laws.
pub(super) struct When<'t> {
    /// Each one's time.
    pub t: &'t dyn Fn(usize) -> f64,
    /// The legs of one that the chart has no answer for, and the length of each one's first.
    pub rest: Rest,
    pub first: &'t dyn Fn(usize) -> f64,
}

impl Ground<'_> {
    /// What legs of these equations are flown with: in units of their own lengths where they are
    /// timed.
    pub fn leg(&self, equations: &Equations, timed: bool) -> Run {
        let clock = Clock::of(self.setting.closed_loop);
        let length = if timed { 1.0 } else { clock.step };
        let mut run = self.run(equations, vec![length]);
        run.step *= length / clock.step;
        // The trajectory's limit is its legs' together; one that is stuck does not hold up its
        // neighbours for all of it.
        run.max_steps = (run.max_steps / clock.all as u32).max(LEAST_STEPS);
        // A leg is short: mostly one step takes it.
        run.first = Some(length);
        run
    }

    /// Flies a batch. Where the kernel can, each thread takes trajectories from start to end,
    /// asking the chart as it goes; a device that asks itself takes the batch as a whole.
    pub fn by_chart(
        &self,
        kernel: &mut dyn Kernel,
        relay: Option<&mut (dyn Relay + '_)>,
        (x0, first, starts): (&[f64], usize, Starts<'_>),
        chart: &dyn Chart,
        watch: &mut Option<Watch<'_>>,
    ) -> Result<Batch, LoopError> {
        let count = x0.len() / self.equations.states;
        let timed = self.timed.is_some();
        let run = self.leg(self.timed.as_ref().unwrap_or(&self.equations), timed);
        if let Some(relay) = relay {
            let mut batch = self.batch(x0, first, starts);
            let wings = Wings::new(By::Whole(kernel), &run, false);
            self.by_relay(
                (relay, &run),
                wings,
                self.pilots(chart, count),
                &mut batch,
                watch,
            )?;
            return Ok(batch);
        }
        if watch.is_none()
            && let Some(legs) = kernel.legs(&run)
        {
            let size = count
                .div_ceil(2 * rayon::current_num_threads())
                .clamp(16, PART);
            let parts: Vec<Batch> = (x0.par_chunks(size * self.equations.states).enumerate())
                .map(|(k, x0)| {
                    let mut part = self.batch(x0, first + k * size, starts);
                    let pilots = self.pilots(chart, x0.len() / self.equations.states);
                    let mut wings = Wings::new(By::Own(legs.as_ref()), &run, timed);
                    Journey::new(self, pilots, &mut part, false).fly(&mut wings, &mut None)?;
                    Ok(part)
                })
                .collect::<Result<_, BackendError>>()?;
            let mut parts = parts.into_iter();
            let mut all = parts
                .next()
                .unwrap_or_else(|| self.batch(&[], first, starts));
            parts.for_each(|part| all.append(part));
            return Ok(all);
        }
        let mut batch = self.batch(x0, first, starts);
        let mut wings = Wings::new(By::Whole(kernel), &run, timed);
        let pilots = self.pilots(chart, count);
        Journey::new(self, pilots, &mut batch, watch.is_some()).fly(&mut wings, watch)?;
        batch.round_trips += wings.trips;
        Ok(batch)
    }

    fn pilots<'p>(&self, chart: &'p dyn Chart, count: usize) -> Pilots<'p> {
        // Under a forcing V certifies nothing but where it is known.
        let outside = match self.equations.supplied() {
            Some(_) => Outside::Stop,
            None => self.setting.closed_loop.outside,
        };
        Pilots {
            chart,
            outside,
            asked: Asked::default(),
            patience: match outside {
                Outside::Hold => usize::MAX,
                _ => (HOLD * Clock::of(self.setting.closed_loop).all as f64) as usize,
            },
            room: Expansions::default(),
            plans: vec![None; count],
            waited: vec![0; count],
        }
    }

    /// Asks the chart at trajectories, all at one time, and sets their laws.
    pub fn update(
        &self,
        wings: &mut Wings<'_>,
        pilots: &mut Pilots<'_>,
        batch: &mut Batch,
        watch: &mut Option<Watch<'_>>,
        (when, lanes): (&When<'_>, &[usize]),
    ) -> Result<(), BackendError> {
        let Some(&any) = lanes.first() else {
            return Ok(());
        };
        pilots
            .asked
            .ask(self, pilots.chart, batch, lanes, when.middle(any));
        let lanes: Vec<(usize, usize)> = lanes.iter().copied().enumerate().collect();
        self.set(wings, pilots, batch, watch, (when, &lanes))
    }

    /// Sets the laws of trajectories, each with the place of its answer; one that has none, and no
    /// help, has come to its end.
    pub fn set(
        &self,
        wings: &mut Wings<'_>,
        pilots: &mut Pilots<'_>,
        batch: &mut Batch,
        watch: &mut Option<Watch<'_>>,
        (when, lanes): (&When<'_>, &[(usize, usize)]),
    ) -> Result<(), BackendError> {
        let dim = batch.dim;
        batch.updates += lanes.len();
        let mut lost = Vec::new();
        for &(j, i) in lanes {
            let vector = &mut batch.end[i * dim..][..dim];
            let Some(answer) = pilots.asked.answer(j) else {
                lost.push(i);
                continue;
            };
            set_chart(vector, answer.p, answer.hessian);
            if let Some(watch) = watch {
                self.show(watch, batch.first + i, (when.t)(i), vector, Some(answer.v));
            }
            pilots.found(i);
        }
        if lost.is_empty() {
            return Ok(());
        }
        let flying: Vec<bool> = (lost.iter())
            .map(|i| {
                batch.fallback[*i] += 1;
                pilots.waited[*i] += 1;
                (when.t)(*i) > 0.0 && pilots.waited[*i] <= pilots.patience
            })
            .collect();
        pilots.room.t = when.middle(lost[0]);
        let mut help = Help {
            outside: pilots.outside,
            wings,
            chart: pilots.chart,
            room: &mut pilots.room,
        };
        let goes_on = self.help(&mut help, (batch, &lost), when, &mut pilots.plans, &flying)?;
        for (i, _) in lost.iter().zip(goes_on).filter(|(_, goes_on)| !goes_on) {
            (batch.status[*i], batch.t_end[*i]) = (OUTSIDE_MAP, (when.t)(*i));
        }
        Ok(())
    }

    /// What is told of trajectories that have come to the final time, and what is missing of those
    /// kept that have not.
    pub fn conclude(
        &self,
        mut pilots: Pilots<'_>,
        batch: &mut Batch,
        ended: &[usize],
        watch: &mut Option<Watch<'_>>,
    ) {
        let scene = self.setting.closed_loop;
        let (n, dim) = (self.equations.states, batch.dim);
        if let Some(watch) = watch {
            pilots
                .asked
                .ask(self, pilots.chart, batch, ended, scene.final_time);
            for (j, &i) in ended.iter().enumerate() {
                if let Some(answer) = pilots.asked.answer(j) {
                    let end = &batch.end[i * dim..][..dim];
                    self.show(
                        watch,
                        batch.first + i,
                        scene.final_time,
                        end,
                        Some(answer.v),
                    );
                }
            }
        }
        for (i, path) in &mut batch.kept {
            if ended.binary_search(i).is_ok() {
                self.keep(path, scene.final_time, &batch.end[*i * dim..][..dim]);
            }
            let missing = scene.samples + 1 - path.t.len();
            path.t.extend(vec![f64::NAN; missing]);
            path.x.extend(vec![f64::NAN; missing * n]);
            path.u
                .extend(vec![f64::NAN; missing * self.equations.controls]);
            if self.equations.supplied().is_some() {
                path.w.extend(vec![
                    f64::NAN;
                    missing * self.equations.disturbance_columns().len()
                ]);
                path.supplied.extend(vec![f64::NAN; missing]);
                path.cost.extend(vec![f64::NAN; missing]);
            }
        }
    }

    /// Sets p of trajectories that the chart has no answer for; says of each whether it goes on.
    fn help(
        &self,
        help: &mut Help<'_, '_>,
        (batch, lost): (&mut Batch, &[usize]),
        when: &When<'_>,
        plans: &mut [Option<Plan>],
        flying: &[bool],
    ) -> Result<Vec<bool>, BackendError> {
        let dim = batch.dim;
        if help.outside == Outside::Search {
            let new: Vec<usize> = lost
                .iter()
                .copied()
                .filter(|i| plans[*i].is_none())
                .collect();
            let from: Vec<f64> = new
                .iter()
                .flat_map(|i| &batch.end[i * dim..][..dim])
                .copied()
                .collect();
            let first: Vec<f64> = new.iter().map(|i| (when.first)(*i)).collect();
            for (i, plan) in new
                .iter()
                .zip(self.search(help, (when.rest, &first), &from)?)
            {
                plans[*i] = Some(plan);
            }
        }
        let mut own: Vec<Plan> = lost
            .iter()
            .map(|i| plans[*i].take().unwrap_or_default())
            .collect();
        let mut vectors: Vec<f64> = lost
            .iter()
            .flat_map(|i| &batch.end[i * dim..][..dim])
            .copied()
            .collect();
        let goes_on = self.fall_back(help, &mut vectors, &mut own, flying);
        for ((i, vector), plan) in lost.iter().zip(vectors.chunks_exact(dim)).zip(own) {
            batch.end[i * dim..][..dim].copy_from_slice(vector);
            plans[*i] = Some(plan);
        }
        Ok(goes_on)
    }
}

impl When<'_> {
    /// Over a leg p of V(x, t) changes with time too: that of its middle errs only to the second
    /// order of its length.
    fn middle(&self, i: usize) -> f64 {
        (self.t)(i) + 0.5 * self.rest.length
    }
}

/// What a chart says where trajectories are: one part after the other.
#[derive(Default)]
pub(super) struct Asked {
    parts: Vec<(Vec<f64>, Expansions)>,
    states: usize,
}

/// One of the answers.
pub(super) struct One<'a> {
    pub v: f64,
    pub p: &'a [f64],
    pub hessian: &'a [f64],
}

impl Asked {
    pub fn ask(
        &mut self,
        ground: &Ground<'_>,
        chart: &dyn Chart,
        batch: &Batch,
        alive: &[usize],
        t: f64,
    ) {
        let (n, dim, reference) = (
            ground.equations.states,
            batch.dim,
            &ground.equations.reference,
        );
        self.states = n;
        self.parts
            .resize_with(alive.len().div_ceil(PART), Default::default);
        let one = |(x, answers): &mut (Vec<f64>, Expansions), alive: &[usize]| {
            x.clear();
            for i in alive {
                x.extend((batch.end[i * dim..][..n].iter().zip(reference)).map(|(s, x)| s + x));
            }
            answers.t = t;
            chart.expansions(n, x, answers);
        };
        match self.parts.as_mut_slice() {
            [part] => one(part, alive),
            parts => (parts.par_iter_mut().zip(alive.par_chunks(PART)))
                .for_each(|(part, alive)| one(part, alive)),
        }
    }

    pub fn answer(&self, j: usize) -> Option<One<'_>> {
        let (n, part, k) = (self.states, &self.parts[j / PART].1, j % PART);
        part.known[k].then(|| One {
            v: part.v[k],
            p: &part.p[k * n..][..n],
            hessian: &part.hessian[k * n * n..][..n * n],
        })
    }
}

impl Batch {
    /// Adds the trajectories that follow.
    fn append(&mut self, other: Batch) {
        let before = self.status.len();
        self.start.extend(other.start);
        self.end.extend(other.end);
        self.t_end.extend(other.t_end);
        self.status.extend(other.status);
        self.fallback.extend(other.fallback);
        self.records.append(other.records);
        self.kept
            .extend(other.kept.into_iter().map(|(i, path)| (i + before, path)));
        self.updates += other.updates;
        self.round_trips += other.round_trips;
    }
}
