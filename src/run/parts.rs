//! Parts of a scene in a result file.

use super::{Provenance, RunError, in_json, note_replaced, path_of_stopped};
use crate::attenuation::Attenuated;
use crate::hdf5::ResultFile;
use crate::model::Model;
use crate::result::TrajectorySchema;
use crate::session::Session;
use crate::session::summary::RunSummary;
use crate::study::Variant;

/// Writes the groups of a study that a session has made, and its summary. Returns whether the
/// session was ended before: then the file says so, and has the name of an unfinished result.
///
/// # Errors
/// Those of writing.
pub fn write_study(
    session: &Session<'_>,
    file: &mut ResultFile,
    variants: &[Variant],
    provenance: &Provenance,
) -> Result<bool, RunError> {
    let stopped = session.is_over();
    let model = &session.scene().model;
    if let Some(asked) = &model.study {
        file.study(&TrajectorySchema::axes(model), asked, variants)?;
    }
    if stopped {
        file.attribute("stopped", 1i64)?;
        file.rename(path_of_stopped(file.path()));
        note_replaced(session, file.path());
    }
    let summary = RunSummary {
        stopped,
        ..session.study_summary(variants, file.path(), provenance.seconds())
    };
    file.attribute("summary", in_json(&summary))?;
    Ok(stopped)
}

/// Writes the groups of the smallest levels of attenuation.
///
/// # Errors
/// Those of writing.
pub fn write_attenuation(
    file: &mut ResultFile,
    model: &Model,
    found: &Attenuated,
) -> Result<(), RunError> {
    Ok(file.attenuation(&TrajectorySchema::axes(model), found)?)
}
