//! `costate simulate`.

use super::alone::Alone;
use crate::args::SimulateArgs;
use crate::common::ending::Ending;
use crate::common::{points, print_json};
use crate::error::CliError;
use crate::text;
use costate::low_level::result::TrajectorySchema;
use costate::run::weights;
use costate::session::{ControlledBy, SessionError, SimulationOptions};

pub fn simulate(args: &SimulateArgs) -> Result<(), CliError> {
    let begun = Alone::read(
        (&args.scene, &args.numerics, 0),
        args.out.as_deref(),
        |_| Ok(()),
    )?;
    let (model, terminal) = (&begun.scene.model, &begun.terminal);
    let from = initial(args, &begun)?;
    let options = options(args)?;
    let ending = Ending::of_simulation(args, &begun.provenance);
    let backend = args.numerics.open(model)?;
    let session = begun.session(backend).until(ending.deadline);

    let mut file = begun.create(args.out.as_deref(), "_simulation")?;
    let simulated = session
        .simulate(from.as_deref(), &options)
        .map_err(|e| ending.nothing_of(e))?;

    let axes = TrajectorySchema::axes(model);
    let (name, adapter) = (session.backend().name(), session.backend().adapter());
    file.simulation(&axes, &simulated, (name, &adapter))?;
    let path = begun.finish(&session, file)?;

    let shown = text::simulated::Shown {
        model,
        simulated: &simulated,
    };
    terminal.say(&shown.text())?;
    let seconds = begun.provenance.seconds();
    terminal.say(&format!("{seconds:.2} s, written to {}", path.display()))?;
    if args.scene.print.json {
        print_json(&shown.json(&path, name, &adapter))?;
    }
    Ok(())
}

/// States that are given on the command line.
fn initial(args: &SimulateArgs, begun: &Alone) -> Result<Option<Vec<f64>>, CliError> {
    let model = &begun.scene.model;
    let mut states = Vec::new();
    for at in &args.at {
        states.extend(points::single(at, model, None)?.0);
    }
    if let Some(path) = &args.points {
        states.extend(points::read(path, model)?);
    }
    Ok((!states.is_empty()).then_some(states))
}

fn options(args: &SimulateArgs) -> Result<SimulationOptions, CliError> {
    let law = match (&args.law, &args.weights) {
        (Some(name), _) => Some(ControlledBy::Law(name.clone())),
        (None, Some(path)) => Some(ControlledBy::Weights(
            weights(path).map_err(SessionError::from)?,
        )),
        (None, None) => None,
    };
    Ok(SimulationOptions {
        time: args.time,
        events: args.events.map(|n| n as usize),
        samples: args.samples.map(|n| n as usize),
        law,
        cycle: args.cycle.map(|n| n as usize),
    })
}
