//! C that all headers have: arrays, straight-line code of expressions, comments and numbers.

use crate::expr::{Fun, Graph, Id, Node, Op};
use nalgebra::DMatrix;
use rustc_hash::FxHashMap;
use std::fmt::Write;

/// Names that the code uses.
pub struct Syntax<'a> {
    pub name: &'a str,
    pub real: &'a str,
    /// Macro that gives a function of `math.h` in the type's precision.
    pub function: &'a str,
}

/// What stands before the code: the type of numbers, and the macro that gives functions of `math.h`
/// for it.
pub fn begin(name: &str, guard: &str) -> String {
    format!(
        "#ifndef {guard}\n#define {guard}\n\n#include <math.h>\n\n\
         #ifdef COSTATE_FLOAT\ntypedef float {name}_real;\n#define {guard}_FN(g) g##f\n\
         #else\ntypedef double {name}_real;\n#define {guard}_FN(g) g\n#endif\n\n"
    )
}

/// What stands after it.
pub fn end(guard: &str) -> String {
    format!("\n#undef {guard}_FN\n#endif /* {guard} */\n")
}

impl Syntax<'_> {
    pub fn vector(&self, of: &str, values: impl ExactSizeIterator<Item = f64>) -> String {
        let count = values.len();
        let values: Vec<String> = values.map(digits).collect();
        let Self { name, real, .. } = self;
        format!(
            "static const {real} {name}_{of}[{count}] = {{{}}};\n",
            values.join(",")
        )
    }

    pub fn matrix(&self, of: &str, matrix: &DMatrix<f64>) -> String {
        let row = |row: usize| {
            let values: Vec<String> = matrix.row(row).iter().map(|v| digits(*v)).collect();
            format!("{{{}}}", values.join(","))
        };
        let rows: Vec<String> = (0..matrix.nrows()).map(row).collect();
        let Self { name, real, .. } = self;
        let (r, c) = matrix.shape();
        format!(
            "static const {real} {name}_{of}[{r}][{c}] = {{\n{}}};\n",
            rows.join(",\n")
        )
    }

    /// Numbers in rows of `width` each.
    pub fn table(&self, of: &str, values: &[f64], width: usize) -> String {
        let row = |row: &[f64]| {
            let values: Vec<String> = row.iter().map(|v| real_text(*v)).collect();
            format!("{{{}}}", values.join(","))
        };
        let rows: Vec<String> = values.chunks(width).map(row).collect();
        let Self { name, real, .. } = self;
        format!(
            "static const {real} {name}_{of}[{}][{width}] = {{\n{}}};\n",
            rows.len(),
            rows.join(",\n")
        )
    }

    /// Numbers, some a line.
    pub fn list(&self, of: &str, values: &[f64]) -> String {
        let Self { name, real, .. } = self;
        let texts: Vec<String> = values.iter().map(|v| real_text(*v)).collect();
        format!(
            "static const {real} {name}_{of}[{}] = {{\n{}}};\n",
            values.len(),
            lines(&texts)
        )
    }

    pub fn number(&self, of: &str, value: f64) -> String {
        let Self { name, real, .. } = self;
        format!("static const {real} {name}_{of} = {};\n", real_text(value))
    }

    /// Whole numbers in the shortest type that holds them.
    pub fn integers(&self, of: &str, values: impl Iterator<Item = usize>) -> String {
        let values: Vec<usize> = values.collect();
        let most = values.iter().copied().max().unwrap_or(0);
        let kind = match most {
            0..=255 => "unsigned char",
            256..=65535 => "unsigned short",
            _ => "unsigned long",
        };
        let texts: Vec<String> = values.iter().map(usize::to_string).collect();
        format!(
            "static const {kind} {}_{of}[{}] = {{\n{}}};\n",
            self.name,
            values.len(),
            lines(&texts)
        )
    }

    /// Expressions of symbols that are elements of arrays, into `target`.
    pub fn straight(
        &self,
        graph: &Graph,
        symbols: &[(&[Id], &str)],
        roots: &[Id],
        target: &str,
    ) -> String {
        let mut names: FxHashMap<Id, String> = FxHashMap::default();
        for (symbols, array) in symbols {
            names.extend(
                symbols
                    .iter()
                    .enumerate()
                    .map(|(i, s)| (*s, format!("{array}[{i}]"))),
            );
        }
        let mut text = String::new();
        let mut count = 0;
        for id in graph.reachable(roots) {
            let Some(value) = self.formula(graph, id, &names) else {
                continue;
            };
            if graph.as_constant(id).is_some() {
                names.insert(id, value);
                continue;
            }
            let name = format!("v{count}");
            count += 1;
            writeln!(text, "    const {} {name} = {value};", self.real)
                .expect("a String takes any text");
            names.insert(id, name);
        }
        for (i, id) in roots.iter().enumerate() {
            writeln!(text, "    {target}[{i}] = {};", names[id]).expect("a String takes any text");
        }
        text
    }

    /// The formula of a node in the names of its arguments; none for a symbol, which has a name.
    fn formula(&self, graph: &Graph, id: Id, names: &FxHashMap<Id, String>) -> Option<String> {
        let name = |id: Id| names[&id].as_str();
        Some(match graph.node(id) {
            Node::Symbol(_) => return None,
            Node::Const(bits) => format!("({}){}", self.real, number(f64::from_bits(bits))),
            Node::Neg(a) => format!("-{}", name(a)),
            Node::Unary(f, a) => {
                let a = name(a);
                match f {
                    Fun::Abs => format!("{}(fabs)({a})", self.function),
                    Fun::Sign => format!("({})(({a} > 0) - ({a} < 0))", self.real),
                    Fun::Step => format!("({})({a} > 0)", self.real),
                    _ => format!("{}({})({a})", self.function, f.name()),
                }
            }
            Node::Powi(a, n) => match n {
                2 => format!("{0} * {0}", name(a)),
                -1 => format!("1 / {}", name(a)),
                _ => format!("{}(pow)({}, {n})", self.function, name(a)),
            },
            Node::Binary(op, a, b) => {
                let (a, b) = (name(a), name(b));
                match op {
                    Op::Add => format!("{a} + {b}"),
                    Op::Sub => format!("{a} - {b}"),
                    Op::Mul => format!("{a} * {b}"),
                    Op::Div => format!("{a} / {b}"),
                    Op::Pow => format!("{}(pow)({a}, {b})", self.function),
                    Op::Min => format!("({a} < {b} || {a} != {a} ? {a} : {b})"),
                    Op::Max => format!("({a} > {b} || {a} != {a} ? {a} : {b})"),
                }
            }
        })
    }
}

/// A list over several lines.
fn lines(values: &[String]) -> String {
    const LINE: usize = 16;
    let rows: Vec<String> = values.chunks(LINE).map(|row| row.join(",")).collect();
    rows.join(",\n")
}

/// Of a text, the same in every version of the program (FNV-1a).
pub fn fingerprint(text: &str) -> u64 {
    (text.bytes()).fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    })
}

/// Text inside a comment, which it must not end or begin again.
pub fn comment(text: &str) -> String {
    let printable = |c: char| if c.is_control() { ' ' } else { c };
    let text = text
        .replace("*/", "* /")
        .replace("/*", "/ *")
        .replace("??", "? ? ");
    text.chars().map(printable).collect()
}

/// A number that a C compiler reads as the same one.
pub fn number(value: f64) -> String {
    if value < 0.0 {
        format!("({value:?})")
    } else {
        format!("{value:?}")
    }
}

/// A weight to 15 digits: the sums of a network lose the others.
fn digits(value: f64) -> String {
    let rounded: f64 = format!("{value:.14e}").parse().unwrap_or(value);
    format!("{rounded:?}")
}

/// The same in a table; infinity too.
pub fn real_text(value: f64) -> String {
    if value.is_finite() {
        return format!("{value:?}");
    }
    if value > 0.0 { "HUGE_VAL" } else { "-HUGE_VAL" }.to_owned()
}
