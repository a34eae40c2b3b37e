//! What `--resume` goes on with, and what it leaves as it is.

use super::{LINEAR, command, done, entries, points, refused, run, same_results};
use crate::common_commands::scratch;
use costate::low_level::result::Stored;
use std::process::Stdio;

/// A finished result is left as it is, whole or part; what is of other work is refused, and stays.
#[test]
fn what_is_finished_is_not_written_over() {
    let folder = scratch("resume-finished");
    std::fs::write(folder.join("scene.toml"), LINEAR).unwrap();
    let ranges = [[-1.0, 1.0]; 2];
    points(&folder.join("a.csv"), ["x", "v"], ranges, 40);
    points(&folder.join("b.csv"), ["x", "v"], ranges, 30);
    let solve = |list: &'static str, more: &[&'static str]| {
        let own = ["solve", "scene.toml", "--backend", "cpu", "--points", list];
        [&own[..], more].concat()
    };
    let read = |name: &str| std::fs::read(folder.join(name)).unwrap();

    done(&folder, &solve("a.csv", &["--out", "all.h5", "--quiet"]));
    let whole = read("all.h5");
    let again = run(&folder, &solve("a.csv", &["--out", "all.h5", "--resume"]));
    assert_eq!(again.0.status.code(), Some(0));
    assert!(again.1.contains("nothing is left to do"), "{}", again.1);
    for other in [
        solve("b.csv", &["--out", "all.h5", "--resume"]),
        solve("a.csv", &["--out", "all.h5", "--resume", "--one-sheet"]),
        solve("a.csv", &["--out", "all.h5", "--resume", "--set", "q=2"]),
        solve("a.csv", &["--out", "all.h5", "--resume", "--shard", "0/2"]),
    ] {
        let errors = refused(&folder, &other, "all_stopped.h5");
        assert!(errors.contains("all.h5"), "{errors}");
        assert!(errors.contains("leave --resume out"), "{errors}");
        // In words, not as the program has it.
        assert!(
            !errors.contains("Some(") && !errors.contains("None"),
            "{errors}"
        );
    }
    assert_eq!(read("all.h5"), whole);

    done(
        &folder,
        &solve("a.csv", &["--out", "p.h5", "--shard", "1/2", "--quiet"]),
    );
    let part = read("p.h5");
    done(
        &folder,
        &solve("a.csv", &["--out", "p.h5", "--shard", "1/2", "--resume"]),
    );
    assert_eq!(read("p.h5"), part);
    refused(
        &folder,
        &solve("a.csv", &["--out", "p.h5", "--shard", "0/2", "--resume"]),
        "none",
    );
    assert_eq!(read("p.h5"), part);

    // A result of something else at all.
    done(
        &folder,
        &[
            "simulate",
            "scene.toml",
            "--time",
            "1",
            "--out",
            "s.h5",
            "--quiet",
        ],
    );
    let errors = refused(
        &folder,
        &solve("a.csv", &["--out", "s.h5", "--resume"]),
        "none",
    );
    assert!(errors.contains("other work"), "{errors}");

    // Without --resume it is written over, as ever; and all that is there has been named.
    done(&folder, &solve("b.csv", &["--out", "all.h5", "--quiet"]));
    assert_ne!(read("all.h5"), whole);
    let left = entries(&folder);
    let is_litter = |name: &String| name.starts_with('.') || name.contains("_stopped");
    assert!(!left.iter().any(is_litter), "{left:?}");
}

/// A merged whole is known, too; one that was put together of some parts is made anew.
#[test]
fn a_merged_whole_is_known() {
    let folder = scratch("resume-merged");
    std::fs::write(folder.join("scene.toml"), LINEAR).unwrap();
    points(&folder.join("a.csv"), ["x", "v"], [[-1.0, 1.0]; 2], 2100);
    let solve = [
        "solve",
        "scene.toml",
        "--points",
        "a.csv",
        "--backend",
        "cpu",
        "--quiet",
    ];
    let shard = |k: &'static str, name: &'static str| {
        done(
            &folder,
            &[&solve[..], &["--shard", k, "--out", name]].concat(),
        );
    };
    shard("0/2", "p0.h5");
    shard("1/2", "p1.h5");
    let (partial, told) = run(&folder, &["merge", "p1.h5", "--partial", "--out", "all.h5"]);
    assert_eq!(partial.status.code(), Some(75), "{told}");
    let said = String::from_utf8_lossy(&partial.stdout);
    assert!(said.contains("shards that are missing: 0"), "{said}");
    // It lacks states, and is made whole.
    done(
        &folder,
        &[&solve[..], &["--resume", "--out", "all.h5"]].concat(),
    );
    done(
        &folder,
        &["merge", "p0.h5", "p1.h5", "--out", "merged.h5", "--quiet"],
    );
    same_results(&folder.join("merged.h5"), &folder.join("all.h5"));
    let stored = Stored::open(folder.join("merged.h5")).unwrap();
    for name in ["V", "p_p99", "u_median", "states"] {
        assert!(stored.has_attribute(&format!("solved_error_estimate_{name}")));
    }
    assert!(stored.has_attribute("error_met"));
    let merged = std::fs::read(folder.join("merged.h5")).unwrap();
    done(
        &folder,
        &[&solve[..], &["--resume", "--out", "merged.h5"]].concat(),
    );
    assert_eq!(std::fs::read(folder.join("merged.h5")).unwrap(), merged);
}

/// Shards that end together under one name lose nothing: each has a file.
#[test]
fn shards_that_end_together_lose_nothing() {
    let folder = scratch("resume-together");
    std::fs::write(folder.join("scene.toml"), LINEAR).unwrap();
    points(&folder.join("a.csv"), ["x", "v"], [[-1.0, 1.0]; 2], 5);
    let solve = [
        "solve",
        "scene.toml",
        "--points",
        "a.csv",
        "--backend",
        "cpu",
        "--quiet",
    ];
    for round in 0..4 {
        let name = format!("r{round}.h5");
        let all: Vec<_> = ["0/3", "1/3", "2/3"]
            .map(|shard| {
                let own = [&solve[..], &["--shard", shard, "--out", &name]].concat();
                command(&folder, &own)
                    .stderr(Stdio::null())
                    .spawn()
                    .unwrap()
            })
            .into_iter()
            .map(|mut child| child.wait().unwrap().code())
            .collect();
        // One that comes late is refused at once.
        let made = all.iter().filter(|code| **code == Some(0)).count();
        assert!(
            all.iter().all(|code| [Some(0), Some(2)].contains(code)),
            "{all:?}"
        );
        let files = entries(&folder);
        let own = files
            .iter()
            .filter(|file| file.starts_with(&format!("r{round}")))
            .count();
        assert_eq!(own, made, "{files:?}");
    }
}
