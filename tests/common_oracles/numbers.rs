//! Kinds of number that a hand-written right-hand side can be evaluated with.
#![allow(
    clippy::suspicious_arithmetic_impl,
    reason = "the product and quotient rules"
)]

use std::ops::{Add, Div, Mul, Neg, Sub};

/// What the oracles compute with.
pub trait Number:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
{
    fn of(x: f64) -> Self;
    /// Nearest f64.
    fn value(self) -> f64;
    fn sin(self) -> Self;
    fn cos(self) -> Self;
    fn sqrt(self) -> Self;

    fn square(self) -> Self {
        self * self
    }

    /// Limited to `[-most, most]`.
    fn clamped(self, most: f64) -> Self {
        if self.value() > most {
            Self::of(most)
        } else if self.value() < -most {
            Self::of(-most)
        } else {
            self
        }
    }
}

impl Number for f64 {
    fn of(x: f64) -> Self {
        x
    }
    fn value(self) -> f64 {
        self
    }
    fn sin(self) -> Self {
        f64::sin(self)
    }
    fn cos(self) -> Self {
        f64::cos(self)
    }
    fn sqrt(self) -> Self {
        f64::sqrt(self)
    }
}

/// A value with its derivatives by N variables.
#[derive(Clone, Copy, Debug)]
pub struct Dual<T, const N: usize> {
    pub v: T,
    pub d: [T; N],
}

impl<T: Number, const N: usize> Dual<T, N> {
    /// Variable number `i`.
    pub fn variable(v: T, i: usize) -> Self {
        Self {
            v,
            d: std::array::from_fn(|j| T::of(if i == j { 1.0 } else { 0.0 })),
        }
    }

    pub fn constant(v: T) -> Self {
        Self {
            v,
            d: [T::of(0.0); N],
        }
    }

    fn chain(self, v: T, slope: T) -> Self {
        Self {
            v,
            d: self.d.map(|d| d * slope),
        }
    }

    fn both(self, o: Self, v: T, f: impl Fn(T, T) -> T) -> Self {
        Self {
            v,
            d: std::array::from_fn(|i| f(self.d[i], o.d[i])),
        }
    }
}

impl<T: Number, const N: usize> Add for Dual<T, N> {
    type Output = Self;
    fn add(self, o: Self) -> Self {
        self.both(o, self.v + o.v, |a, b| a + b)
    }
}
impl<T: Number, const N: usize> Sub for Dual<T, N> {
    type Output = Self;
    fn sub(self, o: Self) -> Self {
        self.both(o, self.v - o.v, |a, b| a - b)
    }
}
impl<T: Number, const N: usize> Mul for Dual<T, N> {
    type Output = Self;
    fn mul(self, o: Self) -> Self {
        self.both(o, self.v * o.v, |a, b| a * o.v + self.v * b)
    }
}
impl<T: Number, const N: usize> Div for Dual<T, N> {
    type Output = Self;
    fn div(self, o: Self) -> Self {
        let q = self.v / o.v;
        self.both(o, q, |a, b| (a - q * b) / o.v)
    }
}
impl<T: Number, const N: usize> Neg for Dual<T, N> {
    type Output = Self;
    fn neg(self) -> Self {
        Self {
            v: -self.v,
            d: self.d.map(|d| -d),
        }
    }
}
impl<T: Number, const N: usize> Number for Dual<T, N> {
    fn of(x: f64) -> Self {
        Self::constant(T::of(x))
    }
    fn value(self) -> f64 {
        self.v.value()
    }
    fn sin(self) -> Self {
        self.chain(self.v.sin(), self.v.cos())
    }
    fn cos(self) -> Self {
        self.chain(self.v.cos(), -self.v.sin())
    }
    fn sqrt(self) -> Self {
        let root = self.v.sqrt();
        self.chain(root, T::of(0.5) / root)
    }
}

/// A value with the size of the terms it comes from: any way of computing it in k operations of
/// precision eps is within about `k * eps * size` of the value.
#[derive(Clone, Copy, Debug)]
pub struct Sized {
    pub v: f64,
    pub size: f64,
}

impl Add for Sized {
    type Output = Self;
    fn add(self, o: Self) -> Self {
        Self {
            v: self.v + o.v,
            size: self.size + o.size,
        }
    }
}
impl Sub for Sized {
    type Output = Self;
    fn sub(self, o: Self) -> Self {
        Self {
            v: self.v - o.v,
            size: self.size + o.size,
        }
    }
}
impl Mul for Sized {
    type Output = Self;
    fn mul(self, o: Self) -> Self {
        Self {
            v: self.v * o.v,
            size: self.size * o.size,
        }
    }
}
impl Div for Sized {
    type Output = Self;
    fn div(self, o: Self) -> Self {
        Self {
            v: self.v / o.v,
            size: self.size * o.size / (o.v * o.v),
        }
    }
}
impl Neg for Sized {
    type Output = Self;
    fn neg(self) -> Self {
        Self {
            v: -self.v,
            size: self.size,
        }
    }
}
impl Number for Sized {
    fn of(x: f64) -> Self {
        Self {
            v: x,
            size: x.abs(),
        }
    }
    fn value(self) -> f64 {
        self.v
    }
    fn sin(self) -> Self {
        let (s, c) = self.v.sin_cos();
        Self {
            v: s,
            size: s.abs() + c.abs() * self.size,
        }
    }
    fn cos(self) -> Self {
        let (s, c) = self.v.sin_cos();
        Self {
            v: c,
            size: c.abs() + s.abs() * self.size,
        }
    }
    fn sqrt(self) -> Self {
        let root = self.v.sqrt();
        Self {
            v: root,
            size: root + 0.5 * self.size / root,
        }
    }
}

/// An unevaluated sum of two f64: about 32 digits (T. J. Dekker, Numerische Mathematik 18, 1971).
#[derive(Clone, Copy, Debug)]
pub struct Double {
    hi: f64,
    lo: f64,
}

impl Double {
    /// `a + b` exactly, for `|a| >= |b|`.
    fn quick(a: f64, b: f64) -> Self {
        let hi = a + b;
        Self {
            hi,
            lo: b - (hi - a),
        }
    }

    /// Sine (`first` = 1) or cosine (0) by their series, for arguments of a few units.
    fn series(self, first: u32) -> Self {
        let square = -self.square();
        let mut term = if first == 1 { self } else { Self::of(1.0) };
        let mut sum = term;
        for k in 1..40 {
            let n = f64::from(2 * k + first);
            term = term * square / Self::of(n * (n - 1.0));
            sum = sum + term;
        }
        sum
    }
}

impl Add for Double {
    type Output = Self;
    fn add(self, o: Self) -> Self {
        let hi = self.hi + o.hi;
        let b = hi - self.hi;
        let error = (self.hi - (hi - b)) + (o.hi - b);
        Self::quick(hi, error + self.lo + o.lo)
    }
}
impl Sub for Double {
    type Output = Self;
    fn sub(self, o: Self) -> Self {
        self + -o
    }
}
impl Mul for Double {
    type Output = Self;
    fn mul(self, o: Self) -> Self {
        let hi = self.hi * o.hi;
        let error = self.hi.mul_add(o.hi, -hi);
        Self::quick(hi, error + self.hi * o.lo + self.lo * o.hi)
    }
}
impl Div for Double {
    type Output = Self;
    fn div(self, o: Self) -> Self {
        let first = self.hi / o.hi;
        let rest = self - o * Self::of(first);
        let second = rest.hi / o.hi;
        let rest = rest - o * Self::of(second);
        Self::quick(first, second) + Self::of(rest.hi / o.hi)
    }
}
impl Neg for Double {
    type Output = Self;
    fn neg(self) -> Self {
        Self {
            hi: -self.hi,
            lo: -self.lo,
        }
    }
}
impl Number for Double {
    fn of(x: f64) -> Self {
        Self { hi: x, lo: 0.0 }
    }
    fn value(self) -> f64 {
        self.hi + self.lo
    }
    fn sin(self) -> Self {
        self.series(1)
    }
    fn cos(self) -> Self {
        self.series(0)
    }
    fn sqrt(self) -> Self {
        // One Newton step doubles the digits of the f64 root.
        let root = Self::of(self.hi.sqrt());
        (root + self / root) * Self::of(0.5)
    }
}
