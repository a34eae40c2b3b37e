//! What a session computes, into result files.

use crate::error::{of_input, raised, raised_by};
use crate::going::{Gone, Listener, going};
use crate::law::Law;
use crate::scene::Scene;
use costate::backend::Deadline;
use costate::backend::cpu::in_pool;
use costate::low_level::hdf5::ResultFile;
use costate::low_level::map::{Worker, Workers};
use costate::low_level::model::{Method, Report};
use costate::low_level::result::{Stored, TrajectorySchema};
use costate::run::{
    LawFiles, MergeOptions, Provenance, RunError, evaluate as evaluated, fit_stored,
    merge as put_together, study as made_study, write_attenuation,
};
use costate::session::summary::{AttenuationSummary, EvaluationSummary, study_rows};
use costate::session::{
    ControlledBy, Kept, Listed, LoopOptions, Resume, Session, SessionError, Shard, Silent,
    SimulationOptions, States, Wanted,
};
use costate::{Choices, Precision, Weights};
use costate_cli::{BackendChoice, CliError, provenance};
use numpy::PyReadonlyArray2;
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use serde_json::{Value, json};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

/// Seconds between two checkpoints of a shard.
const CHECKPOINT: u32 = 60;

/// Where and how exactly to compute, and who is told of it.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct How {
    backend: String,
    adapter: Option<String>,
    precision: Option<String>,
    method: Option<String>,
    rtol: Option<f64>,
    seed: u64,
    time_limit: Option<f64>,
    progress: Py<PyAny>,
    note: Py<PyAny>,
}

/// The same, understood.
struct Numerics {
    backend: BackendChoice,
    adapter: Option<String>,
    choices: Choices,
}

impl How {
    fn numerics(&self, py: Python<'_>) -> PyResult<Numerics> {
        let backend = match self.backend.as_str() {
            "auto" => BackendChoice::Auto,
            "cpu" => BackendChoice::Cpu,
            "gpu" => BackendChoice::Gpu,
            other => {
                let message = format!("backend = {other:?}: \"auto\", \"cpu\" or \"gpu\"");
                return Err(of_input(py, &message));
            }
        };
        let precision = match self.precision.as_deref() {
            None => None,
            Some("f64") => Some(Precision::F64),
            Some("f32") => Some(Precision::F32),
            Some(other) => {
                let message = format!("precision = {other:?}: \"f32\" or \"f64\"");
                return Err(of_input(py, &message));
            }
        };
        let named = |name: &String| {
            (Method::ALL.into_iter())
                .find_map(|(own, method)| (own == name).then_some(method))
                .ok_or_else(|| {
                    let all: Vec<&str> = Method::ALL.iter().map(|(own, _)| *own).collect();
                    of_input(py, &format!("method = {name:?}: {}", all.join(", ")))
                })
        };
        if let Some(rtol) = self.rtol.filter(|rtol| !(*rtol > 0.0 && *rtol < 1.0)) {
            return Err(of_input(py, &format!("rtol = {rtol}: between 0 and 1")));
        }
        Ok(Numerics {
            backend,
            adapter: self.adapter.clone(),
            choices: Choices {
                precision,
                method: self.method.as_ref().map(named).transpose()?,
                rtol: self.rtol,
                seed: self.seed,
                ..Choices::default()
            },
        })
    }

    fn going<T: Send>(
        &self,
        py: Python<'_>,
        work: impl FnOnce(&Listener, Deadline) -> T + Send,
    ) -> PyResult<Gone<T>> {
        self.going_while(py, &|| Ok(()), work)
    }

    /// The same, which an exception of `look` ends.
    fn going_while<T: Send>(
        &self,
        py: Python<'_>,
        look: &dyn Fn() -> PyResult<()>,
        work: impl FnOnce(&Listener, Deadline) -> T + Send,
    ) -> PyResult<Gone<T>> {
        let (progress, note) = (self.progress.bind(py), self.note.bind(py));
        going(py, (progress, note, look), self.time_limit, work)
    }

    /// Something that a session computes into a result file.
    fn compute(
        &self,
        py: Python<'_>,
        scene: &Scene,
        workers: Option<&Crew>,
        work: impl FnOnce(&Session<'_>, &Provenance) -> Result<Made, CliError> + Send,
    ) -> PyResult<Written> {
        let (numerics, scene) = (self.numerics(py)?, Arc::clone(&scene.inner));
        let look = || workers.map_or(Ok(()), |workers| workers.look(py));
        let gone = self.going_while(py, &look, |listener, deadline| {
            let provenance = provenance();
            let mut session = numerics.session(&scene, listener, deadline)?;
            if let Some(workers) = workers {
                session = session.with_workers(workers);
            }
            work(&session, &provenance)
        })?;
        written(py, gone)
    }
}

impl Numerics {
    fn session<'s>(
        &self,
        scene: &'s costate::Scene,
        listener: &'s Listener,
        deadline: Deadline,
    ) -> Result<Session<'s>, CliError> {
        let method = self.choices.method.or(scene.model.integrator.method);
        let backend = costate_cli::backend(self.backend, self.adapter.as_deref(), method)?;
        Ok(Session::on(scene, backend)
            .choosing(self.choices)
            .until(deadline)
            .with_progress(listener))
    }
}

/// Workers of a map, which Python knows.
struct Crew(Py<PyAny>);

impl Crew {
    /// An exception where the work was given up.
    fn look(&self, py: Python<'_>) -> PyResult<()> {
        self.0.call_method0(py, "look").map(drop)
    }
}

impl Workers for Crew {
    fn count(&self) -> usize {
        // Where nobody is known all is done here.
        let count = Python::attach(|py| self.0.call_method0(py, "count")?.extract(py));
        count.unwrap_or(0)
    }

    fn work(&self, tasks: Vec<Vec<u8>>) -> Result<Vec<Vec<u8>>, String> {
        let done: PyResult<_> = Python::attach(|py| {
            let tasks: Vec<_> = tasks.iter().map(|task| PyBytes::new(py, task)).collect();
            self.0.call_method1(py, "work", (tasks,))?.extract(py)
        });
        done.map_err(|e| e.to_string())
    }
}

/// One of them: it solves for states that a map of another process asks for.
#[pyclass(frozen)]
pub struct MapWorker(Mutex<Worker>);

#[pymethods]
impl MapWorker {
    #[new]
    fn new(py: Python<'_>, scene: &Scene, how: How) -> PyResult<Self> {
        let (numerics, scene) = (how.numerics(py)?, Arc::clone(&scene.inner));
        let gone = how.going(py, |listener, deadline| {
            let session = numerics.session(&scene, listener, deadline)?;
            Ok::<_, CliError>(session.worker()?)
        })?;
        match gone.done {
            Ok(worker) => Ok(Self(Mutex::new(worker))),
            Err(error) => Err(raised(py, error)),
        }
    }

    /// Does a task.
    fn work<'py>(&self, py: Python<'py>, task: &[u8]) -> PyResult<Bound<'py, PyBytes>> {
        let done = py.detach(|| {
            in_pool(|| {
                let mut worker = self.0.lock().unwrap_or_else(PoisonError::into_inner);
                worker.work(task)
            })
        });
        match done {
            Ok(done) => Ok(PyBytes::new(py, &done)),
            Err(error) => Err(raised(
                py,
                CliError::from(RunError::from(SessionError::from(error))),
            )),
        }
    }
}

/// What was made: the file, a summary, and whether it was ended before all was done.
type Made = (PathBuf, Value, bool);

/// The same for Python: the file, a summary as JSON, whether it was ended before all was done, and the
/// exception that ended it.
type Written = (PathBuf, String, bool, Option<PyErr>);

fn written(py: Python<'_>, gone: Gone<Result<Made, CliError>>) -> PyResult<Written> {
    match (gone.done, gone.interrupted) {
        (Ok((path, summary, stopped)), interrupted) => {
            Ok((path, summary.to_string(), stopped, interrupted))
        }
        // What could not be done any more is no news.
        (Err(e), Some(interrupted)) if e.status() != 2 => {
            drop(e);
            Err(interrupted)
        }
        (Err(e), _) => Err(raised_by(py, e, gone.is_late)),
    }
}

/// `what`: `run`, `sweep`, `homotopy`, `map`, or `solve` for states `[state][component]`. `kept`: what
/// is kept of swept trajectories. `shard`: the number of a part, and of how many; what it has done is
/// kept in `out` as it goes on, and what is there is not done again. `workers` solve for the states of a
/// map to an error: an object with `count()` and `work(tasks)`, whose tasks `MapWorker`s do.
#[pyfunction]
#[pyo3(signature = (scene, what, out, how, x=None, *, one_sheet=false, samples=None, grid_guesses=false, kept="all", shard=None, workers=None))]
#[allow(clippy::too_many_arguments, reason = "named, in Python")]
pub fn run(
    py: Python<'_>,
    scene: &Scene,
    what: &str,
    out: PathBuf,
    how: How,
    x: Option<PyReadonlyArray2<'_, f64>>,
    one_sheet: bool,
    samples: Option<usize>,
    grid_guesses: bool,
    kept: &str,
    shard: Option<(usize, usize)>,
    workers: Option<Py<PyAny>>,
) -> PyResult<Written> {
    let mut wanted = match (what, x) {
        ("run", None) => Wanted::all(),
        ("sweep", None) => Wanted::sweep(),
        ("homotopy", None) => Wanted::homotopy(),
        ("map", None) => Wanted::map(),
        ("solve", Some(x)) => Wanted {
            states: States::Listed(Listed {
                x: x.as_slice()?.to_vec(),
                one_sheet,
                samples,
            }),
            ..Wanted::default()
        },
        _ => return Err(of_input(py, "what is to be run?")),
    };
    wanted.grid_guesses = grid_guesses;
    if let Some((number, of)) = shard {
        let shard = Shard::new(number, of);
        wanted.shard = Some(shard.map_err(|e| of_input(py, &e.to_string()))?);
        wanted.resume = Resume::Now(CHECKPOINT);
    }
    wanted.kept = match kept {
        "all" => Kept::All,
        "values" => Kept::Values,
        "nothing" => Kept::Nothing,
        _ => {
            let message = format!("keep = {kept:?}: \"all\", \"values\" or \"nothing\"");
            return Err(of_input(py, &message));
        }
    };
    let workers = workers.map(Crew);
    how.compute(py, scene, workers.as_ref(), |session, provenance| {
        let done = session.run(&wanted, &out, provenance)?;
        let stopped = done.outcome.stopped || done.laws.stopped;
        let summary = costate_cli::summary(&done, wanted.laws);
        Ok((done.path, summary, stopped))
    })
}

/// Puts parts together to the whole: its file, and the shards that are missing or unfinished.
#[pyfunction]
pub fn merge(
    py: Python<'_>,
    parts: Vec<PathBuf>,
    out: PathBuf,
    partial: bool,
) -> PyResult<(PathBuf, Vec<usize>, Vec<usize>)> {
    let merged = py.detach(|| {
        let options = MergeOptions {
            partial,
            ..MergeOptions::default()
        };
        put_together(&parts, &out, options, &provenance(), &Silent)
    });
    match merged {
        Ok(merged) => Ok((merged.path, merged.missing, merged.unfinished)),
        Err(error) => Err(raised(py, CliError::from(error))),
    }
}

/// Which of `of` shards does each of so many units.
#[pyfunction]
pub fn shard_owner(units: usize, of: usize) -> Vec<usize> {
    Shard::owner(units, of.max(1))
}

/// The scene's `[study]`.
#[pyfunction]
pub fn study(py: Python<'_>, scene: &Scene, out: PathBuf, how: How) -> PyResult<Written> {
    how.compute(py, scene, None, |session, provenance| {
        let done = made_study(session, (None, Resume::Never), &out, provenance)?;
        let rows = study_rows(&session.scene().model, &done.variants);
        Ok((done.path, json!(rows), done.stopped))
    })
}

/// The scene's `[attenuation]`.
#[pyfunction]
pub fn attenuation(py: Python<'_>, scene: &Scene, out: PathBuf, how: How) -> PyResult<Written> {
    how.compute(py, scene, None, |session, provenance| {
        let mut file = ResultFile::create(&out)?;
        let found = session.attenuation()?;
        write_attenuation(&mut file, &session.scene().model, &found)?;
        let path = session.finish(file, provenance)?;
        Ok((path, json!(AttenuationSummary::new(&found)), false))
    })
}

/// Flights forward in time from `[flight][component]`, with the scene's events. `law`: the name of one
/// of the scene's, or a weights file's (name, text).
#[pyfunction]
#[pyo3(signature = (scene, out, how, x=None, *, time=None, events=None, samples=None, law=None, weights=None, cycle=None))]
#[allow(clippy::too_many_arguments, reason = "named, in Python")]
pub fn simulate(
    py: Python<'_>,
    scene: &Scene,
    out: PathBuf,
    how: How,
    x: Option<PyReadonlyArray2<'_, f64>>,
    time: Option<f64>,
    events: Option<usize>,
    samples: Option<usize>,
    law: Option<String>,
    weights: Option<(String, String)>,
    cycle: Option<usize>,
) -> PyResult<Written> {
    let x: Option<Vec<f64>> = x
        .map(|x| Ok::<_, PyErr>(x.as_slice()?.to_vec()))
        .transpose()?;
    let options = SimulationOptions {
        time,
        events,
        samples,
        law: match (law, weights) {
            (_, Some(weights)) => Some(ControlledBy::Weights(of_text(weights))),
            (Some(name), None) => Some(ControlledBy::Law(name)),
            (None, None) => None,
        },
        cycle,
    };
    how.compute(py, scene, None, |session, provenance| {
        let mut file = ResultFile::create(&out)?;
        let model = &session.scene().model;
        let axes = TrajectorySchema::axes(model);
        let simulated = session.simulate(x.as_deref(), &options)?;
        let backend = session.backend();
        file.simulation(&axes, &simulated, (backend.name(), &backend.adapter()))?;
        let path = session.finish(file, provenance)?;
        Ok((path, json!({ "status": simulated.by_status() }), false))
    })
}

/// The scene's `[closed_loop]` and `[dissipation]`, with V and laws of a result file, and further laws
/// (name, text).
#[pyfunction]
#[pyo3(signature = (scene, out, how, stored=None, *, laws=None, weights=Vec::new(), random=None, solve=false))]
#[allow(clippy::too_many_arguments, reason = "named, in Python")]
pub fn evaluate(
    py: Python<'_>,
    scene: &Scene,
    out: PathBuf,
    how: How,
    stored: Option<PathBuf>,
    laws: Option<Vec<String>>,
    weights: Vec<(String, String)>,
    random: Option<usize>,
    solve: bool,
) -> PyResult<Written> {
    let options = LoopOptions {
        laws,
        random,
        solve,
    };
    let added = weights.into_iter().map(of_text).collect();
    how.compute(py, scene, None, |session, provenance| {
        let stored = stored.map(Stored::open).transpose()?;
        let out = Some(out.as_path());
        let done = evaluated(session, stored.as_ref(), added, &options, out, provenance)?;
        let closed_loop = done.closed_loop.as_ref();
        let summary = closed_loop.map(|e| EvaluationSummary::new(e, &done.path));
        Ok((done.path.clone(), json!(summary), false))
    })
}

/// Fits the laws of `[feedback]` of a scene to what a result file holds, into that file. `directory`:
/// where the files of the laws go. Returns the laws, the names of those left out, and the exception
/// that ended it.
#[pyfunction]
#[pyo3(signature = (scene, file, directory, how, *, names=None, starts=None, seed=None))]
#[allow(clippy::too_many_arguments, reason = "named, in Python")]
pub fn fit(
    py: Python<'_>,
    scene: &Scene,
    file: PathBuf,
    directory: PathBuf,
    how: How,
    names: Option<Vec<String>>,
    starts: Option<usize>,
    seed: Option<u64>,
) -> PyResult<(Vec<Law>, Vec<String>, Option<PyErr>)> {
    let inner = Arc::clone(&scene.inner);
    let gone = how.going(py, |listener, deadline| {
        let stored = Stored::open(&file)?;
        let mut laws = inner.model.feedback.clone();
        laws.retain(|law| names.as_ref().is_none_or(|names| names.contains(&law.name)));
        for law in &mut laws {
            law.seed = seed.unwrap_or(law.seed);
            law.starts = starts.unwrap_or(law.starts);
        }
        if laws.is_empty() {
            return Err(CliError::from(RunError::NoFeedback { path: file.clone() }));
        }
        let files = LawFiles::new(&file, Some(&directory));
        let going: (&dyn costate::session::Progress, _) = (listener, deadline);
        let done = fit_stored(&stored, &inner.model, &laws, &files, going)?;
        let fitted: Vec<Law> = (done.fitted.laws.iter())
            .map(|law| Law::fitted(law, Arc::clone(&inner)))
            .collect::<Result<_, CliError>>()?;
        Ok((fitted, done.fitted.left_out))
    })?;
    match (gone.done, gone.interrupted) {
        (Ok((laws, left_out)), interrupted) => Ok((laws, left_out, interrupted)),
        (Err(_), Some(interrupted)) => Err(interrupted),
        (Err(e), None) => Err(raised_by(py, e, gone.is_late)),
    }
}

/// The page, the names of its pictures, and what could not be drawn with the reason.
type Reported = (PathBuf, Vec<String>, Vec<(String, String)>);

/// The report of a result file: the page, the names of its pictures, and what could not be drawn.
#[pyfunction]
#[pyo3(signature = (file, page, *, axes=None, slice=Vec::new(), levels=Vec::new(), width=None))]
pub fn report(
    py: Python<'_>,
    file: PathBuf,
    page: PathBuf,
    axes: Option<[String; 2]>,
    slice: Vec<(String, f64)>,
    levels: Vec<f64>,
    width: Option<u32>,
) -> PyResult<Reported> {
    let done = py.detach(|| {
        let stored = Stored::open(&file)?;
        let choice = Report {
            axes,
            slice,
            levels,
        };
        let options = costate_report::Options {
            out: Some(page),
            choice,
            width,
        };
        Ok::<_, CliError>(costate_report::write(&stored, &options)?)
    });
    let written = done.map_err(|e| raised(py, e))?;
    Ok((written.page, written.pictures, written.missing))
}

fn of_text((name, text): (String, String)) -> Weights {
    let file = name.clone();
    Weights { name, text, file }
}
