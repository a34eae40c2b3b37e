//! Maps of finite horizons, V(x, t): against exact value functions, in a closed loop, as a header,
//! and asked wrongly.

use crate::common_problems::linear::{Linear, diagonal, form};
use crate::common_problems::{Exact, TwoWells};
use costate::low_level::map::ValueMap;
use costate::low_level::result::Stored;
use nalgebra::{DMatrix, Vector2};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// An empty directory of the test's own.
fn scratch(name: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("map-time-{name}"));
    let _ = std::fs::remove_dir_all(&directory);
    std::fs::create_dir_all(&directory).unwrap();
    directory
}

fn costate(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_costate"))
        .args(arguments)
        .output()
        .unwrap()
}

fn done(output: Output) -> String {
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{errors}");
    String::from_utf8(output.stdout).unwrap() + &errors
}

/// The file of a scene, made.
fn made(directory: &Path, scene: &str) -> PathBuf {
    let (from, to) = (directory.join("scene.toml"), directory.join("scene.h5"));
    std::fs::write(&from, scene).unwrap();
    let said = done(costate(&[
        "homotopy",
        "--backend",
        "cpu",
        from.to_str().unwrap(),
        "--out",
        to.to_str().unwrap(),
    ]));
    println!("{said}");
    to
}

/// Places spread evenly over a box, none of them on a grid.
fn spread<const N: usize>(region: [[f64; 2]; N], count: usize) -> Vec<[f64; N]> {
    let steps = [0.754_877_666, 0.569_840_290, 0.430_159_709];
    (1..=count)
        .map(|k| {
            std::array::from_fn(|i| {
                region[i][0] + (region[i][1] - region[i][0]) * (k as f64 * steps[i]).fract()
            })
        })
        .collect()
}

fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[((sorted.len() - 1) as f64 * share).round() as usize]
}

/// The problem of `scenarios/hopf_lax.toml`.
const TWO_WELLS: &str = r#"
states = { x = {}, y = {} }
controls = { u = {}, v = {} }
dynamics = { x = "u", y = "v" }
cost = { running = "0.5*(u^2 + v^2)", terminal = "x^4/4 - x^2 + 0.1*x + 0.5*y^2", final_time = 2.0 }
region = { x = [-3.0, 3.0], y = [-1.0, 1.0] }
[map]
"#;

/// V, dV/dx and dV/dt.
fn two_wells([x, y, t]: [f64; 3]) -> (f64, Vec<f64>, f64) {
    let Exact { v, p, .. } = TwoWells::with(2.0 - t).at(&[x, y]);
    // V_t = -H, with H = -|p|^2/2.
    let rate = 0.5 * (p[0] * p[0] + p[1] * p[1]);
    (v, p, rate)
}

#[test]
fn v_of_two_sheets_is_known_at_all_times() {
    let directory = scratch("wells");
    // With its bound, however large, something is to be said everywhere.
    let lines = "error = 3e-3\nerror_max = 1e6\nfloor = 3e-2\ncheck = 40\nstates = 1500\nregion = { x = [-1.0, 1.0], y = [-0.5, 0.5] }\n";
    let file = made(&directory, &format!("{TWO_WELLS}{lines}"));
    let map = Stored::open(&file).unwrap().value_map().unwrap();
    assert_eq!(map.time(), Some(2.0));
    let (mut errors, mut over, mut rates, mut unknown, mut met) = (vec![], vec![], vec![], 0, 0);
    for place in spread([[-1.0, 1.0], [-0.5, 0.5], [0.0, 2.0]], 1000) {
        let (v, _, rate) = two_wells(place);
        let Ok(here) = map.at_time(&place[..2], place[2]).lowest else {
            unknown += 1;
            continue;
        };
        over.push((here.v - v).abs() / here.v_error);
        // Next to the surface of equal cost, and to its edge, the states that it may solve do not
        // suffice, and it says so.
        if here.v_error <= 3e-3 * here.v.abs().max(3e-2) {
            met += 1;
            errors.push((here.v - v).abs() / v.abs().max(3e-2));
            rates.push((here.rate - rate).abs());
        }
    }
    println!(
        "{met} of 1000 with a bound as asked; V {:.1e} {:.1e} {:.1e}, over bound {:.2} {:.2}, dV/dt {:.1e} {:.1e}; {unknown} unknown",
        quantile(&errors, 0.5),
        quantile(&errors, 0.99),
        quantile(&errors, 1.0),
        quantile(&over, 0.99),
        quantile(&over, 1.0),
        quantile(&rates, 0.5),
        quantile(&rates, 0.99),
    );
    assert!(unknown <= 5 && met >= 900, "{unknown} {met}");
    // As for V(x, 0), tests/map.rs: bounds are measured at points that were left out.
    assert!(quantile(&over, 0.99) <= 1.0 && quantile(&over, 1.0) <= 3.0);
    assert!(quantile(&errors, 0.99) < 3e-3);
    assert!(quantile(&rates, 0.99) < 0.05);

    // Nothing is interpolated across the surface of equal cost, which ends at t = 1.5.
    let (mut wrong, mut looked) = (0, 0);
    for [x, y, t] in spread([[-0.02, 0.02], [-0.4, 0.4], [0.0, 1.2]], 300) {
        let wells = TwoWells::with(2.0 - t);
        let x = wells.equal_cost() + x;
        let Ok(here) = map.at_time(&[x, y], t).lowest else {
            continue;
        };
        // Where the map says that it does not know V well it may be of both.
        if here.v_error > 3e-3 * here.v.abs().max(3e-2) {
            continue;
        }
        looked += 1;
        // Of three extremals the dearest is the maximum between the wells.
        let ways = wells.ways(x);
        let sheets = &ways[..ways.len().min(2)];
        let clear = sheets.len() == 1 || sheets[1].v - sheets[0].v > 2.0 * here.v_error;
        let mixed = (sheets.iter()).all(|way| (here.p[0] - way.p).abs() > 0.05 * way.p.abs());
        wrong += usize::from(mixed || clear && here.p[0] * sheets[0].p < 0.0);
    }
    println!("beside the surface of equal cost {wrong} of {looked} wrong (of 300 places)");
    assert!(looked >= 100 && wrong <= 3, "{wrong} of {looked}");

    // A time that is not given is 0, where the law jumps over the same line.
    let at = |x: f64, t: &str| -> serde_json::Value {
        let place = format!("x={x},y=0.1{t}");
        let said = costate(&["value", file.to_str().unwrap(), "--json", "--at", &place]);
        assert_eq!(said.status.code(), Some(0));
        serde_json::from_slice::<serde_json::Value>(&said.stdout).unwrap()[0].clone()
    };
    assert_eq!(at(0.3, "")["value"], at(0.3, ",t=0")["value"]);
    assert_eq!(at(0.3, "")["t"], 0.0);
    let (v, p, rate) = two_wells([0.3, 0.1, 0.7]);
    let said = at(0.3, ",t=0.7");
    let number = |v: &serde_json::Value| v.as_f64().unwrap();
    assert!((number(&said["value"]["V"]) - v).abs() <= 3.0 * number(&said["value"]["V_error"]));
    assert!((number(&said["value"]["u"]["u"]) + p[0]).abs() < 0.02);
    assert!((number(&said["value"]["dV_dt"]) - rate).abs() < 0.02);
}

/// A spring with a light pull, and its Riccati differential equation.
const SPRING: &str = r#"
states = { x = {}, v = {} }
controls = { a = {} }
dynamics = { x = "v", v = "-x + 0.3*v + a" }
cost = { running = "0.5*(x^2 + v^2 + 0.5*a^2)", terminal = "1.5*x^2 + 0.5*v^2", final_time = 2.0 }
region = { x = [-1, 1], v = [-1, 1] }
"#;

/// P(t), for V = x'Px/2, and dP/dt.
fn riccati(t: f64) -> [DMatrix<f64>; 2] {
    let spring = Linear {
        a: DMatrix::from_row_slice(2, 2, &[0.0, 1.0, -1.0, 0.3]),
        b: DMatrix::from_row_slice(2, 1, &[0.0, 1.0]),
        q: diagonal(&[1.0, 1.0]),
        r: diagonal(&[0.5]),
    };
    let [p, by_time_left] = spring.with_time(diagonal(&[3.0, 1.0]), 2.0 - t);
    [p, -by_time_left]
}

/// V, p and dV/dt against the Riccati equation; the law of V(x, t) in a closed loop against V(x0,
/// 0), and what V(x, 0) for all times would cost.
#[test]
fn a_linear_quadratic_map_and_its_law() {
    let directory = scratch("spring");
    let loops =
        "[closed_loop]\nsamples = 40\ninitial = { x = [-0.6, 0.6, 4], v = [-0.6, 0.6, 4] }\n";
    let scene = |map: &str| format!("{SPRING}{loops}[map]\n{map}");
    let file = made(
        &directory,
        &scene("error = 1e-4\nfloor = 1e-2\ncheck = 40\n"),
    );
    crate::common_commands::in_schema(&file);
    let stored = Stored::open(&file).unwrap();
    let map = stored.value_map().unwrap();
    let (mut errors, mut over, mut slopes) = (vec![], vec![], vec![]);
    for [x, v, t] in spread([[-1.0, 1.0], [-1.0, 1.0], [0.0, 2.0]], 1000) {
        let [p, rate] = riccati(t);
        let exact = form(&p, &[x, v]);
        let here = map
            .at_time(&[x, v], t)
            .lowest
            .unwrap_or_else(|e| panic!("{x}, {v}, {t}: {e}"));
        errors.push((here.v - exact).abs() / exact.max(1e-2));
        over.push((here.v - exact).abs() / here.v_error);
        let gradient = &p * Vector2::new(x, v);
        let off = [
            here.p[0] - gradient[0],
            here.p[1] - gradient[1],
            here.rate - form(&rate, &[x, v]),
        ];
        slopes.push(off.iter().fold(0.0f64, |a, e| a.max(e.abs())));
    }
    println!(
        "V {:.1e} {:.1e}, over bound {:.2} {:.2}, slopes {:.1e} {:.1e}",
        quantile(&errors, 0.5),
        quantile(&errors, 1.0),
        quantile(&over, 0.99),
        quantile(&over, 1.0),
        quantile(&slopes, 0.5),
        quantile(&slopes, 1.0)
    );
    assert!(quantile(&errors, 1.0) < 1e-4);
    assert!(quantile(&over, 0.99) <= 1.0 && quantile(&over, 1.0) <= 2.0);
    assert!(quantile(&slopes, 1.0) < 2e-2);
    // The end of the horizon is the terminal cost.
    let here = map.at_time(&[0.5, -0.4], 2.0).lowest.unwrap();
    assert!((here.v - (1.5 * 0.25 + 0.5 * 0.16)).abs() < 1e-4 * here.v);
    // Beyond it there is nothing.
    assert!(map.at_time(&[0.5, -0.4], 2.1).lowest.is_err());

    // J/V - 1 with V of the Riccati equation.
    let [p, _] = riccati(0.0);
    let excess = |file: &Path, samples: usize| -> (Vec<f64>, String) {
        let to = file.with_extension(format!("{samples}.h5"));
        let from = file.with_extension(format!("{samples}.toml"));
        let text = std::fs::read_to_string(directory.join("scene.toml")).unwrap();
        std::fs::write(
            &from,
            text.replace("samples = 40", &format!("samples = {samples}")),
        )
        .unwrap();
        let [file, from, out] = [file, &from, &to].map(|p| p.to_str().unwrap().to_owned());
        let said = done(costate(&[
            "evaluate",
            &file,
            "--scene",
            &from,
            "--laws",
            "map",
            "--backend",
            "cpu",
            "--precision",
            "f64",
            "--rtol",
            "1e-9",
            "--out",
            &out,
        ]));
        crate::common_commands::in_schema(&to);
        let stored = Stored::open(&to).unwrap();
        let group = stored.group("closed_loop").unwrap();
        let (x0, cost) = (
            group.f64("x0").unwrap().values,
            group.f64("J").unwrap().values,
        );
        assert_eq!((x0.len(), cost.len()), (32, 16));
        let off = (x0.chunks(2).zip(&cost)).map(|(x, j)| j / form(&p, &[x[0], x[1]]) - 1.0);
        (off.collect(), said)
    };
    let (coarse, said) = excess(&file, 40);
    let (fine, _) = excess(&file, 160);
    assert!(!said.contains("initial time alone"), "{said}");
    let worst = |all: &[f64]| all.iter().fold(0.0f64, |a, x| a.max(x.abs()));
    println!(
        "J/V - 1 at most {:.1e}; with four times the updates {:.1e}",
        worst(&coarse),
        worst(&fine)
    );
    assert!(worst(&coarse) < 1e-4);
    assert!(worst(&fine) < 1e-5);

    // With V(x, 0) alone it is said, and costs much more.
    let other = scratch("spring-start");
    let alone = made(
        &other,
        &scene("error = 1e-4\nfloor = 1e-2\ncheck = 1\ntime = false\n"),
    );
    let (frozen, said) = excess(&alone, 40);
    println!(
        "J/V - 1 with V(x, 0) at all times at most {:.1e}",
        worst(&frozen)
    );
    assert!(
        said.contains("the file knows V at the initial time alone"),
        "{said}"
    );
    assert!(worst(&frozen) > 100.0 * worst(&coarse));

    the_header_takes_the_time(&directory, &file, &map);
    what_is_asked_wrongly(&file, &alone);
    tables_have_a_column_of_times(&directory, &file);
    written_values_are_read_at_the_beginning(&directory, &file);
}

/// The C header's functions of a state and a time.
fn the_header_takes_the_time(directory: &Path, file: &Path, map: &ValueMap) {
    let header = directory.join("map.h");
    done(costate(&[
        "export",
        file.to_str().unwrap(),
        "--out",
        header.to_str().unwrap(),
    ]));
    let text = std::fs::read_to_string(&header).unwrap();
    assert!(text.contains("t in [0, 2]"), "{}", &text[..400]);
    let places = spread([[-1.0, 1.0], [-1.0, 1.0], [0.0, 2.0]], 200);
    let asked: String = places
        .iter()
        .map(|x| format!("{{{:?}, {:?}, {:?}}},", x[0], x[1], x[2]))
        .collect();
    let program = format!(
        "#include \"map.h\"\n#include <stdio.h>\nstatic const double all[][3] = {{{asked}}};\nint main(void) {{\n  \
         unsigned k;\n  for (k = 0; k < sizeof all / sizeof *all; k++) {{\n    double x[2], V = 0, p[3] = {{0}}, u[1] = {{0}};\n    \
         int known;\n    x[0] = all[k][0]; x[1] = all[k][1];\n    known = map_value(x, all[k][2], &V, p);\n    \
         if (known != map_control(x, all[k][2], u)) return 1;\n    \
         printf(\"%d %.17g %.17g %.17g %.17g %.17g\\n\", known, V, p[0], p[1], p[2], u[0]);\n  }}\n  \
         return map_value(all[0], 2.5, &(double){{0}}, (double[3]){{0}});\n}}\n"
    );
    std::fs::write(directory.join("main.c"), program).unwrap();
    let compiler = std::env::var_os("CC").unwrap_or_else(|| "cc".into());
    let compiled = Command::new(compiler)
        .args([
            "-std=c99",
            "-Wall",
            "-Wextra",
            "-Werror",
            "-pedantic",
            "-o",
            "main",
            "main.c",
            "-lm",
        ])
        .current_dir(directory)
        .output()
        .unwrap();
    done(compiled);
    let rows = done(Command::new(directory.join("main")).output().unwrap());
    let rows: Vec<Vec<f64>> = rows
        .lines()
        .map(|line| {
            line.split_whitespace()
                .map(|v| v.parse().unwrap())
                .collect()
        })
        .collect();
    assert_eq!(rows.len(), places.len());
    for (row, place) in rows.iter().zip(&places) {
        let here = map.at_time(&place[..2], place[2]).lowest.unwrap();
        assert_eq!(row[0], 1.0);
        let said = [here.v, here.p[0], here.p[1], here.rate, here.u[0]];
        for (a, b) in row[1..].iter().zip(said) {
            assert!(
                (a - b).abs() <= 1e-11 * (1.0 + b.abs()),
                "{place:?}: {a} {b}"
            );
        }
    }
}

/// A usage error, with a place and a way out; nothing is written.
fn what_is_asked_wrongly(file: &Path, alone: &Path) {
    let refused = |file: &Path, arguments: &[&str], words: &[&str]| {
        let out = file.with_extension("refused.csv");
        let all = [
            &[
                "value",
                file.to_str().unwrap(),
                "--out",
                out.to_str().unwrap(),
            ],
            arguments,
        ]
        .concat();
        let output = costate(&all);
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{errors}");
        for word in words {
            assert!(errors.contains(word), "{word}: {errors}");
        }
        assert!(!out.exists());
    };
    refused(
        file,
        &["--at", "x=0.1,t=2.5"],
        &["--at x=0.1,t=2.5", "not within the horizon, from 0 to 2"],
    );
    refused(file, &["--at", "t=-0.1"], &["not within the horizon"]);
    // Among the names that there are is the time's, where the map has it as an axis.
    refused(file, &["--at", "z=1"], &["states: x, v", "the time, `t`"]);
    let names = file.with_extension("names.csv");
    std::fs::write(&names, "x,z\n0.1,0.5\n").unwrap();
    refused(
        file,
        &["--points", names.to_str().unwrap()],
        &["line 1", "`z`", "x, v, t"],
    );
    refused(
        file,
        &["--grid", "x=-1:1:3", "--grid", "t=0:3:4"],
        &["--grid t=0:3:4", "not within the horizon"],
    );
    refused(
        alone,
        &["--at", "x=0.1,t=0.5"],
        &["knows V at t = 0 alone", "[map] with error"],
    );
    let points = file.with_extension("points.csv");
    std::fs::write(&points, "x,t\n0.1,0.5\n0.1,7\n").unwrap();
    refused(
        file,
        &["--points", points.to_str().unwrap()],
        &["line 3", "column `t`", "not within the horizon"],
    );
    // Where V does not depend on time.
    let directory = scratch("rest");
    let scene = "states = { x = {} }\ncontrols = { u = {} }\ndynamics = { x = \"u\" }\ncost = { running = \"x^2 + u^2\" }\n\
        equilibrium = { x = 0, u = 0 }\nregion = { x = [-1, 1] }\n[map]\nerror = 1e-2\ncheck = 1\n";
    let rest = made(&directory, scene);
    refused(
        &rest,
        &["--at", "x=0.1,t=0.5"],
        &["infinite horizon", "leave it out"],
    );
}

/// `--points` with a column `t`, and `--grid` with an axis.
fn tables_have_a_column_of_times(directory: &Path, file: &Path) {
    let points = directory.join("asked.csv");
    std::fs::write(&points, "t,v,x\n0.5,0.2,-0.3\n1.75,0.2,-0.3\n").unwrap();
    let table = costate(&[
        "value",
        file.to_str().unwrap(),
        "--points",
        points.to_str().unwrap(),
    ]);
    let table = done(table);
    let mut lines = table.lines();
    assert!(
        lines
            .next()
            .unwrap()
            .starts_with("x,v,t,V,p_x,p_v,dV_dt,a,"),
        "{table}"
    );
    for (line, t) in lines.zip([0.5, 1.75]) {
        let row: Vec<f64> = line
            .split(',')
            .take(7)
            .map(|v| v.parse().unwrap())
            .collect();
        let [p, rate] = riccati(t);
        assert_eq!(row[..3], [-0.3, 0.2, t]);
        assert!((row[3] - form(&p, &[-0.3, 0.2])).abs() < 1e-4);
        assert!((row[6] - form(&rate, &[-0.3, 0.2])).abs() < 2e-2);
    }
    let out = directory.join("grid.h5");
    let (file, to) = (file.to_str().unwrap(), out.to_str().unwrap());
    done(costate(&[
        "value",
        file,
        "--grid",
        "x=-0.5:0.5:3,v=0.1,t=0:2:5",
        "--out",
        to,
    ]));
    crate::common_commands::in_schema(&out);
    let stored = Stored::open(&out).unwrap();
    let group = stored.group("map").unwrap();
    let v = group.f64("V").unwrap();
    assert_eq!(v.shape, [3, 1, 5]);
    assert_eq!(group.f64("t").unwrap().values, [0.0, 0.5, 1.0, 1.5, 2.0]);
    for (k, v) in v.values.iter().enumerate() {
        let (x, t) = (-0.5 + 0.5 * (k / 5) as f64, 0.5 * (k % 5) as f64);
        assert!((v - form(&riccati(t)[0], &[x, 0.1])).abs() < 1e-4);
    }
}

/// The end costs 0.2 cos 2y, and the way there half of its length squared over the time `left`
/// (Hopf and Lax).
fn waves(x: f64, left: f64) -> f64 {
    let slope = |y: f64| -0.4 * (2.0 * y).sin() + (y - x) / left;
    // No characteristics meet: the slope by the end rises.
    let (mut low, mut high) = (x - 0.5, x + 0.5);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if slope(middle) > 0.0 {
            high = middle;
        } else {
            low = middle;
        }
    }
    let y = 0.5 * (low + high);
    0.2 * (2.0 * y).cos() + (x - y).powi(2) / (2.0 * left)
}

/// Where V is 0 in the midst of a region its error relative to V says nothing of places nearer to
/// there.
#[test]
fn bounds_hold_where_v_changes_its_sign() {
    let directory = scratch("signs");
    for (name, floor) in [("own", ""), ("low", "floor = 1e-3")] {
        let scene = format!(
            "states = {{ x = {{}} }}\ncontrols = {{ u = {{}} }}\ndynamics = {{ x = \"u\" }}\nregion = {{ x = [-3, 3] }}\n\
             cost = {{ running = \"0.5*u^2\", terminal = \"0.2*cos(2*x)\", final_time = 1.0 }}\n\
             [map]\nerror = 1e-3\ncheck = 20\n{floor}\n"
        );
        let folder = directory.join(name);
        std::fs::create_dir_all(&folder).unwrap();
        let file = made(&folder, &scene);
        let map = Stored::open(&file).unwrap().value_map().unwrap();
        let (mut over, mut negative) = (Vec::new(), 0);
        for [x, t] in spread([[-3.0, 3.0], [0.0, 0.999]], 4000) {
            let Ok(here) = map.at_time(&[x], t).lowest else {
                continue;
            };
            negative += usize::from(here.v < 0.0);
            over.push((here.v - waves(x, 1.0 - t)).abs() / here.v_error);
        }
        println!(
            "{name}: {} known, {negative} below 0, error over bound {:.2} (99 %), {:.2} at most",
            over.len(),
            quantile(&over, 0.99),
            quantile(&over, 1.0)
        );
        assert!(over.len() > 3900 && negative > 1000);
        assert!(quantile(&over, 0.99) < 1.0 && quantile(&over, 1.0) < 3.0);
    }
}

/// Files that `costate value` wrote of several times: V(x, 0) is taken from their rows at t = 0, or
/// none is.
fn written_values_are_read_at_the_beginning(directory: &Path, file: &Path) {
    let write = |name: &str, arguments: &[&str]| {
        let out = directory.join(name);
        let all = [
            &[
                "value",
                file.to_str().unwrap(),
                "--out",
                out.to_str().unwrap(),
            ],
            arguments,
        ]
        .concat();
        done(costate(&all));
        out
    };
    let exact = |x: [f64; 2]| form(&riccati(0.0)[0], &x);
    let grid = write("read.h5", &["--grid", "x=-0.5:0.5:5,v=-0.4:0.4:3,t=0:2:5"]);
    crate::common_commands::in_schema(&grid);
    let map = Stored::open(&grid).unwrap().map().unwrap().unwrap();
    assert_eq!(
        (map.axes[0].len(), map.axes[1].len(), map.axes.len()),
        (5, 3, 2)
    );
    assert_eq!(
        (map.v.len(), map.p.len(), map.u.len(), map.status.len()),
        (15, 30, 15, 15)
    );
    for (k, v) in map.v.iter().enumerate() {
        assert!((v - exact([map.axes[0][k / 3], map.axes[1][k % 3]])).abs() < 1e-4);
    }
    let points = write(
        "rows.h5",
        &[
            "--at",
            "x=0.3,t=1.5",
            "--at",
            "x=0.3,v=0.1",
            "--at",
            "x=-0.2,t=2",
        ],
    );
    crate::common_commands::in_schema(&points);
    let rows = Stored::open(&points).unwrap().points().unwrap().unwrap();
    assert_eq!(
        (rows.x, rows.point, rows.count),
        (vec![0.3, 0.1], vec![1], 1)
    );
    assert!((rows.v[0] - exact([0.3, 0.1])).abs() < 1e-4 && rows.p.len() == 2 && rows.u.len() == 1);
    // Values of the files are values of V(x, 0) again.
    for path in [&grid, &points] {
        let map = Stored::open(path).unwrap().value_map().unwrap();
        let at = if path == &grid {
            [0.25, 0.4]
        } else {
            [0.3, 0.1]
        };
        let here = map.at(&at).lowest.unwrap();
        assert!((here.v - exact(at)).abs() < 1e-4, "{}", here.v);
        let path = path.to_str().unwrap();
        let report = done(costate(&["report", path, "--json"]));
        assert!(
            !report.contains("shape") && !report.contains("not found"),
            "{report}"
        );
        let said = costate(&[
            "check-least",
            path,
            "--backend",
            "cpu",
            "--json",
            "--nodes",
            "41",
        ]);
        let said = String::from_utf8(said.stdout).unwrap();
        let said: serde_json::Value =
            serde_json::from_str(&said[said.find('{').unwrap()..]).unwrap();
        assert_eq!(
            said["states"],
            if path.ends_with("read.h5") { 15 } else { 1 }
        );
        // The grid errs by less than what a step of the time axis changes.
        assert_eq!(
            said["apart"]["states"].as_array().unwrap().len(),
            0,
            "{said}"
        );
    }
    for late in [
        write("late.h5", &["--grid", "x=-0.5:0.5:5,v=-0.4:0.4:3,t=1:2:3"]),
        write("later.h5", &["--at", "x=0.3,t=1.5"]),
    ] {
        for command in [vec!["check-least"], vec!["value", "--at", "x=0.1"]] {
            let output =
                costate(&[&command[..1], &[late.to_str().unwrap()], &command[1..]].concat());
            let errors = String::from_utf8_lossy(&output.stderr);
            assert_eq!(output.status.code(), Some(2), "{errors}");
            assert!(
                errors.contains("/t`: no") && errors.contains("with t = 0 too"),
                "{errors}"
            );
        }
    }
}
