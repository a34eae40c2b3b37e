//! Derivatives in reverse: all slopes of one expression for the price of a few of it, whatever the
//! number of symbols.

use super::{Fun, Graph, Id, Node, Op};
use rustc_hash::{FxHashMap, FxHashSet};

/// What has been gathered for each node: the derivative of the whole by it.
type Adjoints = FxHashMap<Id, Id>;

impl Graph {
    /// Derivatives of `expr` by each of `symbols`, in reverse mode (A. Griewank, A. Walther,
    /// Evaluating Derivatives, 2008): the new operations are at most some four times those of
    /// `expr`. At kinks as [`Self::diff`].
    pub fn gradient(&mut self, expr: Id, symbols: &[Id]) -> Vec<Id> {
        let order = self.reachable(&[expr]);
        let active = self.depending(&order, symbols);
        let mut adjoints = Adjoints::default();
        if active.contains(&expr) {
            let one = self.constant(1.0);
            adjoints.insert(expr, one);
        }
        for &id in order.iter().rev() {
            if let Some(adjoint) = adjoints.get(&id).copied() {
                self.pass(id, adjoint, &active, &mut adjoints);
            }
        }
        let zero = self.constant(0.0);
        (symbols.iter())
            .map(|s| adjoints.get(s).copied().unwrap_or(zero))
            .collect()
    }

    /// The nodes of `order` that depend on one of `symbols`, these included.
    pub(super) fn depending(&self, order: &[Id], symbols: &[Id]) -> FxHashSet<Id> {
        let mut active = FxHashSet::default();
        for &id in order {
            if symbols.contains(&id) || self.arguments(id).any(|a| active.contains(&a)) {
                active.insert(id);
            }
        }
        active
    }

    /// Gives the arguments of a node their parts of its adjoint.
    fn pass(&mut self, id: Id, adjoint: Id, active: &FxHashSet<Id>, adjoints: &mut Adjoints) {
        let mut give = |g: &mut Self, to: Id, part: Id, sign: f64| {
            let sum = match (adjoints.get(&to), sign > 0.0) {
                (None, true) => part,
                (None, false) => g.neg(part),
                (Some(&old), true) => g.add(old, part),
                (Some(&old), false) => g.sub(old, part),
            };
            adjoints.insert(to, sum);
        };
        let is_active = |a: Id| active.contains(&a);
        match self.node(id) {
            Node::Const(_) | Node::Symbol(_) => {}
            Node::Neg(a) => give(self, a, adjoint, -1.0),
            Node::Powi(a, n) => {
                let factor = self.constant(f64::from(n));
                let power = self.powi(a, n - 1);
                let slope = self.mul(factor, power);
                let part = self.mul(adjoint, slope);
                give(self, a, part, 1.0);
            }
            Node::Unary(f, a) => {
                let slope = self.unary_derivative(f, a, id);
                let part = self.mul(adjoint, slope);
                give(self, a, part, 1.0);
            }
            Node::Binary(op, a, b) => match op {
                Op::Add | Op::Sub => {
                    if is_active(a) {
                        give(self, a, adjoint, 1.0);
                    }
                    if is_active(b) {
                        give(self, b, adjoint, if op == Op::Add { 1.0 } else { -1.0 });
                    }
                }
                Op::Mul => {
                    if is_active(a) {
                        let part = self.mul(adjoint, b);
                        give(self, a, part, 1.0);
                    }
                    if is_active(b) {
                        let part = self.mul(adjoint, a);
                        give(self, b, part, 1.0);
                    }
                }
                Op::Div => {
                    // Of 1/b the slope is -(1/b)^2: no further division.
                    let reciprocal = self.as_constant(a) == Some(1.0);
                    let share = match reciprocal {
                        true => self.mul(adjoint, id),
                        false => self.div(adjoint, b),
                    };
                    if is_active(a) {
                        give(self, a, share, 1.0);
                    }
                    if is_active(b) {
                        let part = self.mul(share, id);
                        give(self, b, part, -1.0);
                    }
                }
                Op::Pow => {
                    if is_active(a) {
                        let one = self.constant(1.0);
                        let less = self.sub(b, one);
                        let power = self.pow(a, less);
                        let slope = self.mul(b, power);
                        let part = self.mul(adjoint, slope);
                        give(self, a, part, 1.0);
                    }
                    if is_active(b) {
                        let log = self.unary(Fun::Log, a);
                        let slope = self.mul(id, log);
                        let part = self.mul(adjoint, slope);
                        give(self, b, part, 1.0);
                    }
                }
                Op::Min | Op::Max => {
                    // step(b - a) selects the smaller one.
                    let difference = match op {
                        Op::Min => self.sub(b, a),
                        _ => self.sub(a, b),
                    };
                    let chosen = self.unary(Fun::Step, difference);
                    let of_a = self.mul(adjoint, chosen);
                    if is_active(a) {
                        give(self, a, of_a, 1.0);
                    }
                    if is_active(b) {
                        let rest = self.sub(adjoint, of_a);
                        give(self, b, rest, 1.0);
                    }
                }
            },
        }
    }
}
