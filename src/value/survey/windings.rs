//! Where targets are: as deviations, with any number of periods along periodic states.

use super::{Survey, Task};
use crate::shooting::Path;
use crate::value::approach::Approach;
use crate::value::archive::Index;

/// Windings that are looked for.
const MOST_WINDINGS: i32 = 16;

impl Survey<'_> {
    /// The number of a winding, a new one where it has none yet.
    pub(in crate::low_level::value) fn winding(&mut self, turns: &[i32]) -> usize {
        if let Some(known) = self.windings.iter().position(|w| w == turns) {
            return known;
        }
        self.windings.push(turns.to_vec());
        self.windings.len() - 1
    }

    /// The winding of a target that is nearest to a state, a deviation.
    pub(super) fn winding_near(&mut self, target: usize, s: &[f64]) -> usize {
        let here = self.state(target, 0);
        let turns: Vec<i32> = (s.iter().zip(&here).zip(&self.plan.periods))
            .zip(&self.windings[0])
            .map(|(((s, here), period), turns)| {
                turns + period.map_or(0, |p| ((s - here) / p).round() as i32)
            })
            .collect();
        self.winding(&turns)
    }

    /// The way from a path that is no solution to a target: it begins at a copy of it. None where
    /// the path is not finite.
    pub(super) fn task_along(&mut self, target: usize, path: Path, least: f64) -> Option<Task> {
        let finite = path.nodes.iter().all(|x| x.is_finite());
        let winding = finite.then(|| self.winding_near(target, path.start()))?;
        Some(Task {
            from: None,
            target,
            winding,
            way: Approach::new(path, self.state(target, winding), least),
        })
    }

    /// None, and those that bring a target nearest to the equilibrium.
    pub(super) fn nearest_windings(&self) -> Vec<Vec<i32>> {
        let n = self.targets.states;
        let mut all = vec![vec![0; n]];
        for target in 0..self.targets.len() {
            let turns: Vec<i32> = (0..n)
                .map(|i| {
                    self.plan.periods[i].map_or(0, |period| {
                        let turns = f64::from(self.base(target, i));
                        let s = self.targets.state(target)[i] - self.plan.system.reference[i];
                        (-(s / period + turns).round()).clamp(-1e6, 1e6) as i32
                    })
                })
                .collect();
            if !all.contains(&turns) {
                all.push(turns);
            }
        }
        all
    }

    /// A target's state with a winding, as a deviation.
    pub fn state(&self, target: usize, winding: usize) -> Vec<f64> {
        let (x, reference) = (self.targets.state(target), &self.plan.system.reference);
        (0..x.len())
            .map(|i| {
                let turns = f64::from(self.windings[winding][i] + self.base(target, i))
                    * self.plan.periods[i].unwrap_or(0.0);
                x[i] - reference[i] + turns
            })
            .collect()
    }

    /// Periods that bring a target far outside the region back near it: windings count from there.
    pub fn base(&self, target: usize, i: usize) -> i32 {
        let Some(period) = self.plan.periods[i] else {
            return 0;
        };
        let s = self.targets.state(target)[i] - self.plan.system.reference[i];
        let [lo, hi] = self.plan.region[i];
        if s >= lo - period && s <= hi + period {
            return 0;
        }
        (((0.5 * (lo + hi) - s) / period).round()).clamp(-1e9, 1e9) as i32
    }

    /// Whether windings of two targets count from the same place.
    pub(in crate::low_level::value) fn same_base(&self, a: usize, b: usize) -> bool {
        (0..self.targets.states).all(|i| self.base(a, i) == self.base(b, i))
    }

    pub(super) fn scaled(&self, s: &[f64]) -> Vec<f64> {
        s.iter()
            .zip(&self.plan.widths)
            .map(|(s, w)| s / w)
            .collect()
    }

    /// All windings by which a target may come near a swept point: none first, then by distance.
    pub(super) fn all_windings(&self, index: &Index) -> Vec<Vec<i32>> {
        let n = self.targets.states;
        let mut all: Vec<Vec<i32>> = vec![Vec::new()];
        for i in 0..n {
            let mut turns = vec![0];
            if let Some(period) = self.plan.periods[i] {
                let along = |t: usize| {
                    let turns = f64::from(self.base(t, i)) * period;
                    self.targets.state(t)[i] - self.plan.system.reference[i] + turns
                };
                let lo = (0..self.targets.len())
                    .map(along)
                    .fold(f64::INFINITY, f64::min);
                let hi = (0..self.targets.len())
                    .map(along)
                    .fold(f64::NEG_INFINITY, f64::max);
                let [least, most] = index.extent.get(i).copied().unwrap_or([0.0, 0.0]);
                let width = self.plan.widths[i];
                for k in (1..=MOST_WINDINGS).flat_map(|k| [-k, k]) {
                    let shift = f64::from(k) * period;
                    // A sheet goes on beyond where it was swept.
                    let beyond = 0.5 * period;
                    if lo + shift <= most * width + beyond && hi + shift >= least * width - beyond {
                        turns.push(k);
                    }
                }
            }
            all = (all.iter())
                .flat_map(|w| turns.iter().map(|k| [w.as_slice(), &[*k]].concat()))
                .collect();
        }
        all.sort_by_key(|w| w.iter().map(|k| k.abs()).sum::<i32>());
        all
    }
}
