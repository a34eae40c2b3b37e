//! Closed loops in the result file: `/closed_loop` and what belongs to it.

use crate::closed_loop::{Evaluation, LawResult, Path, SetResult, Spread};
use crate::hdf5::{Dimension, Group, OutputError, ResultFile, Variable};
use crate::model::{Model, Variable as Named};

/// The groups that an evaluation writes, and replaces where a file has them.
pub const CLOSED_LOOP_GROUPS: [&str; 5] = [
    "closed_loop",
    "closed_loop_laws",
    "operating_sets",
    "operating_contours",
    "closed_loop_trajectories",
];

impl Evaluation {
    /// Writes all groups.
    ///
    /// # Errors
    /// What writing gives.
    pub fn write(&self, model: &Model, file: &mut ResultFile) -> Result<(), OutputError> {
        self.write_states(model, file)?;
        self.write_laws(file)?;
        if !self.closed_loop.sets.is_empty() {
            self.write_sets(model, file)?;
        }
        self.write_paths(model, file)
    }

    fn laws_dimension(&self) -> Dimension {
        Dimension::names("law", self.laws.iter().map(|l| l.name.as_str())).long_name("feedback law")
    }

    fn all<T>(&self, of: impl Fn(&LawResult) -> Vec<T>) -> Vec<T> {
        self.laws.iter().flat_map(of).collect()
    }

    fn write_states(&self, model: &Model, file: &mut ResultFile) -> Result<(), OutputError> {
        let both = ["law", "initial"];
        let (cost, time) = units(model);
        let states = model.states.iter().map(|s| s.variable.name.as_str());
        let mut group = Group::new("closed_loop")
            .dimension(self.laws_dimension())
            .dimension(Dimension::index("initial", self.initial.count()).long_name("initial state"))
            .dimension(Dimension::names("state", states))
            .variable(Variable::f64("x0", ["initial", "state"]).long_name("initial state"))
            .variable(
                Variable::f64("V", ["initial"])
                    .unit(cost)
                    .long_name("value function at the initial state"),
            )
            .variable(
                Variable::f64("J", both)
                    .unit(cost)
                    .long_name("cost of the closed loop"),
            )
            .variable(Variable::f64("suboptimality", both).long_name("J/V - 1"))
            .variable(Variable::i32("converged", both).flags([(0, "no"), (1, "yes")]))
            .variable(Variable::i32("status", both).flags(self.status_flags.clone()))
            .variable(
                Variable::f64("t_end", both)
                    .unit(time)
                    .long_name("time at the end of the trajectory"),
            )
            .variable(
                Variable::i32("fallback", both)
                    .long_name("updates of the map's law without an answer of the map"),
            )
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
            let name = |(i, _): &(usize, Vec<f64>)| model.states[*i].variable.name.clone();
            let axes: Vec<String> = self.initial.axes.iter().map(name).collect();
            let counts: Vec<i32> = self
                .initial
                .counts()
                .into_iter()
                .map(|c| c as i32)
                .collect();
            group = group
                .attribute("axes", axes.join(" "))
                .attribute("counts", counts);
        }
        for record in &self.closed_loop.records {
            group = group.variable(Variable::f64(&record.name, both).long_name(&record.text));
        }
        let mut writer = file.group(&group)?;
        writer.write("x0", &self.initial.x)?;
        writer.write("V", &self.values)?;
        writer.write("J", &self.all(|l| l.cost.clone()))?;
        writer.write("suboptimality", &self.all(|l| self.suboptimality(l)))?;
        writer.write(
            "converged",
            &self.all(|l| l.converged.iter().map(|c| i32::from(*c)).collect()),
        )?;
        writer.write("status", &self.all(|l| l.status.clone()))?;
        writer.write("t_end", &self.all(|l| l.t_end.clone()))?;
        writer.write("fallback", &self.all(LawResult::fallbacks))?;
        let count = self.closed_loop.records.len();
        for (k, record) in self.closed_loop.records.iter().enumerate() {
            let of = |l: &LawResult| l.records.iter().skip(k).step_by(count).copied().collect();
            writer.write(&record.name, &self.all(of))?;
        }
        Ok(())
    }

    fn write_laws(&self, file: &mut ResultFile) -> Result<(), OutputError> {
        let columns: [(&str, &str, &str); 10] = [
            (
                "share_converged",
                "1",
                "share of initial states from which the law converges",
            ),
            ("suboptimality_median", "1", "median of J/V - 1"),
            ("suboptimality_p99", "1", "99 % quantile of J/V - 1"),
            ("suboptimality_max", "1", "largest J/V - 1"),
            ("suboptimality_count", "1", "initial states with J/V - 1"),
            ("seconds", "s", "time of the simulation"),
            ("rate", "1/s", "initial states a second"),
            ("failed", "1", "trajectories that ended early"),
            (
                "held",
                "1",
                "share of the map law's updates without an answer of the map",
            ),
            ("fell_back", "1", "trajectories with such updates"),
        ];
        let mut group = Group::new("closed_loop_laws")
            .dimension(self.laws_dimension())
            .variable(Variable::text(
                "source",
                "law",
                self.laws.iter().map(|l| l.source.as_str()),
            ))
            .variable(Variable::text(
                "statuses",
                "law",
                self.laws.iter().map(|l| self.status_text(l)),
            ))
            .attribute("backend", self.backend.as_str())
            .attribute("adapter", self.adapter.as_str());
        for (name, unit, long_name) in columns {
            group = group.variable(Variable::f64(name, ["law"]).unit(unit).long_name(long_name));
        }
        for record in &self.closed_loop.records {
            let name = format!("worst_{}", record.name);
            group = group.variable(Variable::f64(&name, ["law"]));
        }
        let mut writer = file.group(&group)?;
        let row = |law: &LawResult| -> [f64; 10] {
            let spread = self.spread(law);
            let of = |get: fn(&Spread) -> f64| spread.as_ref().map_or(f64::NAN, get);
            let failed = law.status.iter().filter(|s| **s != 0).count();
            [
                law.share_converged(),
                of(|s| s.median),
                of(|s| s.p99),
                of(|s| s.worst),
                spread.map_or(0.0, |s| s.count as f64),
                law.seconds,
                law.rate(),
                failed as f64,
                law.held,
                law.fell_back() as f64,
            ]
        };
        let rows: Vec<[f64; 10]> = self.laws.iter().map(row).collect();
        for (k, (name, ..)) in columns.iter().enumerate() {
            writer.write(name, &rows.iter().map(|r| r[k]).collect::<Vec<f64>>())?;
        }
        for (k, record) in self.closed_loop.records.iter().enumerate() {
            let worst: Vec<f64> = self.laws.iter().map(|l| self.worst(l, k)).collect();
            writer.write(&format!("worst_{}", record.name), &worst)?;
        }
        Ok(())
    }

    fn write_sets(&self, model: &Model, file: &mut ResultFile) -> Result<(), OutputError> {
        let both = ["law", "set"];
        let names = || self.closed_loop.sets.iter().map(|s| s.name.as_str());
        let group = Group::new("operating_sets")
            .dimension(self.laws_dimension())
            .dimension(Dimension::names("set", names()))
            .variable(Variable::text(
                "condition",
                "set",
                self.closed_loop.sets.iter().map(|s| s.text.as_str()),
            ))
            .variable(Variable::f64("share", both).long_name("share of initial states inside"))
            .variable(
                Variable::f64("area", both)
                    .long_name("area inside, in the units of the grid's axes"),
            );
        let mut writer = file.group(&group)?;
        let flat = |of: fn(&SetResult) -> f64| -> Vec<f64> {
            self.sets.iter().flatten().map(of).collect()
        };
        writer.write("share", &flat(|s| s.share))?;
        writer.write("area", &flat(|s| s.area))?;
        drop(writer);

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
        let axes = self
            .initial
            .axes
            .iter()
            .map(|(i, _)| model.states[*i].variable.name.as_str());
        let laws: Vec<&str> = self.laws.iter().map(|l| l.name.as_str()).collect();
        let vertex = |name: &str, flags: &[&str]| {
            let flags: Vec<(i32, &str)> = flags
                .iter()
                .enumerate()
                .map(|(k, n)| (k as i32, *n))
                .collect();
            let variable = Variable::i32(name, ["vertex"]);
            if flags.is_empty() {
                variable
            } else {
                variable.flags(flags)
            }
        };
        let group = Group::new("operating_contours")
            .dimension(Dimension::index("vertex", columns[0].len()))
            .dimension(Dimension::names("axis", axes))
            .variable(vertex("law", &laws))
            .variable(vertex("set", &names().collect::<Vec<_>>()))
            .variable(vertex("line", &[]).long_name("number of the polyline"))
            .variable(vertex("place", &[]).long_name("place on the polyline"))
            .variable(Variable::f64("x", ["vertex", "axis"]).long_name("boundary of the set"));
        let mut writer = file.group(&group)?;
        for (name, column) in ["law", "set", "line", "place"].iter().zip(&columns) {
            writer.write(name, column)?;
        }
        writer.write("x", &x)
    }

    fn write_paths(&self, model: &Model, file: &mut ResultFile) -> Result<(), OutputError> {
        let kept = self.initial.kept();
        let (_, time) = units(model);
        let points = self.closed_loop.samples + 1;
        let names = |v: Vec<&Named>| v.into_iter().map(|v| v.name.clone()).collect::<Vec<_>>();
        let states = names(model.states.iter().map(|s| &s.variable).collect());
        let controls = names(model.controls.iter().map(|c| &c.variable).collect());
        let all = ["law", "trajectory", "sample"];
        let with = |last| all.into_iter().chain([last]);
        let group = Group::new("closed_loop_trajectories")
            .dimension(self.laws_dimension())
            .dimension(Dimension::index("trajectory", kept.len()))
            .dimension(Dimension::index("sample", points))
            .dimension(Dimension::names("state", states))
            .dimension(Dimension::names("control", controls))
            .variable(
                Variable::i32("initial", ["trajectory"])
                    .long_name("index of the initial state in /closed_loop"),
            )
            .variable(Variable::f64("t", all).unit(time).long_name("time"))
            .variable(Variable::f64("x", with("state")).long_name("state"))
            .variable(Variable::f64("u", with("control")).long_name("control"));
        let mut writer = file.group(&group)?;
        let initial: Vec<i32> = kept.iter().map(|i| *i as i32).collect();
        writer.write("initial", &initial)?;
        let gather = |of: fn(&Path) -> &Vec<f64>| {
            self.all(|l| l.paths.iter().flat_map(of).copied().collect())
        };
        writer.write("t", &gather(|p| &p.t))?;
        writer.write("x", &gather(|p| &p.x))?;
        writer.write("u", &gather(|p| &p.u))
    }
}

/// The units of cost and of time.
pub(super) fn units(model: &Model) -> (&str, &str) {
    (
        model.cost_unit.as_deref().unwrap_or("1"),
        model.time_unit.as_deref().unwrap_or("1"),
    )
}
