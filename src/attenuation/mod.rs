//! The smallest level of attenuation: of the linearization, and of a region that is to be covered.

mod refuse;
mod search;

pub use refuse::refuse;
pub use search::{Covering, Outcome, Row, Search, Sought, search};

use crate::backend::{Backend, BackendError};
use crate::diagnostics::ScenarioErrors;
use crate::local::{AttenuationError, Cause, LinearAttenuation, Linearization, linear_attenuation};
use crate::model::{self, Homotopy};
use crate::numeric::digits::plain;
use crate::scene::Scene;
use crate::sweep::Choices;
use crate::value::{self, Grid, PointStatus, StatesError};

/// Why the smallest level could not be found.
#[derive(Debug, thiserror::Error)]
pub enum SmallestError {
    #[error("{parameter}* of the linearization: {source}")]
    Linear {
        parameter: String,
        source: AttenuationError<ScenarioErrors>,
    },
    #[error("{parameter} = {}: {errors}", plain(*value))]
    Scene {
        parameter: String,
        value: f64,
        errors: Box<ScenarioErrors>,
    },
    #[error(
        "the level {} of [attenuation] is below {parameter}* = {star:.10}, the smallest that the linearization allows",
        plain(*value)
    )]
    LevelBelow {
        parameter: String,
        value: f64,
        star: f64,
    },
    #[error(transparent)]
    Backend(#[from] BackendError),
}

/// What was found for a scene.
#[derive(Clone, Debug)]
pub struct Attenuated {
    pub parameter: String,
    /// The scene's own value.
    pub own: f64,
    pub linear: LinearAttenuation,
    /// The states at which coverage is judged.
    pub grid: Grid,
    pub search: Search,
    /// Values whose regions of validity are to be shown: rows of the search, rising.
    pub levels: Vec<f64>,
}

impl Attenuated {
    /// The rows of the levels, rising.
    pub fn regions(&self) -> Vec<&Row> {
        let row = |level: &f64| self.search.rows.iter().find(|r| r.value == *level);
        self.levels.iter().filter_map(row).collect()
    }
}

/// gamma* of the scene's linearization.
///
/// # Errors
/// [`SmallestError::Linear`].
pub fn linear(
    scene: &Scene,
    asked: &model::Attenuation,
) -> Result<LinearAttenuation, SmallestError> {
    let own = scene.model.parameter(&asked.parameter).unwrap_or(f64::NAN);
    let mut at = |value: f64| {
        let other = scene.with(&[(&asked.parameter, value)])?;
        Ok(Linearization::new(&other.hamiltonian, &other.model))
    };
    linear_attenuation(own, asked.range, &mut at).map_err(|source| SmallestError::Linear {
        parameter: asked.parameter.clone(),
        source,
    })
}

/// The smallest level whose region of validity covers the states of the scene's `[attenuation]`,
/// and coverage against the level. `progress` is told what is being solved.
///
/// # Errors
/// [`SmallestError`]. A level at which the scene cannot be swept is a row without coverage, no
/// error.
///
/// # Panics
/// Without an `[attenuation]`.
pub fn smallest(
    scene: &Scene,
    backend: &dyn Backend,
    choices: Choices,
    progress: &mut dyn FnMut(&str),
) -> Result<Attenuated, SmallestError> {
    let levels = Levels::new(scene, backend, choices, progress)?;
    let mut done = 0;
    levels.searched(&mut |value| levels.looked_at(value, &mut done, progress))
}

/// The levels of a scene's `[attenuation]`, and what is looked at for each.
pub struct Levels<'a> {
    scene: &'a Scene,
    backend: &'a dyn Backend,
    choices: Choices,
    asked: &'a model::Attenuation,
    own: f64,
    linear: LinearAttenuation,
    grid: Grid,
    /// Those of the grid, `[state][component]`.
    states: Vec<f64>,
}

impl<'a> Levels<'a> {
    /// # Errors
    /// [`SmallestError::Linear`], [`SmallestError::LevelBelow`].
    ///
    /// # Panics
    /// Without an `[attenuation]`.
    pub fn new(
        scene: &'a Scene,
        backend: &'a dyn Backend,
        choices: Choices,
        progress: &mut dyn FnMut(&str),
    ) -> Result<Self, SmallestError> {
        let asked = (scene.model.attenuation.as_ref()).expect("the scene has an [attenuation]");
        let parameter = &asked.parameter;
        progress(&format!("{parameter}* of the linearization"));
        let linear = linear(scene, asked)?;
        let (star, bounded) = (linear.star, linear.cause == Cause::None);
        let is_below = |l: &f64| if bounded { *l < star } else { *l <= star };
        if let Some(value) = asked.levels.iter().copied().find(is_below) {
            return Err(SmallestError::LevelBelow {
                parameter: parameter.clone(),
                value,
                star,
            });
        }
        let grid = Grid::homotopy(&Homotopy {
            axes: asked.axes.clone(),
            span: asked.span.clone(),
        });
        Ok(Self {
            own: scene.model.parameter(parameter).unwrap_or(f64::NAN),
            states: grid.points(),
            scene,
            backend,
            choices,
            asked,
            linear,
            grid,
        })
    }

    /// Searches with what is known of each level.
    ///
    /// # Errors
    /// Those of `evaluate`.
    pub fn searched<E>(
        &self,
        evaluate: &mut dyn FnMut(f64) -> Result<Outcome, E>,
    ) -> Result<Attenuated, E> {
        let sought = Sought {
            star: self.linear.star,
            allowed: self.linear.cause == Cause::None,
            own: self.own,
            top: self.asked.range.map(|r| r[1]),
            tolerance: self.asked.tolerance,
        };
        let (search, levels) = search(&sought, &self.asked.levels, evaluate)?;
        Ok(self.attenuated(search, levels))
    }

    fn attenuated(&self, search: Search, levels: Vec<f64>) -> Attenuated {
        Attenuated {
            parameter: self.asked.parameter.clone(),
            own: self.own,
            linear: self.linear,
            grid: self.grid.clone(),
            search,
            levels,
        }
    }

    /// Solves for the states at a level, before which so many were.
    ///
    /// # Errors
    /// [`SmallestError`].
    pub fn looked_at(
        &self,
        value: f64,
        done: &mut usize,
        progress: &mut dyn FnMut(&str),
    ) -> Result<Outcome, SmallestError> {
        let parameter = &self.asked.parameter;
        let head = format!("{parameter} = {value:.6} ({done} before it)");
        *done += 1;
        progress(&head);
        let mut told = |what: &str, of: usize, all: usize| {
            progress(&format!("{head}: {of} of {all} states, {what}"))
        };
        let found = outcome(
            self.scene,
            parameter,
            value,
            &self.states,
            self.backend,
            self.choices,
            &mut told,
        )?;
        // What is cut short shows nothing of a level.
        self.choices.deadline.check()?;
        Ok(found)
    }

    /// Into how many units the work is divided: the search, and each level that is asked for.
    pub fn units(&self) -> usize {
        1 + self.asked.levels.len()
    }

    /// How many states are looked at for a level.
    pub fn states(&self) -> usize {
        self.states.len() / self.scene.model.states.len()
    }

    /// The rows of a unit. The search goes by what other levels tell of those that are asked for,
    /// which are units of their own: larger levels are easier. Where they tell nothing it looks
    /// itself.
    ///
    /// # Errors
    /// [`SmallestError`].
    pub fn unit(
        &self,
        unit: usize,
        progress: &mut dyn FnMut(&str),
    ) -> Result<Vec<Row>, SmallestError> {
        let mut done = 0;
        if let Some(level) = unit.checked_sub(1).and_then(|k| self.asked.levels.get(k)) {
            let outcome = self.looked_at(*level, &mut done, progress)?;
            return Ok(vec![Row {
                value: *level,
                outcome,
            }]);
        }
        let mut rows: Vec<Row> = Vec::new();
        self.searched(&mut |value| {
            if self.asked.levels.contains(&value)
                && let Some(covers) = foretold(&rows, value)
            {
                return Ok(self.synthetic(covers));
            }
            let outcome = self.looked_at(value, &mut done, progress)?;
            rows.push(Row {
                value,
                outcome: outcome.clone(),
            });
            Ok::<_, SmallestError>(outcome)
        })?;
        rows.sort_by(|a, b| a.value.total_cmp(&b.value));
        Ok(rows)
    }

    /// Of a level of which nothing is known but whether it covers.
    fn synthetic(&self, covers: bool) -> Outcome {
        let count = self.states();
        let status = match covers {
            true => PointStatus::Converged,
            false => PointStatus::NoGuess,
        };
        Outcome {
            status: vec![status; count],
            v: vec![f64::NAN; count],
            folds: Vec::new(),
            failure: None,
        }
    }

    /// Some rows, by rising value, without what follows from all of them.
    pub fn part(&self, rows: Vec<Row>) -> Attenuated {
        let levels = rows.iter().map(|row| row.value).collect();
        let search = Search {
            covering: Covering::Never {
                top: f64::NAN,
                coverage: f64::NAN,
            },
            monotone: false,
            rows,
        };
        self.attenuated(search, levels)
    }
}

/// Whether a level covers, as far as others tell.
fn foretold(rows: &[Row], value: f64) -> Option<bool> {
    if rows.iter().any(|row| !row.covers() && row.value >= value) {
        return Some(false);
    }
    let is_easier = |row: &Row| row.covers() && row.value <= value;
    rows.iter().any(is_easier).then_some(true)
}

/// The states solved for at one level.
fn outcome(
    scene: &Scene,
    parameter: &str,
    value: f64,
    states: &[f64],
    backend: &dyn Backend,
    choices: Choices,
    progress: value::Progress<'_>,
) -> Result<Outcome, SmallestError> {
    let wrong = |errors| SmallestError::Scene {
        parameter: parameter.to_owned(),
        value,
        errors: Box::new(errors),
    };
    let other = scene.with(&[(parameter, value)]).map_err(wrong)?;
    let count = states.len() / other.model.states.len();
    match value::solve_states_folding(
        &other.model,
        &other.hamiltonian,
        backend,
        choices,
        states,
        progress,
    ) {
        Ok((_, _, answers, folds)) => {
            let targets = &answers.targets.of_given;
            let status: Vec<PointStatus> = targets.iter().map(|t| answers.status(*t)).collect();
            let v = |(t, s): (&usize, &PointStatus)| match s {
                PointStatus::Converged => answers.answer(*t).map_or(f64::NAN, |e| e.value),
                _ => f64::NAN,
            };
            let v = targets.iter().zip(&status).map(v).collect();
            Ok(Outcome {
                status,
                v,
                folds: folds.into_iter().map(|f| f.x).collect(),
                failure: None,
            })
        }
        Err(StatesError::Plan(e)) => Ok(Outcome {
            status: vec![PointStatus::NoGuess; count],
            v: vec![f64::NAN; count],
            folds: Vec::new(),
            failure: Some(e.to_string()),
        }),
        Err(StatesError::Backend(e)) => Err(e.into()),
    }
}
