//! V, p and second derivatives at many states: the local solution about the equilibrium and the map
//! in pieces, as flat arrays.

#[cfg(feature = "gpu")]
mod packed;

#[cfg(feature = "gpu")]
pub(crate) use packed::Packed;

use super::pieces::{
    Desk, Flat, Here, Jet, LANES, MOST_DEGREE, MOST_VARIABLES, Pieces, Sum, Tables, Terms,
    by_states,
};
use crate::backend::cpu::Simd;
use crate::backend::cpu::lanes::Lanes;
use crate::backend::cpu::real::Real;
use crate::local::{LocalErrors, LocalSolution};
use crate::sweep::Plan;

/// Periods by which a coordinate must move to lie between bounds, if it can; 0 where it does. A
/// winding number holds as many.
pub(super) fn turns_into<T: Real>(x: T, [lo, hi]: [T; 2], period: T) -> f64 {
    const MOST: f64 = 1e9;
    if x < lo || x > hi {
        ((lo - x) / period).f64().ceil().clamp(-MOST, MOST)
    } else {
        0.0
    }
}

/// Takes whole periods off a deviation, and adds them to the size of the numbers that it is a
/// difference of; how many they are.
#[inline(always)]
pub(super) fn unwind<T: Real>(s: &mut T, size: &mut f64, period: T) -> f64 {
    let turns = (*s / period).f64().round();
    *s = *s - T::of(turns) * period;
    // A multiple of a rounded period, and its product.
    *size += 3.0 * (turns * period.f64()).abs();
    turns
}

/// What is known of a state.
pub enum Answer<'a, T> {
    Known(&'a Here<T>),
    /// Outside the region, and too uncertain to be told as V; a law does better with it than with
    /// nothing.
    Rough(&'a Here<T>),
    /// In the region, but nothing is known there.
    Unknown,
    /// Outside the region of the pieces, and those round it do not know either: others may.
    Elsewhere,
}

/// Takes what is known of states, with their numbers.
type Tell<'t, T> = &'t mut dyn FnMut(usize, Answer<'_, T>);

/// The maps that are asked, one after the other.
#[derive(Clone, Copy, PartialEq)]
enum Map {
    Region,
    Beyond,
    Rough,
}

/// Both, for states with the same periods.
pub struct Swift<T> {
    around: Option<Around<T>>,
    flat: Flat<T>,
    /// Of use outside the region of the first; what is rough is not blended with what is not.
    beyond: Option<Flat<T>>,
    /// The same with its rough pieces, of use where it knows nothing.
    rough: Option<Flat<T>>,
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
    errors: LocalErrors,
}

/// Room to work in.
pub struct Room<T> {
    desk: Desk<T>,
    near: Vec<u32>,
    /// `[state][coordinate]`.
    z: Vec<T>,
    /// `[state][deviation, size of what it is a difference of][component]`.
    deviations: Vec<f64>,
    inside: Vec<u32>,
    x: Vec<T>,
    /// The same of those outside the region, and coordinates there.
    outside: Vec<u32>,
    far: Vec<T>,
    /// Of these (by their order among them) those that only rough pieces may know, and their
    /// coordinates.
    missed: Vec<u32>,
    missed_at: Vec<T>,
    monomials: Vec<Lanes<T, LANES>>,
}

impl<T: Real> Room<T> {
    pub fn new() -> Self {
        Self {
            desk: Desk::new(),
            near: Vec::new(),
            z: Vec::new(),
            deviations: Vec::new(),
            inside: Vec::new(),
            x: Vec::new(),
            outside: Vec::new(),
            far: Vec::new(),
            missed: Vec::new(),
            missed_at: Vec::new(),
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
    pub fn new(
        pieces: &Pieces,
        [beyond, rough]: [Option<&Pieces>; 2],
        plan: &Plan,
    ) -> Option<Self> {
        let around = match &plan.local {
            Some(local) => Some(Around::new(local, &plan.system.reference)?),
            None => None,
        };
        let of = |i: usize, period: f64| {
            let bounds = [pieces.region.lo[i], pieces.region.hi[i]].map(T::of);
            (i, T::of(period), bounds)
        };
        Some(Self {
            around,
            flat: Flat::new(pieces),
            beyond: beyond.map(Flat::new),
            rough: rough.map(Flat::new),
            // Time is a coordinate of its own.
            reference: (plan
                .system
                .reference
                .iter()
                .copied()
                .chain([0.0])
                .take(pieces.states()))
            .map(T::of)
            .collect(),
            periods: (plan.periods.iter().enumerate())
                .filter_map(|(i, period)| Some(of(i, (*period)?)))
                .collect(),
            simd: Simd::detect(),
        })
    }

    /// What is known at states (absolute), told with their numbers in some order; second
    /// derivatives only where asked for.
    ///
    /// The code behind it is large and compiled for three instruction sets: it is the same whatever
    /// `tell` is.
    pub fn each(
        &self,
        x: &[T],
        second: bool,
        room: &mut Room<T>,
        mut tell: impl FnMut(usize, Answer<'_, T>),
    ) {
        match self.simd {
            Simd::Baseline => baseline(self, x, second, room, &mut tell),
            // SAFETY: the features were detected.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => unsafe { avx2(self, x, second, room, &mut tell) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => unsafe { avx512(self, x, second, room, &mut tell) },
            #[cfg(not(target_arch = "x86_64"))]
            Simd::Neon => self.all::<true>(x, second, room, &mut tell),
        }
    }

    #[inline(always)]
    fn all<const FMA: bool>(&self, x: &[T], second: bool, room: &mut Room<T>, tell: Tell<'_, T>) {
        let n = self.reference.len();
        room.near.clear();
        room.z.clear();
        room.deviations.clear();
        room.inside.clear();
        room.x.clear();
        room.outside.clear();
        room.far.clear();
        room.missed.clear();
        room.missed_at.clear();
        for (k, x) in x.chunks_exact(n).enumerate() {
            if self.is_near(x, &mut room.z, &mut room.deviations) {
                room.near.push(k as u32);
                continue;
            }
            let mut moved = [T::of(0.0); MOST_VARIABLES];
            moved[..n].copy_from_slice(x);
            for (i, period, bounds) in &self.periods {
                moved[*i] = x[*i] + T::of(turns_into(x[*i], *bounds, *period)) * *period;
            }
            if self.flat.covers(&moved[..n]) {
                room.inside.push(k as u32);
                room.x.extend_from_slice(&moved[..n]);
            } else if self.beyond.is_some() {
                room.outside.push(k as u32);
                room.far.extend_from_slice(&moved[..n]);
            } else {
                tell(k, Answer::Elsewhere);
            }
        }
        let Room {
            desk,
            near,
            z,
            deviations,
            inside,
            x,
            outside,
            far,
            missed,
            missed_at,
            monomials,
        } = room;
        if let Some(around) = &self.around {
            around.each::<FMA>(n, (z, deviations), second, monomials, |k, here| {
                tell(near[k] as usize, Answer::Known(here));
            });
        }
        // One call for the three maps: what it calls is inlined here.
        for map in [Map::Region, Map::Beyond, Map::Rough] {
            let (flat, at): (_, &[T]) = match map {
                Map::Region => (Some(&self.flat), x),
                Map::Beyond => (self.beyond.as_ref(), far),
                Map::Rough => (self.rough.as_ref(), missed_at),
            };
            let Some(flat) = flat else {
                let unknown = missed.iter().filter(|_| map == Map::Rough);
                unknown.for_each(|k| tell(outside[*k as usize] as usize, Answer::Elsewhere));
                continue;
            };
            flat.each::<FMA>(at, second, desk, |k, here| match (map, here) {
                (Map::Region, here) => tell(
                    inside[k] as usize,
                    here.map_or(Answer::Unknown, Answer::Known),
                ),
                (Map::Beyond, Some(here)) => tell(outside[k] as usize, Answer::Known(here)),
                (Map::Beyond, None) => missed.push(k as u32),
                (Map::Rough, here) => {
                    let number = outside[missed[k] as usize] as usize;
                    tell(number, here.map_or(Answer::Elsewhere, Answer::Rough));
                }
            });
            if map == Map::Beyond {
                let missed = missed.iter().map(|k| &far[*k as usize * n..][..n]);
                missed.for_each(|at| missed_at.extend_from_slice(at));
            }
        }
    }

    /// Whether the local solution holds at a state; then its coordinates are added, and what their
    /// errors are told by.
    #[inline(always)]
    fn is_near(&self, x: &[T], z: &mut Vec<T>, deviations: &mut Vec<f64>) -> bool {
        let Some(around) = &self.around else {
            return false;
        };
        let n = x.len();
        let mut s = [T::of(0.0); MOST_VARIABLES];
        for i in 0..n {
            s[i] = x[i] - self.reference[i];
        }
        let mut sizes = s.map(|s| s.f64().abs());
        for (i, period, _) in &self.periods {
            unwind(&mut s[*i], &mut sizes[*i], *period);
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
            deviations.extend(s[..n].iter().map(|s| s.f64()));
            deviations.extend_from_slice(&sizes[..n]);
        }
        near
    }
}

impl<T: Real> Around<T> {
    fn new(local: &LocalSolution, reference: &[f64]) -> Option<Self> {
        let polynomial = local.polynomial(reference);
        let degree = polynomial.degree;
        if degree > MOST_DEGREE {
            return None;
        }
        // Monomials are in the same order.
        let tables = Tables::new(&Terms::new(reference.len(), degree));
        Some(Self {
            degree,
            coefficients: (polynomial.coefficients.iter().zip(&tables.scale))
                .map(|(c, scale)| Lanes::splat(T::of(c * scale)))
                .collect(),
            matrix: polynomial.matrix.iter().map(|m| T::of(*m)).collect(),
            seed_value: T::of(polynomial.reach),
            errors: LocalErrors::new(local),
            tables,
        })
    }

    #[inline(always)]
    fn each<const FMA: bool>(
        &self,
        n: usize,
        (z, deviations): (&[T], &[f64]),
        second: bool,
        monomials: &mut Vec<Lanes<T, LANES>>,
        mut tell: impl FnMut(usize, &Here<T>),
    ) {
        let mut of_p = [0.0; MOST_VARIABLES];
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
            self.to_states::<FMA>(n, second, &mut jet);
            for l in 0..places.len() / n {
                let (s, sizes) = deviations[(group * LANES + l) * 2 * n..][..2 * n].split_at(n);
                here.v = jet.v.0[l];
                here.v_bound = T::of(self.errors.at(s, sizes, 0.5 * T::EPSILON, &mut of_p[..n]));
                for j in 0..n {
                    here.p[j] = jet.q[j].0[l];
                    here.p_bound[j] = T::of(of_p[j]);
                }
                if second {
                    here.bent(n, |pair| jet.h[pair].0[l]);
                }
                tell(group * LANES + l, &here);
            }
        }
    }

    /// Derivatives by states: Lq, and LhL' (its triangle).
    #[inline(always)]
    fn to_states<const FMA: bool>(&self, n: usize, second: bool, jet: &mut Jet<T, LANES>) {
        let zero = Lanes::splat(T::of(0.0));
        let add = |sum: &mut Lanes<T, LANES>, factor: T, of: &Lanes<T, LANES>| {
            for l in 0..LANES {
                sum.0[l] = factor.mul_add::<FMA>(of.0[l], sum.0[l]);
            }
        };
        let Jet { q, h, .. } = jet;
        by_states(n, &self.matrix, zero, add, q, second.then_some(h));
    }
}

fn baseline<T: Real>(
    this: &Swift<T>,
    x: &[T],
    second: bool,
    room: &mut Room<T>,
    tell: Tell<'_, T>,
) {
    this.all::<false>(x, second, room, tell);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2<T: Real>(this: &Swift<T>, x: &[T], second: bool, room: &mut Room<T>, tell: Tell<'_, T>) {
    this.all::<true>(x, second, room, tell);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
fn avx512<T: Real>(this: &Swift<T>, x: &[T], second: bool, room: &mut Room<T>, tell: Tell<'_, T>) {
    this.all::<true>(x, second, room, tell);
}
