//! The front door: a scene, where to compute, and what to ask of it.

mod equations;
mod error;
mod estimates;
mod figure;
mod laws;
mod least;
mod loops;
mod mechanism;
mod pass;
mod progress;
mod shard;
mod simulation;
pub mod summary;
mod wanted;

pub use equations::Equations;
pub use error::SessionError;
pub use estimates::Estimates;
pub use figure::StickFigure;
pub use laws::{FitData, fit_laws};
pub use least::LeastOptions;
pub use loops::{LoopOptions, Loops, Sources, same_problem};
pub use mechanism::{
    ContactState, Identity, MechanismAt, MechanismState, MechanismSummary, PointState,
};
pub(crate) use pass::StatesAsked;
pub use pass::{Checkpoint, Outcome, Part, Pass, SoFar, sweep_and_write};
pub use progress::{Finished, Progress, Silent};
pub use shard::{Shard, ShardError};
pub use simulation::{ControlledBy, Cycles, Simulated, SimulationOptions, end_name, some_states};
pub use wanted::{GivenSweep, Kept, Listed, Resume, States, Wanted};

use crate::attenuation::{self, Attenuated, Levels, Row};
use crate::backend::cpu::Cpu;
use crate::backend::cpu::in_pool;
use crate::backend::{Backend, BackendError, Deadline};
use crate::diagnostics::{Problem, ScenarioErrors};
use crate::local::LocalError;
use crate::map::{Adaptive, Known, ValueMap, Worker, Workers};
use crate::model::{Horizon, Model};
use crate::scene::Scene;
use crate::study::{self, Variant};
use crate::sweep::{Choices, Plan, PlanError, SweepReport};
use crate::trajectories::{SweptTrajectories, TrajectoryBlock};
use crate::value::{self, Answers, Entry, PointStatus};
use progress::Step;

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
    progress: &'s dyn Progress,
    workers: Option<&'s dyn Workers>,
}

/// Trajectories that were swept outward from the equilibrium (or from the terminal cost).
pub struct Swept {
    /// What was integrated, and how.
    pub plan: Plan,
    /// How it went: statuses, coverage, |H|.
    pub report: SweepReport,
    /// All of them.
    pub trajectories: SweptTrajectories,
}

/// States that were solved for.
pub struct Solved {
    /// What was integrated, and how.
    pub plan: Plan,
    /// All solutions, and what is known of them.
    pub answers: Answers,
}

impl Solved {
    /// Whether the session's deadline ended the search: then nothing shows that an answer is the
    /// least.
    pub fn is_stopped(&self) -> bool {
        self.answers.stopped
    }

    /// The solution of least V from a state (by its number in the list); `None` where there is
    /// none: see [`Solved::status`].
    ///
    /// # Panics
    /// Where the list has no such state.
    pub fn answer(&self, state: usize) -> Option<&Entry> {
        self.answers.answer(self.answers.targets.of_given[state])
    }

    /// What came of a state.
    ///
    /// # Panics
    /// Where the list has no such state.
    pub fn status(&self, state: usize) -> PointStatus {
        self.answers.status(self.answers.targets.of_given[state])
    }
}

/// A map of V that was made, and how that went.
pub struct Mapped {
    /// How it went: pieces, the check with fresh states, what is not known.
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
            progress: &Silent,
            workers: None,
        }
    }

    /// With choices in place of the scene's settings.
    #[must_use]
    pub fn choosing(mut self, choices: Choices) -> Self {
        self.choices = choices;
        self
    }

    /// Ends at a deadline, with what is there by then: a sweep has gaps (`SweepReport::stopped`),
    /// and states that are not solved have the status [`PointStatus::OutOfTime`] (see
    /// [`Solved::is_stopped`], [`Outcome::stopped`]). A map that has no pieces yet is an error, and
    /// so are fits, closed loops and levels of attenuation that are not done. A deadline is an
    /// instant: it stays passed for later questions.
    ///
    /// ```
    /// # use costate::{Scene, Session};
    /// use costate::backend::Deadline;
    /// use std::time::Duration;
    /// # let scene = Scene::parse(r#"
    /// #     states = { x = {} }
    /// #     controls = { u = {} }
    /// #     dynamics = { x = "u" }
    /// #     cost = { running = "0.5*(x^2 + u^2)" }
    /// #     equilibrium = { x = 0, u = 0 }
    /// #     region = { x = [-1, 1] }
    /// # "#, "scene.toml")?;
    /// let session = Session::new(&scene).until(Deadline::after(Duration::from_secs(60)));
    /// let solved = session.solve(&[0.5])?;
    /// assert!(!solved.is_stopped() && !session.is_over());
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    #[must_use]
    pub fn until(mut self, deadline: Deadline) -> Self {
        self.choices.deadline = deadline;
        self
    }

    /// That deadline.
    pub fn deadline(&self) -> Deadline {
        self.choices.deadline
    }

    /// Whether it has passed.
    pub fn is_over(&self) -> bool {
        self.choices.deadline.has_passed()
    }

    /// With a listener to what goes on.
    #[must_use]
    pub fn with_progress(mut self, progress: &'s dyn Progress) -> Self {
        self.progress = progress;
        self
    }

    /// With others that solve for the states of a map to an error. It is the same map, to the last
    /// bit, where they compute on machines of the same kind.
    #[must_use]
    pub fn with_workers(mut self, workers: &'s dyn Workers) -> Self {
        self.workers = Some(workers);
        self
    }

    /// One of those others, for the map of another process's session of the same scene and choices.
    ///
    /// # Errors
    /// What is wrong with the scene; [`SessionError::NoMap`]; device failures.
    pub fn worker(&self) -> Result<Worker, SessionError> {
        let plan = self.prepare(&Wanted::map())?.into_plan();
        Ok(Worker::new(plan, self.backend.as_ref())?)
    }

    /// The scene.
    pub fn scene(&self) -> &'s Scene {
        self.scene
    }

    /// Where it computes.
    pub fn backend(&self) -> &dyn Backend {
        self.backend.as_ref()
    }

    /// Who listens.
    pub fn progress(&self) -> &'s dyn Progress {
        self.progress
    }

    /// Sweeps outward from the equilibrium (or from the terminal cost), as `costate shoot-out`
    /// does, and keeps the trajectories.
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
    /// #     shoot_out = { value_max = 0.5, spacing = 0.1 }
    /// # "#, "scene.toml")?;
    /// let swept = Session::new(&scene).sweep()?;
    /// let all = &swept.trajectories;
    /// // V = x^2/2 at every point that a trajectory has.
    /// let known = all.v.iter().zip(&all.x).filter(|(v, _)| !v.is_nan());
    /// assert!(known.clone().count() > 10);
    /// assert!(known.into_iter().all(|(v, x)| (v - 0.5 * x * x).abs() < 1e-6));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// Where the scene cannot be swept; device failures.
    pub fn sweep(&self) -> Result<Swept, SessionError> {
        let pass = self.prepare(&Wanted::sweep())?;
        let mut all = SweptTrajectories {
            samples: pass.plan().samples(),
            ..SweptTrajectories::default()
        };
        let outcome = pass.perform::<SessionError>(&mut |block| {
            keep(&mut all, block);
            Ok(())
        })?;
        Ok(Swept {
            plan: outcome.plan,
            report: outcome.swept,
            trajectories: all,
        })
    }

    /// V, p and u at states (`[state][component]`, absolute, in the scene's units), as `costate
    /// solve` finds them.
    ///
    /// # Errors
    /// [`SessionError::Components`], [`SessionError::NotFinite`] and [`SessionError::Turns`]; where
    /// the scene cannot be swept for first guesses; device failures. A state without an answer is
    /// no error, nor is one that the session's deadline has left out (see [`Solved::is_stopped`]).
    pub fn solve(&self, states: &[f64]) -> Result<Solved, SessionError> {
        self.check_states(states)?;
        attenuation::refuse(self.scene)?;
        let Scene {
            model, hamiltonian, ..
        } = self.scene;
        let backend = self.backend.as_ref();
        let step = self.step();
        let mut shown = step.states();
        let choices = Choices {
            partial: true,
            ..self.choices
        };
        let (plan, _, answers) =
            value::solve_states(model, hamiltonian, backend, choices, states, &mut shown)?;
        Ok(Solved { plan, answers })
    }

    /// Refuses what is no list of states.
    fn check_states(&self, states: &[f64]) -> Result<(), SessionError> {
        let n = self.scene.model.states.len();
        if !states.len().is_multiple_of(n) {
            let given = states.len();
            return Err(SessionError::Components { given, states: n });
        }
        if let Some(k) = states.iter().position(|x| !x.is_finite()) {
            let (state, component) = (k / n, k % n);
            return Err(SessionError::NotFinite { state, component });
        }
        Ok(self.scene.model.check_turns(states)?)
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
        if model.map_aim.is_none() {
            return Err(SessionError::NoMap);
        }
        let wanted = Wanted {
            map: true,
            ..Wanted::default()
        };
        let outcome = self
            .prepare(&wanted)?
            .perform::<SessionError>(&mut |_| Ok(()))?;
        // There is none where the deadline has come before its first pieces.
        let out_of_time = || SessionError::Backend(BackendError::OutOfTime);
        let made = outcome.mapped.ok_or_else(out_of_time)?;
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

    /// The scene's `[study]`: the optimal trajectory from one state for several values of
    /// parameters, as `costate study` makes it.
    ///
    /// # Errors
    /// [`SessionError::NoStudy`]; what is wrong with a variant; device failures.
    pub fn study(&self) -> Result<Vec<Variant>, SessionError> {
        self.study_with(self.choices)
    }

    fn study_with(&self, choices: Choices) -> Result<Vec<Variant>, SessionError> {
        let all = self.scene.model.study.as_ref().map(study::combinations);
        let own: Vec<usize> = (0..all.map_or(0, |all| all.len())).collect();
        self.variants(choices, &own, &mut |_| {})
    }

    /// Some variants of the scene's `[study]`, by their numbers; `told` has those that are done.
    ///
    /// # Errors
    /// Those of [`study`](Self::study).
    pub(crate) fn some_variants(
        &self,
        own: &[usize],
        told: &mut (dyn FnMut(&[Variant]) + Send),
    ) -> Result<Vec<Variant>, SessionError> {
        self.variants(self.choices, own, told)
    }

    fn variants(
        &self,
        choices: Choices,
        own: &[usize],
        told: &mut (dyn FnMut(&[Variant]) + Send),
    ) -> Result<Vec<Variant>, SessionError> {
        if self.scene.model.study.is_none() {
            return Err(SessionError::NoStudy);
        }
        let step = self.step();
        let mut shown = |done: &[Variant]| {
            step.say(&format!("study: {} of {} variants", done.len(), own.len()));
            told(done);
        };
        let backend = self.backend.as_ref();
        Ok(in_pool(|| {
            study::study(self.scene, backend, choices, own, &mut shown)
        })?)
    }

    /// The smallest levels of attenuation that the scene's `[attenuation]` asks for.
    ///
    /// # Errors
    /// [`SessionError::NoAttenuation`]; what is wrong with the scene; device failures.
    pub fn attenuation(&self) -> Result<Attenuated, SessionError> {
        if self.scene.model.attenuation.is_none() {
            return Err(SessionError::NoAttenuation);
        }
        let step = self.step();
        let mut shown = |what: &str| step.say(&format!("attenuation: {what}"));
        let backend = self.backend.as_ref();
        let found =
            in_pool(|| attenuation::smallest(self.scene, backend, self.choices, &mut shown))?;
        drop(step);
        self.progress.finished(Finished::Attenuation(&found));
        Ok(found)
    }

    /// The levels that the scene's `[attenuation]` asks for, to be looked at one by one.
    ///
    /// # Errors
    /// As [`attenuation`](Self::attenuation).
    pub fn levels(&self) -> Result<Levels<'_>, SessionError> {
        if self.scene.model.attenuation.is_none() {
            return Err(SessionError::NoAttenuation);
        }
        let backend = self.backend.as_ref();
        Ok(Levels::new(self.scene, backend, self.choices, &mut |_| {})?)
    }

    /// Does a unit of them.
    pub(crate) fn level_rows(
        &self,
        levels: &Levels<'_>,
        unit: usize,
    ) -> Result<Vec<Row>, SessionError> {
        let step = self.step();
        let mut shown = |what: &str| step.say(&format!("attenuation: {what}"));
        Ok(in_pool(|| levels.unit(unit, &mut shown))?)
    }

    /// The plan of a sweep. An error of the local solution has its place in the scene.
    ///
    /// # Errors
    /// What is wrong with the scene.
    pub fn plan(&self, choices: Choices) -> Result<Plan, SessionError> {
        plan(self.scene, self.backend.as_ref(), choices)
    }

    fn step(&self) -> Step<'_> {
        Step(self.progress)
    }
}

/// The plan of a scene's sweep. An error of the local solution has its place in the scene.
///
/// # Errors
/// What is wrong with the scene.
pub fn plan(scene: &Scene, backend: &dyn Backend, choices: Choices) -> Result<Plan, SessionError> {
    attenuation::refuse(scene)?;
    let Scene {
        model, hamiltonian, ..
    } = scene;
    Plan::new(model, hamiltonian, backend, choices).map_err(|e| match e {
        PlanError::Local(e) => at_equilibrium(model, &e).into(),
        other => other.into(),
    })
}

/// Errors of the local solution are the scene's: they are shown at its equilibrium.
#[must_use]
pub fn at_equilibrium(model: &Model, error: &LocalError) -> ScenarioErrors {
    let problem = match (&model.horizon, error, &model.shoot_out) {
        (_, LocalError::SeedTooLarge { .. }, Some(s)) => {
            Problem::at(s.span.clone(), error.to_string(), "this seed_value")
        }
        (Horizon::Infinite { span, .. }, ..) => {
            Problem::at(span.clone(), error.to_string(), "linearized here")
        }
        _ => Problem {
            message: error.to_string(),
            span: None,
            label: String::new(),
            help: None,
        },
    };
    model.errors(vec![problem])
}

/// Adds a block to the trajectories.
fn keep(all: &mut SweptTrajectories, block: &TrajectoryBlock) {
    all.count += block.count;
    all.t.extend_from_slice(&block.t);
    all.x.extend_from_slice(&block.x);
    all.p.extend_from_slice(&block.p);
    all.u.extend_from_slice(&block.u);
    all.v.extend_from_slice(&block.v);
    all.h.extend_from_slice(&block.h);
    all.status.extend_from_slice(&block.status);
    all.sheet.extend_from_slice(&block.sheet);
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

crate::opaque!(Session<'_>, Solved, Swept, Mapped);
