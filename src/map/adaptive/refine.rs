//! Pieces built and states asked for in turns; the frame of their coordinates.

use super::check::mixed;
use super::{BETTER, Hole, Work};
use crate::backend::BackendError;
use crate::map::pieces::{Before, Frame, Pieces, Region, Steep, Unanswered, Want, build};
use crate::shooting::Path;
use crate::value::clearances;
use rustc_hash::FxHashMap;
use std::time::Instant;

/// Share of the budget before the last rounds, and that is worth no further round.
const BEFORE_CLOSING: f64 = 0.88;
pub(super) const ALL_BUT: f64 = 0.97;
/// With such a bound a cell counts as a hole: the last states go there first.
const WORTHLESS: f64 = 0.1;
/// Points that a frame is fitted to, about; from the fullest parts of the region they are drawn by
/// lot.
const MOST_PLACES: usize = 200_000;
/// States solved after which the frame stays.
const SETTLED: usize = 3000;

impl Work<'_, '_> {
    /// Builds pieces, and solves for states where they are not good enough, until they are.
    pub(super) fn refined(
        &mut self,
        region: &Region,
        more: Vec<Want>,
    ) -> Result<Pieces, BackendError> {
        let mut more = Some(more).filter(|m| !m.is_empty());
        let mut before: Option<(Pieces, usize, usize)> = None;
        let mut last: Option<(Instant, usize)> = None;
        let mut closing = false;
        loop {
            self.probe(region.floor)?;
            if self.learn_shadows()? {
                self.shade(region.floor)?;
                before = None;
            }
            if self.states < SETTLED && self.turn(region) {
                before = None;
            }
            let old = before.as_ref().map(|(pieces, points, unanswered)| Before {
                pieces,
                points: *points,
                unanswered: *unanswered,
            });
            self.cloud.unanswered = self.unanswered_places();
            let (pieces, wants) = build(&self.cloud, region, &self.frame, self.flow.as_ref(), old);
            let asked: Vec<Want> = (more
                .take()
                .into_iter()
                .flatten()
                .chain(wants.iter().cloned()))
            .filter(|want| !self.failures.are_too_many(want))
            .collect();
            if asked.is_empty() || self.is_spent(1.0) || (closing && self.is_spent(ALL_BUT)) {
                return Ok(pieces);
            }
            // The last states are first for the holes that the rounds before have left between
            // their new cells, and for cells of which nothing would be said.
            closing = self.is_spent(BEFORE_CLOSING);
            let most = self.aim.error_max.max(WORTHLESS) / self.aim.error;
            let asked = match closing.then(|| holes(&asked, most)) {
                Some(holes) if !holes.is_empty() => holes,
                _ => asked,
            };
            let (solved, clock) = (self.states + self.failed, Instant::now());
            if let Some((began, first)) = last {
                self.pace = (clock - began).as_secs_f64() / (solved - first).max(1) as f64;
            }
            last = Some((clock, solved));
            self.rounds += 1;
            let (known, dark) = (self.cloud.len(), self.unanswered.len());
            let share = if closing { 1.0 } else { BEFORE_CLOSING };
            if !self.answer(asked, region, share)? {
                return Ok(pieces);
            }
            let said = format!("in {} cells", pieces.cells.len());
            (self.progress)(&said, self.states, self.states + wants.len());
            before = Some((pieces, known, dark));
        }
    }

    /// Learns how far solutions that leave a guard do so; whether guards are among these that were
    /// not known to cast a shadow.
    fn learn_shadows(&mut self) -> Result<bool, BackendError> {
        let cut: Vec<usize> = (0..self.unanswered.len())
            .filter(|k| self.unanswered[*k].cut.is_some())
            .collect();
        let mut paths: Vec<Path> = cut
            .iter()
            .filter_map(|k| self.unanswered[*k].cut.take())
            .collect();
        paths.append(&mut self.cut);
        let all: Vec<&Path> = paths.iter().collect();
        let margins = self.untimed(|this| clearances(this.plan, this.solver, &all))?;
        let mut is_new = false;
        for margins in &margins {
            for (shadow, margin) in self.shadows.iter_mut().zip(margins) {
                is_new |= !*shadow && *margin < 0.0;
                *shadow |= *margin < 0.0;
            }
        }
        for (k, margins) in cut.into_iter().zip(margins) {
            self.unanswered[k].clearances = margins;
        }
        Ok(is_new)
    }

    /// States without a solution, in coordinates of the frame.
    fn unanswered_places(&self) -> Unanswered {
        let n = self.cloud.variables;
        let clearance = |hole: &Hole| match hole.leaves_guard {
            true => hole.clearances.iter().copied().fold(0.0, f64::min),
            false => f64::NAN,
        };
        let mut places = Unanswered {
            z: vec![0.0; n * self.unanswered.len()],
            clearance: self.unanswered.iter().map(clearance).collect(),
        };
        for (z, hole) in places.z.chunks_exact_mut(n).zip(&self.unanswered) {
            self.frame.of(&hole.x, z);
        }
        places
    }

    /// Turns the frame to where V is steep, relative to itself, if that is in one direction;
    /// whether it was turned.
    fn turn(&mut self, region: &Region) -> bool {
        let places = self.steep_places(region, None);
        let Some(frame) = Frame::fitted(region, &places) else {
            return false;
        };
        if frame.across(region, &places) > BETTER * self.frame.across(region, &places) {
            return false;
        }
        self.frame = frame;
        let n = self.cloud.variables;
        for k in 0..self.origins.len() {
            let (point, shift) = &self.origins[k];
            let (mut x, p) = self.coordinates(*point as usize);
            x.iter_mut().zip(shift).for_each(|(x, s)| *x += s);
            let z = &mut self.cloud.z[k * n..][..n];
            self.frame.of(&x, z);
            self.frame
                .gradient_of(z, &p, &mut self.cloud.q[k * n..][..n]);
        }
        true
    }

    /// Points in the region, but not in a part of it, with V's slopes relative to itself; all parts
    /// weigh the same.
    pub(super) fn steep_places(&self, region: &Region, without: Option<&Region>) -> Vec<Steep> {
        let n = self.cloud.variables;
        let a_side = if n <= 4 { 8.0 } else { 4.0 };
        let place = |k: usize| {
            let (x, p) = self.coordinates(k);
            let t: Vec<f64> = (0..n)
                .map(|i| (x[i] - region.lo[i]) / region.width(i))
                .collect();
            let inside = t.iter().all(|t| (0.0..=1.0).contains(t))
                && !without.is_some_and(|part| part.covers(&x));
            let part: Vec<u8> = t.iter().map(|t| (t * a_side) as u8).collect();
            inside.then_some((t, p, part))
        };

        let mut points: FxHashMap<Vec<u8>, usize> = FxHashMap::default();
        for (_, _, part) in (0..self.points.len()).filter_map(place) {
            *points.entry(part).or_default() += 1;
        }
        // A lot for all points alike would leave the parts with few of them to chance, and they
        // weigh as much as the others.
        let most = MOST_PLACES / points.len().max(1);

        let mut drawn: FxHashMap<Vec<u8>, f64> = FxHashMap::default();
        let mut places = Vec::new();
        let mut boxes = Vec::new();
        for k in 0..self.points.len() {
            let Some((t, p, part)) = place(k) else {
                continue;
            };
            if mixed(k as u64) * points[&part] as f64 > most as f64 {
                continue;
            }
            *drawn.entry(part.clone()).or_default() += 1.0;
            boxes.push(part);
            let size = self.points.v[k].abs().max(region.floor);
            places.push(Steep {
                slope: (0..n).map(|i| p[i] * region.width(i) / size).collect(),
                t,
                weight: 0.0,
            });
        }
        for (place, part) in places.iter_mut().zip(&boxes) {
            place.weight = 1.0 / (drawn[part] * drawn.len() as f64);
        }
        places
    }
}

/// Cells with bare places, and those in error by more than `most` times the one asked for.
fn holes(wants: &[Want], most: f64) -> Vec<Want> {
    let bad = |w: &Want| w.excess > most;
    let some = wants.iter().filter(|w| bad(w) || !w.bare.is_empty());
    some.map(|w| Want {
        excess: if bad(w) { w.excess } else { 1.0 },
        ..w.clone()
    })
    .collect()
}
