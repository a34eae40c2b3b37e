//! WGSL text that depends on the scene or the method: constants, the model's right-hand side and
//! guards, and in rooms of their own the stages of a step and loads and stores, all straight-line
//! code over named components (arrays would be indexed in memory).

mod buffers;
mod step;
mod taylor;

use super::text::{condition, constants, function, literal, structure};
use crate::backend::{By, Guards, Spec, Variant};
use crate::integrator::{Scheme, Tableau, control};
use crate::model::Precision;
use std::fmt::Write;

/// Fields t, h, before and first_step of the state.
const SCALARS: usize = 4;

/// Where in a chart's law its parts are: the vector is `(s, q, H, ...)`, H's upper triangle row by
/// row.
#[derive(Clone, Copy, Debug)]
pub struct Law {
    /// Components of s.
    pub states: usize,
    /// The last time at which the chart is asked, where time is an argument of it.
    pub last: Option<f64>,
}

/// Reals of a trajectory's state: y and k, the scalars, and with kinks the step size to resume and
/// their values.
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

/// Kinks of which a Runge-Kutta step is made to end at the first; a fixed step has no choice, and a
/// Taylor step looks for them in its own polynomials.
pub fn kinks(spec: &Spec) -> usize {
    let adaptive = spec.method.tableau().is_some_and(Tableau::adaptive);
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
    scheme: Scheme,
    dim: usize,
    inputs: usize,
    legs: Option<Law>,
}

impl<'a> Emitter<'a> {
    pub fn new(spec: &'a Spec, scheme: Scheme, variant: Variant) -> Self {
        Self {
            spec,
            variant,
            scheme,
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
        list.push(match self.scheme.adaptive() {
            true => "ADAPTIVE",
            false => "FIXED",
        });
        list.push(match self.scheme {
            Scheme::RungeKutta(_) => "RUNGE_KUTTA",
            Scheme::Taylor(_) => "TAYLOR",
        });
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

    /// The method: a step, its error, its dense output.
    pub fn method(&self) -> String {
        let mut text = String::new();
        match self.scheme {
            Scheme::RungeKutta(tableau) => self.runge_kutta(tableau, &mut text),
            Scheme::Taylor(order) => self.taylor(order, &mut text),
        }
        self.interpolate(&mut text);
        if let By::Component(c) = self.spec.by {
            self.along(c, &mut text);
        }
        self.vectors(&mut text);
        self.buffers(&mut text);
        if let Some(law) = self.legs {
            self.law(law, &mut text);
        }
        text
    }

    /// Names that the hand-written fragments use in place of components and stages.
    pub fn names(&self) -> Vec<(&'static str, String)> {
        let mut list = Vec::new();
        if let Scheme::RungeKutta(tableau) = self.scheme {
            list.push(("LAST_STAGE", format!("k{}", tableau.stages() - 1)));
        }
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
        let _ = writeln!(
            text,
            "const SAMPLE: u32 = {}u;",
            1 + stored(self.spec).count()
        );
        let _ = writeln!(text, "const RUNNING: u32 = {}u;", super::RUNNING);
        let _ = writeln!(text, "const EVENT: u32 = {}u;", super::EVENT);
        for (name, status) in super::ON_LEGS {
            let _ = writeln!(text, "const {name}: u32 = {status}u;");
        }
        for (status, name) in crate::backend::Status::ALL {
            let _ = writeln!(
                text,
                "const {}: u32 = {}u;",
                name.to_uppercase(),
                status as i32
            );
        }
        let mut real = |name: &str, value: f64| {
            let _ = writeln!(
                text,
                "const {name}: real = {};",
                literal(value, self.spec.precision)
            );
        };
        real(
            "FIRST",
            match self.scheme {
                Scheme::RungeKutta(tableau) => tableau.first(),
                Scheme::Taylor(_) => control::SHARE,
            },
        );
        real("AT_KINK", control::at_kink(self.spec.precision.epsilon()));
        real("FLOOR", control::FLOOR_ULPS * self.spec.precision.epsilon());
        let mut single = |name: &str, value: f64| {
            let _ = writeln!(
                text,
                "const {name}: f32 = {};",
                literal(value, Precision::F32)
            );
        };
        single("SAFETY", control::SAFETY);
        match self.scheme {
            Scheme::RungeKutta(tableau) => {
                single("HALF_ALPHA", 0.5 * control::ALPHA * tableau.exponent());
                single("HALF_BETA", 0.5 * control::BETA * tableau.exponent());
                single("HALF_REFUSED", 0.5 * tableau.exponent());
            }
            Scheme::Taylor(order) => {
                single("TO_LAST_BUT_ONE", 1.0 / (order as f64 - 1.0));
                single("TO_LAST", 1.0 / order as f64);
                single("TAYLOR_SAFETY", control::taylor_safety(order));
                single("BEGIN", 1.0 / control::SHARE);
                single("LEAST_LOG2", -100.0);
            }
        }
        single("SHRINK", control::SHRINK);
        single("GROW", control::GROW);
        single(
            "LEAST_SQUARED_ERROR",
            control::LEAST_ERROR * control::LEAST_ERROR,
        );
        text
    }
}
