//! States and controls against time.

use super::Made;
use super::panels::{Curve, Panel, Panels};
use crate::canvas::{Dash, Ink, Stroke};
use crate::flow::Flow;
use crate::frame::Mark;
use crate::{Drawing, Picture, Source, colours, names};
use costate::low_level::model::{Horizon, Model};
use costate::low_level::result::{StoredError, StoredGroup};
use costate::low_level::schema;
use costate::low_level::trajectories::SweptTrajectories;
use std::ops::Range;

/// Trajectories of the picture: more are not told apart.
const SHOWN: usize = 5;
/// Initial states of the picture of closed loops.
const STARTS: usize = 3;
/// Initial states by dash.
const DASHES: [Dash; 3] = [Dash::Solid, Dash::Dashed, Dash::Dotted];

pub fn picture(source: &Source<'_>) -> Made {
    let Some(t) = source.trajectories()?.filter(|t| t.is_full()) else {
        return Ok(None);
    };
    let shown = far_apart(source.model, t, SHOWN);
    if shown.is_empty() {
        return Ok(None);
    }
    let mut panels = panels(source.model);
    let mut flow = Flow::new(source.model, &source.stored.scene.hamiltonian);
    for (place, k) in shown.iter().enumerate() {
        let stroke = Stroke::new(ink(place), 1.7);
        let curves = optimal(source.model, &mut flow, t, *k);
        for (panel, points) in panels.iter_mut().zip(curves) {
            panel.curves.push(Curve { points, stroke });
        }
    }
    let legend = (shown.iter().enumerate()).map(|(place, k)| {
        let mark = Mark::Line(Stroke::new(ink(place), 2.2));
        (mark, format!("trajectory {k}"))
    });
    Ok(Some(Picture {
        name: "histories".to_owned(),
        title: "Optimal states and controls against time".to_owned(),
        caption: format!(
            "{} optimal trajectories whose initial states are far apart, from their first point on{}{}.",
            shown.len(),
            if source.infinite() {
                "; dotted: the equilibrium"
            } else {
                ""
            },
            if has_bounds(source.model) {
                "; dashed: a control's bounds"
            } else {
                ""
            },
        ),
        drawing: drawing(source, panels, legend.collect()),
    }))
}

/// Each state, between samples too, and each control of a trajectory against the time since its
/// first point.
fn optimal(
    model: &Model,
    flow: &mut Flow<'_>,
    t: &SweptTrajectories,
    k: usize,
) -> Vec<Vec<[f64; 2]>> {
    let path = flow.path(t, k);
    let Some(start) = path.first().map(|(_, time, _)| *time) else {
        return Vec::new();
    };
    let m = model.controls.len();
    let state = |i: usize| {
        let points = path.iter().map(|(_, time, x)| [time - start, x[i]]);
        points.collect()
    };
    let control = |i: usize| {
        let samples = (k * t.samples..(k + 1) * t.samples).filter(|s| t.v[*s].is_finite());
        samples.map(|s| [t.t[s] - start, t.u[s * m + i]]).collect()
    };
    let states = (0..model.states.len()).map(state);
    states.chain((0..m).map(control)).collect()
}

/// Closed loops of several laws from the same initial states.
pub fn closed_loop(source: &Source<'_>) -> Made {
    let Some(group) = source.stored.group(&schema::CLOSED_LOOP_TRAJECTORIES) else {
        return Ok(None);
    };
    let loops = Loops::read(source.model, &group)?;
    let mut panels = panels(source.model);
    let shown = loops.starts.min(STARTS);
    for law in 0..loops.laws.len() {
        for place in 0..shown {
            let stroke = Stroke::new(ink(law), 1.7).dash(DASHES[place % 3]);
            let curves = loops.curves(law, place * loops.starts / shown);
            for (panel, points) in panels.iter_mut().zip(curves) {
                panel.curves.push(Curve { points, stroke });
            }
        }
    }
    let laws = (loops.laws.into_iter().enumerate())
        .map(|(k, name)| (Mark::Line(Stroke::new(ink(k), 2.2)), name));
    let dashes = (0..shown).filter(|_| shown > 1).map(|k| {
        let mark = Mark::Line(Stroke::new(Ink::Text, 1.7).dash(DASHES[k % 3]));
        (mark, format!("initial state {}", k + 1))
    });
    Ok(Some(Picture {
        name: "closed_loop_histories".to_owned(),
        title: "Closed loops against time".to_owned(),
        caption: format!(
            "The same {shown} initial states under every law: a colour is a law, a dash an initial state. Laws whose lines lie \
             on each other act alike."
        ),
        drawing: drawing(source, panels, laws.chain(dashes).collect()),
    }))
}

/// Flights of a simulation: each phase is a line of its own.
pub fn simulated(source: &Source<'_>) -> Made {
    let Some(group) = source.stored.group(&schema::SIMULATION_SAMPLES) else {
        return Ok(None);
    };
    let text = |e: StoredError| e.to_string();
    let (_, flights) = group.i32("flight").map_err(text)?;
    let (_, phases) = group.i32("phase").map_err(text)?;
    let t = group.f64("t").map_err(text)?.values;
    let mut quantities = vec![(
        group.f64("x").map_err(text)?.values,
        source.model.states.len(),
    )];
    if !source.model.controls.is_empty() {
        let u = group.f64("u").map_err(text)?.values;
        quantities.push((u, source.model.controls.len()));
    }
    let fits = |(values, width): &(Vec<f64>, usize)| values.len() == t.len() * width;
    if !quantities.iter().all(fits) || flights.len() != t.len() || phases.len() != t.len() {
        return Err("/simulation_samples: x, u and t do not fit".to_owned());
    }
    let mut panels = panels(source.model);
    let rows: Vec<usize> = (0..t.len())
        .filter(|k| usize::try_from(flights[*k]).is_ok_and(|f| f < SHOWN))
        .collect();
    let phase = |k: usize| (flights[k], phases[k]);
    for rows in rows.chunk_by(|a, b| phase(*a) == phase(*b)) {
        let place = usize::try_from(flights[rows[0]]).unwrap_or(0);
        let samples = rows[0]..rows[rows.len() - 1] + 1;
        let shown = quantities.iter().map(|(values, width)| (values, *width));
        for (panel, points) in panels.iter_mut().zip(against_time(&t, samples, shown)) {
            let stroke = Stroke::new(ink(place), 1.7);
            panel.curves.push(Curve { points, stroke });
        }
    }
    let shown = rows.last().map_or(0, |k| flights[*k] + 1);
    if shown == 0 {
        return Ok(None);
    }
    let legend = (0..shown).filter(|_| shown > 1).map(|k| {
        let mark = Mark::Line(Stroke::new(ink(k as usize), 2.2));
        (mark, format!("flight {}", k + 1))
    });
    Ok(Some(Picture {
        name: "simulation".to_owned(),
        title: "Simulated states and controls against time".to_owned(),
        caption: "Lines are interrupted where the state jumps at an event.".to_owned(),
        drawing: drawing(source, panels, legend.collect()),
    }))
}

/// `/closed_loop_trajectories`.
struct Loops {
    laws: Vec<String>,
    starts: usize,
    samples: usize,
    /// `[law][start][sample]`, and of each sample the states and the controls.
    t: Vec<f64>,
    x: Vec<f64>,
    u: Vec<f64>,
    states: usize,
    controls: usize,
}

impl Loops {
    fn read(model: &Model, group: &StoredGroup<'_>) -> Result<Self, String> {
        let text = |e: StoredError| e.to_string();
        let laws = group.texts("law").map_err(text)?;
        let (t, x, u) = (
            group.f64("t").map_err(text)?,
            group.f64("x").map_err(text)?,
            group.f64("u").map_err(text)?,
        );
        let (n, m) = (model.states.len(), model.controls.len());
        let (&[count, starts, samples], true) =
            (t.shape.as_slice(), x.values.len() == t.values.len() * n)
        else {
            return Err("/closed_loop_trajectories: t is not law x trajectory x sample".to_owned());
        };
        if u.values.len() != t.values.len() * m || laws.len() != count {
            return Err("/closed_loop_trajectories: u does not fit t".to_owned());
        }
        Ok(Self {
            laws,
            starts,
            samples,
            t: t.values,
            x: x.values,
            u: u.values,
            states: n,
            controls: m,
        })
    }

    /// Each state and control of a trajectory against time.
    fn curves(&self, law: usize, start: usize) -> Vec<Vec<[f64; 2]>> {
        let first = (law * self.starts + start) * self.samples;
        let quantities = [(&self.x, self.states), (&self.u, self.controls)];
        against_time(&self.t, first..first + self.samples, quantities)
    }
}

/// Each component of quantities against time; of each quantity `[sample][component]` and the number
/// of components.
pub(super) fn against_time<'q>(
    t: &[f64],
    samples: Range<usize>,
    quantities: impl IntoIterator<Item = (&'q Vec<f64>, usize)>,
) -> Vec<Vec<[f64; 2]>> {
    let mut curves = Vec::new();
    for (values, width) in quantities {
        for i in 0..width {
            let points = samples.clone().map(|s| [t[s], values[s * width + i]]);
            curves.push(points.collect());
        }
    }
    curves
}

/// Panels against time, two beside each other.
fn drawing(
    source: &Source<'_>,
    panels: Vec<Panel>,
    legend: Vec<(Mark, String)>,
) -> Box<dyn Drawing> {
    Box::new(Panels {
        x_label: source.time_label(),
        panels,
        legend,
        marks: Vec::new(),
        columns: 2,
        tall: 1.0,
        log: false,
    })
}

/// Colour of a law, or of a trajectory.
fn ink(k: usize) -> Ink {
    Ink::Colour(colours::class(k))
}

fn has_bounds(model: &Model) -> bool {
    model
        .controls
        .iter()
        .any(|c| c.min.is_some() || c.max.is_some())
}

/// A panel for each state and control, still empty.
pub fn panels(model: &Model) -> Vec<Panel> {
    let rest: Option<Vec<f64>> = match &model.horizon {
        Horizon::Infinite { x, u, .. } => Some([x.as_slice(), u].concat()),
        Horizon::Finite { .. } => None,
    };
    let states = model.states.iter().map(|s| (&s.variable, Vec::new()));
    let controls = (model.controls.iter()).map(|c| {
        (
            &c.variable,
            [c.min, c.max].into_iter().flatten().collect::<Vec<_>>(),
        )
    });
    (states.chain(controls).enumerate())
        .map(|(k, (variable, bounds))| Panel {
            label: names::label(variable),
            bounds,
            rest: rest.as_ref().map(|r| r[k]),
            ..Panel::default()
        })
        .collect()
}

/// Trajectories whose first points are far from each other, in units of the region, and within it
/// if any is.
pub(super) fn far_apart(model: &Model, t: &SweptTrajectories, most: usize) -> Vec<usize> {
    let n = model.states.len();
    let first = |k: usize| (k * t.samples..(k + 1) * t.samples).find(|s| t.v[*s].is_finite());
    let place = |k: usize| -> Option<Vec<f64>> {
        let s = first(k)?;
        let scaled = |i: usize| {
            (t.x[s * n + i] - model.region[i][0]) / (model.region[i][1] - model.region[i][0])
        };
        Some((0..n).map(scaled).collect())
    };
    // Some thousands are as good as all.
    let stride = t.count.div_ceil(4000).max(1);
    let all: Vec<(usize, Vec<f64>)> = (0..t.count)
        .step_by(stride)
        .filter_map(|k| Some((k, place(k)?)))
        .collect();
    let inside = |x: &[f64]| x.iter().all(|v| (0.0..=1.0).contains(v));
    let within: Vec<&(usize, Vec<f64>)> = all.iter().filter(|(_, x)| inside(x)).collect();
    let all: Vec<&(usize, Vec<f64>)> = if within.len() >= most {
        within
    } else {
        all.iter().collect()
    };
    let mut nearest = vec![f64::INFINITY; all.len()];
    let mut chosen = Vec::new();
    let mut next = (!all.is_empty()).then_some(0);
    while let Some(k) = next.filter(|_| chosen.len() < most) {
        chosen.push(all[k].0);
        for (d, other) in nearest.iter_mut().zip(&all) {
            let apart: f64 = other
                .1
                .iter()
                .zip(&all[k].1)
                .map(|(a, b)| (a - b) * (a - b))
                .sum();
            *d = d.min(apart);
        }
        next = (0..all.len())
            .max_by(|a, b| nearest[*a].total_cmp(&nearest[*b]))
            .filter(|k| nearest[*k] > 0.0);
    }
    chosen
}
