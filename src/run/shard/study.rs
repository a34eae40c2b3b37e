//! Parts of a study: variants of it.

use super::super::{Provenance, RunError, write_study};
use super::before::{Before, create_part, note_kept};
use super::manifest::{Kind, Manifest};
use super::merge::MergeError;
use super::source::Source;
use super::{write_manifest, write_whole};
use crate::files::{Draft, target};
use crate::hdf5::ResultFile;
use crate::model::{Model, Study};
use crate::result::{ShardGroups, Stored, StoredError};
use crate::schema;
use crate::session::summary::RunSummary;
use crate::session::{Resume, Session, SessionError, Shard};
use crate::study::{Variant, combinations};
use crate::trajectories::TrajectoryBlock;
use crate::value::PointStatus;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Variants by their numbers.
type Variants = BTreeMap<usize, Variant>;

/// What came of it.
pub struct StudyDone {
    /// The variants that are in the file.
    pub variants: Vec<Variant>,
    /// Whether not all were done.
    pub stopped: bool,
    /// The file.
    pub path: PathBuf,
}

/// Makes the scene's study, or a shard of it, keeping what is done.
///
/// # Errors
/// Those of the study, of what was kept before, and of writing.
pub fn study(
    session: &Session<'_>,
    (shard, resume): (Option<Shard>, Resume),
    path: &Path,
    provenance: &Provenance,
) -> Result<StudyDone, RunError> {
    let asked = session.scene().model.study.as_ref();
    let asked = asked.ok_or(SessionError::NoStudy)?;
    let count = combinations(asked).len();
    let path = target(path)?;
    drop(Draft::begin(&path)?);
    let manifest = Manifest::of_units(Kind::Study, session, (shard, count), provenance);
    let mut before = Before::at(&path, &manifest, resume)?;
    if let Some(stored) = &before.finished {
        before.note_finished(session);
        before.clear(&manifest);
        return Ok(StudyDone {
            variants: read(stored)?.into_values().collect(),
            stopped: false,
            path,
        });
    }
    let mut known = Variants::new();
    for source in &before.sources {
        let done: Vec<usize> = source.units_done().collect();
        let own = read(&source.stored)?.into_iter();
        known.extend(own.filter(|(k, _)| done.contains(k)));
    }
    if !known.is_empty() {
        let note = format!("{} variants were done before", known.len());
        session.progress().note(&note);
    }
    let own = shard.map_or_else(|| (0..count).collect(), |shard| shard.own(count));
    let left: Vec<usize> = own
        .iter()
        .copied()
        .filter(|k| !known.contains_key(k))
        .collect();

    let mut last = Instant::now();
    let part = Part {
        session,
        manifest: &manifest,
        provenance,
    };
    let mut keep = |done: &[Variant]| {
        let is_due = before.every.is_some_and(|every| last.elapsed() >= every);
        if !is_due || done.len() == left.len() {
            return;
        }
        let mut so_far = known.clone();
        so_far.extend(left.iter().copied().zip(done.iter().cloned()));
        let kept = part.write(&so_far, &before.unfinished, true).map(drop);
        note_kept(session, &before.unfinished, kept);
        last = Instant::now();
    };
    let made = session.some_variants(&left, &mut keep)?;
    known.extend(left.into_iter().zip(made));

    let stopped = session.is_over();
    let to = before.place(session, &manifest, stopped);
    let path = match shard.is_some() || stopped {
        true => part.write(&known, &to, stopped)?,
        false => part.whole(known.values(), &to)?,
    };
    if !stopped {
        before.clear(&manifest);
    }
    Ok(StudyDone {
        variants: known.into_values().collect(),
        stopped,
        path,
    })
}

/// A part on its way into a file.
struct Part<'p> {
    session: &'p Session<'p>,
    manifest: &'p Manifest,
    provenance: &'p Provenance,
}

impl Part<'_> {
    fn write(&self, variants: &Variants, to: &Path, stopped: bool) -> Result<PathBuf, RunError> {
        let mut file = create_part(to, self.manifest)?;
        let rows: Vec<Variant> = variants.values().cloned().collect();
        write_study(self.session, &mut file, (&rows, stopped), self.provenance)?;
        file.shard(&ShardGroups {
            number: variants.keys().map(|k| *k as i32).collect(),
            done: (rows.iter())
                .map(|v| i32::from(v.status != PointStatus::OutOfTime))
                .collect(),
            states: vec![0; rows.len()],
            ..ShardGroups::default()
        })?;
        write_manifest(&file, self.manifest)?;
        self.session.finish(file, self.provenance)
    }

    fn whole<'v>(
        &self,
        variants: impl Iterator<Item = &'v Variant>,
        to: &Path,
    ) -> Result<PathBuf, RunError> {
        let mut file = ResultFile::create(to)?;
        let rows: Vec<Variant> = variants.cloned().collect();
        write_study(self.session, &mut file, (&rows, false), self.provenance)?;
        write_whole(&file, self.manifest)?;
        self.session.finish(file, self.provenance)
    }
}

/// Puts parts of a study together.
///
/// # Errors
/// Of reading and writing.
pub(super) fn assemble(
    session: &Session<'_>,
    sources: &[Source],
    (gaps, out): (bool, &Path),
    provenance: &Provenance,
) -> Result<(ResultFile, RunSummary), RunError> {
    let model = &session.scene().model;
    let asked = model.study.as_ref().ok_or(SessionError::NoStudy)?;
    let mut all = Variants::new();
    for source in sources {
        all.extend(read(&source.stored)?);
    }
    for (k, parameters) in combinations(asked).into_iter().enumerate() {
        all.entry(k)
            .or_insert_with(|| Variant::without(model, asked, parameters, PointStatus::NotMerged));
    }
    let rows: Vec<Variant> = all.into_values().collect();
    let mut file = ResultFile::create(out)?;
    let summary = write_study(session, &mut file, (&rows, gaps), provenance)?;
    Ok((file, summary))
}

/// The variants in a part or in the whole, by their numbers.
fn read(stored: &Stored) -> Result<Variants, RunError> {
    let damaged = || MergeError::Damaged {
        path: stored.path.clone(),
        group: "study",
    };
    let model = &stored.scene.model;
    let asked = model.study.as_ref().ok_or_else(damaged)?;
    let combinations = combinations(asked);
    let numbers: Vec<usize> = match stored.group(&schema::SHARD) {
        Some(group) => (group.i32("number")?.1.iter())
            .map(|k| (*k).max(0) as usize)
            .collect(),
        None => (0..combinations.len()).collect(),
    };
    if numbers.is_empty() {
        return Ok(Variants::new());
    }
    let rows = rows(stored, model, asked, numbers.len())?;
    let mut found = Variants::new();
    for (number, variant) in numbers.into_iter().zip(rows) {
        let parameters = combinations.get(number);
        // They are those of the scene.
        let same = parameters.is_some_and(|own| *own == variant.parameters);
        if !same || found.insert(number, variant).is_some() {
            return Err(damaged().into());
        }
    }
    Ok(found)
}

/// The rows of `/study` with their trajectories.
fn rows(
    stored: &Stored,
    model: &Model,
    asked: &Study,
    count: usize,
) -> Result<Vec<Variant>, StoredError> {
    let no_group = |group: &schema::Group| StoredError::NoGroup {
        path: stored.path.clone(),
        group: group.name.to_owned(),
        hint: "",
    };
    let group = stored
        .group(&schema::STUDY)
        .ok_or_else(|| no_group(&schema::STUDY))?;
    let (n, m, samples) = (model.states.len(), model.controls.len(), asked.samples);
    let column = |name: &str| group.shaped(name, &[count]);
    let columns = |names: Vec<&str>| -> Result<Vec<Vec<f64>>, StoredError> {
        names.into_iter().map(column).collect()
    };
    let parameters = columns(asked.vary.iter().map(|(name, _)| name.as_str()).collect())?;
    let records = columns(asked.records.iter().map(|r| r.name.as_str()).collect())?;
    let (x0, u) = (
        group.shaped("x0", &[count, n])?,
        group.shaped("u", &[count, m])?,
    );
    let (value, duration) = (column("V")?, column("duration")?);
    let (status, sheets) = (group.codes("status", count)?, group.codes("sheets", count)?);

    let group = stored.group(&schema::STUDY_TRAJECTORIES);
    let group = group.ok_or_else(|| no_group(&schema::STUDY_TRAJECTORIES))?;
    let of = |name: &str, width: Option<usize>| {
        let shape = [&[count, samples][..], width.as_slice()].concat();
        group.shaped(name, &shape)
    };
    let (t, v) = (of("t", None)?, of("V", None)?);
    let (x, controls) = (of("x", Some(n))?, of("u", Some(m))?);

    let row = |k: usize| -> Option<Variant> {
        let part = |all: &[f64], width: usize| all[k * width..(k + 1) * width].to_vec();
        let status = PointStatus::ALL
            .iter()
            .find(|(s, _)| *s as i32 == status[k])?
            .0;
        let times = part(&t, samples);
        let is_there = times.iter().any(|t| !t.is_nan());
        Some(Variant {
            parameters: parameters.iter().map(|p| p[k]).collect(),
            x0: part(&x0, n),
            status,
            value: value[k],
            u: if m > 0 { part(&u, m) } else { Vec::new() },
            sheets: usize::try_from(sheets[k]).ok()?,
            duration: duration[k],
            records: records.iter().map(|r| r[k]).collect(),
            trajectory: is_there.then(|| TrajectoryBlock {
                count: 1,
                t: times,
                x: part(&x, samples * n),
                u: if m > 0 {
                    part(&controls, samples * m)
                } else {
                    Vec::new()
                },
                v: part(&v, samples),
                ..TrajectoryBlock::default()
            }),
        })
    };
    let wrong = || group.error("status", "not as this program writes it");
    (0..count).map(|k| row(k).ok_or_else(wrong)).collect()
}
