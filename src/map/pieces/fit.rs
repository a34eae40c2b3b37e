//! A polynomial fitted to V and p at scattered points, by weighted least squares.

use super::least_squares::{Equations, LANES, width};
use super::terms::{MOST_VARIABLES, Terms};

/// Equations of a group: it is left out by a system of so many.
const MOST_OF_GROUP: usize = 48;

/// The most points of one group that may be given for so many variables.
pub fn most_of_group(variables: usize) -> usize {
    MOST_OF_GROUP / (variables + 1)
}

/// What is a polynomial: V itself, or a function of it that is smoother where V falls or rises
/// steeply.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(i32)]
pub enum Shape {
    #[default]
    Value = 0,
    Root = 1,
    Logarithm = 2,
    Reciprocal = 3,
}

impl Shape {
    pub const ALL: [(Shape, &'static str); 4] = [
        (Shape::Value, "V"),
        (Shape::Root, "sqrt(V)"),
        (Shape::Logarithm, "log(V)"),
        (Shape::Reciprocal, "1/V"),
    ];

    /// The function and its derivative at V.
    pub fn of(self, v: f64) -> (f64, f64) {
        match self {
            Shape::Value => (v, 1.0),
            Shape::Root => (v.sqrt(), 0.5 / v.sqrt()),
            Shape::Logarithm => (v.ln(), 1.0 / v),
            Shape::Reciprocal => (1.0 / v, -1.0 / (v * v)),
        }
    }

    /// V and its derivative by the function. V is not a number where no V has this value of the
    /// function: a polynomial that crosses 0 comes to another branch.
    pub fn back(self, w: f64) -> (f64, f64) {
        match self {
            Shape::Root if w < 0.0 => (f64::NAN, f64::NAN),
            Shape::Reciprocal if w <= 0.0 => (f64::NAN, f64::NAN),
            Shape::Value => (w, 1.0),
            Shape::Root => (w * w, 2.0 * w),
            Shape::Logarithm => (w.exp(), w.exp()),
            Shape::Reciprocal => (1.0 / w, -1.0 / (w * w)),
        }
    }

    /// Whether it is one-to-one for these V.
    pub fn serves(self, least: f64) -> bool {
        self == Shape::Value || least > 0.0
    }
}

/// What errors of V are relative to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Scale {
    /// V at each point, and at least a floor.
    OfEach(f64),
    /// The same for all points of a cell. A polynomial errs by about as much all over its cell, so
    /// where V may be of either sign an error relative to V at some points would tell too little of
    /// places nearer to V = 0.
    OfAll(f64),
}

impl Scale {
    fn of(self, v: f64) -> f64 {
        match self {
            Self::OfEach(floor) => v.abs().max(floor),
            Self::OfAll(size) => size,
        }
    }
}

/// Points with V and its gradient in the coordinates of a cell.
pub struct Data<'d> {
    pub terms: &'d Terms,
    /// `[term][equation]`: for all points their monomials, then the slopes of these along each
    /// variable in turn.
    rows: Vec<f64>,
    stride: usize,
    v: Vec<f64>,
    /// `[variable][point]`.
    q: Vec<f64>,
    /// Size to which errors of V are relative.
    size: Vec<f64>,
    /// Points of one group are not independent of each other.
    group: Vec<u32>,
    /// Slopes along directions, whose equations come after those of the points.
    along: Vec<Along>,
    scale: Scale,
}

/// What is known of V's slope along a direction at a place.
#[derive(Clone, Debug)]
pub struct Along {
    /// In the variables of a cell.
    pub y: [f64; MOST_VARIABLES],
    /// The largest component is 1.
    pub direction: [f64; MOST_VARIABLES],
    /// By the length of the direction.
    pub slope: f64,
    /// The same by the piece that the direction is of, and V by it.
    pub said: f64,
    pub v: f64,
}

/// A polynomial, with the largest errors that points have of V and of its gradient, each group of
/// points left out of the fit in turn.
pub struct Tested {
    pub coefficients: Vec<f64>,
    pub errors: [f64; 2],
}

impl<'d> Data<'d> {
    /// For polynomials up to a degree: so many points, which `of` fills in (V, group; y and q in
    /// the slices given).
    pub fn new(
        terms: &'d Terms,
        degree: usize,
        scale: Scale,
        points: usize,
        of: impl Fn(usize, &mut [f64], &mut [f64]) -> (f64, u32),
    ) -> Self {
        let (n, count) = (terms.variables, terms.upto[degree]);
        let stride = ((n + 1) * points).max(1);
        let mut this = Self {
            terms,
            rows: vec![0.0; count * stride],
            stride,
            v: Vec::with_capacity(points),
            q: vec![0.0; n * points],
            size: Vec::with_capacity(points),
            group: Vec::with_capacity(points),
            along: Vec::new(),
            scale,
        };
        let mut at = vec![0.0; n * points];
        let (mut y, mut q) = (vec![0.0; n], vec![0.0; n]);
        for k in 0..points {
            let (v, group) = of(k, &mut y, &mut q);
            for i in 0..n {
                at[i * points + k] = y[i];
                this.q[i * points + k] = q[i];
            }
            this.v.push(v);
            this.size.push(scale.of(v));
            this.group.push(group);
        }
        this.rows[..points].fill(1.0);
        for term in 1..count {
            let (parent, axis) = terms.factors[term];
            let (parent, axis) = (usize::from(parent), usize::from(axis));
            let (before, own) = this.rows.split_at_mut(term * stride);
            let (from, y) = (
                &before[parent * stride..][..stride],
                &at[axis * points..][..points],
            );
            for block in (0..=n).filter(|_| points > 0) {
                let (own, from) = (
                    &mut own[block * points..][..points],
                    &from[block * points..][..points],
                );
                for k in 0..points {
                    own[k] = from[k] * y[k];
                }
            }
            for (own, from) in own[(1 + axis) * points..][..points].iter_mut().zip(from) {
                *own += from;
            }
        }
        this
    }

    /// With slopes along directions beside the points.
    pub fn with(self, along: Vec<Along>) -> Self {
        let n = self.terms.variables;
        let count = self.rows.len() / self.stride;
        let equations = (n + 1) * self.len();
        let wider = equations + along.len();
        let mut rows = vec![0.0; count * wider];
        for (own, from) in rows.chunks_mut(wider).zip(self.rows.chunks(self.stride)) {
            own[..equations].copy_from_slice(&from[..equations]);
        }
        let (mut values, mut slopes) = (vec![0.0; count], vec![0.0; n * count]);
        for (k, one) in along.iter().enumerate() {
            self.terms.at(&one.y[..n], &mut values, &mut slopes);
            for term in 0..count {
                rows[term * wider + equations + k] = (0..n)
                    .map(|i| one.direction[i] * slopes[i * count + term])
                    .sum();
            }
        }
        Self {
            rows,
            stride: wider,
            along,
            ..self
        }
    }

    pub fn len(&self) -> usize {
        self.v.len()
    }

    pub fn least(&self) -> f64 {
        self.v.iter().copied().fold(f64::INFINITY, f64::min)
    }

    /// The equations of a shape, weighted by what an error of each means for V; and the weights,
    /// one a point.
    fn equations(&self, shape: Shape, count: usize) -> (Equations, Vec<f64>) {
        let (n, points) = (self.terms.variables, self.len());
        let equations = (n + 1) * points + self.along.len();
        let mut right = vec![0.0; equations];
        let mut weights = vec![0.0; equations];
        for k in 0..points {
            let (w, slope) = shape.of(self.v[k]);
            weights[k] = 1.0 / (self.size[k] * slope.abs());
            right[k] = weights[k] * w;
            for i in 0..n {
                weights[(1 + i) * points + k] = weights[k];
                right[(1 + i) * points + k] = weights[k] * slope * self.q[i * points + k];
            }
        }
        for (k, one) in self.along.iter().enumerate() {
            let (_, slope) = shape.of(one.v);
            let at = (n + 1) * points + k;
            weights[at] = 1.0 / (self.scale.of(one.v) * slope.abs());
            right[at] = weights[at] * slope * one.slope;
        }

        // From rows of one monomial to rows of one equation, some monomials at a time.
        let width = width(count);
        let mut rows = vec![0.0; equations * width];
        for first in (0..count).step_by(LANES) {
            let terms: [&[f64]; LANES] = std::array::from_fn(|t| match first + t < count {
                true => &self.rows[(first + t) * self.stride..][..equations],
                false => &[],
            });
            let some = LANES.min(count - first);
            if some == LANES {
                let terms = terms.map(|row| &row[..equations]);
                for (e, own) in rows.chunks_exact_mut(width).enumerate() {
                    for t in 0..LANES {
                        own[first + t] = weights[e] * terms[t][e];
                    }
                }
            } else {
                for (e, own) in rows.chunks_exact_mut(width).enumerate() {
                    for t in 0..some {
                        own[first + t] = weights[e] * terms[t][e];
                    }
                }
            }
        }
        let equations = Equations {
            rows,
            right,
            coefficients: count,
        };
        (equations, weights)
    }

    /// Polynomials of all degrees up to one for a shape, from the lowest on; fewer where the points
    /// do not determine more.
    pub fn fits(&self, shape: Shape, degree: usize) -> Vec<Vec<f64>> {
        let sizes = &self.terms.upto[..=degree];
        let factors = self.equations(shape, sizes[degree]).0.factors();
        (sizes.iter().filter(|size| **size <= factors.determined))
            .map(|size| factors.solution(*size))
            .filter(|c| c.iter().all(|c| c.is_finite()))
            .collect()
    }

    /// The polynomial of a degree for a shape; `None` where the points do not determine it.
    pub fn fitted(&self, shape: Shape, degree: usize) -> Option<Vec<f64>> {
        (self.fits(shape, degree).pop()).filter(|c| c.len() == self.terms.upto[degree])
    }

    /// Polynomials of several degrees for a shape, from the highest that is determined on, until
    /// the error of one is no more than `enough`. Errors are those of the points that `counts`
    /// tells.
    pub fn tested(
        &self,
        shape: Shape,
        degree: usize,
        (degrees, enough): (usize, f64),
        counts: impl Fn(usize) -> bool,
    ) -> Vec<Tested> {
        if self.len() == 0 {
            return Vec::new();
        }
        let (equations, weights) = self.equations(shape, self.terms.upto[degree]);
        let factors = equations.factors();
        let (n, points) = (self.terms.variables, self.len());
        let mut groups: Vec<u32> = (0..self.len() as u32).collect();
        groups.sort_by_key(|k| self.group[*k as usize]);
        let groups: Vec<&[u32]> = groups
            .chunk_by(|a, b| self.group[*a as usize] == self.group[*b as usize])
            .filter(|group| group.iter().any(|k| counts(*k as usize)))
            .map(|group| &group[..group.len().min(most_of_group(n))])
            .collect();
        // The equations of each group one after the other: V of its points, then their slopes along
        // each variable.
        let of_groups: Vec<u32> = (groups.iter())
            .flat_map(|group| {
                (0..=n).flat_map(|block| group.iter().map(move |k| (block * points) as u32 + k))
            })
            .collect();
        let mut basis = factors.basis(&of_groups);
        let mut found: Vec<Tested> = Vec::new();
        for count in (self.terms.upto[..=degree].iter().copied().rev())
            .filter(|count| *count <= factors.determined)
        {
            // Lower ones too where a group alone determines something of the higher.
            if found.len() >= degrees && found.iter().any(|f| f.errors[0].is_finite()) {
                break;
            }
            let coefficients = factors.solution(count);
            if !coefficients.iter().all(|c| c.is_finite()) {
                continue;
            }
            basis.cut(count);
            let mut errors = [0.0f64; 2];
            let mut first = 0;
            for group in &groups {
                let of_group = first..first + (n + 1) * group.len();
                first = of_group.end;
                let Some(residual) = factors.left_out(&basis, of_group.clone()) else {
                    errors = [f64::INFINITY; 2];
                    break;
                };
                let right = &basis.right[of_group];
                for (at, k) in group
                    .iter()
                    .map(|k| *k as usize)
                    .enumerate()
                    .filter(|(_, k)| counts(*k))
                {
                    let said = |block: usize| {
                        let at = block * group.len() + at;
                        (right[at] - residual[at]) / weights[k]
                    };
                    let mut gradient = [0.0; MOST_VARIABLES];
                    (0..n).for_each(|i| gradient[i] = said(1 + i));
                    let error = self.error(shape, k, said(0), &gradient[..n]);
                    errors = [errors[0].max(error[0]), errors[1].max(error[1])];
                }
            }
            found.push(Tested {
                coefficients,
                errors,
            });
            if errors[0] <= enough {
                break;
            }
        }
        found
    }

    /// Errors at a point where a shape and its gradient are said.
    fn error(&self, shape: Shape, k: usize, said: f64, gradient: &[f64]) -> [f64; 2] {
        let (v, slope) = shape.back(said);
        let off = (gradient.iter().enumerate())
            .map(|(i, g)| (slope * g - self.q[i * self.len() + k]).abs())
            .fold(0.0, f64::max);
        let error = (v - self.v[k]).abs() / self.size[k];
        if error.is_finite() {
            [error, off / self.size[k]]
        } else {
            [f64::INFINITY; 2]
        }
    }

    /// Errors of V, relative to its size, and of its gradient, relative to the same.
    pub fn errors(&self, shape: Shape, coefficients: &[f64]) -> Vec<[f64; 2]> {
        let (n, points) = (self.terms.variables, self.len());
        let mut said = vec![0.0; self.stride];
        for (c, row) in coefficients.iter().zip(self.rows.chunks(self.stride)) {
            said.iter_mut().zip(row).for_each(|(s, a)| *s += c * a);
        }
        let mut gradient = [0.0; MOST_VARIABLES];
        (0..points)
            .map(|k| {
                (0..n).for_each(|i| gradient[i] = said[(1 + i) * points + k]);
                self.error(shape, k, said[k], &gradient[..n])
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_polynomial_is_found_again_in_every_shape() {
        let terms = Terms::new(2, 4);
        let coefficients: Vec<f64> = (0..terms.upto[4])
            .map(|k| {
                if k == 0 {
                    2.0
                } else {
                    0.05 * (k as f64 * 1.7).cos()
                }
            })
            .collect();
        for (shape, _) in Shape::ALL {
            let data = Data::new(&terms, 4, Scale::OfEach(1e-3), 24, |k, y, q| {
                let k = k as f64;
                y[0] = (k * 0.618).fract() * 2.0 - 1.0;
                y[1] = (k * 0.755).fract() * 2.0 - 1.0;
                let w = terms.sum(&coefficients, y, q);
                let (v, slope) = shape.back(w);
                q.iter_mut().for_each(|q| *q *= slope);
                (v, k as u32)
            });
            let found = data.fitted(shape, 4).unwrap();
            assert_eq!(found.len(), 15);
            for (a, b) in found.iter().zip(&coefficients) {
                assert!((a - b).abs() < 1e-8, "{shape:?}: {a} {b}");
            }
            assert!(
                data.errors(shape, &found)
                    .iter()
                    .all(|e| e[0] < 1e-9 && e[1] < 1e-8)
            );
        }
    }

    /// Two points leave most coefficients open; slopes along one direction at other places tell
    /// them.
    #[test]
    fn slopes_along_directions_count_as_points_do() {
        let terms = Terms::new(2, 3);
        let coefficients: Vec<f64> = (0..terms.upto[3]).map(|k| 2.0 / (1.0 + k as f64)).collect();
        let place = |k: usize| {
            let mut y = [0.0; MOST_VARIABLES];
            y[0] = (k as f64 * 0.618).fract() * 2.0 - 1.0;
            y[1] = (k as f64 * 0.755).fract() * 2.0 - 1.0;
            y
        };
        for (shape, _) in Shape::ALL {
            let at = |y: &[f64], q: &mut [f64]| {
                let (v, slope) = shape.back(terms.sum(&coefficients, y, q));
                q.iter_mut().for_each(|q| *q *= slope);
                v
            };
            let data = || {
                Data::new(&terms, 3, Scale::OfEach(1e-3), 2, |k, y, q| {
                    y.copy_from_slice(&place(k + 50)[..2]);
                    (at(y, q), k as u32)
                })
            };
            assert!(
                data()
                    .fitted(shape, 3)
                    .is_none_or(|c| (c[9] - coefficients[9]).abs() > 1e-3)
            );
            let along: Vec<Along> = (0..30)
                .map(|k| {
                    let y = place(k);
                    let mut direction = [0.0; MOST_VARIABLES];
                    (direction[0], direction[1]) =
                        if k % 2 == 0 { (1.0, -0.3) } else { (0.4, 1.0) };
                    let mut q = [0.0; 2];
                    let v = at(&y[..2], &mut q);
                    let slope = direction[0] * q[0] + direction[1] * q[1];
                    Along {
                        y,
                        direction,
                        slope,
                        said: f64::NAN,
                        v,
                    }
                })
                .collect();
            let found = data().with(along).fitted(shape, 3).unwrap();
            for (a, b) in found.iter().zip(&coefficients) {
                assert!((a - b).abs() < 1e-6, "{shape:?}: {a} {b}");
            }
        }
    }

    /// Points that a polynomial of this degree cannot meet, by fits that are made without each
    /// group in turn.
    #[test]
    fn errors_are_those_of_fits_without_the_group() {
        let terms = Terms::new(2, 3);
        let value = |y: &[f64], q: &mut [f64]| {
            q[0] = 0.8 * (2.0 * y[0] + y[1]).cos();
            q[1] = 0.4 * (2.0 * y[0] + y[1]).cos();
            1.5 + 0.4 * (2.0 * y[0] + y[1]).sin()
        };
        let place = |k: usize, y: &mut [f64]| {
            y[0] = (k as f64 * 0.618).fract() * 2.0 - 1.0;
            y[1] = (k as f64 * 0.755).fract() * 2.0 - 1.0;
        };
        let group = |k: usize| (k % 7) as u32;
        let points = 30;
        for shape in [Shape::Value, Shape::Logarithm, Shape::Reciprocal] {
            let data = |kept: &[usize]| {
                Data::new(&terms, 3, Scale::OfEach(1e-3), kept.len(), |at, y, q| {
                    place(kept[at], y);
                    (value(y, q), group(kept[at]))
                })
            };
            let all: Vec<usize> = (0..points).collect();
            let tested = data(&all).tested(shape, 3, (3, 0.0), |k| k != 4);
            assert_eq!(tested.len(), 3);
            for found in tested {
                let degree = terms
                    .upto
                    .iter()
                    .position(|c| *c == found.coefficients.len())
                    .unwrap();
                let mut worst = [0.0f64; 2];
                for left in 0..7 {
                    let (out, kept): (Vec<usize>, Vec<usize>) =
                        all.iter().partition(|k| group(**k) == left);
                    let fitted = data(&kept).fitted(shape, degree).unwrap();
                    let out: Vec<usize> = out.into_iter().filter(|k| *k != 4).collect();
                    for error in data(&out).errors(shape, &fitted) {
                        worst = [worst[0].max(error[0]), worst[1].max(error[1])];
                    }
                }
                for i in 0..2 {
                    assert!(worst[i] > 1e-3, "{worst:?}");
                    assert!(
                        (found.errors[i] - worst[i]).abs() < 1e-6 * worst[i],
                        "{:?} {worst:?}",
                        found.errors
                    );
                }
            }
        }
    }
}
