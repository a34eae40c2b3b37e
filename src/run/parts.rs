//! Parts of a scene in a result file.

use super::RunError;
use crate::attenuation::Attenuated;
use crate::hdf5::ResultFile;
use crate::model::Model;
use crate::result::TrajectorySchema;
use crate::study::Variant;

/// Writes the groups of a study.
///
/// # Errors
/// Those of writing.
pub fn write_study(
    file: &mut ResultFile,
    model: &Model,
    variants: &[Variant],
) -> Result<(), RunError> {
    match &model.study {
        Some(asked) => Ok(file.study(&TrajectorySchema::axes(model), asked, variants)?),
        None => Ok(()),
    }
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
