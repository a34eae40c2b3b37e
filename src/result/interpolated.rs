//! `/map` and `/points` of `costate value`: interpolated values with their errors.

use super::TrajectorySchema;
use super::answers::Names;
use crate::hdf5::{Dimension, Group, OutputError, ResultFile, Variable};
use crate::map::{At, Coverage, Unknown, Value};

/// Whether a value is known, as files write it.
const KNOWN: i32 = 0;
/// Coverage where nothing is known.
const NO_COVERAGE: (i32, &str) = (-1, "unknown");

fn code(at: &At) -> i32 {
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

fn flags() -> [(i32, &'static str); 8] {
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
        schema: &TrajectorySchema,
        places: &Places<'_>,
        times: Option<Times<'_>>,
        values: &[At],
    ) -> Result<(), OutputError> {
        let names = Names::new(schema);
        let (group, dims): (Group, Vec<&str>) = match places {
            Places::Grid(axes) => {
                let mut group = Group::new("map")
                    .attribute("title", "value function on a regular grid, interpolated");
                for (axis, values) in schema.states.iter().zip(*axes) {
                    let dimension = Dimension::values(&axis.name, values.clone(), axis.unit());
                    group = group.dimension(dimension.long_name(axis.description()));
                }
                let mut dims: Vec<&str> = schema.states.iter().map(|s| s.name.as_str()).collect();
                if let (Some(times), Some(axis)) = (&times, axes.get(dims.len())) {
                    let unit = schema.time();
                    group = group.dimension(
                        Dimension::values(times.name, axis.clone(), unit).long_name("time"),
                    );
                    dims.push(times.name);
                }
                (group, dims)
            }
            Places::Points(_) => {
                let group = Group::new("points")
                    .attribute("title", "value function at chosen states, interpolated")
                    .dimension(Dimension::index("point", values.len()));
                (group, vec!["point"])
            }
        };
        let mut group = names.solution(names.axes(group), &dims);
        if let Places::Points(_) = places {
            group = group.variable(names.state("x0", &["point", "state"], "chosen state"));
            if let Some(times) = &times {
                let unit = schema.time();
                group = group.variable(
                    Variable::f64(times.name, ["point"])
                        .unit(unit)
                        .long_name("time"),
                );
            }
        }
        if times.is_some() {
            let rate = Variable::f64("dV_dt", dims.iter().copied());
            group = group.variable(rate.unit(names.rate()).long_name("derivative of V by time"));
        }
        let error =
            |name: &str, what: &str| Variable::f64(name, dims.iter().copied()).long_name(what);
        group = group
            .variable(error("V_error", "error of V that leaving data out shows").unit(names.cost()))
            .variable(error(
                "p_error",
                "error of p that leaving data out shows, relative to p",
            ))
            .variable(error("u_error", "error of u that leaving data out shows").unit(names.control_unit()))
            .variable(
                Variable::i32("status", dims.iter().copied())
                    .long_name("whether the value is known")
                    .flags(flags()),
            )
            .variable(
                Variable::i32("coverage", dims.iter().copied())
                    .long_name("what the value's being the least rests on, which its error does not include")
                    .flags(
                        Coverage::ALL
                            .map(|(_, code, name)| (code, name))
                            .into_iter()
                            .chain([NO_COVERAGE]),
                    ),
            );
        let mut writer = self.group(&group)?;
        let (n, m) = (schema.states.len(), schema.controls.len());
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
        writer.write("V", &scalar(&|v| v.v))?;
        writer.write("p", &vector(n, &|v| v.p.clone()))?;
        if m > 0 {
            writer.write("u", &vector(m, &|v| v.u.clone()))?;
        }
        let sheet: Vec<i32> = values
            .iter()
            .map(|at| known(at).map_or(-1, |v| v.sheet))
            .collect();
        writer.write("sheet", &sheet)?;
        writer.write("V_error", &scalar(&|v| v.v_error))?;
        writer.write("p_error", &scalar(&|v| v.p_error))?;
        writer.write("u_error", &scalar(&|v| v.u_error))?;
        let status: Vec<i32> = values.iter().map(code).collect();
        writer.write("status", &status)?;
        let coverage = |at: &At| known(at).map_or(NO_COVERAGE.0, |v| v.coverage.code());
        writer.write(
            "coverage",
            &values.iter().map(coverage).collect::<Vec<i32>>(),
        )?;
        if let Places::Points(points) = places {
            writer.write("x0", *points)?;
            if let Some(times) = &times {
                writer.write(times.name, times.t)?;
            }
        }
        if times.is_some() {
            writer.write("dV_dt", &scalar(&|v| v.rate))?;
        }
        Ok(())
    }
}
