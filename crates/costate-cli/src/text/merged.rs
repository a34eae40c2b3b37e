//! What was put together.

use super::far_text;
use costate::run::{Merged, listed};
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
        let c = &all.coverage;
        let of_what = if all.stopped { "; in these " } else { "; " };
        let _ = write!(
            text,
            ": {} trajectories{of_what}{} gaps wider than {} remain",
            all.trajectories,
            c.gaps(),
            c.spacing
        );
        if c.gaps_for_want_of_seeds > 0 {
            let _ = write!(
                text,
                " ({} for want of seeds or time: max_seeds counts for each shard)",
                c.gaps_for_want_of_seeds
            );
        }
        if let Some(step) = all.coverage.far() {
            let _ = write!(text, "; {}", far_text(step));
        }
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
