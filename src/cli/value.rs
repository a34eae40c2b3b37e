//! `costate value`: V, p and u interpolated from a result file.

use super::report::Terminal;
use super::{CliError, PrecisionChoice, ValueArgs, points, run};
use crate::map::{At, Coverage, DeviceMap, Fronts, Value, ValueMap};
use crate::model::{Model, Precision};
use crate::output::{Places, ResultFile, RunRecord, Stored, write_text};
use crate::value::Grid;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::time::{Instant, SystemTime};

/// What is wrong with the places asked for.
#[derive(Debug, thiserror::Error)]
pub(super) enum PlaceError {
    #[error("no states are asked for: give --at NAME=VALUE,..., --points FILE.csv or --grid NAME=FIRST:LAST:COUNT")]
    Nothing,
    #[error("--{option} {text}: {reason}")]
    Malformed {
        option: &'static str,
        text: String,
        reason: String,
    },
    #[error("--precision f32: on the CPU values are those of f64 (--backend gpu has both)")]
    Precision,
    #[error("--out {path}: a table ends in .csv, a result file in .h5", path = path.display())]
    Extension { path: std::path::PathBuf },
}

/// Most points of a grid.
const MOST_POINTS: usize = 20_000_000;

pub(super) fn value(args: &ValueArgs) -> Result<(), CliError> {
    let (started, clock) = (SystemTime::now(), Instant::now());
    let terminal = Terminal::with(args.quiet, args.json);
    if args.at.is_empty() && args.points.is_none() && args.grid.is_empty() {
        return Err(PlaceError::Nothing.into());
    }
    if let Some(out) = &args.out {
        let extension = out.extension().and_then(|e| e.to_str());
        if !matches!(extension, Some("csv" | "h5")) {
            return Err(PlaceError::Extension { path: out.clone() }.into());
        }
        let inputs: Vec<&Path> = [&args.file]
            .into_iter()
            .chain(&args.points)
            .map(PathBuf::as_path)
            .collect();
        super::check_out(Some(out), &["csv", "h5"], &inputs)?;
    }
    let stored = Stored::open(&args.file)?;
    let model = &stored.model;
    let grid = grid(&args.grid, model)?;
    let mut states = Vec::new();
    for at in &args.at {
        states.extend(single(at, model)?);
    }
    if let Some(path) = &args.points {
        states.extend(points::read(path, model)?);
    }
    if let Some(axes) = &grid {
        states = Grid { axes: axes.clone() }.points();
    }
    let map = ValueMap::new(&stored)?;
    let asked = ask(&map, &states, args)?;
    let found = asked.found;
    let many = grid.is_some() || args.points.is_some();
    match &args.out {
        Some(out) if out.extension().is_some_and(|e| e == "h5") => {
            let mut file = ResultFile::create(out)?;
            let places = match &grid {
                Some(axes) => Places::Grid(axes),
                None => Places::Points(&states),
            };
            file.interpolated(&run::axes(model), &places, &found)?;
            let record = RunRecord {
                backend: asked.backend.to_owned(),
                adapter: asked.adapter.clone(),
                precision: asked.precision.name().to_owned(),
                method: "interpolation".to_owned(),
                wall_seconds: clock.elapsed().as_secs_f64(),
                ..RunRecord::begun(model, started)
            };
            record.write(&file)?;
            file.attribute("source", args.file.display().to_string())?;
            if let Some(note) = of_all(&found, map.fronts()) {
                file.attribute("coverage", note)?;
            }
            file.finish()?;
        }
        Some(out) => write_text(out, &table(model, &states, &found)?)?,
        None if args.json => {
            let all: Vec<_> = (states.chunks(map.states()).zip(&found))
                .map(|(x, at)| as_json(model, x, at, map.fronts()))
                .collect();
            super::print(&format!("{:#}\n", serde_json::Value::from(all)))?;
            return Ok(());
        }
        None if many => {
            super::print(&table(model, &states, &found)?)?;
            // The table itself says it of each state.
            if let Some(note) = of_all(&found, map.fronts()) {
                terminal.note(&note);
            }
        }
        None => {
            for (x, at) in states.chunks(map.states()).zip(&found) {
                terminal.say(&as_text(model, x, at, map.fronts()))?;
            }
        }
    }
    if let Some(out) = &args.out {
        let known = found.iter().filter(|at| at.lowest.is_ok()).count();
        let errors: Vec<f64> = found
            .iter()
            .filter_map(|at| at.lowest.as_ref().ok())
            .map(|v| v.v_error)
            .collect();
        let [median, most, worst] = super::report::quantiles(&errors);
        let source = match map.pieces() {
            0 => format!("{} sites", map.sites()),
            n => format!("{n} pieces"),
        };
        let mut text = format!("{known} of {} states known, from {source}", found.len());
        if worst.is_finite() {
            let _ = write!(
                text,
                "; error of V: median {median:.1e}, 99 % {most:.1e}, largest {worst:.1e}"
            );
        }
        let _ = write!(
            text,
            "\n{}, {}: {:.2} s, written to {}",
            asked.adapter,
            asked.precision.name(),
            clock.elapsed().as_secs_f64(),
            out.display()
        );
        terminal.say(&text)?;
        let note = of_all(&found, map.fronts());
        if let Some(note) = &note {
            terminal.note(note);
        }
        if args.json {
            let summary = serde_json::json!({
                "file": out.display().to_string(), "states": found.len(), "known": known, "sites": map.sites(), "pieces": map.pieces(),
                "V_error": { "median": median, "p99": most, "max": worst }, "coverage": note,
            });
            super::print(&format!("{summary:#}\n"))?;
        }
    }
    Ok(())
}

/// What is known, and who was asked.
struct Asked {
    found: Vec<At>,
    backend: &'static str,
    adapter: String,
    precision: Precision,
}

fn ask(map: &ValueMap, states: &[f64], args: &ValueArgs) -> Result<Asked, CliError> {
    let backend = run::open_backend(args.backend, args.adapter.as_deref(), None)?;
    let wanted = args.precision.and_then(PrecisionChoice::precision);
    let precision = match wanted {
        Some(precision) => precision,
        None if backend.supports(Precision::F64) => Precision::F64,
        None => Precision::F32,
    };
    let found = match backend.gpu() {
        Some(gpu) => DeviceMap::new(map, gpu, precision)?.at_many(states)?,
        None if precision == Precision::F64 => map.at_many(states, !args.no_errors),
        None => return Err(PlaceError::Precision.into()),
    };
    Ok(Asked {
        found,
        backend: backend.name(),
        adapter: backend.adapter(),
        precision,
    })
}

/// `name=value,...`; states not named are at the reference point.
fn single(text: &str, model: &Model) -> Result<Vec<f64>, CliError> {
    let wrong = |reason: String| PlaceError::Malformed {
        option: "at",
        text: text.to_owned(),
        reason,
    };
    let mut x = model.reference().to_vec();
    let mut given = Vec::new();
    for part in text.split(',') {
        let (name, value) = part
            .split_once('=')
            .ok_or_else(|| wrong(format!("`{part}` is not NAME=VALUE")))?;
        let state = model.state(name.trim()).map_err(&wrong)?;
        if given.contains(&state) {
            return Err(wrong(format!("`{}` stands there twice", name.trim())).into());
        }
        given.push(state);
        x[state] = number(value).map_err(&wrong)?;
    }
    Ok(x)
}

fn number(text: &str) -> Result<f64, String> {
    let value: Option<f64> = text.trim().parse().ok();
    (value.filter(|v| v.is_finite())).ok_or_else(|| format!("`{}` is not a finite number", text.trim()))
}

/// The axes of `--grid name=first:last:count` or `name=value`, repeated or separated by commas; `None` without any.
fn grid(texts: &[String], model: &Model) -> Result<Option<Vec<Vec<f64>>>, CliError> {
    if texts.is_empty() {
        return Ok(None);
    }
    let mut axes: Vec<Vec<f64>> = model.reference().iter().map(|x| vec![*x]).collect();
    let mut given = Vec::new();
    for text in texts.iter().flat_map(|t| t.split(',')) {
        let wrong = |reason: String| PlaceError::Malformed {
            option: "grid",
            text: text.to_owned(),
            reason,
        };
        let shape = || wrong("expected NAME=FIRST:LAST:COUNT or NAME=VALUE".to_owned());
        let (name, range) = text.split_once('=').ok_or_else(shape)?;
        let state = model.state(name.trim()).map_err(&wrong)?;
        if given.contains(&state) {
            return Err(wrong(format!("`{}` stands there twice", name.trim())).into());
        }
        given.push(state);
        let parts: Vec<&str> = range.split(':').collect();
        axes[state] = match parts.as_slice() {
            [value] => vec![number(value).map_err(&wrong)?],
            [first, last, count] => {
                let (first, last) = (number(first).map_err(&wrong)?, number(last).map_err(&wrong)?);
                let count: Option<usize> = count.trim().parse().ok();
                let count = count.filter(|c| (2..=1_000_000).contains(c));
                let count = count.ok_or_else(|| wrong("a count is a whole number from 2 to 1000000".to_owned()))?;
                if last <= first {
                    return Err(wrong("the last value must be above the first".to_owned()).into());
                }
                crate::value::spaced(first, last, count)
            }
            _ => return Err(shape().into()),
        };
    }
    let points = axes.iter().fold(1usize, |a, axis| a.saturating_mul(axis.len()));
    if points > MOST_POINTS {
        let reason = format!("{points} points; at most {MOST_POINTS}");
        let text = texts.join(",");
        return Err(PlaceError::Malformed {
            option: "grid",
            text,
            reason,
        }
        .into());
    }
    Ok(Some(axes))
}

fn names(model: &Model) -> (Vec<&str>, Vec<&str>) {
    (
        model.states.iter().map(|s| s.variable.name.as_str()).collect(),
        model.controls.iter().map(|c| c.variable.name.as_str()).collect(),
    )
}

/// How a value is known, in words.
fn how(value: &Value) -> String {
    if value.sites == 0 {
        return "from the local solution about the equilibrium".to_owned();
    }
    if value.in_pieces {
        return match value.sites {
            1 => "from one piece of the map".to_owned(),
            n => format!("from {n} pieces of the map, blended"),
        };
    }
    let solved = if value.solved > 0 {
        format!(" ({} of them solved states)", value.solved)
    } else {
        String::new()
    };
    format!(
        "interpolated from {} sites{solved}, the nearest {:.1e} of the region away",
        value.sites, value.nearest
    )
}

fn sheet(value: &Value) -> String {
    if value.sites == 0 {
        "at the equilibrium".to_owned()
    } else if value.sheet < 0 {
        "sheet -1 (no labelled solution is near: run with [homotopy] or [map] for labels)".to_owned()
    } else {
        format!("sheet {}", value.sheet)
    }
}

/// What a value's being the least rests on, where something may be missing.
fn coverage(value: &Value, fronts: &Fronts) -> Option<String> {
    match value.coverage {
        Coverage::Local | Coverage::Covered | Coverage::Checked => None,
        Coverage::Searched if !fronts.swept => Some(
            "from states that were searched for sheets one by one: no sweep shows that no cheaper sheet lies over this state"
                .to_owned(),
        ),
        Coverage::Searched => Some(format!(
            "the fronts of the sweep were not covered here ({}): what is known of cheaper sheets is the search at the solved states",
            gaps(fronts)
        )),
        Coverage::Uncovered => Some(format!(
            "the fronts of the sweep were not covered here ({}): a cheaper sheet may be missing, which the error does not include",
            gaps(fronts)
        )),
    }
}

/// The gaps that a sweep left, in words.
fn gaps(fronts: &Fronts) -> String {
    let mut text = match fronts.gaps {
        u64::MAX => "the file does not tell its gaps".to_owned(),
        0 => format!("{} trajectories failed", fronts.failed),
        n => format!("{n} gaps remain, the widest {:.2} of the region", fronts.widest),
    };
    if fronts.below > 0.0 {
        let _ = write!(text, "; covered up to V = {:.4}", fronts.below);
    }
    text
}

/// A solved state that an interpolated sheet undercuts.
fn undercut(at: &At) -> Option<String> {
    let here = at.lowest.as_ref().ok()?;
    let lower = at.others.first().filter(|other| other.v < here.v)?;
    Some(format!(
        "a sheet interpolated from swept trajectories is lower here, V = {:.6}: the solution may not be the least",
        lower.v
    ))
}

/// The same of all answers in one line; `None` where nothing is missing.
fn of_all(found: &[At], fronts: &Fronts) -> Option<String> {
    let known: Vec<&Value> = found.iter().filter_map(|at| at.lowest.as_ref().ok()).collect();
    let count = |c: Coverage| known.iter().filter(|v| v.coverage == c).count();
    let (uncovered, searched) = (count(Coverage::Uncovered), count(Coverage::Searched));
    if uncovered > 0 {
        return Some(format!(
            "{uncovered} of {} answers lie where the fronts of the sweep were not covered ({}): a cheaper sheet may be missing \
             there, which the errors do not include",
            known.len(),
            gaps(fronts)
        ));
    }
    (searched > 0).then(|| {
        format!(
            "{searched} of {} answers rest on states that were searched for sheets one by one, not on fronts without gaps",
            known.len()
        )
    })
}

fn as_text(model: &Model, x: &[f64], at: &At, fronts: &Fronts) -> String {
    let (states, controls) = names(model);
    let list = |names: &[&str], values: &[f64]| {
        let parts: Vec<String> = names.iter().zip(values).map(|(n, v)| format!("{n} = {v}")).collect();
        parts.join(", ")
    };
    let mut lines = vec![list(&states, x)];
    match &at.lowest {
        Err(unknown) => lines.push(format!("  V is not known: {unknown}")),
        Ok(here) => {
            let error = |e: f64| {
                if e.is_finite() {
                    format!(" (error about {e:.1e})")
                } else {
                    String::new()
                }
            };
            lines.push(format!("  V = {:.10}{}", here.v, error(here.v_error)));
            let costates: Vec<String> = states.iter().map(|s| format!("p_{s}")).collect();
            let costates: Vec<&str> = costates.iter().map(String::as_str).collect();
            let relative = if here.p_error.is_finite() {
                format!(" (relative error about {:.1e})", here.p_error)
            } else {
                String::new()
            };
            lines.push(format!("  {}{relative}", list(&costates, &here.p)));
            if !controls.is_empty() {
                lines.push(format!("  {}{}", list(&controls, &here.u), error(here.u_error)));
            }
            lines.push(format!("  {}; {}", sheet(here), how(here)));
            lines.extend(
                coverage(here, fronts)
                    .into_iter()
                    .chain(undercut(at))
                    .map(|note| format!("  {note}")),
            );
        }
    }
    for other in &at.others {
        lines.push(format!(
            "  also: V = {:.10}, {} ({})",
            other.v,
            list(&controls, &other.u),
            sheet(other)
        ));
    }
    lines.join("\n")
}

fn as_json(model: &Model, x: &[f64], at: &At, fronts: &Fronts) -> serde_json::Value {
    let (states, controls) = names(model);
    let object = |names: &[&str], values: &[f64]| -> serde_json::Value {
        let pairs = names
            .iter()
            .zip(values)
            .map(|(n, v)| ((*n).to_owned(), serde_json::json!(v)));
        serde_json::Value::Object(pairs.collect())
    };
    let value = |v: &Value| {
        serde_json::json!({
            "V": v.v, "p": object(&states, &v.p), "u": object(&controls, &v.u), "sheet": v.sheet,
            "V_error": v.v_error, "p_error": v.p_error, "u_error": v.u_error, "sites": v.sites,
            "solved_sites": v.solved, "nearest": v.nearest, "how": how(v),
            "coverage": v.coverage.name(), "coverage_note": coverage(v, fronts),
        })
    };
    serde_json::json!({
        "x": object(&states, x),
        "value": at.lowest.as_ref().ok().map(value),
        "undercut": undercut(at),
        "unknown": at.lowest.as_ref().err().map(ToString::to_string),
        "other_sheets": at.others.iter().map(value).collect::<Vec<_>>(),
    })
}

/// A CSV table; empty fields where V is not known.
fn table(model: &Model, states: &[f64], found: &[At]) -> Result<String, CliError> {
    let (names, controls) = names(model);
    let mut header: Vec<String> = names.iter().map(|n| (*n).to_owned()).collect();
    header.push("V".to_owned());
    header.extend(names.iter().map(|n| format!("p_{n}")));
    header.extend(controls.iter().map(|n| (*n).to_owned()));
    header.extend(["sheet", "V_error", "p_error", "u_error", "coverage", "status"].map(str::to_owned));
    let columns = header.len();
    let mut rows = vec![header];
    for (x, at) in states.chunks(names.len()).zip(found) {
        let mut row: Vec<String> = x.iter().map(f64::to_string).collect();
        if let Ok(here) = &at.lowest {
            row.extend([here.v].iter().chain(&here.p).chain(&here.u).map(f64::to_string));
            row.push(here.sheet.to_string());
            let errors = [here.v_error, here.p_error, here.u_error];
            row.extend(
                errors
                    .iter()
                    .map(|e| if e.is_finite() { e.to_string() } else { String::new() }),
            );
            row.push(here.coverage.name().to_owned());
        }
        row.resize(columns - 1, String::new());
        row.push(
            at.lowest
                .as_ref()
                .map_or_else(ToString::to_string, |_| "known".to_owned()),
        );
        rows.push(row);
    }
    super::csv_text(&rows)
}
