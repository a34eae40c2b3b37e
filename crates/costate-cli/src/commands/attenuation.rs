//! `costate attenuation`: the smallest levels of attenuation alone.

use super::alone::Alone;
use crate::args::{DividedArgs, RunArgs};
use crate::common::ending::Ending;
use crate::common::{pictures, print_json, shard};
use crate::error::{CliError, GridRefusal};
use crate::terminal::Terminal;
use costate::run::{levels, write_attenuation};
use costate::session::summary::AttenuationSummary;
use costate::session::{Resume, SessionError, Shard};
use serde_json::json;

pub fn attenuation(args: &DividedArgs) -> Result<(), CliError> {
    let DividedArgs { run, part } = args;
    let shard = shard::of(*part, &Terminal::new(run.scene.print))?;
    match shard.is_some() || part.resume {
        true => in_parts(run, (shard, shard::resume(*part))),
        false => at_once(run),
    }
}

/// A shard, or all with what was done before.
fn in_parts(args: &RunArgs, part: (Option<Shard>, Resume)) -> Result<(), CliError> {
    if args.grid_guesses {
        return Err(GridRefusal::Nothing.into());
    }
    let scene = (&args.scene, &args.numerics, args.seed);
    let begun = Alone::read(scene, args.out.as_deref(), |model| {
        let asked = model.attenuation.as_ref().map(drop);
        asked.ok_or(SessionError::NoAttenuation)
    })?;
    let terminal = &begun.terminal;
    let ending = format!("_attenuation{}", shard::ending(part.0));
    let path = begun.path(args.out.as_deref(), &ending)?;
    let ending = Ending::of(args, &begun.provenance);
    let backend = args.numerics.open(&begun.scene.model)?;
    let session = begun.session(backend).until(ending.deadline);
    let done = levels(&session, part, &path, &begun.provenance)?;
    terminal.ended()?;
    let (seconds, path) = (begun.provenance.seconds(), done.path.display());
    let count = done.levels;
    terminal.say(&format!(
        "{count} levels; {seconds:.2} s, written to {path}"
    ))?;
    if args.scene.print.json {
        match &done.found {
            Some(found) => print_json(&AttenuationSummary::new(found))?,
            None => print_json(&json!({ "file": path.to_string(), "levels": count }))?,
        }
    }
    match done.stopped {
        true => Err(ending.stopped(done.path)),
        false => Ok(()),
    }
}

fn at_once(args: &RunArgs) -> Result<(), CliError> {
    let (begun, backend, mut file) = Alone::begin(args, "_attenuation", |model| {
        let asked = model.attenuation.as_ref().map(drop);
        asked.ok_or(SessionError::NoAttenuation)
    })?;
    let Alone { terminal, .. } = &begun;
    let ending = Ending::with_nothing(args, &begun.provenance);
    let session = begun.session(backend).until(ending.deadline);
    let found = match session.attenuation() {
        Err(_) if session.is_over() => {
            let why = "the search is not done, and half of it shows nothing";
            return Err(ending.nothing(why));
        }
        found => found?,
    };
    terminal.ended()?;
    write_attenuation(&mut file, &begun.scene.model, &found)?;
    let path = begun.finish(&session, file)?;

    let pictures = pictures::of_attenuation(&path, terminal);
    let beside = match pictures.is_empty() {
        true => String::new(),
        false => format!("; pictures: {} (and .png)", pictures.join(", ")),
    };
    let seconds = begun.provenance.seconds();
    terminal.say(&format!(
        "{seconds:.2} s, written to {}{beside}",
        path.display()
    ))?;
    if args.scene.print.json {
        print_json(&AttenuationSummary::new(&found))?;
    }
    Ok(())
}
