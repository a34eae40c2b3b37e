//! Guesses for single states from trajectories that are optimized directly.

use super::{Lost, Progress, Survey, times};
use crate::backend::BackendError;
use crate::shooting::Solver;
use crate::value::direct::{CARRIED_FROM, Direct, MOVED_FROM, Optimized, Round};
use crate::value::extremal::is_elsewhere;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Guesses that are optimized in a round, and rounds at most.
const GUESSES: u64 = 12;
const ROUNDS: u64 = 12;
/// From this round on there is to be a trajectory a round, or it leads nowhere.
const LEAST_ROUNDS: u64 = 2;
/// Costs nearer to each other than this share are one.
const SAME: f64 = 0.01;
/// Rounds at least.
const LEAST: u64 = 2;
/// Times that the cheapest trajectory is to be found; or, of all that was found, one in so many.
const TIMES: usize = 3;
const ONE_OF: usize = 8;
/// Minima that may be left, of those to be expected.
const UNSEEN: f64 = 0.5;
/// Guesses, times and rounds where all guesses lead to costs that are alike: from these many states
/// over the region, most of which lead somewhere.
const PROBES: usize = 16;
const PLAIN: (u64, usize, u64) = (3, 1, 1);
/// Another trajectory that costs at most this many times the cheapest leaves it in doubt.
const RIVAL: f64 = 3.0;
/// Trajectories that cost at most this many times the least are solved from, and so many of them.
const ABOVE: f64 = 1.3;
const TRIED: usize = 4;
/// Share by which the cost of what was optimized is off, at most where it is smooth.
pub(super) const OFF: f64 = 2e-3;
/// Shortest steps, as shares of the way.
const FROM_OPTIMIZED: f64 = 1.0 / 16.0;

/// Rounds in turn without anything cheaper, by this share, that end the search from guesses of a kind.
const QUIET_ROUNDS: u64 = 2;
const CHEAPER: f64 = 1e-6;

/// Targets that are looked at together: each holds what was found for it.
const TOGETHER: usize = 64;

/// Guesses for a target.
pub(super) struct Asked {
    pub target: usize,
    pub guesses: Vec<u64>,
    /// Cost that what is looked for has about at most.
    pub most: f64,
    /// A trajectory from there, for guesses that begin with it.
    pub known: Option<Optimized>,
}

/// The cheapest trajectory that was found from each target.
type Best = BTreeMap<usize, Optimized>;

fn keep_best(best: &mut Best, target: usize, found: &[Optimized]) {
    for one in found {
        if best.get(&target).is_none_or(|known| one.cost < known.cost) {
            best.insert(target, one.clone());
        }
    }
}

/// Whether there are hardly others than those that were found, of costs that are of interest: of n
/// searches that came to w minima, w (n - 1) / (n - w - 2) are to be expected (Boender and Rinnooy
/// Kan, Mathematical Programming 37, 1987).
fn is_all(costs: &[f64], least: f64) -> bool {
    let mut near: Vec<f64> = (costs.iter().copied())
        .filter(|cost| *cost < times(RIVAL, least))
        .collect();
    near.sort_by(f64::total_cmp);
    let mut distinct: Vec<f64> = Vec::new();
    for cost in &near {
        if distinct.last().is_none_or(|last| !same(*cost, *last)) {
            distinct.push(*cost);
        }
    }
    let (n, w) = (near.len() as f64, distinct.len() as f64);
    // Where all come to one there is nothing to count.
    distinct.len() <= 1 || n > w + 2.0 && w * (n - 1.0) / (n - w - 2.0) < w + UNSEEN
}

/// Whether costs are about equal.
fn same(a: f64, b: f64) -> bool {
    (a - b).abs() <= SAME * b.abs()
}

impl Survey<'_> {
    /// Solves single states from trajectories that are optimized directly, in rounds until the
    /// cheapest one was found several times: from guesses that depend on the state alone. The
    /// states that are left in doubt.
    pub(super) fn try_optimized(
        &mut self,
        solver: &mut Solver,
        direct: &Direct<'_>,
        targets: &[usize],
        progress: Progress<'_>,
    ) -> Result<Vec<usize>, BackendError> {
        let (count, times, least) = if self.is_plain(solver, direct) {
            PLAIN
        } else {
            (GUESSES, TIMES, LEAST)
        };
        // Costs of all that was found for each target.
        let mut costs: Vec<Vec<f64>> = vec![Vec::new(); self.targets.len()];
        let mut best = Best::default();
        let mut left = targets.to_vec();
        for round in 0..ROUNDS {
            let mut found: Vec<(usize, Optimized)> = Vec::new();
            for together in left.chunks(TOGETHER) {
                let asked = (together.iter())
                    .map(|t| Asked {
                        target: *t,
                        guesses: (round * count..(round + 1) * count).collect(),
                        most: f64::INFINITY,
                        known: None,
                    })
                    .collect();
                let rounds = self.rounds(solver, direct, asked)?;
                for (&target, round) in together.iter().zip(rounds) {
                    costs[target].extend(round.costs);
                    keep_best(&mut best, target, &round.found);
                    found.extend(self.promising(target, round.found));
                }
            }
            self.solve_from(solver, direct, found)?;
            progress(
                "from optimized trajectories",
                self.solved(),
                self.targets.len(),
            );
            left.retain(|t| {
                let leads_on = costs[*t].len() as u64 > round || round < LEAST_ROUNDS;
                let is_confirmed = round + 1 >= least && self.is_confirmed(*t, &costs[*t], times);
                leads_on && !is_confirmed
            });
            if left.is_empty() {
                break;
            }
        }
        let is_doubtful = |t: &usize| {
            let least = self.least_value(*t);
            let rivals = |cost: &f64| !same(*cost, least) && *cost < super::times(RIVAL, least);
            !self.is_confirmed(*t, &costs[*t], times) || costs[*t].iter().any(rivals)
        };
        let doubtful: Vec<usize> = targets.iter().copied().filter(is_doubtful).collect();
        for kind in [
            (CARRIED_FROM, "from carried trajectories"),
            (MOVED_FROM, "from moved trajectories"),
        ] {
            self.try_further(solver, direct, &doubtful, kind, &mut best, progress)?;
        }
        self.follow_lost(solver)?;
        Ok(doubtful)
    }

    /// The same from further guesses, in rounds until some in turn lead to nothing cheaper.
    fn try_further(
        &mut self,
        solver: &mut Solver,
        direct: &Direct<'_>,
        targets: &[usize],
        (first, what): (u64, &str),
        best: &mut Best,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        let mut left: Vec<(usize, u64)> = targets.iter().map(|t| (*t, 0)).collect();
        for round in 0..ROUNDS {
            let first = first + round * GUESSES;
            for together in left.chunks_mut(TOGETHER) {
                let asked = (together.iter())
                    .map(|(target, _)| Asked {
                        target: *target,
                        guesses: (first..first + GUESSES).collect(),
                        most: self.least_value(*target),
                        known: best.get(target).cloned(),
                    })
                    .collect();
                let rounds = self.rounds(solver, direct, asked)?;
                let before: Vec<f64> = (together.iter())
                    .map(|(t, _)| self.least_value(*t))
                    .collect();
                let mut found = Vec::new();
                for ((target, _), round) in together.iter().zip(rounds) {
                    keep_best(best, *target, &round.found);
                    found.extend(self.promising(*target, round.found));
                }
                self.solve_from(solver, direct, found)?;
                for ((target, quiet), before) in together.iter_mut().zip(before) {
                    let is_cheaper = self.least_value(*target) < times(1.0 - CHEAPER, before);
                    *quiet = if is_cheaper { 0 } else { *quiet + 1 };
                }
            }
            progress(what, self.solved(), self.targets.len());
            left.retain(|(_, quiet)| *quiet < QUIET_ROUNDS);
            if left.is_empty() {
                break;
            }
        }
        Ok(())
    }

    /// What guesses lead to from some targets.
    ///
    /// # Errors
    /// [`BackendError::OutOfTime`].
    pub(super) fn rounds(
        &mut self,
        solver: &Solver,
        direct: &Direct<'_>,
        asked: Vec<Asked>,
    ) -> Result<Vec<Round>, BackendError> {
        for one in &asked {
            self.starts[one.target] += one.guesses.len() as u32;
        }
        let from: Vec<(Vec<f64>, Asked)> = (asked.into_iter())
            .map(|asked| (self.state(asked.target, 0), asked))
            .collect();
        let end = &solver.scheme.end;
        let rounds = (from.par_iter())
            .map(|(s, asked)| {
                direct.optimized(s, &asked.guesses, asked.most, asked.known.as_ref(), end)
            })
            .collect();
        // What took longer was left out.
        solver.deadline.check()?;
        Ok(rounds)
    }

    /// Whether from states over the whole region all guesses lead to about the same.
    fn is_plain(&self, solver: &Solver, direct: &Direct<'_>) -> bool {
        let stones = self.stones();
        let probes = stones
            .chunks(self.targets.states)
            .step_by(stones.len() / self.targets.states / PROBES);
        let mut led = 0;
        for x in probes {
            let s: Vec<f64> = x
                .iter()
                .zip(&self.plan.system.reference)
                .map(|(x, r)| x - r)
                .collect();
            let guesses: Vec<u64> = (0..GUESSES).collect();
            let round = direct.optimized(&s, &guesses, f64::INFINITY, None, &solver.scheme.end);
            if !round.is_plain() {
                return false;
            }
            led += usize::from(!round.costs.is_empty());
        }
        led >= PROBES - PROBES / 4
    }

    /// Whether the least that is known of a target was found often enough.
    fn is_confirmed(&self, target: usize, costs: &[f64], times: usize) -> bool {
        let least = self.least_value(target);
        let known = costs.iter().copied().fold(least, f64::min);
        let hits = costs.iter().filter(|cost| same(**cost, known)).count();
        same(least, known) && hits >= times.max(costs.len() / ONE_OF) && is_all(costs, known)
    }

    /// Whether a trajectory is about a solution of its target: ways about an obstacle may begin with
    /// one adjoint, and only their costs tell them apart.
    pub(super) fn is_solved(&self, target: usize, one: &Optimized) -> bool {
        let mut known = self.at[target].iter().map(|e| &self.extremals[*e]);
        known.any(|e| {
            (e.value() - one.cost).abs() <= OFF * e.value().abs()
                && !is_elsewhere(e, one.path.node(0), &self.scales)
        })
    }

    /// The cheapest of what was found for a target, by rising cost, those that differ and are new.
    fn promising(&self, target: usize, mut optimized: Vec<Optimized>) -> Vec<(usize, Optimized)> {
        optimized.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        let known =
            (optimized.first()).map_or(f64::INFINITY, |o| o.cost.min(self.least_value(target)));
        optimized.retain(|one| !self.is_solved(target, one));
        let mut worth: Vec<(usize, Optimized)> = Vec::new();
        for one in optimized {
            let is_new = worth.iter().all(|(_, other)| !same(one.cost, other.cost));
            if is_new && one.cost <= times(ABOVE, known) && worth.len() < TRIED {
                worth.push((target, one));
            }
        }
        worth
    }

    /// Solves along trajectories that were optimized; what that does not lead to is optimized with
    /// shorter steps. What is cheaper than all solutions after that is kept.
    pub(super) fn solve_from(
        &mut self,
        solver: &mut Solver,
        direct: &Direct<'_>,
        mut found: Vec<(usize, Optimized)>,
    ) -> Result<(), BackendError> {
        self.solve_along_all(solver, &found)?;
        // What was shortened in vain before need not be again.
        let is_new = |target: &usize, cost: f64| {
            let known = self.lost.get(target);
            known.is_none_or(|known| (known.cost - cost).abs() > OFF * cost.abs())
        };
        found.retain(|(t, one)| self.is_lost(*t, one.cost) && is_new(t, one.cost));
        let end = &solver.scheme.end;
        let shorter: Vec<Option<Optimized>> = (found.par_iter())
            .map(|(_, one)| direct.refined(one, end))
            .collect();
        solver.deadline.check()?;
        // With their costs before.
        let mut lost: Vec<(f64, (usize, Optimized))> = (found.into_iter().zip(shorter))
            .map(|((target, one), shorter)| (one.cost, (target, shorter.unwrap_or(one))))
            .collect();
        lost.retain(|(_, (target, one))| self.is_lost(*target, one.cost));
        let (costs, lost): (Vec<f64>, Vec<(usize, Optimized)>) = lost.into_iter().unzip();
        self.solve_along_all(solver, &lost)?;
        for (cost, (target, one)) in costs.into_iter().zip(lost) {
            let known = self.lost.get(&target);
            let is_cheapest = known.is_none_or(|known| cost < known.cost);
            if is_cheapest && self.is_lost(target, one.cost) {
                let attained = direct.attained(&one);
                let path = one.path;
                let lost = Lost {
                    cost,
                    attained,
                    path,
                };
                self.lost.insert(target, lost);
            }
        }
        Ok(())
    }

    /// Whether a trajectory that was optimized costs less than what was solved for.
    pub(super) fn is_lost(&self, target: usize, cost: f64) -> bool {
        times(1.0 + OFF, cost) < self.least_value(target)
    }

    /// What is cheaper than all solutions, and too rough a guess as a whole, is followed from its end;
    /// whether that leads to any.
    pub(super) fn follow_lost(&mut self, solver: &mut Solver) -> Result<bool, BackendError> {
        let rough = (self.lost.iter())
            .filter(|(t, lost)| self.is_lost(**t, lost.cost))
            .map(|(t, lost)| (*t, lost.path.clone()));
        let rough: Vec<_> = rough.collect();
        if rough.is_empty() {
            return Ok(false);
        }
        self.send_grown(solver, rough, FROM_OPTIMIZED)?;
        let before = self.lost.len();
        let lost = std::mem::take(&mut self.lost);
        self.lost = (lost.into_iter())
            .filter(|(t, lost)| self.is_lost(*t, lost.cost))
            .collect();
        Ok(self.lost.len() < before)
    }

    fn solve_along_all(
        &mut self,
        solver: &mut Solver,
        found: &[(usize, Optimized)],
    ) -> Result<(), BackendError> {
        let mut tasks = Vec::new();
        for (target, one) in found {
            tasks.extend(self.task_along(*target, one.path.clone(), FROM_OPTIMIZED));
        }
        self.send(solver, tasks)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn many_minima_seldom_found_leave_others_to_be_found() {
        assert!(is_all(&[5.0, 5.01, 4.99], 4.99), "all the same");
        let often = [1.0, 1.0, 1.5, 1.0, 1.5, 1.0, 1.0, 1.5, 1.0, 1.0, 1.5, 1.0];
        // 2 of 12: 2.75 are to be expected; of 24, 2.3.
        assert!(!is_all(&often, 1.0));
        assert!(is_all(&[often, often].concat(), 1.0));
        let each: Vec<f64> = (0..24).map(|k| 1.0 + 0.05 * f64::from(k)).collect();
        assert!(!is_all(&each, 1.0));
        // What is far too dear is of no interest.
        let dear: Vec<f64> = each.iter().map(|cost| 10.0 * cost).collect();
        assert!(is_all(&[vec![1.0; 6], dear].concat(), 1.0));
    }
}
