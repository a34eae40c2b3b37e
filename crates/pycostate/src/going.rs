//! Work that goes on while Python waits: on a thread of its own, without the interpreter's lock, ended
//! by Ctrl-C with what is done by then.

use crate::error::{exception, in_python};
use costate::backend::Deadline;
use costate::session::Progress;
use pyo3::prelude::*;
use std::any::Any;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// How often signals and progress are looked at.
const LOOK: Duration = Duration::from_millis(50);

/// What is told of a computation.
enum Told {
    Step(String),
    StepEnded,
    Note(String),
}

/// Passes on what it hears.
pub struct Listener(Mutex<Sender<Told>>);

impl Listener {
    fn tell(&self, told: Told) {
        let sender = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        // Whoever has gone wants to hear nothing.
        let _ = sender.send(told);
    }
}

impl Progress for Listener {
    fn step(&self, what: &str) {
        self.tell(Told::Step(what.to_owned()));
    }

    fn step_ended(&self) {
        self.tell(Told::StepEnded);
    }

    fn note(&self, text: &str) {
        self.tell(Told::Note(text.to_owned()));
    }
}

/// What came of such work.
pub struct Gone<T> {
    pub done: T,
    /// The exception that asked it to end: that of Ctrl-C, or one that `progress` has raised.
    pub interrupted: Option<PyErr>,
    /// Whether the time limit has passed.
    pub is_late: bool,
}

/// Does some work. `progress(step)` is called with what goes on (None where a step has ended), `note`
/// with remarks; an exception of `look()`, which is called again and again, ends it.
pub fn going<T: Send>(
    py: Python<'_>,
    (progress, note, look): (
        &Bound<'_, PyAny>,
        &Bound<'_, PyAny>,
        &dyn Fn() -> PyResult<()>,
    ),
    time_limit: Option<f64>,
    work: impl FnOnce(&Listener, Deadline) -> T + Send,
) -> PyResult<Gone<T>> {
    // Whoever holds a deadline may hold it for ever: so does the flag that it looks at.
    let stop: &'static AtomicBool = Box::leak(Box::new(AtomicBool::new(false)));
    let end = time_limit.and_then(|limit| Deadline::instant(Instant::now(), limit));
    let deadline = Deadline::at(end).or_once(stop);
    let (sender, told) = channel();
    let ended = Ended::default();
    let mut interrupted = None;
    let done = std::thread::scope(|scope| {
        let worker = scope.spawn(|| {
            // Told by its end, whatever that is.
            let _told = Telling(&ended);
            work(&Listener(Mutex::new(sender)), deadline)
        });
        loop {
            let over = py.detach(|| ended.wait());
            let heard = pass_on(&told, progress, note)
                .and_then(|()| py.check_signals())
                .and_then(|()| look());
            if let Err(e) = heard {
                stop.store(true, Ordering::Relaxed);
                interrupted.get_or_insert(e);
            }
            if over {
                break;
            }
        }
        py.detach(|| worker.join())
    });
    match done {
        Ok(done) => Ok(Gone {
            done,
            interrupted,
            is_late: time_limit.is_some() && deadline.has_passed(),
        }),
        Err(panic) => Err(failed(py, panic.as_ref())),
    }
}

/// What a panic of the engine is in Python.
fn failed(py: Python<'_>, panic: &(dyn Any + Send)) -> PyErr {
    let text = (panic.downcast_ref::<String>().map(String::as_str))
        .or(panic.downcast_ref::<&str>().copied())
        .unwrap_or("without a reason");
    let message = format!("the engine has failed, which is a fault of it: {text}");
    exception(py, "CostateError", &message).unwrap_or_else(|e| e)
}

/// Whether the work has ended.
#[derive(Default)]
struct Ended(Mutex<bool>, Condvar);

impl Ended {
    /// Whether it has, after a moment at most.
    fn wait(&self) -> bool {
        let over = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        match self.1.wait_timeout_while(over, LOOK, |over| !*over) {
            Ok((over, _)) => *over,
            Err(poisoned) => *poisoned.into_inner().0,
        }
    }
}

/// Says so when it is dropped.
struct Telling<'e>(&'e Ended);

impl Drop for Telling<'_> {
    fn drop(&mut self) {
        *self.0.0.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.0.1.notify_all();
    }
}

/// All remarks, and the last step.
fn pass_on(
    told: &Receiver<Told>,
    progress: &Bound<'_, PyAny>,
    note: &Bound<'_, PyAny>,
) -> PyResult<()> {
    let mut step = None;
    for one in told.try_iter() {
        match one {
            Told::Note(text) => drop(note.call1((in_python(&text),))?),
            Told::Step(what) => step = Some(Some(what)),
            Told::StepEnded => step = Some(None),
        }
    }
    if let Some(step) = step.filter(|_| !progress.is_none()) {
        progress.call1((step,))?;
    }
    Ok(())
}
