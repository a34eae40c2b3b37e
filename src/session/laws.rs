//! Laws fitted to optimal trajectories, solved states or a map.

use super::progress::{Progress, Step};
use super::{Session, SessionError};
use crate::backend::Deadline;
use crate::feedback::{Data, FitError, Fitted, Samples, Step as FitStep, fit};
use crate::map::ValueMap;
use crate::model::{Feedback, Model};
use crate::scene::Scene;
use std::sync::Mutex;

/// States of a map to an error that are looked at for each sample wanted: conditions leave some
/// out.
const LOOKED_AT: usize = 8;
/// The most of them.
const MOST_LOOKED_AT: usize = 1 << 20;

/// What laws are fitted to.
pub struct FitData<'d> {
    /// The scene that the samples are solutions of.
    pub scene: &'d Scene,
    /// Points of optimal trajectories.
    pub samples: &'d Samples,
    /// A map that knows which samples are optimal, where solutions of several sheets may be among
    /// them. Without one, or where it has no objection, neighbouring samples decide.
    pub map: Option<&'d ValueMap>,
    /// Whether samples are drawn from the map, too.
    pub draws: bool,
    /// When a fit is given up.
    pub deadline: Deadline,
}

/// Fits laws of `model`, which may be another scene with the same states and controls. Those for
/// which the time does not suffice are left out.
///
/// # Errors
/// [`FitError`]; [`FitError::OutOfTime`] where no law was done.
pub fn fit_laws(
    data: &FitData<'_>,
    model: &Model,
    laws: &[Feedback],
    progress: &dyn Progress,
) -> Result<Fitted, FitError> {
    let of_map = |x: &[f64], v: f64| {
        let map = data.map.filter(|map| !map.is_lowest(x, v));
        map.map(|_| false)
    };
    let step = Step(progress);
    let mut fitted = Fitted::default();
    for law in laws {
        let drawn = (data.map.filter(|_| data.draws)).map(|map| {
            let count = (LOOKED_AT * law.max_samples).min(MOST_LOOKED_AT);
            data.samples.with_map(map, &law.bounds, count)
        });
        let all = Data {
            model: &data.scene.model,
            hamiltonian: &data.scene.hamiltonian,
            samples: drawn.as_ref().unwrap_or(data.samples),
            known: &of_map,
            deadline: data.deadline,
        };
        match fit(all, model, law, &shown(&step, law)) {
            Err(FitError::OutOfTime { law }) if !fitted.laws.is_empty() => {
                fitted.left_out.push(law);
            }
            done => fitted.laws.push(done?),
        }
    }
    Ok(fitted)
}

impl Session<'_> {
    /// Fits the laws of the scene's `[feedback]` to samples of its solutions. A map to an error, if
    /// there is one, tells which are optimal, and gives further ones. Laws for which the session's
    /// deadline leaves no time are left out ([`Fitted::left_out`]).
    ///
    /// # Errors
    /// [`SessionError::NoFeedback`], [`SessionError::Fit`].
    pub fn fit(&self, samples: &Samples, map: Option<&ValueMap>) -> Result<Fitted, SessionError> {
        let laws = &self.scene.model.feedback;
        if laws.is_empty() {
            return Err(SessionError::NoFeedback);
        }
        let data = FitData {
            scene: self.scene,
            samples,
            map,
            draws: map.is_some_and(|map| map.pieces() > 0 && map.time().is_none()),
            deadline: self.choices.deadline,
        };
        Ok(fit_laws(&data, &self.scene.model, laws, self.progress)?)
    }
}

/// What is shown of a fit: the steps of all starts together, and the best of them so far.
fn shown<'s>(step: &'s Step<'_>, law: &'s Feedback) -> impl Fn(FitStep) + Sync + 's {
    step.say(&format!("law {}: selecting data", law.name));
    /// Steps taken, and the smallest validation residual.
    struct SoFar(usize, f64);
    let so_far = Mutex::new(SoFar(0, f64::INFINITY));
    move |one| {
        // A panic elsewhere is reported there.
        let Ok(mut so_far) = so_far.lock() else {
            return;
        };
        so_far.0 += 1;
        so_far.1 = so_far.1.min(one.validation);
        step.say(&format!(
            "law {}: {} steps of {} starts, residual on the validation set {:.2e}",
            law.name, so_far.0, law.starts, so_far.1
        ));
    }
}
