//! What the pieces around a state say together: one sheet's blend, with first and second
//! derivatives.

use super::bend::Place;
use super::{Flat, Here};
use crate::backend::cpu::real::Real;
use crate::map::pieces::jets::{MOST_SECOND, by_states};
use crate::map::pieces::{BLEND, MOST_VARIABLES, SAME};

/// What a piece says, in coordinates of the frame.
#[derive(Clone, Copy)]
pub(super) struct PieceValue<T> {
    pub v: T,
    pub q: [T; MOST_VARIABLES],
    pub h: [T; MOST_SECOND],
    pub v_bound: T,
    pub p_bound: [T; MOST_VARIABLES],
    pub sheet: i32,
}

/// A cell that reaches over a state.
#[derive(Clone, Copy)]
pub(super) struct Share<T> {
    pub own: bool,
    /// Whether the cell has one piece only.
    pub sole: bool,
    /// Tasks of its pieces.
    pub from: u32,
    pub to: u32,
    pub weight: Weight<T>,
}

/// A product of factors of one coordinate each, with their derivatives.
#[derive(Clone, Copy)]
pub(super) struct Weight<T> {
    pub f: [T; MOST_VARIABLES],
    pub d: [T; MOST_VARIABLES],
    pub dd: [T; MOST_VARIABLES],
}

impl<T: Real> Flat<T> {
    /// `None` where it is 0; see `super::weight`, which this repeats with second derivatives.
    #[inline(always)]
    pub(super) fn weight(&self, cell: usize, z: &[T]) -> Option<Weight<T>> {
        let n = z.len();
        let (zero, one) = (T::of(0.0), T::of(1.0));
        let place = &self.cells[cell * 2 * n..][..2 * n];
        let (edge, overlap) = (T::of(1.0 - BLEND), T::of(2.0 * BLEND));
        let mut w = Weight {
            f: [one; MOST_VARIABLES],
            d: [zero; MOST_VARIABLES],
            dd: [zero; MOST_VARIABLES],
        };
        for i in 0..n {
            let half = place[n + i];
            let offset = (z[i] - place[i]) / half;
            let t = (offset.absolute() - edge) / overlap;
            if t >= one {
                return None;
            }
            if t > zero {
                let rest = one - t;
                let sign = if offset < zero { -one } else { one };
                let scale = overlap * half;
                w.f[i] = one - t * t * t * (T::of(10.0) - T::of(15.0) * t + T::of(6.0) * t * t);
                w.d[i] = T::of(-30.0) * t * t * rest * rest * sign / scale;
                w.dd[i] = T::of(-60.0) * t * rest * (rest - t) / (scale * scale);
            }
        }
        Some(w)
    }

    /// The lowest sheet's blend; false where nothing is known.
    #[inline(always)]
    pub(super) fn blend(
        &self,
        place: &Place<T>,
        shares: &[Share<T>],
        told: &[PieceValue<T>],
        second: bool,
        here: &mut Here<T>,
    ) -> bool {
        let n = self.states;
        let zero = T::of(0.0);
        let Some(own) = shares.iter().find(|s| s.own) else {
            return false;
        };
        let mut sheets = 0;
        let mut first: Option<&PieceValue<T>> = None;
        for told in &told[own.from as usize..own.to as usize] {
            if told.v.is_finite() && told.v <= self.value_max {
                sheets += 1;
                if first.is_none_or(|f| told.v < f.v) {
                    first = Some(told);
                }
            }
        }
        let Some(first) = first else { return false };
        here.sheet = first.sheet;
        here.sheets = sheets;
        if shares.len() == 1 {
            here.pieces = 1;
            here.v = first.v;
            here.v_bound = first.v_bound;
            self.to_states(place, first.q, first.h, first.p_bound, second, here);
            return true;
        }
        // Around the first: the differences are small.
        let mut sums = Sums::<T>::zero();
        let (mut v_bound, mut p_bound) = (first.v_bound, first.p_bound);
        let mut pieces = 0;
        for share in shares {
            let best = if share.own {
                Some(first)
            } else {
                let mut best: Option<&PieceValue<T>> = None;
                for told in &told[share.from as usize..share.to as usize] {
                    let off = |t: &PieceValue<T>| (t.v - first.v).absolute();
                    if told.v.is_finite() && best.is_none_or(|b| off(told) < off(b)) {
                        best = Some(told);
                    }
                }
                // The piece of the same sheet, if the neighbour has one.
                best.filter(|told| {
                    let alone = own.sole && share.sole;
                    alone
                        || (told.v - first.v).absolute()
                            <= T::of(SAME) * (told.v_bound + first.v_bound)
                })
            };
            let Some(told) = best else { continue };
            sums.add(n, &share.weight, told, first, second);
            v_bound = if told.v_bound > v_bound {
                told.v_bound
            } else {
                v_bound
            };
            for i in 0..n {
                p_bound[i] = if told.p_bound[i] > p_bound[i] {
                    told.p_bound[i]
                } else {
                    p_bound[i]
                };
            }
            pieces += 1;
        }
        here.pieces = pieces.max(1);
        let (mut q, mut h) = (first.q, first.h);
        let mut blend = zero;
        if sums.w > zero {
            blend = sums.b / sums.w;
            let mut slope = [zero; MOST_VARIABLES];
            for i in 0..n {
                slope[i] = (sums.db[i] - blend * sums.dw[i]) / sums.w;
                q[i] = first.q[i] + slope[i];
            }
            if second {
                let mut pair = 0;
                for i in 0..n {
                    for j in i..n {
                        let cross = slope[i] * sums.dw[j] + slope[j] * sums.dw[i];
                        h[pair] = first.h[pair]
                            + (sums.ddb[pair] - cross - blend * sums.ddw[pair]) / sums.w;
                        pair += 1;
                    }
                }
            }
        }
        here.v = first.v + blend;
        here.v_bound = v_bound;
        self.to_states(place, q, h, p_bound, second, here);
        true
    }

    /// Derivatives by states of those by coordinates of the frame.
    #[inline(always)]
    fn to_states(
        &self,
        place: &Place<T>,
        mut q: [T; MOST_VARIABLES],
        mut h: [T; MOST_SECOND],
        mut p_bound: [T; MOST_VARIABLES],
        second: bool,
        here: &mut Here<T>,
    ) {
        let n = self.states;
        let zero = T::of(0.0);
        if let Some(shear) = &self.shear {
            shear.straighten(n, place, &mut q, &mut h, &mut p_bound, second);
        }
        let add = |sum: &mut T, factor: T, of: &T| *sum = *sum + factor * *of;
        by_states(n, &self.matrix, zero, add, &mut q, second.then_some(&mut h));
        here.p = q;
        if second {
            here.bent(n, |pair| h[pair]);
        }
        for j in 0..n {
            here.p_bound[j] = (0..n).fold(zero, |sum, i| {
                sum + (self.matrix[i * n + j] * p_bound[i]).absolute()
            });
        }
    }
}

/// Sums over the pieces that are blended: of weights w, and of weights times what a piece says more
/// than the first.
struct Sums<T> {
    w: T,
    dw: [T; MOST_VARIABLES],
    ddw: [T; MOST_SECOND],
    b: T,
    db: [T; MOST_VARIABLES],
    ddb: [T; MOST_SECOND],
}

impl<T: Real> Sums<T> {
    fn zero() -> Self {
        let zero = T::of(0.0);
        Self {
            w: zero,
            dw: [zero; MOST_VARIABLES],
            ddw: [zero; MOST_SECOND],
            b: zero,
            db: [zero; MOST_VARIABLES],
            ddb: [zero; MOST_SECOND],
        }
    }

    #[inline(always)]
    fn add(
        &mut self,
        n: usize,
        weight: &Weight<T>,
        told: &PieceValue<T>,
        first: &PieceValue<T>,
        second: bool,
    ) {
        let one = T::of(1.0);
        let Weight { f, d, dd } = weight;
        let but = |skip: [usize; 2]| {
            (0..n)
                .filter(|k| !skip.contains(k))
                .fold(one, |product, k| product * f[k])
        };
        let w = (0..n).fold(one, |product, k| product * f[k]);
        let more = told.v - first.v;
        let mut dw = [T::of(0.0); MOST_VARIABLES];
        self.w = self.w + w;
        self.b = self.b + w * more;
        for i in 0..n {
            // Most factors are 1 around a state.
            if d[i] != T::of(0.0) {
                dw[i] = d[i] * but([i, i]);
            }
            self.dw[i] = self.dw[i] + dw[i];
            self.db[i] = self.db[i] + (w * (told.q[i] - first.q[i]) + dw[i] * more);
        }
        if !second {
            return;
        }
        let mut pair = 0;
        for i in 0..n {
            for j in i..n {
                let ddw = match i == j {
                    true if dd[i] == T::of(0.0) => dd[i],
                    true => dd[i] * but([i, i]),
                    false if d[i] == T::of(0.0) || d[j] == T::of(0.0) => T::of(0.0),
                    false => d[i] * d[j] * but([i, j]),
                };
                let cross = dw[i] * (told.q[j] - first.q[j]) + dw[j] * (told.q[i] - first.q[i]);
                self.ddw[pair] = self.ddw[pair] + ddw;
                self.ddb[pair] =
                    self.ddb[pair] + (w * (told.h[pair] - first.h[pair]) + cross + ddw * more);
                pair += 1;
            }
        }
    }
}
