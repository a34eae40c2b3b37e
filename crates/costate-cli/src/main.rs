//! The program `costate` (see `costate --help`): reads arguments, calls the library, prints.

mod afterwards;
mod alone;
mod attenuation;
mod bench;
mod bench_report;
mod check;
mod check_least;
mod columns;
mod dissipation;
mod estimates;
mod evaluate;
mod export;
mod fit;
mod grid;
mod listed;
mod mapped;
mod points;
mod report;
mod report_page;
mod run;
mod study;
mod value;

use clap::{Args, Parser, Subcommand, ValueEnum};
use costate::attenuation::SmallestError;
use costate::backend::{Backend, BackendError};
use costate::closed_loop::{LawError, LoopError};
use costate::files::FileError;
use costate::files::target;
use costate::hdf5::OutputError;
use costate::map::DeviceError;
use costate::model::{Method, Model, Precision};
use costate::result::{RunRecord, StoredError};
use costate::scenario::{LoadError, ScenarioErrors};
use costate::study::StudyError;
use costate::sweep::Choices;
use costate_bench::BenchError;
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::SystemTime;

/// Value functions and optimal feedback of nonlinear systems over a region, by bicharacteristics.
#[derive(Parser, Debug)]
#[command(version, about, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand, Debug)]
enum Command {
    /// Do everything that the scenario asks for and write the result file.
    Run(RunArgs),
    /// Only the sweep outward from the equilibrium (or from the terminal cost).
    ShootOut(RunArgs),
    /// Only V, p and u at the states of [homotopy] and [map], with every sheet found there.
    Homotopy(RunArgs),
    /// V, p and u at the states in a CSV file, in its order.
    Solve(SolveArgs),
    /// V, p and u at any state, interpolated from a result file, with an error estimate.
    Value(ValueArgs),
    /// Ask V on a grid, which knows nothing of sheets, whether V at the solved states of a result
    /// file is the least.
    CheckLeast(check_least::CheckLeastArgs),
    /// Only [study]: the optimal trajectory from one state for several values of parameters.
    Study(RunArgs),
    /// Only [attenuation]: the smallest level of attenuation, of the linearization and of a region,
    /// with pictures.
    Attenuation(RunArgs),
    /// Simulate feedback laws from many initial states, as [closed_loop] asks, and put what came of
    /// it into the result file.
    Evaluate(EvaluateArgs),
    /// Speed against error of every backend, precision, method and tolerance on the scene's own
    /// trajectories.
    Bench(BenchArgs),
    /// Fit the laws of [feedback] to the trajectories of a result file.
    Fit(FitArgs),
    /// V, p and u as a C header: of a map in pieces, or of the series about the equilibrium; or a
    /// fitted law.
    Export(ExportArgs),
    /// One page of HTML with pictures of what a result file holds, and the pictures beside it as
    /// SVG and PNG.
    Report(ReportArgs),
    /// Validate a scenario and print the derived equations and the local solution.
    Check(CheckArgs),
    /// List the GPU adapters found and what each can do.
    Adapters {
        /// Machine-readable list on standard output.
        #[arg(long)]
        json: bool,
    },
}

/// Options of every command that reads a scenario.
#[derive(Args, Debug, Clone)]
struct SceneArgs {
    /// The scenario file (TOML).
    scenario: PathBuf,
    /// Replace a parameter: a number or an expression of earlier parameters. May be repeated.
    #[arg(long = "set", value_name = "NAME=VALUE", value_parser = assignment)]
    set: Vec<(String, String)>,
    /// Machine-readable summary on standard output; everything else goes to standard error.
    #[arg(long)]
    json: bool,
    /// Print nothing but errors.
    #[arg(long)]
    quiet: bool,
}

#[derive(Args, Debug, Clone)]
struct CheckArgs {
    #[command(flatten)]
    scene: SceneArgs,
}

/// Where and how exactly to integrate.
#[derive(Args, Debug, Clone)]
struct NumericsArgs {
    /// Where to compute: a hardware GPU if there is one and else the CPU (auto), any GPU adapter,
    /// or the CPU.
    #[arg(long, value_enum, default_value_t = BackendChoice::Auto)]
    backend: BackendChoice,
    /// Use the adapter whose name contains this.
    #[arg(long, value_name = "NAME")]
    adapter: Option<String>,
    /// Arithmetic of the integration [default: the scenario's]
    #[arg(long, value_enum)]
    precision: Option<PrecisionChoice>,
    /// Integration method: rk4, tsit5, dop853, taylor [default: the scenario's]
    #[arg(long, value_parser = method)]
    method: Option<Method>,
    /// Relative tolerance [default: the scenario's]
    #[arg(long, value_parser = tolerance, allow_negative_numbers = true)]
    rtol: Option<f64>,
}

#[derive(Args, Debug, Clone)]
struct RunArgs {
    #[command(flatten)]
    scene: SceneArgs,
    /// The result file [default: out/<scenario>.h5]; of `solve` also a table, FILE.csv
    #[arg(long)]
    out: Option<PathBuf>,
    #[command(flatten)]
    numerics: NumericsArgs,
    /// Seed of random choices: which trajectories and states the error is estimated from, and the
    /// fresh states by which a map is checked. Results do not depend on it, but for what a check
    /// asks to be mended.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Make no report (page and pictures) at the end of `run`.
    #[arg(long)]
    no_report: bool,
    /// Also take first guesses for the states that are solved for from V on a grid (up to 4 states,
    /// no games): slower.
    #[arg(long)]
    grid_guesses: bool,
}

#[derive(Args, Debug, Clone)]
struct SolveArgs {
    #[command(flatten)]
    run: RunArgs,
    /// The states: a CSV file whose header names states. States it does not name are at the
    /// equilibrium.
    #[arg(long, value_name = "FILE.csv")]
    points: PathBuf,
    /// Be content with one solution a state: faster, but where sheets overlap it may not be the
    /// optimal one.
    #[arg(long)]
    one_sheet: bool,
    /// Also write the optimal trajectory from each state, to /trajectories.
    #[arg(long)]
    trajectories: bool,
    /// Stored points a trajectory.
    #[arg(long, default_value_t = 200, value_parser = at_least_two)]
    samples: usize,
}

#[derive(Args, Debug, Clone)]
struct ValueArgs {
    /// The result file (.h5) of a run.
    file: PathBuf,
    /// A state; states not named are at the equilibrium. May be repeated.
    #[arg(long, value_name = "NAME=VALUE,...", allow_hyphen_values = true)]
    at: Vec<String>,
    /// States: a CSV file whose header names states.
    #[arg(long, value_name = "FILE.csv")]
    points: Option<PathBuf>,
    /// An axis of a grid; states not named are at the equilibrium. May be repeated.
    #[arg(long, value_name = "NAME=FIRST:LAST:COUNT", conflicts_with_all = ["at", "points"], allow_hyphen_values = true)]
    grid: Vec<String>,
    /// Write a table (.csv) or a result file (.h5) instead of printing.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Leave out the error estimates, which take most of the time.
    #[arg(long)]
    no_errors: bool,
    /// Where a map in pieces is asked: the CPU, any GPU adapter, or a hardware GPU if there is one
    /// (auto). The GPU tells the lowest sheet of each state.
    #[arg(long, value_enum, default_value_t = BackendChoice::Cpu)]
    backend: BackendChoice,
    /// Use the adapter whose name contains this.
    #[arg(long, value_name = "NAME")]
    adapter: Option<String>,
    /// Arithmetic on the GPU [default: f64 where the adapter has it]
    #[arg(long, value_enum)]
    precision: Option<PrecisionChoice>,
    /// Machine-readable values on standard output.
    #[arg(long)]
    json: bool,
    /// Print nothing but errors and what was asked for as a table.
    #[arg(long)]
    quiet: bool,
}

#[derive(Args, Debug, Clone)]
struct EvaluateArgs {
    /// A result file, or a scenario (.toml) for laws that need none.
    file: PathBuf,
    /// Take the scene, with its [closed_loop], from here; states and controls must be those of the
    /// result file.
    #[arg(long, value_name = "SCENE.toml")]
    scene: Option<PathBuf>,
    /// Replace a parameter. May be repeated. Not for a result file's own scene.
    #[arg(long = "set", value_name = "NAME=VALUE", value_parser = assignment)]
    set: Vec<(String, String)>,
    /// Only these laws [default: those of the scene]
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    laws: Vec<String>,
    /// Also the law of this weights file. May be repeated.
    #[arg(long, value_name = "FILE.toml")]
    weights: Vec<PathBuf>,
    /// So many initial states at random in the ranges of the scene's grid.
    #[arg(long, value_name = "N", value_parser = trajectories)]
    random: Option<usize>,
    /// Solve for V at the initial states, instead of taking it from the result file.
    #[arg(long)]
    solve: bool,
    /// Write here [default: into the result file; out/<scenario>_closed_loop.h5 for a scenario]
    #[arg(long)]
    out: Option<PathBuf>,
    #[command(flatten)]
    numerics: NumericsArgs,
    /// Seed of random initial states.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Machine-readable summary on standard output; everything else goes to standard error.
    #[arg(long)]
    json: bool,
    /// Print nothing but errors.
    #[arg(long)]
    quiet: bool,
}

#[derive(Args, Debug, Clone)]
struct BenchArgs {
    #[command(flatten)]
    scene: SceneArgs,
    /// The result file; a picture is written beside it [default: out/<scenario>_bench.h5]
    #[arg(long)]
    out: Option<PathBuf>,
    /// What to measure: the CPU and every GPU adapter (all; software adapters only where there is
    /// no hardware), every adapter (gpu), the CPU, or what `run` would take (auto). May be
    /// repeated.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "all")]
    backend: Vec<BenchBackend>,
    /// Of the GPU adapters only the one whose name contains this.
    #[arg(long, value_name = "NAME")]
    adapter: Option<String>,
    /// Only this arithmetic.
    #[arg(long, value_enum, default_value_t = PrecisionChoice::Auto, hide_default_value = true)]
    precision: PrecisionChoice,
    /// Only this method. May be repeated.
    #[arg(long, value_delimiter = ',', value_parser = method)]
    method: Vec<Method>,
    /// Only this relative tolerance. May be repeated [default: 1e-3, 1e-4, ... 1e-12].
    #[arg(long, value_delimiter = ',', value_parser = tolerance, allow_negative_numbers = true)]
    rtol: Vec<f64>,
    /// Trajectories.
    #[arg(long, default_value_t = 4096, value_parser = trajectories)]
    trajectories: usize,
    /// Shifts the seeds along the surface on which they are spread.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Timed passes of each variant.
    #[arg(long, default_value_t = 7, value_parser = clap::value_parser!(u32).range(1..=1000))]
    repeats: u32,
    /// Seconds for all passes, references not included. What does not fit is named; every variant
    /// that is measured has at least one timed pass.
    #[arg(long, default_value_t = 60.0, value_parser = seconds, allow_negative_numbers = true)]
    budget: f64,
    /// Recommend a setting for this error too. May be repeated.
    #[arg(long, value_delimiter = ',', value_parser = tolerance, allow_negative_numbers = true)]
    error: Vec<f64>,
    /// Keep only the ends of trajectories, instead of the points at all levels as a sweep does.
    #[arg(long)]
    ends: bool,
    /// Also time whole sweeps of about so many trajectories, file included: how much of it is not
    /// the kernel's [default: 1000,100000].
    #[arg(long, value_name = "TRAJECTORIES", num_args = 0..=1, value_delimiter = ',', require_equals = true,
          default_missing_value = "1000,100000", value_parser = trajectories)]
    host_share: Vec<usize>,
}

#[derive(Args, Debug, Clone)]
struct FitArgs {
    /// The result file; the laws are written into it, as /feedback.
    file: PathBuf,
    /// Take [feedback] from this scenario, which has the same states and controls.
    #[arg(long, value_name = "SCENE.toml")]
    scene: Option<PathBuf>,
    /// Where the laws' files are written (weights, C header, ONNX) [default: beside the result
    /// file]
    #[arg(long, value_name = "DIR")]
    out_dir: Option<PathBuf>,
    /// Seed of the sets and the first weights [default: the scenario's]
    #[arg(long)]
    seed: Option<u64>,
    /// Trainings from different first weights [default: the scenario's]
    #[arg(long, value_parser = at_least_one)]
    starts: Option<usize>,
    /// Machine-readable summary on standard output; everything else goes to standard error.
    #[arg(long)]
    json: bool,
    /// Print nothing but errors.
    #[arg(long)]
    quiet: bool,
}

#[derive(Args, Debug, Clone)]
struct ExportArgs {
    /// A result file with a map in pieces ([map] with error); with --local also a scene (.toml);
    /// with --law one with fitted laws.
    file: PathBuf,
    /// The Taylor series about the equilibrium instead of the map.
    #[arg(long)]
    local: bool,
    /// A law that `costate fit` put into the result file instead of the map: the header that it
    /// wrote, for the file's own scene. NAME may be left out where there is one law.
    #[arg(long, value_name = "NAME", num_args = 0..=1, require_equals = true, conflicts_with = "local")]
    law: Option<Option<String>>,
    /// Of --local: degree of u in the states; V is of one degree more.
    #[arg(long, value_name = "N", default_value_t = 3, requires = "local", conflicts_with = "law",
          value_parser = law_degree)]
    degree: usize,
    /// What the names in the header begin with, an identifier of C [default: map; with --local:
    /// local; with --law: the law's name]
    #[arg(long, value_parser = identifier)]
    name: Option<String>,
    /// The header [default: beside the file, with the name: STEM_NAME.h; of a scene:
    /// out/STEM_NAME.h]
    #[arg(long, value_name = "FILE.h")]
    out: Option<PathBuf>,
    /// Replace a parameter. May be repeated. Not for a result file's own scene.
    #[arg(long = "set", value_name = "NAME=VALUE", value_parser = assignment)]
    set: Vec<(String, String)>,
    /// Machine-readable summary on standard output; everything else goes to standard error.
    #[arg(long)]
    json: bool,
    /// Print nothing but errors.
    #[arg(long)]
    quiet: bool,
}

#[derive(Args, Debug, Clone)]
struct ReportArgs {
    /// The result file (HDF5).
    file: PathBuf,
    /// The page; pictures go into a folder of its name without `.html` [default:
    /// <FILE>_report.html]
    #[arg(long, value_name = "PAGE.html")]
    out: Option<PathBuf>,
    /// States that pictures of a plane hold fixed; others are at the equilibrium. A value may be an
    /// expression.
    #[arg(long, value_name = "NAME=VALUE,...", value_delimiter = ',', value_parser = assignment)]
    slice: Vec<(String, String)>,
    /// The two states of the plane [default: the first two that --slice does not name]
    #[arg(long, value_name = "NAME,NAME", value_delimiter = ',')]
    axes: Vec<String>,
    /// Levels of the contours of V: numbers or expressions, such as `exp(-4),exp(-3)`.
    #[arg(
        long,
        value_name = "V,...",
        value_delimiter = ',',
        allow_hyphen_values = true
    )]
    levels: Vec<String>,
    /// Width of the pictures in pixels; text keeps its size [default: 900]
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(320..=4000))]
    width: Option<u32>,
    /// Machine-readable summary on standard output.
    #[arg(long)]
    json: bool,
    /// Print nothing but errors.
    #[arg(long)]
    quiet: bool,
}

#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
enum BenchBackend {
    All,
    Auto,
    Gpu,
    Cpu,
}

#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
enum BackendChoice {
    Auto,
    Gpu,
    Cpu,
}

#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
enum PrecisionChoice {
    Auto,
    F32,
    F64,
}

impl NumericsArgs {
    /// The backend asked for, fit for the method that is asked for here or by the scene.
    fn open(&self, model: &Model) -> Result<Box<dyn Backend>, CliError> {
        let method = self.method.or(model.integrator.method);
        run::open_backend(self.backend, self.adapter.as_deref(), method)
    }

    fn choices(&self, seed: u64) -> Choices {
        Choices {
            precision: self.precision.and_then(PrecisionChoice::precision),
            method: self.method,
            rtol: self.rtol,
            seed,
            ..Choices::default()
        }
    }
}

impl PrecisionChoice {
    /// `Some(None)` is auto, asked for.
    fn precision(self) -> Option<Precision> {
        match self {
            PrecisionChoice::Auto => None,
            PrecisionChoice::F32 => Some(Precision::F32),
            PrecisionChoice::F64 => Some(Precision::F64),
        }
    }
}

fn assignment(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((name, value)) if !name.trim().is_empty() && !value.trim().is_empty() => {
            Ok((name.trim().to_owned(), value.trim().to_owned()))
        }
        _ => Err("expected NAME=VALUE".to_owned()),
    }
}

fn identifier(text: &str) -> Result<String, String> {
    let word = text.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
    if word && text.starts_with(|c: char| c.is_ascii_alphabetic()) {
        Ok(text.to_owned())
    } else {
        Err("letters, digits and underscores, a letter first".to_owned())
    }
}

fn law_degree(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(degree) if (1..=6).contains(&degree) => Ok(degree),
        _ => Err("a whole number from 1 to 6".to_owned()),
    }
}

fn at_least_one(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(count) if (1..=1000).contains(&count) => Ok(count),
        _ => Err("a whole number from 1 to 1000".to_owned()),
    }
}

fn at_least_two(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(count) if (2..=1_000_000).contains(&count) => Ok(count),
        _ => Err("a whole number from 2 to 1000000".to_owned()),
    }
}

fn method(text: &str) -> Result<Method, String> {
    let names: Vec<&str> = Method::ALL.iter().map(|(n, _)| *n).collect();
    let found = Method::ALL.iter().find(|(n, _)| *n == text);
    found
        .map(|(_, m)| *m)
        .ok_or_else(|| format!("the methods are {}", names.join(", ")))
}

fn trajectories(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(count) if (1..=10_000_000).contains(&count) => Ok(count),
        _ => Err("a whole number from 1 to 10000000".to_owned()),
    }
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(time) if time > 0.0 && time <= 1e6 => Ok(time),
        _ => Err("seconds, above 0 and at most 1e6".to_owned()),
    }
}

fn tolerance(text: &str) -> Result<f64, String> {
    let value: f64 = text
        .parse()
        .map_err(|_| format!("`{text}` is not a number"))?;
    if value > 0.0 && value <= 0.1 {
        Ok(value)
    } else {
        Err("a relative tolerance is above 0 and at most 0.1".to_owned())
    }
}

/// Why a command stopped.
#[derive(Debug, thiserror::Error)]
enum CliError {
    #[error(transparent)]
    Load(#[from] LoadError),
    #[error(transparent)]
    Scenario(#[from] ScenarioErrors),
    #[error(transparent)]
    Plan(#[from] costate::sweep::PlanError),
    #[error(transparent)]
    Backend(#[from] BackendError),
    #[error(transparent)]
    Output(#[from] OutputError),
    #[error(transparent)]
    File(#[from] FileError),
    #[error(
        "nothing was swept: all {outside} seeds lie outside the guards (is the equilibrium too near their boundary for this seed_value?)"
    )]
    NothingSwept { outside: usize },
    #[error(transparent)]
    Points(#[from] points::PointsError),
    #[error(
        "the scenario has neither [homotopy] nor [map]: no states to solve for (or use `costate solve --points FILE.csv`)"
    )]
    NoTargets,
    #[error(
        "a state named `{name}` cannot be an axis of [map], which has a variable of that name: rename the state, or remove [map]"
    )]
    MapName { name: String },
    #[error(transparent)]
    Device(#[from] DeviceError),
    #[error(transparent)]
    Study(#[from] costate::study::StudyError),
    #[error(transparent)]
    Attenuation(#[from] costate::attenuation::SmallestError),
    #[error("the scenario has no [attenuation]")]
    NoAttenuation,
    #[error("the scenario has no [study]")]
    NoStudy,
    #[error(transparent)]
    Place(#[from] value::PlaceError),
    #[error(transparent)]
    Map(#[from] costate::result::StoredMapError),
    #[error(transparent)]
    Bench(#[from] BenchError),
    #[error("--out {path}: the picture takes this name with .svg; name the table .h5", path = path.display())]
    PictureName { path: PathBuf },
    #[error(transparent)]
    Report(#[from] costate_report::ReportError),
    #[error(transparent)]
    ReportOption(#[from] report_page::OptionError),
    #[error(transparent)]
    Stored(#[from] StoredError),
    #[error(transparent)]
    Law(LawError),
    #[error(transparent)]
    Loop(LoopError),
    #[error(
        "the scenario has neither [closed_loop] nor [dissipation]: nothing to simulate (--scene takes it from another scenario)"
    )]
    NoClosedLoop,
    #[error("no law to simulate: none of those that the scenario asks for is there")]
    NoLaws,
    #[error("the states and controls of {scene} are not those of {file}", scene = scene.display(), file = file.display())]
    OtherScene { scene: PathBuf, file: PathBuf },
    #[error("--out {path}: {reason}", path = path.display())]
    BadOut { path: PathBuf, reason: String },
    #[error("law `{name}` would be written to {path}, which is the scene: give another --out", path = path.display())]
    OverScene { name: String, path: PathBuf },
    #[error("--weights: a law named `{name}` is there already: rename the file", name = name)]
    SameLaw { name: String },
    #[error(
        "--set does not change a result file's own scene: give the scene too (--scene SCENE.toml --set ...)"
    )]
    SetOfResult,
    #[error(
        "--adapter {name}: the CPU is asked for, which has no adapters: leave this out, or give --backend gpu"
    )]
    AdapterOfCpu { name: String },
    #[error(transparent)]
    Fit(#[from] fit::FitCommandError),
    #[error(transparent)]
    Export(#[from] export::ExportError),
    #[error(transparent)]
    Feedback(#[from] costate::feedback::FitError),
    #[error("cannot create the directory {path}: {source}", path = path.display())]
    OutDir {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error(transparent)]
    Refused(#[from] grid::GridRefusal),
    #[error(transparent)]
    Grid(costate::dynamic_programming::DpError),
    #[error("V in the file is not the least at {states} states")]
    NotLeast {
        states: usize,
        /// Whether it has been said.
        silent: bool,
    },
    #[error("the sweep's thread stopped unexpectedly")]
    Thread,
    #[error("cannot write to standard output: {0}")]
    Stdout(#[from] std::io::Error),
}

impl From<LawError> for CliError {
    fn from(error: LawError) -> Self {
        match error {
            LawError::Scenario(errors) => CliError::Scenario(errors),
            other => CliError::Law(other),
        }
    }
}

impl From<LoopError> for CliError {
    fn from(error: LoopError) -> Self {
        match error {
            LoopError::Law(error) => error.into(),
            LoopError::Plan(error) => error.into(),
            LoopError::Backend(error) => error.into(),
            other => CliError::Loop(other),
        }
    }
}

impl CliError {
    /// 2 for what the user wrote, 1 for what could not be done.
    fn status(&self) -> u8 {
        match self {
            CliError::Load(_) | CliError::Scenario(_) | CliError::Plan(_) => 2,
            CliError::Study(StudyError::Scene { .. } | StudyError::Plan { .. })
            | CliError::NoStudy => 2,
            CliError::Attenuation(SmallestError::Backend(_)) => 1,
            CliError::Attenuation(_) | CliError::NoAttenuation => 2,
            CliError::Place(_) | CliError::Map(_) => 2,
            CliError::Device(DeviceError::Backend(_)) => 1,
            CliError::Device(_) => 2,
            CliError::Law(_)
            | CliError::NoClosedLoop
            | CliError::NoLaws
            | CliError::OtherScene { .. }
            | CliError::SetOfResult
            | CliError::AdapterOfCpu { .. } => 2,
            CliError::File(error) | CliError::Output(OutputError::File(error))
                if error.is_of_name() =>
            {
                2
            }
            CliError::BadOut { .. } | CliError::OverScene { .. } | CliError::SameLaw { .. } => 2,
            CliError::Loop(
                LoopError::NoRange | LoopError::NoCount { .. } | LoopError::NoChart { .. },
            ) => 2,
            CliError::Points(_)
            | CliError::NoTargets
            | CliError::MapName { .. }
            | CliError::PictureName { .. } => 2,
            CliError::Stored(_)
            | CliError::Fit(_)
            | CliError::Feedback(_)
            | CliError::Export(_) => 2,
            CliError::ReportOption(_) => 2,
            CliError::Refused(grid::GridRefusal::OutOfTime(_)) => 1,
            CliError::Refused(_) | CliError::Grid(_) => 2,
            CliError::Report(
                costate_report::ReportError::Options(_) | costate_report::ReportError::Stored(_),
            ) => 2,
            _ => 1,
        }
    }

    fn print(&self) {
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

/// What a command writes to `--out`.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Result,
    Table,
    Header,
    Page,
}

impl Kind {
    /// Its endings, the usual one first.
    fn endings(self) -> &'static [&'static str] {
        match self {
            Kind::Result => &["h5", "hdf5", "he5", "nc", "nc4"],
            Kind::Table => &["csv"],
            Kind::Header => &["h"],
            Kind::Page => &["html", "htm"],
        }
    }

    fn name(self) -> &'static str {
        match self {
            Kind::Result => "a result file is HDF5",
            Kind::Table => "a table is CSV",
            Kind::Header => "it is a C header",
            Kind::Page => "it is a page of HTML",
        }
    }
}

/// Refuses to write over what is read and what is no file, and one kind of file under the name of
/// another.
fn check_out(out: Option<&Path>, kinds: &[Kind], inputs: &[&Path]) -> Result<(), CliError> {
    let Some(out) = out else { return Ok(()) };
    let bad = |reason| CliError::BadOut {
        path: out.to_owned(),
        reason,
    };
    target(out)?;
    let same = |a: &Path| {
        std::fs::canonicalize(a).is_ok_and(|a| std::fs::canonicalize(out).is_ok_and(|b| a == b))
    };
    if inputs.iter().any(|i| same(i)) {
        return Err(bad("this file is read".to_owned()));
    }
    let end = out
        .extension()
        .map(|e| e.to_string_lossy().to_lowercase())
        .unwrap_or_default();
    let unnamed = end.is_empty() && kinds == [Kind::Result];
    if unnamed
        || kinds
            .iter()
            .any(|kind| kind.endings().contains(&end.as_str()))
    {
        return Ok(());
    }
    let all: Vec<String> = (kinds.iter())
        .map(|kind| format!("{}; name it .{}", kind.name(), kind.endings()[0]))
        .collect();
    Err(bad(all.join("; or ")))
}

/// Rows of a table as CSV.
fn csv_text(rows: &[Vec<String>]) -> Result<String, CliError> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    let csv = |e: csv::Error| CliError::Stdout(std::io::Error::other(e));
    for row in rows {
        writer.write_record(row).map_err(csv)?;
    }
    let bytes = writer
        .into_inner()
        .map_err(|e| CliError::Stdout(std::io::Error::other(e.to_string())))?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

/// Writes to standard output as it is.
fn print(text: &str) -> Result<(), CliError> {
    std::io::stdout().lock().write_all(text.as_bytes())?;
    Ok(())
}

/// The record of a run of this program.
fn begun(model: &Model, started: SystemTime) -> RunRecord {
    RunRecord {
        git_revision: env!("COSTATE_GIT_REVISION").to_owned(),
        ..RunRecord::begun(model, started)
    }
}

fn main() -> ExitCode {
    if cfg!(unix) && std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // The Vulkan loader complains on standard error where this is unset, though nothing here
        // needs it. SAFETY: no other thread has been started yet.
        unsafe { std::env::set_var("XDG_RUNTIME_DIR", std::env::temp_dir()) };
    }
    // Without it a signal leaves a hidden file beside the result's name, and no more is lost.
    #[cfg(unix)]
    let _ = costate::files::removed_at_signals();
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(e) => {
            let _ = e.print();
            return ExitCode::from(if e.use_stderr() { 2 } else { 0 });
        }
    };
    let done = match cli.command {
        Command::Run(args) => run::run(&args, run::Parts::All),
        Command::ShootOut(args) => run::run(&args, run::Parts::ShootOut),
        Command::Homotopy(args) => run::run(&args, run::Parts::Homotopy),
        Command::Solve(args) => run::run(&args.run, run::Parts::Solve(&args)),
        Command::CheckLeast(args) => check_least::check_least(&args),
        Command::Study(args) => study::study(&args),
        Command::Attenuation(args) => attenuation::attenuation(&args),
        Command::Value(args) => value::value(&args),
        Command::Evaluate(args) => evaluate::evaluate(&args),
        Command::Bench(args) => bench::bench(&args),
        Command::Fit(args) => fit::command(&args),
        Command::Export(args) => export::export(&args),
        Command::Report(args) => report_page::report(&args),
        Command::Check(args) => check::check(&args),
        Command::Adapters { json } => check::adapters(json),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        // The reader of a pipe has gone: it has what it wanted.
        Err(CliError::Stdout(e)) if e.kind() == std::io::ErrorKind::BrokenPipe => ExitCode::SUCCESS,
        Err(e) => {
            e.print();
            ExitCode::from(e.status())
        }
    }
}
