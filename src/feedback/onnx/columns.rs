//! Any expressions, operation by operation on columns `[batch, 1]`.

use super::OnnxError;
use super::messages::DOUBLE;
use super::write::{Name, Writer};
use crate::expr::{Fun, Graph, Id, Node, Op};
use rustc_hash::FxHashMap;
use std::f64::consts::FRAC_PI_2;

/// The roots side by side, `[batch, roots]`. `symbols` are groups of symbols that are the columns
/// of a tensor.
pub(super) fn write(
    w: &mut Writer,
    graph: &Graph,
    symbols: &[(&[Id], &str)],
    roots: &[Id],
) -> Result<Name, OnnxError> {
    let mut names: FxHashMap<Id, Name> = FxHashMap::default();
    let place = |id: Id| {
        let groups = symbols.iter();
        groups
            .filter_map(move |(ids, of)| Some((ids.iter().position(|i| *i == id)?, ids.len(), *of)))
            .next()
    };
    for id in graph.reachable(roots) {
        let name = match graph.node(id) {
            Node::Symbol(_) => {
                let (i, width, of) = place(id).expect("a law depends on states and adjoints alone");
                w.columns(of, &[i], width)
            }
            Node::Const(bits) => w.row(&[f64::from_bits(bits)]),
            Node::Neg(a) => w.op("Neg", &[&names[&a]]),
            Node::Unary(f, a) => unary(w, f, &names[&a])?,
            Node::Powi(a, n) => {
                let n = w.row(&[f64::from(n)]);
                w.op("Pow", &[&names[&a], &n])
            }
            Node::Binary(op, a, b) => {
                let operator = match op {
                    Op::Add => "Add",
                    Op::Sub => "Sub",
                    Op::Mul => "Mul",
                    Op::Div => "Div",
                    Op::Pow => "Pow",
                    Op::Min => "Min",
                    Op::Max => "Max",
                };
                w.op(operator, &[&names[&a], &names[&b]])
            }
        };
        names.insert(id, name);
    }
    // A root that is a number has one row: it takes the batch's from the first symbols.
    let (first, of) = symbols[0];
    let column = w.columns(of, &[0], first.len());
    let zero = w.row(&[0.0]);
    let zeros = w.op("Mul", &[&column, &zero]);
    let columns: Vec<Name> = (roots.iter())
        .map(|root| match graph.as_constant(*root) {
            Some(_) => w.op("Add", &[&names[root], &zeros]),
            None => names[root].clone(),
        })
        .collect();
    let columns: Vec<&str> = columns.iter().map(String::as_str).collect();
    Ok(w.with("Concat", &columns, &[("axis", 1)]))
}

/// Only operators that onnxruntime has in double precision on the CPU.
fn unary(w: &mut Writer, f: Fun, a: &str) -> Result<Name, OnnxError> {
    let cosine = |w: &mut Writer| {
        let quarter = w.row(&[FRAC_PI_2]);
        let shifted = w.op("Add", &[a, &quarter]);
        w.op("Sin", &[&shifted])
    };
    let halves = |w: &mut Writer, operator: &str| {
        let negative = w.op("Neg", &[a]);
        let (up, down) = (w.op("Exp", &[a]), w.op("Exp", &[&negative]));
        let both = w.op(operator, &[&up, &down]);
        let half = w.row(&[0.5]);
        w.op("Mul", &[&both, &half])
    };
    Ok(match f {
        Fun::Sin => w.op("Sin", &[a]),
        Fun::Cos => cosine(w),
        Fun::Tan => {
            let (sine, cosine) = (w.op("Sin", &[a]), cosine(w));
            w.op("Div", &[&sine, &cosine])
        }
        Fun::Sinh => halves(w, "Sub"),
        Fun::Cosh => halves(w, "Add"),
        Fun::Tanh => w.op("Tanh", &[a]),
        Fun::Exp => w.op("Exp", &[a]),
        Fun::Log => w.op("Log", &[a]),
        Fun::Sqrt => w.op("Sqrt", &[a]),
        Fun::Abs => w.op("Abs", &[a]),
        Fun::Sign => w.op("Sign", &[a]),
        Fun::Step => {
            let zero = w.row(&[0.0]);
            let above = w.op("Greater", &[a, &zero]);
            w.with("Cast", &[&above], &[("to", i64::from(DOUBLE))])
        }
        Fun::Expm1 => {
            let (one, exp) = (w.row(&[1.0]), w.op("Exp", &[a]));
            w.op("Sub", &[&exp, &one])
        }
        Fun::Log1p => {
            let one = w.row(&[1.0]);
            let sum = w.op("Add", &[a, &one]);
            w.op("Log", &[&sum])
        }
        Fun::Asin | Fun::Acos | Fun::Atan => return Err(OnnxError::Function(f.name())),
    })
}
