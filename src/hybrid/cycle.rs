//! Orbits that come back to themselves after some events: Newton's method on the return map, and the
//! multipliers of its linearization.

use super::flight::{End, Options, Simulator};
use crate::backend::BackendError;
use nalgebra::{DMatrix, DVector};

/// Newton's steps, and how small the last one must be, relative to the state; or in tolerances.
const STEPS: usize = 40;
const CLOSED: f64 = 1e-11;
const TOLERANCES: f64 = 10.0;
/// Differences by which the return map is linearized, fourth order: what rounding and the tolerance
/// leave of the map (a share of it), over the size of its fifth derivatives (in units of the state),
/// gives the step whose two errors are equal.
const FIFTH: f64 = 1e5;
const LEAST_NOISE: f64 = 1e-14;
/// Least size of a state that differences are relative to.
const LEAST_SIZE: f64 = 1e-3;

/// A periodic orbit.
#[derive(Clone, Debug, PartialEq)]
pub struct Cycle {
    /// The state after the event that it begins with.
    pub start: Vec<f64>,
    pub period: f64,
    /// Eigenvalues of the return map (re, im), the largest first. States after an event lie on a
    /// surface: one of them is 0 for each condition that an event leaves met.
    pub multipliers: Vec<[f64; 2]>,
    /// |return map - start|, relative to the state.
    pub residual: f64,
    pub iterations: usize,
}

impl Cycle {
    /// Whether neighbours come back to it.
    #[must_use]
    pub fn is_stable(&self) -> bool {
        self.multipliers.iter().all(|[re, im]| re.hypot(*im) < 1.0)
    }
}

/// Why there is none.
#[derive(Clone, Debug, PartialEq)]
pub enum CycleError {
    /// A flight from near the guess, or an iterate, ended in another way.
    NoReturn { start: Vec<f64>, end: End },
    /// |return map - start| is left, relative to the state.
    Diverged { residual: f64 },
}

impl Simulator {
    /// The orbit near a state that comes back to itself after `events` events.
    ///
    /// # Errors
    /// Device failures, and a deadline that has passed.
    pub fn cycle(
        &mut self,
        guess: &[f64],
        events: usize,
        options: &Options,
    ) -> Result<Result<Cycle, CycleError>, BackendError> {
        let n = guess.len();
        let options = Options {
            events,
            samples: 0,
            ..options.clone()
        };
        let closed = CLOSED.max(TOLERANCES * options.rtol);
        let mut x = DVector::from_column_slice(guess);
        let mut residual = f64::INFINITY;
        for iterations in 1..=STEPS {
            let size = x.amax().max(LEAST_SIZE);
            let h = (options.rtol.max(LEAST_NOISE) / FIFTH).powf(0.2) * size;
            // The state, and four about it along each axis.
            let mut starts = x.as_slice().to_vec();
            for j in 0..n {
                for k in [-2.0, -1.0, 1.0, 2.0] {
                    let mut moved = x.clone();
                    moved[j] += k * h;
                    starts.extend_from_slice(moved.as_slice());
                }
            }
            let flown = self.fly(&starts, &options)?;
            if let Some(i) = flown.end.iter().position(|end| *end != End::Events) {
                return Ok(Err(CycleError::NoReturn {
                    start: starts[i * n..][..n].to_vec(),
                    end: flown.end[i],
                }));
            }
            let at = |i: usize| DVector::from_column_slice(&flown.last[i * n..][..n]);
            let mut map = DMatrix::zeros(n, n);
            for j in 0..n {
                let [a, b, c, d] = [0, 1, 2, 3].map(|k| at(1 + 4 * j + k));
                let slope = (&a - &d + 8.0 * (&c - &b)) / (12.0 * h);
                map.set_column(j, &slope);
            }
            let off = at(0) - &x;
            residual = off.amax() / size;
            let step = (DMatrix::identity(n, n) - &map).lu().solve(&off);
            let Some(step) = step.filter(|s| s.iter().all(|v| v.is_finite())) else {
                break;
            };
            if step.amax() <= closed * size {
                let eigenvalues = map.complex_eigenvalues();
                let mut multipliers: Vec<[f64; 2]> =
                    eigenvalues.iter().map(|e| [e.re, e.im]).collect();
                let size = |e: &[f64; 2]| e[0].hypot(e[1]);
                multipliers.sort_by(|a, b| size(b).total_cmp(&size(a)));
                return Ok(Ok(Cycle {
                    start: at(0).as_slice().to_vec(),
                    period: flown.t[0],
                    multipliers,
                    residual,
                    iterations,
                }));
            }
            x += step;
        }
        Ok(Err(CycleError::Diverged { residual }))
    }
}
