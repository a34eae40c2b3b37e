//! Taylor coefficients of a differential equation's solution by automatic differentiation of its
//! program: each instruction's normalized coefficients follow from those of its arguments by
//! recurrences (Jorba & Zou, "A software package for the numerical integration of ODEs by means of
//! high-order Taylor methods", Experimental Mathematics 14 (2005), section 2).

use super::arithmetic::{Arithmetic, Comparison};
use super::code::{Recorder, Value};
use crate::program::{Instr, Primitive, Program};
use rustc_hash::FxHashMap;

/// Orders looked at to see on which side of a kink a step begins.
const HINT: usize = 2;

/// Normalized coefficients in order; none where one is zero for certain.
pub type Series = Vec<Option<Value>>;

/// Coefficients of order 0 to `order` of the solution that begins at `y`.
pub fn solution(r: &mut Recorder, rate: &Program, y: &[Value], order: usize) -> Vec<Series> {
    let sides = if has_kinks(rate) && order > HINT {
        // Where the step begins on a kink, the coefficients that follow tell on which side it goes
        // on: those of a solution for which it is on neither.
        let first = follow(
            Nodes::new(r, rate, HINT, FxHashMap::default()),
            rate,
            y,
            HINT,
        );
        sides(r, rate, |k, n| first[k][n])
    } else {
        FxHashMap::default()
    };
    follow(Nodes::new(r, rate, order, sides), rate, y, order)
}

/// The solution's coefficients, each order from the one before.
fn follow(mut nodes: Nodes<'_>, rate: &Program, y: &[Value], order: usize) -> Vec<Series> {
    let mut solution: Vec<Series> = y.iter().map(|y| vec![Some(*y)]).collect();
    for n in 0..order {
        nodes.order(rate, n, |k| solution[k][n]);
        for (component, output) in solution.iter_mut().zip(&rate.outputs) {
            let value = nodes.series[*output as usize][n].map(|v| {
                let share = nodes.r.constant(1.0 / (n + 1) as f64);
                if n == 0 { v } else { nodes.r.mul(v, share) }
            });
            component.push(value);
        }
    }
    solution
}

fn has_kinks(program: &Program) -> bool {
    program.code.iter().any(|i| kink(*i).is_some())
}

/// The values whose difference (or the one whose sign) a kink depends on.
fn kink(instr: Instr) -> Option<(u32, Option<u32>)> {
    match instr {
        Instr::Min(a, b) | Instr::Max(a, b) => Some((a, Some(b))),
        Instr::Call(Primitive::Abs | Primitive::Sign | Primitive::Step, a) => Some((a, None)),
        _ => None,
    }
}

/// For each instruction with a kink a number of the sign that its argument has where the step has
/// just begun: its first coefficient that is not zero.
fn sides(
    r: &mut Recorder,
    program: &Program,
    input: impl Fn(usize, usize) -> Option<Value>,
) -> FxHashMap<usize, Value> {
    let mut nodes = Nodes::new(r, program, HINT, FxHashMap::default());
    for n in 0..=HINT {
        nodes.order(program, n, |k| input(k, n));
    }
    let zero = nodes.r.constant(0.0);
    let mut sides = FxHashMap::default();
    for (i, instr) in program.code.iter().enumerate() {
        let Some((a, b)) = kink(*instr) else { continue };
        let mut side = zero;
        for n in (0..=HINT).rev() {
            let other = b.and_then(|b| nodes.at(b, n));
            let value = nodes.sub(nodes.at(a, n), other).unwrap_or(zero);
            let nothing = nodes.r.compare(Comparison::Equal, value, zero);
            side = nodes.r.select(nothing, side, value);
        }
        sides.insert(i, side);
    }
    sides
}

/// Coefficients of a program's outputs along a solution.
pub fn along(
    r: &mut Recorder,
    program: &Program,
    solution: &[Series],
    order: usize,
) -> Vec<Series> {
    let sides = if has_kinks(program) && order > HINT {
        sides(r, program, |k, n| solution[k][n])
    } else {
        FxHashMap::default()
    };
    let mut nodes = Nodes::new(r, program, order, sides);
    for n in 0..=order {
        nodes.order(program, n, |k| solution[k][n]);
    }
    let take = |o: &u32| nodes.series[*o as usize].clone();
    program.outputs.iter().map(take).collect()
}

struct Nodes<'a> {
    r: &'a mut Recorder,
    series: Vec<Series>,
    /// `j * c_j`, by the instruction that needs them.
    scaled: Vec<Series>,
    /// A second series an instruction keeps: the cosine beside a sine, `1 + a^2` beside an
    /// arctangent.
    partner: Vec<Series>,
    /// What is the same at all orders: a reciprocal, a branch.
    fixed: Vec<Option<Value>>,
    /// The sides of kinks, where they are known.
    sides: FxHashMap<usize, Value>,
}

impl<'a> Nodes<'a> {
    fn new(
        r: &'a mut Recorder,
        program: &Program,
        order: usize,
        sides: FxHashMap<usize, Value>,
    ) -> Self {
        let count = program.code.len();
        Self {
            r,
            series: vec![Vec::with_capacity(order + 1); count],
            scaled: vec![Vec::new(); count],
            partner: vec![Vec::new(); count],
            fixed: vec![None; count],
            sides,
        }
    }

    /// Coefficient `n` of all instructions, from those of the inputs.
    fn order(&mut self, program: &Program, n: usize, input: impl Fn(usize) -> Option<Value>) {
        for (i, instr) in program.code.iter().enumerate() {
            let value = match *instr {
                Instr::Input(k) => input(k as usize),
                _ => self.next(i, *instr, n),
            };
            self.series[i].push(value);
        }
    }

    fn at(&self, v: u32, n: usize) -> Option<Value> {
        self.series[v as usize][n]
    }

    fn add(&mut self, a: Option<Value>, b: Option<Value>) -> Option<Value> {
        match (a, b) {
            (Some(a), Some(b)) => Some(self.r.add(a, b)),
            (a, b) => a.or(b),
        }
    }

    fn sub(&mut self, a: Option<Value>, b: Option<Value>) -> Option<Value> {
        match (a, b) {
            (Some(a), Some(b)) => Some(self.r.sub(a, b)),
            (None, Some(b)) => Some(self.r.neg(b)),
            (a, None) => a,
        }
    }

    fn mul(&mut self, a: Option<Value>, b: Option<Value>) -> Option<Value> {
        Some(self.r.mul(a?, b?))
    }

    fn scale(&mut self, a: Option<Value>, by: f64) -> Option<Value> {
        let by = self.r.constant(by);
        Some(self.r.mul(a?, by))
    }

    /// `sum + a*b`
    fn mul_add(&mut self, a: Option<Value>, b: Option<Value>, sum: Option<Value>) -> Option<Value> {
        match (a, b, sum) {
            (Some(a), Some(b), Some(sum)) => Some(self.r.mul_add(a, b, sum)),
            (Some(a), Some(b), None) => Some(self.r.mul(a, b)),
            _ => sum,
        }
    }

    /// `sum of a_j b_(n-j)` over `first <= j <= last`, twice over where that is the same (a = b).
    fn convolution(
        &mut self,
        a: &Series,
        b: &Series,
        n: usize,
        js: std::ops::RangeInclusive<usize>,
    ) -> Option<Value> {
        let mut sum = None;
        for j in js {
            sum = self.mul_add(a[j], b[n - j], sum);
        }
        sum
    }

    fn product(&mut self, a: u32, b: u32, n: usize) -> Option<Value> {
        let (x, y) = (
            self.series[a as usize].clone(),
            self.series[b as usize].clone(),
        );
        if a != b || n == 0 {
            return self.convolution(&x, &y, n, 0..=n);
        }
        self.square(&x, n, 0)
    }

    /// `sum of a_j a_(n-j)` over `first <= j <= n - first`.
    fn square(&mut self, a: &Series, n: usize, first: usize) -> Option<Value> {
        let mut sum = None;
        for j in first..n.div_ceil(2) {
            sum = self.mul_add(a[j], a[n - j], sum);
        }
        let twice = sum.map(|s| self.r.add(s, s));
        if n.is_multiple_of(2) && n / 2 >= first {
            self.mul_add(a[n / 2], a[n / 2], twice)
        } else {
            twice
        }
    }

    /// Coefficient `n` of instruction `i`; those of lower order, and those of its arguments, are
    /// there.
    fn next(&mut self, i: usize, instr: Instr, n: usize) -> Option<Value> {
        match instr {
            Instr::Input(_) => None,
            Instr::Const(c) => (n == 0).then(|| self.r.constant(c)),
            Instr::Add(a, b) => self.add(self.at(a, n), self.at(b, n)),
            Instr::Sub(a, b) => self.sub(self.at(a, n), self.at(b, n)),
            Instr::Neg(a) => self.at(a, n).map(|a| self.r.neg(a)),
            Instr::Mul(a, b) => self.product(a, b, n),
            Instr::MulAdd(a, b, c) => {
                let product = self.product(a, b, n);
                self.add(product, self.at(c, n))
            }
            Instr::MulSub(a, b, c) => {
                let product = self.product(a, b, n);
                self.sub(product, self.at(c, n))
            }
            Instr::NegMulAdd(a, b, c) => {
                let product = self.product(a, b, n);
                self.sub(self.at(c, n), product)
            }
            Instr::Div(a, b) => self.quotient(i, a, b, n),
            Instr::Min(a, b) => self.branch(i, a, b, n, true),
            Instr::Max(a, b) => self.branch(i, a, b, n, false),
            Instr::Call(f, a) => self.call(i, f, a, n),
        }
    }

    fn quotient(&mut self, i: usize, a: u32, b: u32, n: usize) -> Option<Value> {
        let (top, bottom) = (self.at(a, n), self.at(b, 0)?);
        if n == 0 {
            return top.map(|t| self.r.div(t, bottom));
        }
        let (own, b) = (self.series[i].clone(), self.series[b as usize].clone());
        // b_j q_(n-j) for j from 1; own has n entries.
        let mut sum = None;
        for j in 1..=n {
            sum = self.mul_add(b[j], own[n - j], sum);
        }
        let rest = self.sub(top, sum);
        rest.map(|rest| {
            let inverse = *self.fixed[i].get_or_insert_with(|| {
                let one = self.r.constant(1.0);
                self.r.div(one, bottom)
            });
            self.r.mul(rest, inverse)
        })
    }

    /// The smaller or larger one. Where both begin alike, what they do next decides: a step begins
    /// at a kink only when the one before has ended there.
    fn branch(&mut self, i: usize, a: u32, b: u32, n: usize, smaller: bool) -> Option<Value> {
        let zero = self.r.constant(0.0);
        let (x, y) = (self.at(a, n), self.at(b, n));
        if x.is_none() && y.is_none() {
            return None;
        }
        let (x, y) = (x.unwrap_or(zero), y.unwrap_or(zero));
        if n == 0 {
            return Some(if smaller {
                self.r.least(x, y)
            } else {
                self.r.greatest(x, y)
            });
        }
        if let (Some(side), None) = (self.sides.get(&i), self.fixed[i]) {
            self.fixed[i] = Some(self.r.compare(Comparison::Less, *side, zero));
        }
        if self.fixed[i].is_none() {
            let pair =
                |this: &Self, n| (this.at(a, n).unwrap_or(zero), this.at(b, n).unwrap_or(zero));
            let ((a0, b0), (a1, b1)) = (pair(self, 0), pair(self, 1));
            let before = self.r.compare(Comparison::Less, a0, b0);
            let tie = self.r.compare(Comparison::Equal, a0, b0);
            let after = self.r.compare(Comparison::Less, a1, b1);
            self.fixed[i] = Some(self.r.select(tie, after, before));
        }
        self.fixed[i].map(|less| {
            if smaller {
                self.r.select(less, x, y)
            } else {
                self.r.select(less, y, x)
            }
        })
    }

    /// `j * c_j` of a value, kept with instruction `i`, up to order `n`.
    fn derivatives(&mut self, i: usize, a: u32, n: usize) -> Series {
        while self.scaled[i].len() <= n {
            let j = self.scaled[i].len();
            let value = self.at(a, j);
            let next = if j == 1 {
                value
            } else {
                self.scale(value, j as f64)
            };
            self.scaled[i].push(if j == 0 { None } else { next });
        }
        self.scaled[i].clone()
    }

    fn call(&mut self, i: usize, f: Primitive, a: u32, n: usize) -> Option<Value> {
        let zero = self.r.constant(0.0);
        let first = self.at(a, 0).unwrap_or(zero);
        match f {
            Primitive::Sin | Primitive::Cos => self.sine(i, f == Primitive::Sin, a, n),
            Primitive::Exp | Primitive::Expm1 => self.exponential(i, (f, first), a, n),
            Primitive::Log | Primitive::Log1p => self.logarithm(i, (f, first), a, n),
            Primitive::Atan => self.arctangent(i, first, a, n),
            Primitive::Sqrt => self.root(i, (first, zero), a, n),
            Primitive::Abs => self.absolute(i, (first, zero), a, n),
            Primitive::Sign | Primitive::Step => (n == 0).then(|| {
                let side = self.sides.get(&i).copied().unwrap_or(first);
                self.r.call(f, side)
            }),
        }
    }

    /// `n e_n = sum of j a_j e_(n-j)`.
    fn exponential(
        &mut self,
        i: usize,
        (f, first): (Primitive, Value),
        a: u32,
        n: usize,
    ) -> Option<Value> {
        if n == 0 {
            let value = self.r.call(f, first);
            // e_j of the exponential itself.
            self.partner[i] = vec![Some(if f == Primitive::Exp {
                value
            } else {
                let one = self.r.constant(1.0);
                self.r.add(value, one)
            })];
            return Some(value);
        }
        let slopes = self.derivatives(i, a, n);
        let own = self.partner[i].clone();
        let sum = self.convolution(&slopes, &own, n, 1..=n);
        let value = self.scale(sum, 1.0 / n as f64);
        self.partner[i].push(value);
        value
    }

    /// `n l_n = (n a_n - sum of j l_j a_(n-j)) / a_0`; `j l_j` are kept as `partner`.
    fn logarithm(
        &mut self,
        i: usize,
        (f, first): (Primitive, Value),
        a: u32,
        n: usize,
    ) -> Option<Value> {
        if n == 0 {
            return Some(self.r.call(f, first));
        }
        let one = self.r.constant(1.0);
        let inverse = match self.fixed[i] {
            Some(inverse) => inverse,
            None => {
                let whole = if f == Primitive::Log {
                    first
                } else {
                    self.r.add(first, one)
                };
                let inverse = self.r.div(one, whole);
                self.fixed[i] = Some(inverse);
                inverse
            }
        };
        if n == 1 {
            self.partner[i] = vec![None];
        }
        let (own, b) = (self.partner[i].clone(), self.series[a as usize].clone());
        let sum = self.convolution(&own, &b, n, 1..=n - 1);
        let slope = self.scale(self.at(a, n), n as f64);
        let rest = self.sub(slope, sum);
        let scaled = self.mul(rest, Some(inverse));
        self.partner[i].push(scaled);
        self.scale(scaled, 1.0 / n as f64)
    }

    /// With `g = 1 + a^2`: `n t_n = (n a_n - sum of j t_j g_(n-j)) / g_0`; `j t_j` are kept as
    /// `scaled`.
    fn arctangent(&mut self, i: usize, first: Value, a: u32, n: usize) -> Option<Value> {
        let series = self.series[a as usize].clone();
        let one = self.r.constant(1.0);
        let square = if n == 0 {
            let square = self.mul(series[0], series[0]);
            self.add(square, Some(one))
        } else {
            self.square(&series, n, 0)
        };
        self.partner[i].push(square);
        if n == 0 {
            self.fixed[i] = square.map(|g| self.r.div(one, g));
            self.scaled[i].push(None);
            return Some(self.r.call(Primitive::Atan, first));
        }
        let (own, g) = (self.scaled[i].clone(), self.partner[i].clone());
        let sum = self.convolution(&own, &g, n, 1..=n - 1);
        let slope = self.scale(self.at(a, n), n as f64);
        let rest = self.sub(slope, sum);
        let scaled = self.mul(rest, self.fixed[i]);
        self.scaled[i].push(scaled);
        self.scale(scaled, 1.0 / n as f64)
    }

    /// `2 r_0 r_n = a_n - sum of r_j r_(n-j)`, j from 1 to n - 1.
    fn root(&mut self, i: usize, (first, zero): (Value, Value), a: u32, n: usize) -> Option<Value> {
        if n == 0 {
            return Some(self.r.sqrt(first));
        }
        let root = self.at_own(i, 0, zero);
        let half = *self.fixed[i].get_or_insert_with(|| {
            let half = self.r.constant(0.5);
            self.r.div(half, root)
        });
        let own = self.series[i].clone();
        let sum = self.square(&own, n, 1);
        let rest = self.sub(self.at(a, n), sum);
        self.mul(rest, Some(half))
    }

    fn absolute(
        &mut self,
        i: usize,
        (first, zero): (Value, Value),
        a: u32,
        n: usize,
    ) -> Option<Value> {
        if n == 0 {
            return Some(self.r.abs(first));
        }
        let value = self.at(a, n)?;
        let sign = match self.fixed[i] {
            Some(sign) => sign,
            None => {
                // The sign of what comes first and is not zero.
                let second = self.at(a, 1).unwrap_or(zero);
                let nothing = self.r.compare(Comparison::Equal, first, zero);
                let either = self.r.select(nothing, second, first);
                let leading = self.sides.get(&i).copied().unwrap_or(either);
                let bit = self.r.sign_bit();
                let sign = self.r.and(leading, bit);
                self.fixed[i] = Some(sign);
                sign
            }
        };
        Some(self.r.xor(value, sign))
    }

    fn at_own(&self, i: usize, n: usize, zero: Value) -> Value {
        self.series[i][n].unwrap_or(zero)
    }

    /// A sine keeps its cosine as partner, and the other way round; equal operations are recorded
    /// once.
    fn sine(&mut self, i: usize, sine: bool, a: u32, n: usize) -> Option<Value> {
        let zero = self.r.constant(0.0);
        if n == 0 {
            let first = self.at(a, 0).unwrap_or(zero);
            let (s, c) = self.r.sin_cos(first);
            let (own, other) = if sine { (s, c) } else { (c, s) };
            self.partner[i] = vec![Some(other)];
            return Some(own);
        }
        let slopes = self.derivatives(i, a, n);
        let (own, other) = (self.series[i].clone(), self.partner[i].clone());
        let s = if sine { &own } else { &other };
        let c = if sine { &other } else { &own };
        // n s_n = sum of j a_j c_(n-j); n c_n = -sum of j a_j s_(n-j).
        let up = self.convolution(&slopes, c, n, 1..=n);
        let down = self.convolution(&slopes, s, n, 1..=n);
        let (s, c) = (
            self.scale(up, 1.0 / n as f64),
            self.scale(down, -1.0 / n as f64),
        );
        let (own, other) = if sine { (s, c) } else { (c, s) };
        self.partner[i].push(other);
        own
    }
}
