//! Filling a declared group.

use std::path::{Path, PathBuf};

use rust_hdf5::{FilterPipeline, H5Dataset, H5File, H5Group, H5Type, Hdf5Error};

use super::attribute::AttributeOwner;
use super::elsewhere::{Elsewhere, virtual_dataset};
use super::spec::{Coordinate, Storage};
use super::{AttributeValue, Compression, Dimension, Group, OutputError, Variable};
use crate::files::Behind;

/// Bytes of a chunk, before compression: large enough that the calls cost nothing, within the 1 MiB
/// chunk cache of readers.
const CHUNK_BYTES: usize = 512 * 1024;
/// Most rows of a chunk, so that the one-dimensional variables of a short group stay small too.
const CHUNK_ROWS: usize = 8192;
/// Least rows times bytes of a chunk when few rows are expected: the HDF5 layer indexes no more
/// than about 131,000 chunks of a growing variable, and more rows than expected may come.
const LEAST_CHUNK_BYTES: usize = 16 * 1024;

/// Values of one variable, row-major in the order of its dimensions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Values<'v> {
    /// For a variable of [`Variable::f64`], or of [`Variable::f32`], which rounds them.
    F64(&'v [f64]),
    /// For a variable of [`Variable::i32`].
    I32(&'v [i32]),
}

impl Values<'_> {
    fn len(&self) -> usize {
        match self {
            Self::F64(values) => values.len(),
            Self::I32(values) => values.len(),
        }
    }

    fn kind(&self) -> &'static str {
        match self {
            Self::F64(_) => F64,
            Self::I32(_) => I32,
        }
    }
}

impl<'v> From<&'v [f64]> for Values<'v> {
    fn from(values: &'v [f64]) -> Self {
        Self::F64(values)
    }
}

impl<'v, const N: usize> From<&'v [f64; N]> for Values<'v> {
    fn from(values: &'v [f64; N]) -> Self {
        Self::F64(values)
    }
}

impl<'v> From<&'v Vec<f64>> for Values<'v> {
    fn from(values: &'v Vec<f64>) -> Self {
        Self::F64(values)
    }
}

impl<'v> From<&'v [i32]> for Values<'v> {
    fn from(values: &'v [i32]) -> Self {
        Self::I32(values)
    }
}

impl<'v, const N: usize> From<&'v [i32; N]> for Values<'v> {
    fn from(values: &'v [i32; N]) -> Self {
        Self::I32(values)
    }
}

impl<'v> From<&'v Vec<i32>> for Values<'v> {
    fn from(values: &'v Vec<i32>) -> Self {
        Self::I32(values)
    }
}

const F64: &str = "f64";
const I32: &str = "i32";

/// A numeric variable in the file.
struct Column {
    name: String,
    kind: &'static str,
    /// Elements of one row when the variable grows, of the whole otherwise.
    elements: usize,
    grows: bool,
    /// Whether it is stored in f32.
    single: bool,
    dataset: H5Dataset,
}

impl Column {
    /// Appends values, or writes all of them; how many bytes they take.
    fn store(&self, values: Values<'_>) -> Result<usize, Hdf5Error> {
        match values {
            Values::F64(values) if self.single => {
                let rounded: Vec<f32> = values.iter().map(|v| *v as f32).collect();
                self.put(&rounded)
            }
            Values::F64(values) => self.put(values),
            Values::I32(values) => self.put(values),
        }
    }

    fn put<T: H5Type>(&self, values: &[T]) -> Result<usize, Hdf5Error> {
        match self.grows {
            true => self.dataset.append(values)?,
            false => self.dataset.write_raw(values)?,
        }
        Ok(size_of_val(values))
    }
}

/// Fills a group made by [`ResultFile::group`](super::ResultFile::group).
///
/// What it holds in memory is at most one chunk (about half a MiB) for each variable, however much
/// is appended.
pub struct GroupWriter {
    path: PathBuf,
    behind: Behind,
    group: String,
    rows: usize,
    growing_index: Option<H5Dataset>,
    columns: Vec<Column>,
}

impl std::fmt::Debug for GroupWriter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("GroupWriter")
            .field("path", &self.path)
            .field("group", &self.group)
            .field("rows", &self.rows)
            .finish_non_exhaustive()
    }
}

impl GroupWriter {
    /// `path`: the file's name, for errors.
    pub(super) fn create(
        file: &H5File,
        path: &Path,
        behind: Behind,
        group: &Group,
    ) -> Result<Self, OutputError> {
        let fail = |object: &str| {
            let object = format!("`/{}{object}`", group.name);
            move |error| OutputError::from_hdf5(path, &object, error)
        };
        let maker = Maker {
            h5: file.create_group(&group.name).map_err(fail(""))?,
            group,
        };
        for (name, value) in &group.attributes {
            maker.h5.set(name, value).map_err(fail(""))?;
        }
        let mut scales = Vec::new();
        for dimension in &group.dimensions {
            let object = format!("/{}", dimension.name);
            scales.push(maker.scale(dimension).map_err(fail(&object))?);
        }
        let mut columns = Vec::new();
        for variable in &group.variables {
            let object = format!("/{}", variable.name);
            columns.extend(maker.variable(variable, &scales).map_err(fail(&object))?);
        }
        let growing_index = group
            .dimensions
            .iter()
            .zip(scales)
            .find_map(|(dimension, scale)| dimension.length().is_none().then_some(scale));
        Ok(Self {
            path: path.to_owned(),
            behind,
            group: group.name.clone(),
            rows: 0,
            growing_index,
            columns,
        })
    }

    /// How many rows have been appended.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Appends `rows` rows to every growing variable: `block` has the values of each of them, in
    /// any order. Nothing is written when the block is refused.
    ///
    /// # Errors
    /// [`OutputError::NotGrowing`], [`OutputError::UnknownVariable`],
    /// [`OutputError::MissingVariable`], [`OutputError::Length`] and [`OutputError::Type`] on the
    /// block; [`OutputError::File`] and [`OutputError::Hdf5`] on writing.
    pub fn append(&mut self, rows: usize, block: &[(&str, Values<'_>)]) -> Result<(), OutputError> {
        let Some(index) = &self.growing_index else {
            return Err(OutputError::NotGrowing {
                group: self.group.clone(),
            });
        };
        for (name, values) in block {
            let column = self.column(name, true)?;
            self.check(column, rows * column.elements, values)?;
        }
        let mut order = Vec::with_capacity(self.columns.len());
        for column in self.columns.iter().filter(|column| column.grows) {
            let Some((_, values)) = block.iter().find(|(name, _)| *name == column.name) else {
                return Err(OutputError::MissingVariable {
                    group: self.group.clone(),
                    variable: column.name.clone(),
                });
            };
            order.push((column, *values));
        }
        if rows == 0 {
            return Ok(());
        }
        let mut bytes = 0;
        for (column, values) in order {
            bytes += (column.store(values)).map_err(|error| self.error(&column.name, error))?;
        }
        let numbers: Vec<i64> = (self.rows..self.rows + rows).map(|n| n as i64).collect();
        index
            .append(&numbers)
            .map_err(|error| self.error("the index", error))?;
        self.rows += rows;
        self.behind.wrote(bytes);
        Ok(())
    }

    /// Writes the whole of a variable that does not grow. One that is never written holds NaN, or 0
    /// for integers.
    ///
    /// # Errors
    /// [`OutputError::UnknownVariable`], [`OutputError::Length`] and [`OutputError::Type`] on the
    /// values; [`OutputError::File`] and [`OutputError::Hdf5`] on writing.
    pub fn write<'v>(
        &mut self,
        name: &str,
        values: impl Into<Values<'v>>,
    ) -> Result<(), OutputError> {
        let values = values.into();
        let column = self.column(name, false)?;
        self.check(column, column.elements, &values)?;
        match column.store(values) {
            Ok(_) => Ok(()),
            Err(error) => Err(self.error(name, error)),
        }
    }

    /// Writes a part of a variable that does not grow: from `first` on along its first dimension, as
    /// much as there are values.
    ///
    /// # Errors
    /// Those of [`write`](Self::write).
    pub fn write_from<'v>(
        &mut self,
        name: &str,
        first: usize,
        values: impl Into<Values<'v>>,
    ) -> Result<(), OutputError> {
        let values = values.into();
        let column = self.column(name, false)?;
        let shape = column.dataset.shape();
        let inner: usize = shape.iter().skip(1).product();
        let count = values.len() / inner.max(1);
        let left = shape.first().map_or(0, |all| all.saturating_sub(first));
        self.check(column, count.min(left) * inner, &values)?;
        let starts: Vec<usize> = (0..shape.len())
            .map(|i| if i == 0 { first } else { 0 })
            .collect();
        let mut counts = shape;
        if let Some(along) = counts.first_mut() {
            *along = count;
        }
        let written = match values {
            Values::F64(values) => column.dataset.write_slice(&starts, &counts, values),
            Values::I32(values) => column.dataset.write_slice(&starts, &counts, values),
        };
        written.map_err(|error| self.error(name, error))
    }

    fn column(&self, name: &str, grows: bool) -> Result<&Column, OutputError> {
        self.columns
            .iter()
            .find(|column| column.name == name && column.grows == grows)
            .ok_or_else(|| OutputError::UnknownVariable {
                group: self.group.clone(),
                variable: name.to_owned(),
            })
    }

    fn check(
        &self,
        column: &Column,
        expected: usize,
        values: &Values<'_>,
    ) -> Result<(), OutputError> {
        if values.kind() != column.kind {
            return Err(OutputError::Type {
                group: self.group.clone(),
                variable: column.name.clone(),
                expected: column.kind,
                found: values.kind(),
            });
        }
        if values.len() != expected {
            return Err(OutputError::Length {
                group: self.group.clone(),
                variable: column.name.clone(),
                expected,
                found: values.len(),
            });
        }
        Ok(())
    }

    fn error(&self, variable: &str, error: Hdf5Error) -> OutputError {
        OutputError::from_hdf5(&self.path, &format!("`/{}/{variable}`", self.group), error)
    }
}

/// Makes the datasets of a group.
struct Maker<'g> {
    h5: H5Group,
    group: &'g Group,
}

impl Maker<'_> {
    /// The coordinate variable of a dimension, which is its dimension scale.
    fn scale(&self, dimension: &Dimension) -> Result<H5Dataset, Hdf5Error> {
        let name = dimension.name.as_str();
        let (scale, unit) = match &dimension.coordinate {
            Coordinate::Unlimited => (self.dataset::<i64>(name, &[None], None)?, "1"),
            Coordinate::Index { length } => {
                let scale = self.dataset::<i64>(name, &[Some(*length)], None)?;
                // A chunk at a time: there may be many.
                let at_once = CHUNK_BYTES / size_of::<i64>();
                for first in (0..*length).step_by(at_once) {
                    let count = at_once.min(length - first);
                    let numbers: Vec<i64> = (first..first + count).map(|n| n as i64).collect();
                    scale.write_slice(&[first], &[count], &numbers)?;
                }
                (scale, "1")
            }
            Coordinate::Names(names) => (self.texts(name, names)?, "1"),
            Coordinate::Values { values, unit } => {
                let scale = self.dataset::<f64>(name, &[Some(values.len())], None)?;
                scale.write_raw(values)?;
                (scale, unit.as_str())
            }
        };
        describe(&scale, unit, &dimension.long_name)?;
        scale.set_scale(Some(name))?;
        Ok(scale)
    }

    /// A variable, with `scales` in the order of the group's dimensions; `None` for one of texts,
    /// which is complete, and for one that lies elsewhere.
    fn variable(
        &self,
        variable: &Variable,
        scales: &[H5Dataset],
    ) -> Result<Option<Column>, Hdf5Error> {
        let shape: Vec<Option<usize>> = variable
            .dimensions
            .iter()
            .map(|name| self.group.find_dimension(name)?.length())
            .collect();
        let name = variable.name.as_str();
        let (dataset, kind) = match (&variable.storage, &variable.elsewhere) {
            (Storage::F64, None) => (self.dataset(name, &shape, Some(f64::NAN))?, Some(F64)),
            (Storage::F64, Some(of)) => (self.elsewhere(name, &shape, f64::NAN, of)?, Some(F64)),
            (Storage::F32, None) => (self.dataset(name, &shape, Some(f32::NAN))?, Some(F64)),
            (Storage::F32, Some(of)) => (self.elsewhere(name, &shape, f32::NAN, of)?, Some(F64)),
            (Storage::I32, None) => (self.dataset::<i32>(name, &shape, None)?, Some(I32)),
            (Storage::I32, Some(of)) => (self.elsewhere(name, &shape, of.absent, of)?, Some(I32)),
            (Storage::Text(texts), _) => (self.texts(name, texts)?, None),
        };
        describe(&dataset, &variable.unit, &variable.long_name)?;
        let single = variable.storage == Storage::F32;
        if single {
            let fill = dataset.new_attr::<f32>().shape([1]).create("_FillValue")?;
            fill.write_array(&[f32::NAN])?;
        } else if kind == Some(F64) {
            let fill = dataset.new_attr::<f64>().shape([1]).create("_FillValue")?;
            fill.write_array(&[f64::NAN])?;
        }
        for (name, value) in &variable.attributes {
            dataset.set(name, value)?;
        }
        for (axis, name) in variable.dimensions.iter().enumerate() {
            let mut dimensions = self.group.dimensions.iter().zip(scales);
            if let Some((_, scale)) = dimensions.find(|(dimension, _)| dimension.name == *name) {
                dataset.attach_scale(axis, scale)?;
            }
        }
        let here = kind.filter(|_| variable.elsewhere.is_none());
        Ok(here.map(|kind| Column {
            name: variable.name.clone(),
            kind,
            elements: shape.iter().flatten().product(),
            grows: shape.contains(&None),
            single,
            dataset,
        }))
    }

    /// A dataset whose numbers lie in other files, or are `fill`.
    fn elsewhere<T: H5Type>(
        &self,
        name: &str,
        shape: &[Option<usize>],
        fill: T,
        of: &Elsewhere,
    ) -> Result<H5Dataset, Hdf5Error> {
        let now: Vec<usize> = shape.iter().map(|n| n.unwrap_or(0)).collect();
        let object = (self.group.name.as_str(), name);
        match virtual_dataset(&self.h5, object, &now, fill, &of.files)? {
            Some(dataset) => Ok(dataset),
            None => self.dataset(name, shape, Some(fill)),
        }
    }

    /// A numeric dataset; `None` in `shape` grows from 0.
    fn dataset<T: H5Type>(
        &self,
        name: &str,
        shape: &[Option<usize>],
        fill: Option<T>,
    ) -> Result<H5Dataset, Hdf5Error> {
        let now: Vec<usize> = shape.iter().map(|n| n.unwrap_or(0)).collect();
        let mut builder = self.h5.new_dataset::<T>().shape(&now);
        if let Some(fill) = fill {
            builder = builder.fill_value(fill);
        }
        let elements: usize = shape.iter().flatten().product();
        // A single number, or none, has no chunks.
        if !shape.is_empty() && elements > 0 {
            let bytes = T::element_size();
            let chunk = chunk_shape(shape, bytes, self.group.expected_rows);
            builder = builder.chunk(&chunk).max_shape(shape);
            if let Some(filters) = filters(self.group.compression, bytes) {
                builder = builder.filter_pipeline(filters);
            }
        }
        builder.create(name)
    }

    fn texts(&self, name: &str, texts: &[String]) -> Result<H5Dataset, Hdf5Error> {
        let texts: Vec<&str> = texts.iter().map(String::as_str).collect();
        self.h5.write_vlen_strings(name, &texts)
    }
}

fn describe(dataset: &H5Dataset, unit: &str, long_name: &str) -> Result<(), Hdf5Error> {
    dataset.set("units", &AttributeValue::from(unit))?;
    dataset.set("long_name", &AttributeValue::from(long_name))
}

/// How chunks are stored: as zlib streams, which have checksums, since a number that has changed on
/// a disk would be read as another V. (Of HDF5's own checksum filter, `fletcher32`, the HDF5 layer
/// looks at nothing when it reads.)
fn filters(compression: Compression, element_bytes: usize) -> Option<FilterPipeline> {
    match compression {
        Compression::None => None,
        Compression::Checked => Some(FilterPipeline::deflate(0)),
        Compression::ShuffleDeflate(level) => Some(FilterPipeline::shuffle_deflate(
            element_bytes as u32,
            u32::from(level.min(9)),
        )),
    }
}

/// The chunk of a dataset: whole rows as far as they fit, so that appending touches one chunk at a
/// time; the leading dimensions are cut first.
fn chunk_shape(
    shape: &[Option<usize>],
    element_bytes: usize,
    expected_rows: Option<usize>,
) -> Vec<usize> {
    let mut inner = element_bytes;
    let mut chunk = vec![1; shape.len()];
    for (size, length) in chunk.iter_mut().zip(shape).rev() {
        let room = (CHUNK_BYTES / inner).max(1);
        *size = match length {
            Some(length) => room.min(*length),
            None => {
                let least = LEAST_CHUNK_BYTES.div_ceil(inner);
                let wanted = expected_rows.map_or(CHUNK_ROWS, |rows| rows.max(least));
                room.min(wanted).min(CHUNK_ROWS)
            }
        };
        inner *= *size;
    }
    chunk
}

#[cfg(test)]
mod tests;
