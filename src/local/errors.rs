//! What the local solution's V and p may be off by at a state: the terms left out, what its
//! coefficients are known to, and the rounding of the sums.
//!
//! With `V_k` the part of degree k of V in z, `|V_k| <= C_k r^k` on the sphere of radius r gives
//! `|dV_k/dz| <= k C_k r^(k-1)` (O. D. Kellogg 1928), and so a bound of p's error from one of V's,
//! and of both from an error of z.

use super::seeds::LocalSolution;

/// See the module's text.
#[derive(Clone, Debug)]
pub struct LocalErrors {
    /// See [`LocalErrors::neglected`].
    neglected: Vec<(i32, f64)>,
    /// By degree, the sum of the absolute values of the coefficients kept: no monomial is above 1
    /// on the unit sphere.
    sizes: Vec<f64>,
    /// Relative error of the coefficients.
    coefficients: f64,
    /// Operations through which a term goes at most.
    operations: f64,
    /// Of `z = L's`, row-major, and the lengths of its columns: `|dp_j| <= |L_j| |dq|`.
    matrix: Vec<f64>,
    columns: Vec<f64>,
}

impl LocalErrors {
    pub fn new(local: &LocalSolution) -> Self {
        let n = local.riccati.p.nrows();
        let polynomial = local.polynomial(&vec![0.0; n]);
        let starts = local.starts();
        let sizes: Vec<f64> = (0..=polynomial.degree)
            .map(|k| {
                polynomial.coefficients[starts[k]..starts[k + 1]]
                    .iter()
                    .map(|c| c.abs())
                    .sum()
            })
            .collect();
        Self {
            neglected: local.neglected().to_vec(),
            sizes,
            coefficients: local.riccati.error,
            operations: (polynomial.coefficients.len() + polynomial.degree + n) as f64,
            columns: (0..n)
                .map(|j| {
                    (0..n)
                        .map(|i| polynomial.matrix[i * n + j].powi(2))
                        .sum::<f64>()
                        .sqrt()
                })
                .collect(),
            matrix: polynomial.matrix,
        }
    }

    /// Degrees and sizes, on the unit sphere, of the parts left out.
    pub fn neglected(&self) -> &[(i32, f64)] {
        &self.neglected
    }

    /// Bounds of the errors of V and of each component of p at a deviation s, given with the sizes
    /// of the numbers that it is a difference of; `unit` is the unit roundoff.
    pub fn at(&self, s: &[f64], sizes: &[f64], unit: f64, of_p: &mut [f64]) -> f64 {
        let n = s.len();
        let length = |product: &dyn Fn(usize, f64) -> f64| -> f64 {
            let z = (self.matrix.chunks_exact(n)).map(|row| {
                row.iter()
                    .enumerate()
                    .map(|(j, m)| product(j, *m))
                    .sum::<f64>()
            });
            z.map(|z| z * z).sum::<f64>().sqrt()
        };
        // What z is rounded by, and the largest that it may be.
        let off = (n as f64 + 2.0) * unit * length(&|j, m| (m * sizes[j]).abs());
        let r = off + length(&|j, m| m * s[j]);
        let relative = self.coefficients + self.operations * unit;
        let (mut v, mut q, mut most) = (0.0, 0.0, 0.0);
        // V begins with its quadratic part; r^(k-2).
        let mut power = 1.0;
        for (k, size) in self.sizes.iter().enumerate().skip(2) {
            let degree = k as f64;
            let bend = degree * (degree - 1.0) * size * power;
            let slope = degree * size * power * r;
            v += relative * size * power * r * r + off * slope;
            q += relative * slope + off * bend;
            most += slope;
            power *= r;
        }
        let (mut left_v, mut left_q) = (0.0f64, 0.0f64);
        for (k, size) in &self.neglected {
            left_v = left_v.max(size * r.powi(*k));
            left_q = left_q.max(f64::from(*k) * size * r.powi(*k - 1));
        }
        let all = left_q + q + n as f64 * unit * most;
        of_p.iter_mut()
            .zip(&self.columns)
            .for_each(|(p, column)| *p = column * all);
        left_v + v
    }
}
