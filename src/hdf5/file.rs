//! The file itself: there under its final name only when it is complete.

use super::attribute::AttributeOwner;
use super::error::io_cause;
use super::{AttributeValue, Group, GroupWriter, OutputError};
use crate::files::{Behind, Draft, FileError, Others};
use rust_hdf5::{H5File, Hdf5Error};
use std::fs;
use std::path::{Path, PathBuf};

/// A result file being written.
///
/// It is written under a hidden name beside the final one. [`ResultFile::finish`] flushes it to the
/// disk and renames it; until then a file that was there under the final name stays as it is. A
/// `ResultFile` dropped before that leaves nothing, and a process that is killed outright nothing
/// but the hidden file. It belongs to one thread.
pub struct ResultFile {
    // Closed before the name is removed: some systems do not remove open files.
    file: Open,
    draft: Draft,
    others: Option<Others>,
    groups: Vec<String>,
}

impl std::fmt::Debug for ResultFile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ResultFile")
            .field("draft", &self.draft)
            .field("groups", &self.groups)
            .finish_non_exhaustive()
    }
}

impl ResultFile {
    /// Begins the file that will be `final_path`; missing parent directories are made.
    ///
    /// # Errors
    /// [`FileError::NoFileName`], [`FileError::TargetIsDirectory`], [`FileError::TargetIsSpecial`],
    /// [`FileError::CreateDirectory`] and [`FileError::Create`] (the directory is not writable,
    /// for example).
    pub fn create(final_path: impl AsRef<Path>) -> Result<Self, OutputError> {
        let draft = Draft::begin(final_path.as_ref())?;
        // Nobody else knows the temporary name, and some network file systems refuse locks.
        let file = H5File::options()
            .no_locking()
            .track_order(true)
            .create(draft.hidden())
            .map_err(|error| create_error(draft.path(), error))?;
        Ok(Self {
            file: Open(Some(file)),
            draft,
            others: None,
            groups: Vec::new(),
        })
    }

    /// A copy of the result file `path` without the groups named in `replace`, to which groups can
    /// be added; [`ResultFile::finish`] puts it in the place of `path`.
    ///
    /// # Errors
    /// As [`ResultFile::create`], and [`FileError::Create`] where `path` cannot be copied.
    pub fn extend(path: impl AsRef<Path>, replace: &[&str]) -> Result<Self, OutputError> {
        let mut this = Self::create(path)?;
        drop(this.file.0.take());
        let create = |source| FileError::Create {
            path: this.path().to_owned(),
            source,
        };
        fs::copy(this.path(), this.draft.hidden()).map_err(create)?;
        let file = (H5File::options().no_locking().open_rw(this.draft.hidden()))
            .map_err(|error| create_error(this.path(), error))?;
        for group in replace {
            if file
                .root_group()
                .group_names()
                .is_ok_and(|names| names.iter().any(|n| n == group))
            {
                file.delete_group(group).map_err(|e| this.error(group, e))?;
            }
        }
        this.groups = file
            .root_group()
            .group_names()
            .map_err(|e| this.error("/", e))?;
        this.file = Open(Some(file));
        Ok(this)
    }

    /// The name the file will have.
    #[must_use]
    pub fn path(&self) -> &Path {
        self.draft.path()
    }

    /// Chooses another name for the file, in the same directory.
    pub fn rename(&mut self, path: PathBuf) {
        self.draft.rename(path);
    }

    /// Sets a root attribute.
    ///
    /// # Errors
    /// [`FileError::Write`] and [`OutputError::Hdf5`].
    pub fn attribute(
        &self,
        name: &str,
        value: impl Into<AttributeValue>,
    ) -> Result<(), OutputError> {
        self.open_file()?
            .set(name, &value.into())
            .map_err(|error| self.error(&format!("the root attribute `{name}`"), error))
    }

    /// Makes a group with its coordinates, texts and empty variables, ready to be filled. Any
    /// number of groups can be open and filled in turn.
    ///
    /// # Errors
    /// [`OutputError`]'s variants on declarations, [`FileError::Write`] and
    /// [`OutputError::Hdf5`].
    pub fn group(&mut self, group: &Group) -> Result<GroupWriter, OutputError> {
        group.check()?;
        if self.groups.contains(&group.name) {
            return Err(OutputError::Duplicate {
                group: "/".to_owned(),
                name: group.name.clone(),
            });
        }
        let behind = Behind::of(self.draft.hidden());
        let writer = GroupWriter::create(self.open_file()?, self.path(), behind, group)?;
        self.groups.push(group.name.clone());
        Ok(writer)
    }

    /// Flushes the file to the disk and gives it its final name, replacing what was there; returns
    /// that name. Writers of its groups can no longer write.
    ///
    /// # Errors
    /// [`FileError::Write`], [`OutputError::Hdf5`] and [`FileError::Rename`]; the file is then
    /// gone, and an older one under the final name is still there.
    pub fn finish(mut self) -> Result<PathBuf, OutputError> {
        if let Some(file) = self.file.0.take()
            && let Err(error) = file.close()
        {
            return Err(self.error("the end", error));
        }
        Ok(match &self.others {
            Some(others) => self.draft.publish_beside(others)?,
            None => self.draft.publish()?,
        })
    }

    /// What others have put under its name by the time that it is finished stays.
    pub fn beside(&mut self, others: Others) {
        self.others = Some(others);
    }

    fn open_file(&self) -> Result<&H5File, OutputError> {
        self.file
            .0
            .as_ref()
            .ok_or_else(|| self.error("", Hdf5Error::InvalidState("the file is closed".into())))
    }

    fn error(&self, object: &str, error: Hdf5Error) -> OutputError {
        OutputError::from_hdf5(self.path(), object, error)
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

fn create_error(path: &Path, error: Hdf5Error) -> OutputError {
    match io_cause(error) {
        Ok(source) => OutputError::File(FileError::Create {
            path: path.to_owned(),
            source,
        }),
        Err(error) => OutputError::from_hdf5(path, "the beginning", error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::testing::TemporaryDirectory;

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
        assert_ne!(first.draft.hidden(), second.draft.hidden());
        first.finish().unwrap();
        drop(second);
        assert_eq!(entries(directory.path()), ["result.h5"]);
    }

    #[test]
    fn targets_that_cannot_be_files_are_named() {
        let directory = TemporaryDirectory::new("targets");
        let at = |name: &str| ResultFile::create(directory.path().join(name));
        assert!(matches!(
            at(""),
            Err(OutputError::File(FileError::TargetIsDirectory { .. }))
        ));
        assert!(matches!(
            at(".."),
            Err(OutputError::File(FileError::NoFileName { .. }))
        ));
        fs::write(directory.path().join("file"), b"").unwrap();
        assert!(matches!(
            at("file/result.h5"),
            Err(OutputError::File(FileError::CreateDirectory { .. }))
        ));
        let long = "n".repeat(300);
        let error = at(&long).unwrap_err();
        assert!(
            matches!(error, OutputError::File(FileError::Create { .. })),
            "{error:?}"
        );
    }

    #[test]
    fn a_target_that_became_a_directory_is_a_rename_error() {
        let directory = TemporaryDirectory::new("became");
        let path = directory.path().join("result.h5");
        let file = ResultFile::create(&path).unwrap();
        fs::create_dir(&path).unwrap();
        assert!(matches!(
            file.finish(),
            Err(OutputError::File(FileError::Rename { .. }))
        ));
        assert_eq!(entries(directory.path()), ["result.h5"]);
    }

    #[test]
    fn a_file_is_extended_and_its_groups_replaced() {
        use crate::hdf5::{Dimension, Values, Variable};
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
            assert!(matches!(
                file.group(&group("kept")),
                Err(OutputError::Duplicate { .. })
            ));
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
            Err(OutputError::File(FileError::Create { .. }))
        ));
    }

    #[test]
    fn a_group_is_made_once() {
        let directory = TemporaryDirectory::new("once");
        let mut file = ResultFile::create(directory.path().join("result.h5")).unwrap();
        let group = Group::new("points");
        file.group(&group).unwrap();
        assert!(matches!(
            file.group(&group),
            Err(OutputError::Duplicate { .. })
        ));
    }
}
