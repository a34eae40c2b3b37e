//! The copies of states by whole periods.

use super::cell::{Cell, Corners};
use super::{Copy, Cover, Sought};

/// Periods by which a state is shifted at most, by the number of states that have one.
const MOST_TURNS: [i32; 7] = [16, 16, 16, 5, 3, 2, 2];

impl Cover<'_> {
    /// Least V of cells that reach so far along a periodic state that a state's copies there are
    /// left out.
    pub(super) fn out_of_turns(&self, cells: &[(Cell, Corners)]) -> Option<f64> {
        let plan = self.fan.plan;
        if plan.periods.iter().all(Option::is_none) {
            return None;
        }
        let most = f64::from(self.most_turns()) + 0.5;
        let reach: Vec<f64> = (plan.periods.iter().zip(&plan.widths))
            .map(|(period, width)| period.map_or(f64::INFINITY, |p| most * p / width))
            .collect();
        let beyond = cells.iter().filter(|(_, corners)| {
            let bounds = corners.bounds(plan.system.states, f64::INFINITY);
            bounds
                .iter()
                .zip(&reach)
                .any(|([lo, hi], reach)| *lo < -reach || hi > reach)
        });
        beyond
            .map(|(_, corners)| corners.value)
            .min_by(f64::total_cmp)
    }

    fn most_turns(&self) -> i32 {
        MOST_TURNS[self.fan.plan.periods.iter().flatten().count()]
    }

    /// The states looked for with all windings that come near a cell.
    pub(super) fn copies(&self, sought: &[Sought], cells: &[(Cell, Corners)]) -> Vec<Copy> {
        let n = self.fan.plan.system.states;
        let mut extent = vec![[f64::INFINITY, f64::NEG_INFINITY]; n];
        for (_, corners) in cells {
            for (extent, bound) in extent.iter_mut().zip(corners.bounds(n, f64::INFINITY)) {
                *extent = [extent[0].min(bound[0]), extent[1].max(bound[1])];
            }
        }
        self.copies_within(sought, &extent)
    }

    /// The states looked for with all windings within a range (in widths).
    pub(super) fn copies_within(&self, sought: &[Sought], extent: &[[f64; 2]]) -> Vec<Copy> {
        let plan = self.fan.plan;
        let n = plan.system.states;
        let most = self.most_turns();
        let mut copies = Vec::new();
        for (k, one) in sought.iter().enumerate() {
            let mut turns: Vec<Vec<i32>> = vec![Vec::new()];
            for i in 0..n {
                let range = match plan.periods[i] {
                    Some(period) => {
                        let width = period / plan.widths[i];
                        let x = one.s[i] / plan.widths[i];
                        let lowest = ((extent[i][0] - x) / width).ceil().max(-1e6) as i32;
                        let highest = ((extent[i][1] - x) / width).floor().min(1e6) as i32;
                        let nearest = (-one.s[i] / period).round().clamp(-1e6, 1e6) as i32;
                        lowest.max(nearest - most)..=highest.min(nearest + most)
                    }
                    None => 0..=0,
                };
                turns = (turns.iter())
                    .flat_map(|t| range.clone().map(|k| [t.as_slice(), &[k]].concat()))
                    .collect();
            }
            for turns in turns {
                let x = (0..n)
                    .map(|i| {
                        (one.s[i] + f64::from(turns[i]) * plan.periods[i].unwrap_or(0.0))
                            / plan.widths[i]
                    })
                    .collect();
                copies.push(Copy {
                    sought: k,
                    turns,
                    x,
                });
            }
        }
        copies
    }
}
