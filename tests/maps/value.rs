//! The value map and `costate value` against exact value functions and independently solved states;
//! `[study]` against published figures and its own equations.

use crate::common_commands;
use crate::common_problems::{Exact, TwoWells, manufactured};

use common_commands::{costate, done, scenario, scratch};
use costate::low_level::map::Unknown;
use costate::low_level::result::Stored;
use costate::low_level::trajectories::SolvedStates;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

fn folder() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| scratch("value"))
}

/// The result file of a shipped scene's sweep or run.
fn result(name: &str, command: &str) -> PathBuf {
    made(name, command, &scenario(name))
}

/// The result file of a command on a scene.
fn made(name: &str, command: &str, scene: &Path) -> PathBuf {
    let path = folder().join(format!("{name}-{command}.h5"));
    let arguments: [&dyn AsRef<OsStr>; 7] = [
        &command,
        &scene,
        &"--backend",
        &"cpu",
        &"--quiet",
        &"--out",
        &path,
    ];
    done(costate(&arguments));
    path
}

/// Two-dimensional states as `costate solve` solves them.
fn solved(name: &str, scene: &Path, header: &str, states: &[[f64; 2]]) -> SolvedStates {
    let (points, path) = (
        folder().join(format!("{name}.csv")),
        folder().join(format!("{name}-solved.h5")),
    );
    let rows: Vec<String> = states.iter().map(|[a, b]| format!("{a},{b}\n")).collect();
    std::fs::write(&points, format!("{header}\n{}", rows.concat())).unwrap();
    done(costate::<&dyn AsRef<OsStr>>(&[
        &"solve",
        &scene,
        &"--backend",
        &"cpu",
        &"--quiet",
        &"--points",
        &points,
        &"--out",
        &path,
    ]));
    Stored::open(&path).unwrap().points().unwrap().unwrap()
}

fn pendulum() -> &'static Path {
    static FILE: OnceLock<PathBuf> = OnceLock::new();
    FILE.get_or_init(|| result("pendulum", "run"))
}

/// Points of the unit square that lie evenly and at no simple fraction.
fn spread(count: usize) -> impl Iterator<Item = [f64; 2]> {
    (1..=count).map(|k| {
        [
            (k as f64 * 0.754877666).fract(),
            (k as f64 * 0.569840291).fract(),
        ]
    })
}

fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[((sorted.len() - 1) as f64 * share).round() as usize]
}

#[test]
fn values_are_those_of_an_exact_solution() {
    let map = Stored::open(result("manufactured", "shoot-out"))
        .unwrap()
        .value_map()
        .unwrap();
    let (mut errors, mut slopes, mut controls, mut over) = (vec![], vec![], vec![], vec![]);
    let mut quick = 0.0f64;
    for [a, b] in spread(400) {
        let (x, y) = (3.0 * a - 1.5, 3.0 * b - 1.5);
        let Exact { v, p, u } = manufactured::at(&[x, y]);
        // The sweep goes to V = 3.
        if v > 2.7 {
            continue;
        }
        let at = map.at(&[x, y]);
        assert!(at.others.is_empty(), "one sheet at {x}, {y}");
        let here = at
            .lowest
            .unwrap_or_else(|e| panic!("{x}, {y} (V = {v}): {e}"));
        let scale = v.max(0.01);
        errors.push((here.v - v).abs() / scale);
        slopes.push((0..2).map(|i| (here.p[i] - p[i]).abs()).fold(0.0, f64::max) / scale.sqrt());
        controls.push((here.u[0] - u[0]).abs() / scale.sqrt());
        if here.v_error > 0.0 {
            over.push((here.v - v).abs() / here.v_error);
        }
        let local = map.local(&[x, y]).expect("known at as without haste");
        quick = quick.max((local.v - v).abs() / scale);
    }
    assert!(errors.len() > 200);
    // Neighbours are 0.025 of the region apart, a cubic's error is of the fourth order: 1e-6 of the
    // fourth derivatives.
    println!(
        "V {:.1e} {:.1e}, p {:.1e}, u {:.1e}",
        quantile(&errors, 0.5),
        quantile(&errors, 1.0),
        quantile(&slopes, 1.0),
        quantile(&controls, 1.0)
    );
    assert!(
        quantile(&errors, 0.5) < 3e-6 && quantile(&errors, 1.0) < 1e-3,
        "V"
    );
    assert!(
        quantile(&slopes, 0.5) < 1e-4 && quantile(&slopes, 1.0) < 1e-2,
        "p"
    );
    assert!(
        quantile(&controls, 0.5) < 2e-4 && quantile(&controls, 1.0) < 2e-2,
        "u"
    );
    // Haste costs the blending, an order of magnitude.
    assert!(quick < 5e-3, "{quick}");
    // The estimate is of the right size: rarely below the error (by more than half of it), seldom
    // far above.
    assert!(
        quantile(&over, 0.95) < 1.5,
        "error above its estimate: {}",
        quantile(&over, 0.95)
    );
    assert!(
        quantile(&over, 0.5) > 1e-3,
        "the estimate says nothing: {}",
        quantile(&over, 0.5)
    );
}

#[test]
fn sheets_are_not_mixed_where_the_answer_is_known() {
    let map = Stored::open(result("hopf_lax", "run"))
        .unwrap()
        .value_map()
        .unwrap();
    let wells = TwoWells::with(2.0);
    let mut known = 0;
    for [a, b] in spread(300) {
        let (x, y) = (4.0 * a - 2.0, 1.6 * b - 0.8);
        let Ok(here) = map.at(&[x, y]).lowest else {
            continue;
        };
        known += 1;
        let v = wells.at(&[x, y]).v;
        // At the line of equal cost V has a kink, not a gap: an answer from the wrong sheet is too
        // large by no more than the sheets part, which a hundredth of the region away is 0.04.
        assert!((here.v - v).abs() < 2e-3, "{x}, {y}: {} for {v}", here.v);
    }
    // What the file holds lies a quarter of the region apart in y: a third of the states has
    // nothing on all sides.
    assert!(known > 180, "{known} of 300");
}

#[test]
fn the_pendulum_is_as_solved() {
    let states: Vec<[f64; 2]> = spread(120)
        .map(|[a, b]| [-3.8 + 6.1 * a, -6.0 + 14.0 * b])
        .collect();
    let solved = solved("pendulum", &scenario("pendulum"), "theta,omega", &states);
    let map = Stored::open(pendulum()).unwrap().value_map().unwrap();
    let (mut errors, mut controls) = (Vec::new(), Vec::new());
    for k in 0..solved.count {
        let x = &solved.x[2 * k..2 * k + 2];
        // The scene's sweep and map go to V = 185.
        if solved.v[k].is_nan() || solved.v[k] > 180.0 {
            continue;
        }
        let here = map.at(x).lowest.unwrap_or_else(|e| panic!("{x:?}: {e}"));
        errors.push((here.v - solved.v[k]).abs() / solved.v[k].max(1.0));
        controls.push((here.u[0] - solved.u[k]).abs());
    }
    assert!(errors.len() > 80, "{}", errors.len());
    println!(
        "V {:.1e} {:.1e}, u {:.1e} {:.1e}",
        quantile(&errors, 0.5),
        quantile(&errors, 1.0),
        quantile(&controls, 0.5),
        quantile(&controls, 0.98)
    );
    // u ranges over 60; on the wrong sheet it would be off by 20 or more.
    assert!(quantile(&errors, 0.5) < 2e-6 && quantile(&errors, 1.0) < 2e-3);
    assert!(quantile(&controls, 0.5) < 1e-3 && quantile(&controls, 0.98) < 0.5);
}

#[test]
fn both_sides_of_the_equal_cost_state_are_told() {
    // theta = 2.40894 on omega = 0 (tests/sheets.rs): before it u = -11, behind it 23.
    let map = Stored::open(pendulum()).unwrap().value_map().unwrap();
    for (theta, least, most) in [
        (2.40, -12.0, -10.0),
        (2.4085, -12.0, -10.0),
        (2.4095, 22.0, 25.0),
        (2.42, 22.0, 25.0),
    ] {
        let at = map.at(&[theta, 0.0]);
        let here = at.lowest.unwrap();
        assert!(
            (least..most).contains(&here.u[0]),
            "theta = {theta}: u = {}",
            here.u[0]
        );
        let other = at.others.first().expect("the other sheet is near");
        assert!(!(least..most).contains(&other.u[0]) && other.v > here.v);
        assert!(
            other.v - here.v < 5.0,
            "they cost nearly the same: {} {}",
            here.v,
            other.v
        );
    }
}

#[test]
fn what_is_not_known_is_said() {
    let map = Stored::open(pendulum()).unwrap().value_map().unwrap();
    assert_eq!(map.at(&[0.0, 60.0]).lowest.unwrap_err(), Unknown::Far);
    // V there is 414 (solved), the file goes to 185, its slice to 370.
    assert!(map.at(&[-3.3087, -10.2913]).lowest.is_err());
    let at = map.at(&[-1.5, 0.0]).lowest.unwrap();
    assert_eq!((at.v, at.sites), (0.0, 0));
    // g sin(-1.5)
    assert!((at.u[0] + 9.81 * 1.5f64.sin()).abs() < 1e-12);
}

/// A file of interpolated values says these again with the errors that they were told with, and
/// nothing between them: no error that they show would include their own.
#[test]
fn values_of_values_are_those_alone() {
    let text = std::fs::read_to_string(scenario("manufactured")).unwrap();
    let scene = folder().join("manufactured-coarse.toml");
    let end = ["[shoot_out]", "[homotopy]", "[map]"];
    let cut = end
        .iter()
        .filter_map(|section| text.find(section))
        .min()
        .unwrap();
    std::fs::write(
        &scene,
        format!("{}\n[map]\nerror = 2e-2\ncheck = 5\n", &text[..cut]),
    )
    .unwrap();
    let map = made("coarse", "homotopy", &scene);
    let exact = Stored::open(&map).unwrap().value_map().unwrap();
    let grid = folder().join("coarse-grid.h5");
    done(costate::<&dyn AsRef<OsStr>>(&[
        &"value",
        &map,
        &"--grid",
        &"x=-1:1:41,y=-1:1:41",
        &"--out",
        &grid,
    ]));
    let stored = Stored::open(&grid).unwrap();
    let told = stored.map().unwrap().unwrap();
    assert_eq!(told.errors.len(), 41 * 41);
    let again = stored.value_map().unwrap();
    for k in [0, 10 * 41 + 30, 40 * 41 + 3] {
        let x = [told.axes[0][k / 41], told.axes[1][k % 41]];
        let (here, there) = (again.at(&x).lowest.unwrap(), exact.at(&x).lowest.unwrap());
        let own = told.errors[k];
        assert_eq!(
            (here.v, here.v_error, here.p_error),
            (told.v[k], own.v, own.p)
        );
        assert_eq!((here.solved, here.p.as_slice()), (0, &told.p[2 * k..][..2]));
        // Many at once are rounded otherwise.
        let alike = |a: f64, b: f64| (a - b).abs() <= 1e-9 * b.abs();
        assert!(
            alike(here.v, there.v)
                && alike(here.v_error, there.v_error)
                && alike(here.u[0], there.u[0])
        );
        assert!(here.u_error >= there.u_error * (1.0 - 1e-9) && here.u_error.is_finite());
    }
    for [a, b] in spread(200) {
        let x = [2.0 * a - 1.0, 2.0 * b - 1.0];
        match again.at(&x).lowest {
            // Next to the equilibrium the series says V.
            Ok(here) => assert!(here.sites == 0 && x[0].hypot(x[1]) < 0.5, "{x:?}"),
            Err(why) => assert_eq!(why, Unknown::Between),
        }
    }
}

#[test]
fn tables_grids_and_json_agree() {
    let file = pendulum();
    let table = done(costate::<&dyn AsRef<OsStr>>(&[
        &"value",
        &file,
        &"--grid",
        &"theta=-2:1:4,omega=-1:1:3",
    ]));
    let rows: Vec<Vec<&str>> = table.lines().map(|l| l.split(',').collect()).collect();
    assert_eq!(
        rows[0],
        [
            "theta", "omega", "V", "p_theta", "p_omega", "u", "sheet", "V_error", "p_error",
            "u_error", "coverage", "status"
        ]
    );
    assert_eq!(rows.len(), 13);
    assert_eq!(rows[2][..2], ["-2", "0"]);
    let grid = folder().join("grid.h5");
    done(costate::<&dyn AsRef<OsStr>>(&[
        &"value",
        &file,
        &"--grid",
        &"theta=-2:1:4",
        &"--grid",
        &"omega=-1:1:3",
        &"--out",
        &grid,
        &"--quiet",
    ]));
    let stored = Stored::open(&grid).unwrap();
    let map = stored.map().unwrap().unwrap();
    assert_eq!(map.axes, [vec![-2.0, -1.0, 0.0, 1.0], vec![-1.0, 0.0, 1.0]]);
    for (row, v) in rows[1..].iter().zip(&map.v) {
        assert_eq!(row[2].parse::<f64>().unwrap().to_bits(), v.to_bits());
    }
    let json = done(costate::<&dyn AsRef<OsStr>>(&[
        &"value",
        &file,
        &"--at",
        &"theta=-2,omega=0",
        &"--json",
    ]));
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(
        json[0]["value"]["V"].as_f64().unwrap().to_bits(),
        map.v[1].to_bits()
    );
    let text = done(costate::<&dyn AsRef<OsStr>>(&[
        &"value",
        &file,
        &"--at",
        &"theta=-2",
    ]));
    assert!(
        text.contains("theta = -2, omega = 0") && text.contains("interpolated from"),
        "{text}"
    );
    // A file that was made by interpolation is a result file like others.
    let again = done(costate::<&dyn AsRef<OsStr>>(&[
        &"value",
        &grid,
        &"--at",
        &"theta=-2,omega=0",
        &"--json",
    ]));
    let again: serde_json::Value = serde_json::from_str(&again).unwrap();
    assert_eq!(again[0]["value"]["V"], json[0]["value"]["V"]);
}

#[test]
fn bad_requests_are_refused() {
    let file = pendulum();
    let text = folder().join("text.h5");
    std::fs::write(&text, "no HDF5").unwrap();
    let missing = folder().join("missing.h5");
    let cases: [(&[&dyn AsRef<OsStr>], &str); 12] = [
        (&[&file], "no states are asked for"),
        (&[&file, &"--at", &"thet=1"], "did you mean `theta`"),
        (&[&file, &"--at", &"theta"], "not NAME=VALUE"),
        (&[&file, &"--at", &"theta=x"], "not a finite number"),
        (&[&file, &"--at", &"theta=1,theta=2"], "twice"),
        (&[&file, &"--grid", &"theta=1:0:5"], "above the first"),
        (&[&file, &"--grid", &"theta=0:1"], "FIRST:LAST:COUNT"),
        (
            &[&file, &"--grid", &"theta=0:1:100000,omega=0:1:100000"],
            "at most",
        ),
        (&[&file, &"--at", &"theta=1", &"--out", &"x.txt"], ".csv"),
        (
            &[&file, &"--at", &"theta=1", &"--out", &file],
            "this file is read",
        ),
        (&[&text, &"--at", &"theta=1"], "not a result file"),
        (&[&missing, &"--at", &"theta=1"], "cannot read"),
    ];
    for (arguments, words) in cases {
        let all: Vec<&dyn AsRef<OsStr>> = std::iter::once(&"value" as &dyn AsRef<OsStr>)
            .chain(arguments.iter().copied())
            .collect();
        let output = costate(&all);
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{words}: {errors}");
        assert!(errors.contains(words), "no `{words}` in {errors}");
        assert!(output.stdout.is_empty());
    }
    assert!(!Path::new("x.txt").exists());
}

/// The compressor's equations by hand: x' and L.
fn compressor(x: &[f64], v: f64, phi0: f64) -> ([f64; 4], f64) {
    let characteristic = |phi: f64| 0.1469 + 1.0 + 1.5 * phi - 0.5 * phi.powi(3);
    let [phi, psi, r, gamma] = [x[0], x[1], x[2], x[3]];
    let psi0 = characteristic(phi0);
    let gamma0 = (phi0 + 1.0) / psi0.sqrt();
    let rate = [
        -psi + characteristic(phi) - 3.0 * phi * r,
        phi + 1.0 - gamma * psi.sqrt(),
        4.0 * r * (1.0 - phi * phi - r),
        v,
    ];
    (
        rate,
        (phi - phi0).powi(2) + (psi - psi0).powi(2) + r * r + (gamma - gamma0).powi(2) + v * v,
    )
}

#[test]
fn the_compressor_study_has_the_published_figures() {
    let path = folder().join("study.h5");
    done(costate::<&dyn AsRef<OsStr>>(&[
        &"study",
        &scenario("moore_greitzer"),
        &"--backend",
        &"cpu",
        &"--quiet",
        &"--out",
        &path,
    ]));
    let stored = Stored::open(&path).unwrap();
    let study = stored.group("study").unwrap();
    let column = |name: &str| study.f64(name).unwrap().values;
    assert_eq!(column("Phi0"), [1.1, 1.2, 1.3, 1.4]);
    assert_eq!(study.i32("status").unwrap().1, [0; 4]);
    let (v, psi, gamma, rate) = (
        column("V"),
        column("lowest_Psi"),
        column("highest_gamma"),
        column("highest_rate"),
    );
    // Hardt (1999) at Phi0 = 1.2: V = 0.0533, Psi down to 1.975, gamma up to 1.536, its rate
    // between 0.072 and 0.075 (by collocation 0.07506): as many digits as are printed.
    assert!(
        (v[1] - 0.0533).abs() < 5e-5 && (psi[1] - 1.975).abs() < 5e-4,
        "{} {}",
        v[1],
        psi[1]
    );
    assert!(
        (gamma[1] - 1.536).abs() < 5e-4 && (rate[1] - 0.0750577).abs() < 2e-6,
        "{} {}",
        gamma[1],
        rate[1]
    );
    // Nearer to the peak recovery is dearer, and no rate is above the limit.
    assert!(v.windows(2).all(|w| w[0] > w[1]));
    assert!(rate.iter().all(|r| *r <= 0.1 + 1e-12));
    let paths = stored.group("study_trajectories").unwrap();
    let (t, x, u, along) = (
        paths.f64("t").unwrap(),
        paths.f64("x").unwrap(),
        paths.f64("u").unwrap(),
        paths.f64("V").unwrap(),
    );
    let samples = t.shape[1];
    for (k, phi0) in [1.1, 1.2, 1.3, 1.4].into_iter().enumerate() {
        let at = |q: usize| (k * samples + q, &x.values[(k * samples + q) * 4..][..4]);
        // From where it was asked, V of the table; then x' = f and V' = -L by central differences
        // (error h^2/6 of third derivatives; clamps switch, hence the root mean square).
        assert!((at(0).1[0] - phi0).abs() < 1e-12 && (at(0).1[2] - 0.12).abs() < 1e-12);
        assert!((along.values[k * samples] - v[k]).abs() < 1e-8 * v[k]);
        let (mut off, mut size) = (0.0, 0.0);
        for q in 1..samples - 1 {
            let (i, here) = at(q);
            let h = t.values[i + 1] - t.values[i - 1];
            let (f, l) = compressor(here, u.values[i], phi0);
            for (j, f) in f.iter().enumerate() {
                let slope = (at(q + 1).1[j] - at(q - 1).1[j]) / h;
                off += (slope - f).powi(2);
                size += f * f;
            }
            off += ((along.values[i + 1] - along.values[i - 1]) / h + l).powi(2);
            size += l * l;
        }
        let relative = (off / size).sqrt();
        assert!(relative < 0.02, "Phi0 = {phi0}: {relative}");
    }
}

#[test]
fn a_scene_without_a_study_has_none() {
    let output = costate::<&dyn AsRef<OsStr>>(&[&"study", &scenario("pendulum")]);
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("no [study]"));
    // A variant that is no scene: the equilibrium needs Phi0 above 1, or R grows.
    let bad = folder().join("bad.toml");
    let text = std::fs::read_to_string(scenario("moore_greitzer")).unwrap();
    std::fs::write(&bad, text.replace("[1.1, 1.2, 1.3, 1.4]", "[1.2, 0.9]")).unwrap();
    let out = folder().join("bad.h5");
    let output =
        costate::<&dyn AsRef<OsStr>>(&[&"study", &bad, &"--backend", &"cpu", &"--out", &out]);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert!(errors.contains("Phi0 = 0.9") && !out.exists(), "{errors}");
}

#[test]
fn clamps_and_states_beyond_rescue_do_not_mislead_the_map() {
    // Unstable, with too weak a control where |x + v| > 0.5: V is infinite there, and bent where
    // the clamp switches.
    let scene = folder().join("weak.toml");
    let text = r#"
states = { x = {}, v = {} }
controls = { u = { min = -0.5, max = 0.5 } }
dynamics = { x = "v", v = "x + u" }
cost = { running = "0.5*(x^2 + v^2 + u^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-1, 1], v = [-1, 1] }
shoot_out = { value_max = 2.0, spacing = 0.1, samples = 50 }
"#;
    std::fs::write(&scene, text).unwrap();
    let swept = made("weak", "shoot-out", &scene);
    let states: Vec<[f64; 2]> = spread(250)
        .map(|[a, b]| [2.0 * a - 1.0, 2.0 * b - 1.0])
        .collect();
    let solved = solved("weak", &scene, "x,v", &states);
    let map = Stored::open(&swept).unwrap().value_map().unwrap();
    let (mut known, mut errors) = (0, Vec::new());
    for (state, v) in states.iter().zip(&solved.v) {
        let Ok(here) = map.at(state).lowest else {
            continue;
        };
        known += 1;
        assert!(
            (state[0] + state[1]).abs() < 0.5,
            "{state:?} cannot be brought back, V = {}",
            here.v
        );
        assert!(v.is_finite(), "{state:?} was not solved");
        // Towards |x + v| = 0.5 the slope of V goes to infinity: there only the first digit is
        // asked for.
        let error = (here.v - v).abs() / v;
        assert!(error < 0.1, "{state:?}: {} for {v}", here.v);
        if (state[0] + state[1]).abs() < 0.45 {
            errors.push(error);
        }
        assert!(
            map.local(state)
                .is_none_or(|fast| (fast.v - v).abs() < 0.1 * v),
            "{state:?}"
        );
    }
    assert!(known > 70, "{known}");
    println!(
        "{known} known, V {:.1e} {:.1e}",
        quantile(&errors, 0.5),
        quantile(&errors, 1.0)
    );
    // Across a kink of p a cubic's error is of the second order in the distance of sites (0.025 to
    // 0.05 of the region).
    assert!(quantile(&errors, 0.5) < 1e-4 && quantile(&errors, 1.0) < 2e-2);
}

#[test]
fn nothing_is_written_over_what_is_read() {
    let scene = folder().join("kept.toml");
    std::fs::copy(scenario("linear_quadratic"), &scene).unwrap();
    let before = std::fs::read(&scene).unwrap();
    let file = pendulum();
    let held = std::fs::read(file).unwrap();
    let cases: [(&[&dyn AsRef<OsStr>], &str); 4] = [
        (&[&"run", &scene, &"--out", &scene], "this file is read"),
        (
            &[&"study", &scene, &"--out", &folder().join("other.toml")],
            "name it .h5",
        ),
        (&[&"report", &file, &"--out", &file], "this file is read"),
        (&[&"evaluate", &file, &"--set", &"g=1"], "--scene"),
    ];
    for (arguments, words) in cases {
        let output = costate(arguments);
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{words}: {errors}");
        assert!(errors.contains(words), "no `{words}` in {errors}");
    }
    assert!(std::fs::read(&scene).unwrap() == before && std::fs::read(file).unwrap() == held);
}
