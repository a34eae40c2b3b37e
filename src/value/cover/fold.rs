//! Where swept trajectories fold: behind it, where they have passed conjugate points, none of them
//! costs the least (Jacobi's condition).

use super::fan::Fan;
use nalgebra::DMatrix;

/// The order of points, which are in single precision, is told where they are so far apart, in
/// widths of the region, and the volume that their edges span is at least so large, relative to its
/// largest.
const APART: f64 = 1e-5;
const FLAT: f64 = 1e-2;

/// Edges of a simplex of states in widths of the region, one a column.
struct Edges(DMatrix<f64>);

impl Edges {
    /// The signed volume that they span, relative to the largest of their lengths, unless they are
    /// too short or too flat for its sign to be known.
    fn order(&self) -> Option<f64> {
        let lengths = || self.0.column_iter().map(|edge| edge.norm());
        let order = self.0.determinant() / lengths().product::<f64>();
        (lengths().all(|length| length > APART) && order.abs() > FLAT).then_some(order)
    }
}

/// The first level at which the order of trajectories is not what it was first.
fn reversed(orders: impl Iterator<Item = (usize, Option<f64>)>) -> Option<usize> {
    let mut known = orders.filter_map(|(level, order)| Some((level, order?)));
    let (_, first) = known.next()?;
    known.find_map(|(level, order)| (order * first < 0.0).then_some(level))
}

impl Fan<'_> {
    /// The first level at which the trajectories of a simplex are ordered the other way round than
    /// they were: they have folded.
    pub fn fold(&self, simplex: &[u32]) -> Option<usize> {
        let (n, widths) = (self.plan.system.states, &self.plan.widths);
        let stride = 2 + 2 * n;
        let points: Vec<&[f32]> = simplex.iter().map(|seed| self.points(*seed)).collect();
        let levels = (points.iter().map(|p| p.len() / stride)).min().unwrap_or(0);
        let at = |q: usize, level: usize, i: usize| {
            f64::from(points[q][level * stride + 1 + i]) / widths[i]
        };
        // Edges from the first seed; where these leave one direction, the way on.
        let edges = |level: usize| {
            Edges(DMatrix::from_fn(n, n, |i, j| match simplex.get(j + 1) {
                Some(_) => at(j + 1, level, i) - at(0, level, i),
                None => at(0, level + 1, i) - at(0, level, i),
            }))
        };
        reversed((1..levels).map(|next| (next - 1, edges(next - 1).order())))
    }
}
