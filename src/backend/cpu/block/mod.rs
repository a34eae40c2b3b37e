//! The integrator on a block of lanes. A lane whose trajectory ends takes the next one from the
//! queue, so lanes do not wait for each other; what a lane computes depends on its own trajectory
//! alone.
//!
//! `shaders/block.wgsl` mirrors this room.

mod events;
mod sampling;

use super::Simd;
use super::lanes::Lanes;
use super::real::Real;
use super::routine::{Routine, Session};
use super::steps::{self, Layout, Parameters};
use crate::backend::{By, Run, Spec, Status, Variant};
use crate::integrator::{Scheme, control};
use std::ops::Range;

/// A kernel's code for blocks of a certain number of lanes.
pub struct Compiled {
    pub spec: Spec,
    pub scheme: Scheme,
    layout: Layout,
    /// Components that are not constant.
    moving: Vec<usize>,
    /// What a seed needs before its first step.
    start: Routine,
    step: Routine,
    /// Dense output of a Runge-Kutta step.
    dense: Option<Routine>,
}

impl Compiled {
    /// Whether all of it is machine code.
    pub fn is_compiled(&self) -> bool {
        let parts = [&self.start, &self.step];
        parts
            .into_iter()
            .chain(&self.dense)
            .all(Routine::is_compiled)
    }

    /// Bytes of its machine code.
    pub fn bytes(&self) -> usize {
        let parts = [&self.start, &self.step];
        let parts = parts.into_iter().chain(&self.dense);
        parts.map(Routine::bytes).sum()
    }

    /// `compile`: to machine code of which instructions, where the machine allows it.
    pub fn new(
        spec: &Spec,
        scheme: Scheme,
        variant: Variant,
        compile: Option<Simd>,
        width: usize,
    ) -> Self {
        let layout = Layout::new(spec, scheme);
        let routine = |record: &dyn Fn(&mut super::code::Recorder)| {
            Routine::new(compile, spec.precision, width, record)
        };
        Self {
            start: routine(&|r| steps::start(r, spec, &layout, variant)),
            step: routine(&|r| steps::step(r, spec, &layout, scheme, variant)),
            dense: match scheme {
                Scheme::RungeKutta(tableau) => {
                    Some(routine(&|r| steps::dense(r, spec, &layout, tableau)))
                }
                Scheme::Taylor(_) => None,
            },
            moving: (0..spec.dim()).filter(|c| !spec.is_constant(*c)).collect(),
            spec: spec.clone(),
            scheme,
            layout,
        }
    }
}

/// Where the results of consecutive trajectories go; slices of one chunk.
pub struct Output<'a> {
    pub end: &'a mut [f64],
    pub end_time: &'a mut [f64],
    pub status: &'a mut [Status],
    pub steps: &'a mut [u32],
    pub rejected: &'a mut [u32],
    pub samples: &'a mut [f64],
}

/// Trajectories of a chunk that wait for a lane, each with what its first step needs.
struct Queue<'a, T> {
    seeds: &'a [f64],
    dim: usize,
    /// `[trajectory][derivative of what moves, kinks, squares of size and speed in units of the
    /// tolerance]`.
    starts: Vec<T>,
    width: usize,
    next: usize,
}

impl<'a, T: Real> Queue<'a, T> {
    fn new<const W: usize, const FMA: bool>(
        kernel: &Compiled,
        parameters: &[T],
        seeds: &'a [f64],
    ) -> Self {
        let layout = &kernel.layout;
        let dim = layout.dim;
        let count = seeds.len() / dim;
        let slots: Vec<usize> = (kernel.moving.iter().map(|c| layout.dense + c))
            .chain(layout.next.kinks..layout.next.end)
            .chain([layout.seed, layout.seed + 1])
            .collect();
        let width = slots.len();
        let mut starts = vec![T::of(0.0); count * width];
        let mut session = kernel.start.session::<T, W>(parameters);
        let mut frame = vec![Lanes::<T, W>::splat(T::of(0.0)); layout.slots];
        for first in (0..count).step_by(W) {
            let here = W.min(count - first);
            for c in 0..dim {
                for i in 0..here {
                    frame[layout.now.y + c].0[i] = T::of(seeds[(first + i) * dim + c]);
                }
            }
            session.run::<FMA>(&mut frame);
            for (k, slot) in slots.iter().enumerate() {
                for i in 0..here {
                    starts[(first + i) * width + k] = frame[*slot].0[i];
                }
            }
        }
        Self {
            seeds,
            dim,
            starts,
            width,
            next: 0,
        }
    }

    fn take(&mut self) -> Option<usize> {
        let i = self.next;
        (i * self.dim < self.seeds.len()).then(|| {
            self.next += 1;
            i
        })
    }

    fn start(&self, i: usize) -> &[T] {
        &self.starts[i * self.width..(i + 1) * self.width]
    }
}

/// Everything a block works on. Steps of all lanes, and what follows from them, are one piece of
/// vector code; only lanes to which something happens (a level, an end) are looked at singly.
struct Block<'a, T, const W: usize> {
    kernel: &'a Compiled,
    run: &'a Run,
    layout: Layout,
    frame: Vec<Lanes<T, W>>,
    dense: Option<Session<'a, T, W>>,
    /// Whether the frame holds the dense output of the step at hand.
    densified: bool,
    /// Trajectory in the chunk; none when the queue has run dry.
    trajectory: [Option<usize>; W],
    next_level: [usize; W],
    /// The dense output of the lane in hand, `[component][power]`.
    polynomials: Vec<T>,
    /// Points of all lanes' steps, by component, and their times.
    points: Vec<Lanes<T, W>>,
    /// How and at which fraction of the step at hand a level has ended a lane's trajectory.
    ended: [Option<(Status, T)>; W],
}

/// Integrates the trajectories of one chunk; how many steps the block took.
#[inline(always)]
pub fn integrate<T: Real, const W: usize, const FMA: bool>(
    kernel: &Compiled,
    run: &Run,
    seeds: &[f64],
    out: &mut Output<'_>,
) -> u64 {
    let layout = kernel.layout;
    let parameters = Parameters::values::<T>(run);
    let mut queue = Queue::new::<W, FMA>(kernel, &parameters, seeds);
    let mut step = kernel.step.session::<T, W>(&parameters);
    let mut block = Block::<T, W> {
        kernel,
        run,
        layout,
        frame: vec![Lanes::splat(T::of(0.0)); layout.slots],
        dense: kernel.dense.as_ref().map(|r| r.session(&parameters)),
        densified: false,
        trajectory: [None; W],
        next_level: [0; W],
        polynomials: vec![T::of(0.0); layout.dim * kernel.scheme.degree()],
        points: vec![Lanes::splat(T::of(0.0)); layout.dim + 1],
        ended: [None; W],
    };
    let mut active = 0;
    for lane in 0..W {
        active += usize::from(block.refill(lane, &mut queue, out));
    }
    let mut rounds = 0;
    while active > 0 {
        rounds += 1;
        block
            .frame
            .copy_within(layout.next.y..layout.next.end, layout.now.y);
        step.run::<FMA>(&mut block.frame);
        block.densified = false;
        if kernel.spec.store {
            block.sample::<FMA>(out);
        }
        for lane in 0..W {
            if block.set(layout.special, lane)
                && block.trajectory[lane].is_some()
                && block.settle::<FMA>(lane, out)
                && !block.refill(lane, &mut queue, out)
            {
                active -= 1;
            }
        }
    }
    rounds
}

impl<T: Real, const W: usize> Block<'_, T, W> {
    fn at(&self, slot: usize, lane: usize) -> T {
        self.frame[slot].0[lane]
    }

    fn put(&mut self, slot: usize, lane: usize, value: T) {
        self.frame[slot].0[lane] = value;
    }

    /// Whether a mask is set: all ones are not a number.
    fn set(&self, mask: usize, lane: usize) -> bool {
        !(self.at(mask, lane) == T::of(0.0))
    }

    /// The step attempted.
    fn h(&self, lane: usize) -> T {
        self.at(self.layout.h, lane)
    }

    /// Puts the next trajectory of the queue that has a way to go into a lane; false where there is
    /// none, and the lane idles.
    fn refill(&mut self, lane: usize, queue: &mut Queue<'_, T>, out: &mut Output<'_>) -> bool {
        while let Some(i) = queue.take() {
            match self.place(lane, i, queue, out) {
                None => return true,
                Some(ended) => _ = self.finish(lane, ended, out),
            }
        }
        self.trajectory[lane] = None;
        self.expect_level(lane);
        false
    }

    /// Puts a trajectory at its beginning; its status where that is also its end.
    fn place(
        &mut self,
        lane: usize,
        i: usize,
        queue: &Queue<'_, T>,
        out: &mut Output<'_>,
    ) -> Option<Status> {
        let (dim, next) = (self.layout.dim, self.layout.next);
        let start = queue.start(i);
        for (c, v) in queue.seeds[i * dim..][..dim].iter().enumerate() {
            self.put(next.y + c, lane, T::of(*v));
        }
        // Derivatives of the others are 0 in all lanes.
        let moving = &self.kernel.moving;
        if matches!(self.kernel.scheme, Scheme::RungeKutta(_)) {
            for (c, v) in moving.iter().zip(start) {
                self.put(next.k + c, lane, *v);
            }
        }
        let moving = moving.len();
        for (g, v) in start[moving..queue.width - 2].iter().enumerate() {
            self.put(next.kinks + g, lane, *v);
        }
        for slot in [next.t, next.before, next.resume, next.steps, next.rejected] {
            self.put(slot, lane, T::of(0.0));
        }
        self.trajectory[lane] = Some(i);
        let coordinate = match self.kernel.spec.by {
            By::Time => T::of(0.0),
            By::Component(c) => self.at(next.y + c, lane),
        };
        self.next_level[lane] = self
            .run
            .levels
            .iter()
            .take_while(|l| T::of(**l) <= coordinate)
            .count();
        self.blank(i, 0..self.next_level[lane], out);
        self.expect_level(lane);
        let (size, speed) = (start[queue.width - 2].f64(), start[queue.width - 1].f64());
        if !speed.is_finite() {
            return Some(Status::NotFinite);
        }
        if self.next_level[lane] == self.run.levels.len() {
            return Some(Status::Reached);
        }
        let first = self.first_step(size, speed);
        self.put(self.layout.first_step, lane, T::of(first));
        let mut wanted = match self.kernel.scheme {
            Scheme::Taylor(_) => f64::INFINITY,
            Scheme::RungeKutta(tableau) if tableau.adaptive() => self.run.first.unwrap_or(first),
            Scheme::RungeKutta(_) => first,
        };
        if let (By::Time, Some(end)) = (self.kernel.spec.by, self.run.levels.last())
            && wanted * (1.0 + 1e-3) >= *end
        {
            wanted = *end;
        }
        self.put(next.wanted, lane, T::of(wanted));
        None
    }

    /// From the squares of a seed's size and speed in units of the tolerance.
    fn first_step(&self, size: f64, speed: f64) -> f64 {
        let share = match self.kernel.scheme {
            Scheme::RungeKutta(tableau) if !tableau.adaptive() => return self.run.step,
            Scheme::RungeKutta(tableau) => tableau.first(),
            Scheme::Taylor(_) => control::SHARE,
        };
        let first = share * (size / speed).sqrt();
        // At rest there is nothing to follow, but a finite step keeps the arithmetic going to the
        // step limit.
        if first.is_finite() && first > 0.0 {
            first
        } else {
            share
        }
    }

    /// What happens in the step of one lane: events, samples, end of the trajectory. True when the
    /// lane is free.
    #[inline(always)]
    fn settle<const FMA: bool>(&mut self, lane: usize, out: &mut Output<'_>) -> bool {
        let (now, next) = (self.layout.now, self.layout.next);
        let reached = self
            .at(now.t, lane)
            .f64()
            .max(self.at(self.layout.first_step, lane).f64());
        let floor = control::FLOOR_ULPS * T::EPSILON * reached;
        if !self.set(self.layout.accepted, lane) {
            if self.at(next.wanted, lane).f64() < floor || !self.kernel.scheme.adaptive() {
                let status = if self.at(self.layout.error, lane).is_finite() {
                    Status::StepFloor
                } else {
                    Status::NotFinite
                };
                return self.finish(lane, status, out);
            }
            return self.out_of_steps(lane, out);
        }
        if let Some(ended) = self.events::<FMA>(lane, out) {
            return self.finish(lane, ended, out);
        }
        let outside = (self.run.bounds.iter().enumerate()).any(|(c, [lo, hi])| {
            let y = self.at(next.y + c, lane);
            !(y >= T::of(*lo) && y <= T::of(*hi))
        });
        if outside {
            return self.finish(lane, Status::LeftRegion, out);
        }
        if (self.run.ceiling).is_some_and(|(c, v)| self.at(next.y + c, lane) >= T::of(v)) {
            return self.finish(lane, Status::Reached, out);
        }
        if matches!(self.kernel.scheme, Scheme::Taylor(_)) && self.h(lane).f64() < floor {
            return self.finish(lane, Status::StepFloor, out);
        }
        self.out_of_steps(lane, out)
    }

    fn out_of_steps(&mut self, lane: usize, out: &mut Output<'_>) -> bool {
        let next = self.layout.next;
        let count = self.at(next.steps, lane).f64() + self.at(next.rejected, lane).f64();
        count >= f64::from(self.run.max_steps).min(0.5 / T::EPSILON)
            && self.finish(lane, Status::StepLimit, out)
    }

    /// Writes a lane's result; the lane is then free.
    fn finish(&mut self, lane: usize, status: Status, out: &mut Output<'_>) -> bool {
        if let Some(i) = self.trajectory[lane] {
            let (dim, next) = (self.layout.dim, self.layout.next);
            for c in 0..dim {
                out.end[i * dim + c] = self.at(next.y + c, lane).f64();
            }
            out.end_time[i] = self.at(next.t, lane).f64();
            out.status[i] = status;
            out.steps[i] = self.at(next.steps, lane).f64() as u32;
            out.rejected[i] = self.at(next.rejected, lane).f64() as u32;
            self.blank(i, self.next_level[lane]..self.run.levels.len(), out);
        }
        true
    }

    /// Says of levels that a trajectory has not passed them.
    fn blank(&self, i: usize, levels: Range<usize>, out: &mut Output<'_>) {
        if self.kernel.spec.store {
            let (width, first) = (1 + self.layout.dim, i * self.run.levels.len());
            out.samples[(first + levels.start) * width..(first + levels.end) * width]
                .fill(f64::NAN);
        }
    }
}
