//! The states that trajectories pass, of those that may still get a neighbour: rows of flat memory,
//! and beyond a share of it rows of a file without a name.
//!
//! Of a million trajectories hundreds of thousands are open at a time, with half a kilobyte each or
//! more, and each is looked at once for every neighbour it gets.

use super::gaps::BLOCK;
use rustc_hash::FxHashMap;
use std::fs::File;
use std::io;
use std::sync::{Mutex, PoisonError, RwLock};

/// Bytes that are held in memory.
const MEMORY: usize = 160 << 20;

/// Rows of states, `[state][level]`, in single precision.
pub(super) struct Paths {
    /// Numbers a row.
    width: usize,
    memory: Vec<f32>,
    /// Rows held in memory.
    most: usize,
    beyond: Beyond,
}

/// What is not held in memory.
#[derive(Default)]
struct Beyond {
    file: Option<File>,
    /// Rows that could not be written to it.
    unwritten: RwLock<FxHashMap<u32, Vec<f32>>>,
    /// Why a row could not be read again.
    failure: Mutex<Option<io::Error>>,
}

/// Where a row is to be written.
pub(super) struct Row<'p>(Place<'p>);

enum Place<'p> {
    Memory(&'p mut [f32]),
    Beyond(&'p Beyond, u32),
}

impl Row<'_> {
    /// Writes the row.
    pub fn write(&mut self, numbers: &[f32]) {
        match &mut self.0 {
            Place::Memory(row) => row.copy_from_slice(numbers),
            Place::Beyond(beyond, row) => beyond.write(*row, numbers),
        }
    }
}

impl Paths {
    pub fn new(states: usize, levels: usize) -> Self {
        Self::within(states * levels.next_multiple_of(BLOCK), MEMORY)
    }

    fn within(width: usize, bytes: usize) -> Self {
        Self {
            width,
            memory: Vec::new(),
            most: (bytes / (4 * width.max(1))).max(1),
            beyond: Beyond::default(),
        }
    }

    pub fn width(&self) -> usize {
        self.width
    }

    /// Makes room for so many rows.
    pub fn reserve(&mut self, rows: usize) {
        if rows > self.most && self.beyond.file.is_none() {
            self.beyond.file = nameless();
            if self.beyond.file.is_none() {
                // Then all of it is held.
                self.most = usize::MAX;
            }
        }
        let held = rows.min(self.most) * self.width;
        if self.memory.len() < held {
            self.memory.resize(held, 0.0);
        }
    }

    /// Where these rows, in ascending order, are to be written.
    pub fn rows_mut(&mut self, rows: &[u32]) -> Vec<Row<'_>> {
        let (mut rest, beyond) = (&mut self.memory[..], &self.beyond);
        let (most, width) = (self.most, self.width);
        let mut first = 0;
        let place = |row: &u32| {
            if *row as usize >= most {
                return Row(Place::Beyond(beyond, *row));
            }
            let skipped = (*row as usize - first) * width;
            let (here, after) = std::mem::take(&mut rest)[skipped..].split_at_mut(width);
            rest = after;
            first = *row as usize + 1;
            Row(Place::Memory(here))
        };
        rows.iter().map(place).collect()
    }

    /// A row; `buffer` holds it where it is not in memory.
    pub fn read<'r>(&'r self, row: u32, buffer: &'r mut Vec<f32>) -> &'r [f32] {
        if (row as usize) < self.most {
            return &self.memory[row as usize * self.width..][..self.width];
        }
        buffer.resize(self.width, 0.0);
        self.beyond.read(row, buffer);
        buffer
    }

    /// Why what was set aside could not be read again, if so.
    pub fn failure(&self) -> Option<io::Error> {
        let mut failure = (self.beyond.failure.lock()).unwrap_or_else(PoisonError::into_inner);
        failure.take()
    }
}

impl Beyond {
    fn write(&self, row: u32, numbers: &[f32]) {
        let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_ne_bytes()).collect();
        let written = (self.file.as_ref())
            .is_some_and(|file| write_at(file, &bytes, offset(row, bytes.len())).is_ok());
        let any = !(self.unwritten.read())
            .unwrap_or_else(PoisonError::into_inner)
            .is_empty();
        if any || !written {
            let mut unwritten = (self.unwritten.write()).unwrap_or_else(PoisonError::into_inner);
            match written {
                true => unwritten.remove(&row),
                false => unwritten.insert(row, numbers.to_vec()),
            };
        }
    }

    fn read(&self, row: u32, numbers: &mut [f32]) {
        {
            let unwritten = (self.unwritten.read()).unwrap_or_else(PoisonError::into_inner);
            if let Some(held) = unwritten.get(&row) {
                numbers.copy_from_slice(held);
                return;
            }
        }
        let mut bytes = vec![0; 4 * numbers.len()];
        let read = match &self.file {
            Some(file) => read_at(file, &mut bytes, offset(row, 4 * numbers.len())),
            None => Err(io::ErrorKind::NotFound.into()),
        };
        if let Err(error) = read {
            *(self.failure.lock()).unwrap_or_else(PoisonError::into_inner) = Some(error);
        }
        for (x, bytes) in numbers.iter_mut().zip(bytes.as_chunks::<4>().0) {
            *x = f32::from_ne_bytes(*bytes);
        }
    }
}

fn offset(row: u32, bytes: usize) -> u64 {
    u64::from(row) * bytes as u64
}

/// A file in the directory for temporary ones that has no name, and goes with the process whatever
/// ends it.
#[cfg(target_os = "linux")]
fn nameless() -> Option<File> {
    use std::os::unix::fs::OpenOptionsExt;
    (File::options().read(true).write(true))
        .custom_flags(libc::O_TMPFILE)
        .mode(0o600)
        .open(std::env::temp_dir())
        .ok()
}

#[cfg(not(target_os = "linux"))]
fn nameless() -> Option<File> {
    None
}

#[cfg(unix)]
fn write_at(file: &File, bytes: &[u8], offset: u64) -> io::Result<()> {
    std::os::unix::fs::FileExt::write_all_at(file, bytes, offset)
}

#[cfg(unix)]
fn read_at(file: &File, bytes: &mut [u8], offset: u64) -> io::Result<()> {
    std::os::unix::fs::FileExt::read_exact_at(file, bytes, offset)
}

/// Not reached: there is no file.
#[cfg(not(unix))]
fn write_at(_: &File, _: &[u8], _: u64) -> io::Result<()> {
    Err(io::ErrorKind::Unsupported.into())
}

/// Not reached: there is no file.
#[cfg(not(unix))]
fn read_at(_: &File, _: &mut [u8], _: u64) -> io::Result<()> {
    Err(io::ErrorKind::Unsupported.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rows in memory, in the file and, where it cannot be written, beside it come back as they
    /// were, written over too.
    #[test]
    fn rows_come_back() {
        for broken in [false, true] {
            let width = 2 * BLOCK;
            let mut paths = Paths::within(width, 3 * 4 * width);
            paths.reserve(8);
            assert_eq!(paths.memory.len(), 3 * width);
            if broken {
                paths.beyond.file = File::open("/dev/null").ok();
            }
            let row = |r: u32, round: u32| -> Vec<f32> {
                (0..width)
                    .map(|k| (r * 100 + round) as f32 + k as f32)
                    .collect()
            };
            for round in 0..2 {
                let rows = [0, 2, 4, 7];
                for (place, r) in paths.rows_mut(&rows).iter_mut().zip(rows) {
                    place.write(&row(r, round));
                }
                let mut buffer = Vec::new();
                for r in rows {
                    assert_eq!(paths.read(r, &mut buffer), row(r, round));
                }
            }
            assert!(paths.failure().is_none());
        }
    }
}
