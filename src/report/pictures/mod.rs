//! Each picture: what it needs of the file, and how it is drawn.

mod boundary;
mod contours;
mod phase;
mod surface;

use super::{Picture, Source};

/// What a picture's maker gives: a picture, none where the file has no data for it, or why it cannot be made.
type Made = Result<Option<Picture>, String>;

/// Names of all pictures' files.
pub const NAMES: [&str; 3] = ["phase", "contours", "surface"];

/// All pictures that the file has data for, in the page's order; and those that could not be made.
pub fn all(source: &Source<'_>) -> (Vec<Picture>, Vec<(String, String)>) {
    let makers: [(&str, fn(&Source<'_>) -> Made); 3] = [
        ("phase", phase::picture),
        ("contours", contours::picture),
        ("surface", surface::picture),
    ];
    let (mut pictures, mut missing) = (Vec::new(), Vec::new());
    for (name, make) in makers {
        match make(source) {
            Ok(picture) => pictures.extend(picture),
            Err(reason) => missing.push((name.to_owned(), reason)),
        }
    }
    (pictures, missing)
}
