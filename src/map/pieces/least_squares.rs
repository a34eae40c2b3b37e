//! Dense linear least squares, with the orthogonal basis that leave-out errors are made of.

use crate::backend::cpu::Simd;

/// Of the unit diagonal, added to all: what the equations do not determine stays small.
const RIDGE: f64 = 1e-13;
/// Rows are padded to a multiple of this many numbers.
pub const LANES: usize = 8;
/// Rows of a tile of products.
const TILE: usize = 4;
/// Equations whose rows stay in the nearest cache while they are summed.
const PANEL: usize = 48;

/// Equations `row . c = right` for coefficients c, to be solved by least squares.
pub struct Equations {
    /// `[equation][coefficient]`, each row `width` long, zero behind the last coefficient.
    pub rows: Vec<f64>,
    pub right: Vec<f64>,
    pub coefficients: usize,
}

/// Their factors: with `rows = basis L'` the basis is orthonormal, and the solution of the leading
/// coefficients alone has the leading entries of `along` as its components.
pub struct Factors {
    /// How many coefficients the equations determine.
    pub determined: usize,
    equations: Equations,
    /// Components of the right side along the basis.
    along: Vec<f64>,
    /// Of the rows in units of `scale`, row-major.
    lower: Vec<f64>,
    scale: Vec<f64>,
}

/// Equations as they are in the orthonormal basis of the leading coefficients.
pub struct Basis {
    /// `[equation][coefficient]`, each row `width` long.
    rows: Vec<f64>,
    width: usize,
    pub right: Vec<f64>,
    /// Leading coefficients that count.
    count: usize,
}

/// Length of a row of so many coefficients.
pub fn width(coefficients: usize) -> usize {
    coefficients.max(1).next_multiple_of(LANES)
}

impl Equations {
    /// The factors by Cholesky's method.
    pub fn factors(self) -> Factors {
        let m = self.coefficients;
        let mut factors = Factors {
            determined: m,
            along: vec![0.0; width(m)],
            lower: vec![0.0; m * m],
            scale: vec![0.0; m],
            equations: self,
        };
        match Simd::detect() {
            Simd::Baseline => factors.fill::<false, 8>(),
            // SAFETY: the features were detected.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => unsafe { avx2(&mut factors) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => unsafe { avx512(&mut factors) },
            #[cfg(not(target_arch = "x86_64"))]
            Simd::Neon => factors.fill::<true, 8>(),
        }
        factors
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2(factors: &mut Factors) {
    factors.fill::<true, 8>();
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
fn avx512(factors: &mut Factors) {
    factors.fill::<true, 16>();
}

#[inline(always)]
fn add<const FMA: bool>(a: f64, b: f64, c: f64) -> f64 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

#[inline(always)]
fn total(sums: [f64; LANES]) -> f64 {
    let [a, b, c, d, e, f, g, h] = sums;
    ((a + e) + (c + g)) + ((b + f) + (d + h))
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
    sums.map(total)
}

/// Inner product of rows of any length.
#[inline(always)]
fn product<const FMA: bool>(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; LANES];
    let (whole, rest) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    let tail: f64 = whole
        .remainder()
        .iter()
        .zip(rest.remainder())
        .map(|(a, b)| a * b)
        .sum();
    for (a, b) in whole.zip(rest) {
        for i in 0..LANES {
            sums[i] = add::<FMA>(a[i], b[i], sums[i]);
        }
    }
    total(sums) + tail
}

/// The factor of a symmetric matrix of `m` rows (row-major; on and below the diagonal) in its
/// place, as far as pivots are above `least`; how far.
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

/// `sums[r][k] += a[r] b[k]`.
#[inline(always)]
fn accumulate<const FMA: bool, const WIDE: usize>(
    sums: &mut [[f64; WIDE]; TILE],
    a: [f64; TILE],
    b: &[f64],
) {
    let b = &b[..WIDE];
    for r in 0..TILE {
        for k in 0..WIDE {
            sums[r][k] = add::<FMA>(a[r], b[k], sums[r][k]);
        }
    }
}

/// Adds inner products of columns of some rows, those from `first` on with those from `at` on, on
/// and below the diagonal.
#[inline(always)]
fn gram<const FMA: bool, const WIDE: usize>(
    rows: &[f64],
    width: usize,
    [first, at]: [usize; 2],
    sums: &mut [f64],
    m: usize,
) {
    let mut own = [[0.0; WIDE]; TILE];
    for row in rows.chunks_exact(width) {
        let a = &row[first..first + TILE];
        accumulate::<FMA, WIDE>(&mut own, [a[0], a[1], a[2], a[3]], &row[at..]);
    }
    for i in first..(first + TILE).min(m) {
        for j in at..(at + WIDE).min(i + 1) {
            sums[i * m + j] += own[i - first][j - at];
        }
    }
}

/// Columns from `at` on of rows times a matrix that is zero below the diagonal.
#[inline(always)]
fn times<const FMA: bool, const WIDE: usize>(
    own: [&[f64]; TILE],
    matrix: &[f64],
    width: usize,
    at: usize,
    rows: &mut [f64],
) {
    let mut sums = [[0.0; WIDE]; TILE];
    for (j, row) in matrix.chunks_exact(width).take(at + WIDE).enumerate() {
        accumulate::<FMA, WIDE>(
            &mut sums,
            [own[0][j], own[1][j], own[2][j], own[3][j]],
            &row[at..],
        );
    }
    for (row, sums) in rows.chunks_exact_mut(width).zip(&sums) {
        row[at..at + WIDE].copy_from_slice(sums);
    }
}

impl Factors {
    #[inline(always)]
    fn fill<const FMA: bool, const WIDE: usize>(&mut self) {
        let m = self.equations.coefficients;
        let width = width(m);

        // Inner products on and below the diagonal, and with the right side.
        for panel in self.equations.rows.chunks(PANEL * width) {
            for first in (0..m).step_by(TILE) {
                let mut at = 0;
                while at < (first + TILE).min(m) {
                    if WIDE > LANES && at + WIDE <= width {
                        gram::<FMA, WIDE>(panel, width, [first, at], &mut self.lower, m);
                        at += WIDE;
                    } else {
                        gram::<FMA, LANES>(panel, width, [first, at], &mut self.lower, m);
                        at += LANES;
                    }
                }
            }
        }
        for (row, right) in self
            .equations
            .rows
            .chunks_exact(width)
            .zip(&self.equations.right)
        {
            for k in 0..width {
                self.along[k] = add::<FMA>(row[k], *right, self.along[k]);
            }
        }

        // Coefficients of very different sizes: scaled so that the diagonal is 1.
        for i in 0..m {
            let size = self.lower[i * m + i].sqrt();
            self.scale[i] = if size > 0.0 { size.recip() } else { 0.0 };
            self.along[i] *= self.scale[i];
        }
        for i in 0..m {
            for j in 0..=i {
                self.lower[i * m + j] *= self.scale[i] * self.scale[j];
            }
            self.lower[i * m + i] += RIDGE;
        }

        self.determined = factorized::<FMA>(&mut self.lower, m, 0.0);
        for i in 0..self.determined {
            let lower = &self.lower[i * m..][..=i];
            self.along[i] =
                (self.along[i] - product::<FMA>(&lower[..i], &self.along[..i])) / lower[i];
        }
    }

    /// The solution for the leading coefficients alone.
    pub fn solution(&self, count: usize) -> Vec<f64> {
        let m = self.equations.coefficients;
        let mut x = self.along[..count].to_vec();
        for i in (0..count).rev() {
            let below: f64 = (i + 1..count).map(|k| self.lower[k * m + i] * x[k]).sum();
            x[i] = (x[i] - below) / self.lower[i * m + i];
        }
        x.iter_mut().zip(&self.scale).for_each(|(x, s)| *x *= s);
        x
    }

    /// Some equations in the basis of all coefficients that are determined.
    pub fn basis(&self, equations: &[u32]) -> Basis {
        match Simd::detect() {
            Simd::Baseline => self.in_basis::<false, 8>(equations),
            // SAFETY: the features were detected.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => unsafe { avx2_basis(self, equations) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => unsafe { avx512_basis(self, equations) },
            #[cfg(not(target_arch = "x86_64"))]
            Simd::Neon => self.in_basis::<true, 8>(equations),
        }
    }

    #[inline(always)]
    fn in_basis<const FMA: bool, const WIDE: usize>(&self, equations: &[u32]) -> Basis {
        let (m, count) = (self.equations.coefficients, self.determined);
        let width = width(m);

        // Rows of the inverse of L, then its transpose in units of the rows: a row of the basis is
        // a row times that.
        let mut inverse = vec![0.0; count * width];
        for i in 0..count {
            let (before, own) = inverse.split_at_mut(i * width);
            let lower = &self.lower[i * m..][..=i];
            let own = &mut own[..i.next_multiple_of(LANES).max(LANES)];
            for (j, other) in before.chunks_exact(width).enumerate() {
                for k in 0..own.len() {
                    own[k] = add::<FMA>(-lower[j], other[k], own[k]);
                }
            }
            own.iter_mut().for_each(|x| *x /= lower[i]);
            inverse[i * width + i] = lower[i].recip();
        }
        let mut spread = vec![0.0; count * width];
        for i in 0..count {
            for j in 0..=i {
                spread[j * width + i] = inverse[i * width + j] * self.scale[j];
            }
        }

        let mut rows = vec![0.0; equations.len() * width];
        for (four, list) in rows.chunks_mut(TILE * width).zip(equations.chunks(TILE)) {
            let own: [&[f64]; TILE] = std::array::from_fn(|r| {
                let equation = list[r.min(list.len() - 1)] as usize;
                &self.equations.rows[equation * width..][..width]
            });
            let mut at = 0;
            while at < count {
                if WIDE > LANES && at + WIDE <= width {
                    times::<FMA, WIDE>(own, &spread, width, at, four);
                    at += WIDE;
                } else {
                    times::<FMA, LANES>(own, &spread, width, at, four);
                    at += LANES;
                }
            }
        }
        Basis {
            rows,
            width,
            right: equations
                .iter()
                .map(|k| self.equations.right[*k as usize])
                .collect(),
            count,
        }
    }

    /// What the residuals of some equations, which follow each other in a basis, would be had these
    /// been left out of the fit: `(I - Q Q') e = r` with the rows of the basis `Q` that are theirs.
    /// `None` where they determine a coefficient alone.
    pub fn left_out(&self, basis: &Basis, equations: std::ops::Range<usize>) -> Option<Vec<f64>> {
        match Simd::detect() {
            Simd::Baseline => self.without::<false>(basis, equations),
            // SAFETY: the features were detected.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => unsafe { avx2_without(self, basis, equations) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => unsafe { avx512_without(self, basis, equations) },
            #[cfg(not(target_arch = "x86_64"))]
            Simd::Neon => self.without::<true>(basis, equations),
        }
    }

    #[inline(always)]
    fn without<const FMA: bool>(
        &self,
        basis: &Basis,
        equations: std::ops::Range<usize>,
    ) -> Option<Vec<f64>> {
        /// Below this pivot the others say too little of a coefficient.
        const LEAST: f64 = 1e-8;
        let n = equations.len();
        let used = width(basis.count);
        let row = |k: usize| &basis.rows[(equations.start + k) * basis.width..][..used];
        // Not in closures, which would not have the vector unit's instructions. Behind `count` rows
        // are zero.
        let mut residual = basis.right[equations.clone()].to_vec();
        for k in 0..n {
            residual[k] -= product::<FMA>(row(k), &self.along[..used]);
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

impl Basis {
    /// That of fewer leading coefficients.
    pub fn cut(&mut self, count: usize) {
        let behind = count..width(self.count);
        for row in self.rows.chunks_exact_mut(self.width) {
            row[behind.clone()].fill(0.0);
        }
        self.count = count;
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2_basis(of: &Factors, equations: &[u32]) -> Basis {
    of.in_basis::<true, 8>(equations)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
fn avx512_basis(of: &Factors, equations: &[u32]) -> Basis {
    of.in_basis::<true, 16>(equations)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2_without(
    of: &Factors,
    basis: &Basis,
    equations: std::ops::Range<usize>,
) -> Option<Vec<f64>> {
    of.without::<true>(basis, equations)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
fn avx512_without(
    of: &Factors,
    basis: &Basis,
    equations: std::ops::Range<usize>,
) -> Option<Vec<f64>> {
    of.without::<true>(basis, equations)
}
