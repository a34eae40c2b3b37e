//! Results as text for a person.

pub mod attenuation;
pub mod bench;
pub mod dissipation;
pub mod estimates;
pub mod evaluation;
pub mod laws;
pub mod listed;
pub mod mapped;
pub mod merged;
pub mod simulated;
pub mod solved;
pub mod study;

/// A number of things: "1 state", "2 states".
pub fn counted(number: usize, thing: &str) -> String {
    match number {
        1 => format!("1 {thing}"),
        _ => format!("{number} {thing}s"),
    }
}
