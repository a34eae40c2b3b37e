//! costate
pub mod backend;
pub mod expr;
pub mod hamiltonian;
pub mod integrator;
pub mod model;
pub mod program;
pub mod scenario;
