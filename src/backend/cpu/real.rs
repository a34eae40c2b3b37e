//! Scalar arithmetic written so that loops over lanes become SIMD: no branches, no calls.
//!
//! `shaders/real.wgsl` mirrors this file; the polynomials of both are in [`constants`](crate::backend::constants).

use crate::backend::constants::{double, single};
use std::ops::{Add, Div, Mul, Neg, Sub};

/// f32 or f64 as the lanes compute with it.
pub trait Real:
    Copy
    + Default
    + PartialOrd
    + Send
    + Sync
    + 'static
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
{
    const EPSILON: f64;
    fn of(x: f64) -> Self;
    fn f64(self) -> f64;
    fn f32(self) -> f32;
    /// `a*b + c`, fused where `FMA`; unfused otherwise, because a library call would be slow.
    fn mul_add<const FMA: bool>(self, b: Self, c: Self) -> Self;
    fn absolute(self) -> Self;
    fn root(self) -> Self;
    fn sin_cos<const FMA: bool>(self) -> (Self, Self);
    fn exponential<const FMA: bool>(self) -> Self;
    fn expm1<const FMA: bool>(self) -> Self;
    fn logarithm<const FMA: bool>(self) -> Self;
    fn arctangent<const FMA: bool>(self) -> Self;

    #[inline(always)]
    fn log1p<const FMA: bool>(self) -> Self {
        // log(u) with u = 1 + x, corrected for what rounding u lost.
        let one = Self::of(1.0);
        let u = one + self;
        let lost = self - (u - one);
        let value = u.logarithm::<FMA>() + lost / u;
        // For an infinite u the correction is not a number.
        if u.is_finite() { value } else { u.logarithm::<FMA>() }
    }
    #[inline(always)]
    fn sign(self) -> Self {
        let zero = Self::of(0.0);
        let positive = if self > zero { Self::of(1.0) } else { zero * self };
        if self < zero { Self::of(-1.0) } else { positive }
    }
    #[inline(always)]
    fn step(self) -> Self {
        if self > Self::of(0.0) {
            Self::of(1.0)
        } else {
            Self::of(0.0)
        }
    }
    /// The smaller one; not a number where either is not.
    #[inline(always)]
    fn least(self, b: Self) -> Self {
        let m = if self < b { self } else { b };
        if self.is_nan() { self } else { m }
    }
    #[inline(always)]
    fn greatest(self, b: Self) -> Self {
        let m = if self > b { self } else { b };
        if self.is_nan() { self } else { m }
    }
    #[inline(always)]
    #[allow(clippy::eq_op)] // the definition of a NaN
    fn is_nan(self) -> bool {
        self != self
    }
    #[inline(always)]
    #[allow(clippy::eq_op)] // infinite minus infinite is not a number
    fn is_finite(self) -> bool {
        self - self == Self::of(0.0)
    }
}

/// Horner's rule, highest coefficient first.
#[inline(always)]
fn horner<T: Real, const FMA: bool, const N: usize>(x: T, c: [f64; N]) -> T {
    let mut acc = T::of(c[0]);
    for k in c.iter().skip(1) {
        acc = acc.mul_add::<FMA>(x, T::of(*k));
    }
    acc
}

macro_rules! real {
    ($t:ident, $bits:ident, $int:ident, $mantissa:expr, $bias:expr, $magic:expr,
     pio2: [$p1:expr, $p2:expr, $p3:expr], sin: $sin:expr, cos: $cos:expr,
     ln2: [$l1:expr, $l2:expr], exp: $exp:expr, overflow: $over:expr, underflow: $under:expr,
     log: $log:expr, atan: $atan:expr) => {
        impl Real for $t {
            const EPSILON: f64 = $t::EPSILON as f64;
            #[inline(always)]
            fn of(x: f64) -> Self {
                x as $t
            }
            #[inline(always)]
            fn f64(self) -> f64 {
                f64::from(self)
            }
            #[inline(always)]
            fn f32(self) -> f32 {
                self as f32
            }
            #[inline(always)]
            fn mul_add<const FMA: bool>(self, b: Self, c: Self) -> Self {
                if FMA {
                    $t::mul_add(self, b, c)
                } else {
                    self * b + c
                }
            }
            #[inline(always)]
            fn absolute(self) -> Self {
                self.abs()
            }
            #[inline(always)]
            fn root(self) -> Self {
                self.sqrt()
            }
            #[inline(always)]
            fn sin_cos<const FMA: bool>(self) -> (Self, Self) {
                // Adding 1.5 * 2^mantissa leaves the nearest integer in the low bits: rounding without a call.
                let shifted = Real::mul_add::<FMA>(self, std::f64::consts::FRAC_2_PI as $t, $magic);
                let quadrant = shifted.to_bits();
                let n = shifted - $magic;
                let r = Real::mul_add::<FMA>(n, -($p1 as $t), self);
                let r = Real::mul_add::<FMA>(n, -($p2 as $t), r);
                let r = Real::mul_add::<FMA>(n, -($p3 as $t), r);
                let z = r * r;
                let s = Real::mul_add::<FMA>(r * z, horner::<$t, FMA, _>(z, $sin), r);
                let c = Real::mul_add::<FMA>(
                    z * z,
                    horner::<$t, FMA, _>(z, $cos),
                    Real::mul_add::<FMA>(z, -0.5, 1.0),
                );
                let swap = quadrant & 1 == 1;
                let (a, b) = if swap { (c, s) } else { (s, c) };
                let sign_bit: $bits = 1 << ($bits::BITS - 1);
                let a = $t::from_bits(a.to_bits() ^ ((quadrant << ($bits::BITS - 2)) & sign_bit));
                let b = $t::from_bits(b.to_bits() ^ ((quadrant.wrapping_add(1) << ($bits::BITS - 2)) & sign_bit));
                (a, b)
            }
            #[inline(always)]
            fn exponential<const FMA: bool>(self) -> Self {
                let e = self.split::<FMA>();
                let v = (e.0 + 1.0) * e.1 * e.2;
                let v = if self > $over { $t::INFINITY } else { v };
                if self < $under { 0.0 } else { v }
            }
            #[inline(always)]
            fn expm1<const FMA: bool>(self) -> Self {
                // 2^k (e^r - 1) + (2^k - 1)
                let e = self.split::<FMA>();
                let scale = e.1 * e.2;
                let v = Real::mul_add::<FMA>(scale, e.0, scale - 1.0);
                let v = if self > $over { $t::INFINITY } else { v };
                if self < $under { -1.0 } else { v }
            }
            #[inline(always)]
            fn logarithm<const FMA: bool>(self) -> Self {
                // x = 2^k (1 + f) with 1 + f in [sqrt(1/2), sqrt(2)); subnormals are scaled up first.
                let small = self < $t::MIN_POSITIVE;
                let up = (1u64 << $mantissa) as $t;
                let x = if small { self * up } else { self };
                let one_bits = (1.0 as $t).to_bits();
                let offset = one_bits - (std::f64::consts::FRAC_1_SQRT_2 as $t).to_bits();
                let shifted = x.to_bits().wrapping_add(offset);
                let k = (shifted >> $mantissa) as $int - $bias;
                let mantissa_mask: $bits = (1 << $mantissa) - 1;
                let m = $t::from_bits((shifted & mantissa_mask).wrapping_add(one_bits - offset));
                let f = m - 1.0;
                let s = f / (2.0 + f);
                let z = s * s;
                let poly = z * horner::<$t, FMA, _>(z, $log);
                let half = 0.5 * f * f;
                let k = k as $t - if small { $mantissa as $t } else { 0.0 };
                let low = Real::mul_add::<FMA>(s, half + poly, k * ($l2 as $t));
                let v = Real::mul_add::<FMA>(k, $l1 as $t, f - (half - low));
                let v = if self < 0.0 { $t::NAN } else { v };
                let v = if self == 0.0 { $t::NEG_INFINITY } else { v };
                // Infinity and NaN pass through.
                if self < $t::INFINITY { v } else { self }
            }
            #[inline(always)]
            fn arctangent<const FMA: bool>(self) -> Self {
                // Reduced to |y| <= tan(pi/8) by atan(x) = pi/4 + atan((x-1)/(x+1)), atan(x) = pi/2 - atan(1/x).
                let x = self.abs();
                let (high, middle) = (x > 2.414213562373095, x > 0.41421356237309503);
                let (n, d) = if middle { (x - 1.0, x + 1.0) } else { (x, 1.0) };
                let (n, d) = if high { (-1.0, x) } else { (n, d) };
                let base = if middle {
                    std::f64::consts::FRAC_PI_4 as $t
                } else {
                    0.0
                };
                let base = if high {
                    std::f64::consts::FRAC_PI_2 as $t
                } else {
                    base
                };
                let y = n / d;
                let z = y * y;
                let v = base + (y - y * z * horner::<$t, FMA, _>(z, $atan));
                v.copysign(self)
            }
        }

        impl SplitExp for $t {
            #[inline(always)]
            fn split<const FMA: bool>(self) -> ($t, $t, $t) {
                let bounded = if self > $over { $over } else { self };
                let bounded = if bounded < $under { $under } else { bounded };
                let shifted = Real::mul_add::<FMA>(bounded, std::f64::consts::LOG2_E as $t, $magic);
                let k = shifted - $magic;
                let r = Real::mul_add::<FMA>(k, -($l1 as $t), bounded);
                let r = Real::mul_add::<FMA>(k, -($l2 as $t), r);
                let e = Real::mul_add::<FMA>(r * r, horner::<$t, FMA, _>(r, $exp), r);
                // 2^k as two factors, so that neither under- nor overflows.
                let magic_bits = ($magic as $t).to_bits();
                let whole = shifted.to_bits().wrapping_sub(magic_bits) as $int;
                let first = whole >> 1;
                let second = whole - first;
                let power = |n: $int| $t::from_bits(((n + $bias) as $bits) << $mantissa);
                (e, power(first), power(second))
            }
        }
    };
}

/// Argument reduction shared by the exponentials.
trait SplitExp: Real {
    /// `(e^r - 1, 2^i, 2^j)` with `x = r + (i + j) log 2`, for x within the exponent range.
    fn split<const FMA: bool>(self) -> (Self, Self, Self);
}

real!(f64, u64, i64, 52, 1023, 6_755_399_441_055_744.0,
    pio2: [double::PIO2[0], double::PIO2[1], double::PIO2[2]], sin: double::SIN, cos: double::COS,
    ln2: [double::LN2[0], double::LN2[1]], exp: double::EXP, overflow: double::OVERFLOW, underflow: double::UNDERFLOW,
    log: double::LOG, atan: double::ATAN
);

real!(f32, u32, i32, 23, 127, 12_582_912.0,
    pio2: [single::PIO2[0], single::PIO2[1], single::PIO2[2]], sin: single::SIN, cos: single::COS,
    ln2: [single::LN2[0], single::LN2[1]], exp: single::EXP, overflow: single::OVERFLOW as f32,
    underflow: single::UNDERFLOW as f32, log: single::LOG, atan: single::ATAN
);

#[cfg(test)]
mod tests {
    use super::*;

    /// Largest error of `f` against `exact` over `points`, in units of rounding of the exact value (or of `floor`).
    fn worst<T: Real>(points: &[f64], floor: f64, f: impl Fn(T) -> T, exact: impl Fn(f64) -> f64) -> f64 {
        points
            .iter()
            .map(|&x| T::of(x))
            .map(|x| {
                let (got, want) = (f(x).f64(), exact(x.f64()));
                (got - want).abs() / (T::EPSILON * want.abs().max(floor))
            })
            .fold(0.0, |a: f64, b| if b.is_nan() { f64::INFINITY } else { a.max(b) })
    }

    fn grid(lo: f64, hi: f64) -> Vec<f64> {
        (0..=20_000).map(|i| lo + (hi - lo) * f64::from(i) / 20_000.0).collect()
    }

    fn accuracy<T: Real, const FMA: bool>() {
        let tiny: Vec<f64> = grid(-0.99, 0.99).iter().map(|x| x.powi(7)).collect();
        let positive: Vec<f64> = grid(-60.0, 60.0).iter().map(|x| x.exp()).collect();
        let check = |what: &str, error: f64, bound: f64| assert!(error < bound, "{what}: {error} units of rounding");
        // Two units of rounding: one for the reduction, one for the polynomial.
        let near = grid(-40.0, 40.0);
        check("sin", worst::<T>(&near, 0.5, |x| x.sin_cos::<FMA>().0, f64::sin), 2.0);
        check("cos", worst::<T>(&near, 0.5, |x| x.sin_cos::<FMA>().1, f64::cos), 2.0);
        check(
            "sin near 0",
            worst::<T>(&tiny, 1e-30, |x| x.sin_cos::<FMA>().0, f64::sin),
            2.0,
        );
        check(
            "exp",
            worst::<T>(&grid(-80.0, 80.0), 1e-35, |x| x.exponential::<FMA>(), f64::exp),
            2.0,
        );
        // 2^k (e^r - 1) + (2^k - 1) cancels partly for k = -1: three units.
        check(
            "expm1",
            worst::<T>(&grid(-5.0, 5.0), 1e-30, |x| x.expm1::<FMA>(), f64::exp_m1),
            3.0,
        );
        check(
            "expm1 near 0",
            worst::<T>(&tiny, 1e-30, |x| x.expm1::<FMA>(), f64::exp_m1),
            2.0,
        );
        check(
            "log",
            worst::<T>(&positive, 1e-30, |x| x.logarithm::<FMA>(), f64::ln),
            2.0,
        );
        check("log1p", worst::<T>(&tiny, 1e-30, |x| x.log1p::<FMA>(), f64::ln_1p), 3.0);
        check(
            "atan",
            worst::<T>(&grid(-30.0, 30.0), 1e-30, |x| x.arctangent::<FMA>(), f64::atan),
            3.0,
        );
    }

    #[test]
    fn functions_are_accurate_in_f64() {
        accuracy::<f64, true>();
        accuracy::<f64, false>();
    }

    #[test]
    fn functions_are_accurate_in_f32() {
        accuracy::<f32, true>();
        accuracy::<f32, false>();
    }

    fn special<T: Real>() {
        let inf = T::of(f64::INFINITY);
        let nan = T::of(f64::NAN);
        assert_eq!(inf.exponential::<true>().f64(), f64::INFINITY);
        assert_eq!((-inf).exponential::<true>().f64(), 0.0);
        assert_eq!((-inf).expm1::<true>().f64(), -1.0);
        assert_eq!(inf.expm1::<true>().f64(), f64::INFINITY);
        assert_eq!(T::of(0.0).logarithm::<true>().f64(), f64::NEG_INFINITY);
        assert_eq!(inf.logarithm::<true>().f64(), f64::INFINITY);
        assert_eq!(inf.log1p::<true>().f64(), f64::INFINITY);
        assert!(T::of(-1.0).logarithm::<true>().is_nan());
        assert!((inf.arctangent::<true>().f64() - std::f64::consts::FRAC_PI_2).abs() < T::EPSILON);
        for f in [
            T::exponential::<true>,
            T::expm1::<true>,
            T::logarithm::<true>,
            T::arctangent::<true>,
            T::sign,
        ] {
            assert!(f(nan).is_nan());
        }
        assert!(nan.sin_cos::<true>().0.is_nan() && inf.sin_cos::<true>().1.is_nan());
        assert!(nan.least(T::of(1.0)).is_nan() && T::of(1.0).greatest(nan).is_nan());
    }

    #[test]
    fn special_values_are_kept() {
        special::<f32>();
        special::<f64>();
    }
}
