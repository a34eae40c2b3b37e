//! Batches of closed-loop trajectories on a backend.

use super::equations::Equations;
use super::flights::{Flights, Path, Seen, Starts, Watch};
use super::forcing::Forcing;
use super::law::Law;
use super::pace::Pace;
use super::record::Records;
use super::{Chart, LoopError, Setting};
use crate::backend::cpu::Evaluator;
use crate::backend::{Backend, Kernel, Relay, Run, Status, Trajectories, batch_limit};
use crate::sweep::{AT_GUARD, GUARD_STATUS};

/// Status of a trajectory whose chart has no answer where it has come to.
pub const OUTSIDE_MAP: i32 = 8;
/// Trajectories of a batch under a chart's law.
const CHARTED_BATCH: usize = 16384;

/// A law's kernels.
pub(super) struct Simulator<'s> {
    ground: Ground<'s>,
    kernel: Box<dyn Kernel>,
    /// Of a device that asks the chart itself.
    relay: Option<Box<dyn Relay>>,
    scaled: Option<(Equations, Box<dyn Kernel>)>,
}

/// What all batches of a law share.
pub(super) struct Ground<'s> {
    pub setting: &'s Setting<'s>,
    pub equations: Equations,
    /// The same with the length of each leg, where these are of a chart's law and of many lengths.
    pub timed: Option<Equations>,
    pub pace: Pace,
    pub observer: Evaluator,
    guards: Option<Evaluator>,
    pub terminal: Option<Evaluator>,
}

/// A batch while it flies.
pub(super) struct Batch {
    pub dim: usize,
    /// Number of the first trajectory.
    pub first: usize,
    /// `[trajectory][dim]`.
    pub start: Vec<f64>,
    pub end: Vec<f64>,
    pub t_end: Vec<f64>,
    pub status: Vec<i32>,
    pub records: Records,
    /// Trajectories of the batch kept whole, with their paths.
    pub kept: Vec<(usize, Path)>,
    pub updates: usize,
    /// Between the host and a device.
    pub round_trips: usize,
    /// Of each trajectory the updates at which the chart had no answer.
    pub fallback: Vec<u32>,
}

impl<'s> Simulator<'s> {
    /// Under disturbances where there is a forcing; with the chart that the law is of, if it is.
    pub fn new(
        setting: &'s Setting<'s>,
        law: &Law,
        forcing: Option<&Forcing>,
        chart: Option<&dyn Chart>,
        backend: &dyn Backend,
    ) -> Result<Self, LoopError> {
        let scene = setting.closed_loop;
        let equations = Equations::new(
            setting.model,
            setting.hamiltonian,
            law,
            &scene.records,
            forcing,
        );
        let operations = equations.operations();
        if operations > crate::sweep::MOST_OPERATIONS {
            return Err(LoopError::TooLong {
                law: law.name.clone(),
                operations,
            });
        }
        let (method, precision) = (setting.numerics.method, setting.numerics.precision);
        let own = if equations.charted {
            setting.leg_method
        } else {
            method
        };
        // Of what a backend without a device has no use for nothing is made.
        let asked = chart.filter(|_| equations.charted && backend.asks_surfaces());
        let surface = asked.and_then(|chart| chart.surface(precision));
        let scaled = if scene.records.is_empty() {
            None
        } else {
            let scaled = equations.scaled().without_guards();
            let kernel = backend.compile(&scaled.spec(method, precision, false))?;
            Some((scaled, kernel))
        };
        let mut ground = Ground {
            setting,
            observer: Evaluator::new(&equations.observed()),
            guards: equations.guard_values().map(|g| Evaluator::new(&g)),
            terminal: equations.terminal().map(|t| Evaluator::new(&t)),
            timed: None,
            pace: Pace::new(setting, &equations),
            equations,
        };
        let compile = |equations: &Equations| {
            backend.compile(&equations.spec(own, precision, !equations.charted))
        };
        let mut asking = None;
        if let Some(surface) = surface {
            let kernel = compile(&ground.equations)?;
            let run = ground.leg(&ground.equations, false);
            asking = kernel.relay(&run, &surface)?.map(|relay| (kernel, relay));
        }
        let (kernel, relay) = match asking {
            Some((kernel, relay)) => (kernel, Some(relay)),
            None => {
                let as_needed =
                    ground.equations.charted && matches!(ground.pace, Pace::AsNeeded(_));
                ground.timed = as_needed.then(|| ground.equations.scaled());
                (
                    compile(ground.timed.as_ref().unwrap_or(&ground.equations))?,
                    None,
                )
            }
        };
        Ok(Self {
            ground,
            kernel,
            relay,
            scaled,
        })
    }

    /// What is asked of a chart needs one.
    pub fn fly(
        &mut self,
        starts: Starts<'_>,
        chart: Option<&dyn Chart>,
        mut watch: Option<Watch<'_>>,
    ) -> Result<Flights, LoopError> {
        let equations = &self.ground.equations;
        let n = equations.states;
        let samples = self.ground.setting.closed_loop.samples;
        let size = if equations.charted {
            CHARTED_BATCH
        } else {
            batch_limit(equations.dim(), samples)
        };
        let mut flights = Flights::default();
        for (k, chunk) in starts.x.chunks(size * n).enumerate() {
            let (ground, kernel) = (&self.ground, self.kernel.as_mut());
            let relay = self.relay.as_deref_mut();
            let batch = match chart.filter(|_| ground.equations.charted) {
                Some(chart) => {
                    ground.by_chart(kernel, relay, (chunk, k * size, starts), chart, &mut watch)?
                }
                None => {
                    let mut batch = ground.batch(chunk, k * size, starts);
                    ground.by_formula(kernel, &mut batch, &mut watch)?;
                    batch
                }
            };
            self.finish(batch, &mut flights)?;
        }
        Ok(flights)
    }

    fn finish(&mut self, mut batch: Batch, flights: &mut Flights) -> Result<(), LoopError> {
        let ground = &self.ground;
        if let Some((scaled, kernel)) = &mut self.scaled {
            let scaled: &Equations = scaled;
            // Neither bounds nor guards: these ended the trajectory where they were met.
            let (numerics, scene) = (&ground.setting.numerics, ground.setting.closed_loop);
            let mut atol = vec![1e30; scaled.dim()];
            for (atol, width) in atol.iter_mut().zip(&ground.setting.widths) {
                *atol = numerics.atol * width;
            }
            let run = Run {
                rtol: numerics.rtol,
                atol,
                // Time runs from 0 to 1 over at most one interval.
                step: ground.setting.model.integrator.step.unwrap_or(0.0) * scene.samples as f64
                    / scene.final_time,
                first: None,
                max_steps: u32::MAX,
                levels: vec![1.0],
                ceiling: None,
                bounds: Vec::new(),
            };
            batch
                .records
                .refine(scaled, kernel.as_mut(), &run, &ground.observer)?;
        }
        let (n, dim) = (ground.equations.states, batch.dim);
        if let Some(terminal) = &ground.terminal {
            flights.terminal.extend(terminal.eval(&batch.end, dim));
        }
        for end in batch.end.chunks_exact(dim) {
            flights.end.extend_from_slice(&end[..n]);
            flights.cost.push(end[dim - 1]);
        }
        flights.updates += batch.updates;
        flights.round_trips += batch.round_trips;
        flights.fallback.extend(batch.fallback);
        flights.t_end.extend(batch.t_end);
        flights.status.extend(batch.status);
        flights.records.extend(batch.records.values());
        flights
            .paths
            .extend(batch.kept.into_iter().map(|(_, path)| path));
        Ok(())
    }
}

impl Ground<'_> {
    /// Trajectories from `x0`, the first of which has a number.
    pub fn batch(&self, x0: &[f64], first: usize, starts: Starts<'_>) -> Batch {
        let (n, dim) = (self.equations.states, self.equations.dim());
        let count = x0.len() / n;
        let mut start = vec![0.0; count * dim];
        for (vector, x) in start.chunks_exact_mut(dim).zip(x0.chunks_exact(n)) {
            for i in 0..n {
                vector[i] = x[i] - self.equations.reference[i];
            }
        }
        let forced = self.equations.forcing.clone();
        if !forced.is_empty() {
            let own = starts.forcing[first * forced.len()..].chunks_exact(forced.len());
            for (vector, forcing) in start.chunks_exact_mut(dim).zip(own) {
                vector[forced.clone()].copy_from_slice(forcing);
            }
        }
        let here = |initial: &&usize| (first..first + count).contains(*initial);
        let path = |initial: usize| Path {
            initial,
            ..Path::default()
        };
        Batch {
            dim,
            first,
            end: start.clone(),
            t_end: vec![0.0; count],
            status: vec![Status::Reached as i32; count],
            records: Records::new(
                &self.setting.closed_loop.records,
                self.equations.switch_columns(),
                count,
            ),
            kept: (starts
                .kept
                .iter()
                .filter(here)
                .map(|i| (i - first, path(*i))))
            .collect(),
            updates: 0,
            round_trips: 0,
            fallback: vec![0; count],
            start,
        }
    }

    /// What the kernel is run with, for components of these scales; `levels` of time.
    pub fn run(&self, equations: &Equations, levels: Vec<f64>) -> Run {
        let (setting, numerics) = (self.setting, &self.setting.numerics);
        // Constant components have no error: any finite tolerance will do.
        let mut atol = vec![1e30; equations.dim()];
        for (atol, width) in atol.iter_mut().zip(&setting.widths) {
            *atol = numerics.atol * width;
        }
        for integral in [Some(equations.cost()), equations.supplied()]
            .into_iter()
            .flatten()
        {
            atol[integral] = numerics.atol * setting.value_scale;
        }
        Run {
            rtol: numerics.rtol,
            atol,
            step: setting.model.integrator.step.unwrap_or(0.0),
            first: None,
            max_steps: u32::try_from(setting.model.integrator.max_steps).unwrap_or(u32::MAX),
            levels,
            ceiling: None,
            bounds: setting.bounds.clone(),
        }
    }

    /// A law that is a formula: each trajectory at once.
    fn by_formula(
        &self,
        kernel: &mut dyn Kernel,
        batch: &mut Batch,
        watch: &mut Option<Watch<'_>>,
    ) -> Result<(), LoopError> {
        let scene = self.setting.closed_loop;
        let times: Vec<f64> = (1..=scene.samples)
            .map(|k| scene.final_time * k as f64 / scene.samples as f64)
            .collect();
        let run = self.run(&self.equations, times);
        self.setting.numerics.deadline.check()?;
        let flown = kernel.integrate(&run, &batch.start)?;
        let dim = batch.dim;
        let width = self.observer_width();
        let first = self.observer.eval(&batch.start, dim);
        if !scene.records.is_empty() {
            let along = self.observer.eval(&flown.samples[1..], dim + 1);
            let last = self.observer.eval(&flown.end, dim);
            let start = &batch.start;
            batch.records.each(|i, view| {
                let (mut t, mut from) = (0.0, &start[i * dim..][..dim]);
                let mut before = &first[i * width..][..width];
                for k in 0..flown.levels {
                    let sample = flown.sample(i, k);
                    if sample[0].is_nan() {
                        break;
                    }
                    let here = &along[(i * flown.levels + k) * width..][..width];
                    view.see(sample[0] - t, from, [before, here]);
                    (t, from, before) = (sample[0], &sample[1..], here);
                }
                let rest = flown.end_time[i] - t;
                if rest > 0.0 {
                    view.see(rest, from, [before, &last[i * width..][..width]]);
                }
            });
        }
        if let Some(watch) = watch {
            for i in 0..flown.count() {
                self.show(
                    watch,
                    batch.first + i,
                    0.0,
                    &batch.start[i * dim..][..dim],
                    None,
                );
                for k in 0..flown.levels {
                    let sample = flown.sample(i, k);
                    if sample[0].is_nan() {
                        break;
                    }
                    self.show(watch, batch.first + i, sample[0], &sample[1..], None);
                }
            }
        }
        for (i, path) in &mut batch.kept {
            let start = [0.0]
                .iter()
                .chain(&batch.start[*i * dim..][..dim])
                .copied()
                .collect::<Vec<_>>();
            let points = [start.as_slice()]
                .into_iter()
                .chain((0..flown.levels).map(|k| flown.sample(*i, k)));
            for point in points {
                self.keep(path, point[0], &point[1..]);
            }
        }
        self.settle(batch, &flown);
        Ok(())
    }

    /// Numbers of a row of the observer.
    pub fn observer_width(&self) -> usize {
        self.equations.disturbance_columns().end
    }

    pub fn show(
        &self,
        watch: &mut Watch<'_>,
        trajectory: usize,
        t: f64,
        vector: &[f64],
        v: Option<f64>,
    ) {
        watch(Seen {
            trajectory,
            t,
            s: &vector[..self.equations.states],
            cost: vector[self.equations.cost()],
            supplied: self.equations.supplied().map_or(0.0, |k| vector[k]),
            v,
        });
    }

    pub fn keep(&self, path: &mut Path, t: f64, vector: &[f64]) {
        let n = self.equations.states;
        path.t.push(t);
        path.x
            .extend((0..n).map(|i| vector[i] + self.equations.reference[i]));
        let seen = self.observer.eval(vector, vector.len());
        let known = |values: &[f64]| -> Vec<f64> {
            values
                .iter()
                .map(|v| if t.is_nan() { f64::NAN } else { *v })
                .collect()
        };
        path.u
            .extend(known(&seen[self.equations.control_columns()]));
        path.w
            .extend(known(&seen[self.equations.disturbance_columns()]));
        if let Some(supplied) = self.equations.supplied() {
            path.supplied.extend(known(&[vector[supplied]]));
            path.cost.extend(known(&[vector[self.equations.cost()]]));
        }
    }

    /// Ends and statuses of a batch integrated as a whole.
    fn settle(&self, batch: &mut Batch, flown: &Trajectories) {
        let dim = batch.dim;
        for i in 0..flown.count() {
            let (start, end) = (&batch.start[i * dim..][..dim], &flown.end[i * dim..][..dim]);
            batch.status[i] = self.code(flown.status[i], start, end);
        }
        batch.end.clone_from(&flown.end);
        batch.t_end.clone_from(&flown.end_time);
    }

    /// The status with the guard's own number where one ended the trajectory: also where its
    /// equations end with a guard, so that no step gets beyond it.
    pub fn code(&self, status: Status, start: &[f64], end: &[f64]) -> i32 {
        let stopped = matches!(status, Status::NotFinite | Status::StepFloor);
        let Some(guards) = self
            .guards
            .as_ref()
            .filter(|_| stopped || status == Status::Guard)
        else {
            return status as i32;
        };
        let (at_start, at_end) = (guards.eval(start, start.len()), guards.eval(end, end.len()));
        // One that is 0 from the beginning is an invariant boundary, not met.
        let share = |k: usize| {
            if at_start[k] == 0.0 && at_end[k] >= 0.0 {
                f64::INFINITY
            } else {
                at_end[k] / at_start[k].abs()
            }
        };
        let nearest = (0..at_end.len()).min_by(|a, b| share(*a).total_cmp(&share(*b)));
        match nearest {
            Some(k) if status == Status::Guard || share(k) <= AT_GUARD => GUARD_STATUS + k as i32,
            _ => status as i32,
        }
    }
}
