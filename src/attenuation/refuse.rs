//! A scene whose level of attenuation is below what its linearization allows is refused, with what
//! would be allowed.

use crate::diagnostics::{Problem, ScenarioErrors};
use crate::local::{Cause, LocalError, Riccati};
use crate::model::Horizon;
use crate::numeric::digits::plain;
use crate::scene::Scene;

/// Refuses a game whose level of attenuation its linearization does not allow.
///
/// # Errors
/// [`ScenarioErrors`] with what would be allowed.
pub fn refuse(scene: &Scene) -> Result<(), ScenarioErrors> {
    refusal(scene).map_or(Ok(()), Err)
}

/// The refusal of a game whose linearization has no solution because of its level, or which is not
/// at rest at its equilibrium; `None` where it has one, or lacks it for another reason (which the
/// local solution's own error tells).
fn refusal(scene: &Scene) -> Option<ScenarioErrors> {
    let Scene {
        model, hamiltonian, ..
    } = scene;
    let Horizon::Infinite { span, .. } = &model.horizon else {
        return None;
    };
    if model.disturbances.is_empty() {
        return None;
    }
    let error = Riccati::solve(hamiltonian, model).err()?;
    if let LocalError::NotStationary { .. } = error {
        // No level mends that.
        let problem = Problem::at(
            span.clone(),
            error.to_string(),
            "no equilibrium of the game",
        );
        return Some(model.errors(vec![problem]));
    }
    let Some(asked) = &model.attenuation else {
        let told = matches!(
            error,
            LocalError::ImaginaryAxis { .. } | LocalError::BelowAttenuation { .. }
        );
        let problem = Problem::at(span.clone(), error.to_string(), "linearized here")
            .with_help("name the parameter that is its level in [attenuation], to be told the smallest one allowed");
        return told.then(|| model.errors(vec![problem]));
    };
    let (name, own) = (&asked.parameter, model.parameter(&asked.parameter)?);
    // Where there is no gamma*, the reason for that is more than this refusal could say.
    let linear = super::linear(scene, asked).ok()?;
    if linear.cause == Cause::None || own >= linear.star {
        return None;
    }
    let set = model.overrides.iter().rev().find(|(n, _)| n == name);
    let from = set.map_or_else(String::new, |(n, v)| format!(" (--set {n}={v})"));
    let message = format!(
        "{name} = {}{from} is not above {name}* = {:.10}, the smallest level of attenuation that the linearization allows",
        plain(own),
        linear.star
    );
    let problem = Problem {
        message,
        // What --set replaces is not to blame.
        span: set.is_none().then(|| asked.parameter_span.clone()),
        label: format!("must be above {:.10}", linear.star),
        help: Some(format!("{name}*: {}", linear.cause.explained())),
    };
    Some(model.errors(vec![problem]))
}
