//! Rows of groups, read and written as they come, whatever there are in all.

use crate::hdf5::{GroupWriter, OutputError, Values};
use crate::result::{StoredColumn, StoredError, StoredGroup};
use crate::schema;
use std::ops::Range;

/// Numbers of a column.
#[derive(Clone, Debug)]
pub enum Column {
    Reals(Vec<f64>),
    Wholes(Vec<i32>),
}

impl Column {
    fn clear(&mut self) {
        match self {
            Self::Reals(numbers) => numbers.clear(),
            Self::Wholes(numbers) => numbers.clear(),
        }
    }

    /// Adds numbers that are not known.
    fn unknown(&mut self, count: usize) {
        match self {
            Self::Reals(numbers) => numbers.extend(std::iter::repeat_n(f64::NAN, count)),
            Self::Wholes(numbers) => numbers.extend(std::iter::repeat_n(0, count)),
        }
    }

    pub fn values(&self) -> Values<'_> {
        match self {
            Self::Reals(numbers) => Values::F64(numbers),
            Self::Wholes(numbers) => Values::I32(numbers),
        }
    }
}

/// The variables that the files of one whole have in a group, and how many numbers a row has of each.
#[derive(Clone, Debug)]
pub struct Layout {
    pub names: Vec<&'static str>,
    pub widths: Vec<usize>,
    whole: Vec<bool>,
    /// Real numbers of 32 bits.
    pub single: Vec<bool>,
}

impl Layout {
    /// Those of a group as a file has it; all are by row.
    ///
    /// # Errors
    /// Where it cannot be read.
    pub fn of(group: &StoredGroup<'_>, own: &'static schema::Group) -> Result<Self, StoredError> {
        let names: Vec<&'static str> = (own.variables.iter())
            .map(|v| v.name)
            .filter(|name| group.has(name))
            .collect();
        let mut this = Self {
            names,
            widths: Vec::new(),
            whole: Vec::new(),
            single: Vec::new(),
        };
        for name in &this.names {
            let column = group.column(name)?;
            this.widths.push(column.width());
            this.whole.push(column.whole);
            this.single.push(column.single);
        }
        Ok(this)
    }

    /// The place of a variable.
    pub fn place(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|own| *own == name)
    }

    /// Integers, one a row.
    pub fn of_integers(names: &[&'static str]) -> Self {
        Self {
            names: names.to_vec(),
            widths: vec![1; names.len()],
            whole: vec![true; names.len()],
            single: vec![false; names.len()],
        }
    }

    /// The variables that another group has too, and their places here.
    pub fn part_of(&self, other: &schema::Group) -> (Self, Vec<usize>) {
        let has = |name: &str| other.variables.iter().any(|v| v.name == name);
        let places: Vec<usize> = (0..self.names.len())
            .filter(|k| has(self.names[*k]))
            .collect();
        let part = Self {
            names: places.iter().map(|k| self.names[*k]).collect(),
            widths: places.iter().map(|k| self.widths[*k]).collect(),
            whole: places.iter().map(|k| self.whole[*k]).collect(),
            single: places.iter().map(|k| self.single[*k]).collect(),
        };
        (part, places)
    }

    fn empty(&self) -> Vec<Column> {
        (self.whole.iter())
            .map(|whole| match whole {
                true => Column::Wholes(Vec::new()),
                false => Column::Reals(Vec::new()),
            })
            .collect()
    }
}

/// The rows of a group, read one after the other; of each column only what is asked for.
pub struct Rows {
    columns: Vec<StoredColumn>,
    /// Of each column the rows in memory, and which these are.
    window: Vec<(Column, Range<usize>)>,
    /// How many are read at once, and in all.
    at_once: usize,
    pub count: usize,
    /// The present one.
    pub at: usize,
}

impl Rows {
    /// # Errors
    /// Where the group has not all variables of the layout, or some are shorter than others.
    pub fn new(
        group: &StoredGroup<'_>,
        layout: &Layout,
        at_once: usize,
    ) -> Result<Self, StoredError> {
        let columns = (layout.names.iter().enumerate())
            .map(|(k, name)| {
                let column = group.column(name)?;
                let own = (column.width(), column.whole, column.single);
                match own == (layout.widths[k], layout.whole[k], layout.single[k]) {
                    true => Ok(column),
                    false => Err(group.error(name, "not as the other files have it")),
                }
            })
            .collect::<Result<Vec<_>, _>>()?;
        let count = columns.first().map_or(0, |c| c.rows);
        for (column, name) in columns.iter().zip(&layout.names) {
            if column.rows != count {
                return Err(group.error(name, "not as long as the others of its group"));
            }
        }
        Ok(Self {
            window: layout.empty().into_iter().map(|c| (c, 0..0)).collect(),
            columns,
            at_once,
            count,
            at: 0,
        })
    }

    /// Goes to the next row.
    pub fn advance(&mut self) {
        self.at += 1;
    }

    /// A column in memory, and which of its numbers are the present row's.
    ///
    /// # Errors
    /// Where it cannot be read.
    fn here(&mut self, place: usize) -> Result<(&Column, Range<usize>), StoredError> {
        let (column, width) = (&self.columns[place], self.columns[place].width());
        if self.at >= self.count {
            return Err(column.error(format!(
                "it has {} rows, and the rest of the file tells of more",
                self.count
            )));
        }
        let (numbers, rows) = &mut self.window[place];
        if !rows.contains(&self.at) {
            let count = self.at_once.min(self.count.saturating_sub(self.at));
            match numbers {
                Column::Reals(numbers) => *numbers = column.f64(self.at, count)?,
                Column::Wholes(numbers) => *numbers = column.i32(self.at, count)?,
            }
            *rows = self.at..self.at + count;
        }
        let here = self.at - rows.start;
        Ok((numbers, here * width..(here + 1) * width))
    }

    /// The present row's integer of a column; 0 where the column has none.
    ///
    /// # Errors
    /// Where it cannot be read.
    pub fn whole(&mut self, place: usize) -> Result<i32, StoredError> {
        Ok(self.wholes(place)?.first().copied().unwrap_or(0))
    }

    /// The present row's numbers of a column of reals.
    ///
    /// # Errors
    /// Where they cannot be read.
    pub fn reals(&mut self, place: usize) -> Result<&[f64], StoredError> {
        Ok(match self.here(place)? {
            (Column::Reals(numbers), own) => &numbers[own],
            (Column::Wholes(_), _) => &[],
        })
    }

    /// The present row's integers of a column.
    ///
    /// # Errors
    /// Where they cannot be read.
    pub fn wholes(&mut self, place: usize) -> Result<&[i32], StoredError> {
        Ok(match self.here(place)? {
            (Column::Wholes(numbers), own) => &numbers[own],
            (Column::Reals(_), _) => &[],
        })
    }
}

/// Rows on their way into a group.
pub struct Sink {
    writer: GroupWriter,
    layout: Layout,
    columns: Vec<Column>,
    /// Of each column its place in the rows that are taken; nothing is taken without one.
    places: Vec<Option<usize>>,
    rows: usize,
    at_once: usize,
    /// Of a grid how many nodes there are for each value of its first axis; rows are appended else.
    slab: Option<usize>,
    written: usize,
}

impl Sink {
    /// Into rows that are appended, or nodes of a grid, so many at once.
    pub fn new(writer: GroupWriter, layout: Layout, at_once: usize, slab: Option<usize>) -> Self {
        Self {
            columns: layout.empty(),
            places: (0..layout.names.len()).map(Some).collect(),
            at_once: match slab {
                Some(slab) => at_once.div_ceil(slab.max(1)) * slab.max(1),
                None => at_once,
            },
            writer,
            layout,
            rows: 0,
            slab,
            written: 0,
        }
    }

    /// Takes its columns from others of the rows that come.
    #[must_use]
    pub fn taking(self, places: Vec<Option<usize>>) -> Self {
        Self { places, ..self }
    }

    /// Takes the present row of another group.
    ///
    /// # Errors
    /// Of reading.
    pub fn take(&mut self, rows: &mut Rows) -> Result<(), StoredError> {
        let columns = self.columns.iter_mut().zip(&self.places);
        for ((to, place), width) in columns.zip(&self.layout.widths) {
            let Some(place) = *place else {
                to.unknown(*width);
                continue;
            };
            match (to, rows.here(place)?) {
                (Column::Reals(to), (Column::Reals(from), own)) => to.extend_from_slice(&from[own]),
                (Column::Wholes(to), (Column::Wholes(from), own)) => {
                    to.extend_from_slice(&from[own]);
                }
                (to, _) => to.unknown(*width),
            }
        }
        self.rows += 1;
        Ok(())
    }

    /// A row of which nothing is known.
    pub fn nothing(&mut self) {
        for (to, width) in self.columns.iter_mut().zip(&self.layout.widths) {
            to.unknown(*width);
        }
        self.rows += 1;
    }

    /// Puts integers in place of those of the last row.
    pub fn set_wholes(&mut self, name: &str, value: i32) {
        if let Some(place) = self.layout.place(name)
            && let Column::Wholes(numbers) = &mut self.columns[place]
        {
            let width = self.layout.widths[place];
            let from = numbers.len() - width;
            numbers[from..].fill(value);
        }
    }

    /// The same with real numbers.
    pub fn set_reals(&mut self, name: &str, values: &[f64]) {
        if let Some(place) = self.layout.place(name)
            && let Column::Reals(numbers) = &mut self.columns[place]
        {
            let from = numbers.len() - values.len();
            numbers[from..].copy_from_slice(values);
        }
    }

    /// Puts NaN in place of real numbers of the last row.
    pub fn forget(&mut self, name: &str) {
        if let Some(place) = self.layout.place(name)
            && let Column::Reals(numbers) = &mut self.columns[place]
        {
            let from = numbers.len() - self.layout.widths[place];
            numbers[from..].fill(f64::NAN);
        }
    }

    /// Writes what there is once it is enough.
    ///
    /// # Errors
    /// Of writing.
    pub fn flush_if_full(&mut self) -> Result<(), OutputError> {
        match self.rows >= self.at_once {
            true => self.flush(),
            false => Ok(()),
        }
    }

    /// Writes what there is.
    ///
    /// # Errors
    /// Of writing.
    pub fn flush(&mut self) -> Result<(), OutputError> {
        match self.slab {
            None => {
                let block: Vec<(&str, Values<'_>)> = (self.layout.names.iter())
                    .zip(&self.columns)
                    .map(|(name, column)| (*name, column.values()))
                    .collect();
                self.writer.append(self.rows, &block)?;
            }
            Some(slab) if self.rows > 0 => {
                let first = self.written / slab;
                for (name, column) in self.layout.names.iter().zip(&self.columns) {
                    self.writer.write_from(name, first, column.values())?;
                }
            }
            Some(_) => {}
        }
        self.written += self.rows;
        self.rows = 0;
        self.columns.iter_mut().for_each(Column::clear);
        Ok(())
    }
}
