//! The value map: V, p and u at any state, interpolated from scattered solutions.
//!
//! Each site (a state at which V and p are known) carries a cubic polynomial with the site's V and
//! p and curvature fitted to the sites around it; polynomials of the sites around a state are
//! blended (the modified Shepard method of Franke & Nielson 1980 and Renka 1988, here with
//! gradients). Sites on different sheets are told apart by what their polynomials say at the state:
//! on one sheet they agree. The lowest sheet counts; in a game there is a value only where there is
//! one sheet. The error is that of leaving sites out: what the others, fitted again, say where a
//! site is.
//!
//! ```no_run
//! use costate::low_level::result::Stored;
//! let map = Stored::open("out/scene.h5")?.value_map()?;
//! match map.at(&[2.0, 0.0]).lowest {
//!     Ok(here) => println!("V = {} within about {}, u = {:?}", here.v, here.v_error, here.u),
//!     Err(unknown) => println!("{unknown}"),
//! }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod adaptive;
mod agreement;
mod coverage;
#[cfg(feature = "gpu")]
mod device;
mod errors;
mod fast;
mod guarded;
mod known;
mod local_models;
mod many;
mod nodal;
pub mod pieces;
mod sites;
mod swift;
mod workers;

pub use adaptive::{ABOVE_BOUND, Adaptive, Beyond, Checked, GROSS, Part, adaptive};
pub use agreement::Agreement;
pub use coverage::{Coverage, Fronts};
#[cfg(feature = "gpu")]
pub use device::{DeviceError, DeviceMap};
pub use known::{Known, SweepRecord};
pub use many::Many;
pub use sites::Source;
pub(crate) use swift::Room;
pub use workers::{Worker, Workers};

use crate::backend::cpu::{Cpu, Evaluator};
use crate::hamiltonian::{Hamiltonian, System};
use crate::local::{LocalErrors, LocalPolynomial};
use crate::model::{MAP_ERROR_MAX, Model};
use crate::program::Program;
use crate::sweep::{Choices, Plan, PlanError, spread_over};
use crate::value::nearest::{MOST_DIMENSIONS, Nearest, index};
pub(crate) use guarded::GUARD_ROUNDING;
use guarded::Guarded;
use local_models::{Fitted, LocalModel, blend, distance_between, surrounded};
use nodal::Prediction;
use pieces::{Pieces, Said};
use rayon::prelude::*;
use sites::{Sites, UNLABELLED};
use std::sync::OnceLock;
use swift::{Swift, turns_into, unwind};

/// Why there is no value map.
#[derive(Debug, thiserror::Error)]
pub enum MapError {
    #[error(
        "no values are known: there are neither swept trajectories with costates nor solved states"
    )]
    Empty,
    #[error(transparent)]
    Plan(#[from] PlanError),
    #[error(transparent)]
    Backend(#[from] crate::backend::BackendError),
    #[error("{states} states: values are looked up for at most {MOST_DIMENSIONS}")]
    TooManyStates { states: usize },
}

/// Why V is not known at a state.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unknown {
    #[error("no solutions are near this state")]
    Far,
    #[error("this state lies at the edge of what was computed")]
    Edge,
    #[error(
        "the map says nothing at this state: points are missing there, or its error is above `error_max`"
    )]
    Uncertain,
    #[error("a guard of the scene excludes this state")]
    Guard,
    /// In a game, where the lowest of several is not the value (see [`ValueMap`]).
    #[error("several sheets lie over this state: none is the value")]
    SeveralSheets,
    /// Of a finite horizon.
    #[error("V is known at t = 0 alone")]
    OtherTime,
    /// Of a file of interpolated values: what lies between them no error of theirs tells.
    #[error(
        "the file holds interpolated values, and this state is none of theirs: ask the file that they were made of"
    )]
    Between,
}

/// V, its derivatives and u at a state, on one sheet.
#[derive(Clone, Debug)]
pub struct Value {
    pub v: f64,
    /// `dV/dx`, one a state.
    pub p: Vec<f64>,
    /// `dV/dt` where the map has time as an axis; else NaN.
    pub rate: f64,
    /// `d2V/dx2`, row-major.
    pub hessian: Vec<f64>,
    pub u: Vec<f64>,
    /// Label of the sheet as in the file; -1 where no labelled solution is near.
    pub sheet: i32,
    /// Errors of V, of p (largest component relative to |p|, each times the region's width) and of
    /// u (largest) that leaving out sites around shows. NaN where they were not asked for. Of V it
    /// is no less than what the sites that were blended disagree by.
    pub v_error: f64,
    pub p_error: f64,
    pub u_error: f64,
    /// Sites that were blended; 0 where the local solution about the equilibrium gives the values.
    pub sites: usize,
    /// Of them, how many are solved states.
    pub solved: usize,
    /// Distance to the nearest, in widths of the region.
    pub nearest: f64,
    /// Whether it comes from a map in pieces; its errors are their bounds.
    pub in_pieces: bool,
    /// Periods by which the state was moved to where the sites are.
    pub winding: Vec<i32>,
    /// What its being the least rests on.
    pub coverage: Coverage,
}

/// What is known at a state.
#[derive(Clone, Debug)]
pub struct At {
    /// In a game the only sheet, or the lowest where it is below the level at which the manifold
    /// overlaps.
    pub lowest: Result<Value, Unknown>,
    /// Other sheets, by rising V; all where none is the value. One that is lower is interpolated at
    /// a state that was solved.
    pub others: Vec<Value>,
}

crate::opaque!(ValueMap);

/// Interpolates V, p and u; see the module's text. In a game a state has a value where one sheet
/// lies over it, or where V of the lowest is below the least V of a second sheet over the region:
/// the part of the manifold below that level lies over the region one-to-one.
pub struct ValueMap {
    sites: Sites,
    tree: Box<dyn Nearest>,
    nodal: Vec<OnceLock<Fitted>>,
    left_out: Vec<OnceLock<[f64; 3]>>,
    dominated: Vec<OnceLock<bool>>,
    contested: Vec<OnceLock<bool>>,
    overlap: OnceLock<f64>,
    plan: Plan,
    control: Program,
    guarded: Option<Guarded>,
    /// Of a game H, L and the states' rates.
    isaacs: Option<Program>,
    /// Windings to try, one a combination of periodic states.
    windings: Vec<Vec<i32>>,
    fronts: Fronts,
    own_errors: Option<[f64; 2]>,
    /// How well the states of the map in pieces were searched for cheaper sheets.
    searched: Coverage,
    /// A map that was made to an error: it answers within its region.
    pieces: Option<Pieces>,
    /// Of use outside the region of these.
    beyond: Option<Pieces>,
    /// The final time, where the pieces have time as their last coordinate.
    time: Option<f64>,
    /// The same for many states; `None` in a game, whose answers are checked one by one.
    swift: Option<Swift<f64>>,
    /// Of the local solution.
    local_errors: Option<LocalErrors>,
    /// Whether nothing but the local solution is known beside the pieces.
    pieces_alone: bool,
    /// The law, for many states.
    controls: Evaluator,
}

/// Candidates looked at for each one wanted, and how many first.
const LOOK: usize = 8;
const FEW: usize = 2;
/// A site counts as a neighbour only if no chosen one is nearer to it than this share of its own
/// distance: neighbours on all sides rather than many on one trajectory.
const SPREAD: f64 = 0.5;
/// Share of the other neighbours that one must be consistent with.
const AGREED: f64 = 0.6;
/// Sheets for whose sites there is room among those looked at.
const SHEETS: usize = 3;
/// Sites further away than this many times the reach of their own fit say nothing.
const BEYOND: f64 = 1.0;
/// Within this share of it a place counts as inside even if all sites are on one side: at an
/// invariant boundary there are none beyond.
const INSIDE: f64 = 0.5;
/// At the edge: length of the mean unit vector to the sites around.
const ONE_SIDED: f64 = 0.85;
/// Two say the same of p at a place if they differ by less than these shares of what it changes by
/// on the way, and of its size.
const OF_CHANGE: f64 = 0.5;
const OF_SIZE: f64 = 0.02;
/// Nearer than this, in widths, a place is a site.
const SAME: f64 = 1e-12;
/// Of a game p counts as a solution of H = 0 where H is at most this share of its terms.
pub(crate) const ISAACS_RESIDUAL: f64 = 3e-3;
/// Most windings to either side.
const MOST_WINDINGS: i32 = 3;

/// As many cells that are not known yet.
fn blank<T>(count: usize) -> Vec<OnceLock<T>> {
    (0..count).map(|_| OnceLock::new()).collect()
}

/// H, L and the states' rates at `(s, p)`.
fn isaacs(system: &System) -> Program {
    let n = system.states;
    let running = system.rate[2 * n];
    let roots = [&[system.observer.hamiltonian, running], &system.rate[..n]].concat();
    Program::lower(&system.graph, &system.inputs, &roots)
}

impl ValueMap {
    /// Prepares look-ups in what is known. Where trajectories were swept this sweeps some more,
    /// next to the equilibrium.
    ///
    /// # Errors
    /// [`MapError`].
    pub fn new(model: &Model, hamiltonian: &Hamiltonian, known: Known) -> Result<Self, MapError> {
        let states = model.states.len();
        if states > MOST_DIMENSIONS {
            return Err(MapError::TooManyStates { states });
        }
        let choices = Choices {
            unasked: true,
            ..Choices::default()
        };
        let plan = Plan::new(model, hamiltonian, &Cpu::new(), choices)?;
        let fronts = Fronts::new(&known, &plan);
        let sites = Sites::collect(model, hamiltonian, &plan, &known)?;
        let Known {
            pieces,
            beyond,
            errors,
            coverage,
            ..
        } = known;
        let rough = beyond.filter(|_| pieces.is_some());
        let beyond = rough.clone().map(|pieces| pieces.within(MAP_ERROR_MAX));
        let nothing_else = sites.source.iter().all(|s| *s == Source::Local);
        if pieces.is_none() && nothing_else {
            return Err(MapError::Empty);
        }
        let system = &plan.system;
        let control = Program::lower(&system.graph, &system.inputs, &system.observer.control);
        let isaacs = plan.game.then(|| isaacs(system));
        // Where none is rough the two are the same.
        let parts = beyond.as_ref().map_or(0, |good| good.pieces.len());
        let rough = rough.filter(|all| all.pieces.len() > parts);
        let round = [beyond.as_ref(), rough.as_ref()];
        let swift = (pieces.as_ref().filter(|_| !plan.game))
            .and_then(|pieces| Swift::new(pieces, round, &plan));
        let mut this = Self {
            tree: index(&sites.z, states),
            nodal: blank(sites.len()),
            left_out: blank(sites.len()),
            dominated: blank(sites.len()),
            contested: blank(sites.len()),
            overlap: OnceLock::new(),
            windings: Vec::new(),
            isaacs,
            controls: Evaluator::new(&control),
            control,
            guarded: Guarded::of(&plan),
            local_errors: plan.local.as_ref().map(LocalErrors::new),
            plan,
            sites,
            fronts,
            own_errors: errors,
            searched: coverage.unwrap_or(Coverage::Searched),
            pieces_alone: pieces.is_some() && nothing_else,
            time: (pieces.as_ref().filter(|p| p.states() > states)).and(model.final_time()),
            pieces,
            beyond,
            swift,
        };
        this.windings = this.possible_windings();
        Ok(this)
    }

    /// States n.
    pub fn states(&self) -> usize {
        self.sites.n
    }

    /// The final time, where V is known as V(x, t) up to there.
    pub fn time(&self) -> Option<f64> {
        self.time
    }

    /// The map in pieces, the series that is used near the equilibrium, and the equations: all that
    /// its answers are made of.
    pub fn in_parts(&self) -> Option<(&Pieces, Option<LocalPolynomial>, &System)> {
        let system = &self.plan.system;
        let local = self
            .plan
            .local
            .as_ref()
            .map(|l| l.polynomial(&system.reference));
        Some((self.pieces.as_ref()?, local, system))
    }

    /// Sites that are interpolated between.
    pub fn sites(&self) -> usize {
        self.sites.len()
    }

    /// Pieces of a map that was made to an error; 0 where there is none.
    pub fn pieces(&self) -> usize {
        self.pieces.as_ref().map_or(0, |p| p.pieces.len())
    }

    /// The highest V of a map in pieces at some states spread over its region, at t = 0.
    pub fn highest_in_pieces(&self) -> Option<f64> {
        const LOOKED_AT: usize = 2048;
        let pieces = self.pieces.as_ref()?;
        let mut bounds: Vec<[f64; 2]> = (pieces.region.lo.iter().zip(&pieces.region.hi))
            .map(|(lo, hi)| [*lo, *hi])
            .collect();
        bounds
            .iter_mut()
            .skip(self.states())
            .for_each(|b| *b = [0.0; 2]);
        let values = spread_over(&bounds, LOOKED_AT)
            .into_iter()
            .filter_map(|x| Some(pieces.at(&x)?.v));
        values.reduce(f64::max)
    }

    /// Windings for which a state of the region may lie among the sites.
    fn possible_windings(&self) -> Vec<Vec<i32>> {
        let n = self.sites.n;
        let mut all = vec![vec![0; n]];
        for i in 0..n {
            let Some(period) = self.plan.periods[i] else {
                continue;
            };
            let period = period / self.plan.widths[i];
            let coordinates = || self.sites.z.iter().skip(i).step_by(n);
            let lowest = coordinates().copied().fold(f64::INFINITY, f64::min);
            let highest = coordinates().copied().fold(f64::NEG_INFINITY, f64::max);
            let w = self.plan.widths[i];
            let [lo, hi] = self.plan.region[i].map(|s| s / w);
            let least = (((lowest - hi) / period).ceil() as i32).max(-MOST_WINDINGS);
            let most = (((highest - lo) / period).floor() as i32).min(MOST_WINDINGS);
            all = (all.iter())
                .flat_map(|base| {
                    (least.min(0)..=most.max(0)).map(|k| {
                        let mut winding = base.clone();
                        winding[i] = k;
                        winding
                    })
                })
                .collect();
        }
        all
    }

    /// V, p and u at a state (absolute), with errors; on a finite horizon at t = 0.
    ///
    /// # Panics
    /// Where `x` has not one component for each state.
    pub fn at(&self, x: &[f64]) -> At {
        self.at_time(x, 0.0)
    }

    /// The same at a time of a finite horizon.
    pub fn at_time(&self, x: &[f64], t: f64) -> At {
        let states = self.states();
        assert_eq!(x.len(), states, "a state has {states} components");
        if !x.iter().chain([&t]).all(|x| x.is_finite()) {
            return At {
                lowest: Err(Unknown::Far),
                others: Vec::new(),
            };
        }
        let mut at = self.without_errors_at(x, t);
        let values = at.lowest.iter_mut().chain(&mut at.others);
        for value in values.filter(|v| v.sites > 0 && !v.in_pieces) {
            self.estimate(x, value);
        }
        at
    }

    /// The same with NaN for the errors: for many states.
    ///
    /// Where a state was solved, its solution is the value; a lower one of interpolation is among
    /// the others.
    pub fn without_errors(&self, x: &[f64]) -> At {
        self.without_errors_at(x, 0.0)
    }

    fn without_errors_at(&self, x: &[f64], t: f64) -> At {
        let mut at = self.ranked(x, t);
        let solved = |v: &Value| v.nearest < SAME && v.sites > 0 && v.solved == v.sites;
        if let (Ok(lowest), false) = (&mut at.lowest, self.plan.game)
            && !solved(lowest)
            && let Some(k) = at.others.iter().position(solved)
        {
            // The other sheets keep their order by V.
            std::mem::swap(lowest, &mut at.others[k]);
            at.others.sort_by(|a, b| a.v.total_cmp(&b.v));
        }
        at
    }

    /// All sheets by rising V.
    fn ranked(&self, x: &[f64], t: f64) -> At {
        if self.pieces.is_some() && self.excluded(x).is_some_and(|excluded| excluded[0]) {
            return At {
                lowest: Err(Unknown::Guard),
                others: Vec::new(),
            };
        }
        let s: Vec<f64> = x
            .iter()
            .zip(&self.plan.system.reference)
            .map(|(x, r)| x - r)
            .collect();
        if let Some(value) = self.near_equilibrium(&s) {
            return At {
                lowest: Ok(value),
                others: Vec::new(),
            };
        }
        if let Some(at) = self.in_pieces(x, t) {
            return at;
        }
        if t > 0.0 {
            let known = if self.time.is_some() {
                Unknown::Far
            } else {
                Unknown::OtherTime
            };
            return At {
                lowest: Err(known),
                others: Vec::new(),
            };
        }
        let z: Vec<f64> = s
            .iter()
            .zip(&self.plan.widths)
            .map(|(s, w)| s / w)
            .collect();
        let local_models = self.local_models(&z, None);
        if local_models.is_empty() {
            return At {
                lowest: Err(Unknown::Far),
                others: Vec::new(),
            };
        }
        if local_models[0].distance >= SAME && !self.sites.errors.is_empty() {
            return At {
                lowest: Err(Unknown::Between),
                others: Vec::new(),
            };
        }
        let mut values: Vec<Value> = (self.sheets(&local_models).iter())
            .filter_map(|members| self.blended(&s, &local_models, members))
            .filter(|value| self.solves_isaacs(&s, &value.p))
            .collect();
        values.sort_by(|a, b| a.v.total_cmp(&b.v));
        if self.plan.game && values.len() > 1 && values[0].v >= self.overlap() {
            return At {
                lowest: Err(Unknown::SeveralSheets),
                others: values,
            };
        }
        let mut values = values.into_iter();
        At {
            lowest: values.next().ok_or(Unknown::Edge),
            others: values.collect(),
        }
    }

    /// What the map in pieces returns; `None` outside its region where the one round it does not
    /// know either.
    fn in_pieces(&self, x: &[f64], t: f64) -> Option<At> {
        let pieces = self
            .pieces
            .as_ref()
            .filter(|_| t == 0.0 || self.time.is_some())?;
        let (mut x, winding) = self.wound(pieces, x);
        let s: Vec<f64> = x
            .iter()
            .zip(&self.plan.system.reference)
            .map(|(x, r)| x - r)
            .collect();
        x.extend(self.time.map(|_| t));
        let asked = pieces.covers(&x);
        let pieces = if asked { pieces } else { self.beyond.as_ref()? };
        let mut values = (pieces.sheets(&x).into_iter())
            .filter(|said| self.solves_isaacs(&s, &said.p))
            .map(|said| self.value_in_pieces(pieces, &x, &winding, said));
        let lowest = match values.next() {
            Some(value) => Ok(value),
            None if asked => Err(Unknown::Uncertain),
            None => return None,
        };
        Some(At {
            lowest,
            others: values.collect(),
        })
    }

    /// The error that the map in pieces was asked for, relative to the larger one of V and its
    /// floor, where a value of it has a larger one.
    pub fn falls_short(&self, value: &Value) -> Option<f64> {
        let region = &self.pieces.as_ref().filter(|_| value.in_pieces)?.region;
        (value.v_error > region.error * value.v.abs().max(region.floor)).then_some(region.error)
    }

    /// Whether there is a map round the region of the one asked for.
    pub fn maps_beyond(&self) -> bool {
        self.beyond.is_some()
    }

    /// A state moved by whole periods into the region of a map in pieces, with the numbers of
    /// periods.
    fn wound(&self, pieces: &Pieces, x: &[f64]) -> (Vec<f64>, Vec<i32>) {
        let mut x = x.to_vec();
        let mut winding = vec![0; x.len()];
        for (i, period) in self.plan.periods.iter().enumerate() {
            let Some(period) = period else { continue };
            let turns = turns_into(x[i], [pieces.region.lo[i], pieces.region.hi[i]], *period);
            winding[i] = turns as i32;
            x[i] += turns * period;
        }
        (x, winding)
    }

    /// `x` and what is said of it have the time where that is an axis.
    fn value_in_pieces(&self, pieces: &Pieces, x: &[f64], winding: &[i32], said: Said) -> Value {
        let s: Vec<f64> = x
            .iter()
            .zip(&self.plan.system.reference)
            .map(|(x, r)| x - r)
            .collect();
        let told = self.told(x, winding.to_vec(), said, &pieces.hessian(x));
        self.with_control(&s, told)
    }

    /// What is said of a state that was moved by whole periods, still without u; with the bounds of
    /// p. What is blended from no piece is the local solution's.
    fn told(
        &self,
        x: &[f64],
        winding: Vec<i32>,
        mut said: Said,
        hessian: &[f64],
    ) -> (Value, Vec<f64>) {
        let n = self.states();
        let hessian = of_states(hessian, said.p.len(), n);
        let rate = said.p.get(n).copied().unwrap_or(f64::NAN);
        said.p.truncate(n);
        said.p_bound.truncate(n);
        let in_pieces = said.pieces > 0;
        let value = Value {
            v: said.v,
            rate,
            hessian,
            p_error: self.relative(&said.p_bound, &said.p),
            u_error: 0.0,
            u: Vec::new(),
            v_error: said.v_bound,
            p: said.p,
            sheet: if in_pieces { said.sheet } else { UNLABELLED },
            sites: said.pieces,
            solved: 0,
            nearest: 0.0,
            in_pieces,
            winding,
            coverage: match in_pieces {
                true => self.coverage_of_pieces(x),
                false => Coverage::Local,
            },
        };
        (value, said.p_bound)
    }

    /// With u at a deviation, and what the bounds of p make of it.
    fn with_control(&self, s: &[f64], (value, bound): (Value, Vec<f64>)) -> Value {
        let u = self.control(s, &value.p);
        Value {
            u_error: self.control_error(s, &value.p, &bound, &u),
            u,
            ..value
        }
    }

    /// Of a state within a period of the region: outside it the map has what solutions from there
    /// met.
    fn coverage_of_pieces(&self, x: &[f64]) -> Coverage {
        match (
            self.searched,
            self.pieces.as_ref().is_some_and(|asked| asked.covers(x)),
        ) {
            (Coverage::Checked, false) => Coverage::Searched,
            (searched, _) => searched,
        }
    }

    /// The largest component of a bound of p's error relative to that of p, each times the region's
    /// width.
    fn relative(&self, bound: &[f64], p: &[f64]) -> f64 {
        let widths = &self.plan.widths;
        let largest = |p: &[f64]| {
            p.iter()
                .zip(widths)
                .fold(0.0f64, |a, (p, w)| a.max((p * w).abs()))
        };
        match largest(bound) {
            // At the equilibrium itself p is 0 too.
            0.0 => 0.0,
            bound => bound / largest(p),
        }
    }

    /// What the bound of p, one component after the other, makes of u.
    fn control_error(&self, s: &[f64], p: &[f64], bound: &[f64], u: &[f64]) -> f64 {
        let mut error = 0.0f64;
        for i in 0..p.len() {
            for sign in [-1.0, 1.0] {
                let mut p = p.to_vec();
                p[i] += sign * bound[i];
                let off = self.control(s, &p);
                error = off
                    .iter()
                    .zip(u)
                    .fold(error, |a, (x, y)| a.max((x - y).abs()));
            }
        }
        error
    }

    /// The level of V at which the manifold of a game overlaps itself: the least V of a second
    /// sheet over any of some states of the region; without an equilibrium below everything.
    fn overlap(&self) -> f64 {
        const LOOKED_AT: usize = 2048;
        *self.overlap.get_or_init(|| {
            if self.plan.local.is_none() {
                return f64::NEG_INFINITY;
            }
            let points = spread_over(&self.plan.region, LOOKED_AT);
            (points.par_iter())
                .filter_map(|s| {
                    let z: Vec<f64> = s
                        .iter()
                        .zip(&self.plan.widths)
                        .map(|(s, w)| s / w)
                        .collect();
                    let local_models = self.local_models(&z, None);
                    let sheets = self.sheets(&local_models);
                    let mut values: Vec<f64> = (sheets.iter())
                        .filter_map(|members| Some(self.blended(s, &local_models, members)?.v))
                        .collect();
                    values.sort_by(f64::total_cmp);
                    values.get(1).copied()
                })
                .reduce(|| f64::INFINITY, f64::min)
        })
    }

    /// Whether a sample (x, V) of an extremal is, as far as the map can tell, on the lowest sheet
    /// (in a game the only one).
    pub fn is_lowest(&self, x: &[f64], v: f64) -> bool {
        // Interpolation errs; a sheet that is better by less than this is as good.
        const MARGIN: f64 = 1e-3;
        if self.plan.game && matches!(self.without_errors(x).lowest, Err(Unknown::SeveralSheets)) {
            return false;
        }
        self.local(x)
            .is_none_or(|here| v <= here.v + MARGIN * here.v.abs().max(v.abs()))
    }

    /// A deviation less whole periods, with the sizes of the numbers that it is a difference of,
    /// and the numbers of periods.
    fn unwound(&self, s: &[f64]) -> (Vec<f64>, Vec<f64>, Vec<i32>) {
        let mut winding = vec![0; s.len()];
        let mut s = s.to_vec();
        let mut sizes: Vec<f64> = s.iter().map(|s| s.abs()).collect();
        for (i, period) in self.plan.periods.iter().enumerate() {
            if let Some(period) = period {
                winding[i] = -unwind(&mut s[i], &mut sizes[i], *period) as i32;
            }
        }
        (s, sizes, winding)
    }

    /// Bounds of the errors of V and p that the local solution says at a state, in arithmetic of a
    /// unit roundoff.
    #[cfg(feature = "gpu")]
    fn local_bounds(&self, x: &[f64], unit: f64) -> Option<(f64, Vec<f64>)> {
        let s: Vec<f64> = x
            .iter()
            .zip(&self.plan.system.reference)
            .map(|(x, r)| x - r)
            .collect();
        let (s, sizes, _) = self.unwound(&s);
        let mut bound = vec![0.0; s.len()];
        let of_v = self.local_errors.as_ref()?.at(&s, &sizes, unit, &mut bound);
        Some((of_v, bound))
    }

    fn near_equilibrium(&self, s: &[f64]) -> Option<Value> {
        let local = self.plan.local.as_ref()?;
        let (s, sizes, winding) = self.unwound(s);
        if local.quadratic(&s) > local.seed_value {
            return None;
        }
        let (v, p, hessian) = local.expansion(&s);
        let mut p_bound = vec![0.0; s.len()];
        let v_bound =
            (self.local_errors.as_ref()?).at(&s, &sizes, 0.5 * f64::EPSILON, &mut p_bound);
        let said = Said {
            v,
            p,
            v_bound,
            p_bound,
            sheet: UNLABELLED,
            pieces: 0,
        };
        let told = self.told(&s, winding, said, &hessian);
        Some(self.with_control(&s, told))
    }

    /// Of a game whether `H(x, p)` is about 0: behind a fold no p makes it so, whatever
    /// interpolation returns.
    fn solves_isaacs(&self, s: &[f64], p: &[f64]) -> bool {
        let Some(program) = &self.isaacs else {
            return true;
        };
        let values = program.eval(&[s, p].concat());
        let (h, running) = (values[0], values[1]);
        let power: f64 = values[2..].iter().zip(p).map(|(f, p)| (f * p).abs()).sum();
        h.abs() <= ISAACS_RESIDUAL * (running.abs() + power)
    }

    fn control(&self, s: &[f64], p: &[f64]) -> Vec<f64> {
        self.control.eval(&[s, p].concat())
    }

    fn turn(&self, winding: &[i32], i: usize) -> f64 {
        f64::from(winding[i]) * self.plan.periods[i].unwrap_or(0.0) / self.plan.widths[i]
    }

    fn blended(&self, s: &[f64], local_models: &[LocalModel], members: &[usize]) -> Option<Value> {
        let n = self.sites.n;
        let first = &local_models[members[0]];
        let exact = first.distance < SAME;
        let reach = self.nodal(first.site, None).map_or(0.0, |f| f.reach);
        // A single unconfirmed prediction is rejected.
        let confirmed = exact || members.len() > 1;
        if !confirmed
            || !exact
                && first.distance > INSIDE * reach
                && !surrounded(n, members.iter().map(|k| &local_models[*k]))
        {
            return None;
        }
        let (prediction, disagreement) = blend(n, local_models, members);
        if self.is_implausible(&prediction) {
            return None;
        }
        let value = self.value(s, first, prediction);
        let used = if exact { &members[..1] } else { members };
        let mut labels = used.iter().map(|k| self.sites.sheet[local_models[*k].site]);
        let solved = used
            .iter()
            .filter(|k| self.sites.source[local_models[**k].site] == Source::Solved)
            .count();
        let coverage = self.coverage(value.v, solved == used.len());
        Some(Value {
            coverage,
            sheet: labels.find(|s| *s != UNLABELLED).unwrap_or(UNLABELLED),
            v_error: disagreement,
            sites: used.len(),
            solved,
            ..value
        })
    }

    /// What a prediction means in the scene's units; errors NaN.
    fn value(&self, s: &[f64], from: &LocalModel, prediction: Prediction) -> Value {
        let n = self.sites.n;
        let w = &self.plan.widths;
        let p: Vec<f64> = prediction.q.iter().zip(w).map(|(q, w)| q / w).collect();
        let winding = self.windings[from.winding].clone();
        let moved: Vec<f64> = (0..n)
            .map(|i| s[i] + self.turn(&winding, i) * w[i])
            .collect();
        Value {
            v: prediction.v,
            u: self.control(&moved, &p),
            p,
            rate: f64::NAN,
            hessian: (0..n * n)
                .map(|k| prediction.hessian[k] / (w[k / n] * w[k % n]))
                .collect(),
            sheet: self.sites.sheet[from.site],
            v_error: f64::NAN,
            p_error: f64::NAN,
            u_error: f64::NAN,
            sites: 1,
            solved: usize::from(self.sites.source[from.site] == Source::Solved),
            nearest: from.distance,
            in_pieces: false,
            winding,
            coverage: self.coverage(prediction.v, self.sites.source[from.site] == Source::Solved),
        }
    }
}

/// The leading `n` rows and columns of a matrix of `all`.
fn of_states(matrix: &[f64], all: usize, n: usize) -> Vec<f64> {
    (0..n * n).map(|k| matrix[k / n * all + k % n]).collect()
}
