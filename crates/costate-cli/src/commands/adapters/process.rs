//! Processes of this program, one an adapter.

use crate::common::ending::KEPT;
use crate::error::AdaptersError;
use crate::terminal::Terminal;
use costate::backend::Deadline;
use costate::low_level::diagnostics::printable;
use costate::session::Progress;
use std::collections::BTreeSet;
use std::ffi::{OsStr, OsString};
use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::{Child, ChildStderr, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::{Mutex, PoisonError};
use std::thread::{Scope, ScopedJoinHandle, scope};
use std::time::Duration;

/// How often is looked whether one has ended.
const PAUSE: Duration = Duration::from_millis(20);
/// How an error begins that ends a process.
const ERROR: &str = "error: ";
/// The exit status of what was ended before it was done.
const UNFINISHED: i32 = 75;

/// A shard of the work.
pub struct Part {
    pub number: usize,
    pub of: usize,
    /// The adapter's number.
    pub adapter: usize,
    pub out: PathBuf,
}

/// What came of all of them.
#[derive(Default)]
pub struct Ended {
    /// The first that failed: its place among the parts, its exit status and what it said.
    pub failed: Option<(usize, u8, String)>,
    /// Whether one was ended before it was done.
    pub stopped: bool,
}

/// The words that start this program, before its arguments.
pub fn program(line: &[OsString]) -> Vec<OsString> {
    let own = std::env::current_exe().ok();
    if let Some(own) = own.filter(|path| path.file_stem() == Some(OsStr::new("costate"))) {
        return vec![own.into()];
    }
    // In Python it is a module of another program, as which it was started: `python -m pycostate`.
    let mut words: Vec<OsString> = std::env::args_os().collect();
    let arguments = &line[line.len().min(1)..];
    match words.ends_with(arguments) && words.len() > arguments.len() {
        true => words.truncate(words.len() - arguments.len()),
        false => words = vec!["costate".into()],
    }
    words
}

impl Part {
    /// The arguments of its process: those given, but with its own adapter, shard and file.
    fn arguments(&self, line: &[OsString]) -> Vec<OsString> {
        const REPLACED: [&str; 4] = ["--adapter", "--backend", "--out", "--shard"];
        const LEFT_OUT: &str = "--json";
        let mut given = line.iter().skip(1);
        let mut made: Vec<OsString> = given.next().cloned().into_iter().collect();
        let adapter = self.adapter.to_string();
        let shard = format!("{}/{}", self.number, self.of);
        let own = ["--backend", "gpu", "--adapter", &adapter, "--shard", &shard];
        made.extend(own.map(OsString::from));
        made.extend(["--heed-input".into(), "--out".into()]);
        made.push(self.out.clone().into());
        while let Some(argument) = given.next() {
            let text = argument.to_string_lossy();
            let name = text.split('=').next().unwrap_or_default();
            if text == "--" {
                made.push(argument.clone());
                made.extend(given.by_ref().cloned());
            } else if REPLACED.contains(&name) {
                if name == text {
                    given.next();
                }
            } else if name != LEFT_OUT {
                made.push(argument.clone());
            }
        }
        made
    }
}

/// A process that is running.
struct Running<'scope> {
    process: Child,
    /// What it heeds: a byte asks it to end, and where this is closed it ends at once.
    input: ChildStdin,
    /// Tells the error that it ended with.
    listener: Option<ScopedJoinHandle<'scope, String>>,
}

/// Starts a process for each part, and waits for all to end. Where one fails, or this process is
/// asked to end, they are asked to end with what they have.
pub fn run(
    (program, line): (&[OsString], &[OsString]),
    parts: &[Part],
    (deadline, terminal): (Deadline, &Terminal),
) -> Result<Ended, AdaptersError> {
    let said = Said::default();
    scope(|scope| {
        let mut running = Vec::new();
        for part in parts {
            // Where this fails, those before it see their input closed.
            running.push(start(scope, (program, line), part, &said)?);
        }
        wait(&mut running, parts, (deadline, terminal, &said))
    })
}

fn start<'scope, 'env>(
    scope: &'scope Scope<'scope, 'env>,
    (program, line): (&[OsString], &[OsString]),
    part: &Part,
    said: &'env Said,
) -> Result<Running<'scope>, AdaptersError> {
    let mut process = Command::new(&program[0])
        .args(&program[1..])
        .args(part.arguments(line))
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|source| AdaptersError::Process {
            doing: "cannot start the process",
            adapter: part.adapter.to_string(),
            source,
        })?;
    let (input, errors) = (process.stdin.take(), process.stderr.take());
    let (Some(input), Some(errors)) = (input, errors) else {
        unreachable!("both were asked for");
    };
    let adapter = part.adapter;
    let listener = scope.spawn(move || said.listen(adapter, errors));
    Ok(Running {
        process,
        input,
        listener: Some(listener),
    })
}

fn wait(
    running: &mut [Running<'_>],
    parts: &[Part],
    (deadline, terminal, said): (Deadline, &Terminal, &Said),
) -> Result<Ended, AdaptersError> {
    let mut ended = Ended::default();
    let (mut asked, mut left) = (false, parts.len());
    let show = |left: usize| {
        let (done, of) = (parts.len() - left, parts.len());
        terminal.step(&format!("{done} of {of} shards done"));
    };
    show(left);
    while left > 0 {
        for (k, one) in running.iter_mut().enumerate() {
            if one.listener.is_none() {
                continue;
            }
            let status = one.process.try_wait();
            let Some(status) = status.map_err(|source| AdaptersError::Process {
                doing: "cannot wait for the process",
                adapter: parts[k].adapter.to_string(),
                source,
            })?
            else {
                continue;
            };
            let error = one.listener.take().and_then(|l| l.join().ok());
            let error = error.unwrap_or_default();
            left -= 1;
            show(left);
            match status.code() {
                Some(0) => {}
                Some(UNFINISHED) => ended.stopped = true,
                _ if asked => {
                    ended.stopped = true;
                    if ended.failed.is_none() && !error.is_empty() {
                        said.pass_on(parts[k].adapter, &format!("{ERROR}{error}"));
                    }
                }
                _ => ended.failed = Some((k, code(status), message(status, error))),
            }
        }
        if !asked && (ended.failed.is_some() || deadline.has_passed()) {
            asked = true;
            for one in running.iter_mut() {
                // Some have ended.
                let _ = one.input.write_all(b".");
            }
        }
        if left > 0 {
            std::thread::sleep(PAUSE);
        }
    }
    terminal.step_ended();
    Ok(ended)
}

/// The exit status that a failed process gives this one.
fn code(status: ExitStatus) -> u8 {
    let code = status.code().and_then(|code| u8::try_from(code).ok());
    code.unwrap_or(1)
}

fn message(status: ExitStatus, error: String) -> String {
    match error.is_empty() {
        true => format!("its process ended with {status}"),
        false => error,
    }
}

/// What processes say: one that says what another has said already is not heard.
#[derive(Default)]
struct Said(Mutex<BTreeSet<String>>);

impl Said {
    /// Passes on what a process says, line by line, but the error that it ends with, which is
    /// returned.
    fn listen(&self, adapter: usize, errors: ChildStderr) -> String {
        let mut error = String::new();
        for line in BufReader::new(errors).split(b'\n').map_while(Result::ok) {
            let line = String::from_utf8_lossy(&line);
            if !error.is_empty() {
                error.push('\n');
                error.push_str(&line);
            } else if let Some(text) = line.strip_prefix(ERROR) {
                text.clone_into(&mut error);
            } else {
                self.pass_on(adapter, &line);
            }
        }
        error
    }

    fn pass_on(&self, adapter: usize, line: &str) {
        let mut said = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        // This process says that itself.
        let is_known = line.ends_with(KEPT) || !said.insert(line.to_owned());
        if !is_known {
            // Nowhere is left to report a failure of this.
            let _ = writeln!(
                std::io::stderr(),
                "adapter {adapter}: {}",
                printable(line.trim_end())
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_has_its_own_adapter_shard_and_file() {
        let part = Part {
            number: 1,
            of: 3,
            adapter: 4,
            out: "x_adapters/part1.h5".into(),
        };
        let made = |given: &[&str]| {
            let line: Vec<OsString> = given.iter().map(OsString::from).collect();
            let made = part.arguments(&line).into_iter();
            made.map(|argument| argument.into_string().unwrap())
                .collect::<Vec<_>>()
        };
        let own = [
            "solve",
            "--backend",
            "gpu",
            "--adapter",
            "4",
            "--shard",
            "1/3",
            "--heed-input",
            "--out",
            "x_adapters/part1.h5",
        ];
        let line = "costate solve s.toml --adapter all --backend=auto --set out=1 --json --out x.h5 \
                    --shard none --time-limit 5 --resume --out=y.h5";
        let given: Vec<&str> = line.split_whitespace().collect();
        let kept = "s.toml --set out=1 --time-limit 5 --resume".split(' ');
        let expected: Vec<&str> = own.into_iter().chain(kept).collect();
        assert_eq!(made(&given), expected);
        // What follows is a file, whatever it is called.
        let given = ["costate", "solve", "--adapter=all", "--", "--json"];
        let expected = [&own[..], &["--", "--json"]].concat();
        assert_eq!(made(&given), expected);
    }
}
