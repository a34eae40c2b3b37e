//! Cholesky's factorization of large matrices, that a deadline can end.

use crate::backend::Deadline;
use nalgebra::{DMatrix, DVector};

/// Columns that are factorized at once. The rest is products of matrices, which take most of the
/// time, and between blocks the deadline is looked at: of thousands of weights one factorization
/// takes seconds.
const BLOCK: usize = 64;

/// Solves `a x = b` for a symmetric matrix, of which the lower triangle is read; `None` where it is
/// not positive definite, or the deadline has passed.
pub(super) fn solve(
    mut a: DMatrix<f64>,
    b: &DVector<f64>,
    deadline: Deadline,
) -> Option<DVector<f64>> {
    let size = a.nrows();
    for begin in (0..size).step_by(BLOCK) {
        if deadline.has_passed() {
            return None;
        }
        let end = (begin + BLOCK).min(size);
        let block = a.view((begin, begin), (end - begin, end - begin));
        let factor = block.into_owned().cholesky()?.unpack();
        a.view_mut((begin, begin), (end - begin, end - begin))
            .copy_from(&factor);
        if end < size {
            eliminate(&mut a, &factor, begin..end);
        }
    }
    let mut x = b.clone();
    let solved = a.solve_lower_triangular_mut(&mut x) && a.tr_solve_lower_triangular_mut(&mut x);
    solved.then_some(x)
}

/// The columns of a block below its factor, and what they take off the matrix to their right.
fn eliminate(a: &mut DMatrix<f64>, factor: &DMatrix<f64>, block: std::ops::Range<usize>) {
    let (size, width) = (a.nrows(), block.len());
    let below = a.view((block.end, block.start), (size - block.end, width));
    let mut transposed = below.transpose();
    // The diagonal of a factor is positive: this solves.
    factor.solve_lower_triangular_mut(&mut transposed);
    let below = transposed.transpose();
    a.view_mut((block.end, block.start), (size - block.end, width))
        .copy_from(&below);
    for begin in (block.end..size).step_by(BLOCK) {
        let (rows, columns) = (size - begin, BLOCK.min(size - begin));
        let right = transposed.columns(begin - block.end, columns);
        let left = below.rows(begin - block.end, rows);
        let mut rest = a.view_mut((begin, begin), (rows, columns));
        rest.gemm(-1.0, &left, &right, 1.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::random::uniform;
    use std::time::Duration;

    /// `m m' + size` of a random `m`: its condition is of the order of 1.
    fn problem(size: usize) -> (DMatrix<f64>, DVector<f64>) {
        let m = DMatrix::from_fn(size, size, |i, j| uniform(1, (i * size + j) as u64) - 0.5);
        let shift = DMatrix::identity(size, size) * size as f64;
        let b = DVector::from_fn(size, |i, _| uniform(2, i as u64) - 0.5);
        (&m * m.transpose() + shift, b)
    }

    /// One block, one and a bit, and several: to rounding of sums of `size` products.
    #[test]
    fn solutions_solve() {
        for size in [1, 5, BLOCK, BLOCK + 1, 3 * BLOCK - 7] {
            let (a, b) = problem(size);
            let x = solve(a.clone(), &b, Deadline::default()).unwrap();
            let residual = (&a * &x - &b).amax();
            let rounding = size as f64 * f64::EPSILON * a.amax() * x.amax();
            assert!(residual <= rounding, "{size}: {residual:e}");
        }
    }

    #[test]
    fn what_is_not_positive_has_no_factor() {
        let (mut a, b) = problem(2 * BLOCK);
        let last = 2 * BLOCK - 1;
        a[(last, last)] = -1.0;
        assert!(solve(a, &b, Deadline::default()).is_none());
    }

    #[test]
    fn a_deadline_ends_it() {
        let (a, b) = problem(5);
        assert!(solve(a, &b, Deadline::after(Duration::ZERO)).is_none());
    }
}
