//! The shear of a frame, and derivatives through it.

use super::LANES;
use crate::backend::cpu::lanes::Lanes;
use crate::backend::cpu::real::Real;
use crate::map::pieces::jets::{Jet, MOST_SECOND, Sum, Tables};
use crate::map::pieces::{Bend, MOST_VARIABLES};

/// Along one axis `(t + phi(the other coordinates) - lowest) / width`; see [`Bend`].
#[derive(Clone, Debug)]
pub(super) struct Shear<T> {
    axis: usize,
    lowest: T,
    width: T,
    /// Of phi, a polynomial of the other coordinates: one variable less than states.
    tables: Tables,
    degree: usize,
    /// Of divided powers, the same in all lanes.
    phi: Vec<Lanes<T, LANES>>,
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
            phi: scaled.map(|(c, scale)| Lanes::splat(T::of(c * scale))).collect(),
            tables,
        }
    }

    /// The sheared coordinate of some places, one a lane; and phi there, through whose derivatives [`Self::straighten`] goes.
    #[inline(always)]
    pub fn bend<const FMA: bool>(
        &self,
        n: usize,
        places: &mut [[T; MOST_VARIABLES]],
        second: bool,
        monomials: &mut [Lanes<T, LANES>],
    ) -> Jet<T, LANES> {
        let mut phi = Jet::zero();
        let mut y = [Lanes::splat(T::of(0.0)); MOST_VARIABLES];
        for (l, z) in places.iter().enumerate() {
            for (k, i) in (0..n).filter(|i| *i != self.axis).enumerate() {
                y[k].0[l] = z[i];
            }
        }
        Sum {
            tables: &self.tables,
            degree: self.degree,
            coefficients: &self.phi,
            monomials,
        }
        .at::<FMA>(n - 1, &y, second, &mut phi);
        for (l, z) in places.iter_mut().enumerate() {
            z[self.axis] = (z[self.axis] + phi.v.0[l] - self.lowest) / self.width;
        }
        phi
    }

    /// Derivatives, and bounds of the first, by the coordinates without the shear, at the place in a lane of phi.
    #[inline(always)]
    pub fn straighten(
        &self,
        n: usize,
        (phi, l): (&Jet<T, LANES>, usize),
        q: &mut [T; MOST_VARIABLES],
        h: &mut [T; MOST_SECOND],
        bound: &mut [T; MOST_VARIABLES],
        second: bool,
    ) {
        let zero = T::of(0.0);
        let a = self.axis;
        let mut slope = [zero; MOST_VARIABLES];
        for (k, i) in (0..n).filter(|i| *i != a).enumerate() {
            slope[i] = phi.q[k].0[l];
        }
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
        // J'hJ and what the curvature of phi adds, where J is the identity but for its row of the axis.
        let mut row = [zero; MOST_VARIABLES];
        for i in 0..n {
            row[i] = if i == a { T::of(1.0) } else { slope[i] } / self.width;
        }
        let old = *h;
        let at = |i: usize, j: usize| -> T {
            let (i, j) = if i < j { (i, j) } else { (j, i) };
            old[i * n - i * (i + 1) / 2 + j]
        };
        let (mut pair, mut curved) = (0, 0);
        for i in 0..n {
            for j in i..n {
                let mut sum = row[i] * row[j] * at(a, a);
                if i != a && j != a {
                    sum = sum + steep * phi.h[curved].0[l] + at(i, j);
                    curved += 1;
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
