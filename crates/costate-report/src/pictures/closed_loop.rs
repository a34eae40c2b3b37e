//! Maps of what closed loops do over the grid of initial states: a picture a recorded quantity, a
//! panel a law.

use super::bands::fill;
use super::panels::{Curve, Panel, Panels};
use crate::canvas::{Anchor, Canvas, Dash, Ink, Point, Rect, Stroke, Style};
use crate::colours;
use crate::contour::{self, Grid};
use crate::frame::{Axis, Bar, Frame, LINE, Legend, Mark};
use crate::ticks;
use crate::{Drawing, Picture, Source, names, text};
use costate::low_level::result::{StoredError, StoredGroup};
use costate::low_level::schema;

/// A panel's inside is no narrower.
const NARROWEST: f64 = 230.0;
/// The last label of an axis and the first of the next stand between panels.
const BETWEEN: f64 = 34.0;
/// Bands of a map.
const BANDS: usize = 10;
/// J/V - 1 below this is drawn as this: it is what the error of V and of the integration leave.
const LEAST_LOSS: f64 = 1e-6;

/// The variable that holds J/V - 1.
const LOSS: &str = "suboptimality";
/// The one that counts updates at which the map's law had no answer.
const FALLBACK: &str = "fallback";

/// What all maps have in common.
struct Loops {
    laws: Vec<String>,
    count: usize,
    /// `[initial][state]`.
    x0: Vec<f64>,
    converged: Vec<i32>,
}

/// Initial states on a grid of two states, others fixed.
struct Place {
    axes: [usize; 2],
    x: Vec<f64>,
    y: Vec<f64>,
    /// Number of the initial state of each node.
    nodes: Vec<usize>,
    base: Vec<f64>,
}

impl Place {
    /// The states that are held fixed, in words.
    fn fixed(&self, source: &Source<'_>) -> String {
        let fixed = names::held(&source.model.states, &self.axes, |k| self.base[k]);
        names::at(&fixed)
    }
}

/// What closed loops recorded.
struct Quantity {
    name: String,
    title: String,
    /// What an axis says.
    label: String,
    /// `[law][initial]`.
    values: Vec<f64>,
}

impl Quantity {
    fn new(group: &StoredGroup<'_>, name: &str, values: Vec<f64>) -> Self {
        let what = group
            .attribute(Some(name), "long_name")
            .filter(|l| l != name);
        let (title, label) = match what {
            _ if name == LOSS => (
                "Loss against the optimum, J/V \u{2212} 1".to_owned(),
                "J/V \u{2212} 1".to_owned(),
            ),
            Some(what) => (format!("{}: {what}", name.replace('_', " ")), what),
            None => (name.replace('_', " "), name.to_owned()),
        };
        Self {
            name: name.to_owned(),
            title,
            label,
            values,
        }
    }

    fn is_loss(&self) -> bool {
        self.name == LOSS
    }

    fn is_unknown(&self) -> bool {
        self.values.iter().all(|v| !v.is_finite())
    }

    fn is_zero(&self) -> bool {
        self.values.iter().all(|v| !v.is_finite() || *v == 0.0)
    }

    /// Of the loss: what is too small to mean anything.
    fn cut_off(&mut self) {
        for v in self.values.iter_mut().filter(|v| v.is_finite()) {
            *v = v.max(LEAST_LOSS);
        }
    }
}

#[derive(Clone)]
struct OneLaw {
    name: String,
    values: Vec<f64>,
    /// 1 where the closed loop converges, 0 where it does not.
    converged: Vec<f64>,
    /// Boundaries of operating sets: set and polylines.
    sets: Vec<(usize, Vec<Vec<[f64; 2]>>)>,
}

struct Map {
    x: Vec<f64>,
    y: Vec<f64>,
    labels: [String; 2],
    laws: Vec<OneLaw>,
    levels: Vec<f64>,
    log: bool,
    bar: String,
    sets: Vec<String>,
}

fn wrong(e: StoredError) -> String {
    e.to_string()
}

/// All maps; the reasons for those that cannot be drawn.
pub fn pictures(source: &Source<'_>) -> (Vec<Picture>, Vec<(String, String)>) {
    let (mut made, mut missing) = (Vec::new(), Vec::new());
    let Some(group) = source.stored.group(&schema::CLOSED_LOOP) else {
        return (made, missing);
    };
    match Loops::read(source, &group) {
        Err(reason) => missing.push(("closed_loop".to_owned(), reason)),
        Ok(loops) => {
            for name in quantities(&group) {
                match loops.picture(source, &group, &name) {
                    Ok(picture) => made.extend(picture),
                    Err(reason) => missing.push((format!("closed_loop_{name}"), reason)),
                }
            }
        }
    }
    (made, missing)
}

/// Recorded quantities in the file's order, where the map's law had no answer, and the loss against
/// the optimum.
fn quantities(group: &StoredGroup<'_>) -> Vec<String> {
    let drawn = |name: &String| name == FALLBACK || !schema::CLOSED_LOOP.reserves(name);
    let mut all: Vec<String> = group.names().into_iter().filter(drawn).collect();
    if group.has(LOSS) {
        all.push(LOSS.to_owned());
    }
    all
}

impl Loops {
    fn read(source: &Source<'_>, group: &StoredGroup<'_>) -> Result<Self, String> {
        let n = source.model.states.len();
        let laws = group.texts("law").map_err(wrong)?;
        let x0 = group.f64("x0").map_err(wrong)?;
        if x0.shape.len() != 2 || x0.shape[1] != n {
            return Err("/closed_loop/x0 is not initial x state".to_owned());
        }
        let converged = group.i32("converged").map_err(wrong)?.1;
        if converged.len() != laws.len() * x0.shape[0] {
            return Err("/closed_loop/converged is not law x initial".to_owned());
        }
        Ok(Self {
            laws,
            count: x0.shape[0],
            x0: x0.values,
            converged,
        })
    }

    fn picture(
        &self,
        source: &Source<'_>,
        group: &StoredGroup<'_>,
        name: &str,
    ) -> Result<Option<Picture>, String> {
        let values = group.f64(name).map_err(wrong)?;
        if values.shape != [self.laws.len(), self.count] {
            // Something else than a quantity of each law and initial state.
            return Ok(None);
        }
        let mut quantity = Quantity::new(group, name, values.values);
        if quantity.is_loss() {
            quantity.cut_off();
            // V is not known at the initial states.
            if quantity.is_unknown() {
                return Ok(None);
            }
        }
        if quantity.is_unknown() {
            return Err("it has no values".to_owned());
        }
        // The map's law had an answer everywhere.
        if name == FALLBACK && quantity.is_zero() {
            return Ok(None);
        }
        match self.place(source, group) {
            Some(place) => self.map(source, place, quantity).map(Some),
            None => Ok(Some(self.curves(source, group, quantity))),
        }
    }

    /// The grid of two states, where there is one.
    fn place(&self, source: &Source<'_>, group: &StoredGroup<'_>) -> Option<Place> {
        let n = source.model.states.len();
        let index = |name: &str| {
            source
                .model
                .states
                .iter()
                .position(|s| s.variable.name == name)
        };
        let axes: Vec<usize> = group
            .attribute(None, "axes")?
            .split_whitespace()
            .filter_map(index)
            .collect();
        if axes.len() < 2 {
            return None;
        }
        // The report's own axes where they are among these.
        let own = source.axes.iter().all(|k| axes.contains(k));
        let axes = if own { source.axes } else { [axes[0], axes[1]] };
        let values = |k: usize| {
            let mut all: Vec<f64> = self.x0.iter().skip(k).step_by(n).copied().collect();
            all.sort_by(f64::total_cmp);
            all.dedup();
            all
        };
        let base: Vec<f64> = (0..n)
            .map(|k| {
                let all = values(k);
                let near = all.iter().copied().min_by(|a, b| {
                    (a - source.base[k])
                        .abs()
                        .total_cmp(&(b - source.base[k]).abs())
                });
                near.unwrap_or(source.base[k])
            })
            .collect();
        let (x, y) = (values(axes[0]), values(axes[1]));
        let mut nodes = vec![usize::MAX; x.len() * y.len()];
        for (k, at) in self.x0.chunks(n).enumerate() {
            if (0..n).all(|i| axes.contains(&i) || at[i] == base[i]) {
                let i = x.binary_search_by(|v| v.total_cmp(&at[axes[0]])).ok()?;
                let j = y.binary_search_by(|v| v.total_cmp(&at[axes[1]])).ok()?;
                nodes[i * y.len() + j] = k;
            }
        }
        (!nodes.contains(&usize::MAX)).then_some(Place {
            axes,
            x,
            y,
            nodes,
            base,
        })
    }

    fn map(
        &self,
        source: &Source<'_>,
        place: Place,
        quantity: Quantity,
    ) -> Result<Picture, String> {
        let loss = quantity.is_loss();
        let (sets, lines) = operating(source, &place)?;
        let laws: Vec<OneLaw> = (0..self.laws.len())
            .map(|k| self.law(k, &place, &quantity.values, &lines))
            .collect();
        let shown: Vec<f64> = laws.iter().flat_map(|l| l.values.iter().copied()).collect();
        let levels = if loss { decades(&shown) } else { even(&shown) };
        let at = place.fixed(source);
        let pale = laws.iter().any(|l| l.converged.contains(&0.0));
        let mut caption = format!(
            "Each point is an initial state{at}; its colour is what the closed loop from there recorded, one panel a law, one scale for all."
        );
        if loss {
            caption += " 10\u{207b}\u{b2} is one per cent more cost than the optimum; at the equilibrium itself there is no ratio, and the cells next to it are empty.";
            if !source.model.disturbances.is_empty() {
                caption += " Nothing disturbs these loops: against the worst disturbance, of which V is the value, they cost more.";
            }
        }
        if pale {
            caption += " Pale, within the dashed line: the closed loop does not converge.";
        }
        if !sets.is_empty() {
            caption += " Thick lines bound the operating sets.";
        }
        Ok(Picture {
            name: format!("closed_loop_{}", quantity.name),
            title: format!("{}{at}", quantity.title),
            caption,
            drawing: Box::new(Map {
                labels: place
                    .axes
                    .map(|k| names::label(&source.model.states[k].variable)),
                x: place.x,
                y: place.y,
                laws,
                levels,
                log: loss,
                bar: quantity.label,
                sets,
            }),
        })
    }

    /// A law's panel on the grid.
    fn law(&self, k: usize, place: &Place, values: &[f64], lines: &Boundaries) -> OneLaw {
        let own = k * self.count;
        OneLaw {
            name: self.laws[k].clone(),
            values: place.nodes.iter().map(|i| values[own + i]).collect(),
            converged: (place.nodes.iter())
                .map(|i| f64::from(self.converged[own + i]))
                .collect(),
            sets: lines
                .iter()
                .filter(|(l, ..)| *l == k)
                .map(|(_, s, l)| (*s, l.clone()))
                .collect(),
        }
    }

    /// Where there is no grid of two states: along one, or how values are distributed.
    fn curves(&self, source: &Source<'_>, group: &StoredGroup<'_>, quantity: Quantity) -> Picture {
        let axis = group.attribute(None, "axes").and_then(|a| {
            let name = a.split_whitespace().next()?.to_owned();
            source
                .model
                .states
                .iter()
                .position(|s| s.variable.name == name)
        });
        let log = axis.is_none() && quantity.is_loss();
        let curves = (0..self.laws.len()).map(|k| {
            let own = &quantity.values[k * self.count..(k + 1) * self.count];
            Curve {
                points: match axis {
                    Some(a) => self.along(a, own, source.model.states.len()),
                    None => distribution(own),
                },
                stroke: Stroke::new(Ink::Colour(colours::class(k)), 2.0),
            }
        });
        let mut panel = Panel {
            curves: curves.collect(),
            ..Panel::default()
        };
        let legend = self.laws.iter().enumerate().map(|(k, name)| {
            let mark = Mark::Line(Stroke::new(Ink::Colour(colours::class(k)), 2.5));
            (mark, name.clone())
        });
        let (x_label, caption) = match axis {
            Some(a) => {
                panel.label = quantity.label;
                (
                    names::label(&source.model.states[a].variable),
                    "What the closed loop from each initial state recorded.",
                )
            }
            None => {
                panel.label = "share of initial states".to_owned();
                panel.range = Some([0.0, 1.0]);
                (
                    quantity.label,
                    "The share of the random initial states from which the closed loop recorded at most so much.",
                )
            }
        };
        Picture {
            name: format!("closed_loop_{}", quantity.name),
            title: quantity.title,
            caption: caption.to_owned(),
            drawing: Box::new(Panels {
                x_label,
                panels: vec![panel],
                legend: legend.collect(),
                marks: Vec::new(),
                columns: 1,
                tall: 2.0,
                log,
            }),
        }
    }

    /// A law's values over the `axis`-th of `n` states.
    fn along(&self, axis: usize, values: &[f64], n: usize) -> Vec<[f64; 2]> {
        let mut points: Vec<[f64; 2]> = values
            .iter()
            .enumerate()
            .map(|(i, v)| [self.x0[i * n + axis], *v])
            .collect();
        points.sort_by(|a, b| a[0].total_cmp(&b[0]));
        points
    }
}

/// The share of values that are at most each of them.
fn distribution(values: &[f64]) -> Vec<[f64; 2]> {
    let mut sorted: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().max(2) as f64 - 1.0;
    sorted
        .iter()
        .enumerate()
        .map(|(i, v)| [*v, i as f64 / last])
        .collect()
}

/// Operating sets by name with their conditions, and their boundaries: law, set, polylines on the
/// grid's plane.
type Boundaries = Vec<(usize, usize, Vec<Vec<[f64; 2]>>)>;

fn operating(source: &Source<'_>, place: &Place) -> Result<(Vec<String>, Boundaries), String> {
    let (Some(sets), Some(lines)) = (
        source.stored.group(&schema::OPERATING_SETS),
        source.stored.group(&schema::OPERATING_CONTOURS),
    ) else {
        return Ok((Vec::new(), Vec::new()));
    };
    let names = sets.texts("set").map_err(wrong)?;
    let conditions = sets.texts("condition").unwrap_or_default();
    let named = names
        .iter()
        .enumerate()
        .map(|(k, name)| match conditions.get(k) {
            Some(c) => format!("{name}: {c}"),
            None => name.clone(),
        });
    let x = lines.f64("x").map_err(wrong)?;
    if x.shape.len() != 2 || x.shape[1] != 2 {
        return Err("/operating_contours/x is not vertex x 2".to_owned());
    }
    let axes = lines.texts("axis").unwrap_or_default();
    let name = |k: usize| source.model.states[place.axes[k]].variable.name.as_str();
    // The other way round where the report's axes are.
    let turned = axes.first().is_some_and(|a| a == name(1));
    let column = |name: &str| lines.i32(name).map(|c| c.1).map_err(wrong);
    let (law, set, line) = (column("law")?, column("set")?, column("line")?);
    let mut found: Boundaries = Vec::new();
    let mut before = None;
    for (k, at) in x.values.chunks(2).enumerate() {
        let key = (law[k], set[k], line[k]);
        let (l, s) = (law[k].max(0) as usize, set[k].max(0) as usize);
        let at = if turned {
            [at[1], at[0]]
        } else {
            [at[0], at[1]]
        };
        if !found.iter().any(|(a, b, _)| (*a, *b) == (l, s)) {
            found.push((l, s, Vec::new()));
        }
        let Some((.., lines)) = found.iter_mut().find(|(a, b, _)| (*a, *b) == (l, s)) else {
            continue;
        };
        if before != Some(key) {
            lines.push(Vec::new());
        }
        if let Some(open) = lines.last_mut() {
            open.push(at);
        }
        before = Some(key);
    }
    Ok((named.collect(), found))
}

/// Even levels that few values lie outside of.
fn even(values: &[f64]) -> Vec<f64> {
    let mut sorted: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let at = |q: f64| sorted[((sorted.len() - 1) as f64 * q).round() as usize];
    let (mut from, mut to) = (at(0.0), at(1.0));
    let (low, high) = (at(0.02), at(0.98));
    // A few values far away would leave one band for all others.
    if to - from > 4.0 * (high - low) && high > low {
        (from, to) = (low, high);
    }
    if to <= from {
        return vec![
            from - 0.5 * from.abs().max(1e-3),
            from + 0.5 * from.abs().max(1e-3),
        ];
    }
    let step = ticks::step(to - from, BANDS);
    let (first, last) = ((from / step).floor() as i64, (to / step).ceil() as i64);
    (first..=last).map(|k| k as f64 * step).collect()
}

/// Powers of ten and three times these.
fn decades(values: &[f64]) -> Vec<f64> {
    let most = values
        .iter()
        .copied()
        .filter(|v| v.is_finite())
        .fold(LEAST_LOSS * 10.0, f64::max)
        .min(1e3);
    let last = (most.log10() * 2.0).ceil() as i32;
    let first = ((LEAST_LOSS.log10() * 2.0).round() as i32).max(last - 12);
    let level = |k: i32| {
        if k % 2 == 0 {
            10f64.powi(k / 2)
        } else {
            3.0 * 10f64.powi((k - 1).div_euclid(2))
        }
    };
    (first..=last).map(level).collect()
}

impl Map {
    fn columns(&self, width: f64) -> usize {
        let fit = (((width - 130.0) / (NARROWEST + BETWEEN)) as usize).max(1);
        let rows = self.laws.len().div_ceil(fit);
        // Rows of even length.
        self.laws.len().div_ceil(rows)
    }

    fn legend(&self) -> Vec<(Mark, String)> {
        let mut entries: Vec<(Mark, String)> = (self.sets.iter().enumerate())
            .map(|(k, name)| (Mark::Line(set_stroke(k)), name.clone()))
            .collect();
        if self.laws.iter().any(|l| l.converged.contains(&0.0)) {
            let dashed = Stroke::new(Ink::Text, 1.2).dash(Dash::Dashed);
            entries.push((Mark::Line(dashed), "does not converge (pale)".to_owned()));
        }
        entries
    }

    fn shade(&self, band: usize) -> colours::Rgb {
        // Band 0 lies below the first level, which few values do.
        colours::value((band as f64 - 0.5).max(0.0) / (self.levels.len() as f64 - 1.0).max(1.0))
    }

    fn panel(&self, canvas: &mut dyn Canvas, frame: &Frame, law: &OneLaw) {
        let grid = |values| Grid {
            x: &self.x,
            y: &self.y,
            values,
            cut: &[],
        };
        frame.under(canvas);
        fill(
            canvas,
            frame,
            &grid(&law.values),
            &self.levels,
            &|k| self.shade(k),
            true,
        );
        let bad: Vec<f64> = law.converged.iter().map(|c| 1.0 - c).collect();
        if bad.contains(&1.0) {
            let rings: Vec<Vec<Point>> = contour::region(&grid(&bad), 0.5)
                .iter()
                .map(|r| frame.ring(r))
                .collect();
            canvas.area(&rings, Ink::Paper, 0.6);
            let edges: Vec<Vec<[f64; 2]>> = contour::lines(&grid(&bad), 0.5)
                .into_iter()
                .map(|l| l.points)
                .collect();
            canvas.lines(
                &frame.lines(&edges),
                Stroke::new(Ink::Text, 1.2).dash(Dash::Dashed),
            );
        }
        for (set, lines) in &law.sets {
            let lines = frame.lines(lines);
            canvas.lines(&lines, Stroke::new(Ink::Paper, 4.5).opacity(0.8));
            canvas.lines(&lines, set_stroke(*set));
        }
        frame.over(canvas);
        let a = frame.area;
        let name = text::shortened(&law.name, 13.0, a.width());
        canvas.text(
            [0.5 * (a.left + a.right), a.top - 0.5 * LINE],
            &name,
            Style::new(Anchor::Middle),
        );
    }
}

fn set_stroke(set: usize) -> Stroke {
    const INKS: [Ink; 3] = [
        Ink::Text,
        Ink::Colour([213, 94, 0]),
        Ink::Colour([204, 121, 167]),
    ];
    Stroke::new(INKS[set % INKS.len()], 2.2)
}

impl Drawing for Map {
    fn height(&self, width: f64) -> f64 {
        let columns = self.columns(width);
        let rows = self.laws.len().div_ceil(columns) as f64;
        let inside = (width - 150.0 - BETWEEN * (columns as f64 - 1.0)) / columns as f64;
        let high = (0.85 * inside).clamp(190.0, 420.0);
        let legend = self.legend();
        Legend { entries: &legend }.height(width)
            + rows * (high + LINE + BETWEEN)
            + Frame::below(true)
    }

    fn draw(&self, canvas: &mut dyn Canvas, area: Rect) {
        let entries = self.legend();
        let legend = Legend { entries: &entries };
        legend.draw(canvas, [area.left, area.top], area.width());
        let top = area.top + legend.height(area.width());
        let columns = self.columns(area.width());
        let rows = self.laws.len().div_ceil(columns);
        let ends = |v: &[f64]| [v[0], v[v.len() - 1]];
        let x = Axis::linear(self.labels[0].clone(), ends(&self.x));
        let y = Axis::linear(self.labels[1].clone(), ends(&self.y));
        let bounds = ends(&self.levels);
        let axis = if self.log {
            Axis::log("", bounds)
        } else {
            Axis::linear("", bounds)
        };
        let colour = |v: f64| self.shade(self.levels.partition_point(|l| *l <= v));
        let bar = Bar {
            label: &self.bar,
            axis: &axis,
            bands: &self.levels,
            colour: &colour,
        };
        let bottom = area.bottom - Frame::below(true);
        let high = (bottom - top) / rows as f64 - LINE - BETWEEN;
        let left = area.left + Frame::beside(&y, high);
        let right = area.right - bar.width(bottom - top) - 18.0;
        let wide = (right - left - BETWEEN * (columns as f64 - 1.0)) / columns as f64;
        for (k, law) in self.laws.iter().enumerate() {
            let (row, column) = (k / columns, k % columns);
            let corner = [
                left + column as f64 * (wide + BETWEEN),
                top + LINE + row as f64 * (high + LINE + BETWEEN),
            ];
            let inside = Rect::new(corner[0], corner[1], corner[0] + wide, corner[1] + high);
            let mut frame = Frame::around(inside, x.clone(), y.clone());
            frame.y_labels = column == 0;
            frame.x_labels = k + columns >= self.laws.len();
            self.panel(canvas, &frame, law);
        }
        let last = top + rows as f64 * (high + LINE + BETWEEN) - BETWEEN;
        bar.draw(canvas, right + 18.0, top + LINE, last);
    }
}
