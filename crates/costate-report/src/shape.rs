//! Lines and polygons cut to a rectangle, and made of no more points than can be seen.

use super::canvas::{Point, Rect};

/// How far a line may be from its points, in pixels, when points are left out.
const TOLERANCE: f64 = 0.2;

/// The parts of a line within a rectangle (Liang & Barsky), few points each. Points that are not
/// finite part the line.
pub fn clipped(line: &[Point], area: Rect) -> Vec<Vec<Point>> {
    let mut parts: Vec<Vec<Point>> = Vec::new();
    let mut open = false;
    for pair in line.windows(2) {
        let Some((from, to)) = segment(pair[0], pair[1], area) else {
            open = false;
            continue;
        };
        match parts
            .last_mut()
            .filter(|part| open && part.last() == Some(&from))
        {
            Some(part) => part.push(to),
            None => parts.push(vec![from, to]),
        }
        open = to == pair[1];
    }
    parts.iter().map(|part| thinned(part)).collect()
}

fn segment(from: Point, to: Point, area: Rect) -> Option<(Point, Point)> {
    if from.iter().chain(&to).any(|v| !v.is_finite()) {
        return None;
    }
    let (mut enter, mut leave) = (0.0f64, 1.0f64);
    let along = [to[0] - from[0], to[1] - from[1]];
    for (k, low, high) in [(0, area.left, area.right), (1, area.top, area.bottom)] {
        if along[k] == 0.0 {
            if from[k] < low || from[k] > high {
                return None;
            }
            continue;
        }
        let (a, b) = ((low - from[k]) / along[k], (high - from[k]) / along[k]);
        enter = enter.max(a.min(b));
        leave = leave.min(a.max(b));
    }
    if enter > leave {
        return None;
    }
    let at = |s: f64| [from[0] + s * along[0], from[1] + s * along[1]];
    Some((
        if enter > 0.0 { at(enter) } else { from },
        if leave < 1.0 { at(leave) } else { to },
    ))
}

/// A polygon cut to a rectangle (Sutherland & Hodgman).
pub fn clipped_ring(ring: &[Point], area: Rect) -> Vec<Point> {
    let mut ring = ring.to_vec();
    let sides: [(usize, f64, bool); 4] = [
        (0, area.left, true),
        (0, area.right, false),
        (1, area.top, true),
        (1, area.bottom, false),
    ];
    for (k, bound, above) in sides {
        let inside = |p: &Point| if above { p[k] >= bound } else { p[k] <= bound };
        let before = std::mem::take(&mut ring);
        for i in 0..before.len() {
            let (a, b) = (before[i], before[(i + 1) % before.len()]);
            if inside(&a) {
                ring.push(a);
            }
            if inside(&a) != inside(&b) {
                let s = (bound - a[k]) / (b[k] - a[k]);
                ring.push([a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1])]);
            }
        }
    }
    ring
}

/// A line with fewer points (Douglas & Peucker), nowhere further than a fraction of a pixel from
/// the one given.
pub fn thinned(line: &[Point]) -> Vec<Point> {
    if line.len() < 3 {
        return line.to_vec();
    }
    let mut keep = vec![false; line.len()];
    (keep[0], keep[line.len() - 1]) = (true, true);
    let mut pending = vec![(0, line.len() - 1)];
    while let Some((first, last)) = pending.pop() {
        let far = (first + 1..last)
            .map(|k| (k, distance(line[k], line[first], line[last])))
            .max_by(|a, b| a.1.total_cmp(&b.1));
        if let Some((k, far)) = far
            && far > TOLERANCE
        {
            keep[k] = true;
            pending.extend([(first, k), (k, last)]);
        }
    }
    line.iter()
        .zip(keep)
        .filter(|(_, keep)| *keep)
        .map(|(p, _)| *p)
        .collect()
}

/// Distance of a point from a line between two.
fn distance(p: Point, a: Point, b: Point) -> f64 {
    let along = [b[0] - a[0], b[1] - a[1]];
    let from = [p[0] - a[0], p[1] - a[1]];
    let length = along[0] * along[0] + along[1] * along[1];
    let s = if length > 0.0 {
        ((from[0] * along[0] + from[1] * along[1]) / length).clamp(0.0, 1.0)
    } else {
        0.0
    };
    (from[0] - s * along[0]).hypot(from[1] - s * along[1])
}

#[cfg(test)]
mod tests {
    use super::*;

    const AREA: Rect = Rect {
        left: 0.0,
        top: 0.0,
        right: 10.0,
        bottom: 10.0,
    };

    #[test]
    fn lines_are_cut() {
        let parts = clipped(
            &[
                [-5.0, 5.0],
                [5.0, 5.0],
                [5.0, 15.0],
                [8.0, 15.0],
                [8.0, -5.0],
            ],
            AREA,
        );
        assert_eq!(
            parts,
            [
                vec![[0.0, 5.0], [5.0, 5.0], [5.0, 10.0]],
                vec![[8.0, 10.0], [8.0, 0.0]]
            ]
        );
        let parts = clipped(
            &[
                [1.0, 1.0],
                [2.0, 3.0],
                [f64::NAN, 2.0],
                [4.0, 4.0],
                [5.0, 4.0],
            ],
            AREA,
        );
        assert_eq!(parts.len(), 2);
        assert!(clipped(&[[-1.0, 0.0], [-1.0, 9.0]], AREA).is_empty());
    }

    #[test]
    fn polygons_are_cut() {
        let ring = clipped_ring(&[[-5.0, -5.0], [5.0, -5.0], [5.0, 5.0], [-5.0, 5.0]], AREA);
        assert_eq!(ring.len(), 4);
        assert!(ring.iter().all(|p| AREA.contains(*p)));
        assert!(clipped_ring(&[[-5.0, -5.0], [-1.0, -5.0], [-1.0, -2.0]], AREA).is_empty());
    }

    #[test]
    fn straight_parts_need_two_points() {
        let line: Vec<Point> = (0..100).map(|k| [f64::from(k), 3.0]).collect();
        assert_eq!(thinned(&line).len(), 2);
        let circle: Vec<Point> = (0..1000)
            .map(|k| f64::from(k) * 0.00628)
            .map(|a| [100.0 * a.cos(), 100.0 * a.sin()])
            .collect();
        let thin = thinned(&circle);
        assert!(thin.len() < 100, "{}", thin.len());
        for p in &circle {
            let near = thin
                .windows(2)
                .map(|w| distance(*p, w[0], w[1]))
                .fold(f64::INFINITY, f64::min);
            assert!(near <= TOLERANCE + 1e-12);
        }
    }
}
