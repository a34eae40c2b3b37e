//! The first states, as many as the budget has room for.

use super::{AROUND, GIVEN_UP, NEAR, Work};
use crate::backend::BackendError;
use crate::value::Track;
use std::time::Instant;

/// States of the first round that are searched for all sheets, by number of states.
const FIRST: [usize; 7] = [0, 64, 256, 256, 256, 384, 512];
/// Shortest step of the way from a point of an extremal to a state near it, where there are few
/// points yet.
const PATIENT_STEP: f64 = 1.0 / 64.0;
/// Floor of V for relative errors unless the scene says, relative to the median over the region.
const FLOOR: f64 = 1e-3;
/// Where V is 0 in most of the region its size is this share of the largest one.
const OF_LARGEST: f64 = 0.01;
/// As [`FLOOR`], where V is negative somewhere: it is 0 on surfaces then, where nothing is special
/// and nobody wants small relative errors.
const FLOOR_OF_BOTH_SIGNS: f64 = 0.1;
/// With a limit of seconds, states of the first batch: a batch is finished, and how long one takes
/// is not known before.
const FIRST_BATCH: usize = 8;
/// Share of the seconds that the first states within the region may take, and those on its faces
/// after them.
const WITHIN: f64 = 0.5;
const FACES: f64 = 0.75;

/// States of a scene up to which corners that no way from a point leads to are searched.
const MOST_SEARCHED_IN_CORNERS: usize = 3;

impl Work<'_, '_> {
    /// Solves for the first states, searched for all sheets; the floor of V.
    pub(super) fn first(&mut self) -> Result<f64, BackendError> {
        let n = self.cloud.variables;
        let mut wide: Vec<[f64; 2]> = (self.aim.bounds.iter())
            .map(|[lo, hi]| [lo - 0.5 * AROUND * (hi - lo), hi + 0.5 * AROUND * (hi - lo)])
            .collect();
        wide.extend(self.axis.as_ref().map(|axis| [0.0, axis.last]));
        let (mut tracks, mut values) =
            self.searched_in_budget(self.spread(&wide, FIRST[n]), WITHIN)?;
        // Where trajectories are not followed backward only states on the region's faces and in its
        // corners tell of these.
        if !self.goes_beyond() {
            let mut states = self.on_faces(&wide);
            states.extend(corners(&wide).filter(|_| self.axis.is_none()));
            let (more, others) = self.searched_in_budget(states, FACES)?;
            tracks.extend(more);
            values.extend(others);
        }
        values.retain(|v| v.is_finite());
        let is_signed = values.iter().any(|v| *v < 0.0);
        values.iter_mut().for_each(|v| *v = v.abs());
        values.sort_by(f64::total_cmp);
        let median = values.get(values.len() / 2).copied().unwrap_or(1.0);
        let size = median.max(OF_LARGEST * values.last().copied().unwrap_or(0.0));
        // V that is 0 everywhere has no size of its own.
        let size = if size > 0.0 { size } else { 1.0 };
        let floor = self.aim.floor.unwrap_or(
            size * if is_signed {
                FLOOR_OF_BOTH_SIGNS
            } else {
                FLOOR
            },
        );
        self.add(tracks, floor)?;
        if self.goes_beyond() {
            self.edges(floor)?;
        }
        if self.axis.is_some() {
            let mut states = self.spread(&wide, FIRST[n]);
            states.extend(corners(&wide[..n - 1]));
            self.add_ends(&states);
        }
        Ok(floor)
    }

    /// States on the region's faces and in its corners: what lies there no other states surround.
    fn edges(&mut self, floor: f64) -> Result<(), BackendError> {
        let n = self.plan.system.states;
        let bounds = &self.aim.bounds;
        let mut states: Vec<Vec<f64>> = corners(bounds).collect();
        states.extend(self.on_faces(bounds));
        let mut states = self.budgeted(states);
        if self.seconds_left(1.0) <= 0.0 {
            states.clear();
        }
        let count = states.len();
        let mut z = vec![0.0; n];
        let mut guesses = Vec::new();
        for x in &states {
            self.frame.of(x, &mut z);
            let Some(from) = self.nearest(&z) else {
                // No way leads there: these are no states that the budget had no room for.
                self.first[1] -= count;
                return Ok(());
            };
            let shift = &self.origins[from as usize].1;
            let x = x.iter().zip(shift).map(|(x, s)| x - s).collect();
            guesses.push((x, self.guess(from), self.cloud.sheet[from as usize]));
        }
        let sheets: Vec<i32> = guesses.iter().map(|(.., sheet)| *sheet).collect();
        let guesses = guesses.into_iter().map(|(x, path, _)| (x, path)).collect();
        let Some(found) = self.near(guesses, PATIENT_STEP)? else {
            return Ok(());
        };
        self.first[0] += count;
        let mut lost = Vec::new();
        for (k, (x, found)) in states.iter().zip(&found).enumerate() {
            if let Err(miss) = found {
                self.missed(x, miss.clone());
                if k < 1 << n && n <= MOST_SEARCHED_IN_CORNERS {
                    lost.push(x.clone());
                }
            }
        }
        let most = self.most_value();
        let tracks: Vec<Track> = (found.into_iter().zip(sheets))
            .filter_map(|(found, sheet)| {
                let (path, value) = found.ok().filter(|(_, value)| *value <= most)?;
                Some(Track {
                    path,
                    value,
                    sheet,
                    whole: true,
                })
            })
            .collect();
        self.states += tracks.len();
        self.add(tracks, floor)?;

        // A corner has no other states around it: without it a polynomial goes on there by itself.
        if !lost.is_empty() {
            let (tracks, _) = self.searched_in_budget(lost, FACES)?;
            self.add(tracks, floor)?;
        }
        Ok(())
    }

    /// States spread over the faces of bounds; the end of the horizon needs none.
    fn on_faces(&self, bounds: &[[f64; 2]]) -> Vec<Vec<f64>> {
        let n = bounds.len();
        let faces = 2 * n - usize::from(self.axis.is_some());
        (0..faces)
            .flat_map(|face| {
                let mut side = bounds.to_vec();
                side[face / 2] = [bounds[face / 2][face % 2]; 2];
                self.spread(&side, FIRST[n] / (2 * n))
            })
            .collect()
    }

    /// Wanted states, of these as many as the budget has room for.
    fn budgeted(&mut self, mut states: Vec<Vec<f64>>) -> Vec<Vec<f64>> {
        self.first[1] += states.len();
        states.truncate(self.states_left(1.0));
        states
    }

    /// As [`Work::searched`], of as many states, from the first on, as the budget has room for.
    fn searched_in_budget(
        &mut self,
        states: Vec<Vec<f64>>,
        share: f64,
    ) -> Result<(Vec<Track>, Vec<f64>), BackendError> {
        let n = self.cloud.variables;
        let states = self.budgeted(states);
        let mut states = self.of_levels(states);
        let (mut tracks, mut values) = (Vec::new(), Vec::new());
        let began = Instant::now();
        while !states.is_empty() {
            let fits = match self.aim.seconds {
                None => states.len() / n,
                // Without any state there is no map.
                Some(_) if self.first[0] == 0 => FIRST_BATCH,
                Some(_) if values.is_empty() && self.seconds_left(share) > 0.0 => FIRST_BATCH,
                Some(_) => Self::fitting(self.seconds_left(share), began, values.len()),
            };
            let rest = states.split_off(states.len().min(n * fits));
            if states.is_empty() {
                break;
            }
            let count = states.len() / n;
            let Some((found, own)) = self.in_time(GIVEN_UP, |this| this.searched(states, NEAR))?
            else {
                break;
            };
            self.first[0] += count;
            tracks.extend(found);
            values.extend(own);
            states = rest;
        }
        Ok((tracks, values))
    }
}

/// The corners of a box.
fn corners(bounds: &[[f64; 2]]) -> impl Iterator<Item = Vec<f64>> {
    (0..1usize << bounds.len()).map(move |corner| {
        let each = bounds.iter().enumerate();
        each.map(|(i, bound)| bound[corner >> i & 1]).collect()
    })
}
