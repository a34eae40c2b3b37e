//! How far extremals keep from the guards.

use super::tracks::{Track, TrackPoints};
use crate::backend::BackendError;
use crate::backend::cpu::Evaluator;
use crate::numeric::hermite::hermite;
use crate::program::Program;
use crate::shooting::{Path, Solver};
use crate::sweep::Plan;

/// Parts of a segment at whose ends guards are looked at.
pub(super) const PARTS: usize = 8;
/// Places of a track nearer to each other than this share of its length are one.
const SAME: f64 = 1e-9;
/// The end of a track counts where the margin there is above this share of the largest on it.
const AT_END: f64 = 1e-3;
/// Share of the largest margin that rounding may take a track outside by.
const ROUNDING: f64 = 1e-6;
/// Step of differences along a trajectory, in sizes of its states.
const STEP: f64 = 1e-7;
/// Steps to where a margin is least between places.
const HALVINGS: usize = 24;
/// (sqrt(5) - 1)/2.
const GOLDEN: f64 = 0.618_033_988_749_894_8;

/// How far a point's trajectory keeps from the guards.
#[derive(Clone, Copy, Debug)]
pub struct Clearance {
    /// The least margin from there to the end; infinite where it is not known.
    pub margin: f64,
    /// Whether that is yet to come: else a state has the least margin itself.
    pub ahead: bool,
}

impl Default for Clearance {
    fn default() -> Self {
        Self {
            margin: f64::INFINITY,
            ahead: false,
        }
    }
}

/// Margins of the guards along trajectories.
pub(super) struct Guards {
    margins: Evaluator,
    /// Of states and adjoints, backward in time.
    rates: Evaluator,
    pub count: usize,
    width: usize,
}

/// A place of a trajectory, with the margins of the guards.
struct Place {
    t: f64,
    node: Vec<f64>,
    margins: Vec<f64>,
    /// Number of the point that it is.
    point: Option<usize>,
}

impl Guards {
    /// `None` where there are none.
    pub fn of(plan: &Plan) -> Option<Self> {
        let system = &plan.system;
        let width = 2 * system.states;
        let margins: Vec<_> = system.guards.iter().map(|g| g.expr).collect();
        let evaluator =
            |outputs: &[_]| Evaluator::new(&Program::lower(&system.graph, &system.inputs, outputs));
        (!margins.is_empty()).then(|| Self {
            margins: evaluator(&margins),
            rates: evaluator(&system.rate[..width]),
            count: margins.len(),
            width,
        })
    }

    /// Margins `[node][guard]` at nodes `(s, p)`.
    pub fn margins(&self, nodes: &[f64]) -> Vec<f64> {
        self.margins.eval(nodes, self.width)
    }

    /// Their rates of change along trajectories, `[node][guard]`.
    pub fn slopes(&self, nodes: &[f64], margins: &[f64]) -> Vec<f64> {
        let rates = self.rates.eval(nodes, self.width);
        let size = |all: &[f64]| {
            all.iter()
                .fold(f64::MIN_POSITIVE, |size, x| x.abs().max(size))
        };
        let (nodes, rates) = (
            nodes.chunks_exact(self.width),
            rates.chunks_exact(self.width),
        );
        let steps: Vec<f64> = (nodes.clone().zip(rates.clone()))
            .map(|(node, rate)| STEP * size(node) / size(rate))
            .collect();
        let moved: Vec<f64> = (nodes.zip(rates).zip(&steps))
            .flat_map(|((node, rate), step)| {
                node.iter().zip(rate).map(move |(z, rate)| z - step * rate)
            })
            .collect();
        let moved = self.margins(&moved);
        (moved.iter().zip(margins).enumerate())
            .map(|(k, (moved, here))| (moved - here) / steps[k / self.count])
            .collect()
    }

    /// Time and least margin of a guard between places (time and node) of a trajectory, by cubics
    /// through these.
    pub fn least_between(&self, guard: usize, places: &[(f64, &[f64])]) -> [f64; 2] {
        let nodes: Vec<f64> = places
            .iter()
            .flat_map(|(_, node)| node.iter().copied())
            .collect();
        let slopes = self.rates.eval(&nodes, self.width);
        let margin = |t: f64| {
            let next = places[1..places.len() - 1].partition_point(|(at, _)| *at < t) + 1;
            let ((from, a), (to, b)) = (places[next - 1], places[next]);
            let slope = |place: usize, i: usize| -slopes[place * self.width + i];
            let node: Vec<f64> = (0..self.width)
                .map(|i| {
                    let ends = ([a[i], slope(next - 1, i)], [b[i], slope(next, i)]);
                    hermite((t - from) / (to - from), to - from, ends.0, ends.1)
                })
                .collect();
            self.margins(&node)[guard]
        };
        // Golden section.
        let (mut lo, mut hi) = (places[0].0, places[places.len() - 1].0);
        for _ in 0..HALVINGS {
            let (a, b) = (hi - GOLDEN * (hi - lo), lo + GOLDEN * (hi - lo));
            if margin(a) <= margin(b) {
                hi = b;
            } else {
                lo = a;
            }
        }
        let t = 0.5 * (lo + hi);
        [t, margin(t)]
    }

    /// Places of paths: their nodes, and some between them.
    fn along(&self, solver: &mut Solver, paths: &[&Path]) -> Result<Vec<Vec<Place>>, BackendError> {
        let between = solver.between_nodes(paths, PARTS)?;
        let one = |(path, between): (&&Path, &Vec<f64>)| {
            let (times, nodes) = samples(path, between);
            let margins = self.margins(&nodes);
            let each = nodes
                .chunks_exact(self.width)
                .zip(margins.chunks_exact(self.count));
            (times.into_iter().zip(each))
                .map(|(t, (node, margins))| Place {
                    t,
                    node: node.to_vec(),
                    margins: margins.to_vec(),
                    point: None,
                })
                .collect()
        };
        Ok(paths.iter().zip(&between).map(one).collect())
    }

    /// The least margin of a guard from each of some places on, which are in order.
    fn least_from(&self, guard: usize, places: &[Place]) -> Vec<Clearance> {
        let all: Vec<[f64; 2]> = places.iter().map(|p| [p.t, p.margins[guard]]).collect();
        // Of a guard that an equilibrium lies on the boundary of, the end tells nothing: all come
        // near.
        let end = all
            .last()
            .map(|at| at[1])
            .filter(|end| *end > AT_END * size_of(guard, places));
        least_from(
            &all,
            end.unwrap_or(f64::INFINITY),
            |three, [_, value], later| {
                // The parabola is not what the margin is, but about.
                let fall = all[three[1]][1] - value;
                (value - 2.0 * fall < later).then(|| {
                    let near = three.map(|k| (places[k].t, places[k].node.as_slice()));
                    self.least_between(guard, &near)
                })
            },
        )
    }
}

/// All samples of a path, `[sample][2n]`, with their times from its beginning: its nodes, and those
/// between them.
pub(super) fn samples(path: &Path, between: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let mut times = Vec::with_capacity(PARTS * path.segments() + 1);
    let mut nodes = Vec::with_capacity(path.nodes.len() + between.len());
    let mut t = 0.0;
    let between = between.chunks_exact((PARTS - 1) * path.width);
    for ((k, duration), between) in path.durations.iter().enumerate().zip(between) {
        times.extend((0..PARTS).map(|part| t + duration * part as f64 / PARTS as f64));
        nodes.extend_from_slice(path.node(k));
        nodes.extend_from_slice(between);
        t += duration;
    }
    times.push(t);
    nodes.extend_from_slice(path.last());
    (times, nodes)
}

/// The largest size of a guard's margins at places.
fn size_of(guard: usize, places: &[Place]) -> f64 {
    places
        .iter()
        .fold(0.0, |size, p| p.margins[guard].abs().max(size))
}

/// How far a path keeps from each guard: where the margin is negative the path leaves it by more
/// than rounding.
///
/// # Errors
/// Device failures only.
pub fn clearances(
    plan: &Plan,
    solver: &mut Solver,
    paths: &[&Path],
) -> Result<Vec<Vec<f64>>, BackendError> {
    let Some(guards) = Guards::of(plan).filter(|_| !paths.is_empty()) else {
        return Ok(vec![Vec::new(); paths.len()]);
    };
    let one = |places: &Vec<Place>| {
        let of = |guard: usize| {
            let least = guards
                .least_from(guard, places)
                .first()
                .map_or(f64::INFINITY, |c| c.margin);
            if least < -rounding(guard, places) {
                least
            } else {
                least.max(0.0)
            }
        };
        (0..guards.count).map(of).collect()
    };
    Ok(guards.along(solver, paths)?.iter().map(one).collect())
}

/// What rounding may take a margin below 0 by.
fn rounding(guard: usize, places: &[Place]) -> f64 {
    ROUNDING * size_of(guard, places)
}

/// Tells of points of tracks, numbered from `first` on, how far they keep from the guards that cast
/// shadows. Of each point whether the track leaves one of these: before a track's beginning it may.
///
/// # Errors
/// Device failures only.
pub fn tell(
    plan: &Plan,
    solver: &mut Solver,
    (tracks, first): (&[Track], u32),
    shadows: &[bool],
    points: &mut TrackPoints,
) -> Result<Vec<bool>, BackendError> {
    let mut outside = vec![false; points.len()];
    let Some(guards) = Guards::of(plan).filter(|_| shadows.contains(&true)) else {
        return Ok(outside);
    };
    let paths: Vec<&Path> = tracks.iter().map(|track| &track.path).collect();
    let mut of_track = guards.along(solver, &paths)?;
    let margins = guards.margins(&points.nodes);
    for (k, margins) in margins.chunks_exact(guards.count).enumerate() {
        let track = (points.track[k] - first) as usize;
        of_track[track].push(Place {
            t: points.t[k],
            node: points.node(k).to_vec(),
            margins: margins.to_vec(),
            point: Some(k),
        });
    }

    points.clearance = vec![Clearance::default(); points.len()];
    for mut places in of_track {
        places.sort_by(|a, b| a.t.total_cmp(&b.t));
        for guard in (0..guards.count).filter(|guard| shadows[*guard]) {
            let least = guards.least_from(guard, &places);
            let rounding = rounding(guard, &places);
            for (least, place) in least.into_iter().zip(&places) {
                let Some(k) = place.point else { continue };
                // Of what was solved for it is known that it stays inside.
                outside[k] |= points.t[k] < 0.0 && least.margin < -rounding;
                if least.margin < points.clearance[k].margin {
                    points.clearance[k] = least;
                }
            }
        }
    }
    Ok(outside)
}

/// The least value from each of some places (time, value) on, which are in order, with what counts
/// as the value at the end. Where it may be least between three of them `refine` gives time and
/// value by their numbers, the vertex of the parabola through them, and the least value that comes
/// later.
fn least_from(
    all: &[[f64; 2]],
    end: f64,
    refine: impl Fn([usize; 3], [f64; 2], f64) -> Option<[f64; 2]>,
) -> Vec<Clearance> {
    let same = match all {
        [first, .., last] => SAME * (last[0] - first[0]),
        _ => 0.0,
    };
    let mut apart: Vec<usize> = Vec::with_capacity(all.len());
    let mut of = Vec::with_capacity(all.len());
    for (k, at) in all.iter().enumerate() {
        if apart.last().is_none_or(|last| at[0] - all[*last][0] > same) {
            apart.push(k);
        }
        of.push(apart.len() - 1);
    }
    let mut from = vec![Clearance::default(); apart.len()];
    // Of what comes later.
    let mut least = end;
    for k in (0..apart.len()).rev() {
        let here = all[apart[k]];
        let inner = k > 0 && k + 1 < apart.len();
        let lowest = inner
            .then(|| [apart[k - 1], apart[k], apart[k + 1]])
            .and_then(|three| {
                let vertex = vertex(three.map(|k| all[k]))?;
                refine(three, vertex, least.min(here[1]))
            });
        let after = lowest.filter(|[t, _]| *t >= here[0]);
        least = after.map_or(least, |[_, value]| least.min(value));
        from[k] = Clearance {
            margin: least.min(here[1]),
            ahead: least < here[1],
        };
        // A minimum next to the place counts as one from before it on.
        least = lowest.map_or(least, |[_, value]| least.min(value));
    }
    of.into_iter().map(|k| from[k]).collect()
}

/// Where a parabola through three places is least, if the middle one is not above the others.
fn vertex([a, b, c]: [[f64; 2]; 3]) -> Option<[f64; 2]> {
    if b[1] > a[1] || b[1] > c[1] {
        return None;
    }
    let (left, right) = (a[0] - b[0], c[0] - b[0]);
    // b + slope t + bend t^2 through the other two.
    let (rise, fall) = ((c[1] - b[1]) / right, (a[1] - b[1]) / left);
    let bend = (rise - fall) / (right - left);
    let slope = rise - bend * right;
    (bend > 0.0).then(|| {
        [
            b[0] - 0.5 * slope / bend,
            b[1] - 0.25 * slope * slope / bend,
        ]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn least_values_from_places_on() {
        let square = |t: f64| (t - 1.3) * (t - 1.3) + 0.25;
        let all: Vec<[f64; 2]> = [0.0, 0.7, 1.0, 1.0, 1.9, 2.5]
            .map(|t| [t, square(t)])
            .to_vec();
        let least = least_from(&all, f64::INFINITY, |_, vertex, _| Some(vertex));
        for least in &least[..4] {
            assert!(
                (least.margin - 0.25).abs() < 1e-14 && least.ahead,
                "{least:?}"
            );
        }
        for k in 4..6 {
            assert!(
                least[k].margin == all[k][1] && !least[k].ahead,
                "{:?}",
                least[k]
            );
        }
        // What falls to its end, which counts or not, and one place alone.
        let falling = [[0.0, 3.0], [1.0, 2.0], [2.0, 1.0]];
        let margins = |end: f64| -> Vec<f64> {
            let least = least_from(&falling, end, |_, _, _| None);
            least.iter().map(|c| c.margin).collect()
        };
        assert_eq!(margins(1.0), [1.0; 3]);
        assert_eq!(margins(f64::INFINITY), [3.0, 2.0, 1.0]);
        assert_eq!(
            least_from(&[[0.0, 3.0]], 3.0, |_, _, _| None)[0].margin,
            3.0
        );
    }
}
