//! What a run reports, as plain numbers: the attribute `summary` of a result file, and what
//! `--json` prints. A number that is not finite (of which nothing is known) is `None`, in JSON
//! null.
#![allow(missing_docs, reason = "fields whose name says what they are")]

mod laws;

pub use laws::{
    AttenuationSummary, DissipationSummary, EvaluationSummary, FittedSummary, LinearSummary,
};

use super::{Estimates, Outcome, Session};
use crate::backend::Status;
use crate::map::{Adaptive, Agreement};
use crate::model::Model;
use crate::numeric::quantile::median_p99_max;
use crate::sweep::accuracy::{Spread, are_met};
use crate::sweep::{Far, Plan, Steps, SurfacePart};
use crate::value::{Answers, PointStatus};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Median, 99 % quantile and largest value.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Quantiles {
    pub median: Option<f64>,
    pub p99: Option<f64>,
    pub max: Option<f64>,
}

impl Quantiles {
    /// Of values, what is not a number left out.
    #[must_use]
    pub fn of(values: &[f64]) -> Self {
        median_p99_max(values).into()
    }

    /// The larger of each of two.
    #[must_use]
    pub(crate) fn largest(self, other: Self) -> Self {
        Self {
            median: larger(self.median, other.median),
            p99: larger(self.p99, other.p99),
            max: larger(self.max, other.max),
        }
    }
}

/// The larger of two numbers; what is not finite is larger than any that is.
pub(crate) fn larger(a: Option<f64>, b: Option<f64>) -> Option<f64> {
    Some(a?.max(b?))
}

/// The larger of two, where there are both.
fn largest(a: Option<Quantiles>, b: Option<Quantiles>) -> Option<Quantiles> {
    match (a, b) {
        (Some(a), Some(b)) => Some(a.largest(b)),
        (a, b) => a.or(b),
    }
}

/// Whether all bounds were met: false where one was not; `None` where one is not known, or there is
/// none.
pub(super) fn all_met(met: &[Option<bool>]) -> Option<bool> {
    if met.contains(&Some(false)) {
        return Some(false);
    }
    (!met.is_empty() && met.iter().all(Option::is_some)).then_some(true)
}

impl From<[f64; 3]> for Quantiles {
    fn from(values: [f64; 3]) -> Self {
        let [median, p99, max] = values.map(finite);
        Self { median, p99, max }
    }
}

impl From<Spread> for Quantiles {
    fn from(spread: Spread) -> Self {
        [spread.median, spread.p99, spread.worst].into()
    }
}

fn finite(x: f64) -> Option<f64> {
    Some(x).filter(|x| x.is_finite())
}

/// What a run has done. Groups of which nothing was computed are `None`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RunSummary {
    pub title: String,
    /// The result file.
    pub file: String,
    pub backend: String,
    pub adapter: String,
    pub precision: String,
    pub method: String,
    pub rtol: f64,
    pub atol: f64,
    /// Of a part of a sweep which shard it is (from 0), and of how many.
    #[serde(default)]
    pub shard: Option<[usize; 2]>,
    /// Whether the run was ended before everything was swept and solved.
    #[serde(default)]
    pub stopped: bool,
    /// Whether it was ended later, before all laws, closed loops and levels were done.
    #[serde(default)]
    pub laws_stopped: bool,
    /// How many trajectories were swept.
    pub trajectories: usize,
    /// How many more a part of a sweep has swept that another part reports.
    #[serde(default)]
    pub trajectories_borrowed: usize,
    /// Whether they are in the file; else they only gave first guesses.
    pub trajectories_stored: bool,
    /// How many trajectories ended with each status.
    pub status: BTreeMap<String, usize>,
    pub coverage: CoverageSummary,
    /// V of the seeds' surface, and the error of V there.
    pub seed_value: Option<f64>,
    pub seed_error: Option<f64>,
    /// |H| along trajectories; the second relative to the largest running cost of each.
    pub hamiltonian: Quantiles,
    pub hamiltonian_relative: Quantiles,
    /// Errors of the sweep.
    pub error_estimate: Option<SweptErrors>,
    /// Whether the errors asked for were met, of the sweep and of the solved states.
    pub error_met: Option<bool>,
    pub stiffness: StiffnessSummary,
    pub steps: u64,
    pub rejected: u64,
    pub rounds: usize,
    pub integrate_seconds: f64,
    pub wall_seconds: f64,
    pub trajectories_per_second: f64,
    /// The solved states.
    pub homotopy: Option<SolvedSummary>,
    /// The map to an error.
    pub map: Option<MapSummary>,
    /// A row for each variant of `[study]`: parameters, V, status, recorded quantities.
    pub study: Option<Vec<BTreeMap<String, Cell>>>,
}

/// A number or a text of a table; a number that is not finite is null.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Cell {
    Number(Option<f64>),
    Text(String),
}

/// How far the fronts of a sweep cover the manifold.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CoverageSummary {
    /// The distance asked for, in widths of the region.
    pub spacing: f64,
    /// Pairs of neighbours.
    pub pairs: usize,
    /// Pairs further apart than that, since `max_seeds` was reached.
    pub gaps_for_want_of_seeds: usize,
    /// Pairs further apart than that with no number between their seeds.
    pub gaps_indistinguishable: usize,
    /// Pairs further apart than that where seeds crowd at guards, and more would leave others.
    #[serde(default)]
    pub gaps_crowded: usize,
    pub widest_gap: Option<f64>,
    /// How far trajectories go from one front to the next.
    #[serde(flatten)]
    pub steps: Option<Steps>,
    /// Seeds that guards exclude.
    pub seeds_outside_guards: usize,
}

impl CoverageSummary {
    /// Pairs of neighbours further apart than the spacing that remain.
    #[must_use]
    pub fn gaps(&self) -> usize {
        self.gaps_for_want_of_seeds + self.gaps_indistinguishable + self.gaps_crowded
    }

    /// Whether fronts lie too far apart to tell of what is between them.
    #[must_use]
    pub fn far(&self) -> Option<Far> {
        self.steps?.far()
    }
}

/// Errors of the sweep: a random sample integrated again with a finer tolerance.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SweptErrors {
    pub trajectories: usize,
    pub failed: usize,
    pub points: usize,
    /// Points that have slid too far along the manifold to be compared.
    pub points_parted: usize,
    pub method: String,
    pub rtol: f64,
    #[serde(rename = "V")]
    pub value: Option<Quantiles>,
    #[serde(rename = "p")]
    pub costate: Option<Quantiles>,
    #[serde(rename = "u")]
    pub control: Option<Quantiles>,
    pub slid_along_manifold: Option<f64>,
    pub ended_differently: usize,
    /// The largest error of V asked for.
    pub asked: f64,
    pub met: Option<bool>,
    pub seconds: f64,
}

impl SweptErrors {
    /// Of two sweeps: the larger errors, medians too.
    #[must_use]
    pub(crate) fn largest(self, other: Self) -> Self {
        // Of no trajectories there are none.
        match (self.trajectories, other.trajectories) {
            (_, 0) => return self,
            (0, _) => return other,
            _ => {}
        }
        let all = Self {
            trajectories: self.trajectories + other.trajectories,
            failed: self.failed + other.failed,
            points: self.points + other.points,
            points_parted: self.points_parted + other.points_parted,
            value: largest(self.value, other.value),
            costate: largest(self.costate, other.costate),
            control: largest(self.control, other.control),
            slid_along_manifold: larger(self.slid_along_manifold, other.slid_along_manifold),
            ended_differently: self.ended_differently + other.ended_differently,
            seconds: self.seconds + other.seconds,
            ..self
        };
        let met = all.value.and_then(|value| {
            let worst = value.max.unwrap_or(f64::INFINITY);
            let trajectories = (all.trajectories, all.ended_differently);
            are_met(
                worst,
                all.asked,
                trajectories,
                (all.points, all.points_parted),
            )
        });
        Self { met, ..all }
    }
}

/// Errors of the solved states: a random sample solved again with a finer tolerance.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SolvedErrors {
    pub states: usize,
    pub failed: usize,
    pub tolerance: f64,
    #[serde(rename = "V")]
    pub value: Option<Quantiles>,
    #[serde(rename = "p")]
    pub costate: Option<Quantiles>,
    #[serde(rename = "u")]
    pub control: Option<Quantiles>,
    pub asked: f64,
    pub met: Option<bool>,
    pub seconds: f64,
}

impl SolvedErrors {
    /// Of two lists of states: the larger errors, medians too.
    #[must_use]
    pub(crate) fn largest(self, other: Self) -> Self {
        Self {
            states: self.states + other.states,
            failed: self.failed + other.failed,
            value: largest(self.value, other.value),
            costate: largest(self.costate, other.costate),
            control: largest(self.control, other.control),
            met: all_met(&[self.met, other.met]),
            seconds: self.seconds + other.seconds,
            ..self
        }
    }
}

impl RunSummary {
    /// Trajectories whose integration failed.
    #[must_use]
    pub fn failed(&self) -> usize {
        (Status::ALL.iter())
            .filter(|(status, _)| Status::FAILURES.contains(status))
            .filter_map(|(_, name)| self.status.get(*name))
            .sum()
    }

    /// Whether the errors asked for were met, of those that were estimated; `None` where that is not
    /// known.
    #[must_use]
    pub(crate) fn met(&self) -> Option<bool> {
        let solved = self
            .homotopy
            .as_ref()
            .and_then(|h| h.error_estimate.as_ref());
        let swept = self.error_estimate.as_ref().map(|errors| errors.met);
        let all: Vec<Option<bool>> = swept.into_iter().chain(solved.map(|e| e.met)).collect();
        all_met(&all)
    }
}

/// Rates of the closed loop that lie far apart.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StiffnessSummary {
    /// Real and imaginary part.
    pub fastest_rate: Option<[f64; 2]>,
    pub slowest_rate: Option<[f64; 2]>,
    pub ratio: Option<f64>,
    pub fronts_hidden: Option<bool>,
    pub steps_held_by_stability: Option<f64>,
    pub segments: Option<f64>,
    pub stiff: bool,
}

/// The solved states.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SolvedSummary {
    pub states: usize,
    /// The same without repetitions.
    pub distinct: usize,
    pub status: BTreeMap<String, usize>,
    pub solutions: usize,
    pub sheets: usize,
    pub equal_cost_points: usize,
    pub fold_points: usize,
    pub largest_residual: f64,
    /// |H| at the states, relative to the running cost there.
    pub hamiltonian_relative: Quantiles,
    pub error_estimate: Option<SolvedErrors>,
    pub integrations: u64,
    pub seconds: f64,
    pub states_per_second: f64,
}

/// A map to an error.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MapSummary {
    /// The last time of V(x, t); `None` where time is no axis.
    pub time: Option<f64>,
    pub pieces: usize,
    pub cells: usize,
    pub points: usize,
    pub states: usize,
    pub failed: usize,
    pub above_max: usize,
    pub rounds: usize,
    pub seconds: f64,
    pub first_search: FirstSearch,
    pub error_asked: f64,
    /// Errors are relative to V, or to this where V is smaller.
    pub floor: f64,
    /// Share of the region where the error asked for is not met, and nine tenths of it along each
    /// axis.
    pub share_unmet: f64,
    pub unmet_within: Vec<[f64; 2]>,
    pub share_unknown: f64,
    pub unknown_within: Vec<[f64; 2]>,
    pub error_max: f64,
    /// Share of the region where the bound is above `error_max`.
    pub share_uncertain: f64,
    pub budget_spent: bool,
    pub pieces_beyond: Option<usize>,
    pub check: CheckSummary,
}

/// The first search for all sheets: the states it looked at, and those it wanted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FirstSearch {
    pub states: usize,
    pub wanted: usize,
}

/// The check of a map with fresh states.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CheckSummary {
    pub states: usize,
    pub asked: usize,
    pub solved: usize,
    pub known: usize,
    #[serde(rename = "V_error")]
    pub value_error: Quantiles,
    #[serde(rename = "V_error_over_bound")]
    pub value_error_over_bound: Quantiles,
    pub above_bound: usize,
    pub said_without_answer: usize,
}

impl Session<'_> {
    /// A pass in numbers. `file` is the result file, `seconds` how long the run took so far.
    #[must_use]
    pub fn summary(&self, outcome: &Outcome, file: &Path, seconds: f64) -> RunSummary {
        let model = &self.scene().model;
        let Outcome { plan, swept, .. } = outcome;
        let coverage = &swept.coverage;
        let statuses = swept.by_status.iter();
        RunSummary {
            title: model.title.clone(),
            file: file.display().to_string(),
            backend: self.backend().name().to_owned(),
            adapter: self.backend().adapter(),
            precision: plan.spec.precision.name().to_owned(),
            method: plan.method().name().to_owned(),
            rtol: plan.run.rtol,
            atol: plan.atol,
            shard: (plan.part != SurfacePart::WHOLE).then_some([plan.part.part, plan.part.parts]),
            stopped: outcome.stopped,
            laws_stopped: false,
            trajectories: swept.trajectories,
            trajectories_borrowed: swept.borrowed,
            trajectories_stored: outcome.trajectories,
            status: statuses.map(|(s, n)| (plan.status_name(*s), *n)).collect(),
            coverage: CoverageSummary {
                spacing: plan.shoot_out.spacing,
                pairs: coverage.pairs,
                gaps_for_want_of_seeds: coverage.uncovered,
                gaps_indistinguishable: coverage.indistinguishable,
                gaps_crowded: coverage.crowded,
                widest_gap: finite(coverage.widest),
                steps: Some(coverage.steps),
                seeds_outside_guards: coverage.outside_guards,
            },
            seed_value: plan.local.as_ref().and_then(|l| finite(l.seed_value)),
            seed_error: plan.local.as_ref().and_then(|l| finite(l.error)),
            hamiltonian: Quantiles::of(&swept.drift),
            hamiltonian_relative: Quantiles::of(&swept.relative_drift),
            error_estimate: swept_errors(&outcome.estimates),
            error_met: outcome.estimates.met(),
            stiffness: stiffness(&outcome.estimates),
            steps: swept.steps,
            rejected: swept.rejected,
            rounds: swept.rounds,
            integrate_seconds: swept.integrate_seconds,
            wall_seconds: seconds,
            trajectories_per_second: swept.trajectories as f64 / swept.integrate_seconds.max(1e-9),
            homotopy: (outcome.answers.as_ref()).map(|a| solved(plan, a, &outcome.estimates)),
            map: (outcome.mapped.as_ref()).map(|made| mapped(made, model.states.len())),
            study: study_rows(model, &outcome.variants),
        }
    }
}

impl Session<'_> {
    /// A study alone in numbers; nothing was swept. `file` and `seconds` as for
    /// [`Session::summary`].
    #[must_use]
    pub fn study_summary(
        &self,
        variants: &[crate::study::Variant],
        file: &Path,
        seconds: f64,
    ) -> RunSummary {
        let model = &self.scene().model;
        RunSummary {
            title: model.title.clone(),
            file: file.display().to_string(),
            backend: self.backend().name().to_owned(),
            adapter: self.backend().adapter(),
            rtol: self.choices.rtol.unwrap_or(model.integrator.rtol),
            wall_seconds: seconds,
            study: study_rows(model, variants),
            ..RunSummary::default()
        }
    }
}

/// The table of a study: a row for each variant; `None` where the scene has no study.
#[must_use]
pub fn study_rows(
    model: &Model,
    variants: &[crate::study::Variant],
) -> Option<Vec<BTreeMap<String, Cell>>> {
    let asked = model.study.as_ref()?;
    let number = |name: &String, value: &f64| (name.clone(), Cell::Number(finite(*value)));
    let rows = variants.iter().map(|v| {
        let parameters = asked.vary.iter().zip(&v.parameters);
        let records = asked.records.iter().zip(&v.records);
        let mut row: BTreeMap<String, Cell> =
            parameters.map(|((name, _), x)| number(name, x)).collect();
        row.insert("V".to_owned(), Cell::Number(finite(v.value)));
        row.insert("status".to_owned(), Cell::Text(v.status.name().to_owned()));
        row.extend(records.map(|(record, x)| number(&record.name, x)));
        row
    });
    Some(rows.collect())
}

/// The answer at a state of a list.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AnswerSummary {
    pub x: Vec<f64>,
    #[serde(rename = "V")]
    pub value: Option<f64>,
    pub p: Option<Vec<f64>>,
    pub u: Option<Vec<f64>>,
    pub status: &'static str,
    /// Solutions found.
    pub sheets: usize,
    /// What supports that V is the least.
    pub support: &'static str,
    /// The cost of a simulated control that is below V.
    pub bound: Option<f64>,
    pub covered_to: Option<f64>,
    pub starts: u32,
    /// The cost of the control along the answer, simulated.
    pub flown: Option<f64>,
    pub flights: u32,
    /// V of each solution found.
    #[serde(rename = "V_sheets")]
    pub values: Vec<f64>,
}

impl AnswerSummary {
    /// Of the states of a list, in its order; at most `most`.
    #[must_use]
    pub fn all(outcome: &Outcome, most: usize) -> Vec<Self> {
        let Some(answers) = &outcome.answers else {
            return Vec::new();
        };
        let listed = &answers.targets.of_given[..outcome.listed];
        let one = |&target: &usize| {
            let answer = answers.answer(target);
            let support = &answers.support[target];
            Self {
                x: answers.targets.state(target).to_vec(),
                value: answer.and_then(|a| finite(a.value)),
                p: answer.map(|a| a.p.clone()),
                u: answer.map(|a| a.u.clone()),
                status: answers.status(target).name(),
                sheets: answers.of(target).len(),
                support: answers.evidence(target).name(),
                bound: support.bound,
                covered_to: finite(support.covered_to),
                starts: support.starts,
                flown: support.flown.and_then(finite),
                flights: support.flights,
                values: answers.of(target).iter().map(|e| e.value).collect(),
            }
        };
        listed.iter().take(most).map(one).collect()
    }
}

/// How many of the states asked for have each status.
#[must_use]
pub fn by_status(answers: &Answers) -> BTreeMap<PointStatus, usize> {
    let mut counts = BTreeMap::new();
    for &target in &answers.targets.of_given {
        *counts.entry(answers.status(target)).or_insert(0) += 1;
    }
    counts
}

/// |H| at each solution, relative to the running cost there.
#[must_use]
pub fn relative_hamiltonian(plan: &Plan, answers: &Answers) -> Vec<f64> {
    let running = plan.system.rate[2 * plan.system.states];
    let relative = answers.entries.iter().map(|e| {
        let cost = plan.system.eval(&[running], e.path.start(), &e.p)[0].abs();
        if cost > 0.0 {
            e.hamiltonian.abs() / cost
        } else {
            e.hamiltonian.abs()
        }
    });
    relative.collect()
}

fn swept_errors(estimates: &Estimates) -> Option<SweptErrors> {
    let a = estimates.swept.as_ref()?;
    Some(SweptErrors {
        trajectories: a.sampled,
        failed: a.failed,
        points: a.compared,
        points_parted: a.parted,
        method: a.method.name().to_owned(),
        rtol: a.rtol,
        value: a.value.map(Quantiles::from),
        costate: a.costate.map(Quantiles::from),
        control: a.control.map(Quantiles::from),
        slid_along_manifold: finite(a.slid),
        ended_differently: a.differ,
        asked: a.bound,
        met: a.met(),
        seconds: a.seconds,
    })
}

fn solved_errors(estimates: &Estimates) -> Option<SolvedErrors> {
    let a = estimates.solved.as_ref()?;
    Some(SolvedErrors {
        states: a.sampled,
        failed: a.failed,
        tolerance: a.tolerance,
        value: a.value.map(Quantiles::from),
        costate: a.costate.map(Quantiles::from),
        control: a.control.map(Quantiles::from),
        asked: a.bound,
        met: a.met(),
        seconds: a.seconds,
    })
}

fn stiffness(estimates: &Estimates) -> StiffnessSummary {
    let segments = estimates.segments.as_ref();
    let rates = estimates.separation.or(segments.map(|s| s.separation));
    StiffnessSummary {
        fastest_rate: rates.map(|s| [s.fastest.re, s.fastest.im]),
        slowest_rate: rates.map(|s| [s.slowest.re, s.slowest.im]),
        ratio: rates.and_then(|s| finite(s.ratio)),
        fronts_hidden: estimates.separation.map(|s| s.hides_fronts()),
        steps_held_by_stability: estimates.held.map(|h| h.share),
        segments: segments.map(|s| s.mean),
        stiff: estimates.held.is_some() || segments.is_some(),
    }
}

fn solved(plan: &Plan, answers: &Answers, estimates: &Estimates) -> SolvedSummary {
    let statuses = by_status(answers);
    let named = statuses.iter().map(|(s, n)| (s.name().to_owned(), *n));
    let residuals = answers.entries.iter().map(|e| e.residual);
    SolvedSummary {
        states: answers.targets.of_given.len(),
        distinct: answers.targets.len(),
        status: named.collect(),
        solutions: answers.entries.len(),
        sheets: answers.sheets,
        equal_cost_points: answers.equal_cost.len(),
        fold_points: answers.folds.len(),
        largest_residual: residuals.fold(0.0, f64::max),
        hamiltonian_relative: Quantiles::of(&relative_hamiltonian(plan, answers)),
        error_estimate: solved_errors(estimates),
        integrations: answers.evaluations,
        seconds: answers.seconds,
        states_per_second: answers.targets.len() as f64 / answers.seconds.max(1e-9),
    }
}

fn mapped(made: &Adaptive, states: usize) -> MapSummary {
    let region = &made.pieces.region;
    let agreement = Agreement::new(&made.check, region.floor);
    MapSummary {
        time: region.hi.get(states).copied(),
        pieces: made.pieces.pieces.len(),
        cells: made.pieces.cells.len(),
        points: made.points,
        states: made.states,
        failed: made.failed,
        above_max: made.above_max,
        rounds: made.rounds,
        seconds: made.seconds,
        first_search: FirstSearch {
            states: made.first[0],
            wanted: made.first[1],
        },
        error_asked: region.error,
        floor: region.floor,
        share_unmet: made.unmet.share,
        unmet_within: made.unmet.bounds.clone(),
        share_unknown: made.unknown.share,
        unknown_within: made.unknown.bounds.clone(),
        error_max: made.error_max,
        share_uncertain: made.uncertain,
        budget_spent: made.spent,
        pieces_beyond: made.beyond.as_ref().map(|b| b.pieces.pieces.len()),
        check: CheckSummary {
            states: made.check.len(),
            asked: made.check_asked,
            solved: agreement.solved,
            known: agreement.known,
            value_error: agreement.error.into(),
            value_error_over_bound: agreement.over_bound.into(),
            above_bound: agreement.above_bound,
            said_without_answer: agreement.of_none.values().sum(),
        },
    }
}
