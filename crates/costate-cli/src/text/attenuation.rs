//! Levels of attenuation as text.

use crate::common::columns::columns;
use costate::low_level::attenuation::{Attenuated, Covering, Row};
use costate::low_level::local::{Cause, LinearAttenuation};

/// gamma* in a line.
pub fn star_text(parameter: &str, linear: &LinearAttenuation) -> String {
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
pub fn text(found: &Attenuated) -> String {
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
