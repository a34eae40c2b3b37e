//! How a map agrees with fresh states, which were never used in it.

use super::Checked;
use crate::numeric::quantile::median_p99_max;
use crate::value::PointStatus;
use std::collections::BTreeMap;

/// How a map agrees with fresh states.
#[derive(Clone, Debug)]
pub struct Agreement {
    /// Fresh states with an answer to compare with.
    pub solved: usize,
    /// Others, by why V is not compared there.
    pub unsolved: BTreeMap<PointStatus, usize>,
    /// Of those solved how many the map knows.
    pub known: usize,
    /// |V of the map - V|, relative to V or to the map's floor where V is smaller: median, 99 % and
    /// largest.
    pub error: [f64; 3],
    /// The same over the map's bound of the error.
    pub over_bound: [f64; 3],
    /// States whose error is above the bound.
    pub above_bound: usize,
    /// The state at which it is most above it.
    pub worst: Option<Checked>,
    /// States without an answer for which the map has one, by why they have none.
    pub of_none: BTreeMap<PointStatus, usize>,
}

impl Agreement {
    /// Of checked states; `floor` is the map's.
    #[must_use]
    pub fn new(check: &[Checked], floor: f64) -> Self {
        let is_solved = |c: &&Checked| c.solved.is_finite() && c.status != PointStatus::AboveMax;
        let solved: Vec<&Checked> = check.iter().filter(is_solved).collect();
        let known: Vec<&Checked> = (solved.iter().copied())
            .filter(|c| c.said.is_finite())
            .collect();

        let off = |c: &Checked| (c.said - c.solved).abs();
        let error: Vec<f64> = (known.iter())
            .map(|c| off(c) / c.solved.abs().max(floor))
            .collect();
        // Where both are 0 the bound holds.
        let over = |c: &Checked| if off(c) == 0.0 { 0.0 } else { off(c) / c.bound };
        let over_bound: Vec<f64> = known.iter().map(|c| over(c)).collect();

        let worst = known.iter().max_by(|a, b| over(a).total_cmp(&over(b)));
        let unsolved = check.iter().filter(|c| !is_solved(c));
        let of_none = (check.iter())
            .filter(|c| !c.solved.is_finite() && c.said.is_finite())
            // Where a guard excludes a state, look-ups return nothing.
            .filter(|c| !matches!(c.status, PointStatus::AboveMax | PointStatus::OutsideGuard));
        Self {
            solved: solved.len(),
            known: known.len(),
            error: median_p99_max(&error),
            above_bound: over_bound.iter().filter(|o| **o > 1.0).count(),
            over_bound: median_p99_max(&over_bound),
            worst: worst.map(|c| (*c).clone()),
            unsolved: by_status(unsolved),
            of_none: by_status(of_none),
        }
    }
}

fn by_status<'c>(some: impl Iterator<Item = &'c Checked>) -> BTreeMap<PointStatus, usize> {
    some.fold(BTreeMap::new(), |mut counts, c| {
        *counts.entry(c.status).or_default() += 1;
        counts
    })
}
