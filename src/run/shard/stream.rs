//! The rows of parts, with all that belongs to them, on their way into the groups of the whole.

use super::super::RunError;
use super::elsewhere::own_columns;
use super::rows::{Layout, Rows, Sink};
use super::source::Source;
use super::whole::Whole;
use crate::hdf5::ResultFile;
use crate::result::{ShardFiles, ShardGroups, StoredError, TrajectorySchema};
use crate::schema;
use crate::sweep::Plan;
use crate::value::PointStatus;
use std::collections::BTreeMap;

/// Rows that are held of a file at most, and that are written at once.
pub(super) const MOST_ROWS: usize = 8192;

/// What was counted while rows were written.
#[derive(Default)]
pub(super) struct Counted {
    pub status: BTreeMap<String, usize>,
    pub residual: f64,
    pub hamiltonian: Vec<f64>,
}

/// The rows of a part: its states, the solutions of each, and its trajectory.
pub(super) struct Stream {
    pub place: Rows,
    points: Option<Rows>,
    solutions: Option<(Rows, Rows)>,
    trajectories: Option<Rows>,
    layouts: Layouts,
    /// How many different states of each block have come.
    seen: BTreeMap<i32, i32>,
}

/// The variables of each group of a part.
#[derive(Clone, Default)]
struct Layouts {
    points: Option<Layout>,
    solutions: Option<Layout>,
    trajectories: Option<Layout>,
}

impl Stream {
    pub fn open(source: &Source, at_once: usize) -> Result<Self, RunError> {
        let stored = &source.stored;
        let damaged = |group| source.damaged(group);
        let rows = |own: &'static schema::Group| -> Result<Option<(Rows, Layout)>, StoredError> {
            let Some(group) = stored.group(own) else {
                return Ok(None);
            };
            let layout = Layout::of(&group, own)?;
            if let Some(name) =
                (layout.names.iter().zip(&layout.single)).find(|(_, single)| **single)
            {
                return Err(group.error(name.0, "its numbers have 32 bits, not 64"));
            }
            Ok(Some((Rows::new(&group, &layout, at_once)?, layout)))
        };
        let (place, _) = rows(&schema::SHARD_POINTS)?.ok_or_else(|| damaged("shard_points"))?;
        let points = rows(&schema::POINTS)?;
        let count = points.as_ref().map_or(0, |(rows, _)| rows.count);
        if count != place.count {
            return Err(damaged("shard_points"));
        }
        let (points, of_points) = points.unzip();
        let (solutions, of_solutions) = rows(&schema::POINTS_SHEETS)?.unzip();
        let (sheets, _) = rows(&schema::SHARD_SHEETS)?.unzip();
        let solutions = match (solutions, sheets) {
            (Some(solutions), Some(sheets)) if solutions.count == sheets.count => {
                Some((solutions, sheets))
            }
            (None, _) => None,
            _ => return Err(damaged("shard_sheets")),
        };
        let (trajectories, of_trajectories) = rows(&schema::TRAJECTORIES)?.unzip();
        let samples = source.manifest.asked.samples;
        let other = |layout: &Layout| {
            let stored = layout.place("V").map(|v| layout.widths[v]);
            samples.is_some() && stored != samples
        };
        if of_trajectories.as_ref().is_some_and(other) {
            return Err(damaged("trajectories"));
        }
        Ok(Self {
            place,
            points,
            solutions,
            trajectories,
            layouts: Layouts {
                points: of_points,
                solutions: of_solutions,
                trajectories: of_trajectories,
            },
            seen: BTreeMap::new(),
        })
    }

    /// Whether, at the end, as many states and solutions have come as the part says it has.
    pub fn is_complete(&self, source: &Source) -> bool {
        let seen = |block: &i32| self.seen.get(block).copied().unwrap_or(0);
        let blocks = source.number.iter().zip(&source.states);
        let solutions = self.solutions.as_ref();
        blocks
            .into_iter()
            .all(|(block, states)| seen(block) == *states)
            && solutions.is_none_or(|(rows, _)| rows.at == rows.count)
            && (self.trajectories.as_ref()).is_none_or(|rows| rows.at == rows.count)
    }

    /// The number of the present state among all; `None` at the end.
    pub fn index(&mut self) -> Result<Option<i32>, StoredError> {
        match self.place.at < self.place.count {
            true => self.place.whole(0).map(Some),
            false => Ok(None),
        }
    }

    pub fn block(&mut self) -> Result<i32, StoredError> {
        self.place.whole(1)
    }

    pub fn advance(&mut self) -> Result<(), StoredError> {
        if self.place.whole(3)? == 0 {
            let block = self.block()?;
            *self.seen.entry(block).or_insert(0) += 1;
        }
        self.place.advance();
        if let Some(points) = &mut self.points {
            points.advance();
        }
        Ok(())
    }

    /// Passes over the present state with all that belongs to it.
    pub fn skip(&mut self) -> Result<(), StoredError> {
        if let (Some(points), Some(layout)) = (&mut self.points, &self.layouts.points) {
            let place = |name: &str| layout.place(name).unwrap_or(usize::MAX);
            let count = points.whole(place("sheets"))?;
            let value = points.reals(place("V"))?[0];
            if let Some((solutions, sheets)) = &mut self.solutions {
                (0..count).for_each(|_| {
                    solutions.advance();
                    sheets.advance();
                });
            }
            if let Some(trajectories) = self.trajectories.as_mut().filter(|_| value.is_finite()) {
                trajectories.advance();
            }
        }
        self.advance()
    }
}

/// The groups of the whole on their way.
pub(super) struct Sinks {
    points: Option<Sink>,
    solutions: Option<Sink>,
    map: Option<Sink>,
    trajectories: Option<Sink>,
    value_max: Option<f64>,
    names: Layouts,
    /// States that go to `/points`: the first ones.
    listed: usize,
}

impl Sinks {
    pub fn new(
        whole: &Whole<'_>,
        file: &mut ResultFile,
        streams: &[Stream],
        files: Option<&ShardFiles>,
        is_part: bool,
    ) -> Result<Self, RunError> {
        let (schema, at_once) = (&whole.schema, MOST_ROWS);
        let any = |of: fn(&Layouts) -> &Option<Layout>| {
            streams.iter().find_map(|s| of(&s.layouts).clone())
        };
        let names = Layouts {
            points: any(|l| &l.points),
            solutions: any(|l| &l.solutions),
            trajectories: any(|l| &l.trajectories),
        };
        let asked = &whole.manifest.asked;
        let count = if is_part { asked.rows } else { asked.points };
        let points = match (&names.points, files) {
            (Some(_), Some(files)) if count > 0 => {
                let writer = file.points_elsewhere(schema, count, files)?;
                Some(own_columns(writer, &ShardFiles::OWN_OF_POINTS))
            }
            (Some(layout), None) if count > 0 => {
                let writer = file.points_later(schema, count)?;
                Some(Sink::new(writer, layout.clone(), at_once, None))
            }
            _ => None,
        };
        let any_of = |of: &[usize]| of.iter().any(|rows| *rows > 0);
        let solutions = match (&names.solutions, files) {
            (Some(_), Some(files)) if any_of(&files.entries) => {
                let writer = file.points_sheets_elsewhere(schema, files)?;
                Some(own_columns(writer, &ShardFiles::OWN_OF_ENTRIES))
            }
            (Some(layout), None) if count > 0 => {
                let writer = file.points_sheets_later(schema, count)?;
                Some(Sink::new(writer, layout.clone(), at_once, None))
            }
            _ => None,
        };
        let map = match (whole.grid().filter(|_| !is_part), &names.points) {
            (Some(grid), Some(of_points)) => {
                let (layout, places) = of_points.part_of(&schema::MAP);
                let slab = grid.len() / grid.axes[0].len();
                let writer = file.map_later(schema, grid)?;
                let places = places.into_iter().map(Some).collect();
                Some(Sink::new(writer, layout, at_once, Some(slab)).taking(places))
            }
            _ => None,
        };
        let trajectories = match (&names.trajectories, whole.manifest.asked.samples) {
            (Some(layout), Some(samples)) => {
                let schema = TrajectorySchema {
                    samples,
                    ..schema.clone()
                };
                match files {
                    Some(files) if any_of(&files.trajectories) => {
                        let writer = file.trajectories_elsewhere(&schema, files)?;
                        Some(own_columns(writer, &ShardFiles::OWN_OF_TRAJECTORIES))
                    }
                    Some(_) => None,
                    None => {
                        let writer = file.group(&schema.group()?)?;
                        Some(Sink::new(writer, layout.clone(), at_once / 8, None))
                    }
                }
            }
            _ => None,
        };
        let of_map = whole.model.map.as_ref();
        Ok(Self {
            points,
            solutions,
            map,
            trajectories,
            value_max: of_map.and_then(|m| m.value_max),
            names,
            listed: count,
        })
    }

    /// A state of a part that is missing.
    pub fn nothing(&mut self, whole: &Whole<'_>, row: usize) -> Result<(), RunError> {
        let sink = match row < self.listed {
            true => self.points.as_mut(),
            false => self.map.as_mut(),
        };
        let Some(sink) = sink else { return Ok(()) };
        sink.nothing();
        sink.set_wholes("given", row as i32);
        sink.set_wholes("sheet", -1);
        sink.set_wholes("lifted_sheet", -1);
        sink.set_wholes("status", PointStatus::NotMerged as i32);
        let mut first = 0;
        for grid in &whole.request.grids {
            if (first..first + grid.len()).contains(&row) {
                sink.set_reals("x0", &grid.point(row - first));
            }
            first += grid.len();
        }
        Ok(sink.flush_if_full()?)
    }

    /// The present state of a part with all that belongs to it: its number among all, and its row in
    /// `/points`. `None` where its sheets are none of its block's.
    pub fn row(
        &mut self,
        whole: &Whole<'_>,
        stream: &mut Stream,
        (row, place): (usize, usize),
        numbers: &dyn Fn(i32) -> Option<(i32, i32)>,
        (counted, mut part): (&mut Counted, Option<&mut ShardGroups>),
    ) -> Result<Option<()>, RunError> {
        let (Some(rows), Some(layout)) = (&mut stream.points, &self.names.points) else {
            return Ok(None);
        };
        let of = |name: &str| layout.place(name).unwrap_or(usize::MAX);
        let (v, sheets, status) = (of("V"), of("sheets"), of("status"));
        let value = rows.reals(v)?[0];
        let count = rows.whole(sheets)?;
        let mut code = rows.whole(status)?;
        let Some((sheet, lifted)) = numbers(stream.place.whole(2)?) else {
            return Ok(None);
        };
        if row < self.listed {
            if let Some(sink) = &mut self.points {
                sink.take(rows)?;
                sink.set_wholes("given", row as i32);
                sink.set_wholes("sheet", sheet);
                sink.set_wholes("lifted_sheet", lifted);
                sink.flush_if_full()?;
            }
        } else if let Some(sink) = &mut self.map {
            sink.take(rows)?;
            sink.set_wholes("sheet", sheet);
            sink.set_wholes("lifted_sheet", lifted);
            if self.value_max.is_some_and(|most| value > most) {
                code = PointStatus::AboveMax as i32;
                for name in ["V", "p", "u"] {
                    sink.forget(name);
                }
                for name in ["sheet", "lifted_sheet"] {
                    sink.set_wholes(name, -1);
                }
                sink.set_wholes("winding", 0);
                sink.set_wholes("status", code);
            }
            sink.flush_if_full()?;
        }
        let status = (PointStatus::ALL.iter())
            .find(|(s, _)| *s as i32 == rows.whole(status).unwrap_or(code))
            .map_or("?", |(_, name)| name);
        *counted.status.entry(status.to_owned()).or_insert(0) += 1;

        for _ in 0..count {
            let (Some((solutions, within)), Some(layout)) =
                (&mut stream.solutions, &self.names.solutions)
            else {
                return Ok(None);
            };
            let Some((sheet, lifted)) = numbers(within.whole(0)?) else {
                return Ok(None);
            };
            let of = |name: &str| layout.place(name).unwrap_or(usize::MAX);
            let is_counted = stream.place.whole(3)? == 0;
            let residual = solutions.reals(of("residual"))?[0];
            counted.residual = counted.residual.max(residual);
            let h = solutions.reals(of("H"))?[0].abs();
            let p = solutions.reals(of("p"))?.to_vec();
            let winding = solutions.wholes(of("winding"))?.to_vec();
            if let Some(x) = stream.points.as_mut().filter(|_| is_counted) {
                let x = x.reals(
                    self.names
                        .points
                        .as_ref()
                        .and_then(|l| l.place("x0"))
                        .unwrap_or(0),
                )?;
                counted
                    .hamiltonian
                    .push(relative(&whole.plan, x, &winding, &p, h));
            }
            if row < self.listed
                && let Some(sink) = &mut self.solutions
            {
                sink.take(solutions)?;
                if let Some(part) = &mut part {
                    part.entry_sheet.push(within.whole(0)?);
                }
                sink.set_wholes("point", place as i32);
                sink.set_wholes("sheet", sheet);
                sink.set_wholes("lifted_sheet", lifted);
                sink.flush_if_full()?;
            }
            solutions.advance();
            within.advance();
        }
        if value.is_finite()
            && let Some(sink) = &mut self.trajectories
        {
            let Some(rows) = &mut stream.trajectories else {
                return Ok(None);
            };
            sink.take(rows)?;
            sink.set_wholes("given", row as i32);
            sink.set_wholes("sheet", sheet);
            sink.flush_if_full()?;
            rows.advance();
        }
        Ok(Some(()))
    }

    pub fn flush(&mut self) -> Result<(), RunError> {
        for sink in [
            self.points.as_mut(),
            self.solutions.as_mut(),
            self.map.as_mut(),
            self.trajectories.as_mut(),
        ]
        .into_iter()
        .flatten()
        {
            sink.flush()?;
        }
        Ok(())
    }
}

/// |H| relative to the running cost at a solution's beginning.
fn relative(plan: &Plan, x: &[f64], winding: &[i32], p: &[f64], h: f64) -> f64 {
    let running = plan.system.rate[2 * plan.system.states];
    let s: Vec<f64> = (0..x.len())
        .map(|i| {
            let turns = f64::from(winding[i]) * plan.periods[i].unwrap_or(0.0);
            x[i] - plan.system.reference[i] + turns
        })
        .collect();
    let cost = plan.system.eval(&[running], &s, p)[0].abs();
    if cost > 0.0 { h / cost } else { h }
}
