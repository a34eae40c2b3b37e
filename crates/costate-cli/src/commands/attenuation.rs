//! `costate attenuation`: the smallest levels of attenuation alone.

use super::alone::Alone;
use crate::args::RunArgs;
use crate::common::ending::Ending;
use crate::common::{pictures, print_json};
use crate::error::CliError;
use costate::run::write_attenuation;
use costate::session::SessionError;
use costate::session::summary::AttenuationSummary;

pub fn attenuation(args: &RunArgs) -> Result<(), CliError> {
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
