//! The program as its user meets it: arguments, exit status, what is printed where, and what is
//! left on disk.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

/// A fresh directory to run in.
fn directory(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR"))
        .join("program")
        .join(name);
    if path.exists() {
        std::fs::remove_dir_all(&path).expect("an old directory can be removed");
    }
    std::fs::create_dir_all(&path).expect("a directory can be made");
    path
}

fn shipped(name: &str) -> String {
    let path = Path::new(crate::ROOT)
        .join("scenarios")
        .join(name)
        .with_extension("toml");
    path.display().to_string()
}

fn command(directory: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_costate"));
    command
        .current_dir(directory)
        .args(arguments)
        .stdin(Stdio::null());
    command
}

fn costate(directory: &Path, arguments: &[&str]) -> Output {
    command(directory, arguments)
        .output()
        .expect("the program starts")
}

/// Everything below a directory.
fn contents(directory: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut open = vec![directory.to_owned()];
    while let Some(at) = open.pop() {
        for entry in std::fs::read_dir(at).expect("a directory can be read") {
            let path = entry.expect("an entry can be read").path();
            if path.is_dir() {
                open.push(path.clone());
            }
            found.push(path);
        }
    }
    found
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// A refusal: this status, a word of the reason on standard error, and nothing anywhere else.
fn refused(name: &str, arguments: &[&str], status: i32, reason: &str) {
    let here = directory(name);
    let output = costate(&here, arguments);
    assert_eq!(
        output.status.code(),
        Some(status),
        "{arguments:?}: {}",
        text(&output.stderr)
    );
    assert_eq!(text(&output.stdout), "", "{arguments:?}");
    assert!(
        text(&output.stderr).contains(reason),
        "{arguments:?}: no `{reason}` in: {}",
        text(&output.stderr)
    );
    assert_eq!(
        contents(&here),
        Vec::<PathBuf>::new(),
        "{arguments:?} leaves nothing"
    );
}

#[test]
fn wrong_usage_is_refused() {
    let pendulum = shipped("pendulum");
    refused(
        "option",
        &["run", &pendulum, "--tolerance", "1e-3"],
        2,
        "--tolerance",
    );
    refused("command", &["fly", &pendulum], 2, "fly");
    refused("missing", &["run"], 2, "SCENE");
    refused(
        "rtol",
        &["run", &pendulum, "--rtol", "fast"],
        2,
        "not a number",
    );
    refused(
        "rtol-range",
        &["run", &pendulum, "--rtol=-1"],
        2,
        "at most 0.1",
    );
    refused(
        "precision",
        &["run", &pendulum, "--precision", "f16"],
        2,
        "f16",
    );
    refused("no-file", &["run", "nowhere.toml"], 2, "nowhere.toml");
}

#[test]
fn wrong_settings_are_refused() {
    let pendulum = shipped("pendulum");
    refused("set-name", &["run", &pendulum, "--set", "qq=3"], 2, "qq");
    refused(
        "set-form",
        &["run", &pendulum, "--set", "q"],
        2,
        "NAME=VALUE",
    );
    refused("set-value", &["run", &pendulum, "--set", "q=3+"], 2, "3+");
    // The cost is no longer positive definite: no local solution.
    refused(
        "set-sense",
        &["run", &pendulum, "--set", "r=-1"],
        2,
        "convex",
    );
    refused(
        "set-peak",
        &["run", &shipped("moore_greitzer"), "--set", "Phi0=1.0"],
        2,
        "0.000000",
    );
}

#[test]
fn a_wrong_scene_is_refused_with_all_its_errors() {
    let here = directory("scene");
    let source = std::fs::read_to_string(shipped("pendulum")).expect("the scene is there");
    let wrong = source
        .replace("-g*sin(theta) + u", "-g*sine(theta) + u")
        .replace("q*(e^2 + omega^2)", "q*(e^2 + omga^2)");
    std::fs::write(here.join("wrong.toml"), wrong).expect("a file can be written");
    for command in ["run", "check", "shoot-out"] {
        let output = costate(&here, &[command, "wrong.toml"]);
        let errors = text(&output.stderr);
        assert_eq!(
            (output.status.code(), text(&output.stdout).as_str()),
            (Some(2), ""),
            "{command}"
        );
        for part in ["wrong.toml", "sine", "omga", "did you mean"] {
            assert!(errors.contains(part), "{command}: no `{part}` in {errors}");
        }
    }
    assert_eq!(
        contents(&here),
        [here.join("wrong.toml")],
        "nothing is written"
    );
}

#[test]
fn the_result_goes_where_it_should() {
    let here = directory("output");
    let output = costate(
        &here,
        &["run", &shipped("manufactured"), "--backend", "cpu"],
    );
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let file = here.join("out").join("manufactured.h5");
    let (page, pictures) = (
        here.join("out/manufactured_report.html"),
        here.join("out/manufactured_report"),
    );
    let (drawn, rest): (Vec<PathBuf>, Vec<PathBuf>) = contents(&here)
        .into_iter()
        .partition(|p| p.starts_with(&pictures));
    assert_eq!(
        rest,
        [here.join("out"), file.clone(), page],
        "the default, and nothing beside it but the report"
    );
    assert!(
        drawn.len() > 2
            && drawn
                .iter()
                .skip(1)
                .all(|p| p.extension().is_some_and(|e| e == "svg" || e == "png")),
        "{drawn:?}"
    );
    assert!(
        std::fs::read(&file)
            .expect("it can be read")
            .starts_with(b"\x89HDF\r\n\x1a\n")
    );
    let said = text(&output.stdout);
    for part in ["trajectories", "covered", "|H|", "manufactured.h5"] {
        assert!(said.contains(part), "no `{part}` in {said}");
    }
    let elsewhere = here.join("some").join("where.h5");
    let argument = elsewhere.display().to_string();
    let output = costate(
        &here,
        &[
            "shoot-out",
            &shipped("manufactured"),
            "--backend",
            "cpu",
            "--out",
            &argument,
        ],
    );
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert!(elsewhere.exists());
}

#[test]
fn json_is_alone_on_standard_output() {
    let here = directory("json");
    for arguments in [
        vec!["run", "scene", "--json", "--backend", "cpu"],
        vec!["run", "scene", "--json", "--quiet", "--backend", "cpu"],
        vec!["check", "scene", "--json"],
    ] {
        let scene = shipped("manufactured");
        let arguments: Vec<&str> = arguments
            .iter()
            .map(|a| if *a == "scene" { scene.as_str() } else { a })
            .collect();
        let output = costate(&here, &arguments);
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        let value: serde_json::Value =
            serde_json::from_slice(&output.stdout).expect("standard output is JSON");
        assert!(
            value["title"]
                .as_str()
                .is_some_and(|t| t.contains("Manufactured")),
            "{value}"
        );
        if arguments[0] == "run" {
            let count = value["trajectories"].as_u64().expect("a count");
            assert!(count > 50, "{value}");
            assert_eq!(value["status"]["reached"].as_u64(), Some(count), "{value}");
            assert_eq!(
                text(&output.stderr).is_empty(),
                arguments.contains(&"--quiet"),
                "the rest is on standard error"
            );
        }
    }
}

/// Without trajectories a sweep tells the same of them.
#[test]
fn trajectories_may_be_left_out() {
    let here = directory("without");
    let scene = shipped("manufactured");
    let told = |command: &str, out: &str, more: &[&str]| {
        let arguments = [
            &[command, &scene, "--json", "--backend", "cpu", "--out", out],
            more,
        ];
        let output = costate(&here, &arguments.concat());
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        let mut told: serde_json::Value =
            serde_json::from_slice(&output.stdout).expect("standard output is JSON");
        let stored = told["trajectories_stored"].take();
        let file = rust_hdf5::H5File::open(here.join(out)).expect("a result file");
        assert_eq!(stored, file.dataset("trajectories/V").is_ok());
        let kept = [
            "trajectories",
            "status",
            "coverage",
            "hamiltonian",
            "seed_value",
            "estimates",
        ];
        (stored, kept.map(|name| told[name].take()))
    };
    for command in ["run", "shoot-out"] {
        let (all, with) = told(command, "with.h5", &[]);
        let (none, without) = told(command, "without.h5", &["--no-trajectories"]);
        assert_eq!((all, none), (true.into(), false.into()));
        assert_eq!(with, without);
        assert!(with[0].as_u64().is_some_and(|count| count > 50));

        let (values, alone) = told(command, "values.h5", &["--values-only"]);
        assert_eq!(values, serde_json::Value::Bool(true));
        assert_eq!(with, alone);
    }

    // The same numbers, rounded, in less than a quarter of the bytes of a sample.
    let read = |out: &str, name: &str| {
        let file = rust_hdf5::H5File::open(here.join(out)).expect("a result file");
        let dataset = file.dataset(&format!("trajectories/{name}")).expect(name);
        (
            dataset.element_size(),
            dataset.read_numeric_as::<f64>().expect(name),
        )
    };
    for name in ["x", "V"] {
        let ((8, all), (4, rounded)) = (read("with.h5", name), read("values.h5", name)) else {
            panic!("{name}: not in f64 and f32");
        };
        assert!(all.iter().any(|v| v.is_finite()));
        let same = |(a, b): (&f64, &f64)| f64::from(*a as f32).to_bits() == b.to_bits();
        assert!(all.iter().zip(&rounded).all(same), "{name}");
        assert_eq!(all.len(), rounded.len());
    }
    let file = rust_hdf5::H5File::open(here.join("values.h5")).expect("a result file");
    for name in ["t", "p", "u", "H", "steps"] {
        assert!(
            file.dataset(&format!("trajectories/{name}")).is_err(),
            "{name}"
        );
    }

    // What needs costates says so; a page is made of the rest.
    let fitted = costate(&here, &["value", "values.h5", "--grid", "x=0:1:3"]);
    let said = text(&fitted.stderr);
    assert_eq!(fitted.status.code(), Some(2), "{said}");
    assert!(
        said.contains("neither /trajectories of an infinite horizon with costates"),
        "{said}"
    );
    assert!(said.contains("`--values-only`"), "{said}");
    let page = costate(&here, &["report", "values.h5", "--out", "page.html"]);
    assert_eq!(page.status.code(), Some(0), "{}", text(&page.stderr));
    assert!(text(&std::fs::read(here.join("page.html")).expect("a page")).contains("phase"));
    let both = ["shoot-out", &scene, "--values-only", "--no-trajectories"];
    assert_eq!(costate(&here, &both).status.code(), Some(2));

    // Where f32 would not resolve them they are stored in f64.
    let far = r#"
        states = { x = {} }
        controls = { u = {} }
        parameters = { c = 1, o = 0 }
        dynamics = { x = "u" }
        cost = { running = "0.5*c*((x - o)^2 + u^2)" }
        equilibrium = { x = "o", u = 0 }
        region = { x = ["o - 1", "o + 1"] }
        shoot_out = { value_max = "0.4*c", spacing = 0.1, samples = 10 }
    "#;
    std::fs::write(here.join("far.toml"), far).unwrap();
    for (set, bytes) in [("o=0", [4, 4]), ("o=1e6", [8, 4]), ("c=1e45", [4, 8])] {
        let arguments = [
            "shoot-out",
            "far.toml",
            "--values-only",
            "--set",
            set,
            "--out",
            "far.h5",
        ];
        let output = costate(&here, &arguments);
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        let found = ["x", "V"].map(|name| read("far.h5", name));
        assert_eq!(found.each_ref().map(|(size, _)| *size), bytes, "{set}");
        let v = &found[1].1;
        assert!(v.iter().any(|v| *v > 0.0) && v.iter().all(|v| !v.is_infinite()));
    }
    // A terminal cost may have a constant of any size.
    let arguments = [
        "shoot-out",
        &shipped("finite_horizon"),
        "--values-only",
        "--backend",
        "cpu",
        "--out",
        "end.h5",
    ];
    let output = costate(&here, &arguments);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert_eq!(["x", "V"].map(|name| read("end.h5", name).0), [4, 8]);
}

#[test]
fn quiet_is_quiet() {
    let here = directory("quiet");
    for arguments in [
        ["run", "pendulum"],
        ["shoot-out", "finite_horizon"],
        ["check", "moore_greitzer"],
    ] {
        let mut all = vec![
            arguments[0].to_owned(),
            shipped(arguments[1]),
            "--quiet".to_owned(),
        ];
        if arguments[0] != "check" {
            all.extend(["--backend".to_owned(), "cpu".to_owned()]);
        }
        let all: Vec<&str> = all.iter().map(String::as_str).collect();
        let output = costate(&here, &all);
        assert_eq!(
            (
                output.status.code(),
                text(&output.stdout),
                text(&output.stderr)
            ),
            (Some(0), String::new(), String::new())
        );
    }
}

#[test]
fn set_changes_the_result() {
    let here = directory("set");
    let p = |set: &[&str]| {
        let scene = shipped("pendulum");
        let arguments = [&["check", &scene, "--json"], set].concat();
        let output = costate(&here, &arguments);
        let value: serde_json::Value =
            serde_json::from_slice(&output.stdout).expect("standard output is JSON");
        value["riccati"][0][0].as_f64().expect("a number")
    };
    let plain = p(&[]);
    assert_eq!(p(&["--set", "q=5.55"]), plain);
    assert!(p(&["--set", "q=8"]) > plain, "dearer states cost more");
    // An expression of an earlier parameter; the last one counts.
    assert_eq!(
        p(&["--set", "q=g-9", "--set", "q=8"]),
        p(&["--set", "q=4*2"])
    );
}

/// The double integrator with unit weights, held at x = 3 by nothing: K = (1, sqrt 3), eigenvalues
/// (-sqrt 3 +- i)/2.
#[test]
fn check_tells_the_local_gain_and_the_guards() {
    let here = directory("gain");
    let text_of = |control: &str| {
        format!(
            "states = {{ x = {{}}, v = {{}} }}\ncontrols = {{ u = {{}} }}\n\
             dynamics = {{ x = \"v\", v = \"{control}\" }}\ncost = {{ running = \"0.5*((x - 3)^2 + v^2 + u^2)\" }}\n\
             equilibrium = {{ x = 3, v = 0, u = 0 }}\nregion = {{ x = [2, 4], v = [-1, 1] }}\n\
             guards = {{ short = \"x < 5\", wide = \"2*x + v >= -1\" }}\n"
        )
    };
    for (control, sign) in [("u", 1.0), ("-u", -1.0)] {
        std::fs::write(here.join("scene.toml"), text_of(control)).expect("a file can be written");
        let output = costate(&here, &["check", "scene.toml", "--json"]);
        let value: serde_json::Value =
            serde_json::from_slice(&output.stdout).expect("standard output is JSON");
        let close = |found: &serde_json::Value, wanted: f64| {
            let found = found.as_f64().expect("a number");
            // The Riccati equation is solved to about 1e-14.
            assert!((found - wanted).abs() < 1e-12, "{found} {wanted}");
        };
        close(&value["gain"][0][0], sign);
        close(&value["gain"][0][1], sign * 3f64.sqrt());
        close(&value["closed_loop_eigenvalues"][0][0], -0.5 * 3f64.sqrt());
        assert_eq!(value["guards"][0]["name"], "short");
        assert_eq!(value["guards"][0]["strict"], true);
        // 5 - 3 and 2 * 3 + 0 + 1.
        close(&value["guards"][0]["at_equilibrium"], 2.0);
        assert_eq!(value["guards"][1]["strict"], false);
        close(&value["guards"][1]["at_equilibrium"], 7.0);
    }
    std::fs::write(here.join("scene.toml"), text_of("u")).expect("a file can be written");
    let said = text(&costate(&here, &["check", "scene.toml"]).stdout);
    for wanted in [
        "u = u_e - K (x - x_e)",
        "1.00000000    1.73205081  (u)",
        "-0.866025 - 0.500000i",
        "short: ",
        "> 0 (2.0",
        ">= 0 (7.0",
    ] {
        assert!(said.contains(wanted), "{wanted}: {said}");
    }
    // On a finite horizon there is no equilibrium: guards alone.
    let finite = text_of("u").replace("u^2)\" }", "u^2)\", terminal = \"x^2\", final_time = 1 }");
    let finite: String = finite
        .lines()
        .filter(|l| !l.starts_with("equilibrium"))
        .map(|l| format!("{l}\n"))
        .collect();
    std::fs::write(here.join("scene.toml"), finite).expect("a file can be written");
    let output = costate(&here, &["check", "scene.toml", "--json"]);
    let value: serde_json::Value =
        serde_json::from_slice(&output.stdout).expect("standard output is JSON");
    assert!(
        value["gain"].is_null() && value["guards"][0]["at_equilibrium"].is_null(),
        "{value}"
    );
}

#[test]
fn gaps_left_by_the_cap_are_told() {
    let here = directory("cap");
    let source = std::fs::read_to_string(shipped("pendulum")).expect("the scene is there");
    std::fs::write(
        here.join("few.toml"),
        source.replace("samples = 100 ", "max_seeds = 150\nsamples = 100 "),
    )
    .expect("a file can be written");
    let output = costate(&here, &["run", "few.toml", "--backend", "cpu"]);
    let said = text(&output.stdout);
    assert_eq!(
        output.status.code(),
        Some(0),
        "a run with gaps is done: {}",
        text(&output.stderr)
    );
    assert!(
        said.contains("NOT fully covered") && said.contains("max_seeds = 150"),
        "{said}"
    );
}

#[test]
fn an_output_that_cannot_be_made_is_refused() {
    let here = directory("blocked");
    std::fs::write(here.join("file"), "in the way").expect("a file can be written");
    let target = here.join("file").join("result.h5").display().to_string();
    let output = costate(
        &here,
        &[
            "run",
            &shipped("manufactured"),
            "--backend",
            "cpu",
            "--out",
            &target,
        ],
    );
    assert_eq!(output.status.code(), Some(2), "{}", text(&output.stderr));
    assert!(
        text(&output.stderr).contains("result.h5") || text(&output.stderr).contains("file"),
        "{}",
        text(&output.stderr)
    );
    assert_eq!(contents(&here), [here.join("file")]);
    assert_eq!(
        std::fs::read_to_string(here.join("file")).expect("it is still there"),
        "in the way"
    );
}

/// Killed while it writes: nothing under the result's name, and an older result as it was.
#[test]
fn a_killed_run_leaves_no_result() {
    for older in [None, Some("an older result")] {
        let here = directory(if older.is_some() {
            "killed-older"
        } else {
            "killed"
        });
        let target = here.join("result.h5");
        if let Some(older) = older {
            std::fs::write(&target, older).expect("a file can be written");
        }
        let before = contents(&here).len();
        let scene = shipped("moore_greitzer");
        // So tight that it takes far longer than this test waits.
        let arguments = [
            "run",
            &scene,
            "--quiet",
            "--backend",
            "cpu",
            "--precision",
            "f64",
            "--rtol",
            "1e-13",
            "--out",
            "result.h5",
        ];
        let mut child = command(&here, &arguments)
            .spawn()
            .expect("the program starts");
        let start = Instant::now();
        // Its file under another name has something in it once trajectories are written.
        let writing = || {
            let files = contents(&here);
            files.len() > before
                && files
                    .iter()
                    .any(|f| *f != target && f.metadata().is_ok_and(|m| m.len() > 100_000))
        };
        while !writing() {
            assert!(
                child.try_wait().expect("a child can be asked").is_none(),
                "the run ended before it was seen writing"
            );
            assert!(
                start.elapsed() < Duration::from_secs(60),
                "nothing is written: {:?}",
                contents(&here)
            );
            std::thread::sleep(Duration::from_millis(2));
        }
        child.kill().expect("a child can be killed");
        assert!(!child.wait().expect("a child can be waited for").success());
        match older {
            None => assert!(!target.exists(), "{:?}", contents(&here)),
            Some(older) => assert_eq!(
                std::fs::read_to_string(&target).expect("it is still there"),
                older
            ),
        }
        // And what is left does not stand in the way of another run.
        let quick = shipped("manufactured");
        let output = costate(
            &here,
            &[
                "run",
                &quick,
                "--quiet",
                "--backend",
                "cpu",
                "--out",
                "result.h5",
            ],
        );
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        assert!(
            std::fs::read(&target)
                .expect("it is there")
                .starts_with(b"\x89HDF\r\n\x1a\n")
        );
    }
}

#[test]
fn all_shipped_scenes_pass_check() {
    let here = directory("check");
    let folder = Path::new(crate::ROOT).join("scenarios");
    let scenes = contents(&folder).into_iter();
    let mut count = 0;
    // One of the hard scenes is there to be refused (tests/estimates.rs); the other is a file of
    // weights.
    const NO_SCENES: [&str; 2] = ["peak_infinite_horizon.toml", "hardt_network.toml"];
    for path in scenes.filter(|p| {
        p.extension().is_some_and(|e| e == "toml") && !NO_SCENES.iter().any(|n| p.ends_with(n))
    }) {
        let path = path.display().to_string();
        let output = costate(&here, &["check", &path]);
        assert_eq!(
            output.status.code(),
            Some(0),
            "{path}: {}",
            text(&output.stderr)
        );
        let said = text(&output.stdout);
        for part in [
            "Hamiltonian",
            "Optimal control",
            "State equations",
            "Adjoint equations",
        ] {
            assert!(said.contains(part), "{path}: no `{part}` in {said}");
        }
        count += 1;
    }
    assert!(count >= 20, "{count} scenes");
    assert_eq!(
        contents(&here),
        Vec::<PathBuf>::new(),
        "checking writes nothing"
    );
}
