//! `/caustic`: where swept trajectories end in folds of the manifold.

use super::TrajectorySchema;
use super::table::Table;
use crate::hdf5::{OutputError, ResultFile};
use crate::schema;
use crate::sweep::FoldPoint;

impl ResultFile {
    /// Writes `/caustic`; nothing where there is no fold.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn caustic(
        &mut self,
        axes: &TrajectorySchema,
        folds: &[FoldPoint],
    ) -> Result<(), OutputError> {
        if folds.is_empty() {
            return Ok(());
        }
        let flat =
            |of: fn(&FoldPoint) -> &[f64]| folds.iter().flat_map(of).copied().collect::<Vec<f64>>();
        let column = |of: fn(&FoldPoint) -> f64| folds.iter().map(of).collect::<Vec<f64>>();
        let trajectory: Vec<i32> = folds.iter().map(|f| f.trajectory as i32).collect();
        let mut table = Table::new(&schema::CAUSTIC, axes).length("vertex", folds.len());
        table
            .put("x", flat(|f| &f.x))
            .put("p", flat(|f| &f.p))
            .put("V", column(|f| f.value))
            .put("t", column(|f| f.t))
            .put("trajectory", trajectory);
        table.write(self)
    }
}
