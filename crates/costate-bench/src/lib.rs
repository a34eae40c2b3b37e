//! Speed against error: the trajectories of a scene's own sweep, integrated by every backend,
//! precision, method and tolerance there is, and compared with a reference made by another method.
//!
//! - [`Work`] is what is integrated: seeds on the scene's own seed surface, the same for all
//!   variants;
//! - [`devices`] opens what can integrate, [`variants`] lists what is to be measured and what
//!   cannot be;
//! - [`mod@reference`] and [`errors`] say how wrong a result is, off the manifold of optimal
//!   solutions;
//! - [`measure()`] takes the times, variants in turn; [`pareto`] chooses among them;
//! - [`flops`](costate::backend::flops) and [`Backend::peak`](costate::backend::Backend::peak) give
//!   the share of what a device can do;
//! - [`mod@write`] stores what was measured;
//! - [`host_share`] tells the kernel's time from all other time of a whole run.

mod comparison;
pub mod devices;
pub mod errors;
pub mod host_share;
pub mod measure;
pub mod pareto;
pub mod reference;
pub mod variants;
mod work;
pub mod write;

pub use measure::{Bench, Floor, Options, Row, measure};
pub use variants::{Missing, Steps, Wanted};
pub use work::{Pass, Work, WorkError};

use costate::backend::BackendError;

/// Why nothing could be measured.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    #[error(transparent)]
    Backend(#[from] BackendError),
    #[error(transparent)]
    Work(#[from] WorkError),
    #[error("nothing is left to measure: {why}")]
    NothingLeft { why: String },
    #[error("{seeds} reference trajectories were integrated and none passed a level to compare at")]
    NoReference { seeds: usize },
}
