//! V on a grid for commands: what it is refused for.

use crate::error::CliError;
use costate::low_level::dynamic_programming::DpError;
use costate::low_level::model::Model;
use std::path::PathBuf;

/// Most nodes in all: about a hundred bytes each.
const MOST_NODES: usize = 20_000_000;

/// Why there is no V on a grid for a command.
#[derive(Debug, thiserror::Error)]
pub enum GridRefusal {
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

/// Nodes of each axis; empty where none are given.
pub fn counts(given: &[usize], model: &Model) -> Result<Vec<usize>, CliError> {
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
