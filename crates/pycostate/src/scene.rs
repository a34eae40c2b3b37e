//! Scenes.

use crate::error::raised;
use costate::Stored;
use costate::low_level::model::{Model, Variable};
use costate::low_level::schema;
use costate::session::SimulationOptions;
use costate_cli::Checked;
use pyo3::prelude::*;
use std::path::PathBuf;
use std::sync::Arc;

type Simulation = (
    Vec<f64>,
    Option<f64>,
    Option<usize>,
    Option<usize>,
    Option<usize>,
);

/// A scene with its equations.
#[pyclass(frozen, module = "pycostate._engine")]
pub struct Scene {
    pub inner: Arc<costate::Scene>,
    #[pyo3(get)]
    text: String,
    #[pyo3(get)]
    file_name: String,
}

impl Scene {
    pub fn of(inner: Arc<costate::Scene>) -> Self {
        Self {
            text: inner.model.text.clone(),
            file_name: inner.model.file_name.clone(),
            inner,
        }
    }

    fn model(&self) -> &Model {
        &self.inner.model
    }
}

#[pymethods]
impl Scene {
    /// Reads a file; `set` are definitions of parameters in place of the file's.
    #[staticmethod]
    fn load(py: Python<'_>, path: PathBuf, set: Vec<(String, String)>) -> PyResult<Self> {
        match costate::Scene::load_with(&path, &set) {
            Ok(inner) => Ok(Self::of(Arc::new(inner))),
            Err(e) => Err(raised(py, e)),
        }
    }

    /// Reads a text.
    #[staticmethod]
    fn parse(py: Python<'_>, text: &str, name: &str, set: Vec<(String, String)>) -> PyResult<Self> {
        match costate::Scene::parse_with(text, name, &set) {
            Ok(inner) => Ok(Self::of(Arc::new(inner))),
            Err(e) => Err(raised(py, e)),
        }
    }

    /// Definitions of parameters in place of the text's.
    #[getter]
    fn set(&self) -> Vec<(String, String)> {
        self.model().overrides.clone()
    }

    #[getter]
    fn title(&self) -> &str {
        &self.model().title
    }

    /// (name, unit, description) of each state.
    #[getter]
    fn states(&self) -> Vec<(String, String, String)> {
        let states = self.model().states.iter();
        states.map(|s| described(&s.variable)).collect()
    }

    /// The same of controls.
    #[getter]
    fn controls(&self) -> Vec<(String, String, String)> {
        let controls = self.model().controls.iter();
        controls.map(|c| described(&c.variable)).collect()
    }

    /// Names of parameters with their values.
    #[getter]
    fn parameters(&self) -> Vec<(String, f64)> {
        let parameters = self.model().parameters.iter();
        parameters.map(|p| (p.name.clone(), p.value)).collect()
    }

    /// The states at the equilibrium, or at the terminal cost's reference.
    #[getter]
    fn reference(&self) -> Vec<f64> {
        let n = self.model().states.len();
        self.model().reference()[..n].to_vec()
    }

    /// [low, high] of each state in the region, absolute.
    #[getter]
    fn region(&self) -> Vec<[f64; 2]> {
        self.model().region.clone()
    }

    /// The name of the time; whether the horizon is finite.
    #[getter]
    fn time(&self) -> (String, Option<f64>) {
        let model = self.model();
        (model.time_name().to_owned(), model.final_time())
    }

    /// Names of the laws of `[feedback]`.
    #[getter]
    fn laws(&self) -> Vec<&str> {
        let laws = self.model().feedback.iter();
        laws.map(|law| law.name.as_str()).collect()
    }

    /// A state that is called like something in `/map`, and cannot be an axis there.
    fn no_axis(&self) -> Option<&str> {
        let mut names = self.model().states.iter().map(|s| s.variable.name.as_str());
        names.find(|name| schema::MAP.reserves(name))
    }

    /// Whether something in `/points` is called so.
    fn is_taken(&self, name: &str) -> bool {
        schema::POINTS.reserves(name)
    }

    /// What a simulation does unless it is told otherwise: states that it begins with, row by row,
    /// how long it lasts, events after which a flight ends, stored points of a phase, whether it looks
    /// for an orbit.
    fn simulation(&self, py: Python<'_>) -> PyResult<Simulation> {
        let starts = costate::Session::new(&self.inner).starts(None);
        let starts = starts.map_err(|e| raised(py, e))?;
        let asked = SimulationOptions::default().or_of(self.model());
        Ok((starts, asked.time, asked.events, asked.samples, asked.cycle))
    }

    /// A header of C of the series about the equilibrium.
    fn local_to_c(&self, py: Python<'_>, name: &str, degree: usize) -> PyResult<String> {
        let inner = Arc::clone(&self.inner);
        py.detach(move || costate_cli::local_header(name, &inner, degree))
            .map_err(|e| raised(py, e))
    }

    /// What follows from the scene: text, JSON and remarks.
    fn check(&self, py: Python<'_>) -> PyResult<(String, String, Vec<String>)> {
        let inner = Arc::clone(&self.inner);
        let checked = py.detach(move || {
            let checked = Checked::of(&inner)?;
            let json = checked.json().to_string();
            Ok::<_, costate_cli::CliError>((checked.text(), json, checked.notes))
        });
        checked.map_err(|e| raised(py, e))
    }
}

fn described(variable: &Variable) -> (String, String, String) {
    let text = |t: &Option<String>| t.clone().unwrap_or_default();
    (
        variable.name.clone(),
        text(&variable.unit),
        text(&variable.long_name),
    )
}

/// The scene of a result file.
#[pyfunction]
pub fn scene_of_file(py: Python<'_>, file: PathBuf) -> PyResult<Scene> {
    let stored = Stored::open(&file).map_err(|e| raised(py, e))?;
    Ok(Scene::of(Arc::new(stored.scene)))
}
