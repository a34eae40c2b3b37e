//! Laws that are fitted to a scene's solutions, or read from weights files.

use crate::error::raised;
use crate::scene::Scene;
use costate::FittedLaw;
use costate::low_level::feedback::{ClosedForm, Law as Fit, header, onnx};
use costate::low_level::program::Program;
use costate_cli::CliError;
use numpy::{IntoPyArray, PyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use std::sync::Arc;

/// A law u(x).
#[pyclass(frozen, module = "pycostate._engine")]
pub struct Law {
    #[pyo3(get)]
    name: String,
    law: Fit,
    form: ClosedForm,
    /// Of all states: the controls, or what the law gives in place of them.
    commands: Program,
    scene: Arc<costate::Scene>,
}

impl Law {
    pub fn of(name: &str, law: Fit, scene: Arc<costate::Scene>) -> Result<Self, CliError> {
        let form = law
            .closed_form(&scene.model, &scene.hamiltonian)
            .map_err(|e| CliError::Export(e.into()))?;
        Ok(Self {
            name: name.to_owned(),
            commands: Program::lower(&form.graph, &form.x, &form.commands),
            form,
            law,
            scene,
        })
    }

    pub fn fitted(law: &FittedLaw, scene: Arc<costate::Scene>) -> Result<Self, CliError> {
        Self::of(&law.name, law.law.clone(), scene)
    }
}

#[pymethods]
impl Law {
    /// Of a weights file's text.
    #[staticmethod]
    fn parse(py: Python<'_>, name: &str, text: &str, file: &str, scene: &Scene) -> PyResult<Self> {
        let law = Fit::from_toml(text, file).map_err(|e| raised(py, CliError::Export(e.into())))?;
        Self::of(name, law, Arc::clone(&scene.inner)).map_err(|e| raised(py, e))
    }

    /// Names of what it gives.
    #[getter]
    fn outputs(&self) -> Vec<String> {
        self.form.outputs.clone()
    }

    /// `[state][output]` at `[state][component]`, row by row.
    fn eval<'py>(
        &self,
        py: Python<'py>,
        x: PyReadonlyArray2<'py, f64>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let n = self.form.x.len();
        let x = x.as_slice()?;
        let all = py.detach(|| {
            let mut all = Vec::with_capacity(x.len() / n * self.form.commands.len());
            x.chunks_exact(n)
                .for_each(|x| all.extend(self.commands.eval(x)));
            all
        });
        Ok(all.into_pyarray(py))
    }

    /// The weights file's text.
    fn to_toml(&self) -> String {
        self.law.to_toml()
    }

    /// A header of C.
    fn to_c(&self) -> String {
        header(&self.name, &self.law, &self.form, &self.scene.model)
    }

    /// An ONNX model.
    fn to_onnx(&self, py: Python<'_>) -> PyResult<Vec<u8>> {
        let model = &self.scene.model;
        onnx(&self.name, &self.law, &self.form, model)
            .map_err(|e| crate::error::of_input(py, &e.to_string()))
    }
}
