//! `costate fit`: laws from what a result file holds.

use crate::args::FitArgs;
use crate::common::ending::Ending;
use crate::common::{note_ended_early, print_json};
use crate::error::CliError;
use crate::terminal::Terminal;
use crate::text;
use costate::low_level::result::Stored;
use costate::run::{LawFiles, RunError, fit_stored, other_scene};
use costate::session::summary::FittedSummary;
use serde_json::json;

pub fn fit(args: &FitArgs) -> Result<(), CliError> {
    let stored = Stored::open(&args.file)?;
    let terminal = Terminal::new(args.print);
    note_ended_early(&stored, &terminal);
    let other = args.scene.as_deref();
    let other = other
        .map(|scene| other_scene(&stored, scene, &[]))
        .transpose()?;
    let scene = &other.as_ref().unwrap_or(&stored.scene).model;
    if scene.feedback.is_empty() {
        let path = args.scene.clone().unwrap_or_else(|| args.file.clone());
        return Err(RunError::NoFeedback { path }.into());
    }
    let mut laws = scene.feedback.clone();
    for law in &mut laws {
        law.seed = args.seed.unwrap_or(law.seed);
        law.starts = args.starts.unwrap_or(law.starts);
    }

    let files = LawFiles::new(&args.file, args.out_dir.as_deref());
    let ending = Ending::of_fit(args);
    let done = match fit_stored(&stored, scene, &laws, &files, (&terminal, ending.deadline)) {
        Err(error) if error.is_of_time() => return Err(ending.nothing(error.to_string())),
        done => done?,
    };
    if args.print.json {
        let laws = FittedSummary::all(&done.fitted, &done.exports);
        print_json(&json!({ "file": args.file.display().to_string(), "laws": laws }))?;
    }
    terminal.say(&text::laws::text(&done.fitted))?;
    terminal.say(&text::laws::files(&done.fitted, &done.exports))?;
    match done.fitted.left_out.is_empty() {
        true => Ok(()),
        false => Err(ending.stopped(args.file.clone())),
    }
}
