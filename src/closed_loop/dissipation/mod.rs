//! The L2 gain that a value function certifies, checked by simulation.
//!
//! The running cost of a game splits into what the disturbance does and what it pays for: with
//! `l(x, u) = L(x, u, 0)` and the supply `s(x, u, w) = L(x, u, 0) - L(x, u, w)` (for
//! `L = 1/2 |z|^2 - 1/2 gamma^2 |w|^2` it is `1/2 gamma^2 |w|^2`). V that solves the Isaacs equation is a storage
//! function (van der Schaft, IEEE Trans. Automatic Control 37, 1992): under u* and *every* w that
//! keeps the state where V is known, at all times T
//!
//! ```text
//! E(T) + V(x(T)) <= W(T) + V(x(0)),    E = int_0^T l dt,    W = int_0^T s dt,
//! ```
//!
//! with equality for `w = w*(x, p)`; so `E/(W + V(x(0))) <= 1`, the gain, in whatever factors the
//! scene writes its cost. Nothing of this is used here: laws are flown under random, sinusoidal and
//! worst-case disturbances, E and W are integrated beside the state, and the inequality is looked
//! at whenever V is known. A law that is not good enough, or a V that is none, is found out.
//!
//! The gain needs V at initial states only, which are solved for; the sharper inequality needs V
//! along trajectories, where the map's errors count. Both are told apart.

mod cases;
mod certificate;
mod verdict;

pub use super::forcing::Wave;
pub use cases::{Cases, DisturbanceKind};
pub use certificate::{Certificate, Origin, Solver};
pub use verdict::{LawCheck, Summary, ratio_text};

use super::flights::{Seen, Starts};
use super::forcing::Forcing;
use super::simulate::Simulator;
use super::{Chart, Law, Laws, LoopError, MAP, Setting};
use crate::backend::Backend;
use crate::local::{Riccati, closed_loop_margin};
use crate::model::{self, ClosedLoop, Model, Outside};
use crate::sweep::{Choices, Numerics};
use std::collections::BTreeMap;
use std::time::Instant;
use verdict::Track;

/// Relative violation below which the inequality is taken to hold: what is left of integration
/// errors.
pub const TOLERANCE: f64 = 1e-6;
/// Relative tolerance of the integration unless the scene's is tighter, so that its errors are far
/// below [`TOLERANCE`].
const RTOL: f64 = 1e-9;
/// Trajectories of each kind that are kept whole.
const KEPT: usize = 2;
/// Final time in time constants of the slowest mode of the closed loop: V has decayed by exp(-16).
const TIME_CONSTANTS: f64 = 8.0;

/// A check: the laws, each under the same disturbances.
#[derive(Clone, Debug)]
pub struct Dissipation {
    pub cases: Cases,
    /// `[case]`: V at the initial state; NaN where it is not known.
    pub v0: Vec<f64>,
    pub origin: Vec<Origin>,
    pub laws: Vec<LawCheck>,
    /// Where V is from, in words.
    pub value: &'static str,
    pub final_time: f64,
    /// Intervals between the stored points of the trajectories kept.
    pub samples: usize,
    pub frequencies: [f64; 2],
    pub numerics: Numerics,
    pub backend: String,
    pub adapter: String,
    pub status_flags: Vec<(i32, String)>,
}

/// How a check's trajectories are flown: as a `[closed_loop]` that records nothing.
///
/// # Errors
/// [`LoopError::NoRates`].
pub fn flight(
    model: &Model,
    asked: &model::Dissipation,
    riccati: Option<&Riccati>,
) -> Result<ClosedLoop, LoopError> {
    let slowest = riccati.map(closed_loop_margin).filter(|rate| *rate > 0.0);
    let auto = slowest.map(|rate| TIME_CONSTANTS / rate);
    let scene = model.closed_loop.as_ref();
    let reference = model.reference().iter().map(|x| model::Start::Fixed(*x));
    Ok(ClosedLoop {
        final_time: (asked.final_time.or(auto)).ok_or(LoopError::NoRates { key: "final_time" })?,
        samples: asked.samples,
        initial: asked.initial.clone().unwrap_or_else(|| reference.collect()),
        random: None,
        laws: Some(
            asked
                .laws
                .clone()
                .unwrap_or_else(|| vec![(MAP.to_owned(), asked.span.clone())]),
        ),
        given: scene.map(|s| s.given.clone()).unwrap_or_default(),
        records: Vec::new(),
        sets: Vec::new(),
        track: scene.and_then(|s| s.track),
        converged: model::DEFAULT_CONVERGED,
        margin: scene.map_or(model::DEFAULT_LOOP_MARGIN, |s| s.margin),
        period: asked.period,
        outside: Outside::Stop,
        span: asked.span.clone(),
    })
}

/// Flies `chosen` laws under the disturbances that a scene asks for. `flight` is of [`flight`];
/// `choices` has the seed.
///
/// # Errors
/// Where disturbances cannot be drawn; what [`Setting::new`] and [`Setting::simulate`] give.
pub fn check(
    laws: &Laws<'_>,
    (asked, flight): (&model::Dissipation, &ClosedLoop),
    chosen: &[Law],
    certificate: &Certificate<'_>,
    backend: &dyn Backend,
    choices: Choices,
    progress: &mut dyn FnMut(&str),
) -> Result<Dissipation, LoopError> {
    let rtol = choices.rtol.unwrap_or(laws.model.integrator.rtol.min(RTOL));
    let choices = Choices {
        rtol: Some(rtol),
        ..choices
    };
    let setting = Setting::new(laws, flight, backend, choices)?;
    let (cases, frequencies) = Cases::draw(laws, asked, certificate, choices.seed)?;
    let (v0, origin) = certificate.initial(&cases.x0, laws.model.reference())?;
    if v0.iter().all(|v| v.is_nan()) {
        return Err(LoopError::NoStates);
    }
    let mut this = Dissipation {
        laws: Vec::new(),
        value: certificate.name(),
        final_time: flight.final_time,
        samples: flight.samples,
        numerics: setting.numerics,
        backend: backend.name().to_owned(),
        adapter: backend.adapter(),
        status_flags: setting.status_flags(),
        frequencies,
        cases,
        v0,
        origin,
    };
    for law in chosen {
        progress(&law.name);
        let result = this.fly(&setting, law, certificate, backend)?;
        this.laws.push(result);
    }
    Ok(this)
}

impl Dissipation {
    fn fly(
        &self,
        setting: &Setting<'_>,
        law: &Law,
        certificate: &Certificate<'_>,
        backend: &dyn Backend,
    ) -> Result<LawCheck, LoopError> {
        let forcing = Forcing {
            quadratic: certificate.matrix().cloned(),
        };
        let mut simulator =
            Simulator::new(setting, law, Some(&forcing), certificate.chart(), backend)?;
        let clock = Instant::now();
        let cases = &self.cases;
        let mut tracks: Vec<Track> = self.v0.iter().map(|v| Track::new(*v)).collect();
        let mut watch = |seen: Seen<'_>| {
            if let Some(v) = seen.v.or_else(|| certificate.quadratic(seen.s)) {
                tracks[seen.trajectory].see(seen.t, [seen.cost, seen.supplied, v], seen.s);
            }
        };
        let starts = Starts {
            x: &cases.x0,
            forcing: &cases.forcing,
            kept: &[],
        };
        let flights = simulator.fly(starts, certificate.chart(), Some(&mut watch))?;
        let mut result = LawCheck::new(law, setting, self, certificate, &tracks, flights.status);
        result.seconds = clock.elapsed().as_secs_f64();
        // Flown again rather than all of them kept: what a trajectory is does not depend on its
        // batch.
        let (n, width) = (cases.states, cases.forcing.len() / cases.count());
        let kept = result.closest(cases, KEPT);
        let of = |values: &[f64], width: usize| -> Vec<f64> {
            (kept
                .iter()
                .flat_map(|i| &values[i * width..(i + 1) * width])
                .copied())
            .collect()
        };
        let (x, forcing) = (of(&cases.x0, n), of(&cases.forcing, width));
        let all: Vec<usize> = (0..kept.len()).collect();
        let again = Starts {
            x: &x,
            forcing: &forcing,
            kept: &all,
        };
        result.paths = simulator.fly(again, certificate.chart(), None)?.paths;
        for (path, case) in result.paths.iter_mut().zip(kept) {
            path.initial = case;
        }
        result.path_values = (result.paths.iter())
            .map(|path| certificate.values(&path.x, n))
            .collect();
        Ok(result)
    }

    /// How many of a law's trajectories ended how, by name.
    pub fn statuses(&self, law: &LawCheck) -> BTreeMap<&str, usize> {
        let mut counts = BTreeMap::new();
        for status in &law.status {
            let name = self.status_flags.iter().find(|(code, _)| code == status);
            *counts
                .entry(name.map_or("unknown", |(_, n)| n.as_str()))
                .or_default() += 1;
        }
        counts
    }
}
