//! What an earlier run of the same work has left: a result that is gone on with, or that is done.

use super::super::{RunError, beside, note_replaced, of_shard, path_of_stopped, stopped_beside};
use super::manifest::Manifest;
use super::merge::MergeError;
use super::source::Source;
use crate::files::Others;
use crate::hdf5::ResultFile;
use crate::result::Stored;
use crate::session::{Resume, Session};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// What there is at a place, and where results go.
#[derive(Default)]
pub(super) struct Before {
    /// Parts that are gone on with, and their files.
    pub sources: Vec<Source>,
    pub kept: Vec<PathBuf>,
    /// The result, where all is done.
    pub finished: Option<Stored>,
    /// The result's name, and where it is while it is not finished.
    pub path: PathBuf,
    pub unfinished: PathBuf,
    /// What is done is kept so often.
    pub every: Option<Duration>,
}

impl Before {
    /// Looks for what work of this kind has left.
    ///
    /// # Errors
    /// [`MergeError::Other`] and [`MergeError::OtherWork`] where there is something else.
    pub fn at(path: &Path, manifest: &Manifest, resume: Resume) -> Result<Self, RunError> {
        let mut this = Self {
            path: path.to_owned(),
            unfinished: path_of_stopped(path),
            every: match resume {
                Resume::Never => None,
                Resume::Later(seconds) | Resume::Now(seconds) => {
                    Some(Duration::from_secs(seconds.into()))
                }
            },
            ..Self::default()
        };
        if let Some(shard) = other_shard(path, manifest) {
            let path = path.to_owned();
            return Err(MergeError::OtherShard { path, shard }.into());
        }
        if !matches!(resume, Resume::Now(_)) {
            return Ok(this);
        }
        let beside = stopped_beside(path);
        for at in [path, &beside].into_iter().filter(|at| at.exists()) {
            match Source::open(at) {
                Ok(source) => this.begun(source, manifest)?,
                Err(RunError::Merge(MergeError::NoPart { .. })) => this.whole(at, manifest)?,
                Err(error) => return Err(error),
            }
        }
        Ok(this)
    }

    /// Takes a part.
    fn begun(&mut self, source: Source, manifest: &Manifest) -> Result<(), MergeError> {
        source.is_of(manifest)?;
        if source.path() == self.path {
            self.unfinished.clone_from(&self.path);
            if !source.stored.has_attribute("stopped") {
                self.finished = Some(source.stored);
                return Ok(());
            }
        }
        self.kept.push(source.path());
        self.sources.push(source);
        Ok(())
    }

    /// Takes what is no part: the whole, or something else.
    fn whole(&mut self, at: &Path, manifest: &Manifest) -> Result<(), RunError> {
        let stored = Stored::open(at)?;
        let path = at.to_owned();
        let known = Manifest::of_whole(&stored).ok_or(MergeError::OtherWork { path })?;
        Source::same(at, manifest, &known)?;
        // One that was put together of some parts is made anew.
        if at == self.path && !stored.has_attribute("stopped") {
            self.finished = Some(stored);
        }
        Ok(())
    }

    /// Where what is unfinished, or the result, goes; what is replaced there is said.
    pub fn place(&mut self, session: &Session<'_>, manifest: &Manifest, stopped: bool) -> PathBuf {
        let to = match stopped {
            true => &mut self.unfinished,
            false => &mut self.path,
        };
        // Another shard may have come there meanwhile.
        if other_shard(to, manifest).is_some() {
            let taken =
                std::mem::replace(to, beside(to, &of_shard(manifest.shard, manifest.shards)));
            (session.progress()).note(&format!(
                "{} is the result of another shard now, and stays: this one's goes to {}",
                taken.display(),
                to.display()
            ));
        }
        if stopped && self.kept.is_empty() {
            note_replaced(session, to);
        }
        to.clone()
    }

    /// Says that all was done before.
    pub fn note_finished(&self, session: &Session<'_>) {
        let path = self.path.display();
        (session.progress()).note(&format!("{path} is finished: nothing is left to do"));
    }

    /// Removes what was kept of work that is in its result now.
    pub fn clear(&self, manifest: &Manifest) {
        let others = self.kept.iter().chain([&self.unfinished]);
        for other in others.filter(|other| **other != self.path && other.exists()) {
            if Source::open(other).is_ok_and(|s| s.manifest == *manifest) {
                let _ = std::fs::remove_file(other);
            }
        }
    }
}

/// A part's file, which does not come in place of another shard's that is there once it is finished.
pub(super) fn create_part(to: &Path, manifest: &Manifest) -> Result<ResultFile, RunError> {
    let mut file = ResultFile::create(to)?;
    let own = manifest.clone();
    file.beside(Others {
        beside: beside(to, &of_shard(manifest.shard, manifest.shards)),
        are_there: Box::new(move |path| other_shard(path, &own).is_some()),
    });
    Ok(file)
}

/// Which shard's result is at a path, if it is that of another shard of the same whole.
fn other_shard(path: &Path, manifest: &Manifest) -> Option<usize> {
    let there = (path.exists()).then(|| Source::open(path).ok()).flatten()?;
    let other = &there.manifest;
    let is_other = other.shard != manifest.shard && manifest.differs(other).is_none();
    is_other.then_some(other.shard)
}

/// Says that what is done could not be kept, if so.
pub(super) fn note_kept(session: &Session<'_>, to: &Path, kept: Result<(), RunError>) {
    if let Err(error) = kept {
        let path = to.display();
        (session.progress()).note(&format!(
            "what is done could not be kept in {path}: {error}"
        ));
    }
}
