//! Small numerical tools that several rooms share: cubics, quantiles, random numbers, numbers as
//! text.

pub mod digits;
pub mod hermite;
pub mod quantile;
pub mod random;
