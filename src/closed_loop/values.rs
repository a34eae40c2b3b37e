//! V at the initial states, by solving for it.

use crate::backend::Backend;
use crate::hamiltonian::Hamiltonian;
use crate::model::Model;
use crate::sweep::Choices;
use crate::value::{self, Answers, Progress};

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
    Ok(least(&found))
}

/// The same of the states of some blocks (see [`value::count_blocks`]; `None`: of all): their numbers,
/// and V.
///
/// # Errors
/// As [`solved_values`].
pub fn values_of_blocks(
    (model, hamiltonian): (&Model, &Hamiltonian),
    backend: &dyn Backend,
    choices: Choices,
    states: &[f64],
    blocks: Option<&[usize]>,
    progress: Progress<'_>,
) -> Result<(Vec<usize>, Vec<f64>), LoopError> {
    let (_, _, found, _) = value::solve_blocks(
        (model, hamiltonian),
        backend,
        choices,
        states,
        blocks,
        progress,
    )?;
    let values = least(&found);
    Ok((found.targets.rows, values))
}

/// The least V of each state given.
fn least(found: &Answers) -> Vec<f64> {
    let value = |target: &usize| found.answer(*target).map_or(f64::NAN, |e| e.value);
    found.targets.of_given.iter().map(value).collect()
}
