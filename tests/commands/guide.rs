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

/// A line of a chapter as a command: of the program, or of the shell.
fn command(line: &str) -> Command {
    match line.strip_prefix("costate ") {
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
    }
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
                    let done = command(line).current_dir(&folder).output().unwrap();
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

/// Runs the commands of a chapter, with the files that it gives, and returns all that they print.
fn performed(chapter: &str, folder: &Path) -> String {
    let text = std::fs::read_to_string(Path::new(crate::ROOT).join("docs").join(chapter)).unwrap();
    let mut printed = String::new();
    let mut commands = 0;
    for (language, block) in blocks(&text) {
        if let Some((_, name)) = language.split_once(" file=") {
            std::fs::write(folder.join(name), block).unwrap();
            continue;
        }
        for line in block.lines().filter(|_| language == "sh") {
            let done = command(line).current_dir(folder).output().unwrap();
            let errors = String::from_utf8_lossy(&done.stderr);
            assert!(done.status.success(), "{chapter}: {line}: {errors}");
            printed += &String::from_utf8_lossy(&done.stdout);
            printed += &errors;
            commands += 1;
        }
    }
    assert!(commands > 0, "{chapter}: no command was run");
    printed
}

/// A line's words, each number as `#`: digits may differ between machines.
fn words(line: &str) -> String {
    let is_number = |word: &&str| word.chars().any(|c| c.is_ascii_digit());
    let words = line.split_whitespace();
    let words: Vec<&str> = words
        .map(|word| if is_number(&word) { "#" } else { word })
        .collect();
    words.join(" ")
}

/// The commands of these chapters work, and print what the chapters show.
#[test]
fn chapters_show_what_their_commands_print() {
    for chapter in ["tasks.md", "reading.md", "mechanisms.md", "simulation.md"] {
        let folder = scratch(&format!("guide_{}", chapter.trim_end_matches(".md")));
        let printed = performed(chapter, &folder);
        let printed: Vec<String> = printed.lines().map(words).collect();
        let path = Path::new(crate::ROOT).join("docs").join(chapter);
        let text = std::fs::read_to_string(path).unwrap();
        let shown = blocks(&text).into_iter().filter(|(l, _)| l == "text");
        let mut compared = 0;
        for line in shown.flat_map(|(_, block)| block.lines().map(words).collect::<Vec<_>>()) {
            assert!(
                line.is_empty() || printed.contains(&line),
                "{chapter} shows `{line}`, which no command prints"
            );
            compared += 1;
        }
        assert!(compared > 10, "{chapter}: {compared} lines");
    }
}

/// What a heading's anchor is called.
fn anchor(heading: &str) -> String {
    let kept = |c: &char| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_');
    let text: String = heading.to_lowercase().chars().filter(kept).collect();
    text.replace(' ', "-")
}

#[test]
fn links_lead_somewhere() {
    let root = Path::new(crate::ROOT);
    let mut followed = 0;
    for page in chapters().into_iter().chain([root.join("README.md")]) {
        let text = std::fs::read_to_string(&page).unwrap();
        for link in text.split("](").skip(1) {
            let link = link.split(')').next().unwrap();
            if link.starts_with("http") {
                continue;
            }
            let (file, place) = link.split_once('#').unwrap_or((link, ""));
            let target = match file {
                "" => page.clone(),
                file => page.parent().unwrap().join(file),
            };
            assert!(target.exists(), "{}: {link}", page.display());
            if !place.is_empty() && target.extension().is_some_and(|e| e == "md") {
                let text = std::fs::read_to_string(&target).unwrap();
                let headings = text.lines().filter(|line| line.starts_with('#'));
                let mut anchors = headings.map(|h| anchor(h.trim_start_matches('#').trim()));
                assert!(anchors.any(|a| a == place), "{}: {link}", page.display());
            }
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
