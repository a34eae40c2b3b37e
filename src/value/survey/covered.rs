//! Extremals from the cells of the swept manifold: what lies over a target is found whatever else
//! is asked for.

use super::spread::Effort;
use super::{COHORT, MOST_SHEETS, Progress, SHORT, Survey, Task, Wanted, times};
use crate::backend::BackendError;
use crate::shooting::Solver;
use crate::value::approach::Approach;
use crate::value::cover::{Candidate, Cover, Sought, goes_behind_guards, lower};
use crate::value::extremal::{Extremal, is_elsewhere, largest_of};
use crate::value::flight::homeward;
use std::collections::BTreeMap;

/// Ratio of the costs up to which the manifold is searched, one after the other: in cells, and by
/// points near the target.
const STEP: [f64; 2] = [2.0, 4.0];
/// First and last of these costs, in the cover's unit.
const LOWEST: f64 = 1e-6;
const HIGHEST: [f64; 2] = [256.0, 16.0];
const FIRST_FINITE: f64 = 1.0 / 4096.0;
/// The first search of a target goes to this share of what the linearization expects.
const FIRST: f64 = 1.0 / 64.0;
/// Times that guesses which no known solution explains are tried.
const ROUNDS: usize = 4;
/// Guesses of one target tried in a round.
const MOST_AT_ONCE: usize = 12;
/// Shortest steps, as shares of the way from a guess.
pub(super) const FROM_CELL: f64 = 1.0 / 16.0;
/// The same from a trajectory near the target.
const FROM_POINT: f64 = 1.0 / 16.0;
/// Where solutions leave guards, and trajectories go on behind these, others are looked for up to
/// this many times the V of the cheapest of them.
const PAST_CUT: f64 = 16.0;
/// Guesses near a target are tried up to this many times its least V where all sheets are looked
/// for.
const SHEETS: f64 = 1.5;
/// A solution explains a guess whose adjoint differs by less than this share of the spread within
/// the cell, and of its size.
const WITHIN: f64 = 0.6;
const ALIKE: f64 = 0.02;
/// A solution is dearer than a guess promises from this share of its cost on: where trajectories
/// turn within a cell guesses are off by some hundredths.
pub(super) const DEARER: f64 = 0.03;
/// A guess promises less than what is known where it is below that by more than this share.
const PROMISE: f64 = 2e-3;
/// Guesses that promise more than this times the cost searched for are left out.
const ABOVE: f64 = 1.3;

/// Where the way to a target begins.
#[derive(Clone, Copy)]
enum Start {
    /// At the target itself, with the mean of a cell's trajectories.
    Mean,
    /// At the trajectory beside it, in steps of at least this share of the way.
    Beside(f64),
}

impl Survey<'_> {
    /// Searches the manifold for every target, in rising cost, until what was found is cheaper than
    /// what is left.
    pub(super) fn search_cells(
        &mut self,
        solver: &mut Solver,
        cover: &mut Cover<'_>,
        wanted: Wanted,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        if self.plan.local.is_none() && !self.plan.costs_are_positive() {
            let all: Vec<usize> = (0..self.targets.len())
                .filter(|t| !self.is_refused(*t))
                .collect();
            return self.search(solver, cover, &all, f64::INFINITY, wanted, progress);
        }
        self.try_within_seeds(solver, cover)?;
        let kind = usize::from(!cover.has_cells());
        let step = STEP[kind];
        let stage_of = |share: f64| share.log(step).ceil() as i32;
        let (lowest, highest) = (stage_of(LOWEST), stage_of(HIGHEST[kind]));
        let first: Vec<i32> = (0..self.targets.len())
            .map(|t| stage_of(self.expected(t, cover.unit)).clamp(lowest, highest))
            .collect();
        let mut open: Vec<usize> = (0..self.targets.len())
            .filter(|t| !self.is_refused(*t))
            .collect();
        // At last, on a finite horizon, whatever it costs.
        let last = highest + i32::from(self.plan.local.is_none());
        for stage in lowest..=last {
            let ceiling = if stage > highest {
                f64::INFINITY
            } else {
                cover.unit * step.powi(stage)
            };
            let now: Vec<usize> = (open.iter().copied())
                .filter(|t| first[*t] <= stage)
                .collect();
            self.search(solver, cover, &now, ceiling, wanted, progress)?;
            open.retain(|t| first[*t] > stage || !self.is_settled(*t, ceiling, wanted));
            if open.is_empty() {
                break;
            }
        }
        Ok(())
    }

    /// The cost at which a target's search begins, in units, by the quadratic V at the copy nearest
    /// to the equilibrium.
    fn expected(&self, target: usize, unit: f64) -> f64 {
        let Some(local) = &self.plan.local else {
            return FIRST_FINITE;
        };
        let s = homeward(&self.state(target, 0), &self.plan.periods);
        (FIRST * local.quadratic(&s) / unit).clamp(LOWEST, HIGHEST[0])
    }

    /// Whether nothing that costs more than `ceiling` is of interest at a target.
    fn is_settled(&self, target: usize, ceiling: f64, wanted: Wanted) -> bool {
        let highest = wanted.at(self.targets.limits[target]).value_max;
        if ceiling >= self.targets.limits[target] && ceiling >= highest {
            return true;
        }
        let Some(least) = self.lowest(target).map(|e| self.extremals[e].value()) else {
            let cut = self.cut[target]
                .iter()
                .map(Extremal::value)
                .min_by(f64::total_cmp);
            let is_past = cut.is_some_and(|cut| ceiling >= times(PAST_CUT, cut));
            return ceiling >= self.targets.limits[target]
                || (is_past && goes_behind_guards(self.targets.states));
        };
        let sheets = wanted.sheets && self.at[target].len() < MOST_SHEETS;
        // Once cells over the target were left out, what costs more can only be found by chance.
        let complete = ceiling <= self.uncovered[target];
        least <= ceiling && (!sheets || !complete || ceiling >= self.sheets_to(target, wanted))
    }

    fn search(
        &mut self,
        solver: &mut Solver,
        cover: &mut Cover<'_>,
        targets: &[usize],
        ceiling: f64,
        wanted: Wanted,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        for part in targets.chunks(COHORT) {
            let sought: Vec<Sought> = (part.iter())
                .map(|&target| Sought {
                    target,
                    s: self.state(target, 0),
                    gridded: self.targets.gridded[target],
                    above: self.searched[target],
                })
                .collect();
            if !cover.has_cells() {
                let near = cover.near(&sought, ceiling)?;
                self.try_near(solver, cover, near, ceiling, wanted)?;
                part.iter().for_each(|t| self.uncovered[*t] = 0.0);
                progress("from swept trajectories", self.solved(), self.targets.len());
                continue;
            }
            let cells = cover.search(&sought, ceiling)?;
            let lost = self.try_candidates(solver, cover, cells.candidates, ceiling, wanted)?;
            for &target in part {
                let left = [cells.uncovered.get(&target), lost.get(&target)];
                let left = left
                    .into_iter()
                    .flatten()
                    .copied()
                    .fold(f64::INFINITY, f64::min);
                self.uncovered[target] = self.uncovered[target].min(left);
                self.searched[target] = ceiling;
            }
            progress("from the swept manifold", self.solved(), self.targets.len());
        }
        Ok(())
    }

    /// Targets that lie within the seeds, by the local solution.
    fn try_within_seeds(
        &mut self,
        solver: &mut Solver,
        cover: &Cover<'_>,
    ) -> Result<(), BackendError> {
        let mut tasks = Vec::new();
        for target in (0..self.targets.len()).filter(|t| self.is_open(*t)) {
            for winding in 0..self.windings.len() {
                let goal = self.state(target, winding);
                if let Some(path) = cover.within_seeds(&goal, &solver.scheme.end) {
                    tasks.push(Task {
                        from: None,
                        target,
                        winding,
                        way: Approach::new(path, goal, FROM_CELL),
                    });
                }
            }
        }
        self.send(solver, tasks)?;
        Ok(())
    }

    /// Tries guesses from trajectories near the targets: those that promise less than what is
    /// known, the nearest first. States of a grid are reached from each other before.
    fn try_near(
        &mut self,
        solver: &mut Solver,
        cover: &Cover<'_>,
        mut left: Vec<Candidate>,
        ceiling: f64,
        wanted: Wanted,
    ) -> Result<(), BackendError> {
        self.spread(solver, wanted, Effort::Leaps, &mut |_: &str, _, _| {})?;
        left.retain(|c| {
            c.expected <= ABOVE * ceiling && !self.tried.contains(&(c.target, c.seed()))
        });
        while !left.is_empty() {
            let mut now: Vec<Candidate> = Vec::new();
            let mut later = Vec::new();
            for candidate in left {
                if !self.promises(&candidate, wanted) {
                    continue;
                }
                if now.last().is_some_and(|c| c.target == candidate.target) {
                    later.push(candidate);
                } else {
                    now.push(candidate);
                }
            }
            self.tried.extend(now.iter().map(|c| (c.target, c.seed())));
            self.send_all(solver, cover, now.iter(), Start::Beside(FROM_POINT))?;
            left = later;
        }
        Ok(())
    }

    /// Whether a guess may lead to something new that is of interest.
    fn promises(&self, candidate: &Candidate, wanted: Wanted) -> bool {
        let known = self.known_at(candidate);
        let mut near = known.filter(|e| !is_elsewhere(e, &candidate.node, &self.scales));
        let least = self
            .lowest(candidate.target)
            .map(|e| self.extremals[e].value());
        let range = if wanted.sheets && self.at[candidate.target].len() < MOST_SHEETS {
            SHEETS
        } else {
            1.0
        };
        near.next().is_none() && least.is_none_or(|v| candidate.value <= times(range, v))
    }

    /// Tries the guesses that no known solution explains; the targets of which one led nowhere,
    /// with the least V it promised.
    fn try_candidates(
        &mut self,
        solver: &mut Solver,
        cover: &Cover<'_>,
        mut left: Vec<Candidate>,
        ceiling: f64,
        wanted: Wanted,
    ) -> Result<BTreeMap<usize, f64>, BackendError> {
        // Where something cheaper is known or offered, sheets above what is of interest are not
        // followed.
        let mut least: BTreeMap<usize, f64> = BTreeMap::new();
        for c in &left {
            let known = || {
                self.lowest(c.target)
                    .map_or(f64::INFINITY, |e| self.extremals[e].value())
            };
            let entry = least.entry(c.target).or_insert_with(known);
            *entry = entry.min(c.value);
        }
        left.retain(|c| {
            let highest = wanted.at(self.targets.limits[c.target]).value_max;
            c.value <= ABOVE * ceiling
                && (c.value <= ABOVE * highest || c.value <= least[&c.target])
        });
        let inside: Vec<Candidate> = left.iter().filter(|c| c.is_inside()).cloned().collect();
        let mut tried: Vec<Candidate> = Vec::new();
        for round in 0..ROUNDS {
            // The first round shows what there is; after that only what may be the least is tried
            // again.
            left.retain(|c| !self.is_known(c) && (round < 1 || self.may_be_least(c)));
            let (now, later) = choose(left, &self.scales);
            left = later;
            if now.is_empty() {
                break;
            }
            self.send_all(solver, cover, now.iter(), Start::Mean)?;
            let missing = now
                .iter()
                .filter(|c| !self.is_explained(c) && (c.is_inside() || self.may_be_least(c)));
            let missing: Vec<Candidate> = missing.cloned().collect();
            self.send_all(solver, cover, missing.iter(), Start::Beside(FROM_CELL))?;
            tried.extend(missing);
        }
        let aims = self.aim(solver, cover, inside)?;
        // A guess within its cell belongs to a sheet there: what it did not lead to may be missing.
        let is_missing = |survey: &Self, c: &Candidate| {
            c.is_inside()
                && survey.may_be_least(c)
                && !survey.is_explained(c)
                && !survey.explains_loosely(c)
                && !aims.dearer.iter().any(|other| other.is_same(c))
        };
        let mut hard: Vec<Candidate> = tried;
        hard.retain(|c| is_missing(self, c));
        self.send_all(solver, cover, hard.iter(), Start::Beside(SHORT))?;
        hard.extend(left);
        hard.retain(|c| is_missing(self, c));
        let mut lost = aims.lost;
        for candidate in hard {
            lower(&mut lost, candidate.target, candidate.value);
        }
        Ok(lost)
    }

    fn send_all<'c>(
        &mut self,
        solver: &mut Solver,
        cover: &Cover<'_>,
        candidates: impl Iterator<Item = &'c Candidate>,
        start: Start,
    ) -> Result<(), BackendError> {
        let end = &solver.scheme.end;
        let tasks: Vec<Task> = candidates
            .map(|c| Task {
                from: None,
                target: c.target,
                winding: self.winding(&c.turns),
                way: match start {
                    Start::Mean => Approach::new(cover.mean_path(c, end), c.goal.clone(), 1.0),
                    Start::Beside(least) => {
                        Approach::new(cover.path_beside(c, end), c.goal.clone(), least)
                    }
                },
            })
            .collect();
        self.send(solver, tasks)?;
        Ok(())
    }

    /// Whether a guess promises less than what is known.
    fn may_be_least(&self, candidate: &Candidate) -> bool {
        const NEARLY: f64 = 1.05;
        self.lowest(candidate.target)
            .is_none_or(|e| candidate.value <= times(NEARLY, self.extremals[e].value()))
    }

    fn is_explained(&self, candidate: &Candidate) -> bool {
        self.explaining(candidate).next().is_some()
    }

    /// Solutions known of a guess's adjoint.
    fn explaining(&self, candidate: &Candidate) -> impl Iterator<Item = &Extremal> {
        self.known_at(candidate).filter(|e| {
            alike(
                e.adjoint(),
                candidate.adjoint(),
                &candidate.spread,
                &self.scales,
                WITHIN,
            )
        })
    }

    /// Whether a guess is not worth a try: a solution of its adjoint is known that costs about what
    /// it promises, or it promises no less than all that is known. Ways that join behind an obstacle
    /// arrive with one adjoint, and only their costs tell them apart.
    fn is_known(&self, candidate: &Candidate) -> bool {
        let above = |v: f64, share: f64| v - candidate.value > share * candidate.value.abs();
        let least = self.lowest(candidate.target);
        let promising = least.is_none_or(|e| above(self.extremals[e].value(), PROMISE));
        let mut explaining = self.explaining(candidate);
        explaining.any(|e| !promising || !above(e.value(), DEARER))
    }

    /// Whether a solution of about the guess's cost and adjoint is known: near a fold cells are no
    /// measure of either.
    fn explains_loosely(&self, candidate: &Candidate) -> bool {
        self.known_at(candidate).any(|e| {
            let near = (e.value() - candidate.value).abs() <= 0.1 * candidate.value.abs();
            near && alike(
                e.adjoint(),
                candidate.adjoint(),
                &candidate.spread,
                &self.scales,
                3.0 * WITHIN,
            )
        })
    }

    /// Solutions at a guess's copy of its target, those that leave a guard too.
    pub(super) fn known_at(&self, candidate: &Candidate) -> impl Iterator<Item = &Extremal> {
        (self.at[candidate.target].iter())
            .map(|e| &self.extremals[*e])
            .chain(&self.cut[candidate.target])
            .filter(|e| self.windings[e.winding] == candidate.turns)
    }
}

/// Whether two adjoints agree as far as the spread within a cell lets them be told apart.
fn alike(a: &[f64], b: &[f64], spread: &[f64], scales: &[f64], within: f64) -> bool {
    let size = largest_of(scales, |i| a[i].abs().max(b[i].abs()));
    let apart = largest_of(scales, |i| a[i] - b[i]);
    apart <= within * largest_of(scales, |i| spread[i]) + ALIKE * size
}

/// Of each target the guesses that differ from each other, to be tried now; and the others.
fn choose(candidates: Vec<Candidate>, scales: &[f64]) -> (Vec<Candidate>, Vec<Candidate>) {
    let (mut now, mut later): (Vec<Candidate>, Vec<Candidate>) = (Vec::new(), Vec::new());
    let mut first = 0;
    for candidate in candidates {
        if now.get(first).is_some_and(|c| c.target != candidate.target) {
            first = now.len();
        }
        let like = |other: &Candidate| {
            other.turns == candidate.turns
                && alike(
                    other.adjoint(),
                    candidate.adjoint(),
                    &candidate.spread,
                    scales,
                    WITHIN,
                )
        };
        if now.len() - first >= MOST_AT_ONCE || now[first..].iter().any(like) {
            later.push(candidate);
        } else {
            now.push(candidate);
        }
    }
    (now, later)
}
