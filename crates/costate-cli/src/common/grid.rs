//! V on a grid for commands: what it is refused for.

use crate::error::{CliError, GridRefusal, MOST_NODES};
use costate::low_level::model::Model;

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
