//! A law as a C header that needs nothing but `math.h`: straight-line code of the law's expressions.

use super::law::ClosedForm;
use crate::expr::{Fun, Graph, Id, Node, Op};
use crate::model::Model;
use std::collections::HashMap;
use std::fmt::Write;

/// The header's text. It defines `NAME_u(x, u)`, and of a value function also `NAME_V(x, V, p)`; bounds on controls are
/// applied. `name` is an identifier.
pub fn header(name: &str, form: &ClosedForm, model: &Model) -> String {
    let guard = format!("COSTATE_{}_H", name.to_uppercase());
    let states: Vec<&str> = model.states.iter().map(|s| s.variable.name.as_str()).collect();
    let outputs: Vec<&str> = form.outputs.iter().map(String::as_str).collect();
    let (n, m) = (states.len(), outputs.len());
    let mut text = format!(
        "/* Feedback law `{name}` of the scene: {}\n   written by costate {}.\n   x: {}\n   u: {}{} */\n\
         #ifndef {guard}\n#define {guard}\n\n#include <math.h>\n",
        comment(&model.title),
        env!("CARGO_PKG_VERSION"),
        states.join(", "),
        outputs.join(", "),
        if form.value.is_some() {
            "\n   V: the value function, p: its gradient by x"
        } else {
            ""
        },
    );
    let commands: Vec<(String, Id)> = (form.commands.iter().enumerate())
        .map(|(i, id)| (format!("u[{i}]"), *id))
        .collect();
    text += &format!("\nstatic inline void {name}_u(const double x[{n}], double u[{m}])\n");
    text += &body(&form.graph, &form.x, &commands);
    if let Some((value, slopes)) = &form.value {
        let mut targets = vec![("*V".to_owned(), *value)];
        targets.extend(slopes.iter().enumerate().map(|(i, id)| (format!("p[{i}]"), *id)));
        text += &format!("\nstatic inline void {name}_V(const double x[{n}], double *V, double p[{n}])\n");
        text += &body(&form.graph, &form.x, &targets);
    }
    text + &format!("\n#endif /* {guard} */\n")
}

/// Text inside a comment, which it must not end.
fn comment(text: &str) -> String {
    let printable = |c: char| if c.is_control() { ' ' } else { c };
    text.replace("*/", "* /").chars().map(printable).collect()
}

fn body(graph: &Graph, x: &[Id], targets: &[(String, Id)]) -> String {
    let roots: Vec<Id> = targets.iter().map(|(_, id)| *id).collect();
    let mut names: HashMap<Id, String> = HashMap::new();
    let mut text = String::from("{\n");
    for (i, symbol) in x.iter().enumerate() {
        names.insert(*symbol, format!("x[{i}]"));
    }
    let mut count = 0;
    for id in graph.reachable(&roots) {
        let Some(value) = formula(graph, id, &names) else {
            continue;
        };
        if graph.as_constant(id).is_some() {
            names.insert(id, value);
            continue;
        }
        let name = format!("v{count}");
        count += 1;
        writeln!(text, "    const double {name} = {value};").expect("a String takes any text");
        names.insert(id, name);
    }
    if !x.iter().any(|s| graph.depends_on(&roots, *s)) {
        text += "    (void)x;\n";
    }
    for (target, id) in targets {
        writeln!(text, "    {target} = {};", names[id]).expect("a String takes any text");
    }
    text + "}\n"
}

/// The formula of a node in the names of its arguments; none for a symbol, which has a name.
fn formula(graph: &Graph, id: Id, names: &HashMap<Id, String>) -> Option<String> {
    let name = |id: Id| names[&id].as_str();
    Some(match graph.node(id) {
        Node::Symbol(_) => return None,
        Node::Const(bits) => number(f64::from_bits(bits)),
        Node::Neg(a) => format!("-{}", name(a)),
        Node::Unary(f, a) => {
            let a = name(a);
            match f {
                Fun::Abs => format!("fabs({a})"),
                Fun::Sign => format!("(double)(({a} > 0.0) - ({a} < 0.0))"),
                Fun::Step => format!("{a} > 0.0 ? 1.0 : 0.0"),
                _ => format!("{}({a})", f.name()),
            }
        }
        Node::Powi(a, n) => match n {
            2 => format!("{0} * {0}", name(a)),
            -1 => format!("1.0 / {}", name(a)),
            _ => format!("pow({}, {n}.0)", name(a)),
        },
        Node::Binary(op, a, b) => {
            let (a, b) = (name(a), name(b));
            match op {
                Op::Add => format!("{a} + {b}"),
                Op::Sub => format!("{a} - {b}"),
                Op::Mul => format!("{a} * {b}"),
                Op::Div => format!("{a} / {b}"),
                Op::Pow => format!("pow({a}, {b})"),
                Op::Min => format!("({a} < {b} || {a} != {a} ? {a} : {b})"),
                Op::Max => format!("({a} > {b} || {a} != {a} ? {a} : {b})"),
            }
        }
    })
}

/// A number that a C compiler reads as the same one.
fn number(value: f64) -> String {
    if value < 0.0 {
        format!("({value:?})")
    } else {
        format!("{value:?}")
    }
}
