//! Register allocation for backends that keep values in numbered slots.

use super::{Instr, Program};

/// Index of a register.
pub type Slot = u16;

/// A program with values assigned to registers: constants first, then inputs, then reused
/// temporaries.
#[derive(Clone, Debug)]
pub struct Allocation {
    /// Values of registers `0..constants.len()`.
    pub constants: Vec<f64>,
    /// The first input's register; inputs are consecutive.
    pub first_input: Slot,
    /// Register of each value in the program.
    pub slot: Vec<Slot>,
    /// Registers in all.
    pub registers: usize,
}

impl Allocation {
    /// Linear scan over the straight-line code. An instruction's register is never one of those it
    /// reads, nor that of a value still needed.
    ///
    /// # Panics
    /// When the program needs more than 65536 registers.
    pub fn new(program: &Program) -> Self {
        let count = program.code.len();
        let mut last_use = vec![0usize; count];
        for (i, instr) in program.code.iter().enumerate() {
            instr.reads().for_each(|v| last_use[v as usize] = i);
        }
        program
            .outputs
            .iter()
            .for_each(|o| last_use[*o as usize] = count);

        let constants: Vec<f64> = program
            .code
            .iter()
            .filter_map(|i| {
                if let Instr::Const(c) = i {
                    Some(*c)
                } else {
                    None
                }
            })
            .collect();
        let first_input = constants.len();
        let mut registers = first_input + program.inputs;
        let mut free: Vec<usize> = Vec::new();
        let mut slot = vec![0usize; count];
        let mut next_constant = 0;
        for (i, instr) in program.code.iter().enumerate() {
            slot[i] = match *instr {
                Instr::Const(_) => {
                    next_constant += 1;
                    next_constant - 1
                }
                Instr::Input(k) => first_input + k as usize,
                _ => free.pop().unwrap_or_else(|| {
                    registers += 1;
                    registers - 1
                }),
            };
            let mut dead: Vec<usize> = (instr.reads())
                .map(|v| v as usize)
                .filter(|&v| {
                    last_use[v] == i
                        && !matches!(program.code[v], Instr::Const(_) | Instr::Input(_))
                })
                .map(|v| slot[v])
                .collect();
            dead.dedup();
            for s in dead {
                if !free.contains(&s) {
                    free.push(s);
                }
            }
        }
        assert!(
            registers <= usize::from(Slot::MAX) + 1,
            "the program needs {registers} registers"
        );
        Self {
            constants,
            first_input: first_input as Slot,
            slot: slot.into_iter().map(|s| s as Slot).collect(),
            registers,
        }
    }
}
