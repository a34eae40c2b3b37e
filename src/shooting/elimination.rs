//! Block elimination of the linearized multiple-shooting equations of one trajectory.
//!
//! Unknown are the steps `d_k` of the nodes `z_k = (s, p)`, k = 0..M, in scaled units:
//!
//! ```text
//! d_{k+1} = Phi_k d_k + r_k          r_k: defect, the segment's end less the next node
//! (-G I) d_M = e                     e = g(s_M) - p_M
//! s-part of d_0 given
//! ```
//!
//! The end's n rows are carried backward through the segments: `W_{k+1} Phi_k = L_k W_k` with
//! orthonormal rows in every `W_k`. Those rows span the conormal space of the stable manifold (of
//! the terminal condition's flow), which attracts backward in time, so that no growing part of
//! `Phi` is ever subtracted from another, and a conjugate point on the way does no harm. Forward
//! again, each step is corrected onto its rows. (Compare the compactification of U. Ascher, R.
//! Mattheij, R. Russell, Numerical Solution of Boundary Value Problems, SIAM 1995, ch. 7.)
//!
//! `W_0 = (A B)` tells the slope `dp/ds = -B^-1 A` of the sheet at the target; B is singular
//! exactly on a fold.

use crate::numeric::dense::solve_dense;

/// Elimination of one trajectory, kept for further right-hand sides.
#[derive(Clone, Debug, Default)]
pub struct Factors {
    n: usize,
    /// `Phi_k`, row-major, segment by segment.
    phi: Vec<f64>,
    /// `W_k`, `n x 2n`, node by node.
    w: Vec<f64>,
    /// `L_k`, `n x n` lower triangular, node by node (the last: of the end's condition).
    l: Vec<f64>,
}

/// What the first node has to satisfy besides its rows.
#[derive(Clone, Debug)]
pub enum Start<'a> {
    /// The s-part of its step (scaled).
    Step(&'a [f64]),
    /// The s-part is on a line: `excess + direction * t`; and `along . (t, dp) = advance`. One more
    /// unknown, t.
    Line {
        excess: &'a [f64],
        direction: &'a [f64],
        along: &'a [f64],
        advance: f64,
    },
}

impl Factors {
    /// Eliminates. `phi` holds the segments' propagators (scaled), `hessian` is G (scaled).
    pub fn new(n: usize, phi: Vec<f64>, hessian: &[f64]) -> Self {
        let segments = phi.len() / (4 * n * n);
        let mut this = Self {
            n,
            phi,
            w: vec![0.0; (segments + 1) * 2 * n * n],
            l: vec![0.0; (segments + 1) * n * n],
        };
        match n {
            1 => this.eliminate(1, hessian),
            2 => this.eliminate(2, hessian),
            3 => this.eliminate(3, hessian),
            4 => this.eliminate(4, hessian),
            _ => this.eliminate(n, hessian),
        }
        this
    }

    /// An elimination that was done elsewhere: propagators `[segment][2n x 2n]`, and the `W` and
    /// `L` of their nodes.
    pub fn from_parts(n: usize, phi: Vec<f64>, w: Vec<f64>, l: Vec<f64>) -> Self {
        debug_assert_eq!(w.len(), (phi.len() / (4 * n * n) + 1) * 2 * n * n);
        debug_assert_eq!(2 * l.len(), w.len());
        Self { n, phi, w, l }
    }

    /// `W` and `L` of all nodes.
    pub fn parts(&self) -> (&[f64], &[f64]) {
        (&self.w, &self.l)
    }

    pub fn is_empty(&self) -> bool {
        self.w.is_empty()
    }

    /// Inlined for each common n, so that the inner loops have a known length.
    #[inline(always)]
    fn eliminate(&mut self, n: usize, hessian: &[f64]) {
        let m = 2 * n;
        let segments = self.phi.len() / (m * m);
        let mut rows = vec![0.0; n * m];
        for i in 0..n {
            for j in 0..n {
                rows[i * m + j] = -hessian[i * n + j];
            }
            rows[i * m + n + i] = 1.0;
        }
        for k in (0..=segments).rev() {
            if k < segments {
                let (w, phi) = (
                    &self.w[(k + 1) * n * m..][..n * m],
                    &self.phi[k * m * m..][..m * m],
                );
                rows.fill(0.0);
                for i in 0..n {
                    for q in 0..m {
                        let a = w[i * m + q];
                        for j in 0..m {
                            rows[i * m + j] += a * phi[q * m + j];
                        }
                    }
                }
            }
            orthonormalize(n, &mut rows, &mut self.l[k * n * n..][..n * n]);
            self.w[k * n * m..][..n * m].copy_from_slice(&rows);
        }
    }

    /// The rows `(A B)` of the first node.
    pub fn first_rows(&self) -> &[f64] {
        &self.w[..2 * self.n * self.n]
    }

    /// Largest entry of each segment's propagator.
    pub fn growth(&self) -> impl Iterator<Item = f64> + '_ {
        self.phi
            .chunks(4 * self.n * self.n)
            .map(|p| p.iter().fold(0.0f64, |a, x| a.max(x.abs())))
    }

    /// Steps `[node][2n]` (scaled) for defects `[segment][2n]`, the end's residual e and the
    /// start's condition; `None` where the first node's equations are singular. For a line, t comes
    /// last.
    pub fn solve(&self, defects: &[f64], end: &[f64], start: &Start<'_>) -> Option<Vec<f64>> {
        match self.n {
            1 => self.solve_of(1, defects, end, start),
            2 => self.solve_of(2, defects, end, start),
            3 => self.solve_of(3, defects, end, start),
            4 => self.solve_of(4, defects, end, start),
            6 => self.solve_of(6, defects, end, start),
            n => self.solve_of(n, defects, end, start),
        }
    }

    /// Inlined for each common n, as [`Factors::eliminate`] is.
    #[inline(always)]
    fn solve_of(
        &self,
        n: usize,
        defects: &[f64],
        end: &[f64],
        start: &Start<'_>,
    ) -> Option<Vec<f64>> {
        let m = 2 * n;
        let segments = defects.len() / m;
        let mut c = vec![0.0; (segments + 1) * n];
        // Backward: what each node's rows must give.
        for k in (0..=segments).rev() {
            let (here, after) = c[k * n..].split_at_mut(n);
            if k == segments {
                here.copy_from_slice(end);
            } else {
                let w = &self.w[(k + 1) * n * m..][..n * m];
                let defects = &defects[k * m..][..m];
                for i in 0..n {
                    let row = &w[i * m..][..m];
                    let dot: f64 = (0..m).map(|j| row[j] * defects[j]).sum();
                    here[i] = after[i] - dot;
                }
            }
            let l = &self.l[k * n * n..][..n * n];
            for i in 0..n {
                let below: f64 = (0..i).map(|j| l[i * n + j] * here[j]).sum();
                here[i] = (here[i] - below) / l[i * n + i];
            }
        }
        let (first, t) = self.first_step(&c[..n], start)?;
        let mut steps = vec![0.0; (segments + 1) * m];
        steps[..m].copy_from_slice(&first);
        for k in 0..segments {
            let phi = &self.phi[k * m * m..][..m * m];
            let (done, open) = steps.split_at_mut((k + 1) * m);
            let (from, to) = (&done[k * m..], &mut open[..m]);
            for i in 0..m {
                let dot: f64 = (0..m).map(|j| phi[i * m + j] * from[j]).sum();
                to[i] = dot + defects[k * m + i];
            }
            let w = &self.w[(k + 1) * n * m..][..n * m];
            for i in 0..n {
                let row = &w[i * m..][..m];
                let excess = c[(k + 1) * n + i] - (0..m).map(|j| row[j] * to[j]).sum::<f64>();
                for j in 0..m {
                    to[j] += row[j] * excess;
                }
            }
        }
        if let Some(t) = t {
            steps.push(t);
        }
        steps.iter().all(|x| x.is_finite()).then_some(steps)
    }

    fn first_step(&self, c: &[f64], start: &Start<'_>) -> Option<(Vec<f64>, Option<f64>)> {
        let n = self.n;
        let m = 2 * n;
        let w = self.first_rows();
        match start {
            Start::Step(s) => {
                let mut a = vec![0.0; n * n];
                let mut b = c.to_vec();
                for i in 0..n {
                    a[i * n..][..n].copy_from_slice(&w[i * m + n..][..n]);
                    b[i] -= (0..n).map(|j| w[i * m + j] * s[j]).sum::<f64>();
                }
                solve_dense(n, &mut a, &mut b)?;
                Some(([*s, &b].concat(), None))
            }
            Start::Line {
                excess,
                direction,
                along,
                advance,
            } => {
                let q = n + 1;
                let mut a = vec![0.0; q * q];
                let mut b = vec![0.0; q];
                for i in 0..n {
                    let row = &w[i * m..][..m];
                    a[i * q] = (0..n).map(|j| row[j] * direction[j]).sum();
                    a[i * q + 1..][..n].copy_from_slice(&row[n..]);
                    b[i] = c[i] - (0..n).map(|j| row[j] * excess[j]).sum::<f64>();
                }
                a[n * q..].copy_from_slice(along);
                b[n] = *advance;
                solve_dense(q, &mut a, &mut b)?;
                let s: Vec<f64> = (0..n).map(|j| excess[j] + direction[j] * b[0]).collect();
                Some(([s.as_slice(), &b[1..]].concat(), Some(b[0])))
            }
        }
    }

    /// The sheet's slope `dp/ds` at the first node (scaled, row-major), and the smallest singular
    /// value of B: 0 on a fold, 1 where p is free of s.
    pub fn slope(&self) -> (Option<Vec<f64>>, f64) {
        let n = self.n;
        let w = self.first_rows();
        let a = nalgebra::DMatrix::from_fn(n, n, |i, j| w[i * 2 * n + j]);
        let b = nalgebra::DMatrix::from_fn(n, n, |i, j| w[i * 2 * n + n + j]);
        let smallest = b.singular_values().min();
        let slope = b
            .lu()
            .solve(&a)
            .map(|x| (-x).transpose().iter().copied().collect());
        (slope, smallest)
    }

    /// The sheet's slope `dp/ds` at a node (physical units, row-major), given the scales of `(s,
    /// p)`; `None` where the smallest singular value of the node's equations for p is below
    /// `least`: near a fold.
    pub fn slope_at(&self, node: usize, scales: &[f64], least: f64) -> Option<Vec<f64>> {
        let n = self.n;
        let w = &self.w[node * 2 * n * n..][..2 * n * n];
        let a = nalgebra::DMatrix::from_fn(n, n, |i, j| w[i * 2 * n + j]);
        let b = nalgebra::DMatrix::from_fn(n, n, |i, j| w[i * 2 * n + n + j]);
        if b.singular_values().min() < least {
            return None;
        }
        let scaled = b.lu().solve(&a)?;
        let slope: Vec<f64> = (0..n * n)
            .map(|q| -scaled[(q / n, q % n)] * scales[n + q / n] / scales[q % n])
            .collect();
        slope.iter().all(|x| x.is_finite()).then_some(slope)
    }

    /// The unit tangent `(t, dp)` of the sheet along a line with `direction`, oriented like
    /// `before` where given, and to rising t otherwise.
    pub fn tangent(&self, direction: &[f64], before: Option<&[f64]>) -> Option<Vec<f64>> {
        let n = self.n;
        let w = self.first_rows();
        let matrix = nalgebra::DMatrix::from_fn(n + 1, n + 1, |i, j| match (i, j) {
            (i, _) if i == n => 0.0,
            (i, 0) => (0..n).map(|q| w[i * 2 * n + q] * direction[q]).sum(),
            (i, j) => w[i * 2 * n + n + j - 1],
        });
        let svd = matrix.svd(false, true);
        let vt = svd.v_t?;
        let null = svd.singular_values.imin();
        let mut t: Vec<f64> = vt.row(null).iter().copied().collect();
        let sign = match before {
            Some(b) => b.iter().zip(&t).map(|(x, y)| x * y).sum::<f64>(),
            None => t[0],
        };
        if sign < 0.0 {
            t.iter_mut().for_each(|x| *x = -*x);
        }
        t.iter().all(|x| x.is_finite()).then_some(t)
    }
}

/// `rows = L Q`, Q with orthonormal rows in place of `rows`: modified Gram-Schmidt, twice, as once
/// is not orthogonal to rounding where the rows are nearly dependent.
#[inline(always)]
fn orthonormalize(n: usize, rows: &mut [f64], l: &mut [f64]) {
    let m = 2 * n;
    l.fill(0.0);
    for i in 0..n {
        let (done, rest) = rows.split_at_mut(i * m);
        let row = &mut rest[..m];
        for _ in 0..2 {
            for j in 0..i {
                let q = &done[j * m..][..m];
                let dot: f64 = (0..m).map(|k| row[k] * q[k]).sum();
                l[i * n + j] += dot;
                for k in 0..m {
                    row[k] -= dot * q[k];
                }
            }
        }
        let norm = row.iter().map(|x| x * x).sum::<f64>().sqrt();
        l[i * n + i] = norm;
        for x in row {
            *x /= norm;
        }
    }
}
