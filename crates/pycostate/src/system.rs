//! A scene's equations as functions of arrays: for laws that are functions of Python.

use crate::scene::Scene;
use costate::low_level::expr::Id;
use costate::low_level::program::Program;
use numpy::{IntoPyArray, PyArray1, PyReadonlyArray2};
use pyo3::prelude::*;

/// x', L and the guards of states and controls; disturbances are 0.
#[pyclass(frozen, module = "pycostate._engine")]
pub struct System {
    /// Of (x, u): x', then L.
    rates: Program,
    /// Of x: positive inside.
    guards: Program,
    states: usize,
    controls: usize,
    #[pyo3(get)]
    guard_names: Vec<String>,
    #[pyo3(get)]
    events: Vec<String>,
    /// (min, max) of each control.
    #[pyo3(get)]
    bounds: Vec<(f64, f64)>,
}

#[pymethods]
impl System {
    #[new]
    fn new(scene: &Scene) -> Self {
        let model = &scene.inner.model;
        let mut graph = model.graph.clone();
        let mut numbers = std::collections::HashMap::default();
        for parameter in &model.parameters {
            numbers.insert(parameter.symbol, graph.constant(parameter.value));
        }
        for disturbance in &model.disturbances {
            numbers.insert(disturbance.symbol, graph.constant(0.0));
        }
        let x: Vec<Id> = model.states.iter().map(|s| s.variable.symbol).collect();
        let u: Vec<Id> = model.controls.iter().map(|c| c.variable.symbol).collect();
        let rates = (model.dynamics.iter())
            .map(|f| f.expr)
            .chain([model.running.expr]);
        let rates = graph.substitute(&rates.collect::<Vec<Id>>(), &numbers);
        let guards: Vec<Id> = model.guards.iter().map(|g| g.condition.expr).collect();
        let guards = graph.substitute(&guards, &numbers);
        Self {
            rates: Program::lower(&graph, &[x.as_slice(), &u].concat(), &rates),
            guards: Program::lower(&graph, &x, &guards),
            states: x.len(),
            controls: u.len(),
            guard_names: model.guards.iter().map(|g| g.name.clone()).collect(),
            events: model.events.iter().map(|e| e.name.clone()).collect(),
            bounds: (model.controls.iter())
                .map(|c| {
                    (
                        c.min.unwrap_or(f64::NEG_INFINITY),
                        c.max.unwrap_or(f64::INFINITY),
                    )
                })
                .collect(),
        }
    }

    /// `[state][component]` of x', then L, at states and controls, row by row.
    fn rates<'py>(
        &self,
        py: Python<'py>,
        x: PyReadonlyArray2<'py, f64>,
        u: PyReadonlyArray2<'py, f64>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let (x, u) = (x.as_slice()?, u.as_slice()?);
        if x.len() / self.states * self.controls != u.len() {
            let message = "as many controls as states are needed";
            return Err(crate::error::of_input(py, message));
        }
        let rates = py.detach(|| {
            let mut all = Vec::with_capacity(x.len() / self.states * (self.states + 1));
            let mut both = vec![0.0; self.states + self.controls];
            for (k, x) in x.chunks_exact(self.states).enumerate() {
                both[..self.states].copy_from_slice(x);
                both[self.states..].copy_from_slice(&u[k * self.controls..][..self.controls]);
                all.extend(self.rates.eval(&both));
            }
            all
        });
        Ok(rates.into_pyarray(py))
    }

    /// `[state][guard]` at states, row by row.
    fn guards<'py>(
        &self,
        py: Python<'py>,
        x: PyReadonlyArray2<'py, f64>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let x = x.as_slice()?;
        let all: Vec<f64> = x
            .chunks_exact(self.states)
            .flat_map(|x| self.guards.eval(x))
            .collect();
        Ok(all.into_pyarray(py))
    }
}
