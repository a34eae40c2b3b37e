//! Least, largest and last values of recorded quantities along trajectories.
//!
//! Samples alone would see an extremum only to the second order in their distance. Where the
//! quantity's slope changes sign between two samples, or the cubic through values and slopes has an
//! extremum there, the trajectory is integrated again from the sample before to the estimated time,
//! and once more from what is seen then. Values are of points of the trajectory in any case, so
//! that they are as accurate as the integration; what is missed is the second order in the error of
//! a time that is itself of high order. Kinks of the quantity are met by the intersection of
//! tangents, from ever nearer points on both sides, and looked for where an argument of min, max or
//! abs changes its sign.

use super::equations::Equations;
use crate::backend::cpu::Evaluator;
use crate::backend::{BackendError, Kernel, Run, Status};
use crate::model::{Extremum, Record};
use rayon::prelude::*;
use std::ops::Range;

/// Places looked at a trajectory and quantity, and how often each at most.
const MOST_PLACES: usize = 4;
const ROUNDS: usize = 5;
/// Kinks looked for a trajectory.
const MOST_CROSSINGS: usize = 64;
/// A place is done where no more than this share of the tolerance can be gained.
const GAIN: f64 = 0.1;
/// Points on both sides of a kink are taken at this share of the bracket.
const ASIDE: f64 = 1.0 / 32.0;
/// A slope of this share of those around says that the quantity is smooth there.
const FLAT: f64 = 0.1;

/// Value and time derivative.
type Point = (f64, f64);

/// A stretch of a trajectory in which an extremum may lie.
#[derive(Clone, Debug)]
struct Place {
    /// The integrated vector at its beginning.
    from: Vec<f64>,
    /// Times since then between which the extremum is, with the quantity there.
    bracket: [(f64, Point); 2],
    /// What the quantity may reach.
    promise: f64,
    /// Size of the quantity around.
    size: f64,
    /// The largest slope at the ends of the first bracket.
    slope: f64,
    /// The flattest slope seen inside.
    flattest: f64,
}

/// What is known of one quantity along one trajectory; maxima with the opposite sign, so that all
/// are minima.
#[derive(Clone, Debug)]
struct Track {
    best: f64,
    places: Vec<Place>,
    last: f64,
    /// Whether the quantity was no number somewhere on the way: then it has no extremum.
    undefined: bool,
}

/// Where an argument of min, max or abs in a recorded expression changes its sign: there the
/// quantity has a kink, and two of them between samples may hide an extremum from the slopes at
/// these.
#[derive(Clone, Debug)]
struct Crossing {
    /// The integrated vector at the stretch's beginning.
    from: Vec<f64>,
    /// Place of the argument in the observer's rows.
    column: usize,
    /// Times since then, and the argument there (halved where an end stays, the Illinois method).
    bracket: [(f64, f64); 2],
    /// Which end the last step replaced.
    replaced: Option<usize>,
    /// The argument's size in the beginning.
    size: f64,
    done: bool,
}

/// The records of one trajectory.
pub(super) struct View<'r> {
    kinds: &'r [Extremum],
    switches: &'r Range<usize>,
    tracks: &'r mut [Track],
    crossings: &'r mut Vec<Crossing>,
}

impl View<'_> {
    /// A stretch of the trajectory, `length` long, from the vector `from`; `ends` are the records'
    /// values and slopes (and what else the evaluator gives) at its ends.
    pub fn see(&mut self, length: f64, from: &[f64], ends: [&[f64]; 2]) {
        for column in self.switches.clone() {
            let [a, b] = ends.map(|e| e[column]);
            if (a < 0.0 && b > 0.0 || a > 0.0 && b < 0.0) && self.crossings.len() < MOST_CROSSINGS {
                self.crossings.push(Crossing {
                    from: from.to_vec(),
                    column,
                    bracket: [(0.0, a), (length, b)],
                    replaced: None,
                    size: a.abs().max(b.abs()),
                    done: false,
                });
            }
        }
        for (k, (kind, track)) in self.kinds.iter().zip(self.tracks.iter_mut()).enumerate() {
            let sign = sign(*kind);
            let [a, b] = ends.map(|e| (sign * e[2 * k], sign * e[2 * k + 1]));
            track.last = sign * b.0;
            track.undefined |= a.0.is_nan() || b.0.is_nan();
            if *kind == Extremum::Final {
                continue;
            }
            track.best = track.best.min(a.0).min(b.0);
            let Some(promise) = guess(a, b, length).filter(|p| *p < track.best) else {
                continue;
            };
            track.places.retain(|p| p.promise < track.best);
            if track.places.len() >= 4 * MOST_PLACES {
                track.keep_best();
            }
            track.places.push(Place {
                from: from.to_vec(),
                bracket: [(0.0, a), (length, b)],
                promise,
                size: a.0.abs().max(b.0.abs()),
                slope: a.1.abs().max(b.1.abs()),
                flattest: f64::INFINITY,
            });
        }
    }
}

/// The records of a batch of trajectories.
pub(super) struct Records {
    kinds: Vec<Extremum>,
    switches: Range<usize>,
    tracks: Vec<Track>,
    /// One list a trajectory.
    crossings: Vec<Vec<Crossing>>,
}

/// A point of a trajectory that is asked for.
enum Asked {
    Place { track: usize, place: usize },
    Crossing { trajectory: usize, crossing: usize },
}

impl Records {
    /// `switches`: which columns of the observer's rows are the arguments at whose zeros records
    /// have kinks.
    pub fn new(records: &[Record], switches: Range<usize>, trajectories: usize) -> Self {
        let track = Track {
            best: f64::INFINITY,
            places: Vec::new(),
            last: f64::NAN,
            undefined: false,
        };
        Self {
            kinds: records.iter().map(|r| r.extremum).collect(),
            tracks: vec![track; trajectories * records.len()],
            crossings: vec![Vec::new(); trajectories],
            switches,
        }
    }

    /// Adds those of the trajectories that follow.
    pub fn append(&mut self, other: Self) {
        self.tracks.extend(other.tracks);
        self.crossings.extend(other.crossings);
    }

    /// Gives each trajectory's records, in parallel, to `look` with the trajectory's index.
    pub fn each(&mut self, look: impl Fn(usize, &mut View<'_>) + Sync) {
        let (kinds, switches) = (&self.kinds, &self.switches);
        if kinds.is_empty() {
            return;
        }
        let all = self
            .tracks
            .par_chunks_mut(kinds.len())
            .zip(&mut self.crossings);
        all.enumerate().for_each(|(i, (tracks, crossings))| {
            let mut view = View {
                kinds,
                switches,
                tracks,
                crossings,
            };
            look(i, &mut view);
        });
    }

    /// Looks for the extrema between samples. `kernel` integrates [`Equations::scaled`].
    ///
    /// # Errors
    /// Device failures only.
    pub fn refine(
        &mut self,
        scaled: &Equations,
        kernel: &mut dyn Kernel,
        run: &Run,
        evaluator: &Evaluator,
    ) -> Result<(), BackendError> {
        for track in &mut self.tracks {
            track.places.retain(|p| p.promise < track.best);
            track.keep_best();
        }
        for _ in 0..ROUNDS {
            for track in &mut self.tracks {
                track
                    .places
                    .retain(|p| p.promise < track.best - GAIN * run.rtol * p.size);
            }
            let (asked, seeds) = self.ask();
            if asked.is_empty() {
                return Ok(());
            }
            let ended = kernel.integrate(run, &seeds)?;
            let values = evaluator.eval(&ended.end, scaled.dim());
            let width = values.len() / asked.len();
            let rows: Vec<Option<&[f64]>> = (values.chunks_exact(width).zip(&ended.status))
                .map(|(row, status)| (*status == Status::Reached).then_some(row))
                .collect();
            self.answer(&asked, &rows, run.rtol);
        }
        Ok(())
    }

    /// Points to look at, with the times since their stretch's beginning, and the seeds that lead
    /// there.
    fn ask(&self) -> (Vec<(Asked, f64)>, Vec<f64>) {
        let (mut asked, mut seeds) = (Vec::new(), Vec::new());
        let mut seed = |from: &[f64], time: f64| {
            // T stands before J.
            let (vector, cost) = from.split_at(from.len() - 1);
            seeds.extend_from_slice(vector);
            seeds.push(time);
            seeds.extend_from_slice(cost);
        };
        for (t, track) in self.tracks.iter().enumerate() {
            for (p, place) in track.places.iter().enumerate() {
                for time in place.times() {
                    asked.push((Asked::Place { track: t, place: p }, time));
                    seed(&place.from, time);
                }
            }
        }
        for (i, crossings) in self.crossings.iter().enumerate() {
            for (c, crossing) in crossings.iter().enumerate().filter(|(_, c)| !c.done) {
                let [(t0, a), (t1, b)] = crossing.bracket;
                let time = (t0 * b - t1 * a) / (b - a);
                let what = Asked::Crossing {
                    trajectory: i,
                    crossing: c,
                };
                asked.push((what, time));
                seed(&crossing.from, time);
            }
        }
        (asked, seeds)
    }

    /// Takes in what was seen: the observer's rows, none where the point was not reached.
    fn answer(&mut self, asked: &[(Asked, f64)], rows: &[Option<&[f64]>], rtol: f64) {
        let count = self.kinds.len();
        let mut seen: Vec<Vec<Vec<(f64, Point)>>> = (self.tracks.iter())
            .map(|t| t.places.iter().map(|p| p.bracket.to_vec()).collect())
            .collect();
        for ((what, time), row) in asked.iter().zip(rows) {
            let row = row.unwrap_or_default();
            match *what {
                Asked::Place { track, place } if !row.is_empty() => {
                    let (k, all) = (track % count, &mut self.tracks[track]);
                    let sign = sign(self.kinds[k]);
                    let point = (sign * row[2 * k], sign * row[2 * k + 1]);
                    if !point.0.is_nan() && !point.1.is_nan() {
                        all.best = all.best.min(point.0);
                        seen[track][place].push((*time, point));
                    }
                }
                Asked::Crossing {
                    trajectory,
                    crossing,
                } => {
                    let crossing = &mut self.crossings[trajectory][crossing];
                    crossing.narrow(
                        *time,
                        row.get(crossing.column).copied().unwrap_or(f64::NAN),
                        rtol,
                    );
                    for (k, kind) in self.kinds.iter().enumerate().filter(|_| !row.is_empty()) {
                        // `min` leaves NaN out.
                        let track = &mut self.tracks[trajectory * count + k];
                        track.best = track.best.min(sign(*kind) * row[2 * k]);
                    }
                }
                Asked::Place { .. } => {}
            }
        }
        for (track, seen) in self.tracks.iter_mut().zip(seen) {
            for (place, points) in track.places.iter_mut().zip(seen) {
                place.narrow(points);
            }
        }
    }

    /// `[trajectory][record]`: the values; NaN where nothing was seen.
    pub fn values(&self) -> Vec<f64> {
        let count = self.kinds.len().max(1);
        (self.tracks.iter().enumerate())
            .map(|(t, track)| match self.kinds[t % count] {
                Extremum::Final => track.last,
                kind if track.best.is_finite() && !track.undefined => sign(kind) * track.best,
                _ => f64::NAN,
            })
            .collect()
    }
}

fn sign(kind: Extremum) -> f64 {
    if kind == Extremum::Max { -1.0 } else { 1.0 }
}

impl Crossing {
    /// One step of the Illinois method.
    fn narrow(&mut self, time: f64, value: f64, rtol: f64) {
        let side = usize::from((value < 0.0) != (self.bracket[0].1 < 0.0));
        self.bracket[side] = (time, value);
        if self.replaced == Some(side) {
            self.bracket[1 - side].1 *= 0.5;
        }
        self.replaced = Some(side);
        self.done = value.is_nan() || value.abs() <= GAIN * rtol * self.size;
    }
}

impl Track {
    fn keep_best(&mut self) {
        self.places.sort_by(|a, b| a.promise.total_cmp(&b.promise));
        self.places.truncate(MOST_PLACES);
    }
}

impl Place {
    /// Times at which the extremum may be, estimated from the bracket: at first for want of knowing
    /// better as of a smooth quantity and as of one with a kink.
    fn times(&self) -> Vec<f64> {
        let [(start, a), (end, b)] = self.bracket;
        let length = end - start;
        let new = self.flattest == f64::INFINITY;
        let smooth = self.smooth();
        let mut estimates = Vec::with_capacity(4);
        if new || smooth {
            estimates.extend(cubic_minimum(a, b, length));
        }
        if !smooth && let Some(t) = crossing(a, b, length) {
            estimates.push(t);
            if !new {
                estimates.extend([t - ASIDE * length, t + ASIDE * length]);
            }
        }
        estimates.retain(|t| *t > 0.0 && *t < length);
        estimates.into_iter().map(|t| start + t).collect()
    }

    /// Whether a slope much flatter than those around has been seen.
    fn smooth(&self) -> bool {
        self.flattest <= FLAT * self.slope
    }

    /// The neighbours of the lowest point seen between which the slope changes sign.
    fn narrow(&mut self, mut points: Vec<(f64, Point)>) {
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        let lowest = (0..points.len())
            .min_by(|a, b| points[*a].1.0.total_cmp(&points[*b].1.0))
            .unwrap_or(0);
        let side = if points[lowest].1.1 < 0.0 {
            lowest
        } else {
            lowest.saturating_sub(1)
        };
        let Some(&[a, b]) = points.get(side..side + 2) else {
            return;
        };
        let inside = points
            .iter()
            .filter(|p| p.0 > self.bracket[0].0 && p.0 < self.bracket[1].0);
        self.flattest = inside.map(|p| p.1.1.abs()).fold(self.flattest, f64::min);
        self.bracket = [a, b];
        let promise = if self.smooth() { promise } else { guess };
        self.promise = promise(a.1, b.1, b.0 - a.0).unwrap_or(f64::INFINITY);
    }
}

/// Time at which the tangents at both ends meet, where a minimum lies between.
fn crossing(a: Point, b: Point, length: f64) -> Option<f64> {
    (a.1 < 0.0 && b.1 > 0.0).then(|| (b.0 - a.0 - b.1 * length) / (a.1 - b.1))
}

/// Time of the minimum of the cubic with these values and slopes at 0 and `length`, where it has
/// one between.
fn cubic_minimum(a: Point, b: Point, length: f64) -> Option<f64> {
    // In x = t/length: c3 x^3 + c2 x^2 + c1 x + a; its slope vanishes with rising sign at the root
    // taken.
    let (da, db, rise) = (a.1 * length, b.1 * length, b.0 - a.0);
    let (c1, c2, c3) = (da, 3.0 * rise - 2.0 * da - db, da + db - 2.0 * rise);
    let root = (c2 * c2 - 3.0 * c3 * c1).sqrt();
    // The form without cancellation; the slope rises where 3 c3 x + c2 = root > 0.
    let x = if c2 >= 0.0 {
        -c1 / (c2 + root)
    } else {
        (root - c2) / (3.0 * c3)
    };
    (x > 0.0 && x < 1.0).then_some(x * length)
}

/// The lowest value that a quantity may reach between two points, if lower than at both.
fn promise(a: Point, b: Point, length: f64) -> Option<f64> {
    // Tangents that meet elsewhere say nothing of what is between.
    if let Some(t) = crossing(a, b, length).filter(|t| *t > 0.0 && *t < length) {
        return Some((a.0 + a.1 * t).min(a.0).min(b.0));
    }
    let t = cubic_minimum(a, b, length)?;
    let x = t / length;
    let (da, db, rise) = (a.1 * length, b.1 * length, b.0 - a.0);
    let value = a.0 + x * (da + x * (3.0 * rise - 2.0 * da - db + x * (da + db - 2.0 * rise)));
    (value < a.0.min(b.0)).then_some(value)
}

/// The same where a kink may be between, towards which the quantity may bend: somewhat lower.
fn guess(a: Point, b: Point, length: f64) -> Option<f64> {
    const LOWER: f64 = 0.25;
    let promise = promise(a, b, length)?;
    let lower = LOWER * (a.0.max(b.0) - promise);
    Some(if a.1 < 0.0 && b.1 > 0.0 {
        promise - lower
    } else {
        promise
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The minimum of a cubic is that of the cubic: x^3 - 3x at 1, from anywhere on both sides.
    #[test]
    fn a_cubic_is_met_exactly() {
        let point = |x: f64| (x * x * x - 3.0 * x, 3.0 * x * x - 3.0);
        for (from, to) in [(0.0, 2.0), (-0.5, 1.5), (0.9, 7.0), (-0.99, 1.01)] {
            let t = cubic_minimum(point(from), point(to), to - from).unwrap();
            assert!((from + t - 1.0).abs() < 1e-12, "{from} {to}: {}", from + t);
            let least = promise(point(from), point(to), to - from).unwrap();
            assert!(least <= -2.0 + 1e-12);
        }
        assert_eq!(cubic_minimum(point(1.5), point(2.0), 0.5), None);
        assert_eq!(cubic_minimum(point(-0.9), point(0.9), 1.8), None);
    }

    #[test]
    fn tangents_of_a_kink_meet_at_it() {
        let t = crossing((0.3, -1.0), (0.7, 1.0), 1.0).unwrap();
        assert!((t - 0.3).abs() < 1e-15);
        assert_eq!(crossing((0.3, 1.0), (0.7, -1.0), 1.0), None);
    }

    #[test]
    fn a_straight_line_promises_nothing() {
        assert_eq!(promise((0.0, 1.0), (1.0, 1.0), 1.0), None);
        assert_eq!(promise((1.0, 0.0), (1.0, 0.0), 1.0), None);
        assert_eq!(
            promise((f64::NAN, -1.0), (1.0, 1.0), 1.0).filter(|p| *p < 1.0),
            None
        );
    }
}
