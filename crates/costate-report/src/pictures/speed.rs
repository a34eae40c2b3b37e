//! Speed against error, of `costate bench`.

use super::Made;
use crate::canvas::{Canvas, Dash, Ink, Rect, Stroke};
use crate::frame::{Axis, Frame, Legend, Mark, range};
use crate::{Drawing, Picture, Source, colours};
use costate::low_level::result::{StoredError, StoredGroup};
use costate::low_level::schema;

/// Larger errors are of no use.
const USEFUL: f64 = 0.1;
const LEAST: f64 = 1e-17;

struct Series {
    label: String,
    colour: colours::Rgb,
    dash: Dash,
    /// Worst error of V, trajectories a second.
    points: Vec<[f64; 2]>,
}

struct Speed {
    series: Vec<Series>,
    pareto: Vec<[f64; 2]>,
}

pub fn picture(source: &Source<'_>) -> Made {
    let Some(group) = source.stored.group(&schema::SPEED_ERROR) else {
        return Ok(None);
    };
    let speed = read(&group).map_err(|e| e.to_string())?;
    if speed.series.is_empty() {
        return Err("no variant has an error below 0.1".to_owned());
    }
    Ok(Some(Picture {
        name: "speed".to_owned(),
        title: "Speed against error".to_owned(),
        caption: "Each dot is a tolerance (or step) of one method: trajectories a second, seeds on the host to results on the host, against \
                  the worst error of V off the manifold, relative to max(1, V). Up and left is better; the broad band is what nothing beats."
            .to_owned(),
        drawing: Box::new(speed),
    }))
}

fn read(group: &StoredGroup<'_>) -> Result<Speed, StoredError> {
    let [adapter, precision, method] = [
        group.texts("adapter")?,
        group.texts("precision")?,
        group.texts("method")?,
    ];
    let (error, rate) = (
        group.f64("e_V_worst")?.values,
        group.f64("trajectories_per_second")?.values,
    );
    let best = group.i32("pareto")?.1;
    let mut devices: Vec<String> = Vec::new();
    let mut methods: Vec<&str> = Vec::new();
    let mut series: Vec<Series> = Vec::new();
    let mut pareto = Vec::new();
    const DASHES: [Dash; 3] = [Dash::Solid, Dash::Dashed, Dash::Dotted];
    for k in 0..error.len() {
        if !(error[k] <= USEFUL && rate[k].is_finite() && rate[k] > 0.0) {
            continue;
        }
        let device = format!("{} {}", adapter[k], precision[k]);
        let label = format!("{} {device}", method[k]);
        let point = [error[k].max(LEAST), rate[k]];
        if best[k] != 0 {
            pareto.push(point);
        }
        match series.iter_mut().find(|s| s.label == label) {
            Some(s) => s.points.push(point),
            None => {
                let place = |all: &mut Vec<String>, one: &String| {
                    all.iter().position(|a| a == one).unwrap_or_else(|| {
                        all.push(one.clone());
                        all.len() - 1
                    })
                };
                let dash = place(&mut devices, &device);
                let colour = methods
                    .iter()
                    .position(|m| *m == method[k])
                    .unwrap_or_else(|| {
                        methods.push(&method[k]);
                        methods.len() - 1
                    });
                series.push(Series {
                    label,
                    colour: colours::class(colour),
                    dash: DASHES[dash % 3],
                    points: vec![point],
                });
            }
        }
    }
    for s in &mut series {
        s.points.sort_by(|a, b| a[0].total_cmp(&b[0]));
    }
    pareto.sort_by(|a, b| a[0].total_cmp(&b[0]));
    Ok(Speed { series, pareto })
}

/// The line of the Pareto front.
fn best() -> Stroke {
    Stroke::new(Ink::Muted, 11.0).opacity(0.3)
}

impl Speed {
    fn legend(&self) -> Vec<(Mark, String)> {
        let line = |s: &Series| Mark::Line(Stroke::new(Ink::Colour(s.colour), 2.0).dash(s.dash));
        let series = self.series.iter().map(|s| (line(s), s.label.clone()));
        let best = (
            Mark::Line(best()),
            "Pareto front: what nothing beats".to_owned(),
        );
        series.chain([best]).collect()
    }
}

impl Drawing for Speed {
    fn height(&self, width: f64) -> f64 {
        let legend = self.legend();
        (0.58 * width).clamp(330.0, 620.0) + Legend { entries: &legend }.height(width)
    }

    fn draw(&self, canvas: &mut dyn Canvas, area: Rect) {
        let entries = self.legend();
        let legend = Legend { entries: &entries };
        legend.draw(canvas, [area.left, area.top], area.width());
        let top = area.top + legend.height(area.width());
        let all = || self.series.iter().flat_map(|s| s.points.iter());
        let [x, y] = [0, 1].map(|k| range(all().map(|p| p[k])).unwrap_or([1e-9, 1.0]));
        let x = Axis::log("worst error of V, relative", x).padded(0.04);
        let y = Axis::log("trajectories a second", y).padded(0.06);
        let frame = Frame::within(Rect::new(area.left, top, area.right, area.bottom), x, y);
        frame.under(canvas);
        canvas.lines(&frame.line(&self.pareto), best());
        for s in &self.series {
            let ink = Ink::Colour(s.colour);
            canvas.lines(&frame.line(&s.points), Stroke::new(ink, 1.6).dash(s.dash));
            canvas.dots(&frame.dots(s.points.iter().copied()), 7.0, ink, 1.0);
        }
        frame.over(canvas);
    }
}
