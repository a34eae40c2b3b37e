//! `costate mechanism`.

use crate::args::MechanismArgs;
use crate::common::load::load;
use crate::common::points;
use crate::error::CliError;
use crate::terminal::Printed;
use costate::low_level::model::{Horizon, Model, State};
use costate::session::{MechanismAt, MechanismState};
use std::io::Write as _;

pub fn mechanism(args: &MechanismArgs) -> Result<(), CliError> {
    let scene = load(&args.scene)?;
    let Some(at) = MechanismAt::new(&scene) else {
        let path = args.scene.scenario.clone();
        return Err(CliError::NoMechanism { path });
    };
    let model = &scene.model;
    let wide = with_inputs(model);
    let given = match &args.points {
        Some(path) => points::read(path, &wide)?,
        None => wide.reference().to_vec(),
    };
    let (n, m) = (model.states.len(), model.controls.len());
    let found: Vec<MechanismState> = (given.chunks(wide.states.len()))
        .map(|all| at.at(&all[..n], &all[n..n + m], &all[n + m..]))
        .collect();
    if args.scene.print.quiet && !args.scene.print.json {
        return Ok(());
    }
    let mut out = Printed::new();
    let coordinates = at.coordinates();
    if args.scene.print.json {
        let all = serde_json::json!({ "coordinates": coordinates, "states": found });
        writeln!(out, "{all:#}")?;
        return Ok(());
    }
    writeln!(out, "{}", model.title)?;
    for (k, state) in found.iter().enumerate() {
        writeln!(out, "\nstate {}", k + 1)?;
        write!(out, "{}", as_text(&coordinates, state))?;
    }
    Ok(())
}

/// A model whose states are also the controls and disturbances, to read points with.
fn with_inputs(model: &Model) -> Model {
    let mut wide = model.clone();
    let inputs = (model.controls.iter().map(|c| &c.variable)).chain(&model.disturbances);
    wide.states.extend(inputs.map(|variable| State {
        variable: variable.clone(),
        period: None,
    }));
    let zeros = model.disturbances.len();
    match &mut wide.horizon {
        Horizon::Infinite { x, u, .. } => {
            x.extend(u.iter());
            x.extend(std::iter::repeat_n(0.0, zeros));
        }
        Horizon::Finite { reference, .. } => {
            reference.extend(std::iter::repeat_n(0.0, model.controls.len() + zeros));
        }
    }
    wide
}

fn as_text(coordinates: &[String], state: &MechanismState) -> String {
    let width = coordinates
        .iter()
        .map(String::len)
        .max()
        .unwrap_or(0)
        .max(12);
    let row = |numbers: &[f64]| -> String {
        numbers
            .iter()
            .map(|v| format!(" {:>16.9}", v + 0.0))
            .collect()
    };
    let mut lines = vec![format!(
        "  {:<width$} {:>16} {:>16} {:>16} {:>16} {:>16} {:>16}",
        "coordinate", "q", "q'", "q''", "force", "C q' + G", "G"
    )];
    for (i, name) in coordinates.iter().enumerate() {
        let all = [
            state.q[i],
            state.q_rate[i],
            state.accelerations[i],
            state.forces[i],
            state.bias[i],
            state.gravity[i],
        ];
        lines.push(format!("  {name:<width$}{}", row(&all)));
    }
    lines.push("  mass matrix".to_owned());
    lines.extend(
        state
            .mass_matrix
            .iter()
            .map(|r| format!("  {:<width$}{}", "", row(r))),
    );
    lines.push(format!(
        "  kinetic energy {:.9}, potential {:.9}",
        state.kinetic, state.potential
    ));
    for point in &state.points {
        lines.push(format!(
            "  point {}: at{}, velocity{}",
            point.name,
            row(&point.position),
            row(&point.velocity)
        ));
    }
    for contact in &state.contacts {
        lines.push(format!(
            "  contact {} along{}: force {:.9}; velocity {:.3e}, impulse that stops it {:.9}",
            contact.name,
            row(&contact.direction),
            contact.force,
            contact.velocity,
            contact.impulse
        ));
    }
    if !state.contacts.is_empty() {
        lines.push(format!(
            "  q' after a collision{}",
            row(&state.after_collision)
        ));
    }
    lines.join("\n") + "\n"
}
