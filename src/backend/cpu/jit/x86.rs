//! Encoding of the instructions that vector code needs: AVX2 (Intel SDM volume 2, VEX prefix) and
//! AVX-512 (EVEX prefix).

use super::encoder::{Base, Encoder, Form, Mask, Operand, Register};
use crate::backend::cpu::arithmetic::Comparison;
use crate::backend::cpu::code::{Binary, Fused};
use crate::model::Precision;

/// A set of instructions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Set {
    /// AVX2 and FMA: 16 registers of 256 bits.
    Avx2,
    /// AVX-512 F, DQ and VL: 32 registers of 512 bits, and registers of masks.
    Avx512,
}

impl Set {
    /// Bytes of a vector.
    pub fn vector(self) -> usize {
        match self {
            Set::Avx2 => 32,
            Set::Avx512 => 64,
        }
    }

    pub fn encoder(self, precision: Precision) -> Assembler {
        Assembler::new(self, precision)
    }
}

/// The mask register that holds nothing beyond an operation.
const SCRATCH: Mask = 7;
/// Mask registers that may hold comparisons: the others but the first, which means no mask.
const MASKS: Mask = 6;

/// The quiet predicate of a comparison: no exception on what is not a number.
fn predicate(how: Comparison) -> u8 {
    match how {
        Comparison::Less => 0x11,
        Comparison::Equal => 0x00,
        Comparison::Unordered => 0x03,
    }
}

#[derive(Clone, Copy)]
enum Map {
    M0F = 1,
    M0F38 = 2,
    M0F3A = 3,
}

/// An instruction but for its operands.
#[derive(Clone, Copy)]
struct Opcode {
    map: Map,
    /// The prefix: none, 66, F3.
    pp: u8,
    /// The bit W of a VEX prefix, and of an EVEX prefix.
    wide: [bool; 2],
    opcode: u8,
}

pub struct Assembler {
    bytes: Vec<u8>,
    set: Set,
    double: bool,
}

impl Assembler {
    pub fn new(set: Set, precision: Precision) -> Self {
        Self {
            bytes: Vec::new(),
            set,
            double: precision == Precision::F64,
        }
    }

    /// An instruction whose EVEX form has W where it works on doubles.
    fn of(&self, map: Map, pp: u8, opcode: u8) -> Opcode {
        Opcode {
            map,
            pp,
            wide: [false, self.double],
            opcode,
        }
    }

    /// `opcode reg, vvvv, operand` on whole vectors; of AVX-512 under a mask where that is not 0.
    fn emit(&mut self, op: Opcode, reg: u8, vvvv: u8, operand: Operand, mask: Mask) {
        match self.set {
            Set::Avx2 => self.vex(op, reg, vvvv, operand),
            Set::Avx512 => self.evex(op, reg, vvvv, operand, mask),
        }
    }

    /// 0x66 marks the double form of most instructions.
    fn packed(&self) -> u8 {
        u8::from(self.double)
    }

    /// A 256-bit VEX instruction.
    fn vex(&mut self, op: Opcode, reg: u8, vvvv: u8, operand: Operand) {
        let rm = match operand {
            Operand::Register(r) => r,
            Operand::Memory(..) => 0,
        };
        let (r, b, wide) = (reg < 8, rm < 8, op.wide[0]);
        let second = ((!vvvv & 15) << 3) | 4 | op.pp;
        if matches!(op.map, Map::M0F) && !wide && b {
            self.bytes.extend([0xC5, u8::from(r) << 7 | second]);
        } else {
            let first = u8::from(r) << 7 | 1 << 6 | u8::from(b) << 5 | op.map as u8;
            self.bytes
                .extend([0xC4, first, u8::from(wide) << 7 | second]);
        }
        self.bytes.push(op.opcode);
        self.operand(reg, operand, 1);
    }

    /// A 512-bit EVEX instruction.
    fn evex(&mut self, op: Opcode, reg: u8, vvvv: u8, operand: Operand, mask: Mask) {
        let rm = match operand {
            Operand::Register(r) => r,
            Operand::Memory(..) => 0,
        };
        // The higher bits of the registers' numbers are stored inverted.
        let clear = |number: u8, bit: u8| number >> bit & 1 == 0;
        let first = u8::from(clear(reg, 3)) << 7
            | u8::from(clear(rm, 4)) << 6
            | u8::from(clear(rm, 3)) << 5
            | u8::from(clear(reg, 4)) << 4
            | op.map as u8;
        let second = u8::from(op.wide[1]) << 7 | (!vvvv & 15) << 3 | 1 << 2 | op.pp;
        let third = 0b10 << 5 | u8::from(clear(vvvv, 4)) << 3 | mask;
        self.bytes.extend([0x62, first, second, third, op.opcode]);
        self.operand(reg, operand, Set::Avx512.vector() as i32);
    }

    /// The bytes that name the operands; short offsets count in units.
    fn operand(&mut self, reg: u8, operand: Operand, unit: i32) {
        let reg = (reg & 7) << 3;
        match operand {
            Operand::Register(r) => self.bytes.push(0xC0 | reg | (r & 7)),
            Operand::Memory(base, offset) => {
                let base = match base {
                    Base::Frame => 7,
                    Base::Pool => 6,
                    Base::Spill => 1,
                };
                match i8::try_from(offset / unit) {
                    Ok(short) if offset % unit == 0 => {
                        self.bytes.push(0x40 | reg | base);
                        self.bytes.push(short as u8);
                    }
                    _ => {
                        self.bytes.push(0x80 | reg | base);
                        self.bytes.extend(offset.to_le_bytes());
                    }
                }
            }
        }
    }

    /// All bits of the lanes that are in a mask, none of the others (AVX-512).
    fn spread(&mut self, to: Register, from: Mask) {
        let spread = self.of(Map::M0F38, 2, 0x38);
        self.emit(spread, to, 0, Operand::Register(from), 0);
    }

    /// A move of whole vectors, whatever is in them.
    fn plain(opcode: u8) -> Opcode {
        Opcode {
            map: Map::M0F,
            pp: 0,
            wide: [false; 2],
            opcode,
        }
    }
}

impl Encoder for Assembler {
    fn vector(&self) -> usize {
        self.set.vector()
    }

    fn registers(&self) -> usize {
        match self.set {
            Set::Avx2 => 16,
            Set::Avx512 => 32,
        }
    }

    fn masks(&self) -> Mask {
        match self.set {
            Set::Avx2 => 0,
            Set::Avx512 => MASKS,
        }
    }

    fn only_accumulates(&self) -> bool {
        false
    }

    fn binary(&mut self, kind: Binary, to: Register, a: Register, b: Operand) {
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
            Binary::Compare(how) if self.set == Set::Avx512 => {
                self.compare(how, SCRATCH, a, b);
                return self.spread(to, SCRATCH);
            }
            Binary::Compare(_) => (p, 0xC2),
        };
        self.emit(self.of(Map::M0F, pp, opcode), to, a, b, 0);
        if let Binary::Compare(how) = kind {
            self.bytes.push(predicate(how));
        }
    }

    fn compare(&mut self, how: Comparison, to: Mask, a: Register, b: Operand) {
        let compare = self.of(Map::M0F, self.packed(), 0xC2);
        self.emit(compare, to, a, b, 0);
        self.bytes.push(predicate(how));
    }

    fn fused(&mut self, kind: Fused, form: Form, to: Register, v: Register, m: Operand) {
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
        let fused = Opcode {
            wide: [self.double; 2],
            ..self.of(Map::M0F38, 1, row | column)
        };
        self.emit(fused, to, v, m, 0);
    }

    fn sqrt(&mut self, to: Register, a: Operand) {
        self.emit(self.of(Map::M0F, self.packed(), 0x51), to, 0, a, 0);
    }

    fn shift(&mut self, left: bool, to: Register, a: Register, by: u32) {
        let opcode = if self.double { 0x73 } else { 0x72 };
        let extension = if left { 6 } else { 2 };
        let shift = self.of(Map::M0F, 1, opcode);
        self.emit(shift, extension, to, Operand::Register(a), 0);
        self.bytes.push(by as u8);
    }

    fn blend(&mut self, to: Register, mask: Register, yes: Operand, no: Register) {
        if self.set == Set::Avx512 {
            let highest = self.of(Map::M0F38, 2, 0x39);
            self.emit(highest, SCRATCH, 0, Operand::Register(mask), 0);
            return self.choose(to, SCRATCH, yes, no);
        }
        let opcode = if self.double { 0x4B } else { 0x4A };
        self.emit(self.of(Map::M0F3A, 1, opcode), to, no, yes, 0);
        self.bytes.push(mask << 4);
    }

    fn choose(&mut self, to: Register, mask: Mask, yes: Operand, no: Register) {
        self.emit(self.of(Map::M0F38, 1, 0x65), to, no, yes, mask);
    }

    fn copy(&mut self, to: Register, from: Operand) {
        let opcode = match from {
            Operand::Register(_) => 0x28,
            Operand::Memory(..) => 0x10,
        };
        self.emit(Self::plain(opcode), to, 0, from, 0);
    }

    fn store(&mut self, from: Register, base: Base, offset: i32) {
        let to = Operand::Memory(base, offset);
        self.emit(Self::plain(0x11), from, 0, to, 0);
    }

    fn repeat(mut self, bytes: usize) -> Vec<u8> {
        // add rdi, bytes; dec rdx; jnz back to the first byte
        self.bytes.extend([0x48, 0x81, 0xC7]);
        self.bytes.extend((bytes as i32).to_le_bytes());
        self.bytes.extend([0x48, 0xFF, 0xCA]);
        let back = -(self.bytes.len() as i32 + 6);
        self.bytes.extend([0x0F, 0x85]);
        self.bytes.extend(back.to_le_bytes());
        // vzeroupper; ret
        self.bytes.extend([0xC5, 0xF8, 0x77, 0xC3]);
        self.bytes
    }
}

#[cfg(test)]
mod tests;
