//! What the pictures are made of, read once.

use super::plane::{GridField, Plane, refined};
use super::{names, ticks};
use costate::low_level::model::{Model, Report};
use costate::low_level::numeric::digits::plain;
use costate::low_level::result::Stored;
use costate::low_level::result::StoredMapError;
use costate::low_level::schema;
use costate::low_level::trajectories::{SolvedStates, SweptTrajectories};
use costate::low_level::value::PointStatus;
use std::cell::OnceCell;

/// Points along each axis of the planes that are drawn, about.
const FINE: usize = 160;
/// Solved states along an axis from which a plane is drawn.
const LEAST: usize = 5;
/// The same where each point is a search: between these, V is told by p.
const COARSE: usize = 41;

/// Options that do not fit the scene.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum OptionsError {
    #[error("{what}: the scene has no state `{name}`{hint}")]
    UnknownState {
        what: &'static str,
        name: String,
        hint: String,
    },
    #[error("--slice {name}={}: outside the region, which is {} to {}", plain(*value), plain(*from), plain(*to))]
    SliceOutside {
        name: String,
        value: f64,
        from: f64,
        to: f64,
    },
    #[error("--slice {name}: it is one of the picture's axes; choose others with --axes")]
    SliceOfAxis { name: String },
    #[error("--axes: two different states are needed")]
    Axes,
}

/// A result file and what it is to be shown of it.
pub struct Source<'s> {
    pub stored: &'s Stored,
    pub model: &'s Model,
    /// The two states of pictures of a plane; the same one twice where there is but one state.
    pub axes: [usize; 2],
    /// The state of which pictures replace two components.
    pub base: Vec<f64>,
    /// Asked for; empty: to be chosen.
    levels: Vec<f64>,
    trajectories: Result<Option<SweptTrajectories>, String>,
    points: Result<Option<SolvedStates>, String>,
    sheets: Result<Option<SolvedStates>, String>,
    field: Result<Option<GridField>, String>,
    plane: OnceCell<Result<Option<Plane>, String>>,
}

impl<'s> Source<'s> {
    /// Reads the groups; `choice` goes before the scene's `[report]`, entry by entry.
    ///
    /// # Errors
    /// [`OptionsError`] where a choice does not fit the scene.
    pub fn new(stored: &'s Stored, choice: &Report) -> Result<Self, OptionsError> {
        let model = &stored.scene.model;
        let merged = merged(choice, model.report.as_ref());
        // Before anything is read: a mistake is told at once.
        let asked = axes(model, &merged, None)?;
        base(model, &merged, asked, None)?;
        let text = |e: costate::low_level::result::StoredError| e.to_string();
        let trajectories = stored.trajectories().map_err(text);
        let points = stored.points().map_err(text);
        let sheets = stored.points_sheets().map_err(text);
        let field = field(stored, &points);
        let grid = field.as_ref().ok().and_then(Option::as_ref);
        let axes = axes(model, &merged, grid)?;
        let base = base(model, &merged, axes, grid)?;
        Ok(Self {
            stored,
            model,
            axes,
            base,
            levels: merged.levels,
            trajectories,
            points,
            sheets,
            field,
            plane: OnceCell::new(),
        })
    }

    /// `/trajectories`.
    pub fn trajectories(&self) -> Result<Option<&SweptTrajectories>, String> {
        let found = self.trajectories.as_ref().map_err(Clone::clone)?;
        Ok(found.as_ref().filter(|t| t.count > 0 && t.samples > 0))
    }

    /// `/points`.
    pub fn points(&self) -> Result<Option<&SolvedStates>, String> {
        Ok(self
            .points
            .as_ref()
            .map_err(Clone::clone)?
            .as_ref()
            .filter(|p| p.count > 0))
    }

    /// `/points_sheets`.
    pub fn sheets(&self) -> Result<Option<&SolvedStates>, String> {
        Ok(self
            .sheets
            .as_ref()
            .map_err(Clone::clone)?
            .as_ref()
            .filter(|p| p.count > 0))
    }

    /// The value function where solved states form a grid.
    pub fn field(&self) -> Result<Option<&GridField>, String> {
        Ok(self.field.as_ref().map_err(Clone::clone)?.as_ref())
    }

    /// V over the plane of the two states, where the data cover some of it.
    pub fn plane(&self) -> Result<Option<&Plane>, String> {
        let field = self.field()?;
        let made = self.plane.get_or_init(|| {
            // Solved states on a grid, or what follows from all solutions of the file.
            match field.and_then(|f| self.make_plane(f)) {
                Some(plane) => Ok(Some(plane)),
                None => self.scattered(),
            }
        });
        Ok(made.as_ref().map_err(Clone::clone)?.as_ref())
    }

    /// From solutions that form no map. With a finite horizon only solved states are of the initial
    /// time.
    fn scattered(&self) -> Result<Option<Plane>, String> {
        if !self.knows_values() || self.axes[0] == self.axes[1] {
            return Ok(None);
        }
        let map = match self.stored.value_map() {
            Ok(map) => map,
            Err(StoredMapError::Empty { .. }) => return Ok(None),
            Err(e) => return Err(format!("no value map: {e}")),
        };
        let swept = self.trajectories().ok().flatten().map(|t| &t.v);
        let solved = self.points().ok().flatten().map(|p| &p.v);
        let said = map.highest_in_pieces();
        let known = [swept, solved]
            .into_iter()
            .flatten()
            .flatten()
            .copied()
            .chain(said)
            .filter(|v| v.is_finite());
        let limit = known.fold(f64::NEG_INFINITY, f64::max);
        let region = &self.model.region;
        let field = GridField::of_value_map(&map, self.axes, &self.base, region, COARSE, limit);
        let Some(plane) = field.and_then(|field| self.make_plane(&field)) else {
            return Ok(None);
        };
        let states: Vec<f64> = (plane.x.iter())
            .flat_map(|a| plane.y.iter().map(move |b| [*a, *b]))
            .flat_map(|at| {
                let mut x = plane.base.clone();
                (x[self.axes[0]], x[self.axes[1]]) = (at[0], at[1]);
                x
            })
            .collect();
        // What the map does not know is not shown, though its neighbours would foretell it.
        let (mut v, excess) = (plane.v.clone(), map.excess(&states).unwrap_or_default());
        for (v, (_, known)) in v.iter_mut().zip(&excess) {
            if !known && *v < limit {
                *v = f64::NAN;
            }
        }
        let excess = excess.into_iter().map(|(excess, _)| excess).collect();
        Ok(Some(Plane {
            limit,
            v,
            excess,
            ..plane
        }))
    }

    fn make_plane(&self, field: &GridField) -> Option<Plane> {
        let [a, b] = self.axes;
        if a == b || [a, b].iter().any(|k| field.axes[*k].len() < LEAST) {
            return None;
        }
        let along = |k: usize| refined(&field.axes[k], FINE);
        Plane::new(field, self.axes, &self.base, along(a), along(b))
    }

    /// The levels of contours of V on a plane.
    pub fn levels(&self, plane: &Plane) -> Vec<f64> {
        if !self.levels.is_empty() {
            return self.levels.clone();
        }
        let values: Vec<f64> = plane.v.iter().copied().filter(|v| v.is_finite()).collect();
        let most = self.value_max(&values).min(plane.limit);
        let least = values.iter().copied().fold(f64::INFINITY, f64::min);
        if least >= -1e-9 * most.abs() && most > 0.0 {
            one_two_five(most)
        } else {
            // From below the least to above the largest: all is covered.
            let step = ticks::step(most - least, 12);
            let (first, last) = ((least / step).floor() as i64, (most / step).ceil() as i64);
            (first..=last).map(|k| k as f64 * step).collect()
        }
    }

    /// The largest V of pictures: the map's limit, else the largest value.
    fn value_max(&self, values: &[f64]) -> f64 {
        let asked = self.model.map.as_ref().and_then(|m| m.value_max);
        let most = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        asked.map_or(most, |a| a.min(most))
    }

    /// Whether V can be asked for at any state.
    pub fn knows_values(&self) -> bool {
        self.stored.has(&schema::MAP_PIECES)
            || self.infinite()
                && self
                    .stored
                    .has_any(&[&schema::TRAJECTORIES, &schema::POINTS])
    }

    /// Whether the horizon is infinite: V grows from 0 at the equilibrium.
    /// What an axis of the time is called.
    pub fn time_label(&self) -> String {
        match &self.model.time_unit {
            Some(unit) => format!("time ({unit})"),
            None => "time".to_owned(),
        }
    }

    pub fn infinite(&self) -> bool {
        matches!(
            self.model.horizon,
            costate::low_level::model::Horizon::Infinite { .. }
        )
    }

    /// What the two axes say.
    pub fn labels(&self) -> [String; 2] {
        self.axes
            .map(|k| names::label(&self.model.states[k].variable))
    }

    /// ` at R = 0.12, γ = 1.5`: the states that a picture of the plane holds fixed; on a finite
    /// horizon the time too.
    pub fn fixed(&self) -> String {
        let states = &self.model.states;
        let mut fixed = names::held(states, &self.axes, |k| self.base[k]);
        if !self.infinite() {
            fixed.push(format!("{} = 0", self.model.time_name()));
        }
        names::at(&fixed)
    }
}

/// 1, 2, 5, 10, ... times powers of ten: about three decades up to and including `most`.
fn one_two_five(most: f64) -> Vec<f64> {
    let top = most.log10().ceil() as i32;
    let all = (top - 4..=top).flat_map(|e| [1.0, 2.0, 5.0].map(|f| f * 10f64.powi(e)));
    // A last round level close to the end would make a band that is not seen.
    let mut levels: Vec<f64> = all
        .filter(|v| *v > most * 1e-3 && *v < most * 0.93)
        .collect();
    levels.push(most);
    levels
}

fn merged(choice: &Report, scene: Option<&Report>) -> Report {
    let mut merged = choice.clone();
    if let Some(scene) = scene {
        if merged.levels.is_empty() {
            merged.levels.clone_from(&scene.levels);
        }
        let axes_asked = merged.axes.is_some();
        if !axes_asked {
            merged.axes.clone_from(&scene.axes);
        }
        for (name, value) in &scene.slice {
            // The scene's slice may be along what is now an axis.
            let axis = axes_asked && merged.axes.as_ref().is_some_and(|a| a.contains(name));
            if !axis && !merged.slice.iter().any(|(n, _)| n == name) {
                merged.slice.push((name.clone(), *value));
            }
        }
    }
    merged.levels.sort_by(f64::total_cmp);
    merged.levels.dedup();
    merged
}

fn state(model: &Model, name: &str, what: &'static str) -> Result<usize, OptionsError> {
    let names = || model.states.iter().map(|s| s.variable.name.as_str());
    names()
        .position(|n| n == name)
        .ok_or_else(|| OptionsError::UnknownState {
            what,
            name: name.to_owned(),
            hint: costate::low_level::diagnostics::did_you_mean(name, names()).map_or_else(
                || format!("; its states: {}", names().collect::<Vec<_>>().join(", ")),
                |s| format!("; {s}"),
            ),
        })
}

fn axes(
    model: &Model,
    choice: &Report,
    grid: Option<&GridField>,
) -> Result<[usize; 2], OptionsError> {
    let Some([a, b]) = &choice.axes else {
        // The first two that are not asked to be fixed, those of a grid before others.
        let fixed = |k: &usize| {
            choice
                .slice
                .iter()
                .any(|(n, _)| *n == model.states[*k].variable.name)
        };
        let along = |k: &usize| grid.is_none_or(|g| g.fixed(*k).is_none());
        let mut free: Vec<usize> = (0..model.states.len()).filter(|k| !fixed(k)).collect();
        free.sort_by_key(|k| !along(k));
        free.truncate(2);
        free.sort_unstable();
        let mut free = free.into_iter();
        let first = free.next().unwrap_or(0);
        return Ok([first, free.next().unwrap_or(first)]);
    };
    let found = [state(model, a, "--axes")?, state(model, b, "--axes")?];
    if found[0] == found[1] {
        return Err(OptionsError::Axes);
    }
    Ok(found)
}

/// The reference, or where a grid is if that has but one place along a state.
fn base(
    model: &Model,
    choice: &Report,
    axes: [usize; 2],
    grid: Option<&GridField>,
) -> Result<Vec<f64>, OptionsError> {
    let mut base = model.reference().to_vec();
    for (k, x) in base.iter_mut().enumerate() {
        *x = grid.and_then(|g| g.fixed(k)).unwrap_or(*x);
    }
    for (name, value) in &choice.slice {
        let k = state(model, name, "--slice")?;
        let [from, to] = model.region[k];
        if !(*value >= from && *value <= to) {
            return Err(OptionsError::SliceOutside {
                name: name.clone(),
                value: *value,
                from,
                to,
            });
        }
        if axes.contains(&k) {
            return Err(OptionsError::SliceOfAxis { name: name.clone() });
        }
        base[k] = *value;
    }
    Ok(base)
}

/// The solved states as a grid: the map, else points that form one in two states or more.
fn field(
    stored: &Stored,
    points: &Result<Option<SolvedStates>, String>,
) -> Result<Option<GridField>, String> {
    let (n, m) = (
        stored.scene.model.states.len(),
        stored.scene.model.controls.len(),
    );
    if let Some(map) = stored.map().map_err(|e| e.to_string())? {
        let above: Vec<bool> = map
            .status
            .iter()
            .map(|s| *s == PointStatus::AboveMax as i32)
            .collect();
        let limit = stored
            .scene
            .model
            .map
            .as_ref()
            .and_then(|m| m.value_max)
            .unwrap_or(f64::INFINITY);
        return Ok(Some(GridField::of_map(&map, m, &above, limit)));
    }
    let points = points.as_ref().map_err(Clone::clone)?;
    let grid = points.as_ref().and_then(|p| GridField::of_points(p, n, m));
    Ok(grid.filter(|g| g.extent().len() > 1))
}
