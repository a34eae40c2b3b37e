//! A scene's equations as text.

use super::names;
use super::ticks::significant;
use costate::low_level::model::{Horizon, Model, Span, Variable};

/// A group of equations: what they are, and a line each.
pub struct Equations {
    pub heading: String,
    pub lines: Vec<String>,
}

/// Everything that defines the problem, as the scene has it.
pub fn of(model: &Model) -> Vec<Equations> {
    let group = |heading: &str, lines: Vec<String>| Equations {
        heading: heading.to_owned(),
        lines,
    };
    let states = model.states.iter().map(|s| variable(&s.variable, ""));
    let controls = (model.controls.iter()).map(|c| variable(&c.variable, &bounds(c.min, c.max)));
    // What follows from a mechanism is written nowhere; its description is.
    let from_mechanism =
        |symbol| (model.mechanism.as_ref()).is_some_and(|mechanism| mechanism.moves(symbol));
    let dynamics = (model.states.iter().zip(&model.dynamics))
        .filter(|(s, _)| !from_mechanism(s.variable.symbol))
        .map(|(s, d)| format!("{}' = {}", s.variable.name, written(model, &d.span)));
    let running = format!("L = {}", written(model, &model.running.span));
    let mechanism = costate::low_level::scenario::mechanism(&model.text);
    let mechanism = (mechanism.iter()).map(|(k, v)| format!("{k} = {}", tidy(v)));
    let definitions = costate::low_level::scenario::definitions(&model.text);
    let definitions = (definitions.iter()).map(|(k, v)| format!("{k} = {}", tidy(v)));
    let parameters = (model.parameters.iter())
        .map(|p| format!("{} = {}", p.name, significant(p.value, 6)))
        .collect::<Vec<_>>();
    let (end, what) = end(model);
    let mut all = vec![
        group("States", states.collect()),
        group("Controls", controls.collect()),
        group("Mechanism", mechanism.collect()),
        group("Dynamics", dynamics.collect()),
        group("Running cost", vec![running]),
        group(end, vec![what]),
        group("Definitions", definitions.collect()),
        group("Parameters", vec![parameters.join(", ")]),
    ];
    all.retain(|e| e.lines.iter().any(|l| !l.is_empty()));
    all
}

/// The scene's own words.
fn written(model: &Model, span: &Span) -> String {
    tidy(model.text.get(span.clone()).unwrap_or_default())
}

/// Name, what it means, unit, and `more`.
fn variable(v: &Variable, more: &str) -> String {
    let long = v
        .long_name
        .as_deref()
        .map_or_else(String::new, |l| format!(": {l}"));
    format!("{}{long}{}{more}", v.name, names::unit(v.unit.as_deref()))
}

/// Bounds of a control, in words.
fn bounds(min: Option<f64>, max: Option<f64>) -> String {
    match (min, max) {
        (Some(a), Some(b)) => format!(", from {a} to {b}"),
        (Some(a), None) => format!(", at least {a}"),
        (None, Some(b)) => format!(", at most {b}"),
        (None, None) => String::new(),
    }
}

/// Where optimal trajectories end, and what is so there.
fn end(model: &Model) -> (&'static str, String) {
    match &model.horizon {
        Horizon::Infinite { x, u, .. } => {
            let states = model.states.iter().map(|s| &s.variable.name).zip(x);
            let controls = model.controls.iter().map(|c| &c.variable.name).zip(u);
            let values = states
                .chain(controls)
                .map(|(name, v)| format!("{name} = {}", significant(*v, 6)));
            ("Equilibrium", values.collect::<Vec<_>>().join(", "))
        }
        Horizon::Finite {
            terminal,
            final_time,
            ..
        } => {
            let at = significant(*final_time, 6);
            let phi = written(model, &terminal.span);
            ("Terminal cost", format!("{phi} at t = {at}"))
        }
    }
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
