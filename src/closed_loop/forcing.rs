//! Disturbances of a closed loop as expressions, so that they are integrated in the kernels like
//! everything else.

use crate::expr::{Fun, Graph, Id, Kind};
use crate::hamiltonian::Hamiltonian;
use crate::model::Model;
use nalgebra::DMatrix;
use rustc_hash::FxHashMap;

/// Sinusoids of a disturbance. The sum of so many with random phases is near a Gaussian process
/// (Shinozuka & Deodatis, Applied Mechanics Reviews 44, 1991: the spectral representation).
pub(super) const WAVES: usize = 8;

/// `w_j = c w*_j(x, p) + sum_k a_jk sin(b_jk t + f_jk)`, and where its p comes from.
pub(super) struct Forcing {
    /// P of `p = P s`; without it p is that of a chart.
    pub quadratic: Option<DMatrix<f64>>,
}

/// A forcing as expressions.
pub(super) struct Motion {
    /// c, then a, b, f of each wave of each disturbance, then t: symbols of constant components,
    /// but for t.
    pub components: Vec<Id>,
    /// Index of t among them.
    pub time: usize,
    /// One a disturbance, in the components and the Hamiltonian's x and p.
    pub disturbance: Vec<Id>,
    /// `L(x, u, 0) - L(x, u, w)`, in the scene's symbols.
    pub supply: Id,
}

/// One sinusoid, `amplitude sin(frequency t + phase)`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Wave {
    pub amplitude: f64,
    /// In radians a unit of time.
    pub frequency: f64,
    pub phase: f64,
}

/// Numbers that a trajectory's disturbance is made of, in the order of [`Motion::components`];
/// `waves` has [`WAVES`] a disturbance or fewer.
pub(super) fn components(worst: f64, waves: &[Vec<Wave>]) -> Vec<f64> {
    let mut all = vec![worst];
    for waves in waves {
        for k in 0..WAVES {
            let wave = waves.get(k).copied().unwrap_or_default();
            all.extend([wave.amplitude, wave.frequency, wave.phase]);
        }
    }
    all.push(0.0);
    all
}

impl Motion {
    pub fn new(model: &Model, hamiltonian: &Hamiltonian, graph: &mut Graph) -> Self {
        let constant = |graph: &mut Graph, name: &str| graph.symbol(name, Kind::State);
        let share = constant(graph, "worst");
        let mut components = vec![share];
        let time = graph.symbol("t", Kind::State);
        let mut disturbance = Vec::new();
        for worst in &hamiltonian.disturbance {
            let mut terms = vec![graph.mul(share, *worst)];
            for _ in 0..WAVES {
                let [a, b, f] =
                    ["amplitude", "frequency", "phase"].map(|name| constant(graph, name));
                components.extend([a, b, f]);
                let turned = graph.mul(b, time);
                let angle = graph.add(turned, f);
                let sine = graph.unary(Fun::Sin, angle);
                terms.push(graph.mul(a, sine));
            }
            disturbance.push(graph.sum(&terms));
        }
        components.push(time);
        Self {
            time: components.len() - 1,
            components,
            supply: supply(model, graph),
            disturbance,
        }
    }
}

/// L is quadratic in w: `-(L_w w + 1/2 w'L_ww w)`, which does not cancel as the difference of two L
/// would.
fn supply(model: &Model, graph: &mut Graph) -> Id {
    let w: Vec<Id> = model.disturbances.iter().map(|w| w.symbol).collect();
    let zero = graph.constant(0.0);
    let none: FxHashMap<Id, Id> = w.iter().map(|w| (*w, zero)).collect();
    let half = graph.constant(0.5);
    let mut terms = Vec::new();
    for &a in &w {
        let slope = graph.diff(model.running.expr, a);
        let first = graph.substitute(&[slope], &none)[0];
        terms.push(graph.mul(first, a));
        for &b in &w {
            let second = graph.diff(slope, b);
            let both = graph.mul(a, b);
            let product = graph.mul(second, both);
            terms.push(graph.mul(half, product));
        }
    }
    let all = graph.sum(&terms);
    graph.neg(all)
}
