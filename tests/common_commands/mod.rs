//! What the tests of commands share: directories, scenes made of shipped ones, and the program.
#![allow(dead_code, reason = "every test crate uses a part")]

pub mod header;
pub mod made_up;

use costate::low_level::model::State;
use costate::low_level::result::Stored;
use costate::low_level::scenario::PROBLEM_SECTIONS;
use costate::low_level::schema::{self, Kind};
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// An empty directory of a test's own.
pub fn scratch(name: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&directory);
    std::fs::create_dir_all(&directory).unwrap();
    directory
}

pub fn costate<S: AsRef<OsStr>>(arguments: &[S]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_costate"))
        .args(arguments)
        .output()
        .unwrap()
}

/// What a command prints, which must succeed.
pub fn done(output: Output) -> String {
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{errors}");
    String::from_utf8(output.stdout).unwrap()
}

/// Fails where a result file has a group or variable that is not in the schema, or one of another
/// shape.
#[track_caller]
pub fn in_schema(file: &Path) {
    let stored = Stored::open(file).unwrap();
    let groups = stored.groups();
    assert!(!groups.is_empty(), "{}", file.display());
    for name in groups {
        let group = stored.group(&name).unwrap();
        let schema = schema::group(&name).unwrap_or_else(|| panic!("/{name}"));
        for own in group.names() {
            let coordinate = schema.reserves(&own) && schema.variable(&own).is_none();
            let state = |s: &State| s.variable.name == own;
            let axis = stored.scene.model.states.iter().any(state)
                || own == stored.scene.model.time_name();
            if coordinate || axis {
                continue;
            }
            let variable = schema.variable(&own);
            let variable = variable.unwrap_or_else(|| panic!("/{name}/{own}"));
            match variable.kind {
                Kind::Text => drop(group.texts(&own).unwrap()),
                Kind::Real => drop(group.f64(&own).unwrap()),
                Kind::Integer | Kind::Code => drop(group.i32(&own).unwrap()),
            }
            if variable.kind == Kind::Code {
                let meanings = group.attribute(Some(&own), "flag_meanings");
                assert!(meanings.is_some(), "/{name}/{own}");
            }
        }
    }
}

/// Runs a script of `tests/` that checks what was written; it must succeed. The Python with what it
/// imports is `COSTATE_TEST_PYTHON`, which `tests/run.sh` sets.
#[track_caller]
pub fn checked_by(script: &str, files: &[&Path]) {
    let python = std::env::var_os("COSTATE_TEST_PYTHON").unwrap_or_else(|| "python3".into());
    let script = Path::new(crate::ROOT).join("tests").join(script);
    let checked = Command::new(python)
        .arg(script)
        .args(files)
        .output()
        .unwrap();
    assert!(
        checked.status.success(),
        "{}{}",
        String::from_utf8_lossy(&checked.stdout),
        String::from_utf8_lossy(&checked.stderr)
    );
}

pub fn scenario(name: &str) -> PathBuf {
    Path::new(crate::ROOT)
        .join("scenarios")
        .join(format!("{name}.toml"))
}

/// Some sections of a shipped scene.
pub fn sections_of(name: &str, wanted: impl Fn(&str) -> bool) -> String {
    let text = std::fs::read_to_string(scenario(name)).unwrap();
    let (mut kept, mut keep) = (String::new(), true);
    for line in text.lines() {
        if let Some(section) = line
            .strip_prefix('[')
            .and_then(|l| l.split([']', '.']).next())
        {
            keep = wanted(section);
        }
        if keep {
            kept += &format!("{line}\n");
        }
    }
    kept
}

/// A shipped scene's problem alone, with further lines, in a directory.
pub fn scene(directory: &Path, name: &str, lines: &str) -> PathBuf {
    let path = directory.join(format!("{name}.toml"));
    let kept = sections_of(name, |section| PROBLEM_SECTIONS.contains(&section));
    std::fs::write(&path, format!("{kept}\n{lines}\n")).unwrap();
    path
}

/// A map of a scene by `costate homotopy`, in a directory: its file, and its summary's "map".
pub fn map_of(directory: &Path, name: &str, scene: &str) -> (Stored, serde_json::Value) {
    let path = directory.join(name).with_extension("toml");
    std::fs::write(&path, scene).unwrap();
    let out = path.with_extension("h5");
    let fixed = ["homotopy", "--backend", "cpu", "--json", "--out"].map(OsStr::new);
    let printed = done(costate(
        &[&fixed[..], &[out.as_ref(), path.as_ref()]].concat(),
    ));
    let summary: serde_json::Value = serde_json::from_str(&printed).unwrap();
    (Stored::open(&out).unwrap(), summary["map"].clone())
}

/// A column of what `costate solve` writes of states of a scene, whose variables are named as in a
/// header.
pub fn column_of<const N: usize>(
    directory: &Path,
    name: &str,
    scene: &str,
    (header, states): (&str, &[[f64; N]]),
    column: &str,
) -> Vec<String> {
    let [path, points, out] =
        ["toml", "csv", "solved.csv"].map(|ending| directory.join(format!("{name}.{ending}")));
    std::fs::write(&path, scene).unwrap();
    let lines: Vec<String> = states
        .iter()
        .map(|x| x.map(|x| x.to_string()).join(","))
        .collect();
    std::fs::write(&points, format!("{header}\n{}\n", lines.join("\n"))).unwrap();
    let fixed = ["solve", "--backend", "cpu", "--quiet", "--points"].map(OsStr::new);
    let last = [
        points.as_os_str(),
        path.as_os_str(),
        OsStr::new("--out"),
        out.as_os_str(),
    ];
    done(costate(&[&fixed[..], &last].concat()));
    let mut table = csv::Reader::from_path(&out).unwrap();
    let column = table
        .headers()
        .unwrap()
        .iter()
        .position(|h| h == column)
        .unwrap();
    table
        .records()
        .map(|row| row.unwrap()[column].to_owned())
        .collect()
}
