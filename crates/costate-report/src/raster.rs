//! A picture as pixels, and as a PNG file.

use super::canvas::{Anchor, Canvas, Ink, Point, Stroke, Style};
use super::text::{self, Outline};
use tiny_skia::{
    FillRule, LineCap, LineJoin, Paint, Path, PathBuilder, Pixmap, StrokeDash, Transform,
};

/// Pixels with smooth edges.
pub struct Raster {
    size: [f64; 2],
    pixmap: Pixmap,
}

/// Pixels could not be had, or not written.
#[derive(Debug, thiserror::Error)]
pub enum RasterError {
    #[error("a picture of {0} x {1} pixels is too large")]
    Size(f64, f64),
    #[error("PNG: {0}")]
    Encoding(#[from] png::EncodingError),
}

impl Raster {
    /// A white ground.
    ///
    /// # Errors
    /// [`RasterError::Size`].
    pub fn new(size: [f64; 2]) -> Result<Self, RasterError> {
        let [width, height] = size.map(|v| v.round().clamp(1.0, 1e5) as u32);
        let mut pixmap = Pixmap::new(width, height).ok_or(RasterError::Size(size[0], size[1]))?;
        pixmap.fill(tiny_skia::Color::WHITE);
        Ok(Self { size, pixmap })
    }

    /// The file's bytes: eight bits a channel, no transparency.
    ///
    /// # Errors
    /// [`RasterError::Encoding`].
    pub fn png(&self) -> Result<Vec<u8>, RasterError> {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, self.pixmap.width(), self.pixmap.height());
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        // Every pixel is opaque: the ground is, and what is drawn over an opaque pixel leaves it
        // so.
        let rgb: Vec<u8> = self
            .pixmap
            .data()
            .chunks_exact(4)
            .flat_map(|p| [p[0], p[1], p[2]])
            .collect();
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&rgb)?;
        writer.finish()?;
        Ok(bytes)
    }

    fn fill(&mut self, path: &Path, rule: FillRule, ink: Ink, opacity: f64) {
        self.pixmap.fill_path(
            path,
            &paint(ink, opacity),
            rule,
            Transform::identity(),
            None,
        );
    }

    fn stroke(&mut self, path: &Path, stroke: &tiny_skia::Stroke, ink: Ink, opacity: f64) {
        self.pixmap.stroke_path(
            path,
            &paint(ink, opacity),
            stroke,
            Transform::identity(),
            None,
        );
    }
}

fn paint(ink: Ink, opacity: f64) -> Paint<'static> {
    let [r, g, b] = ink.light();
    let mut paint = Paint::default();
    paint.set_color_rgba8(r, g, b, (255.0 * opacity.clamp(0.0, 1.0)).round() as u8);
    paint.anti_alias = true;
    paint
}

fn path(lines: &[Vec<Point>], closed: bool) -> Option<Path> {
    let mut builder = PathBuilder::new();
    for line in lines {
        for (k, [x, y]) in line.iter().enumerate() {
            let (x, y) = (*x as f32, *y as f32);
            if k == 0 {
                builder.move_to(x, y)
            } else {
                builder.line_to(x, y)
            }
        }
        if closed && !line.is_empty() {
            builder.close();
        }
    }
    builder.finish()
}

/// Where a text's outlines go: from its own coordinates to the picture's.
fn placed(at: Point, words: &str, style: Style) -> impl Fn(Point) -> (f32, f32) {
    let width = text::width(words, style.size);
    let back = match style.anchor {
        Anchor::Start => 0.0,
        Anchor::Middle => 0.5 * width,
        Anchor::End => width,
    };
    let down = text::baseline(style.size);
    move |[x, y]| {
        let (along, below) = (x - back, y + down);
        let [px, py] = if style.upward {
            [at[0] + below, at[1] - along]
        } else {
            [at[0] + along, at[1] + below]
        };
        (px as f32, py as f32)
    }
}

impl Canvas for Raster {
    fn size(&self) -> [f64; 2] {
        self.size
    }

    fn lines(&mut self, lines: &[Vec<Point>], stroke: Stroke) {
        let Some(path) = path(lines, false) else {
            return;
        };
        let style = tiny_skia::Stroke {
            width: stroke.width as f32,
            line_join: LineJoin::Round,
            dash: (stroke.dash.pattern())
                .and_then(|[on, off]| StrokeDash::new(vec![on as f32, off as f32], 0.0)),
            ..tiny_skia::Stroke::default()
        };
        self.stroke(&path, &style, stroke.ink, stroke.opacity);
    }

    fn area(&mut self, rings: &[Vec<Point>], ink: Ink, opacity: f64) {
        if let Some(path) = path(rings, true) {
            self.fill(&path, FillRule::EvenOdd, ink, opacity);
        }
    }

    fn dots(&mut self, at: &[Point], width: f64, ink: Ink, opacity: f64) {
        let mut builder = PathBuilder::new();
        for [x, y] in at {
            builder.push_circle(*x as f32, *y as f32, 0.5 * width as f32);
        }
        if let Some(path) = builder.finish() {
            self.fill(&path, FillRule::Winding, ink, opacity);
        }
    }

    fn text(&mut self, at: Point, words: &str, style: Style) {
        let place = placed(at, words, style);
        let mut builder = PathBuilder::new();
        for part in text::outlines(words, style.size) {
            match part {
                Outline::Move(p) => {
                    let (x, y) = place(p);
                    builder.move_to(x, y);
                }
                Outline::Line(p) => {
                    let (x, y) = place(p);
                    builder.line_to(x, y);
                }
                Outline::Quadratic(by, p) => {
                    let ((a, b), (x, y)) = (place(by), place(p));
                    builder.quad_to(a, b, x, y);
                }
                Outline::Cubic(first, second, p) => {
                    let ((a, b), (c, d), (x, y)) = (place(first), place(second), place(p));
                    builder.cubic_to(a, b, c, d, x, y);
                }
                Outline::Close => builder.close(),
            }
        }
        let Some(path) = builder.finish() else { return };
        if style.halo {
            let edge = tiny_skia::Stroke {
                width: 3.0,
                line_join: LineJoin::Round,
                line_cap: LineCap::Round,
                ..tiny_skia::Stroke::default()
            };
            self.stroke(&path, &edge, Ink::Paper, 1.0);
        }
        self.fill(&path, FillRule::Winding, style.ink, 1.0);
    }
}
