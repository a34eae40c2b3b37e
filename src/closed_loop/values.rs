//! V at the initial states, by solving for it.

use crate::backend::Backend;
use crate::hamiltonian::Hamiltonian;
use crate::model::Model;
use crate::sweep::Choices;
use crate::value::{self, Progress};

use super::LoopError;

/// V at states (`[state][n]`), each solved for as `costate solve` does; NaN where no solution is
/// found.
///
/// # Errors
/// Where the scene cannot be swept for first guesses; device failures.
pub fn solved_values(
    model: &Model,
    hamiltonian: &Hamiltonian,
    backend: &dyn Backend,
    choices: Choices,
    states: &[f64],
    progress: Progress<'_>,
) -> Result<Vec<f64>, LoopError> {
    let (_, _, found) =
        value::solve_states(model, hamiltonian, backend, choices, states, progress)?;
    Ok((0..states.len() / model.states.len())
        .map(|k| {
            found
                .answer(found.targets.of_given[k])
                .map_or(f64::NAN, |e| e.value)
        })
        .collect())
}
