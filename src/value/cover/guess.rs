//! First guesses from places of the manifold.

use super::cell::{Cell, Place};
use super::close::Close;
use super::{Candidate, Copy, Cover, Open, Sought, holds, tangent};
use crate::shooting::{End, Path};
use smallvec::smallvec;

/// How far outside a cell, relative to it, a state may lie that is looked for in it.
const OUTSIDE: f64 = 0.35;
/// Most segments that a guess begins with.
const MOST_SEGMENTS: f64 = 400.0;

impl Cover<'_> {
    /// The guess that a leaf gives for a state, if the state lies in it.
    pub(super) fn candidate(
        &self,
        leaf: &Open,
        close: Option<&Close>,
        copy: &Copy,
        sought: &[Sought],
    ) -> Option<Candidate> {
        let widths = &self.fan.plan.widths;
        let n = widths.len();
        let part = close.and_then(|close| close.locate(&copy.x));
        let part = part.filter(|part| part.place.outside <= OUTSIDE);
        let (place, first, points) = match &part {
            Some(part) => {
                let place = Place {
                    share: part.share,
                    ..part.place.clone()
                };
                (place, part.at_place(), part.points.clone())
            }
            None => {
                let place = self.place(leaf, copy)?;
                if place.outside > OUTSIDE {
                    return None;
                }
                match self.on_the_way(&leaf.cell, copy) {
                    Some(first) => (place, first.clone(), vec![first]),
                    None => {
                        let first = self.at(&leaf.cell, &place);
                        (place, first, self.corner_points(&leaf.cell))
                    }
                }
            }
        };
        let goal: Vec<f64> = copy.x.iter().zip(widths).map(|(x, w)| x * w).collect();
        let value = first[1 + 2 * n];
        let promised = points.iter().map(|point| tangent(point, n, |i| goal[i]));
        let spread = |i: usize| {
            let off = points
                .iter()
                .map(|q| (q[1 + n + i] - first[1 + n + i]).abs());
            off.fold(0.0, f64::max)
        };
        Some(Candidate {
            target: sought[copy.sought].target,
            turns: copy.turns.clone(),
            lowest: promised.fold(value, f64::min),
            goal,
            node: first[1..=2 * n].to_vec(),
            value,
            expected: value,
            spread: (0..n).map(spread).collect(),
            time: first[0],
            cell: leaf.cell.clone(),
            place,
            part: part.map(|part| Box::new(part.corners)),
        })
    }

    /// `(t, s, p, V)` of a scene of one state where the trajectory of a cell that ends within it
    /// passes a copy: up to the end V may rise by any factor, and nothing is between.
    fn on_the_way(&self, cell: &Cell, copy: &Copy) -> Option<Vec<f64>> {
        let (plan, seed) = (self.fan.plan, cell.seeds[0]);
        if plan.system.states > 1 || !self.stationary || !self.fan.is_cut(seed, cell.level + 1) {
            return None;
        }
        let from = f64::from(self.fan.point(seed, cell.level)?.0[1]) / plan.widths[0];
        let length = self.fan.along_to(cell.level) + (copy.x[0] - from).abs();
        let trace = self.fan.traces(&[&self.fan.start(seed)], &[length]).ok()?;
        trace.into_iter().next().filter(|point| !point.is_empty())
    }

    /// Where in a leaf a state lies.
    fn place(&self, leaf: &Open, copy: &Copy) -> Option<Place> {
        let seeds = leaf.cell.seeds.len();
        match leaf.corners.locate(&copy.x, seeds) {
            Some(place) => Some(place),
            // A flat cell: its middle, if the state is hardly outside its corners.
            None if !holds(&leaf.corners.bounds(copy.x.len(), 0.0), &copy.x) => None,
            None => Some(Place {
                weights: smallvec![1.0 / seeds as f64; seeds],
                share: 0.5,
                outside: OUTSIDE,
            }),
        }
    }

    /// The guess that a point of a trajectory gives for a state near it.
    pub(super) fn point_guess(
        &self,
        seed: u32,
        level: usize,
        copy: &Copy,
        sought: &[Sought],
        distance: f64,
    ) -> Candidate {
        let widths = &self.fan.plan.widths;
        let n = widths.len();
        let cell = Cell {
            seeds: smallvec![seed],
            level,
            bend: 0.0,
            depth: 0,
        };
        let place = Place {
            weights: smallvec![1.0],
            share: 0.0,
            outside: distance,
        };
        let first = self.mixed(&cell, &place, level);
        let goal: Vec<f64> = copy.x.iter().zip(widths).map(|(x, w)| x * w).collect();
        let way: Vec<f64> = (0..n).map(|i| goal[i] - first[1 + i]).collect();
        let value = tangent(&first, n, |i| goal[i]);
        let bend = (self.fan.plan.local.as_ref()).map_or(0.0, |local| local.quadratic(&way));
        Candidate {
            target: sought[copy.sought].target,
            turns: copy.turns.clone(),
            goal,
            node: first[1..=2 * n].to_vec(),
            value,
            lowest: value,
            expected: value + bend,
            spread: vec![0.0; n],
            time: first[0],
            cell,
            place,
            part: None,
        }
    }

    /// `(t, s, p, V)` at a place of a cell.
    fn at(&self, cell: &Cell, place: &Place) -> Vec<f64> {
        let lower = self.mixed(cell, place, cell.level);
        if !self.stationary {
            return lower;
        }
        let upper = self.mixed(cell, place, cell.level + 1);
        // A cubic along the trajectory: it is known how fast all changes at both levels, and how
        // far they are apart.
        if cell
            .seeds
            .iter()
            .any(|seed| self.fan.is_cut(*seed, cell.level + 1))
        {
            return (lower.iter().zip(&upper))
                .map(|(a, b)| a + place.share * (b - a))
                .collect();
        }
        let (q, step) = (place.share, self.fan.step(cell.level));
        let rates = self.fan.along(&[lower.as_slice(), &upper].concat());
        let (below, above) = rates.split_at(lower.len());
        let blend = [
            (1.0 + 2.0 * q) * (1.0 - q).powi(2),
            q * q * (3.0 - 2.0 * q),
            q * (1.0 - q).powi(2) * step,
            q * q * (q - 1.0) * step,
        ];
        (0..lower.len())
            .map(|i| {
                let straight = lower[i] + q * (upper[i] - lower[i]);
                let cubic = blend[0] * lower[i]
                    + blend[1] * upper[i]
                    + blend[2] * below[i]
                    + blend[3] * above[i];
                // Where the trajectories of a cell differ too much their mean is none.
                let usual = (upper[i] - lower[i]).abs();
                if (cubic - straight).abs() <= usual {
                    cubic
                } else {
                    straight
                }
            })
            .collect()
    }

    /// The mean of the cell's trajectories, from the candidate's place on.
    pub fn mean_path(&self, candidate: &Candidate, end: &End) -> Path {
        let first: Vec<f64> = std::iter::once(candidate.time)
            .chain(candidate.node.iter().copied())
            .chain([candidate.value])
            .collect();
        self.path(&candidate.cell, &candidate.place, &first, end)
    }

    /// The cell's trajectory that passes nearest, from the level nearer to the place: a solution
    /// from its own state.
    pub fn path_beside(&self, candidate: &Candidate, end: &End) -> Path {
        let (cell, place) = (&candidate.cell, &candidate.place);
        let most =
            (0..place.weights.len()).max_by(|a, b| place.weights[*a].total_cmp(&place.weights[*b]));
        let upper = self.stationary && place.share > 0.5;
        let corner = Place {
            weights: (0..place.weights.len())
                .map(|q| f64::from(u8::from(Some(q) == most)))
                .collect(),
            share: 0.0,
            outside: 0.0,
        };
        let cell = Cell {
            level: cell.level + usize::from(upper),
            ..cell.clone()
        };
        let first = self.mixed(&cell, &corner, cell.level);
        self.path(&cell, &corner, &first, end)
    }

    /// The mean of a cell's trajectories at a level, by a place's weights.
    fn mixed(&self, cell: &Cell, place: &Place, level: usize) -> Vec<f64> {
        let mut mean = vec![0.0; 2 + 2 * self.fan.plan.system.states];
        for (seed, weight) in cell.seeds.iter().zip(&place.weights) {
            if let Some((point, _)) = self.fan.point(*seed, level) {
                mean.iter_mut()
                    .zip(point)
                    .for_each(|(m, x)| *m += weight * f64::from(*x));
            }
        }
        if !self.stationary && level > 0 {
            // To the last bit.
            mean[0] = self.fan.time(level);
        }
        mean
    }

    /// The points `(t, s, p, V)` of a cell's corners, as far as there are any.
    fn corner_points(&self, cell: &Cell) -> Vec<Vec<f64>> {
        let levels = cell.level..=cell.level + usize::from(self.stationary);
        let corners = levels.flat_map(|level| cell.seeds.iter().map(move |seed| (*seed, level)));
        corners
            .filter_map(|(seed, level)| self.fan.point(seed, level))
            .map(|(point, _)| point.iter().map(|x| f64::from(*x)).collect())
            .collect()
    }

    /// The path from a place to the end: the mean of the cell's trajectories, and on into the range
    /// of the end's condition.
    fn path(&self, cell: &Cell, place: &Place, first: &[f64], end: &End) -> Path {
        let points: Vec<Vec<f64>> = (0..=cell.level)
            .rev()
            .map(|level| self.mixed(cell, place, level))
            .collect();
        self.path_through(first, &points, self.duration, end)
    }

    /// The path from a point `(t, s, p, V)` through others, down to the seed, to the end, in segments
    /// of at least this duration.
    pub(super) fn path_through(
        &self,
        first: &[f64],
        points: &[Vec<f64>],
        least: f64,
        end: &End,
    ) -> Path {
        let n = self.fan.plan.system.states;
        let mut path = Path::new(&first[1..=2 * n]);
        let shortest = (first[0] / MOST_SEGMENTS).max(least);
        let mut at = first[0];
        for (k, point) in points.iter().enumerate() {
            let before = points.get(k + 1).map_or(f64::NEG_INFINITY, |next| next[0]);
            // The last point that is not too far away, or the next one.
            if at - before > shortest && at > point[0] {
                path.push(at - point[0], &point[1..=2 * n]);
                at = point[0];
            }
        }
        let s = path.last()[..n].to_vec();
        let (nodes, durations) = end.tail(&s, first[1 + 2 * n], self.duration);
        path.append(&nodes, &durations);
        path
    }
}
