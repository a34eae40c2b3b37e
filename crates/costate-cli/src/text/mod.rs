//! Results as text for a person.

pub mod attenuation;
pub mod bench;
pub mod dissipation;
pub mod estimates;
pub mod evaluation;
pub mod laws;
pub mod listed;
pub mod mapped;
pub mod solved;
pub mod study;
