//! Single states solved for from a scene alone: a sweep for first guesses where they need one, then
//! the solutions.

use super::{
    Answers, Archive, Progress, Request, blocks::Blocks, blocks::NoKeeper, for_guesses,
    goes_without_sweep, solver,
};
use crate::backend::{Backend, BackendError};
use crate::hamiltonian::Hamiltonian;
use crate::model::Model;
use crate::shooting::Solver;
use crate::sweep::{Choices, FoldPoint, Plan, PlanError};

/// Why states could not be solved for.
#[derive(Debug, thiserror::Error)]
pub enum StatesError {
    #[error(transparent)]
    Plan(#[from] PlanError),
    #[error(transparent)]
    Backend(#[from] BackendError),
}

/// All solutions at states (`[state][n]`), as `costate solve` finds them, with the plan and the
/// solver they were found with.
///
/// # Errors
/// Where the scene cannot be swept for first guesses; device failures.
pub fn solve_states(
    model: &Model,
    hamiltonian: &Hamiltonian,
    backend: &dyn Backend,
    choices: Choices,
    states: &[f64],
    progress: Progress<'_>,
) -> Result<(Plan, Solver, Answers), StatesError> {
    let (plan, solver, found, _) =
        solve_states_folding(model, hamiltonian, backend, choices, states, progress)?;
    Ok((plan, solver, found))
}

/// As [`solve_states`], and where the sweep for first guesses met folds.
///
/// # Errors
/// Those of [`solve_states`].
pub fn solve_states_folding(
    model: &Model,
    hamiltonian: &Hamiltonian,
    backend: &dyn Backend,
    choices: Choices,
    states: &[f64],
    progress: Progress<'_>,
) -> Result<(Plan, Solver, Answers, Vec<FoldPoint>), StatesError> {
    let scene = (model, hamiltonian);
    solve_blocks(scene, backend, choices, states, None, progress)
}

/// Into how many blocks states are cut (see [`Blocks`]).
///
/// # Errors
/// Where the scene cannot be swept for first guesses.
pub fn count_blocks(
    model: &Model,
    hamiltonian: &Hamiltonian,
    backend: &dyn Backend,
    choices: Choices,
    states: &[f64],
) -> Result<usize, StatesError> {
    let n = model.states.len();
    let choices = for_guesses(choices, n, states.len() / n);
    let plan = Plan::new(model, hamiltonian, backend, choices)?;
    let request = Request {
        points: states.to_vec(),
        ..Request::default()
    };
    Ok(Blocks::new(&plan, backend, &request).blocks.len())
}

/// As [`solve_states_folding`], for the states of some blocks alone; `None`: of all.
///
/// # Errors
/// Those of [`solve_states`].
pub fn solve_blocks(
    (model, hamiltonian): (&Model, &Hamiltonian),
    backend: &dyn Backend,
    choices: Choices,
    states: &[f64],
    own: Option<&[usize]>,
    progress: Progress<'_>,
) -> Result<(Plan, Solver, Answers, Vec<FoldPoint>), StatesError> {
    let n = model.states.len();
    let choices = for_guesses(choices, n, states.len() / n);
    let plan = Plan::new(model, hamiltonian, backend, choices)?;
    let mut archive = Archive::new(&plan);
    let direct = goes_without_sweep(&plan);
    let mut folds = Vec::new();
    if !direct {
        folds = archive.sweep(&plan, backend)?.folds;
    }
    let mut solver = solver(&plan, backend)?;
    let request = Request {
        points: states.to_vec(),
        // In a game only the equilibrium's own sheet counts.
        one_sheet: plan.game && plan.local.is_some(),
        partial: choices.partial,
        ..Request::default()
    };
    let blocks = Blocks::new(&plan, backend, &request);
    let own = match own {
        Some(own) => own.to_vec(),
        None => (0..blocks.blocks.len()).collect(),
    };
    let mut sweep = |archive: &mut Archive| -> Result<(), StatesError> {
        folds = archive.sweep(&plan, backend)?.folds;
        Ok(())
    };
    let found = blocks.solve(
        (&plan, model),
        &mut solver,
        backend,
        (&archive, direct.then_some(&mut sweep as _)),
        (&own, &mut NoKeeper),
        progress,
    )?;
    drop(blocks);
    let found = found.answers;
    Ok((plan, solver, found, folds))
}
