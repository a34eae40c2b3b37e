//! What the allocation of registers asks of the encoding of a set of instructions.

use crate::backend::cpu::arithmetic::Comparison;
use crate::backend::cpu::code::{Binary, Fused};

/// A vector register.
pub type Register = u8;

/// A register of masks, from 1 on.
pub type Mask = u8;

/// Where an address begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Base {
    /// The frame of lanes: the code's first argument.
    Frame,
    /// Constants: the second.
    Pool,
    /// Values that found no register: the fourth.
    Spill,
}

/// The last operand of an instruction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operand {
    Register(Register),
    /// Bytes from a base.
    Memory(Base, i32),
}

/// Which of a fused operation's operands the result replaces, and which one is the last operand.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// `d = d*m + v`
    F132,
    /// `d = v*d + m`
    F213,
    /// `d = v*m + d`
    F231,
}

/// Machine code in the making. A result's register may be that of any operand, unless said.
pub trait Encoder {
    /// Bytes of a vector.
    fn vector(&self) -> usize;

    /// Vector registers that may hold values.
    fn registers(&self) -> usize;

    /// Mask registers that may hold comparisons; 0 where a comparison is a vector.
    fn masks(&self) -> Mask;

    /// Whether a fused operation replaces its summand alone ([`Form::F231`]).
    fn only_accumulates(&self) -> bool;

    fn binary(&mut self, kind: Binary, to: Register, a: Register, b: Operand);

    /// `to = a < b`, say, as a mask.
    fn compare(&mut self, how: Comparison, to: Mask, a: Register, b: Operand);

    /// `to` is the operand that `form` replaces, and no other.
    fn fused(&mut self, kind: Fused, form: Form, to: Register, v: Register, m: Operand);

    fn sqrt(&mut self, to: Register, a: Operand);

    fn shift(&mut self, left: bool, to: Register, a: Register, by: u32);

    /// `to = highest bit of mask ? yes : no`
    fn blend(&mut self, to: Register, mask: Register, yes: Operand, no: Register);

    /// `to = mask ? yes : no`
    fn choose(&mut self, to: Register, mask: Mask, yes: Operand, no: Register);

    fn copy(&mut self, to: Register, from: Operand);

    fn store(&mut self, from: Register, base: Base, offset: i32);

    /// Ends the code: it is repeated as often as its third argument says, with a frame that moves by
    /// `bytes` each time.
    fn repeat(self, bytes: usize) -> Vec<u8>;
}
