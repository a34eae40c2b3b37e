//! Scalar arithmetic written so that loops over lanes become SIMD: no branches, no calls.

use super::arithmetic::{Arithmetic, Comparison, DOUBLE, Format, SINGLE};
use std::marker::PhantomData;
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
    /// The elementary functions of this format; fused products where `FMA`.
    type With<const FMA: bool>: Arithmetic<V = Self, Mask = bool> + Default;
    fn of(x: f64) -> Self;
    fn f64(self) -> f64;
    fn f32(self) -> f32;
    /// `a*b + c`, fused where `FMA`; unfused otherwise, because a library call would be slow.
    fn mul_add<const FMA: bool>(self, b: Self, c: Self) -> Self;
    fn absolute(self) -> Self;
    fn root(self) -> Self;
    #[inline(always)]
    #[allow(clippy::eq_op, reason = "infinite minus infinite is not a number")]
    fn is_finite(self) -> bool {
        self - self == Self::of(0.0)
    }
}

/// Arithmetic on one number of type `T`; fused where `FMA`.
#[derive(Clone, Copy)]
pub struct Scalar<T, const FMA: bool>(PhantomData<T>);

impl<T, const FMA: bool> Scalar<T, FMA> {
    #[inline(always)]
    pub fn new() -> Self {
        Self(PhantomData)
    }
}

impl<T, const FMA: bool> Default for Scalar<T, FMA> {
    fn default() -> Self {
        Self::new()
    }
}

macro_rules! real {
    ($t:ident, $bits:ident, $format:ident) => {
        impl Real for $t {
            const EPSILON: f64 = $t::EPSILON as f64;
            type With<const FMA: bool> = Scalar<$t, FMA>;
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
        }

        impl<const FMA: bool> Arithmetic for Scalar<$t, FMA> {
            type V = $t;
            type Mask = bool;

            #[inline(always)]
            fn format(&self) -> &'static Format {
                &$format
            }
            #[inline(always)]
            fn constant(&mut self, c: f64) -> $t {
                c as $t
            }
            #[inline(always)]
            fn pattern(&mut self, bits: u64) -> $t {
                $t::from_bits(bits as $bits)
            }
            #[inline(always)]
            fn add(&mut self, a: $t, b: $t) -> $t {
                a + b
            }
            #[inline(always)]
            fn sub(&mut self, a: $t, b: $t) -> $t {
                a - b
            }
            #[inline(always)]
            fn mul(&mut self, a: $t, b: $t) -> $t {
                a * b
            }
            #[inline(always)]
            fn div(&mut self, a: $t, b: $t) -> $t {
                a / b
            }
            #[inline(always)]
            fn sqrt(&mut self, a: $t) -> $t {
                a.sqrt()
            }
            #[inline(always)]
            fn mul_add(&mut self, a: $t, b: $t, c: $t) -> $t {
                Real::mul_add::<FMA>(a, b, c)
            }
            #[inline(always)]
            fn mul_sub(&mut self, a: $t, b: $t, c: $t) -> $t {
                Real::mul_add::<FMA>(a, b, -c)
            }
            #[inline(always)]
            fn neg_mul_add(&mut self, a: $t, b: $t, c: $t) -> $t {
                Real::mul_add::<FMA>(-a, b, c)
            }
            #[inline(always)]
            fn and(&mut self, a: $t, b: $t) -> $t {
                $t::from_bits(a.to_bits() & b.to_bits())
            }
            #[inline(always)]
            fn or(&mut self, a: $t, b: $t) -> $t {
                $t::from_bits(a.to_bits() | b.to_bits())
            }
            #[inline(always)]
            fn xor(&mut self, a: $t, b: $t) -> $t {
                $t::from_bits(a.to_bits() ^ b.to_bits())
            }
            #[inline(always)]
            fn shift_left(&mut self, a: $t, by: u32) -> $t {
                $t::from_bits(a.to_bits() << by)
            }
            #[inline(always)]
            fn shift_right(&mut self, a: $t, by: u32) -> $t {
                $t::from_bits(a.to_bits() >> by)
            }
            #[inline(always)]
            fn add_bits(&mut self, a: $t, b: $t) -> $t {
                $t::from_bits(a.to_bits().wrapping_add(b.to_bits()))
            }
            #[inline(always)]
            #[allow(clippy::eq_op, reason = "the definition of a NaN")]
            fn compare(&mut self, how: Comparison, a: $t, b: $t) -> bool {
                match how {
                    Comparison::Less => a < b,
                    Comparison::Equal => a == b,
                    Comparison::Unordered => a != a || b != b,
                }
            }
            #[inline(always)]
            fn top_bit(&mut self, a: $t) -> bool {
                a.to_bits() >> ($bits::BITS - 1) != 0
            }
            #[inline(always)]
            fn select(&mut self, mask: bool, yes: $t, no: $t) -> $t {
                if mask { yes } else { no }
            }
        }
    };
}

real!(f64, u64, DOUBLE);
real!(f32, u32, SINGLE);

#[cfg(test)]
mod tests {
    use super::*;

    fn with<T: Real, const FMA: bool>() -> T::With<FMA> {
        T::With::default()
    }

    /// Largest error of `f` against `exact` over `points`, in units of rounding of the exact value
    /// (or of `floor`).
    fn worst<T: Real>(
        points: &[f64],
        floor: f64,
        f: impl Fn(T) -> T,
        exact: impl Fn(f64) -> f64,
    ) -> f64 {
        points
            .iter()
            .map(|&x| T::of(x))
            .map(|x| {
                let (got, want) = (f(x).f64(), exact(x.f64()));
                (got - want).abs() / (T::EPSILON * want.abs().max(floor))
            })
            .fold(0.0, |a: f64, b| {
                if b.f64().is_nan() {
                    f64::INFINITY
                } else {
                    a.max(b)
                }
            })
    }

    fn grid(lo: f64, hi: f64) -> Vec<f64> {
        (0..=20_000)
            .map(|i| lo + (hi - lo) * f64::from(i) / 20_000.0)
            .collect()
    }

    fn accuracy<T: Real, const FMA: bool>() {
        let tiny: Vec<f64> = grid(-0.99, 0.99).iter().map(|x| x.powi(7)).collect();
        let positive: Vec<f64> = grid(-60.0, 60.0).iter().map(|x| x.exp()).collect();
        let check = |what: &str, error: f64, bound: f64| {
            assert!(error < bound, "{what}: {error} units of rounding")
        };
        // Two units of rounding: one for the reduction, one for the polynomial.
        let near = grid(-40.0, 40.0);
        check(
            "sin",
            worst::<T>(&near, 0.5, |x| with::<T, FMA>().sin_cos(x).0, f64::sin),
            2.0,
        );
        check(
            "cos",
            worst::<T>(&near, 0.5, |x| with::<T, FMA>().sin_cos(x).1, f64::cos),
            2.0,
        );
        check(
            "sin near 0",
            worst::<T>(&tiny, 1e-30, |x| with::<T, FMA>().sin_cos(x).0, f64::sin),
            2.0,
        );
        check(
            "exp",
            worst::<T>(
                &grid(-80.0, 80.0),
                1e-35,
                |x| with::<T, FMA>().exp(x),
                f64::exp,
            ),
            2.0,
        );
        // 2^k (e^r - 1) + (2^k - 1) cancels partly for k = -1: three units.
        check(
            "expm1",
            worst::<T>(
                &grid(-5.0, 5.0),
                1e-30,
                |x| with::<T, FMA>().expm1(x),
                f64::exp_m1,
            ),
            3.0,
        );
        check(
            "expm1 near 0",
            worst::<T>(&tiny, 1e-30, |x| with::<T, FMA>().expm1(x), f64::exp_m1),
            2.0,
        );
        check(
            "log",
            worst::<T>(&positive, 1e-30, |x| with::<T, FMA>().log(x), f64::ln),
            2.0,
        );
        check(
            "log1p",
            worst::<T>(&tiny, 1e-30, |x| with::<T, FMA>().log1p(x), f64::ln_1p),
            3.0,
        );
        check(
            "atan",
            worst::<T>(
                &grid(-30.0, 30.0),
                1e-30,
                |x| with::<T, FMA>().atan(x),
                f64::atan,
            ),
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
        assert_eq!(with::<T, true>().exp(inf).f64(), f64::INFINITY);
        assert_eq!(with::<T, true>().exp(-inf).f64(), 0.0);
        assert_eq!(with::<T, true>().expm1(-inf).f64(), -1.0);
        assert_eq!(with::<T, true>().expm1(inf).f64(), f64::INFINITY);
        assert_eq!(with::<T, true>().log(T::of(0.0)).f64(), f64::NEG_INFINITY);
        assert_eq!(with::<T, true>().log(inf).f64(), f64::INFINITY);
        assert_eq!(with::<T, true>().log1p(inf).f64(), f64::INFINITY);
        assert!(with::<T, true>().log(T::of(-1.0)).f64().is_nan());
        assert!(
            (with::<T, true>().atan(inf).f64() - std::f64::consts::FRAC_PI_2).abs() < T::EPSILON
        );
        let mut a = with::<T, true>();
        for v in [
            a.exp(nan),
            a.expm1(nan),
            a.log(nan),
            a.atan(nan),
            a.sign(nan),
        ] {
            assert!(v.f64().is_nan());
        }
        assert!(
            with::<T, true>().sin_cos(nan).0.f64().is_nan()
                && with::<T, true>().sin_cos(inf).1.f64().is_nan()
        );
        assert!(
            with::<T, true>().least(nan, T::of(1.0)).f64().is_nan()
                && with::<T, true>().greatest(T::of(1.0), nan).f64().is_nan()
        );
    }

    #[test]
    fn special_values_are_kept() {
        special::<f32>();
        special::<f64>();
    }
}
