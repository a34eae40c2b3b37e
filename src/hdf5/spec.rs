//! The declaration of a group: its dimensions, its variables, what they mean.

use std::collections::BTreeSet;

use super::elsewhere::Elsewhere;
use super::{AttributeValue, OutputError};

/// How the chunks of numeric variables are stored.
///
/// Trajectories in f64 shrink by about a fifth at level 1, at a tenth of the plain writing speed
/// (60 against 600 MB/s on one core), hardly more at higher levels and slower still. Coarse values
/// and long runs of NaN shrink well.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Compression {
    /// As they are, which is fastest.
    None,
    /// As they are, within zlib streams for their checksums: half as fast.
    #[default]
    Checked,
    /// Bytes regrouped by significance, then deflated at a level from 1 (fast) to 9 (small).
    ShuffleDeflate(u8),
}

/// The values along a dimension.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Coordinate {
    Index { length: usize },
    Unlimited,
    Names(Vec<String>),
    Values { values: Vec<f64>, unit: String },
}

/// A dimension of a group, with the coordinate variable of the same name.
#[derive(Clone, Debug, PartialEq)]
pub struct Dimension {
    pub(super) name: String,
    pub(super) long_name: String,
    pub(super) coordinate: Coordinate,
}

impl Dimension {
    fn new(name: &str, long_name: String, coordinate: Coordinate) -> Self {
        Self {
            name: name.to_owned(),
            long_name,
            coordinate,
        }
    }

    /// A dimension of fixed length whose coordinate counts from 0.
    #[must_use]
    pub fn index(name: &str, length: usize) -> Self {
        Self::new(name, format!("{name} index"), Coordinate::Index { length })
    }

    /// The dimension along which blocks are appended, its coordinate counting from 0. It comes
    /// first in every variable that has it, and a group has at most one.
    #[must_use]
    pub fn unlimited(name: &str) -> Self {
        Self::new(name, format!("{name} index"), Coordinate::Unlimited)
    }

    /// A dimension with a name for each index.
    #[must_use]
    pub fn names<S: Into<String>>(name: &str, names: impl IntoIterator<Item = S>) -> Self {
        let names = names.into_iter().map(Into::into).collect();
        Self::new(name, format!("{name} name"), Coordinate::Names(names))
    }

    /// A dimension with a number for each index, in `unit`: the axis of a grid.
    #[must_use]
    pub fn values(name: &str, values: Vec<f64>, unit: &str) -> Self {
        let coordinate = Coordinate::Values {
            values,
            unit: unit.to_owned(),
        };
        Self::new(name, name.to_owned(), coordinate)
    }

    /// Says what the coordinate is, in words.
    #[must_use]
    pub fn long_name(mut self, long_name: &str) -> Self {
        self.long_name = long_name.to_owned();
        self
    }

    /// Its name, which the coordinate variable has too.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The length, `None` when it grows.
    pub(crate) fn length(&self) -> Option<usize> {
        match &self.coordinate {
            Coordinate::Index { length } => Some(*length),
            Coordinate::Unlimited => None,
            Coordinate::Names(names) => Some(names.len()),
            Coordinate::Values { values, .. } => Some(values.len()),
        }
    }
}

/// What a variable stores.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Storage {
    F64,
    F32,
    I32,
    Text(Vec<String>),
}

/// A variable of a group.
#[derive(Clone, Debug, PartialEq)]
pub struct Variable {
    pub(super) name: String,
    pub(super) dimensions: Vec<String>,
    pub(super) storage: Storage,
    pub(super) unit: String,
    pub(super) long_name: String,
    pub(super) attributes: Vec<(String, AttributeValue)>,
    /// Where its numbers lie, if not here.
    pub(super) elsewhere: Option<Elsewhere>,
}

impl Variable {
    fn new<'d>(name: &str, dims: impl IntoIterator<Item = &'d str>, storage: Storage) -> Self {
        Self {
            name: name.to_owned(),
            dimensions: dims.into_iter().map(str::to_owned).collect(),
            storage,
            unit: "1".to_owned(),
            long_name: name.to_owned(),
            attributes: Vec::new(),
            elsewhere: None,
        }
    }

    /// Floating-point values over `dims`, slowest first; NaN, the fill value, is 'no value'. No
    /// dimension makes a scalar.
    #[must_use]
    pub fn f64<'d>(name: &str, dims: impl IntoIterator<Item = &'d str>) -> Self {
        Self::new(name, dims, Storage::F64)
    }

    /// The same, stored in half of the bytes: what is written to it is rounded to f32.
    #[must_use]
    pub fn f32<'d>(name: &str, dims: impl IntoIterator<Item = &'d str>) -> Self {
        Self::new(name, dims, Storage::F32)
    }

    /// Integers (counts, codes) over `dims`, slowest first.
    #[must_use]
    pub fn i32<'d>(name: &str, dims: impl IntoIterator<Item = &'d str>) -> Self {
        Self::new(name, dims, Storage::I32)
    }

    /// One text for each index of the fixed dimension `dimension`. They are written with the
    /// declaration.
    #[must_use]
    pub fn text<S: Into<String>>(
        name: &str,
        dimension: &str,
        values: impl IntoIterator<Item = S>,
    ) -> Self {
        let values = values.into_iter().map(Into::into).collect();
        Self::new(name, [dimension], Storage::Text(values))
    }

    /// The unit; `"1"` unless told otherwise.
    #[must_use]
    pub fn unit(mut self, unit: &str) -> Self {
        self.unit = unit.to_owned();
        self
    }

    /// Says what the variable is, in words; its name unless told otherwise.
    #[must_use]
    pub fn long_name(mut self, long_name: &str) -> Self {
        self.long_name = long_name.to_owned();
        self
    }

    /// The codes an integer variable takes and their meanings. A meaning's blanks become
    /// underscores, for `flag_meanings` is a blank-separated list.
    #[must_use]
    pub fn flags<S: AsRef<str>>(self, flags: impl IntoIterator<Item = (i32, S)>) -> Self {
        let (values, meanings): (Vec<i32>, Vec<String>) = flags
            .into_iter()
            .map(|(value, meaning)| {
                let words: Vec<&str> = meaning.as_ref().split_whitespace().collect();
                (value, words.join("_"))
            })
            .unzip();
        self.attribute("flag_values", values)
            .attribute("flag_meanings", meanings.join(" "))
    }

    /// One more attribute.
    #[must_use]
    pub fn attribute(mut self, name: &str, value: impl Into<AttributeValue>) -> Self {
        self.attributes.push((name.to_owned(), value.into()));
        self
    }
}

/// A group to be made by [`ResultFile::group`](super::ResultFile::group).
#[derive(Clone, Debug, PartialEq)]
pub struct Group {
    pub(super) name: String,
    pub(super) dimensions: Vec<Dimension>,
    pub(super) variables: Vec<Variable>,
    pub(super) attributes: Vec<(String, AttributeValue)>,
    pub(super) compression: Compression,
    pub(super) expected_rows: Option<usize>,
}

impl Group {
    /// An empty declaration of the group `/name`.
    #[must_use]
    pub fn new(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            dimensions: Vec::new(),
            variables: Vec::new(),
            attributes: Vec::new(),
            compression: Compression::default(),
            expected_rows: None,
        }
    }

    /// Adds a dimension.
    #[must_use]
    pub fn dimension(mut self, dimension: Dimension) -> Self {
        self.dimensions.push(dimension);
        self
    }

    /// Adds a variable.
    #[must_use]
    pub fn variable(mut self, variable: Variable) -> Self {
        self.variables.push(variable);
        self
    }

    /// Adds an attribute of the group itself.
    #[must_use]
    pub fn attribute(mut self, name: &str, value: impl Into<AttributeValue>) -> Self {
        self.attributes.push((name.to_owned(), value.into()));
        self
    }

    /// How the variables are stored.
    #[must_use]
    pub fn compression(mut self, compression: Compression) -> Self {
        self.compression = compression;
        self
    }

    /// About how many rows will be appended, if known: a small group then gets small chunks. More
    /// or fewer may come.
    #[must_use]
    pub fn expected_rows(mut self, rows: Option<usize>) -> Self {
        self.expected_rows = rows;
        self
    }

    /// The dimension a variable names.
    pub(crate) fn find_dimension(&self, name: &str) -> Option<&Dimension> {
        self.dimensions.iter().find(|d| d.name == name)
    }

    /// Refuses what no file can hold, before anything is written.
    pub(crate) fn check(&self) -> Result<(), OutputError> {
        check_name(&self.name, &self.name)?;
        let mut names = BTreeSet::new();
        let mut growing = None;
        for dimension in &self.dimensions {
            self.check_unique(&mut names, &dimension.name)?;
            match dimension.length() {
                Some(0) => {
                    return Err(OutputError::EmptyDimension {
                        group: self.name.clone(),
                        dimension: dimension.name.clone(),
                    });
                }
                None if growing.replace(&dimension.name).is_some() => {
                    return Err(self.growing_error(&dimension.name));
                }
                _ => {}
            }
        }
        for variable in &self.variables {
            self.check_unique(&mut names, &variable.name)?;
            self.check_variable(variable)?;
        }
        Ok(())
    }

    fn check_unique<'n>(
        &self,
        names: &mut BTreeSet<&'n str>,
        name: &'n str,
    ) -> Result<(), OutputError> {
        check_name(&self.name, name)?;
        if names.insert(name) {
            Ok(())
        } else {
            Err(OutputError::Duplicate {
                group: self.name.clone(),
                name: name.to_owned(),
            })
        }
    }

    fn check_variable(&self, variable: &Variable) -> Result<(), OutputError> {
        for (position, name) in variable.dimensions.iter().enumerate() {
            let Some(dimension) = self.find_dimension(name) else {
                return Err(OutputError::UnknownDimension {
                    group: self.name.clone(),
                    variable: variable.name.clone(),
                    dimension: name.clone(),
                });
            };
            let is_text = matches!(variable.storage, Storage::Text(_));
            if dimension.length().is_none() && (position > 0 || is_text) {
                return Err(self.growing_error(name));
            }
            if let (Storage::Text(texts), Some(expected)) = (&variable.storage, dimension.length())
                && texts.len() != expected
            {
                return Err(OutputError::Length {
                    group: self.name.clone(),
                    variable: variable.name.clone(),
                    expected,
                    found: texts.len(),
                });
            }
        }
        Ok(())
    }

    fn growing_error(&self, dimension: &str) -> OutputError {
        OutputError::GrowingDimension {
            group: self.name.clone(),
            dimension: dimension.to_owned(),
        }
    }
}

fn check_name(group: &str, name: &str) -> Result<(), OutputError> {
    if name.is_empty() || name == "." || name.contains(['/', '\0']) {
        return Err(OutputError::InvalidName {
            group: group.to_owned(),
            name: name.to_owned(),
        });
    }
    Ok(())
}
