//! What the tests of this layer share.

use std::path::{Path, PathBuf};

/// A directory of one test, gone with it.
pub struct TemporaryDirectory(PathBuf);

impl TemporaryDirectory {
    pub fn new(test: &str) -> Self {
        let name = format!("costate-output-{test}-{}", std::process::id());
        let path = std::env::temp_dir().join(name);
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    pub fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for TemporaryDirectory {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
