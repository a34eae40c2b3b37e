//! `costate import`: a scene from another program's file.

use crate::args::ImportArgs;
use crate::error::{CliError, ImportFileError};
use crate::terminal::Terminal;
use costate::low_level::files::{read_text, write_text};
use costate::session::Progress;
use costate_urdf::import;
use std::path::PathBuf;

pub fn run(args: &ImportArgs) -> Result<(), CliError> {
    let terminal = Terminal::with(args.print.quiet, args.print.json);
    let path = args.file.clone();
    let text = read_text(&args.file).map_err(|source| ImportFileError::Read {
        path: path.clone(),
        source,
    })?;
    let out = match &args.out {
        Some(out) => {
            refuse(out, args)?;
            out.clone()
        }
        None => PathBuf::from(args.file.file_stem().unwrap_or_default()).with_extension("toml"),
    };
    // What was made of a scene since it was imported is somebody's work.
    if out.exists() {
        return Err(ImportFileError::Exists { path: out }.into());
    }
    let name = args.file.file_name().unwrap_or_default().to_string_lossy();
    let made = import(&text, &name).map_err(|error| ImportFileError::Robot { path, error })?;
    write_text(&out, &made.text)?;
    terminal.say(&format!(
        "{} joints, {} kg in motion: written to {}",
        made.joints,
        six_digits(made.mass),
        out.display()
    ))?;
    for note in &made.notes {
        terminal.note(note);
    }
    if args.print.json {
        crate::common::print_json(&serde_json::json!({
            "file": out.display().to_string(), "joints": made.joints, "mass": made.mass, "notes": made.notes,
        }))?;
    }
    Ok(())
}

/// A scene has its own ending, and does not replace the robot.
fn refuse(out: &std::path::Path, args: &ImportArgs) -> Result<(), CliError> {
    let bad = |reason: &str| CliError::BadOut {
        path: out.to_owned(),
        reason: reason.to_owned(),
    };
    let same = std::fs::canonicalize(out)
        .is_ok_and(|a| std::fs::canonicalize(&args.file).is_ok_and(|b| a == b));
    if same {
        return Err(bad("this file is read"));
    }
    match out
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("toml"))
    {
        true => Ok(()),
        false => Err(bad("a scene is TOML; name it .toml")),
    }
}

/// A sum as people read it.
fn six_digits(value: f64) -> f64 {
    format!("{value:.5e}").parse().unwrap_or(value)
}
