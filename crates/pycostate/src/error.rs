//! Errors as Python's exceptions; their classes are in `pycostate.errors`.

use costate::ScenarioErrors;
use costate_cli::CliError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

/// Status of what was ended before it was done.
const UNFINISHED: u8 = 75;
/// Status of what the caller has given.
const OF_INPUT: u8 = 2;

/// An error as an exception: `SceneError` with the places where a scene is at fault, `InputError` for
/// what else was given, `OutOfTime` for what had no time, `CostateError` for what could not be done.
pub fn raised(py: Python<'_>, error: impl Into<CliError>) -> PyErr {
    let error = error.into();
    if let Some(problems) = error.problems() {
        return of_scene(py, problems).unwrap_or_else(|e| e);
    }
    let class = match error.status() {
        UNFINISHED => "OutOfTime",
        OF_INPUT => "InputError",
        _ => "CostateError",
    };
    exception(py, class, &error.to_string()).unwrap_or_else(|e| e)
}

/// The same for what is at fault in a call.
pub fn of_input(py: Python<'_>, message: &str) -> PyErr {
    exception(py, "InputError", message).unwrap_or_else(|e| e)
}

fn class<'py>(py: Python<'py>, name: &str) -> PyResult<Bound<'py, PyAny>> {
    py.import("pycostate.errors")?.getattr(name)
}

fn exception(py: Python<'_>, name: &str, message: &str) -> PyResult<PyErr> {
    Ok(PyErr::from_value(class(py, name)?.call1((message,))?))
}

/// `SceneError(text, file, problems)`; a problem is a dict with `message`, `line`, `column`, `help`.
fn of_scene(py: Python<'_>, errors: &ScenarioErrors) -> PyResult<PyErr> {
    let problems = PyList::empty(py);
    for problem in &errors.problems {
        let (line, column) = errors.place(problem).unzip();
        let one = PyDict::new(py);
        one.set_item("message", &problem.message)?;
        one.set_item("line", line)?;
        one.set_item("column", column)?;
        one.set_item("help", &problem.help)?;
        problems.append(one)?;
    }
    let text = errors.render(false);
    let made = class(py, "SceneError")?.call1((text.trim_end(), &errors.file_name, problems))?;
    Ok(PyErr::from_value(made))
}
