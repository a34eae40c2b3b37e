//! The smallest level of attenuation: coverage against the level, and regions of validity.

use super::Made;
use super::phase::FOLD;
use crate::canvas::{Canvas, Dash, Ink, Rect, Stroke};
use crate::contour::{self, Grid};
use crate::frame::{Axis, Frame, Legend, Mark, dashed, range};
use crate::ticks::significant;
use crate::{Drawing, Picture, Source, colours, names};
use costate::low_level::result::{StoredError, StoredGroup};
use costate::low_level::schema;
use costate::low_level::value::PointStatus;

/// From this ratio of the largest value to the smallest on, the axis of values is logarithmic.
const DECADE: f64 = 8.0;

fn scalar(group: &StoredGroup<'_>, name: &str) -> Result<f64, StoredError> {
    Ok(group.f64(name)?.values.first().copied().unwrap_or(f64::NAN))
}

/// What the file says of the smallest level, in a line; `None` without.
pub fn key_figure(source: &Source<'_>) -> Option<String> {
    let group = source.stored.group(&schema::ATTENUATION)?;
    let name = names::symbol(&group.attribute(None, "parameter")?);
    let (star, smallest) = (
        scalar(&group, "star").ok()?,
        scalar(&group, "smallest_covering").ok()?,
    );
    let covers = if smallest.is_finite() {
        format!(
            "the states are covered from {name} = {} on",
            significant(smallest, 6)
        )
    } else {
        "the states are not covered at any level looked at".to_owned()
    };
    Some(format!(
        "{name}* = {} of the linearization; {covers}",
        significant(star, 5)
    ))
}

struct Coverage {
    name: String,
    /// Level and percentage, rising.
    curve: Vec<[f64; 2]>,
    /// Levels to be marked: how, and what is said of them.
    marks: Vec<(f64, Stroke, String)>,
}

/// Coverage against the level.
pub fn coverage(source: &Source<'_>) -> Made {
    let Some(group) = source.stored.group(&schema::ATTENUATION) else {
        return Ok(None);
    };
    let coverage = read_coverage(&group).map_err(|e| e.to_string())?;
    let name = &coverage.name;
    Ok(Some(Picture {
        name: "coverage".to_owned(),
        title: format!("Share of the states with a valid value function against {name}"),
        caption: format!(
            "Each dot is a level of attenuation at which all states were solved for. Below {name}* the linearization has no \
             solution at all; at the smallest covering level and the higher ones looked at V is valid at every one of the states."
        ),
        drawing: Box::new(coverage),
    }))
}

fn read_coverage(group: &StoredGroup<'_>) -> Result<Coverage, StoredError> {
    let name = names::symbol(&group.attribute(None, "parameter").unwrap_or_default());
    let (values, coverage) = (group.f64("value")?.values, group.f64("coverage")?.values);
    let mut marks = Vec::new();
    let thick = |k: usize, dash: Dash| Stroke::new(Ink::Colour(colours::class(k)), 2.0).dash(dash);
    let said = [
        (
            "star",
            format!("{name}* of the linearization"),
            thick(1, Dash::Dashed),
        ),
        (
            "smallest_covering",
            "smallest that covers".to_owned(),
            thick(2, Dash::Solid),
        ),
        ("own", "the scene's own".to_owned(), thick(6, Dash::Dotted)),
    ];
    for (variable, words, stroke) in said {
        let value = scalar(group, variable)?;
        if value.is_finite() {
            marks.push((value, stroke, format!("{words}: {}", significant(value, 5))));
        }
    }
    Ok(Coverage {
        name,
        curve: values
            .iter()
            .zip(&coverage)
            .map(|(v, c)| [*v, 100.0 * c])
            .collect(),
        marks,
    })
}

impl Coverage {
    fn legend(&self) -> Vec<(Mark, String)> {
        let curve = Mark::Dot(Ink::Colour(colours::class(0)));
        let marks = self
            .marks
            .iter()
            .map(|(_, stroke, words)| (Mark::Line(*stroke), words.clone()));
        std::iter::once((curve, "solved".to_owned()))
            .chain(marks)
            .collect()
    }
}

impl Drawing for Coverage {
    fn height(&self, width: f64) -> f64 {
        let legend = self.legend();
        (0.5 * width).clamp(300.0, 560.0) + Legend { entries: &legend }.height(width)
    }

    fn draw(&self, canvas: &mut dyn Canvas, area: Rect) {
        let entries = self.legend();
        let legend = Legend { entries: &entries };
        legend.draw(canvas, [area.left, area.top], area.width());
        let top = area.top + legend.height(area.width());
        let values = self.curve.iter().map(|p| p[0]);
        let [from, to] = range(values.chain(self.marks.iter().map(|m| m.0))).unwrap_or([1.0, 2.0]);
        let label = format!("level of attenuation {}", self.name);
        let x = if to / from > DECADE {
            Axis::log(label, [from, to])
        } else {
            Axis::linear(label, [from, to])
        };
        let [least, _] = range(self.curve.iter().map(|p| p[1])).unwrap_or([0.0, 100.0]);
        // What happens among the last percents is to be seen, too.
        let least = if least > 60.0 {
            (least / 10.0).floor() * 10.0
        } else {
            0.0
        };
        let y = Axis::linear("states covered (%)", [least.min(90.0), 100.0]).padded(0.04);
        let frame = Frame::within(
            Rect::new(area.left, top, area.right, area.bottom),
            x.padded(0.03),
            y,
        );
        frame.under(canvas);
        let [bottom, head] = frame.y.range;
        for (value, stroke, _) in &self.marks {
            canvas.lines(&frame.line(&[[*value, bottom], [*value, head]]), *stroke);
        }
        let ink = Ink::Colour(colours::class(0));
        canvas.lines(&frame.line(&self.curve), Stroke::new(ink, 1.6));
        canvas.dots(&frame.dots(self.curve.iter().copied()), 7.0, ink, 1.0);
        frame.over(canvas);
    }
}

/// One level's states.
struct Region {
    colour: colours::Rgb,
    label: String,
    /// 1 where valid, over the plane; V along the axis where there is but one.
    values: Vec<f64>,
    /// Where trajectories meet folds.
    folds: Vec<[f64; 2]>,
}

struct Validity {
    axes: Vec<Vec<f64>>,
    labels: Vec<String>,
    /// By falling level: each region lies over the larger ones.
    regions: Vec<Region>,
    rest: Option<[f64; 2]>,
    folds: bool,
}

/// Regions of validity of some levels over a plane of two states; V along one state where that is
/// all there is.
pub fn validity(source: &Source<'_>) -> Made {
    let Some(group) = source.stored.group(&schema::ATTENUATION_REGIONS) else {
        return Ok(None);
    };
    let read = read_validity(source, &group).map_err(|e| e.to_string())?;
    let Some((validity, fixed)) = read else {
        return Ok(None);
    };
    let name = names::symbol(&group.attribute(None, "parameter").unwrap_or_default());
    let plane = validity.axes.len() == 2;
    let mut caption = if plane {
        format!(
            "At each level {name} the value function is valid at the states of the region of its colour (drawn to half-way to the next state); the smaller region lies over the larger ones."
        )
    } else {
        format!("The value function at each level {name}, as far as it is valid.")
    };
    if plane && validity.folds {
        caption += " Dots: where trajectories of the sweep meet a fold, beyond which no smooth solution goes on.";
    }
    Ok(Some(Picture {
        name: "validity".to_owned(),
        title: format!("Where the value function is valid, by level of attenuation{fixed}"),
        caption,
        drawing: Box::new(validity),
    }))
}

/// The drawing, and what the title says of states that are held fixed.
fn read_validity(
    source: &Source<'_>,
    group: &StoredGroup<'_>,
) -> Result<Option<(Validity, String)>, StoredError> {
    let states = &source.model.states;
    let grid: Vec<Vec<f64>> = (states.iter())
        .map(|s| group.f64(&s.variable.name).map(|a| a.values))
        .collect::<Result<_, _>>()?;
    let answers = Answers {
        levels: group.f64("level")?.values,
        status: group.i32("status")?.1,
        v: group.f64("V")?.values,
    };
    let Some(cut) = Cut::find(source, grid) else {
        return Ok(None);
    };
    let folds = folds(source, states.len())?;
    let parameter = names::symbol(&group.attribute(None, "parameter").unwrap_or_default());
    let levels = 0..answers.levels.len();
    let regions: Vec<Region> = (levels.rev())
        .map(|k| answers.region(k, &cut, &folds, &parameter))
        .collect();
    let reference = source.model.reference();
    let validity = Validity {
        axes: cut.shown.iter().map(|k| cut.grid[*k].clone()).collect(),
        labels: (cut.shown.iter())
            .map(|k| names::label(&states[*k].variable))
            .collect(),
        folds: regions.iter().any(|r| !r.folds.is_empty()),
        regions,
        rest: match cut.shown.as_slice() {
            [a, b] => Some([reference[*a], reference[*b]]),
            _ => None,
        },
    };
    Ok(Some((validity, cut.fixed(source))))
}

/// The part of the grid of states that is shown: a line, or a plane.
struct Cut {
    grid: Vec<Vec<f64>>,
    /// The one or two states along the axes.
    shown: Vec<usize>,
    /// The node of each state that is held fixed.
    at: Vec<usize>,
}

impl Cut {
    /// Along the report's axes where these are more than one node long; the others at the grid's
    /// value nearest to the report's.
    fn find(source: &Source<'_>, grid: Vec<Vec<f64>>) -> Option<Self> {
        let n = grid.len();
        let long = |k: &usize| grid[*k].len() > 1;
        let mut shown: Vec<usize> = source.axes.iter().copied().filter(long).collect();
        shown.dedup();
        if shown.len() < 2 {
            shown = (0..n).filter(long).take(2).collect();
        }
        if shown.is_empty() {
            return None;
        }
        let near = |k: usize| {
            let distance = |i: &usize| (grid[k][*i] - source.base[k]).abs();
            (0..grid[k].len())
                .min_by(|a, b| distance(a).total_cmp(&distance(b)))
                .unwrap_or(0)
        };
        let at = (0..n).map(near).collect();
        Some(Self { grid, shown, at })
    }

    /// The states that it holds fixed, in words.
    fn fixed(&self, source: &Source<'_>) -> String {
        let fixed = names::held(&source.model.states, &self.shown, |k| {
            self.grid[k][self.at[k]]
        });
        names::at(&fixed)
    }

    /// Nodes of the whole grid.
    fn count(&self) -> usize {
        self.grid.iter().map(Vec::len).product()
    }

    /// Its nodes among those of the grid, by the first axis, then by the second.
    fn nodes(&self) -> Vec<usize> {
        let mut at = self.at.clone();
        let mut nodes = Vec::new();
        let inner = self.shown.get(1).map_or(1, |b| self.grid[*b].len());
        for i in 0..self.grid[self.shown[0]].len() {
            for j in 0..inner {
                at[self.shown[0]] = i;
                if let Some(b) = self.shown.get(1) {
                    at[*b] = j;
                }
                let place = at
                    .iter()
                    .zip(&self.grid)
                    .fold(0, |place, (i, axis)| place * axis.len() + i);
                nodes.push(place);
            }
        }
        nodes
    }
}

/// What was found at the grid's nodes, level by level.
struct Answers {
    levels: Vec<f64>,
    status: Vec<i32>,
    v: Vec<f64>,
}

impl Answers {
    /// The region of the `k`-th level; `folds`: level and state of each.
    fn region(&self, k: usize, cut: &Cut, folds: &[(usize, Vec<f64>)], parameter: &str) -> Region {
        let count = cut.count();
        let status = &self.status[k * count..][..count];
        let v = &self.v[k * count..][..count];
        let is_valid = |status: i32| status == PointStatus::Converged as i32;
        let values = (cut.nodes().into_iter()).map(|place| match cut.shown.len() {
            2 => f64::from(u8::from(is_valid(status[place]))),
            _ => v[place],
        });
        let valid = status.iter().filter(|s| is_valid(**s)).count();
        let wanted = status
            .iter()
            .filter(|s| **s != PointStatus::OutsideGuard as i32)
            .count();
        let share = significant(100.0 * valid as f64 / wanted.max(1) as f64, 3);
        let levels = self.levels.len();
        let [a, b] = [cut.shown[0], cut.shown[cut.shown.len() - 1]];
        Region {
            // Dark is hard to reach: the smallest level.
            colour: colours::value(0.12 + 0.8 * (k + 1) as f64 / (levels + 1) as f64),
            label: format!(
                "{parameter} = {}: {share} % of the states",
                significant(self.levels[k], 4)
            ),
            values: values.collect(),
            // Others' folds are not on the plane.
            folds: (folds.iter().filter(|(l, _)| *l == k && cut.at.len() == 2))
                .map(|(_, x)| [x[a], x[b]])
                .collect(),
        }
    }
}

/// Level and state of each fold.
fn folds(source: &Source<'_>, n: usize) -> Result<Vec<(usize, Vec<f64>)>, StoredError> {
    let Some(group) = source.stored.group(&schema::ATTENUATION_CAUSTIC) else {
        return Ok(Vec::new());
    };
    let (level, x) = (group.i32("level_index")?.1, group.f64("x")?.values);
    Ok((level.iter().zip(x.chunks(n)))
        .map(|(l, x)| (*l as usize, x.to_vec()))
        .collect())
}

impl Validity {
    fn legend(&self) -> Vec<(Mark, String)> {
        let line = |r: &Region| {
            (
                Mark::Line(Stroke::new(Ink::Colour(r.colour), 9.0)),
                r.label.clone(),
            )
        };
        let mut all: Vec<(Mark, String)> = self.regions.iter().rev().map(line).collect();
        if self.folds && self.axes.len() == 2 {
            all.push((Mark::Dot(FOLD), "folds met".to_owned()));
        }
        all
    }

    fn plane(&self, canvas: &mut dyn Canvas, frame: &Frame) {
        for region in &self.regions {
            let grid = Grid {
                x: &self.axes[0],
                y: &self.axes[1],
                values: &region.values,
                cut: &[],
            };
            let rings: Vec<_> = contour::region(&grid, 0.5)
                .iter()
                .map(|r| frame.ring(r))
                .collect();
            canvas.area(&rings, Ink::Colour(region.colour), 0.85);
            let edges: Vec<_> = contour::lines(&grid, 0.5)
                .into_iter()
                .map(|l| l.points)
                .collect();
            canvas.lines(&frame.lines(&edges), Stroke::new(Ink::Paper, 1.4));
        }
        for region in &self.regions {
            let dots = frame.dots(region.folds.iter().copied());
            canvas.dots(&dots, 4.4, Ink::Colour([255, 255, 255]), 1.0);
            canvas.dots(&dots, 3.0, FOLD, 1.0);
        }
        if let Some(rest) = self.rest {
            let dots = frame.dots([rest]);
            canvas.dots(&dots, 9.0, Ink::Colour([255, 255, 255]), 1.0);
            canvas.dots(&dots, 6.0, Ink::Colour([20, 20, 20]), 1.0);
        }
    }

    fn line(&self, canvas: &mut dyn Canvas, frame: &Frame) {
        let x = &self.axes[0];
        for region in &self.regions {
            let line: Vec<[f64; 2]> = x
                .iter()
                .zip(&region.values)
                .map(|(x, v)| [*x, *v])
                .collect();
            let ink = Ink::Colour(region.colour);
            canvas.lines(&frame.line(&line), Stroke::new(ink, 2.2));
            // Where it ends short of the axis's end.
            let finite = |k: usize| region.values.get(k).is_some_and(|v| v.is_finite());
            let ends = (0..x.len())
                .filter(|k| finite(*k) && (!finite(k.wrapping_sub(1)) || !finite(k + 1)));
            let ends = ends.filter(|k| *k > 0 && k + 1 < x.len()).map(|k| line[k]);
            canvas.dots(&frame.dots(ends), 7.0, ink, 1.0);
        }
    }
}

impl Drawing for Validity {
    fn height(&self, width: f64) -> f64 {
        let legend = self.legend();
        (0.6 * width).clamp(320.0, 640.0) + Legend { entries: &legend }.height(width)
    }

    fn draw(&self, canvas: &mut dyn Canvas, area: Rect) {
        let entries = self.legend();
        let legend = Legend { entries: &entries };
        legend.draw(canvas, [area.left, area.top], area.width());
        let top = area.top + legend.height(area.width());
        let outer = Rect::new(area.left, top, area.right, area.bottom);
        let ends = |v: &[f64]| [v[0], v[v.len() - 1]];
        let x = Axis::linear(self.labels[0].clone(), ends(&self.axes[0]));
        let plane = self.axes.len() == 2;
        let y = if plane {
            Axis::linear(self.labels[1].clone(), ends(&self.axes[1]))
        } else {
            let values = self.regions.iter().flat_map(|r| r.values.iter().copied());
            Axis::linear("V", range(values).unwrap_or([0.0, 1.0])).padded(0.03)
        };
        let frame = Frame::within(outer, x, y);
        frame.under(canvas);
        if plane {
            self.plane(canvas, &frame);
            if let Some([x0, y0]) = self.rest {
                let [left, right] = frame.x.range;
                let [bottom, head] = frame.y.range;
                let cross = [[[x0, bottom], [x0, head]], [[left, y0], [right, y0]]];
                for line in cross {
                    canvas.lines(&frame.line(&line), dashed(Ink::Muted).opacity(0.35));
                }
            }
        } else {
            self.line(canvas, &frame);
        }
        frame.over(canvas);
    }
}
