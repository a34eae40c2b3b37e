//! Events between the ends of steps: a condition that comes true and false again within a step.
//!
//! The conditions are looked at along a leg, at points several a step, and between these by cubic
//! Hermite interpolation of the values and rates there. What may have come true is flown to.

/// Points a step, and of a leg at least and at most.
const A_STEP: usize = 6;
const LEAST: usize = 12;
const MOST: usize = 3000;
/// Where interpolation has more than this share of the nearer end's value left, nothing comes true.
const SURE: f64 = 0.05;

/// At how many points a leg of so many steps is looked at: a power of two, so that batches are few.
pub(super) fn points(steps: u32) -> usize {
    (A_STEP * steps as usize)
        .clamp(LEAST, MOST)
        .next_power_of_two()
}

/// What is left of a condition at a time, and its rate.
#[derive(Clone, Copy, Debug)]
pub(super) struct Point {
    pub t: f64,
    pub left: f64,
    pub rate: f64,
}

/// The time between two points at which the interpolated condition is least, if it may be met there.
pub(super) fn suspect(a: Point, b: Point) -> Option<f64> {
    if b.left <= 0.0 {
        return Some(b.t);
    }
    if !(b.left.is_finite() && a.rate < 0.0 && b.rate > 0.0) {
        return None;
    }
    let h = b.t - a.t;
    // p(s) = a + b1 s + c s^2 + d s^3 on 0..1; p' has a root inside, from - to +.
    let (b1, b2) = (h * a.rate, h * b.rate);
    let c = 3.0 * (b.left - a.left) - 2.0 * b1 - b2;
    let d = b1 + b2 - 2.0 * (b.left - a.left);
    let discriminant = (c * c - 3.0 * d * b1).max(0.0);
    // The stable form of (-c + sqrt(c^2 - 3 d b1)) / (3 d).
    let s = (-b1 / (c + discriminant.sqrt())).clamp(0.0, 1.0);
    let least = a.left + s * (b1 + s * (c + s * d));
    (least <= SURE * a.left.min(b.left)).then_some(a.t + s * h)
}

/// About when a condition is met between a point before and one after that: the first root of the
/// interpolation.
pub(super) fn crossing(a: Point, b: Point) -> f64 {
    let h = b.t - a.t;
    let at = |s: f64| {
        let (b1, b2) = (h * a.rate, h * b.rate);
        let c = 3.0 * (b.left - a.left) - 2.0 * b1 - b2;
        let d = b1 + b2 - 2.0 * (b.left - a.left);
        a.left + s * (b1 + s * (c + s * d))
    };
    let (mut before, mut after) = (0.0, 1.0);
    for _ in 0..50 {
        let middle = 0.5 * (before + after);
        match at(middle) > 0.0 {
            true => before = middle,
            false => after = middle,
        }
    }
    a.t + before * h
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dip_between_two_points_is_suspected() {
        // (t - 0.4)^2 - depth on [0, 1].
        let point = |t: f64, depth: f64| Point {
            t,
            left: (t - 0.4) * (t - 0.4) - depth,
            rate: 2.0 * (t - 0.4),
        };
        let found = suspect(point(0.0, 1e-4), point(1.0, 1e-4)).unwrap();
        assert!((found - 0.4).abs() < 1e-12);
        assert!(suspect(point(0.0, -0.1), point(1.0, -0.1)).is_none());
        assert!(
            suspect(point(0.5, 1e-4), point(1.0, 1e-4)).is_none(),
            "it rises"
        );
        assert_eq!(suspect(point(0.0, 0.01), point(0.4, 0.01)), Some(0.4));
        let at = crossing(point(0.0, 0.01), point(0.4, 0.01));
        assert!((at - 0.3).abs() < 1e-12);
    }
}
