//! What a run prints: heading, progress, summary.

use super::{CliError, RunArgs, SceneArgs};
use crate::backend::{Backend, Status};
use crate::model::Model;
use crate::output::RunRecord;
use crate::sweep::{Plan, Sampling, SweepReport};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
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

    fn say(&self, text: &str) -> std::io::Result<()> {
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

    pub fn heading(&self, model: &Model, plan: &Plan, backend: &dyn Backend, args: &RunArgs) {
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
        if plan.sampling == Sampling::ArcLength {
            self.note("the running cost is negative in places: V is not monotone along trajectories, which are sampled by arc length");
        }
        if let Some(local) = &plan.local
            && local.error
                > 0.1 * plan.run.rtol * plan.run.levels.get(plan.inner).copied().unwrap_or(f64::INFINITY) * 1.0001
            && plan.sampling == Sampling::Value
        {
            self.note(&format!(
                "the local solution's error at the seeds, {:.1e}, is above the tolerance: choose a smaller seed_value or \"auto\"",
                local.error
            ));
        }
        if args.seed != 0 {
            self.note("--seed has no effect on a sweep, which makes no random choices");
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

    pub fn summary(
        &self,
        plan: &Plan,
        swept: &SweepReport,
        record: &RunRecord,
        path: &Path,
        seconds: f64,
    ) -> Result<(), CliError> {
        if self.json {
            writeln!(std::io::stdout(), "{:#}", as_json(plan, swept, record, path, seconds))?;
        }
        self.say(&as_text(plan, swept, path, seconds))?;
        Ok(())
    }
}

/// The progress of a sweep.
pub(super) struct Bar(ProgressBar);

impl Bar {
    pub fn update(&self, done: usize, waiting: usize) {
        self.0
            .set_message(format!("{done} trajectories, {waiting} gaps to fill"));
    }

    pub fn clear(&self) {
        self.0.finish_and_clear();
    }
}

/// Ends that say nothing about the problem but that the integration could not go on.
const FAILURES: [Status; 3] = [Status::StepFloor, Status::StepLimit, Status::NotFinite];

/// Quantiles of |H|: median, 99 %, largest.
fn quantiles(drift: &[f64]) -> [f64; 3] {
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

fn as_text(plan: &Plan, swept: &SweepReport, path: &Path, seconds: f64) -> String {
    let statuses = (swept.by_status.iter())
        .map(|(s, n)| format!("{n} {}", plan.status_name(*s).replace('_', " ")))
        .collect::<Vec<_>>();
    let c = &swept.coverage;
    let mut lines = vec![format!("{} trajectories: {}", swept.trajectories, statuses.join(", "))];
    if c.outside_guards > 0 {
        lines.push(format!("{} seeds outside the guards, not swept", c.outside_guards));
    }
    lines.push(if c.uncovered + c.indistinguishable == 0 {
        let failed: usize = (swept.by_status.iter())
            .filter(|(code, _)| FAILURES.iter().any(|f| *f as i32 == **code))
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
    lines.push(format!(
        "{seconds:.2} s, of which {:.2} s integrating ({:.0} trajectories/s), {} steps, {} rejected, {} rounds",
        swept.integrate_seconds,
        swept.trajectories as f64 / swept.integrate_seconds.max(1e-9),
        swept.steps,
        swept.rejected,
        swept.rounds
    ));
    lines.push(format!("written to {}", path.display()));
    lines.join("\n")
}

fn as_json(plan: &Plan, swept: &SweepReport, record: &RunRecord, path: &Path, seconds: f64) -> serde_json::Value {
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
        "steps": swept.steps,
        "rejected": swept.rejected,
        "rounds": swept.rounds,
        "integrate_seconds": swept.integrate_seconds,
        "wall_seconds": seconds,
        "trajectories_per_second": swept.trajectories as f64 / swept.integrate_seconds.max(1e-9),
    })
}
