//! Expressions rewritten as value at a reference point plus a deviation.
//!
//! Near an equilibrium `f(x* + s)` is a small difference of large terms: evaluated as written, f32 loses
//! the digits that tell neighbouring trajectories apart. Here every node becomes a pair `(c, d)` with
//! `node = c + d`, `c` a number (the node at the reference point) and `d` an expression in the deviations
//! that is computed without cancellation: `sin(c + d) - sin(c) = 2 sin(d/2) cos(c + d/2)`,
//! `sqrt(c + d) - sqrt(c) = d / (sqrt(c + d) + sqrt(c))`, and so on. What cancels at the reference point
//! cancels in the `c`s, once, in f64.

use super::{Fun, Graph, Id, Node, Op};
use std::collections::HashMap;

/// An expression as `at + change`: a number and an expression that vanishes with the deviations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Deviation {
    pub at: f64,
    pub change: Id,
}

/// A sum below this many rounding errors of its terms is a cancellation to zero.
const CANCELLED: f64 = 8.0 * f64::EPSILON;

fn cancel(sum: f64, scale: f64) -> f64 {
    if sum.abs() <= CANCELLED * scale { 0.0 } else { sum }
}

impl Graph {
    /// Rewrites `roots` about a reference point. `symbols` maps each free symbol to its value there and its
    /// deviation (a constant 0 for parameters).
    ///
    /// # Panics
    /// When a symbol that a root depends on is not in `symbols`.
    pub fn deviations(&mut self, roots: &[Id], symbols: &HashMap<Id, Deviation>) -> Vec<Deviation> {
        let mut memo: HashMap<Id, Deviation> = HashMap::new();
        for id in self.reachable(roots) {
            let zero = self.constant(0.0);
            let value = match self.node(id) {
                Node::Const(bits) => Deviation {
                    at: f64::from_bits(bits),
                    change: zero,
                },
                Node::Symbol(_) => symbols[&id],
                Node::Neg(a) => {
                    let a = memo[&a];
                    Deviation {
                        at: -a.at,
                        change: self.neg(a.change),
                    }
                }
                Node::Unary(f, a) => self.deviate_unary(f, memo[&a]),
                Node::Powi(a, n) => self.deviate_power(memo[&a], n),
                Node::Binary(op, a, b) => self.deviate_binary(op, memo[&a], memo[&b]),
            };
            memo.insert(id, value);
        }
        roots.iter().map(|r| memo[r]).collect()
    }

    /// `at + change` as one expression.
    pub fn whole(&mut self, v: Deviation) -> Id {
        let c = self.constant(v.at);
        self.add(c, v.change)
    }

    fn scale(&mut self, c: f64, d: Id) -> Id {
        let c = self.constant(c);
        self.mul(c, d)
    }

    /// `f(whole) - f(at)`, for functions with no better form; a non-finite `f(at)` is left in the change.
    fn plain(&mut self, at: f64, whole: Id) -> Deviation {
        let at = if at.is_finite() { at } else { 0.0 };
        let c = self.constant(at);
        Deviation {
            at,
            change: self.sub(whole, c),
        }
    }

    fn deviate_unary(&mut self, f: Fun, a: Deviation) -> Deviation {
        let (c, d) = (a.at, a.change);
        let value = f.apply(c);
        if self.is_zero(d) {
            return Deviation { at: value, change: d };
        }
        match f {
            Fun::Sin | Fun::Cos => {
                if c == 0.0 && f == Fun::Sin {
                    return Deviation {
                        at: 0.0,
                        change: self.unary(Fun::Sin, d),
                    };
                }
                // sin(c+d) - sin(c) = 2 sin(d/2) (cos(c) cos(d/2) - sin(c) sin(d/2)), and alike for cos.
                let half = self.scale(0.5, d);
                let (s, k) = (self.unary(Fun::Sin, half), self.unary(Fun::Cos, half));
                let (x, y) = if f == Fun::Sin {
                    (2.0 * c.cos(), -2.0 * c.sin())
                } else {
                    (-2.0 * c.sin(), -2.0 * c.cos())
                };
                let (p, q) = (self.scale(x, k), self.scale(y, s));
                let sum = self.add(p, q);
                Deviation {
                    at: value,
                    change: self.mul(s, sum),
                }
            }
            Fun::Sinh | Fun::Cosh => {
                let half = self.scale(0.5, d);
                let (s, k) = (self.unary(Fun::Sinh, half), self.unary(Fun::Cosh, half));
                let (x, y) = if f == Fun::Sinh {
                    (2.0 * c.cosh(), 2.0 * c.sinh())
                } else {
                    (2.0 * c.sinh(), 2.0 * c.cosh())
                };
                let (p, q) = (self.scale(x, k), self.scale(y, s));
                let sum = self.add(p, q);
                Deviation {
                    at: value,
                    change: self.mul(s, sum),
                }
            }
            Fun::Tan | Fun::Tanh => {
                let t = self.unary(f, d);
                let sign = if f == Fun::Tan { 1.0 } else { -1.0 };
                let one = self.constant(1.0);
                let numerator = self.scale(1.0 + sign * value * value, t);
                let vt = self.scale(-sign * value, t);
                let denominator = self.add(one, vt);
                Deviation {
                    at: value,
                    change: self.div(numerator, denominator),
                }
            }
            Fun::Exp => {
                let e = self.unary(Fun::Expm1, d);
                Deviation {
                    at: value,
                    change: self.scale(value, e),
                }
            }
            Fun::Expm1 => {
                let e = self.unary(Fun::Expm1, d);
                Deviation {
                    at: value,
                    change: self.scale(c.exp(), e),
                }
            }
            Fun::Log | Fun::Log1p => {
                let base = if f == Fun::Log { c } else { 1.0 + c };
                if base > 0.0 {
                    let q = self.scale(1.0 / base, d);
                    return Deviation {
                        at: value,
                        change: self.unary(Fun::Log1p, q),
                    };
                }
                let whole = self.whole(a);
                let v = self.unary(f, whole);
                self.plain(value, v)
            }
            Fun::Sqrt if c > 0.0 => {
                let whole = self.whole(a);
                let root = self.unary(Fun::Sqrt, whole);
                let at = self.constant(value);
                let sum = self.add(root, at);
                Deviation {
                    at: value,
                    change: self.div(d, sum),
                }
            }
            // Values that jump have no useful deviation form.
            Fun::Sign | Fun::Step => {
                let whole = self.whole(a);
                Deviation {
                    at: 0.0,
                    change: self.unary(f, whole),
                }
            }
            Fun::Asin | Fun::Acos | Fun::Atan | Fun::Abs | Fun::Sqrt => {
                let whole = self.whole(a);
                let v = self.unary(f, whole);
                self.plain(value, v)
            }
        }
    }

    fn deviate_power(&mut self, a: Deviation, n: i32) -> Deviation {
        if self.is_zero(a.change) {
            return Deviation {
                at: a.at.powi(n),
                change: a.change,
            };
        }
        if n < 0 {
            let one = self.constant(1.0);
            let zero = self.constant(0.0);
            let one = Deviation {
                at: self.as_constant(one).unwrap_or(1.0),
                change: zero,
            };
            let p = self.deviate_power(a, -n);
            return self.deviate_binary(Op::Div, one, p);
        }
        if a.at == 0.0 {
            return Deviation {
                at: 0.0,
                change: self.powi(a.change, n),
            };
        }
        if n > 6 {
            let half = self.deviate_power(a, n / 2);
            let rest = self.deviate_power(a, n - n / 2);
            return self.deviate_binary(Op::Mul, half, rest);
        }
        // d (n c^(n-1) + d (... + d)): binomial coefficients, Horner's rule.
        let mut coefficient = 1.0;
        let mut coefficients = Vec::new();
        for k in 1..=n {
            coefficient *= f64::from(n - k + 1) / f64::from(k);
            coefficients.push(coefficient * a.at.powi(n - k));
        }
        let mut sum = self.constant(coefficients[coefficients.len() - 1]);
        for c in coefficients.iter().rev().skip(1) {
            let product = self.mul(a.change, sum);
            let c = self.constant(*c);
            sum = self.add(product, c);
        }
        Deviation {
            at: a.at.powi(n),
            change: self.mul(a.change, sum),
        }
    }

    fn deviate_binary(&mut self, op: Op, a: Deviation, b: Deviation) -> Deviation {
        match op {
            Op::Add => Deviation {
                at: cancel(a.at + b.at, a.at.abs() + b.at.abs()),
                change: self.add(a.change, b.change),
            },
            Op::Sub => Deviation {
                at: cancel(a.at - b.at, a.at.abs() + b.at.abs()),
                change: self.sub(a.change, b.change),
            },
            Op::Mul => {
                // (ca + da) db + cb da
                let whole = self.whole(a);
                let (x, y) = (self.mul(whole, b.change), self.scale(b.at, a.change));
                Deviation {
                    at: a.at * b.at,
                    change: self.add(x, y),
                }
            }
            Op::Div => {
                if b.at == 0.0 {
                    let (n, d) = (self.whole(a), self.whole(b));
                    return Deviation {
                        at: 0.0,
                        change: self.div(n, d),
                    };
                }
                let at = a.at / b.at;
                let x = self.scale(at, b.change);
                let numerator = self.sub(a.change, x);
                let denominator = self.whole(b);
                Deviation {
                    at,
                    change: self.div(numerator, denominator),
                }
            }
            Op::Pow => {
                if a.at > 0.0 && self.is_zero(b.change) {
                    let q = self.scale(1.0 / a.at, a.change);
                    let log = self.unary(Fun::Log1p, q);
                    let scaled = self.scale(b.at, log);
                    let e = self.unary(Fun::Expm1, scaled);
                    let at = a.at.powf(b.at);
                    return Deviation {
                        at,
                        change: self.scale(at, e),
                    };
                }
                let (x, y) = (self.whole(a), self.whole(b));
                let v = self.pow(x, y);
                self.plain(a.at.powf(b.at), v)
            }
            Op::Min | Op::Max => {
                let at = if op == Op::Min { a.at.min(b.at) } else { a.at.max(b.at) };
                let x = self.whole(Deviation {
                    at: a.at - at,
                    change: a.change,
                });
                let y = self.whole(Deviation {
                    at: b.at - at,
                    change: b.change,
                });
                Deviation {
                    at,
                    change: self.binary(op, x, y),
                }
            }
        }
    }
}
