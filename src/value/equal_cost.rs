//! The equal-cost boundary: where two sheets cost the same and the optimal feedback jumps.

use super::approach::{Approach, follow};
use super::extremal::same;
use super::survey::{Survey, Wanted};
use crate::backend::BackendError;
use crate::shooting::{Path, Solver};
use rustc_hash::FxHashMap;
use std::collections::BTreeMap;

/// Largest difference of V, relative to V, at a located point.
pub const EQUAL: f64 = 1e-9;
/// Iterations by which a point is located.
const MOST_ROUNDS: usize = 12;
/// Shortest step of the way to a point, as a share of it.
const LEAST: f64 = 1.0 / 64.0;

/// A point where the two cheapest sheets cost the same.
#[derive(Clone, Debug)]
pub struct BoundaryPoint {
    /// The neighbouring targets between which it lies.
    pub between: (usize, usize),
    /// State (absolute; as the targets are given).
    pub x: Vec<f64>,
    /// V, the mean of both.
    pub value: f64,
    /// `|V1 - V2| / V`.
    pub difference: f64,
    /// The sheets, the lower label first, with each one's adjoint and the deviation its solution
    /// starts from.
    pub sheets: [i32; 2],
    pub p: [Vec<f64>; 2],
    pub s: [Vec<f64>; 2],
    /// Polyline that the point is on, and its place there; −1 where there are no lines.
    pub line: i32,
    pub place: i32,
}

/// Two solutions followed to the same moving state on an edge.
struct Pair {
    edge: (usize, usize),
    /// Extremals of the sheets that are lowest at the two ends.
    extremals: [usize; 2],
    paths: [Path; 2],
    /// Share of the edge, and the bracket of the point on it.
    at: f64,
    low: f64,
    high: f64,
    done: Option<BoundaryPoint>,
    lost: bool,
}

impl BoundaryPoint {
    /// The same with other numbers of its sheets, the lower one first.
    pub fn renumbered(&mut self, number: impl Fn(i32) -> i32) -> bool {
        self.sheets = self.sheets.map(number);
        let turned = self.sheets[0] > self.sheets[1];
        if turned {
            self.sheets.swap(0, 1);
            self.p.swap(0, 1);
            self.s.swap(0, 1);
        }
        turned
    }
}

impl Survey<'_> {
    /// Locates the equal-cost boundary on all edges whose ends' cheapest solutions lie on different
    /// sheets.
    ///
    /// # Errors
    /// Device failures only.
    pub fn equal_cost(
        &mut self,
        solver: &mut Solver,
        wanted: Wanted,
    ) -> Result<Vec<BoundaryPoint>, BackendError> {
        let (mut points, joined) = self.crossings(solver, wanted)?;
        if joined {
            // Sheets that were one after all have one label now.
            self.label();
            points = self.crossings(solver, wanted)?.0;
        }
        along_lines(&mut points, &self.targets.cells);
        Ok(points)
    }

    /// The points where sheets cross; and whether two turned out to be the same, which are joined.
    pub(super) fn crossings(
        &mut self,
        solver: &mut Solver,
        wanted: Wanted,
    ) -> Result<(Vec<BoundaryPoint>, bool), BackendError> {
        let mut joined = false;
        let mut pairs = self.pairs(wanted);
        for _ in 0..MOST_ROUNDS {
            let active: Vec<usize> = (0..pairs.len())
                .filter(|k| pairs[*k].done.is_none() && !pairs[*k].lost)
                .collect();
            if active.is_empty() {
                break;
            }
            let mut ways: Vec<Approach> = Vec::with_capacity(2 * active.len());
            for &k in &active {
                for side in 0..2 {
                    let goal = self.on_edge(&pairs[k], side);
                    ways.push(Approach::from_solution(
                        pairs[k].paths[side].clone(),
                        goal,
                        LEAST,
                    ));
                }
            }
            follow(solver, &mut ways)?;
            solver.deadline.check()?;
            let mut ways = ways.into_iter();
            for k in active {
                let both = [ways.next(), ways.next()].map(|w| w.and_then(|w| w.finish().1.ok()));
                let [Some(a), Some(b)] = both else {
                    pairs[k].lost = true;
                    continue;
                };
                let [i, j] = pairs[k].extremals;
                let alike = self.extremals[i].winding == self.extremals[j].winding
                    && same(a.0.path.adjoint(), b.0.path.adjoint(), &self.scales);
                if alike {
                    joined |= self.join(i, j);
                    pairs[k].lost = true;
                } else {
                    self.refine(&mut pairs[k], a, b);
                }
            }
        }
        Ok((pairs.into_iter().filter_map(|p| p.done).collect(), joined))
    }

    /// The state at a pair's place on its edge, as a deviation with the winding of one side.
    fn on_edge(&self, pair: &Pair, side: usize) -> Vec<f64> {
        let winding = self.extremals[pair.extremals[side]].winding;
        let (a, b) = (
            self.state(pair.edge.0, winding),
            self.state(pair.edge.1, winding),
        );
        a.iter()
            .zip(&b)
            .map(|(a, b)| a + pair.at * (b - a))
            .collect()
    }

    /// V up to which the sheets of two neighbours are of interest.
    fn highest(&self, a: usize, b: usize, wanted: Wanted) -> f64 {
        let limits = &self.targets.limits;
        wanted.at(limits[a].max(limits[b])).value_max
    }

    fn pairs(&self, wanted: Wanted) -> Vec<Pair> {
        let mut pairs = Vec::new();
        for &(a, b) in &self.targets.edges {
            let (Some(i), Some(j)) = (self.lowest(a), self.lowest(b)) else {
                continue;
            };
            if self.sheet[i] == self.sheet[j]
                || (0..self.targets.states).any(|k| self.base(a, k) != self.base(b, k))
                || self.extremals[i].value().min(self.extremals[j].value())
                    > self.highest(a, b, wanted)
            {
                continue;
            }
            // The boundary is where the sheets cross: each must go on at least as far as the point
            // between.
            let on = |target: usize, sheet: i32| {
                self.at[target]
                    .iter()
                    .copied()
                    .find(|e| self.sheet[*e] == sheet)
            };
            let (i_at_b, j_at_a) = (on(b, self.sheet[i]), on(a, self.sheet[j]));
            let value = |e: usize| self.extremals[e].value();
            let at = match (i_at_b, j_at_a) {
                (Some(ib), Some(ja)) => {
                    let (da, db) = (value(i) - value(ja), value(ib) - value(j));
                    (da / (da - db)).clamp(0.0, 1.0)
                }
                _ => 0.5,
            };
            pairs.push(Pair {
                edge: (a, b),
                extremals: [i, j],
                paths: [
                    self.extremals[i].path.clone(),
                    self.extremals[j].path.clone(),
                ],
                at: if at.is_finite() { at } else { 0.5 },
                low: 0.0,
                high: 1.0,
                done: None,
                lost: false,
            });
        }
        pairs
    }

    /// Newton's method for V1 = V2 on the edge, kept inside the bracket: dV/dx is p.
    fn refine(
        &self,
        pair: &mut Pair,
        a: (crate::shooting::Job, crate::shooting::Solved),
        b: (crate::shooting::Job, crate::shooting::Solved),
    ) {
        let n = self.targets.states;
        let difference = a.1.value - b.1.value;
        let mean = 0.5 * (a.1.value + b.1.value);
        let (x0, x1) = (
            self.targets.state(pair.edge.0),
            self.targets.state(pair.edge.1),
        );
        let slope: f64 = (0..n)
            .map(|i| (a.0.path.adjoint()[i] - b.0.path.adjoint()[i]) * (x1[i] - x0[i]))
            .sum();
        if difference.abs() <= EQUAL * mean.abs() {
            let mut order = [0, 1];
            let label = |side: usize| self.sheet[pair.extremals[side]];
            if label(0) > label(1) {
                order = [1, 0];
            }
            let jobs = [&a.0, &b.0];
            pair.done = Some(BoundaryPoint {
                between: pair.edge,
                x: (0..n).map(|i| x0[i] + pair.at * (x1[i] - x0[i])).collect(),
                value: mean,
                difference: if mean == 0.0 {
                    0.0
                } else {
                    difference.abs() / mean.abs()
                },
                sheets: order.map(label),
                p: order.map(|k| jobs[k].path.adjoint().to_vec()),
                s: order.map(|k| jobs[k].path.start().to_vec()),
                line: -1,
                place: -1,
            });
            return;
        }
        if difference < 0.0 {
            pair.low = pair.at;
        } else {
            pair.high = pair.at;
        }
        let newton = pair.at - difference / slope;
        pair.at = if newton > pair.low && newton < pair.high {
            newton
        } else {
            0.5 * (pair.low + pair.high)
        };
        pair.paths = [a.0.path, b.0.path];
    }
}

/// Joins the points of cells to polylines: two points on a cell's sides with the same pair of
/// sheets are neighbours.
pub fn along_lines(points: &mut [BoundaryPoint], cells: &[[usize; 4]]) {
    let on_edge: FxHashMap<(usize, usize), usize> = points
        .iter()
        .enumerate()
        .map(|(k, p)| (p.between, k))
        .collect();
    let mut next: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for cell in cells {
        let mut by_sheets: BTreeMap<[i32; 2], Vec<usize>> = BTreeMap::new();
        for q in 0..4 {
            let (a, b) = (cell[q], cell[(q + 1) % 4]);
            if let Some(&k) = on_edge.get(&(a.min(b), a.max(b))) {
                by_sheets.entry(points[k].sheets).or_default().push(k);
            }
        }
        for list in by_sheets.into_values() {
            // In order around the cell: neighbours in pairs.
            for pair in list.chunks_exact(2) {
                next.entry(pair[0]).or_default().push(pair[1]);
                next.entry(pair[1]).or_default().push(pair[0]);
            }
        }
    }
    let ends = next.iter().filter(|(_, n)| n.len() == 1).map(|(k, _)| *k);
    let starts: Vec<usize> = ends.chain(next.keys().copied()).collect();
    let mut line = 0;
    for start in starts {
        if points[start].line >= 0 {
            continue;
        }
        let (mut at, mut place) = (Some(start), 0);
        while let Some(k) = at {
            points[k].line = line;
            points[k].place = place;
            place += 1;
            at = next[&k].iter().copied().find(|q| points[*q].line < 0);
        }
        line += 1;
    }
}
