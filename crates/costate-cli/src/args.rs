//! The arguments of each command.

use clap::{Args, Parser, Subcommand, ValueEnum};
use costate::low_level::model::{Method, Precision};
use costate::low_level::sweep::Choices;
use costate::session::{Shard, ShardError};
use std::path::PathBuf;

/// Value functions and optimal feedback of nonlinear systems over a region, by bicharacteristics.
#[derive(Parser, Debug)]
#[command(name = "costate", version, about, arg_required_else_help = true)]
pub struct Cli {
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Subcommand, Debug)]
pub enum Command {
    /// Do everything that the scene asks for and write the result file.
    Run(RunArgs),
    /// Only the sweep outward from the equilibrium (or from the terminal cost).
    ShootOut(DividedArgs),
    /// Only V, p and u at the states of [homotopy] and [map], with every sheet found there.
    Homotopy(StatesArgs),
    /// Only [map]: V, p and u on its grid, or the map to an error.
    Map(StatesArgs),
    /// V, p and u at the states in a CSV file, in its order.
    Solve(SolveArgs),
    /// V, p and u at any state, interpolated from a result file, with an error estimate.
    Value(ValueArgs),
    /// Put the results of shards (--shard) together to the whole.
    Merge(MergeArgs),
    /// Ask a second method, V on a grid (dynamic programming), whether V at the solved states of a
    /// result file is the least.
    CheckLeast(CheckLeastArgs),
    /// Only [study]: the optimal trajectory from one state for several values of parameters.
    Study(DividedArgs),
    /// Only [attenuation]: the smallest level of attenuation, of the linearization and of a region,
    /// with pictures.
    Attenuation(DividedArgs),
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
    #[cfg(feature = "report")]
    Report(ReportArgs),
    /// Validate a scene and print the derived equations and the local solution.
    Check(CheckArgs),
    /// The mechanism of a scene at chosen states: mass matrix, forces, accelerations and their
    /// derivatives, energies, points, contacts.
    Mechanism(MechanismArgs),
    /// Simulate forward in time with the scene's [events]: where they come, the states after them,
    /// and orbits that come back to themselves.
    Simulate(SimulateArgs),
    /// A scene from a robot in URDF: its joints and bodies as [mechanism], limits as guards and bounds.
    #[cfg(feature = "urdf")]
    Import(ImportArgs),
    /// Print the reference of scenes, or of the result file, in Markdown.
    Reference {
        /// What of.
        #[arg(value_enum)]
        what: Reference,
    },
    /// List the GPU adapters found and what each can do.
    Adapters {
        /// Machine-readable list on standard output.
        #[arg(long)]
        json: bool,
    },
}

/// What `costate reference` prints.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Reference {
    /// All sections and keys of a scene.
    Scene,
    /// All groups and variables of the result file.
    File,
}

/// Options of every command that reads a scene.
#[derive(Args, Debug, Clone)]
pub struct SceneArgs {
    /// The scene file (TOML).
    #[arg(value_name = "SCENE")]
    pub scenario: PathBuf,
    /// Replace a parameter: a number or an expression of earlier parameters. May be repeated.
    #[arg(long = "set", value_name = "NAME=VALUE", value_parser = assignment)]
    pub set: Vec<(String, String)>,
    #[command(flatten)]
    pub print: PrintArgs,
}

/// What is printed, and where.
#[derive(Args, Debug, Clone, Copy)]
pub struct PrintArgs {
    /// Machine-readable summary on standard output; everything else goes to standard error.
    #[arg(long)]
    pub json: bool,
    /// Print nothing but errors.
    #[arg(long)]
    pub quiet: bool,
}

#[derive(Args, Debug, Clone)]
pub struct CheckArgs {
    #[command(flatten)]
    pub scene: SceneArgs,
}

#[derive(Args, Debug, Clone)]
pub struct MechanismArgs {
    #[command(flatten)]
    pub scene: SceneArgs,
    /// CSV file of states, controls and disturbances (header: their names; what is missing takes the
    /// equilibrium's value) [default: the equilibrium, or the middle of the region]
    #[arg(long, value_name = "FILE")]
    pub points: Option<PathBuf>,
}

#[cfg(feature = "urdf")]
#[derive(Args, Debug, Clone)]
pub struct ImportArgs {
    /// The robot (URDF).
    #[arg(value_name = "ROBOT.urdf")]
    pub file: PathBuf,
    /// The scene [default: the robot's file with .toml, here; it must not be there yet]
    #[arg(long, value_name = "SCENE.toml")]
    pub out: Option<PathBuf>,
    #[command(flatten)]
    pub print: PrintArgs,
}

#[derive(Args, Debug, Clone)]
pub struct SimulateArgs {
    #[command(flatten)]
    pub scene: SceneArgs,
    /// A state to begin with; states not named are at the equilibrium, or in the middle of the
    /// region. May be repeated [default: [simulation] initial]
    #[arg(long, value_name = "NAME=VALUE,...", allow_hyphen_values = true)]
    pub at: Vec<String>,
    /// States to begin with: a CSV file whose header names states.
    #[arg(long, value_name = "FILE.csv")]
    pub points: Option<PathBuf>,
    /// How long a flight lasts [default: the scene's]
    #[arg(long, value_parser = duration, allow_negative_numbers = true)]
    pub time: Option<f64>,
    /// End with so many events [default: the scene's, or 1000]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub events: Option<u32>,
    /// Stored points of each phase, from event to event, after its first; 0 stores none [default:
    /// the scene's, or 50]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=100_000))]
    pub samples: Option<u32>,
    /// What controls: `lqr`, or a law in [closed_loop.law] [default: the scene's; else controls
    /// stay as they are at the equilibrium, or 0]
    #[arg(long, value_name = "NAME")]
    pub law: Option<String>,
    /// Let the law of this weights file control.
    #[arg(long, value_name = "FILE.toml", conflicts_with = "law")]
    pub weights: Option<PathBuf>,
    /// Look for the orbit that comes back to itself after so many events, near each state, and for
    /// its multipliers; flights begin there then. 0: for none [default: the scene's]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=1000))]
    pub cycle: Option<u32>,
    /// The result file [default: out/<scene>_simulation.h5]
    #[arg(long)]
    pub out: Option<PathBuf>,
    #[command(flatten)]
    pub numerics: NumericsArgs,
}

/// Where and how exactly to integrate.
#[derive(Args, Debug, Clone)]
pub struct NumericsArgs {
    /// Where to compute: a hardware GPU if there is one and else the CPU (auto), any GPU adapter,
    /// or the CPU.
    #[arg(long, value_enum, default_value_t = BackendChoice::Auto)]
    pub backend: BackendChoice,
    /// Use the adapter whose name contains this, or of this number (from 0) in the list of `costate
    /// adapters`; `all`: of solve, homotopy, map and study, each adapter does a shard of the work.
    #[arg(long, value_name = "NAME")]
    pub adapter: Option<String>,
    /// Arithmetic of the integration [default: the scene's]
    #[arg(long, value_enum)]
    pub precision: Option<PrecisionChoice>,
    /// Integration method: rk4, tsit5, dop853, taylor [default: the scene's]
    #[arg(long, value_parser = method)]
    pub method: Option<Method>,
    /// Relative tolerance [default: the scene's]
    #[arg(long, value_parser = tolerance, allow_negative_numbers = true)]
    pub rtol: Option<f64>,
}

#[derive(Args, Debug, Clone)]
pub struct RunArgs {
    #[command(flatten)]
    pub scene: SceneArgs,
    /// The result file [default: out/<scene>.h5]; of `solve` also a table, FILE.csv
    #[arg(long)]
    pub out: Option<PathBuf>,
    #[command(flatten)]
    pub numerics: NumericsArgs,
    /// Seed of random choices: which trajectories and states the error is estimated from, and the
    /// fresh states by which a map is checked. Results do not depend on it, but for what a check
    /// asks to be mended.
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// End after so many seconds with what is done by then, and exit status 75. (An interrupt does
    /// the same; a second one ends at once, with nothing.)
    #[arg(long, value_name = "SECONDS", value_parser = seconds, allow_negative_numbers = true)]
    pub time_limit: Option<f64>,
    /// Do not store the trajectories of `[shoot_out]`: only what is told of them. (Fewer points a
    /// trajectory are `[shoot_out] samples`.)
    #[arg(long)]
    pub no_trajectories: bool,
    /// Of the trajectories of `[shoot_out]` store x and V alone, in f32 where that resolves them
    /// (and how each ended, and its sheet): a fifth of the size. No law can be fitted to them, and no
    /// V is interpolated between them.
    #[arg(long, conflicts_with = "no_trajectories")]
    pub values_only: bool,
    /// Make no report (page and pictures) at the end of `run`.
    #[arg(long)]
    pub no_report: bool,
    /// Also take first guesses for the states that are solved for from V on a grid (up to 4 states,
    /// no games): slower.
    #[arg(long)]
    pub grid_guesses: bool,
}

/// Which part of the work to do.
#[derive(Args, Debug, Clone, Copy)]
pub struct ShardArgs {
    /// Only this part of the work: shard M (from 0) of N; `none`: all of it. `costate merge` puts the
    /// parts together [default: in a Slurm job array this task's, by SLURM_ARRAY_TASK_ID, _COUNT
    /// and _MIN; else all]
    #[arg(long, value_name = "M/N", value_parser = shard)]
    pub shard: Option<ShardChoice>,
    /// Go on with what an earlier run of the same command has left that was ended before it was
    /// done: what it had solved for is not done again.
    #[arg(long)]
    pub resume: bool,
    /// What is done is kept after so many seconds, and again each time that so many have passed: a
    /// run that is killed loses no more.
    #[arg(long, value_name = "SECONDS", default_value_t = 60, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub checkpoint: u32,
    /// End as standard input tells: how `--adapter all` ends the processes that it starts.
    #[arg(long, hide = true)]
    pub heed_input: bool,
}

/// A part of the work, or all of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ShardChoice {
    All,
    One(Shard),
}

fn shard(text: &str) -> Result<ShardChoice, ShardError> {
    match text {
        "none" => Ok(ShardChoice::All),
        text => text.parse().map(ShardChoice::One),
    }
}

/// A run that can be divided.
#[derive(Args, Debug, Clone)]
pub struct DividedArgs {
    #[command(flatten)]
    pub run: RunArgs,
    #[command(flatten)]
    pub part: ShardArgs,
}

/// States of a scene.
#[derive(Args, Debug, Clone)]
pub struct StatesArgs {
    #[command(flatten)]
    pub run: RunArgs,
    #[command(flatten)]
    pub part: ShardArgs,
    #[command(flatten)]
    pub archive: ArchiveArgs,
}

/// Where first guesses come from.
#[derive(Args, Debug, Clone)]
pub struct ArchiveArgs {
    /// Take first guesses from the trajectories of this result file, where states need a sweep for
    /// them (games; finite horizons of four and more states): the result of `costate shoot-out` of
    /// the same scene. Without it each run, and each shard, makes a sweep of its own.
    #[arg(long, value_name = "FILE.h5")]
    pub archive: Option<PathBuf>,
}

#[derive(Args, Debug, Clone)]
pub struct MergeArgs {
    /// The results of the shards.
    #[arg(value_name = "PART.h5", required = true)]
    pub parts: Vec<PathBuf>,
    /// The whole.
    #[arg(long, value_name = "FILE.h5")]
    pub out: PathBuf,
    /// Put together what there is; states of shards that are missing have the status `not_merged`.
    #[arg(long)]
    pub partial: bool,
    /// Leave the numbers of states in the parts, from which they are then read (virtual datasets of
    /// HDF5): the parts must stay where they are. States come in the order of the parts.
    #[arg(long = "virtual")]
    pub stay: bool,
    #[command(flatten)]
    pub print: PrintArgs,
}

#[derive(Args, Debug, Clone)]
pub struct SolveArgs {
    #[command(flatten)]
    pub run: RunArgs,
    #[command(flatten)]
    pub part: ShardArgs,
    #[command(flatten)]
    pub archive: ArchiveArgs,
    /// The states: a CSV file whose header names states. States it does not name are at the
    /// equilibrium.
    #[arg(long, value_name = "FILE.csv")]
    pub points: PathBuf,
    /// Be content with one solution a state: faster, but where sheets overlap it may not be the
    /// optimal one.
    #[arg(long)]
    pub one_sheet: bool,
    /// Also write the optimal trajectory from each state, to /trajectories.
    #[arg(long)]
    pub trajectories: bool,
    /// Stored points a trajectory.
    #[arg(long, default_value_t = 200, value_parser = at_least_two)]
    pub samples: usize,
}

#[derive(Args, Debug, Clone)]
pub struct ValueArgs {
    /// The result file (.h5) of a run.
    pub file: PathBuf,
    /// A state; states not named are at the equilibrium. May be repeated.
    #[arg(long, value_name = "NAME=VALUE,...", allow_hyphen_values = true)]
    pub at: Vec<String>,
    /// States: a CSV file whose header names states.
    #[arg(long, value_name = "FILE.csv")]
    pub points: Option<PathBuf>,
    /// An axis of a grid; states not named are at the equilibrium. May be repeated.
    #[arg(long, value_name = "NAME=FIRST:LAST:COUNT", conflicts_with_all = ["at", "points"], allow_hyphen_values = true)]
    pub grid: Vec<String>,
    /// Write a table (.csv) or a result file (.h5) instead of printing.
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Leave out the error estimates, which take most of the time.
    #[arg(long)]
    pub no_errors: bool,
    /// Where a map in pieces is asked: the CPU, any GPU adapter, or a hardware GPU if there is one
    /// (auto). The GPU tells the lowest sheet of each state.
    #[arg(long, value_enum, default_value_t = BackendChoice::Cpu)]
    pub backend: BackendChoice,
    /// Use the adapter whose name contains this, or of this number (from 0) in the list of `costate
    /// adapters`.
    #[arg(long, value_name = "NAME")]
    pub adapter: Option<String>,
    /// Arithmetic on the GPU [default: f64 where the adapter has it]
    #[arg(long, value_enum)]
    pub precision: Option<PrecisionChoice>,
    /// Machine-readable values on standard output.
    #[arg(long)]
    pub json: bool,
    /// Print nothing but errors and what was asked for as a table.
    #[arg(long)]
    pub quiet: bool,
}

#[derive(Args, Debug, Clone)]
pub struct EvaluateArgs {
    /// A result file, or a scene (.toml) for laws that need none.
    pub file: PathBuf,
    /// Take the scene, with its [closed_loop], from here; states and controls must be those of the
    /// result file.
    #[arg(long, value_name = "SCENE.toml")]
    pub scene: Option<PathBuf>,
    /// Replace a parameter. May be repeated. Not for a result file's own scene.
    #[arg(long = "set", value_name = "NAME=VALUE", value_parser = assignment)]
    pub set: Vec<(String, String)>,
    /// Only these laws [default: those of the scene]
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    pub laws: Vec<String>,
    /// Also the law of this weights file. May be repeated.
    #[arg(long, value_name = "FILE.toml")]
    pub weights: Vec<PathBuf>,
    /// So many initial states at random in the ranges of the scene's grid.
    #[arg(long, value_name = "N", value_parser = trajectories)]
    pub random: Option<usize>,
    /// Solve for V at the initial states, instead of taking it from the result file.
    #[arg(long)]
    pub solve: bool,
    /// Write here [default: into the result file; out/<scene>_closed_loop.h5 for a scene]
    #[arg(long)]
    pub out: Option<PathBuf>,
    #[command(flatten)]
    pub numerics: NumericsArgs,
    /// Seed of random initial states.
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// With --shard or --resume: end after so many seconds with what is done by then, and exit
    /// status 75. (A signal does the same.)
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub time_limit: Option<f64>,
    #[command(flatten)]
    pub part: ShardArgs,
    #[command(flatten)]
    pub print: PrintArgs,
}

#[derive(Args, Debug, Clone)]
pub struct BenchArgs {
    #[command(flatten)]
    pub scene: SceneArgs,
    /// The result file; a picture is written beside it [default: out/<scene>_bench.h5]
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// What to measure: the CPU and every GPU adapter (all; software adapters only where there is
    /// no hardware), every adapter (gpu), the CPU, or what `run` would take (auto). May be
    /// repeated.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "all")]
    pub backend: Vec<BenchBackend>,
    /// Of the GPU adapters only the one whose name contains this.
    #[arg(long, value_name = "NAME")]
    pub adapter: Option<String>,
    /// Only this arithmetic.
    #[arg(long, value_enum, default_value_t = PrecisionChoice::Auto, hide_default_value = true)]
    pub precision: PrecisionChoice,
    /// Only this method. May be repeated.
    #[arg(long, value_delimiter = ',', value_parser = method)]
    pub method: Vec<Method>,
    /// Only this relative tolerance. May be repeated [default: 1e-3, 1e-4, ... 1e-12].
    #[arg(long, value_delimiter = ',', value_parser = tolerance, allow_negative_numbers = true)]
    pub rtol: Vec<f64>,
    /// Trajectories.
    #[arg(long, default_value_t = 4096, value_parser = trajectories)]
    pub trajectories: usize,
    /// Shifts the seeds along the surface on which they are spread.
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Timed passes of each variant.
    #[arg(long, default_value_t = 7, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub repeats: u32,
    /// Seconds for all passes, references not included. What does not fit is named; every variant
    /// that is measured has at least one timed pass.
    #[arg(long, default_value_t = 60.0, value_parser = seconds, allow_negative_numbers = true)]
    pub budget: f64,
    /// Recommend a setting for this error too. May be repeated.
    #[arg(long, value_delimiter = ',', value_parser = tolerance, allow_negative_numbers = true)]
    pub error: Vec<f64>,
    /// Keep only the ends of trajectories, instead of the points at all levels as a sweep does.
    #[arg(long)]
    pub ends: bool,
    /// Also time whole sweeps of about so many trajectories, file included: how much of it is not
    /// the kernel's [default: 1000,100000].
    #[arg(long, value_name = "TRAJECTORIES", num_args = 0..=1, value_delimiter = ',', require_equals = true,
          default_missing_value = "1000,100000", value_parser = trajectories)]
    pub host_share: Vec<usize>,
}

#[derive(Args, Debug, Clone)]
pub struct FitArgs {
    /// The result file; the laws are written into it, as /feedback.
    pub file: PathBuf,
    /// Take [feedback] from this scene, which has the same states and controls.
    #[arg(long, value_name = "SCENE.toml")]
    pub scene: Option<PathBuf>,
    /// Where the laws' files are written (weights, C header, ONNX) [default: beside the result
    /// file]
    #[arg(long, value_name = "DIR")]
    pub out_dir: Option<PathBuf>,
    /// Seed of the sets and the first weights [default: the scene's]
    #[arg(long)]
    pub seed: Option<u64>,
    /// Trainings from different first weights [default: the scene's]
    #[arg(long, value_parser = at_least_one)]
    pub starts: Option<usize>,
    /// End after so many seconds with the laws that are done by then, and exit status 75. Laws that
    /// the result file has already are kept unless all are done. (An interrupt does the same.)
    #[arg(long, value_name = "SECONDS", value_parser = seconds, allow_negative_numbers = true)]
    pub time_limit: Option<f64>,
    #[command(flatten)]
    pub print: PrintArgs,
}

#[derive(Args, Debug, Clone)]
pub struct ExportArgs {
    /// A result file with a map in pieces ([map] with error); with --local also a scene (.toml);
    /// with --law one with fitted laws.
    pub file: PathBuf,
    /// The Taylor series about the equilibrium instead of the map.
    #[arg(long)]
    pub local: bool,
    /// A law that `costate fit` put into the result file instead of the map: the header that it
    /// wrote, for the file's own scene. NAME may be left out where there is one law.
    #[arg(long, value_name = "NAME", num_args = 0..=1, require_equals = true, conflicts_with = "local")]
    pub law: Option<Option<String>>,
    /// Of --local: degree of u in the states; V is of one degree more.
    #[arg(long, value_name = "N", default_value_t = 3, requires = "local", conflicts_with = "law",
          value_parser = law_degree)]
    pub degree: usize,
    /// What the names in the header begin with, an identifier of C [default: map; with --local:
    /// local; with --law: the law's name]
    #[arg(long, value_parser = identifier)]
    pub name: Option<String>,
    /// The header [default: beside the file, with the name: STEM_NAME.h; of a scene:
    /// out/STEM_NAME.h]
    #[arg(long, value_name = "FILE.h")]
    pub out: Option<PathBuf>,
    /// Replace a parameter. May be repeated. Not for a result file's own scene.
    #[arg(long = "set", value_name = "NAME=VALUE", value_parser = assignment)]
    pub set: Vec<(String, String)>,
    #[command(flatten)]
    pub print: PrintArgs,
}

#[cfg(feature = "report")]
#[derive(Args, Debug, Clone)]
pub struct ReportArgs {
    /// The result file (HDF5).
    pub file: PathBuf,
    /// The page; pictures go into a folder of its name without `.html` [default:
    /// <FILE>_report.html]
    #[arg(long, value_name = "PAGE.html")]
    pub out: Option<PathBuf>,
    /// States that pictures of a plane hold fixed; others are at the equilibrium. A value may be an
    /// expression.
    #[arg(long, value_name = "NAME=VALUE,...", value_delimiter = ',', value_parser = assignment)]
    pub slice: Vec<(String, String)>,
    /// The two states of the plane [default: the first two that --slice does not name]
    #[arg(long, value_name = "NAME,NAME", value_delimiter = ',')]
    pub axes: Vec<String>,
    /// Levels of the contours of V: numbers or expressions, such as `exp(-4),exp(-3)`.
    #[arg(
        long,
        value_name = "V,...",
        value_delimiter = ',',
        allow_hyphen_values = true
    )]
    pub levels: Vec<String>,
    /// Width of the pictures in pixels; text keeps its size [default: 900]
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(320..=4000))]
    pub width: Option<u32>,
    /// Machine-readable summary on standard output.
    #[arg(long)]
    pub json: bool,
    /// Print nothing but errors.
    #[arg(long)]
    pub quiet: bool,
}

#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
pub enum BenchBackend {
    All,
    Auto,
    Gpu,
    Cpu,
}

#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
pub enum BackendChoice {
    Auto,
    Gpu,
    Cpu,
}

#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
pub enum PrecisionChoice {
    Auto,
    F32,
    F64,
}

impl NumericsArgs {
    pub fn choices(&self, seed: u64) -> Choices {
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
    pub fn precision(self) -> Option<Precision> {
        match self {
            PrecisionChoice::Auto => None,
            PrecisionChoice::F32 => Some(Precision::F32),
            PrecisionChoice::F64 => Some(Precision::F64),
        }
    }
}

pub fn assignment(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((name, value)) if !name.trim().is_empty() && !value.trim().is_empty() => {
            Ok((name.trim().to_owned(), value.trim().to_owned()))
        }
        _ => Err("expected NAME=VALUE".to_owned()),
    }
}

pub fn identifier(text: &str) -> Result<String, String> {
    let word = text.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
    if word && text.starts_with(|c: char| c.is_ascii_alphabetic()) {
        Ok(text.to_owned())
    } else {
        Err("letters, digits and underscores, a letter first".to_owned())
    }
}

pub fn law_degree(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(degree) if (1..=6).contains(&degree) => Ok(degree),
        _ => Err("a whole number from 1 to 6".to_owned()),
    }
}

pub fn at_least_one(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(count) if (1..=1000).contains(&count) => Ok(count),
        _ => Err("a whole number from 1 to 1000".to_owned()),
    }
}

pub fn at_least_two(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(count) if (2..=1_000_000).contains(&count) => Ok(count),
        _ => Err("a whole number from 2 to 1000000".to_owned()),
    }
}

pub fn method(text: &str) -> Result<Method, String> {
    let names: Vec<&str> = Method::ALL.iter().map(|(n, _)| *n).collect();
    let found = Method::ALL.iter().find(|(n, _)| *n == text);
    found
        .map(|(_, m)| *m)
        .ok_or_else(|| format!("the methods are {}", names.join(", ")))
}

pub fn trajectories(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(count) if (1..=10_000_000).contains(&count) => Ok(count),
        _ => Err("a whole number from 1 to 10000000".to_owned()),
    }
}

pub fn seconds(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(time) if time > 0.0 && time <= 1e6 => Ok(time),
        _ => Err("seconds, above 0 and at most 1e6".to_owned()),
    }
}

pub fn duration(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(time) if time > 0.0 && f64::is_finite(time) => Ok(time),
        _ => Err("a time above 0, in the scene's unit".to_owned()),
    }
}

pub fn tolerance(text: &str) -> Result<f64, String> {
    let value: f64 = text
        .parse()
        .map_err(|_| format!("`{text}` is not a number"))?;
    if value > 0.0 && value <= 0.1 {
        Ok(value)
    } else {
        Err("a relative tolerance is above 0 and at most 0.1".to_owned())
    }
}

#[derive(Args, Debug, Clone)]
pub struct CheckLeastArgs {
    /// The result file (.h5), with solved states in /points or /map.
    pub file: PathBuf,
    /// Nodes of the grid along each axis, about: one number, or one for each state [default: by the
    /// number of states]
    #[arg(long, value_name = "N", value_delimiter = ',', value_parser = nodes)]
    pub nodes: Vec<usize>,
    /// Widths of the region by which the grid goes beyond the region and the states.
    #[arg(long, default_value_t = 0.3, value_parser = margin, allow_negative_numbers = true)]
    pub margin: f64,
    /// Seconds for the grid; on an infinite horizon its values are taken as they are then.
    #[arg(long, value_parser = seconds, allow_negative_numbers = true)]
    pub seconds: Option<f64>,
    /// The grid and V are apart where they differ by more than this share of V.
    #[arg(long, default_value_t = 0.1, value_parser = share, allow_negative_numbers = true)]
    pub apart: f64,
    #[command(flatten)]
    pub numerics: NumericsArgs,
    #[command(flatten)]
    pub print: PrintArgs,
}

fn nodes(text: &str) -> Result<usize, String> {
    match text.trim().parse() {
        Ok(count) if (11..=100_001).contains(&count) => Ok(count),
        _ => Err("a whole number from 11 to 100001".to_owned()),
    }
}

fn margin(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(widths) if (0.0..=10.0).contains(&widths) => Ok(widths),
        _ => Err("widths of the region, from 0 to 10".to_owned()),
    }
}

fn share(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(share) if share > 0.0 && share <= 10.0 => Ok(share),
        _ => Err("a share of V, above 0 and at most 10".to_owned()),
    }
}
