//! Numbers of sheets.

use super::Survey;
use std::collections::{BTreeMap, HashMap};

impl Survey<'_> {
    /// Numbers the sheets by their least V.
    pub(in crate::value) fn label(&mut self) {
        let mut least: BTreeMap<usize, (f64, usize)> = BTreeMap::new();
        for e in 0..self.extremals.len() {
            let root = self.groups.root(e);
            let this = (self.extremals[e].value(), self.extremals[e].target);
            let entry = least.entry(root).or_insert(this);
            if this < *entry {
                *entry = this;
            }
        }
        let mut order: Vec<(usize, (f64, usize))> = least.into_iter().collect();
        order.sort_by(|a, b| a.1.0.total_cmp(&b.1.0).then(a.1.1.cmp(&b.1.1)));
        let number: HashMap<usize, i32> = order
            .iter()
            .enumerate()
            .map(|(k, (root, _))| (*root, k as i32))
            .collect();
        self.sheet = (0..self.extremals.len())
            .map(|e| number[&self.groups.root(e)])
            .collect();
    }
}
