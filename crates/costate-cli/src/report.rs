//! What a run prints: heading, progress, summary.

use super::estimates::Estimates;
use super::{CliError, SceneArgs};
use costate::backend::{Backend, Status};
use costate::map::Adaptive;
use costate::model::Model;
use costate::result::RunRecord;
use costate::study::Variant;
use costate::sweep::{Plan, Sampling, SweepReport};
use costate::value::{Answers, EqualCost, Evidence, PointStatus};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;
use std::time::Duration;

/// Where a run's words go: text to standard output, or to standard error beside `--json`.
pub(super) struct Terminal {
    quiet: bool,
    json: bool,
}

impl Terminal {
    pub fn new(args: &SceneArgs) -> Self {
        Self {
            quiet: args.quiet,
            json: args.json,
        }
    }

    /// Of a command that reads no scenario.
    pub fn with(quiet: bool, json: bool) -> Self {
        Self { quiet, json }
    }

    pub fn say(&self, text: &str) -> std::io::Result<()> {
        if self.quiet {
            return Ok(());
        }
        if self.json {
            writeln!(std::io::stderr(), "{text}")
        } else {
            writeln!(std::io::stdout(), "{text}")
        }
    }

    /// A remark that does not stop the run.
    pub fn note(&self, text: &str) {
        if !self.quiet {
            let _ = writeln!(std::io::stderr(), "note: {text}");
        }
    }

    pub fn heading(&self, model: &Model, plan: &Plan, backend: &dyn Backend) {
        let head = format!(
            "{}\n{} on {}, {} {}, rtol {:e}",
            model.title,
            backend.name(),
            backend.adapter(),
            plan.spec.precision.name(),
            plan.method().name(),
            plan.run.rtol
        );
        let _ = self.say(&head);
        if plan.run.rtol > plan.rtol_asked {
            self.note(&format!(
                "rtol {:e} is below what {} can resolve; {:e} is used",
                plan.rtol_asked,
                plan.spec.precision.name(),
                plan.run.rtol
            ));
        }
        let asked = model
            .shoot_out
            .as_ref()
            .is_some_and(|s| s.sample_by.is_some());
        if plan.sampling == Sampling::ArcLength && plan.game {
            self.note("a game: V may fall and rise along trajectories, which are sampled by arc length and end where the manifold folds");
        } else if plan.sampling == Sampling::ArcLength && !asked {
            self.note("the running cost is negative in places: V is not monotone along trajectories, which are sampled by arc length; where a state can be held at a negative cost there is no least cost, and V is only that of an extremal");
        }
        if let Some(local) = &plan.local
            && local.error
                > 0.1
                    * plan.run.rtol
                    * plan
                        .run
                        .levels
                        .get(plan.inner)
                        .copied()
                        .unwrap_or(f64::INFINITY)
                    * 1.0001
            && plan.sampling == Sampling::Value
        {
            self.note(&format!(
                "the local solution's error at the seeds, {:.1e}, is above the tolerance: choose a smaller seed_value or \"auto\"",
                local.error
            ));
        }
    }

    pub fn progress(&self) -> Bar {
        let target = if self.quiet {
            ProgressDrawTarget::hidden()
        } else {
            ProgressDrawTarget::stderr()
        };
        let bar = ProgressBar::with_draw_target(None, target);
        if let Ok(style) = ProgressStyle::with_template("{spinner} {elapsed} {msg}") {
            bar.set_style(style);
        }
        bar.enable_steady_tick(Duration::from_millis(200));
        Bar(bar)
    }

    pub fn summary(&self, done: &Done<'_>) -> Result<(), CliError> {
        self.say(&as_text(done))?;
        done.estimates.notes(done.plan, self);
        Ok(())
    }
}

/// What a run has done.
pub(super) struct Done<'a> {
    pub plan: &'a Plan,
    /// Names of the states.
    pub names: &'a [String],
    pub swept: &'a SweepReport,
    /// Whether the sweep is a result; else it gave first guesses.
    pub stored: bool,
    pub answers: Option<&'a Answers>,
    /// A map that was made to an error.
    pub mapped: Option<&'a Adaptive>,
    /// How many of the states given, from the first on, the user listed: those are answered one by
    /// one.
    pub listed: usize,
    pub estimates: &'a Estimates,
    pub model: &'a Model,
    /// Of the scene's [study].
    pub variants: &'a [Variant],
    pub record: &'a RunRecord,
    pub path: &'a Path,
    pub seconds: f64,
}

/// The progress of a sweep.
pub(super) struct Bar(ProgressBar);

impl Bar {
    pub fn update(&self, done: usize, waiting: usize) {
        self.0
            .set_message(format!("{done} trajectories, {waiting} gaps to fill"));
    }

    pub fn say(&self, text: &str) {
        self.0.set_message(text.to_owned());
    }

    pub fn clear(&self) {
        self.0.finish_and_clear();
    }
}

/// Quantiles of |H|: median, 99 %, largest.
pub(super) fn quantiles(drift: &[f64]) -> [f64; 3] {
    let mut sorted: Vec<f64> = drift.iter().copied().filter(|d| !d.is_nan()).collect();
    sorted.sort_by(f64::total_cmp);
    let at = |q: f64| {
        sorted
            .get(((sorted.len().max(1) - 1) as f64 * q).round() as usize)
            .copied()
            .unwrap_or(f64::NAN)
    };
    [at(0.5), at(0.99), at(1.0)]
}

fn as_text(done: &Done<'_>) -> String {
    let mut lines = Vec::new();
    if done.stored {
        lines.extend(sweep_text(done.plan, done.swept, done.estimates));
    }
    if let Some(answers) = done.answers {
        lines.extend(answers_text(done, answers));
        lines.extend(super::listed::text(done, answers));
    }
    if let Some(made) = done.mapped {
        lines.extend(super::mapped::text(done, made));
    }
    if !done.variants.is_empty() {
        lines.push("study:".to_owned());
        lines.push(super::study::table(done.model, done.variants));
    }
    lines.join("\n")
}

/// Targets by status.
fn by_status(answers: &Answers) -> BTreeMap<PointStatus, usize> {
    let mut counts = BTreeMap::new();
    for &target in &answers.targets.of_given {
        *counts.entry(answers.status(target)).or_insert(0) += 1;
    }
    counts
}

fn answers_text(done: &Done<'_>, answers: &Answers) -> Vec<String> {
    let statuses = (by_status(answers).iter())
        .map(|(s, n)| format!("{n} {}", s.name().replace('_', " ")))
        .collect::<Vec<_>>();
    let mut lines = vec![format!(
        "{} states: {}",
        answers.targets.of_given.len(),
        statuses.join(", ")
    )];
    let copies = if answers.lifted < answers.sheets {
        format!(" ({} without copies by whole periods)", answers.lifted)
    } else {
        String::new()
    };
    lines.push(format!(
        "{} solutions on {} {}{copies}",
        answers.entries.len(),
        answers.sheets,
        if answers.sheets == 1 {
            "sheet"
        } else {
            "sheets"
        }
    ));
    if !answers.equal_cost.is_empty() {
        let jump = |e: &EqualCost| {
            e.u[0]
                .iter()
                .zip(&e.u[1])
                .fold(0.0f64, |a, (x, y)| a.max((x - y).abs()))
        };
        lines.push(format!(
            "equal-cost boundary: {} points, largest jump of a control {:.4}",
            answers.equal_cost.len(),
            answers.equal_cost.iter().map(jump).fold(0.0, f64::max)
        ));
    }
    if !answers.folds.is_empty() {
        lines.push(format!("folds: {} points", answers.folds.len()));
    }
    lines.extend(missed(done, answers));
    if answers.entries.is_empty() {
        return lines;
    }
    lines.extend(support_text(answers));
    let residual = answers
        .entries
        .iter()
        .map(|e| e.residual)
        .fold(0.0, f64::max);
    let what = if done.plan.system.terminal.is_some() {
        None
    } else {
        Some(relative_hamiltonian(done.plan, answers))
    };
    lines.push(match what {
        Some([median, most, largest]) => format!(
            "last corrections at most {residual:.1e} of a trajectory; |H| at the states, of the running cost: median {median:.1e}, 99 % {most:.1e}, largest {largest:.1e}"
        ),
        None => format!("last corrections at most {residual:.1e} of a trajectory"),
    });
    lines.extend(done.estimates.solved_text());
    let guess = if done.stored {
        String::new()
    } else {
        let trajectories = done.swept.trajectories + answers.searched;
        format!(" (first guesses from {trajectories} swept trajectories)")
    };
    lines.push(format!(
        "{:.2} s solving: {}, {:.1} integrations of a trajectory each{guess}",
        answers.seconds,
        pace(answers.targets.len(), answers.seconds),
        answers.evaluations as f64 / answers.targets.len().max(1) as f64,
    ));
    lines
}

/// What supports that the answers are the least.
fn support_text(answers: &Answers) -> Option<String> {
    if answers.game {
        return None;
    }
    let mut counts: BTreeMap<Evidence, usize> = BTreeMap::new();
    let of_interest = |t: &&usize| answers.status(**t) != PointStatus::AboveMax;
    for &target in answers.targets.of_given.iter().filter(of_interest) {
        *counts.entry(answers.evidence(target)).or_insert(0) += 1;
    }
    let said =
        |evidence: Evidence, what: &str| counts.get(&evidence).map(|n| format!("at {n} {what}"));
    let parts = [
        said(Evidence::Covered, "by the whole swept manifold up to it"),
        said(Evidence::NotUndercut, "by nothing tried being cheaper"),
        said(Evidence::Undercut, "NOT: a flown control is cheaper"),
    ];
    let parts: Vec<String> = parts.into_iter().flatten().collect();
    let flights: u64 = answers.support.iter().map(|s| u64::from(s.flights)).sum();
    let told = format!(
        "that V is the least is supported {}; {flights} controls flown",
        parts.join(", ")
    );
    (!parts.is_empty()).then_some(told)
}

/// The first few states that were not solved, with the reason and how far a continuation came.
fn missed(done: &Done<'_>, answers: &Answers) -> Vec<String> {
    const SHOWN: usize = 5;
    let show = |x: &[f64]| {
        let parts: Vec<String> = (done.names.iter().zip(x))
            .map(|(name, x)| format!("{name} = {x:.6}"))
            .collect();
        parts.join(", ")
    };
    let open = |t: &usize| {
        !matches!(
            answers.status(*t),
            PointStatus::Converged | PointStatus::AboveMax
        )
    };
    let missed: Vec<usize> = (0..answers.targets.len()).filter(open).collect();
    let mut lines: Vec<String> = (missed.iter().take(SHOWN))
        .map(|&t| {
            let reason = answers.status(t).name().replace('_', " ");
            let furthest = answers.misses[t].as_ref().and_then(|m| m.furthest.as_ref());
            let furthest = furthest.map_or_else(String::new, |x| format!("; furthest {}", show(x)));
            format!("  {reason}: {}{furthest}", show(answers.targets.state(t)))
        })
        .collect();
    if missed.len() > SHOWN {
        lines.push(format!(
            "  and {} more: see status and furthest in the file",
            missed.len() - SHOWN
        ));
    }
    lines
}

/// Quantiles of |H| at the targets relative to the running cost there.
fn relative_hamiltonian(plan: &Plan, answers: &Answers) -> [f64; 3] {
    let running = plan.system.rate[2 * plan.system.states];
    let all: Vec<f64> = (answers.entries.iter())
        .map(|e| {
            let cost = plan.system.eval(&[running], e.path.start(), &e.p)[0].abs();
            if cost > 0.0 {
                e.hamiltonian.abs() / cost
            } else {
                e.hamiltonian.abs()
            }
        })
        .collect();
    quantiles(&all)
}

fn sweep_text(plan: &Plan, swept: &SweepReport, estimates: &Estimates) -> Vec<String> {
    let statuses = (swept.by_status.iter())
        .map(|(s, n)| format!("{n} {}", plan.status_name(*s).replace('_', " ")))
        .collect::<Vec<_>>();
    let c = &swept.coverage;
    let mut lines = vec![format!(
        "{} trajectories: {}",
        swept.trajectories,
        statuses.join(", ")
    )];
    if c.outside_guards > 0 {
        lines.push(format!(
            "{} seeds outside the guards, not swept",
            c.outside_guards
        ));
    }
    lines.push(if c.uncovered + c.indistinguishable == 0 {
        let failed: usize = (swept.by_status.iter())
            .filter(|(code, _)| Status::FAILURES.iter().any(|f| *f as i32 == **code))
            .map(|(_, n)| n)
            .sum();
        let covered = format!(
            "no neighbours within the region are further apart than {}",
            plan.shoot_out.spacing
        );
        if failed == 0 {
            format!("fronts covered: {covered}")
        } else {
            format!("fronts covered only as far as trajectories go: {covered}, but {failed} trajectories failed")
        }
    } else {
        let mut reasons = Vec::new();
        if c.uncovered > 0 {
            reasons.push(format!(
                "{} for want of seeds (max_seeds = {})",
                c.uncovered, plan.shoot_out.max_seeds
            ));
        }
        if c.indistinguishable > 0 {
            reasons.push(format!(
                "{} with no {} number between",
                c.indistinguishable,
                plan.spec.precision.name()
            ));
        }
        format!(
            "fronts NOT fully covered: {} gaps wider than {} remain ({}), the widest {:.3} of the region",
            c.uncovered + c.indistinguishable,
            plan.shoot_out.spacing,
            reasons.join(", "),
            c.widest
        )
    });
    if let Some(local) = &plan.local {
        lines.push(format!(
            "seeds on V = {:.3e}, where V is known to {:.1e} (expansion to degree {})",
            local.seed_value, local.error, local.degree
        ));
    }
    let [median, most, largest] = quantiles(&swept.relative_drift);
    let what = if plan.sampling == Sampling::Time {
        "change of H"
    } else {
        "|H|"
    };
    lines.push(format!(
        "{what} along trajectories, of the running cost: median {median:.1e}, 99 % {most:.1e}, largest {largest:.1e}"
    ));
    lines.extend(estimates.swept_text());
    lines.push(format!(
        "{:.2} s integrating ({:.0} trajectories/s), {} steps, {} rejected, {} rounds",
        swept.integrate_seconds,
        swept.trajectories as f64 / swept.integrate_seconds.max(1e-9),
        swept.steps,
        swept.rejected,
        swept.rounds
    ));
    lines
}

fn answers_json(plan: &Plan, answers: &Answers, estimates: &Estimates) -> serde_json::Value {
    let statuses: serde_json::Map<String, serde_json::Value> = (by_status(answers).iter())
        .map(|(s, n)| (s.name().to_owned(), (*n).into()))
        .collect();
    let relative = relative_hamiltonian(plan, answers);
    serde_json::json!({
        "states": answers.targets.of_given.len(),
        "distinct": answers.targets.len(),
        "status": statuses,
        "solutions": answers.entries.len(),
        "sheets": answers.sheets,
        "equal_cost_points": answers.equal_cost.len(),
        "fold_points": answers.folds.len(),
        "largest_residual": answers.entries.iter().map(|e| e.residual).fold(0.0, f64::max),
        "hamiltonian_relative": { "median": relative[0], "p99": relative[1], "max": relative[2] },
        "error_estimate": estimates.solved_json(),
        "integrations": answers.evaluations,
        "seconds": answers.seconds,
        "states_per_second": answers.targets.len() as f64 / answers.seconds.max(1e-9),
    })
}

pub(super) fn as_json(done: &Done<'_>) -> serde_json::Value {
    let Done {
        plan,
        swept,
        record,
        path,
        seconds,
        ..
    } = *done;
    let [median, most, largest] = quantiles(&swept.drift);
    let relative = quantiles(&swept.relative_drift);
    let c = &swept.coverage;
    let statuses: serde_json::Map<String, serde_json::Value> = swept
        .by_status
        .iter()
        .map(|(s, n)| (plan.status_name(*s), (*n).into()))
        .collect();
    serde_json::json!({
        "title": record.title,
        "file": path.display().to_string(),
        "backend": record.backend,
        "adapter": record.adapter,
        "precision": record.precision,
        "method": record.method,
        "rtol": record.rtol,
        "atol": record.atol,
        "trajectories": swept.trajectories,
        "trajectories_stored": done.stored,
        "study": super::study::as_json(done.model, done.variants),
        "homotopy": done.answers.map(|a| answers_json(plan, a, done.estimates)),
        "map": done.mapped.map(|made| super::mapped::as_json(made, done.names.len())),
        "status": statuses,
        "coverage": {
            "spacing": plan.shoot_out.spacing,
            "pairs": c.pairs,
            "gaps_for_want_of_seeds": c.uncovered,
            "gaps_indistinguishable": c.indistinguishable,
            "widest_gap": c.widest,
            "seeds_outside_guards": c.outside_guards,
        },
        "seed_value": plan.local.as_ref().map(|l| l.seed_value),
        "seed_error": plan.local.as_ref().map(|l| l.error),
        "hamiltonian": { "median": median, "p99": most, "max": largest },
        "hamiltonian_relative": { "median": relative[0], "p99": relative[1], "max": relative[2] },
        "error_estimate": done.estimates.swept_json(),
        "error_met": done.estimates.met(),
        "stiffness": done.estimates.stiffness_json(),
        "steps": swept.steps,
        "rejected": swept.rejected,
        "rounds": swept.rounds,
        "integrate_seconds": swept.integrate_seconds,
        "wall_seconds": seconds,
        "trajectories_per_second": swept.trajectories as f64 / swept.integrate_seconds.max(1e-9),
    })
}

/// States a second, or seconds a state.
fn pace(states: usize, seconds: f64) -> String {
    let a_second = states as f64 / seconds.max(1e-9);
    if a_second >= 10.0 || states == 0 {
        format!("{a_second:.0} states/s")
    } else {
        format!("{:.2} s a state", 1.0 / a_second)
    }
}
