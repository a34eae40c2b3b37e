//! V, p and u at chosen states: every sheet, the lowest one, and where two cost the same.

mod approach;
mod archive;
mod extremal;
mod fold;
mod nearest;
mod survey;
mod targets;

pub use approach::{Approach, Unreached, follow};
pub use archive::{Archive, Index, Place, segment_duration};
pub use extremal::Extremal;
pub use fold::Fold;
pub use survey::{Miss, PointStatus, Survey, Wanted};
pub use targets::{Grid, Targets};
