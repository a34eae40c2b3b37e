//! Files of parts of the whole: what each says of itself, and how they become one.

mod before;
mod elsewhere;
mod levels;
mod loops;
mod manifest;
mod merge;
mod part;
mod rows;
mod source;
mod stream;
mod study;
mod sweep;
mod whole;

pub use levels::{LevelsDone, levels};
pub use loops::LoopsDone;
pub(super) use loops::{Divided, loops};
pub(super) use manifest::hash_of;
pub use manifest::{Asked, Kind, Loops, Manifest};
pub use merge::{MergeError, MergeOptions, Merged, listed, merge};
pub(super) use part::run;
pub use study::{StudyDone, study};
pub(super) use sweep::PartOfSweep;

use super::RunError;
use crate::hdf5::ResultFile;
use crate::result::{MANIFEST, ShardGroups, TrajectorySchema};
use crate::session::Part;
use crate::value::Answers;
use crate::value::blocks::Seam;

/// The root attribute that the manifest of a whole is in.
const WHOLE: &str = "whole";

/// Writes the states that were solved for as a part of the whole: all of them to `/points`, those
/// of a map too, with what is needed to put parts together.
///
/// # Errors
/// Those of writing.
pub(super) fn write_states(
    file: &mut ResultFile,
    schema: &TrajectorySchema,
    (answers, part): (&Answers, &Part),
) -> Result<(), RunError> {
    file.points(schema, answers, 0, answers.targets.of_given.len())?;
    file.sheet_edges(schema, answers)?;
    Ok(file.shard(&groups(answers, part))?)
}

/// Notes what a file is a part of.
///
/// # Errors
/// Those of writing.
pub(super) fn write_manifest(file: &ResultFile, manifest: &Manifest) -> Result<(), RunError> {
    file.attribute("shard", manifest.shard as i64)?;
    file.attribute("shards", manifest.shards as i64)?;
    let text = serde_json::to_string(manifest).unwrap_or_default();
    Ok(file.attribute(MANIFEST, text)?)
}

/// Notes what a file is the whole of.
///
/// # Errors
/// Those of writing.
pub(super) fn write_whole(file: &ResultFile, manifest: &Manifest) -> Result<(), RunError> {
    let text = serde_json::to_string(&manifest.whole()).unwrap_or_default();
    Ok(file.attribute(WHOLE, text)?)
}

/// Where the rows of a part belong.
fn groups(answers: &Answers, part: &Part) -> ShardGroups {
    let targets = &answers.targets;
    let number = |k: usize| i32::try_from(k).unwrap_or(i32::MAX);
    let of_answer = |target: usize| {
        let place = |entry: &crate::value::Entry| {
            let here = answers.of(target);
            here.iter().position(|other| std::ptr::eq(other, entry))
        };
        let place = answers.answer(target).and_then(place);
        place.map_or(-1, |k| part.sheet_within[answers.first[target] + k])
    };
    let entries = targets.of_given.iter().flat_map(|t| {
        part.sheet_within[answers.first[*t]..answers.first[*t + 1]]
            .iter()
            .copied()
    });
    let mut seen = vec![false; targets.len()];
    let again = |t: &usize| i32::from(std::mem::replace(&mut seen[*t], true));
    ShardGroups {
        again: targets.of_given.iter().map(again).collect(),
        number: part.own.iter().map(|k| number(*k)).collect(),
        done: part.is_done.iter().map(|done| i32::from(*done)).collect(),
        states: part.states.iter().map(|k| number(*k)).collect(),
        index: targets.rows.iter().map(|k| number(*k)).collect(),
        block: part.block_of.iter().map(|k| number(*k)).collect(),
        sheet: targets.of_given.iter().map(|t| of_answer(*t)).collect(),
        entry_sheet: entries.collect(),
        seams: part.seams.iter().flat_map(Seam::to_numbers).collect(),
    }
}
