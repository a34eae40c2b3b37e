//! The result file as its readers see it: `tests/check_result.py` on files of many shapes.
//!
//! The Python with h5py, xarray, netCDF4 and h5netcdf is `COSTATE_TEST_PYTHON`, else `python3`;
//! `tests/run.sh` makes one.

use std::path::{Path, PathBuf};
use std::process::Command;

use costate::low_level::hdf5::{Compression, ResultFile};
use costate::low_level::result::{Axis, RunRecord, TrajectorySchema};
use costate::low_level::trajectories::TrajectoryBlock;

/// One file to write and check.
struct Case {
    name: &'static str,
    states: usize,
    controls: usize,
    disturbances: usize,
    samples: usize,
    blocks: Vec<usize>,
    compression: Compression,
}

const PLAIN: Case = Case {
    name: "plain",
    states: 3,
    controls: 2,
    disturbances: 1,
    samples: 5,
    blocks: Vec::new(),
    compression: Compression::ShuffleDeflate(1),
};

fn axes(kind: &str, count: usize) -> Vec<Axis> {
    (0..count)
        .map(|n| Axis {
            name: format!("{kind}{n}"),
            unit: (n % 2 == 1).then(|| "rad/s".to_owned()),
            long_name: (n % 3 == 0).then(|| format!("{kind} number {n}, \u{3b8}\u{307}")),
        })
        .collect()
}

/// Trajectories `first..first + count`, every third of them without its last sample.
fn block(case: &Case, first: usize, count: usize) -> TrajectoryBlock {
    let samples = case.samples;
    let field = |width: usize, scale: f64| -> Vec<f64> {
        (0..count * samples * width)
            .map(|n| {
                let (trajectory, sample) = (n / (samples * width), n / width % samples);
                let missing = (first + trajectory) % 3 == 2 && sample + 1 == samples;
                let value = scale * ((first * samples * width + n) as f64).sin();
                if missing { f64::NAN } else { value }
            })
            .collect()
    };
    let t = (0..count * samples).map(|n| (n % samples) as f64 - samples as f64);
    let codes = |modulus: usize| {
        (first..first + count)
            .map(|n| (n % modulus) as i32)
            .collect()
    };
    let mut block = TrajectoryBlock {
        count,
        t: t.collect(),
        x: field(case.states, 1.0),
        p: field(case.states, 2.0),
        u: field(case.controls, 3.0),
        w: field(case.disturbances, 4.0),
        v: field(1, 5.0),
        h: field(1, 1e-9),
        status: codes(2),
        sheet: codes(1),
        steps: codes(97),
        rejected: codes(5),
        hamiltonian_drift: vec![1e-9; count],
    };
    for (t, v) in block.t.iter_mut().zip(&block.v) {
        if v.is_nan() {
            *t = f64::NAN;
        }
    }
    block
}

fn write(case: &Case, path: &Path) {
    let mut file = ResultFile::create(path).unwrap();
    let mut writer = file
        .trajectories(&TrajectorySchema {
            states: axes("state", case.states),
            controls: axes("control", case.controls),
            disturbances: axes("disturbance", case.disturbances),
            samples: case.samples,
            status_flags: vec![
                (0, "reached the level".to_owned()),
                (1, "left the region".to_owned()),
            ],
            expected_trajectories: Some(case.blocks.iter().sum()),
            compression: case.compression,
            ..TrajectorySchema::default()
        })
        .unwrap();
    for count in &case.blocks {
        let next = block(case, writer.count(), *count);
        writer.append(&next).unwrap();
    }
    let record = RunRecord {
        title: "test".to_owned(),
        // Longer than the 64 KiB that an attribute can hold in place.
        scenario: "theta = \"\u{3b8}\"\n".repeat(10_000),
        created: costate::low_level::result::utc_timestamp(std::time::SystemTime::now()),
        rtol: 1e-8,
        ..RunRecord::default()
    };
    record.write(&file).unwrap();
    file.finish().unwrap();
}

/// Runs the checks on a file; the error is what they printed.
fn check(path: &Path) -> Result<(), String> {
    let python = std::env::var("COSTATE_TEST_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let script = Path::new(crate::ROOT).join("tests/check_result.py");
    let output = Command::new(&python)
        .args([&script, path])
        .output()
        .unwrap_or_else(|error| panic!("{python}: {error}; tests/run.sh sets one up"));
    if output.status.success() {
        return Ok(());
    }
    Err(String::from_utf8_lossy(&output.stderr).into_owned())
}

fn scratch(name: &str) -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{name}.h5"))
}

#[track_caller]
fn assert_readable(case: &Case) {
    let path = scratch(case.name);
    write(case, &path);
    if let Err(message) = check(&path) {
        panic!("{}: {message}", case.name);
    }
    std::fs::remove_file(path).unwrap();
}

#[test]
fn many_uneven_blocks() {
    assert_readable(&Case {
        name: "uneven",
        blocks: vec![1, 63, 0, 65, 345, 1, 1, 7000, 2],
        ..PLAIN
    });
}

#[test]
fn no_trajectory() {
    assert_readable(&Case {
        name: "none",
        ..PLAIN
    });
}

#[test]
fn one_of_everything() {
    assert_readable(&Case {
        name: "one",
        states: 1,
        controls: 0,
        disturbances: 0,
        samples: 1,
        blocks: vec![1],
        ..PLAIN
    });
}

#[test]
fn uncompressed_without_controls() {
    assert_readable(&Case {
        name: "uncompressed",
        controls: 0,
        blocks: vec![100, 28],
        compression: Compression::None,
        ..PLAIN
    });
}

#[test]
fn a_trajectory_longer_than_a_chunk() {
    assert_readable(&Case {
        name: "long",
        samples: 50_001,
        disturbances: 0,
        blocks: vec![2, 1, 4],
        ..PLAIN
    });
}

#[test]
fn the_checks_can_fail() {
    let path = scratch("no-record");
    let mut file = ResultFile::create(&path).unwrap();
    let schema = TrajectorySchema {
        states: axes("state", 1),
        samples: 1,
        status_flags: vec![(0, "reached the level".to_owned())],
        ..TrajectorySchema::default()
    };
    file.trajectories(&schema).unwrap();
    file.finish().unwrap();
    let message = check(&path).unwrap_err();
    assert!(message.contains("no root attribute title"), "{message}");
    std::fs::remove_file(path).unwrap();
}
