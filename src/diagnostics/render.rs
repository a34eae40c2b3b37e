//! Rendering of problems, with the text underlined.

use super::printable::{misleads, printable};
use super::{Problem, Span};
use miette::{
    Diagnostic, GraphicalReportHandler, GraphicalTheme, LabeledSpan, MietteError,
    MietteSpanContents, SourceCode, SourceSpan, SpanContents,
};
use std::fmt;

/// Longest part of a line that is shown; a longer one is cut around the place.
const MAX_LINE: usize = 160;
/// Problems that are shown with their text; of more nobody reads them.
const SHOWN: usize = 50;

/// All problems of one scenario, in the file's order; those without a place come last.
///
/// `Display` gives one `file:line:column: message` a line; [`ScenarioErrors::render`] shows the
/// text underlined.
#[derive(Clone, PartialEq)]
pub struct ScenarioErrors {
    /// As given, for messages.
    pub file_name: String,
    /// The whole text, which the problems' spans refer to.
    pub text: String,
    /// At least one.
    pub problems: Vec<Problem>,
}

impl std::error::Error for ScenarioErrors {}

/// As [`ScenarioErrors::render`] shows it: what `main` prints that returns it.
impl fmt::Debug for ScenarioErrors {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "\n{}", self.render(false))
    }
}

impl fmt::Display for ScenarioErrors {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, problem) in self.problems.iter().enumerate() {
            if i > 0 {
                writeln!(f)?;
            }
            write!(f, "{}:", self.file_name)?;
            if let Some((line, column)) = self.place(problem) {
                write!(f, "{line}:{column}:")?;
            }
            write!(f, " {}", problem.message)?;
            if let Some(help) = &problem.help {
                write!(f, " ({help})")?;
            }
        }
        Ok(())
    }
}

impl ScenarioErrors {
    /// The problems of a text, in its order.
    pub fn new(file_name: &str, text: &str, mut problems: Vec<Problem>) -> Self {
        problems.sort_by_key(|p| {
            p.span
                .as_ref()
                .map_or((usize::MAX, 0), |s| (s.start, s.end))
        });
        problems.dedup();
        Self {
            file_name: file_name.to_owned(),
            text: text.to_owned(),
            problems,
        }
    }

    /// Line and column of a problem, both from 1; columns count characters.
    pub fn place(&self, problem: &Problem) -> Option<(usize, usize)> {
        problem.span.as_ref().map(|s| position(&self.text, s.start))
    }

    /// All problems for a person to read: the text underlined, with ANSI colours if `colours`.
    pub fn render(&self, colours: bool) -> String {
        let theme = if colours {
            GraphicalTheme::unicode()
        } else {
            GraphicalTheme::unicode_nocolor()
        };
        let handler = GraphicalReportHandler::new_themed(theme)
            .with_width(120)
            // What a message offers to be pasted has numbers: none is broken at its sign.
            .with_break_words(false)
            .with_word_separator(textwrap::WordSeparator::AsciiSpace)
            .with_word_splitter(textwrap::WordSplitter::NoHyphenation)
            .with_context_lines(1);
        // As many bytes, so that places stay.
        let mut text = String::with_capacity(self.text.len());
        for c in self.text.chars() {
            match misleads(c) && !matches!(c, '\n' | '\r' | '\t') {
                true => text.extend(std::iter::repeat_n('?', c.len_utf8())),
                false => text.push(c),
            }
        }
        let file_name = printable(&self.file_name);
        let mut out = String::new();
        for problem in self.problems.iter().take(SHOWN) {
            let shown = Shown {
                problem,
                source: Source {
                    file_name: &file_name,
                    text: &text,
                },
            };
            if handler.render_report(&mut out, &shown).is_err() {
                // The plain form needs no layout and cannot fail.
                out.push_str(&problem.message);
            }
            out.push('\n');
        }
        let count = match self.problems.len() {
            1 => "1 problem".to_owned(),
            n if n > SHOWN => format!("{n} problems, of which these are the first {SHOWN},"),
            n => format!("{n} problems"),
        };
        out + &format!("{count} in {file_name}\n")
    }
}

/// Line and column (in characters) of a byte offset, both from 1.
pub(crate) fn position(text: &str, offset: usize) -> (usize, usize) {
    let before = &text.as_bytes()[..offset.min(text.len())];
    let line_start = before
        .iter()
        .rposition(|b| *b == b'\n')
        .map_or(0, |i| i + 1);
    let line = before.iter().filter(|b| **b == b'\n').count() + 1;
    (
        line,
        String::from_utf8_lossy(&before[line_start..])
            .chars()
            .filter(|c| *c != '\u{feff}')
            .count()
            + 1,
    )
}

/// One problem as miette wants it.
#[derive(Debug)]
struct Shown<'s> {
    problem: &'s Problem,
    source: Source<'s>,
}

impl fmt::Display for Shown<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&printable(&self.problem.message))
    }
}

impl std::error::Error for Shown<'_> {}

impl Diagnostic for Shown<'_> {
    fn help<'a>(&'a self) -> Option<Box<dyn fmt::Display + 'a>> {
        self.problem
            .help
            .as_ref()
            .map(|h| Box::new(printable(h)) as Box<dyn fmt::Display>)
    }

    fn source_code(&self) -> Option<&dyn SourceCode> {
        self.problem
            .span
            .as_ref()
            .map(|_| &self.source as &dyn SourceCode)
    }

    fn labels(&self) -> Option<Box<dyn Iterator<Item = LabeledSpan> + '_>> {
        let span = self.source.shown_span(self.problem.span.as_ref()?);
        let label = Some(printable(&self.problem.label).into_owned()).filter(|l| !l.is_empty());
        Some(Box::new(std::iter::once(LabeledSpan::new(
            label,
            span.start,
            span.len(),
        ))))
    }
}

/// The file's text, of which very long lines are shown in part only.
#[derive(Debug)]
struct Source<'s> {
    file_name: &'s str,
    text: &'s str,
}

impl Source<'_> {
    /// The part of a span on its first line, and within what is shown of that.
    fn shown_span(&self, span: &Span) -> Span {
        let start = self.boundary(span.start);
        let (_, line_end) = self.line(start);
        let end = span
            .end
            .clamp(start, line_end.max(start))
            .min(start + MAX_LINE / 2);
        start..self.boundary(end)
    }

    /// Bounds of the line with a byte offset, without its end.
    fn line(&self, offset: usize) -> (usize, usize) {
        let start = self.text[..offset].rfind('\n').map_or(0, |i| i + 1);
        let end = self.text[offset..]
            .find('\n')
            .map_or(self.text.len(), |i| offset + i);
        (start, end)
    }

    /// The nearest character boundary at or below `offset`.
    fn boundary(&self, offset: usize) -> usize {
        let mut at = offset.min(self.text.len());
        while !self.text.is_char_boundary(at) {
            at -= 1;
        }
        at
    }
}

impl SourceCode for Source<'_> {
    fn read_span<'a>(
        &'a self,
        span: &SourceSpan,
        before: usize,
        after: usize,
    ) -> Result<Box<dyn SpanContents<'a> + 'a>, MietteError> {
        let offset = span.offset();
        let (start, end) = self.line(offset);
        let inner = self.text.read_span(span, before, after)?;
        let short = inner
            .data()
            .split(|b| *b == b'\n')
            .all(|l| l.len() <= MAX_LINE);
        let (data, shown, line, column, lines) = if short && end - start <= MAX_LINE {
            (
                inner.data(),
                *inner.span(),
                inner.line(),
                inner.column(),
                inner.line_count(),
            )
        } else {
            let from = self.boundary(start.max(offset.saturating_sub(MAX_LINE / 2)));
            let to = self.boundary(end.min(offset + MAX_LINE / 2)).max(from);
            let (line, column) = position(self.text, from);
            (
                &self.text.as_bytes()[from..to],
                SourceSpan::new(from.into(), to - from),
                line - 1,
                column - 1,
                1,
            )
        };
        // Without context the position is asked for, which miette itself counts in bytes.
        let column = if before == 0 {
            position(self.text, offset).1 - 1
        } else {
            column
        };
        let name = self.file_name.to_owned();
        Ok(Box::new(MietteSpanContents::new_named(
            name, data, shown, line, column, lines,
        )))
    }
}
