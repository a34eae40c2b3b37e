//! `costate attenuation`: the smallest levels of attenuation alone.

use super::alone::Alone;
use crate::args::RunArgs;
use crate::common::print_json;
use crate::error::CliError;
use crate::terminal::Terminal;
use costate::low_level::result::Stored;
use costate::run::write_attenuation;
use costate::session::summary::AttenuationSummary;
use costate::session::{Progress, SessionError};
use costate_report::ATTENUATION_PICTURES;
use std::path::Path;

pub fn attenuation(args: &RunArgs) -> Result<(), CliError> {
    if args.time_limit.is_some() {
        return Err(CliError::NoTimeLimit);
    }
    let (begun, backend, mut file) = Alone::begin(args, "_attenuation", |model| {
        let asked = model.attenuation.as_ref().map(drop);
        asked.ok_or(SessionError::NoAttenuation)
    })?;
    let Alone { terminal, .. } = &begun;
    let session = begun.session(backend);
    let found = session.attenuation()?;
    terminal.ended()?;
    write_attenuation(&mut file, &begun.scene.model, &found)?;
    let path = begun.finish(&session, file)?;

    let pictures = pictures(&path, terminal);
    let beside = match pictures.is_empty() {
        true => String::new(),
        false => format!("; pictures: {} (and .png)", pictures.join(", ")),
    };
    let seconds = begun.provenance.seconds();
    terminal.say(&format!(
        "{seconds:.2} s, written to {}{beside}",
        path.display()
    ))?;
    if args.scene.json {
        print_json(&AttenuationSummary::new(&found))?;
    }
    Ok(())
}

/// The pictures beside a result file, by their names as SVG; what cannot be drawn is a note.
fn pictures(path: &Path, terminal: &Terminal) -> Vec<String> {
    let stored = Stored::open(path).map_err(|e| e.to_string());
    let written = stored.and_then(|s| {
        costate_report::write_beside(&s, &ATTENUATION_PICTURES).map_err(|e| e.to_string())
    });
    match written {
        Ok(written) => {
            for (name, reason) in &written.missing {
                terminal.note(&format!("picture {name}: {reason}"));
            }
            written.pictures
        }
        Err(reason) => {
            terminal.note(&format!("no picture was made: {reason}"));
            Vec::new()
        }
    }
}
