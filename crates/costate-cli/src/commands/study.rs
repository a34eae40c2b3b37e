//! `costate study`: the study alone.

use super::alone::Alone;
use crate::args::DividedArgs;
use crate::common::ending::Ending;
use crate::common::{print_json, shard};
use crate::error::{CliError, GridRefusal};
use crate::text;
use costate::run::study as made;
use costate::session::SessionError;
use costate::session::summary::study_rows;

pub fn study(args: &DividedArgs) -> Result<(), CliError> {
    let DividedArgs { run, part } = args;
    if run.grid_guesses {
        return Err(GridRefusal::Nothing.into());
    }
    let scene = (&run.scene, &run.numerics, run.seed);
    let begun = Alone::read(scene, run.out.as_deref(), |model| {
        model.study.as_ref().map(drop).ok_or(SessionError::NoStudy)
    })?;
    let (model, terminal) = (&begun.scene.model, &begun.terminal);
    let shard = shard::of(*part, terminal)?;
    let ending = format!("_study{}", shard::ending(shard));
    let path = begun.path(run.out.as_deref(), &ending)?;
    let ending = Ending::of(run, &begun.provenance);
    let backend = run.numerics.open(model)?;
    let session = begun.session(backend).until(ending.deadline);
    let work = (shard, shard::resume(*part));
    let done = made(&session, work, &path, &begun.provenance)?;

    terminal.say(&text::study::table(model, &done.variants))?;
    let seconds = begun.provenance.seconds();
    terminal.say(&format!(
        "{seconds:.2} s, written to {}",
        done.path.display()
    ))?;
    if run.scene.print.json {
        print_json(&study_rows(model, &done.variants))?;
    }
    if done.stopped {
        return Err(ending.stopped(done.path));
    }
    Ok(())
}
