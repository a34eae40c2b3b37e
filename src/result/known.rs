//! What a value map is made of, from a file.

use super::{Stored, StoredError};
use crate::map::{Known, MapError, SweepRecord, ValueMap};
use crate::schema;
use crate::session::summary::RunSummary;
use crate::trajectories::SweptTrajectories;

/// Why a file gives no value map.
#[derive(Debug, thiserror::Error)]
pub enum StoredMapError {
    #[error(transparent)]
    Stored(#[from] StoredError),
    #[error("{path} holds nothing to interpolate V from: neither /trajectories of an infinite horizon with costates nor /points nor /map (`costate run` or `costate homotopy` of its scene makes some; `--values-only` and `--no-trajectories` leave costates out)", path = path.display())]
    Empty { path: std::path::PathBuf },
    #[error("{path}: its run was ended before it was known which solutions lie on one sheet (or shards of it are not there), so nothing is interpolated: run it to its end, or merge all shards again (what was solved is in /points and /map)", path = path.display())]
    Stopped { path: std::path::PathBuf },
    #[error("{path}: its run was ended before anything was solved: run it to its end", path = path.display())]
    NothingDone { path: std::path::PathBuf },
    #[error("{path}: its map in pieces knows V nowhere: run its scene again; what is printed of the map says why", path = path.display())]
    EmptyMap { path: std::path::PathBuf },
    #[error(transparent)]
    Map(MapError),
}

impl Stored {
    /// All values of the file, ready to be looked up. Where it has swept trajectories this sweeps
    /// some more, next to the equilibrium.
    ///
    /// # Errors
    /// [`StoredMapError`].
    pub fn value_map(&self) -> Result<ValueMap, StoredMapError> {
        let known = self.known()?;
        ValueMap::new(&self.scene.model, &self.scene.hamiltonian, known).map_err(
            |error| match error {
                MapError::Empty if self.has_map() => StoredMapError::EmptyMap { path: self.name() },
                MapError::Empty if self.is_stopped() => {
                    let path = self.name();
                    match self.has(&schema::POINTS) || self.has(&schema::MAP) {
                        true => StoredMapError::Stopped { path },
                        false => StoredMapError::NothingDone { path },
                    }
                }
                MapError::Empty => StoredMapError::Empty { path: self.name() },
                error => StoredMapError::Map(error),
            },
        )
    }

    /// Which shards a file that was put together of some lacks, in words.
    pub fn shards_lacking(&self) -> Option<String> {
        let shards = |name: &str| self.attribute(name).filter(|list| !list.is_empty());
        let missing = shards("shards_missing").map(|list| format!("missing: {list}"));
        let unfinished = shards("shards_unfinished").map(|list| format!("not finished: {list}"));
        let all: Vec<String> = missing.into_iter().chain(unfinished).collect();
        (!all.is_empty()).then(|| all.join("; "))
    }

    /// Which shard's part it is, and of how many; `None` where it is no part.
    pub fn shard(&self) -> Option<(usize, usize)> {
        let text = self.attribute(super::MANIFEST)?;
        let manifest: serde_json::Value = serde_json::from_str(&text).ok()?;
        let number = |name: &str| usize::try_from(manifest[name].as_u64()?).ok();
        // All of the work, ended early, is a part of one.
        Some((number("shard")?, number("shards")?)).filter(|(_, of)| *of > 1)
    }

    /// Whether the run made a map in pieces, which may know nothing.
    pub fn has_map(&self) -> bool {
        self.has(&schema::MAP_PIECES) || self.summary()["map"].is_object()
    }

    /// Whether its run was ended before everything was swept and solved.
    fn is_stopped(&self) -> bool {
        self.has_attribute("stopped") || !self.absent_parts().is_empty()
    }

    /// What the file may lack, in words, where its run was ended before all was done, or not all
    /// shards of it are there.
    pub fn ended_early(&self) -> Option<String> {
        if let Some(shards) = self.shards_lacking() {
            return Some(format!(
                "not all shards are in it ({shards}): a cheaper solution may be missing, and V is interpolated between swept trajectories alone; merge again with all of them"
            ));
        }
        let stopped = self.has_attribute("stopped");
        let how = if stopped && self.has_map() {
            "before everything was swept and solved: a cheaper solution may be missing, and the map knows V in less of its region than was asked for"
        } else if stopped {
            "before everything was swept and solved: a state without an answer may have one, a cheaper solution may be missing, and V is not interpolated between solved states"
        } else if self.has_attribute("laws_stopped") {
            "after everything was solved: laws, closed loops and levels of attenuation may be missing"
        } else {
            return None;
        };
        Some(format!("its run was ended {how}"))
    }

    /// What the file holds of the value function.
    ///
    /// # Errors
    /// [`StoredError`] where groups are not as this program writes them.
    pub fn known(&self) -> Result<Known, StoredError> {
        // `costate value` writes one solution a state alone.
        let solved = match self.points_sheets()? {
            None => self.points()?,
            entries => entries,
        };
        let summary = self.run_summary()?;
        // Where the search was ended before, nothing tells which solutions lie on one sheet, and
        // none is interpolated.
        let stopped = self.is_stopped();
        Ok(Known {
            swept: self.trajectories()?.filter(SweptTrajectories::is_full),
            solved: solved.filter(|_| !stopped),
            grid: self.map()?.filter(|_| !stopped),
            pieces: self.map_pieces()?,
            beyond: self.map_beyond()?,
            coverage: Some(self.map_coverage()),
            sweep: SweepRecord {
                lacks: self.shard().is_some() || self.has_attribute("shards_missing"),
                ..sweep_record(summary.as_ref())
            },
            searched: self.attribute("source").is_none() && !stopped,
            errors: summary.as_ref().and_then(own_errors),
        })
    }
}

/// From the summary of the run that made the file.
fn sweep_record(summary: Option<&RunSummary>) -> SweepRecord {
    let Some(summary) = summary else {
        return SweepRecord::default();
    };
    let coverage = &summary.coverage;
    SweepRecord {
        gaps: Some(coverage.gaps() as u64),
        widest: coverage.widest_gap.unwrap_or(f64::NAN),
        far: coverage.far(),
        lacks: false,
        failed: summary.failed() as u64,
    }
}

/// Worst relative errors of V and p of the solved states.
fn own_errors(summary: &RunSummary) -> Option<[f64; 2]> {
    let errors = summary.homotopy.as_ref()?.error_estimate.as_ref()?;
    Some([errors.value?.max?, errors.costate?.max?])
}
