//! Truncated power series in several variables, and Al'brekht's expansion of V about the
//! equilibrium.
//!
//! V is sought as a sum of homogeneous polynomials V_2 + V_3 + ...; the degree-k part of H(s,
//! dV/ds) = 0 is a linear equation for V_k (E. G. Al'brekht, On the optimal stabilization of
//! nonlinear systems, J. Appl. Math. Mech. 25, 1961).

use super::Riccati;
use crate::expr::{Fun, Graph, Id, Kind, Op};
use nalgebra::{DMatrix, DVector};
use rustc_hash::FxHashMap;

/// Monomials of up to a degree in some variables, and which products they form.
#[derive(Clone, Debug)]
pub struct Basis {
    pub variables: usize,
    pub degree: usize,
    /// Exponents, by rising total degree.
    pub exponents: Vec<Vec<u8>>,
    /// `start[k]..start[k + 1]` are the monomials of degree k.
    pub start: Vec<usize>,
    products: Vec<(u32, u32, u32)>,
    /// Each monomial after the first as a lower one times a variable.
    factors: Vec<(u32, u32)>,
}

impl Basis {
    pub fn new(variables: usize, degree: usize) -> Self {
        let mut exponents: Vec<Vec<u8>> = Vec::new();
        let mut start = vec![0];
        for k in 0..=degree {
            homogeneous(variables, k, &mut Vec::new(), &mut exponents);
            start.push(exponents.len());
        }
        let index: FxHashMap<&Vec<u8>, usize> =
            exponents.iter().enumerate().map(|(i, e)| (e, i)).collect();
        let mut products = Vec::new();
        for (i, a) in exponents.iter().enumerate() {
            let left = degree - a.iter().map(|n| usize::from(*n)).sum::<usize>();
            for (j, b) in exponents[..start[left + 1]].iter().enumerate() {
                let sum: Vec<u8> = a.iter().zip(b).map(|(x, y)| x + y).collect();
                products.push((i as u32, j as u32, index[&sum] as u32));
            }
        }
        let factors = (exponents.iter().skip(1))
            .map(|e| {
                let v = e.iter().position(|n| *n > 0).unwrap_or(0);
                let mut lower = e.clone();
                lower[v] -= 1;
                (index[&lower] as u32, v as u32)
            })
            .collect();
        Self {
            variables,
            degree,
            start,
            products,
            factors,
            exponents,
        }
    }

    /// Number of monomials of up to `degree` in `variables`.
    pub fn size(variables: usize, degree: usize) -> usize {
        (1..=degree).fold(1usize, |n, k| n * (variables + k) / k)
    }

    fn zero(&self) -> Vec<f64> {
        vec![0.0; self.exponents.len()]
    }

    fn constant(&self, c: f64) -> Vec<f64> {
        let mut p = self.zero();
        p[0] = c;
        p
    }

    fn multiply(&self, a: &[f64], b: &[f64]) -> Vec<f64> {
        let mut p = self.zero();
        for &(i, j, k) in &self.products {
            p[k as usize] += a[i as usize] * b[j as usize];
        }
        p
    }

    /// `sum coefficients[k] d^k` of a series without constant term.
    fn compose(&self, coefficients: &[f64], d: &[f64]) -> Vec<f64> {
        let mut p = self.constant(coefficients[coefficients.len() - 1]);
        for c in coefficients.iter().rev().skip(1) {
            p = self.multiply(&p, d);
            p[0] += c;
        }
        p
    }

    fn unary(&self, f: Fun, a: &[f64]) -> Vec<f64> {
        let mut d = a.to_vec();
        d[0] = 0.0;
        self.compose(&taylor(f, a[0], self.degree), &d)
    }

    fn divide(&self, a: &[f64], b: &[f64]) -> Vec<f64> {
        let c = b[0];
        let mut d = b.to_vec();
        d[0] = 0.0;
        let geometric: Vec<f64> = (0..=self.degree as i32)
            .map(|k| (-1f64).powi(k) / c.powi(k + 1))
            .collect();
        self.multiply(a, &self.compose(&geometric, &d))
    }

    /// Gradient by each variable.
    pub fn gradient(&self, p: &[f64]) -> Vec<Vec<f64>> {
        let index: FxHashMap<&Vec<u8>, usize> = self
            .exponents
            .iter()
            .enumerate()
            .map(|(i, e)| (e, i))
            .collect();
        (0..self.variables)
            .map(|v| {
                let mut g = self.zero();
                for (e, c) in self.exponents.iter().zip(p).filter(|(e, _)| e[v] > 0) {
                    let mut lower = e.clone();
                    lower[v] -= 1;
                    g[index[&lower]] += f64::from(e[v]) * c;
                }
                g
            })
            .collect()
    }

    /// Values of all monomials at a point.
    pub fn monomials(&self, z: &[f64]) -> Vec<f64> {
        let mut values = Vec::new();
        self.monomials_into(z, self.exponents.len(), &mut values);
        values
    }

    /// Values of the first `count` monomials at a point, into memory that is there.
    pub fn monomials_into(&self, z: &[f64], count: usize, values: &mut Vec<f64>) {
        values.clear();
        values.reserve(count);
        values.push(1.0);
        for (lower, v) in &self.factors[..count - 1] {
            values.push(values[*lower as usize] * z[*v as usize]);
        }
    }
}

fn homogeneous(variables: usize, degree: usize, prefix: &mut Vec<u8>, out: &mut Vec<Vec<u8>>) {
    if prefix.len() + 1 == variables {
        let mut e = prefix.clone();
        e.push(degree as u8);
        out.push(e);
        return;
    }
    for k in (0..=degree).rev() {
        prefix.push(k as u8);
        homogeneous(variables, degree - k, prefix, out);
        prefix.pop();
    }
}

/// Taylor coefficients of `f` at `c` up to `degree`, from its symbolic derivatives.
fn taylor(f: Fun, c: f64, degree: usize) -> Vec<f64> {
    let mut g = Graph::new();
    let x = g.symbol("x", Kind::State);
    let mut derivative = g.unary(f, x);
    let values = FxHashMap::from_iter([(x, c)]);
    let mut coefficients = Vec::new();
    let mut factorial = 1.0;
    for k in 0..=degree {
        if k > 0 {
            derivative = g.diff(derivative, x);
            factorial *= k as f64;
        }
        coefficients.push(g.eval(&[derivative], &values)[0] / factorial);
    }
    // A kink at the point itself has no series.
    if matches!(f, Fun::Abs | Fun::Sign | Fun::Step) && c == 0.0 {
        coefficients.fill(f64::NAN);
    }
    coefficients
}

/// H as a function of `(s, p)` whose symbols are `inputs` in order.
pub struct Equation<'a> {
    pub graph: &'a Graph,
    pub hamiltonian: Id,
    pub inputs: &'a [Id],
}

impl Equation<'_> {
    /// Series of H where each input is given as a series.
    fn series(&self, basis: &Basis, inputs: &FxHashMap<Id, Vec<f64>>) -> Vec<f64> {
        let result = self.graph.fold(
            &[self.hamiltonian],
            &mut |id| inputs[&id].clone(),
            &mut |c| basis.constant(c),
            &mut |f, a: &Vec<f64>| basis.unary(f, a),
            &mut |op, a, b| match op {
                Op::Add => a.iter().zip(b).map(|(x, y)| x + y).collect(),
                Op::Sub => a.iter().zip(b).map(|(x, y)| x - y).collect(),
                Op::Mul => basis.multiply(a, b),
                Op::Div => basis.divide(a, b),
                Op::Pow => {
                    let log = basis.unary(Fun::Log, a);
                    basis.unary(Fun::Exp, &basis.multiply(b, &log))
                }
                // Which branch holds near the point is decided at the point.
                Op::Min => (if a[0] <= b[0] { a } else { b }).clone(),
                Op::Max => (if a[0] >= b[0] { a } else { b }).clone(),
            },
        );
        result.into_iter().next().unwrap_or_else(|| basis.zero())
    }

    /// Coefficients of V in coordinates z, `s = t z`, through the basis's degree. Stops early, at
    /// the degree returned, where the equations have no series (a kink at the equilibrium).
    pub fn expand(&self, basis: &Basis, t: &DMatrix<f64>, riccati: &Riccati) -> (Vec<f64>, usize) {
        let n = basis.variables;
        let quadratic = rounded_identity(t.transpose() * &riccati.p * t);
        let mut v = basis.zero();
        for k in basis.start[2]..basis.start[3] {
            let e = &basis.exponents[k];
            let mut factors = (0..n).flat_map(|i| (0..e[i]).map(move |_| i));
            if let (Some(i), Some(j)) = (factors.next(), factors.next()) {
                v[k] = if i == j { 0.5 } else { 1.0 } * quadratic[(i, j)];
            }
        }
        let Some(inverse) = t.clone().try_inverse() else {
            return (v, 2);
        };
        let rate = &inverse * &riccati.closed_loop * t;
        for k in 3..=basis.degree {
            let q = basis.gradient(&v);
            let mut inputs = FxHashMap::default();
            for i in 0..n {
                let mut s = basis.zero();
                let mut p = basis.zero();
                for j in 0..n {
                    let mut e = vec![0u8; n];
                    e[j] = 1;
                    if let Some(at) = basis.exponents.iter().position(|x| *x == e) {
                        s[at] = t[(i, j)];
                    }
                    // p = t^-T q
                    p.iter_mut()
                        .zip(&q[j])
                        .for_each(|(p, q)| *p += inverse[(j, i)] * q);
                }
                inputs.insert(self.inputs[i], s);
                inputs.insert(self.inputs[n + i], p);
            }
            let h = self.series(basis, &inputs);
            let range = basis.start[k]..basis.start[k + 1];
            let right = -DVector::from_column_slice(&h[range.clone()]);
            let solution = drift_operator(basis, k, &rate).lu().solve(&right);
            match solution {
                Some(x) if x.iter().all(|c| c.is_finite()) => {
                    v[range].copy_from_slice(x.as_slice())
                }
                _ => return (v, k - 1),
            }
        }
        (v, basis.degree)
    }
}

/// Where t comes of P itself, `t'Pt` is the identity but for rounding.
fn rounded_identity(m: DMatrix<f64>) -> DMatrix<f64> {
    const ROUNDING: f64 = 1e-9;
    let identity = DMatrix::identity(m.nrows(), m.ncols());
    if (&m - &identity).amax() <= ROUNDING {
        identity
    } else {
        m
    }
}

/// Matrix of `V_k -> grad V_k . (rate z)` on homogeneous polynomials of degree k.
fn drift_operator(basis: &Basis, k: usize, rate: &DMatrix<f64>) -> DMatrix<f64> {
    let range = basis.start[k]..basis.start[k + 1];
    let size = range.len();
    let index: FxHashMap<&Vec<u8>, usize> = basis.exponents[range.clone()]
        .iter()
        .enumerate()
        .map(|(i, e)| (e, i))
        .collect();
    let mut m = DMatrix::zeros(size, size);
    for (col, e) in basis.exponents[range].iter().enumerate() {
        for i in 0..basis.variables {
            if e[i] == 0 {
                continue;
            }
            for j in 0..basis.variables {
                let mut moved = e.clone();
                moved[i] -= 1;
                moved[j] += 1;
                m[(index[&moved], col)] += f64::from(e[i]) * rate[(i, j)];
            }
        }
    }
    m
}
