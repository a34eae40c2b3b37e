//! The file itself: there under its final name only when it is complete.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use rust_hdf5::{H5File, Hdf5Error};

use super::attribute::AttributeOwner;
use super::error::io_cause;
use super::{AttributeValue, Group, GroupWriter, OutputError, Temporary};

/// Tells apart the temporary files of one process.
static TEMPORARIES: AtomicU64 = AtomicU64::new(0);

/// A result file being written.
///
/// It is written under a hidden name beside the final one. [`ResultFile::finish`] flushes it to the
/// disk and renames it; until then a file that was there under the final name stays as it is. A
/// `ResultFile` dropped before that leaves nothing, and a process that is killed outright nothing but the hidden file.
/// It belongs to one thread.
pub struct ResultFile {
    final_path: PathBuf,
    // Closed before the name is removed: some systems do not remove open files.
    file: Open,
    temporary: Temporary,
    groups: Vec<String>,
}

impl std::fmt::Debug for ResultFile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ResultFile")
            .field("final_path", &self.final_path)
            .field("temporary", &self.temporary)
            .field("groups", &self.groups)
            .finish_non_exhaustive()
    }
}

impl ResultFile {
    /// Begins the file that will be `final_path`; missing parent directories are made.
    ///
    /// # Errors
    /// [`OutputError::NoFileName`], [`OutputError::TargetIsDirectory`], [`OutputError::TargetIsSpecial`],
    /// [`OutputError::CreateDirectory`] and [`OutputError::Create`] (the directory is not writable,
    /// for example).
    pub fn create(final_path: impl AsRef<Path>) -> Result<Self, OutputError> {
        let (final_path, temporary) = begun(final_path.as_ref())?;
        // Nobody else knows the temporary name, and some network file systems refuse locks.
        let file = H5File::options()
            .no_locking()
            .track_order(true)
            .create(temporary.path())
            .map_err(|error| create_error(&final_path, error))?;
        Ok(Self {
            final_path,
            file: Open(Some(file)),
            temporary,
            groups: Vec::new(),
        })
    }

    /// A copy of the result file `path` without the groups named in `replace`, to which groups can be added;
    /// [`ResultFile::finish`] puts it in the place of `path`.
    ///
    /// # Errors
    /// As [`ResultFile::create`], and [`OutputError::Create`] where `path` cannot be copied.
    pub fn extend(path: impl AsRef<Path>, replace: &[&str]) -> Result<Self, OutputError> {
        let mut this = Self::create(path)?;
        let create = |source| OutputError::Create {
            path: this.final_path.clone(),
            source,
        };
        drop(this.file.0.take());
        fs::copy(&this.final_path, this.temporary.path()).map_err(create)?;
        let file = (H5File::options().no_locking().open_rw(this.temporary.path()))
            .map_err(|error| create_error(&this.final_path, error))?;
        for group in replace {
            if file
                .root_group()
                .group_names()
                .is_ok_and(|names| names.iter().any(|n| n == group))
            {
                file.delete_group(group).map_err(|e| this.error(group, e))?;
            }
        }
        this.groups = file.root_group().group_names().map_err(|e| this.error("/", e))?;
        this.file = Open(Some(file));
        Ok(this)
    }

    /// The name the file will have.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.final_path
    }

    /// Sets a root attribute.
    ///
    /// # Errors
    /// [`OutputError::Write`] and [`OutputError::Hdf5`].
    pub fn attribute(&self, name: &str, value: impl Into<AttributeValue>) -> Result<(), OutputError> {
        self.open_file()?
            .set(name, &value.into())
            .map_err(|error| self.error(&format!("the root attribute `{name}`"), error))
    }

    /// Makes a group with its coordinates, texts and empty variables, ready to be filled. Any
    /// number of groups can be open and filled in turn.
    ///
    /// # Errors
    /// [`OutputError`]'s variants on declarations, [`OutputError::Write`] and
    /// [`OutputError::Hdf5`].
    pub fn group(&mut self, group: &Group) -> Result<GroupWriter, OutputError> {
        group.check()?;
        if self.groups.contains(&group.name) {
            return Err(OutputError::Duplicate {
                group: "/".to_owned(),
                name: group.name.clone(),
            });
        }
        let writer = GroupWriter::create(self.open_file()?, &self.final_path, group)?;
        self.groups.push(group.name.clone());
        Ok(writer)
    }

    /// Flushes the file to the disk and gives it its final name, replacing what was there; returns
    /// that name. Writers of its groups can no longer write.
    ///
    /// # Errors
    /// [`OutputError::Write`], [`OutputError::Hdf5`] and [`OutputError::Rename`]; the file is then
    /// gone, and an older one under the final name is still there.
    pub fn finish(mut self) -> Result<PathBuf, OutputError> {
        if let Some(file) = self.file.0.take()
            && let Err(error) = file.close()
        {
            return Err(self.error("the end", error));
        }
        let Self {
            final_path, temporary, ..
        } = self;
        temporary.publish(&final_path).map_err(|source| OutputError::Rename {
            path: final_path.clone(),
            source,
        })?;
        // The file is complete and in place; some network file systems refuse to flush a directory.
        let _ = sync_directory(parent_directory(&final_path));
        Ok(final_path)
    }

    fn open_file(&self) -> Result<&H5File, OutputError> {
        self.file
            .0
            .as_ref()
            .ok_or_else(|| self.error("", Hdf5Error::InvalidState("the file is closed".into())))
    }

    fn error(&self, object: &str, error: Hdf5Error) -> OutputError {
        OutputError::from_hdf5(&self.final_path, object, error)
    }
}

/// An open file that is dropped is not flushed to the disk before it goes.
struct Open(Option<H5File>);

impl Drop for Open {
    fn drop(&mut self) {
        if let Some(file) = self.0.take() {
            let _ = file.close_no_sync();
        }
    }
}

/// The file that a path names: of a link the one that it leads to.
///
/// # Errors
/// [`OutputError::NoFileName`], [`OutputError::TargetIsDirectory`] and [`OutputError::TargetIsSpecial`]: nothing but a regular
/// file is replaced.
pub fn target(given: &Path) -> Result<PathBuf, OutputError> {
    let linked = given.is_symlink().then(|| fs::canonicalize(given).ok()).flatten();
    let path = linked.unwrap_or_else(|| given.to_owned());
    if path.file_name().is_none() {
        return Err(OutputError::NoFileName { path });
    }
    if path.is_dir() {
        return Err(OutputError::TargetIsDirectory { path });
    }
    if path.exists() && !path.is_file() {
        return Err(OutputError::TargetIsSpecial { path });
    }
    Ok(path)
}

/// The file that will have a name, and its hidden name until then, in a directory that is there.
fn begun(given: &Path) -> Result<(PathBuf, Temporary), OutputError> {
    let path = target(given)?;
    let mut hidden = std::ffi::OsString::from(".");
    hidden.push(path.file_name().unwrap_or_default());
    let serial = TEMPORARIES.fetch_add(1, Ordering::Relaxed);
    hidden.push(format!(".{}-{serial}.tmp", std::process::id()));
    let directory = parent_directory(&path);
    fs::create_dir_all(directory).map_err(|source| OutputError::CreateDirectory {
        directory: directory.to_owned(),
        source,
    })?;
    let temporary = Temporary::new(path.with_file_name(hidden));
    Ok((path, temporary))
}

/// Puts a text file in place whole: written beside it under a hidden name, flushed and renamed.
///
/// # Errors
/// Those of [`ResultFile::create`], [`OutputError::Write`] and [`OutputError::Rename`]; an older file under the name is then
/// still there.
pub fn write_text(path: &Path, text: &str) -> Result<(), OutputError> {
    write_bytes(path, text.as_bytes())
}

/// As [`write_text`], for a file of any kind.
///
/// # Errors
/// Those of [`write_text`].
pub fn write_bytes(path: &Path, bytes: &[u8]) -> Result<(), OutputError> {
    let (path, temporary) = begun(path)?;
    let at = || path.clone();
    let mut file = File::create(temporary.path()).map_err(|source| OutputError::Create { path: at(), source })?;
    let written = file.write_all(bytes).and_then(|()| file.sync_all());
    drop(file);
    written.map_err(|source| OutputError::Write { path: at(), source })?;
    (temporary.publish(&path)).map_err(|source| OutputError::Rename { path: at(), source })
}

fn parent_directory(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

fn create_error(path: &Path, error: Hdf5Error) -> OutputError {
    match io_cause(error) {
        Ok(source) => OutputError::Create {
            path: path.to_owned(),
            source,
        },
        Err(error) => OutputError::from_hdf5(path, "the beginning", error),
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
    use super::*;
    use crate::output::testing::TemporaryDirectory;

    fn entries(directory: &Path) -> Vec<String> {
        let mut names: Vec<String> = fs::read_dir(directory)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn a_dropped_file_leaves_the_old_one_and_no_temporary() {
        let directory = TemporaryDirectory::new("dropped");
        let path = directory.path().join("result.h5");
        fs::write(&path, b"older").unwrap();
        let file = ResultFile::create(&path).unwrap();
        file.attribute("title", "half").unwrap();
        let name = entries(directory.path())[0].clone();
        assert!(name.starts_with('.') && name.contains(&std::process::id().to_string()));
        drop(file);
        assert_eq!(entries(directory.path()), ["result.h5"]);
        assert_eq!(fs::read(&path).unwrap(), b"older");
    }

    #[test]
    fn finish_replaces_the_old_file() {
        let directory = TemporaryDirectory::new("finish");
        let path = directory.path().join("new/sub/result.h5");
        for title in ["first", "second"] {
            let file = ResultFile::create(&path).unwrap();
            file.attribute("title", title).unwrap();
            assert_eq!(file.finish().unwrap(), path);
            let back = H5File::open(&path).unwrap();
            assert_eq!(back.attr_string("title").unwrap(), title);
        }
        assert_eq!(entries(path.parent().unwrap()), ["result.h5"]);
    }

    #[test]
    fn two_files_of_one_process_do_not_share_a_temporary() {
        let directory = TemporaryDirectory::new("two");
        let path = directory.path().join("result.h5");
        let first = ResultFile::create(&path).unwrap();
        let second = ResultFile::create(&path).unwrap();
        assert_ne!(first.temporary.path(), second.temporary.path());
        first.finish().unwrap();
        drop(second);
        assert_eq!(entries(directory.path()), ["result.h5"]);
    }

    #[test]
    fn targets_that_cannot_be_files_are_named() {
        let directory = TemporaryDirectory::new("targets");
        let at = |name: &str| ResultFile::create(directory.path().join(name));
        assert!(matches!(at(""), Err(OutputError::TargetIsDirectory { .. })));
        assert!(matches!(at(".."), Err(OutputError::NoFileName { .. })));
        fs::write(directory.path().join("file"), b"").unwrap();
        assert!(matches!(at("file/result.h5"), Err(OutputError::CreateDirectory { .. })));
        let long = "n".repeat(300);
        let error = at(&long).unwrap_err();
        assert!(matches!(error, OutputError::Create { .. }), "{error:?}");
    }

    #[test]
    fn a_target_that_became_a_directory_is_a_rename_error() {
        let directory = TemporaryDirectory::new("became");
        let path = directory.path().join("result.h5");
        let file = ResultFile::create(&path).unwrap();
        fs::create_dir(&path).unwrap();
        assert!(matches!(file.finish(), Err(OutputError::Rename { .. })));
        assert_eq!(entries(directory.path()), ["result.h5"]);
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
            Err(OutputError::TargetIsDirectory { .. })
        ));
        // A missing directory is made, as for result files.
        write_text(&directory.path().join("new/sub/table.csv"), "x").unwrap();
        assert_eq!(entries(directory.path()), ["new", "picture.svg", "taken"]);
    }

    #[test]
    fn a_file_is_extended_and_its_groups_replaced() {
        use crate::output::{Dimension, Values, Variable};
        let directory = TemporaryDirectory::new("extended");
        let path = directory.path().join("result.h5");
        let group = |name: &str| {
            Group::new(name)
                .dimension(Dimension::unlimited("row"))
                .dimension(Dimension::names("state", ["phi", "omega"]))
                .variable(Variable::f64("x", ["row", "state"]).unit("rad"))
        };
        let rows = |start: f64| -> Vec<f64> { (0..6000).map(|k| start + f64::from(k)).collect() };
        let write = |file: &mut ResultFile, name: &str, start: f64| {
            let values = rows(start);
            let mut writer = file.group(&group(name)).unwrap();
            writer.append(3000, &[("x", Values::F64(&values))]).unwrap();
        };
        let mut file = ResultFile::create(&path).unwrap();
        file.attribute("title", "first").unwrap();
        write(&mut file, "kept", 0.0);
        write(&mut file, "fit", 1.0);
        file.finish().unwrap();
        let before = fs::read(&path).unwrap();
        // Dropped: the file is as it was.
        drop(ResultFile::extend(&path, &["fit"]).unwrap());
        assert_eq!(fs::read(&path).unwrap(), before);
        for start in [2.0, 3.0] {
            let mut file = ResultFile::extend(&path, &["fit", "other"]).unwrap();
            assert!(matches!(file.group(&group("kept")), Err(OutputError::Duplicate { .. })));
            write(&mut file, "fit", start);
            write(&mut file, "other", 10.0 * start);
            file.finish().unwrap();
            let back = H5File::open(&path).unwrap();
            assert_eq!(back.attr_string("title").unwrap(), "first");
            let read = |name: &str| back.dataset(name).unwrap().read_raw::<f64>().unwrap();
            assert_eq!(read("kept/x"), rows(0.0));
            assert_eq!(read("fit/x"), rows(start));
            assert_eq!(read("other/x"), rows(10.0 * start));
        }
        assert_eq!(entries(directory.path()), ["result.h5"]);
        assert!(matches!(
            ResultFile::extend(directory.path().join("none.h5"), &[]),
            Err(OutputError::Create { .. })
        ));
    }

    #[test]
    fn a_group_is_made_once() {
        let directory = TemporaryDirectory::new("once");
        let mut file = ResultFile::create(directory.path().join("result.h5")).unwrap();
        let group = Group::new("points");
        file.group(&group).unwrap();
        assert!(matches!(file.group(&group), Err(OutputError::Duplicate { .. })));
    }
}
