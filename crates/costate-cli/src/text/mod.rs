//! Results as text for a person.

use costate::low_level::sweep::Far;

pub mod attenuation;
pub mod bench;
pub mod dissipation;
pub mod estimates;
pub mod evaluation;
pub mod laws;
pub mod listed;
pub mod mapped;
pub mod merged;
pub mod simulated;
pub mod solved;
pub mod study;

/// A number of things: "1 state", "2 states".
pub fn counted(number: usize, thing: &str) -> String {
    match number {
        1 => format!("1 {thing}"),
        _ => format!("{number} {thing}s"),
    }
}

/// What fronts without gaps are.
pub fn no_further(spacing: f64) -> String {
    format!("no neighbours within the region are further apart than {spacing}")
}

/// Of fronts without gaps, of which some trajectories failed, or that may be far apart.
pub fn covered(spacing: f64, failed: usize, far: Option<Far>) -> String {
    let covered = no_further(spacing);
    match (failed, far) {
        (0, Some(far)) => format!(
            "fronts NOT covered: {far}, and nothing is compared in between (shoot_out: more samples, or a lower value_max)"
        ),
        (0, None) => format!("fronts covered: {covered}"),
        _ => format!(
            "fronts covered only as far as trajectories go: {covered}, but {failed} trajectories failed"
        ),
    }
}
