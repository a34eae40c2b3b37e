//! Expressions rewritten as value at a reference point plus a deviation.
//!
//! Near an equilibrium `f(x* + s)` is a small difference of large terms: evaluated as written, f32
//! loses the digits that tell neighbouring trajectories apart. Here every node becomes a pair `(c,
//! d)` with `node = c + d`, `c` a number (the node at the reference point) and `d` an expression in
//! the deviations that is computed without cancellation: `sin(c + d) - sin(c) = 2 sin(d/2) cos(c +
//! d/2)`, `sqrt(c + d) - sqrt(c) = d / (sqrt(c + d) + sqrt(c))`, and so on. What cancels at the
//! reference point cancels in the `c`s, once, in f64.

use super::{Fun, Graph, Id, Node, Op};
use rustc_hash::FxHashMap;

/// An expression as `at + change`: a number and an expression that vanishes with the deviations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Deviation {
    pub at: f64,
    pub change: Id,
    /// The sum as an expression of its own, where the two may cancel: of what ranges over many
    /// orders of magnitude.
    whole: Option<Id>,
}

impl Deviation {
    pub fn new(at: f64, change: Id) -> Self {
        Self {
            at,
            change,
            whole: None,
        }
    }
}

/// Arguments of exponentials at the reference point above which these are wide: much less of them
/// may be left elsewhere.
const WIDE: f64 = 2.0;
/// Arguments of exponentials at the reference point below which their factors would overflow, or be
/// lost, before the product.
const FAINT: f64 = -40.0;
/// Arguments of tanh up to which its addition theorem loses no digits.
const BEFORE_SATURATION: f64 = 1.0;

/// A sum below this many rounding errors of its terms is a cancellation to zero.
const CANCELLED: f64 = 8.0 * f64::EPSILON;

fn cancel(sum: f64, scale: f64) -> f64 {
    if sum.abs() <= CANCELLED * scale {
        0.0
    } else {
        sum
    }
}

impl Graph {
    /// Rewrites `roots` about a reference point. `symbols` maps each free symbol to its value there
    /// and its deviation (a constant 0 for parameters).
    ///
    /// # Panics
    /// When a symbol that a root depends on is not in `symbols`.
    pub fn deviations(
        &mut self,
        roots: &[Id],
        symbols: &FxHashMap<Id, Deviation>,
    ) -> Vec<Deviation> {
        let mut memo: FxHashMap<Id, Deviation> = FxHashMap::default();
        for id in self.reachable(roots) {
            let zero = self.constant(0.0);
            let value = match self.node(id) {
                Node::Const(bits) => Deviation::new(f64::from_bits(bits), zero),
                Node::Symbol(_) => symbols[&id],
                Node::Neg(a) => {
                    let a = memo[&a];
                    Deviation::new(-a.at, self.neg(a.change))
                }
                Node::Unary(f, a) => self.deviate_unary(f, memo[&a]),
                Node::Powi(a, n) => self.deviate_power(memo[&a], n),
                Node::Binary(op, a, b) => self.deviate_binary(op, memo[&a], memo[&b]),
            };
            let whole = self.direct(self.node(id), &value, &memo);
            // What is no longer wide is not a difference of what is.
            let value = match (whole, self.node(id)) {
                (
                    Some(whole),
                    Node::Binary(Op::Div | Op::Pow, ..)
                    | Node::Unary(Fun::Log | Fun::Log1p, _)
                    | Node::Powi(_, ..0),
                ) => self.plain(value.at, whole),
                _ => value,
            };
            memo.insert(id, Deviation { whole, ..value });
        }
        roots.iter().map(|r| memo[r]).collect()
    }

    /// `at + change` as one expression.
    pub fn whole(&mut self, v: Deviation) -> Id {
        v.whole.unwrap_or_else(|| {
            let c = self.constant(v.at);
            self.add(c, v.change)
        })
    }

    /// A node from its whole operands, where `at + change` may cancel: of exponentials that are
    /// large at the reference point, and what is made of these.
    fn direct(
        &mut self,
        node: Node,
        value: &Deviation,
        of: &FxHashMap<Id, Deviation>,
    ) -> Option<Id> {
        let is_wide = |a: Id| of[&a].whole.is_some();
        if value.at == 0.0 {
            return None;
        }
        match node {
            Node::Const(_) | Node::Symbol(_) => None,
            Node::Neg(a) => {
                let a = of[&a].whole?;
                Some(self.neg(a))
            }
            Node::Unary(f, a) => {
                let exponential = match f {
                    _ if self.is_zero(of[&a].change) => false,
                    Fun::Exp | Fun::Expm1 => of[&a].at > WIDE,
                    Fun::Sinh | Fun::Cosh => of[&a].at.abs() > WIDE,
                    _ => false,
                };
                (exponential || is_wide(a)).then(|| {
                    let a = self.whole(of[&a]);
                    self.unary(f, a)
                })
            }
            Node::Powi(a, n) => {
                let a = of[&a].whole?;
                Some(self.powi(a, n))
            }
            Node::Binary(op, a, b) if is_wide(a) || is_wide(b) => {
                let larger = of[&a].at.abs().max(of[&b].at.abs());
                // What cancels at the reference point does so there once.
                if matches!(op, Op::Add | Op::Sub) && value.at.abs() < 0.5 * larger {
                    return None;
                }
                let (a, b) = (self.whole(of[&a]), self.whole(of[&b]));
                Some(self.binary(op, a, b))
            }
            Node::Binary(..) => None,
        }
    }

    fn scale(&mut self, c: f64, d: Id) -> Id {
        let c = self.constant(c);
        self.mul(c, d)
    }

    /// `f(whole) - f(at)`, for functions with no better form; a non-finite `f(at)` is left in the
    /// change.
    fn plain(&mut self, at: f64, whole: Id) -> Deviation {
        let at = if at.is_finite() { at } else { 0.0 };
        let c = self.constant(at);
        Deviation::new(at, self.sub(whole, c))
    }

    fn deviate_unary(&mut self, f: Fun, a: Deviation) -> Deviation {
        let (c, d) = (a.at, a.change);
        let value = f.apply(c);
        if self.is_zero(d) {
            return Deviation::new(value, d);
        }
        match f {
            Fun::Sin | Fun::Cos => self.deviate_sine(f, a),
            Fun::Sinh | Fun::Cosh => self.deviate_hyperbolic(f, a),
            // tanh(c+d) - tanh(c) = tanh(d) (1 - tanh(c) tanh(c+d)): of the addition theorem
            // nothing is left where both saturate.
            Fun::Tanh if c.abs() > BEFORE_SATURATION => {
                let whole = self.whole(a);
                let (t, there) = (self.unary(f, d), self.unary(f, whole));
                let one = self.constant(1.0);
                let product = self.scale(value, there);
                let slope = self.sub(one, product);
                Deviation::new(value, self.mul(t, slope))
            }
            Fun::Tan | Fun::Tanh => {
                let t = self.unary(f, d);
                let sign = if f == Fun::Tan { 1.0 } else { -1.0 };
                let one = self.constant(1.0);
                let numerator = self.scale(1.0 + sign * value * value, t);
                let vt = self.scale(-sign * value, t);
                let denominator = self.add(one, vt);
                Deviation::new(value, self.div(numerator, denominator))
            }
            // There the difference loses nothing that matters.
            Fun::Exp | Fun::Expm1 if c < FAINT || !value.is_finite() => self.undeviated(f, a),
            Fun::Exp => {
                let e = self.unary(Fun::Expm1, d);
                Deviation::new(value, self.scale(value, e))
            }
            Fun::Expm1 => {
                let e = self.unary(Fun::Expm1, d);
                Deviation::new(value, self.scale(c.exp(), e))
            }
            Fun::Log | Fun::Log1p => {
                let base = if f == Fun::Log { c } else { 1.0 + c };
                if base > 0.0 {
                    let q = self.scale(1.0 / base, d);
                    return Deviation::new(value, self.unary(Fun::Log1p, q));
                }
                self.undeviated(f, a)
            }
            Fun::Sqrt if c > 0.0 => {
                let whole = self.whole(a);
                let root = self.unary(Fun::Sqrt, whole);
                let at = self.constant(value);
                let sum = self.add(root, at);
                Deviation::new(value, self.div(d, sum))
            }
            // Values that jump have no useful deviation form.
            Fun::Sign | Fun::Step => {
                let whole = self.whole(a);
                Deviation::new(0.0, self.unary(f, whole))
            }
            Fun::Asin | Fun::Acos | Fun::Atan | Fun::Abs | Fun::Sqrt => self.undeviated(f, a),
        }
    }

    /// A function of the whole, less its value at the reference.
    fn undeviated(&mut self, f: Fun, a: Deviation) -> Deviation {
        let whole = self.whole(a);
        let v = self.unary(f, whole);
        self.plain(f.apply(a.at), v)
    }

    /// `sin(c+d) - sin(c) = 2 sin(d/2) (cos(c) cos(d/2) - sin(c) sin(d/2))`, and alike for cos.
    fn deviate_sine(&mut self, f: Fun, a: Deviation) -> Deviation {
        let (c, d) = (a.at, a.change);
        if c == 0.0 && f == Fun::Sin {
            return Deviation::new(0.0, self.unary(Fun::Sin, d));
        }
        let half = self.scale(0.5, d);
        let (s, k) = (self.unary(Fun::Sin, half), self.unary(Fun::Cos, half));
        let (x, y) = if f == Fun::Sin {
            (2.0 * c.cos(), -2.0 * c.sin())
        } else {
            (-2.0 * c.sin(), -2.0 * c.cos())
        };
        let (p, q) = (self.scale(x, k), self.scale(y, s));
        let sum = self.add(p, q);
        Deviation::new(f.apply(c), self.mul(s, sum))
    }

    /// `sinh(c+d) - sinh(c) = 2 sinh(d/2) cosh(c + d/2)`, and alike for cosh.
    fn deviate_hyperbolic(&mut self, f: Fun, a: Deviation) -> Deviation {
        let (c, d) = (a.at, a.change);
        let value = f.apply(c);
        let half = self.scale(0.5, d);
        let s = self.unary(Fun::Sinh, half);
        // The sum below is that of large terms where d is about -2c.
        if c.abs() > WIDE {
            let middle = self.whole(Deviation::new(c, half));
            let other = if f == Fun::Sinh { Fun::Cosh } else { Fun::Sinh };
            let middle = self.unary(other, middle);
            let product = self.mul(s, middle);
            return Deviation::new(value, self.scale(2.0, product));
        }
        let k = self.unary(Fun::Cosh, half);
        let (x, y) = if f == Fun::Sinh {
            (2.0 * c.cosh(), 2.0 * c.sinh())
        } else {
            (2.0 * c.sinh(), 2.0 * c.cosh())
        };
        let (p, q) = (self.scale(x, k), self.scale(y, s));
        let sum = self.add(p, q);
        Deviation::new(value, self.mul(s, sum))
    }

    fn deviate_power(&mut self, a: Deviation, n: i32) -> Deviation {
        if self.is_zero(a.change) {
            return Deviation::new(a.at.powi(n), a.change);
        }
        if n < 0 {
            let one = self.constant(1.0);
            let zero = self.constant(0.0);
            let one = Deviation::new(self.as_constant(one).unwrap_or(1.0), zero);
            let p = self.deviate_power(a, -n);
            return self.deviate_binary(Op::Div, one, p);
        }
        if a.at == 0.0 {
            return Deviation::new(0.0, self.powi(a.change, n));
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
        Deviation::new(a.at.powi(n), self.mul(a.change, sum))
    }

    fn deviate_binary(&mut self, op: Op, a: Deviation, b: Deviation) -> Deviation {
        match op {
            Op::Add => Deviation::new(
                cancel(a.at + b.at, a.at.abs() + b.at.abs()),
                self.add(a.change, b.change),
            ),
            Op::Sub => Deviation::new(
                cancel(a.at - b.at, a.at.abs() + b.at.abs()),
                self.sub(a.change, b.change),
            ),
            Op::Mul => {
                // (ca + da) db + cb da
                let whole = self.whole(a);
                let (x, y) = (self.mul(whole, b.change), self.scale(b.at, a.change));
                Deviation::new(a.at * b.at, self.add(x, y))
            }
            Op::Div => {
                if b.at == 0.0 {
                    let (n, d) = (self.whole(a), self.whole(b));
                    return Deviation::new(0.0, self.div(n, d));
                }
                let at = a.at / b.at;
                let x = self.scale(at, b.change);
                let numerator = self.sub(a.change, x);
                let denominator = self.whole(b);
                Deviation::new(at, self.div(numerator, denominator))
            }
            Op::Pow => {
                if a.at > 0.0 && self.is_zero(b.change) {
                    let q = self.scale(1.0 / a.at, a.change);
                    let log = self.unary(Fun::Log1p, q);
                    let scaled = self.scale(b.at, log);
                    let e = self.unary(Fun::Expm1, scaled);
                    let at = a.at.powf(b.at);
                    return Deviation::new(at, self.scale(at, e));
                }
                let (x, y) = (self.whole(a), self.whole(b));
                let v = self.pow(x, y);
                self.plain(a.at.powf(b.at), v)
            }
            Op::Min | Op::Max => {
                let at = if op == Op::Min {
                    a.at.min(b.at)
                } else {
                    a.at.max(b.at)
                };
                let x = self.whole(Deviation::new(a.at - at, a.change));
                let y = self.whole(Deviation::new(b.at - at, b.change));
                Deviation::new(at, self.binary(op, x, y))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::expr::Kind;

    /// What is made of an argument k (x - x0), of which the number at the reference point is any,
    /// against the same written out.
    fn worst(
        make: impl Fn(&mut Graph, Id) -> Id,
        argument: impl Fn(f64) -> f64,
        written: impl Fn(f64) -> f64,
    ) -> f64 {
        let mut worst = 0.0f64;
        for c in [
            -600.0, -60.0, -41.0, -39.0, -20.0, -5.0, -1.5, -0.5, 0.0, 0.7, 3.0, 12.0, 20.0, 39.0,
            60.0,
        ] {
            let mut graph = Graph::new();
            let (x, s) = (
                graph.symbol("x", Kind::State),
                graph.symbol("s", Kind::State),
            );
            let root = make(&mut graph, x);
            let form =
                graph.deviations(&[root], &FxHashMap::from_iter([(x, Deviation::new(c, s))]))[0];
            let whole = graph.whole(form);
            for place in [-700.0, -30.0, -6.0, -1.0, -0.01, 0.3, 1.0, 5.0, 25.0, 70.0] {
                let deviation = place - c;
                let at = graph.eval(
                    &[whole, form.change],
                    &FxHashMap::from_iter([(s, deviation)]),
                );
                // As rounded.
                let right = written(argument(c + deviation));
                // What is not wide may be left with the rounding of the number at the reference
                // point.
                let least = written(argument(c)).abs().min(WIDE.exp());
                let off = (at[0] - right).abs() / right.abs().max(least).max(f64::MIN_POSITIVE);
                // Of the change, relative to what it is a difference of.
                let size = right.abs().max(written(argument(c)).abs());
                let change = (at[1] - (right - form.at)).abs() / size.max(f64::MIN_POSITIVE);
                assert!(
                    off.is_finite() && change.is_finite(),
                    "from {c} at {place}: {at:?} is not {right}"
                );
                worst = worst.max(off).max(change);
            }
        }
        worst
    }

    #[test]
    fn what_saturates_or_is_lost_at_the_reference_point_is_not_elsewhere() {
        let same = |x: f64| x;
        assert!(worst(|g, x| g.unary(Fun::Tanh, x), same, f64::tanh) < 1e-13);
        // Where the wide ones are small the rounding of their arguments counts.
        assert!(worst(|g, x| g.unary(Fun::Exp, x), same, f64::exp) < 1e-12);
        assert!(worst(|g, x| g.unary(Fun::Cosh, x), same, f64::cosh) < 1e-12);
        let logistic = |g: &mut Graph, x: Id| {
            let (one, e) = (g.constant(1.0), g.unary(Fun::Exp, x));
            let sum = g.add(one, e);
            g.div(one, sum)
        };
        assert!(worst(logistic, same, |x| 1.0 / (1.0 + x.exp())) < 1e-12);
        // Its derivative, as the other way round.
        let slope = |g: &mut Graph, x: Id| {
            let (one, e) = (g.constant(1.0), g.unary(Fun::Exp, x));
            let sum = g.add(one, e);
            let square = g.powi(sum, 2);
            g.div(e, square)
        };
        let exact = |x: f64| (0.5 / (0.5 * x).cosh()).powi(2);
        assert!(worst(slope, same, exact) < 1e-12);
        // Of two quotients: to the rounding of what is as large as itself where it is largest.
        let derived = |g: &mut Graph, x: Id| {
            let of = logistic(g, x);
            let (one, slope) = (g.constant(1.0), g.diff(of, x));
            g.sub(one, slope)
        };
        assert!(worst(derived, same, |x| 1.0 + exact(x)) < 1e-12);
        let logarithm = |g: &mut Graph, x: Id| {
            let (one, e) = (g.constant(1.0), g.unary(Fun::Exp, x));
            let sum = g.add(one, e);
            let log = g.unary(Fun::Log, sum);
            g.add(one, log)
        };
        assert!(
            worst(logarithm, same, |x| 1.0
                + x.max(0.0)
                + (-x.abs()).exp().ln_1p())
                < 1e-12
        );
        // exp(-x^2), of which nothing is left beyond 27.
        let bump = |g: &mut Graph, x: Id| {
            let square = g.powi(x, 2);
            let minus = g.neg(square);
            g.unary(Fun::Exp, minus)
        };
        let value = |x: f64| if x.abs() < 26.0 { (-x * x).exp() } else { 0.0 };
        assert!(worst(bump, |x| if x.abs() > 26.0 { 30.0 } else { x }, value) < 1e-9);
    }

    #[test]
    fn near_the_reference_point_changes_keep_their_digits() {
        for c in [-300.0, -20.0, -1.5, 0.4, 2.5, 15.0] {
            let mut graph = Graph::new();
            let (x, s) = (
                graph.symbol("x", Kind::State),
                graph.symbol("s", Kind::State),
            );
            for (f, slope) in [
                (Fun::Exp, f64::exp(c)),
                (Fun::Sinh, c.cosh()),
                (Fun::Cosh, c.sinh()),
                (Fun::Tanh, c.cosh().powi(-2)),
            ] {
                let root = graph.unary(f, x);
                let form = graph
                    .deviations(&[root], &FxHashMap::from_iter([(x, Deviation::new(c, s))]))[0];
                let small = 1e-9;
                let change =
                    graph.eval(&[form.change], &FxHashMap::from_iter([(s, small)]))[0] / small;
                let size = f.apply(c).abs().max(1e-18);
                assert!(
                    (change - slope).abs() < 1e-8 * slope.abs().max(1e-8 * size),
                    "{f:?} from {c}: {change:e} is not {slope:e}"
                );
            }
        }
    }
}
