//! The picture: error against time, one line a series.

use super::measure::{Bench, Row, USEFUL};
use plotters::coord::Shift;
use plotters::prelude::*;

/// Pixels. It stays legible at 800.
const SIZE: (u32, u32) = (960, 620);
const LEGEND: u32 = 264;
const LINE: i32 = 20;
/// Colours that the colour-blind tell apart (M. Okabe, K. Ito, Color Universal Design, 2008), without the yellow, which
/// is too light for lines: one a backend and precision. The method is told by the mark.
const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(230, 159, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(213, 94, 0),
    RGBColor(86, 180, 233),
    RGBColor(60, 60, 60),
];
const MARKS: usize = 5;
/// Errors that are not there are drawn here.
const LEAST: f64 = 1e-17;

/// A picture could not be drawn.
#[derive(Debug, thiserror::Error)]
#[error("cannot draw the picture: {0}")]
pub struct PictureError(String);

fn failed(e: impl std::fmt::Display) -> PictureError {
    PictureError(e.to_string())
}

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Chart<'a> = ChartContext<
    'a,
    SVGBackend<'a>,
    Cartesian2d<plotters::coord::combinators::LogCoord<f64>, plotters::coord::combinators::LogCoord<f64>>,
>;

/// The picture as SVG text; `title` heads it.
///
/// # Errors
/// [`PictureError`] where nothing was measured that can be drawn.
pub fn svg(bench: &Bench, title: &str) -> Result<String, PictureError> {
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, SIZE).into_drawing_area();
        root.fill(&WHITE).map_err(failed)?;
        let (plot, legend) = root.split_horizontally(SIZE.0 - LEGEND);
        draw(bench, title, &plot)?;
        explain(bench, &legend)?;
        root.present().map_err(failed)?;
    }
    Ok(text)
}

/// Microseconds a trajectory and worst e_V, of what is of use.
fn place(bench: &Bench, row: &Row) -> Option<(f64, f64)> {
    let time = 1e6 * row.median() / bench.trajectories as f64;
    let error = row.errors.value.worst;
    (time.is_finite() && error <= USEFUL).then_some((time, error.max(LEAST)))
}

/// Lines in the order of the rows, with what tells them apart.
struct Line {
    device: usize,
    label: String,
    colour: RGBColor,
    mark: usize,
    rows: Vec<usize>,
}

fn lines(bench: &Bench) -> Vec<Line> {
    let mut lines: Vec<Line> = Vec::new();
    let mut colours = Vec::new();
    let mut methods = Vec::new();
    let mut series = Vec::new();
    for (k, row) in bench.rows.iter().enumerate() {
        let s = row.series;
        let at = series.iter().position(|t| *t == s).unwrap_or_else(|| {
            let place = |list: &mut Vec<_>, item| {
                list.iter().position(|i| *i == item).unwrap_or_else(|| {
                    list.push(item);
                    list.len() - 1
                })
            };
            let colour = place(&mut colours, (s.device, Some(s.precision), None));
            let mark = place(&mut methods, (0, None, Some(s.method)));
            series.push(s);
            lines.push(Line {
                device: s.device,
                label: format!("{} {}", s.precision.name(), s.method.name()),
                colour: COLOURS[colour % COLOURS.len()],
                mark: mark % MARKS,
                rows: Vec::new(),
            });
            lines.len() - 1
        });
        lines[at].rows.push(k);
    }
    lines
}

fn draw(bench: &Bench, title: &str, area: &Area<'_>) -> Result<(), PictureError> {
    let points: Vec<(f64, f64)> = bench.rows.iter().filter_map(|r| place(bench, r)).collect();
    let [x, y] = [0, 1].map(|axis| {
        let of = |p: &(f64, f64)| if axis == 0 { p.0 } else { p.1 };
        let least = points.iter().map(of).fold(f64::INFINITY, f64::min);
        let most = points.iter().map(of).fold(0.0, f64::max);
        // Room for the marks.
        (least / 1.6)..(most * 1.6)
    });
    if points.is_empty() {
        return Err(PictureError("no variant has a time and an error".into()));
    }
    let mut chart = ChartBuilder::on(area)
        .margin(12)
        .caption(shortened(title, 62), ("sans-serif", 20))
        .x_label_area_size(48)
        .y_label_area_size(78)
        .build_cartesian_2d(x.log_scale(), y.log_scale())
        .map_err(failed)?;
    chart
        .configure_mesh()
        .x_desc("time a trajectory, end to end (\u{b5}s)")
        .y_desc("worst error of V off the manifold, relative to max(1, V)")
        .x_label_formatter(&|x| plain(*x))
        .y_label_formatter(&|y| power(*y))
        .axis_desc_style(("sans-serif", 18))
        .label_style(("sans-serif", 17))
        .x_max_light_lines(2)
        .bold_line_style(RGBColor(205, 205, 205))
        .light_line_style(RGBColor(240, 240, 240))
        .draw()
        .map_err(failed)?;
    front(bench, &mut chart)?;
    for line in lines(bench) {
        let at: Vec<(f64, f64)> = line.rows.iter().filter_map(|k| place(bench, &bench.rows[*k])).collect();
        chart
            .draw_series(LineSeries::new(at.iter().copied(), line.colour.stroke_width(2)))
            .map_err(failed)?;
        let plot = chart.plotting_area();
        for point in at {
            let (px, py) = plot.map_coordinate(&point);
            marks(area, (px, py), &line)?;
        }
    }
    Ok(())
}

/// What nothing beats, as a broad band beneath the lines.
fn front(bench: &Bench, chart: &mut Chart<'_>) -> Result<(), PictureError> {
    let mut at: Vec<(f64, f64)> = bench
        .rows
        .iter()
        .filter(|r| r.pareto)
        .filter_map(|r| place(bench, r))
        .collect();
    at.sort_by(|a, b| a.0.total_cmp(&b.0));
    let band = RGBColor(150, 150, 150).mix(0.45).stroke_width(10);
    chart.draw_series(LineSeries::new(at, band)).map_err(failed)?;
    Ok(())
}

/// A mark at a pixel of the whole picture.
fn marks(area: &Area<'_>, (x, y): (i32, i32), line: &Line) -> Result<(), PictureError> {
    // Areas draw relative to their own corner.
    let (left, top) = area.get_base_pixel();
    mark(area, (x - left, y - top), line)
}

fn mark(area: &Area<'_>, at: (i32, i32), line: &Line) -> Result<(), PictureError> {
    let colour = line.colour;
    let done = match line.mark {
        0 => area.draw(&Circle::new(at, 5, colour.filled())),
        1 => area.draw(&TriangleMarker::new(at, 6, colour.filled())),
        2 => area.draw(&Rectangle::new(
            [(at.0 - 4, at.1 - 4), (at.0 + 4, at.1 + 4)],
            colour.filled(),
        )),
        3 => area.draw(&Cross::new(at, 5, colour.stroke_width(2))),
        _ => area.draw(&Circle::new(at, 5, colour.stroke_width(2))),
    };
    done.map_err(failed)
}

/// The legend: series by device, then what else there is to say.
fn explain(bench: &Bench, area: &Area<'_>) -> Result<(), PictureError> {
    let style = ("sans-serif", 16).into_text_style(area);
    let mut y = 48;
    let write = |text: &str, x: i32, y: i32| area.draw_text(text, &style, (x, y)).map_err(failed);
    let lines = lines(bench);
    for (k, device) in bench.devices.iter().enumerate() {
        for part in wrapped(&device.adapter, 33) {
            write(&part, 4, y)?;
            y += LINE;
        }
        for line in lines.iter().filter(|l| l.device == k) {
            let stroke = line.colour.stroke_width(2);
            area.draw(&PathElement::new([(10, y + 7), (44, y + 7)], stroke))
                .map_err(failed)?;
            mark(area, (27, y + 7), line)?;
            write(&line.label, 54, y)?;
            y += LINE;
        }
        y += LINE / 2;
    }
    let band = RGBColor(150, 150, 150).mix(0.45).stroke_width(10);
    area.draw(&PathElement::new([(10, y + 7), (44, y + 7)], band))
        .map_err(failed)?;
    write("not beaten (Pareto front)", 54, y)?;
    y += LINE + LINE / 2;
    write(&format!("{} trajectories,", bench.trajectories), 4, y)?;
    write(&format!("median of {} passes", bench.rounds), 4, y + LINE)
}

/// A decimal power as the axis of errors shows it.
fn power(x: f64) -> String {
    let exponent = x.log10();
    let digits = |n: i64| -> String {
        const RAISED: [char; 10] = [
            '\u{2070}', '\u{b9}', '\u{b2}', '\u{b3}', '\u{2074}', '\u{2075}', '\u{2076}', '\u{2077}', '\u{2078}',
            '\u{2079}',
        ];
        let digits = n.unsigned_abs().to_string();
        let sign = if n < 0 { "\u{207b}" } else { "" };
        let raised = digits.bytes().map(|b| RAISED[usize::from(b - b'0')]);
        sign.chars().chain(raised).collect()
    };
    if (exponent - exponent.round()).abs() < 1e-6 {
        format!("10{}", digits(exponent.round() as i64))
    } else {
        format!("{x:.0e}")
    }
}

/// A time without needless digits; of a decade's ten marks three are enough.
fn plain(x: f64) -> String {
    let first = x / 10f64.powf(x.log10().floor() + 1e-9);
    if [1.0, 2.0, 5.0, 10.0].iter().all(|d| (first - d).abs() > 0.01) {
        return String::new();
    }
    let text = if x >= 1.0 { format!("{x:.1}") } else { format!("{x:.4}") };
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

fn shortened(text: &str, most: usize) -> String {
    if text.chars().count() <= most {
        return text.to_owned();
    }
    text.chars().take(most - 1).chain(['\u{2026}']).collect()
}

/// A text in lines of at most so many characters, broken between words.
fn wrapped(text: &str, most: usize) -> Vec<String> {
    let mut lines: Vec<String> = vec![String::new()];
    for word in text.split_whitespace() {
        let last = lines.len() - 1;
        let room = lines[last].chars().count() + 1 + word.chars().count() <= most;
        if lines[last].is_empty() {
            lines[last] = word.to_owned();
        } else if room {
            lines[last] = format!("{} {word}", lines[last]);
        } else {
            lines.push(word.to_owned());
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels() {
        assert_eq!(power(1e-12), "10\u{207b}\u{b9}\u{b2}");
        assert_eq!(power(1.0), "10\u{2070}");
        assert_eq!(power(2e-3), "2e-3");
        assert_eq!(
            (plain(10.0), plain(0.05), plain(60.0)),
            ("10".into(), "0.05".into(), String::new())
        );
        assert_eq!(wrapped("one two three", 7), ["one two", "three"]);
        assert_eq!(shortened("abcdef", 4), "abc\u{2026}");
    }
}
