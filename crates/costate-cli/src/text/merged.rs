//! What was put together.

use super::{covered, no_further};
use costate::run::{Merged, listed};
use costate::session::summary::RunSummary;
use std::fmt::Write;

pub fn merged(merged: &Merged) -> String {
    let mut text = format!("{} of {} shards", merged.files, merged.shards);
    if let Some(solved) = &merged.summary.homotopy {
        let statuses: Vec<String> = (solved.status.iter())
            .map(|(name, count)| format!("{count} {}", name.replace('_', " ")))
            .collect();
        let _ = write!(
            text,
            ": {} states: {}; {} solutions",
            solved.states,
            statuses.join(", "),
            solved.solutions,
        );
        // Where states are missing nothing tells which of these are one.
        if !merged.summary.stopped {
            let _ = write!(text, " on {} sheets", solved.sheets);
        }
    }
    let all = &merged.summary;
    if all.trajectories > 0 {
        let _ = write!(text, ": {} trajectories; {}", all.trajectories, fronts(all));
    }
    if merged.summary.error_met == Some(false) {
        text += "\nthe error asked for was NOT met";
    }
    for (what, shards) in [
        ("missing", &merged.missing),
        ("not finished", &merged.unfinished),
    ] {
        if !shards.is_empty() {
            let _ = write!(text, "\nshards that are {what}: {}", listed(shards));
        }
    }
    let _ = write!(
        text,
        "\n{:.2} s, written to {}",
        merged.seconds,
        merged.path.display()
    );
    if merged.stay {
        text += "; the numbers of states stay in the parts, and are read from there";
    }
    text
}

/// How well the fronts of all parts are covered.
fn fronts(all: &RunSummary) -> String {
    let c = &all.coverage;
    if c.gaps() > 0 {
        let why = match c.gaps_for_want_of_seeds {
            0 => String::new(),
            some => {
                format!(", {some} for want of seeds (max_seeds counts for each shard) or of time")
            }
        };
        return format!(
            "fronts NOT fully covered: {} gaps wider than {} remain{why}, the widest {:.3} of the region",
            c.gaps(),
            c.spacing,
            c.widest_gap.unwrap_or(f64::INFINITY)
        );
    }
    match all.stopped {
        true => format!(
            "fronts covered as far as they are there: {}",
            no_further(c.spacing)
        ),
        false => covered(c.spacing, all.failed(), c.far()),
    }
}
