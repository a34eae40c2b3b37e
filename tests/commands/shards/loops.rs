//! Closed loops in shards.

use super::{done, entries, merged, refused, run};
use crate::common_commands::scratch;
use costate::low_level::result::Stored;
use std::path::Path;

/// Guards end some loops early; one law comes from a map in the result file.
const SCENE: &str = r#"
title = "loops"
states = { x = {}, v = {} }
controls = { u = { min = -2, max = 2 } }
dynamics = { x = "v", v = "-x + x^3/6 + u" }
cost = { running = "0.5*(x^2 + v^2 + u^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-1, 1], v = [-1, 1] }
map = { error = 1e-2, states = 200, check = 20 }
guards.slow = "v < 0.9"

[closed_loop]
laws = ["lqr", "map", "soft"]
final_time = 8
samples = 40
initial = { x = [-1, 1, 9], v = [-0.95, 0.95, 7] }
law.soft = { u = "-0.2*x - 0.3*v" }
record = { most = "max(u)", last = "final(x)" }
sets = { gentle = "most <= 0.5" }
"#;

const GROUPS: [&str; 5] = [
    "closed_loop",
    "closed_loop_laws",
    "closed_loop_trajectories",
    "operating_sets",
    "operating_contours",
];

/// Fails where closed loops differ in any number but the clock's.
#[track_caller]
fn same_loops(a: &Path, b: &Path) {
    let (a, b) = (Stored::open(a).unwrap(), Stored::open(b).unwrap());
    for name in GROUPS {
        let (one, other) = (a.group(name).unwrap(), b.group(name).unwrap());
        for own in one
            .names()
            .iter()
            .filter(|n| !["seconds", "rate"].contains(&n.as_str()))
        {
            match (one.f64(own), other.f64(own)) {
                (Ok(x), Ok(y)) => {
                    assert_eq!(x.shape, y.shape, "/{name}/{own}");
                    let bits = |x: &[f64]| x.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
                    assert_eq!(bits(&x.values), bits(&y.values), "/{name}/{own}");
                }
                _ => assert_eq!(one.texts(own).unwrap(), other.texts(own).unwrap()),
            }
            for attribute in ["units", "flag_meanings"] {
                let of = |group: &costate::low_level::result::StoredGroup<'_>| {
                    group.attribute(Some(own), attribute)
                };
                assert_eq!(of(&one), of(&other), "/{name}/{own}: {attribute}");
            }
        }
        for attribute in [
            "axes",
            "converged_below",
            "precision",
            "method",
            "method_of_map",
            "rtol",
        ] {
            let of = |group: &costate::low_level::result::StoredGroup<'_>| {
                group.attribute(None, attribute)
            };
            assert_eq!(of(&one), of(&other), "/{name}: {attribute}");
        }
    }
}

/// A folder with the scene and its map.
fn folder(name: &str) -> std::path::PathBuf {
    let folder = scratch(name);
    std::fs::write(folder.join("scene.toml"), SCENE).unwrap();
    done(
        &folder,
        &[
            "map",
            "scene.toml",
            "--backend",
            "cpu",
            "--quiet",
            "--out",
            "map.h5",
        ],
    );
    folder
}

const EVALUATE: [&str; 5] = ["evaluate", "map.h5", "--backend", "cpu", "--quiet"];

fn parts(folder: &Path, more: &[&str], of: usize) -> Vec<String> {
    (0..of)
        .map(|k| {
            let (name, shard) = (format!("p{k}.h5"), format!("{k}/{of}"));
            let own = ["--out", &name, "--shard", &shard];
            done(folder, &[&EVALUATE[..], more, &own].concat());
            name
        })
        .collect()
}

#[test]
fn shards_of_closed_loops_are_the_whole() {
    let folder = folder("shards-loops");
    // The grid, random states, and V that is solved for in blocks.
    for (of, more) in [
        (3, &[][..]),
        (70, &["--laws", "lqr,soft"]),
        (4, &["--random", "50", "--seed", "3"]),
        (2, &["--solve"]),
    ] {
        let whole = ["--out", "whole.h5"];
        done(&folder, &[&EVALUATE[..], more, &whole].concat());
        let parts = parts(&folder, more, of);
        let all = merged(&folder, &parts, &[]);
        match more.first() {
            Some(&"--random") => {
                // Random states have no contours.
                let [a, b] = ["whole.h5", "all.h5"].map(|n| Stored::open(folder.join(n)).unwrap());
                for name in ["x0", "V", "J", "t_end", "most", "last", "suboptimality"] {
                    let of = |s: &Stored| s.group("closed_loop").unwrap().f64(name).unwrap().values;
                    let bits = |x: Vec<f64>| x.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
                    assert_eq!(bits(of(&a)), bits(of(&b)), "{name}");
                }
            }
            _ => same_loops(&folder.join("whole.h5"), &all),
        }
        for part in parts {
            std::fs::remove_file(folder.join(part)).unwrap();
        }
    }
}

/// What is missing has a status; what does not belong together is refused; what is done is not done
/// again.
#[test]
fn gaps_and_strangers_are_told() {
    let folder = folder("shards-loops-gaps");
    let parts = parts(&folder, &["--laws", "lqr"], 3);
    let merge = ["merge", &parts[0], &parts[2], "--out", "some.h5"];
    let errors = refused(&folder, &merge, "some.h5");
    assert!(errors.contains("missing: 1"), "{errors}");
    let (output, errors) = run(&folder, &[&merge[..], &["--partial"]].concat());
    assert_eq!(output.status.code(), Some(75), "{errors}");
    let stored = Stored::open(folder.join("some.h5")).unwrap();
    let group = stored.group("closed_loop").unwrap();
    let (status, cost) = (
        group.i32("status").unwrap().1,
        group.f64("J").unwrap().values,
    );
    let gone = status.iter().filter(|s| **s == 9).count();
    assert_eq!(gone, 21);
    assert!(status.iter().zip(&cost).all(|(s, j)| *s != 9 || j.is_nan()));
    // Shares are of what is there.
    let laws = stored.group("closed_loop_laws").unwrap();
    let (share, failed) = (
        laws.f64("share_converged").unwrap(),
        laws.f64("failed").unwrap(),
    );
    let converged = group
        .i32("converged")
        .unwrap()
        .1
        .iter()
        .filter(|c| **c == 1)
        .count();
    assert_eq!(share.values, [converged as f64 / 42.0]);
    let ended = status.iter().filter(|s| ![0, 9].contains(*s)).count();
    assert_eq!(failed.values, [ended as f64]);
    let sets = stored.group("operating_sets").unwrap();
    assert!(sets.f64("area").unwrap().values.iter().all(|a| a.is_nan()));
    let names = group.attribute(Some("status"), "flag_meanings").unwrap();
    assert!(names.contains("not_merged"), "{names}");

    let own = ["--laws", "soft", "--shard", "1/3", "--out", "other.h5"];
    done(&folder, &[&EVALUATE[..], &own].concat());
    let strange = [
        "merge", &parts[0], "other.h5", &parts[2], "--out", "mixed.h5",
    ];
    let errors = refused(&folder, &strange, "mixed.h5");
    assert!(
        errors.contains("laws lqr") && errors.contains("laws soft"),
        "{errors}"
    );

    let before = std::fs::read(folder.join(&parts[1])).unwrap();
    let again = [
        "--laws", "lqr", "--shard", "1/3", "--resume", "--out", &parts[1],
    ];
    done(&folder, &[&EVALUATE[..], &again].concat());
    assert_eq!(std::fs::read(folder.join(&parts[1])).unwrap(), before);
    let other = [
        "--laws", "soft", "--shard", "1/3", "--resume", "--out", &parts[1],
    ];
    refused(&folder, &[&EVALUATE[..], &other].concat(), "none");

    // A part has a file of its own: that of the map stays as it is.
    let map = std::fs::read(folder.join("map.h5")).unwrap();
    done(&folder, &[&EVALUATE[..], &["--shard", "0/3"]].concat());
    assert!(folder.join("out/scene_closed_loop_0_of_3.h5").exists());
    assert!(std::fs::read(folder.join("map.h5")).unwrap() == map);
    let errors = refused(&folder, &[&EVALUATE[..], &["--resume"]].concat(), "none");
    assert!(errors.contains("--out"), "{errors}");
    let listed = entries(&folder);
    assert!(
        listed.iter().all(|name| !name.starts_with('.')),
        "{listed:?}"
    );
}

/// One that had no time is gone on with.
#[test]
fn loops_that_were_ended_are_gone_on_with() {
    let folder = folder("shards-loops-ended");
    let own = ["--laws", "lqr", "--random", "30000", "--out", "a.h5"];
    let ended = [
        &EVALUATE[..],
        &own,
        &["--shard", "0/1", "--time-limit", "1e-6"],
    ]
    .concat();
    let (output, errors) = run(&folder, &ended);
    assert_eq!(output.status.code(), Some(75), "{errors}");
    let on = [&EVALUATE[..], &own, &["--shard", "0/1", "--resume"]].concat();
    done(&folder, &on);
    done(
        &folder,
        &[&EVALUATE[..], &own[..4], &["--out", "b.h5"]].concat(),
    );
    let [a, b] = ["a.h5", "b.h5"].map(|n| Stored::open(folder.join(n)).unwrap());
    for name in ["x0", "J", "t_end"] {
        let of = |s: &Stored| s.group("closed_loop").unwrap().f64(name).unwrap().values;
        let bits = |x: Vec<f64>| x.into_iter().map(f64::to_bits).collect::<Vec<_>>();
        assert!(bits(of(&a)) == bits(of(&b)), "{name}");
    }
}
