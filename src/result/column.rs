//! A variable of a stored file that is read in parts.

use super::StoredError;
use rust_hdf5::{DatatypeMessage, H5Dataset};
use std::path::{Path, PathBuf};

/// A variable of a file of which rows are read as they are wanted.
pub struct StoredColumn {
    path: PathBuf,
    object: String,
    /// Along its first dimension, and the lengths of the others.
    pub rows: usize,
    pub inner: Vec<usize>,
    /// Whether it has integers.
    pub whole: bool,
    /// Whether it has real numbers of 32 bits.
    pub single: bool,
    dataset: H5Dataset,
}

impl StoredColumn {
    /// `object`: how messages call it.
    pub(super) fn new(path: &Path, object: String, dataset: H5Dataset) -> Self {
        let shape = dataset.shape();
        Self {
            path: path.to_owned(),
            object,
            rows: shape.first().copied().unwrap_or(0),
            inner: shape.get(1..).unwrap_or_default().to_vec(),
            whole: matches!(dataset.datatype(), Ok(DatatypeMessage::FixedPoint { .. })),
            single: matches!(
                dataset.datatype(),
                Ok(DatatypeMessage::FloatingPoint { size: 4, .. })
            ),
            dataset,
        }
    }

    /// Numbers of one row.
    pub fn width(&self) -> usize {
        self.inner.iter().product()
    }

    /// Some rows of real numbers.
    ///
    /// # Errors
    /// [`StoredError::Object`] where they cannot be read.
    pub fn f64(&self, first: usize, count: usize) -> Result<Vec<f64>, StoredError> {
        if !self.single {
            return self.read(first, count);
        }
        let numbers: Vec<f32> = self.read(first, count)?;
        Ok(numbers.into_iter().map(f64::from).collect())
    }

    /// Some rows of integers.
    ///
    /// # Errors
    /// [`StoredError::Object`] where they cannot be read.
    pub fn i32(&self, first: usize, count: usize) -> Result<Vec<i32>, StoredError> {
        self.read(first, count)
    }

    fn read<T: rust_hdf5::H5Type>(
        &self,
        first: usize,
        count: usize,
    ) -> Result<Vec<T>, StoredError> {
        let starts: Vec<usize> = std::iter::once(first)
            .chain(self.inner.iter().map(|_| 0))
            .collect();
        let counts: Vec<usize> = std::iter::once(count)
            .chain(self.inner.iter().copied())
            .collect();
        if counts.contains(&0) {
            return Ok(Vec::new());
        }
        let read = self.dataset.read_slice(&starts, &counts);
        read.map_err(|e| self.error(e.to_string()))
    }

    /// An error that names it.
    pub fn error(&self, reason: String) -> StoredError {
        StoredError::Object {
            path: self.path.clone(),
            object: self.object.clone(),
            reason,
        }
    }
}
