//! Text of an expression -> tokens. Never fails: what is no token of the language becomes
//! [`Kind::Foreign`], so that the parser can report the first thing wrong in reading order.

use std::ops::Range;
use winnow::ascii::{digit0, digit1};
use winnow::combinator::{alt, opt, repeat};
use winnow::error::ContextError;
use winnow::prelude::*;
use winnow::stream::LocatingSlice;
use winnow::token::{any, one_of, take_while};

/// One token and its byte range in the expression's text.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Token<'t> {
    pub kind: Kind<'t>,
    pub span: Range<usize>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Kind<'t> {
    Number(f64),
    Name(&'t str),
    Plus,
    Minus,
    Star,
    Slash,
    Caret,
    Open,
    Close,
    Comma,
    /// `<`, `<=`, `>`, `>=`.
    Relation(Relation),
    /// Anything else, `**` and `==` included.
    Foreign(&'t str),
}

/// Comparison of a guard.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Relation {
    Less,
    LessEqual,
    Greater,
    GreaterEqual,
}

type Input<'t> = LocatingSlice<&'t str>;

/// The tokens of `text`, at most `limit` of them.
pub(super) fn tokens(text: &str, limit: usize) -> Vec<Token<'_>> {
    let mut input = LocatingSlice::new(text);
    let mut found = Vec::new();
    while found.len() < limit {
        match spaced_token(&mut input) {
            Ok((kind, span)) => found.push(Token { kind, span }),
            Err(_) => break,
        }
    }
    found
}

fn spaced_token<'t>(input: &mut Input<'t>) -> Result<(Kind<'t>, Range<usize>), ContextError> {
    take_while(0.., char::is_whitespace)
        .void()
        .parse_next(input)?;
    alt((number, name, operator, foreign))
        .with_span()
        .parse_next(input)
}

fn number<'t>(input: &mut Input<'t>) -> Result<Kind<'t>, ContextError> {
    let mantissa = alt(((digit1, opt(('.', digit0))).void(), ('.', digit1).void()));
    let exponent = opt((one_of(['e', 'E']), opt(one_of(['+', '-'])), digit1));
    (mantissa, exponent)
        .take()
        .parse_to()
        .map(Kind::Number)
        .parse_next(input)
}

fn name<'t>(input: &mut Input<'t>) -> Result<Kind<'t>, ContextError> {
    let part = || {
        (
            one_of(|c: char| c.is_alphabetic() || c == '_'),
            take_while(0.., |c: char| c.is_alphanumeric() || c == '_'),
        )
            .void()
    };
    let more = repeat::<_, _, (), _, _>(0.., ('.', part()).void());
    let text: &str = (part(), more).take().parse_next(input)?;
    Ok(if text.split('.').all(is_identifier) {
        Kind::Name(text)
    } else {
        Kind::Foreign(text)
    })
}

/// Whether `text` may name something: an ASCII letter or `_`, then letters, digits and `_`.
pub(super) fn is_identifier(text: &str) -> bool {
    text.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
        && text.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
}

fn operator<'t>(input: &mut Input<'t>) -> Result<Kind<'t>, ContextError> {
    alt((
        alt(("**", "==", "!=", "&&", "||", "=<", "=>")).map(Kind::Foreign),
        alt((
            "<=".value(Relation::LessEqual),
            ">=".value(Relation::GreaterEqual),
        ))
        .map(Kind::Relation),
        any.verify_map(|c| match c {
            '+' => Some(Kind::Plus),
            '-' => Some(Kind::Minus),
            '*' => Some(Kind::Star),
            '/' => Some(Kind::Slash),
            '^' => Some(Kind::Caret),
            '(' => Some(Kind::Open),
            ')' => Some(Kind::Close),
            ',' => Some(Kind::Comma),
            '<' => Some(Kind::Relation(Relation::Less)),
            '>' => Some(Kind::Relation(Relation::Greater)),
            _ => None,
        }),
    ))
    .parse_next(input)
}

fn foreign<'t>(input: &mut Input<'t>) -> Result<Kind<'t>, ContextError> {
    any.take().map(Kind::Foreign).parse_next(input)
}
