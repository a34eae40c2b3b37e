//! When a command ends before it is done: at its time limit, or when a signal asks it to.

use crate::args::{EvaluateArgs, FitArgs, RunArgs, SimulateArgs};
use crate::error::CliError;
use costate::backend::{BackendError, Deadline};
use costate::low_level::files::stop_at_signals;
use costate::run::Provenance;
use costate::session::SessionError;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

/// What the first signal is answered with.
pub const KEPT: &str = "what is done is kept; once more ends at once, with nothing";
const NOTHING: &str = "this ends, with nothing; once more ends at once";

/// Ends a command early, with what is done, or with nothing.
pub struct Ending {
    pub deadline: Deadline,
    limit: Option<f64>,
    /// The signal that asked.
    signal: Arc<Mutex<Option<String>>>,
}

impl Ending {
    /// From now on signals only ask the command to end.
    pub fn of(args: &RunArgs, provenance: &Provenance) -> Self {
        let (limit, quiet) = (args.time_limit, args.scene.print.quiet);
        Self::saying(KEPT, limit, quiet, provenance.clock)
    }

    /// The same for `fit`, from now on.
    pub fn of_fit(args: &FitArgs) -> Self {
        Self::saying(KEPT, args.time_limit, args.print.quiet, Instant::now())
    }

    /// The same for a part of `evaluate`.
    pub fn of_loops(args: &EvaluateArgs, provenance: &Provenance) -> Self {
        Self::saying(KEPT, args.time_limit, args.print.quiet, provenance.clock)
    }

    /// The same for a command of which a part shows nothing.
    pub fn with_nothing(args: &RunArgs, provenance: &Provenance) -> Self {
        let (limit, quiet) = (args.time_limit, args.scene.print.quiet);
        Self::saying(NOTHING, limit, quiet, provenance.clock)
    }

    /// The same for `simulate`, which shows nothing then.
    pub fn of_simulation(args: &SimulateArgs, provenance: &Provenance) -> Self {
        Self::saying(NOTHING, None, args.scene.print.quiet, provenance.clock)
    }

    fn saying(what: &'static str, limit: Option<f64>, quiet: bool, clock: Instant) -> Self {
        let signal = Arc::new(Mutex::new(None));
        let asked = Arc::clone(&signal);
        let stop = stop_at_signals(move |name| {
            *asked.lock().unwrap_or_else(PoisonError::into_inner) = Some(name.to_owned());
            if !quiet {
                eprintln!("{name}: {what}");
            }
        });
        let instant = limit.and_then(|limit| Deadline::instant(clock, limit));
        Self {
            deadline: Deadline::at(instant).or_once(stop),
            limit,
            signal,
        }
    }

    /// The error that a command ends with then.
    pub fn stopped(&self, path: PathBuf) -> CliError {
        let by = self.cause();
        CliError::Stopped { by, path }
    }

    /// The same where nothing is written, and why.
    pub fn nothing(&self, why: impl Into<String>) -> CliError {
        let (by, why) = (self.cause(), why.into());
        CliError::Nothing { by, why }
    }

    /// The same of an error that may be that the time is over.
    pub fn nothing_of(&self, error: SessionError) -> CliError {
        match error {
            SessionError::Backend(BackendError::OutOfTime) => {
                self.nothing("the simulation was not done")
            }
            other => other.into(),
        }
    }

    fn cause(&self) -> String {
        let signal = self.signal.lock().unwrap_or_else(PoisonError::into_inner);
        match (&*signal, self.limit) {
            (Some(name), _) => name.clone(),
            (None, Some(limit)) => format!("--time-limit {limit}"),
            (None, None) => "its deadline".to_owned(),
        }
    }
}
