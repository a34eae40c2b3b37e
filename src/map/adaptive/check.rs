//! Fresh states, which the map never used: what it says of them, and more states where it is wrong.

use super::{CHECK_GIVEN_UP, GIVEN_UP, Hole, NEAR, Work};
use crate::backend::BackendError;
use crate::map::pieces::{Pieces, Region, Said, Want};
use crate::numeric::quantile::nearest_rank;
use crate::shooting::Path;
use crate::value::PointStatus;
use std::time::Instant;

/// Rounds of fresh states.
pub(super) const CHECKS: usize = 4;
/// Times of fresh states, where time is an axis.
const TIMES: usize = 8;
/// Share of fresh states whose error may be above the bound.
pub const ABOVE_BOUND: f64 = 0.01;
/// With a limit of seconds: fresh states of the first batch, and the share of the limit that all of
/// them may take about.
const FIRST_CHECKED: usize = 16;
const CHECK_SHARE: f64 = 0.25;
/// V above that of all points by more than this share is not known.
const ABOVE_POINTS: f64 = 0.5;
/// So many times its bound the error of one alone is too much.
pub const GROSS: f64 = 3.0;
/// States in a cell that a fresh state has shown to be wrong, which are searched for all sheets.
const SEARCHED: usize = 4;
/// Draws of a fresh state, where guards exclude states.
const MOST_DRAWN: usize = 256;
/// States that tell where the error is met.
const LOOKED_AT: usize = 4096;

/// A fresh state and what the map says of it.
#[derive(Clone, Debug)]
pub struct Checked {
    /// Of a map with a time axis the time is the last component.
    pub x: Vec<f64>,
    pub status: PointStatus,
    /// V solved for, and said with its bound; NaN where there is none.
    pub solved: f64,
    pub said: f64,
    pub bound: f64,
}

impl Checked {
    pub(super) fn of(x: &[f64], (status, solved): (PointStatus, f64), said: Option<&Said>) -> Self {
        Self {
            x: x.to_vec(),
            status,
            solved,
            said: said.map_or(f64::NAN, |s| s.v),
            bound: said.map_or(f64::NAN, |s| s.v_bound),
        }
    }
}

/// A point that a solution meets, with V.
pub(super) type Met = (Vec<f64>, f64);

/// What is said in the end, and how much of the region is not.
pub(super) struct Judged {
    pub pieces: Pieces,
    /// As in [`super::Adaptive`].
    pub unmet: Part,
    pub unknown: Part,
    pub uncertain: f64,
}

/// A part of the region.
#[derive(Clone, Debug, Default)]
pub struct Part {
    /// Of the region's volume.
    pub share: f64,
    /// Where nine tenths of it lie along each variable; empty where there is none.
    pub bounds: Vec<[f64; 2]>,
}

impl Part {
    fn of(states: &[&Vec<f64>], all: usize) -> Self {
        let variables = states.first().map_or(0, |x| x.len());
        let bounds = (0..variables).map(|i| {
            let mut along: Vec<f64> = states.iter().map(|x| x[i]).collect();
            along.sort_by(f64::total_cmp);
            [nearest_rank(&along, 0.05), nearest_rank(&along, 0.95)]
        });
        Self {
            // Where guards leave nothing to look at nothing is known.
            share: if all == 0 {
                1.0
            } else {
                states.len() as f64 / all as f64
            },
            bounds: bounds.collect(),
        }
    }
}

const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

/// A number from 0 to 1 of which close arguments tell nothing.
pub(super) fn mixed(mut z: u64) -> f64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}

/// Whether a state has no solution, as far as a search tells; one that a guard itself excludes is
/// not asked about.
fn is_without_solution(status: PointStatus) -> bool {
    use PointStatus::{Fold, Horizon, LeavesGuard, NoGuess, NotFinite, NotReached};
    matches!(
        status,
        Fold | Horizon | LeavesGuard | NoGuess | NotFinite | NotReached
    )
}

impl Work<'_, '_> {
    /// Pieces without those that are too uncertain; judged by many states, since cells reach over
    /// the region's faces.
    pub(super) fn judged(&self, mut pieces: Pieces) -> Judged {
        // A polynomial of 1/V or log V goes on to any V where no solution exists.
        pieces.region.value_max = pieces.region.value_max.min(self.highest());
        // V of a game may jump.
        if self.cloud.several && !self.plan.game {
            pieces.admit_cliffs();
        }
        let mut looked_at = self.spread(&self.bounds, LOOKED_AT);
        // Of states that guards exclude nothing is to be said.
        if let Some(guarded) = &self.guarded {
            looked_at = guarded.admitted(looked_at);
        }
        let all = looked_at.len();
        let region = &pieces.region;
        // Whether each meets the error, where anything is said.
        let meets = |here: Said| here.v_bound <= region.error * here.v.abs().max(region.floor);
        let met: Vec<Option<bool>> = looked_at.iter().map(|x| pieces.at(x).map(meets)).collect();
        // Nothing is said above the largest V of interest; of a map without pieces nothing is.
        let may_be_above = self.aim.value_max.is_some() && !pieces.pieces.is_empty();
        let pieces = pieces.within(self.aim.error_max);
        let (mut unmet, mut unknown) = (Vec::new(), Vec::new());
        let mut uncertain = 0;
        for (x, met) in looked_at.iter().zip(met) {
            let left_out = met.is_some() && pieces.at(x).is_none();
            uncertain += usize::from(left_out);
            if left_out || (met.is_none() && !may_be_above) {
                unknown.push(x);
                unmet.push(x);
            } else if met == Some(false) {
                unmet.push(x);
            }
        }
        Judged {
            uncertain: uncertain as f64 / all.max(1) as f64,
            unmet: Part::of(&unmet, all),
            unknown: Part::of(&unknown, all),
            pieces,
        }
    }

    /// The highest V that may lie between points.
    fn highest(&self) -> f64 {
        let most = self
            .cloud
            .v
            .iter()
            .copied()
            .fold(f64::NEG_INFINITY, f64::max);
        most + ABOVE_POINTS * most.abs()
    }

    /// Fresh states of which the map says too small a bound; none where they are few enough.
    pub(super) fn wrong(check: &[Checked]) -> Vec<&Checked> {
        let wrong: Vec<&Checked> = (check.iter())
            .filter(|c| c.status != PointStatus::AboveMax && (c.said - c.solved).abs() > c.bound)
            .collect();
        let enough = wrong.len() as f64 <= ABOVE_BOUND * check.len() as f64;
        let gross = |c: &&Checked| (c.said - c.solved).abs() > GROSS * c.bound;
        if enough && !wrong.iter().any(gross) {
            Vec::new()
        } else {
            wrong
        }
    }

    /// Fresh states without a solution of which the map says a value; none where they are few
    /// enough.
    pub(super) fn unfounded(check: &[Checked]) -> Vec<&Checked> {
        let unfounded: Vec<&Checked> = (check.iter())
            .filter(|c| is_without_solution(c.status) && c.said.is_finite())
            .collect();
        let enough = unfounded.len() as f64 <= ABOVE_BOUND * check.len() as f64;
        if enough { Vec::new() } else { unfounded }
    }

    /// Notes a state (absolute) if a search found no solution there, or one that leaves a guard.
    pub(super) fn note(&mut self, x: &[f64], (status, cut): (PointStatus, Option<Path>)) {
        let leaves_guard = status == PointStatus::LeavesGuard;
        // Behind a fold of a game there is no solution: its edge is that of the points.
        if is_without_solution(status) && (leaves_guard || !self.plan.game) {
            self.unanswered.push(Hole {
                x: x.to_vec(),
                cut: cut.filter(|_| leaves_guard),
                leaves_guard,
                clearances: Vec::new(),
            });
        }
    }

    /// Searches for states in the cells that said too little of their errors; what more is wanted
    /// in these.
    pub(super) fn searched_around(
        &mut self,
        wrong: &[&Checked],
        pieces: &Pieces,
        region: &Region,
    ) -> Result<Vec<Want>, BackendError> {
        let more: Vec<Want> = wrong.iter().map(|c| self.want_around(pieces, c)).collect();
        // A guard may have cut off what the map goes by there.
        let too_low = wrong.iter().filter(|c| c.said < c.solved);
        self.asked.extend(too_low.map(|c| (c.x.clone(), c.solved)));
        let mut states = Vec::new();
        for (want, c) in more.iter().zip(wrong) {
            states.extend(&c.x);
            for _ in 1..SEARCHED {
                let mut x = (self.inside(want, region))
                    .map(|z| self.frame.state(&z))
                    .unwrap_or_default();
                if let (Some(t), Some(_)) = (x.last_mut(), &self.axis) {
                    // Of as many times as there are already.
                    *t = c.x[c.x.len() - 1];
                }
                states.extend(x);
            }
        }
        if !states.is_empty()
            && let Some((tracks, _)) = self.in_time(GIVEN_UP, |this| this.searched(states, NEAR))?
        {
            self.add(tracks, region.floor)?;
        }
        Ok(more)
    }

    /// Fresh states, solved from scratch and looked up; and what their solutions meet outside the
    /// region, with V.
    pub(super) fn checked(
        &mut self,
        pieces: &Pieces,
    ) -> Result<(Vec<Checked>, Vec<Met>), BackendError> {
        let n = self.cloud.variables;
        let mut states = self.fresh(self.aim.check);
        if self.axis.is_some() {
            // Of as many times as there are, the first ones'.
            for k in TIMES..states.len() / n {
                states[k * n + n - 1] = states[(k % TIMES) * n + n - 1];
            }
        }
        let (mut all, mut of) = (Vec::new(), Vec::new());
        let began = Instant::now();
        loop {
            let done = of.len();
            // A check is not part of the budget, but does not take much longer.
            let room = match (self.aim.seconds, done) {
                (None, _) => states.len() / n,
                (Some(_), 0) => FIRST_CHECKED,
                (Some(seconds), _) => {
                    let left = CHECK_SHARE * seconds - began.elapsed().as_secs_f64();
                    Self::fitting(left, began, done)
                }
            };
            let batch: Vec<f64> = states[done * n..].iter().copied().take(room * n).collect();
            if batch.is_empty() {
                break;
            }
            let count = batch.len() / n;
            let Some(found) = self.in_time(CHECK_GIVEN_UP, |this| this.solve(batch, false))? else {
                break;
            };
            of.resize(done + count, (0, 0));
            for (numbers, answers) in found {
                for (number, target) in numbers.iter().zip(&answers.targets.of_given) {
                    of[done + number] = (all.len(), *target);
                }
                all.push((numbers, answers));
            }
        }
        states.truncate(of.len() * n);
        let met = self.met_beyond(&all, &pieces.region)?;
        let check = (states.chunks(n).zip(of))
            .map(|(x, (group, target))| {
                let answers = &all[group].1;
                let above = answers
                    .answer(target)
                    .is_some_and(|a| self.aim.value_max.is_some_and(|most| a.value > most));
                let status = if above {
                    PointStatus::AboveMax
                } else {
                    answers.status(target)
                };
                let solved = answers.answer(target).map_or(f64::NAN, |e| e.value);
                Checked::of(x, (status, solved), pieces.at(x).as_ref())
            })
            .collect();
        Ok((check, met))
    }

    /// More states for the cell round a fresh state.
    fn want_around(&self, pieces: &Pieces, checked: &Checked) -> Want {
        let mut z = vec![0.0; checked.x.len()];
        self.frame.of(&checked.x, &mut z);
        let cell = &pieces.cells[pieces.cell(&z)];
        let more = |i: usize| 0.3 * (cell.hi[i] - cell.lo[i]);
        let near = |k: &u32| {
            let at = self.cloud.z(*k as usize);
            (0..z.len()).all(|i| at[i] >= cell.lo[i] - more(i) && at[i] <= cell.hi[i] + more(i))
        };
        Want {
            lo: cell.lo.clone(),
            hi: cell.hi.clone(),
            excess: (checked.said - checked.solved).abs() / checked.bound * 2.0,
            bare: Vec::new(),
            points: (0..self.cloud.len() as u32).filter(near).collect(),
            near: 0,
            is_finest: false,
            shaded: None,
        }
    }

    /// Fresh states of the region (absolute) that no guard excludes, if some are found, in an order
    /// without end. The seed asked for turns them, and nothing else of a map.
    fn fresh(&mut self, count: usize) -> Vec<f64> {
        let bounds = self.bounds.clone();
        let turn = |i: usize| match self.plan.seed {
            0 => 0.0,
            seed => mixed(seed.wrapping_add((i as u64 + 1).wrapping_mul(GOLDEN))),
        };
        let turns: Vec<f64> = (0..bounds.len()).map(turn).collect();
        (0..count)
            .flat_map(|_| {
                let mut x = Vec::new();
                for _ in 0..MOST_DRAWN {
                    x = (bounds.iter().zip(&turns))
                        .map(|([lo, hi], turn)| lo + (hi - lo) * (self.uniform() + turn).fract())
                        .collect();
                    if !self.is_excluded(&x) {
                        break;
                    }
                }
                x
            })
            .collect()
    }

    /// A number from 0 to 1 (splitmix64).
    pub(super) fn uniform(&mut self) -> f64 {
        self.random = self.random.wrapping_add(GOLDEN);
        mixed(self.random)
    }
}
