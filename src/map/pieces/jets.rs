//! Polynomials of many places at once, with their first and second derivatives.
//!
//! Monomials are divided powers `y^k / k!`, whose derivatives are again divided powers without a
//! factor: all derivatives are sums of coefficients times the same monomials.

use super::terms::{MOST_DEGREE, MOST_VARIABLES, Terms};
use crate::backend::cpu::lanes::Lanes;
use crate::backend::cpu::real::Real;
use std::collections::BTreeMap;

/// Entries of a triangle of second derivatives.
pub const MOST_SECOND: usize = MOST_VARIABLES * (MOST_VARIABLES + 1) / 2;

/// Which coefficient a derivative takes with which monomial; all of one number of variables.
#[derive(Clone, Debug)]
pub struct Tables {
    /// Number of monomials up to each degree.
    pub upto: Vec<usize>,
    /// Earlier monomial, variable and its power in each monomial.
    pub factors: Vec<(u16, u8, u8)>,
    /// `[term][variable]`: the term times a variable, below the highest degree.
    pub first: Vec<u16>,
    /// `[term][pair]`: the term times two variables, the triangle `i <= j` row by row.
    pub second: Vec<u16>,
    /// Factorials by which a monomial differs from its divided powers.
    pub scale: Vec<f64>,
}

impl Tables {
    pub fn new(terms: &Terms) -> Self {
        let n = terms.variables;
        let count = terms.factors.len();
        let powers = |t: usize| terms.powers_of(t);
        let index: BTreeMap<&[u8], u16> = (0..count).map(|t| (powers(t), t as u16)).collect();
        let times = |t: usize, axes: &[usize]| -> u16 {
            let mut product = powers(t).to_vec();
            axes.iter().for_each(|i| product[*i] += 1);
            index[product.as_slice()]
        };
        let below = |less: usize| {
            (terms.upto.len() > less).then(|| terms.upto[terms.upto.len() - 1 - less])
        };
        let factorial = |k: u8| (1..=k).map(f64::from).product::<f64>();
        Self {
            upto: terms.upto.clone(),
            factors: (0..count)
                .map(|t| {
                    let (parent, axis) = terms.factors[t];
                    (parent, axis, powers(t)[usize::from(axis)])
                })
                .collect(),
            first: (0..below(1).unwrap_or(0))
                .flat_map(|t| (0..n).map(move |i| (t, i)))
                .map(|(t, i)| times(t, &[i]))
                .collect(),
            second: (0..below(2).unwrap_or(0))
                .flat_map(|t| (0..n).flat_map(move |i| (i..n).map(move |j| (t, i, j))))
                .map(|(t, i, j)| times(t, &[i, j]))
                .collect(),
            scale: (0..count)
                .map(|t| powers(t).iter().map(|k| factorial(*k)).product())
                .collect(),
        }
    }
}

/// Polynomials and their derivatives, one a lane.
#[derive(Clone, Copy, Debug)]
pub struct Jet<T, const W: usize> {
    pub v: Lanes<T, W>,
    pub q: [Lanes<T, W>; MOST_VARIABLES],
    /// The triangle `i <= j`, row by row.
    pub h: [Lanes<T, W>; MOST_SECOND],
}

impl<T: Real, const W: usize> Jet<T, W> {
    pub fn zero() -> Self {
        let zero = Lanes::splat(T::of(0.0));
        Self {
            v: zero,
            q: [zero; MOST_VARIABLES],
            h: [zero; MOST_SECOND],
        }
    }
}

/// Makes q of `M'q`, and h of `M'hM` where there is one (a triangle `i <= j`, row by row):
/// derivatives by x of a function of `z = M x` whose derivatives by z they are. V is a number or
/// lanes of them; `add` adds a multiple of the third to the first.
#[inline(always)]
pub fn by_states<T: Real, V: Copy>(
    n: usize,
    matrix: &[T],
    zero: V,
    add: impl Fn(&mut V, T, &V),
    q: &mut [V; MOST_VARIABLES],
    h: Option<&mut [V; MOST_SECOND]>,
) {
    let m = |i: usize, j: usize| matrix[i * n + j];
    let mut p = [zero; MOST_VARIABLES];
    for j in 0..n {
        for i in 0..n {
            add(&mut p[j], m(i, j), &q[i]);
        }
    }
    *q = p;
    let Some(h) = h else { return };
    // By way of hM.
    let mut half = [[zero; MOST_VARIABLES]; MOST_VARIABLES];
    let mut pair = 0;
    for i in 0..n {
        for k in i..n {
            for j in 0..n {
                add(&mut half[i][j], m(k, j), &h[pair]);
                if k != i {
                    add(&mut half[k][j], m(i, j), &h[pair]);
                }
            }
            pair += 1;
        }
    }
    let mut pair = 0;
    for a in 0..n {
        for b in a..n {
            let mut sum = zero;
            for i in 0..n {
                add(&mut sum, m(i, a), &half[i][b]);
            }
            h[pair] = sum;
            pair += 1;
        }
    }
}

/// What is summed: coefficients `[term]` with a value a lane, and room for the monomials.
pub struct Sum<'a, T, const W: usize> {
    pub tables: &'a Tables,
    pub degree: usize,
    pub coefficients: &'a [Lanes<T, W>],
    pub monomials: &'a mut [Lanes<T, W>],
}

impl<T: Real, const W: usize> Sum<'_, T, W> {
    /// At `y`, one place a lane; second derivatives only where asked for.
    #[inline(always)]
    pub fn at<const FMA: bool>(
        self,
        n: usize,
        y: &[Lanes<T, W>; MOST_VARIABLES],
        second: bool,
        to: &mut Jet<T, W>,
    ) {
        // The number of variables is a constant of the loops: their sums stay in registers.
        match n {
            1 => self.of::<1, 1, FMA>(y, second, to),
            2 => self.of::<2, 3, FMA>(y, second, to),
            3 => self.of::<3, 6, FMA>(y, second, to),
            4 => self.of::<4, 10, FMA>(y, second, to),
            5 => self.of::<5, 15, FMA>(y, second, to),
            _ => self.of::<6, 21, FMA>(y, second, to),
        }
    }

    #[inline(always)]
    fn of<const N: usize, const PAIRS: usize, const FMA: bool>(
        self,
        y: &[Lanes<T, W>; MOST_VARIABLES],
        second: bool,
        to: &mut Jet<T, W>,
    ) {
        let zero: Lanes<T, W> = Lanes::splat(T::of(0.0));
        let Self {
            tables,
            degree,
            coefficients: c,
            monomials: m,
        } = self;
        // `[power - 1][variable]`: y / power.
        let mut parts = [[zero; N]; MOST_DEGREE];
        for (k, part) in parts[..degree.min(MOST_DEGREE)].iter_mut().enumerate() {
            let inverse = T::of(1.0 / (k as f64 + 1.0));
            for i in 0..N {
                for l in 0..W {
                    part[i].0[l] = y[i].0[l] * inverse;
                }
            }
        }
        let count = tables.upto[degree];
        // The highest derivatives are summed, from which the others follow: the highest monomials
        // are not needed.
        let needed = tables.upto[degree.saturating_sub(if second { 2 } else { 1 })];
        let (c, m) = (&c[..count], &mut m[..count]);
        m[0] = Lanes::splat(T::of(1.0));
        for (t, (parent, axis, power)) in tables.factors[..needed].iter().enumerate().skip(1) {
            let (a, b) = (
                m[usize::from(*parent)],
                parts[usize::from(*power) - 1][usize::from(*axis)],
            );
            for l in 0..W {
                m[t].0[l] = a.0[l] * b.0[l];
            }
        }
        if second {
            by_parts::<T, W, N, PAIRS, FMA>(tables, degree, c, m, y, to);
            return;
        }
        by_slopes::<T, W, N, FMA>(tables, degree, c, m, y, to);
    }
}

/// Sums of all first derivatives, one degree after the other, from which V follows: the part of
/// degree k of a function is `1/k` times its gradient times y (Euler).
#[inline(always)]
fn by_slopes<T: Real, const W: usize, const N: usize, const FMA: bool>(
    tables: &Tables,
    degree: usize,
    c: &[Lanes<T, W>],
    m: &[Lanes<T, W>],
    y: &[Lanes<T, W>; MOST_VARIABLES],
    to: &mut Jet<T, W>,
) {
    let zero = Lanes::splat(T::of(0.0));
    let (mut v, mut q) = (c[0], [zero; N]);
    let mut first = 0;
    for k in 1..=degree {
        // First derivatives of degree k - 1.
        let end = tables.upto[k - 1];
        let mut part = [zero; N];
        let nexts = tables.first[first * N..end * N].chunks_exact(N);
        for (next, m) in nexts.zip(&m[first..end]) {
            for i in 0..N {
                let c = &c[usize::from(next[i])];
                for l in 0..W {
                    part[i].0[l] = c.0[l].mul_add::<FMA>(m.0[l], part[i].0[l]);
                }
            }
        }
        let share = T::of(1.0 / k as f64);
        let mut more = zero;
        for i in 0..N {
            for l in 0..W {
                q[i].0[l] = q[i].0[l] + part[i].0[l];
                more.0[l] = part[i].0[l].mul_add::<FMA>(y[i].0[l], more.0[l]);
            }
        }
        for l in 0..W {
            v.0[l] = more.0[l].mul_add::<FMA>(share, v.0[l]);
        }
        first = end;
    }
    to.v = v;
    to.q[..N].copy_from_slice(&q);
}

/// The same with second derivatives, from which those of first order follow too.
#[inline(always)]
fn by_parts<T: Real, const W: usize, const N: usize, const PAIRS: usize, const FMA: bool>(
    tables: &Tables,
    degree: usize,
    c: &[Lanes<T, W>],
    m: &[Lanes<T, W>],
    y: &[Lanes<T, W>; MOST_VARIABLES],
    to: &mut Jet<T, W>,
) {
    let zero = Lanes::splat(T::of(0.0));
    let (mut v, mut q, mut h) = (c[0], [zero; N], [zero; PAIRS]);
    if degree > 0 {
        for i in 0..N {
            q[i] = c[usize::from(tables.first[i])];
            for l in 0..W {
                v.0[l] = q[i].0[l].mul_add::<FMA>(y[i].0[l], v.0[l]);
            }
        }
    }
    let mut first = 0;
    for k in 1..degree {
        // Second derivatives of degree k - 1.
        let end = tables.upto[k - 1];
        let mut part = [zero; PAIRS];
        let nexts = tables.second[first * PAIRS..end * PAIRS].chunks_exact(PAIRS);
        for (next, m) in nexts.zip(&m[first..end]) {
            for pair in 0..PAIRS {
                let c = &c[usize::from(next[pair])];
                for l in 0..W {
                    part[pair].0[l] = c.0[l].mul_add::<FMA>(m.0[l], part[pair].0[l]);
                }
            }
        }
        let mut slope = [zero; N];
        let mut pair = 0;
        for i in 0..N {
            for j in i..N {
                let own = part[pair];
                for l in 0..W {
                    h[pair].0[l] = h[pair].0[l] + own.0[l];
                    slope[i].0[l] = own.0[l].mul_add::<FMA>(y[j].0[l], slope[i].0[l]);
                }
                if i != j {
                    for l in 0..W {
                        slope[j].0[l] = own.0[l].mul_add::<FMA>(y[i].0[l], slope[j].0[l]);
                    }
                }
                pair += 1;
            }
        }
        let (of_slope, of_value) = (T::of(1.0 / k as f64), T::of(1.0 / (k * (k + 1)) as f64));
        let mut more = zero;
        for i in 0..N {
            for l in 0..W {
                q[i].0[l] = slope[i].0[l].mul_add::<FMA>(of_slope, q[i].0[l]);
                more.0[l] = slope[i].0[l].mul_add::<FMA>(y[i].0[l], more.0[l]);
            }
        }
        for l in 0..W {
            v.0[l] = more.0[l].mul_add::<FMA>(of_value, v.0[l]);
        }
        first = end;
    }
    to.v = v;
    to.q[..N].copy_from_slice(&q);
    to.h[..PAIRS].copy_from_slice(&h);
}
