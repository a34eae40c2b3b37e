//! `costate solve` and `costate homotopy` as a user runs them: files in, files out, refusals.

use crate::common_commands;

use common_commands::{checked_by, column_of, scratch};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn folder(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("costate-solve-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&path).unwrap();
    path
}

fn scenario(name: &str) -> PathBuf {
    Path::new(crate::ROOT).join("scenarios").join(name)
}

fn costate(arguments: &[&std::ffi::OsStr]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_costate"))
        .args(arguments)
        .output()
        .unwrap()
}

fn solve(name: &str, csv: &str) -> (Output, PathBuf) {
    let folder = folder(name);
    let points = folder.join("points.csv");
    std::fs::write(&points, csv).unwrap();
    let out = folder.join("out.h5");
    let done = costate(&[
        "solve".as_ref(),
        scenario("pendulum.toml").as_ref(),
        "--backend".as_ref(),
        "cpu".as_ref(),
        "--json".as_ref(),
        "--points".as_ref(),
        points.as_ref(),
        "--out".as_ref(),
        out.as_ref(),
    ]);
    (done, out)
}

#[test]
fn bad_points_are_refused_with_their_place() {
    for (name, csv, words) in [
        (
            "unknown",
            "theta,omeg\n1,2\n",
            vec!["line 1", "`omeg`", "did you mean `omega`"],
        ),
        ("twice", "theta,theta\n1,2\n", vec!["line 1", "twice"]),
        (
            "number",
            "theta,omega\n1,2\n3,x\n",
            vec!["line 3", "`omega`", "`x`"],
        ),
        (
            "infinite",
            "theta\ninf\n",
            vec!["line 2", "not a finite number"],
        ),
        (
            "lines",
            "theta,omega\r\n1,2\r\n\r\n# no\r\n3,x\r\n",
            vec!["line 5", "`omega`"],
        ),
        (
            "ragged",
            "theta,omega\n1\n",
            vec!["line 2: 1 values, where the header names 2"],
        ),
        ("empty", "theta,omega\n", vec!["no points"]),
        ("nothing", "", vec!["header"]),
    ] {
        let (done, out) = solve(name, csv);
        let text = String::from_utf8_lossy(&done.stderr).into_owned();
        assert_eq!(done.status.code(), Some(2), "{name}: {text}");
        for word in words {
            assert!(text.contains(word), "{name}: no `{word}` in: {text}");
        }
        assert!(
            !out.exists() && done.stdout.is_empty(),
            "{name}: nothing is written"
        );
    }
    let missing = costate(&[
        "solve".as_ref(),
        scenario("pendulum.toml").as_ref(),
        "--points".as_ref(),
        "no-such-file.csv".as_ref(),
    ]);
    assert_eq!(missing.status.code(), Some(2));
}

#[test]
fn a_scene_without_targets_has_no_homotopy() {
    let folder = folder("none");
    let file = folder.join("scene.toml");
    let text = r#"
        states = { x = {} }
        controls = { u = {} }
        dynamics = { x = "x + u" }
        cost = { running = "0.5*(x^2 + u^2)" }
        equilibrium = { x = 0, u = 0 }
        region = { x = [-1, 1] }
    "#;
    std::fs::write(&file, text).unwrap();
    let done = costate(&["homotopy".as_ref(), file.as_ref()]);
    assert_eq!(done.status.code(), Some(2));
    // One state, no [shoot_out]: points are solved all the same. V = (1 + sqrt 2) x^2 / 2.
    let points = folder.join("points.csv");
    std::fs::write(&points, "x\n0.5\n-2\n0\n0.5\n").unwrap();
    let out = folder.join("out.h5");
    let done = costate(&[
        "solve".as_ref(),
        file.as_ref(),
        "--points".as_ref(),
        points.as_ref(),
        "--json".as_ref(),
        "--out".as_ref(),
        out.as_ref(),
    ]);
    let text = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.code(), Some(0), "{text}");
    let summary: serde_json::Value = serde_json::from_slice(&done.stdout).unwrap();
    assert_eq!(summary["homotopy"]["status"]["converged"], 4, "{summary}");
    assert_eq!(summary["homotopy"]["distinct"], 3);
    let file = rust_hdf5::H5File::open(&out).unwrap();
    let v: Vec<f64> = file.dataset("points/V").unwrap().read_raw::<f64>().unwrap();
    for (v, x) in v.iter().zip([0.5f64, -2.0, 0.0, 0.5]) {
        let exact = 0.5 * (1.0 + 2f64.sqrt()) * x * x;
        assert!((v - exact).abs() <= 1e-9 * exact, "{v} not {exact}");
    }
}

/// The groups of a whole run, as xarray's engines see them.
/// The table says what `--json` says of each state; only it is written.
#[test]
fn answers_as_a_table() {
    let folder = folder("table");
    let (points, out) = (folder.join("points.csv"), folder.join("answers.csv"));
    std::fs::write(&points, "theta,omega\n0.5,0.25\n40,90\n0,0\n").unwrap();
    let pendulum = scenario("pendulum.toml");
    let arguments = |out: &Path, more: &[&str]| -> Vec<std::ffi::OsString> {
        let fixed = [
            "solve",
            pendulum.to_str().unwrap(),
            "--backend",
            "cpu",
            "--json",
        ];
        let paths = [
            "--points",
            points.to_str().unwrap(),
            "--out",
            out.to_str().unwrap(),
        ];
        fixed
            .iter()
            .chain(&paths)
            .chain(more)
            .map(Into::into)
            .collect()
    };
    let run = |out: &Path, more: &[&str]| {
        let arguments = arguments(out, more);
        costate(&arguments.iter().map(|a| a.as_os_str()).collect::<Vec<_>>())
    };
    let done = run(&out, &[]);
    assert_eq!(
        done.status.code(),
        Some(0),
        "{}",
        String::from_utf8_lossy(&done.stderr)
    );
    let summary: serde_json::Value = serde_json::from_slice(&done.stdout).unwrap();
    let table = std::fs::read_to_string(&out).unwrap();
    let rows: Vec<Vec<&str>> = table.lines().map(|l| l.split(',').collect()).collect();
    let header = "theta,omega,V,p_theta,p_omega,u,sheet,sheets,status,evidence,covered_to,bound";
    assert_eq!(rows[0].join(","), header);
    assert_eq!(rows.len(), 4);
    let column = |name: &str| rows[0].iter().position(|n| *n == name).unwrap();
    for (row, point) in rows[1..].iter().zip(summary["points"].as_array().unwrap()) {
        assert_eq!(row[column("status")], point["status"].as_str().unwrap());
        assert_eq!(row[column("evidence")], point["support"].as_str().unwrap());
        assert_eq!(row[column("V")].parse::<f64>().ok(), point["V"].as_f64());
        assert_eq!(
            row[column("p_omega")].parse::<f64>().ok(),
            point["p"][1].as_f64()
        );
        assert_eq!(row[column("u")].parse::<f64>().ok(), point["u"][0].as_f64());
    }
    assert_eq!(rows[1][column("status")], "converged");
    assert_ne!(rows[2][column("status")], "converged");
    assert!(rows[2][column("V")].is_empty());
    let names: Vec<_> = std::fs::read_dir(&folder)
        .unwrap()
        .map(|f| f.unwrap().file_name())
        .collect();
    assert_eq!(names.len(), 2, "{names:?}");

    // A table has no trajectories, and the points are not written over.
    let refused = run(&out, &["--trajectories"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("--trajectories"));
    let named = folder.join("named.toml");
    let text = std::fs::read_to_string(&pendulum)
        .unwrap()
        .replace("omega", "sheets");
    std::fs::write(&named, text).unwrap();
    std::fs::write(folder.join("named.csv"), "theta\n1\n").unwrap();
    let mut with = arguments(&folder.join("none.csv"), &[]);
    (with[1], with[6]) = (named.into(), folder.join("named.csv").into());
    let refused = costate(&with.iter().map(|a| a.as_os_str()).collect::<Vec<_>>());
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("another column"));
    assert!(!folder.join("none.csv").exists());
    let refused = run(&points, &[]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(
        std::fs::read_to_string(&points)
            .unwrap()
            .starts_with("theta,omega\n0.5")
    );
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn result_groups_open_in_xarray() {
    let folder = folder("groups");
    let out = folder.join("out.h5");
    let text = std::fs::read_to_string(scenario("pendulum.toml")).unwrap();
    let small = text
        .replace("[-5.0, 3.5, 171]", "[-5.0, 3.5, 35]")
        .replace("{ theta = 64, omega = 64 }", "{ theta = 15, omega = 13 }");
    assert_ne!(small, text);
    let file = folder.join("scene.toml");
    std::fs::write(&file, small).unwrap();
    let done = costate(&[
        "run".as_ref(),
        file.as_ref(),
        "--out".as_ref(),
        out.as_ref(),
    ]);
    assert_eq!(
        done.status.code(),
        Some(0),
        "{}",
        String::from_utf8_lossy(&done.stderr)
    );
    checked_by("check_answers.py", &[&out]);
}

/// `v' = f(v) + w` with the cost `(v^2 + w^2)/2`: H = 0 gives `p = f + sqrt(f^2 + v^2)`, and V is
/// its integral.
#[test]
fn what_saturates_or_vanishes_at_the_equilibrium_counts_elsewhere() {
    let folder = scratch("solve_saturated");
    type Drift = fn(f64) -> f64;
    let cases: [(&str, &str, Drift); 4] = [
        ("tanh", "tanh(40*(v - 0.5)) + tanh(20)", |v| {
            (40.0 * (v - 0.5)).tanh() + 20f64.tanh()
        }),
        ("bump", "exp(-((v - 0.5)*60)^2)", |v| {
            (-((v - 0.5) * 60.0).powi(2)).exp()
        }),
        ("bump_less_deep", "exp(-((v - 0.5)*54)^2)", |v| {
            (-((v - 0.5) * 54.0).powi(2)).exp()
        }),
        ("logistic", "1/(1 + exp(50 - 100*v))", |v| {
            1.0 / (1.0 + (50.0 - 100.0 * v).exp())
        }),
    ];
    for (name, text, f) in cases {
        let scene = format!(
            "states = {{ v = {{}} }}\ncontrols = {{ w = {{}} }}\ndynamics = {{ v = \"{text} + w\" }}\n\
             cost = {{ running = \"0.5*(v^2 + w^2)\" }}\nequilibrium = {{ v = 0, w = 0 }}\nregion = {{ v = [-1, 1] }}\n"
        );
        let found = column_of(&folder, name, &scene, ("v", &[[0.45], [0.5], [0.55]]), "V");
        for (x, v) in [0.45, 0.5, 0.55].into_iter().zip(&found) {
            // Simpson's rule, in parts much shorter than the layer.
            let count = 20_000;
            let p = |v: f64| f(v) + f(v).hypot(v);
            let h = x / f64::from(count);
            let sum: f64 = (0..count)
                .map(|k| h * f64::from(k))
                .map(|a| p(a) + 4.0 * p(a + 0.5 * h) + p(a + h))
                .sum();
            let right = sum * h / 6.0;
            let v: f64 = v.parse().unwrap();
            assert!(
                (v - right).abs() < 1e-8 * right,
                "{name}, {x}: {v} instead of {right}"
            );
        }
    }
}

/// Which of several guards a state is outside of, and the guard that its trajectory leaves.
#[test]
fn a_guard_that_is_left_is_named() {
    let folder = folder("guards");
    let points = folder.join("points.csv");
    std::fs::write(&points, "x,v\n1,0\n1,-0.6\n").unwrap();
    let said = |guards: &str| {
        let scene = folder.join("bound.toml");
        let text = format!(
            r#"
            states = {{ x = {{}}, v = {{}} }}
            controls = {{ u = {{ min = -2, max = 2 }} }}
            dynamics = {{ x = "v", v = "u" }}
            cost = {{ running = "x^2 + 0.1*v^2 + 0.1*u^2" }}
            equilibrium = {{ x = 0, v = 0, u = 0 }}
            region = {{ x = [-1, 1], v = [-1, 1] }}
            guards = {{ {guards} }}
            "#
        );
        std::fs::write(&scene, text).unwrap();
        let done = costate(&[
            "solve".as_ref(),
            scene.as_ref(),
            "--backend".as_ref(),
            "cpu".as_ref(),
            "--points".as_ref(),
            points.as_ref(),
            "--out".as_ref(),
            folder.join("out.h5").as_ref(),
        ]);
        String::from_utf8_lossy(&done.stdout).into_owned()
    };
    let one = said("slow = \"v^2 < 0.25\"");
    assert!(one.contains("leaves guard `slow`: x = 1.0"), "{one}");
    assert!(one.contains("outside guard `slow`: x = 1.0"), "{one}");
    let two = said("near = \"x > -2\", slow = \"v^2 < 0.25\"");
    assert!(two.contains("outside guard `slow`: x = 1.0"), "{two}");
    assert!(!two.contains("guard `near`"), "{two}");
}
