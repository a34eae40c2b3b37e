//! `costate check-least` and `--grid-guesses`: V on a grid as a referee of solved states and as a
//! source of guesses.

use crate::common_oracles;
use crate::common_values;

use common_oracles::derive;
use common_values::{parse, scene};
use costate::backend::cpu::Cpu;
use costate::low_level::hdf5::ResultFile;
use costate::low_level::model::{Model, Variable};
use costate::low_level::result::{Axis, RunRecord, TrajectorySchema};
use costate::low_level::sweep::Choices;
use costate::low_level::value::{Answers, solve_states};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::SystemTime;

/// Swing-up of a pendulum: the states below have two solutions and more.
const SWING: &str = r#"
states = { x = { period = "2*pi" }, v = {} }
controls = { u = {} }
dynamics = { x = "v", v = "sin(x) + u" }
cost = { running = "1 - cos(x) + 0.5*(0.1*v^2 + 6*u^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = ["-pi", "pi"], v = [-3, 3] }
"#;
const STATES: [f64; 6] = [3.0, 0.5, 2.5, -1.0, 1.0, 0.0];
/// The same extremal, found from two guesses: both are within Newton's 1e-9 of the trajectory, of
/// second order in V.
const SAME: f64 = 1e-9;

fn folder(name: &str) -> PathBuf {
    let path =
        std::env::temp_dir().join(format!("costate-check-least-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&path).unwrap();
    path
}

fn costate(arguments: &[&str]) -> Output {
    (Command::new(env!("CARGO_BIN_EXE_costate"))
        .args(arguments)
        .output())
    .unwrap()
}

fn solved(model: &Model, states: &[f64]) -> Answers {
    let choices = Choices::default();
    let found = solve_states(
        model,
        &derive(model),
        &Cpu::new(),
        choices,
        states,
        &mut |_, _, _| {},
    );
    found.unwrap_or_else(|e| panic!("{e}")).2
}

/// A result file with answers (or none) as `costate solve` writes them.
fn stored(path: &Path, model: &Model, answers: Option<&Answers>) {
    let axis = |v: &Variable| Axis {
        name: v.name.clone(),
        unit: v.unit.clone(),
        long_name: v.long_name.clone(),
    };
    let schema = TrajectorySchema {
        states: model.states.iter().map(|s| axis(&s.variable)).collect(),
        controls: model.controls.iter().map(|c| axis(&c.variable)).collect(),
        ..TrajectorySchema::default()
    };
    let mut file = ResultFile::create(path).unwrap();
    if let Some(answers) = answers {
        let count = answers.targets.of_given.len();
        file.points(&schema, answers, 0, count).unwrap();
    }
    RunRecord::begun(model, SystemTime::now())
        .write(&file)
        .unwrap();
    file.finish().unwrap();
}

/// The summary of a check, and its exit status.
fn checked(file: &Path, more: &[&str]) -> (Value, Option<i32>) {
    let path = file.display().to_string();
    let arguments = [&["check-least", &path, "--json", "--nodes", "121"], more].concat();
    let done = costate(&arguments);
    let text = String::from_utf8_lossy(&done.stdout);
    let summary = serde_json::from_str(&text);
    let summary =
        summary.unwrap_or_else(|e| panic!("{e}: {text}{}", String::from_utf8_lossy(&done.stderr)));
    (summary, done.status.code())
}

fn number(value: &Value) -> f64 {
    value
        .as_f64()
        .unwrap_or_else(|| panic!("{value} is no number"))
}

#[test]
fn a_correct_result_is_not_undercut() {
    let folder = folder("correct");
    let model = parse(SWING);
    let file = folder.join("swing.h5");
    stored(&file, &model, Some(&solved(&model, &STATES)));
    for backend in ["cpu", "gpu"] {
        let (said, status) = checked(&file, &["--backend", backend]);
        assert_eq!(status, Some(0), "{said:#}");
        assert_eq!(
            said["grid"]["backend"], backend,
            "no other device is taken in its place"
        );
        assert_eq!((&said["states"], &said["known"]), (&3.into(), &3.into()));
        // All paths lead to what is in the file.
        assert_eq!(said["greedy"]["same"], 3, "{said:#}");
        assert_eq!(said["undercut"].as_array().map(Vec::len), Some(0));
        let worst = number(&said["difference"]["worst"]);
        assert!(worst > 0.0 && worst < 0.05, "a coarse grid: {worst}");
        // A threshold below what the grid differs by is told at every state that is beyond it.
        let (strict, _) = checked(
            &file,
            &[
                "--backend",
                backend,
                "--apart",
                &format!("{}", 0.99 * worst),
            ],
        );
        let apart = strict["apart"]["states"].as_array().expect("a list");
        assert!(!apart.is_empty());
        assert!((number(&apart[0]["difference"]).abs() - worst).abs() < 1e-12);
    }
}

#[test]
fn what_is_not_the_least_is_found() {
    let folder = folder("dearer");
    let model = parse(SWING);
    let truth = solved(&model, &STATES);
    let mut told = solved(&model, &STATES);
    // At one state the second solution in place of the first, at another a V that is a little too
    // large.
    let (first, second) = (told.targets.of_given[0], told.targets.of_given[1]);
    assert!(told.of(first).len() > 1, "two solutions");
    let at = told.first[first];
    told.entries.swap(at, at + 1);
    let at = told.first[second];
    told.entries[at].value *= 1.0 + 1e-4;
    let file = folder.join("dearer.h5");
    stored(&file, &model, Some(&told));

    let (said, status) = checked(&file, &["--backend", "cpu"]);
    assert_eq!(status, Some(1), "{said:#}");
    let undercut = said["undercut"].as_array().expect("a list");
    assert_eq!(undercut.len(), 2, "{said:#}");
    for (found, (target, state)) in undercut
        .iter()
        .zip([(first, &STATES[..2]), (second, &STATES[2..4])])
    {
        let least = truth.answer(target).expect("solved");
        assert_eq!(found["x"], serde_json::json!(state));
        let claimed = told.answer(target).expect("solved").value;
        assert!((number(&found["V"]) - claimed).abs() <= 1e-12 * claimed);
        assert!(
            (number(&found["cheaper"]) - least.value).abs() <= SAME * least.value,
            "{found:#}"
        );
        for (p, exact) in found["p"].as_array().expect("a list").iter().zip(&least.p) {
            assert!(
                (number(p) - exact).abs()
                    <= 1e-6 * least.p.iter().fold(0.0, |a: f64, p| a.max(p.abs()))
            );
        }
    }
    // The grid sees the first, which costs much more, and not the second, which is within its
    // error.
    let apart = said["apart"]["states"].as_array().expect("a list");
    assert_eq!(apart.len(), 1, "{said:#}");
    assert_eq!(apart[0]["x"], serde_json::json!(STATES[..2]));

    let path = file.display().to_string();
    let quiet = costate(&[
        "check-least",
        &path,
        "--quiet",
        "--nodes",
        "121",
        "--backend",
        "cpu",
    ]);
    assert_eq!(
        (quiet.status.code(), quiet.stdout.as_slice()),
        (Some(1), b"".as_slice())
    );
    assert!(String::from_utf8_lossy(&quiet.stderr).contains("not the least at 2 states"));
}

fn refused(arguments: &[&str], words: &str) {
    let done = costate(arguments);
    let text = String::from_utf8_lossy(&done.stderr).replace('\n', " ");
    assert_eq!(done.status.code(), Some(2), "{arguments:?}: {text}");
    assert!(text.contains(words), "{arguments:?}: {text}");
    assert!(done.stdout.is_empty(), "{arguments:?}");
}

/// Five integrators in a row.
fn five() -> String {
    let states: Vec<String> = (1..=5).map(|i| format!("x{i}")).collect();
    let each = |text: &dyn Fn(usize) -> String| (1..=5).map(text).collect::<Vec<_>>().join(", ");
    format!(
        "states = {{ {} }}\ncontrols = {{ u = {{}} }}\ndynamics = {{ {} }}\n\
         cost = {{ running = \"0.5*({} + u^2)\" }}\nequilibrium = {{ {}, u = 0 }}\nregion = {{ {} }}\n",
        each(&|i| format!("x{i} = {{}}")),
        each(&|i| if i < 5 {
            format!("x{i} = \"x{}\"", i + 1)
        } else {
            "x5 = \"u\"".to_owned()
        }),
        states
            .iter()
            .map(|s| format!("{s}^2"))
            .collect::<Vec<_>>()
            .join(" + "),
        each(&|i| format!("x{i} = 0")),
        each(&|i| format!("x{i} = [-1, 1]")),
    )
}

#[test]
fn what_has_no_grid_is_refused() {
    let folder = folder("refused");
    let check = |name: &str, model: &Model, words: &str| {
        let file = folder.join(name);
        stored(&file, model, None);
        refused(&["check-least", &file.display().to_string()], words);
    };
    check("game.h5", &scene("pendulum_game", &[]), "disturbances");
    check("five.h5", &parse(&five()), "5 states");
    let model = parse(SWING);
    check("empty.h5", &model, "no solved states");
    let path = folder.join("swing.h5");
    stored(&path, &model, Some(&solved(&model, &STATES[4..])));
    let path = path.display().to_string();
    refused(
        &["check-least", &path, "--nodes", "21,21,21"],
        "3 numbers for 2 states",
    );
    refused(&["check-least", &path, "--nodes", "100001"], "nodes in all");
    refused(
        &["check-least", &path, "--nodes", "3"],
        "whole number from 11",
    );
    refused(&["check-least", &path, "--apart", "0"], "above 0");
    refused(&["check-least", &path, "--margin", "-1"], "from 0 to 10");
    refused(
        &["check-least", &path, "--sheets", "2"],
        "unexpected argument",
    );
    refused(
        &["check-least", &folder.join("none.h5").display().to_string()],
        "none.h5",
    );
}

#[test]
fn guesses_from_a_grid_are_refused_where_there_is_none() {
    let folder = folder("guesses-refused");
    let text = |name: &str, text: &str| {
        let path = folder.join(name);
        std::fs::write(&path, text).unwrap();
        path.display().to_string()
    };
    let (five, swing) = (text("five.toml", &five()), text("swing.toml", SWING));
    let points = text("points.csv", "x1\n0.1\n");
    let out = folder.join("out.h5");
    let to = out.display().to_string();
    let game = format!("{}/scenarios/pendulum_game.toml", crate::ROOT);
    let study = format!("{}/scenarios/moore_greitzer.toml", crate::ROOT);
    refused(
        &["run", &game, "--grid-guesses", "--out", &to],
        "disturbances",
    );
    refused(
        &[
            "solve",
            &five,
            "--points",
            &points,
            "--grid-guesses",
            "--out",
            &to,
        ],
        "5 states",
    );
    refused(
        &["shoot-out", &swing, "--grid-guesses", "--out", &to],
        "no states",
    );
    refused(
        &["study", &study, "--grid-guesses", "--out", &to],
        "no states",
    );
    assert!(!out.exists());
    let left: Vec<_> = std::fs::read_dir(&folder)
        .unwrap()
        .map(|e| e.unwrap().file_name())
        .collect();
    assert_eq!(left.len(), 3, "{left:?}: nothing was written");
}

/// `--json` of `costate solve` at states.
fn answers(folder: &Path, scene: &str, states: &[f64], more: &[&str]) -> Vec<Value> {
    let (file, points) = (folder.join("scene.toml"), folder.join("points.csv"));
    std::fs::write(&file, scene).unwrap();
    let rows: Vec<String> = states
        .chunks(2)
        .map(|x| format!("{},{}\n", x[0], x[1]))
        .collect();
    std::fs::write(&points, format!("x,v\n{}", rows.concat())).unwrap();
    let (file, points) = (file.display().to_string(), points.display().to_string());
    let out = folder.join("out.h5").display().to_string();
    let arguments = [
        "solve",
        &file,
        "--points",
        &points,
        "--out",
        &out,
        "--json",
        "--backend",
        "cpu",
    ];
    let done = costate(&[&arguments, more].concat());
    assert_eq!(
        done.status.code(),
        Some(0),
        "{}",
        String::from_utf8_lossy(&done.stderr)
    );
    let summary: Value = serde_json::from_slice(&done.stdout).unwrap();
    summary["points"].as_array().expect("a list").clone()
}

#[test]
fn guesses_from_a_grid_change_no_answer_that_was_right() {
    let folder = folder("guesses");
    let without = answers(&folder, SWING, &STATES, &[]);
    let with = answers(&folder, SWING, &STATES, &["--grid-guesses"]);
    assert_eq!((without.len(), with.len()), (3, 3));
    for (a, b) in without.iter().zip(&with) {
        let (v, w) = (number(&a["V"]), number(&b["V"]));
        assert!((v - w).abs() <= SAME * v, "{v} {w}");
        assert!(
            number(&b["starts"]) > number(&a["starts"]),
            "the grid's guess was tried"
        );
    }
}

/// At rest hanging, with a torque that takes several swings: a sheet that the cells do not lead to.
/// V is another program's (direct collocation), good to 1e-6.
#[test]
fn guesses_from_a_grid_find_what_cells_do_not() {
    let folder = folder("bounded");
    let scene = SWING
        .replace("u = {} }", "u = { min = -0.4, max = 0.4 } }")
        .replace("6*u^2", "u^2");
    let found = answers(
        &folder,
        &scene,
        &[std::f64::consts::PI, 0.0],
        &["--grid-guesses"],
    );
    let v = number(&found[0]["V"]);
    assert!((v / 14.251771422859562 - 1.0).abs() < 1e-6, "{v}");
}
