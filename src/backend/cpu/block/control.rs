//! Step control of a block.

use super::{Block, Decision};
use crate::backend::By;
use crate::backend::cpu::lanes::Lanes;
use crate::backend::cpu::real::Real;
use crate::integrator::{Scheme, control, taylor};

impl<T: Real, const W: usize> Block<'_, T, W> {
    /// Accepts or rejects each lane's step, chooses its next size, and finds the lanes to be looked at singly.
    #[inline(always)]
    pub(super) fn control<const FMA: bool>(&mut self) -> Decision<T, W> {
        let adaptive = self.kernel.adaptive();
        let error = self.frame[self.layout.error];
        let mut decided = Decision {
            accepted: [false; W],
            finite: [false; W],
            next_h: Lanes(*self.h()),
            special: [0; W],
        };
        for i in 0..W {
            decided.finite[i] = error.0[i].is_finite();
            decided.accepted[i] = error.0[i] <= T::of(1.0);
        }
        match self.kernel.scheme {
            Scheme::RungeKutta(tableau) if tableau.adaptive() => {
                let factor = self.factors(&error, tableau.exponent());
                for i in 0..W {
                    decided.next_h.0[i] = decided.next_h.0[i] * T::of(f64::from(factor[i]));
                }
            }
            Scheme::RungeKutta(_) => {}
            Scheme::Taylor(_) => {
                // The next expansion says how far it reaches.
                let (shrink, any) = (T::of(control::SHRINK), T::of(f64::INFINITY));
                for i in 0..W {
                    let shorter = decided.next_h.0[i] * shrink;
                    decided.next_h.0[i] = if decided.accepted[i] { any } else { shorter };
                }
            }
        }
        if adaptive && !self.sides.is_empty() {
            self.meet_kinks::<FMA>(&mut decided);
        }
        self.limit(&mut decided);
        let most = self.run.max_steps.saturating_sub(1);
        let unit = T::of(control::FLOOR_ULPS * T::EPSILON);
        let by = self.kernel.spec.by;
        for i in 0..W {
            let passed = match by {
                By::Time => self.t.0[i] + self.h()[i] >= self.next_at.0[i],
                By::Component(c) => self.y_new(c)[i] >= self.next_at.0[i],
            };
            let floor = unit * larger(self.t.0[i], self.first_step.0[i]);
            let stuck = !decided.accepted[i] & (!adaptive | (decided.next_h.0[i] < floor));
            let spent = self.steps[i] + self.rejected[i] >= most;
            decided.special[i] = u8::from(passed | stuck | spent);
        }
        self.look_outside(&mut decided.special);
        decided
    }

    /// Refuses steps with a kink well inside, in favour of ones that end there.
    #[inline(always)]
    fn meet_kinks<const FMA: bool>(&mut self, decided: &mut Decision<T, W>) {
        let zero = T::of(0.0);
        // Fraction of the step up to the first kink; 2 where there is none.
        let mut first = [T::of(2.0); W];
        for (g, old) in self.sides.iter().enumerate() {
            let new = &self.frame[self.layout.kinks + g].0;
            for i in 0..W {
                let (a, b) = (old.0[i], new[i]);
                let crossed = (a < zero) & (b >= zero) | (a > zero) & (b <= zero);
                let q = a / (a - b);
                first[i] = if crossed & (q < first[i]) { q } else { first[i] };
            }
        }
        let (share, floor) = (
            T::of(control::at_kink(T::EPSILON)),
            T::of(control::FLOOR_ULPS * T::EPSILON),
        );
        // A Taylor step keeps the branch it began with: it must never begin just before a kink.
        let exact = matches!(self.kernel.scheme, Scheme::Taylor(_));
        for i in 0..W {
            let q = first[i];
            let (h, resume) = (self.h()[i], self.resume.0[i]);
            // A share of the step that kinks have not shortened, and no less than the floor: what is left of shorter
            // ones is lost in rounding.
            let near = share * larger(h, resume);
            let near = larger(near, floor * larger(self.t.0[i], self.first_step.0[i]));
            let ahead = (h * q > near) | exact & (h > near + near);
            let inside = decided.accepted[i] & (q < T::of(2.0)) & ahead & (h * (T::of(1.0) - q) > near);
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
    fn factors(&mut self, error: &Lanes<T, W>, unit: f64) -> [f32; W] {
        let mut e = [0.0f32; W];
        for i in 0..W {
            e[i] = error.0[i].f32();
        }
        let least = (control::LEAST_ERROR * control::LEAST_ERROR) as f32;
        let (safety, grow, shrink) = (control::SAFETY as f32, control::GROW as f32, control::SHRINK as f32);
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
        let (By::Time, Some(end)) = (self.kernel.spec.by, self.run.levels.last()) else {
            return;
        };
        for i in 0..W {
            // A refused step has not passed the end, and one that ends at a kink just before it must not be stretched.
            let left = T::of(*end) - (self.t.0[i] + self.h()[i]);
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
    fn look_outside(&self, special: &mut [u8; W]) {
        for (c, [lo, hi]) in self.run.bounds.iter().enumerate() {
            let (lo, hi) = (T::of(*lo), T::of(*hi));
            let y = self.y_new(c);
            for i in 0..W {
                special[i] |= u8::from(!((y[i] >= lo) & (y[i] <= hi)));
            }
        }
        if let Some((c, v)) = self.run.ceiling {
            let v = T::of(v);
            for i in 0..W {
                special[i] |= u8::from(self.y_new(c)[i] >= v);
            }
        }
        if let Some(guards) = &self.kernel.spec.guards {
            for (g, strict) in guards.strict.iter().enumerate() {
                let value = &self.frame[self.layout.guards + g].0;
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
}

/// Steps at which the last terms of Taylor expansions are as large as the tolerance, but no longer than wanted.
#[inline(always)]
pub(super) fn taylor_steps<T: Real, const W: usize>(
    order: usize,
    below: &Lanes<T, W>,
    top: &Lanes<T, W>,
    wanted: &Lanes<T, W>,
    h: &mut Lanes<T, W>,
) {
    let (p, q) = (-1.0 / (order as f32 - 1.0), -1.0 / order as f32);
    let safety = taylor::safety(order) as f32;
    for i in 0..W {
        let (a, b) = (below.0[i].f32(), top.0[i].f32());
        let (a, b) = (log2(a) * p, log2(b) * q);
        let reach = safety * exp2(if a < b { a } else { b });
        // What is not finite takes no step, and is refused for it.
        let finite = below.0[i].is_finite() & top.0[i].is_finite();
        let reach = T::of(f64::from(if finite { reach } else { 0.0 }));
        h.0[i] = if reach * T::of(1.0 + 1e-3) >= wanted.0[i] { wanted.0[i] } else { reach };
    }
}

#[inline(always)]
fn larger<T: Real>(a: T, b: T) -> T {
    if a > b { a } else { b }
}

/// A step of `h`, or the `left` way where that is no more than a little further: no crumb is left at the end.
#[inline(always)]
pub(super) fn stretched<T: Real>(h: T, left: T) -> T {
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
