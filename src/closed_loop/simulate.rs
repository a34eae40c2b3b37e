//! Batches of closed-loop trajectories on a backend.

use super::equations::{Equations, set_chart};
use super::flights::{Flights, Path, Seen, Starts, Watch};
use super::forcing::Forcing;
use super::law::Law;
use super::record::Records;
use super::{Chart, Expansion, LoopError, Setting};
use crate::backend::cpu::map::Evaluator;
use crate::backend::{Backend, Kernel, Run, Status, Trajectories, batch_limit};
use crate::sweep::GUARD_STATUS;
use rayon::prelude::*;

/// Status of a trajectory whose chart has no answer where it has come to.
pub const OUTSIDE_MAP: i32 = 8;
/// A trajectory that cannot go on has met a guard whose value is below this share of that at its start.
const AT_GUARD: f64 = 1e-4;
/// Longest share of the final time over which a chart's last answer is held where it has none.
const HOLD: f64 = 0.25;
/// Trajectories of a batch under a chart's law.
const CHARTED_BATCH: usize = 16384;

/// A law's kernels.
pub(super) struct Simulator<'s> {
    setting: &'s Setting<'s>,
    equations: Equations,
    kernel: Box<dyn Kernel>,
    scaled: Option<(Equations, Box<dyn Kernel>)>,
    observer: Evaluator,
    guards: Option<Evaluator>,
    terminal: Option<Evaluator>,
}

/// A batch while it flies.
struct Batch {
    dim: usize,
    /// Number of the first trajectory.
    first: usize,
    /// `[trajectory][dim]`.
    start: Vec<f64>,
    end: Vec<f64>,
    t_end: Vec<f64>,
    status: Vec<i32>,
    records: Records,
    /// Trajectories of the batch kept whole, with their paths.
    kept: Vec<(usize, Path)>,
    updates: usize,
    held: usize,
}

impl<'s> Simulator<'s> {
    /// Under disturbances where there is a forcing.
    pub fn new(
        setting: &'s Setting<'s>,
        law: &Law,
        forcing: Option<&Forcing>,
        backend: &dyn Backend,
    ) -> Result<Self, LoopError> {
        let scene = setting.closed_loop;
        let equations = Equations::new(setting.model, setting.hamiltonian, law, &scene.records, forcing);
        let operations = equations.operations();
        if operations > crate::sweep::MOST_OPERATIONS {
            return Err(LoopError::TooLong {
                law: law.name.clone(),
                operations,
            });
        }
        let (method, precision) = (setting.numerics.method, setting.numerics.precision);
        let kernel = backend.compile(&equations.spec(method, precision, !equations.charted))?;
        let scaled = if scene.records.is_empty() {
            None
        } else {
            let scaled = equations.scaled();
            let kernel = backend.compile(&scaled.spec(method, precision, false))?;
            Some((scaled, kernel))
        };
        Ok(Self {
            setting,
            kernel,
            scaled,
            observer: Evaluator::new(&equations.observed()),
            guards: equations.guard_values().map(|g| Evaluator::new(&g)),
            terminal: equations.terminal().map(|t| Evaluator::new(&t)),
            equations,
        })
    }

    /// What is asked of a chart needs one.
    pub fn fly(
        &mut self,
        starts: Starts<'_>,
        chart: Option<&dyn Chart>,
        mut watch: Option<Watch<'_>>,
    ) -> Result<Flights, LoopError> {
        let n = self.equations.states;
        let samples = self.setting.closed_loop.samples;
        let size = if self.equations.charted {
            CHARTED_BATCH
        } else {
            batch_limit(self.equations.dim(), samples)
        };
        let mut flights = Flights::default();
        for (k, chunk) in starts.x.chunks(size * n).enumerate() {
            let mut batch = self.batch(chunk, k * size, starts);
            match chart.filter(|_| self.equations.charted) {
                Some(chart) => self.by_chart(&mut batch, chart, &mut watch)?,
                None => self.by_formula(&mut batch, &mut watch)?,
            }
            self.finish(batch, &mut flights)?;
        }
        Ok(flights)
    }

    fn batch(&self, x0: &[f64], first: usize, starts: Starts<'_>) -> Batch {
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
            kept: (starts.kept.iter().filter(here).map(|i| (i - first, path(*i)))).collect(),
            updates: 0,
            held: 0,
            start,
        }
    }

    /// What the kernel is run with, for components of these scales; `levels` of time.
    fn run(&self, equations: &Equations, levels: Vec<f64>) -> Run {
        let (setting, numerics) = (self.setting, &self.setting.numerics);
        // Constant components have no error: any finite tolerance will do.
        let mut atol = vec![1e30; equations.dim()];
        for (atol, width) in atol.iter_mut().zip(&setting.widths) {
            *atol = numerics.atol * width;
        }
        for integral in [Some(equations.cost()), equations.supplied()].into_iter().flatten() {
            atol[integral] = numerics.atol * setting.value_scale;
        }
        Run {
            rtol: numerics.rtol,
            atol,
            step: setting.model.integrator.step.unwrap_or(0.0),
            max_steps: u32::try_from(setting.model.integrator.max_steps).unwrap_or(u32::MAX),
            levels,
            ceiling: None,
            bounds: setting.bounds.clone(),
        }
    }

    /// A law that is a formula: each trajectory at once.
    fn by_formula(&mut self, batch: &mut Batch, watch: &mut Option<Watch<'_>>) -> Result<(), LoopError> {
        let scene = self.setting.closed_loop;
        let times: Vec<f64> = (1..=scene.samples)
            .map(|k| scene.final_time * k as f64 / scene.samples as f64)
            .collect();
        let run = self.run(&self.equations, times);
        let flown = self.kernel.integrate(&run, &batch.start)?;
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
                self.show(watch, batch.first + i, 0.0, &batch.start[i * dim..][..dim], None);
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
    fn observer_width(&self) -> usize {
        self.equations.disturbance_columns().end
    }

    fn show(&self, watch: &mut Watch<'_>, trajectory: usize, t: f64, vector: &[f64], v: Option<f64>) {
        watch(Seen {
            trajectory,
            t,
            s: &vector[..self.equations.states],
            cost: vector[self.equations.cost()],
            supplied: self.equations.supplied().map_or(0.0, |k| vector[k]),
            v,
        });
    }

    fn keep(&self, path: &mut Path, t: f64, vector: &[f64]) {
        let n = self.equations.states;
        path.t.push(t);
        path.x.extend((0..n).map(|i| vector[i] + self.equations.reference[i]));
        let seen = self.observer.eval(vector, vector.len());
        let known =
            |values: &[f64]| -> Vec<f64> { values.iter().map(|v| if t.is_nan() { f64::NAN } else { *v }).collect() };
        path.u.extend(known(&seen[self.equations.control_columns()]));
        path.w.extend(known(&seen[self.equations.disturbance_columns()]));
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

    /// The status with the guard's own number where one ended the trajectory: also where its equations end with a guard, so
    /// that no step gets beyond it.
    fn code(&self, status: Status, start: &[f64], end: &[f64]) -> i32 {
        let stopped = matches!(status, Status::NotFinite | Status::StepFloor);
        let Some(guards) = self.guards.as_ref().filter(|_| stopped || status == Status::Guard) else {
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

    /// The law of a chart: between updates that of its quadratic model at the state of the last one. A gap in the chart is
    /// bridged with the model before it, but not under a forcing: V certifies nothing there.
    fn by_chart(
        &mut self,
        batch: &mut Batch,
        chart: &dyn Chart,
        watch: &mut Option<Watch<'_>>,
    ) -> Result<(), LoopError> {
        let scene = self.setting.closed_loop;
        let sampling = scene.final_time / scene.samples as f64;
        let updates = scene
            .period
            .map_or(1, |p| (sampling / p - 1e-9).ceil().max(1.0) as usize);
        let step = sampling / updates as f64;
        let run = self.run(&self.equations, vec![step]);
        let (n, dim, width) = (self.equations.states, batch.dim, self.observer_width());
        let mut alive: Vec<usize> = (0..batch.status.len()).collect();
        let patience = if self.equations.supplied().is_some() {
            0
        } else {
            (HOLD * (scene.samples * updates) as f64) as usize
        };
        let mut waited = vec![0; alive.len()];
        for k in 0..scene.samples * updates {
            let t = step * k as f64;
            let answers = self.asked(chart, batch, &alive);
            batch.updates += alive.len();
            for (&i, answer) in alive.iter().zip(&answers) {
                match answer {
                    Some(a) => {
                        let vector = &mut batch.end[i * dim..][..dim];
                        set_chart(vector, &a.p, &a.hessian);
                        waited[i] = 0;
                        if let Some(watch) = watch {
                            self.show(watch, batch.first + i, t, vector, Some(a.v));
                        }
                    }
                    None if k > 0 && waited[i] < patience => {
                        waited[i] += 1;
                        batch.held += 1;
                    }
                    None => (batch.status[i], batch.t_end[i]) = (OUTSIDE_MAP, t),
                }
            }
            alive.retain(|i| batch.status[*i] == Status::Reached as i32);
            if alive.is_empty() {
                break;
            }
            if k % updates == 0 {
                self.keep_alive(batch, &alive, t);
            }
            let seeds: Vec<f64> = alive
                .iter()
                .flat_map(|i| &batch.end[i * dim..][..dim])
                .copied()
                .collect();
            let flown = self.kernel.integrate(&run, &seeds)?;
            if !scene.records.is_empty() {
                let (before, after) = (self.observer.eval(&seeds, dim), self.observer.eval(&flown.end, dim));
                batch.records.each(|i, view| {
                    if let Ok(j) = alive.binary_search(&i) {
                        let row = |values: &[f64]| values[j * width..][..width].to_vec();
                        let ends = [row(&before), row(&after)];
                        view.see(flown.end_time[j], &seeds[j * dim..][..dim], [&ends[0], &ends[1]]);
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
        if let Some(watch) = watch {
            for (&i, answer) in alive.iter().zip(self.asked(chart, batch, &alive)) {
                if let Some(a) = answer {
                    self.show(
                        watch,
                        batch.first + i,
                        scene.final_time,
                        &batch.end[i * dim..][..dim],
                        Some(a.v),
                    );
                }
            }
        }
        self.keep_alive(batch, &alive, scene.final_time);
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
        Ok(())
    }

    /// What the chart says where these trajectories are.
    fn asked(&self, chart: &dyn Chart, batch: &Batch, alive: &[usize]) -> Vec<Option<Expansion>> {
        let (n, dim, reference) = (self.equations.states, batch.dim, &self.equations.reference);
        (alive.par_iter())
            .map(|i| {
                let s = &batch.end[i * dim..][..n];
                let x: Vec<f64> = s.iter().zip(reference).map(|(s, x)| s + x).collect();
                chart.local(&x)
            })
            .collect()
    }

    fn keep_alive(&self, batch: &mut Batch, alive: &[usize], t: f64) {
        let dim = batch.dim;
        for (i, path) in &mut batch.kept {
            if alive.binary_search(i).is_ok() {
                self.keep(path, t, &batch.end[*i * dim..][..dim]);
            }
        }
    }

    fn finish(&mut self, mut batch: Batch, flights: &mut Flights) -> Result<(), LoopError> {
        if let Some((scaled, kernel)) = &mut self.scaled {
            let scaled: &Equations = scaled;
            // Neither bounds nor guards: these ended the trajectory where they were met.
            let (numerics, scene) = (&self.setting.numerics, self.setting.closed_loop);
            let mut atol = vec![1e30; scaled.dim()];
            for (atol, width) in atol.iter_mut().zip(&self.setting.widths) {
                *atol = numerics.atol * width;
            }
            let run = Run {
                rtol: numerics.rtol,
                atol,
                // Time runs from 0 to 1 over at most one interval.
                step: self.setting.model.integrator.step.unwrap_or(0.0) * scene.samples as f64 / scene.final_time,
                max_steps: u32::MAX,
                levels: vec![1.0],
                ceiling: None,
                bounds: Vec::new(),
            };
            batch.records.refine(scaled, kernel.as_mut(), &run, &self.observer)?;
        }
        let (n, dim) = (self.equations.states, batch.dim);
        if let Some(terminal) = &self.terminal {
            flights.terminal.extend(terminal.eval(&batch.end, dim));
        }
        for end in batch.end.chunks_exact(dim) {
            flights.end.extend_from_slice(&end[..n]);
            flights.cost.push(end[dim - 1]);
        }
        flights.updates += batch.updates;
        flights.held += batch.held;
        flights.t_end.extend(batch.t_end);
        flights.status.extend(batch.status);
        flights.records.extend(batch.records.values());
        flights.paths.extend(batch.kept.into_iter().map(|(_, path)| path));
        Ok(())
    }
}
