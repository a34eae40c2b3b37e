//! Names that groups of a result file have of their own are refused where a scene would use them.

use crate::common_commands::{costate, done, in_schema, scratch};
use costate::Stored;
use costate::low_level::schema;
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

#[test]
fn all_names_that_a_file_has_are_reserved() {
    let folder = scratch("reserved");
    let scene = folder.join("scene.toml");
    std::fs::write(&scene, SCENE).unwrap();
    let (run, value) = (folder.join("run.h5"), folder.join("value.h5"));
    let paths = [&scene, &run, &value].map(|p| p.to_str().unwrap().to_owned());
    let run_it = ["run", &paths[0], "--out", &paths[1], "--no-report"];
    done(costate(&run_it));
    let grid = [
        "value",
        &paths[1],
        "--grid",
        "x=-0.5:0.5:3",
        "--out",
        &paths[2],
    ];
    done(costate(&grid));
    for file in [&run, &value] {
        in_schema(file);
    }
    // What the scene's own names stand beside.
    let own = ["x", "y", "r", "most", "largest"];
    for (file, group) in [
        (&run, &schema::MAP),
        (&value, &schema::MAP),
        (&run, &schema::STUDY),
        (&run, &schema::CLOSED_LOOP),
    ] {
        let names = Stored::open(file).unwrap().group(group).unwrap().names();
        let others: Vec<&String> = (names.iter())
            .filter(|n| !own.contains(&n.as_str()))
            .collect();
        assert!(others.len() > 5, "/{}: {names:?}", group.name);
        for name in others {
            assert!(group.reserves(name), "/{}: {name}", group.name);
        }
    }
}

#[test]
fn the_reference_of_the_file_is_the_schema() {
    let printed = done(costate(&["reference", "file"]));
    let page = std::fs::read_to_string(Path::new(crate::ROOT).join("docs/result_file.md")).unwrap();
    assert_eq!(
        between(&page),
        printed.trim(),
        "print it again: costate reference file"
    );
    assert!(printed.contains("| `suboptimality` |"), "{printed}");
}

#[test]
fn the_reference_of_scenes_is_what_the_parser_knows() {
    let printed = done(costate(&["reference", "scene"]));
    let page = std::fs::read_to_string(Path::new(crate::ROOT).join("docs/scene.md")).unwrap();
    assert_eq!(
        between(&page),
        printed.trim(),
        "print it again: costate reference scene"
    );
    assert!(printed.contains("| `max_seeds` |"), "{printed}");
}

/// What a page has between the lines that enclose what the program prints.
fn between(page: &str) -> &str {
    let after = page
        .split_once("<!-- printed: begin -->")
        .expect("a first line")
        .1;
    let inside = after
        .split_once("<!-- printed: end -->")
        .expect("a last line")
        .0;
    inside.trim()
}
