//! The solution near the equilibrium: Riccati matrix, closed loop, higher terms of V, and the seeds
//! of the sweep.

mod attenuation;
mod errors;
mod linearization;
mod polynomial;
mod riccati;
mod seeds;
mod series;
mod shape;

pub use attenuation::{AttenuationError, Cause, LinearAttenuation, linear_attenuation};
pub use errors::LocalErrors;
pub use linearization::Linearization;
pub use polynomial::LocalPolynomial;
pub(crate) use riccati::eigenvalues_of;
pub use riccati::{Riccati, closed_loop_margin, linear_law, show_eigenvalue};
pub use seeds::{LocalSolution, SeedChoice, SeedScratch};

/// Why no local solution exists, or none that the sweep can start from.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LocalError {
    #[error(
        "the linearization is not stabilizable: its mode with eigenvalue {eigenvalue} cannot be influenced by the control and does not decay (distance to loss of rank {distance:.1e})"
    )]
    NotStabilizable { eigenvalue: String, distance: f64 },
    #[error(
        "the Hamiltonian matrix has an eigenvalue on the imaginary axis, {eigenvalue} (relative distance {distance:.1e}): {hint}"
    )]
    ImaginaryAxis {
        eigenvalue: String,
        distance: f64,
        hint: String,
    },
    #[error("no stabilizing Riccati solution was found: {reason}")]
    NoSolution { reason: String },
    #[error("the Riccati solution's relative residual is {residual:.1e}, above {bound:.0e}")]
    Residual { residual: f64, bound: f64 },
    #[error(
        "the Riccati solution is not positive definite: smallest eigenvalue {smallest:.3e} of largest {largest:.3e}, along ({direction}); no ellipsoid of constant cost surrounds the equilibrium"
    )]
    NotPositive {
        smallest: f64,
        largest: f64,
        direction: String,
    },
    #[error(
        "the game Riccati solution is not positive semidefinite (eigenvalues from {smallest:.3e} to {largest:.3e}): the attenuation asked is below what the linearization allows"
    )]
    BelowAttenuation { smallest: f64, largest: f64 },
    #[error(
        "the equilibrium is not one of the optimal inputs: at p = 0 the {role} is {name} = {value:.6e}, not {wanted:.6e} (a term linear in `{name}` in the cost?)"
    )]
    NotStationary {
        role: &'static str,
        name: String,
        value: f64,
        wanted: f64,
    },
    #[error("the closed loop is not stable: eigenvalue {eigenvalue}")]
    NotStable { eigenvalue: String },
    #[error(
        "V of degree {degree} in {states} states has too many terms{hint}", hint = most.map_or(String::new(), |m| format!(" (at most {m})"))
    )]
    TooLong {
        degree: usize,
        states: usize,
        most: Option<usize>,
    },
    #[error(
        "V has no Taylor series of degree {degree} at the equilibrium: it ends at degree {known} (a kink of the equations there?)"
    )]
    NoSeries { degree: usize, known: usize },
    #[error("seed_value {value:e} is too large: {reason}")]
    SeedTooLarge { value: f64, reason: String },
}
