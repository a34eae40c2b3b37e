//! Panels of lines that share their horizontal axis.

use crate::Drawing;
use crate::canvas::{Canvas, Dash, Ink, Rect, Stroke};
use crate::frame::{Axis, Frame, Legend, Mark, dashed, range};

/// Height of a panel's inside.
const HEIGHT: f64 = 162.0;
const GAP: f64 = 16.0;
/// Smaller values are what rounding leaves of 0.
const NOTHING: f64 = 1e-13;
/// Columns are no narrower.
const NARROWEST: f64 = 380.0;

/// A line of a panel.
#[derive(Clone)]
pub struct Curve {
    pub points: Vec<[f64; 2]>,
    pub stroke: Stroke,
}

/// One panel.
#[derive(Clone, Default)]
pub struct Panel {
    pub label: String,
    pub curves: Vec<Curve>,
    /// Values at which a dashed line is drawn: bounds.
    pub bounds: Vec<f64>,
    /// A value at which a dotted line is drawn: the equilibrium.
    pub rest: Option<f64>,
    /// Places with a mark.
    pub dots: Vec<[f64; 2]>,
    /// The vertical range, if it does not follow from the curves.
    pub range: Option<[f64; 2]>,
}

pub struct Panels {
    pub x_label: String,
    pub panels: Vec<Panel>,
    pub legend: Vec<(Mark, String)>,
    /// Places along the horizontal axis with an upright dashed line through all panels.
    pub marks: Vec<f64>,
    /// At most so many columns.
    pub columns: usize,
    /// Panels are so many times as high.
    pub tall: f64,
    /// Logarithmic horizontal axis.
    pub log: bool,
}

impl Panels {
    fn columns(&self, width: f64) -> usize {
        ((width / NARROWEST) as usize)
            .clamp(1, self.columns.max(1))
            .min(self.panels.len().max(1))
    }

    fn rows(&self, width: f64) -> usize {
        self.panels.len().div_ceil(self.columns(width))
    }

    fn x(&self) -> Axis {
        let all = self
            .panels
            .iter()
            .flat_map(|p| p.curves.iter())
            .flat_map(|c| c.points.iter().map(|p| p[0]));
        let found = range(all.filter(|v| !self.log || *v > 0.0)).unwrap_or([0.0, 1.0]);
        if self.log {
            Axis::log(self.x_label.clone(), found)
        } else {
            Axis::linear(self.x_label.clone(), found)
        }
    }
}

impl Panel {
    fn y(&self) -> Axis {
        let values = self
            .curves
            .iter()
            .flat_map(|c| c.points.iter().map(|p| p[1]));
        let found = range(values.clone());
        let mut shown = self.range.or(found).unwrap_or([0.0, 1.0]);
        if shown.iter().all(|v| v.abs() < NOTHING) {
            shown = [-1.0, 1.0];
        }
        // Bounds that are far away would flatten the curves.
        let wide = (shown[1] - shown[0]).max(1e-300);
        for bound in &self.bounds {
            if *bound > shown[0] - wide && *bound < shown[1] + wide {
                shown = [shown[0].min(*bound), shown[1].max(*bound)];
            }
        }
        let axis = Axis::linear(self.label.clone(), shown);
        if self.range.is_some() {
            axis
        } else {
            axis.padded(0.05)
        }
    }

    fn draw(&self, canvas: &mut dyn Canvas, frame: &Frame, marks: &[f64]) {
        frame.under(canvas);
        let [left, right] = frame.x.range;
        let [low, high] = frame.y.range;
        for bound in &self.bounds {
            canvas.lines(
                &frame.line(&[[left, *bound], [right, *bound]]),
                dashed(Ink::Muted),
            );
        }
        if let Some(rest) = self.rest {
            let dotted = Stroke::new(Ink::Muted, 1.2).dash(Dash::Dotted);
            canvas.lines(&frame.line(&[[left, rest], [right, rest]]), dotted);
        }
        for mark in marks {
            canvas.lines(
                &frame.line(&[[*mark, low], [*mark, high]]),
                dashed(Ink::Text),
            );
        }
        for curve in &self.curves {
            canvas.lines(&frame.line(&curve.points), curve.stroke);
        }
        let dots = frame.dots(self.dots.iter().copied());
        canvas.dots(&dots, 10.0, Ink::Paper, 1.0);
        canvas.dots(&dots, 7.0, Ink::Text, 1.0);
        frame.over(canvas);
    }
}

impl Drawing for Panels {
    fn height(&self, width: f64) -> f64 {
        let rows = self.rows(width) as f64;
        Legend {
            entries: &self.legend,
        }
        .height(width)
            + rows * self.tall * HEIGHT
            + (rows - 1.0) * GAP
            + Frame::below(true)
            + 7.0
    }

    fn draw(&self, canvas: &mut dyn Canvas, area: Rect) {
        let legend = Legend {
            entries: &self.legend,
        };
        legend.draw(canvas, [area.left, area.top], area.width());
        let top = area.top + legend.height(area.width()) + 7.0;
        let (columns, rows) = (self.columns(area.width()), self.rows(area.width()));
        let bottom = area.bottom - Frame::below(true);
        let height = (bottom - top - (rows as f64 - 1.0) * GAP) / rows as f64;
        let axes: Vec<Axis> = self.panels.iter().map(Panel::y).collect();
        let x = self.x();
        let mut left = area.left;
        let wide = area.width() / columns as f64;
        for column in 0..columns {
            // A column's axes stand above each other.
            let own = || column * rows..((column + 1) * rows).min(self.panels.len());
            let room = own()
                .map(|k| Frame::beside(&axes[k], height))
                .fold(0.0, f64::max);
            for (row, k) in own().enumerate() {
                let at = top + row as f64 * (height + GAP);
                let inside = Rect::new(left + room, at, left + wide - 14.0, at + height);
                let mut frame = Frame::around(inside, x.clone(), axes[k].clone());
                frame.x_labels = k + 1 == own().end;
                self.panels[k].draw(canvas, &frame, &self.marks);
            }
            left += wide;
        }
    }
}
