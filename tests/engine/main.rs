//! The engine without the program: expressions to sweeps and boundary value problems, on every
//! backend.

#[path = "../common/mod.rs"]
mod common;
#[path = "../common_hard/mod.rs"]
mod common_hard;
#[path = "../common_oracles/mod.rs"]
mod common_oracles;
#[path = "../common_problems/mod.rs"]
mod common_problems;

mod backends;
mod batches;
mod elimination;
mod equations;
mod exact;
mod fronts;
mod gradient;
mod hard;
mod hard_compressor;
mod kinks;
mod local;
mod malformed;
mod mechanisms;
mod off_manifold;
mod order;
mod result_file;
mod right_hand_sides;
mod rooms;
mod scenarios;
mod scene_backends;
mod scene_reference;
mod shooting;
mod simulation;
mod taylor;

/// The directory of the whole project.
const ROOT: &str = env!("CARGO_MANIFEST_DIR");
