//! The slope `X = dp/dx` of the manifold along its characteristics, and where the manifold folds.
//!
//! Neighbouring characteristics of a manifold that projects one-to-one have `dp = X dx`, X
//! symmetric (the manifold is Lagrangian; where V exists X is its Hessian). From the variational
//! equations, with H's derivatives on the characteristic, backward in time: `X' = H_xx + H_xp X + X
//! H_px + X H_pp X`, the Riccati differential equation. X grows without limit exactly where `det
//! dx/dseed = 0`: there the projection folds (a conjugate point, a point of the caustic), in the
//! direction of time in which the equation is stable. (W. T. Reid, Riccati Differential Equations,
//! 1972; A. J. van der Schaft, L2-Gain and Passivity Techniques in Nonlinear Control, chapter 11,
//! for the Lagrangian manifold of a game.)

use super::System;
use crate::expr::{Graph, Id, Kind};
use crate::model::Precision;

/// A slope this many times its scale counts as infinite: the fold then lies as small a part of the
/// trajectory's own time scale ahead, and is extrapolated to. In single precision steps that follow
/// the slope further are lost in rounding.
pub fn infinite(precision: Precision) -> f64 {
    match precision {
        Precision::F64 => 1e6,
        Precision::F32 => 1e4,
    }
}

/// The equation of X.
#[derive(Clone, Debug)]
pub struct Slope {
    /// Symbols of X's upper triangle, row by row.
    pub symbols: Vec<Id>,
    /// Their rates by backward time.
    pub rate: Vec<Id>,
    /// Positive before a fold.
    pub guard: Id,
}

impl Slope {
    /// The equation along a system's characteristics; enters its expressions into `graph`, the
    /// system's own or a copy. `units` are the scales of X's entries (row-major); the guard is
    /// positive up to `limit` of them.
    pub fn new(graph: &mut Graph, system: &System, units: &[f64], limit: f64) -> Self {
        let n = system.states;
        let mut symbols = Vec::new();
        let zero = graph.constant(0.0);
        let mut x = vec![vec![zero; n]; n];
        for i in 0..n {
            for j in i..n {
                let entry = graph.symbol(&format!("X_{i}_{j}"), Kind::Adjoint);
                symbols.push(entry);
                (x[i][j], x[j][i]) = (entry, entry);
            }
        }
        // Columns of the Jacobian of the backward rates (a, b) of (s, p).
        let jacobian: Vec<Vec<Id>> = (system.inputs.iter())
            .map(|z| graph.diff_all(&system.rate[..2 * n], *z))
            .collect();
        let product =
            |graph: &mut Graph, left: &dyn Fn(usize) -> Id, right: &dyn Fn(usize) -> Id| {
                let terms: Vec<Id> = (0..n).map(|k| graph.mul(left(k), right(k))).collect();
                graph.sum(&terms)
            };
        // Y = a_s + a_p X, by which neighbours part; X' = b_s + b_p X - X Y.
        let mut parting = vec![vec![zero; n]; n];
        for (i, row) in parting.iter_mut().enumerate() {
            for (j, entry) in row.iter_mut().enumerate() {
                let turned = product(graph, &|k| jacobian[n + k][i], &|k| x[k][j]);
                *entry = graph.add(jacobian[j][i], turned);
            }
        }
        let mut rate = Vec::new();
        for i in 0..n {
            for j in i..n {
                let turned = product(graph, &|k| jacobian[n + k][n + i], &|k| x[k][j]);
                let driven = graph.add(jacobian[j][n + i], turned);
                let carried = product(graph, &|k| x[i][k], &|k| parting[k][j]);
                rate.push(graph.sub(driven, carried));
            }
        }
        let squares: Vec<Id> = (0..n * n)
            .map(|q| {
                let unit = graph.constant(1.0 / (limit * units[q]));
                let scaled = graph.mul(x[q / n][q % n], unit);
                graph.powi(scaled, 2)
            })
            .collect();
        let size = graph.sum(&squares);
        let one = graph.constant(1.0);
        let guard = graph.sub(one, size);
        Self {
            symbols,
            rate,
            guard,
        }
    }

    /// Number of entries of X's upper triangle.
    pub fn len(states: usize) -> usize {
        states * (states + 1) / 2
    }

    /// Upper triangle, row by row, of a matrix (row-major); symmetric in what is kept.
    pub fn packed(matrix: &[f64], states: usize) -> Vec<f64> {
        let n = states;
        (0..n)
            .flat_map(|i| (i..n).map(move |j| 0.5 * (matrix[i * n + j] + matrix[j * n + i])))
            .collect()
    }

    /// Product of two matrices entry by entry, summed, in scaled units; of upper triangles.
    pub fn product(a: &[f64], b: &[f64], units: &[f64], states: usize) -> f64 {
        let n = states;
        let places = (0..n).flat_map(|i| (i..n).map(move |j| (i, j)));
        (places.zip(a.iter().zip(b)))
            .map(|((i, j), (a, b))| {
                let twice = if i == j { 1.0 } else { 2.0 };
                twice * a * b / units[i * n + j].powi(2)
            })
            .sum()
    }
}
