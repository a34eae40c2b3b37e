//! Guards that cut a cheaper way off where another solution is the answer: no state without an
//! answer tells of these, but what the map says there is that of the cheaper way.

use super::Work;
use crate::backend::BackendError;
use crate::value::Track;

/// States that are asked at once.
const MOST: usize = 512;
/// Points looked at round a state.
const NEAR: usize = 48;
/// A point promises less than a state's V if by its slopes V is below this share less there.
const LESS: f64 = 0.02;
/// Shortest step of the way from a point to a state.
const LEAST_STEP: f64 = 1.0 / 8.0;

impl Work<'_, '_> {
    /// Whether V is that of the beginnings of trajectories alone: V(x, 0).
    pub(super) fn tells_of_beginnings(&self) -> bool {
        self.plan.local.is_none() && self.axis.is_none()
    }

    /// Asks of states with their V whether points near them promise less: the way on from there
    /// leaves a guard, which then casts a shadow; or it leads to a cheaper solution, which is
    /// added.
    pub(super) fn probe(&mut self, floor: f64) -> Result<(), BackendError> {
        let all = std::mem::take(&mut self.asked);
        // Of a game nothing is followed behind a fold.
        if self.plan.game || self.shadows.iter().all(|known| *known) {
            return Ok(());
        }
        let mut asked = Vec::new();
        let every = all.len().div_ceil(MOST).max(1);
        for (x, v) in all.into_iter().step_by(every) {
            let from = self.promising(&x, v, floor);
            asked.extend(from.map(|from| (x, v, from)));
        }
        if asked.is_empty() {
            return Ok(());
        }
        let guess = |(x, _, from): &(Vec<f64>, f64, u32)| {
            let shift = &self.origins[*from as usize].1;
            let moved: Vec<f64> = x.iter().zip(shift).map(|(x, s)| x - s).collect();
            self.way(&moved, *from)
        };
        let guesses = asked.iter().map(guess).collect();
        let Some(found) = self.near(guesses, LEAST_STEP)? else {
            return Ok(());
        };
        let mut tracks = Vec::new();
        for ((_, v, from), found) in asked.iter().zip(found) {
            match found {
                Ok((path, value)) if value < v - LESS * v.abs().max(floor) => tracks.push(Track {
                    path,
                    value,
                    sheet: self.cloud.sheet[*from as usize],
                    whole: true,
                }),
                Ok(_) => {}
                Err(miss) => self.cut.extend(miss.and_then(|miss| miss.cut)),
            }
        }
        self.states += tracks.len();
        self.add(tracks, floor)
    }

    /// Of the points near a state that which promises the lowest V there, if that is below the one
    /// known.
    fn promising(&self, x: &[f64], v: f64, floor: f64) -> Option<u32> {
        let n = self.cloud.variables;
        let mut z = vec![0.0; n];
        self.frame.of(x, &mut z);
        let distance = |k: u32| -> f64 {
            let at = self.cloud.z(k as usize);
            at.iter().zip(&z).map(|(a, b)| (a - b).powi(2)).sum()
        };
        let mut near: Vec<(f64, u32)> = (0..self.cloud.len() as u32)
            .filter(|k| self.goes_on(*k))
            .map(|k| (distance(k), k))
            .collect();
        if near.len() > NEAR {
            near.select_nth_unstable_by(NEAR, |a, b| a.0.total_cmp(&b.0));
            near.truncate(NEAR);
        }
        let promise = |k: u32| -> f64 {
            let (at, q) = (self.cloud.z(k as usize), self.cloud.q(k as usize));
            self.cloud.v[k as usize] + (0..n).map(|i| q[i] * (z[i] - at[i])).sum::<f64>()
        };
        near.into_iter()
            .map(|(_, k)| (promise(k), k))
            .filter(|(promised, _)| *promised < v - LESS * v.abs().max(floor))
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .map(|(_, k)| k)
    }
}
