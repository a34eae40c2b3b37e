//! Parts of a sweep: each is one of the surface of seeds, and a file of trajectories like that of the
//! whole.

use super::super::{Provenance, RunError, in_json, trajectory_schema, write_errors};
use super::before::{Before, create_part};
use super::manifest::{Asked, Kind, Manifest};
use super::merge::MergeError;
use super::rows::{Layout, Rows, Sink};
use super::source::Source;
use super::whole::{Gaps, note_gaps, record};
use super::{write_manifest, write_whole};
use crate::hdf5::ResultFile;
use crate::result::{ShardGroups, TrajectorySchema};
use crate::schema;
use crate::session::summary::{Quantiles, RunSummary, larger};
use crate::session::{Kept, Session, SessionError, Wanted};
use crate::sweep::{Choices, FoldPoint, Plan};
use std::path::{Path, PathBuf};

/// Trajectories that are held at once.
const AT_ONCE: usize = 1024;

/// A sweep that is a part, or that counts as done when it is there.
pub(in crate::run) struct PartOfSweep {
    manifest: Manifest,
    before: Before,
    divided: bool,
}

impl PartOfSweep {
    /// What is asked for, and what an earlier run has left of it.
    ///
    /// # Errors
    /// Where there is something else.
    pub fn new(
        session: &Session<'_>,
        wanted: &Wanted,
        (plan, path): (&Plan, &Path),
        provenance: &Provenance,
    ) -> Result<Self, RunError> {
        let manifest = Manifest::of_sweep(session, wanted, plan, provenance);
        let mut before = Before::at(path, &manifest, wanted.resume)?;
        if !before.sources.is_empty() {
            session
                .progress()
                .note("a sweep that was ended before it was done begins again");
        }
        before.sources.clear();
        Ok(Self {
            divided: wanted.shard.is_some(),
            manifest,
            before,
        })
    }

    /// What tells of the work, where it is done.
    ///
    /// # Errors
    /// Of reading.
    pub fn finished(&self, session: &Session<'_>) -> Result<Option<RunSummary>, RunError> {
        let Some(stored) = &self.before.finished else {
            return Ok(None);
        };
        self.before.note_finished(session);
        self.before.clear(&self.manifest);
        Ok(Some(stored.run_summary()?.unwrap_or_default()))
    }

    /// Begins its file.
    ///
    /// # Errors
    /// Those of writing.
    pub fn create(&self, path: &Path) -> Result<ResultFile, RunError> {
        match self.divided {
            true => create_part(path, &self.manifest),
            false => Ok(ResultFile::create(path)?),
        }
    }

    /// Notes in the file what it is, with so many trajectories; where it goes.
    ///
    /// # Errors
    /// Those of writing.
    pub fn note(
        &mut self,
        session: &Session<'_>,
        file: &mut ResultFile,
        (trajectories, stopped): (usize, bool),
    ) -> Result<PathBuf, RunError> {
        let to = self.before.place(session, &self.manifest, stopped);
        if to != file.path() {
            file.rename(to.clone());
        }
        if stopped {
            file.attribute("stopped", 1i64)?;
        }
        if !self.divided {
            write_whole(file, &self.manifest)?;
            return Ok(to);
        }
        let count = |n: usize| i32::try_from(n).unwrap_or(i32::MAX);
        file.shard(&ShardGroups {
            number: vec![count(self.manifest.shard)],
            done: vec![i32::from(!stopped)],
            states: vec![count(trajectories)],
            ..ShardGroups::default()
        })?;
        write_manifest(file, &self.manifest)?;
        Ok(to)
    }

    /// Removes what an earlier run has left, once all is done.
    pub fn done(&self) {
        self.before.clear(&self.manifest);
    }
}

impl Source {
    /// How many trajectories a part of a sweep has.
    fn trajectories(&self) -> usize {
        self.states.iter().map(|k| (*k).max(0) as usize).sum()
    }
}

impl Manifest {
    /// Of a part of a sweep.
    fn of_sweep(
        session: &Session<'_>,
        wanted: &Wanted,
        plan: &Plan,
        provenance: &Provenance,
    ) -> Self {
        let kept = match wanted.kept {
            Kept::All => "with all that belongs to them",
            Kept::Values => "x and V alone",
            Kept::Nothing => "not stored",
        };
        Self {
            asked: Asked {
                kept: Some(kept.to_owned()),
                ..Asked::default()
            },
            precision: plan.spec.precision.name().to_owned(),
            method: plan.method().name().to_owned(),
            rtol: plan.rtol_asked,
            ..Self::begun(Kind::Sweep, session, (wanted.shard, 1), provenance)
        }
    }
}

/// Puts parts of a sweep together, in the order of their numbers.
///
/// # Errors
/// Of reading and writing.
pub(super) fn assemble(
    session: &Session<'_>,
    sources: &[Source],
    (gaps, out): (Gaps<'_>, &Path),
    provenance: &Provenance,
) -> Result<(PathBuf, RunSummary), RunError> {
    let mut sources: Vec<&Source> = sources.iter().collect();
    sources.sort_by_key(|source| source.manifest.shard);
    let (first, model) = (sources[0], &session.scene().model);
    let plan = session.plan(Choices {
        rtol: Some(first.manifest.rtol),
        ..Choices::default()
    })?;
    let schema = trajectory_schema(model, &plan);
    let parts = summaries(&sources)?;
    if gaps.is_none() && parts.iter().all(|part| part.trajectories == 0) {
        let outside = parts.iter().map(|p| p.coverage.seeds_outside_guards).sum();
        return Err(SessionError::NothingSwept { outside }.into());
    }
    let mut file = ResultFile::create(out)?;
    let drift = write_trajectories(&mut file, &schema, &sources)?;
    write_folds(&mut file, &schema, &sources)?;

    let mut summary = together(&parts);
    summary.file = out.display().to_string();
    summary.stopped = gaps.is_some();
    summary.shard = None;
    if !drift.is_empty() {
        summary.hamiltonian = Quantiles::of(&drift);
    }
    write_errors(&file, &summary)?;
    file.attribute("summary", in_json(&summary))?;
    if gaps.is_some() {
        file.attribute("stopped", 1i64)?;
    }
    note_gaps(&file, gaps)?;
    write_whole(&file, &first.manifest)?;
    record(first, &summary, provenance).write(&file)?;
    Ok((file.finish()?, summary))
}

/// What each part tells of itself.
fn summaries(sources: &[&Source]) -> Result<Vec<RunSummary>, RunError> {
    let of = |source: &&Source| -> Result<RunSummary, RunError> {
        let path = source.path();
        let summary = (source.stored.run_summary()?).ok_or(MergeError::NoSummary { path })?;
        match summary.trajectories == source.trajectories() {
            true => Ok(summary),
            false => Err(source.damaged(schema::SHARD.name)),
        }
    };
    sources.iter().map(of).collect()
}

/// Writes the trajectories of all parts; |H| along each.
fn write_trajectories(
    file: &mut ResultFile,
    schema: &TrajectorySchema,
    sources: &[&Source],
) -> Result<Vec<f64>, RunError> {
    let mut drift = Vec::new();
    let mut sink: Option<(Sink, Layout)> = None;
    let are_kept = sources
        .iter()
        .any(|s| s.stored.has_any(&[&schema::TRAJECTORIES]));
    for source in sources {
        let damaged = || source.damaged(schema::TRAJECTORIES.name);
        let Some(group) = source.stored.group(&schema::TRAJECTORIES) else {
            match are_kept && source.trajectories() > 0 {
                true => return Err(damaged()),
                false => continue,
            }
        };
        if sink.is_none() {
            let layout = Layout::of(&group, &schema::TRAJECTORIES)?;
            let of_values = group.column("V")?;
            let schema = TrajectorySchema {
                samples: of_values.inner.first().copied().unwrap_or(schema.samples),
                values_only: match group.attribute(None, "stored") {
                    Some(_) => Some([group.column("x")?.single, of_values.single]),
                    None => None,
                },
                ..schema.clone()
            };
            let writer = file.group(&schema.group()?)?;
            sink = Some((Sink::new(writer, layout.clone(), AT_ONCE, None), layout));
        }
        let Some((sink, layout)) = &mut sink else {
            continue;
        };
        let mut rows = Rows::new(&group, layout, AT_ONCE)?;
        if rows.count != source.trajectories() {
            return Err(damaged());
        }
        let of_drift = layout.place("hamiltonian_drift");
        while rows.at < rows.count {
            if let Some(place) = of_drift {
                drift.extend_from_slice(rows.reals(place)?);
            }
            sink.take(&mut rows)?;
            sink.flush_if_full()?;
            rows.advance();
        }
    }
    if let Some((mut sink, _)) = sink {
        sink.flush()?;
    }
    Ok(drift)
}

/// Writes the folds of all parts.
fn write_folds(
    file: &mut ResultFile,
    schema: &TrajectorySchema,
    sources: &[&Source],
) -> Result<(), RunError> {
    let n = schema.states.len();
    let (mut folds, mut first) = (Vec::new(), 0);
    for source in sources {
        let damaged = || source.damaged(schema::CAUSTIC.name);
        if let Some(group) = source.stored.group(&schema::CAUSTIC) {
            let (x, p) = (group.f64("x")?.values, group.f64("p")?.values);
            let (v, t) = (group.f64("V")?.values, group.f64("t")?.values);
            let of = group.i32("trajectory")?.1;
            if [x.len(), p.len()] != [of.len() * n; 2] || [v.len(), t.len()] != [of.len(); 2] {
                return Err(damaged());
            }
            for (k, trajectory) in of.iter().enumerate() {
                let trajectory = usize::try_from(*trajectory).map_err(|_| damaged())?;
                if trajectory >= source.trajectories() {
                    return Err(damaged());
                }
                folds.push(FoldPoint {
                    trajectory: first + trajectory,
                    t: t[k],
                    x: x[k * n..(k + 1) * n].to_vec(),
                    p: p[k * n..(k + 1) * n].to_vec(),
                    value: v[k],
                });
            }
        }
        first += source.trajectories();
    }
    Ok(file.caustic(schema, &folds)?)
}

/// The numbers of all parts: sums, and of errors the largest that a part has.
fn together(parts: &[RunSummary]) -> RunSummary {
    // What is told of no trajectories says nothing of those of the others.
    let (some, none): (Vec<_>, Vec<_>) = parts.iter().partition(|part| part.trajectories > 0);
    let mut parts = some.into_iter().chain(none);
    let Some(mut all) = parts.next().cloned() else {
        return RunSummary::default();
    };
    for part in parts {
        all.trajectories += part.trajectories;
        all.trajectories_borrowed += part.trajectories_borrowed;
        all.trajectories_stored |= part.trajectories_stored;
        for (status, count) in &part.status {
            *all.status.entry(status.clone()).or_insert(0) += count;
        }
        let (here, there) = (&mut all.coverage, &part.coverage);
        here.pairs += there.pairs;
        here.gaps_for_want_of_seeds += there.gaps_for_want_of_seeds;
        here.gaps_indistinguishable += there.gaps_indistinguishable;
        here.gaps_crowded += there.gaps_crowded;
        here.seeds_outside_guards += there.seeds_outside_guards;
        here.widest_gap = larger(here.widest_gap, there.widest_gap);
        here.steps = here.steps.zip(there.steps).map(|(a, b)| a.and(b));
        if part.trajectories > 0 {
            all.hamiltonian = all.hamiltonian.largest(part.hamiltonian);
            let relative = all.hamiltonian_relative.largest(part.hamiltonian_relative);
            all.hamiltonian_relative = relative;
        }
        all.error_estimate = match (all.error_estimate.take(), part.error_estimate.clone()) {
            (Some(a), Some(b)) => Some(a.largest(b)),
            (a, b) => a.or(b),
        };
        all.stiffness.stiff |= part.stiffness.stiff;
        all.steps += part.steps;
        all.rejected += part.rejected;
        all.rounds = all.rounds.max(part.rounds);
        all.integrate_seconds += part.integrate_seconds;
        all.wall_seconds += part.wall_seconds;
    }
    all.error_met = all.met();
    all.trajectories_per_second = all.trajectories as f64 / all.integrate_seconds.max(1e-9);
    all
}
