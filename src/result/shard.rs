//! The groups of a shard's file that `costate merge` reads.

use super::table::{NO_AXES, Table};
use crate::hdf5::{OutputError, ResultFile};
use crate::schema;

/// Which part of the states a file has.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ShardGroups {
    /// Of each block in the file: its number among all, 1 where it was searched to the end, and how
    /// many different states it has.
    pub number: Vec<i32>,
    pub done: Vec<i32>,
    pub states: Vec<i32>,
    /// Of each row of `/points` (then of `/map`, where the file has one): its number among all
    /// states asked for, its block, and its sheet within that.
    pub index: Vec<i32>,
    pub block: Vec<i32>,
    pub sheet: Vec<i32>,
    /// 1 where an earlier row has the same state.
    pub again: Vec<i32>,
    /// Of each row of `/points_sheets` its sheet within its block.
    pub entry_sheet: Vec<i32>,
    /// What joins blocks.
    pub seams: Vec<f64>,
}

impl ResultFile {
    /// Writes `/shard`, `/shard_points`, `/shard_sheets` and `/shard_seams`.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn shard(&mut self, groups: &ShardGroups) -> Result<(), OutputError> {
        let mut table = Table::new(&schema::SHARD, &NO_AXES).length("block", groups.number.len());
        table
            .put("number", &groups.number)
            .put("done", &groups.done)
            .put("states", &groups.states);
        table.write(self)?;
        let rows = groups.index.len();
        let mut table = Table::new(&schema::SHARD_POINTS, &NO_AXES).length("point", rows);
        table
            .put("index", &groups.index)
            .put("block", &groups.block)
            .put("sheet", &groups.sheet)
            .put("again", &groups.again);
        table.write(self)?;
        let entries = groups.entry_sheet.len();
        let mut table = Table::new(&schema::SHARD_SHEETS, &NO_AXES).length("entry", entries);
        table.put("sheet", &groups.entry_sheet);
        table.write(self)?;
        let count = groups.seams.len();
        let mut table = Table::new(&schema::SHARD_SEAMS, &NO_AXES).length("number", count);
        table.put("value", &groups.seams);
        table.write(self)
    }
}
