//! Cells that states are asked for in vain, and that are left in the end.

use crate::map::pieces::Want;
use rustc_hash::FxHashMap;

/// Failures in a cell after which no more states are tried there.
const MOST: u32 = 6;

/// A cell, and what is wanted in it: one that is left as its bare places have no answer may be in
/// error later, and is another one then.
#[derive(Clone, PartialEq, Eq, Hash)]
pub(super) struct Asked {
    faces: Vec<u64>,
    /// The cell itself is good enough.
    pub only_bare: bool,
}

impl Asked {
    pub fn of(want: &Want) -> Self {
        let faces = want.lo.iter().chain(&want.hi);
        Self {
            faces: faces.map(|x| x.to_bits()).collect(),
            only_bare: want.excess <= 1.0,
        }
    }
}

/// How often nothing came of what was asked for.
#[derive(Default)]
pub(super) struct Failures(FxHashMap<Asked, u32>);

impl Failures {
    /// Whether no more states are tried for a cell.
    pub fn are_too_many(&self, want: &Want) -> bool {
        self.0
            .get(&Asked::of(want))
            .is_some_and(|count| *count >= MOST)
    }

    pub fn add(&mut self, asked: Asked) {
        *self.0.entry(asked).or_default() += 1;
    }

    /// A state was solved: partly above `value_max`, a cell is worth more states all the same.
    pub fn forgive(&mut self, asked: Asked) {
        let count = self.0.entry(asked).or_default();
        *count = count.saturating_sub(1);
    }
}
