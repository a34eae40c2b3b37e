//! HDF5 that `xarray.open_dataset(FILE, group=...)` opens with no keyword, and nothing of what is
//! in it.
//!
//! - [`ResultFile`] is the file: written under a hidden name beside its target, renamed to the
//!   final name by [`ResultFile::finish`], gone when dropped before that;
//! - [`Group`], [`Dimension`] and [`Variable`] declare one netCDF-like group, [`GroupWriter`] fills
//!   it, in blocks along a growing first dimension or variable by variable;
//! - [`Group::rows_elsewhere`] lets rows be read from other files.
//!
//! Every dimension is a dimension scale with a value for each index, every variable carries `units`
//! and `long_name`, a missing floating-point value is NaN (also declared as `_FillValue`), and
//! integer codes carry `flag_values` and `flag_meanings`.
//!
//! ```no_run
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # use costate::low_level::hdf5::*;
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

mod attribute;
mod dataset;
mod elsewhere;
mod error;
mod file;
mod spec;

pub use attribute::AttributeValue;
pub use dataset::{GroupWriter, Values};
pub use elsewhere::RowsOf;
pub use error::OutputError;
pub use file::ResultFile;
pub use spec::{Compression, Dimension, Group, Variable};
