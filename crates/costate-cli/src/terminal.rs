//! Where the words of a command go: text to standard output, or to standard error beside `--json`.

use crate::args::PrintArgs;
use crate::text;
use costate::backend::Backend;
use costate::low_level::diagnostics::printable;
use costate::low_level::model::Model;
use costate::low_level::sweep::Plan;
use costate::session::{Finished, Progress};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::Write;
use std::sync::Mutex;
use std::time::Duration;

/// Standard output for text that may have names from elsewhere: what a terminal would obey is
/// spelled out.
pub struct Printed(std::io::StdoutLock<'static>);

impl Printed {
    pub fn new() -> Self {
        Self(std::io::stdout().lock())
    }
}

impl Write for Printed {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        // A formatted text comes in whole strings.
        let text = String::from_utf8_lossy(bytes);
        self.0.write_all(printable(&text).as_bytes())?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.0.flush()
    }
}

/// The terminal, as what listens to a computation.
pub struct Terminal {
    quiet: bool,
    json: bool,
    /// The line that shows the present step.
    bar: Mutex<Option<ProgressBar>>,
    /// Why standard output could not be written to.
    broken: Mutex<Option<std::io::Error>>,
}

impl Terminal {
    pub fn new(args: PrintArgs) -> Self {
        Self::with(args.quiet, args.json)
    }

    /// Of a command with options of its own for it.
    pub fn with(quiet: bool, json: bool) -> Self {
        Self {
            quiet,
            json,
            bar: Mutex::default(),
            broken: Mutex::default(),
        }
    }

    /// Text that a command was asked for.
    pub fn say(&self, text: &str) -> std::io::Result<()> {
        if self.quiet {
            return Ok(());
        }
        let text = printable(text);
        if self.json {
            writeln!(std::io::stderr(), "{text}")
        } else {
            writeln!(std::io::stdout(), "{text}")
        }
    }

    /// What standard output refused while a computation went on.
    pub fn ended(&self) -> std::io::Result<()> {
        let broken = self.broken.lock().ok().and_then(|mut broken| broken.take());
        broken.map_or(Ok(()), Err)
    }

    fn said(&self, text: &str) {
        if let (Err(error), Ok(mut broken)) = (self.say(text), self.broken.lock()) {
            broken.get_or_insert(error);
        }
    }
}

impl Progress for Terminal {
    fn step(&self, what: &str) {
        let Ok(mut bar) = self.bar.lock() else { return };
        let bar = bar.get_or_insert_with(|| {
            let target = match self.quiet {
                true => ProgressDrawTarget::hidden(),
                false => ProgressDrawTarget::stderr(),
            };
            let bar = ProgressBar::with_draw_target(None, target);
            if let Ok(style) = ProgressStyle::with_template("{spinner} {elapsed} {msg}") {
                bar.set_style(style);
            }
            bar.enable_steady_tick(Duration::from_millis(200));
            bar
        });
        bar.set_message(printable(what).into_owned());
    }

    fn step_ended(&self) {
        if let Some(bar) = self.bar.lock().ok().and_then(|mut bar| bar.take()) {
            bar.finish_and_clear();
        }
    }

    fn note(&self, text: &str) {
        if !self.quiet {
            let _ = writeln!(std::io::stderr(), "note: {}", printable(text));
        }
    }

    fn begun(&self, model: &Model, plan: &Plan, backend: &dyn Backend) {
        self.said(&text::solved::heading(model, plan, backend));
        for note in text::solved::heading_notes(model, plan) {
            self.note(&note);
        }
    }

    fn finished(&self, part: Finished<'_>) {
        match part {
            Finished::Solved(outcome, model) => {
                self.said(&text::solved::text(&text::solved::Solved::new(
                    outcome, model,
                )));
                for note in text::estimates::notes(&outcome.estimates, &outcome.plan) {
                    self.note(&note);
                }
            }
            Finished::Fitted(fitted) => self.said(&text::laws::text(fitted)),
            Finished::Exported(fitted, exports) => {
                self.said(&text::laws::files(fitted, exports));
            }
            Finished::ClosedLoop(evaluation) => self.said(&text::evaluation::text(evaluation)),
            Finished::Dissipation(check) => self.said(&text::dissipation::text(check)),
            Finished::Attenuation(found) => self.said(&text::attenuation::text(found)),
            _ => {}
        }
    }
}
