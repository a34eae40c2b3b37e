//! V at chosen states, V on a grid, closed loops: the library, without the program.

#[path = "../common/mod.rs"]
mod common;
#[path = "../common_loop/mod.rs"]
mod common_loop;
#[path = "../common_oracles/mod.rs"]
mod common_oracles;
#[path = "../common_problems/mod.rs"]
mod common_problems;
#[path = "../common_values/mod.rs"]
mod common_values;

mod closed_loop;
mod dissipation;
mod dynamic_programming;
mod flight;
mod hard_states;
mod homotopy;
mod least;
mod mechanisms;
mod session;
mod sheets;

/// The directory of the whole project.
const ROOT: &str = env!("CARGO_MANIFEST_DIR");
