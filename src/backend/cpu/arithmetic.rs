//! Elementary functions and register programs, written once over a small set of operations that
//! every SIMD instruction set has: the lanes run them on numbers, the just-in-time compiler records
//! them as instructions.
//!
//! `shaders/real.wgsl` mirrors the functions; the polynomials of both are in
//! [`constants`](crate::backend::constants).

use crate::backend::constants::{double, single};
use crate::program::{Instr, Primitive, Program};

/// What the functions need to know of a floating-point format.
pub struct Format {
    pub mantissa: u32,
    pub bias: u64,
    pub bits: u32,
    /// 1.5 * 2^mantissa: added to a number it leaves the nearest integer in the low bits.
    pub magic: f64,
    pub one: u64,
    /// Bits of sqrt(1/2).
    pub half_root: u64,
    /// Smallest normal number.
    pub least: f64,
    pub pio2: [f64; 3],
    pub ln2: [f64; 2],
    pub overflow: f64,
    pub underflow: f64,
    pub sin: &'static [f64],
    pub cos: &'static [f64],
    pub exp: &'static [f64],
    pub log: &'static [f64],
    pub atan: &'static [f64],
}

macro_rules! format {
    ($t:ident, $m:ident, $mantissa:expr, $bias:expr, $magic:expr) => {
        Format {
            mantissa: $mantissa,
            bias: $bias,
            bits: 8 * size_of::<$t>() as u32,
            magic: $magic,
            one: (1.0 as $t).to_bits() as u64,
            half_root: (std::f64::consts::FRAC_1_SQRT_2 as $t).to_bits() as u64,
            least: $t::MIN_POSITIVE as f64,
            pio2: $m::PIO2,
            ln2: $m::LN2,
            overflow: $m::OVERFLOW,
            underflow: $m::UNDERFLOW,
            sin: &$m::SIN,
            cos: &$m::COS,
            exp: &$m::EXP,
            log: &$m::LOG,
            atan: &$m::ATAN,
        }
    };
}

pub static DOUBLE: Format = format!(f64, double, 52, 1023, 6_755_399_441_055_744.0);
pub static SINGLE: Format = format!(f32, single, 23, 127, 12_582_912.0);

/// Comparisons; false where either side is not a number, but for `Unordered`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Comparison {
    Less,
    Equal,
    Unordered,
}

/// Arithmetic on values of one floating-point format.
pub trait Arithmetic {
    type V: Copy;
    type Mask: Copy;

    fn format(&self) -> &'static Format;
    /// A number, rounded to the format.
    fn constant(&mut self, c: f64) -> Self::V;
    /// The number with these bits.
    fn pattern(&mut self, bits: u64) -> Self::V;
    fn add(&mut self, a: Self::V, b: Self::V) -> Self::V;
    fn sub(&mut self, a: Self::V, b: Self::V) -> Self::V;
    fn mul(&mut self, a: Self::V, b: Self::V) -> Self::V;
    fn div(&mut self, a: Self::V, b: Self::V) -> Self::V;
    fn sqrt(&mut self, a: Self::V) -> Self::V;
    /// `a*b + c`, `a*b - c` and `c - a*b`; fused where the instruction set has it.
    fn mul_add(&mut self, a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    fn mul_sub(&mut self, a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    fn neg_mul_add(&mut self, a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    fn and(&mut self, a: Self::V, b: Self::V) -> Self::V;
    fn or(&mut self, a: Self::V, b: Self::V) -> Self::V;
    fn xor(&mut self, a: Self::V, b: Self::V) -> Self::V;
    fn shift_left(&mut self, a: Self::V, by: u32) -> Self::V;
    fn shift_right(&mut self, a: Self::V, by: u32) -> Self::V;
    /// Sum of the bits as integers.
    fn add_bits(&mut self, a: Self::V, b: Self::V) -> Self::V;
    fn compare(&mut self, how: Comparison, a: Self::V, b: Self::V) -> Self::Mask;
    /// The highest bit as a mask.
    fn top_bit(&mut self, a: Self::V) -> Self::Mask;
    fn select(&mut self, mask: Self::Mask, yes: Self::V, no: Self::V) -> Self::V;

    #[inline(always)]
    fn sign_bit(&mut self) -> Self::V {
        let bits = self.format().bits;
        self.pattern(1 << (bits - 1))
    }
    #[inline(always)]
    fn neg(&mut self, a: Self::V) -> Self::V {
        let sign = self.sign_bit();
        self.xor(a, sign)
    }
    #[inline(always)]
    fn abs(&mut self, a: Self::V) -> Self::V {
        let bits = self.format().bits;
        let rest = self.pattern((1 << (bits - 1)) - 1);
        self.and(a, rest)
    }
    /// The smaller one; not a number where either is not.
    #[inline(always)]
    fn least(&mut self, a: Self::V, b: Self::V) -> Self::V {
        let less = self.compare(Comparison::Less, a, b);
        let smaller = self.select(less, a, b);
        let lost = self.compare(Comparison::Unordered, a, a);
        self.select(lost, a, smaller)
    }
    #[inline(always)]
    fn greatest(&mut self, a: Self::V, b: Self::V) -> Self::V {
        let less = self.compare(Comparison::Less, b, a);
        let larger = self.select(less, a, b);
        let lost = self.compare(Comparison::Unordered, a, a);
        self.select(lost, a, larger)
    }
    #[inline(always)]
    fn sign(&mut self, a: Self::V) -> Self::V {
        let (zero, one, minus) = (self.constant(0.0), self.constant(1.0), self.constant(-1.0));
        // Zero times the argument keeps what is not a number.
        let rest = self.mul(zero, a);
        let above = self.compare(Comparison::Less, zero, a);
        let v = self.select(above, one, rest);
        let below = self.compare(Comparison::Less, a, zero);
        self.select(below, minus, v)
    }
    #[inline(always)]
    fn step(&mut self, a: Self::V) -> Self::V {
        let (zero, one) = (self.constant(0.0), self.constant(1.0));
        let above = self.compare(Comparison::Less, zero, a);
        self.select(above, one, zero)
    }
    /// Horner's rule, highest coefficient first.
    #[inline(always)]
    fn horner(&mut self, x: Self::V, c: &'static [f64]) -> Self::V {
        let mut acc = self.constant(c[0]);
        for k in &c[1..] {
            let k = self.constant(*k);
            acc = self.mul_add(acc, x, k);
        }
        acc
    }

    #[inline(always)]
    fn sin_cos(&mut self, x: Self::V) -> (Self::V, Self::V) {
        self.expanded_sin_cos(x)
    }
    #[inline(always)]
    fn expanded_sin_cos(&mut self, x: Self::V) -> (Self::V, Self::V) {
        let f = self.format();
        let magic = self.constant(f.magic);
        let per_quadrant = self.constant(std::f64::consts::FRAC_2_PI);
        let shifted = self.mul_add(x, per_quadrant, magic);
        let n = self.sub(shifted, magic);
        let mut r = x;
        for part in f.pio2 {
            let part = self.constant(part);
            r = self.neg_mul_add(n, part, r);
        }
        let z = self.mul(r, r);
        let p = self.horner(z, f.sin);
        let rz = self.mul(r, z);
        let s = self.mul_add(rz, p, r);
        let p = self.horner(z, f.cos);
        let (half, one) = (self.constant(0.5), self.constant(1.0));
        let c = self.neg_mul_add(z, half, one);
        let zz = self.mul(z, z);
        let c = self.mul_add(zz, p, c);
        let odd = self.shift_left(shifted, f.bits - 1);
        let odd = self.top_bit(odd);
        let (a, b) = (self.select(odd, c, s), self.select(odd, s, c));
        let sign = self.sign_bit();
        let unit = self.pattern(1);
        let flip = self.shift_left(shifted, f.bits - 2);
        let flip = self.and(flip, sign);
        let next = self.add_bits(shifted, unit);
        let next = self.shift_left(next, f.bits - 2);
        let next = self.and(next, sign);
        (self.xor(a, flip), self.xor(b, next))
    }

    /// `(e^r - 1, 2^i, 2^j)` with `x = r + (i + j) log 2`, for x within the exponent's range.
    #[inline(always)]
    fn split(&mut self, x: Self::V) -> (Self::V, Self::V, Self::V) {
        let f = self.format();
        let (over, under) = (self.constant(f.overflow), self.constant(f.underflow));
        let high = self.compare(Comparison::Less, over, x);
        let bounded = self.select(high, over, x);
        let low = self.compare(Comparison::Less, bounded, under);
        let bounded = self.select(low, under, bounded);
        let magic = self.constant(f.magic);
        let per_factor = self.constant(std::f64::consts::LOG2_E);
        let shifted = self.mul_add(bounded, per_factor, magic);
        let k = self.sub(shifted, magic);
        let mut r = bounded;
        for part in f.ln2 {
            let part = self.constant(part);
            r = self.neg_mul_add(k, part, r);
        }
        let p = self.horner(r, f.exp);
        let rr = self.mul(r, r);
        let e = self.mul_add(rr, p, r);
        // 2^k as two factors, so that neither under- nor overflows.
        let half = self.constant(0.5);
        let first = self.mul_add(k, half, magic);
        let whole = self.sub(first, magic);
        let rest = self.sub(k, whole);
        let second = self.add(rest, magic);
        (e, self.power_of_two(first), self.power_of_two(second))
    }

    /// `2^n` from `n + magic`.
    #[inline(always)]
    fn power_of_two(&mut self, shifted: Self::V) -> Self::V {
        let f = self.format();
        let bias = self.pattern(f.bias);
        let biased = self.add_bits(shifted, bias);
        self.shift_left(biased, f.mantissa)
    }

    #[inline(always)]
    fn exp(&mut self, x: Self::V) -> Self::V {
        let f = self.format();
        let (e, i, j) = self.split(x);
        let (one, zero, inf) = (
            self.constant(1.0),
            self.constant(0.0),
            self.constant(f64::INFINITY),
        );
        let v = self.add(e, one);
        let v = self.mul(v, i);
        let v = self.mul(v, j);
        self.bounded_exp(x, v, inf, zero, f)
    }

    /// `v`, or the limits where x is beyond the exponent's range.
    #[inline(always)]
    fn bounded_exp(
        &mut self,
        x: Self::V,
        v: Self::V,
        high: Self::V,
        low: Self::V,
        f: &'static Format,
    ) -> Self::V {
        let (over, under) = (self.constant(f.overflow), self.constant(f.underflow));
        let above = self.compare(Comparison::Less, over, x);
        let v = self.select(above, high, v);
        let below = self.compare(Comparison::Less, x, under);
        self.select(below, low, v)
    }

    #[inline(always)]
    fn expm1(&mut self, x: Self::V) -> Self::V {
        // 2^k (e^r - 1) + (2^k - 1)
        let f = self.format();
        let (e, i, j) = self.split(x);
        let (one, minus, inf) = (
            self.constant(1.0),
            self.constant(-1.0),
            self.constant(f64::INFINITY),
        );
        let scale = self.mul(i, j);
        let rest = self.sub(scale, one);
        let v = self.mul_add(scale, e, rest);
        self.bounded_exp(x, v, inf, minus, f)
    }

    #[inline(always)]
    fn log(&mut self, a: Self::V) -> Self::V {
        // x = 2^k (1 + f) with 1 + f in [sqrt(1/2), sqrt(2)); subnormals are scaled up first.
        let f = self.format();
        let (least, up) = (
            self.constant(f.least),
            self.constant((1u64 << f.mantissa) as f64),
        );
        let (zero, one, two, half) = (
            self.constant(0.0),
            self.constant(1.0),
            self.constant(2.0),
            self.constant(0.5),
        );
        let small = self.compare(Comparison::Less, a, least);
        let scaled = self.mul(a, up);
        let x = self.select(small, scaled, a);
        let offset = self.pattern(f.one - f.half_root);
        let shifted = self.add_bits(x, offset);
        let exponent = self.shift_right(shifted, f.mantissa);
        // An integer below 2^mantissa as a number: put under the leading bit of 2^mantissa.
        let place = self.pattern((f.bias + u64::from(f.mantissa)) << f.mantissa);
        let placed = self.or(exponent, place);
        let base = (1u64 << f.mantissa) as f64 + f.bias as f64;
        let (base, lift) = (self.constant(base), self.constant(f64::from(f.mantissa)));
        let k = self.sub(placed, base);
        let lifted = self.sub(k, lift);
        let k = self.select(small, lifted, k);
        let mask = self.pattern((1 << f.mantissa) - 1);
        let root = self.pattern(f.half_root);
        let m = self.and(shifted, mask);
        let m = self.add_bits(m, root);
        let q = self.sub(m, one);
        let below = self.add(two, q);
        let s = self.div(q, below);
        let z = self.mul(s, s);
        let p = self.horner(z, f.log);
        let poly = self.mul(z, p);
        let square = self.mul(half, q);
        let square = self.mul(square, q);
        let (l1, l2) = (self.constant(f.ln2[0]), self.constant(f.ln2[1]));
        let tail = self.mul(k, l2);
        let inner = self.add(square, poly);
        let low = self.mul_add(s, inner, tail);
        let v = self.sub(square, low);
        let v = self.sub(q, v);
        let v = self.mul_add(k, l1, v);
        let (nan, minus, inf) = (
            self.constant(f64::NAN),
            self.constant(f64::NEG_INFINITY),
            self.constant(f64::INFINITY),
        );
        let negative = self.compare(Comparison::Less, a, zero);
        let v = self.select(negative, nan, v);
        let nothing = self.compare(Comparison::Equal, a, zero);
        let v = self.select(nothing, minus, v);
        // Infinity and what is not a number pass through.
        let finite = self.compare(Comparison::Less, a, inf);
        self.select(finite, v, a)
    }

    #[inline(always)]
    fn log1p(&mut self, a: Self::V) -> Self::V {
        // log(u) with u = 1 + a, corrected for what rounding u lost.
        let one = self.constant(1.0);
        let u = self.add(one, a);
        let kept = self.sub(u, one);
        let lost = self.sub(a, kept);
        let log = self.log(u);
        let correction = self.div(lost, u);
        let v = self.add(log, correction);
        // For an infinite u the correction is not a number.
        let zero = self.constant(0.0);
        let nothing = self.sub(u, u);
        let finite = self.compare(Comparison::Equal, nothing, zero);
        self.select(finite, v, log)
    }

    #[inline(always)]
    fn atan(&mut self, a: Self::V) -> Self::V {
        // Reduced to |y| <= tan(pi/8) by atan(x) = pi/4 + atan((x-1)/(x+1)), atan(x) = pi/2 -
        // atan(1/x).
        let f = self.format();
        let x = self.abs(a);
        let (zero, one, minus) = (self.constant(0.0), self.constant(1.0), self.constant(-1.0));
        let (upper, lower) = (
            self.constant(2.414213562373095),
            self.constant(0.41421356237309503),
        );
        let (quarter, right) = (
            self.constant(std::f64::consts::FRAC_PI_4),
            self.constant(std::f64::consts::FRAC_PI_2),
        );
        let high = self.compare(Comparison::Less, upper, x);
        let middle = self.compare(Comparison::Less, lower, x);
        let (less, more) = (self.sub(x, one), self.add(x, one));
        let (n, d) = (self.select(middle, less, x), self.select(middle, more, one));
        let (n, d) = (self.select(high, minus, n), self.select(high, x, d));
        let base = self.select(middle, quarter, zero);
        let base = self.select(high, right, base);
        let y = self.div(n, d);
        let z = self.mul(y, y);
        let p = self.horner(z, f.atan);
        let yz = self.mul(y, z);
        let v = self.neg_mul_add(yz, p, y);
        let v = self.add(base, v);
        let sign = self.sign_bit();
        let (v, sign) = (self.abs(v), self.and(a, sign));
        self.or(v, sign)
    }

    /// One function of one argument.
    #[inline(always)]
    fn call(&mut self, function: Primitive, a: Self::V) -> Self::V {
        self.expanded(function, a)
    }
    /// A function as arithmetic.
    #[inline(always)]
    fn expanded(&mut self, function: Primitive, a: Self::V) -> Self::V {
        match function {
            Primitive::Sin => self.sin_cos(a).0,
            Primitive::Cos => self.sin_cos(a).1,
            Primitive::Exp => self.exp(a),
            Primitive::Expm1 => self.expm1(a),
            Primitive::Log => self.log(a),
            Primitive::Log1p => self.log1p(a),
            Primitive::Atan => self.atan(a),
            Primitive::Sqrt => self.sqrt(a),
            Primitive::Abs => self.abs(a),
            Primitive::Sign => self.sign(a),
            Primitive::Step => self.step(a),
        }
    }

    /// Records a program; the values of its outputs.
    fn program(&mut self, program: &Program, inputs: &[Self::V]) -> Vec<Self::V> {
        let mut v: Vec<Self::V> = Vec::with_capacity(program.code.len());
        let mut cosine = None;
        for (i, instr) in program.code.iter().enumerate() {
            let at = |k: u32| v[k as usize];
            let value = match *instr {
                Instr::Input(k) => inputs[k as usize],
                Instr::Const(c) => self.constant(c),
                Instr::Add(a, b) => self.add(at(a), at(b)),
                Instr::Sub(a, b) => self.sub(at(a), at(b)),
                Instr::Mul(a, b) => self.mul(at(a), at(b)),
                Instr::Div(a, b) => self.div(at(a), at(b)),
                Instr::Neg(a) => self.neg(at(a)),
                Instr::Min(a, b) => self.least(at(a), at(b)),
                Instr::Max(a, b) => self.greatest(at(a), at(b)),
                Instr::MulAdd(a, b, c) => self.mul_add(at(a), at(b), at(c)),
                Instr::MulSub(a, b, c) => self.mul_sub(at(a), at(b), at(c)),
                Instr::NegMulAdd(a, b, c) => self.neg_mul_add(at(a), at(b), at(c)),
                // A cosine that follows the sine of its argument comes with it.
                Instr::Call(Primitive::Cos, a) if matches!(cosine, Some((at, of, _)) if at + 1 == i && of == a) => {
                    cosine.map_or_else(|| at(a), |(_, _, value)| value)
                }
                Instr::Call(Primitive::Sin, a) => {
                    let (sine, other) = self.sin_cos(at(a));
                    cosine = Some((i, a, other));
                    sine
                }
                Instr::Call(f, a) => self.call(f, at(a)),
            };
            v.push(value);
        }
        program.outputs.iter().map(|o| v[*o as usize]).collect()
    }
}
