//! Shooting out: seeds on the local solution (or the terminal cost) integrated backward in time,
//! with new seeds between neighbours that part.

pub mod accuracy;
mod caustic;
mod complex;
mod draft;
mod fronts;
mod gaps;
mod neighbours;
mod nodes;
mod observe;
mod parts;
mod paths;
mod plan;
mod sample;
mod steps;
pub mod stiffness;
mod surface;

pub use accuracy::{Accuracy, Spread};
pub use caustic::FoldPoint;
pub use draft::with_margin;
pub use fronts::{Coverage, Progress, SweepReport, sweep, sweep_keeping};
pub use observe::Observed;
pub use parts::SurfacePart;
pub(crate) use plan::MOST_OPERATIONS;
pub use plan::{
    AT_GUARD, Choices, FOLD_STATUS, GUARD_STATUS, Numerics, Plan, PlanError, Sampling, spread_over,
};
pub use sample::{Kept, Sample};
pub use steps::{Far, Steps};
pub use surface::{Surface, holds as guard_holds};
