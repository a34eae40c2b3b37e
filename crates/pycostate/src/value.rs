//! V, p and u at any state, of a result file.

use crate::error::{of_input, raised};
use crate::scene::Scene;
use costate::backend::Backend;
use costate::backend::cpu::Cpu;
use costate::low_level::hdf5::ResultFile;
use costate::low_level::map::At;
use costate::low_level::result::{
    Places, RunRecord, Stored, Times, TrajectorySchema, interpolated_status, interpolated_statuses,
};
use costate::{Precision, ValueMap};
use costate_cli::CliError;
use numpy::{IntoPyArray, PyArray1, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::PathBuf;
use std::sync::Arc;

/// V, p and u at any state.
#[pyclass(frozen, module = "pycostate._engine")]
pub struct Value {
    map: ValueMap,
    of: Arc<costate::Scene>,
    #[pyo3(get)]
    file: PathBuf,
}

#[pymethods]
impl Value {
    /// Of a result file.
    #[new]
    fn new(py: Python<'_>, file: PathBuf) -> PyResult<Self> {
        let read = py.detach(|| {
            let stored = Stored::open(&file)?;
            let map = stored.value_map()?;
            Ok::<_, CliError>((map, stored.scene))
        });
        let (map, scene) = read.map_err(|e| raised(py, e))?;
        let of = Arc::new(scene);
        Ok(Self { map, of, file })
    }

    /// The scene that the result is of.
    #[getter]
    fn scene(&self) -> Scene {
        Scene::of(Arc::clone(&self.of))
    }

    /// Whether V depends on the time.
    #[getter]
    fn has_time(&self) -> bool {
        self.map.time().is_some()
    }

    /// A header of C of a map in pieces; its names begin with `name`.
    fn to_c(&self, py: Python<'_>, name: &str) -> PyResult<String> {
        let made = Stored::open(&self.file)
            .map_err(CliError::from)
            .and_then(|stored| costate_cli::map_header(name, &stored));
        made.map_err(|e| raised(py, e))
    }

    /// What is known at a state, by code.
    #[staticmethod]
    fn statuses() -> Vec<(i32, &'static str)> {
        interpolated_statuses().to_vec()
    }

    /// Writes V, p, u with their errors to a result file: to `/points`, or to `/map` where `axes` are
    /// those of a grid that the states are the points of, the last axis fastest.
    #[pyo3(signature = (out, x, t, axes=None))]
    fn write<'py>(
        &self,
        py: Python<'py>,
        out: PathBuf,
        x: PyReadonlyArray2<'py, f64>,
        t: PyReadonlyArray1<'py, f64>,
        axes: Option<Vec<Vec<f64>>>,
    ) -> PyResult<PathBuf> {
        let (x, t) = (x.as_slice()?, t.as_slice()?);
        let provenance = costate_cli::provenance();
        let found = self.found(py, (x, t), true)?;
        let written = py.detach(|| {
            let places = match &axes {
                Some(axes) => Places::Grid(axes),
                None => Places::Points(x),
            };
            let model = &self.of.model;
            let named = self.has_time().then(|| Times {
                name: model.time_name(),
                t,
            });
            let mut file = ResultFile::create(out)?;
            file.interpolated(&TrajectorySchema::axes(model), &places, named, &found)?;
            let cpu = Cpu::new();
            let record = RunRecord {
                backend: cpu.name().to_owned(),
                adapter: cpu.adapter(),
                precision: Precision::F64.name().to_owned(),
                method: "interpolation".to_owned(),
                ..provenance.record(model)
            };
            record.write(&file)?;
            file.attribute("source", self.file.display().to_string())?;
            Ok::<_, CliError>(file.finish()?)
        });
        written.map_err(|e| raised(py, e))
    }

    /// V, p, u at `[state][component]`, row by row, NaN where they are not known; on a finite horizon
    /// at t = 0. Fast.
    fn many<'py>(
        &self,
        py: Python<'py>,
        x: PyReadonlyArray2<'py, f64>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let x = x.as_slice()?;
        let many = py.detach(|| self.map.many(x));
        let out = PyDict::new(py);
        out.set_item("V", many.v.into_pyarray(py))?;
        out.set_item("p", many.p.into_pyarray(py))?;
        out.set_item("u", many.u.into_pyarray(py))?;
        Ok(out)
    }

    /// The same at times, with what is known of the errors, the sheet, and why nothing is known.
    fn at<'py>(
        &self,
        py: Python<'py>,
        x: PyReadonlyArray2<'py, f64>,
        t: PyReadonlyArray1<'py, f64>,
        errors: bool,
    ) -> PyResult<Bound<'py, PyDict>> {
        let (x, t) = (x.as_slice()?, t.as_slice()?);
        let found = self.found(py, (x, t), errors)?;
        let n = self.map.states();
        let out = PyDict::new(py);
        let number = |of: &dyn Fn(&costate::Value) -> f64| -> Bound<'py, PyArray1<f64>> {
            let all: Vec<f64> = (found.iter())
                .map(|at| at.lowest.as_ref().map_or(f64::NAN, of))
                .collect();
            all.into_pyarray(py)
        };
        let row = |width: usize, of: &dyn Fn(&costate::Value) -> &[f64]| {
            let unknown = vec![f64::NAN; width];
            let all: Vec<f64> = (found.iter())
                .flat_map(|at| at.lowest.as_ref().map_or(unknown.as_slice(), of))
                .copied()
                .collect();
            all.into_pyarray(py)
        };
        out.set_item("V", number(&|v| v.v))?;
        out.set_item("p", row(n, &|v| &v.p))?;
        out.set_item("u", row(self.of.model.controls.len(), &|v| &v.u))?;
        out.set_item("V_error", number(&|v| v.v_error))?;
        out.set_item("p_error", number(&|v| v.p_error))?;
        out.set_item("u_error", number(&|v| v.u_error))?;
        let sheets: Vec<i32> = (found.iter())
            .map(|at| at.lowest.as_ref().map_or(-1, |v| v.sheet))
            .collect();
        out.set_item("sheet", sheets.into_pyarray(py))?;
        let why: Vec<i32> = found.iter().map(interpolated_status).collect();
        out.set_item("status", why.into_pyarray(py))?;
        Ok(out)
    }
}

impl Value {
    /// What is known at states `[state][component]` and times. Signals are looked at meanwhile.
    fn found(&self, py: Python<'_>, (x, t): (&[f64], &[f64]), errors: bool) -> PyResult<Vec<At>> {
        /// States that are asked for at once.
        const PART: usize = 20_000;
        let n = self.map.states();
        if t.len() * n != x.len() {
            return Err(of_input(py, "as many times as states are needed"));
        }
        let mut all = Vec::with_capacity(t.len());
        for (x, t) in x.chunks(PART * n).zip(t.chunks(PART)) {
            all.extend(py.detach(|| self.map.at_times(x, t, errors)));
            py.check_signals()?;
        }
        Ok(all)
    }
}
