//! What happens within a block's accepted steps: levels, guards, the end.

use super::{Block, Output};
use crate::backend::cpu::arithmetic::Arithmetic;
use crate::backend::cpu::real::Real;
use crate::backend::{By, Status};
use crate::integrator::Scheme;

/// Levels looked at together.
const AT_ONCE: usize = 8;

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

    /// Guards and levels within an accepted step; the status when the trajectory ends in it, with
    /// its last point in `y` and `t`.
    #[inline(always)]
    pub(super) fn events<const FMA: bool>(
        &mut self,
        lane: usize,
        out: &mut Output<'_>,
    ) -> Option<Status> {
        let (now, next) = (self.layout.now, self.layout.next);
        let mut most = T::of(1.0);
        let mut ended = None;
        if let Some((status, at)) = self.ended[lane].take() {
            (ended, most) = (Some(status), at);
        } else if !self.inside_at_end(lane) {
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
        let store = self.kernel.spec.store;
        if !store {
            self.next_level[lane] = levels.len() - 1;
        }
        let is_passed = |k: usize| k < levels.len() && T::of(levels[k]) <= end;
        while !matches!(ended, Some(Status::Reached | Status::LeftRegion))
            && is_passed(self.next_level[lane])
        {
            let first = self.next_level[lane];
            let count = (1..AT_ONCE).take_while(|j| is_passed(first + j)).count() + 1;
            let wanted = std::array::from_fn(|j| T::of(levels[first + j.min(count - 1)]));
            let located = self.locate::<FMA>(lane, wanted, start, end);
            // What lies behind a guard met is not passed.
            let inside = located[..count].iter().take_while(|q| **q <= most).count();
            let (stored, within) = if store {
                self.store_samples::<FMA>(lane, first, &located, inside, out)
            } else {
                (inside, true)
            };
            self.next_level[lane] += stored;
            if stored > 0 && (!within || self.next_level[lane] == levels.len()) {
                most = located[stored - 1];
                // Steps may be long: a stored point outside the region ends the trajectory like a
                // step's end there.
                let last = self.next_level[lane] == levels.len();
                ended = Some(if last {
                    Status::Reached
                } else {
                    Status::LeftRegion
                });
                break;
            }
            if stored < count {
                break;
            }
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
                self.put(
                    next.y + c,
                    lane,
                    T::of(self.run.levels[self.run.levels.len() - 1]),
                );
            }
        }
        ended
    }

    /// Whether the guards hold at the end of the lane's step.
    pub(super) fn inside_at_end(&self, lane: usize) -> bool {
        let Some(guards) = &self.kernel.spec.guards else {
            return true;
        };
        let values = (self.layout.guards..self.layout.accepted).map(|slot| self.at(slot, lane));
        hold(values, &guards.strict)
    }

    /// Computes the dense output of all lanes' steps, once a step.
    #[inline(always)]
    pub(super) fn densify<const FMA: bool>(&mut self) {
        if let (Some(dense), false) = (&mut self.dense, self.densified) {
            dense.run::<FMA>(&mut self.frame);
            self.densified = true;
        }
    }

    /// The argument of the dense output at a fraction of the lane's step, and the factor before it:
    /// in a Taylor polynomial both are the time.
    #[inline(always)]
    fn argument(&self, lane: usize, q: T) -> (T, T) {
        let time = q * self.h(lane);
        match self.kernel.scheme {
            Scheme::RungeKutta(_) => (q, time),
            Scheme::Taylor(_) => (time, time),
        }
    }

    /// Takes the lane's dense output in hand.
    #[inline(always)]
    fn gather<const FMA: bool>(&mut self, lane: usize) {
        self.densify::<FMA>();
        let (dim, degree) = (self.layout.dim, self.kernel.scheme.degree());
        for c in 0..dim {
            for m in 0..degree {
                self.polynomials[c * degree + m] =
                    self.frame[self.layout.dense + m * dim + c].0[lane];
            }
        }
    }

    /// `p0 + z (p1 + z (p2 + ...))` of a component in hand, and its derivative.
    #[inline(always)]
    fn polynomial<const FMA: bool, const N: usize>(
        &self,
        c: usize,
        z: &[T; N],
    ) -> ([T; N], [T; N]) {
        let degree = self.kernel.scheme.degree();
        let p = &self.polynomials[c * degree..(c + 1) * degree];
        let (mut value, mut slope) = ([p[degree - 1]; N], [T::of(0.0); N]);
        for p in p[..degree - 1].iter().rev() {
            for j in 0..N {
                slope[j] = slope[j].mul_add::<FMA>(z[j], value[j]);
                value[j] = value[j].mul_add::<FMA>(z[j], *p);
            }
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
        let (first, dim, degree) = (
            self.layout.dense + c,
            self.layout.dim,
            self.kernel.scheme.degree(),
        );
        let mut value = self.at(first + (degree - 1) * dim, lane);
        for m in (0..degree - 1).rev() {
            value = value.mul_add::<FMA>(z, self.at(first + m * dim, lane));
        }
        value.mul_add::<FMA>(factor, self.at(self.layout.now.y + c, lane))
    }

    /// Fractions of the step at which the coordinate takes some values, by Newton's method kept
    /// within brackets. Leaves the lane's dense output in hand.
    #[inline(always)]
    fn locate<const FMA: bool>(
        &mut self,
        lane: usize,
        levels: [T; AT_ONCE],
        start: T,
        end: T,
    ) -> [T; AT_ONCE] {
        let (zero, one) = (T::of(0.0), T::of(1.0));
        let mut q: [T; AT_ONCE] = std::array::from_fn(|j| {
            let guess = (levels[j] - start) / (end - start);
            if levels[j] >= end { one } else { guess }
        });
        if !self.kernel.spec.store && q[0] == one {
            return q;
        }
        self.gather::<FMA>(lane);
        let By::Component(c) = self.kernel.spec.by else {
            return q;
        };
        let h = self.h(lane);
        let (mut lo, mut hi) = ([zero; AT_ONCE], [one; AT_ONCE]);
        // A root at a bracket's end may be missed by rounding; halving the bracket then would lead
        // away from it.
        let slack = T::of(4.0 * T::EPSILON);
        for _ in 0..30 {
            let mut z = q;
            let mut factor = q;
            for j in 0..AT_ONCE {
                (z[j], factor[j]) = self.argument(lane, q[j]);
            }
            let (value, slope) = self.polynomial::<FMA, AT_ONCE>(c, &z);
            let mut moved = zero;
            for j in 0..AT_ONCE {
                let residual = value[j].mul_add::<FMA>(factor[j], start - levels[j]);
                // d/dq of factor * value(z); z and factor are proportional to q.
                let slope = slope[j].mul_add::<FMA>(z[j], value[j]) * h;
                let above = residual > zero;
                hi[j] = if above { q[j] } else { hi[j] };
                lo[j] = if above { lo[j] } else { q[j] };
                let newton = q[j] - residual / slope;
                let inside = (newton >= lo[j] - slack) & (newton <= hi[j] + slack);
                let next = if inside {
                    newton
                } else {
                    T::of(0.5) * (lo[j] + hi[j])
                };
                // The end of the step is found without a search.
                let next = if levels[j] >= end { one } else { next };
                let change = (next - q[j]).absolute();
                moved = if change > moved { change } else { moved };
                q[j] = next;
            }
            if moved <= T::of(2.0 * T::EPSILON) {
                break;
            }
        }
        q
    }

    /// Stores the points at fractions of the step whose dense output is in hand, up to the first
    /// one outside the region; how many, and whether all are within it.
    #[inline(always)]
    fn store_samples<const FMA: bool>(
        &self,
        lane: usize,
        level: usize,
        q: &[T; AT_ONCE],
        count: usize,
        out: &mut Output<'_>,
    ) -> (usize, bool) {
        let Some(i) = self.trajectory[lane] else {
            return (count, true);
        };
        let (dim, now, next) = (self.layout.dim, self.layout.now, self.layout.next);
        let (width, h, t) = (1 + dim, self.h(lane), self.at(now.t, lane));
        let start = (i * self.run.levels.len() + level) * width;
        let to = &mut out.samples[start..start + count * width];
        let (mut z, mut factor) = (*q, *q);
        for j in 0..AT_ONCE {
            (z[j], factor[j]) = self.argument(lane, q[j]);
        }
        let mut inside = [true; AT_ONCE];
        for c in 0..dim {
            let (mut value, _) = self.polynomial::<FMA, AT_ONCE>(c, &z);
            let (begin, end) = (self.at(now.y + c, lane), self.at(next.y + c, lane));
            for j in 0..AT_ONCE {
                let v = value[j].mul_add::<FMA>(factor[j], begin);
                value[j] = if q[j] == T::of(1.0) { end } else { v };
            }
            if let Some([lo, hi]) = self.run.bounds.get(c) {
                let (lo, hi) = (T::of(*lo), T::of(*hi));
                for j in 0..AT_ONCE {
                    inside[j] &= (value[j] >= lo) & (value[j] <= hi);
                }
            }
            for (row, v) in to.chunks_exact_mut(width).zip(&value) {
                row[1 + c] = v.f64();
            }
        }
        for (j, row) in to.chunks_exact_mut(width).enumerate() {
            row[0] = q[j].mul_add::<FMA>(h, t).f64();
            if let By::Component(c) = self.kernel.spec.by {
                row[1 + c] = self.run.levels[level + j];
            }
        }
        match inside[..count].iter().position(|inside| !inside) {
            None => (count, true),
            Some(outside) => {
                to[(outside + 1) * width..].fill(f64::NAN);
                (outside + 1, false)
            }
        }
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
            if hold(values.into_iter(), &guards.strict) {
                lo = middle;
            } else {
                hi = middle;
            }
        }
        lo
    }
}

fn hold<T: Real>(values: impl Iterator<Item = T>, strict: &[bool]) -> bool {
    let zero = T::of(0.0);
    values
        .zip(strict)
        .all(|(v, strict)| if *strict { v > zero } else { v >= zero })
}
