//! A scene as the rest of the program sees it: symbols, expressions and settings. Nothing here
//! knows TOML.

mod feedback;
mod turns;

pub use feedback::{Activation, Base, Feedback, LawOutput, Target};
pub use turns::{MOST_TURNS, TooManyTurns};

use crate::diagnostics::{Problem, ScenarioErrors};
use crate::expr::{Graph, Id, Values};
use crate::mechanism::Mechanism;

pub use crate::diagnostics::Span;

/// A named, possibly unit-carrying axis entry.
#[derive(Clone, Debug)]
pub struct Variable {
    pub name: String,
    pub unit: Option<String>,
    pub long_name: Option<String>,
    pub symbol: Id,
    /// Where it is declared.
    pub span: Span,
}

/// A state; `period` makes it an angle-like coordinate.
#[derive(Clone, Debug)]
pub struct State {
    pub variable: Variable,
    pub period: Option<f64>,
}

/// A control with optional bounds (both numbers, lower below upper).
#[derive(Clone, Debug)]
pub struct Control {
    pub variable: Variable,
    pub min: Option<f64>,
    pub max: Option<f64>,
    /// Where the bounds stand, if any.
    pub bounds_span: Option<Span>,
}

/// A parameter and its value.
#[derive(Clone, Debug)]
pub struct Parameter {
    pub name: String,
    pub symbol: Id,
    pub value: f64,
}

/// An expression and the place it was written.
#[derive(Clone, Debug)]
pub struct Located {
    pub expr: Id,
    pub span: Span,
}

/// Condition under which the model is valid: `expr` is positive (or not negative) inside.
#[derive(Clone, Debug)]
pub struct Guard {
    pub name: String,
    /// Normalised: `a > b` and `b < a` become `a - b`.
    pub condition: Located,
    /// `>` rather than `>=`.
    pub strict: bool,
}

/// What a simulation forward in time meets: the state jumps there, or the simulation ends.
#[derive(Clone, Debug)]
pub struct Event {
    pub name: String,
    /// Positive until the condition comes true.
    pub ahead: Id,
    /// The event counts where this is not negative as the condition comes true; elsewhere it is
    /// passed by.
    pub only: Option<Id>,
    /// The state after it, of that before; `None` ends the simulation.
    pub map: Option<Vec<Id>>,
    /// What contacts of a mechanism keep as it is, after it and before it: 0 where they hold.
    pub kept: Vec<Kept>,
}

/// A velocity or a distance that a contact keeps as it is, at an event: of the state before it.
#[derive(Clone, Debug)]
pub struct Kept {
    pub contact: String,
    pub after: Id,
    pub before: Id,
}

/// `[simulation]`.
#[derive(Clone, Debug)]
pub struct Simulation {
    /// One a state.
    pub initial: Vec<Start>,
    /// `None`: the final time of a finite horizon.
    pub time: Option<f64>,
    /// Events after which a flight ends.
    pub events: usize,
    /// Stored points a phase.
    pub samples: usize,
    /// Of `[closed_loop.law]`, or `lqr`; `None`: controls are held.
    pub law: Option<String>,
    /// Events after which an orbit is to come back to itself.
    pub cycle: Option<usize>,
    pub span: Span,
}

/// Events after which a simulation ends, and stored points a phase, unless the scene says.
pub const DEFAULT_EVENTS: usize = 1000;
pub const DEFAULT_PHASE_SAMPLES: usize = 50;

/// What ends the trajectories in forward time.
#[derive(Clone, Debug)]
pub enum Horizon {
    /// The equilibrium: values of all states and controls, where f = 0 and L = 0.
    Infinite {
        x: Vec<f64>,
        u: Vec<f64>,
        span: Span,
    },
    /// Terminal cost phi(x) at `final_time`; `reference` is the point deviations are taken from.
    Finite {
        terminal: Located,
        final_time: f64,
        reference: Vec<f64>,
    },
}

/// V of the seed ellipsoid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SeedValue {
    Auto,
    Value(f64),
}

/// `[shoot_out]`.
#[derive(Clone, Debug)]
pub struct ShootOut {
    /// Fronts up to this V. Absent only in a finite-horizon scene.
    pub value_max: Option<f64>,
    /// Largest gap between neighbours on a front as a fraction of the region's box.
    pub spacing: f64,
    pub seed_value: SeedValue,
    /// Stored points a trajectory.
    pub samples: usize,
    /// Cap on the number of seeds.
    pub max_seeds: usize,
    /// How far outside the region a trajectory is followed, as a fraction of the region's width on
    /// each side.
    pub margin: f64,
    /// What stored points are levels of; `None`: V where it is monotone along trajectories.
    pub sample_by: Option<SampleBy>,
    /// Longest trajectory where points are levels of arc length, in widths of the region.
    pub arc_length: f64,
    /// Whether trajectories end where the manifold folds, which in a game they always do.
    pub folds: bool,
    pub span: Span,
}

/// What the stored points of a trajectory on an infinite horizon are levels of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SampleBy {
    Value,
    ArcLength,
}

/// Length of a trajectory sampled by arc length unless `[shoot_out] arc_length` says otherwise.
pub const DEFAULT_ARC_LENGTH: f64 = 8.0;

/// Largest number of seeds unless `[shoot_out] max_seeds` says otherwise.
pub const DEFAULT_MAX_SEEDS: usize = 100_000;
/// How far a trajectory is followed outside the region unless `[shoot_out] margin` says otherwise.
pub const DEFAULT_MARGIN: f64 = 1.0;

/// One axis of the `[homotopy]` grid: a fixed value or `count` values from `first` to `last`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum GridAxis {
    Fixed(f64),
    Range { first: f64, last: f64, count: usize },
}

/// `[homotopy]`: one axis a state (a state not named is fixed at the equilibrium).
#[derive(Clone, Debug)]
pub struct Homotopy {
    pub axes: Vec<GridAxis>,
    pub span: Span,
}

/// `[map]`: a regular grid over the region.
#[derive(Clone, Debug)]
pub struct MapGrid {
    /// Points along each state's axis; 1 is the reference alone.
    pub counts: Vec<usize>,
    /// Larger V is left out of the map.
    pub value_max: Option<f64>,
    pub span: Span,
}

/// Bound of a map above which nothing is said unless the scene has another, and how many errors
/// asked for it is at least.
pub const MAP_ERROR_MAX: f64 = 0.02;
pub const MAP_ERRORS_MAX: f64 = 10.0;
/// Least and largest error that a map can be asked for, relative to V.
pub const LEAST_MAP_ERROR: f64 = 1e-8;
pub const MOST_MAP_ERROR: f64 = 0.1;
/// States up to which a map to an error is made.
pub const MOST_MAP_STATES: usize = 6;
/// States that a map to an error may solve for, and fresh states that it is checked with, unless
/// the scene says.
pub const DEFAULT_MAP_STATES: usize = 100_000;
pub const DEFAULT_MAP_CHECK: usize = 200;
/// Fresh states that a scene may ask for.
pub const MOST_MAP_CHECK: usize = 1_000_000;

/// `[map]` with `error`: pieces, refined until the error is met.
#[derive(Clone, Debug, PartialEq)]
pub struct MapAim {
    /// Relative to the larger one of V and the floor.
    pub error: f64,
    /// Nothing is said where the bound is above this, relative to the same.
    pub error_max: f64,
    /// Largest distance of the surface of equal cost of two sheets from where the map has it, in
    /// widths of the region; `None`: any.
    pub equal_cost: Option<f64>,
    /// In units of the cost; `None`: chosen.
    pub floor: Option<f64>,
    /// `[lower, upper]` a state, inside the region.
    pub bounds: Vec<[f64; 2]>,
    /// Larger V is left out.
    pub value_max: Option<f64>,
    /// States that may be solved for, and seconds.
    pub states: usize,
    pub seconds: Option<f64>,
    /// Fresh states of the check.
    pub check: usize,
    /// Whether V(x, t) is wanted, over the whole horizon, or V(x, 0) alone.
    pub time: bool,
    pub span: Span,
}

/// `[sheets]`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sheets {
    /// V up to which every sheet is continued.
    pub value_max: Option<f64>,
}

/// `[report]`: what pictures show.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// Of contours of V; empty: to be chosen.
    pub levels: Vec<f64>,
    /// States that are held fixed, and where; others are at the reference.
    pub slice: Vec<(String, f64)>,
    /// The two states of a plane; the first two without.
    pub axes: Option<[String; 2]>,
}

/// Where the closed loop starts along one state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Start {
    Fixed(f64),
    /// `count` is absent only where states are drawn at random.
    Range {
        first: f64,
        last: f64,
        count: Option<usize>,
    },
}

/// A law given in `[closed_loop.law]`.
#[derive(Clone, Debug)]
pub struct GivenLaw {
    pub name: String,
    pub formula: Formula,
    pub span: Span,
}

/// How a given law is written.
#[derive(Clone, Debug)]
pub enum Formula {
    /// An expression of states for each control, or state to be commanded, by name.
    Expressions(Vec<(String, Located)>),
    /// A file of weights; a relative name is looked for beside the scene.
    Weights { file: String, span: Span },
}

/// What of a recorded expression is kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Extremum {
    Min,
    Max,
    Final,
}

/// A quantity recorded along the closed loop: an extremum, or the last value, of an expression of
/// states and controls.
#[derive(Clone, Debug)]
pub struct Record {
    pub name: String,
    pub extremum: Extremum,
    pub of: Located,
    /// As written.
    pub text: String,
}

/// The initial states from which a recorded quantity keeps within a bound.
#[derive(Clone, Debug)]
pub struct OperatingSet {
    pub name: String,
    /// Index of the quantity.
    pub record: usize,
    /// Inside is `quantity >= bound` rather than `<=`.
    pub at_least: bool,
    pub bound: f64,
    /// As written.
    pub text: String,
}

/// `[closed_loop]`.
#[derive(Clone, Debug)]
pub struct ClosedLoop {
    pub final_time: f64,
    /// Intervals between the points at which quantities are recorded.
    pub samples: usize,
    /// One a state.
    pub initial: Vec<Start>,
    /// So many initial states at random, uniform in the ranges of `initial`, instead of their grid.
    pub random: Option<usize>,
    /// Names of the laws asked for; `None`: all there are.
    pub laws: Option<Vec<(String, Span)>>,
    pub given: Vec<GivenLaw>,
    pub records: Vec<Record>,
    pub sets: Vec<OperatingSet>,
    /// Rate at which a commanded state is followed.
    pub track: Option<f64>,
    /// Share of the region's mean of 1/2 d'Pd below which a trajectory's end counts as at the
    /// equilibrium.
    pub converged: f64,
    /// How far outside the region a trajectory is followed, as a fraction of the region's width on
    /// each side.
    pub margin: f64,
    /// Time between updates of the map's law.
    pub period: Option<f64>,
    /// What the map's law does where the map knows nothing.
    pub outside: Outside,
    pub span: Span,
}

impl ClosedLoop {
    /// Time between samples.
    pub fn interval(&self) -> f64 {
        self.final_time / self.samples as f64
    }
}

/// What the law of a map does where the map knows nothing, until it knows again.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Outside {
    /// The trajectory ends.
    Stop,
    /// p goes on as `q + H s` of the last answer.
    Hold,
    /// p is that of the nearest state known, on the way from the state, moved into the map's
    /// region, to the reference point.
    Nearest,
    /// The same where the equations foretell that it leads back to where the map knows; else the
    /// cheapest plan that first holds a control at a bound.
    #[default]
    Search,
    /// p is that of the Riccati solution at the equilibrium.
    Local,
}

impl Outside {
    pub const ALL: [(&'static str, Outside); 5] = [
        ("stop", Outside::Stop),
        ("hold", Outside::Hold),
        ("nearest", Outside::Nearest),
        ("search", Outside::Search),
        ("lqr", Outside::Local),
    ];

    pub fn name(self) -> &'static str {
        Self::ALL
            .iter()
            .find(|(_, o)| *o == self)
            .map_or("?", |(name, _)| name)
    }
}

/// `[dissipation]`: the L2 gain that V certifies, checked by simulation. `None` is "auto".
#[derive(Clone, Debug)]
pub struct Dissipation {
    /// Disturbances under each law.
    pub disturbances: usize,
    pub final_time: Option<f64>,
    /// Largest amplitude, one a disturbance.
    pub amplitude: Option<Vec<f64>>,
    /// Between which frequencies sinusoids lie, rad a unit of time.
    pub frequencies: Option<[f64; 2]>,
    /// Names of the laws asked for; `None`: the optimal one.
    pub laws: Option<Vec<(String, Span)>>,
    /// One a state; `None`: spread over where V is known.
    pub initial: Option<Vec<Start>>,
    /// Intervals between the times at which the inequality is checked.
    pub samples: usize,
    /// Time between updates of p from a value map.
    pub period: Option<f64>,
    pub span: Span,
}

/// `[study]`: the optimal trajectory from one state, for several values of parameters.
#[derive(Clone, Debug)]
pub struct Study {
    /// Parameters and their values; all combinations are studied.
    pub vary: Vec<(String, Vec<f64>)>,
    /// The state, for the parameters' present values.
    pub from: Vec<f64>,
    pub records: Vec<Record>,
    /// Stored points a trajectory.
    pub samples: usize,
    pub span: Span,
}

/// `[attenuation]`: the smallest level of a disturbance's attenuation that the linearization, and
/// that a region, allows.
#[derive(Clone, Debug)]
pub struct Attenuation {
    /// The parameter that is the level; larger is easier.
    pub parameter: String,
    /// Where its value stands in `[parameters]`.
    pub parameter_span: Span,
    /// Values that are searched; `None`: from the scene's own value on.
    pub range: Option<[f64; 2]>,
    /// Relative, of the smallest value that covers the states.
    pub tolerance: f64,
    /// The states at which coverage is judged: a grid, one axis a state.
    pub axes: Vec<GridAxis>,
    /// Values whose regions of validity are stored; empty: to be chosen.
    pub levels: Vec<f64>,
    pub span: Span,
}

/// `[closed_loop] converged` unless given.
pub const DEFAULT_CONVERGED: f64 = 1e-3;
/// `[closed_loop] margin` unless given: room for a surge cycle or a swing.
pub const DEFAULT_LOOP_MARGIN: f64 = 5.0;

/// Integration method.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Method {
    Rk4,
    Tsit5,
    Dop853,
    /// Taylor series of an order that follows from the tolerance.
    Taylor,
}

impl Method {
    pub const ALL: [(&'static str, Method); 4] = [
        ("rk4", Method::Rk4),
        ("tsit5", Method::Tsit5),
        ("dop853", Method::Dop853),
        ("taylor", Method::Taylor),
    ];

    pub fn name(self) -> &'static str {
        Method::ALL
            .iter()
            .find(|(_, m)| *m == self)
            .map_or("?", |(n, _)| n)
    }
}

/// Arithmetic of the integration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Precision {
    F32,
    F64,
}

impl Precision {
    pub fn name(self) -> &'static str {
        match self {
            Precision::F32 => "f32",
            Precision::F64 => "f64",
        }
    }

    /// Bytes of a number.
    pub fn bytes(self) -> usize {
        match self {
            Precision::F32 => 4,
            Precision::F64 => 8,
        }
    }

    /// Unit roundoff times two: the spacing of numbers at 1.
    pub fn epsilon(self) -> f64 {
        match self {
            Precision::F32 => f64::from(f32::EPSILON),
            Precision::F64 => f64::EPSILON,
        }
    }
}

/// `[integrator]`. `None` is "auto".
#[derive(Clone, Debug)]
pub struct Integrator {
    pub method: Option<Method>,
    pub rtol: f64,
    pub atol: f64,
    /// Step of a fixed-step method; required for it.
    pub step: Option<f64>,
    pub precision: Option<Precision>,
    pub max_steps: usize,
    pub span: Option<Span>,
}

/// Step limit unless `[integrator] max_steps` says otherwise.
pub const DEFAULT_MAX_STEPS: usize = 100_000;

/// A whole scene, checked for everything that can be checked without deriving the Hamiltonian.
#[derive(Clone, Debug)]
pub struct Model {
    pub title: String,
    /// File name for messages, and the whole text for messages and the result file.
    pub file_name: String,
    pub text: String,
    /// Parameters replaced from outside the text, with what they were given.
    pub overrides: Vec<(String, String)>,
    pub graph: Graph,
    pub parameters: Vec<Parameter>,
    pub states: Vec<State>,
    pub controls: Vec<Control>,
    pub disturbances: Vec<Variable>,
    /// One a state: its time derivative.
    pub dynamics: Vec<Located>,
    /// From which they follow, where the scene has bodies and joints.
    pub mechanism: Option<Mechanism>,
    /// Running cost L.
    pub running: Located,
    pub horizon: Horizon,
    /// `[lower, upper]` a state.
    pub region: Vec<[f64; 2]>,
    pub guards: Vec<Guard>,
    pub events: Vec<Event>,
    pub simulation: Option<Simulation>,
    pub shoot_out: Option<ShootOut>,
    pub homotopy: Option<Homotopy>,
    pub map: Option<MapGrid>,
    pub map_aim: Option<MapAim>,
    pub sheets: Sheets,
    /// Laws to fit.
    pub feedback: Vec<Feedback>,
    pub report: Option<Report>,
    pub closed_loop: Option<ClosedLoop>,
    pub dissipation: Option<Dissipation>,
    pub study: Option<Study>,
    pub attenuation: Option<Attenuation>,
    pub integrator: Integrator,
    /// The unit of time, where the scene says.
    pub time_unit: Option<String>,
    /// The unit of cost, hence of V, where the scene says.
    pub cost_unit: Option<String>,
    /// Remarks on the scene: what it says and is not used.
    pub notes: Vec<String>,
}

impl Model {
    /// Problems that a later stage found in the model, to be reported with its text.
    pub fn errors(&self, problems: Vec<Problem>) -> ScenarioErrors {
        ScenarioErrors::new(&self.file_name, &self.text, problems)
    }

    /// The present value of a parameter; `None` where there is none of this name.
    pub fn parameter(&self, name: &str) -> Option<f64> {
        self.parameters
            .iter()
            .find(|p| p.name == name)
            .map(|p| p.value)
    }

    /// Whether there is a disturbance, and H = min max.
    pub fn is_game(&self) -> bool {
        !self.disturbances.is_empty()
    }

    /// Value of every parameter symbol.
    pub fn parameter_values(&self) -> Values {
        self.parameters
            .iter()
            .map(|p| (p.symbol, p.value))
            .collect()
    }

    /// Index of the state of a name; else what is wrong with it, in words.
    ///
    /// # Errors
    /// Text for a message: the names there are, and the one that may be meant.
    pub fn state(&self, name: &str) -> Result<usize, String> {
        let names = || self.states.iter().map(|s| s.variable.name.as_str());
        names().position(|n| n == name).ok_or_else(|| {
            let hint = crate::diagnostics::did_you_mean(name, names())
                .map_or_else(String::new, |s| format!("; {s}"));
            let all: Vec<&str> = names().collect();
            format!(
                "`{name}` is not a state of the scene (states: {}){hint}",
                all.join(", ")
            )
        })
    }

    /// Final time of a finite horizon.
    pub fn final_time(&self) -> Option<f64> {
        match self.horizon {
            Horizon::Infinite { .. } => None,
            Horizon::Finite { final_time, .. } => Some(final_time),
        }
    }

    /// What time is called in files, tables and options: `t`, unless a state has that name.
    pub fn time_name(&self) -> &'static str {
        let taken = |name: &&str| self.states.iter().any(|s| s.variable.name == *name);
        let names = ["t", "time", "time_of_horizon"];
        names
            .into_iter()
            .find(|n| !taken(n))
            .unwrap_or("costate_time")
    }

    /// The point deviations are taken from: the equilibrium, or the finite horizon's reference.
    pub fn reference(&self) -> &[f64] {
        match &self.horizon {
            Horizon::Infinite { x, .. } => x,
            Horizon::Finite { reference, .. } => reference,
        }
    }
}
