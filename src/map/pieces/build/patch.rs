//! A block as it is fitted: the box of its piece, and which points tell of it.

use super::super::fit::{Data, Scale, Shape};
use super::{Block, Builder, LEAST_EQUATIONS, Piece};

/// Some points of a block, and the box of their piece.
pub(super) struct Patch<'p> {
    pub center: Vec<f64>,
    pub half: Vec<f64>,
    pub points: &'p [u32],
    /// Points tell the piece's error up to so many half widths from the middle.
    pub near: f64,
    pub scale: Scale,
}

impl Patch<'_> {
    /// The box, to be made a piece.
    pub fn extent(&self) -> (Vec<f64>, Vec<f64>) {
        (self.center.clone(), self.half.clone())
    }
}

impl Builder<'_> {
    /// Of a block, with these of its points.
    pub(super) fn patch<'p>(&self, block: &Block, points: &'p [u32]) -> Patch<'p> {
        let (center, half) = self.extent(block);
        Patch {
            center,
            half,
            points,
            near: 1.0,
            scale: self.scale(points),
        }
    }

    /// Whether a point tells the error of the patch's piece.
    #[inline]
    pub(super) fn tells(&self, patch: &Patch<'_>, k: u32) -> bool {
        let z = self.cloud.z(k as usize);
        let (center, half) = (&patch.center, &patch.half);
        (0..self.cloud.variables).all(|i| (z[i] - center[i]).abs() <= patch.near * half[i])
    }

    /// Points in the variables of the patch.
    pub(super) fn data_of(&self, patch: &Patch<'_>, list: &[u32], degree: usize) -> Data<'_> {
        self.data((&patch.center, &patch.half), list, degree, patch.scale)
    }

    /// The highest degree that so many points determine; `None` where there are too few for any.
    pub(super) fn highest_of(&self, points: usize) -> Option<usize> {
        let equations = ((self.cloud.variables + 1) * points) as f64;
        let determined =
            |degree: usize| equations >= LEAST_EQUATIONS * self.terms.upto[degree] as f64;
        (1..=self.highest).rev().find(|d| determined(*d))
    }

    /// Points that are worth fitting a degree to.
    pub(super) fn most_points(&self, degree: usize) -> usize {
        let n = self.cloud.variables;
        let most = self.habits.most_equations * self.terms.upto[degree] as f64 / (n + 1) as f64;
        most.ceil() as usize
    }

    /// The patch's piece with the error over the one asked for; without bounds where its points are
    /// too few to tell.
    pub(super) fn piece_of(
        &self,
        patch: Patch<'_>,
        fitted: (Shape, Vec<f64>),
        bounds: Option<[f64; 2]>,
    ) -> (Piece, f64) {
        self.piece((patch.center, patch.half), fitted, bounds, patch.points)
    }
}
