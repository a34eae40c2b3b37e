//! V over a plane as filled contours.

use super::Made;
use super::bands::fill;
use super::boundary::Boundary;
use crate::canvas::{Anchor, Canvas, Ink, Point, Rect, Stroke, Style, TEXT};
use crate::colours;
use crate::contour::{self, Grid};
use crate::frame::{Axis, Bar, Frame, Legend, Mark, range};
use crate::hatch;
use crate::plane::Plane;
use crate::ticks::significant;
use crate::{Drawing, Picture, Source, names, text};

/// The line of equal cost.
fn equal_cost() -> Stroke {
    Stroke::new(Ink::Text, 2.6)
}

struct Contours {
    plane: Plane,
    /// Ends of the bands; nothing is shown above the last.
    levels: Vec<f64>,
    /// Levels with a line.
    lines: Vec<f64>,
    /// What of V lies outside all levels.
    least: f64,
    boundary: Boundary,
    /// The equilibrium's place.
    rest: Option<[f64; 2]>,
    labels: [String; 2],
    bar: String,
}

pub fn picture(source: &Source<'_>) -> Made {
    let Some(plane) = source.plane()? else {
        return Ok(None);
    };
    let Some([least, most]) = range(plane.v.iter().copied()) else {
        return Ok(None);
    };
    let asked = source.levels(plane);
    check_levels(&asked, [least, most])?;
    // Bands that end above all that is known would only take colours from the others.
    let end = most.min(plane.limit);
    let mut levels: Vec<f64> = asked.iter().copied().filter(|l| *l < end).collect();
    let last = asked.iter().copied().find(|l| *l >= end);
    levels.extend(last.map(|l| l.min(plane.limit)));
    let drawing = Contours {
        plane: plane.clone(),
        levels,
        lines: asked.into_iter().filter(|l| *l <= end).collect(),
        least,
        boundary: Boundary::read(source)?,
        rest: source
            .infinite()
            .then(|| source.axes.map(|k| source.model.reference()[k])),
        labels: source.labels(),
        bar: "V, cost from the state on".to_owned(),
    };
    Ok(Some(Picture {
        name: "contours".to_owned(),
        title: format!("Value function V over {}{}", over(source), source.fixed()),
        caption: caption(source, plane),
        drawing: Box::new(drawing),
    }))
}

/// Refuses levels that are all beside the values of V.
fn check_levels(levels: &[f64], [least, most]: [f64; 2]) -> Result<(), String> {
    if !levels.iter().all(|l| *l < least || *l > most) {
        return Ok(());
    }
    let asked = levels
        .iter()
        .map(|l| significant(*l, 3))
        .collect::<Vec<_>>()
        .join(", ");
    Err(format!(
        "none of the levels {asked} is among the values of V there, {} to {}",
        significant(least, 3),
        significant(most, 3)
    ))
}

fn caption(source: &Source<'_>, plane: &Plane) -> String {
    let mut caption = format!(
        "Lines of equal cost{}. From each state on a line the optimal trajectory costs what the line says; it crosses the lines \
         towards the lower ones. Where lines lie close, p = dV/dx is large.",
        source.fixed()
    );
    if plane.sheets().len() > 1 {
        caption += " Lines have a kink where the cheapest solution changes from one sheet to another: the thick line.";
    }
    caption += " Blank: not known, or above the last level.";
    caption += &hatch::caption(source, plane);
    caption
}

/// `θ and ω`.
pub fn over(source: &Source<'_>) -> String {
    let [a, b] = source
        .axes
        .map(|k| names::symbol(&source.model.states[k].variable.name));
    format!("{a} and {b}")
}

impl Contours {
    /// Levels are mostly spread over decades.
    fn scale(&self) -> Axis {
        let (first, last) = (self.levels[0], self.levels[self.levels.len() - 1]);
        let ratio = (last / first).powf(1.0 / (self.levels.len().max(2) as f64 - 1.0));
        if first > 0.0 && ratio > 1.5 {
            // One band more: what is below the first level.
            Axis::log("", [first / ratio, last])
        } else {
            Axis::linear("", [self.least.min(first), last])
        }
    }

    /// The band from one level to the next has one colour.
    fn colour(&self, value: f64) -> colours::Rgb {
        self.shade(self.levels.partition_point(|l| *l <= value))
    }

    fn shade(&self, band: usize) -> colours::Rgb {
        colours::value((band as f64 / self.levels.len().max(1) as f64).min(1.0))
    }

    fn legend(&self) -> Vec<(Mark, String)> {
        let jump = "equal cost: the optimal control jumps".to_owned();
        let entry = (Mark::Line(equal_cost()), jump);
        let is_drawn = !self.boundary.is_empty();
        is_drawn.then_some(entry).into_iter().collect()
    }

    /// Bands of V, hatched where its bound is too large.
    fn fill(&self, canvas: &mut dyn Canvas, frame: &Frame) {
        // Bands meet at the boundary; only lines end there.
        let whole = Grid {
            cut: &[],
            ..self.grid()
        };
        let shade = |band| self.shade(band);
        fill(canvas, frame, &whole, &self.levels, &shade, false);
        canvas.lines(&frame.lines(&hatch::lines(&self.plane)), hatch::stroke());
    }

    /// Draws each level's lines, and gives them.
    fn level_lines(&self, canvas: &mut dyn Canvas, frame: &Frame) -> Vec<Vec<Vec<Point>>> {
        let stroke = Stroke::new(Ink::Colour([255, 255, 255]), 1.0).opacity(0.85);
        let drawn = self.lines.iter().map(|level| {
            let lines: Vec<Vec<[f64; 2]>> = contour::lines(&self.grid(), *level)
                .into_iter()
                .map(|l| l.points)
                .collect();
            let lines = frame.lines(&lines);
            canvas.lines(&lines, stroke);
            lines
        });
        drawn.collect()
    }

    /// The equal-cost boundary and the equilibrium.
    fn marks(&self, canvas: &mut dyn Canvas, frame: &Frame) {
        let boundary = frame.lines(&self.boundary.lines);
        canvas.lines(&boundary, Stroke::new(Ink::Paper, 4.6).opacity(0.7));
        canvas.lines(&boundary, equal_cost());
        let points = frame.dots(self.boundary.points.iter().copied());
        canvas.dots(&points, 5.0, equal_cost().ink, 1.0);
        if let Some(rest) = self.rest {
            let dots = frame.dots([rest]);
            canvas.dots(&dots, 9.0, Ink::Colour([255, 255, 255]), 1.0);
            canvas.dots(&dots, 6.0, Ink::Colour([20, 20, 20]), 1.0);
        }
    }

    /// Writes the levels on their lines, the highest first.
    fn label(&self, canvas: &mut dyn Canvas, frame: &Frame, lines: &[Vec<Vec<Point>>]) {
        let mut labels = Labels { taken: Vec::new() };
        if let Some([x, y]) = self.rest.and_then(|r| frame.dots([r]).first().copied()) {
            labels
                .taken
                .push(Rect::new(x - 6.0, y - 6.0, x + 6.0, y + 6.0));
        }
        for (level, lines) in self.lines.iter().zip(lines).rev() {
            labels.write(canvas, lines, &significant(*level, 3), frame.area);
        }
    }

    fn grid(&self) -> Grid<'_> {
        Grid {
            x: &self.plane.x,
            y: &self.plane.y,
            values: &self.plane.v,
            cut: &self.plane.cut,
        }
    }
}

/// A level's line with room for its label in it.
struct Labels {
    taken: Vec<Rect>,
}

impl Labels {
    /// Writes `label` on the longest of some lines, in the middle of its straightest part that is
    /// free.
    fn write(&mut self, canvas: &mut dyn Canvas, lines: &[Vec<Point>], label: &str, area: Rect) {
        let length = |l: &Vec<Point>| {
            l.windows(2)
                .map(|w| (w[1][0] - w[0][0]).hypot(w[1][1] - w[0][1]))
                .sum::<f64>()
        };
        let width = text::width(label, TEXT - 1.0);
        let Some(line) = lines.iter().max_by(|a, b| length(a).total_cmp(&length(b))) else {
            return;
        };
        if length(line) < 2.5 * width {
            return;
        }
        // Candidates along the line; the one furthest from the labels that are there.
        let dense = resampled(line, 8.0);
        let room = |p: &Point| {
            Rect::new(
                p[0] - 0.5 * width - 3.0,
                p[1] - 8.0,
                p[0] + 0.5 * width + 3.0,
                p[1] + 8.0,
            )
        };
        let inside = |r: &Rect| {
            r.left > area.left + 2.0
                && r.right < area.right - 2.0
                && r.top > area.top + 2.0
                && r.bottom < area.bottom - 2.0
        };
        let free = |r: &Rect| {
            self.taken.iter().all(|t| {
                r.right < t.left || r.left > t.right || r.bottom < t.top || r.top > t.bottom
            })
        };
        let distance = |p: &Point| {
            let to =
                |t: &Rect| (0.5 * (t.left + t.right) - p[0]).hypot(0.5 * (t.top + t.bottom) - p[1]);
            self.taken.iter().map(to).fold(1e3, f64::min)
        };
        let best = (dense.iter())
            .filter(|p| inside(&room(p)) && free(&room(p)))
            .min_by(|a, b| {
                // Near an earlier label, so that labels stand in a row, but not too near.
                let cost = |p: &Point| (distance(p) - 60.0).abs();
                cost(a).total_cmp(&cost(b))
            });
        if let Some(at) = best {
            canvas.text(
                *at,
                label,
                Style::new(Anchor::Middle).size(TEXT - 1.0).halo(),
            );
            self.taken.push(room(at));
        }
    }
}

/// A line with points at most `step` pixels apart.
fn resampled(line: &[Point], step: f64) -> Vec<Point> {
    let mut dense = Vec::new();
    for w in line.windows(2) {
        let parts = ((w[1][0] - w[0][0]).hypot(w[1][1] - w[0][1]) / step)
            .ceil()
            .max(1.0);
        for k in 0..parts as usize {
            let s = k as f64 / parts;
            dense.push([
                w[0][0] + s * (w[1][0] - w[0][0]),
                w[0][1] + s * (w[1][1] - w[0][1]),
            ]);
        }
    }
    dense
}

impl Drawing for Contours {
    fn height(&self, width: f64) -> f64 {
        (0.62 * width).clamp(320.0, 680.0)
    }

    fn draw(&self, canvas: &mut dyn Canvas, area: Rect) {
        let ends = |v: &[f64]| [v[0], v[v.len() - 1]];
        let x = Axis::linear(self.labels[0].clone(), ends(&self.plane.x));
        let y = Axis::linear(self.labels[1].clone(), ends(&self.plane.y));
        let entries = self.legend();
        let legend = Legend { entries: &entries };
        let top = area.top + legend.height(area.width());
        let axis = self.scale();
        let mut bands = vec![axis.range[0]];
        bands.extend(self.levels.iter().filter(|l| **l > axis.range[0]));
        let colour = |v: f64| self.colour(v);
        let bar = Bar {
            label: &self.bar,
            axis: &axis,
            bands: &bands,
            colour: &colour,
        };
        let room = bar.width(area.height());
        let frame = Frame::within(
            Rect::new(area.left, top, area.right - room, area.bottom),
            x,
            y,
        );
        legend.draw(canvas, [area.left, area.top], area.width());
        frame.under(canvas);
        self.fill(canvas, &frame);
        let lines = self.level_lines(canvas, &frame);
        self.marks(canvas, &frame);
        self.label(canvas, &frame, &lines);
        frame.over(canvas);
        bar.draw(
            canvas,
            frame.area.right + 14.0,
            frame.area.top,
            frame.area.bottom,
        );
    }
}
