//! The ellipsoid that seeds lie on, where V itself is of no use for it.

use super::{LocalError, Riccati};
use nalgebra::{DMatrix, DVector};

/// Rates of change below this share of the largest count as none.
const ROUNDING: f64 = 1e-9;

/// S of an ellipsoid `s'Ss/2 = c` that every trajectory of the linear closed loop enters; `None`
/// where P serves.
///
/// Along the closed loop `d/dt s'Ps = -s'Ms` with `M = -(Ac'P + P Ac)`. For minimal cost M is the
/// running cost's and not negative; in a game the disturbance's share may make V rise along the
/// closed loop, trajectories cross `{V = c}` twice and some of them leave it without having been
/// seeds. S solves `Ac'S + S Ac = -|M|`, |M| with the absolute values of M's eigenvalues (in units
/// of `widths`): it is at least P, and P itself where M has no negative eigenvalue.
///
/// # Errors
/// [`LocalError::NoSolution`] where that equation has none.
pub(super) fn shape(riccati: &Riccati, widths: &[f64]) -> Result<Option<DMatrix<f64>>, LocalError> {
    let n = widths.len();
    let p = DMatrix::from_fn(n, n, |i, j| riccati.p[(i, j)] * widths[i] * widths[j]);
    let a = DMatrix::from_fn(n, n, |i, j| {
        riccati.closed_loop[(i, j)] * widths[j] / widths[i]
    });
    let m = -(a.transpose() * &p + &p * &a);
    let eigen = ((&m + m.transpose()) * 0.5).symmetric_eigen();
    if eigen.eigenvalues.min() >= -ROUNDING * eigen.eigenvalues.amax() {
        return Ok(None);
    }
    let size = eigen.eigenvalues.map(f64::abs);
    let positive =
        &eigen.eigenvectors * DMatrix::from_diagonal(&size) * eigen.eigenvectors.transpose();
    let s = lyapunov(&a, &positive).ok_or(LocalError::NoSolution {
        reason: "the Lyapunov equation of the surface of seeds is singular".into(),
    })?;
    Ok(Some(DMatrix::from_fn(n, n, |i, j| {
        s[(i, j)] / (widths[i] * widths[j])
    })))
}

/// Solves `a'X + X a = -q` as a linear system of n^2 unknowns.
fn lyapunov(a: &DMatrix<f64>, q: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let n = a.nrows();
    let identity = DMatrix::<f64>::identity(n, n);
    let operator = identity.kronecker(&a.transpose()) + a.transpose().kronecker(&identity);
    let x = operator
        .lu()
        .solve(&-DVector::from_column_slice(q.as_slice()))?;
    let x = DMatrix::from_column_slice(n, n, x.as_slice());
    Some((&x + x.transpose()) * 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn riccati(p: [f64; 4], closed_loop: [f64; 4]) -> Riccati {
        Riccati {
            p: DMatrix::from_row_slice(2, 2, &p),
            closed_loop: DMatrix::from_row_slice(2, 2, &closed_loop),
            eigenvalues: Vec::new(),
            residual: 0.0,
            error: 0.0,
        }
    }

    #[test]
    fn where_the_cost_falls_everywhere_it_is_the_cost() {
        let r = riccati([2.0, 0.0, 0.0, 1.0], [-1.0, 0.0, 0.0, -3.0]);
        assert_eq!(shape(&r, &[1.0, 1.0]).unwrap(), None);
    }

    /// P = I is no Lyapunov function of this closed loop, whose shear is larger than its decay.
    #[test]
    fn trajectories_enter_it_everywhere() {
        let r = riccati([1.0, 0.0, 0.0, 1.0], [-1.0, 6.0, 0.0, -1.0]);
        for widths in [[1.0, 1.0], [0.1, 20.0]] {
            let s = shape(&r, &widths).unwrap().unwrap();
            let falls = -(r.closed_loop.transpose() * &s + &s * &r.closed_loop);
            assert!(falls.clone().symmetric_eigenvalues().min() > 0.0, "{falls}");
            let above = &s - &r.p;
            assert!(above.symmetric_eigenvalues().min() >= -1e-12);
        }
    }
}
