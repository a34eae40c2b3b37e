//! Pieces in which all is met that pieces can be.

use costate::low_level::map::pieces::{
    Bend, Cell, Frame, Node, Piece, Pieces, Region, Shape, directions,
};
use costate::low_level::numeric::random::random;

/// Three states, cells turned against the axes, all functions of V, several sheets of several
/// degrees, and pieces that say something on one side only: made up, so that all of it is met.
pub fn made_up(region: Region) -> Pieces {
    let cell = |lo: [f64; 3], hi: [f64; 3], pieces| Cell {
        lo: lo.to_vec(),
        hi: hi.to_vec(),
        pieces,
    };
    let cells = vec![
        cell([0.0, 0.0, 0.0], [0.5, 1.0, 1.0], 0..2),
        cell([0.5, 0.0, 0.0], [1.0, 1.0, 0.4], 2..3),
        cell([0.5, 0.0, 0.4], [1.0, 1.0, 1.0], 3..5),
    ];
    let split = |axis, at, below, above| Node::Split {
        axis,
        at,
        below,
        above,
        reach: [at; 2],
    };
    let nodes = vec![
        split(0, 0.5, 1, 2),
        Node::Cell(0),
        split(2, 0.4, 3, 4),
        Node::Cell(1),
        Node::Cell(2),
    ];
    // Shape, number of terms, V in the middle, bound.
    let kinds = [
        (Shape::Value, 35, 2.0, 0.2),
        (Shape::Root, 20, 2.4, 1e-6),
        (Shape::Logarithm, 84, 2.0, 0.2),
        (Shape::Reciprocal, 10, 2.0, 0.2),
        (Shape::Value, 4, 1.9, f64::INFINITY),
    ];
    let piece = |(k, (shape, terms, v, bound)): (usize, (Shape, usize, f64, f64))| {
        let of = &cells.iter().find(|c| c.pieces.contains(&k)).unwrap();
        let middle = |i: usize| 0.5 * (of.lo[i] + of.hi[i]);
        let unit = |j: usize| random(21, (100 * k + j) as u64) as f64 / 2f64.powi(63) - 1.0;
        let mut coefficients: Vec<f64> = (0..terms).map(|j| 0.02 * unit(j)).collect();
        coefficients[0] = shape.of(v).0;
        Piece {
            center: (0..3).map(middle).collect(),
            half: (0..3).map(|i| 0.55 * (of.hi[i] - of.lo[i])).collect(),
            shape,
            coefficients,
            bound,
            p_bound: bound,
            sheet: k as i32,
            // The lower sheet of the third cell ends inside it, and a guard's shadow lies over the
            // first.
            support: match k {
                0 => vec![[-4.0, 4.0]; directions(3).len()],
                4 => vec![[-0.7, 0.2]; directions(3).len()],
                _ => Vec::new(),
            },
            clearance: match k {
                0 => vec![0.1, 0.4, -0.3, 0.2, 0.5, -0.2, 0.1, -0.6, 0.3, -0.4],
                _ => Vec::new(),
            },
        }
    };
    let pieces = kinds.into_iter().enumerate().map(piece).collect();
    let phi = (0..Bend::count(3))
        .map(|k| 0.2 * (1.3 * k as f64).sin())
        .collect();
    let frame = Frame {
        bend: Bend::new(3, 1, -0.7, 2.4, phi),
        ..Frame::steep(&region, &[0.5, -0.6, 0.3])
    };
    Pieces::new(region, frame, nodes, cells.clone(), pieces).unwrap()
}
