//! Why a run with files did not succeed.

use crate::feedback::FitError;
use crate::files::FileError;
use crate::hdf5::OutputError;
use crate::result::{StoredError, StoredMapError};
use crate::scenario::LoadError;
use crate::session::SessionError;
use std::path::PathBuf;

/// Why a run with files did not succeed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "its message says what each is")]
pub enum RunError {
    #[error(transparent)]
    Session(SessionError),
    #[error(transparent)]
    Load(#[from] LoadError),
    #[error(transparent)]
    Output(#[from] OutputError),
    #[error(transparent)]
    File(#[from] FileError),
    #[error(transparent)]
    Stored(#[from] StoredError),
    #[error(transparent)]
    Map(#[from] StoredMapError),
    #[error(transparent)]
    Merge(#[from] super::MergeError),
    #[error("{path} asks for no law: it has no [feedback] (or take one from another scene with --scene)", path = path.display())]
    NoFeedback { path: PathBuf },
    #[error("{path} holds neither trajectories with costates, solved states nor a map to an error to fit a law to", path = path.display())]
    NoData { path: PathBuf },
    #[error("law {laws} is not done, and {path} has laws already", path = path.display())]
    LawsLeftOut { laws: String, path: PathBuf },
    #[error("law `{name}` would be written to {path}, which is the scene: give another --out", path = path.display())]
    OverScene { name: String, path: PathBuf },
    #[error("{file} gives no first guesses: {why}; leave --archive out, or name the result of `costate shoot-out` of this scene", file = file.display())]
    NoSweep { file: PathBuf, why: &'static str },
    #[error("the states and controls of {scene} are not those of {file}", scene = scene.display(), file = file.display())]
    OtherScene { scene: PathBuf, file: PathBuf },
}

impl<E: Into<SessionError>> From<E> for RunError {
    fn from(error: E) -> Self {
        Self::Session(error.into())
    }
}

impl RunError {
    /// Whether the time given did not suffice to fit laws.
    #[must_use]
    pub fn is_of_time(&self) -> bool {
        matches!(
            self,
            Self::LawsLeftOut { .. } | Self::Session(SessionError::Fit(FitError::OutOfTime { .. }))
        )
    }

    /// Whether what was asked for is at fault; else it could not be carried out.
    #[must_use]
    pub fn is_of_input(&self) -> bool {
        match self {
            Self::LawsLeftOut { .. } => false,
            Self::Session(error) => error.is_of_input(),
            Self::Output(OutputError::File(error)) | Self::File(error) => error.is_of_name(),
            Self::Output(_) => false,
            _ => true,
        }
    }
}
