//! The hash-consed expression graph and its simplifying constructors.

use crate::numeric::{greatest, least};
use rustc_hash::FxHashMap;

/// Index of a node in its [`Graph`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Id(pub(crate) u32);

/// What a symbol stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Kind {
    Parameter,
    State,
    Adjoint,
    Control,
    Disturbance,
}

/// A named free variable.
#[derive(Clone, Debug)]
pub struct Symbol {
    pub name: String,
    pub kind: Kind,
}

/// Functions of one argument. `Sign` and `Step` arise from differentiation: `Sign(x)` is -1, 0, 1
/// and `Step(x)` is 1 for x > 0 and else 0. `Expm1` and `Log1p` arise from the deviation form.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Fun {
    Sin,
    Cos,
    Tan,
    Asin,
    Acos,
    Atan,
    Sinh,
    Cosh,
    Tanh,
    Exp,
    Log,
    Sqrt,
    Abs,
    Sign,
    Step,
    Expm1,
    Log1p,
}

impl Fun {
    /// Functions a scenario may call, with their names.
    pub const CALLABLE: [(&'static str, Fun); 13] = [
        ("sin", Fun::Sin),
        ("cos", Fun::Cos),
        ("tan", Fun::Tan),
        ("asin", Fun::Asin),
        ("acos", Fun::Acos),
        ("atan", Fun::Atan),
        ("sinh", Fun::Sinh),
        ("cosh", Fun::Cosh),
        ("tanh", Fun::Tanh),
        ("exp", Fun::Exp),
        ("log", Fun::Log),
        ("sqrt", Fun::Sqrt),
        ("abs", Fun::Abs),
    ];

    /// The function's name in scenario files and printed equations.
    pub fn name(self) -> &'static str {
        match self {
            Fun::Sign => "sign",
            Fun::Step => "step",
            Fun::Expm1 => "expm1",
            Fun::Log1p => "log1p",
            _ => Fun::CALLABLE
                .iter()
                .find(|(_, f)| *f == self)
                .map_or("?", |(n, _)| n),
        }
    }

    /// Value in f64.
    pub fn apply(self, x: f64) -> f64 {
        match self {
            Fun::Sin => x.sin(),
            Fun::Cos => x.cos(),
            Fun::Tan => x.tan(),
            Fun::Asin => x.asin(),
            Fun::Acos => x.acos(),
            Fun::Atan => x.atan(),
            Fun::Sinh => x.sinh(),
            Fun::Cosh => x.cosh(),
            Fun::Tanh => x.tanh(),
            Fun::Exp => x.exp(),
            Fun::Log => x.ln(),
            Fun::Sqrt => x.sqrt(),
            Fun::Abs => x.abs(),
            Fun::Sign => {
                if x > 0.0 {
                    1.0
                } else if x < 0.0 {
                    -1.0
                } else {
                    0.0 * x
                }
            }
            Fun::Step => {
                if x > 0.0 {
                    1.0
                } else {
                    0.0
                }
            }
            Fun::Expm1 => x.exp_m1(),
            Fun::Log1p => x.ln_1p(),
        }
    }
}

/// Operations of two arguments.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Op {
    Add,
    Sub,
    Mul,
    Div,
    /// `a ^ b` for a real exponent; integer exponents are [`Node::Powi`].
    Pow,
    Min,
    Max,
}

impl Op {
    /// Value in f64.
    pub fn apply(self, x: f64, y: f64) -> f64 {
        match self {
            Op::Add => x + y,
            Op::Sub => x - y,
            Op::Mul => x * y,
            Op::Div => x / y,
            Op::Pow => x.powf(y),
            Op::Min => least(x, y),
            Op::Max => greatest(x, y),
        }
    }
}

/// One node of the graph. Constants are kept as bits so that nodes can be hashed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Node {
    Const(u64),
    Symbol(u32),
    Neg(Id),
    Unary(Fun, Id),
    Binary(Op, Id, Id),
    /// Integer power, exponent at least 2 in magnitude or -1.
    Powi(Id, i32),
}

/// Arena of expressions in which structurally equal expressions are one node.
#[derive(Clone, Debug, Default)]
pub struct Graph {
    nodes: Vec<Node>,
    index: FxHashMap<Node, Id>,
    symbols: Vec<Symbol>,
}

impl Graph {
    pub fn new() -> Self {
        Self::default()
    }

    /// The node behind an id.
    pub fn node(&self, id: Id) -> Node {
        self.nodes[id.0 as usize]
    }

    /// Number of nodes made so far; ids below it are valid and arguments have smaller ids than
    /// their users.
    pub fn len(&self) -> usize {
        self.nodes.len()
    }

    pub fn is_empty(&self) -> bool {
        self.nodes.is_empty()
    }

    pub fn symbols(&self) -> &[Symbol] {
        &self.symbols
    }

    fn intern(&mut self, node: Node) -> Id {
        if let Some(&id) = self.index.get(&node) {
            return id;
        }
        let id = Id(u32::try_from(self.nodes.len())
            .expect("an expression graph holds fewer than 2^32 nodes"));
        self.nodes.push(node);
        self.index.insert(node, id);
        id
    }

    /// A new free variable. Two calls give two different symbols even for one name.
    pub fn symbol(&mut self, name: &str, kind: Kind) -> Id {
        let index = self.symbols.len() as u32;
        self.symbols.push(Symbol {
            name: name.to_owned(),
            kind,
        });
        self.intern(Node::Symbol(index))
    }

    /// The symbol at `id`, where it is one.
    pub fn as_symbol(&self, id: Id) -> Option<&Symbol> {
        match self.node(id) {
            Node::Symbol(i) => Some(&self.symbols[i as usize]),
            _ => None,
        }
    }

    pub fn constant(&mut self, value: f64) -> Id {
        // One zero, so that 0 and -0 are the same node.
        let value = if value == 0.0 { 0.0 } else { value };
        self.intern(Node::Const(value.to_bits()))
    }

    /// The value at `id`, where it is a constant.
    pub fn as_constant(&self, id: Id) -> Option<f64> {
        match self.node(id) {
            Node::Const(bits) => Some(f64::from_bits(bits)),
            _ => None,
        }
    }

    pub fn is_zero(&self, id: Id) -> bool {
        self.as_constant(id) == Some(0.0)
    }

    fn is_one(&self, id: Id) -> bool {
        self.as_constant(id) == Some(1.0)
    }

    /// `id` as (coefficient, rest) with the constant factor pulled out.
    fn split_factor(&self, id: Id) -> (f64, Id) {
        match self.node(id) {
            Node::Neg(a) => {
                let (c, r) = self.split_factor(a);
                (-c, r)
            }
            Node::Binary(Op::Mul, a, b) => match self.as_constant(a) {
                Some(c) => (c, b),
                None => (1.0, id),
            },
            _ => (1.0, id),
        }
    }

    fn scaled(&mut self, factor: f64, rest: Id) -> Id {
        let c = self.constant(factor);
        self.mul(c, rest)
    }

    pub fn add(&mut self, a: Id, b: Id) -> Id {
        if let (Some(x), Some(y)) = (self.as_constant(a), self.as_constant(b)) {
            return self.constant(x + y);
        }
        if self.is_zero(a) {
            return b;
        }
        if self.is_zero(b) {
            return a;
        }
        let ((ca, ra), (cb, rb)) = (self.split_factor(a), self.split_factor(b));
        if ra == rb {
            return self.scaled(ca + cb, ra);
        }
        if let Node::Neg(inner) = self.node(b) {
            return self.sub(a, inner);
        }
        if let Node::Neg(inner) = self.node(a) {
            return self.sub(b, inner);
        }
        // (x - b) + b and (x + c1) + c2
        match (self.node(a), self.node(b)) {
            (Node::Binary(Op::Sub, x, y), _) if y == b => return x,
            (_, Node::Binary(Op::Sub, x, y)) if y == a => return x,
            _ => {}
        }
        if let Some(folded) = self
            .fold_constant_term(a, b, 1.0)
            .or_else(|| self.fold_constant_term(b, a, 1.0))
        {
            return folded;
        }
        let (lo, hi) = if a <= b { (a, b) } else { (b, a) };
        self.intern(Node::Binary(Op::Add, lo, hi))
    }

    /// `sum + sign * constant` where `sum` already has a constant term.
    fn fold_constant_term(&mut self, sum: Id, constant: Id, sign: f64) -> Option<Id> {
        let c = self.as_constant(constant)? * sign;
        match self.node(sum) {
            Node::Binary(Op::Add, x, y) => {
                let (k, rest) = match (self.as_constant(x), self.as_constant(y)) {
                    (Some(k), _) => (k, y),
                    (_, Some(k)) => (k, x),
                    _ => return None,
                };
                let k = self.constant(k + c);
                Some(self.add(rest, k))
            }
            Node::Binary(Op::Sub, x, y) => match (self.as_constant(x), self.as_constant(y)) {
                (Some(k), _) => {
                    let k = self.constant(k + c);
                    Some(self.sub(k, y))
                }
                (_, Some(k)) => {
                    let k = self.constant(c - k);
                    Some(self.add(x, k))
                }
                _ => None,
            },
            _ => None,
        }
    }

    pub fn sub(&mut self, a: Id, b: Id) -> Id {
        if let (Some(x), Some(y)) = (self.as_constant(a), self.as_constant(b)) {
            return self.constant(x - y);
        }
        if self.is_zero(b) {
            return a;
        }
        if self.is_zero(a) {
            return self.neg(b);
        }
        let ((ca, ra), (cb, rb)) = (self.split_factor(a), self.split_factor(b));
        if ra == rb {
            return self.scaled(ca - cb, ra);
        }
        if let Node::Neg(inner) = self.node(b) {
            return self.add(a, inner);
        }
        match self.node(a) {
            Node::Binary(Op::Add, x, y) if x == b => return y,
            Node::Binary(Op::Add, x, y) if y == b => return x,
            _ => {}
        }
        match self.node(b) {
            Node::Binary(Op::Add, x, y) if x == a => return self.neg(y),
            Node::Binary(Op::Add, x, y) if y == a => return self.neg(x),
            Node::Binary(Op::Sub, x, y) if x == a => return y,
            _ => {}
        }
        if let Some(folded) = self.fold_constant_term(a, b, -1.0) {
            return folded;
        }
        if let Some(c) = self.as_constant(b) {
            let c = self.constant(-c);
            return self.add(a, c);
        }
        self.intern(Node::Binary(Op::Sub, a, b))
    }

    pub fn neg(&mut self, a: Id) -> Id {
        match self.node(a) {
            Node::Const(bits) => self.constant(-f64::from_bits(bits)),
            Node::Neg(x) => x,
            Node::Binary(Op::Sub, x, y) => self.sub(y, x),
            Node::Binary(Op::Mul, x, y) if self.as_constant(x).is_some() => {
                let c = self.neg(x);
                self.mul(c, y)
            }
            Node::Binary(Op::Div, x, y) if self.as_constant(x).is_some() => {
                let c = self.neg(x);
                self.div(c, y)
            }
            _ => self.intern(Node::Neg(a)),
        }
    }

    pub fn mul(&mut self, a: Id, b: Id) -> Id {
        if let (Some(x), Some(y)) = (self.as_constant(a), self.as_constant(b)) {
            return self.constant(x * y);
        }
        // Exact zero times a finite expression; expressions which overflow are caught at run time
        // on the other factors.
        if self.is_zero(a) || self.is_zero(b) {
            return self.constant(0.0);
        }
        if self.is_one(a) {
            return b;
        }
        if self.is_one(b) {
            return a;
        }
        if self.as_constant(a) == Some(-1.0) {
            return self.neg(b);
        }
        if self.as_constant(b) == Some(-1.0) {
            return self.neg(a);
        }
        // Constants gather at the front: c * rest.
        let ((ca, ra), (cb, rb)) = (self.split_factor(a), self.split_factor(b));
        if let Some(x) = self.as_constant(a) {
            if cb != 1.0 {
                return self.scaled(x * cb, rb);
            }
            if let Node::Binary(Op::Div, n, d) = self.node(b)
                && let Some(n) = self.as_constant(n)
            {
                let n = self.constant(n * x);
                return self.div(n, d);
            }
            return self.intern(Node::Binary(Op::Mul, a, b));
        }
        if self.as_constant(b).is_some() {
            return self.mul(b, a);
        }
        if ca != 1.0 || cb != 1.0 {
            let product = self.mul(ra, rb);
            return self.scaled(ca * cb, product);
        }
        let ((ba, ea), (bb, eb)) = (self.as_power(a), self.as_power(b));
        if ba == bb {
            return self.powi(ba, ea + eb);
        }
        match (self.node(a), self.node(b)) {
            (Node::Unary(Fun::Sqrt, x), Node::Unary(Fun::Sqrt, y)) if x == y => return x,
            (Node::Binary(Op::Div, n, d), _) if d == b => return n,
            (_, Node::Binary(Op::Div, n, d)) if d == a => return n,
            _ => {}
        }
        let (lo, hi) = if a <= b { (a, b) } else { (b, a) };
        self.intern(Node::Binary(Op::Mul, lo, hi))
    }

    fn as_power(&self, a: Id) -> (Id, i32) {
        match self.node(a) {
            Node::Powi(b, n) => (b, n),
            _ => (a, 1),
        }
    }

    pub fn div(&mut self, a: Id, b: Id) -> Id {
        if let (Some(x), Some(y)) = (self.as_constant(a), self.as_constant(b)) {
            return self.constant(x / y);
        }
        if self.is_zero(a) || self.is_one(b) {
            return a;
        }
        if let Some(y) = self.as_constant(b).filter(|y| *y != 0.0) {
            let reciprocal = self.constant(1.0 / y);
            return self.mul(reciprocal, a);
        }
        let ((ca, ra), (cb, rb)) = (self.split_factor(a), self.split_factor(b));
        if ra == rb {
            return self.constant(ca / cb);
        }
        if cb != 1.0 && cb != 0.0 {
            let quotient = self.div(ra, rb);
            return self.scaled(ca / cb, quotient);
        }
        if ca != 1.0 && self.as_constant(a).is_none() {
            let quotient = self.div(ra, b);
            return self.scaled(ca, quotient);
        }
        let ((ba, ea), (bb, eb)) = (self.as_power(a), self.as_power(b));
        if ba == bb && ea > eb {
            return self.powi(ba, ea - eb);
        }
        self.intern(Node::Binary(Op::Div, a, b))
    }

    /// `a ^ n` for an integer `n`.
    pub fn powi(&mut self, a: Id, n: i32) -> Id {
        if let Some(x) = self.as_constant(a) {
            return self.constant(x.powi(n));
        }
        match n {
            0 => return self.constant(1.0),
            1 => return a,
            _ => {}
        }
        if n < 0 {
            let one = self.constant(1.0);
            let d = self.powi(a, -n);
            return self.div(one, d);
        }
        match self.node(a) {
            Node::Powi(b, m) => self.powi(b, m * n),
            Node::Neg(b) => {
                let p = self.powi(b, n);
                if n % 2 == 0 { p } else { self.neg(p) }
            }
            Node::Unary(Fun::Sqrt, b) if n % 2 == 0 => self.powi(b, n / 2),
            Node::Unary(Fun::Abs, b) if n % 2 == 0 => self.powi(b, n),
            Node::Binary(Op::Mul, c, b) if self.as_constant(c).is_some() => {
                let c = self.powi(c, n);
                let p = self.powi(b, n);
                self.mul(c, p)
            }
            _ => self.intern(Node::Powi(a, n)),
        }
    }

    /// `a ^ b`; integer and half-integer constant exponents become products and square roots.
    pub fn pow(&mut self, a: Id, b: Id) -> Id {
        if let Some(y) = self.as_constant(b) {
            if let Some(x) = self.as_constant(a) {
                return self.constant(x.powf(y));
            }
            if y.fract() == 0.0 && y.abs() <= 64.0 {
                return self.powi(a, y as i32);
            }
            if (2.0 * y).fract() == 0.0 && y.abs() <= 16.0 {
                let root = self.unary(Fun::Sqrt, a);
                return self.powi(root, (2.0 * y) as i32);
            }
        }
        self.intern(Node::Binary(Op::Pow, a, b))
    }

    pub fn unary(&mut self, f: Fun, a: Id) -> Id {
        if let Some(x) = self.as_constant(a) {
            return self.constant(f.apply(x));
        }
        if let Node::Neg(inner) = self.node(a) {
            match f {
                Fun::Sin | Fun::Tan | Fun::Asin | Fun::Atan | Fun::Sinh | Fun::Tanh | Fun::Sign => {
                    let v = self.unary(f, inner);
                    return self.neg(v);
                }
                Fun::Cos | Fun::Cosh | Fun::Abs => return self.unary(f, inner),
                _ => {}
            }
        }
        self.intern(Node::Unary(f, a))
    }

    pub fn min(&mut self, a: Id, b: Id) -> Id {
        self.extremum(Op::Min, a, b)
    }

    pub fn max(&mut self, a: Id, b: Id) -> Id {
        self.extremum(Op::Max, a, b)
    }

    fn extremum(&mut self, op: Op, a: Id, b: Id) -> Id {
        if a == b {
            return a;
        }
        if let (Some(x), Some(y)) = (self.as_constant(a), self.as_constant(b)) {
            let extremum = if op == Op::Min { least } else { greatest };
            return self.constant(extremum(x, y));
        }
        self.intern(Node::Binary(op, a, b))
    }

    /// Any two-argument operation through its simplifying constructor.
    pub fn binary(&mut self, op: Op, a: Id, b: Id) -> Id {
        match op {
            Op::Add => self.add(a, b),
            Op::Sub => self.sub(a, b),
            Op::Mul => self.mul(a, b),
            Op::Div => self.div(a, b),
            Op::Pow => self.pow(a, b),
            Op::Min => self.min(a, b),
            Op::Max => self.max(a, b),
        }
    }

    /// The angle of `(x, y)`, between -pi and pi: `2 atan(y / (sqrt(x^2 + y^2) + x))`, which has no
    /// value at its cut, y = 0 and x <= 0.
    pub fn atan2(&mut self, y: Id, x: Id) -> Id {
        if let (Some(y), Some(x)) = (self.as_constant(y), self.as_constant(x)) {
            return self.constant(y.atan2(x));
        }
        let squares = [x, y].map(|v| self.powi(v, 2));
        let square = self.sum(&squares);
        let length = self.unary(Fun::Sqrt, square);
        let sum = self.add(length, x);
        let half = self.div(y, sum);
        let angle = self.unary(Fun::Atan, half);
        let two = self.constant(2.0);
        self.mul(two, angle)
    }

    /// Sum of terms; zero for none.
    pub fn sum(&mut self, terms: &[Id]) -> Id {
        let zero = self.constant(0.0);
        terms.iter().fold(zero, |acc, &t| self.add(acc, t))
    }

    /// Arguments of a node, none for a leaf.
    pub fn arguments(&self, id: Id) -> impl Iterator<Item = Id> + use<> {
        let (a, b) = match self.node(id) {
            Node::Const(_) | Node::Symbol(_) => (None, None),
            Node::Neg(a) | Node::Unary(_, a) | Node::Powi(a, _) => (Some(a), None),
            Node::Binary(_, a, b) => (Some(a), Some(b)),
        };
        a.into_iter().chain(b)
    }

    /// All nodes that the roots depend on, arguments before their users.
    pub fn reachable(&self, roots: &[Id]) -> Vec<Id> {
        let mut seen = vec![false; self.nodes.len()];
        let mut stack: Vec<Id> = roots.to_vec();
        while let Some(id) = stack.pop() {
            if !std::mem::replace(&mut seen[id.0 as usize], true) {
                stack.extend(self.arguments(id));
            }
        }
        (0..self.nodes.len())
            .filter(|&i| seen[i])
            .map(|i| Id(i as u32))
            .collect()
    }

    /// Expressions at whose zeros a root has a kink or a jump: differences of the arguments of min
    /// and max, arguments of abs and sign.
    pub fn kinks(&mut self, roots: &[Id]) -> Vec<Id> {
        let mut found = Vec::new();
        for id in self.reachable(roots) {
            let at = match self.node(id) {
                Node::Binary(Op::Min | Op::Max, a, b) => self.sub(a, b),
                Node::Unary(Fun::Abs | Fun::Sign | Fun::Step, a) => a,
                _ => continue,
            };
            if self.as_constant(at).is_none() && !found.contains(&at) {
                found.push(at);
            }
        }
        found
    }

    /// Whether any root depends on `symbol`.
    pub fn depends_on(&self, roots: &[Id], symbol: Id) -> bool {
        self.reachable(roots).binary_search(&symbol).is_ok()
    }

    /// Rebuilds `roots` with each key of `map` replaced by its value.
    pub fn substitute(&mut self, roots: &[Id], map: &FxHashMap<Id, Id>) -> Vec<Id> {
        let mut new: FxHashMap<Id, Id> = FxHashMap::default();
        for id in self.reachable(roots) {
            let value = match map.get(&id) {
                Some(&v) => v,
                None => match self.node(id) {
                    Node::Const(_) | Node::Symbol(_) => id,
                    Node::Neg(a) => self.neg(new[&a]),
                    Node::Unary(f, a) => self.unary(f, new[&a]),
                    Node::Powi(a, n) => self.powi(new[&a], n),
                    Node::Binary(op, a, b) => self.binary(op, new[&a], new[&b]),
                },
            };
            new.insert(id, value);
        }
        roots.iter().map(|r| new[r]).collect()
    }
}
