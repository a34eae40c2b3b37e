//! What a picture is drawn on: an SVG text or pixels. Coordinates are in pixels, y downward, and
//! need not be whole.

use super::colours::Rgb;

pub type Point = [f64; 2];

/// A colour by its purpose, so that a page may show it on a dark ground, or a colour as such.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Ink {
    /// Text, and lines as dark as text.
    Text,
    /// Text and lines that matter less.
    Muted,
    Grid,
    /// The ground.
    Paper,
    Colour(Rgb),
}

impl Ink {
    /// On a light ground.
    pub fn light(self) -> Rgb {
        match self {
            Ink::Text => [28, 30, 33],
            Ink::Muted => [105, 110, 118],
            Ink::Grid => [226, 228, 231],
            Ink::Paper => [255, 255, 255],
            Ink::Colour(c) => c,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dash {
    Solid,
    Dashed,
    Dotted,
}

impl Dash {
    /// Lengths of ink and gap, in pixels.
    pub fn pattern(self) -> Option<[f64; 2]> {
        match self {
            Dash::Solid => None,
            Dash::Dashed => Some([7.0, 4.0]),
            Dash::Dotted => Some([2.0, 3.0]),
        }
    }
}

/// How a line is drawn.
#[derive(Clone, Copy, Debug)]
pub struct Stroke {
    pub ink: Ink,
    pub width: f64,
    pub dash: Dash,
    pub opacity: f64,
}

impl Stroke {
    pub fn new(ink: Ink, width: f64) -> Self {
        Self {
            ink,
            width,
            dash: Dash::Solid,
            opacity: 1.0,
        }
    }

    pub fn dash(self, dash: Dash) -> Self {
        Self { dash, ..self }
    }

    pub fn opacity(self, opacity: f64) -> Self {
        Self { opacity, ..self }
    }
}

/// Which part of a text is at its point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Anchor {
    Start,
    Middle,
    End,
}

/// How a text is drawn. Its vertical middle is at the point.
#[derive(Clone, Copy, Debug)]
pub struct Style {
    pub ink: Ink,
    pub size: f64,
    pub anchor: Anchor,
    /// Written upward.
    pub upward: bool,
    /// With an edge of the ground's colour, to be read above lines.
    pub halo: bool,
}

/// Size of all text, in pixels, whatever the picture's size.
pub const TEXT: f64 = 13.0;
/// Size of titles.
pub const TITLE: f64 = 15.0;

impl Style {
    pub fn new(anchor: Anchor) -> Self {
        Self {
            ink: Ink::Text,
            size: TEXT,
            anchor,
            upward: false,
            halo: false,
        }
    }

    pub fn ink(self, ink: Ink) -> Self {
        Self { ink, ..self }
    }

    pub fn size(self, size: f64) -> Self {
        Self { size, ..self }
    }

    pub fn upward(self) -> Self {
        Self {
            upward: true,
            ..self
        }
    }

    pub fn halo(self) -> Self {
        Self { halo: true, ..self }
    }
}

/// Something to draw on. Drawing code knows only this.
pub trait Canvas {
    /// Width and height.
    fn size(&self) -> [f64; 2];

    /// Open lines, in one style.
    fn lines(&mut self, lines: &[Vec<Point>], stroke: Stroke);

    /// What an odd number of the closed `rings` is around, filled.
    fn area(&mut self, rings: &[Vec<Point>], ink: Ink, opacity: f64);

    /// Filled polygons with edges in one style, each over the ones before.
    fn faces(&mut self, faces: &[(Vec<Point>, Rgb)], edge: Stroke) {
        for (ring, colour) in faces {
            self.area(std::slice::from_ref(ring), Ink::Colour(*colour), 1.0);
            if let Some(first) = ring.first() {
                self.lines(&[[ring.as_slice(), &[*first]].concat()], edge);
            }
        }
    }

    /// Round dots of diameter `width`.
    fn dots(&mut self, at: &[Point], width: f64, ink: Ink, opacity: f64);

    fn text(&mut self, at: Point, text: &str, style: Style);

    /// Lines that move, one set of them a frame, over and over in so many seconds; a line of one
    /// point is a dot. Where nothing can move the first frame is drawn.
    fn moving(&mut self, frames: &[Vec<Vec<Point>>], seconds: f64, stroke: Stroke) {
        let _ = seconds;
        let Some(first) = frames.first() else { return };
        let (dots, lines): (Vec<_>, Vec<_>) = first.iter().cloned().partition(|l| l.len() == 1);
        self.lines(&lines, stroke);
        self.dots(&dots.concat(), stroke.width, stroke.ink, stroke.opacity);
    }

    fn line(&mut self, from: Point, to: Point, stroke: Stroke) {
        self.lines(&[vec![from, to]], stroke);
    }

    fn rectangle(&mut self, area: Rect, ink: Ink, opacity: f64) {
        self.area(&[area.corners().to_vec()], ink, opacity);
    }
}

/// A rectangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rect {
    pub left: f64,
    pub top: f64,
    pub right: f64,
    pub bottom: f64,
}

impl Rect {
    pub fn new(left: f64, top: f64, right: f64, bottom: f64) -> Self {
        Self {
            left,
            top,
            right,
            bottom,
        }
    }

    pub fn width(&self) -> f64 {
        self.right - self.left
    }

    pub fn height(&self) -> f64 {
        self.bottom - self.top
    }

    pub fn corners(&self) -> [Point; 4] {
        [
            [self.left, self.top],
            [self.right, self.top],
            [self.right, self.bottom],
            [self.left, self.bottom],
        ]
    }

    pub fn contains(&self, [x, y]: Point) -> bool {
        x >= self.left && x <= self.right && y >= self.top && y <= self.bottom
    }
}
