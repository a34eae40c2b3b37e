//! A whole whose rows stay in the parts: virtual datasets of HDF5, in the order of the parts.
//!
//! In the order in which states were given a part's rows are scattered: about as many runs as states
//! of a list, each of which would be a selection of every variable.

use super::super::RunError;
use super::merge::MergeError;
use super::rows::{Layout, Sink};
use super::source::Source;
use super::stream::{Counted, Sinks, Stream};
use super::whole::{Numbers, Whole};
use crate::hdf5::{GroupWriter, ResultFile};
use crate::result::{MANIFEST, ShardFiles, StoredError, StoredGroup};
use crate::schema;
use std::path::{Component, Path, PathBuf};

/// Rows of what is written here that are held: of integers, a chunk of the file.
const ROWS: usize = 1 << 17;
/// Rows that are read at once where they are counted.
const COUNTED_AT_ONCE: usize = 1 << 16;

/// The columns that are written to the whole itself.
pub(super) fn own_columns(writer: GroupWriter, names: &[&'static str]) -> Sink {
    let nothing = vec![None; names.len()];
    Sink::new(writer, Layout::of_integers(names), ROWS, Some(1)).taking(nothing)
}

impl Whole<'_> {
    /// Writes the groups of [`write_rows`](Whole::write_rows), with rows that are read from the parts:
    /// those of a part after those of the shard before, and then the states that no part has. A
    /// map, whose nodes have their places, is written here.
    pub(super) fn write_elsewhere(
        &self,
        file: &mut ResultFile,
        numbers: &Numbers<'_>,
    ) -> Result<Counted, RunError> {
        let mut order: Vec<usize> = (0..self.sources.len()).collect();
        order.sort_by_key(|k| self.sources[*k].manifest.shard);
        let listed = self.manifest.asked.points;
        let mut there = States::none(listed);
        let folder = file.path().parent().map(Path::to_owned);
        let files = self.files(&order, folder.as_deref(), &mut there)?;

        let mut streams = self.streams()?;
        let mut sinks = Sinks::new(self, file, &streams, Some(&files), false)?;
        let mut counted = Counted::default();
        let mut place = 0;
        for (k, rows) in order.iter().zip(&files.points) {
            for _ in 0..*rows {
                let stream = &mut streams[*k];
                let damaged = || self.sources[*k].damaged("shard_points");
                let index = stream.index()?.ok_or_else(damaged)?;
                let row = usize::try_from(index).map_err(|_| damaged())?;
                // Each block is of one part.
                let block = stream.block()?;
                if !self.is_from(block, *k) {
                    return Err(damaged());
                }
                let of = numbers.of_block(block).ok_or_else(damaged)?;
                sinks
                    .row(self, stream, (row, place), &of, (&mut counted, None))?
                    .ok_or_else(damaged)?;
                stream.advance()?;
                place += 1;
            }
        }
        for row in there.missing() {
            self.nothing(&mut sinks, &mut counted, row..row + 1)?;
        }
        self.write_in_order(
            (&mut sinks, &mut streams),
            numbers,
            listed,
            (&mut counted, None),
        )?;
        sinks.flush()?;
        file.shard_files(&files)?;
        Ok(counted)
    }

    /// The parts in this order, as a file in `folder` names them, and what they have.
    fn files(
        &self,
        order: &[usize],
        folder: Option<&Path>,
        there: &mut States,
    ) -> Result<ShardFiles, RunError> {
        let mut files = ShardFiles::default();
        for k in order {
            let source = &self.sources[*k];
            let rows = there.take(source)?;
            let counted = rows_of(source, rows)?;
            let (entries, trajectories) = counted.ok_or_else(|| source.damaged("points"))?;
            let path = source.path();
            files.file.push(name_from(folder, &path)?);
            let found = std::fs::metadata(&path);
            let found = found.map_err(|source| StoredError::Read { path, source })?;
            files.bytes.push(found.len());
            files.shard.push(source.manifest.shard as i32);
            files.points.push(rows);
            files.entries.push(entries);
            files.trajectories.push(trajectories);
            let manifest = source.stored.attribute(MANIFEST);
            files.manifest.push(manifest.unwrap_or_default());
        }
        Ok(files)
    }

    /// The rows of all parts.
    pub(super) fn streams(&self) -> Result<Vec<Stream>, RunError> {
        (self.sources.iter())
            .map(|source| Stream::open(source, self.at_once()))
            .collect()
    }
}

/// Which of so many states parts have, a bit each.
struct States {
    count: usize,
    bits: Vec<u64>,
}

impl States {
    fn none(count: usize) -> Self {
        Self {
            count,
            bits: vec![0; count.div_ceil(64)],
        }
    }

    /// Takes those of a part, which come first in it and in order; how many.
    fn take(&mut self, source: &Source) -> Result<usize, RunError> {
        let damaged = || source.damaged("shard_points");
        let group = (source.stored.group(&schema::SHARD_POINTS)).ok_or_else(damaged)?;
        let column = group.column("index")?;
        let (mut rows, mut next) = (0, 0);
        while rows < column.rows {
            let read = column.i32(rows, COUNTED_AT_ONCE.min(column.rows - rows))?;
            for index in read {
                let index = usize::try_from(index).map_err(|_| damaged())?;
                if index >= self.count {
                    return Ok(rows);
                }
                let (word, bit) = (index / 64, 1 << (index % 64));
                if index < next || self.bits[word] & bit != 0 {
                    return Err(damaged());
                }
                self.bits[word] |= bit;
                (rows, next) = (rows + 1, index + 1);
            }
        }
        Ok(rows)
    }

    fn missing(&self) -> impl Iterator<Item = usize> {
        (0..self.count).filter(|k| self.bits[k / 64] & 1 << (k % 64) == 0)
    }
}

/// How many solutions the first states of a part have, and how many trajectories they are; `None`
/// where its groups do not fit together.
fn rows_of(source: &Source, rows: usize) -> Result<Option<(usize, usize)>, RunError> {
    let stored = &source.stored;
    let count = |group: &Option<StoredGroup<'_>>, name: &str| match group {
        Some(group) => group.column(name).map(|column| column.rows),
        None => Ok(0),
    };
    let (points, entries) = (
        stored.group(&schema::POINTS),
        stored.group(&schema::POINTS_SHEETS),
    );
    let trajectories = count(&stored.group(&schema::TRAJECTORIES), "V")?;
    let all = count(&entries, "V")?;
    let Some(points) = points.filter(|_| rows > 0) else {
        return Ok((rows == 0).then_some((0, 0)));
    };
    let column = points.column("sheets")?;
    if column.rows < rows {
        return Ok(None);
    }
    let mut solutions = 0usize;
    for first in (0..rows).step_by(COUNTED_AT_ONCE) {
        let read = column.i32(first, COUNTED_AT_ONCE.min(rows - first))?;
        let counts = read.iter().map(|n| (*n).max(0) as usize);
        solutions += counts.sum::<usize>();
    }
    Ok((solutions <= all).then_some((solutions, trajectories)))
}

/// How a file in a folder calls another one: from the folder, so that both can be moved together;
/// absolute where nothing leads there.
fn name_from(folder: Option<&Path>, path: &Path) -> Result<String, MergeError> {
    let real = |path: &Path| match path.as_os_str().is_empty() {
        true => std::fs::canonicalize("."),
        false => std::fs::canonicalize(path),
    };
    let name = || -> Option<String> {
        // A link to a part is a part.
        let to = real(path.parent().unwrap_or(Path::new(""))).ok()?;
        let to = to.join(path.file_name()?);
        let from = real(folder.unwrap_or(Path::new(""))).ok()?;
        let text = relative(&from, &to).unwrap_or(to).into_os_string();
        text.into_string().ok()
    };
    name().ok_or_else(|| MergeError::NoText {
        path: path.to_owned(),
    })
}

/// The way from a folder to a file, both absolute; `None` where they have not one root.
fn relative(from: &Path, to: &Path) -> Option<PathBuf> {
    let is_named = |c: &Component<'_>| matches!(c, Component::Normal(_));
    let common = (from.components().zip(to.components()))
        .take_while(|(a, b)| a == b)
        .count();
    let up = from.components().skip(common);
    let down = to.components().skip(common);
    if !up.clone().all(|c| is_named(&c)) || !down.clone().all(|c| is_named(&c)) {
        return None;
    }
    Some(up.map(|_| Component::ParentDir).chain(down).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ways_between_folders() {
        let way = |from: &str, to: &str| relative(Path::new(from), Path::new(to));
        assert_eq!(way("/a/b", "/a/b/p.h5"), Some("p.h5".into()));
        assert_eq!(way("/a/b", "/a/c/p.h5"), Some("../c/p.h5".into()));
        assert_eq!(way("/a", "/a/b/p.h5"), Some("b/p.h5".into()));
        assert_eq!(way("/", "/p.h5"), Some("p.h5".into()));
        assert_eq!(way("a", "/p.h5"), None);
    }

    #[test]
    fn states_that_no_part_has() {
        let mut states = States::none(130);
        states.bits[0] = !0 ^ 0b100;
        states.bits[1] = !0;
        assert_eq!(states.missing().collect::<Vec<_>>(), [2, 128, 129]);
    }
}
