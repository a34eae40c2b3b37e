//! Parts of `[attenuation]`: the search, and levels that are asked for.

use super::super::{Provenance, RunError, write_attenuation};
use super::before::{Before, create_part, note_kept};
use super::manifest::{Kind, Manifest};
use super::source::Source;
use super::{write_manifest, write_whole};
use crate::attenuation::{Attenuated, Levels, Outcome, Row};
use crate::files::{Draft, target};
use crate::hdf5::ResultFile;
use crate::result::ShardGroups;
use crate::schema;
use crate::session::summary::RunSummary;
use crate::session::{Finished, Resume, Session, SessionError, Shard};
use crate::value::PointStatus;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Rows by the bits of their levels, which are not negative and rise with them.
type Rows = BTreeMap<u64, Outcome>;

/// What came of it.
pub struct LevelsDone {
    /// What was found, of a whole that was made here.
    pub found: Option<Attenuated>,
    /// Levels that were looked at.
    pub levels: usize,
    /// Whether not all were done.
    pub stopped: bool,
    /// The file.
    pub path: PathBuf,
}

/// Looks at the levels of the scene's `[attenuation]`, or at those of a shard, keeping what is done.
///
/// # Errors
/// Those of the levels, of what was kept before, and of writing.
pub fn levels(
    session: &Session<'_>,
    (shard, resume): (Option<Shard>, Resume),
    path: &Path,
    provenance: &Provenance,
) -> Result<LevelsDone, RunError> {
    let path = target(path)?;
    drop(Draft::begin(&path)?);
    let all = session.levels()?;
    let units = all.units();
    let manifest = Manifest::of_units(Kind::Attenuation, session, (shard, units), provenance);
    let mut before = Before::at(&path, &manifest, resume)?;
    if before.finished.is_some() {
        before.note_finished(session);
        before.clear(&manifest);
        return Ok(LevelsDone {
            found: None,
            levels: 0,
            stopped: false,
            path,
        });
    }
    let part = Part {
        session,
        all: &all,
        manifest: &manifest,
        provenance,
    };
    let (mut rows, mut done) = (Rows::new(), Vec::new());
    for source in &before.sources {
        rows.extend(read(source, &all)?);
        done.extend(source.units_done());
    }
    if !rows.is_empty() {
        let note = format!("{} levels were looked at before", rows.len());
        session.progress().note(&note);
    }
    let own = shard.map_or_else(|| (0..units).collect(), |shard| shard.own(units));
    let left: Vec<usize> = own.into_iter().filter(|k| !done.contains(k)).collect();

    let (mut last, mut stopped) = (Instant::now(), false);
    for (k, unit) in left.iter().enumerate() {
        let found = match session.level_rows(&all, *unit) {
            Err(_) if session.is_over() => {
                stopped = true;
                break;
            }
            found => found?,
        };
        rows.extend(
            found
                .into_iter()
                .map(|row| (row.value.to_bits(), row.outcome)),
        );
        done.push(*unit);
        let is_last = k + 1 == left.len();
        if before.every.is_some_and(|every| last.elapsed() >= every) && !is_last {
            let kept = part.write(&rows, &done, (&before.unfinished, true));
            note_kept(session, &before.unfinished, kept.map(drop));
            last = Instant::now();
        }
    }

    let count = rows.len();
    let to = before.place(session, &manifest, stopped);
    let (path, found) = match shard.is_some() || stopped {
        true => (part.write(&rows, &done, (&to, stopped))?, None),
        false => {
            let found = whole(session, &all, &rows)?;
            let mut file = ResultFile::create(&to)?;
            write_attenuation(&mut file, &session.scene().model, &found)?;
            write_whole(&file, &manifest)?;
            (session.finish(file, provenance)?, Some(found))
        }
    };
    if let Some(found) = &found {
        session.progress().finished(Finished::Attenuation(found));
    }
    if !stopped {
        before.clear(&manifest);
    }
    Ok(LevelsDone {
        found,
        levels: count,
        stopped,
        path,
    })
}

/// A part on its way into a file.
struct Part<'p> {
    session: &'p Session<'p>,
    all: &'p Levels<'p>,
    manifest: &'p Manifest,
    provenance: &'p Provenance,
}

impl Part<'_> {
    fn write(
        &self,
        rows: &Rows,
        done: &[usize],
        (to, stopped): (&Path, bool),
    ) -> Result<PathBuf, RunError> {
        let mut file = create_part(to, self.manifest)?;
        if !rows.is_empty() {
            let row = |(value, outcome): (&u64, &Outcome)| Row {
                value: f64::from_bits(*value),
                outcome: outcome.clone(),
            };
            let found = self.all.part(rows.iter().map(row).collect());
            write_attenuation(&mut file, &self.session.scene().model, &found)?;
        }
        let mut done: Vec<i32> = (done.iter())
            .map(|k| i32::try_from(*k).unwrap_or(i32::MAX))
            .collect();
        done.sort_unstable();
        file.shard(&ShardGroups {
            done: vec![1; done.len()],
            states: vec![0; done.len()],
            number: done,
            ..ShardGroups::default()
        })?;
        write_manifest(&file, self.manifest)?;
        if stopped {
            file.attribute("stopped", 1i64)?;
        }
        self.session.finish(file, self.provenance)
    }
}

/// Searches among rows that are known; what is not among them, since coverage is not as larger
/// levels tell, is looked at now.
fn whole(session: &Session<'_>, all: &Levels<'_>, rows: &Rows) -> Result<Attenuated, SessionError> {
    let progress = session.progress();
    let mut done = rows.len();
    let mut shown = |what: &str| progress.step(&format!("attenuation: {what}"));
    let found = all.searched(&mut |value: f64| match rows.get(&value.to_bits()) {
        Some(outcome) => Ok(outcome.clone()),
        None => all.looked_at(value, &mut done, &mut shown),
    });
    if done > rows.len() {
        progress.step_ended();
        progress.note(&format!(
            "{} levels that no part has looked at, as coverage falls with a rising level somewhere, were looked at now",
            done - rows.len()
        ));
    }
    Ok(found?)
}

/// Puts parts of levels together.
///
/// # Errors
/// Of reading and writing.
pub(super) fn assemble(
    session: &Session<'_>,
    sources: &[Source],
    out: &Path,
    provenance: &Provenance,
) -> Result<(PathBuf, RunSummary), RunError> {
    let all = session.levels()?;
    let mut rows = Rows::new();
    for source in sources {
        rows.extend(read(source, &all)?);
    }
    let found = whole(session, &all, &rows)?;
    let model = &session.scene().model;
    let mut file = ResultFile::create(out)?;
    write_attenuation(&mut file, model, &found)?;
    write_whole(&file, &sources[0].manifest)?;
    let path = session.finish(file, provenance)?;
    session.progress().finished(Finished::Attenuation(&found));
    let summary = RunSummary {
        title: model.title.clone(),
        file: path.display().to_string(),
        ..RunSummary::default()
    };
    Ok((path, summary))
}

/// The rows of a part.
fn read(source: &Source, all: &Levels<'_>) -> Result<Rows, RunError> {
    let stored = &source.stored;
    let Some(regions) = stored.group(&schema::ATTENUATION_REGIONS) else {
        return Ok(Rows::new());
    };
    let damaged = || source.damaged(schema::ATTENUATION_REGIONS.name);
    let curve = stored.group(&schema::ATTENUATION).ok_or_else(damaged)?;
    let n = stored.scene.model.states.len();
    let levels = regions.f64("level")?.values;
    let (rows, states) = (levels.len(), all.states());
    let (swept, values) = (curve.codes("swept", rows)?, curve.f64("value")?.values);
    let (status, v) = (
        regions.codes("status", rows * states)?,
        regions.f64("V")?.values,
    );
    if values != levels || v.len() != rows * states {
        return Err(damaged());
    }
    let mut folds = vec![Vec::new(); rows];
    if let Some(caustic) = stored.group(&schema::ATTENUATION_CAUSTIC) {
        let (index, x) = (caustic.i32("level_index")?.1, caustic.f64("x")?.values);
        if x.len() != index.len() * n {
            return Err(damaged());
        }
        for (k, x) in index.iter().zip(x.chunks_exact(n)) {
            let of = usize::try_from(*k).ok().and_then(|k| folds.get_mut(k));
            of.ok_or_else(damaged)?.push(x.to_vec());
        }
    }
    let known = |code: &i32| (PointStatus::ALL.iter()).find(|(s, _)| *s as i32 == *code);
    let mut found = Rows::new();
    for (k, folds) in folds.into_iter().enumerate() {
        let here = k * states..(k + 1) * states;
        let status = status[here.clone()]
            .iter()
            .map(|code| known(code).map(|(s, _)| *s));
        let outcome = Outcome {
            status: status.collect::<Option<_>>().ok_or_else(damaged)?,
            v: v[here].to_vec(),
            folds,
            failure: (swept[k] == 0).then(|| "the scene cannot be swept there".to_owned()),
        };
        found.insert(levels[k].to_bits(), outcome);
    }
    Ok(found)
}
