//! Every extremal from each of many targets, and which of them lie on one sheet.
//!
//! First guesses are rests of swept trajectories; one is tried for each sheet that the sweep shows near a target. What
//! they miss is reached from solved neighbours: each solution is continued to the targets around it, sheet by sheet,
//! as long as new ones are found. Where a sheet ends in a fold it is followed around it. Solutions that a continuation
//! joins have the same label.

use super::approach::{Approach, Unreached, follow};
use super::archive::{Archive, Index, segment_duration};
use super::conjugate::ConjugatePoints;
use super::extremal::{Extremal, is_elsewhere, misfit, same};
use super::fold::{self, Fold};
use super::targets::{Groups, Targets};
use crate::backend::BackendError;
use crate::backend::cpu::map::Evaluator;
use crate::program::Program;
use crate::shooting::{End, Failure, Path, Solved, Solver};
use crate::sweep::{Plan, guard_holds as holds};
use rayon::prelude::*;
use std::collections::{BTreeMap, HashMap, HashSet};
use std::sync::{Mutex, PoisonError};

/// Shortest steps, as shares of the way: from a swept trajectory, from a neighbour, and where nothing else has worked.
const FROM_SWEEP: f64 = 1.0 / 4.0;
const SHORT: f64 = 1.0 / 256.0;
const FROM_NEIGHBOUR: f64 = 1.0 / 32.0;
const LAST_RESORT: f64 = 1.0 / 4096.0;
/// Swept trajectories tried for a target that nothing else has led to.
const ATTEMPTS: usize = 3;
/// Swept points within this many spacings of a target show which sheets there are.
const REACH: f64 = 2.0;
/// Swept points that are looked at.
const MOST_NEAR: usize = 48;
/// Sheets over one target, and windings, that are looked for.
const MOST_SHEETS: usize = 8;
const MOST_WINDINGS: i32 = 16;
/// Ways in the shortest steps that are tried to one target.
const MOST_WAYS: usize = 4;
/// Times that what was found behind folds is followed to further folds.
const FOLD_ROUNDS: usize = 3;
/// Parts of a segment at whose ends guards are looked at.
const GUARD_PIECES: usize = 8;
/// Windings tried for a target that no swept point is near to.
const FAR_WINDINGS: usize = 3;
/// Targets looked at together.
const COHORT: usize = 4096;

/// Why a target has no solution, as a status; 0 is solved.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(i32)]
pub enum PointStatus {
    Converged = 0,
    /// The target is outside a guard.
    OutsideGuard = 1,
    /// The solution found leaves a guard on its way.
    LeavesGuard = 2,
    /// Newton's method did not converge on the way to the target.
    NotReached = 3,
    /// The sheet ends in a fold on the way to the target. Of a game: no solution without a fold along it was found.
    Fold = 4,
    /// The equations are not defined on the way to the target.
    NotFinite = 5,
    /// The trajectory does not come near the equilibrium.
    Horizon = 6,
    /// No trajectory of the sweep, nor a solved target, to start from.
    NoGuess = 7,
    /// Its V, as far as its neighbours tell, is above what is of interest: it was not tried.
    AboveMax = 8,
    /// Of a game: several sheets without a fold lie over it, none of which is the value.
    SeveralSheets = 9,
    /// Of a game: the cost is negative there, which certifies nothing.
    NegativeValue = 10,
}

impl PointStatus {
    pub const ALL: [(PointStatus, &'static str); 11] = [
        (PointStatus::Converged, "converged"),
        (PointStatus::OutsideGuard, "outside_guard"),
        (PointStatus::LeavesGuard, "leaves_guard"),
        (PointStatus::NotReached, "not_reached"),
        (PointStatus::Fold, "fold"),
        (PointStatus::NotFinite, "not_finite"),
        (PointStatus::Horizon, "horizon"),
        (PointStatus::NoGuess, "no_guess"),
        (PointStatus::AboveMax, "above_value_max"),
        (PointStatus::SeveralSheets, "several_sheets"),
        (PointStatus::NegativeValue, "negative_value"),
    ];

    pub fn name(self) -> &'static str {
        PointStatus::ALL
            .iter()
            .find(|(s, _)| *s == self)
            .map_or("?", |(_, n)| n)
    }
}

/// What is known of a target without a solution.
#[derive(Clone, Debug)]
pub struct Miss {
    pub status: PointStatus,
    /// Furthest state reached toward it (absolute), and the distance left in widths of the region.
    pub furthest: Option<Vec<f64>>,
    pub left: f64,
}

/// What a survey asks for beyond the targets.
#[derive(Clone, Copy, Debug)]
pub struct Wanted {
    /// Extremals are continued up to this V (to a target that has none, regardless).
    pub value_max: f64,
    /// Whether all sheets are looked for, or one solution a target is enough.
    pub sheets: bool,
}

/// A fold's singular value, relative to that where the way began, below which a failure counts as a fold.
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
    /// Of a game with an equilibrium the extremal at each target on the sheet of the equilibrium; else empty.
    pub principal: Vec<Option<usize>>,
    pub folds: Vec<Fold>,
    /// Label of each extremal's sheet: 0 is that of the least V.
    pub sheet: Vec<i32>,
    pub evaluations: u64,
    pub(super) groups: Groups,
    pub(super) scales: Vec<f64>,
    duration: f64,
    guards: Option<(Evaluator, Vec<bool>)>,
    /// In a game, where extremals with a fold along them are none.
    /// (Locked only so that a survey may be read by several threads.)
    conjugate: Option<Mutex<ConjugatePoints>>,
}

/// Told what is done and how many targets are solved of how many.
pub type Progress<'p> = &'p mut dyn FnMut(&str, usize, usize);

/// A way to try: from which extremal (if any), to which target and winding.
struct Errand {
    from: Option<usize>,
    target: usize,
    winding: usize,
    way: Approach,
}

impl<'a> Survey<'a> {
    /// # Errors
    /// When a kernel cannot be compiled.
    pub fn new(plan: &'a Plan, targets: &'a Targets, solver: &Solver) -> Result<Self, BackendError> {
        let guards = (!plan.system.guards.is_empty()).then(|| {
            let exprs: Vec<_> = plan.system.guards.iter().map(|g| g.expr).collect();
            let program = Program::lower(&plan.system.graph, &plan.system.inputs, &exprs);
            let strict = plan.system.guards.iter().map(|g| g.strict).collect();
            (Evaluator::new(&program), strict)
        });
        Ok(Self {
            plan,
            targets,
            extremals: Vec::new(),
            at: vec![Vec::new(); targets.len()],
            windings: Vec::new(),
            misses: vec![None; targets.len()],
            principal: Vec::new(),
            folds: Vec::new(),
            sheet: Vec::new(),
            evaluations: 0,
            groups: Groups::default(),
            scales: solver.scheme.equations.scales.clone(),
            duration: segment_duration(plan),
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
        wanted: Wanted,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        let index = self.index(archive);
        self.windings = self.all_windings(&index);
        self.near_end(solver);
        self.refuse_outside();
        super::march::add_marched(self, solver)?;
        if self.plan.game && self.plan.local.is_some() {
            return self.principal_sheet(solver, archive, &index, wanted, progress);
        }
        let order: Vec<usize> = (0..self.targets.len()).collect();
        for part in order.chunks(COHORT) {
            self.swept(solver, archive, &index, part, wanted)?;
            progress("from the sweep", self.solved(), self.targets.len());
        }
        // The hard ones together in short steps: many at once cost little more than one.
        let open = self.hopeful();
        let errands = self.nearest_guesses(&solver.scheme.end, archive, &index, &open, 0, SHORT);
        self.send(solver, errands)?;
        self.spread(solver, wanted, FROM_NEIGHBOUR, progress)?;
        self.last_resort(solver, archive, &index, wanted, progress)?;
        // Nothing behind a fold counts in a game.
        if wanted.sheets && !self.plan.game {
            self.around_folds(solver, wanted, progress)?;
        }
        self.label();
        Ok(())
    }

    /// Of a game with an equilibrium: the sheet of the equilibrium, continued along the straight line to each target as long
    /// as it does not fold, and what other sheets the sweep shows there.
    fn principal_sheet(
        &mut self,
        solver: &mut Solver,
        archive: &Archive,
        index: &Index,
        wanted: Wanted,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        self.principal = self.at.iter().map(|list| list.first().copied()).collect();
        let open: Vec<usize> = (0..self.targets.len()).filter(|t| self.is_open(*t)).collect();
        for part in open.chunks(COHORT) {
            // Where Newton's method fails for another reason than a fold, shorter steps may do.
            for longest in [1.0 / 8.0, 1.0 / 64.0] {
                let left: Vec<usize> = (part.iter().copied())
                    .filter(|t| self.principal[*t].is_none() && !self.missed_by(*t, PointStatus::Fold))
                    .collect();
                let errands = self.rays(&solver.scheme.end, &left, longest);
                for (target, reached) in self.send(solver, errands)? {
                    self.principal[target] = reached;
                }
            }
            progress("from the equilibrium", self.solved(), self.targets.len());
        }
        let reached: Vec<usize> = self.principal.iter().flatten().copied().collect();
        for pair in reached.windows(2) {
            self.groups.join(pair[0], pair[1]);
        }
        if wanted.sheets {
            let misses = self.misses.clone();
            let all: Vec<usize> = (0..self.targets.len()).filter(|t| !self.is_refused(*t)).collect();
            for part in all.chunks(COHORT) {
                self.swept(solver, archive, index, part, wanted)?;
            }
            // What is found beside a principal sheet that ends does not make up for it.
            self.misses = misses;
        }
        self.label();
        Ok(())
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

    /// A target's state with a winding, as a deviation.
    pub fn state(&self, target: usize, winding: usize) -> Vec<f64> {
        let (x, reference) = (self.targets.state(target), &self.plan.system.reference);
        (0..x.len())
            .map(|i| {
                let turns =
                    f64::from(self.windings[winding][i] + self.base(target, i)) * self.plan.periods[i].unwrap_or(0.0);
                x[i] - reference[i] + turns
            })
            .collect()
    }

    /// Periods that bring a target far outside the region back near it: windings count from there.
    pub fn base(&self, target: usize, i: usize) -> i32 {
        let Some(period) = self.plan.periods[i] else { return 0 };
        let s = self.targets.state(target)[i] - self.plan.system.reference[i];
        let [lo, hi] = self.plan.region[i];
        if s >= lo - period && s <= hi + period {
            return 0;
        }
        (((0.5 * (lo + hi) - s) / period).round()).clamp(-1e9, 1e9) as i32
    }

    /// Whether windings of two targets count from the same place.
    fn same_base(&self, a: usize, b: usize) -> bool {
        (0..self.targets.states).all(|i| self.base(a, i) == self.base(b, i))
    }

    fn scaled(&self, s: &[f64]) -> Vec<f64> {
        s.iter().zip(&self.plan.widths).map(|(s, w)| s / w).collect()
    }

    /// An index of the swept points near the targets.
    fn index(&self, archive: &Archive) -> Index {
        let (plan, n) = (self.plan, self.targets.states);
        let bounds: Vec<[f64; 2]> = (0..n)
            .map(|i| {
                if plan.periodic[i] {
                    return [f64::NEG_INFINITY, f64::INFINITY];
                }
                let along = self.targets.x.iter().skip(i).step_by(n);
                let margin = REACH * plan.shoot_out.spacing * plan.widths[i];
                let [lo, hi] = along.fold([f64::INFINITY, f64::NEG_INFINITY], |[lo, hi], x| {
                    [lo.min(*x), hi.max(*x)]
                });
                // Nothing may lie near targets outside the sweep's reach: then the region's points are all there is.
                let [region_lo, region_hi] = plan.region[i];
                let lo = (lo - plan.system.reference[i] - margin).min(region_hi);
                let hi = (hi - plan.system.reference[i] + margin).max(region_lo);
                [lo, hi]
            })
            .collect();
        let near = Index::new(archive, &plan.widths, &bounds, plan.shoot_out.spacing);
        if !near.is_empty() {
            return near;
        }
        let all = vec![[f64::NEG_INFINITY, f64::INFINITY]; n];
        Index::new(archive, &plan.widths, &all, plan.shoot_out.spacing)
    }

    /// All windings by which a target may come near a swept point: none first, then by distance.
    fn all_windings(&self, index: &Index) -> Vec<Vec<i32>> {
        let n = self.targets.states;
        let mut all: Vec<Vec<i32>> = vec![Vec::new()];
        for i in 0..n {
            let mut turns = vec![0];
            if let Some(period) = self.plan.periods[i] {
                let along = |t: usize| {
                    let turns = f64::from(self.base(t, i)) * period;
                    self.targets.state(t)[i] - self.plan.system.reference[i] + turns
                };
                let lo = (0..self.targets.len()).map(along).fold(f64::INFINITY, f64::min);
                let hi = (0..self.targets.len()).map(along).fold(f64::NEG_INFINITY, f64::max);
                let [least, most] = index.extent.get(i).copied().unwrap_or([0.0, 0.0]);
                let width = self.plan.widths[i];
                for k in (1..=MOST_WINDINGS).flat_map(|k| [-k, k]) {
                    let shift = f64::from(k) * period;
                    // A sheet goes on beyond where it was swept.
                    let beyond = 0.5 * period;
                    if lo + shift <= most * width + beyond && hi + shift >= least * width - beyond {
                        turns.push(k);
                    }
                }
            }
            all = (all.iter())
                .flat_map(|w| turns.iter().map(|k| [w.as_slice(), &[*k]].concat()))
                .collect();
        }
        all.sort_by_key(|w| w.iter().map(|k| k.abs()).sum::<i32>());
        all
    }

    /// Targets so near the equilibrium that the local solution answers.
    fn near_end(&mut self, solver: &Solver) {
        for target in 0..self.targets.len() {
            for winding in 0..self.windings.len() {
                let s = self.state(target, winding);
                if !solver.scheme.end.covers(&s) {
                    continue;
                }
                let at = solver.scheme.end.at(&s);
                let slope = solver.scheme.equations.scaled_slope(&at.hessian);
                let solved = Solved {
                    value: at.value,
                    slope: Some(slope),
                    fold: 1.0,
                    residual: 0.0,
                    t: 0.0,
                };
                let path = Path::new(&[s.as_slice(), &at.gradient].concat());
                self.add(Extremal {
                    target,
                    winding,
                    path,
                    solved,
                    iterations: 0,
                });
            }
        }
    }

    fn refuse_outside(&mut self) {
        for target in 0..self.targets.len() {
            let s = self.state(target, 0);
            let node = [s.as_slice(), &vec![0.0; s.len()]].concat();
            if self.at[target].is_empty() && !self.inside(&node) {
                self.misses[target] = Some(Miss {
                    status: PointStatus::OutsideGuard,
                    furthest: None,
                    left: f64::NAN,
                });
            }
        }
    }

    /// Whether a target still needs a solution.
    fn is_open(&self, target: usize) -> bool {
        self.at[target].is_empty() && !self.is_refused(target)
    }

    fn is_refused(&self, target: usize) -> bool {
        self.missed_by(target, PointStatus::OutsideGuard)
    }

    fn missed_by(&self, target: usize, status: PointStatus) -> bool {
        self.misses[target].as_ref().is_some_and(|m| m.status == status)
    }

    /// Targets that still need a solution, and may have one: behind a fold there is none in a game.
    fn hopeful(&self) -> Vec<usize> {
        let behind = |t: usize| self.plan.game && self.missed_by(t, PointStatus::Fold);
        (0..self.targets.len())
            .filter(|t| self.is_open(*t) && !behind(*t))
            .collect()
    }

    /// Whether all nodes are inside the guards, but for rounding.
    fn inside(&self, nodes: &[f64]) -> bool {
        let Some((guards, strict)) = &self.guards else {
            return true;
        };
        const ROUNDING: f64 = 1e-9;
        let (n, width) = (self.targets.states, 2 * self.targets.states);
        let values = guards.eval(nodes, width);
        nodes
            .chunks(width)
            .zip(values.chunks(strict.len()))
            .all(|(node, values)| {
                values.iter().enumerate().all(|(g, v)| {
                    if holds(*v, strict[g]) {
                        return true;
                    }
                    // On the boundary rounding decides: a state a little to either side will do.
                    (0..2 * n).any(|q| {
                        let mut moved = node.to_vec();
                        let step = ROUNDING * self.scales[q / 2];
                        moved[q / 2] += if q % 2 == 0 { step } else { -step };
                        holds(guards.eval(&moved, width)[g], strict[g])
                    })
                })
            })
    }

    /// What is wrong with trajectories, if anything: that they leave a guard, or in a game that they have a fold.
    fn wrong(&mut self, solver: &mut Solver, paths: &[&Path]) -> Result<Vec<Option<PointStatus>>, BackendError> {
        let guarded = self.valid(solver, paths)?.into_iter();
        let mut wrong: Vec<_> = guarded.map(|v| (!v).then_some(PointStatus::LeavesGuard)).collect();
        if let Some(conjugate) = &mut self.conjugate {
            let conjugate = conjugate.get_mut().unwrap_or_else(PoisonError::into_inner);
            for (wrong, regular) in wrong.iter_mut().zip(conjugate.absent(paths)?) {
                *wrong = wrong.or((!regular).then_some(PointStatus::Fold));
            }
        }
        Ok(wrong)
    }

    /// Whether trajectories stay inside the guards, at their nodes and between them.
    pub(super) fn valid(&self, solver: &mut Solver, paths: &[&Path]) -> Result<Vec<bool>, BackendError> {
        if self.guards.is_none() {
            return Ok(vec![true; paths.len()]);
        }
        let between = solver.between_nodes(paths, GUARD_PIECES)?;
        Ok((paths.iter().zip(between))
            .map(|(path, between)| self.inside(&path.nodes) && self.inside(&between))
            .collect())
    }

    /// Adds an extremal unless it is known; its index, and whether it is new.
    pub(super) fn add(&mut self, extremal: Extremal) -> (usize, bool) {
        let known = self.at[extremal.target].iter().copied().find(|e| {
            let other = &self.extremals[*e];
            other.winding == extremal.winding && same(other.adjoint(), extremal.adjoint(), &self.scales)
        });
        if let Some(known) = known {
            return (known, false);
        }
        let index = self.extremals.len();
        self.at[extremal.target].push(index);
        self.misses[extremal.target] = None;
        self.extremals.push(extremal);
        self.groups.push();
        (index, true)
    }

    /// Follows errands, and joins what they find to what they came from. Of each its target, and the extremal there if it was
    /// reached.
    fn send(&mut self, solver: &mut Solver, errands: Vec<Errand>) -> Result<Vec<(usize, Option<usize>)>, BackendError> {
        let (mut ways, rest): (Vec<Approach>, Vec<_>) = (errands.into_iter())
            .map(|e| (e.way, (e.from, e.target, e.winding)))
            .unzip();
        follow(solver, &mut ways)?;
        let finished: Vec<_> = ways.into_iter().map(Approach::finish).collect();
        let paths = finished
            .iter()
            .filter_map(|(_, outcome)| outcome.as_ref().ok().map(|(job, _)| &job.path));
        let mut wrong = self.wrong(solver, &paths.collect::<Vec<_>>())?.into_iter();
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
                            self.groups.join(from, index);
                        }
                        reached.pop();
                        reached.push((target, Some(index)));
                    }
                    Some(status) => {
                        let at = self.targets.state(target).to_vec();
                        self.miss(target, status, Some(at), 0.0);
                    }
                },
                Err(unreached) => {
                    self.unreached(from, target, winding, &unreached);
                }
            }
        }
        Ok(reached)
    }

    /// Notes how far the way to a target led, if that is further than before.
    fn unreached(&mut self, from: Option<usize>, target: usize, winding: usize, unreached: &Unreached) {
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
        // Compared with where the way began; a guess from the sweep is no solution, and what is usual stands for it.
        let began = from.map_or_else(|| self.usual_fold(), |e| self.extremals[e].solved.fold);
        let ended = unreached.job.as_ref().and_then(|j| j.solved()).map(|s| s.fold);
        let status = match unreached.failure {
            Failure::NotFinite => PointStatus::NotFinite,
            Failure::Horizon => PointStatus::Horizon,
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
    fn usual_fold(&self) -> f64 {
        let mut all: Vec<f64> = self.extremals.iter().map(|e| e.solved.fold).collect();
        let middle = all.len() / 2;
        if all.is_empty() {
            return 0.0;
        }
        *all.select_nth_unstable_by(middle, f64::total_cmp).1
    }

    fn miss(&mut self, target: usize, status: PointStatus, furthest: Option<Vec<f64>>, left: f64) {
        let better = self.misses[target]
            .as_ref()
            .is_none_or(|m| m.furthest.is_none() || left < m.left);
        if better && self.at[target].is_empty() {
            self.misses[target] = Some(Miss { status, furthest, left });
        }
    }

    /// Solves targets from the swept points near them.
    fn swept(
        &mut self,
        solver: &mut Solver,
        archive: &Archive,
        index: &Index,
        targets: &[usize],
        wanted: Wanted,
    ) -> Result<(), BackendError> {
        let reach = REACH * self.plan.shoot_out.spacing;
        let first = self.first_guesses(&solver.scheme.end, archive, index, targets, reach, wanted);
        self.send(solver, first)?;
        if !wanted.sheets {
            return Ok(());
        }
        for _ in 1..MOST_SHEETS {
            let further = self.further_guesses(&solver.scheme.end, archive, index, targets, reach);
            if further.is_empty() {
                break;
            }
            let before = self.extremals.len();
            self.send(solver, further)?;
            if self.extremals.len() == before {
                break;
            }
        }
        Ok(())
    }

    /// One guess for each winding that has a swept point near the target; at least one.
    fn first_guesses(
        &self,
        end: &End,
        archive: &Archive,
        index: &Index,
        targets: &[usize],
        reach: f64,
        wanted: Wanted,
    ) -> Vec<Errand> {
        let open = targets
            .par_iter()
            .filter(|t| !self.is_refused(**t) && self.at[**t].is_empty());
        open.flat_map_iter(|&target| {
            let mut near: Vec<(usize, _, f64)> = (0..self.windings.len())
                .filter_map(|winding| {
                    let place = self.scaled(&self.state(target, winding));
                    let (place, distance) = index.near(&place, 0.0, 1).first().copied()?;
                    Some((winding, place, distance))
                })
                .collect();
            near.sort_by(|a, b| a.2.total_cmp(&b.2));
            let all = wanted.sheets;
            let anyhow = self.targets.limits[target] == f64::INFINITY;
            near.into_iter()
                .enumerate()
                .filter(move |(k, (_, _, distance))| {
                    let tried = *k == 0 || (all && *k < FAR_WINDINGS);
                    (tried && anyhow) || ((*k == 0 || all) && *distance <= reach)
                })
                .map(|(_, (winding, place, distance))| {
                    // Nothing near tells which sheets there are: each winding's is followed all the way.
                    let least = if distance > reach && anyhow { SHORT } else { FROM_SWEEP };
                    self.errand(end, archive, target, winding, place, least)
                })
                .collect::<Vec<_>>()
        })
        .collect()
    }

    fn errand(
        &self,
        end: &End,
        archive: &Archive,
        target: usize,
        winding: usize,
        place: super::archive::Place,
        least: f64,
    ) -> Errand {
        let path = archive.path(place, end, archive.value(place), self.duration);
        Errand {
            from: None,
            target,
            winding,
            way: Approach::new(path, self.state(target, winding), least),
        }
    }

    /// Guesses from swept points near targets that lie on none of the sheets known there.
    fn further_guesses(
        &self,
        end: &End,
        archive: &Archive,
        index: &Index,
        targets: &[usize],
        reach: f64,
    ) -> Vec<Errand> {
        let solved = targets.par_iter().filter(|t| !self.at[**t].is_empty());
        solved
            .flat_map_iter(|&target| {
                (0..self.windings.len()).filter_map(move |winding| {
                    let known: Vec<&Extremal> = (self.at[target].iter())
                        .map(|e| &self.extremals[*e])
                        .filter(|e| e.winding == winding)
                        .collect();
                    if known.is_empty() || known.len() >= MOST_SHEETS {
                        return None;
                    }
                    let place = self.scaled(&self.state(target, winding));
                    let near = index.near(&place, reach, MOST_NEAR);
                    let (place, _) = (near.into_iter()).find(|(place, distance)| {
                        let node = archive.node(*place);
                        *distance <= reach && known.iter().all(|e| is_elsewhere(e, &node, &self.scales))
                    })?;
                    Some(self.errand(end, archive, target, winding, place, FROM_SWEEP))
                })
            })
            .collect()
    }

    /// Continues every extremal to the neighbours of its target, as long as that gives new ones.
    pub(super) fn spread(
        &mut self,
        solver: &mut Solver,
        wanted: Wanted,
        least: f64,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        let neighbours = self.targets.neighbours();
        // Ways that were followed, from an extremal to a target: once is enough.
        let mut gone: HashSet<(usize, usize)> = HashSet::new();
        let mut ways_to: HashMap<usize, usize> = HashMap::new();
        loop {
            let mut errands: BTreeMap<(usize, usize), (f64, Errand)> = BTreeMap::new();
            for e in 0..self.extremals.len() {
                let (target, winding) = (self.extremals[e].target, self.extremals[e].winding);
                for &to in &neighbours[target] {
                    if self.is_refused(to) || gone.contains(&(e, to)) || !self.same_base(target, to) {
                        continue;
                    }
                    let tried = ways_to.get(&to).copied().unwrap_or(0);
                    if least == LAST_RESORT && (tried >= MOST_WAYS || self.targets.limits[to] < f64::INFINITY) {
                        continue;
                    }
                    if self.joins(e, to) {
                        continue;
                    }
                    if !self.wants(e, to, wanted) {
                        continue;
                    }
                    // One way a sheet and target at a time: the shortest.
                    let root = self.groups.root(e);
                    let goal = self.state(to, winding);
                    let path = &self.extremals[e].path;
                    let far = (goal.iter().zip(path.start()).zip(&self.plan.widths))
                        .map(|((g, s), w)| ((g - s) / w).powi(2))
                        .sum::<f64>();
                    if errands.get(&(to, root)).is_none_or(|(shortest, _)| far < *shortest) {
                        let errand = Errand {
                            from: Some(e),
                            target: to,
                            winding,
                            way: Approach::from_solution(path.clone(), goal, least),
                        };
                        errands.insert((to, root), (far, errand));
                    }
                }
            }
            if errands.is_empty() {
                return Ok(());
            }
            let errands: Vec<Errand> = errands.into_values().map(|(_, e)| e).collect();
            for errand in &errands {
                // Where a way leads nowhere, or to what is known, there is nothing left to do.
                gone.extend(errand.from.map(|from| (from, errand.target)));
                *ways_to.entry(errand.target).or_insert(0) += 1;
            }
            self.send(solver, errands)?;
            progress("from neighbours", self.solved(), self.targets.len());
        }
    }

    /// Whether an extremal is to be continued to a neighbouring target.
    fn wants(&self, e: usize, to: usize, wanted: Wanted) -> bool {
        let extremal = &self.extremals[e];
        if self.at[to].is_empty() {
            let (from, goal) = (extremal.path.start(), self.state(to, extremal.winding));
            let change: f64 = (0..goal.len())
                .map(|i| extremal.adjoint()[i] * (goal[i] - from[i]))
                .sum();
            return extremal.value() + change.min(0.0) <= self.targets.limits[to];
        }
        if self.at[to].len() >= MOST_SHEETS {
            return false;
        }
        // The cheapest are joined to each other however much they cost, so that their labels agree.
        wanted.sheets && (extremal.value() <= wanted.value_max || self.lowest(extremal.target) == Some(e))
    }

    /// Whether an extremal fits one at a neighbouring target, and joins them.
    fn joins(&mut self, e: usize, to: usize) -> bool {
        let root = self.groups.root(e);
        let mut best: Option<(f64, usize)> = None;
        for q in 0..self.at[to].len() {
            let other = self.at[to][q];
            if self.extremals[other].winding != self.extremals[e].winding {
                continue;
            }
            if self.groups.root(other) == root {
                return true;
            }
            let m = misfit(&self.extremals[e], &self.extremals[other], &self.scales);
            if best.is_none_or(|(b, _)| m < b) {
                best = Some((m, other));
            }
        }
        match best {
            Some((m, other)) if m < 1.0 => {
                self.groups.join(e, other);
                true
            }
            _ => false,
        }
    }

    /// Targets still without a solution, in the shortest steps: from neighbours, from the swept points nearest to them,
    /// and from what that has given.
    fn last_resort(
        &mut self,
        solver: &mut Solver,
        archive: &Archive,
        index: &Index,
        wanted: Wanted,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        let only = Wanted {
            sheets: false,
            ..wanted
        };
        for attempt in 0..=ATTEMPTS {
            let open = self.hopeful();
            if open.is_empty() {
                return Ok(());
            }
            self.spread(solver, only, LAST_RESORT, progress)?;
            if attempt == 0 {
                let errands = self.linear_guesses(&solver.scheme.end, &open, LAST_RESORT);
                self.send(solver, errands)?;
            }
            if attempt < ATTEMPTS {
                let errands = self.nearest_guesses(&solver.scheme.end, archive, index, &open, attempt, LAST_RESORT);
                self.send(solver, errands)?;
                progress("in short steps", self.solved(), self.targets.len());
            }
        }
        for target in 0..self.targets.len() {
            if self.at[target].is_empty() && self.misses[target].is_none() {
                let limited = self.targets.limits[target] < f64::INFINITY;
                let status = if limited {
                    PointStatus::AboveMax
                } else {
                    PointStatus::NoGuess
                };
                self.miss(target, status, None, f64::INFINITY);
            }
        }
        Ok(())
    }

    /// Guesses that follow the linear closed loop, from a state on the way to the target near which it holds.
    fn linear_guesses(&self, end: &End, targets: &[usize], least: f64) -> Vec<Errand> {
        let open = targets
            .iter()
            .filter(|t| self.is_open(**t) && self.targets.limits[**t] == f64::INFINITY);
        open.filter_map(|&target| {
            let (path, goal) = self.linear_path(end, target)?;
            Some(Errand {
                from: None,
                target,
                winding: 0,
                way: Approach::new(path, goal, least),
            })
        })
        .collect()
    }

    /// Straight ways from the local solution to targets.
    fn rays(&self, end: &End, targets: &[usize], longest: f64) -> Vec<Errand> {
        // Of the distance from the equilibrium where the way begins.
        const SHORTEST: f64 = 1.0 / 64.0;
        let near = self.plan.local.as_ref().map_or(0.0, |l| l.seed_value);
        let ray = |&target: &usize| {
            let goal = self.state(target, 0);
            let share = self
                .plan
                .local
                .as_ref()
                .map(|l| (near / l.quadratic(&goal)).sqrt().min(1.0))?;
            let s: Vec<f64> = goal.iter().map(|g| share * g).collect();
            let at = end.at(&s);
            let mut path = Path::new(&[s.as_slice(), &at.gradient].concat());
            let (nodes, durations) = end.tail(&s, at.value, self.duration);
            path.append(&nodes, &durations);
            Some(Errand {
                from: None,
                target,
                winding: 0,
                way: Approach::along(path, goal, SHORT.min(SHORTEST * share), longest),
            })
        };
        targets.iter().filter_map(ray).collect()
    }

    /// A path of the linear closed loop from a state on the way to a target near which it holds; with the target's state.
    fn linear_path(&self, end: &End, target: usize) -> Option<(Path, Vec<f64>)> {
        let goal = self.state(target, 0);
        let (value, _) = end.linear(&goal)?;
        let near = self.plan.local.as_ref().map_or(0.0, |l| l.seed_value);
        let share = (near / value).sqrt().min(1.0);
        let s: Vec<f64> = goal.iter().map(|g| share * g).collect();
        let (value, p) = end.linear(&s)?;
        let mut path = Path::new(&[s.as_slice(), &p].concat());
        let (nodes, durations) = end.tail(&s, value, self.duration);
        path.append(&nodes, &durations);
        Some((path, goal))
    }

    /// For each target the swept trajectory that is the `attempt`-th nearest to it.
    fn nearest_guesses(
        &self,
        end: &End,
        archive: &Archive,
        index: &Index,
        targets: &[usize],
        attempt: usize,
        least: f64,
    ) -> Vec<Errand> {
        let open = targets
            .par_iter()
            .filter(|t| self.at[**t].is_empty() && self.targets.limits[**t] == f64::INFINITY);
        open.filter_map(|&target| {
            let mut near: Vec<(usize, _, f64)> = (0..self.windings.len())
                .flat_map(|winding| {
                    let place = self.scaled(&self.state(target, winding));
                    let near = index.near(&place, f64::INFINITY, MOST_NEAR);
                    near.into_iter()
                        .map(move |(place, distance)| (winding, place, distance))
                })
                .collect();
            near.sort_by(|a, b| a.2.total_cmp(&b.2));
            let mut trajectories: Vec<usize> = Vec::new();
            let (winding, place, _) = near.into_iter().find(|(_, place, _)| {
                if trajectories.contains(&place.trajectory) {
                    return false;
                }
                trajectories.push(place.trajectory);
                trajectories.len() == attempt + 1
            })?;
            Some(self.errand(end, archive, target, winding, place, least))
        })
        .collect()
    }

    /// Follows sheets around the folds in which they end between neighbours, and what is found there on from there.
    fn around_folds(
        &mut self,
        solver: &mut Solver,
        wanted: Wanted,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        let neighbours = self.targets.neighbours();
        let mut tried: HashSet<(usize, usize)> = HashSet::new();
        for _ in 0..FOLD_ROUNDS {
            let mut ways = Vec::new();
            for e in 0..self.extremals.len() {
                let from = self.extremals[e].target;
                if self.extremals[e].value() > wanted.value_max {
                    continue;
                }
                for &to in &neighbours[from] {
                    if !self.is_refused(to)
                        && self.same_base(from, to)
                        && !tried.contains(&(e, to))
                        && !self.joins(e, to)
                    {
                        tried.insert((e, to));
                        ways.push((e, to));
                    }
                }
            }
            if ways.is_empty() {
                return Ok(());
            }
            let before = self.extremals.len();
            let starts: Vec<fold::Edge> = (ways.iter())
                .map(|(e, to)| fold::Edge {
                    path: self.extremals[*e].path.clone(),
                    to: self.state(*to, self.extremals[*e].winding),
                })
                .collect();
            for ((e, to), found) in ways.into_iter().zip(fold::around(solver, starts)?) {
                self.evaluations += u64::from(found.evaluations);
                let winding = self.extremals[e].winding;
                for (target, end) in [(self.extremals[e].target, found.at_start), (to, found.at_end)] {
                    let Some((job, solved)) = end else { continue };
                    if !self.valid(solver, &[&job.path])?[0] || solved.value > wanted.value_max {
                        continue;
                    }
                    let (index, _) = self.add(Extremal {
                        target,
                        winding,
                        path: job.path,
                        solved,
                        iterations: found.evaluations,
                    });
                    // Without a fold between, the sheet goes on.
                    if found.folds.is_empty() {
                        self.groups.join(e, index);
                    }
                }
                self.folds.extend(found.folds);
            }
            progress("around folds", self.solved(), self.targets.len());
            if self.extremals.len() == before {
                return Ok(());
            }
            self.spread(solver, wanted, FROM_NEIGHBOUR, progress)?;
        }
        Ok(())
    }

    /// Numbers the sheets by their least V.
    pub(super) fn label(&mut self) {
        let mut least: BTreeMap<usize, (f64, usize)> = BTreeMap::new();
        for e in 0..self.extremals.len() {
            let root = self.groups.root(e);
            let this = (self.extremals[e].value(), self.extremals[e].target);
            let entry = least.entry(root).or_insert(this);
            if this < *entry {
                *entry = this;
            }
        }
        let mut order: Vec<(usize, (f64, usize))> = least.into_iter().collect();
        order.sort_by(|a, b| a.1.0.total_cmp(&b.1.0).then(a.1.1.cmp(&b.1.1)));
        let number: HashMap<usize, i32> = order
            .iter()
            .enumerate()
            .map(|(k, (root, _))| (*root, k as i32))
            .collect();
        self.sheet = (0..self.extremals.len())
            .map(|e| number[&self.groups.root(e)])
            .collect();
    }
}
