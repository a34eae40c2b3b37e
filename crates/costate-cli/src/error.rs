//! Why a command stopped, and its exit status.

use costate::backend::BackendError;
use costate::low_level::diagnostics::printable;
use costate::low_level::dynamic_programming::DpError;
use costate::low_level::feedback::{LawError, NetworkError};
use costate::low_level::files::FileError;
use costate::low_level::hdf5::OutputError;
use costate::low_level::local::LocalError;
#[cfg(feature = "gpu")]
use costate::low_level::map::DeviceError;
use costate::low_level::result::{StoredError, StoredMapError};
use costate::low_level::scenario::{LoadError, ScenarioErrors};
use costate::run::RunError;
use costate::session::{SessionError, Shard};
use costate_bench::BenchError;
use std::io::{IsTerminal, Write};
use std::path::PathBuf;

/// Most nodes in all: about a hundred bytes each.
pub const MOST_NODES: usize = 20_000_000;

/// Exit status of what was ended before it was done, and has left what was done: EX_TEMPFAIL of
/// sysexits.h.
const UNFINISHED: u8 = 75;

/// Why a command stopped.
#[derive(Debug, thiserror::Error)]
pub enum CliError {
    #[error(transparent)]
    Scenario(ScenarioErrors),
    #[error(transparent)]
    Session(SessionError),
    #[error(transparent)]
    Run(RunError),
    #[error(transparent)]
    Backend(#[from] BackendError),
    #[cfg(feature = "gpu")]
    #[error(transparent)]
    Device(#[from] DeviceError),
    #[error(transparent)]
    Points(#[from] PointsError),
    #[error(transparent)]
    Place(#[from] PlaceError),
    #[error(transparent)]
    Export(#[from] ExportError),
    #[cfg(feature = "urdf")]
    #[error(transparent)]
    Import(#[from] ImportFileError),
    #[error(transparent)]
    Refused(#[from] GridRefusal),
    #[error(transparent)]
    Shard(#[from] ShardRefusal),
    #[error(transparent)]
    Adapters(#[from] AdaptersError),
    #[error(transparent)]
    Bench(#[from] BenchError),
    #[error("--out {path}: the picture takes this name with .svg; name the table .h5", path = path.display())]
    PictureName { path: PathBuf },
    #[cfg(feature = "report")]
    #[error(transparent)]
    Report(#[from] costate_report::ReportError),
    #[cfg(feature = "report")]
    #[error(transparent)]
    ReportOption(#[from] OptionError),
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
    #[error("{path} has no [mechanism]", path = path.display())]
    NoMechanism { path: PathBuf },
    #[error("V in the file is not the least at {states} states")]
    NotLeast {
        states: usize,
        /// Whether it has been said.
        silent: bool,
    },
    #[error("ended by {by} before all was done; {path} has what was done by then", path = path.display())]
    Stopped { by: String, path: PathBuf },
    #[error("ended by {by}: {why}: nothing is written")]
    Nothing { by: String, why: String },
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
                GridRefusal::OutOfTime(DpError::OutOfTime).into()
            }
            other => Self::Session(other),
        }
    }
}

impl From<RunError> for CliError {
    fn from(error: RunError) -> Self {
        match error {
            RunError::Session(error) => error.into(),
            other => Self::Run(other),
        }
    }
}

/// What may stop a run is one of its errors, whichever command meets it.
macro_rules! of_a_run {
    ($($error:ty),+) => {
        $(impl From<$error> for CliError {
            fn from(error: $error) -> Self {
                Self::Run(error.into())
            }
        })+
    };
}
of_a_run!(
    LoadError,
    OutputError,
    FileError,
    StoredError,
    StoredMapError
);

impl CliError {
    /// 2 for what the user wrote, 1 for what could not be done, 75 for what was ended before.
    pub fn status(&self) -> u8 {
        if matches!(
            self,
            Self::Stopped { .. } | Self::Nothing { .. } | Self::Shard(ShardRefusal::Partial { .. })
        ) {
            return UNFINISHED;
        }
        let of_input = match self {
            Self::Session(error) => error.is_of_input(),
            Self::Run(error) => error.is_of_input(),
            #[cfg(feature = "gpu")]
            Self::Device(DeviceError::Backend(error)) => error.is_of_input(),
            #[cfg(feature = "gpu")]
            Self::Device(_) => true,
            Self::Backend(error) => error.is_of_input(),
            Self::Refused(error) => !matches!(error, GridRefusal::OutOfTime(_)),
            Self::Adapters(AdaptersError::Part { status, .. }) => return *status,
            Self::Adapters(error) => !matches!(error, AdaptersError::Process { .. }),
            #[cfg(feature = "report")]
            Self::Report(error) => {
                use costate_report::ReportError;
                match error {
                    ReportError::Options(_)
                    | ReportError::Stored(_)
                    | ReportError::NotOurs { .. } => true,
                    ReportError::Output(error) => error.is_of_name(),
                    _ => false,
                }
            }
            Self::Bench(_) | Self::NotLeast { .. } | Self::Stdout(_) => false,
            _ => true,
        };
        if of_input { 2 } else { 1 }
    }

    /// What is wrong with a scene, where that is the reason.
    pub fn problems(&self) -> Option<&ScenarioErrors> {
        match self {
            CliError::Scenario(e) | CliError::Run(RunError::Load(LoadError::Scenario(e))) => {
                Some(e)
            }
            _ => None,
        }
    }

    pub fn print(&self) {
        if matches!(self, CliError::NotLeast { silent: true, .. }) {
            return;
        }
        let colours = std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none();
        let text = match self.problems() {
            Some(problems) => problems.render(colours),
            None => printable(&format!("error: {self}")).into_owned(),
        };
        // Nowhere is left to report a failure of this.
        let _ = writeln!(std::io::stderr(), "{}", text.trim_end());
    }
}

/// Why no part of the work is done, or not all parts were put together.
#[derive(Debug, thiserror::Error)]
pub enum ShardRefusal {
    #[error(
        "{is} is set, and {not} is not: which shard is this? Give --shard M/N (or --shard none)"
    )]
    Half { is: &'static str, not: &'static str },
    #[error("{name}: `{text}` is no number: give --shard M/N (or --shard none)")]
    NoNumber { name: &'static str, text: String },
    #[error(
        "task {id} is none of {of} from {min} on in steps of {step} (a part of a job array that is run again?): give --shard M/N"
    )]
    NotInTurn {
        id: usize,
        of: usize,
        min: usize,
        step: usize,
    },
    #[error("--resume: what is gone on with has a file of its own: name it (--out FILE.h5)")]
    NoOut,
    #[error("--time-limit is for parts that are gone on with: give --shard M/N, or --resume, too")]
    NoLimit,
    #[error(
        "a shard's result is put together with others: name a result file (--out FILE.h5), not a table"
    )]
    Table,
    #[error("not all shards are there; {path} says which", path = path.display())]
    Partial { path: PathBuf },
}

/// Why the work is not done by all adapters.
#[derive(Debug, thiserror::Error)]
pub enum AdaptersError {
    #[error(
        "--adapter all is for solve, homotopy, map and study, whose work is divided: name one adapter, or give its number in the list of `costate adapters`"
    )]
    NotDivided,
    #[error(
        "--adapter all: a map to an error is not divided, but a grid is: name one adapter, or leave [map] error out"
    )]
    Map,
    #[error(
        "--adapter all divides the work by itself, and this is its shard {shard}: give each task one adapter by its number (--adapter K)"
    )]
    Shard { shard: Shard },
    #[error("--adapter all puts results together: name a result file (--out FILE.h5), not a table")]
    Table,
    #[error("--adapter all: each adapter's process reads {path}, which must be a file for that", path = path.display())]
    NoFile { path: PathBuf },
    #[error("{doing} of adapter {adapter}: {source}")]
    Process {
        doing: &'static str,
        adapter: String,
        source: std::io::Error,
    },
    #[error("adapter {adapter}: {message}{}", going_on(kept.as_ref()))]
    Part {
        adapter: String,
        message: String,
        status: u8,
        /// The folder of parts, where there are any.
        kept: Option<PathBuf>,
    },
}

fn going_on(kept: Option<&PathBuf>) -> String {
    kept.map_or_else(String::new, |folder| {
        let folder = folder.display();
        format!("\n{folder} has what was done by then; --resume goes on with it")
    })
}

/// What is wrong with the places asked for.
#[derive(Debug, thiserror::Error)]
pub enum PlaceError {
    #[error(
        "no states are asked for: give --at NAME=VALUE,..., --points FILE.csv or --grid NAME=FIRST:LAST:COUNT"
    )]
    Nothing,
    #[error("--{option} {text}: {reason}")]
    Malformed {
        option: &'static str,
        text: String,
        reason: String,
    },
    #[error(
        "two columns of the table would be called `{name}`, one of them a state's or control's: take a result file (--out FILE.h5) or --json, or rename it"
    )]
    TwoColumns { name: String },
    #[error("--precision f32: on the CPU values are those of f64 (--backend gpu has both)")]
    Precision,
}

/// Why no robot was imported.
#[cfg(feature = "urdf")]
#[derive(Debug, thiserror::Error)]
pub enum ImportFileError {
    #[error("cannot read {path}: {source}", path = path.display())]
    Read {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("{path} is there already: name another file with --out", path = path.display())]
    Exists { path: PathBuf },
    #[error("{path}: {error}", path = path.display())]
    Robot {
        path: PathBuf,
        error: costate_urdf::ImportError,
    },
}

/// Why nothing was exported.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    #[error(
        "{path} has no map in pieces: give the scene [map] with error = ... and run it again (--local exports the series about the equilibrium)", path = path.display()
    )]
    NoMap { path: PathBuf },
    #[error("{path} is a scene, and a map is in a result file: run it first (--local exports the series about the equilibrium)", path = path.display())]
    Scene { path: PathBuf },
    #[error("{path} is a scene, and a fitted law is in a result file: run it and fit the law first (costate fit)", path = path.display())]
    SceneOfLaw { path: PathBuf },
    #[error("{path} holds no fitted law: fit one first (costate fit)", path = path.display())]
    NoLaw { path: PathBuf },
    #[error("{path} holds {}: say which with --law=NAME", listed(laws), path = path.display())]
    WhichLaw { path: PathBuf, laws: Vec<String> },
    #[error("{path} holds no law `{name}`, but {}", listed(laws), path = path.display())]
    OtherLaws {
        path: PathBuf,
        name: String,
        laws: Vec<String>,
    },
    #[error(
        "--set changes a scene, and {path} is a result file: run its scene with --set and export that, or export the series of the scene (--local SCENE.toml --set ...)", path = path.display()
    )]
    SetOfResult { path: PathBuf },
    #[error("a finite horizon has no equilibrium, and so no series about it")]
    Finite,
    #[error(transparent)]
    Local(#[from] LocalError),
    #[error(transparent)]
    Weights(#[from] NetworkError),
    #[error(transparent)]
    Law(#[from] LawError),
}

/// An option that is no number or names nothing.
#[cfg(feature = "report")]
#[derive(Debug, thiserror::Error)]
#[error("{option} {text}: {reason}")]
pub struct OptionError {
    pub option: &'static str,
    pub text: String,
    pub reason: String,
}

/// Why there is no V on a grid for a command.
#[derive(Debug, thiserror::Error)]
pub enum GridRefusal {
    #[error(
        "{path} has no solved states in /points or /map: make it with `costate solve SCENE --points FILE.csv`, or ask for [homotopy] or [map] in the scene",
        path = path.display()
    )]
    NoStates { path: PathBuf },
    #[error("{path} has no solved states: its run was ended before any was solved; run it again", path = path.display())]
    NoneDone { path: PathBuf },
    #[error(
        "--nodes: {given} numbers for {states} states: give one for all axes, or one for each of {names}"
    )]
    Counts {
        given: usize,
        states: usize,
        names: String,
    },
    #[error("--nodes: {nodes} nodes in all; at most {}", MOST_NODES)]
    TooManyNodes { nodes: usize },
    #[error(
        "--grid-guesses: this solves for no states of [homotopy], [map] or a file: leave the option out"
    )]
    Nothing,
    #[error("--seconds: {0}: give more of them, or fewer --nodes")]
    OutOfTime(DpError),
}

/// What is wrong with a file of points; each error names the place.
#[derive(Debug, thiserror::Error)]
pub enum PointsError {
    #[error("cannot read {}: {source}", path.display())]
    Read { path: PathBuf, source: csv::Error },
    #[error("{}: line {line}: {reason}", path.display())]
    Malformed {
        path: PathBuf,
        line: u64,
        reason: String,
    },
    #[error("{}: line 1: `{name}` is not a state of the scene (states: {states}){help}", path.display())]
    UnknownState {
        path: PathBuf,
        name: String,
        states: String,
        help: String,
    },
    #[error("{}: line 1: `{name}` stands there twice", path.display())]
    Twice { path: PathBuf, name: String },
    #[error("{}: line 1: a header with the names of states is needed (states: {states})", path.display())]
    NoHeader { path: PathBuf, states: String },
    #[error("{}: line {line}, column `{name}`: `{text}` is not a finite number", path.display())]
    NotANumber {
        path: PathBuf,
        line: u64,
        name: String,
        text: String,
    },
    #[error("{}: line {line}, column `{name}`: {reason}", path.display())]
    Refused {
        path: PathBuf,
        line: u64,
        name: String,
        reason: String,
    },
    #[error("{} is not a CSV file: it is {what}; states are given as CSV, a header with their names and a line each", path.display())]
    NoTable { path: PathBuf, what: &'static str },
    #[error("{} has a header but no points", path.display())]
    Empty { path: PathBuf },
}

fn listed(laws: &[String]) -> String {
    format!("the laws {}", laws.join(", "))
}
