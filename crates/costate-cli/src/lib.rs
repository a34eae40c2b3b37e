//! The program `costate` (see `costate --help`): reads arguments, calls the library, prints. It is
//! called by the executable of that name, and by the one in the Python package.

// The program needs result files.
#![cfg(feature = "hdf5")]

mod args;
mod commands;
mod common;
mod error;
mod terminal;
mod text;

use args::Command;
use clap::Parser;
#[cfg(feature = "urdf")]
use commands::import;
#[cfg(feature = "report")]
use commands::report;
use commands::{
    adapters, attenuation, bench, check, check_least, evaluate, export, fit, mechanism, merge, run,
    simulate, study, value,
};
use costate::low_level::diagnostics::{printable, unprintable};

// What the Python package shares with the program.
pub use args::BackendChoice;
pub use commands::check::Checked;
pub use commands::export::{local_header, map_header};
pub use commands::run::summary;
pub use common::open::backend;
pub use common::provenance;
pub use error::CliError;
use std::ffi::OsString;

/// Runs a command, `costate ARGUMENTS...`, and returns its exit status: 0 if it was done, 2 if what
/// it was given is wrong. `arguments` begin with the program's name.
///
/// It is the whole program: it prints to the standard output and error of the process, and may set
/// environment variables and handlers of signals, so that nothing else should run in the process
/// when it begins.
pub fn run_command(arguments: impl IntoIterator<Item = OsString>) -> u8 {
    if cfg!(unix) && std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // The Vulkan loader complains on standard error where this is unset, though nothing here
        // needs it. SAFETY: no other thread has been started yet.
        unsafe { std::env::set_var("XDG_RUNTIME_DIR", std::env::temp_dir()) };
    }
    // Without it a signal leaves a hidden file beside the result's name, and no more is lost.
    #[cfg(unix)]
    let _ = costate::low_level::files::removed_at_signals();
    let arguments: Vec<OsString> = arguments.into_iter().collect();
    let cli = match args::Cli::try_parse_from(&arguments) {
        Ok(cli) => cli,
        Err(e) => {
            // Coloured unless an argument has what a terminal would obey.
            let odd = |a: &OsString| unprintable(&a.to_string_lossy()).is_some();
            match arguments.iter().any(odd) {
                true => eprint!("{}", printable(&e.render().to_string())),
                false => drop(e.print()),
            }
            return if e.use_stderr() { 2 } else { 0 };
        }
    };
    let done = match adapters::divided(cli.command, &arguments) {
        Ok(Some(command)) => perform(command),
        Ok(None) => Ok(()),
        Err(error) => Err(error),
    };
    match done {
        Ok(()) => 0,
        // The reader of a pipe has gone: it has what it wanted.
        Err(CliError::Stdout(e)) if e.kind() == std::io::ErrorKind::BrokenPipe => 0,
        Err(e) => {
            e.print();
            e.status()
        }
    }
}

/// Does what one process does.
fn perform(command: Command) -> Result<(), CliError> {
    match command {
        Command::Run(args) => run::run(&args, run::Parts::All),
        Command::ShootOut(args) => run::run(&args.run, run::Parts::ShootOut(&args.part)),
        Command::Homotopy(args) => run::run(&args.run, run::Parts::Homotopy(&args)),
        Command::Map(args) => run::run(&args.run, run::Parts::Map(&args)),
        Command::Merge(args) => merge::merge(&args),
        Command::Solve(args) => run::run(&args.run, run::Parts::Solve(&args)),
        Command::CheckLeast(args) => check_least::check_least(&args),
        Command::Study(args) => study::study(&args),
        Command::Attenuation(args) => attenuation::attenuation(&args),
        Command::Simulate(args) => simulate::simulate(&args),
        Command::Value(args) => value::value(&args),
        Command::Evaluate(args) => evaluate::evaluate(&args),
        Command::Bench(args) => bench::bench(&args),
        Command::Fit(args) => fit::fit(&args),
        Command::Export(args) => export::export(&args),
        #[cfg(feature = "report")]
        Command::Report(args) => report::report(&args),
        Command::Check(args) => check::check(&args),
        #[cfg(feature = "urdf")]
        Command::Import(args) => import::run(&args),
        Command::Mechanism(args) => mechanism::mechanism(&args),
        Command::Reference { what } => check::reference(what),
        Command::Adapters { json } => check::list_adapters(json),
    }
}
