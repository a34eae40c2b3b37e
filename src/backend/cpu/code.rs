//! Straight-line vector code in single-assignment form, and the recorder that makes it from
//! [`Arithmetic`].
//!
//! Code works on a frame: slots of lanes, one for each quantity of a trajectory. It is compiled
//! (`jit`) or interpreted (`lanes`); both give the same bits where both fuse products.

use super::arithmetic::{Arithmetic, Comparison, DOUBLE, Format, SINGLE};
use crate::model::Precision;
use crate::program::Primitive;
use rustc_hash::{FxHashMap, FxHashSet};

/// A value: the index of the operation that makes it.
pub type Value = u32;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Binary {
    Add,
    Sub,
    Mul,
    Div,
    And,
    Or,
    Xor,
    AddBits,
    Compare(Comparison),
}

impl Binary {
    pub fn commutes(self) -> bool {
        !matches!(self, Binary::Sub | Binary::Div | Binary::Compare(_))
    }
}

/// What a fused operation does with a, b and c.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Fused {
    /// `a*b + c`
    MulAdd,
    /// `a*b - c`
    MulSub,
    /// `c - a*b`
    NegMulAdd,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Op {
    /// Lanes of a frame's slot, as it was before the code ran.
    Load(u32),
    /// The same number in all lanes, given with each call.
    Parameter(u32),
    /// The number with these bits in all lanes.
    Pattern(u64),
    Binary(Binary, Value, Value),
    Fused(Fused, Value, Value, Value),
    Sqrt(Value),
    ShiftLeft(Value, u32),
    ShiftRight(Value, u32),
    /// The second value where the first one's highest bit is set, else the third.
    Blend(Value, Value, Value),
    /// A function left to the interpreter. A cosine directly follows the sine of the same value.
    Call(Primitive, Value),
    /// Puts a value into a frame's slot.
    Store(Value, u32),
}

impl Op {
    /// The values read.
    pub fn reads(&self) -> impl Iterator<Item = Value> + use<> {
        let list = match *self {
            Op::Load(_) | Op::Parameter(_) | Op::Pattern(_) => [None; 3],
            Op::Sqrt(a)
            | Op::ShiftLeft(a, _)
            | Op::ShiftRight(a, _)
            | Op::Call(_, a)
            | Op::Store(a, _) => [Some(a), None, None],
            Op::Binary(_, a, b) => [Some(a), Some(b), None],
            Op::Fused(_, a, b, c) | Op::Blend(a, b, c) => [Some(a), Some(b), Some(c)],
        };
        list.into_iter().flatten()
    }

    fn renumbered(self, map: impl Fn(Value) -> Value) -> Self {
        match self {
            Op::Load(_) | Op::Parameter(_) | Op::Pattern(_) => self,
            Op::Sqrt(a) => Op::Sqrt(map(a)),
            Op::ShiftLeft(a, n) => Op::ShiftLeft(map(a), n),
            Op::ShiftRight(a, n) => Op::ShiftRight(map(a), n),
            Op::Call(f, a) => Op::Call(f, map(a)),
            Op::Store(a, s) => Op::Store(map(a), s),
            Op::Binary(k, a, b) => Op::Binary(k, map(a), map(b)),
            Op::Fused(k, a, b, c) => Op::Fused(k, map(a), map(b), map(c)),
            Op::Blend(a, b, c) => Op::Blend(map(a), map(b), map(c)),
        }
    }
}

/// Records operations, each distinct one once.
pub struct Recorder {
    format: &'static Format,
    pub ops: Vec<Op>,
    known: FxHashMap<Op, Value>,
    stored: FxHashSet<u32>,
    /// Whether elementary functions become arithmetic.
    expand: bool,
}

impl Recorder {
    /// `expand`: elementary functions become arithmetic; else they are calls, which only an
    /// interpreter can follow.
    pub fn new(precision: Precision, expand: bool) -> Self {
        Self {
            expand,
            format: match precision {
                Precision::F32 => &SINGLE,
                Precision::F64 => &DOUBLE,
            },
            ops: Vec::new(),
            known: FxHashMap::default(),
            stored: FxHashSet::default(),
        }
    }

    fn record(&mut self, op: Op) -> Value {
        if let Some(value) = self.known.get(&op) {
            return *value;
        }
        let value = self.ops.len() as Value;
        self.ops.push(op);
        self.known.insert(op, value);
        value
    }

    pub fn load(&mut self, slot: usize) -> Value {
        self.record(Op::Load(slot as u32))
    }

    pub fn loads(&mut self, slots: std::ops::Range<usize>) -> Vec<Value> {
        slots.map(|s| self.load(s)).collect()
    }

    pub fn parameter(&mut self, index: usize) -> Value {
        self.record(Op::Parameter(index as u32))
    }

    /// # Panics
    /// When the slot is stored to twice.
    pub fn store(&mut self, value: Value, slot: usize) {
        assert!(self.stored.insert(slot as u32), "slot {slot} stored twice");
        self.ops.push(Op::Store(value, slot as u32));
    }

    /// The spacing of numbers at 1.
    pub fn epsilon(&self) -> f64 {
        1.0 / (1u64 << self.format.mantissa) as f64
    }

    /// The larger one; the second where either is not a number.
    pub fn larger(&mut self, a: Value, b: Value) -> Value {
        let less = self.compare(Comparison::Less, b, a);
        self.select(less, a, b)
    }

    /// The smaller one; the second where either is not a number.
    pub fn smaller(&mut self, a: Value, b: Value) -> Value {
        let less = self.compare(Comparison::Less, a, b);
        self.select(less, a, b)
    }

    /// Whether a mask is not set.
    pub fn not(&mut self, mask: Value) -> Value {
        let all = self.pattern(u64::MAX >> (64 - self.format.bits));
        self.xor(mask, all)
    }

    /// Slots that a frame must have.
    pub fn slots(&self) -> usize {
        let slot = |op: &Op| match op {
            Op::Load(s) | Op::Store(_, s) => *s as usize + 1,
            _ => 0,
        };
        self.ops.iter().map(slot).max().unwrap_or(0)
    }

    /// Parameters to be given with each call.
    pub fn parameters(&self) -> usize {
        let parameter = |op: &Op| {
            if let Op::Parameter(p) = op {
                *p as usize + 1
            } else {
                0
            }
        };
        self.ops.iter().map(parameter).max().unwrap_or(0)
    }

    /// `sum of weight * value` over weights that are not 0, begun with the product that comes
    /// first.
    pub fn weighted(&mut self, terms: impl IntoIterator<Item = (f64, Value)>) -> Value {
        let mut sum = None;
        for (weight, value) in terms {
            if weight == 0.0 {
                continue;
            }
            let weight = self.constant(weight);
            sum = Some(match sum {
                None => self.mul(value, weight),
                Some(sum) => self.mul_add(value, weight, sum),
            });
        }
        sum.unwrap_or_else(|| self.constant(0.0))
    }

    /// What is left when operations nobody reads are removed, for `copies` neighbouring vectors
    /// side by side: one vector alone would wait for its own results.
    ///
    /// # Panics
    /// When a slot is both loaded and stored: a load may happen late.
    pub fn finish(self, copies: u32) -> Vec<Op> {
        let mut needed: Vec<bool> = self
            .ops
            .iter()
            .map(|op| matches!(op, Op::Store(..)))
            .collect();
        for (i, op) in self.ops.iter().enumerate().rev() {
            if needed[i] {
                op.reads().for_each(|v| needed[v as usize] = true);
            }
            assert!(
                !matches!(op, Op::Load(s) if self.stored.contains(s)),
                "a slot is both loaded and stored"
            );
        }
        let mut new = vec![[0; MOST_COPIES as usize]; self.ops.len()];
        let mut ops = Vec::new();
        for (i, op) in self.ops.iter().enumerate().filter(|(i, _)| needed[*i]) {
            for copy in 0..copies {
                let shared = matches!(op, Op::Parameter(_) | Op::Pattern(_)) && copy > 0;
                new[i][copy as usize] = if shared {
                    new[i][0]
                } else {
                    ops.len() as Value
                };
                if shared {
                    continue;
                }
                ops.push(match op.renumbered(|v| new[v as usize][copy as usize]) {
                    Op::Load(s) => Op::Load(s * copies + copy),
                    Op::Store(v, s) => Op::Store(v, s * copies + copy),
                    other => other,
                });
            }
        }
        ops
    }
}

/// Largest number of vectors side by side.
pub const MOST_COPIES: u32 = 4;

impl Arithmetic for Recorder {
    type V = Value;
    type Mask = Value;

    fn format(&self) -> &'static Format {
        self.format
    }
    fn constant(&mut self, c: f64) -> Value {
        let bits = if self.format.bits == 64 {
            c.to_bits()
        } else {
            u64::from((c as f32).to_bits())
        };
        self.record(Op::Pattern(bits))
    }
    fn pattern(&mut self, bits: u64) -> Value {
        self.record(Op::Pattern(bits))
    }
    fn add(&mut self, a: Value, b: Value) -> Value {
        self.record(Op::Binary(Binary::Add, a, b))
    }
    fn sub(&mut self, a: Value, b: Value) -> Value {
        self.record(Op::Binary(Binary::Sub, a, b))
    }
    fn mul(&mut self, a: Value, b: Value) -> Value {
        self.record(Op::Binary(Binary::Mul, a, b))
    }
    fn div(&mut self, a: Value, b: Value) -> Value {
        self.record(Op::Binary(Binary::Div, a, b))
    }
    fn sqrt(&mut self, a: Value) -> Value {
        self.record(Op::Sqrt(a))
    }
    fn mul_add(&mut self, a: Value, b: Value, c: Value) -> Value {
        self.record(Op::Fused(Fused::MulAdd, a, b, c))
    }
    fn mul_sub(&mut self, a: Value, b: Value, c: Value) -> Value {
        self.record(Op::Fused(Fused::MulSub, a, b, c))
    }
    fn neg_mul_add(&mut self, a: Value, b: Value, c: Value) -> Value {
        self.record(Op::Fused(Fused::NegMulAdd, a, b, c))
    }
    fn and(&mut self, a: Value, b: Value) -> Value {
        self.record(Op::Binary(Binary::And, a, b))
    }
    fn or(&mut self, a: Value, b: Value) -> Value {
        self.record(Op::Binary(Binary::Or, a, b))
    }
    fn xor(&mut self, a: Value, b: Value) -> Value {
        self.record(Op::Binary(Binary::Xor, a, b))
    }
    fn shift_left(&mut self, a: Value, by: u32) -> Value {
        self.record(Op::ShiftLeft(a, by))
    }
    fn shift_right(&mut self, a: Value, by: u32) -> Value {
        self.record(Op::ShiftRight(a, by))
    }
    fn add_bits(&mut self, a: Value, b: Value) -> Value {
        self.record(Op::Binary(Binary::AddBits, a, b))
    }
    fn sin_cos(&mut self, x: Value) -> (Value, Value) {
        if self.expand {
            return self.expanded_sin_cos(x);
        }
        let sine = self.record(Op::Call(Primitive::Sin, x));
        (sine, self.record(Op::Call(Primitive::Cos, x)))
    }
    fn call(&mut self, function: Primitive, a: Value) -> Value {
        match function {
            Primitive::Sin => self.sin_cos(a).0,
            Primitive::Cos => self.sin_cos(a).1,
            Primitive::Sqrt => self.sqrt(a),
            f if self.expand => self.expanded(f, a),
            f => self.record(Op::Call(f, a)),
        }
    }
    fn compare(&mut self, how: Comparison, a: Value, b: Value) -> Value {
        self.record(Op::Binary(Binary::Compare(how), a, b))
    }
    fn top_bit(&mut self, a: Value) -> Value {
        a
    }
    fn select(&mut self, mask: Value, yes: Value, no: Value) -> Value {
        self.record(Op::Blend(mask, yes, no))
    }
}
