//! Which seeds of a sweep are neighbours.
//!
//! The triangulation that a sweep refines (`complex`) is known by its edges alone: where it is a flag
//! complex, what surrounds an edge are the vertices that are neighbours of both its ends. Splitting
//! an edge at a new vertex makes the new one a neighbour of the ends and of those around, and parts
//! the ends; the complex stays a flag complex (Lutz & Nevo 2016, on edge subdivisions). In six states
//! a seed has some 40 neighbours, but is a corner of hundreds of simplices.
//!
//! What is settled is forgotten: memory follows the unsettled part, not the number of seeds.

use rustc_hash::FxHashMap;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Index of a vertex, in order of creation.
pub type Vertex = u32;

/// An edge by its ends, the smaller index first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Edge(pub Vertex, pub Vertex);

impl Edge {
    pub fn new(a: Vertex, b: Vertex) -> Self {
        Edge(a.min(b), a.max(b))
    }
}

/// What is known of a vertex.
#[derive(Clone, Debug, Default)]
struct Star {
    /// In ascending order.
    neighbours: Vec<Vertex>,
    /// Edges here that are not settled.
    open: u32,
    /// Neighbours with such edges.
    open_neighbours: u32,
    /// Whether an edge here was given up: it counts as one that waits for ever.
    given_up: bool,
    /// The face of the first triangulation that it lies in.
    face: u32,
}

/// Neighbourhoods with open (not yet settled) edges.
#[derive(Clone, Debug, Default)]
pub struct Neighbours {
    stars: Vec<Star>,
    faces: Faces,
    /// Edges that have come up since they were last asked for.
    fresh: Vec<Edge>,
    /// Vertices that nothing is to be compared with, since they were last asked for.
    closed: Vec<Vertex>,
    /// Those that nothing will be near, likewise.
    forgotten: Vec<Vertex>,
    /// Memory for what surrounds an edge.
    around: Vec<Vertex>,
}

impl Neighbours {
    /// Those of a flag complex of so many vertices.
    pub fn new(vertices: usize, simplices: &[Vec<Vertex>]) -> Self {
        let mut this = Self {
            faces: Faces::new(vertices, simplices),
            ..Self::default()
        };
        for face in 0..vertices as u32 {
            this.stars.push(Star {
                face,
                ..Star::default()
            });
        }
        let mut edges: Vec<Edge> = (simplices.iter())
            .flat_map(|s| {
                let ends = |(i, a): (usize, &Vertex)| {
                    let a = *a;
                    s[i + 1..].iter().map(move |b| Edge::new(a, *b))
                };
                s.iter().enumerate().flat_map(ends)
            })
            .collect();
        edges.sort_unstable();
        edges.dedup();
        for Edge(a, b) in &edges {
            for (from, to) in [(*a, *b), (*b, *a)] {
                let star = &mut this.stars[from as usize];
                star.neighbours.push(to);
                star.open += 1;
                star.open_neighbours += 1;
            }
        }
        for star in &mut this.stars {
            star.neighbours.sort_unstable();
        }
        this.fresh = edges;
        this
    }

    /// Edges that came up since the last call.
    pub fn take_fresh(&mut self) -> Vec<Edge> {
        std::mem::take(&mut self.fresh)
    }

    /// Vertices whose last open edge was settled since the last call, and that got no other since;
    /// of those with an edge that was given up, these that nothing will be near.
    pub fn take_closed(&mut self) -> Vec<Vertex> {
        let mut closed = std::mem::take(&mut self.closed);
        closed.retain(|v| self.stars[*v as usize].open == 0);
        closed
    }

    /// Vertices that no open edge is at or around any more, since the last call.
    pub fn take_forgotten(&mut self) -> Vec<Vertex> {
        std::mem::take(&mut self.forgotten)
    }

    /// The first simplex of the first triangulation that an edge lies in.
    pub fn root(&self, edge: Edge) -> u32 {
        let face = |v: Vertex| self.stars[v as usize].face;
        self.faces.root(face(edge.0), face(edge.1))
    }

    /// Marks an open edge as needing no seed between its ends.
    pub fn settle(&mut self, edge: Edge) {
        self.close(edge.0);
        self.close(edge.1);
    }

    /// Leaves an open edge, which will get no seed, as it is.
    pub fn give_up(&mut self, edge: Edge) {
        for end in [edge.0, edge.1] {
            self.stars[end as usize].given_up = true;
        }
        self.settle(edge);
    }

    /// One open edge less at a vertex.
    fn close(&mut self, vertex: Vertex) {
        let star = &mut self.stars[vertex as usize];
        star.open -= 1;
        if star.open > 0 {
            return;
        }
        if !star.given_up {
            self.closed.push(vertex);
        }
        let mut done = std::mem::take(&mut self.around);
        done.clear();
        if self.stars[vertex as usize].open_neighbours == 0 {
            done.push(vertex);
        }
        for k in 0..self.stars[vertex as usize].neighbours.len() {
            let v = self.stars[vertex as usize].neighbours[k];
            let other = &mut self.stars[v as usize];
            other.open_neighbours -= 1;
            if other.open_neighbours == 0 && other.open == 0 {
                done.push(v);
            }
        }
        for v in &done {
            self.forget(*v);
        }
        self.around = done;
    }

    /// Drops a vertex that no open edge is at or around.
    fn forget(&mut self, vertex: Vertex) {
        if self.stars[vertex as usize].given_up {
            self.closed.push(vertex);
        }
        for n in std::mem::take(&mut self.stars[vertex as usize].neighbours) {
            let star = &mut self.stars[n as usize];
            if let Some(at) = star.find(vertex) {
                star.neighbours.remove(at);
            }
        }
        self.forgotten.push(vertex);
    }

    /// Puts the common neighbours of an edge's ends into a list.
    pub fn around(&self, Edge(a, b): Edge, to: &mut Vec<Vertex>) {
        to.clear();
        let of = |v: Vertex| &self.stars[v as usize].neighbours;
        common(of(a), of(b), to);
    }

    /// Splits an open edge at a new vertex.
    pub fn split(&mut self, edge: Edge) -> Vertex {
        let Edge(a, b) = edge;
        let middle = self.stars.len() as Vertex;
        let mut around = std::mem::take(&mut self.around);
        self.around(edge, &mut around);

        // Each end has the new vertex as a neighbour in the other's place: as many open ones.
        for (from, to) in [(a, b), (b, a)] {
            let star = &mut self.stars[from as usize];
            if let Some(at) = star.find(to) {
                star.neighbours.remove(at);
            }
            star.neighbours.push(middle);
        }
        for c in &around {
            if self.stars[*c as usize].open == 0 {
                self.reopen(*c);
            }
            let star = &mut self.stars[*c as usize];
            star.open += 1;
            star.open_neighbours += 1;
            star.neighbours.push(middle);
        }

        around.extend([a, b]);
        around.sort_unstable();
        (self.fresh).extend(around.iter().map(|v| Edge(*v, middle)));
        let face = |v: Vertex| self.stars[v as usize].face;
        let face = self.faces.join(face(a), face(b));
        self.stars.push(Star {
            neighbours: around.clone(),
            open: around.len() as u32,
            open_neighbours: around.len() as u32,
            given_up: false,
            face,
        });
        self.around = around;
        middle
    }

    /// Tells its neighbours that a vertex will have an open edge again.
    fn reopen(&mut self, vertex: Vertex) {
        for k in 0..self.stars[vertex as usize].neighbours.len() {
            let v = self.stars[vertex as usize].neighbours[k];
            self.stars[v as usize].open_neighbours += 1;
        }
    }
}

impl Star {
    /// Where a neighbour is in the list.
    fn find(&self, vertex: Vertex) -> Option<usize> {
        self.neighbours.binary_search(&vertex).ok()
    }
}

/// The vertices in both of two ascending lists.
fn common(a: &[Vertex], b: &[Vertex], to: &mut Vec<Vertex>) {
    let (mut i, mut j) = (0, 0);
    while i < a.len() && j < b.len() {
        let (x, y) = (a[i], b[j]);
        if x == y {
            to.push(x);
        }
        i += usize::from(x <= y);
        j += usize::from(y <= x);
    }
}

/// Faces of the first triangulation, each by the simplices that have it.
#[derive(Clone, Debug, Default)]
struct Faces {
    /// By face, in ascending order; those of the vertices first.
    simplices: Vec<Vec<u32>>,
    joins: FxHashMap<(u32, u32), u32>,
}

impl Faces {
    fn new(vertices: usize, simplices: &[Vec<Vertex>]) -> Self {
        let mut of = vec![Vec::new(); vertices];
        for (root, vertices) in simplices.iter().enumerate() {
            for v in vertices {
                of[*v as usize].push(root as u32);
            }
        }
        Self {
            simplices: of,
            joins: FxHashMap::default(),
        }
    }

    /// The simplices that have both of two faces, in ascending order.
    fn of_both(&self, a: u32, b: u32) -> impl Iterator<Item = u32> {
        let (a, mut b) = (&self.simplices[a as usize], &self.simplices[b as usize][..]);
        a.iter().copied().filter(move |x| {
            while b.first().is_some_and(|y| y < x) {
                b = &b[1..];
            }
            b.first() == Some(x)
        })
    }

    /// The first simplex that has both of two faces.
    fn root(&self, a: u32, b: u32) -> u32 {
        self.of_both(a, b).next().unwrap_or(0)
    }

    /// The smallest face that two faces lie in.
    fn join(&mut self, a: u32, b: u32) -> u32 {
        if a == b {
            return a;
        }
        let key = (a.min(b), a.max(b));
        if let Some(face) = self.joins.get(&key) {
            return *face;
        }
        let both: Vec<u32> = self.of_both(a, b).collect();
        let face = if both == self.simplices[a as usize] {
            a
        } else if both == self.simplices[b as usize] {
            b
        } else {
            self.simplices.push(both);
            self.simplices.len() as u32 - 1
        };
        self.joins.insert(key, face);
        face
    }
}

/// An edge that waits, with the gap between its ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Wait {
    root: u32,
    /// The gap's bits, falling: gaps are positive, and their bits order as their values.
    falling: u32,
    edge: Edge,
}

impl Wait {
    fn gap(&self) -> f32 {
        f32::from_bits(u32::MAX - self.falling)
    }

    fn key(&self) -> (u32, u32, u32, Edge) {
        // The exponent is the octave.
        let octave = self.falling >> (f32::MANTISSA_DIGITS - 1);
        (octave, self.root, self.falling, self.edge)
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
    pub fn push(&mut self, root: u32, gap: f32, edge: Edge) {
        self.0.push(Reverse(Wait {
            root,
            falling: u32::MAX - gap.to_bits(),
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
    use crate::sweep::complex::Complex;
    use std::collections::BTreeSet;

    /// Whatever is split, and whatever is settled and forgotten meanwhile, the neighbours are those
    /// of the simplicial complex, with its roots.
    #[test]
    fn neighbours_are_those_of_the_complex() {
        for (n, splits) in [(1, 0), (2, 200), (3, 200), (4, 150), (5, 80), (6, 60)] {
            let complexes = [Complex::sphere(n), Complex::unit_box(n.min(4))];
            for (kind, (mut complex, _)) in complexes.into_iter().enumerate() {
                complex.take_fresh();
                let first = complex.simplices();
                let mut neighbours = Neighbours::new(complex.vertices(), &first);
                let mut roots: Vec<BTreeSet<u32>> = vec![BTreeSet::new(); complex.vertices()];
                for (root, simplex) in first.iter().enumerate() {
                    for v in simplex {
                        roots[*v as usize].insert(root as u32);
                    }
                }
                let mut open = neighbours.take_fresh();
                let mut forgotten = BTreeSet::new();
                for step in 0..splits {
                    if open.is_empty() {
                        break;
                    }
                    let draw = random((n + 10 * kind) as u64, step) as usize;
                    let edge = open.swap_remove(draw % open.len());
                    if step % 3 == 2 {
                        neighbours.settle(edge);
                    } else {
                        assert_eq!(neighbours.split(edge), complex.split(edge));
                        let both = &roots[edge.0 as usize] & &roots[edge.1 as usize];
                        roots.push(both);
                    }
                    open.extend(neighbours.take_fresh());
                    forgotten.extend(neighbours.take_forgotten());
                    compare(&neighbours, &complex, &open, &forgotten);
                    for edge in &open {
                        let mut both = roots[edge.0 as usize].intersection(&roots[edge.1 as usize]);
                        assert_eq!(Some(&neighbours.root(*edge)), both.next());
                    }
                }
                // At last nothing is left.
                for edge in open {
                    neighbours.settle(edge);
                }
                forgotten.extend(neighbours.take_forgotten());
                let alone = if n == 1 && kind == 0 { 2 } else { 0 };
                assert_eq!(forgotten.len() + alone, neighbours.stars.len());
            }
        }
    }

    fn compare(
        neighbours: &Neighbours,
        complex: &Complex,
        open: &[Edge],
        forgotten: &BTreeSet<Vertex>,
    ) {
        let mut expected: BTreeSet<Edge> = BTreeSet::new();
        for simplex in complex.simplices() {
            for (i, a) in simplex.iter().enumerate() {
                expected.extend(simplex[i + 1..].iter().map(|b| Edge::new(*a, *b)));
            }
        }
        expected.retain(|e| !forgotten.contains(&e.0) && !forgotten.contains(&e.1));
        let mut found = BTreeSet::new();
        for (v, star) in neighbours.stars.iter().enumerate() {
            let v = v as Vertex;
            assert!(star.neighbours.is_sorted());
            let here = open.iter().filter(|e| e.0 == v || e.1 == v);
            assert_eq!(here.count() as u32, star.open);
            let open = |n: &&Vertex| neighbours.stars[**n as usize].open > 0;
            let count = star.neighbours.iter().filter(open).count() as u32;
            assert_eq!(count, star.open_neighbours);
            if !forgotten.contains(&v) {
                assert!(star.open + star.open_neighbours > 0);
            }
            found.extend(star.neighbours.iter().map(|n| Edge::new(v, *n)));
        }
        assert_eq!(found, expected);
    }

    /// What was given up waits for ever: new neighbours of its ends are still compared with them.
    #[test]
    fn vertices_of_given_up_edges_stay() {
        let (complex, _) = Complex::sphere(3);
        let mut neighbours = Neighbours::new(complex.vertices(), &complex.simplices());
        let mut open = neighbours.take_fresh();
        let last = open.pop().expect("an octahedron has edges");
        neighbours.give_up(open[0]);
        open[1..].iter().for_each(|edge| neighbours.settle(*edge));
        let given_up = [open[0].0, open[0].1];
        let closed = neighbours.take_closed();
        assert!(closed.iter().all(|v| !given_up.contains(v)));
        assert!(!closed.contains(&last.0) && !closed.contains(&last.1));
        neighbours.settle(last);
        let mut all = [closed, neighbours.take_closed()].concat();
        all.sort_unstable();
        assert_eq!(all, [0, 1, 2, 3, 4, 5]);
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
                waiting.push(9 - k, *gap, Edge(k, k + 1));
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
}
