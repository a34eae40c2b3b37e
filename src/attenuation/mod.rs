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
    let model = &scene.model;
    let asked = model
        .attenuation
        .as_ref()
        .expect("the scene has an [attenuation]");
    let parameter = asked.parameter.clone();
    progress(&format!("{parameter}* of the linearization"));
    let linear = linear(scene, asked)?;
    let own = model.parameter(&parameter).unwrap_or(f64::NAN);
    let star = linear.star;
    let bounded = linear.cause == Cause::None;
    if let Some(value) =
        (asked.levels.iter().copied()).find(|l| if bounded { *l < star } else { *l <= star })
    {
        return Err(SmallestError::LevelBelow {
            parameter,
            value,
            star,
        });
    }
    let grid = Grid::homotopy(&Homotopy {
        axes: asked.axes.clone(),
        span: asked.span.clone(),
    });
    let states = grid.points();
    let mut done = 0;
    let mut evaluate = |value: f64| {
        let head = format!("{parameter} = {value:.6} ({} before it)", done);
        done += 1;
        progress(&head);
        let mut told = |what: &str, of: usize, all: usize| {
            progress(&format!("{head}: {of} of {all} states, {what}"))
        };
        let found = outcome(
            scene, &parameter, value, &states, backend, choices, &mut told,
        )?;
        // What is cut short shows nothing of a level.
        choices.deadline.check()?;
        Ok::<_, SmallestError>(found)
    };
    let sought = Sought {
        star,
        allowed: bounded,
        own,
        top: asked.range.map(|r| r[1]),
        tolerance: asked.tolerance,
    };
    let (search, levels) = search(&sought, &asked.levels, &mut evaluate)?;
    Ok(Attenuated {
        parameter,
        own,
        linear,
        grid,
        search,
        levels,
    })
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
