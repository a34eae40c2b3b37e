//! Parts put together: what is asked, and what is refused.

use super::super::{Provenance, RunError};
use super::manifest::Kind;
use super::source::Source;
use super::study;
use super::sweep;
use super::whole::{Into, assemble, note_gaps};
use super::{levels, loops};
use crate::backend::cpu::Cpu;
use crate::files::allow_open;
use crate::session::summary::RunSummary;
use crate::session::{Progress, Session};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What to do with what is not there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MergeOptions {
    /// Puts together what there is: states of shards that are missing have the status `not_merged`.
    pub partial: bool,
    /// Leaves rows in the parts, from which they are read.
    pub stay: bool,
}

/// What came of it.
#[derive(Clone, Debug)]
pub struct Merged {
    /// The whole's file.
    pub path: PathBuf,
    /// How many files were put together.
    pub files: usize,
    /// How many shards there are of the whole.
    pub shards: usize,
    /// Whether rows are read from these files.
    pub stay: bool,
    /// Shards that are missing.
    pub missing: Vec<usize>,
    /// Shards that were ended before they were done.
    pub unfinished: Vec<usize>,
    /// The numbers, as the file has them.
    pub summary: RunSummary,
    /// How long it took to put them together.
    pub seconds: f64,
}

/// Why files are not put together.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "its message says what each is")]
pub enum MergeError {
    #[error("no files to put together: name the results of the shards")]
    Nothing,
    #[error(
        "{path} is no part of a whole: it was not made with --shard", path = path.display()
    )]
    NoPart { path: PathBuf },
    #[error("{path} is a part that another version of costate has made: make it again with this one", path = path.display())]
    OtherVersion { path: PathBuf },
    #[error(
        "{path} and {other} are not of one whole: {what} differs ({a}; {b})",
        path = path.display(), other = other.display()
    )]
    Differs {
        path: PathBuf,
        other: PathBuf,
        what: &'static str,
        a: String,
        b: String,
    },
    #[error("shard {shard} is there twice: {path} and {other}", path = path.display(), other = other.display())]
    Twice {
        shard: usize,
        path: PathBuf,
        other: PathBuf,
    },
    #[error(
        "of {of} shards {} missing: {} (counted from 0); run {}, or put together what there is with --partial",
        if missing.len() == 1 { "one is" } else { "some are" },
        listed(missing),
        if missing.len() == 1 { "it" } else { "them" }
    )]
    Missing { missing: Vec<usize>, of: usize },
    #[error(
        "{path} is not finished: run its shard again with --resume, or put together what there is with --partial",
        path = path.display()
    )]
    Unfinished { path: PathBuf },
    #[error("{path} does not tell what its run did (the attribute `summary`): run its shard again", path = path.display())]
    NoSummary { path: PathBuf },
    #[error(
        "{count} states are in no part, although no shard is missing: rows were lost from one; run all shards again"
    )]
    NoRows { count: usize },
    #[error("{path}: /{group} is not as this program writes it, or lacks rows: run its shard again", path = path.display())]
    Damaged { path: PathBuf, group: &'static str },
    #[error(
        "{path} cannot be gone on with: {what} was another ({then}, and now {now}); leave --resume out to begin anew (in Python: name another folder)",
        path = path.display()
    )]
    Other {
        path: PathBuf,
        what: &'static str,
        now: String,
        then: String,
    },
    #[error(
        "{path} is of other work, which cannot be gone on with: leave --resume out to write over it, or name another --out",
        path = path.display()
    )]
    OtherWork { path: PathBuf },
    #[error(
        "{path} is the result of shard {shard}: each shard has a file of its own (--out; without it costate finds a name)",
        path = path.display()
    )]
    OtherShard { path: PathBuf, shard: usize },
    #[error(
        "some of the levels of attenuation show nothing of the smallest one, so --partial cannot put them together: run {} to the end first (missing: {}; not finished: {})",
        if missing.len() + unfinished.len() == 1 { "this shard" } else { "these shards" },
        if missing.is_empty() { "none".to_owned() } else { listed(missing) },
        if unfinished.is_empty() { "none".to_owned() } else { listed(unfinished) }
    )]
    Gaps {
        missing: Vec<usize>,
        unfinished: Vec<usize>,
    },
    #[error("{path} is both a part and the whole: name another --out", path = path.display())]
    OverPart { path: PathBuf },
    #[error(
        "{path} is a part of a study, of closed loops, of levels or of a sweep; --virtual is for parts of states (solve, homotopy, map): leave it out",
        path = path.display()
    )]
    VirtualSmall { path: PathBuf },
    #[error(
        "{path}: what --virtual writes down is the names of parts, and this one is no text (UTF-8): give it another name, or leave --virtual out",
        path = path.display()
    )]
    NoText { path: PathBuf },
}

/// Numbers, with ranges where several follow each other: `0, 3-7, 9`.
#[must_use]
pub fn listed(numbers: &[usize]) -> String {
    let mut runs: Vec<(usize, usize)> = Vec::new();
    for &n in numbers {
        match runs.last_mut() {
            Some((_, last)) if *last + 1 == n => *last = n,
            _ => runs.push((n, n)),
        }
    }
    let text = |(a, b): &(usize, usize)| match b - a {
        0 => a.to_string(),
        1 => format!("{a}, {b}"),
        _ => format!("{a}-{b}"),
    };
    runs.iter().map(text).collect::<Vec<_>>().join(", ")
}

/// Puts parts together to the whole: as one run would have written it, but for clocks and the
/// estimate of errors.
///
/// # Errors
/// Where the parts are not of one whole, or not all are there; of reading and writing.
pub fn merge(
    paths: &[PathBuf],
    out: &Path,
    options: MergeOptions,
    provenance: &Provenance,
    progress: &dyn Progress,
) -> Result<Merged, RunError> {
    // Each part stays open; some more are for everything else.
    allow_open(paths.len() + 64);
    let sources = (paths.iter())
        .map(|path| Source::open(path))
        .collect::<Result<Vec<_>, _>>()?;
    let first = sources.first().ok_or(MergeError::Nothing)?;
    let (missing, unfinished) = check(&sources, out, options)?;

    let session = Session::on(&first.stored.scene, Box::new(Cpu::new())).with_progress(progress);
    let gaps = (!missing.is_empty() || !unfinished.is_empty()).then_some((&*missing, &*unfinished));
    let (path, summary) = match first.manifest.of {
        Kind::States => {
            let into = match options.stay {
                true => Into::Virtual(gaps),
                false => Into::Whole(gaps),
            };
            assemble(&session, &sources, into, out, provenance)?
        }
        Kind::Study | Kind::ClosedLoop | Kind::Attenuation | Kind::Sweep if options.stay => {
            let path = first.path();
            return Err(MergeError::VirtualSmall { path }.into());
        }
        Kind::Study => {
            let (file, summary) =
                study::assemble(&session, &sources, (gaps.is_some(), out), provenance)?;
            note_gaps(&file, gaps)?;
            super::write_whole(&file, &first.manifest)?;
            (session.finish(file, provenance)?, summary)
        }
        Kind::Attenuation if gaps.is_some() => {
            return Err(MergeError::Gaps {
                missing,
                unfinished,
            }
            .into());
        }
        Kind::Attenuation => levels::assemble(&session, &sources, out, provenance)?,
        Kind::ClosedLoop => loops::assemble(&session, &sources, (gaps, out), provenance)?,
        Kind::Sweep => sweep::assemble(&session, &sources, (gaps, out), provenance)?,
    };
    Ok(Merged {
        files: sources.len(),
        shards: first.manifest.shards,
        stay: options.stay,
        path,
        missing,
        unfinished,
        summary,
        seconds: provenance.seconds(),
    })
}

/// Whether parts are of one whole; the shards that are missing, and those that are not finished.
fn check(
    sources: &[Source],
    out: &Path,
    options: MergeOptions,
) -> Result<(Vec<usize>, Vec<usize>), RunError> {
    let first = &sources[0].manifest;
    let same_file = |a: &Path| {
        let whole = |path: &Path| std::fs::canonicalize(path).ok();
        whole(a).is_some() && whole(a) == whole(out)
    };
    let mut at: BTreeMap<usize, PathBuf> = BTreeMap::new();
    for source in sources {
        let path = source.path();
        if same_file(&path) {
            return Err(MergeError::OverPart { path }.into());
        }
        if let Some((what, a, b)) = first.differs(&source.manifest) {
            let other = path;
            let path = sources[0].path();
            return Err(MergeError::Differs {
                path,
                other,
                what,
                a,
                b,
            }
            .into());
        }
        let shard = source.manifest.shard;
        if let Some(other) = at.insert(shard, path.clone()) {
            return Err(MergeError::Twice {
                shard,
                path: other,
                other: path,
            }
            .into());
        }
    }
    let of = first.shards;
    let missing: Vec<usize> = (0..of).filter(|k| !at.contains_key(k)).collect();
    let tells = first.of == Kind::States;
    let told = |s: &&Source| s.stored.has_attribute("stopped") || s.stored.has_attribute("summary");
    if let Some(source) = sources.iter().find(|s| tells && !told(s)) {
        let path = source.path();
        return Err(MergeError::NoSummary { path }.into());
    }
    let late = sources.iter().filter(|s| !s.is_finished());
    let unfinished: Vec<usize> = late.clone().map(|s| s.manifest.shard).collect();
    if options.partial {
        return Ok((missing, unfinished));
    }
    if !missing.is_empty() {
        return Err(MergeError::Missing { missing, of }.into());
    }
    match late.map(Source::path).next() {
        Some(path) => Err(MergeError::Unfinished { path }.into()),
        None => Ok((missing, unfinished)),
    }
}

#[cfg(test)]
mod tests {
    use super::listed;

    #[test]
    fn numbers_are_listed_as_ranges() {
        assert_eq!(listed(&[]), "");
        assert_eq!(listed(&[3]), "3");
        assert_eq!(listed(&[0, 1, 3, 4, 5, 9]), "0, 1, 3-5, 9");
    }
}
