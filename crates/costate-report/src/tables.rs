//! Tables of a report: key figures, and groups with a row a law or a case.

use super::ticks::significant;
use super::{Source, names};
use costate::low_level::result::{Array, StoredGroup};
use costate::low_level::schema;
use costate::low_level::value::PointStatus;
use costate::session::summary::{Cell, Quantiles, RunSummary, SolvedSummary};
use std::collections::BTreeMap;

/// A table; the first column names the rows.
pub struct Table {
    pub title: String,
    pub columns: Vec<String>,
    pub rows: Vec<Vec<String>>,
    pub caption: String,
}

/// Groups that are shown as tables: name, title, caption.
static GROUPS: [(&schema::Group, &str, &str); 8] = [
    (
        &schema::FEEDBACK,
        "Fitted laws",
        "Errors are of held-out trajectories; the whole law is in the result file.",
    ),
    (
        &schema::CLOSED_LOOP_LAWS,
        "Closed loops",
        "One row a law, all from the same initial states. J/V \u{2212} 1 is the loss against the optimum.",
    ),
    (
        &schema::OPERATING_SETS,
        "Operating sets",
        "Share of initial states inside, and area in the units of the grid's axes.",
    ),
    (
        &schema::DISSIPATION_KINDS,
        "Dissipation inequality",
        "E_z + V(x(t)) \u{2264} W + V0 under disturbances of each kind: E_z is what they did, W what they paid for. A ratio is E_z/(W + V0); \
         violations are relative to W + V0.",
    ),
    (&schema::STUDY, "Study", "One row a variant."),
    (
        &schema::SIMULATION,
        "Simulated flights",
        "x0 is the state at the beginning, x end the last one.",
    ),
    (
        &schema::SIMULATION_EVENTS,
        "Events of the flights",
        "The state before and after each jump.",
    ),
    (
        &schema::CYCLES,
        "Orbits",
        "x is the state after the event that an orbit begins with. Multipliers are those of the return map: neighbours come back to \
         the orbit where all are smaller than 1.",
    ),
];
/// Dimensions along which rows go, where they have names or numbers.
const ALONG: [&str; 6] = ["law", "variant", "row", "jump", "cycle", "flight"];
/// Rows that are shown.
const SHOWN: usize = 40;
/// Longest text shown in a table cell.
const LONGEST: usize = 60;

/// All tables that the file has data for, and groups that could not be read.
pub fn all(source: &Source<'_>) -> (Vec<Table>, Vec<(String, String)>) {
    let (mut tables, mut missing) = (Vec::new(), Vec::new());
    for (schema, title, caption) in GROUPS {
        let Some(group) = source.stored.group(schema) else {
            continue;
        };
        match of_group(&group, title, caption) {
            Some(table) if table.rows.is_empty() => {}
            Some(table) => tables.push(table),
            None => missing.push((
                title.to_owned(),
                format!("/{} has no column of a row's length", schema.name),
            )),
        }
    }
    (tables, missing)
}

/// Columns of one dimension, or of two whose second has names.
fn of_group(group: &StoredGroup<'_>, title: &str, caption: &str) -> Option<Table> {
    let all = group.names();
    // The dimension along which most variables extend: the first one with names.
    let (index, labels) =
        (ALONG.iter()).find_map(|d| Some((*d, texts(group, d).or_else(|| numbered(group, d))?)))?;
    let mut table = Table {
        title: title.to_owned(),
        columns: vec![index.to_owned()],
        rows: labels.iter().map(|l| vec![l.clone()]).collect(),
        caption: caption.to_owned(),
    };
    let others: Vec<(String, Vec<String>)> = (all.iter())
        .filter(|n| *n != index)
        .filter_map(|n| Some((n.clone(), texts(group, n)?)))
        .collect();
    for name in all.iter().filter(|n| *n != index && *n != "toml") {
        if let Some((_, texts)) = others.iter().find(|(n, _)| n == name) {
            if !is_coordinate(name) && *texts != labels {
                table.add_texts(name, texts);
            }
        } else if let Some(words) = coded(group, name) {
            table.add_texts(name, &words);
        } else if let Some(array) = numbers(group, name) {
            let unit = group
                .attribute(Some(name), "units")
                .filter(|u| !u.starts_with("see "));
            let shape = array.shape;
            let values = match is_counted_from_one(name) {
                true => array.values.iter().map(|k| k + 1.0).collect(),
                false => array.values,
            };
            let array = Array { shape, values };
            table.add_numbers(name, &names::unit(unit.as_deref()), &array, &others);
        }
    }
    if is_counted_from_one(index) {
        table.shorten();
    }
    (table.columns.len() > 1 || table.rows.is_empty()).then_some(table)
}

impl Table {
    /// A column of texts, if there is a short one for each row.
    fn add_texts(&mut self, name: &str, texts: &[String]) {
        let is_short = |t: &String| t.len() <= LONGEST && !t.contains('\n');
        if texts.len() == self.rows.len() && texts.iter().all(is_short) {
            self.columns.push(heading(name));
            for (row, text) in self.rows.iter_mut().zip(texts) {
                row.push(text.clone());
            }
        }
    }

    /// Leaves out rows that nobody reads.
    fn shorten(&mut self) {
        let all = self.rows.len();
        if all > SHOWN {
            self.rows.truncate(SHOWN);
            let more =
                format!(" The first {SHOWN} rows of {all}; the others are in the result file.");
            self.caption.push_str(&more);
        }
    }

    /// A column of numbers, or one for each component where these have names among the group's
    /// texts.
    fn add_numbers(
        &mut self,
        name: &str,
        unit: &str,
        array: &Array,
        texts: &[(String, Vec<String>)],
    ) {
        match array.shape.as_slice() {
            [count] if *count == self.rows.len() => {
                self.columns.push(format!("{}{unit}", heading(name)));
                for (row, v) in self.rows.iter_mut().zip(&array.values) {
                    row.push(significant(*v, 4));
                }
            }
            [count, width] if *count == self.rows.len() => {
                for (k, part) in components(name, *width, texts).iter().enumerate() {
                    self.columns.push(format!("{} {part}{unit}", heading(name)));
                    for (row, values) in self.rows.iter_mut().zip(array.values.chunks(*width)) {
                        row.push(significant(values[k], 4));
                    }
                }
            }
            _ => {}
        }
    }
}

/// The names along a variable's second dimension; none where nothing has as many.
fn components(name: &str, width: usize, texts: &[(String, Vec<String>)]) -> Vec<String> {
    if name.starts_with("multiplier") {
        return (1..=width).map(|k| k.to_string()).collect();
    }
    let own = if name == "u" { "control" } else { "state" };
    let fits =
        |(n, t): &&(String, Vec<String>)| is_coordinate(n) && !n.contains('_') && t.len() == width;
    let first = texts.iter().filter(fits).min_by_key(|(n, _)| n != own);
    first.map_or_else(Vec::new, |(_, parts)| parts.clone())
}

/// Names along a dimension, or what is said of them.
fn is_coordinate(name: &str) -> bool {
    ["state", "control", "set", "output", "input"].contains(&name)
        || name.ends_with("_units")
        || name.ends_with("_long_name")
}

/// Numbers, integers too.
fn numbers(group: &StoredGroup<'_>, name: &str) -> Option<Array> {
    let integers = || {
        let (shape, values) = group.i32(name).ok()?;
        let values = values.into_iter().map(f64::from).collect();
        Some(Array { shape, values })
    };
    group.f64(name).ok().or_else(integers)
}

/// Codes in words.
fn coded(group: &StoredGroup<'_>, name: &str) -> Option<Vec<String>> {
    let meanings = group.meanings(name);
    if meanings.is_empty() {
        return None;
    }
    let (_, codes) = group.i32(name).ok()?;
    let word = |code: &i32| meanings.get(code).cloned().unwrap_or(code.to_string());
    Some(codes.iter().map(word).collect())
}

/// What readers know by its number rather than its index.
fn is_counted_from_one(name: &str) -> bool {
    ["jump", "cycle", "flight"].contains(&name)
}

/// Texts; numbers are none.
fn texts(group: &StoredGroup<'_>, name: &str) -> Option<Vec<String>> {
    group.texts(name).ok().filter(|t| !t.is_empty())
}

fn numbered(group: &StoredGroup<'_>, dimension: &str) -> Option<Vec<String>> {
    if !group.has(dimension) {
        return None;
    }
    if let Ok(values) = group.f64(dimension) {
        let first = f64::from(u8::from(is_counted_from_one(dimension)));
        return Some(
            (values.values.iter())
                .map(|v| significant(*v + first, 6))
                .collect(),
        );
    }
    // Rows without numbers are counted.
    let count = (group.names().iter()).find_map(|n| group.f64(n).ok()?.shape.first().copied())?;
    Some((0..count).map(|k| k.to_string()).collect())
}

fn heading(name: &str) -> String {
    name.replace('_', " ")
}

/// What the run was, and how well it went: name and value. A summary that cannot be read is one of
/// them.
pub fn key_figures(source: &Source<'_>) -> Vec<(String, String)> {
    let mut figures = Figures::default();
    let summary = match source.stored.run_summary() {
        Ok(summary) => summary,
        Err(reason) => {
            figures.add("Summary", format!("cannot be read: {reason}"));
            None
        }
    };
    if let Some((shard, of)) = source.stored.shard() {
        figures.add(
            "Shard",
            format!("{shard} of {of} (from 0): what others have is not in it"),
        );
    }
    match source.stored.shards_lacking() {
        Some(shards) => figures.add("Shards that are not in it", shards),
        None => figures.add(
            "Ended early",
            summary.as_ref().map_or_else(String::new, ended_early),
        ),
    }
    if let [first, ..] = source.stored.absent_parts() {
        let count = source.stored.absent_parts().len();
        let gone = format!("{count} ({first}): nothing is known of the states there");
        figures.add("Parts that are gone", gone);
    }
    match summary.as_ref().filter(|s| s.trajectories_stored) {
        Some(s) => figures.add_sweep(s),
        None => {
            if let Ok(Some(t)) = source.trajectories() {
                figures.add("Trajectories", t.count.to_string());
            }
        }
    }
    if let Some(solved) = summary.as_ref().and_then(|s| s.homotopy.as_ref()) {
        figures.add_solved(solved);
    }
    figures.add(
        "Attenuation",
        super::pictures::attenuation_figure(source).unwrap_or_default(),
    );
    if let Some(met) = summary.as_ref().and_then(|s| s.error_met) {
        let met = if met { "met" } else { "NOT met" };
        figures.add("Promised accuracy", met.to_owned());
    }
    figures.add_provenance(source, summary.as_ref());
    figures.0
}

/// What a run that a limit or a signal ended has not done; nothing for others.
fn ended_early(summary: &RunSummary) -> String {
    let alone = summary.trajectories == 0 && summary.homotopy.is_none() && summary.map.is_none();
    let variants = summary.study.as_deref().unwrap_or_default();
    if summary.stopped && alone && !variants.is_empty() {
        let late = Cell::Text(PointStatus::OutOfTime.name().to_owned());
        let left = variants
            .iter()
            .filter(|row| row.get("status") == Some(&late));
        return match (left.count(), variants.len()) {
            (left, all) if left == all => format!("before any of the {all} variants was done"),
            (left, all) => format!("{left} of the {all} variants were not done"),
        };
    }
    match (summary.stopped, summary.laws_stopped) {
        (true, _) => "before everything was swept and solved: a cheaper solution may be missing",
        (false, true) => "after everything was solved, before all laws and closed loops were done",
        (false, false) => "",
    }
    .to_owned()
}

/// Names with values, those that have one.
#[derive(Default)]
struct Figures(Vec<(String, String)>);

impl Figures {
    fn add(&mut self, name: &str, value: String) {
        if !value.is_empty() {
            self.0.push((name.to_owned(), value));
        }
    }

    fn add_sweep(&mut self, summary: &RunSummary) {
        self.add("Trajectories", counts(&summary.status));
        let gaps = &summary.coverage;
        let open = gaps.gaps();
        let widest = gaps.widest_gap.map_or_else(String::new, |w| {
            format!(", the widest {} of the region", significant(w, 3))
        });
        self.add(
            "Fronts",
            match (open, gaps.far()) {
                (0, None) if summary.stopped => {
                    "no gaps in what is there, which is not all".to_owned()
                }
                (0, None) => match summary.shard {
                    None => "covered".to_owned(),
                    Some([shard, of]) => format!("covered in this part ({shard} of {of}, from 0)"),
                },
                (0, Some(far)) => format!("not covered: {far}"),
                _ => format!("{open} gaps left{widest}"),
            },
        );
        if let Some(e) = &summary.error_estimate {
            self.add(
                "Errors of the sweep",
                errors([e.value, e.costate, e.control]),
            );
        }
    }

    fn add_solved(&mut self, solved: &SolvedSummary) {
        self.add("Solved states", counts(&solved.status));
        let sheets = format!("{} on {} sheets", solved.solutions, solved.sheets);
        self.add("Solutions", sheets);
        if let Some(e) = &solved.error_estimate {
            self.add(
                "Errors of solved states",
                errors([e.value, e.costate, e.control]),
            );
        }
    }

    /// Where, how, when and by what the file was made.
    fn add_provenance(&mut self, source: &Source<'_>, summary: Option<&RunSummary>) {
        let text = |name: &str| source.stored.attribute(name).unwrap_or_default();
        let backend = [text("backend"), text("adapter")].join(" on ");
        self.add("Backend", backend.trim_matches(|c| c == ' ').to_owned());
        let tolerance = summary.map_or_else(String::new, |s| {
            format!(", rtol {}", significant(s.rtol, 2))
        });
        let arithmetic = format!("{} {}{tolerance}", text("precision"), text("method"));
        self.add("Arithmetic", arithmetic.trim().to_owned());
        if let Some(s) = summary {
            self.add("Time", format!("{} s", significant(s.wall_seconds, 3)));
        }
        self.add("Created", text("created"));
        self.add("Command", text("command"));
        let version = [text("costate_version"), text("git_revision")].join(" ");
        self.add("Version", version.trim().to_owned());
    }
}

/// The worst errors of V, p and u.
fn errors(of: [Option<Quantiles>; 3]) -> String {
    let worst = ["V", "p", "u"].iter().zip(of).filter_map(|(name, q)| {
        let worst = q?.max?;
        Some(format!("{name} {}", significant(worst, 2)))
    });
    let parts: Vec<String> = worst.collect();
    match parts.is_empty() {
        true => String::new(),
        false => format!("worst of a sample: {}", parts.join(", ")),
    }
}

fn counts(of: &BTreeMap<String, usize>) -> String {
    let each = of
        .iter()
        .map(|(k, n)| format!("{n} {}", k.replace('_', " ")));
    each.collect::<Vec<_>>().join(", ")
}
