//! `/attenuation`, `/attenuation_regions` and `/attenuation_caustic`.

use super::TrajectorySchema;
use super::answers::{Names, status};
use crate::attenuation::{Attenuated, Covering};
use crate::hdf5::{Dimension, Group, OutputError, ResultFile, Variable};
use crate::value::PointStatus;

/// The groups of the smallest level of attenuation.
pub const ATTENUATION_GROUPS: [&str; 3] =
    ["attenuation", "attenuation_regions", "attenuation_caustic"];

impl ResultFile {
    /// Writes coverage against the level, the regions of validity of some levels, and the folds met
    /// at these.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn attenuation(
        &mut self,
        schema: &TrajectorySchema,
        found: &Attenuated,
    ) -> Result<(), OutputError> {
        self.attenuation_curve(found)?;
        let names = Names::new(schema);
        let regions = found.regions();
        if regions.is_empty() {
            return Ok(());
        }
        let levels: Vec<f64> = regions.iter().map(|r| r.value).collect();
        let level = || Dimension::values("level", levels.clone(), "1").long_name(&found.parameter);
        let mut group = Group::new("attenuation_regions")
            .attribute(
                "title",
                "regions of validity: where V solves the Isaacs equation at a level of attenuation",
            )
            .attribute("parameter", found.parameter.as_str())
            .dimension(level());
        for (axis, values) in schema.states.iter().zip(&found.grid.axes) {
            let dimension = Dimension::values(&axis.name, values.clone(), axis.unit());
            group = group.dimension(dimension.long_name(axis.description()));
        }
        let dims: Vec<&str> = std::iter::once("level")
            .chain(schema.states.iter().map(|s| s.name.as_str()))
            .collect();
        let v = Variable::f64("V", dims.iter().copied())
            .unit(names.cost())
            .long_name("value function, where it is valid");
        let group = group.variable(status(dims.iter().copied())).variable(v);
        let mut writer = self.group(&group)?;
        let all = |r: &&crate::attenuation::Row| {
            r.outcome
                .status
                .iter()
                .map(|s| *s as i32)
                .collect::<Vec<_>>()
        };
        writer.write(
            "status",
            &regions.iter().flat_map(all).collect::<Vec<i32>>(),
        )?;
        let v: Vec<f64> = regions
            .iter()
            .flat_map(|r| r.outcome.v.iter().copied())
            .collect();
        writer.write("V", &v)?;
        let folds: Vec<(i32, &Vec<f64>)> = (regions.iter().enumerate())
            .flat_map(|(k, r)| r.outcome.folds.iter().map(move |x| (k as i32, x)))
            .collect();
        if folds.is_empty() {
            return Ok(());
        }
        let mut group = Group::new("attenuation_caustic")
            .attribute(
                "title",
                "where trajectories meet folds, at the levels of /attenuation_regions",
            )
            .expected_rows(Some(folds.len()))
            .dimension(Dimension::unlimited("vertex"))
            .dimension(level());
        group = names.axes(group);
        group = group
            .variable(
                Variable::i32("level_index", ["vertex"])
                    .long_name("index of the level in /attenuation_regions"),
            )
            .variable(names.state("x", &["vertex", "state"], "state"));
        let index: Vec<i32> = folds.iter().map(|(k, _)| *k).collect();
        let x: Vec<f64> = folds.iter().flat_map(|(_, x)| x.iter().copied()).collect();
        self.group(&group)?.append(
            folds.len(),
            &[("level_index", (&index).into()), ("x", (&x).into())],
        )
    }

    fn attenuation_curve(&mut self, found: &Attenuated) -> Result<(), OutputError> {
        let (rows, name) = (&found.search.rows, &found.parameter);
        let bracket = match found.search.covering {
            Covering::Smallest { lower, upper } => [lower, upper],
            Covering::All { upper } => [f64::NAN, upper],
            Covering::Never { top, .. } => [top, f64::NAN],
        };
        let scalars: [(&str, f64, String); 6] = [
            ("own", found.own, format!("the scene's own value of {name}")),
            (
                "star",
                found.linear.star,
                format!(
                    "{name}*, the smallest value that the linearization allows, by the game Riccati equation"
                ),
            ),
            (
                "star_hamiltonian",
                found.linear.hamiltonian,
                format!("{name}* by the Hamiltonian matrix alone"),
            ),
            (
                "smallest_covering",
                found.search.smallest().unwrap_or(f64::NAN),
                format!("smallest value of {name} whose region of validity covers the states"),
            ),
            (
                "bracket_lower",
                bracket[0],
                "largest value looked at that does not cover".to_owned(),
            ),
            (
                "bracket_upper",
                bracket[1],
                "smallest value from which on all that were looked at cover".to_owned(),
            ),
        ];
        let mut group = Group::new("attenuation")
            .attribute("title", "coverage against the level of attenuation")
            .attribute("parameter", name.as_str())
            .attribute("cause", found.linear.cause.name())
            .attribute("monotone", vec![i32::from(found.search.monotone)])
            .dimension(Dimension::index("row", rows.len()))
            .dimension(Dimension::names("status", PointStatus::ALL.map(|(_, n)| n)))
            .variable(Variable::f64("value", ["row"]).long_name(name))
            .variable(
                Variable::f64("coverage", ["row"])
                    .long_name("share of the wanted states at which V is valid"),
            )
            .variable(Variable::i32("valid", ["row"]).long_name("states at which V is valid"))
            .variable(Variable::i32("wanted", ["row"]).long_name("states inside the guards"))
            .variable(
                Variable::i32("states", ["row", "status"]).long_name("number of states by status"),
            )
            .variable(
                Variable::i32("swept", ["row"])
                    .long_name("1 where the scene could be swept at all"),
            );
        for (name, _, long_name) in &scalars {
            group = group.variable(Variable::f64(name, []).long_name(long_name));
        }
        let mut writer = self.group(&group)?;
        let column =
            |f: &dyn Fn(&crate::attenuation::Row) -> f64| rows.iter().map(f).collect::<Vec<f64>>();
        writer.write("value", &column(&|r| r.value))?;
        writer.write("coverage", &column(&|r| r.coverage()))?;
        let whole = |f: &dyn Fn(&crate::attenuation::Row) -> usize| {
            rows.iter().map(|r| f(r) as i32).collect::<Vec<_>>()
        };
        writer.write("valid", &whole(&|r| r.valid()))?;
        writer.write("wanted", &whole(&|r| r.wanted()))?;
        writer.write(
            "swept",
            &whole(&|r| usize::from(r.outcome.failure.is_none())),
        )?;
        let count = |r: &crate::attenuation::Row, s: PointStatus| {
            r.outcome.status.iter().filter(|t| **t == s).count()
        };
        let states: Vec<i32> = (rows.iter())
            .flat_map(|r| PointStatus::ALL.map(|(s, _)| count(r, s) as i32))
            .collect();
        writer.write("states", &states)?;
        for (name, value, _) in &scalars {
            writer.write(name, &[*value])?;
        }
        Ok(())
    }
}
