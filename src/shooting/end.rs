//! Where a trajectory of the boundary value problem ends: on the local stable manifold, or on the
//! terminal cost.

use crate::hamiltonian::System;
use crate::local::LocalSolution;
use crate::program::Program;

/// Error of V that the end may contribute, relative to V at the target.
const END_SHARE: f64 = 1e-11;
/// The end lies this much further inside than its error demands, so that it may move with the
/// target.
const ROOM: f64 = 0.25;

/// The condition `p = g(s)` at the end, with the cost from there on.
#[derive(Clone, Debug)]
pub enum End {
    /// `g` is the gradient of the local solution; the horizon is long enough for the end to lie in
    /// its range.
    Manifold(Box<LocalSolution>),
    /// `g` is the gradient of the terminal cost after a fixed time.
    Terminal { program: Program, time: f64 },
}

/// `V`, `g = dV/ds` and `dg/ds` (row-major) at an end.
pub struct AtEnd {
    pub value: f64,
    pub gradient: Vec<f64>,
    pub hessian: Vec<f64>,
}

impl End {
    /// # Panics
    /// When the system has an infinite horizon and no local solution is given.
    pub fn new(system: &System, local: Option<&LocalSolution>) -> Self {
        let Some(terminal) = &system.terminal else {
            return End::Manifold(Box::new(
                local
                    .expect("an infinite horizon has a local solution")
                    .clone(),
            ));
        };
        let mut graph = system.graph.clone();
        let n = system.states;
        let mut roots = vec![terminal.value];
        roots.extend(&terminal.gradient);
        for i in 0..n {
            for j in 0..n {
                roots.push(graph.diff(terminal.gradient[i], system.inputs[j]));
            }
        }
        End::Terminal {
            program: Program::lower(&graph, &system.inputs, &roots),
            time: terminal.time,
        }
    }

    pub fn at(&self, s: &[f64]) -> AtEnd {
        match self {
            End::Manifold(local) => {
                let (value, gradient, hessian) = local.expansion(s);
                AtEnd {
                    value,
                    gradient,
                    hessian,
                }
            }
            End::Terminal { program, .. } => {
                let n = s.len();
                // No adjoint enters the terminal cost.
                let inputs = [s, &vec![0.0; n]].concat();
                let all = program.eval(&inputs);
                AtEnd {
                    value: all[0],
                    gradient: all[1..=n].to_vec(),
                    hessian: all[1 + n..].to_vec(),
                }
            }
        }
    }

    /// Whether the end `s` of a trajectory that costs `value` lies where the condition holds to the
    /// accuracy asked.
    pub fn holds(&self, s: &[f64], value: f64) -> bool {
        match self {
            End::Manifold(local) => local.quadratic(s) <= Self::farthest(local, value),
            End::Terminal { .. } => true,
        }
    }

    /// The local solution's answer at a target so near the equilibrium that it needs no trajectory.
    pub fn covers(&self, s: &[f64]) -> bool {
        match self {
            End::Manifold(local) => {
                let quadratic = local.quadratic(s);
                quadratic <= Self::farthest(local, quadratic)
            }
            End::Terminal { .. } => false,
        }
    }

    fn farthest(local: &LocalSolution, value: f64) -> f64 {
        local.value_within(END_SHARE * value, f64::INFINITY)
    }

    /// V and p of the linearization at a deviation, where there is an equilibrium: a guess
    /// anywhere, an answer nowhere.
    pub fn linear(&self, s: &[f64]) -> Option<(f64, Vec<f64>)> {
        match self {
            End::Manifold(local) => {
                let p = &local.riccati.p * nalgebra::DVector::from_column_slice(s);
                Some((local.quadratic(s), p.iter().copied().collect()))
            }
            End::Terminal { .. } => None,
        }
    }

    /// Nodes `(s, p)` and durations that follow `s` on the local manifold until the end is deep
    /// enough for a trajectory of cost `value`; nothing where it is already, or on a finite
    /// horizon.
    pub fn tail(&self, s: &[f64], value: f64, duration: f64) -> (Vec<f64>, Vec<f64>) {
        let (mut nodes, mut durations) = (Vec::new(), Vec::new());
        let End::Manifold(local) = self else {
            return (nodes, durations);
        };
        let aim = ROOM * Self::farthest(local, value);
        let step = (&local.riccati.closed_loop * duration).exp();
        let mut s = nalgebra::DVector::from_column_slice(s);
        while local.quadratic(s.as_slice()) > aim && durations.len() < MOST_TAIL {
            s = &step * s;
            let at = local.at_state(s.as_slice());
            nodes.extend_from_slice(&at[..2 * s.len()]);
            durations.push(duration);
        }
        (nodes, durations)
    }
}

/// Segments that are added at once at most.
const MOST_TAIL: usize = 400;
