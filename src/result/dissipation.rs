//! Checks of the dissipation inequality in the result file: `/dissipation`.

use super::TrajectorySchema;
use super::table::{NO_AXES, Table};
use crate::closed_loop::Path;
use crate::closed_loop::dissipation::{
    Dissipation, DisturbanceKind, LawCheck, Origin, Summary, TOLERANCE,
};
use crate::hdf5::{OutputError, ResultFile};
use crate::model::Model;
use crate::schema;

/// The groups that a check writes, and replaces where a file has them.
pub const DISSIPATION_GROUPS: [&str; 3] = [
    schema::DISSIPATION.name,
    schema::DISSIPATION_KINDS.name,
    schema::DISSIPATION_TRAJECTORIES.name,
];

impl Dissipation {
    /// Writes all groups.
    ///
    /// # Errors
    /// What writing gives.
    pub fn write(&self, model: &Model, file: &mut ResultFile) -> Result<(), OutputError> {
        let axes = TrajectorySchema::axes(model);
        self.write_cases(&axes, file)?;
        self.write_kinds(file)?;
        self.write_paths(&axes, file)
    }

    fn law_names(&self) -> impl Iterator<Item = &str> {
        self.laws.iter().map(|l| l.name.as_str())
    }

    fn write_cases(
        &self,
        axes: &TrajectorySchema,
        file: &mut ResultFile,
    ) -> Result<(), OutputError> {
        let all = |of: fn(&LawCheck) -> &Vec<f64>| -> Vec<f64> {
            self.laws.iter().flat_map(of).copied().collect()
        };
        let mut table = Table::new(&schema::DISSIPATION, axes)
            .labels("law", self.law_names())
            .length("case", self.cases.count());
        table
            .attribute("value_function", self.value)
            .attribute("final_time", self.final_time)
            .attribute("lowest_frequency", self.frequencies[0])
            .attribute("highest_frequency", self.frequencies[1])
            .attribute("tolerance", TOLERANCE)
            .attribute("backend", self.backend.as_str())
            .attribute("adapter", self.adapter.as_str())
            .attribute("precision", self.numerics.precision.name())
            .attribute("method", self.numerics.method.name())
            .attribute("rtol", self.numerics.rtol);

        let kinds = DisturbanceKind::ALL.map(|(name, _)| name);
        let kind = |k: &DisturbanceKind| DisturbanceKind::ALL.iter().position(|(_, own)| own == k);
        let origins = Origin::ALL.map(|(name, _)| name);
        let origin = |o: &Origin| Origin::ALL.iter().position(|(_, own)| own == o);
        let code = |place: Option<usize>| place.unwrap_or(0) as i32;
        let status: Vec<i32> = self.laws.iter().flat_map(|l| &l.status).copied().collect();
        table
            .put_codes(
                "kind",
                (0..).zip(kinds),
                (self.cases.kind.iter().map(|k| code(kind(k)))).collect::<Vec<i32>>(),
            )
            .put("x0", &self.cases.x0)
            .put("V0", &self.v0)
            .put_codes(
                "V0_from",
                (0..).zip(origins),
                (self.origin.iter().map(|o| code(origin(o)))).collect::<Vec<i32>>(),
            )
            .put("amplitude", &self.cases.amplitude)
            .put_codes("status", self.status_flags.clone(), status)
            .put("E_z", all(|l| &l.done))
            .put("W", all(|l| &l.supplied))
            .put("V_end", all(|l| &l.v_end))
            .put("ratio", all(|l| &l.ratio))
            .put("violation", all(|l| &l.violation))
            .put("explained", all(|l| &l.explained))
            .put("t_end", all(|l| &l.t_end));
        table.write(file)
    }

    /// A row a law and kind.
    fn write_kinds(&self, file: &mut ResultFile) -> Result<(), OutputError> {
        let rows: Vec<(&str, Summary)> = (self.laws.iter())
            .flat_map(|l| {
                let summaries = l.summaries(&self.cases).into_iter();
                summaries.map(|s| (l.name.as_str(), s))
            })
            .collect();
        let laws: Vec<String> = rows.iter().map(|(law, _)| (*law).to_owned()).collect();
        let kinds: Vec<String> = rows.iter().map(|(_, s)| s.kind.name().to_owned()).collect();
        let column = |of: fn(&Summary) -> f64| rows.iter().map(|(_, s)| of(s)).collect::<Vec<_>>();
        let mut table = Table::new(&schema::DISSIPATION_KINDS, &NO_AXES).length("row", rows.len());
        table
            .put("law", laws)
            .put("kind", kinds)
            .put("count", column(|s| s.count as f64))
            .put("judged", column(|s| s.judged as f64))
            .put("left", column(|s| s.left as f64))
            .put("median_ratio", column(|s| s.median_ratio))
            .put("worst_ratio", column(|s| s.worst_ratio))
            .put("exceeded", column(|s| s.exceeded as f64))
            .put("worst_violation", column(|s| s.worst_violation))
            .put("violated", column(|s| s.violated as f64))
            .put("unexplained", column(|s| s.unexplained as f64));
        table.write(file)
    }

    fn write_paths(
        &self,
        axes: &TrajectorySchema,
        file: &mut ResultFile,
    ) -> Result<(), OutputError> {
        let paths: Vec<(usize, &Path, &Vec<f64>)> = (self.laws.iter().enumerate())
            .flat_map(|(k, l)| {
                let paths = l.paths.iter().zip(&l.path_values);
                paths.map(move |(path, v)| (k, path, v))
            })
            .collect();
        let gather = |of: fn(&Path) -> &Vec<f64>| -> Vec<f64> {
            paths.iter().flat_map(|(_, p, _)| of(p)).copied().collect()
        };
        let law: Vec<i32> = paths.iter().map(|(k, ..)| *k as i32).collect();
        let case: Vec<i32> = paths.iter().map(|(_, p, _)| p.initial as i32).collect();
        let v: Vec<f64> = paths.iter().flat_map(|(.., v)| v.iter()).copied().collect();
        let mut table = Table::new(&schema::DISSIPATION_TRAJECTORIES, axes)
            .length("trajectory", paths.len())
            .length("sample", self.samples + 1);
        table
            .put_codes("law", (0..).zip(self.law_names()), law)
            .put("case", case)
            .put("t", gather(|p| &p.t))
            .put("x", gather(|p| &p.x));
        if !axes.controls.is_empty() {
            table.put("u", gather(|p| &p.u));
        }
        if !axes.disturbances.is_empty() {
            table.put("w", gather(|p| &p.w));
        }
        table
            .put("V", v)
            .put("E_z", gather(|p| &p.cost))
            .put("W", gather(|p| &p.supplied));
        table.write(file)
    }
}
