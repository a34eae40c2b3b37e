//! Pages and pictures beside a result file. Without the feature `report` there are none.

use crate::error::CliError;
use crate::terminal::Terminal;
#[cfg(feature = "report")]
use costate::low_level::result::Stored;
#[cfg(feature = "report")]
use costate::session::Progress;
use std::path::{Path, PathBuf};

/// The report of a finished file; a failure is a note.
#[cfg(feature = "report")]
pub fn page(path: &Path, terminal: &Terminal) -> Option<PathBuf> {
    terminal.step("report");
    let written = Stored::open(path).map_err(|e| e.to_string());
    let written = written.and_then(|stored| {
        costate_report::write(&stored, &costate_report::Options::default())
            .map_err(|e| e.to_string())
    });
    terminal.step_ended();
    match written {
        Ok(written) => Some(written.page),
        Err(reason) => {
            terminal.note(&format!("no report was made: {reason}"));
            None
        }
    }
}

/// The pictures of levels of attenuation, by their names as SVG; what cannot be drawn is a note.
#[cfg(feature = "report")]
pub fn of_attenuation(path: &Path, terminal: &Terminal) -> Vec<String> {
    let stored = Stored::open(path).map_err(|e| e.to_string());
    let written = stored.and_then(|s| {
        costate_report::write_beside(&s, &costate_report::ATTENUATION_PICTURES)
            .map_err(|e| e.to_string())
    });
    match written {
        Ok(written) => {
            for (name, reason) in &written.missing {
                terminal.note(&format!("picture {name}: {reason}"));
            }
            written.pictures
        }
        Err(reason) => {
            terminal.note(&format!("no picture was made: {reason}"));
            Vec::new()
        }
    }
}

/// The picture of speed against error, with the table's name as SVG; where it cannot be drawn, or
/// that name is taken by what is none of ours, there is a note instead.
#[cfg(feature = "report")]
pub fn of_speed(
    path: &Path,
    title: &str,
    terminal: &Terminal,
) -> Result<Option<PathBuf>, CliError> {
    use costate::low_level::files::write_text;
    let svg = path.with_extension("svg");
    if svg.exists() && !costate_report::is_ours(&svg) {
        terminal.note(&format!(
            "no picture was made: {} is there and is none of ours",
            svg.display()
        ));
        return Ok(None);
    }
    let drawn = costate_report::single(&Stored::open(path)?, "speed").unwrap_or_else(|e| {
        terminal.note(&e.to_string());
        None
    });
    let Some(mut picture) = drawn else {
        return Ok(None);
    };
    picture.title = format!("{title}: speed against error");
    write_text(&svg, &picture.svg(f64::from(costate_report::DEFAULT_WIDTH)))?;
    Ok(Some(svg))
}

#[cfg(not(feature = "report"))]
pub fn page(_: &Path, _: &Terminal) -> Option<PathBuf> {
    None
}

#[cfg(not(feature = "report"))]
pub fn of_attenuation(_: &Path, _: &Terminal) -> Vec<String> {
    Vec::new()
}

#[cfg(not(feature = "report"))]
pub fn of_speed(_: &Path, _: &str, _: &Terminal) -> Result<Option<PathBuf>, CliError> {
    Ok(None)
}
