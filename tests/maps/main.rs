//! Maps of V over a region: made, asked, flown and exported by the program.

#[path = "../common/mod.rs"]
mod common;
#[path = "../common_commands/mod.rs"]
mod common_commands;
#[path = "../common_loop/mod.rs"]
mod common_loop;
#[path = "../common_problems/mod.rs"]
mod common_problems;

mod export;
mod map;
mod map_bounds;
mod map_device;
mod map_loops;
mod map_shadows;
mod map_time;
mod value;

/// The directory of the whole project.
const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");
