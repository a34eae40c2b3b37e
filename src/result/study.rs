//! `/study` and `/study_trajectories`.

use super::TrajectorySchema;
use super::answers::{Names, status};
use crate::hdf5::{Dimension, Group, OutputError, ResultFile, Variable};
use crate::model::Study;
use crate::study::Variant;

impl ResultFile {
    /// Writes the table of a study and its trajectories.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn study(
        &mut self,
        schema: &TrajectorySchema,
        study: &Study,
        variants: &[Variant],
    ) -> Result<(), OutputError> {
        let names = Names::new(schema);
        let count = variants.len();
        let mut group = Group::new("study")
            .attribute(
                "title",
                "the optimal trajectory from one state, for several values of parameters",
            )
            .dimension(Dimension::index("variant", count));
        group = names.axes(group);
        for (name, _) in &study.vary {
            group = group.variable(Variable::f64(name, ["variant"]).long_name("parameter"));
        }
        group = group
            .variable(names.state("x0", &["variant", "state"], "state started from"))
            .variable(
                Variable::f64("V", ["variant"])
                    .unit(names.cost())
                    .long_name("value function"),
            )
            .variable(status(["variant"]))
            .variable(Variable::i32("sheets", ["variant"]).long_name("number of solutions found"))
            .variable(
                Variable::f64("duration", ["variant"])
                    .unit(schema.time())
                    .long_name("time to near the equilibrium"),
            );
        if !schema.controls.is_empty() {
            let u = Variable::f64("u", ["variant", "control"]).unit(names.control_unit());
            group = group.variable(u.long_name("control at the beginning"));
        }
        for record in &study.records {
            group =
                group.variable(Variable::f64(&record.name, ["variant"]).long_name(&record.text));
        }
        let mut writer = self.group(&group)?;
        let column = |f: &dyn Fn(&Variant) -> f64| variants.iter().map(f).collect::<Vec<f64>>();
        let flat =
            |f: &dyn Fn(&Variant) -> Vec<f64>| variants.iter().flat_map(f).collect::<Vec<f64>>();
        for (k, (name, _)) in study.vary.iter().enumerate() {
            writer.write(name, &column(&|v| v.parameters[k]))?;
        }
        writer.write("x0", &flat(&|v| v.x0.clone()))?;
        writer.write("V", &column(&|v| v.value))?;
        let integers = |f: &dyn Fn(&Variant) -> i32| variants.iter().map(f).collect::<Vec<i32>>();
        writer.write("status", &integers(&|v| v.status as i32))?;
        writer.write("sheets", &integers(&|v| v.sheets as i32))?;
        writer.write("duration", &column(&|v| v.duration))?;
        if !schema.controls.is_empty() {
            writer.write("u", &flat(&|v| v.u.clone()))?;
        }
        for (k, record) in study.records.iter().enumerate() {
            writer.write(&record.name, &column(&|v| v.records[k]))?;
        }
        self.study_trajectories(&names, schema, study, variants)
    }

    fn study_trajectories(
        &mut self,
        names: &Names<'_>,
        schema: &TrajectorySchema,
        study: &Study,
        variants: &[Variant],
    ) -> Result<(), OutputError> {
        let (samples, n, m) = (study.samples, schema.states.len(), schema.controls.len());
        let mut group = Group::new("study_trajectories")
            .attribute("title", "the trajectories of /study")
            .dimension(Dimension::index("variant", variants.len()))
            .dimension(Dimension::index("sample", samples));
        group = names.axes(group);
        let dims = ["variant", "sample"];
        group = group
            .variable(
                Variable::f64("t", dims)
                    .unit(schema.time())
                    .long_name("time, 0 at the state started from"),
            )
            .variable(names.state("x", &["variant", "sample", "state"], "state"))
            .variable(
                Variable::f64("V", dims)
                    .unit(names.cost())
                    .long_name("value function"),
            );
        if m > 0 {
            let u = Variable::f64("u", ["variant", "sample", "control"]).unit(names.control_unit());
            group = group.variable(u.long_name("control"));
        }
        let mut writer = self.group(&group)?;
        let flat = |width: usize,
                    f: &dyn Fn(&crate::trajectories::TrajectoryBlock) -> Vec<f64>|
         -> Vec<f64> {
            (variants.iter())
                .flat_map(|v| {
                    v.trajectory
                        .as_ref()
                        .map_or_else(|| vec![f64::NAN; samples * width], f)
                })
                .collect()
        };
        let from_start = |t: &[f64]| t.iter().map(|at| at - t[0]).collect::<Vec<f64>>();
        writer.write("t", &flat(1, &|b| from_start(&b.t)))?;
        writer.write("x", &flat(n, &|b| b.x.clone()))?;
        writer.write("V", &flat(1, &|b| b.v.clone()))?;
        if m > 0 {
            writer.write("u", &flat(m, &|b| b.u.clone()))?;
        }
        Ok(())
    }
}
