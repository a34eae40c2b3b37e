//! The seeds' neighbourhoods: a simplicial complex refined by splitting edges.
//!
//! For an infinite horizon it triangulates the sphere of directions (two states: a closed curve);
//! for a finite horizon the box of terminal states. Splitting an edge splits every simplex that has
//! it, so neighbours always match. What is settled is forgotten: memory follows the unsettled part,
//! not the number of seeds.

use std::collections::{BTreeMap, HashMap};

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

#[derive(Clone, Debug, Default)]
struct EdgeRecord {
    simplices: Vec<u32>,
    settled: bool,
}

#[derive(Clone, Debug)]
struct Simplex {
    vertices: Vec<Vertex>,
    /// The initial simplex it comes from: work goes from one to the next, so that few are open at a
    /// time.
    root: u32,
    unsettled: u32,
}

/// A simplicial complex with open (not yet settled) edges.
#[derive(Clone, Debug, Default)]
pub struct Complex {
    simplices: HashMap<u32, Simplex>,
    edges: HashMap<Edge, EdgeRecord>,
    next_simplex: u32,
    next_vertex: Vertex,
    /// Open edges at each vertex; at none, what is kept for the vertex can be dropped.
    open_at: HashMap<Vertex, u32>,
    /// Edges that have come up since they were last asked for.
    fresh: Vec<Edge>,
}

impl Complex {
    /// A complex of the given simplices over vertices `0..vertices`.
    pub fn new(vertices: usize, simplices: &[Vec<Vertex>]) -> Self {
        let mut this = Self {
            next_vertex: vertices as Vertex,
            ..Self::default()
        };
        for (root, vertices) in simplices.iter().enumerate() {
            this.add(vertices.clone(), root as u32);
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
        let mut all: Vec<(&u32, &Simplex)> = self.simplices.iter().collect();
        all.sort_by_key(|(id, _)| **id);
        all.into_iter().map(|(_, s)| s.vertices.clone()).collect()
    }

    /// Vertices made so far.
    pub fn vertices(&self) -> usize {
        self.next_vertex as usize
    }

    /// Edges that came up since the last call.
    pub fn take_fresh(&mut self) -> Vec<Edge> {
        let mut fresh = std::mem::take(&mut self.fresh);
        fresh.retain(|e| self.edges.get(e).is_some_and(|r| !r.settled));
        fresh
    }

    /// Hands all open edges out again as fresh ones, and makes the present simplices the roots.
    pub fn renew(&mut self) {
        let mut ids: Vec<u32> = self.simplices.keys().copied().collect();
        ids.sort_unstable();
        for id in ids {
            if let Some(s) = self.simplices.get_mut(&id) {
                s.root = id;
            }
        }
        self.fresh = self
            .edges
            .iter()
            .filter(|(_, r)| !r.settled)
            .map(|(e, _)| *e)
            .collect();
        self.fresh.sort_unstable();
    }

    /// The first initial simplex that an open edge belongs to.
    pub fn root(&self, edge: Edge) -> Option<u32> {
        self.edges
            .get(&edge)?
            .simplices
            .iter()
            .filter_map(|s| self.simplices.get(s))
            .map(|s| s.root)
            .min()
    }

    /// Whether a vertex still has open edges.
    pub fn is_open(&self, vertex: Vertex) -> bool {
        self.open_at.contains_key(&vertex)
    }

    fn edges_of(vertices: &[Vertex]) -> impl Iterator<Item = Edge> + '_ {
        vertices
            .iter()
            .enumerate()
            .flat_map(move |(i, a)| vertices[i + 1..].iter().map(move |b| Edge::new(*a, *b)))
    }

    fn add(&mut self, vertices: Vec<Vertex>, root: u32) {
        let id = self.next_simplex;
        self.next_simplex += 1;
        let mut unsettled = 0;
        for edge in Self::edges_of(&vertices) {
            let record = self.edges.entry(edge).or_insert_with(|| {
                self.fresh.push(edge);
                *self.open_at.entry(edge.0).or_default() += 1;
                *self.open_at.entry(edge.1).or_default() += 1;
                EdgeRecord::default()
            });
            record.simplices.push(id);
            unsettled += u32::from(!record.settled);
        }
        self.simplices.insert(
            id,
            Simplex {
                vertices,
                root,
                unsettled,
            },
        );
        // A point has no edges and is settled as it is.
        self.drop_settled(id);
    }

    /// Marks an edge as needing no seed between its ends.
    pub fn settle(&mut self, edge: Edge) {
        let Some(record) = self.edges.get_mut(&edge).filter(|r| !r.settled) else {
            return;
        };
        record.settled = true;
        let simplices = record.simplices.clone();
        self.close(edge);
        for id in simplices {
            if let Some(s) = self.simplices.get_mut(&id) {
                s.unsettled -= 1;
            }
            self.drop_settled(id);
        }
    }

    fn close(&mut self, edge: Edge) {
        for v in [edge.0, edge.1] {
            if let Some(n) = self.open_at.get_mut(&v) {
                *n -= 1;
                if *n == 0 {
                    self.open_at.remove(&v);
                }
            }
        }
    }

    fn drop_settled(&mut self, id: u32) {
        if self.simplices.get(&id).is_some_and(|s| s.unsettled == 0) {
            self.remove(id);
        }
    }

    fn remove(&mut self, id: u32) -> Option<Simplex> {
        let simplex = self.simplices.remove(&id)?;
        for edge in Self::edges_of(&simplex.vertices) {
            if let Some(record) = self.edges.get_mut(&edge) {
                record.simplices.retain(|s| *s != id);
                if record.simplices.is_empty() && record.settled {
                    self.edges.remove(&edge);
                }
            }
        }
        Some(simplex)
    }

    /// Splits an open edge at a new vertex, and with it all simplices that have the edge.
    pub fn split(&mut self, edge: Edge) -> Option<Vertex> {
        let record = self.edges.get(&edge).filter(|r| !r.settled)?;
        let simplices = record.simplices.clone();
        let middle = self.next_vertex;
        self.next_vertex += 1;
        for id in simplices {
            // The halves come first, so that edges they share with the old simplex are never
            // without one.
            let Some(old) = self.simplices.get(&id).cloned() else {
                continue;
            };
            for end in [edge.0, edge.1] {
                let half = old
                    .vertices
                    .iter()
                    .map(|v| if *v == end { middle } else { *v })
                    .collect();
                self.add(half, old.root);
            }
            self.remove(id);
        }
        self.edges.remove(&edge);
        self.close(edge);
        Some(middle)
    }

    /// Open edges by root simplex, for reports.
    pub fn open_edges(&self) -> usize {
        self.edges.values().filter(|r| !r.settled).count()
    }
}

/// Edges waiting for a seed, in the order in which they get one: the widest gaps first, to a factor
/// of two, so that a cap on seeds leaves no part of a front far behind; among alike ones root
/// simplex by root simplex, so that parts settle and can be forgotten.
#[derive(Clone, Debug, Default)]
pub struct Waiting(BTreeMap<(u32, u32, u32, Edge), f32>);

impl Waiting {
    pub fn push(&mut self, root: u32, gap: f32, edge: Edge) {
        // Gaps are positive: their bits order like their values, and the exponent is the octave.
        let falling = u32::MAX - gap.to_bits();
        let octave = falling >> (f32::MANTISSA_DIGITS - 1);
        self.0.insert((octave, root, falling, edge), gap);
    }

    pub fn pop(&mut self) -> Option<(Edge, f32)> {
        self.0.pop_first().map(|((_, _, _, edge), gap)| (edge, gap))
    }

    pub fn len(&self) -> usize {
        self.0.len()
    }

    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The widest gap waiting.
    pub fn widest(&self) -> f32 {
        self.0.values().copied().fold(0.0, f32::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        for s in complex.simplices.values() {
            for skip in 0..s.vertices.len() {
                let mut face: Vec<Vertex> = s
                    .vertices
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
        let middle = complex.split(edges[0]).unwrap();
        for edge in edges.into_iter().skip(1).chain(complex.take_fresh()) {
            complex.settle(edge);
        }
        assert_eq!(
            (
                complex.open_edges(),
                complex.simplices.len(),
                complex.edges.len()
            ),
            (0, 0, 0)
        );
        assert!(!complex.is_open(middle));
    }

    #[test]
    fn the_box_is_triangulated() {
        let (complex, corners) = Complex::unit_box(3);
        assert_eq!((complex.simplices.len(), corners.len()), (6, 8));
        // Volumes of the simplices add up to that of the box.
        let volume: f64 = complex
            .simplices
            .values()
            .map(|s| {
                let at =
                    |k: usize| nalgebra::Vector3::from_row_slice(&corners[s.vertices[k] as usize]);
                nalgebra::Matrix3::from_columns(&[at(1) - at(0), at(2) - at(0), at(3) - at(0)])
                    .determinant()
                    .abs()
                    / 6.0
            })
            .sum();
        assert!((volume - 1.0).abs() < 1e-12);
    }
}
