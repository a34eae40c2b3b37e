//! A few linear equations.

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

#[cfg(test)]
mod tests {
    use super::solve_dense;

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
