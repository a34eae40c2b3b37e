//! The dissipation inequality: how near each disturbance came to it, and those that came nearest.

use super::Made;
use super::histories;
use super::panels::{Curve, Panel, Panels};
use crate::canvas::{Dash, Ink, Stroke};
use crate::frame::{Mark, dashed};
use crate::{Picture, Source, colours, names};
use costate::low_level::closed_loop::dissipation::ratio_text;
use costate::low_level::model::Model;
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

    /// A curve a law and kind: rising ratios over their place among all.
    fn curves(&self) -> Vec<Curve> {
        let mut curves = Vec::new();
        for law in 0..self.laws.len() {
            for kind in 0..self.kinds.len() {
                let ratios = self.sorted(law, kind);
                let Some(last) = ratios.last() else { continue };
                let place = |k: usize| (k as f64 + 0.5) / ratios.len() as f64;
                let stride = ratios.len().div_ceil(POINTS);
                let mut points: Vec<[f64; 2]> = (0..ratios.len())
                    .step_by(stride)
                    .map(|k| [place(k), ratios[k]])
                    .collect();
                points.push([1.0, *last]);
                let ink = Ink::Colour(colours::class(kind));
                curves.push(Curve {
                    points,
                    stroke: Stroke::new(ink, 2.0).dash(DASHES[law % 3]),
                });
            }
        }
        curves
    }

    /// The largest ratio of each kind under the first law, in words.
    fn largest(&self) -> Vec<String> {
        let told = |(kind, name): (usize, &String)| {
            let last = *self.sorted(0, kind).last()?;
            Some(format!("{name} {}", ratio_text(last)))
        };
        self.kinds.iter().enumerate().filter_map(told).collect()
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
    let curves = cases.curves();
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
            cases.largest().join(", ")
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
    let cases = read(&all).map_err(|e| e.to_string())?;
    let paths = Paths::read(source.model, &group)?;
    let mut panels = empty_panels(source.model);
    let mut drawn = Vec::new();
    for path in 0..paths.count {
        let case = paths.case[path] as usize;
        let Some(kind) = cases.kind.get(case).copied() else {
            continue;
        };
        // The nearest of a kind comes first.
        if paths.law[path] != 0 || drawn.contains(&kind) {
            continue;
        }
        drawn.push(kind);
        let stroke = Stroke::new(Ink::Colour(colours::class(kind as usize)), 1.7);
        let curves = paths.curves(path, cases.v0[case]).into_iter();
        for (panel, points) in panels.iter_mut().zip(curves) {
            panel.curves.push(Curve { points, stroke });
        }
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

/// A panel for each state, control and disturbance, and one for the balance.
fn empty_panels(model: &Model) -> Vec<Panel> {
    let mut panels = histories::panels(model);
    panels.extend(model.disturbances.iter().map(|w| Panel {
        label: names::label(w),
        rest: Some(0.0),
        ..Panel::default()
    }));
    panels.push(Panel {
        label: "(E + V)/(W + V(x0))".to_owned(),
        bounds: vec![1.0],
        ..Panel::default()
    });
    panels
}

/// `/dissipation_trajectories`.
struct Paths {
    /// `[path]`.
    law: Vec<i32>,
    case: Vec<i32>,
    count: usize,
    samples: usize,
    /// `[path][sample]`.
    t: Vec<f64>,
    v: Vec<f64>,
    done: Vec<f64>,
    supplied: Vec<f64>,
    /// x, u and w, `[path][sample][component]`, with the number of components.
    quantities: [(Vec<f64>, usize); 3],
}

impl Paths {
    fn read(model: &Model, group: &StoredGroup<'_>) -> Result<Self, String> {
        let text = |e: StoredError| e.to_string();
        let (law, case) = (
            group.i32("law").map_err(text)?.1,
            group.i32("case").map_err(text)?.1,
        );
        let t = group.f64("t").map_err(text)?;
        let &[count, samples] = t.shape.as_slice() else {
            return Err("/dissipation_trajectories: t is not trajectory x sample".to_owned());
        };
        let column = |name: &str, width: usize| {
            let values = group.shaped(name, &[count, samples, width]);
            values.map(|values| (values, width)).map_err(text)
        };
        let scalar = |name: &str| group.shaped(name, &[count, samples]).map_err(text);
        Ok(Self {
            law,
            case,
            count,
            samples,
            t: t.values,
            quantities: [
                column("x", model.states.len())?,
                column("u", model.controls.len())?,
                column("w", model.disturbances.len())?,
            ],
            v: scalar("V")?,
            done: scalar("E_z")?,
            supplied: scalar("W")?,
        })
    }

    /// Each quantity of a path against time, and last the balance; `v0`: V at its beginning.
    fn curves(&self, path: usize, v0: f64) -> Vec<Vec<[f64; 2]>> {
        let own = path * self.samples..(path + 1) * self.samples;
        let quantities = self
            .quantities
            .iter()
            .map(|(values, width)| (values, *width));
        let mut curves = histories::against_time(&self.t, own.clone(), quantities);
        let share = |s: usize| (self.done[s] + self.v[s]) / (self.supplied[s] + v0);
        let points = own
            .map(|s| [self.t[s], share(s)])
            .filter(|p| p[1].is_finite());
        curves.push(points.collect());
        curves
    }
}
