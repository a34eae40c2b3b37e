//! The result file: what its groups hold, written ([`crate::hdf5::ResultFile`]) and read back
//! ([`Stored`]).

mod answers;
mod attenuation;
mod caustic;
mod closed_loop;
mod column;
mod dissipation;
mod elsewhere;
mod feedback;
mod interpolated;
mod known;
mod map_pieces;
mod names;
mod pieces_group;
mod record;
mod shard;
mod simulation;
mod stored;
mod study;
mod table;
mod trajectories;

pub use attenuation::ATTENUATION_GROUPS;
pub use closed_loop::CLOSED_LOOP_GROUPS;
pub use column::StoredColumn;
pub use dissipation::DISSIPATION_GROUPS;
pub use elsewhere::{MANIFEST, ShardFiles, VIRTUAL};
pub use feedback::FEEDBACK_GROUP;
pub use interpolated::{Places, Times, interpolated_status, interpolated_statuses};
pub use known::StoredMapError;
pub use names::{Axis, TrajectorySchema};
pub use record::{RunRecord, utc_timestamp};
pub use shard::ShardGroups;
pub use stored::{Array, Stored, StoredError, StoredGroup};
pub use table::{Data, Table};
pub use trajectories::TrajectoryWriter;
