//! Multiple shooting: the two-point boundary value problems of chosen states, solved in batches.
//!
//! A [`Path`] holds a trajectory as nodes `(s, p)` joined by segments. [`Solver`] closes the gaps
//! between the segments and meets the conditions at both ends by damped Newton iterations over many
//! paths at once: the segments of all paths are one batch of a backend's kernel, and each path's
//! linear equations are eliminated block by block ([`Factors`]).

mod device;
mod elimination;
mod end;
mod equations;
mod newton;
mod path;
mod solver;

pub use elimination::{Factors, Start};
pub use end::{AtEnd, End};
pub use equations::Equations;
pub use newton::{Failure, Goal, Job, Scheme, Solved};
pub use path::Path;
pub use solver::{Solver, Work};
