//! Attributes of the root, of a group and of a variable.

use rust_hdf5::types::VarLenUnicode;
use rust_hdf5::{H5Dataset, H5File, H5Group, Hdf5Error};

/// The value of an attribute.
#[derive(Clone, Debug, PartialEq)]
pub enum AttributeValue {
    /// UTF-8 text of any length.
    Text(String),
    /// A 64-bit float.
    F64(f64),
    /// A 64-bit integer.
    I64(i64),
    /// A list of 32-bit integers.
    I32List(Vec<i32>),
}

impl From<&str> for AttributeValue {
    fn from(value: &str) -> Self {
        Self::Text(value.to_owned())
    }
}

impl From<String> for AttributeValue {
    fn from(value: String) -> Self {
        Self::Text(value)
    }
}

impl From<f64> for AttributeValue {
    fn from(value: f64) -> Self {
        Self::F64(value)
    }
}

impl From<i64> for AttributeValue {
    fn from(value: i64) -> Self {
        Self::I64(value)
    }
}

impl From<Vec<i32>> for AttributeValue {
    fn from(values: Vec<i32>) -> Self {
        Self::I32List(values)
    }
}

/// Anything of an HDF5 file that holds attributes.
pub(super) trait AttributeOwner {
    fn set(&self, name: &str, value: &AttributeValue) -> Result<(), Hdf5Error>;
}

impl AttributeOwner for H5File {
    fn set(&self, name: &str, value: &AttributeValue) -> Result<(), Hdf5Error> {
        match value {
            AttributeValue::Text(text) => self.set_attr_string(name, text),
            AttributeValue::F64(number) => self.set_attr_numeric(name, number),
            AttributeValue::I64(number) => self.set_attr_numeric(name, number),
            AttributeValue::I32List(list) => self.set_attr_array_numeric(name, list),
        }
    }
}

impl AttributeOwner for H5Group {
    fn set(&self, name: &str, value: &AttributeValue) -> Result<(), Hdf5Error> {
        match value {
            AttributeValue::Text(text) => self.set_attr_string(name, text),
            AttributeValue::F64(number) => self.set_attr_numeric(name, number),
            AttributeValue::I64(number) => self.set_attr_numeric(name, number),
            AttributeValue::I32List(list) => self.set_attr_array_numeric(name, list),
        }
    }
}

impl AttributeOwner for H5Dataset {
    fn set(&self, name: &str, value: &AttributeValue) -> Result<(), Hdf5Error> {
        match value {
            AttributeValue::Text(text) => self
                .new_attr::<VarLenUnicode>()
                .shape(())
                .create(name)?
                .write_string(text),
            AttributeValue::F64(number) => self
                .new_attr::<f64>()
                .shape(())
                .create(name)?
                .write_numeric(number),
            AttributeValue::I64(number) => self
                .new_attr::<i64>()
                .shape(())
                .create(name)?
                .write_numeric(number),
            AttributeValue::I32List(list) => self
                .new_attr::<i32>()
                .shape([list.len()])
                .create(name)?
                .write_array(list),
        }
    }
}
