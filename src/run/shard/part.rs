//! A run of which what is done can be kept, and gone on with: a part of the whole, or all of it.

use super::super::{
    Done, LawsDone, Provenance, RunError, in_json, trajectory_schema, write_errors, write_outcome,
    write_sampled,
};
use super::before::{Before, create_part, note_kept};
use super::manifest::Manifest;
use super::source::Source;
use super::whole::{Into, assemble};
use super::{write_manifest, write_states, write_whole};
use crate::backend::cpu::Cpu;
use crate::files::{Draft, target};
use crate::hdf5::ResultFile;
use crate::result::{RunRecord, TrajectorySchema};
use crate::session::summary::RunSummary;
use crate::session::{
    Checkpoint, Finished, Outcome, Part, Pass, Session, SessionError, SoFar, Wanted,
};
use crate::sweep::Plan;
use crate::value::Answers;
use std::path::{Path, PathBuf};

/// What a run is.
#[derive(Clone)]
struct Work<'s> {
    session: &'s Session<'s>,
    wanted: Wanted,
    provenance: Provenance,
    manifest: Manifest,
    schema: TrajectorySchema,
}

/// Runs a pass over states, keeping what is done; another pass as it is.
///
/// # Errors
/// Those of the pass, of what was kept before, and of writing.
pub(in crate::run) fn run<'s>(
    session: &'s Session<'s>,
    wanted: &Wanted,
    (mut pass, path): (Pass<'s>, &Path),
    provenance: &Provenance,
) -> Result<Done, RunError> {
    let model = &session.scene().model;
    if wanted.shard.is_some() && pass.maps() {
        return Err(SessionError::NotDivided.into());
    }
    let Some(states) = pass.states() else {
        return session.run_whole(wanted, pass, (path, None), provenance);
    };
    let work = Work {
        manifest: Manifest::of(session, wanted, &states, provenance),
        schema: trajectory_schema(model, pass.plan()),
        wanted: wanted.clone(),
        provenance: provenance.clone(),
        session,
    };
    let path = target(path)?;
    // What is wrong with the place is told before the work is done.
    drop(Draft::begin(&path)?);
    let mut before = Before::at(&path, &work.manifest, wanted.resume)?;
    if let Some(stored) = &before.finished {
        before.note_finished(session);
        before.clear(&work.manifest);
        let outcome = pass.nothing();
        return Ok(Done {
            record: work.record(&outcome.plan),
            laws: LawsDone::default(),
            summary: stored.run_summary()?.unwrap_or_default(),
            outcome,
            path,
        });
    }
    (session.progress()).begun(model, pass.plan(), session.backend());
    let done: Vec<usize> = (before.sources.iter())
        .flat_map(Source::units_done)
        .collect();
    if !done.is_empty() {
        let some = match done.len() {
            1 => "1 block of states was".to_owned(),
            some => format!("{some} blocks of states were"),
        };
        let note = format!("{some} done before; what is told below is of the others");
        session.progress().note(&note);
    }
    pass.without(done);
    if let Some(every) = before.every {
        let (work, kept) = (work.clone(), before.kept.clone());
        let to = before.unfinished.clone();
        let keep = move |so_far: &SoFar<'_>| {
            note_kept(work.session, &to, work.keep(so_far, &kept, &to));
        };
        pass.keeping(Checkpoint::new(every, Box::new(keep)));
    }

    let outcome = pass.perform::<RunError>(&mut |_| Ok(()))?;
    let (path, summary) = work.write(&outcome, &mut before)?;
    (session.progress()).finished(Finished::Solved(&outcome, model));
    match (outcome.stopped, &outcome.part) {
        (false, _) => before.clear(&work.manifest),
        (true, Some(part)) if !part.is_done.contains(&true) => session.progress().note(
            "no block of states was finished in this time, and nothing of a block is kept before: with --resume and the same time limit no more would be",
        ),
        (true, _) => {}
    }
    Ok(Done {
        record: work.record(&outcome.plan),
        laws: LawsDone::default(),
        outcome,
        summary,
        path,
    })
}

impl Work<'_> {
    /// Keeps what is done by now, with what was done before.
    fn keep(&self, so_far: &SoFar<'_>, before: &[PathBuf], to: &Path) -> Result<(), RunError> {
        let before = (before.iter())
            .map(|path| Source::open(path))
            .collect::<Result<Vec<_>, _>>()?;
        let states = (so_far.plan, so_far.answers, so_far.part);
        self.write_part(states, (before, true), to, &mut |_| Ok(None))?;
        Ok(())
    }

    /// Writes what came of a run, with what was done before.
    fn write(
        &self,
        outcome: &Outcome,
        before: &mut Before,
    ) -> Result<(PathBuf, RunSummary), RunError> {
        let (Some(answers), Some(part)) = (&outcome.answers, &outcome.part) else {
            // Nothing was come to.
            return Err(SessionError::Backend(crate::backend::BackendError::OutOfTime).into());
        };
        let model = &self.session.scene().model;
        let sources = std::mem::take(&mut before.sources);
        let to = &before.place(self.session, &self.manifest, outcome.stopped);
        if sources.is_empty() && !outcome.stopped && self.wanted.shard.is_none() {
            let mut file = ResultFile::create(to)?;
            write_outcome(&mut file, outcome, model, &self.schema)?;
            let summary = self.summary(outcome, to);
            write_errors(&file, &summary)?;
            file.attribute("summary", in_json(&summary))?;
            write_whole(&file, &self.manifest)?;
            self.record(&outcome.plan).write(&file)?;
            return Ok((file.finish()?, summary));
        }
        let states = (&outcome.plan, answers, part);
        let mut more = |file: &mut ResultFile| {
            write_sampled(file, outcome, &self.schema)?;
            // Whoever looks at the map of a run that was ended finds it.
            if let (Some(targets), None) = (&outcome.targets, self.wanted.shard)
                && let Some(grid) = targets.map_grid().filter(|_| has_all(part))
            {
                let value_max = model.map.as_ref().and_then(|m| m.value_max);
                file.map(&self.schema, answers, grid, targets.points(), value_max)?;
            }
            if let Some(made) = &outcome.mapped {
                file.map_pieces(&self.schema, model.time_name(), made)?;
            }
            Ok(Some(self.summary(outcome, to)))
        };
        self.write_part(states, (sources, outcome.stopped), to, &mut more)
    }

    /// Writes a part, with others of the same shard, as one part; or, if that is all there is, as
    /// the whole.
    fn write_part(
        &self,
        states: (&Plan, &Answers, &Part),
        (before, stopped): (Vec<Source>, bool),
        to: &Path,
        more: More<'_>,
    ) -> Result<(PathBuf, RunSummary), RunError> {
        if before.is_empty() {
            let file = create_part(to, &self.manifest)?;
            return self.write_states(file, states, stopped, more);
        }
        let draft = Draft::begin(to)?;
        let file = ResultFile::create(draft.hidden())?;
        self.write_states(file, states, stopped, more)?;
        let mut sources = before;
        sources.push(Source::open(draft.hidden())?);
        let into = match self.wanted.shard.is_none() && !stopped {
            true => Into::Whole(None),
            false => Into::Part(&self.manifest, !stopped),
        };
        let here = Session::on(self.session.scene(), Box::new(Cpu::new()));
        assemble(&here, &sources, into, to, &self.provenance)
    }

    fn write_states(
        &self,
        mut file: ResultFile,
        (plan, answers, part): (&Plan, &Answers, &Part),
        stopped: bool,
        more: More<'_>,
    ) -> Result<(PathBuf, RunSummary), RunError> {
        write_states(&mut file, &self.schema, (answers, part))?;
        write_manifest(&file, &self.manifest)?;
        if stopped {
            file.attribute("stopped", 1i64)?;
        }
        let summary = more(&mut file)?;
        if let Some(summary) = &summary {
            write_errors(&file, summary)?;
            file.attribute("summary", in_json(summary))?;
        }
        self.record(plan).write(&file)?;
        Ok((file.finish()?, summary.unwrap_or_default()))
    }

    fn summary(&self, outcome: &Outcome, path: &Path) -> RunSummary {
        (self.session).summary(outcome, path, self.provenance.seconds())
    }

    fn record(&self, plan: &Plan) -> RunRecord {
        self.session.record_of(plan, &self.provenance)
    }
}

/// Writes what else a run has, and tells its summary.
type More<'m> = &'m mut dyn FnMut(&mut ResultFile) -> Result<Option<RunSummary>, RunError>;

/// Whether a part has all states that were asked for.
fn has_all(part: &Part) -> bool {
    part.block_of.len() == part.rows
}
