//! Loads from buffers and stores to them; what a leg under a chart's law adds.

use super::{Emitter, Law, SCALARS, Settings, kinks, state, stored};
use std::fmt::Write;

/// The place of a counter of trajectory i.
fn counter(k: usize) -> String {
    format!("counters[i + {k}u * control.stride]")
}

impl Emitter<'_> {
    /// Loads and stores.
    pub(super) fn buffers(&self, text: &mut String) {
        self.load_run(text);
        let seed = self.state_vector(0);
        let _ = writeln!(
            text,
            "fn load_seed(i: u32) -> Vector {{\n    return {seed};\n}}"
        );
        self.load(text);
        self.save(text);
        if self.spec.store {
            self.store_vector(text);
        }
    }

    /// The settings of a run.
    fn load_run(&self, text: &mut String) {
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
    }

    /// A vector in the state of trajectory i, from this component on.
    fn state_vector(&self, first: usize) -> String {
        let components: Vec<String> = (0..self.dim)
            .map(|c| format!("state[i + {}u * control.stride]", first + c))
            .collect();
        format!("Vector({})", components.join(", "))
    }

    /// The place of a number in the state of trajectory i, behind its vectors.
    fn scalar(&self, k: usize) -> String {
        format!("state[i + {}u * control.stride]", 2 * self.dim + k)
    }

    /// A trajectory taken up again.
    fn load(&self, text: &mut String) {
        let (y, k) = (self.state_vector(0), self.state_vector(self.dim));
        let kinks = kinks(self.spec);
        // What a step remembers of its kinks, behind the other fields.
        let mut remembered = String::new();
        if kinks > 0 {
            let sides: Vec<String> = (0..kinks).map(|g| self.scalar(SCALARS + 1 + g)).collect();
            let _ = write!(
                remembered,
                ", {}, Sides({})",
                self.scalar(SCALARS),
                sides.join(", ")
            );
        }
        if self.legs.is_some() {
            let _ = write!(remembered, ", {}, {}", counter(4), counter(5));
        }
        let _ = write!(
            text,
            "fn load(i: u32) -> Lane {{\n    let next_level = {};\n    return Lane({y}, {k}, {}, {}, f32({}), {}, {}, \
             next_level, {}, {}, level(next_level), 0u{remembered});\n}}\n",
            counter(1),
            self.scalar(0),
            self.scalar(1),
            self.scalar(2),
            self.scalar(3),
            counter(0),
            counter(2),
            counter(3),
        );
    }

    /// A trajectory laid by: the end of one that has ended, all of one that goes on.
    fn save(&self, text: &mut String) {
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
            let _ = writeln!(
                text,
                "        ends[i + {c}u * control.stride] = lane.y.c{c};"
            );
        }
        let _ = writeln!(
            text,
            "        ends[i + {}u * control.stride] = lane.t;\n        return;\n    }}",
            self.dim
        );
        for c in 0..self.dim {
            let _ = writeln!(text, "    state[i + {c}u * control.stride] = lane.y.c{c};");
            let _ = writeln!(
                text,
                "    state[i + {}u * control.stride] = lane.k.c{c};",
                self.dim + c
            );
        }
        for (k, field) in ["lane.t", "lane.h", "real(lane.before)", "lane.first_step"]
            .iter()
            .enumerate()
        {
            let _ = writeln!(text, "    {} = {field};", self.scalar(k));
        }
        let kinks = kinks(self.spec);
        if kinks > 0 {
            let _ = writeln!(text, "    {} = lane.resume;", self.scalar(SCALARS));
        }
        for g in 0..kinks {
            let side = self.scalar(SCALARS + 1 + g);
            let _ = writeln!(text, "    {side} = lane.sides.c{g};");
        }
        text.push_str("}\n");
    }

    /// The components that are kept of a sample.
    fn store_vector(&self, text: &mut String) {
        let _ = writeln!(text, "fn store_vector(at: u32, y: Vector) {{");
        for (k, c) in stored(self.spec).enumerate() {
            let _ = writeln!(text, "    samples[at + {k}u] = y.c{c};");
        }
        text.push_str("}\n");
    }

    /// A chart's place of a vector, its law, and where legs begin; see `shaders/legs.wgsl`.
    pub(super) fn law(&self, Law { states: n, last }: Law, text: &mut String) {
        let mut place: Vec<String> = (0..n).map(|i| format!("y.c{i}")).collect();
        if let Some(last) = last {
            // Over a period p of V(x, t) changes with time too: that of its middle errs only to the
            // second order of the period.
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
            let terms: Vec<String> = (0..n)
                .map(|j| format!("said.h[{}] * s.c{j}", pair(i, j)))
                .collect();
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
            let _ = writeln!(
                text,
                "    state[i + {}u * control.stride] = y.c{c};",
                first + c
            );
        }
        let _ = writeln!(text, "}}\nfn trace(at: u32, y: Vector, v: real) {{");
        for c in 0..self.dim {
            let _ = writeln!(text, "    traces[at + {c}u] = y.c{c};");
        }
        let _ = writeln!(text, "    traces[at + {}u] = v;\n}}", self.dim);
    }
}
