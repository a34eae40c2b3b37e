//! States solved for where pieces want them, along the ways from points near.

use super::failures::Asked;
use super::{GIVEN_UP, NEAR, Work};
use crate::backend::BackendError;
use crate::map::pieces::{Region, Want};
use crate::map::workers::solved_by;
use crate::shooting::Path;
use crate::value::{FoundNear, Miss, PointStatus, Track, path_from, solve_near};

/// States asked for in a cell at once: this many times a power of its error over the one asked for,
/// and the most.
const A_CELL: f64 = 3.0;
const MORE: f64 = 0.4;
const MOST_A_CELL: f64 = 48.0;
/// A round solves for at most this many times the states solved before.
const GROWTH: f64 = 3.0;
const GROWTH_BY_QUARTERS: f64 = 2.0;
/// Shortest step of the way from a point of an extremal to a state near it.
const LEAST_STEP: f64 = 1.0 / 8.0;
/// A change of V by itself counts as so many widths of a cell.
const STEEP: f64 = 2.0;
/// Draws of a state in the part of a cell that lies in the region.
const DRAWS: usize = 20;
/// Draws of a place where V is promised to be of interest.
const DRAWS_BELOW_MAX: usize = 4;
/// Draws of which one nearest to the edge of a shadow is taken.
const DRAWS_AT_EDGE: usize = 8;

/// A state to be solved for, from which point of the cloud, for which cell.
pub(super) struct Task {
    /// With its time where the map has that axis.
    pub x: Vec<f64>,
    pub from: u32,
    cell: Asked,
    /// Half widths of the cell.
    pub half: Vec<f64>,
    /// No more states make the cell smaller.
    is_finest: bool,
    /// An edge of a shadow is asked for: a solution that leaves a guard tells of it, too.
    shaded: bool,
}

impl Work<'_, '_> {
    /// Solves for states in cells that want some, with a share of the budget; false where there is
    /// nothing to start from, or it takes too long.
    pub(super) fn answer(
        &mut self,
        wants: Vec<Want>,
        region: &Region,
        share: f64,
    ) -> Result<bool, BackendError> {
        let mut tasks = self.tasks(wants, region, share);
        if tasks.is_empty() {
            return Ok(false);
        }
        self.take_ends(&mut tasks);
        // Where sheets lie over each other a way from a point near tells nothing of the others.
        if self.cloud.several {
            self.search_for(tasks, region)
        } else {
            self.go(tasks, region)
        }
    }

    /// Solves for states along the ways from points near them; `None` if that takes too long.
    pub(super) fn near(
        &mut self,
        guesses: Vec<(Vec<f64>, Path)>,
        least_step: f64,
    ) -> Result<Option<Vec<FoundNear>>, BackendError> {
        self.in_time(GIVEN_UP, |this| {
            if let Some(workers) = this.workers {
                let width = 2 * this.plan.system.states;
                if let Some(found) = solved_by(workers, width, &guesses, least_step)? {
                    this.solver.deadline.check()?;
                    return Ok(found);
                }
            }
            solve_near(this.plan, this.solver, guesses, least_step)
        })
    }

    /// States for cells that want some.
    fn tasks(&mut self, mut wants: Vec<Want>, region: &Region, share: f64) -> Vec<Task> {
        let in_time = (self.seconds_left(share) / self.pace).max(0.0);
        let in_time = if in_time.is_nan() {
            usize::MAX
        } else {
            in_time as usize
        };
        let growth = if self.cloud.leaves_quarters() {
            GROWTH_BY_QUARTERS
        } else {
            GROWTH
        };
        let budget = self
            .states_left(share)
            .min((growth * self.states as f64) as usize)
            .min(in_time)
            .max(1);
        wants.sort_by(|a, b| b.excess.total_cmp(&a.excess));
        let mut tasks = Vec::new();
        // One for each in turn, the worst first: many in few cells at once would halve these where
        // their points lie alone.
        let quota = |w: &Want| (A_CELL * w.excess.max(1.0).powf(MORE)).min(MOST_A_CELL) as usize;
        for turn in 0..MOST_A_CELL as usize {
            for want in wants.iter().filter(|w| turn < quota(w)) {
                if tasks.len() >= budget {
                    break;
                }
                // No more points halve it, and its error may stay for ever.
                if turn == 0 && want.is_finest {
                    self.failures.add(Asked::of(want));
                }
                self.task(want, turn, region, &mut tasks);
            }
        }
        tasks
    }

    /// Searches for all sheets at the states; false if that takes too long.
    fn search_for(&mut self, tasks: Vec<Task>, region: &Region) -> Result<bool, BackendError> {
        let mut states = Vec::new();
        let mut widest = 0.0f64;
        for task in &tasks {
            let shift = &self.origins[task.from as usize].1;
            let at = states.len();
            states.extend(task.x.iter().zip(shift).map(|(x, s)| x + s));
            self.to_few_times(task, &mut states[at..]);
            widest = task.half.iter().fold(widest, |a, h| a.max(*h));
        }
        let Some((tracks, values)) =
            self.in_time(GIVEN_UP, |this| this.searched(states, widest.min(NEAR)))?
        else {
            return Ok(false);
        };
        for (task, v) in tasks.into_iter().zip(values) {
            if task.cell.only_bare || v.is_nan() {
                self.failures.add(task.cell);
            } else if !task.is_finest {
                self.failures.forgive(task.cell);
            }
        }
        self.add(tracks, region.floor)?;
        Ok(true)
    }

    /// Solves for the states along the ways from points near them; false if that takes too long.
    fn go(&mut self, tasks: Vec<Task>, region: &Region) -> Result<bool, BackendError> {
        let guesses: Vec<_> = tasks.iter().map(|e| self.way(&e.x, e.from)).collect();
        let Some(found) = self.near(guesses, LEAST_STEP)? else {
            return Ok(false);
        };
        let mut tracks = Vec::new();
        let most = self.most_value();
        for (task, found) in tasks.into_iter().zip(found) {
            let high = found.as_ref().is_ok_and(|(_, value)| *value > most);
            let is_missed = match &found {
                Ok(_) => high,
                Err(miss) => !(task.shaded && miss.as_ref().is_some_and(|m| m.cut.is_some())),
            };
            if task.cell.only_bare || is_missed {
                self.failures.add(task.cell);
            }
            let (path, value) = match found {
                Ok(_) if high => {
                    self.failed += 1;
                    self.above_max += 1;
                    continue;
                }
                Ok(found) => found,
                Err(miss) => {
                    let shift = &self.origins[task.from as usize].1;
                    let x: Vec<f64> = task.x.iter().zip(shift).map(|(x, s)| x + s).collect();
                    self.missed(&x, miss);
                    continue;
                }
            };
            self.states += 1;
            tracks.push(Track {
                path,
                value,
                sheet: self.cloud.sheet[task.from as usize],
                whole: true,
            });
        }
        self.add(tracks, region.floor)?;
        Ok(true)
    }

    /// Counts a state (absolute) that the way from a point near does not lead to.
    pub(super) fn missed(&mut self, x: &[f64], miss: Option<Miss>) {
        self.failed += 1;
        // Near a guard's shadow there is nothing to be found; elsewhere the way may only have been
        // a bad one.
        if !self.plan.system.guards.is_empty() {
            let why = miss.map_or((PointStatus::NotReached, None), |m| (m.status, m.cut));
            self.note(x, why);
        }
    }

    /// A way to a state of a cell, a bare corner or one that is drawn, from the nearest point.
    fn task(&mut self, want: &Want, turn: usize, region: &Region, tasks: &mut Vec<Task>) {
        let n = self.cloud.variables;
        let places = want.bare.len() / n;
        let bare = (turn < places).then(|| {
            let place = (turn + self.rounds) % places;
            want.bare[place * n..][..n].to_vec()
        });
        let is_in_error = want.excess > 1.0;
        let z = match bare {
            Some(z) if !is_in_error || self.may_be_below_max(want, &z, region) => z,
            _ if !is_in_error => return,
            _ => match self.place_for(want, turn, region) {
                Some(z) => z,
                None => {
                    self.failures.add(Asked::of(want));
                    return;
                }
            },
        };
        let Some(from) = self.start_for(want, &z, region) else {
            return;
        };
        // As many periods away as the point that it is reached from.
        let shift = &self.origins[from as usize].1;
        tasks.push(Task {
            x: self
                .frame
                .state(&z)
                .iter()
                .zip(shift)
                .map(|(x, s)| x - s)
                .collect(),
            from,
            cell: Asked::of(want),
            half: want
                .lo
                .iter()
                .zip(&want.hi)
                .map(|(lo, hi)| 0.5 * (hi - lo))
                .collect(),
            is_finest: want.is_finest,
            shaded: want.shaded.is_some(),
        });
    }

    /// A place drawn from a cell for the state of one turn. Where V is above the largest one of
    /// interest a state tells nothing, and others are drawn first.
    fn place_for(&mut self, want: &Want, turn: usize, region: &Region) -> Option<Vec<f64>> {
        let mut last = None;
        for _ in 0..DRAWS_BELOW_MAX {
            // Half of those that tell of the edge of a shadow lie next to it.
            let z = match &want.shaded {
                Some(_) if turn % 2 == 1 => self.next_to_edge(want, region),
                _ => self.inside(want, region),
            }?;
            let is_below = self.may_be_below_max(want, &z, region);
            last = Some(z);
            if is_below {
                break;
            }
        }
        last
    }

    /// Whether V at a place of a cell is of interest, as far as the nearest point tells.
    fn may_be_below_max(&self, want: &Want, z: &[f64], region: &Region) -> bool {
        region.value_max == f64::INFINITY
            || self.start_for(want, z, region).is_none_or(|k| {
                let (at, q) = (self.cloud.z(k as usize), self.cloud.q(k as usize));
                let steps = q.iter().zip(z.iter().zip(at));
                let change: f64 = steps.map(|(q, (z, at))| q * (z - at)).sum();
                self.cloud.v[k as usize] + change <= region.value_max
            })
    }

    /// The point from which a way leads to a place of a cell.
    fn start_for(&self, want: &Want, z: &[f64], region: &Region) -> Option<u32> {
        let n = self.cloud.variables;
        // In widths of the cell, and by how much V would change on the way.
        let distance = |k: u32| -> f64 {
            let (at, q) = (self.cloud.z(k as usize), self.cloud.q(k as usize));
            let (mut far, mut change) = (0.0, 0.0);
            for i in 0..n {
                far += ((z[i] - at[i]) / (want.hi[i] - want.lo[i])).powi(2);
                change += q[i] * (z[i] - at[i]);
            }
            far + (STEEP * change / self.cloud.v[k as usize].abs().max(region.floor)).powi(2)
        };
        (want.points.iter().copied())
            .filter(|k| self.goes_on(*k))
            .min_by(|a, b| distance(*a).total_cmp(&distance(*b)))
            .or_else(|| self.nearest(z))
    }

    /// A place drawn from the part of a cell that lies in the region, and not in a shadow.
    pub(super) fn inside(&mut self, want: &Want, region: &Region) -> Option<Vec<f64>> {
        (0..DRAWS).find_map(|_| self.drawn(want, region).filter(|z| !want.is_in_shadow(z)))
    }

    /// A place next to the edge of a shadow.
    fn next_to_edge(&mut self, want: &Want, region: &Region) -> Option<Vec<f64>> {
        let drawn: Vec<_> = (0..DRAWS_AT_EDGE)
            .filter_map(|_| self.drawn(want, region))
            .collect();
        (drawn.into_iter()).min_by(|a, b| want.margin(a).abs().total_cmp(&want.margin(b).abs()))
    }

    /// A place drawn from a cell, if it lies in the region.
    fn drawn(&mut self, want: &Want, region: &Region) -> Option<Vec<f64>> {
        let z: Vec<f64> = (want.lo.iter().zip(&want.hi))
            .map(|(lo, hi)| lo + (hi - lo) * self.uniform())
            .collect();
        region.covers(&self.frame.state(&z)).then_some(z)
    }

    /// The point nearest to a place, of all.
    pub(super) fn nearest(&self, z: &[f64]) -> Option<u32> {
        let distance = |k: usize| -> f64 {
            self.cloud
                .z(k)
                .iter()
                .zip(z)
                .map(|(a, b)| (a - b).powi(2))
                .sum()
        };
        (0..self.cloud.len())
            .filter(|k| self.goes_on(*k as u32))
            .min_by(|a, b| distance(*a).total_cmp(&distance(*b)))
            .map(|k| k as u32)
    }

    /// Whether a point's track goes on from there: one at the end of a horizon is no guess of
    /// another.
    pub(super) fn goes_on(&self, k: u32) -> bool {
        let track = self.points.track[self.origins[k as usize].0 as usize];
        self.tracks[track as usize].path.segments() > 0
    }

    /// The path from a point of the cloud on.
    pub(super) fn guess(&self, k: u32) -> Path {
        let (point, _) = &self.origins[k as usize];
        let number = *point as usize;
        let track = self.points.track[number] as usize;
        let t = self.points.t[number];
        let mut later: Vec<(f64, &[f64])> = (self.of_track[track].iter())
            .map(|q| (self.points.t[*q as usize], self.points.node(*q as usize)))
            .filter(|(q, _)| t < 0.0 && *q > t && *q < 0.0)
            .collect();
        later.sort_by(|a, b| a.0.total_cmp(&b.0));
        path_from(&self.tracks[track], self.points.node(number), t, &later)
    }
}
