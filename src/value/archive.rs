//! Trajectories of a sweep, kept as first guesses for boundary value problems.

use super::nearest::{self, Nearest};
use crate::backend::{Backend, BackendError, Status, Trajectories};
use crate::shooting::{End, Path};
use crate::sweep::{Plan, Sampling, SweepReport, sweep_keeping};
use crate::trajectories::SweptTrajectories;

/// Points kept at most; above it every second trajectory is left out.
const MOST_NUMBERS: usize = 48 << 20;
/// Points of one trajectory nearer to each other than this share of the spacing are not all looked
/// up.
const THIN: f64 = 0.25;
/// Most segments that a first guess begins with.
const MOST_SEGMENTS: f64 = 400.0;

/// Sampled trajectories, backward from the seed.
pub struct Archive {
    /// Components of a node, `2n`.
    width: usize,
    /// Numbers of a point: the node, V.
    stride: usize,
    /// `[point][stride]`; a trajectory's points are consecutive, the seed first. f32: these are
    /// guesses.
    points: Vec<f32>,
    /// Backward time of each point. f64: differences of these are durations of segments, which no
    /// iteration corrects.
    times: Vec<f64>,
    /// First point of each trajectory, and the end.
    first: Vec<usize>,
    /// One of this many trajectories is kept.
    every: usize,
    seen: usize,
    /// A finite horizon's trajectories are of use only whole.
    whole: bool,
}

/// A node and V some time later, by the classical method of Runge and Kutta: good enough for a guess.
fn carried(plan: &Plan, node: &[f64], v: f64, time: f64) -> (Vec<f64>, f64) {
    const STEPS: usize = 16;
    let (system, width) = (&plan.system, node.len());
    // Rates are those of backward time.
    let rate = |z: &[f64]| -> Vec<f64> {
        let rates = system.eval(&system.rate, &z[..width / 2], &z[width / 2..width]);
        rates[..=width].iter().map(|r| -r).collect()
    };
    let h = time / STEPS as f64;
    let moved = |z: &[f64], by: &[f64], h: f64| -> Vec<f64> {
        z.iter().zip(by).map(|(z, r)| z + h * r).collect()
    };
    let mut z: Vec<f64> = node.iter().copied().chain([v]).collect();
    for _ in 0..STEPS {
        let a = rate(&z);
        let b = rate(&moved(&z, &a, 0.5 * h));
        let c = rate(&moved(&z, &b, 0.5 * h));
        let d = rate(&moved(&z, &c, h));
        for k in 0..=width {
            z[k] += h / 6.0 * (a[k] + 2.0 * (b[k] + c[k]) + d[k]);
        }
    }
    let v = z.pop().unwrap_or(f64::NAN);
    (z, v)
}

/// A point of an archived trajectory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Place {
    pub trajectory: usize,
    /// Points before it on its trajectory.
    pub point: usize,
}

impl Archive {
    pub fn new(plan: &Plan) -> Self {
        let width = 2 * plan.system.states;
        Self {
            width,
            stride: 1 + width,
            points: Vec::new(),
            times: Vec::new(),
            first: vec![0],
            every: 1,
            seen: 0,
            whole: plan.sampling == Sampling::Time,
        }
    }

    /// Sweeps, and keeps the trajectories; nothing else is done with them.
    ///
    /// # Errors
    /// Device failures.
    pub fn sweep(
        &mut self,
        plan: &Plan,
        backend: &dyn Backend,
    ) -> Result<SweepReport, BackendError> {
        let mut keep = |seeds: &[f64], batch: &Trajectories| self.keep(seeds, batch);
        sweep_keeping(plan, backend, &mut |_, _| {}, &mut keep, None)
    }

    /// Of trajectories as a result file has them, with the states, costates and times of all.
    ///
    /// Files have no seeds, but for the points nearest to them. On a finite horizon what is left to
    /// its end is integrated; else a guess ends where the file's trajectory does, and is led on by
    /// the local solution.
    pub fn of_stored(plan: &Plan, swept: &SweptTrajectories) -> Self {
        let mut this = Self::new(plan);
        let n = plan.system.states;
        let end_time = plan.system.terminal.as_ref().map(|terminal| terminal.time);
        for i in 0..swept.count {
            let is_known = |k: &usize| !swept.v[i * swept.samples + k].is_nan();
            let is_whole = swept.status[i] == Status::Reached as i32 && is_known(&0);
            if this.whole && !is_whole {
                continue;
            }
            // Times rise along a trajectory; here the seed comes first.
            let known: Vec<usize> = (0..swept.samples).rev().filter(is_known).collect();
            let Some(&first) = known.first() else {
                continue;
            };
            let node = |k: usize| -> Vec<f64> {
                let at = (i * swept.samples + k) * n;
                let s = swept.x[at..at + n].iter().zip(&plan.system.reference);
                let s = s.map(|(x, reference)| x - reference);
                s.chain(swept.p[at..at + n].iter().copied()).collect()
            };
            let time = |k: usize| swept.t[i * swept.samples + k];
            let origin = match end_time {
                Some(end) => {
                    let left = end - time(first);
                    if left > 0.0 {
                        this.times.push(0.0);
                        let (z, v) =
                            carried(plan, &node(first), swept.v[i * swept.samples + first], left);
                        this.points.extend(z.iter().chain([&v]).map(|x| *x as f32));
                    }
                    end
                }
                None => time(first),
            };
            for k in known {
                this.times.push(origin - time(k));
                let v = swept.v[i * swept.samples + k];
                this.points
                    .extend(node(k).iter().chain([&v]).map(|x| *x as f32));
            }
            this.first.push(this.times.len());
        }
        while this.points.len() > MOST_NUMBERS {
            this.thin();
        }
        this
    }

    /// Keeps a batch of the sweep.
    pub fn keep(&mut self, seeds: &[f64], batch: &Trajectories) {
        for i in 0..batch.count() {
            self.seen += 1;
            // One that has reached the ceiling of V is not whole.
            let to_the_end = || batch.levels == 0 || !batch.sample(i, batch.levels - 1)[0].is_nan();
            let wanted = !self.whole || (batch.status[i] == Status::Reached && to_the_end());
            if !wanted || !(self.seen - 1).is_multiple_of(self.every) {
                continue;
            }
            self.times.push(0.0);
            let seed = &seeds[i * batch.dim..][..=self.width];
            self.points.extend(seed.iter().map(|x| *x as f32));
            for k in 0..batch.levels {
                let sample = batch.sample(i, k);
                if sample[0].is_nan() {
                    break;
                }
                self.times.push(sample[0]);
                self.points
                    .extend(sample[1..=self.stride].iter().map(|x| *x as f32));
            }
            self.first.push(self.times.len());
            if self.points.len() > MOST_NUMBERS {
                self.thin();
            }
        }
    }

    /// Leaves out every second trajectory.
    fn thin(&mut self) {
        self.every *= 2;
        let (mut points, mut times, mut first) = (Vec::new(), Vec::new(), vec![0]);
        for t in (0..self.trajectories()).step_by(2) {
            let kept = self.first[t]..self.first[t + 1];
            times.extend_from_slice(&self.times[kept.clone()]);
            points
                .extend_from_slice(&self.points[kept.start * self.stride..kept.end * self.stride]);
            first.push(times.len());
        }
        (self.points, self.times, self.first) = (points, times, first);
    }

    pub fn trajectories(&self) -> usize {
        self.first.len() - 1
    }

    pub fn is_empty(&self) -> bool {
        self.trajectories() == 0
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        4 * self.points.len() + 8 * (self.times.len() + self.first.len())
    }

    fn point(&self, place: Place) -> &[f32] {
        let at = (self.first[place.trajectory] + place.point) * self.stride;
        &self.points[at..][..self.stride]
    }

    /// Backward time at a place.
    fn time(&self, place: Place) -> f64 {
        self.times[self.first[place.trajectory] + place.point]
    }

    /// `(s, p)` at a place.
    pub fn node(&self, place: Place) -> Vec<f64> {
        self.point(place)[..self.width]
            .iter()
            .map(|x| f64::from(*x))
            .collect()
    }

    /// V at a place.
    pub fn value(&self, place: Place) -> f64 {
        f64::from(self.point(place)[self.width])
    }

    /// The path from a place to the end: the rest of its trajectory, and on into the range of the
    /// end's condition for a cost of `value`. On a finite horizon, whose places are the ends of
    /// trajectories, it lasts as long as the horizon.
    pub fn path(&self, place: Place, end: &End, value: f64, duration: f64) -> Path {
        let mut path = Path::new(&self.node(place));
        let mut at = self.time(place);
        let shortest = (at / MOST_SEGMENTS).max(duration);
        for point in (0..place.point).rev() {
            let this = Place { point, ..place };
            let before = if point > 0 {
                self.time(Place {
                    point: point - 1,
                    ..place
                })
            } else {
                f64::NEG_INFINITY
            };
            let time = self.time(this);
            // The last point that is not too far away, or the next one.
            if at - before > shortest && at > time {
                path.push(at - time, &self.node(this));
                at = time;
            }
        }
        let s = path.last()[..self.width / 2].to_vec();
        let (nodes, durations) = end.tail(&s, value, duration);
        path.append(&nodes, &durations);
        // Devices give times in single precision, levels are sums.
        if let End::Terminal { time, .. } = end {
            path.set_horizon(*time);
        }
        path
    }
}

/// An index of an archive's points by state, in widths of the region.
pub struct Index {
    places: Vec<Place>,
    tree: Box<dyn Nearest>,
    /// Smallest and largest coordinates of the points.
    pub extent: Vec<[f64; 2]>,
}

impl Index {
    /// Indexes the points within `bounds` (deviations), `spacing` being the sweep's.
    pub fn new(archive: &Archive, widths: &[f64], bounds: &[[f64; 2]], spacing: f64) -> Self {
        let n = widths.len();
        let mut places = Vec::new();
        let mut coordinates: Vec<f64> = Vec::new();
        for trajectory in 0..archive.trajectories() {
            let count = archive.first[trajectory + 1] - archive.first[trajectory];
            let from = if archive.whole { count - 1 } else { 0 };
            let mut last: Option<Vec<f64>> = None;
            for point in from..count {
                let place = Place { trajectory, point };
                let s: Vec<f64> = archive.point(place)[..n]
                    .iter()
                    .map(|x| f64::from(*x))
                    .collect();
                let inside = s.iter().zip(bounds).all(|(s, [lo, hi])| s >= lo && s <= hi);
                if !inside {
                    continue;
                }
                let s: Vec<f64> = s.iter().zip(widths).map(|(s, w)| s / w).collect();
                let moved = last.as_ref().is_none_or(|l| {
                    let gap = l
                        .iter()
                        .zip(&s)
                        .map(|(a, b)| (a - b).abs())
                        .fold(0.0, f64::max);
                    gap > THIN * spacing
                });
                if moved || point + 1 == count {
                    places.push(place);
                    coordinates.extend_from_slice(&s);
                    last = Some(s);
                }
            }
        }
        let extent = (0..n)
            .map(|i| {
                let along = coordinates.iter().skip(i).step_by(n);
                along.fold([f64::INFINITY, f64::NEG_INFINITY], |[lo, hi], x| {
                    [lo.min(*x), hi.max(*x)]
                })
            })
            .collect();
        Self {
            tree: nearest::index(&coordinates, n),
            places,
            extent,
        }
    }

    pub fn len(&self) -> usize {
        self.places.len()
    }

    pub fn is_empty(&self) -> bool {
        self.places.is_empty()
    }

    /// The places nearest to a state (in widths of the region), with their distances.
    pub fn near(&self, state: &[f64], within: f64, most: usize) -> Vec<(Place, f64)> {
        if self.places.is_empty() {
            return Vec::new();
        }
        (self.tree.near(state, within, most).into_iter())
            .map(|(k, d)| (self.places[k], d))
            .collect()
    }
}
