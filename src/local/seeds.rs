//! Seeds: points of the stable manifold on a small ellipsoid about the equilibrium.

use super::series::{Basis, Equation};
use super::shape::shape;
use super::{LocalError, LocalPolynomial, Riccati};
use crate::hamiltonian::System;
use crate::model::{Model, SeedValue};
use crate::program::Program;
use nalgebra::{DMatrix, DVector};
use std::cell::RefCell;

/// Highest degree of V that is tried, and the most coefficients it may have.
const MAX_DEGREE: usize = 6;
const MAX_TERMS: usize = 800;
/// Parts of V after the last one used by which its error is told: the first is 0 where V is even.
const LOOK_AHEAD: usize = 2;
/// Directions in which the size of a homogeneous part is looked at, and what is added for those
/// between.
const PROBES: usize = 512;
const PROBE_MARGIN: f64 = 1.5;

/// What the seed ellipsoid is chosen for.
#[derive(Clone, Copy, Debug)]
pub struct SeedChoice {
    pub asked: SeedValue,
    /// Largest error of V at the seeds.
    pub tolerance: f64,
    /// Seeds lie below this V.
    pub ceiling: f64,
    /// V at which seed directions are spread evenly, as far as the linearization goes.
    pub outer: f64,
}

/// V and p near the equilibrium, and the ellipsoid `s'Ss/2 = seed_value` on which the sweep starts:
/// S is P but where V falls along some trajectories of a game (see `shape`).
#[derive(Clone, Debug)]
pub struct LocalSolution {
    pub riccati: Riccati,
    /// `s = t z` with `t'St = I`.
    t: DMatrix<f64>,
    /// `p = t^-T dV/dz`.
    to_adjoint: DMatrix<f64>,
    basis: Basis,
    value: Vec<f64>,
    /// `[monomial][derivative by z_i, then V]` up to the degree kept.
    packed: Vec<f64>,
    /// `[monomial][second derivative by z_i, z_j, j up to i, row by row]`, up to their degree.
    second: Vec<f64>,
    /// Largest sizes of the parts of V not kept, on the unit sphere of z, with their degrees.
    neglected: Vec<(i32, f64)>,
    /// V up to which controls stay inside their bounds and the ellipsoid inside the region.
    limit: f64,
    /// Degree to which V is expanded (2: the Riccati solution alone).
    pub degree: usize,
    pub seed_value: f64,
    /// Estimated error of V at the seeds: the first term left out.
    pub error: f64,
    flow: Flow,
}

/// Memory of [`LocalSolution::expansion`].
#[derive(Default)]
struct Expanding {
    z: Vec<f64>,
    at: Vec<f64>,
    sums: Vec<f64>,
    monomials: Vec<f64>,
    half: Vec<f64>,
}

thread_local! {
    static EXPANDING: RefCell<Expanding> = RefCell::default();
}

/// Homogeneous parts of V.
struct Parts {
    /// Of each degree the largest size on the unit sphere of z.
    sizes: Vec<f64>,
    /// Highest degree that is known.
    known: usize,
}

impl Parts {
    /// Error of V up to a degree at a radius: the first neglected part's size times radius^k, or
    /// that of a part after it.
    fn error_at(&self, degree: usize, radius: f64) -> f64 {
        (degree + 1..=self.known)
            .map(|k| self.sizes[k] * radius.powi(k as i32))
            .fold(0.0, f64::max)
    }

    /// The degree that meets a tolerance of V up to the largest radius, and that radius; none
    /// reaches beyond V = `limit`.
    fn widest(&self, tolerance: f64, limit: f64) -> (usize, f64) {
        let radius_for = |degree: usize| -> f64 {
            let mut radius = (2.0 * limit).sqrt();
            while self.error_at(degree, radius) > tolerance && radius > 1e-12 {
                radius *= 0.9;
            }
            radius
        };
        (2..=self.known - LOOK_AHEAD)
            .map(|d| (d, radius_for(d)))
            .fold(
                (2, 0.0),
                |best, this| if this.1 > best.1 { this } else { best },
            )
    }

    /// Degrees and sizes of the parts beyond a degree.
    fn beyond(&self, degree: usize) -> Vec<(i32, f64)> {
        (degree + 1..=self.known)
            .map(|k| (k as i32, self.sizes[k]))
            .collect()
    }
}

/// V as a power series in z: its coefficients by monomials, and the highest degree that is known.
fn series(system: &System, riccati: &Riccati, t: &DMatrix<f64>) -> (Basis, Vec<f64>, usize) {
    let n = system.states;
    let highest = (2..=MAX_DEGREE)
        .rev()
        .find(|d| Basis::size(n, d + LOOK_AHEAD) <= MAX_TERMS);
    let basis = Basis::new(n, highest.map_or(2, |d| d + LOOK_AHEAD));
    let equation = Equation {
        graph: &system.graph,
        hamiltonian: system.observer.hamiltonian,
        inputs: &system.inputs,
    };
    let (value, known) = equation.expand(&basis, t, riccati);
    (basis, value, known)
}

/// V of the seeds: as asked for, or what the radius allows.
///
/// # Errors
/// `SeedTooLarge` where what is asked for is beyond the limit of the local solution.
fn seed_value(asked: SeedValue, radius: f64, limit: f64) -> Result<f64, LocalError> {
    match asked {
        SeedValue::Auto => Ok(0.5 * radius * radius),
        SeedValue::Value(c) if c > limit => Err(LocalError::SeedTooLarge {
            value: c,
            reason: format!(
                "the local solution holds up to V = {limit:.3e} (bounds of the controls, the region, the guards, the first front)"
            ),
        }),
        SeedValue::Value(c) => Ok(c),
    }
}

impl LocalSolution {
    /// Expands V and chooses the seed ellipsoid.
    ///
    /// # Errors
    /// [`LocalError`]; `SeedTooLarge` where a given seed value leads out of the range of the local
    /// solution.
    pub fn new(
        system: &System,
        model: &Model,
        riccati: Riccati,
        choice: SeedChoice,
    ) -> Result<Self, LocalError> {
        let n = system.states;
        let (t, l) = coordinates(model, &riccati)?;
        // t^-T = (L^-T)^-T = L
        let to_adjoint = l;
        let (basis, value, known) = series(system, &riccati, &t);
        let parts = Parts {
            sizes: part_sizes(&basis, &value, n),
            known,
        };
        let limit = range_limit(system, model, &riccati, &t, choice.ceiling);
        // Where the equations have no series or it is too long, the quadratic V is used, and H
        // itself tells its error.
        let quadratic = known < 2 + LOOK_AHEAD;
        let (degree, radius) = if quadratic {
            (
                2,
                radius_by_residual(system, &riccati, &t, choice.tolerance, limit),
            )
        } else {
            parts.widest(choice.tolerance, limit)
        };
        let seed_value = seed_value(choice.asked, radius, limit)?;
        let radius = (2.0 * seed_value).sqrt();
        let error = if quadratic {
            residual_error(system, &riccati, &t, radius)
        } else {
            parts.error_at(degree, radius)
        };
        let mut kept = value;
        kept[basis.start[degree + 1]..].fill(0.0);
        let gradient = basis.gradient(&kept);
        let second: Vec<Vec<f64>> = (gradient.iter().enumerate())
            .flat_map(|(i, g)| basis.gradient(g).into_iter().take(i + 1))
            .collect();
        let second = (0..basis.start[degree - 1])
            .flat_map(|k| second.iter().map(move |c| c[k]))
            .collect();
        let terms = basis.start[degree + 1];
        let packed = (0..terms)
            .flat_map(|k| gradient.iter().chain([&kept]).map(move |c| c[k]))
            .collect();
        let inverse = to_adjoint.transpose();
        let flow = Flow::new(
            inverse * &riccati.closed_loop * &t,
            choice.outer.max(seed_value),
            seed_value,
        );
        Ok(Self {
            neglected: if quadratic {
                // The error of the quadratic V grows as a cubic term does.
                vec![(3, error / radius.powi(3))]
            } else {
                parts.beyond(degree)
            },
            flow,
            riccati,
            t,
            to_adjoint,
            basis,
            value: kept,
            packed,
            second,
            limit,
            degree,
            seed_value,
            error,
        })
    }

    /// Largest V, at most `ceiling`, of an ellipsoid on which the estimated error of V is at most
    /// `error`, with the controls well inside their bounds.
    pub fn value_within(&self, error: f64, ceiling: f64) -> f64 {
        let radius = (self.neglected.iter())
            .filter(|(_, size)| *size > 0.0)
            .map(|(k, size)| (error / size).powf(1.0 / f64::from(*k)))
            .fold((2.0 * ceiling.min(self.limit)).sqrt(), f64::min);
        0.5 * radius * radius
    }

    /// Estimated error of V on the ellipsoid `s'Ss/2 = value`.
    pub fn error_where(&self, value: f64) -> f64 {
        let radius = (2.0 * value).sqrt();
        (self.neglected.iter())
            .map(|(k, size)| size * radius.powi(*k))
            .fold(0.0, f64::max)
    }

    /// V as one polynomial, which serves up to the seeds' ellipsoid; `reference` is x at s = 0.
    pub fn polynomial(&self, reference: &[f64]) -> LocalPolynomial {
        LocalPolynomial {
            degree: self.degree,
            origin: reference.to_vec(),
            // z = t^-1 s = L's, by rows.
            matrix: self.to_adjoint.as_slice().to_vec(),
            coefficients: self.value[..self.basis.start[self.degree + 1]].to_vec(),
            reach: self.seed_value,
        }
    }

    /// `V`, `dV/ds` and the Hessian (row-major) of the local solution at a deviation.
    pub fn expansion(&self, s: &[f64]) -> (f64, Vec<f64>, Vec<f64>) {
        // Numbers of states and of pairs of them as constants.
        match s.len() {
            1 => self.expansion_of::<1, 1>(s),
            2 => self.expansion_of::<2, 3>(s),
            3 => self.expansion_of::<3, 6>(s),
            4 => self.expansion_of::<4, 10>(s),
            5 => self.expansion_of::<5, 15>(s),
            6 => self.expansion_of::<6, 21>(s),
            _ => self.expansion_of::<0, 0>(s),
        }
    }

    /// [`LocalSolution::expansion`] of N states and M pairs, or any number where that is 0.
    #[inline(always)]
    fn expansion_of<const N: usize, const M: usize>(&self, s: &[f64]) -> (f64, Vec<f64>, Vec<f64>) {
        let n = if N > 0 { N } else { s.len() };
        let pairs = if N > 0 { M } else { n * (n + 1) / 2 };
        // It is asked for at every period of a flight: memory is taken for what is returned alone.
        EXPANDING.with_borrow_mut(|scratch| {
            let Expanding {
                z,
                at,
                sums,
                monomials,
                half,
            } = scratch;
            for (all, count) in [(&mut *z, n), (at, 2 * n + 1), (sums, pairs), (half, n * n)] {
                all.clear();
                all.resize(count, 0.0);
            }
            let l = self.to_adjoint.as_slice();
            // z = L's, L by columns.
            for (z, column) in z.iter_mut().zip(l.chunks_exact(n)) {
                *z = column.iter().zip(s).map(|(l, s)| l * s).sum();
            }
            self.fill_of::<N>(z, monomials, at);
            for (m, row) in monomials.iter().zip(self.second.chunks_exact(pairs)) {
                for k in 0..pairs {
                    sums[k] += row[k] * m;
                }
            }
            let second = |i: usize, j: usize| sums[i.max(j) * (i.max(j) + 1) / 2 + i.min(j)];
            for i in 0..n {
                for j in 0..n {
                    half[i * n + j] = (0..n).map(|k| l[k * n + i] * second(k, j)).sum();
                }
            }
            let mut hessian = vec![0.0; n * n];
            for i in 0..n {
                for j in 0..n {
                    hessian[i * n + j] = (0..n).map(|k| half[i * n + k] * l[k * n + j]).sum();
                }
            }
            (at[2 * n], at[n..2 * n].to_vec(), hessian)
        })
    }

    /// Degrees and largest sizes, on the unit sphere of z, of the parts of V not kept.
    pub fn neglected(&self) -> &[(i32, f64)] {
        &self.neglected
    }

    /// Where the coefficients of each degree begin in [`LocalSolution::polynomial`], and the end.
    pub(super) fn starts(&self) -> &[usize] {
        &self.basis.start
    }

    /// `s'Ss/2`, by which the range of the local solution is told. At least `s'Ps/2`; the same but
    /// in some games.
    pub fn quadratic(&self, s: &[f64]) -> f64 {
        let columns = self.to_adjoint.as_slice().chunks_exact(s.len());
        let z = columns.map(|column| column.iter().zip(s).map(|(l, s)| l * s).sum::<f64>());
        0.5 * z.map(|z| z * z).sum::<f64>()
    }

    /// The seed `(s, p, V)` for a direction (a unit vector in the coordinates where S is the
    /// identity) in which the linearized trajectory passes the outer ellipsoid.
    ///
    /// The modes of the closed loop grow at different rates backward in time, so that most of a
    /// front far out comes from a thin part of the seed ellipsoid. Directions on the outer
    /// ellipsoid, brought inward along the linear flow, put the seeds where the fronts need them.
    pub fn seed(&self, direction: &[f64]) -> Vec<f64> {
        let mut seed = vec![0.0; 2 * direction.len() + 1];
        self.seed_into(direction, &mut seed, &mut SeedScratch::default());
        seed
    }

    /// [`LocalSolution::seed`], into memory that is there: `seed` has room for `(s, p, V)`.
    pub fn seed_into(&self, direction: &[f64], seed: &mut [f64], scratch: &mut SeedScratch) {
        // With the number of states as a constant, loops over them are none.
        match direction.len() {
            1 => self.seed_of::<1>(direction, seed, scratch),
            2 => self.seed_of::<2>(direction, seed, scratch),
            3 => self.seed_of::<3>(direction, seed, scratch),
            4 => self.seed_of::<4>(direction, seed, scratch),
            5 => self.seed_of::<5>(direction, seed, scratch),
            6 => self.seed_of::<6>(direction, seed, scratch),
            _ => self.seed_of::<0>(direction, seed, scratch),
        }
    }

    /// [`LocalSolution::seed_into`] of N states, or any number where that is 0.
    #[inline(always)]
    fn seed_of<const N: usize>(
        &self,
        direction: &[f64],
        seed: &mut [f64],
        scratch: &mut SeedScratch,
    ) {
        self.flow.inward::<N>(direction, scratch);
        self.fill_of::<N>(&scratch.z, &mut scratch.monomials, seed);
    }

    /// `(s, p, V)` of the local solution at `s = t z`.
    fn at(&self, z: &[f64]) -> Vec<f64> {
        let mut at = vec![0.0; 2 * z.len() + 1];
        self.fill_of::<0>(z, &mut Vec::new(), &mut at);
        at
    }

    /// [`LocalSolution::at`] of N states, or any number where that is 0, into memory that is there;
    /// `monomials` are those of z then.
    #[inline(always)]
    fn fill_of<const N: usize>(&self, z: &[f64], monomials: &mut Vec<f64>, to: &mut [f64]) {
        let n = if N > 0 { N } else { z.len() };
        (self.basis).monomials_into(z, self.packed.len() / (n + 1), monomials);
        let (s, rest) = to.split_at_mut(n);
        // The sums of V and of its derivatives go side by side; each is taken in order.
        let sums = &mut rest[..n + 1];
        sums.fill(0.0);
        for (m, row) in monomials.iter().zip(self.packed.chunks_exact(n + 1)) {
            for k in 0..n + 1 {
                sums[k] += row[k] * m;
            }
        }
        multiply::<N>(&self.t, z, s);
        let (q, _) = rest.split_at_mut(n);
        // p takes the place of V's derivatives.
        let terms = monomials.len();
        monomials.extend_from_slice(q);
        multiply::<N>(&self.to_adjoint, &monomials[terms..], q);
        monomials.truncate(terms);
    }

    /// V of the local solution at a deviation `s`, with `p`.
    pub fn at_state(&self, s: &[f64]) -> Vec<f64> {
        // z = t^-1 s = L' s
        let z = self.to_adjoint.transpose() * DVector::from_column_slice(s);
        let mut at = self.at(z.as_slice());
        // Not by way of z and back: a state that is 0 stays 0.
        at[..s.len()].copy_from_slice(s);
        at
    }
}

/// `t` with `t'St = I` for the S of the seeds' ellipsoid, and `L = t^-T`.
pub(super) fn coordinates(
    model: &Model,
    riccati: &Riccati,
) -> Result<(DMatrix<f64>, DMatrix<f64>), LocalError> {
    let widths: Vec<f64> = model.region.iter().map(|[lo, hi]| hi - lo).collect();
    let shape = shape(riccati, &widths)?.unwrap_or_else(|| riccati.p.clone());
    let factor = shape.cholesky().ok_or(LocalError::NoSolution {
        reason: "P has no Cholesky factor".into(),
    })?;
    let l = factor.l();
    let t = l.transpose().try_inverse().ok_or(LocalError::NoSolution {
        reason: "P is singular to rounding".into(),
    })?;
    Ok((t, l))
}

/// The linear closed loop in coordinates where `s'Ss` is `|z|^2`.
#[derive(Clone, Debug)]
struct Flow {
    rate: DMatrix<f64>,
    /// Propagators over `step * 2^k`.
    powers: Vec<DMatrix<f64>>,
    step: f64,
    outer_radius: f64,
    radius: f64,
    /// The powers that may leave a point of the outer sphere outside the inner one.
    useful: usize,
}

/// Memory that seeds are computed in.
#[derive(Clone, Debug, Default)]
pub struct SeedScratch {
    z: Vec<f64>,
    next: Vec<f64>,
    term: Vec<f64>,
    rate: Vec<f64>,
    monomials: Vec<f64>,
}

impl Flow {
    /// Steps short against the fastest mode, so that the series for the rest converges at once.
    const STEP: f64 = 0.05;
    const TERMS: usize = 10;
    /// Powers of the shortest step that are tried: enough for any ratio of values that f64 holds.
    const POWERS: usize = 40;
    const NEWTON: usize = 6;

    fn new(rate: DMatrix<f64>, outer: f64, inner: f64) -> Self {
        let step = Self::STEP / rate.norm();
        let mut powers = vec![Self::series(&rate, step)];
        for k in 1..Self::POWERS {
            powers.push(&powers[k - 1] * &powers[k - 1]);
        }
        let (outer_radius, radius) = ((2.0 * outer).sqrt(), (2.0 * inner).sqrt());
        // What the longest steps leave of any vector is less than this norm of it.
        let is_of_use = |power: &DMatrix<f64>| power.norm() * outer_radius > radius;
        let useful = powers.iter().rposition(is_of_use).map_or(0, |k| k + 1);
        Self {
            rate,
            powers,
            step,
            outer_radius,
            radius,
            useful,
        }
    }

    /// `exp(rate * t)` for a short time.
    fn series(rate: &DMatrix<f64>, t: f64) -> DMatrix<f64> {
        let n = rate.nrows();
        let mut term = DMatrix::identity(n, n);
        let mut sum = term.clone();
        for k in 1..=Self::TERMS {
            term = &term * rate * (t / k as f64);
            sum += &term;
        }
        sum
    }

    /// The point, `scratch.z`, where the trajectory from a direction on the outer sphere meets the
    /// inner sphere. `|z|` never rises along the flow: the longest steps that stay outside come
    /// first, Newton's method finds the rest of the time.
    ///
    /// Of N states, or any number where that is 0.
    #[inline(always)]
    fn inward<const N: usize>(&self, direction: &[f64], scratch: &mut SeedScratch) {
        let norm = |z: &[f64]| z.iter().map(|x| x * x).sum::<f64>().sqrt();
        scratch.z.clear();
        (scratch.z).extend(direction.iter().map(|x| x * self.outer_radius));
        if self.outer_radius > self.radius {
            scratch.next.resize(direction.len(), 0.0);
            for power in self.powers[..self.useful].iter().rev() {
                multiply::<N>(power, &scratch.z, &mut scratch.next);
                if norm(&scratch.next) > self.radius {
                    std::mem::swap(&mut scratch.z, &mut scratch.next);
                }
            }
            let mut t = 0.0;
            self.advance::<N>(t, scratch);
            for _ in 0..Self::NEWTON {
                let (moved, rate) = (&scratch.next, &scratch.rate);
                let slope: f64 = moved.iter().zip(rate).map(|(x, v)| x * v).sum();
                let excess = 0.5 * (norm(moved).powi(2) - self.radius.powi(2));
                let before = t;
                if slope < 0.0 {
                    t = (t - excess / slope).clamp(0.0, self.step);
                }
                if t == before {
                    break;
                }
                self.advance::<N>(t, scratch);
            }
            std::mem::swap(&mut scratch.z, &mut scratch.next);
        }
        let scale = self.radius / norm(&scratch.z);
        scratch.z.iter_mut().for_each(|x| *x *= scale);
    }

    /// The point a short time after `scratch.z`, as `scratch.next`, and its rate.
    #[inline(always)]
    fn advance<const N: usize>(&self, t: f64, scratch: &mut SeedScratch) {
        let SeedScratch {
            z,
            next: sum,
            term,
            rate,
            ..
        } = scratch;
        term.clone_from(z);
        sum.clone_from(z);
        rate.resize(z.len(), 0.0);
        for k in 1..=Self::TERMS {
            multiply::<N>(&self.rate, term, rate);
            let factor = t / k as f64;
            rate.iter_mut().for_each(|x| *x *= factor);
            std::mem::swap(term, rate);
            sum.iter_mut().zip(&*term).for_each(|(s, x)| *s += x);
        }
        multiply::<N>(&self.rate, sum, rate);
    }
}

/// `to = m z`, without allocation; of N components, or any number where that is 0.
#[inline(always)]
fn multiply<const N: usize>(m: &DMatrix<f64>, z: &[f64], to: &mut [f64]) {
    let n = if N > 0 { N } else { z.len() };
    let (z, to) = (&z[..n], &mut to[..n]);
    to.fill(0.0);
    for (column, x) in m.as_slice().chunks_exact(n).zip(z) {
        for k in 0..n {
            to[k] += column[k] * x;
        }
    }
}

/// Unit vectors well spread over the sphere, the same in every run.
fn probes(n: usize) -> impl Iterator<Item = Vec<f64>> {
    let mut state = 0x9e37_79b9_7f4a_7c15_u64;
    let mut normal = move || {
        // Sum of uniforms: near enough to normal for directions.
        let mut sum = -6.0;
        for _ in 0..12 {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            sum += (state >> 11) as f64 / (1u64 << 53) as f64;
        }
        sum
    };
    (0..PROBES).map(move |_| {
        let v: Vec<f64> = (0..n).map(|_| normal()).collect();
        let norm = v.iter().map(|x| x * x).sum::<f64>().sqrt().max(1e-12);
        v.into_iter().map(|x| x / norm).collect()
    })
}

/// Largest size on the unit sphere of each homogeneous part.
pub(super) fn part_sizes(basis: &Basis, value: &[f64], n: usize) -> Vec<f64> {
    let mut sizes = vec![0.0f64; basis.degree + 1];
    for z in probes(n) {
        let m = basis.monomials(&z);
        for (k, size) in sizes.iter_mut().enumerate() {
            let range = basis.start[k]..basis.start[k + 1];
            let part: f64 = value[range.clone()]
                .iter()
                .zip(&m[range])
                .map(|(c, m)| c * m)
                .sum();
            *size = size.max(PROBE_MARGIN * part.abs());
        }
    }
    sizes
}

/// Largest V for which the ellipsoid keeps the controls half-way inside their bounds and stays
/// inside the region.
fn range_limit(
    system: &System,
    model: &Model,
    riccati: &Riccati,
    t: &DMatrix<f64>,
    ceiling: f64,
) -> f64 {
    let n = system.states;
    let mut limit = ceiling;
    // Half-width of the ellipsoid along state i is sqrt(2c) |row i of t|.
    for (i, [lo, hi]) in model.region.iter().enumerate() {
        let reach = t.row(i).norm();
        limit = limit.min(0.5 * (0.25 * (hi - lo) / reach).powi(2));
    }
    let zero = vec![0.0; n];
    let rest = system.eval(&system.observer.unclamped, &zero, &zero);
    for (k, control) in model.controls.iter().enumerate() {
        let room = [
            control.min.map(|lo| rest[k] - lo),
            control.max.map(|hi| hi - rest[k]),
        ];
        let Some(room) = room.into_iter().flatten().reduce(f64::min) else {
            continue;
        };
        // Gain of the linear law along each direction, by differences over the unit sphere of the
        // ellipsoid.
        let h = 1e-6;
        let gain = (0..n)
            .map(|j| {
                let s: Vec<f64> = (0..n).map(|i| h * t[(i, j)]).collect();
                let p: Vec<f64> = (&riccati.p * DVector::from_column_slice(&s))
                    .iter()
                    .copied()
                    .collect();
                let u = system.eval(&system.observer.unclamped[k..=k], &s, &p)[0];
                ((u - rest[k]) / h).powi(2)
            })
            .sum::<f64>()
            .sqrt();
        if gain > 0.0 {
            limit = limit.min(0.5 * (0.5 * room / gain).powi(2));
        }
    }
    short_of_kinks(system, riccati, t, limit)
}

/// A state with the adjoint of the quadratic V.
fn point_on(riccati: &Riccati, s: DVector<f64>) -> Vec<f64> {
    let p = &riccati.p * &s;
    s.iter().chain(p.iter()).copied().collect()
}

/// A V, at most `limit`, whose ellipsoid lies inside the guards, and no kink of the equations cuts:
/// a series cannot follow them.
pub(super) fn short_of_kinks(
    system: &System,
    riccati: &Riccati,
    t: &DMatrix<f64>,
    limit: f64,
) -> f64 {
    let n = system.states;
    let limit = short_of_guards(system, riccati, t, limit);
    let mut graph = system.graph.clone();
    let kinks = graph.kinks(&system.rate);
    if kinks.is_empty() {
        return limit;
    }
    let program = Program::lower(&graph, &system.inputs, &kinks);
    let rest = program.eval(&vec![0.0; 2 * n]);
    let cut = |radius: f64| {
        probes(n).any(|d| {
            program
                .eval(&point_on(riccati, t * DVector::from_vec(d) * radius))
                .iter()
                .zip(&rest)
                .any(|(g, at_rest)| g * at_rest < 0.0)
        })
    };
    let mut radius = (2.0 * limit).sqrt();
    if !cut(radius) {
        return limit;
    }
    while cut(radius) && radius > 1e-12 {
        radius *= 0.8;
    }
    // Between the directions looked at a kink may be a little nearer.
    0.5 * (radius / PROBE_MARGIN).powi(2)
}

/// Places along each direction at which guards are looked at.
const SHELLS: u32 = 40;

/// A V, at most `limit`, whose ellipsoid lies inside the guards: then no way from there leaves one.
/// Guards that the equilibrium lies on the boundary of are left out.
fn short_of_guards(system: &System, riccati: &Riccati, t: &DMatrix<f64>, limit: f64) -> f64 {
    let guards: Vec<_> = system.guards.iter().map(|g| g.expr).collect();
    if guards.is_empty() {
        return limit;
    }
    let n = system.states;
    let program = Program::lower(&system.graph, &system.inputs, &guards);
    let rest = program.eval(&vec![0.0; 2 * n]);
    let whole = (2.0 * limit).sqrt();
    let mut radius = whole;
    for d in probes(n) {
        let d = t * DVector::from_vec(d);
        for k in 1..=SHELLS {
            let share = whole * f64::from(k) / f64::from(SHELLS);
            if share >= radius {
                break;
            }
            let margins = program.eval(&point_on(riccati, &d * share));
            if margins
                .iter()
                .zip(&rest)
                .any(|(g, at_rest)| *at_rest > 0.0 && (*g < 0.0 || g.is_nan()))
            {
                radius = share;
            }
        }
    }
    if radius == whole {
        return limit;
    }
    // Between the places looked at a guard may be a little nearer.
    0.5 * (radius * (1.0 - 1.0 / f64::from(SHELLS)) / PROBE_MARGIN).powi(2)
}

/// Error of the quadratic V at a radius from the residual of H there: H is the rate at which V is
/// wrong, and it falls along the closed loop at least as a cubic term does.
fn residual_error(system: &System, riccati: &Riccati, t: &DMatrix<f64>, radius: f64) -> f64 {
    let slowest = super::closed_loop_margin(riccati);
    let worst = probes(system.states)
        .map(|d| {
            let s: Vec<f64> = (t * DVector::from_vec(d) * radius)
                .iter()
                .copied()
                .collect();
            let p: Vec<f64> = (&riccati.p * DVector::from_column_slice(&s))
                .iter()
                .copied()
                .collect();
            system.eval(&[system.observer.hamiltonian], &s, &p)[0].abs()
        })
        .fold(0.0, f64::max);
    PROBE_MARGIN * worst / (3.0 * slowest)
}

fn radius_by_residual(
    system: &System,
    riccati: &Riccati,
    t: &DMatrix<f64>,
    tolerance: f64,
    limit: f64,
) -> f64 {
    let mut radius = (2.0 * limit).sqrt();
    while residual_error(system, riccati, t, radius) > tolerance && radius > 1e-12 {
        radius *= 0.8;
    }
    radius
}
