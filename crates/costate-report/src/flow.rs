//! The optimal motion between stored samples.

use costate::low_level::expr::{Id, Values};
use costate::low_level::hamiltonian::Hamiltonian;
use costate::low_level::model::Model;
use costate::low_level::numeric::hermite::hermite;
use costate::low_level::trajectories::SweptTrajectories;

/// Points between two samples.
const BETWEEN: usize = 8;

/// Evaluates the equations of a scene at samples.
pub struct Flow<'s> {
    hamiltonian: &'s Hamiltonian,
    values: Values,
    roots: Vec<Id>,
}

impl<'s> Flow<'s> {
    pub fn new(model: &Model, hamiltonian: &'s Hamiltonian) -> Self {
        let mut roots = hamiltonian.state_rate.clone();
        roots.push(hamiltonian.running);
        Self {
            hamiltonian,
            values: model.parameter_values(),
            roots,
        }
    }

    /// x' and, last, the running cost.
    pub fn at(&mut self, x: &[f64], p: &[f64]) -> Vec<f64> {
        let h = self.hamiltonian;
        self.values
            .extend(h.x.iter().copied().zip(x.iter().copied()));
        self.values
            .extend(h.p.iter().copied().zip(p.iter().copied()));
        h.graph.eval(&self.roots, &self.values)
    }

    /// The state at each sample of a trajectory and at some times between samples (cubic Hermite
    /// interpolation), with the number of the sample before and the time. Of trajectories that are
    /// values alone the states at samples, without times.
    pub fn path(&mut self, t: &SweptTrajectories, k: usize) -> Vec<(usize, f64, Vec<f64>)> {
        let n = self.hamiltonian.x.len();
        if !t.is_full() {
            return (k * t.samples..(k + 1) * t.samples)
                .filter(|s| t.v[*s].is_finite())
                .map(|s| (s, f64::NAN, t.x[s * n..(s + 1) * n].to_vec()))
                .collect();
        }
        let mut path: Vec<(usize, f64, Vec<f64>)> = Vec::new();
        let mut before: Option<(usize, Vec<f64>)> = None;
        for s in k * t.samples..(k + 1) * t.samples {
            if !t.v[s].is_finite() {
                before = None;
                continue;
            }
            let x = &t.x[s * n..(s + 1) * n];
            let rate = self.at(x, &t.p[s * n..(s + 1) * n]);
            if let Some((last, slope)) = &before {
                let from = &t.x[last * n..(last + 1) * n];
                let h = t.t[s] - t.t[*last];
                for j in 1..BETWEEN {
                    let q = j as f64 / BETWEEN as f64;
                    let state = (0..n)
                        .map(|i| hermite(q, h, [from[i], slope[i]], [x[i], rate[i]]))
                        .collect();
                    path.push((*last, t.t[*last] + q * h, state));
                }
            }
            path.push((s, t.t[s], x.to_vec()));
            before = Some((s, rate));
        }
        path
    }
}
