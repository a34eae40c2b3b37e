//! The stabilizing solution of the algebraic Riccati equation of the linearization (for a game, the
//! game equation).

use super::LocalError;
use super::linearization::{Linearization, widths};
use crate::expr::Id;
use crate::hamiltonian::Hamiltonian;
use crate::model::{Horizon, Model};
use nalgebra::{Complex, DMatrix, DVector};

/// Largest accepted `|A'P + PA + P H_pp P + Q|` relative to its terms.
const RESIDUAL: f64 = 1e-10;
/// Eigenvalues nearer to the imaginary axis than this, relative to the matrix, count as on it: a
/// double eigenvalue there is computed to the square root of the rounding error.
pub(super) const ON_AXIS: f64 = 1e-7;
/// Relative size under which a singular or eigenvalue counts as zero.
const RANK: f64 = 1e-10;

/// Linear-quadratic solution at the equilibrium: `V = s'P s / 2`, `p = P s`, `s' = closed_loop s`.
#[derive(Clone, Debug)]
pub struct Riccati {
    pub p: DMatrix<f64>,
    pub closed_loop: DMatrix<f64>,
    /// Eigenvalues of the closed loop, by rising real part.
    pub eigenvalues: Vec<Complex<f64>>,
    /// Relative residual of the Riccati equation.
    pub residual: f64,
    /// Estimated error of P, relative to it along every direction: `|s'dPs| <= error s'Ps`.
    pub error: f64,
}

/// That products of the numbers of a scene are numbers, too.
fn check_scales(linear: &Linearization, widths: &DVector<f64>) -> Result<(), LocalError> {
    const MOST: f64 = 1e150;
    let entries = linear.g.iter().chain(linear.q.iter()).map(|x| x.abs());
    let squares = widths.iter().map(|w| w * w);
    let is_far = |x: &f64| *x > MOST || (*x > 0.0 && *x < MOST.recip());
    let is_far_width = |w: f64| is_far(&w) || w == 0.0;
    let mut of_entries = entries.filter(|x| x.is_finite());
    match of_entries.any(|x| is_far(&x)) || squares.into_iter().any(is_far_width) {
        true => Err(LocalError::NoSolution {
            reason: "its numbers are too far from 1 to be multiplied: give the region, the dynamics and the cost in units in which they are nearer to 1".into(),
        }),
        false => Ok(()),
    }
}

/// Distance of the slowest mode from the imaginary axis.
pub fn closed_loop_margin(r: &Riccati) -> f64 {
    r.eigenvalues
        .iter()
        .map(|e| -e.re)
        .fold(f64::INFINITY, f64::min)
}

impl Riccati {
    /// Solves for the scene's equilibrium.
    ///
    /// # Errors
    /// The cases of [`LocalError`] up to `NotStable`, each with the number that decides.
    pub fn solve(hamiltonian: &Hamiltonian, model: &Model) -> Result<Self, LocalError> {
        let n = hamiltonian.states();
        let widths = widths(model);
        let linear = Linearization::new(hamiltonian, model);
        check_scales(&linear, &widths)?;
        if !linear.is_finite() {
            return Err(LocalError::NoSolution {
                reason: "the second derivatives of H at the equilibrium are not finite (a root or logarithm at the edge of its domain?)".into(),
            });
        }
        check_stationary(hamiltonian, model)?;
        let input = input_matrix(hamiltonian, model, &widths);
        check_stabilizable(&linear.a, &input)?;
        let game = !model.disturbances.is_empty();
        check_imaginary_axis(&linear, model, game)?;
        let scaled = stabilizing(&linear)?;
        let residual = relative_residual(&linear, &scaled);
        if residual.is_nan() || residual > RESIDUAL {
            return Err(LocalError::Residual {
                residual,
                bound: RESIDUAL,
            });
        }
        let closed = &linear.a + &linear.g * &scaled;
        let p = DMatrix::from_fn(n, n, |i, j| scaled[(i, j)] / (widths[i] * widths[j]));
        let closed_loop = DMatrix::from_fn(n, n, |i, j| closed[(i, j)] * widths[i] / widths[j]);
        let mut eigenvalues: Vec<_> = eigenvalues_of(&closed);
        eigenvalues.sort_by(|a, b| {
            (a.re, a.im)
                .partial_cmp(&(b.re, b.im))
                .unwrap_or(std::cmp::Ordering::Equal)
        });
        if let Some(e) = eigenvalues.iter().find(|e| e.re.is_nan() || e.re >= 0.0) {
            return Err(LocalError::NotStable {
                eigenvalue: show_eigenvalue(*e),
            });
        }
        check_positive(&scaled, model, game)?;
        let error = forward_error(&linear, &scaled);
        Ok(Self {
            p,
            closed_loop,
            eigenvalues,
            residual,
            error,
        })
    }
}

/// The Newton step that lowers the residual no more, as large as P's error, and what a factor of P
/// loses.
fn forward_error(l: &Linearization, p: &DMatrix<f64>) -> f64 {
    /// A Newton step sees the residual with its rounding, which may hide as much as it shows.
    const HIDDEN: f64 = 2.0;
    let factored = (p.nrows() * (p.nrows() + 1)) as f64 * f64::EPSILON;
    let relative = || {
        let factor = p.clone().cholesky()?.l();
        let half = factor.solve_lower_triangular(&newton_step(l, p)?)?;
        Some(factor.solve_lower_triangular(&half.transpose())?.norm())
    };
    HIDDEN * relative().unwrap_or_else(|| relative_residual(l, p)) + factored
}

/// `[control][state]`: derivatives of u*(x, P (x - x_e)) at the equilibrium, without bounds.
pub fn linear_law(h: &Hamiltonian, model: &Model, riccati: &Riccati) -> Vec<Vec<f64>> {
    let mut graph = h.graph.clone();
    let values = h.point(model);
    let mut slopes = |symbols: &[Id]| -> Vec<Vec<f64>> {
        (h.unclamped.iter())
            .map(|u| {
                let all: Vec<Id> = symbols.iter().map(|s| graph.diff(*u, *s)).collect();
                graph.eval(&all, &values)
            })
            .collect()
    };
    let (by_x, by_p) = (slopes(&h.x), slopes(&h.p));
    let n = h.states();
    (by_x.into_iter().zip(by_p))
        .map(|(by_x, by_p)| {
            let through_p = |i: usize| (0..n).map(|k| by_p[k] * riccati.p[(k, i)]).sum::<f64>();
            (0..n).map(|i| by_x[i] + through_p(i)).collect()
        })
        .collect()
}

/// An eigenvalue as `a + bi`.
pub fn show_eigenvalue(e: Complex<f64>) -> String {
    if e.im.abs() <= 1e-12 * e.norm().max(1e-300) {
        format!("{:.6}", e.re)
    } else {
        format!(
            "{:.6} {} {:.6}i",
            e.re,
            if e.im < 0.0 { '-' } else { '+' },
            e.im.abs()
        )
    }
}

/// The extremal inputs at the equilibrium and p = 0 must be those of the equilibrium, or it is none
/// of the characteristics.
fn check_stationary(hamiltonian: &Hamiltonian, model: &Model) -> Result<(), LocalError> {
    const ROUNDING: f64 = 1e-7;
    let Horizon::Infinite { u, .. } = &model.horizon else {
        return Ok(());
    };
    let values = hamiltonian.point(model);
    let found = |exprs: &[crate::expr::Id]| hamiltonian.graph.eval(exprs, &values);
    let controls = (model
        .controls
        .iter()
        .zip(found(&hamiltonian.unclamped))
        .zip(u))
    .map(|((c, value), wanted)| ("optimal control", &c.variable.name, value, *wanted));
    let disturbances = (model
        .disturbances
        .iter()
        .zip(found(&hamiltonian.disturbance)))
    .map(|(w, value)| ("worst-case disturbance", &w.name, value, 0.0));
    let off = |(_, _, value, wanted): &(&str, &String, f64, f64)| {
        let size = wanted.abs().max(if *wanted == 0.0 { 1.0 } else { 0.0 });
        (value - wanted).abs() > ROUNDING * size
    };
    match controls.chain(disturbances).find(off) {
        Some((role, name, value, wanted)) => Err(LocalError::NotStationary {
            role,
            name: name.clone(),
            value,
            wanted,
        }),
        None => Ok(()),
    }
}

fn input_matrix(hamiltonian: &Hamiltonian, model: &Model, widths: &DVector<f64>) -> DMatrix<f64> {
    let mut graph = hamiltonian.graph.clone();
    let mut values = hamiltonian.point(model);
    values.extend(model.controls.iter().map(|c| (c.variable.symbol, 0.0)));
    values.extend(model.disturbances.iter().map(|w| (w.symbol, 0.0)));
    let rates: Vec<_> = model.dynamics.iter().map(|d| d.expr).collect();
    let mut b = DMatrix::zeros(rates.len(), model.controls.len());
    for (j, control) in model.controls.iter().enumerate() {
        let slopes = graph.diff_all(&rates, control.variable.symbol);
        for (i, v) in graph.eval(&slopes, &values).into_iter().enumerate() {
            b[(i, j)] = v / widths[i];
        }
    }
    b
}

/// Popov-Belevitch-Hautus test: `[A - lambda I, B]` keeps full rank at every eigenvalue that does
/// not decay.
fn check_stabilizable(a: &DMatrix<f64>, b: &DMatrix<f64>) -> Result<(), LocalError> {
    let n = a.nrows();
    let scale = if a.norm() > 0.0 { a.norm() } else { 1.0 };
    // The rank does not depend on the size of the inputs' columns.
    let mut b = b.clone();
    for mut column in b.column_iter_mut().filter(|c| c.norm() > 0.0) {
        let factor = scale / column.norm();
        column *= factor;
    }
    for lambda in &eigenvalues_of(a) {
        if lambda.re < -ON_AXIS * scale {
            continue;
        }
        let test = DMatrix::from_fn(n, n + b.ncols(), |i, j| {
            let real = if j < n { a[(i, j)] } else { b[(i, j - n)] };
            Complex::new(real, 0.0)
                - if i == j {
                    *lambda
                } else {
                    Complex::new(0.0, 0.0)
                }
        });
        let distance = test.singular_values().min() / scale;
        // The eigenvalue itself is only known to about this.
        if distance < 1e-8 {
            return Err(LocalError::NotStabilizable {
                eigenvalue: show_eigenvalue(*lambda),
                distance,
            });
        }
    }
    Ok(())
}

fn check_imaginary_axis(l: &Linearization, model: &Model, game: bool) -> Result<(), LocalError> {
    let m = l.balanced().0.hamiltonian_matrix();
    let scale = m.norm().max(f64::MIN_POSITIVE);
    let nearest = nearest_to_axis(&eigenvalues_of(&m));
    match nearest {
        Some(e) if e.re.abs() < ON_AXIS * scale => Err(LocalError::ImaginaryAxis {
            eigenvalue: show_eigenvalue(e),
            distance: e.re.abs() / scale,
            hint: why_on_axis(l, model, e, game),
        }),
        _ => Ok(()),
    }
}

/// Why an eigenvalue lies on the axis, as far as the second derivatives of the cost at the
/// equilibrium tell.
fn why_on_axis(l: &Linearization, model: &Model, eigenvalue: Complex<f64>, game: bool) -> String {
    let level = "the attenuation asked is below what the linearization allows";
    let size = l.q.norm();
    // Scaled by the region's widths, so that it is of the size that L has over the region.
    if size <= RANK * running_size(model) {
        let hint = "the running cost is flat there, its second derivatives along the states are all 0: add a term quadratic in them";
        return if game {
            format!("{level}, or {hint}")
        } else {
            hint.to_owned()
        };
    }
    let eigen = l.q.clone().symmetric_eigen();
    let (k, least) = eigen.eigenvalues.argmin();
    if least < -RANK * size {
        let direction = direction(model, eigen.eigenvectors.column(k).iter().copied());
        let hint = format!(
            "the running cost curves down there along ({direction}): leaving the equilibrium that way pays, so resting at it is not optimal; make the cost convex in the states"
        );
        return if game {
            format!("{level}, or {hint}")
        } else {
            hint
        };
    }
    if game {
        return format!("{level}, or a mode on the axis is not seen by the cost");
    }
    match unseen_mode(l, eigenvalue) {
        Some(mode) => format!(
            "its mode, along ({}), neither decays nor is seen by the cost; weigh it in the running cost or use a finite horizon",
            direction(model, mode.into_iter())
        ),
        None => "the running cost does not hold the states there: make it convex in the states"
            .to_owned(),
    }
}

/// Size of the running cost in the region: the largest of its second derivatives, each times the
/// region's widths.
fn running_size(model: &Model) -> f64 {
    let mut graph = model.graph.clone();
    let widths = widths(model);
    let mut values = model.parameter_values();
    values.extend(model.controls.iter().map(|c| (c.variable.symbol, 0.0)));
    values.extend(model.disturbances.iter().map(|w| (w.symbol, 0.0)));
    let corners = [0.0, 0.25, 0.75, 1.0].map(|share| {
        let states = model.states.iter().zip(&model.region);
        let at = states.map(|(s, [lo, hi])| (s.variable.symbol, lo + (hi - lo) * share));
        at.collect::<Vec<_>>()
    });
    let mut largest = 0.0f64;
    for (i, state) in model.states.iter().enumerate() {
        let slope = graph.diff(model.running.expr, state.variable.symbol);
        let second = graph.diff(slope, state.variable.symbol);
        for corner in &corners {
            values.extend(corner.iter().copied());
            let value = graph.eval(&[second], &values)[0].abs() * widths[i].powi(2);
            largest = largest.max(if value.is_finite() { value } else { 0.0 });
        }
    }
    largest
}

/// A direction in which the mode of an eigenvalue on the axis lies outside what the cost sees, in
/// scaled coordinates: `[A - i omega; Q] v = 0`. `None` where there is none.
fn unseen_mode(l: &Linearization, eigenvalue: Complex<f64>) -> Option<Vec<f64>> {
    /// The eigenvalue itself is only known to about this (see [`ON_AXIS`]).
    const LOST: f64 = 1e-6;
    let n = l.a.nrows();
    let (a, q) = (
        l.a.norm().max(f64::MIN_POSITIVE),
        l.q.norm().max(f64::MIN_POSITIVE),
    );
    let axis = Complex::new(0.0, eigenvalue.im);
    let test = DMatrix::from_fn(2 * n, n, |i, j| {
        let on = if i == j {
            axis / a
        } else {
            Complex::new(0.0, 0.0)
        };
        let entry = if i < n {
            l.a[(i, j)] / a
        } else {
            l.q[(i - n, j)] / q
        };
        Complex::new(entry, 0.0) - on
    });
    let svd = test.svd(false, true);
    let (k, least) = svd.singular_values.argmin();
    let rows = svd.v_t.filter(|_| least < LOST)?;
    Some(rows.row(k).iter().map(|c| c.norm()).collect())
}

/// A direction in words: the scaled states that it moves.
fn direction(model: &Model, components: impl Iterator<Item = f64>) -> String {
    const SHOWN: f64 = 0.1;
    let components: Vec<f64> = components.collect();
    let largest = components.iter().fold(0.0f64, |a, c| a.max(c.abs()));
    let names = model.states.iter().map(|s| s.variable.name.as_str());
    let moved = names
        .zip(&components)
        .filter(|(_, c)| c.abs() >= SHOWN * largest);
    moved
        .map(|(n, c)| format!("{n}: {c:.2}"))
        .collect::<Vec<_>>()
        .join(", ")
}

/// The eigenvalue nearest to the imaginary axis.
pub(super) fn nearest_to_axis(eigenvalues: &[Complex<f64>]) -> Option<Complex<f64>> {
    (eigenvalues.iter().copied()).min_by(|x, y| x.re.abs().total_cmp(&y.re.abs()))
}

/// The matrix sign function, by Newton's iteration (J. D. Roberts 1980); `None` where it meets a
/// singular matrix.
pub(super) fn sign(matrix: DMatrix<f64>) -> Option<DMatrix<f64>> {
    let mut z = matrix;
    for _ in 0..100 {
        let inverse = z.clone().lu().try_inverse()?;
        // Scaling by norms speeds the first iterations; near the limit it is 1.
        let c = (z.norm() / inverse.norm()).sqrt();
        let next = (&z / c + &inverse * c) * 0.5;
        let change = (&next - &z).norm() / next.norm();
        z = next;
        if change < 1e-14 {
            break;
        }
    }
    Some(z)
}

/// Matrix sign iteration for the stable invariant subspace, then Newton steps on the equation.
fn stabilizing(l: &Linearization) -> Result<DMatrix<f64>, LocalError> {
    let n = l.a.nrows();
    let no = |reason: &str| LocalError::NoSolution {
        reason: reason.into(),
    };
    let (b, factor) = l.balanced();
    let z = sign(b.hamiltonian_matrix())
        .ok_or_else(|| no("the sign iteration met a singular matrix"))?;
    // (sign + I) [I; P] = 0
    let identity = DMatrix::<f64>::identity(n, n);
    let mut left = DMatrix::zeros(2 * n, n);
    left.view_mut((0, 0), (n, n))
        .copy_from(&z.view((0, n), (n, n)));
    left.view_mut((n, 0), (n, n))
        .copy_from(&(z.view((n, n), (n, n)) + &identity));
    let mut right = DMatrix::zeros(2 * n, n);
    right
        .view_mut((0, 0), (n, n))
        .copy_from(&-(z.view((0, 0), (n, n)) + &identity));
    right
        .view_mut((n, 0), (n, n))
        .copy_from(&-z.view((n, 0), (n, n)));
    let svd = left.svd(true, true);
    let smallest = svd.singular_values.min() / svd.singular_values.max();
    if smallest.is_nan() || smallest < RANK {
        return Err(no(
            "the stable subspace has no graph over the states (a mode cannot be stabilized)",
        ));
    }
    let p = svd.solve(&right, 0.0).map_err(no)?;
    Ok(polished(l, (&p + p.transpose()) * (0.5 * factor)).0)
}

/// Newton steps on the Riccati equation as long as they lower its relative residual, which is
/// returned with the solution.
pub(super) fn polished(l: &Linearization, p: DMatrix<f64>) -> (DMatrix<f64>, f64) {
    let mut p = p;
    let mut best = relative_residual(l, &p);
    for _ in 0..8 {
        let Some(step) = newton_step(l, &p) else {
            break;
        };
        let next = &p + (&step + step.transpose()) * 0.5;
        let residual = relative_residual(l, &next);
        if residual.is_nan() || residual >= best {
            break;
        }
        (p, best) = (next, residual);
    }
    (p, best)
}

fn equation(l: &Linearization, p: &DMatrix<f64>) -> DMatrix<f64> {
    l.a.transpose() * p + p * &l.a + p * &l.g * p + &l.q
}

fn relative_residual(l: &Linearization, p: &DMatrix<f64>) -> f64 {
    let terms = 2.0 * (p * &l.a).norm() + (p * &l.g * p).norm() + l.q.norm();
    equation(l, p).norm() / terms.max(f64::MIN_POSITIVE)
}

/// Solves `Ac' X + X Ac = -residual` as a linear system of n^2 unknowns.
fn newton_step(l: &Linearization, p: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let n = l.a.nrows();
    // n^2 x n^2 elimination; beyond this the sign iteration's own accuracy must do.
    if n > 24 {
        return None;
    }
    let ac = &l.a + &l.g * p;
    let identity = DMatrix::<f64>::identity(n, n);
    let operator = identity.kronecker(&ac.transpose()) + ac.transpose().kronecker(&identity);
    let right = -DVector::from_column_slice(equation(l, p).as_slice());
    let x = operator.lu().solve(&right)?;
    Some(DMatrix::from_column_slice(n, n, x.as_slice()))
}

fn check_positive(scaled: &DMatrix<f64>, model: &Model, game: bool) -> Result<(), LocalError> {
    let eigen = scaled.clone().symmetric_eigen();
    let (k, smallest) = eigen.eigenvalues.argmin();
    let largest = eigen.eigenvalues.max();
    if game && smallest < -RANK * largest.abs() {
        return Err(LocalError::BelowAttenuation { smallest, largest });
    }
    if smallest.is_nan() || smallest <= RANK * largest {
        let v = eigen.eigenvectors.column(k);
        return Err(LocalError::NotPositive {
            smallest,
            largest,
            direction: direction(model, v.iter().copied()),
        });
    }
    Ok(())
}

/// Eigenvalues of a matrix. The QR iteration may stand still on a defective one (a chain of
/// integrators); a change of some roundings moves it on.
pub(crate) fn eigenvalues_of(matrix: &DMatrix<f64>) -> Vec<Complex<f64>> {
    const ITERATIONS: usize = 10_000;
    let size = matrix.amax().max(f64::MIN_POSITIVE);
    for change in [0.0, 1e-15, 1e-14, 1e-13, 1e-12] {
        let noise = |i: usize, j: usize| change * size * ((i * 7 + j * 13 + 1) as f64).sin();
        let moved = DMatrix::from_fn(matrix.nrows(), matrix.ncols(), |i, j| {
            matrix[(i, j)] + noise(i, j)
        });
        if let Some(schur) = nalgebra::Schur::try_new(moved, f64::EPSILON, ITERATIONS) {
            return schur.complex_eigenvalues().iter().copied().collect();
        }
    }
    vec![Complex::new(f64::NAN, f64::NAN); matrix.nrows()]
}
