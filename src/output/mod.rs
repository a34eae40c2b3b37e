//! The result file: HDF5 that `xarray.open_dataset(FILE, group=...)` opens with no keyword.
//!
//! Three layers, each usable without the one above it:
//!
//! - [`ResultFile`] is the file: written under a temporary name beside its target, renamed to the
//!   final name by [`ResultFile::finish`], gone when dropped before that;
//! - [`Group`], [`Dimension`] and [`Variable`] declare one netCDF-like group, [`GroupWriter`] fills
//!   it, in blocks along a growing first dimension or variable by variable;
//! - [`TrajectoryWriter`] is the group `/trajectories`.
//!
//! Every dimension is a dimension scale with a value for each index, every variable carries `units`
//! and `long_name`, a missing floating-point value is NaN (also declared as `_FillValue`), and
//! integer codes carry `flag_values` and `flag_meanings`.
//!
//! ```no_run
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # use costate::output::*;
//! let mut file = ResultFile::create("out/points.h5")?;
//! let mut points = file.group(
//!     &Group::new("points")
//!         .dimension(Dimension::unlimited("point"))
//!         .dimension(Dimension::names("state", ["phi", "omega"]))
//!         .variable(Variable::f64("x0", ["point", "state"]).long_name("initial state"))
//!         .variable(Variable::i32("status", ["point"]).flags([(0, "converged"), (1, "failed")])),
//! )?;
//! points.append(1, &[("x0", (&[0.1, 0.2]).into()), ("status", (&[0]).into())])?;
//! file.finish()?;
//! # Ok(()) }
//! ```

mod answers;
mod attenuation;
mod attribute;
mod caustic;
mod dataset;
mod error;
mod file;
mod interpolated;
mod map_pieces;
mod record;
mod spec;
mod speed_error;
mod stored;
mod study;
mod temporary;
#[cfg(test)]
mod testing;
mod trajectories;

pub use attenuation::ATTENUATION_GROUPS;
pub use attribute::AttributeValue;
pub use dataset::{GroupWriter, Values};
pub use error::OutputError;
pub use file::{ResultFile, target, write_bytes, write_text};
pub use interpolated::{Places, Times};
pub use record::{RunRecord, utc_timestamp};
pub use spec::{Compression, Dimension, Group, Variable};
pub use stored::{Array, Stored, StoredError, StoredGroup, StoredMap, StoredPoints, StoredTrajectories};
pub use temporary::Temporary;
#[cfg(unix)]
pub use temporary::removed_at_signals;
pub use trajectories::{Axis, TrajectoryBlock, TrajectorySchema, TrajectoryWriter};
