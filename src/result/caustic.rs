//! `/caustic`: where swept trajectories end in folds of the manifold.

use super::TrajectorySchema;
use super::answers::Names;
use crate::hdf5::{Dimension, Group, OutputError, ResultFile, Variable};
use crate::sweep::FoldPoint;

impl ResultFile {
    /// Writes `/caustic`; nothing where there is no fold.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn caustic(
        &mut self,
        schema: &TrajectorySchema,
        folds: &[FoldPoint],
    ) -> Result<(), OutputError> {
        if folds.is_empty() {
            return Ok(());
        }
        let names = Names::new(schema);
        let mut group = Group::new("caustic")
            .attribute(
                "title",
                "where trajectories meet a fold of the manifold: det dx/dseed = 0; in a game the boundary of the region of validity",
            )
            .expected_rows(Some(folds.len()))
            .dimension(Dimension::unlimited("vertex"));
        group = names.axes(group);
        group = group
            .variable(names.state("x", &["vertex", "state"], "state"))
            .variable(names.costate("p", &["vertex", "state"]))
            .variable(
                Variable::f64("V", ["vertex"])
                    .unit(names.cost())
                    .long_name("cost along the trajectory, the limit of the value function"),
            )
            .variable(
                Variable::f64("t", ["vertex"])
                    .unit(schema.time())
                    .long_name("time"),
            )
            .variable(
                Variable::i32("trajectory", ["vertex"])
                    .long_name("index of the trajectory that ends there"),
            );
        let flat = |of: &dyn Fn(&FoldPoint) -> &[f64]| {
            folds.iter().flat_map(of).copied().collect::<Vec<f64>>()
        };
        let (x, p) = (flat(&|f| &f.x), flat(&|f| &f.p));
        let value: Vec<f64> = folds.iter().map(|f| f.value).collect();
        let t: Vec<f64> = folds.iter().map(|f| f.t).collect();
        let trajectory: Vec<i32> = folds.iter().map(|f| f.trajectory as i32).collect();
        self.group(&group)?.append(
            folds.len(),
            &[
                ("x", (&x).into()),
                ("p", (&p).into()),
                ("V", (&value).into()),
                ("t", (&t).into()),
                ("trajectory", (&trajectory).into()),
            ],
        )
    }
}
