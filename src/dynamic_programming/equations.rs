//! The scene's own dynamics and cost at any control, and the optimal control of a costate.

use crate::expr::{Deviation, Id, Kind};
use crate::hamiltonian::{Hamiltonian, System};
use crate::model::Model;
use crate::program::Program;
use rustc_hash::FxHashMap;

/// Programs of one scene, in deviations `s = x - reference` and forward time.
#[derive(Clone, Debug)]
pub(super) struct Equations {
    pub states: usize,
    pub controls: usize,
    /// From `(s, u)` to `f`, `L` and the guards' values.
    pub motion: Program,
    /// For each guard whether 0 is outside.
    pub strict: Vec<bool>,
    /// From `(s, p)` to the control that minimizes H.
    pub law: Program,
    /// From `(s, p)` to the terminal cost and its gradient, where the horizon is finite.
    pub terminal: Option<Program>,
    /// Bounds of each control; infinite where there is none.
    pub bounds: Vec<[f64; 2]>,
}

impl Equations {
    pub fn new(model: &Model, hamiltonian: &Hamiltonian, system: &System) -> Self {
        let mut graph = hamiltonian.graph.clone();
        let zero = graph.constant(0.0);
        let mut symbols: FxHashMap<Id, Deviation> = (model.parameter_values().into_iter())
            .map(|(symbol, at)| (symbol, Deviation::new(at, zero)))
            .collect();
        let mut inputs = Vec::new();
        for (state, &at) in model.states.iter().zip(model.reference()) {
            let change = graph.symbol(&format!("d_{}", state.variable.name), Kind::State);
            symbols.insert(state.variable.symbol, Deviation::new(at, change));
            inputs.push(change);
        }
        for control in &model.controls {
            let change = control.variable.symbol;
            symbols.insert(change, Deviation::new(0.0, change));
            inputs.push(change);
        }
        let roots: Vec<Id> = (model.dynamics.iter().map(|f| f.expr))
            .chain([model.running.expr])
            .chain(hamiltonian.guards.iter().map(|g| g.condition.expr))
            .collect();
        let forms = graph.deviations(&roots, &symbols);
        let whole: Vec<Id> = forms.into_iter().map(|f| graph.whole(f)).collect();
        let terminal = system.terminal.as_ref().map(|t| {
            let roots = [&[t.value], t.gradient.as_slice()].concat();
            Program::lower(&system.graph, &system.inputs, &roots)
        });
        Self {
            states: model.states.len(),
            controls: model.controls.len(),
            motion: Program::lower(&graph, &inputs, &whole),
            strict: hamiltonian.guards.iter().map(|g| g.strict).collect(),
            law: Program::lower(&system.graph, &system.inputs, &system.observer.control),
            terminal,
            bounds: (model.controls.iter())
                .map(|c| {
                    [
                        c.min.unwrap_or(f64::NEG_INFINITY),
                        c.max.unwrap_or(f64::INFINITY),
                    ]
                })
                .collect(),
        }
    }

    /// Outputs of [`Self::motion`].
    pub fn width(&self) -> usize {
        self.states + 1 + self.strict.len()
    }

    /// Whether a row of [`Self::motion`] is finite and inside the guards.
    pub fn is_valid(&self, row: &[f64]) -> bool {
        let (rates, guards) = row.split_at(self.states + 1);
        let holds = |(g, strict): (&f64, &bool)| if *strict { *g > 0.0 } else { *g >= 0.0 };
        rates.iter().all(|x| x.is_finite()) && guards.iter().zip(&self.strict).all(holds)
    }
}
