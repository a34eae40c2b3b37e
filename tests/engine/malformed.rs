//! Scenes with mistakes: every mistake is reported, with its exact place, and nothing else is.
//!
//! The scenes are in `tests/malformed/*.cases`, as edits of `base.toml` (of `mechanism.toml` where
//! they are about mechanisms):
//!
//! ```text
//! == name of the case
//! 14| omega = "u + 2e"          new text of line 14; several such lines for several lines, <CR> for a carriage return
//! -15                           line 15 removed
//! --set g=1                     as on the command line
//! => 14:15 part of the message | part of the help
//! => - message of a problem without a place
//! ```
//!
//! Lines and columns count from 1, columns in characters. All problems are listed, in order.

use costate::low_level::scenario::{LoadError, ScenarioErrors, load, parse};
use std::collections::BTreeMap;

const BASE: &str = include_str!("../malformed/base.toml");
const MECHANISM: &str = include_str!("../malformed/mechanism.toml");

/// A problem that a scene must have.
struct Expected<'c> {
    /// (line, column).
    place: Option<(usize, usize)>,
    message: &'c str,
    /// A part of the help; empty: any help or none.
    help: &'c str,
}

struct Case<'c> {
    name: &'c str,
    text: String,
    set: Vec<(String, String)>,
    expected: Vec<Expected<'c>>,
}

/// A base scene with lines (from 1) replaced by any number of lines.
fn edited(base: &str, edits: &BTreeMap<usize, Vec<String>>) -> String {
    let lines = base
        .lines()
        .enumerate()
        .flat_map(|(i, line)| match edits.get(&(i + 1)) {
            Some(new) => new.clone(),
            None => vec![line.to_owned()],
        });
    lines.map(|l| l + "\n").collect()
}

/// The base scene with one line replaced.
fn with_line(line: usize, new: &str) -> String {
    edited(BASE, &BTreeMap::from([(line, vec![new.to_owned()])]))
}

fn read_case<'c>(base: &str, case: &'c str) -> Option<Case<'c>> {
    let (name, rest) = case.split_once('\n')?;
    let (mut edits, mut set, mut expected) = (
        BTreeMap::<usize, Vec<String>>::new(),
        Vec::new(),
        Vec::new(),
    );
    for line in rest.lines().filter(|l| !l.is_empty()) {
        if let Some(problem) = line.strip_prefix("=> ") {
            let (place, text) = problem.split_once(' ')?;
            let (message, help) = text.split_once(" | ").unwrap_or((text, ""));
            let place = place
                .split_once(':')
                .map(|(l, c)| Some((l.parse().ok()?, c.parse().ok()?)));
            expected.push(Expected {
                place: place.flatten(),
                message,
                help,
            });
        } else if let Some(assignment) = line.strip_prefix("--set ") {
            let (name, value) = assignment.split_once('=')?;
            set.push((name.to_owned(), value.to_owned()));
        } else if let Some(removed) = line.strip_prefix('-') {
            edits.insert(removed.parse().ok()?, Vec::new());
        } else {
            let (number, text) = line.split_once('|')?;
            let text = text.strip_prefix(' ').unwrap_or(text).replace("<CR>", "\r");
            edits.entry(number.parse().ok()?).or_default().push(text);
        }
    }
    Some(Case {
        name,
        text: edited(base, &edits),
        set,
        expected,
    })
}

fn found(errors: &ScenarioErrors) -> String {
    let line = |p| {
        let place = errors
            .place(p)
            .map_or("-".to_owned(), |(line, column)| format!("{line}:{column}"));
        format!(
            "\n    => {place} {} | {}",
            p.message,
            p.help.as_deref().unwrap_or_default()
        )
    };
    errors.problems.iter().map(line).collect()
}

fn check(cases: &str) {
    check_edits(BASE, cases);
}

/// Cases that are edits of a base scene.
fn check_edits(base: &str, cases: &str) {
    let mut wrong = String::new();
    let cases = cases
        .strip_prefix("== ")
        .expect("a file of cases begins with one");
    for case in cases.split("\n== ") {
        let case = read_case(base, case).unwrap_or_else(|| panic!("not a case: {case}"));
        assert!(
            !case.expected.is_empty(),
            "{}: no problem expected",
            case.name
        );
        let Err(errors) = parse(&case.text, "scene.toml", &case.set) else {
            wrong += &format!("{}: accepted\n", case.name);
            continue;
        };
        let matches = errors.problems.len() == case.expected.len()
            && errors
                .problems
                .iter()
                .zip(&case.expected)
                .all(|(p, expected)| {
                    errors.place(p) == expected.place
                        && p.message.contains(expected.message)
                        && p.help
                            .as_deref()
                            .unwrap_or_default()
                            .contains(expected.help)
                });
        if !matches {
            wrong += &format!("{}: found{}\n", case.name, found(&errors));
        }
    }
    assert!(wrong.is_empty(), "{wrong}");
}

#[test]
fn the_base_scene_is_good() {
    let model = parse(BASE, "scene.toml", &[]).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(model.states.len(), 2);
    assert_eq!(model.reference(), [1.0, 0.0]);
}

#[test]
fn syntax_of_expressions() {
    check(include_str!("../malformed/syntax.cases"));
}

#[test]
fn places_inside_strings() {
    check(include_str!("../malformed/places.cases"));
}

#[test]
fn names_in_expressions() {
    check(include_str!("../malformed/names.cases"));
}

#[test]
fn periods() {
    check(include_str!("../malformed/periods.cases"));
}

#[test]
fn workarounds() {
    check(include_str!("../malformed/workarounds.cases"));
}

#[test]
fn declarations() {
    check(include_str!("../malformed/declarations.cases"));
}

#[test]
fn sections() {
    check(include_str!("../malformed/sections.cases"));
}

#[test]
fn horizon_and_equilibrium() {
    check(include_str!("../malformed/horizon.cases"));
}

#[test]
fn guards() {
    check(include_str!("../malformed/guards.cases"));
}

#[test]
fn settings() {
    check(include_str!("../malformed/settings.cases"));
}

#[test]
fn closed_loops() {
    check(include_str!("../malformed/closed_loop.cases"));
}

#[test]
fn attenuation() {
    check(include_str!("../malformed/attenuation.cases"));
}

#[test]
fn dissipation() {
    check(include_str!("../malformed/dissipation.cases"));
}

#[test]
fn mechanisms() {
    parse(MECHANISM, "scene.toml", &[]).unwrap_or_else(|e| panic!("{e}"));
    check_edits(MECHANISM, include_str!("../malformed/mechanism.cases"));
}

#[test]
fn toml_itself() {
    check(include_str!("../malformed/toml.cases"));
}

#[test]
fn all_problems_of_a_file_at_once() {
    check(include_str!("../malformed/many.cases"));
}

#[test]
fn an_empty_file_lacks_the_required_sections() {
    let errors = parse("", "scene.toml", &[]).expect_err("nothing in it");
    let missing = ["states", "controls", "dynamics", "cost", "region"]
        .map(|s| format!("section [{s}] is missing"));
    assert_eq!(
        errors
            .problems
            .iter()
            .map(|p| p.message.clone())
            .collect::<Vec<_>>(),
        missing
    );
}

#[test]
fn no_expression_overflows_the_stack() {
    let deep = |n: usize| format!("omega = \"u + {}sin(e){}\"", "(".repeat(n), ")".repeat(n));
    let (signs, powers) = (
        format!("omega = \"u + {}e\"", "-".repeat(100_000)),
        format!("omega = \"u + e{}\"", "^e".repeat(100_000)),
    );
    let calls = format!(
        "omega = \"u + {}e{}\"",
        "sin(".repeat(100_000),
        ")".repeat(100_000)
    );
    let long = format!("omega = \"u{}\"", " + e".repeat(600_000));
    for (line, message) in [
        (deep(10_000), "nested more than 200 deep"),
        (signs, "nested more than 200 deep"),
        (powers, "nested more than 200 deep"),
        (calls, "nested more than 200 deep"),
        (long, "more than 1000000 numbers"),
    ] {
        let text = with_line(14, &line);
        let errors = parse(&text, "scene.toml", &[]).expect_err("too deep or too long");
        assert_eq!(errors.problems.len(), 1, "{message}");
        assert!(
            errors.problems[0].message.contains(message),
            "{}",
            errors.problems[0].message
        );
        // A line of megabytes is not shown whole.
        assert!(errors.render(false).len() < 4000);
        assert!(errors.render(false).contains("scene.toml:14:"));
    }
    assert!(parse(&with_line(14, &deep(190)), "scene.toml", &[]).is_ok());
}

#[test]
fn a_long_sum_is_read() {
    let sum: String = (0..100_000).map(|k| format!(" + sin({k}*e)")).collect();
    let model = parse(
        &with_line(14, &format!("omega = \"u{sum}\"")),
        "scene.toml",
        &[],
    )
    .unwrap_or_else(|e| panic!("{e}"));
    let shown = model.graph.show(model.dynamics[1].expr);
    assert!(
        shown.ends_with("sin(99999*(theta - 1))"),
        "{}",
        &shown[shown.len() - 60..]
    );
}

#[test]
fn reports() {
    let text =
        with_line(14, r#"omega = "-g*sin(thta) + u""#).replace("[integrator]", "[integratr]");
    let errors = parse(&text, "dir/scene.toml", &[("x".to_owned(), "1".to_owned())])
        .expect_err("two mistakes");
    let plain = errors.to_string();
    assert_eq!(
        plain,
        "dir/scene.toml:14:17: unknown name `thta` (did you mean `theta`?)\n\
         dir/scene.toml:29:2: unknown section [integratr] (did you mean `integrator`?)\n\
         dir/scene.toml: --set x=1: there is no parameter `x`"
    );
    let shown = errors.render(false);
    for part in [
        "dir/scene.toml:14:17",
        "-g*sin(thta) + u",
        "──┬─",
        "not declared anywhere",
        "help: did you mean `theta`?",
        "3 problems in dir/scene.toml",
    ] {
        assert!(shown.contains(part), "{part} is not in\n{shown}");
    }
    assert!(!shown.contains('\u{1b}'), "no colours unless asked for");
    assert!(errors.render(true).contains('\u{1b}'));
}

#[test]
fn the_report_counts_characters_like_the_plain_form() {
    let long = format!("omega = \"u + {} thta\"", "e + ".repeat(200));
    for line in [
        "omega = \"u + thta\" # \u{3c8}",
        "  omega = \"\"\"u + \u{e4}\"\"\"",
        &long,
    ] {
        // A byte order mark is not a character of the first line.
        let text = with_line(14, line);
        for text in [
            text.clone(),
            format!("\u{feff}{text}"),
            text.replace('\n', "\r\n"),
        ] {
            let errors = parse(&text, "scene.toml", &[]).expect_err("a mistake");
            let (line, column) = errors.place(&errors.problems[0]).expect("it has a place");
            let shown = errors.render(false);
            assert!(
                shown.contains(&format!("[scene.toml:{line}:{column}]")),
                "{line}:{column} is not in\n{shown}"
            );
            assert_eq!((line, errors.problems.len()), (14, 1));
        }
    }
}

#[test]
fn files_that_cannot_be_read() {
    let missing =
        load(std::path::Path::new("no/such/scene.toml"), &[]).expect_err("there is no such file");
    assert!(matches!(missing, LoadError::Read { .. }));
    assert!(
        missing
            .to_string()
            .starts_with("cannot read no/such/scene.toml")
    );
}

#[test]
fn events() {
    check(include_str!("../malformed/events.cases"));
}

#[test]
fn events_of_mechanisms() {
    check_edits(
        MECHANISM,
        include_str!("../malformed/mechanism_events.cases"),
    );
}
