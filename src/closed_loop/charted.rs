//! Trajectories under the law of a chart: `p = q + H s`, set once a period at each trajectory's state.
//!
//! The CPU's lanes ask the chart as they go. A device asks a map in pieces itself (`relayed`); games, whose answers are checked one
//! by one, charts that are no map in pieces, and maps larger than a device's buffers are asked here, with a round trip a period.

use super::equations::set_chart;
use super::fallback::{Help, Plan, hold_here};
use super::flights::{Starts, Watch};
use super::simulate::{Batch, Ground, OUTSIDE_MAP};
use super::{Chart, Expansions, LoopError};
use crate::backend::{BackendError, Kernel, Relay, Run, Status, Trajectories};
use crate::model::Outside;
use rayon::prelude::*;

/// Trajectories that one thread flies from their start to their end: few enough to balance the load, many enough that the
/// kernel's lanes are full, also with the few that the chart has no answer for.
const PART: usize = 1024;
/// Longest share of the final time over which the last answer is held for want of anything better, unless that is the policy.
const HOLD: f64 = 0.25;
/// Attempted steps that a leg may take, however many legs there are.
const LEAST_STEPS: u32 = 10_000;

/// What flies trajectories over a period.
pub(super) enum Wings<'k> {
    /// On this thread.
    Own(&'k dyn crate::backend::Legs),
    /// A batch as a whole; how often that was.
    Whole(&'k mut dyn Kernel, usize),
}

impl Wings<'_> {
    pub fn fly(&mut self, run: &Run, seeds: &[f64], to: &mut Trajectories) -> Result<(), BackendError> {
        match self {
            Wings::Own(legs) => legs.integrate(seeds, to),
            Wings::Whole(kernel, trips) => {
                *to = kernel.integrate(run, seeds)?;
                *trips += 1;
            }
        }
        Ok(())
    }
}

/// Times between updates.
#[derive(Clone, Copy)]
pub(super) struct Clock {
    pub step: f64,
    /// Updates between samples, and all.
    pub updates: usize,
    pub all: usize,
}

/// What is known of a batch's trajectories from one update of their law to the next.
pub(super) struct Pilots<'p> {
    pub run: &'p Run,
    pub clock: Clock,
    pub chart: &'p dyn Chart,
    pub outside: Outside,
    patience: usize,
    asked: Asked,
    room: Expansions,
    lost: Vec<usize>,
    plans: Vec<Option<Plan>>,
    waited: Vec<usize>,
}

impl Pilots<'_> {
    /// Notes that the chart had an answer.
    pub fn found(&mut self, i: usize) {
        (self.plans[i], self.waited[i]) = (None, 0);
    }
}

impl Ground<'_> {
    pub fn clock(&self) -> Clock {
        let scene = self.setting.closed_loop;
        let sampling = scene.final_time / scene.samples as f64;
        let updates = scene
            .period
            .map_or(1, |p| (sampling / p - 1e-9).ceil().max(1.0) as usize);
        Clock {
            step: sampling / updates as f64,
            updates,
            all: scene.samples * updates,
        }
    }

    /// What legs are flown with.
    pub fn leg(&self, clock: Clock) -> Run {
        let mut run = self.run(&self.equations, vec![clock.step]);
        // The trajectory's limit is its legs' together; one that is stuck does not hold up its neighbours for all of it.
        run.max_steps = (run.max_steps / clock.all as u32).max(LEAST_STEPS);
        // A leg is short: mostly one step takes it.
        run.first = Some(clock.step);
        run
    }

    /// Flies a batch. Where the kernel can, each thread takes trajectories from start to end, asking the chart as it goes; a device
    /// that asks itself takes the batch as a whole.
    pub fn by_chart(
        &self,
        kernel: &mut dyn Kernel,
        relay: Option<&mut (dyn Relay + '_)>,
        (x0, first, starts): (&[f64], usize, Starts<'_>),
        chart: &dyn Chart,
        watch: &mut Option<Watch<'_>>,
    ) -> Result<Batch, LoopError> {
        let clock = self.clock();
        let run = self.leg(clock);
        let n = self.equations.states;
        if let Some(relay) = relay {
            let mut batch = self.batch(x0, first, starts);
            let pilots = self.pilots(&run, clock, chart, x0.len() / n);
            self.by_relay((relay, kernel), pilots, &mut batch, watch)?;
            return Ok(batch);
        }
        if watch.is_none()
            && let Some(legs) = kernel.legs(&run)
        {
            let size = (x0.len() / n)
                .div_ceil(2 * rayon::current_num_threads())
                .clamp(16, PART);
            let parts: Vec<Batch> = (x0.par_chunks(size * n).enumerate())
                .map(|(k, x0)| {
                    let mut part = self.batch(x0, first + k * size, starts);
                    let pilots = self.pilots(&run, clock, chart, x0.len() / n);
                    self.relay(&mut Wings::Own(legs.as_ref()), pilots, &mut part, &mut None)?;
                    Ok(part)
                })
                .collect::<Result<_, BackendError>>()?;
            let mut parts = parts.into_iter();
            let mut all = parts.next().unwrap_or_else(|| self.batch(&[], first, starts));
            parts.for_each(|part| all.append(part));
            return Ok(all);
        }
        let mut batch = self.batch(x0, first, starts);
        let pilots = self.pilots(&run, clock, chart, x0.len() / n);
        let mut wings = Wings::Whole(kernel, 0);
        self.relay(&mut wings, pilots, &mut batch, watch)?;
        if let Wings::Whole(_, trips) = wings {
            batch.round_trips += trips;
        }
        Ok(batch)
    }

    fn pilots<'p>(&self, run: &'p Run, clock: Clock, chart: &'p dyn Chart, count: usize) -> Pilots<'p> {
        // Under a forcing V certifies nothing but where it is known.
        let outside = match self.equations.supplied() {
            Some(_) => Outside::Stop,
            None => self.setting.closed_loop.outside,
        };
        Pilots {
            run,
            clock,
            chart,
            outside,
            patience: match outside {
                Outside::Hold => usize::MAX,
                _ => (HOLD * clock.all as f64) as usize,
            },
            asked: Asked::default(),
            room: Expansions::default(),
            lost: Vec::new(),
            plans: vec![None; count],
            waited: vec![0; count],
        }
    }

    /// Sets the law of some trajectories for the period that begins with update k; one that has none has come to its end.
    pub fn update(
        &self,
        wings: &mut Wings<'_>,
        pilots: &mut Pilots<'_>,
        batch: &mut Batch,
        watch: &mut Option<Watch<'_>>,
        (k, alive): (usize, &[usize]),
    ) -> Result<(), BackendError> {
        let (dim, Clock { step, all, .. }) = (batch.dim, pilots.clock);
        let t = step * k as f64;
        // Over a period p of V(x, t) changes with time too: that of its middle errs only to the second order of the period.
        let middle = t + 0.5 * step;
        pilots.asked.ask(self, pilots.chart, batch, alive, middle);
        pilots.room.t = middle;
        batch.updates += alive.len();
        pilots.lost.clear();
        for (j, &i) in alive.iter().enumerate() {
            let vector = &mut batch.end[i * dim..][..dim];
            let Some(answer) = pilots.asked.answer(j) else {
                pilots.lost.push(i);
                continue;
            };
            (pilots.plans[i], pilots.waited[i]) = (None, 0);
            set_chart(vector, answer.p, answer.hessian);
            if let Some(watch) = watch {
                self.show(watch, batch.first + i, t, vector, Some(answer.v));
            }
        }
        if pilots.lost.is_empty() {
            return Ok(());
        }
        let lost = std::mem::take(&mut pilots.lost);
        let flying: Vec<bool> = (lost.iter())
            .map(|i| {
                batch.fallback[*i] += 1;
                pilots.waited[*i] += 1;
                k > 0 && pilots.waited[*i] <= pilots.patience
            })
            .collect();
        let mut help = Help {
            outside: pilots.outside,
            wings,
            run: pilots.run,
            chart: pilots.chart,
            room: &mut pilots.room,
        };
        let goes_on = self.help(&mut help, (batch, &lost), (all - k, step), &mut pilots.plans, &flying)?;
        for (i, _) in lost.iter().zip(goes_on).filter(|(_, goes_on)| !goes_on) {
            (batch.status[*i], batch.t_end[*i]) = (OUTSIDE_MAP, t);
        }
        pilots.lost = lost;
        Ok(())
    }

    /// From one update to the next, all trajectories of a batch.
    fn relay(
        &self,
        wings: &mut Wings<'_>,
        mut pilots: Pilots<'_>,
        batch: &mut Batch,
        watch: &mut Option<Watch<'_>>,
    ) -> Result<(), BackendError> {
        let scene = self.setting.closed_loop;
        let (dim, width) = (batch.dim, self.observer_width());
        let Pilots {
            run, clock, outside, ..
        } = pilots;
        let mut alive: Vec<usize> = (0..batch.status.len()).collect();
        let mut seeds: Vec<f64> = Vec::new();
        let mut flown = Trajectories::default();
        for k in 0..clock.all {
            let t = clock.step * k as f64;
            self.update(wings, &mut pilots, batch, watch, (k, &alive))?;
            alive.retain(|i| batch.status[*i] == Status::Reached as i32);
            if alive.is_empty() {
                break;
            }
            if k % clock.updates == 0 {
                self.keep_alive(batch, &alive, t);
            }
            seeds.clear();
            for i in &alive {
                seeds.extend_from_slice(&batch.end[i * dim..][..dim]);
            }
            wings.fly(run, &seeds, &mut flown)?;
            if outside != Outside::Stop {
                self.fly_stiff(wings, run, &mut seeds, &mut flown, |j| batch.fallback[alive[j]] += 1)?;
            }
            if !scene.records.is_empty() {
                let (before, after) = (self.observer.eval(&seeds, dim), self.observer.eval(&flown.end, dim));
                batch.records.each(|i, view| {
                    if let Ok(j) = alive.binary_search(&i) {
                        let ends = [&before[j * width..][..width], &after[j * width..][..width]];
                        view.see(flown.end_time[j], &seeds[j * dim..][..dim], ends);
                    }
                });
            }
            for (j, &i) in alive.iter().enumerate() {
                let end = &flown.end[j * dim..][..dim];
                batch.status[i] = self.code(flown.status[j], &batch.start[i * dim..][..dim], end);
                batch.t_end[i] = t + flown.end_time[j];
                batch.end[i * dim..][..dim].copy_from_slice(end);
            }
            alive.retain(|i| batch.status[*i] == Status::Reached as i32);
        }
        self.conclude(pilots, batch, &alive, watch);
        Ok(())
    }

    /// What is told of trajectories that have come to the final time, and what is missing of those kept that have not.
    pub fn conclude(&self, mut pilots: Pilots<'_>, batch: &mut Batch, alive: &[usize], watch: &mut Option<Watch<'_>>) {
        let scene = self.setting.closed_loop;
        let (n, dim) = (self.equations.states, batch.dim);
        if let Some(watch) = watch {
            pilots.asked.ask(self, pilots.chart, batch, alive, scene.final_time);
            for (j, &i) in alive.iter().enumerate() {
                if let Some(answer) = pilots.asked.answer(j) {
                    let end = &batch.end[i * dim..][..dim];
                    self.show(watch, batch.first + i, scene.final_time, end, Some(answer.v));
                }
            }
        }
        self.keep_alive(batch, alive, scene.final_time);
        for (_, path) in &mut batch.kept {
            let missing = scene.samples + 1 - path.t.len();
            path.t.extend(vec![f64::NAN; missing]);
            path.x.extend(vec![f64::NAN; missing * n]);
            path.u.extend(vec![f64::NAN; missing * self.equations.controls]);
            if self.equations.supplied().is_some() {
                path.w
                    .extend(vec![f64::NAN; missing * self.equations.disturbance_columns().len()]);
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
        periods: (usize, f64),
        plans: &mut [Option<Plan>],
        flying: &[bool],
    ) -> Result<Vec<bool>, BackendError> {
        let dim = batch.dim;
        if help.outside == Outside::Search {
            let new: Vec<usize> = lost.iter().copied().filter(|i| plans[*i].is_none()).collect();
            let from: Vec<f64> = new.iter().flat_map(|i| &batch.end[i * dim..][..dim]).copied().collect();
            for (i, plan) in new.iter().zip(self.search(help, periods, &from)?) {
                plans[*i] = Some(plan);
            }
        }
        let mut own: Vec<Plan> = lost.iter().map(|i| plans[*i].take().unwrap_or_default()).collect();
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

    /// Flies again, with p held, the legs that the model of V, next to where V is too steep for it, makes too stiff to follow.
    fn fly_stiff(
        &self,
        wings: &mut Wings<'_>,
        run: &Run,
        seeds: &mut [f64],
        flown: &mut Trajectories,
        mut count: impl FnMut(usize),
    ) -> Result<(), BackendError> {
        let dim = flown.dim;
        for j in 0..flown.count() {
            if flown.status[j] != Status::StepLimit {
                continue;
            }
            let seed = &mut seeds[j * dim..][..dim];
            hold_here(seed, self.equations.states);
            count(j);
            let mut again = Trajectories::default();
            wings.fly(run, seed, &mut again)?;
            flown.status[j] = again.status[0];
            flown.end_time[j] = again.end_time[0];
            flown.end[j * dim..][..dim].copy_from_slice(&again.end);
        }
        Ok(())
    }

    fn keep_alive(&self, batch: &mut Batch, alive: &[usize], t: f64) {
        let dim = batch.dim;
        for (i, path) in &mut batch.kept {
            if alive.binary_search(i).is_ok() {
                self.keep(path, t, &batch.end[*i * dim..][..dim]);
            }
        }
    }
}

/// What a chart says where trajectories are: one part after the other.
#[derive(Default)]
struct Asked {
    parts: Vec<(Vec<f64>, Expansions)>,
    states: usize,
}

/// One of the answers.
struct One<'a> {
    v: f64,
    p: &'a [f64],
    hessian: &'a [f64],
}

impl Asked {
    fn ask(&mut self, ground: &Ground<'_>, chart: &dyn Chart, batch: &Batch, alive: &[usize], t: f64) {
        let (n, dim, reference) = (ground.equations.states, batch.dim, &ground.equations.reference);
        self.states = n;
        self.parts.resize_with(alive.len().div_ceil(PART), Default::default);
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
            parts => (parts.par_iter_mut().zip(alive.par_chunks(PART))).for_each(|(part, alive)| one(part, alive)),
        }
    }

    fn answer(&self, j: usize) -> Option<One<'_>> {
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
