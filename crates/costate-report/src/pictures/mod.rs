//! Each picture: what it needs of the file, and how it is drawn.

mod attenuation;
mod bands;
mod boundary;
mod closed_loop;
mod contours;
mod curve;
mod dissipation;
mod figures;
mod histories;
mod panels;
mod phase;
mod quality;
mod slices;
mod speed;
mod surface;

pub use attenuation::key_figure as attenuation_figure;

use super::{Picture, Source};

/// What a picture's maker gives: a picture, none where the file has no data for it, or why it
/// cannot be made.
type Made = Result<Option<Picture>, String>;
type Maker = fn(&Source<'_>) -> Made;

/// Pictures by the names of their files, in the page's order.
const BEFORE: [(&str, Maker); 11] = [
    ("motion", figures::moving),
    ("figures", figures::picture),
    ("simulation", histories::simulated),
    ("phase", phase::picture),
    ("contours", contours::picture),
    ("surface", surface::picture),
    ("curve", curve::picture),
    ("slice", slices::picture),
    ("histories", histories::picture),
    ("coverage", attenuation::coverage),
    ("validity", attenuation::validity),
];
/// Those after the maps of closed loops.
const AFTER: [(&str, Maker); 5] = [
    ("closed_loop_histories", histories::closed_loop),
    ("dissipation", dissipation::picture),
    ("dissipation_histories", dissipation::histories),
    ("errors", quality::picture),
    ("speed", speed::picture),
];

/// One picture by its name.
pub fn named(source: &Source<'_>, name: &str) -> Made {
    let maker = BEFORE.iter().chain(&AFTER).find(|(n, _)| *n == name);
    maker.map_or(Ok(None), |(_, make)| make(source))
}

/// All pictures that the file has data for, in the page's order; and those that could not be made.
pub fn all(source: &Source<'_>) -> (Vec<Picture>, Vec<(String, String)>) {
    let (mut pictures, mut missing) = (Vec::new(), Vec::new());
    let make = |makers: &[(&str, Maker)],
                pictures: &mut Vec<Picture>,
                missing: &mut Vec<(String, String)>| {
        for (name, make) in makers {
            match make(source) {
                Ok(picture) => pictures.extend(picture),
                Err(reason) => missing.push(((*name).to_owned(), reason)),
            }
        }
    };
    make(&BEFORE, &mut pictures, &mut missing);
    let (maps, without) = closed_loop::pictures(source);
    pictures.extend(maps);
    missing.extend(without);
    make(&AFTER, &mut pictures, &mut missing);
    (pictures, missing)
}
