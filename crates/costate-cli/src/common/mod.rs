//! What commands have in common: reading scenes, opening backends, names of files, printing.

pub mod columns;
pub mod ending;
pub mod grid;
pub mod load;
pub mod open;
pub mod pictures;
pub mod points;
pub mod shard;

use crate::error::CliError;
use crate::terminal::Terminal;
use costate::low_level::files::target;
use costate::low_level::result::Stored;
use costate::run::Provenance;
use costate::session::Progress;
use std::io::Write;
use std::path::Path;

/// What a command writes to `--out`.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Result,
    Table,
    Header,
    #[cfg(feature = "report")]
    Page,
}

impl Kind {
    /// Its endings, the usual one first.
    fn endings(self) -> &'static [&'static str] {
        match self {
            Kind::Result => &["h5", "hdf5", "he5", "nc", "nc4"],
            Kind::Table => &["csv"],
            Kind::Header => &["h"],
            #[cfg(feature = "report")]
            Kind::Page => &["html", "htm"],
        }
    }

    fn name(self) -> &'static str {
        match self {
            Kind::Result => "a result file is HDF5",
            Kind::Table => "a table is CSV",
            Kind::Header => "it is a C header",
            #[cfg(feature = "report")]
            Kind::Page => "it is a page of HTML",
        }
    }
}

/// Refuses to write over what is read and what is no file, and one kind of file under the name of
/// another.
pub fn check_out(out: Option<&Path>, kinds: &[Kind], inputs: &[&Path]) -> Result<(), CliError> {
    let Some(out) = out else { return Ok(()) };
    let bad = |reason| CliError::BadOut {
        path: out.to_owned(),
        reason,
    };
    target(out)?;
    let same = |a: &Path| {
        std::fs::canonicalize(a).is_ok_and(|a| std::fs::canonicalize(out).is_ok_and(|b| a == b))
    };
    if inputs.iter().any(|i| same(i)) {
        return Err(bad("this file is read".to_owned()));
    }
    let end = out
        .extension()
        .map(|e| e.to_string_lossy().to_lowercase())
        .unwrap_or_default();
    let unnamed = end.is_empty() && kinds == [Kind::Result];
    if unnamed
        || kinds
            .iter()
            .any(|kind| kind.endings().contains(&end.as_str()))
    {
        return Ok(());
    }
    let all: Vec<String> = (kinds.iter())
        .map(|kind| format!("{}; name it .{}", kind.name(), kind.endings()[0]))
        .collect();
    Err(bad(all.join("; or ")))
}

/// Says so where the run that made a file was ended early, or parts that it reads from are gone.
pub fn note_ended_early(stored: &Stored, terminal: &Terminal) {
    if let [first, ..] = stored.absent_parts() {
        let (path, count) = (stored.path.display(), stored.absent_parts().len());
        let of = if count == 1 {
            "part that it reads from is"
        } else {
            "parts that it reads from are"
        };
        terminal.note(&format!(
            "{path}: {count} {of} gone ({first}): nothing is known of the states there, and V is not interpolated between other solved states"
        ));
    }
    if let Some((shard, of)) = stored.shard() {
        let path = stored.path.display();
        terminal.note(&format!(
            "{path} is shard {shard} of {of} (from 0): what others have, cheaper solutions too, is not in it (costate merge puts them together)"
        ));
    }
    if let Some(how) = stored.ended_early() {
        let path = stored.path.display();
        terminal.note(&format!("{path}: {how}"));
    }
}

/// Rows of a table as CSV.
pub fn csv_text(rows: &[Vec<String>]) -> Result<String, CliError> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    let csv = |e: csv::Error| CliError::Stdout(std::io::Error::other(e));
    for row in rows {
        writer.write_record(row).map_err(csv)?;
    }
    let bytes = writer
        .into_inner()
        .map_err(|e| CliError::Stdout(std::io::Error::other(e.to_string())))?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

/// Writes to standard output as it is.
pub fn print(text: &str) -> Result<(), CliError> {
    std::io::stdout().lock().write_all(text.as_bytes())?;
    Ok(())
}

/// A run of this program that begins now.
pub fn provenance() -> Provenance {
    Provenance {
        git_revision: env!("COSTATE_GIT_REVISION").to_owned(),
        ..Provenance::now()
    }
}

/// Writes a summary to standard output, as JSON.
pub fn print_json(summary: &impl serde::Serialize) -> Result<(), CliError> {
    let text = serde_json::to_string_pretty(summary).map_err(std::io::Error::other)?;
    print(&format!("{text}\n"))
}
