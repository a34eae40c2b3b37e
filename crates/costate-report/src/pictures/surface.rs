//! V over a plane as a surface, seen from above at a slant.

use super::Made;
use crate::canvas::{Anchor, Canvas, Ink, Point, Rect, Stroke, Style, TEXT};
use crate::colours;
use crate::frame::{LINE, range};
use crate::hatch;
use crate::plane::Plane;
use crate::{Drawing, Picture, Source, text, ticks};

/// Cells along each axis, at most: what can be told apart, and a small file.
const CELLS: usize = 40;
/// The direction of sight: turned about the vertical, and raised above the horizontal.
const TURN: f64 = -0.93;
const RAISE: f64 = 0.52;
/// Height of the box; its base is 1 x 1.
const HIGH: f64 = 0.62;

struct Surface {
    plane: Plane,
    most: f64,
    least: f64,
    labels: [String; 2],
}

pub fn picture(source: &Source<'_>) -> Made {
    let Some(plane) = source.plane()? else {
        return Ok(None);
    };
    let Some([least, most]) = range(plane.v.iter().copied()) else {
        return Ok(None);
    };
    let top = source
        .levels(plane)
        .last()
        .copied()
        .unwrap_or(most)
        .min(most)
        .min(plane.limit);
    let thin = thinned(plane);
    let drawing = Surface {
        least: if source.infinite() {
            least.min(0.0)
        } else {
            least
        },
        most: if top > least { top } else { most },
        plane: thin,
        labels: source.labels(),
    };
    Ok(Some(Picture {
        name: "surface".to_owned(),
        title: format!("Value function V as a surface{}", source.fixed()),
        caption: format!(
            "Height and colour are V over {}{}. Its slope is p = dV/dx. {}Missing: not known, or above {}.{}",
            super::contours::over(source),
            source.fixed(),
            if plane.sheets().len() > 1 {
                "Where two sheets meet there is a crease, which is left open. "
            } else {
                ""
            },
            ticks::significant(drawing.most, 3),
            hatch::caption(source, plane)
        ),
        drawing: Box::new(drawing),
    }))
}

/// Every so many-th point along each axis, ends included.
fn thinned(plane: &Plane) -> Plane {
    let keep = |count: usize| -> Vec<usize> {
        let cells = (count - 1).min(CELLS);
        (0..=cells).map(|k| k * (count - 1) / cells).collect()
    };
    let (rows, columns) = (keep(plane.x.len()), keep(plane.y.len()));
    let ny = plane.y.len();
    let pick = |i: &usize, j: &usize| i * ny + j;
    let all: Vec<usize> = rows
        .iter()
        .flat_map(|i| columns.iter().map(move |j| pick(i, j)))
        .collect();
    Plane {
        axes: plane.axes,
        x: rows.iter().map(|i| plane.x[*i]).collect(),
        y: columns.iter().map(|j| plane.y[*j]).collect(),
        v: all.iter().map(|k| plane.v[*k]).collect(),
        u: Vec::new(),
        sheet: all.iter().map(|k| plane.sheet[*k]).collect(),
        cut: Vec::new(),
        base: plane.base.clone(),
        limit: plane.limit,
        excess: match plane.excess.is_empty() {
            true => Vec::new(),
            false => all.iter().map(|k| plane.excess[*k]).collect(),
        },
    }
}

/// The box's base.
const BASE: [[f64; 3]; 4] = [
    [0.0, 0.0, 0.0],
    [1.0, 0.0, 0.0],
    [1.0, 1.0, 0.0],
    [0.0, 1.0, 0.0],
];

/// The corner of the base that is furthest left: the upright axis stands there.
fn corner() -> [f64; 3] {
    BASE.into_iter()
        .min_by(|a, b| seen(*a)[0].total_cmp(&seen(*b)[0]))
        .unwrap_or_default()
}

/// The part of a polygon with heights of at most `most`.
fn below(ring: &[[f64; 3]], most: f64) -> Vec<[f64; 3]> {
    let mut cut = Vec::with_capacity(ring.len() + 1);
    for k in 0..ring.len() {
        let (a, b) = (ring[k], ring[(k + 1) % ring.len()]);
        if a[2] <= most {
            cut.push(a);
        }
        if (a[2] <= most) != (b[2] <= most) {
            let s = (most - a[2]) / (b[2] - a[2]);
            cut.push([0, 1, 2].map(|i| a[i] + s * (b[i] - a[i])));
        }
    }
    cut
}

/// From the unit box to the picture.
struct View {
    scale: f64,
    middle: Point,
    /// What of the unrotated picture is at `middle`.
    centre: Point,
}

/// Right and up on the plane of sight, and the distance towards the eye.
fn seen([x, y, z]: [f64; 3]) -> [f64; 3] {
    let (s, c) = TURN.sin_cos();
    let (x, y) = (x - 0.5, y - 0.5);
    let (right, away) = (c * x - s * y, s * x + c * y);
    let (sr, cr) = RAISE.sin_cos();
    [right, z * cr + away * sr, -away * cr + z * sr]
}

impl View {
    /// A view of which `drawn` fills `area`.
    fn new(area: Rect, drawn: impl Iterator<Item = [f64; 3]>) -> Self {
        let mut bounds = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
        for c in drawn.map(seen) {
            for k in 0..2 {
                bounds[k] = [bounds[k][0].min(c[k]), bounds[k][1].max(c[k])];
            }
        }
        let [w, h] = bounds.map(|[a, b]| b - a);
        Self {
            scale: (area.width() / w).min(area.height() / h),
            middle: [
                0.5 * (area.left + area.right),
                0.5 * (area.top + area.bottom),
            ],
            centre: bounds.map(|[a, b]| 0.5 * (a + b)),
        }
    }

    fn at(&self, p: [f64; 3]) -> Point {
        let [right, up, _] = seen(p);
        [
            self.middle[0] + self.scale * (right - self.centre[0]),
            self.middle[1] - self.scale * (up - self.centre[1]),
        ]
    }
}

impl Surface {
    /// Places in the unit box.
    fn unit(&self, i: usize, j: usize) -> [f64; 3] {
        let share = |v: f64, axis: &[f64]| (v - axis[0]) / (axis[axis.len() - 1] - axis[0]);
        let v = self.plane.v[i * self.plane.y.len() + j];
        [
            share(self.plane.x[i], &self.plane.x),
            share(self.plane.y[j], &self.plane.y),
            HIGH * (v - self.least) / (self.most - self.least),
        ]
    }

    /// Cells that are drawn, the furthest first: corners, mean V.
    fn cells(&self) -> Vec<(Vec<[f64; 3]>, f64)> {
        let ny = self.plane.y.len();
        let mut cells = Vec::new();
        for i in 0..self.plane.x.len() - 1 {
            for j in 0..ny - 1 {
                let places = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)];
                let at = |(i, j): (usize, usize)| self.plane.v[i * ny + j];
                let values = places.map(at);
                let fits =
                    values.iter().all(|v| v.is_finite()) && values.iter().any(|v| *v <= self.most);
                if !fits {
                    continue;
                }
                let corners = below(&places.map(|(i, j)| self.unit(i, j)), HIGH);
                let mean = values.iter().map(|v| v.min(self.most)).sum::<f64>() / 4.0;
                if corners.len() > 2 {
                    cells.push((corners, mean));
                }
            }
        }
        let depth = |c: &[[f64; 3]]| {
            c.iter().map(|p| seen([p[0], p[1], 0.0])[2]).sum::<f64>() / c.len() as f64
        };
        cells.sort_by(|a, b| depth(&a.0).total_cmp(&depth(&b.0)));
        cells
    }

    /// Lines across the cells of which the map says itself that V may be off by more than was asked
    /// for.
    fn hatching(&self) -> Vec<Vec<[f64; 3]>> {
        let mut lines = Vec::new();
        for i in 0..self.plane.x.len() - 1 {
            for j in 0..self.plane.y.len() - 1 {
                if hatch::is_unmet(&self.plane, i, j) {
                    let line = below(&[self.unit(i, j), self.unit(i + 1, j + 1)], HIGH);
                    lines.extend((line.len() > 1).then_some(line));
                }
            }
        }
        lines
    }

    fn axes(&self, canvas: &mut dyn Canvas, view: &View, area: Rect) {
        let mut lines: Vec<Vec<Point>> =
            vec![BASE.iter().chain([&BASE[0]]).map(|p| view.at(*p)).collect()];
        for k in 0..2 {
            lines.extend(self.level_axis(canvas, view, area, k));
        }
        lines.extend(self.upright_axis(canvas, view));
        canvas.lines(&lines, Stroke::new(Ink::Muted, 1.0));
    }

    /// Labels of the axis of a state, along the edge of the base in front; its ticks.
    fn level_axis(
        &self,
        canvas: &mut dyn Canvas,
        view: &View,
        area: Rect,
        k: usize,
    ) -> Vec<Vec<Point>> {
        let other = 1 - k;
        // The edges in front: x at the nearer end of y and the other way round.
        let mut ends = [[0.5, 0.5, 0.0]; 2];
        (ends[0][other], ends[1][other]) = (0.0, 1.0);
        let edge = f64::from(seen(ends[1])[2] > seen(ends[0])[2]);
        let values = [&self.plane.x, &self.plane.y][k];
        let (from, to) = (values[0], values[values.len() - 1]);
        let at = |value: f64, out: f64| {
            let mut p = [0.0, 0.0, 0.0];
            p[k] = (value - from) / (to - from);
            p[other] = edge + out * (2.0 * edge - 1.0);
            view.at(p)
        };
        let left = at(0.5 * (from + to), 0.0)[0] < view.middle[0];
        let anchor = if left { Anchor::End } else { Anchor::Start };
        let foot = view.at(corner());
        let mut lines = Vec::new();
        for tick in ticks::linear(from, to, 6) {
            lines.push(vec![at(tick.value, 0.0), at(tick.value, 0.02)]);
            // At the corner of the upright axis labels would meet.
            let beside = at(tick.value, 0.0);
            if (beside[0] - foot[0]).hypot(beside[1] - foot[1]) < 16.0 {
                continue;
            }
            let [x, y] = at(tick.value, 0.03);
            canvas.text([x, y + 6.0], &tick.label, Style::new(anchor));
        }
        let [x, y] = at(0.5 * (from + to), 0.13);
        // Not beyond the picture's edges.
        let label = text::shortened(&self.labels[k], TEXT, 0.5 * area.width());
        let long = text::width(&label, TEXT);
        let x = if left {
            x.max(area.left + long)
        } else {
            x.min(area.right - long)
        };
        canvas.text([x, y + LINE], &label, Style::new(anchor));
        lines
    }

    /// Labels of the axis of V; the axis and its ticks.
    fn upright_axis(&self, canvas: &mut dyn Canvas, view: &View) -> Vec<Vec<Point>> {
        let [x, y, _] = corner();
        let height = |v: f64| HIGH * (v - self.least) / (self.most - self.least);
        let upright = |v: f64| view.at([x, y, height(v)]);
        let mut lines = vec![vec![upright(self.least), upright(self.most)]];
        for tick in ticks::linear(self.least, self.most, 6) {
            let [x, y] = upright(tick.value);
            lines.push(vec![[x - 5.0, y], [x, y]]);
            canvas.text([x - 9.0, y], &tick.label, Style::new(Anchor::End));
        }
        let [x, y] = upright(self.most);
        canvas.text([x, y - LINE], "V", Style::new(Anchor::Middle));
        lines
    }
}

impl Drawing for Surface {
    fn height(&self, width: f64) -> f64 {
        (0.62 * width).clamp(340.0, 660.0)
    }

    fn draw(&self, canvas: &mut dyn Canvas, area: Rect) {
        let inner = Rect::new(
            area.left + 50.0,
            area.top + 26.0,
            area.right - 30.0,
            area.bottom - 2.6 * LINE,
        );
        let cells = self.cells();
        let corner = corner();
        let base = BASE.into_iter().chain([[corner[0], corner[1], HIGH]]);
        let view = View::new(
            inner,
            base.chain(cells.iter().flat_map(|(c, _)| c.iter().copied())),
        );
        self.axes(canvas, &view, area);
        let face = |(corners, mean): (Vec<[f64; 3]>, f64)| {
            let ring: Vec<Point> = corners.iter().map(|p| view.at(*p)).collect();
            (
                ring,
                colours::value((mean - self.least) / (self.most - self.least)),
            )
        };
        let faces: Vec<(Vec<Point>, colours::Rgb)> = cells.into_iter().map(face).collect();
        let hatched: Vec<Vec<Point>> = self
            .hatching()
            .iter()
            .map(|l| l.iter().map(|p| view.at(*p)).collect())
            .collect();
        canvas.faces(
            &faces,
            Stroke::new(Ink::Colour([255, 255, 255]), 0.5).opacity(0.4),
        );
        canvas.lines(&hatched, hatch::stroke());
    }
}
