//! Round trips of declared groups, read back with the HDF5 layer itself.

use super::*;
use crate::files::testing::TemporaryDirectory;
use crate::hdf5::ResultFile;

fn table() -> Group {
    Group::new("table")
        .attribute("comment", "a test")
        .attribute("scale", 2.5)
        .attribute("entries", 3_i64)
        .dimension(Dimension::unlimited("row"))
        .dimension(Dimension::names("state", ["phi", "omega", "\u{3b8}"]))
        .dimension(Dimension::values("grid", vec![0.5, 1.5], "m"))
        .variable(Variable::f64("x", ["row", "state"]).unit("rad"))
        .variable(Variable::i32("status", ["row"]).flags([(0, "all well"), (7, "failed")]))
        .variable(Variable::f64("map", ["grid", "state"]))
        .variable(Variable::f64("gain", []))
        .variable(Variable::text("label", "state", ["a", "", "c"]))
}

/// The file made by `fill`, opened for reading.
fn round_trip(
    test: &str,
    group: &Group,
    fill: impl FnOnce(&mut GroupWriter),
) -> (TemporaryDirectory, H5File) {
    let directory = TemporaryDirectory::new(test);
    let mut file = ResultFile::create(directory.path().join("result.h5")).unwrap();
    fill(&mut file.group(group).unwrap());
    let path = file.finish().unwrap();
    let file = H5File::open(path).unwrap();
    (directory, file)
}

fn numbers<T: H5Type>(file: &H5File, name: &str) -> Vec<T> {
    file.dataset(name).unwrap().read_raw().unwrap()
}

/// Equal bits, so that NaN equals NaN.
fn bits(values: &[f64]) -> Vec<u64> {
    values.iter().map(|value| value.to_bits()).collect()
}

/// A number that has changed on the disk is an error, not another number: of an array that grows
/// and of one that stays as it is, however small.
#[test]
fn a_flipped_bit_is_an_error() {
    const X: f64 = 1.234_567_890_123;
    const MAP: f64 = 9.876_543_210_987;
    for (dataset, number) in [("table/x", X), ("table/map", MAP)] {
        let directory = TemporaryDirectory::new("flipped");
        let mut file = ResultFile::create(directory.path().join("result.h5")).unwrap();
        let mut writer = file.group(&table()).unwrap();
        let rows = [
            ("status", (&[0][..]).into()),
            ("x", (&[0.0, X, 1.0][..]).into()),
        ];
        writer.append(1, &rows).unwrap();
        writer
            .write("map", &[0.0, 1.0, MAP, 3.0, 4.0, 5.0][..])
            .unwrap();
        let path = file.finish().unwrap();

        let mut bytes = std::fs::read(&path).unwrap();
        let written = number.to_le_bytes();
        let at = bytes.windows(8).position(|window| window == written);
        bytes[at.unwrap() + 5] ^= 0x10;
        std::fs::write(&path, bytes).unwrap();
        let read = H5File::open(&path).and_then(|file| file.dataset(dataset)?.read_raw::<f64>());
        assert!(read.is_err(), "{dataset}: {read:?}");
    }
}

#[test]
fn uneven_blocks_come_back_in_order() {
    const BLOCKS: [usize; 8] = [1, 63, 0, 65, 345, 9000, 2, 20_000];
    let total: usize = BLOCKS.iter().sum();
    let x: Vec<f64> = (0..3 * total)
        .map(|n| if n % 7 == 3 { f64::NAN } else { n as f64 / 3.0 })
        .collect();
    let status: Vec<i32> = (0..total).map(|n| n as i32 % 11 - 5).collect();
    let fill = |writer: &mut GroupWriter| {
        let mut done = 0;
        for rows in BLOCKS {
            let x = &x[3 * done..3 * (done + rows)];
            let status = &status[done..done + rows];
            let block = [("status", status.into()), ("x", x.into())];
            writer.append(rows, &block).unwrap();
            done += rows;
            assert_eq!(writer.rows(), done);
        }
    };
    for compression in [Compression::None, Compression::ShuffleDeflate(1)] {
        let group = table().compression(compression);
        let (_directory, file) = round_trip("uneven", &group, fill);
        assert_eq!(file.dataset("table/x").unwrap().shape(), [total, 3]);
        assert_eq!(bits(&numbers(&file, "table/x")), bits(&x));
        assert_eq!(numbers::<i32>(&file, "table/status"), status);
        let index: Vec<i64> = (0..total as i64).collect();
        assert_eq!(numbers::<i64>(&file, "table/row"), index);
    }
}

#[test]
fn fixed_variables_coordinates_and_attributes() {
    let map = [1.0, f64::NAN, 3.0, 4.0, 5.0, 6.0];
    let (_directory, file) = round_trip("fixed", &table(), |writer| {
        writer.write("map", &map).unwrap();
        writer.write("gain", &[0.25]).unwrap();
    });
    assert_eq!(bits(&numbers(&file, "table/map")), bits(&map));
    assert_eq!(numbers::<f64>(&file, "table/gain"), [0.25]);
    assert_eq!(numbers::<f64>(&file, "table/grid"), [0.5, 1.5]);
    assert!(numbers::<f64>(&file, "table/x").is_empty());
    let texts = |name: &str| file.dataset(name).unwrap().read_vlen_strings().unwrap();
    assert_eq!(texts("table/state"), ["phi", "omega", "\u{3b8}"]);
    assert_eq!(texts("table/label"), ["a", "", "c"]);
    let status = file.dataset("table/status").unwrap();
    let text = |name: &str| status.attr(name).unwrap().read_string().unwrap();
    assert_eq!(text("flag_meanings"), "all_well failed");
    assert_eq!(text("units"), "1");
    let flags: Vec<i32> = status
        .attr("flag_values")
        .unwrap()
        .read_numeric_as()
        .unwrap();
    assert_eq!(flags, [0, 7]);
    let comment = file.root_group().group("table").unwrap();
    assert_eq!(comment.attr_string("comment").unwrap(), "a test");
}

#[test]
fn an_unwritten_variable_is_no_value() {
    let (_directory, file) = round_trip("unwritten", &table(), |_| {});
    assert!(
        numbers::<f64>(&file, "table/map")
            .iter()
            .all(|v| v.is_nan())
    );
    assert!(numbers::<f64>(&file, "table/gain")[0].is_nan());
}

#[test]
fn a_refused_block_writes_nothing() {
    let (x, status) = ([1.0, 2.0, 3.0], [4]);
    let (_directory, file) = round_trip("refused", &table(), |writer| {
        let refusals = [
            writer.append(1, &[("x", (&x).into())]),
            writer.append(2, &[("x", (&x).into()), ("status", (&status).into())]),
            writer.append(1, &[("x", (&status).into()), ("status", (&status).into())]),
            writer.append(1, &[("map", (&x).into())]),
            writer.write("map", &x),
            writer.write("status", &status),
        ];
        let kinds: Vec<&str> = refusals
            .iter()
            .map(|refusal| match refusal {
                Err(OutputError::MissingVariable { .. }) => "missing",
                Err(OutputError::Length { .. }) => "length",
                Err(OutputError::Type { .. }) => "type",
                Err(OutputError::UnknownVariable { .. }) => "unknown",
                _ => "other",
            })
            .collect();
        let expected = ["missing", "length", "type", "unknown", "length", "unknown"];
        assert_eq!(kinds, expected);
    });
    assert!(numbers::<f64>(&file, "table/x").is_empty());
    assert!(numbers::<i32>(&file, "table/status").is_empty());
}

#[test]
fn declarations_that_no_file_can_hold() {
    let directory = TemporaryDirectory::new("declarations");
    let mut file = ResultFile::create(directory.path().join("result.h5")).unwrap();
    let mut declare = |group: Group| file.group(&group).map(|_| ());
    let base = || Group::new("g").dimension(Dimension::unlimited("row"));
    let twice = base().variable(Variable::f64("row", ["row"]));
    assert!(matches!(declare(twice), Err(OutputError::Duplicate { .. })));
    let unknown = base().variable(Variable::f64("x", ["state"]));
    assert!(matches!(
        declare(unknown),
        Err(OutputError::UnknownDimension { .. })
    ));
    let empty = base().dimension(Dimension::index("sample", 0));
    assert!(matches!(
        declare(empty),
        Err(OutputError::EmptyDimension { .. })
    ));
    let second = base().dimension(Dimension::unlimited("other"));
    assert!(matches!(
        declare(second),
        Err(OutputError::GrowingDimension { .. })
    ));
    let late = base()
        .dimension(Dimension::index("sample", 2))
        .variable(Variable::f64("x", ["sample", "row"]));
    assert!(matches!(
        declare(late),
        Err(OutputError::GrowingDimension { .. })
    ));
    let slash = base().variable(Variable::f64("a/b", ["row"]));
    assert!(matches!(
        declare(slash),
        Err(OutputError::InvalidName { .. })
    ));
    let short = Group::new("g")
        .dimension(Dimension::index("sample", 2))
        .variable(Variable::text("label", "sample", ["one"]));
    assert!(matches!(declare(short), Err(OutputError::Length { .. })));
    // None of the refused declarations left a group behind.
    assert!(declare(base()).is_ok());
}

#[test]
fn a_writer_outlives_its_file_without_harm() {
    let directory = TemporaryDirectory::new("outlives");
    let mut file = ResultFile::create(directory.path().join("result.h5")).unwrap();
    let group = Group::new("g")
        .dimension(Dimension::unlimited("row"))
        .variable(Variable::f64("x", ["row"]));
    let mut writer = file.group(&group).unwrap();
    file.finish().unwrap();
    let late = writer.append(1, &[("x", (&[1.0]).into())]);
    assert!(matches!(late, Err(OutputError::Hdf5 { .. })));
}

#[test]
fn chunks_hold_whole_rows_within_their_size() {
    let rows = None;
    assert_eq!(chunk_shape(&[rows], 8, None), [CHUNK_ROWS]);
    assert_eq!(
        chunk_shape(&[rows, Some(201), Some(4)], 8, None),
        [81, 201, 4]
    );
    // A row larger than a chunk is cut, its leading dimension first.
    let long = chunk_shape(&[rows, Some(1_000_000), Some(4)], 8, None);
    assert_eq!(long, [1, CHUNK_BYTES / 32, 4]);
    // Few rows expected: small chunks, but not so small that the index could run out.
    assert_eq!(chunk_shape(&[rows, Some(201)], 8, Some(50)), [50, 201]);
    assert_eq!(chunk_shape(&[rows], 8, Some(1)), [LEAST_CHUNK_BYTES / 8]);
    assert_eq!(chunk_shape(&[Some(2), Some(3)], 8, None), [2, 3]);
}
