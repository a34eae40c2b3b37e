//! The backend that a command computes on.

use crate::args::{BackendChoice, NumericsArgs};
use crate::error::{AdaptersError, CliError};
use costate::backend::Backend;
use costate::backend::adapters::{self, Selection};
use costate::backend::cpu::Cpu;
use costate::low_level::model::{Method, Model};

/// What `--adapter` is given for all of them.
pub const ALL: &str = "all";

/// The backend asked for, fit for the method asked for where the choice is ours.
pub fn backend(
    choice: BackendChoice,
    adapter: Option<&str>,
    method: Option<Method>,
) -> Result<Box<dyn Backend>, CliError> {
    let selection = match (adapter, choice) {
        (Some(name), BackendChoice::Cpu) => {
            return Err(CliError::AdapterOfCpu {
                name: name.to_owned(),
            });
        }
        (None, BackendChoice::Cpu) => return Ok(Box::new(Cpu::new())),
        (Some(ALL), _) => return Err(AdaptersError::NotDivided.into()),
        (Some(name), _) => Selection::Named(name.to_owned()),
        (None, BackendChoice::Gpu) => Selection::Any,
        (None, BackendChoice::Auto) => Selection::Hardware,
    };
    match adapters::open(&selection)? {
        // Where the choice is ours, a method asked for counts.
        Some(gpu)
            if selection == Selection::Hardware && method.is_some_and(|m| !gpu.favours(m)) =>
        {
            Ok(Box::new(Cpu::new()))
        }
        Some(gpu) => Ok(gpu),
        // Only a search for hardware comes back empty.
        None => Ok(Box::new(Cpu::new())),
    }
}

impl NumericsArgs {
    /// The backend asked for, fit for the method that is asked for here or by the scene.
    pub fn open(&self, model: &Model) -> Result<Box<dyn Backend>, CliError> {
        let method = self.method.or(model.integrator.method);
        backend(self.backend, self.adapter.as_deref(), method)
    }
}
