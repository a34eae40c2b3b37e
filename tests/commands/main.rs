//! The program: what its commands print, write and refuse.

#[path = "../common/mod.rs"]
mod common;
#[path = "../common_commands/mod.rs"]
mod common_commands;
#[path = "../common_oracles/mod.rs"]
mod common_oracles;
#[path = "../common_problems/mod.rs"]
mod common_problems;
#[path = "../common_values/mod.rs"]
mod common_values;

mod absurd;
mod attenuation;
mod bench;
mod check_least;
mod dissipation_program;
mod endings;
mod estimates;
mod feedback;
mod game;
mod guide;
mod horizons;
mod import;
mod program;
mod published;
mod refusals;
mod report;
mod reserved;
mod shards;
mod shards_virtual;
mod simulate;
mod solve;

/// The directory of the whole project.
const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");
