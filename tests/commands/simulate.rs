//! `costate simulate`: what it prints, writes and refuses.

use crate::common_commands::{in_schema, scratch};
use costate::Stored;
use std::path::Path;
use std::process::{Command, Output};

const BALL: &str = r#"
title = "Ball"
states = { h = { unit = "m" }, v = {} }
controls = { u = {} }
dynamics = { h = "v", v = "-9.81 + u" }
cost = { running = "u^2", terminal = "0", final_time = 1 }
region = { h = [0, 2], v = [-5, 5] }
guards = { fast = "v > -6" }
[events.floor]
when = "h <= 0"
set = { v = "-0.5*v" }
[events.ceiling]
when = "h >= 3"
ends = true
[simulation]
initial = { h = [0.5, 1, 2], v = 0 }
samples = 4
"#;

fn costate(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_costate"))
        .current_dir(folder)
        .args(arguments)
        .output()
        .unwrap()
}

fn written(name: &str, scene: &str) -> std::path::PathBuf {
    let folder = scratch(name);
    std::fs::write(folder.join("ball.toml"), scene).unwrap();
    folder
}

fn json(done: &Output) -> serde_json::Value {
    assert!(
        done.status.success(),
        "{}",
        String::from_utf8_lossy(&done.stderr)
    );
    serde_json::from_slice(&done.stdout).unwrap()
}

#[test]
fn flights_are_printed_and_written() {
    let folder = written("simulate", BALL);
    let done = costate(&folder, &["simulate", "ball.toml", "--backend", "cpu"]);
    assert!(
        done.status.success(),
        "{}",
        String::from_utf8_lossy(&done.stderr)
    );
    let text = String::from_utf8_lossy(&done.stdout);
    for words in [
        "2 flights simulated",
        "time: 1, zeno: 1",
        "flight 2",
        "floor",
        "after it",
        "ends: time",
    ] {
        assert!(text.contains(words), "{words}: {text}");
    }
    let path = folder.join("out/ball_simulation.h5");
    in_schema(&path);
    let stored = Stored::open(&path).unwrap();
    assert_eq!(stored.scene.model.title, "Ball");
    let page = reported(&folder, "ball");
    for words in [
        "Simulated flights",
        "Events of the flights",
        "<td>event floor</td>",
    ] {
        assert!(page.contains(words), "{words}");
    }

    // From the scene's states, and from others: up to the ceiling, and down past the guard.
    let arguments = [
        "simulate",
        "ball.toml",
        "--at",
        "h=1,v=8",
        "--at",
        "h=2",
        "--json",
    ];
    let all = json(&costate(&folder, &arguments));
    let flights = all["flights"].as_array().unwrap();
    assert_eq!(flights[0]["status"], "event_ceiling");
    assert_eq!(flights[1]["status"], "guard_fast");
    let number = |v: &serde_json::Value| v.as_f64().unwrap();
    // 1 + 8 t - g t^2/2 = 3; v = -6 where h = 2 - 36/(2 g).
    let t = (8.0 - (64.0f64 - 4.0 * 9.81).sqrt()) / 9.81;
    assert!((number(&flights[0]["t_end"]) - t).abs() < 1e-9);
    assert!((number(&flights[1]["x_end"]["h"]) - (2.0 - 18.0 / 9.81)).abs() < 1e-9);
    assert_eq!(all["status"]["guard_fast"], 1);

    // What else is asked of its file has a clear answer.
    let value = costate(&folder, &["value", "out/ball_simulation.h5", "--at", "h=1"]);
    assert!([Some(1), Some(2)].contains(&value.status.code()));
    assert!(!String::from_utf8_lossy(&value.stderr).contains("panicked"));
    let page = reported(&folder, "ball");
    for words in ["<td>event ceiling</td>", "<td>guard fast</td>"] {
        assert!(page.contains(words), "{words}");
    }
    // These flights have no events.
    assert!(!page.contains("Events of the flights"));
}

/// The page of a simulation.
fn reported(folder: &Path, scene: &str) -> String {
    let report = costate(folder, &["report", &format!("out/{scene}_simulation.h5")]);
    let errors = String::from_utf8_lossy(&report.stderr);
    assert!(report.status.success(), "{errors}");
    let page = folder.join(format!("out/{scene}_simulation_report.html"));
    std::fs::read_to_string(page).unwrap()
}

#[test]
fn an_orbit_is_found_and_written() {
    let scene = format!("{}/scenarios/compass_gait.toml", crate::ROOT);
    let folder = scratch("simulate_gait");
    let all = json(&costate(
        &folder,
        &["simulate", &scene, "--json", "--events", "2"],
    ));
    let cycle = &all["cycles"][0];
    assert!((cycle["period"].as_f64().unwrap() - 0.73434639116).abs() < 1e-9);
    assert_eq!(cycle["stable"], true);
    in_schema(&folder.join("out/compass_gait_simulation.h5"));
    assert_eq!(all["flights"][0]["events"].as_array().unwrap().len(), 2);
    // An orbit that is not there is said, and flights begin where they were to.
    let none = json(&costate(
        &folder,
        &[
            "simulate",
            &scene,
            "--json",
            "--events",
            "2",
            "--at",
            "stance_rate=5",
        ],
    ));
    assert!(
        none["cycles"][0]["none"]
            .as_str()
            .unwrap()
            .contains("does not come back")
    );
    assert_eq!(none["flights"][0]["x0"]["stance_rate"], 5.0);
    // Flights keep the numbers of their states.
    let guess = [
        "--at",
        "stance_rate=5",
        "--at",
        "stance=-1.3,swing=-1.84,stance_rate=-1.09,swing_rate=-0.38",
    ];
    let both = json(&costate(
        &folder,
        &[&["simulate", &scene, "--json", "--events", "2"], &guess[..]].concat(),
    ));
    assert_eq!(both["flights"][0]["x0"]["stance_rate"], 5.0);
    assert!(both["cycles"][0]["none"].is_string());
    assert_eq!(both["flights"][1]["x0"], both["cycles"][1]["x"]);
    let page = reported(&folder, "compass_gait");
    for words in [
        "Orbits",
        "<td>no return</td>",
        "<td>found</td>",
        "multiplier re 1",
    ] {
        assert!(page.contains(words), "{words}");
    }
}

#[test]
fn what_cannot_be_simulated_is_refused() {
    let folder = written("simulate_refused", BALL);
    let refused = |arguments: &[&str], words: &str| {
        let all = [&["simulate", "ball.toml"], arguments].concat();
        let done = costate(&folder, &all);
        let text = String::from_utf8_lossy(&done.stderr);
        assert_eq!(done.status.code(), Some(2), "{arguments:?}: {text}");
        assert!(text.contains(words), "{arguments:?}: {text}");
    };
    refused(&["--law", "lqr"], "the horizon is finite");
    refused(&["--law", "map"], "costate evaluate");
    refused(&["--time", "0"], "above 0");
    refused(&["--events", "0"], "events");
    refused(&["--at", "height=1"], "is not a state");
    refused(&["--at", "h=nan"], "not a finite number");
    refused(&["--weights", "none.toml"], "none.toml");
    refused(&["--out", "ball.toml"], "ball.toml");
    refused(&["--points", "none.csv"], "none.csv");
    assert!(!folder.join("out").exists(), "nothing is written");
}

#[cfg(unix)]
#[test]
fn a_signal_leaves_nothing() {
    // Bounces without end.
    let scene = BALL
        .replace("-0.5*v", "-v")
        .replace("h = [0.5, 1, 2]", "h = [0.5, 1, 400]");
    let folder = written("simulate_signal", &scene);
    let mut child = Command::new(env!("CARGO_BIN_EXE_costate"))
        .current_dir(&folder)
        .args([
            "simulate",
            "ball.toml",
            "--time",
            "100000",
            "--events",
            "1000000",
        ])
        .stdout(std::process::Stdio::null())
        .spawn()
        .unwrap();
    while !folder.join("out").exists() {
        assert!(child.try_wait().unwrap().is_none(), "it ended by itself");
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    std::thread::sleep(std::time::Duration::from_millis(200));
    let id = child.id().to_string();
    assert!(
        Command::new("kill")
            .args(["-TERM", &id])
            .status()
            .unwrap()
            .success()
    );
    assert_eq!(child.wait().unwrap().code(), Some(75));
    let left: Vec<_> = match std::fs::read_dir(folder.join("out")) {
        Ok(entries) => entries.map(|e| e.unwrap().file_name()).collect(),
        Err(_) => Vec::new(),
    };
    assert!(left.is_empty(), "{left:?}");
}

#[test]
fn a_contact_that_does_not_hold_is_said() {
    let scene = r#"
[mechanism]
gravity = [0, -9.81]
[mechanism.bodies]
crank = { joint = "revolute", mass = 1, shape = { rod = 0.5 } }
coupler = { joint = "revolute", parent = "crank", at = [0.5, 0], mass = 1, shape = { rod = 1.0 } }
rocker = { joint = "revolute", at = [1, 0], mass = 1, shape = { rod = 0.5 } }
[mechanism.points]
end = { body = "coupler", at = [1, 0] }
top = { body = "rocker", at = [0.5, 0] }
[mechanism.contacts]
end = { with = "top" }
[mechanism.forces]
crank = "u"
[controls]
u = {}
[cost]
running = "u^2"
terminal = "0"
final_time = 0.1
[region]
crank = [-3, 3]
coupler = [-3, 3]
rocker = [-3, 3]
crank_rate = [-3, 3]
coupler_rate = [-3, 3]
rocker_rate = [-3, 3]
"#;
    let folder = written("simulate_open", scene);
    let said = |at: &str| {
        let done = costate(&folder, &["simulate", "ball.toml", "--at", at]);
        assert!(done.status.success());
        String::from_utf8_lossy(&done.stderr).into_owned()
    };
    // A parallelogram, upright; the same with a rocker that leans, or moves alone.
    let upright = "crank=1.5707963267948966,coupler=-1.5707963267948966,rocker=1.5707963267948966";
    assert!(!said(upright).contains("does not hold"));
    let leaning = upright.replace("rocker=1.57", "rocker=1.27");
    let text = said(&leaning);
    assert!(
        text.contains("contact `end` does not hold: its points are apart by"),
        "{text}"
    );
    let text = said(&format!("{upright},rocker_rate=1"));
    assert!(text.contains("its point moves at"), "{text}");
}
