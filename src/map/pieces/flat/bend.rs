//! The shear of a frame, and derivatives through it.

use crate::backend::cpu::lanes::Lanes;
use crate::backend::cpu::real::Real;
use crate::map::pieces::jets::{Jet, MOST_SECOND, Sum, Tables};
use crate::map::pieces::{Bend, LANES, MOST_VARIABLES};
#[cfg(feature = "gpu")]
use crate::map::swift::Packed;

/// Along one axis `(t + phi(the other coordinates) - lowest) / width`; see [`Bend`].
#[derive(Clone, Debug)]
pub(super) struct Shear<T> {
    axis: usize,
    lowest: T,
    width: T,
    tables: Tables,
    degree: usize,
    /// Of phi by divided powers, the same in all lanes.
    phi: Vec<Lanes<T, LANES>>,
}

/// A place in coordinates of the frame, with first and second derivatives of phi by all of them
/// where there is a shear.
#[derive(Clone, Copy)]
pub(super) struct Place<T> {
    pub z: [T; MOST_VARIABLES],
    slope: [T; MOST_VARIABLES],
    curvature: [T; MOST_SECOND],
}

impl<T: Real> Place<T> {
    pub fn zero() -> Self {
        let zero = T::of(0.0);
        Self {
            z: [zero; MOST_VARIABLES],
            slope: [zero; MOST_VARIABLES],
            curvature: [zero; MOST_SECOND],
        }
    }
}

impl<T: Real> Shear<T> {
    pub fn new(bend: &Bend) -> Self {
        let tables = Tables::new(bend.terms());
        let scaled = bend.phi.iter().zip(&tables.scale);
        Self {
            axis: bend.axis,
            lowest: T::of(bend.lowest),
            width: T::of(bend.width),
            degree: tables.upto.len() - 1,
            phi: scaled.map(|(c, s)| Lanes::splat(T::of(c * s))).collect(),
            tables,
        }
    }

    /// Number of monomials of phi.
    pub fn terms(&self) -> usize {
        self.phi.len()
    }

    /// See `Flat::pack`.
    #[cfg(feature = "gpu")]
    pub fn pack(&self, to: &mut Packed) {
        to.condition("BEND");
        to.count("BEND_AXIS", self.axis);
        to.number("BEND_LOWEST", self.lowest.f64());
        to.number("BEND_WIDTH", self.width.f64());
        to.reals("PHI", self.phi.iter().map(|c| c.0[0].f64()));
        to.count("BEND_TERMS", self.phi.len());
        to.count("BEND_BELOW", self.tables.upto[self.degree - 1]);
        to.count("BEND_TWICE_BELOW", self.tables.upto[self.degree.max(2) - 2]);
        to.tables(
            [
                "BEND_UPTO",
                "BEND_FACTORS",
                "BEND_RAISED",
                "BEND_RAISED_TWICE",
            ],
            &self.tables,
        );
    }

    /// The sheared coordinate of some places, and phi's derivatives there.
    #[inline(always)]
    pub fn bend<const FMA: bool>(
        &self,
        n: usize,
        second: bool,
        monomials: &mut [Lanes<T, LANES>],
        places: &mut [Place<T>],
    ) {
        let zero = Lanes::splat(T::of(0.0));
        let a = self.axis;
        let others = || (0..n).filter(|i| *i != a);
        let mut jet = Jet::zero();
        for places in places.chunks_mut(LANES) {
            let mut y = [zero; MOST_VARIABLES];
            for (l, place) in places.iter().enumerate() {
                for (y, i) in y.iter_mut().zip(others()) {
                    y.0[l] = place.z[i];
                }
            }
            Sum {
                tables: &self.tables,
                degree: self.degree,
                coefficients: &self.phi,
                monomials,
            }
            .at::<FMA>(n - 1, &y, second, &mut jet);
            for (l, place) in places.iter_mut().enumerate() {
                place.z[a] = (place.z[a] + jet.v.0[l] - self.lowest) / self.width;
                for (q, i) in jet.q.iter().zip(others()) {
                    place.slope[i] = q.0[l];
                }
                if !second {
                    continue;
                }
                let (mut pair, mut own) = (0, 0);
                for i in 0..n {
                    for j in i..n {
                        if i != a && j != a {
                            place.curvature[pair] = jet.h[own].0[l];
                            own += 1;
                        }
                        pair += 1;
                    }
                }
            }
        }
    }

    /// Derivatives, and bounds of the first, by the coordinates without the shear.
    #[inline(always)]
    pub fn straighten(
        &self,
        n: usize,
        Place {
            slope, curvature, ..
        }: &Place<T>,
        q: &mut [T; MOST_VARIABLES],
        h: &mut [T; MOST_SECOND],
        bound: &mut [T; MOST_VARIABLES],
        second: bool,
    ) {
        let zero = T::of(0.0);
        let a = self.axis;
        let steep = q[a] / self.width;
        let uncertain = bound[a] / self.width;
        for i in (0..n).filter(|i| *i != a) {
            q[i] = q[i] + steep * slope[i];
            bound[i] = bound[i] + uncertain * slope[i].absolute();
        }
        q[a] = steep;
        bound[a] = uncertain;
        if !second {
            return;
        }
        // J'hJ and what the curvature of phi adds, where J is the identity but for its row of the
        // axis.
        let mut row = [zero; MOST_VARIABLES];
        for i in 0..n {
            row[i] = if i == a { T::of(1.0) } else { slope[i] } / self.width;
        }
        let old = *h;
        let at = |i: usize, j: usize| -> T {
            let (i, j) = if i < j { (i, j) } else { (j, i) };
            old[i * n - i * (i + 1) / 2 + j]
        };
        let mut pair = 0;
        for i in 0..n {
            for j in i..n {
                let mut sum = row[i] * row[j] * at(a, a) + steep * curvature[pair];
                if i != a && j != a {
                    sum = sum + at(i, j);
                }
                if i != a {
                    sum = sum + at(i, a) * row[j];
                }
                if j != a {
                    sum = sum + at(j, a) * row[i];
                }
                h[pair] = sum;
                pair += 1;
            }
        }
    }
}
