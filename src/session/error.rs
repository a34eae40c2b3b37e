//! Why a session has no answer.

use crate::attenuation::SmallestError;
use crate::backend::BackendError;
use crate::closed_loop::{LawError, LoopError};
use crate::diagnostics::ScenarioErrors;
use crate::dynamic_programming::{DpError, Refusal};
use crate::feedback::FitError;
use crate::map::MapError;
use crate::model::TooManyTurns;
use crate::study::StudyError;
use crate::sweep::PlanError;
use crate::value::StatesError;

/// Why a session has no answer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "its message says what each is")]
pub enum SessionError {
    #[error("{given} numbers are no list of states with {states} components each")]
    Components { given: usize, states: usize },
    #[error("component {component} of state {state} is no finite number")]
    NotFinite { state: usize, component: usize },
    #[error("the scene asks for no map: give it [map] with error = ...")]
    NoMap,
    #[error(
        "the scene has neither [homotopy] nor [map]: no states to solve for (or use `costate solve --points FILE.csv`)"
    )]
    NoTargets,
    #[error(
        "nothing was swept: all {outside} seeds lie outside the guards (is the equilibrium too near their boundary for this seed_value?)"
    )]
    NothingSwept { outside: usize },
    #[error(
        "a map to an error is not divided into shards, as each of its rounds needs all before it, but a grid is: leave --shard out, or [map] error (pycostate.distributed.map has each round's states solved for by a cluster)"
    )]
    NotDivided,
    #[error(
        "only states that are solved for are divided into shards and gone on with, not a sweep, a study or laws in one run with them"
    )]
    StatesAlone,
    #[error("[dissipation] is not divided into shards, but [closed_loop] is: leave --shard out")]
    DissipationNotDivided,
    #[error("the scene has no [study]")]
    NoStudy,
    #[error("how long to simulate? Give [simulation] time = ..., or --time")]
    NoTime,
    #[error("the scene has no [attenuation]")]
    NoAttenuation,
    #[error("the scene has no [feedback]: no law to fit")]
    NoFeedback,
    #[error(
        "the scene has neither [closed_loop] nor [dissipation]: nothing to simulate (--scene takes it from another scene)"
    )]
    NoClosedLoop,
    #[error("no law to simulate: none of those that the scene asks for is there")]
    NoLaws,
    #[error("a law named `{name}` is there already: give the other one another name")]
    SameLaw { name: String },
    #[error(
        "grid_guesses: this solves for no states of [homotopy], [map] or a list: leave the option out"
    )]
    NoGridGuesses,
    #[error("state {state} (from 0): {source}")]
    Turns { state: usize, source: TooManyTurns },
    /// What is wrong with the scene, with its place.
    #[error(transparent)]
    Scenario(#[from] ScenarioErrors),
    #[error(transparent)]
    Plan(#[from] PlanError),
    #[error(transparent)]
    Refused(#[from] Refusal),
    #[error(transparent)]
    Grid(DpError),
    #[error(transparent)]
    Study(#[from] StudyError),
    #[error(transparent)]
    Attenuation(#[from] SmallestError),
    #[error(transparent)]
    Fit(#[from] FitError),
    #[error(transparent)]
    Law(LawError),
    #[error(transparent)]
    Loop(LoopError),
    #[error(transparent)]
    Map(#[from] MapError),
    #[error(transparent)]
    Backend(#[from] BackendError),
}

impl SessionError {
    /// Whether the scene, or what is asked of it, is at fault: the computation cannot succeed as it
    /// is asked for. Else it could not be carried out.
    #[must_use]
    pub fn is_of_input(&self) -> bool {
        match self {
            Self::NothingSwept { .. } => false,
            Self::Backend(error) => error.is_of_input(),
            Self::Study(error) => {
                matches!(error, StudyError::Scene { .. } | StudyError::Plan { .. })
            }
            Self::Attenuation(error) => !matches!(error, SmallestError::Backend(_)),
            Self::Loop(error) => matches!(
                error,
                LoopError::NoRange | LoopError::NoCount { .. } | LoopError::NoChart { .. }
            ),
            Self::Grid(DpError::OutOfTime) => false,
            _ => true,
        }
    }
}

impl From<(usize, TooManyTurns)> for SessionError {
    fn from((state, source): (usize, TooManyTurns)) -> Self {
        Self::Turns { state, source }
    }
}

impl From<StatesError> for SessionError {
    fn from(error: StatesError) -> Self {
        match error {
            StatesError::Plan(error) => error.into(),
            StatesError::Backend(error) => error.into(),
        }
    }
}

impl From<LawError> for SessionError {
    fn from(error: LawError) -> Self {
        match error {
            LawError::Scenario(errors) => Self::Scenario(errors),
            other => Self::Law(other),
        }
    }
}

impl From<LoopError> for SessionError {
    fn from(error: LoopError) -> Self {
        match error {
            LoopError::Law(error) => error.into(),
            LoopError::Plan(error) => error.into(),
            LoopError::Backend(error) => error.into(),
            other => Self::Loop(other),
        }
    }
}

impl From<DpError> for SessionError {
    fn from(error: DpError) -> Self {
        match error {
            DpError::Backend(error) => error.into(),
            other => Self::Grid(other),
        }
    }
}
