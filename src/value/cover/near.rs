//! Where there are too many states for cells: the points of swept trajectories near a state.

use super::{Candidate, Copy, Cover, Sought};
use crate::backend::BackendError;
use crate::value::nearest::{self, Nearest};
use rayon::prelude::*;

/// Points of one trajectory between two that are looked up.
const EVERY: usize = 4;
/// What is looked at for a state.
struct Effort {
    /// Points looked at, and those of them that are offered.
    near: usize,
    offered: usize,
    /// Share by which the adjoints of two points on different trajectories differ at least for both
    /// to be offered.
    different: f64,
}
/// For a state of a grid, whose neighbours help; and for one that may be alone.
const OF_GRID: Effort = Effort {
    near: 96,
    offered: 4,
    different: 0.35,
};
const ALONE: Effort = Effort {
    near: 300,
    offered: 12,
    different: 0.2,
};
/// Distance, in units of that of the nearest point, and in widths, up to which points are of use.
const FARTHER: f64 = 3.0;
const FAR: f64 = 0.5;

/// Points of swept trajectories that are looked up.
struct Points {
    /// Seeds and levels.
    places: Vec<(u32, usize)>,
    /// In widths of the region, `[point][state]`.
    x: Vec<f64>,
    /// Least and largest, one a state.
    extent: Vec<[f64; 2]>,
}

impl Cover<'_> {
    /// Guesses for states from the trajectories that pass near them and cost at most `ceiling`
    /// there: the nearest, and those whose adjoints differ from all that are nearer.
    ///
    /// # Errors
    /// Device failures only.
    pub fn near(
        &mut self,
        sought: &[Sought],
        ceiling: f64,
    ) -> Result<Vec<Candidate>, BackendError> {
        if self.divided_to != ceiling {
            self.divide_first(ceiling)?;
        }
        let points = self.points_to(ceiling);
        if points.places.is_empty() {
            return Ok(Vec::new());
        }
        let tree = nearest::index(&points.x, self.fan.plan.system.states);
        let copies = self.copies_within(sought, &points.extent);
        let this = &*self;
        let mut found: Vec<Candidate> = copies
            .par_iter()
            .flat_map_iter(|copy| this.offered(copy, sought, &points.places, tree.as_ref()))
            .collect();
        found.sort_by(|a, b| {
            (a.target.cmp(&b.target))
                .then(a.outside().total_cmp(&b.outside()))
                .then(a.turns.cmp(&b.turns))
        });
        Ok(found)
    }

    /// Every so many points of the swept trajectories that cost at most so much.
    fn points_to(&self, ceiling: f64) -> Points {
        let (fan, n) = (&self.fan, self.fan.plan.system.states);
        let mut seeds: Vec<u32> = self.roots.iter().flatten().copied().collect();
        seeds.sort_unstable();
        seeds.dedup();
        let mut places: Vec<(u32, usize)> = Vec::new();
        let mut x: Vec<f64> = Vec::new();
        let mut extent = vec![[f64::INFINITY, f64::NEG_INFINITY]; n];
        for seed in seeds {
            for level in (0..=fan.reached(seed)).step_by(EVERY) {
                let Some((point, true)) = fan.point(seed, level) else {
                    break;
                };
                if f64::from(point[1 + 2 * n]) > ceiling {
                    break;
                }
                places.push((seed, level));
                for i in 0..n {
                    let along = f64::from(point[1 + i]) / fan.plan.widths[i];
                    extent[i] = [extent[i][0].min(along), extent[i][1].max(along)];
                    x.push(along);
                }
            }
        }
        Points { places, x, extent }
    }

    /// Guesses for a state from the points near it: the nearest, and those whose adjoints differ
    /// from all that are nearer.
    fn offered(
        &self,
        copy: &Copy,
        sought: &[Sought],
        places: &[(u32, usize)],
        tree: &dyn Nearest,
    ) -> Vec<Candidate> {
        let fan = &self.fan;
        let effort = if sought[copy.sought].gridded {
            OF_GRID
        } else {
            ALONE
        };
        let mut near = tree.near(&copy.x, f64::INFINITY, effort.near);
        let within = near.first().map_or(0.0, |(_, d)| (FARTHER * d).max(FAR));
        // A trajectory that stays on an invariant boundary leads to one that does, without
        // rounding.
        if fan.is_on_boundary(&copy.x) {
            near.sort_by_key(|(k, _)| !fan.is_boundary(places[*k].0));
        }
        let mut offered: Vec<Candidate> = Vec::new();
        for (k, distance) in near {
            if offered.len() >= effort.offered {
                break;
            }
            if distance > within {
                continue;
            }
            let (seed, level) = places[k];
            let candidate = self.point_guess(seed, level, copy, sought, distance);
            let like =
                |other: &Candidate| differ(other, &candidate, &fan.plan.widths) < effort.different;
            if !offered.iter().any(like) {
                offered.push(candidate);
            }
        }
        offered
    }
}

/// Difference of two adjoints relative to the larger one, in units of the region's widths.
fn differ(a: &Candidate, b: &Candidate, widths: &[f64]) -> f64 {
    let (p, q) = (a.adjoint(), b.adjoint());
    let largest = |of: &dyn Fn(usize) -> f64| {
        (0..p.len())
            .map(|i| (of(i) * widths[i]).abs())
            .fold(0.0, f64::max)
    };
    let size = largest(&|i| p[i]).max(largest(&|i| q[i]));
    if a.turns != b.turns || size == 0.0 {
        f64::INFINITY
    } else {
        largest(&|i| p[i] - q[i]) / size
    }
}
