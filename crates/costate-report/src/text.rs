//! The font of the pixels, and how wide a text is in it: so pictures need no font of the system.

use super::canvas::Point;
use std::sync::OnceLock;
use ttf_parser::{Face, GlyphId, OutlineBuilder};

/// A subset of DejaVu Sans; its license is beside it.
static FONT: &[u8] = include_bytes!("font/DejaVuSans-subset.ttf");
/// Height of capitals over the size.
const CAPITALS: f64 = 0.73;

fn face() -> Option<&'static Face<'static>> {
    static FACE: OnceLock<Option<Face<'static>>> = OnceLock::new();
    FACE.get_or_init(|| Face::parse(FONT, 0).ok()).as_ref()
}

fn glyphs(text: &str, size: f64) -> impl Iterator<Item = (GlyphId, f64)> {
    let face = face();
    text.chars().filter_map(move |c| {
        let face = face?;
        // What the subset lacks is shown as the replacement character.
        let glyph = face
            .glyph_index(c)
            .or_else(|| face.glyph_index('\u{fffd}'))?;
        let advance = f64::from(face.glyph_hor_advance(glyph).unwrap_or(0));
        Some((glyph, advance * size / f64::from(face.units_per_em())))
    })
}

/// The width of a text in pixels. Most other sans-serif fonts are narrower than this one.
pub fn width(text: &str, size: f64) -> f64 {
    glyphs(text, size).map(|(_, advance)| advance).sum()
}

/// How far the baseline is beneath a text's vertical middle.
pub fn baseline(size: f64) -> f64 {
    0.5 * CAPITALS * size
}

/// A part of a glyph's outline, in pixels.
pub enum Outline {
    Move(Point),
    Line(Point),
    Quadratic(Point, Point),
    Cubic(Point, Point, Point),
    Close,
}

struct Placed<'a> {
    parts: &'a mut Vec<Outline>,
    left: f64,
    scale: f64,
}

impl Placed<'_> {
    fn at(&self, x: f32, y: f32) -> Point {
        [
            self.left + self.scale * f64::from(x),
            -self.scale * f64::from(y),
        ]
    }
}

impl OutlineBuilder for Placed<'_> {
    fn move_to(&mut self, x: f32, y: f32) {
        let to = self.at(x, y);
        self.parts.push(Outline::Move(to));
    }

    fn line_to(&mut self, x: f32, y: f32) {
        let to = self.at(x, y);
        self.parts.push(Outline::Line(to));
    }

    fn quad_to(&mut self, x1: f32, y1: f32, x: f32, y: f32) {
        let (by, to) = (self.at(x1, y1), self.at(x, y));
        self.parts.push(Outline::Quadratic(by, to));
    }

    fn curve_to(&mut self, x1: f32, y1: f32, x2: f32, y2: f32, x: f32, y: f32) {
        let (a, b, to) = (self.at(x1, y1), self.at(x2, y2), self.at(x, y));
        self.parts.push(Outline::Cubic(a, b, to));
    }

    fn close(&mut self) {
        self.parts.push(Outline::Close);
    }
}

/// The outlines of a text whose baseline begins at the origin.
pub fn outlines(text: &str, size: f64) -> Vec<Outline> {
    let mut parts = Vec::new();
    let Some(face) = face() else { return parts };
    let scale = size / f64::from(face.units_per_em());
    let mut left = 0.0;
    for (glyph, advance) in glyphs(text, size) {
        let mut placed = Placed {
            parts: &mut parts,
            left,
            scale,
        };
        // A space has no outline.
        let _ = face.outline_glyph(glyph, &mut placed);
        left += advance;
    }
    parts
}

/// A text of at most `most` pixels, its end replaced by dots where it is longer.
pub fn shortened(text: &str, size: f64, most: f64) -> String {
    if width(text, size) <= most {
        return text.to_owned();
    }
    let mut kept: Vec<char> = text.chars().collect();
    while kept.pop().is_some() {
        let shorter: String = kept.iter().collect::<String>().trim_end().to_owned() + "\u{2026}";
        if width(&shorter, size) <= most {
            return shorter;
        }
    }
    String::new()
}

/// Digits (and signs) raised, as in powers of ten.
pub fn raised(n: i64) -> String {
    const DIGITS: [char; 10] = [
        '\u{2070}', '\u{b9}', '\u{b2}', '\u{b3}', '\u{2074}', '\u{2075}', '\u{2076}', '\u{2077}',
        '\u{2078}', '\u{2079}',
    ];
    let sign = if n < 0 { "\u{207b}" } else { "" };
    let digits = n.unsigned_abs().to_string();
    let digits = digits.bytes().map(|b| DIGITS[usize::from(b - b'0')]);
    sign.chars().chain(digits).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn widths_and_outlines() {
        assert!(face().is_some());
        // Digits of this font are 1303/2048 of the size each.
        assert!((width("00", 100.0) - 2.0 * 100.0 * 1303.0 / 2048.0).abs() < 1e-9);
        assert!(outlines(" ", 10.0).is_empty());
        let tall = outlines("H", 100.0);
        let top = tall.iter().fold(0.0f64, |top, part| match part {
            Outline::Move(p) | Outline::Line(p) => top.min(p[1]),
            _ => top,
        });
        assert!((top + 100.0 * CAPITALS).abs() < 0.5, "{top}");
        // Greek, powers and what is missing.
        for text in [
            "\u{3b8}\u{3c8}\u{394}",
            "10\u{207b}\u{b9}\u{b2}",
            "\u{2212}\u{221e}\u{2264}\u{2211}",
        ] {
            let missing = face().unwrap().glyph_index('\u{fffd}').unwrap();
            assert!(glyphs(text, 10.0).all(|(g, _)| g != missing), "{text}");
        }
        assert!(width("\u{4e2d}", 10.0) > 0.0);
    }

    #[test]
    fn long_texts_end_in_dots() {
        assert_eq!(shortened("abc", 10.0, 100.0), "abc");
        let short = shortened("a rather long text", 10.0, 60.0);
        assert!(
            short.ends_with('\u{2026}') && width(&short, 10.0) <= 60.0,
            "{short}"
        );
        assert_eq!(raised(-12), "\u{207b}\u{b9}\u{b2}");
    }
}
