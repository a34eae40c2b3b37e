//! Reading states from a CSV file.

use crate::error::{PlaceError, PointsError};
use costate::low_level::diagnostics::{did_you_mean, shorten};
use costate::low_level::files::{is_hdf5, read_bytes};
use costate::low_level::model::Model;
use std::path::Path;

/// The column of times: its name, and what is wrong with one.
pub struct TimeColumn<'t> {
    pub name: &'t str,
    /// Whether other times than 0 mean anything.
    pub known: bool,
    pub check: &'t dyn Fn(f64) -> Result<(), String>,
}

/// A last column with this name holds V as published, beside the states; nothing is read from it
/// here.
pub const PUBLISHED: &str = "V_published";

/// Whether the last column of a file of points is [`PUBLISHED`], and no state.
pub fn has_published(path: &Path, model: &Model) -> bool {
    let reader = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .comment(Some(b'#'))
        .from_path(path);
    let header = reader.and_then(|mut r| r.headers().cloned());
    header.is_ok_and(|header| is_published(&header, model))
}

fn is_published(header: &csv::StringRecord, model: &Model) -> bool {
    let is_state = model.states.iter().any(|s| s.variable.name == PUBLISHED);
    header.iter().next_back().map(bare) == Some(PUBLISHED) && !is_state
}

/// States `[point][n]` of a CSV file whose header names states; those it does not name stay at the
/// reference point.
pub fn read(path: &Path, model: &Model) -> Result<Vec<f64>, PointsError> {
    Ok(read_with_times(path, model, None)?.0)
}

/// The same, and a time each: that of a column of its own, if `time` says there may be one, else 0.
pub fn read_with_times(
    path: &Path,
    model: &Model,
    time: Option<TimeColumn<'_>>,
) -> Result<(Vec<f64>, Vec<f64>), PointsError> {
    let whole = read_bytes(path).map_err(|source| PointsError::Read {
        path: path.to_owned(),
        source: source.into(),
    })?;
    if let Some(what) = no_table(&whole) {
        let path = path.to_owned();
        return Err(PointsError::NoTable { path, what });
    }
    let mut reader = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .comment(Some(b'#'))
        .from_reader(whole.as_slice());
    let file = PointsFile {
        path,
        whole: &whole,
        model,
        time,
    };
    let header = reader
        .headers()
        .map_err(|e| file.malformed(e, &csv::StringRecord::new()))?
        .clone();
    let columns = file.columns(&header)?;
    let (mut points, mut times) = (Vec::new(), Vec::new());
    for record in reader.records() {
        let record = record.map_err(|e| file.malformed(e, &header))?;
        let (x, t) = file.point(&record, &columns)?;
        times.push(t);
        points.extend(x);
    }
    if points.is_empty() {
        return Err(PointsError::Empty {
            path: path.to_owned(),
        });
    }
    Ok((points, times))
}

/// A state as typed, `name=value,...`, and a time, 0 where it is not given; states not named are at
/// the reference point.
pub fn single(
    text: &str,
    model: &Model,
    time: Option<&TimeColumn<'_>>,
) -> Result<(Vec<f64>, f64), PlaceError> {
    let wrong = |reason: String| PlaceError::Malformed {
        option: "at",
        text: shorten(text),
        reason,
    };
    let mut x = model.reference().to_vec();
    x.push(0.0);
    let mut given = Vec::new();
    for part in text.split(',') {
        let (name, value) = part.split_once('=').ok_or_else(|| {
            wrong(format!(
                "`{part}` is not NAME=VALUE; several are separated by commas"
            ))
        })?;
        let state = argument(name.trim(), model, time).map_err(&wrong)?;
        if given.contains(&state) {
            return Err(wrong(format!("`{}` stands there twice", name.trim())));
        }
        given.push(state);
        x[state] = number(value).map_err(&wrong)?;
        (model.check_turns_of(state, x[state])).map_err(|error| wrong(error.to_string()))?;
    }
    let t = x.pop().unwrap_or(0.0);
    if let Some(time) = time {
        (time.check)(t).map_err(&wrong)?;
    }
    Ok((x, t))
}

/// Number of a state, or of what follows the states: the time.
pub fn argument(name: &str, model: &Model, time: Option<&TimeColumn<'_>>) -> Result<usize, String> {
    if time.is_some_and(|time| time.name == name) {
        return Ok(model.states.len());
    }
    model
        .state(name)
        .map_err(|reason| match time.filter(|time| time.known) {
            Some(time) => format!(
                "{reason}; the map's other axis is the time, `{}`",
                time.name
            ),
            None => reason,
        })
}

pub fn number(text: &str) -> Result<f64, String> {
    let value: Option<f64> = text.trim().parse().ok();
    (value.filter(|v| v.is_finite()))
        .ok_or_else(|| format!("`{}` is not a finite number", shorten(text.trim())))
}

/// What a file is that is no table.
fn no_table(whole: &[u8]) -> Option<&'static str> {
    if is_hdf5(whole) {
        return Some("a result file (HDF5)");
    }
    whole.contains(&0).then_some("no text")
}

/// A file of points while it is read.
struct PointsFile<'a> {
    path: &'a Path,
    whole: &'a [u8],
    model: &'a Model,
    time: Option<TimeColumn<'a>>,
}

impl PointsFile<'_> {
    fn names(&self) -> Vec<&str> {
        let states = self.model.states.iter();
        states.map(|s| s.variable.name.as_str()).collect()
    }

    /// What columns may be called.
    fn arguments(&self) -> String {
        let time = self.time.as_ref().filter(|t| t.known).map(|t| t.name);
        let all: Vec<&str> = self.names().into_iter().chain(time).collect();
        all.join(", ")
    }

    fn line(&self, position: Option<&csv::Position>) -> Option<u64> {
        position.map(|p| line_of(self.whole, p.byte()))
    }

    /// What the reader could not make a record of.
    fn malformed(&self, source: csv::Error, header: &csv::StringRecord) -> PointsError {
        let path = self.path.to_owned();
        let Some(line) = self.line(source.position()) else {
            return PointsError::Read { path, source };
        };
        let reason = match source.kind() {
            csv::ErrorKind::UnequalLengths {
                expected_len, len, ..
            } => {
                format!("{len} values, where the header names {expected_len}")
            }
            csv::ErrorKind::Utf8 { err, .. } => match header.get(err.field()) {
                Some(name) => format!("column `{name}`: no text in UTF-8"),
                None => "no text in UTF-8".to_owned(),
            },
            _ => source.to_string(),
        };
        PointsError::Malformed { path, line, reason }
    }

    /// The state of each column that is read, by its number; the time follows the states.
    fn columns(&self, header: &csv::StringRecord) -> Result<Vec<usize>, PointsError> {
        if header.iter().all(str::is_empty) {
            return Err(PointsError::NoHeader {
                path: self.path.to_owned(),
                states: self.arguments(),
            });
        }
        let names = self.names();
        let mut columns = Vec::new();
        let published = usize::from(is_published(header, self.model));
        for name in header.iter().take(header.len() - published) {
            let name = bare(name);
            let is_time = self.time.as_ref().is_some_and(|t| t.name == name);
            let Some(state) =
                (names.iter().position(|n| *n == name)).or(is_time.then_some(names.len()))
            else {
                return Err(PointsError::UnknownState {
                    path: self.path.to_owned(),
                    name: shorten(name),
                    states: self.arguments(),
                    help: match name.contains([';', '\t']) {
                        true => "; columns are separated by commas".to_owned(),
                        false => did_you_mean(name, names.iter().copied())
                            .map_or_else(String::new, |s| format!("; {s}")),
                    },
                });
            };
            if columns.contains(&state) {
                return Err(PointsError::Twice {
                    path: self.path.to_owned(),
                    name: name.to_owned(),
                });
            }
            columns.push(state);
        }
        Ok(columns)
    }

    /// The state of a record, and its time.
    fn point(
        &self,
        record: &csv::StringRecord,
        columns: &[usize],
    ) -> Result<(Vec<f64>, f64), PointsError> {
        let mut x = self.model.reference().to_vec();
        x.push(0.0);
        let line = || self.line(record.position()).unwrap_or(0);
        for (text, &state) in record.iter().zip(columns) {
            x[state] = (bare(text).parse().ok())
                .filter(|v: &f64| v.is_finite())
                .ok_or_else(|| PointsError::NotANumber {
                    path: self.path.to_owned(),
                    line: line(),
                    name: self.argument(state).to_owned(),
                    text: shorten(text),
                })?;
            (self.model.check_turns_of(state, x[state]))
                .map_err(|error| self.refused(state, line(), error.to_string()))?;
        }
        let t = x.pop().unwrap_or(0.0);
        if let Some(time) = &self.time {
            (time.check)(t).map_err(|reason| self.refused(x.len(), line(), reason))?;
        }
        Ok((x, t))
    }

    /// A number that nothing can be told at.
    fn refused(&self, argument: usize, line: u64, reason: String) -> PointsError {
        PointsError::Refused {
            path: self.path.to_owned(),
            line,
            name: self.argument(argument).to_owned(),
            reason,
        }
    }

    /// Name of a state, or of the time, which follows the states.
    fn argument(&self, k: usize) -> &str {
        let state = self.model.states.get(k);
        state
            .map(|s| s.variable.name.as_str())
            .or(self.time.as_ref().map(|t| t.name))
            .unwrap_or_default()
    }
}

/// A field without a byte order mark and quotes: beside either of these a reader takes quotes for a
/// part of the text.
fn bare(text: &str) -> &str {
    let text = text.trim_start_matches('\u{feff}').trim();
    let inner = text
        .strip_prefix('"')
        .and_then(|text| text.strip_suffix('"'));
    inner.map_or(text, str::trim)
}

/// Line (from 1) of the record that a reader began to look for at a byte: blank lines and comments
/// before it are not it.
fn line_of(text: &[u8], byte: u64) -> u64 {
    let at = (byte as usize).min(text.len());
    let before = text[..at].iter().filter(|b| **b == b'\n').count();
    let skipped = (text[at..].split(|b| *b == b'\n'))
        .take_while(|line| matches!(line, [] | [b'\r'] | [b'#', ..]))
        .count();
    (before + skipped + 1) as u64
}

#[cfg(test)]
mod tests {
    use super::bare;

    #[test]
    fn quotes_and_marks_are_no_part_of_a_field() {
        for text in ["x1", "\u{feff}x1", "\u{feff}\"x1\"", " \"x1\"", "\" x1 \""] {
            assert_eq!(bare(text), "x1");
        }
        assert_eq!(bare("\"x1"), "\"x1");
    }
}
