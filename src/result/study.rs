//! `/study` and `/study_trajectories`.

use super::TrajectorySchema;
use super::answers::point_statuses;
use super::table::Table;
use crate::hdf5::{OutputError, ResultFile};
use crate::model::Study;
use crate::schema;
use crate::study::Variant;
use crate::trajectories::TrajectoryBlock;

impl ResultFile {
    /// Writes the table of a study and its trajectories.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn study(
        &mut self,
        axes: &TrajectorySchema,
        study: &Study,
        variants: &[Variant],
    ) -> Result<(), OutputError> {
        let column = |f: &dyn Fn(&Variant) -> f64| variants.iter().map(f).collect::<Vec<f64>>();
        let flat = |f: fn(&Variant) -> &[f64]| -> Vec<f64> {
            variants.iter().flat_map(f).copied().collect()
        };
        let integers = |f: fn(&Variant) -> i32| variants.iter().map(f).collect::<Vec<i32>>();
        let mut table = Table::new(&schema::STUDY, axes).length("variant", variants.len());
        for (k, (name, _)) in study.vary.iter().enumerate() {
            table.put_named("<parameter>", name, None, column(&|v| v.parameters[k]));
        }
        table
            .put("x0", flat(|v| &v.x0))
            .put("V", column(&|v| v.value))
            .put_codes("status", point_statuses(), integers(|v| v.status as i32))
            .put("sheets", integers(|v| v.sheets as i32))
            .put("duration", column(&|v| v.duration));
        if !axes.controls.is_empty() {
            table.put("u", flat(|v| &v.u));
        }
        for (k, record) in study.records.iter().enumerate() {
            let values = column(&|v| v.records[k]);
            table.put_named("<quantity>", &record.name, Some(&record.text), values);
        }
        table.write(self)?;
        self.study_trajectories(axes, study.samples, variants)
    }

    fn study_trajectories(
        &mut self,
        axes: &TrajectorySchema,
        samples: usize,
        variants: &[Variant],
    ) -> Result<(), OutputError> {
        let flat = |width: usize, f: fn(&TrajectoryBlock) -> &[f64]| -> Vec<f64> {
            (variants.iter())
                .flat_map(|v| match &v.trajectory {
                    Some(block) => f(block).to_vec(),
                    None => vec![f64::NAN; samples * width],
                })
                .collect()
        };
        // From the start of each trajectory.
        let mut t = flat(1, |b| &b.t);
        for one in t.chunks_mut(samples) {
            let start = one[0];
            one.iter_mut().for_each(|t| *t -= start);
        }
        let mut table = Table::new(&schema::STUDY_TRAJECTORIES, axes)
            .length("variant", variants.len())
            .length("sample", samples);
        table
            .put("t", t)
            .put("x", flat(axes.states.len(), |b| &b.x))
            .put("V", flat(1, |b| &b.v));
        if !axes.controls.is_empty() {
            table.put("u", flat(axes.controls.len(), |b| &b.u));
        }
        table.write(self)
    }
}
