//! The cells that a search begins with.

use super::cell::{Cell, Corners};
use super::{BEYOND, Cover, MOST_STATES};
use crate::backend::BackendError;
use rayon::prelude::*;

/// Widest gap, in widths of the region, between neighbouring first trajectories; and how many there
/// are at most.
const SPACING: [f64; MOST_STATES + 1] = [0.05, 0.05, 0.08, 0.15, 0.2, 0.3, 0.4];
const MOST_FIRST: [usize; MOST_STATES + 1] = [2, 4000, 4000, 4000, 1200, 800, 400];
/// Widths beyond the region up to which gaps are looked at.
const AROUND: f64 = 0.25;

impl Cover<'_> {
    /// Divides the first simplices, from the start, where neighbouring trajectories part before
    /// their cost is `ceiling`: the cells of a narrow bundle that goes elsewhere are not seen from
    /// outside it.
    pub(super) fn divide_first(&mut self, ceiling: f64) -> Result<(), BackendError> {
        let n = self.fan.plan.system.states;
        let mut done: Vec<Vec<u32>> = Vec::new();
        let mut open = self.base.clone();
        let first: Vec<u32> = self.base.iter().flatten().copied().collect();
        self.fan.integrate(&first, BEYOND * ceiling)?;
        let mut made = 0;
        while !open.is_empty() {
            let gaps: Vec<(f64, u32, u32)> =
                open.par_iter().map(|s| self.widest(s, ceiling)).collect();
            let mut next = Vec::new();
            let mut middles = Vec::new();
            for (simplex, (gap, a, b)) in open.into_iter().zip(gaps) {
                let wide = gap > SPACING[n] && made < MOST_FIRST[n];
                let Some(middle) = wide.then(|| self.fan.middle(a, b)).flatten() else {
                    done.push(simplex);
                    continue;
                };
                middles.push(middle);
                for end in [a, b] {
                    next.push(
                        simplex
                            .iter()
                            .map(|v| if *v == end { middle } else { *v })
                            .collect(),
                    );
                }
            }
            self.fan.integrate(&middles, BEYOND * ceiling)?;
            middles.sort_unstable();
            middles.dedup();
            made += middles.len();
            open = next;
        }
        (self.roots, self.divided_to) = (done, ceiling);
        Ok(())
    }

    /// The widest gap between two trajectories of a simplex, and which. Endless, between the two
    /// furthest apart, where all of them cost too much but what lies between may not.
    fn widest(&self, simplex: &[u32], ceiling: f64) -> (f64, u32, u32) {
        if let Some((a, b)) = (!self.stationary)
            .then(|| self.fan.hidden(simplex, ceiling))
            .flatten()
        {
            return (f64::INFINITY, a, b);
        }
        let mut widest = (0.0, 0, 0);
        for (k, a) in simplex.iter().enumerate() {
            for b in &simplex[k + 1..] {
                let gap = self.fan.gap(*a, *b, ceiling, AROUND);
                if gap > widest.0 {
                    widest = (gap, *a, *b);
                }
            }
        }
        widest
    }

    /// The cells of the first simplices.
    pub(super) fn first_cells(&self, ceiling: f64) -> Vec<(Cell, Corners)> {
        let fan = &self.fan;
        self.roots
            .par_iter()
            .flat_map_iter(|seeds| {
                let last = seeds.iter().map(|v| fan.reached(*v)).max().unwrap_or(0);
                let levels = if self.stationary {
                    0..last
                } else {
                    fan.levels()..fan.levels() + 1
                };
                levels.filter_map(move |level| {
                    let cell = Cell {
                        seeds: seeds.as_slice().into(),
                        level,
                        bend: f64::INFINITY,
                        depth: 0,
                    };
                    let corners = cell.corners(fan, self.stationary);
                    let any = corners.known.iter().any(|k| *k);
                    (any && corners.lowest <= ceiling).then_some((cell, corners))
                })
            })
            .collect()
    }
}
