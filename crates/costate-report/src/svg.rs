//! A picture as SVG text.
//!
//! Colours stand in attributes, for programs that know no style sheets; classes name their purpose,
//! so that a page's style sheet may replace them on a dark ground.

use super::canvas::{Anchor, Canvas, Ink, Point, Stroke, Style};
use super::colours::Rgb;
use super::text;
use std::fmt::Write as _;

/// Narrower than the font that widths are measured in, all of them.
const FONTS: &str = "Helvetica,Arial,'Liberation Sans','DejaVu Sans',sans-serif";

pub struct Svg {
    size: [f64; 2],
    body: String,
}

impl Svg {
    pub fn new(size: [f64; 2]) -> Self {
        Self {
            size,
            body: String::new(),
        }
    }

    /// The whole text; `title` is what a reader of the screen says.
    pub fn finish(self, title: &str) -> String {
        let [width, height] = self.size.map(|v| v.round());
        let paper = Ink::Paper;
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} \
             {height}\" role=\"img\" font-family=\"{FONTS}\" stroke-linejoin=\"round\" stroke-linecap=\"butt\">\n\
             <!-- costate report -->\n<title>{}</title>\n<rect class=\"f{}\" width=\"{width}\" height=\"{height}\" fill=\"{}\"/>\n{}</svg>\n",
            escaped(title),
            class(paper),
            colour(paper),
            self.body
        )
    }

    fn push(&mut self, text: std::fmt::Arguments<'_>) {
        // Writing to a String cannot fail.
        let _ = self.body.write_fmt(text);
    }
}

/// Text as XML wants it.
pub fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            // XML has no place for other control characters.
            c if c < ' ' && !matches!(c, '\n' | '\t') => out.push(' '),
            c => out.push(c),
        }
    }
    out
}

fn colour(ink: Ink) -> String {
    let [r, g, b] = ink.light();
    format!("#{r:02x}{g:02x}{b:02x}")
}

/// Letter of an ink's classes: `f` or `s` (fill, stroke) goes before it.
fn class(ink: Ink) -> &'static str {
    match ink {
        Ink::Text => "t",
        Ink::Muted => "m",
        Ink::Grid => "g",
        Ink::Paper => "p",
        Ink::Colour(_) => "",
    }
}

/// ` class="st" stroke="#..."`, `what` being stroke or fill.
fn inked(what: &str, ink: Ink) -> String {
    let letter = class(ink);
    let class = if letter.is_empty() {
        String::new()
    } else {
        format!(" class=\"{}{letter}\"", &what[..1])
    };
    format!("{class} {what}=\"{}\"", colour(ink))
}

fn opacity(what: &str, opacity: f64) -> String {
    if opacity >= 1.0 {
        String::new()
    } else {
        format!(" {what}-opacity=\"{}\"", short(opacity, 2))
    }
}

/// A number without needless digits.
fn short(v: f64, decimals: usize) -> String {
    let text = format!("{v:.decimals$}");
    let text = if text.contains('.') {
        text.trim_end_matches('0').trim_end_matches('.')
    } else {
        &text
    };
    match text {
        "-0" | "" => "0".to_owned(),
        _ => text.strip_prefix("0.").map_or_else(
            || {
                text.strip_prefix("-0.")
                    .map_or_else(|| text.to_owned(), |rest| format!("-.{rest}"))
            },
            |rest| format!(".{rest}"),
        ),
    }
}

/// A line in tenths of a pixel, relative to the point before: half as long as absolute coordinates.
fn path(line: &[Point], closed: bool, out: &mut String) {
    let mut last: Option<[i64; 2]> = None;
    let mut count = 0;
    for point in line {
        let at = point.map(|v| (10.0 * v).round() as i64);
        let numbers = |v: [i64; 2]| {
            let [x, y] = v.map(|v| short(v as f64 / 10.0, 1));
            // A sign or a point parts numbers as well as a blank does; a point does so only after
            // another point.
            let blank = if y.starts_with('-') || (y.starts_with('.') && x.contains('.')) {
                ""
            } else {
                " "
            };
            format!("{x}{blank}{y}")
        };
        match last {
            None => {
                let _ = write!(out, "M{}", numbers(at));
            }
            Some(before) if before == at => continue,
            Some(before) => {
                let _ = write!(out, "l{}", numbers([at[0] - before[0], at[1] - before[1]]));
            }
        }
        last = Some(at);
        count += 1;
    }
    if closed && count > 0 {
        out.push('z');
    }
}

impl Canvas for Svg {
    fn size(&self) -> [f64; 2] {
        self.size
    }

    fn lines(&mut self, lines: &[Vec<Point>], stroke: Stroke) {
        let mut d = String::new();
        for line in lines.iter().filter(|l| l.len() > 1) {
            path(line, false, &mut d);
        }
        if d.is_empty() {
            return;
        }
        let dash = stroke.dash.pattern().map_or_else(String::new, |[on, off]| {
            format!(" stroke-dasharray=\"{} {}\"", short(on, 1), short(off, 1))
        });
        self.push(format_args!(
            "<path fill=\"none\"{} stroke-width=\"{}\"{dash}{} d=\"{d}\"/>\n",
            inked("stroke", stroke.ink),
            short(stroke.width, 2),
            opacity("stroke", stroke.opacity),
        ));
    }

    fn area(&mut self, rings: &[Vec<Point>], ink: Ink, alpha: f64) {
        let mut d = String::new();
        for ring in rings.iter().filter(|r| r.len() > 2) {
            path(ring, true, &mut d);
        }
        if d.is_empty() {
            return;
        }
        let rule = if rings.len() > 1 {
            " fill-rule=\"evenodd\""
        } else {
            ""
        };
        self.push(format_args!(
            "<path{rule}{}{} d=\"{d}\"/>\n",
            inked("fill", ink),
            opacity("fill", alpha)
        ));
    }

    fn faces(&mut self, faces: &[(Vec<Point>, Rgb)], edge: Stroke) {
        self.push(format_args!(
            "<g{} stroke-width=\"{}\"{}>\n",
            inked("stroke", edge.ink),
            short(edge.width, 2),
            opacity("stroke", edge.opacity)
        ));
        for (ring, fill) in faces {
            let mut d = String::new();
            path(ring, true, &mut d);
            self.push(format_args!(
                "<path fill=\"{}\" d=\"{d}\"/>\n",
                colour(Ink::Colour(*fill))
            ));
        }
        self.push(format_args!("</g>\n"));
    }

    fn dots(&mut self, at: &[Point], width: f64, ink: Ink, alpha: f64) {
        if at.is_empty() {
            return;
        }
        // Lines without length with round ends: one element for all dots.
        let mut d = String::new();
        for point in at {
            path(&[*point], false, &mut d);
            d.push_str("h0");
        }
        self.push(format_args!(
            "<path fill=\"none\" stroke-linecap=\"round\"{} stroke-width=\"{}\"{} d=\"{d}\"/>\n",
            inked("stroke", ink),
            short(width, 2),
            opacity("stroke", alpha),
        ));
    }

    fn moving(&mut self, frames: &[Vec<Vec<Point>>], seconds: f64, stroke: Stroke) {
        let texts: Vec<String> = (frames.iter())
            .map(|lines| {
                let mut d = String::new();
                for line in lines {
                    path(line, false, &mut d);
                    if line.len() == 1 {
                        d.push_str("h0");
                    }
                }
                d
            })
            .collect();
        let Some(first) = texts.first() else { return };
        self.push(format_args!(
            "<path fill=\"none\" stroke-linecap=\"round\"{} stroke-width=\"{}\"{} d=\"{first}\">\
             <animate attributeName=\"d\" calcMode=\"discrete\" dur=\"{}s\" repeatCount=\"indefinite\" values=\"{}\"/></path>\n",
            inked("stroke", stroke.ink),
            short(stroke.width, 2),
            opacity("stroke", stroke.opacity),
            short(seconds, 3),
            texts.join(";"),
        ));
    }

    fn text(&mut self, [x, y]: Point, words: &str, style: Style) {
        if words.is_empty() {
            return;
        }
        let anchor = match style.anchor {
            Anchor::Start => "",
            Anchor::Middle => " text-anchor=\"middle\"",
            Anchor::End => " text-anchor=\"end\"",
        };
        let down = text::baseline(style.size);
        let place = if style.upward {
            format!(
                " transform=\"translate({} {}) rotate(-90)\"",
                short(x + down, 1),
                short(y, 1)
            )
        } else {
            format!(" x=\"{}\" y=\"{}\"", short(x, 1), short(y + down, 1))
        };
        let common = format!("{place}{anchor} font-size=\"{}\"", short(style.size, 1));
        let words = escaped(words);
        if style.halo {
            self.push(format_args!(
                "<text{common}{} stroke-width=\"3\"{}>{words}</text>\n",
                inked("stroke", Ink::Paper).replace("\"sp\"", "\"sp fp\""),
                " fill=\"#ffffff\"",
            ));
        }
        self.push(format_args!(
            "<text{common}{}>{words}</text>\n",
            inked("fill", style.ink)
        ));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        assert_eq!(short(0.5, 1), ".5");
        assert_eq!(short(-0.5, 1), "-.5");
        assert_eq!(short(-0.04, 1), "0");
        assert_eq!(short(120.0, 1), "120");
        assert_eq!(short(100.0, 0), "100");
    }

    #[test]
    fn paths_are_relative() {
        let mut d = String::new();
        path(
            &[[1.0, 2.0], [1.5, 1.0], [1.5, 1.0], [1.0, 1.25]],
            true,
            &mut d,
        );
        assert_eq!(d, "M1 2l.5-1l-.5.3z");
    }

    #[test]
    fn text_is_escaped() {
        assert_eq!(escaped("a<b & \"c\"\u{1}"), "a&lt;b &amp; &quot;c&quot; ");
    }
}
