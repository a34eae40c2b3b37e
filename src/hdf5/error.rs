//! What can go wrong while a result file is declared, written and put in place.

use crate::files::FileError;
use rust_hdf5::Hdf5Error;
use std::io;
use std::path::{Path, PathBuf};

/// A result file could not be declared, written or put in place.
///
/// `path` is always the final name the caller gave, not the temporary one.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// The file could not be begun, written or given its name.
    #[error(transparent)]
    File(#[from] FileError),
    /// The HDF5 layer refused, for a reason other than I/O.
    #[error("cannot write {object} of the result file {}: {source}", path.display())]
    Hdf5 {
        /// The final name.
        path: PathBuf,
        /// The group, variable or attribute in hand.
        object: String,
        /// The HDF5 layer's answer.
        source: Box<Hdf5Error>,
    },
    /// Two dimensions or variables of a group, or two groups, have one name.
    #[error("{group}: `{name}` is declared twice")]
    Duplicate {
        /// The group.
        group: String,
        /// The name.
        name: String,
    },
    /// A name HDF5 or netCDF cannot hold: empty, `.`, or with a `/`.
    #[error("{group}: {name:?} is not a name a group, dimension or variable can have")]
    InvalidName {
        /// The group.
        group: String,
        /// The name.
        name: String,
    },
    /// A variable names a dimension that its group does not declare.
    #[error("{group}: the variable `{variable}` has the undeclared dimension `{dimension}`")]
    UnknownDimension {
        /// The group.
        group: String,
        /// The variable.
        variable: String,
        /// The dimension it names.
        dimension: String,
    },
    /// A fixed dimension of length zero: leave the dimension and its variables out instead.
    #[error("{group}: the dimension `{dimension}` has length zero")]
    EmptyDimension {
        /// The group.
        group: String,
        /// The dimension.
        dimension: String,
    },
    /// Only the first dimension of a variable, and one dimension of a group, can grow.
    #[error("{group}: the growing dimension `{dimension}` is not the only one or not the first")]
    GrowingDimension {
        /// The group.
        group: String,
        /// The dimension.
        dimension: String,
    },
    /// A block was appended to a group without a growing dimension.
    #[error("{group}: no dimension of this group grows")]
    NotGrowing {
        /// The group.
        group: String,
    },
    /// Values were handed over for a variable that the group does not have (or does not have there:
    /// `append` takes growing variables, `write` the others).
    #[error("{group}: there is no variable `{variable}` to write to here")]
    UnknownVariable {
        /// The group.
        group: String,
        /// The variable.
        variable: String,
    },
    /// A column, attribute or dimension that the schema of its group does not have.
    #[error("{group}: `{name}` is not in the schema of the result file")]
    NotInSchema {
        /// The group.
        group: String,
        /// The name.
        name: String,
    },
    /// A block lacks a growing variable: all grow in step.
    #[error("{group}: the block has no values for `{variable}`")]
    MissingVariable {
        /// The group.
        group: String,
        /// The variable.
        variable: String,
    },
    /// The number of values is not that of the variable's shape.
    #[error("{group}: `{variable}` takes {expected} values here, got {found}")]
    Length {
        /// The group.
        group: String,
        /// The variable.
        variable: String,
        /// What the shape asks for.
        expected: usize,
        /// What was handed over.
        found: usize,
    },
    /// The values' type is not the variable's.
    #[error("{group}: `{variable}` takes {expected} values, got {found}")]
    Type {
        /// The group.
        group: String,
        /// The variable.
        variable: String,
        /// The declared type.
        expected: &'static str,
        /// The type handed over.
        found: &'static str,
    },
}

impl OutputError {
    /// Sorts an error of the HDF5 layer: the operating system's answers come out as
    /// [`FileError::Write`], all others with the `object` in hand.
    pub(super) fn from_hdf5(path: &Path, object: &str, error: Hdf5Error) -> Self {
        match io_cause(error) {
            Ok(source) => Self::File(FileError::Write {
                path: path.to_owned(),
                source,
            }),
            Err(source) => Self::Hdf5 {
                path: path.to_owned(),
                object: object.to_owned(),
                source: Box::new(source),
            },
        }
    }
}

/// The I/O error within an HDF5 error, or that error back.
pub(super) fn io_cause(error: Hdf5Error) -> Result<io::Error, Hdf5Error> {
    match error {
        Hdf5Error::Io(cause) => Ok(cause),
        // The inner type is private to the crate and has no `source`, so the operating system's
        // error number is only in the text, as the standard library prints it.
        Hdf5Error::IoLayer(inner) => match os_error_number(&inner.to_string()) {
            Some(number) => Ok(io::Error::from_raw_os_error(number)),
            None => Err(Hdf5Error::IoLayer(inner)),
        },
        other => Err(other),
    }
}

fn os_error_number(text: &str) -> Option<i32> {
    let (_, tail) = text.rsplit_once("(os error ")?;
    tail.split_once(')')?.0.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_os_error_number_survives_the_hdf5_layer() {
        let full = io::Error::from_raw_os_error(28);
        assert_eq!(os_error_number(&format!("I/O error: {full}")), Some(28));
        assert_eq!(os_error_number("invalid state: not chunked"), None);
    }

    #[test]
    fn only_io_errors_become_write_errors() {
        let path = Path::new("a.h5");
        let state = Hdf5Error::InvalidState("no".into());
        assert!(matches!(
            OutputError::from_hdf5(path, "t", state),
            OutputError::Hdf5 { .. }
        ));
        let io = Hdf5Error::Io(io::Error::other("gone"));
        assert!(matches!(
            OutputError::from_hdf5(path, "t", io),
            OutputError::File(FileError::Write { .. })
        ));
    }
}
