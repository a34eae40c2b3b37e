//! `--adapter all`: each GPU adapter does a shard of the work, in a process of its own, and their
//! results are put together.

mod choose;
mod folder;
mod process;

use super::run::{Parts, check_names, out_path};
use crate::args::{BackendChoice, Command, PrecisionChoice, RunArgs, ShardArgs};
use crate::common::ending::Ending;
use crate::common::load::load;
use crate::common::open::ALL;
use crate::common::{Kind, check_out, print_json, provenance, shard};
use crate::error::{AdaptersError, CliError, GridRefusal};
use crate::terminal::Terminal;
use crate::text;
use choose::choose;
use costate::backend::adapters::{AdapterInfo, adapters};
use costate::low_level::files::heed_input;
use costate::low_level::model::Model;
use costate::run::{MergeOptions, Provenance, merge, output_of};
use costate::session::{Progress, SessionError};
use folder::Folder;
use process::{Ended, Part};
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// The exit status of what the user wrote wrongly.
const OF_INPUT: u8 = 2;

/// Does a divided command on all adapters, if that is asked for; `line`: the arguments as they were
/// given. What is left to be done: any other command, and this one where there is one adapter.
pub fn divided(mut command: Command, line: &[OsString]) -> Result<Option<Command>, CliError> {
    let Some((run, part)) = divisible(&mut command) else {
        return Ok(Some(command));
    };
    let part = *part;
    if part.heed_input {
        // Without it the process ends by signals, as any other.
        let _ = heed_input();
    }
    let of_all = run.numerics.adapter.as_deref() == Some(ALL);
    if !of_all || run.numerics.backend == BackendChoice::Cpu {
        return Ok(Some(command));
    }
    let run = run.clone();
    let provenance = provenance();
    let terminal = Terminal::new(run.scene.print);
    if let Some(shard) = shard::of(part, &terminal)? {
        return Err(AdaptersError::Shard { shard }.into());
    }
    let (path, model) = checked(&command, &run, &terminal)?;
    let found = adapters();
    let asked = run.numerics.precision.and_then(PrecisionChoice::precision);
    let chosen = choose(&found, asked.or(model.integrator.precision))?;
    for (number, why) in chosen.left_out {
        let name = &found[number];
        terminal.note(&format!("adapter {number}, {name}, is left out: {why}"));
    }
    let goes_on = part.resume && folder::is_there(&path);
    if let ([only], false) = (&*chosen.adapters, goes_on) {
        if let Some((run, _)) = divisible(&mut command) {
            run.numerics.adapter = Some(only.to_string());
        }
        return Ok(Some(command));
    }

    terminal.say(&model.title)?;
    for number in &chosen.adapters {
        terminal.say(&format!("adapter {number}: {}", found[*number]))?;
    }
    let work = Work {
        run: &run,
        resume: part.resume,
        path: &path,
        provenance: &provenance,
        terminal: &terminal,
    };
    work.perform(line, (&found, &chosen.adapters))?;
    Ok(None)
}

/// The arguments of a command that can be divided.
fn divisible(command: &mut Command) -> Option<(&mut RunArgs, &mut ShardArgs)> {
    match command {
        Command::Solve(args) => Some((&mut args.run, &mut args.part)),
        Command::Homotopy(args) | Command::Map(args) => Some((&mut args.run, &mut args.part)),
        Command::Study(args) => Some((&mut args.run, &mut args.part)),
        _ => None,
    }
}

/// Refuses what one process would, before there are several; where the result goes, and the scene.
fn checked(
    command: &Command,
    run: &RunArgs,
    terminal: &Terminal,
) -> Result<(PathBuf, Model), CliError> {
    let (parts, solve) = match command {
        Command::Solve(args) => (Parts::Solve(args), Some(args)),
        Command::Homotopy(args) => (Parts::Homotopy(args), None),
        Command::Map(args) => (Parts::Map(args), None),
        _ => return checked_study(run),
    };
    read_by_all(&run.scene.scenario)?;
    if let Some(solve) = solve {
        read_by_all(&solve.points)?;
        if text::listed::is_table(solve) {
            return Err(AdaptersError::Table.into());
        }
    }
    check_names(run, parts)?;
    let model = load(&run.scene)?.model;
    let wanted = parts.wanted(run, &model)?;
    if wanted.map && model.map_aim.is_some() {
        return Err(AdaptersError::Map.into());
    }
    Ok((out_path(run, (solve, None), terminal), model))
}

/// The same of a study.
fn checked_study(run: &RunArgs) -> Result<(PathBuf, Model), CliError> {
    if run.grid_guesses {
        return Err(GridRefusal::Nothing.into());
    }
    read_by_all(&run.scene.scenario)?;
    check_out(run.out.as_deref(), &[Kind::Result], &[&run.scene.scenario])?;
    let model = load(&run.scene)?.model;
    if model.study.is_none() {
        return Err(SessionError::NoStudy.into());
    }
    let own = || output_of(&run.scene.scenario, "_study");
    Ok((run.out.clone().unwrap_or_else(own), model))
}

/// Refuses what only one process can read; what is not there is told by who reads it.
fn read_by_all(path: &Path) -> Result<(), AdaptersError> {
    match std::fs::metadata(path).is_ok_and(|file| !file.is_file()) {
        true => Err(AdaptersError::NoFile {
            path: path.to_owned(),
        }),
        false => Ok(()),
    }
}

/// The work of all adapters.
struct Work<'a> {
    run: &'a RunArgs,
    resume: bool,
    path: &'a Path,
    provenance: &'a Provenance,
    terminal: &'a Terminal,
}

impl Work<'_> {
    fn perform(
        &self,
        line: &[OsString],
        (found, chosen): (&[AdapterInfo], &[usize]),
    ) -> Result<(), CliError> {
        let folder = Folder::begin(self.path)?;
        if !self.resume && folder.has_parts() {
            let path = folder.path().display();
            self.terminal.note(&format!(
                "{path}, which an earlier run that was ended early has left, is replaced"
            ));
            folder.clear();
        }
        let part = |(number, adapter): (usize, &usize)| Part {
            number,
            of: chosen.len(),
            adapter: *adapter,
            out: folder.part(number),
        };
        let parts: Vec<Part> = chosen.iter().enumerate().map(part).collect();
        let ending = Ending::of(self.run, self.provenance);
        let program = process::program(line);
        let Ended { failed, stopped } =
            process::run((&program, line), &parts, (ending.deadline, self.terminal))?;
        let kept = || folder.has_parts().then(|| folder.path().to_owned());
        if let Some((k, status, message)) = failed {
            let number = parts[k].adapter;
            let adapter = format!("{number}, {}", found[number]);
            // What the user wrote cannot be gone on with.
            let kept = kept().filter(|_| status != OF_INPUT);
            return Err(AdaptersError::Part {
                adapter,
                message,
                status,
                kept,
            }
            .into());
        }
        if stopped {
            return Err(match kept() {
                Some(path) => ending.stopped(path),
                None => ending.nothing("nothing was done by then"),
            });
        }
        self.put_together(&folder, &parts)
    }

    fn put_together(&self, folder: &Folder, parts: &[Part]) -> Result<(), CliError> {
        let files: Vec<PathBuf> = parts.iter().map(|part| part.out.clone()).collect();
        let options = MergeOptions::default();
        let merged = merge(&files, self.path, options, self.provenance, self.terminal)
            .inspect_err(|_| {
                let path = folder.path().display();
                self.terminal.note(&format!("{path} has all parts"));
            })?;
        folder.clear();
        self.terminal.say(&text::merged::merged(&merged))?;
        if self.run.scene.print.json {
            print_json(&merged.summary)?;
        }
        Ok(())
    }
}
