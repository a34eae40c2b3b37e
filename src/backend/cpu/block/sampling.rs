//! Points at the levels that trajectories pass in a step: of all lanes together, a level of each at
//! a time. Lanes whose trajectory meets a guard in the step are left to `events`, which knows how
//! far they get.

use super::{Block, Output};
use crate::backend::cpu::real::Real;
use crate::backend::{By, Status};
use crate::integrator::Scheme;

/// Most iterations of Newton's method, or halvings.
const ITERATIONS: usize = 30;

/// The sampling coordinate over the lanes' steps.
struct Course<T, const W: usize> {
    start: [T; W],
    end: [T; W],
    /// Its rise over what its rates at the start and at the end would make of it; 1 where it is the
    /// time.
    first: [T; W],
    last: [T; W],
}

impl<T: Real, const W: usize> Course<T, W> {
    /// First guesses of the fractions of the steps at which the coordinate takes some values: its
    /// inverse by Hermite's cubic between the ends.
    #[inline(always)]
    fn guess(&self, levels: &[T; W]) -> [T; W] {
        let one = T::of(1.0);
        let mut guess = [one; W];
        for lane in 0..W {
            let (start, end, level) = (self.start[lane], self.end[lane], levels[lane]);
            let y = (level - start) / (end - start);
            let rest = one - y;
            let bend = (self.first[lane] - one) * rest + (one - self.last[lane]) * y;
            let q = y + y * rest * bend;
            // Not where it all but stands still at an end, or rises and falls.
            let within = (q >= T::of(0.0)) & (q <= one);
            let q = if within { q } else { y };
            guess[lane] = if level >= end { one } else { q };
        }
        guess
    }
}

impl<T: Real, const W: usize> Block<'_, T, W> {
    /// Stores the points at all levels that lanes pass in the step at hand, and notes where that
    /// ends a trajectory.
    #[inline(always)]
    pub(super) fn sample<const FMA: bool>(&mut self, out: &mut Output<'_>) {
        let (now, next) = (self.layout.now, self.layout.next);
        let (from, to) = match self.kernel.spec.by {
            By::Time => (now.t, next.t),
            By::Component(c) => (now.y + c, next.y + c),
        };
        let end = self.frame[to].0;
        let mut passing: [bool; W] = std::array::from_fn(|lane| {
            self.trajectory[lane].is_some()
                && self.set(self.layout.special, lane)
                && self.set(self.layout.accepted, lane)
                && self.passes(lane, end[lane])
                && self.inside_at_end(lane)
        });
        if !passing.contains(&true) {
            return;
        }
        self.densify::<FMA>();
        let course = self.course::<FMA>(from, to);
        let levels = &self.run.levels;
        while passing.contains(&true) {
            let wanted: [T; W] = std::array::from_fn(|lane| match passing[lane] {
                true => T::of(levels[self.next_level[lane]]),
                false => end[lane],
            });
            let q = self.fractions::<FMA>(&course, &wanted);
            self.evaluate::<FMA>(&q);
            for lane in 0..W {
                if passing[lane] {
                    self.store(lane, out);
                    passing[lane] = match self.after_level(lane) {
                        None => self.passes(lane, end[lane]),
                        Some(status) => {
                            self.ended[lane] = Some((status, q[lane]));
                            false
                        }
                    };
                }
            }
        }
    }

    /// Whether a lane has a level at or before a coordinate.
    fn passes(&self, lane: usize, coordinate: T) -> bool {
        (self.run.levels.get(self.next_level[lane])).is_some_and(|l| T::of(*l) <= coordinate)
    }

    /// The argument of the dense output at fractions of the lanes' steps, and the factor before it:
    /// of a Taylor polynomial both are the time.
    #[inline(always)]
    fn arguments(&self, q: &[T; W]) -> ([T; W], [T; W]) {
        let h = &self.frame[self.layout.h].0;
        let mut time = *q;
        for lane in 0..W {
            time[lane] = time[lane] * h[lane];
        }
        match self.kernel.scheme {
            Scheme::RungeKutta(_) => (*q, time),
            Scheme::Taylor(_) => (time, time),
        }
    }

    /// The coordinate over the lanes' steps.
    #[inline(always)]
    fn course<const FMA: bool>(&self, from: usize, to: usize) -> Course<T, W> {
        let one = T::of(1.0);
        let mut course = Course {
            start: self.frame[from].0,
            end: self.frame[to].0,
            first: [one; W],
            last: [one; W],
        };
        if let By::Component(c) = self.kernel.spec.by {
            let (z, _) = self.arguments(&[one; W]);
            let (value, slope) = self.polynomial_of_all::<FMA>(c, &z);
            let h = &self.frame[self.layout.h].0;
            let at_start = &self.frame[self.layout.dense + c].0;
            for lane in 0..W {
                let slope = slope[lane].mul_add::<FMA>(z[lane], value[lane]) * h[lane];
                let rise = course.end[lane] - course.start[lane];
                course.first[lane] = rise / (at_start[lane] * h[lane]);
                course.last[lane] = rise / slope;
            }
        }
        course
    }

    /// `p0 + z (p1 + z (p2 + ...))` of a component in all lanes, and its derivative.
    #[inline(always)]
    fn polynomial_of_all<const FMA: bool>(&self, c: usize, z: &[T; W]) -> ([T; W], [T; W]) {
        let (layout, degree) = (&self.layout, self.kernel.scheme.degree());
        let (first, dim) = (layout.dense + c, layout.dim);
        let mut value = self.frame[first + (degree - 1) * dim].0;
        let mut slope = [T::of(0.0); W];
        for m in (0..degree - 1).rev() {
            let p = &self.frame[first + m * dim].0;
            for lane in 0..W {
                slope[lane] = slope[lane].mul_add::<FMA>(z[lane], value[lane]);
                value[lane] = value[lane].mul_add::<FMA>(z[lane], p[lane]);
            }
        }
        (value, slope)
    }

    /// Fractions of the step at which the coordinate takes a value in each lane, by Newton's method
    /// kept within brackets. A lane's result does not depend on the others.
    #[inline(always)]
    fn fractions<const FMA: bool>(&self, course: &Course<T, W>, levels: &[T; W]) -> [T; W] {
        let Course { start, end, .. } = course;
        let mut q = course.guess(levels);
        let By::Component(c) = self.kernel.spec.by else {
            return q;
        };
        let (zero, one, half) = (T::of(0.0), T::of(1.0), T::of(0.5));
        let h = &self.frame[self.layout.h].0;
        let (mut lo, mut hi) = ([zero; W], [one; W]);
        // A root at a bracket's end may be missed by rounding; halving the bracket then would lead
        // away from it.
        let slack = T::of(4.0 * T::EPSILON);
        // Newton's method squares what is left: after so small a step it is below rounding.
        let near = T::of(T::EPSILON.sqrt() / 16.0);
        let close = T::of(2.0 * T::EPSILON);
        // The end of the step is found without a search.
        let mut searches: [bool; W] = std::array::from_fn(|lane| levels[lane] < end[lane]);
        for _ in 0..ITERATIONS {
            let (z, factor) = self.arguments(&q);
            let (value, slope) = self.polynomial_of_all::<FMA>(c, &z);
            let mut moves = false;
            for lane in 0..W {
                let residual = value[lane].mul_add::<FMA>(factor[lane], start[lane] - levels[lane]);
                // d/dq of factor * value(z); z and factor are proportional to q.
                let slope = slope[lane].mul_add::<FMA>(z[lane], value[lane]) * h[lane];
                let above = residual > zero;
                hi[lane] = if above { q[lane] } else { hi[lane] };
                lo[lane] = if above { lo[lane] } else { q[lane] };
                let newton = q[lane] - residual / slope;
                let inside = (newton >= lo[lane] - slack) & (newton <= hi[lane] + slack);
                let halved = half * (lo[lane] + hi[lane]);
                let next = if inside { newton } else { halved };
                let change = (next - q[lane]).absolute();
                q[lane] = if searches[lane] { next } else { q[lane] };
                let enough = if inside { near } else { close };
                searches[lane] &= change > enough;
                moves |= searches[lane];
            }
            if !moves {
                break;
            }
        }
        q
    }

    /// Computes all components, and as the last one the time, at fractions of the lanes' steps.
    #[inline(always)]
    fn evaluate<const FMA: bool>(&mut self, q: &[T; W]) {
        let layout = self.layout;
        let dim = layout.dim;
        let (z, factor) = self.arguments(q);
        for c in 0..dim {
            let (mut value, _) = self.polynomial_of_all::<FMA>(c, &z);
            let begin = &self.frame[layout.now.y + c].0;
            let end = &self.frame[layout.next.y + c].0;
            for lane in 0..W {
                let v = value[lane].mul_add::<FMA>(factor[lane], begin[lane]);
                value[lane] = if q[lane] == T::of(1.0) { end[lane] } else { v };
            }
            self.points[c].0 = value;
        }
        let (t, h) = (&self.frame[layout.now.t].0, &self.frame[layout.h].0);
        self.points[dim].0 = std::array::from_fn(|lane| q[lane].mul_add::<FMA>(h[lane], t[lane]));
    }

    /// Writes a lane's point at its next level.
    #[inline(always)]
    fn store(&self, lane: usize, out: &mut Output<'_>) {
        let Some(i) = self.trajectory[lane] else {
            return;
        };
        let (dim, level) = (self.layout.dim, self.next_level[lane]);
        let row = &mut out.samples[(i * self.run.levels.len() + level) * (1 + dim)..][..1 + dim];
        row[0] = self.points[dim].0[lane].f64();
        for (to, from) in row[1..].iter_mut().zip(&self.points) {
            *to = from.0[lane].f64();
        }
        if let By::Component(c) = self.kernel.spec.by {
            row[1 + c] = self.run.levels[level];
        }
    }

    /// Goes on to a lane's next level; the status where the one passed has ended its trajectory.
    /// Steps may be long: a stored point outside the region ends it like a step's end there.
    #[inline(always)]
    fn after_level(&mut self, lane: usize) -> Option<Status> {
        self.next_level[lane] += 1;
        if self.next_level[lane] == self.run.levels.len() {
            return Some(Status::Reached);
        }
        let outside = (self.run.bounds.iter().zip(&self.points)).any(|([lo, hi], point)| {
            let v = point.0[lane];
            !((v >= T::of(*lo)) & (v <= T::of(*hi)))
        });
        outside.then_some(Status::LeftRegion)
    }
}
