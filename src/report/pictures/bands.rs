//! Bands of equal colour between levels.

use crate::report::canvas::{Canvas, Ink, Point};
use crate::report::colours::Rgb;
use crate::report::contour::{self, Grid};
use crate::report::frame::Frame;

/// Fills the bands between levels (ascending, at least one): band 0 is below the first; what is above the last is band
/// `levels.len()` if `open`, else left out.
pub fn fill(canvas: &mut dyn Canvas, frame: &Frame, grid: &Grid<'_>, levels: &[f64], shade: &dyn Fn(usize) -> Rgb, open: bool) {
    let rings = |level: f64| -> Vec<Vec<Point>> { contour::region(grid, level).iter().map(|r| frame.ring(r)).collect() };
    // What is above the last level is taken out of every band, by the even-odd rule; painted over, it would leave coloured
    // edges.
    let above = match levels.last() {
        Some(last) if !open => rings(*last),
        _ => Vec::new(),
    };
    let bounds = std::iter::once(f64::NEG_INFINITY).chain(levels.iter().copied());
    let bands = levels.len() + usize::from(open);
    for (k, level) in bounds.enumerate().take(bands) {
        let mut band = rings(level);
        band.extend(above.iter().cloned());
        canvas.area(&band, Ink::Colour(shade(k)), 1.0);
    }
}
