//! One pass over a scene: the sweep, then the states that are solved for, then the map and the
//! study.

use super::estimates::Estimates;
use super::progress::{Progress, Step};
use super::wanted::{GivenSweep, Kept, Targets, Wanted};
use super::{Session, SessionError, Shard};
use crate::backend::cpu::in_pool;
use crate::backend::{Backend, BackendError, Deadline, Trajectories};
use crate::dynamic_programming::{self, Device, Options, extent};
use crate::map::{self, Adaptive};
use crate::model::MapAim;
use crate::scene::Scene;
use crate::study::Variant;
use crate::sweep::{Choices, Plan, SurfacePart, SweepReport, sweep_keeping};
use crate::trajectories::TrajectoryBlock;
use crate::value::blocks::{Blocks, Found, Keeper, Seam};
use crate::value::{self, Answers, Archive, Entry, PointStatus};
use rustc_hash::FxHashSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// A pass that is planned, and has not begun.
pub struct Pass<'s> {
    session: &'s Session<'s>,
    plan: Plan,
    choices: Choices,
    targets: Option<Targets>,
    aim: Option<&'s MapAim>,
    stored: bool,
    kept: Kept,
    study: bool,
    grid_guesses: bool,
    archive: Option<Arc<GivenSweep>>,
    shard: Option<Shard>,
    /// Blocks that are not solved, since they were before.
    done: Vec<usize>,
    checkpoint: Option<Checkpoint<'s>>,
}

/// Keeps what is done by now.
pub struct Checkpoint<'c> {
    /// Writes it; what is wrong with that is told there, and the work goes on.
    pub write: Box<dyn FnMut(&SoFar<'_>) + Send + 'c>,
    /// Time between two, at least.
    every: Duration,
    /// When it was written last, or the work began, and how long that took.
    last: Instant,
    took: Duration,
}

/// What came of a pass.
pub struct Outcome {
    /// What was integrated, and how.
    pub plan: Plan,
    /// Of the sweep, also of one that only gave first guesses.
    pub swept: SweepReport,
    /// How many trajectories of an earlier sweep gave first guesses.
    pub guesses: usize,
    /// Whether the sweep is a result. Else it gave first guesses.
    pub stored: bool,
    /// Whether its trajectories were kept.
    pub trajectories: bool,
    /// The states that were solved for.
    pub answers: Option<Answers>,
    /// How many of the answers, from the first on, are those of a list of the user's own.
    pub listed: usize,
    /// The trajectories from the states of the list, and how many points each has.
    pub sampled: Option<(usize, TrajectoryBlock)>,
    /// The map to an error.
    pub mapped: Option<Adaptive>,
    /// The variants of the study.
    pub variants: Vec<Variant>,
    /// The errors of the sweep and of the answers.
    pub estimates: Estimates,
    /// Whether the session's deadline ended it before everything was done.
    pub stopped: bool,
    /// Which of the states asked for these are; `None` where none were.
    pub part: Option<Part>,
    pub(crate) targets: Option<Targets>,
}

/// Which of the states asked for were solved for, and what joins them to others.
pub struct Part {
    /// The shard that they are; `None` where all were to be solved for.
    pub shard: Option<Shard>,
    /// How many states were asked for in all, and in how many blocks they are.
    pub rows: usize,
    /// How many blocks there are in all.
    pub blocks: usize,
    /// The blocks that were solved here: their numbers, whether each was searched to the end, and
    /// how many different states it has.
    pub(crate) own: Vec<usize>,
    pub(crate) is_done: Vec<bool>,
    pub(crate) states: Vec<usize>,
    /// The block of each state that is answered, as they were given.
    pub(crate) block_of: Vec<usize>,
    /// The number that the sheet of each solution has within its block.
    pub(crate) sheet_within: Vec<i32>,
    pub(crate) seams: Vec<Seam>,
}

impl Outcome {
    /// Of what is not begun.
    fn nothing(plan: Plan, targets: Option<Targets>) -> Self {
        Self {
            swept: SweepReport::default(),
            guesses: 0,
            stored: false,
            trajectories: false,
            answers: None,
            listed: 0,
            sampled: None,
            mapped: None,
            variants: Vec::new(),
            estimates: Estimates::default(),
            stopped: false,
            part: None,
            targets,
            plan,
        }
    }

    /// The solution of least V at a state that was asked for (by its number: those of a list first,
    /// then of `[homotopy]` and `[map]`); `None` where there is none. (`answers` has each state
    /// once, in an order of its own.)
    ///
    /// # Panics
    /// Where no such state was asked for.
    pub fn answer(&self, state: usize) -> Option<&Entry> {
        let answers = self.answers.as_ref()?;
        answers.answer(answers.targets.of_given[state])
    }

    /// What came of such a state; `None` where no states were asked for.
    ///
    /// # Panics
    /// Where no such state was asked for.
    pub fn status(&self, state: usize) -> Option<PointStatus> {
        let answers = self.answers.as_ref()?;
        Some(answers.status(answers.targets.of_given[state]))
    }
}

impl Session<'_> {
    /// The states that are asked for; `None` where there are none.
    ///
    /// # Errors
    /// What is wrong with them.
    pub(crate) fn targets(&self, wanted: &Wanted) -> Result<Option<Targets>, SessionError> {
        Targets::new(&self.scene.model, wanted)
    }

    /// Plans what is asked for; nothing is computed beyond the local solution.
    ///
    /// # Errors
    /// What is wrong with the scene, or with what is asked for.
    pub fn prepare(&self, wanted: &Wanted) -> Result<Pass<'_>, SessionError> {
        let model = &self.scene.model;
        let targets = Targets::new(model, wanted)?;
        if wanted.grid_guesses {
            dynamic_programming::refuse(model, "grid_guesses")?;
            if targets.is_none() {
                return Err(SessionError::NoGridGuesses);
            }
        }

        let aim = model.map_aim.as_ref().filter(|_| wanted.map);
        let solves = targets.is_some() || aim.is_some();
        let stored = wanted.sweep && model.shoot_out.is_some();
        let count = targets.as_ref().map_or(0, Targets::count);
        let choices = Choices {
            inner_levels: solves,
            dispensable: solves && !stored,
            max_seeds: (solves && !wanted.sweep)
                .then(|| value::guess_seeds(model.states.len(), count)),
            unasked: solves,
            part: (wanted.shard.filter(|_| wanted.sweep)).map(|shard| SurfacePart {
                part: shard.number(),
                parts: shard.of(),
            }),
            ..self.choices
        };
        Ok(Pass {
            plan: self.plan(choices)?,
            session: self,
            choices,
            targets,
            aim,
            stored,
            kept: wanted.kept,
            study: wanted.study && model.study.is_some(),
            grid_guesses: wanted.grid_guesses,
            archive: wanted.archive.clone(),
            shard: wanted.shard,
            done: Vec::new(),
            checkpoint: None,
        })
    }
}

/// The states that a pass solves for.
pub(crate) struct StatesAsked<'a> {
    pub plan: &'a Plan,
    pub targets: &'a Targets,
    /// Blocks of them in all.
    pub units: usize,
}

/// What is done of the states by now.
pub struct SoFar<'a> {
    pub(crate) plan: &'a Plan,
    pub(crate) answers: &'a Answers,
    pub(crate) part: &'a Part,
}

impl<'c> Checkpoint<'c> {
    /// They take at most one part of so many of the time.
    const SHARE: u32 = 20;

    /// Writes by this, not sooner after the last time than so; the work begins now.
    pub fn new(every: Duration, write: Box<dyn FnMut(&SoFar<'_>) + Send + 'c>) -> Self {
        Self {
            write,
            every,
            last: Instant::now(),
            took: Duration::ZERO,
        }
    }
}

/// Keeps what is found of states.
struct KeepStates<'k, 'c> {
    checkpoint: Option<&'k mut Checkpoint<'c>>,
    plan: &'k Plan,
    shard: Option<Shard>,
    rows: usize,
    blocks: usize,
}

impl Keeper for KeepStates<'_, '_> {
    fn is_due(&self) -> bool {
        (self.checkpoint.as_ref()).is_some_and(|checkpoint| {
            let pause = checkpoint.every.max(checkpoint.took * Checkpoint::SHARE);
            checkpoint.last.elapsed() >= pause
        })
    }

    fn keep(&mut self, own: &[usize], found: Found) {
        let Some(checkpoint) = &mut self.checkpoint else {
            return;
        };
        let begun = Instant::now();
        let (part, answers) = Part::of(self.shard, (self.rows, self.blocks), own, found);
        (checkpoint.write)(&SoFar {
            plan: self.plan,
            answers: &answers,
            part: &part,
        });
        (checkpoint.last, checkpoint.took) = (Instant::now(), begun.elapsed());
    }
}

impl Part {
    /// What was found for some blocks, of so many states and blocks in all.
    fn of(
        shard: Option<Shard>,
        (rows, blocks): (usize, usize),
        own: &[usize],
        found: Found,
    ) -> (Self, Answers) {
        let part = Self {
            shard,
            rows,
            blocks,
            own: own.to_vec(),
            block_of: found.block_of,
            sheet_within: found.sheet_within,
            is_done: found.is_done,
            states: found.states,
            seams: found.seams,
        };
        (part, found.answers)
    }
}

impl<'s> Pass<'s> {
    /// Whether a map to an error is made.
    pub(crate) fn maps(&self) -> bool {
        self.aim.is_some()
    }

    /// The states that are solved for; `None` where there are none.
    pub(crate) fn states(&self) -> Option<StatesAsked<'_>> {
        let targets = self.targets.as_ref()?;
        let blocks = Blocks::new(&self.plan, self.session.backend(), &targets.request);
        Some(StatesAsked {
            plan: &self.plan,
            units: blocks.blocks.len(),
            targets,
        })
    }

    /// Leaves out blocks of states: they were solved before.
    pub(crate) fn without(&mut self, done: Vec<usize>) {
        self.done = done;
    }

    /// Nothing is done, since all was before.
    pub(crate) fn nothing(self) -> Outcome {
        Outcome::nothing(self.plan, self.targets)
    }

    /// Keeps what is done, now and then.
    pub(crate) fn keeping(&mut self, checkpoint: Checkpoint<'s>) {
        self.checkpoint = Some(checkpoint);
    }
}

impl Pass<'_> {
    /// What will be integrated, and how.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// That alone.
    pub(crate) fn into_plan(self) -> Plan {
        self.plan
    }

    /// Whether the sweep is a result, with its trajectories.
    pub fn stores_sweep(&self) -> bool {
        self.stored && self.kept != Kept::Nothing
    }

    /// Computes everything. Blocks of swept trajectories go to `write` as they finish, if the sweep
    /// is a result.
    ///
    /// # Errors
    /// Those of the computation, and of `write`.
    pub fn perform<E: From<SessionError>>(self, write: Write<'_, E>) -> Result<Outcome, E> {
        let stores_sweep = self.stores_sweep();
        let Pass {
            session,
            plan,
            choices,
            targets,
            aim,
            stored,
            study,
            grid_guesses,
            archive: given,
            shard,
            done,
            mut checkpoint,
            ..
        } = self;
        let mut outcome = Outcome {
            stored,
            trajectories: stores_sweep,
            ..Outcome::nothing(plan, targets)
        };

        let solves = outcome.targets.is_some() || aim.is_some();
        let mut archive = solves.then(|| Archive::new(&outcome.plan));
        // A sweep that was made before leaves no reason to make one.
        let is_used = |_: &Arc<GivenSweep>| !stored && value::may_use_sweep(&outcome.plan);
        if given.as_ref().is_some_and(|given| !is_used(given)) {
            let text = "the sweep that is given (--archive) is not used: here the search makes its own trajectories";
            session.progress.note(text);
        }
        let given = given.filter(is_used);
        let direct = !stored && given.is_none() && value::goes_without_sweep(&outcome.plan);
        if let Some(given) = given {
            outcome.guesses = given.swept.count;
            archive = solves.then(|| Archive::of_stored(&outcome.plan, &given.swept));
        } else if !direct {
            let write = stores_sweep.then_some(write);
            outcome.swept = session.sweep_into(&outcome.plan, archive.as_mut(), write)?;
        }
        in_pool(|| {
            if let Some(archive) = &mut archive {
                let asked = (direct, grid_guesses, shard);
                let work = (done.as_slice(), checkpoint.as_mut());
                session.solve_states(&mut outcome, archive, asked, work)?;
            }
            if let (Some(aim), Some(archive)) = (aim, &archive) {
                outcome.mapped = session.map_or_note(&outcome.plan, archive, aim)?;
            }
            if study {
                outcome.variants = session.study_with(choices)?;
            }
            Ok::<_, SessionError>(())
        })?;

        // Estimates would take longer than what they are of.
        outcome.stopped = session.is_over();
        if outcome.stopped {
            return Ok(outcome);
        }
        let (plan, answers) = (&outcome.plan, outcome.answers.as_ref());
        outcome.estimates =
            Estimates::new(plan, &outcome.swept, stored, answers).map_err(SessionError::from)?;
        Ok(outcome)
    }
}

impl Session<'_> {
    /// Solves for the states of a pass, if there are any, and samples the trajectories from those
    /// of the list. `direct`: nothing was swept so far.
    fn solve_states(
        &self,
        outcome: &mut Outcome,
        archive: &Archive,
        (direct, grid_guesses, shard): (bool, bool, Option<Shard>),
        (done, checkpoint): (&[usize], Option<&mut Checkpoint<'_>>),
    ) -> Result<(), SessionError> {
        let plan = &outcome.plan;
        let Some(targets) = &mut outcome.targets else {
            return Ok(());
        };
        targets.request.partial = true;
        if grid_guesses {
            targets.request.grid = match self.grid(plan, &targets.all()) {
                Err(_) if self.is_over() => None,
                grid => Some(grid?),
            };
        }
        let backend = self.backend.as_ref();
        let mut solver = value::solver(plan, backend)?;
        let step = self.step();
        let mut shown = step.states();

        let blocks = Blocks::new(plan, backend, &targets.request);
        let count = blocks.blocks.len();
        let mut own = match shard {
            None => (0..count).collect(),
            Some(shard) => shard.own(count),
        };
        let done: FxHashSet<usize> = done.iter().copied().collect();
        own.retain(|block| !done.contains(block));
        let rows = blocks.whole.rows_in_all();
        let mut keeper = KeepStates {
            checkpoint,
            plan,
            shard,
            rows,
            blocks: count,
        };
        let mut swept = None;
        let mut sweep = |archive: &mut Archive| -> Result<(), SessionError> {
            swept = Some(self.sweep_into::<SessionError>(plan, Some(archive), None)?);
            Ok(())
        };
        let guesses = (archive, direct.then_some(&mut sweep as _));
        let scene = (plan, &self.scene.model);
        let found = blocks.solve(
            scene,
            &mut solver,
            backend,
            guesses,
            (&own, &mut keeper),
            &mut shown,
        )?;
        if let Some(swept) = swept {
            outcome.swept = swept;
        }
        let (part, answers) = Part::of(shard, (rows, count), &own, found);
        outcome.part = Some(part);

        let rows = &answers.targets.rows;
        let of_points = rows.partition_point(|row| *row < targets.points());
        outcome.listed = if targets.listed { of_points } else { 0 };
        if let Some(samples) = targets.samples {
            let of_given = &answers.targets.of_given[..outcome.listed];
            let entries: Vec<&Entry> = of_given.iter().filter_map(|t| answers.answer(*t)).collect();
            // What is solved has its trajectory, whatever the time.
            solver.deadline = Deadline::default();
            let block = value::sampled(plan, &mut solver, &entries, samples)?;
            outcome.sampled = Some((samples, block));
        }
        outcome.answers = Some(answers);
        Ok(())
    }

    /// The map that a scene's `[map] error` asks for; `None`, with a note, where the time is over.
    fn map_or_note(
        &self,
        plan: &Plan,
        archive: &Archive,
        aim: &MapAim,
    ) -> Result<Option<Adaptive>, SessionError> {
        // What it begins with takes long where much was swept.
        let made = match self.is_over() {
            true => Err(SessionError::Backend(BackendError::OutOfTime)),
            false => self.map_to_error(plan, archive, aim),
        };
        match made {
            Err(SessionError::Backend(BackendError::OutOfTime)) => {
                self.progress
                    .note("no map was made: the run was ended before");
                Ok(None)
            }
            made => made.map(Some),
        }
    }

    /// V on a grid over the states, for first guesses.
    fn grid(
        &self,
        plan: &Plan,
        states: &[f64],
    ) -> Result<Arc<dynamic_programming::GridValue>, SessionError> {
        let step = self.step();
        step.say("V on a grid");
        let Scene {
            model, hamiltonian, ..
        } = self.scene;
        let options = Options {
            holds: extent(plan, states),
            ..Options::default()
        };
        let device = Device::of(self.backend.as_ref());
        Ok(Arc::new(dynamic_programming::solve(
            model,
            hamiltonian,
            plan,
            &options,
            device,
        )?))
    }

    /// The map that a scene's `[map] error` asks for.
    fn map_to_error(
        &self,
        plan: &Plan,
        archive: &Archive,
        aim: &MapAim,
    ) -> Result<Adaptive, SessionError> {
        let mut solver = value::solver(plan, self.backend.as_ref())?;
        let step = self.step();
        let mut shown = step.states();
        let model = &self.scene.model;
        Ok(map::adaptive(
            plan,
            model,
            &mut solver,
            archive,
            (aim, self.workers),
            &mut shown,
        )?)
    }

    /// Sweeps for a pass. Trajectories also go into the archive, where there is one.
    fn sweep_into<E: From<SessionError>>(
        &self,
        plan: &Plan,
        mut archive: Option<&mut Archive>,
        write: Option<Write<'_, E>>,
    ) -> Result<SweepReport, E> {
        let mut keep = |seeds: &[f64], batch: &Trajectories| {
            if let Some(archive) = &mut archive {
                archive.keep(seeds, batch);
            }
        };
        let backend = self.backend.as_ref();
        let swept = sweep_and_write(plan, backend, self.progress, &mut keep, write)?;
        // A part may be outside the guards, or there may be more parts than simplices.
        if swept.trajectories == 0 && plan.part == SurfacePart::WHOLE {
            let outside = swept.coverage.outside_guards;
            return Err(SessionError::NothingSwept { outside }.into());
        }
        Ok(swept)
    }
}

/// Sweeps, and tells of it; blocks of trajectories go to `write`, if there is one, while the next
/// ones are integrated.
///
/// # Errors
/// Device failures, and those of `write`.
pub fn sweep_and_write<E: From<SessionError>>(
    plan: &Plan,
    backend: &dyn Backend,
    progress: &dyn Progress,
    keep: &mut (dyn FnMut(&[f64], &Trajectories) + Send),
    write: Option<Write<'_, E>>,
) -> Result<SweepReport, E> {
    /// An error of either side.
    struct Failure<E>(E);
    impl<E: From<SessionError>> From<BackendError> for Failure<E> {
        fn from(e: BackendError) -> Self {
            Failure(E::from(e.into()))
        }
    }

    let step = Step(progress);
    let mut shown = |done: usize, waiting: usize| {
        step.say(&format!("{done} trajectories, {waiting} gaps to fill"));
    };
    let swept = match write {
        None => sweep_keeping(plan, backend, &mut shown, keep, None),
        Some(write) => {
            let sink = &mut |block: &TrajectoryBlock| write(block).map_err(Failure);
            sweep_keeping(plan, backend, &mut shown, keep, Some(sink))
        }
    };
    swept.map_err(|Failure(e)| e)
}

/// Takes blocks of swept trajectories.
pub type Write<'w, E> = &'w mut dyn FnMut(&TrajectoryBlock) -> Result<(), E>;

crate::opaque!(Pass<'_>, Outcome, Part, Checkpoint<'_>, SoFar<'_>);
