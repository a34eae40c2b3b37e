//! `costate attenuation`, and the smallest level of attenuation of a run.

use super::alone::Alone;
use super::columns::columns;
use super::report::Terminal;
use super::run::axes;
use super::{CliError, RunArgs};
use costate::attenuation::{Attenuated, Covering, Row, smallest};
use costate::backend::Backend;
use costate::hdf5::ResultFile;
use costate::local::{Cause, LinearAttenuation};
use costate::model::Model;
use costate::result::Stored;
use costate::scene::Scene;
use costate::sweep::Choices;
use costate_report::ATTENUATION_PICTURES;
use std::path::Path;

pub(super) fn attenuation(args: &RunArgs) -> Result<(), CliError> {
    let asks = |model: &Model| {
        model
            .attenuation
            .as_ref()
            .map(drop)
            .ok_or(CliError::NoAttenuation)
    };
    let (begun, mut file) = Alone::begin(args, "_attenuation", asks)?;
    let Alone {
        scene,
        backend,
        terminal,
        clock,
        ..
    } = &begun;
    let choices = args.numerics.choices(args.seed);
    let found = write(&mut file, scene, backend.as_ref(), choices, terminal)?;
    let path = begun.finish(file)?;
    terminal.say(&text(&found))?;
    let pictures = pictures(&path, terminal);
    let beside = if pictures.is_empty() {
        String::new()
    } else {
        format!("; pictures: {} (and .png)", pictures.join(", "))
    };
    let seconds = clock.elapsed().as_secs_f64();
    terminal.say(&format!(
        "{seconds:.2} s, written to {}{beside}",
        path.display()
    ))?;
    if args.scene.json {
        super::print(&format!("{:#}\n", as_json(&found)))?;
    }
    Ok(())
}

/// Finds the smallest level that the scene asks for and writes its groups.
pub(super) fn write(
    file: &mut ResultFile,
    scene: &Scene,
    backend: &dyn Backend,
    choices: Choices,
    terminal: &Terminal,
) -> Result<Attenuated, CliError> {
    let bar = terminal.progress();
    let found = smallest(scene, backend, choices, &mut |what| {
        bar.say(&format!("attenuation: {what}"))
    });
    bar.clear();
    let found = found?;
    file.attenuation(&axes(&scene.model), &found)?;
    Ok(found)
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

/// gamma* in a line.
pub(super) fn star_text(parameter: &str, linear: &LinearAttenuation) -> String {
    if linear.cause == Cause::None {
        return format!(
            "{parameter}* at or below {}, {}",
            linear.star,
            linear.cause.explained()
        );
    }
    format!(
        "{parameter}* = {:.12} (Riccati equation), {:.12} (Hamiltonian matrix), relative difference {:.1e}\n  {}: {}",
        linear.star,
        linear.hamiltonian,
        linear.difference(),
        linear.cause.name(),
        linear.cause.explained()
    )
}

pub(super) fn star_json(linear: &LinearAttenuation) -> serde_json::Value {
    serde_json::json!({
        "star": linear.star,
        "star_hamiltonian": linear.hamiltonian,
        "difference": linear.difference(),
        "cause": linear.cause.name(),
        "at_or_below": linear.cause == Cause::None,
    })
}

fn percent(row: &Row) -> String {
    let share = 100.0 * row.coverage();
    // What is not all does not look like it.
    if row.covers() || share < 99.995 {
        format!("{share:.2} %")
    } else {
        "99.99 %".to_owned()
    }
}

fn failing(row: &Row) -> String {
    let counts = row.failing();
    let words: Vec<String> = (counts.iter())
        .map(|(status, count)| format!("{count} {}", status.name().replace('_', " ")))
        .collect();
    match &row.outcome.failure {
        Some(reason) => format!("not swept: {reason}"),
        None => words.join(", "),
    }
}

/// The answer and the curve, for a person.
pub(super) fn text(found: &Attenuated) -> String {
    let name = &found.parameter;
    let search = &found.search;
    let states = found.grid.len();
    let mut lines = vec![format!("attenuation: {}", star_text(name, &found.linear))];
    lines.push(match search.covering {
        Covering::Smallest { lower, upper } => format!(
            "smallest {name} whose region of validity covers the {states} states: {upper:.6} (at {lower:.6} they are not covered)"
        ),
        Covering::All { upper } => format!(
            "the region of validity covers the {states} states at every {name} looked at, down to {upper:.6}"
        ),
        Covering::Never { top, .. } => {
            let share = search.rows.last().map_or_else(String::new, percent);
            format!("the {states} states are not covered even at {name} = {top:.6}: {share}")
        }
    });
    if let Some(row) = search.first_failing() {
        let first = match search.covering {
            Covering::Never { .. } => "not valid there",
            _ => "first to fail",
        };
        lines.push(format!("  {first}: {}", failing(row)));
    }
    if !search.monotone {
        lines.push(format!(
            "  coverage is not monotone in {name}: see the curve"
        ));
    }
    let below = search.covering_below();
    if !below.is_empty() {
        let below: Vec<String> = below.iter().map(|v| format!("{v:.6}")).collect();
        lines.push(format!(
            "  covered below that nevertheless: {name} = {}",
            below.join(", ")
        ));
    }
    let mut rows = vec![vec![
        name.clone(),
        "covered".to_owned(),
        "not valid".to_owned(),
    ]];
    rows.extend(
        (search.rows.iter()).map(|r| vec![format!("{:.6}", r.value), percent(r), failing(r)]),
    );
    lines.push(columns(&rows, &[2]));
    lines.join("\n")
}

pub(super) fn as_json(found: &Attenuated) -> serde_json::Value {
    let (state, bracket) = match found.search.covering {
        Covering::Smallest { lower, upper } => ("smallest", [Some(lower), Some(upper)]),
        Covering::All { upper } => ("all", [None, Some(upper)]),
        Covering::Never { top, .. } => ("never", [Some(top), None]),
    };
    let counts = |r: &Row| -> serde_json::Map<String, serde_json::Value> {
        (r.failing().iter())
            .map(|(s, n)| (s.name().to_owned(), (*n).into()))
            .collect()
    };
    let row = |r: &Row| {
        serde_json::json!({
            "value": r.value, "coverage": r.coverage(), "valid": r.valid(), "wanted": r.wanted(),
            "failing": counts(r), "failure": r.outcome.failure,
        })
    };
    let mut all = star_json(&found.linear);
    let more = serde_json::json!({
        "parameter": found.parameter,
        "own": found.own,
        "states": found.grid.len(),
        "covered": state,
        "smallest_covering": found.search.smallest(),
        "bracket": bracket,
        "first_failing": found.search.first_failing().map(counts),
        "monotone": found.search.monotone,
        "covering_below": found.search.covering_below(),
        "levels": found.levels,
        "curve": found.search.rows.iter().map(row).collect::<Vec<_>>(),
    });
    if let (Some(all), serde_json::Value::Object(more)) = (all.as_object_mut(), more) {
        all.extend(more);
    }
    all
}
