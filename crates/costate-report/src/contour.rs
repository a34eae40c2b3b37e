//! Lines and regions of equal value of a function given on a rectangular grid: marching squares.
//!
//! Along the edges of the grid the function is taken as linear; what happens at a saddle within a
//! cell is decided by the mean of its corners. Cells with a corner that is not finite, and cells in
//! `cut`, are left out: lines end and regions are bounded there.
//!
//! Each cell's part of the region {f >= level} is a polygon. Neighbours share their edges, in
//! opposite directions: what is left when these are taken away are the region's boundaries.

use std::collections::{BTreeMap, BTreeSet};

/// A function on the grid `x` x `y`: `values[i * y.len() + j]` belongs to `(x[i], y[j])`. Both axes
/// ascend.
#[derive(Clone, Copy, Debug)]
pub struct Grid<'a> {
    pub x: &'a [f64],
    pub y: &'a [f64],
    pub values: &'a [f64],
    /// Cells that are left out, `[i * (y.len() - 1) + j]`; empty: none.
    pub cut: &'a [bool],
}

/// A line on which the function has one value. The greater values are on the left of its direction.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    pub points: Vec<[f64; 2]>,
    /// The last point is the first one.
    pub closed: bool,
}

/// A vertex: a node of the grid, or the crossing of the level on the edge from that node along x or
/// y.
type Vertex = (u32, u8);
const NODE: u8 = 0;
const ALONG_X: u8 = 1;
const ALONG_Y: u8 = 2;

/// Directed edges of a region's boundary; `true` for those at the level, not on the grid's edges.
type Edges = BTreeMap<(Vertex, Vertex), bool>;

impl Grid<'_> {
    /// Whether the sizes fit together.
    fn fits(&self) -> bool {
        let (nx, ny) = (self.x.len(), self.y.len());
        nx > 1
            && ny > 1
            && self.values.len() == nx * ny
            && (self.cut.is_empty() || self.cut.len() == (nx - 1) * (ny - 1))
            && u32::try_from(nx * ny).is_ok()
    }

    fn open(&self, i: usize, j: usize) -> bool {
        let ny = self.y.len();
        let corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)];
        corners
            .iter()
            .all(|(i, j)| self.values[i * ny + j].is_finite())
            && !self.cut.get(i * (ny - 1) + j).copied().unwrap_or(false)
    }

    fn place(&self, (node, kind): Vertex, level: f64) -> [f64; 2] {
        let ny = self.y.len();
        let (i, j) = (node as usize / ny, node as usize % ny);
        let here = self.values[node as usize];
        let share = |there: f64| ((level - here) / (there - here)).clamp(0.0, 1.0);
        match kind {
            ALONG_X => {
                let s = share(self.values[(i + 1) * ny + j]);
                [self.x[i] + s * (self.x[i + 1] - self.x[i]), self.y[j]]
            }
            ALONG_Y => {
                let s = share(self.values[i * ny + j + 1]);
                [self.x[i], self.y[j] + s * (self.y[j + 1] - self.y[j])]
            }
            _ => [self.x[i], self.y[j]],
        }
    }

    /// The boundary of {f >= level}, that region on its left.
    fn boundary(&self, level: f64) -> Edges {
        let mut edges = Edges::new();
        if !self.fits() {
            return edges;
        }
        let (cells, ny) = ([self.x.len() - 1, self.y.len() - 1], self.y.len());
        // Cells that belong to the region as a whole, most of them: their common edges would only
        // be taken away again.
        let mut whole = vec![false; cells[0] * cells[1]];
        let mut parts: Vec<(usize, usize)> = Vec::new();
        for i in 0..cells[0] {
            for j in 0..cells[1] {
                if self.open(i, j) {
                    let corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)];
                    let inside = |&(i, j): &(usize, usize)| self.values[i * ny + j] >= level;
                    whole[i * cells[1] + j] = corners.iter().all(inside);
                    parts.push((i, j));
                }
            }
        }
        let is_whole = |i: Option<usize>, j: Option<usize>| {
            let within = i.zip(j).filter(|(i, j)| *i < cells[0] && *j < cells[1]);
            within.is_some_and(|(i, j)| whole[i * cells[1] + j])
        };
        for (i, j) in parts {
            // Across the edges that begin at each corner in turn.
            let beside = [
                is_whole(Some(i), j.checked_sub(1)),
                is_whole(Some(i + 1), Some(j)),
                is_whole(Some(i), Some(j + 1)),
                is_whole(i.checked_sub(1), Some(j)),
            ];
            let here = whole[i * cells[1] + j];
            for polygon in self.cell(i, j, level) {
                for k in 0..polygon.len() {
                    if !(here && beside[k]) {
                        add(&mut edges, polygon[k], polygon[(k + 1) % polygon.len()], ny);
                    }
                }
            }
        }
        edges
    }

    /// The part of a cell where f >= level, counterclockwise.
    fn cell(&self, i: usize, j: usize, level: f64) -> Vec<Vec<Vertex>> {
        let ny = self.y.len();
        let node = |i: usize, j: usize| (i * ny + j) as u32;
        let corners = [
            node(i, j),
            node(i + 1, j),
            node(i + 1, j + 1),
            node(i, j + 1),
        ];
        let between = [
            (corners[0], ALONG_X),
            (corners[1], ALONG_Y),
            (corners[3], ALONG_X),
            (corners[0], ALONG_Y),
        ];
        let values = corners.map(|n| self.values[n as usize]);
        let inside = values.map(|v| v >= level);
        let saddle = inside[0] == inside[2] && inside[1] == inside[3] && inside[0] != inside[1];
        if saddle && values.iter().sum::<f64>() < 4.0 * level {
            let alone = |k: usize| vec![(corners[k], NODE), between[k], between[(k + 3) % 4]];
            let first = usize::from(!inside[0]);
            return vec![alone(first), alone(first + 2)];
        }
        let mut polygon = Vec::with_capacity(6);
        for k in 0..4 {
            if inside[k] {
                polygon.push((corners[k], NODE));
            }
            if inside[k] != inside[(k + 1) % 4] {
                polygon.push(between[k]);
            }
        }
        if polygon.is_empty() {
            vec![]
        } else {
            vec![polygon]
        }
    }
}

/// Adds a directed edge, or takes its opposite away.
fn add(edges: &mut Edges, from: Vertex, to: Vertex, ny: usize) {
    if edges.remove(&(to, from)).is_none() {
        edges.insert((from, to), !on_grid(from, to, ny));
    }
}

/// Whether two vertices of a cell lie on one edge of the grid: not two crossings, of which an edge
/// has but one.
fn on_grid(a: Vertex, b: Vertex, ny: usize) -> bool {
    let end = |(node, kind): Vertex| match kind {
        ALONG_X => node + ny as u32,
        _ => node + 1,
    };
    match (a.1, b.1) {
        (NODE, NODE) => true,
        (NODE, _) => a.0 == b.0 || a.0 == end(b),
        (_, NODE) => b.0 == a.0 || b.0 == end(a),
        _ => false,
    }
}

/// Directed edges joined end to end: vertices of each chain, and whether it is closed. A closed
/// chain's first vertex is not repeated.
fn chains(edges: impl Iterator<Item = (Vertex, Vertex)>) -> Vec<(Vec<Vertex>, bool)> {
    let mut next: BTreeMap<Vertex, BTreeSet<Vertex>> = BTreeMap::new();
    let mut entered: BTreeMap<Vertex, usize> = BTreeMap::new();
    for (from, to) in edges {
        next.entry(from).or_default().insert(to);
        *entered.entry(to).or_default() += 1;
    }
    let mut found = Vec::new();
    // Those that begin somewhere first: what is left then are rings.
    let begins: Vec<Vertex> = (next.iter())
        .filter(|(v, out)| out.len() > entered.get(v).copied().unwrap_or(0))
        .map(|(v, _)| *v)
        .collect();
    for begin in begins {
        while let Some(chain) = walk(&mut next, begin) {
            found.push((chain, false));
        }
    }
    while let Some(begin) = next.keys().next().copied() {
        if let Some(mut chain) = walk(&mut next, begin) {
            let closed = chain.len() > 1 && chain.first() == chain.last();
            if closed {
                chain.pop();
            }
            found.push((chain, closed));
        }
    }
    found
}

/// Follows edges from a vertex on, taking them away; `None` where none is left.
fn walk(next: &mut BTreeMap<Vertex, BTreeSet<Vertex>>, begin: Vertex) -> Option<Vec<Vertex>> {
    let mut chain = vec![begin];
    let mut at = begin;
    while let Some(out) = next.get_mut(&at) {
        let to = out.pop_first();
        if out.is_empty() {
            next.remove(&at);
        }
        let Some(to) = to else { break };
        chain.push(to);
        at = to;
        if at == begin {
            break;
        }
    }
    (chain.len() > 1).then_some(chain)
}

/// Lines on which the function is `level`. Empty where the grid's sizes do not fit together.
pub fn lines(grid: &Grid<'_>, level: f64) -> Vec<Line> {
    let edges = grid.boundary(level);
    let at_level = edges.iter().filter(|(_, level)| **level).map(|(e, _)| *e);
    chains(at_level)
        .into_iter()
        .map(|(chain, closed)| {
            let mut points: Vec<[f64; 2]> = chain.iter().map(|v| grid.place(*v, level)).collect();
            if closed {
                points.push(points[0]);
            }
            Line { points, closed }
        })
        .collect()
}

/// The region {f >= level} as rings (outer ones counterclockwise, holes clockwise), for a fill by
/// the even-odd rule. The first point is not repeated.
pub fn region(grid: &Grid<'_>, level: f64) -> Vec<Vec<[f64; 2]>> {
    chains(grid.boundary(level).into_keys())
        .into_iter()
        .map(|(chain, _)| chain.iter().map(|v| grid.place(*v, level)).collect())
        .collect()
}

/// The area within rings that are directed as [`region`]'s.
pub fn area(rings: &[Vec<[f64; 2]>]) -> f64 {
    let twice = |ring: &Vec<[f64; 2]>| -> f64 {
        (0..ring.len())
            .map(|k| {
                let ([ax, ay], [bx, by]) = (ring[k], ring[(k + 1) % ring.len()]);
                ax * by - bx * ay
            })
            .sum()
    };
    0.5 * rings.iter().map(twice).sum::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn axis(first: f64, last: f64, count: usize) -> Vec<f64> {
        (0..count)
            .map(|k| first + (last - first) * k as f64 / (count - 1) as f64)
            .collect()
    }

    fn sampled(x: &[f64], y: &[f64], f: impl Fn(f64, f64) -> f64) -> Vec<f64> {
        x.iter()
            .flat_map(|x| y.iter().map(|y| f(*x, *y)).collect::<Vec<_>>())
            .collect()
    }

    #[test]
    fn a_linear_function_is_met_exactly() {
        let (x, y) = (axis(0.0, 1.0, 7), axis(-1.0, 1.0, 5));
        let values = sampled(&x, &y, |x, y| 2.0 * x - 3.0 * y);
        let grid = Grid {
            x: &x,
            y: &y,
            values: &values,
            cut: &[],
        };
        let found = lines(&grid, 0.3);
        assert_eq!(found.len(), 1);
        assert!(!found[0].closed);
        for [x, y] in &found[0].points {
            assert!((2.0 * x - 3.0 * y - 0.3).abs() < 1e-14);
        }
        // Greater values on the left.
        let ([ax, ay], [bx, by]) = (found[0].points[0], found[0].points[1]);
        assert!(2.0 * -(by - ay) - 3.0 * (bx - ax) > 0.0);
    }

    #[test]
    fn a_circle() {
        // Linear interpolation of x^2 + y^2 along an edge is off by at most f''/8 h^2 in value, so
        // by h^2 / (8 r) in place: 1e-3 of a step of 1/200 asks for r >= 0.625.
        let x = axis(-1.0, 1.0, 401);
        let values = sampled(&x, &x, |x, y| x * x + y * y);
        let grid = Grid {
            x: &x,
            y: &x,
            values: &values,
            cut: &[],
        };
        let found = lines(&grid, 0.64);
        assert_eq!(found.len(), 1);
        assert!(found[0].closed);
        for [x, y] in &found[0].points {
            assert!((x.hypot(*y) - 0.8).abs() < 1e-3 * 0.005, "{x} {y}");
        }
        // Outside the circle is the region; the square less the disc.
        let outside = area(&region(&grid, 0.64));
        assert!(
            (outside - (4.0 - std::f64::consts::PI * 0.64)).abs() < 1e-4,
            "{outside}"
        );
    }

    #[test]
    fn saddles_both_ways() {
        let x = [0.0, 1.0];
        for (values, pieces) in [([1.0, 0.0, 0.0, 1.0], 1), ([1.0, -2.0, -2.0, 1.0], 2)] {
            let grid = Grid {
                x: &x,
                y: &x,
                values: &values,
                cut: &[],
            };
            assert_eq!(lines(&grid, 0.4).len(), 2);
            let rings = region(&grid, 0.4);
            assert_eq!(rings.len(), pieces);
            let share = area(&rings);
            assert!(share > 0.0 && share < 1.0);
        }
    }

    #[test]
    fn holes_and_cuts_end_lines() {
        let x = axis(0.0, 4.0, 5);
        let mut values = sampled(&x, &x, |_, y| y);
        let whole = Grid {
            x: &x,
            y: &x,
            values: &values,
            cut: &[],
        };
        assert_eq!(lines(&whole, 1.5).len(), 1);
        assert!((area(&region(&whole, 1.5)) - 4.0 * 2.5).abs() < 1e-12);
        // Cells from 1 to 2 along x are left out.
        let cut: Vec<bool> = (0..16).map(|k| k / 4 == 1).collect();
        let parted = lines(&Grid { cut: &cut, ..whole }, 1.5);
        assert_eq!(parted.len(), 2);
        for line in &parted {
            assert!(line.points.iter().all(|p| p[0] <= 1.0 || p[0] >= 2.0));
        }
        assert!((area(&region(&Grid { cut: &cut, ..whole }, 1.5)) - 3.0 * 2.5).abs() < 1e-12);
        // A node without a value takes its four cells with it.
        values[2 * 5 + 2] = f64::NAN;
        let holed = Grid {
            x: &x,
            y: &x,
            values: &values,
            cut: &[],
        };
        let found = lines(&holed, 1.5);
        assert_eq!(found.len(), 2);
        assert!(
            found
                .iter()
                .all(|l| l.points.iter().all(|p| p[0] <= 1.0 || p[0] >= 3.0))
        );
        assert!((area(&region(&holed, -1.0)) - 12.0).abs() < 1e-12);
    }

    #[test]
    fn levels_at_nodes_and_sizes_that_do_not_fit() {
        let x = axis(0.0, 2.0, 3);
        let values = sampled(&x, &x, |x, _| x);
        let grid = Grid {
            x: &x,
            y: &x,
            values: &values,
            cut: &[],
        };
        let found = lines(&grid, 1.0);
        assert_eq!(found.len(), 1);
        assert!(found[0].points.iter().all(|p| p[0] == 1.0));
        assert!((area(&region(&grid, 1.0)) - 2.0).abs() < 1e-12);
        assert!(lines(&grid, 5.0).is_empty() && region(&grid, 5.0).is_empty());
        assert!(lines(&Grid { x: &x[..1], ..grid }, 1.0).is_empty());
        assert!(
            lines(
                &Grid {
                    cut: &[true],
                    ..grid
                },
                1.0
            )
            .is_empty()
        );
    }
}
