//! V, p and u along the only state of a scene.

use super::Made;
use super::panels::{Curve, Panel, Panels};
use crate::canvas::{Ink, Stroke};
use crate::plane::even;
use crate::{Picture, Source, colours, names};
use costate::low_level::map::Value;

/// States that are asked for.
const STATES: usize = 801;

pub fn picture(source: &Source<'_>) -> Made {
    let model = source.model;
    let ([state], true) = (model.states.as_slice(), source.knows_values()) else {
        return Ok(None);
    };
    let map = source.stored.value_map().map_err(|e| e.to_string())?;
    let x = even(model.region[0], STATES);
    let found: Vec<Option<Value>> = map
        .at_many(&x, false)
        .into_iter()
        .map(|at| at.lowest.ok())
        .collect();
    let known = found.iter().flatten().count();
    if known == 0 {
        return Err("V is known at no state of the region".to_owned());
    }

    let name = names::symbol(&state.variable.name);
    let mut panels = vec![
        panel("V".to_owned(), &x, &found, |value| value.v),
        panel(format!("p = dV/d{name}"), &x, &found, |value| value.p[0]),
    ];
    for (k, control) in model.controls.iter().enumerate() {
        panels.push(Panel {
            bounds: [control.min, control.max].into_iter().flatten().collect(),
            ..panel(names::label(&control.variable), &x, &found, |value| {
                value.u[k]
            })
        });
    }
    Ok(Some(Picture {
        name: "curve".to_owned(),
        title: format!(
            "Value function V, its slope and the optimal control over {name}{}",
            source.fixed()
        ),
        caption: format!(
            "The least cost from each state on, p = dV/d{name}, and u*. Lines end where nothing is known, and where the cheapest \
             solution changes to another sheet.{}",
            match known < STATES {
                true => format!(" Known at {known} of {STATES} states."),
                false => String::new(),
            }
        ),
        drawing: Box::new(Panels {
            x_label: names::label(&state.variable),
            panels,
            legend: Vec::new(),
            marks: Vec::new(),
            columns: 1,
            tall: 1.2,
            log: false,
        }),
    }))
}

/// What is known along the state, a line for each run of states on one sheet. That of the series
/// about the equilibrium, which has no number, goes on on both sides.
fn panel(label: String, x: &[f64], found: &[Option<Value>], of: impl Fn(&Value) -> f64) -> Panel {
    let stroke = Stroke::new(Ink::Colour(colours::class(0)), 1.9);
    let places: Vec<(f64, Option<&Value>)> = x
        .iter()
        .copied()
        .zip(found.iter().map(Option::as_ref))
        .collect();
    let goes_on = |(_, a): &(f64, Option<&Value>), (_, b): &(f64, Option<&Value>)| match (a, b) {
        (Some(a), Some(b)) => a.sheet == b.sheet || a.sheet.min(b.sheet) < 0,
        _ => false,
    };
    let curves = places.chunk_by(goes_on).filter_map(|run| {
        let points: Vec<[f64; 2]> = (run.iter())
            .filter_map(|(x, value)| Some([*x, of((*value)?)]))
            .collect();
        (points.len() > 1).then_some(Curve { points, stroke })
    });
    Panel {
        label,
        curves: curves.collect(),
        ..Panel::default()
    }
}
