//! How expressions depend on chosen symbols, without taking them apart.

use super::{Graph, Id, Node, Op};
use rustc_hash::FxHashMap;

impl Graph {
    /// The degree of each expression as a polynomial in `symbols`, as far as it can be seen node by
    /// node: an upper bound, which terms that cancel do not lower; `None` where a symbol stands
    /// inside a function, a divisor or an exponent.
    pub fn degrees(&self, exprs: &[Id], symbols: &[Id]) -> Vec<Option<u32>> {
        let mut known: FxHashMap<Id, Option<u32>> = FxHashMap::default();
        for id in self.reachable(exprs) {
            let of = |a: Id| known[&a];
            let free = |a: Id| (of(a) == Some(0)).then_some(0);
            let degree = match self.node(id) {
                Node::Symbol(_) if symbols.contains(&id) => Some(1),
                Node::Const(_) | Node::Symbol(_) => Some(0),
                Node::Neg(a) => of(a),
                Node::Powi(a, n) if n > 0 => of(a).and_then(|d| d.checked_mul(n.unsigned_abs())),
                Node::Unary(_, a) | Node::Powi(a, _) => free(a),
                Node::Binary(op, a, b) => match op {
                    Op::Add | Op::Sub => of(a).zip(of(b)).map(|(a, b)| a.max(b)),
                    Op::Mul => (of(a).zip(of(b))).and_then(|(a, b)| a.checked_add(b)),
                    Op::Div => free(b).and(of(a)),
                    Op::Pow | Op::Min | Op::Max => free(a).and(free(b)),
                },
            };
            known.insert(id, degree);
        }
        exprs.iter().map(|e| known[e]).collect()
    }
}
