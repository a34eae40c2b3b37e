//! Second derivatives in numbers.

use super::{Graph, Id, Values};
use rustc_hash::FxHashMap;

impl Graph {
    /// The Hessian of `expr` by `symbols` at a point (row-major): the gradient's tangents along each
    /// symbol, in numbers, so that the work is that of some ten `expr` a symbol.
    ///
    /// # Panics
    /// When a symbol that `expr` depends on has no value.
    pub fn hessian(&mut self, expr: Id, symbols: &[Id], values: &Values) -> Vec<f64> {
        let gradient = self.gradient(expr, symbols);
        let along: Vec<Id> = (0..symbols.len())
            .map(|i| self.symbol(&format!("along {i}"), super::Kind::State))
            .collect();
        let directions: FxHashMap<Id, Id> =
            symbols.iter().copied().zip(along.iter().copied()).collect();
        let tangents = self.tangents(&gradient, &directions);
        let mut here = values.clone();
        let mut columns = Vec::with_capacity(symbols.len());
        for j in 0..symbols.len() {
            for (i, direction) in along.iter().enumerate() {
                here.insert(*direction, if i == j { 1.0 } else { 0.0 });
            }
            columns.push(self.eval(&tangents, &here));
        }
        let n = symbols.len();
        // Both triangles are the same but for rounding.
        (0..n * n)
            .map(|k| 0.5 * (columns[k % n][k / n] + columns[k / n][k % n]))
            .collect()
    }
}
