//! A pair of axes: from numbers to places, grid, ticks, labels.

use super::canvas::{Anchor, Canvas, Dash, Ink, Point, Rect, Stroke, Style, TEXT};
use super::shape;
use super::text;
use super::ticks::{self, Tick};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scale {
    Linear,
    Log,
}

/// One axis.
#[derive(Clone, Debug)]
pub struct Axis {
    pub label: String,
    pub range: [f64; 2],
    pub scale: Scale,
}

impl Axis {
    /// A range that has no width is given some.
    pub fn linear(label: impl Into<String>, range: [f64; 2]) -> Self {
        let [mut from, mut to] = range;
        if !from.is_finite() || !to.is_finite() {
            (from, to) = (0.0, 1.0);
        }
        let least = 1e-9 * from.abs().max(to.abs()).max(1e-290);
        if to - from <= least {
            let pad = (0.1 * from.abs()).max(if from == 0.0 { 1.0 } else { 0.0 });
            (from, to) = (from - pad, to + pad);
        }
        Self {
            label: label.into(),
            range: [from, to],
            scale: Scale::Linear,
        }
    }

    /// Both ends above 0.
    pub fn log(label: impl Into<String>, range: [f64; 2]) -> Self {
        let from = if range[0] > 0.0 && range[0].is_finite() {
            range[0]
        } else {
            1e-16
        };
        let to = if range[1] > from && range[1].is_finite() {
            range[1]
        } else {
            from
        };
        let range = if to / from < 1.5 {
            [from / 1.5, to * 1.5]
        } else {
            [from, to]
        };
        Self {
            label: label.into(),
            range,
            scale: Scale::Log,
        }
    }

    /// A little more than the range on both sides.
    pub fn padded(self, share: f64) -> Self {
        let [from, to] = self.range;
        let range = match self.scale {
            Scale::Linear => [from - share * (to - from), to + share * (to - from)],
            Scale::Log => {
                let f = (to / from).powf(share);
                [from / f, to * f]
            }
        };
        Self { range, ..self }
    }

    /// 0 at the range's beginning, 1 at its end.
    fn share(&self, value: f64) -> f64 {
        let [from, to] = self.range;
        match self.scale {
            Scale::Linear => (value - from) / (to - from),
            Scale::Log if value <= 0.0 => f64::NAN,
            Scale::Log => (value / from).ln() / (to / from).ln(),
        }
    }

    /// Ticks for so many pixels, each label needing `room` of them.
    fn ticks(&self, pixels: f64, room: f64) -> Vec<Tick> {
        let most = ((pixels / room) as usize).clamp(2, 12);
        let [from, to] = self.range;
        match self.scale {
            Scale::Linear => ticks::linear(from, to, most),
            Scale::Log => ticks::logarithmic(from, to, most),
        }
    }
}

/// The range of finite numbers; `None` without any.
pub fn range(values: impl IntoIterator<Item = f64>) -> Option<[f64; 2]> {
    let finite = values.into_iter().filter(|v| v.is_finite());
    finite.fold(None, |range, v| match range {
        None => Some([v, v]),
        Some([a, b]) => Some([f64::min(a, v), f64::max(b, v)]),
    })
}

/// Room of a tick and its label beside the axis.
const TICK: f64 = 5.0;
const GAP: f64 = 4.0;
/// Pixels from one label to the next.
const ROOM_Y: f64 = 34.0;
/// Height of a line of text.
pub const LINE: f64 = 18.0;

/// Axes around a rectangle.
#[derive(Clone, Debug)]
pub struct Frame {
    pub x: Axis,
    pub y: Axis,
    /// What is inside the axes.
    pub area: Rect,
    /// Whether ticks have labels: panels beside or above each other share them.
    pub x_labels: bool,
    pub y_labels: bool,
    pub y_ticks: bool,
}

impl Frame {
    /// Axes that fill `outer`, labels and all.
    pub fn within(outer: Rect, x: Axis, y: Axis) -> Self {
        let bottom = outer.bottom - Self::below(true);
        let left = outer.left + Self::beside(&y, bottom - outer.top);
        // Half of the last label of x stands out.
        let area = Rect::new(left, outer.top + 7.0, outer.right - 14.0, bottom);
        Self::around(area, x, y)
    }

    /// Axes around `area`.
    pub fn around(area: Rect, x: Axis, y: Axis) -> Self {
        Self {
            x,
            y,
            area,
            x_labels: true,
            y_labels: true,
            y_ticks: true,
        }
    }

    /// Room beneath: ticks, their labels and the axis's.
    pub fn below(name: bool) -> f64 {
        TICK + GAP + LINE + if name { LINE } else { 0.0 }
    }

    /// Room on the left for ticks, labels and the axis's name, of an axis so high.
    pub fn beside(y: &Axis, height: f64) -> f64 {
        let widest = (y.ticks(height, ROOM_Y).iter())
            .map(|t| text::width(&t.label, TEXT))
            .fold(0.0, f64::max);
        let name = if y.label.is_empty() { 0.0 } else { LINE + GAP };
        TICK + GAP + widest + name + 2.0
    }

    /// The place of a pair of numbers.
    pub fn at(&self, [x, y]: [f64; 2]) -> Point {
        [
            self.area.left + self.x.share(x) * self.area.width(),
            self.area.bottom - self.y.share(y) * self.area.height(),
        ]
    }

    /// The visible parts of a line.
    pub fn line(&self, line: &[[f64; 2]]) -> Vec<Vec<Point>> {
        let placed: Vec<Point> = line.iter().map(|p| self.at(*p)).collect();
        shape::clipped(&placed, self.area)
    }

    /// The visible parts of lines.
    pub fn lines<'a>(&self, lines: impl IntoIterator<Item = &'a Vec<[f64; 2]>>) -> Vec<Vec<Point>> {
        lines.into_iter().flat_map(|l| self.line(l)).collect()
    }

    /// The visible part of a polygon.
    pub fn ring(&self, ring: &[[f64; 2]]) -> Vec<Point> {
        let placed: Vec<Point> = ring.iter().map(|p| self.at(*p)).collect();
        let mut cut = shape::clipped_ring(&placed, self.area);
        if let Some(first) = cut.first().copied() {
            cut.push(first);
            cut = shape::thinned(&cut);
            cut.pop();
        }
        cut
    }

    /// The visible ones of some points.
    pub fn dots(&self, points: impl IntoIterator<Item = [f64; 2]>) -> Vec<Point> {
        let placed = points.into_iter().map(|p| self.at(p));
        placed.filter(|p| self.area.contains(*p)).collect()
    }

    fn ticks_x(&self) -> Vec<Tick> {
        // Labels grow with their number of digits: what is widest decides.
        let width = self.area.width();
        let widest = |ticks: &[Tick]| {
            ticks
                .iter()
                .map(|t| text::width(&t.label, TEXT))
                .fold(0.0, f64::max)
        };
        let room = widest(&self.x.ticks(width, 70.0)) + 26.0;
        self.x.ticks(width, room.max(44.0))
    }

    /// What lies beneath the data.
    pub fn under(&self, canvas: &mut dyn Canvas) {
        let stroke = Stroke::new(Ink::Grid, 1.0);
        let mut lines = Vec::new();
        for tick in self.ticks_x().iter().filter(|t| !t.label.is_empty()) {
            let x = self.at([tick.value, self.y.range[0]])[0];
            lines.push(vec![[x, self.area.top], [x, self.area.bottom]]);
        }
        for tick in self
            .y
            .ticks(self.area.height(), ROOM_Y)
            .iter()
            .filter(|t| !t.label.is_empty())
        {
            let y = self.at([self.x.range[0], tick.value])[1];
            lines.push(vec![[self.area.left, y], [self.area.right, y]]);
        }
        canvas.lines(&lines, stroke);
    }

    /// The axes themselves, above the data.
    pub fn over(&self, canvas: &mut dyn Canvas) {
        let a = self.area;
        let mut lines = vec![[a.corners().to_vec(), vec![a.corners()[0]]].concat()];
        let style = Style::new(Anchor::Middle);
        for tick in self.ticks_x() {
            let x = self.at([tick.value, self.y.range[0]])[0];
            let length = if tick.label.is_empty() {
                0.5 * TICK
            } else {
                TICK
            };
            lines.push(vec![[x, a.bottom], [x, a.bottom + length]]);
            if self.x_labels {
                canvas.text([x, a.bottom + TICK + GAP + 0.5 * TEXT], &tick.label, style);
            }
        }
        let ticks = if self.y_ticks {
            self.y.ticks(a.height(), ROOM_Y)
        } else {
            Vec::new()
        };
        let mut widest = 0.0f64;
        for tick in &ticks {
            let y = self.at([self.x.range[0], tick.value])[1];
            let length = if tick.label.is_empty() {
                0.5 * TICK
            } else {
                TICK
            };
            lines.push(vec![[a.left - length, y], [a.left, y]]);
            widest = widest.max(text::width(&tick.label, TEXT));
            if self.y_labels {
                canvas.text(
                    [a.left - TICK - GAP, y],
                    &tick.label,
                    Style::new(Anchor::End),
                );
            }
        }
        canvas.lines(&lines, Stroke::new(Ink::Muted, 1.0));
        if self.x_labels && !self.x.label.is_empty() {
            let label = text::shortened(&self.x.label, TEXT, a.width() + 60.0);
            canvas.text(
                [
                    0.5 * (a.left + a.right),
                    a.bottom + TICK + GAP + LINE + 0.5 * LINE,
                ],
                &label,
                style,
            );
        }
        if self.y_labels && !self.y.label.is_empty() {
            let x = a.left - TICK - 2.0 * GAP - widest - 0.5 * LINE;
            let label = text::shortened(&self.y.label, TEXT, a.height() + 12.0);
            canvas.text([x, 0.5 * (a.top + a.bottom)], &label, style.upward());
        }
    }
}

/// How an entry of a legend looks.
#[derive(Clone, Copy, Debug)]
pub enum Mark {
    Line(Stroke),
    Dot(Ink),
}

/// Rows of a legend, above the axes where it hides nothing.
pub struct Legend<'a> {
    pub entries: &'a [(Mark, String)],
}

const MARK: f64 = 26.0;
const BETWEEN: f64 = 18.0;

impl Legend<'_> {
    /// Entries by row, with their left ends.
    fn rows(&self, width: f64) -> Vec<Vec<(f64, usize)>> {
        let mut rows: Vec<Vec<(f64, usize)>> = Vec::new();
        let mut left = f64::INFINITY;
        for (k, (_, label)) in self.entries.iter().enumerate() {
            let needed = MARK + GAP + 2.0 + text::width(label, TEXT);
            if left + needed > width {
                rows.push(Vec::new());
                left = 0.0;
            }
            if let Some(row) = rows.last_mut() {
                row.push((left, k));
            }
            left += needed + BETWEEN;
        }
        rows
    }

    /// Height in a picture so wide.
    pub fn height(&self, width: f64) -> f64 {
        LINE * self.rows(width).len() as f64 + if self.entries.is_empty() { 0.0 } else { 6.0 }
    }

    /// Draws it from the upper left corner `at` on.
    pub fn draw(&self, canvas: &mut dyn Canvas, at: Point, width: f64) {
        for (row, entries) in self.rows(width).iter().enumerate() {
            let y = at[1] + LINE * (row as f64 + 0.5);
            for (left, k) in entries {
                let (mark, label) = &self.entries[*k];
                let x = at[0] + left;
                match *mark {
                    Mark::Line(stroke) => canvas.line([x, y], [x + MARK, y], stroke),
                    Mark::Dot(ink) => canvas.dots(&[[x + 0.5 * MARK, y]], 8.0, ink, 1.0),
                }
                let label = text::shortened(label, TEXT, width - MARK - GAP);
                canvas.text([x + MARK + GAP + 2.0, y], &label, Style::new(Anchor::Start));
            }
        }
    }
}

/// A bar of colours with its own axis, upright, beside a picture.
pub struct Bar<'a> {
    pub label: &'a str,
    pub axis: &'a Axis,
    /// Bounds of the bands, ascending; empty: shades.
    pub bands: &'a [f64],
    /// The colour of a value.
    pub colour: &'a dyn Fn(f64) -> super::colours::Rgb,
}

impl Bar<'_> {
    pub fn width(&self, height: f64) -> f64 {
        let widest = (self.axis.ticks(height, ROOM_Y).iter())
            .map(|t| text::width(&t.label, TEXT))
            .fold(0.0, f64::max);
        14.0 + TICK + GAP + widest + LINE + GAP
    }

    /// Draws it with its left edge at `left`, from `top` to `bottom`.
    pub fn draw(&self, canvas: &mut dyn Canvas, left: f64, top: f64, bottom: f64) {
        let (right, height) = (left + 14.0, bottom - top);
        let y = |v: f64| bottom - self.axis.share(v) * height;
        let shades: Vec<f64> = if self.bands.is_empty() {
            (0..=64)
                .map(|k| {
                    let [a, b] = self.axis.range;
                    let s = f64::from(k) / 64.0;
                    match self.axis.scale {
                        Scale::Linear => a + s * (b - a),
                        Scale::Log => a * (b / a).powf(s),
                    }
                })
                .collect()
        } else {
            self.bands.to_vec()
        };
        for pair in shades.windows(2) {
            let middle = match self.axis.scale {
                Scale::Linear => 0.5 * (pair[0] + pair[1]),
                Scale::Log => (pair[0] * pair[1]).sqrt(),
            };
            let above = (y(pair[1]) - 0.3).max(top);
            canvas.rectangle(
                Rect::new(left, above, right, y(pair[0]).min(bottom)),
                Ink::Colour((self.colour)(middle)),
                1.0,
            );
        }
        let mut lines = vec![
            [
                Rect::new(left, top, right, bottom).corners().to_vec(),
                vec![[left, top]],
            ]
            .concat(),
        ];
        let ticks = self.axis.ticks(height, ROOM_Y);
        let mut widest = 0.0f64;
        for tick in &ticks {
            let at = y(tick.value);
            lines.push(vec![
                [right, at],
                [right + if tick.label.is_empty() { 2.5 } else { TICK }, at],
            ]);
            widest = widest.max(text::width(&tick.label, TEXT));
            canvas.text(
                [right + TICK + GAP, at],
                &tick.label,
                Style::new(Anchor::Start),
            );
        }
        canvas.lines(&lines, Stroke::new(Ink::Muted, 1.0));
        let x = right + TICK + 2.0 * GAP + widest + 0.5 * LINE;
        let label = text::shortened(self.label, TEXT, height + 30.0);
        canvas.text(
            [x, 0.5 * (top + bottom)],
            &label,
            Style::new(Anchor::Middle).upward(),
        );
    }
}

/// A thin dashed line, as for bounds.
pub fn dashed(ink: Ink) -> Stroke {
    Stroke::new(ink, 1.2).dash(Dash::Dashed)
}
