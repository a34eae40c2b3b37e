//! V, p and u at the targets of a scene: grids and single states, from the sweep to the answers.

use super::archive::Archive;
use super::cover::Cover;
use super::direct::Direct;
use super::equal_cost::BoundaryPoint;
use super::fold::Fold;
use super::survey::{
    BEYOND, GridGuesses, Mesh, Miss, PointStatus, Progress, Support, Survey, Wanted,
};
use super::targets::{Grid, Targets};
use crate::backend::cpu::Cpu;
use crate::backend::{Backend, BackendError, Deadline};
use crate::dynamic_programming::{self, Device, GridValue, Options};
use crate::expr::Id;
use crate::hamiltonian::Hamiltonian;
use crate::model::{GridAxis, Homotopy, MapGrid, Model, Precision};
use crate::shooting::{End, Equations, Path, Scheme, Solver, Work};
use crate::sweep::{Choices, Plan};
use std::sync::mpsc::channel;
use std::sync::{Arc, OnceLock};

/// Tolerance of the answers where the scene asks for less: they are of use as f64 numbers.
pub(super) const MOST_RTOL: f64 = 1e-9;
/// Segments are integrated to this share of it.
const SEGMENT_SHARE: f64 = 0.1;
/// Tolerance of segments on a finite horizon. V there has no other error: that of the last
/// correction is of second order, and there is no local solution at the end.
const FINITE_RTOL: f64 = 1e-12;
/// Smallest tolerance of segments.
const LEAST_RTOL: f64 = 1e-13;
/// Variation components that a lane of the CPU or an invocation of a GPU carries: more are slower,
/// as their stages do not fit the nearest memory, and leave lanes idle in small batches.
const VARIATIONS: usize = 16;
/// Fold points nearer than this, in scaled units, are one.
const SAME_FOLD: f64 = 1e-5;
/// Newton's tolerance on a device in single precision, and the one of its segments.
const DRAFT_TOLERANCE: f64 = 1e-4;
const DRAFT_RTOL: f64 = 1e-5;

/// States from which on a surface of seeds has thousands of simplices before the first trajectory.
const MANY_STATES: usize = 7;

/// What to solve for.
#[derive(Clone, Debug, Default)]
pub struct Request {
    /// Grids, in the order of the answers.
    pub grids: Vec<Grid>,
    /// V up to which each grid is of interest.
    pub limits: Vec<f64>,
    /// Single states `[point][n]`.
    pub points: Vec<f64>,
    /// Single states are one another's neighbours, and searched for as points of a grid are:
    /// without flights of their own.
    pub in_company: bool,
    /// One solution a target is enough: no search for other sheets.
    pub one_sheet: bool,
    /// V up to which sheets are continued; `None`: the scene's, or a little beyond the sweep.
    pub value_max: Option<f64>,
    /// V on a grid, whose greedy paths are tried as first guesses too.
    pub grid: Option<Arc<GridValue>>,
    /// At the solver's deadline what is found is an answer, and the other targets are out of time;
    /// else it is an error.
    pub partial: bool,
}

/// A solution at a point.
#[derive(Clone, Debug)]
pub struct Entry {
    pub target: usize,
    pub sheet: i32,
    /// The same where copies of a sheet by whole periods have one number.
    pub lifted: i32,
    pub winding: Vec<i32>,
    pub value: f64,
    pub p: Vec<f64>,
    pub u: Vec<f64>,
    pub w: Vec<f64>,
    pub hamiltonian: f64,
    pub iterations: u32,
    /// The last correction relative to the trajectory's size.
    pub residual: f64,
    /// `dp/dx` (row-major), where it exists; and how far from a fold it is: 0 on one, at most 1.
    pub slope: Option<Vec<f64>>,
    pub fold: f64,
    /// The trajectory.
    pub path: Path,
}

/// Where two sheets cost the same, with the controls on both.
#[derive(Clone, Debug)]
pub struct EqualCost {
    pub point: BoundaryPoint,
    pub u: [Vec<f64>; 2],
}

impl EqualCost {
    /// Gives its sheets other numbers.
    pub fn renumber(&mut self, number: impl Fn(i32) -> i32) {
        if self.point.renumbered(number) {
            self.u.swap(0, 1);
        }
    }
}

/// What supports that an answer is the least.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(i32)]
pub enum Evidence {
    /// There is no answer, or it is the answer of a game.
    None = 0,
    /// Every cell of the swept manifold over the state was followed up to the answer's cost: at
    /// that resolution there is no cheaper extremal.
    Covered = 1,
    /// Nothing that was tried costs less.
    NotUndercut = 2,
    /// A control that was flown costs less.
    Undercut = 3,
}

impl Evidence {
    pub const ALL: [(Evidence, &'static str); 4] = [
        (Evidence::None, "none"),
        (Evidence::Covered, "covered"),
        (Evidence::NotUndercut, "not_undercut"),
        (Evidence::Undercut, "undercut"),
    ];

    pub fn name(self) -> &'static str {
        Evidence::ALL
            .iter()
            .find(|(e, _)| *e == self)
            .map_or("?", |(_, n)| n)
    }
}

/// What was found.
#[derive(Clone, Default)]
pub struct Answers {
    /// Whether H is `min max`, and the cheapest of several sheets is not the answer (see
    /// [`Self::answer`]).
    pub game: bool,
    /// Whether the search was ended before it was done: then nothing shows that an answer is the
    /// least.
    pub stopped: bool,
    /// Whether that of each target was; without any, of none.
    pub cut: Vec<bool>,
    /// Of a game with an equilibrium the entry at each target on the sheet of the equilibrium.
    pub principal: Option<Vec<Option<usize>>>,
    pub targets: Targets,
    /// Whether there are too many sheets to be followed over the states.
    pub is_crowded: bool,
    /// All solutions, by target, then by V.
    pub entries: Vec<Entry>,
    /// First entry of each target, and the end.
    pub first: Vec<usize>,
    pub misses: Vec<Option<Miss>>,
    /// What supports that the answer at each target is the least.
    pub support: Vec<Support>,
    /// Trajectories that the search integrated.
    pub searched: usize,
    pub equal_cost: Vec<EqualCost>,
    /// States absolute.
    pub folds: Vec<Fold>,
    pub sheets: usize,
    /// The same where copies by whole periods count as one.
    pub lifted: usize,
    pub evaluations: u64,
    pub work: Work,
    pub seconds: f64,
}

impl Answers {
    /// The guard that a target's trajectory leaves, or that the target itself is outside of: the one
    /// with the least margin, as a share of its size along the trajectory. `None` where no guard is
    /// why it was not solved, and where several hold at all nodes: one of them is left between two.
    pub fn guard_left<'m>(&self, model: &'m Model, target: usize) -> Option<&'m str> {
        let miss = self.misses[target].as_ref()?;
        let n = model.states.len();
        let states: Vec<Vec<f64>> = match miss.status {
            PointStatus::OutsideGuard => vec![self.targets.state(target).to_vec()],
            PointStatus::LeavesGuard => {
                let path = miss.cut.as_ref()?;
                let absolute = |node: &[f64]| -> Vec<f64> {
                    let deviations = node[..n].iter().zip(model.reference());
                    deviations.map(|(s, reference)| s + reference).collect()
                };
                path.nodes.chunks(path.width).map(absolute).collect()
            }
            _ => return None,
        };
        let share = |condition: Id| -> f64 {
            let (mut least, mut largest) = (f64::INFINITY, 0.0f64);
            for x in &states {
                let mut values = model.parameter_values();
                let symbols = model.states.iter().map(|s| s.variable.symbol);
                values.extend(symbols.zip(x.iter().copied()));
                let margin = model.graph.eval(&[condition], &values)[0];
                (least, largest) = (least.min(margin), largest.max(margin.abs()));
            }
            if largest > 0.0 { least / largest } else { 0.0 }
        };
        let shares = model.guards.iter().map(|g| (share(g.condition.expr), g));
        let (least, guard) = shares.min_by(|a, b| a.0.total_cmp(&b.0))?;
        (least <= 0.0 || model.guards.len() == 1).then_some(guard.name.as_str())
    }

    /// The solution that is the answer at a target: that of least V. In a game the one on the sheet
    /// that the equilibrium's becomes along the straight line to the target, if it does not fold on
    /// that line nor along the trajectory, and V is not negative; without an equilibrium the only
    /// one.
    pub fn answer(&self, target: usize) -> Option<&Entry> {
        let entry = match &self.principal {
            _ if !self.game => return self.of(target).first(),
            Some(principal) => principal[target].map(|e| &self.entries[e]),
            None => match self.of(target) {
                [only] => Some(only),
                _ => None,
            },
        };
        entry.filter(|e| e.value >= 0.0)
    }

    /// Of a game the status of a target without an answer.
    fn unanswered(&self, target: usize) -> PointStatus {
        let negative = |e: usize| self.entries[e].value < 0.0;
        match (&self.principal, self.of(target).len()) {
            (Some(principal), _) if principal[target].is_some_and(negative) => {
                PointStatus::NegativeValue
            }
            (None, 2..) => PointStatus::SeveralSheets,
            (None, 1) => PointStatus::NegativeValue,
            _ => (self.misses[target].as_ref()).map_or(PointStatus::NoGuess, |m| m.status),
        }
    }

    /// All solutions at a target, by rising V.
    pub fn of(&self, target: usize) -> &[Entry] {
        &self.entries[self.first[target]..self.first[target + 1]]
    }

    pub fn status(&self, target: usize) -> PointStatus {
        match (self.answer(target), &self.misses[target]) {
            (None, _) if self.game => self.unanswered(target),
            (Some(answer), _) if answer.value > self.targets.limits[target] => {
                PointStatus::AboveMax
            }
            (Some(_), _) if self.game => PointStatus::Converged,
            (Some(_), _) if self.support[target].bound.is_some() => PointStatus::Undercut,
            (_, Some(miss)) => miss.status,
            (_, None) => PointStatus::Converged,
        }
    }

    /// Whether a target has no solution for want of a guess that leads to one.
    pub fn lacks_guesses(&self) -> bool {
        (0..self.targets.len()).any(|t| {
            self.of(t).is_empty()
                && !matches!(
                    self.status(t),
                    PointStatus::OutsideGuard | PointStatus::AboveMax
                )
        })
    }

    /// Whether the search for a target's solutions was ended before it was done.
    fn is_cut(&self, target: usize) -> bool {
        self.cut.get(target).copied().unwrap_or(false)
    }

    /// What supports that the answer at a target is the least, in a word.
    pub fn evidence(&self, target: usize) -> Evidence {
        let support = &self.support[target];
        match self.answer(target) {
            None => Evidence::None,
            Some(_) if self.game || self.is_cut(target) => Evidence::None,
            Some(_) if support.bound.is_some() => Evidence::Undercut,
            Some(answer) if answer.value <= support.covered_to => Evidence::Covered,
            Some(_) => Evidence::NotUndercut,
        }
    }

    /// Targets with an answer.
    pub fn solved(&self) -> usize {
        (0..self.targets.len())
            .filter(|t| self.answer(*t).is_some())
            .count()
    }
}

impl Grid {
    /// The scene's `[homotopy]` grid.
    pub fn homotopy(homotopy: &Homotopy) -> Self {
        let axes = homotopy.axes.iter().map(|axis| match *axis {
            GridAxis::Fixed(x) => vec![x],
            GridAxis::Range { first, last, count } => spaced(first, last, count),
        });
        Self {
            axes: axes.collect(),
        }
    }

    /// The scene's `[map]`: over the region; a single point of an axis is the reference.
    pub fn map(map: &MapGrid, model: &Model) -> Self {
        let axes = (map.counts.iter().zip(&model.region).zip(model.reference())).map(
            |((count, [lo, hi]), x)| {
                if *count == 1 {
                    vec![*x]
                } else {
                    spaced(*lo, *hi, *count)
                }
            },
        );
        Self {
            axes: axes.collect(),
        }
    }
}

/// `count` values from `first` to `last`, both met exactly.
pub fn spaced(first: f64, last: f64, count: usize) -> Vec<f64> {
    (0..count)
        .map(|k| {
            if k + 1 == count {
                last
            } else {
                first + (last - first) * k as f64 / (count - 1) as f64
            }
        })
        .collect()
}

/// Seeds of a sweep that is made for first guesses alone. In many dimensions every further seed
/// multiplies simplices, and continuation has to bridge the gaps anyway.
pub fn guess_seeds(states: usize, targets: usize) -> usize {
    const LEAST: usize = 1024;
    const A_TARGET: usize = 4;
    const FEW: usize = 128;
    if states >= MANY_STATES {
        FEW
    } else {
        LEAST.max(A_TARGET.saturating_mul(targets))
    }
}

/// Choices for a plan whose sweep, if one is made, is for first guesses alone.
pub fn for_guesses(choices: Choices, states: usize, targets: usize) -> Choices {
    Choices {
        inner_levels: true,
        unasked: true,
        dispensable: true,
        max_seeds: Some(guess_seeds(states, targets)),
        ..choices
    }
}

/// Whether states that were not solved for without a sweep may be with one.
pub fn may_need_sweep(plan: &Plan) -> bool {
    plan.can_be_swept() && !Cover::serves(plan)
}

/// Whether states may be led to from a sweep's trajectories: the search makes its own else.
pub fn may_use_sweep(plan: &Plan) -> bool {
    !goes_without_sweep(plan) || may_need_sweep(plan)
}

/// Whether states are solved for without a sweep for first guesses, at first: where the search
/// makes its own, or a sweep takes much longer than they do. In a game a sweep shows folds too, and
/// is made wherever it can be.
pub fn goes_without_sweep(plan: &Plan) -> bool {
    !plan.can_be_swept() || Cover::serves(plan) || (plan.system.states >= MANY_STATES && !plan.game)
}

/// What a backend solves a plan's boundary value problems with.
pub(super) fn scheme(plan: &Plan, tolerance: f64, backend: &dyn Backend) -> Scheme {
    // The scales do not depend on how far a sweep goes; a game's are what they always were.
    let scale = if plan.game {
        plan.value_scale
    } else {
        plan.corner_value()
    };
    Scheme {
        equations: Equations::new(
            &plan.system,
            &plan.widths,
            scale,
            (VARIATIONS, backend.longest()),
        ),
        end: End::new(&plan.system, plan.local.as_ref()),
        tolerance,
        duration: plan.segment_duration(),
    }
}

/// A solver for a plan: in f64 on the CPU lanes, after drafts on the backend where that is another
/// one.
///
/// # Errors
/// What the backend refuses to compile.
pub fn solver(plan: &Plan, backend: &dyn Backend) -> Result<Solver, BackendError> {
    let asked = plan.rtol_asked.min(MOST_RTOL);
    let rtol = (SEGMENT_SHARE * asked).max(LEAST_RTOL);
    let host_rtol = if plan.system.terminal.is_some() {
        rtol.min(FINITE_RTOL)
    } else {
        rtol
    };
    let cpu = Cpu::new();
    let mut host = Solver::new(&cpu, Precision::F64, scheme(plan, asked, &cpu), host_rtol)?;
    host.deadline = plan.deadline;
    if backend.name() == "cpu" {
        return Ok(host);
    }
    let precision = plan.spec.precision;
    let (tolerance, rtol) = match precision {
        Precision::F32 => (DRAFT_TOLERANCE, DRAFT_RTOL),
        Precision::F64 => (asked, rtol),
    };
    let draft = Solver::new(backend, precision, scheme(plan, tolerance, backend), rtol)?;
    Ok(host.after(draft))
}

/// What serves every state of a plan, made when it is first asked for.
pub struct Common<'a> {
    plan: &'a Plan,
    model: &'a Model,
    direct: OnceLock<Option<Direct<'a>>>,
    grids: [OnceLock<Option<Arc<GridValue>>>; 2],
}

impl<'a> Common<'a> {
    pub fn new(plan: &'a Plan, model: &'a Model) -> Self {
        Self {
            plan,
            model,
            direct: OnceLock::new(),
            grids: [OnceLock::new(), OnceLock::new()],
        }
    }

    /// Trajectories optimized directly, until a deadline.
    fn direct(&self, deadline: Deadline) -> Option<&Direct<'a>> {
        let made = || {
            Direct::new(self.plan, self.model, self.plan.segment_duration())
                .map(|direct| direct.until(deadline))
        };
        self.direct.get_or_init(made).as_ref()
    }

    /// V on a grid; `None` where there is none that serves.
    fn grid(&self, mesh: Mesh) -> Option<Arc<GridValue>> {
        let place = match mesh {
            Mesh::Coarse => &self.grids[0],
            Mesh::Usual => &self.grids[1],
        };
        place
            .get_or_init(|| guess_grid(self.plan, self.model, mesh).map(Arc::new))
            .clone()
    }
}

/// V on a grid over the region, for guesses where the search cannot show the least; none where that
/// takes long.
fn guess_grid(plan: &Plan, model: &Model, mesh: Mesh) -> Option<GridValue> {
    /// States up to which it is made.
    const MOST: usize = 3;
    let serves = !plan.game && plan.system.states <= MOST;
    let hamiltonian = serves.then(|| Hamiltonian::derive(model).ok())??;
    let options = Options {
        share: match mesh {
            Mesh::Coarse => 0.5,
            Mesh::Usual => 1.0,
        },
        ..Options::default()
    };
    dynamic_programming::solve(model, &hamiltonian, plan, &options, Device::cpu()).ok()
}

/// Solves for a request, with first guesses from an archive.
///
/// # Errors
/// Device failures only.
pub fn solve(
    plan: &Plan,
    model: &Model,
    solver: &mut Solver,
    archive: &Archive,
    request: &Request,
    progress: Progress<'_>,
) -> Result<Answers, BackendError> {
    let mut targets = Targets::new(
        plan.system.states,
        &request.grids,
        &request.limits,
        &request.points,
        &plan.widths,
    );
    if request.in_company {
        targets.gridded.fill(true);
    }
    let common = Common::new(plan, model);
    solve_targets(&common, solver, archive, (targets, request), progress)
}

/// Solves for some of the targets of a request, as if there were no others.
///
/// # Errors
/// Device failures only.
pub fn solve_targets(
    common: &Common<'_>,
    solver: &mut Solver,
    archive: &Archive,
    (targets, request): (Targets, &Request),
    progress: Progress<'_>,
) -> Result<Answers, BackendError> {
    // A search has thousands of parallel steps of some microseconds: from outside the pool each is
    // handed over to one of its threads, and waited for.
    if rayon::current_thread_index().is_some() {
        return solve_here(common, solver, archive, (targets, request), progress);
    }
    let (tell, told) = channel::<(String, usize, usize)>();
    let mut solved = None;
    rayon::in_place_scope(|scope| {
        scope.spawn(|_| {
            let tell = tell;
            let mut progress = |what: &str, done: usize, of: usize| {
                let _ = tell.send((what.to_owned(), done, of));
            };
            let asked = (targets, request);
            solved = Some(solve_here(common, solver, archive, asked, &mut progress));
        });
        for (what, done, of) in told {
            progress(&what, done, of);
        }
    });
    solved.expect("the scope ends after what it has begun")
}

/// V up to which sheets are continued.
pub(super) fn value_max(plan: &Plan, model: &Model, request: &Request) -> f64 {
    (request.value_max)
        .or(model.sheets.value_max)
        .unwrap_or(BEYOND * plan.shoot_out.value_max.unwrap_or(f64::INFINITY))
}

fn solve_here(
    common: &Common<'_>,
    solver: &mut Solver,
    archive: &Archive,
    (targets, request): (Targets, &Request),
    progress: Progress<'_>,
) -> Result<Answers, BackendError> {
    let Common { plan, model, .. } = *common;
    let clock = std::time::Instant::now();
    let wanted = Wanted {
        value_max: value_max(plan, model, request),
        sheets: !request.one_sheet,
    };
    let mut survey = Survey::new(plan, &targets, solver)?;
    let mut cover = Cover::serves(plan)
        .then(|| Cover::new(plan, model, plan.segment_duration(), &Cpu::new()))
        .transpose()?
        .map(|cover| cover.until(solver.deadline));
    if !cover.as_ref().is_some_and(Cover::has_cells) {
        survey.direct = common.direct(solver.deadline);
    }
    let mut make = |mesh| common.grid(mesh);
    let second = match &request.grid {
        Some(grid) => GridGuesses::Given(grid),
        None => GridGuesses::OnDemand(&mut make),
    };
    match survey.run(solver, archive, cover.as_mut(), wanted, second, progress) {
        Err(BackendError::OutOfTime) if request.partial => survey.cut_short(),
        done => done?,
    }
    let is_left_out = request.one_sheet || plan.game || survey.stopped || survey.is_crowded;
    let boundary = if is_left_out {
        Vec::new()
    } else {
        match survey.equal_cost(solver, wanted) {
            Err(BackendError::OutOfTime) if request.partial => Vec::new(),
            found => found?,
        }
    };
    let found = Gathered::of(plan, &survey);
    let count = |numbers: &[i32]| numbers.iter().copied().max().map_or(0, |s| s as usize + 1);
    Ok(Answers {
        game: plan.game,
        stopped: survey.stopped,
        cut: match survey.stopped {
            true => vec![true; targets.len()],
            false => Vec::new(),
        },
        is_crowded: survey.is_crowded,
        principal: (!survey.principal.is_empty()).then_some(found.principal),
        sheets: count(&survey.sheet),
        lifted: count(&survey.lifted),
        misses: survey.misses.clone(),
        support: (0..targets.len()).map(|t| survey.support(t)).collect(),
        searched: cover.as_ref().map_or(0, Cover::trajectories),
        evaluations: survey.evaluations,
        work: solver.work,
        seconds: clock.elapsed().as_secs_f64(),
        entries: found.entries,
        first: found.first,
        equal_cost: with_controls(plan, boundary),
        folds: distinct_folds(plan, &survey),
        targets,
    })
}

/// The extremals of a survey by target, then by V.
struct Gathered {
    entries: Vec<Entry>,
    /// First entry of each target, and the end.
    first: Vec<usize>,
    principal: Vec<Option<usize>>,
}

impl Gathered {
    fn of(plan: &Plan, survey: &Survey<'_>) -> Self {
        let mut this = Self {
            entries: Vec::with_capacity(survey.extremals.len()),
            first: vec![0],
            principal: Vec::new(),
        };
        for target in 0..survey.targets.len() {
            let mut here: Vec<(usize, Entry)> = (survey.at[target].iter())
                .map(|e| (*e, entry(plan, survey, *e)))
                .collect();
            here.sort_by(|(_, a), (_, b)| a.value.total_cmp(&b.value).then(a.sheet.cmp(&b.sheet)));
            let wanted = survey.principal.get(target).copied().flatten();
            let place = wanted.and_then(|wanted| here.iter().position(|(e, _)| *e == wanted));
            this.principal.push(place.map(|k| this.entries.len() + k));
            this.entries.extend(here.into_iter().map(|(_, e)| e));
            this.first.push(this.entries.len());
        }
        this
    }
}

/// Points of equal cost with the controls on both sheets.
pub(super) fn with_controls(plan: &Plan, boundary: Vec<BoundaryPoint>) -> Vec<EqualCost> {
    let control = |s: &[f64], p: &[f64]| plan.system.eval(&plan.system.observer.control, s, p);
    let of = |point: BoundaryPoint| EqualCost {
        u: [0, 1].map(|k| control(&point.s[k], &point.p[k])),
        point,
    };
    boundary.into_iter().map(of).collect()
}

/// The folds of a survey in absolute states, each once: the same point is met from both of its
/// neighbours, and by each of the two sheets.
fn distinct_folds(plan: &Plan, survey: &Survey<'_>) -> Vec<Fold> {
    let near = |a: &[f64], b: &[f64], scales: &[f64]| {
        (0..a.len()).all(|i| (a[i] - b[i]).abs() <= SAME_FOLD * scales[i])
    };
    let mut folds: Vec<&Fold> = Vec::new();
    for fold in &survey.folds {
        let n = fold.s.len();
        let known = |f: &&Fold| {
            near(&f.s, &fold.s, &survey.scales[..n]) && near(&f.p, &fold.p, &survey.scales[n..])
        };
        if !folds.iter().any(known) {
            folds.push(fold);
        }
    }
    let reference = &plan.system.reference;
    (folds.into_iter())
        .map(|f| Fold {
            s: f.s.iter().zip(reference).map(|(s, x)| s + x).collect(),
            ..f.clone()
        })
        .collect()
}

fn entry(plan: &Plan, survey: &Survey<'_>, index: usize) -> Entry {
    let extremal = &survey.extremals[index];
    let (s, p) = (extremal.path.start(), extremal.adjoint());
    let observer = &plan.system.observer;
    let (m, k) = (observer.control.len(), observer.disturbance.len());
    let roots = [
        observer.control.as_slice(),
        &observer.disturbance,
        &[observer.hamiltonian],
    ]
    .concat();
    let values = plan.system.eval(&roots, s, p);
    Entry {
        target: extremal.target,
        sheet: survey.sheet[index],
        lifted: survey.lifted[index],
        winding: (survey.windings[extremal.winding].iter().enumerate())
            .map(|(i, k)| k + survey.base(extremal.target, i))
            .collect(),
        value: extremal.value(),
        p: p.to_vec(),
        u: values[..m].to_vec(),
        w: values[m..m + k].to_vec(),
        hamiltonian: values[m + k],
        iterations: extremal.iterations,
        residual: extremal.solved.residual,
        slope: extremal.solved.slope.clone(),
        fold: extremal.solved.fold,
        path: extremal.path.clone(),
    }
}

crate::opaque!(Answers);
