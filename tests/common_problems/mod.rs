//! Problems with known answers, each once: where its scene is, and V, p and u by hand.
#![allow(dead_code, reason = "each test file uses its part")]

pub mod linear;
pub mod manufactured;
pub mod two_wells;

#[allow(unused_imports, reason = "each test program uses its part")]
pub use {linear::Cart, two_wells::TwoWells};

use costate::low_level::model::Model;

/// V, p = dV/dx and u at a state.
#[derive(Clone, Debug)]
pub struct Exact {
    pub v: f64,
    pub p: Vec<f64>,
    pub u: Vec<f64>,
}

/// The value of a scene's parameter.
pub fn parameter(model: &Model, name: &str) -> f64 {
    let found = model.parameters.iter().find(|p| p.name == name);
    found.unwrap_or_else(|| panic!("no parameter {name}")).value
}
