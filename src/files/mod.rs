//! Files on disk: there under their final name only when they are complete.

mod error;
mod temporary;
#[cfg(test)]
pub(crate) mod testing;

pub use error::FileError;
pub use temporary::Temporary;
#[cfg(unix)]
pub use temporary::removed_at_signals;

use std::ffi::{OsStr, OsString};
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Tells apart the temporary files of one process.
static TEMPORARIES: AtomicU64 = AtomicU64::new(0);

/// A file being written under a hidden name beside its final one. Dropped before [`Draft::publish`]
/// it leaves nothing, and an older file under the final name stays as it is.
#[derive(Debug)]
pub struct Draft {
    path: PathBuf,
    temporary: Temporary,
}

impl Draft {
    /// Claims the hidden name for the file that will be `path`; missing parent directories are
    /// made. The caller makes the file.
    ///
    /// # Errors
    /// Those of [`target`], and [`FileError::CreateDirectory`].
    pub fn begin(path: &Path) -> Result<Self, FileError> {
        let path = target(path)?;
        let directory = directory_of(&path);
        make(directory)?;
        let temporary = hidden(directory, path.file_name().unwrap_or_default());
        Ok(Self { path, temporary })
    }

    /// The name the file will have.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The hidden name it has now.
    pub fn hidden(&self) -> &Path {
        self.temporary.path()
    }

    /// Gives the complete file its final name, replacing what was there; returns that name.
    ///
    /// # Errors
    /// [`FileError::Rename`]; the file is then gone, and an older one is still there.
    pub fn publish(self) -> Result<PathBuf, FileError> {
        let Self { path, temporary } = self;
        temporary
            .publish(&path)
            .map_err(|source| FileError::Rename {
                path: path.clone(),
                source,
            })?;
        // The file is complete and in place; some network file systems refuse to flush a directory.
        let _ = sync_directory(directory_of(&path));
        Ok(path)
    }
}

/// The file that a path names: of a link the one that it leads to.
///
/// # Errors
/// [`FileError::NoFileName`], [`FileError::TargetIsDirectory`] and [`FileError::TargetIsSpecial`]:
/// nothing but a regular file is replaced.
pub fn target(given: &Path) -> Result<PathBuf, FileError> {
    let linked = given
        .is_symlink()
        .then(|| fs::canonicalize(given).ok())
        .flatten();
    let path = linked.unwrap_or_else(|| given.to_owned());
    if path.file_name().is_none() {
        return Err(FileError::NoFileName { path });
    }
    if path.is_dir() {
        return Err(FileError::TargetIsDirectory { path });
    }
    if path.exists() && !path.is_file() {
        return Err(FileError::TargetIsSpecial { path });
    }
    Ok(path)
}

/// Puts a text file in place whole: written beside it under a hidden name, flushed and renamed.
///
/// # Errors
/// Those of [`Draft::begin`], [`FileError::Create`], [`FileError::Write`] and
/// [`FileError::Rename`]; an older file under the name is then still there.
pub fn write_text(path: &Path, text: &str) -> Result<(), FileError> {
    write_bytes(path, text.as_bytes())
}

/// As [`write_text`], for a file of any kind.
///
/// # Errors
/// Those of [`write_text`].
pub fn write_bytes(path: &Path, bytes: &[u8]) -> Result<(), FileError> {
    let draft = Draft::begin(path)?;
    let at = || draft.path().to_owned();
    let mut file =
        File::create(draft.hidden()).map_err(|source| FileError::Create { path: at(), source })?;
    let written = file.write_all(bytes).and_then(|()| file.sync_all());
    drop(file);
    written.map_err(|source| FileError::Write { path: at(), source })?;
    draft.publish().map(drop)
}

/// Puts files in place together: all are written under hidden names in `beside`, a directory of the
/// same file system, before any gets its own. Parent directories are made then.
///
/// # Errors
/// As [`write_text`]; where one cannot be written none is in place.
pub fn write_together(files: &[(PathBuf, Vec<u8>)], beside: &Path) -> Result<(), FileError> {
    let mut drafts = Vec::with_capacity(files.len());
    for (path, bytes) in files {
        let path = target(path)?;
        make(beside)?;
        let draft = hidden(beside, path.file_name().unwrap_or_default());
        fs::write(draft.path(), bytes).map_err(|source| FileError::Write {
            path: path.clone(),
            source,
        })?;
        drafts.push((path, draft));
    }
    for (path, draft) in drafts {
        make(directory_of(&path))?;
        draft
            .publish(&path)
            .map_err(|source| FileError::Rename { path, source })?;
    }
    Ok(())
}

/// Whether files can be made in a directory: by making one, which is taken away again.
///
/// # Errors
/// Those of making it.
pub fn can_hold(directory: &Path) -> io::Result<()> {
    let trial = hidden(directory, "costate".as_ref());
    File::create_new(trial.path()).map(drop)
}

/// A hidden name in a directory for a file to be called so.
fn hidden(directory: &Path, name: &OsStr) -> Temporary {
    let serial = TEMPORARIES.fetch_add(1, Ordering::Relaxed);
    let mut hidden = OsString::from(".");
    hidden.push(name);
    hidden.push(format!(".{}-{serial}.tmp", std::process::id()));
    Temporary::new(directory.join(hidden))
}

/// Makes a directory that may be there.
///
/// # Errors
/// [`FileError::CreateDirectory`].
pub fn make(directory: &Path) -> Result<(), FileError> {
    fs::create_dir_all(directory).map_err(|source| FileError::CreateDirectory {
        directory: directory.to_owned(),
        source,
    })
}

/// The directory that a file lies in.
pub fn directory_of(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

/// Makes a rename durable, where directories can be flushed.
fn sync_directory(directory: &Path) -> io::Result<()> {
    if cfg!(unix) {
        File::open(directory)?.sync_all()?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::testing::TemporaryDirectory;
    use super::*;

    fn entries(directory: &Path) -> Vec<String> {
        let mut names: Vec<String> = fs::read_dir(directory)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn a_text_is_there_whole_or_not_at_all() {
        let directory = TemporaryDirectory::new("text");
        let path = directory.path().join("picture.svg");
        for text in ["first", "second"] {
            write_text(&path, text).unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), text);
        }
        let taken = directory.path().join("taken");
        fs::create_dir(&taken).unwrap();
        assert!(matches!(
            write_text(&taken, "no"),
            Err(FileError::TargetIsDirectory { .. })
        ));
        // Together: where one cannot be, none is.
        let both = [
            (directory.path().join("pictures/a.svg"), b"a".to_vec()),
            (taken.clone(), b"no".to_vec()),
        ];
        assert!(write_together(&both, directory.path()).is_err());
        assert_eq!(entries(directory.path()), ["picture.svg", "taken"]);
        write_together(&both[..1], directory.path()).unwrap();
        assert_eq!(fs::read(&both[0].0).unwrap(), b"a");
        fs::remove_dir_all(directory.path().join("pictures")).unwrap();
        // A missing directory is made, as for result files.
        write_text(&directory.path().join("new/sub/table.csv"), "x").unwrap();
        assert_eq!(entries(directory.path()), ["new", "picture.svg", "taken"]);
    }
}
