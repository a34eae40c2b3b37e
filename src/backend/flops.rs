//! Floating-point operations that the equations and the method need: what a kernel's rate is held
//! against.
//!
//! A multiply-add is two operations, a division or a root one (though a processor takes several
//! times as long over it). Elementary functions count as their polynomials and argument reductions
//! do. Comparisons, selections, moves, the step control and what happens at levels are not counted.

use super::Spec;
use super::constants::Constants;
use crate::integrator::{Scheme, Tableau};
use crate::model::Precision;
use crate::program::{Instr, Primitive, Program};

/// Operations of an evaluation of a program.
pub fn of_program(program: &Program, precision: Precision) -> f64 {
    let mut total = 0.0;
    for (i, instr) in program.code.iter().enumerate() {
        total += match *instr {
            Instr::Input(_) | Instr::Const(_) | Instr::Neg(_) | Instr::Min(..) | Instr::Max(..) => {
                0.0
            }
            Instr::Add(..) | Instr::Sub(..) | Instr::Mul(..) | Instr::Div(..) => 1.0,
            Instr::MulAdd(..) | Instr::MulSub(..) | Instr::NegMulAdd(..) => 2.0,
            // Computed with the sine before it.
            Instr::Call(Primitive::Cos, a)
                if i > 0 && program.code[i - 1] == Instr::Call(Primitive::Sin, a) =>
            {
                0.0
            }
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
        let length = table
            .iter()
            .find(|(n, _)| *n == name)
            .map_or(0, |(_, c)| c.len());
        2.0 * (length.max(1) - 1) as f64
    };
    match f {
        // Reduction; sine and cosine, of which the quadrant chooses.
        Primitive::Sin | Primitive::Cos => {
            10.0 + (3.0 + polynomial("sin")) + (5.0 + polynomial("cos"))
        }
        Primitive::Exp => 10.0 + polynomial("exp") + 3.0,
        Primitive::Expm1 => 10.0 + polynomial("exp") + 4.0,
        Primitive::Log => 15.0 + polynomial("log"),
        Primitive::Log1p => 20.0 + polynomial("log"),
        Primitive::Atan => 8.0 + polynomial("atan"),
        Primitive::Sqrt => 1.0,
        Primitive::Abs | Primitive::Sign | Primitive::Step => 0.0,
    }
}

/// Operations of an attempted step at a relative tolerance.
pub fn of_step(spec: &Spec, rtol: f64) -> f64 {
    let step = match spec.method.scheme(rtol) {
        Scheme::RungeKutta(tableau) => of_stages(spec, tableau),
        Scheme::Taylor(order) => of_expansion(spec, order),
    };
    // Looked at once a step.
    let looked = [
        spec.kinks.as_ref(),
        spec.guards.as_ref().map(|g| &g.program),
    ];
    let looked = looked.into_iter().flatten();
    step + looked.map(|p| of_program(p, spec.precision)).sum::<f64>()
}

fn of_stages(spec: &Spec, tableau: &Tableau) -> f64 {
    let dim = spec.dim() as f64;
    let inputs = spec.rate.inputs as f64;
    let used = |row: &[f64]| row.iter().filter(|x| **x != 0.0).count() as f64;
    let rate = of_program(&spec.rate, spec.precision);
    let mut total = 0.0;
    for (s, row) in tableau.a.iter().enumerate() {
        // Components that no rate depends on are needed only at the end of the step.
        let components = if s + 1 == tableau.a.len() {
            dim
        } else {
            inputs
        };
        total += rate + components * 2.0 * (used(row) + 1.0);
    }
    for estimate in [tableau.error, tableau.companion] {
        if !estimate.is_empty() {
            // The tolerance's norm: scale, quotient, square.
            total += dim * (2.0 * used(estimate) + 6.0);
        }
    }
    total
}

/// Coefficients by the plain recurrences, and the polynomial at the step's end.
fn of_expansion(spec: &Spec, order: usize) -> f64 {
    let program = &spec.rate;
    let fixed = |v: u32| matches!(program.code[v as usize], Instr::Const(_));
    // A number changes nothing beyond the first coefficient, and multiplies each of another series
    // once.
    let sum = |a, b, n: f64| {
        if n > 0.0 && (fixed(a) || fixed(b)) {
            0.0
        } else {
            1.0
        }
    };
    let product = |a, b, n: f64| {
        if fixed(a) || fixed(b) {
            1.0
        } else {
            2.0 * n + 1.0
        }
    };
    let mut total = of_program(program, spec.precision);
    for n in 1..order {
        let n = n as f64;
        for (i, instr) in program.code.iter().enumerate() {
            total += match *instr {
                Instr::Input(_)
                | Instr::Const(_)
                | Instr::Neg(_)
                | Instr::Min(..)
                | Instr::Max(..) => 0.0,
                Instr::Add(a, b) | Instr::Sub(a, b) => sum(a, b, n),
                Instr::Mul(a, b) => product(a, b, n),
                Instr::Div(_, b) => 1.0 + if fixed(b) { 0.0 } else { 2.0 * n },
                Instr::MulAdd(a, b, c) | Instr::MulSub(a, b, c) | Instr::NegMulAdd(a, b, c) => {
                    product(a, b, n) + sum(c, c, n)
                }
                Instr::Call(Primitive::Cos, a)
                    if i > 0 && program.code[i - 1] == Instr::Call(Primitive::Sin, a) =>
                {
                    0.0
                }
                // Two series; one with its own; one with 1 + a^2.
                Instr::Call(Primitive::Sin | Primitive::Cos, _) => 4.0 * n + 1.0,
                Instr::Call(Primitive::Atan, _) => 4.0 * n + 3.0,
                Instr::Call(Primitive::Abs | Primitive::Sign | Primitive::Step, _) => 0.0,
                Instr::Call(..) => 2.0 * n + 1.0,
            };
        }
    }
    let (order, dim) = (order as f64, spec.dim() as f64);
    total + dim * (order - 1.0) + dim * 2.0 * order
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::By;
    use crate::model::Method;

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
        // Three inner stages with one weight for one component, the last one with four for two;
        // four rates.
        let expected = 4.0 * 3.0 + 3.0 * (2.0 * 2.0) + 2.0 * (2.0 * 5.0);
        assert_eq!(of_step(&spec, 1e-6), expected);
        let spec = Spec {
            method: Method::Taylor,
            ..spec
        };
        let order = match spec.method.scheme(1e-6) {
            Scheme::Taylor(order) => order as f64,
            Scheme::RungeKutta(_) => unreachable!("Taylor's method has no tableau"),
        };
        // Each further coefficient takes a product with a number and a quotient by one; what is
        // added is a number.
        let coefficients = 3.0 + (order - 1.0) * (1.0 + 1.0);
        assert_eq!(
            of_step(&spec, 1e-6),
            coefficients + 2.0 * (order - 1.0) + 2.0 * 2.0 * order
        );
    }
}
