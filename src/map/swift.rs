//! V, p and second derivatives at many states: the local solution about the equilibrium and the map in pieces, as flat arrays.

use super::pieces::{Desk, Flat, Here, Jet, LANES, MOST_DEGREE, MOST_VARIABLES, Pieces, Sum, Tables, Terms};
use crate::backend::cpu::Simd;
use crate::backend::cpu::lanes::Lanes;
use crate::backend::cpu::real::Real;
use crate::sweep::Plan;
use std::collections::BTreeMap;

/// What is known of a state.
pub enum Answer<'a, T> {
    Known(&'a Here<T>),
    /// In the region, but nothing is known there.
    Unknown,
    /// Outside the region of the pieces: others may know.
    Elsewhere,
}

/// Both, for states with the same periods.
pub struct Swift<T> {
    around: Option<Around<T>>,
    flat: Flat<T>,
    reference: Vec<T>,
    /// Period, and lower and upper bound of the region, of each state that has one.
    periods: Vec<(usize, T, [T; 2])>,
    simd: Simd,
}

/// The local solution: V is a polynomial of `z = L's`.
struct Around<T> {
    tables: Tables,
    degree: usize,
    /// Of divided powers, the same in all lanes.
    coefficients: Vec<Lanes<T, LANES>>,
    /// `[coordinate][state]`: L'.
    matrix: Vec<T>,
    /// `z'z/2` up to which it holds.
    seed_value: T,
    /// Degrees and sizes of the parts of V not kept.
    neglected: Vec<(i32, T)>,
}

/// Room to work in.
pub struct Room<T> {
    desk: Desk<T>,
    near: Vec<u32>,
    /// `[state][coordinate]`.
    z: Vec<T>,
    inside: Vec<u32>,
    x: Vec<T>,
    monomials: Vec<Lanes<T, LANES>>,
}

impl<T: Real> Room<T> {
    pub fn new() -> Self {
        Self {
            desk: Desk::new(),
            near: Vec::new(),
            z: Vec::new(),
            inside: Vec::new(),
            x: Vec::new(),
            monomials: Vec::new(),
        }
    }
}

impl<T: Real> Default for Room<T> {
    fn default() -> Self {
        Self::new()
    }
}

impl<T: Real> Swift<T> {
    /// `None` where the local solution is a polynomial of too high a degree.
    pub fn new(pieces: &Pieces, plan: &Plan) -> Option<Self> {
        let n = pieces.states();
        let around = match &plan.local {
            Some(local) => Some(Around::new(n, local)?),
            None => None,
        };
        let of = |i: usize, period: f64| {
            let bounds = [pieces.region.lo[i], pieces.region.hi[i]].map(T::of);
            (i, T::of(period), bounds)
        };
        Some(Self {
            around,
            flat: Flat::new(pieces, &vec![0.0; n]),
            // Time is a coordinate of its own.
            reference: (plan.system.reference.iter().copied().chain([0.0]).take(n))
                .map(T::of)
                .collect(),
            periods: (plan.periods.iter().enumerate())
                .filter_map(|(i, period)| Some(of(i, (*period)?)))
                .collect(),
            simd: Simd::detect(),
        })
    }

    /// What is known at states (absolute), told with their numbers in some order; second derivatives only where asked for.
    pub fn each(&self, x: &[T], second: bool, room: &mut Room<T>, tell: impl FnMut(usize, Answer<'_, T>)) {
        match self.simd {
            Simd::Baseline => self.all::<false>(x, second, room, tell),
            // SAFETY: the features were detected.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => unsafe { avx2(self, x, second, room, tell) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => unsafe { avx512(self, x, second, room, tell) },
        }
    }

    #[inline(always)]
    fn all<const FMA: bool>(
        &self,
        x: &[T],
        second: bool,
        room: &mut Room<T>,
        mut tell: impl FnMut(usize, Answer<'_, T>),
    ) {
        let n = self.reference.len();
        room.near.clear();
        room.z.clear();
        room.inside.clear();
        room.x.clear();
        for (k, x) in x.chunks_exact(n).enumerate() {
            if self.is_near(x, &mut room.z) {
                room.near.push(k as u32);
                continue;
            }
            let mut moved = [T::of(0.0); MOST_VARIABLES];
            moved[..n].copy_from_slice(x);
            for (i, period, [lo, hi]) in &self.periods {
                if x[*i] < *lo || x[*i] > *hi {
                    let turns = ((*lo - x[*i]) / *period).f64().ceil();
                    moved[*i] = x[*i] + T::of(turns.clamp(-1e9, 1e9)) * *period;
                }
            }
            if self.flat.covers(&moved[..n]) {
                room.inside.push(k as u32);
                room.x.extend_from_slice(&moved[..n]);
            } else {
                tell(k, Answer::Elsewhere);
            }
        }
        let Room {
            desk,
            near,
            z,
            inside,
            x,
            monomials,
        } = room;
        if let Some(around) = &self.around {
            around.each::<FMA>(n, z, second, monomials, |k, here| {
                tell(near[k] as usize, Answer::Known(here));
            });
        }
        self.flat.each::<FMA>(x, second, desk, |k, here| {
            tell(inside[k] as usize, here.map_or(Answer::Unknown, Answer::Known));
        });
    }

    /// Whether the local solution holds at a state; then its coordinates are added.
    #[inline(always)]
    fn is_near(&self, x: &[T], z: &mut Vec<T>) -> bool {
        let Some(around) = &self.around else { return false };
        let n = x.len();
        let mut s = [T::of(0.0); MOST_VARIABLES];
        for i in 0..n {
            s[i] = x[i] - self.reference[i];
        }
        for (i, period, _) in &self.periods {
            s[*i] = s[*i] - T::of((s[*i] / *period).f64().round()) * *period;
        }
        let mut own = [T::of(0.0); MOST_VARIABLES];
        let mut square = T::of(0.0);
        for i in 0..n {
            for j in 0..n {
                own[i] = own[i] + around.matrix[i * n + j] * s[j];
            }
            square = square + own[i] * own[i];
        }
        // The negation of `above`: what is not a number is not near.
        let near = T::of(0.5) * square <= around.seed_value;
        if near {
            z.extend_from_slice(&own[..n]);
        }
        near
    }
}

impl<T: Real> Around<T> {
    fn new(n: usize, local: &crate::local::LocalSolution) -> Option<Self> {
        let degree = local.degree;
        if degree > MOST_DEGREE {
            return None;
        }
        let terms = Terms::new(n, degree);
        let tables = Tables::new(&terms);
        let by_powers: BTreeMap<&[u8], f64> = local.terms().collect();
        let matrix = local.coordinates();
        Some(Self {
            degree,
            coefficients: (0..terms.factors.len())
                .map(|t| {
                    let c = by_powers.get(terms.powers_of(t)).copied().unwrap_or(0.0);
                    Lanes::splat(T::of(c * tables.scale[t]))
                })
                .collect(),
            matrix: (0..n * n).map(|k| T::of(matrix[(k / n, k % n)])).collect(),
            seed_value: T::of(local.seed_value),
            neglected: local.neglected().iter().map(|(k, size)| (*k, T::of(*size))).collect(),
            tables,
        })
    }

    #[inline(always)]
    fn each<const FMA: bool>(
        &self,
        n: usize,
        z: &[T],
        second: bool,
        monomials: &mut Vec<Lanes<T, LANES>>,
        mut tell: impl FnMut(usize, &Here<T>),
    ) {
        let zero = T::of(0.0);
        monomials.resize(self.coefficients.len(), Lanes::splat(zero));
        let mut jet = Jet::zero();
        let mut here = Here::blank();
        here.sheets = 1;
        for (group, places) in z.chunks(LANES * n).enumerate() {
            let mut y = [Lanes::splat(zero); MOST_VARIABLES];
            for (l, place) in places.chunks_exact(n).enumerate() {
                for i in 0..n {
                    y[i].0[l] = place[i];
                }
            }
            Sum {
                tables: &self.tables,
                degree: self.degree,
                coefficients: &self.coefficients,
                monomials,
            }
            .at::<FMA>(n, &y, second, &mut jet);
            for (l, place) in places.chunks_exact(n).enumerate() {
                here.v = jet.v.0[l];
                self.finish(n, place, &jet, l, second, &mut here);
                tell(group * LANES + l, &here);
            }
        }
    }

    /// Derivatives by states, and the error.
    #[inline(always)]
    fn finish(&self, n: usize, z: &[T], jet: &Jet<T, LANES>, l: usize, second: bool, here: &mut Here<T>) {
        let zero = T::of(0.0);
        let m = |i: usize, j: usize| self.matrix[i * n + j];
        let square = z.iter().fold(zero, |sum, z| sum + *z * *z);
        let radius = square.root();
        here.v_bound = zero;
        for (degree, size) in &self.neglected {
            let error = (0..*degree).fold(*size, |product, _| product * radius);
            here.v_bound = if error > here.v_bound { error } else { here.v_bound };
        }
        for j in 0..n {
            let mut p = zero;
            for i in 0..n {
                p = p + m(i, j) * jet.q[i].0[l];
            }
            here.p[j] = p;
        }
        if !second {
            return;
        }
        let mut half = [[zero; MOST_VARIABLES]; MOST_VARIABLES];
        let mut pair = 0;
        for i in 0..n {
            for k in i..n {
                let h = jet.h[pair].0[l];
                for j in 0..n {
                    half[i][j] = half[i][j] + h * m(k, j);
                    if k != i {
                        half[k][j] = half[k][j] + h * m(i, j);
                    }
                }
                pair += 1;
            }
        }
        for a in 0..n {
            for b in 0..n {
                let mut sum = zero;
                for i in 0..n {
                    sum = sum + m(i, a) * half[i][b];
                }
                here.hessian[a * n + b] = sum;
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2<T: Real>(this: &Swift<T>, x: &[T], second: bool, room: &mut Room<T>, tell: impl FnMut(usize, Answer<'_, T>)) {
    this.all::<true>(x, second, room, tell);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
fn avx512<T: Real>(this: &Swift<T>, x: &[T], second: bool, room: &mut Room<T>, tell: impl FnMut(usize, Answer<'_, T>)) {
    this.all::<true>(x, second, room, tell);
}
