//! The rounding of what pieces say: no bound may be below it.

use super::terms::Terms;
use super::{BLEND, Cell, Piece, Pieces, Shape};

/// Largest slope of a monomial of a shear over 0 to 1: its degree.
const STEEPEST_SHEAR: f64 = 3.0;
/// Slope of the blend's weights at most, of the weight over a cell's half width.
const STEEPEST: f64 = 30.0 / 16.0 / (2.0 * BLEND);

impl Pieces {
    /// Raises the bounds of all pieces to the rounding of their sums in f64.
    pub(super) fn raise_to_rounding(&mut self) {
        let places = self.places();
        for cell in &self.cells {
            for piece in &mut self.pieces[cell.pieces.clone()] {
                let [v, q] = rounding(piece, cell, &self.terms, self.region.floor, &places);
                piece.bound = piece.bound.max(v);
                piece.p_bound = piece.p_bound.max(q);
            }
        }
    }

    /// What each coordinate of the frame is rounded by at most.
    fn places(&self) -> Vec<f64> {
        let (n, unit) = (self.states(), 0.5 * f64::EPSILON);
        let frame = &self.frame;
        let mut off: Vec<f64> = (frame.matrix.chunks_exact(n))
            .map(|row| {
                let terms = row.iter().enumerate().map(|(j, m)| {
                    let far = |bound: f64| (m * (bound - frame.origin[j])).abs();
                    far(self.region.lo[j]).max(far(self.region.hi[j]))
                });
                (n as f64 + 2.0) * unit * terms.sum::<f64>()
            })
            .collect();
        if let Some(bend) = &frame.bend {
            // The polynomial of the others, each from 0 to 1, and its slopes by what these are off
            // by.
            let size: f64 = bend.phi.iter().map(|c| c.abs()).sum();
            let others: f64 = off.iter().sum();
            let own = (bend.phi.len() as f64 + 4.0) * unit * (1.0 + size + bend.lowest.abs());
            off[bend.axis] = (own + STEEPEST_SHEAR * size * others) / bend.width;
        }
        off
    }
}

/// Bounds of V's rounding and of that of its derivatives by the monomials' variables, relative to
/// the larger one of V and the floor.
fn rounding(piece: &Piece, cell: &Cell, terms: &Terms, floor: f64, places: &[f64]) -> [f64; 2] {
    let (n, unit) = (cell.lo.len(), 0.5 * f64::EPSILON);
    // The largest of a monomial's variables where the cell says something, and what they are off
    // by.
    let (mut most, mut off) = (1.0f64, 0.0f64);
    for i in 0..n {
        let more = 0.5 * BLEND * (cell.hi[i] - cell.lo[i]);
        for face in [cell.lo[i] - more, cell.hi[i] + more] {
            most = most.max((face - piece.center[i]).abs() / piece.half[i]);
        }
        off = off.max((places[i] + unit * (2.0 + piece.center[i].abs())) / piece.half[i]);
    }
    let degree = terms.degree_of(piece.coefficients.len() - 1) as f64;
    let size_of = |(t, c): (usize, &f64)| c.abs() * most.powi(terms.degree_of(t) as i32);
    let size: f64 = piece.coefficients.iter().enumerate().map(size_of).sum();
    let steps = piece.coefficients.len() as f64 + degree;
    // Of the polynomial w, and of its gradient.
    let w = size * (steps * unit + degree * off);
    let slope = degree * size;
    let gradient = slope * ((steps + 2.0 * n as f64) * unit + degree * off);
    // The least and the largest that it may be.
    let first = piece.coefficients[0].abs();
    let least = (2.0 * first - size).max(0.0);
    let over = |v: f64| match v.max(floor) {
        larger if larger > 0.0 => larger,
        _ => size,
    };
    // |V'|/V and |V''|/V with V the larger one of it and the floor.
    let [by, bend] = match piece.shape {
        Shape::Value => [1.0 / over(least), 0.0],
        Shape::Root => {
            let v = over(least * least);
            [2.0 * size.min(v.sqrt().max(least)) / v, 2.0 / v]
        }
        Shape::Logarithm => [1.0, 1.0],
        Shape::Reciprocal => {
            // Where the coefficients alone do not bound V, it is taken as at most ten times that at
            // the center.
            let v = 1.0 / least.max(0.1 * first).max(f64::MIN_POSITIVE);
            [v, 2.0 * v * v]
        }
    };
    let v = by * w + 4.0 * unit;
    // The blend's weights turn differences of V into slopes.
    let blended = STEEPEST
        * n as f64
        * piece
            .half
            .iter()
            .zip(cell.lo.iter().zip(&cell.hi))
            .map(|(half, (lo, hi))| 2.0 * half / (hi - lo))
            .fold(1.0, f64::max);
    [
        v,
        by * gradient + bend * w * slope + 4.0 * unit * by * slope + blended * 2.0 * v,
    ]
}
