//! `costate attenuation`: the smallest levels of attenuation alone.

use super::alone::Alone;
use crate::args::RunArgs;
use crate::common::{pictures, print_json};
use crate::error::CliError;
use costate::run::write_attenuation;
use costate::session::SessionError;
use costate::session::summary::AttenuationSummary;

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
    if args.scene.json {
        print_json(&AttenuationSummary::new(&found))?;
    }
    Ok(())
}
