//! The smallest level of attenuation that the linearization allows, found in two ways.
//!
//! With `H_pp = -B R^-1 B' + E E' / gamma^2` the game Riccati equation has a stabilizing solution
//! P >= 0 exactly for gamma above some gamma* (Doyle, Glover, Khargonekar & Francis 1989). Going down
//! to it, P grows until either eigenvalues of the Hamiltonian matrix meet on the imaginary axis, or
//! P becomes infinite (the upper block of the stable invariant subspace becomes singular) and
//! changes sign.

use super::Linearization;
use super::riccati::{ON_AXIS, eigenvalues_of, nearest_to_axis, polished, sign};
use crate::numeric::digits::plain;
use nalgebra::{Complex, DMatrix, Schur};

/// Relative residual up to which a Riccati solution counts as one: it says how near gamma* can be
/// come.
const RESIDUAL: f64 = 1e-12;
/// A semidefinite P has eigenvalues down to minus this, relative to its largest.
const ROUNDING: f64 = 1e-12;
/// Relative width at which a bracket is narrow enough.
const WIDTH: f64 = 1e-13;
/// Without a range, values from the scene's own are tried by factors of two up to 2 to this power,
/// either way.
const DOUBLINGS: i32 = 20;
/// Values on each side of gamma* at which monotony is checked.
const CHECKS: usize = 6;

/// What stops P on the way down.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// The Hamiltonian matrix gets eigenvalues on the imaginary axis.
    Axis,
    /// P becomes infinite.
    Unbounded,
    /// Nothing, down to the smallest value tried.
    None,
}

impl Cause {
    pub fn name(self) -> &'static str {
        match self {
            Cause::Axis => "axis",
            Cause::Unbounded => "unbounded",
            Cause::None => "none",
        }
    }

    /// In words.
    pub fn explained(self) -> &'static str {
        match self {
            Cause::Axis => "below it the Hamiltonian matrix has eigenvalues on the imaginary axis",
            Cause::Unbounded => {
                "there the Riccati solution becomes infinite, and below it indefinite"
            }
            Cause::None => {
                "the smallest value tried, at which the linearization still has a solution"
            }
        }
    }
}

/// gamma* of a linearization.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinearAttenuation {
    /// By bisection on the game Riccati equation. Where [`Cause::None`]: an upper bound.
    pub star: f64,
    /// By bisection on the Hamiltonian matrix alone: its eigenvalues, and its stable invariant
    /// subspace.
    pub hamiltonian: f64,
    pub cause: Cause,
}

impl LinearAttenuation {
    /// Relative difference of the two answers.
    pub fn difference(&self) -> f64 {
        (self.star - self.hamiltonian).abs() / self.star
    }
}

/// Why there is no gamma*.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum AttenuationError<E: std::error::Error + 'static> {
    #[error("at {}: {source}", plain(*value))]
    Scene { value: f64, source: E },
    #[error(
        "the linearization has no solution at any level of attenuation from {} to {}: neither a larger level nor another range helps unless the undisturbed problem is solvable",
        plain(*lo),
        plain(*hi)
    )]
    Nowhere { lo: f64, hi: f64 },
    #[error(
        "the linearization has a solution at {}, but none at {}: a larger value of the parameter must be easier (is it a gain instead of a level?)",
        plain(*feasible),
        plain(*infeasible)
    )]
    NotMonotone { feasible: f64, infeasible: f64 },
    #[error("the scene's own value, {}, is not above 0: give [attenuation] a range", plain(*value))]
    NotPositive { value: f64 },
}

/// Part of gamma* below it at which the cause is asked for.
const NEARLY: f64 = 1e-6;

/// Whether the linearization allows a level.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Verdict {
    Allowed,
    Refused(Cause),
}

/// Bisection on the logarithm, from a refused and an allowed value to neighbours, with what was
/// said of the refused one.
struct Bracket {
    lo: f64,
    hi: f64,
    cause: Cause,
}

impl Bracket {
    fn narrow<E>(mut self, judge: &mut dyn FnMut(f64) -> Result<Verdict, E>) -> Result<Self, E> {
        while self.hi / self.lo - 1.0 > WIDTH {
            let middle = (self.lo * self.hi).sqrt();
            if middle <= self.lo || middle >= self.hi {
                break;
            }
            match judge(middle)? {
                Verdict::Allowed => self.hi = middle,
                Verdict::Refused(cause) => (self.lo, self.cause) = (middle, cause),
            }
        }
        Ok(self)
    }
}

/// gamma* for a parameter: `linearization` gives the scene's for a value of it. Searched are
/// `range`, or values up to a million times above and below `own`.
///
/// # Errors
/// [`AttenuationError`]: a value for which there is no linearization, no value at which there is a
/// solution, or one above which there is none.
pub fn linear_attenuation<E: std::error::Error + 'static>(
    own: f64,
    range: Option<[f64; 2]>,
    linearization: &mut dyn FnMut(f64) -> Result<Linearization, E>,
) -> Result<LinearAttenuation, AttenuationError<E>> {
    let mut at = |value: f64| {
        linearization(value).map_err(|source| AttenuationError::Scene { value, source })
    };
    if range.is_none() && (own.is_nan() || own <= 0.0) {
        return Err(AttenuationError::NotPositive { value: own });
    }
    let mut riccati = |value: f64| Ok(by_riccati(&at(value)?));
    let (lo, hi) = match range {
        Some([lo, hi]) => (lo, hi),
        None => bracket(own, &mut riccati)?,
    };
    if riccati(hi)? != Verdict::Allowed {
        return Err(AttenuationError::Nowhere { lo, hi });
    }
    let cause = match riccati(lo)? {
        Verdict::Refused(cause) => cause,
        Verdict::Allowed => {
            return Ok(LinearAttenuation {
                star: lo,
                hamiltonian: lo,
                cause: Cause::None,
            });
        }
    };
    let found = Bracket { lo, hi, cause }.narrow(&mut riccati)?;
    let between = |a: f64, b: f64, k: usize| a * (b / a).powf(k as f64 / (CHECKS + 1) as f64);
    for k in 1..=CHECKS {
        let (below, above) = (between(lo, found.lo, k), between(found.hi, hi, k));
        if below < found.lo && riccati(below)? == Verdict::Allowed {
            let infeasible = found.lo;
            return Err(AttenuationError::NotMonotone {
                feasible: below,
                infeasible,
            });
        }
        if above > found.hi && riccati(above)? != Verdict::Allowed {
            let feasible = found.hi;
            return Err(AttenuationError::NotMonotone {
                feasible,
                infeasible: above,
            });
        }
    }
    let mut alone = |value: f64| Ok(by_hamiltonian(&at(value)?));
    // What the other method says of the bracket's ends is not asked: it has to find its own way
    // from there.
    let second = Bracket { lo, hi, cause }.narrow(&mut alone)?;
    // Exactly at an infinite P either may be said: the cause is asked for a little below.
    let cause = match by_hamiltonian(&at((found.lo * (1.0 - NEARLY)).max(lo))?) {
        Verdict::Refused(cause) => cause,
        Verdict::Allowed => second.cause,
    };
    Ok(LinearAttenuation {
        star: found.hi,
        hamiltonian: second.hi,
        cause,
    })
}

/// The nearest refused and allowed values by factors of two from `own`; both the same way out where
/// there are none.
fn bracket<E: std::error::Error + 'static>(
    own: f64,
    judge: &mut dyn FnMut(f64) -> Result<Verdict, AttenuationError<E>>,
) -> Result<(f64, f64), AttenuationError<E>> {
    let allowed = judge(own)? == Verdict::Allowed;
    let mut last = own;
    for k in 1..=DOUBLINGS {
        let next = own
            * if allowed {
                0.5f64.powi(k)
            } else {
                2f64.powi(k)
            };
        let here = judge(next)? == Verdict::Allowed;
        if here != allowed {
            return Ok((next.min(last), next.max(last)));
        }
        last = next;
    }
    Ok((last.min(own), last.max(own)))
}

/// The Riccati equation's answer. P is judged by its inverse where that is the better one to
/// compute: it passes 0 where P passes infinity.
fn by_riccati(linear: &Linearization) -> Verdict {
    let n = linear.a.nrows();
    let axis = Verdict::Refused(Cause::Axis);
    if !linear.is_finite() {
        return axis;
    }
    let (linear, _) = linear.balanced();
    let Some(sign) = sign(linear.hamiltonian_matrix()).filter(|s| s.iter().all(|x| x.is_finite()))
    else {
        return axis;
    };
    // The range of I - sign, of rank n.
    let projector = DMatrix::identity(2 * n, 2 * n) - sign;
    let svd = projector.svd(true, false);
    let Some(basis) = svd.u else { return axis };
    let (upper, lower) = (
        basis.view((0, 0), (n, n)).into_owned(),
        basis.view((n, 0), (n, n)).into_owned(),
    );
    let smallest = |m: &DMatrix<f64>| m.singular_values().min();
    let direct = smallest(&upper) >= smallest(&lower);
    let (over, under, equation) = if direct {
        (&lower, &upper, linear)
    } else {
        (&upper, &lower, linear.dual())
    };
    // P = X2 X1^-1, of which the transpose is solved for.
    let Some(p) = under.transpose().lu().solve(&over.transpose()) else {
        return axis;
    };
    let (p, residual) = polished(&equation, (&p + p.transpose()) * 0.5);
    let closed = eigenvalues_of(&(&equation.a + &equation.g * &p));
    let stable = closed
        .iter()
        .all(|e| if direct { e.re < 0.0 } else { e.re > 0.0 });
    if residual.is_nan() || residual > RESIDUAL || !stable {
        return axis;
    }
    let eigenvalues = p.symmetric_eigenvalues();
    let bound = if direct {
        -ROUNDING * eigenvalues.amax()
    } else {
        0.0
    };
    if eigenvalues.min() >= bound {
        Verdict::Allowed
    } else {
        Verdict::Refused(Cause::Unbounded)
    }
}

/// The Hamiltonian matrix's answer: no eigenvalue on the imaginary axis, and X1'X2 >= 0 for a basis
/// [X1; X2] of the stable invariant subspace. That matrix is P seen from the subspace: bounded, and
/// singular with X1 where P becomes infinite.
fn by_hamiltonian(linear: &Linearization) -> Verdict {
    let n = linear.a.nrows();
    let axis = Verdict::Refused(Cause::Axis);
    if !linear.is_finite() {
        return axis;
    }
    let m = linear.balanced().0.hamiltonian_matrix();
    let near = nearest_to_axis(&eigenvalues_of(&m)).map_or(0.0, |e| e.re.abs());
    if near.is_nan() || near < ON_AXIS * m.norm() {
        return axis;
    }
    let Some(basis) = stable_subspace(&m) else {
        return axis;
    };
    let (upper, lower) = (basis.view((0, 0), (n, n)), basis.view((n, 0), (n, n)));
    let inner = upper.adjoint() * lower;
    let eigen = ((&inner + inner.adjoint()) * Complex::new(0.5, 0.0)).symmetric_eigen();
    let negative = |k: usize| {
        let direction = eigen.eigenvectors.column(k);
        // A direction of infinite P, or one that P does not see.
        let infinite = (upper * direction).norm() < (lower * direction).norm();
        eigen.eigenvalues[k] < if infinite { 0.0 } else { -ROUNDING }
    };
    if (0..n).any(negative) {
        Verdict::Refused(Cause::Unbounded)
    } else {
        Verdict::Allowed
    }
}

/// An orthonormal basis (`2n x n`) of the stable invariant subspace: Schur's form with the stable
/// eigenvalues moved to its beginning by rotations (A. J. Laub 1979; Golub & Van Loan, section
/// 7.6.2).
fn stable_subspace(m: &DMatrix<f64>) -> Option<DMatrix<Complex<f64>>> {
    let size = m.nrows();
    let complex = m.map(|x| Complex::new(x, 0.0));
    let (mut q, mut t) = Schur::try_new(complex, f64::EPSILON, 10_000)?.unpack();
    let mut stable = 0;
    for k in 0..size {
        if t[(k, k)].re >= 0.0 {
            continue;
        }
        for j in (stable..k).rev() {
            exchange(&mut q, &mut t, j);
        }
        stable += 1;
    }
    (2 * stable == size).then(|| q.columns(0, stable).into_owned())
}

/// Exchanges the eigenvalues j and j + 1 of a triangular matrix `t` with `q t q*` kept.
fn exchange(q: &mut DMatrix<Complex<f64>>, t: &mut DMatrix<Complex<f64>>, j: usize) {
    // The second one's eigenvector within the block becomes the first column.
    let (x, y) = (t[(j, j + 1)], t[(j + 1, j + 1)] - t[(j, j)]);
    let length = x.norm().hypot(y.norm());
    if length == 0.0 {
        return;
    }
    let (c, s) = (x / length, y / length);
    let turn = |m: &mut DMatrix<Complex<f64>>| {
        for i in 0..m.nrows() {
            let (a, b) = (m[(i, j)], m[(i, j + 1)]);
            m[(i, j)] = a * c + b * s;
            m[(i, j + 1)] = b * c.conj() - a * s.conj();
        }
    };
    turn(q);
    turn(t);
    for i in 0..t.ncols() {
        let (a, b) = (t[(j, i)], t[(j + 1, i)]);
        t[(j, i)] = a * c.conj() + b * s.conj();
        t[(j + 1, i)] = b * c - a * s;
    }
    t[(j + 1, j)] = Complex::new(0.0, 0.0);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_stable_subspace_is_invariant() {
        // Real, complex and double eigenvalues.
        let a = DMatrix::from_row_slice(3, 3, &[0.0, 1.0, 0.0, -2.0, 0.3, 1.0, 0.5, 0.0, 1.5]);
        let g = -DMatrix::from_row_slice(3, 3, &[1.0, 0.2, 0.0, 0.2, 2.0, 0.3, 0.0, 0.3, 1.5]);
        let linear = Linearization {
            a,
            g,
            q: DMatrix::identity(3, 3),
        };
        let m = linear.hamiltonian_matrix();
        let basis = stable_subspace(&m).unwrap();
        let image = m.map(|x| Complex::new(x, 0.0)) * &basis;
        let within = &basis * (basis.adjoint() * &image);
        assert!((&image - within).norm() < 1e-13 * m.norm());
        let orthonormal = basis.adjoint() * &basis;
        assert!((orthonormal - DMatrix::identity(3, 3)).norm() < 1e-14);
        let within = eigenvalues_of(&(basis.adjoint() * image).map(|z| z.re));
        assert_eq!(within.len(), 3);
        assert!(
            by_hamiltonian(&linear) == Verdict::Allowed && by_riccati(&linear) == Verdict::Allowed
        );
    }
}
