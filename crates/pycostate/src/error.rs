//! Errors as Python's exceptions; their classes are in `pycostate.errors`.

use costate::ScenarioErrors;
use costate_cli::CliError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

/// Status of what was ended before it was done.
const UNFINISHED: u8 = 75;
/// What is said of a part for which no time was left.
const OUT_OF_TIME: &str = "the time given is over";
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
    exception(py, class, &in_python(&error.to_string())).unwrap_or_else(|e| e)
}

/// A message without the command line's words: `--time-limit` is `time_limit`.
#[pyfunction]
pub fn in_python(text: &str) -> String {
    // `costate check-least FILE` is p.check_least(...).
    let mut calls = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find("`costate ") {
        let command = &rest[at + "`costate ".len()..];
        let Some(end) = command.find('`') else {
            break;
        };
        let name = command[..end].split(' ').next().unwrap_or_default();
        calls.push_str(&rest[..at]);
        calls.push_str(&format!("p.{}(...)", name.replace('-', "_")));
        rest = &command[end + 1..];
    }
    let text = calls + rest;
    let mut made = String::with_capacity(text.len());
    let mut rest = text.as_str();
    while let Some(at) = rest.find("--") {
        let (before, option) = (&rest[..at], &rest[at + 2..]);
        let end = option
            .find(|c: char| !(c.is_ascii_lowercase() || c == '-'))
            .unwrap_or(option.len());
        let begins = before.is_empty() || before.ends_with([' ', '(', '`', '\'']);
        let name = &option[..end];
        made.push_str(before);
        match begins && name.starts_with(|c: char| c.is_ascii_lowercase()) {
            true => made.push_str(&name.replace('-', "_")),
            false => made.push_str(&rest[at..at + 2 + end]),
        }
        rest = &option[end..];
    }
    made + rest
}

/// The same of work that had a time limit, and whether that has passed.
pub fn raised_by(py: Python<'_>, error: impl Into<CliError>, is_late: bool) -> PyErr {
    let error = error.into();
    let text = error.to_string();
    match is_late && text.contains(OUT_OF_TIME) {
        true => exception(py, "OutOfTime", &in_python(&text)).unwrap_or_else(|e| e),
        false => raised(py, error),
    }
}

/// The same for what is at fault in a call.
pub fn of_input(py: Python<'_>, message: &str) -> PyErr {
    exception(py, "InputError", message).unwrap_or_else(|e| e)
}

fn class<'py>(py: Python<'py>, name: &str) -> PyResult<Bound<'py, PyAny>> {
    py.import("pycostate.errors")?.getattr(name)
}

/// An exception of a class of the package.
pub fn exception(py: Python<'_>, name: &str, message: &str) -> PyResult<PyErr> {
    Ok(PyErr::from_value(class(py, name)?.call1((message,))?))
}

/// `SceneError(text, file, problems)`; a problem is a dict with `message`, `line`, `column`, `help`.
fn of_scene(py: Python<'_>, errors: &ScenarioErrors) -> PyResult<PyErr> {
    let problems = PyList::empty(py);
    for problem in &errors.problems {
        let (line, column) = errors.place(problem).unzip();
        let one = PyDict::new(py);
        one.set_item("message", in_python(&problem.message))?;
        one.set_item("line", line)?;
        one.set_item("column", column)?;
        one.set_item("help", &problem.help)?;
        problems.append(one)?;
    }
    // What users have written stays as it is.
    let text = errors.render(false).replace("--set ", "set ");
    let made = class(py, "SceneError")?.call1((text.trim_end(), &errors.file_name, problems))?;
    Ok(PyErr::from_value(made))
}
