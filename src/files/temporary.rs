//! Files under hidden names: gone unless they are given another one, whether by an error or by a
//! signal to end.

use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

/// Those of this process that are there.
static OPEN: Mutex<Vec<Claimed>> = Mutex::new(Vec::new());

/// Signals that ask a program to end, and leave it time to.
static STOP: AtomicBool = AtomicBool::new(false);
/// Told of such a signal, by its name; none where the first one ends the process.
static ASKED: Mutex<Option<Asked>> = Mutex::new(None);
/// Whether it is the end of the input that ends this process at once, and no second signal.
static HEEDS_INPUT: AtomicBool = AtomicBool::new(false);
type Asked = Box<dyn Fn(&str) + Send>;

/// From now on the first signal that asks the process to end (interrupt, terminate, those of batch
/// systems before they kill) only sets the flag that is returned, and calls `asked` with the
/// signal's name; the second one ends it. Needs [`removed_at_signals`].
pub fn stop_at_signals(asked: impl Fn(&str) + Send + 'static) -> &'static AtomicBool {
    *ASKED.lock().unwrap_or_else(PoisonError::into_inner) = Some(Box::new(asked));
    &STOP
}

/// A file's hidden name; what is there is removed when this is dropped.
#[derive(Debug)]
pub struct Temporary(Claimed);

/// A hidden name, and the directories that were made for it, the innermost first.
#[derive(Clone, Debug, PartialEq)]
struct Claimed {
    path: PathBuf,
    made: Vec<PathBuf>,
}

impl Claimed {
    /// Removes what is there, and the directories unless something else is in them.
    fn remove(&self) {
        self.remove_file();
        self.remove_directories();
    }

    fn remove_file(&self) {
        // Nothing better can be done about a file that cannot be removed than to leave it hidden; a
        // published one has gone.
        let _ = std::fs::remove_file(&self.path);
    }

    fn remove_directories(&self) {
        for directory in &self.made {
            if std::fs::remove_dir(directory).is_err() {
                break;
            }
        }
    }
}

impl Temporary {
    /// Claims a name, before the file is made.
    pub fn new(path: PathBuf) -> Self {
        Self::within(path, Vec::new())
    }

    /// The same in a directory that was made for it, maybe with those that it lies in: they go with
    /// the file unless it is published. The innermost comes first.
    pub fn within(path: PathBuf, made: Vec<PathBuf>) -> Self {
        let claimed = Claimed { path, made };
        let mut open = OPEN.lock().unwrap_or_else(PoisonError::into_inner);
        open.push(claimed.clone());
        Self(claimed)
    }

    pub fn path(&self) -> &Path {
        &self.0.path
    }

    /// Gives the file another name, in place of what has it.
    ///
    /// # Errors
    /// Those of the rename; the file is then gone.
    pub fn publish(self, to: &Path) -> io::Result<()> {
        std::fs::rename(self.path(), to)
    }

    /// Gives the file another name too, if no file has that: nobody else comes between.
    ///
    /// # Errors
    /// Of the kind `AlreadyExists` where one has; others where the file system has no second names.
    pub fn link(&self, to: &Path) -> io::Result<()> {
        std::fs::hard_link(self.path(), to)
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        self.0.remove();
        let mut open = OPEN.lock().unwrap_or_else(PoisonError::into_inner);
        open.retain(|claimed| *claimed != self.0);
    }
}

/// From now on a signal that ends the process (interrupt, terminate, hang up, those of timers and
/// of batch systems) removes its hidden files first. What the process was started to ignore, as
/// `nohup` has it, it still ignores. A file that is longer than the system allows (`ulimit -f`) is
/// an error of writing, and no longer a signal.
///
/// # Errors
/// Where the system has no room for handlers or a thread.
#[cfg(unix)]
pub fn removed_at_signals() -> io::Result<()> {
    use signal_hook::consts::{
        SIGALRM, SIGHUP, SIGINT, SIGQUIT, SIGTERM, SIGUSR1, SIGUSR2, SIGVTALRM, SIGXCPU,
    };
    let ends: Vec<i32> = [
        SIGALRM, SIGHUP, SIGINT, SIGQUIT, SIGTERM, SIGUSR1, SIGUSR2, SIGVTALRM, SIGXCPU,
    ]
    .into_iter()
    .filter(|s| !ignored(*s))
    .collect();
    // SAFETY: to ignore a signal needs no handler of ours.
    unsafe {
        libc::signal(libc::SIGXFSZ, libc::SIG_IGN);
    }
    let mut signals = signal_hook::iterator::Signals::new(ends)?;
    std::thread::Builder::new()
        .name("signals".to_owned())
        .spawn(move || {
            for signal in &mut signals {
                heard(signal);
            }
        })?;
    Ok(())
}

/// From now on this process does what whoever started it writes to its standard input: a byte asks
/// it to end, as a signal does, and where the input ends, as that one is gone, it ends at once. A
/// second signal does nothing more then: the same one may come from several sides. Needs
/// [`removed_at_signals`].
///
/// # Errors
/// Where the system has no room for a thread.
#[cfg(unix)]
pub fn heed_input() -> io::Result<()> {
    use signal_hook::consts::{SIGHUP, SIGTERM};
    HEEDS_INPUT.store(true, Ordering::Relaxed);
    std::thread::Builder::new()
        .name("input".to_owned())
        .spawn(|| {
            let bytes = io::stdin().lock().bytes().take_while(Result::is_ok);
            bytes.for_each(|_| heard(SIGTERM));
            heard(SIGHUP);
        })?;
    Ok(())
}

/// Ends the process by a signal, or asks it to.
#[cfg(unix)]
fn heard(signal: i32) {
    if asks(signal) {
        let asked = ASKED.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(asked) = &*asked {
            if !STOP.swap(true, Ordering::Relaxed) {
                return asked(signal_hook::low_level::signal_name(signal).unwrap_or("a signal"));
            }
            if HEEDS_INPUT.load(Ordering::Relaxed) {
                return;
            }
        }
    }
    // Held to the end: no other file comes after these.
    let open = OPEN.lock().unwrap_or_else(PoisonError::into_inner);
    // Other files may lie in a directory that was made for the first one.
    open.iter().for_each(Claimed::remove_file);
    open.iter().for_each(Claimed::remove_directories);
    // Whoever waits for the process is to see that the signal ended it.
    let _ = signal_hook::low_level::emulate_default_handler(signal);
}

/// Whether a signal asks to end, and something else kills where that is not heard.
#[cfg(unix)]
fn asks(signal: i32) -> bool {
    use signal_hook::consts::{SIGINT, SIGTERM, SIGUSR1, SIGUSR2, SIGXCPU};
    [SIGINT, SIGTERM, SIGUSR1, SIGUSR2, SIGXCPU].contains(&signal)
}

#[cfg(unix)]
fn ignored(signal: i32) -> bool {
    // SAFETY: zeros are a valid `sigaction`, and with no new action the call only fills it in.
    unsafe {
        let mut now: libc::sigaction = std::mem::zeroed();
        libc::sigaction(signal, std::ptr::null(), &mut now) == 0
            && now.sa_sigaction == libc::SIG_IGN
    }
}
