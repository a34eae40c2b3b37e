//! The rooms of `src/` depend downward only: what a file imports belongs to its own room or to one
//! further down.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// From the ground up; a room may import what stands before it. ARCHITECTURE.md draws them.
const FLOORS: [&str; 29] = [
    "schema",
    "diagnostics",
    "numeric",
    "trajectories",
    "files",
    "hdf5",
    "expr",
    "program",
    "mechanism",
    "model",
    "scenario",
    "hamiltonian",
    "scene",
    "integrator",
    "local",
    "backend",
    "hybrid",
    "shooting",
    "sweep",
    "dynamic_programming",
    "value",
    "map",
    "feedback",
    "closed_loop",
    "attenuation",
    "study",
    "session",
    "result",
    "run",
];

fn files(directory: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
}

fn room(file: &Path) -> String {
    let first = file.components().next().unwrap().as_os_str();
    Path::new(first)
        .file_stem()
        .unwrap()
        .to_str()
        .unwrap()
        .to_owned()
}

/// The text without comments, and without the tests at its end.
fn code(text: &str) -> String {
    let end = text.find("#[cfg(test)]\nmod tests {").unwrap_or(text.len());
    let lines = text[..end].lines();
    lines
        .map(|line| line.split("//").next().unwrap_or_default())
        .collect::<Vec<_>>()
        .join("\n")
}

/// Names that follow `crate::`, also in braces.
fn imports(code: &str) -> BTreeSet<String> {
    let name = |text: &str| -> String {
        text.chars()
            .take_while(|c| c.is_alphanumeric() || *c == '_')
            .collect()
    };
    let mut found = BTreeSet::new();
    for (at, path) in code.match_indices("crate::") {
        // Not the end of a longer word.
        if code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_') {
            continue;
        }
        let rest = &code[at + path.len()..];
        let rest = rest.strip_prefix("low_level::").unwrap_or(rest);
        let Some(list) = rest.strip_prefix('{') else {
            let own = name(rest);
            // A macro belongs to no room.
            if !rest[own.len()..].starts_with('!') {
                found.insert(own);
            }
            continue;
        };
        let mut depth = 0;
        let mut begins = true;
        for (k, c) in list.char_indices() {
            match c {
                '{' => depth += 1,
                '}' if depth == 0 => break,
                '}' => depth -= 1,
                ',' if depth == 0 => begins = true,
                c if begins && !c.is_whitespace() => {
                    found.insert(name(&list[k..]));
                    begins = false;
                }
                _ => {}
            }
        }
    }
    found
}

#[test]
fn imports_are_found() {
    let text = "use crate::{map::{A, B}, value};\nfn f() { crate::local::g(); } // crate::cli\n";
    let found: Vec<String> = imports(&code(text)).into_iter().collect();
    assert_eq!(found, ["local", "map", "value"]);
}

#[test]
fn rooms_depend_downward() {
    let src = Path::new(crate::ROOT).join("src");
    let mut all = Vec::new();
    files(&src, &mut all);
    let floor = |room: &str| FLOORS.iter().position(|f| *f == room);
    let mut wrong = Vec::new();
    let mut arrows = 0;
    for file in &all {
        let place = file.strip_prefix(&src).unwrap();
        let own = room(place);
        if own == "lib" || own == "low_level" {
            continue;
        }
        let Some(at) = floor(&own) else {
            wrong.push(format!(
                "{}: the room `{own}` has no floor",
                place.display()
            ));
            continue;
        };
        for other in imports(&code(&std::fs::read_to_string(file).unwrap())) {
            match floor(&other) {
                Some(to) if to > at => wrong.push(format!(
                    "{} imports {other}, which stands above it",
                    place.display()
                )),
                Some(_) => arrows += usize::from(other != own),
                None => wrong.push(format!(
                    "{} imports {other}, which has no floor",
                    place.display()
                )),
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert!(arrows > 100, "only {arrows} imports were found");
}
