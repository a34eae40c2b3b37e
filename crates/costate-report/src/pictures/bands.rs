//! Bands of equal colour between levels.

use crate::canvas::{Canvas, Ink, Point};
use crate::colours::Rgb;
use crate::contour::{self, Grid};
use crate::frame::Frame;

/// Fills the bands between levels (ascending, at least one): band 0 is below the first; what is
/// above the last is band `levels.len()` if `open`, else left out.
pub fn fill(
    canvas: &mut dyn Canvas,
    frame: &Frame,
    grid: &Grid<'_>,
    levels: &[f64],
    shade: &dyn Fn(usize) -> Rgb,
    open: bool,
) {
    // What is below a level, the greatest first, each over the one before: no gaps between bands.
    let negative: Vec<f64> = grid.values.iter().map(|v| -v).collect();
    let below = Grid {
        values: &negative,
        ..*grid
    };
    let whole = open.then_some((levels.len(), f64::INFINITY));
    let bands = whole
        .into_iter()
        .chain(levels.iter().copied().enumerate().rev());
    for (k, level) in bands {
        let rings: Vec<Vec<Point>> = contour::region(&below, -level)
            .iter()
            .map(|r| frame.ring(r))
            .collect();
        canvas.area(&rings, Ink::Colour(shade(k)), 1.0);
    }
}
