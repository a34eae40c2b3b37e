//! Optimal trajectories and fronts of equal cost in a phase plane.

use super::Made;
use super::boundary::Boundary;
use crate::canvas::{Canvas, Ink, Rect, Stroke};
use crate::colours;
use crate::flow::Flow;
use crate::frame::{Axis, Bar, Frame, Legend, Mark};
use crate::plane::{Field, GridField};
use crate::ticks::significant;
use crate::{Drawing, Picture, Source};
use costate::low_level::result::StoredError;
use costate::low_level::schema;
use costate::low_level::trajectories::SweptTrajectories;
use std::collections::BTreeMap;

/// Trajectories of a picture.
const SHOWN: usize = 64;
/// Of those that are nowhere optimal, of which there are more the more sheets there are.
const OTHERS: usize = 12;
/// Fronts of a picture.
const FRONTS: usize = 6;
/// Bands of V that trajectories are coloured by.
const BANDS: usize = 10;
/// A trajectory whose V is above the map's by this share, and by this of the largest V, is not
/// optimal there: what interpolation on the map may be off by is less.
const ABOVE: f64 = 0.01;
const ABOVE_ALL: f64 = 0.002;
/// Colour of folds.
pub(super) const FOLD: Ink = Ink::Colour([213, 94, 0]);
/// Sheet of a sample where there is no telling, and where another sheet is cheaper.
const UNKNOWN: i32 = -1;
const DEARER: i32 = -2;

type Path = Vec<[f64; 2]>;

struct Phase {
    labels: [String; 2],
    ranges: [[f64; 2]; 2],
    /// Pieces of trajectories by colour.
    coloured: Vec<(colours::Rgb, Vec<Path>)>,
    /// Pieces that are not optimal.
    faint: Vec<Path>,
    fronts: Vec<Path>,
    boundary: Boundary,
    rest: Vec<[f64; 2]>,
    /// Where trajectories end in folds.
    caustic: Vec<[f64; 2]>,
    legend: Vec<(Mark, String)>,
    /// Ends of the bands of V, where colours show V.
    bands: Vec<f64>,
}

/// A trajectory as seen in the region: states with a period may be shifted by some.
#[derive(Clone)]
struct Seen {
    number: usize,
    shift: Vec<f64>,
    /// The sheet of each sample.
    sheets: Vec<i32>,
    /// Its outermost point in the picture.
    outer: [f64; 2],
}

/// Points of `/caustic` in the plane.
fn caustic(source: &Source<'_>) -> Result<Vec<[f64; 2]>, StoredError> {
    let Some(group) = source.stored.group(&schema::CAUSTIC) else {
        return Ok(Vec::new());
    };
    let n = source.model.states.len();
    let x = group.f64("x")?.values;
    Ok(x.chunks(n).map(|x| source.axes.map(|k| x[k])).collect())
}

pub fn picture(source: &Source<'_>) -> Made {
    let Some(t) = source.trajectories()? else {
        return Ok(None);
    };
    if source.axes[0] == source.axes[1] {
        return Err("it needs two states".to_owned());
    }
    let two = source.model.states.len() == 2;
    let field = if two { source.field()? } else { None };
    let shifts = if two {
        shifts(source)
    } else {
        vec![vec![0.0; source.model.states.len()]]
    };
    let all = seen(source, t, field, &shifts);
    let shown = shown(source, &all);
    let mut drawing = Phase::empty(source, &shifts)?;
    let mut caption = format!(
        "{} of {} optimal trajectories{}. ",
        shown.len(),
        t.count,
        if two {
            ""
        } else {
            ", projected: lines that cross differ in the other states"
        },
    );
    let mut flow = Flow::new(source.model, &source.stored.scene.hamiltonian);
    if has_several_sheets(&all) {
        drawing.by_sheet(source, t, &mut flow, &shown);
        caption += &drawing.said_of_sheets(shifts.len() > 1);
    } else {
        drawing.by_value(source, t, &mut flow, &shown);
        caption += "Colour: V, the cost from there on. ";
    }
    // Samples of a game are no levels of V.
    if two && source.infinite() && !source.model.is_game() {
        let levels = drawing.draw_fronts(source, t, &all);
        caption += &drawing.said_of_fronts(&levels);
    }
    drawing.name_boundary_and_folds();
    caption += if source.infinite() {
        "Motion is towards the dot, the equilibrium; trajectories are stored from the first front on."
    } else {
        "Motion is towards the terminal cost."
    };
    Ok(Some(Picture {
        name: "phase".to_owned(),
        title: format!(
            "Optimal trajectories in the plane of {}",
            super::contours::over(source)
        ),
        caption,
        drawing: Box::new(drawing),
    }))
}

/// Trajectories for the picture: mostly such as are optimal somewhere.
fn shown(source: &Source<'_>, all: &[Seen]) -> Vec<Seen> {
    let optimal = |s: &&Seen| s.sheets.is_empty() || s.sheets.iter().any(|s| *s >= 0);
    let (best, others): (Vec<&Seen>, Vec<&Seen>) = all.iter().partition(optimal);
    let mut shown = spread(source, &best, SHOWN);
    shown.extend(spread(source, &others, OTHERS));
    shown
}

fn has_several_sheets(all: &[Seen]) -> bool {
    let mut sheets = (all.iter())
        .flat_map(|s| s.sheets.iter().copied())
        .filter(|s| *s >= 0);
    let first = sheets.next();
    sheets.any(|s| Some(s) != first)
}

/// Whole periods by which a state of the region may be away from where a trajectory was swept.
fn shifts(source: &Source<'_>) -> Vec<Vec<f64>> {
    let mut all = vec![Vec::new()];
    for state in &source.model.states {
        let steps: Vec<f64> = state.period.map_or_else(
            || vec![0.0],
            |p| (-2..=2).map(|k| f64::from(k) * p).collect(),
        );
        all = all
            .iter()
            .flat_map(|s| steps.iter().map(move |d| [s.as_slice(), &[*d]].concat()))
            .collect();
    }
    all
}

/// Every trajectory with every shift that brings it into the picture.
fn seen(
    source: &Source<'_>,
    t: &SweptTrajectories,
    field: Option<&GridField>,
    shifts: &[Vec<f64>],
) -> Vec<Seen> {
    let n = source.model.states.len();
    let mut all = Vec::new();
    for k in 0..t.count {
        for shift in shifts {
            let at = |s: usize| -> Vec<f64> {
                t.x[s * n..(s + 1) * n]
                    .iter()
                    .zip(shift)
                    .map(|(x, d)| x + d)
                    .collect()
            };
            // Time runs forward: the first sample is the outermost. With a finite horizon it is the
            // only one that V is known for.
            let looked_at = if source.infinite() { t.samples } else { 1 };
            let samples = (k * t.samples..(k + 1) * t.samples).filter(|s| t.v[*s].is_finite());
            let inside = samples.take(looked_at).map(at).find(|x| {
                source.axes.iter().all(|i| {
                    let [from, to] = source.model.region[*i];
                    x[*i] >= from && x[*i] <= to
                })
            });
            let Some(x) = inside else { continue };
            all.push(Seen {
                number: k,
                sheets: field.map_or_else(Vec::new, |f| sheets_along(source, t, f, k, shift)),
                shift: shift.clone(),
                outer: source.axes.map(|i| x[i]),
            });
        }
    }
    all
}

/// The sheet of each sample of a trajectory. With a finite horizon V is known at the initial time
/// only.
fn sheets_along(
    source: &Source<'_>,
    t: &SweptTrajectories,
    field: &GridField,
    k: usize,
    shift: &[f64],
) -> Vec<i32> {
    let n = shift.len();
    let largest = field.largest();
    let range = k * t.samples..(k + 1) * t.samples;
    let told = |s: usize| -> Option<i32> {
        let x: Vec<f64> = t.x[s * n..(s + 1) * n]
            .iter()
            .zip(shift)
            .map(|(x, d)| x + d)
            .collect();
        let local = field.at(&x)?;
        let most = local.v + ABOVE * local.v.abs() + ABOVE_ALL * largest;
        Some(if t.v[s] > most { DEARER } else { local.sheet })
    };
    if !source.infinite() {
        let sheet = range
            .clone()
            .find(|s| t.v[*s].is_finite())
            .and_then(told)
            .unwrap_or(UNKNOWN);
        return vec![sheet; t.samples];
    }
    let mut sheets = vec![UNKNOWN; t.samples];
    let mut current = UNKNOWN;
    // Outward is backward: what is dearer stays so.
    for s in range.clone().rev().filter(|s| t.v[*s].is_finite()) {
        if current != DEARER
            && let Some(sheet) = told(s)
        {
            current = sheet;
        }
        sheets[s - range.start] = current;
    }
    // What the map does not reach further in is on the sheet of what follows.
    if let Some(first) = sheets.iter().rposition(|s| *s >= 0) {
        let sheet = sheets[first];
        sheets[first..].fill(sheet);
    }
    sheets
}

/// At most `most`, their outer ends as far from each other as can be had one by one.
fn spread(source: &Source<'_>, all: &[&Seen], most: usize) -> Vec<Seen> {
    let widths = source
        .axes
        .map(|k| source.model.region[k][1] - source.model.region[k][0]);
    let mut nearest = vec![f64::INFINITY; all.len()];
    let mut chosen = Vec::new();
    let mut next = (!all.is_empty()).then_some(0);
    while let Some(k) = next.filter(|_| chosen.len() < most) {
        chosen.push(Seen::clone(all[k]));
        for (d, s) in nearest.iter_mut().zip(all) {
            let apart = |i: usize| (s.outer[i] - all[k].outer[i]) / widths[i];
            *d = d.min(apart(0).hypot(apart(1)));
        }
        next = (0..all.len())
            .max_by(|a, b| nearest[*a].total_cmp(&nearest[*b]))
            .filter(|k| nearest[*k] > 1e-6);
    }
    chosen
}

/// Pieces of one trajectory of equal class; where a class ends the next begins.
fn pieces(
    source: &Source<'_>,
    t: &SweptTrajectories,
    flow: &mut Flow<'_>,
    seen: &Seen,
    class: impl Fn(usize) -> i32,
) -> Vec<(i32, Path)> {
    let mut pieces: Vec<(i32, Path)> = Vec::new();
    for (s, _, x) in flow.path(t, seen.number) {
        let at = source.axes.map(|k| x[k] + seen.shift[k]);
        let here = class(s);
        if let Some((_, path)) = pieces.last_mut() {
            path.push(at);
        }
        if pieces.last().is_none_or(|(c, _)| *c != here) {
            pieces.push((here, vec![at]));
        }
    }
    pieces
}

impl Phase {
    /// The picture without trajectories and fronts.
    fn empty(source: &Source<'_>, shifts: &[Vec<f64>]) -> Result<Self, String> {
        let rest = source.model.reference();
        Ok(Self {
            labels: source.labels(),
            ranges: source.axes.map(|k| source.model.region[k]),
            coloured: Vec::new(),
            faint: Vec::new(),
            fronts: Vec::new(),
            boundary: Boundary::read(source)?,
            rest: (shifts.iter())
                .filter(|_| source.infinite())
                .map(|s| source.axes.map(|k| rest[k] + s[k]))
                .collect(),
            caustic: if source.model.states.len() == 2 {
                caustic(source).map_err(|e| e.to_string())?
            } else {
                Vec::new()
            },
            legend: Vec::new(),
            bands: Vec::new(),
        })
    }

    /// The caption's part on colours of sheets; `shifted`: trajectories are shown a period away,
    /// too.
    fn said_of_sheets(&self, shifted: bool) -> String {
        let mut said =
            "A colour is a sheet: a family of optimal trajectories that goes its own way. "
                .to_owned();
        if !self.faint.is_empty() {
            said += "Grey: where another sheet offers less, a trajectory is not optimal (or it is not known whether it is). ";
        }
        if shifted {
            said += "Trajectories that leave on one side of the period come in on the other. ";
        }
        said
    }

    /// The legend's entry of fronts, and the caption's part on them.
    fn said_of_fronts(&mut self, levels: &[String]) -> String {
        if levels.is_empty() {
            return String::new();
        }
        let line = Mark::Line(Stroke::new(Ink::Text, 1.3));
        self.legend.push((line, "front of equal cost".to_owned()));
        format!(
            "Across them: fronts of equal cost, V = {}. ",
            levels.join(", ")
        )
    }

    /// The legend's entries of what bounds the sheets.
    fn name_boundary_and_folds(&mut self) {
        if !self.boundary.is_empty() {
            let dark = Stroke::new(Ink::Text, 3.0);
            let what = "equal cost: the control jumps";
            self.legend.push((Mark::Line(dark), what.to_owned()));
        }
        if !self.caustic.is_empty() {
            let what = "fold of the manifold: V is valid up to here";
            self.legend.push((Mark::Dot(FOLD), what.to_owned()));
        }
    }

    fn by_sheet(
        &mut self,
        source: &Source<'_>,
        t: &SweptTrajectories,
        flow: &mut Flow<'_>,
        shown: &[Seen],
    ) {
        let mut by_class: BTreeMap<i32, Vec<Path>> = BTreeMap::new();
        for seen in shown {
            for (sheet, path) in pieces(source, t, flow, seen, |s| {
                seen.sheets[s - seen.number * t.samples]
            }) {
                if sheet < 0 {
                    self.faint.push(path);
                } else {
                    by_class.entry(sheet).or_default().push(path);
                }
            }
        }
        for (sheet, paths) in by_class {
            let colour = colours::class(sheet as usize);
            let mark = Mark::Line(Stroke::new(Ink::Colour(colour), 2.0));
            self.legend.push((mark, format!("sheet {sheet}")));
            self.coloured.push((colour, paths));
        }
        if !self.faint.is_empty() {
            let mark = Mark::Line(Stroke::new(Ink::Muted, 1.0).opacity(0.6));
            self.legend.push((mark, "not optimal".to_owned()));
        }
    }

    fn by_value(
        &mut self,
        source: &Source<'_>,
        t: &SweptTrajectories,
        flow: &mut Flow<'_>,
        shown: &[Seen],
    ) {
        // What lies outside the picture would take the colours of what is in it.
        let shown_here = |k: usize| {
            let x = &t.x[k * source.model.states.len()..][..source.model.states.len()];
            (x.iter().zip(&source.model.region)).all(|(x, [lo, hi])| (lo..=hi).contains(&x))
        };
        let values = (0..t.v.len())
            .filter(|k| t.v[*k].is_finite() && (!source.model.is_game() || shown_here(*k)));
        let values = values.map(|k| t.v[k]);
        let (least, most) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| {
            (a.min(v), b.max(v))
        });
        let zero = if source.infinite() {
            least.min(0.0)
        } else {
            least
        };
        self.bands = (0..=BANDS)
            .map(|k| zero + (most - zero) * k as f64 / BANDS as f64)
            .collect();
        let band = |v: f64| (((v - zero) / (most - zero) * BANDS as f64) as usize).min(BANDS - 1);
        let mut by_band: Vec<Vec<Path>> = vec![Vec::new(); BANDS];
        for seen in shown {
            for (b, path) in pieces(source, t, flow, seen, |s| band(t.v[s]) as i32) {
                by_band[b as usize].push(path);
            }
        }
        self.coloured = (by_band.into_iter().enumerate())
            .map(|(b, paths)| (band_colour(b), paths))
            .collect();
    }

    /// Some fronts, cut where they are not optimal and where neighbours are far apart; their V.
    fn draw_fronts(
        &mut self,
        source: &Source<'_>,
        t: &SweptTrajectories,
        all: &[Seen],
    ) -> Vec<String> {
        let value = |j: usize| {
            let values = (0..t.count)
                .map(|k| t.v[k * t.samples + j])
                .filter(|v| v.is_finite());
            values.fold(f64::NAN, f64::max)
        };
        let most = value(0);
        if !most.is_finite() {
            return Vec::new();
        }
        let mut by_shift: BTreeMap<String, Vec<&Seen>> = BTreeMap::new();
        for seen in all {
            by_shift
                .entry(format!("{:?}", seen.shift))
                .or_default()
                .push(seen);
        }
        let mut rings: Vec<Vec<&Seen>> = by_shift.into_values().collect();
        rings.iter_mut().for_each(|ring| in_order(source, t, ring));
        let mut levels = Vec::new();
        let mut before = usize::MAX;
        for f in 2..=FRONTS + 1 {
            // Even steps of the square root of V: about even in place.
            let wanted = most * (f as f64 / (FRONTS + 1) as f64).powi(2);
            let nearest = (0..t.samples)
                .filter(|j| value(*j).is_finite())
                .min_by(|a, b| {
                    (value(*a) - wanted)
                        .abs()
                        .total_cmp(&(value(*b) - wanted).abs())
                });
            let Some(j) = nearest.filter(|j| *j != before) else {
                continue;
            };
            before = j;
            for ring in &rings {
                self.front(source, t, ring, j);
            }
            levels.push(significant(value(j), 3));
        }
        levels
    }

    /// The axis of the bands of V.
    fn value_axis(&self) -> Axis {
        Axis::linear(
            "",
            [
                self.bands.first().copied().unwrap_or(0.0),
                self.bands.last().copied().unwrap_or(1.0),
            ],
        )
    }

    /// Trajectories and, across them, fronts.
    fn paths(&self, canvas: &mut dyn Canvas, frame: &Frame) {
        canvas.lines(
            &frame.lines(&self.faint),
            Stroke::new(Ink::Muted, 0.8).opacity(0.4),
        );
        let width = if self.bands.is_empty() { 1.1 } else { 1.3 };
        for (colour, paths) in &self.coloured {
            canvas.lines(
                &frame.lines(paths),
                Stroke::new(Ink::Colour(*colour), width).opacity(0.9),
            );
        }
        canvas.lines(&frame.lines(&self.fronts), Stroke::new(Ink::Text, 1.3));
    }

    /// The equal-cost boundary, folds and the equilibrium.
    fn marks(&self, canvas: &mut dyn Canvas, frame: &Frame) {
        let boundary = frame.lines(&self.boundary.lines);
        canvas.lines(&boundary, Stroke::new(Ink::Paper, 5.0).opacity(0.7));
        canvas.lines(&boundary, Stroke::new(Ink::Text, 3.0));
        let points = frame.dots(self.boundary.points.iter().copied());
        canvas.dots(&points, 6.0, Ink::Text, 1.0);
        let folds = frame.dots(self.caustic.iter().copied());
        canvas.dots(&folds, 6.0, Ink::Paper, 1.0);
        canvas.dots(&folds, 4.5, FOLD, 1.0);
        let dots = frame.dots(self.rest.iter().copied());
        canvas.dots(&dots, 10.0, Ink::Paper, 1.0);
        canvas.dots(&dots, 7.0, Ink::Text, 1.0);
    }

    fn front(&mut self, source: &Source<'_>, t: &SweptTrajectories, ring: &[&Seen], j: usize) {
        let spacing = source.model.shoot_out.as_ref().map_or(0.05, |s| s.spacing);
        let widths = source
            .axes
            .map(|k| source.model.region[k][1] - source.model.region[k][0]);
        let mut path: Path = Vec::new();
        for seen in ring.iter().chain(ring.first()) {
            let s = seen.number * t.samples + j;
            let good = t.v[s].is_finite() && seen.sheets.get(j).is_none_or(|s| *s != DEARER);
            let at = source.axes.map(|k| t.x[2 * s + k] + seen.shift[k]);
            let near = path
                .last()
                .is_some_and(|p| (0..2).all(|i| (p[i] - at[i]).abs() <= 3.0 * spacing * widths[i]));
            if (!good || !near) && !path.is_empty() {
                self.fronts.push(std::mem::take(&mut path));
            }
            if good {
                path.push(at);
            }
        }
        self.fronts.push(path);
    }
}

/// Puts trajectories of two states in the order in which they lie around the equilibrium, by their
/// innermost points.
fn in_order(source: &Source<'_>, t: &SweptTrajectories, ring: &mut [&Seen]) {
    let at = source.model.reference();
    let width = source
        .model
        .region
        .iter()
        .map(|[a, b]| b - a)
        .collect::<Vec<_>>();
    let angle = |seen: &Seen| {
        let last = (seen.number * t.samples..(seen.number + 1) * t.samples)
            .rev()
            .find(|s| t.v[*s].is_finite());
        last.map_or(f64::NAN, |s| {
            let of = |i: usize| (t.x[2 * s + i] - at[i]) / width[i];
            of(1).atan2(of(0))
        })
    };
    ring.sort_by(|a, b| angle(a).total_cmp(&angle(b)));
}

fn band_colour(band: usize) -> colours::Rgb {
    // Not up to the lightest, which is hard to see on white.
    colours::value(0.92 * (band as f64 + 0.5) / BANDS as f64)
}

impl Drawing for Phase {
    fn height(&self, width: f64) -> f64 {
        (0.64 * width).clamp(330.0, 700.0)
            + Legend {
                entries: &self.legend,
            }
            .height(width)
    }

    fn draw(&self, canvas: &mut dyn Canvas, area: Rect) {
        let legend = Legend {
            entries: &self.legend,
        };
        legend.draw(canvas, [area.left, area.top], area.width());
        let top = area.top + legend.height(area.width());
        let axis = self.value_axis();
        let width = axis.range[1] - axis.range[0];
        let colour = |v: f64| {
            band_colour((((v - axis.range[0]) / width * BANDS as f64) as usize).min(BANDS - 1))
        };
        let bar = Bar {
            label: "V, cost from there on",
            axis: &axis,
            bands: &self.bands,
            colour: &colour,
        };
        let room = if self.bands.is_empty() {
            0.0
        } else {
            bar.width(area.bottom - top)
        };
        let [x, y] = [0, 1].map(|k| Axis::linear(self.labels[k].clone(), self.ranges[k]));
        let frame = Frame::within(
            Rect::new(area.left, top, area.right - room, area.bottom),
            x,
            y,
        );
        frame.under(canvas);
        self.paths(canvas, &frame);
        self.marks(canvas, &frame);
        frame.over(canvas);
        if !self.bands.is_empty() {
            bar.draw(
                canvas,
                frame.area.right + 14.0,
                frame.area.top,
                frame.area.bottom,
            );
        }
    }
}
