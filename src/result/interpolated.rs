//! `/map` and `/points` of `costate value`: interpolated values with their errors.

use super::TrajectorySchema;
use super::table::Table;
use crate::hdf5::{OutputError, ResultFile};
use crate::map::{At, Coverage, Unknown, Value};
use crate::schema;

/// Whether a value is known, as files write it.
const KNOWN: i32 = 0;
/// Coverage where nothing is known.
const NO_COVERAGE: (i32, &str) = (-1, "unknown");

/// What is known at a state, as files write it: a code of [`interpolated_statuses`].
pub fn interpolated_status(at: &At) -> i32 {
    match at.lowest {
        Ok(_) => KNOWN,
        Err(Unknown::Far) => 1,
        Err(Unknown::Edge) => 2,
        Err(Unknown::SeveralSheets) => 3,
        Err(Unknown::Uncertain) => 4,
        Err(Unknown::OtherTime) => 5,
        Err(Unknown::Guard) => 6,
        Err(Unknown::Between) => 7,
    }
}

/// The codes and their meanings.
#[must_use]
pub fn interpolated_statuses() -> [(i32, &'static str); 8] {
    [
        (KNOWN, "interpolated"),
        (1, "far from data"),
        (2, "edge of data"),
        (3, "several sheets"),
        (4, "not known to the map"),
        (5, "other time"),
        (6, "excluded by a guard"),
        (7, "between interpolated values"),
    ]
}

/// Where values are wanted.
pub enum Places<'p> {
    /// A grid: one axis a state, and one of the time where there are times.
    Grid(&'p [Vec<f64>]),
    /// `[point][state]`.
    Points(&'p [f64]),
}

/// Times of a map that has time as an axis: its name, and one a point.
pub struct Times<'t> {
    pub name: &'t str,
    pub t: &'t [f64],
}

impl ResultFile {
    /// Writes interpolated values, to `/map` for a grid (last axis fastest), to `/points` for
    /// single states.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn interpolated(
        &mut self,
        axes: &TrajectorySchema,
        places: &Places<'_>,
        times: Option<Times<'_>>,
        values: &[At],
    ) -> Result<(), OutputError> {
        let mut table = match places {
            Places::Grid(grid) => Table::new(&schema::MAP, axes)
                .title("value function on a regular grid, interpolated")
                .grid(grid, times.as_ref().map(|t| t.name)),
            Places::Points(_) => Table::new(&schema::POINTS, axes)
                .title("value function at chosen states, interpolated")
                .length("point", values.len()),
        };
        let (n, m) = (axes.states.len(), axes.controls.len());
        let known = |at: &At| at.lowest.as_ref().ok().cloned();
        let scalar = |f: &dyn Fn(&Value) -> f64| -> Vec<f64> {
            values
                .iter()
                .map(|at| known(at).map_or(f64::NAN, |v| f(&v)))
                .collect()
        };
        let vector = |width: usize, f: &dyn Fn(&Value) -> Vec<f64>| -> Vec<f64> {
            (values.iter())
                .flat_map(|at| known(at).map_or_else(|| vec![f64::NAN; width], |v| f(&v)))
                .collect()
        };
        table
            .put("V", scalar(&|v| v.v))
            .put("p", vector(n, &|v| v.p.clone()));
        if m > 0 {
            table.put("u", vector(m, &|v| v.u.clone()));
        }
        let sheet = |at: &At| known(at).map_or(-1, |v| v.sheet);
        let coverage = |at: &At| known(at).map_or(NO_COVERAGE.0, |v| v.coverage.code());
        let coverages = Coverage::ALL.map(|(_, code, name)| (code, name));
        table
            .put("sheet", values.iter().map(sheet).collect::<Vec<i32>>())
            .put("V_error", scalar(&|v| v.v_error))
            .put("p_error", scalar(&|v| v.p_error))
            .put("u_error", scalar(&|v| v.u_error))
            .put_codes(
                "status",
                interpolated_statuses(),
                values.iter().map(interpolated_status).collect::<Vec<i32>>(),
            )
            .put_codes(
                "coverage",
                coverages.into_iter().chain([NO_COVERAGE]),
                values.iter().map(coverage).collect::<Vec<i32>>(),
            );
        if let Places::Points(points) = places {
            table.put("x0", *points);
            if let Some(times) = &times {
                table.put_named("<time>", times.name, None, times.t);
            }
        }
        if times.is_some() {
            table.put("dV_dt", scalar(&|v| v.rate));
        }
        table.write(self)
    }
}
