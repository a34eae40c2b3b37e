//! Symbolic derivatives.

use super::{Fun, Graph, Id, Node, Op};
use rustc_hash::FxHashMap;

impl Graph {
    /// Derivative of `expr` by `symbol`.
    ///
    /// At kinks the derivative of one side is taken: `d|x|/dx = sign(x)` and a clamp's derivative
    /// is 0 where it acts.
    pub fn diff(&mut self, expr: Id, symbol: Id) -> Id {
        self.diff_all(&[expr], symbol)[0]
    }

    /// Derivatives of several expressions by one symbol, sharing the work.
    pub fn diff_all(&mut self, exprs: &[Id], symbol: Id) -> Vec<Id> {
        let one = self.constant(1.0);
        self.tangents(exprs, &FxHashMap::from_iter([(symbol, one)]))
    }

    /// Derivatives of several expressions along a direction: `along` has the rates of the symbols
    /// that change.
    pub fn tangents(&mut self, exprs: &[Id], along: &FxHashMap<Id, Id>) -> Vec<Id> {
        let mut d: FxHashMap<Id, Id> = FxHashMap::default();
        for id in self.reachable(exprs) {
            let value = self.diff_node(id, along, &d);
            d.insert(id, value);
        }
        exprs.iter().map(|e| d[e]).collect()
    }

    fn diff_node(&mut self, id: Id, along: &FxHashMap<Id, Id>, d: &FxHashMap<Id, Id>) -> Id {
        if let Some(&rate) = along.get(&id) {
            return rate;
        }
        match self.node(id) {
            Node::Const(_) | Node::Symbol(_) => self.constant(0.0),
            Node::Neg(a) => self.neg(d[&a]),
            Node::Powi(a, n) => {
                if self.is_zero(d[&a]) {
                    return d[&a];
                }
                let c = self.constant(f64::from(n));
                let p = self.powi(a, n - 1);
                let outer = self.mul(c, p);
                self.mul(outer, d[&a])
            }
            Node::Unary(f, a) => {
                if self.is_zero(d[&a]) {
                    return d[&a];
                }
                let outer = self.unary_derivative(f, a, id);
                self.mul(outer, d[&a])
            }
            Node::Binary(op, a, b) => self.diff_binary(op, a, b, id, d[&a], d[&b]),
        }
    }

    fn diff_binary(&mut self, op: Op, a: Id, b: Id, value: Id, da: Id, db: Id) -> Id {
        match op {
            Op::Add => self.add(da, db),
            Op::Sub => self.sub(da, db),
            Op::Mul => {
                let (x, y) = (self.mul(da, b), self.mul(a, db));
                self.add(x, y)
            }
            Op::Div => {
                // (a/b)' = a'/b - (a/b) b'/b, which reuses the quotient.
                let first = self.div(da, b);
                if self.is_zero(db) {
                    return first;
                }
                let q = self.div(db, b);
                let second = self.mul(value, q);
                self.sub(first, second)
            }
            Op::Pow => {
                let one = self.constant(1.0);
                let e = self.sub(b, one);
                let p = self.pow(a, e);
                let bp = self.mul(b, p);
                let first = self.mul(bp, da);
                if self.is_zero(db) {
                    return first;
                }
                let log = self.unary(Fun::Log, a);
                let v = self.mul(value, log);
                let second = self.mul(v, db);
                self.add(first, second)
            }
            Op::Min | Op::Max => {
                if da == db {
                    return da;
                }
                // step(b - a) selects the smaller one.
                let diff = if op == Op::Min {
                    self.sub(b, a)
                } else {
                    self.sub(a, b)
                };
                let pick_a = self.unary(Fun::Step, diff);
                let change = self.sub(da, db);
                let x = self.mul(pick_a, change);
                self.add(db, x)
            }
        }
    }

    /// Derivative of `f` at `a`, given the node `value = f(a)`.
    pub(super) fn unary_derivative(&mut self, f: Fun, a: Id, value: Id) -> Id {
        let one = self.constant(1.0);
        match f {
            Fun::Sin => self.unary(Fun::Cos, a),
            Fun::Cos => {
                let s = self.unary(Fun::Sin, a);
                self.neg(s)
            }
            Fun::Tan => {
                let sq = self.powi(value, 2);
                self.add(one, sq)
            }
            Fun::Asin | Fun::Acos => {
                let sq = self.powi(a, 2);
                let r = self.sub(one, sq);
                let root = self.unary(Fun::Sqrt, r);
                let d = self.div(one, root);
                if f == Fun::Asin { d } else { self.neg(d) }
            }
            Fun::Atan => {
                let sq = self.powi(a, 2);
                let r = self.add(one, sq);
                self.div(one, r)
            }
            Fun::Sinh => self.unary(Fun::Cosh, a),
            Fun::Cosh => self.unary(Fun::Sinh, a),
            Fun::Tanh => {
                let sq = self.powi(value, 2);
                self.sub(one, sq)
            }
            Fun::Exp => value,
            Fun::Expm1 => self.add(value, one),
            Fun::Log => self.div(one, a),
            Fun::Log1p => {
                let r = self.add(one, a);
                self.div(one, r)
            }
            Fun::Sqrt => {
                let half = self.constant(0.5);
                self.div(half, value)
            }
            Fun::Abs => self.unary(Fun::Sign, a),
            Fun::Sign | Fun::Step => self.constant(0.0),
        }
    }
}
