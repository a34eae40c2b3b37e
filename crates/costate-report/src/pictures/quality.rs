//! How wrong it is: histograms of what vanishes on an exact solution, and the run's own estimates.

use super::Made;
use crate::canvas::{Anchor, Canvas, Ink, Rect, Stroke, Style, TEXT};
use crate::colours;
use crate::flow::Flow;
use crate::frame::{Axis, Frame, LINE, dashed, range};
use crate::{Drawing, Picture, Source, text};
use costate::low_level::schema;
use costate::session::summary::Quantiles;

/// Bins a decade.
const BINS: f64 = 4.0;
/// Anything smaller is rounding, or exact by chance, and counted in the first bin.
const LEAST: f64 = 1e-16;
/// Trajectories, and samples of each, that are looked at.
const TRAJECTORIES: usize = 400;
const SAMPLES: usize = 25;
const HIGH: f64 = 120.0;

struct Row {
    label: String,
    values: Vec<f64>,
}

/// A quantity's estimated error: median, 99 % quantile, largest.
struct Estimate {
    label: String,
    quantiles: [f64; 3],
}

struct Quality {
    rows: Vec<Row>,
    estimates: Vec<Estimate>,
    asked: Option<f64>,
}

pub fn picture(source: &Source<'_>) -> Made {
    let mut rows = Vec::new();
    let change = if source.infinite() {
        "|H|"
    } else {
        "change of H"
    };
    let swept = along_trajectories(source)?;
    if !swept.is_empty() {
        rows.push(Row {
            label: format!(
                "{change} along {} trajectories, of the largest running cost",
                swept.len()
            ),
            values: swept,
        });
    }
    rows.extend(at_points(source)?);
    let summary = source.stored.run_summary().map_err(wrong)?;
    let swept = summary.as_ref().and_then(|s| s.error_estimate.as_ref());
    let solved = summary.as_ref().and_then(|s| s.homotopy.as_ref());
    let solved = solved.and_then(|s| s.error_estimate.as_ref());
    let mut estimates = Vec::new();
    if let Some(e) = swept {
        estimates.extend(estimates_of("swept", [e.value, e.costate, e.control]));
    }
    if let Some(e) = solved {
        estimates.extend(estimates_of("solved", [e.value, e.costate, e.control]));
    }
    if rows.is_empty() && estimates.is_empty() {
        return Ok(None);
    }
    let asked = swept.map(|e| e.asked);
    let mut caption = "Errors on a logarithmic axis; the further left the better. ".to_owned();
    if !rows.is_empty() {
        caption += "H and the residual are 0 on an exact solution. ";
    }
    if !estimates.is_empty() {
        caption += "Estimates compare a random sample with a finer integration: dot median, bar 99 %, ring largest";
        caption += if asked.is_some() {
            "; dashed: what is promised of V. "
        } else {
            ". "
        };
    }
    Ok(Some(Picture {
        name: "errors".to_owned(),
        title: "How wrong is it".to_owned(),
        caption: caption.trim_end().to_owned(),
        drawing: Box::new(Quality {
            rows,
            estimates,
            asked,
        }),
    }))
}

fn wrong(e: costate::low_level::result::StoredError) -> String {
    e.to_string()
}

/// The drift of H relative to the largest running cost of some trajectories.
fn along_trajectories(source: &Source<'_>) -> Result<Vec<f64>, String> {
    let (Some(t), Some(group)) = (
        source.trajectories()?.filter(|t| t.is_full()),
        source.stored.group(&schema::TRAJECTORIES),
    ) else {
        return Ok(Vec::new());
    };
    let drift = group.f64("hamiltonian_drift").map_err(wrong)?.values;
    let n = source.model.states.len();
    let mut flow = Flow::new(source.model, &source.stored.scene.hamiltonian);
    let mut all = Vec::new();
    for k in (0..t.count).step_by(t.count.div_ceil(TRAJECTORIES)) {
        let finite: Vec<usize> = (k * t.samples..(k + 1) * t.samples)
            .filter(|s| t.v[*s].is_finite())
            .collect();
        let cost = (finite.iter().step_by(finite.len().div_ceil(SAMPLES).max(1)))
            .map(|s| flow.at(&t.x[s * n..(s + 1) * n], &t.p[s * n..(s + 1) * n])[n].abs())
            .fold(0.0, f64::max);
        let relative = drift.get(k).copied().unwrap_or(f64::NAN) / cost;
        if relative.is_finite() {
            all.push(relative);
        }
    }
    Ok(all)
}

/// |H| and residuals at solved states.
fn at_points(source: &Source<'_>) -> Result<Vec<Row>, String> {
    let (Some(points), Some(group)) = (source.points()?, source.stored.group(&schema::POINTS))
    else {
        return Ok(Vec::new());
    };
    let n = source.model.states.len();
    let mut rows = Vec::new();
    let solved: Vec<usize> = (0..points.count)
        .filter(|k| points.v[*k].is_finite())
        .collect();
    // Rows of the file, of which those of other times are not among the points.
    let row = |k: usize| points.point[k] as usize;
    // What was interpolated has neither.
    if source.infinite() && group.has("H") {
        let h = group.f64("H").map_err(wrong)?.values;
        let mut flow = Flow::new(source.model, &source.stored.scene.hamiltonian);
        let values: Vec<f64> = (solved.iter().step_by(solved.len().div_ceil(8000).max(1)))
            .map(|k| {
                h[row(*k)].abs()
                    / flow.at(&points.x[k * n..(k + 1) * n], &points.p[k * n..(k + 1) * n])[n].abs()
            })
            .filter(|v| v.is_finite())
            .collect();
        rows.push(Row {
            label: "|H| at solved states, of the running cost there".to_owned(),
            values,
        });
    }
    if group.has("residual") {
        let residual = group.f64("residual").map_err(wrong)?.values;
        let values = solved.iter().map(|k| residual[row(*k)]);
        rows.push(Row {
            label: "last correction at solved states, of the trajectory's size".to_owned(),
            values: values.filter(|v| v.is_finite()).collect(),
        });
    }
    rows.retain(|r| !r.values.is_empty());
    Ok(rows)
}

fn estimates_of(what: &str, of: [Option<Quantiles>; 3]) -> Vec<Estimate> {
    let known = ["V", "p", "u"].iter().zip(of).filter_map(|(name, q)| {
        let q = q?;
        let quantiles = [q.median?, q.p99?, q.max?];
        let label = format!("{name} {what}");
        Some(Estimate { label, quantiles })
    });
    known.collect()
}

impl Quality {
    fn range(&self) -> [f64; 2] {
        let values = self.rows.iter().flat_map(|r| r.values.iter().copied());
        let all = values
            .chain(self.estimates.iter().flat_map(|e| e.quantiles))
            .chain(self.asked);
        let [from, to] = range(all.filter(|v| *v > LEAST)).unwrap_or([1e-12, 1e-6]);
        [
            10f64.powf(from.log10().floor()),
            10f64.powf(to.log10().ceil()),
        ]
    }

    /// Counts by bin, from the range's beginning on.
    fn histogram(values: &[f64], [from, to]: [f64; 2]) -> Vec<usize> {
        let bins = ((to / from).log10() * BINS).round().max(1.0) as usize;
        let mut counts = vec![0; bins];
        for v in values {
            let place = ((v.max(LEAST) / from).log10() * BINS).floor();
            counts[(place.max(0.0) as usize).min(bins - 1)] += 1;
        }
        counts
    }

    fn room(&self, width: f64) -> (f64, f64) {
        let labels = self.estimates.iter().map(|e| text::width(&e.label, TEXT));
        let left = labels.fold(46.0, f64::max) + 14.0;
        (left, width - left - 14.0)
    }
}

impl Drawing for Quality {
    fn height(&self, _: f64) -> f64 {
        let estimates = if self.estimates.is_empty() {
            0.0
        } else {
            LINE + 26.0 + LINE * self.estimates.len() as f64
        };
        self.rows.len() as f64 * (HIGH + LINE + 10.0) + estimates + Frame::below(true)
    }

    fn draw(&self, canvas: &mut dyn Canvas, area: Rect) {
        let (room, wide) = self.room(area.width());
        let [left, right] = [area.left + room, area.left + room + wide];
        let shown = self.range();
        let x = Axis::log("relative error", shown);
        let mut top = area.top;
        let panels = self.rows.len() + usize::from(!self.estimates.is_empty());
        for (k, row) in self.rows.iter().enumerate() {
            let label = text::shortened(&row.label, TEXT, wide + room);
            canvas.text([left, top + 0.5 * LINE], &label, Style::new(Anchor::Start));
            let counts = Self::histogram(&row.values, shown);
            let most = counts.iter().copied().max().unwrap_or(1) as f64;
            let inside = Rect::new(left, top + LINE, right, top + LINE + HIGH);
            let mut frame =
                Frame::around(inside, x.clone(), Axis::linear("count", [0.0, 1.08 * most]));
            frame.x_labels = k + 1 == panels;
            frame.under(canvas);
            let bars: Vec<_> = (counts.iter().enumerate().filter(|(_, c)| **c > 0))
                .map(|(b, count)| {
                    let at = |b: usize| shown[0] * 10f64.powf(b as f64 / BINS);
                    let [a, z] = [frame.at([at(b), 0.0]), frame.at([at(b + 1), *count as f64])];
                    Rect::new(a[0] + 0.5, z[1], z[0] - 0.5, a[1])
                        .corners()
                        .to_vec()
                })
                .collect();
            canvas.area(&bars, Ink::Colour(colours::class(k)), 0.85);
            frame.over(canvas);
            top += HIGH + LINE + 10.0;
        }
        if !self.estimates.is_empty() {
            let style = Style::new(Anchor::Start);
            canvas.text([left, top + 0.5 * LINE], "estimated errors", style);
            let inside = Rect::new(
                left,
                top + LINE,
                right,
                top + LINE + 12.0 + LINE * self.estimates.len() as f64,
            );
            let mut frame = Frame::around(inside, x, Axis::linear("", [0.0, 1.0]));
            frame.y_ticks = false;
            self.marks(canvas, &frame);
        }
    }
}

impl Quality {
    fn marks(&self, canvas: &mut dyn Canvas, frame: &Frame) {
        let a = frame.area;
        let grid = Stroke::new(Ink::Grid, 1.0);
        if let Some(asked) = self.asked {
            let x = frame.at([asked, 0.0])[0];
            canvas.line([x, a.top], [x, a.bottom], dashed(Ink::Text));
        }
        for (k, estimate) in self.estimates.iter().enumerate() {
            let y = a.top + 6.0 + LINE * (k as f64 + 0.5);
            canvas.line([a.left, y], [a.right, y], grid);
            canvas.text([a.left - 8.0, y], &estimate.label, Style::new(Anchor::End));
            let [median, most, largest] =
                estimate.quantiles.map(|q| frame.at([q.max(LEAST), 0.0])[0]);
            let ink = Ink::Colour(colours::class(k % 3));
            canvas.line([median, y], [largest, y], Stroke::new(ink, 1.4));
            canvas.dots(&[[median, y]], 8.0, ink, 1.0);
            canvas.line([most, y - 5.0], [most, y + 5.0], Stroke::new(ink, 2.2));
            canvas.dots(&[[largest, y]], 9.0, ink, 1.0);
            canvas.dots(&[[largest, y]], 5.0, Ink::Paper, 1.0);
        }
        frame.over(canvas);
    }
}
