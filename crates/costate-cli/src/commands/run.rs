//! `costate run` and its parts.

use crate::args::{RunArgs, ShardArgs, SolveArgs, StatesArgs};
use crate::common::ending::Ending;
use crate::common::load::load;
use crate::common::{Kind, check_out, pictures, points, print_json, provenance, shard};
use crate::error::CliError;
use crate::error::{GridRefusal, ShardRefusal};
use crate::terminal::Terminal;
use crate::text::listed;
use costate::low_level::dynamic_programming;
use costate::low_level::files::{target, write_text};
use costate::low_level::model::Model;
use costate::low_level::result::Stored;
use costate::run::{
    Done, Provenance, archive, note_replaced, output_of, output_of_points, path_of_stopped,
};
use costate::session::summary::{
    AttenuationSummary, DissipationSummary, EvaluationSummary, FittedSummary,
};
use costate::session::{
    Finished, Kept, Listed, Progress, Session, SessionError, Shard, States, Wanted,
};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Which parts of a scene to run.
#[derive(Clone, Copy)]
pub enum Parts<'a> {
    All,
    ShootOut(&'a ShardArgs),
    Homotopy(&'a StatesArgs),
    Map(&'a StatesArgs),
    Solve(&'a SolveArgs),
}

pub fn run(args: &RunArgs, parts: Parts<'_>) -> Result<(), CliError> {
    let provenance = provenance();
    let solve = parts.solve();
    let table = solve.is_some_and(listed::is_table);
    check_names(args, parts)?;

    let scene = load(&args.scene)?;
    let model = &scene.model;
    if let Some(solve) = solve.filter(|_| table) {
        listed::check_table(solve, model)?;
    }
    let mut wanted = parts.wanted(args, model)?;
    let terminal = Terminal::new(args.scene.print);
    if let Some(path) = parts.archive() {
        wanted.archive = Some(Arc::new(archive(&Stored::open(path)?, model)?));
    }
    if let Some(part) = parts.part() {
        wanted.shard = shard::of(part, &terminal)?;
        if table && (wanted.shard.is_some() || part.resume) {
            return Err(ShardRefusal::Table.into());
        }
        wanted.resume = shard::resume(part);
    }
    if wanted.kept != Kept::All && !(wanted.sweep && model.shoot_out.is_some()) {
        let option = match wanted.kept {
            Kept::Values => "--values-only",
            _ => "--no-trajectories",
        };
        terminal.note(&format!(
            "{option} changes nothing here: swept trajectories are only stored by run and shoot-out, of scenes with [shoot_out]"
        ));
    }
    let path = out_path(args, (solve, wanted.shard), &terminal);
    if let Some(solve) = solve
        && points::has_published(&solve.points, model)
    {
        let column = points::PUBLISHED;
        terminal.note(&format!("column {column} of the points is not read"));
    }

    let ending = Ending::of(args, &provenance);
    let session = Session::on(&scene, args.numerics.open(model)?)
        .choosing(args.numerics.choices(args.seed))
        .until(ending.deadline)
        .with_progress(&terminal);
    let refused = |e: CliError| match e {
        CliError::Session(SessionError::NoGridGuesses) => GridRefusal::Nothing.into(),
        other => other,
    };
    let (mut summary, path, stopped) = if table {
        to_table(&session, &wanted, &path, &provenance).map_err(refused)?
    } else {
        to_file(&session, &wanted, &path, &provenance).map_err(refused)?
    };
    terminal.ended()?;
    let page = (matches!(parts, Parts::All) && !args.no_report && !stopped)
        .then(|| pictures::page(&path, &terminal));
    let page = page.flatten();
    summary["report"] = json!(page.as_ref().map(|p| p.display().to_string()));
    if args.scene.print.json {
        print_json(&summary)?;
    }
    let report = page.map_or_else(String::new, |p| format!("; report: {}", p.display()));
    let seconds = provenance.seconds();
    terminal.say(&format!(
        "{seconds:.2} s, written to {}{report}",
        path.display()
    ))?;
    match stopped {
        true => Err(ending.stopped(path)),
        false => Ok(()),
    }
}

impl<'a> Parts<'a> {
    fn solve(self) -> Option<&'a SolveArgs> {
        match self {
            Parts::Solve(solve) => Some(solve),
            _ => None,
        }
    }

    /// Which part of it, if it can be divided.
    fn part(self) -> Option<ShardArgs> {
        match self {
            Parts::Solve(solve) => Some(solve.part),
            Parts::Homotopy(args) | Parts::Map(args) => Some(args.part),
            Parts::ShootOut(part) => Some(*part),
            Parts::All => None,
        }
    }

    /// The result whose trajectories are first guesses.
    fn archive(self) -> Option<&'a Path> {
        let archive = match self {
            Parts::Solve(solve) => &solve.archive,
            Parts::Homotopy(args) | Parts::Map(args) => &args.archive,
            Parts::All | Parts::ShootOut(_) => return None,
        };
        archive.archive.as_deref()
    }

    /// What the session is asked for.
    pub fn wanted(self, args: &RunArgs, model: &Model) -> Result<Wanted, CliError> {
        let mut wanted = match self {
            Parts::All => Wanted::all(),
            Parts::ShootOut(_) => Wanted::sweep(),
            Parts::Homotopy(_) => Wanted::homotopy(),
            Parts::Map(_) => Wanted::map(),
            Parts::Solve(solve) => Wanted {
                states: States::Listed(Listed {
                    x: points::read(&solve.points, model)?,
                    one_sheet: solve.one_sheet,
                    samples: solve.trajectories.then_some(solve.samples),
                }),
                ..Wanted::default()
            },
        };
        wanted.grid_guesses = args.grid_guesses;
        wanted.kept = match (args.no_trajectories, args.values_only) {
            (true, _) => Kept::Nothing,
            (_, true) => Kept::Values,
            _ => Kept::All,
        };
        if args.grid_guesses {
            dynamic_programming::refuse(model, "--grid-guesses").map_err(SessionError::from)?;
        }
        Ok(wanted)
    }
}

/// Refuses an `--out` that is an input, or of the wrong kind.
pub fn check_names(args: &RunArgs, parts: Parts<'_>) -> Result<(), CliError> {
    let inputs = [Some(&args.scene.scenario), parts.solve().map(|s| &s.points)];
    let inputs = inputs.into_iter().flatten().map(PathBuf::as_path);
    let inputs: Vec<&Path> = inputs.chain(parts.archive()).collect();
    let kinds: &[Kind] = match parts {
        Parts::Solve(_) => &[Kind::Result, Kind::Table],
        _ => &[Kind::Result],
    };
    check_out(args.out.as_deref(), kinds, &inputs)
}

/// Where results go; said where that is beside others.
pub fn out_path(
    args: &RunArgs,
    (solve, shard): (Option<&SolveArgs>, Option<Shard>),
    terminal: &Terminal,
) -> PathBuf {
    let scenario = &args.scene.scenario;
    let (path, other) = match &args.out {
        Some(path) => (path.clone(), None),
        None if shard.is_some() => (output_of(scenario, &shard::ending(shard)), None),
        None if solve.is_some() => output_of_points(scenario),
        None => (output_of(scenario, ""), None),
    };
    if let Some(other) = other {
        terminal.note(&format!(
            "{} holds other results and stays as it is; the answers go to {}",
            other.display(),
            path.display()
        ));
    }
    path
}

/// The run with its result file: the summary for `--json`, and the file.
fn to_file(
    session: &Session<'_>,
    wanted: &Wanted,
    path: &Path,
    provenance: &Provenance,
) -> Result<(Value, PathBuf, bool), CliError> {
    let done = session.run(wanted, path, provenance)?;
    let stopped = done.outcome.stopped || done.laws.stopped;
    Ok((summary(&done, wanted.laws), done.path, stopped))
}

/// What `--json` prints of a run; `laws`: also of the scene's laws and loops.
pub fn summary(done: &Done, laws: bool) -> Value {
    let mut summary = json!(done.summary);
    if done.outcome.listed > 0 {
        summary["points"] = json!(listed::points(&done.outcome));
    }
    let all = &done.laws;
    let feedback = all.feedback.as_ref();
    let parts = [
        (
            "feedback",
            json!(feedback.map(|f| FittedSummary::all(&f.fitted, &f.exports))),
        ),
        (
            "closed_loop",
            json!((all.closed_loop.as_ref()).map(|e| EvaluationSummary::new(e, &done.path))),
        ),
        (
            "dissipation",
            json!(all.dissipation.as_ref().map(DissipationSummary::new)),
        ),
        (
            "attenuation",
            json!(all.attenuation.as_ref().map(AttenuationSummary::new)),
        ),
    ];
    for (name, part) in parts.into_iter().filter(|_| laws) {
        summary[name] = part;
    }
    summary
}

/// The answers as a table; there is no result file.
fn to_table(
    session: &Session<'_>,
    wanted: &Wanted,
    path: &Path,
    provenance: &Provenance,
) -> Result<(Value, PathBuf, bool), CliError> {
    let model = &session.scene().model;
    let pass = session.prepare(wanted)?;
    session
        .progress()
        .begun(model, pass.plan(), session.backend());
    // What is wrong with the name is told before the work is done.
    let path = target(path)?;
    let outcome = pass.perform::<SessionError>(&mut |_| Ok(()))?;
    let path = match outcome.stopped {
        true => path_of_stopped(&path),
        false => path,
    };
    if outcome.stopped {
        note_replaced(session, &path);
    }
    let mut summary = json!(session.summary(&outcome, &path, provenance.seconds()));
    summary["points"] = json!(listed::points(&outcome));
    write_text(&path, &listed::table(&outcome, model)?)?;
    session
        .progress()
        .finished(Finished::Solved(&outcome, model));
    Ok((summary, path, outcome.stopped))
}
