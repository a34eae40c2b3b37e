//! The dissipation inequality through the program: a nonlinear game from its sweep on, a linear one
//! without, file and report.

use costate::low_level::result::Stored;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn folder(name: &str) -> PathBuf {
    let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR"))
        .join("dissipation")
        .join(name);
    let _ = std::fs::remove_dir_all(&path);
    std::fs::create_dir_all(&path).unwrap();
    path
}

fn costate(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_costate"))
        .args(args)
        .output()
        .unwrap()
}

fn json(done: &Output) -> Value {
    assert!(
        done.status.success(),
        "{}",
        String::from_utf8_lossy(&done.stderr)
    );
    serde_json::from_slice(&done.stdout).unwrap()
}

/// A shipped scene with fewer disturbances.
fn scene(folder: &Path, name: &str, disturbances: usize) -> PathBuf {
    let text = std::fs::read_to_string(format!("{}/scenarios/{name}.toml", crate::ROOT)).unwrap();
    let path = folder.join(format!("{name}.toml"));
    let fewer = text.replace(
        "disturbances = 10000",
        &format!("disturbances = {disturbances}"),
    );
    assert_ne!(text, fewer);
    std::fs::write(&path, fewer).unwrap();
    path
}

/// The law of the value map, V at the initial states solved for: the ratio keeps below 1, and the
/// map's errors of V are told apart.
#[test]
fn a_nonlinear_game_from_its_sweep() {
    let folder = folder("nonlinear");
    let (scene, out) = (
        scene(&folder, "manufactured_game", 1500),
        folder.join("out.h5"),
    );
    let done = costate(&[
        "run",
        scene.to_str().unwrap(),
        "--backend",
        "cpu",
        "--json",
        "--no-report",
        "--out",
        out.to_str().unwrap(),
    ]);
    let summary = json(&done);
    let law = &summary["dissipation"]["laws"][0];
    println!("{}", law["verdict"]);
    assert_eq!(law["held"], true, "{}", law["verdict"]);
    let worst = law["kinds"]["worst_case"]["worst_ratio"].as_f64().unwrap();
    assert!((worst - 1.0).abs() < 1e-5, "{worst}");
    assert!(
        law["verdict"]
            .as_str()
            .unwrap()
            .contains("the worst case comes closest")
    );

    crate::common_commands::in_schema(&out);
    let stored = Stored::open(&out).unwrap();
    let group = stored.group("dissipation").unwrap();
    let (x, v) = (
        group.f64("x0").unwrap().values,
        group.f64("V0").unwrap().values,
    );
    assert_eq!(v.len(), 1500);
    for (x, v) in x.chunks_exact(2).zip(&v) {
        let exact = 0.5 * (x[0] * x[0] + x[1] * x[1]) + 0.25 * x[0].powi(4);
        // Solved for with rtol 1e-8.
        assert!(
            (v - exact).abs() <= 1e-7 * exact,
            "V0 at {x:?}: {v} {exact}"
        );
    }
    let ratio = group.f64("ratio").unwrap();
    assert_eq!(ratio.shape, [1, 1500]);
    assert!(ratio.values.iter().all(|r| *r <= 1.0 + 1e-6));
}

#[test]
fn a_linear_game_without_a_sweep() {
    let folder = folder("linear");
    let (scene, out) = (scene(&folder, "linear_game", 600), folder.join("out.h5"));
    let evaluate = |file: &Path| {
        let args = [
            "evaluate",
            file.to_str().unwrap(),
            "--backend",
            "cpu",
            "--json",
        ];
        json(&match file == out {
            true => costate(&args),
            false => costate(&[args.as_slice(), &["--out", out.to_str().unwrap()]].concat()),
        })
    };
    let first = evaluate(&scene);
    let laws = first["dissipation"]["laws"].as_array().unwrap();
    let held: Vec<bool> = laws.iter().map(|l| l["held"].as_bool().unwrap()).collect();
    assert_eq!(held, [true, false], "{}", first["dissipation"]);
    assert_eq!(
        first["dissipation"]["value_function"],
        "exact (linear scene)"
    );
    // Again from the result: the groups are replaced by the same.
    let read = || {
        crate::common_commands::in_schema(&out);
        let stored = Stored::open(&out).unwrap();
        let all = stored
            .group("dissipation")
            .unwrap()
            .f64("violation")
            .unwrap()
            .values;
        let paths = stored.group("dissipation_trajectories").unwrap();
        let (w, t) = (paths.f64("w").unwrap(), paths.f64("t").unwrap());
        assert_eq!(w.shape, [t.shape[0], t.shape[1], 1]);
        assert_eq!(
            stored
                .group("dissipation_kinds")
                .unwrap()
                .texts("kind")
                .unwrap()
                .len(),
            6
        );
        all
    };
    let before = read();
    let second = evaluate(&out);
    assert_eq!(
        second["dissipation"]["laws"][0]["kinds"],
        first["dissipation"]["laws"][0]["kinds"]
    );
    assert_eq!(before, read());
    let page = costate(&["report", out.to_str().unwrap(), "--quiet"]);
    assert!(
        page.status.success(),
        "{}",
        String::from_utf8_lossy(&page.stderr)
    );
    for picture in ["dissipation", "dissipation_histories"] {
        let svg = std::fs::read_to_string(folder.join("out_report").join(format!("{picture}.svg")))
            .unwrap();
        assert!(svg.contains("worst case"), "{picture}");
    }
    let html = std::fs::read_to_string(folder.join("out_report.html")).unwrap();
    assert!(html.contains("Dissipation inequality"));
}

/// What cannot be checked is said, and nothing is written.
#[test]
fn a_nonlinear_scene_without_a_map_is_refused() {
    let folder = folder("refused");
    let (scene, out) = (
        scene(&folder, "manufactured_game", 10),
        folder.join("out.h5"),
    );
    let done = costate(&[
        "evaluate",
        scene.to_str().unwrap(),
        "--out",
        out.to_str().unwrap(),
    ]);
    assert_eq!(done.status.code(), Some(1));
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(said.contains("there is no value map"), "{said}");
    assert!(!out.exists());
}
