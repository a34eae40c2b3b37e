//! `scenarios/hopf_lax.toml`: a free particle, `x' = u`, `L = |u|^2/2`, with terminal cost
//! `phi(x) + y^2/2`, `phi(x) = x^4/4 - k x^2/2 + slant x`. Costates are constant along trajectories,
//! which are straight: with a time T left `x = e + T phi'(e)` for an end e, and V is the least of
//! `phi(e) + (x - e)^2/(2 T)` over all ends (Hopf and Lax).

use super::{Exact, parameter};
use costate::low_level::model::Model;

/// The problem with a time left.
#[derive(Clone, Copy, Debug)]
pub struct TwoWells {
    /// T.
    pub left: f64,
    pub k: f64,
    pub slant: f64,
}

/// A straight way to an end, in x.
#[derive(Clone, Copy, Debug)]
pub struct Way {
    pub end: f64,
    /// What it costs.
    pub v: f64,
    /// dV/dx of its sheet.
    pub p: f64,
}

impl TwoWells {
    /// As the scene is shipped, with a time left.
    pub fn with(left: f64) -> Self {
        Self {
            left,
            k: 2.0,
            slant: 0.1,
        }
    }

    /// With the parameters of a scene, at its beginning.
    pub fn of(model: &Model) -> Self {
        let [left, k, slant] = ["T", "k", "slant"].map(|name| parameter(model, name));
        Self { left, k, slant }
    }

    fn terminal(&self, e: f64) -> f64 {
        e.powi(4) / 4.0 - 0.5 * self.k * e * e + self.slant * e
    }

    fn slope(&self, e: f64) -> f64 {
        e.powi(3) - self.k * e + self.slant
    }

    /// Where the straight way to an end begins.
    pub fn start(&self, e: f64) -> f64 {
        e + self.left * self.slope(e)
    }

    /// All extremals from x, the cheapest first: by Newton's method from many ends.
    pub fn ways(&self, x: f64) -> Vec<Way> {
        let mut ends: Vec<f64> = Vec::new();
        for k in -60..=60 {
            let mut e = f64::from(k) * 0.05;
            for _ in 0..60 {
                e -= (self.start(e) - x) / (1.0 + self.left * (3.0 * e * e - self.k));
            }
            let good = (self.start(e) - x).abs() < 1e-12;
            if good && ends.iter().all(|other| (e - other).abs() > 1e-6) {
                ends.push(e);
            }
        }
        let mut ways: Vec<Way> = (ends.into_iter())
            .map(|end| Way {
                end,
                v: self.terminal(end) + 0.5 * self.left * self.slope(end).powi(2),
                p: self.slope(end),
            })
            .collect();
        ways.sort_by(|a, b| a.v.total_cmp(&b.v));
        ways
    }

    /// What y costs by itself: its part of V, and dV/dy.
    pub fn across(&self, y: f64) -> (f64, f64) {
        let p = y / (1.0 + self.left);
        (0.5 * y * p, p)
    }

    pub fn at(&self, s: &[f64]) -> Exact {
        let way = self.ways(s[0])[0];
        let (v, p) = self.across(s[1]);
        Exact {
            v: way.v + v,
            p: vec![way.p, p],
            u: vec![-way.p, -p],
        }
    }

    /// Where both wells cost the same, by symmetry about it; there are two sheets where the time
    /// left is more than 1/k.
    pub fn equal_cost(&self) -> f64 {
        self.left * self.slant
    }
}
