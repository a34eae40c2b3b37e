//! Why a command stopped, and its exit status.

use crate::commands::{export, report, value};
use crate::common::{grid, points};
use costate::backend::BackendError;
use costate::low_level::dynamic_programming::DpError;
use costate::low_level::files::FileError;
use costate::low_level::hdf5::OutputError;
use costate::low_level::map::DeviceError;
use costate::low_level::result::{StoredError, StoredMapError};
use costate::low_level::scenario::{LoadError, ScenarioErrors};
use costate::run::RunError;
use costate::session::SessionError;
use costate_bench::BenchError;
use std::io::{IsTerminal, Write};
use std::path::PathBuf;

/// Why a command stopped.
#[derive(Debug, thiserror::Error)]
pub enum CliError {
    #[error(transparent)]
    Load(#[from] LoadError),
    #[error(transparent)]
    Scenario(ScenarioErrors),
    #[error(transparent)]
    Session(SessionError),
    #[error(transparent)]
    Run(RunError),
    #[error(transparent)]
    Backend(#[from] BackendError),
    #[error(transparent)]
    Output(#[from] OutputError),
    #[error(transparent)]
    File(#[from] FileError),
    #[error(transparent)]
    Stored(#[from] StoredError),
    #[error(transparent)]
    Map(#[from] StoredMapError),
    #[error(transparent)]
    Device(#[from] DeviceError),
    #[error(transparent)]
    Points(#[from] points::PointsError),
    #[error(transparent)]
    Place(#[from] value::PlaceError),
    #[error(transparent)]
    Export(#[from] export::ExportError),
    #[error(transparent)]
    Refused(#[from] grid::GridRefusal),
    #[error(transparent)]
    Bench(#[from] BenchError),
    #[error("--out {path}: the picture takes this name with .svg; name the table .h5", path = path.display())]
    PictureName { path: PathBuf },
    #[error(transparent)]
    Report(#[from] costate_report::ReportError),
    #[error(transparent)]
    ReportOption(#[from] report::OptionError),
    #[error("--out {path}: {reason}", path = path.display())]
    BadOut { path: PathBuf, reason: String },
    #[error(
        "--set does not change a result file's own scene: give the scene too (--scene SCENE.toml --set ...)"
    )]
    SetOfResult,
    #[error(
        "--adapter {name}: the CPU is asked for, which has no adapters: leave this out, or give --backend gpu"
    )]
    AdapterOfCpu { name: String },
    #[error("V in the file is not the least at {states} states")]
    NotLeast {
        states: usize,
        /// Whether it has been said.
        silent: bool,
    },
    #[error("cannot write to standard output: {0}")]
    Stdout(#[from] std::io::Error),
}

/// Problems of a scene are shown with their places, wherever they come from.
impl From<ScenarioErrors> for CliError {
    fn from(errors: ScenarioErrors) -> Self {
        Self::Scenario(errors)
    }
}

impl From<SessionError> for CliError {
    fn from(error: SessionError) -> Self {
        match error {
            SessionError::Scenario(errors) => Self::Scenario(errors),
            SessionError::Grid(DpError::OutOfTime) => {
                grid::GridRefusal::OutOfTime(DpError::OutOfTime).into()
            }
            other => Self::Session(other),
        }
    }
}

impl From<RunError> for CliError {
    fn from(error: RunError) -> Self {
        match error {
            RunError::Session(error) => error.into(),
            RunError::Load(error) => error.into(),
            other => Self::Run(other),
        }
    }
}

impl CliError {
    /// 2 for what the user wrote, 1 for what could not be done.
    pub fn status(&self) -> u8 {
        let of_input = match self {
            Self::Session(error) => error.is_of_input(),
            Self::Run(error) => error.is_of_input(),
            Self::File(error) | Self::Output(OutputError::File(error)) => error.is_of_name(),
            Self::Device(error) => !matches!(error, DeviceError::Backend(_)),
            Self::Refused(error) => !matches!(error, grid::GridRefusal::OutOfTime(_)),
            Self::Report(error) => {
                use costate_report::ReportError;
                matches!(
                    error,
                    ReportError::Options(_) | ReportError::Stored(_) | ReportError::NotOurs { .. }
                )
            }
            Self::Backend(_)
            | Self::Output(_)
            | Self::Bench(_)
            | Self::NotLeast { .. }
            | Self::Stdout(_) => false,
            _ => true,
        };
        if of_input { 2 } else { 1 }
    }

    pub fn print(&self) {
        if matches!(self, CliError::NotLeast { silent: true, .. }) {
            return;
        }
        let colours = std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none();
        let text = match self {
            CliError::Scenario(e) | CliError::Load(LoadError::Scenario(e)) => e.render(colours),
            other => format!("error: {other}"),
        };
        // Nowhere is left to report a failure of this.
        let _ = writeln!(std::io::stderr(), "{}", text.trim_end());
    }
}
