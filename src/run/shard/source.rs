//! A part that is read.

use super::super::RunError;
use super::manifest::Manifest;
use super::merge::MergeError;
use crate::result::Stored;
use crate::schema;
use crate::value::blocks::Seam;
use std::path::{Path, PathBuf};

/// A part, open.
pub(super) struct Source {
    pub stored: Stored,
    pub manifest: Manifest,
    /// Numbers of its blocks, whether each is done, and how many states it has.
    pub number: Vec<i32>,
    pub done: Vec<i32>,
    pub states: Vec<i32>,
}

impl Source {
    pub fn open(path: &Path) -> Result<Self, RunError> {
        let stored = Stored::open(path)?;
        let no_part = || MergeError::NoPart {
            path: path.to_owned(),
        };
        let manifest = match Manifest::read(&stored) {
            Some(manifest) => manifest,
            None if stored.has_attribute(super::MANIFEST) => {
                let path = path.to_owned();
                return Err(MergeError::OtherVersion { path }.into());
            }
            None => return Err(no_part().into()),
        };
        let group = stored.group(&schema::SHARD).ok_or_else(no_part)?;
        let (number, done, states) = (
            group.i32("number")?.1,
            group.i32("done")?.1,
            group.i32("states")?.1,
        );
        Ok(Self {
            manifest,
            number,
            done,
            states,
            stored,
        })
    }

    pub fn path(&self) -> PathBuf {
        self.stored.path.clone()
    }

    pub fn damaged(&self, group: &'static str) -> RunError {
        let path = self.path();
        MergeError::Damaged { path, group }.into()
    }

    /// Whether it is a part of the same, and the same one.
    ///
    /// # Errors
    /// [`MergeError::Other`] where it is not.
    pub fn is_of(&self, manifest: &Manifest) -> Result<(), MergeError> {
        Self::same(&self.path(), manifest, &self.manifest)
    }

    /// The same of a file that tells of itself what it is.
    ///
    /// # Errors
    /// [`MergeError::Other`] where it is not.
    pub fn same(path: &Path, manifest: &Manifest, other: &Manifest) -> Result<(), MergeError> {
        let differs = manifest.differs(other).or_else(|| {
            let shard = |m: &Manifest| format!("{}/{}", m.shard, m.shards);
            let (a, b) = (shard(manifest), shard(other));
            (a != b).then_some(("shard", a, b))
        });
        let path = path.to_owned();
        match differs {
            Some((what, now, then)) => Err(MergeError::Other {
                path,
                what,
                now,
                then,
            }),
            None => Ok(()),
        }
    }

    /// The units that are done.
    pub fn units_done(&self) -> impl Iterator<Item = usize> {
        let blocks = self.number.iter().zip(&self.done);
        blocks
            .filter(|(_, done)| **done == 1)
            .map(|(k, _)| (*k).max(0) as usize)
    }

    /// Whether all its units are done.
    pub fn is_finished(&self) -> bool {
        self.done.iter().all(|done| *done == 1)
    }

    /// What joins its blocks to others.
    pub fn seams(&self) -> Result<Vec<Seam>, RunError> {
        let Some(group) = self.stored.group(&schema::SHARD_SEAMS) else {
            return Ok(Vec::new());
        };
        let numbers = group.f64("value")?.values;
        let seams = Seam::all_from(&numbers).filter(|seams| {
            let blocks = seams.iter().map(|s| s.block as i64);
            blocks.eq(self.number.iter().map(|k| i64::from(*k)))
        });
        seams.ok_or_else(|| self.damaged("shard_seams"))
    }
}
