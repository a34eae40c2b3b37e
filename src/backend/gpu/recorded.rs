//! Straight-line code that the CPU records, as WGSL text.
//!
//! Shader compilers may re-associate (see `shaders/real.wgsl`): what recovers a rounding error by
//! subtraction must not come this way.

use super::text::{literal, primitive};
use crate::backend::cpu::arithmetic::Comparison;
use crate::backend::cpu::code::{Binary, Fused, Op, Recorder, Value};
use crate::model::Precision;
use crate::program::Primitive;
use std::fmt::Write;

/// How a step's quantities are named in WGSL.
pub trait Names {
    /// An expression for what a slot of the frame holds; what must stand before its first use may be
    /// written.
    fn load(&self, slot: u32, text: &mut String) -> String;

    /// An expression for a parameter.
    fn parameter(&self, index: u32) -> String;

    /// A statement that keeps a value for a slot.
    fn store(&self, slot: u32, value: &str) -> String;
}

/// The statements of straight-line code, in the order in which it was recorded. Elementary functions
/// are those of `shaders/real.wgsl`.
pub fn statements(recorder: Recorder, precision: Precision, names_of: &impl Names) -> String {
    let ops = recorder.finish(1);
    let bits = 8 * precision.bytes();
    let all = u64::MAX >> (64 - bits);
    let suffix = if bits == 64 { "lu" } else { "u" };
    let mut text = String::new();
    // What stands for each value, and whether it is a truth.
    let mut names: Vec<(String, bool)> = Vec::with_capacity(ops.len());
    for (i, op) in ops.iter().enumerate() {
        let name = |v: Value| names[v as usize].0.as_str();
        let pattern = |v: Value| match ops[v as usize] {
            Op::Pattern(bits) => Some(bits),
            _ => None,
        };
        let truth = |v: Value| -> Option<String> {
            match (names[v as usize].1, pattern(v)) {
                (true, _) => Some(name(v).to_owned()),
                (_, Some(0)) => Some("false".to_owned()),
                (_, Some(bits)) if bits == all => Some("true".to_owned()),
                _ => None,
            }
        };
        let known = |v: Value| names[v as usize].1;
        let of_bits = |a: Value, operator: &str, b: Value| {
            format!(
                "bitcast<real>(bitcast<bits>({}) {operator} bitcast<bits>({}))",
                name(a),
                name(b)
            )
        };
        let mut is_truth = false;
        let expression = match *op {
            Op::Load(slot) => {
                let name = names_of.load(slot, &mut text);
                names.push((name, false));
                continue;
            }
            Op::Parameter(p) => {
                names.push((names_of.parameter(p), false));
                continue;
            }
            Op::Pattern(pattern) => {
                let value = match precision {
                    Precision::F32 => f64::from(f32::from_bits(pattern as u32)),
                    Precision::F64 => f64::from_bits(pattern),
                };
                let normal = value == 0.0 || value.is_normal();
                let exact = if value == f64::INFINITY {
                    "LARGEST".to_owned()
                } else if normal && !(value == 0.0 && value.is_sign_negative()) {
                    format!("real({})", literal(value, precision))
                } else {
                    format!("bitcast<real>(bits({pattern}{suffix}))")
                };
                names.push((exact, false));
                continue;
            }
            Op::Store(v, slot) => {
                let value = match known(v) {
                    true => format!("select(real(0.0), real(1.0), {})", name(v)),
                    false => name(v).to_owned(),
                };
                let _ = writeln!(text, "{}", names_of.store(slot, &value));
                names.push((String::new(), false));
                continue;
            }
            Op::Binary(kind @ (Binary::And | Binary::Or | Binary::Xor), a, b) => {
                let operator = match kind {
                    Binary::And => "&",
                    Binary::Or => "|",
                    _ => "^",
                };
                match (truth(a), truth(b)) {
                    (Some(x), Some(y)) if known(a) || known(b) => {
                        is_truth = true;
                        match kind {
                            Binary::Xor => format!("{x} != {y}"),
                            _ => format!("{x} {operator} {y}"),
                        }
                    }
                    _ => of_bits(a, operator, b),
                }
            }
            Op::Binary(Binary::AddBits, a, b) => of_bits(a, "+", b),
            Op::Binary(Binary::Compare(how), a, b) => {
                is_truth = true;
                match how {
                    Comparison::Less => format!("{} < {}", name(a), name(b)),
                    Comparison::Equal => format!("{} == {}", name(a), name(b)),
                    Comparison::Unordered => format!(
                        "!(({a} <= 0.0) | ({a} > 0.0)) | !(({b} <= 0.0) | ({b} > 0.0))",
                        a = name(a),
                        b = name(b)
                    ),
                }
            }
            Op::Binary(kind, a, b) => {
                let operator = match kind {
                    Binary::Add => "+",
                    Binary::Sub => "-",
                    Binary::Mul => "*",
                    _ => "/",
                };
                format!("{} {operator} {}", name(a), name(b))
            }
            Op::Fused(kind, a, b, c) => match kind {
                Fused::MulAdd => format!("{} * {} + {}", name(a), name(b), name(c)),
                Fused::MulSub => format!("{} * {} - {}", name(a), name(b), name(c)),
                Fused::NegMulAdd => format!("{} - {} * {}", name(c), name(a), name(b)),
            },
            Op::Sqrt(a) => format!("sqrt({})", name(a)),
            Op::ShiftLeft(a, by) => {
                format!("bitcast<real>(bitcast<bits>({}) << {by}u)", name(a))
            }
            Op::ShiftRight(a, by) => {
                format!("bitcast<real>(bitcast<bits>({}) >> {by}u)", name(a))
            }
            Op::Blend(mask, yes, no) => {
                let mask = match known(mask) {
                    true => name(mask).to_owned(),
                    false => format!(
                        "((bitcast<bits>({}) >> {}u) != 0{suffix})",
                        name(mask),
                        bits - 1
                    ),
                };
                match (truth(yes), truth(no)) {
                    (Some(x), Some(y)) if known(yes) || known(no) => {
                        is_truth = true;
                        format!("select({y}, {x}, {mask})")
                    }
                    _ => format!("select({}, {}, {mask})", name(no), name(yes)),
                }
            }
            Op::Call(Primitive::Sin, a) => {
                let _ = writeln!(text, "let pair{i} = sin_cos({});", name(a));
                names.push((format!("pair{i}.sine"), false));
                continue;
            }
            Op::Call(Primitive::Cos, _) if matches!(ops[i - 1], Op::Call(Primitive::Sin, _)) => {
                names.push((format!("pair{}.cosine", i - 1), false));
                continue;
            }
            Op::Call(f, a) => format!("{}({})", primitive(f), name(a)),
        };
        let _ = writeln!(text, "let v{i} = {expression};");
        names.push((format!("v{i}"), is_truth));
    }
    text
}
