//! Flights: an independent upper bound of V.
//!
//! Any control that brings a state home costs at least V. Cheap feedback laws are flown from given
//! states, all in one batch, and the cost of each flight is an upper bound of V at its start: a
//! flight that costs less than a claimed V proves the claim wrong, and its path is a first guess
//! for multiple shooting.
//!
//! A law is asked for a costate `p = q + H s` once a period; between, `u = u*(s, q + H s)` feeds
//! back continuously. A law that is a little wrong costs only a little more: the excess is of
//! second order in what is wrong of p. Nothing of a law is trusted: it may be fitted, guessed, or
//! follow another state's solution; the cost is that of the control it gave.
//!
//! Of a game (`min max`) a flight bounds nothing: the disturbance of the equations answers to the
//! law's costate.

mod along;
mod course;
mod equations;
mod itself;
mod laws;
mod pilot;
mod sites;
mod undercut;

pub use along::{AlongState, AlongTime, Guide, PIECES, guides, slopes};
pub use itself::{along_itself, precise};
pub use laws::{Drifting, Expansion, Linear, Terminal};
pub use pilot::Pilot;
pub use sites::{At, Site};
pub use undercut::{Claim, Flew, Undercut, tolerance, undercut};

use crate::shooting::Path;

/// A feedback law `u = u*(s, p)` by a costate `p = q + H s`, which is asked for again and again
/// along a flight (once a period).
pub trait Law: Sync {
    /// `(q, H)` (H row-major; its symmetric part is used) at time t and deviation s; `None` where
    /// the law has no answer (the flight ends).
    fn costate(&self, t: f64, s: &[f64]) -> Option<(Vec<f64>, Vec<f64>)>;
}

/// What is to be flown.
pub struct Flight<'a> {
    /// Deviation s.
    pub start: Vec<f64>,
    pub law: &'a dyn Law,
    /// A flight is given up once it has cost this much.
    pub ceiling: f64,
}

/// How a flight ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum FlightEnd {
    /// Near an equilibrium, or at the final time: its cost is an upper bound of V at its start.
    Home,
    AboveCeiling,
    /// The law had no answer.
    NoAnswer,
    /// The equations could not be integrated.
    Failed,
    /// It did not come near the equilibrium within many times the slowest mode's time, or very many
    /// periods.
    TimeUp,
    /// It met a guard.
    LeftGuard,
}

/// What came of a flight.
#[derive(Clone, Debug)]
pub struct Flown {
    /// Cost of the whole flight: the running cost, plus V of what is left with its estimated error
    /// (the local solution near the equilibrium), or the terminal cost on a finite horizon.
    /// Infinite if it did not come home.
    pub cost: f64,
    /// States on the way with the law's costates, forward in time, with the local solution's tail:
    /// a guess for multiple shooting. Its first node is the start, moved by the periods that bring
    /// the path's end to the equilibrium at s = 0. Only of a flight that came home.
    pub path: Option<Path>,
    pub end: FlightEnd,
}

/// The state less whole periods, so that the equilibrium nearest to it is at 0.
pub(crate) fn homeward(s: &[f64], periods: &[Option<f64>]) -> Vec<f64> {
    (s.iter().zip(periods))
        .map(|(s, period)| period.map_or(*s, |period| s - (s / period).round() * period))
        .collect()
}

/// `m s` of a row-major square matrix.
fn times<'m>(m: &'m [f64], s: &'m [f64]) -> impl Iterator<Item = f64> + 'm {
    m.chunks(s.len())
        .map(move |row| row.iter().zip(s).map(|(a, b)| a * b).sum())
}

/// The costate `p + H (s - at)` as `(q, H)`.
fn tangent(p: &[f64], h: Vec<f64>, at: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let q = p
        .iter()
        .zip(times(&h, at))
        .map(|(p, turned)| p - turned)
        .collect();
    (q, h)
}

/// `q + H s`.
fn costate(q: &[f64], h: &[f64], s: &[f64]) -> Vec<f64> {
    q.iter()
        .zip(times(h, s))
        .map(|(q, turned)| q + turned)
        .collect()
}
