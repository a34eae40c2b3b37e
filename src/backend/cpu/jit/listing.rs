//! Encoders against what GNU as makes of the same instructions, of doubles and of singles: also where
//! the machine has not got them.

use super::encoder::{Base, Operand, Register};
use crate::model::Precision;

/// An instruction, and of doubles and singles its text and what it is written as.
pub type Row<'t, A> = (fn(&mut A), [&'t str; 2], [&'t str; 2]);

pub fn r(register: Register) -> Operand {
    Operand::Register(register)
}

pub fn m(base: Base, offset: i32) -> Operand {
    Operand::Memory(base, offset)
}

/// `written`: what an encoder of this precision writes of an instruction.
pub fn agrees<A>(listing: &[Row<'_, A>], written: impl Fn(Precision, fn(&mut A)) -> String) {
    for (emit, doubles, singles) in listing {
        for (precision, [text, want]) in [(Precision::F64, doubles), (Precision::F32, singles)] {
            assert_eq!(written(precision, *emit), *want, "{text}");
        }
    }
}
