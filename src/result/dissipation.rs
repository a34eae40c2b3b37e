//! Checks of the dissipation inequality in the result file: `/dissipation`.

use super::closed_loop::units;
use crate::closed_loop::Path;
use crate::closed_loop::dissipation::{
    Dissipation, DisturbanceKind, LawCheck, Origin, Summary, TOLERANCE,
};
use crate::hdf5::{Dimension, Group, OutputError, ResultFile, Variable};
use crate::model::Model;

/// The groups that a check writes, and replaces where a file has them.
pub const DISSIPATION_GROUPS: [&str; 3] = [
    "dissipation",
    "dissipation_kinds",
    "dissipation_trajectories",
];

impl Dissipation {
    /// Writes all groups.
    ///
    /// # Errors
    /// What writing gives.
    pub fn write(&self, model: &Model, file: &mut ResultFile) -> Result<(), OutputError> {
        self.write_cases(model, file)?;
        self.write_kinds(file)?;
        self.write_paths(model, file)
    }

    fn laws_dimension(&self) -> Dimension {
        Dimension::names("law", self.laws.iter().map(|l| l.name.as_str())).long_name("feedback law")
    }

    fn all(&self, of: fn(&LawCheck) -> &Vec<f64>) -> Vec<f64> {
        self.laws.iter().flat_map(of).copied().collect()
    }

    fn write_cases(&self, model: &Model, file: &mut ResultFile) -> Result<(), OutputError> {
        let both = ["law", "case"];
        let kinds = (0..)
            .zip(DisturbanceKind::ALL)
            .map(|(k, (name, _))| (k, name));
        let states = model.states.iter().map(|s| s.variable.name.as_str());
        let disturbances = model.disturbances.iter().map(|w| w.name.as_str());
        type Column<'m> = (
            &'static str,
            &'m str,
            &'static str,
            fn(&LawCheck) -> &Vec<f64>,
        );
        let (cost, time) = units(model);
        let columns: [Column<'_>; 7] = [
            ("E_z", cost, "integral of L(x, u, 0) up to t_end", |l| {
                &l.done
            }),
            (
                "W",
                cost,
                "integral of L(x, u, 0) - L(x, u, w) up to t_end",
                |l| &l.supplied,
            ),
            ("V_end", cost, "value function at t_end", |l| &l.v_end),
            (
                "ratio",
                "1",
                "largest E_z/(W + V0) over the stored times",
                |l| &l.ratio,
            ),
            (
                "violation",
                "1",
                "largest (E_z + V - W - V0)/(W + V0) over the stored times",
                |l| &l.violation,
            ),
            (
                "explained",
                "1",
                "what V's estimated errors explain of a violation beyond the tolerance",
                |l| &l.explained,
            ),
            ("t_end", time, "last time at which V was known", |l| {
                &l.t_end
            }),
        ];
        let mut group = Group::new("dissipation")
            .dimension(self.laws_dimension())
            .dimension(Dimension::index("case", self.cases.count()).long_name("disturbance"))
            .dimension(Dimension::names("state", states))
            .dimension(Dimension::names("disturbance", disturbances))
            .variable(Variable::i32("kind", ["case"]).flags(kinds))
            .variable(Variable::f64("x0", ["case", "state"]).long_name("initial state"))
            .variable(
                Variable::f64("V0", ["case"])
                    .unit(cost)
                    .long_name("value function at the initial state"),
            )
            .variable(
                Variable::i32("V0_from", ["case"])
                    .flags((0..).zip(Origin::ALL).map(|(k, (name, _))| (k, name))),
            )
            .variable(
                Variable::f64("amplitude", ["case", "disturbance"])
                    .long_name("amplitude of the disturbance"),
            )
            .variable(Variable::i32("status", both).flags(self.status_flags.clone()))
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
        for (name, unit, long_name, _) in columns {
            group = group.variable(Variable::f64(name, both).unit(unit).long_name(long_name));
        }
        let mut writer = file.group(&group)?;
        let place = |kind: &DisturbanceKind| {
            DisturbanceKind::ALL
                .iter()
                .position(|(_, k)| k == kind)
                .unwrap_or(0) as i32
        };
        writer.write(
            "kind",
            &self.cases.kind.iter().map(place).collect::<Vec<i32>>(),
        )?;
        writer.write("x0", &self.cases.x0)?;
        writer.write("V0", &self.v0)?;
        let origin =
            |from: &Origin| Origin::ALL.iter().position(|(_, o)| o == from).unwrap_or(0) as i32;
        writer.write(
            "V0_from",
            &self.origin.iter().map(origin).collect::<Vec<i32>>(),
        )?;
        writer.write("amplitude", &self.cases.amplitude)?;
        let status: Vec<i32> = self.laws.iter().flat_map(|l| &l.status).copied().collect();
        writer.write("status", &status)?;
        for (name, _, _, of) in columns {
            writer.write(name, &self.all(of))?;
        }
        Ok(())
    }

    /// A row a law and kind.
    fn write_kinds(&self, file: &mut ResultFile) -> Result<(), OutputError> {
        const COLUMNS: [(&str, &str); 9] = [
            ("count", "disturbances"),
            ("judged", "disturbances from states where V is known"),
            (
                "left",
                "of these, trajectories that ended early and are judged up to there",
            ),
            ("median_ratio", "median of E_z/(W + V0)"),
            ("worst_ratio", "largest E_z/(W + V0)"),
            ("exceeded", "ratios above 1 beyond the tolerance"),
            (
                "worst_violation",
                "largest relative violation of the inequality",
            ),
            ("violated", "violations beyond the tolerance"),
            (
                "unexplained",
                "violations beyond the tolerance and what V's estimated errors explain",
            ),
        ];
        let rows: Vec<_> = (self.laws.iter())
            .flat_map(|l| {
                l.summaries(&self.cases)
                    .into_iter()
                    .map(|s| (l.name.as_str(), s))
            })
            .collect();
        let mut group = Group::new("dissipation_kinds")
            .dimension(Dimension::index("row", rows.len()))
            .variable(Variable::text(
                "law",
                "row",
                rows.iter().map(|(law, _)| *law),
            ))
            .variable(Variable::text(
                "kind",
                "row",
                rows.iter().map(|(_, s)| s.kind.name()),
            ));
        for (name, long_name) in COLUMNS {
            group = group.variable(Variable::f64(name, ["row"]).unit("1").long_name(long_name));
        }
        let mut writer = file.group(&group)?;
        let row = |s: &Summary| {
            let [count, judged, left, exceeded, violated, unexplained] = [
                s.count,
                s.judged,
                s.left,
                s.exceeded,
                s.violated,
                s.unexplained,
            ]
            .map(|c| c as f64);
            let [median, worst, violation] = [s.median_ratio, s.worst_ratio, s.worst_violation];
            [
                count,
                judged,
                left,
                median,
                worst,
                exceeded,
                violation,
                violated,
                unexplained,
            ]
        };
        for (k, (name, _)) in COLUMNS.iter().enumerate() {
            let column: Vec<f64> = rows.iter().map(|(_, s)| row(s)[k]).collect();
            writer.write(name, &column)?;
        }
        Ok(())
    }

    fn write_paths(&self, model: &Model, file: &mut ResultFile) -> Result<(), OutputError> {
        let (cost, time) = units(model);
        let paths: Vec<(usize, &Path, &Vec<f64>)> = (self.laws.iter().enumerate())
            .flat_map(|(k, l)| {
                l.paths
                    .iter()
                    .zip(&l.path_values)
                    .map(move |(p, v)| (k, p, v))
            })
            .collect();
        let all = ["trajectory", "sample"];
        let with = |last| all.into_iter().chain([last]);
        let names =
            |v: &[&crate::model::Variable]| v.iter().map(|v| v.name.clone()).collect::<Vec<_>>();
        let states: Vec<_> = model.states.iter().map(|s| &s.variable).collect();
        let controls: Vec<_> = model.controls.iter().map(|c| &c.variable).collect();
        let disturbances: Vec<_> = model.disturbances.iter().collect();
        let laws = (0..).zip(self.laws.iter().map(|l| l.name.as_str()));
        let group = Group::new("dissipation_trajectories")
            .dimension(Dimension::index("trajectory", paths.len()))
            .dimension(Dimension::index("sample", self.samples + 1))
            .dimension(Dimension::names("state", names(&states)))
            .dimension(Dimension::names("control", names(&controls)))
            .dimension(Dimension::names("disturbance", names(&disturbances)))
            .variable(Variable::i32("law", ["trajectory"]).flags(laws))
            .variable(
                Variable::i32("case", ["trajectory"])
                    .long_name("index of the disturbance in /dissipation"),
            )
            .variable(Variable::f64("t", all).unit(time).long_name("time"))
            .variable(Variable::f64("x", with("state")).long_name("state"))
            .variable(Variable::f64("u", with("control")).long_name("control"))
            .variable(Variable::f64("w", with("disturbance")).long_name("disturbance"))
            .variable(
                Variable::f64("V", all)
                    .unit(cost)
                    .long_name("value function"),
            )
            .variable(
                Variable::f64("E_z", all)
                    .unit(cost)
                    .long_name("integral of L(x, u, 0)"),
            )
            .variable(
                Variable::f64("W", all)
                    .unit(cost)
                    .long_name("integral of L(x, u, 0) - L(x, u, w)"),
            );
        let mut writer = file.group(&group)?;
        writer.write(
            "law",
            &paths.iter().map(|(k, ..)| *k as i32).collect::<Vec<i32>>(),
        )?;
        writer.write(
            "case",
            &paths
                .iter()
                .map(|(_, p, _)| p.initial as i32)
                .collect::<Vec<i32>>(),
        )?;
        let gather = |of: fn(&Path) -> &Vec<f64>| -> Vec<f64> {
            paths.iter().flat_map(|(_, p, _)| of(p)).copied().collect()
        };
        writer.write("t", &gather(|p| &p.t))?;
        writer.write("x", &gather(|p| &p.x))?;
        writer.write("u", &gather(|p| &p.u))?;
        writer.write("w", &gather(|p| &p.w))?;
        writer.write(
            "V",
            &paths
                .iter()
                .flat_map(|(_, _, v)| v.iter())
                .copied()
                .collect::<Vec<f64>>(),
        )?;
        writer.write("E_z", &gather(|p| &p.cost))?;
        writer.write("W", &gather(|p| &p.supplied))
    }
}
