//! WGSL text that depends on the scene or the method: constants, the model's right-hand side and guards, and the
//! stages of a step, all straight-line code over named components (arrays would be indexed in memory).

use crate::backend::constants::Constants;
use crate::backend::{By, Guards, Spec};
use crate::integrator::{Tableau, control};
use crate::model::Precision;
use crate::program::{Instr, Primitive, Program};
use std::fmt::Write;

/// Invocations a workgroup.
pub const WORKGROUP: u32 = 64;

/// What a run, beyond its [`Spec`], asks of the shader.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Variant {
    /// Leading components with bounds.
    pub bounds: usize,
    /// Component with a ceiling.
    pub ceiling: Option<usize>,
}

/// Components of a stored sample: all but the coordinate, which is the level.
pub fn stored(spec: &Spec) -> impl Iterator<Item = usize> + use<> {
    let by = spec.by;
    (0..spec.dim()).filter(move |c| by != By::Component(*c))
}

/// Offsets into the buffer of run settings.
#[derive(Clone, Copy, Debug)]
pub struct Settings {
    pub rtol: usize,
    pub step: usize,
    pub ceiling: usize,
    pub last: usize,
    pub atol: usize,
    pub lower: usize,
    pub upper: usize,
    pub levels: usize,
}

impl Settings {
    pub fn new(dim: usize, variant: Variant) -> Self {
        let atol = 4;
        let lower = atol + dim;
        let upper = lower + variant.bounds;
        Self {
            rtol: 0,
            step: 1,
            ceiling: 2,
            last: 3,
            atol,
            lower,
            upper,
            levels: upper + variant.bounds,
        }
    }
}

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

/// The text of one module's generated parts.
pub struct Emitter<'a> {
    spec: &'a Spec,
    variant: Variant,
    tableau: &'static Tableau,
    dim: usize,
    inputs: usize,
}

impl<'a> Emitter<'a> {
    pub fn new(spec: &'a Spec, variant: Variant) -> Self {
        Self {
            spec,
            variant,
            tableau: spec.method.tableau(),
            dim: spec.dim(),
            inputs: spec.rate.inputs,
        }
    }

    fn number(&self, x: f64) -> String {
        literal(x, self.spec.precision)
    }

    /// The conditions of `//if` lines that hold.
    pub fn conditions(&self) -> Vec<&'static str> {
        let mut list = vec![match self.spec.precision {
            Precision::F32 => "F32",
            Precision::F64 => "F64",
        }];
        list.push(if self.tableau.adaptive() { "ADAPTIVE" } else { "FIXED" });
        list.push(match self.spec.by {
            By::Time => "BY_TIME",
            By::Component(_) => "BY_COMPONENT",
        });
        list.push(if self.spec.guards.is_some() {
            "GUARDS"
        } else {
            "UNGUARDED"
        });
        for (holds, name) in [
            (self.spec.store, "STORE"),
            (self.variant.bounds > 0, "BOUNDS"),
            (self.variant.ceiling.is_some(), "CEILING"),
        ] {
            if holds {
                list.push(name);
            }
        }
        list
    }

    /// The model: the right-hand side and the guards.
    pub fn model(&self) -> String {
        let mut text = String::new();
        structure(&mut text, "Vector", self.dim);
        structure(&mut text, "Inputs", self.inputs);
        text += &function("rate", &self.spec.rate, "Vector", self.spec.precision);
        if let Some(Guards { program, strict }) = &self.spec.guards {
            structure(&mut text, "GuardValues", program.outputs.len());
            text += &function("guard_values", program, "GuardValues", self.spec.precision);
            let holds: Vec<String> = (strict.iter().enumerate())
                .map(|(g, strict)| format!("(v.c{g} {} 0.0)", if *strict { ">" } else { ">=" }))
                .collect();
            let _ = write!(
                text,
                "fn guards_hold(x: Inputs) -> bool {{\n    let v = guard_values(x);\n    return {};\n}}\n",
                holds.join(" & ")
            );
        }
        text
    }

    /// The method: the stages of a step, its error, its dense output.
    pub fn method(&self) -> String {
        let mut text = String::new();
        self.step_structure(&mut text);
        self.attempt(&mut text);
        self.dense(&mut text);
        self.vectors(&mut text);
        self.buffers(&mut text);
        text
    }

    fn step_structure(&self, text: &mut String) {
        let stages: String = (1..self.tableau.stages()).map(|s| format!(" k{s}: Vector,")).collect();
        let _ = writeln!(text, "// New point, derivatives at the stages, squared error.");
        let _ = writeln!(text, "struct Step {{ y: Vector,{stages} error: real, }}");
    }

    /// `sum_j weights[j] k_j.c`
    fn combination(&self, weights: &[f64], c: usize) -> String {
        let terms: Vec<String> = (weights.iter().enumerate())
            .filter(|(_, w)| **w != 0.0)
            .map(|(j, w)| {
                if *w == 1.0 {
                    format!("k{j}.c{c}")
                } else {
                    format!("k{j}.c{c} * {}", self.number(*w))
                }
            })
            .collect();
        terms.join(" + ")
    }

    fn attempt(&self, text: &mut String) {
        let stages = self.tableau.stages();
        let _ = writeln!(text, "fn attempt(y: Vector, k0: Vector, h: real, run: Run) -> Step {{");
        for s in 1..stages {
            let last = s + 1 == stages;
            // Components that no derivative depends on are needed only at the end of the step.
            let components = if last { self.dim } else { self.inputs };
            for c in 0..components {
                let sum = self.combination(self.tableau.a[s - 1], c);
                let _ = writeln!(text, "    let y{s}_{c} = y.c{c} + h * ({sum});");
            }
            let arguments: Vec<String> = (0..self.inputs).map(|c| format!("y{s}_{c}")).collect();
            let _ = writeln!(text, "    let k{s} = rate(Inputs({}));", arguments.join(", "));
        }
        let last = stages - 1;
        let new: Vec<String> = (0..self.dim).map(|c| format!("y{last}_{c}")).collect();
        let all: Vec<String> = (1..stages).map(|s| format!("k{s}")).collect();
        if self.tableau.adaptive() {
            for c in 0..self.dim {
                let sum = self.combination(self.tableau.error, c);
                let _ = writeln!(
                    text,
                    "    let e{c} = ({sum}) * h / (run.atol.c{c} + run.rtol * max(abs(y.c{c}), abs(y{last}_{c})));"
                );
            }
            let squares: Vec<String> = (0..self.dim).map(|c| format!("e{c} * e{c}")).collect();
            let share = self.number(1.0 / self.dim as f64);
            let _ = writeln!(text, "    let square = ({}) * {share};", squares.join(" + "));
            self.companion(text, last, &share);
        } else {
            // Only whether it is finite matters.
            let terms: Vec<String> = (0..self.dim).map(|c| format!("y{last}_{c} + k{last}.c{c}")).collect();
            let _ = writeln!(text, "    let error = {};", terms.join(" + "));
        }
        let _ = writeln!(
            text,
            "    return Step(Vector({}), {}, error);\n}}",
            new.join(", "),
            all.join(", ")
        );
    }

    /// The squared error, from the estimate's mean square and that of the companion where there is one.
    fn companion(&self, text: &mut String, last: usize, share: &str) {
        if self.tableau.companion.is_empty() {
            let _ = writeln!(text, "    let error = square;");
            return;
        }
        for c in 0..self.dim {
            let sum = self.combination(self.tableau.companion, c);
            let _ = writeln!(
                text,
                "    let g{c} = ({sum}) * h / (run.atol.c{c} + run.rtol * max(abs(y.c{c}), abs(y{last}_{c})));"
            );
        }
        let squares: Vec<String> = (0..self.dim).map(|c| format!("g{c} * g{c}")).collect();
        let weight = self.number(control::COMPANION);
        let _ = writeln!(
            text,
            "    let sum = square + {weight} * ({}) * {share};\n    let error = select(square, square * (square / sum), sum > {});",
            squares.join(" + "),
            self.number(0.0)
        );
    }

    fn dense(&self, text: &mut String) {
        let dense = self.tableau.dense;
        let _ = writeln!(
            text,
            "fn interpolate(y: Vector, k0: Vector, step: Step, h: real, q: real) -> Vector {{\n    if (q == 1.0) {{\n        \
             return step.y;\n    }}"
        );
        for (j, d) in dense.iter().enumerate() {
            let used = d.iter().rposition(|d| *d != 0.0).map_or(0, |last| last + 1);
            let horner = (d[..used].iter().rev()).fold(String::new(), |acc, d| {
                let d = self.number(*d);
                if acc.is_empty() {
                    d
                } else {
                    format!("{d} + q * ({acc})")
                }
            });
            let _ = writeln!(text, "    let b{j}: real = q * ({horner});");
        }
        self.stage_names(text);
        let components: Vec<String> = (0..self.dim)
            .map(|c| {
                let terms: Vec<String> = (0..dense.len()).map(|j| format!("k{j}.c{c} * b{j}")).collect();
                format!("y.c{c} + h * ({})", terms.join(" + "))
            })
            .collect();
        let _ = writeln!(text, "    return Vector({});\n}}", components.join(", "));
        let By::Component(c) = self.spec.by else {
            return;
        };
        let _ = writeln!(
            text,
            "// Dense output of the coordinate: y + h q (p0 + q (p1 + q (p2 + q p3)))."
        );
        let _ = writeln!(text, "struct Path {{ p0: real, p1: real, p2: real, p3: real, }}");
        let _ = writeln!(text, "fn path(k0: Vector, step: Step) -> Path {{");
        self.stage_names(text);
        let powers: Vec<String> = (0..4)
            .map(|m| {
                let weights: Vec<f64> = dense.iter().map(|d| d[m]).collect();
                let sum = self.combination(&weights, c);
                if sum.is_empty() { "0.0".to_owned() } else { sum }
            })
            .collect();
        let _ = writeln!(text, "    return Path({});\n}}", powers.join(", "));
    }

    fn stage_names(&self, text: &mut String) {
        for s in 1..self.tableau.stages() {
            let _ = writeln!(text, "    let k{s} = step.k{s};");
        }
    }

    /// Functions of whole vectors.
    fn vectors(&self, text: &mut String) {
        let list = |count: usize, f: &dyn Fn(usize) -> String, separator: &str| {
            (0..count).map(f).collect::<Vec<_>>().join(separator)
        };
        let leading = list(self.inputs, &|c| format!("y.c{c}"), ", ");
        let _ = writeln!(
            text,
            "fn inputs_of(y: Vector) -> Inputs {{\n    return Inputs({leading});\n}}"
        );
        let coordinate = match self.spec.by {
            By::Time => "t".to_owned(),
            By::Component(c) => format!("y.c{c}"),
        };
        let _ = writeln!(
            text,
            "fn coordinate(y: Vector, t: real) -> real {{\n    return {coordinate};\n}}"
        );
        let sum = list(self.dim, &|c| format!("y.c{c}"), " + ");
        let _ = writeln!(text, "fn total(y: Vector) -> real {{\n    return {sum};\n}}");
        if self.tableau.adaptive() {
            let _ = writeln!(
                text,
                "// Norm of v in units of the tolerance at y; free of overflow in f32."
            );
            let _ = writeln!(text, "fn norm(v: Vector, y: Vector, run: Run) -> real {{");
            for c in 0..self.dim {
                let _ = writeln!(
                    text,
                    "    let n{c} = abs(v.c{c}) / (run.atol.c{c} + run.rtol * abs(y.c{c}));"
                );
            }
            let most = (1..self.dim).fold("n0".to_owned(), |acc, c| format!("max({acc}, n{c})"));
            let _ = writeln!(
                text,
                "    let most = {most};\n    let unit = select(most, 1.0, most == 0.0);"
            );
            let squares = list(self.dim, &|c| format!("(n{c} / unit) * (n{c} / unit)"), " + ");
            let _ = writeln!(text, "    return unit * sqrt({squares});\n}}");
        }
        if self.variant.bounds > 0 {
            let inside = |c: usize| format!("(y.c{c} >= run.lower{c}) & (y.c{c} <= run.upper{c})");
            let _ = writeln!(
                text,
                "fn within(y: Vector, run: Run) -> bool {{\n    return {};\n}}",
                list(self.variant.bounds, &inside, " & ")
            );
        }
    }

    /// Loads and stores.
    fn buffers(&self, text: &mut String) {
        let settings = Settings::new(self.dim, self.variant);
        let mut fields = vec![
            "rtol: real".to_owned(),
            "step: real".into(),
            "ceiling: real".into(),
            "last: real".into(),
        ];
        fields.push("atol: Vector".to_owned());
        let at = |k: usize| format!("settings[{k}]");
        let mut values: Vec<String> = (0..settings.atol).map(at).collect();
        let atol: Vec<String> = (settings.atol..settings.lower).map(at).collect();
        values.push(format!("Vector({})", atol.join(", ")));
        for (name, offset) in [("lower", settings.lower), ("upper", settings.upper)] {
            for c in 0..self.variant.bounds {
                fields.push(format!("{name}{c}: real"));
                values.push(at(offset + c));
            }
        }
        let _ = writeln!(text, "struct Run {{ {}, }}", fields.join(", "));
        let _ = writeln!(
            text,
            "fn load_run() -> Run {{\n    return Run({});\n}}",
            values.join(", ")
        );

        let vector = |first: usize| {
            let components: Vec<String> = (0..self.dim)
                .map(|c| format!("state[i + {}u * control.stride]", first + c))
                .collect();
            format!("Vector({})", components.join(", "))
        };
        let _ = writeln!(text, "fn load_seed(i: u32) -> Vector {{\n    return {};\n}}", vector(0));
        let (y, k) = (vector(0), vector(self.dim));
        let scalar = |k: usize| format!("state[i + {}u * control.stride]", 2 * self.dim + k);
        let counter = |k: usize| format!("counters[i + {k}u * control.stride]");
        let _ = write!(
            text,
            "fn load(i: u32) -> Lane {{\n    let next_level = {};\n    return Lane({y}, {k}, {}, {}, f32({}), {}, {}, \
             next_level, {}, {}, level(next_level), 0u);\n}}\n",
            counter(1),
            scalar(0),
            scalar(1),
            scalar(2),
            scalar(3),
            counter(0),
            counter(2),
            counter(3),
        );
        let _ = writeln!(text, "fn save(i: u32, lane: Lane) {{");
        for (k, field) in ["status", "next_level", "steps", "rejected"].iter().enumerate() {
            let _ = writeln!(text, "    {} = lane.{field};", counter(k));
        }
        let _ = writeln!(text, "    if (lane.status != RUNNING) {{");
        for c in 0..self.dim {
            let _ = writeln!(text, "        ends[i + {c}u * control.stride] = lane.y.c{c};");
        }
        let _ = writeln!(
            text,
            "        ends[i + {}u * control.stride] = lane.t;\n        return;\n    }}",
            self.dim
        );
        for c in 0..self.dim {
            let _ = writeln!(text, "    state[i + {c}u * control.stride] = lane.y.c{c};");
            let _ = writeln!(text, "    state[i + {}u * control.stride] = lane.k.c{c};", self.dim + c);
        }
        for (k, field) in ["lane.t", "lane.h", "real(lane.before)", "lane.first_step"]
            .iter()
            .enumerate()
        {
            let _ = writeln!(text, "    {} = {field};", scalar(k));
        }
        text.push_str("}\n");
        if self.spec.store {
            let _ = writeln!(text, "fn store_vector(at: u32, y: Vector) {{");
            for (k, c) in stored(self.spec).enumerate() {
                let _ = writeln!(text, "    samples[at + {k}u] = y.c{c};");
            }
            text.push_str("}\n");
        }
    }

    /// Names that the hand-written fragments use in place of components and stages.
    pub fn names(&self) -> Vec<(&'static str, String)> {
        let mut list = vec![("LAST_STAGE", format!("k{}", self.tableau.stages() - 1))];
        if let By::Component(c) = self.spec.by {
            list.push(("COORDINATE", format!("c{c}")));
        }
        if let Some(c) = self.variant.ceiling {
            list.push(("CEILING_COMPONENT", format!("c{c}")));
        }
        list
    }

    /// Constants of the integrator.
    pub fn constants(&self) -> String {
        let mut text = constants(self.spec.precision);
        let settings = Settings::new(self.dim, self.variant);
        let _ = writeln!(text, "const WORKGROUP: u32 = {WORKGROUP}u;");
        let _ = writeln!(text, "const DIM: u32 = {}u;", self.dim);
        let _ = writeln!(text, "const LEVELS: u32 = {}u;", settings.levels);
        let _ = writeln!(text, "const SAMPLE: u32 = {}u;", 1 + stored(self.spec).count());
        let _ = writeln!(text, "const RUNNING: u32 = {}u;", super::RUNNING);
        let _ = writeln!(text, "const EVENT: u32 = {}u;", super::EVENT);
        for (status, name) in crate::backend::Status::ALL {
            let _ = writeln!(text, "const {}: u32 = {}u;", name.to_uppercase(), status as i32);
        }
        let mut real = |name: &str, value: f64| {
            let _ = writeln!(text, "const {name}: real = {};", literal(value, self.spec.precision));
        };
        real("FIRST", self.tableau.first());
        real("FLOOR", control::FLOOR_ULPS * self.spec.precision.epsilon());
        let mut single = |name: &str, value: f64| {
            let _ = writeln!(text, "const {name}: f32 = {};", literal(value, Precision::F32));
        };
        single("SAFETY", control::SAFETY);
        single("HALF_ALPHA", 0.5 * control::ALPHA * self.tableau.exponent());
        single("HALF_BETA", 0.5 * control::BETA * self.tableau.exponent());
        single("HALF_REFUSED", 0.5 * self.tableau.exponent());
        single("SHRINK", control::SHRINK);
        single("GROW", control::GROW);
        single("LEAST_SQUARED_ERROR", control::LEAST_ERROR * control::LEAST_ERROR);
        text
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

fn structure(text: &mut String, name: &str, count: usize) {
    let fields: Vec<String> = (0..count).map(|c| format!("c{c}: real")).collect();
    let _ = writeln!(text, "struct {name} {{ {}, }}", fields.join(", "));
}

/// A program as a function of `Inputs`.
fn function(name: &str, program: &Program, output: &str, precision: Precision) -> String {
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
            Instr::Call(Primitive::Cos, a) if i > 0 && program.code[i - 1] == Instr::Call(Primitive::Sin, a) => {
                value.push(format!("pair{}.cosine", i - 1));
                continue;
            }
            Instr::Call(f, a) => format!("{}({})", primitive(f), at(a)),
        };
        let _ = writeln!(text, "    let v{i}: real = {expression};");
        value.push(format!("v{i}"));
    }
    let outputs: Vec<&str> = program.outputs.iter().map(|o| value[*o as usize].as_str()).collect();
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
