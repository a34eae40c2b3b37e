//! Small numerical tools that several rooms share: quantiles, random numbers, numbers as text.

pub mod digits;
pub mod quantile;
pub mod random;
