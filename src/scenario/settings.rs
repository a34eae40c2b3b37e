//! The sections with numbers only: region, shoot_out, homotopy, map, sheets, integrator.

use super::declare::Declared;
use super::reader::{Reader, Section, Value};
use crate::diagnostics::Problem;
use crate::diagnostics::shorten;
use crate::model::{
    DEFAULT_ARC_LENGTH, DEFAULT_MAP_CHECK, DEFAULT_MAP_STATES, DEFAULT_MARGIN, DEFAULT_MAX_SEEDS,
    DEFAULT_MAX_STEPS, GridAxis, Homotopy, Integrator, LEAST_MAP_ERROR, MAP_ERROR_MAX,
    MAP_ERRORS_MAX, MOST_MAP_CHECK, MOST_MAP_ERROR, MOST_MAP_STATES, MapAim, MapGrid, Method,
    Precision, SampleBy, SeedValue, Sheets, ShootOut,
};
use crate::numeric::digits::plain;
use toml::de::DeValue;

/// Largest gap on a front unless `[shoot_out] spacing` says otherwise.
pub const DEFAULT_SPACING: f64 = 0.05;
/// Stored points a trajectory unless `[shoot_out] samples` says otherwise.
pub const DEFAULT_SAMPLES: usize = 200;
/// Tolerance unless `[integrator]` says otherwise.
pub const DEFAULT_RTOL: f64 = 1e-6;
/// `atol` unless `[integrator]` says otherwise, in units of `rtol`.
pub const DEFAULT_ATOL_SHARE: f64 = 1e-3;

/// Points of a grid.
const MOST_POINTS: f64 = 2e6;

/// Keys of a map that is made to an error.
const OF_ERROR: [&str; 8] = [
    "error_max",
    "equal_cost",
    "floor",
    "region",
    "states",
    "seconds",
    "check",
    "time",
];

/// Seeds of one sweep, at most.
const MOST_SEEDS: u32 = 10_000_000;
/// Below this V differences of states are next to what f64 can hold.
const LEAST_VALUE: f64 = 1e-200;
const SAMPLE_BY: [(&str, Option<SampleBy>); 3] = [
    ("value", Some(SampleBy::Value)),
    ("arc_length", Some(SampleBy::ArcLength)),
    ("auto", None),
];

const PRECISIONS: [(&str, Option<Precision>); 3] = [
    ("f32", Some(Precision::F32)),
    ("f64", Some(Precision::F64)),
    ("auto", None),
];

impl<'a> Reader<'a> {
    /// `[region]`: bounds of each state; `None` where one is missing or wrong.
    pub fn region(
        &mut self,
        section: &Section<'a>,
        states: &[Declared<'a>],
    ) -> Option<Vec<[f64; 2]>> {
        self.entries_of(section, states, "states");
        let mut all = Vec::with_capacity(states.len());
        for state in states {
            let name = shorten(state.name);
            all.push(match section.get(state.name) {
                Some(value) => self.interval(value, &format!("the region of `{name}`")),
                None => {
                    let message = format!("state `{name}` has no bounds in [region]");
                    let help = format!("add {name} = [lower, upper]");
                    self.report(
                        Problem::at(section.span.clone(), message, "missing here").with_help(help),
                    );
                    None
                }
            });
        }
        all.into_iter().collect()
    }

    pub fn interval(&mut self, value: &'a Value<'a>, what: &str) -> Option<[f64; 2]> {
        let [lower, upper] = self.array(value, what, "[lower, upper]", 2)? else {
            return None;
        };
        let bounds = (self.number(lower, what), self.number(upper, what));
        let (Some(lower), Some(upper)) = bounds else {
            return None;
        };
        if lower >= upper {
            let (lower, upper) = (plain(lower), plain(upper));
            let message = format!("{what} is empty: {lower} is not below {upper}");
            return self.refuse(value.span(), message, "the lower bound comes first");
        }
        Some([lower, upper])
    }

    /// `[shoot_out]`; `finite`: the horizon is; `game`: there are disturbances.
    pub fn shoot_out(
        &mut self,
        section: &Section<'a>,
        finite: bool,
        game: bool,
    ) -> Option<ShootOut> {
        self.check_keys(section, "shoot_out");
        let before = self.problems.len();
        let positive = |v: f64| v > 0.0;
        let value_max = section
            .get("value_max")
            .and_then(|v| self.number_that(v, "value_max", "greater than 0", positive));
        if let (Some(v), Some(value)) = (value_max, section.get("value_max"))
            && v < LEAST_VALUE
        {
            let message = format!("value_max must be at least {LEAST_VALUE:e}, not {v:e}");
            self.report(Problem::at(
                value.span(),
                message,
                "too small to reckon with",
            ));
        }
        if section.get("value_max").is_none() && !finite {
            let problem = Problem::at(
                section.span.clone(),
                "[shoot_out] has no value_max",
                "`value_max` is missing",
            );
            self.report(problem.with_help("add value_max = ..., the largest V of interest"));
        }
        let spacing = section.get("spacing").and_then(|v| {
            self.number_that(v, "spacing", "greater than 0 and at most 1", |s| {
                s > 0.0 && s <= 1.0
            })
        });
        let seed_value = self.seed_value(section, value_max, finite);
        let samples = section
            .get("samples")
            .and_then(|v| self.count(v, "samples", 2));
        let max_seeds = section
            .get("max_seeds")
            .and_then(|v| self.count_to(v, "max_seeds", 1, MOST_SEEDS));
        let margin = section
            .get("margin")
            .and_then(|v| self.number_that(v, "margin", "at least 0", |m| m >= 0.0));
        let sample_by = (section.get("sample_by")).and_then(|v| self.sample_by(v, finite, game));
        let arc_length = (section.get("arc_length")).and_then(|v| {
            self.number_that(v, "arc_length", "greater than 0 and at most 1000", |a| {
                a > 0.0 && a <= 1e3
            })
        });
        let folds = section
            .get("folds")
            .and_then(|v| self.yes_or_no(v, "folds"));
        if let (true, Some(false)) = (game, folds) {
            let message = "with disturbances trajectories end where the manifold folds: behind a fold nothing is certified";
            self.report(Problem::at(
                section.key_span("folds"),
                message,
                "remove this",
            ));
        }
        (self.problems.len() == before).then(|| ShootOut {
            value_max,
            spacing: spacing.unwrap_or(DEFAULT_SPACING),
            seed_value,
            samples: samples.unwrap_or(DEFAULT_SAMPLES),
            max_seeds: max_seeds.unwrap_or(DEFAULT_MAX_SEEDS),
            margin: margin.unwrap_or(DEFAULT_MARGIN),
            sample_by,
            arc_length: arc_length.unwrap_or(DEFAULT_ARC_LENGTH),
            folds: folds.unwrap_or(false),
            span: section.span.clone(),
        })
    }

    fn sample_by(&mut self, value: &'a Value<'a>, finite: bool, game: bool) -> Option<SampleBy> {
        let by = self.choice(value, "sample_by", &SAMPLE_BY)??;
        let message = match by {
            _ if finite => "with a final time the stored points are levels of time",
            SampleBy::Value if game => {
                "with disturbances V may fall and rise along a trajectory: its points are no levels of V"
            }
            _ => return Some(by),
        };
        self.refuse(value.span(), message, "remove this, or write \"auto\"")
    }

    fn seed_value(
        &mut self,
        section: &Section<'a>,
        value_max: Option<f64>,
        finite: bool,
    ) -> SeedValue {
        let Some(value) = section.get("seed_value") else {
            return SeedValue::Auto;
        };
        if value.get_ref().as_str() == Some("auto") {
            return SeedValue::Auto;
        }
        let Some(seed) = self.number_that(value, "seed_value", "greater than 0", |v| v > 0.0)
        else {
            return SeedValue::Auto;
        };
        if finite {
            let message =
                "seed_value has no meaning with a final time: seeds lie on the terminal cost";
            self.report(Problem::at(
                value.span(),
                message,
                "remove this, or write \"auto\"",
            ));
        } else if let Some(max) = value_max.filter(|max| seed >= *max) {
            let (seed, max) = (plain(seed), plain(max));
            let message = format!("seed_value must be below value_max, but {seed} >= {max}");
            self.report(Problem::at(
                value.span(),
                message,
                format!("value_max is {max}"),
            ));
        }
        SeedValue::Value(seed)
    }

    /// `[homotopy]`. States it does not name stay at `reference`, if that is known.
    pub fn homotopy(
        &mut self,
        section: &Section<'a>,
        states: &[Declared<'a>],
        reference: Option<&[f64]>,
    ) -> Option<Homotopy> {
        let fixed = |i: usize| {
            reference
                .and_then(|r| r.get(i))
                .map(|&x| GridAxis::Fixed(x))
        };
        let axes = self.grid_axes(section, states, &fixed)?;
        self.grid_size(section, grid_points(&axes))?;
        Some(Homotopy {
            axes,
            span: section.span.clone(),
        })
    }

    /// One axis a state; `default` is that of a state which the section does not name.
    pub fn grid_axes(
        &mut self,
        section: &Section<'a>,
        states: &[Declared<'a>],
        default: &dyn Fn(usize) -> Option<GridAxis>,
    ) -> Option<Vec<GridAxis>> {
        self.entries_of(section, states, "states");
        let axes: Vec<Option<GridAxis>> = (states.iter().enumerate())
            .map(|(i, state)| match section.get(state.name) {
                Some(value) => self.axis(value, &shorten(state.name)),
                None => default(i),
            })
            .collect();
        axes.into_iter().collect()
    }

    /// Refuses a grid of too many points.
    pub fn grid_size(&mut self, section: &Section<'a>, points: f64) -> Option<()> {
        if points <= MOST_POINTS {
            return Some(());
        }
        let message = format!(
            "{} has {} points; at most {MOST_POINTS:.0} are solved at once",
            section.name,
            number_of(points)
        );
        self.refuse(section.span.clone(), message, "too many points")
    }

    /// `[map]`: a regular grid over the region.
    pub fn map(&mut self, section: &Section<'a>, states: &[Declared<'a>]) -> Option<MapGrid> {
        self.check_keys(section, "map");
        let accurate = section.get("error").is_some();
        if !accurate {
            for key in OF_ERROR {
                if let Some(value) = section.get(key) {
                    let message = format!("`{key}` belongs to a map that is made to an error");
                    self.refuse::<()>(
                        value.span(),
                        message,
                        "give `error = 1e-3` too, or leave it out",
                    );
                }
            }
        }
        if accurate && section.get("resolution").is_none() {
            return None;
        }
        let before = self.problems.len();
        let value_max = (section.get("value_max"))
            .and_then(|v| self.number_that(v, "value_max", "greater than 0", |v| v > 0.0));
        let counts: Vec<usize> = match section.get("resolution") {
            None => vec![default_resolution(states.len()); states.len()],
            Some(value) if matches!(value.get_ref(), DeValue::Table(_)) => {
                let table = self.table(value, section.key_span("resolution"), "resolution")?;
                self.entries_of(&table, states, "states");
                (states.iter())
                    .map(|state| match table.get(state.name) {
                        Some(value) => self.count(
                            value,
                            &format!("the resolution of `{}`", shorten(state.name)),
                            1,
                        ),
                        None => Some(1),
                    })
                    .collect::<Option<_>>()?
            }
            Some(value) => vec![self.count(value, "resolution", 2)?; states.len()],
        };
        self.grid_size(section, counts.iter().map(|c| *c as f64).product())?;
        (self.problems.len() == before).then(|| MapGrid {
            counts,
            value_max,
            span: section.span.clone(),
        })
    }

    /// What `[map]` asks for with `error`.
    pub fn map_aim(
        &mut self,
        section: &Section<'a>,
        states: &[Declared<'a>],
        region: Option<&[[f64; 2]]>,
        (finite, game): (bool, bool),
    ) -> Option<MapAim> {
        let error = section.get("error")?;
        let before = self.problems.len();
        let within = |v: f64| (LEAST_MAP_ERROR..=MOST_MAP_ERROR).contains(&v);
        let wanted = format!("from {LEAST_MAP_ERROR:e} to {MOST_MAP_ERROR}");
        let error = self.number_that(error, "the error of the map", &wanted, within);
        let mut positive = |key: &str| {
            section
                .get(key)
                .and_then(|v| self.number_that(v, key, "greater than 0", |v| v > 0.0))
        };
        let (floor, value_max, seconds) = (
            positive("floor"),
            positive("value_max"),
            positive("seconds"),
        );
        let equal_cost = positive("equal_cost");
        let count = |reader: &mut Self, key: &str, default: usize| match section.get(key) {
            Some(value) => reader.count(value, key, 1),
            None => Some(default),
        };
        let most = count(self, "states", DEFAULT_MAP_STATES);
        let check = count(self, "check", DEFAULT_MAP_CHECK);
        self.check_map_size(section, states.len(), check);
        let time = self.time_axis(section, states.len(), finite, game);
        let bounds = self.map_bounds(section, states, region?)?;
        let (error, most, check) = (error?, most?, check?);
        let error_max = match section.get("error_max") {
            Some(value) => {
                let wanted = format!("at least the error asked for, {error:e}");
                self.number_that(value, "error_max", &wanted, |v| v >= error)?
            }
            None => MAP_ERROR_MAX.max(MAP_ERRORS_MAX * error),
        };
        (self.problems.len() == before).then(|| MapAim {
            error,
            error_max,
            equal_cost,
            floor,
            bounds,
            value_max,
            states: most,
            seconds,
            check,
            time,
            span: section.span.clone(),
        })
    }

    /// Refuses a map to an error with too many fresh states or too many axes.
    fn check_map_size(&mut self, section: &Section<'a>, states: usize, check: Option<usize>) {
        if let (Some(asked), Some(value)) = (check, section.get("check"))
            && asked > MOST_MAP_CHECK
        {
            let message = format!("check = {asked}: at most {MOST_MAP_CHECK} fresh states");
            self.refuse::<()>(
                value.span(),
                message,
                "1000 tell a share of wrong bounds to 0.3 %",
            );
        }
        if states > MOST_MAP_STATES {
            let message = format!("a map to an error is made for at most {MOST_MAP_STATES} states");
            let label = format!("this scene has {states}");
            self.refuse::<()>(section.span.clone(), message, label);
        }
    }

    /// The region of a map to an error: the scene's, made narrower by `region`.
    fn map_bounds(
        &mut self,
        section: &Section<'a>,
        states: &[Declared<'a>],
        region: &[[f64; 2]],
    ) -> Option<Vec<[f64; 2]>> {
        let mut bounds = region.to_vec();
        let Some(value) = section.get("region") else {
            return Some(bounds);
        };
        let table = self.table(value, section.key_span("region"), "the region of the map")?;
        self.entries_of(&table, states, "states");
        for (state, bounds) in states.iter().zip(&mut bounds) {
            if let Some(value) = table.get(state.name) {
                let what = format!("the map's range of `{}`", shorten(state.name));
                *bounds = self.range_within(value, &what, *bounds)?;
            }
        }
        Some(bounds)
    }

    /// A range `[lower, upper]` that is not empty and lies inside another.
    fn range_within(
        &mut self,
        value: &'a Value<'a>,
        what: &str,
        bounds: [f64; 2],
    ) -> Option<[f64; 2]> {
        let [lo, hi] = self.array(value, what, "[lower, upper]", 2)? else {
            return None;
        };
        let (lo, hi) = (self.number(lo, what)?, self.number(hi, what)?);
        if lo >= hi {
            let (lo, hi) = (plain(lo), plain(hi));
            let message = format!("{what} is empty: {lo} is not below {hi}");
            return self.refuse(value.span(), message, "the lower end comes first");
        }
        if lo < bounds[0] || hi > bounds[1] {
            let message = format!(
                "{what} is not inside the region, from {} to {}",
                plain(bounds[0]),
                plain(bounds[1])
            );
            return self.refuse(
                value.span(),
                message,
                "make [region] wider, or this narrower",
            );
        }
        Some([lo, hi])
    }

    /// Whether a map to an error has time as an axis: unless the scene says, wherever that can be
    /// had.
    fn time_axis(
        &mut self,
        section: &Section<'a>,
        states: usize,
        finite: bool,
        game: bool,
    ) -> bool {
        let possible = finite && !game && states < MOST_MAP_STATES;
        let Some(value) = section.get("time") else {
            return possible;
        };
        let Some(wanted) = self.yes_or_no(value, "time") else {
            return false;
        };
        if wanted && !possible {
            let (message, help) = if !finite {
                (
                    "an infinite horizon has no time axis",
                    "V does not depend on time: leave `time` out".to_owned(),
                )
            } else if game {
                (
                    "the map of a game has no time axis",
                    "`time = false` makes that of V(x, 0)".to_owned(),
                )
            } else {
                let message = "the map of so many states has no time axis";
                let most = MOST_MAP_STATES - 1;
                (
                    message,
                    format!(
                        "time counts as a state: at most {most} others; `time = false` makes that of V(x, 0)"
                    ),
                )
            };
            self.refuse::<()>(value.span(), message, help);
        }
        wanted && possible
    }

    /// `[sheets]`.
    pub fn sheets(&mut self, section: &Section<'a>) -> Sheets {
        self.check_keys(section, "sheets");
        Sheets {
            value_max: (section.get("value_max"))
                .and_then(|v| self.number_that(v, "value_max", "greater than 0", |v| v > 0.0)),
        }
    }

    fn axis(&mut self, value: &'a Value<'a>, name: &str) -> Option<GridAxis> {
        let what = format!("the axis of `{name}`");
        if !matches!(value.get_ref(), DeValue::Array(_)) {
            return self.number(value, &what).map(GridAxis::Fixed);
        }
        let [first, last, count] = self.array(value, &what, "[first, last, count]", 3)? else {
            return None;
        };
        let ends = (self.number(first, &what), self.number(last, &what));
        let count = self.count(count, &format!("the count of {what}"), 2);
        let ((Some(first), Some(last)), Some(count)) = (ends, count) else {
            return None;
        };
        if first >= last {
            let (first, last) = (plain(first), plain(last));
            let message = format!("{what} is empty: {first} is not below {last}");
            return self.refuse(value.span(), message, "the lower end comes first");
        }
        Some(GridAxis::Range { first, last, count })
    }

    /// `[integrator]`, or the defaults.
    pub fn integrator(&mut self, section: Option<&Section<'a>>) -> Integrator {
        let mut integrator = Integrator {
            method: None,
            rtol: DEFAULT_RTOL,
            atol: DEFAULT_ATOL_SHARE * DEFAULT_RTOL,
            step: None,
            precision: None,
            max_steps: DEFAULT_MAX_STEPS,
            span: section.map(|s| s.span.clone()),
        };
        let Some(section) = section else {
            return integrator;
        };
        self.check_keys(section, "integrator");
        let method = section
            .get("method")
            .map(|v| self.choice(v, "method", &methods()));
        if let Some(rtol) = section.get("rtol").and_then(|v| {
            self.number_that(v, "rtol", "greater than 0 and at most 0.1", |r| {
                r > 0.0 && r <= 0.1
            })
        }) {
            integrator.rtol = rtol;
            integrator.atol = DEFAULT_ATOL_SHARE * rtol;
        }
        if let Some(atol) = section
            .get("atol")
            .and_then(|v| self.number_that(v, "atol", "at least 0", |a| a >= 0.0))
        {
            integrator.atol = atol;
        }
        integrator.step = section
            .get("step")
            .and_then(|v| self.number_that(v, "step", "greater than 0", |h| h > 0.0));
        if let Some(precision) = section
            .get("precision")
            .and_then(|v| self.choice(v, "precision", &PRECISIONS))
        {
            integrator.precision = precision;
        }
        if let Some(steps) = section
            .get("max_steps")
            .and_then(|v| self.count(v, "max_steps", 1))
        {
            integrator.max_steps = steps;
        }
        // An unknown method says nothing about whether it needs a step.
        if let Some(method) = method.unwrap_or(Some(None)) {
            integrator.method = method;
            self.check_step(section, method);
        }
        integrator
    }

    fn check_step(&mut self, section: &Section<'a>, method: Option<Method>) {
        let name = method.map_or("auto", Method::name);
        let given = section.get("step").is_some();
        if is_fixed_step(method) && !given {
            let message = format!("method {name} has a fixed step, which is not given");
            let problem = Problem::at(section.key_span("method"), message, "needs a step");
            self.report(problem.with_help("add step = ..., in units of time"));
        } else if !is_fixed_step(method) && given {
            let message = match method {
                Some(_) => format!("method {name} chooses its steps itself"),
                None => "without a method the steps are chosen for you".to_owned(),
            };
            let problem = Problem::at(section.key_span("step"), message, "has no meaning here");
            self.report(problem.with_help("remove step, or write method = \"rk4\""));
        }
    }
}

/// Points of a grid.
pub(super) fn grid_points(axes: &[GridAxis]) -> f64 {
    let of = |a: &GridAxis| match a {
        GridAxis::Fixed(_) => 1.0,
        GridAxis::Range { count, .. } => *count as f64,
    };
    axes.iter().map(of).product()
}

/// Points along each axis of a map that does not say: some thousands in all.
fn default_resolution(states: usize) -> usize {
    (4096f64.powf(1.0 / states as f64).round() as usize).clamp(2, 101)
}

fn is_fixed_step(method: Option<Method>) -> bool {
    method.is_some_and(|m| !m.adaptive())
}

/// Names of methods, and "auto".
fn methods() -> Vec<(&'static str, Option<Method>)> {
    let named = Method::ALL.iter().map(|(name, m)| (*name, Some(*m)));
    named.chain([("auto", None)]).collect()
}

/// A count that is kept as a real number, for messages.
pub fn number_of(count: f64) -> String {
    match count < 1e9 {
        true => format!("{count:.0}"),
        false => format!("{count:.3e}"),
    }
}
