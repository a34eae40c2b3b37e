//! `--adapter all`: the work divided among the adapters of one machine. One software adapter is
//! shown twice, by two copies of the file that tells the Vulkan loader of it.

use crate::common_commands::scratch;
use crate::shards::{LINEAR, command, entries, linear, points, same_results};
use costate::low_level::result::Stored;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// More states than are in one block on a GPU, so that each adapter has some.
const STATES: u32 = 4200;

const SOLVE: [&str; 6] = [
    "solve",
    "scene.toml",
    "--points",
    "states.csv",
    "--backend",
    "gpu",
];
const ALL: [&str; 2] = ["--adapter", "all"];

/// The file that tells the loader of a software adapter. A machine without one fails the test.
fn software() -> PathBuf {
    let named = ["VK_DRIVER_FILES", "VK_ICD_FILENAMES"]
        .into_iter()
        .filter_map(std::env::var_os)
        .flat_map(|list| std::env::split_paths(&list).collect::<Vec<_>>());
    let folders = [
        "/usr/share/vulkan/icd.d",
        "/usr/local/share/vulkan/icd.d",
        "/etc/vulkan/icd.d",
    ];
    let installed = (folders.iter())
        .filter_map(|folder| std::fs::read_dir(folder).ok())
        .flat_map(|entries| entries.map(|entry| entry.unwrap().path()));
    let is_software = |path: &PathBuf| {
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        name.starts_with("lvp_icd") && name.ends_with(".json") && path.exists()
    };
    let mut found: Vec<PathBuf> = named.chain(installed).filter(is_software).collect();
    found.sort_by_key(|path| !path.to_string_lossy().contains(std::env::consts::ARCH));
    (found.into_iter().next())
        .expect("no software adapter was found; install one (Debian: mesa-vulkan-drivers)")
}

/// The program on a machine with so many adapters.
fn on(adapters: usize, folder: &Path, arguments: &[&str]) -> Command {
    let of_loader = folder.join("loader");
    std::fs::create_dir_all(&of_loader).unwrap();
    let copies = (0..adapters).map(|k| {
        let copy = of_loader.join(format!("{k}.json"));
        std::fs::copy(software(), &copy).unwrap();
        copy
    });
    let list = std::env::join_paths(copies).unwrap();
    let mut command = command(folder, arguments);
    // The newer name and the older one.
    command
        .env("VK_DRIVER_FILES", &list)
        .env("VK_ICD_FILENAMES", &list);
    command
}

/// What a command with two adapters ends with, and what it says on standard error.
fn both(folder: &Path, arguments: &[&str]) -> (Output, String) {
    let output = on(2, folder, arguments).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    (output, errors)
}

#[track_caller]
fn done(adapters: usize, folder: &Path, arguments: &[&str]) -> String {
    let output = on(adapters, folder, arguments).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {errors}");
    String::from_utf8(output.stdout).unwrap()
}

/// The scene and its states, and what one adapter makes of them.
fn solved_by_one(name: &str) -> PathBuf {
    let folder = linear(name);
    let path = folder.join("states.csv");
    points(&path, ["x", "v"], [[-1.0, 1.0]; 2], STATES);
    let one = ["--adapter", "0", "--out", "one.h5", "--quiet"];
    done(2, &folder, &[&SOLVE[..], &one].concat());
    folder
}

#[test]
fn two_adapters_are_one() {
    let folder = solved_by_one("adapters-list");
    let own = [&SOLVE[..], &ALL, &["--out", "all.h5"]].concat();
    let (output, errors) = both(&folder, &[&own[..], &["--json"]].concat());
    assert_eq!(output.status.code(), Some(0), "{errors}");
    for said in [
        "adapter 0: ",
        "adapter 1: ",
        "2 of 2 shards",
        "written to all.h5",
    ] {
        assert!(errors.contains(said), "{said}: {errors}");
    }
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(summary["homotopy"]["states"], STATES);
    assert_eq!(summary["backend"], "gpu");
    same_results(&folder.join("one.h5"), &folder.join("all.h5"));
    let stored = Stored::open(folder.join("all.h5")).unwrap();
    assert!(!stored.has_attribute("manifest") && !stored.has_attribute("stopped"));
    // Parts are gone with their folder.
    let left = ["all.h5", "loader", "one.h5", "scene.toml", "states.csv"];
    assert_eq!(entries(&folder), left);
    // Nothing is said that was not asked for.
    let (output, errors) = both(&folder, &[&own[..], &["--quiet"]].concat());
    assert_eq!(output.status.code(), Some(0), "{errors}");
    assert!(output.stdout.is_empty() && errors.is_empty(), "{errors}");

    // A single adapter does all by itself.
    let alone = done(
        1,
        &folder,
        &[&SOLVE[..], &ALL, &["--out", "alone.h5"]].concat(),
    );
    assert!(
        alone.contains("gpu on ") && !alone.contains("shards"),
        "{alone}"
    );
    same_results(&folder.join("one.h5"), &folder.join("alone.h5"));
}

#[test]
fn two_adapters_make_a_study() {
    let folder = scratch("adapters-study");
    let study = "study = { vary = { q = [1, 2, 3, 4, 5] }, from = { x = 0.5 }, samples = 4 }";
    std::fs::write(folder.join("scene.toml"), format!("{LINEAR}{study}\n")).unwrap();
    let study = ["study", "scene.toml", "--backend", "gpu"];
    done(
        2,
        &folder,
        &[&study[..], &["--adapter", "1", "--out", "one.h5"]].concat(),
    );
    // Into a folder that is made for it, beside no other.
    let all = [&study[..], &ALL, &["--out", "made/all.h5"]].concat();
    let said = done(2, &folder, &all);
    assert!(said.contains("2 of 2 shards"), "{said}");
    same_results(&folder.join("one.h5"), &folder.join("made/all.h5"));
    assert_eq!(entries(&folder.join("made")), ["all.h5"]);
}

/// Waits for something, for a minute at most.
#[track_caller]
fn wait_for(what: &str, mut is_there: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !is_there() {
        assert!(begun.elapsed() < Duration::from_secs(60), "{what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// The numbers of processes that were started for adapters in a folder, with their arguments.
#[cfg(target_os = "linux")]
fn processes(folder: &Path) -> Vec<(String, String)> {
    let here = folder.canonicalize().unwrap();
    let all = std::fs::read_dir("/proc").unwrap();
    let ours = all.filter_map(|entry| {
        // What has ended meanwhile is none.
        let process = entry.ok()?.path();
        let line = std::fs::read(process.join("cmdline")).ok()?;
        let line = String::from_utf8_lossy(&line).into_owned();
        let is_here = std::fs::read_link(process.join("cwd")).ok()? == here;
        let number = process.file_name()?.to_str()?.to_owned();
        (is_here && line.contains("--heed-input")).then_some((number, line))
    });
    ours.collect()
}

#[cfg(target_os = "linux")]
fn send(signal: &str, process: &str) {
    let sent = Command::new("kill").args(["-s", signal, process]).status();
    assert!(sent.unwrap().success());
}

/// A study of so many variants that it goes on for long, in a folder; how it is made.
#[cfg(target_os = "linux")]
fn long_study(name: &str) -> (PathBuf, Vec<&'static str>) {
    let folder = scratch(name);
    let values: Vec<String> = (0..400).map(|k| format!("{}", 1 + k)).collect();
    let study = format!(
        "study = {{ vary = {{ q = [{}] }}, from = {{ x = 0.5 }}, samples = 4 }}",
        values.join(", ")
    );
    std::fs::write(folder.join("scene.toml"), format!("{LINEAR}{study}\n")).unwrap();
    let study = ["study", "scene.toml", "--backend", "gpu"];
    let more = ["--out", "all.h5", "--checkpoint", "1"];
    (folder, [&study[..], &ALL, &more].concat())
}

/// A run with two adapters of which something is kept already.
#[cfg(target_os = "linux")]
fn at_work(folder: &Path, arguments: &[&str]) -> Child {
    let child = on(2, folder, arguments)
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let kept = |k: usize| folder.join(format!("all_adapters/part{k}.h5")).exists();
    wait_for("both begin", || {
        kept(0) && kept(1) && processes(folder).len() == 2
    });
    child
}

/// How many variants are kept that were solved.
#[cfg(target_os = "linux")]
fn variants(folder: &Path) -> usize {
    let of_part = |k: usize| {
        let stored = Stored::open(folder.join(format!("all_adapters/part{k}.h5"))).unwrap();
        let group = stored.group("study").unwrap();
        let mut meanings = group.meanings("status").into_iter();
        let (code, _) = meanings.find(|(_, name)| name == "converged").unwrap();
        let status = group.i32("status").unwrap().1;
        status.iter().filter(|status| **status == code).count()
    };
    of_part(0) + of_part(1)
}

/// A run that is asked to end keeps what is done, one that is killed what was kept by then, and
/// neither leaves a process.
#[cfg(target_os = "linux")]
#[test]
fn what_is_ended_leaves_its_parts() {
    let (folder, own) = long_study("adapters-ended");
    let child = at_work(&folder, &own);
    send("TERM", &child.id().to_string());
    let output = child.wait_with_output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(75), "{errors}");
    let said = "ended by SIGTERM before all was done; all_adapters has what was done by then";
    assert!(errors.contains(said), "{errors}");
    assert_eq!(errors.matches("SIGTERM").count(), 2, "{errors}");
    assert!(processes(&folder).is_empty());
    assert_eq!(entries(&folder), ["all_adapters", "loader", "scene.toml"]);
    assert_eq!(
        entries(&folder.join("all_adapters")),
        ["part0.h5", "part1.h5"]
    );
    let before = variants(&folder);
    assert!(before >= 2);

    // Of another scene nothing is gone on with, nor by other adapters, and nothing is lost.
    let resumed = [&own[..], &["--resume"]].concat();
    let (output, errors) = both(&folder, &[&resumed[..], &["--rtol", "1e-5"]].concat());
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert!(errors.contains("leave --resume out"), "{errors}");
    let output = on(1, &folder, &resumed).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert!(errors.contains("number of shards"), "{errors}");
    assert_eq!(variants(&folder), before);

    // Killed, it takes its processes with it.
    let mut child = at_work(&folder, &resumed);
    wait_for("more is kept", || variants(&folder) > before);
    child.kill().unwrap();
    child.wait().unwrap();
    wait_for("they end with what started them", || {
        processes(&folder).is_empty()
    });
    assert!(variants(&folder) > before);
    assert!(!folder.join("all.h5").exists());
}

/// Where one process fails, that is told, and the others end with what they have.
#[cfg(target_os = "linux")]
#[test]
fn a_process_that_fails_is_told() {
    let (folder, own) = long_study("adapters-failed");
    let child = at_work(&folder, &own);
    let (process, _) = (processes(&folder).into_iter())
        .find(|(_, line)| line.contains("part1.h5"))
        .unwrap();
    send("KILL", &process);
    let output = child.wait_with_output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{errors}");
    let said = [
        "error: adapter 1, ",
        "SIGKILL",
        "all_adapters has what was done",
    ];
    assert!(said.iter().all(|said| errors.contains(said)), "{errors}");
    assert!(processes(&folder).is_empty());
    assert!(!folder.join("all.h5").exists());
    assert!(variants(&folder) >= 2);
}

/// The same line leads to the result, however often it is ended, and one without `--resume` begins
/// anew.
#[test]
fn what_was_ended_is_gone_on_with() {
    let folder = solved_by_one("adapters-resumed");
    let own = [&SOLVE[..], &ALL, &["--out", "all.h5"]].concat();
    std::fs::create_dir(folder.join("all_adapters")).unwrap();
    std::fs::write(folder.join("all_adapters/part7.h5"), "of another run").unwrap();
    let clock = Instant::now();
    let (output, errors) = both(&folder, &own);
    let seconds = clock.elapsed().as_secs_f64();
    assert_eq!(output.status.code(), Some(0), "{errors}");
    assert!(
        errors.contains("all_adapters, which an earlier run"),
        "{errors}"
    );
    same_results(&folder.join("one.h5"), &folder.join("all.h5"));
    let left = ["all.h5", "loader", "one.h5", "scene.toml", "states.csv"];
    assert_eq!(entries(&folder), left);

    std::fs::remove_file(folder.join("all.h5")).unwrap();
    for times in 1.. {
        let limit = format!("{:?}", 0.2 * f64::from(times) * seconds);
        let own = [&own[..], &["--resume", "--time-limit", &limit]].concat();
        let (output, errors) = both(&folder, &own);
        match output.status.code() {
            Some(0) => break,
            Some(75) => assert!(times < 40, "{errors}"),
            _ => panic!("{errors}"),
        }
        assert!(
            errors.contains(&format!("ended by --time-limit {limit}")),
            "{errors}"
        );
        assert!(!folder.join("all.h5").exists());
    }
    same_results(&folder.join("one.h5"), &folder.join("all.h5"));
    assert_eq!(entries(&folder), left);
}

#[test]
fn what_is_not_divided_among_adapters_is_refused() {
    let folder = linear("adapters-refused");
    let mapped = format!("{LINEAR}map = {{ error = 1e-3 }}\n");
    std::fs::write(folder.join("mapped.toml"), mapped).unwrap();
    let before = entries(&folder);
    let refused = |arguments: &[&str], variables: &[(&str, &str)], why: &str| {
        let mut command = command(&folder, arguments);
        let output = command.args(ALL).envs(variables.iter().copied()).output();
        let output = output.unwrap();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {errors}");
        assert!(errors.contains(why), "{why}: {errors}");
        assert_eq!(entries(&folder), before, "{arguments:?}");
    };
    let elsewhere = "solve, homotopy, map and study";
    for other in ["run", "shoot-out", "simulate", "bench"] {
        refused(&[other, "scene.toml"], &[], elsewhere);
    }
    let by_number = "--adapter K";
    refused(&[&SOLVE[..], &["--shard", "1/2"]].concat(), &[], by_number);
    let task = [
        ("SLURM_ARRAY_TASK_ID", "1"),
        ("SLURM_ARRAY_TASK_COUNT", "2"),
        ("SLURM_ARRAY_TASK_MIN", "0"),
    ];
    refused(&SOLVE, &task, by_number);
    let solve = &SOLVE[..4];
    refused(
        &[solve, &["--backend", "cpu"]].concat(),
        &[],
        "the CPU is asked for",
    );
    refused(&[solve, &["--out", "a.csv"]].concat(), &[], "result file");
    refused(
        &["map", "mapped.toml"],
        &[],
        "a map to an error is not divided",
    );
    refused(&["study", "scene.toml"], &[], "[study]");
    refused(
        &["solve", "scene.toml", "--points", "/dev/null"],
        &[],
        "must be a file",
    );
    refused(
        &["solve", "scene.toml", "--points", "none.csv"],
        &[],
        "none.csv",
    );
}
