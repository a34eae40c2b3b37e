//! The register program: straight-line arithmetic that both backends run.
//!
//! [`Program::lower`] turns expressions into instructions in single-assignment form, each value
//! computed once. Functions beyond the primitives are written out here, so the backends have few to
//! provide and agree on the rest.

mod builder;
mod registers;

pub use registers::{Allocation, Slot};

use crate::expr::{Graph, Id};
use crate::numeric::{greatest, least};

/// A value: the index of the instruction that computes it.
pub type Value = u32;

/// One instruction of a [`Program`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Instr {
    Input(u32),
    Const(f64),
    Add(Value, Value),
    Sub(Value, Value),
    Mul(Value, Value),
    Div(Value, Value),
    Neg(Value),
    /// `a*b + c`
    MulAdd(Value, Value, Value),
    /// `a*b - c`
    MulSub(Value, Value, Value),
    /// `c - a*b`
    NegMulAdd(Value, Value, Value),
    Min(Value, Value),
    Max(Value, Value),
    Call(Primitive, Value),
}

/// Functions of one argument that every backend provides.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Primitive {
    Sin,
    Cos,
    Exp,
    Expm1,
    Log,
    Log1p,
    Atan,
    Sqrt,
    Abs,
    Sign,
    Step,
}

/// Straight-line code from inputs to outputs. A [`Primitive::Cos`] of the same argument directly
/// follows its [`Primitive::Sin`] where both are needed, so a backend can compute the pair at once.
#[derive(Clone, Debug, PartialEq)]
pub struct Program {
    pub inputs: usize,
    pub code: Vec<Instr>,
    pub outputs: Vec<Value>,
}

impl Instr {
    /// The values an instruction reads.
    pub fn reads(&self) -> impl Iterator<Item = Value> + use<> {
        let list = match *self {
            Instr::Input(_) | Instr::Const(_) => [None; 3],
            Instr::Neg(a) | Instr::Call(_, a) => [Some(a), None, None],
            Instr::Add(a, b)
            | Instr::Sub(a, b)
            | Instr::Mul(a, b)
            | Instr::Div(a, b)
            | Instr::Min(a, b)
            | Instr::Max(a, b) => [Some(a), Some(b), None],
            Instr::MulAdd(a, b, c) | Instr::MulSub(a, b, c) | Instr::NegMulAdd(a, b, c) => {
                [Some(a), Some(b), Some(c)]
            }
        };
        list.into_iter().flatten()
    }

    fn renumbered(self, map: impl Fn(Value) -> Value) -> Self {
        match self {
            Instr::Input(_) | Instr::Const(_) => self,
            Instr::Neg(a) => Instr::Neg(map(a)),
            Instr::Call(f, a) => Instr::Call(f, map(a)),
            Instr::Add(a, b) => Instr::Add(map(a), map(b)),
            Instr::Sub(a, b) => Instr::Sub(map(a), map(b)),
            Instr::Mul(a, b) => Instr::Mul(map(a), map(b)),
            Instr::Div(a, b) => Instr::Div(map(a), map(b)),
            Instr::Min(a, b) => Instr::Min(map(a), map(b)),
            Instr::Max(a, b) => Instr::Max(map(a), map(b)),
            Instr::MulAdd(a, b, c) => Instr::MulAdd(map(a), map(b), map(c)),
            Instr::MulSub(a, b, c) => Instr::MulSub(map(a), map(b), map(c)),
            Instr::NegMulAdd(a, b, c) => Instr::NegMulAdd(map(a), map(b), map(c)),
        }
    }
}

impl Program {
    /// Lowers `outputs` as a program of `inputs` (symbols, in order).
    ///
    /// # Panics
    /// When an output depends on a symbol that is not among the inputs.
    pub fn lower(graph: &Graph, inputs: &[Id], outputs: &[Id]) -> Self {
        builder::lower(graph, inputs, outputs)
    }

    /// Reference evaluation, one point in f64 with the standard library's functions.
    pub fn eval(&self, inputs: &[f64]) -> Vec<f64> {
        let mut v: Vec<f64> = Vec::with_capacity(self.code.len());
        for instr in &self.code {
            let at = |i: Value| v[i as usize];
            v.push(match *instr {
                Instr::Input(i) => inputs[i as usize],
                Instr::Const(c) => c,
                Instr::Add(a, b) => at(a) + at(b),
                Instr::Sub(a, b) => at(a) - at(b),
                Instr::Mul(a, b) => at(a) * at(b),
                Instr::Div(a, b) => at(a) / at(b),
                Instr::Neg(a) => -at(a),
                Instr::MulAdd(a, b, c) => at(a) * at(b) + at(c),
                Instr::MulSub(a, b, c) => at(a) * at(b) - at(c),
                Instr::NegMulAdd(a, b, c) => at(c) - at(a) * at(b),
                Instr::Min(a, b) => least(at(a), at(b)),
                Instr::Max(a, b) => greatest(at(a), at(b)),
                Instr::Call(f, a) => f.apply(at(a)),
            });
        }
        self.outputs.iter().map(|o| v[*o as usize]).collect()
    }

    /// Number of arithmetic instructions (neither inputs nor constants).
    pub fn operations(&self) -> usize {
        self.code
            .iter()
            .filter(|i| !matches!(i, Instr::Input(_) | Instr::Const(_)))
            .count()
    }
}

impl Primitive {
    /// Value in f64.
    pub fn apply(self, x: f64) -> f64 {
        use crate::expr::Fun;
        let f = match self {
            Primitive::Sin => Fun::Sin,
            Primitive::Cos => Fun::Cos,
            Primitive::Exp => Fun::Exp,
            Primitive::Expm1 => Fun::Expm1,
            Primitive::Log => Fun::Log,
            Primitive::Log1p => Fun::Log1p,
            Primitive::Atan => Fun::Atan,
            Primitive::Sqrt => Fun::Sqrt,
            Primitive::Abs => Fun::Abs,
            Primitive::Sign => Fun::Sign,
            Primitive::Step => Fun::Step,
        };
        f.apply(x)
    }
}
