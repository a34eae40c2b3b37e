//! Step control as vector code: what follows from an attempted step, and which lanes must be looked
//! at singly.

use super::arithmetic::{Arithmetic, Comparison};
use super::code::{Recorder, Value};
use super::steps::{Layout, Parameters, Taken};
use crate::backend::{By, Spec};
use crate::integrator::{Scheme, control};

/// What follows from an attempted step; masks are all ones or zero.
pub struct Decision {
    accepted: Value,
    next_h: Value,
    before: Value,
    resume: Value,
    t: Value,
    t_new: Value,
    special: Value,
}

impl Decision {
    pub fn new(
        r: &mut Recorder,
        spec: &Spec,
        layout: &Layout,
        scheme: Scheme,
        given: &Parameters,
        taken: &Taken,
    ) -> Self {
        let now = &layout.now;
        let one = r.constant(1.0);
        let accepted = r.compare(Comparison::Less, taken.error, one);
        let (t, before, resume) = (r.load(now.t), r.load(now.before), r.load(now.resume));
        let mut this = Self {
            accepted,
            next_h: taken.h,
            before,
            resume,
            t,
            t_new: r.add(t, taken.h),
            special: r.constant(0.0),
        };
        let first_step = r.load(layout.first_step);
        let reached = r.larger(t, first_step);
        let unit = r.constant(control::FLOOR_ULPS * r.epsilon());
        let floor = r.mul(unit, reached);
        match scheme {
            Scheme::RungeKutta(tableau) if tableau.adaptive() => {
                this.resize(r, taken, tableau.exponent())
            }
            Scheme::RungeKutta(_) => {}
            Scheme::Taylor(_) => {
                // The next expansion says how far it reaches.
                let (shrink, any) = (r.constant(control::SHRINK), r.constant(f64::INFINITY));
                let shorter = r.mul(taken.h, shrink);
                this.next_h = r.select(accepted, any, shorter);
                this.before = r.select(accepted, taken.reach, before);
            }
        }
        if scheme.adaptive() && !taken.kinks.is_empty() {
            this.meet_kinks(r, layout, taken, floor);
        }
        if spec.by == By::Time {
            // A refused step has not passed the end, and one that ends at a kink just before it
            // must not be stretched.
            let left = r.sub(given.end, this.t_new);
            let stretched = stretched(r, this.next_h, left);
            this.next_h = r.select(this.accepted, stretched, this.next_h);
        }
        this.look(r, spec, layout, scheme, given, taken, floor);
        this
    }

    /// The next step's size from this one's error (PI control, see [`control`]).
    fn resize(&mut self, r: &mut Recorder, taken: &Taken, unit: f64) {
        let e = taken.error;
        let least = r.constant(control::LEAST_ERROR * control::LEAST_ERROR);
        let size = r.larger(e, least);
        let log = log2(r, size);
        // Squared errors: the exponents are halved.
        let alpha = r.constant(-0.5 * control::ALPHA * unit);
        let beta = r.constant(0.5 * control::BETA * unit);
        let refused = r.constant(-0.5 * unit);
        let past = r.mul(beta, self.before);
        let going_on = r.mul_add(alpha, log, past);
        let going_back = r.mul(refused, log);
        let exponent = r.select(self.accepted, going_on, going_back);
        let power = exp2(r, exponent);
        let safety = r.constant(control::SAFETY);
        let factor = r.mul(safety, power);
        let (grow, one, shrink) = (
            r.constant(control::GROW),
            r.constant(1.0),
            r.constant(control::SHRINK),
        );
        let most = r.select(self.accepted, grow, one);
        let factor = r.smaller(factor, most);
        let factor = r.larger(factor, shrink);
        let zero = r.constant(0.0);
        let nothing = r.sub(e, e);
        let finite = r.compare(Comparison::Equal, nothing, zero);
        let factor = r.select(finite, factor, shrink);
        self.next_h = r.mul(taken.h, factor);
        self.before = r.select(self.accepted, log, self.before);
    }

    /// Refuses a step with a kink well inside, in favour of one that ends there.
    fn meet_kinks(&mut self, r: &mut Recorder, layout: &Layout, taken: &Taken, floor: Value) {
        let (zero, one, two) = (r.constant(0.0), r.constant(1.0), r.constant(2.0));
        // Fraction of the step up to the first kink; 2 where there is none.
        let mut first = two;
        for (g, new) in taken.kinks.iter().enumerate() {
            let old = r.load(layout.now.kinks + g);
            // Neither side of zero on which the step began.
            let mut sides = [old, *new].map(|v| {
                (
                    r.compare(Comparison::Less, v, zero),
                    r.compare(Comparison::Less, zero, v),
                )
            });
            sides[1] = (r.not(sides[1].0), r.not(sides[1].1));
            let (up, down) = (r.and(sides[0].0, sides[1].0), r.and(sides[0].1, sides[1].1));
            let crossed = r.or(up, down);
            let change = r.sub(old, *new);
            let q = r.div(old, change);
            let q = r.select(crossed, q, two);
            first = r.smaller(q, first);
        }
        let (h, q) = (taken.h, first);
        // A share of the step that kinks have not shortened, and no less than the floor: what is
        // left of shorter ones is lost in rounding.
        let share = r.constant(control::at_kink(r.epsilon()));
        let whole = r.larger(h, self.resume);
        let near = r.mul(share, whole);
        let near = r.larger(near, floor);
        let before = r.mul(h, q);
        let rest = r.sub(one, q);
        let behind = r.mul(h, rest);
        let ahead = r.compare(Comparison::Less, near, before);
        let met = r.compare(Comparison::Less, q, two);
        let met = r.and(met, self.accepted);
        let past = r.compare(Comparison::Less, near, behind);
        let inside = r.and(met, ahead);
        let inside = r.and(inside, past);
        let outside = r.not(inside);
        let crosses = r.and(met, outside);
        // The end of the shorter step is to lie behind the kink, not before it.
        let tenth = r.constant(0.1);
        let shorter = r.mul_add(tenth, near, before);
        let grown = r.larger(self.next_h, self.resume);
        let next_h = r.select(crosses, grown, self.next_h);
        self.next_h = r.select(inside, shorter, next_h);
        self.accepted = r.and(self.accepted, outside);
        let resume = r.select(crosses, zero, self.resume);
        self.resume = r.select(inside, whole, resume);
    }

    /// The lanes to be looked at singly: a level, a guard, a bound, a limit is met.
    #[allow(clippy::too_many_arguments, reason = "what a step gives, each named")]
    fn look(
        &mut self,
        r: &mut Recorder,
        spec: &Spec,
        layout: &Layout,
        scheme: Scheme,
        given: &Parameters,
        taken: &Taken,
        floor: Value,
    ) {
        let coordinate = match spec.by {
            By::Time => self.t_new,
            By::Component(c) => taken.y_new[c],
        };
        let next_at = r.load(layout.next_at);
        let mut fine = r.compare(Comparison::Less, coordinate, next_at);
        let above = if scheme.adaptive() {
            let below = r.compare(Comparison::Less, self.next_h, floor);
            let above = r.not(below);
            r.or(self.accepted, above)
        } else {
            self.accepted
        };
        fine = r.and(fine, above);
        if matches!(scheme, Scheme::Taylor(_)) {
            // Its steps are never refused for being too long; towards a singularity they only
            // shrink.
            let stuck = r.compare(Comparison::Less, taken.h, floor);
            let moves = r.not(stuck);
            fine = r.and(fine, moves);
        }
        let (steps, rejected) = (r.load(layout.now.steps), r.load(layout.now.rejected));
        let count = r.add(steps, rejected);
        let some_left = r.compare(Comparison::Less, count, given.step_limit);
        fine = r.and(fine, some_left);
        for ([lo, hi], y) in given.bounds.iter().zip(&taken.y_new) {
            let (a, b) = (
                r.compare(Comparison::Less, *lo, *y),
                r.compare(Comparison::Less, *y, *hi),
            );
            let both = r.and(a, b);
            fine = r.and(fine, both);
        }
        if let Some((c, most)) = given.ceiling {
            let below = r.compare(Comparison::Less, taken.y_new[c], most);
            fine = r.and(fine, below);
        }
        let zero = r.constant(0.0);
        for v in &taken.guards {
            // On the boundary itself a guard may hold or not; that is looked at.
            let inside = r.compare(Comparison::Less, zero, *v);
            fine = r.and(fine, inside);
        }
        self.special = r.not(fine);
    }

    /// Stores what follows.
    pub fn store(&self, r: &mut Recorder, layout: &Layout, taken: &Taken) {
        let (now, next) = (&layout.now, &layout.next);
        let a = self.accepted;
        let pair = |r: &mut Recorder, new: Value, old: Value, slot: usize| {
            let v = r.select(a, new, old);
            r.store(v, slot);
        };
        for c in 0..layout.dim {
            pair(r, taken.y_new[c], taken.y[c], next.y + c);
        }
        if let Some((old, new)) = &taken.k {
            for c in 0..layout.dim {
                pair(r, new[c], old[c], next.k + c);
            }
        }
        for (g, new) in taken.kinks.iter().enumerate() {
            let old = r.load(now.kinks + g);
            pair(r, *new, old, next.kinks + g);
        }
        pair(r, self.t_new, self.t, next.t);
        let one = r.constant(1.0);
        for (from, to, counts) in [
            (now.steps, next.steps, true),
            (now.rejected, next.rejected, false),
        ] {
            let old = r.load(from);
            let new = r.add(old, one);
            let v = if counts {
                r.select(a, new, old)
            } else {
                r.select(a, old, new)
            };
            r.store(v, to);
        }
        r.store(self.next_h, next.wanted);
        r.store(self.before, next.before);
        r.store(self.resume, next.resume);
        r.store(taken.error, layout.error);
        for (g, v) in taken.guards.iter().enumerate() {
            r.store(*v, layout.guards + g);
        }
        r.store(a, layout.accepted);
        r.store(self.special, layout.special);
    }
}

/// A step of `h`, or the `left` way where that is no more than a little further: no tiny step is
/// left at the end.
pub fn stretched(r: &mut Recorder, h: Value, left: Value) -> Value {
    let slack = r.constant(1.0 + 1e-3);
    let reach = r.mul(h, slack);
    let short = r.compare(Comparison::Less, reach, left);
    r.select(short, h, left)
}

/// Base-2 logarithm to 1e-4 of a normal number, for step control only.
pub fn log2(r: &mut Recorder, x: Value) -> Value {
    let f = r.format();
    let exponent = r.shift_right(x, f.mantissa);
    // An integer below 2^mantissa as a number: put under the leading bit of 2^mantissa.
    let place = r.pattern((f.bias + u64::from(f.mantissa)) << f.mantissa);
    let placed = r.or(exponent, place);
    let base = r.constant((1u64 << f.mantissa) as f64 + f.bias as f64);
    let exponent = r.sub(placed, base);
    let (mask, unit) = (r.pattern((1 << f.mantissa) - 1), r.pattern(f.one));
    let m = r.and(x, mask);
    let m = r.or(m, unit);
    // 2/log(2) artanh(s), s = (m - 1)/(m + 1) <= 1/3.
    let one = r.constant(1.0);
    let (below, above) = (r.sub(m, one), r.add(m, one));
    let s = r.div(below, above);
    let z = r.mul(s, s);
    let p = r.horner(z, &[0.412_198_6, 0.577_078, 0.961_796_7, 2.885_390_1]);
    r.mul_add(s, p, exponent)
}

/// Base-2 exponential to 1e-4 where it is a normal number, for step control only.
pub fn exp2(r: &mut Recorder, x: Value) -> Value {
    let f = r.format();
    // Beyond these the sizes of steps mean nothing any more.
    let most = r.constant(f.bias as f64 - 2.0);
    let least = r.neg(most);
    let x = r.smaller(x, most);
    let x = r.larger(x, least);
    let magic = r.constant(f.magic);
    let shifted = r.add(x, magic);
    let n = r.sub(shifted, magic);
    let part = r.sub(x, n);
    let p = r.horner(
        part,
        &[
            0.009_618_1,
            0.055_504_1,
            0.240_226_5,
            std::f64::consts::LN_2,
            1.0,
        ],
    );
    let power = r.shift_left(shifted, f.mantissa);
    r.add_bits(p, power)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::cpu::lanes::{Interpreted, Lanes};
    use crate::backend::cpu::real::Real;
    use crate::model::Precision;

    fn evaluate<T: Real>(
        precision: Precision,
        f: impl Fn(&mut Recorder, Value) -> Value,
        x: f64,
    ) -> f64 {
        let mut r = Recorder::new(precision, true);
        let (argument, mut frame) = (r.load(0), vec![Lanes::<T, 4>::splat(T::of(x)); 2]);
        let value = f(&mut r, argument);
        r.store(value, 1);
        let code = Interpreted::new(r);
        code.run::<T, 4, false>(&mut code.registers(&[]), &mut frame);
        frame[1].0[0].f64()
    }

    #[test]
    fn step_control_functions_are_good_enough() {
        for i in -60..60 {
            let (x, y) = (1.37f64.powi(i), f64::from(i) * 0.37);
            for precision in [Precision::F32, Precision::F64] {
                let of = |f: fn(&mut Recorder, Value) -> Value, x| match precision {
                    Precision::F32 => evaluate::<f32>(precision, f, x),
                    Precision::F64 => evaluate::<f64>(precision, f, x),
                };
                assert!((of(log2, x) - x.log2()).abs() < 1e-3, "log2({x})");
                assert!((of(exp2, y) / y.exp2() - 1.0).abs() < 1e-3, "exp2({y})");
            }
        }
    }
}
