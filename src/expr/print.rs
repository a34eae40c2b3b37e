//! Printing expressions as a person would write them, in the scenario file's own syntax.

use super::{Graph, Id, Node, Op};

// Binding strengths: sum < product < unary minus < power < atom.
const SUM: u8 = 1;
const PRODUCT: u8 = 2;
const UNARY: u8 = 3;
const POWER: u8 = 4;
const ATOM: u8 = 5;

/// Text and binding strength of a printed expression.
type Shown = (String, u8);

fn wrapped((text, strength): Shown, least: u8) -> String {
    if strength < least {
        format!("({text})")
    } else {
        text
    }
}

/// `left` continued, in place: sums of many thousand terms are printed in linear time.
fn joined(mut left: String, sign: &str, right: &str) -> String {
    left.push_str(sign);
    left.push_str(right);
    left
}

impl Graph {
    /// The expression as text that parses back to an equal value.
    pub fn show(&self, id: Id) -> String {
        // A stack of its own: sums may be deeper than the thread's stack allows.
        let mut pending = vec![(id, false)];
        let mut done: Vec<Shown> = Vec::new();
        while let Some((id, arguments_done)) = pending.pop() {
            let arguments: Vec<Id> = self.arguments(id).collect();
            if arguments_done {
                let shown = done.split_off(done.len() - arguments.len());
                done.push(self.show_node(id, shown));
            } else {
                pending.push((id, true));
                pending.extend(arguments.iter().rev().map(|a| (*a, false)));
            }
        }
        done.pop().unwrap_or_default().0
    }

    /// One node, given its printed arguments.
    fn show_node(&self, id: Id, arguments: Vec<Shown>) -> Shown {
        let mut arguments = arguments.into_iter();
        let mut next = || arguments.next().unwrap_or_default();
        match self.node(id) {
            Node::Const(bits) => {
                let v = f64::from_bits(bits);
                let text = if v != 0.0 && (v.abs() < 1e-4 || v.abs() >= 1e16) {
                    format!("{v:e}")
                } else {
                    format!("{v}")
                };
                (text, if v < 0.0 { UNARY } else { ATOM })
            }
            Node::Symbol(i) => (self.symbols()[i as usize].name.clone(), ATOM),
            Node::Neg(_) => (format!("-{}", wrapped(next(), PRODUCT)), UNARY),
            Node::Unary(f, _) => (format!("{}({})", f.name(), next().0), ATOM),
            Node::Powi(_, n) => (format!("{}^{n}", wrapped(next(), ATOM)), POWER),
            Node::Binary(op, a, b) => self.show_binary(op, (a, next()), (b, next())),
        }
    }

    fn show_binary(&self, op: Op, (a, left): (Id, Shown), (b, right): (Id, Shown)) -> Shown {
        match op {
            Op::Add => {
                // A leading minus reads better in second place.
                let (first, second) = match self.as_constant(a) {
                    Some(_) => (right, left),
                    None => (left, right),
                };
                let ((left, strength), right) = (first, wrapped(second, SUM));
                if let Some(rest) = right.strip_prefix('-') {
                    (joined(left, " - ", rest), SUM)
                } else if let Some(rest) = left.strip_prefix('-').filter(|_| strength > SUM) {
                    (joined(right, " - ", rest), SUM)
                } else {
                    (joined(left, " + ", &right), SUM)
                }
            }
            Op::Sub => {
                let (left, right) = (wrapped(left, SUM), wrapped(right, PRODUCT));
                match right.strip_prefix('-') {
                    Some(rest) => (joined(left, " + ", rest), SUM),
                    None => (joined(left, " - ", &right), SUM),
                }
            }
            Op::Mul => {
                let left = match self.as_constant(a) {
                    Some(_) => left.0,
                    None => wrapped(left, PRODUCT),
                };
                let right = match self.node(b) {
                    Node::Binary(Op::Div, ..) => wrapped(right, UNARY),
                    _ => wrapped(right, PRODUCT),
                };
                (joined(left, "*", &right), PRODUCT)
            }
            Op::Div => (
                format!("{}/{}", wrapped(left, PRODUCT), wrapped(right, UNARY)),
                PRODUCT,
            ),
            Op::Pow => (
                format!("{}^{}", wrapped(left, ATOM), wrapped(right, ATOM)),
                POWER,
            ),
            Op::Min => (format!("min({}, {})", left.0, right.0), ATOM),
            Op::Max => (format!("max({}, {})", left.0, right.0), ATOM),
        }
    }
}
