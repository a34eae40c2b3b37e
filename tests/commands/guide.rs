//! The guide: its first chapter works as it is written, and its links lead somewhere.

use crate::common_commands::scratch;
use std::path::{Path, PathBuf};
use std::process::Command;

fn chapters() -> Vec<PathBuf> {
    let docs = std::fs::read_dir(Path::new(crate::ROOT).join("docs")).unwrap();
    let pages = docs.map(|entry| entry.unwrap().path());
    pages
        .filter(|path| path.extension().is_some_and(|e| e == "md"))
        .collect()
}

/// Fenced blocks of a page with their language, in its order.
fn blocks(text: &str) -> Vec<(String, String)> {
    let mut found: Vec<(String, String)> = Vec::new();
    let mut open = false;
    for line in text.lines() {
        match line.strip_prefix("```") {
            Some(language) => {
                open = !open;
                if open {
                    found.push((language.to_owned(), String::new()));
                }
            }
            None if open => {
                let (_, block) = found.last_mut().unwrap();
                *block += &format!("{line}\n");
            }
            None => {}
        }
    }
    found
}

#[test]
fn ten_minutes_lead_to_a_law() {
    let folder = scratch("guide");
    let text = std::fs::read_to_string(Path::new(crate::ROOT).join("docs/ten_minutes.md")).unwrap();
    let mut said = Vec::new();
    for (language, block) in blocks(&text) {
        match language.as_str() {
            "toml" => std::fs::write(folder.join("motor.toml"), block).unwrap(),
            "c" => std::fs::write(folder.join("main.c"), block).unwrap(),
            "sh" => {
                for line in block.lines() {
                    let mut command = match line.strip_prefix("costate ") {
                        Some(arguments) => {
                            let mut command = Command::new(env!("CARGO_BIN_EXE_costate"));
                            command.args(arguments.split(' '));
                            command
                        }
                        None => {
                            let mut command = Command::new("sh");
                            command.args(["-c", line]);
                            command
                        }
                    };
                    let done = command.current_dir(&folder).output().unwrap();
                    let errors = String::from_utf8_lossy(&done.stderr);
                    assert!(done.status.success(), "{line}: {errors}");
                    said.push((line.to_owned(), String::from_utf8(done.stdout).unwrap()));
                }
            }
            other => panic!("a block of {other}"),
        }
    }
    let of = |begins: &str| {
        let found = said.iter().find(|(line, _)| line.starts_with(begins));
        found.unwrap_or_else(|| panic!("{begins}")).1.clone()
    };
    let run = of("costate run");
    assert!(run.contains("met by its own measure"), "{run}");
    assert!(!run.contains("WARNING"), "{run}");
    let value = of("costate value");
    assert!(
        value.contains("V = ") && !value.contains("may be missing"),
        "{value}"
    );
    // What the C program commands is what the program says.
    let flown = of("./main");
    let (known, u) = flown.trim().split_once(' ').unwrap();
    assert_eq!(known, "1");
    let u: f64 = u.parse().unwrap();
    assert!(value.split_whitespace().any(|word| {
        let word = word.trim_matches(|c: char| !(c.is_ascii_digit() || c == '-' || c == '.'));
        word.parse().is_ok_and(|said: f64| (said - u).abs() < 1e-4)
    }));
    assert!(folder.join("out/motor_report.html").exists());
}

#[test]
fn links_lead_somewhere() {
    let root = Path::new(crate::ROOT);
    let mut followed = 0;
    for page in chapters().into_iter().chain([root.join("README.md")]) {
        let text = std::fs::read_to_string(&page).unwrap();
        for link in text.split("](").skip(1) {
            let link = link.split(')').next().unwrap();
            let file = link.split('#').next().unwrap();
            if link.starts_with("http") || file.is_empty() {
                continue;
            }
            let target = page.parent().unwrap().join(file);
            assert!(target.exists(), "{}: {link}", page.display());
            followed += 1;
        }
    }
    assert!(followed > 30, "{followed} links");
}

#[test]
fn the_contents_list_every_chapter() {
    let contents = std::fs::read_to_string(Path::new(crate::ROOT).join("docs/SUMMARY.md")).unwrap();
    for page in chapters() {
        let name = page.file_name().unwrap().to_str().unwrap().to_owned();
        assert!(
            name == "SUMMARY.md" || contents.contains(&format!("]({name})")),
            "{name}"
        );
    }
}
