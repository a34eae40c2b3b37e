//! What the program refuses instead of crashing, hanging or answering wrongly: found by trying to
//! break it.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const SCENE: &str = r#"
states = { x = {}, v = {} }
controls = { u = {} }
dynamics = { x = "v", v = "-x + u" }
cost = { running = "0.5*(x^2 + v^2 + u^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-1, 1], v = [-1, 1] }
shoot_out = { value_max = 1.0, spacing = 0.2, samples = 10 }
"#;

fn folder(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("costate-refusals-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&path).unwrap();
    path
}

fn run(name: &str, scene: &str, out: Option<&str>) -> (Output, PathBuf) {
    let folder = folder(name);
    let file = folder.join("scene.toml");
    std::fs::write(&file, scene).unwrap();
    let out = folder.join(out.unwrap_or("out.h5"));
    let done = Command::new(env!("CARGO_BIN_EXE_costate"))
        .args(["run", "--backend", "cpu"])
        .arg(&file)
        .arg("--out")
        .arg(&out)
        .output()
        .unwrap();
    (done, out)
}

fn refused(name: &str, scene: &str, status: i32, words: &str) {
    let (done, out) = run(name, scene, None);
    let text = String::from_utf8_lossy(&done.stderr).replace('\n', " ");
    assert_eq!(done.status.code(), Some(status), "{text}");
    assert!(text.contains(words), "{text}");
    assert!(!out.exists(), "{name}: a result was written");
}

#[test]
fn samples_that_no_memory_holds() {
    refused(
        "samples",
        &SCENE.replace("samples = 10", "samples = 100000000"),
        2,
        "MiB",
    );
}

#[test]
fn a_guard_that_no_seed_is_inside_of() {
    let scene = format!("guards = {{ never = \"x^2 + v^2 < 1e-30\" }}\n{SCENE}");
    refused("guard", &scene, 1, "nothing was swept");
}

#[test]
fn more_states_than_can_be_triangulated() {
    let names: Vec<String> = (0..12).map(|i| format!("x{i}")).collect();
    let each =
        |f: &dyn Fn(&str) -> String| names.iter().map(|n| f(n)).collect::<Vec<_>>().join(", ");
    let squares = names
        .iter()
        .map(|n| format!("{n}^2"))
        .collect::<Vec<_>>()
        .join(" + ");
    let scene = format!(
        "states = {{ {} }}\ncontrols = {{ u = {{}} }}\ndynamics = {{ {} }}\ncost = {{ running = \"{squares} + u^2\" }}\n\
         equilibrium = {{ {}, u = 0 }}\nregion = {{ {} }}\nshoot_out = {{ value_max = 1.0 }}\n",
        each(&|n| format!("{n} = {{}}")),
        each(&|n| format!("{n} = \"-{n} + u\"")),
        each(&|n| format!("{n} = 0")),
        each(&|n| format!("{n} = [-1, 1]")),
    );
    refused("states", &scene, 2, "12 states");
}

#[test]
fn a_cap_below_the_first_seeds_is_kept() {
    let (done, out) = run(
        "cap",
        &SCENE.replace("samples = 10", "samples = 10, max_seeds = 5"),
        None,
    );
    let text = String::from_utf8_lossy(&done.stdout).into_owned();
    assert!(done.status.success() && out.exists());
    assert!(
        text.contains("5 trajectories") && text.contains("NOT fully covered"),
        "{text}"
    );
}

#[test]
fn failed_trajectories_are_not_coverage() {
    let scene = format!("{SCENE}integrator = {{ max_steps = 1 }}\n");
    let (done, _) = run("steps", &scene, None);
    let text = String::from_utf8_lossy(&done.stdout).into_owned();
    assert!(
        text.contains("step limit") && text.contains("only as far as trajectories go"),
        "{text}"
    );
}

#[cfg(unix)]
#[test]
fn a_pipe_is_not_replaced() {
    let pipe = folder("pipe").join("pipe.h5");
    let _ = std::fs::remove_file(&pipe);
    assert!(
        Command::new("mkfifo")
            .arg(&pipe)
            .status()
            .unwrap()
            .success()
    );
    let (done, _) = run("pipe", SCENE, Some("pipe.h5"));
    assert_eq!(done.status.code(), Some(2));
    assert!(pipe.exists() && !pipe.is_file(), "the pipe was replaced");
}

#[cfg(unix)]
#[test]
fn arguments_need_not_be_unicode() {
    use std::os::unix::ffi::OsStrExt;
    let folder = folder("bytes");
    std::fs::write(folder.join("scene.toml"), SCENE).unwrap();
    let done = Command::new(env!("CARGO_BIN_EXE_costate"))
        .current_dir(&folder)
        .args(["run", "--backend", "cpu", "scene.toml", "--out"])
        .arg(std::ffi::OsStr::from_bytes(b"b\xff.h5"))
        .output()
        .unwrap();
    assert!(
        done.status.success(),
        "{}",
        String::from_utf8_lossy(&done.stderr)
    );
}

#[test]
fn equations_too_long_for_a_shader() {
    let folder = folder("long");
    let sum: Vec<String> = (0..3000)
        .map(|i| {
            format!(
                "{}*sin({}*x)",
                1e-6 * f64::from(i),
                1.0 + f64::from(i) / 64.0
            )
        })
        .collect();
    let scene = SCENE.replace("-x + u", &format!("-x + u + {}", sum.join(" + ")));
    std::fs::write(folder.join("scene.toml"), scene).unwrap();
    let done = Command::new(env!("CARGO_BIN_EXE_costate"))
        .current_dir(&folder)
        .args(["run", "--backend", "gpu", "scene.toml"])
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&done.stderr).replace('\n', " ");
    assert_eq!(done.status.code(), Some(1), "{text}");
    assert!(text.contains("operations"), "{text}");
}

/// Standard error of a refused run in one line, without the frame about it.
fn words_of(name: &str, scene: &str) -> String {
    let (done, out) = run(name, scene, None);
    let text = String::from_utf8_lossy(&done.stderr).replace(['\n', '│', '·'], " ");
    let text = text.split_whitespace().collect::<Vec<_>>().join(" ");
    assert_eq!(done.status.code(), Some(2), "{name}: {text}");
    assert!(!out.exists(), "{name}: a result was written");
    text
}

fn with_cost(cost: &str) -> String {
    SCENE
        .replace("-x + u", "u")
        .replace("0.5*(x^2 + v^2 + u^2)", cost)
}

#[test]
fn a_cost_that_is_not_stationary_at_the_equilibrium() {
    let text = words_of("slope", &with_cost("3*x + x^2 + v^2 + u^2"));
    for words in [
        "running cost is not stationary",
        "dL/dx is 3.000000e0",
        "scene.toml:5:20",
        "(x - 0)^2",
    ] {
        assert!(text.contains(words), "no `{words}` in: {text}");
    }
    // A cross term with a control that is at its equilibrium has no slope, and rounding is none.
    for (name, cost) in [
        ("cross", "x^2 + v^2 + u^2 + x*u"),
        (
            "rounding",
            "(x + 1 - cos(0))^2 + (v + 0.1 + 0.2 - 0.3)^2 + u^2",
        ),
    ] {
        let (done, _) = run(name, &with_cost(cost), None);
        assert!(
            done.status.success(),
            "{name}: {}",
            String::from_utf8_lossy(&done.stderr)
        );
    }
}

#[test]
fn a_kink_at_the_equilibrium() {
    let text = words_of("kink", &with_cost("abs(x) + x^2 + v^2 + u^2"));
    assert!(
        text.contains("the running cost has a kink at the equilibrium: `abs(x)`"),
        "{text}"
    );
    // Second derivatives of the cost jump, though the first do not.
    let text = words_of("bend", &with_cost("x*abs(x) + 2*x^2 + v^2 + u^2"));
    assert!(text.contains("the running cost has a kink"), "{text}");
    let text = words_of("product", &with_cost("abs(x)*abs(v) + x^2 + v^2 + u^2"));
    assert!(text.contains("the running cost has a kink"), "{text}");
    let friction = SCENE.replace("-x + u", "-x + u - 0.1*abs(v)");
    let text = words_of("friction", &friction);
    assert!(
        text.contains("the dynamics of `v` have a kink at the equilibrium: `abs(v)`"),
        "{text}"
    );
    // Quadratic drag is smooth enough, and so is a kink elsewhere.
    for (name, force) in [
        ("drag", "-x + u - v*abs(v)"),
        ("elsewhere", "-x + u - 0.1*(abs(v - 0.5) - 0.5)"),
    ] {
        let (done, _) = run(name, &SCENE.replace("-x + u", force), None);
        assert!(
            done.status.success(),
            "{name}: {}",
            String::from_utf8_lossy(&done.stderr)
        );
    }
}

#[test]
fn why_an_eigenvalue_is_on_the_axis() {
    for (name, cost, words) in [
        (
            "negative",
            "-x^2 + v^2 + u^2",
            "the running cost curves down there along (x: ",
        ),
        ("flat", "x^4 + v^4 + u^2", "the running cost is flat there"),
        (
            "unseen",
            "v^2 + u^2",
            "its mode, along (x: 1.00), neither decays nor is seen by the cost",
        ),
    ] {
        let text = words_of(name, &with_cost(cost));
        assert!(
            text.contains("on the imaginary axis") && text.contains(words),
            "{name}: {text}"
        );
    }
}

/// `costate value` at a state, as text and as JSON.
fn value(file: &std::path::Path, at: &str) -> (String, serde_json::Value) {
    let ask = |more: &[&str]| {
        let done = Command::new(env!("CARGO_BIN_EXE_costate"))
            .arg("value")
            .arg(file)
            .args(["--at", at])
            .args(more)
            .output()
            .unwrap();
        assert!(
            done.status.success(),
            "{}",
            String::from_utf8_lossy(&done.stderr)
        );
        String::from_utf8_lossy(&done.stdout).into_owned()
    };
    let json: serde_json::Value = serde_json::from_str(&ask(&["--json"])).unwrap();
    (ask(&[]), json[0]["value"].clone())
}

#[test]
fn what_uncovered_fronts_cannot_show_is_said() {
    const WORDS: &str = "a cheaper sheet may be missing";
    // The local solution of a linear-quadratic problem would hold everywhere.
    let fine = SCENE.replace("spacing = 0.2", "spacing = 0.15, seed_value = 1e-3");
    let (done, covered) = run("covered", &fine, None);
    assert!(String::from_utf8_lossy(&done.stdout).contains("fronts covered:"));
    let (text, json) = value(&covered, "x=0.5,v=0.5");
    assert!(
        !text.contains(WORDS) && json["coverage"] == "covered",
        "{text}"
    );
    let (done, capped) = run(
        "capped",
        &fine.replace("samples = 10", "samples = 10, max_seeds = 40"),
        None,
    );
    assert!(String::from_utf8_lossy(&done.stdout).contains("NOT fully covered"));
    let (text, json) = value(&capped, "x=0.5,v=0.5");
    assert!(
        text.contains(WORDS) && json["coverage"] == "uncovered",
        "{text}"
    );
    assert!(
        json["coverage_note"]
            .as_str()
            .unwrap()
            .contains("gaps remain"),
        "{json}"
    );
    // Fronts without gaps tell nothing of what lies between two that are far apart.
    let far = fine.replace("value_max = 1.0", "value_max = 3.0");
    let (done, far) = run("far", &far.replace("samples = 10", "samples = 2"), None);
    assert!(String::from_utf8_lossy(&done.stdout).contains("fronts NOT covered: trajectories go"));
    let (text, json) = value(&far, "x=0.5,v=0.5");
    assert!(
        text.contains(WORDS) && json["coverage"] == "uncovered",
        "{text}"
    );
    // On a finite horizon what ends outside the region is not swept.
    const FINITE: &str = r#"
states = { x = {} }
controls = { u = {} }
dynamics = { x = "u" }
cost = { running = "0.5*u^2", terminal = "cos(3*x)", final_time = 0.5 }
region = { x = [-1, 1] }
shoot_out = { spacing = 0.05, samples = 12 }
homotopy = { x = [-0.5, 0.5, 3] }
"#;
    let (done, finite) = run("finite", FINITE, None);
    assert!(String::from_utf8_lossy(&done.stdout).contains("fronts covered:"));
    let (text, json) = value(&finite, "x=0.5");
    assert!(
        text.contains("end in the region alone") && json["coverage"] == "searched",
        "{text}"
    );
    // Up to where its neighbours are near each other the same sweep has covered its fronts.
    let (text, json) = value(&capped, "x=0.15,v=0.1");
    assert!(
        !text.contains(WORDS) && json["coverage"] == "covered",
        "{text}"
    );
}

#[test]
fn a_solved_state_is_known_to_its_own_error() {
    let scene = format!(
        "{}\nmap = {{ resolution = 5 }}\n",
        SCENE.replace("max = 1.0", "max = 1.0, max_seeds = 20")
    );
    let (done, out) = run("node", &scene, None);
    assert!(
        done.status.success(),
        "{}",
        String::from_utf8_lossy(&done.stderr)
    );
    let (text, json) = value(&out, "x=0.5,v=-1");
    // V = s'Ps/2 of the linear-quadratic problem: P11 = sqrt(2) P22, P12 = sqrt(2) - 1, P22 =
    // sqrt(2 sqrt(2) - 1).
    let (p12, p22) = (2f64.sqrt() - 1.0, (2.0 * 2f64.sqrt() - 1.0).sqrt());
    let exact = 0.5 * (2f64.sqrt() * p22 * 0.25 - p12 + p22);
    let (v, error) = (
        json["V"].as_f64().unwrap(),
        json["V_error"].as_f64().unwrap(),
    );
    assert!((v - exact).abs() <= 1e-9 * exact, "{v}, not {exact}");
    assert!(error <= 1e-8, "{error}: {text}");
    assert_eq!(json["coverage"], "searched", "{text}");
}

/// The program in a folder, with a result file `swept.h5` there.
fn in_folder(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_costate"))
        .current_dir(folder)
        .args(arguments)
        .output()
        .unwrap()
}

fn swept(name: &str) -> PathBuf {
    let (done, out) = run(name, SCENE, Some("swept.h5"));
    assert!(
        done.status.success(),
        "{}",
        String::from_utf8_lossy(&done.stderr)
    );
    let folder = out.parent().unwrap().to_owned();
    std::fs::write(folder.join("points.csv"), "x,v\n0.1,0.2\n").unwrap();
    folder
}

/// What is in a folder, hidden files included.
fn entries(folder: &Path) -> Vec<String> {
    let mut all: Vec<String> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
        .collect();
    all.sort();
    all
}

#[test]
fn what_cannot_be_written_is_said_before_the_work() {
    let folder = swept("out");
    for kind in ["h5", "csv", "h", "html"] {
        let _ = std::fs::create_dir(folder.join(format!("taken.{kind}")));
    }
    let before = entries(&folder);
    let solve = [
        "solve",
        "scene.toml",
        "--points",
        "points.csv",
        "--backend",
        "cpu",
    ];
    let at = ["value", "swept.h5", "--at", "x=0.1"];
    let with = |command: &[&'static str], more: &[&'static str]| [command, more].concat();
    let taken = "it is a directory; name a file in it";
    let cases: [(Vec<&str>, &str); 19] = [
        (
            with(&solve, &["--out", "points.csv/a.h5"]),
            "cannot create the directory points.csv",
        ),
        (
            with(&at, &["--out", "points.csv/deep/a.csv"]),
            "cannot create the directory points.csv/deep",
        ),
        (
            with(&solve, &["--time-limit", "-1"]),
            "seconds, above 0 and at most 1e6",
        ),
        (with(&solve, &["--out", "taken.h5"]), taken),
        (with(&solve, &["--out", "taken.csv"]), taken),
        (with(&at, &["--out", "taken.h5"]), taken),
        (with(&at, &["--out", "taken.csv"]), taken),
        (
            vec!["export", "scene.toml", "--local", "--out", "taken.h"],
            taken,
        ),
        (vec!["report", "swept.h5", "--out", "taken.html"], taken),
        (
            with(&solve, &["--out", "answers.pdf"]),
            "name it .h5; or a table is CSV; name it .csv",
        ),
        (with(&at, &["--out", "answers.txt"]), "name it .csv"),
        (
            vec!["run", "scene.toml", "--out", "answers.csv"],
            "a result file is HDF5; name it .h5",
        ),
        (
            vec!["report", "swept.h5", "--out", "page.pdf"],
            "name it .html",
        ),
        (
            with(&at, &["--adapter", "any"]),
            "--adapter any: the CPU is asked for",
        ),
        (
            with(&solve, &["--adapter", "any"]),
            "--adapter any: the CPU is asked for",
        ),
        (
            vec!["value", "taken.h5", "--at", "x=0.1"],
            "taken.h5 is a directory",
        ),
        (vec!["check-least", "taken.h5"], "taken.h5 is a directory"),
        (vec!["report", "taken.h5"], "taken.h5 is a directory"),
        (
            vec!["solve", "scene.toml", "--points", "taken.csv"],
            "cannot read taken.csv",
        ),
    ];
    for (arguments, words) in cases {
        let done = in_folder(&folder, &arguments);
        let text = String::from_utf8_lossy(&done.stderr);
        assert_eq!(done.status.code(), Some(2), "{arguments:?}: {text}");
        assert!(
            text.contains(words),
            "{arguments:?}: no `{words}` in {text}"
        );
        assert!(
            done.stdout.is_empty() && entries(&folder) == before,
            "{arguments:?}"
        );
    }
    // A directory that is not there is made, whatever is written.
    for out in ["new/deep/a.h5", "new/table/a.csv"] {
        let done = in_folder(&folder, &with(&at, &["--out", out]));
        assert!(done.status.success() && folder.join(out).is_file(), "{out}");
    }
}

/// A device that takes no more, for the result as for what is printed.
#[cfg(unix)]
#[test]
fn a_full_disk_leaves_nothing() {
    let folder = swept("full");
    let before = entries(&folder);
    for out in ["grid.h5", "grid.csv"] {
        let command = format!(
            "ulimit -f 8; exec '{}' value swept.h5 --grid x=-0.5:0.5:150,v=-0.5:0.5:150 --no-errors --out {out}",
            env!("CARGO_BIN_EXE_costate")
        );
        let done = Command::new("bash")
            .current_dir(&folder)
            .args(["-c", &command])
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&done.stderr);
        assert_eq!(done.status.code(), Some(1), "{text}");
        assert!(
            text.contains(&format!("cannot write to {out}: ")) && text.contains("os error"),
            "{text}"
        );
        assert_eq!(entries(&folder), before);
    }
    if Path::new("/dev/full").exists() {
        let full = std::fs::OpenOptions::new()
            .write(true)
            .open("/dev/full")
            .unwrap();
        let done = Command::new(env!("CARGO_BIN_EXE_costate"))
            .current_dir(&folder)
            .args(["value", "swept.h5", "--at", "x=0.1"])
            .stdout(full)
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&done.stderr);
        assert_eq!(done.status.code(), Some(1));
        assert!(
            text.contains("standard output") && text.contains("os error 28"),
            "{text}"
        );
    }
}

/// A run that no budget ends, in a folder of its own with an older result.
#[cfg(unix)]
fn endless(name: &str) -> (PathBuf, std::process::Child) {
    endless_to(name, "homotopy", "")
}

/// The same with its result in a folder (`""` or `"made/"`) that is not there yet.
#[cfg(unix)]
fn endless_to(name: &str, command: &str, place: &str) -> (PathBuf, std::process::Child) {
    use std::time::{Duration, Instant};
    let folder = folder(name);
    let scene =
        format!("{SCENE}\n[map]\nerror = 1e-8\nerror_max = 1.0\nfloor = 1e-9\ncheck = 200\n");
    let scene = scene.replace("-x + u", "-sin(9*x) + v^3 + u");
    std::fs::write(folder.join("scene.toml"), scene).unwrap();
    std::fs::write(folder.join("out.h5"), "older").unwrap();
    let mut child = Command::new(env!("CARGO_BIN_EXE_costate"))
        .current_dir(&folder)
        .args([command, "--backend", "cpu", "--quiet"])
        .args(["scene.toml", "--out", &format!("{place}out.h5")])
        .spawn()
        .unwrap();
    let began = Instant::now();
    let hidden = |name: &String| name.starts_with(".out.h5.");
    let results = folder.join(place);
    while !results.is_dir() || !entries(&results).iter().any(hidden) {
        let waited = began.elapsed() < Duration::from_secs(60);
        assert!(waited, "no hidden file was made");
        let ended = child.try_wait().unwrap();
        assert!(ended.is_none(), "it ended by itself");
        std::thread::sleep(Duration::from_millis(5));
    }
    (folder, child)
}

#[cfg(unix)]
fn signal(child: &std::process::Child, name: &str) {
    let sent = Command::new("kill")
        .args(["-s", name, &child.id().to_string()])
        .status();
    assert!(sent.unwrap().success());
}

/// Signals that end at once leave the older file and nothing else, and whoever waits sees the
/// signal.
#[cfg(unix)]
#[test]
fn a_signal_leaves_no_hidden_file() {
    use std::os::unix::process::ExitStatusExt;
    for (names, number) in [
        // None that nohup, or a shell's background, makes a process ignore, as it then should.
        (["ALRM", "ALRM"], 14),
        (["TERM", "TERM"], 15),
        (["USR1", "TERM"], 15),
    ] {
        let (folder, mut child) = endless("signal");
        signal(&child, names[0]);
        if names[0] != "ALRM" {
            std::thread::sleep(std::time::Duration::from_millis(20));
            // It may have ended by the first one.
            if child.try_wait().unwrap().is_none() {
                signal(&child, names[1]);
            }
        }
        let status = child.wait().unwrap();
        let hidden = |name: &String| name.starts_with('.');
        let there = entries(&folder);
        assert!(!there.iter().any(hidden), "{names:?}: {there:?}");
        assert_eq!(std::fs::read(folder.join("out.h5")).unwrap(), b"older");
        // The first one may have been enough, or the second one late.
        let stopped = folder.join("out_stopped.h5");
        if stopped.exists() {
            costate::Stored::open(&stopped).unwrap();
            std::fs::remove_file(&stopped).unwrap();
        } else {
            assert_eq!(status.signal(), Some(number), "{names:?}: {status}");
        }
        assert_eq!(entries(&folder), ["out.h5", "scene.toml"], "{names:?}");
    }
}

/// A folder that was made for the result goes with it, whatever else is written there.
#[cfg(unix)]
#[test]
fn a_signal_leaves_no_empty_folder() {
    use std::os::unix::process::ExitStatusExt;
    let (folder, mut child) = endless_to("folder", "run", "made/");
    // Not a hang-up, which nohup makes it ignore.
    signal(&child, "ALRM");
    assert_eq!(child.wait().unwrap().signal(), Some(14));
    assert_eq!(entries(&folder), ["out.h5", "scene.toml"]);
}

/// The first interrupt asks: what is done is written, beside an older result.
#[cfg(unix)]
#[test]
fn an_interrupt_keeps_what_is_done() {
    for name in ["TERM", "USR1"] {
        let (folder, mut child) = endless("interrupt");
        signal(&child, name);
        let status = child.wait().unwrap();
        assert_eq!(status.code(), Some(75), "{name}: {status}");
        assert_eq!(
            entries(&folder),
            ["out.h5", "out_stopped.h5", "scene.toml"],
            "{name}"
        );
        assert_eq!(std::fs::read(folder.join("out.h5")).unwrap(), b"older");
        let stored = costate::Stored::open(folder.join("out_stopped.h5")).unwrap();
        assert!(stored.run_summary().unwrap().unwrap().stopped);
        std::fs::remove_file(folder.join("out_stopped.h5")).unwrap();
    }
}

#[test]
fn a_time_limit_ends_a_run() {
    let folder = folder("limit");
    let scene = format!("{SCENE}\n[map]\nresolution = 60\n").replace("-x + u", "-sin(9*x) + u");
    std::fs::write(folder.join("scene.toml"), scene).unwrap();
    let limited = |arguments: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_costate"))
            .current_dir(&folder)
            .args(arguments)
            .args(["--time-limit", "1e-3", "--backend", "cpu"])
            .output()
            .unwrap()
    };
    let done = limited(&["homotopy", "scene.toml", "--out", "out.h5"]);
    let text = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.code(), Some(75), "{text}");
    assert!(
        text.contains("ended by --time-limit 0.001 before all was done; out.h5 has"),
        "{text}"
    );
    crate::common_commands::in_schema(&folder.join("out.h5"));
    assert_page_says(&folder, "out.h5", "before everything was swept and solved");
    // As a table too.
    std::fs::write(folder.join("points.csv"), "x,v\n0.5,0.5\n-0.5,0.25\n").unwrap();
    let points = ["solve", "scene.toml", "--points", "points.csv"];
    let done = limited(&[points.as_slice(), &["--out", "out.csv"]].concat());
    assert_eq!(done.status.code(), Some(75));
    let table = std::fs::read_to_string(folder.join("out.csv")).unwrap();
    assert_eq!(table.matches("out_of_time").count(), 2, "{table}");
    // Of a search for a level a part shows nothing.
    let game = Path::new(crate::ROOT).join("scenarios/folding_game.toml");
    let done = limited(&["attenuation", game.to_str().unwrap(), "--out", "none.h5"]);
    assert_eq!(done.status.code(), Some(75));
    assert!(!folder.join("none.h5").exists());
}

/// A run that has solved everything, and is ended in what comes after: its file says so, and an
/// older one stays.
#[test]
fn a_time_limit_ends_what_follows_a_run() {
    let text = |name: &str| {
        let path = Path::new(crate::ROOT).join("scenarios").join(name);
        std::fs::read_to_string(path).unwrap()
    };
    let swept = SCENE
        .replace("-x + u", "-sin(9*x) + u")
        .replace("spacing = 0.2", "spacing = 0.02");
    let swept = swept.replace("samples = 10", "samples = 40");
    let fit = "feedback = { fit = \"u\", hidden = [12], iterations = 1000000, patience = 1000000 }";
    let level = text("linear_game.toml").replace(
        "[attenuation]",
        "[attenuation]\ntolerance = 1e-6\nstates = { x = [-1, 1, 60], v = [-1, 1, 60] }",
    );
    let level = level.replace("disturbances = 10000", "disturbances = 4");
    let endless = [("fit", format!("{swept}\n{fit}\n")), ("level", level)];
    for (name, scene) in endless {
        let folder = folder(&format!("limit-{name}"));
        std::fs::write(folder.join("scene.toml"), scene).unwrap();
        std::fs::write(folder.join("out.h5"), "older").unwrap();
        let done = Command::new(env!("CARGO_BIN_EXE_costate"))
            .current_dir(&folder)
            .args(["run", "scene.toml", "--out", "out.h5", "--backend", "cpu"])
            .args(["--time-limit", "6", "--json"])
            .output()
            .unwrap();
        let errors = String::from_utf8_lossy(&done.stderr);
        assert_eq!(done.status.code(), Some(75), "{name}: {errors}");
        let summary: serde_json::Value = serde_json::from_slice(&done.stdout).unwrap();
        let marks = ["stopped", "laws_stopped"].map(|mark| summary[mark].clone());
        assert_eq!(marks, [false, true], "{name}: {errors}");
        assert_eq!(std::fs::read(folder.join("out.h5")).unwrap(), b"older");
        let beside = costate::Stored::open(folder.join("out_stopped.h5")).unwrap();
        let summary = beside.run_summary().unwrap().unwrap();
        assert!(summary.laws_stopped && !summary.stopped, "{name}");
        assert!(summary.file.ends_with("out_stopped.h5"), "{name}");
        let left: Vec<String> = entries(&folder);
        assert!(!left.iter().any(|n| n.starts_with('.')), "{left:?}");
        assert_page_says(&folder, "out_stopped.h5", "after everything was solved");
    }
}

/// The report of a result file says how far its run came.
fn assert_page_says(folder: &Path, file: &str, how_far: &str) {
    let done = in_folder(folder, &["report", file, "--out", "page.html"]);
    let errors = String::from_utf8_lossy(&done.stderr);
    assert_eq!(done.status.code(), Some(0), "{errors}");
    let page = std::fs::read_to_string(folder.join("page.html")).unwrap();
    let told = format!("<dt>Ended early</dt><dd>{how_far}");
    assert!(page.contains(&told), "{file}: no {told} on its page");
}

#[test]
fn numbers_of_hundreds_of_digits_are_printed_with_exponents() {
    let folder = swept("digits");
    let (large, larger) = ("9".repeat(300), "9".repeat(320));
    let said = |arguments: &[&str], status: i32| {
        let done = in_folder(&folder, arguments);
        assert_eq!(
            done.status.code(),
            Some(status),
            "{}",
            String::from_utf8_lossy(&done.stderr)
        );
        let text = [done.stdout, done.stderr].concat();
        String::from_utf8_lossy(&text).into_owned()
    };
    let outside = said(&["value", "swept.h5", "--at", &format!("x={large}")], 0);
    assert!(
        outside.contains("x = 1e300 lies outside the region of the map, from -1 to 1"),
        "{outside}"
    );
    let table = said(
        &["value", "swept.h5", "--grid", &format!("x=0:{large}:2")],
        0,
    );
    assert!(table.contains("\n1e300,0,,"), "{table}");
    let small = said(&["value", "swept.h5", "--at", "v=1e-300"], 0);
    assert!(small.contains("v = 1e-300"), "{small}");
    let infinite = said(&["value", "swept.h5", "--at", &format!("x={larger}")], 2);
    assert!(infinite.contains("is not a finite number"), "{infinite}");
    std::fs::write(folder.join("large.csv"), format!("x,v\n{larger},0\n")).unwrap();
    let infinite_too = said(&["value", "swept.h5", "--points", "large.csv"], 2);
    assert!(
        infinite_too.contains("line 2, column `x`"),
        "{infinite_too}"
    );
    for text in [outside, table, small, infinite, infinite_too] {
        assert!(text.lines().all(|line| line.len() < 250), "{text}");
    }
}
