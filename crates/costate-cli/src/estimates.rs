//! What a run says about its own error, and about rates too far apart for its methods.

use super::CliError;
use super::report::Terminal;
use costate::hdf5::ResultFile;
use costate::local::show_eigenvalue;
use costate::model::Precision;
use costate::sweep::accuracy::{self, Accuracy, PROMISE, Spread};
use costate::sweep::stiffness::{self, HeldSteps, Segments, Separation};
use costate::sweep::{Plan, SweepReport};
use costate::value::{self, Answers, PointStatus, SolvedAccuracy};

/// Estimates of one run; a part that was not run has none.
#[derive(Default)]
pub(super) struct Estimates {
    pub swept: Option<Accuracy>,
    pub solved: Option<SolvedAccuracy>,
    pub separation: Option<Separation>,
    pub held: Option<HeldSteps>,
    pub segments: Option<Segments>,
}

impl Estimates {
    /// `stored`: the sweep is a result, not only a source of guesses.
    pub fn of(
        plan: &Plan,
        swept: &SweepReport,
        stored: bool,
        answers: Option<&Answers>,
    ) -> Result<Self, CliError> {
        let mut this = Self {
            separation: stiffness::separation(plan).filter(|_| stored),
            ..Self::default()
        };
        if stored {
            this.swept = Some(accuracy::estimate(plan, &swept.sample)?);
            this.held = stiffness::held_steps(plan, &swept.sample);
        }
        if let Some(answers) = answers {
            this.solved = value::accuracy(plan, answers)?;
            let beyond = (0..answers.targets.len())
                .filter(|t| answers.status(*t) == PointStatus::Horizon)
                .count();
            this.segments = stiffness::segments(
                plan,
                answers.entries.iter().map(|e| e.path.segments()),
                beyond,
            );
        }
        Ok(this)
    }

    /// Whether the errors asked for were met, as far as they are known.
    pub fn met(&self) -> Option<bool> {
        let swept = self.swept.as_ref().map(Accuracy::met);
        let solved = self.solved.as_ref().map(SolvedAccuracy::met);
        let all: Vec<Option<bool>> = swept.into_iter().chain(solved).collect();
        if all.contains(&Some(false)) {
            return Some(false);
        }
        (!all.is_empty() && all.iter().all(Option::is_some)).then_some(true)
    }

    /// Root attributes of the result file; errors that are not known are left out.
    pub fn write(&self, file: &ResultFile) -> Result<(), CliError> {
        let spread = |name: &str, spread: Option<Spread>| -> Result<(), CliError> {
            let Some(s) = spread else { return Ok(()) };
            file.attribute(name, s.worst)?;
            file.attribute(&format!("{name}_p99"), s.p99)?;
            file.attribute(&format!("{name}_median"), s.median)?;
            Ok(())
        };
        if let Some(a) = &self.swept {
            spread("error_estimate_V", a.value)?;
            spread("error_estimate_p", a.costate)?;
            spread("error_estimate_u", a.control)?;
            file.attribute("error_estimate_trajectories", a.sampled as i64)?;
            file.attribute("error_asked", a.bound)?;
        }
        if let Some(a) = &self.solved {
            spread("solved_error_estimate_V", a.value)?;
            spread("solved_error_estimate_p", a.costate)?;
            spread("solved_error_estimate_u", a.control)?;
            file.attribute("solved_error_estimate_states", a.sampled as i64)?;
            file.attribute("solved_error_asked", a.bound)?;
        }
        if let Some(met) = self.met() {
            file.attribute("error_met", i64::from(met))?;
        }
        Ok(())
    }

    pub fn swept_text(&self) -> Option<String> {
        let a = self.swept.as_ref()?;
        let Some(value) = a.value else {
            return Some(format!(
                "error estimate: none, no point of the {} sampled trajectories could be compared",
                a.sampled
            ));
        };
        Some(format!(
            "error estimate ({} trajectories again, f64 {} rtol {:.0e}): V {}{}{}",
            a.sampled,
            a.method.name(),
            a.rtol,
            quantiles(value),
            worst("p", a.costate),
            worst("u", a.control)
        ))
    }

    pub fn solved_text(&self) -> Option<String> {
        let a = self.solved.as_ref()?;
        let value = a.value?;
        Some(format!(
            "error estimate ({} states again, tolerance {:.0e}): V {}{}{}",
            a.sampled - a.failed,
            a.tolerance,
            quantiles(value),
            worst("p", a.costate),
            worst("u", a.control)
        ))
    }

    /// Warnings: the error asked for was not met, and why a run is slow or incomplete.
    pub fn notes(&self, plan: &Plan, terminal: &Terminal) {
        if let Some(a) = &self.swept {
            swept_note(plan, a, terminal);
        }
        if let Some(a) = self.solved.as_ref().filter(|a| a.met() == Some(false)) {
            terminal.note(&format!(
                "the error asked for was not met at the solved states: V is wrong by up to {:.1e}, asked {:.0e}",
                a.value.map_or(f64::NAN, |v| v.worst),
                a.bound
            ));
        }
        if let Some(s) = self.separation.filter(Separation::hides_fronts) {
            terminal.note(&separation_note(plan, &s));
        }
        if let Some(h) = &self.held {
            terminal.note(&format!(
                "stiff: {:.0} % of the steps are held by stability, not accuracy (mean h |lambda| = {:.1}; {} is stable to {:.1}); \
                 trajectories last {:.0} time constants of the fastest rate, |lambda| = {:.3e}. The result is right, but an \
                 explicit method is slow here and a larger tolerance does not help: replace the fast state by its quasi-steady value",
                100.0 * h.share,
                h.product,
                plan.method().name(),
                h.boundary,
                h.time_constants,
                h.rate
            ));
        }
        if let Some(s) = &self.segments {
            let beyond = match s.beyond {
                0 => String::new(),
                n => format!("; {n} states (status horizon) would take more than are tried"),
            };
            terminal.note(&format!(
                "stiff: the fastest rate, {}, is {:.0} times the slowest, {}: a solution takes {:.0} segments{beyond}. What is solved \
                 is right, but the time grows with that ratio: replace the fast states by their quasi-steady values where it matters",
                show_eigenvalue(s.separation.fastest),
                s.separation.ratio,
                show_eigenvalue(s.separation.slowest),
                s.mean
            ));
        }
    }

    /// For the summary of `--json`.
    pub fn swept_json(&self) -> serde_json::Value {
        let Some(a) = &self.swept else {
            return serde_json::Value::Null;
        };
        serde_json::json!({
            "trajectories": a.sampled,
            "failed": a.failed,
            "points": a.compared,
            "points_parted": a.parted,
            "method": a.method.name(),
            "rtol": a.rtol,
            "V": spread_json(a.value),
            "p": spread_json(a.costate),
            "u": spread_json(a.control),
            "slid_along_manifold": a.slid,
            "ended_differently": a.differ,
            "asked": a.bound,
            "met": a.met(),
            "seconds": a.seconds,
        })
    }

    pub fn solved_json(&self) -> serde_json::Value {
        let Some(a) = &self.solved else {
            return serde_json::Value::Null;
        };
        serde_json::json!({
            "states": a.sampled,
            "failed": a.failed,
            "tolerance": a.tolerance,
            "V": spread_json(a.value),
            "p": spread_json(a.costate),
            "u": spread_json(a.control),
            "asked": a.bound,
            "met": a.met(),
            "seconds": a.seconds,
        })
    }

    pub fn stiffness_json(&self) -> serde_json::Value {
        let rates = self.separation.or(self.segments.map(|s| s.separation));
        serde_json::json!({
            "fastest_rate": rates.map(|s| [s.fastest.re, s.fastest.im]),
            "slowest_rate": rates.map(|s| [s.slowest.re, s.slowest.im]),
            "ratio": rates.map(|s| s.ratio),
            "fronts_hidden": self.separation.map(|s| s.hides_fronts()),
            "steps_held_by_stability": self.held.map(|h| h.share),
            "segments": self.segments.map(|s| s.mean),
            "stiff": self.held.is_some() || self.segments.is_some(),
        })
    }
}

fn separation_note(plan: &Plan, s: &Separation) -> String {
    // Boundary value problems take some multiple of the ratio in segments, which has its limit.
    const SOLVABLE: f64 = 1000.5;
    let solve = if s.ratio <= SOLVABLE {
        "ask for states there ([homotopy], [map], costate solve), or "
    } else {
        ""
    };
    let enough =
        plan.spec.precision == Precision::F32 && s.digits < -Precision::F64.epsilon().log10();
    let finer = if enough {
        ", or use --precision f64"
    } else {
        ""
    };
    format!(
        "the closed loop's rates are far apart, {} and {} (ratio {:.0}): fronts along the slow modes come from seeds that differ in \
         digit {:.0} at the earliest, and {} has {:.0}. What is swept is right, but those parts are not covered: {solve}replace the \
         fast states by their quasi-steady values{finer}",
        show_eigenvalue(s.fastest),
        show_eigenvalue(s.slowest),
        s.ratio,
        s.digits,
        plan.spec.precision.name(),
        s.resolved,
    )
}

fn swept_note(plan: &Plan, a: &Accuracy, terminal: &Terminal) {
    let Some(value) = a.value else {
        terminal
            .note("the error could not be estimated: no sampled trajectory has a point that its reference reaches too");
        return;
    };
    if value.worst > a.bound {
        let remedy = if !plan.method().adaptive() {
            "a fixed step controls no error: use a smaller one, or a method that chooses its steps"
        } else if plan.spec.precision == Precision::F32 {
            "f32's rounding is the floor of what it reaches: use --precision f64, or ask for less"
        } else if plan.run.rtol > plan.rtol_asked {
            "f64's rounding is the floor of what it reaches: ask for less"
        } else if plan
            .local
            .as_ref()
            .is_some_and(|l| l.error > 0.1 * a.bound * plan.value_scale)
        {
            "the seeds are off by that much already: use a smaller seed_value"
        } else {
            "use a smaller rtol"
        };
        terminal.note(&format!(
            "the error asked for was NOT met: V is wrong by up to {:.1e} of it, {:.0e} ({PROMISE} rtol) was asked; {remedy}",
            value.worst, a.bound
        ));
    }
    if a.met() == Some(false) && value.worst <= a.bound {
        terminal.note(&format!(
            "{} of {} sampled trajectories end otherwise than in a finer integration: do not trust where trajectories end",
            a.differ, a.sampled
        ));
    }
    if a.met().is_none() {
        terminal.note(&format!(
            "the error of {} of {} sampled points could not be told: trajectories part so fast there that the same seed leads \
             elsewhere in a finer integration; what remains is |H|",
            a.parted,
            a.parted + a.compared
        ));
    }
}

fn quantiles(s: Spread) -> String {
    format!(
        "median {:.1e}, 99 % {:.1e}, worst {:.1e}",
        s.median, s.p99, s.worst
    )
}

fn worst(name: &str, spread: Option<Spread>) -> String {
    spread.map_or_else(String::new, |s| format!("; {name} worst {:.1e}", s.worst))
}

/// Infinite errors (what is no number was found) as null: JSON has no other word for them.
fn spread_json(spread: Option<Spread>) -> serde_json::Value {
    spread.map_or(
        serde_json::Value::Null,
        |s| serde_json::json!({ "median": s.median, "p99": s.p99, "max": s.worst }),
    )
}
