//! Closed loops and the dissipation inequality, simulated again into a result file.

use super::shard::{Divided, LoopsDone, hash_of, loops};
use super::sources::told_apart;
use super::{Provenance, RunError, sources};
use crate::closed_loop::dissipation::Dissipation;
use crate::closed_loop::{Evaluation, Weights};
use crate::hdf5::ResultFile;
use crate::result::{CLOSED_LOOP_GROUPS, DISSIPATION_GROUPS, RunRecord, Stored};
use crate::session::{LoopOptions, Resume, Session, SessionError, Shard};
use std::path::{Path, PathBuf};

/// What came of it.
pub struct Evaluated {
    /// Of `[closed_loop]`.
    pub closed_loop: Option<Evaluation>,
    /// Of `[dissipation]`.
    pub dissipation: Option<Dissipation>,
    /// The result file.
    pub path: PathBuf,
}

/// Simulates a shard of what the session's scene asks for in `[closed_loop]` into `out`, keeping what
/// is done; `None`: all of it. Laws and V are those of [`evaluate`].
///
/// # Errors
/// As [`evaluate`]; [`SessionError::DissipationNotDivided`]; what is wrong with what was kept before.
pub fn evaluate_shard(
    session: &Session<'_>,
    (stored, added): (Option<&Stored>, Vec<Weights>),
    options: &LoopOptions,
    (shard, resume): (Option<Shard>, Resume),
    out: &Path,
    provenance: &Provenance,
) -> Result<LoopsDone, RunError> {
    let model = &session.scene().model;
    match (&model.closed_loop, &model.dissipation) {
        (None, None) => return Err(SessionError::NoClosedLoop.into()),
        (None, Some(_)) => return Err(SessionError::DissipationNotDivided.into()),
        (Some(_), Some(_)) => session
            .progress()
            .note("[dissipation] is left out: it is not divided into shards"),
        (Some(_), None) => {}
    }
    // Results of one scene differ in when they were made at least.
    let mut from = String::new();
    if let Some(stored) = stored {
        from += &told_apart(stored);
    }
    for weights in &added {
        from += &format!("{}\n{}\n", weights.name, weights.text);
    }
    let from = hash_of(from.bytes());
    let divided = Divided {
        shard,
        resume,
        from: &from,
    };
    let sources = sources(stored, model, added, session.progress())?;
    loops(session, (&sources, options), &divided, out, provenance)
}

/// Simulates what the session's scene asks for in `[closed_loop]` and `[dissipation]`. Laws and V
/// are those of a result file, if one is given, and `added` laws. The results replace those in that
/// file, or go into `out`.
///
/// # Errors
/// Where the scene asks for nothing of this; what is wrong with its laws; those of files.
pub fn evaluate(
    session: &Session<'_>,
    stored: Option<&Stored>,
    added: Vec<Weights>,
    options: &LoopOptions,
    out: Option<&Path>,
    provenance: &Provenance,
) -> Result<Evaluated, RunError> {
    let model = &session.scene().model;
    let parts = [
        (model.closed_loop.is_some(), CLOSED_LOOP_GROUPS.as_slice()),
        (model.dissipation.is_some(), &DISSIPATION_GROUPS),
    ];
    if parts.iter().all(|(there, _)| !there) {
        return Err(SessionError::NoClosedLoop.into());
    }
    let mut file = match (stored, out) {
        (_, Some(out)) => ResultFile::create(out)?,
        (Some(stored), None) => {
            // Of what is simulated again nothing old is left.
            let replaced: Vec<&str> = (parts.iter().filter(|(there, _)| *there))
                .flat_map(|(_, groups)| groups.iter().copied())
                .collect();
            ResultFile::extend(&stored.path, &replaced)?
        }
        (None, None) => {
            let scenario = Path::new(&model.file_name);
            ResultFile::create(super::output_of(scenario, "_closed_loop"))?
        }
    };

    let from = sources(stored, model, added, session.progress())?;
    let (mut closed_loop, mut dissipation, mut numerics) = (None, None, None);
    if model.closed_loop.is_some() {
        let evaluation = session.closed_loop(&from, options)?;
        evaluation.write(model, &mut file)?;
        numerics = Some(evaluation.numerics);
        closed_loop = Some(evaluation);
    }
    if model.dissipation.is_some() {
        let check = session.dissipation(&from, options)?;
        check.write(model, &mut file)?;
        numerics = numerics.or(Some(check.numerics));
        dissipation = Some(check);
    }
    if let (Some(numerics), true) = (numerics, stored.is_none() || out.is_some()) {
        let record = RunRecord {
            precision: numerics.precision.name().to_owned(),
            method: numerics.method.name().to_owned(),
            rtol: numerics.rtol,
            atol: numerics.atol,
            ..session.record(provenance)
        };
        record.write(&file)?;
    }
    let path = file.finish()?;
    Ok(Evaluated {
        closed_loop,
        dissipation,
        path,
    })
}
