//! Hatching: where a map in pieces says itself that V may be off by more than the error it was
//! asked for.

use super::canvas::{Ink, Stroke};
use super::plane::Plane;
use super::source::Source;
use super::ticks::significant;

/// Lines across the width of a plane.
const LINES: usize = 48;
/// Points along a line, at which it is asked whether it goes on.
const STEPS: usize = 480;

pub fn stroke() -> Stroke {
    Stroke::new(Ink::Colour([20, 20, 20]), 0.8).opacity(0.55)
}

/// Whether V is known on a cell of the plane and its bound is above the error asked for at a
/// corner.
pub fn is_unmet(plane: &Plane, i: usize, j: usize) -> bool {
    let ny = plane.y.len();
    if plane.excess.is_empty() || i + 1 >= plane.x.len() || j + 1 >= ny {
        return false;
    }
    let corners = [
        i * ny + j,
        i * ny + j + 1,
        (i + 1) * ny + j,
        (i + 1) * ny + j + 1,
    ];
    corners.iter().all(|k| plane.v[*k].is_finite())
        && corners.iter().any(|k| plane.excess[*k] > 1.0)
}

/// Share of the cells with V that are hatched.
pub fn share(plane: &Plane) -> f64 {
    let (mut known, mut unmet) = (0usize, 0usize);
    let ny = plane.y.len();
    for i in 0..plane.x.len().saturating_sub(1) {
        for j in 0..ny.saturating_sub(1) {
            let corners = [
                i * ny + j,
                i * ny + j + 1,
                (i + 1) * ny + j,
                (i + 1) * ny + j + 1,
            ];
            known += usize::from(corners.iter().all(|k| plane.v[*k].is_finite()));
            unmet += usize::from(is_unmet(plane, i, j));
        }
    }
    unmet as f64 / known.max(1) as f64
}

/// Slanted lines over the hatched cells, in the plane's coordinates.
pub fn lines(plane: &Plane) -> Vec<Vec<[f64; 2]>> {
    let mut all = Vec::new();
    if plane.excess.is_empty() {
        return all;
    }
    // Coordinates from 0 to 1 along both axes.
    let at = |axis: &[f64], s: f64| axis[0] + s * (axis[axis.len() - 1] - axis[0]);
    let cell =
        |axis: &[f64], x: f64| axis.partition_point(|a| *a <= x).clamp(1, axis.len() - 1) - 1;
    for line in 1..2 * LINES {
        // Upward to the right, through (shift, 0).
        let shift = line as f64 / LINES as f64 - 1.0;
        let mut run: Vec<[f64; 2]> = Vec::new();
        for step in 0..=STEPS {
            let s = step as f64 / STEPS as f64;
            let (a, b) = (s, s - shift);
            let inside = (0.0..=1.0).contains(&b);
            let point = [at(&plane.x, a), at(&plane.y, b)];
            if inside && is_unmet(plane, cell(&plane.x, point[0]), cell(&plane.y, point[1])) {
                run.push(point);
            } else {
                close(&mut run, &mut all);
            }
        }
        close(&mut run, &mut all);
    }
    all
}

/// Keeps the ends of a run.
fn close(run: &mut Vec<[f64; 2]>, all: &mut Vec<Vec<[f64; 2]>>) {
    if let [first, .., last] = run.as_slice() {
        all.push(vec![*first, *last]);
    }
    run.clear();
}

/// What a caption says of the hatching; nothing where no error was asked for.
pub fn caption(source: &Source<'_>, plane: &Plane) -> String {
    let asked = source.model.map_aim.as_ref().map(|m| m.error);
    let (Some(asked), false) = (asked, plane.excess.is_empty()) else {
        return String::new();
    };
    match share(plane) {
        0.0 => format!(
            " By the map\u{2019}s own bound V is within the error asked for, {}, everywhere here.",
            significant(asked, 3)
        ),
        share => format!(
            " Hatched, {:.1} % of what is shown: the map\u{2019}s own bound of V\u{2019}s error is above the error asked for, {}.",
            100.0 * share,
            significant(asked, 3)
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn even(count: usize) -> Vec<f64> {
        (0..count)
            .map(|k| 2.0 * k as f64 / (count - 1) as f64)
            .collect()
    }

    /// V is known but for a corner, and the bound is too large to the right of x = 1.
    fn plane() -> Plane {
        let (x, y) = (even(41), even(31));
        let points = || x.iter().flat_map(|x| y.iter().map(move |y| (*x, *y)));
        let unknown = |x: f64, y: f64| x > 1.5 && y > 1.5;
        Plane {
            axes: [0, 1],
            v: points()
                .map(|(x, y)| if unknown(x, y) { f64::NAN } else { x + y })
                .collect(),
            u: Vec::new(),
            sheet: vec![0; 41 * 31],
            cut: Vec::new(),
            base: vec![0.0; 2],
            limit: f64::INFINITY,
            excess: points()
                .map(|(x, _)| if x > 1.0 { 3.0 } else { 0.5 })
                .collect(),
            x,
            y,
        }
    }

    #[test]
    fn only_what_is_known_and_not_good_enough_is_hatched() {
        let plane = plane();
        let lines = lines(&plane);
        assert!(lines.len() > LINES / 2);
        // A cell's width: one is hatched where a corner of it is not good enough.
        let cell = 0.05 + 1e-12;
        for [x, y] in lines.iter().flatten() {
            assert!(
                *x >= 1.0 - cell && (*x <= 1.5 + cell || *y <= 1.5 + 0.067),
                "{x} {y}"
            );
        }
        // Half of the plane but for its corner, of all but the corner.
        let share = share(&plane);
        assert!(
            (share - (1.0 - 0.125) / (2.0 - 0.125)).abs() < 0.03,
            "{share}"
        );
        let good = Plane {
            excess: vec![0.9; plane.v.len()],
            ..plane.clone()
        };
        assert!(super::lines(&good).is_empty() && super::share(&good) == 0.0);
        let unasked = Plane {
            excess: Vec::new(),
            ..plane
        };
        assert!(super::lines(&unasked).is_empty());
    }
}
