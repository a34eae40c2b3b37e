//! Stick figures of a mechanism along a trajectory: many on one picture, and one that moves.

use super::Made;
use super::histories::far_apart;
use crate::canvas::{Canvas, Ink, Point, Rect, Stroke};
use crate::flow::Flow;
use crate::frame::{Axis, Bar, Frame, range};
use crate::{Drawing, Picture, Source, colours, ticks};
use costate::low_level::schema;
use costate::session::StickFigure;

/// Figures of the picture, and of the one that moves a second.
const SHOWN: usize = 20;
const RATE: f64 = 25.0;
/// Frames at most, and seconds that the motion takes at least and at most.
const MOST_FRAMES: usize = 250;
const SECONDS: [f64; 2] = [2.0, 10.0];
/// A motion ends where no vertex is further from its last place than this share of the figure.
const STILL: f64 = 0.01;
/// Height of a picture by its width at most, and at least.
const TALL: f64 = 0.75;
const FLAT: f64 = 0.22;

/// A trajectory of which figures are drawn.
struct Motion {
    /// What it is, for captions.
    of: String,
    t: Vec<f64>,
    x: Vec<Vec<f64>>,
}

pub fn picture(source: &Source<'_>) -> Made {
    let Some((figure, motion, track)) = track(source)? else {
        return match &source.model.mechanism {
            Some(_) => Err("no trajectory is stored; `--trajectories` stores those of `solve` and `homotopy`, and `costate simulate` its flights, unless `--samples` is 0".to_owned()),
            None => Ok(None),
        };
    };
    let count = SHOWN.min(track.len().max(2));
    let figures = even(&track, count);
    let step = (track[track.len() - 1].t - track[0].t) / (count - 1) as f64;
    let unit = unit(source);
    Ok(Some(Picture {
        name: "figures".to_owned(),
        title: "The mechanism along a trajectory".to_owned(),
        caption: format!(
            "{}, every {}{unit}: dark at the beginning, light at the end. Thin: paths of the ends.{}",
            motion.of,
            ticks::significant(step, 3),
            seen(&figure),
        ),
        drawing: Box::new(Figures {
            lines: figure.lines.clone(),
            paths: paths(&figure, &track),
            frames: figures,
            moving: None,
            axes: labels(&figure),
            time: source.time_label(),
        }),
    }))
}

pub fn moving(source: &Source<'_>) -> Made {
    let Some((figure, motion, track)) = track(source)? else {
        return Ok(None);
    };
    let duration = track[track.len() - 1].t - track[0].t;
    let real = source.model.time_unit.as_deref() == Some("s")
        && (SECONDS[0]..=SECONDS[1]).contains(&duration);
    let seconds = match real {
        true => duration,
        false => duration.clamp(SECONDS[0], SECONDS[1]),
    };
    let count = ((RATE * seconds) as usize).clamp(2, MOST_FRAMES);
    let unit = unit(source);
    Ok(Some(Picture {
        name: "motion".to_owned(),
        title: "The mechanism in motion".to_owned(),
        caption: format!(
            "{}: {}{unit} in {} (browsers show it moving; the PNG has its beginning).{}",
            motion.of,
            ticks::significant(duration, 3),
            match real {
                true => "real time".to_owned(),
                false => format!("{} s", ticks::significant(seconds, 3)),
            },
            seen(&figure),
        ),
        drawing: Box::new(Figures {
            lines: figure.lines.clone(),
            paths: paths(&figure, &track),
            frames: even(&track, count),
            moving: Some((seconds, figure.joints.clone())),
            axes: labels(&figure),
            time: String::new(),
        }),
    }))
}

fn unit(source: &Source<'_>) -> String {
    (source.model.time_unit.as_ref()).map_or_else(String::new, |unit| format!(" {unit}"))
}

fn seen(figure: &StickFigure) -> &'static str {
    match figure.planar {
        true => "",
        false => " Seen from the side and a little from above.",
    }
}

fn labels(figure: &StickFigure) -> [String; 2] {
    match figure.planar {
        true => ["x".to_owned(), "y".to_owned()],
        false => ["to the right".to_owned(), "upward".to_owned()],
    }
}

/// A figure at a time, as it is seen.
#[derive(Clone)]
struct Still {
    t: f64,
    vertices: Vec<[f64; 2]>,
}

/// The figure along the trajectory of the file that is shown, if there is one, up to where it stands
/// still.
fn track(source: &Source<'_>) -> Result<Option<(StickFigure, Motion, Vec<Still>)>, String> {
    let Some(figure) = StickFigure::new(&source.stored.scene) else {
        return Ok(None);
    };
    let Some(motion) = motion(source)? else {
        return Ok(None);
    };
    let mut track: Vec<Still> = Vec::new();
    let (mut shift, mut last) = ([0.0; 2], f64::NEG_INFINITY);
    for (t, x) in motion.t.iter().zip(&motion.x) {
        let mut vertices: Vec<[f64; 2]> =
            figure.at(x).into_iter().map(|p| figure.seen(p)).collect();
        if let (Some(before), true) = (track.last(), *t == last) {
            // An event that gives parts new names may count places from another point.
            shift = moved(&before.vertices, &vertices, shift);
        }
        for v in &mut vertices {
            *v = [v[0] + shift[0], v[1] + shift[1]];
        }
        last = *t;
        track.push(Still { t: *t, vertices });
    }
    track.retain(|s| s.vertices.iter().flatten().all(|v| v.is_finite()));
    if track.len() < 2 {
        return Ok(None);
    }
    let size = extent(&track)
        .iter()
        .fold(0.0f64, |a, [lo, hi]| a.max(hi - lo));
    let end = track[track.len() - 1].vertices.clone();
    let moves = |s: &Still| {
        let apart = s
            .vertices
            .iter()
            .zip(&end)
            .map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1]));
        apart.fold(0.0, f64::max) > STILL * size
    };
    let moving = track.iter().rposition(moves).map_or(1, |k| k + 1);
    track.truncate((moving + 1).max(2));
    Ok(Some((figure, motion, track)))
}

/// The shift by which most vertices after an event lie where some were before it; of these the one
/// nearest to what it was.
fn moved(before: &[[f64; 2]], after: &[[f64; 2]], last: [f64; 2]) -> [f64; 2] {
    let size = before.iter().flatten().fold(0.0f64, |a, v| a.max(v.abs()));
    let near = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]) <= 1e-6 * size;
    let hits = |shift: [f64; 2]| {
        let there = |v: &&[f64; 2]| {
            let at = [v[0] + shift[0], v[1] + shift[1]];
            before.iter().any(|b| near(*b, at))
        };
        after.iter().filter(there).count()
    };
    let from = |a: [f64; 2]| (a[0] - last[0]).hypot(a[1] - last[1]);
    let pairs = (before.iter()).flat_map(|b| after.iter().map(|a| [b[0] - a[0], b[1] - a[1]]));
    let mut best = (hits(last), last);
    for shift in pairs {
        let hits = hits(shift);
        if hits > best.0 || (hits == best.0 && from(shift) < from(best.1)) {
            best = (hits, shift);
        }
    }
    best.1
}

/// What the file has: a simulation, a closed loop, an optimal trajectory, in this order.
fn motion(source: &Source<'_>) -> Result<Option<Motion>, String> {
    let n = source.model.states.len();
    let text = |e: costate::low_level::result::StoredError| e.to_string();
    let states = |t: &[f64], x: &[f64]| -> (Vec<f64>, Vec<Vec<f64>>) {
        (t.iter().zip(x.chunks(n)))
            .filter(|(t, x)| t.is_finite() && x.iter().all(|v| v.is_finite()))
            .map(|(t, x)| (*t, x.to_vec()))
            .unzip()
    };
    if let Some(group) = source.stored.group(&schema::SIMULATION_SAMPLES) {
        let (_, flights) = group.i32("flight").map_err(text)?;
        let (t, x) = (group.f64("t").map_err(text)?, group.f64("x").map_err(text)?);
        let count = flights.iter().take_while(|f| **f == 0).count();
        if count > 1 && x.values.len() == t.values.len() * n {
            let (t, x) = states(&t.values[..count], &x.values[..count * n]);
            let of = "The first flight of the simulation".to_owned();
            return Ok(Some(Motion { of, t, x }));
        }
    }
    if let Some(group) = source.stored.group(&schema::CLOSED_LOOP_TRAJECTORIES) {
        let (t, x) = (group.f64("t").map_err(text)?, group.f64("x").map_err(text)?);
        let laws = group.texts("law").map_err(text)?;
        if let (&[_, _, samples], Some(law)) = (t.shape.as_slice(), laws.first()) {
            let (t, x) = states(&t.values[..samples], &x.values[..samples * n]);
            let of = format!("The closed loop of law {law} from its first initial state");
            return Ok(Some(Motion { of, t, x }));
        }
    }
    let Some(swept) = source.trajectories()? else {
        return Ok(None);
    };
    let chosen = match swept.count {
        1..=20 => Some(0),
        _ => far_apart(source.model, swept, 1).first().copied(),
    };
    let Some(k) = chosen.filter(|_| swept.is_full()) else {
        return Ok(None);
    };
    let path = Flow::new(source.model, &source.stored.scene.hamiltonian).path(swept, k);
    let Some(begin) = path.first().map(|p| p.1) else {
        return Ok(None);
    };
    Ok(Some(Motion {
        of: format!("The optimal trajectory {k}"),
        t: path.iter().map(|p| p.1 - begin).collect(),
        x: path.into_iter().map(|p| p.2).collect(),
    }))
}

/// Figures at even times, their vertices between those that are known.
fn even(track: &[Still], count: usize) -> Vec<Still> {
    let (first, last) = (track[0].t, track[track.len() - 1].t);
    (0..count)
        .map(|k| {
            let t = first + (last - first) * k as f64 / (count - 1) as f64;
            let after = track
                .partition_point(|s| s.t <= t)
                .clamp(1, track.len() - 1);
            let (a, b) = (&track[after - 1], &track[after]);
            let share = match b.t > a.t {
                true => ((t - a.t) / (b.t - a.t)).clamp(0.0, 1.0),
                false => 1.0,
            };
            let between =
                |(a, b): (&[f64; 2], &[f64; 2])| [0, 1].map(|k| a[k] + share * (b[k] - a[k]));
            Still {
                t,
                vertices: a.vertices.iter().zip(&b.vertices).map(between).collect(),
            }
        })
        .collect()
}

/// The path of each end, cut where the time stands still.
fn paths(figure: &StickFigure, track: &[Still]) -> Vec<Vec<[f64; 2]>> {
    let phases: Vec<&[Still]> = track.chunk_by(|a, b| a.t < b.t).collect();
    (figure.ends.iter())
        .flat_map(|end| {
            let phase = |p: &&[Still]| p.iter().map(|s| s.vertices[*end]).collect();
            phases.iter().map(phase).collect::<Vec<_>>()
        })
        .collect()
}

/// Ranges of both coordinates.
fn extent(frames: &[Still]) -> [[f64; 2]; 2] {
    [0, 1].map(|k| {
        let all = frames
            .iter()
            .flat_map(|f| f.vertices.iter().map(move |v| v[k]));
        range(all).unwrap_or([0.0, 1.0])
    })
}

struct Figures {
    lines: Vec<[usize; 2]>,
    paths: Vec<Vec<[f64; 2]>>,
    frames: Vec<Still>,
    /// Of a figure that moves: for how many seconds, and its joints.
    moving: Option<(f64, Vec<usize>)>,
    axes: [String; 2],
    time: String,
}

impl Figures {
    /// Padded ranges in which both axes have the same scale, for an area of this shape.
    fn ranges(&self, tall: f64) -> [[f64; 2]; 2] {
        let own = extent(&self.frames);
        let of_paths = [0, 1].map(|k| range(self.paths.iter().flatten().map(|p| p[k])));
        let all = [0, 1].map(|k| match of_paths[k] {
            Some([lo, hi]) => [own[k][0].min(lo), own[k][1].max(hi)],
            None => own[k],
        });
        let widths = all.map(|[lo, hi]| 1.12 * (hi - lo));
        let width = widths[0].max(widths[1] / tall).max(1e-9);
        let wanted = [width, width * tall];
        [0, 1].map(|k| {
            let middle = 0.5 * (all[k][0] + all[k][1]);
            [middle - 0.5 * wanted[k], middle + 0.5 * wanted[k]]
        })
    }

    /// Height of the axes by their width.
    fn tall(&self) -> f64 {
        let [x, y] = extent(&self.frames).map(|[lo, hi]| hi - lo);
        (y / x.max(1e-9)).clamp(FLAT, TALL)
    }

    fn placed(&self, frame: &Frame, still: &Still) -> Vec<Vec<Point>> {
        let line =
            |[a, b]: &[usize; 2]| vec![frame.at(still.vertices[*a]), frame.at(still.vertices[*b])];
        self.lines.iter().map(line).collect()
    }
}

impl Drawing for Figures {
    fn height(&self, width: f64) -> f64 {
        self.tall() * width
    }

    fn draw(&self, canvas: &mut dyn Canvas, area: Rect) {
        let last = self.frames.len() - 1;
        let times = Axis::linear(self.time.clone(), [self.frames[0].t, self.frames[last].t]);
        // Yellow is too light for lines.
        let shade = |share: f64| colours::value(0.92 * share);
        let [from, to] = times.range;
        let bar = Bar {
            label: &self.time,
            axis: &times,
            bands: &[],
            colour: &|t| shade((t - from) / (to - from)),
        };
        let room = match self.moving {
            Some(_) => 0.0,
            None => bar.width(area.height()) + 16.0,
        };
        let outer = Rect::new(area.left, area.top, area.right - room, area.bottom);
        let [x, y] = self.ranges(outer.height() / outer.width());
        let [x_label, y_label] = self.axes.clone();
        let rough = Frame::within(
            outer,
            Axis::linear(x_label.clone(), x),
            Axis::linear(y_label.clone(), y),
        );
        let [x, y] = self.ranges(rough.area.height() / rough.area.width());
        let frame = Frame::around(
            rough.area,
            Axis::linear(x_label, x),
            Axis::linear(y_label, y),
        );
        frame.under(canvas);
        canvas.lines(
            &frame.lines(&self.paths),
            Stroke::new(Ink::Muted, 0.9).opacity(0.8),
        );
        match &self.moving {
            Some((seconds, joints)) => {
                let frames: Vec<Vec<Vec<Point>>> =
                    self.frames.iter().map(|f| self.placed(&frame, f)).collect();
                let ink = Ink::Colour(colours::class(0));
                canvas.moving(&frames, *seconds, Stroke::new(ink, 3.2));
                let dots: Vec<Vec<Vec<Point>>> = (self.frames.iter())
                    .map(|f| {
                        let dot = |k: &usize| vec![frame.at(f.vertices[*k])];
                        joints.iter().map(dot).collect()
                    })
                    .collect();
                canvas.moving(&dots, *seconds, Stroke::new(Ink::Text, 7.0));
            }
            None => {
                for (k, still) in self.frames.iter().enumerate() {
                    let share = k as f64 / last.max(1) as f64;
                    let ink = Ink::Colour(shade(share));
                    let width = if k == 0 || k == last { 2.8 } else { 1.5 };
                    canvas.lines(&self.placed(&frame, still), Stroke::new(ink, width));
                }
                bar.draw(
                    canvas,
                    area.right - room + 16.0,
                    rough.area.top,
                    rough.area.bottom,
                );
            }
        }
        frame.over(canvas);
    }
}
