//! Syntax trees -> nodes of the graph: names are looked up, functions checked, sides simplified.

use super::hints;
use super::parser::{Ast, GuardTree, Tree};
use super::quoted::Offsets;
use super::reader::Reader;
use super::scope::{Kinds, Meaning, functions, reserved};
use super::syntax_error::SyntaxError;
use crate::diagnostics::Problem;
use crate::diagnostics::did_you_mean;
use crate::diagnostics::shorten;
use crate::expr::{Fun, Id};
use crate::model::Span;
use rustc_hash::FxHashSet;
use std::ops::Range;

/// Most problems reported for one expression.
const MAX_PROBLEMS: usize = 20;

/// Where an expression's text comes from.
#[derive(Clone, Debug)]
pub(super) enum Origin {
    File {
        offsets: Offsets,
        whole: Span,
    },
    /// `--set name=value`, as typed.
    CommandLine(String),
}

/// What an expression is for, and so which names it may use.
#[derive(Clone, Copy, Debug)]
pub(super) struct Use<'w> {
    /// For messages: "the period of `theta`".
    pub what: &'w str,
    pub allowed: Kinds,
    /// The rule in words: "numbers and parameters".
    pub rule: &'static str,
}

impl<'w> Use<'w> {
    /// A value that is a number once the parameters are known.
    pub fn number(what: &'w str) -> Self {
        Self {
            what,
            allowed: Kinds::PARAMETER,
            rule: "numbers and parameters",
        }
    }
}

/// An expression in the graph and the kinds of names it depends on.
#[derive(Clone, Copy, Debug)]
pub(super) struct Built {
    pub expr: Id,
    pub kinds: Kinds,
}

impl Origin {
    /// A problem at `range` of the expression's text.
    pub fn problem(
        &self,
        range: &Range<usize>,
        message: String,
        label: String,
        help: Option<String>,
    ) -> Problem {
        match self {
            Origin::File { offsets, .. } => Problem {
                message,
                span: Some(offsets.locate(range)),
                label,
                help,
            },
            Origin::CommandLine(typed) => {
                let message = format!("--set {typed}: {message}");
                Problem {
                    message,
                    span: None,
                    label: String::new(),
                    help,
                }
            }
        }
    }

    /// A problem of the expression as a whole.
    pub fn problem_of_all(&self, message: String, label: &str) -> Problem {
        match self {
            Origin::File { whole, .. } => Problem::at(whole.clone(), message, label),
            Origin::CommandLine(_) => self.problem(&(0..0), message, String::new(), None),
        }
    }

    pub fn syntax_problem(&self, error: SyntaxError) -> Problem {
        self.problem(&error.span, error.message, error.label, error.help)
    }
}

/// One walk over a tree.
struct Walk<'r, 'a, 'o> {
    reader: &'r mut Reader<'a>,
    origin: &'o Origin,
    purpose: &'o Use<'o>,
    reported: FxHashSet<String>,
    broken: bool,
    kinds: Kinds,
}

impl Reader<'_> {
    /// The expression of `tree`; `None` if it has a problem, all of which are reported, or uses a
    /// name that has.
    pub fn build(&mut self, tree: &Tree<'_>, origin: &Origin, purpose: &Use<'_>) -> Option<Built> {
        let (ids, kinds) = self.build_all(tree, origin, purpose)?;
        ids.last().map(|&expr| Built { expr, kinds })
    }

    /// The two sides of a guard.
    pub fn build_guard(
        &mut self,
        guard: &GuardTree<'_>,
        origin: &Origin,
        purpose: &Use<'_>,
    ) -> Option<(Id, Id)> {
        let (ids, _) = self.build_all(&guard.tree, origin, purpose)?;
        Some((ids[guard.left], ids[guard.right]))
    }

    fn build_all(
        &mut self,
        tree: &Tree<'_>,
        origin: &Origin,
        purpose: &Use<'_>,
    ) -> Option<(Vec<Id>, Kinds)> {
        let reported = FxHashSet::default();
        let mut walk = Walk {
            reader: self,
            origin,
            purpose,
            reported,
            broken: false,
            kinds: Kinds::NONE,
        };
        let mut ids: Vec<Id> = Vec::with_capacity(tree.len());
        for ast in tree {
            let id = walk.node(ast, &ids);
            walk.check_finite(id);
            ids.push(id);
        }
        let (broken, kinds) = (walk.broken, walk.kinds);
        (!broken).then_some((ids, kinds))
    }
}

/// Whether a name may be that of something that follows from a mechanism.
fn is_of_mechanism(name: &str) -> bool {
    name.contains('.') || ["kinetic", "potential", "energy"].contains(&name)
}

impl Walk<'_, '_, '_> {
    /// The node for `ast`; something harmless where there is a problem.
    fn node(&mut self, ast: &Ast<'_>, ids: &[Id]) -> Id {
        match ast {
            Ast::Number(value) => self.reader.graph.constant(*value),
            Ast::Negate(a) => self.reader.graph.neg(ids[*a]),
            Ast::Binary(op, a, b) => self.reader.graph.binary(*op, ids[*a], ids[*b]),
            Ast::Name(name, span) => self.name(name, span).unwrap_or_else(|| self.substitute()),
            Ast::Call {
                function,
                span,
                arguments,
                ..
            } if *function == "atan2" => match arguments.as_slice() {
                [y, x] => self.reader.graph.atan2(ids[*y], ids[*x]),
                given => {
                    let message =
                        format!("`atan2` takes two arguments, y and x, not {}", given.len());
                    self.report(span, message, "called here", None);
                    self.substitute()
                }
            },
            Ast::Call {
                function,
                name_span,
                span,
                arguments,
            } => match (self.function(function, name_span), arguments.as_slice()) {
                (Some(f), [a]) => self.reader.graph.unary(f, ids[*a]),
                (Some(_), given) => {
                    let message = format!("`{function}` takes one argument, not {}", given.len());
                    self.report(span, message, "called here", None);
                    self.substitute()
                }
                (None, _) => self.substitute(),
            },
        }
    }

    fn substitute(&mut self) -> Id {
        self.reader.graph.constant(1.0)
    }

    fn report(&mut self, span: &Range<usize>, message: String, label: &str, help: Option<String>) {
        self.broken = true;
        if self.reported.len() < MAX_PROBLEMS && self.reported.insert(message.clone()) {
            let problem = self.origin.problem(span, message, label.to_owned(), help);
            self.reader.report(problem);
        }
    }

    /// Constant parts such as `1/0`, which would otherwise surface far from here.
    fn check_finite(&mut self, id: Id) {
        if !self.broken
            && self
                .reader
                .graph
                .as_constant(id)
                .is_some_and(|v| !v.is_finite())
        {
            self.broken = true;
            let message = format!("{} has a part that is not finite", self.purpose.what);
            let label = "a division by zero, or a function outside its domain";
            self.reader
                .report(self.origin.problem_of_all(message, label));
        }
    }

    fn name(&mut self, name: &str, span: &Range<usize>) -> Option<Id> {
        let purpose = self.purpose;
        let Some(entry) = self.reader.scope.get(name) else {
            return self.undeclared(name, span);
        };
        let noun = entry.role.noun();
        let kinds = match entry.meaning {
            Meaning::Known { kinds, .. } => kinds,
            _ => entry.role.kinds(),
        };
        if let Some(kind) = kinds.outside(purpose.allowed) {
            let message = if kinds == entry.role.kinds() {
                format!("{} may not use `{name}`, which is {noun}", purpose.what)
            } else {
                format!(
                    "{} may not use `{name}`, which depends on {kind}",
                    purpose.what
                )
            };
            let help = format!("it may use {}", purpose.rule);
            self.report(span, message, noun, Some(help));
            return None;
        }
        match entry.meaning {
            Meaning::Known { expr, kinds } => {
                self.kinds = self.kinds.and(kinds);
                Some(expr)
            }
            Meaning::Broken => {
                self.broken = true;
                None
            }
            Meaning::Current => {
                self.report(
                    span,
                    format!("`{name}` is defined by itself"),
                    "used in its own definition",
                    None,
                );
                None
            }
            Meaning::Later => {
                let help = format!("{} may use {}", purpose.what, purpose.rule);
                self.report(
                    span,
                    format!("`{name}` is defined only further down"),
                    "not known here",
                    Some(help),
                );
                None
            }
        }
    }

    fn undeclared(&mut self, name: &str, span: &Range<usize>) -> Option<Id> {
        if name == "pi" {
            return Some(self.reader.graph.constant(std::f64::consts::PI));
        }
        if self.reader.no_mechanism && is_of_mechanism(name) {
            self.broken = true;
            return None;
        }
        if functions().any(|f| f == name) {
            let message = format!("`{name}` is a function");
            self.report(
                span,
                message,
                "without an argument here",
                Some(format!("write {name}(...)")),
            );
            return None;
        }
        // Of very many unknown names nobody reads the suggestions.
        const SUGGESTED: usize = 20;
        let candidates = self
            .reader
            .scope
            .names(None)
            .chain(reserved().map(|r| -> &str { r }));
        let few = self.reader.problems.len() < SUGGESTED;
        let hint = hints::of_name(name).map(str::to_owned);
        let help = hint.or_else(|| few.then(|| did_you_mean(name, candidates)).flatten());
        self.report(
            span,
            format!("unknown name `{}`", shorten(name)),
            "not declared anywhere",
            help,
        );
        None
    }

    fn function(&mut self, name: &str, span: &Range<usize>) -> Option<Fun> {
        if let Some((_, f)) = Fun::CALLABLE.iter().find(|(n, _)| *n == name) {
            return Some(*f);
        }
        if self.reader.scope.get(name).is_some() || name == "pi" {
            let noun = self
                .reader
                .scope
                .get(name)
                .map_or("a number", |e| e.role.noun());
            let message = format!("`{name}` is {noun}, not a function");
            self.report(
                span,
                message,
                "called here",
                Some(format!("write {name}*(...) for a product")),
            );
            return None;
        }
        let help = match name {
            "ln" => Some("write log, which is the natural logarithm".to_owned()),
            "pow" | "power" => Some("write a^b".to_owned()),
            "sqr" | "square" => Some("write (...)^2".to_owned()),
            "cbrt" => Some("write (...)^(1/3)".to_owned()),
            "log10" => Some("write log(...)/log(10)".to_owned()),
            _ => hints::of_function(name)
                .map(str::to_owned)
                .or_else(|| did_you_mean(name, functions())),
        };
        let help = help.unwrap_or_else(|| {
            format!("functions: {}", functions().collect::<Vec<_>>().join(", "))
        });
        self.report(
            span,
            format!("unknown function `{}`", shorten(name)),
            "not a function",
            Some(help),
        );
        None
    }
}
