//! `scenarios/manufactured.toml`: V is chosen, the cost follows from it.

use super::Exact;
use costate::low_level::closed_loop::{Chart, Expansion};

/// Its parameter r.
const R: f64 = 0.5;

/// As the scene's head says; (1 - cos x)/2 without cancellation.
pub fn at(s: &[f64]) -> Exact {
    let [x, y] = [s[0], s[1]];
    let v = 0.5 * x * x + (0.5 * x).sin().powi(2) + 0.5 * x * y + y * y + 0.25 * x * x * y * y;
    let p = vec![
        x + 0.5 * x.sin() + 0.5 * y + 0.5 * x * y * y,
        0.5 * x + 2.0 * y + 0.5 * x * x * y,
    ];
    let u = vec![-p[1] / R];
    Exact { v, p, u }
}

pub fn value(s: &[f64]) -> f64 {
    at(s).v
}

/// The second derivatives of V, row-major.
pub fn hessian(s: &[f64]) -> [f64; 4] {
    let [x, y] = [s[0], s[1]];
    let xy = 0.5 + x * y;
    [1.0 + 0.5 * x.cos() + 0.5 * y * y, xy, xy, 2.0 + 0.5 * x * x]
}

/// V, known everywhere, as a closed loop asks for it.
pub struct Known;

impl Chart for Known {
    fn local(&self, x: &[f64]) -> Option<Expansion> {
        let Exact { v, p, .. } = at(x);
        let hessian = hessian(x).to_vec();
        Some(Expansion { v, p, hessian })
    }
}
