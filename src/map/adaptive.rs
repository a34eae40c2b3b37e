//! A map to the error asked for: states are chosen, solved, and their extremals cut into points,
//! until pieces fitted to these say what points that were left out say, and what fresh states say
//! that were never used.

mod beyond;
mod check;
mod failures;
mod first;
mod horizon;
mod points;
mod probe;
mod refine;
mod search;
mod tasks;

use super::Workers;
use super::guarded::Guarded;
use super::pieces::{Cloud, Flow, Frame, MOST_VARIABLES, Pieces, Region};
use crate::backend::{BackendError, Deadline};
use crate::map::Coverage;
use crate::model::{MapAim, Model};
use crate::shooting::{Path, Solver};
use crate::sweep::{Plan, spread_over};
use crate::value::{Archive, Progress, Track, TrackPoints};
pub use beyond::Beyond;
pub use check::{ABOVE_BOUND, Checked, GROSS, Part};
use check::{CHECKS, Met};
use failures::Failures;
use horizon::TimeAxis;
use refine::ALL_BUT;
use std::time::Instant;

/// Points of extremals are wanted this far outside the region, in its widths.
const AROUND: f64 = 0.05;
/// Slopes across that are this much less make another frame worth while.
const BETTER: f64 = 0.7;
/// How far beyond their outermost points pieces say something, in half widths: behind a fold of a
/// game there is nothing.
const BEYOND: f64 = 0.6;
const BEYOND_OF_GAME: f64 = 0.02;
/// Other sheets than the lowest are kept at a state if they may be the lowest within this share of
/// the region.
const NEAR: f64 = 0.05;

/// With a limit of seconds: so many times as long, and some seconds, after which states are given
/// up, and fresh states of the check.
const GIVEN_UP: f64 = 1.5;
const CHECK_GIVEN_UP: f64 = 2.0;
const GRACE: f64 = 5.0;

/// What came of it.
pub struct Adaptive {
    pub pieces: Pieces,
    /// Of an infinite horizon and of V(x, t): where solutions from the region lead.
    pub beyond: Option<Beyond>,
    pub check: Vec<Checked>,
    /// States solved for, and tried without an answer of use.
    pub states: usize,
    pub failed: usize,
    /// Of these, how many have one of V above `value_max`.
    pub above_max: usize,
    pub points: usize,
    pub rounds: usize,
    /// Fresh states that the check was asked for: with a limit of seconds it may have had room for
    /// fewer.
    pub check_asked: usize,
    /// States of the first search: those that the budget had room for, and all.
    pub first: [usize; 2],
    /// Where the error is above the one asked for, or nothing is known.
    pub unmet: Part,
    /// Where nothing is said.
    pub unknown: Part,
    /// Share of the region where that is because bounds are above `error_max`.
    pub uncertain: f64,
    /// Whether the budget ended it.
    pub spent: bool,
    pub error_max: f64,
    pub seconds: f64,
}

impl Adaptive {
    /// Whether all states of the first search were searched: else a cheaper sheet may have been
    /// missed.
    pub fn is_searched(&self) -> bool {
        self.first[0] >= self.first[1]
    }

    /// How well its states were searched for cheaper sheets.
    pub fn coverage(&self) -> Coverage {
        match (self.is_searched(), self.check.is_empty()) {
            (false, _) => Coverage::Uncovered,
            (true, false) => Coverage::Checked,
            (true, true) => Coverage::Searched,
        }
    }
}

/// A state at which a search found no solution.
struct Hole {
    /// Absolute, with its time where that is an axis.
    x: Vec<f64>,
    /// The solution there that leaves a guard, until its clearance is known.
    cut: Option<Path>,
    /// Whether the solution leaves a guard, and how far it keeps from each, once that is known.
    leaves_guard: bool,
    clearances: Vec<f64>,
}

struct Work<'a, 'p> {
    plan: &'a Plan,
    model: &'a Model,
    solver: &'a mut Solver,
    archive: &'a Archive,
    aim: &'a MapAim,
    /// Who solves for states elsewhere, if anyone does.
    workers: Option<&'a dyn Workers>,
    progress: Progress<'p>,
    tracks: Vec<Track>,
    points: TrackPoints,
    /// Points of each track.
    of_track: Vec<Vec<u32>>,
    cloud: Cloud,
    frame: Frame,
    /// Where V solves the Hamilton-Jacobi-Bellman equation in the variables of the map.
    flow: Option<Flow>,
    /// Track point and turns by periods that each point of the cloud comes from.
    origins: Vec<(u32, Vec<f64>)>,
    failures: Failures,
    unanswered: Vec<Hole>,
    /// Guards that a solution was seen to leave.
    shadows: Vec<bool>,
    /// States (absolute) with V to be asked whether points near them promise less; and solutions
    /// that leave guards.
    asked: Vec<(Vec<f64>, f64)>,
    cut: Vec<Path>,
    guarded: Option<Guarded>,
    random: u64,
    states: usize,
    failed: usize,
    above_max: usize,
    rounds: usize,
    /// States of the first search that were taken up, and all of it.
    first: [usize; 2],
    clock: Instant,
    /// Seconds a state of the last round, its pieces included.
    pace: f64,
    /// Of the states, and of the time where that is an axis.
    bounds: Vec<[f64; 2]>,
    axis: Option<TimeAxis>,
    /// dV/dt at the points, where time is an axis.
    rates: Vec<f64>,
}

/// Makes a map. `archive` gives the first guesses. Where there are `workers`, states that are
/// reached from points near them are solved for there.
///
/// At the plan's deadline it is what it is by then.
///
/// # Errors
/// Device failures; [`BackendError::OutOfTime`] where the deadline comes before the first states
/// are solved.
pub fn adaptive(
    plan: &Plan,
    model: &Model,
    solver: &mut Solver,
    archive: &Archive,
    (aim, workers): (&MapAim, Option<&dyn Workers>),
    progress: Progress<'_>,
) -> Result<Adaptive, BackendError> {
    let axis = TimeAxis::of(plan, model, aim)?;
    let bounds: Vec<[f64; 2]> = (aim.bounds.iter().copied())
        .chain(axis.as_ref().map(|axis| [0.0, axis.last]))
        .collect();
    assert!(bounds.len() <= MOST_VARIABLES);
    let region = Region {
        lo: bounds.iter().map(|b| b[0]).collect(),
        hi: bounds.iter().map(|b| b[1]).collect(),
        error: aim.error,
        equal_cost: aim.equal_cost.unwrap_or(f64::INFINITY),
        floor: 0.0,
        value_max: aim.value_max.unwrap_or(f64::INFINITY),
        beyond: if plan.game { BEYOND_OF_GAME } else { BEYOND },
        game: plan.game,
    };
    let flow = Flow::of(plan, axis.is_some());
    let mut work = Work {
        flow,
        plan,
        model,
        solver,
        archive,
        aim,
        workers,
        progress,
        tracks: Vec::new(),
        points: TrackPoints {
            states: plan.system.states,
            ..TrackPoints::default()
        },
        of_track: Vec::new(),
        cloud: Cloud {
            variables: bounds.len(),
            ..Cloud::default()
        },
        frame: Frame::along(&region),
        origins: Vec::new(),
        failures: Failures::default(),
        unanswered: Vec::new(),
        shadows: vec![false; plan.system.guards.len()],
        asked: Vec::new(),
        cut: Vec::new(),
        guarded: Guarded::of(plan),
        random: 0x5eed,
        states: 0,
        failed: 0,
        above_max: 0,
        rounds: 0,
        first: [0; 2],
        pace: 0.0,
        clock: Instant::now(),
        bounds,
        axis,
        rates: Vec::new(),
    };
    work.run(region)
}

impl Work<'_, '_> {
    /// States spread over bounds.
    fn spread(&self, bounds: &[[f64; 2]], count: usize) -> Vec<Vec<f64>> {
        match &self.guarded {
            Some(guarded) => guarded.spread(bounds, count),
            None => spread_over(bounds, count),
        }
    }

    /// Whether a guard excludes a state (absolute).
    fn is_excluded(&self, x: &[f64]) -> bool {
        let n = self.plan.system.states;
        self.guarded
            .as_ref()
            .is_some_and(|guarded| guarded.excluded(&x[..n])[0])
    }

    fn run(&mut self, mut region: Region) -> Result<Adaptive, BackendError> {
        region.floor = self.first()?;
        if self.cloud.is_empty() && self.is_over() {
            return Err(BackendError::OutOfTime);
        }
        let (mut check, mut met) = (Vec::new(), Vec::new());
        let pieces = self.refined(&region, Vec::new())?;
        let mut judged = self.judged(pieces);
        for attempt in 0..CHECKS {
            (check, met) = self.checked(&judged.pieces)?;
            let wrong = Self::wrong(&check);
            let unfounded = Self::unfounded(&check);
            if (wrong.is_empty() && unfounded.is_empty())
                || attempt + 1 == CHECKS
                || self.is_spent(1.0)
            {
                break;
            }
            unfounded
                .iter()
                .for_each(|c| self.note(&c.x, (c.status, None)));
            let more = self.searched_around(&wrong, &judged.pieces, &region)?;
            let pieces = self.refined(&region, more)?;
            judged = self.judged(pieces);
        }
        Ok(Adaptive {
            unmet: judged.unmet,
            unknown: judged.unknown,
            spent: self.is_spent(ALL_BUT),
            uncertain: judged.uncertain,
            error_max: self.aim.error_max,
            beyond: self.beyond(&region, &met),
            pieces: judged.pieces,
            check_asked: self.aim.check,
            check,
            states: self.states,
            failed: self.failed,
            above_max: self.above_max,
            points: self.cloud.len(),
            rounds: self.rounds,
            first: self.first,
            seconds: self.clock.elapsed().as_secs_f64(),
        })
    }

    fn is_spent(&self, share: f64) -> bool {
        self.states_left(share) == 0 || self.seconds_left(share) <= 0.0 || self.is_over()
    }

    /// Whether the whole run is to end, with the map as it is.
    fn is_over(&self) -> bool {
        self.plan.deadline.has_passed()
    }

    /// What is left of a share of the budget.
    fn states_left(&self, share: f64) -> usize {
        ((share * self.aim.states as f64) as usize).saturating_sub(self.states + self.failed)
    }

    fn seconds_left(&self, share: f64) -> f64 {
        (self.aim.seconds).map_or(f64::INFINITY, |s| {
            share * s - self.clock.elapsed().as_secs_f64()
        })
    }

    /// Work on states; `None` if it takes so many times the limit of seconds, if there is one, or
    /// until the plan's deadline. What it had found is lost then.
    fn in_time<T>(
        &mut self,
        times: f64,
        work: impl FnOnce(&mut Self) -> Result<T, BackendError>,
    ) -> Result<Option<T>, BackendError> {
        let end = |seconds: f64| Deadline::instant(self.clock, times * seconds + GRACE);
        self.solver.deadline = self.plan.deadline.by(self.aim.seconds.and_then(end));
        let done = work(self);
        self.solver.deadline = self.plan.deadline;
        match done {
            Err(BackendError::OutOfTime) => Ok(None),
            done => done.map(Some),
        }
    }

    /// Work without a deadline, on what is solved.
    fn untimed<T>(&mut self, work: impl FnOnce(&mut Self) -> T) -> T {
        let deadline = std::mem::take(&mut self.solver.deadline);
        let done = work(self);
        self.solver.deadline = deadline;
        done
    }

    /// How many more states there is time for, at the pace of those done since `began`.
    fn fitting(seconds_left: f64, began: Instant, done: usize) -> usize {
        let pace = began.elapsed().as_secs_f64() / done as f64;
        (seconds_left.max(0.0) / pace) as usize
    }

    /// V up to which points are kept: a little beyond what is asked for, for the pieces at its
    /// edge.
    fn most_value(&self) -> f64 {
        self.aim
            .value_max
            .map_or(f64::INFINITY, |v| v + 0.1 * v.abs())
    }
}
