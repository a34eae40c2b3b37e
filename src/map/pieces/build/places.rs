//! Where points are and where they are missing.

use super::shadow::Edge;
use super::{BESIDE, Block, Builder, Piece, REACH, Unanswered};
use rustc_hash::FxHashSet;

/// Points of a block of which a fit and its tests see only a part.
const MANY_POINTS: usize = 500;
/// Without a solution a place counts if no point is nearer than this share of the usual distance
/// between tracks.
const NO_POINT_WITHIN: f64 = 1.5;
/// The same where the solution is known to leave a guard.
const NO_POINT_WITHIN_OF_CUT: f64 = 0.25;

impl Unanswered {
    /// Whether a place lies in a box.
    pub(super) fn lies_in(&self, k: u32, lo: &[f64], hi: &[f64]) -> bool {
        let n = lo.len();
        (self.z[k as usize * n..][..n].iter().zip(lo.iter().zip(hi)))
            .all(|(z, (lo, hi))| z >= lo && z <= hi)
    }
}

impl Builder<'_> {
    /// The axis along which a block is halved.
    pub(super) fn axis(&self, block: &Block, pieces: &[(Piece, Vec<u32>)]) -> usize {
        if self.leaves_quarters() {
            self.axis_by_terms(block, pieces)
        } else {
            self.axis_by_halves(block, pieces)
        }
    }

    /// Axes along which a block may be halved without becoming a sliver.
    pub(super) fn wide(&self, block: &Block) -> Vec<usize> {
        let width = |i: usize| block.hi[i] - block.lo[i];
        let n = self.cloud.variables;
        let widest = (0..n).map(width).fold(0.0, f64::max);
        (0..n)
            .filter(|i| width(*i) * self.habits.sliver > widest)
            .collect()
    }

    /// A piece as it is said: with the extent of its points where these do not lie all around, and
    /// outside shadows of guards; and the edge of these.
    pub(super) fn finished(
        &self,
        mut piece: Piece,
        points: &[u32],
        block: &Block,
        beyond: f64,
    ) -> (Piece, Edge) {
        // Alone in the region's inside, a sheet has points all around unless they are few.
        let reach = if beyond < self.region.beyond || self.region.game {
            BESIDE
        } else {
            REACH
        };
        let at_edge = !self.places_without(block, points, 2, reach).is_empty();
        let mut edge = self.edge(&piece, points);
        piece.clearance = std::mem::take(&mut edge.clearance);
        if at_edge || self.without.is_some() || !piece.clearance.is_empty() {
            piece.support = self.enclosed(&piece, points, beyond);
        }
        let piece = if self.leaves_quarters() {
            self.with_all(piece, points)
        } else {
            self.bounded(piece, at_edge)
        };
        (piece, edge)
    }

    /// How much V changes along an axis, relative to itself, differently at different points.
    pub(super) fn change(&self, block: &Block, axis: usize) -> f64 {
        let width = block.hi[axis] - block.lo[axis];
        let stride = (block.points.len() / 1000).max(1);
        let relative = |k: &u32| {
            let k = *k as usize;
            self.cloud.q(k)[axis] * width / self.cloud.v[k].abs().max(self.region.floor)
        };
        let all: Vec<f64> = block.points.iter().step_by(stride).map(relative).collect();
        let mean = all.iter().sum::<f64>() / all.len().max(1) as f64;
        (all.iter().map(|c| (c - mean).powi(2)).sum::<f64>() / all.len().max(1) as f64).sqrt()
    }

    /// Extents of points along directions, in the piece's variables, and a little more: between
    /// tracks there may be others.
    pub(super) fn enclosed(&self, piece: &Piece, points: &[u32], beyond: f64) -> Vec<[f64; 2]> {
        let n = self.cloud.variables;
        (self.directions.iter())
            .map(|d| {
                let along = points.iter().map(|k| {
                    let z = self.cloud.z(*k as usize);
                    (0..n)
                        .map(|i| d[i] * (z[i] - piece.center[i]) / piece.half[i])
                        .sum::<f64>()
                });
                let [lo, hi] = along.fold([f64::INFINITY, f64::NEG_INFINITY], |[lo, hi], t| {
                    [lo.min(t), hi.max(t)]
                });
                [lo - beyond, hi + beyond]
            })
            .collect()
    }

    pub(super) fn unanswered_in(&self, lo: &[f64], hi: &[f64]) -> Vec<u32> {
        let all = 0..self.cloud.unanswered.clearance.len() as u32;
        all.filter(|k| self.cloud.unanswered.lies_in(*k, lo, hi))
            .collect()
    }

    /// Whether pieces say something at a place of a block at which a search found no solution, and
    /// no point is near: one that was only missed lies among the tracks of others.
    pub(super) fn is_unfounded(&self, block: &Block, pieces: &[Piece]) -> bool {
        let n = self.cloud.variables;
        let places = &self.cloud.unanswered;
        let z = |k: u32| &places.z[k as usize * n..][..n];
        let is_said = |k: u32| {
            pieces.iter().any(|piece| {
                let y = piece.place(z(k));
                piece.supports(&self.directions, &y[..n])
                    && piece.value(&self.terms, &y[..n]).0 <= self.region.value_max
            })
        };
        let said: Vec<u32> = block
            .unanswered
            .iter()
            .copied()
            .filter(|k| is_said(*k))
            .collect();
        if said.is_empty() {
            return false;
        }
        let tracks: FxHashSet<u32> = block
            .points
            .iter()
            .map(|k| self.cloud.track[*k as usize])
            .collect();
        // Of so many tracks spread over the block, in its widths.
        let usual = (tracks.len() as f64).powf(-1.0 / n as f64);
        said.into_iter().any(|k| {
            let share = match places.clearance[k as usize].is_nan() {
                true => NO_POINT_WITHIN,
                false => NO_POINT_WITHIN_OF_CUT,
            };
            let near = |point: &u32| {
                let at = self.cloud.z(*point as usize);
                (0..n)
                    .all(|i| (at[i] - z(k)[i]).abs() <= share * usual * (block.hi[i] - block.lo[i]))
            };
            !block.points.iter().any(near)
        })
    }

    /// By how much V of points in a block is off what its pieces say there, at most, relative to V:
    /// of each piece where it is the nearest. Where sheets lie over each other a point above them
    /// may be of another sheet.
    pub(super) fn off_points(&self, block: &Block, pieces: &[Piece]) -> Vec<f64> {
        let n = self.cloud.variables;
        let mut off = vec![0.0f64; pieces.len()];
        // Of fewer points most have tested the fit.
        if self.without.is_some() || block.points.len() < MANY_POINTS {
            return off;
        }
        for k in block.points.iter().map(|k| *k as usize) {
            let (z, v) = (self.cloud.z(k), self.cloud.v[k]);
            if (0..n).any(|i| z[i] < block.lo[i] || z[i] > block.hi[i]) {
                continue;
            }
            let by = |piece: &Piece| {
                let y = piece.place(z);
                let said = piece.value(&self.terms, &y[..n]).0;
                (said.is_finite() && piece.supports(&self.directions, &y[..n]))
                    .then(|| (v - said) / v.abs().max(self.region.floor))
            };
            let said = pieces
                .iter()
                .enumerate()
                .filter_map(|(j, piece)| Some((j, by(piece)?)));
            let nearest = said.min_by(|a, b| a.1.abs().total_cmp(&b.1.abs()));
            if let Some((j, by)) = nearest.filter(|(_, by)| *by < 0.0 || !self.cloud.several) {
                off[j] = off[j].max(by.abs());
            }
        }
        off
    }

    /// Places of a block that no point is near to: where few variables allow high degrees, between
    /// its corners too.
    pub(super) fn bare_places(&self, block: &Block) -> Vec<f64> {
        let (a_side, reach) = match self.cloud.variables {
            1 | 2 => (5, 0.35),
            3 => (4, 0.5),
            _ => (2, REACH),
        };
        self.places_without(block, &block.points, a_side, reach)
    }

    /// Places of a grid over a block, in the region, that none of some points is within so many
    /// half widths of.
    fn places_without(&self, block: &Block, points: &[u32], a_side: usize, reach: f64) -> Vec<f64> {
        let n = self.cloud.variables;
        let half = |i: usize| 0.5 * (block.hi[i] - block.lo[i]);
        let places = a_side.pow(n as u32);
        assert!(places <= 64);
        let level = |i: usize, step: usize| {
            block.lo[i] + step as f64 / (a_side - 1) as f64 * (block.hi[i] - block.lo[i])
        };
        // A bit a place: those of each step along each axis, and those that no point has been found
        // near to.
        let mut of_step = vec![0u64; n * a_side];
        let mut left = 0u64;
        for place in 0..places {
            let mut rest = place;
            let at: Vec<f64> = (0..n)
                .map(|i| {
                    let step = rest % a_side;
                    rest /= a_side;
                    of_step[i * a_side + step] |= 1 << place;
                    level(i, step)
                })
                .collect();
            let x = self.frame.state(&at);
            let inside = (0..n).all(|i| x[i] >= self.region.lo[i] && x[i] <= self.region.hi[i]);
            left |= u64::from(inside) << place;
        }
        for k in points {
            if left == 0 {
                break;
            }
            let z = self.cloud.z(*k as usize);
            let mut near = left;
            for i in 0..n {
                let steps =
                    (0..a_side).filter(|step| (z[i] - level(i, *step)).abs() <= reach * half(i));
                near &= steps.fold(0, |all, step| all | of_step[i * a_side + step]);
                if near == 0 {
                    break;
                }
            }
            left &= !near;
        }
        (0..places)
            .filter(|place| left >> place & 1 == 1)
            .flat_map(|place| (0..n).map(move |i| (i, place / a_side.pow(i as u32) % a_side)))
            .map(|(i, step)| level(i, step))
            .collect()
    }
}
