//! Cubics between two points with values and slopes.

/// Cubic through two values and slopes (Hermite), at the share `q` of an interval of length `h`.
pub fn hermite(q: f64, h: f64, [a, da]: [f64; 2], [b, db]: [f64; 2]) -> f64 {
    let r = 1.0 - q;
    r * r * (1.0 + 2.0 * q) * a + q * q * (1.0 + 2.0 * r) * b + h * q * r * (r * da - q * db)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cubic_is_exact() {
        let f = |x: f64| x * x * x - 2.0 * x;
        let d = |x: f64| 3.0 * x * x - 2.0;
        let (a, h) = (-0.5, 1.7);
        for q in [0.0, 0.3, 0.9, 1.0] {
            let found = hermite(q, h, [f(a), d(a)], [f(a + h), d(a + h)]);
            assert!((found - f(a + q * h)).abs() < 1e-12);
        }
    }
}
