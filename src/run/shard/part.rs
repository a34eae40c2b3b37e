//! A run of which what is done can be kept, and gone on with: a part of the whole, or all of it.

use super::super::{
    Done, LawsDone, Provenance, RunError, in_json, note_replaced, path_of_stopped,
    trajectory_schema, write_estimates, write_outcome, write_sampled,
};
use super::manifest::Manifest;
use super::merge::MergeError;
use super::source::Source;
use super::whole::{Into, assemble};
use super::{write_manifest, write_states};
use crate::backend::cpu::Cpu;
use crate::files::{Draft, target};
use crate::hdf5::ResultFile;
use crate::result::{RunRecord, TrajectorySchema};
use crate::session::summary::RunSummary;
use crate::session::{
    Checkpoint, Finished, Outcome, Part, Pass, Resume, Session, SessionError, SoFar, Wanted,
};
use crate::sweep::Plan;
use crate::value::Answers;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// What a run is, and where it goes.
#[derive(Clone)]
struct Work<'s> {
    session: &'s Session<'s>,
    wanted: Wanted,
    provenance: Provenance,
    manifest: Manifest,
    schema: TrajectorySchema,
    /// The result, and where it is while it is not finished.
    path: PathBuf,
    unfinished: PathBuf,
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
        return session.run_whole(wanted, pass, path, provenance);
    };
    let path = target(path)?;
    let mut work = Work {
        unfinished: path_of_stopped(&path),
        manifest: Manifest::of(session, wanted, &states, provenance),
        schema: trajectory_schema(model, pass.plan()),
        wanted: wanted.clone(),
        provenance: provenance.clone(),
        session,
        path,
    };
    // What is wrong with the place is told before the work is done.
    drop(Draft::begin(&work.path)?);
    let before = match wanted.resume {
        Resume::Now(_) => work.before()?,
        Resume::Never | Resume::Later(_) => Vec::new(),
    };
    if before.iter().any(|source| source.stored.path == work.path) {
        work.unfinished.clone_from(&work.path);
    }
    (session.progress()).begun(model, pass.plan(), session.backend());
    let done: Vec<usize> = before.iter().flat_map(Source::units_done).collect();
    if !done.is_empty() {
        let (some, of) = (done.len(), work.manifest.units);
        let note = format!("{some} blocks of states, of {of} in all, were done before");
        session.progress().note(&note);
    }
    pass.without(done);
    let kept: Vec<PathBuf> = before
        .iter()
        .map(|source| source.stored.path.clone())
        .collect();
    if let Resume::Later(seconds) | Resume::Now(seconds) = wanted.resume {
        let every = Duration::from_secs(seconds.into());
        let (work, kept) = (work.clone(), kept.clone());
        let keep = move |so_far: &SoFar<'_>| work.keep(so_far, &kept);
        pass.keeping(Checkpoint::new(every, Box::new(keep)));
    }

    let outcome = pass.perform::<RunError>(&mut |_| Ok(()))?;
    let (path, summary) = work.write(&outcome, before)?;
    (session.progress()).finished(Finished::Solved(&outcome, model));
    if !outcome.stopped {
        work.clear(&kept);
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
    /// What earlier runs of the same have kept.
    fn before(&self) -> Result<Vec<Source>, RunError> {
        let mut found = Vec::new();
        let beside = super::super::stopped_beside(&self.path);
        for path in [&self.path, &beside]
            .into_iter()
            .filter(|path| path.exists())
        {
            let source = match Source::open(path) {
                Ok(source) => source,
                // The whole, or something else: it is not gone on with.
                Err(RunError::Merge(MergeError::NoPart { .. })) => continue,
                Err(error) => return Err(error),
            };
            source.is_of(&self.manifest)?;
            found.push(source);
        }
        Ok(found)
    }

    /// Keeps what is done by now; what is wrong with that is said, and the work goes on.
    fn keep(&self, so_far: &SoFar<'_>, before: &[PathBuf]) {
        let kept = || -> Result<(), RunError> {
            let before = (before.iter())
                .map(|path| Source::open(path))
                .collect::<Result<Vec<_>, _>>()?;
            let states = (so_far.plan, so_far.answers, so_far.part);
            self.write_part(states, (before, true), &self.unfinished, &mut |_| Ok(None))?;
            Ok(())
        };
        if let Err(error) = kept() {
            let path = self.unfinished.display();
            (self.session.progress()).note(&format!(
                "what is done could not be kept in {path}: {error}"
            ));
        }
    }

    /// Writes what came of a run, with what was done before.
    fn write(
        &self,
        outcome: &Outcome,
        before: Vec<Source>,
    ) -> Result<(PathBuf, RunSummary), RunError> {
        let (Some(answers), Some(part)) = (&outcome.answers, &outcome.part) else {
            // Nothing was come to.
            return Err(SessionError::Backend(crate::backend::BackendError::OutOfTime).into());
        };
        let model = &self.session.scene().model;
        let to = match outcome.stopped {
            true => &self.unfinished,
            false => &self.path,
        };
        if outcome.stopped && before.is_empty() {
            note_replaced(self.session, to);
        }
        if before.is_empty() && !outcome.stopped && self.wanted.shard.is_none() {
            let mut file = ResultFile::create(to)?;
            write_outcome(&mut file, outcome, model, &self.schema)?;
            write_estimates(&file, &outcome.estimates)?;
            let summary = self.summary(outcome, to);
            file.attribute("summary", in_json(&summary))?;
            self.record(&outcome.plan).write(&file)?;
            return Ok((file.finish()?, summary));
        }
        let states = (&outcome.plan, answers, part);
        let mut more = |file: &mut ResultFile| {
            write_sampled(file, outcome, &self.schema)?;
            write_estimates(file, &outcome.estimates)?;
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
        self.write_part(states, (before, outcome.stopped), to, &mut more)
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
            let file = ResultFile::create(to)?;
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
            file.attribute("summary", in_json(summary))?;
        }
        self.record(plan).write(&file)?;
        Ok((file.finish()?, summary.unwrap_or_default()))
    }

    /// Removes what was kept of a run that is in its result now.
    fn clear(&self, kept: &[PathBuf]) {
        let others = kept.iter().chain([&self.unfinished]);
        for other in others.filter(|other| **other != self.path && other.exists()) {
            let is_ours = Source::open(other).is_ok_and(|s| s.manifest == self.manifest);
            if is_ours {
                let _ = std::fs::remove_file(other);
            }
        }
    }

    fn summary(&self, outcome: &Outcome, path: &Path) -> RunSummary {
        (self.session).summary(outcome, path, self.provenance.seconds())
    }

    fn record(&self, plan: &Plan) -> RunRecord {
        RunRecord {
            precision: plan.spec.precision.name().to_owned(),
            method: plan.method().name().to_owned(),
            rtol: plan.run.rtol,
            atol: plan.atol,
            ..self.session.record(&self.provenance)
        }
    }
}

/// Writes what else a run has, and tells its summary.
type More<'m> = &'m mut dyn FnMut(&mut ResultFile) -> Result<Option<RunSummary>, RunError>;

/// Whether a part has all states that were asked for.
fn has_all(part: &Part) -> bool {
    part.block_of.len() == part.rows
}
