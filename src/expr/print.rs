//! Printing expressions as a person would write them, in the scenario file's own syntax.

use super::{Graph, Id, Node, Op};

// Binding strengths: sum < product < unary minus < power < atom.
const SUM: u8 = 1;
const PRODUCT: u8 = 2;
const UNARY: u8 = 3;
const POWER: u8 = 4;
const ATOM: u8 = 5;

impl Graph {
    /// The expression as text that parses back to an equal value.
    pub fn show(&self, id: Id) -> String {
        self.show_at(id).0
    }

    fn wrapped(&self, id: Id, least: u8) -> String {
        let (text, strength) = self.show_at(id);
        if strength < least { format!("({text})") } else { text }
    }

    fn show_at(&self, id: Id) -> (String, u8) {
        match self.node(id) {
            Node::Const(bits) => {
                let v = f64::from_bits(bits);
                let text = if v != 0.0 && (v.abs() < 1e-4 || v.abs() >= 1e16) { format!("{v:e}") } else { format!("{v}") };
                (text, if v < 0.0 { UNARY } else { ATOM })
            }
            Node::Symbol(i) => (self.symbols()[i as usize].name.clone(), ATOM),
            Node::Neg(a) => (format!("-{}", self.wrapped(a, PRODUCT)), UNARY),
            Node::Unary(f, a) => (format!("{}({})", f.name(), self.show(a)), ATOM),
            Node::Powi(a, n) => (format!("{}^{n}", self.wrapped(a, ATOM)), POWER),
            Node::Binary(op, a, b) => self.show_binary(op, a, b),
        }
    }

    fn show_binary(&self, op: Op, a: Id, b: Id) -> (String, u8) {
        match op {
            Op::Add => {
                // A leading minus reads better in second place.
                let (first, second) = match self.as_constant(a) {
                    Some(_) => (b, a),
                    None => (a, b),
                };
                let ((left, strength), right) = (self.show_at(first), self.wrapped(second, SUM));
                if let Some(rest) = right.strip_prefix('-') {
                    (format!("{left} - {rest}"), SUM)
                } else if let Some(rest) = left.strip_prefix('-').filter(|_| strength > SUM) {
                    (format!("{right} - {rest}"), SUM)
                } else {
                    (format!("{left} + {right}"), SUM)
                }
            }
            Op::Sub => {
                let right = self.wrapped(b, PRODUCT);
                match right.strip_prefix('-') {
                    Some(rest) => (format!("{} + {rest}", self.wrapped(a, SUM)), SUM),
                    None => (format!("{} - {right}", self.wrapped(a, SUM)), SUM),
                }
            }
            Op::Mul => {
                let left = match self.as_constant(a) {
                    Some(_) => self.show(a),
                    None => self.wrapped(a, PRODUCT),
                };
                let right = match self.node(b) {
                    Node::Binary(Op::Div, ..) => self.wrapped(b, UNARY),
                    _ => self.wrapped(b, PRODUCT),
                };
                (format!("{left}*{right}"), PRODUCT)
            }
            Op::Div => (format!("{}/{}", self.wrapped(a, PRODUCT), self.wrapped(b, UNARY)), PRODUCT),
            Op::Pow => (format!("{}^{}", self.wrapped(a, ATOM), self.wrapped(b, ATOM)), POWER),
            Op::Min => (format!("min({}, {})", self.show(a), self.show(b)), ATOM),
            Op::Max => (format!("max({}, {})", self.show(a), self.show(b)), ATOM),
        }
    }
}
