//! `costate export`: compiled headers against the value map, the local series and exact value
//! functions.

use crate::common_commands;
use crate::common_problems::{Exact, manufactured};

use common_commands::header::{Said, ask};
use common_commands::made_up::made_up;
use common_commands::{costate, done, scene};
use costate::low_level::feedback::{Known, value_header};
use costate::low_level::hamiltonian::{Hamiltonian, System};
use costate::low_level::local::{LocalPolynomial, LocalSolution, Riccati, SeedChoice};
use costate::low_level::map::Coverage;
use costate::low_level::map::pieces::Region;
use costate::low_level::model::{Model, SeedValue};
use costate::low_level::numeric::random::random;
use costate::low_level::result::Stored;
use std::path::{Path, PathBuf};

fn scratch(name: &str) -> PathBuf {
    common_commands::scratch(&format!("export-{name}"))
}

/// A result file with a map, and its header.
fn exported(directory: &Path, name: &str, map: &str) -> Stored {
    let scene = scene(directory, name, map);
    let file = directory.join(format!("{name}.h5"));
    let (scene, file) = (scene.to_str().unwrap(), file.to_str().unwrap());
    done(costate(&[
        "homotopy",
        "--backend",
        "cpu",
        scene,
        "--out",
        file,
    ]));
    let said = done(costate(&[
        "export",
        file,
        "--json",
        "--out",
        directory.join("map.h").to_str().unwrap(),
    ]));
    let said: serde_json::Value = serde_json::from_str(&said).unwrap();
    let length = std::fs::metadata(directory.join("map.h")).unwrap().len();
    assert_eq!(
        (said["kind"].as_str(), said["bytes"].as_u64()),
        (Some("map"), Some(length))
    );
    Stored::open(Path::new(file)).unwrap()
}

/// States at random in the region made wider by `more` of its widths on each side.
fn places(model: &Model, more: f64, count: u64) -> Vec<Vec<f64>> {
    let n = model.states.len() as u64;
    let unit = |k: u64| random(11, k) as f64 / 2f64.powi(64);
    let place = |k: u64| {
        let at = |(i, [lo, hi]): (usize, &[f64; 2])| {
            lo + (hi - lo) * ((1.0 + 2.0 * more) * unit(k * n + i as u64) - more)
        };
        model.region.iter().enumerate().map(at).collect()
    };
    (0..count).map(place).collect()
}

fn size(p: &[f64]) -> f64 {
    p.iter().fold(0.0, |a, x| a.max(x.abs()))
}

/// A header against what `costate value` says: numbers of states that both know, that neither does,
/// and of those that only one knows; and the largest differences of V (relative to V and the
/// floor), p and u (to their sizes).
fn compare(stored: &Stored, states: &[Vec<f64>], said: &[Said]) -> ([usize; 3], [f64; 3]) {
    let map = stored.value_map().unwrap();
    let floor = stored.map_pieces().unwrap().unwrap().region.floor;
    let (mut counts, mut off) = ([0; 3], [0.0f64; 3]);
    // Where p or u passes 0, its size elsewhere counts.
    let known: Vec<&Said> = said.iter().filter(|said| said.known).collect();
    let mean =
        |of: &dyn Fn(&Said) -> f64| known.iter().map(|s| of(s)).sum::<f64>() / known.len() as f64;
    let usual = [mean(&|s| size(&s.p)), mean(&|s| size(&s.u))];
    for (x, said) in states.iter().zip(said) {
        // The header keeps to the region.
        let here = map.without_errors(x).lowest.ok();
        match (
            here.filter(|here| here.coverage != Coverage::Searched),
            said.known,
        ) {
            (Some(here), true) => {
                counts[0] += 1;
                let differences = |a: &[f64], b: &[f64]| {
                    a.iter()
                        .zip(b)
                        .fold(0.0f64, |m, (a, b)| m.max((a - b).abs()))
                };
                let now = [
                    (here.v - said.v).abs() / here.v.abs().max(floor),
                    differences(&here.p, &said.p) / size(&here.p).max(usual[0]),
                    differences(&here.u, &said.u) / size(&here.u).max(usual[1]),
                ];
                (0..3).for_each(|i| off[i] = off[i].max(now[i]));
            }
            (None, false) => counts[1] += 1,
            _ => counts[2] += 1,
        }
    }
    (counts, off)
}

/// Of V, p and u. Double: the same to the rounding of sums of some 50 terms and of another libm.
/// Single: rounding of 6e-8 through the same sums; slopes also divide differences of V by the width
/// of the strip over which cells are blended.
const DOUBLE: [f64; 3] = [1e-12; 3];
const SINGLE: [f64; 3] = [1e-5, 1e-4, 1e-4];

/// In both precisions, optimized and not, at states in and around the region.
fn headers_agree(name: &str, map: &str, more: f64) -> [usize; 3] {
    headers_agree_in(&scratch(name), name, map, more)
}

fn headers_agree_in(directory: &Path, name: &str, map: &str, more: f64) -> [usize; 3] {
    let stored = exported(directory, name, map);
    let sizes = [
        stored.scene.model.states.len(),
        stored.scene.model.controls.len(),
    ];
    let states = places(&stored.scene.model, more, 1500);
    let (double, off) = compare(
        &stored,
        &states,
        &ask(directory, "map", sizes, &["-O2"], &states),
    );
    println!("{name}: known, unknown, differing {double:?}; off {off:?}");
    assert_eq!(double[2], 0);
    assert!((0..3).all(|i| off[i] <= DOUBLE[i]), "{off:?}");
    let single = ask(directory, "map", sizes, &["-DCOSTATE_FLOAT"], &states);
    let (counts, off) = compare(&stored, &states, &single);
    println!("{name} in single precision: {counts:?}; off {off:?}");
    // Rounded states may lie on the other side of a boundary.
    assert!(counts[2] <= 3, "{counts:?}");
    assert!((0..3).all(|i| off[i] <= SINGLE[i]), "{off:?}");
    double
}

/// The header itself against V in closed form.
#[test]
fn a_smooth_map_is_its_header() {
    let [known, unknown, _] = headers_agree(
        "manufactured",
        "[map]\nerror = 1e-4\nfloor = 1e-3\ncheck = 1",
        0.1,
    );
    assert!(known > 800 && unknown > 300, "{known} {unknown}");
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join("export-manufactured");
    let states: Vec<Vec<f64>> = (0..500)
        .map(|k| {
            let unit = |k| 3.0 * random(5, k) as f64 / 2f64.powi(64) - 1.5;
            vec![unit(2 * k), unit(2 * k + 1)]
        })
        .collect();
    for (x, said) in states
        .iter()
        .zip(ask(&directory, "map", [2, 1], &[], &states))
    {
        let Exact { v, p, .. } = manufactured::at(x);
        assert!(
            said.known && (said.v - v).abs() < 1e-4 * v.max(1e-3),
            "{x:?}: {said:?}"
        );
        // u* = -p_y / r with r = 1/2, where the map's p is right.
        assert!(
            (said.u[0] + 2.0 * said.p[1]).abs() < 1e-12 * (1.0 + size(&p)),
            "{x:?}: {said:?}"
        );
    }
}

/// An angle, moved by whole periods; a highest V, above which nothing is said; sheets that cost the
/// same.
#[test]
fn a_periodic_map_is_its_header() {
    let map = "[shoot_out]\nvalue_max = 185.0\n[map]\nerror = 1e-2\nvalue_max = 150.0\ncheck = 1\nstates = 600";
    let [known, unknown, _] = headers_agree("pendulum", map, 0.5);
    assert!(known > 200 && unknown > 200, "{known} {unknown}");
}

/// Behind the fold of a game nothing is known, which H(x, p) tells.
#[test]
fn a_game_s_map_is_its_header() {
    let [known, unknown, _] = headers_agree("folding_game", "[map]\nerror = 1e-3\ncheck = 1", 0.0);
    assert!(known > 800 && unknown > 100, "{known} {unknown}");
}

/// A guard excludes states of the region, by more than rounding.
#[test]
fn a_guarded_map_is_its_header() {
    let map = "[guards]\nwall = \"x + y < 1.2\"\n[map]\nerror = 1e-4\nfloor = 1e-3\ncheck = 1";
    let [known, unknown, _] = headers_agree_in(&scratch("guarded"), "manufactured", map, 0.0);
    assert!(known > 800 && unknown > 100, "{known} {unknown}");
}

/// A finite horizon, on which two sheets lie over each other: the lower one counts.
#[test]
fn the_lowest_of_two_sheets_is_told() {
    let map = "[map]\nerror = 1e-2\nfloor = 1e-2\ncheck = 1\ntime = false\nregion = { x = [-0.6, 0.6], y = [-0.3, 0.3] }";
    let [known, ..] = headers_agree("hopf_lax", map, 0.0);
    assert!(known > 20, "{known}");
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join("export-hopf_lax");
    let pieces = Stored::open(directory.join("hopf_lax.h5"))
        .unwrap()
        .map_pieces()
        .unwrap()
        .unwrap();
    assert!(
        pieces.cells.iter().any(|cell| cell.pieces.len() > 1),
        "there is a second sheet"
    );
    // p_x jumps where the wells cost the same, near x = 0.
    let states: Vec<Vec<f64>> = [-0.5, 0.5].map(|x| vec![x, 0.1]).to_vec();
    let said = ask(&directory, "map", [2, 2], &[], &states);
    assert!(said[0].p[0] * said[1].p[0] < 0.0, "{said:?}");
}

#[test]
fn all_that_pieces_can_be_is_in_their_header() {
    let directory = scratch("made-up");
    let path = directory.join("chain.toml");
    let text = "states = { x = {}, y = {}, z = {} }\ncontrols = { u = { max = 0.05 } }\n\
                dynamics = { x = \"y\", y = \"z\", z = \"u\" }\ncost = { running = \"0.5*(x^2 + y^2 + z^2 + u^2)\" }\n\
                equilibrium = { x = 0, y = 0, z = 0, u = 0 }\nregion = { x = [-1, 2], y = [-3, 1], z = [-0.5, 1.5] }\n";
    std::fs::write(&path, text).unwrap();
    let (model, hamiltonian) = loaded(&path);
    let system = System::new(&hamiltonian, &model);
    let pieces = made_up(Region {
        lo: model.region.iter().map(|r| r[0]).collect(),
        hi: model.region.iter().map(|r| r[1]).collect(),
        error: 1e-3,
        equal_cost: f64::INFINITY,
        floor: 0.5,
        value_max: 2.02,
        beyond: 0.0,
        game: false,
    });
    let header = value_header("made", Known::Map(&pieces, None), &system, &model);
    std::fs::write(directory.join("made.h"), &header).unwrap();
    let states = places(&model, 0.05, 3000);
    let (mut alone, mut blended, mut unknown, mut sheets) =
        (0, 0, 0, std::collections::BTreeSet::new());
    for (x, said) in states
        .iter()
        .zip(ask(&directory, "made", [3, 1], &["-O2"], &states))
    {
        let here = pieces.at(x);
        assert_eq!(here.is_some(), said.known, "{x:?}");
        let Some(here) = here else {
            unknown += 1;
            continue;
        };
        sheets.insert(here.sheet);
        if here.pieces == 1 {
            alone += 1
        } else {
            blended += 1
        }
        // Sums of at most 84 terms of about 1.
        assert!((here.v - said.v).abs() < 1e-13, "{x:?}: {said:?} {here:?}");
        for (p, said) in here.p.iter().zip(&said.p) {
            assert!((p - said).abs() < 1e-13, "{x:?}: {said} {here:?}");
        }
        assert!(
            (said.u[0] - (-said.p[2]).min(0.05)).abs() < 1e-15,
            "{x:?}: {said:?}"
        );
    }
    println!("{alone} from one piece, {blended} blended, {unknown} unknown; sheets {sheets:?}");
    assert!(alone > 300 && blended > 100 && unknown > 300 && sheets.len() > 3);
    // Another strip of blending, other bounds that tell sheets apart, another limit of V: each
    // would have been seen.
    for (right, wrong) in [
        ("made_overlap = 0.1;", "made_overlap = 0.12;"),
        ("made_same = 3.0;", "made_same = 0.0;"),
        ("made_value_max = 2.02;", "made_value_max = 2.0;"),
    ] {
        assert!(header.contains(right), "{right}");
        std::fs::write(directory.join("made.h"), header.replace(right, wrong)).unwrap();
        let off = |(x, said): (&Vec<f64>, Said)| match pieces.at(x) {
            Some(here) => !said.known || (here.v - said.v).abs() > 1e-6,
            None => said.known,
        };
        let all = states
            .iter()
            .zip(ask(&directory, "made", [3, 1], &["-O2"], &states));
        assert!(all.map(off).filter(|off| *off).count() > 10, "{wrong}");
    }
}

fn loaded(path: &Path) -> (Model, Hamiltonian) {
    let model = costate::low_level::scenario::load(path, &[]).unwrap();
    let hamiltonian = Hamiltonian::derive(&model).unwrap();
    (model, hamiltonian)
}

/// The series in C, of every degree, is that of [`LocalPolynomial`], which is that of the sweep's
/// local solution, and errs by the next term.
#[test]
fn the_series_is_its_header() {
    let directory = scratch("series");
    let path = scene(&directory, "manufactured", "");
    let (model, hamiltonian) = loaded(&path);
    let system = System::new(&hamiltonian, &model);
    let riccati = Riccati::solve(&hamiltonian, &model).unwrap();
    let states = places(&model, 0.0, 100);
    let near: Vec<Vec<f64>> = states
        .iter()
        .map(|x| x.iter().map(|x| 0.1 * x).collect())
        .collect();
    for degree in 1..=6 {
        let local = LocalPolynomial::new(&system, &model, &riccati, degree + 1).unwrap();
        let header = directory.join("local.h");
        let arguments = [
            "export",
            path.to_str().unwrap(),
            "--local",
            "--quiet",
            "--out",
            header.to_str().unwrap(),
        ];
        done(costate(
            &[&arguments[..], &["--degree", &degree.to_string()]].concat(),
        ));
        for (flags, tolerance) in [(["-O2"], 1e-13), (["-DCOSTATE_FLOAT"], 1e-5)] {
            for (x, said) in states
                .iter()
                .zip(ask(&directory, "local", [2, 1], &flags, &states))
            {
                let (v, p) = local.at(x);
                assert!(
                    (said.v - v).abs() <= tolerance * (1.0 + v.abs()),
                    "{degree}: {said:?} {v}"
                );
                for (said, p) in said.p.iter().zip(&p) {
                    assert!(
                        (said - p).abs() <= tolerance * (1.0 + size(&[*p])),
                        "{degree}: {said} {p}"
                    );
                }
                assert_eq!(said.known, local.knows(x), "{x:?}");
            }
        }
        // Of terms through degree d + 1; this V has even ones alone, whose coefficients are below
        // 1.
        let missing = if degree % 2 == 1 {
            degree + 3
        } else {
            degree + 2
        };
        for (x, said) in near
            .iter()
            .zip(ask(&directory, "local", [2, 1], &[], &near))
        {
            let (v, radius) = (manufactured::value(x), size(x));
            assert!(
                (said.v - v).abs() <= radius.powi(missing as i32) + 1e-16,
                "{degree} {x:?}: {said:?} {v}"
            );
        }
    }
    let choice = SeedChoice {
        asked: SeedValue::Auto,
        tolerance: 1e-12,
        ceiling: 1.0,
        outer: 1.0,
    };
    let swept = LocalSolution::new(&system, &model, riccati.clone(), choice).unwrap();
    let local = LocalPolynomial::new(&system, &model, &riccati, swept.degree).unwrap();
    for x in &states {
        let (at, (v, p)) = (swept.at_state(x), local.at(x));
        assert!((at[4] - v).abs() < 1e-13 * (1.0 + v));
        assert!((at[2] - p[0]).abs() + (at[3] - p[1]).abs() < 1e-13 * (1.0 + size(&p)));
    }
}

/// The double integrator with unit weights: K = (1, sqrt 3), P = ((sqrt 3, 1), (1, sqrt 3)), at
/// every degree; u is bounded.
#[test]
fn the_series_of_a_linear_quadratic_scene_is_riccati_s() {
    let directory = scratch("linear");
    let path = directory.join("linear.toml");
    let text = "states = { x = {}, v = {} }\ncontrols = { u = { min = -1.5 } }\ndynamics = { x = \"v\", v = \"u\" }\n\
                cost = { running = \"0.5*(x^2 + v^2 + u^2)\" }\nequilibrium = { x = 0, v = 0, u = 0 }\n\
                region = { x = [-1, 1], v = [-1, 1] }\n";
    std::fs::write(&path, text).unwrap();
    let (model, _) = loaded(&path);
    let states = places(&model, 0.0, 50);
    for degree in ["1", "3", "6"] {
        let out = directory.join("gain.h");
        let arguments = [
            "export",
            path.to_str().unwrap(),
            "--local",
            "--degree",
            degree,
            "--name",
            "gain",
        ];
        done(costate(
            &[&arguments[..], &["--out", out.to_str().unwrap()]].concat(),
        ));
        for (x, said) in states
            .iter()
            .zip(ask(&directory, "gain", [2, 1], &[], &states))
        {
            let root = 3f64.sqrt();
            let gain = (-x[0] - root * x[1]).max(-1.5);
            let v = 0.5 * root * (x[0] * x[0] + x[1] * x[1]) + x[0] * x[1];
            // The Riccati equation is solved to about 1e-14.
            assert!((said.u[0] - gain).abs() < 1e-12, "{x:?}: {said:?} {gain}");
            assert!((said.v - v).abs() < 1e-12, "{x:?}: {said:?} {v}");
        }
    }
}

/// How many there are in a directory.
fn headers(directory: &Path) -> usize {
    let files = std::fs::read_dir(directory)
        .unwrap()
        .map(|f| f.unwrap().path());
    files
        .filter(|f| f.extension().is_some_and(|e| e == "h"))
        .count()
}

/// The header of a law in a result file is the one that the fit wrote.
#[test]
fn a_fitted_law_is_exported_again() {
    let directory = scratch("law");
    let law = |name: &str, fit: &str| {
        format!("[feedback.{name}]\nfit = \"{fit}\"\nhidden = [2]\nstarts = 1\niterations = 20\n")
    };
    let states = "[homotopy]\nx = [-1, 1, 7]\ny = [-1, 1, 7]\n";
    let path = scene(
        &directory,
        "manufactured",
        &(states.to_owned() + &law("push", "u") + &law("cost", "V")),
    );
    let file = directory.join("points.h5");
    let (path, file) = (path.to_str().unwrap(), file.to_str().unwrap());
    done(costate(&[
        "homotopy",
        "--backend",
        "cpu",
        path,
        "--out",
        file,
    ]));
    done(costate(&["fit", file]));
    let written = |name: &str| std::fs::read(directory.join(name)).unwrap();
    for name in ["push", "cost"] {
        let out = directory.join("again.h");
        let wanted = format!("--law={name}");
        let said = done(costate(&[
            "export",
            file,
            &wanted,
            "--json",
            "--out",
            out.to_str().unwrap(),
        ]));
        let said: serde_json::Value = serde_json::from_str(&said).unwrap();
        assert_eq!(
            (said["kind"].as_str(), said["name"].as_str()),
            (Some("law"), Some(name))
        );
        let text = written("again.h");
        assert!(String::from_utf8_lossy(&text).contains(&format!("{name}_u(")));
        assert!(text == written(&format!("points_{name}.h")), "{name}");
        std::fs::remove_file(out).unwrap();
    }
    let before = headers(&directory);
    for (wanted, reason) in [("--law", "push, cost"), ("--law=map", "no law `map`")] {
        let output = costate(&["export", file, wanted]);
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{wanted}: {errors}");
        assert!(errors.contains(reason), "{wanted}: {errors}");
        assert_eq!(headers(&directory), before);
    }
    // Of a single law the name is known, and so is where it goes.
    let alone = directory.join("alone");
    std::fs::create_dir(&alone).unwrap();
    let other = scene(&alone, "manufactured", &law("pull", "u"));
    done(costate(&["fit", file, "--scene", other.to_str().unwrap()]));
    let fitted = written("points_pull.h");
    std::fs::remove_file(directory.join("points_pull.h")).unwrap();
    done(costate(&["export", file, "--law"]));
    assert!(fitted == written("points_pull.h"));
}

#[test]
fn what_cannot_be_exported_is_refused() {
    let directory = scratch("refused");
    let path = scene(
        &directory,
        "manufactured",
        "[homotopy]\nx = [0.1, 0.2, 2]\ny = 0.1\n",
    );
    let file = directory.join("points.h5");
    let (path, file) = (path.to_str().unwrap(), file.to_str().unwrap());
    done(costate(&[
        "homotopy",
        "--backend",
        "cpu",
        path,
        "--out",
        file,
    ]));
    let finite = scene(&directory, "hopf_lax", "");
    let finite = finite.to_str().unwrap();
    let cases: [(&[&str], &str); 12] = [
        (&["export", file], "has no map in pieces"),
        (&["export", path], "is a scene"),
        (&["export", finite, "--local"], "finite horizon"),
        (&["export", path, "--local", "--degree", "7"], "from 1 to 6"),
        (
            &["export", path, "--local", "--name", "a-b"],
            "letters, digits",
        ),
        (
            &["export", path, "--local", "--out", "law.toml"],
            "name it .h",
        ),
        (
            &["export", file, "--local", "--set", "r=2"],
            "--local SCENE.toml --set",
        ),
        (
            &["export", file, "--law", "--degree", "2"],
            "cannot be used with",
        ),
        (&["export", file, "--degree", "2"], "--local"),
        (&["export", file, "--law"], "holds no fitted law"),
        (&["export", path, "--law"], "is a scene"),
        (&["export", file, "--law", "--local"], "cannot be used with"),
    ];
    for (arguments, reason) in cases {
        let output = costate(arguments);
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {errors}");
        assert!(errors.contains(reason), "{arguments:?}: {errors}");
    }
    assert_eq!(headers(&directory), 0);
    // The series of a result file's own scene; beside the file where nothing else is asked for.
    done(costate(&["export", file, "--local", "--degree", "2"]));
    let text = std::fs::read_to_string(directory.join("points_local.h")).unwrap();
    assert!(text.contains("Taylor series of degree 3"));
}
