//! What `costate solve` answers at the states that the user listed, one by one.

use super::solved::Solved;
use crate::args::SolveArgs;
use crate::common::columns::columns;
use crate::common::csv_text;
use crate::error::CliError;
use costate::low_level::model::Model;
use costate::low_level::numeric::digits::plain;
use costate::low_level::numeric::quantile::nearest_rank;
use costate::low_level::value::Answers;
use costate::session::Outcome;
use costate::session::summary::AnswerSummary;

/// V and u at the first few states that the user listed.
pub fn text(done: &Solved<'_>, answers: &Answers) -> Vec<String> {
    const SHOWN: usize = 10;
    if done.outcome.listed == 0 {
        return Vec::new();
    }
    let controls = done.model.controls.iter().map(|c| c.variable.name.clone());
    let header = done
        .names
        .iter()
        .cloned()
        .chain(["V".to_owned()])
        .chain(controls);
    let mut table: Vec<Vec<String>> = vec![header.chain(["status".to_owned()]).collect()];
    let last = table[0].len() - 1;
    let listed = &answers.targets.of_given[..done.outcome.listed];
    table.extend((listed.iter().take(SHOWN)).map(|target| shown_row(answers, *target, last)));
    let mut lines: Vec<String> = columns(&table, &[last])
        .lines()
        .map(|line| format!("  {line}"))
        .collect();
    if done.outcome.listed > SHOWN {
        lines.push(format!(
            "  and {} more: see the file, or --json",
            done.outcome.listed - SHOWN
        ));
    }
    lines.extend(flown(done, answers));
    lines
}

/// A state, V and u there, and in the `last` column what they rest on.
fn shown_row(answers: &Answers, target: usize, last: usize) -> Vec<String> {
    let short = |v: f64| match v.abs() {
        size if size == 0.0 || (1e-3..1e6).contains(&size) => format!("{v:.6}"),
        _ => format!("{v:.6e}"),
    };
    let state = answers.targets.state(target);
    let mut row: Vec<String> = state.iter().copied().map(plain).collect();
    let Some(answer) = answers.answer(target) else {
        row.resize(last, "-".to_owned());
        row.push(answers.status(target).name().replace('_', " "));
        return row;
    };
    row.push(format!("{:.12}", answer.value));
    row.extend(answer.u.iter().copied().map(short));
    let sheets = match answers.of(target).len() {
        1 => String::new(),
        n => format!(", least of {n} solutions"),
    };
    let bound = match answers.support[target].bound {
        Some(bound) => format!("; NOT THE LEAST: a flown control costs {bound:.9}"),
        None => String::new(),
    };
    row.push(format!(
        "{}{sheets}{bound}",
        answers.evidence(target).name().replace('_', " ")
    ));
    row
}

/// Share of V by which a flight may cost more without a word.
const LOOSE: f64 = 1e-4;

/// What simulated controls along the answers have cost.
fn flown(done: &Solved<'_>, answers: &Answers) -> Option<String> {
    let listed = &answers.targets.of_given[..done.outcome.listed];
    // Next to the equilibrium V says nothing of its own size.
    let mut sizes: Vec<f64> = listed
        .iter()
        .filter_map(|t| Some(answers.answer(*t)?.value.abs()))
        .collect();
    sizes.sort_by(f64::total_cmp);
    let least = (0.01 * nearest_rank(&sizes, 0.5)).max(f64::MIN_POSITIVE);
    let all = listed.iter().zip(1..).filter_map(|(&target, number)| {
        let (value, flown) = (
            answers.answer(target)?.value,
            answers.support[target].flown?,
        );
        Some((number, (flown - value) / value.abs().max(least)))
    });
    let (mut home, lost): (Vec<(usize, f64)>, Vec<_>) = all.partition(|(_, more)| more.is_finite());
    home.sort_by(|a, b| a.1.total_cmp(&b.1));
    let (loosest, most) = home.last().copied().unwrap_or((0, f64::NEG_INFINITY));
    // A bound that is far above V is no sign that V is wrong: the control was not followed well.
    let loose = match home.len() {
        2.. if most > LOOSE => format!(
            " (at number {loosest}; half of them at most {:.1e})",
            home[(home.len() - 1) / 2].1.max(0.0)
        ),
        _ => String::new(),
    };
    let lost: Vec<usize> = lost.into_iter().map(|(number, _)| number).collect();
    let said = |what: String| format!("  simulated along the answers, the controls cost {what}");
    match (home.len(), lost.len()) {
        (0, 0) => None,
        (0, _) => Some(said(format!(
            "no bound: {} did not come home",
            numbered(&lost)
        ))),
        (_, 0) if most <= 0.0 => Some(said("V and no more".to_owned())),
        (_, 0) => Some(said(format!("V and at most {most:.1e} of it more{loose}"))),
        (home, _) => Some(said(format!(
            "V and at most {most:.1e} of it more{loose} from {home} states; from {} they did not come home",
            numbered(&lost)
        ))),
    }
}

/// How many states, and the numbers of the first of them in the order in which they were listed.
fn numbered(states: &[usize]) -> String {
    const MOST: usize = 5;
    let first: Vec<String> = states.iter().take(MOST).map(usize::to_string).collect();
    let more = if states.len() > MOST { ", ..." } else { "" };
    let word = if states.len() == 1 {
        "number"
    } else {
        "numbers"
    };
    format!("{} ({word} {}{more})", states.len(), first.join(", "))
}

/// The answers at the states that the user listed, in their order; at most the first 1000.
pub fn points(outcome: &Outcome) -> Vec<AnswerSummary> {
    const MOST: usize = 1000;
    AnswerSummary::all(outcome, MOST)
}

/// Whether the answers are to be written as a table, not as a result file.
pub fn is_table(args: &SolveArgs) -> bool {
    let extension = args.run.out.as_deref().and_then(std::path::Path::extension);
    extension.is_some_and(|e| e.eq_ignore_ascii_case("csv"))
}

/// Columns beside those of the states and controls.
const COLUMNS: [&str; 6] = [
    "sheet",
    "sheets",
    "status",
    "evidence",
    "covered_to",
    "bound",
];

fn header(model: &Model) -> Vec<String> {
    let states = || model.states.iter().map(|s| s.variable.name.clone());
    let controls = model.controls.iter().map(|c| c.variable.name.clone());
    (states().chain(["V".to_owned()]))
        .chain(states().map(|n| format!("p_{n}")))
        .chain(controls)
        .chain(COLUMNS.map(str::to_owned))
        .collect()
}

/// Refuses what a table has no room for: trajectories, and two columns of one name.
pub fn check_table(args: &SolveArgs, model: &Model) -> Result<(), CliError> {
    let bad = |reason| CliError::BadOut {
        path: args.run.out.clone().unwrap_or_default(),
        reason,
    };
    if args.trajectories {
        return Err(bad(
            "a table has no room for --trajectories; name a result file, .h5".to_owned(),
        ));
    }
    let mut names = header(model);
    names.sort_unstable();
    if names.windows(2).any(|pair| pair[0] == pair[1]) {
        return Err(bad(
            "a state or control has the name of another column of the table; name a result file, .h5".to_owned(),
        ));
    }
    Ok(())
}

/// A CSV table of the states that the user listed; empty fields where V is not known.
pub fn table(outcome: &Outcome, model: &Model) -> Result<String, CliError> {
    let mut rows = vec![header(model)];
    let number = |v: f64| {
        if v.is_finite() {
            plain(v)
        } else {
            String::new()
        }
    };
    if let Some(answers) = &outcome.answers {
        for &target in &answers.targets.of_given[..outcome.listed] {
            let mut row: Vec<String> = answers
                .targets
                .state(target)
                .iter()
                .copied()
                .map(plain)
                .collect();
            match answers.answer(target) {
                Some(a) => {
                    row.extend(
                        [a.value]
                            .iter()
                            .chain(&a.p)
                            .chain(&a.u)
                            .copied()
                            .map(number),
                    );
                    row.push(a.sheet.to_string());
                }
                None => row.resize(rows[0].len() - COLUMNS.len() + 1, String::new()),
            }
            row.push(answers.of(target).len().to_string());
            row.push(answers.status(target).name().to_owned());
            row.push(answers.evidence(target).name().to_owned());
            row.push(number(answers.support[target].covered_to));
            row.push(
                answers.support[target]
                    .bound
                    .map_or_else(String::new, number),
            );
            rows.push(row);
        }
    }
    csv_text(&rows)
}
