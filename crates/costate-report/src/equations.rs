//! A scene's equations as text.

use super::names;
use costate::low_level::model::{Horizon, Model};

/// A group of equations: what they are, and a line each.
pub struct Equations {
    pub heading: String,
    pub lines: Vec<String>,
}

/// Everything that defines the problem, as the scene has it.
pub fn of(model: &Model) -> Vec<Equations> {
    let written = |span: &costate::low_level::model::Span| {
        tidy(model.text.get(span.clone()).unwrap_or_default())
    };
    let mut all = Vec::new();
    let mut add = |heading: &str, lines: Vec<String>| {
        if !lines.is_empty() {
            all.push(Equations {
                heading: heading.to_owned(),
                lines,
            });
        }
    };
    let variable = |v: &costate::low_level::model::Variable, more: &str| {
        let long = v
            .long_name
            .as_deref()
            .map_or_else(String::new, |l| format!(": {l}"));
        format!("{}{long}{}{more}", v.name, names::unit(v.unit.as_deref()))
    };
    add(
        "States",
        model
            .states
            .iter()
            .map(|s| variable(&s.variable, ""))
            .collect(),
    );
    let controls = model.controls.iter().map(|c| {
        let bounds = match (c.min, c.max) {
            (Some(a), Some(b)) => format!(", from {a} to {b}"),
            (Some(a), None) => format!(", at least {a}"),
            (None, Some(b)) => format!(", at most {b}"),
            (None, None) => String::new(),
        };
        variable(&c.variable, &bounds)
    });
    add("Controls", controls.collect());
    let dynamics = (model.states.iter().zip(&model.dynamics))
        .map(|(s, d)| format!("{}' = {}", s.variable.name, written(&d.span)));
    add("Dynamics", dynamics.collect());
    add(
        "Running cost",
        vec![format!("L = {}", written(&model.running.span))],
    );
    match &model.horizon {
        Horizon::Infinite { x, u, .. } => {
            let states = model.states.iter().map(|s| &s.variable.name).zip(x);
            let controls = model.controls.iter().map(|c| &c.variable.name).zip(u);
            let values = states
                .chain(controls)
                .map(|(name, v)| format!("{name} = {}", super::ticks::significant(*v, 6)));
            add("Equilibrium", vec![values.collect::<Vec<_>>().join(", ")]);
        }
        Horizon::Finite {
            terminal,
            final_time,
            ..
        } => {
            let at = super::ticks::significant(*final_time, 6);
            add(
                "Terminal cost",
                vec![format!("{} at t = {at}", written(&terminal.span))],
            );
        }
    }
    let definitions = costate::low_level::scenario::definitions(&model.text);
    add(
        "Definitions",
        definitions
            .iter()
            .map(|(k, v)| format!("{k} = {}", tidy(v)))
            .collect(),
    );
    add(
        "Parameters",
        vec![
            (model.parameters.iter())
                .map(|p| format!("{} = {}", p.name, super::ticks::significant(p.value, 6)))
                .collect::<Vec<_>>()
                .join(", "),
        ],
    );
    all.retain(|e| e.lines.iter().any(|l| !l.is_empty()));
    all
}

/// Without quotes and line ends.
fn tidy(text: &str) -> String {
    let text = text.trim();
    let quotes = ["\"\"\"", "'''", "\"", "'"];
    let inner = quotes
        .iter()
        .find_map(|q| text.strip_prefix(q).and_then(|t| t.strip_suffix(q)))
        .unwrap_or(text);
    inner.split_whitespace().collect::<Vec<_>>().join(" ")
}
