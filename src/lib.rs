//! costate
pub mod backend;
pub mod cli;
pub mod expr;
pub mod hamiltonian;
pub mod integrator;
pub mod local;
pub mod model;
pub mod output;
pub mod program;
pub mod scenario;
pub mod sweep;
