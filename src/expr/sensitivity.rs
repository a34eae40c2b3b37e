//! How much an expression owes to what it is made of.

use super::{Fun, Graph, Id, Node, Op, Values};
use rustc_hash::FxHashMap;

impl Graph {
    /// Value of `expr`, and the sum over all symbols and numbers in it of their sizes times the
    /// slopes by them: what relative changes of all of these by one part would change at most, to
    /// first order. In reverse, in numbers; symbols without a value are NaN.
    pub fn sensitivity(&self, expr: Id, values: &Values) -> (f64, f64) {
        let order = self.reachable(&[expr]);
        let mut value: FxHashMap<Id, f64> = FxHashMap::default();
        for &id in &order {
            let v = match self.node(id) {
                Node::Const(bits) => f64::from_bits(bits),
                Node::Symbol(_) => values.get(&id).copied().unwrap_or(f64::NAN),
                Node::Neg(a) => -value[&a],
                Node::Unary(f, a) => f.apply(value[&a]),
                Node::Powi(a, n) => value[&a].powi(n),
                Node::Binary(op, a, b) => op.apply(value[&a], value[&b]),
            };
            value.insert(id, v);
        }
        let mut slopes: FxHashMap<Id, f64> = FxHashMap::from_iter([(expr, 1.0)]);
        let mut size = 0.0;
        for &id in order.iter().rev() {
            let slope = slopes.get(&id).copied().unwrap_or(0.0);
            let v = value[&id];
            let mut give = |to: Id, part: f64| *slopes.entry(to).or_insert(0.0) += slope * part;
            match self.node(id) {
                Node::Const(_) | Node::Symbol(_) => size += (slope * v).abs(),
                Node::Neg(a) => give(a, -1.0),
                Node::Powi(a, n) => give(a, f64::from(n) * value[&a].powi(n - 1)),
                Node::Unary(f, a) => give(a, f.slope(value[&a], v)),
                Node::Binary(op, a, b) => {
                    let (x, y) = (value[&a], value[&b]);
                    let (by_a, by_b) = match op {
                        Op::Add => (1.0, 1.0),
                        Op::Sub => (1.0, -1.0),
                        Op::Mul => (y, x),
                        Op::Div => (1.0 / y, -v / y),
                        // Of a base of 0 no change of the exponent matters.
                        Op::Pow => (y * x.powf(y - 1.0), if v == 0.0 { 0.0 } else { v * x.ln() }),
                        Op::Min => (f64::from(x <= y), f64::from(x > y)),
                        Op::Max => (f64::from(x >= y), f64::from(x < y)),
                    };
                    give(a, by_a);
                    give(b, by_b);
                }
            }
        }
        (value[&expr], size)
    }
}

impl Fun {
    /// df/dx, of x and f(x).
    fn slope(self, x: f64, y: f64) -> f64 {
        match self {
            Fun::Sin => x.cos(),
            Fun::Cos => -x.sin(),
            Fun::Tan => 1.0 + y * y,
            Fun::Asin => 1.0 / (1.0 - x * x).sqrt(),
            Fun::Acos => -1.0 / (1.0 - x * x).sqrt(),
            Fun::Atan => 1.0 / (1.0 + x * x),
            Fun::Sinh => x.cosh(),
            Fun::Cosh => x.sinh(),
            Fun::Tanh => 1.0 - y * y,
            Fun::Exp => y,
            Fun::Expm1 => y + 1.0,
            Fun::Log => 1.0 / x,
            Fun::Log1p => 1.0 / (1.0 + x),
            Fun::Sqrt => 0.5 / y,
            Fun::Abs => Fun::Sign.apply(x),
            Fun::Sign | Fun::Step => 0.0,
        }
    }
}
