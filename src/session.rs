//! The front door: a scene, where to compute, and what to ask of it.

use crate::backend::cpu::Cpu;
use crate::backend::{Backend, BackendError};
use crate::map::{self, Adaptive, Known, MapError, ValueMap};
use crate::scene::Scene;
use crate::sweep::{Choices, Plan, PlanError};
use crate::value::{self, Answers, Archive, Entry, PointStatus, StatesError};

/// Why a session has no answer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SessionError {
    #[error("{given} numbers are no list of states with {states} components each")]
    Components { given: usize, states: usize },
    #[error("the scene asks for no map: give it [map] with error = ...")]
    NoMap,
    #[error(transparent)]
    Plan(#[from] PlanError),
    #[error(transparent)]
    Backend(#[from] BackendError),
    #[error(transparent)]
    Map(#[from] MapError),
}

impl From<StatesError> for SessionError {
    fn from(error: StatesError) -> Self {
        match error {
            StatesError::Plan(error) => error.into(),
            StatesError::Backend(error) => error.into(),
        }
    }
}

/// A scene and a backend. Everything asked of it is computed when it is asked.
///
/// ```
/// use costate::{Scene, Session};
/// let scene = Scene::parse(
///     r#"
///     states = { x = {}, v = {} }
///     controls = { u = {} }
///     dynamics = { x = "v", v = "u" }
///     cost = { running = "0.5*(x^2 + u^2)" }
///     equilibrium = { x = 0, v = 0, u = 0 }
///     region = { x = [-1, 1], v = [-1, 1] }
///     "#,
///     "scene.toml",
/// )?;
/// let solved = Session::new(&scene).solve(&[0.5, 0.2])?;
/// let answer = solved.answer(0).expect("a linear problem has an answer everywhere");
/// // V = x'Px/2 with P = [[sqrt(2), 1], [1, sqrt(2)]].
/// let exact = 0.5 * (2f64.sqrt() * (0.25 + 0.04) + 2.0 * 0.5 * 0.2);
/// assert!((answer.value - exact).abs() < 1e-8);
/// assert!((answer.u[0] + 0.5 + 0.2 * 2f64.sqrt()).abs() < 1e-8);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Session<'s> {
    scene: &'s Scene,
    backend: Box<dyn Backend>,
    /// What is chosen in place of the scene's settings.
    pub choices: Choices,
}

/// States that were solved for.
pub struct Solved {
    pub plan: Plan,
    /// All solutions, and what is known of them.
    pub answers: Answers,
}

impl Solved {
    /// The solution of least V from a state (by its number in the list); `None` where there is
    /// none: see [`Solved::status`].
    pub fn answer(&self, state: usize) -> Option<&Entry> {
        self.answers.answer(self.answers.targets.of_given[state])
    }

    /// What came of a state.
    pub fn status(&self, state: usize) -> PointStatus {
        self.answers.status(self.answers.targets.of_given[state])
    }
}

/// A map of V that was made, and how that went.
pub struct Mapped {
    pub made: Adaptive,
    /// V, p and u at any state.
    pub map: ValueMap,
}

impl<'s> Session<'s> {
    /// On all cores of the CPU.
    pub fn new(scene: &'s Scene) -> Self {
        Self::on(scene, Box::new(Cpu::new()))
    }

    /// On a backend: [`Cpu`], a GPU, or your own.
    pub fn on(scene: &'s Scene, backend: Box<dyn Backend>) -> Self {
        Self {
            scene,
            backend,
            choices: Choices::default(),
        }
    }

    /// V, p and u at states (`[state][component]`, absolute, in the scene's units), as `costate
    /// solve` finds them.
    ///
    /// # Errors
    /// [`SessionError::Components`]; where the scene cannot be swept for first guesses; device
    /// failures. A state without an answer is no error.
    pub fn solve(&self, states: &[f64]) -> Result<Solved, SessionError> {
        let n = self.scene.model.states.len();
        if !states.len().is_multiple_of(n) {
            let given = states.len();
            return Err(SessionError::Components { given, states: n });
        }
        let Scene {
            model, hamiltonian, ..
        } = self.scene;
        let backend = self.backend.as_ref();
        let (plan, _, answers) = value::solve_states(
            model,
            hamiltonian,
            backend,
            self.choices,
            states,
            &mut |_, _, _| {},
        )?;
        Ok(Solved { plan, answers })
    }

    /// The map that the scene's `[map] error` asks for, as `costate homotopy` makes it.
    ///
    /// ```
    /// # use costate::{Scene, Session};
    /// # let scene = Scene::parse(r#"
    /// #     states = { x = {} }
    /// #     controls = { u = {} }
    /// #     dynamics = { x = "u" }
    /// #     cost = { running = "0.5*(x^2 + u^2)" }
    /// #     equilibrium = { x = 0, u = 0 }
    /// #     region = { x = [-1, 1] }
    /// #     map = { error = 1e-3 }
    /// # "#, "scene.toml")?;
    /// let mapped = Session::new(&scene).map()?;
    /// let here = mapped.map.at(&[0.5]).lowest?;
    /// assert!((here.v - 0.125).abs() <= here.v_error && here.v_error < 1e-3);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`SessionError::NoMap`]; where the scene cannot be swept for first guesses, or nothing is
    /// known anywhere; device failures.
    pub fn map(&self) -> Result<Mapped, SessionError> {
        let Scene {
            model, hamiltonian, ..
        } = self.scene;
        let aim = model.map_aim.as_ref().ok_or(SessionError::NoMap)?;
        let backend = self.backend.as_ref();
        let choices = value::for_guesses(self.choices, model.states.len(), 0);
        let plan = Plan::new(model, hamiltonian, backend, choices)?;
        let mut archive = Archive::new(&plan);
        if !value::goes_without_sweep(&plan) {
            archive.sweep(&plan, backend)?;
        }
        let mut solver = value::solver(&plan, backend)?;
        let made = map::adaptive(&plan, model, &mut solver, &archive, aim, &mut |_, _, _| {})?;
        let known = Known {
            pieces: Some(made.pieces.clone()),
            beyond: made.beyond.as_ref().map(|beyond| beyond.pieces.clone()),
            coverage: Some(made.coverage()),
            searched: true,
            ..Known::default()
        };
        let map = ValueMap::new(model, hamiltonian, known)?;
        Ok(Mapped { made, map })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_asked_is_an_error() {
        let text = r#"
            states = { x = {}, v = {} }
            controls = { u = {} }
            dynamics = { x = "v", v = "u" }
            cost = { running = "0.5*(x^2 + u^2)" }
            equilibrium = { x = 0, v = 0, u = 0 }
            region = { x = [-1, 1], v = [-1, 1] }
        "#;
        let scene = Scene::parse(text, "scene.toml").unwrap();
        let session = Session::new(&scene);
        assert!(matches!(
            session.solve(&[0.1, 0.2, 0.3]),
            Err(SessionError::Components {
                given: 3,
                states: 2
            })
        ));
        assert!(matches!(session.map(), Err(SessionError::NoMap)));
        // No states are no error.
        assert!(session.solve(&[]).is_ok());
    }
}
