//! Every extremal from each of many targets, and which of them lie on one sheet.
//!
//! First guesses come from the cells of the swept manifold that lie over a target (`covered`), or
//! where there are too many states for cells from swept trajectories near it (`swept`). What they
//! miss is reached from the local solution (`local`) and from solved neighbours (`spread`), where
//! it is asked for also from V on a grid (`greedy`). Where a sheet ends in a fold it is followed
//! around it (`folds`). Solutions that a continuation joins have the same label (`label`). In a
//! game only the sheet of the equilibrium counts (`principal`).

mod admissible;
mod aimed;
mod beside;
mod checked;
mod company;
mod covered;
mod folds;
mod greedy;
mod handed;
mod label;
mod local;
mod optimized;
mod principal;
mod spread;
mod status;
mod stones;
mod swept;
mod windings;

pub use checked::Support;
pub use status::{Miss, PointStatus};

use super::approach::{Approach, Unreached, follow};
use super::archive::{Archive, Index};
use super::clearance::Guards;
use super::conjugate::ConjugatePoints;
use super::cover::Cover;
use super::direct::Direct;
use super::extremal::{Extremal, same};
use super::fold::Fold;
use super::grow::grown;
use super::march;
use super::targets::Targets;
use super::tracks::FoundNear;
use crate::backend::BackendError;
use crate::dynamic_programming::GridValue;
use crate::shooting::{Failure, Path, Solver};
use crate::sweep::Plan;
pub(in crate::low_level::value) use label::Sheets;
use rayon::prelude::*;
use rustc_hash::FxHashSet;
use spread::{Effort, Followed};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

/// Shortest steps, as shares of the way, where there is nothing near to start from.
const SHORT: f64 = 1.0 / 256.0;
/// Sheets over one target that are looked for.
const MOST_SHEETS: usize = 8;
/// Targets looked at together.
const COHORT: usize = 4096;

/// What a survey asks for beyond the targets.
#[derive(Clone, Copy, Debug)]
pub struct Wanted {
    /// Extremals are continued up to this V (to a target that has none, regardless).
    pub value_max: f64,
    /// Whether all sheets are looked for, or one solution a target is enough.
    pub sheets: bool,
}

impl Wanted {
    /// Cost up to which sheets are looked for over a target whose V is `least`.
    fn sheets_to(self, least: f64, states: usize) -> f64 {
        // In many dimensions sheets far above the least are many and of no use.
        let range = match states {
            0..=2 => 16.0,
            3 => 4.0,
            _ => 1.0,
        };
        self.value_max.min(times(range, least))
    }

    /// The same at a target above whose `limit` V is of no interest: nor need the sheets be far
    /// over it.
    pub(in crate::low_level::value) fn at(self, limit: f64) -> Self {
        Self {
            value_max: self.value_max.min(BEYOND * limit),
            ..self
        }
    }
}

/// A cost made larger by a factor of its size: negative costs exist. Less than what is infinite is
/// infinite.
pub(in crate::low_level::value) fn times(factor: f64, cost: f64) -> f64 {
    if cost.is_finite() {
        cost + (factor - 1.0) * cost.abs()
    } else {
        cost
    }
}

/// Sheets are looked for up to this many times the V of interest, unless the scene says how far.
pub(in crate::low_level::value) const BEYOND: f64 = 2.0;
/// A fold's singular value, relative to that where the way began, below which a failure counts as a
/// fold.
const NEAR_FOLD: f64 = 0.2;

/// The extremals of many targets.
pub struct Survey<'a> {
    pub plan: &'a Plan,
    pub targets: &'a Targets,
    pub extremals: Vec<Extremal>,
    /// Extremals of each target.
    pub at: Vec<Vec<usize>>,
    /// Numbers of periods along each state.
    pub windings: Vec<Vec<i32>>,
    pub misses: Vec<Option<Miss>>,
    /// Solutions that are no extremals for the scene: they leave a guard. Their paths are their
    /// beginnings alone.
    cut: Vec<Vec<Extremal>>,
    /// Of a game with an equilibrium the extremal at each target on the sheet of the equilibrium;
    /// else empty.
    pub principal: Vec<Option<usize>>,
    pub folds: Vec<Fold>,
    /// Label of each extremal's sheet: 0 is that of the least V.
    pub sheet: Vec<i32>,
    /// The same where copies of a sheet by whole periods have one label.
    pub lifted: Vec<i32>,
    pub evaluations: u64,
    /// First guesses tried for each target.
    pub starts: Vec<u32>,
    /// Cost up to which the manifold was searched for extremals of each target; 0: not at all.
    pub searched: Vec<f64>,
    /// Least cost of a control that undercuts the least V of a target, and how many were flown.
    bounds: Vec<Option<f64>>,
    flights: Vec<u32>,
    /// Cost of a flight along the answer itself, of listed states.
    flown: Vec<Option<f64>>,
    /// Of targets the cheapest trajectory that was optimized directly, costs less than what is
    /// known, and led to no solution.
    lost: BTreeMap<usize, Lost>,
    /// Ways from targets to neighbours that were tried at once.
    leapt: Followed,
    /// Trajectories from which ways to a target were tried.
    pub(super) tried: FxHashSet<(usize, u32)>,
    /// Cost from which on the search of each target was not complete.
    pub uncovered: Vec<f64>,
    /// Whether the deadline cut the search short.
    pub stopped: bool,
    /// Whether there are too many sheets to be followed over the states.
    pub is_crowded: bool,
    /// Where single states are to be solved for from trajectories that are optimized directly.
    pub(in crate::low_level::value) direct: Option<&'a Direct<'a>>,
    pub(in crate::low_level::value) joined: Sheets,
    pub(in crate::low_level::value) scales: Vec<f64>,
    duration: f64,
    /// With whether each excludes its boundary.
    guards: Option<(Guards, Vec<bool>)>,
    /// In a game, where extremals with a fold along them are none.
    /// (Locked only so that a survey may be read by several threads.)
    conjugate: Option<Mutex<ConjugatePoints>>,
}

/// A trajectory that was optimized directly and led to no solution.
struct Lost {
    /// Its cost before its steps were shortened.
    cost: f64,
    /// What its controls cost where they are simulated.
    attained: Option<f64>,
    path: Path,
}

/// Told what is done and how many targets are solved of how many.
pub type Progress<'p> = &'p mut dyn FnMut(&str, usize, usize);

/// V on a grid, whose greedy paths are first guesses too.
pub enum GridGuesses<'p> {
    /// At every target.
    Given(&'p GridValue),
    /// Made, where it can be, once the search has left doubts, and for the targets in doubt.
    OnDemand(&'p mut dyn FnMut(Mesh) -> Option<Arc<GridValue>>),
}

/// How fine a grid is that is made for guesses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mesh {
    /// Half of the usual nodes along each axis.
    Coarse,
    /// The usual ones.
    Usual,
}

/// A way to try: from which extremal (if any), to which target and winding.
pub(in crate::low_level::value) struct Task {
    from: Option<usize>,
    target: usize,
    winding: usize,
    way: Approach,
}

impl<'a> Survey<'a> {
    /// # Errors
    /// When a kernel cannot be compiled.
    pub fn new(
        plan: &'a Plan,
        targets: &'a Targets,
        solver: &Solver,
    ) -> Result<Self, BackendError> {
        let guards = Guards::of(plan).map(|guards| {
            let strict = plan.system.guards.iter().map(|g| g.strict).collect();
            (guards, strict)
        });
        Ok(Self {
            plan,
            targets,
            extremals: Vec::new(),
            at: vec![Vec::new(); targets.len()],
            windings: Vec::new(),
            misses: vec![None; targets.len()],
            cut: vec![Vec::new(); targets.len()],
            principal: Vec::new(),
            folds: Vec::new(),
            sheet: Vec::new(),
            evaluations: 0,
            starts: vec![0; targets.len()],
            searched: vec![0.0; targets.len()],
            uncovered: vec![f64::INFINITY; targets.len()],
            bounds: vec![None; targets.len()],
            flights: vec![0; targets.len()],
            flown: vec![None; targets.len()],
            lost: BTreeMap::new(),
            leapt: Followed::default(),
            tried: FxHashSet::default(),
            stopped: false,
            is_crowded: false,
            direct: None,
            joined: Sheets::default(),
            lifted: Vec::new(),
            scales: solver.scheme.equations.scales.clone(),
            duration: plan.segment_duration(),
            guards,
            conjugate: (plan.game.then(|| ConjugatePoints::new(plan)).transpose()?).map(Mutex::new),
        })
    }

    /// Finds the extremals.
    ///
    /// # Errors
    /// Device failures only.
    pub fn run(
        &mut self,
        solver: &mut Solver,
        archive: &Archive,
        mut cover: Option<&mut Cover<'_>>,
        mut wanted: Wanted,
        mut second: GridGuesses<'_>,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        let index = self.begin(solver, archive, cover.as_deref())?;
        if self.plan.game && self.plan.local.is_some() {
            return self.principal_sheet(solver, archive, &index, wanted, progress);
        }
        self.first_search(
            solver,
            archive,
            &index,
            cover.as_deref_mut(),
            wanted,
            progress,
        )?;
        self.search_singly(solver, archive, cover, wanted, progress)?;
        match &mut second {
            GridGuesses::Given(grid) => self.try_grid(solver, grid, progress)?,
            GridGuesses::OnDemand(make) => self.try_doubtful(solver, make, progress)?,
        }
        self.spread(solver, wanted, Effort::Neighbours, progress)?;
        let is_crowded = self.with_direct(|survey, direct| {
            survey.search_in_company(solver, direct, wanted, progress)
        })?;
        self.is_crowded = is_crowded.unwrap_or(false);
        wanted.sheets &= !self.is_crowded;
        self.fly_in_company(solver, wanted, progress)?;
        self.last_resort(solver, archive, &index, wanted, progress)?;
        // Nothing behind a fold counts in a game.
        if wanted.sheets && !self.plan.game {
            self.around_folds(solver, wanted, progress)?;
        }
        self.check_by_flights(solver, progress)?;
        if let GridGuesses::OnDemand(make) = &mut second
            && self.try_lost(solver, make, progress)?
        {
            self.check_by_flights(solver, progress)?;
        }
        self.label();
        self.keep_bounds_positive();
        Ok(())
    }

    /// Does something with the trajectories that are optimized directly, if there are any.
    fn with_direct<T>(
        &mut self,
        work: impl FnOnce(&mut Self, &Direct<'a>) -> Result<T, BackendError>,
    ) -> Result<Option<T>, BackendError> {
        let direct = self.direct;
        direct.map(|direct| work(self, direct)).transpose()
    }

    /// Where costs are nowhere negative what was left out does not promise less than 0, however far
    /// tangents of trajectories that part go below it.
    fn keep_bounds_positive(&mut self) {
        let is_below = self.uncovered.iter().any(|v| *v < 0.0);
        if is_below && self.plan.costs_are_positive() {
            (self.uncovered.iter_mut()).for_each(|v| *v = v.max(0.0));
        }
    }

    /// Ends a search that its deadline has cut short: of what it found nothing is known to be the
    /// least, and nothing is known of the other targets.
    pub fn cut_short(&mut self) {
        self.stopped = true;
        if self.plan.game && self.plan.local.is_some() {
            // Which of the solutions is the value is not known yet.
            self.principal = vec![None; self.targets.len()];
            self.at = vec![Vec::new(); self.targets.len()];
        }
        for target in 0..self.targets.len() {
            if self.is_open(target) {
                let furthest = self.misses[target].take().and_then(|miss| miss.furthest);
                self.misses[target] = Some(Miss {
                    status: PointStatus::OutOfTime,
                    furthest,
                    left: f64::NAN,
                    cut: None,
                });
            }
        }
        self.label();
    }

    /// What needs no guess; the swept points near the targets.
    fn begin(
        &mut self,
        solver: &mut Solver,
        archive: &Archive,
        cover: Option<&Cover<'_>>,
    ) -> Result<Index, BackendError> {
        let index = self.index(archive);
        self.windings = if cover.is_some() {
            self.nearest_windings()
        } else {
            self.all_windings(&index)
        };
        self.refuse_outside();
        self.near_end(solver);
        march::add_marched(self, solver)?;
        Ok(index)
    }

    /// From the manifold, where it can be searched, or from swept trajectories near the targets.
    fn first_search(
        &mut self,
        solver: &mut Solver,
        archive: &Archive,
        index: &Index,
        cover: Option<&mut Cover<'_>>,
        wanted: Wanted,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        if let Some(cover) = cover {
            self.search_cells(solver, cover, wanted, progress)?;
            self.try_flights(solver)?;
            return self.try_folds_beside(solver);
        }
        self.try_flights(solver)?;
        let order: Vec<usize> = (0..self.targets.len()).collect();
        for part in order.chunks(COHORT) {
            self.swept(solver, archive, index, part, wanted)?;
            progress("from the sweep", self.solved(), self.targets.len());
        }
        // The hard ones together in short steps: many at once cost little more than one.
        let open = self.worth_trying();
        let tasks = self.nearest_guesses(&solver.scheme.end, archive, index, &open, 0, SHORT);
        self.send(solver, tasks)?;
        Ok(())
    }

    /// Cost up to which sheets over a target are of interest.
    pub(in crate::low_level::value) fn sheets_to(&self, target: usize, wanted: Wanted) -> f64 {
        let wanted = wanted.at(self.targets.limits[target]);
        match self.lowest(target) {
            // A game has one answer; nothing is known of how far its sheets matter.
            Some(least) if !self.plan.game => {
                wanted.sheets_to(self.extremals[least].value(), self.targets.states)
            }
            _ => wanted.value_max,
        }
    }

    /// Targets with a solution.
    pub fn solved(&self) -> usize {
        self.at.iter().filter(|list| !list.is_empty()).count()
    }

    /// The extremal of least V at a target.
    pub fn lowest(&self, target: usize) -> Option<usize> {
        let value = |e: &usize| self.extremals[*e].value();
        self.at[target]
            .iter()
            .copied()
            .min_by(|a, b| value(a).total_cmp(&value(b)))
    }

    pub(in crate::low_level::value) fn refuse_outside(&mut self) {
        for target in 0..self.targets.len() {
            let s = self.state(target, 0);
            let node = [s.as_slice(), &vec![0.0; s.len()]].concat();
            if self.at[target].is_empty() && !self.inside(&node) {
                self.misses[target] = Some(Miss {
                    status: PointStatus::OutsideGuard,
                    furthest: None,
                    left: f64::NAN,
                    cut: None,
                });
            }
        }
    }

    /// Whether a target still needs a solution.
    pub(in crate::low_level::value) fn is_open(&self, target: usize) -> bool {
        self.at[target].is_empty() && !self.is_refused(target)
    }

    pub(in crate::low_level::value) fn is_refused(&self, target: usize) -> bool {
        self.missed_by(target, PointStatus::OutsideGuard)
    }

    pub(in crate::low_level::value) fn missed_by(
        &self,
        target: usize,
        status: PointStatus,
    ) -> bool {
        self.misses[target]
            .as_ref()
            .is_some_and(|m| m.status == status)
    }

    /// Targets that still need a solution, and may have one: behind a fold there is none in a game.
    pub(in crate::low_level::value) fn worth_trying(&self) -> Vec<usize> {
        let behind = |t: usize| self.plan.game && self.missed_by(t, PointStatus::Fold);
        (0..self.targets.len())
            .filter(|t| self.is_open(*t) && !behind(*t))
            .collect()
    }

    /// Adds an extremal unless it is known; its index, and whether it is new.
    pub(in crate::low_level::value) fn add(&mut self, extremal: Extremal) -> (usize, bool) {
        let mut found = self.at[extremal.target].iter().copied();
        let known = found.find(|e| self.is_same(&self.extremals[*e], &extremal));
        if let Some(known) = known {
            return (known, false);
        }
        let index = self.extremals.len();
        self.at[extremal.target].push(index);
        self.misses[extremal.target] = None;
        self.joined.push(index, &extremal);
        self.extremals.push(extremal);
        (index, true)
    }

    /// Whether two extremals of a target are one.
    fn is_same(&self, a: &Extremal, b: &Extremal) -> bool {
        a.winding == b.winding && same(a.adjoint(), b.adjoint(), &self.scales)
    }

    /// Joins two extremals' sheets, unless another extremal of the one lies over a state of the
    /// other: then the way between them has left its sheet.
    pub(in crate::low_level::value) fn join(&mut self, a: usize, b: usize) -> bool {
        self.joined.join(a, b)
    }

    /// Follows continuation tasks, and joins what they find to what they came from. Of each its
    /// target, and the extremal there if it was reached.
    pub(in crate::low_level::value) fn send(
        &mut self,
        solver: &mut Solver,
        tasks: Vec<Task>,
    ) -> Result<Vec<(usize, Option<usize>)>, BackendError> {
        for task in &tasks {
            self.starts[task.target] += 1;
        }
        let (mut ways, rest): (Vec<Approach>, Vec<_>) = (tasks.into_iter())
            .map(|e| (e.way, (e.from, e.target, e.winding)))
            .unzip();
        follow(solver, &mut ways)?;
        let finished: Vec<_> = ways.into_par_iter().map(Approach::finish).collect();
        let paths = finished
            .iter()
            .filter_map(|(_, outcome)| outcome.as_ref().ok().map(|(job, _)| &job.path));
        // What is found by the deadline is kept: it is looked at all the same.
        let deadline = std::mem::take(&mut solver.deadline);
        let wrong = self.wrong(solver, &paths.collect::<Vec<_>>());
        solver.deadline = deadline;
        let mut wrong = wrong?.into_iter();
        let mut reached = Vec::new();
        // Solutions first: by them it is told why other ways have failed.
        let (found, lost): (Vec<_>, Vec<_>) =
            (finished.into_iter().zip(rest)).partition(|((_, outcome), _)| outcome.is_ok());
        for ((evaluations, outcome), (from, target, winding)) in found.into_iter().chain(lost) {
            self.evaluations += u64::from(evaluations);
            reached.push((target, None));
            match outcome {
                Ok((job, solved)) => match wrong.next().flatten() {
                    None => {
                        let (index, _) = self.add(Extremal {
                            target,
                            winding,
                            path: job.path,
                            solved,
                            iterations: evaluations,
                        });
                        if let Some(from) = from {
                            self.join(from, index);
                        }
                        reached.pop();
                        reached.push((target, Some(index)));
                    }
                    Some(status) => {
                        let at = self.targets.state(target).to_vec();
                        self.miss(target, status, Some(at), 0.0);
                        let cut = Extremal {
                            target,
                            winding,
                            path: Path::new(job.path.node(0)),
                            solved,
                            iterations: evaluations,
                        };
                        if !self.cut[target]
                            .iter()
                            .any(|known| self.is_same(known, &cut))
                        {
                            self.cut[target].push(cut);
                        }
                        let miss = self.misses[target].as_mut();
                        if let Some(miss) = miss.filter(|m| m.status == PointStatus::LeavesGuard) {
                            miss.cut.get_or_insert(job.path);
                        }
                    }
                },
                Err(unreached) => {
                    self.unreached(from, target, winding, &unreached);
                }
            }
        }
        deadline.check()?;
        Ok(reached)
    }

    /// Solves for each target from one path that begins near it; the solutions' paths and V.
    pub(in crate::low_level::value) fn solve_along(
        &mut self,
        solver: &mut Solver,
        paths: Vec<Path>,
        least: f64,
    ) -> Result<Vec<FoundNear>, BackendError> {
        self.windings = vec![vec![0; self.targets.states]];
        let reference = &self.plan.system.reference;
        let tasks = (paths.into_iter().enumerate())
            .map(|(target, path)| {
                // As it stands there: a path that goes round leads to a state that does.
                let goal = (self.targets.state(target).iter().zip(reference)).map(|(x, r)| x - r);
                Task {
                    from: None,
                    target,
                    winding: 0,
                    way: Approach::new(path, goal.collect(), least),
                }
            })
            .collect();
        self.send(solver, tasks)?;
        let found = self
            .at
            .iter()
            .zip(&self.misses)
            .map(|(found, miss)| match found.first() {
                Some(e) => Ok((self.extremals[*e].path.clone(), self.extremals[*e].value())),
                None => Err(miss.clone()),
            });
        Ok(found.collect())
    }

    /// Solves along paths to targets from their ends, and from what that leads to.
    pub(in crate::low_level::value) fn send_grown(
        &mut self,
        solver: &mut Solver,
        rough: Vec<(usize, Path)>,
        least: f64,
    ) -> Result<Vec<(usize, Option<usize>)>, BackendError> {
        let (targets, paths): (Vec<usize>, Vec<Path>) = rough.into_iter().unzip();
        let mut tasks = Vec::new();
        for (target, (path, evaluations)) in
            targets.into_iter().zip(grown(self.plan, solver, paths)?)
        {
            self.evaluations += u64::from(evaluations);
            tasks.extend(path.and_then(|(path, _)| self.task_along(target, path, least)));
        }
        self.send(solver, tasks)
    }

    /// Notes how far the way to a target led, if that is further than before.
    pub(in crate::low_level::value) fn unreached(
        &mut self,
        from: Option<usize>,
        target: usize,
        winding: usize,
        unreached: &Unreached,
    ) {
        if !self.at[target].is_empty() {
            return;
        }
        let goal = self.scaled(&self.state(target, winding));
        let there = self.scaled(&unreached.furthest);
        let left = goal
            .iter()
            .zip(&there)
            .map(|(a, b)| (a - b).powi(2))
            .sum::<f64>()
            .sqrt();
        // Compared with where the way began; a guess from the sweep is no solution: the median of
        // all fold distances is used instead.
        let began = from.map_or_else(|| self.usual_fold(), |e| self.extremals[e].solved.fold);
        let ended = unreached
            .job
            .as_ref()
            .and_then(|j| j.solved())
            .map(|s| s.fold);
        let status = match unreached.failure {
            Failure::NotFinite => PointStatus::NotFinite,
            Failure::Horizon => PointStatus::Horizon,
            Failure::OutOfTime => PointStatus::OutOfTime,
            _ if ended.is_some_and(|ended| ended < NEAR_FOLD * began) => PointStatus::Fold,
            _ => PointStatus::NotReached,
        };
        let reference = &self.plan.system.reference;
        let turns = self.state(target, winding);
        let state = self.targets.state(target);
        // Back from the winding to where the target is.
        let furthest = (0..state.len())
            .map(|i| unreached.furthest[i] + reference[i] - (turns[i] + reference[i] - state[i]))
            .collect();
        self.miss(target, status, Some(furthest), left);
    }

    /// Median of the extremals' distances from folds; 0 where there are none.
    pub(in crate::low_level::value) fn usual_fold(&self) -> f64 {
        let mut all: Vec<f64> = self.extremals.iter().map(|e| e.solved.fold).collect();
        let middle = all.len() / 2;
        if all.is_empty() {
            return 0.0;
        }
        *all.select_nth_unstable_by(middle, f64::total_cmp).1
    }

    pub(in crate::low_level::value) fn miss(
        &mut self,
        target: usize,
        status: PointStatus,
        furthest: Option<Vec<f64>>,
        left: f64,
    ) {
        let better = self.misses[target]
            .as_ref()
            .is_none_or(|m| m.furthest.is_none() || left < m.left);
        if better && self.at[target].is_empty() {
            self.misses[target] = Some(Miss {
                status,
                furthest,
                left,
                cut: None,
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::times;

    #[test]
    fn a_share_of_what_is_unknown_is_unknown() {
        assert_eq!(times(0.5, f64::INFINITY), f64::INFINITY);
        assert!(5.0 < times(1.0 - 1e-6, f64::INFINITY));
        assert_eq!((times(1.5, 2.0), times(1.5, -2.0)), (3.0, -1.0));
    }
}
