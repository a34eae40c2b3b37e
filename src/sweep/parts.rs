//! Parts of the surface of seeds: cells of simplices of the first triangulation that lie together.
//!
//! What becomes of a simplex does not depend on the others (`neighbours`), so parts that are swept
//! apart have the same seeds as the whole. Those where parts meet belong to one of them; the others
//! sweep them too, to compare what is theirs with it.

use super::neighbours::Vertex;

/// Cells of the surface that a part has.
const CELLS: usize = 8;

/// One of so many parts, counted from 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SurfacePart {
    pub part: usize,
    pub parts: usize,
}

impl SurfacePart {
    /// The whole surface.
    pub const WHOLE: Self = Self { part: 0, parts: 1 };
}

/// What is swept of a first triangulation.
#[derive(Clone, Debug)]
pub struct First {
    /// Its simplices by their vertices, counted here.
    pub simplices: Vec<Vec<Vertex>>,
    /// By vertex: its number in the whole, ascending.
    pub vertices: Vec<Vertex>,
    /// By vertex: the simplices of the whole that have it, in ascending order.
    pub roots: Vec<Vec<u32>>,
    /// By simplex of the whole: whether it is swept here.
    pub is_swept: Vec<bool>,
}

impl First {
    /// A part of a triangulation whose vertices have these parameters.
    pub fn new(simplices: &[Vec<Vertex>], parameters: &[Vec<f64>], part: SurfacePart) -> Self {
        let is_swept = swept(simplices, parameters, part);
        let mut roots = vec![Vec::new(); parameters.len()];
        for (root, simplex) in simplices.iter().enumerate() {
            for v in simplex {
                roots[*v as usize].push(root as u32);
            }
        }
        let is_here = |v: &usize| roots[*v].iter().any(|root| is_swept[*root as usize]);
        let vertices: Vec<Vertex> = (0..parameters.len())
            .filter(is_here)
            .map(|v| v as Vertex)
            .collect();
        let here = |v: &Vertex| vertices.partition_point(|other| other < v) as Vertex;
        Self {
            simplices: (simplices.iter().zip(&is_swept))
                .filter(|(_, swept)| **swept)
                .map(|(simplex, _)| simplex.iter().map(here).collect())
                .collect(),
            roots: (vertices.iter())
                .map(|v| std::mem::take(&mut roots[*v as usize]))
                .collect(),
            vertices,
            is_swept,
        }
    }
}

/// Which simplices are in a part. They are halved again and again by where their centres are, along
/// the coordinate in which these differ most, to cells of equally many; each part has several, from
/// all over the surface, for what a simplex takes differs much from place to place.
fn swept(simplices: &[Vec<Vertex>], parameters: &[Vec<f64>], part: SurfacePart) -> Vec<bool> {
    if part == SurfacePart::WHOLE {
        return vec![true; simplices.len()];
    }
    let width = parameters.first().map_or(0, Vec::len);
    let centre = |simplex: &Vec<Vertex>| -> Vec<f64> {
        (0..width)
            .map(|k| (simplex.iter().map(|v| parameters[*v as usize][k])).sum())
            .collect()
    };
    let centres: Vec<Vec<f64>> = simplices.iter().map(centre).collect();
    let mut is_in = vec![false; simplices.len()];
    let mut open = vec![(
        (0..simplices.len()).collect::<Vec<_>>(),
        0,
        CELLS * part.parts,
    )];
    while let Some((mut some, first, cells)) = open.pop() {
        // Cells from `first` on, of which the part has every so many-th one.
        if cells == 1 {
            let own = first % part.parts == part.part;
            some.into_iter().for_each(|s| is_in[s] = own);
            continue;
        }
        let extent = |k: &usize| {
            let values = some.iter().map(|s| centres[*s][*k]);
            let (lo, hi) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), x| {
                (x.min(lo), x.max(hi))
            });
            hi - lo
        };
        let axis = (0..width).max_by(|a, b| extent(a).total_cmp(&extent(b)).then(b.cmp(a)));
        let along = axis.unwrap_or(0);
        some.sort_by(|a, b| {
            let at = |s: &usize| centres[*s][along];
            at(a).total_cmp(&at(b)).then(a.cmp(b))
        });
        let half = cells / 2;
        let cut = (some.len() as u128 * half as u128 / cells as u128) as usize;
        let rest = some.split_off(cut);
        open.extend([(some, first, half), (rest, first + half, cells - half)]);
    }
    is_in
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sweep::complex::Complex;

    /// Whatever the number of parts, each simplex is in one of them, and parts are alike in size.
    #[test]
    fn parts_make_the_whole() {
        for (complex, parameters) in [
            Complex::sphere(1),
            Complex::sphere(2),
            Complex::sphere(5),
            Complex::unit_box(4),
        ] {
            let simplices = complex.simplices();
            for parts in [1, 2, 3, 7, 40] {
                let mut times = vec![0; simplices.len()];
                for part in 0..parts {
                    let part = SurfacePart { part, parts };
                    let first = First::new(&simplices, &parameters, part);
                    let count = first.simplices.len();
                    let even = simplices.len() as f64 / parts as f64;
                    assert!((count as f64 - even).abs() < 9.0, "{count} of {even}");
                    let swept = (0..simplices.len()).filter(|k| first.is_swept[*k]);
                    for (here, root) in first.simplices.iter().zip(swept) {
                        times[root] += 1;
                        let named = here.iter().map(|v| first.vertices[*v as usize]);
                        assert!(named.eq(simplices[root].iter().copied()));
                    }
                }
                assert!(times.iter().all(|times| *times == 1), "{times:?}");
            }
        }
    }
}
