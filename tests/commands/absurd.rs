//! Numbers and files that are not what is asked for: each is refused at once, by its name.

use crate::common_commands::scratch;
use std::path::{Path, PathBuf};
use std::process::Command;

const SCENE: &str = r#"
states = { x = { period = "2*pi" }, v = {} }
controls = { u = {} }
parameters = { x0 = 0.5, q = 1 }
dynamics = { x = "v", v = "-q*sin(x) + u" }
cost = { running = "0.5*(x^2 + v^2 + u^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-1, 1], v = [-1, 1] }
homotopy = { x = "x0" }
shoot_out = { value_max = 0.5, spacing = 0.2, samples = 10 }
"#;

/// A directory with a scene, and its result.
fn swept(name: &str) -> PathBuf {
    let folder = scratch(&format!("absurd-{name}"));
    std::fs::write(folder.join("scene.toml"), SCENE).unwrap();
    said(
        &folder,
        &["shoot-out", "scene.toml", "--out", "swept.h5"],
        0,
    );
    folder
}

/// What a command prints on standard error, on one line.
fn said(folder: &Path, arguments: &[&str], status: i32) -> String {
    let done = Command::new(env!("CARGO_BIN_EXE_costate"))
        .current_dir(folder)
        .args(arguments)
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.code(), Some(status), "{arguments:?}: {text}");
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Subtracting so many periods leaves nothing of the angle (and took memory without end).
#[test]
fn angles_that_have_no_digits_left() {
    let folder = swept("angles");
    std::fs::write(folder.join("far.csv"), "x,v\n0.5,0\n1e26,0\n").unwrap();
    let listed = ["solve", "scene.toml", "--points", "far.csv"];
    let cases: [(&[&str], &str); 6] = [
        (&listed, "far.csv: line 3, column `x`: `x` = 1e26 is"),
        (
            &["value", "swept.h5", "--points", "far.csv"],
            "far.csv: line 3, column `x`: `x` = 1e26 is",
        ),
        (
            &["value", "swept.h5", "--at", "x=-1e300"],
            "--at x=-1e300: `x` = -1e300 is",
        ),
        (
            &["value", "swept.h5", "--grid", "x=0:1e26:5"],
            "--grid x=0:1e26:5: `x` = 1e26 is",
        ),
        (
            &["homotopy", "scene.toml", "--set", "x0=1e26"],
            "[scene.toml:9:18]",
        ),
        (
            &["check", "scene.toml", "--set", "x0=-7e5"],
            "`x` = -700000 is 1.1e5 periods away from 0",
        ),
    ];
    for (arguments, words) in cases {
        let text = said(&folder, arguments, 2);
        assert!(text.contains(words), "{arguments:?}: {text}");
        assert!(text.contains("subtract whole periods"), "{text}");
    }
    // As far as it may be, by whole periods: V is that of the state itself.
    let turns = 90_000.0 * std::f64::consts::TAU;
    std::fs::write(
        folder.join("near.csv"),
        format!("x,v\n0.5,0\n{},0\n", 0.5 + turns),
    )
    .unwrap();
    let solved = [
        "solve",
        "scene.toml",
        "--points",
        "near.csv",
        "--out",
        "v.csv",
    ];
    said(&folder, &solved, 0);
    let mut table = csv::Reader::from_path(folder.join("v.csv")).unwrap();
    let column = table.headers().unwrap().iter().position(|h| h == "V");
    let v: Vec<f64> = table
        .records()
        .map(|row| row.unwrap()[column.unwrap()].parse().unwrap())
        .collect();
    // The angle has lost an ulp of 5.7e5, and |dV/dx| is about 1.
    assert!((v[1] - v[0]).abs() < 1e-9 + 2.0 * turns * f64::EPSILON);
}

#[test]
fn a_file_of_another_kind() {
    let folder = swept("kinds");
    let text = said(&folder, &["run", "swept.h5"], 2);
    assert!(
        text.contains("swept.h5 is a result file: give the scene (.toml)"),
        "{text}"
    );
    let listed = ["solve", "scene.toml", "--points", "swept.h5"];
    let text = said(&folder, &listed, 2);
    assert!(
        text.contains("swept.h5 is not a CSV file: it is a result file (HDF5)"),
        "{text}"
    );
    let whole = std::fs::read(folder.join("swept.h5")).unwrap();
    std::fs::write(folder.join("cut.h5"), &whole[..whole.len() / 2]).unwrap();
    std::fs::write(folder.join("empty.h5"), "").unwrap();
    std::fs::write(folder.join("noise.h5"), [0x80u8, 0, 1, 255]).unwrap();
    for (file, what) in [
        ("scene.toml", "it is a text; this may be a scene"),
        ("empty.h5", "it is empty"),
        ("noise.h5", "it begins otherwise"),
        ("cut.h5", "it begins as one, but is damaged or cut short"),
    ] {
        let text = said(&folder, &["value", file, "--at", "x=0"], 2);
        let told = format!("{file} is not a result file (HDF5): {what}");
        assert!(text.contains(&told), "{text}");
    }
}

#[test]
fn numbers_of_no_size() {
    let folder = swept("sizes");
    for (set, hint) in [
        ("q=inf", "take a number that is large"),
        ("q=-Infinity", "take a number that is large"),
        ("q=nan", "give a number, or an expression"),
    ] {
        let text = said(&folder, &["check", "scene.toml", "--set", set], 2);
        let told = format!("--set {set}: parameter `q` is a finite number");
        assert!(text.contains(&told) && text.contains(hint), "{text}");
    }
    std::fs::write(folder.join("empty.toml"), "title = \"nothing yet\"\n").unwrap();
    let text = said(&folder, &["check", "empty.toml"], 2);
    assert!(text.contains("docs/scene.md"), "{text}");
    let wide = SCENE.replace("v = [-1, 1]", "v = [1e300, -1e300]");
    std::fs::write(folder.join("wide.toml"), wide).unwrap();
    let text = said(&folder, &["check", "wide.toml"], 2);
    assert!(text.contains("1e300 is not below -1e300"), "{text}");
}

/// Numbers whose products are none are named as the cause (a mode that cannot be stabilized was),
/// and so are commas where a table has other separators.
#[test]
fn units_and_separators_that_do_not_fit() {
    let folder = swept("units");
    for (from, to) in [
        (
            "region = { x = [-1, 1], v = [-1, 1] }",
            "region = { x = [-1, 1], v = [-1e100, 1e100] }",
        ),
        (
            "region = { x = [-1, 1], v = [-1, 1] }",
            "region = { x = [-1, 1], v = [-1e-200, 1e-200] }",
        ),
        ("0.5*(x^2 + v^2 + u^2)", "1e200*(x^2 + v^2 + u^2)"),
        ("0.5*(x^2 + v^2 + u^2)", "1e-200*(x^2 + v^2 + u^2)"),
        ("+ u\"", "+ 1e-150*u\""),
    ] {
        let scene = SCENE.replace(from, to);
        assert_ne!(scene, SCENE);
        std::fs::write(folder.join("units.toml"), scene).unwrap();
        let text = said(
            &folder,
            &["shoot-out", "units.toml", "--out", "units.h5"],
            2,
        );
        assert!(text.contains("too far from 1"), "{to}: {text}");
        assert!(!folder.join("units.h5").exists(), "{to}");
    }
    for text in ["x;v\n0.5;0\n", "x\tv\n0.5\t0\n"] {
        std::fs::write(folder.join("points.csv"), text).unwrap();
        let said = said(
            &folder,
            &["solve", "scene.toml", "--points", "points.csv"],
            2,
        );
        assert!(said.contains("separated by commas"), "{said}");
    }
}
