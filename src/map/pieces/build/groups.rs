//! Several sheets over one block: its points are parted, and each part has a piece of its own.

use super::super::fit::Shape;
use super::crossings::GOES_ON;
use super::{Block, Builder, Piece, thinned};
use crate::map::pieces::MOST_VARIABLES;

/// Points a group of a sheet needs.
const LEAST_GROUP: usize = 6;
/// Points of two sheets that are nearer to each other than this, in widths of the cell, show
/// whether gradients jump; how many pairs are looked at, and among how many points of each.
const NEAR_PAIR: f64 = 0.3;
const PAIRS: usize = 9;
const MOST_LOOKED_AT: usize = 300;
/// Sheets in a cell.
const MOST_GROUPS: usize = 4;
/// Blocks with so many times the points that a polynomial needs are halved before sheets are looked
/// for.
const LARGE: f64 = 16.0;
/// Where a cell cannot be halved several sheets are taken for one whose error is this much larger.
const SEPARATE: f64 = 0.1;

/// The sheets of a block.
struct Sheets {
    /// The piece of each, with its largest error over the one asked for.
    each: Vec<(Piece, f64)>,
    /// The points of each.
    groups: Vec<Vec<u32>>,
}

impl Builder<'_> {
    /// The pieces of a block, one a sheet; with their largest error over the one asked for.
    pub(super) fn fitted(
        &self,
        block: &Block,
        can_be_halved: bool,
    ) -> (Vec<(Piece, Vec<u32>)>, f64) {
        let all = self.of_group(block, &block.points, can_be_halved);
        if let Some((piece, excess)) = all {
            if excess <= self.habits.enough {
                return (vec![(piece, block.points.clone())], excess);
            }
            // Of many variables sorting is dear: where a half may yet tell, points of one sheet
            // that were parted are not sorted, and those of a large block not even parted.
            let dear = !self.leaves_quarters() && can_be_halved;
            if dear && block.near as f64 > LARGE * self.least() {
                return (vec![(piece, block.points.clone())], excess);
            }
            for groups in self.groups(block) {
                if dear && !self.jumps(block, &groups) {
                    continue;
                }
                let groups = self.sorted_out(block, groups);
                if groups.len() < 2 || !self.jumps(block, &groups) {
                    continue;
                }
                let each: Option<Vec<_>> = groups
                    .iter()
                    .map(|g| self.of_group(block, g, can_be_halved))
                    .collect();
                let Some(each) = each else { continue };
                let Some(sheets) = self.consistent(block, Sheets { each, groups }) else {
                    continue;
                };
                let Sheets { each, groups } = sheets;
                let worst = each.iter().map(|(_, e)| *e).fold(0.0, f64::max);
                // Where two cost the same they may have to be known better than elsewhere.
                let surface = self.excess_of_unfinished(block, &each, &groups);
                let good = worst <= self.habits.enough
                    && (surface <= self.habits.enough || !can_be_halved);
                if good || (worst < SEPARATE * excess && !can_be_halved) {
                    let pieces = each.into_iter().map(|(p, _)| p).zip(groups).collect();
                    return (pieces, worst.max(surface));
                }
            }
            if let Some((sheet, excess)) = self.without_strays(block, can_be_halved) {
                return (vec![sheet], excess);
            }
            return (vec![(piece, block.points.clone())], excess);
        }
        (Vec::new(), f64::INFINITY)
    }

    /// Ways to part a block's points by sheets: by their labels, and by their gradients.
    fn groups(&self, block: &Block) -> Vec<Vec<Vec<u32>>> {
        let mut labels: Vec<i32> = block
            .points
            .iter()
            .map(|k| self.cloud.sheet[*k as usize])
            .collect();
        labels.sort_unstable();
        labels.dedup();
        let labelled: Vec<Vec<u32>> = (labels.iter())
            .map(|l| {
                let of = |k: &&u32| self.cloud.sheet[**k as usize] == *l;
                block.points.iter().filter(of).copied().collect()
            })
            .filter(|g: &Vec<u32>| g.len() >= LEAST_GROUP)
            .collect();
        let mut ways = Vec::new();
        if (2..=MOST_GROUPS).contains(&labelled.len()) {
            ways.push(labelled);
        }
        let parted = self.parted(block, &block.points, LEAST_GROUP);
        ways.extend(parted.map(Vec::from));
        ways
    }

    /// Two groups of no less than `least` points by their gradients (two means).
    fn parted(&self, block: &Block, points: &[u32], least: usize) -> Option<[Vec<u32>; 2]> {
        let n = self.cloud.variables;
        let q = |k: u32| self.cloud.q(k as usize);
        let mean = |points: &[u32]| -> Vec<f64> {
            (0..n)
                .map(|i| points.iter().map(|k| q(*k)[i]).sum::<f64>() / points.len().max(1) as f64)
                .collect()
        };
        let far = |k: u32, from: &[f64]| -> f64 {
            (q(k).iter().zip(from).zip(block.hi.iter().zip(&block.lo)))
                .map(|((q, c), (hi, lo))| ((q - c) * (hi - lo)).powi(2))
                .sum()
        };
        // From the points furthest apart.
        let middle = mean(points);
        let furthest = |from: &[f64]| {
            let all = points.iter().copied();
            all.max_by(|a, b| far(*a, from).total_cmp(&far(*b, from)))
        };
        let a = furthest(&middle)?;
        let b = furthest(q(a))?;
        let (mut one, mut other) = (q(a).to_vec(), q(b).to_vec());
        let mut groups = [Vec::new(), Vec::new()];
        for _ in 0..8 {
            let (first, second) =
                (points.iter().copied()).partition(|k| far(*k, &one) <= far(*k, &other));
            groups = [first, second];
            if groups.iter().any(|g: &Vec<u32>| g.len() < least) {
                return None;
            }
            one = mean(&groups[0]);
            other = mean(&groups[1]);
        }
        Some(groups)
    }

    /// Sheets whose bounds hold where others have points and they have none; `None` where one says
    /// far less there.
    fn consistent(&self, block: &Block, mut sheets: Sheets) -> Option<Sheets> {
        let lower = match self.lower_without_points(block, &sheets) {
            Some(lower) => lower,
            None => {
                sheets = self.without_dominated(block, sheets)?;
                self.lower_without_points(block, &sheets)?
            }
        };
        for ((piece, _), lower) in sheets.each.iter_mut().zip(lower) {
            piece.bound = piece.bound.max(lower);
        }
        Some(sheets)
    }

    /// Sheets that may be the lowest somewhere in a block; `None` if all may be. One is not whose
    /// points all lie where another one that is known well enough is lower: where whole periods may
    /// be chosen anew at each state, the rest of a least solution need not be least.
    fn without_dominated(&self, block: &Block, sheets: Sheets) -> Option<Sheets> {
        if !self.may_be_dominated(block) {
            return None;
        }
        let reach: Vec<Piece> = (sheets.each.iter().zip(&sheets.groups))
            .map(|((piece, _), points)| self.going_on(piece, points))
            .collect();
        let is_dominated = |own: usize| {
            let mut others = (0..reach.len()).filter(|other| *other != own);
            others.any(|other| {
                sheets.each[other].1 <= self.habits.enough
                    && self.is_below(&reach[other], &sheets.groups[own])
            })
        };
        // Of two one at most is below the other.
        let stays: Vec<bool> = (0..reach.len()).map(|own| !is_dominated(own)).collect();
        if stays.iter().all(|stays| *stays) {
            return None;
        }
        let (each, groups) = (sheets.each.into_iter().zip(sheets.groups))
            .zip(stays)
            .filter_map(|(sheet, stays)| stays.then_some(sheet))
            .unzip();
        Some(Sheets { each, groups })
    }

    /// The one sheet of a block but for a few points, of which it is below: too few to tell of a
    /// sheet of their own.
    fn without_strays(
        &self,
        block: &Block,
        can_be_halved: bool,
    ) -> Option<((Piece, Vec<u32>), f64)> {
        if !self.may_be_dominated(block) {
            return None;
        }
        let (mut points, mut strays) = (block.points.clone(), Vec::new());
        for _ in 1..MOST_GROUPS {
            let mut parts = self.parted(block, &points, 1)?;
            parts.sort_by_key(Vec::len);
            let [few, most] = parts;
            strays.extend(few);
            points = most;
            if strays.len() >= LEAST_GROUP {
                return None;
            }
            let (piece, excess) = self.of_group(block, &points, can_be_halved)?;
            if excess <= self.habits.enough {
                let goes_on = self.going_on(&piece, &points);
                let is_below = self.is_below(&goes_on, &strays);
                return is_below.then_some(((piece, points), excess));
            }
        }
        None
    }

    /// Whether a sheet that is lower than another's points tells that these are not the lowest.
    fn may_be_dominated(&self, block: &Block) -> bool {
        self.cloud.several && !self.is_shaded && !self.region.game && block.unanswered.is_empty()
    }

    /// A piece that reaches a little beyond its points.
    fn going_on(&self, piece: &Piece, points: &[u32]) -> Piece {
        Piece {
            support: self.enclosed(piece, points, GOES_ON),
            ..piece.clone()
        }
    }

    /// Whether a piece is lower than all of some points by more than the error asked for, and none
    /// of these is known to be of the least solution: V may jump, where controls have bounds.
    fn is_below(&self, piece: &Piece, points: &[u32]) -> bool {
        let is_doubtful = |k: &u32| self.cloud.doubtful[*k as usize];
        points.iter().all(is_doubtful)
            && points.iter().all(|k| {
                let y = piece.place(self.cloud.z(*k as usize));
                let y = &y[..self.cloud.variables];
                let v = self.cloud.v[*k as usize];
                let enough = self.region.error * v.abs().max(self.region.floor);
                piece.supports(&self.directions, y) && v - piece.value(&self.terms, y).0 > enough
            })
    }

    /// By how much each sheet says, at most, that it is lower than another where it has no points
    /// of its own, relative to V; `None` if that is more than the error asked for.
    fn lower_without_points(&self, block: &Block, sheets: &Sheets) -> Option<Vec<f64>> {
        let Sheets { each, groups } = sheets;
        let mut lower = vec![0.0f64; each.len()];
        let n = self.cloud.variables;
        let far = |k: u32, l: u32| -> f64 {
            let (a, b) = (self.cloud.z(k as usize), self.cloud.z(l as usize));
            (0..n)
                .map(|i| ((a[i] - b[i]) / (block.hi[i] - block.lo[i])).powi(2))
                .sum()
        };
        let inside = |k: &u32| {
            let z = self.cloud.z(*k as usize);
            (0..n).all(|i| z[i] >= block.lo[i] && z[i] <= block.hi[i])
        };
        for (own, group) in groups.iter().enumerate() {
            for k in group.iter().copied().filter(inside) {
                let (z, v) = (self.cloud.z(k as usize), self.cloud.v[k as usize]);
                for (other, (piece, _)) in
                    each.iter().enumerate().filter(|(other, _)| *other != own)
                {
                    let y: Vec<f64> = (0..n)
                        .map(|i| (z[i] - piece.center[i]) / piece.half[i])
                        .collect();
                    let mut gradient = [0.0; MOST_VARIABLES];
                    let (said, _) =
                        piece
                            .shape
                            .back(self.terms.sum(&piece.coefficients, &y, &mut gradient));
                    let by = (v - said) / v.abs().max(self.region.floor);
                    let near = |l: &u32| far(k, *l) < 0.25 * NEAR_PAIR * NEAR_PAIR;
                    if by <= lower[other] || groups[other].iter().any(near) {
                        continue;
                    }
                    if by > self.region.error {
                        return None;
                    }
                    lower[other] = by;
                }
            }
        }
        Some(lower)
    }

    /// Whether gradients jump between groups where they are near each other: those of a smooth
    /// function that was cut in two do not.
    fn jumps(&self, block: &Block, groups: &[Vec<u32>]) -> bool {
        let n = self.cloud.variables;
        let width: Vec<f64> = (0..n).map(|i| block.hi[i] - block.lo[i]).collect();
        let mean = |points: &[u32], i: usize| {
            points
                .iter()
                .map(|k| self.cloud.q(*k as usize)[i])
                .sum::<f64>()
                / points.len() as f64
        };
        let mut met = vec![false; groups.len()];
        for a in 0..groups.len() {
            for b in a + 1..groups.len() {
                let between: f64 = (0..n)
                    .map(|i| ((mean(&groups[a], i) - mean(&groups[b], i)) * width[i]).powi(2))
                    .sum::<f64>()
                    .sqrt();
                let mut pairs: Vec<(f64, f64)> = Vec::new();
                for k in thinned(&groups[a], MOST_LOOKED_AT) {
                    let (zk, qk) = (self.cloud.z(k as usize), self.cloud.q(k as usize));
                    for l in thinned(&groups[b], MOST_LOOKED_AT) {
                        let (zl, ql) = (self.cloud.z(l as usize), self.cloud.q(l as usize));
                        let far: f64 = (0..n).map(|i| ((zk[i] - zl[i]) / width[i]).powi(2)).sum();
                        if far < NEAR_PAIR * NEAR_PAIR {
                            let jump: f64 =
                                (0..n).map(|i| ((qk[i] - ql[i]) * width[i]).powi(2)).sum();
                            pairs.push((far, jump.sqrt()));
                        }
                    }
                }
                if pairs.is_empty() {
                    continue;
                }
                pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
                pairs.truncate(PAIRS);
                pairs.sort_by(|a, b| a.1.total_cmp(&b.1));
                if pairs[pairs.len() / 2].1 < 0.5 * between {
                    return false;
                }
                (met[a], met[b]) = (true, true);
            }
        }
        met.into_iter().all(|m| m)
    }

    /// Groups after each point has gone to the one whose polynomial says what it says: labels are
    /// those of where a way began, which Newton's method may have left.
    fn sorted_out(&self, block: &Block, mut groups: Vec<Vec<u32>>) -> Vec<Vec<u32>> {
        const ROUNDS: usize = 8;
        let (center, half) = self.extent(block);
        let all: Vec<u32> = groups.concat();
        let scale = self.scale(&all);
        let data = |list: &[u32], degree: usize| self.data((&center, &half), list, degree, scale);
        for round in 0..ROUNDS {
            let degree = if round < ROUNDS / 2 {
                2
            } else {
                self.highest.min(3)
            };
            let whole = data(&all, degree);
            let mut errors: Vec<Vec<f64>> = Vec::new();
            for group in &groups {
                let most =
                    (2.0 * self.habits.most_equations * self.terms.upto[degree] as f64) as usize;
                let Some(fitted) = data(&thinned(group, most), degree).fitted(Shape::Value, degree)
                else {
                    return Vec::new();
                };
                let each = whole.errors(Shape::Value, &fitted);
                errors.push(each.iter().map(|e| e[0] + e[1]).collect());
            }
            let mut next = vec![Vec::new(); groups.len()];
            for (k, point) in all.iter().enumerate() {
                let best = (0..groups.len()).min_by(|a, b| errors[*a][k].total_cmp(&errors[*b][k]));
                next[best.unwrap_or(0)].push(*point);
            }
            next.retain(|g| g.len() >= LEAST_GROUP);
            let same = next.iter().map(Vec::len).eq(groups.iter().map(Vec::len));
            groups = next;
            if groups.len() < 2 || (same && round >= ROUNDS / 2) {
                break;
            }
        }
        groups
    }
}
