//! docs/scene.md names every section and key of a scene: what the parser accepts is asked of the
//! parser.

use costate::low_level::scenario::{Problem, parse};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Like no key and no choice.
const BOGUS: &str = "qqqqqqqqqq";

/// A body with a coordinate.
const BODY: &str =
    "gravity = [0, 1]\n[mechanism.bodies]\na = { joint = \"revolute\", mass = 1, com = [1, 0]";

/// Tables that are probed beside the sections: the heading of each, the section that it is in, and
/// lines there, after `BODY` in a mechanism, in which `BOGUS` is a key of it.
const WITHIN: [(&str, &str, &str); 7] = [
    (
        "closed_loop.law",
        "closed_loop.law",
        "one = { weights = \"one.toml\", qqqqqqqqqq = 1 }",
    ),
    ("mechanism.bodies", "mechanism", ", qqqqqqqqqq = 1 }"),
    (
        "mechanism.bodies.shape",
        "mechanism",
        ", shape = { rod = 1, qqqqqqqqqq = 1 } }",
    ),
    (
        "mechanism.points",
        "mechanism",
        " }\n[mechanism.points]\np = { qqqqqqqqqq = 1 }",
    ),
    (
        "mechanism.contacts",
        "mechanism",
        " }\n[mechanism.points]\np = { body = \"a\" }\n[mechanism.contacts]\np = { qqqqqqqqqq = 1 }",
    ),
    (
        "mechanism.forces.body",
        "mechanism",
        " }\n[mechanism.forces]\na = { qqqqqqqqqq = 1 }",
    ),
    (
        "events.collision",
        "mechanism",
        " }\n[mechanism.points]\np = { body = \"a\" }\n[events.e]\nwhen = \"a <= 0\"\ncollision = [{ qqqqqqqqqq = 1 }]",
    ),
];

fn root() -> PathBuf {
    Path::new(crate::ROOT).to_owned()
}

/// What is said of a scene with these lines in one section.
fn problems(section: &str, lines: &str) -> Vec<Problem> {
    let base = [
        ("states", "x = {}"),
        ("controls", "u = {}"),
        ("disturbances", "w = {}"),
        ("dynamics", "x = \"u + w\""),
        ("cost", "running = \"0.5*(x^2 + u^2 - 4*w^2)\""),
        ("equilibrium", "x = 0\nu = 0"),
        ("region", "x = [-1, 1]"),
    ];
    let mut text = String::new();
    for (name, lines) in base.iter().filter(|(name, _)| *name != section) {
        text += &format!("[{name}]\n{lines}\n");
    }
    text += &format!("[{section}]\n{lines}\n");
    parse(&text, "scene.toml", &[]).map_or_else(|errors| errors.problems, |_| Vec::new())
}

/// The list in the first help of a kind.
fn listed(problems: &[Problem], before: &str) -> Option<BTreeSet<String>> {
    let help = problems.iter().filter(|p| p.message.contains(BOGUS));
    let mut lists = help.filter_map(|p| {
        p.help
            .as_ref()?
            .split_once(before)
            .map(|(_, list)| list.to_owned())
    });
    Some(lists.next()?.split(", ").map(str::to_owned).collect())
}

/// Keys that a section, or each of its entries, may have; `None` where its keys are names of the
/// scene.
fn keys(section: &str) -> Option<BTreeSet<String>> {
    let probes = [format!("{BOGUS} = 1"), format!("x = {{ {BOGUS} = 1 }}")];
    match WITHIN.iter().find(|(name, ..)| *name == section) {
        Some((_, "mechanism", lines)) => listed(
            &problems("mechanism", &format!("{BODY}{lines}")),
            " may have: ",
        ),
        Some((_, within, lines)) => listed(&problems(within, lines), " may have: "),
        None => probes
            .iter()
            .find_map(|lines| listed(&problems(section, lines), " may have: ")),
    }
}

fn sections() -> BTreeSet<String> {
    let unknown = parse(&format!("[{BOGUS}]"), "scene.toml", &[])
        .unwrap_err()
        .problems;
    listed(&unknown, "sections: ").expect("the parser lists its sections")
}

/// Rows of the tables under each heading: by the key in the first column.
fn documented() -> BTreeMap<String, BTreeMap<String, String>> {
    let text = std::fs::read_to_string(root().join("docs/scene.md")).unwrap();
    let mut all: BTreeMap<String, BTreeMap<String, String>> = BTreeMap::new();
    let mut current = None;
    for line in text.lines() {
        if line.starts_with('#') {
            let name = line
                .split("`[")
                .nth(1)
                .and_then(|rest| rest.split("]`").next());
            current = name.map(str::to_owned);
            all.extend(name.map(|name| (name.to_owned(), BTreeMap::new())));
        }
        let key = line
            .strip_prefix("| `")
            .and_then(|rest| rest.split('`').next());
        if let (Some(section), Some(key)) = (&current, key) {
            let rows = all.get_mut(section).unwrap();
            assert!(
                rows.insert(key.to_owned(), line.to_owned()).is_none(),
                "{section}: {key} twice"
            );
        }
    }
    all
}

#[test]
fn the_reference_names_every_section_and_key() {
    let documented = documented();
    let sections = sections();
    assert!(
        sections.len() > 15 && sections.contains("integrator"),
        "{sections:?}"
    );
    let named: BTreeSet<String> = documented
        .keys()
        .filter(|name| !name.contains('.'))
        .cloned()
        .collect();
    assert_eq!(
        named, sections,
        "sections of docs/scene.md, and those of the parser"
    );
    let mut with_keys = 0;
    for section in sections
        .iter()
        .map(String::as_str)
        .chain(WITHIN.iter().map(|(name, ..)| *name))
    {
        let Some(keys) = keys(section) else { continue };
        with_keys += 1;
        let rows = documented
            .get(section)
            .unwrap_or_else(|| panic!("no heading `[{section}]`"));
        let rows: BTreeSet<String> = rows.keys().cloned().collect();
        assert_eq!(
            rows, keys,
            "keys of [{section}] in docs/scene.md, and those of the parser"
        );
    }
    // Tables with keys that no probe above reaches would be missed.
    let mut checks = 0;
    for folder in ["src/scenario", "src/scenario/mechanism"] {
        let files = std::fs::read_dir(root().join(folder)).unwrap();
        let files = files
            .map(|file| file.unwrap().path())
            .filter(|path| path.is_file());
        checks += files
            .map(|path| std::fs::read_to_string(path).unwrap())
            .map(|text| text.matches("self.check_keys(").count())
            .sum::<usize>();
    }
    assert_eq!(
        with_keys, checks,
        "tables whose keys the parser checks, and those probed here"
    );
}

#[test]
fn the_reference_names_every_choice() {
    let documented = documented();
    let mut found = 0;
    for (section, rows) in &documented {
        for (key, row) in rows {
            let choices = listed(
                &problems(section, &format!("{key} = \"{BOGUS}\"")),
                "known: ",
            );
            for choice in choices.into_iter().flatten() {
                found += 1;
                assert!(
                    row.contains(&format!("`\"{choice}\"`")),
                    "[{section}] {key}: {choice}"
                );
            }
        }
    }
    assert!(found > 15, "{found} choices");
}

#[test]
fn the_readme_leads_there() {
    let readme = std::fs::read_to_string(root().join("README.md")).unwrap();
    assert!(readme.contains("](docs/scene.md)"));
}
