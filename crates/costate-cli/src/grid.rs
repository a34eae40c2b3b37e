//! V on a grid for commands: what it is refused for, and as a source of guesses.

use super::CliError;
use costate::backend::Backend;
use costate::dynamic_programming::{Device, extent};
use costate::dynamic_programming::{DpError, GridValue, MOST_STATES, Options, solve};
use costate::model::Model;
use costate::scene::Scene;
use costate::sweep::Plan;
use std::path::PathBuf;

/// Most nodes in all: about a hundred bytes each.
const MOST_NODES: usize = 20_000_000;

/// Why there is no V on a grid for a command.
#[derive(Debug, thiserror::Error)]
pub(super) enum GridRefusal {
    #[error(
        "{place}: the scene has disturbances, and V on a grid is for problems without (of a game no order of V says which sheet counts)"
    )]
    Game { place: String },
    #[error("{place}: the scene has {states} states, and V on a grid is for at most {MOST_STATES}")]
    TooManyStates { place: String, states: usize },
    #[error(
        "{path} has no solved states in /points or /map: make it with `costate solve SCENE --points FILE.csv`, or ask for [homotopy] or [map] in the scene",
        path = path.display()
    )]
    NoStates { path: PathBuf },
    #[error(
        "--nodes: {given} numbers for {states} states: give one for all axes, or one for each of {names}"
    )]
    Counts {
        given: usize,
        states: usize,
        names: String,
    },
    #[error("--nodes: {nodes} nodes in all; at most {MOST_NODES}")]
    TooManyNodes { nodes: usize },
    #[error(
        "--grid-guesses: this solves for no states of [homotopy], [map] or a file: leave the option out"
    )]
    Nothing,
    #[error("--seconds: {0}: give more of them, or fewer --nodes")]
    OutOfTime(DpError),
}

impl From<DpError> for CliError {
    fn from(error: DpError) -> Self {
        match error {
            DpError::Backend(error) => error.into(),
            DpError::OutOfTime => GridRefusal::OutOfTime(error).into(),
            other => CliError::Grid(other),
        }
    }
}

/// Refuses scenes that have no V on a grid; `place` is what is at fault.
pub(super) fn refuse(model: &Model, place: &str) -> Result<(), CliError> {
    let place = place.to_owned();
    let states = model.states.len();
    if model.is_game() {
        return Err(GridRefusal::Game { place }.into());
    }
    if states > MOST_STATES {
        return Err(GridRefusal::TooManyStates { place, states }.into());
    }
    Ok(())
}

/// Nodes of each axis; empty where none are given.
pub(super) fn counts(given: &[usize], model: &Model) -> Result<Vec<usize>, CliError> {
    let states = model.states.len();
    let counts = match given {
        [] => return Ok(Vec::new()),
        [one] => vec![*one; states],
        some if some.len() == states => some.to_vec(),
        some => {
            let names: Vec<&str> = model
                .states
                .iter()
                .map(|s| s.variable.name.as_str())
                .collect();
            return Err(GridRefusal::Counts {
                given: some.len(),
                states,
                names: names.join(", "),
            }
            .into());
        }
    };
    let nodes = counts
        .iter()
        .fold(1usize, |all, count| all.saturating_mul(*count));
    if nodes > MOST_NODES {
        return Err(GridRefusal::TooManyNodes { nodes }.into());
    }
    Ok(counts)
}

/// V on a grid over the region and some states (`[state][n]`, absolute), for guesses.
pub(super) fn for_guesses(
    scene: &Scene,
    plan: &Plan,
    backend: &dyn Backend,
    states: &[f64],
) -> Result<GridValue, CliError> {
    let options = Options {
        holds: extent(plan, states),
        ..Options::default()
    };
    Ok(solve(
        &scene.model,
        &scene.hamiltonian,
        plan,
        &options,
        Device::of(backend),
    )?)
}
