//! What answers cost that are flown: an upper bound of V that rests on nothing but the simulated
//! control.

use super::undercut::Claim;
use super::{AlongTime, Flight, Flown, PIECES, Pilot, guides};
use crate::backend::BackendError;
use crate::shooting::Solver;
use crate::sweep::Plan;

/// A flight is given up where it costs more than the claim by this share of it, or of the scale of
/// V.
const MORE: f64 = 0.1;
/// Periods of these flights, in those of others.
const FINE: f64 = 1.0 / 16.0;
/// Pieces of the solutions that are followed, in those of others.
const MANY: usize = 5;
/// Claims that are flown together.
const COHORT: usize = 1024;

/// A pilot for [`along_itself`].
///
/// # Errors
/// When the kernel cannot be compiled.
pub fn precise(plan: &Plan) -> Result<Pilot, BackendError> {
    Pilot::with_periods(plan, FINE)
}

/// A flight from each claim's state along its own solution, with feedback by its slopes. Not for
/// games.
///
/// # Errors
/// Device failures only.
pub fn along_itself(
    plan: &Plan,
    pilot: &mut Pilot,
    solver: &mut Solver,
    claims: &[Claim<'_>],
) -> Result<Vec<Flown>, BackendError> {
    let mut flown = Vec::with_capacity(claims.len());
    for part in claims.chunks(COHORT) {
        let paths: Vec<_> = part.iter().map(|claim| claim.path).collect();
        let guides = guides(plan, solver, &paths, MANY * PIECES)?;
        // By time: the start is on the solution, so that little is left to be corrected.
        let laws: Vec<AlongTime<'_>> = (paths.iter().zip(&guides))
            .map(|(path, guide)| AlongTime::new(plan, guide, path.start()))
            .collect();
        let flights: Vec<Flight<'_>> = (part.iter().zip(&laws))
            .map(|(claim, law)| Flight {
                start: claim.path.start().to_vec(),
                law,
                ceiling: claim.value + MORE * claim.value.abs().max(plan.value_scale),
            })
            .collect();
        flown.extend(pilot.fly(&flights)?);
    }
    Ok(flown)
}
