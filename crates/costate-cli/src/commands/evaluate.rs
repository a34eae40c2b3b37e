//! `costate evaluate`: laws simulated side by side.

use crate::args::EvaluateArgs;
use crate::common::ending::Ending;
use crate::common::load::loaded;
use crate::common::{Kind, check_out, note_ended_early, print_json, provenance, shard};
use crate::error::{CliError, ShardRefusal};
use crate::terminal::Terminal;
use costate::low_level::closed_loop::Weights;
use costate::low_level::result::Stored;
use costate::run::{
    LoopsDone, Provenance, evaluate as simulate, evaluate_shard, other_scene, output_of, weights,
};
use costate::session::summary::{DissipationSummary, EvaluationSummary};
use costate::session::{LoopOptions, Session, SessionError};
use serde_json::json;
use std::path::{Path, PathBuf};

pub fn evaluate(args: &EvaluateArgs) -> Result<(), CliError> {
    let provenance = provenance();
    let inputs = [&args.file]
        .into_iter()
        .chain(&args.scene)
        .chain(&args.weights);
    let inputs: Vec<&Path> = inputs.map(PathBuf::as_path).collect();
    check_out(args.out.as_deref(), &[Kind::Result], &inputs)?;

    let is_scene = args
        .file
        .extension()
        .is_some_and(|end| end.eq_ignore_ascii_case("toml"));
    let stored = (!is_scene).then(|| Stored::open(&args.file)).transpose()?;
    let terminal = Terminal::new(args.print);
    (stored.iter()).for_each(|stored| note_ended_early(stored, &terminal));
    if stored.is_some() && args.scene.is_none() && !args.set.is_empty() {
        return Err(CliError::SetOfResult);
    }
    let other = match (&stored, &args.scene) {
        (Some(_), None) => None,
        (Some(stored), Some(scene)) => Some(other_scene(stored, scene, &args.set)?),
        (None, _) => Some(loaded(&args.file, &args.set)?),
    };
    let own = stored.as_ref().map(|stored| &stored.scene);
    let scene = other.as_ref().or(own).ok_or(SessionError::NoClosedLoop)?;
    if scene.model.closed_loop.is_none() && scene.model.dissipation.is_none() {
        return Err(SessionError::NoClosedLoop.into());
    }

    let added: Vec<Weights> = (args.weights.iter())
        .map(|path| weights(path).map_err(SessionError::from))
        .collect::<Result<_, _>>()?;
    let options = LoopOptions {
        laws: (!args.laws.is_empty()).then(|| args.laws.clone()),
        random: args.random,
        solve: args.solve,
    };
    let session = Session::on(scene, args.numerics.open(&scene.model)?)
        .choosing(args.numerics.choices(args.seed))
        .with_progress(&terminal);
    let out = args.out.as_deref();
    let shard = shard::of(args.part, &terminal)?;
    if shard.is_some() || args.part.resume {
        let own = || {
            let ending = format!("_closed_loop{}", shard::ending(shard));
            shard.map(|_| output_of(Path::new(&scene.model.file_name), &ending))
        };
        let out = &(out.map(Path::to_owned).or_else(own)).ok_or(ShardRefusal::NoOut)?;
        let ending = Ending::of_loops(args, &provenance);
        let session = session.until(ending.deadline);
        let part = (shard, shard::resume(args.part));
        let laws = (stored.as_ref(), added);
        let done = evaluate_shard(&session, laws, &options, part, out, &provenance)?;
        terminal.ended()?;
        return finished(args, (&done, &provenance), &terminal, &ending);
    }
    if args.time_limit.is_some() {
        return Err(ShardRefusal::NoLimit.into());
    }
    let done = simulate(&session, stored.as_ref(), added, &options, out, &provenance)?;
    terminal.ended()?;

    if args.print.json {
        let file = done.path.display().to_string();
        let mut summary = match &done.closed_loop {
            Some(evaluation) => json!(EvaluationSummary::new(evaluation, &done.path)),
            None => json!({ "file": file }),
        };
        if let Some(check) = &done.dissipation {
            summary["dissipation"] = json!(DissipationSummary::new(check));
        }
        print_json(&summary)?;
    }
    let (seconds, path) = (provenance.seconds(), done.path.display());
    Ok(terminal.say(&format!("{seconds:.2} s, written to {path}"))?)
}

/// Tells of a part.
fn finished(
    args: &EvaluateArgs,
    (done, provenance): (&LoopsDone, &Provenance),
    terminal: &Terminal,
    ending: &Ending,
) -> Result<(), CliError> {
    let path = &done.path;
    if args.print.json {
        let summary = match &done.evaluation {
            Some(evaluation) => json!(EvaluationSummary::new(evaluation, path)),
            None => json!({ "file": path.display().to_string() }),
        };
        print_json(&summary)?;
    }
    let (seconds, shown) = (provenance.seconds(), path.display());
    terminal.say(&format!("{seconds:.2} s, written to {shown}"))?;
    match done.stopped {
        true => Err(ending.stopped(path.clone())),
        false => Ok(()),
    }
}
