//! What a command leaves that is ended early, and what is said of its file afterwards.

use crate::common_commands::{in_schema, scratch};
use std::path::Path;
use std::process::{Command, Output};
use std::time::{Duration, Instant};

const SCENE: &str = r#"
states = { x = {}, v = {} }
controls = { u = {} }
parameters = { q = 1 }
dynamics = { x = "v", v = "-q*x + u" }
cost = { running = "0.5*(x^2 + v^2 + u^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-1, 1], v = [-1, 1] }
"#;

fn command(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_costate"));
    command.current_dir(folder).args(arguments);
    command
}

fn done(folder: &Path, arguments: &[&str]) -> (Output, String) {
    let done = command(folder, arguments).output().unwrap();
    let errors = String::from_utf8_lossy(&done.stderr).into_owned();
    (done, errors)
}

fn entries(folder: &Path) -> Vec<String> {
    let names = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<String> = names
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

/// Its file has the name of what is unfinished and says so, to programs and on its page.
#[test]
fn a_study_leaves_an_older_result() {
    let folder = scratch("ended-study");
    let study = "study = { vary = { q = [1, 2, 3, 4] }, from = { x = 0.5 } }";
    std::fs::write(folder.join("scene.toml"), format!("{SCENE}{study}\n")).unwrap();
    std::fs::write(folder.join("out.h5"), "older").unwrap();
    let limited = ["study", "scene.toml", "--out", "out.h5", "--time-limit"];
    let limited = [&limited[..], &["1e-3", "--backend", "cpu"]].concat();
    for round in 0..2 {
        let (output, errors) = done(&folder, &limited);
        assert_eq!(output.status.code(), Some(75), "{errors}");
        assert!(errors.contains("before all was done; out_stopped.h5 has"));
        let replaced = "out_stopped.h5, which an earlier run that was ended early has left";
        assert_eq!(errors.contains(replaced), round == 1, "{errors}");
        assert_eq!(std::fs::read(folder.join("out.h5")).unwrap(), b"older");
    }
    let path = folder.join("out_stopped.h5");
    in_schema(&path);
    let stored = costate::Stored::open(&path).unwrap();
    assert!(stored.has_attribute("stopped"));
    let summary = stored.run_summary().unwrap().unwrap();
    assert!(summary.stopped && summary.study.unwrap().len() == 4);
    drop(stored);

    let (output, errors) = done(&folder, &["report", "out_stopped.h5", "--out", "p.html"]);
    assert!(output.status.success(), "{errors}");
    let page = std::fs::read_to_string(folder.join("p.html")).unwrap();
    let told = "<dt>Ended early</dt><dd>before any of the 4 variants was done";
    assert!(page.contains(told), "{page}");
    assert_eq!(page.matches("<td>out of time</td>").count(), 4, "{page}");
}

/// A study that is not ended early has a summary, too.
#[test]
fn a_study_has_a_summary() {
    let folder = scratch("whole-study");
    let study = "study = { vary = { q = [1, 2] }, from = { x = 0.5 } }";
    std::fs::write(folder.join("scene.toml"), format!("{SCENE}{study}\n")).unwrap();
    let (output, errors) = done(&folder, &["study", "scene.toml", "--backend", "cpu"]);
    assert!(output.status.success(), "{errors}");
    let stored = costate::Stored::open(folder.join("out/scene_study.h5")).unwrap();
    let summary = stored.run_summary().unwrap().unwrap();
    assert!(!summary.stopped && stored.ended_early().is_none());
    assert_eq!(summary.study.unwrap().len(), 2);
}

/// Of two laws the second, which is large, has no end: the first one is kept, files of older laws
/// stay, and the time is kept to, though one step of the training of so many weights is long.
#[test]
fn laws_that_were_fitted_are_kept() {
    const LIMIT: f64 = 8.0;
    let folder = scratch("ended-laws");
    let laws = "[shoot_out]\nvalue_max = 1.0\nspacing = 0.05\nsamples = 100\n\
        [feedback.small]\nfit = \"u\"\nhidden = [2]\nstarts = 1\niterations = 3\n\
        [feedback.large]\nfit = \"u\"\nhidden = [40, 40]\niterations = 1000000\npatience = 1000000\n";
    std::fs::write(folder.join("scene.toml"), format!("{SCENE}{laws}")).unwrap();
    for older in ["out.h5", "out_small.toml", "out_large.h"] {
        std::fs::write(folder.join(older), "older").unwrap();
    }
    let began = Instant::now();
    let limit = LIMIT.to_string();
    let run = ["run", "scene.toml", "--out", "out.h5", "--backend", "cpu"];
    let (output, errors) = done(&folder, &[&run[..], &["--time-limit", &limit]].concat());
    let took = began.elapsed().as_secs_f64();
    assert_eq!(output.status.code(), Some(75), "{errors}");
    // A second on an idle machine; tests run beside others.
    assert!(took < LIMIT + 5.0, "{took} s: {errors}");
    assert!(errors.contains("law large was not fitted"), "{errors}");
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(
        said.contains("law small: written to out_stopped_small.toml, out_stopped_small.h"),
        "{said}"
    );
    for older in ["out.h5", "out_small.toml", "out_large.h"] {
        assert_eq!(std::fs::read(folder.join(older)).unwrap(), b"older");
    }
    let there = entries(&folder);
    assert!(!there.iter().any(|n| n.contains("stopped_large")));
    let stored = costate::Stored::open(folder.join("out_stopped.h5")).unwrap();
    let kept = costate::run::fitted_laws(&stored).unwrap();
    assert_eq!(kept.len(), 1, "{there:?}");
    assert_eq!(kept[0].name, "small");
    drop(stored);

    // `fit` for itself: laws that the file has stay as they are, until all new ones are done.
    let fit = [
        "fit",
        "out_stopped.h5",
        "--out-dir",
        "again",
        "--time-limit",
    ];
    let before = std::fs::read(folder.join("out_stopped.h5")).unwrap();
    let (output, errors) = done(&folder, &[&fit[..], &["4"]].concat());
    assert_eq!(output.status.code(), Some(75), "{errors}");
    let told = "ended by --time-limit 4: law large is not done, and out_stopped.h5 has laws already: nothing is written";
    assert!(errors.contains(told), "{errors}");
    let after = std::fs::read(folder.join("out_stopped.h5")).unwrap();
    assert!(before == after && !folder.join("again").exists());

    // Where the file has none those that are done are kept.
    let sweep = [
        "shoot-out",
        "scene.toml",
        "--out",
        "swept.h5",
        "--backend",
        "cpu",
    ];
    let (output, errors) = done(&folder, &sweep);
    assert!(output.status.success(), "{errors}");
    let (output, errors) = done(&folder, &["fit", "swept.h5", "--time-limit", "4"]);
    assert_eq!(output.status.code(), Some(75), "{errors}");
    assert!(
        errors.contains("swept.h5 has what was done by then"),
        "{errors}"
    );
    let stored = costate::Stored::open(folder.join("swept.h5")).unwrap();
    let kept = costate::run::fitted_laws(&stored).unwrap();
    assert!(kept.len() == 1 && kept[0].name == "small");
    assert!(folder.join("swept_small.h").exists() && !folder.join("swept_large.h").exists());
    drop(stored);

    // Without an older result the file has its usual name, but older laws are not replaced.
    std::fs::remove_file(folder.join("out.h5")).unwrap();
    let (output, errors) = done(&folder, &[&run[..], &["--time-limit", &limit]].concat());
    assert_eq!(output.status.code(), Some(75), "{errors}");
    assert!(costate::Stored::open(folder.join("out.h5")).is_ok());
    assert_eq!(
        std::fs::read(folder.join("out_small.toml")).unwrap(),
        b"older"
    );

    let export = ["export", "out.h5", "--law", "--out", "law.h"];
    let (output, errors) = done(&folder, &export);
    assert!(output.status.success(), "{errors}");
    let told = "note: out.h5: its run was ended after everything was solved";
    assert!(errors.contains(told), "{errors}");
}

/// Commands that read a file of a run that was ended early say so.
#[test]
fn what_reads_such_a_file_says_so() {
    let folder = scratch("ended-read");
    let more = "map = { resolution = 60 }\nclosed_loop = { final_time = 5, initial = { x = 0.5 }, laws = [\"lqr\"] }\n";
    let scene = format!("{SCENE}{more}").replace("-q*x + u", "-sin(9*x) + u");
    std::fs::write(folder.join("scene.toml"), scene).unwrap();
    let limited = ["homotopy", "scene.toml", "--out", "o.h5", "--time-limit"];
    let (output, errors) = done(&folder, &[&limited[..], &["1e-3"]].concat());
    assert_eq!(output.status.code(), Some(75), "{errors}");
    let told = "note: o.h5: its run was ended before everything was swept and solved";
    for reads in [
        &["value", "o.h5", "--at", "x=0.5"][..],
        &["check-least", "o.h5"],
        &["evaluate", "o.h5", "--out", "e.h5"],
        &["export", "o.h5"],
    ] {
        let (_, errors) = done(&folder, reads);
        assert_eq!(errors.matches(told).count(), 1, "{reads:?}: {errors}");
        let (_, errors) = done(&folder, &[reads, &["--quiet"]].concat());
        assert!(!errors.contains(told), "{reads:?}: {errors}");
    }
}

/// A part of a search shows nothing: nothing is left, not even the directory made for its file.
#[cfg(unix)]
#[test]
fn a_signal_ends_a_search_with_nothing() {
    let folder = scratch("ended-search");
    let game = Path::new(crate::ROOT).join("scenarios/linear_game.toml");
    let scene = std::fs::read_to_string(game).unwrap().replace(
        "[attenuation]",
        "[attenuation]\ntolerance = 1e-6\nstates = { x = [-1, 1, 60], v = [-1, 1, 60] }",
    );
    std::fs::write(folder.join("scene.toml"), scene).unwrap();
    let search = ["attenuation", "scene.toml", "--backend", "cpu", "--quiet"];
    let mut child = command(&folder, &search).spawn().unwrap();
    let began = Instant::now();
    let begun = || folder.join("out").is_dir() && !entries(&folder.join("out")).is_empty();
    while !begun() {
        assert!(began.elapsed() < Duration::from_secs(60), "nothing begins");
        std::thread::sleep(Duration::from_millis(5));
    }
    // The hidden file is there a little before signals are heard.
    std::thread::sleep(Duration::from_millis(300));
    assert!(child.try_wait().unwrap().is_none(), "it ended by itself");
    let id = child.id().to_string();
    let sent = Command::new("kill").args(["-s", "TERM", &id]).status();
    assert!(sent.unwrap().success());
    let status = child.wait().unwrap();
    assert_eq!(status.code(), Some(75), "{status}");
    assert_eq!(entries(&folder), ["scene.toml"]);
}
