//! Floating-point operations that the equations and the method need: what a kernel's rate is held against.
//!
//! A multiply-add is two operations, a division or a root one (though a processor takes several times as long over it).
//! Elementary functions count as their polynomials and argument reductions do. Comparisons, selections, moves, the step
//! control and what happens at levels are not counted.

use crate::backend::Spec;
use crate::backend::constants::Constants;
use crate::model::{Method, Precision};
use crate::program::{Instr, Primitive, Program};

/// Operations of an evaluation of a program.
pub fn of_program(program: &Program, precision: Precision) -> f64 {
    let mut total = 0.0;
    for (i, instr) in program.code.iter().enumerate() {
        total += match *instr {
            Instr::Input(_) | Instr::Const(_) | Instr::Neg(_) | Instr::Min(..) | Instr::Max(..) => 0.0,
            Instr::Add(..) | Instr::Sub(..) | Instr::Mul(..) | Instr::Div(..) => 1.0,
            Instr::MulAdd(..) | Instr::MulSub(..) | Instr::NegMulAdd(..) => 2.0,
            // Computed with the sine before it.
            Instr::Call(Primitive::Cos, a) if i > 0 && program.code[i - 1] == Instr::Call(Primitive::Sin, a) => 0.0,
            Instr::Call(f, _) => of_primitive(f, precision),
        };
    }
    total
}

/// As written in `backend/cpu/real.rs`.
fn of_primitive(f: Primitive, precision: Precision) -> f64 {
    let table = Constants::of(precision).polynomials;
    // Horner's rule.
    let polynomial = |name: &str| {
        let length = table.iter().find(|(n, _)| *n == name).map_or(0, |(_, c)| c.len());
        2.0 * (length.max(1) - 1) as f64
    };
    match f {
        // Reduction; sine and cosine, of which the quadrant chooses.
        Primitive::Sin | Primitive::Cos => 10.0 + (3.0 + polynomial("sin")) + (5.0 + polynomial("cos")),
        Primitive::Exp => 10.0 + polynomial("exp") + 3.0,
        Primitive::Expm1 => 10.0 + polynomial("exp") + 4.0,
        Primitive::Log => 15.0 + polynomial("log"),
        Primitive::Log1p => 20.0 + polynomial("log"),
        Primitive::Atan => 8.0 + polynomial("atan"),
        Primitive::Sqrt => 1.0,
        Primitive::Abs | Primitive::Sign | Primitive::Step => 0.0,
    }
}

/// Operations of an attempted step; `None` for a method that is not a tableau's.
pub fn of_step(spec: &Spec) -> Option<f64> {
    if !matches!(spec.method, Method::Rk4 | Method::Tsit5 | Method::Dop853) {
        return None;
    }
    let tableau = spec.method.tableau();
    let dim = spec.dim() as f64;
    let inputs = spec.rate.inputs as f64;
    let used = |row: &[f64]| row.iter().filter(|x| **x != 0.0).count() as f64;
    let rate = of_program(&spec.rate, spec.precision);
    let mut total = 0.0;
    for (s, row) in tableau.a.iter().enumerate() {
        // Components that no rate depends on are needed only at the end of the step.
        let components = if s + 1 == tableau.a.len() { dim } else { inputs };
        total += rate + components * 2.0 * (used(row) + 1.0);
    }
    for estimate in [tableau.error, tableau.companion] {
        if !estimate.is_empty() {
            // The tolerance's norm: scale, quotient, square.
            total += dim * (2.0 * used(estimate) + 6.0);
        }
    }
    // Looked at once a step.
    let looked = [spec.kinks.as_ref(), spec.guards.as_ref().map(|g| &g.program)];
    Some(
        total
            + looked
                .into_iter()
                .flatten()
                .map(|p| of_program(p, spec.precision))
                .sum::<f64>(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::By;

    /// x' = a x + b with x' of a second component 1: rk4 by hand.
    #[test]
    fn a_step_by_hand() {
        let rate = Program {
            inputs: 1,
            code: vec![
                Instr::Input(0),
                Instr::Const(2.0),
                Instr::Const(3.0),
                Instr::MulAdd(0, 1, 2),
                Instr::Div(0, 1),
            ],
            outputs: vec![3, 4],
        };
        assert_eq!(of_program(&rate, Precision::F64), 3.0);
        let spec = Spec {
            rate,
            guards: None,
            kinks: None,
            method: Method::Rk4,
            precision: Precision::F64,
            by: By::Time,
            store: false,
        };
        // Three inner stages with one weight for one component, the last one with four for two; four rates.
        let expected = 4.0 * 3.0 + 3.0 * (2.0 * 2.0) + 2.0 * (2.0 * 5.0);
        assert_eq!(of_step(&spec), Some(expected));
    }
}
