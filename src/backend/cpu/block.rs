//! The integrator on a block of lanes. A lane whose trajectory ends takes the next one from the queue, so lanes do not
//! wait for each other; what a lane computes depends on its own trajectory alone.
//!
//! `shaders/block.wgsl` mirrors this file.

use super::lanes::{LaneProgram, Lanes};
use super::real::Real;
use crate::backend::{By, Run, Status};
use crate::integrator::{Tableau, control};

/// A compiled kernel's programs and layout.
pub struct Compiled {
    pub rate: LaneProgram,
    pub guards: Option<(LaneProgram, Vec<bool>)>,
    /// The kinks' program and its inputs, leading components too.
    pub kinks: Option<(LaneProgram, usize)>,
    /// Inputs of both programs: the leading components.
    pub inputs: usize,
    pub dim: usize,
    pub tableau: &'static Tableau,
    pub by: By,
    pub store: bool,
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

/// Everything a block works on. What steps use is kept lane by lane in SIMD order; only lanes to which something happens
/// (a level, an end, a fresh trajectory) are looked at singly.
struct Block<'a, T, const W: usize> {
    kernel: &'a Compiled,
    run: &'a Run,
    file: Vec<Lanes<T, W>>,
    guard_file: Vec<Lanes<T, W>>,
    kink_file: Vec<Lanes<T, W>>,
    /// Values of the kinks' program where the step begins and where it ends.
    sides: Vec<Lanes<T, W>>,
    sides_new: Vec<Lanes<T, W>>,
    /// Step size to go on with behind a kink; 0 where none is ahead.
    resume: Lanes<T, W>,
    y: Vec<Lanes<T, W>>,
    y_new: Vec<Lanes<T, W>>,
    /// Stage derivatives, `[stage][component]`.
    k: Vec<Lanes<T, W>>,
    t: Lanes<T, W>,
    h: Lanes<T, W>,
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
    /// Lanes whose empty first step is due.
    fresh: [bool; W],
    atol: Vec<T>,
    /// Dense output of the lane in hand, a polynomial a component.
    dense: Vec<[T; 4]>,
}

/// Integrates the `count` trajectories of one chunk.
#[inline(always)]
pub fn integrate<T: Real, const W: usize, const FMA: bool>(
    kernel: &Compiled,
    run: &Run,
    seeds: &[f64],
    out: &mut Output<'_>,
) {
    let dim = kernel.dim;
    let zero = Lanes::splat(T::of(0.0));
    let mut block = Block::<T, W> {
        kernel,
        run,
        file: kernel.rate.registers(),
        guard_file: kernel.guards.as_ref().map_or_else(Vec::new, |(g, _)| g.registers()),
        kink_file: kernel.kinks.as_ref().map_or_else(Vec::new, |(k, _)| k.registers()),
        sides: vec![zero; kernel.kinks.as_ref().map_or(0, |(k, _)| k.outputs())],
        sides_new: vec![zero; kernel.kinks.as_ref().map_or(0, |(k, _)| k.outputs())],
        resume: zero,
        y: vec![zero; dim],
        y_new: vec![zero; dim],
        k: vec![zero; dim * kernel.tableau.stages()],
        t: zero,
        h: zero,
        before: Lanes::splat(1.0),
        next_at: zero,
        first_step: zero,
        steps: [0; W],
        rejected: [0; W],
        trajectory: [None; W],
        next_level: [0; W],
        fresh: [false; W],
        atol: run.atol.iter().map(|a| T::of(*a)).collect(),
        dense: vec![[T::of(0.0); 4]; dim],
    };
    let count = seeds.len() / dim;
    let mut next = 0;
    for lane in 0..W {
        block.refill(lane, &mut next, count, seeds);
    }
    while block.trajectory.iter().any(Option::is_some) {
        let error = block.attempt::<FMA>();
        let decided = block.control::<FMA>(&error);
        let mut single = [false; W];
        for lane in 0..W {
            if decided.special[lane] != 0 && block.trajectory[lane].is_some() {
                single[lane] = true;
                if block.settle::<FMA>(lane, &decided, out) {
                    block.refill(lane, &mut next, count, seeds);
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
    /// Puts the next trajectory of the queue into a lane, or idles it.
    ///
    /// A fresh lane's first attempt has h = 0: it moves nothing and leaves the derivative at the seed in the last
    /// stage, from which the first step size follows.
    fn refill(&mut self, lane: usize, next: &mut usize, count: usize, seeds: &[f64]) {
        let dim = self.kernel.dim;
        let trajectory = (*next < count).then_some(*next);
        if let Some(i) = trajectory {
            *next += 1;
            for c in 0..dim {
                self.y[c].0[lane] = T::of(seeds[i * dim + c]);
            }
        }
        for c in 0..dim {
            self.k[c].0[lane] = T::of(0.0);
        }
        self.t.0[lane] = T::of(0.0);
        self.h.0[lane] = T::of(0.0);
        self.before.0[lane] = 1.0;
        self.first_step.0[lane] = T::of(0.0);
        self.resume.0[lane] = T::of(0.0);
        self.steps[lane] = 0;
        self.rejected[lane] = 0;
        self.trajectory[lane] = trajectory;
        self.fresh[lane] = trajectory.is_some();
        let coordinate = match self.kernel.by {
            By::Time => T::of(0.0),
            By::Component(c) => self.y[c].0[lane],
        };
        self.next_level[lane] = self.run.levels.iter().take_while(|l| T::of(**l) <= coordinate).count();
        self.expect_level(lane);
    }

    /// Sets the level at which the lane is next looked at.
    fn expect_level(&mut self, lane: usize) {
        let last = self.run.levels.len().saturating_sub(1);
        let next = if self.kernel.store { self.next_level[lane] } else { last };
        let at = self.run.levels.get(next).copied().unwrap_or(f64::INFINITY);
        self.next_at.0[lane] = T::of(if self.trajectory[lane].is_some() {
            at
        } else {
            f64::INFINITY
        });
    }

    /// All stages of one step of every lane; returns the squared error in the tolerance's norm (for a fixed-step method
    /// 0 where the result is finite).
    #[inline(always)]
    fn attempt<const FMA: bool>(&mut self) -> Lanes<T, W> {
        let (dim, tableau) = (self.kernel.dim, self.kernel.tableau);
        let inputs = self.kernel.inputs;
        let stages = tableau.stages();
        for s in 1..stages {
            // Components that no derivative depends on are needed only at the end of the step.
            let components = if s + 1 == stages { dim } else { inputs };
            for c in 0..components {
                let mut sum = [T::of(0.0); W];
                for (j, &a) in tableau.a[s - 1].iter().enumerate() {
                    if a == 0.0 {
                        continue;
                    }
                    let (a, k) = (T::of(a), &self.k[j * dim + c].0);
                    for i in 0..W {
                        sum[i] = k[i].mul_add::<FMA>(a, sum[i]);
                    }
                }
                let (y, h) = (&self.y[c].0, &self.h.0);
                for i in 0..W {
                    sum[i] = sum[i].mul_add::<FMA>(h[i], y[i]);
                }
                let to = if c < inputs {
                    &mut self.kernel.rate.inputs(&mut self.file, inputs)[c]
                } else {
                    &mut self.y_new[c]
                };
                to.0 = sum;
            }
            self.kernel.rate.run::<T, W, FMA>(&mut self.file);
            for c in 0..dim {
                let (to, from) = (&mut self.k[s * dim + c].0, &self.kernel.rate.output(&self.file, c).0);
                to.copy_from_slice(from);
            }
        }
        // The last stage was taken at the new point.
        let new_point = self.kernel.rate.inputs(&mut self.file, inputs);
        for c in 0..inputs {
            let (to, from) = (&mut self.y_new[c].0, &new_point[c].0);
            to.copy_from_slice(from);
        }
        self.error::<FMA>()
    }

    #[inline(always)]
    fn error<const FMA: bool>(&self) -> Lanes<T, W> {
        let (dim, tableau) = (self.kernel.dim, self.kernel.tableau);
        let mut total = [T::of(0.0); W];
        let rtol = T::of(self.run.rtol);
        for c in 0..dim {
            let (y, y_new) = (&self.y[c].0, &self.y_new[c].0);
            if !tableau.adaptive() {
                // Zero times a finite number is zero; anything else is not a number.
                let k = &self.k[(tableau.stages() - 1) * dim + c].0;
                for i in 0..W {
                    total[i] = total[i] + T::of(0.0) * (y_new[i] + k[i]);
                }
                continue;
            }
            let mut sum = [T::of(0.0); W];
            for (j, &e) in tableau.error.iter().enumerate() {
                if e == 0.0 {
                    continue;
                }
                let (e, k) = (T::of(e), &self.k[j * dim + c].0);
                for i in 0..W {
                    sum[i] = k[i].mul_add::<FMA>(e, sum[i]);
                }
            }
            let (atol, h) = (self.atol[c], &self.h.0);
            for i in 0..W {
                let (p, q) = (y[i].absolute(), y_new[i].absolute());
                let size = if p > q { p } else { q };
                let e = sum[i] * h[i] / rtol.mul_add::<FMA>(size, atol);
                total[i] = e.mul_add::<FMA>(e, total[i]);
            }
        }
        let share = T::of(1.0 / dim as f64);
        for e in &mut total {
            *e = *e * share;
        }
        if !tableau.companion.is_empty() {
            let other = self.companion::<FMA>();
            for i in 0..W {
                let e = total[i];
                let sum = T::of(control::COMPANION).mul_add::<FMA>(other[i] * share, e);
                total[i] = if sum > T::of(0.0) { e * (e / sum) } else { e };
            }
        }
        Lanes(total)
    }

    /// Sum of squares of the companion estimate.
    #[inline(always)]
    fn companion<const FMA: bool>(&self) -> [T; W] {
        let (dim, tableau) = (self.kernel.dim, self.kernel.tableau);
        let mut total = [T::of(0.0); W];
        let rtol = T::of(self.run.rtol);
        for c in 0..dim {
            let mut sum = [T::of(0.0); W];
            for (j, &e) in tableau.companion.iter().enumerate() {
                if e == 0.0 {
                    continue;
                }
                let (e, k) = (T::of(e), &self.k[j * dim + c].0);
                for i in 0..W {
                    sum[i] = k[i].mul_add::<FMA>(e, sum[i]);
                }
            }
            let (y, y_new) = (&self.y[c].0, &self.y_new[c].0);
            let (atol, h) = (self.atol[c], &self.h.0);
            for i in 0..W {
                let (p, q) = (y[i].absolute(), y_new[i].absolute());
                let size = if p > q { p } else { q };
                let e = sum[i] * h[i] / rtol.mul_add::<FMA>(size, atol);
                total[i] = e.mul_add::<FMA>(e, total[i]);
            }
        }
        total
    }

    /// Accepts or rejects each lane's step, chooses its next size, and finds the lanes to be looked at singly.
    #[inline(always)]
    fn control<const FMA: bool>(&mut self, error: &Lanes<T, W>) -> Decision<T, W> {
        let adaptive = self.kernel.tableau.adaptive();
        let mut decided = Decision {
            accepted: [false; W],
            finite: [false; W],
            next_h: self.h,
            special: [0; W],
        };
        for i in 0..W {
            decided.finite[i] = error.0[i].is_finite();
            decided.accepted[i] = error.0[i] <= T::of(1.0);
        }
        if adaptive {
            let factor = self.factors(error);
            for i in 0..W {
                decided.next_h.0[i] = self.h.0[i] * T::of(f64::from(factor[i]));
            }
            self.meet_kinks::<FMA>(&mut decided);
        }
        self.limit(&mut decided);
        let most = self.run.max_steps.saturating_sub(1);
        let unit = T::of(control::FLOOR_ULPS * T::EPSILON);
        for i in 0..W {
            let passed = match self.kernel.by {
                By::Time => self.t.0[i] + self.h.0[i] >= self.next_at.0[i],
                By::Component(c) => self.y_new[c].0[i] >= self.next_at.0[i],
            };
            let floor = unit * larger(self.t.0[i], self.first_step.0[i]);
            let stuck = !decided.accepted[i] & (!adaptive | (decided.next_h.0[i] < floor));
            let spent = self.steps[i] + self.rejected[i] >= most;
            decided.special[i] = u8::from(passed | stuck | spent | self.fresh[i]);
        }
        self.look_outside::<FMA>(&mut decided.special);
        decided
    }

    /// Refuses steps with a kink well inside, in favour of ones that end there.
    #[inline(always)]
    fn meet_kinks<const FMA: bool>(&mut self, decided: &mut Decision<T, W>) {
        let Some((program, inputs)) = &self.kernel.kinks else {
            return;
        };
        for (to, from) in program.inputs(&mut self.kink_file, *inputs).iter_mut().zip(&self.y_new) {
            to.0 = from.0;
        }
        program.run::<T, W, FMA>(&mut self.kink_file);
        let zero = T::of(0.0);
        // Fraction of the step up to the first kink; 2 where there is none.
        let mut first = [T::of(2.0); W];
        for (g, (old, new)) in self.sides.iter().zip(&mut self.sides_new).enumerate() {
            new.0 = program.output(&self.kink_file, g).0;
            for i in 0..W {
                let (a, b) = (old.0[i], new.0[i]);
                let crossed = (a < zero) & (b >= zero) | (a > zero) & (b <= zero);
                let q = a / (a - b);
                first[i] = if crossed & (q < first[i]) { q } else { first[i] };
            }
        }
        let (share, floor) = (
            T::of(control::at_kink(T::EPSILON)),
            T::of(control::FLOOR_ULPS * T::EPSILON),
        );
        for i in 0..W {
            let q = first[i];
            let (h, resume) = (self.h.0[i], self.resume.0[i]);
            // A share of the step that kinks have not shortened, and no less than the floor: what is left of shorter
            // ones is lost in rounding.
            let near = share * larger(h, resume);
            let near = larger(near, floor * larger(self.t.0[i], self.first_step.0[i]));
            let inside = decided.accepted[i] & !self.fresh[i] & (h * q > near) & (h * (T::of(1.0) - q) > near);
            let crosses = decided.accepted[i] & (q < T::of(2.0)) & !inside;
            // The end of the shorter step is to lie behind the kink, not before it.
            let shorter = q.mul_add::<FMA>(h, T::of(0.1) * near);
            let grown = larger(decided.next_h.0[i], resume);
            decided.accepted[i] &= !inside;
            decided.next_h.0[i] = if inside {
                shorter
            } else if crosses {
                grown
            } else {
                decided.next_h.0[i]
            };
            self.resume.0[i] = if inside {
                larger(resume, h)
            } else if crosses {
                zero
            } else {
                resume
            };
        }
    }

    /// Factors of the step size.
    #[inline(always)]
    fn factors(&mut self, error: &Lanes<T, W>) -> [f32; W] {
        let mut e = [0.0f32; W];
        for i in 0..W {
            e[i] = error.0[i].f32();
        }
        let least = (control::LEAST_ERROR * control::LEAST_ERROR) as f32;
        let (safety, grow, shrink) = (control::SAFETY as f32, control::GROW as f32, control::SHRINK as f32);
        let unit = self.kernel.tableau.exponent();
        let refused = (-0.5 * unit) as f32;
        // Squared errors: the exponents are halved.
        let (alpha, beta) = (
            (-0.5 * control::ALPHA * unit) as f32,
            (0.5 * control::BETA * unit) as f32,
        );
        let mut factor = [0.0f32; W];
        for i in 0..W {
            let accepted = e[i] <= 1.0;
            let size = if e[i] > least { e[i] } else { least };
            let log = log2(size);
            let exponent = if accepted {
                alpha * log + beta * log2(self.before.0[i])
            } else {
                refused * log
            };
            let most = if accepted { grow } else { 1.0 };
            let f = safety * exp2(if exponent > 4.0 { 4.0 } else { exponent });
            let f = if f < most { f } else { most };
            let f = if f > shrink { f } else { shrink };
            let finite = e[i] < f32::MAX;
            factor[i] = if finite { f } else { shrink };
            self.before.0[i] = if accepted { size } else { self.before.0[i] };
        }
        factor
    }

    /// Keeps steps from passing the end where the end is a time.
    #[inline(always)]
    fn limit(&self, decided: &mut Decision<T, W>) {
        let (By::Time, Some(end)) = (self.kernel.by, self.run.levels.last()) else {
            return;
        };
        for i in 0..W {
            // A refused step has not passed the end, and one that ends at a kink just before it must not be stretched.
            let left = T::of(*end) - (self.t.0[i] + self.h.0[i]);
            let next = decided.next_h.0[i];
            decided.next_h.0[i] = if decided.accepted[i] {
                stretched(next, left)
            } else {
                next
            };
        }
    }

    /// Marks lanes whose new point is outside the region, above the ceiling or outside a guard.
    #[inline(always)]
    fn look_outside<const FMA: bool>(&mut self, special: &mut [u8; W]) {
        for ([lo, hi], y) in self.run.bounds.iter().zip(&self.y_new) {
            let (lo, hi) = (T::of(*lo), T::of(*hi));
            for i in 0..W {
                special[i] |= u8::from(!((y.0[i] >= lo) & (y.0[i] <= hi)));
            }
        }
        if let Some((c, v)) = self.run.ceiling {
            let v = T::of(v);
            for i in 0..W {
                special[i] |= u8::from(self.y_new[c].0[i] >= v);
            }
        }
        if let Some((program, strict)) = &self.kernel.guards {
            let inputs = self.kernel.inputs;
            for (to, from) in program.inputs(&mut self.guard_file, inputs).iter_mut().zip(&self.y_new) {
                to.0 = from.0;
            }
            program.run::<T, W, FMA>(&mut self.guard_file);
            for (g, strict) in strict.iter().enumerate() {
                let value = &program.output(&self.guard_file, g).0;
                for i in 0..W {
                    let holds = if *strict {
                        value[i] > T::of(0.0)
                    } else {
                        value[i] >= T::of(0.0)
                    };
                    special[i] |= u8::from(!holds);
                }
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
        for i in 0..W {
            self.t.0[i] = if moves[i] {
                self.t.0[i] + self.h.0[i]
            } else {
                self.t.0[i]
            };
        }
        for i in 0..W {
            self.h.0[i] = if single[i] { self.h.0[i] } else { decided.next_h.0[i] };
        }
        for (old, new) in self.sides.iter_mut().zip(&self.sides_new) {
            for i in 0..W {
                old.0[i] = if moves[i] { new.0[i] } else { old.0[i] };
            }
        }
        let dim = self.kernel.dim;
        let (first, last) = self.k.split_at_mut((self.kernel.tableau.stages() - 1) * dim);
        for c in 0..dim {
            let (y, y_new) = (&mut self.y[c].0, &self.y_new[c].0);
            for i in 0..W {
                y[i] = if moves[i] { y_new[i] } else { y[i] };
            }
            let (k, k_new) = (&mut first[c].0, &last[c].0);
            for i in 0..W {
                k[i] = if moves[i] { k_new[i] } else { k[i] };
            }
        }
    }

    /// Finishes the step of one lane: events, samples, end of the trajectory. True when the lane is free.
    #[inline(always)]
    fn settle<const FMA: bool>(&mut self, lane: usize, decided: &Decision<T, W>, out: &mut Output<'_>) -> bool {
        if self.fresh[lane] {
            return self.start(lane, out);
        }
        let next_h = decided.next_h.0[lane];
        if !decided.accepted[lane] {
            self.rejected[lane] += 1;
            self.h.0[lane] = next_h;
            let (t, first) = (self.t.0[lane].f64(), self.first_step.0[lane].f64());
            let floor = control::FLOOR_ULPS * T::EPSILON * t.max(first);
            if next_h.f64() < floor || !self.kernel.tableau.adaptive() {
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
        self.keep_sides(lane);
        if let Some(ended) = self.events::<FMA>(lane, out) {
            return self.finish(lane, ended, out);
        }
        self.t.0[lane] = self.t.0[lane] + self.h.0[lane];
        self.h.0[lane] = next_h;
        let last = (self.kernel.tableau.stages() - 1) * self.kernel.dim;
        for c in 0..self.kernel.dim {
            self.y[c].0[lane] = self.y_new[c].0[lane];
            self.k[c].0[lane] = self.k[last + c].0[lane];
        }
        let outside = (self.run.bounds.iter().zip(&self.y))
            .any(|([lo, hi], y)| !(y.0[lane] >= T::of(*lo) && y.0[lane] <= T::of(*hi)));
        if outside {
            return self.finish(lane, Status::LeftRegion, out);
        }
        if self.run.ceiling.is_some_and(|(c, v)| self.y[c].0[lane] >= T::of(v)) {
            return self.finish(lane, Status::Reached, out);
        }
        self.out_of_steps(lane, out)
    }

    fn keep_sides(&mut self, lane: usize) {
        for (old, new) in self.sides.iter_mut().zip(&self.sides_new) {
            old.0[lane] = new.0[lane];
        }
    }

    fn out_of_steps(&mut self, lane: usize, out: &mut Output<'_>) -> bool {
        self.steps[lane] + self.rejected[lane] >= self.run.max_steps && self.finish(lane, Status::StepLimit, out)
    }

    /// First step of a fresh lane, from the derivative that its empty step has left.
    fn start(&mut self, lane: usize, out: &mut Output<'_>) -> bool {
        let (dim, tableau) = (self.kernel.dim, self.kernel.tableau);
        let last = (tableau.stages() - 1) * dim;
        let (mut size, mut speed) = (0.0, 0.0);
        for c in 0..dim {
            let (y, k) = (self.y[c].0[lane], self.k[last + c].0[lane]);
            self.k[c].0[lane] = k;
            let scale = self.atol[c].f64() + self.run.rtol * y.f64().abs();
            size += (y.f64() / scale).powi(2);
            speed += (k.f64() / scale).powi(2);
        }
        if !speed.is_finite() {
            return self.finish(lane, Status::NotFinite, out);
        }
        if self.next_level[lane] == self.run.levels.len() {
            return self.finish(lane, Status::Reached, out);
        }
        let first = if tableau.adaptive() {
            tableau.first() * (size / speed).sqrt()
        } else {
            self.run.step
        };
        // At rest there is nothing to follow, but a finite step keeps the arithmetic going to the step limit.
        let first = if first.is_finite() && first > 0.0 {
            first
        } else {
            tableau.first()
        };
        self.fresh[lane] = false;
        self.keep_sides(lane);
        self.first_step.0[lane] = T::of(first);
        self.before.0[lane] = 1.0;
        self.h.0[lane] = T::of(first);
        if let (By::Time, Some(end)) = (self.kernel.by, self.run.levels.last()) {
            self.h.0[lane] = stretched(self.h.0[lane], T::of(*end));
        }
        false
    }

    /// Guards and levels within an accepted step; the status when the trajectory ends in it, with its last point in
    /// `y` and `t`.
    #[inline(always)]
    fn events<const FMA: bool>(&mut self, lane: usize, out: &mut Output<'_>) -> Option<Status> {
        for c in 0..self.kernel.dim {
            self.dense[c] = self.polynomial(lane, c);
        }
        let mut most = T::of(1.0);
        let mut ended = None;
        if self.kernel.guards.is_some() && !self.guards_hold::<FMA>(lane, T::of(1.0)) {
            most = self.last_inside::<FMA>(lane);
            ended = Some(Status::Guard);
        }
        let levels = &self.run.levels;
        let (start, end) = match self.kernel.by {
            By::Time => (self.t.0[lane], self.t.0[lane] + self.h.0[lane]),
            By::Component(c) => (self.y[c].0[lane], self.y_new[c].0[lane]),
        };
        while self.next_level[lane] < levels.len() {
            let k = self.next_level[lane];
            let level = T::of(levels[k]);
            if level > end {
                break;
            }
            let last = k + 1 == levels.len();
            if self.kernel.store || last {
                let q = self.locate::<FMA>(lane, level, start, end);
                if q > most {
                    break;
                }
                if self.kernel.store {
                    self.store_sample::<FMA>(lane, k, q, out);
                }
                if last {
                    most = q;
                    ended = Some(Status::Reached);
                }
            }
            self.next_level[lane] += 1;
        }
        self.expect_level(lane);
        if ended.is_some() {
            for c in 0..self.kernel.dim {
                self.y[c].0[lane] = self.interpolate::<FMA>(lane, c, most);
            }
            self.t.0[lane] = most.mul_add::<FMA>(self.h.0[lane], self.t.0[lane]);
            // A level that ends the trajectory is met by definition.
            if let (Some(Status::Reached), By::Component(c)) = (ended, self.kernel.by) {
                self.y[c].0[lane] = T::of(levels[levels.len() - 1]);
            }
        }
        ended
    }

    /// Component `c` at fraction `q` of the lane's step, from the dense output in hand.
    #[inline(always)]
    fn interpolate<const FMA: bool>(&self, lane: usize, c: usize, q: T) -> T {
        if q == T::of(1.0) {
            return self.y_new[c].0[lane];
        }
        (cubic::<T, FMA>(&self.dense[c], q) * q).mul_add::<FMA>(self.h.0[lane], self.y[c].0[lane])
    }

    /// Coefficients of the dense output of component `c`: `y + h q (p0 + q (p1 + q (p2 + q p3)))`.
    #[inline(always)]
    fn polynomial(&self, lane: usize, c: usize) -> [T; 4] {
        let mut p = [T::of(0.0); 4];
        for (j, d) in self.kernel.tableau.dense.iter().enumerate() {
            let k = self.k[j * self.kernel.dim + c].0[lane];
            for (p, d) in p.iter_mut().zip(d) {
                *p = *p + k * T::of(*d);
            }
        }
        p
    }

    /// Fraction of the step at which the coordinate takes the value `level`, by Newton's method kept within a bracket.
    #[inline(always)]
    fn locate<const FMA: bool>(&self, lane: usize, level: T, start: T, end: T) -> T {
        let guess = (level - start) / (end - start);
        let By::Component(c) = self.kernel.by else {
            return if level == end { T::of(1.0) } else { guess };
        };
        if level >= end {
            return T::of(1.0);
        }
        let p = &self.dense[c];
        let h = self.h.0[lane];
        let (mut lo, mut hi, mut q) = (T::of(0.0), T::of(1.0), guess);
        for _ in 0..30 {
            let residual = (cubic::<T, FMA>(p, q) * q).mul_add::<FMA>(h, start - level);
            let slope = T::of(4.0) * p[3] * q * q * q + T::of(3.0) * p[2] * q * q + T::of(2.0) * p[1] * q + p[0];
            if residual > T::of(0.0) {
                hi = q;
            } else {
                lo = q;
            }
            let newton = q - residual / (slope * h);
            // A root at a bracket's end may be missed by rounding; halving the bracket then would lead away from it.
            let slack = T::of(4.0 * T::EPSILON);
            let inside = newton >= lo - slack && newton <= hi + slack;
            let next = if inside { newton } else { T::of(0.5) * (lo + hi) };
            let moved = (next - q).absolute();
            q = next;
            if moved <= T::of(2.0 * T::EPSILON) {
                break;
            }
        }
        q
    }

    #[inline(always)]
    fn store_sample<const FMA: bool>(&self, lane: usize, level: usize, q: T, out: &mut Output<'_>) {
        let Some(i) = self.trajectory[lane] else { return };
        let dim = self.kernel.dim;
        let start = (i * self.run.levels.len() + level) * (1 + dim);
        let to = &mut out.samples[start..start + 1 + dim];
        to[0] = q.mul_add::<FMA>(self.h.0[lane], self.t.0[lane]).f64();
        for c in 0..dim {
            to[1 + c] = self.interpolate::<FMA>(lane, c, q).f64();
        }
        if let By::Component(c) = self.kernel.by {
            to[1 + c] = self.run.levels[level];
        }
    }

    /// Whether the lane is inside all guards at a fraction of its step.
    #[inline(always)]
    fn guards_hold<const FMA: bool>(&mut self, lane: usize, q: T) -> bool {
        let Some((program, strict)) = &self.kernel.guards else {
            return true;
        };
        for c in 0..self.kernel.inputs {
            let value = self.interpolate::<FMA>(lane, c, q);
            program.inputs(&mut self.guard_file, self.kernel.inputs)[c].0[lane] = value;
        }
        program.run::<T, W, FMA>(&mut self.guard_file);
        strict.iter().enumerate().all(|(g, strict)| {
            let value = program.output(&self.guard_file, g).0[lane];
            if *strict {
                value > T::of(0.0)
            } else {
                value >= T::of(0.0)
            }
        })
    }

    /// Largest fraction of the step, to rounding, up to which the guards hold.
    #[inline(always)]
    fn last_inside<const FMA: bool>(&mut self, lane: usize) -> T {
        let (mut lo, mut hi) = (T::of(0.0), T::of(1.0));
        while (hi - lo).f64() > 4.0 * T::EPSILON {
            let middle = T::of(0.5) * (lo + hi);
            if self.guards_hold::<FMA>(lane, middle) {
                lo = middle;
            } else {
                hi = middle;
            }
        }
        lo
    }

    /// Writes a lane's result; the lane is then free.
    fn finish(&mut self, lane: usize, status: Status, out: &mut Output<'_>) -> bool {
        if let Some(i) = self.trajectory[lane] {
            let dim = self.kernel.dim;
            for c in 0..dim {
                out.end[i * dim + c] = self.y[c].0[lane].f64();
            }
            out.end_time[i] = self.t.0[lane].f64();
            out.status[i] = status;
            out.steps[i] = self.steps[lane];
            out.rejected[i] = self.rejected[lane];
        }
        true
    }
}

/// `p0 + q (p1 + q (p2 + q p3))`
#[inline(always)]
fn cubic<T: Real, const FMA: bool>(p: &[T; 4], q: T) -> T {
    p[3].mul_add::<FMA>(q, p[2])
        .mul_add::<FMA>(q, p[1])
        .mul_add::<FMA>(q, p[0])
}

#[inline(always)]
fn larger<T: Real>(a: T, b: T) -> T {
    if a > b { a } else { b }
}

/// A step of `h`, or the `left` way where that is no more than a little further: no crumb is left at the end.
#[inline(always)]
fn stretched<T: Real>(h: T, left: T) -> T {
    if h * T::of(1.0 + 1e-3) >= left { left } else { h }
}

/// Base-2 logarithm to 1e-4, for step control only.
#[inline(always)]
fn log2(x: f32) -> f32 {
    let bits = x.to_bits();
    let exponent = (bits >> 23) as i32 - 127;
    let m = f32::from_bits((bits & 0x007f_ffff) | 0x3f80_0000);
    // 2/log(2) artanh(s), s = (m - 1)/(m + 1) <= 1/3.
    let s = (m - 1.0) / (m + 1.0);
    let z = s * s;
    let p = s * (2.885_390_1 + z * (0.961_796_7 + z * (0.577_078 + z * 0.412_198_6)));
    exponent as f32 + p
}

/// Base-2 exponential to 1e-4, for step control only.
#[inline(always)]
fn exp2(x: f32) -> f32 {
    let shifted = x + 12_582_912.0;
    let n = shifted.to_bits().wrapping_sub(12_582_912.0f32.to_bits());
    let f = x - (shifted - 12_582_912.0);
    let p = 1.0 + f * (std::f32::consts::LN_2 + f * (0.240_226_5 + f * (0.055_504_1 + f * 0.009_618_1)));
    f32::from_bits(p.to_bits().wrapping_add(n << 23))
}

#[cfg(test)]
mod tests {
    #[test]
    fn step_control_functions_are_good_enough() {
        for i in -60..60 {
            let x = 1.37f32.powi(i);
            assert!((super::log2(x) - x.log2()).abs() < 1e-3, "log2({x})");
            let y = i as f32 * 0.37;
            assert!((super::exp2(y) / y.exp2() - 1.0).abs() < 1e-3, "exp2({y})");
        }
    }
}
