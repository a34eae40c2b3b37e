//! The nearest of many points: by a tree of boxes, or in many dimensions by looking at all.
//!
//! The tree is made once and asked for tens of points at a time, thousands of times a second, by the
//! value map: what is looked at lies in rows. (An R-tree of a library, whose iterator keeps all
//! boxes that it has seen in a heap, takes several times as long.)

/// Points of up to this many coordinates are searched by a tree.
pub const MOST_DIMENSIONS: usize = 10;
/// Points of a box that is not divided.
const LEAF: usize = 12;

/// Points that can be asked for the ones nearest to a place.
pub trait Nearest: Send + Sync {
    /// Indices and distances of points by rising distance (equal ones by index): at most `most`,
    /// and none but the first further than `within`.
    fn near(&self, place: &[f64], within: f64, most: usize) -> Vec<(usize, f64)>;
}

/// Points in boxes, each box in two halves: a k-d tree.
struct Tree<const N: usize> {
    /// Those of a box follow each other.
    points: Vec<[f64; N]>,
    /// What the points were numbered before.
    index: Vec<u32>,
    /// The whole first; halves come after what they are of.
    boxes: Vec<Cell<N>>,
}

/// The smallest box round some of the points.
struct Cell<const N: usize> {
    lower: [f64; N],
    upper: [f64; N],
    /// Its points.
    first: u32,
    last: u32,
    /// Its halves' numbers; 0 where it is not divided.
    halves: [u32; 2],
}

/// A point with its distance as one number, which is the lower the nearer it is, and of equal
/// distances the lower its index.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Found(u128);

impl Found {
    fn new(distance: f64, index: u32) -> Self {
        // Bits of numbers that are not negative are in the order of the numbers.
        Self(u128::from(distance.to_bits()) << 32 | u128::from(index))
    }

    fn distance(self) -> f64 {
        f64::from_bits((self.0 >> 32) as u64)
    }

    fn index(self) -> usize {
        (self.0 & u128::from(u32::MAX)) as usize
    }
}

/// What a search has found so far.
struct Search<const N: usize> {
    place: [f64; N],
    within: f64,
    most: usize,
    /// Those within the distance: the nearest, and up to as many more.
    found: Vec<Found>,
    /// The nearest beyond it.
    beyond: Option<Found>,
    /// Nothing further away is of use.
    bound: f64,
}

impl<const N: usize> Search<N> {
    fn offer(&mut self, distance: f64, index: u32) {
        if distance > self.bound {
            return;
        }
        let found = Found::new(distance, index);
        if distance > self.within {
            self.beyond = Some(self.beyond.map_or(found, |nearest| nearest.min(found)));
            self.bound = self.beyond.map_or(self.bound, Found::distance);
            return;
        }
        if self.found.is_empty() {
            self.bound = self.within;
        }
        self.found.push(found);
        if self.found.len() == 2 * self.most {
            self.cut();
        }
    }

    /// Keeps the nearest alone. Now and then is cheaper than a heap that does it all the time.
    fn cut(&mut self) {
        if self.found.len() > self.most {
            let (_, last, _) = self.found.select_nth_unstable(self.most - 1);
            self.bound = last.distance();
            self.found.truncate(self.most);
        }
    }

    fn finished(mut self) -> Vec<(usize, f64)> {
        self.cut();
        self.found.sort_unstable();
        if self.found.is_empty() {
            self.found.extend(self.beyond);
        }
        (self.found.into_iter())
            .map(|f| (f.index(), f.distance()))
            .collect()
    }
}

impl<const N: usize> Tree<N> {
    fn new(points: &[f64]) -> Self {
        let mut entries: Vec<([f64; N], u32)> = (points.as_chunks::<N>().0.iter().enumerate())
            .map(|(k, p)| (*p, k as u32))
            .collect();
        let mut boxes = Vec::new();
        if !entries.is_empty() {
            Self::divide(&mut entries, 0, &mut boxes);
        }
        let (points, index) = entries.into_iter().unzip();
        Self {
            points,
            index,
            boxes,
        }
    }

    /// Makes the box of some points, which begin at `first` among all, and those within it; its
    /// number.
    fn divide(entries: &mut [([f64; N], u32)], first: usize, boxes: &mut Vec<Cell<N>>) -> u32 {
        let (mut lower, mut upper) = ([f64::INFINITY; N], [f64::NEG_INFINITY; N]);
        for (p, _) in entries.iter() {
            for i in 0..N {
                lower[i] = lower[i].min(p[i]);
                upper[i] = upper[i].max(p[i]);
            }
        }
        let number = boxes.len();
        boxes.push(Cell {
            lower,
            upper,
            first: first as u32,
            last: (first + entries.len()) as u32,
            halves: [0; 2],
        });
        if entries.len() > LEAF {
            let width = |i: &usize| upper[*i] - lower[*i];
            let widest = (0..N).max_by(|i, j| width(i).total_cmp(&width(j)));
            let widest = widest.unwrap_or(0);
            let middle = entries.len() / 2;
            entries.select_nth_unstable_by(middle, |a, b| a.0[widest].total_cmp(&b.0[widest]));
            let (low, high) = entries.split_at_mut(middle);
            let low = Self::divide(low, first, boxes);
            let high = Self::divide(high, first + middle, boxes);
            boxes[number].halves = [low, high];
        }
        number as u32
    }

    /// Distance of a box; never more than that of a point in it, rounding included.
    fn distance(&self, number: u32, place: &[f64; N]) -> f64 {
        let b = &self.boxes[number as usize];
        let mut square = 0.0;
        for i in 0..N {
            let below = b.lower[i] - place[i];
            let above = place[i] - b.upper[i];
            let beside = if below > above { below } else { above };
            square += if beside > 0.0 { beside } else { 0.0 }.powi(2);
        }
        square.sqrt()
    }

    fn visit(&self, number: u32, search: &mut Search<N>) {
        let b = &self.boxes[number as usize];
        if b.halves == [0; 2] {
            let those = b.first as usize..b.last as usize;
            for (p, index) in self.points[those.clone()].iter().zip(&self.index[those]) {
                let mut square = 0.0;
                for i in 0..N {
                    square += (p[i] - search.place[i]).powi(2);
                }
                let distance = square.sqrt();
                search.offer(distance, *index);
            }
            return;
        }
        let mut halves = b
            .halves
            .map(|half| (self.distance(half, &search.place), half));
        if halves[1].0 < halves[0].0 {
            halves.swap(0, 1);
        }
        for (distance, half) in halves {
            // One as far away as the last may hold one of a smaller index.
            let is_of_no_use = distance > search.bound;
            if !is_of_no_use {
                self.visit(half, search);
            }
        }
    }
}

impl<const N: usize> Nearest for Tree<N> {
    fn near(&self, place: &[f64], within: f64, most: usize) -> Vec<(usize, f64)> {
        let mut search = Search {
            place: std::array::from_fn(|i| place[i]),
            within,
            most,
            found: Vec::with_capacity((2 * most).min(self.points.len())),
            beyond: None,
            bound: f64::INFINITY,
        };
        if most > 0 && !self.boxes.is_empty() {
            self.visit(0, &mut search);
        }
        search.finished()
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
    match dimensions {
        1 => Box::new(Tree::<1>::new(points)),
        2 => Box::new(Tree::<2>::new(points)),
        3 => Box::new(Tree::<3>::new(points)),
        4 => Box::new(Tree::<4>::new(points)),
        5 => Box::new(Tree::<5>::new(points)),
        6 => Box::new(Tree::<6>::new(points)),
        7 => Box::new(Tree::<7>::new(points)),
        8 => Box::new(Tree::<8>::new(points)),
        9 => Box::new(Tree::<9>::new(points)),
        10 => Box::new(Tree::<10>::new(points)),
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
                compare(&points, &*tree, &place);
            }
        }
    }

    /// Of points at one distance those of smaller indices come first, however the tree is divided.
    #[test]
    fn equal_distances_are_told_apart_by_index() {
        for n in [1, 2, 3] {
            let points: Vec<f64> = (0..400 * n).map(|k| ((k * 7919) % 5) as f64).collect();
            let tree = index(&points, n);
            for place in [0.0, 1.5, 2.0, 9.0] {
                compare(&points, &*tree, &vec![place; n]);
            }
        }
        assert!(index(&[], 2).near(&[0.0, 0.0], 1.0, 3).is_empty());
    }

    fn compare(points: &[f64], tree: &dyn Nearest, place: &[f64]) {
        let square = |p: &[f64]| {
            p.iter()
                .zip(place)
                .map(|(x, y)| (x - y).powi(2))
                .sum::<f64>()
        };
        let mut all: Vec<(usize, f64)> = (points.chunks(place.len()))
            .map(|p| square(p).sqrt())
            .enumerate()
            .collect();
        all.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        for (within, most) in [
            (0.2, 8),
            (0.0, 1),
            (f64::INFINITY, 40),
            (0.3, 1000),
            (1.0, 3),
        ] {
            let expected: Vec<_> = (all.iter().take(most).enumerate())
                .filter(|(k, (_, d))| *k == 0 || *d <= within)
                .map(|(_, x)| *x)
                .collect();
            assert_eq!(
                tree.near(place, within, most),
                expected,
                "{most} within {within} of {place:?}"
            );
        }
    }
}
