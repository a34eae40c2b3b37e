//! Reading states from a CSV file.

use crate::error::PointsError;
use costate::low_level::diagnostics::{did_you_mean, shorten};
use costate::low_level::files::read_bytes;
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
    let at = || path.to_owned();
    let whole = read_bytes(path).map_err(|source| PointsError::Read {
        path: at(),
        source: source.into(),
    })?;
    let mut reader = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .comment(Some(b'#'))
        .from_reader(whole.as_slice());
    let names: Vec<&str> = model
        .states
        .iter()
        .map(|s| s.variable.name.as_str())
        .collect();
    let arguments = || {
        let time = time.as_ref().filter(|t| t.known).map(|t| t.name);
        names
            .iter()
            .copied()
            .chain(time)
            .collect::<Vec<&str>>()
            .join(", ")
    };
    let malformed = |source: csv::Error, header: &csv::StringRecord| {
        let Some(line) = source.position().map(|p| line_of(&whole, p.byte())) else {
            return PointsError::Read { path: at(), source };
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
        PointsError::Malformed {
            path: at(),
            line,
            reason,
        }
    };
    let header = reader
        .headers()
        .map_err(|e| malformed(e, &csv::StringRecord::new()))?
        .clone();
    if header.iter().all(str::is_empty) {
        return Err(PointsError::NoHeader {
            path: at(),
            states: arguments(),
        });
    }
    let mut columns = Vec::new();
    let published = usize::from(is_published(&header, model));
    for name in header.iter().take(header.len() - published) {
        let name = bare(name);
        let is_time = time.as_ref().is_some_and(|t| t.name == name);
        let Some(state) =
            (names.iter().position(|n| *n == name)).or(is_time.then_some(names.len()))
        else {
            return Err(PointsError::UnknownState {
                path: at(),
                name: shorten(name),
                states: arguments(),
                help: did_you_mean(name, names.iter().copied())
                    .map_or_else(String::new, |s| format!("; {s}")),
            });
        };
        if columns.contains(&state) {
            return Err(PointsError::Twice {
                path: at(),
                name: name.to_owned(),
            });
        }
        columns.push(state);
    }
    let (mut points, mut times) = (Vec::new(), Vec::new());
    for record in reader.records() {
        let record = record.map_err(|e| malformed(e, &header))?;
        let mut x = model.reference().to_vec();
        x.push(0.0);
        let line = || record.position().map_or(0, |p| line_of(&whole, p.byte()));
        let name_of = |k: usize| {
            names
                .get(k)
                .copied()
                .or(time.as_ref().map(|t| t.name))
                .unwrap_or_default()
        };
        for (text, &state) in record.iter().zip(&columns) {
            x[state] = (bare(text).parse().ok())
                .filter(|v: &f64| v.is_finite())
                .ok_or_else(|| PointsError::NotANumber {
                    path: at(),
                    line: line(),
                    name: name_of(state).to_owned(),
                    text: shorten(text),
                })?;
        }
        let t = x.pop().unwrap_or(0.0);
        if let Some(time) = &time {
            (time.check)(t).map_err(|reason| PointsError::Time {
                path: at(),
                line: line(),
                name: time.name.to_owned(),
                reason,
            })?;
        }
        times.push(t);
        points.extend(x);
    }
    if points.is_empty() {
        return Err(PointsError::Empty { path: at() });
    }
    Ok((points, times))
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
