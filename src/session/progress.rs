//! What is reported of a computation while it goes on.

use super::Outcome;
use crate::attenuation::Attenuated;
use crate::backend::Backend;
use crate::closed_loop::Evaluation;
use crate::closed_loop::dissipation::Dissipation;
use crate::feedback::{Exports, Fitted};
use crate::model::Model;
use crate::sweep::Plan;

/// A part of a run that is finished, with its result.
#[non_exhaustive]
pub enum Finished<'a> {
    /// The sweep, the solved states, the map and the study.
    Solved(&'a Outcome, &'a Model),
    /// The laws of `[feedback]`.
    Fitted(&'a Fitted),
    /// The files that were written of each.
    Exported(&'a Fitted, &'a [Exports]),
    /// The closed loops of `[closed_loop]`.
    ClosedLoop(&'a Evaluation),
    /// The check of `[dissipation]`.
    Dissipation(&'a Dissipation),
    /// The levels of `[attenuation]`.
    Attenuation(&'a Attenuated),
}

/// A listener to a computation. Each method does nothing unless you write it.
///
/// ```
/// use costate::session::Progress;
/// /// Prints the remarks that a run makes, and nothing else.
/// struct Remarks;
/// impl Progress for Remarks {
///     fn note(&self, text: &str) {
///         eprintln!("{text}");
///     }
/// }
/// ```
pub trait Progress: Sync {
    /// What is being computed now; each text replaces the one before it.
    fn step(&self, _what: &str) {}

    /// The step that was shown has ended.
    fn step_ended(&self) {}

    /// A remark that a user should read; the computation goes on.
    fn note(&self, _text: &str) {}

    /// A run begins: what it is going to integrate, and where.
    fn begun(&self, _model: &Model, _plan: &Plan, _backend: &dyn Backend) {}

    /// A part of a run has ended.
    fn finished(&self, _part: Finished<'_>) {}
}

/// Listens to nothing.
pub struct Silent;

impl Progress for Silent {}

/// Shows a step for as long as it lives.
pub(crate) struct Step<'p>(pub &'p dyn Progress);

impl Step<'_> {
    pub fn say(&self, what: &str) {
        self.0.step(what);
    }

    /// For states that are solved for.
    pub fn states(&self) -> impl FnMut(&str, usize, usize) {
        |what: &str, done: usize, of: usize| {
            self.say(&format!("{done} of {of} states solved, {what}"));
        }
    }
}

impl Drop for Step<'_> {
    fn drop(&mut self) {
        self.0.step_ended();
    }
}
