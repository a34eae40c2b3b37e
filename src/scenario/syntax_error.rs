//! What is wrong with an expression's syntax, in words.

use super::lexer::{Kind, Relation, Token};
use crate::diagnostics::shorten;
use std::ops::Range;

/// A syntax error and its byte range in the expression's text.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct SyntaxError {
    pub span: Range<usize>,
    pub message: String,
    pub label: String,
    pub help: Option<String>,
}

impl SyntaxError {
    pub fn new(span: Range<usize>, message: impl Into<String>, label: impl Into<String>) -> Self {
        Self {
            span,
            message: message.into(),
            label: label.into(),
            help: None,
        }
    }

    pub fn with_help(mut self, help: impl Into<String>) -> Self {
        self.help = Some(help.into());
        self
    }
}

/// The text of a token, cut where it is very long.
fn shown(kind: Kind<'_>) -> String {
    match kind {
        Kind::Number(value) => format!("{value}"),
        Kind::Name(text) | Kind::Foreign(text) => shorten(text),
        Kind::Plus => "+".into(),
        Kind::Minus => "-".into(),
        Kind::Star => "*".into(),
        Kind::Slash => "/".into(),
        Kind::Caret => "^".into(),
        Kind::Open => "(".into(),
        Kind::Close => ")".into(),
        Kind::Comma => ",".into(),
        Kind::Relation(Relation::Less) => "<".into(),
        Kind::Relation(Relation::LessEqual) => "<=".into(),
        Kind::Relation(Relation::Greater) => ">".into(),
        Kind::Relation(Relation::GreaterEqual) => ">=".into(),
    }
}

/// Token `at` (or the end) stands where a value must begin.
pub(super) fn no_operand(tokens: &[Token<'_>], at: usize) -> SyntaxError {
    let before = at.checked_sub(1).map(|i| &tokens[i]);
    match (before, tokens.get(at)) {
        (None, None) => SyntaxError::new(0..0, "the expression is empty", "nothing here"),
        (Some(before), None) => {
            let message = format!("the expression ends after `{}`", shown(before.kind));
            SyntaxError::new(before.span.clone(), message, "a value must follow")
        }
        (
            Some(Token {
                kind: Kind::Open,
                span,
            }),
            Some(Token {
                kind: Kind::Close,
                span: end,
            }),
        ) => SyntaxError::new(
            span.start..end.end,
            "the parentheses are empty",
            "a value is missing",
        ),
        (_, Some(token)) => match token.kind {
            Kind::Foreign(text) => foreign(text, token.span.clone()),
            kind => {
                let message = format!("expected a value, found `{}`", shown(kind));
                let label = "a number, a name or `(` must stand here";
                SyntaxError::new(token.span.clone(), message, label)
            }
        },
    }
}

/// Token `at` follows a complete value, but is no operator. `compared`: a comparison stands before
/// it.
pub(super) fn after_operand(tokens: &[Token<'_>], at: usize, compared: bool) -> SyntaxError {
    let token = &tokens[at];
    let span = token.span.clone();
    let before = at.checked_sub(1).map_or(Kind::Close, |i| tokens[i].kind);
    match token.kind {
        Kind::Number(_) | Kind::Name(_) | Kind::Open => {
            let left = if before == Kind::Close {
                "(...)".to_owned()
            } else {
                shown(before)
            };
            let right = if token.kind == Kind::Open {
                "(...)".to_owned()
            } else {
                shown(token.kind)
            };
            if let Kind::Name(word @ ("and" | "or" | "not")) = token.kind {
                let message = format!("`{word}` is no operator");
                return SyntaxError::new(span, message, "not understood").with_help(BOTH);
            }
            let message = format!("an operator is missing before `{}`", shown(token.kind));
            SyntaxError::new(
                span,
                message,
                "no operator between this and what stands before it",
            )
            .with_help(format!("write {left}*{right}"))
        }
        Kind::Close => SyntaxError::new(span, "`)` without `(`", "nothing to close here"),
        Kind::Comma => {
            let error = SyntaxError::new(span, "unexpected `,`", "not allowed here");
            match (before, tokens.get(at + 1).map(|t| t.kind)) {
                (Kind::Number(a), Some(Kind::Number(b))) => {
                    error.with_help(format!("write {a}.{b} with a point"))
                }
                _ => error,
            }
        }
        Kind::Relation(_) if compared => {
            SyntaxError::new(span, "a second comparison", "one comparison a condition")
                .with_help("write two guards, or min(a, b) > 0 for a > 0 and b > 0")
        }
        Kind::Relation(_) => {
            SyntaxError::new(span, "a comparison is not a value", "not allowed here").with_help(
                "comparisons stand between the two sides of a guard, in [guards], or of an event's condition, and nowhere else",
            )
        }
        Kind::Foreign(text) => foreign(text, span),
        kind => SyntaxError::new(
            span,
            format!("unexpected `{}`", shown(kind)),
            "not allowed here",
        ),
    }
}

/// How conditions are joined.
const BOTH: &str =
    "write min(a, b) > 0 for a > 0 and b > 0, and max(a, b) > 0 where one of them is enough";

fn foreign(text: &str, span: Range<usize>) -> SyntaxError {
    let help = match text {
        "**" => "write ^ for a power",
        "=" | "==" | "!=" => {
            "an expression is a value: it assigns and compares nothing; guards and conditions of events compare by <, <=, > or >=, and an event happens where its condition comes true"
        }
        "&&" | "||" | "&" | "|" => BOTH,
        "=<" => "write <=",
        "=>" => "write >=",
        "\u{2212}" | "\u{2013}" => "write - (the ASCII minus sign)",
        "\u{b7}" | "\u{d7}" | "\u{22c5}" => "write *",
        "\u{f7}" => "write /",
        "\u{b2}" => "write ^2",
        "\u{b3}" => "write ^3",
        "\u{221a}" => "write sqrt(...)",
        "\u{3c0}" => "write pi",
        "\u{2264}" => "write <=",
        "\u{2265}" => "write >=",
        "[" | "]" | "{" | "}" => "use parentheses ( )",
        _ if text.chars().any(char::is_alphanumeric) => {
            "names have letters a to z, A to Z, digits and _"
        }
        _ => "the operators are + - * / ^",
    };
    let what = if text.chars().any(char::is_alphabetic) {
        "the name"
    } else {
        "the symbol"
    };
    let message = format!(
        "{what} `{}` is not part of the language",
        shorten(&text.escape_debug().to_string())
    );
    SyntaxError::new(span, message, "not understood").with_help(help)
}
