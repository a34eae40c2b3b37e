//! WGSL text that depends on the scene or the method: constants, the model's right-hand side and guards, and the
//! stages of a step, all straight-line code over named components (arrays would be indexed in memory).

use super::text::{condition, constants, function, literal, structure};
use crate::backend::{By, Guards, Spec, Variant};
use crate::integrator::{Tableau, control};
use crate::model::Precision;
use std::fmt::Write;

/// Fields t, h, before and first_step of the state.
const SCALARS: usize = 4;

/// Where in a chart's law its parts are: the vector is `(s, q, H, ...)`, H's upper triangle row by row.
#[derive(Clone, Copy, Debug)]
pub struct Law {
    /// Components of s.
    pub states: usize,
    /// The last time at which the chart is asked, where time is an argument of it.
    pub last: Option<f64>,
}

/// Reals of a trajectory's state: y and k, the scalars, and with kinks the step size to resume and their values.
pub fn state(spec: &Spec) -> usize {
    let kinks = kinks(spec);
    2 * spec.dim() + SCALARS + if kinks > 0 { 1 + kinks } else { 0 }
}

/// Invocations a workgroup.
pub const WORKGROUP: u32 = 64;

/// Components of a stored sample: all but the coordinate, which is the level.
pub fn stored(spec: &Spec) -> impl Iterator<Item = usize> + use<> {
    let by = spec.by;
    (0..spec.dim()).filter(move |c| by != By::Component(*c))
}

/// Kinks that steps are made to end at; a fixed step has no choice.
pub fn kinks(spec: &Spec) -> usize {
    let adaptive = spec.method.adaptive();
    (spec.kinks.as_ref().filter(|_| adaptive)).map_or(0, |program| program.outputs.len())
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

/// The text of one module's generated parts.
pub struct Emitter<'a> {
    spec: &'a Spec,
    variant: Variant,
    tableau: &'static Tableau,
    dim: usize,
    inputs: usize,
    legs: Option<Law>,
}

impl<'a> Emitter<'a> {
    pub fn new(spec: &'a Spec, tableau: &'static Tableau, variant: Variant) -> Self {
        Self {
            spec,
            variant,
            tableau,
            dim: spec.dim(),
            inputs: spec.rate.inputs,
            legs: None,
        }
    }

    /// Of a kernel that sets a chart's law at the beginning of each leg.
    pub fn with_legs(self, law: Law) -> Self {
        Self {
            legs: Some(law),
            ..self
        }
    }

    fn number(&self, x: f64) -> String {
        literal(x, self.spec.precision)
    }

    /// The conditions of `//if` lines that hold.
    pub fn conditions(&self) -> Vec<&'static str> {
        let mut list = vec![condition(self.spec.precision)];
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
            (kinks(self.spec) > 0, "KINKS"),
            (self.legs.is_some(), "LEGS"),
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
        self.kinks(&mut text);
        text
    }

    /// The kinks' values, and where a step meets the first one.
    fn kinks(&self, text: &mut String) {
        let Some(program) = self.spec.kinks.as_ref().filter(|_| kinks(self.spec) > 0) else {
            return;
        };
        structure(text, "Sides", program.outputs.len());
        *text += &function("kink_values", program, "Sides", self.spec.precision);
        let _ = writeln!(
            text,
            "// Fraction of a step up to its first kink, from the values at its ends; 2 where there is none.\n\
             fn first_kink(begin: Sides, end: Sides) -> real {{\n    var first: real = 2.0;"
        );
        for g in 0..program.outputs.len() {
            let (a, b) = (format!("begin.c{g}"), format!("end.c{g}"));
            let _ = writeln!(
                text,
                "    let q{g} = {a} / ({a} - {b});\n    let crossed{g} = (({a} < 0.0) & ({b} >= 0.0)) | (({a} > 0.0) & ({b} <= 0.0));\n    \
                 first = select(first, q{g}, crossed{g} & (q{g} < first));"
            );
        }
        text.push_str("    return first;\n}\n");
    }

    /// The method: the stages of a step, its error, its dense output.
    pub fn method(&self) -> String {
        let mut text = String::new();
        self.step_structure(&mut text);
        self.attempt(&mut text);
        self.dense(&mut text);
        self.vectors(&mut text);
        self.buffers(&mut text);
        if let Some(law) = self.legs {
            self.law(law, &mut text);
        }
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
        if terms.is_empty() {
            return self.number(0.0);
        }
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

    /// The dense output: polynomials in the fraction of the step, made once for all points wanted in it.
    fn dense(&self, text: &mut String) {
        let (tableau, degree) = (self.tableau, self.tableau.degree());
        let names = |f: &dyn Fn(usize) -> String| (0..degree).map(f).collect::<Vec<_>>();
        let _ = writeln!(
            text,
            "// y + h q (d0 + q (d1 + ...))\nstruct Dense {{ {}, }}",
            names(&|m| format!("d{m}: Vector")).join(", ")
        );
        let _ = writeln!(
            text,
            "fn densify(y: Vector, k0: Vector, step: Step, h: real) -> Dense {{"
        );
        self.stage_names(text);
        for (e, a) in tableau.extra.iter().enumerate() {
            let s = tableau.stages() + e;
            for c in 0..self.inputs {
                let sum = self.combination(a, c);
                let _ = writeln!(text, "    let y{s}_{c} = y.c{c} + h * ({sum});");
            }
            let arguments: Vec<String> = (0..self.inputs).map(|c| format!("y{s}_{c}")).collect();
            let _ = writeln!(text, "    let k{s} = rate(Inputs({}));", arguments.join(", "));
        }
        let (zero, mut of) = (self.number(0.0), Vec::new());
        for c in 0..self.dim {
            let parts: Vec<String> = (0..degree)
                .map(|i| {
                    let weights: Vec<f64> = tableau.dense.iter().map(|d| d[i]).collect();
                    let _ = writeln!(text, "    let f{i}_{c}: real = {};", self.combination(&weights, c));
                    format!("f{i}_{c}")
                })
                .collect();
            let power = |m: usize| {
                let terms: Vec<String> = (0..degree)
                    .map(|i| (tableau.power(i, m), &parts[i]))
                    .filter(|(w, _)| *w != 0.0)
                    .map(|(w, part)| {
                        if w == 1.0 {
                            part.clone()
                        } else {
                            format!("{part} * {}", self.number(w))
                        }
                    })
                    .collect();
                if terms.is_empty() {
                    zero.clone()
                } else {
                    terms.join(" + ")
                }
            };
            of.push((0..degree).map(power).collect::<Vec<_>>());
        }
        let vectors = names(&|m| {
            let components: Vec<&str> = of.iter().map(|powers| powers[m].as_str()).collect();
            format!("Vector({})", components.join(", "))
        });
        let _ = writeln!(text, "    return Dense({});\n}}", vectors.join(", "));
        let horner = |c: usize| {
            (0..degree - 1).rev().fold(format!("d.d{}.c{c}", degree - 1), |acc, m| {
                format!("d.d{m}.c{c} + q * ({acc})")
            })
        };
        let _ = writeln!(
            text,
            "fn interpolate(y: Vector, d: Dense, step: Step, h: real, q: real) -> Vector {{\n    if (q == 1.0) {{\n        \
             return step.y;\n    }}\n    let s = q * h;"
        );
        let components: Vec<String> = (0..self.dim).map(|c| format!("y.c{c} + s * ({})", horner(c))).collect();
        let _ = writeln!(text, "    return Vector({});\n}}", components.join(", "));
        if let By::Component(c) = self.spec.by {
            let slope = (0..degree - 1).rev().fold(
                format!("{} * d.d{}.c{c}", self.number(degree as f64), degree - 1),
                |acc, m| format!("{} * d.d{m}.c{c} + q * ({acc})", self.number((m + 1) as f64)),
            );
            let _ = writeln!(
                text,
                "// The coordinate's way since the begin of the step and its slope, per unit of h.\n\
                 struct Along {{ way: real, slope: real, }}\n\
                 fn along(d: Dense, q: real) -> Along {{\n    return Along(q * ({}), {slope});\n}}",
                horner(c)
            );
        }
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
        let kinks = kinks(self.spec);
        let scalar = |k: usize| format!("state[i + {}u * control.stride]", 2 * self.dim + k);
        let counter = |k: usize| format!("counters[i + {k}u * control.stride]");
        // What a step remembers of its kinks, behind the other fields.
        let mut remembered = String::new();
        if kinks > 0 {
            let sides: Vec<String> = (0..kinks).map(|g| scalar(SCALARS + 1 + g)).collect();
            let _ = write!(remembered, ", {}, Sides({})", scalar(SCALARS), sides.join(", "));
        }
        if self.legs.is_some() {
            let _ = write!(remembered, ", {}, {}", counter(4), counter(5));
        }
        let _ = write!(
            text,
            "fn load(i: u32) -> Lane {{\n    let next_level = {};\n    return Lane({y}, {k}, {}, {}, f32({}), {}, {}, \
             next_level, {}, {}, level(next_level), 0u{remembered});\n}}\n",
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
        let (own, going) = match self.legs {
            Some(_) => (["leg", "begun"].as_slice(), "is_going(lane.status)"),
            None => ([].as_slice(), "lane.status == RUNNING"),
        };
        let fields = ["status", "next_level", "steps", "rejected"];
        for (k, field) in fields.iter().chain(own).enumerate() {
            let _ = writeln!(text, "    {} = lane.{field};", counter(k));
        }
        let _ = writeln!(text, "    if (!({going})) {{");
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
        if kinks > 0 {
            let _ = writeln!(text, "    {} = lane.resume;", scalar(SCALARS));
        }
        for g in 0..kinks {
            let _ = writeln!(text, "    {} = lane.sides.c{g};", scalar(SCALARS + 1 + g));
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

    /// A chart's place of a vector, its law, and where legs begin; see `shaders/legs.wgsl`.
    fn law(&self, Law { states: n, last }: Law, text: &mut String) {
        let mut place: Vec<String> = (0..n).map(|i| format!("y.c{i}")).collect();
        if let Some(last) = last {
            // Over a period p of V(x, t) changes with time too: that of its middle errs only to the second order of the period.
            let middle = format!("(real(leg) + {}) * run.last", self.number(0.5));
            place.push(format!("min({middle}, {})", self.number(last)));
        }
        let arguments = place.len();
        // Of the triangle of second derivatives by all arguments.
        let pair = |a: usize, b: usize| {
            let (i, j) = (a.min(b), a.max(b));
            i * (2 * arguments - i - 1) / 2 + j
        };
        let _ = writeln!(
            text,
            "fn place_of(y: Vector, leg: u32, run: Run) -> Place {{\n    return Place({});\n}}",
            place.join(", ")
        );
        let _ = writeln!(
            text,
            "fn set_law(lane: ptr<function, Lane>, said: Said) {{\n    let s = (*lane).y;"
        );
        let mut entry = 2 * n;
        for i in 0..n {
            let terms: Vec<String> = (0..n).map(|j| format!("said.h[{}] * s.c{j}", pair(i, j))).collect();
            let _ = writeln!(
                text,
                "    (*lane).y.c{} = said.p[{i}] - ({});",
                n + i,
                terms.join(" + ")
            );
            for j in i..n {
                let _ = writeln!(text, "    (*lane).y.c{entry} = said.h[{}];", pair(i, j));
                entry += 1;
            }
        }
        let first = state(self.spec);
        let _ = writeln!(text, "}}\nfn save_begin(i: u32, y: Vector) {{");
        for c in 0..self.dim {
            let _ = writeln!(text, "    state[i + {}u * control.stride] = y.c{c};", first + c);
        }
        let _ = writeln!(text, "}}\nfn trace(at: u32, y: Vector, v: real) {{");
        for c in 0..self.dim {
            let _ = writeln!(text, "    traces[at + {c}u] = y.c{c};");
        }
        let _ = writeln!(text, "    traces[at + {}u] = v;\n}}", self.dim);
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
        for (name, status) in super::ON_LEGS {
            let _ = writeln!(text, "const {name}: u32 = {status}u;");
        }
        for (status, name) in crate::backend::Status::ALL {
            let _ = writeln!(text, "const {}: u32 = {}u;", name.to_uppercase(), status as i32);
        }
        let mut real = |name: &str, value: f64| {
            let _ = writeln!(text, "const {name}: real = {};", literal(value, self.spec.precision));
        };
        real("FIRST", self.tableau.first());
        real("AT_KINK", control::at_kink(self.spec.precision.epsilon()));
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
