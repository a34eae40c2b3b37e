//! Parts of a scene in a result file.

use super::{Provenance, RunError, in_json};
use crate::attenuation::Attenuated;
use crate::hdf5::ResultFile;
use crate::model::Model;
use crate::result::TrajectorySchema;
use crate::session::Session;
use crate::session::summary::RunSummary;
use crate::study::Variant;

/// Writes the groups of a study and its summary, which is returned; of one that was ended before it was done the file
/// says so.
///
/// # Errors
/// Those of writing.
pub(super) fn write_study(
    session: &Session<'_>,
    file: &mut ResultFile,
    (variants, stopped): (&[Variant], bool),
    provenance: &Provenance,
) -> Result<RunSummary, RunError> {
    let model = &session.scene().model;
    if let (Some(asked), false) = (&model.study, variants.is_empty()) {
        file.study(&TrajectorySchema::axes(model), asked, variants)?;
    }
    if stopped {
        file.attribute("stopped", 1i64)?;
    }
    let summary = RunSummary {
        stopped,
        ..session.study_summary(variants, file.path(), provenance.seconds())
    };
    file.attribute("summary", in_json(&summary))?;
    Ok(summary)
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
