//! The nearest of many points: by an R-tree, or in many dimensions by looking at all.

use rstar::{AABB, PointDistance, RTree, RTreeObject};

/// Points of up to this many coordinates are searched by a tree.
pub const MOST_DIMENSIONS: usize = 10;

/// Points that can be asked for the ones nearest to a place.
pub trait Nearest: Send + Sync {
    /// Indices and distances of points by rising distance (equal ones by index): at most `most`,
    /// and none but the first further than `within`.
    fn near(&self, place: &[f64], within: f64, most: usize) -> Vec<(usize, f64)>;
}

struct Entry<const N: usize> {
    at: [f64; N],
    index: usize,
}

impl<const N: usize> RTreeObject for Entry<N> {
    type Envelope = AABB<[f64; N]>;

    fn envelope(&self) -> Self::Envelope {
        AABB::from_point(self.at)
    }
}

impl<const N: usize> PointDistance for Entry<N> {
    fn distance_2(&self, place: &[f64; N]) -> f64 {
        self.at
            .iter()
            .zip(place)
            .map(|(x, y)| (x - y).powi(2))
            .sum()
    }
}

struct Tree<const N: usize>(RTree<Entry<N>>);

fn padded<const N: usize>(point: &[f64]) -> [f64; N] {
    std::array::from_fn(|i| point.get(i).copied().unwrap_or(0.0))
}

impl<const N: usize> Nearest for Tree<N> {
    fn near(&self, place: &[f64], within: f64, most: usize) -> Vec<(usize, f64)> {
        let mut found: Vec<(usize, f64)> = Vec::new();
        for (entry, square) in self.0.nearest_neighbor_iter_with_distance_2(padded(place)) {
            let distance = square.sqrt();
            // Equal distances come in any order: one more than asked for settles who is among the
            // last.
            let full = found.len() >= most && found.last().is_some_and(|(_, d)| distance > *d);
            let outside = distance > within && found.last().is_some_and(|(_, d)| distance > *d);
            if full || outside {
                break;
            }
            found.push((entry.index, distance));
        }
        found.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        found.truncate(most);
        let inside = found
            .iter()
            .filter(|(_, distance)| *distance <= within)
            .count();
        found.truncate(inside.max(1));
        found
    }
}

/// Points that are all looked at: in more dimensions than the trees are made for, where they would
/// save little.
struct All {
    /// `[point][dimensions]`.
    points: Vec<f64>,
    dimensions: usize,
}

impl Nearest for All {
    fn near(&self, place: &[f64], within: f64, most: usize) -> Vec<(usize, f64)> {
        let square = |p: &[f64]| {
            p.iter()
                .zip(place)
                .map(|(x, y)| (x - y).powi(2))
                .sum::<f64>()
        };
        let distances = self
            .points
            .chunks(self.dimensions)
            .map(|p| square(p).sqrt());
        let mut found: Vec<(usize, f64)> = distances.enumerate().collect();
        found.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        let inside = found
            .iter()
            .take(most)
            .filter(|(_, distance)| *distance <= within)
            .count();
        found.truncate(inside.max(1));
        found
    }
}

/// An index over points of `dimensions` coordinates, `[point][dimensions]`.
pub fn index(points: &[f64], dimensions: usize) -> Box<dyn Nearest> {
    fn tree<const N: usize>(points: &[f64], dimensions: usize) -> Box<dyn Nearest> {
        let all = points.chunks(dimensions).enumerate();
        let entries = all.map(|(index, p)| Entry::<N> {
            at: padded(p),
            index,
        });
        Box::new(Tree(RTree::bulk_load(entries.collect())))
    }
    match dimensions {
        // A tree has at least two dimensions.
        1 | 2 => tree::<2>(points, dimensions),
        3 => tree::<3>(points, dimensions),
        4 => tree::<4>(points, dimensions),
        5 => tree::<5>(points, dimensions),
        6 => tree::<6>(points, dimensions),
        7 => tree::<7>(points, dimensions),
        8 => tree::<8>(points, dimensions),
        9 => tree::<9>(points, dimensions),
        10 => tree::<10>(points, dimensions),
        _ => Box::new(All {
            points: points.to_vec(),
            dimensions,
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn agrees_with_looking_at_all_points() {
        for n in [1, 2, 3, 5, 10, 11, 14] {
            let points: Vec<f64> = (0..300 * n)
                .map(|k| ((k * k) as f64 * 0.618).fract())
                .collect();
            let tree = index(&points, n);
            for q in 0..20 {
                let place: Vec<f64> = (0..n)
                    .map(|i| ((q * 7 + i) as f64 * 0.417).fract())
                    .collect();
                let mut all: Vec<(usize, f64)> = points
                    .chunks(n)
                    .map(|p| {
                        p.iter()
                            .zip(&place)
                            .map(|(x, y)| (x - y).powi(2))
                            .sum::<f64>()
                            .sqrt()
                    })
                    .enumerate()
                    .collect();
                all.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
                let found = tree.near(&place, 0.2, 8);
                let expected: Vec<_> = (all.iter().take(8).enumerate())
                    .filter(|(k, (_, d))| *k == 0 || *d <= 0.2)
                    .map(|(_, x)| *x)
                    .collect();
                assert_eq!(
                    found.iter().map(|f| f.0).collect::<Vec<_>>(),
                    expected.iter().map(|f| f.0).collect::<Vec<_>>(),
                    "{n} dimensions, place {q}"
                );
            }
        }
    }
}
