//! Small numerical tools that several rooms share: cubics, a few linear equations, quantiles,
//! random numbers, numbers as text.

pub mod dense;
pub mod digits;
pub mod hermite;
pub mod quantile;
pub mod random;

/// The smaller one; not a number where either is not. As compiled kernels compute it.
#[must_use]
pub fn least(a: f64, b: f64) -> f64 {
    if a.is_nan() || a < b { a } else { b }
}

/// The larger one; not a number where either is not. As compiled kernels compute it.
#[must_use]
pub fn greatest(a: f64, b: f64) -> f64 {
    if a.is_nan() || b < a { a } else { b }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_number_stays_none() {
        for (a, b) in [(f64::NAN, 1.0), (1.0, f64::NAN), (f64::NAN, f64::NAN)] {
            assert!(least(a, b).is_nan() && greatest(a, b).is_nan());
        }
        assert_eq!((least(1.0, 2.0), greatest(1.0, 2.0)), (1.0, 2.0));
        assert_eq!((least(2.0, 1.0), greatest(2.0, 1.0)), (1.0, 2.0));
    }
}
