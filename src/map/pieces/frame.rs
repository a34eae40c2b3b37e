//! Coordinates in which cells are boxes: those of the region, or turned so that one axis points
//! where V is steep, and sheared so that it points there everywhere.

use super::Region;
use super::terms::{MOST_VARIABLES, Terms};
use nalgebra::{DMatrix, DVector};

/// Degree of the polynomial of a shear.
const BEND_DEGREE: usize = 3;
/// Of the largest diagonal entry, added to all when a shear is fitted.
const RIDGE: f64 = 1e-6;

/// V is steep where its root mean square slope over the region is above this many times itself;
/// another frame is worth while if slopes across are this much less, in the mean square.
const STEEP: f64 = 5.0;
const WORTH: f64 = 0.8;

/// `t = matrix (x - origin)`, and with a shear another coordinate along one axis: the region lies
/// within 0 to 1 along each.
#[derive(Clone, Debug)]
pub struct Frame {
    pub origin: Vec<f64>,
    /// Row-major, one row a coordinate.
    pub matrix: Vec<f64>,
    /// Of the matrix.
    pub inverse: Vec<f64>,
    pub bend: Option<Bend>,
}

/// A shear: along one axis `(t + phi(the other coordinates) - lowest) / width` instead of `t`.
///
/// Where V rises steeply across a curved layer, phi is such that the layer is flat: cells can then
/// be thin across it and wide along it.
#[derive(Clone, Debug)]
pub struct Bend {
    pub axis: usize,
    pub lowest: f64,
    pub width: f64,
    /// Of the monomials of the other coordinates, in order; the constant is 0.
    pub phi: Vec<f64>,
    terms: Terms,
}

/// A place where V is known, in coordinates of a frame without a shear, with its weight.
pub struct Steep {
    pub t: Vec<f64>,
    /// Gradient relative to V.
    pub slope: Vec<f64>,
    pub weight: f64,
}

impl Bend {
    /// Number of coefficients for so many variables.
    pub fn count(variables: usize) -> usize {
        Terms::new(variables - 1, BEND_DEGREE).factors.len()
    }

    /// From its parts; `None` where they do not fit together.
    pub fn new(
        variables: usize,
        axis: usize,
        lowest: f64,
        width: f64,
        phi: Vec<f64>,
    ) -> Option<Self> {
        let fits = (2..=MOST_VARIABLES).contains(&variables) && axis < variables;
        (fits && phi.len() == Self::count(variables) && width > 0.0).then(|| Self {
            axis,
            lowest,
            width,
            phi,
            terms: Terms::new(variables - 1, BEND_DEGREE),
        })
    }

    /// The shear that leaves the least of V's slopes along the other axes, in the mean square over
    /// places.
    pub fn fitted(axis: usize, places: &[Steep]) -> Option<Self> {
        let n = places.first()?.t.len();
        let terms = Terms::new(n - 1, BEND_DEGREE);
        let count = terms.factors.len();
        let mut gram = DMatrix::<f64>::zeros(count, count);
        let mut right = DVector::<f64>::zeros(count);
        let (mut values, mut slopes) = (vec![0.0; count], vec![0.0; (n - 1) * count]);
        for place in places {
            terms.at(&others(&place.t, axis), &mut values, &mut slopes);
            let (along, across) = (place.slope[axis], others(&place.slope, axis));
            for (row, wanted) in slopes.chunks(count).zip(across) {
                let row = DVector::from_column_slice(row) * along;
                gram.syger(place.weight, &row, &row, 1.0);
                right.axpy(place.weight * wanted, &row, 1.0);
            }
        }
        gram.fill_upper_triangle_with_lower_triangle();
        // The constant has no slope.
        let ridge = RIDGE * (0..count).map(|k| gram[(k, k)]).fold(0.0, f64::max);
        (0..count).for_each(|k| gram[(k, k)] += ridge);
        let phi: Vec<f64> = gram.cholesky()?.solve(&right).iter().copied().collect();
        phi.iter().all(|c| c.is_finite()).then_some(())?;
        Self::new(n, axis, 0.0, 1.0, phi)
    }

    /// Monomials of phi, of the other coordinates.
    pub(super) fn terms(&self) -> &Terms {
        &self.terms
    }

    /// phi as a polynomial of all coordinates, by the monomials of `all`.
    pub fn whole(&self, all: &Terms) -> Vec<f64> {
        let mut whole = vec![0.0; all.upto[BEND_DEGREE]];
        for (c, powers) in self
            .phi
            .iter()
            .zip(self.terms.powers.chunks(all.variables - 1))
        {
            let mut wanted = powers.to_vec();
            wanted.insert(self.axis, 0);
            let term = (0..whole.len()).find(|t| all.powers_of(*t) == wanted);
            whole[term.expect("all monomials up to the degree are there")] = *c;
        }
        whole
    }

    /// phi and its gradient by all coordinates.
    fn phi(&self, t: &[f64], gradient: &mut [f64]) -> f64 {
        let mut along = [0.0; MOST_VARIABLES];
        let y = others(t, self.axis);
        let value = self.terms.sum(&self.phi, &y, &mut along[..y.len()]);
        gradient[self.axis] = 0.0;
        let beside = (0..t.len()).filter(|i| *i != self.axis);
        for (i, g) in beside.zip(along) {
            gradient[i] = g;
        }
        value
    }

    /// Bounds of phi over a box, not always tight.
    fn range(&self, lo: &[f64], hi: &[f64]) -> [f64; 2] {
        let n = lo.len();
        let (below, above) = (others(lo, self.axis), others(hi, self.axis));
        let count = self.phi.len();
        // Coordinates of the region are not negative: monomials rise with each.
        let at = |y: &[f64]| {
            let clamped: Vec<f64> = y.iter().map(|y| y.max(0.0)).collect();
            let (mut values, mut slopes) = (vec![0.0; count], vec![0.0; (n - 1) * count]);
            self.terms.at(&clamped, &mut values, &mut slopes);
            (values, slopes)
        };
        let ((low, low_slopes), (high, high_slopes)) = (at(&below), at(&above));
        let bounds = |from: &[f64], to: &[f64]| -> [f64; 2] {
            (self.phi.iter().zip(from.iter().zip(to))).fold([0.0, 0.0], |[lo, hi], (c, (a, b))| {
                [lo + (c * a).min(c * b), hi + (c * a).max(c * b)]
            })
        };
        let direct = bounds(&low, &high);
        // From the middle, by the largest slopes.
        let middle: Vec<f64> = below
            .iter()
            .zip(&above)
            .map(|(a, b)| 0.5 * (a + b))
            .collect();
        let mut gradient = [0.0; MOST_VARIABLES];
        let value = self.terms.sum(&self.phi, &middle, &mut gradient[..n - 1]);
        let away: f64 = (0..n - 1)
            .map(|i| {
                let [a, b] = bounds(
                    &low_slopes[i * count..][..count],
                    &high_slopes[i * count..][..count],
                );
                0.5 * (above[i] - below[i]) * a.abs().max(b.abs())
            })
            .sum();
        [direct[0].max(value - away), direct[1].min(value + away)]
    }
}

/// All but one.
fn others(t: &[f64], axis: usize) -> Vec<f64> {
    t.iter()
        .enumerate()
        .filter(|(i, _)| *i != axis)
        .map(|(_, t)| *t)
        .collect()
}

impl Frame {
    /// The region's own axes.
    pub fn along(region: &Region) -> Self {
        Self::turned(region, &DMatrix::identity(region.lo.len(), region.lo.len()))
    }

    /// With the first axis along a direction, in widths of the region, and the others as near to
    /// the region's as can be.
    pub fn steep(region: &Region, direction: &[f64]) -> Self {
        let n = direction.len();
        let d = DVector::from_column_slice(direction).normalize();
        // A reflection that takes the axis nearest to the direction to it.
        let axis = d.iamax();
        let mut v = d.clone();
        v[axis] += d[axis].signum();
        let turn = DMatrix::identity(n, n) - (2.0 / v.norm_squared()) * &v * v.transpose();
        Self::turned(region, &turn)
    }

    /// The frame in which V is steep along one axis and as little as can be along the others;
    /// `None` where it is steep nowhere or no other frame is much better than the region's own
    /// axes. Places are in widths of the region.
    pub fn fitted(region: &Region, places: &[Steep]) -> Option<Self> {
        let n = region.lo.len();
        // Of two coordinates pieces of high degree follow a layer by themselves.
        if n <= 2 {
            return None;
        }
        let mut moments = DMatrix::<f64>::zeros(n, n);
        for place in places {
            let slope = DVector::from_column_slice(&place.slope);
            moments.syger(place.weight, &slope, &slope, 1.0);
        }
        moments.fill_upper_triangle_with_lower_triangle();
        let eigen = moments.symmetric_eigen();
        let steepest = eigen.eigenvalues.imax();
        if eigen.eigenvalues[steepest] < STEEP * STEEP {
            return None;
        }
        let direction = eigen.eigenvectors.column(steepest);
        let along = Self::along(region).across(region, places);
        let straight = Self::steep(region, direction.as_slice());
        // The axis that [`Self::steep`] turns to the direction.
        let axis = direction.iamax();
        let mut best = (straight.across(region, places), straight.clone());
        let turned: Vec<Steep> = places.iter().map(|p| straight.place(region, p)).collect();
        if let Some(bend) = Bend::fitted(axis, &turned) {
            let bent = straight.bent(region, bend);
            let across = bent.across(region, places);
            if across < WORTH * best.0 {
                best = (across, bent);
            }
        }
        (best.0 < WORTH * along).then_some(best.1)
    }

    /// With a shear, whose range is that of the region.
    fn bent(self, region: &Region, mut bend: Bend) -> Self {
        let n = region.lo.len();
        // Bounds of parts of the region: those of the whole are far from tight.
        let a_side = if n <= 3 { 16usize } else { 8 - n.min(4) };
        let (mut lowest, mut highest) = (f64::INFINITY, f64::NEG_INFINITY);
        for part in 0..a_side.pow(n as u32) {
            let mut left = part;
            let (mut lo, mut hi) = (vec![0.0; n], vec![0.0; n]);
            for j in 0..n {
                let from = region.width(j) * (left % a_side) as f64 / a_side as f64;
                let to = from + region.width(j) / a_side as f64;
                left /= a_side;
                for i in 0..n {
                    let row = self.matrix[i * n + j];
                    let offset = region.lo[j] - self.origin[j];
                    lo[i] += (row * (offset + from)).min(row * (offset + to));
                    hi[i] += (row * (offset + from)).max(row * (offset + to));
                }
            }
            let [least, most] = bend.range(&lo, &hi);
            lowest = f64::min(lowest, lo[bend.axis] + least);
            highest = f64::max(highest, hi[bend.axis] + most);
        }
        (bend.lowest, bend.width) = (lowest, highest - lowest);
        Self {
            bend: Some(bend),
            ..self
        }
    }

    /// A place of the region in this frame's coordinates.
    fn place(&self, region: &Region, place: &Steep) -> Steep {
        let n = place.t.len();
        let x: Vec<f64> = (0..n)
            .map(|i| region.lo[i] + place.t[i] * region.width(i))
            .collect();
        let p: Vec<f64> = (0..n).map(|i| place.slope[i] / region.width(i)).collect();
        let (mut t, mut slope) = (vec![0.0; n], vec![0.0; n]);
        self.of(&x, &mut t);
        self.gradient_of(&t, &p, &mut slope);
        Steep {
            t,
            slope,
            weight: place.weight,
        }
    }

    /// Mean square of V's slopes along all coordinates but the steepest one.
    pub fn across(&self, region: &Region, places: &[Steep]) -> f64 {
        let n = self.origin.len();
        let mut squares = vec![0.0; n];
        for place in places {
            for (square, slope) in squares.iter_mut().zip(self.place(region, place).slope) {
                *square += place.weight * slope * slope;
            }
        }
        squares.iter().sum::<f64>() - squares.iter().copied().fold(0.0, f64::max)
    }

    /// `turn` is orthogonal, in widths of the region.
    fn turned(region: &Region, turn: &DMatrix<f64>) -> Self {
        let n = region.lo.len();
        let mut matrix = DMatrix::zeros(n, n);
        let mut origin = DVector::zeros(n);
        for i in 0..n {
            let row: Vec<f64> = turn.row(i).iter().copied().collect();
            let lowest: f64 = row.iter().map(|r| r.min(0.0)).sum();
            let width = row.iter().map(|r| r.max(0.0)).sum::<f64>() - lowest;
            for j in 0..n {
                matrix[(i, j)] = row[j] / width / region.width(j);
            }
            origin[i] = lowest / width;
        }
        // Of an orthogonal matrix with scaled rows and columns.
        let inverse = matrix
            .clone()
            .try_inverse()
            .expect("rows of an orthogonal matrix are independent");
        let shift = &inverse * origin;
        Self {
            origin: (0..n).map(|i| region.lo[i] + shift[i]).collect(),
            matrix: matrix.transpose().as_slice().to_vec(),
            inverse: inverse.transpose().as_slice().to_vec(),
            bend: None,
        }
    }

    /// From its parts; `None` where the matrix has no inverse.
    pub fn new(origin: Vec<f64>, matrix: Vec<f64>, bend: Option<Bend>) -> Option<Self> {
        let n = origin.len();
        let inverse = DMatrix::from_row_slice(n, n, &matrix).try_inverse()?;
        Some(Self {
            origin,
            matrix,
            inverse: inverse.transpose().as_slice().to_vec(),
            bend,
        })
    }

    /// How a state's component changes by the coordinates, a shear aside.
    pub fn inverse_row(&self, i: usize) -> &[f64] {
        let n = self.origin.len();
        &self.inverse[i * n..][..n]
    }

    /// Coordinates of a state (absolute).
    pub fn of(&self, x: &[f64], t: &mut [f64]) {
        let n = x.len();
        for (t, row) in t.iter_mut().zip(self.matrix.chunks(n)) {
            *t = (0..n).map(|j| row[j] * (x[j] - self.origin[j])).sum();
        }
        if let Some(bend) = &self.bend {
            let phi = bend.phi(&t[..n], &mut [0.0; MOST_VARIABLES]);
            t[bend.axis] = (t[bend.axis] + phi - bend.lowest) / bend.width;
        }
    }

    /// The state at coordinates.
    pub fn state(&self, t: &[f64]) -> Vec<f64> {
        let n = t.len();
        let mut t = t.to_vec();
        if let Some(bend) = &self.bend {
            let phi = bend.phi(&t, &mut [0.0; MOST_VARIABLES]);
            t[bend.axis] = bend.lowest + bend.width * t[bend.axis] - phi;
        }
        let row = |i: usize| -> f64 { (0..n).map(|j| self.inverse[i * n + j] * t[j]).sum() };
        (0..n).map(|i| self.origin[i] + row(i)).collect()
    }

    /// The gradient by coordinates of one by states, at coordinates `t`.
    pub fn gradient_of(&self, t: &[f64], p: &[f64], q: &mut [f64]) {
        let n = p.len();
        for (j, q) in q.iter_mut().enumerate() {
            *q = (0..n).map(|i| self.inverse[i * n + j] * p[i]).sum();
        }
        if let Some(bend) = &self.bend {
            let mut slope = [0.0; MOST_VARIABLES];
            bend.phi(&t[..n], &mut slope);
            let along = q[bend.axis];
            (0..n).for_each(|i| q[i] -= along * slope[i]);
            q[bend.axis] = along * bend.width;
        }
    }

    /// Rates of the coordinates where the state changes at rates `f`, at coordinates `t`.
    pub fn rates(&self, t: &[f64], f: &[f64], rates: &mut [f64]) {
        let n = f.len();
        for (rate, row) in rates.iter_mut().zip(self.matrix.chunks(n)) {
            *rate = row.iter().zip(f).map(|(m, f)| m * f).sum();
        }
        if let Some(bend) = &self.bend {
            let mut slope = [0.0; MOST_VARIABLES];
            bend.phi(&t[..n], &mut slope);
            let sheared: f64 = (0..n).map(|i| slope[i] * rates[i]).sum();
            rates[bend.axis] = (rates[bend.axis] + sheared) / bend.width;
        }
    }

    /// The gradient by states of one by coordinates, at coordinates `t`.
    pub fn gradient(&self, t: &[f64], q: &[f64], p: &mut [f64]) {
        self.by_states(t, q, p, |x| x);
    }

    /// Bounds of the gradient by states where its components by coordinates are bounded.
    pub fn gradient_bound(&self, t: &[f64], q: &[f64], p: &mut [f64]) {
        self.by_states(t, q, p, f64::abs);
    }

    /// Sums over coordinates, each part as `part` has it.
    fn by_states(&self, t: &[f64], q: &[f64], p: &mut [f64], part: impl Fn(f64) -> f64) {
        let n = q.len();
        let mut q: [f64; MOST_VARIABLES] = std::array::from_fn(|i| if i < n { q[i] } else { 0.0 });
        if let Some(bend) = &self.bend {
            let mut slope = [0.0; MOST_VARIABLES];
            bend.phi(&t[..n], &mut slope);
            let along = q[bend.axis] / bend.width;
            (0..n).for_each(|i| q[i] += along * part(slope[i]));
            q[bend.axis] = along;
        }
        for (j, p) in p.iter_mut().enumerate() {
            *p = (0..n).map(|i| part(self.matrix[i * n + j] * q[i])).sum();
        }
    }

    /// Whether a box of coordinates may meet the region: of one that does not it is not always
    /// told.
    pub fn may_meet(&self, region: &Region, lo: &[f64], hi: &[f64]) -> bool {
        let around = self.states_of(lo, hi);
        (around.iter().zip(region.lo.iter().zip(&region.hi)))
            .all(|([from, to], (lo, hi))| to >= lo && from <= hi)
    }

    /// Whether a box of coordinates certainly lies in the region.
    pub fn lies_in(&self, region: &Region, lo: &[f64], hi: &[f64]) -> bool {
        let around = self.states_of(lo, hi);
        (around.iter().zip(region.lo.iter().zip(&region.hi)))
            .all(|([from, to], (lo, hi))| from >= lo && to <= hi)
    }

    /// Bounds of the states of a box of coordinates, not always tight.
    fn states_of(&self, lo: &[f64], hi: &[f64]) -> Vec<[f64; 2]> {
        let n = lo.len();
        let (mut lo, mut hi) = (lo.to_vec(), hi.to_vec());
        if let Some(bend) = &self.bend {
            let [least, most] = bend.range(&lo, &hi);
            lo[bend.axis] = bend.lowest + bend.width * lo[bend.axis] - most;
            hi[bend.axis] = bend.lowest + bend.width * hi[bend.axis] - least;
        }
        (0..n)
            .map(|i| {
                let row = &self.inverse[i * n..][..n];
                [false, true].map(|upper| {
                    let side = |j: usize| {
                        if (row[j] > 0.0) == upper {
                            hi[j]
                        } else {
                            lo[j]
                        }
                    };
                    self.origin[i] + (0..n).map(|j| row[j] * side(j)).sum::<f64>()
                })
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_region_fits_and_gradients_turn_with_it() {
        let region = Region {
            lo: vec![1.0, -2.0, 0.0],
            hi: vec![1.4, 3.0, 0.2],
            error: 1e-3,
            equal_cost: f64::INFINITY,
            floor: 1e-3,
            value_max: f64::INFINITY,
            beyond: 0.25,
            game: false,
        };
        let direction = [0.5, -0.6, 0.3];
        let frame = Frame::steep(&region, &direction);
        let (mut lowest, mut highest) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for corner in 0..8 {
            let x: Vec<f64> = (0..3)
                .map(|i| {
                    if corner >> i & 1 == 1 {
                        region.hi[i]
                    } else {
                        region.lo[i]
                    }
                })
                .collect();
            let mut t = [0.0; 3];
            frame.of(&x, &mut t);
            for i in 0..3 {
                lowest[i] = t[i].min(lowest[i]);
                highest[i] = t[i].max(highest[i]);
            }
            let back = frame.state(&t);
            assert!(back.iter().zip(&x).all(|(a, b)| (a - b).abs() < 1e-12));
        }
        for i in 0..3 {
            assert!(lowest[i].abs() < 1e-12 && (highest[i] - 1.0).abs() < 1e-12);
        }
        // A function of the direction alone changes along one coordinate only.
        let p: Vec<f64> = (0..3).map(|i| direction[i] / region.width(i)).collect();
        let mut q = [0.0; 3];
        frame.gradient_of(&[0.5; 3], &p, &mut q);
        assert_eq!(q.iter().filter(|q| q.abs() > 1e-12).count(), 1);
        let mut again = [0.0; 3];
        frame.gradient(&[0.5; 3], &q, &mut again);
        assert!(again.iter().zip(&p).all(|(a, b)| (a - b).abs() < 1e-12));
        assert!(
            !frame.may_meet(&region, &[0.0; 3], &[0.0; 3])
                || frame
                    .state(&[0.0; 3])
                    .iter()
                    .zip(&region.lo)
                    .all(|(a, b)| a >= b)
        );
    }

    /// Across a curved layer V changes along one axis of the fitted frame, in which the region
    /// fits.
    #[test]
    fn a_curved_layer_is_flat() {
        let region = Region {
            lo: vec![-1.0, 2.0, 0.0],
            hi: vec![1.0, 5.0, 0.2],
            error: 1e-3,
            equal_cost: f64::INFINITY,
            floor: 1e-3,
            value_max: f64::INFINITY,
            beyond: 0.25,
            game: false,
        };
        let states: Vec<[f64; 3]> = (0..2000)
            .map(|k| [0.618, 0.755, 0.57].map(|r| (f64::from(k) * r).fract()))
            .collect();
        // log V = 6 tanh((c - 0.8) / 0.1) of c = y0 + 0.8 y1 + 0.3 y1^2 - 0.2 y1 y2, in widths of
        // the region.
        let value = |y: &[f64]| {
            6.0 * ((y[0] + 0.8 * y[1] + 0.3 * y[1] * y[1] - 0.2 * y[1] * y[2] - 0.8) / 0.1).tanh()
        };
        let slope = |y: &[f64]| {
            let steep = 60.0 * (1.0 - (value(y) / 6.0).powi(2));
            [
                steep,
                steep * (0.8 + 0.6 * y[1] - 0.2 * y[2]),
                -0.2 * steep * y[1],
            ]
        };
        let places: Vec<Steep> = (states.iter())
            .map(|t| Steep {
                t: t.to_vec(),
                slope: slope(t).to_vec(),
                weight: 1.0 / 2000.0,
            })
            .collect();
        let frame = Frame::fitted(&region, &places).unwrap();
        let bend = frame.bend.as_ref().unwrap();
        let straight = Frame {
            bend: None,
            ..frame.clone()
        };
        let (bent, straight) = (
            frame.across(&region, &places),
            straight.across(&region, &places),
        );
        assert!(bent < 0.1 * straight, "{bent} {straight}");
        let (mut lowest, mut highest) = (f64::INFINITY, f64::NEG_INFINITY);
        for place in &places {
            let x: Vec<f64> = (0..3)
                .map(|i| region.lo[i] + place.t[i] * region.width(i))
                .collect();
            let mut t = [0.0; 3];
            frame.of(&x, &mut t);
            assert!(t.iter().all(|t| (0.0..=1.0).contains(t)), "{t:?}");
            lowest = t[bend.axis].min(lowest);
            highest = t[bend.axis].max(highest);
            let back = frame.state(&t);
            assert!(back.iter().zip(&x).all(|(a, b)| (a - b).abs() < 1e-12));
            let p: Vec<f64> = (0..3).map(|i| place.slope[i] / region.width(i)).collect();
            let (mut q, mut again) = ([0.0; 3], [0.0; 3]);
            frame.gradient_of(&t, &p, &mut q);
            frame.gradient(&t, &q, &mut again);
            assert!(again.iter().zip(&p).all(|(a, b)| (a - b).abs() < 1e-9));
            // By differences.
            let at = |t: &[f64]| {
                let x = frame.state(t);
                let y: Vec<f64> = (0..3)
                    .map(|i| (x[i] - region.lo[i]) / region.width(i))
                    .collect();
                value(&y)
            };
            for i in 0..3 {
                let (mut a, mut b) = (t, t);
                a[i] -= 1e-5;
                b[i] += 1e-5;
                assert!((q[i] - (at(&b) - at(&a)) / 2e-5).abs() < 1e-4);
            }
            let (lo, hi) = (t.map(|t| t - 0.01), t.map(|t| t + 0.01));
            assert!(frame.may_meet(&region, &lo, &hi));
        }
        assert!(highest - lowest > 0.7, "{lowest} to {highest}");
    }
}
