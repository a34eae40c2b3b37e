//! Where two cells meet their polynomials say the same, or one of them errs by what they differ.

use super::super::{MOST_VARIABLES, PieceValue, Pieces, SAME, SHEET_MISFIT};
use super::crossings::{A_SIDE, shares};
use super::{Builder, Built};
use rayon::prelude::*;

/// Places on a face, in shares of the cell's width along its other axes: its middle, and towards
/// two opposite corners.
const PLACES: [f64; 3] = [0.5, 0.15, 0.85];
/// One of two is right, and the other wrong, where it is so many times nearer to what the nearest
/// point says.
const CLEARLY: f64 = 5.0;

/// Two cells whose only pieces differ by more than their bounds where they meet.
#[derive(Clone, Copy)]
pub(super) struct Disagreement {
    pub cells: [usize; 2],
    /// Where, in coordinates of the frame.
    pub z: [f64; MOST_VARIABLES],
    /// V said by each.
    pub v: [f64; 2],
    /// By how much they differ, relative to the larger one of V and the floor.
    pub off: f64,
}

/// A sheet that ends at a face though it is the lowest there: V is continuous, but the cell beyond
/// says more.
struct Cliff {
    /// The cell that says more.
    cell: usize,
    /// Where, in coordinates of the frame.
    z: [f64; MOST_VARIABLES],
    /// By how much, relative to the larger one of V and the floor.
    off: f64,
}

impl Pieces {
    /// Where the lowest of both sides of a face are different sheets, and differ by more than their
    /// bounds.
    fn cliffs(&self) -> Vec<Cliff> {
        /// From the corners, in widths of the cell: on the region's faces rounding would tell.
        const INSET: f64 = 1e-3;
        let n = self.states();
        let most = self.region.value_max;
        let lowest = |cell: usize, z: &[f64]| -> Option<(usize, PieceValue)> {
            (self.cells[cell].pieces.clone())
                .filter_map(|k| Some((k, self.told(k, z)?)))
                .min_by(|a, b| a.1.v.total_cmp(&b.1.v))
                .filter(|(_, told)| told.v <= most)
        };
        (0..self.cells.len())
            .into_par_iter()
            .flat_map_iter(|cell| {
                let places = A_SIDE[n].pow(n as u32 - 1);
                (0..2 * n * places).filter_map(move |number| {
                    let (face, place) = (number / places, number % places);
                    let along = (0..n).filter(|i| *i != face / 2);
                    let mut at = [0.5; MOST_VARIABLES];
                    for (i, share) in along.zip(shares(place, A_SIDE[n])) {
                        at[i] = INSET + (1.0 - 2.0 * INSET) * share;
                    }
                    let z = self.on_face(cell, face, at)?;
                    let beside = self.cell(&z[..n]);
                    let ((own, a), (other, b)) = (lowest(cell, &z[..n])?, lowest(beside, &z[..n])?);
                    let off = (a.v - b.v).abs();
                    let size = a.v.abs().min(b.v.abs()).max(self.region.floor);
                    // Of one sheet two pieces may only be inaccurate.
                    let is_cliff = off > SAME * (a.v_bound + b.v_bound)
                        && self.misfit(own, other, &z[..n])? > SHEET_MISFIT;
                    is_cliff.then_some(Cliff {
                        cell: if a.v > b.v { cell } else { beside },
                        z,
                        off: off / size,
                    })
                })
            })
            .collect()
    }

    /// Where a sheet ends though it is the lowest there the cell beyond errs by as much as it says
    /// more, at least.
    pub fn admit_cliffs(&mut self) {
        for cliff in self.cliffs() {
            self.raise(cliff.cell, cliff.off);
        }
    }

    /// Where cells of one piece disagree with their neighbours.
    pub(super) fn disagreements(&self) -> Vec<Disagreement> {
        let n = self.states();
        (0..self.cells.len())
            .into_par_iter()
            .filter_map(|cell| Some((cell, self.alone(cell)?)))
            .flat_map_iter(|(cell, piece)| {
                let mut met = Vec::new();
                for face in 0..2 * n {
                    for share in PLACES {
                        let z = self.on_face(cell, face, [share; MOST_VARIABLES]);
                        let Some((z, beside)) = z.map(|z| (z, self.cell(&z[..n]))) else {
                            continue;
                        };
                        // One of two cells of a size looks at their common face.
                        if face % 2 == 0 && self.are_level(cell, beside, face / 2) {
                            continue;
                        }
                        let Some(other) = self.alone(beside) else {
                            continue;
                        };
                        met.extend(self.difference(piece, other, &z[..n]).map(|(v, off)| {
                            Disagreement {
                                cells: [cell, beside],
                                z,
                                v,
                                off,
                            }
                        }));
                    }
                }
                met
            })
            .collect()
    }

    /// The only piece of a cell.
    pub(super) fn alone(&self, cell: usize) -> Option<usize> {
        let own = self.cells[cell].pieces.clone();
        (own.len() == 1).then_some(own.start)
    }

    /// Whether two cells have the same extent along all axes but one.
    fn are_level(&self, a: usize, b: usize, across: usize) -> bool {
        let (a, b) = (&self.cells[a], &self.cells[b]);
        (0..self.states()).all(|i| i == across || (a.lo[i] == b.lo[i] && a.hi[i] == b.hi[i]))
    }

    /// A place just beyond a face of a cell, at shares of its width along the other axes; `None`
    /// outside the region.
    fn on_face(
        &self,
        cell: usize,
        face: usize,
        shares: [f64; MOST_VARIABLES],
    ) -> Option<[f64; MOST_VARIABLES]> {
        /// In widths of the cell.
        const BEYOND: f64 = 1e-9;
        let n = self.states();
        let (lo, hi) = (&self.cells[cell].lo, &self.cells[cell].hi);
        let mut z = [0.0; MOST_VARIABLES];
        for i in 0..n {
            z[i] = lo[i] + shares[i] * (hi[i] - lo[i]);
        }
        let (axis, upper) = (face / 2, face % 2 == 1);
        let beyond = BEYOND * (hi[axis] - lo[axis]);
        z[axis] = if upper {
            hi[axis] + beyond
        } else {
            lo[axis] - beyond
        };
        let inside = (0.0..1.0).contains(&z[axis]) && self.covers(&self.frame.state(&z[..n]));
        inside.then_some(z)
    }

    /// What two pieces say at a place, and by how much they differ, relative to V, if it is more
    /// than their bounds.
    fn difference(&self, a: usize, b: usize, z: &[f64]) -> Option<([f64; 2], f64)> {
        let (a, b) = (self.told(a, z)?, self.told(b, z)?);
        let off = (a.v - b.v).abs();
        let size = a.v.abs().min(b.v.abs()).max(self.region.floor);
        (off > a.v_bound + b.v_bound).then_some(([a.v, b.v], off / size))
    }

    /// Makes the bounds of a cell's pieces no less than `bound`.
    pub(in crate::low_level::map::pieces) fn raise(&mut self, cell: usize, bound: f64) {
        for piece in &mut self.pieces[self.cells[cell].pieces.clone()] {
            if piece.bound < bound {
                piece.p_bound *= bound / piece.bound;
                piece.bound = bound;
            }
        }
    }
}

impl Builder<'_> {
    /// Asks for states where a sheet ends though it is the lowest there: at the face, and a part of
    /// the way into the cell that says more.
    pub(super) fn ask_at_cliffs(&self, made: &mut Built) {
        const INTO: f64 = 0.3;
        let n = self.cloud.variables;
        for cliff in made.pieces.cliffs() {
            let want = &mut made.wants[cliff.cell];
            // Cells in error are asked about anyway, and change.
            if want.excess > 1.0 {
                continue;
            }
            want.bare.extend(&cliff.z[..n]);
            let middle = |i: usize| 0.5 * (want.lo[i] + want.hi[i]);
            let into = (0..n).map(|i| cliff.z[i] + INTO * (middle(i) - cliff.z[i]));
            want.bare.extend(into);
        }
    }

    /// Cells to blame for disagreements, each with what these are.
    pub(super) fn blamed(&self, made: &Built) -> Vec<(usize, Disagreement)> {
        (made.pieces.disagreements().into_par_iter())
            .flat_map_iter(|disagreement| {
                let guilty = self.guilty(made, &disagreement);
                let of = |k: usize| guilty[k].then_some((disagreement.cells[k], disagreement));
                [of(0), of(1)].into_iter().flatten()
            })
            .collect()
    }

    /// Which of two cells that disagree errs: one that is in error anyway; else one that
    /// contradicts the nearest point; else both.
    fn guilty(&self, made: &Built, disagreement: &Disagreement) -> [bool; 2] {
        let Disagreement { cells, z, v, .. } = disagreement;
        let pieces = &made.pieces;
        let in_error = cells.map(|cell| {
            (pieces.alone(cell)).is_some_and(|k| pieces.pieces[k].bound > self.region.error)
        });
        if in_error[0] != in_error[1] {
            return in_error;
        }
        let n = self.cloud.variables;
        let (lo, hi) = (&pieces.cells[cells[0]].lo, &pieces.cells[cells[0]].hi);
        let away = |k: &u32| -> f64 {
            let at = self.cloud.z(*k as usize);
            (0..n)
                .map(|i| ((at[i] - z[i]) / (hi[i] - lo[i])).powi(2))
                .sum()
        };
        let points = cells.iter().flat_map(|cell| &made.wants[*cell].points);
        let Some(nearest) = points.min_by(|a, b| away(a).total_cmp(&away(b))) else {
            return [true; 2];
        };
        let k = *nearest as usize;
        let (at, q) = (self.cloud.z(k), self.cloud.q(k));
        let there = self.cloud.v[k] + (0..n).map(|i| q[i] * (z[i] - at[i])).sum::<f64>();
        let [one, other] = v.map(|v| (v - there).abs());
        [one * CLEARLY >= other, other * CLEARLY >= one]
    }
}
