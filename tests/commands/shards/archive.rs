//! First guesses from a sweep that was made once for all shards.

use super::{done, merged, points, refused, same_results, shards};
use crate::common_commands::{scenario, scratch};
use costate::low_level::result::Stored;

/// A game's states need a sweep: with that of `shoot-out` shards are the whole, and V is what it is
/// with one of their own.
#[test]
fn a_game_takes_a_sweep_that_was_made_before() {
    let folder = scratch("shards-archive");
    let scene = scenario("linear_game");
    let scene = scene.to_str().unwrap();
    let here = ["--backend", "cpu", "--quiet"];
    done(
        &folder,
        &[&["shoot-out", scene, "--out", "sweep.h5"], &here[..]].concat(),
    );
    points(
        &folder.join("states.csv"),
        ["x", "v"],
        [[-0.9, 0.9]; 2],
        1200,
    );
    let solve = [&["solve", scene, "--points", "states.csv"], &here[..]].concat();
    let given = [&solve[..], &["--archive", "sweep.h5"]].concat();

    done(&folder, &[&solve[..], &["--out", "own.h5"]].concat());
    done(&folder, &[&given[..], &["--out", "whole.h5"]].concat());
    let loud: Vec<&str> = given.iter().copied().filter(|a| *a != "--quiet").collect();
    let parts = shards(&folder, &loud, 3);
    let all = merged(&folder, &parts, &[]);
    same_results(&folder.join("whole.h5"), &all);
    let value = |name: &str| {
        let stored = Stored::open(folder.join(name)).unwrap();
        let group = stored.group("points").unwrap();
        (
            group.f64("V").unwrap().values,
            group.i32("status").unwrap().1,
        )
    };
    let ((own, solved), (with, _)) = (value("own.h5"), value("whole.h5"));
    assert!(solved.iter().filter(|s| **s == 0).count() > 1000);
    for ((a, b), status) in own.iter().zip(&with).zip(solved) {
        assert!(
            status != 0 || (a - b).abs() <= 1e-6 * a.abs().max(1e-3),
            "{a} {b}"
        );
    }

    // Other guesses may leave other last bits: parts with and without are of two wholes.
    let own = ["--shard", "1/3", "--out", "strange.h5"];
    done(&folder, &[&solve[..], &own].concat());
    let mixed = [
        "merge",
        &parts[0],
        "strange.h5",
        &parts[2],
        "--out",
        "mixed.h5",
    ];
    let errors = refused(&folder, &mixed, "mixed.h5");
    assert!(errors.contains("guesses from the sweep"), "{errors}");

    // What gives no guesses is refused.
    let with = |file: &'static str, more: &[&'static str]| {
        [&solve[..], &["--archive", file, "--out", "none.h5"], more].concat()
    };
    let errors = refused(&folder, &with("own.h5", &[]), "none.h5");
    assert!(errors.contains("no trajectories"), "{errors}");
    let errors = refused(&folder, &with("sweep.h5", &["--set", "gamma=3"]), "none.h5");
    assert!(errors.contains("other parameters"), "{errors}");
    done(
        &folder,
        &[
            &["shoot-out", scene, "--out", "values.h5", "--values-only"],
            &here[..],
        ]
        .concat(),
    );
    let errors = refused(&folder, &with("values.h5", &[]), "none.h5");
    assert!(errors.contains("values alone"), "{errors}");
}
