//! Levels of attenuation in shards.

use super::{done, merged, refused, run, same_results, shards};
use crate::common_commands::{scenario, scratch};
use costate::low_level::result::Stored;

/// Levels that are asked for are units, and so is the search, which goes by what it knows of them:
/// all together are what one search looks at, to the last bit.
#[test]
fn shards_of_levels_are_the_whole() {
    let folder = scratch("shards-levels");
    let text = std::fs::read_to_string(scenario("oscillator_game")).unwrap();
    let at = text.find("[attenuation]").expect("it has the section");
    let section = "[attenuation]\nparameter = \"gamma\"\ntolerance = 0.02\nlevels = [1.3, 1.6, 2.0, 3.0]\n\
                   states = { x = [-1, 1, 5], v = [-1, 1, 5] }\n";
    std::fs::write(
        folder.join("scene.toml"),
        format!("{}{section}", &text[..at]),
    )
    .unwrap();
    let attenuation = ["attenuation", "scene.toml", "--backend", "cpu"];
    done(
        &folder,
        &[&attenuation[..], &["--out", "whole.h5", "--quiet"]].concat(),
    );
    let parts = shards(&folder, &attenuation, 3);
    let all = merged(&folder, &parts, &[]);
    same_results(&folder.join("whole.h5"), &all);

    // Levels are not looked at twice, but for where the search begins: at the scene's own.
    let looked_at = |name: &str| {
        let stored = Stored::open(folder.join(name)).unwrap();
        (stored.group("attenuation")).map_or(0, |g| g.f64("value").unwrap().values.len())
    };
    let in_parts: usize = parts.iter().map(|part| looked_at(part)).sum();
    let in_one = looked_at("whole.h5");
    assert!(
        (in_one..=in_one + 1).contains(&in_parts),
        "{in_parts} {in_one}"
    );

    let some = ["merge", &parts[0], &parts[1], "--out", "some.h5"];
    let errors = refused(&folder, &some, "some.h5");
    assert!(errors.contains("missing: 2"), "{errors}");
    let errors = refused(&folder, &[&some[..], &["--partial"]].concat(), "some.h5");
    assert!(
        errors.contains("--partial cannot") && errors.contains("missing: 2"),
        "{errors}"
    );

    // What had no time is gone on with, as one.
    let own = [&attenuation[..], &["--out", "b.h5", "--quiet", "--resume"]].concat();
    let (output, errors) = run(&folder, &[&own[..], &["--time-limit", "1e-3"]].concat());
    assert_eq!(output.status.code(), Some(75), "{errors}");
    done(&folder, &own);
    same_results(&folder.join("whole.h5"), &folder.join("b.h5"));
    let before = std::fs::read(folder.join("b.h5")).unwrap();
    done(&folder, &own);
    assert_eq!(std::fs::read(folder.join("b.h5")).unwrap(), before);
}
