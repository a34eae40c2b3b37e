//! Where the characters of a TOML string's value stand in the file.

use crate::model::Span;
use std::ops::Range;

/// Maps byte offsets in a string's value to byte offsets in the file.
#[derive(Clone, Debug)]
pub(super) enum Offsets {
    /// The value stands in the file as it is, from this offset on.
    Verbatim(usize),
    /// Escapes: where the notation of every byte of the value starts and ends in the file.
    Table(Vec<(usize, usize)>),
    /// The literal could not be followed: everything is placed at the whole of it.
    Whole(Span),
}

impl Offsets {
    /// For the string literal at `span` of `text` (quotes included) with value `value`.
    pub fn of(text: &str, span: &Span, value: &str) -> Self {
        let Some(literal) = text.get(span.clone()) else {
            return Self::Whole(span.clone());
        };
        let quote = ["\"\"\"", "'''", "\"", "'"].into_iter().find(|q| {
            literal.len() >= 2 * q.len() && literal.starts_with(q) && literal.ends_with(q)
        });
        let Some(quote) = quote else {
            return Self::Whole(span.clone());
        };
        let mut start = quote.len();
        let body = &literal[start..literal.len() - quote.len()];
        if quote.len() == 3 {
            // A newline right after the opening quotes does not belong to the value.
            start += ["\r\n", "\n"]
                .into_iter()
                .find(|n| body.starts_with(n))
                .map_or(0, str::len);
        }
        let body = &literal[start..literal.len() - quote.len()];
        let start = span.start + start;
        if body == value {
            return Self::Verbatim(start);
        }
        match follow(body, value, quote.starts_with('"')) {
            Some(table) => Self::Table(
                table
                    .into_iter()
                    .map(|(a, b)| (a + start, b + start))
                    .collect(),
            ),
            None => Self::Whole(span.clone()),
        }
    }

    /// The file range of a range of the value.
    pub fn locate(&self, range: &Range<usize>) -> Span {
        match self {
            Self::Verbatim(start) => start + range.start..start + range.end,
            Self::Table(table) => {
                let last = table.len().saturating_sub(1);
                let start = table.get(range.start.min(last)).map_or(0, |t| t.0);
                let end = if range.end > range.start {
                    table[(range.end - 1).min(last)].1
                } else {
                    start
                };
                start..end.max(start)
            }
            Self::Whole(span) => span.clone(),
        }
    }
}

/// Start and end in `body` of every byte of `value` and of its end; `None` where they do not match.
fn follow(body: &str, value: &str, escapes: bool) -> Option<Vec<(usize, usize)>> {
    let mut table = Vec::with_capacity(value.len() + 1);
    let mut at = 0;
    for c in value.chars() {
        loop {
            let rest = &body[at..];
            match trimmed_line_break(rest).filter(|_| escapes) {
                Some(length) => at += length,
                None if rest.starts_with("\r\n") && c == '\n' => at += 1,
                None => break,
            }
        }
        let (meant, length) = if escapes {
            character(&body[at..])?
        } else {
            plain(&body[at..])?
        };
        if meant != c {
            return None;
        }
        table.extend(std::iter::repeat_n((at, at + length), c.len_utf8()));
        at += length;
    }
    table.push((at, at));
    Some(table)
}

fn plain(rest: &str) -> Option<(char, usize)> {
    let c = rest.chars().next()?;
    Some((c, c.len_utf8()))
}

/// Length of a backslash at the end of a line with the white space it swallows.
fn trimmed_line_break(rest: &str) -> Option<usize> {
    let after = rest.strip_prefix('\\')?;
    let kept = after.trim_start_matches([' ', '\t', '\r', '\n']);
    let swallowed = &after[..after.len() - kept.len()];
    swallowed.contains('\n').then_some(1 + swallowed.len())
}

/// The character at the start of `rest` and the length of its notation.
fn character(rest: &str) -> Option<(char, usize)> {
    let Some(escape) = rest.strip_prefix('\\') else {
        return plain(rest);
    };
    let (kind, _) = plain(escape)?;
    let hex = |digits: usize| {
        let code = u32::from_str_radix(escape.get(1..1 + digits)?, 16).ok()?;
        Some((char::from_u32(code)?, 2 + digits))
    };
    match kind {
        'b' => Some(('\u{8}', 2)),
        't' => Some(('\t', 2)),
        'n' => Some(('\n', 2)),
        'f' => Some(('\u{c}', 2)),
        'r' => Some(('\r', 2)),
        'e' => Some(('\u{1b}', 2)),
        '"' | '\\' => Some((kind, 2)),
        'x' => hex(2),
        'u' => hex(4),
        'U' => hex(8),
        _ => None,
    }
}
