//! The dissipation inequality: how near each disturbance came to it, and those that came nearest.

use super::Made;
use super::histories;
use super::panels::{Curve, Panel, Panels};
use crate::canvas::{Dash, Ink, Stroke};
use crate::frame::{Mark, dashed};
use crate::{Picture, Source, colours, names};
use costate::low_level::closed_loop::dissipation::ratio_text;
use costate::low_level::result::{StoredError, StoredGroup};
use costate::low_level::schema;

/// Points of a curve: more are not told apart.
const POINTS: usize = 400;
/// Laws by dash.
const DASHES: [Dash; 3] = [Dash::Solid, Dash::Dashed, Dash::Dotted];

struct Cases {
    laws: Vec<String>,
    kinds: Vec<String>,
    /// `[case]`: index of its kind.
    kind: Vec<i32>,
    v0: Vec<f64>,
    /// `[law][case]`.
    ratio: Vec<f64>,
}

fn read(group: &StoredGroup<'_>) -> Result<Cases, StoredError> {
    let laws = group.texts("law")?;
    let kind = group.i32("kind")?.1;
    let ratio = group.shaped("ratio", &[laws.len(), kind.len()])?;
    let kinds = group
        .attribute(Some("kind"), "flag_meanings")
        .unwrap_or_default();
    Ok(Cases {
        v0: group.f64("V0")?.values,
        kinds: kinds
            .split_whitespace()
            .map(|k| k.replace('_', " "))
            .collect(),
        laws,
        kind,
        ratio,
    })
}

impl Cases {
    /// Rising ratios of a law and kind.
    fn sorted(&self, law: usize, kind: usize) -> Vec<f64> {
        let own = self.ratio[law * self.kind.len()..].iter().zip(&self.kind);
        let mut all: Vec<f64> = own
            .filter(|(r, k)| **k == kind as i32 && r.is_finite())
            .map(|(r, _)| *r)
            .collect();
        all.sort_by(f64::total_cmp);
        all
    }

    fn legend(&self, laws: usize) -> Vec<(Mark, String)> {
        let kinds =
            (self.kinds.iter().enumerate()).filter(|(k, _)| self.kind.contains(&(*k as i32)));
        let kinds = kinds.map(|(k, name)| {
            let mark = Mark::Line(Stroke::new(Ink::Colour(colours::class(k)), 2.2));
            (mark, name.clone())
        });
        let laws = (self.laws.iter().take(laws).enumerate())
            .filter(|_| laws > 1)
            .map(|(k, name)| {
                let mark = Mark::Line(Stroke::new(Ink::Text, 1.7).dash(DASHES[k % 3]));
                (mark, format!("law {name}"))
            });
        kinds.chain(laws).collect()
    }
}

pub fn picture(source: &Source<'_>) -> Made {
    let Some(group) = source.stored.group(&schema::DISSIPATION) else {
        return Ok(None);
    };
    let cases = read(&group).map_err(|e| e.to_string())?;
    let mut curves = Vec::new();
    let mut largest = Vec::new();
    for law in 0..cases.laws.len() {
        for (kind, name) in cases.kinds.iter().enumerate() {
            let ratios = cases.sorted(law, kind);
            let Some(last) = ratios.last() else { continue };
            if law == 0 {
                largest.push(format!("{name} {}", ratio_text(*last)));
            }
            let place = |k: usize| (k as f64 + 0.5) / ratios.len() as f64;
            let stride = ratios.len().div_ceil(POINTS);
            let mut points: Vec<[f64; 2]> = (0..ratios.len())
                .step_by(stride)
                .map(|k| [place(k), ratios[k]])
                .collect();
            points.push([1.0, *last]);
            curves.push(Curve {
                points,
                stroke: Stroke::new(Ink::Colour(colours::class(kind)), 2.0).dash(DASHES[law % 3]),
            });
        }
    }
    if curves.is_empty() {
        return Err("V is known at no initial state".to_owned());
    }
    let mut legend = cases.legend(cases.laws.len());
    legend.push((
        Mark::Line(dashed(Ink::Muted)),
        "what V certifies".to_owned(),
    ));
    let highest = cases
        .ratio
        .iter()
        .copied()
        .filter(|r| r.is_finite())
        .fold(1.0, f64::max);
    Ok(Some(Picture {
        name: "dissipation".to_owned(),
        title: "Dissipation inequality under disturbances".to_owned(),
        caption: format!(
            "{} disturbances, each kind sorted by what it did, E, of what it paid for and V at its beginning, W + V(x0), at the worst \
             time: V certifies that this stays below 1. Largest of law {}: {}.",
            cases.kind.len(),
            cases.laws[0],
            largest.join(", ")
        ),
        drawing: Box::new(Panels {
            x_label: "share of the disturbances of a kind".to_owned(),
            panels: vec![Panel {
                label: "E/(W + V(x0))".to_owned(),
                curves,
                bounds: vec![1.0],
                range: Some([0.0, 1.05 * highest]),
                ..Panel::default()
            }],
            legend,
            marks: Vec::new(),
            columns: 1,
            tall: 1.9,
            log: false,
        }),
    }))
}

/// The trajectories that came nearest, one of each kind, under the first law.
pub fn histories(source: &Source<'_>) -> Made {
    let (Some(all), Some(group)) = (
        source.stored.group(&schema::DISSIPATION),
        source.stored.group(&schema::DISSIPATION_TRAJECTORIES),
    ) else {
        return Ok(None);
    };
    let text = |e: StoredError| e.to_string();
    let cases = read(&all).map_err(text)?;
    let (law, case) = (
        group.i32("law").map_err(text)?.1,
        group.i32("case").map_err(text)?.1,
    );
    let t = group.f64("t").map_err(text)?;
    let &[count, samples] = t.shape.as_slice() else {
        return Err("/dissipation_trajectories: t is not trajectory x sample".to_owned());
    };
    let model = source.model;
    let [n, m, k] = [
        model.states.len(),
        model.controls.len(),
        model.disturbances.len(),
    ];
    let column =
        |name: &str, width: usize| group.shaped(name, &[count, samples, width]).map_err(text);
    let scalar = |name: &str| group.shaped(name, &[count, samples]).map_err(text);
    let quantities = [
        (column("x", n)?, n),
        (column("u", m)?, m),
        (column("w", k)?, k),
    ];
    let (v, done, supplied) = (scalar("V")?, scalar("E_z")?, scalar("W")?);
    let mut panels = histories::panels(model);
    panels.extend(model.disturbances.iter().map(|w| Panel {
        label: names::label(w),
        rest: Some(0.0),
        ..Panel::default()
    }));
    let balance = panels.len();
    panels.push(Panel {
        label: "(E + V)/(W + V(x0))".to_owned(),
        bounds: vec![1.0],
        ..Panel::default()
    });
    let mut drawn = Vec::new();
    for path in 0..count {
        let Some(kind) = cases.kind.get(case[path] as usize).copied() else {
            continue;
        };
        // The nearest of a kind comes first.
        if law[path] != 0 || drawn.contains(&kind) {
            continue;
        }
        drawn.push(kind);
        let stroke = Stroke::new(Ink::Colour(colours::class(kind as usize)), 1.7);
        let own = path * samples..(path + 1) * samples;
        let mut place = 0;
        for (values, width) in &quantities {
            for i in 0..*width {
                let points = own
                    .clone()
                    .map(|s| [t.values[s], values[s * width + i]])
                    .collect();
                panels[place].curves.push(Curve { points, stroke });
                place += 1;
            }
        }
        let v0 = cases.v0[case[path] as usize];
        let share = |s: usize| (done[s] + v[s]) / (supplied[s] + v0);
        let points = own
            .map(|s| [t.values[s], share(s)])
            .filter(|p| p[1].is_finite())
            .collect();
        panels[balance].curves.push(Curve { points, stroke });
    }
    if drawn.is_empty() {
        return Ok(None);
    }
    Ok(Some(Picture {
        name: "dissipation_histories".to_owned(),
        title: "The disturbances that came nearest to the bound".to_owned(),
        caption: format!(
            "Of each kind the one with the largest E/(W + V(x0)) under law {}. Below: what was done and may still be done, of what was paid \
             for; under the worst case this stays 1, under any other disturbance it falls.",
            cases.laws[0]
        ),
        drawing: Box::new(Panels {
            x_label: source.time_label(),
            panels,
            legend: cases.legend(1),
            marks: Vec::new(),
            columns: 2,
            tall: 1.0,
            log: false,
        }),
    }))
}
