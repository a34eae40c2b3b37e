//! Groups whose rows lie in the files of parts, and what is known of these files.

use super::answers::{points_declared, points_sheets_declared};
use super::stored::{Stored, StoredError};
use super::table::{Data, NO_AXES, Table};
use super::{StoredGroup, TrajectorySchema};
use crate::files::allow_open;
use crate::hdf5::{GroupWriter, OutputError, ResultFile, RowsOf, Variable};
use crate::schema;
use crate::trajectories::{SolvedStates, SweptTrajectories};
use crate::value::PointStatus;
use rust_hdf5::H5File;
use std::fs::Metadata;
use std::path::Path;

/// The root attribute of a file that reads rows from others.
pub const VIRTUAL: &str = "virtual";
/// The root attribute that says what a part is a part of.
pub const MANIFEST: &str = "manifest";
/// The status of trajectories of a part that is not there.
const NO_TRAJECTORY: i32 = -1;

/// Files of parts, and how many rows of each group lie in each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ShardFiles {
    /// From the folder of the whole, or absolute.
    pub file: Vec<String>,
    pub shard: Vec<i32>,
    pub points: Vec<usize>,
    pub entries: Vec<usize>,
    pub trajectories: Vec<usize>,
    /// How long each is, and its root attribute [`MANIFEST`]: by these it is known again.
    pub bytes: Vec<u64>,
    pub manifest: Vec<String>,
}

impl ShardFiles {
    /// The variables of each group that are written to the whole itself.
    pub const OWN_OF_POINTS: [&'static str; 3] = ["given", "sheet", "lifted_sheet"];
    pub const OWN_OF_ENTRIES: [&'static str; 3] = ["point", "sheet", "lifted_sheet"];
    pub const OWN_OF_TRAJECTORIES: [&'static str; 2] = ["given", "sheet"];

    fn rows(&self, of: &[usize]) -> Vec<RowsOf> {
        let file = self.file.iter().cloned();
        (file.zip(of))
            .map(|(file, rows)| RowsOf { file, rows: *rows })
            .collect()
    }
}

impl ResultFile {
    /// Makes `/points` of so many rows, of which all but their sheets and places among the states
    /// given lie in files.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn points_elsewhere(
        &mut self,
        axes: &TrajectorySchema,
        rows: usize,
        files: &ShardFiles,
    ) -> Result<GroupWriter, OutputError> {
        let (own, absent) = (
            ShardFiles::OWN_OF_POINTS,
            [("status", PointStatus::NotMerged as i32)],
        );
        let group = points_declared(axes, rows, true)?;
        self.group(&group.rows_elsewhere(rows, &files.rows(&files.points), &own, &absent))
    }

    /// Makes `/points_sheets`, of which all but points and sheets lie in files.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn points_sheets_elsewhere(
        &mut self,
        axes: &TrajectorySchema,
        files: &ShardFiles,
    ) -> Result<GroupWriter, OutputError> {
        let (rows, own) = (files.entries.iter().sum(), ShardFiles::OWN_OF_ENTRIES);
        let group = points_sheets_declared(axes, rows)?;
        self.group(&group.rows_elsewhere(rows, &files.rows(&files.entries), &own, &[]))
    }

    /// Makes `/trajectories`, of which all but sheets and the states that they begin at lie in files.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn trajectories_elsewhere(
        &mut self,
        axes: &TrajectorySchema,
        files: &ShardFiles,
    ) -> Result<GroupWriter, OutputError> {
        let mut axes = axes.clone();
        let name = PointStatus::NotMerged.name().to_owned();
        axes.status_flags.push((NO_TRAJECTORY, name));
        let (rows, own) = (
            files.trajectories.iter().sum(),
            ShardFiles::OWN_OF_TRAJECTORIES,
        );
        let (files, absent) = (files.rows(&files.trajectories), [("status", NO_TRAJECTORY)]);
        let given = schema::TRAJECTORIES.variable("given");
        let given = Variable::i32("given", ["trajectory"])
            .long_name(given.map_or("", |variable| variable.meaning));
        let group = axes.group()?.variable(given);
        self.group(&group.rows_elsewhere(rows, &files, &own, &absent))
    }

    /// Writes `/shard_files`, and notes that rows lie in these files.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn shard_files(&mut self, files: &ShardFiles) -> Result<(), OutputError> {
        self.attribute(VIRTUAL, 1i64)?;
        let count = |of: &[usize]| -> Vec<i32> {
            let narrow = |n: &usize| i32::try_from(*n).unwrap_or(i32::MAX);
            of.iter().map(narrow).collect()
        };
        let bytes: Vec<f64> = files.bytes.iter().map(|n| *n as f64).collect();
        let mut table = Table::new(&schema::SHARD_FILES, &NO_AXES).length("part", files.file.len());
        table
            .put("file", Data::Text(files.file.clone()))
            .put("shard", &files.shard)
            .put("points", count(&files.points))
            .put("entries", count(&files.entries))
            .put("trajectories", count(&files.trajectories))
            .put("bytes", bytes)
            .put("manifest", Data::Text(files.manifest.clone()));
        table.write(self)
    }
}

/// The files that rows of a stored file lie in and that are not there; none of a file that has all
/// of its rows.
///
/// # Errors
/// [`StoredError::OtherPart`] and [`StoredError::InPlaceOf`] where HDF5 would read other numbers.
pub(super) fn absent(stored: &Stored) -> Result<Vec<String>, StoredError> {
    if !stored.has_attribute(VIRTUAL) {
        return Ok(Vec::new());
    }
    let Some(group) = stored.group(&schema::SHARD_FILES) else {
        return Ok(Vec::new());
    };
    let (files, bytes) = (group.texts("file")?, group.f64("bytes")?.values);
    let manifests = group.texts("manifest")?;
    // HDF5 opens all of them at once.
    allow_open(files.len() + 64);
    let folder = stored.path.parent().unwrap_or(Path::new(""));
    let mut absent = Vec::new();
    for ((file, bytes), manifest) in files.into_iter().zip(bytes).zip(manifests) {
        let (path, part) = (stored.name(), folder.join(&file));
        let is_same = |found: &Metadata| {
            found.len() as f64 == bytes && manifest_of(&part).is_some_and(|own| own == manifest)
        };
        match std::fs::metadata(&part) {
            Ok(found) if is_same(&found) => {}
            Ok(_) => return Err(StoredError::OtherPart { path, part: file }),
            // HDF5 goes on to look for it there.
            Err(_) if Path::new(&file).is_file() => {
                return Err(StoredError::InPlaceOf { path, part: file });
            }
            Err(_) => absent.push(file),
        }
    }
    Ok(absent)
}

fn manifest_of(path: &Path) -> Option<String> {
    let file = H5File::options().no_locking().open(path).ok()?;
    file.attr_string(MANIFEST).ok()
}

/// The rows of a group in the order in which the states were given; `None` where they are.
pub(super) fn given_order(
    group: &StoredGroup<'_>,
    rows: usize,
) -> Result<Option<Vec<usize>>, StoredError> {
    if !group.has("given") {
        return Ok(None);
    }
    let given = group.codes("given", rows)?;
    let mut order: Vec<usize> = (0..rows).collect();
    order.sort_by_key(|row| given[*row]);
    Ok(Some(order))
}

impl SolvedStates {
    /// So many rows, in this order; each of `widths` states and controls.
    pub(super) fn taken(&self, (n, m): (usize, usize), rows: &[usize]) -> Self {
        Self {
            count: rows.len(),
            x: taken(&self.x, n, rows),
            v: taken(&self.v, 1, rows),
            p: taken(&self.p, n, rows),
            u: taken(&self.u, m, rows),
            sheet: taken(&self.sheet, 1, rows),
            point: taken(&self.point, 1, rows),
            status: taken(&self.status, 1, rows),
            errors: taken(&self.errors, 1, rows),
        }
    }

    /// Takes the sheets of states whose V is not known.
    pub(super) fn forget_sheets(&mut self) {
        for (sheet, v) in self.sheet.iter_mut().zip(&self.v) {
            if v.is_nan() {
                *sheet = -1;
            }
        }
    }
}

impl SweptTrajectories {
    /// The same in this order.
    pub(super) fn in_order(self, rows: &[usize]) -> Self {
        let count = self.count.max(1);
        // What is copied goes at once.
        let of = |all: Vec<f64>| taken(&all, all.len() / count, rows);
        Self {
            t: of(self.t),
            x: of(self.x),
            p: of(self.p),
            u: of(self.u),
            v: of(self.v),
            h: of(self.h),
            status: taken(&self.status, 1, rows),
            sheet: taken(&self.sheet, 1, rows),
            ..self
        }
    }
}

/// Some rows of an array.
pub(super) fn taken<T: Copy>(all: &[T], width: usize, rows: &[usize]) -> Vec<T> {
    if all.is_empty() {
        return Vec::new();
    }
    (rows.iter())
        .flat_map(|row| all[row * width..][..width].iter().copied())
        .collect()
}
