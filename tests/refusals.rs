//! What the program refuses instead of crashing, hanging or answering wrongly: found by trying to break it.

use std::path::PathBuf;
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
    let each = |f: &dyn Fn(&str) -> String| names.iter().map(|n| f(n)).collect::<Vec<_>>().join(", ");
    let squares = names.iter().map(|n| format!("{n}^2")).collect::<Vec<_>>().join(" + ");
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
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let (done, _) = run("pipe", SCENE, Some("pipe.h5"));
    assert_eq!(done.status.code(), Some(1));
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
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
}

#[test]
fn equations_too_long_for_a_shader() {
    let folder = folder("long");
    let sum: Vec<String> = (0..3000)
        .map(|i| format!("{}*sin({}*x)", 1e-6 * f64::from(i), 1.0 + f64::from(i) / 64.0))
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
    SCENE.replace("-x + u", "u").replace("0.5*(x^2 + v^2 + u^2)", cost)
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
        ("rounding", "(x + 1 - cos(0))^2 + (v + 0.1 + 0.2 - 0.3)^2 + u^2"),
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
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
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
    assert!(!text.contains(WORDS) && json["coverage"] == "covered", "{text}");
    let (done, capped) = run(
        "capped",
        &fine.replace("samples = 10", "samples = 10, max_seeds = 40"),
        None,
    );
    assert!(String::from_utf8_lossy(&done.stdout).contains("NOT fully covered"));
    let (text, json) = value(&capped, "x=0.5,v=0.5");
    assert!(text.contains(WORDS) && json["coverage"] == "uncovered", "{text}");
    assert!(
        json["coverage_note"].as_str().unwrap().contains("gaps remain"),
        "{json}"
    );
    // Up to where its neighbours are near each other the same sweep has covered its fronts.
    let (text, json) = value(&capped, "x=0.15,v=0.1");
    assert!(!text.contains(WORDS) && json["coverage"] == "covered", "{text}");
}

#[test]
fn a_solved_state_is_known_to_its_own_error() {
    let scene = format!(
        "{}\nmap = {{ resolution = 5 }}\n",
        SCENE.replace("max = 1.0", "max = 1.0, max_seeds = 20")
    );
    let (done, out) = run("node", &scene, None);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let (text, json) = value(&out, "x=0.5,v=-1");
    // V = s'Ps/2 of the linear-quadratic problem: P11 = sqrt(2) P22, P12 = sqrt(2) - 1, P22 = sqrt(2 sqrt(2) - 1).
    let (p12, p22) = (2f64.sqrt() - 1.0, (2.0 * 2f64.sqrt() - 1.0).sqrt());
    let exact = 0.5 * (2f64.sqrt() * p22 * 0.25 - p12 + p22);
    let (v, error) = (json["V"].as_f64().unwrap(), json["V_error"].as_f64().unwrap());
    assert!((v - exact).abs() <= 1e-9 * exact, "{v}, not {exact}");
    assert!(error <= 1e-8, "{error}: {text}");
    assert_eq!(json["coverage"], "searched", "{text}");
}
