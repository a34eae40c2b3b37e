//! The integrator on a block of lanes. A lane whose trajectory ends takes the next one from the queue, so lanes do not
//! wait for each other; what a lane computes depends on its own trajectory alone.
//!
//! `shaders/block.wgsl` mirrors this room.

mod control;
mod events;

use super::lanes::Lanes;
use super::real::Real;
use super::routine::{Routine, Session};
use super::steps::{self, Layout};
use crate::backend::{By, Run, Spec, Status};
use crate::integrator::{Scheme, control as constants};

/// A kernel's code for blocks of a certain number of lanes.
pub struct Compiled {
    pub spec: Spec,
    pub scheme: Scheme,
    layout: Layout,
    /// What a seed needs before its first step.
    start: Routine,
    /// A Runge-Kutta step, or the expansion of a Taylor step.
    step: Routine,
    /// The new point of a Taylor step.
    evaluation: Option<Routine>,
    /// Dense output of a Runge-Kutta step.
    dense: Option<Routine>,
}

impl Compiled {
    /// `compile`: to machine code, where the machine allows it.
    pub fn new(spec: &Spec, scheme: Scheme, compile: bool, width: usize) -> Self {
        let layout = Layout::new(spec, scheme);
        let routine = |record: &dyn Fn(&mut super::code::Recorder)| Routine::new(compile, spec.precision, width, record);
        let start = routine(&|r| steps::start(r, spec, &layout));
        let (step, evaluation, dense) = match scheme {
            Scheme::RungeKutta(tableau) => (
                routine(&|r| steps::runge_kutta(r, spec, &layout, tableau)),
                None,
                Some(routine(&|r| steps::dense(r, spec, &layout, tableau))),
            ),
            Scheme::Taylor(order) => (
                routine(&|r| steps::expansion(r, spec, &layout, order)),
                Some(routine(&|r| steps::evaluation(r, spec, &layout, order))),
                None,
            ),
        };
        Self {
            spec: spec.clone(),
            scheme,
            layout,
            start,
            step,
            evaluation,
            dense,
        }
    }

    fn adaptive(&self) -> bool {
        self.scheme.adaptive()
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
    /// `[trajectory][derivative, kinks, squares of size and speed in units of the tolerance]`.
    starts: Vec<T>,
    width: usize,
    next: usize,
}

impl<'a, T: Real> Queue<'a, T> {
    fn new<const W: usize, const FMA: bool>(kernel: &Compiled, parameters: &[T], seeds: &'a [f64]) -> Self {
        let layout = &kernel.layout;
        let dim = layout.dim;
        let count = seeds.len() / dim;
        let slots: Vec<usize> = layout
            .stage(0)
            .chain(layout.kinks..layout.guards)
            .chain([layout.top, layout.top + 1])
            .collect();
        let width = slots.len();
        let mut starts = vec![T::of(0.0); count * width];
        let mut session = kernel.start.session::<T, W>(parameters);
        let mut frame = vec![Lanes::<T, W>::splat(T::of(0.0)); layout.slots];
        for first in (0..count).step_by(W) {
            let here = W.min(count - first);
            for c in 0..dim {
                for i in 0..here {
                    frame[layout.y + c].0[i] = T::of(seeds[(first + i) * dim + c]);
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

/// Everything a block works on. What steps use is kept lane by lane in SIMD order; only lanes to which something happens
/// (a level, an end) are looked at singly.
struct Block<'a, T, const W: usize> {
    kernel: &'a Compiled,
    run: &'a Run,
    layout: Layout,
    frame: Vec<Lanes<T, W>>,
    step: Session<'a, T, W>,
    evaluation: Option<Session<'a, T, W>>,
    dense: Option<Session<'a, T, W>>,
    /// Whether the frame holds the dense output of the step at hand.
    densified: bool,
    /// Values of the kinks where the step begins.
    sides: Vec<Lanes<T, W>>,
    /// Step size to go on with behind a kink; 0 where none is ahead.
    resume: Lanes<T, W>,
    t: Lanes<T, W>,
    /// The step to attempt; for a Taylor step the longest one allowed.
    wanted: Lanes<T, W>,
    /// Squared error of the step before.
    before: Lanes<f32, W>,
    /// The level each lane comes to next; infinite for an idle lane.
    next_at: Lanes<T, W>,
    first_step: Lanes<T, W>,
    steps: [u32; W],
    rejected: [u32; W],
    /// Trajectory in the chunk; none when the queue has run dry.
    trajectory: [Option<usize>; W],
    next_level: [usize; W],
}

/// Integrates the trajectories of one chunk.
#[inline(always)]
pub fn integrate<T: Real, const W: usize, const FMA: bool>(
    kernel: &Compiled,
    run: &Run,
    seeds: &[f64],
    out: &mut Output<'_>,
) {
    let zero = Lanes::splat(T::of(0.0));
    let layout = kernel.layout;
    let parameters: Vec<T> = [run.rtol].iter().chain(&run.atol).map(|v| T::of(*v)).collect();
    let mut queue = Queue::new::<W, FMA>(kernel, &parameters, seeds);
    let mut block = Block::<T, W> {
        kernel,
        run,
        layout,
        frame: vec![zero; layout.slots],
        step: kernel.step.session(&parameters),
        evaluation: kernel.evaluation.as_ref().map(|r| r.session(&parameters)),
        dense: kernel.dense.as_ref().map(|r| r.session(&parameters)),
        densified: false,
        sides: vec![zero; layout.guards - layout.kinks],
        resume: zero,
        t: zero,
        wanted: zero,
        before: Lanes::splat(1.0),
        next_at: zero,
        first_step: zero,
        steps: [0; W],
        rejected: [0; W],
        trajectory: [None; W],
        next_level: [0; W],
    };
    for lane in 0..W {
        block.refill(lane, &mut queue, out);
    }
    while block.trajectory.iter().any(Option::is_some) {
        block.attempt::<FMA>();
        let decided = block.control::<FMA>();
        let mut single = [false; W];
        for lane in 0..W {
            if decided.special[lane] != 0 && block.trajectory[lane].is_some() {
                single[lane] = true;
                if block.settle::<FMA>(lane, &decided, out) {
                    block.refill(lane, &mut queue, out);
                }
            }
        }
        block.advance(&decided, &single);
    }
}

/// What the step control decided for each lane.
struct Decision<T, const W: usize> {
    accepted: [bool; W],
    finite: [bool; W],
    next_h: Lanes<T, W>,
    /// Not 0 where a lane must be looked at singly.
    special: [u8; W],
}

impl<T: Real, const W: usize> Block<'_, T, W> {
    fn y(&self, c: usize) -> &[T; W] {
        &self.frame[self.layout.y + c].0
    }

    fn y_new(&self, c: usize) -> &[T; W] {
        &self.frame[self.layout.y_new + c].0
    }

    fn h(&self) -> &[T; W] {
        &self.frame[self.layout.h].0
    }

    /// Puts the next trajectory of the queue that has a way to go into a lane, or idles it.
    fn refill(&mut self, lane: usize, queue: &mut Queue<'_, T>, out: &mut Output<'_>) {
        while let Some(i) = queue.take() {
            match self.place(lane, i, queue) {
                None => return,
                Some(ended) => _ = self.finish(lane, ended, out),
            }
        }
        self.trajectory[lane] = None;
        self.expect_level(lane);
    }

    /// Puts a trajectory at its beginning; its status where that is also its end.
    fn place(&mut self, lane: usize, i: usize, queue: &Queue<'_, T>) -> Option<Status> {
        let dim = self.layout.dim;
        let start = queue.start(i);
        for c in 0..dim {
            self.frame[self.layout.y + c].0[lane] = T::of(queue.seeds[i * dim + c]);
            if self.kernel.dense.is_some() {
                self.frame[self.layout.k + c].0[lane] = start[c];
            }
        }
        for (side, v) in self.sides.iter_mut().zip(&start[dim..]) {
            side.0[lane] = *v;
        }
        self.t.0[lane] = T::of(0.0);
        self.before.0[lane] = 1.0;
        self.resume.0[lane] = T::of(0.0);
        self.steps[lane] = 0;
        self.rejected[lane] = 0;
        self.trajectory[lane] = Some(i);
        let coordinate = match self.kernel.spec.by {
            By::Time => T::of(0.0),
            By::Component(c) => self.y(c)[lane],
        };
        self.next_level[lane] = self.run.levels.iter().take_while(|l| T::of(**l) <= coordinate).count();
        self.expect_level(lane);
        let (size, speed) = (start[queue.width - 2].f64(), start[queue.width - 1].f64());
        if !speed.is_finite() {
            return Some(Status::NotFinite);
        }
        if self.next_level[lane] == self.run.levels.len() {
            return Some(Status::Reached);
        }
        let first = self.first_step(size, speed);
        self.first_step.0[lane] = T::of(first);
        self.wanted.0[lane] = match self.kernel.scheme {
            Scheme::Taylor(_) => T::of(f64::INFINITY),
            Scheme::RungeKutta(_) => T::of(first),
        };
        if let (By::Time, Some(end)) = (self.kernel.spec.by, self.run.levels.last()) {
            self.wanted.0[lane] = control::stretched(self.wanted.0[lane], T::of(*end));
        }
        None
    }

    /// From the squares of a seed's size and speed in units of the tolerance.
    fn first_step(&self, size: f64, speed: f64) -> f64 {
        let share = match self.kernel.scheme {
            Scheme::RungeKutta(tableau) if !tableau.adaptive() => return self.run.step,
            Scheme::RungeKutta(tableau) => tableau.first(),
            Scheme::Taylor(_) => constants::SHARE,
        };
        let first = share * (size / speed).sqrt();
        // At rest there is nothing to follow, but a finite step keeps the arithmetic going to the step limit.
        if first.is_finite() && first > 0.0 { first } else { share }
    }

    /// One step of all lanes.
    #[inline(always)]
    fn attempt<const FMA: bool>(&mut self) {
        self.densified = false;
        match &mut self.evaluation {
            None => {
                self.frame[self.layout.h] = self.wanted;
                self.step.run::<FMA>(&mut self.frame);
            }
            Some(evaluation) => {
                self.step.run::<FMA>(&mut self.frame);
                if let Scheme::Taylor(order) = self.kernel.scheme {
                    let (below, top) = (self.frame[self.layout.top], self.frame[self.layout.top + 1]);
                    control::taylor_steps(order, &below, &top, &self.wanted, &mut self.frame[self.layout.h]);
                }
                evaluation.run::<FMA>(&mut self.frame);
            }
        }
    }

    /// Finishes the step of all lanes to which nothing happened.
    #[inline(always)]
    fn advance(&mut self, decided: &Decision<T, W>, single: &[bool; W]) {
        let mut moves = [false; W];
        for i in 0..W {
            moves[i] = decided.accepted[i] & !single[i];
            let fails = !decided.accepted[i] & !single[i];
            self.steps[i] += u32::from(moves[i]);
            self.rejected[i] += u32::from(fails);
        }
        let h = self.frame[self.layout.h].0;
        for i in 0..W {
            self.t.0[i] = if moves[i] { self.t.0[i] + h[i] } else { self.t.0[i] };
        }
        for i in 0..W {
            self.wanted.0[i] = if single[i] { self.wanted.0[i] } else { decided.next_h.0[i] };
        }
        let layout = self.layout;
        for (k, old) in self.sides.iter_mut().enumerate() {
            let new = &self.frame[layout.kinks + k].0;
            for i in 0..W {
                old.0[i] = if moves[i] { new[i] } else { old.0[i] };
            }
        }
        let mut take = |to: usize, from: usize| {
            let from = self.frame[from].0;
            let to = &mut self.frame[to].0;
            for i in 0..W {
                to[i] = if moves[i] { from[i] } else { to[i] };
            }
        };
        for c in 0..layout.dim {
            take(layout.y + c, layout.y_new + c);
        }
        if let Scheme::RungeKutta(tableau) = self.kernel.scheme {
            let last = layout.stage(tableau.stages() - 1).start;
            for c in 0..layout.dim {
                take(layout.k + c, last + c);
            }
        }
    }

    /// Finishes the step of one lane: events, samples, end of the trajectory. True when the lane is free.
    #[inline(always)]
    fn settle<const FMA: bool>(&mut self, lane: usize, decided: &Decision<T, W>, out: &mut Output<'_>) -> bool {
        let next_h = decided.next_h.0[lane];
        if !decided.accepted[lane] {
            self.rejected[lane] += 1;
            self.wanted.0[lane] = next_h;
            let (t, first) = (self.t.0[lane].f64(), self.first_step.0[lane].f64());
            let floor = constants::FLOOR_ULPS * T::EPSILON * t.max(first);
            if next_h.f64() < floor || !self.kernel.adaptive() {
                let status = if decided.finite[lane] {
                    Status::StepFloor
                } else {
                    Status::NotFinite
                };
                return self.finish(lane, status, out);
            }
            return self.out_of_steps(lane, out);
        }
        self.steps[lane] += 1;
        for (k, old) in self.sides.iter_mut().enumerate() {
            old.0[lane] = self.frame[self.layout.kinks + k].0[lane];
        }
        if let Some(ended) = self.events::<FMA>(lane, out) {
            return self.finish(lane, ended, out);
        }
        self.t.0[lane] = self.t.0[lane] + self.h()[lane];
        self.wanted.0[lane] = next_h;
        let layout = self.layout;
        for c in 0..layout.dim {
            self.frame[layout.y + c].0[lane] = self.y_new(c)[lane];
        }
        if let Scheme::RungeKutta(tableau) = self.kernel.scheme {
            let last = layout.stage(tableau.stages() - 1).start;
            for c in 0..layout.dim {
                self.frame[layout.k + c].0[lane] = self.frame[last + c].0[lane];
            }
        }
        let outside = (self.run.bounds.iter().enumerate()).any(|(c, [lo, hi])| {
            let y = self.y(c)[lane];
            !(y >= T::of(*lo) && y <= T::of(*hi))
        });
        if outside {
            return self.finish(lane, Status::LeftRegion, out);
        }
        if self.run.ceiling.is_some_and(|(c, v)| self.y(c)[lane] >= T::of(v)) {
            return self.finish(lane, Status::Reached, out);
        }
        self.out_of_steps(lane, out)
    }

    fn out_of_steps(&mut self, lane: usize, out: &mut Output<'_>) -> bool {
        self.steps[lane] + self.rejected[lane] >= self.run.max_steps && self.finish(lane, Status::StepLimit, out)
    }

    /// Writes a lane's result; the lane is then free.
    fn finish(&mut self, lane: usize, status: Status, out: &mut Output<'_>) -> bool {
        if let Some(i) = self.trajectory[lane] {
            let dim = self.layout.dim;
            for c in 0..dim {
                out.end[i * dim + c] = self.y(c)[lane].f64();
            }
            out.end_time[i] = self.t.0[lane].f64();
            out.status[i] = status;
            out.steps[i] = self.steps[lane];
            out.rejected[i] = self.rejected[lane];
        }
        true
    }
}
