//! The first search within the budget.

use super::{NEAR, Work};
use crate::backend::BackendError;
use crate::value::Track;
use std::time::Instant;

/// With a limit of seconds, states of the first batch: a batch is finished, and how long one takes is not known before.
const FIRST_BATCH: usize = 8;
/// Share of the seconds that the first states within the region may take, and those on its faces after them.
pub(super) const WITHIN: f64 = 0.5;
pub(super) const FACES: f64 = 0.75;

impl Work<'_, '_> {
    /// As [`Work::searched`], of as many states, from the first on, as the budget has room for.
    pub(super) fn searched_in_budget(
        &mut self,
        mut states: Vec<f64>,
        share: f64,
    ) -> Result<(Vec<Track>, Vec<f64>), BackendError> {
        let n = self.cloud.variables;
        self.first[1] += states.len() / n;
        states.truncate(n * self.states_left(1.0));
        let (mut tracks, mut values) = (Vec::new(), Vec::new());
        let began = Instant::now();
        while !states.is_empty() {
            let fits = match self.aim.seconds {
                None => states.len() / n,
                // Without any state there is no map.
                Some(_) if self.first[0] == 0 => FIRST_BATCH,
                Some(_) if values.is_empty() && self.seconds_left(share) > 0.0 => FIRST_BATCH,
                Some(_) => {
                    let pace = began.elapsed().as_secs_f64() / values.len() as f64;
                    (self.seconds_left(share).max(0.0) / pace) as usize
                }
            };
            let rest = states.split_off(states.len().min(n * fits));
            if states.is_empty() {
                break;
            }
            self.first[0] += states.len() / n;
            let (found, own) = self.searched(states, NEAR)?;
            tracks.extend(found);
            values.extend(own);
            states = rest;
        }
        Ok((tracks, values))
    }
}
