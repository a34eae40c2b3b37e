//! Trajectories of the swept manifold, integrated backward in time from seeds as they are asked
//! for.

use super::first::looks_into_gaps;
use super::{MOST_IN_CELLS, goes_behind_guards, tangent};
use crate::backend::cpu::Evaluator;
use crate::backend::{
    Backend, BackendError, By, Deadline, Guards, Kernel, Run, Spec, Status, Trajectories,
    batch_limit,
};
use crate::local::{LocalSolution, SeedChoice};
use crate::model::{Method, Model, Precision, SeedValue};
use crate::program::Program;
use crate::sweep::{Plan, Surface, with_margin};
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use std::sync::{Mutex, PoisonError};

/// Tolerance of the trajectories: they are first guesses.
const RTOL: f64 = 1e-7;
/// Attempted steps a trajectory.
const MOST_STEPS: u32 = 20_000;
/// Instructions of the equations up to which Taylor series are used.
const LONGEST_SERIES: usize = 600;
/// Arc length between stored points, in widths of the region, and the points beyond the first ones.
const SPACING: f64 = 0.05;
const MOST_POINTS: usize = 320;
/// Ratio of the first points' arc lengths.
const RATIO: f64 = 1.6;
/// Stored times of a finite horizon.
const TIMES: usize = 32;
/// Trajectories are followed at least as many widths beyond the region.
const LEAST_MARGIN: f64 = 3.0;
/// The terminal states looked at reach this many widths beyond the region on each side.
const TERMINAL_MARGIN: f64 = 2.0;
/// Trajectories that a task prepares at least.
const TASK: usize = 16;
/// The seeds' error of V, relative to V of the seeds.
const SEED_ERROR: f64 = 1e-6;

/// A stored trajectory: its points, the seed first. f32, as these are guesses.
pub struct Trajectory {
    /// `[point][2 + 2n]`: backward time, s, p, V.
    points: Vec<f32>,
    /// Where it ended, if that is not its last level: beyond, nothing is known.
    end: Option<Vec<f32>>,
    /// Whether cells reach up to its end: a guard is there, or there is one state, and no other
    /// trajectory passes beside it (it may all but stop, and V rise without end within a level).
    cut: bool,
    /// Cost up to which it was integrated.
    ceiling: f64,
}

/// The trajectories through a surface of seeds. A seed's trajectory depends on its parameter alone,
/// so that what is found with it does not depend on which others were asked for.
pub struct Fan<'a> {
    pub plan: &'a Plan,
    pub surface: Surface,
    local: Option<LocalSolution>,
    /// (Locked only so that the trajectories may be read by several threads.)
    kernel: Mutex<Box<dyn Kernel>>,
    run: Run,
    /// Parameters of the seeds, whether they are inside the guards, and whether on a boundary of
    /// them.
    parameters: Vec<Vec<f64>>,
    inside: Vec<bool>,
    boundary: Vec<bool>,
    /// Seeds half-way between two others; none where no number lies between.
    middles: FxHashMap<(u32, u32), Option<u32>>,
    trajectories: Vec<Option<Trajectory>>,
    /// Numbers of a stored point.
    stride: usize,
    /// Rates of `(s, p, V)` and of the arc length, of `(s, p)`.
    rates: Evaluator,
    pub integrated: usize,
    pub deadline: Deadline,
    /// The last batch, whose memory the next one uses again.
    batch: Trajectories,
}

/// What is integrated: `(s, p, V)` and the arc length.
struct Programs {
    rate: Program,
    /// Where trajectories end at guards.
    guards: Option<Guards>,
    kinks: Option<Program>,
}

impl Programs {
    fn new(plan: &Plan) -> Self {
        let system = &plan.system;
        let mut graph = system.graph.clone();
        let mut rate = system.rate.clone();
        rate.push(system.arc_rate);
        let switches = graph.kinks(&rate);
        let lower = |roots: &[_]| Program::lower(&graph, &system.inputs, roots);
        let guards: Vec<_> = system.guards.iter().map(|g| g.expr).collect();
        let ends_at_guards = !guards.is_empty() && !goes_behind_guards(system.states);
        Self {
            rate: lower(&rate),
            guards: ends_at_guards.then(|| Guards {
                program: lower(&guards),
                strict: system.guards.iter().map(|g| g.strict).collect(),
            }),
            kinks: (!switches.is_empty()).then(|| lower(&switches)),
        }
    }

    /// Of a kernel that samples by time on a finite horizon, and else by arc length.
    fn spec(self, plan: &Plan, backend: &dyn Backend) -> Spec {
        let is_short = self.rate.code.len() <= LONGEST_SERIES;
        let method = match backend.favours(Method::Taylor) && is_short {
            true => Method::Taylor,
            false => Method::Dop853,
        };
        Spec {
            rate: self.rate,
            guards: self.guards,
            kinks: self.kinks,
            method,
            precision: Precision::F64,
            by: if plan.system.terminal.is_some() {
                By::Time
            } else {
                By::Component(2 * plan.system.states + 1)
            },
            store: true,
        }
    }
}

/// Settings of the trajectories of a plan, sampled at these levels; `unit` is a scale of V.
fn run(plan: &Plan, unit: f64, levels: Vec<f64>) -> Run {
    let scales = (plan.widths.iter().copied())
        .chain(plan.widths.iter().map(|w| unit / w))
        .chain([unit, 1.0]);
    let periodic = plan.periodic.iter().copied();
    let margin = plan.shoot_out.margin.max(LEAST_MARGIN);
    Run {
        rtol: RTOL,
        atol: scales.map(|s| 1e-3 * RTOL * s).collect(),
        step: 0.0,
        first: None,
        max_steps: MOST_STEPS,
        levels,
        ceiling: None,
        bounds: with_margin(&plan.region, &plan.widths, periodic, margin),
    }
}

impl<'a> Fan<'a> {
    /// The trajectories of a plan's manifold; of its [`Plan`] only what does not depend on the
    /// scene's own sweep counts.
    ///
    /// # Errors
    /// When the kernel cannot be compiled.
    pub fn new(
        plan: &'a Plan,
        model: &Model,
        unit: f64,
        backend: &dyn Backend,
    ) -> Result<Self, BackendError> {
        let (surface, local) = surface(plan, model, unit);
        let programs = Programs::new(plan);
        let rates = Evaluator::new(&programs.rate);
        let levels = match &plan.system.terminal {
            Some(terminal) => (1..=TIMES)
                .map(|k| terminal.time * k as f64 / TIMES as f64)
                .collect(),
            None => arc_lengths(&surface, plan),
        };
        Ok(Self {
            plan,
            surface,
            local,
            kernel: Mutex::new(backend.compile(&programs.spec(plan, backend))?),
            run: run(plan, unit, levels),
            parameters: Vec::new(),
            inside: Vec::new(),
            boundary: Vec::new(),
            middles: FxHashMap::default(),
            trajectories: Vec::new(),
            stride: 2 + 2 * plan.system.states,
            rates,
            integrated: 0,
            deadline: Deadline::default(),
            batch: Trajectories::default(),
        })
    }

    /// Levels of a complete trajectory.
    pub fn levels(&self) -> usize {
        self.run.levels.len()
    }

    /// V and `(s, p)` of the local solution at a state whose V is at most `margin` times that of
    /// the seeds.
    pub fn local(&self, s: &[f64], margin: f64) -> Option<(f64, Vec<f64>)> {
        let local = self.local.as_ref()?;
        let inside = local.quadratic(s) <= margin * local.seed_value;
        let at = inside.then(|| local.at_state(s))?;
        Some((at[2 * s.len()], at[..2 * s.len()].to_vec()))
    }

    /// The value of a level, from 1 on.
    pub fn time(&self, level: usize) -> f64 {
        self.run.levels[level - 1]
    }

    /// A new seed.
    pub fn seed(&mut self, parameter: Vec<f64>) -> u32 {
        let (parameter, _, guarded) = self.surface.placed(parameter);
        self.boundary.push(guarded.on_boundary);
        self.inside.push(guarded.inside);
        self.parameters.push(parameter);
        self.trajectories.push(None);
        (self.parameters.len() - 1) as u32
    }

    /// Whether a seed was made on the boundary of the guards.
    pub fn is_boundary(&self, seed: u32) -> bool {
        self.boundary[seed as usize]
    }

    /// Whether a state (in widths of the region) is on the boundary of the guards.
    pub fn is_on_boundary(&self, x: &[f64]) -> bool {
        let s = x.iter().zip(&self.plan.widths).map(|(x, w)| x * w);
        let node: Vec<f64> = s.chain(x.iter().map(|_| 0.0)).collect();
        self.surface.on_boundary(&node)
    }

    /// The seed half-way between two; on the boundary of the guards where only one of them is
    /// inside.
    pub fn middle(&mut self, a: u32, b: u32) -> Option<u32> {
        let key = (a.min(b), a.max(b));
        if let Some(known) = self.middles.get(&key) {
            return *known;
        }
        let (p, q) = (
            &self.parameters[key.0 as usize],
            &self.parameters[key.1 as usize],
        );
        let between = match (self.inside[key.0 as usize], self.inside[key.1 as usize]) {
            (true, false) => self.surface.boundary(p, q),
            (false, true) => self.surface.boundary(q, p),
            _ => self.surface.between(p, q),
        };
        let distinct = between != *p && between != *q;
        let crosses = self.inside[key.0 as usize] != self.inside[key.1 as usize];
        let middle = distinct.then(|| self.seed(between));
        if let Some(middle) = middle.filter(|_| crosses) {
            self.boundary[middle as usize] = true;
        }
        self.middles.insert(key, middle);
        middle
    }

    /// Integrates those of the seeds that were not, up to a cost of `ceiling`.
    ///
    /// # Errors
    /// Device failures only.
    pub fn integrate(&mut self, seeds: &[u32], ceiling: f64) -> Result<(), BackendError> {
        let n = self.plan.system.states;
        let mut wanted: Vec<u32> = (seeds.iter().copied())
            .filter(|v| {
                let known = &self.trajectories[*v as usize];
                known
                    .as_ref()
                    .is_none_or(|t| t.ceiling < ceiling && t.end.is_some())
            })
            .collect();
        wanted.sort_unstable();
        wanted.dedup();
        for v in wanted.extract_if(.., |v| !self.inside[*v as usize]) {
            self.trajectories[v as usize] = Some(self.none_from(v));
        }
        self.deadline.check()?;
        self.run.ceiling = ceiling.is_finite().then_some((2 * n, ceiling));
        let dim = 2 * n + 2;
        // Between levels of arc length.
        let cuts = self.plan.system.terminal.is_none() && n < MOST_IN_CELLS;
        for part in wanted.chunks(batch_limit(dim, self.run.levels.len())) {
            let mut starts = vec![0.0; part.len() * dim];
            let this = &*self;
            (starts.par_chunks_mut(dim).zip(part))
                .with_min_len(TASK)
                .for_each(|(to, v)| to[..dim - 1].copy_from_slice(&this.start(*v)));
            let kernel = self
                .kernel
                .get_mut()
                .unwrap_or_else(PoisonError::into_inner);
            let batch = &mut self.batch;
            kernel.integrate_into(&self.run, &starts, batch)?;
            self.integrated += part.len();
            let this = &*self;
            let trajectories: Vec<Trajectory> = (starts.par_chunks(dim).enumerate())
                .with_min_len(TASK)
                .map(|(i, start)| this.trajectory(i, start, cuts))
                .collect();
            for (v, trajectory) in part.iter().zip(trajectories) {
                self.trajectories[*v as usize] = Some(trajectory);
            }
        }
        Ok(())
    }

    /// What is kept of a trajectory of the last batch, which began there; `cuts`: whether cells may
    /// reach up to where it ends.
    fn trajectory(&self, i: usize, start: &[f64], cuts: bool) -> Trajectory {
        let (batch, n) = (&self.batch, self.plan.system.states);
        let mut points = first_point(&start[..self.stride - 1]);
        let mut complete = batch.status[i] == Status::Reached;
        for k in 0..batch.levels {
            let sample = batch.sample(i, k);
            if sample[0].is_nan() {
                complete = false;
                break;
            }
            points.extend(sample[..self.stride].iter().map(|x| *x as f32));
        }
        points.shrink_to_fit();
        let end = &batch.end[i * batch.dim..][..self.stride - 1];
        let end: Vec<f32> = std::iter::once(batch.end_time[i])
            .chain(end.iter().copied())
            .map(|x| x as f32)
            .collect();
        let usable = end.iter().all(|x| x.is_finite());
        let last = points[points.len() - self.stride..].to_vec();
        Trajectory {
            end: (!complete).then_some(if usable { end } else { last }),
            cut: usable && cuts && (n == 1 || batch.status[i] == Status::Guard),
            points,
            ceiling: self
                .run
                .ceiling
                .map_or(f64::INFINITY, |(_, ceiling)| ceiling),
        }
    }

    /// Where a seed's trajectory starts: `(s, p, V)`.
    pub fn start(&self, seed: u32) -> Vec<f64> {
        self.surface.seed(&self.parameters[seed as usize])
    }

    /// The points `(t, s, p, V)` of a seed's trajectory, one after the other; the seed is the first.
    pub fn points(&self, seed: u32) -> &[f32] {
        (self.trajectories[seed as usize].as_ref()).map_or(&[], |t| &t.points)
    }

    /// The seed `(s, p, V)` at the mean of others, by weights that may be a little below 0. None
    /// where a guard excludes it.
    pub fn mean_seed(&self, seeds: &[u32], weights: &[f64]) -> Option<Vec<f64>> {
        let parameters = seeds.iter().map(|seed| &self.parameters[*seed as usize]);
        let mut mean = vec![0.0; self.parameters[seeds[0] as usize].len()];
        for (parameter, weight) in parameters.zip(weights) {
            (mean.iter_mut().zip(parameter)).for_each(|(m, q)| *m += weight * q);
        }
        let (_, seed, guarded) = self.surface.placed(self.surface.normalized(mean));
        guarded.inside.then_some(seed)
    }

    /// The trajectories of seeds `(s, p, V)` up to the cost that others were integrated to last:
    /// their points `(t, s, p, V)` at these arc lengths (finite horizon: times), one after the
    /// other, as far as they come.
    ///
    /// # Errors
    /// Device failures only.
    pub fn traces(&self, seeds: &[&[f64]], levels: &[f64]) -> Result<Vec<Vec<f64>>, BackendError> {
        let dim = 2 * self.plan.system.states + 2;
        let run = Run {
            levels: levels.to_vec(),
            ..self.run.clone()
        };
        let mut traces = Vec::with_capacity(seeds.len());
        // Other threads trace others at the same time.
        let shared = || self.kernel.lock().unwrap_or_else(PoisonError::into_inner);
        let mut fork = shared().fork();
        let mut integrate = |run: &Run, starts: &[f64]| match &mut fork {
            Some(kernel) => kernel.integrate(run, starts),
            None => shared().integrate(run, starts),
        };
        for part in seeds.chunks(batch_limit(dim, levels.len())) {
            self.deadline.check()?;
            let starts: Vec<f64> = (part.iter())
                .flat_map(|seed| seed.iter().copied().chain([0.0]))
                .collect();
            let batch = integrate(&run, &starts)?;
            traces.extend((0..part.len()).map(|i| {
                (0..batch.levels)
                    .map(|level| &batch.sample(i, level)[..self.stride])
                    .take_while(|sample| sample.iter().all(|x| x.is_finite()))
                    .flatten()
                    .copied()
                    .collect()
            }));
        }
        Ok(traces)
    }

    /// The trajectory of a seed that a guard excludes: it ends where it begins.
    fn none_from(&self, seed: u32) -> Trajectory {
        let points = first_point(&self.start(seed));
        Trajectory {
            end: Some(points.clone()),
            cut: false,
            points,
            ceiling: f64::INFINITY,
        }
    }

    /// The point of a seed's trajectory at a level (0 is the seed), and whether the trajectory came
    /// that far: else it is the one where it ended. A guard that ended it on the way to the level
    /// stands for this.
    pub fn point(&self, seed: u32, level: usize) -> Option<(&[f32], bool)> {
        let trajectory = self.trajectories[seed as usize].as_ref()?;
        match trajectory
            .points
            .get(level * self.stride..(level + 1) * self.stride)
        {
            Some(point) => Some((point, true)),
            None => (trajectory.end.as_deref()).map(|end| (end, self.is_cut(seed, level))),
        }
    }

    /// Whether a seed's trajectory was cut (see [`Trajectory`]) on the way to a level.
    pub fn is_cut(&self, seed: u32, level: usize) -> bool {
        let known = self.trajectories[seed as usize].as_ref();
        known.is_some_and(|t| t.cut && level * self.stride == t.points.len())
    }

    /// The points of trajectories at the first `levels`, up to the cost at which they part and to
    /// where one ends, which stands once for what it did not reach; where gaps are not looked into
    /// ([`looks_into_gaps`]) up to the last level that all reach below the ceiling.
    fn together<const N: usize>(
        &self,
        seeds: [u32; N],
        levels: usize,
        ceiling: f64,
    ) -> impl Iterator<Item = [&[f32]; N]> {
        let looks_on = looks_into_gaps(self.plan.system.states);
        // What lies between costs at least what these did before they parted.
        let (mut before, mut ended) = (f64::NEG_INFINITY, false);
        (0..levels).map_while(move |level| {
            if ended || before > ceiling {
                return None;
            }
            let (mut points, mut known) = ([&[] as &[f32]; N], 0);
            for (point, seed) in points.iter_mut().zip(seeds) {
                let (there, is_known) = self.point(seed, level)?;
                *point = there;
                known += usize::from(is_known);
            }
            ended = known < N;
            before = f64::INFINITY;
            for (k, a) in points.iter().enumerate() {
                for b in &points[k + 1..] {
                    before = before.min(self.tangent(a, b)).min(self.tangent(b, a));
                }
            }
            let stops = known == 0 || (!looks_on && (ended || before > ceiling));
            (!stops).then_some(points)
        })
    }

    /// Whether something between points may lie within `around` widths of the region.
    fn is_near(&self, points: &[&[f32]], around: f64) -> bool {
        let plan = self.plan;
        (0..plan.system.states).all(|i| {
            let [lo, hi] = plan.region[i];
            let margin = around * plan.widths[i];
            let range = points.iter().map(|point| f64::from(point[1 + i]));
            let [least, most] = range.fold([f64::INFINITY, f64::NEG_INFINITY], |[l, m], x| {
                [l.min(x), m.max(x)]
            });
            plan.periodic[i] || (most >= lo - margin && least <= hi + margin)
        })
    }

    /// The widest gap between two trajectories at the first `levels`, up to the cost at which they
    /// part, where what is between them may lie within `around` widths of the region.
    pub fn gap(&self, a: u32, b: u32, levels: usize, ceiling: f64, around: f64) -> f64 {
        let at = |v: u32| (self.inside[v as usize], self.boundary[v as usize]);
        match (at(a), at(b)) {
            ((false, _), (false, _)) | ((true, true), (false, _)) | ((false, _), (true, true)) => {
                return 0.0;
            }
            // A boundary of the guards lies between.
            ((true, _), (false, _)) | ((false, _), (true, _)) => return f64::INFINITY,
            _ => {}
        }
        if !looks_into_gaps(self.plan.system.states) {
            match self.plan.system.states {
                3 => return self.gap_of::<3>(a, b, levels, ceiling, around),
                4 => return self.gap_of::<4>(a, b, levels, ceiling, around),
                5 => return self.gap_of::<5>(a, b, levels, ceiling, around),
                6 => return self.gap_of::<6>(a, b, levels, ceiling, around),
                _ => {}
            }
        }
        let apart = |points: [&[f32]; 2]| {
            let difference = |(i, w): (usize, &f64)| {
                (f64::from(points[0][1 + i]) - f64::from(points[1][1 + i])).abs() / w
            };
            let widths = self.plan.widths.iter().enumerate();
            widths.map(difference).fold(0.0, f64::max)
        };
        (self.together([a, b], levels, ceiling))
            .filter(|points| self.is_near(points, around))
            .map(apart)
            .fold(0.0, f64::max)
    }

    /// The same of N states where gaps are not looked into: with the number as a constant it takes a
    /// quarter of the time.
    fn gap_of<const N: usize>(
        &self,
        a: u32,
        b: u32,
        levels: usize,
        ceiling: f64,
        around: f64,
    ) -> f64 {
        let plan = self.plan;
        let widths: [f64; N] = std::array::from_fn(|i| plan.widths[i]);
        let bounds: [[f64; 2]; N] = std::array::from_fn(|i| {
            let ([lo, hi], margin) = (plan.region[i], around * widths[i]);
            match plan.periodic[i] {
                true => [f64::NEG_INFINITY, f64::INFINITY],
                false => [lo - margin, hi + margin],
            }
        });
        let levels_of = |v: u32| self.points(v).chunks_exact(2 + 2 * N);
        let mut widest = 0.0f64;
        for (a, b) in levels_of(a).zip(levels_of(b)).take(levels) {
            let at = |point: &[f32]| -> ([f64; N], [f64; N], f64) {
                let s = std::array::from_fn(|i| f64::from(point[1 + i]));
                let p = std::array::from_fn(|i| f64::from(point[1 + N + i]));
                (s, p, f64::from(point[1 + 2 * N]))
            };
            let ((s, p, v), (r, q, w)) = (at(a), at(b));
            let along = |p: &[f64; N], from: &[f64; N], to: &[f64; N]| -> f64 {
                (0..N).map(|i| p[i] * (to[i] - from[i])).sum()
            };
            // What lies between costs at least this.
            let least = (v + along(&p, &s, &r))
                .min(v)
                .min((w + along(&q, &r, &s)).min(w));
            if least > ceiling {
                break;
            }
            let near =
                (0..N).all(|i| s[i].max(r[i]) >= bounds[i][0] && s[i].min(r[i]) <= bounds[i][1]);
            if near {
                let apart = |i: usize| (s[i] - r[i]).abs() / widths[i];
                widest = (0..N).map(apart).fold(widest, f64::max);
            }
        }
        widest
    }

    /// How far the trajectory of a seed between two others passes, in widths of the region, from the
    /// middle between theirs, as far as [`Fan::gap`] looks.
    pub fn bulge(&self, [a, b, middle]: [u32; 3], levels: usize, ceiling: f64, around: f64) -> f64 {
        let off = |points: [&[f32]; 3]| {
            let difference = |(i, w): (usize, &f64)| {
                let [a, b, middle] = [0, 1, 2].map(|k: usize| f64::from(points[k][1 + i]));
                (middle - 0.5 * (a + b)).abs() / w
            };
            let widths = self.plan.widths.iter().enumerate();
            widths.map(difference).fold(0.0, f64::max)
        };
        (self.together([a, b, middle], levels, ceiling))
            .filter(|points| self.is_near(points, around))
            .map(off)
            .fold(0.0, f64::max)
    }

    /// The least of V at a point of a trajectory, and at another one as its adjoint has it there.
    pub fn tangent(&self, a: &[f32], b: &[f32]) -> f64 {
        let n = self.plan.system.states;
        tangent(a, n, |i| b[1 + i].into()).min(a[1 + 2 * n].into())
    }

    /// Of a simplex of terminal states that all cost more than `ceiling` already: the two furthest
    /// apart, if by the tangents of the terminal cost some state between them may cost less.
    pub fn hidden(&self, simplex: &[u32], ceiling: f64) -> Option<(u32, u32)> {
        /// Shortest edges looked at, as a share of all terminal states.
        const SHORTEST: f64 = 1.0 / 1024.0;
        let n = self.plan.system.states;
        let seeds: Vec<Vec<f64>> = simplex.iter().map(|seed| self.start(*seed)).collect();
        if !ceiling.is_finite() || seeds.iter().any(|s| s[2 * n] <= ceiling) {
            return None;
        }
        let tangent =
            |a: &[f64], b: &[f64]| a[2 * n] + (0..n).map(|i| a[n + i] * (b[i] - a[i])).sum::<f64>();
        let below = |a: &Vec<f64>| {
            seeds
                .iter()
                .map(|b| tangent(a, b))
                .fold(f64::INFINITY, f64::min)
        };
        if seeds.iter().map(below).fold(f64::NEG_INFINITY, f64::max) > ceiling {
            return None;
        }
        let mut longest = (SHORTEST, None);
        for (k, a) in simplex.iter().enumerate() {
            for b in &simplex[k + 1..] {
                let (p, q) = (&self.parameters[*a as usize], &self.parameters[*b as usize]);
                let length = (0..n).map(|i| (p[i] - q[i]).powi(2)).sum::<f64>().sqrt();
                if length > longest.0 {
                    longest = (length, Some((*a, *b)));
                }
            }
        }
        longest.1
    }

    /// Changes of `(t, s, p, V)` a unit of arc length at points `(t, s, p, V)`, one after the
    /// other.
    pub fn along(&self, points: &[f64]) -> Vec<f64> {
        let n = self.plan.system.states;
        let rates = self.rates.eval(points.get(1..).unwrap_or(&[]), self.stride);
        (rates.chunks_exact(2 * n + 2))
            .flat_map(|r| {
                std::iter::once(1.0)
                    .chain(r[..=2 * n].iter().copied())
                    .map(|x| x / r[2 * n + 1])
            })
            .collect()
    }

    /// Arc length from a level to the next one (0 is the seed).
    pub fn step(&self, level: usize) -> f64 {
        self.run.levels[level] - self.along_to(level)
    }

    /// Arc length (finite horizon: time) at a level (0 is the seed), or at the last one.
    pub fn along_to(&self, level: usize) -> f64 {
        match level.min(self.run.levels.len()) {
            0 => 0.0,
            level => self.run.levels[level - 1],
        }
    }

    /// Levels that a seed's trajectory reaches; a guard that ends it counts as one.
    pub fn reached(&self, seed: u32) -> usize {
        (self.trajectories[seed as usize].as_ref())
            .map_or(0, |t| t.points.len() / self.stride - usize::from(!t.cut))
    }
}

/// A seed `(s, p, V)` as a stored point.
fn first_point(seed: &[f64]) -> Vec<f32> {
    std::iter::once(0.0)
        .chain(seed.iter().map(|x| *x as f32))
        .collect()
}

/// The surface of seeds: chosen by the region and the cost there alone.
fn surface(plan: &Plan, model: &Model, unit: f64) -> (Surface, Option<LocalSolution>) {
    if let Some(terminal) = &plan.system.terminal {
        let reach = (plan.region.iter().zip(&plan.widths))
            .map(|([lo, hi], w)| [lo - TERMINAL_MARGIN * w, hi + TERMINAL_MARGIN * w]);
        return (
            Surface::terminal(&plan.system, terminal, reach.collect()),
            None,
        );
    }
    let local = plan
        .local
        .as_ref()
        .expect("an infinite horizon has a local solution");
    let choice = SeedChoice {
        asked: SeedValue::Auto,
        tolerance: SEED_ERROR * unit * SPACING,
        ceiling: SPACING * unit,
        outer: unit,
    };
    let own = LocalSolution::new(&plan.system, model, local.riccati.clone(), choice);
    let own = own.unwrap_or_else(|_| local.clone());
    (Surface::sphere(&plan.system, own.clone()), Some(own))
}

/// Arc lengths from the seeds: first in proportion to the seeds' size, then evenly.
fn arc_lengths(surface: &Surface, plan: &Plan) -> Vec<f64> {
    let n = plan.system.states;
    let mut direction = vec![0.0; n];
    let mut size: f64 = f64::INFINITY;
    for i in 0..n {
        direction.fill(0.0);
        direction[i] = 1.0;
        let seed = surface.seed(&direction);
        let length: f64 = (0..n)
            .map(|k| (seed[k] / plan.widths[k]).powi(2))
            .sum::<f64>()
            .sqrt();
        size = size.min(length);
    }
    let mut lengths = Vec::new();
    let mut step = (0.5 * size).max(1e-9);
    let mut at = 0.0;
    while step < SPACING {
        at += step;
        lengths.push(at);
        step *= RATIO;
    }
    lengths.extend((1..=MOST_POINTS).map(|k| at + SPACING * k as f64));
    lengths
}
