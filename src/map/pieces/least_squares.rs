//! Dense linear least squares in rows of one coefficient each, with the orthogonal basis that leave-out errors are made of.

use crate::backend::cpu::Simd;

/// Of the unit diagonal, added to all: what the equations do not determine stays small.
const RIDGE: f64 = 1e-13;
/// Rows are padded to a multiple of this many equations.
pub const LANES: usize = 8;

/// Equations `sum_i c_i row_i = right`, one column an equation, to be solved by least squares.
pub struct Equations {
    /// `[coefficient][equation]`, each row `stride` long, zero behind the last equation.
    pub rows: Vec<f64>,
    pub right: Vec<f64>,
    pub stride: usize,
    pub coefficients: usize,
}

/// Their factors: with `rows = L basis` the basis is orthonormal, and the solution of the leading coefficients alone has
/// the leading entries of `along` as its components.
pub struct Factors {
    /// How many coefficients the equations determine.
    pub determined: usize,
    /// `[coefficient][equation]`.
    pub basis: Vec<f64>,
    /// Components of the right side along the basis.
    pub along: Vec<f64>,
    lower: Vec<f64>,
    scale: Vec<f64>,
    coefficients: usize,
}

pub fn stride(equations: usize) -> usize {
    equations.max(1).next_multiple_of(LANES)
}

impl Equations {
    /// The factors by Cholesky's method.
    pub fn factors(self) -> Factors {
        let mut factors = Factors {
            determined: self.coefficients,
            along: vec![0.0; self.coefficients],
            lower: vec![0.0; self.coefficients * self.coefficients],
            scale: vec![0.0; self.coefficients],
            coefficients: self.coefficients,
            basis: self.rows,
        };
        match Simd::detect() {
            Simd::Baseline => factors.fill::<false>(&self.right, self.stride),
            // SAFETY: the features were detected.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => unsafe { avx2(&mut factors, &self.right, self.stride) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => unsafe { avx512(&mut factors, &self.right, self.stride) },
        }
        factors
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2(factors: &mut Factors, right: &[f64], stride: usize) {
    factors.fill::<true>(right, stride);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
fn avx512(factors: &mut Factors, right: &[f64], stride: usize) {
    factors.fill::<true>(right, stride);
}

#[inline(always)]
fn add<const FMA: bool>(a: f64, b: f64, c: f64) -> f64 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// Inner products of a row with four others.
#[inline(always)]
fn products<const FMA: bool>(row: &[f64], others: [&[f64]; 4]) -> [f64; 4] {
    let mut sums = [[0.0; LANES]; 4];
    let [p, q, r, s] = others.map(|o| o.chunks_exact(LANES));
    for ((((a, p), q), r), s) in row.chunks_exact(LANES).zip(p).zip(q).zip(r).zip(s) {
        for i in 0..LANES {
            sums[0][i] = add::<FMA>(a[i], p[i], sums[0][i]);
            sums[1][i] = add::<FMA>(a[i], q[i], sums[1][i]);
            sums[2][i] = add::<FMA>(a[i], r[i], sums[2][i]);
            sums[3][i] = add::<FMA>(a[i], s[i], sums[3][i]);
        }
    }
    sums.map(|s| s.iter().sum())
}

/// Inner product of rows of any length.
#[inline(always)]
fn product<const FMA: bool>(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; LANES];
    let (whole, rest) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    let tail: f64 = whole.remainder().iter().zip(rest.remainder()).map(|(a, b)| a * b).sum();
    for (a, b) in whole.zip(rest) {
        for i in 0..LANES {
            sums[i] = add::<FMA>(a[i], b[i], sums[i]);
        }
    }
    sums.iter().sum::<f64>() + tail
}

/// The factor of a symmetric matrix of `m` rows (row-major; on and below the diagonal) in its place, as far as pivots are above
/// `least`; how far.
#[inline(always)]
fn factorized<const FMA: bool>(matrix: &mut [f64], m: usize, least: f64) -> usize {
    for i in 0..m {
        let (above, below) = matrix.split_at_mut(i * m);
        let own = &mut below[..m];
        for j in 0..i {
            let other = &above[j * m..][..=j];
            own[j] = (own[j] - product::<FMA>(&own[..j], &other[..j])) / other[j];
        }
        let pivot = own[i] - product::<FMA>(&own[..i], &own[..i]);
        if pivot <= least || !pivot.is_finite() {
            return i;
        }
        own[i] = pivot.sqrt();
    }
    m
}

impl Factors {
    #[inline(always)]
    fn fill<const FMA: bool>(&mut self, right: &[f64], stride: usize) {
        let m = self.coefficients;
        let row = |rows: &[f64], i: usize| -> std::ops::Range<usize> {
            debug_assert!((i + 1) * stride <= rows.len());
            i * stride..(i + 1) * stride
        };
        // Rows of very different sizes: scaled to unit length.
        for i in 0..m {
            let own = &self.basis[row(&self.basis, i)];
            let size = products::<FMA>(own, [own; 4])[0].sqrt();
            let scale = if size > 0.0 { size.recip() } else { 0.0 };
            self.scale[i] = scale;
            self.basis[i * stride..][..stride].iter_mut().for_each(|a| *a *= scale);
        }
        // Inner products on and below the diagonal, and with the right side.
        for i in 0..m {
            let own = &self.basis[row(&self.basis, i)];
            for j in (0..=i).step_by(4) {
                let four = std::array::from_fn(|k| &self.basis[row(&self.basis, (j + k).min(i))]);
                for (k, product) in products::<FMA>(own, four).into_iter().enumerate() {
                    if j + k <= i {
                        self.lower[i * m + j + k] = product;
                    }
                }
            }
            self.lower[i * m + i] += RIDGE;
            self.along[i] = products::<FMA>(own, [right; 4])[0];
        }
        self.determined = factorized::<FMA>(&mut self.lower, m, 0.0);
        for i in 0..self.determined {
            let lower = &self.lower[i * m..][..=i];
            self.along[i] = (self.along[i] - product::<FMA>(&lower[..i], &self.along[..i])) / lower[i];
        }
        // The basis in place of the rows.
        for i in 0..self.determined {
            let (before, own) = self.basis.split_at_mut(i * stride);
            let own = &mut own[..stride];
            let lower = &self.lower[i * m..][..m];
            let mut j = 0;
            while j + 4 <= i {
                let [a, b, c, d] = std::array::from_fn(|k| &before[(j + k) * stride..][..stride]);
                let [p, q, r, s] = std::array::from_fn(|k| -lower[j + k]);
                for e in 0..stride {
                    let far = add::<FMA>(r, c[e], s * d[e]);
                    own[e] = add::<FMA>(p, a[e], add::<FMA>(q, b[e], own[e] + far));
                }
                j += 4;
            }
            for j in j..i {
                let other = &before[j * stride..][..stride];
                for e in 0..stride {
                    own[e] = add::<FMA>(-lower[j], other[e], own[e]);
                }
            }
            let inverse = lower[i].recip();
            own.iter_mut().for_each(|a| *a *= inverse);
        }
    }

    /// The solution for the leading coefficients alone.
    pub fn solution(&self, count: usize) -> Vec<f64> {
        let m = self.coefficients;
        let mut x = self.along[..count].to_vec();
        for i in (0..count).rev() {
            let below: f64 = (i + 1..count).map(|k| self.lower[k * m + i] * x[k]).sum();
            x[i] = (x[i] - below) / self.lower[i * m + i];
        }
        x.iter_mut().zip(&self.scale).for_each(|(x, s)| *x *= s);
        x
    }
}

impl Factors {
    /// What the residuals of some equations would be had these been left out of the fit of the leading coefficients:
    /// `(I - Q Q') e = r` with the rows of the basis `Q` that are theirs. `None` where they determine a coefficient alone.
    pub fn left_out(&self, count: usize, right: &[f64], stride: usize, equations: &[usize]) -> Option<Vec<f64>> {
        match Simd::detect() {
            Simd::Baseline => self.without::<false>(count, right, stride, equations),
            // SAFETY: the features were detected.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => unsafe { avx2_without(self, count, right, stride, equations) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => unsafe { avx512_without(self, count, right, stride, equations) },
        }
    }

    #[inline(always)]
    fn without<const FMA: bool>(
        &self,
        count: usize,
        right: &[f64],
        stride: usize,
        equations: &[usize],
    ) -> Option<Vec<f64>> {
        /// Below this pivot the others say too little of a coefficient.
        const LEAST: f64 = 1e-8;
        let n = equations.len();
        // `[equation][coefficient]`, in rows of whole lanes.
        let width = count.next_multiple_of(LANES);
        let mut own = vec![0.0; n * width];
        for (i, basis) in self.basis.chunks_exact(stride).take(count).enumerate() {
            for (own, equation) in own.chunks_exact_mut(width).zip(equations) {
                own[i] = basis[*equation];
            }
        }
        let mut along = vec![0.0; width];
        along[..count].copy_from_slice(&self.along[..count]);
        let row = |k: usize| &own[k * width..][..width];
        // Not in a closure, which would not have the vector unit's instructions.
        let mut residual = vec![0.0; n];
        for k in 0..n {
            residual[k] = right[equations[k]] - product::<FMA>(&own[k * width..][..width], &along);
        }
        let mut matrix = vec![0.0; n * n];
        for i in 0..n {
            for j in (0..=i).step_by(4) {
                let four = std::array::from_fn(|k| row((j + k).min(i)));
                for (k, product) in products::<FMA>(row(i), four).into_iter().enumerate() {
                    if j + k <= i {
                        matrix[i * n + j + k] = -product;
                    }
                }
            }
            matrix[i * n + i] += 1.0;
        }
        if factorized::<FMA>(&mut matrix, n, LEAST) < n {
            return None;
        }
        for i in 0..n {
            let lower = &matrix[i * n..][..=i];
            residual[i] = (residual[i] - product::<FMA>(&lower[..i], &residual[..i])) / lower[i];
        }
        for i in (0..n).rev() {
            let sum: f64 = (i + 1..n).map(|k| matrix[k * n + i] * residual[k]).sum();
            residual[i] = (residual[i] - sum) / matrix[i * n + i];
        }
        Some(residual)
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2_without(of: &Factors, count: usize, right: &[f64], stride: usize, equations: &[usize]) -> Option<Vec<f64>> {
    of.without::<true>(count, right, stride, equations)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
fn avx512_without(of: &Factors, count: usize, right: &[f64], stride: usize, equations: &[usize]) -> Option<Vec<f64>> {
    of.without::<true>(count, right, stride, equations)
}
