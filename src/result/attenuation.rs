//! `/attenuation`, `/attenuation_regions` and `/attenuation_caustic`.

use super::TrajectorySchema;
use super::answers::point_statuses;
use super::table::{NO_AXES, Table};
use crate::attenuation::{Attenuated, Covering, Row};
use crate::hdf5::{OutputError, ResultFile};
use crate::schema;
use crate::value::PointStatus;

/// The groups of the smallest level of attenuation.
pub const ATTENUATION_GROUPS: [&str; 3] = [
    schema::ATTENUATION.name,
    schema::ATTENUATION_REGIONS.name,
    schema::ATTENUATION_CAUSTIC.name,
];

impl ResultFile {
    /// Writes coverage against the level, the regions of validity of some levels, and the folds met
    /// at these.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn attenuation(
        &mut self,
        axes: &TrajectorySchema,
        found: &Attenuated,
    ) -> Result<(), OutputError> {
        self.attenuation_curve(found)?;
        let regions = found.regions();
        if regions.is_empty() {
            return Ok(());
        }
        let levels: Vec<f64> = regions.iter().map(|r| r.value).collect();
        let outcomes = || regions.iter().map(|r| &r.outcome);
        let status: Vec<i32> = outcomes()
            .flat_map(|o| o.status.iter().map(|s| *s as i32))
            .collect();
        let v: Vec<f64> = outcomes().flat_map(|o| o.v.iter().copied()).collect();
        let mut table = Table::new(&schema::ATTENUATION_REGIONS, axes)
            .numbers("level", levels.clone())
            .grid(&found.grid.axes, None);
        table
            .attribute("parameter", found.parameter.as_str())
            .put_codes("status", point_statuses(), status)
            .put("V", v);
        table.write(self)?;

        let folds: Vec<(i32, &Vec<f64>)> = (outcomes().enumerate())
            .flat_map(|(k, o)| o.folds.iter().map(move |x| (k as i32, x)))
            .collect();
        if folds.is_empty() {
            return Ok(());
        }
        let index: Vec<i32> = folds.iter().map(|(k, _)| *k).collect();
        let x: Vec<f64> = folds.iter().flat_map(|(_, x)| x.iter().copied()).collect();
        let mut table = Table::new(&schema::ATTENUATION_CAUSTIC, axes)
            .length("vertex", folds.len())
            .numbers("level", levels);
        table.put("level_index", index).put("x", x);
        table.write(self)
    }

    fn attenuation_curve(&mut self, found: &Attenuated) -> Result<(), OutputError> {
        let rows = &found.search.rows;
        let [lower, upper] = match found.search.covering {
            Covering::Smallest { lower, upper } => [lower, upper],
            Covering::All { upper } => [f64::NAN, upper],
            Covering::Never { top, .. } => [top, f64::NAN],
        };
        let column = |f: fn(&Row) -> f64| rows.iter().map(f).collect::<Vec<f64>>();
        let whole = |f: fn(&Row) -> usize| rows.iter().map(|r| f(r) as i32).collect::<Vec<i32>>();
        let count = |r: &Row, s: PointStatus| r.outcome.status.iter().filter(|t| **t == s).count();
        let states: Vec<i32> = (rows.iter())
            .flat_map(|r| PointStatus::ALL.map(|(s, _)| count(r, s) as i32))
            .collect();
        let mut table = Table::new(&schema::ATTENUATION, &NO_AXES)
            .length("row", rows.len())
            .labels("status", PointStatus::ALL.map(|(_, name)| name));
        table
            .attribute("parameter", found.parameter.as_str())
            .attribute("cause", found.linear.cause.name())
            .attribute("monotone", vec![i32::from(found.search.monotone)])
            .put("value", column(|r| r.value))
            .put("coverage", column(Row::coverage))
            .put("valid", whole(Row::valid))
            .put("wanted", whole(Row::wanted))
            .put("states", states)
            .put("swept", whole(|r| usize::from(r.outcome.failure.is_none())))
            .put("own", found.own)
            .put("star", found.linear.star)
            .put("star_hamiltonian", found.linear.hamiltonian)
            .put(
                "smallest_covering",
                found.search.smallest().unwrap_or(f64::NAN),
            )
            .put("bracket_lower", lower)
            .put("bracket_upper", upper);
        table.write(self)
    }
}
