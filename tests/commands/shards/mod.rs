//! Work divided into shards, put together again, and gone on with.

mod archive;
mod copies;
mod elsewhere;
mod levels;
mod loops;
mod resume;
mod sweeps;

use crate::common_commands::{in_schema, scenario, scratch};
use costate::low_level::result::Stored;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

/// Linear and fast; a third of the states are in each block of a list of three thousand.
pub const LINEAR: &str = r#"
states = { x = {}, v = {} }
controls = { u = {} }
parameters = { q = 1 }
dynamics = { x = "v", v = "-q*x + u" }
cost = { running = "0.5*(x^2 + v^2 + u^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-1, 1], v = [-1, 1] }
"#;

pub fn command(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_costate"));
    command.current_dir(folder).args(arguments);
    for name in ["ID", "COUNT", "MIN", "STEP"] {
        command.env_remove(format!("SLURM_ARRAY_TASK_{name}"));
    }
    command
}

pub fn run(folder: &Path, arguments: &[&str]) -> (Output, String) {
    let output = command(folder, arguments).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    (output, errors)
}

#[track_caller]
pub fn done(folder: &Path, arguments: &[&str]) -> String {
    let (output, errors) = run(folder, arguments);
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {errors}");
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Refused, with nothing written under a name.
#[track_caller]
pub fn refused(folder: &Path, arguments: &[&str], out: &str) -> String {
    let (output, errors) = run(folder, arguments);
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {errors}");
    assert!(!folder.join(out).exists());
    errors
}

pub fn entries(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> = (std::fs::read_dir(folder).unwrap())
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

/// So many scattered states in ranges, as a file of points.
pub fn points(path: &Path, names: [&str; 2], ranges: [[f64; 2]; 2], count: u32) {
    let mut text = format!("{},{}\n", names[0], names[1]);
    for k in 0..count {
        // A lattice of rank 1, in which no two states are alike.
        let at = |turn: f64, [lo, hi]: [f64; 2]| lo + (hi - lo) * (f64::from(k) * turn).fract();
        let (x, y) = (at(0.754_877_666, ranges[0]), at(0.569_840_29, ranges[1]));
        writeln!(text, "{x:?},{y:?}").unwrap();
    }
    std::fs::write(path, text).unwrap();
}

/// Fails where two result files differ in any number or text, but for what only parts have.
#[track_caller]
pub fn same_results(a: &Path, b: &Path) {
    let (a, b) = (Stored::open(a).unwrap(), Stored::open(b).unwrap());
    let groups = |stored: &Stored| {
        let mut names = stored.groups();
        names.retain(|name| !name.starts_with("shard"));
        names.sort();
        names
    };
    assert_eq!(groups(&a), groups(&b));
    assert!(!groups(&a).is_empty());
    for name in groups(&a) {
        let (one, other) = (a.group(&name).unwrap(), b.group(&name).unwrap());
        let names = |of: &[String]| {
            let mut names = of.to_vec();
            names.sort();
            names
        };
        assert_eq!(names(&one.names()), names(&other.names()), "/{name}");
        for own in one.names() {
            if let (Ok(x), Ok(y)) = (one.f64(&own), other.f64(&own)) {
                assert_eq!(x.shape, y.shape, "/{name}/{own}");
                let differ = (x.values.iter().zip(&y.values))
                    .filter(|(x, y)| x.to_bits() != y.to_bits())
                    .count();
                assert_eq!(differ, 0, "/{name}/{own}");
            } else {
                assert_eq!(one.texts(&own).unwrap(), other.texts(&own).unwrap());
            }
            for attribute in ["units", "long_name", "flag_meanings"] {
                let of = |group: &costate::low_level::result::StoredGroup<'_>| {
                    group.attribute(Some(&own), attribute)
                };
                assert_eq!(of(&one), of(&other), "/{name}/{own}: {attribute}");
            }
        }
    }
}

/// Makes all shards of a command.
pub fn shards(folder: &Path, arguments: &[&str], of: usize) -> Vec<String> {
    (0..of)
        .map(|k| {
            let (name, shard) = (format!("p{k}.h5"), format!("{k}/{of}"));
            let own = ["--out", &name, "--shard", &shard, "--quiet"];
            done(folder, &[arguments, &own].concat());
            name
        })
        .collect()
}

pub fn merged(folder: &Path, parts: &[String], more: &[&str]) -> PathBuf {
    let parts: Vec<&str> = parts.iter().map(String::as_str).collect();
    let own = ["--out", "all.h5"];
    done(folder, &[&["merge"], parts.as_slice(), &own, more].concat());
    folder.join("all.h5")
}

/// States of several sheets and ways round, some given twice, with their trajectories; more shards
/// than blocks of states.
#[test]
fn shards_of_a_list_are_the_whole() {
    let folder = scratch("shards-list");
    let scene = scenario("pendulum");
    let ranges = [[-4.0, 4.0], [-6.0, 6.0]];
    points(&folder.join("states.csv"), ["theta", "omega"], ranges, 2200);
    let mut text = std::fs::read_to_string(folder.join("states.csv")).unwrap();
    let again: Vec<String> = text.lines().skip(5).take(3).map(str::to_owned).collect();
    text += &(again.join("\n") + "\n");
    std::fs::write(folder.join("states.csv"), text).unwrap();

    let solve = ["solve", scene.to_str().unwrap(), "--points", "states.csv"];
    let more = ["--trajectories", "--samples", "5", "--backend", "cpu"];
    let solve = [&solve[..], &more].concat();
    done(
        &folder,
        &[&solve[..], &["--out", "whole.h5", "--quiet"]].concat(),
    );
    let parts = shards(&folder, &solve, 5);
    let all = merged(&folder, &parts, &["--quiet"]);
    same_results(&folder.join("whole.h5"), &all);

    // They are parts, and what they leave out is nothing but what others have.
    let mut rows = 0;
    for part in &parts {
        in_schema(&folder.join(part));
        let stored = Stored::open(folder.join(part)).unwrap();
        rows += stored.points().unwrap().map_or(0, |points| points.count);
        assert!(stored.has_attribute("manifest") && stored.has_attribute("shard"));
    }
    assert_eq!(rows, 2203);
    let whole = Stored::open(&all).unwrap();
    in_schema(&all);
    assert!(!whole.has_attribute("manifest") && !whole.has_attribute("stopped"));
    let count = |path: &Path| {
        let summary = Stored::open(path).unwrap().run_summary().unwrap().unwrap();
        let solved = summary.homotopy.unwrap();
        (
            solved.states,
            solved.distinct,
            solved.status,
            solved.solutions,
            solved.sheets,
        )
    };
    let counted = count(&all);
    assert_eq!(counted, count(&folder.join("whole.h5")));
    assert!(counted.4 > 3 && counted.1 == 2200 && counted.0 == 2203);
    let largest = |path: &Path| {
        let summary = Stored::open(path).unwrap().run_summary().unwrap().unwrap();
        let solved = summary.homotopy.unwrap();
        (solved.largest_residual, solved.hamiltonian_relative)
    };
    assert_eq!(largest(&all), largest(&folder.join("whole.h5")));
}

/// States of both grids of a scene, with V above the limit of one left out, and a line on which two
/// sheets cost the same.
#[test]
fn shards_of_grids_are_the_whole() {
    let folder = scratch("shards-grids");
    let scene = scenario("pendulum");
    let homotopy = ["homotopy", scene.to_str().unwrap(), "--backend", "cpu"];
    done(
        &folder,
        &[&homotopy[..], &["--out", "whole.h5", "--quiet"]].concat(),
    );
    let parts = shards(&folder, &homotopy, 3);
    let all = merged(&folder, &parts, &["--quiet"]);
    same_results(&folder.join("whole.h5"), &all);
    let stored = Stored::open(&all).unwrap();
    let line = stored.group("equal_cost").unwrap();
    assert!(line.f64("V").unwrap().values.len() > 100);
    let above = stored.map().unwrap().unwrap().v;
    assert!(above.iter().any(|v| v.is_nan()) && above.iter().any(|v| v.is_finite()));
    // The map alone has no states of the other grid.
    done(
        &folder,
        &[
            "map",
            scene.to_str().unwrap(),
            "--backend",
            "cpu",
            "--out",
            "map.h5",
            "--quiet",
        ],
    );
    assert!(!Stored::open(folder.join("map.h5")).unwrap().has("points"));
}

pub fn linear(name: &str) -> PathBuf {
    let folder = scratch(name);
    std::fs::write(folder.join("scene.toml"), LINEAR).unwrap();
    points(
        &folder.join("states.csv"),
        ["x", "v"],
        [[-1.0, 1.0]; 2],
        3000,
    );
    folder
}

pub const SOLVE: [&str; 6] = [
    "solve",
    "scene.toml",
    "--points",
    "states.csv",
    "--backend",
    "cpu",
];

#[test]
fn what_is_not_of_one_whole_is_refused() {
    let folder = linear("shards-refused");
    let parts = shards(&folder, &SOLVE, 3);
    let parts: Vec<&str> = parts.iter().map(String::as_str).collect();
    let merge = |parts: &[&str]| {
        let own = ["--out", "all.h5"];
        refused(&folder, &[&["merge"], parts, &own].concat(), "all.h5")
    };
    let one_missing = merge(&[parts[0], parts[2]]);
    assert!(
        one_missing.contains("of 3 shards one is missing: 1 ("),
        "{one_missing}"
    );
    assert!(one_missing.contains("--partial"), "{one_missing}");
    let twice = merge(&[parts[0], parts[1], parts[2], parts[1]]);
    assert!(twice.contains("shard 1 is there twice"), "{twice}");
    let over = run(
        &folder,
        &["merge", "p0.h5", "p1.h5", "p2.h5", "--out", "p0.h5"],
    );
    assert_eq!(over.0.status.code(), Some(2), "{}", over.1);

    // Other counts, scenes, lists, tolerances, and files that are no parts at all.
    let other = |name: &str, more: &[&str]| {
        let own = ["--out", name, "--quiet"];
        done(&folder, &[&SOLVE[..], &own, more].concat());
        merge(&[parts[0], name, parts[2]])
    };
    let count = other("count.h5", &["--shard", "1/4"]);
    assert!(count.contains("number of shards differs (3; 4)"), "{count}");
    let set = other("set.h5", &["--shard", "1/3", "--set", "q=2"]);
    assert!(set.contains("scene (with --set) differs"), "{set}");
    let rtol = other("rtol.h5", &["--shard", "1/3", "--rtol", "1e-8"]);
    assert!(rtol.contains("method and tolerance differs"), "{rtol}");
    let whole = other("whole.h5", &[]);
    assert!(whole.contains("whole.h5 is no part of a whole"), "{whole}");
    let text = std::fs::read_to_string(folder.join("states.csv")).unwrap();
    std::fs::write(folder.join("states.csv"), text.replacen("0.", "0.0", 1)).unwrap();
    let list = other("list.h5", &["--shard", "1/3"]);
    assert!(list.contains("list of states differs"), "{list}");

    // A part that was cut short on its way.
    let bytes = std::fs::read(folder.join("p1.h5")).unwrap();
    for share in [2, 4, 50] {
        std::fs::write(folder.join("cut.h5"), &bytes[..bytes.len() / share]).unwrap();
        let cut = merge(&[parts[0], "cut.h5", parts[2]]);
        assert!(cut.contains("cut.h5"), "{cut}");
    }
    let none = merge(&["none.h5"]);
    assert!(none.contains("none.h5"), "{none}");
}

/// What is missing is told by status, and never filled in.
#[test]
fn a_partial_whole_says_what_is_missing() {
    let folder = linear("shards-partial");
    let parts = shards(&folder, &SOLVE, 3);
    merged(&folder, &parts, &["--quiet"]);
    let whole = Stored::open(folder.join("all.h5"))
        .unwrap()
        .points()
        .unwrap()
        .unwrap();

    let merge = [
        "merge",
        "p0.h5",
        "p2.h5",
        "--out",
        "some.h5",
        "--partial",
        "--quiet",
    ];
    let (output, errors) = run(&folder, &merge);
    assert_eq!(output.status.code(), Some(75), "{errors}");
    assert!(errors.contains("some.h5"), "{errors}");
    let stored = Stored::open(folder.join("some.h5")).unwrap();
    assert_eq!(stored.attribute("shards_missing").as_deref(), Some("1"));
    assert!(stored.has_attribute("stopped"));
    let some = stored.points().unwrap().unwrap();
    let codes = stored.group("points").unwrap();
    let missing = (codes.meanings("status").iter())
        .find(|(_, name)| *name == "not merged")
        .map(|(code, _)| *code)
        .unwrap();
    assert_eq!(some.count, whole.count);
    let mut left = 0;
    for k in 0..some.count {
        if some.status[k] == missing {
            left += 1;
            assert!(some.v[k].is_nan() && some.sheet[k] == -1 && some.x[2 * k].is_nan());
        } else {
            assert_eq!(some.v[k].to_bits(), whole.v[k].to_bits());
        }
    }
    let owned = Stored::open(folder.join("p1.h5"))
        .unwrap()
        .points()
        .unwrap();
    assert_eq!(left, owned.map_or(0, |points| points.count));
    assert!(left > 0);
    let summary = stored.run_summary().unwrap().unwrap();
    assert_eq!(summary.homotopy.unwrap().status["not_merged"], left);
}

/// A job array's tasks know their shards.
#[test]
fn a_job_array_tells_the_shard() {
    let folder = linear("shards-array");
    let own = [&SOLVE[..], &["--out", "a.h5"]].concat();
    let task = |variables: &[(&str, &str)]| {
        let mut command = command(&folder, &own);
        for (name, value) in variables {
            command.env(format!("SLURM_ARRAY_TASK_{name}"), value);
        }
        let output = command.output().unwrap();
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        (output.status.code(), errors)
    };
    let (status, errors) = task(&[("ID", "7"), ("COUNT", "3"), ("MIN", "5")]);
    assert_eq!(status, Some(0), "{errors}");
    assert!(errors.contains("shard 2/3"), "{errors}");
    let stored = Stored::open(folder.join("a.h5")).unwrap();
    assert!(
        stored
            .attribute("manifest")
            .unwrap()
            .contains("\"shard\":2,\"shards\":3")
    );
    std::fs::remove_file(folder.join("a.h5")).unwrap();
    for variables in [
        &[("ID", "1")][..],
        &[("COUNT", "3")],
        &[("ID", "9"), ("COUNT", "3"), ("MIN", "5")],
    ] {
        let (status, errors) = task(variables);
        assert_eq!(status, Some(2), "{errors}");
        assert!(errors.contains("--shard"), "{errors}");
        assert!(!folder.join("a.h5").exists());
    }
    for wrong in ["3/3", "x", "1/0", "-1/3"] {
        let option = format!("--shard={wrong}");
        refused(&folder, &[&own[..], &[&option]].concat(), "a.h5");
    }
    let table = [&SOLVE[..], &["--out", "a.csv", "--shard", "0/2"]].concat();
    assert!(refused(&folder, &table, "a.csv").contains("result file"));
}

/// A run that is ended leaves what is done; what is left of it gives the same as all at once.
#[test]
fn what_was_ended_is_gone_on_with() {
    let folder = linear("shards-resumed");
    done(
        &folder,
        &[&SOLVE[..], &["--out", "whole.h5", "--quiet"]].concat(),
    );
    let own = [&SOLVE[..], &["--out", "a.h5", "--quiet"]].concat();

    // Ended by its time limit, again and again, with more each time.
    let clock = Instant::now();
    done(&folder, &own);
    let seconds = clock.elapsed().as_secs_f64();
    std::fs::remove_file(folder.join("a.h5")).unwrap();
    let mut times = 0;
    loop {
        let limit = format!("{:?}", 0.6 * seconds);
        let (output, errors) = run(
            &folder,
            &[&own[..], &["--resume", "--time-limit", &limit]].concat(),
        );
        times += 1;
        match output.status.code() {
            Some(0) => break,
            Some(75) => assert!(times < 40, "{errors}"),
            _ => panic!("{errors}"),
        }
        let stored = Stored::open(folder.join("a.h5")).unwrap();
        assert!(stored.has_attribute("stopped") && stored.has_attribute("manifest"));
    }
    same_results(&folder.join("whole.h5"), &folder.join("a.h5"));
    assert!(!entries(&folder).iter().any(|name| name.contains("stopped")));

    // What is not of the same is refused; what is complete is done anew.
    let limited = [&own[..], &["--time-limit", "0.1", "--shard", "0/2"]].concat();
    std::fs::remove_file(folder.join("a.h5")).unwrap();
    let _ = run(&folder, &limited);
    let (output, errors) = run(
        &folder,
        &[&own[..], &["--resume", "--shard", "1/2"]].concat(),
    );
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert!(errors.contains("a file of its own"), "{errors}");
}

/// A run that is killed at once leaves its last checkpoint and nothing else.
#[cfg(unix)]
#[test]
fn a_killed_run_leaves_a_checkpoint() {
    let folder = scratch("shards-killed");
    let scene = scenario("pendulum");
    let ranges = [[-4.0, 4.0], [-6.0, 6.0]];
    points(&folder.join("states.csv"), ["theta", "omega"], ranges, 5000);
    let solve = ["solve", scene.to_str().unwrap(), "--points", "states.csv"];
    let solve = [&solve[..], &["--backend", "cpu", "--quiet"]].concat();
    done(&folder, &[&solve[..], &["--out", "whole.h5"]].concat());
    let own = [
        &solve[..],
        &["--out", "a.h5", "--resume", "--checkpoint", "1"],
    ]
    .concat();

    let mut child = command(&folder, &own)
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let begun = Instant::now();
    while !folder.join("a.h5").exists() && begun.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(5));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let stored = Stored::open(folder.join("a.h5")).unwrap();
    let blocks = stored.group("shard").unwrap().i32("done").unwrap().1;
    assert!(!blocks.is_empty() && blocks.iter().all(|done| *done == 1));
    drop(stored);
    let (output, errors) = run(
        &folder,
        &own[..own.len()]
            .iter()
            .copied()
            .filter(|a| *a != "--quiet")
            .collect::<Vec<_>>(),
    );
    assert_eq!(output.status.code(), Some(0), "{errors}");
    assert!(errors.contains("done before"), "{errors}");
    same_results(&folder.join("whole.h5"), &folder.join("a.h5"));
}

/// A study divides by its variants.
#[test]
fn shards_of_a_study_are_the_whole() {
    let folder = scratch("shards-study");
    let study = "study = { vary = { q = [1, 2, 3, 4, 5] }, from = { x = 0.5 }, samples = 4 }";
    std::fs::write(folder.join("scene.toml"), format!("{LINEAR}{study}\n")).unwrap();
    let study = ["study", "scene.toml", "--backend", "cpu"];
    done(&folder, &[&study[..], &["--out", "whole.h5"]].concat());
    // More shards than variants.
    let parts = shards(&folder, &study, 7);
    let all = merged(&folder, &parts, &["--quiet"]);
    same_results(&folder.join("whole.h5"), &all);
    in_schema(&folder.join("p0.h5"));
    let summary = |path: &Path| {
        Stored::open(path)
            .unwrap()
            .run_summary()
            .unwrap()
            .unwrap()
            .study
    };
    assert_eq!(summary(&all), summary(&folder.join("whole.h5")));

    let rows = |path: &str| {
        let stored = Stored::open(folder.join(path)).unwrap();
        stored
            .group("study")
            .map_or(0, |group| group.f64("V").unwrap().values.len())
    };
    let full = (0..7).map(|k| rows(&format!("p{k}.h5")));
    assert_eq!(full.clone().sum::<usize>(), 5);
    let first = full.clone().position(|rows| rows == 1).unwrap();
    let others: Vec<&str> = (parts.iter().enumerate())
        .filter(|(k, _)| *k != first)
        .map(|(_, name)| name.as_str())
        .collect();
    let partial = [
        &["merge", "--partial", "--out", "some.h5"],
        others.as_slice(),
    ]
    .concat();
    assert_eq!(run(&folder, &partial).0.status.code(), Some(75));
    let stored = Stored::open(folder.join("some.h5")).unwrap();
    let group = stored.group("study").unwrap();
    let missing = (group.meanings("status").into_iter()).find(|(_, name)| name == "not merged");
    let status = group.i32("status").unwrap().1;
    let code = missing.unwrap().0;
    assert_eq!(status.iter().filter(|s| **s == code).count(), 1);

    // Gone on with after a time limit.
    let own = [&study[..], &["--out", "a.h5", "--quiet", "--resume"]].concat();
    let (output, errors) = run(&folder, &[&own[..], &["--time-limit", "1e-3"]].concat());
    assert_eq!(output.status.code(), Some(75), "{errors}");
    done(&folder, &own);
    same_results(&folder.join("whole.h5"), &folder.join("a.h5"));
    // Parts of other work are not gone on with.
    let list = [
        &SOLVE[..],
        &["--out", "p0.h5", "--resume", "--shard", "0/7"],
    ]
    .concat();
    points(&folder.join("states.csv"), ["x", "v"], [[-1.0, 1.0]; 2], 3);
    let (output, errors) = run(&folder, &list);
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert!(errors.contains("kind of work"), "{errors}");
}

/// The example for Slurm, with the variables of a job array and no cluster.
#[cfg(unix)]
#[test]
fn the_slurm_script_does_a_job_array() {
    let folder = linear("shards-slurm");
    let bin = folder.join("bin");
    std::fs::create_dir_all(&bin).unwrap();
    std::os::unix::fs::symlink(env!("CARGO_BIN_EXE_costate"), bin.join("costate")).unwrap();
    let path = format!("{}:{}", bin.display(), std::env::var("PATH").unwrap());
    let script = Path::new(crate::ROOT).join("examples/slurm.sh");
    let all = folder.join("out/scene/all.h5");
    let run_tasks = |tasks: std::ops::Range<usize>| {
        for task in tasks.clone() {
            let done = Command::new("bash")
                .arg(&script)
                .args(["scene.toml", "states.csv", "3"])
                .current_dir(&folder)
                .env("PATH", &path)
                .env("SLURM_ARRAY_JOB_ID", "77")
                .env("SLURM_ARRAY_TASK_ID", task.to_string())
                .env("SLURM_ARRAY_TASK_COUNT", tasks.len().to_string())
                .env("SLURM_ARRAY_TASK_MIN", tasks.start.to_string())
                .output()
                .unwrap();
            let errors = String::from_utf8_lossy(&done.stderr);
            assert!(done.status.success(), "{errors}");
            assert_eq!(all.exists(), task == 2, "{errors}");
        }
    };
    run_tasks(0..3);
    // Two of them again: they are the same shards of three.
    let first = std::fs::read(&all).unwrap();
    for name in ["all.h5", "part-1.h5", "part-2.h5"] {
        std::fs::remove_file(folder.join("out/scene").join(name)).unwrap();
    }
    run_tasks(1..3);
    assert_eq!(first.len(), std::fs::read(&all).unwrap().len());
    done(
        &folder,
        &[&SOLVE[..], &["--out", "whole.h5", "--quiet"]].concat(),
    );
    same_results(&folder.join("whole.h5"), &all);
}
