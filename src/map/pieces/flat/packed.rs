//! Flat arrays as kernels on a device read them.

use super::{EVERYWHERE, Flat};
use crate::map::pieces::Shape;
use crate::map::swift::Packed;

impl Flat<f64> {
    /// Adds them, for states as deviations from `reference`; the names are those of
    /// `shaders/pieces.wgsl`.
    pub(crate) fn pack(&self, reference: &[f64], to: &mut Packed) {
        let n = self.states;
        let shifted = |values: &[f64]| -> Vec<f64> {
            values.iter().zip(reference).map(|(v, r)| v - r).collect()
        };
        to.number("LEAST_SIZE", self.floor);
        to.number("VALUE_MAX", self.value_max);
        to.reals("LO", shifted(&self.lo));
        to.reals("HI", shifted(&self.hi));
        to.reals("ORIGIN", shifted(&self.origin));
        to.reals("MATRIX", self.matrix.iter().copied());
        to.reals(
            "SPLITS",
            self.nodes
                .iter()
                .flat_map(|b| [b.at, b.reach[0], b.reach[1]]),
        );
        to.words(
            "NODES",
            self.nodes.iter().flat_map(|b| [b.axis, b.below, b.above]),
        );
        to.count("DEPTH", self.depth());
        to.reals("CELLS", self.cells.iter().copied());
        to.words("OWNED", self.owned.iter().copied());
        to.reals(
            "BOUNDS",
            self.heads.iter().flat_map(|h| [h.bound, h.p_bound]),
        );
        let head = |h: &super::Head<f64>| {
            [
                h.coefficients,
                h.degree.into(),
                h.shape as u32,
                h.sheet as u32,
                h.support,
            ]
        };
        to.words("HEADS", self.heads.iter().flat_map(head));
        for (name, shape) in [
            ("ROOT", Shape::Root),
            ("LOGARITHM", Shape::Logarithm),
            ("RECIPROCAL", Shape::Reciprocal),
        ] {
            to.count(name, shape as usize);
        }
        to.count("EVERYWHERE", EVERYWHERE as usize);
        to.reals("PLACES", self.places.iter().copied());
        to.reals("COEFFICIENTS", self.coefficients.iter().copied());
        to.reals("SUPPORTS", self.supports.iter().copied());
        to.reals("DIRECTION", self.directions.iter().copied());
        to.count("DIRECTIONS", self.directions.len() / n);
        to.count("MARGINS", self.margins);
        if let Some(shear) = &self.shear {
            shear.pack(to);
        }
    }

    /// Nodes that wait at most while the tree is walked, and one more.
    fn depth(&self) -> usize {
        let (mut most, mut open) = (0, vec![(0usize, 1usize)]);
        while let Some((at, depth)) = open.pop() {
            most = most.max(depth);
            let node = &self.nodes[at];
            if node.axis as usize != self.states {
                open.extend([
                    (node.below as usize, depth + 1),
                    (node.above as usize, depth + 1),
                ]);
            }
        }
        most + 1
    }
}
