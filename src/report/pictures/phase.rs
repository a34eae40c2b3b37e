//! Optimal trajectories and fronts of equal cost in a phase plane.

use super::Made;
use super::boundary::Boundary;
use crate::output::StoredTrajectories;
use crate::report::canvas::{Canvas, Ink, Rect, Stroke};
use crate::report::colours;
use crate::report::frame::{Axis, Bar, Frame, Legend, Mark};
use crate::report::plane::Field;
use crate::report::ticks::significant;
use crate::report::{Drawing, Picture, Source};

/// Trajectories of a picture.
const SHOWN: usize = 96;
/// Fronts of a picture.
const FRONTS: usize = 6;
/// Bands of V that trajectories are coloured by.
const BANDS: usize = 10;
/// A trajectory whose V is above the map's by this share, and by this of the largest V, is not optimal there: what
/// interpolation on the map may be off by is less.
const ABOVE: f64 = 0.01;
const ABOVE_ALL: f64 = 0.002;

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
    rest: Option<[f64; 2]>,
    legend: Vec<(Mark, String)>,
    /// Ends of the bands of V, where colours show V.
    bands: Vec<f64>,
}

pub fn picture(source: &Source<'_>) -> Made {
    let Some(t) = source.trajectories()? else { return Ok(None) };
    if source.axes[0] == source.axes[1] {
        return Err("it needs two states".to_owned());
    }
    let two = source.model.states.len() == 2;
    let ring = if two && source.infinite() { in_order(source, t) } else { (0..t.count).collect() };
    let field = if two { source.field()? } else { None };
    let sheets = field.map(|f| sheets_along(t, f));
    let coloured_by_sheet = sheets.as_ref().is_some_and(|s| {
        let mut all: Vec<i32> = s.iter().copied().filter(|s| *s >= 0).collect();
        all.sort_unstable();
        all.dedup();
        all.len() > 1
    });
    let shown = chosen(&ring, SHOWN);
    let mut drawing = Phase {
        labels: source.labels(),
        ranges: source.axes.map(|k| source.model.region[k]),
        coloured: Vec::new(),
        faint: Vec::new(),
        fronts: Vec::new(),
        boundary: Boundary::read(source)?,
        rest: source.infinite().then(|| source.axes.map(|k| source.model.reference()[k])),
        legend: Vec::new(),
        bands: Vec::new(),
    };
    let mut caption = format!(
        "{} of {} optimal trajectories{}. ",
        shown.len(),
        t.count,
        if two { "" } else { ", projected: lines that cross differ in the other states" },
    );
    match &sheets {
        Some(sheets) if coloured_by_sheet => {
            drawing.by_sheet(source, t, sheets, &shown);
            caption += "A colour is a sheet: a family of optimal trajectories that reaches the equilibrium in its own way. ";
            if !drawing.faint.is_empty() {
                caption += "Thin grey: where a trajectory's own cost is above what another sheet offers, it is an extremal but \
                            not optimal. ";
            }
        }
        _ => {
            drawing.by_value(source, t, &shown);
            caption += "Colour: V, the cost from there on. ";
        }
    }
    if two && source.infinite() {
        let levels = drawing.draw_fronts(source, t, &ring, sheets.as_deref());
        if !levels.is_empty() {
            caption += &format!("Black: fronts of equal cost, V = {}. ", levels.join(", "));
            let line = Mark::Line(Stroke::new(Ink::Text, 1.3));
            drawing.legend.push((line, "front of equal cost".to_owned()));
        }
    }
    if !drawing.boundary.is_empty() {
        let dark = Stroke::new(Ink::Text, 3.0);
        drawing.legend.push((Mark::Line(dark), "equal cost: the control jumps".to_owned()));
    }
    caption += if source.infinite() {
        "Motion is towards the dot, the equilibrium; within the innermost ends V is below the first sample."
    } else {
        "Motion is towards the terminal cost."
    };
    Ok(Some(Picture {
        name: "phase".to_owned(),
        title: format!("Optimal trajectories in the plane of {}", super::contours::over(source)),
        caption,
        drawing: Box::new(drawing),
    }))
}

/// At most `most`, evenly spread.
pub fn chosen<T: Copy>(all: &[T], most: usize) -> Vec<T> {
    let count = all.len().min(most);
    (0..count).map(|k| all[k * all.len() / count]).collect()
}

/// Trajectories of two states in the order in which they lie around the equilibrium, by their innermost points.
fn in_order(source: &Source<'_>, t: &StoredTrajectories) -> Vec<usize> {
    let at = source.model.reference();
    let width = source.model.region.iter().map(|[a, b]| b - a).collect::<Vec<_>>();
    let angle = |k: &usize| {
        let last = (k * t.samples..(k + 1) * t.samples).rev().find(|s| t.v[*s].is_finite());
        last.map_or(f64::NAN, |s| {
            let of = |i: usize| (t.x[2 * s + i] - at[i]) / width[i];
            of(1).atan2(of(0))
        })
    };
    let mut order: Vec<(f64, usize)> = (0..t.count).map(|k| (angle(&k), k)).filter(|(a, _)| a.is_finite()).collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0));
    order.into_iter().map(|(_, k)| k).collect()
}

/// The sheet of each sample, -1 where there is no value, -2 where another sheet is cheaper there or further in.
fn sheets_along(t: &StoredTrajectories, field: &dyn Field) -> Vec<i32> {
    let n = t.x.len() / t.v.len().max(1);
    let largest = t.v.iter().copied().filter(|v| v.is_finite()).fold(0.0, f64::max);
    let mut sheets = vec![-1; t.v.len()];
    for k in 0..t.count {
        let mut current = -1;
        // Time runs forward: outward is backward.
        for s in (k * t.samples..(k + 1) * t.samples).rev() {
            let v = t.v[s];
            if !v.is_finite() {
                continue;
            }
            if current != -2
                && let Some(local) = field.at(&t.x[s * n..(s + 1) * n])
            {
                current = if v > local.v + ABOVE * local.v.abs() + ABOVE_ALL * largest { -2 } else { local.sheet };
            }
            sheets[s] = current;
        }
        // What the map does not reach further in is on the sheet of what follows.
        let range = k * t.samples..(k + 1) * t.samples;
        if let Some(inner) = range.clone().rev().map(|s| sheets[s]).find(|s| *s >= 0) {
            for s in range.rev().take_while(|s| sheets[*s] == -1 || !t.v[*s].is_finite()).collect::<Vec<_>>() {
                if t.v[s].is_finite() {
                    sheets[s] = inner;
                }
            }
        }
    }
    sheets
}

impl Phase {
    fn place(source: &Source<'_>, t: &StoredTrajectories, s: usize) -> [f64; 2] {
        let n = source.model.states.len();
        source.axes.map(|k| t.x[s * n + k])
    }

    /// Pieces of one trajectory of equal class; `None` parts them.
    fn pieces<C: PartialEq + Copy>(
        source: &Source<'_>,
        t: &StoredTrajectories,
        k: usize,
        class: impl Fn(usize) -> Option<C>,
    ) -> Vec<(C, Path)> {
        let mut pieces: Vec<(C, Path)> = Vec::new();
        let mut open: Option<C> = None;
        for s in k * t.samples..(k + 1) * t.samples {
            let at = Self::place(source, t, s);
            let here = if t.v[s].is_finite() { class(s) } else { None };
            let Some(c) = here else {
                open = None;
                continue;
            };
            match pieces.last_mut().filter(|_| open.is_some()) {
                // The last piece reaches up to where the next begins.
                Some((last, path)) => {
                    path.push(at);
                    if *last != c {
                        pieces.push((c, vec![at]));
                    }
                }
                None => pieces.push((c, vec![at])),
            }
            open = Some(c);
        }
        pieces
    }

    fn by_sheet(&mut self, source: &Source<'_>, t: &StoredTrajectories, sheets: &[i32], shown: &[usize]) {
        let mut by_class: std::collections::BTreeMap<i32, Vec<Path>> = std::collections::BTreeMap::new();
        for k in shown {
            for (sheet, path) in Self::pieces(source, t, *k, |s| Some(sheets[s])) {
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
            let mark = Mark::Line(Stroke::new(Ink::Muted, 0.8).opacity(0.6));
            self.legend.push((mark, "not optimal".to_owned()));
        }
    }

    fn by_value(&mut self, source: &Source<'_>, t: &StoredTrajectories, shown: &[usize]) {
        let values = t.v.iter().copied().filter(|v| v.is_finite());
        let (least, most) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
        let zero = if source.infinite() { least.min(0.0) } else { least };
        self.bands = (0..=BANDS).map(|k| zero + (most - zero) * k as f64 / BANDS as f64).collect();
        let band = |v: f64| (((v - zero) / (most - zero) * BANDS as f64) as usize).min(BANDS - 1);
        let mut by_band: Vec<Vec<Path>> = vec![Vec::new(); BANDS];
        for k in shown {
            for (b, path) in Self::pieces(source, t, *k, |s| Some(band(t.v[s]))) {
                by_band[b].push(path);
            }
        }
        self.coloured = (by_band.into_iter().enumerate()).map(|(b, paths)| (band_colour(b), paths)).collect();
    }

    /// Some fronts, cut where they are not optimal and where neighbours are far apart; their V.
    fn draw_fronts(&mut self, source: &Source<'_>, t: &StoredTrajectories, ring: &[usize], sheets: Option<&[i32]>) -> Vec<String> {
        let value = |j: usize| {
            let values = ring.iter().map(|k| t.v[k * t.samples + j]).filter(|v| v.is_finite());
            values.fold(f64::NAN, f64::max)
        };
        let spacing = source.model.shoot_out.as_ref().map_or(0.05, |s| s.spacing);
        let most = value(0);
        if !most.is_finite() {
            return Vec::new();
        }
        let mut levels = Vec::new();
        let mut before = usize::MAX;
        for f in 1..=FRONTS {
            // Even steps of the square root of V: about even in place.
            let wanted = most * (f as f64 / FRONTS as f64).powi(2);
            let nearest = (0..t.samples)
                .filter(|j| value(*j).is_finite())
                .min_by(|a, b| (value(*a) - wanted).abs().total_cmp(&(value(*b) - wanted).abs()));
            let Some(j) = nearest.filter(|j| *j != before) else { continue };
            before = j;
            let widths = source.axes.map(|k| source.model.region[k][1] - source.model.region[k][0]);
            let mut path: Path = Vec::new();
            for k in ring.iter().chain(ring.first()) {
                let s = k * t.samples + j;
                let good = t.v[s].is_finite() && sheets.is_none_or(|sheets| sheets[s] != -2);
                let at = Self::place(source, t, s);
                let near = path.last().is_some_and(|p| (0..2).all(|i| (p[i] - at[i]).abs() <= 3.0 * spacing * widths[i]));
                if (!good || !near) && !path.is_empty() {
                    self.fronts.push(std::mem::take(&mut path));
                }
                if good {
                    path.push(at);
                }
            }
            self.fronts.push(path);
            levels.push(significant(value(j), 3));
        }
        levels
    }
}

fn band_colour(band: usize) -> colours::Rgb {
    // Not up to the lightest, which is hard to see on white.
    colours::value(0.92 * (band as f64 + 0.5) / BANDS as f64)
}

impl Drawing for Phase {
    fn height(&self, width: f64) -> f64 {
        (0.64 * width).clamp(330.0, 700.0) + Legend { entries: &self.legend }.height(width)
    }

    fn draw(&self, canvas: &mut dyn Canvas, area: Rect) {
        let [x, y] = [0, 1].map(|k| Axis::linear(self.labels[k].clone(), self.ranges[k]));
        let legend = Legend { entries: &self.legend };
        legend.draw(canvas, [area.left, area.top], area.width());
        let top = area.top + legend.height(area.width());
        let axis = Axis::linear("", [self.bands.first().copied().unwrap_or(0.0), self.bands.last().copied().unwrap_or(1.0)]);
        let width = axis.range[1] - axis.range[0];
        let colour = |v: f64| band_colour((((v - axis.range[0]) / width * BANDS as f64) as usize).min(BANDS - 1));
        let bar = Bar {
            label: "V, cost from there on",
            axis: &axis,
            bands: &self.bands,
            colour: &colour,
        };
        let room = if self.bands.is_empty() { 0.0 } else { bar.width(area.bottom - top) };
        let frame = Frame::within(Rect::new(area.left, top, area.right - room, area.bottom), x, y);
        frame.under(canvas);
        canvas.lines(&frame.lines(&self.faint), Stroke::new(Ink::Muted, 0.8).opacity(0.45));
        let width = if self.bands.is_empty() { 1.1 } else { 1.3 };
        for (colour, paths) in &self.coloured {
            canvas.lines(&frame.lines(paths), Stroke::new(Ink::Colour(*colour), width).opacity(0.9));
        }
        canvas.lines(&frame.lines(&self.fronts), Stroke::new(Ink::Text, 1.3));
        canvas.lines(&frame.lines(&self.boundary.lines), Stroke::new(Ink::Paper, 5.0).opacity(0.7));
        canvas.lines(&frame.lines(&self.boundary.lines), Stroke::new(Ink::Text, 3.0));
        canvas.dots(&frame.dots(self.boundary.points.iter().copied()), 6.0, Ink::Text, 1.0);
        if let Some(rest) = self.rest {
            let dots = frame.dots([rest]);
            canvas.dots(&dots, 10.0, Ink::Paper, 1.0);
            canvas.dots(&dots, 7.0, Ink::Text, 1.0);
        }
        frame.over(canvas);
        if !self.bands.is_empty() {
            bar.draw(canvas, frame.area.right + 14.0, frame.area.top, frame.area.bottom);
        }
    }
}
