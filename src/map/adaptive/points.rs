//! Tracks and their points: which are wanted, and what is kept of them.

use super::{AROUND, Work};
use crate::backend::BackendError;
use crate::map::pieces::MOST_VARIABLES;
use crate::shooting::Path;
use crate::value::{Track, TrackPoints, Wish, tell_clearances, track_points};

/// Largest distance between points of an extremal, in widths of the region, and change of log V.
const SPACING: f64 = 0.025;
const CHANGE: f64 = 0.15;
/// Solutions are followed at most so many widths of the region out of it.
const MOST_REACH: f64 = 5.0;

impl Work<'_, '_> {
    /// Whether extremals are followed backward beyond the states they were solved for: where sheets
    /// lie over each other what comes before an answer need not be one.
    pub(super) fn goes_beyond(&self) -> bool {
        !self.plan.game && self.plan.local.is_some() && !self.cloud.several
    }

    /// The region and its margin, as deviations.
    fn around(&self) -> Vec<[f64; 2]> {
        let each = self.aim.bounds.iter().zip(&self.plan.system.reference);
        each.map(|([lo, hi], r)| {
            let more = AROUND * (hi - lo);
            [lo - r - more, hi - r + more]
        })
        .collect()
    }

    /// Bounds, as deviations, within which points of tracks are kept. A state that has a period
    /// comes back by itself; of a game what lies behind a fold is no value.
    pub(super) fn farthest(&self) -> Vec<[f64; 2]> {
        let each = self.around().into_iter().zip(&self.plan.periods);
        each.map(|([lo, hi], period)| {
            let stays = self.plan.game || period.is_some();
            let more = if stays { 0.0 } else { MOST_REACH * (hi - lo) };
            [lo - more, hi + more]
        })
        .collect()
    }

    /// Where points of tracks are wanted, as deviations, those of states with a period in one of
    /// these; and how dense.
    pub(super) fn wish(&self, floor: f64) -> Wish {
        Wish {
            bounds: self.farthest(),
            around: self.around(),
            widths: self.aim.bounds.iter().map(|[lo, hi]| hi - lo).collect(),
            spacing: SPACING,
            change: CHANGE,
            floor,
            value_max: self.most_value(),
            onward: self.plan.local.is_some() || self.axis.is_some(),
            horizon: self.axis.as_ref().map(|axis| axis.last),
            beyond: self.goes_beyond(),
            shadows: self.shadows.clone(),
        }
    }

    /// Adds tracks and their points.
    pub(super) fn add(&mut self, tracks: Vec<Track>, floor: f64) -> Result<(), BackendError> {
        let wish = self.wish(floor);
        let first = self.tracks.len() as u32;
        let found = self.points_of(&tracks, first, &wish)?;
        self.keep(tracks, found, (&wish.bounds, &wish.around));
        Ok(())
    }

    /// Points of tracks, whose numbers begin with `first`. What is solved is used, whatever the
    /// time.
    pub(super) fn points_of(
        &mut self,
        tracks: &[Track],
        first: u32,
        wish: &Wish,
    ) -> Result<TrackPoints, BackendError> {
        let wish = self.in_any_period(wish, tracks);
        self.untimed(|this| track_points(this.plan, this.solver, tracks, first, &wish))
    }

    /// Of a state with a period any number of periods away will do; where the cost tells whole
    /// periods apart, as far away as tracks begin: further out is no least V.
    fn in_any_period(&self, wish: &Wish, tracks: &[Track]) -> Wish {
        let turns = |i: usize, [lo, hi]: [f64; 2], period: f64| {
            let begin = self
                .tracks
                .iter()
                .chain(tracks)
                .map(|track| track.path.node(0)[i]);
            begin.fold([0.0f64; 2], |[least, most], s| {
                let (first, last) = (((lo - s) / period).ceil(), ((hi - s) / period).floor());
                // Of several the one that moves it least.
                let turns = if first > last {
                    0.0
                } else {
                    0.0f64.clamp(first, last)
                };
                [least.min(turns), most.max(turns)]
            })
        };
        let wide = |bounds: &[[f64; 2]]| -> Vec<[f64; 2]> {
            let each = bounds.iter().enumerate();
            each.map(
                |(i, b)| match (self.plan.periods[i], self.plan.recurrent[i]) {
                    (None, _) => *b,
                    (Some(_), Some(_)) => [f64::NEG_INFINITY, f64::INFINITY],
                    (Some(period), None) => {
                        let [least, most] = turns(i, *b, period);
                        [b[0] - most * period, b[1] - least * period]
                    }
                },
            )
            .collect()
        };
        Wish {
            bounds: wide(&wish.bounds),
            around: wide(&wish.around),
            ..wish.clone()
        }
    }

    /// Keeps tracks with their points: within bounds, and of those around the region as points of
    /// the cloud.
    pub(super) fn keep(
        &mut self,
        tracks: Vec<Track>,
        found: TrackPoints,
        (bounds, around): (&[[f64; 2]], &[[f64; 2]]),
    ) {
        let n = self.plan.system.states;
        if let Some(axis) = &self.axis {
            self.rates.extend(axis.rates(&found.nodes, 2 * n));
        }
        let first = self.points.len();
        self.tracks.extend(tracks);
        self.points.extend(found);
        self.place(first, (bounds, around));
    }

    /// Puts points, from one on, into the cloud.
    fn place(&mut self, first: usize, (bounds, around): (&[[f64; 2]], &[[f64; 2]])) {
        let n = self.plan.system.states;
        self.of_track.resize(self.tracks.len(), Vec::new());
        for k in first..self.points.len() {
            let track = self.points.track[k];
            let number = k as u32;
            self.of_track[track as usize].push(number);
            let node = self.points.node(k).to_vec();
            for mut shift in self.shifts(&node[..n], bounds) {
                let near = |i: usize| (around[i][0]..=around[i][1]).contains(&(node[i] + shift[i]));
                if !(0..n).all(near) {
                    continue;
                }
                let Track { path, sheet, .. } = &self.tracks[track as usize];
                let x = self.state_of(&self.points, k, path, &shift);
                let mut p = node[n..].to_vec();
                if self.axis.is_some() {
                    p.push(self.rates[number as usize]);
                    shift.push(0.0);
                }
                let told = (self.points.v[k], self.points.clearance[k]);
                let of_track = (track, *sheet, self.is_doubtful(k));
                self.cloud.add(&self.frame, (&x, &p), told, of_track);
                self.origins.push((number, shift));
            }
        }
    }

    /// Whether another solution may be cheaper at a point: one on another sheet than the lowest, or
    /// the rest of the least one where the cost tells whole periods apart, which may be chosen anew
    /// at each state.
    pub(super) fn is_doubtful(&self, k: usize) -> bool {
        let plan = self.plan;
        let periods = plan.periods.iter().zip(&plan.recurrent);
        let told_apart = |(period, recurrent): (&Option<f64>, &Option<f64>)| {
            period.is_some() && recurrent.is_none()
        };
        let is_least = self.tracks[self.points.track[k] as usize].whole;
        !is_least || (self.points.t[k] != 0.0 && periods.into_iter().any(told_apart))
    }

    /// Learns how far all points keep from the guards that cast shadows, and places them anew.
    pub(super) fn shade(&mut self, floor: f64) -> Result<(), BackendError> {
        let outside = self.untimed(|this| {
            let tracks = (this.tracks.as_slice(), 0);
            tell_clearances(
                this.plan,
                this.solver,
                tracks,
                &this.shadows,
                &mut this.points,
            )
        })?;
        self.points.retain(|k| !outside[k]);
        if self.axis.is_some() {
            let mut k = 0;
            self.rates.retain(|_| {
                k += 1;
                !outside[k - 1]
            });
        }
        self.cloud.clear();
        self.of_track.clear();
        self.origins.clear();
        let wish = self.wish(floor);
        self.place(0, (&wish.bounds, &wish.around));
        Ok(())
    }

    /// State (absolute, moved by whole periods) of a point on a path, with its time where that is
    /// an axis.
    pub(super) fn state_of(
        &self,
        points: &TrackPoints,
        k: usize,
        path: &Path,
        shift: &[f64],
    ) -> Vec<f64> {
        let node = points
            .node(k)
            .iter()
            .zip(shift)
            .zip(&self.plan.system.reference);
        node.map(|((s, shift), r)| s + shift + r)
            .chain(
                self.axis
                    .as_ref()
                    .map(|axis| axis.begins(path) + points.t[k]),
            )
            .collect()
    }

    /// State (as solved, absolute) and gradient of a point, with its time and dV/dt where time is
    /// an axis.
    pub(super) fn coordinates(&self, point: usize) -> (Vec<f64>, Vec<f64>) {
        let path = &self.tracks[self.points.track[point] as usize].path;
        let x = self.state_of(&self.points, point, path, &[0.0; MOST_VARIABLES]);
        let mut p = self.points.node(point)[self.plan.system.states..].to_vec();
        p.extend(self.axis.as_ref().map(|_| self.rates[point]));
        (x, p)
    }

    /// All whole periods by which a state (deviation) comes into bounds.
    pub(super) fn shifts(&self, s: &[f64], bounds: &[[f64; 2]]) -> Vec<Vec<f64>> {
        let mut all = vec![vec![0.0; s.len()]];
        for (i, period) in self.plan.periods.iter().enumerate() {
            let Some(period) = period else { continue };
            let [lo, hi] = bounds[i];
            let (first, last) = (
                ((lo - s[i]) / period).ceil() as i32,
                ((hi - s[i]) / period).floor() as i32,
            );
            all = (all.iter())
                .flat_map(|base| {
                    (first..=last).map(|k| {
                        let mut shift = base.clone();
                        shift[i] = f64::from(k) * period;
                        shift
                    })
                })
                .collect();
        }
        all
    }
}
