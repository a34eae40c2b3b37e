//! Solutions found at targets, and whether two of them are the same or lie on one sheet.

use crate::shooting::{Path, Solved};

/// Relative difference of adjoints below which two solutions at one state are the same.
const SAME: f64 = 1e-5;
/// How far the difference of two neighbours' adjoints may be from what their slopes predict,
/// relative to it.
const SMOOTH: f64 = 0.2;
/// The same for V, whose prediction from p is of higher order.
const SMOOTH_VALUE: f64 = 0.05;

/// An extremal from a target: a solution of the boundary value problem, optimal or not.
#[derive(Clone, Debug)]
pub struct Extremal {
    /// Target (in the survey's order).
    pub target: usize,
    /// Which of the survey's windings: the solution starts that many periods away from the target
    /// as given.
    pub winding: usize,
    pub path: Path,
    pub solved: Solved,
    pub iterations: u32,
}

impl Extremal {
    pub fn value(&self) -> f64 {
        self.solved.value
    }

    pub fn adjoint(&self) -> &[f64] {
        self.path.adjoint()
    }
}

/// Scaled adjoints of a solution.
fn scaled(p: &[f64], scales: &[f64]) -> Vec<f64> {
    let n = p.len();
    p.iter().zip(&scales[n..]).map(|(p, s)| p / s).collect()
}

fn largest(v: impl IntoIterator<Item = f64>) -> f64 {
    v.into_iter().fold(0.0, |a, x| a.max(x.abs()))
}

/// The largest component of an adjoint or of a difference of some, scaled.
pub fn largest_of(scales: &[f64], of: impl Fn(usize) -> f64) -> f64 {
    let n = scales.len() / 2;
    largest((0..n).map(|i| of(i) / scales[n + i]))
}

/// Whether two solutions from the same state are one.
pub fn same(a: &[f64], b: &[f64], scales: &[f64]) -> bool {
    alike(a, b, scales, SAME)
}

/// Whether two adjoints differ by at most a share of the largest component.
pub fn alike(a: &[f64], b: &[f64], scales: &[f64], share: f64) -> bool {
    let (a, b) = (scaled(a, scales), scaled(b, scales));
    let size = largest(a.iter().chain(&b).copied());
    largest(a.iter().zip(&b).map(|(x, y)| x - y)) <= share * size
}

/// How far two neighbours are from being joined by a smooth sheet: below 1 they fit.
pub fn misfit(a: &Extremal, b: &Extremal, scales: &[f64]) -> f64 {
    let n = a.adjoint().len();
    let (Some(sa), Some(sb)) = (&a.solved.slope, &b.solved.slope) else {
        return f64::INFINITY;
    };
    let h: Vec<f64> = (0..n)
        .map(|i| (b.path.start()[i] - a.path.start()[i]) / scales[i])
        .collect();
    let (pa, pb) = (scaled(a.adjoint(), scales), scaled(b.adjoint(), scales));
    let along = |s: &[f64]| -> Vec<f64> {
        (0..n)
            .map(|i| (0..n).map(|j| s[i * n + j] * h[j]).sum())
            .collect()
    };
    let (from_a, from_b) = (along(sa), along(sb));
    let change: Vec<f64> = (0..n).map(|i| pb[i] - pa[i]).collect();
    let predicted: Vec<f64> = (0..n).map(|i| 0.5 * (from_a[i] + from_b[i])).collect();
    // The slopes must agree with each other too, or their mean says little.
    let size = largest(change.iter().chain(&predicted).copied())
        .max(SAME * largest(pa.iter().chain(&pb).copied()));
    let off = largest((0..n).map(|i| change[i] - predicted[i]));
    // Scaled V: p and s are scaled so that their product is in units of the value's scale.
    let scale = scales[0] * scales[n];
    let mean: f64 = (0..n).map(|i| 0.5 * (pa[i] + pb[i]) * h[i]).sum();
    let moved = (b.value() - a.value()) / scale;
    let travel: f64 = (0..n)
        .map(|i| (0.5 * (pa[i].abs() + pb[i].abs()) * h[i]).abs())
        .sum();
    let value = (moved - mean).abs() / (SMOOTH_VALUE * travel + 1e-12);
    (off / (SMOOTH * size)).max(value)
}

/// Adjoint (scaled) that a solution's sheet is expected to have at a state near its own.
pub fn predicted(a: &Extremal, state: &[f64], scales: &[f64]) -> Option<(Vec<f64>, f64)> {
    let n = a.adjoint().len();
    let slope = a.solved.slope.as_ref()?;
    let h: Vec<f64> = (0..n)
        .map(|i| (state[i] - a.path.start()[i]) / scales[i])
        .collect();
    let p = scaled(a.adjoint(), scales);
    let change: Vec<f64> = (0..n)
        .map(|i| (0..n).map(|j| slope[i * n + j] * h[j]).sum())
        .collect();
    let size = largest(change.iter().copied());
    Some(((0..n).map(|i| p[i] + change[i]).collect(), size))
}

/// V that a solution's sheet is expected to have at a state near its own, to second order; and the
/// sum of the changes along the axes, whatever their signs.
pub fn expected_value(a: &Extremal, state: &[f64], scales: &[f64]) -> Option<(f64, f64)> {
    let n = a.adjoint().len();
    let (there, _) = predicted(a, state, scales)?;
    let h = |i: usize| (state[i] - a.path.start()[i]) / scales[i];
    let p = scaled(a.adjoint(), scales);
    let scale = scales[0] * scales[n];
    let along = |i: usize| 0.5 * scale * (p[i] + there[i]) * h(i);
    let change: f64 = (0..n).map(along).sum();
    Some((a.value() + change, (0..n).map(|i| along(i).abs()).sum()))
}

/// Whether a point `(s, p)` of a trajectory is clearly off the sheet of a solution near it.
pub fn is_elsewhere(a: &Extremal, node: &[f64], scales: &[f64]) -> bool {
    let n = a.adjoint().len();
    let Some((expected, change)) = predicted(a, &node[..n], scales) else {
        return false;
    };
    let p = scaled(&node[n..], scales);
    let size = largest(p.iter().chain(&expected).copied());
    largest((0..n).map(|i| p[i] - expected[i])) > 0.5 * change + 0.05 * size
}
