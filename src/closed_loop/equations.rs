//! A closed loop as programs: what is integrated, what is recorded.

use super::forcing::{Forcing, Motion};
use super::law::Law;
use crate::backend::{By, Guards, Spec};
use crate::expr::{Deviation, Graph, Id, Kind};
use crate::hamiltonian::{GuardExpr, Hamiltonian, deviations};
use crate::model::{Extremum, Horizon, Method, Model, Precision, Record};
use crate::program::Program;
use nalgebra::DMatrix;
use rustc_hash::FxHashMap;
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

/// Equations while their symbols get their meanings: from expressions in x, p, u and w to
/// expressions in the integrated vector.
struct Closing<'c> {
    model: &'c Model,
    hamiltonian: &'c Hamiltonian,
    graph: Graph,
    /// What stands for parameters, states, adjoints and what is integrated for a forcing.
    symbols: FxHashMap<Id, Deviation>,
    /// Symbols of the integrated vector but for J.
    inputs: Vec<Id>,
    zero: Id,
}

impl<'c> Closing<'c> {
    /// With numbers for parameters, and s as the first inputs.
    fn new(model: &'c Model, hamiltonian: &'c Hamiltonian, law: &Law) -> Self {
        let mut graph = law.graph.clone();
        let zero = graph.constant(0.0);
        let (inputs, symbols) = deviations(&mut graph, model);
        Self {
            model,
            hamiltonian,
            graph,
            symbols,
            inputs,
            zero,
        }
    }

    /// p: that of a quadratic V, or of a chart, whose q and H become inputs.
    fn set_adjoints(&mut self, quadratic: Option<&DMatrix<f64>>, charted: bool) {
        let n = self.model.states.len();
        let p = match quadratic {
            Some(matrix) => linear(&mut self.graph, matrix, &self.inputs),
            None if charted => chart_symbols(&mut self.graph, &mut self.inputs, n),
            None => Vec::new(),
        };
        for (&symbol, change) in self.hamiltonian.p.iter().zip(p) {
            self.symbols.insert(symbol, Deviation::new(0.0, change));
        }
    }

    /// The motion of a disturbance, whose components become inputs.
    fn set_motion(&mut self) -> Motion {
        let motion = Motion::new(self.model, self.hamiltonian, &mut self.graph);
        for &change in &motion.components {
            self.symbols.insert(change, Deviation::new(0.0, change));
            self.inputs.push(change);
        }
        motion
    }

    /// The running cost without disturbances.
    fn undisturbed_running(&mut self) -> Id {
        let disturbances = self.model.disturbances.iter();
        let without = disturbances.map(|w| (w.symbol, self.zero)).collect();
        let running = [self.model.running.expr];
        self.graph.substitute(&running, &without)[0]
    }

    /// What stands for controls under a law, and for disturbances under a motion; these are 0
    /// without one.
    fn replacements(&self, law: &Law, motion: Option<&Motion>) -> FxHashMap<Id, Id> {
        let mut replaced: FxHashMap<Id, Id> = (self.model.controls.iter().zip(&law.control))
            .map(|(c, u)| (c.variable.symbol, *u))
            .collect();
        let disturbances = self.model.disturbances.iter().map(|w| w.symbol);
        match motion {
            Some(motion) => replaced.extend(disturbances.zip(motion.disturbance.clone())),
            None => replaced.extend(disturbances.map(|w| (w, self.zero))),
        }
        replaced
    }

    /// All expressions, in the order in which [`Equations::new`] takes them apart again; `running`
    /// is the running cost without disturbances.
    fn roots(&self, running: Id, motion: Option<&Motion>, records: &[Record]) -> Vec<Id> {
        let model = self.model;
        let disturbances = model.disturbances.iter().map(|w| w.symbol);
        (model.dynamics.iter().map(|f| f.expr))
            .chain([running])
            .chain(motion.map(|m| m.supply))
            .chain(disturbances.filter(|_| motion.is_some()))
            .chain(records.iter().map(|r| r.of.expr))
            .chain(model.controls.iter().map(|c| c.variable.symbol))
            .chain(self.hamiltonian.guards.iter().map(|g| g.condition.expr))
            .chain(match &model.horizon {
                Horizon::Finite { terminal, .. } => Some(terminal.expr),
                Horizon::Infinite { .. } => None,
            })
            .collect()
    }

    /// Expressions of the integrated vector, in whole numbers (not as deviations).
    fn closed(&mut self, roots: &[Id], replaced: &FxHashMap<Id, Id>) -> Vec<Id> {
        let closed = self.graph.substitute(roots, replaced);
        let forms = self.graph.deviations(&closed, &self.symbols);
        forms.into_iter().map(|f| self.graph.whole(f)).collect()
    }

    /// The arguments at whose zeros records have kinks, so far as an extremum of these is sought.
    fn switches(&mut self, records: &[Record], values: &[Id]) -> Vec<Id> {
        let sought = records
            .iter()
            .zip(values)
            .filter(|(r, _)| r.extremum != Extremum::Final);
        let sought: Vec<Id> = sought.map(|(_, value)| *value).collect();
        self.graph.kinks(&sought)
    }

    /// Of each value the value and its derivative along the rates of s.
    fn with_derivatives(&mut self, values: Vec<Id>, rates: &[Id]) -> Vec<Id> {
        let (graph, inputs) = (&mut self.graph, &self.inputs);
        let mut recorded = Vec::new();
        for value in values {
            let terms: Vec<Id> = (rates.iter().zip(inputs))
                .map(|(rate, input)| {
                    let slope = graph.diff(value, *input);
                    graph.mul(slope, *rate)
                })
                .collect();
            recorded.extend([value, graph.sum(&terms)]);
        }
        recorded
    }
}

impl Equations {
    /// The closed loop of a scene under a law, with what of it is recorded.
    pub fn new(
        model: &Model,
        hamiltonian: &Hamiltonian,
        law: &Law,
        records: &[Record],
        forcing: Option<&Forcing>,
    ) -> Self {
        let n = model.states.len();
        let mut closing = Closing::new(model, hamiltonian, law);
        let quadratic = forcing.and_then(|f| f.quadratic.as_ref());
        let charted = quadratic.is_none() && (law.charted || forcing.is_some());
        closing.set_adjoints(quadratic, charted);
        let first = closing.inputs.len();
        let motion = forcing.map(|_| closing.set_motion());
        let forced = first..closing.inputs.len();
        let running = closing.undisturbed_running();
        let replaced = closing.replacements(law, motion.as_ref());

        let roots = closing.roots(running, motion.as_ref(), records);
        let mut whole = closing.closed(&roots, &replaced).into_iter();
        let mut take = |count: usize| whole.by_ref().take(count).collect::<Vec<Id>>();
        let (f, running) = (take(n), take(1)[0]);
        let supply = take(usize::from(forcing.is_some())).first().copied();
        let disturbance = take(forcing.map_or(0, |_| model.disturbances.len()));
        let (values, control) = (take(records.len()), take(model.controls.len()));
        let guards = take(hamiltonian.guards.len());
        let terminal = take(1).first().copied();

        let switches = closing.switches(records, &values);
        let recorded = closing.with_derivatives(values, &f);
        let mut rate = f;
        rate.resize(closing.inputs.len(), closing.zero);
        if let (Some(supply), Some(motion)) = (supply, &motion) {
            rate[first + motion.time] = closing.graph.constant(1.0);
            rate.push(supply);
            let supplied = closing.graph.symbol("supplied", Kind::State);
            closing.inputs.push(supplied);
        }
        rate.push(running);
        Self {
            states: n,
            controls: model.controls.len(),
            charted,
            forcing: forced,
            disturbance,
            inputs: closing.inputs,
            rate,
            guards: GuardExpr::all(&hamiltonian.guards, guards),
            recorded,
            control,
            switches,
            terminal,
            reference: model.reference().to_vec(),
            graph: closing.graph,
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
