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
