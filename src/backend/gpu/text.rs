//! WGSL text that every module is made of: numbers, the constants of the elementary functions,
//! programs.

use crate::backend::constants::Constants;
use crate::model::Precision;
use crate::program::{Instr, Primitive, Program};
use std::fmt::Write;

/// A number as WGSL text that gives exactly this value in `precision`.
pub fn literal(x: f64, precision: Precision) -> String {
    let most = match precision {
        Precision::F32 => f64::from(f32::MAX),
        Precision::F64 => f64::MAX,
    };
    if x.is_nan() {
        return "not_a_number()".to_owned();
    }
    let x = x.clamp(-most, most);
    let text = match precision {
        Precision::F32 => format!("{:?}", x as f32),
        Precision::F64 => format!("{x:?}lf"),
    };
    if x.is_sign_negative() {
        format!("({text})")
    } else {
        text
    }
}

/// The condition of `//if` lines for this precision.
pub fn condition(precision: Precision) -> &'static str {
    match precision {
        Precision::F32 => "F32",
        Precision::F64 => "F64",
    }
}

/// The type `real` and the constants of the elementary functions.
pub fn constants(precision: Precision) -> String {
    use std::f64::consts;
    let (least, most) = match precision {
        Precision::F32 => (f64::from(f32::MIN_POSITIVE), f64::from(f32::MAX)),
        Precision::F64 => (f64::MIN_POSITIVE, f64::MAX),
    };
    let (word, suffix, mantissa, bias) = match precision {
        Precision::F32 => ("u32", "u", f32::MANTISSA_DIGITS - 1, 127),
        Precision::F64 => ("u64", "lu", f64::MANTISSA_DIGITS - 1, 1023),
    };
    let (one, root_half) = match precision {
        Precision::F32 => (
            u64::from(1f32.to_bits()),
            u64::from((consts::FRAC_1_SQRT_2 as f32).to_bits()),
        ),
        Precision::F64 => (1f64.to_bits(), consts::FRAC_1_SQRT_2.to_bits()),
    };
    let mut text = format!("alias real = {};\n", precision.name());
    let table = Constants::of(precision);
    let mut real = |name: &str, value: f64| {
        let _ = writeln!(text, "const {name}: real = {};", literal(value, precision));
    };
    for (name, value) in [
        ("EPSILON", precision.epsilon()),
        ("SMALLEST_NORMAL", least),
        ("LARGEST", most),
        ("SUBNORMAL_SCALE", f64::from(mantissa).exp2()),
        ("FRAC_2_PI", consts::FRAC_2_PI),
        ("FRAC_PI_2", consts::FRAC_PI_2),
        ("FRAC_PI_4", consts::FRAC_PI_4),
        ("LOG2_E", consts::LOG2_E),
        ("OVERFLOW", table.overflow),
        ("UNDERFLOW", table.underflow),
    ] {
        real(name, value);
    }
    for (k, c) in table.pio2.iter().enumerate() {
        real(&format!("PIO2_{k}"), *c);
    }
    for (k, c) in table.ln2.iter().enumerate() {
        real(&format!("LN2_{k}"), *c);
    }
    let _ = writeln!(
        text,
        "alias bits = {word};\nconst MANTISSA: u32 = {mantissa}u;\nconst BIAS: i32 = {bias};"
    );
    for (name, value) in [
        ("MANTISSA_MASK", (1u64 << mantissa) - 1),
        ("ROOT_HALF", root_half),
        ("ROOT_HALF_TO_ONE", one - root_half),
    ] {
        let _ = writeln!(text, "const {name}: bits = {value}{suffix};");
    }
    for (name, coefficients) in table.polynomials {
        let horner = (coefficients.iter().map(|c| literal(*c, precision)))
            .reduce(|acc, c| format!("({acc}) * x + {c}"))
            .unwrap_or_default();
        let _ = writeln!(
            text,
            "fn {name}_polynomial(x: real) -> real {{\n    return {horner};\n}}"
        );
    }
    text
}

/// A structure of `count` components.
pub fn structure(text: &mut String, name: &str, count: usize) {
    let fields: Vec<String> = (0..count).map(|c| format!("c{c}: real")).collect();
    let _ = writeln!(text, "struct {name} {{ {}, }}", fields.join(", "));
}

/// A program as a function of `Inputs`.
pub fn function(name: &str, program: &Program, output: &str, precision: Precision) -> String {
    let mut text = format!("fn {name}(x: Inputs) -> {output} {{\n");
    let mut value: Vec<String> = Vec::with_capacity(program.code.len());
    for (i, instr) in program.code.iter().enumerate() {
        let at = |v: u32| value[v as usize].as_str();
        let expression = match *instr {
            Instr::Input(k) => {
                value.push(format!("x.c{k}"));
                continue;
            }
            Instr::Const(c) => {
                value.push(literal(c, precision));
                continue;
            }
            Instr::Add(a, b) => format!("{} + {}", at(a), at(b)),
            Instr::Sub(a, b) => format!("{} - {}", at(a), at(b)),
            Instr::Mul(a, b) => format!("{} * {}", at(a), at(b)),
            Instr::Div(a, b) => format!("{} / {}", at(a), at(b)),
            Instr::Neg(a) => format!("-{}", at(a)),
            Instr::MulAdd(a, b, c) => format!("{} * {} + {}", at(a), at(b), at(c)),
            Instr::MulSub(a, b, c) => format!("{} * {} - {}", at(a), at(b), at(c)),
            Instr::NegMulAdd(a, b, c) => format!("{} - {} * {}", at(c), at(a), at(b)),
            Instr::Min(a, b) => format!("least({}, {})", at(a), at(b)),
            Instr::Max(a, b) => format!("greatest({}, {})", at(a), at(b)),
            Instr::Call(Primitive::Sin, a) if matches!(program.code.get(i + 1), Some(Instr::Call(Primitive::Cos, b)) if *b == a) =>
            {
                let _ = writeln!(text, "    let pair{i} = sin_cos({});", at(a));
                value.push(format!("pair{i}.sine"));
                continue;
            }
            Instr::Call(Primitive::Cos, a)
                if i > 0 && program.code[i - 1] == Instr::Call(Primitive::Sin, a) =>
            {
                value.push(format!("pair{}.cosine", i - 1));
                continue;
            }
            Instr::Call(f, a) => format!("{}({})", primitive(f), at(a)),
        };
        let _ = writeln!(text, "    let v{i}: real = {expression};");
        value.push(format!("v{i}"));
    }
    let outputs: Vec<&str> = program
        .outputs
        .iter()
        .map(|o| value[*o as usize].as_str())
        .collect();
    let _ = writeln!(text, "    return {output}({});\n}}", outputs.join(", "));
    text
}

/// A primitive's function in real.wgsl, or WGSL's own where that is exact.
pub fn primitive(f: Primitive) -> &'static str {
    match f {
        Primitive::Sin => "sine",
        Primitive::Cos => "cosine",
        Primitive::Exp => "exponential",
        Primitive::Expm1 => "expm1_",
        Primitive::Log => "logarithm",
        Primitive::Log1p => "log1p_",
        Primitive::Atan => "arctangent",
        Primitive::Sqrt => "sqrt",
        Primitive::Abs => "abs",
        Primitive::Sign => "sign_",
        Primitive::Step => "step_",
    }
}
