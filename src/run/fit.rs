//! Laws fitted to what a result file holds, written into it and beside it.

use super::{RunError, STOPPED};
use crate::backend::Deadline;
use crate::backend::cpu::in_pool;
use crate::feedback::{Exports, Fitted, Samples};
use crate::files::{FileError, can_hold, make};
use crate::hdf5::ResultFile;
use crate::map::ValueMap;
use crate::model::{Feedback, Model};
use crate::result::{FEEDBACK_GROUP, Stored, StoredMapError};
use crate::schema;
use crate::session::{FitData, Progress, fit_laws, same_problem};
use crate::trajectories::SweptTrajectories;
use std::path::{Path, PathBuf};

/// Laws of a scene as fitted, with the files written of each.
pub struct FittedFiles {
    /// The laws.
    pub fitted: Fitted,
    /// The files, one entry a law.
    pub exports: Vec<Exports>,
}

/// Where the laws' files go, and what their names begin with.
#[derive(Clone, Debug)]
pub struct LawFiles {
    directory: PathBuf,
    stem: String,
}

impl LawFiles {
    /// Beside a result file, unless a directory is given.
    #[must_use]
    pub fn new(path: &Path, directory: Option<&Path>) -> Self {
        let directory = directory.or(path.parent()).unwrap_or(Path::new(""));
        let stem = path.file_stem().unwrap_or_default().to_string_lossy();
        Self {
            directory: directory.to_owned(),
            stem: stem.into_owned(),
        }
    }

    /// Those of a run that was ended early: where files of an earlier run have the usual names, as
    /// a result's would be, `STEM_stopped_NAME.toml` and so on.
    pub(super) fn of_stopped(path: &Path, laws: &[Feedback]) -> Self {
        let mut files = Self::new(path, None);
        let there = |law: &Feedback| {
            ["toml", "h", "onnx"]
                .iter()
                .any(|ending| files.of(&law.name, ending).exists())
        };
        // Beside an older result the file itself has such a name already.
        if !files.stem.ends_with(STOPPED) && laws.iter().any(there) {
            files.stem.push_str(STOPPED);
        }
        files
    }

    fn of(&self, law: &str, ending: &str) -> PathBuf {
        self.directory.join(format!("{}_{law}.{ending}", self.stem))
    }

    /// Writes the files of laws; `model` is the scene that their samples are solutions of.
    ///
    /// # Errors
    /// Those of writing.
    pub(super) fn write(&self, fitted: &Fitted, model: &Model) -> Result<Vec<Exports>, RunError> {
        let directory = &self.directory;
        if !directory.as_os_str().is_empty() {
            make(directory)?;
        }
        Ok(fitted.export(directory, &self.stem, model)?)
    }

    /// Whether the files can be written there, as far as that can be told before: fitting takes
    /// long.
    pub(super) fn check(&self, scene: &Model, laws: &[Feedback]) -> Result<(), RunError> {
        // What is not there yet is made in what is.
        let place = self.directory.ancestors().find(|d| d.exists());
        let place = place.unwrap_or(Path::new("."));
        let holds = match place.is_dir() {
            true => can_hold(place),
            false => Err(std::io::Error::other(format!(
                "{} is not a directory",
                place.display()
            ))),
        };
        holds.map_err(|source| FileError::CreateDirectory {
            directory: self.directory.clone(),
            source,
        })?;

        let scene = std::fs::canonicalize(&scene.file_name).ok();
        for law in laws {
            let weights = self.of(&law.name, "toml");
            if scene.is_some() && scene == std::fs::canonicalize(&weights).ok() {
                return Err(RunError::OverScene {
                    name: law.name.clone(),
                    path: weights,
                });
            }
        }
        Ok(())
    }
}

/// Whether a file has a map to an error to draw samples from; on a finite horizon laws are fitted
/// along trajectories.
fn is_mapped(stored: &Stored) -> bool {
    stored.has(&schema::MAP_PIECES) && stored.scene.model.final_time().is_none()
}

/// The map that knows which samples are optimal, where solutions of several sheets may be in the
/// file, or samples are the map's own; `None` where it is not needed, or the file holds no values.
fn judge(stored: &Stored, mapped: bool) -> Result<Option<ValueMap>, RunError> {
    let periodic = stored.scene.model.states.iter().any(|s| s.period.is_some());
    if !(periodic || stored.has(&schema::POINTS_SHEETS) || mapped) {
        return Ok(None);
    }
    match stored.value_map() {
        Ok(map) => Ok(Some(map)),
        Err(StoredMapError::Empty { .. }) => Ok(None),
        Err(e) => Err(e.into()),
    }
}

/// Fits `laws` of `scene` to what a result file holds, writes `/feedback` into it, and the laws'
/// files to where they go. Laws for which the time does not suffice are left out.
///
/// # Errors
/// Where there is nothing to fit to, no law can be fitted by the deadline, some cannot and the file
/// has laws already, or files cannot be written.
pub fn fit_stored(
    stored: &Stored,
    scene: &Model,
    laws: &[Feedback],
    files: &LawFiles,
    going: (&dyn Progress, Deadline),
) -> Result<FittedFiles, RunError> {
    files.check(scene, laws)?;
    let fitted = fit_into(stored, scene, laws, going)?;
    let exports = files.write(&fitted, &stored.scene.model)?;
    Ok(FittedFiles { fitted, exports })
}

/// The same without the laws' files.
pub(super) fn fit_into(
    stored: &Stored,
    scene: &Model,
    laws: &[Feedback],
    (progress, deadline): (&dyn Progress, Deadline),
) -> Result<Fitted, RunError> {
    let own = &stored.scene.model;
    let sizes = (own.states.len(), own.controls.len());
    let swept = stored.trajectories()?.filter(SweptTrajectories::is_full);
    let solved = stored.points()?;
    let samples = Samples::new(sizes, swept.as_ref(), solved.as_ref());
    let mapped = is_mapped(stored);
    if samples.is_empty() && !mapped {
        let path = stored.name();
        return Err(RunError::NoData { path });
    }

    if !same_problem(own, scene) {
        progress.note(
            "what the file holds is of another problem (other parameters, equations or cost): laws fitted to it are those of the file's problem",
        );
    }
    progress.step("reading the value map");
    let map = judge(stored, mapped).inspect_err(|_| progress.step_ended())?;
    let data = FitData {
        scene: &stored.scene,
        samples: &samples,
        map: map.as_ref(),
        draws: mapped,
        deadline,
    };
    let fitted = in_pool(|| fit_laws(&data, scene, laws, progress))?;
    let left_out = &fitted.left_out;
    if !left_out.is_empty() && stored.group(FEEDBACK_GROUP).is_some() {
        let (laws, path) = (left_out.join(", "), stored.path.clone());
        return Err(RunError::LawsLeftOut { laws, path });
    }

    let mut file = ResultFile::extend(&stored.path, &[FEEDBACK_GROUP])?;
    fitted.write(&mut file)?;
    file.finish()?;
    Ok(fitted)
}
