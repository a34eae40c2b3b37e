//! Variables whose numbers lie in other files: virtual datasets of HDF5.

use super::Group;
use super::spec::{Coordinate, Storage};
use rust_hdf5::{H5Group, H5Type, Hdf5Error, Hyperslab, HyperslabBlock, Selection};
use std::sync::Arc;

/// Rows that lie in another file, in its group and variable of the same names.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RowsOf {
    /// The file: from the folder of the one that reads from it, or absolute.
    pub file: String,
    /// How many of its rows, from the first on.
    pub rows: usize,
}

/// Where the numbers of a variable lie, and what stands for integers that are nowhere.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Elsewhere {
    pub files: Arc<[RowsOf]>,
    pub absent: i32,
}

impl Group {
    /// Makes the growing dimension one of `rows` rows, of which the first ones lie in `files`, one
    /// file after the other; only the variables named in `own` are written here. Beyond them, and
    /// where a file is not there when it is read, real numbers are NaN and integers 0, or what
    /// `absent` names for them.
    #[must_use]
    pub fn rows_elsewhere(
        mut self,
        rows: usize,
        files: &[RowsOf],
        own: &[&str],
        absent: &[(&str, i32)],
    ) -> Self {
        let files: Arc<[RowsOf]> = files.into();
        let mut growing = self.dimensions.iter_mut();
        let Some(dimension) = growing.find(|d| d.length().is_none()) else {
            return self;
        };
        dimension.coordinate = Coordinate::Index { length: rows };
        for variable in &mut self.variables {
            let grows = variable.dimensions.first() == Some(&dimension.name);
            let is_text = matches!(variable.storage, Storage::Text(_));
            let name = variable.name.as_str();
            if grows && !is_text && !own.contains(&name) {
                let found = absent.iter().find(|(of, _)| *of == name);
                variable.elsewhere = Some(Elsewhere {
                    files: Arc::clone(&files),
                    absent: found.map_or(0, |(_, code)| *code),
                });
            }
        }
        self
    }
}

/// Makes a virtual dataset; `None` where no file has any of its rows.
pub(super) fn virtual_dataset<T: H5Type>(
    h5: &H5Group,
    (group, name): (&str, &str),
    shape: &[usize],
    fill: T,
    files: &[RowsOf],
) -> Result<Option<rust_hdf5::H5Dataset>, Hdf5Error> {
    let mut builder = h5.new_dataset::<T>().shape(shape).fill_value(fill);
    let source = format!("/{group}/{name}");
    let mut first = 0;
    for of in files.iter().filter(|of| of.rows > 0) {
        builder = builder.virtual_mapping(
            selection(first, of.rows, shape),
            &escaped(&of.file),
            &escaped(&source),
            selection(0, of.rows, shape),
        );
        first += of.rows;
    }
    match first {
        0 => Ok(None),
        _ => builder.create(name).map(Some),
    }
}

/// Whole rows.
fn selection(first: usize, rows: usize, shape: &[usize]) -> Selection {
    let inner = shape.iter().skip(1);
    let start = std::iter::once(first).chain(inner.clone().map(|_| 0));
    let end = std::iter::once(first + rows - 1).chain(inner.map(|n| n - 1));
    let wide = |n: usize| n as u64;
    Selection::Hyperslab {
        rank: shape.len(),
        form: Hyperslab::Blocks(vec![HyperslabBlock {
            start: start.map(wide).collect(),
            end: end.map(wide).collect(),
        }]),
    }
}

/// A per cent sign begins a pattern in these names.
fn escaped(name: &str) -> String {
    name.replace('%', "%%")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::testing::TemporaryDirectory;
    use crate::hdf5::{Dimension, ResultFile, Values, Variable};
    use rust_hdf5::H5File;

    fn group() -> Group {
        Group::new("points")
            .dimension(Dimension::unlimited("point"))
            .dimension(Dimension::names("state", ["phi", "omega"]))
            .variable(Variable::f64("x", ["point", "state"]))
            .variable(Variable::i32("status", ["point"]))
            .variable(Variable::i32("sheet", ["point"]))
    }

    /// So many rows, numbered from `first` on.
    fn part(path: &std::path::Path, first: i32, rows: i32) {
        let mut file = ResultFile::create(path).unwrap();
        let mut writer = file.group(&group()).unwrap();
        let x: Vec<f64> = (2 * first..2 * (first + rows)).map(f64::from).collect();
        let whole: Vec<i32> = (first..first + rows).collect();
        writer
            .append(
                rows as usize,
                &[
                    ("x", Values::F64(&x)),
                    ("status", Values::I32(&whole)),
                    ("sheet", Values::I32(&whole)),
                ],
            )
            .unwrap();
        file.finish().unwrap();
    }

    fn read(path: &std::path::Path) -> (Vec<f64>, Vec<i32>, Vec<i32>) {
        let back = H5File::open(path).unwrap();
        let whole = |name: &str| back.dataset(name).unwrap().read_raw::<i32>().unwrap();
        let x = back.dataset("points/x").unwrap();
        assert_eq!(x.shape(), [8, 2]);
        (
            x.read_raw().unwrap(),
            whole("points/status"),
            whole("points/sheet"),
        )
    }

    /// The first rows of each part, in a folder of another name, and a row that no part has.
    #[test]
    fn rows_are_read_where_they_lie() {
        let directory = TemporaryDirectory::new("elsewhere");
        let at = |name: &str| directory.path().join(name);
        std::fs::create_dir(at("parts")).unwrap();
        part(&at("parts/90%.h5"), 0, 5);
        part(&at("parts/b.h5"), 5, 3);
        let files = [("parts/90%.h5", 4), ("parts/none.h5", 0), ("parts/b.h5", 3)];
        let files = files.map(|(file, rows)| RowsOf {
            file: file.to_owned(),
            rows,
        });
        let mut file = ResultFile::create(at("all.h5")).unwrap();
        let group = group().rows_elsewhere(8, &files, &["sheet"], &[("status", 13)]);
        let mut writer = file.group(&group).unwrap();
        writer.write_from("sheet", 0, &[7, 6, 5, 4, 3]).unwrap();
        writer.write_from("sheet", 5, &[2, 1, 0]).unwrap();
        assert!(writer.write("status", &[0; 8]).is_err());
        file.finish().unwrap();

        let (x, status, sheet) = read(&at("all.h5"));
        assert_eq!(x[..8], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]);
        assert_eq!(x[8..14], [10.0, 11.0, 12.0, 13.0, 14.0, 15.0]);
        assert!(x[14..].iter().all(|x| x.is_nan()));
        assert_eq!(status, [0, 1, 2, 3, 5, 6, 7, 13]);
        assert_eq!(sheet, [7, 6, 5, 4, 3, 2, 1, 0]);

        // What is added later leaves it as it is.
        let mut file = ResultFile::extend(at("all.h5"), &["other"]).unwrap();
        let other = Group::new("other")
            .dimension(Dimension::index("k", 2))
            .variable(Variable::f64("y", ["k"]));
        file.group(&other).unwrap().write("y", &[1.0, 2.0]).unwrap();
        file.finish().unwrap();
        let again = read(&at("all.h5"));
        assert_eq!((&again.1, &again.2), (&status, &sheet));
        assert_eq!(again.0[..14], x[..14]);

        // The folder can be moved; what is no longer there is not known.
        std::fs::create_dir(at("moved")).unwrap();
        std::fs::rename(at("all.h5"), at("moved/all.h5")).unwrap();
        std::fs::rename(at("parts"), at("moved/parts")).unwrap();
        assert_eq!(read(&at("moved/all.h5")).1, status);
        std::fs::remove_file(at("moved/parts/90%.h5")).unwrap();
        let (x, status, _) = read(&at("moved/all.h5"));
        assert_eq!(status, [13, 13, 13, 13, 5, 6, 7, 13]);
        assert!(x[..8].iter().all(|x| x.is_nan()) && x[8] == 10.0);
    }

    #[test]
    fn a_group_without_any_file_knows_nothing() {
        let directory = TemporaryDirectory::new("nowhere");
        let path = directory.path().join("all.h5");
        let mut file = ResultFile::create(&path).unwrap();
        let group = group().rows_elsewhere(8, &[], &["sheet"], &[("status", 13)]);
        file.group(&group).unwrap();
        file.finish().unwrap();
        let (x, status, sheet) = read(&path);
        assert!(x.iter().all(|x| x.is_nan()));
        assert_eq!((status, sheet), (vec![13; 8], vec![0; 8]));
    }
}
