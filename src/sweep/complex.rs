//! The first seeds' neighbourhoods: a simplicial complex refined by splitting edges.
//!
//! For an infinite horizon it triangulates the sphere of directions (two states: a closed curve);
//! for a finite horizon the box of terminal states. Splitting an edge splits every simplex that has
//! it, so neighbours always match. The complex is a flag complex, whose simplices are all sets of
//! mutual neighbours: the cross-polytope's boundary and Kuhn's triangulation are, and stay so when
//! an edge is split. So a sweep, which refines it a thousand times further, knows it by its edges
//! alone (`neighbours`).

use super::neighbours::{Edge, Vertex};
use rustc_hash::FxHashMap;

/// A simplicial complex.
#[derive(Clone, Debug, Default)]
pub struct Complex {
    /// By their vertices, in order of creation; those split are left behind, without any.
    simplices: Vec<Vec<Vertex>>,
    /// The simplices of each edge, in order of creation.
    edges: FxHashMap<Edge, Vec<usize>>,
    next_vertex: Vertex,
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
        for vertices in simplices {
            this.add(vertices.clone());
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
        let left = self.simplices.iter().filter(|s| !s.is_empty());
        left.cloned().collect()
    }

    /// Vertices made so far.
    #[cfg(test)]
    pub fn vertices(&self) -> usize {
        self.next_vertex as usize
    }

    /// Edges that came up since the last call, and were not split.
    pub fn take_fresh(&mut self) -> Vec<Edge> {
        let mut fresh = std::mem::take(&mut self.fresh);
        fresh.retain(|e| self.edges.contains_key(e));
        fresh
    }

    fn edges_of(vertices: &[Vertex]) -> impl Iterator<Item = Edge> + '_ {
        (vertices.iter().enumerate())
            .flat_map(move |(i, a)| vertices[i + 1..].iter().map(move |b| Edge::new(*a, *b)))
    }

    fn add(&mut self, vertices: Vec<Vertex>) {
        let id = self.simplices.len();
        for edge in Self::edges_of(&vertices) {
            let simplices = self.edges.entry(edge).or_insert_with(|| {
                self.fresh.push(edge);
                Vec::new()
            });
            simplices.push(id);
        }
        self.simplices.push(vertices);
    }

    /// Splits an edge at a new vertex, and with it all simplices that have the edge.
    pub fn split(&mut self, edge: Edge) -> Vertex {
        let middle = self.next_vertex;
        self.next_vertex += 1;
        for id in self.edges.remove(&edge).unwrap_or_default() {
            let old = std::mem::take(&mut self.simplices[id]);
            for side in Self::edges_of(&old) {
                if let Some(simplices) = self.edges.get_mut(&side) {
                    simplices.retain(|s| *s != id);
                }
            }
            for end in [edge.0, edge.1] {
                let half = old.iter().map(|v| if *v == end { middle } else { *v });
                self.add(half.collect());
            }
        }
        middle
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
        let mut faces: FxHashMap<Vec<Vertex>, u32> = FxHashMap::default();
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
