//! When a command ends before it is done: at its time limit, or when a signal asks it to.

use crate::args::RunArgs;
use crate::error::CliError;
use costate::backend::Deadline;
use costate::low_level::files::stop_at_signals;
use costate::run::Provenance;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

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
        Self::saying(
            "what is done is kept; once more ends at once, with nothing",
            args,
            provenance,
        )
    }

    /// The same for a command of which a part shows nothing.
    pub fn with_nothing(args: &RunArgs, provenance: &Provenance) -> Self {
        Self::saying(
            "this ends, with nothing; once more ends at once",
            args,
            provenance,
        )
    }

    fn saying(what: &'static str, args: &RunArgs, provenance: &Provenance) -> Self {
        let signal = Arc::new(Mutex::new(None));
        let (asked, quiet) = (Arc::clone(&signal), args.scene.print.quiet);
        let stop = stop_at_signals(move |name| {
            *asked.lock().unwrap_or_else(PoisonError::into_inner) = Some(name.to_owned());
            if !quiet {
                eprintln!("{name}: {what}");
            }
        });
        let limit = args.time_limit;
        let limit = limit.and_then(|limit| Deadline::instant(provenance.clock, limit));
        Self {
            deadline: Deadline::at(limit).or_once(stop),
            limit: args.time_limit,
            signal,
        }
    }

    /// The error that a command ends with then.
    pub fn stopped(&self, path: PathBuf) -> CliError {
        let by = self.cause();
        CliError::Stopped { by, path }
    }

    /// The same where nothing is written.
    pub fn nothing(&self) -> CliError {
        CliError::Nothing { by: self.cause() }
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
