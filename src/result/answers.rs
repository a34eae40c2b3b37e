//! The groups `/points`, `/points_sheets`, `/map`, `/equal_cost` and `/folds`.

use super::TrajectorySchema;
use super::table::{Data, Table};
use crate::hdf5::{Group, GroupWriter, OutputError, ResultFile};
use crate::schema;
use crate::value::{Answers, Entry, EqualCost, Evidence, Fold, Grid, PointStatus};
use std::mem::take;

const NO_SHEET: i32 = -1;

/// Codes of [`PointStatus`].
pub(super) fn point_statuses() -> impl Iterator<Item = (i32, &'static str)> {
    PointStatus::ALL
        .into_iter()
        .map(|(s, name)| (s as i32, name))
}

/// Columns of what supports some points.
#[derive(Default)]
struct SupportColumns {
    evidence: Vec<i32>,
    covered_to: Vec<f64>,
    bound: Vec<f64>,
    starts: Vec<i32>,
    flights: Vec<i32>,
}

impl SupportColumns {
    fn push(&mut self, answers: &Answers, target: usize) {
        let support = &answers.support[target];
        self.evidence.push(answers.evidence(target) as i32);
        self.covered_to.push(support.covered_to);
        self.bound.push(support.bound.unwrap_or(f64::NAN));
        self.starts.push(support.starts as i32);
        self.flights.push(support.flights as i32);
    }

    fn put(self, table: &mut Table<'_>) {
        table
            .put_codes(
                "evidence",
                Evidence::ALL.map(|(e, name)| (e as i32, name)),
                self.evidence,
            )
            .put("covered_to", self.covered_to)
            .put("bound", self.bound)
            .put("starts", self.starts)
            .put("flights", self.flights);
    }
}

/// Columns of the solutions of some points.
#[derive(Default)]
struct Columns {
    value: Vec<f64>,
    p: Vec<f64>,
    u: Vec<f64>,
    sheet: Vec<i32>,
    lifted: Vec<i32>,
    winding: Vec<i32>,
    status: Vec<i32>,
}

impl Columns {
    /// V, p, u, the sheet and the way round.
    fn put_solutions(&mut self, axes: &TrajectorySchema, table: &mut Table<'_>) {
        table
            .put("V", take(&mut self.value))
            .put("p", take(&mut self.p));
        if !axes.controls.is_empty() {
            table.put("u", take(&mut self.u));
        }
        table
            .put("sheet", take(&mut self.sheet))
            .put("lifted_sheet", take(&mut self.lifted))
            .put("winding", take(&mut self.winding));
    }

    fn push(&mut self, axes: &TrajectorySchema, entry: Option<&Entry>, status: PointStatus) {
        self.status.push(status as i32);
        let (n, m) = (axes.states.len(), axes.controls.len());
        match entry {
            Some(e) => {
                self.value.push(e.value);
                self.p.extend_from_slice(&e.p);
                self.u.extend_from_slice(&e.u);
                self.sheet.push(e.sheet);
                self.lifted.push(e.lifted);
                self.winding.extend_from_slice(&e.winding);
            }
            None => {
                self.value.push(f64::NAN);
                self.p.extend(vec![f64::NAN; n]);
                self.u.extend(vec![f64::NAN; m]);
                self.sheet.push(NO_SHEET);
                self.lifted.push(NO_SHEET);
                self.winding.extend(vec![0; n]);
            }
        }
    }
}

/// Declares the columns of solutions.
fn solutions_later(axes: &TrajectorySchema, table: &mut Table<'_>) {
    for name in ["V", "p", "sheet", "lifted_sheet", "winding"] {
        table.put(name, Data::Later);
    }
    if !axes.controls.is_empty() {
        table.put("u", Data::Later);
    }
}

/// Declares those of statuses and of what supports V.
fn codes_later(table: &mut Table<'_>) {
    let evidence = Evidence::ALL.map(|(e, name)| (e as i32, name));
    table
        .put_codes("status", point_statuses(), Data::Later)
        .put_codes("evidence", evidence, Data::Later);
    for name in ["covered_to", "bound", "starts", "flights"] {
        table.put(name, Data::Later);
    }
}

/// `/points` for about so many rows, which are appended; whether with their places among the states
/// given.
pub(super) fn points_declared(
    axes: &TrajectorySchema,
    rows: usize,
    given: bool,
) -> Result<Group, OutputError> {
    let mut table = Table::new(&schema::POINTS, axes).length("point", rows);
    solutions_later(axes, &mut table);
    for name in [
        "x0",
        "iterations",
        "residual",
        "H",
        "sheets",
        "furthest",
        "flown",
    ] {
        table.put(name, Data::Later);
    }
    codes_later(&mut table);
    if given {
        table.put("given", Data::Later);
    }
    table.declare()
}

/// `/points_sheets` for about so many rows, which are appended.
pub(super) fn points_sheets_declared(
    axes: &TrajectorySchema,
    rows: usize,
) -> Result<Group, OutputError> {
    let mut table = Table::new(&schema::POINTS_SHEETS, axes).length("entry", rows);
    solutions_later(axes, &mut table);
    for name in ["point", "H", "residual"] {
        table.put(name, Data::Later);
    }
    table.declare()
}

impl ResultFile {
    /// Writes `/points` and `/points_sheets` for the states given from the `first`-th on, `count`
    /// of them, in the order in which they were given.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn points(
        &mut self,
        axes: &TrajectorySchema,
        answers: &Answers,
        first: usize,
        count: usize,
    ) -> Result<(), OutputError> {
        if count == 0 {
            return Ok(());
        }
        let given = &answers.targets.of_given[first..first + count];
        let n = axes.states.len();
        let mut columns = Columns::default();
        let mut supports = SupportColumns::default();
        let (mut x0, mut furthest) = (Vec::new(), Vec::new());
        let (mut iterations, mut sheets) = (Vec::new(), Vec::new());
        let (mut residual, mut h, mut flown) = (Vec::new(), Vec::new(), Vec::new());
        for &target in given {
            let entry = answers.answer(target);
            columns.push(axes, entry, answers.status(target));
            supports.push(answers, target);
            let state = answers.targets.state(target);
            x0.extend_from_slice(state);
            match &answers.misses[target] {
                None => furthest.extend_from_slice(state),
                Some(miss) => match &miss.furthest {
                    Some(x) => furthest.extend_from_slice(x),
                    None => furthest.extend(vec![f64::NAN; n]),
                },
            }
            iterations.push(entry.map_or(0, |e| e.iterations as i32));
            residual.push(entry.map_or(f64::NAN, |e| e.residual));
            h.push(entry.map_or(f64::NAN, |e| e.hamiltonian));
            flown.push(answers.support[target].flown.unwrap_or(f64::NAN));
            sheets.push(answers.of(target).len() as i32);
        }

        let mut table = Table::new(&schema::POINTS, axes).length("point", count);
        table.put("x0", x0);
        columns.put_solutions(axes, &mut table);
        table
            .put_codes("status", point_statuses(), columns.status)
            .put("iterations", iterations)
            .put("residual", residual)
            .put("H", h)
            .put("sheets", sheets)
            .put("furthest", furthest);
        supports.put(&mut table);
        table.put("flown", flown);
        table.write(self)?;
        self.points_sheets(axes, answers, given)
    }

    /// Makes `/points` for about so many rows, which are appended.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn points_later(
        &mut self,
        axes: &TrajectorySchema,
        rows: usize,
    ) -> Result<GroupWriter, OutputError> {
        self.group(&points_declared(axes, rows, false)?)
    }

    /// Makes `/points_sheets` for about so many rows, which are appended.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn points_sheets_later(
        &mut self,
        axes: &TrajectorySchema,
        rows: usize,
    ) -> Result<GroupWriter, OutputError> {
        self.group(&points_sheets_declared(axes, rows)?)
    }

    /// Makes `/map` for a grid, to be written in parts.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn map_later(
        &mut self,
        axes: &TrajectorySchema,
        grid: &Grid,
    ) -> Result<GroupWriter, OutputError> {
        let mut table = Table::new(&schema::MAP, axes).grid(&grid.axes, None);
        solutions_later(axes, &mut table);
        codes_later(&mut table);
        self.group(&table.declare()?)
    }

    fn points_sheets(
        &mut self,
        axes: &TrajectorySchema,
        answers: &Answers,
        given: &[usize],
    ) -> Result<(), OutputError> {
        let mut columns = Columns::default();
        let (mut point, mut h, mut residual) = (Vec::new(), Vec::new(), Vec::new());
        for (k, &target) in given.iter().enumerate() {
            for entry in answers.of(target) {
                point.push(k as i32);
                columns.push(axes, Some(entry), PointStatus::Converged);
                h.push(entry.hamiltonian);
                residual.push(entry.residual);
            }
        }
        if point.is_empty() {
            return Ok(());
        }
        let mut table = Table::new(&schema::POINTS_SHEETS, axes).length("entry", point.len());
        table.put("point", point);
        columns.put_solutions(axes, &mut table);
        table.put("H", h).put("residual", residual);
        table.write(self)
    }

    /// Writes `/map` for a grid whose points are those given from the `first`-th on. V above
    /// `value_max` is left out.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn map(
        &mut self,
        axes: &TrajectorySchema,
        answers: &Answers,
        grid: &Grid,
        first: usize,
        value_max: Option<f64>,
    ) -> Result<(), OutputError> {
        let mut columns = Columns::default();
        let mut supports = SupportColumns::default();
        for k in 0..grid.len() {
            let target = answers.targets.of_given[first + k];
            let lowest = answers.answer(target);
            let entry = lowest.filter(|e| value_max.is_none_or(|most| e.value <= most));
            let status = match (lowest, entry) {
                (Some(_), None) => PointStatus::AboveMax,
                _ => answers.status(target),
            };
            columns.push(axes, entry, status);
            supports.push(answers, target);
        }
        let mut table = Table::new(&schema::MAP, axes).grid(&grid.axes, None);
        columns.put_solutions(axes, &mut table);
        table.put_codes("status", point_statuses(), columns.status);
        supports.put(&mut table);
        table.write(self)
    }

    /// Writes `/equal_cost` and `/folds`, where there are any.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn sheet_edges(
        &mut self,
        axes: &TrajectorySchema,
        answers: &Answers,
    ) -> Result<(), OutputError> {
        self.equal_cost(axes, answers)?;
        let folds = &answers.folds;
        if folds.is_empty() {
            return Ok(());
        }
        let flat =
            |of: fn(&Fold) -> &[f64]| folds.iter().flat_map(of).copied().collect::<Vec<f64>>();
        let mut table = Table::new(&schema::FOLDS, axes).length("vertex", folds.len());
        table
            .put("x", flat(|f| &f.s))
            .put("p", flat(|f| &f.p))
            .put("V", folds.iter().map(|f| f.value).collect::<Vec<f64>>());
        table.write(self)
    }

    fn equal_cost(
        &mut self,
        axes: &TrajectorySchema,
        answers: &Answers,
    ) -> Result<(), OutputError> {
        if answers.equal_cost.is_empty() {
            return Ok(());
        }
        let mut order: Vec<&EqualCost> = answers.equal_cost.iter().collect();
        order.sort_by_key(|e| (e.point.line, e.point.place));
        let flat = |f: fn(&EqualCost) -> Vec<f64>| -> Vec<f64> {
            order.iter().flat_map(|e| f(e)).collect()
        };
        let column = |f: fn(&EqualCost) -> f64| order.iter().map(|e| f(e)).collect::<Vec<f64>>();
        let whole = |f: fn(&EqualCost) -> i32| order.iter().map(|e| f(e)).collect::<Vec<i32>>();
        let sheet: Vec<i32> = order.iter().flat_map(|e| e.point.sheets).collect();
        let mut table = Table::new(&schema::EQUAL_COST, axes)
            .length("vertex", order.len())
            .length("side", 2);
        table
            .put("x", flat(|e| e.point.x.clone()))
            .put("V", column(|e| e.point.value))
            .put("difference", column(|e| e.point.difference))
            .put("sheet", sheet)
            .put("p", flat(|e| e.point.p.concat()))
            .put("line", whole(|e| e.point.line))
            .put("place", whole(|e| e.point.place));
        if !axes.controls.is_empty() {
            let jump = |e: &EqualCost| e.u[1].iter().zip(&e.u[0]).map(|(b, a)| b - a).collect();
            table
                .put("u", flat(|e| e.u.concat()))
                .put("jump", flat(jump));
        }
        table.write(self)
    }
}
