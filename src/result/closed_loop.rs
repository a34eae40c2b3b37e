//! Closed loops in the result file: `/closed_loop` and what belongs to it.

use super::TrajectorySchema;
use super::names::{common, product};
use super::table::{NO_AXES, Table};
use crate::closed_loop::{Evaluation, LawResult, NOT_MERGED, Path, SetResult, Spread};
use crate::hdf5::{OutputError, ResultFile};
use crate::model::Model;
use crate::schema;

/// The groups that an evaluation writes, and replaces where a file has them.
pub const CLOSED_LOOP_GROUPS: [&str; 5] = [
    schema::CLOSED_LOOP.name,
    schema::CLOSED_LOOP_LAWS.name,
    schema::OPERATING_SETS.name,
    schema::OPERATING_CONTOURS.name,
    schema::CLOSED_LOOP_TRAJECTORIES.name,
];

impl Evaluation {
    /// Writes all groups.
    ///
    /// # Errors
    /// What writing gives.
    pub fn write(&self, model: &Model, file: &mut ResultFile) -> Result<(), OutputError> {
        let axes = TrajectorySchema::axes(model);
        self.write_states(&axes, file)?;
        self.write_laws(file)?;
        if !self.closed_loop.sets.is_empty() {
            self.write_sets(&axes, file)?;
            self.write_contours(&axes, file)?;
        }
        self.write_paths(&axes, file)
    }

    fn law_names(&self) -> impl Iterator<Item = &str> {
        self.laws.iter().map(|l| l.name.as_str())
    }

    fn all<T>(&self, of: impl Fn(&LawResult) -> Vec<T>) -> Vec<T> {
        self.laws.iter().flat_map(of).collect()
    }

    fn write_states(
        &self,
        axes: &TrajectorySchema,
        file: &mut ResultFile,
    ) -> Result<(), OutputError> {
        let mut table = Table::new(&schema::CLOSED_LOOP, axes)
            .labels("law", self.law_names())
            .length("initial", self.initial.count());
        table
            .attribute("outside", self.closed_loop.outside.name())
            .attribute("final_time", self.closed_loop.final_time)
            .attribute("converged_metric", self.metric)
            .attribute("converged_below", self.converged_below)
            .attribute("backend", self.backend.as_str())
            .attribute("adapter", self.adapter.as_str())
            .attribute("precision", self.numerics.precision.name())
            .attribute("method", self.numerics.method.name())
            .attribute("method_of_map", self.leg_method.name())
            .attribute("rtol", self.numerics.rtol);
        if !self.initial.axes.is_empty() {
            let name = |(i, _): &(usize, Vec<f64>)| axes.states[*i].name.clone();
            let names: Vec<String> = self.initial.axes.iter().map(name).collect();
            let counts = self.initial.counts().into_iter().map(|c| c as i32);
            table
                .attribute("axes", names.join(" "))
                .attribute("counts", counts.collect::<Vec<i32>>());
        }

        let converged = self.all(|l| l.converged.iter().map(|c| i32::from(*c)).collect());
        table
            .put("x0", &self.initial.x)
            .put("V", &self.values)
            .put("J", self.all(|l| l.cost.clone()))
            .put("suboptimality", self.all(|l| self.suboptimality(l)))
            .put_codes("converged", [(0, "no"), (1, "yes")], converged)
            .put_codes(
                "status",
                self.status_flags.clone(),
                self.all(|l| l.status.clone()),
            )
            .put("t_end", self.all(|l| l.t_end.clone()))
            .put("fallback", self.all(LawResult::fallbacks));
        let count = self.closed_loop.records.len();
        for (k, record) in self.closed_loop.records.iter().enumerate() {
            let of = |l: &LawResult| -> Vec<f64> {
                l.records.iter().skip(k).step_by(count).copied().collect()
            };
            table.put_named("<quantity>", &record.name, Some(&record.text), self.all(of));
        }
        table.write(file)
    }

    fn write_laws(&self, file: &mut ResultFile) -> Result<(), OutputError> {
        let mut table =
            Table::new(&schema::CLOSED_LOOP_LAWS, &NO_AXES).labels("law", self.law_names());
        let text = |of: &dyn Fn(&LawResult) -> String| self.laws.iter().map(of).collect::<Vec<_>>();
        let column = |of: &dyn Fn(&LawResult) -> f64| self.laws.iter().map(of).collect::<Vec<_>>();
        let spread =
            |of: fn(&Spread) -> f64| column(&|l| self.spread(l).as_ref().map_or(f64::NAN, of));
        let failed = |l: &LawResult| {
            l.status
                .iter()
                .filter(|s| ![0, NOT_MERGED].contains(s))
                .count() as f64
        };
        table
            .attribute("backend", self.backend.as_str())
            .attribute("adapter", self.adapter.as_str())
            .put("source", text(&|l| l.source.clone()))
            .put("statuses", text(&|l| self.status_text(l)))
            .put("share_converged", column(&LawResult::share_converged))
            .put("suboptimality_median", spread(|s| s.median))
            .put("suboptimality_p99", spread(|s| s.p99))
            .put("suboptimality_max", spread(|s| s.worst))
            .put(
                "suboptimality_count",
                column(&|l| self.spread(l).map_or(0.0, |s| s.count as f64)),
            )
            .put("seconds", column(&|l| l.seconds))
            .put("rate", column(&LawResult::rate))
            .put("failed", column(&failed))
            .put("updates", column(&|l| l.updates as f64))
            .put("held", column(&|l| l.held))
            .put("fell_back", column(&|l| l.fell_back() as f64));
        for (k, record) in self.closed_loop.records.iter().enumerate() {
            let name = format!("worst_{}", record.name);
            let worst = column(&|l| self.worst(l, k));
            table.put_named("worst_<quantity>", &name, None, worst);
        }
        table.write(file)
    }

    /// Units of the axes of the grid of initial states.
    fn axis_units(&self, axes: &TrajectorySchema) -> Vec<String> {
        let unit = |(i, _): &(usize, Vec<f64>)| axes.states[*i].unit().to_owned();
        self.initial.axes.iter().map(unit).collect()
    }

    fn write_sets(
        &self,
        axes: &TrajectorySchema,
        file: &mut ResultFile,
    ) -> Result<(), OutputError> {
        let sets = &self.closed_loop.sets;
        let flat = |of: fn(&SetResult) -> f64| -> Vec<f64> {
            self.sets.iter().flatten().map(of).collect()
        };
        let condition: Vec<String> = sets.iter().map(|s| s.text.clone()).collect();
        let mut table = Table::new(&schema::OPERATING_SETS, &NO_AXES)
            .labels("law", self.law_names())
            .labels("set", sets.iter().map(|s| s.name.as_str()));
        table
            .put("condition", condition)
            .put("share", flat(|s| s.share))
            .put_in("area", product(&self.axis_units(axes)), flat(|s| s.area));
        table.write(file)
    }

    fn write_contours(
        &self,
        axes: &TrajectorySchema,
        file: &mut ResultFile,
    ) -> Result<(), OutputError> {
        let mut columns: [Vec<i32>; 4] = Default::default();
        let mut x = Vec::new();
        for (law, sets) in self.sets.iter().enumerate() {
            for (set, result) in sets.iter().enumerate() {
                for (line, points) in result.lines.iter().enumerate() {
                    for (place, point) in points.iter().enumerate() {
                        for (column, value) in columns.iter_mut().zip([law, set, line, place]) {
                            column.push(value as i32);
                        }
                        x.extend_from_slice(point);
                    }
                }
            }
        }
        if x.is_empty() {
            return Ok(());
        }

        let names = (self.initial.axes.iter()).map(|(i, _)| axes.states[*i].name.as_str());
        let sets = self.closed_loop.sets.iter().map(|s| s.name.as_str());
        let units = self.axis_units(axes);
        let [law, set, line, place] = columns;
        let mut table = Table::new(&schema::OPERATING_CONTOURS, &NO_AXES)
            .length("vertex", law.len())
            .labels("axis", names);
        table
            .put_codes("law", (0..).zip(self.law_names()), law)
            .put_codes("set", (0..).zip(sets), set)
            .put("line", line)
            .put("place", place)
            .put("axis_units", units.clone())
            .put_in(
                "x",
                common(units.iter().map(String::as_str), "axis_units"),
                x,
            );
        table.write(file)
    }

    fn write_paths(
        &self,
        axes: &TrajectorySchema,
        file: &mut ResultFile,
    ) -> Result<(), OutputError> {
        let kept = self.initial.kept();
        // A part of the initial states may have none of them.
        if kept.is_empty() {
            return Ok(());
        }
        let gather = |of: fn(&Path) -> &Vec<f64>| -> Vec<f64> {
            self.all(|l| l.paths.iter().flat_map(of).copied().collect())
        };
        let mut table = Table::new(&schema::CLOSED_LOOP_TRAJECTORIES, axes)
            .labels("law", self.law_names())
            .length("trajectory", kept.len())
            .length("sample", self.closed_loop.samples + 1);
        table
            .put(
                "initial",
                kept.iter().map(|i| *i as i32).collect::<Vec<i32>>(),
            )
            .put("t", gather(|p| &p.t))
            .put("x", gather(|p| &p.x));
        if !axes.controls.is_empty() {
            table.put("u", gather(|p| &p.u));
        }
        table.write(file)
    }
}
