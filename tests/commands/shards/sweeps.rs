//! Sweeps by parts of the surface of seeds.

use super::{done, entries, merged, refused, run, shards};
use crate::common_commands::{scenario, scratch};
use costate::low_level::result::Stored;
use std::collections::BTreeMap;
use std::path::Path;

/// Three states on a sphere of seeds, of which a guard cuts off a part; every trajectory is reported
/// by one part, whose neighbours lie in others.
const GUARDED: &str = r#"
title = "part of a sphere"
states = { x = {}, v = {}, z = {} }
controls = { u = { min = -1, max = 1 }, w = {} }
dynamics = { x = "v", v = "-x + x^3/6 + u", z = "0.3*z + w + 0.2*x*v" }
cost = { running = "0.5*(x^2 + v^2 + z^2 + u^2 + w^2)" }
equilibrium = { x = 0, v = 0, z = 0, u = 0, w = 0 }
region = { x = [-2, 2], v = [-2, 2], z = [-2, 2] }
guards = { above = "z > -0.02 - 0.1*x" }
shoot_out = { value_max = 2, spacing = 0.1, samples = 24 }
"#;

/// A box of seeds (a finite horizon), where the Hopf-Lax formula knows V.
const BOX: &str = r#"
title = "box of seeds"
states = { x = {}, y = {} }
controls = { u = {}, w = {} }
dynamics = { x = "u", y = "w" }
cost = { running = "0.5*(u^2 + w^2)", terminal = "cos(3*x) + 0.5*y^2*(1 + x)", final_time = 0.5 }
region = { x = [-1, 1], y = [-1, 1] }
shoot_out = { spacing = 0.05, samples = 12 }
"#;

/// The rows of `/trajectories` by their bits, and how often each is there.
fn trajectories(path: &Path) -> (Vec<String>, BTreeMap<Vec<u64>, usize>) {
    let stored = Stored::open(path).unwrap();
    let group = stored.group("trajectories").unwrap();
    let count = group.i32("status").unwrap().1.len();
    let mut names = group.names();
    names.sort();
    let mut rows = vec![Vec::new(); count];
    // Their numbers are other ones: they come in the order of the parts.
    for name in names.iter().filter(|name| *name != "trajectory") {
        let Ok(column) = group.f64(name) else {
            continue;
        };
        if column.shape.first() == Some(&count) && !column.values.is_empty() {
            let width = column.values.len() / count;
            for (row, values) in rows.iter_mut().zip(column.values.chunks_exact(width)) {
                row.extend(values.iter().map(|x| x.to_bits()));
            }
        }
    }
    let mut times = BTreeMap::new();
    for row in rows {
        *times.entry(row).or_insert(0) += 1;
    }
    (names, times)
}

/// What a summary tells but clocks, the file's name, and what a sample is drawn for.
fn told(path: &Path) -> serde_json::Value {
    let summary = Stored::open(path).unwrap().run_summary().unwrap().unwrap();
    let mut told = serde_json::to_value(&summary).unwrap();
    for name in [
        "file",
        "error_estimate",
        "hamiltonian_relative",
        "integrate_seconds",
        "wall_seconds",
        "trajectories_per_second",
        "rounds",
        "stiffness",
        "trajectories_borrowed",
    ] {
        told.as_object_mut().unwrap().remove(name);
    }
    // The quantiles of each part where |H| is not stored.
    told["hamiltonian"] = told["hamiltonian"]["max"].clone();
    told
}

/// Parts of a sweep have the trajectories of one run, each once, to the last bit.
#[test]
fn parts_of_a_sweep_are_the_sweep() {
    let pendulum = std::fs::read_to_string(scenario("pendulum")).unwrap();
    let folding = std::fs::read_to_string(scenario("folding_game")).unwrap();
    for (name, text, of, more) in [
        ("guarded", GUARDED, 3, &[][..]),
        ("box", BOX, 4, &["--values-only"][..]),
        // More parts than there are simplices.
        ("pendulum", &pendulum, 70, &["--precision", "f32"][..]),
        ("folding", &folding, 2, &[][..]),
    ] {
        let folder = scratch(&format!("shards_sweep_{name}"));
        std::fs::write(folder.join("scene.toml"), text).unwrap();
        let command = ["shoot-out", "scene.toml", "--backend", "cpu"];
        let command = [&command, more].concat();
        done(&folder, &[&command[..], &["--out", "one.h5"]].concat());
        let one = folder.join("one.h5");

        let all = merged(&folder, &shards(&folder, &command, of), &[]);
        let (names, rows) = trajectories(&one);
        assert!(
            names.contains(&"x".to_owned()) && rows.len() > 100,
            "{name}"
        );
        assert!((names, rows) == trajectories(&all), "{name}");
        assert_eq!(told(&one), told(&all), "{name}");

        // Folds are of trajectories of the whole.
        let folds = |path: &Path| {
            let stored = Stored::open(path).unwrap();
            let group = stored.group("caustic")?;
            let of = group.i32("trajectory").unwrap().1;
            let x = group.f64("x").unwrap().values;
            let swept = stored.trajectories().unwrap().unwrap();
            let (n, samples) = (2, swept.samples);
            let ends = of.iter().map(|k| {
                let own = &swept.x[*k as usize * samples * n..][..samples * n];
                own.iter().rev().copied().find(|x| !x.is_nan()).unwrap()
            });
            let mut ends: Vec<[u64; 2]> = (ends.zip(x.chunks_exact(n)))
                .map(|(end, fold)| [end.to_bits(), fold[0].to_bits()])
                .collect();
            ends.sort_unstable();
            Some(ends)
        };
        assert_eq!(folds(&one).is_some(), name == "folding");
        assert_eq!(folds(&one), folds(&all), "{name}");
    }
}

/// What is not there is named, and a sweep that was made is not made again.
#[test]
fn parts_of_a_sweep_that_are_missing_are_named() {
    let folder = scratch("shards_sweep_missing");
    std::fs::write(folder.join("scene.toml"), BOX).unwrap();
    let command = ["shoot-out", "scene.toml", "--backend", "cpu"];
    let parts = shards(&folder, &command, 3);
    let errors = refused(
        &folder,
        &["merge", &parts[0], &parts[2], "--out", "all.h5"],
        "all.h5",
    );
    assert!(errors.contains("of 3 shards one is missing: 1"), "{errors}");
    let (output, errors) = run(
        &folder,
        &[
            "merge",
            &parts[0],
            &parts[2],
            "--out",
            "some.h5",
            "--partial",
        ],
    );
    assert_eq!(output.status.code(), Some(75), "{errors}");
    let some = Stored::open(folder.join("some.h5")).unwrap();
    assert_eq!(some.attribute("shards_missing").as_deref(), Some("1"));
    assert!(some.has_attribute("stopped"));
    let count = |part: &String| {
        let stored = Stored::open(folder.join(part)).unwrap();
        stored.trajectories().unwrap().unwrap().count
    };
    let merged = some.trajectories().unwrap().unwrap().count;
    assert_eq!(merged, count(&parts[0]) + count(&parts[2]));

    // The same part again: it is there. Another sweep: it is refused.
    let own = ["--out", "p1.h5", "--shard", "1/3", "--resume"];
    let before = std::fs::read(folder.join("p1.h5")).unwrap();
    let (output, errors) = run(&folder, &[&command[..], &own].concat());
    assert_eq!(output.status.code(), Some(0), "{errors}");
    assert!(errors.contains("nothing is left to do"), "{errors}");
    assert!(before == std::fs::read(folder.join("p1.h5")).unwrap());
    let (output, errors) = run(&folder, &[&command[..], &own, &["--values-only"]].concat());
    assert_eq!(output.status.code(), Some(2), "{errors}");
    let names = ["p0.h5", "p1.h5", "p2.h5", "scene.toml", "some.h5"];
    assert_eq!(entries(&folder), names);
}

/// `max_seeds` counts for each part: parts of a sweep that it does not end are the sweep, wherever the
/// seeds lie; where it ends one, that is said.
#[test]
fn parts_of_a_sweep_each_have_the_cap() {
    let folder = scratch("shards_sweep_cap");
    // Nearly all seeds lie in one corner.
    let text = BOX
        .replace(
            "cos(3*x) + 0.5*y^2*(1 + x)",
            "exp(-60*((x - 0.7)^2 + (y - 0.7)^2))*cos(12*x) + 0.05*(x^2 + y^2)",
        )
        .replace("spacing = 0.05", "spacing = 0.1, max_seeds = 4000");
    std::fs::write(folder.join("scene.toml"), text).unwrap();
    let command = ["shoot-out", "scene.toml", "--backend", "cpu"];
    done(&folder, &[&command[..], &["--out", "one.h5"]].concat());
    let all = merged(&folder, &shards(&folder, &command, 8), &[]);
    let (_, rows) = trajectories(&all);
    assert!((2000..4000).contains(&rows.len()), "{}", rows.len());
    assert_eq!(told(&folder.join("one.h5")), told(&all));

    let text = BOX.replace("spacing = 0.05", "spacing = 0.01, max_seeds = 501");
    std::fs::write(folder.join("scene.toml"), text).unwrap();
    let own = ["--out", "p.h5", "--shard", "0/2"];
    let told = done(&folder, &[&command[..], &own].concat());
    assert!(told.contains("max_seeds = 501 for each shard"), "{told}");
    let parts = shards(&folder, &command, 2);
    let all = Stored::open(merged(&folder, &parts, &[])).unwrap();
    let summary = all.run_summary().unwrap().unwrap();
    assert_eq!(summary.trajectories, 1002);
    assert!(summary.coverage.gaps_for_want_of_seeds > 0);
}

/// What is no sweep is refused: seeds that guards exclude, all of them, and a part in place of all.
#[test]
fn parts_of_nothing_and_parts_for_all_are_refused() {
    let folder = scratch("shards_sweep_nothing");
    let text = format!("{BOX}guards = {{ far = \"x > 50\" }}\n");
    std::fs::write(folder.join("scene.toml"), text).unwrap();
    let command = ["shoot-out", "scene.toml", "--backend", "cpu"];
    let parts = shards(&folder, &command, 2);
    let merge = ["merge", &parts[0], &parts[1], "--out", "all.h5"];
    let (output, errors) = run(&folder, &merge);
    assert_eq!(output.status.code(), Some(1), "{errors}");
    assert!(errors.contains("seeds lie outside the guards"), "{errors}");
    assert!(!folder.join("all.h5").exists());

    std::fs::write(folder.join("scene.toml"), BOX).unwrap();
    std::fs::write(folder.join("q.csv"), "x,y\n0.1,0.2\n").unwrap();
    let parts = shards(&folder, &command, 2);
    let solve = [
        "solve",
        "scene.toml",
        "--points",
        "q.csv",
        "--backend",
        "cpu",
    ];
    let from = ["--archive", &parts[0], "--out", "solved.h5"];
    let errors = refused(&folder, &[&solve[..], &from].concat(), "solved.h5");
    assert!(errors.contains("one shard's part"), "{errors}");

    // The whole is done, whoever has made it.
    let all = merged(&folder, &parts, &[]);
    let again = ["--out", "all.h5", "--resume"];
    let before = std::fs::read(&all).unwrap();
    let (output, errors) = run(&folder, &[&command[..], &again].concat());
    assert_eq!(output.status.code(), Some(0), "{errors}");
    assert!(errors.contains("nothing is left to do"), "{errors}");
    assert!(before == std::fs::read(&all).unwrap());

    std::fs::write(folder.join("scene.toml"), GUARDED).unwrap();
    let parts = shards(&folder, &command, 2);
    let mut known = 0;
    for (k, part) in parts.iter().enumerate() {
        let at = ["--at", "x=0.3,v=0.3,z=0.3"];
        let (output, errors) = run(&folder, &[&["value", part.as_str()], &at[..]].concat());
        assert!(errors.contains(&format!("is shard {k} of 2")), "{errors}");
        let text = String::from_utf8_lossy(&output.stdout);
        if text.contains("V =") {
            let said = "parts of the sweep are not in the file";
            assert!(text.contains(said), "{text}");
            known += 1;
        }
    }
    assert!(known > 0);
}
