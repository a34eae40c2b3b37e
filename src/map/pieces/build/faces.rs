//! Where two cells meet their polynomials say the same, or one of them errs by what they differ.

use super::super::{MOST_VARIABLES, Pieces};
use rayon::prelude::*;

/// Places on a face, in shares of the cell's width along its other axes: its middle, and towards two opposite corners.
const PLACES: [f64; 3] = [0.5, 0.15, 0.85];

/// A cell whose only piece differs from that of a neighbour by more than the bounds of both.
pub(super) struct Disagreement {
    pub cell: usize,
    pub beside: usize,
    /// By how much, relative to the larger one of V and the floor.
    pub off: f64,
}

impl Pieces {
    pub(super) fn disagreements(&self) -> Vec<Disagreement> {
        let n = self.states();
        let alone = |cell: usize| {
            let own = self.cells[cell].pieces.clone();
            (own.len() == 1).then_some(own.start)
        };
        (0..self.cells.len())
            .into_par_iter()
            .filter_map(|cell| Some((cell, alone(cell)?)))
            .flat_map_iter(|(cell, piece)| {
                let mut met = Vec::new();
                for face in 0..2 * n {
                    for share in PLACES {
                        let z = self.on_face(cell, face, share);
                        let Some((z, beside)) = z.map(|z| (z, self.cell(&z[..n]))) else {
                            continue;
                        };
                        // One of two cells of a size looks at their common face.
                        if face % 2 == 0 && self.are_level(cell, beside, face / 2) {
                            continue;
                        }
                        let Some(other) = alone(beside) else { continue };
                        let Some(off) = self.difference(piece, other, &z[..n]) else {
                            continue;
                        };
                        // One that is in error anyway is to blame before one that is not.
                        let [own, its] = [piece, other].map(|k| self.pieces[k].bound > self.region.error);
                        let of = |cell: usize, beside: usize| Disagreement { cell, beside, off };
                        met.extend((own || !its).then(|| of(cell, beside)));
                        met.extend((its || !own).then(|| of(beside, cell)));
                    }
                }
                met
            })
            .collect()
    }

    /// Whether two cells have the same extent along all axes but one.
    fn are_level(&self, a: usize, b: usize, across: usize) -> bool {
        let (a, b) = (&self.cells[a], &self.cells[b]);
        (0..self.states()).all(|i| i == across || (a.lo[i] == b.lo[i] && a.hi[i] == b.hi[i]))
    }

    /// A place just beyond a face of a cell; `None` outside the region.
    fn on_face(&self, cell: usize, face: usize, share: f64) -> Option<[f64; MOST_VARIABLES]> {
        /// In widths of the cell.
        const BEYOND: f64 = 1e-9;
        let n = self.states();
        let (lo, hi) = (&self.cells[cell].lo, &self.cells[cell].hi);
        let mut z = [0.0; MOST_VARIABLES];
        for i in 0..n {
            z[i] = lo[i] + share * (hi[i] - lo[i]);
        }
        let (axis, upper) = (face / 2, face % 2 == 1);
        let beyond = BEYOND * (hi[axis] - lo[axis]);
        z[axis] = if upper { hi[axis] + beyond } else { lo[axis] - beyond };
        let inside = (0.0..1.0).contains(&z[axis]) && self.covers(&self.frame.state(&z[..n]));
        inside.then_some(z)
    }

    /// By how much two pieces differ at a place, relative to V, if it is more than their bounds.
    fn difference(&self, a: usize, b: usize, z: &[f64]) -> Option<f64> {
        let (a, b) = (self.told(a, z)?, self.told(b, z)?);
        let off = (a.v - b.v).abs();
        let size = a.v.abs().min(b.v.abs()).max(self.region.floor);
        (off > a.v_bound + b.v_bound).then_some(off / size)
    }

    /// Makes the bounds of a cell's pieces no less than `bound`.
    pub(in crate::map::pieces) fn raise(&mut self, cell: usize, bound: f64) {
        for piece in &mut self.pieces[self.cells[cell].pieces.clone()] {
            if piece.bound < bound {
                piece.p_bound *= bound / piece.bound;
                piece.bound = bound;
            }
        }
    }
}
