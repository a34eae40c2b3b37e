//! Tokens of an expression -> syntax tree, by precedence climbing.
//!
//! The tree is an arena in which operands stand before their users, so whoever walks it needs no
//! recursion; only the parser itself recurses, to a depth that is checked before it starts.

use super::lexer::{Kind, Relation, Token, tokens};
use super::syntax_error::{SyntaxError, after_operand, no_operand};
use crate::expr::Op;
use std::ops::Range;
use winnow::combinator::{Infix, Prefix, expression};
use winnow::error::{ErrMode, ParserError};
use winnow::prelude::*;
use winnow::stream::{Stateful, Stream, TokenSlice};

/// Deepest nesting of parentheses, signs and powers.
pub(super) const MAX_DEPTH: usize = 200;
/// Longest expression in tokens; deriving the equations of anything longer would not end in useful
/// time.
pub(super) const MAX_TOKENS: usize = 1_000_000;

/// A node of the syntax tree; operands are indices of earlier nodes, spans are byte ranges in the
/// expression's text.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Ast<'t> {
    Number(f64),
    Name(&'t str, Range<usize>),
    Negate(usize),
    Binary(Op, usize, usize),
    Call {
        function: &'t str,
        name_span: Range<usize>,
        span: Range<usize>,
        arguments: Vec<usize>,
    },
}

/// A parsed expression; the last node is the root.
pub(super) type Tree<'t> = Vec<Ast<'t>>;

/// A parsed guard: one tree with two roots.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct GuardTree<'t> {
    pub tree: Tree<'t>,
    pub left: usize,
    pub relation: Relation,
    pub right: usize,
}

#[derive(Debug)]
struct State<'t, 'a> {
    tree: Tree<'t>,
    tokens: &'a [Token<'t>],
}

type Input<'t, 'a> = Stateful<TokenSlice<'a, Token<'t>>, State<'t, 'a>>;
type Parsed<O> = Result<O, ErrMode<SyntaxError>>;

impl<I: Stream> ParserError<I> for SyntaxError {
    type Inner = Self;

    fn from_input(_: &I) -> Self {
        Self::default()
    }

    fn into_inner(self) -> Result<Self, Self> {
        Ok(self)
    }
}

/// Parses one expression.
///
/// # Errors
/// The first [`SyntaxError`] in reading order.
pub(super) fn parse_expression(text: &str) -> Result<Tree<'_>, SyntaxError> {
    let tokens = tokens(text, MAX_TOKENS + 1);
    check_size(text, &tokens)?;
    let mut input = start(&tokens);
    expr(&mut input).map_err(inner)?;
    finish(input, None)
}

/// Parses a guard: two expressions with a comparison between them.
///
/// # Errors
/// The first [`SyntaxError`] in reading order.
pub(super) fn parse_guard(text: &str) -> Result<GuardTree<'_>, SyntaxError> {
    let tokens = tokens(text, MAX_TOKENS + 1);
    check_size(text, &tokens)?;
    let mut input = start(&tokens);
    let left = expr(&mut input).map_err(inner)?;
    let Some(Token {
        kind: Kind::Relation(relation),
        ..
    }) = input.peek_token()
    else {
        if input.peek_token().is_some() {
            return Err(unexpected(&input, None));
        }
        return Err(SyntaxError::new(
            0..text.len(),
            "a condition needs a comparison",
            "no `<`, `<=`, `>` or `>=` here",
        )
        .with_help("write for example \"x > 0\""));
    };
    let relation = *relation;
    input.next_token();
    let right = expr(&mut input).map_err(inner)?;
    finish(input, Some(relation)).map(|tree| GuardTree {
        tree,
        left,
        relation,
        right,
    })
}

fn start<'t, 'a>(tokens: &'a [Token<'t>]) -> Input<'t, 'a> {
    Stateful {
        input: TokenSlice::new(tokens),
        state: State {
            tree: Vec::new(),
            tokens,
        },
    }
}

fn finish<'t>(input: Input<'t, '_>, relation: Option<Relation>) -> Result<Tree<'t>, SyntaxError> {
    if input.peek_token().is_some() {
        return Err(unexpected(&input, relation));
    }
    Ok(input.state.tree)
}

fn inner(error: ErrMode<SyntaxError>) -> SyntaxError {
    match error {
        ErrMode::Backtrack(e) | ErrMode::Cut(e) => e,
        // Tokens are complete; the parser never asks for more.
        ErrMode::Incomplete(_) => SyntaxError::default(),
    }
}

fn cut<O>(error: SyntaxError) -> Parsed<O> {
    Err(ErrMode::Cut(error))
}

fn backtrack<O>() -> Parsed<O> {
    Err(ErrMode::Backtrack(SyntaxError::default()))
}

/// The error of the next token, which stands where only an operator could.
fn unexpected(input: &Input<'_, '_>, relation: Option<Relation>) -> SyntaxError {
    let at = position(input);
    after_operand(input.state.tokens, at, relation.is_some())
}

fn position(input: &Input<'_, '_>) -> usize {
    input.state.tokens.len() - input.eof_offset()
}

fn expr(input: &mut Input<'_, '_>) -> Parsed<usize> {
    expression(operand)
        .prefix(prefix)
        .infix(infix)
        .parse_next(input)
}

fn push<'t>(input: &mut Input<'t, '_>, ast: Ast<'t>) -> usize {
    input.state.tree.push(ast);
    input.state.tree.len() - 1
}

fn operand<'t, 'a>(input: &mut Input<'t, 'a>) -> Parsed<usize> {
    let Some(token) = input.peek_token() else {
        return backtrack();
    };
    match token.kind {
        Kind::Number(value) => {
            input.next_token();
            if !value.is_finite() {
                return cut(SyntaxError::new(
                    token.span.clone(),
                    "the number is too large",
                    "beyond 1.8e308",
                ));
            }
            Ok(push(input, Ast::Number(value)))
        }
        Kind::Name(name) => {
            input.next_token();
            match input.peek_token() {
                Some(Token {
                    kind: Kind::Open, ..
                }) => call(input, name, token.span.clone()),
                _ => Ok(push(input, Ast::Name(name, token.span.clone()))),
            }
        }
        Kind::Open => {
            input.next_token();
            let root = expr(input)?;
            close(input, token)?;
            Ok(root)
        }
        _ => backtrack(),
    }
}

/// Consumes the closing parenthesis that belongs to `open`; returns where it ends.
fn close(input: &mut Input<'_, '_>, open: &Token<'_>) -> Parsed<usize> {
    match input.peek_token() {
        Some(Token {
            kind: Kind::Close,
            span,
        }) => {
            input.next_token();
            Ok(span.end)
        }
        Some(_) => cut(unexpected(input, None)),
        None => cut(SyntaxError::new(
            open.span.clone(),
            "the parenthesis is never closed",
            "`)` is missing for this",
        )),
    }
}

fn call<'t>(
    input: &mut Input<'t, '_>,
    function: &'t str,
    name_span: Range<usize>,
) -> Parsed<usize> {
    let Some(open) = input.next_token() else {
        return backtrack();
    };
    let mut arguments = Vec::new();
    if let Some(Token {
        kind: Kind::Close,
        span,
    }) = input.peek_token()
    {
        input.next_token();
        let span = name_span.start..span.end;
        return Ok(push(
            input,
            Ast::Call {
                function,
                name_span,
                span,
                arguments,
            },
        ));
    }
    loop {
        arguments.push(expr(input)?);
        match input.peek_token() {
            Some(Token {
                kind: Kind::Comma, ..
            }) => input.next_token(),
            _ => break,
        };
    }
    let span = name_span.start..close(input, open)?;
    Ok(push(
        input,
        Ast::Call {
            function,
            name_span,
            span,
            arguments,
        },
    ))
}

/// Binding powers: sum 1, product 3, sign 5, power 7, so that `-x^2` is `-(x^2)` and `2^-1` is
/// allowed.
fn prefix<'t, 'a>(
    input: &mut Input<'t, 'a>,
) -> Parsed<Prefix<Input<'t, 'a>, usize, ErrMode<SyntaxError>>> {
    let at = position(input);
    match input.peek_token().map(|t| t.kind) {
        Some(Kind::Minus) => {
            input.next_token();
            Ok(Prefix(5, |input, a| Ok(push(input, Ast::Negate(a)))))
        }
        Some(Kind::Plus) => {
            input.next_token();
            Ok(Prefix(5, |_, a| Ok(a)))
        }
        _ => cut(no_operand(input.state.tokens, at)),
    }
}

fn infix<'t, 'a>(
    input: &mut Input<'t, 'a>,
) -> Parsed<Infix<Input<'t, 'a>, usize, ErrMode<SyntaxError>>> {
    let operator = match input.peek_token().map(|t| t.kind) {
        Some(Kind::Plus) => Infix::Left(1, |i: &mut Input<'t, 'a>, a, b| {
            Ok(binary(i, Op::Add, a, b))
        }),
        Some(Kind::Minus) => Infix::Left(1, |i: &mut Input<'t, 'a>, a, b| {
            Ok(binary(i, Op::Sub, a, b))
        }),
        Some(Kind::Star) => Infix::Left(3, |i: &mut Input<'t, 'a>, a, b| {
            Ok(binary(i, Op::Mul, a, b))
        }),
        Some(Kind::Slash) => Infix::Left(3, |i: &mut Input<'t, 'a>, a, b| {
            Ok(binary(i, Op::Div, a, b))
        }),
        Some(Kind::Caret) => Infix::Right(7, |i: &mut Input<'t, 'a>, a, b| {
            Ok(binary(i, Op::Pow, a, b))
        }),
        _ => return backtrack(),
    };
    input.next_token();
    Ok(operator)
}

fn binary(input: &mut Input<'_, '_>, op: Op, a: usize, b: usize) -> usize {
    push(input, Ast::Binary(op, a, b))
}

/// Refuses what would make the parser recurse too deep, or is too long to work with.
fn check_size(text: &str, tokens: &[Token<'_>]) -> Result<(), SyntaxError> {
    if tokens.len() > MAX_TOKENS {
        let message =
            format!("the expression has more than {MAX_TOKENS} numbers, names and operators");
        return Err(SyntaxError::new(0..text.len(), message, "too long")
            .with_help("name its parts in [definitions]"));
    }
    // Signs and powers pending at each open parenthesis; sums and products end them.
    let mut pending: Vec<usize> = vec![0];
    let mut total = 0;
    let mut after_operand = false;
    for token in tokens {
        let nested = match token.kind {
            Kind::Open => {
                pending.push(0);
                true
            }
            Kind::Caret => true,
            Kind::Minus | Kind::Plus => !after_operand,
            _ => false,
        };
        if nested {
            total += 1;
            if let (Some(last), false) = (pending.last_mut(), token.kind == Kind::Open) {
                *last += 1;
            }
            if total > MAX_DEPTH {
                let message = format!("the expression is nested more than {MAX_DEPTH} deep");
                return Err(SyntaxError::new(
                    token.span.clone(),
                    message,
                    "one level too many here",
                )
                .with_help("name its parts in [definitions]"));
            }
        } else if matches!(
            token.kind,
            Kind::Minus | Kind::Plus | Kind::Star | Kind::Slash | Kind::Comma | Kind::Relation(_)
        ) {
            if let Some(last) = pending.last_mut() {
                total -= std::mem::take(last);
            }
        } else if token.kind == Kind::Close && pending.len() > 1 {
            total -= 1 + pending.pop().unwrap_or(0);
        }
        after_operand = matches!(token.kind, Kind::Number(_) | Kind::Name(_) | Kind::Close);
    }
    Ok(())
}
