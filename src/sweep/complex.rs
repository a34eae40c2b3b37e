//! The seeds' neighbourhoods: a simplicial complex refined by splitting edges.
//!
//! For an infinite horizon it triangulates the sphere of directions (two states: a closed curve);
//! for a finite horizon the box of terminal states. Splitting an edge splits every simplex that has
//! it, so neighbours always match. What is settled is forgotten: memory follows the unsettled part,
//! not the number of seeds.
//!
//! Simplices and edges are rows of flat arrays, which name each other by their rows' numbers; the
//! rows of those forgotten are used again. So a split looks nothing up, and asks for no memory.

use rustc_hash::FxHashMap;
use smallvec::SmallVec;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Index of a vertex, in order of creation.
pub type Vertex = u32;

/// The ends of an edge, the smaller index first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Ends(pub Vertex, pub Vertex);

impl Ends {
    pub fn new(a: Vertex, b: Vertex) -> Self {
        Ends(a.min(b), a.max(b))
    }
}

/// An edge of a complex, by its row; of use as long as the edge is open.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Edge(u32);

#[derive(Clone, Debug)]
struct EdgeRecord {
    ends: Ends,
    settled: bool,
    simplices: SmallVec<[u32; 6]>,
}

#[derive(Clone, Copy, Debug)]
struct Simplex {
    /// Its number in order of creation.
    born: u32,
    /// The initial simplex it comes from: work goes from one to the next, so that few are open at a
    /// time.
    root: u32,
    unsettled: u32,
}

/// Of a simplex that has been forgotten.
const GONE: u32 = u32::MAX;

/// A simplicial complex with open (not yet settled) edges.
#[derive(Clone, Debug, Default)]
pub struct Complex {
    /// Vertices of a simplex.
    corners: usize,
    /// A simplex's edges by the places of their ends among its vertices.
    pairs: Vec<(usize, usize)>,
    simplices: Vec<Simplex>,
    /// `[simplex][corner]`.
    vertices: Vec<Vertex>,
    /// `[simplex][pair]`: rows of its edges.
    sides: Vec<u32>,
    free_simplices: Vec<u32>,
    edges: Vec<EdgeRecord>,
    free_edges: Vec<u32>,
    next_simplex: u32,
    /// Simplices at each vertex; at none, what is kept for the vertex can be dropped.
    simplices_at: Vec<u32>,
    /// The edge made last to each vertex: while an edge is split, that to the new vertex.
    latest: Vec<u32>,
    /// Edges that have come up since they were last asked for.
    fresh: Vec<Edge>,
    /// Vertices whose last simplex was forgotten since they were last asked for.
    closed: Vec<Vertex>,
}

impl Complex {
    /// A complex of the given simplices, all of as many vertices, over vertices `0..vertices`.
    pub fn new(vertices: usize, simplices: &[Vec<Vertex>]) -> Self {
        let corners = simplices.first().map_or(0, Vec::len);
        let pairs = (0..corners)
            .flat_map(|i| (i + 1..corners).map(move |j| (i, j)))
            .collect();
        let mut this = Self {
            corners,
            pairs,
            simplices_at: vec![0; vertices],
            latest: vec![0; vertices],
            ..Self::default()
        };
        let mut known: FxHashMap<Ends, u32> = FxHashMap::default();
        for (root, vertices) in simplices.iter().enumerate() {
            let id = this.row();
            this.vertices[id as usize * corners..][..corners].copy_from_slice(vertices);
            for k in 0..this.pairs.len() {
                let (i, j) = this.pairs[k];
                let ends = Ends::new(vertices[i], vertices[j]);
                let side = *(known.entry(ends)).or_insert_with(|| this.open(ends));
                this.attach(id, k, side);
            }
            this.appear(id, root as u32);
            for v in vertices {
                this.simplices_at[*v as usize] += 1;
            }
            // A point has no edges and is settled as it is.
            if this.pairs.is_empty() {
                this.forget(id);
            }
        }
        this
    }

    /// The boundary of the cross-polytope in n dimensions, with its vertices' directions: `2n`
    /// vertices, `2^n` simplices.
    pub fn sphere(n: usize) -> (Self, Vec<Vec<f64>>) {
        // In two dimensions in order round the curve; generally +e_0, +e_1, ..., -e_0, -e_1, ...
        let directions: Vec<Vec<f64>> = (0..2 * n)
            .map(|k| {
                (0..n)
                    .map(|i| {
                        if i == k % n {
                            if k < n { 1.0 } else { -1.0 }
                        } else {
                            0.0
                        }
                    })
                    .collect()
            })
            .collect();
        let simplices: Vec<Vec<Vertex>> = (0..1u32 << n)
            .map(|signs| {
                (0..n as u32)
                    .map(|i| if signs >> i & 1 == 0 { i } else { i + n as u32 })
                    .collect()
            })
            .collect();
        (Self::new(2 * n, &simplices), directions)
    }

    /// Kuhn's triangulation of the unit box in n dimensions: `2^n` vertices, `n!` simplices.
    pub fn unit_box(n: usize) -> (Self, Vec<Vec<f64>>) {
        let corners: Vec<Vec<f64>> = (0..1u32 << n)
            .map(|c| (0..n).map(|i| f64::from(c >> i & 1)).collect())
            .collect();
        let mut orders: Vec<Vec<usize>> = vec![Vec::new()];
        for _ in 0..n {
            orders = (orders.iter())
                .flat_map(|o| {
                    (0..n)
                        .filter(|i| !o.contains(i))
                        .map(|i| [o.as_slice(), &[i]].concat())
                        .collect::<Vec<_>>()
                })
                .collect();
        }
        let simplices: Vec<Vec<Vertex>> = (orders.iter())
            .map(|order| {
                let mut corner = 0u32;
                let path = order.iter().map(|i| {
                    corner |= 1 << i;
                    corner
                });
                std::iter::once(0).chain(path).collect()
            })
            .collect();
        (Self::new(1 << n, &simplices), corners)
    }

    /// The simplices' vertices, in order of creation.
    pub fn simplices(&self) -> Vec<Vec<Vertex>> {
        let vertices = |id: u32| self.vertices_of(id).to_vec();
        self.in_order().into_iter().map(vertices).collect()
    }

    /// Rows of the simplices, in order of creation.
    fn in_order(&self) -> Vec<u32> {
        let mut rows: Vec<u32> = (0..self.simplices.len() as u32)
            .filter(|id| self.simplices[*id as usize].born != GONE)
            .collect();
        rows.sort_unstable_by_key(|id| self.simplices[*id as usize].born);
        rows
    }

    fn vertices_of(&self, id: u32) -> &[Vertex] {
        &self.vertices[id as usize * self.corners..][..self.corners]
    }

    /// Vertices made so far.
    pub fn vertices(&self) -> usize {
        self.simplices_at.len()
    }

    /// The ends of an open edge.
    pub fn ends(&self, edge: Edge) -> Ends {
        self.edges[edge.0 as usize].ends
    }

    /// Edges that came up since the last call.
    pub fn take_fresh(&mut self) -> Vec<Edge> {
        std::mem::take(&mut self.fresh)
    }

    /// Vertices that have been left without simplices since the last call: no edge will come to
    /// them.
    pub fn take_closed(&mut self) -> Vec<Vertex> {
        std::mem::take(&mut self.closed)
    }

    /// Hands all open edges out again as fresh ones, and makes the present simplices the roots.
    pub fn renew(&mut self) {
        for (root, id) in self.in_order().into_iter().enumerate() {
            self.simplices[id as usize].root = root as u32;
        }
        self.fresh = (0..self.edges.len() as u32)
            .filter(|e| self.is_open_edge(*e))
            .map(Edge)
            .collect();
        let edges = &self.edges;
        self.fresh
            .sort_unstable_by_key(|e| edges[e.0 as usize].ends);
    }

    fn is_open_edge(&self, row: u32) -> bool {
        let edge = &self.edges[row as usize];
        !edge.settled && !edge.simplices.is_empty()
    }

    /// The first initial simplex that an open edge belongs to.
    pub fn root(&self, edge: Edge) -> u32 {
        let roots = (self.edges[edge.0 as usize].simplices.iter())
            .map(|id| self.simplices[*id as usize].root);
        roots.min().unwrap_or(0)
    }

    /// A row for a simplex.
    fn row(&mut self) -> u32 {
        if let Some(id) = self.free_simplices.pop() {
            return id;
        }
        let id = self.simplices.len();
        self.simplices.push(Simplex {
            born: GONE,
            root: 0,
            unsettled: 0,
        });
        self.vertices.resize((id + 1) * self.corners, 0);
        self.sides.resize((id + 1) * self.pairs.len(), 0);
        id as u32
    }

    /// Gives a simplex its next number, and counts what is unsettled of it.
    fn appear(&mut self, id: u32, root: u32) {
        let sides = &self.sides[id as usize * self.pairs.len()..][..self.pairs.len()];
        let unsettled = (sides.iter())
            .filter(|s| !self.edges[**s as usize].settled)
            .count() as u32;
        self.simplices[id as usize] = Simplex {
            born: self.next_simplex,
            root,
            unsettled,
        };
        self.next_simplex += 1;
    }

    /// Makes an open edge.
    fn open(&mut self, ends: Ends) -> u32 {
        let record = EdgeRecord {
            ends,
            settled: false,
            simplices: SmallVec::new(),
        };
        let row = match self.free_edges.pop() {
            Some(row) => {
                self.edges[row as usize] = record;
                row
            }
            None => {
                self.edges.push(record);
                self.edges.len() as u32 - 1
            }
        };
        self.fresh.push(Edge(row));
        row
    }

    /// The edge between a vertex and the newest one, made where there is none.
    fn spoke(&mut self, vertex: Vertex, newest: Vertex) -> u32 {
        let ends = Ends(vertex, newest);
        let latest = self.latest[vertex as usize];
        if (self.edges.get(latest as usize)).is_some_and(|e| e.ends == ends) {
            return latest;
        }
        let row = self.open(ends);
        self.latest[vertex as usize] = row;
        row
    }

    /// Makes an edge a side of a simplex.
    fn attach(&mut self, id: u32, pair: usize, side: u32) {
        self.sides[id as usize * self.pairs.len() + pair] = side;
        self.edges[side as usize].simplices.push(id);
    }

    /// Marks an open edge as needing no seed between its ends.
    pub fn settle(&mut self, edge: Edge) {
        let record = &mut self.edges[edge.0 as usize];
        record.settled = true;
        let simplices = std::mem::take(&mut record.simplices);
        let mut left = SmallVec::new();
        for id in simplices {
            let simplex = &mut self.simplices[id as usize];
            simplex.unsettled -= 1;
            if simplex.unsettled == 0 {
                self.forget(id);
            } else {
                left.push(id);
            }
        }
        if left.is_empty() {
            self.free_edges.push(edge.0);
        }
        self.edges[edge.0 as usize].simplices = left;
    }

    /// Drops a simplex, all of whose edges are settled, and what nothing else needs.
    fn forget(&mut self, id: u32) {
        self.simplices[id as usize].born = GONE;
        self.free_simplices.push(id);
        for corner in 0..self.corners {
            let vertex = self.vertices[id as usize * self.corners + corner];
            let simplices = &mut self.simplices_at[vertex as usize];
            *simplices -= 1;
            if *simplices == 0 {
                self.closed.push(vertex);
            }
        }
        for k in 0..self.pairs.len() {
            let side = self.sides[id as usize * self.pairs.len() + k];
            let simplices = &mut self.edges[side as usize].simplices;
            if let Some(at) = simplices.iter().position(|s| *s == id) {
                simplices.swap_remove(at);
                if simplices.is_empty() {
                    self.free_edges.push(side);
                }
            }
        }
    }

    /// Splits an open edge at a new vertex, and with it all simplices that have the edge.
    ///
    /// A simplex's own row becomes the half without the edge's first end: whatever the halves have
    /// in common with it stays as it is.
    pub fn split(&mut self, edge: Edge) -> Vertex {
        let ends = self.ends(edge);
        let middle = self.simplices_at.len() as Vertex;
        self.simplices_at.push(0);
        self.latest.push(0);
        let mut simplices = std::mem::take(&mut self.edges[edge.0 as usize].simplices);
        simplices.sort_unstable_by_key(|id| self.simplices[*id as usize].born);
        for id in simplices {
            self.halve(id, ends, middle);
        }
        self.free_edges.push(edge.0);
        middle
    }

    /// Replaces a simplex that has an edge by its two halves.
    fn halve(&mut self, id: u32, ends: Ends, middle: Vertex) {
        let (corners, count) = (self.corners, self.pairs.len());
        let other = self.row();
        let (at, to) = (id as usize, other as usize);
        (self.vertices).copy_within(at * corners..(at + 1) * corners, to * corners);
        let place = |vertices: &[Vertex], end: Vertex| vertices.iter().position(|v| *v == end);
        let (Some(first), Some(second)) = (
            place(self.vertices_of(id), ends.0),
            place(self.vertices_of(id), ends.1),
        ) else {
            // Not reached: these are the simplices of the edge.
            self.free_simplices.push(other);
            return;
        };
        // The half that keeps the second end has the row: edges at the first end go to the other.
        for k in 0..count {
            let (i, j) = self.pairs[k];
            let side = self.sides[at * count + k];
            let is_split = (i, j) == (first.min(second), first.max(second));
            if i == first || j == first {
                let far = self.vertices[at * corners + if i == first { j } else { i }];
                let spoke = self.spoke(far, middle);
                self.attach(id, k, spoke);
                if !is_split {
                    self.hand_over(side, id, other);
                    self.sides[to * count + k] = side;
                }
            } else if i != second && j != second {
                self.attach(other, k, side);
            }
        }
        for corner in 0..corners {
            if corner != first && corner != second {
                let vertex = self.vertices[at * corners + corner];
                self.simplices_at[vertex as usize] += 1;
            }
        }
        self.simplices_at[middle as usize] += 2;
        self.vertices[at * corners + first] = middle;
        self.vertices[to * corners + second] = middle;
        for k in 0..count {
            let (i, j) = self.pairs[k];
            if i == second || j == second {
                let far = self.vertices[to * corners + if i == second { j } else { i }];
                let spoke = self.spoke(far, middle);
                self.attach(other, k, spoke);
            }
        }
        let root = self.simplices[at].root;
        self.appear(id, root);
        self.appear(other, root);
    }

    /// Puts one simplex in another's place at an edge.
    fn hand_over(&mut self, side: u32, from: u32, to: u32) {
        let simplices = &mut self.edges[side as usize].simplices;
        if let Some(at) = simplices.iter().position(|s| *s == from) {
            simplices[at] = to;
        }
    }

    /// Open edges by root simplex, for reports.
    pub fn open_edges(&self) -> usize {
        (0..self.edges.len() as u32)
            .filter(|e| self.is_open_edge(*e))
            .count()
    }
}

/// An edge that waits, with the gap between its ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Wait {
    root: u32,
    /// The gap's bits, falling: gaps are positive, and their bits order as their values.
    falling: u32,
    ends: Ends,
    edge: Edge,
}

impl Wait {
    fn gap(&self) -> f32 {
        f32::from_bits(u32::MAX - self.falling)
    }

    fn key(&self) -> (u32, u32, u32, Ends) {
        // The exponent is the octave.
        let octave = self.falling >> (f32::MANTISSA_DIGITS - 1);
        (octave, self.root, self.falling, self.ends)
    }
}

impl Ord for Wait {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.key().cmp(&other.key())
    }
}

impl PartialOrd for Wait {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

/// Edges waiting for a seed, in the order in which they get one: the widest gaps first, to a factor
/// of two, so that a cap on seeds leaves no part of a front far behind; among alike ones root
/// simplex by root simplex, so that parts settle and can be forgotten.
#[derive(Clone, Debug, Default)]
pub struct Waiting(BinaryHeap<Reverse<Wait>>);

impl Waiting {
    pub fn push(&mut self, root: u32, gap: f32, ends: Ends, edge: Edge) {
        self.0.push(Reverse(Wait {
            root,
            falling: u32::MAX - gap.to_bits(),
            ends,
            edge,
        }));
    }

    pub fn pop(&mut self) -> Option<(Edge, f32)> {
        self.0.pop().map(|Reverse(w)| (w.edge, w.gap()))
    }

    pub fn len(&self) -> usize {
        self.0.len()
    }

    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The widest gap waiting.
    pub fn widest(&self) -> f32 {
        self.0.iter().map(|Reverse(w)| w.gap()).fold(0.0, f32::max)
    }

    /// Leaves so many, the first in order, and gives the others with their gaps.
    pub fn keep(&mut self, count: usize) -> Vec<(Edge, f32)> {
        if count >= self.len() {
            return Vec::new();
        }
        let mut all = std::mem::take(&mut self.0).into_vec();
        // Falling in the order of `Reverse`, so what comes first stands first.
        all.select_nth_unstable_by(count, |a, b| b.cmp(a));
        let dropped = all.split_off(count);
        self.0 = all.into();
        (dropped.into_iter())
            .map(|Reverse(w)| (w.edge, w.gap()))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::random::random;
    use std::collections::HashMap;

    /// Splits everything for some rounds; every (n-2)-face of a closed surface must belong to two
    /// simplices.
    fn closed(n: usize, rounds: usize) {
        let (mut complex, directions) = Complex::sphere(n);
        assert_eq!(directions.len(), complex.vertices());
        for _ in 0..rounds {
            for edge in complex.take_fresh() {
                complex.split(edge);
            }
        }
        let mut faces: HashMap<Vec<Vertex>, u32> = HashMap::new();
        for s in complex.simplices() {
            for skip in 0..s.len() {
                let mut face: Vec<Vertex> = s
                    .iter()
                    .enumerate()
                    .filter(|(i, _)| *i != skip)
                    .map(|(_, v)| *v)
                    .collect();
                face.sort_unstable();
                *faces.entry(face).or_default() += 1;
            }
        }
        assert!(!faces.is_empty());
        assert!(
            faces.values().all(|c| *c == 2),
            "a face is not shared by two simplices"
        );
    }

    #[test]
    fn refinement_keeps_the_sphere_closed() {
        closed(2, 5);
        closed(3, 3);
        closed(4, 2);
    }

    #[test]
    fn settled_parts_are_forgotten() {
        let (mut complex, _) = Complex::sphere(3);
        let edges = complex.take_fresh();
        assert_eq!(edges.len(), 12);
        let middle = complex.split(edges[0]);
        for edge in edges.into_iter().skip(1).chain(complex.take_fresh()) {
            complex.settle(edge);
        }
        assert_eq!(complex.open_edges(), 0);
        assert!(complex.simplices().is_empty());
        assert_eq!(complex.free_edges.len(), complex.edges.len());
        let closed = complex.take_closed();
        assert_eq!(closed.len(), complex.vertices());
        assert!(closed.contains(&middle));
    }

    /// Whatever is split and settled, rows name each other rightly, and nothing is left over.
    #[test]
    fn rows_stay_consistent() {
        for n in 1..=6 {
            let (mut complex, _) = Complex::sphere(n);
            let mut open = complex.take_fresh();
            let mut closed = complex.take_closed();
            for step in 0..400 {
                if open.is_empty() {
                    break;
                }
                let edge = open.swap_remove(random(n as u64, step) as usize % open.len());
                if step % 3 == 0 || step > 200 {
                    complex.settle(edge);
                } else {
                    complex.split(edge);
                }
                open.extend(complex.take_fresh());
                closed.extend(complex.take_closed());
                consistent(&complex, &open, &closed);
            }
        }
    }

    fn consistent(complex: &Complex, open: &[Edge], closed: &[Vertex]) {
        let count = complex.pairs.len();
        let mut lists: FxHashMap<u32, Vec<u32>> = FxHashMap::default();
        let mut at = vec![0; complex.vertices()];
        for id in complex.in_order() {
            let vertices = complex.vertices_of(id);
            let sides = &complex.sides[id as usize * count..][..count];
            let mut unsettled = 0;
            for (side, (i, j)) in sides.iter().zip(&complex.pairs) {
                let edge = &complex.edges[*side as usize];
                assert_eq!(edge.ends, Ends::new(vertices[*i], vertices[*j]));
                unsettled += u32::from(!edge.settled);
                lists.entry(*side).or_default().push(id);
            }
            assert_eq!(complex.simplices[id as usize].unsettled, unsettled);
            assert!(unsettled > 0);
            vertices.iter().for_each(|v| at[*v as usize] += 1);
        }
        assert_eq!(at, complex.simplices_at);
        assert_eq!(at.iter().filter(|n| **n == 0).count(), closed.len());
        for edge in open {
            assert!(lists.contains_key(&edge.0));
        }
        assert_eq!(complex.open_edges(), open.len());
        for (row, edge) in complex.edges.iter().enumerate() {
            let mut listed = edge.simplices.to_vec();
            listed.sort_unstable();
            let mut expected = lists.remove(&(row as u32)).unwrap_or_default();
            expected.sort_unstable();
            assert_eq!(listed, expected);
            assert_eq!(
                complex.free_edges.contains(&(row as u32)),
                expected.is_empty()
            );
        }
    }

    /// The widest come first, to a factor of two, among alike ones by root; and those left out are
    /// the last.
    #[test]
    fn edges_wait_in_order() {
        let gaps = [0.3f32, 1.7, 0.26, 1.1, 0.9, 0.01];
        let waiting = || {
            let mut waiting = Waiting::default();
            for (k, gap) in gaps.iter().enumerate() {
                let k = k as u32;
                waiting.push(9 - k, *gap, Ends(k, k + 1), Edge(k));
            }
            waiting
        };
        let order = |mut waiting: Waiting| -> Vec<u32> {
            std::iter::from_fn(|| waiting.pop())
                .map(|(edge, gap)| {
                    assert_eq!(gap, gaps[edge.0 as usize]);
                    edge.0
                })
                .collect()
        };
        assert_eq!(order(waiting()), [3, 1, 4, 2, 0, 5]);
        let mut fewer = waiting();
        let mut dropped: Vec<u32> = fewer.keep(4).iter().map(|(edge, _)| edge.0).collect();
        dropped.sort_unstable();
        assert_eq!(dropped, [0, 5]);
        assert_eq!(order(fewer), [3, 1, 4, 2]);
    }

    #[test]
    fn the_box_is_triangulated() {
        let (complex, corners) = Complex::unit_box(3);
        assert_eq!((complex.simplices().len(), corners.len()), (6, 8));
        // Volumes of the simplices add up to that of the box.
        let volume: f64 = (complex.simplices().iter())
            .map(|s| {
                let at = |k: usize| nalgebra::Vector3::from_row_slice(&corners[s[k] as usize]);
                nalgebra::Matrix3::from_columns(&[at(1) - at(0), at(2) - at(0), at(3) - at(0)])
                    .determinant()
                    .abs()
                    / 6.0
            })
            .sum();
        assert!((volume - 1.0).abs() < 1e-12);
    }
}
