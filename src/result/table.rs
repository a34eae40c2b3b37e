//! Columns that become a group of the file, declared as the [schema](crate::schema) has it.

use super::TrajectorySchema;
use super::names::{Names, with_axes};
use crate::hdf5::{
    AttributeValue, Compression, Dimension, Group, OutputError, ResultFile, Values, Variable,
};
use crate::schema::{self, Along, Kind, STATE_AXES, When};
use std::borrow::Cow;

/// The contents of a column.
#[derive(Debug)]
pub enum Data<'d> {
    F64(Cow<'d, [f64]>),
    I32(Cow<'d, [i32]>),
    Text(Vec<String>),
    /// Numbers that are appended later.
    Later,
    /// Real numbers that are appended later and stored in f32.
    LaterInSingle,
}

impl From<Vec<f64>> for Data<'_> {
    fn from(values: Vec<f64>) -> Self {
        Self::F64(values.into())
    }
}

impl<'d> From<&'d [f64]> for Data<'d> {
    fn from(values: &'d [f64]) -> Self {
        Self::F64(values.into())
    }
}

impl<'d> From<&'d Vec<f64>> for Data<'d> {
    fn from(values: &'d Vec<f64>) -> Self {
        Self::F64(values.into())
    }
}

impl From<f64> for Data<'_> {
    fn from(value: f64) -> Self {
        Self::F64(vec![value].into())
    }
}

impl From<Vec<i32>> for Data<'_> {
    fn from(values: Vec<i32>) -> Self {
        Self::I32(values.into())
    }
}

impl<'d> From<&'d Vec<i32>> for Data<'d> {
    fn from(values: &'d Vec<i32>) -> Self {
        Self::I32(values.into())
    }
}

impl From<i32> for Data<'_> {
    fn from(value: i32) -> Self {
        Self::I32(vec![value].into())
    }
}

impl From<Vec<String>> for Data<'_> {
    fn from(values: Vec<String>) -> Self {
        Self::Text(values)
    }
}

/// A variable of the schema with the name and the description that it has in this file.
struct Column<'t> {
    of: &'static schema::Variable,
    name: String,
    meaning: Option<String>,
    /// Where it is not the schema's.
    unit: Option<String>,
    flags: Vec<(i32, String)>,
    data: Data<'t>,
}

/// A group on its way into a file: what is put into it must be in its schema, and it must have
/// everything that the schema always has.
pub struct Table<'t> {
    schema: &'static schema::Group,
    names: Names<'t>,
    title: Option<&'t str>,
    /// Those of dimensions that the scene does not give.
    dimensions: Vec<(&'static str, Dimension)>,
    /// The axes that `<state>` stands for.
    grid: Vec<Dimension>,
    /// The dimension that another name in angle brackets stands for.
    alias: Option<(&'static str, &'static str)>,
    columns: Vec<Column<'t>>,
    attributes: Vec<(String, AttributeValue)>,
    rows: Option<usize>,
    compression: Compression,
    /// Whether variables that the schema always has may be missing.
    partial: bool,
    /// What is in the table but not in its schema.
    unknown: Option<String>,
}

impl<'t> Table<'t> {
    #[must_use]
    pub fn new(schema: &'static schema::Group, axes: &'t TrajectorySchema) -> Self {
        Self {
            schema,
            names: Names::new(axes),
            title: None,
            dimensions: Vec::new(),
            grid: Vec::new(),
            alias: None,
            columns: Vec::new(),
            attributes: Vec::new(),
            rows: None,
            compression: Compression::default(),
            partial: false,
            unknown: None,
        }
    }

    /// Another title than the schema's.
    #[must_use]
    pub fn title(mut self, title: &'t str) -> Self {
        self.title = Some(title);
        self
    }

    #[must_use]
    pub fn compression(mut self, compression: Compression) -> Self {
        self.compression = compression;
        self
    }

    /// Leaves out variables that the schema always has: those that are not put.
    #[must_use]
    pub fn partial(mut self) -> Self {
        self.partial = true;
        self
    }

    /// The length of a dimension; of one whose rows are appended about how many, if known.
    #[must_use]
    pub fn length(mut self, name: &'static str, length: impl Into<Option<usize>>) -> Self {
        let length = length.into();
        let dimension = match (self.along(name), length) {
            (Some(Along::Rows), rows) => {
                self.rows = rows;
                Dimension::unlimited(name)
            }
            (_, length) => Dimension::index(name, length.unwrap_or(0)),
        };
        self.dimension(name, dimension)
    }

    /// The names along a dimension.
    #[must_use]
    pub fn labels<S: Into<String>>(
        self,
        name: &'static str,
        labels: impl IntoIterator<Item = S>,
    ) -> Self {
        self.dimension(name, Dimension::names(name, labels))
    }

    /// The numbers along a dimension without a unit.
    #[must_use]
    pub fn numbers(self, name: &'static str, values: Vec<f64>) -> Self {
        self.dimension(name, Dimension::values(name, values, "1"))
    }

    fn dimension(mut self, name: &'static str, dimension: Dimension) -> Self {
        let Some(own) = self.schema.dimensions.iter().find(|d| d.name == name) else {
            self.unknown = Some(name.to_owned());
            return self;
        };
        let dimension = dimension.long_name(own.meaning);
        self.dimensions.push((name, dimension));
        self
    }

    /// The axes of a grid of states: values for each state, and for the time of that name.
    #[must_use]
    pub fn grid(mut self, axes: &[Vec<f64>], time: Option<&str>) -> Self {
        let schema = self.names.axes();
        let states = schema.states.iter().zip(axes).map(|(axis, values)| {
            Dimension::values(&axis.name, values.clone(), axis.unit()).long_name(axis.description())
        });
        let mut grid: Vec<Dimension> = states.collect();
        if let (Some(time), Some(values)) = (time, axes.get(schema.states.len())) {
            let axis = Dimension::values(time, values.clone(), schema.time());
            grid.push(axis.long_name("time"));
        }
        self.grid = grid;
        self
    }

    /// The dimension of the group that a name in angle brackets stands for.
    #[must_use]
    pub fn stands_for(mut self, open: &'static str, name: &'static str) -> Self {
        self.alias = Some((open, name));
        self
    }

    fn along(&self, name: &str) -> Option<Along> {
        let found = self.schema.dimensions.iter().find(|d| d.name == name);
        found.map(|d| d.along)
    }

    /// Adds a column.
    pub fn put(&mut self, name: &'static str, data: impl Into<Data<'t>>) -> &mut Self {
        self.push(name, name, None, Vec::new(), data.into())
    }

    /// Adds a column of codes, each with its meaning.
    pub fn put_codes<S: Into<String>>(
        &mut self,
        name: &'static str,
        flags: impl IntoIterator<Item = (i32, S)>,
        data: impl Into<Data<'t>>,
    ) -> &mut Self {
        let flags = flags
            .into_iter()
            .map(|(code, s)| (code, s.into()))
            .collect();
        self.push(name, name, None, flags, data.into())
    }

    /// Adds a column whose name the scene gives: `open` is what stands for it in the schema.
    pub fn put_named(
        &mut self,
        open: &'static str,
        name: &str,
        meaning: Option<&str>,
        data: impl Into<Data<'t>>,
    ) -> &mut Self {
        self.push(open, name, meaning, Vec::new(), data.into())
    }

    /// Adds a column in a unit that follows from what is in it.
    pub fn put_in(
        &mut self,
        name: &'static str,
        unit: String,
        data: impl Into<Data<'t>>,
    ) -> &mut Self {
        self.put(name, data);
        if let Some(column) = self.columns.last_mut() {
            column.unit = Some(unit);
        }
        self
    }

    fn push(
        &mut self,
        own: &'static str,
        name: &str,
        meaning: Option<&str>,
        flags: Vec<(i32, String)>,
        data: Data<'t>,
    ) -> &mut Self {
        match self.schema.variables.iter().find(|v| v.name == own) {
            None => self.unknown = Some(own.to_owned()),
            Some(of) => self.columns.push(Column {
                of,
                name: name.to_owned(),
                meaning: meaning.map(str::to_owned),
                unit: None,
                flags,
                data,
            }),
        }
        self
    }

    /// Sets an attribute of the group.
    pub fn attribute(&mut self, name: &str, value: impl Into<AttributeValue>) -> &mut Self {
        if !self.schema.attributes.iter().any(|(own, _)| *own == name) {
            self.unknown = Some(name.to_owned());
        }
        self.attributes.push((name.to_owned(), value.into()));
        self
    }

    /// The declaration.
    ///
    /// # Errors
    /// [`OutputError::NotInSchema`] and [`OutputError::MissingVariable`], mistakes of the program.
    pub fn declare(&self) -> Result<Group, OutputError> {
        let group = self.schema.name;
        if let Some(name) = &self.unknown {
            return Err(OutputError::NotInSchema {
                group: group.to_owned(),
                name: name.clone(),
            });
        }
        let (controls, disturbances) = self.names.has();
        for own in self.schema.variables.iter().filter(|v| !v.is_open()) {
            let due = match own.when {
                When::Always => true,
                When::Controls => controls,
                When::Disturbances => disturbances,
                When::With(_) => false,
            };
            if due && !self.partial && !self.columns.iter().any(|c| c.of.name == own.name) {
                return Err(OutputError::MissingVariable {
                    group: group.to_owned(),
                    variable: own.name.to_owned(),
                });
            }
        }

        let mut made = Group::new(group)
            .attribute("title", self.title.unwrap_or(self.schema.title))
            .compression(self.compression)
            .expected_rows(self.rows);
        for (name, value) in &self.attributes {
            made = made.attribute(name, value.clone());
        }
        let axes = self.names.axes();
        for own in self.schema.dimensions {
            made = match own.along {
                Along::States => {
                    let made = with_axes(made, "state", &axes.states);
                    made.variable(self.names.costate_units())
                }
                Along::Controls => with_axes(made, "control", &axes.controls),
                Along::Disturbances => with_axes(made, "disturbance", &axes.disturbances),
                Along::StateAxes => (self.grid.iter().cloned()).fold(made, Group::dimension),
                _ => match self.dimensions.iter().find(|(name, _)| *name == own.name) {
                    Some((_, dimension)) => made.dimension(dimension.clone()),
                    None => made,
                },
            };
        }
        for column in &self.columns {
            made = made.variable(self.variable(column));
        }
        Ok(made)
    }

    fn variable(&self, column: &Column<'_>) -> Variable {
        let own = column.of;
        let mut over: Vec<&str> = Vec::new();
        for name in own.dimensions {
            match self.alias {
                _ if *name == STATE_AXES.name => over.extend(self.grid.iter().map(Dimension::name)),
                Some((open, own)) if *name == open => over.push(own),
                _ => over.push(name),
            }
        }
        let variable = match (&column.data, own.kind) {
            (Data::Text(texts), _) => Variable::text(
                &column.name,
                over.first().copied().unwrap_or(""),
                texts.clone(),
            ),
            (Data::LaterInSingle, Kind::Real) => Variable::f32(&column.name, over),
            (_, Kind::Real | Kind::Text) => Variable::f64(&column.name, over),
            (_, Kind::Integer | Kind::Code) => Variable::i32(&column.name, over),
        };
        let meaning = column.meaning.as_deref().unwrap_or(own.meaning);
        let unit = self.names.unit(own.unit);
        let unit = column.unit.as_deref().unwrap_or(&unit);
        let variable = variable.unit(unit).long_name(meaning);
        match own.kind {
            Kind::Code => variable.flags(column.flags.iter().map(|(code, s)| (*code, s))),
            _ => variable,
        }
    }

    /// Writes the whole group.
    ///
    /// # Errors
    /// Those of [`declare`](Self::declare), and what writing gives.
    pub fn write(&self, file: &mut ResultFile) -> Result<(), OutputError> {
        let mut writer = file.group(&self.declare()?)?;
        let columns = self.columns.iter().filter_map(|c| {
            let values = match &c.data {
                Data::F64(values) => Values::F64(values),
                Data::I32(values) => Values::I32(values),
                Data::Text(_) | Data::Later | Data::LaterInSingle => return None,
            };
            Some((c.name.as_str(), values))
        });
        match self
            .schema
            .dimensions
            .iter()
            .any(|d| d.along == Along::Rows)
        {
            true => writer.append(self.rows.unwrap_or(0), &columns.collect::<Vec<_>>()),
            false => {
                for (name, values) in columns {
                    writer.write(name, values)?;
                }
                Ok(())
            }
        }
    }
}

impl std::fmt::Debug for Table<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Table")
            .field("group", &self.schema.name)
            .finish_non_exhaustive()
    }
}

/// No axes: for groups that have nothing of a scene.
pub(super) static NO_AXES: std::sync::LazyLock<TrajectorySchema> =
    std::sync::LazyLock::new(TrajectorySchema::default);
