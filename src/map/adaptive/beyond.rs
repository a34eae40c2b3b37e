//! Where solutions from the region lead: a second map round it, of what they met there. A law needs
//! it, since a closed loop goes the same ways; no states are solved for its sake.

use super::{AROUND, BETTER, Checked, Met, Work};
use crate::backend::BackendError;
use crate::map::pieces::{Cloud, Frame, Pieces, Region, build_around};
use crate::value::{Answers, PointStatus, Track, Wish};

/// Errors there may be so many times larger: what a law costs rises with the square of them.
const LARGER: f64 = 3.0;
/// How far beyond their outermost points pieces there say something, in half widths: nothing
/// surrounds them.
const BEYOND_POINTS: f64 = 0.04;
/// What is outside the region by less than this share of its width may be so by rounding.
const ROUNDING: f64 = 1e-9;

/// The map round the region, and what the trajectories of fresh states show of it.
pub struct Beyond {
    pub pieces: Pieces,
    /// Points on these trajectories outside the region: V known as if solved for, and said with its
    /// bound as it was before they were looked at.
    pub check: Vec<Checked>,
}

impl Work<'_, '_> {
    /// Whether there is a map round the region at all: behind a fold of a game there is no value,
    /// and where V depends on time that is no axis solutions tell of their beginnings alone.
    fn maps_beyond(&self) -> bool {
        !self.plan.game && (self.plan.local.is_some() || self.axis.is_some())
    }

    /// The region, widened to where solutions from states in it lead; `None` where they stay in it.
    /// Points of the margin, to which solutions are continued backward or which are searched from,
    /// do not count: no closed loop from the region comes there.
    fn reach(&self, region: &Region) -> Option<Region> {
        let bounds = self.farthest();
        let reference = &self.plan.system.reference;
        let stays = |i: usize| self.plan.periods[i].is_some();
        let past = |x: &[f64], i: usize| {
            let more = ROUNDING * region.width(i);
            x[i] < region.lo[i] - more || x[i] > region.hi[i] + more
        };
        // Wherever whole periods take a state to.
        let moved = |s: &[f64]| -> Vec<Vec<f64>> {
            let each = self.shifts(s, &bounds).into_iter();
            each.map(|shift| {
                (0..s.len())
                    .map(|i| s[i] + shift[i] + reference[i])
                    .collect()
            })
            .collect()
        };
        let begin_inside: Vec<bool> = (self.tracks.iter())
            .map(|track| {
                moved(track.path.start())
                    .iter()
                    .any(|x| !(0..x.len()).any(|i| past(x, i)))
            })
            .collect();
        let mut outer = region.clone();
        let onward = (0..self.points.len())
            .filter(|k| self.points.t[*k] >= 0.0 && begin_inside[self.points.track[*k] as usize]);
        for x in onward.flat_map(|k| moved(&self.points.node(k)[..reference.len()])) {
            if (0..x.len()).any(|i| stays(i) && past(&x, i)) {
                continue;
            }
            for i in (0..x.len()).filter(|i| past(&x, *i)) {
                let [lo, hi] = bounds[i].map(|s| s + reference[i]);
                let x = x[i].clamp(lo, hi);
                (outer.lo[i], outer.hi[i]) = (outer.lo[i].min(x), outer.hi[i].max(x));
            }
        }
        (outer != *region).then_some(outer)
    }

    /// The map round the region, if solutions leave it.
    pub(super) fn beyond(&mut self, region: &Region, met: &[Met]) -> Option<Beyond> {
        if !self.maps_beyond() {
            return None;
        }
        let outer = Region {
            beyond: region.beyond.min(BEYOND_POINTS),
            error: (LARGER * region.error).min(self.aim.error_max),
            ..self.reach(region)?
        };
        // Points a little within the region's faces keep the two together.
        let mut inner = region.clone();
        for i in 0..inner.lo.len() {
            let margin = AROUND * region.width(i);
            (inner.lo[i], inner.hi[i]) = (inner.lo[i] + margin, inner.hi[i] - margin);
        }
        let places = self.steep_places(&outer, Some(&inner));
        let along = Frame::along(&outer);
        let frame = Frame::fitted(&outer, &places)
            .filter(|frame| frame.across(&outer, &places) <= BETTER * along.across(&outer, &places))
            .unwrap_or(along);
        let n = self.plan.system.states;
        let bounds = self.farthest();
        let mut cloud = Cloud {
            variables: self.cloud.variables,
            several: self.cloud.several,
            ..Cloud::default()
        };
        for k in 0..self.points.len() {
            let (at, p) = self.coordinates(k);
            for shift in self.shifts(&self.points.node(k)[..n], &bounds) {
                let mut x = at.clone();
                x.iter_mut().zip(&shift).for_each(|(x, s)| *x += s);
                if inner.covers(&x) || !outer.covers(&x) {
                    continue;
                }
                let track = self.points.track[k];
                let sheet = self.tracks[track as usize].sheet;
                cloud.add(
                    &frame,
                    (&x, &p),
                    (self.points.v[k], self.points.clearance[k]),
                    (track, sheet, self.is_doubtful(k)),
                );
            }
        }
        let mut pieces = build_around(&cloud, &outer, &frame, self.flow.as_ref(), region);
        let check = (met.iter())
            .map(|(x, v)| Checked::of(x, (PointStatus::Converged, *v), pieces.at(x).as_ref()))
            .collect();
        // Where they disagree nothing can be solved for: the error seen is the bound.
        met.iter().for_each(|(x, v)| pieces.admit(x, *v));
        // Whatever its bound, for a law it is better than nothing; but of several sheets one far
        // from its points may call itself the lowest.
        if self.cloud.several {
            pieces = pieces.within(self.aim.error_max);
        }
        (!pieces.pieces.is_empty()).then_some(Beyond { pieces, check })
    }

    /// Points outside the region that the least solutions from fresh states meet, with V.
    pub(super) fn met_beyond(
        &mut self,
        all: &[(Vec<usize>, Answers)],
        region: &Region,
    ) -> Result<Vec<Met>, BackendError> {
        if !self.maps_beyond() {
            return Ok(Vec::new());
        }
        let mut tracks = Vec::new();
        for answers in all.iter().map(|(_, answers)| answers) {
            let lowest = answers
                .targets
                .of_given
                .iter()
                .filter_map(|target| answers.answer(*target));
            tracks.extend(lowest.map(|e| Track::of(e, true)));
        }
        let wish = Wish {
            beyond: false,
            ..self.wish(region.floor)
        };
        let points = self.points_of(&tracks, 0, &wish)?;
        let n = self.plan.system.states;
        let mut met = Vec::new();
        for k in 0..points.len() {
            let node = points.node(k);
            let Some(shift) = self.shifts(&node[..n], &wish.bounds).into_iter().next() else {
                continue;
            };
            let x = self.state_of(&points, k, &tracks[points.track[k] as usize].path, &shift);
            if !region.covers(&x) && points.v[k] <= region.value_max {
                met.push((x, points.v[k]));
            }
        }
        Ok(met)
    }
}
