//! Orbits that come back to themselves after some events: Newton's method on the return map, and the
//! multipliers of its linearization.

use super::flight::{End, Jump, Options, Simulator};
use crate::backend::{Backend, BackendError, By, Kernel, Spec};
use crate::expr::{Graph, Id, Kind};
use crate::model::{Event, Method, Precision};
use crate::program::Program;
use nalgebra::{Complex, DMatrix, DVector, Schur};

/// Newton's steps, and how small the last one must be, in widths of the region; or in tolerances.
const STEPS: usize = 40;
const CLOSED: f64 = 1e-11;
const TOLERANCES: f64 = 10.0;
/// Multipliers nearer to 1 than this, or than so many tolerances, are those of a family of orbits.
const NEUTRAL: f64 = 1e-7;
/// What is back to rounding: in widths of the region, and as a share of an orbit's extent.
const ROUNDED: f64 = 1e-12;
const RETURNS: f64 = 1e-10;
/// Sweeps over a matrix until its singular values or eigenvalues are there.
const SWEEPS: usize = 10_000;
/// An orbit is longer than so many of what counts as being back.
const LENGTH: f64 = 10.0;
/// How near an orbit begins to the surface of its event, relative to the condition.
const AFTER: f64 = 1e-9;
/// Longest step, and how far from the guess an orbit may begin, in widths.
const LONGEST: f64 = 0.5;
const FURTHEST: f64 = 3.0;

/// A periodic orbit.
#[derive(Clone, Debug, PartialEq)]
pub struct Cycle {
    /// The state after the event that it begins with.
    pub start: Vec<f64>,
    pub period: f64,
    /// Eigenvalues of the return map (re, im), the largest first. States after an event lie on a
    /// surface: one of them is 0 for each condition that an event leaves met.
    pub multipliers: Vec<[f64; 2]>,
    /// |return map - start|, in widths of the region.
    pub residual: f64,
    pub iterations: usize,
    /// How near to 1 a multiplier may be that says nothing.
    neutral: f64,
}

impl Cycle {
    /// The size of the largest multiplier.
    fn largest(&self) -> f64 {
        let sizes = self.multipliers.iter().map(|[re, im]| re.hypot(*im));
        sizes.fold(0.0, f64::max)
    }

    /// Whether neighbours come back to it.
    #[must_use]
    pub fn is_stable(&self) -> bool {
        self.largest() < 1.0 - self.neutral
    }

    /// Whether some of them part from it.
    #[must_use]
    pub fn is_unstable(&self) -> bool {
        self.largest() > 1.0 + self.neutral
    }
}

/// Why there is none.
#[derive(Clone, Debug, PartialEq)]
pub enum CycleError {
    /// A flight from near the guess, or an iterate, ended in another way.
    NoReturn { start: Vec<f64>, end: End },
    /// |return map - start| is left, in widths of the region.
    Diverged { residual: f64 },
    /// What comes back is at rest: an equilibrium, not an orbit.
    AtRest { state: Vec<f64> },
}

/// Linearizations: the variation of a flight, and derivatives of conditions and maps.
struct Linear {
    /// `(x, T, v)`: v is a variation of x, at a given time.
    varied: Box<dyn Kernel>,
    rates: Program,
    /// Of a state: the gradient of each event's `ahead`.
    gradients: Program,
    /// Of a state: the Jacobian of each event's map, row by row.
    jacobians: Vec<Option<Program>>,
}

/// A system with events whose orbits are looked for.
pub struct Orbits {
    simulator: Simulator,
    linear: Linear,
}

crate::opaque!(Orbits);

impl Orbits {
    /// As [`Simulator::new`], which the simulator is made by.
    ///
    /// # Errors
    /// What the backend refuses to compile.
    pub fn new(
        graph: &mut Graph,
        simulator: Simulator,
        (x, rates): (&[Id], &[Id]),
        (events, guards): (&[Event], &[Event]),
        (backend, method, precision): (&dyn Backend, Method, Precision),
    ) -> Result<Self, BackendError> {
        let all: Vec<&Event> = events.iter().chain(guards).collect();
        let duration = graph.symbol("phase duration", Kind::Parameter);
        let linear = Linearized::new(graph, x, rates, &all, duration);
        let switches = graph.kinks(rates);
        let varied = Spec {
            rate: Program::lower(graph, &linear.inputs, &linear.varied),
            guards: None,
            kinks: (!switches.is_empty())
                .then(|| Program::lower(graph, &[x, &[duration]].concat(), &switches)),
            method,
            precision,
            by: By::Time,
            store: false,
        };
        let of_state = |roots: &[Id]| Program::lower(graph, x, roots);
        Ok(Self {
            simulator,
            linear: Linear {
                varied: backend.compile(&varied)?,
                rates: of_state(rates),
                gradients: of_state(&linear.gradients),
                jacobians: (linear.jacobians.iter())
                    .map(|all| all.as_ref().map(|all| of_state(all)))
                    .collect(),
            },
        })
    }

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
            // It begins with the state after an event.
            begins: AFTER,
            ..options.clone()
        };
        let closed = CLOSED.max(TOLERANCES * options.rtol);
        let neutral = NEUTRAL.max(TOLERANCES * options.rtol);
        // States after an event lie on its surface; a guess need not.
        let first = self.simulator.fly(guess, &options)?;
        let mut x = match first.end[0] {
            End::Events => DVector::from_vec(first.last),
            end => {
                return Ok(Err(CycleError::NoReturn {
                    start: guess.to_vec(),
                    end,
                }));
            }
        };
        let guess = x.clone();
        let widths = |v: &DVector<f64>| {
            let shares = v.iter().zip(&options.widths).map(|(v, w)| (v / w).abs());
            shares.fold(0.0, f64::max)
        };
        let (mut residual, mut is_near) = (f64::INFINITY, false);
        for iterations in 1..=STEPS {
            let flown = self.simulator.fly(x.as_slice(), &options)?;
            // At rest everything is back.
            let rates = DVector::from_vec(self.linear.rates.eval(x.as_slice()));
            let extent = widths(&rates) * flown.t[0];
            let moves = extent > LENGTH * LENGTH * closed;
            if flown.end[0] != End::Events {
                let state = x.as_slice().to_vec();
                return Ok(Err(match (moves, flown.end[0]) {
                    (false, End::Time) => CycleError::AtRest { state },
                    (_, end) => CycleError::NoReturn { start: state, end },
                }));
            }
            let map = self.linearized(x.as_slice(), &flown.jumps, &options)?;
            let back = DVector::from_column_slice(&flown.last);
            let off = &back - &x;
            residual = widths(&off);
            if !map.iter().chain(off.iter()).all(|v| v.is_finite()) {
                break;
            }
            let apart = DMatrix::identity(n, n) - &map;
            let schur = Schur::try_new(map.clone(), f64::EPSILON, SWEEPS);
            let apart = apart.try_svd(true, true, f64::EPSILON, SWEEPS);
            let (Some(schur), Some(mut apart)) = (schur, apart) else {
                break;
            };
            // Of a family of orbits none is singled out: any that is back will do. As many directions
            // are left alone as there are multipliers of 1.
            let eigenvalues = schur.complex_eigenvalues();
            let near_one = |e: &&Complex<f64>| (e.re - 1.0).hypot(e.im) < neutral;
            let alone = eigenvalues.iter().filter(near_one).count();
            let is_family = alone > 0;
            let mut sizes: Vec<f64> = apart.singular_values.iter().copied().collect();
            sizes.sort_by(f64::total_cmp);
            let least = alone.checked_sub(1).map_or(0.0, |last| sizes[last]);
            (apart.singular_values.iter_mut())
                .filter(|size| **size <= least)
                .for_each(|size| *size = 0.0);
            let step = apart.solve(&off, 0.0).ok();
            let step = step.filter(|s| s.iter().all(|v| v.is_finite()));
            let is_small = step.as_ref().is_some_and(|s| widths(s) <= closed);
            // One more step is worth more than the tolerance.
            let is_found = is_small && is_near;
            is_near = is_small;
            // A part of what it goes through; what is back to rounding is back, however ill-conditioned
            // the map is.
            let is_exact = residual <= ROUNDED && residual <= RETURNS * extent;
            let is_back = residual <= LENGTH * closed
                && residual <= LENGTH * RETURNS * extent
                && (is_exact || is_found || is_family && is_small);
            if is_back && !moves {
                let state = back.as_slice().to_vec();
                return Ok(Err(CycleError::AtRest { state }));
            }
            if is_back {
                let mut multipliers: Vec<[f64; 2]> =
                    eigenvalues.iter().map(|e| [e.re, e.im]).collect();
                let size = |e: &[f64; 2]| e[0].hypot(e[1]);
                multipliers.sort_by(|a, b| size(b).total_cmp(&size(a)));
                return Ok(Ok(Cycle {
                    start: back.as_slice().to_vec(),
                    period: flown.t[0],
                    multipliers,
                    residual,
                    iterations,
                    neutral,
                }));
            }
            let Some(step) = step else { break };
            let share = (LONGEST / widths(&step)).min(1.0);
            x += share * step;
            if widths(&(&x - &guess)) > FURTHEST {
                break;
            }
        }
        Ok(Err(CycleError::Diverged { residual }))
    }

    /// Derivative of the state after these events by the one at the beginning: of each phase the
    /// variation at a given time, the event's time that changes with it, and the map (the saltation
    /// matrix; M. di Bernardo et al., Piecewise-smooth Dynamical Systems, 2008, 2.5).
    fn linearized(
        &mut self,
        from: &[f64],
        jumps: &[Jump],
        options: &Options,
    ) -> Result<DMatrix<f64>, BackendError> {
        let n = from.len();
        let begins = std::iter::once(from).chain(jumps.iter().map(|j| j.after.as_slice()));
        let times = std::iter::once(0.0).chain(jumps.iter().map(|j| j.t));
        let mut seeds = Vec::new();
        for ((begin, t), jump) in begins.zip(times).zip(jumps) {
            for column in 0..n {
                seeds.extend_from_slice(begin);
                seeds.push(jump.t - t);
                seeds.extend((0..n).map(|i| f64::from(u8::from(i == column))));
            }
        }
        let width = 2 * n + 1;
        let run = self.simulator.run(options, vec![1.0], width);
        let flown = self.linear.varied.integrate(&run, &seeds)?;
        let mut whole = DMatrix::identity(n, n);
        for (k, jump) in jumps.iter().enumerate() {
            let phi = DMatrix::from_fn(n, n, |i, j| flown.end[(k * n + j) * width + n + 1 + i]);
            let rate = DVector::from_vec(self.linear.rates.eval(&jump.before));
            let gradients = self.linear.gradients.eval(&jump.before);
            let gradient = DVector::from_column_slice(&gradients[jump.event * n..][..n]);
            let speed = gradient.dot(&rate);
            let met = DMatrix::identity(n, n) - &rate * gradient.transpose() / speed;
            if let Some(map) = &self.linear.jacobians[jump.event] {
                let map = DMatrix::from_row_slice(n, n, &map.eval(&jump.before));
                whole = map * met * phi * whole;
            }
        }
        Ok(whole)
    }
}

/// Expressions of [`Linear`].
struct Linearized {
    /// `(x, T, v)`.
    inputs: Vec<Id>,
    varied: Vec<Id>,
    gradients: Vec<Id>,
    jacobians: Vec<Option<Vec<Id>>>,
}

impl Linearized {
    fn new(graph: &mut Graph, x: &[Id], rates: &[Id], all: &[&Event], duration: Id) -> Self {
        let column: Vec<Id> = (0..x.len())
            .map(|i| graph.symbol(&format!("variation {i}"), Kind::State))
            .collect();
        let along = x.iter().copied().zip(column.iter().copied()).collect();
        let tangents = graph.tangents(rates, &along);
        let zero = graph.constant(0.0);
        let mut varied: Vec<Id> = rates.iter().map(|f| graph.mul(duration, *f)).collect();
        varied.push(zero);
        varied.extend(
            tangents
                .iter()
                .map(|t| graph.mul(duration, *t))
                .collect::<Vec<_>>(),
        );
        let gradients = (all.iter())
            .flat_map(|e| graph.gradient(e.ahead, x))
            .collect();
        let jacobians = (all.iter())
            .map(|e| {
                let rows = e.map.as_ref()?.iter();
                Some(rows.flat_map(|row| graph.gradient(*row, x)).collect())
            })
            .collect();
        Self {
            inputs: [x, &[duration], &column].concat(),
            varied,
            gradients,
            jacobians,
        }
    }
}
