//! Encoding of the AVX2 instructions that vector code needs (Intel SDM volume 2, VEX prefix).

use crate::backend::cpu::arithmetic::Comparison;
use crate::backend::cpu::code::{Binary, Fused};
use crate::model::Precision;

/// A 256-bit register, 0 to 15.
pub type Register = u8;

/// Where an address begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Base {
    /// The frame of lanes (rdi).
    Frame,
    /// Constants (rsi).
    Pool,
    /// Values that found no register (rcx).
    Spill,
}

/// Bytes of a vector.
pub const VECTOR: usize = 32;

/// The last operand of an instruction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operand {
    Register(Register),
    /// Bytes from a base.
    Memory(Base, i32),
}

#[derive(Clone, Copy)]
enum Map {
    M0F = 1,
    M0F38 = 2,
    M0F3A = 3,
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

pub struct Assembler {
    pub bytes: Vec<u8>,
    double: bool,
}

impl Assembler {
    pub fn new(precision: Precision) -> Self {
        Self {
            bytes: Vec::new(),
            double: precision == Precision::F64,
        }
    }

    /// 0x66 marks the double form of most instructions.
    fn packed(&self) -> u8 {
        u8::from(self.double)
    }

    /// A 256-bit VEX instruction: `opcode reg, vvvv, operand`.
    #[allow(clippy::too_many_arguments, reason = "the fields of an encoding")]
    fn vex(
        &mut self,
        map: Map,
        pp: u8,
        wide: bool,
        opcode: u8,
        reg: u8,
        vvvv: u8,
        operand: Operand,
    ) {
        let rm = match operand {
            Operand::Register(r) => r,
            Operand::Memory(..) => 0,
        };
        let (r, b) = (reg < 8, rm < 8);
        let second = ((!vvvv & 15) << 3) | 4 | pp;
        if matches!(map, Map::M0F) && !wide && b {
            self.bytes.extend([0xC5, u8::from(r) << 7 | second]);
        } else {
            let first = u8::from(r) << 7 | 1 << 6 | u8::from(b) << 5 | map as u8;
            self.bytes
                .extend([0xC4, first, u8::from(wide) << 7 | second]);
        }
        self.bytes.push(opcode);
        let reg = (reg & 7) << 3;
        match operand {
            Operand::Register(r) => self.bytes.push(0xC0 | reg | (r & 7)),
            Operand::Memory(base, offset) => {
                let base = match base {
                    Base::Frame => 7,
                    Base::Pool => 6,
                    Base::Spill => 1,
                };
                if let Ok(short) = i8::try_from(offset) {
                    self.bytes.push(0x40 | reg | base);
                    self.bytes.push(short as u8);
                } else {
                    self.bytes.push(0x80 | reg | base);
                    self.bytes.extend(offset.to_le_bytes());
                }
            }
        }
    }

    pub fn binary(&mut self, kind: Binary, to: Register, a: Register, b: Operand) {
        let (p, double) = (self.packed(), self.double);
        let (pp, opcode) = match kind {
            Binary::Add => (p, 0x58),
            Binary::Mul => (p, 0x59),
            Binary::Sub => (p, 0x5C),
            Binary::Div => (p, 0x5E),
            Binary::And => (p, 0x54),
            Binary::Or => (p, 0x56),
            Binary::Xor => (p, 0x57),
            Binary::AddBits => (1, if double { 0xD4 } else { 0xFE }),
            Binary::Compare(_) => (p, 0xC2),
        };
        self.vex(Map::M0F, pp, false, opcode, to, a, b);
        if let Binary::Compare(how) = kind {
            // The quiet predicates: no exception on what is not a number.
            self.bytes.push(match how {
                Comparison::Less => 0x11,
                Comparison::Equal => 0x00,
                Comparison::Unordered => 0x03,
            });
        }
    }

    pub fn fused(&mut self, kind: Fused, form: Form, to: Register, v: Register, m: Operand) {
        let row = match form {
            Form::F132 => 0x90,
            Form::F213 => 0xA0,
            Form::F231 => 0xB0,
        };
        let column = match kind {
            Fused::MulAdd => 0x8,
            Fused::MulSub => 0xA,
            Fused::NegMulAdd => 0xC,
        };
        self.vex(Map::M0F38, 1, self.double, row | column, to, v, m);
    }

    pub fn sqrt(&mut self, to: Register, a: Operand) {
        self.vex(Map::M0F, self.packed(), false, 0x51, to, 0, a);
    }

    pub fn shift(&mut self, left: bool, to: Register, a: Register, by: u32) {
        let opcode = if self.double { 0x73 } else { 0x72 };
        let extension = if left { 6 } else { 2 };
        self.vex(
            Map::M0F,
            1,
            false,
            opcode,
            extension,
            to,
            Operand::Register(a),
        );
        self.bytes.push(by as u8);
    }

    /// `to = highest bit of mask ? yes : no`
    pub fn blend(&mut self, to: Register, mask: Register, yes: Operand, no: Register) {
        let opcode = if self.double { 0x4B } else { 0x4A };
        self.vex(Map::M0F3A, 1, false, opcode, to, no, yes);
        self.bytes.push(mask << 4);
    }

    pub fn copy(&mut self, to: Register, from: Operand) {
        let opcode = if matches!(from, Operand::Register(_)) {
            0x28
        } else {
            0x10
        };
        self.vex(Map::M0F, 0, false, opcode, to, 0, from);
    }

    pub fn store(&mut self, from: Register, base: Base, offset: i32) {
        self.vex(
            Map::M0F,
            0,
            false,
            0x11,
            from,
            0,
            Operand::Memory(base, offset),
        );
    }

    /// Ends a loop that began with the first byte: the frame moves by `bytes`, rdx counts down.
    pub fn repeat(&mut self, bytes: usize) {
        self.bytes.extend([0x48, 0x81, 0xC7]);
        self.bytes.extend((bytes as i32).to_le_bytes());
        self.bytes.extend([0x48, 0xFF, 0xCA]);
        let back = -(self.bytes.len() as i32 + 6);
        self.bytes.extend([0x0F, 0x85]);
        self.bytes.extend(back.to_le_bytes());
        // vzeroupper; ret
        self.bytes.extend([0xC5, 0xF8, 0x77, 0xC3]);
    }
}
