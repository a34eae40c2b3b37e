//! What a run prints: heading and summary.

use super::{counted, covered, estimates};
use costate::backend::{Backend, Status};
use costate::low_level::model::Model;
use costate::low_level::numeric::quantile::median_p99_max;
use costate::low_level::sweep::{Plan, Sampling, SurfacePart, SweepReport};
use costate::low_level::value::{Answers, EqualCost, Evidence, PointStatus};
use costate::session::summary::{by_status, relative_hamiltonian};
use costate::session::{Estimates, Outcome};
use std::collections::BTreeMap;

/// What a run has done, and the names of the states.
pub struct Solved<'a> {
    pub outcome: &'a Outcome,
    pub model: &'a Model,
    pub names: Vec<String>,
}

impl<'a> Solved<'a> {
    pub fn new(outcome: &'a Outcome, model: &'a Model) -> Self {
        let names = model.states.iter().map(|s| s.variable.name.clone());
        Self {
            outcome,
            model,
            names: names.collect(),
        }
    }
}

/// What is going to be integrated, and where.
pub fn heading(model: &Model, plan: &Plan, backend: &dyn Backend) -> String {
    format!(
        "{}\n{} on {}, {} {}, rtol {:e}",
        model.title,
        backend.name(),
        backend.adapter(),
        plan.spec.precision.name(),
        plan.method().name(),
        plan.run.rtol
    )
}

/// Remarks on it.
pub fn heading_notes(model: &Model, plan: &Plan) -> Vec<String> {
    let mut notes = model.notes.clone();
    if plan.run.rtol > plan.rtol_asked {
        notes.push(format!(
            "rtol {:e} is below what {} can resolve; {:e} is used",
            plan.rtol_asked,
            plan.spec.precision.name(),
            plan.run.rtol
        ));
    }
    let asked = (model.shoot_out.as_ref()).is_some_and(|s| s.sample_by.is_some());
    if plan.sampling == Sampling::ArcLength && plan.game {
        notes.push("a game: V may fall and rise along trajectories, which are sampled by arc length and end where the manifold folds".to_owned());
    } else if plan.sampling == Sampling::ArcLength && !asked {
        notes.push("the running cost is negative in places: V is not monotone along trajectories, which are sampled by arc length; where a state can be held at a negative cost there is no least cost, and V is only that of an extremal".to_owned());
    }
    let first_level = plan.run.levels.get(plan.inner).copied();
    let limit = 0.1 * plan.run.rtol * first_level.unwrap_or(f64::INFINITY) * 1.0001;
    if let Some(local) = &plan.local
        && local.error > limit
        && plan.sampling == Sampling::Value
    {
        notes.push(format!(
            "the local solution's error at the seeds, {:.1e}, is above the tolerance: choose a smaller seed_value or \"auto\"",
            local.error
        ));
    }
    notes
}

/// The whole summary.
pub fn text(done: &Solved<'_>) -> String {
    let mut lines = Vec::new();
    let outcome = done.outcome;
    if outcome.stored {
        lines.extend(sweep_text(
            &outcome.plan,
            &outcome.swept,
            &outcome.estimates,
        ));
    }
    if let Some(answers) = &outcome.answers {
        lines.extend(answers_text(done, answers));
        lines.extend(super::listed::text(done, answers));
    }
    if let Some(made) = &outcome.mapped {
        lines.extend(super::mapped::text(done, made));
    }
    if !outcome.variants.is_empty() {
        lines.push("study:".to_owned());
        lines.push(super::study::table(done.model, &outcome.variants));
    }
    lines.join("\n")
}

fn answers_text(done: &Solved<'_>, answers: &Answers) -> Vec<String> {
    if answers.targets.of_given.is_empty() && done.outcome.part.is_some() {
        return vec!["no states: no block of them fell to this shard".to_owned()];
    }
    let statuses = (by_status(answers).iter())
        .map(|(s, n)| format!("{n} {}", s.name().replace('_', " ")))
        .collect::<Vec<_>>();
    let mut lines = vec![
        format!(
            "{}: {}",
            counted(answers.targets.of_given.len(), "state"),
            statuses.join(", ")
        ),
        sheets_text(answers),
    ];
    lines.extend(boundary_text(answers));
    if !answers.folds.is_empty() {
        lines.push(format!("folds: {}", counted(answers.folds.len(), "point")));
    }
    lines.extend(missed(done, answers));
    if answers.entries.is_empty() {
        return lines;
    }
    lines.extend(support_text(answers));
    lines.push(residual_text(done, answers));
    lines.extend(estimates::solved_text(&done.outcome.estimates));
    let guess = if done.outcome.stored {
        String::new()
    } else {
        let trajectories = done.outcome.swept.trajectories + answers.searched;
        match done.outcome.guesses {
            0 => format!(" (first guesses from {trajectories} swept trajectories)"),
            given => format!(
                " (first guesses from {given} trajectories of the archive, and {trajectories} more)"
            ),
        }
    };
    lines.push(format!(
        "{:.2} s solving: {}, {:.1} integrations of a trajectory each{guess}",
        answers.seconds,
        pace(answers.targets.len(), answers.seconds),
        answers.evaluations as f64 / answers.targets.len().max(1) as f64,
    ));
    lines
}

/// How many solutions on how many sheets.
fn sheets_text(answers: &Answers) -> String {
    let copies = if answers.lifted < answers.sheets {
        format!(" ({} without copies by whole periods)", answers.lifted)
    } else {
        String::new()
    };
    let solutions = counted(answers.entries.len(), "solution");
    match answers.stopped {
        true => format!(
            "{solutions}; the search was ended before it was known which are of one sheet, and whether any is the least"
        ),
        false => format!(
            "{solutions} on {}{copies}",
            counted(answers.sheets, "sheet")
        ),
    }
}

/// The equal-cost boundary, where there is one.
fn boundary_text(answers: &Answers) -> Option<String> {
    let jump = |e: &EqualCost| {
        e.u[0]
            .iter()
            .zip(&e.u[1])
            .fold(0.0f64, |a, (x, y)| a.max((x - y).abs()))
    };
    (!answers.equal_cost.is_empty()).then(|| {
        format!(
            "equal-cost boundary: {} points, largest jump of a control {:.4}",
            answers.equal_cost.len(),
            answers.equal_cost.iter().map(jump).fold(0.0, f64::max)
        )
    })
}

/// How well the solutions meet the equations.
fn residual_text(done: &Solved<'_>, answers: &Answers) -> String {
    let residual = answers
        .entries
        .iter()
        .map(|e| e.residual)
        .fold(0.0, f64::max);
    let corrections = format!("last corrections at most {residual:.1e} of a trajectory");
    let plan = &done.outcome.plan;
    if plan.system.terminal.is_some() {
        return corrections;
    }
    let [median, most, largest] = median_p99_max(&relative_hamiltonian(plan, answers));
    format!(
        "{corrections}; |H| at the states, of the running cost: median {median:.1e}, 99 % {most:.1e}, largest {largest:.1e}"
    )
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
fn missed(done: &Solved<'_>, answers: &Answers) -> Vec<String> {
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
            let mut reason = answers.status(t).name().replace('_', " ");
            if let Some(guard) = answers.guard_left(done.model, t) {
                reason = format!("{reason} `{guard}`");
            }
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

fn sweep_text(plan: &Plan, swept: &SweepReport, estimates: &Estimates) -> Vec<String> {
    let statuses = (swept.by_status.iter())
        .map(|(s, n)| format!("{n} {}", plan.status_name(*s).replace('_', " ")))
        .collect::<Vec<_>>();
    let whole = plan.part == SurfacePart::WHOLE;
    let mut lines = Vec::new();
    if !whole {
        lines.push(format!(
            "part {} (from 0) of {} of the surface of seeds",
            plan.part.part, plan.part.parts
        ));
    }
    if swept.trajectories == 0 {
        lines.push(match swept.coverage.outside_guards {
            0 => "no trajectories: nothing of this part is to be swept".to_owned(),
            outside => {
                format!("no trajectories: all {outside} seeds of this part lie outside the guards")
            }
        });
        return lines;
    }
    lines.push(format!(
        "{} trajectories: {}",
        swept.trajectories,
        statuses.join(", ")
    ));
    if swept.borrowed > 0 {
        lines.push(format!(
            "{} more on edges that are shared were swept too: other parts report them",
            swept.borrowed
        ));
    }
    let c = &swept.coverage;
    if c.outside_guards > 0 {
        lines.push(format!(
            "{} seeds outside the guards, not swept",
            c.outside_guards
        ));
    }
    lines.push(if c.gaps() == 0 {
        covered_text(plan, swept)
    } else {
        gaps_text(plan, swept)
    });
    if let Some(local) = &plan.local {
        lines.push(format!(
            "seeds on V = {:.3e}, where V is known to {:.1e} (expansion to degree {})",
            local.seed_value, local.error, local.degree
        ));
    }
    let [median, most, largest] = median_p99_max(&swept.relative_drift);
    let what = if plan.sampling == Sampling::Time {
        "change of H"
    } else {
        "|H|"
    };
    lines.push(format!(
        "{what} along trajectories, of the running cost: median {median:.1e}, 99 % {most:.1e}, largest {largest:.1e}"
    ));
    lines.extend(estimates::swept_text(estimates));
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

/// Of fronts without gaps.
fn covered_text(plan: &Plan, swept: &SweepReport) -> String {
    let failed: usize = (swept.by_status.iter())
        .filter(|(code, _)| Status::FAILURES.iter().any(|f| *f as i32 == **code))
        .map(|(_, n)| n)
        .sum();
    let far = swept.coverage.steps.far();
    covered(plan.shoot_out.spacing, failed, far)
}

/// Of fronts with gaps, and why these are left.
fn gaps_text(plan: &Plan, swept: &SweepReport) -> String {
    let c = &swept.coverage;
    let mut reasons = Vec::new();
    if c.uncovered > 0 && swept.stopped {
        reasons.push(format!("{} for want of time", c.uncovered));
    } else if c.uncovered > 0 {
        let each = match plan.part == SurfacePart::WHOLE {
            true => "",
            false => " for each shard",
        };
        reasons.push(format!(
            "{} for want of seeds (max_seeds = {}{each})",
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
    if c.crowded > 0 {
        reasons.push(format!(
            "{} where seeds crowd, and more would leave others",
            c.crowded
        ));
    }
    format!(
        "fronts NOT fully covered: {} gaps wider than {} remain ({}), the widest {:.3} of the region",
        c.gaps(),
        plan.shoot_out.spacing,
        reasons.join(", "),
        c.widest
    )
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
