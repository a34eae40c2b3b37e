//! V at the initial states, by solving for it.

use crate::backend::{Backend, BackendError};
use crate::hamiltonian::Hamiltonian;
use crate::model::Model;
use crate::sweep::{Choices, Plan, sweep_keeping};
use crate::value::{self, Archive, Request};

use super::LoopError;

/// V at states (`[state][n]`), each solved for as `costate solve` does; NaN where no solution is found.
///
/// # Errors
/// Where the scene cannot be swept for first guesses; device failures.
pub fn solved_values(
    model: &Model,
    hamiltonian: &Hamiltonian,
    backend: &dyn Backend,
    choices: Choices,
    states: &[f64],
    progress: &mut dyn FnMut(&str, usize, usize),
) -> Result<Vec<f64>, LoopError> {
    let n = model.states.len();
    let choices = Choices {
        inner_levels: true,
        unasked: true,
        max_seeds: Some(value::guess_seeds(n, states.len() / n)),
        ..choices
    };
    let plan = Plan::new(model, hamiltonian, backend, choices)?;
    let mut archive = Archive::new(&plan);
    sweep_keeping::<BackendError>(
        &plan,
        backend,
        &mut |_, _| {},
        &mut |seeds, batch| archive.keep(seeds, batch),
        &mut |_| Ok(()),
    )?;
    let mut solver = value::solver(&plan, backend)?;
    let request = Request {
        points: states.to_vec(),
        ..Request::default()
    };
    let found = value::solve(&plan, model, &mut solver, &archive, &request, &mut |what, done, of| {
        progress(what, done, of);
    })?;
    Ok((0..states.len() / n)
        .map(|k| found.lowest(found.targets.of_given[k]).map_or(f64::NAN, |e| e.value))
        .collect())
}
