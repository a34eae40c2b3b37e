//! The closed loop: feedback laws simulated from many initial states, side by side.
//!
//! A [`Law`] gives the controls as expressions of the states, or of p where a [`Chart`] knows that
//! around each state. It is put into the scene's equations, which a backend integrates forward in
//! time with the running cost; recorded quantities are followed to their extrema between samples;
//! [`Evaluation`] says what came of it.

mod charted;
mod choose;
pub mod dissipation;
mod equations;
mod evaluation;
mod fallback;
mod flights;
mod forcing;
mod gathered;
mod initial;
mod law;
mod legs;
mod pace;
mod record;
mod relayed;
mod sets;
mod simulate;
mod values;

pub use choose::{Available, Chosen, LQR, MAP, Weights};
pub use evaluation::{Evaluation, LawResult, SetResult, Spread};
pub use flights::{Flights, Path};
pub use gathered::{Gathered, NOT_MERGED};
pub use initial::Initial;
pub use law::{Law, LawError, Laws};
pub use sets::{Line, area, contour};
pub use simulate::OUTSIDE_MAP;
pub use values::{solved_values, values_of_blocks};

use crate::backend::{Backend, BackendError, Status, Surface};
use crate::hamiltonian::Hamiltonian;
use crate::map::{Room, ValueMap};
use crate::model::{ClosedLoop, Horizon, Method, Model, Precision};
use crate::sweep::{Choices, GUARD_STATUS, Numerics, PlanError};
use flights::Starts;
use nalgebra::DMatrix;
use simulate::Simulator;
use std::time::Instant;

/// A value function that is known around states: what the law of a value map is taken from.
pub trait Chart: Sync {
    /// V, its gradient and its second derivatives at a state; `None` where they are not known. A
    /// state with a period may be any number of periods away.
    fn local(&self, x: &[f64]) -> Option<Expansion>;

    /// The same at many states `[state][component]`.
    fn expansions(&self, states: usize, x: &[f64], to: &mut Expansions) {
        to.reset(states, x.len() / states);
        for (k, x) in x.chunks_exact(states).enumerate() {
            if let Some(here) = self.local(x) {
                to.put(k, here.v, &here.p, &here.hessian);
            }
        }
    }

    /// The same without second derivatives, which may be left as they were.
    fn slopes(&self, states: usize, x: &[f64], to: &mut Expansions) {
        self.expansions(states, x, to);
    }

    /// The same for kernels on a device that ask it themselves; `None` where they cannot.
    fn surface(&self, _precision: Precision) -> Option<Surface> {
        None
    }

    /// Moves a state into the region of which the chart knows something; false where that has no
    /// bounds.
    fn clamp(&self, _x: &mut [f64]) -> bool {
        false
    }

    /// Estimated error of V at a state; NaN where nothing is known of it.
    fn uncertainty(&self, _x: &[f64]) -> f64 {
        f64::NAN
    }
}

/// V to the second order around a state.
#[derive(Clone, Debug, PartialEq)]
pub struct Expansion {
    pub v: f64,
    /// dV/dx.
    pub p: Vec<f64>,
    /// `[state][state]`: d2V/dx2.
    pub hessian: Vec<f64>,
}

/// Expansions at many states, kept for the next call.
#[derive(Default)]
pub struct Expansions {
    /// Time at which V is asked for, on a finite horizon.
    pub t: f64,
    /// Whether V is known; what is not holds no values.
    pub known: Vec<bool>,
    pub v: Vec<f64>,
    /// `[state][component]`.
    pub p: Vec<f64>,
    /// `[state][component][component]`.
    pub hessian: Vec<f64>,
    room: Room<f64>,
}

impl Expansions {
    fn reset(&mut self, states: usize, count: usize) {
        self.known.clear();
        self.known.resize(count, false);
        self.v.resize(count, f64::NAN);
        self.p.resize(count * states, f64::NAN);
        self.hessian.resize(count * states * states, f64::NAN);
    }

    fn put(&mut self, k: usize, v: f64, p: &[f64], hessian: &[f64]) {
        let n = p.len();
        self.known[k] = true;
        self.v[k] = v;
        self.p[k * n..][..n].copy_from_slice(p);
        self.hessian[k * n * n..][..n * n].copy_from_slice(hessian);
    }
}

impl Chart for ValueMap {
    fn expansions(&self, states: usize, x: &[f64], to: &mut Expansions) {
        to.reset(states, x.len() / states);
        let mut room = std::mem::take(&mut to.room);
        self.each(x, to.t, (true, true), &mut room, |k, here| {
            if let Some(here) = here {
                to.put(
                    k,
                    here.v,
                    &here.p[..states],
                    &here.hessian[..states * states],
                );
            }
        });
        to.room = room;
    }

    fn slopes(&self, states: usize, x: &[f64], to: &mut Expansions) {
        to.reset(states, x.len() / states);
        let mut room = std::mem::take(&mut to.room);
        self.each(x, to.t, (false, true), &mut room, |k, here| {
            if let Some(here) = here {
                to.known[k] = true;
                to.v[k] = here.v;
                to.p[k * states..][..states].copy_from_slice(&here.p[..states]);
            }
        });
        to.room = room;
    }

    #[cfg(feature = "gpu")]
    fn surface(&self, precision: Precision) -> Option<Surface> {
        self.to_surface(precision)
    }

    fn clamp(&self, x: &mut [f64]) -> bool {
        self.clamp_to_pieces(x)
    }

    fn local(&self, x: &[f64]) -> Option<Expansion> {
        ValueMap::local(self, x).map(|here| Expansion {
            v: here.v,
            p: here.p,
            hessian: here.hessian,
        })
    }

    /// With what [`Chart::local`], which is in haste, differs by from all sites around.
    fn uncertainty(&self, x: &[f64]) -> f64 {
        match (self.at(x).lowest, ValueMap::local(self, x)) {
            (Ok(here), Some(fast)) => here.v_error + (here.v - fast.v).abs(),
            _ => f64::NAN,
        }
    }
}

/// Why a closed loop could not be simulated.
#[derive(Debug, thiserror::Error)]
pub enum LoopError {
    #[error(transparent)]
    Law(#[from] LawError),
    #[error(transparent)]
    Plan(#[from] PlanError),
    #[error(transparent)]
    Backend(#[from] BackendError),
    #[error(transparent)]
    States(#[from] crate::value::StatesError),
    #[error(
        "law `{law}` takes {operations} operations; at most {} are handled",
        crate::sweep::MOST_OPERATIONS
    )]
    TooLong { law: String, operations: usize },
    #[error("law `{law}` needs the value map")]
    NoChart { law: String },
    #[error("random initial states need a range: give [closed_loop] initial an axis [first, last]")]
    NoRange,
    #[error("the axis of `{axis}` has no count, which a grid needs (or give random = N)")]
    NoCount { axis: String },
    #[error(
        "V is not known: there is no value map, and the scene is not linear with a quadratic cost (or has no stabilizing P >= 0), where V would be exact without one"
    )]
    NoValue,
    #[error(
        "[dissipation] {key} = \"auto\" follows from the closed loop's eigenvalues, of which there are none here: give {key}"
    )]
    NoRates { key: &'static str },
    #[error(
        "[dissipation] amplitude = \"auto\" is the largest w* over the region, which is 0: give amplitude"
    )]
    NoAmplitude,
    #[error("V is known at none of the initial states of [dissipation]")]
    NoStates,
}

/// Down to this tolerance legs of a period, which mostly are one step whatever its order, are taken
/// by a method of low order where none is named.
const LEGS_RTOL: f64 = 1e-8;

/// What all laws are simulated with.
pub struct Setting<'s> {
    pub model: &'s Model,
    pub hamiltonian: &'s Hamiltonian,
    pub closed_loop: &'s ClosedLoop,
    pub numerics: Numerics,
    /// Method of a chart's law, whose legs are a period long.
    pub leg_method: Method,
    /// P of the local solution; where there is none, squares of deviations in units of the region's
    /// widths.
    metric: DMatrix<f64>,
    /// Whether `metric` is P, so that `1/2 d'metric d` is a cost.
    local: bool,
    /// Mean of `1/2 d'metric d` over the region.
    scale: f64,
    /// What J is compared with for its absolute tolerance.
    value_scale: f64,
    widths: Vec<f64>,
    /// Deviations outside of which a trajectory has left.
    bounds: Vec<[f64; 2]>,
    /// None where a state has no period.
    periods: Vec<Option<f64>>,
}

impl<'s> Setting<'s> {
    /// For the closed loop of a scene.
    ///
    /// # Errors
    /// [`PlanError::NoStep`].
    pub fn new(
        laws: &Laws<'s>,
        closed_loop: &'s ClosedLoop,
        backend: &dyn Backend,
        choices: Choices,
    ) -> Result<Self, LoopError> {
        let model = laws.model;
        let widths: Vec<f64> = model.region.iter().map(|[lo, hi]| hi - lo).collect();
        let local = laws.riccati().map(|r| r.p.clone());
        let n = widths.len();
        let scaled =
            || DMatrix::from_fn(n, n, |i, j| if i == j { widths[i].powi(-2) } else { 0.0 });
        let metric = local.clone().unwrap_or_else(scaled);
        let scale = mean_over_region(&metric, model);
        let value_scale =
            (model.shoot_out.as_ref().and_then(|s| s.value_max)).unwrap_or(match local {
                Some(_) => scale,
                None => 1.0,
            });
        let bounds = (model
            .region
            .iter()
            .zip(model.reference())
            .zip(&model.states))
        .map(|(([lo, hi], x), state)| {
            let margin = closed_loop.margin * (hi - lo);
            match state.period {
                Some(_) => [f64::NEG_INFINITY, f64::INFINITY],
                None => [lo - x - margin, hi - x + margin],
            }
        })
        .collect();
        let numerics = Numerics::choose(model, backend, choices)?;
        let leg_method = match choices.method.or(model.integrator.method) {
            None if numerics.rtol >= LEGS_RTOL => Method::Tsit5,
            _ => numerics.method,
        };
        Ok(Self {
            numerics,
            leg_method,
            hamiltonian: laws.hamiltonian,
            periods: model.states.iter().map(|s| s.period).collect(),
            local: local.is_some(),
            model,
            closed_loop,
            metric,
            scale,
            value_scale,
            widths,
            bounds,
        })
    }

    /// A deviation, of states with a period the nearest one, and how many periods were taken off.
    fn nearest(&self, deviation: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let turns: Vec<f64> = (deviation.iter().zip(&self.periods))
            .map(|(d, period)| period.map_or(0.0, |p| (d / p).round()))
            .collect();
        let left = (deviation.iter().zip(&turns).zip(&self.periods))
            .map(|((d, k), period)| d - k * period.unwrap_or(0.0))
            .collect();
        (left, turns)
    }

    /// P of the local solution, where there is one.
    fn local_metric(&self) -> Option<&DMatrix<f64>> {
        self.local.then_some(&self.metric)
    }

    /// `1/2 d'metric d`.
    fn quadratic(&self, d: &[f64]) -> f64 {
        let n = d.len();
        let row = |i: usize| (0..n).map(|j| self.metric[(i, j)] * d[j]).sum::<f64>();
        0.5 * (0..n).map(|i| d[i] * row(i)).sum::<f64>()
    }

    /// Status codes and their meanings.
    pub fn status_flags(&self) -> Vec<(i32, String)> {
        let general = (Status::ALL.iter().filter(|(s, _)| *s != Status::Guard))
            .map(|(s, n)| (*s as i32, (*n).to_owned()));
        let guards = (self.hamiltonian.guards.iter().enumerate())
            .map(|(k, g)| (GUARD_STATUS + k as i32, format!("guard_{}", g.name)));
        general
            .chain(
                [(OUTSIDE_MAP, "outside_map"), (NOT_MERGED, "not_merged")]
                    .map(|(code, name)| (code, name.to_owned())),
            )
            .chain(guards)
            .collect()
    }

    /// Meaning of a status code.
    pub fn status_name(&self, code: i32) -> String {
        let found = self.status_flags().into_iter().find(|(c, _)| *c == code);
        found.map_or_else(|| format!("status_{code}"), |(_, name)| name)
    }

    /// Simulates one law from all initial states.
    ///
    /// # Errors
    /// Device failures; a law that is too long, or needs a chart and has none.
    pub fn simulate(
        &self,
        law: &Law,
        initial: &Initial,
        chart: Option<&dyn Chart>,
        backend: &dyn Backend,
    ) -> Result<LawResult, LoopError> {
        if law.charted && chart.is_none() {
            return Err(LoopError::NoChart {
                law: law.name.clone(),
            });
        }
        let clock = Instant::now();
        let mut simulator = Simulator::new(self, law, None, chart, backend)?;
        let compiled = clock.elapsed().as_secs_f64();
        let kept = initial.kept();
        let starts = Starts {
            x: &initial.x,
            kept: &kept,
            ..Starts::default()
        };
        let mut flights = simulator.fly(starts, chart, None)?;
        if law.charted {
            self.unwind(&mut simulator, initial, &mut flights, chart)?;
        }
        let seconds = clock.elapsed().as_secs_f64() - compiled;
        Ok(self.judge(law, flights, seconds))
    }

    /// Under a chart's law a trajectory may end at another copy of the equilibrium, periods away,
    /// where the running cost need not vanish. Its cost is that of the same motion written so that
    /// it ends at the equilibrium itself: as V is meant.
    fn unwind(
        &self,
        simulator: &mut Simulator<'_>,
        initial: &Initial,
        flights: &mut Flights,
        chart: Option<&dyn Chart>,
    ) -> Result<(), LoopError> {
        let n = self.widths.len();
        let (mut moved, mut x) = (Vec::new(), Vec::new());
        for i in 0..flights.status.len() {
            let (_, turns) = self.nearest(&flights.end[i * n..][..n]);
            if flights.status[i] == Status::Reached as i32 && turns.iter().any(|k| *k != 0.0) {
                moved.push(i);
                let from = &initial.x[i * n..][..n];
                x.extend(
                    (from.iter().zip(&turns).zip(&self.periods))
                        .map(|((x, k), p)| x - k * p.unwrap_or(0.0)),
                );
            }
        }
        let again = simulator.fly(
            Starts {
                x: &x,
                ..Starts::default()
            },
            chart,
            None,
        )?;
        flights.round_trips += again.round_trips;
        for (j, i) in moved.into_iter().enumerate() {
            flights.cost[i] = again.cost[j];
            flights.status[i] = again.status[j];
            flights.t_end[i] = again.t_end[j];
            flights.end[i * n..][..n].copy_from_slice(&again.end[j * n..][..n]);
        }
        Ok(())
    }

    /// J and convergence from where trajectories ended.
    fn judge(&self, law: &Law, flights: Flights, seconds: f64) -> LawResult {
        let n = self.widths.len();
        let finite = matches!(self.model.horizon, Horizon::Finite { .. });
        let mut result = LawResult {
            name: law.name.clone(),
            source: law.source.clone(),
            records: flights.records,
            status: flights.status,
            t_end: flights.t_end,
            paths: flights.paths,
            held: flights.fallback.iter().map(|k| f64::from(*k)).sum::<f64>()
                / flights.updates.max(1) as f64,
            updates: flights.updates,
            fallback: flights.fallback,
            round_trips: flights.round_trips,
            seconds,
            ..LawResult::default()
        };
        for (i, &status) in result.status.iter().enumerate() {
            let reached = status == Status::Reached as i32;
            let left = self.quadratic(&self.nearest(&flights.end[i * n..][..n]).0);
            result
                .converged
                .push(reached && (finite || left <= self.closed_loop.converged * self.scale));
            let rest = match flights.terminal.get(i) {
                Some(terminal) => *terminal,
                None if self.local => left,
                None => 0.0,
            };
            result.cost.push(if reached {
                flights.cost[i] + rest
            } else {
                f64::NAN
            });
        }
        result
    }

    /// Simulates several laws from the same initial states.
    ///
    /// # Errors
    /// As [`Self::simulate`].
    pub fn simulate_all(
        &self,
        laws: &[Law],
        initial: &Initial,
        chart: Option<&dyn Chart>,
        backend: &dyn Backend,
        progress: &mut dyn FnMut(&str),
    ) -> Result<Vec<LawResult>, LoopError> {
        let mut results = Vec::new();
        for law in laws {
            progress(&law.name);
            results.push(self.simulate(law, initial, chart, backend)?);
        }
        Ok(results)
    }

    /// What came of laws from the same initial states.
    pub fn evaluated(
        &self,
        initial: Initial,
        values: Vec<f64>,
        laws: Vec<LawResult>,
        backend: &dyn Backend,
    ) -> Evaluation {
        Evaluation::new(self, initial, values, laws, backend)
    }

    /// Simulates several laws from the same initial states. `values` are V there, where known; else
    /// those of the chart.
    ///
    /// # Errors
    /// As [`Self::simulate`].
    pub fn evaluate(
        &self,
        laws: &[Law],
        initial: Initial,
        chart: Option<&dyn Chart>,
        values: Option<Vec<f64>>,
        backend: &dyn Backend,
        progress: &mut dyn FnMut(&str),
    ) -> Result<Evaluation, LoopError> {
        let values = values.unwrap_or_else(|| initial.values(chart));
        let results = self.simulate_all(laws, &initial, chart, backend, progress)?;
        Ok(self.evaluated(initial, values, results, backend))
    }
}

/// Mean of `1/2 d'M d` over the region: `1/2 sum M_ij (m_i m_j + [i = j] w_i^2/12)`, m being its
/// centre's deviation.
fn mean_over_region(metric: &DMatrix<f64>, model: &Model) -> f64 {
    let centre: Vec<f64> = (model.region.iter().zip(model.reference()))
        .map(|([lo, hi], x)| 0.5 * (lo + hi) - x)
        .collect();
    let moment = |i: usize, j: usize| {
        let width = model.region[i][1] - model.region[i][0];
        centre[i] * centre[j] + if i == j { width * width / 12.0 } else { 0.0 }
    };
    let n = centre.len();
    (0..n * n)
        .map(|k| 0.5 * metric[(k / n, k % n)] * moment(k / n, k % n))
        .sum()
}
