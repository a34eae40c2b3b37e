//! Choosing among variants: which are worth having, and which to take for a wanted error.

/// Which points are not beaten in both coordinates (less is better). Points that are not finite are
/// never chosen; of equal ones all are.
pub fn front(points: &[(f64, f64)]) -> Vec<bool> {
    let mut order: Vec<usize> = (0..points.len())
        .filter(|i| points[*i].0.is_finite() && points[*i].1.is_finite())
        .collect();
    order.sort_by(|a, b| {
        let ((s, e), (t, f)) = (points[*a], points[*b]);
        s.total_cmp(&t).then(e.total_cmp(&f))
    });
    let mut chosen = vec![false; points.len()];
    let mut best: Option<(f64, f64)> = None;
    for i in order {
        let point = points[i];
        if best.is_none_or(|b| point.1 < b.1 || point == b) {
            chosen[i] = true;
            best = Some(point);
        }
    }
    chosen
}

/// Times closer together than this factor are as good as equal: the next run may order them
/// otherwise.
const NOISE: f64 = 1.1;

/// The fastest of `(seconds, error)` with an error of at most `wanted`; of those about as fast the
/// most accurate.
pub fn fastest(points: impl IntoIterator<Item = (f64, f64)>, wanted: f64) -> Option<usize> {
    let good: Vec<(usize, (f64, f64))> = (points.into_iter().enumerate())
        .filter(|(_, (seconds, error))| *error <= wanted && seconds.is_finite())
        .collect();
    let least = good.iter().map(|(_, p)| p.0).fold(f64::INFINITY, f64::min);
    (good.iter())
        .filter(|(_, p)| p.0 <= NOISE * least)
        .min_by(|(_, a), (_, b)| a.1.total_cmp(&b.1))
        .map(|(i, _)| *i)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_front_is_what_nothing_beats() {
        let nan = f64::NAN;
        let points = [
            (1.0, 1e-2),
            (2.0, 1e-4),
            (2.0, 1e-3),
            (3.0, 1e-4),
            (4.0, 1e-6),
            (0.5, nan),
            (nan, 0.0),
        ];
        assert_eq!(
            front(&points),
            [true, true, false, false, true, false, false]
        );
        // A twin is as good.
        assert_eq!(front(&[(1.0, 1.0), (1.0, 1.0)]), [true, true]);
        assert!(front(&[]).is_empty());
    }

    /// The definition, over a grid with many ties.
    #[test]
    fn the_front_agrees_with_its_definition() {
        let points: Vec<(f64, f64)> = (0..97u32)
            .map(|k| (f64::from(k * 37 % 11), f64::from(k * 53 % 13)))
            .collect();
        let beaten = |p: &(f64, f64)| points.iter().any(|q| q.0 <= p.0 && q.1 <= p.1 && q != p);
        let expected: Vec<bool> = points.iter().map(|p| !beaten(p)).collect();
        assert_eq!(front(&points), expected);
        assert!(expected.contains(&true) && expected.contains(&false));
    }

    #[test]
    fn the_fastest_that_is_good_enough() {
        let points = [(1.0, 1e-2), (2.0, 1e-5), (1.5, 1e-6), (0.1, f64::NAN)];
        assert_eq!(fastest(points, 1e-1), Some(0));
        assert_eq!(fastest(points, 1e-3), Some(2));
        assert_eq!(fastest(points, 1e-6), Some(2));
        assert_eq!(fastest(points, 1e-9), None);
        // One that is hardly slower and more accurate is taken.
        assert_eq!(fastest([(1.0, 1e-4), (1.05, 1e-7)], 1e-3), Some(1));
    }
}
