//! Evaluation in f64 and over any number-like type.

use super::{Fun, Graph, Id, Node, Op};
use rustc_hash::FxHashMap;

/// Numbers for symbols.
pub type Values = FxHashMap<Id, f64>;

impl Graph {
    /// Values of `roots` with the symbols given by `values` (symbol node -> value).
    ///
    /// # Panics
    /// When a symbol that a root depends on has no value.
    pub fn eval(&self, roots: &[Id], values: &Values) -> Vec<f64> {
        self.fold(
            roots,
            &mut |id| {
                values
                    .get(&id)
                    .copied()
                    .unwrap_or_else(|| panic!("no value for symbol {}", self.show(id)))
            },
            &mut |c| c,
            &mut |f, x| f.apply(*x),
            &mut |op, x, y| op.apply(*x, *y),
        )
    }

    /// Evaluates `roots` bottom-up in any algebra (numbers, intervals, truncated series). Negation
    /// and integer powers are given to `binary` as products and differences.
    pub fn fold<T: Clone>(
        &self,
        roots: &[Id],
        symbol: &mut dyn FnMut(Id) -> T,
        constant: &mut dyn FnMut(f64) -> T,
        unary: &mut dyn FnMut(Fun, &T) -> T,
        binary: &mut dyn FnMut(Op, &T, &T) -> T,
    ) -> Vec<T> {
        let mut value: FxHashMap<Id, T> = FxHashMap::default();
        for id in self.reachable(roots) {
            let v = match self.node(id) {
                Node::Const(bits) => constant(f64::from_bits(bits)),
                Node::Symbol(_) => symbol(id),
                Node::Neg(a) => binary(Op::Sub, &constant(0.0), &value[&a]),
                Node::Unary(f, a) => unary(f, &value[&a]),
                Node::Binary(op, a, b) => binary(op, &value[&a], &value[&b]),
                Node::Powi(a, n) => {
                    let base = value[&a].clone();
                    let mut result: Option<T> = None;
                    let mut square = base;
                    let mut e = n.unsigned_abs();
                    while e > 0 {
                        if e & 1 == 1 {
                            result = Some(match result {
                                Some(r) => binary(Op::Mul, &r, &square),
                                None => square.clone(),
                            });
                        }
                        e >>= 1;
                        if e > 0 {
                            square = binary(Op::Mul, &square, &square);
                        }
                    }
                    let p = result.unwrap_or_else(|| constant(1.0));
                    if n < 0 {
                        binary(Op::Div, &constant(1.0), &p)
                    } else {
                        p
                    }
                }
            };
            value.insert(id, v);
        }
        roots.iter().map(|r| value[r].clone()).collect()
    }
}
