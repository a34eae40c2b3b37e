//! Sets of initial states on a grid of two axes: their areas and contours.
//!
//! Each cell is cut into four triangles about its centre (whose level is the corners' mean), in
//! each of which the level is interpolated linearly: no cell is ambiguous, and the area is of the
//! second order in the spacing. Where a corner has no level the triangle of the other three is
//! left; with two of them missing, nothing.

use rustc_hash::FxHashMap;

/// A polyline; a closed one ends where it begins.
pub type Line = Vec<[f64; 2]>;

/// A corner of a triangle: the grid's nodes, then the centres of cells.
#[derive(Clone, Copy)]
struct Corner {
    id: usize,
    at: [f64; 2],
    level: f64,
}

/// Area, in the axes' units, of the part of a grid where a level is not negative. `levels` has the
/// last axis fastest; NaN: no level.
pub fn area(axes: [&[f64]; 2], levels: &[f64]) -> f64 {
    let mut total = 0.0;
    triangles(axes, levels, &mut |corners| {
        // Sutherland-Hodgman with the line level = 0.
        let mut inside: Vec<[f64; 2]> = Vec::with_capacity(4);
        for (a, b) in [(0, 1), (1, 2), (2, 0)] {
            let (a, b) = (corners[a], corners[b]);
            if a.level >= 0.0 {
                inside.push(a.at);
            }
            if (a.level >= 0.0) != (b.level >= 0.0) {
                inside.push(cut(a, b));
            }
        }
        let cross = |p: [f64; 2], q: [f64; 2]| p[0] * q[1] - p[1] * q[0];
        let twice: f64 = (0..inside.len())
            .map(|k| cross(inside[k], inside[(k + 1) % inside.len()]))
            .sum();
        total += 0.5 * twice.abs();
    });
    total
}

/// The lines on which a level is 0.
pub fn contour(axes: [&[f64]; 2], levels: &[f64]) -> Vec<Line> {
    // Each piece ends on two edges of triangles, an edge in at most two pieces.
    type Edge = (usize, usize);
    let mut at: FxHashMap<Edge, [f64; 2]> = FxHashMap::default();
    let mut pieces: Vec<[Edge; 2]> = Vec::new();
    triangles(axes, levels, &mut |corners| {
        let mut ends: Vec<Edge> = Vec::with_capacity(2);
        for (a, b) in [(0, 1), (1, 2), (2, 0)] {
            let (a, b) = (corners[a], corners[b]);
            if (a.level >= 0.0) != (b.level >= 0.0) {
                let (a, b) = if a.id < b.id { (a, b) } else { (b, a) };
                at.insert((a.id, b.id), cut(a, b));
                ends.push((a.id, b.id));
            }
        }
        if let &[a, b] = ends.as_slice() {
            pieces.push([a, b]);
        }
    });
    let mut of: FxHashMap<Edge, Vec<usize>> = FxHashMap::default();
    for (k, piece) in pieces.iter().enumerate() {
        piece
            .iter()
            .for_each(|edge| of.entry(*edge).or_default().push(k));
    }
    let mut used = vec![false; pieces.len()];
    let mut lines = Vec::new();
    // Open lines from their ends first; what is left is closed.
    let loose = |k: usize| (0..2).find(|e| of[&pieces[k][*e]].len() == 1);
    let starts: Vec<(usize, usize)> = (0..pieces.len())
        .filter_map(|k| loose(k).map(|e| (k, e)))
        .chain((0..pieces.len()).map(|k| (k, 0)))
        .collect();
    for (first, end) in starts {
        if used[first] {
            continue;
        }
        let mut edge = pieces[first][end];
        let mut line = vec![at[&edge]];
        let mut next = Some(first);
        while let Some(k) = next {
            used[k] = true;
            edge = if pieces[k][0] == edge {
                pieces[k][1]
            } else {
                pieces[k][0]
            };
            line.push(at[&edge]);
            next = of[&edge].iter().copied().find(|k| !used[*k]);
        }
        lines.push(line);
    }
    lines
}

fn cut(a: Corner, b: Corner) -> [f64; 2] {
    let t = a.level / (a.level - b.level);
    [0, 1].map(|i| a.at[i] + t * (b.at[i] - a.at[i]))
}

fn triangles(axes: [&[f64]; 2], levels: &[f64], see: &mut dyn FnMut([Corner; 3])) {
    let [rows, columns] = axes;
    let nodes = rows.len() * columns.len();
    for i in 0..rows.len().saturating_sub(1) {
        for j in 0..columns.len().saturating_sub(1) {
            let corner = |i: usize, j: usize| {
                let id = i * columns.len() + j;
                Corner {
                    id,
                    at: [rows[i], columns[j]],
                    level: levels[id],
                }
            };
            let around = [
                corner(i, j),
                corner(i, j + 1),
                corner(i + 1, j + 1),
                corner(i + 1, j),
            ];
            let known: Vec<Corner> = around.into_iter().filter(|c| !c.level.is_nan()).collect();
            match known.as_slice() {
                &[a, b, c] => see([a, b, c]),
                [_, _, _, _] => {
                    let middle = Corner {
                        id: nodes + i * columns.len() + j,
                        at: [0, 1].map(|k| 0.25 * around.iter().map(|c| c.at[k]).sum::<f64>()),
                        level: 0.25 * around.iter().map(|c| c.level).sum::<f64>(),
                    };
                    (0..4).for_each(|k| see([around[k], around[(k + 1) % 4], middle]));
                }
                _ => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    fn disk(count: usize) -> (Vec<f64>, Vec<f64>) {
        let axis: Vec<f64> = (0..count)
            .map(|k| -1.0 + 2.0 * k as f64 / (count - 1) as f64)
            .collect();
        let levels =
            (axis.iter()).flat_map(|x| axis.iter().map(move |y| 0.7f64.powi(2) - x * x - y * y));
        let levels = levels.collect();
        (axis, levels)
    }

    /// The error falls with the square of the spacing.
    #[test]
    fn the_area_of_a_disk() {
        let error = |count: usize| {
            let (axis, levels) = disk(count);
            (area([&axis, &axis], &levels) - PI * 0.49).abs()
        };
        let (coarse, fine) = (error(41), error(161));
        assert!(coarse < 5e-3, "{coarse:e}");
        assert!(fine < coarse / 10.0, "{coarse:e} {fine:e}");
    }

    #[test]
    fn the_contour_of_a_disk_is_one_closed_line() {
        let (axis, levels) = disk(41);
        let lines = contour([&axis, &axis], &levels);
        assert_eq!(lines.len(), 1);
        assert_eq!(lines[0].first(), lines[0].last());
        for [x, y] in &lines[0] {
            // Linear interpolation: off by at most an eighth of the squared spacing times the
            // curvature, 2.
            assert!((x.hypot(*y) - 0.7).abs() < 0.05f64.powi(2), "{x} {y}");
        }
        let length: f64 = lines[0]
            .windows(2)
            .map(|w| (w[0][0] - w[1][0]).hypot(w[0][1] - w[1][1]))
            .sum();
        assert!((length - 1.4 * PI).abs() < 0.02, "{length}");
    }

    #[test]
    fn a_half_plane_is_exact_and_its_line_open() {
        let axis: Vec<f64> = (0..5).map(f64::from).collect();
        let levels: Vec<f64> = (axis.iter())
            .flat_map(|x| axis.iter().map(move |y| x + y - 3.5))
            .collect();
        assert!((area([&axis, &axis], &levels) - (16.0 - 0.5 * 3.5 * 3.5)).abs() < 1e-12);
        let lines = contour([&axis, &axis], &levels);
        assert_eq!(lines.len(), 1);
        assert_ne!(lines[0].first(), lines[0].last());
    }

    /// A missing node takes the triangles at it away, and the line ends there.
    #[test]
    fn missing_levels_are_holes() {
        let axis: Vec<f64> = (0..3).map(f64::from).collect();
        let mut levels = vec![1.0; 9];
        levels[4] = f64::NAN;
        assert!((area([&axis, &axis], &levels) - 2.0).abs() < 1e-12);
        assert!(contour([&axis, &axis], &levels).is_empty());
        levels[0] = f64::NAN;
        levels[1] = -1.0;
        assert!(
            (area([&axis, &axis], &levels) - 1.375).abs() < 1e-12,
            "{}",
            area([&axis, &axis], &levels)
        );
        assert_eq!(area([&axis, &axis], &[f64::NAN; 9]), 0.0);
    }
}
