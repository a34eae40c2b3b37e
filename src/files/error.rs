//! What can go wrong while a file is put in place.

use std::io;
use std::path::PathBuf;

/// A file could not be put in place.
///
/// `path` is always the final name the caller gave, not the hidden one.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The final name is a directory, so nothing can be renamed to it.
    #[error("cannot write {}: it is a directory; name a file in it", path.display())]
    TargetIsDirectory {
        /// The final name.
        path: PathBuf,
    },
    /// The final name is a device, a pipe or a socket, which a rename would destroy.
    #[error("cannot write {}: it is a device, a pipe or a socket; name a regular file", path.display())]
    TargetIsSpecial {
        /// The final name.
        path: PathBuf,
    },
    /// The path ends in `..` or is empty or a root, so it names no file.
    #[error("cannot write {:?}: the path has no file name", path)]
    NoFileName {
        /// The final name.
        path: PathBuf,
    },
    /// A parent directory is missing and cannot be made.
    #[error("cannot create the directory {}: {source}", directory.display())]
    CreateDirectory {
        /// The directory.
        directory: PathBuf,
        /// The operating system's answer.
        source: io::Error,
    },
    /// The temporary file beside the final name cannot be created.
    #[error("cannot create {}: {source}", path.display())]
    Create {
        /// The final name.
        path: PathBuf,
        /// The operating system's answer.
        source: io::Error,
    },
    /// The operating system refused a write, a disk that is full included.
    #[error("cannot write to {}: {source}", path.display())]
    Write {
        /// The final name.
        path: PathBuf,
        /// The operating system's answer.
        source: io::Error,
    },
    /// The complete file cannot be renamed to its final name.
    #[error("cannot give the finished file its name {}: {source}", path.display())]
    Rename {
        /// The final name.
        path: PathBuf,
        /// The operating system's answer.
        source: io::Error,
    },
}

impl FileError {
    /// Whether no file can have the name, whatever is free on the disk: not at all, or not there.
    pub fn is_of_name(&self) -> bool {
        match self {
            Self::TargetIsDirectory { .. }
            | Self::TargetIsSpecial { .. }
            | Self::NoFileName { .. } => true,
            Self::CreateDirectory { source, .. } | Self::Create { source, .. } => {
                is_of_place(source)
            }
            Self::Write { .. } | Self::Rename { .. } => false,
        }
    }
}

/// Whether a place can hold no new file or directory, whatever is free on the disk.
fn is_of_place(error: &io::Error) -> bool {
    use io::ErrorKind::{
        AlreadyExists, InvalidFilename, NotADirectory, NotFound, PermissionDenied,
        ReadOnlyFilesystem,
    };
    matches!(
        error.kind(),
        AlreadyExists
            | InvalidFilename
            | NotADirectory
            | NotFound
            | PermissionDenied
            | ReadOnlyFilesystem
    )
}
