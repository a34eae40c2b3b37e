//! `costate value`: V, p and u interpolated from a result file.

use crate::args::{PrecisionChoice, ValueArgs};
use crate::common::points::{TimeColumn, argument, number};
use crate::common::{
    Kind, check_out, csv_text, note_ended_early, open, points, print, print_json, provenance,
};
use crate::error::{CliError, PlaceError};
use crate::terminal::Terminal;
use costate::backend::Backend;
use costate::low_level::diagnostics::shorten;
use costate::low_level::files::write_text;
use costate::low_level::hdf5::ResultFile;
#[cfg(feature = "gpu")]
use costate::low_level::map::DeviceMap;
use costate::low_level::map::{At, Coverage, Fronts, Unknown, Value, ValueMap};
use costate::low_level::model::{Model, Precision};
use costate::low_level::numeric::digits::plain;
use costate::low_level::numeric::quantile::median_p99_max;
use costate::low_level::result::TrajectorySchema;
use costate::low_level::result::{Places, RunRecord, Stored, Times};
use costate::low_level::schema;
use costate::low_level::value::Grid;
use costate::run::Provenance;
use costate::session::Progress;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Most points of a grid.
const MOST_POINTS: usize = 20_000_000;

pub fn value(args: &ValueArgs) -> Result<(), CliError> {
    let provenance = provenance();
    let terminal = Terminal::with(args.quiet, args.json);
    if args.at.is_empty() && args.points.is_none() && args.grid.is_empty() {
        return Err(PlaceError::Nothing.into());
    }
    if let Some(out) = &args.out {
        let inputs: Vec<&Path> = [&args.file]
            .into_iter()
            .chain(&args.points)
            .map(PathBuf::as_path)
            .collect();
        check_out(Some(out), &[Kind::Result, Kind::Table], &inputs)?;
    }
    let stored = Stored::open(&args.file)?;
    note_ended_early(&stored, &terminal);
    let model = &stored.scene.model;
    let places = Wanted::of(args, &stored)?;
    let file = args.out.as_ref().filter(|out| !is_csv(out));
    if let (Some(out), true) = (file, places.grid.is_some()) {
        refuse_axes(out, model)?;
    }

    let map = stored.value_map()?;
    let asked = ask(&map, &places.states, &places.times, args)?;
    let answer = Answer {
        model,
        map: &map,
        places: &places,
        asked: &asked,
        provenance: &provenance,
    };
    match &args.out {
        Some(out) => {
            match is_csv(out) {
                true => write_text(out, &answer.table()?)?,
                false => answer.to_file(out, args)?,
            }
            answer.summarize(out, args, &terminal)
        }
        None if args.json => answer.print_json(),
        None if places.grid.is_some() || args.points.is_some() => {
            print(&answer.table()?)?;
            // The table itself says it of each state.
            if let Some(note) = of_all(&asked.found, map.fronts()) {
                terminal.note(&note);
            }
            Ok(())
        }
        None => answer.say(&terminal),
    }
}

/// The states, and times, at which V is wanted.
struct Wanted {
    grid: Option<Vec<Vec<f64>>>,
    states: Vec<f64>,
    times: Vec<f64>,
}

impl Wanted {
    fn of(args: &ValueArgs, stored: &Stored) -> Result<Self, CliError> {
        let model = &stored.scene.model;
        // A missing map is told later; here what is asked of it.
        let knows = stored
            .map_pieces()?
            .is_some_and(|p| p.states() > model.states.len());
        let check = |t: f64| known_time(model, knows, t);
        let n = model.states.len();
        let time = || TimeColumn {
            name: model.time_name(),
            known: knows,
            check: &check,
        };
        let mut grid = grid(&args.grid, model, &time())?;
        let (mut states, mut times) = (Vec::new(), Vec::new());
        for at in &args.at {
            let (x, t) = points::single(at, model, Some(&time()))?;
            states.extend(x);
            times.push(t);
        }
        if let Some(path) = &args.points {
            let (x, t) = points::read_with_times(path, model, Some(time()))?;
            states.extend(x);
            times.extend(t);
        }
        if let Some(axes) = &mut grid {
            let all = Grid { axes: axes.clone() }.points();
            states = all.chunks(n + 1).flat_map(|x| &x[..n]).copied().collect();
            times = all.chunks(n + 1).map(|x| x[n]).collect();
            if !knows {
                axes.pop();
            }
        }
        Ok(Self {
            grid,
            states,
            times,
        })
    }
}

/// Refuses states that are named like a variable of `/map`.
fn refuse_axes(out: &Path, model: &Model) -> Result<(), CliError> {
    let mut names = model.states.iter().map(|s| s.variable.name.as_str());
    let Some(name) = names.find(|name| schema::MAP.reserves(name)) else {
        return Ok(());
    };
    Err(CliError::BadOut {
        path: out.to_owned(),
        reason: format!(
            "a state named `{name}` cannot be an axis of /map, which has a variable of that name: rename the state, or name a table, .csv"
        ),
    })
}

/// What the map returned, to be printed or written.
struct Answer<'a> {
    model: &'a Model,
    map: &'a ValueMap,
    places: &'a Wanted,
    asked: &'a Asked,
    provenance: &'a Provenance,
}

impl Answer<'_> {
    /// The times, where V depends on it.
    fn times(&self) -> Option<&Vec<f64>> {
        self.map.time().is_some().then_some(&self.places.times)
    }

    /// Each state with its time and what is known there.
    fn each(&self) -> impl Iterator<Item = ((&[f64], Option<f64>), &At)> {
        let states = self.places.states.chunks(self.map.states());
        (states.zip(&self.asked.found).enumerate())
            .map(|(k, (x, at))| ((x, self.times().map(|t| t[k])), at))
    }

    fn table(&self) -> Result<String, CliError> {
        table(
            self.model,
            &self.places.states,
            self.times(),
            &self.asked.found,
            self.map,
        )
    }

    fn print_json(&self) -> Result<(), CliError> {
        let all = self
            .each()
            .map(|(x, at)| as_json(self.model, x, at, self.map));
        print_json(&all.collect::<Vec<_>>())
    }

    fn say(&self, terminal: &Terminal) -> Result<(), CliError> {
        let asked = self.asked;
        if asked.backend == "gpu" {
            let precision = asked.precision.name();
            terminal.say(&format!("gpu on {}, {precision}", asked.adapter))?;
        }
        for (x, at) in self.each() {
            terminal.say(&as_text(self.model, x, at, self.map))?;
        }
        Ok(())
    }

    fn to_file(&self, out: &Path, args: &ValueArgs) -> Result<(), CliError> {
        let (model, asked) = (self.model, self.asked);
        let mut file = ResultFile::create(out)?;
        let places = match &self.places.grid {
            Some(axes) => Places::Grid(axes),
            None => Places::Points(&self.places.states),
        };
        let named = self.times().map(|t| Times {
            name: model.time_name(),
            t,
        });
        file.interpolated(&TrajectorySchema::axes(model), &places, named, &asked.found)?;
        let record = RunRecord {
            backend: asked.backend.to_owned(),
            adapter: asked.adapter.clone(),
            precision: asked.precision.name().to_owned(),
            method: "interpolation".to_owned(),
            ..self.provenance.record(model)
        };
        record.write(&file)?;
        file.attribute("source", args.file.display().to_string())?;
        if let Some(note) = of_all(&asked.found, self.map.fronts()) {
            file.attribute("coverage", note)?;
        }
        file.finish()?;
        Ok(())
    }

    /// What is said of values that were written.
    fn summarize(&self, out: &Path, args: &ValueArgs, terminal: &Terminal) -> Result<(), CliError> {
        let (found, map) = (&self.asked.found, self.map);
        let known: Vec<&Value> = (found.iter())
            .filter_map(|at| at.lowest.as_ref().ok())
            .collect();
        let errors: Vec<f64> = known.iter().map(|v| v.v_error).collect();
        let [median, most, worst] = median_p99_max(&errors);
        let source = match map.pieces() {
            0 => format!("{} sites", map.sites()),
            n => format!("{n} pieces"),
        };
        let mut text = format!(
            "{} of {} states known, from {source}",
            known.len(),
            found.len()
        );
        if worst.is_finite() {
            let _ = write!(
                text,
                "; error of V: median {median:.1e}, 99 % {most:.1e}, largest {worst:.1e}"
            );
        }
        let _ = write!(
            text,
            "\n{}, {}: {:.2} s, written to {}",
            self.asked.adapter,
            self.asked.precision.name(),
            self.provenance.seconds(),
            out.display()
        );
        terminal.say(&text)?;
        let note = of_all(found, map.fronts());
        if let Some(note) = &note {
            terminal.note(note);
        }
        if args.json {
            let summary = serde_json::json!({
                "file": out.display().to_string(), "states": found.len(), "known": known.len(), "sites": map.sites(), "pieces": map.pieces(),
                "V_error": { "median": median, "p99": most, "max": worst }, "coverage": note,
            });
            print_json(&summary)?;
        }
        Ok(())
    }
}

/// Whether a file is a table by its name.
fn is_csv(out: &Path) -> bool {
    out.extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("csv"))
}

/// What is known, and who was asked.
struct Asked {
    found: Vec<At>,
    backend: &'static str,
    adapter: String,
    precision: Precision,
}

fn ask(map: &ValueMap, states: &[f64], times: &[f64], args: &ValueArgs) -> Result<Asked, CliError> {
    let backend = open::backend(args.backend, args.adapter.as_deref(), None)?;
    let wanted = args.precision.and_then(PrecisionChoice::precision);
    let precision = match wanted {
        Some(precision) => precision,
        None if backend.supports(Precision::F64) => Precision::F64,
        None => Precision::F32,
    };
    let found = match on_device(map, backend.as_ref(), precision, (states, times))? {
        Some(found) => found,
        None if precision == Precision::F64 => map.at_times(states, times, !args.no_errors),
        None => return Err(PlaceError::Precision.into()),
    };
    Ok(Asked {
        found,
        backend: backend.name(),
        adapter: backend.adapter(),
        precision,
    })
}

/// What a GPU knows at states and times; `None` of another backend.
#[cfg(feature = "gpu")]
fn on_device(
    map: &ValueMap,
    backend: &dyn Backend,
    precision: Precision,
    (states, times): (&[f64], &[f64]),
) -> Result<Option<Vec<At>>, CliError> {
    let Some(gpu) = backend.gpu() else {
        return Ok(None);
    };
    let map = DeviceMap::new(map, gpu, precision)?;
    Ok(Some(map.at_times(states, times)?))
}

#[cfg(not(feature = "gpu"))]
fn on_device(
    _: &ValueMap,
    _: &dyn Backend,
    _: Precision,
    _: (&[f64], &[f64]),
) -> Result<Option<Vec<At>>, CliError> {
    Ok(None)
}

/// What is wrong with asking for V at a time; `knows`: the file's map has time as an axis.
fn known_time(model: &Model, knows: bool, t: f64) -> Result<(), String> {
    let name = model.time_name();
    let at = plain(t);
    match model.final_time() {
        _ if t == 0.0 => Ok(()),
        None => Err(format!(
            "`{name}` = {at}, but on an infinite horizon V does not depend on time: leave it out"
        )),
        Some(last) if !(0.0..=last).contains(&t) => Err(format!(
            "`{name}` = {at} is not within the horizon, from 0 to {}",
            plain(last)
        )),
        Some(_) if !knows && model.is_game() => Err(format!(
            "`{name}` = {at}, but of a game V is known at {name} = 0 alone"
        )),
        Some(_) if !knows && model.map_aim.as_ref().is_some_and(|aim| aim.time) => Err(format!(
            "`{name}` = {at}, but the file has no map of V(x, {name}): none was made, it knows nothing, or these are values of one at \
             {name} = 0"
        )),
        Some(_) if !knows => Err(format!(
            "`{name}` = {at}, but the file knows V at {name} = 0 alone: give the scene [map] with error = ... (and not time = false), and \
             run it again"
        )),
        Some(_) => Ok(()),
    }
}

/// The axes of `--grid name=first:last:count` or `name=value`, repeated or separated by commas, the
/// time's last; `None` without any.
fn grid(
    texts: &[String],
    model: &Model,
    time: &TimeColumn<'_>,
) -> Result<Option<Vec<Vec<f64>>>, CliError> {
    if texts.is_empty() {
        return Ok(None);
    }
    let wrong = |text: &str, reason: String| PlaceError::Malformed {
        option: "grid",
        text: shorten(text),
        reason,
    };
    let mut axes: Vec<Vec<f64>> = model.reference().iter().map(|x| vec![*x]).collect();
    axes.push(vec![0.0]);
    let mut given = Vec::new();
    for text in texts.iter().flat_map(|t| t.split(',')) {
        let (state, values) =
            grid_axis(text, &mut given, model, time).map_err(|reason| wrong(text, reason))?;
        axes[state] = values;
    }
    let points = axes
        .iter()
        .fold(1usize, |a, axis| a.saturating_mul(axis.len()));
    if points > MOST_POINTS {
        let reason = format!("{points} points; at most {MOST_POINTS}");
        return Err(wrong(&texts.join(","), reason).into());
    }
    Ok(Some(axes))
}

/// One axis of a grid: the state, or what follows the states, and its values; `given`: those that
/// are there already.
fn grid_axis(
    text: &str,
    given: &mut Vec<usize>,
    model: &Model,
    time: &TimeColumn<'_>,
) -> Result<(usize, Vec<f64>), String> {
    let shape = || "expected NAME=FIRST:LAST:COUNT or NAME=VALUE".to_owned();
    let (name, range) = text.split_once('=').ok_or_else(shape)?;
    let state = argument(name.trim(), model, Some(time))?;
    if given.contains(&state) {
        return Err(format!("`{}` stands there twice", name.trim()));
    }
    given.push(state);
    let parts: Vec<&str> = range.split(':').collect();
    let values = match parts.as_slice() {
        [value] => vec![number(value)?],
        [first, last, count] => {
            let (first, last) = (number(first)?, number(last)?);
            let count: Option<usize> = count.trim().parse().ok();
            let count = count.filter(|c| (2..=1_000_000).contains(c));
            let count = count.ok_or("a count is a whole number from 2 to 1000000")?;
            if last <= first {
                return Err("the last value must be above the first".to_owned());
            }
            costate::low_level::value::spaced(first, last, count)
        }
        _ => return Err(shape()),
    };
    (values.first().into_iter().chain(values.last()))
        .try_for_each(|x| model.check_turns_of(state, *x))
        .map_err(|error| error.to_string())?;
    if state == model.states.len() {
        values.iter().try_for_each(|t| (time.check)(*t))?;
    }
    Ok((state, values))
}

fn names(model: &Model) -> (Vec<&str>, Vec<&str>) {
    (
        model
            .states
            .iter()
            .map(|s| s.variable.name.as_str())
            .collect(),
        model
            .controls
            .iter()
            .map(|c| c.variable.name.as_str())
            .collect(),
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
        "sheet -1 (no labelled solution is near: run with [homotopy] or [map] for labels)"
            .to_owned()
    } else {
        format!("sheet {}", value.sheet)
    }
}

/// Of a map whose first states were not all searched.
const CUT: &str = "the budget ended the search of the map's first states";

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
        Coverage::Uncovered if value.in_pieces => Some(format!("{CUT}: a cheaper sheet may be missing, which the error does not include")),
        Coverage::Uncovered => Some(format!(
            "the fronts of the sweep were not covered here ({}): a cheaper sheet may be missing, which the error does not include",
            gaps(fronts)
        )),
    }
}

/// The gaps that a sweep left, in words.
fn gaps(fronts: &Fronts) -> String {
    let mut text = match (fronts.gaps, fronts.far) {
        _ if fronts.lacks => "parts of the sweep are not in the file".to_owned(),
        (u64::MAX, _) => "the file does not tell its gaps".to_owned(),
        (0, Some(far)) => far.to_string(),
        (0, None) if fronts.end_inside => {
            "on a finite horizon trajectories are swept that end in the region alone".to_owned()
        }
        (0, None) => format!("{} trajectories failed", fronts.failed),
        (n, _) => format!(
            "{n} gaps remain, the widest {:.2} of the region",
            fronts.widest
        ),
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
    let known: Vec<&Value> = found
        .iter()
        .filter_map(|at| at.lowest.as_ref().ok())
        .collect();
    let count = |c: Coverage| known.iter().filter(|v| v.coverage == c).count();
    let (uncovered, searched) = (count(Coverage::Uncovered), count(Coverage::Searched));
    let of_pieces = |v: &&&Value| v.in_pieces && v.coverage == Coverage::Uncovered;
    let cut = known.iter().filter(of_pieces).count();
    if cut > 0 {
        return Some(format!(
            "{cut} of {} answers are of a map to an error. {CUT}: a cheaper sheet may be missing, which the errors do not include",
            known.len()
        ));
    }
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

/// Why V is not known at a state.
fn reason(model: &Model, x: &[f64], unknown: Unknown, map: &ValueMap) -> String {
    match map.outside(x).filter(|_| unknown == Unknown::Far) {
        Some((state, [lo, hi])) => {
            let beyond = if map.maps_beyond() {
                " (of the map round it, which solutions that leave the region have made, too little is known there)"
            } else {
                ""
            };
            format!(
                "{unknown}: {} = {} lies outside the region of the map, from {} to {}{beyond}",
                model.states[state].variable.name,
                plain(x[state]),
                plain(lo),
                plain(hi)
            )
        }
        None => unknown.to_string(),
    }
}

/// V with ten decimals, or as many digits where it is very small or large.
fn ten(v: f64) -> String {
    if v == 0.0 || (1e-3..1e15).contains(&v.abs()) {
        format!("{v:.10}")
    } else {
        format!("{v:.10e}")
    }
}

/// `x` with its time where the map has that axis.
fn as_text(model: &Model, (x, t): (&[f64], Option<f64>), at: &At, map: &ValueMap) -> String {
    let (states, controls) = names(model);
    let time = t.map_or(String::new(), |t| {
        format!(", {} = {}", model.time_name(), plain(t))
    });
    let mut lines = vec![list(&states, x) + &time];
    match &at.lowest {
        Err(unknown) => lines.push(format!(
            "  V is not known: {}",
            reason(model, x, *unknown, map)
        )),
        Ok(here) => {
            lines.extend(value_text(model, t.is_some(), here));
            if let Some(asked) = map.falls_short(here) {
                lines.push(format!(
                    "  the map was asked for an error of {asked:.1e}, which is not met here"
                ));
            }
            lines.extend(
                coverage(here, map.fronts())
                    .into_iter()
                    .chain(undercut(at))
                    .map(|note| format!("  {note}")),
            );
        }
    }
    for other in &at.others {
        lines.push(format!(
            "  also: V = {}, {} ({})",
            ten(other.v),
            list(&controls, &other.u),
            sheet(other)
        ));
    }
    lines.join("\n")
}

/// `x1 = 0.1, x2 = -0.3`.
fn list(names: &[&str], values: &[f64]) -> String {
    let parts: Vec<String> = (names.iter().zip(values))
        .map(|(n, v)| format!("{n} = {}", plain(*v)))
        .collect();
    parts.join(", ")
}

/// V, p, its slope in time if `rate`, and u, with their errors where these are known.
fn value_text(model: &Model, rate: bool, here: &Value) -> Vec<String> {
    let (states, controls) = names(model);
    let error = |e: f64| {
        if e.is_finite() {
            format!(" (error about {e:.1e})")
        } else {
            String::new()
        }
    };
    let mut lines = vec![format!("  V = {}{}", ten(here.v), error(here.v_error))];
    let costates: Vec<String> = states.iter().map(|s| format!("p_{s}")).collect();
    let costates: Vec<&str> = costates.iter().map(String::as_str).collect();
    let relative = if here.p_error.is_finite() {
        format!(" (relative error about {:.1e})", here.p_error)
    } else {
        String::new()
    };
    lines.push(format!("  {}{relative}", list(&costates, &here.p)));
    if rate {
        lines.push(format!(
            "  dV/d{} = {}",
            model.time_name(),
            plain(here.rate)
        ));
    }
    if !controls.is_empty() {
        lines.push(format!(
            "  {}{}",
            list(&controls, &here.u),
            error(here.u_error)
        ));
    }
    lines.push(format!("  {}; {}", sheet(here), how(here)));
    lines
}

fn as_json(
    model: &Model,
    (x, t): (&[f64], Option<f64>),
    at: &At,
    map: &ValueMap,
) -> serde_json::Value {
    let fronts = map.fronts();
    let (states, controls) = names(model);
    let object = |names: &[&str], values: &[f64]| -> serde_json::Value {
        let pairs = names
            .iter()
            .zip(values)
            .map(|(n, v)| ((*n).to_owned(), serde_json::json!(v)));
        serde_json::Value::Object(pairs.collect())
    };
    let value = |v: &Value| {
        let mut all = serde_json::json!({
            "V": v.v, "p": object(&states, &v.p), "u": object(&controls, &v.u), "sheet": v.sheet,
            "V_error": v.v_error, "p_error": v.p_error, "u_error": v.u_error, "sites": v.sites,
            "solved_sites": v.solved, "nearest": v.nearest, "how": how(v),
            "coverage": v.coverage.name(), "coverage_note": coverage(v, fronts),
        });
        if t.is_some() {
            all["dV_dt"] = serde_json::json!(v.rate);
        }
        all
    };
    let mut all = serde_json::json!({
        "x": object(&states, x),
        "value": at.lowest.as_ref().ok().map(value),
        "undercut": undercut(at),
        "unknown": at.lowest.as_ref().err().map(|unknown| reason(model, x, *unknown, map)),
        "other_sheets": at.others.iter().map(value).collect::<Vec<_>>(),
    });
    if let Some(t) = t {
        all["t"] = serde_json::json!(t);
    }
    all
}

/// A CSV table; empty fields where V is not known.
fn table(
    model: &Model,
    states: &[f64],
    times: Option<&Vec<f64>>,
    found: &[At],
    map: &ValueMap,
) -> Result<String, CliError> {
    let header = header(model, times.is_some())?;
    let columns = header.len();
    let mut rows = vec![header];
    for (k, (x, at)) in states.chunks(model.states.len()).zip(found).enumerate() {
        let t = times.map(|t| t[k]);
        let mut row: Vec<String> = x.iter().chain(&t).map(|v| plain(*v)).collect();
        if let Ok(here) = &at.lowest {
            row.extend(fields(here, t.is_some()));
        }
        row.resize(columns - 1, String::new());
        row.push(at.lowest.as_ref().map_or_else(
            |unknown| reason(model, x, *unknown, map),
            |_| "known".to_owned(),
        ));
        rows.push(row);
    }
    csv_text(&rows)
}

/// The columns of the table; `time`: V depends on it.
fn header(model: &Model, time: bool) -> Result<Vec<String>, CliError> {
    let (names, controls) = names(model);
    let mut header: Vec<String> = names.iter().map(|n| (*n).to_owned()).collect();
    header.extend(time.then(|| model.time_name().to_owned()));
    header.push("V".to_owned());
    header.extend(names.iter().map(|n| format!("p_{n}")));
    header.extend(time.then(|| "dV_dt".to_owned()));
    header.extend(controls.iter().map(|n| (*n).to_owned()));
    header.extend(
        [
            "sheet", "V_error", "p_error", "u_error", "coverage", "status",
        ]
        .map(str::to_owned),
    );
    let mut sorted = header.clone();
    sorted.sort_unstable();
    if let Some(pair) = sorted.windows(2).find(|pair| pair[0] == pair[1]) {
        let name = pair[0].clone();
        return Err(PlaceError::TwoColumns { name }.into());
    }
    Ok(header)
}

/// What the table says where V is known, from V to its coverage.
fn fields(here: &Value, time: bool) -> Vec<String> {
    let rate = time.then_some(here.rate);
    let numbers = [here.v];
    let numbers = numbers.iter().chain(&here.p).chain(&rate).chain(&here.u);
    let mut fields: Vec<String> = numbers.map(|v| plain(*v)).collect();
    fields.push(here.sheet.to_string());
    let errors = [here.v_error, here.p_error, here.u_error];
    fields.extend(errors.iter().map(|e| {
        if e.is_finite() {
            plain(*e)
        } else {
            String::new()
        }
    }));
    fields.push(here.coverage.name().to_owned());
    fields
}
