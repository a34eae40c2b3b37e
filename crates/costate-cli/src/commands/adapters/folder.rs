//! Where the parts lie until they are put together.

use costate::low_level::files::{Draft, FileError, target};
use std::fs;
use std::path::{Path, PathBuf};

/// The folder of a result's parts, beside it: `out/x.h5` -> `out/x_adapters`. What is of use stays
/// there; dropped with nothing in it, it goes.
pub struct Folder {
    path: PathBuf,
    /// A name in it: what was made of the folder for it goes with it, also by a signal, unless
    /// something else is there.
    claim: Option<Draft>,
}

impl Folder {
    /// Its name.
    pub fn of(result: &Path) -> PathBuf {
        let mut name = result.file_stem().unwrap_or_default().to_owned();
        name.push("_adapters");
        result.with_file_name(name)
    }

    /// The folder of a result; it may be there already.
    pub fn begin(result: &Path) -> Result<Self, FileError> {
        // What is wrong with the result's place is told before the work is done.
        let result = target(result)?;
        drop(Draft::begin(&result)?);
        let path = Self::of(&result);
        let claim = Some(Draft::begin(&path.join("part.h5"))?);
        Ok(Self { path, claim })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The file of a part.
    pub fn part(&self, number: usize) -> PathBuf {
        self.path.join(format!("part{number}.h5"))
    }

    /// Whether anything is kept here.
    pub fn has_parts(&self) -> bool {
        self.entries().iter().any(|name| is_part(name))
    }

    /// Removes all parts, and what processes that were killed have left of them.
    pub fn clear(&self) {
        let is_ours = |name: &String| match name.strip_prefix('.') {
            Some(hidden) => begins_as_part(hidden).is_some() && hidden.ends_with(".tmp"),
            None => is_part(name),
        };
        // What cannot be removed does no harm.
        for name in self.entries().into_iter().filter(is_ours) {
            let _ = fs::remove_file(self.path.join(name));
        }
    }

    fn entries(&self) -> Vec<String> {
        let entries = fs::read_dir(&self.path).into_iter().flatten().flatten();
        entries
            .filter_map(|entry| entry.file_name().into_string().ok())
            .collect()
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        drop(self.claim.take());
        // One that was there before is no part of the claim. It stays where something is in it.
        let _ = fs::remove_dir(&self.path);
    }
}

/// Whether a file is called as a part is.
fn is_part(name: &str) -> bool {
    begins_as_part(name).is_some_and(|rest| rest == ".h5" || rest == "_stopped.h5")
}

/// What follows a part's number.
fn begins_as_part(name: &str) -> Option<&str> {
    let rest = name.strip_prefix("part")?;
    let after = rest.trim_start_matches(|c: char| c.is_ascii_digit());
    (after.len() < rest.len()).then_some(after)
}

/// Whether parts of a result were kept.
pub fn is_there(result: &Path) -> bool {
    target(result).is_ok_and(|result| Folder::of(&result).is_dir())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_ours_stays() {
        let base = std::env::temp_dir().join(format!("costate-folder-{}", std::process::id()));
        let result = base.join("deep/x.h5");
        drop(Folder::begin(&result).unwrap());
        assert!(!base.exists());

        let folder = Folder::begin(&result).unwrap();
        assert!(!folder.has_parts());
        let names = ["part0.h5", "part12_stopped.h5", ".part1.h5.m-1-2.tmp"];
        let others = [".mine", "notes.txt", "part.h5", "part1.h5.bak"];
        for name in names.iter().chain(&others) {
            fs::write(folder.path().join(name), "").unwrap();
        }
        assert!(folder.has_parts());
        folder.clear();
        let mut left = folder.entries();
        left.sort();
        assert_eq!(left, others);
        drop(folder);
        assert!(base.join("deep/x_adapters/notes.txt").exists());
        fs::remove_dir_all(&base).unwrap();
    }
}
