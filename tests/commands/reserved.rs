//! Names that groups of a result file have of their own are refused where a scene would use them.

use crate::common_commands::{costate, done, scratch};
use costate::Stored;
use costate::low_level::model::reserved::{self, is_reserved};
use std::path::Path;

const SCENE: &str = r#"
parameters = { r = 1.0 }
states = { x = {}, y = {} }
controls = { f = {} }
dynamics = { x = "y", y = "f" }
cost = { running = "0.5*(x^2 + r*f^2)" }
equilibrium = { x = 0, y = 0, f = 0 }
region = { x = [-1, 1], y = [-1, 1] }
map = { resolution = 3 }

[study]
vary = { r = [1.0, 2.0] }
from = { x = 0.5 }
record = { most = "max(x)" }

[closed_loop]
final_time = 6
initial = { x = [-0.5, 0.5, 3] }
record = { largest = "max(f)" }
"#;

/// What is in a group but is no name of the scene.
fn own(file: &Path, group: &str) -> Vec<String> {
    let scene = ["x", "y", "r", "most", "largest"];
    let names = Stored::open(file).unwrap().group(group).unwrap().names();
    let own = names.into_iter().filter(|n| !scene.contains(&n.as_str()));
    own.collect()
}

#[test]
fn all_names_that_a_file_has_are_reserved() {
    let folder = scratch("reserved");
    let scene = folder.join("scene.toml");
    std::fs::write(&scene, SCENE).unwrap();
    let (run, value) = (folder.join("run.h5"), folder.join("value.h5"));
    let paths = [&scene, &run, &value].map(|p| p.to_str().unwrap().to_owned());
    done(costate(&[
        "run",
        &paths[0],
        "--out",
        &paths[1],
        "--no-report",
    ]));
    done(costate(&[
        "value",
        &paths[1],
        "--grid",
        "x=-0.5:0.5:3",
        "--out",
        &paths[2],
    ]));
    for (file, group, lists) in [
        (&run, "map", vec![reserved::MAP]),
        (&value, "map", vec![reserved::MAP, reserved::VALUES]),
        (&run, "study", vec![reserved::STUDY]),
        (&run, "closed_loop", vec![reserved::CLOSED_LOOP]),
    ] {
        let names = own(file, group);
        assert!(names.len() > 5, "/{group}: {names:?}");
        for name in names {
            let known = lists.iter().any(|list| is_reserved(&name, list));
            assert!(known, "/{group} has `{name}`, which is not reserved");
        }
    }
}
