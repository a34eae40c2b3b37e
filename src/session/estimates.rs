//! The errors of a pass, and rates too far apart for its methods.

use super::summary::all_met;
use crate::backend::BackendError;
use crate::sweep::accuracy::{self, Accuracy};
use crate::sweep::stiffness::{self, HeldSteps, Segments, Separation};
use crate::sweep::{Plan, SweepReport};
use crate::value::{self, Answers, PointStatus, SolvedAccuracy};

/// Estimates of one pass; of what was not computed there are none.
#[derive(Default)]
pub struct Estimates {
    /// Errors of the sweep.
    pub swept: Option<Accuracy>,
    /// Errors of the solved states.
    pub solved: Option<SolvedAccuracy>,
    /// Rates of the closed loop that lie far apart.
    pub separation: Option<Separation>,
    /// Steps of the sweep that stability limits, not accuracy.
    pub held: Option<HeldSteps>,
    /// Solutions of states that take many segments, since rates lie far apart.
    pub segments: Option<Segments>,
}

impl Estimates {
    /// `stored`: the sweep is a result, not only a source of guesses.
    ///
    /// # Errors
    /// Device failures.
    pub fn new(
        plan: &Plan,
        swept: &SweepReport,
        stored: bool,
        answers: Option<&Answers>,
    ) -> Result<Self, BackendError> {
        let mut this = Self {
            separation: stiffness::separation(plan).filter(|_| stored),
            ..Self::default()
        };
        if stored {
            this.swept = Some(accuracy::estimate(plan, &swept.sample)?);
            this.held = stiffness::held_steps(plan, &swept.sample);
        }
        if let Some(answers) = answers {
            this.solved = value::accuracy(plan, answers)?;
            let beyond = (0..answers.targets.len())
                .filter(|t| answers.status(*t) == PointStatus::Horizon)
                .count();
            let segments = answers.entries.iter().map(|e| e.path.segments());
            this.segments = stiffness::segments(plan, segments, beyond);
        }
        Ok(this)
    }

    /// Whether the errors asked for were met; `None` where that is not known.
    #[must_use]
    pub fn met(&self) -> Option<bool> {
        let swept = self.swept.as_ref().map(Accuracy::met);
        let solved = self.solved.as_ref().map(SolvedAccuracy::met);
        all_met(&swept.into_iter().chain(solved).collect::<Vec<_>>())
    }
}
