//! A scene's equations as functions of arrays: for laws that are functions of Python.

use crate::error::{of_input, raised};
use crate::scene::Scene;
use costate::Precision;
use costate::low_level::expr::Id;
use costate::low_level::hdf5::ResultFile;
use costate::low_level::hybrid::{End, Flights, Jump, Sample, lost_contact, sizes};
use costate::low_level::model::Horizon;
use costate::low_level::program::Program;
use costate::low_level::result::{RunRecord, TrajectorySchema};
use costate::session::{Simulated, some_states};
use costate_cli::CliError;
use numpy::{IntoPyArray, PyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use std::path::PathBuf;
use std::sync::Arc;

/// What integrates flights under a law of Python, and how.
const BACKEND: &str = "python";
const METHOD: &str = "dopri5";

/// Flights as Python has flown them: the fields are those of a dict.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Flown<'py> {
    /// `[flight][component]`.
    x0: PyReadonlyArray2<'py, f64>,
    x_end: PyReadonlyArray2<'py, f64>,
    /// `[flight]`; the cost is the running one.
    t_end: Vec<f64>,
    events: Vec<usize>,
    status: Vec<i32>,
    cost: Vec<f64>,
    /// (flight, event, time), with the states before and after.
    jumps: Vec<(usize, usize, f64)>,
    before: PyReadonlyArray2<'py, f64>,
    after: PyReadonlyArray2<'py, f64>,
    /// (flight, phase, time), with states and controls.
    samples: Vec<(usize, usize, f64)>,
    x: PyReadonlyArray2<'py, f64>,
    u: PyReadonlyArray2<'py, f64>,
    law: String,
    rtol: f64,
    time: f64,
}

/// x', L, and what flights meet: events, then guards of states; disturbances are 0.
#[pyclass(frozen, module = "pycostate._engine")]
pub struct System {
    /// Of (x, u): x', then L.
    rates: Program,
    /// Of (x, u): conditions, positive until they come true; their rates; where they count, which is
    /// where this is not negative.
    conditions: Program,
    /// Of x, an event's: the state after it, and what contacts keep, after and before. `None`: the
    /// flight ends.
    maps: Vec<Option<Program>>,
    /// Of x: the cost at the final time.
    terminal: Option<Program>,
    states: usize,
    controls: usize,
    scene: Arc<costate::Scene>,
    #[pyo3(get)]
    events: Vec<String>,
    #[pyo3(get)]
    guards: Vec<String>,
    /// Sizes of conditions over the region.
    #[pyo3(get)]
    sizes: Vec<f64>,
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
        let both = [x.as_slice(), &u].concat();

        let rates = (model.dynamics.iter())
            .map(|f| f.expr)
            .chain([model.running.expr]);
        let rates = graph.substitute(&rates.collect::<Vec<Id>>(), &numbers);

        let everywhere = graph.constant(1.0);
        let events = model.events.iter().map(|e| (e.ahead, e.only));
        let guards = model.guards.iter().map(|g| (g.condition.expr, None));
        let (ahead, only): (Vec<Id>, Vec<Id>) = events
            .chain(guards)
            .map(|(ahead, only)| (ahead, only.unwrap_or(everywhere)))
            .unzip();
        let [ahead, only] = [ahead, only].map(|all| graph.substitute(&all, &numbers));
        let moving = x.iter().copied().zip(rates.iter().copied()).collect();
        let slopes = graph.tangents(&ahead, &moving);
        let sizes = sizes(&mut graph, &ahead, &x, &some_states(model));
        let conditions = [ahead, slopes, only].concat();

        let maps = (model.events.iter())
            .map(|event| {
                let map = event.map.as_ref()?.iter().copied();
                let after = event.kept.iter().map(|kept| kept.after);
                let before = event.kept.iter().map(|kept| kept.before);
                let all: Vec<Id> = map.chain(after).chain(before).collect();
                let all = graph.substitute(&all, &numbers);
                Some(Program::lower(&graph, &x, &all))
            })
            .collect();
        let terminal = match &model.horizon {
            Horizon::Finite { terminal, .. } => {
                let cost = graph.substitute(&[terminal.expr], &numbers);
                Some(Program::lower(&graph, &x, &cost))
            }
            Horizon::Infinite { .. } => None,
        };
        Self {
            terminal,
            rates: Program::lower(&graph, &both, &rates),
            conditions: Program::lower(&graph, &both, &conditions),
            maps,
            states: x.len(),
            controls: u.len(),
            scene: Arc::clone(&scene.inner),
            events: model.events.iter().map(|e| e.name.clone()).collect(),
            guards: model.guards.iter().map(|g| g.name.clone()).collect(),
            sizes,
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
        self.of_both(py, &self.rates, &x, &u)
    }

    /// `[state][condition]` of conditions, then their rates, then where they count.
    fn conditions<'py>(
        &self,
        py: Python<'py>,
        x: PyReadonlyArray2<'py, f64>,
        u: PyReadonlyArray2<'py, f64>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        self.of_both(py, &self.conditions, &x, &u)
    }

    /// Writes flights to a result file; its path.
    fn write(&self, py: Python<'_>, out: PathBuf, flown: Flown<'_>) -> PyResult<PathBuf> {
        let simulated = self.simulated(flown)?;
        let written = py.detach(|| {
            let provenance = costate_cli::provenance();
            let model = &self.scene.model;
            let mut file = ResultFile::create(out)?;
            let axes = TrajectorySchema::axes(model);
            file.simulation(&axes, &simulated, (BACKEND, ""))?;
            let record = RunRecord {
                backend: BACKEND.to_owned(),
                precision: simulated.precision.name().to_owned(),
                method: simulated.method.to_owned(),
                rtol: simulated.rtol,
                ..provenance.record(model)
            };
            record.write(&file)?;
            Ok::<_, CliError>(file.finish()?)
        });
        written.map_err(|e| raised(py, e))
    }

    /// The state after an event, and whether a contact no longer holds in it; `None` where the event
    /// ends the flight.
    #[allow(clippy::needless_pass_by_value, reason = "as Python gives it")]
    fn jump(&self, event: usize, x: Vec<f64>) -> Option<(Vec<f64>, bool)> {
        let mut after = self.maps.get(event)?.as_ref()?.eval(&x);
        let kept = after.split_off(self.states);
        let (now, before) = kept.split_at(kept.len() / 2);
        let is_lost = lost_contact(now, before).is_some();
        Some((after, is_lost))
    }
}

impl System {
    fn simulated(&self, flown: Flown<'_>) -> PyResult<Simulated> {
        let n = self.states;
        let row = |x: &PyReadonlyArray2<'_, f64>, k: usize| -> PyResult<Vec<f64>> {
            Ok(x.as_slice()?[k * n..][..n].to_vec())
        };
        let jumps = (flown.jumps.iter().enumerate())
            .map(|(k, &(flight, event, t))| {
                Ok(Jump {
                    flight,
                    event,
                    t,
                    before: row(&flown.before, k)?,
                    after: row(&flown.after, k)?,
                })
            })
            .collect::<PyResult<_>>()?;
        let samples = (flown.samples.iter().enumerate())
            .map(|(k, &(flight, phase, t))| {
                Ok(Sample {
                    flight,
                    phase,
                    t,
                    x: row(&flown.x, k)?,
                })
            })
            .collect::<PyResult<_>>()?;
        let ends = flown.status.iter().map(|code| End::of_code(*code));
        let flights = Flights {
            last: flown.x_end.as_slice()?.to_vec(),
            t: flown.t_end,
            end: ends.map(|end| end.unwrap_or(End::NotLocated)).collect(),
            events: flown.events,
            jumps,
            samples,
            ..Flights::default()
        };

        let model = &self.scene.model;
        let is_whole = |flight: usize| {
            // To rounding: it may be an expression.
            let near = |whole: f64| (flown.time - whole).abs() <= 1e-9 * whole;
            flights.end[flight] == End::Time && model.final_time().is_some_and(near)
        };
        let costs = flown.cost.into_iter().enumerate();
        let cost = costs
            .map(|(flight, running)| match &self.terminal {
                Some(terminal) if is_whole(flight) => {
                    running + terminal.eval(&flights.last[flight * n..][..n])[0]
                }
                _ => running,
            })
            .collect();
        let named = |kind: &'static str, all: &[String]| -> Vec<String> {
            all.iter().map(|name| format!("{kind}_{name}")).collect()
        };
        Ok(Simulated {
            initial: flown.x0.as_slice()?.to_vec(),
            u: flown.u.as_slice()?.to_vec(),
            names: [named("event", &self.events), named("guard", &self.guards)].concat(),
            events: self.events.len(),
            law: Some(flown.law),
            method: METHOD,
            precision: Precision::F64,
            rtol: flown.rtol,
            time: flown.time,
            cycles: None,
            cost: Some(cost),
            flights,
        })
    }

    fn of_both<'py>(
        &self,
        py: Python<'py>,
        program: &Program,
        x: &PyReadonlyArray2<'py, f64>,
        u: &PyReadonlyArray2<'py, f64>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let (x, u) = (x.as_slice()?, u.as_slice()?);
        if x.len() / self.states * self.controls != u.len() {
            let message = "as many controls as states are needed";
            return Err(of_input(py, message));
        }
        let all = py.detach(|| {
            let mut all = Vec::new();
            let mut both = vec![0.0; self.states + self.controls];
            for (k, x) in x.chunks_exact(self.states).enumerate() {
                both[..self.states].copy_from_slice(x);
                both[self.states..].copy_from_slice(&u[k * self.controls..][..self.controls]);
                all.extend(program.eval(&both));
            }
            all
        });
        Ok(all.into_pyarray(py))
    }
}
