//! The pieces of a block once they are fitted: where they say something, and what tells against
//! them.

use super::flow::Residual;
use super::shadow::Edge;
use super::{BEYOND_OF_SEVERAL, Block, Builder, Piece};

/// Some of a block's points test its pieces; one of all that is off by so many bounds contradicts
/// them.
const GROSS: f64 = 3.0;

/// Pieces of a block before they are judged.
pub(super) struct Made {
    pieces: Vec<Piece>,
    /// Of shadows of guards, one a piece.
    edges: Vec<Edge>,
    /// How far points say that these are off, over what is good enough, at most.
    pub of_edges: f64,
    /// How far the pieces say something beyond their points, in half widths.
    beyond: f64,
    /// What the equation along the flow says of each.
    by_equation: Vec<Residual>,
    /// How far each is off at the block's points, at most.
    off: Vec<f64>,
}

impl Builder<'_> {
    /// Pieces of a block with their extents, from fits and their points, and what tells against
    /// them.
    pub(super) fn made(&self, block: &Block, own: &[(Piece, Vec<u32>)]) -> Made {
        // Of several sheets none says anything much beyond its own points.
        let beyond = if own.len() > 1 {
            self.region.beyond.min(BEYOND_OF_SEVERAL)
        } else {
            self.region.beyond
        };
        let (pieces, edges): (Vec<Piece>, Vec<Edge>) = (own.iter())
            .map(|(piece, points)| self.finished(piece.clone(), points, block, beyond))
            .unzip();
        Made {
            beyond,
            of_edges: edges.iter().map(|edge| edge.excess).fold(0.0, f64::max),
            by_equation: self.bounds_by_equation(&pieces),
            off: self.off_points(block, &pieces),
            pieces,
            edges,
        }
    }

    /// Whether a point is off by many bounds of a piece.
    fn is_far_off(&self, piece: &Piece, off: f64) -> bool {
        off > GROSS * piece.bound.max(self.region.error)
    }

    /// Whether something contradicts the pieces of a block.
    pub(super) fn is_wrong(&self, block: &Block, made: &Made) -> bool {
        let Made { pieces, off, .. } = made;
        // Halves ask for states of their own where the equation is not met; what cannot be halved
        // keeps to its points there.
        made.of_edges > 1.0
            || self.is_contradicted(pieces, &made.by_equation)
            || self.is_unfounded(block, pieces)
            || (pieces.iter().zip(off)).any(|(piece, off)| self.is_far_off(piece, *off))
    }

    /// Pieces that stay, kept to what their points and the equation bear out; with the edges of
    /// shadows.
    pub(super) fn judged(
        &self,
        block: &Block,
        own: &[(Piece, Vec<u32>)],
        made: Made,
    ) -> (Vec<Piece>, Vec<Edge>) {
        let mut pieces = made.pieces;
        for (k, (by, off)) in made.by_equation.into_iter().zip(made.off).enumerate() {
            let mut piece = pieces.remove(k);
            self.judge(&mut piece, by, &pieces, (&own[k].1, made.beyond));
            if self.is_far_off(&piece, off) {
                piece.bound = off;
            }
            pieces.insert(k, piece);
        }
        if self.is_unfounded(block, &pieces) {
            for (piece, (_, points)) in pieces.iter_mut().zip(own) {
                piece.support = self.enclosed(piece, points, 0.0);
            }
            if self.is_unfounded(block, &pieces) {
                pieces.clear();
            }
        }
        if let [piece] = pieces.as_mut_slice() {
            self.extend(piece, block);
        }
        (pieces, made.edges)
    }
}
