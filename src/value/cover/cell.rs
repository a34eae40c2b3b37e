//! Cells of the swept manifold: a simplex of seeds between two levels, and where in it a state
//! lies.

use super::fan::Fan;
use crate::numeric::dense::solve_dense;
use smallvec::{SmallVec, smallvec};

/// What there is of each seed of a cell, and of each corner: kept in place up to 3 states.
pub type OfSeeds<T> = SmallVec<[T; 4]>;
pub type OfCorners<T> = SmallVec<[T; 6]>;

/// A cell: the trajectories of a simplex of seeds between `level` and the next one (finite horizon:
/// at the last level).
#[derive(Clone, Debug)]
pub struct Cell {
    pub seeds: OfSeeds<u32>,
    pub level: usize,
    /// How far the middles of its edges are off the straight line, relative to the edges, as far as
    /// that is known.
    pub bend: f64,
    /// Divisions that led to it.
    pub depth: u32,
}

/// The corners of a cell in widths of the region: first those at the lower level, then those at the
/// upper one.
#[derive(Clone, Debug)]
pub struct Corners {
    /// `[corner][n]`.
    pub x: SmallVec<[f64; 18]>,
    pub known: OfCorners<bool>,
    /// Least V of the known ones; and the highest, endless where one is not known.
    pub value: f64,
    pub highest: f64,
    /// Least V that the known ones expect at each other, by their adjoints: a bundle that passes
    /// between dear neighbours may cost less than any of them.
    pub lowest: f64,
}

/// How much larger than the hull of its corners a cell may be, relative to its size: at least, a
/// unit of its bend, and at most. Curved cells reach beyond it.
const INFLATION: f64 = 0.1;
const INFLATION_BENT: f64 = 2.0;
const MOST_INFLATION: f64 = 1.0;
/// How far outside a straight cell, relative to it, and from it, relative to its longest edge, a
/// state is kept.
const MARGIN: f64 = 0.2;
const NEAR: f64 = 0.04;
/// The same a unit of the cell's bend.
const MARGIN_BENT: f64 = 3.0;
const NEAR_BENT: f64 = 1.5;
/// How much a cell is bent a unit of the way by which its corners' mean is short of theirs.
const TURN: f64 = 2.0;
/// Bend above which a cell's corners do not tell where its inside is.
pub const UNKNOWN: f64 = 0.35;
/// Share of the bend that a half keeps where the division does not show it: it is proportional to
/// an edge's length.
pub const KEPT: f64 = 0.7;

impl Cell {
    pub fn corners(&self, fan: &Fan<'_>, stationary: bool) -> Corners {
        let (n, widths) = (fan.plan.system.states, &fan.plan.widths);
        let levels: &[usize] = if stationary { &[0, 1] } else { &[0] };
        let mut corners = Corners {
            x: SmallVec::new(),
            known: SmallVec::new(),
            value: f64::INFINITY,
            highest: f64::NEG_INFINITY,
            lowest: f64::INFINITY,
        };
        for step in levels {
            corners.lowest = corners.lowest.min(self.expected(fan, self.level + step));
            for seed in &self.seeds {
                let Some((point, known)) = fan.point(*seed, self.level + step) else {
                    corners.known.push(false);
                    corners.highest = f64::INFINITY;
                    corners.x.extend(std::iter::repeat_n(f64::NAN, n));
                    continue;
                };
                corners.known.push(known);
                let value = f64::from(point[1 + 2 * n]);
                corners.value = corners.value.min(value);
                corners.highest = corners
                    .highest
                    .max(if known { value } else { f64::INFINITY });
                corners.x.extend(
                    point[1..=n]
                        .iter()
                        .zip(widths)
                        .map(|(s, w)| f64::from(*s) / w),
                );
            }
        }
        corners.lowest = corners.lowest.min(corners.value);
        corners
    }

    /// The least V that corners at a level expect at each other, by their adjoints.
    fn expected(&self, fan: &Fan<'_>, level: usize) -> f64 {
        let known = |seed: &u32| Some(fan.point(*seed, level)?).filter(|(_, known)| *known);
        let points: OfSeeds<&[f32]> =
            (self.seeds.iter().filter_map(known).map(|(point, _)| point)).collect();
        let pairs = (points.iter()).flat_map(|a| points.iter().map(move |b| (a, b)));
        (pairs.map(|(a, b)| fan.tangent(a, b))).fold(f64::INFINITY, f64::min)
    }
}

impl Corners {
    /// Of points `(t, s, p, V)` all of which are known.
    pub fn of_points(points: &[&[f64]], widths: &[f64]) -> Self {
        let n = widths.len();
        let values = points.iter().map(|point| point[1 + 2 * n]);
        let value = values.clone().fold(f64::INFINITY, f64::min);
        Self {
            x: (points.iter())
                .flat_map(|point| point[1..=n].iter().zip(widths).map(|(s, w)| s / w))
                .collect(),
            known: smallvec![true; points.len()],
            value,
            highest: values.fold(f64::NEG_INFINITY, f64::max),
            lowest: value,
        }
    }

    /// Lowest and highest coordinates, beyond which no part of the cell is expected.
    pub fn bounds(&self, n: usize, bend: f64) -> SmallVec<[[f64; 2]; 3]> {
        let inflation = (INFLATION + INFLATION_BENT * bend).min(MOST_INFLATION);
        let mut bounds: SmallVec<[[f64; 2]; 3]> = smallvec![[f64::INFINITY, f64::NEG_INFINITY]; n];
        for corner in self.x.chunks_exact(n) {
            for (bound, x) in bounds.iter_mut().zip(corner) {
                *bound = [bound[0].min(*x), bound[1].max(*x)];
            }
        }
        let size = bounds.iter().map(|[lo, hi]| hi - lo).fold(0.0, f64::max);
        for bound in &mut bounds {
            *bound = [bound[0] - inflation * size, bound[1] + inflation * size];
        }
        bounds
    }

    /// Whether a state (in widths), which is within the bounds, may lie in the cell.
    pub fn may_hold(&self, state: &[f64], seeds: usize, longest: f64, bend: f64) -> bool {
        if bend >= UNKNOWN || !self.complete() {
            return true;
        }
        let Some(place) = self.locate(state, seeds) else {
            return true;
        };
        if place.outside <= MARGIN + MARGIN_BENT * bend {
            return true;
        }
        let near = (NEAR + NEAR_BENT * bend) * longest;
        self.off(&place, state, seeds) <= near
    }

    /// Distance of a state from the cell, at most: from the point of it that its place is nearest to,
    /// or from an edge.
    fn off(&self, place: &Place, state: &[f64], seeds: usize) -> f64 {
        let n = state.len();
        let share = place.share.clamp(0.0, 1.0);
        let mut weights: OfSeeds<f64> = place.weights.iter().map(|w| w.max(0.0)).collect();
        let sum: f64 = weights.iter().sum();
        weights.iter_mut().for_each(|w| *w /= sum);
        let layers = self.known.len() / seeds;
        let at = |i: usize| -> f64 {
            let corner = |q: usize| match layers {
                2 => (1.0 - share) * self.x[q * n + i] + share * self.x[(seeds + q) * n + i],
                _ => self.x[q * n + i],
            };
            (0..seeds).map(|q| weights[q] * corner(q)).sum()
        };
        let inside = (0..n)
            .map(|i| (at(i) - state[i]).powi(2))
            .sum::<f64>()
            .sqrt();
        let within = (0..layers).flat_map(|layer| {
            let pairs = (0..seeds).flat_map(move |a| (a + 1..seeds).map(move |b| (a, b)));
            pairs.map(move |(a, b)| (layer * seeds + a, layer * seeds + b))
        });
        let between = (0..seeds * (layers - 1)).map(|q| (q, seeds + q));
        let edges = within.chain(between);
        edges.fold(inside, |least, (a, b)| {
            least.min(self.off_edge(a, b, state))
        })
    }

    /// Distance of a state from the edge between two corners.
    fn off_edge(&self, a: usize, b: usize, state: &[f64]) -> f64 {
        let n = state.len();
        let along = |i: usize| self.x[b * n + i] - self.x[a * n + i];
        let way = |i: usize| state[i] - self.x[a * n + i];
        let length: f64 = (0..n).map(|i| along(i).powi(2)).sum();
        let share = (0..n).map(|i| along(i) * way(i)).sum::<f64>() / length.max(f64::MIN_POSITIVE);
        let share = share.clamp(0.0, 1.0);
        let off = |i: usize| (way(i) - share * along(i)).powi(2);
        (0..n).map(off).sum::<f64>().sqrt()
    }

    /// How far a cell's layers are from having the shape of each other, relative to its longest
    /// edge: none for a cell of one layer.
    pub fn skew(&self, seeds: usize, n: usize, longest: f64) -> f64 {
        if self.known.len() < 2 * seeds || longest == 0.0 {
            return 0.0;
        }
        let along = |q: usize, i: usize| self.x[(seeds + q) * n + i] - self.x[q * n + i];
        let differ = |q: usize| {
            (0..n)
                .map(|i| (along(q, i) - along(0, i)).powi(2))
                .sum::<f64>()
                .sqrt()
        };
        0.25 * (1..seeds).map(differ).fold(0.0, f64::max) / longest
    }

    /// How far a cell may reach beyond its corners where their trajectories turn or part within
    /// `step`, the arc length of each between the layers (in widths), relative to its longest edge:
    /// what lies between them goes as far as they do, but their mean does not.
    pub fn turn(&self, seeds: usize, n: usize, step: f64, longest: f64) -> f64 {
        if longest == 0.0 || !self.complete() {
            return 0.0;
        }
        let mean = |i: usize| {
            let along = |q: usize| self.x[(seeds + q) * n + i] - self.x[q * n + i];
            (0..seeds).map(along).sum::<f64>() / seeds as f64
        };
        let goes = (0..n).map(|i| mean(i).powi(2)).sum::<f64>().sqrt();
        TURN * (step - goes).max(0.0) / longest
    }

    /// How far trajectories may pass beside the straight lines between their ends at the layers,
    /// relative to the cell's longest edge. Those of `whole` seeds (by position) are as long as `step`
    /// (in widths), and so lie within ellipses about their ends.
    pub fn bow(&self, whole: &[usize], n: usize, step: f64, longest: f64) -> f64 {
        if longest == 0.0 || !self.complete() {
            return 0.0;
        }
        let seeds = self.known.len() / 2;
        let straight = (whole.iter()).map(|q| self.distance(*q, seeds + q, n));
        let shortest = straight.fold(step, f64::min);
        0.5 * (step * step - shortest * shortest).sqrt() / longest
    }

    /// How far the middle of the edge between two seeds is off the line between them, at the layers
    /// of which all is known.
    pub fn bend(
        &self,
        a: usize,
        b: usize,
        middle: &[Option<SmallVec<[f64; 3]>>],
        seeds: usize,
        n: usize,
    ) -> f64 {
        let mut bend = 0.0f64;
        for (layer, middle) in middle.iter().enumerate() {
            let (a, b) = (layer * seeds + a, layer * seeds + b);
            let length = self.distance(a, b, n);
            let Some(middle) = middle
                .as_ref()
                .filter(|_| self.known[a] && self.known[b] && length > 0.0)
            else {
                return UNKNOWN;
            };
            let off = (0..n)
                .map(|i| (middle[i] - 0.5 * (self.x[a * n + i] + self.x[b * n + i])).powi(2))
                .sum::<f64>()
                .sqrt();
            bend = bend.max(off / length);
        }
        bend
    }

    fn distance(&self, a: usize, b: usize, n: usize) -> f64 {
        (0..n)
            .map(|i| (self.x[a * n + i] - self.x[b * n + i]).powi(2))
            .sum::<f64>()
            .sqrt()
    }

    /// The longest edge between two of the seeds at either level, as positions among the seeds, and
    /// its length.
    pub fn longest(&self, seeds: usize, n: usize) -> (usize, usize, f64) {
        let layers = self.known.len() / seeds;
        let mut longest = (0, 0, 0.0);
        for a in 0..seeds {
            for b in a + 1..seeds {
                for layer in 0..layers {
                    let length = self.distance(layer * seeds + a, layer * seeds + b, n);
                    if length > longest.2 {
                        longest = (a, b, length);
                    }
                }
            }
        }
        longest
    }

    pub fn complete(&self) -> bool {
        self.known.iter().all(|k| *k)
    }

    /// Where a state (in widths) lies in the cell: the weights of the seeds and the share of the
    /// way between the levels, with how far it is outside (0: inside; relative to the cell). None
    /// where the cell is flat.
    pub fn locate(&self, state: &[f64], seeds: usize) -> Option<Place> {
        let layers = self.known.len() / seeds;
        let unknowns = seeds - 1 + usize::from(layers == 2);
        match (state.len(), unknowns) {
            (1, 1) => self.locate_in::<1>(state, seeds),
            (2, 2) => self.locate_in::<2>(state, seeds),
            (3, 3) => self.locate_in::<3>(state, seeds),
            _ => None,
        }
    }

    /// Newton's method for the place: a cell of two layers is bilinear.
    fn locate_in<const N: usize>(&self, state: &[f64], seeds: usize) -> Option<Place> {
        let two = self.known.len() == 2 * seeds;
        let mut weights: OfSeeds<f64> = smallvec![1.0 / seeds as f64; seeds];
        let mut share = if two { 0.5 } else { 0.0 };
        for _ in 0..8 {
            let mut step: [f64; N] = std::array::from_fn(|i| state[i]);
            let mut matrix = [[0.0; N]; N];
            for i in 0..N {
                let at = |corner: usize| self.x[corner * N + i];
                let mixed = |seed: usize| {
                    if two {
                        (1.0 - share) * at(seed) + share * at(seeds + seed)
                    } else {
                        at(seed)
                    }
                };
                for (seed, weight) in weights.iter().enumerate() {
                    step[i] -= weight * mixed(seed);
                }
                for seed in 1..seeds {
                    matrix[i][seed - 1] = mixed(seed) - mixed(0);
                }
                if two {
                    matrix[i][N - 1] = (0..seeds)
                        .map(|q| weights[q] * (at(seeds + q) - at(q)))
                        .sum();
                }
            }
            solve_dense(N, matrix.as_flattened_mut(), &mut step)?;
            if !step.iter().all(|x| x.is_finite() && x.abs() < 1e3) {
                return None;
            }
            for seed in 1..seeds {
                weights[seed] += step[seed - 1];
                weights[0] -= step[seed - 1];
            }
            if two {
                share += step[N - 1];
            }
            if step.iter().all(|x| x.abs() < 1e-6) {
                break;
            }
        }
        let below = weights.iter().fold(0.0f64, |a, w| a.max(-w));
        let outside = below.max(-share).max(share - 1.0);
        Some(Place {
            weights,
            share,
            outside,
        })
    }
}

/// A place in a cell.
#[derive(Clone, Debug)]
pub struct Place {
    /// One a seed, 1 in all.
    pub weights: OfSeeds<f64>,
    /// Share of the way from the lower to the upper level.
    pub share: f64,
    /// How far outside the cell it is, relative to the cell; 0 inside.
    pub outside: f64,
}
