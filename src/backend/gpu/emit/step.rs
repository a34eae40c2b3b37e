//! A step of the method: its stages, its error, its dense output, and functions of whole vectors.

use super::Emitter;
use crate::backend::By;
use crate::integrator::{Tableau, control};
use std::fmt::Write;

/// Operations of a right-hand side up to which each stage has a copy of it.
const MOST_REPEATED: usize = 2000;

impl Emitter<'_> {
    /// A Runge-Kutta step and its dense output.
    pub(super) fn runge_kutta(&self, tableau: &Tableau, text: &mut String) {
        self.step_structure(tableau, text);
        self.attempt(tableau, text);
        self.densify(tableau, text);
    }

    fn step_structure(&self, tableau: &Tableau, text: &mut String) {
        let stages: String = (1..tableau.stages())
            .map(|s| format!(" k{s}: Vector,"))
            .collect();
        let _ = writeln!(
            text,
            "// New point, derivatives at the stages, squared error."
        );
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

    fn attempt(&self, tableau: &Tableau, text: &mut String) {
        let stages = tableau.stages();
        let _ = writeln!(
            text,
            "fn attempt(lane: Lane, run: Run) -> Step {{\n    let y = lane.y;\n    let k0 = lane.k;\n    let h = lane.h;"
        );
        if self.spec.rate.operations() > MOST_REPEATED {
            self.looped(tableau, text);
        }
        for s in 1..stages {
            if self.spec.rate.operations() > MOST_REPEATED {
                break;
            }
            let last = s + 1 == stages;
            // Components that no derivative depends on are needed only at the end of the step.
            let components = if last { self.dim } else { self.inputs };
            for c in 0..components {
                let sum = self.combination(tableau.a[s - 1], c);
                let _ = writeln!(text, "    let y{s}_{c} = y.c{c} + h * ({sum});");
            }
            let arguments: Vec<String> = (0..self.inputs).map(|c| format!("y{s}_{c}")).collect();
            let _ = writeln!(
                text,
                "    let k{s} = rate(Inputs({}));",
                arguments.join(", ")
            );
        }
        let last = stages - 1;
        let new: Vec<String> = (0..self.dim).map(|c| format!("y{last}_{c}")).collect();
        let all: Vec<String> = (1..stages).map(|s| format!("k{s}")).collect();
        if tableau.adaptive() {
            for c in 0..self.dim {
                let sum = self.combination(tableau.error, c);
                let _ = writeln!(
                    text,
                    "    let e{c} = ({sum}) * h / (run.atol.c{c} + run.rtol * max(abs(y.c{c}), abs(y{last}_{c})));"
                );
            }
            let squares: Vec<String> = (0..self.dim).map(|c| format!("e{c} * e{c}")).collect();
            let share = self.number(1.0 / self.dim as f64);
            let _ = writeln!(
                text,
                "    let square = ({}) * {share};",
                squares.join(" + ")
            );
            self.companion(tableau, text, last, &share);
        } else {
            // Only whether it is finite matters.
            let terms: Vec<String> = (0..self.dim)
                .map(|c| format!("y{last}_{c} + k{last}.c{c}"))
                .collect();
            let _ = writeln!(text, "    let error = {};", terms.join(" + "));
        }
        let _ = writeln!(
            text,
            "    return Step(Vector({}), {}, error);\n}}",
            new.join(", "),
            all.join(", ")
        );
    }

    /// The stages as a loop, with one copy of the right-hand side: compilers repeat it at each place
    /// where it stands, and of long ones take minutes.
    fn looped(&self, tableau: &Tableau, text: &mut String) {
        let stages = tableau.stages();
        let last = stages - 1;
        let width = last;
        let weights: Vec<String> = (tableau.a.iter().take(last))
            .flat_map(|row| {
                let row = row
                    .iter()
                    .copied()
                    .chain(std::iter::repeat(0.0))
                    .take(width);
                row.map(|w| self.number(w)).collect::<Vec<_>>()
            })
            .collect();
        let zeros = vec![self.number(0.0); self.dim].join(", ");
        let each = |line: &dyn Fn(usize) -> String| -> String { (0..self.dim).map(line).collect() };
        let arguments: Vec<String> = (0..self.inputs).map(|c| format!("z.c{c}")).collect();
        let _ = writeln!(
            text,
            "    var weights = array<real, {}>({});\n    var k: array<Vector, {stages}>;\n    k[0] = k0;\n    var z = y;\n    \
             for (var s = 1u; s < {stages}u; s++) {{\n        var sum = Vector({zeros});\n        \
             for (var j = 0u; j < s; j++) {{\n            let w = weights[(s - 1u) * {width}u + j];\n{}        }}\n{}        \
             k[s] = rate(Inputs({}));\n    }}",
            weights.len(),
            weights.join(", "),
            each(&|c| format!("            sum.c{c} += k[j].c{c} * w;\n")),
            each(&|c| format!("        z.c{c} = y.c{c} + h * sum.c{c};\n")),
            arguments.join(", ")
        );
        for s in 1..stages {
            let _ = writeln!(text, "    let k{s} = k[{s}];");
        }
        for c in 0..self.dim {
            let _ = writeln!(text, "    let y{last}_{c} = z.c{c};");
        }
    }

    /// The squared error, from the estimate's mean square and that of the companion where there is
    /// one.
    fn companion(&self, tableau: &Tableau, text: &mut String, last: usize, share: &str) {
        if tableau.companion.is_empty() {
            let _ = writeln!(text, "    let error = square;");
            return;
        }
        for c in 0..self.dim {
            let sum = self.combination(tableau.companion, c);
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

    /// The polynomials' coefficients, from the derivatives at the stages and at those that only the
    /// dense output needs.
    fn densify(&self, tableau: &Tableau, text: &mut String) {
        let degree = tableau.degree();
        let names = |f: &dyn Fn(usize) -> String| (0..degree).map(f).collect::<Vec<_>>();
        self.dense_structure(text);
        let _ = writeln!(
            text,
            "fn densify(y: Vector, k0: Vector, step: Step, h: real) -> Dense {{"
        );
        self.stage_names(tableau, text);
        for (e, a) in tableau.extra.iter().enumerate() {
            let s = tableau.stages() + e;
            for c in 0..self.inputs {
                let sum = self.combination(a, c);
                let _ = writeln!(text, "    let y{s}_{c} = y.c{c} + h * ({sum});");
            }
            let arguments: Vec<String> = (0..self.inputs).map(|c| format!("y{s}_{c}")).collect();
            let _ = writeln!(
                text,
                "    let k{s} = rate(Inputs({}));",
                arguments.join(", ")
            );
        }
        let of: Vec<Vec<String>> = (0..self.dim)
            .map(|c| self.powers(tableau, c, text))
            .collect();
        let vectors = names(&|m| {
            let components: Vec<&str> = of.iter().map(|powers| powers[m].as_str()).collect();
            format!("Vector({})", components.join(", "))
        });
        let _ = writeln!(text, "    return Dense({});\n}}", vectors.join(", "));
    }

    /// Coefficients of the powers of a component's polynomial, as expressions in the parts that are
    /// written first.
    fn powers(&self, tableau: &Tableau, c: usize, text: &mut String) -> Vec<String> {
        let degree = tableau.degree();
        let parts: Vec<String> = (0..degree)
            .map(|i| {
                let weights: Vec<f64> = tableau.dense.iter().map(|d| d[i]).collect();
                let _ = writeln!(
                    text,
                    "    let f{i}_{c}: real = {};",
                    self.combination(&weights, c)
                );
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
                self.number(0.0)
            } else {
                terms.join(" + ")
            }
        };
        (0..degree).map(power).collect()
    }

    /// A component's polynomial by Horner's rule.
    fn horner(&self, c: usize) -> String {
        let highest = self.scheme.degree() - 1;
        (0..highest)
            .rev()
            .fold(format!("d.d{highest}.c{c}"), |acc, m| {
                format!("d.d{m}.c{c} + q * ({acc})")
            })
    }

    /// Polynomials in the fraction of the step, made once for all points wanted in it.
    pub(super) fn dense_structure(&self, text: &mut String) {
        let names: Vec<String> = (0..self.scheme.degree())
            .map(|m| format!("d{m}: Vector"))
            .collect();
        let _ = writeln!(
            text,
            "// y + h q (d0 + q (d1 + ...))\nstruct Dense {{ {}, }}",
            names.join(", ")
        );
    }

    /// The vector at a fraction of the step.
    pub(super) fn interpolate(&self, text: &mut String) {
        let _ = writeln!(
            text,
            "fn interpolate(y: Vector, d: Dense, step: Step, h: real, q: real) -> Vector {{\n    if (q == 1.0) {{\n        \
             return step.y;\n    }}\n    let s = q * h;"
        );
        let components: Vec<String> = (0..self.dim)
            .map(|c| format!("y.c{c} + s * ({})", self.horner(c)))
            .collect();
        let _ = writeln!(text, "    return Vector({});\n}}", components.join(", "));
    }

    /// The way of the sampling coordinate, which is this component.
    pub(super) fn along(&self, c: usize, text: &mut String) {
        let degree = self.scheme.degree();
        let slope = (0..degree - 1).rev().fold(
            format!("{} * d.d{}.c{c}", self.number(degree as f64), degree - 1),
            |acc, m| {
                format!(
                    "{} * d.d{m}.c{c} + q * ({acc})",
                    self.number((m + 1) as f64)
                )
            },
        );
        let _ = writeln!(
            text,
            "// The coordinate's way since the begin of the step and its slope, per unit of h.\n\
             struct Along {{ way: real, slope: real, }}\n\
             fn along(d: Dense, q: real) -> Along {{\n    return Along(q * ({}), {slope});\n}}",
            self.horner(c)
        );
    }

    fn stage_names(&self, tableau: &Tableau, text: &mut String) {
        for s in 1..tableau.stages() {
            let _ = writeln!(text, "    let k{s} = step.k{s};");
        }
    }

    /// Functions of whole vectors.
    pub(super) fn vectors(&self, text: &mut String) {
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
        let _ = writeln!(
            text,
            "fn total(y: Vector) -> real {{\n    return {sum};\n}}"
        );
        if self.scheme.adaptive() {
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
            let squares = list(
                self.dim,
                &|c| format!("(n{c} / unit) * (n{c} / unit)"),
                " + ",
            );
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
}
