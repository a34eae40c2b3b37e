//! Several sheets in a cell: where one of them ends although it is lower than the others, and how
//! well it is known where two of them cost the same.

use super::super::{BLEND, MOST_VARIABLES};
use super::{BEYOND_OF_SEVERAL, Block, Builder, Piece};

/// Places a side of a grid over a cell or over a face of one, by number of variables: a sheet that
/// is lower in a corner of the region alone ends on a small part of it.
pub(super) const A_SIDE: [usize; MOST_VARIABLES + 1] = [1, 65, 33, 9, 5, 3, 3];
/// How far beyond the extent of its points a sheet's polynomial tells whether it goes on there, in
/// half widths.
pub(super) const GOES_ON: f64 = 0.3;
/// From a cell's faces, in half widths: by rounding those of the region lie outside it.
const INSET: f64 = 1e-6;
/// States that are asked for where a sheet ends.
const MOST_ENDS: usize = 8;

/// What a piece says of a place, beyond the extent of its points too.
struct ExtendedValue {
    v: f64,
    q: [f64; MOST_VARIABLES],
    /// How far outside the extent of its points, in half widths.
    outside: f64,
    /// Of V, absolute.
    bound: f64,
}

impl Builder<'_> {
    /// Places where a sheet has ended, by its points, while it was lower than all others: V is
    /// continuous, so it goes on there, or one that is not known begins. With the most that V would
    /// jump, relative to itself.
    pub(super) fn ends(&self, block: &Block, pieces: &[Piece]) -> (Vec<f64>, f64) {
        let (mut places, mut jump) = (Vec::new(), 0.0f64);
        if pieces.len() < 2 || self.region.game || self.without.is_some() {
            return (places, jump);
        }
        let n = self.cloud.variables;
        let inside = |z: &[f64]| self.region.covers(&self.frame.state(z));
        let mut add = |z: &[f64], off: f64| {
            places.extend_from_slice(&z[..n]);
            jump = jump.max(off);
        };
        let grid: Vec<Vec<f64>> = self.grid(block, -INSET).collect();
        let all: Vec<Vec<ExtendedValue>> = (grid.iter())
            .map(|z| pieces.iter().map(|piece| self.told(piece, z)).collect())
            .collect();
        for (z, told) in grid.iter().zip(&all) {
            let off = self.jump(told, |told| told.outside > 0.0);
            if off > self.region.error && inside(z) {
                add(z, off);
            }
        }

        // Between two places of the grid a sheet may end before another one is lower.
        for place in 0..grid.len() {
            for axis in 0..n {
                let step = A_SIDE[n].pow(axis as u32);
                if place / step % A_SIDE[n] + 1 == A_SIDE[n] {
                    continue;
                }
                for (k, piece) in pieces.iter().enumerate() {
                    let ends = [place, place + step].map(|at| all[at][k].outside);
                    if (ends[0] <= 0.0) == (ends[1] <= 0.0) {
                        continue;
                    }
                    let z = self.edge_of_support(piece, [&grid[place], &grid[place + step]]);
                    let told: Vec<ExtendedValue> =
                        pieces.iter().map(|piece| self.told(piece, &z)).collect();
                    let off = self.jump(&told, |other| std::ptr::eq(other, &told[k]));
                    if off > self.region.error && inside(&z) {
                        add(&z, off);
                    }
                }
            }
        }
        let count = places.len() / n;
        let some: Vec<f64> = (0..count.min(MOST_ENDS))
            .flat_map(|k| {
                let place = k * count / count.min(MOST_ENDS);
                places[place * n..][..n].to_vec()
            })
            .collect();
        (some, jump)
    }

    /// By how much V would jump at a place, relative to itself, where some of the sheets end: these
    /// are lower than all that are known.
    fn jump(&self, all: &[ExtendedValue], ends: impl Fn(&ExtendedValue) -> bool) -> f64 {
        let lowest = |of: &dyn Fn(&ExtendedValue) -> bool| {
            let v = all.iter().filter(|told| of(told)).map(|told| told.v);
            v.fold(f64::INFINITY, f64::min)
        };
        let known = lowest(&|told| told.outside <= 0.0 && !ends(told));
        let beyond = lowest(&|told| ends(told) && told.outside <= GOES_ON);
        if !known.is_finite() || known > self.region.value_max || beyond >= known {
            return 0.0;
        }
        (known - beyond) / known.abs().max(self.region.floor)
    }

    /// Where the extent of a piece's points ends on the way between two places.
    fn edge_of_support(&self, piece: &Piece, [a, b]: [&[f64]; 2]) -> Vec<f64> {
        /// Of the way.
        const HALVINGS: usize = 16;
        let between =
            |t: f64| -> Vec<f64> { a.iter().zip(b).map(|(a, b)| a + t * (b - a)).collect() };
        let begins_inside = self.told(piece, a).outside <= 0.0;
        let [mut lo, mut hi] = [0.0, 1.0];
        for _ in 0..HALVINGS {
            let middle = 0.5 * (lo + hi);
            if (self.told(piece, &between(middle)).outside <= 0.0) == begins_inside {
                lo = middle;
            } else {
                hi = middle;
            }
        }
        between(0.5 * (lo + hi))
    }

    /// How far the surface on which the two lowest sheets of a block cost the same may be from
    /// where it is said to be, over the distance asked for.
    pub(super) fn excess_of_surface(&self, block: &Block, pieces: &[Piece]) -> f64 {
        let asked = self.region.equal_cost;
        if pieces.len() < 2 || asked == f64::INFINITY || self.region.game || self.without.is_some()
        {
            return 0.0;
        }
        let n = self.cloud.variables;
        let spacing =
            |i: usize| (1.0 + BLEND) * (block.hi[i] - block.lo[i]) / (A_SIDE[n] - 1) as f64;
        let mut excess = 0.0f64;
        // Cells beside this one are blended with it a little beyond its faces.
        for z in self.grid(block, BLEND) {
            let mut known: Vec<ExtendedValue> = (pieces.iter())
                .map(|piece| self.told(piece, &z))
                .filter(|told| told.outside <= 0.0)
                .collect();
            known.sort_by(|a, b| a.v.total_cmp(&b.v));
            let [a, b, ..] = known.as_slice() else {
                continue;
            };
            let jump: Vec<f64> = (0..n).map(|i| b.q[i] - a.q[i]).collect();
            let within: f64 = (0..n).map(|i| jump[i].abs() * spacing(i)).sum();
            if b.v - a.v > within || a.v > self.region.value_max {
                continue;
            }
            let size = jump.iter().map(|q| q * q).sum::<f64>().sqrt();
            excess = excess.max((a.bound + b.bound) / (size * asked).max(f64::MIN_POSITIVE));
        }
        excess
    }

    /// The same of pieces that are not finished.
    pub(super) fn excess_of_unfinished(
        &self,
        block: &Block,
        each: &[(Piece, f64)],
        groups: &[Vec<u32>],
    ) -> f64 {
        if self.region.equal_cost == f64::INFINITY {
            return 0.0;
        }
        let beyond = self.region.beyond.min(BEYOND_OF_SEVERAL);
        let enclosed: Vec<Piece> = (each.iter().zip(groups))
            .map(|((piece, _), points)| Piece {
                support: self.enclosed(piece, points, beyond),
                ..piece.clone()
            })
            .collect();
        self.excess_of_surface(block, &enclosed)
    }

    /// Places of a grid over a block, and so many half widths around it.
    fn grid(&self, block: &Block, around: f64) -> impl Iterator<Item = Vec<f64>> {
        let n = self.cloud.variables;
        let side = A_SIDE[n];
        (0..side.pow(n as u32)).map(move |place| {
            (0..n)
                .zip(shares(place, side))
                .map(|(i, share)| {
                    let margin = 0.5 * around * (block.hi[i] - block.lo[i]);
                    let (lo, hi) = (block.lo[i] - margin, block.hi[i] + margin);
                    lo + share * (hi - lo)
                })
                .collect()
        })
    }

    fn told(&self, piece: &Piece, z: &[f64]) -> ExtendedValue {
        let y = piece.place(z);
        let outside = (piece.support.iter().zip(&self.directions))
            .map(|([lo, hi], d)| {
                let at: f64 = d.iter().zip(&y).map(|(d, y)| d * y).sum();
                (at - hi).max(lo - at)
            })
            .fold(f64::NEG_INFINITY, f64::max);
        let (v, q) = piece.value(&self.terms, &y[..z.len()]);
        ExtendedValue {
            v,
            q,
            outside,
            bound: piece.bound * v.abs().max(self.region.floor),
        }
    }
}

/// Where a place of a grid with so many places a side lies along each axis, in shares of the side.
pub(super) fn shares(place: usize, side: usize) -> impl Iterator<Item = f64> {
    std::iter::successors(Some(place), move |left| Some(left / side))
        .map(move |left| (left % side) as f64 / (side - 1) as f64)
}
