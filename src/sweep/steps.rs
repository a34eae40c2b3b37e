//! How far trajectories go from one front to the next: what lies between fronts is compared with
//! nothing.

use super::plan::Plan;
use crate::backend::Trajectories;
use serde::{Deserialize, Serialize};

/// Fronts are far apart where a trajectory goes more of the region from one to the next.
const FAR: f64 = 0.5;
/// Where it comes to no front, less is too much: all of it is compared with nothing.
const FAR_ALONE: f64 = 0.25;

/// The longest ways of trajectories within the region, in its widths.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Steps {
    /// From one front to the next, from the seed to the first and from the last to the end.
    #[serde(rename = "longest_step")]
    pub longest: f64,
    /// Of those that come to no front.
    #[serde(rename = "longest_without_front")]
    pub alone: f64,
    /// How many come to no front.
    #[serde(rename = "trajectories_without_front")]
    pub without: usize,
    /// How many come to one.
    #[serde(rename = "trajectories_with_fronts")]
    pub with: usize,
}

impl Steps {
    /// Those of trajectory `i` of a batch, from its seed on.
    pub(super) fn of(plan: &Plan, seed: &[f64], batch: &Trajectories, i: usize) -> Self {
        let n = plan.system.states;
        let within = |k: usize, x: f64| match plan.periodic[k] {
            true => x,
            false => x.clamp(plan.region[k][0], plan.region[k][1]),
        };
        let way = |x: &[f64], y: &[f64]| {
            (0..n)
                .map(|k| (within(k, x[k]) - within(k, y[k])).abs() / plan.widths[k])
                .fold(0.0, f64::max)
        };
        let passed = (plan.inner..batch.levels)
            .map(|level| &batch.sample(i, level)[1..=n])
            .take_while(|x| !x[0].is_nan());
        let (mut longest, mut passes, mut at) = (0.0f64, false, &seed[..n]);
        for x in passed {
            longest = longest.max(way(at, x));
            passes = true;
            at = x;
        }
        longest = longest.max(way(at, &batch.end[i * batch.dim..][..n]));
        match passes {
            true => Self {
                longest,
                with: 1,
                ..Self::default()
            },
            false => Self {
                alone: longest,
                without: 1,
                ..Self::default()
            },
        }
    }

    /// Those of both.
    #[must_use]
    pub(crate) fn and(self, other: Self) -> Self {
        Self {
            longest: self.longest.max(other.longest),
            alone: self.alone.max(other.alone),
            without: self.without + other.without,
            with: self.with + other.with,
        }
    }

    /// Whether fronts lie too far apart to tell of what is between them.
    #[must_use]
    pub fn far(&self) -> Option<Far> {
        let alone = Far::Alone {
            trajectories: self.without,
            of: self.without + self.with,
            way: self.alone,
        };
        (self.longest > FAR)
            .then_some(Far::Apart(self.longest))
            .or((self.alone > FAR_ALONE || self.without > self.with).then_some(alone))
    }
}

/// That fronts lie too far apart to tell of what is between them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Far {
    /// Trajectories go so much of the region from one front to the next.
    Apart(f64),
    /// Some come to no front, which go so much of it.
    Alone {
        trajectories: usize,
        of: usize,
        way: f64,
    },
}

impl std::fmt::Display for Far {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Apart(way) => write!(
                f,
                "trajectories go {way:.2} of the region from one front to the next"
            ),
            Self::Alone {
                trajectories,
                of,
                way,
            } => write!(
                f,
                "{trajectories} of {of} trajectories go up to {way:.2} of the region and come to no front"
            ),
        }
    }
}
