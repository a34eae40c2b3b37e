//! How far trajectories go from one front to the next: what lies between fronts is compared with
//! nothing.

use super::plan::Plan;
use crate::backend::Trajectories;

/// Fronts are far apart where a trajectory goes more of the region from one to the next.
const FAR: f64 = 0.5;
/// Where it comes to no front, less is too much: all of it is compared with nothing.
const FAR_ALONE: f64 = 0.25;

/// The longest ways of trajectories within the region, in its widths.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Steps {
    /// From one front to the next, from the seed to the first and from the last to the end.
    pub longest: f64,
    /// Of those that come to no front.
    pub alone: f64,
    /// The most fronts that a trajectory passes.
    pub fronts: usize,
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
        let (mut longest, mut fronts, mut at) = (0.0f64, 0, &seed[..n]);
        for x in passed {
            longest = longest.max(way(at, x));
            fronts += 1;
            at = x;
        }
        longest = longest.max(way(at, &batch.end[i * batch.dim..][..n]));
        match fronts {
            0 => Self {
                alone: longest,
                ..Self::default()
            },
            _ => Self {
                longest,
                fronts,
                ..Self::default()
            },
        }
    }

    /// The longer ones.
    #[must_use]
    pub(super) fn and(self, other: Self) -> Self {
        Self {
            longest: self.longest.max(other.longest),
            alone: self.alone.max(other.alone),
            fronts: self.fronts.max(other.fronts),
        }
    }

    /// Whether fronts lie too far apart to tell of what is between them.
    #[must_use]
    pub fn far(&self) -> Option<Far> {
        if self.fronts == 0 {
            return Some(Far::NoFronts);
        }
        let alone = (self.alone > FAR_ALONE).then_some(Far::Alone(self.alone));
        (self.longest > FAR)
            .then_some(Far::Apart(self.longest))
            .or(alone)
    }
}

/// That fronts lie too far apart to tell of what is between them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Far {
    /// Trajectories go so much of the region from one front to the next.
    Apart(f64),
    /// Some go so much of it, and come to no front.
    Alone(f64),
    /// None comes to a front.
    NoFronts,
}

impl std::fmt::Display for Far {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Apart(way) => write!(
                f,
                "trajectories go {way:.2} of the region from one front to the next"
            ),
            Self::Alone(way) => write!(
                f,
                "trajectories go {way:.2} of the region and come to no front"
            ),
            Self::NoFronts => write!(f, "no trajectory comes to the first front"),
        }
    }
}
