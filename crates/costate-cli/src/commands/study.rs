//! `costate study`: the study alone.

use super::alone::Alone;
use crate::args::RunArgs;
use crate::common::ending::Ending;
use crate::common::print_json;
use crate::error::CliError;
use crate::text;
use costate::run::write_study;
use costate::session::SessionError;
use costate::session::summary::study_rows;

pub fn study(args: &RunArgs) -> Result<(), CliError> {
    let (begun, backend, mut file) = Alone::begin(args, "_study", |model| {
        model.study.as_ref().map(drop).ok_or(SessionError::NoStudy)
    })?;
    let (model, terminal) = (&begun.scene.model, &begun.terminal);
    let ending = Ending::of(args, &begun.provenance);
    let session = begun.session(backend).until(ending.deadline);
    let variants = session.study()?;
    let stopped = write_study(&session, &mut file, &variants, &begun.provenance)?;
    let path = begun.finish(&session, file)?;

    terminal.say(&text::study::table(model, &variants))?;
    let seconds = begun.provenance.seconds();
    terminal.say(&format!("{seconds:.2} s, written to {}", path.display()))?;
    if args.scene.print.json {
        print_json(&study_rows(model, &variants))?;
    }
    if stopped {
        return Err(ending.stopped(path));
    }
    Ok(())
}
