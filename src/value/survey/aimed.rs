//! Guesses that may cost less than what is known at a target, put to the test: a trajectory of the
//! swept manifold is aimed at the target, and its cost is no guess.

use super::covered::{DEARER, FROM_CELL};
use super::{Survey, Task};
use crate::backend::BackendError;
use crate::shooting::Solver;
use crate::value::approach::Approach;
use crate::value::cover::{Aimed, Candidate, Cover, lower};
use crate::value::extremal::largest_of;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Guesses of one target that are put to the test.
const MOST_AIMED: usize = 6;
/// A trajectory that passes a target costs there less than what is known where it is below that by
/// more than this share; and certainly so.
const CHEAPER: f64 = 1e-4;
const CERTAINLY: f64 = 5e-3;
/// Of trajectories beside each other adjoints differ by at most this share.
const BESIDE: f64 = 0.05;

/// What aimed trajectories told.
pub(super) struct Aims {
    /// Targets at which a trajectory costs less than what is known, and no solution was found from
    /// it; with its cost.
    pub lost: BTreeMap<usize, f64>,
    /// Guesses that cost no less than what is known.
    pub dearer: Vec<Candidate>,
}

impl Survey<'_> {
    /// Tries the guesses that may cost less than what is known, from trajectories aimed at their
    /// targets. A guess is off by some hundredths, so those that promise a little more count, and by
    /// more where its cell's corners promise less.
    pub(super) fn aim(
        &mut self,
        solver: &mut Solver,
        cover: &Cover<'_>,
        mut candidates: Vec<Candidate>,
    ) -> Result<Aims, BackendError> {
        candidates.retain(|c| self.is_above(c, c.lowest, -DEARER));
        let expected = |c: &Candidate| 0.5 * (c.value + c.lowest);
        candidates
            .sort_by(|a, b| (a.target.cmp(&b.target)).then(expected(a).total_cmp(&expected(b))));
        let mut count: BTreeMap<usize, usize> = BTreeMap::new();
        candidates.retain(|c| {
            let of = count.entry(c.target).or_default();
            *of += 1;
            *of <= MOST_AIMED
        });
        let aimed = cover.aim(&candidates)?;
        let all: Vec<(Candidate, Aimed)> = (candidates.into_iter().zip(aimed))
            .filter_map(|(c, aimed)| Some((c, aimed?)))
            .collect();
        let (mut cheaper, dearer): (Vec<_>, Vec<_>) = (all.into_iter()).partition(|(c, aimed)| {
            self.is_above(c, aimed.value, CHEAPER) && !self.is_beside_known(c, aimed)
        });
        let windings: Vec<usize> = (cheaper.iter())
            .map(|(c, _)| self.winding(&c.turns))
            .collect();
        let tasks: Vec<Task> = (cheaper.par_iter().zip(windings))
            .map(|((c, aimed), winding)| {
                let path = cover.path_of(aimed, &solver.scheme.end)?;
                Ok(Task {
                    from: None,
                    target: c.target,
                    winding,
                    way: Approach::new(path, c.goal.clone(), FROM_CELL),
                })
            })
            .collect::<Result<_, BackendError>>()?;
        self.send(solver, tasks)?;
        cheaper.retain(|(c, aimed)| aimed.is_close && self.is_above(c, aimed.value, CERTAINLY));
        let mut lost = BTreeMap::new();
        for (c, aimed) in cheaper {
            lower(&mut lost, c.target, aimed.value);
        }
        let dearer = (dearer.into_iter()).filter_map(|(c, aimed)| aimed.is_close.then_some(c));
        Ok(Aims {
            lost,
            dearer: dearer.collect(),
        })
    }

    /// Whether a trajectory passes beside a solution known at its target: they fit within what it
    /// is off by.
    fn is_beside_known(&self, candidate: &Candidate, aimed: &Aimed) -> bool {
        self.known_at(candidate).any(|e| {
            let (p, q) = (aimed.adjoint(), e.adjoint());
            let off = aimed.value_by(&candidate.goal, q) - e.value();
            let apart = largest_of(&self.scales, |i| p[i] - q[i]);
            off.abs() <= CHEAPER * e.value().abs()
                && apart <= BESIDE * largest_of(&self.scales, |i| q[i])
        })
    }

    /// Whether all that is known of a guess's target costs more than `value`, by more than this
    /// share of it: solutions that leave a guard count.
    fn is_above(&self, candidate: &Candidate, value: f64, share: f64) -> bool {
        let above = |v: f64| v - value > share * value.abs();
        let least = self.lowest(candidate.target);
        least.is_none_or(|e| above(self.extremals[e].value()))
            && self.known_at(candidate).all(|e| above(e.value()))
    }
}
