//! V, p and u at chosen states: every sheet, the lowest one, and where two cost the same.

mod approach;
mod archive;
mod nearest;

pub use approach::{Approach, Unreached, follow};
pub use archive::{Archive, Index, Place, segment_duration};
