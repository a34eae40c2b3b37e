//! Names as a scene wants them.

use std::collections::BTreeSet;

/// Names that are taken.
pub struct Names {
    taken: BTreeSet<String>,
}

/// What a scene keeps for itself, or this crate writes.
const KEPT: [&str; 6] = ["pi", "kinetic", "potential", "energy", "world", "t"];

impl Names {
    pub fn new() -> Self {
        Self {
            taken: KEPT.iter().map(|n| (*n).to_owned()).collect(),
        }
    }

    /// A name of letters, digits and `_` that no other has, nor its rate or force; a note where it
    /// is not the robot's.
    pub fn of(&mut self, given: &str, notes: &mut Vec<String>) -> String {
        let mut name: String = (given.chars())
            .map(|c| if c.is_ascii_alphanumeric() { c } else { '_' })
            .collect();
        if !name.starts_with(|c: char| c.is_ascii_alphabetic()) {
            name.insert_str(0, "joint_");
        }
        let function = costate::low_level::scenario::is_function(&name);
        if function || self.is_taken(&name) {
            let free = (2..)
                .map(|k| format!("{name}_{k}"))
                .find(|n| !self.is_taken(n));
            name = free.unwrap_or(name);
        }
        if name != given {
            notes.push(format!("`{}` is called {name}", given.escape_debug()));
        }
        for tail in [
            "", "_rate", "_force", "_x", "_y", "_z", "_yaw", "_pitch", "_roll",
        ] {
            self.taken.insert(format!("{name}{tail}"));
        }
        name
    }

    fn is_taken(&self, name: &str) -> bool {
        let own = ["", "_rate", "_force"].map(|tail| format!("{name}{tail}"));
        own.iter().any(|n| self.taken.contains(n))
    }
}
