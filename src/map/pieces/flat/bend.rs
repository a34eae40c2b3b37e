//! The shear of a frame, and derivatives through it.

use crate::backend::cpu::real::Real;
use crate::map::pieces::jets::MOST_SECOND;
use crate::map::pieces::{Bend, MOST_VARIABLES};

/// Most monomials: those of degree 3 in five variables.
const MOST: usize = 56;

/// Along one axis `(t + phi(the other coordinates) - lowest) / width`; see [`Bend`].
#[derive(Clone, Debug)]
pub(super) struct Shear<T> {
    axis: usize,
    lowest: T,
    width: T,
    phi: Vec<T>,
    /// Of each monomial the earlier one and the coordinate that it is the product of.
    factors: Vec<(u16, u8)>,
}

impl<T: Real> Shear<T> {
    pub fn new(bend: &Bend, n: usize) -> Self {
        assert!(bend.phi.len() <= MOST && n <= MOST_VARIABLES);
        // In coordinates of the frame.
        let own = |other: u8| {
            if usize::from(other) < bend.axis {
                other
            } else {
                other + 1
            }
        };
        Self {
            axis: bend.axis,
            lowest: T::of(bend.lowest),
            width: T::of(bend.width),
            phi: bend.phi.iter().map(|c| T::of(*c)).collect(),
            factors: bend.factors().iter().map(|(k, i)| (*k, own(*i))).collect(),
        }
    }

    /// The sheared coordinate.
    #[inline(always)]
    pub fn bend(&self, z: &mut [T; MOST_VARIABLES]) {
        let mut monomials = [T::of(1.0); MOST];
        let mut phi = self.phi[0];
        for (term, (parent, axis)) in self.factors.iter().enumerate().skip(1) {
            monomials[term] = monomials[usize::from(*parent)] * z[usize::from(*axis)];
            phi = phi + self.phi[term] * monomials[term];
        }
        z[self.axis] = (z[self.axis] + phi - self.lowest) / self.width;
    }

    /// Derivatives, and bounds of the first, by the coordinates without the shear.
    #[inline(always)]
    pub fn straighten(
        &self,
        n: usize,
        z: &[T; MOST_VARIABLES],
        q: &mut [T; MOST_VARIABLES],
        h: &mut [T; MOST_SECOND],
        bound: &mut [T; MOST_VARIABLES],
        second: bool,
    ) {
        let zero = T::of(0.0);
        let a = self.axis;
        let (slope, curvature) = self.derivatives(n, z, second);
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

    /// First and second derivatives of phi.
    #[inline(always)]
    fn derivatives(&self, n: usize, z: &[T; MOST_VARIABLES], second: bool) -> ([T; MOST_VARIABLES], [T; MOST_SECOND]) {
        let zero = T::of(0.0);
        let mut monomials = [T::of(1.0); MOST];
        let mut slopes = [[zero; MOST_VARIABLES]; MOST];
        let (mut slope, mut curvature) = ([zero; MOST_VARIABLES], [zero; MOST_SECOND]);
        for (term, (parent, axis)) in self.factors.iter().enumerate().skip(1) {
            let (parent, axis) = (usize::from(*parent), usize::from(*axis));
            monomials[term] = monomials[parent] * z[axis];
            for i in 0..n {
                slopes[term][i] = slopes[parent][i] * z[axis];
            }
            slopes[term][axis] = slopes[term][axis] + monomials[parent];
            for i in 0..n {
                slope[i] = slope[i] + self.phi[term] * slopes[term][i];
            }
        }
        if second {
            let mut seconds = [[zero; MOST_SECOND]; MOST];
            for (term, (parent, axis)) in self.factors.iter().enumerate().skip(1) {
                let (parent, axis) = (usize::from(*parent), usize::from(*axis));
                let mut pair = 0;
                for i in 0..n {
                    for j in i..n {
                        let mut sum = seconds[parent][pair] * z[axis];
                        if i == axis {
                            sum = sum + slopes[parent][j];
                        }
                        if j == axis {
                            sum = sum + slopes[parent][i];
                        }
                        seconds[term][pair] = sum;
                        curvature[pair] = curvature[pair] + self.phi[term] * sum;
                        pair += 1;
                    }
                }
            }
        }
        (slope, curvature)
    }
}
