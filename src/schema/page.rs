//! The schema in Markdown, for the guide.

use super::{Along, GROUPS, Group, Kind, Unit, Variable, When};
use std::fmt::Write;

/// A section for each group: its dimensions, variables and attributes.
#[must_use]
pub fn markdown() -> String {
    let mut page = String::new();
    for group in GROUPS {
        section(&mut page, group);
    }
    page
}

fn section(page: &mut String, group: &Group) {
    let _ = writeln!(page, "### `/{}`\n\n{}.\n", group.name, capital(group.title));
    let _ = writeln!(page, "| dimension | |\n| --- | --- |");
    for dimension in group.dimensions {
        let along = match dimension.along {
            Along::Index | Along::Rows => "counted from 0",
            Along::Names => "names",
            Along::Values(_) => "numbers",
            Along::States | Along::Controls | Along::Disturbances => {
                "names; with the variables `NAME_units` and `NAME_long_name`"
            }
            Along::StateAxes => "numbers in the unit of the state",
        };
        let _ = writeln!(
            page,
            "| `{}` | {}: {along} |",
            dimension.name, dimension.meaning
        );
    }
    let _ = writeln!(
        page,
        "\n| variable | over | unit | |\n| --- | --- | --- | --- |"
    );
    for variable in group.variables {
        let over: Vec<String> = variable
            .dimensions
            .iter()
            .map(|d| format!("`{d}`"))
            .collect();
        let _ = writeln!(
            page,
            "| `{}` | {} | {} | {} |",
            variable.name,
            over.join(", "),
            unit(variable),
            meaning(variable)
        );
    }
    if !group.attributes.is_empty() {
        let _ = writeln!(page, "\n| attribute | |\n| --- | --- |");
        for (name, meaning) in group.attributes {
            let _ = writeln!(page, "| `{name}` | {meaning} |");
        }
    }
    page.push('\n');
}

fn unit(variable: &Variable) -> String {
    let words = match (variable.kind, variable.unit) {
        (Kind::Text, _) => "text",
        (Kind::Code, _) => "code",
        (Kind::Integer, _) => "integer",
        (Kind::Real, Unit::One) => "1",
        (Kind::Real, Unit::Cost) => "cost",
        (Kind::Real, Unit::Time) => "time",
        (Kind::Real, Unit::CostRate) => "cost/time",
        (Kind::Real, Unit::State) => "the states'",
        (Kind::Real, Unit::Costate) => "cost/the states'",
        (Kind::Real, Unit::Control) => "the controls'",
        (Kind::Real, Unit::Disturbance) => "the disturbances'",
        (Kind::Real, Unit::Fixed(unit)) => unit,
    };
    words.to_owned()
}

fn meaning(variable: &Variable) -> String {
    // A bar would end the cell.
    let text = variable.meaning.replace('|', "\\|");
    match variable.when {
        When::Always => text,
        When::Controls => format!("{text} (with controls)"),
        When::Disturbances => format!("{text} (with disturbances)"),
        When::With(what) => format!("{text} (with {what})"),
    }
}

fn capital(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or_else(String::new, |first| {
        first.to_uppercase().chain(letters).collect()
    })
}
