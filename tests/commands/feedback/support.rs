//! Directories, commands, and reading back what a fit wrote.

use costate::low_level::result::Stored;
use std::path::{Path, PathBuf};
use std::process::Command;

/// An empty directory of the test's own.
pub fn scratch(name: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("feedback-{name}"));
    let _ = std::fs::remove_dir_all(&directory);
    std::fs::create_dir_all(&directory).unwrap();
    directory
}

/// `/feedback` of a file with one law.
pub struct Points {
    pub law: Vec<String>,
    pub error: f64,
    pub flops: f64,
    pub toml: String,
}

impl Points {
    pub fn read(path: &Path) -> Self {
        crate::common_commands::in_schema(path);
        let stored = Stored::open(path).unwrap();
        let group = stored.group("feedback").expect("a group /feedback");
        let number = |name: &str| group.f64(name).unwrap().values[0];
        Self {
            law: group.texts("name").unwrap(),
            error: number("u_mean_relative_error"),
            flops: number("flops"),
            toml: group.texts("toml").unwrap().remove(0),
        }
    }
}

/// What a command prints, which must succeed.
pub fn output(command: &mut Command) -> String {
    let done = command
        .output()
        .unwrap_or_else(|e| panic!("{command:?}: {e}"));
    let errors = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(done.status.success(), "{command:?}: {errors}");
    String::from_utf8(done.stdout).unwrap()
}
