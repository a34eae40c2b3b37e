//! A closed loop as programs: what is integrated, what is recorded.

use super::forcing::{Forcing, Motion};
use super::law::Law;
use crate::backend::{By, Guards, Spec};
use crate::expr::{Deviation, Graph, Id, Kind};
use crate::hamiltonian::{GuardExpr, Hamiltonian};
use crate::model::{Extremum, Horizon, Method, Model, Precision, Record};
use crate::program::Program;
use nalgebra::DMatrix;
use std::collections::HashMap;
use std::ops::Range;

/// Equations of a scene under a law, in deviations `s = x - reference` and forward time.
///
/// The integrated vector is `(s, q, H, J)`: q and the upper triangle of H (row by row) only where
/// the law is that of a chart, whose `p = q + H s` they hold constant. `J' = L`.
/// [`Equations::scaled`] has a duration T before J, by which all rates are multiplied.
///
/// With a [`Forcing`] it is `(s, q, H, d, W, J)`: d is what a trajectory's disturbance is made of,
/// `W' = L(x, u, 0) - L(x, u, w)` what the disturbance pays for, and `J' = L(x, u, 0)`. Without one
/// w = 0.
pub(super) struct Equations {
    graph: Graph,
    pub states: usize,
    pub controls: usize,
    /// Whether q and H are there.
    pub charted: bool,
    /// Components of d; none without a forcing.
    pub forcing: Range<usize>,
    /// Symbols of the integrated vector but for J.
    inputs: Vec<Id>,
    rate: Vec<Id>,
    guards: Vec<GuardExpr>,
    /// Of each record its expression and the time derivative of that.
    recorded: Vec<Id>,
    control: Vec<Id>,
    disturbance: Vec<Id>,
    /// At whose zeros a recorded expression has a kink.
    switches: Vec<Id>,
    terminal: Option<Id>,
    pub reference: Vec<f64>,
}

impl Equations {
    pub fn new(
        model: &Model,
        hamiltonian: &Hamiltonian,
        law: &Law,
        records: &[Record],
        forcing: Option<&Forcing>,
    ) -> Self {
        let mut graph = law.graph.clone();
        let n = model.states.len();
        let zero = graph.constant(0.0);
        let mut symbols: HashMap<Id, Deviation> = HashMap::new();
        for (symbol, at) in model.parameter_values() {
            symbols.insert(symbol, Deviation::new(at, zero));
        }
        let mut inputs = Vec::new();
        for (state, &at) in model.states.iter().zip(model.reference()) {
            let change = graph.symbol(&format!("d_{}", state.variable.name), Kind::State);
            symbols.insert(state.variable.symbol, Deviation::new(at, change));
            inputs.push(change);
        }
        let quadratic = forcing.and_then(|f| f.quadratic.as_ref());
        let charted = quadratic.is_none() && (law.charted || forcing.is_some());
        let p = match quadratic {
            Some(matrix) => linear(&mut graph, matrix, &inputs),
            None if charted => chart_symbols(&mut graph, &mut inputs, n),
            None => Vec::new(),
        };
        for (&symbol, change) in hamiltonian.p.iter().zip(p) {
            symbols.insert(symbol, Deviation::new(0.0, change));
        }
        let first = inputs.len();
        let motion = forcing.map(|_| Motion::new(model, hamiltonian, &mut graph));
        for &change in motion.iter().flat_map(|m| &m.components) {
            symbols.insert(change, Deviation::new(0.0, change));
            inputs.push(change);
        }
        let forced = first..inputs.len();
        let mut replaced: HashMap<Id, Id> = (model.controls.iter().zip(&law.control))
            .map(|(c, u)| (c.variable.symbol, *u))
            .collect();
        let disturbances = || model.disturbances.iter().map(|w| w.symbol);
        let without: HashMap<Id, Id> = disturbances().map(|w| (w, zero)).collect();
        let running = graph.substitute(&[model.running.expr], &without)[0];
        let supply = motion.as_ref().map(|m| m.supply);
        replaced.extend(match &motion {
            Some(motion) => disturbances().zip(motion.disturbance.clone()).collect(),
            None => without,
        });
        let roots: Vec<Id> = (model.dynamics.iter().map(|f| f.expr))
            .chain([running])
            .chain(supply)
            .chain(disturbances().filter(|_| forcing.is_some()))
            .chain(records.iter().map(|r| r.of.expr))
            .chain(model.controls.iter().map(|c| c.variable.symbol))
            .chain(hamiltonian.guards.iter().map(|g| g.condition.expr))
            .chain(match &model.horizon {
                Horizon::Finite { terminal, .. } => Some(terminal.expr),
                Horizon::Infinite { .. } => None,
            })
            .collect();
        let closed = graph.substitute(&roots, &replaced);
        let forms = graph.deviations(&closed, &symbols);
        let mut whole = forms
            .into_iter()
            .map(|f| graph.whole(f))
            .collect::<Vec<_>>()
            .into_iter();
        let mut take = |count: usize| whole.by_ref().take(count).collect::<Vec<Id>>();
        let (f, running) = (take(n), take(1)[0]);
        let supply = take(usize::from(forcing.is_some())).first().copied();
        let disturbance = take(forcing.map_or(0, |_| model.disturbances.len()));
        let (values, control) = (take(records.len()), take(model.controls.len()));
        let guards = (hamiltonian
            .guards
            .iter()
            .zip(take(hamiltonian.guards.len())))
        .map(|(g, expr)| GuardExpr {
            name: g.name.clone(),
            expr,
            strict: g.strict,
        })
        .collect();
        let terminal = take(1).first().copied();
        let sought = records
            .iter()
            .zip(&values)
            .filter(|(r, _)| r.extremum != Extremum::Final);
        let sought: Vec<Id> = sought.map(|(_, value)| *value).collect();
        let switches = graph.kinks(&sought);
        let mut recorded = Vec::new();
        for value in values {
            let terms: Vec<Id> = (0..n)
                .map(|i| {
                    let slope = graph.diff(value, inputs[i]);
                    graph.mul(slope, f[i])
                })
                .collect();
            recorded.extend([value, graph.sum(&terms)]);
        }
        let mut rate = f;
        rate.resize(inputs.len(), zero);
        if let (Some(supply), Some(motion)) = (supply, &motion) {
            rate[first + motion.time] = graph.constant(1.0);
            rate.push(supply);
            inputs.push(graph.symbol("supplied", Kind::State));
        }
        rate.push(running);
        Self {
            states: n,
            controls: model.controls.len(),
            charted,
            forcing: forced,
            disturbance,
            inputs,
            rate,
            guards,
            recorded,
            control,
            switches,
            terminal,
            reference: model.reference().to_vec(),
            graph,
        }
    }

    /// The same over `tau` from 0 to 1, T being the duration: a component before J.
    pub fn scaled(&self) -> Self {
        let mut graph = self.graph.clone();
        let duration = graph.symbol("duration", Kind::State);
        let mut inputs = self.inputs.clone();
        inputs.push(duration);
        let mut rate: Vec<Id> = self.rate.iter().map(|r| graph.mul(duration, *r)).collect();
        rate.insert(inputs.len() - 1, graph.constant(0.0));
        Self {
            graph,
            inputs,
            rate,
            guards: self.guards.clone(),
            recorded: self.recorded.clone(),
            control: self.control.clone(),
            disturbance: self.disturbance.clone(),
            forcing: self.forcing.clone(),
            switches: self.switches.clone(),
            reference: self.reference.clone(),
            ..*self
        }
    }

    pub fn without_guards(self) -> Self {
        Self {
            guards: Vec::new(),
            ..self
        }
    }

    /// Components of the integrated vector.
    pub fn dim(&self) -> usize {
        self.rate.len()
    }

    /// Index of J.
    pub fn cost(&self) -> usize {
        self.dim() - 1
    }

    /// Index of W, where there is a forcing.
    pub fn supplied(&self) -> Option<usize> {
        (!self.forcing.is_empty()).then_some(self.forcing.end)
    }

    /// Operations of a right-hand side.
    pub fn operations(&self) -> usize {
        self.program(&self.rate).code.len()
    }

    fn program(&self, roots: &[Id]) -> Program {
        Program::lower(&self.graph, &self.inputs, roots)
    }

    /// The states' derivatives and the running cost.
    pub fn rates(&self) -> Program {
        let mut roots = self.rate[..self.states].to_vec();
        roots.extend(self.rate.last());
        self.program(&roots)
    }

    pub fn spec(&self, method: Method, precision: Precision, store: bool) -> Spec {
        let mut graph = self.graph.clone();
        let kinks = graph.kinks(&self.rate);
        let guards: Vec<Id> = self.guards.iter().map(|g| g.expr).collect();
        Spec {
            rate: self.program(&self.rate),
            guards: (!guards.is_empty()).then(|| Guards {
                program: self.program(&guards),
                strict: self.guards.iter().map(|g| g.strict).collect(),
            }),
            kinks: (!kinks.is_empty()).then(|| Program::lower(&graph, &self.inputs, &kinks)),
            method,
            precision,
            by: By::Time,
            store,
        }
    }

    /// Values and time derivatives of the records, then the controls, then the arguments at whose
    /// zeros records have kinks, then the disturbances of a forcing.
    pub fn observed(&self) -> Program {
        self.program(
            &[
                self.recorded.as_slice(),
                &self.control,
                &self.switches,
                &self.disturbance,
            ]
            .concat(),
        )
    }

    /// Columns of [`Self::observed`] with the controls.
    pub fn control_columns(&self) -> Range<usize> {
        self.recorded.len()..self.recorded.len() + self.controls
    }

    /// Columns of [`Self::observed`] with the arguments of kinks.
    pub fn switch_columns(&self) -> Range<usize> {
        let first = self.recorded.len() + self.controls;
        first..first + self.switches.len()
    }

    /// Columns of [`Self::observed`] with the disturbances; none without a forcing.
    pub fn disturbance_columns(&self) -> Range<usize> {
        let first = self.switch_columns().end;
        first..first + self.disturbance.len()
    }

    /// Values of the guards.
    pub fn guard_values(&self) -> Option<Program> {
        let exprs: Vec<Id> = self.guards.iter().map(|g| g.expr).collect();
        (!exprs.is_empty()).then(|| self.program(&exprs))
    }

    /// The terminal cost, where the horizon is finite.
    pub fn terminal(&self) -> Option<Program> {
        self.terminal.map(|t| self.program(&[t]))
    }
}

/// `P s`.
fn linear(graph: &mut Graph, p: &DMatrix<f64>, s: &[Id]) -> Vec<Id> {
    (0..s.len())
        .map(|i| {
            let terms: Vec<Id> = (s.iter().enumerate())
                .map(|(j, s)| {
                    let entry = graph.constant(p[(i, j)]);
                    graph.mul(entry, *s)
                })
                .collect();
            graph.sum(&terms)
        })
        .collect()
}

/// Adds q and H to the inputs; returns `p = q + H s`.
fn chart_symbols(graph: &mut Graph, inputs: &mut Vec<Id>, n: usize) -> Vec<Id> {
    let s = inputs.clone();
    let q: Vec<Id> = (0..n)
        .map(|i| graph.symbol(&format!("q_{i}"), Kind::Adjoint))
        .collect();
    inputs.extend(&q);
    let mut h = vec![vec![q[0]; n]; n];
    for i in 0..n {
        for j in i..n {
            let entry = graph.symbol(&format!("H_{i}_{j}"), Kind::Adjoint);
            inputs.push(entry);
            (h[i][j], h[j][i]) = (entry, entry);
        }
    }
    (0..n)
        .map(|i| {
            let mut terms = vec![q[i]];
            for j in 0..n {
                terms.push(graph.mul(h[i][j], s[j]));
            }
            graph.sum(&terms)
        })
        .collect()
}

/// Writes a chart's answer at `s` into the components behind s: `q = p - H s`, then H's upper
/// triangle.
pub(super) fn set_chart(vector: &mut [f64], p: &[f64], hessian: &[f64]) {
    let n = p.len();
    let mut place = 2 * n;
    for i in 0..n {
        // Symmetric in what is kept: half the sum of both triangles.
        let entry = |j: usize| 0.5 * (hessian[i * n + j] + hessian[j * n + i]);
        let bent: f64 = (0..n).map(|j| entry(j) * vector[j]).sum();
        vector[n + i] = p[i] - bent;
        for j in i..n {
            vector[place] = entry(j);
            place += 1;
        }
    }
}

/// p at s of a vector's chart, as [`set_chart`] has written it.
pub(super) fn chart_of(vector: &[f64], n: usize) -> impl Iterator<Item = f64> {
    (0..n).map(move |i| {
        let entry = |j: usize| {
            let (row, column) = (i.min(j), i.max(j));
            vector[2 * n + row * n - row * (row + 1) / 2 + column]
        };
        vector[n + i] + (0..n).map(|j| entry(j) * vector[j]).sum::<f64>()
    })
}
