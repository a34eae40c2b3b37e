//! Encoding of the instructions that vector code needs of aarch64: Advanced SIMD, which every
//! processor of that kind has (Arm Architecture Reference Manual, DDI 0487, C7.2).

use super::encoder::{Base, Encoder, Form, Mask, Operand, Register};
use crate::backend::cpu::arithmetic::Comparison;
use crate::backend::cpu::code::{Binary, Fused};
use crate::model::Precision;

/// A set of instructions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Set {
    /// 32 registers of 128 bits.
    Neon,
}

impl Set {
    /// Bytes of a vector.
    pub fn vector(self) -> usize {
        16
    }

    pub fn encoder(self, precision: Precision) -> Assembler {
        Assembler::new(precision)
    }
}

/// What an operand in memory is loaded into: arithmetic is on registers alone.
const LOADED: Register = 31;
/// What an operation needs between its instructions.
const BETWEEN: Register = 30;
/// The register for addresses too far from their base.
const ADDRESS: u32 = 9;
/// The registers of the code's first and third argument.
const FRAME: u32 = 0;
const COUNT: u32 = 2;

pub struct Assembler {
    bytes: Vec<u8>,
    /// Bytes before the loop.
    prologue: usize,
    double: bool,
}

/// Operations on three registers, as on four singles: `to`, `a` and `b` are bits 0, 5 and 16 on.
mod three {
    pub const FADD: u32 = 0x4E20D400;
    pub const FSUB: u32 = 0x4EA0D400;
    pub const FMUL: u32 = 0x6E20DC00;
    pub const FDIV: u32 = 0x6E20FC00;
    /// `to = to + a*b`
    pub const FMLA: u32 = 0x4E20CC00;
    /// `to = to - a*b`
    pub const FMLS: u32 = 0x4EA0CC00;
    pub const FCMEQ: u32 = 0x4E20E400;
    /// `a > b`
    pub const FCMGT: u32 = 0x6EA0E400;
    pub const ADD: u32 = 0x4EA08400;
    // Of bits, the same for doubles.
    pub const AND: u32 = 0x4E201C00;
    pub const ORR: u32 = 0x4EA01C00;
    pub const EOR: u32 = 0x6E201C00;
    /// `to = b ? a : to`
    pub const BIT: u32 = 0x6EA01C00;
    /// `to = b ? to : a`
    pub const BIF: u32 = 0x6EE01C00;
}

/// Operations on two registers, as on four singles.
mod two {
    pub const FSQRT: u32 = 0x6EA1F800;
    pub const FNEG: u32 = 0x6EA0F800;
    /// All bits where the highest is set.
    pub const CMLT: u32 = 0x4EA0A800;
    /// Of bits.
    pub const NOT: u32 = 0x6E205800;
}

/// The bit that makes singles doubles.
const DOUBLE: u32 = 1 << 22;

/// Pairs of registers of which a function must leave the lower halves as they were.
const KEPT: [u32; 4] = [8, 10, 12, 14];

impl Assembler {
    pub fn new(precision: Precision) -> Self {
        let mut this = Self {
            bytes: Vec::new(),
            prologue: 0,
            double: precision == Precision::F64,
        };
        // stp d8, d9, [sp, #-64]! and the others behind it
        this.word(0x6DBC27E8);
        for (k, first) in KEPT.into_iter().enumerate().skip(1) {
            this.word(0x6D000000 | pair(first, k));
        }
        this.prologue = this.bytes.len();
        this
    }

    fn word(&mut self, word: u32) {
        self.bytes.extend(word.to_le_bytes());
    }

    /// The operation on numbers of the code's precision.
    fn of(&self, operation: u32) -> u32 {
        operation | if self.double { DOUBLE } else { 0 }
    }

    fn three(&mut self, operation: u32, to: Register, a: Register, b: Register) {
        self.word(operation | u32::from(b) << 16 | u32::from(a) << 5 | u32::from(to));
    }

    fn two(&mut self, operation: u32, to: Register, a: Register) {
        self.three(operation, to, a, 0);
    }

    /// `ldr` or `str` of a whole vector.
    fn access(&mut self, operation: u32, register: Register, base: Base, offset: i32) {
        let mut base = match base {
            Base::Frame => FRAME,
            Base::Pool => 1,
            Base::Spill => 3,
        };
        let offset = offset as u32;
        debug_assert!(offset.is_multiple_of(16) && offset < 1 << 24);
        // Twelve bits count vectors; what is further away is reached by steps of 4096 bytes.
        let (far, near) = (offset >> 16, offset & 0xFFFF);
        if far > 0 {
            // add x9, base, #far*16, lsl #12
            self.word(0x91400000 | (far * 16) << 10 | base << 5 | ADDRESS);
            base = ADDRESS;
        }
        self.word(operation | (near / 16) << 10 | base << 5 | u32::from(register));
    }

    fn load(&mut self, to: Register, base: Base, offset: i32) {
        self.access(0x3DC00000, to, base, offset);
    }

    /// The operand in a register.
    fn brought(&mut self, operand: Operand) -> Register {
        match operand {
            Operand::Register(r) => r,
            Operand::Memory(base, offset) => {
                self.load(LOADED, base, offset);
                LOADED
            }
        }
    }
}

/// The operands of `stp` and `ldp` of two neighbours' lower halves: the `k`-th pair from sp on.
fn pair(first: u32, k: usize) -> u32 {
    const SP: u32 = 31;
    (2 * k as u32) << 15 | (first + 1) << 10 | SP << 5 | first
}

impl Encoder for Assembler {
    fn vector(&self) -> usize {
        Set::Neon.vector()
    }

    fn registers(&self) -> usize {
        BETWEEN.into()
    }

    fn masks(&self) -> Mask {
        0
    }

    fn only_accumulates(&self) -> bool {
        true
    }

    fn binary(&mut self, kind: Binary, to: Register, a: Register, b: Operand) {
        let b = self.brought(b);
        match kind {
            Binary::Add => self.three(self.of(three::FADD), to, a, b),
            Binary::Sub => self.three(self.of(three::FSUB), to, a, b),
            Binary::Mul => self.three(self.of(three::FMUL), to, a, b),
            Binary::Div => self.three(self.of(three::FDIV), to, a, b),
            Binary::And => self.three(three::AND, to, a, b),
            Binary::Or => self.three(three::ORR, to, a, b),
            Binary::Xor => self.three(three::EOR, to, a, b),
            Binary::AddBits => self.three(self.of(three::ADD), to, a, b),
            Binary::Compare(Comparison::Less) => self.three(self.of(three::FCMGT), to, b, a),
            Binary::Compare(Comparison::Equal) => self.three(self.of(three::FCMEQ), to, a, b),
            Binary::Compare(Comparison::Unordered) => {
                // Unless both equal themselves.
                let equal = self.of(three::FCMEQ);
                self.three(equal, BETWEEN, a, a);
                self.three(equal, to, b, b);
                self.three(three::AND, to, to, BETWEEN);
                self.two(two::NOT, to, to);
            }
        }
    }

    fn compare(&mut self, _: Comparison, _: Mask, _: Register, _: Operand) {
        unreachable!("there are no mask registers");
    }

    fn fused(&mut self, kind: Fused, form: Form, to: Register, v: Register, m: Operand) {
        debug_assert_eq!(form, Form::F231);
        let m = self.brought(m);
        if kind == Fused::MulSub {
            self.two(self.of(two::FNEG), to, to);
        }
        let operation = match kind {
            Fused::MulAdd | Fused::MulSub => three::FMLA,
            Fused::NegMulAdd => three::FMLS,
        };
        self.three(self.of(operation), to, v, m);
    }

    fn sqrt(&mut self, to: Register, a: Operand) {
        let a = self.brought(a);
        self.two(self.of(two::FSQRT), to, a);
    }

    fn shift(&mut self, left: bool, to: Register, a: Register, by: u32) {
        let bits = if self.double { 64 } else { 32 };
        // Shifts to the right count from twice the number's bits down.
        let operation = match left {
            true => 0x4F005400 | (bits + by) << 16,
            false => 0x6F000400 | (2 * bits - by) << 16,
        };
        self.two(operation, to, a);
    }

    fn blend(&mut self, to: Register, mask: Register, yes: Operand, no: Register) {
        let yes = self.brought(yes);
        self.two(self.of(two::CMLT), BETWEEN, mask);
        if to == yes {
            return self.three(three::BIF, to, no, BETWEEN);
        }
        if to != no {
            self.copy(to, Operand::Register(no));
        }
        self.three(three::BIT, to, yes, BETWEEN);
    }

    fn choose(&mut self, _: Register, _: Mask, _: Operand, _: Register) {
        unreachable!("there are no mask registers");
    }

    fn copy(&mut self, to: Register, from: Operand) {
        match from {
            Operand::Register(from) => self.three(three::ORR, to, from, from),
            Operand::Memory(base, offset) => self.load(to, base, offset),
        }
    }

    fn store(&mut self, from: Register, base: Base, offset: i32) {
        self.access(0x3D800000, from, base, offset);
    }

    fn repeat(mut self, bytes: usize) -> Vec<u8> {
        debug_assert!(bytes < 4096);
        // add x0, x0, #bytes; subs x2, x2, #1
        self.word(0x91000000 | (bytes as u32) << 10 | FRAME << 5 | FRAME);
        self.word(0xF1000400 | COUNT << 5 | COUNT);
        // A conditional jump reaches 1 MiB, an unconditional one 128: b.eq past a jump back.
        self.word(0x54000040);
        let back = (self.bytes.len() - self.prologue) as u32 / 4;
        self.word(0x14000000 | (back.wrapping_neg() & 0x03FFFFFF));
        for (k, first) in KEPT.into_iter().enumerate().skip(1) {
            self.word(0x6D400000 | pair(first, k));
        }
        // ldp d8, d9, [sp], #64; ret
        self.word(0x6CC427E8);
        self.word(0xD65F03C0);
        self.bytes
    }
}

#[cfg(test)]
mod tests;
