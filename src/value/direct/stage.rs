//! A step of the transcribed problem: state and cost after it, with derivatives by state and control.

use crate::backend::cpu::map::Evaluator;
use crate::expr::Kind;
use crate::model::Model;
use crate::program::Program;
use nalgebra::DMatrix;
use std::collections::HashMap;

/// Stages of the classical fourth-order method.
const NODES: [f64; 4] = [0.0, 0.5, 0.5, 1.0];
const WEIGHTS: [f64; 4] = [1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0];

/// f and L with their derivatives, of a deviation and the controls.
pub(super) struct Rates {
    rates: Evaluator,
    derivatives: Evaluator,
    pub states: usize,
    pub controls: usize,
}

/// Steps from states under constant controls, all at once: of each the state and the cost after it.
pub(super) struct Steps {
    /// `[step][n]`.
    pub next: Vec<f64>,
    pub cost: Vec<f64>,
    /// `(x, u)` at the stages, `[stage][step][n + m]`.
    stages: Vec<Vec<f64>>,
}

/// Derivatives of one step by `(x, u)`, row by row.
pub(super) struct Slopes {
    /// `[n][n + m]`.
    pub jacobian: Vec<f64>,
    pub gradient: Vec<f64>,
    /// Of Gauss-Newton: without the dynamics' curvature, and not negative. `[n + m][n + m]`.
    pub hessian: Vec<f64>,
}

impl Rates {
    pub fn new(model: &Model) -> Self {
        let mut graph = model.graph.clone();
        let n = model.states.len();
        let mut values: HashMap<_, _> = HashMap::new();
        for (symbol, value) in model.parameter_values() {
            values.insert(symbol, graph.constant(value));
        }
        let mut inputs = Vec::new();
        for (state, &at) in model.states.iter().zip(model.reference()) {
            let name = format!("direct {}", state.variable.name);
            let deviation = graph.symbol(&name, Kind::State);
            let at = graph.constant(at);
            values.insert(state.variable.symbol, graph.add(deviation, at));
            inputs.push(deviation);
        }
        inputs.extend(model.controls.iter().map(|c| c.variable.symbol));
        let open: Vec<_> = (model.dynamics.iter())
            .map(|d| d.expr)
            .chain([model.running.expr])
            .collect();
        let rates = graph.substitute(&open, &values);
        let mut derivatives = Vec::new();
        for rate in &rates {
            derivatives.extend(inputs.iter().map(|z| graph.diff(*rate, *z)));
        }
        for k in n * inputs.len()..(n + 1) * inputs.len() {
            let slope = derivatives[k];
            derivatives.extend(inputs.iter().map(|z| graph.diff(slope, *z)));
        }
        let lower = |roots: &[_]| Evaluator::new(&Program::lower(&graph, &inputs, roots));
        Self {
            rates: lower(&rates),
            derivatives: lower(&derivatives),
            states: n,
            controls: model.controls.len(),
        }
    }

    /// Steps of the classical fourth-order method from `x`, `[step][n]`, under `u`, `[step][m]`; `None` where one is not finite.
    pub fn steps(&self, x: &[f64], u: &[f64], h: f64) -> Option<Steps> {
        let (n, m) = (self.states, self.controls);
        let (width, count) = (n + m, u.len() / m);
        let mut steps = Steps {
            next: x[..count * n].to_vec(),
            cost: vec![0.0; count],
            stages: Vec::with_capacity(NODES.len()),
        };
        let mut rates = vec![0.0; count * (n + 1)];
        for (node, weight) in NODES.into_iter().zip(WEIGHTS) {
            let mut at = Vec::with_capacity(count * width);
            for k in 0..count {
                at.extend((0..n).map(|i| x[k * n + i] + node * h * rates[k * (n + 1) + i]));
                at.extend_from_slice(&u[k * m..][..m]);
            }
            rates = self.rates.eval(&at, width);
            for k in 0..count {
                let rate = &rates[k * (n + 1)..][..=n];
                (0..n).for_each(|i| steps.next[k * n + i] += weight * h * rate[i]);
                steps.cost[k] += weight * h * rate[n];
            }
            steps.stages.push(at);
        }
        let finite = steps.next.iter().chain(&steps.cost).all(|v| v.is_finite());
        finite.then_some(steps)
    }

    /// Derivatives of steps, through all stages.
    pub fn slopes(&self, steps: &Steps, h: f64) -> Vec<Slopes> {
        let (n, width) = (self.states, self.states + self.controls);
        let outputs = (n + 1) * width + width * width;
        let all: Vec<Vec<f64>> = steps.stages.iter().map(|at| self.derivatives.eval(at, width)).collect();
        let mut by_stage = vec![0.0; width * width];
        let mut slope = vec![0.0; n * width];
        let mut product = vec![0.0; width * width];
        (0..steps.cost.len())
            .map(|k| {
                let mut slopes = Slopes {
                    jacobian: vec![0.0; n * width],
                    gradient: vec![0.0; width],
                    hessian: vec![0.0; width * width],
                };
                slope.fill(0.0);
                for i in 0..n {
                    slopes.jacobian[i * width + i] = 1.0;
                }
                for (stage, (node, weight)) in NODES.into_iter().zip(WEIGHTS).enumerate() {
                    let here = &all[stage][k * outputs..][..outputs];
                    let (first, rest) = here.split_at(n * width);
                    let (gradient, second) = rest.split_at(width);
                    // d(stage)/d(x, u)
                    by_stage.fill(0.0);
                    for i in 0..width {
                        by_stage[i * width + i] = 1.0;
                    }
                    for (b, s) in by_stage.iter_mut().zip(&slope) {
                        *b += node * h * s;
                    }
                    times(first, &by_stage, n, width, width, &mut slope);
                    for (j, s) in slopes.jacobian.iter_mut().zip(&slope) {
                        *j += weight * h * s;
                    }
                    times(second, &by_stage, width, width, width, &mut product);
                    for a in 0..width {
                        for i in 0..width {
                            let share = weight * h * by_stage[i * width + a];
                            slopes.gradient[a] += share * gradient[i];
                            for b in 0..width {
                                slopes.hessian[a * width + b] += share * product[i * width + b];
                            }
                        }
                    }
                }
                not_negative(&mut slopes.hessian, width);
                slopes
            })
            .collect()
    }
}

/// `c = a b` for matrices of `rows x inner` and `inner x columns`, row by row.
pub(super) fn times(a: &[f64], b: &[f64], rows: usize, inner: usize, columns: usize, c: &mut [f64]) {
    for i in 0..rows {
        let row = &mut c[i * columns..(i + 1) * columns];
        row.fill(0.0);
        for k in 0..inner {
            let factor = a[i * inner + k];
            for (c, b) in row.iter_mut().zip(&b[k * columns..(k + 1) * columns]) {
                *c += factor * b;
            }
        }
    }
}

/// Replaces negative eigenvalues of a symmetric matrix by 0.
fn not_negative(matrix: &mut [f64], width: usize) {
    let square = DMatrix::from_row_slice(width, width, matrix);
    if square.clone().cholesky().is_some() {
        return;
    }
    let mut eigen = square.symmetric_eigen();
    eigen.eigenvalues.iter_mut().for_each(|v| *v = v.max(0.0));
    matrix.copy_from_slice(eigen.recompose().as_slice());
}
