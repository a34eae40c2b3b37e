//! What every result file says about the run that made it.

use std::time::{SystemTime, UNIX_EPOCH};

use crate::hdf5::{OutputError, ResultFile};
use crate::model::Model;

/// The root attributes of a result file: where its numbers come from.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RunRecord {
    /// One line on what the file holds.
    pub title: String,
    /// The scenario file's whole text.
    pub scenario: String,
    /// The scenario file's path, absolute where that can be told.
    pub scenario_file: String,
    /// Parameters replaced on the command line: a line `name=value` each.
    pub set: String,
    /// The version of this program.
    pub costate_version: String,
    /// The commit that the program was built from; the library does not know it.
    pub git_revision: String,
    /// The command line.
    pub command: String,
    /// When the run began, ISO 8601 in UTC: see [`utc_timestamp`].
    pub created: String,
    /// What integrated: `cpu` or `gpu`.
    pub backend: String,
    /// The adapter's name, or the processor's.
    pub adapter: String,
    /// `f64` or `f32`.
    pub precision: String,
    /// The integration method.
    pub method: String,
    /// The relative tolerance (dimensionless).
    pub rtol: f64,
    /// The absolute tolerance, in units of each component's scale (of states the region's width).
    pub atol: f64,
    /// How long the run took (s).
    pub wall_seconds: f64,
}

impl RunRecord {
    /// What is known when a run of this process begins.
    pub fn begun(model: &Model, started: SystemTime) -> Self {
        let file = std::fs::canonicalize(&model.file_name);
        let set: Vec<String> = model
            .overrides
            .iter()
            .map(|(n, v)| format!("{n}={v}"))
            .collect();
        Self {
            title: model.title.clone(),
            scenario: model.text.clone(),
            scenario_file: file
                .map_or_else(|_| model.file_name.clone(), |f| f.display().to_string()),
            set: set.join("\n"),
            costate_version: env!("CARGO_PKG_VERSION").to_owned(),
            git_revision: "unknown".to_owned(),
            command: std::env::args_os()
                .map(|a| a.to_string_lossy().into_owned())
                .collect::<Vec<_>>()
                .join(" "),
            created: utc_timestamp(started),
            ..Self::default()
        }
    }

    /// What `set` says, as `--set` gives it.
    pub fn overrides(set: &str) -> Vec<(String, String)> {
        let pairs = set.lines().filter_map(|l| l.split_once('='));
        pairs.map(|(n, v)| (n.to_owned(), v.to_owned())).collect()
    }

    /// Writes the record as root attributes.
    ///
    /// # Errors
    /// [`OutputError::File`] and [`OutputError::Hdf5`].
    pub fn write(&self, file: &ResultFile) -> Result<(), OutputError> {
        let texts = [
            ("title", &self.title),
            ("scenario", &self.scenario),
            ("scenario_file", &self.scenario_file),
            ("set", &self.set),
            ("costate_version", &self.costate_version),
            ("git_revision", &self.git_revision),
            ("command", &self.command),
            ("created", &self.created),
            ("backend", &self.backend),
            ("adapter", &self.adapter),
            ("precision", &self.precision),
            ("method", &self.method),
        ];
        for (name, text) in texts {
            file.attribute(name, text.as_str())?;
        }
        file.attribute("rtol", self.rtol)?;
        file.attribute("atol", self.atol)?;
        file.attribute("wall_seconds", self.wall_seconds)
    }
}

/// A time as ISO 8601 in UTC, to the second: `2026-01-31T12:00:00Z`. Times before 1970 come out as
/// its first second.
#[must_use]
pub fn utc_timestamp(time: SystemTime) -> String {
    let seconds = time
        .duration_since(UNIX_EPOCH)
        .map_or(0, |elapsed| elapsed.as_secs());
    let (days, second) = (seconds / 86_400, seconds % 86_400);
    let (year, month, day) = civil_date(days);
    let (hour, minute, second) = (second / 3_600, second / 60 % 60, second % 60);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}Z")
}

/// The Gregorian date `days` after 1970-01-01 (Howard Hinnant, "chrono-compatible low-level date
/// algorithms", `civil_from_days`): years begin in March, so that the leap day is a year's last.
fn civil_date(days: u64) -> (u64, u64, u64) {
    let shifted = days + 719_468;
    let (era, day_of_era) = (shifted / 146_097, shifted % 146_097);
    let year_of_era =
        (day_of_era - day_of_era / 1_460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month_from_march = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month_from_march + 2) / 5 + 1;
    let month = if month_from_march < 10 {
        month_from_march + 3
    } else {
        month_from_march - 9
    };
    (400 * era + year_of_era + u64::from(month <= 2), month, day)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn timestamps_at_known_seconds() {
        let at = |seconds| utc_timestamp(UNIX_EPOCH + Duration::from_secs(seconds));
        assert_eq!(at(0), "1970-01-01T00:00:00Z");
        assert_eq!(at(951_826_154), "2000-02-29T12:09:14Z");
        assert_eq!(at(1_709_251_199), "2024-02-29T23:59:59Z");
        assert_eq!(at(1_767_225_600), "2026-01-01T00:00:00Z");
    }
}
