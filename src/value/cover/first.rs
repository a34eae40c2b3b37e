//! The cells that a search begins with.

use super::cell::{Cell, Corners};
use super::{BEYOND, Cover, MOST_STATES};
use crate::backend::BackendError;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

/// Widest gap, in widths of the region, between neighbouring first trajectories; and how many there
/// are at most.
const SPACING: [f64; MOST_STATES + 1] = [0.05, 0.05, 0.08, 0.15, 0.2, 0.3, 0.4];
const MOST_FIRST: [usize; MOST_STATES + 1] = [2, 4000, 4000, 4000, 1200, 800, 400];
/// Widths beyond the region up to which gaps are looked at.
const AROUND: f64 = 0.25;

/// How far the middle trajectory of a gap may pass from the middle between the others, in units of
/// the widest gap.
const BULGE: f64 = 0.5;

/// Whether it is looked at what passes between first trajectories that stay near each other, or
/// have parted when they cost too much, and at what they do behind a fold only in the end. In space
/// this takes twice as many trajectories, and those before folds alone are too many.
pub(super) fn looks_into_gaps(states: usize) -> bool {
    states <= 2
}

/// How far two trajectories part, in widths of the region, at the first `levels`.
struct Gap {
    size: f64,
    a: u32,
    b: u32,
    levels: usize,
}

/// Widest gaps between two trajectories (the lower seed first) at all levels: an edge has many
/// simplices.
type Gaps = FxHashMap<(u32, u32), f64>;

/// The edges of a simplex, the lower seed first.
fn edges(simplex: &[u32]) -> impl Iterator<Item = (u32, u32)> {
    (simplex.iter().enumerate())
        .flat_map(|(k, a)| simplex[k + 1..].iter().map(|b| (*a.min(b), *a.max(b))))
}

/// Simplices that are not divided further.
#[derive(Default)]
struct Divided {
    done: Vec<Vec<u32>>,
    /// Of these nothing behind a fold was looked at.
    folded: Vec<Vec<u32>>,
}

impl Divided {
    fn push(&mut self, simplex: Vec<u32>, gap: Gap) {
        match gap.levels {
            usize::MAX => self.done.push(simplex),
            _ => self.folded.push(simplex),
        }
    }
}

impl Cover<'_> {
    /// Divides the first simplices, from the start, where neighbouring trajectories part before
    /// their cost is `ceiling`: the cells of a narrow bundle that goes elsewhere are not seen from
    /// outside it. What the trajectories do behind a fold comes last: none of them costs the least
    /// there, and those that are scattered by many obstacles part without end.
    pub(super) fn divide_first(&mut self, ceiling: f64) -> Result<(), BackendError> {
        let first: Vec<u32> = self.base.iter().flatten().copied().collect();
        self.fan.integrate(&first, BEYOND * ceiling)?;
        let (mut made, mut gaps) = (0, Gaps::default());
        let base = self.base.clone();
        let Divided { mut done, folded } =
            self.divide_gaps(base, ceiling, false, (&mut made, &mut gaps))?;
        let behind = self.divide_gaps(folded, ceiling, true, (&mut made, &mut gaps))?;
        done.extend(behind.done);
        (self.roots, self.divided_to) = (done, ceiling);
        Ok(())
    }

    /// Divides simplices until none has a wide gap, or as many seeds were `made` as there are at
    /// most.
    fn divide_gaps(
        &mut self,
        mut open: Vec<Vec<u32>>,
        ceiling: f64,
        behind_folds: bool,
        (made, known): (&mut usize, &mut Gaps),
    ) -> Result<Divided, BackendError> {
        let n = self.fan.plan.system.states;
        let mut divided = Divided::default();
        while !open.is_empty() {
            self.measure(&open, ceiling, known);
            let gaps: Vec<Gap> = (open.par_iter())
                .map(|simplex| self.widest(simplex, ceiling, behind_folds, known))
                .collect();
            let mut halved: Vec<(Vec<u32>, Gap, u32)> = Vec::new();
            for (simplex, gap) in open.into_iter().zip(gaps) {
                // Behind folds what lies between is not worth a look.
                let least = match looks_into_gaps(n) && !behind_folds {
                    true => 0.0,
                    false => SPACING[n],
                };
                let looked_into = gap.size > least && *made < MOST_FIRST[n];
                match looked_into.then(|| self.fan.middle(gap.a, gap.b)).flatten() {
                    Some(middle) => halved.push((simplex, gap, middle)),
                    None => divided.push(simplex, gap),
                }
            }
            let mut middles: Vec<u32> = halved.iter().map(|(.., middle)| *middle).collect();
            middles.sort_unstable();
            middles.dedup();
            self.fan.integrate(&middles, BEYOND * ceiling)?;

            let is_wide = |(_, gap, middle): &(Vec<u32>, Gap, u32)| {
                gap.size > SPACING[n] || {
                    let seeds = [gap.a, gap.b, *middle];
                    self.fan.bulge(seeds, gap.levels, ceiling, AROUND) > BULGE * SPACING[n]
                }
            };
            let wide: Vec<bool> = halved.par_iter().map(is_wide).collect();
            let mut dividing: Vec<u32> = Vec::new();
            open = Vec::new();
            for ((simplex, gap, middle), wide) in halved.into_iter().zip(wide) {
                if !wide {
                    divided.push(simplex, gap);
                    continue;
                }
                dividing.push(middle);
                for end in [gap.a, gap.b] {
                    let half = simplex.iter().map(|v| if *v == end { middle } else { *v });
                    open.push(half.collect());
                }
            }
            dividing.sort_unstable();
            dividing.dedup();
            *made += dividing.len();
        }
        Ok(divided)
    }

    /// Adds the gaps of the simplices' edges that are not known.
    fn measure(&self, simplices: &[Vec<u32>], ceiling: f64, known: &mut Gaps) {
        let mut new: Vec<(u32, u32)> = Vec::new();
        for edge in simplices.iter().flat_map(|simplex| edges(simplex)) {
            known.entry(edge).or_insert_with(|| {
                new.push(edge);
                f64::NAN
            });
        }
        let gap = |(a, b): (u32, u32)| self.fan.gap(a, b, usize::MAX, ceiling, AROUND);
        let sizes: Vec<f64> = new.par_iter().map(|edge| gap(*edge)).collect();
        known.extend(new.into_iter().zip(sizes));
    }

    /// The widest gap between two trajectories of a simplex. Endless, between the two furthest
    /// apart, where all of them cost too much but what lies between may not.
    fn widest(&self, simplex: &[u32], ceiling: f64, behind_folds: bool, known: &Gaps) -> Gap {
        if let Some((a, b)) = (!self.stationary)
            .then(|| self.fan.hidden(simplex, ceiling))
            .flatten()
        {
            return Gap {
                size: f64::INFINITY,
                a,
                b,
                levels: usize::MAX,
            };
        }
        let all = widest_of(simplex, usize::MAX, |edge| known[&edge]);
        if behind_folds || !looks_into_gaps(self.fan.plan.system.states) {
            return all;
        }
        match self.fan.fold(simplex) {
            Some(levels) => widest_of(simplex, levels, |(a, b)| {
                self.fan.gap(a, b, levels, ceiling, AROUND)
            }),
            None => all,
        }
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

/// The widest of a simplex's gaps at the first `levels`.
fn widest_of(simplex: &[u32], levels: usize, size: impl Fn((u32, u32)) -> f64) -> Gap {
    let gap = |(a, b), size| Gap { size, a, b, levels };
    let wider = |widest: Gap, gap: Gap| match gap.size > widest.size {
        true => gap,
        false => widest,
    };
    let none = gap((0, 0), 0.0);
    (edges(simplex).map(|edge| gap(edge, size(edge)))).fold(none, wider)
}
