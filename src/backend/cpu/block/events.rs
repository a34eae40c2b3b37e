//! What happens within a block's accepted steps: levels, guards, the end.

use super::{Block, Output};
use crate::backend::cpu::arithmetic::Arithmetic;
use crate::backend::cpu::real::Real;
use crate::backend::{By, Status};
use crate::integrator::Scheme;

impl<T: Real, const W: usize> Block<'_, T, W> {
    pub(super) fn expect_level(&mut self, lane: usize) {
        let last = self.run.levels.len().saturating_sub(1);
        let next = if self.kernel.spec.store {
            self.next_level[lane]
        } else {
            last
        };
        let at = self.run.levels.get(next).copied().unwrap_or(f64::INFINITY);
        let at = if self.trajectory[lane].is_some() {
            at
        } else {
            f64::INFINITY
        };
        self.put(self.layout.next_at, lane, T::of(at));
    }

    /// Guards and levels within an accepted step; the status when the trajectory ends in it, with its last point in
    /// `y` and `t`.
    #[inline(always)]
    pub(super) fn events<const FMA: bool>(&mut self, lane: usize, out: &mut Output<'_>) -> Option<Status> {
        let (now, next) = (self.layout.now, self.layout.next);
        let mut most = T::of(1.0);
        let mut ended = None;
        if !self.inside_at_end(lane) {
            most = self.last_inside::<FMA>(lane);
            ended = Some(Status::Guard);
        }
        let levels = &self.run.levels;
        let h = self.h(lane);
        let by = self.kernel.spec.by;
        let (start, end) = match by {
            By::Time => (self.at(now.t, lane), self.at(next.t, lane)),
            By::Component(c) => (self.at(now.y + c, lane), self.at(next.y + c, lane)),
        };
        while self.next_level[lane] < levels.len() {
            let k = self.next_level[lane];
            let level = T::of(levels[k]);
            if level > end {
                break;
            }
            let last = k + 1 == levels.len();
            if self.kernel.spec.store || last {
                let q = self.locate::<FMA>(lane, level, start, end);
                if q > most {
                    break;
                }
                if self.kernel.spec.store {
                    let inside = self.store_sample::<FMA>(lane, k, q, out);
                    // Steps may be long: a stored point outside the region ends the trajectory like a step's end there.
                    if !inside && !last {
                        self.next_level[lane] += 1;
                        (most, ended) = (q, Some(Status::LeftRegion));
                        break;
                    }
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
            for c in 0..self.layout.dim {
                let v = self.interpolate::<FMA>(lane, c, most);
                self.put(next.y + c, lane, v);
            }
            let t = most.mul_add::<FMA>(h, self.at(now.t, lane));
            self.put(next.t, lane, t);
            // A level that ends the trajectory is met by definition.
            if let (Some(Status::Reached), By::Component(c)) = (ended, by) {
                self.put(next.y + c, lane, T::of(self.run.levels[self.run.levels.len() - 1]));
            }
        }
        ended
    }

    /// Whether the guards hold at the end of the lane's step.
    fn inside_at_end(&self, lane: usize) -> bool {
        let Some(guards) = &self.kernel.spec.guards else {
            return true;
        };
        let values: Vec<T> = (self.layout.guards..self.layout.accepted)
            .map(|slot| self.at(slot, lane))
            .collect();
        hold(&values, &guards.strict)
    }

    /// Computes the dense output of all lanes' steps, once a step.
    #[inline(always)]
    fn densify<const FMA: bool>(&mut self) {
        if let (Some(dense), false) = (&mut self.dense, self.densified) {
            dense.run::<FMA>(&mut self.frame);
            self.densified = true;
        }
    }

    /// The argument of the dense output at a fraction of the lane's step, and the factor before it: in a Taylor
    /// polynomial both are the time.
    #[inline(always)]
    fn argument(&self, lane: usize, q: T) -> (T, T) {
        let time = q * self.h(lane);
        match self.kernel.scheme {
            Scheme::RungeKutta(_) => (q, time),
            Scheme::Taylor(_) => (time, time),
        }
    }

    /// `p0 + z (p1 + z (p2 + ...))` of a component, and its derivative.
    #[inline(always)]
    fn polynomial<const FMA: bool>(&self, lane: usize, c: usize, z: T) -> (T, T) {
        let (first, dim, degree) = (self.layout.dense + c, self.layout.dim, self.kernel.scheme.degree());
        let mut value = self.at(first + (degree - 1) * dim, lane);
        let mut slope = T::of(0.0);
        for m in (0..degree - 1).rev() {
            slope = slope.mul_add::<FMA>(z, value);
            value = value.mul_add::<FMA>(z, self.at(first + m * dim, lane));
        }
        (value, slope)
    }

    /// Component `c` at fraction `q` of the lane's step.
    #[inline(always)]
    fn interpolate<const FMA: bool>(&mut self, lane: usize, c: usize, q: T) -> T {
        if q == T::of(1.0) {
            return self.at(self.layout.next.y + c, lane);
        }
        self.densify::<FMA>();
        let (z, factor) = self.argument(lane, q);
        let (value, _) = self.polynomial::<FMA>(lane, c, z);
        value.mul_add::<FMA>(factor, self.at(self.layout.now.y + c, lane))
    }

    /// Fraction of the step at which the coordinate takes the value `level`, by Newton's method kept within a bracket.
    #[inline(always)]
    fn locate<const FMA: bool>(&mut self, lane: usize, level: T, start: T, end: T) -> T {
        if level >= end {
            return T::of(1.0);
        }
        let guess = (level - start) / (end - start);
        let By::Component(c) = self.kernel.spec.by else {
            return guess;
        };
        self.densify::<FMA>();
        let h = self.h(lane);
        let (mut lo, mut hi, mut q) = (T::of(0.0), T::of(1.0), guess);
        for _ in 0..30 {
            let (z, factor) = self.argument(lane, q);
            let (value, slope) = self.polynomial::<FMA>(lane, c, z);
            let residual = value.mul_add::<FMA>(factor, start - level);
            // d/dq of factor * value(z); z and factor are proportional to q.
            let slope = slope.mul_add::<FMA>(z, value) * h;
            if residual > T::of(0.0) {
                hi = q;
            } else {
                lo = q;
            }
            let newton = q - residual / slope;
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

    /// Stores the point at a fraction of the step; whether it is within the region.
    #[inline(always)]
    fn store_sample<const FMA: bool>(&mut self, lane: usize, level: usize, q: T, out: &mut Output<'_>) -> bool {
        let Some(i) = self.trajectory[lane] else {
            return true;
        };
        let dim = self.layout.dim;
        let start = (i * self.run.levels.len() + level) * (1 + dim);
        let to = &mut out.samples[start..start + 1 + dim];
        to[0] = q.mul_add::<FMA>(self.h(lane), self.at(self.layout.now.t, lane)).f64();
        for c in 0..dim {
            to[1 + c] = self.interpolate::<FMA>(lane, c, q).f64();
        }
        if let By::Component(c) = self.kernel.spec.by {
            to[1 + c] = self.run.levels[level];
        }
        let bounds = self.run.bounds.iter().zip(&to[1..]);
        bounds.fold(true, |inside, ([lo, hi], x)| inside & (*x >= *lo) & (*x <= *hi))
    }

    /// Largest fraction of the step, to rounding, up to which the guards hold.
    #[inline(always)]
    fn last_inside<const FMA: bool>(&mut self, lane: usize) -> T {
        let kernel = self.kernel;
        let Some(guards) = &kernel.spec.guards else {
            return T::of(1.0);
        };
        let (mut lo, mut hi) = (T::of(0.0), T::of(1.0));
        while (hi - lo).f64() > 4.0 * T::EPSILON {
            let middle = T::of(0.5) * (lo + hi);
            let point: Vec<T> = (0..guards.program.inputs)
                .map(|c| self.interpolate::<FMA>(lane, c, middle))
                .collect();
            let values = T::With::<FMA>::default().program(&guards.program, &point);
            if hold(&values, &guards.strict) {
                lo = middle;
            } else {
                hi = middle;
            }
        }
        lo
    }
}

fn hold<T: Real>(values: &[T], strict: &[bool]) -> bool {
    let zero = T::of(0.0);
    values
        .iter()
        .zip(strict)
        .all(|(v, strict)| if *strict { *v > zero } else { *v >= zero })
}
