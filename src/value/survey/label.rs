//! Numbers of sheets: which extremals lie on one, and which sheets are copies of one by whole
//! periods.

use super::Survey;
use crate::value::extremal::{Extremal, misfit};
use crate::value::nearest;
use crate::value::targets::Groups;
use rustc_hash::FxHashMap;
use std::collections::BTreeMap;

/// Places that are looked at for copies, a place.
const NEAR: usize = 12;
/// Distances below this, in widths of the region, are none.
const SAME: f64 = 1e-9;

/// Which extremals lie on one sheet.
#[derive(Clone, Default)]
pub(in crate::low_level::value) struct Sheets {
    groups: Groups,
    /// Members of each group by target and winding: two at one state are two sheets.
    members: FxHashMap<usize, FxHashMap<(usize, usize), usize>>,
}

impl Sheets {
    /// A further extremal on a sheet of its own.
    pub fn push(&mut self, index: usize, extremal: &Extremal) {
        self.groups.push();
        let place = (extremal.target, extremal.winding);
        self.members
            .insert(index, FxHashMap::from_iter([(place, index)]));
    }

    /// Notes that two extremals are on one sheet, whatever else is.
    pub fn unite(&mut self, a: usize, b: usize) {
        let (a, b) = (self.groups.root(a), self.groups.root(b));
        if a == b {
            return;
        }
        self.groups.join(a, b);
        let mut all = self.members.remove(&a).unwrap_or_default();
        all.extend(self.members.remove(&b).unwrap_or_default());
        self.members.insert(self.groups.root(a), all);
    }

    /// Notes that two extremals are on different sheets over a state, which has this number.
    pub fn part(&mut self, a: usize, b: usize, state: usize) {
        for e in [a, b] {
            let root = self.groups.root(e);
            self.members.entry(root).or_default().insert((state, 0), e);
        }
    }

    pub fn root(&mut self, e: usize) -> usize {
        self.groups.root(e)
    }

    /// Joins two extremals' sheets, unless another extremal of the one lies over a state of the
    /// other: then the way between them has left its sheet. Whether they were joined now.
    pub fn join(&mut self, a: usize, b: usize) -> bool {
        let (a, b) = (self.groups.root(a), self.groups.root(b));
        if a == b {
            return false;
        }
        let (of_a, of_b) = (&self.members[&a], &self.members[&b]);
        let (few, many) = if of_a.len() < of_b.len() {
            (of_a, of_b)
        } else {
            (of_b, of_a)
        };
        let other =
            |(place, e): (&(usize, usize), &usize)| many.get(place).is_some_and(|other| other != e);
        if few.iter().any(other) {
            return false;
        }
        self.groups.join(a, b);
        let (mut joined, other) = (
            self.members.remove(&a).unwrap_or_default(),
            self.members.remove(&b).unwrap_or_default(),
        );
        if joined.len() < other.len() {
            let few = std::mem::replace(&mut joined, other);
            joined.extend(few);
        } else {
            joined.extend(other);
        }
        self.members.insert(self.groups.root(a), joined);
        true
    }

    /// Of each extremal the number of its sheet: they are numbered by their least V.
    fn numbers(&mut self, extremals: &[Extremal]) -> Vec<i32> {
        let mut least: BTreeMap<usize, (f64, usize)> = BTreeMap::new();
        for (e, extremal) in extremals.iter().enumerate() {
            let this = (extremal.value(), extremal.target);
            let entry = least.entry(self.groups.root(e)).or_insert(this);
            if this < *entry {
                *entry = this;
            }
        }
        let mut order: Vec<(usize, (f64, usize))> = least.into_iter().collect();
        order.sort_by(|a, b| a.1.0.total_cmp(&b.1.0).then(a.1.1.cmp(&b.1.1)));
        let number: FxHashMap<usize, i32> = (order.iter().enumerate())
            .map(|(k, (root, _))| (*root, k as i32))
            .collect();
        (0..extremals.len())
            .map(|e| number[&self.groups.root(e)])
            .collect()
    }
}

impl Survey<'_> {
    /// Numbers the sheets, one for each way round a periodic state; and, where copies by whole
    /// periods count as one, again.
    pub(in crate::low_level::value) fn label(&mut self) {
        self.sheet = self.joined.numbers(&self.extremals);
        self.lifted = if self.plan.periods.iter().any(Option::is_some) {
            self.with_copies(self.joined.clone(), &self.reach())
                .numbers(&self.extremals)
        } else {
            self.sheet.clone()
        };
    }

    /// The sheets with copies joined. A solution from a target with a winding is one from the state
    /// that many periods away: on the line, instead of the circle, what lies next to each other
    /// there may be one sheet.
    pub(in crate::low_level::value) fn with_copies(
        &self,
        mut sheets: Sheets,
        reach: &[f64],
    ) -> Sheets {
        let mut at: BTreeMap<(usize, usize), Vec<usize>> = BTreeMap::new();
        for (e, extremal) in self.extremals.iter().enumerate() {
            at.entry((extremal.target, extremal.winding))
                .or_default()
                .push(e);
        }
        let places: Vec<(usize, usize)> = at.keys().copied().collect();
        let states: Vec<Vec<f64>> = places
            .iter()
            .map(|(t, w)| self.scaled(&self.state(*t, *w)))
            .collect();
        let tree = nearest::index(&states.concat(), self.targets.states);
        let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
        for (k, (target, winding)) in places.iter().enumerate() {
            for (other, distance) in tree.near(&states[k], reach[*target], NEAR) {
                // Those of one winding are neighbours already.
                let (to, turned) = places[other];
                let neighbours = turned == *winding && self.same_base(*target, to);
                if other > k && !neighbours && distance <= reach[*target] {
                    pairs.push((distance, k, other));
                }
            }
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        for (_, a, b) in pairs {
            for &e in &at[&places[a]] {
                let fits =
                    |other: usize| misfit(&self.extremals[e], &self.extremals[other], &self.scales);
                let best = (at[&places[b]].iter())
                    .map(|other| (fits(*other), *other))
                    .min_by(|a, b| a.0.total_cmp(&b.0));
                if let Some((misfit, other)) = best
                    && misfit < 1.0
                {
                    sheets.join(e, other);
                }
            }
        }
        sheets
    }

    /// How far each target's neighbours are at most, in widths of the region.
    fn reach(&self) -> Vec<f64> {
        let mut reach = vec![SAME; self.targets.len()];
        for &(a, b) in &self.targets.edges {
            let (x, y) = (self.targets.state(a), self.targets.state(b));
            let squares = (0..x.len()).map(|i| ((x[i] - y[i]) / self.plan.widths[i]).powi(2));
            let distance = squares.sum::<f64>().sqrt() + SAME;
            reach[a] = reach[a].max(distance);
            reach[b] = reach[b].max(distance);
        }
        reach
    }
}
