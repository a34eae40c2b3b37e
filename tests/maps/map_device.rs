//! A map in pieces asked on a GPU: against the CPU's evaluator, and against an exact value
//! function.

use crate::common_commands;
use crate::common_problems::{Exact, manufactured};

use common_commands::made_up::made_up;
use common_commands::{costate, done, scenario, scene, scratch};
use costate::backend::Backend;
use costate::backend::gpu::{Gpu, Selection};
use costate::low_level::hdf5::ResultFile;
use costate::low_level::map::pieces::Region;
use costate::low_level::map::{Adaptive, At, DeviceError, DeviceMap, Part, Unknown};
use costate::low_level::model::Precision;
use costate::low_level::result::{Axis, Stored, TrajectorySchema};
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Rounding of V: of sums of up to some hundred terms, at places in cells down to a hundredth of
/// the region.
const ROUNDINGS: f64 = 100.0;
/// Of p, in units of V's: slopes of polynomials in a cell are divided by its width.
const OF_P: f64 = 50.0;

fn folder() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| scratch("map-device"))
}

fn gpu() -> Gpu {
    Gpu::open(&Selection::Any)
        .expect("an adapter")
        .expect("an adapter")
}

/// The map of a shipped scene without the sections that are not about V, with a section [map] of
/// these lines.
fn made(name: &str, lines: &str) -> PathBuf {
    solved(&scene(folder(), name, &format!("[map]\n{lines}")))
}

/// The result file of a scene's states.
fn solved(scene: &Path) -> PathBuf {
    let out = scene.with_extension("h5");
    let arguments: [&dyn AsRef<OsStr>; 6] =
        [&"homotopy", &scene, &"--backend", &"cpu", &"--out", &out];
    done(costate(&arguments));
    out
}

/// States spread evenly over a box and a little beyond, none of them on a grid.
fn spread(lo: &[f64], hi: &[f64], count: usize) -> Vec<f64> {
    let steps = [0.754_877_666, 0.569_840_290, 0.430_159_709, 0.324_717_957];
    (1..=count)
        .flat_map(|k| {
            (0..lo.len()).map(move |i| {
                let share = 1.01 * (k as f64 * steps[i]).fract() - 0.005;
                lo[i] + (hi[i] - lo[i]) * share
            })
        })
        .collect()
}

/// What two answers differ by: V and its bound, p and the same of it, in units of rounding; states
/// known to one alone.
#[derive(Debug, Default)]
struct Difference {
    v: f64,
    p: f64,
    known: usize,
    unlike: usize,
    pieces: usize,
    several: usize,
    /// Differences of V and p in units of what the second one's bounds are larger by.
    v_lost: f64,
    p_lost: f64,
    /// What those of V are larger by, relative to V, in the middle.
    widened: f64,
}

fn difference(
    (region, widths): (&Region, &[f64]),
    x: &[f64],
    (a, b): (&[At], &[At]),
    epsilon: f64,
) -> Difference {
    let n = widths.len();
    let mut all = Difference::default();
    let mut widened = Vec::new();
    for ((a, b), x) in a.iter().zip(b).zip(x.chunks(n)) {
        let (Ok(here), Ok(there)) = (&a.lowest, &b.lowest) else {
            all.unlike += usize::from(a.lowest.is_ok() != b.lowest.is_ok());
            continue;
        };
        all.known += 1;
        all.pieces += usize::from(here.in_pieces);
        all.several += usize::from(!a.others.is_empty());
        if here.sheet != there.sheet || here.sites != there.sites {
            all.unlike += 1;
            continue;
        }
        // Places have rounding errors too, through which V changes by p.
        let reach: f64 = (here.p.iter().zip(x)).map(|(p, x)| (p * x).abs()).sum();
        let unit = epsilon * (here.v.abs() + reach + here.v_error);
        all.v = all.v.max((here.v - there.v).abs() / unit);
        if epsilon == f64::EPSILON {
            all.v = all.v.max((here.v_error - there.v_error).abs() / unit);
        }
        let wider = there.v_error - here.v_error;
        let in_widths = |p: &[f64]| {
            p.iter()
                .zip(widths)
                .fold(0.0f64, |m, (p, w)| m.max((p * w).abs()))
        };
        let off: Vec<f64> = here.p.iter().zip(&there.p).map(|(a, b)| a - b).collect();
        let wider_p = there.p_error * in_widths(&there.p) - here.p_error * in_widths(&here.p);
        // What lies outside the region the host says, as exactly.
        if region.covers(x) {
            all.v_lost = all.v_lost.max((here.v - there.v).abs() / wider);
            all.p_lost = all.p_lost.max(in_widths(&off) / wider_p);
            widened.push(wider / here.v.abs());
        }
        let size = here.p.iter().fold(0.0f64, |m, p| m.max(p.abs()));
        for i in 0..n {
            all.p = all
                .p
                .max((here.p[i] - there.p[i]).abs() / (epsilon * (size + here.v.abs())));
        }
    }
    widened.sort_by(f64::total_cmp);
    all.widened = widened[widened.len() / 2];
    all
}

/// On both precisions, `least` of the states being known; how many have several sheets.
fn compared(file: &Path, count: usize, least: f64) -> usize {
    let stored = Stored::open(file).unwrap();
    let map = stored.value_map().unwrap();
    let region = stored
        .map_pieces()
        .unwrap()
        .expect("a map in pieces")
        .region;
    let x = spread(&region.lo, &region.hi, count);
    let cpu = map.at_many(&x, false);
    let widths: Vec<f64> = stored
        .scene
        .model
        .region
        .iter()
        .map(|[lo, hi]| hi - lo)
        .collect();
    let gpu = gpu();
    assert_eq!(gpu.name(), "gpu");
    let mut several = 0;
    for precision in [Precision::F64, Precision::F32] {
        let epsilon = precision.epsilon();
        let device = DeviceMap::new(&map, &gpu, precision).unwrap();
        let said = device.at_many(&x).unwrap();
        let off = difference((&region, &widths), &x, (&cpu, &said), epsilon);
        println!(
            "{}, {}: {off:?} of {count}",
            file.display(),
            precision.name()
        );
        assert!(off.known as f64 > least * count as f64 && off.pieces * 2 > off.known);
        // At the edges of what is known a rounding decides; in f32 some states lie within one of a
        // face between cells.
        let seldom = if precision == Precision::F64 {
            0
        } else {
            count / 200
        };
        assert!(off.unlike <= seldom, "{}", off.unlike);
        assert!(off.v <= ROUNDINGS && off.p <= OF_P * ROUNDINGS);
        if precision == Precision::F32 {
            assert!(
                off.v_lost <= 1.0 && off.p_lost <= 1.0,
                "bounds hold what rounding does"
            );
            assert!(off.widened < 1e-3, "and not much more");
        }
        several = off.several;
        // The comparison sees an error of a few more roundings.
        let mut wrong = said;
        if let Some(Ok(value)) = wrong
            .iter_mut()
            .map(|at| at.lowest.as_mut())
            .find(Result::is_ok)
        {
            value.v *= 1.0 + 10.0 * ROUNDINGS * epsilon;
            value.v += 10.0 * ROUNDINGS * epsilon;
        }
        assert!(difference((&region, &widths), &x, (&cpu, &wrong), epsilon).v > ROUNDINGS);
        // A state's answer does not depend on its company.
        let n = map.states();
        let alone = device.at_many(&x[7 * n..8 * n]).unwrap();
        let together = device.at_many(&x).unwrap();
        let bits = |at: &At| {
            at.lowest
                .as_ref()
                .ok()
                .map(|v| (v.v.to_bits(), v.p[0].to_bits()))
        };
        assert_eq!(bits(&alone[0]), bits(&together[7]));
    }
    several
}

#[test]
fn a_smooth_value_on_a_gpu_is_the_exact_one() {
    let file = made("manufactured", "error = 1e-4\nfloor = 1e-3\ncheck = 1");
    compared(&file, 5000, 0.95);
    // By hand, whatever the CPU says.
    let stored = Stored::open(&file).unwrap();
    let map = stored.value_map().unwrap();
    let states = spread(&[-1.48; 2], &[1.48; 2], 1000);
    let said = DeviceMap::new(&map, &gpu(), Precision::F64)
        .unwrap()
        .at_many(&states)
        .unwrap();
    for (x, at) in states.chunks(2).zip(said) {
        let (x, y) = (x[0], x[1]);
        let Exact { v, p, .. } = manufactured::at(&[x, y]);
        let here = at.lowest.unwrap_or_else(|e| panic!("{x}, {y}: {e}"));
        assert!(
            (here.v - v).abs() <= 1e-4 * v.max(1e-3),
            "{x}, {y}: {} {v}",
            here.v
        );
        assert!((here.p[0] - p[0]).abs() <= 1e-2 * v.max(1e-3).sqrt());
    }
    the_program_says_the_same(&file);
}

/// `costate value --backend gpu` tells who was asked, and gives the CPU's table.
fn the_program_says_the_same(file: &Path) {
    let points: String = spread(&[-1.4; 2], &[1.4; 2], 50)
        .chunks(2)
        .map(|x| format!("{},{}\n", x[0], x[1]))
        .collect();
    let (list, file) = (folder().join("points.csv"), file.to_str().unwrap());
    std::fs::write(&list, format!("x,y\n{points}")).unwrap();
    let list = list.to_str().unwrap();
    let mut tables = Vec::new();
    for backend in ["cpu", "gpu"] {
        let out = folder().join(format!("{backend}.csv"));
        let output = costate(&[
            "value",
            file,
            "--points",
            list,
            "--backend",
            backend,
            "--out",
            out.to_str().unwrap(),
        ]);
        let said = done(output);
        let adapter = if backend == "gpu" {
            gpu().adapter()
        } else {
            "CPU, ".to_owned()
        };
        assert!(said.contains(&adapter) && said.contains("f64"), "{said}");
        tables.push(std::fs::read_to_string(out).unwrap());
    }
    let rows = |table: &str| -> Vec<Vec<String>> {
        let row = |line: &str| line.split(',').map(str::to_owned).collect();
        table.lines().map(row).collect()
    };
    let (cpu, gpu) = (rows(&tables[0]), rows(&tables[1]));
    assert_eq!(cpu.len(), 51);
    for (a, b) in cpu.iter().zip(&gpu) {
        assert_eq!(a.len(), b.len());
        for (a, b) in a.iter().zip(b) {
            match (a.parse::<f64>(), b.parse::<f64>()) {
                (Ok(a), Ok(b)) => assert!((a - b).abs() <= 1e-9 * a.abs().max(1e-3), "{a} {b}"),
                _ => assert_eq!(a, b),
            }
        }
    }
}

#[test]
fn two_sheets_of_the_pendulum() {
    let file = made(
        "pendulum",
        "error = 1e-3\nfloor = 1e-2\nstates = 800\ncheck = 1",
    );
    assert!(
        compared(&file, 5000, 0.8) > 0,
        "several sheets lie over some states"
    );
}

/// Three states in sheared coordinates, all functions of V, several sheets and pieces that say
/// something on one side only, about the local solution of a chain of integrators.
#[test]
fn all_that_pieces_can_be() {
    let scene = folder().join("chain.toml");
    let text = "states = { x = {}, y = {}, z = {} }\ncontrols = { u = {} }\n\
                dynamics = { x = \"y\", y = \"z\", z = \"u\" }\ncost = { running = \"0.5*(x^2 + y^2 + z^2 + u^2)\" }\n\
                equilibrium = { x = 0, y = 0, z = 0, u = 0 }\nregion = { x = [-1, 2], y = [-3, 1], z = [-0.5, 1.5] }\n\
                map = { error = 0.1, states = 20, check = 1 }\n";
    std::fs::write(&scene, text).unwrap();
    let file = solved(&scene);
    let stored = Stored::open(&file).unwrap();
    let region = stored.map_pieces().unwrap().unwrap().region;
    let pieces = made_up(Region {
        floor: 0.5,
        value_max: 2.02,
        ..region
    });
    assert!(pieces.frame.bend.is_some());
    let axes = |names: &[&str]| -> Vec<Axis> {
        let axis = |name: &&str| Axis {
            name: (*name).to_owned(),
            unit: None,
            long_name: None,
        };
        names.iter().map(axis).collect()
    };
    let schema = TrajectorySchema {
        states: axes(&["x", "y", "z"]),
        controls: axes(&["u"]),
        ..TrajectorySchema::default()
    };
    let made = Adaptive {
        pieces,
        check: Vec::new(),
        check_asked: 0,
        states: 0,
        failed: 0,
        above_max: 0,
        points: 0,
        rounds: 0,
        first: [0; 2],
        beyond: None,
        unmet: Part::default(),
        unknown: Part::default(),
        uncertain: 0.0,
        spent: false,
        error_max: f64::INFINITY,
        seconds: 0.0,
    };
    let mut writer = ResultFile::extend(&file, &["map_pieces"]).unwrap();
    writer.map_pieces(&schema, "t", &made).unwrap();
    writer.finish().unwrap();
    compared(&file, 5000, 0.3);
}

/// What the GPU does not do is said, and nothing is written.
#[test]
fn what_a_gpu_does_not_do_is_said() {
    let scattered = folder().join("scattered.h5");
    let arguments: [&dyn AsRef<OsStr>; 5] = [
        &"run",
        &scenario("linear_quadratic"),
        &"--no-report",
        &"--out",
        &scattered,
    ];
    done(costate(&arguments));
    let (file, out) = (scattered.to_str().unwrap(), folder().join("none.csv"));
    let at = Stored::open(&scattered).unwrap().scene.model.states[0]
        .variable
        .name
        .clone()
        + "=0.1";
    let to = out.to_str().unwrap();
    for (args, wanted, status) in [
        (vec!["--backend", "gpu"], "holds no map in pieces", 2),
        (vec!["--precision", "f32"], "--backend gpu has both", 2),
        (
            vec!["--backend", "gpu", "--adapter", "no such thing"],
            "no adapter",
            2,
        ),
    ] {
        let output = costate(&[&["value", file, "--at", &at, "--out", to][..], &args].concat());
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(status), "{said}");
        assert!(said.contains(wanted), "{said}");
        assert!(!out.exists());
    }
    let map_of_scattered = Stored::open(&scattered).unwrap();
    let map = map_of_scattered.value_map().unwrap();
    let refused = DeviceMap::new(&map, &gpu(), Precision::F64).err();
    assert!(matches!(refused, Some(DeviceError::NoPieces)));
}

/// Many turns away f32 has no digits left of an angle: whole periods are taken off before.
#[test]
fn whole_periods_are_taken_off_in_f64() {
    let directory = folder().join("far");
    std::fs::create_dir_all(&directory).unwrap();
    let lines = "[map]\nerror = 1e-2\nfloor = 1e-1\nstates = 200\ncheck = 1";
    let file = solved(&scene(&directory, "pendulum", lines));
    let stored = Stored::open(&file).unwrap();
    let map = stored.value_map().unwrap();
    let gpu = gpu();
    let device = DeviceMap::new(&map, &gpu, Precision::F32).unwrap();
    let turn = 2.0 * std::f64::consts::PI;
    let near = spread(&[-3.0, -4.0], &[1.5, 4.0], 200);
    let far: Vec<f64> = (near.chunks(2))
        .flat_map(|x| [x[0] + 10_000.0 * turn, x[1]])
        .collect();
    let (cpu, said) = (map.at_many(&far, false), device.at_many(&far).unwrap());
    let mut known = 0;
    for (a, b) in cpu.iter().zip(&said) {
        let (Ok(a), Ok(b)) = (&a.lowest, &b.lowest) else {
            continue;
        };
        known += usize::from(a.in_pieces);
        assert!(
            a.sheet != b.sheet || (a.v - b.v).abs() <= b.v_error - a.v_error,
            "{} {}",
            a.v,
            b.v
        );
        assert_eq!(a.winding, b.winding);
    }
    assert!(known > 100);
    let at = format!("theta={},omega=0.5", -1.0 + 10_000.0 * turn);
    let file = file.to_str().unwrap();
    let said = done(costate(&[
        "value",
        file,
        "--at",
        &at,
        "--backend",
        "gpu",
        "--precision",
        "f32",
    ]));
    assert!(
        said.contains(&gpu.adapter()) && said.contains("f32"),
        "{said}"
    );
}

/// Pieces are smooth and say something of states that a guard excludes, too: the GPU does not tell
/// it either.
#[test]
fn nothing_is_said_of_states_that_a_guard_excludes() {
    let path = folder().join("excluded.toml");
    let text = "states = { x = {}, y = {} }\ncontrols = { u = {}, w = {} }\ndynamics = { x = \"u\", y = \"w\" }\n\
                cost = { running = \"0.5*(u^2 + w^2 + x^2 + y^2)\" }\nequilibrium = { x = 0, y = 0, u = 0, w = 0 }\n\
                region = { x = [-1, 1], y = [-1, 1] }\nguards = { slanted = \"y > -0.6 + 0.3*x\" }\n\
                map = { error = 1e-3, states = 500, check = 10 }\n";
    std::fs::write(&path, text).unwrap();
    let map = Stored::open(solved(&path)).unwrap().value_map().unwrap();
    let x = spread(&[-1.0, -1.0], &[1.0, 1.0], 2000);
    for precision in [Precision::F32, Precision::F64] {
        let device = DeviceMap::new(&map, &gpu(), precision).unwrap();
        let (mut excluded, mut known) = (0, 0);
        for (x, at) in x.chunks(2).zip(device.at_many(&x).unwrap()) {
            if x[1] < -0.6 + 0.3 * x[0] {
                assert_eq!(at.lowest.err(), Some(Unknown::Guard), "{x:?}");
                excluded += 1;
            } else {
                known += usize::from(at.lowest.is_ok());
            }
        }
        assert!(
            excluded > 300 && known > 1500,
            "{excluded} excluded, {known} known"
        );
    }
}
