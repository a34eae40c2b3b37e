//! A few linear equations, in memory that is there.

/// Solves `a x = b` (a row-major, n x n) by elimination with row exchanges; x in place of b. `None`
/// where a pivot is 0 or not finite. Inlined, so that loops over a constant n are none.
#[inline(always)]
pub fn solve_dense(n: usize, a: &mut [f64], b: &mut [f64]) -> Option<()> {
    for k in 0..n {
        let pivot = (k..n).max_by(|i, j| a[i * n + k].abs().total_cmp(&a[j * n + k].abs()))?;
        if !(a[pivot * n + k].abs() > 0.0 && a[pivot * n + k].is_finite()) {
            return None;
        }
        if pivot != k {
            for j in 0..n {
                a.swap(k * n + j, pivot * n + j);
            }
            b.swap(k, pivot);
        }
        for i in k + 1..n {
            let f = a[i * n + k] / a[k * n + k];
            for j in k..n {
                a[i * n + j] -= f * a[k * n + j];
            }
            b[i] -= f * b[k];
        }
    }
    for k in (0..n).rev() {
        let rest: f64 = (k + 1..n).map(|j| a[k * n + j] * b[j]).sum();
        b[k] = (b[k] - rest) / a[k * n + k];
    }
    Some(())
}

/// The lower factor of a symmetric matrix (row-major, n x n; its lower triangle counts) in its
/// place. `None` where that is not positive definite.
pub fn cholesky(n: usize, a: &mut [f64]) -> Option<()> {
    for i in 0..n {
        for j in 0..=i {
            let (row, other) = (&a[i * n..][..j], &a[j * n..][..j]);
            let known: f64 = row.iter().zip(other).map(|(x, y)| x * y).sum();
            let left = a[i * n + j] - known;
            a[i * n + j] = if i > j {
                left / a[j * n + j]
            } else if left > 0.0 {
                left.sqrt()
            } else {
                return None;
            };
        }
    }
    Some(())
}

/// Solves `l l' x = b` by a lower factor (see [`cholesky`]) for columns of right-hand sides, `b`
/// row-major; x in place of b.
pub fn solve_by_cholesky(n: usize, l: &[f64], columns: usize, b: &mut [f64]) {
    for i in 0..n {
        for j in 0..i {
            (0..columns).for_each(|c| b[i * columns + c] -= l[i * n + j] * b[j * columns + c]);
        }
        (0..columns).for_each(|c| b[i * columns + c] /= l[i * n + i]);
    }
    for i in (0..n).rev() {
        for j in i + 1..n {
            (0..columns).for_each(|c| b[i * columns + c] -= l[j * n + i] * b[j * columns + c]);
        }
        (0..columns).for_each(|c| b[i * columns + c] /= l[i * n + i]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Against what the equations say; only the lower triangle is read.
    #[test]
    fn a_symmetric_matrix_is_factored() {
        let matrix = [[4.0, 2.0, -1.0], [2.0, 5.0, 0.5], [-1.0, 0.5, 3.0]];
        let mut lower = [[4.0, 9.0, 9.0], [2.0, 5.0, 9.0], [-1.0, 0.5, 3.0]];
        let right = [[1.0, 0.3], [-2.0, 0.0], [5.0, -1.0]];
        let mut x = right;
        assert_eq!(cholesky(3, lower.as_flattened_mut()), Some(()));
        solve_by_cholesky(3, lower.as_flattened(), 2, x.as_flattened_mut());
        for (row, right) in matrix.iter().zip(right) {
            for c in 0..2 {
                let left: f64 = row.iter().zip(&x).map(|(a, x)| a * x[c]).sum();
                assert!((left - right[c]).abs() < 1e-14, "{left} for {}", right[c]);
            }
        }
        for indefinite in [[1.0, 0.0, 2.0, 1.0], [0.0, 0.0, 0.0, 1.0], [f64::NAN; 4]] {
            assert_eq!(cholesky(2, &mut indefinite.clone()), None);
        }
    }

    /// Against what the equations say, with a pivot that is 0 at first.
    #[test]
    fn a_few_equations_are_solved() {
        let matrix = [[0.0, 2.0, -1.0], [3.0, 1.0, 0.5], [-1.0, 4.0, 2.0]];
        let right = [1.0, -2.0, 5.0];
        let mut x = right;
        let solved = solve_dense(3, matrix.clone().as_flattened_mut(), &mut x);
        assert_eq!(solved, Some(()));
        for (row, right) in matrix.iter().zip(right) {
            let left: f64 = row.iter().zip(&x).map(|(a, x)| a * x).sum();
            assert!((left - right).abs() < 1e-14, "{left} for {right}");
        }
        let singular = solve_dense(2, &mut [1.0, 2.0, 2.0, 4.0], &mut [1.0, 1.0]);
        assert_eq!(singular, None);
    }
}
