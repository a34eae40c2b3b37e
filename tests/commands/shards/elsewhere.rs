//! Wholes whose rows stay in the parts (`costate merge --virtual`).

use super::{LINEAR, SOLVE, command, done, linear, points, refused, run, shards};
use crate::common_commands::{checked_by, in_schema, scenario, scratch};
use costate::low_level::result::Stored;
use costate::low_level::trajectories::SolvedStates;
use std::path::Path;

/// A copying merge and a virtual one of the same parts, both in a folder of their own.
fn both(folder: &Path, parts: &[String], more: &[&str]) -> i32 {
    let parts: Vec<&str> = parts.iter().map(String::as_str).collect();
    let merge = |more: &[&str]| {
        let words = [&["merge"], parts.as_slice(), more].concat();
        let (output, errors) = run(folder, &words);
        output.status.code().unwrap_or_else(|| panic!("{errors}"))
    };
    let copied = merge(&[&["--out", "out/copy.h5"], more].concat());
    let named = merge(&[&["--out", "out/all.h5", "--virtual"], more].concat());
    assert_eq!(copied, named);
    named
}

fn bits(numbers: &[f64]) -> Vec<u64> {
    numbers.iter().map(|v| v.to_bits()).collect()
}

#[track_caller]
fn same_states(a: &SolvedStates, b: &SolvedStates) {
    assert!(a.count > 0);
    assert_eq!(
        (a.count, &a.sheet, &a.status),
        (b.count, &b.sheet, &b.status)
    );
    for (x, y) in [(&a.x, &b.x), (&a.v, &b.v), (&a.p, &b.p), (&a.u, &b.u)] {
        assert_eq!(bits(x), bits(y));
    }
}

/// Our own reader gives states in the order in which they were given.
#[track_caller]
fn same_as_read(a: &Path, b: &Path) {
    let (a, b) = (Stored::open(a).unwrap(), Stored::open(b).unwrap());
    same_states(&a.points().unwrap().unwrap(), &b.points().unwrap().unwrap());
    let solutions = |stored: &Stored| stored.points_sheets().unwrap().unwrap();
    same_states(&solutions(&a), &solutions(&b));
    let counted = |stored: &Stored| {
        let solved = stored.run_summary().unwrap().unwrap().homotopy.unwrap();
        (
            (solved.states, solved.distinct, solved.status),
            (solved.solutions, solved.sheets, solved.equal_cost_points),
            (solved.largest_residual, solved.hamiltonian_relative),
        )
    };
    assert_eq!(counted(&a), counted(&b));
}

/// Of several sheets and ways round, with states given twice and trajectories: every number, and
/// what is left once a part is gone.
#[test]
fn a_virtual_list_is_the_copied_one() {
    let folder = scratch("virtual-list");
    let scene = scenario("pendulum");
    let ranges = [[-4.0, 4.0], [-6.0, 6.0]];
    points(&folder.join("states.csv"), ["theta", "omega"], ranges, 2200);
    let mut text = std::fs::read_to_string(folder.join("states.csv")).unwrap();
    let again: Vec<String> = text.lines().skip(5).take(3).map(str::to_owned).collect();
    text += &(again.join("\n") + "\n");
    std::fs::write(folder.join("states.csv"), text).unwrap();
    let solve = ["solve", scene.to_str().unwrap(), "--points", "states.csv"];
    let more = ["--trajectories", "--samples", "5", "--backend", "cpu"];
    // More shards than blocks of states.
    let parts = shards(&folder, &[&solve[..], &more].concat(), 5);
    assert_eq!(both(&folder, &parts, &["--quiet"]), 0);

    let (copy, all) = (folder.join("out/copy.h5"), folder.join("out/all.h5"));
    in_schema(&all);
    checked_by("check_virtual.py", &[&copy, &all]);
    same_as_read(&copy, &all);
    let bytes = |path: &Path| std::fs::metadata(path).unwrap().len();
    assert!(
        3 * bytes(&all) < bytes(&copy),
        "{} {}",
        bytes(&all),
        bytes(&copy)
    );
    let stored = Stored::open(&all).unwrap();
    assert!(stored.has_attribute("virtual") && stored.absent_parts().is_empty());
    let files = stored.group("shard_files").unwrap();
    assert_eq!(files.texts("file").unwrap()[1], "../p1.h5");
    let rows = files.i32("points").unwrap().1;
    assert_eq!(rows.iter().sum::<i32>(), 2203);
    drop(stored);

    // Programs that read it; a folder that is moved with its parts.
    let asked = |name: &str| {
        let at = ["--at", "theta=1.1,omega=-0.4"];
        done(&folder, &[&["value", name], &at[..]].concat())
    };
    assert_eq!(asked("out/all.h5"), asked("out/copy.h5"));
    let moved = scratch("virtual-list-moved");
    std::fs::create_dir_all(moved.join("out")).unwrap();
    for name in [
        "p0.h5",
        "p1.h5",
        "p2.h5",
        "p3.h5",
        "p4.h5",
        "out/all.h5",
        "out/copy.h5",
    ] {
        std::fs::rename(folder.join(name), moved.join(name)).unwrap();
    }
    let (copy, all) = (moved.join("out/copy.h5"), moved.join("out/all.h5"));
    same_as_read(&copy, &all);
    done(&moved, &["report", "out/all.h5", "--quiet"]);

    // A part that is gone is not known, and nothing else changes.
    let gone = rows.iter().position(|rows| *rows > 0).unwrap();
    std::fs::remove_file(moved.join(format!("p{gone}.h5"))).unwrap();
    checked_by("check_virtual.py", &[&copy, &all]);
    let stored = Stored::open(&all).unwrap();
    assert_eq!(stored.absent_parts(), [format!("../p{gone}.h5")]);
    let code = (stored
        .group("points")
        .unwrap()
        .meanings("status")
        .into_iter())
    .find(|(_, name)| name == "not merged")
    .unwrap()
    .0;
    let known = Stored::open(&copy).unwrap().points().unwrap().unwrap();
    let left = stored.points().unwrap().unwrap();
    let mut lost = 0;
    for k in 0..left.count {
        if left.status[k] == code {
            lost += 1;
            assert!(left.v[k].is_nan() && left.x[2 * k].is_nan() && left.sheet[k] == -1);
        } else {
            assert_eq!(left.v[k].to_bits(), known.v[k].to_bits());
        }
    }
    assert_eq!(lost, rows[gone]);
    let solutions = stored.points_sheets().unwrap().unwrap();
    assert!(solutions.count > 0 && solutions.v.iter().all(|v| v.is_finite()));
    drop(stored);
    let ask = ["value", "out/all.h5", "--at", "theta=1,omega=0"];
    let (output, errors) = run(&moved, &ask);
    assert_eq!(output.status.code(), Some(0), "{errors}");
    assert!(errors.contains("gone (../p"), "{errors}");
    done(&moved, &["report", "out/all.h5", "--quiet"]);
    let page = std::fs::read_to_string(moved.join("out/all_report.html")).unwrap();
    assert!(page.contains("Parts that are gone"));

    // Another file in its place is refused, here and where HDF5 would look for one.
    let name = format!("p{gone}.h5");
    std::fs::copy(
        moved.join(format!("p{}.h5", (gone + 1) % 5)),
        moved.join(&name),
    )
    .unwrap();
    let (output, errors) = run(&moved, &ask);
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert!(
        errors.contains("another file than the one that was merged"),
        "{errors}"
    );
    std::fs::rename(moved.join(&name), folder.join(&name)).unwrap();
    let all = all.to_str().unwrap();
    let mut inside = command(
        &folder.join("out"),
        &["value", all, "--at", "theta=1,omega=0"],
    );
    let output = inside.output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert!(errors.contains("run this in another folder"), "{errors}");
}

/// Of two grids the states of one stay in the parts; the map's nodes are written in their order.
#[test]
fn a_virtual_grid_has_its_map() {
    let folder = scratch("virtual-grids");
    let scene = scenario("pendulum");
    let homotopy = ["homotopy", scene.to_str().unwrap(), "--backend", "cpu"];
    let parts = shards(&folder, &homotopy, 3);
    assert_eq!(both(&folder, &parts, &["--quiet"]), 0);
    let (copy, all) = (folder.join("out/copy.h5"), folder.join("out/all.h5"));
    checked_by("check_virtual.py", &[&copy, &all]);
    same_as_read(&copy, &all);
    let stored = Stored::open(&all).unwrap();
    assert!(stored.has("equal_cost") && stored.has("map"));
    drop(stored);
    let checked = |name: &str| {
        let words = ["check-least", name, "--nodes", "41", "--json"];
        let text: serde_json::Value = serde_json::from_str(&done(&folder, &words)).unwrap();
        ["known", "states", "apart", "greedy", "verdict"].map(|key| text[key].clone())
    };
    let own = checked("out/all.h5");
    assert!(own[0].as_u64().unwrap() > 1000, "{own:?}");
    assert_eq!(own, checked("out/copy.h5"));
}

/// States of shards that are missing have rows that lie nowhere; a study is refused.
#[test]
fn what_a_virtual_whole_cannot_have() {
    let folder = linear("virtual-partial");
    let parts = shards(&folder, &SOLVE, 3);
    let some = [parts[2].clone(), parts[0].clone()];
    let missing = ["merge", "p2.h5", "p0.h5", "--virtual", "--out", "out.h5"];
    let errors = refused(&folder, &missing, "out.h5");
    assert!(
        errors.contains("of 3 shards one is missing: 1 ("),
        "{errors}"
    );
    assert_eq!(both(&folder, &some, &["--partial", "--quiet"]), 75);
    let (copy, all) = (folder.join("out/copy.h5"), folder.join("out/all.h5"));
    checked_by("check_virtual.py", &[&copy, &all]);
    same_as_read(&copy, &all);
    let stored = Stored::open(&all).unwrap();
    assert_eq!(stored.attribute("shards_missing").as_deref(), Some("1"));
    assert!(stored.has_attribute("stopped"));
    let files = stored.group("shard_files").unwrap();
    assert_eq!(files.i32("shard").unwrap().1, [0, 2]);
    let rows = files.i32("points").unwrap().1;
    assert!(rows.iter().sum::<i32>() < 3000);

    let study = "study = { vary = { q = [1, 2, 3] }, from = { x = 0.5 }, samples = 4 }";
    std::fs::write(folder.join("study.toml"), format!("{LINEAR}{study}\n")).unwrap();
    let parts = shards(&folder, &["study", "study.toml", "--backend", "cpu"], 2);
    let merge = ["merge", &parts[0], &parts[1], "--virtual", "--out", "s.h5"];
    let errors = refused(&folder, &merge, "s.h5");
    assert!(
        errors.contains("--virtual is for parts of states"),
        "{errors}"
    );
}
