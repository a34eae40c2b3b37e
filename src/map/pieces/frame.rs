//! Coordinates in which cells are boxes: those of the region, or turned so that one axis points where V is steep.

use super::Region;
use nalgebra::{DMatrix, DVector};

/// `t = matrix (x - origin)`: the region lies within 0 to 1 along each coordinate.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    pub origin: Vec<f64>,
    /// Row-major, one row a coordinate.
    pub matrix: Vec<f64>,
    /// Of the matrix.
    pub inverse: Vec<f64>,
}

impl Frame {
    /// The region's own axes.
    pub fn along(region: &Region) -> Self {
        Self::turned(region, &DMatrix::identity(region.lo.len(), region.lo.len()))
    }

    /// With the first axis along a direction, in widths of the region, and the others as near to the region's as can be.
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
        }
    }

    /// From its parts; `None` where the matrix has no inverse.
    pub fn new(origin: Vec<f64>, matrix: Vec<f64>) -> Option<Self> {
        let n = origin.len();
        let inverse = DMatrix::from_row_slice(n, n, &matrix).try_inverse()?;
        Some(Self {
            origin,
            matrix,
            inverse: inverse.transpose().as_slice().to_vec(),
        })
    }

    /// Coordinates of a state (absolute).
    pub fn of(&self, x: &[f64], t: &mut [f64]) {
        let n = x.len();
        for (t, row) in t.iter_mut().zip(self.matrix.chunks(n)) {
            *t = (0..n).map(|j| row[j] * (x[j] - self.origin[j])).sum();
        }
    }

    /// The state at coordinates.
    pub fn state(&self, t: &[f64]) -> Vec<f64> {
        let n = t.len();
        let row = |i: usize| -> f64 { (0..n).map(|j| self.inverse[i * n + j] * t[j]).sum() };
        (0..n).map(|i| self.origin[i] + row(i)).collect()
    }

    /// The gradient by coordinates of one by states.
    pub fn gradient_of(&self, p: &[f64], q: &mut [f64]) {
        let n = p.len();
        for (j, q) in q.iter_mut().enumerate() {
            *q = (0..n).map(|i| self.inverse[i * n + j] * p[i]).sum();
        }
    }

    /// The gradient by states of one by coordinates.
    pub fn gradient(&self, q: &[f64], p: &mut [f64]) {
        let n = q.len();
        for (j, p) in p.iter_mut().enumerate() {
            *p = (0..n).map(|i| self.matrix[i * n + j] * q[i]).sum();
        }
    }

    /// Bounds of the gradient by states where its components by coordinates are bounded.
    pub fn gradient_bound(&self, q: &[f64], p: &mut [f64]) {
        let n = q.len();
        for (j, p) in p.iter_mut().enumerate() {
            *p = (0..n).map(|i| (self.matrix[i * n + j] * q[i]).abs()).sum();
        }
    }

    /// Whether a box of coordinates may meet the region: of one that does not it is not always told.
    pub fn may_meet(&self, region: &Region, lo: &[f64], hi: &[f64]) -> bool {
        let n = lo.len();
        (0..n).all(|i| {
            let row = &self.inverse[i * n..][..n];
            let end = |upper: bool| -> f64 {
                let side = |j: usize| if (row[j] > 0.0) == upper { hi[j] } else { lo[j] };
                self.origin[i] + (0..n).map(|j| row[j] * side(j)).sum::<f64>()
            };
            end(true) >= region.lo[i] && end(false) <= region.hi[i]
        })
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
        frame.gradient_of(&p, &mut q);
        assert_eq!(q.iter().filter(|q| q.abs() > 1e-12).count(), 1);
        let mut again = [0.0; 3];
        frame.gradient(&q, &mut again);
        assert!(again.iter().zip(&p).all(|(a, b)| (a - b).abs() < 1e-12));
        assert!(
            !frame.may_meet(&region, &[0.0; 3], &[0.0; 3])
                || frame.state(&[0.0; 3]).iter().zip(&region.lo).all(|(a, b)| a >= b)
        );
    }
}
