//! What a scene's sweep integrates, with which tolerances, and where its trajectories are sampled
//! and end.

use super::draft::Draft;
use super::parts::SurfacePart;
use super::surface::{Surface, corners};
use crate::backend::{Backend, Deadline, Run, Spec, Status};
use crate::expr::Id;
use crate::hamiltonian::{Hamiltonian, Slope, System, infinite};
use crate::local::{LocalError, LocalSolution, Riccati};
use crate::model::{Horizon, Method, Model, Precision, SampleBy, SeedValue, ShootOut};
use crate::program::Program;
use crate::shooting::End;

/// An explicit f64 needs no more than this tolerance to be asked for; above it f32 does.
const F32_RTOL: f64 = 1e-5;
/// Tolerances below this many rounding errors cannot be met.
const LEAST_RTOL: f64 = 4.0;
/// Share of the tolerance that the seeds may use up.
pub(super) const SEED_SHARE: f64 = 0.1;
/// A trajectory along which V may fall again is given up at this many times `value_max`, or the
/// quadratic V of the region's corners where that is more.
pub(super) const BEYOND_VALUE: f64 = 10.0;

/// Status code of the first guard; the others follow.
pub const GUARD_STATUS: i32 = 16;
/// A trajectory that cannot go on (for want of a finite or large enough step) has met the guard
/// whose value has fallen below this share: of its largest along a swept trajectory, of that at the
/// start of a closed loop's.
pub const AT_GUARD: f64 = 1e-4;
/// Status code of a trajectory that ends where the manifold folds.
pub const FOLD_STATUS: i32 = 15;

/// Why a scene cannot be swept.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    #[error(
        "the scene has no [shoot_out] section: add one, or a [map]; V, p and u at chosen states need neither: `costate solve --points`"
    )]
    NoShootOut,
    #[error(
        "{states} states: the seeds of a sweep are triangulated for at most {most} on this horizon ({MOST_STATES} on an infinite, \
         {MOST_STATES_FINITE} on a finite one); V, p and u at chosen states need no sweep: `costate solve --points` or `costate homotopy`"
    )]
    TooManyStates { states: usize, most: usize },
    #[error(
        "samples = {samples} in [shoot_out]: one trajectory's points would take {mebibytes} MiB, and {} MiB are the most: give fewer samples",
        MOST_BYTES >> 20
    )]
    TooManySamples { samples: usize, mebibytes: usize },
    #[error("the equations take {operations} operations; at most {MOST_OPERATIONS} are handled")]
    TooLong { operations: usize },
    #[error("method {method} has a fixed step: give step = ... in [integrator]")]
    NoStep { method: &'static str },
    #[error(transparent)]
    Local(#[from] LocalError),
}

/// Operations of the dynamics up to which Taylor series are chosen: a step of theirs is some hundred
/// times as long.
const SHORT: usize = 200;

/// The method that reaches a tolerance soonest on a backend (see benches/README.md for the
/// measurements).
fn best_method(backend: &dyn Backend, rtol: f64, dynamics: usize) -> Method {
    if rtol >= F32_RTOL {
        Method::Tsit5
    } else if backend.favours(Method::Taylor) && dynamics <= SHORT {
        Method::Taylor
    } else {
        Method::Dop853
    }
}

/// The first triangulation has `2^n` simplices (a finite horizon's `n!`).
const MOST_STATES: usize = 10;
const MOST_STATES_FINITE: usize = 7;
/// Instructions of one right-hand side: registers are numbered in 16 bits.
pub(crate) const MOST_OPERATIONS: usize = 30_000;
/// Bytes that the points of one trajectory may take.
const MOST_BYTES: usize = 64 << 20;

/// What is chosen in place of a scene's settings; `None` leaves the scene's.
#[derive(Clone, Copy, Debug, Default)]
pub struct Choices {
    /// Arithmetic.
    pub precision: Option<Precision>,
    /// Integration method.
    pub method: Option<Method>,
    /// Relative tolerance of a step.
    pub rtol: Option<f64>,
    /// Whether trajectories are also sampled between the seeds and the first stored level, for
    /// first guesses of boundary value problems.
    pub inner_levels: bool,
    /// Lowers the scene's cap on seeds.
    pub max_seeds: Option<usize>,
    /// Whether a scene without `[shoot_out]` is swept all the same, as far as its region may need.
    pub unasked: bool,
    /// Whether the sweep is only for first guesses, which also come without: then its states are
    /// not limited (see [`Plan::can_be_swept`]).
    pub dispensable: bool,
    /// Seed of the random sample that the error is estimated from.
    pub seed: u64,
    /// When work is ended with what is there.
    pub deadline: Deadline,
    /// Whether what is solved for by the deadline is an answer; else passing it is an error.
    pub partial: bool,
    /// What is swept of the surface of seeds, where that is not all of it.
    pub part: Option<SurfacePart>,
}

/// The coordinate that the stored points of a sweep are levels of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sampling {
    /// Levels of V (infinite horizon).
    Value,
    /// Times (finite horizon).
    Time,
    /// Arc length in widths of the region, where V is not monotone along trajectories.
    ArcLength,
}

/// With what something is integrated.
#[derive(Clone, Copy, Debug)]
pub struct Numerics {
    pub precision: Precision,
    pub method: Method,
    /// Tolerance asked; the one used may be larger where the precision is too low for it.
    pub rtol_asked: f64,
    pub rtol: f64,
    /// Absolute tolerance in units of each component's scale: the scene's, in proportion where
    /// another `rtol` is asked.
    pub atol: f64,
    /// When a simulation is given up.
    pub deadline: Deadline,
}

impl Numerics {
    /// What a scene, the command line and a backend make of it.
    ///
    /// # Errors
    /// [`PlanError::NoStep`].
    pub fn choose(
        model: &Model,
        backend: &dyn Backend,
        choices: Choices,
    ) -> Result<Self, PlanError> {
        let rtol_asked = choices.rtol.unwrap_or(model.integrator.rtol);
        let asked = choices.precision.or(model.integrator.precision);
        let precision = asked.unwrap_or(
            if rtol_asked >= F32_RTOL || !backend.supports(Precision::F64) {
                Precision::F32
            } else {
                Precision::F64
            },
        );
        let method = (choices.method.or(model.integrator.method)).unwrap_or_else(|| {
            let rates: Vec<Id> = model.dynamics.iter().map(|d| d.expr).collect();
            best_method(backend, rtol_asked, model.graph.reachable(&rates).len())
        });
        if !method.adaptive() && model.integrator.step.is_none() {
            return Err(PlanError::NoStep {
                method: method.name(),
            });
        }
        let rtol = rtol_asked.max(Plan::least_rtol(precision));
        // A tighter rtol alone would leave what is small against the region, or V on the first
        // fronts, as it was.
        let atol =
            model.integrator.atol * choices.rtol.map_or(1.0, |_| rtol / model.integrator.rtol);
        Ok(Self {
            precision,
            method,
            rtol_asked,
            rtol,
            atol,
            deadline: choices.deadline,
        })
    }
}

/// Everything a sweep needs besides a backend.
pub struct Plan {
    /// When a sweep ends with what is there, and solving for states is given up.
    pub deadline: Deadline,
    /// What is swept of the surface of seeds.
    pub part: SurfacePart,
    pub spec: Spec,
    pub run: Run,
    pub surface: Surface,
    pub sampling: Sampling,
    /// Leading levels of the run that are not part of the result.
    pub inner: usize,
    pub shoot_out: ShootOut,
    /// The local solution, for an infinite horizon.
    pub local: Option<LocalSolution>,
    /// Tolerance asked; the run's own may be larger where the precision is too low for it.
    pub rtol_asked: f64,
    /// Absolute tolerance in units of each component's scale: the scene's, in proportion where
    /// another `rtol` is asked.
    pub atol: f64,
    /// Periodic states are not limited to the region.
    pub periodic: Vec<bool>,
    pub periods: Vec<Option<f64>>,
    /// The same where dynamics and cost do not tell the periods apart either: then another copy of
    /// the equilibrium is one too. (A cost such as `theta^2` does tell them apart.)
    pub recurrent: Vec<Option<f64>>,
    pub widths: Vec<f64>,
    /// Scale of V: value_max, or the largest terminal cost.
    pub value_scale: f64,
    /// Region as deviations.
    pub region: Vec<[f64; 2]>,
    pub system: System,
    /// Whether H is `min max`: then what is certified ends at folds and no sheet is better than
    /// another.
    pub game: bool,
    /// Where the slope's upper triangle begins in the integrated vector, if it is integrated.
    pub slope: Option<usize>,
    /// Scales of the slope's entries (row-major).
    pub slope_units: Vec<f64>,
    end: End,
    /// Seed of random choices.
    pub seed: u64,
}

/// Segments are about as long as the fastest mode takes to grow by e to this power.
const SEGMENT_GROWTH: f64 = 3.0;

impl Plan {
    /// Duration of a segment of a first guess.
    pub fn segment_duration(&self) -> f64 {
        match (&self.local, &self.system.terminal) {
            (Some(local), _) => {
                let fastest = local
                    .riccati
                    .eigenvalues
                    .iter()
                    .map(|e| e.norm())
                    .fold(0.0, f64::max);
                SEGMENT_GROWTH / fastest
            }
            (None, Some(terminal)) => terminal.time / 16.0,
            (None, None) => 1.0,
        }
    }

    /// Plans the sweep of a scene on a backend.
    ///
    /// # Errors
    /// [`PlanError`] where the scene asks for none or has no local solution.
    pub fn new(
        model: &Model,
        hamiltonian: &Hamiltonian,
        backend: &dyn Backend,
        choices: Choices,
    ) -> Result<Self, PlanError> {
        let shoot_out = asked_sweep(model, hamiltonian, choices)?;
        check_size(model, &shoot_out, choices)?;
        let system = System::new(hamiltonian, model);
        check_length(&system)?;
        let numerics = Numerics::choose(model, backend, choices)?;
        let widths: Vec<f64> = model.region.iter().map(|[lo, hi]| hi - lo).collect();
        let region = deviations(&model.region, &system.reference);
        let periods: Vec<Option<f64>> = model.states.iter().map(|s| s.period).collect();
        let sampling = sampling(model, &system, &shoot_out, &region);

        let draft = Draft {
            model,
            system: &system,
            shoot_out: &shoot_out,
            numerics: &numerics,
            sampling,
            region: &region,
            widths: &widths,
        };
        let manifold = draft.manifold(hamiltonian)?;
        let value_scale = manifold.value_scale;
        let end = End::new(&system, manifold.local.as_ref());
        let slope_units = slope_units(&end, &widths, value_scale);
        let course = draft.course(&manifold, choices.inner_levels);
        let integrand = draft.integrand(value_scale, &slope_units);
        Ok(Self {
            deadline: choices.deadline,
            part: choices.part.unwrap_or(SurfacePart::WHOLE),
            run: draft.run(&course, &integrand.scales),
            slope: integrand.slope,
            spec: integrand.spec(&numerics, course.by),
            surface: manifold.surface,
            sampling,
            inner: course.inner,
            local: manifold.local,
            rtol_asked: numerics.rtol_asked,
            atol: numerics.atol,
            recurrent: recurrent(&system, &periods, &region, &widths),
            periodic: periods.iter().map(Option::is_some).collect(),
            periods,
            widths,
            value_scale,
            region,
            game: model.is_game(),
            slope_units,
            end,
            seed: choices.seed,
            shoot_out,
            system,
        })
    }

    /// Whether the plan's seeds can be triangulated. A plan that is made for a sweep always can be
    /// swept.
    pub fn can_be_swept(&self) -> bool {
        self.system.states <= most_states(self.system.terminal.is_some())
    }

    /// The integrated vector at a seed `(s, p, V)`: arc length from 0, the slope of the local
    /// solution or of the terminal cost.
    pub fn start(&self, seed: &[f64]) -> Vec<f64> {
        let mut start = vec![0.0; self.spec.dim()];
        self.start_into(seed, &mut start);
        start
    }

    /// [`Plan::start`], into memory that is there.
    pub fn start_into(&self, seed: &[f64], start: &mut [f64]) {
        let n = self.system.states;
        let (given, rest) = start.split_at_mut(seed.len());
        given.copy_from_slice(seed);
        rest.fill(0.0);
        if let Some(first) = self.slope {
            let slope = Slope::packed(&self.end.at(&seed[..n]).hessian, n);
            start[first..first + slope.len()].copy_from_slice(&slope);
        }
    }

    /// What the linearization gives for V at the costliest corner of the region; on a finite
    /// horizon the scale of V. It does not depend on how far the scene's own sweep goes.
    pub fn corner_value(&self) -> f64 {
        let Some(local) = &self.local else {
            return self.value_scale;
        };
        let largest = largest_at_corners(&local.riccati.p, &self.region);
        if largest > 0.0 && largest.is_finite() {
            largest
        } else {
            self.value_scale
        }
    }

    /// Whether neither the running cost nor, on a finite horizon, the terminal cost is negative
    /// anywhere in the region: then V never falls backward along a trajectory. (Looked at in many
    /// points.)
    pub fn costs_are_positive(&self) -> bool {
        let terminal = self.system.terminal.as_ref().map(|t| t.value);
        value_is_monotone(&self.system, &self.region)
            && terminal.is_none_or(|phi| nowhere_negative(&self.system, phi, &self.region))
    }

    /// Whether the last point of a trajectory that has ended is at a fold.
    pub fn is_folded(&self, end: &[f64]) -> bool {
        // The end is where the slope counts as infinite, to rounding.
        const NEARLY: f64 = 0.5;
        self.slope.is_some_and(|first| {
            let n = self.system.states;
            let slope = &end[first..first + Slope::len(n)];
            let size = Slope::product(slope, slope, &self.slope_units, n).sqrt();
            size.is_nan() || size >= NEARLY * infinite(self.spec.precision)
        })
    }

    /// The tightest relative tolerance that a precision can meet.
    pub fn least_rtol(precision: Precision) -> f64 {
        LEAST_RTOL * precision.epsilon()
    }

    /// Stored points a trajectory.
    pub fn samples(&self) -> usize {
        self.run.levels.len() - self.inner
    }

    pub fn method(&self) -> Method {
        self.spec.method
    }

    /// Status codes of the result file and their meanings: the general ones, then one a guard.
    pub fn status_flags(&self) -> Vec<(i32, String)> {
        let general = Status::ALL
            .iter()
            .filter(|(s, _)| *s != Status::Guard)
            .map(|(s, n)| (*s as i32, (*n).to_owned()))
            .chain(self.slope.map(|_| (FOLD_STATUS, "fold".to_owned())));
        let guards = self
            .system
            .guards
            .iter()
            .enumerate()
            .map(|(k, g)| (GUARD_STATUS + k as i32, format!("guard_{}", g.name)));
        general.chain(guards).collect()
    }

    /// Meaning of a status code.
    pub fn status_name(&self, code: i32) -> String {
        self.status_flags()
            .into_iter()
            .find(|(c, _)| *c == code)
            .map_or_else(|| format!("status_{code}"), |(_, n)| n)
    }
}

/// The sweep that the scene asks for, or one for first guesses, with no more seeds than chosen.
///
/// # Errors
/// [`PlanError::NoShootOut`]; [`PlanError::Local`].
fn asked_sweep(
    model: &Model,
    hamiltonian: &Hamiltonian,
    choices: Choices,
) -> Result<ShootOut, PlanError> {
    let mut shoot_out = match &model.shoot_out {
        Some(asked) => asked.clone(),
        None if choices.unasked => unasked_sweep(model, hamiltonian)?,
        None => return Err(PlanError::NoShootOut),
    };
    shoot_out.max_seeds = choices
        .max_seeds
        .map_or(shoot_out.max_seeds, |m| m.min(shoot_out.max_seeds));
    Ok(shoot_out)
}

/// Whether seeds can be triangulated, and one trajectory's points held.
///
/// # Errors
/// [`PlanError::TooManyStates`]; [`PlanError::TooManySamples`].
fn check_size(model: &Model, shoot_out: &ShootOut, choices: Choices) -> Result<(), PlanError> {
    let n = model.states.len();
    let most = most_states(matches!(model.horizon, Horizon::Finite { .. }));
    if n > most && !choices.dispensable {
        return Err(PlanError::TooManyStates { states: n, most });
    }
    let bytes = shoot_out.samples.saturating_mul(8 * (2 * n + 3));
    if bytes > MOST_BYTES {
        return Err(PlanError::TooManySamples {
            samples: shoot_out.samples,
            mebibytes: bytes >> 20,
        });
    }
    Ok(())
}

/// Whether the equations are short enough to be numbered.
///
/// # Errors
/// [`PlanError::TooLong`].
fn check_length(system: &System) -> Result<(), PlanError> {
    let operations = Program::lower(&system.graph, &system.inputs, &system.rate)
        .code
        .len();
    if operations > MOST_OPERATIONS {
        return Err(PlanError::TooLong { operations });
    }
    Ok(())
}

/// The coordinate to sample by: the one asked for, else V where it is monotone along trajectories.
fn sampling(model: &Model, system: &System, shoot_out: &ShootOut, region: &[[f64; 2]]) -> Sampling {
    if matches!(model.horizon, Horizon::Finite { .. }) {
        return Sampling::Time;
    }
    match shoot_out.sample_by {
        Some(SampleBy::Value) => Sampling::Value,
        Some(SampleBy::ArcLength) => Sampling::ArcLength,
        None if !model.is_game() && value_is_monotone(system, region) => Sampling::Value,
        None => Sampling::ArcLength,
    }
}

/// A box as deviations from a point.
fn deviations(region: &[[f64; 2]], reference: &[f64]) -> Vec<[f64; 2]> {
    (region.iter().zip(reference))
        .map(|([lo, hi], x)| [lo - x, hi - x])
        .collect()
}

/// The periods by which all rates, the running cost among them, and the guards repeat (looked at in
/// many points).
fn recurrent(
    system: &System,
    periods: &[Option<f64>],
    region: &[[f64; 2]],
    widths: &[f64],
) -> Vec<Option<f64>> {
    const POINTS: usize = 64;
    const ALIKE: f64 = 1e-9;
    let n = system.states;
    let program = Program::lower(&system.graph, &system.inputs, &system.rate);
    let guards: Vec<_> = system.guards.iter().map(|g| g.expr).collect();
    let guards = Program::lower(&system.graph, &system.inputs, &guards);
    let points: Vec<Vec<f64>> = (spread_over(region, POINTS).into_iter().enumerate())
        .map(|(k, s)| {
            let p = (0..n).map(|i| ((k + i) as f64 * 0.618).fract() / widths[i]);
            s.iter().copied().chain(p).collect()
        })
        .collect();
    let here = |program: &Program| -> Vec<Vec<f64>> {
        points.iter().map(|point| program.eval(point)).collect()
    };
    let there = |program: &Program, i: usize, period: f64| -> Vec<Vec<f64>> {
        let moved = |point: &Vec<f64>| {
            let mut moved = point.clone();
            moved[i] += period;
            program.eval(&moved)
        };
        points.iter().map(moved).collect()
    };
    let largest = |all: &mut dyn Iterator<Item = f64>| all.fold(0.0f64, |a, x| a.max(x.abs()));
    let alike = |a: f64, b: f64, size: f64| (a - b).abs() <= ALIKE * size || a.is_nan();

    let (rates, margins) = (here(&program), here(&guards));
    let rates_repeat = |i: usize, period: f64| {
        (rates.iter().zip(there(&program, i, period))).all(|(here, there)| {
            let size = largest(&mut here.iter().chain(&there).copied());
            here.iter().zip(&there).all(|(a, b)| alike(*a, *b, size))
        })
    };
    // A guard's margin is compared with the largest anywhere: it may be 0 here.
    let guards_repeat = |i: usize, period: f64| {
        let there = there(&guards, i, period);
        (0..system.guards.len()).all(|g| {
            let size = largest(&mut margins.iter().chain(&there).map(|m| m[g]));
            margins
                .iter()
                .zip(&there)
                .all(|(a, b)| alike(a[g], b[g], size))
        })
    };
    (periods.iter().enumerate())
        .map(|(i, period)| {
            period.filter(|period| rates_repeat(i, *period) && guards_repeat(i, *period))
        })
        .collect()
}

/// States up to which the seeds of a sweep are triangulated.
fn most_states(finite: bool) -> usize {
    if finite {
        MOST_STATES_FINITE
    } else {
        MOST_STATES
    }
}

/// Scales of the slope's entries (row-major): V's scale over those of the states, or what the slope
/// is at the equilibrium where that is more.
fn slope_units(end: &End, widths: &[f64], value_scale: f64) -> Vec<f64> {
    let n = widths.len();
    let at_rest = end.at(&vec![0.0; n]).hessian;
    let steepest = (0..n).map(|i| (at_rest[i * n + i] * widths[i].powi(2)).abs());
    let scale = steepest
        .filter(|x| x.is_finite())
        .fold(value_scale, f64::max);
    (0..n * n)
        .map(|q| scale / (widths[q / n] * widths[q % n]))
        .collect()
}

/// A sweep for first guesses where the scene asks for none: up to the largest quadratic V of the
/// region's corners.
fn unasked_sweep(model: &Model, hamiltonian: &Hamiltonian) -> Result<ShootOut, PlanError> {
    let value_max = match &model.horizon {
        Horizon::Finite { .. } => None,
        Horizon::Infinite { .. } => Some(largest_quadratic(
            model,
            &Riccati::solve(hamiltonian, model)?,
        )),
    };
    Ok(ShootOut {
        value_max,
        spacing: 0.1,
        seed_value: SeedValue::Auto,
        samples: 64,
        max_seeds: 4096,
        margin: crate::model::DEFAULT_MARGIN,
        sample_by: None,
        arc_length: crate::model::DEFAULT_ARC_LENGTH,
        folds: false,
        span: 0..0,
    })
}

/// Largest quadratic V of the region's corners.
pub(super) fn largest_quadratic(model: &Model, riccati: &Riccati) -> f64 {
    let region = deviations(&model.region, model.reference());
    largest_at_corners(&riccati.p, &region)
}

/// Largest `s'Ps/2` at the corners of a box of deviations.
fn largest_at_corners(p: &nalgebra::DMatrix<f64>, region: &[[f64; 2]]) -> f64 {
    let n = region.len();
    let at = |corner: &[bool]| {
        let side = |i: usize| region[i][usize::from(corner[i])];
        (0..n)
            .map(|i| {
                (0..n)
                    .map(|j| 0.5 * side(i) * p[(i, j)] * side(j))
                    .sum::<f64>()
            })
            .sum::<f64>()
    };
    corners(n).map(|c| at(&c)).fold(0.0, f64::max)
}

/// Whether L is nowhere negative in the region, even at the cheapest control (looked at in many
/// points).
fn value_is_monotone(system: &System, region: &[[f64; 2]]) -> bool {
    nowhere_negative(system, system.least_running, region)
}

/// Whether an expression of the state is nowhere negative in a region (looked at in many points).
fn nowhere_negative(system: &System, expr: Id, region: &[[f64; 2]]) -> bool {
    const POINTS: usize = 4096;
    let program = Program::lower(&system.graph, &system.inputs, &[expr]);
    let n = system.states;
    let points: Vec<f64> = (spread_over(region, POINTS).into_iter())
        .flat_map(|s| s.into_iter().chain(std::iter::repeat_n(0.0, n)))
        .collect();
    let scale = |v: &[f64]| v.iter().fold(0.0f64, |a, b| a.max(b.abs()));
    let values = crate::backend::cpu::Evaluator::new(&program).eval(&points, 2 * n);
    let rounding = 1e-12 * scale(&values);
    // Outside its domain the model says nothing about the sign.
    values.iter().all(|l| l.is_nan() || *l >= -rounding)
}

/// States spread evenly over a box, the same in every run: a Kronecker sequence, by the square
/// roots of primes.
pub fn spread_over(region: &[[f64; 2]], count: usize) -> Vec<Vec<f64>> {
    let is_prime = |p: &usize| (2..*p).all(|q| !p.is_multiple_of(q));
    let primes: Vec<f64> = (2..)
        .filter(is_prime)
        .take(region.len())
        .map(|p| p as f64)
        .collect();
    let place = |k: usize| {
        let along = region.iter().enumerate().map(|(i, [lo, hi])| {
            let fraction = ((k as f64 + 0.5) * primes[i].sqrt()).fract();
            lo + (hi - lo) * fraction
        });
        along.collect()
    };
    (0..count).map(place).collect()
}
