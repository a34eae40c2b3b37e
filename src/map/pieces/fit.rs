//! A polynomial fitted to V and p at scattered points, by weighted least squares.

use super::terms::Terms;
use nalgebra::{DMatrix, DVector};

/// Of the largest diagonal entry, added to all: what the points do not determine stays small.
const RIDGE: f64 = 1e-13;

/// What is a polynomial: V itself, or a function of it that is smoother where V falls or rises steeply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
pub enum Shape {
    Value = 0,
    Root = 1,
    Logarithm = 2,
    Reciprocal = 3,
}

impl Shape {
    pub const ALL: [(Shape, &'static str); 4] = [
        (Shape::Value, "V"),
        (Shape::Root, "sqrt(V)"),
        (Shape::Logarithm, "log(V)"),
        (Shape::Reciprocal, "1/V"),
    ];

    /// The function and its derivative at V.
    pub fn of(self, v: f64) -> (f64, f64) {
        match self {
            Shape::Value => (v, 1.0),
            Shape::Root => (v.sqrt(), 0.5 / v.sqrt()),
            Shape::Logarithm => (v.ln(), 1.0 / v),
            Shape::Reciprocal => (1.0 / v, -1.0 / (v * v)),
        }
    }

    /// V and its derivative by the function.
    pub fn back(self, w: f64) -> (f64, f64) {
        match self {
            Shape::Value => (w, 1.0),
            Shape::Root => (w * w, 2.0 * w),
            Shape::Logarithm => (w.exp(), w.exp()),
            Shape::Reciprocal => (1.0 / w, -1.0 / (w * w)),
        }
    }

    /// Whether it is one-to-one for these V.
    pub fn serves(self, least: f64) -> bool {
        self == Shape::Value || least > 0.0
    }
}

/// Points with V and its gradient in the coordinates of a cell.
pub struct Data<'d> {
    pub terms: &'d Terms,
    /// Monomials `[point][term]` and slopes `[point][variable][term]` up to the highest degree asked for.
    values: Vec<f64>,
    slopes: Vec<f64>,
    v: Vec<f64>,
    /// `[point][variable]`.
    q: Vec<f64>,
    /// Size to which errors of V are relative.
    size: Vec<f64>,
    count: usize,
}

impl<'d> Data<'d> {
    /// Points `y` with `v` and its gradient by `y`, for polynomials up to a degree.
    pub fn new(
        terms: &'d Terms,
        degree: usize,
        floor: f64,
        points: impl Iterator<Item = (Vec<f64>, f64, Vec<f64>)>,
    ) -> Self {
        let (n, count) = (terms.variables, terms.upto[degree]);
        let mut this = Self {
            terms,
            values: Vec::new(),
            slopes: Vec::new(),
            v: Vec::new(),
            q: Vec::new(),
            size: Vec::new(),
            count,
        };
        for (y, v, q) in points {
            let at = this.values.len();
            this.values.resize(at + count, 0.0);
            let along = this.slopes.len();
            this.slopes.resize(along + n * count, 0.0);
            terms.at(&y, &mut this.values[at..], &mut this.slopes[along..]);
            this.v.push(v);
            this.q.extend(q);
            this.size.push(v.abs().max(floor));
        }
        this
    }

    pub fn len(&self) -> usize {
        self.v.len()
    }

    pub fn least(&self) -> f64 {
        self.v.iter().copied().fold(f64::INFINITY, f64::min)
    }

    /// Polynomials of all degrees up to one for a shape, from the lowest on; fewer where the points do not determine more.
    pub fn fits(&self, shape: Shape, degree: usize) -> Vec<Vec<f64>> {
        let (n, stride, m) = (self.terms.variables, self.count, self.terms.upto[degree]);
        // One equation a column.
        let mut equations = DMatrix::<f64>::zeros(m, self.len() * (n + 1));
        let mut wanted = DVector::<f64>::zeros(self.len() * (n + 1));
        let mut column = 0;
        let mut add = |row: &[f64], weight: f64, right: f64| {
            let mut equation = equations.column_mut(column);
            for (e, v) in equation.iter_mut().zip(row) {
                *e = weight * v;
            }
            wanted[column] = weight * right;
            column += 1;
        };
        for k in 0..self.len() {
            let (w, slope) = shape.of(self.v[k]);
            let weight = 1.0 / (self.size[k] * slope.abs());
            add(&self.values[k * stride..][..m], weight, w);
            for i in 0..n {
                let q = self.q[k * n + i];
                add(&self.slopes[(k * n + i) * stride..][..m], weight, slope * q);
            }
        }
        let right = &equations * wanted;
        let gram = &equations * equations.transpose();
        solved(gram, right, &self.terms.upto[..=degree])
    }

    /// Errors of V, relative to its size, and of its gradient, relative to the same.
    pub fn errors(&self, shape: Shape, coefficients: &[f64]) -> Vec<[f64; 2]> {
        let (n, stride, m) = (self.terms.variables, self.count, coefficients.len());
        let dot = |row: &[f64]| row[..m].iter().zip(coefficients).map(|(a, b)| a * b).sum::<f64>();
        (0..self.len())
            .map(|k| {
                let (v, slope) = shape.back(dot(&self.values[k * stride..]));
                let off = (0..n)
                    .map(|i| (slope * dot(&self.slopes[(k * n + i) * stride..]) - self.q[k * n + i]).abs())
                    .fold(0.0, f64::max);
                let error = (v - self.v[k]).abs() / self.size[k];
                // On the other branch of the shape V is something else.
                let wrong = shape == Shape::Root && dot(&self.values[k * stride..]) < 0.0;
                if error.is_finite() && !wrong {
                    [error, off / self.size[k]]
                } else {
                    [f64::INFINITY; 2]
                }
            })
            .collect()
    }
}

/// Solutions of the leading blocks of symmetric equations, of these sizes, by Cholesky's method: the factor of a leading block
/// is a leading block of the factor.
fn solved(mut gram: DMatrix<f64>, mut right: DVector<f64>, sizes: &[usize]) -> Vec<Vec<f64>> {
    let m = right.len();
    // Columns of very different sizes: scaled to a unit diagonal.
    let scale: Vec<f64> = (0..m)
        .map(|i| {
            if gram[(i, i)] > 0.0 {
                gram[(i, i)].sqrt().recip()
            } else {
                0.0
            }
        })
        .collect();
    for j in 0..m {
        for i in 0..m {
            gram[(i, j)] *= scale[i] * scale[j];
        }
        gram[(j, j)] += RIDGE;
        right[j] *= scale[j];
    }
    // Column by column, on and below the diagonal.
    let mut done = m;
    for j in 0..m {
        let (before, mut rest) = gram.columns_range_pair_mut(0..j, j..m);
        let mut column = rest.column_mut(0);
        for k in 0..j {
            let factor = before[(j, k)];
            if factor != 0.0 {
                for (c, b) in column.as_mut_slice()[j..]
                    .iter_mut()
                    .zip(&before.column(k).as_slice()[j..])
                {
                    *c -= factor * b;
                }
            }
        }
        let pivot = column[j];
        if pivot <= 0.0 || !pivot.is_finite() {
            done = j;
            break;
        }
        let inverse = pivot.sqrt().recip();
        for c in &mut column.as_mut_slice()[j..] {
            *c *= inverse;
        }
        right[j] *= inverse;
        let y = right[j];
        for (r, c) in right.as_mut_slice()[j + 1..]
            .iter_mut()
            .zip(&column.as_slice()[j + 1..])
        {
            *r -= y * c;
        }
    }
    (sizes.iter().filter(|size| **size <= done))
        .map(|&size| {
            let mut x = right.as_slice()[..size].to_vec();
            for i in (0..size).rev() {
                let below: f64 = (i + 1..size).map(|k| gram[(k, i)] * x[k]).sum();
                x[i] = (x[i] - below) / gram[(i, i)];
            }
            for (x, s) in x.iter_mut().zip(&scale) {
                *x *= s;
            }
            x
        })
        .filter(|x| x.iter().all(|x| x.is_finite()))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_polynomial_is_found_again_in_every_shape() {
        let terms = Terms::new(2, 4);
        let coefficients: Vec<f64> = (0..terms.upto[4])
            .map(|k| if k == 0 { 2.0 } else { 0.05 * (k as f64 * 1.7).cos() })
            .collect();
        for (shape, _) in Shape::ALL {
            let points = (0..24).map(|k| {
                let y = vec![
                    (f64::from(k) * 0.618).fract() * 2.0 - 1.0,
                    (f64::from(k) * 0.755).fract() * 2.0 - 1.0,
                ];
                let mut gradient = [0.0; 2];
                let w = terms.sum(&coefficients, &y, &mut gradient);
                let (v, slope) = shape.back(w);
                (y, v, gradient.iter().map(|g| slope * g).collect())
            });
            let data = Data::new(&terms, 4, 1e-3, points);
            let found = data.fits(shape, 4).pop().unwrap();
            assert_eq!(found.len(), 15);
            for (a, b) in found.iter().zip(&coefficients) {
                assert!((a - b).abs() < 1e-8, "{shape:?}: {a} {b}");
            }
            assert!(data.errors(shape, &found).iter().all(|e| e[0] < 1e-9 && e[1] < 1e-8));
        }
    }
}
