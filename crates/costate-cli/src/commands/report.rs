//! `costate report`.

use crate::args::ReportArgs;
use crate::common::{Kind, check_out};
use crate::error::{CliError, OptionError};
use crate::terminal::Printed;
use costate::low_level::model::Report;
use costate::low_level::result::Stored;
use costate::low_level::scenario;
use costate_report::Options;
use std::io::Write as _;

pub fn report(args: &ReportArgs) -> Result<(), CliError> {
    let clock = std::time::Instant::now();
    check_out(args.out.as_deref(), &[Kind::Page], &[&args.file])?;
    let stored = Stored::open(&args.file)?;
    let choice = choice(args, &stored)?;
    let options = Options {
        out: args.out.clone(),
        choice,
        width: args.width,
    };
    let written = costate_report::write(&stored, &options)?;
    if args.quiet && !args.json {
        return Ok(());
    }
    let mut out = Printed::new();
    if args.json {
        let missing: Vec<_> = (written.missing.iter())
            .map(|(name, reason)| serde_json::json!({ "name": name, "reason": reason }))
            .collect();
        let summary = serde_json::json!({
            "page": written.page.display().to_string(),
            "bytes": written.bytes,
            "folder": written.folder.display().to_string(),
            "pictures": written.pictures,
            "missing": missing,
            "seconds": clock.elapsed().as_secs_f64(),
        });
        writeln!(out, "{summary:#}")?;
        return Ok(());
    }
    for (name, reason) in &written.missing {
        writeln!(out, "not drawn: {name}: {reason}")?;
    }
    writeln!(
        out,
        "{}: {}\n{:.2} s, written to {} ({} kB) and {}",
        crate::text::counted(written.pictures.len(), "picture"),
        written.pictures.join(", "),
        clock.elapsed().as_secs_f64(),
        written.page.display(),
        written.bytes / 1000,
        written.folder.display()
    )?;
    Ok(())
}

/// What is asked for, numbers being expressions of the scene's parameters.
fn choice(args: &ReportArgs, stored: &Stored) -> Result<Report, OptionError> {
    let number = |option: &'static str, text: &str| {
        scenario::constant(text, &stored.scene.model).map_err(|reason| OptionError {
            option,
            text: text.to_owned(),
            reason,
        })
    };
    let mut choice = Report::default();
    for level in &args.levels {
        choice.levels.push(number("--levels", level)?);
    }
    for (name, value) in &args.slice {
        choice.slice.push((name.clone(), number("--slice", value)?));
    }
    choice.axes = match args.axes.as_slice() {
        [] => None,
        [a, b] => Some([a.trim().to_owned(), b.trim().to_owned()]),
        other => {
            return Err(OptionError {
                option: "--axes",
                text: other.join(","),
                reason: "the names of two states are needed".to_owned(),
            });
        }
    };
    Ok(choice)
}
