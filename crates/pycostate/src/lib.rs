//! The engine as a Python module, `pycostate._engine`: scenes, runs that end at Ctrl-C, values of a
//! map, laws. What users see is in Python, in `python/pycostate`, which makes labelled arrays of the
//! result files that are written here.

mod error;
mod going;
mod law;
mod runs;
mod scene;
mod system;
mod value;

use pyo3::prelude::*;

/// What `pycostate` is made of; it promises nothing.
#[pymodule]
mod _engine {
    #[pymodule_export]
    use super::error::in_python;
    #[pymodule_export]
    use super::law::Law;
    #[pymodule_export]
    use super::run_command;
    #[pymodule_export]
    use super::runs::{
        MapWorker, attenuation, evaluate, fit, merge, report, run, shard_owner, simulate, study,
    };
    #[pymodule_export]
    use super::scene::{Scene, scene_of_file};
    #[pymodule_export]
    use super::system::System;
    #[pymodule_export]
    use super::value::Value;
}

/// Runs `costate ARGUMENTS...`: the whole program, which prints to the process's standard output.
/// Returns its exit status.
#[pyfunction]
fn run_command(py: Python<'_>, arguments: Vec<std::ffi::OsString>) -> u8 {
    py.detach(|| costate_cli::run_command(arguments))
}
