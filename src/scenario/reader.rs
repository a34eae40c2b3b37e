//! What all sections are read with: typed access to TOML values, each refusal with its place.

use super::build::{Built, Origin, Use};
use super::hints;
use super::keys::keys_of;
use super::parser::{parse_expression, parse_guard};
use super::quoted::Offsets;
use super::scope::Scope;
use crate::diagnostics::Problem;
use crate::diagnostics::did_you_mean;
use crate::diagnostics::shorten;
use crate::diagnostics::unprintable;
use crate::expr::{Graph, Id};
use crate::model::Span;
use crate::numeric::digits::plain;
use rustc_hash::FxHashMap;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// A TOML value and its place.
pub(super) type Value<'a> = Spanned<DeValue<'a>>;

/// A table with the name it has in messages ("[states]", "state `theta`") and the place of its key.
#[derive(Clone, Debug)]
pub(super) struct Section<'a> {
    pub name: String,
    pub span: Span,
    table: &'a DeTable<'a>,
}

impl<'a> Section<'a> {
    pub fn new(name: impl Into<String>, span: Span, table: &'a DeTable<'a>) -> Self {
        Self {
            name: name.into(),
            span,
            table,
        }
    }

    /// Key, its place, and value, in the file's order.
    pub fn entries(&self) -> impl Iterator<Item = (&'a str, Span, &'a Value<'a>)> + use<'a> {
        self.table
            .iter()
            .map(|(k, v)| (k.get_ref().as_ref(), k.span(), v))
    }

    pub fn get(&self, key: &str) -> Option<&'a Value<'a>> {
        self.table.get(key)
    }

    /// The place of a key, or of the section where it has no such key.
    pub fn key_span(&self, key: &str) -> Span {
        self.table
            .get_key_value(key)
            .map_or_else(|| self.span.clone(), |(k, _)| k.span())
    }
}

/// Everything known while a file is read.
pub(super) struct Reader<'a> {
    pub text: &'a str,
    pub graph: Graph,
    pub scope: Scope,
    /// Values of the parameters.
    pub values: FxHashMap<Id, f64>,
    pub problems: Vec<Problem>,
    /// Remarks on what is read.
    pub notes: Vec<String>,
    /// Something is wrong with the mechanism: what follows from it is not known, which is no further
    /// problem.
    pub no_mechanism: bool,
}

impl<'a> Reader<'a> {
    pub fn new(text: &'a str) -> Self {
        let (graph, scope) = (Graph::new(), Scope::default());
        Self {
            text,
            graph,
            scope,
            values: FxHashMap::default(),
            problems: Vec::new(),
            notes: Vec::new(),
            no_mechanism: false,
        }
    }

    pub fn report(&mut self, problem: Problem) {
        self.problems.push(problem);
    }

    /// Reports at `span`; returns `None`, for use in a chain.
    pub fn refuse<T>(
        &mut self,
        span: Span,
        message: impl Into<String>,
        label: impl Into<String>,
    ) -> Option<T> {
        self.report(Problem::at(span, message, label));
        None
    }

    /// Reports a name that is not one of those known, and which of them may be meant.
    pub fn unknown<'k, T>(
        &mut self,
        (name, span): (&str, Span),
        message: impl Into<String>,
        label: &str,
        known: impl Iterator<Item = &'k str>,
    ) -> Option<T> {
        let help = did_you_mean(name, known);
        self.report(Problem {
            help,
            ..Problem::at(span, message, label)
        });
        None
    }

    /// Refuses all keys but those of the section, or table within one, of this name.
    pub fn check_keys(&mut self, section: &Section<'_>, of: &str) {
        let known = keys_of(of);
        for (key, span, _) in section.entries().filter(|(k, ..)| !known.contains(k)) {
            let hint = hints::of_key(&section.name, key).map(str::to_owned);
            let help = hint
                .or_else(|| did_you_mean(key, known.iter().copied()))
                .unwrap_or_else(|| format!("{} may have: {}", section.name, known.join(", ")));
            let message = format!("unknown key `{}` in {}", shorten(key), section.name);
            self.report(Problem::at(span, message, "not a key here").with_help(help));
        }
    }

    fn wrong_type<T>(&mut self, value: &Value<'_>, what: &str, expected: &str) -> Option<T> {
        let found = match value.get_ref() {
            DeValue::String(_) => "a string",
            DeValue::Integer(_) => "an integer",
            DeValue::Float(_) => "a number",
            DeValue::Boolean(_) => "true or false",
            DeValue::Datetime(_) => "a date",
            DeValue::Array(_) => "an array",
            DeValue::Table(_) => "a table",
        };
        self.refuse(
            value.span(),
            format!("{what} must be {expected}, not {found}"),
            format!("expected {expected}"),
        )
    }

    /// A text of one line that is printed, and written into files.
    pub fn label(&mut self, value: &'a Value<'a>, what: &str) -> Option<&'a str> {
        self.printable(value, what, &[])
    }

    /// The same of several lines.
    pub fn text_of_lines(&mut self, value: &'a Value<'a>, what: &str) -> Option<&'a str> {
        self.printable(value, what, &['\n', '\r', '\t'])
    }

    fn printable(&mut self, value: &'a Value<'a>, what: &str, allowed: &[char]) -> Option<&'a str> {
        let text = self.string(value, what)?;
        match unprintable(&text.replace(allowed, "")) {
            Some(c) => {
                let message = format!("{what} has a character that is not printed ({c:?})");
                self.refuse(value.span(), message, "leave that character out")
            }
            None => Some(text),
        }
    }

    /// Whether something can be named so: without characters that are not printed, without `/` and
    /// `,`, and with a letter or digit at both ends.
    pub fn is_name(name: &str) -> bool {
        const MOST: usize = 100;
        let ends = |c: Option<char>| c.is_some_and(|c| c.is_alphanumeric() || c == '_');
        let mut letters = name.chars();
        let inside = unprintable(name).is_none() && !name.contains(['/', ',', '\\']);
        inside
            && name.chars().count() <= MOST
            && ends(letters.next())
            && (letters.as_str().is_empty() || ends(letters.next_back()))
    }

    pub fn string(&mut self, value: &'a Value<'a>, what: &str) -> Option<&'a str> {
        match value.get_ref().as_str() {
            Some(text) => Some(text),
            None => self.wrong_type(value, what, "a string"),
        }
    }

    pub fn table(&mut self, value: &'a Value<'a>, span: Span, what: &str) -> Option<Section<'a>> {
        match value.get_ref() {
            DeValue::Table(table) => Some(Section::new(what, span, table)),
            _ => self.wrong_type(value, what, "a table"),
        }
    }

    /// The elements of an array that must have `names.len()` of them.
    pub fn array(
        &mut self,
        value: &'a Value<'a>,
        what: &str,
        names: &str,
        length: usize,
    ) -> Option<&'a [Value<'a>]> {
        match value.get_ref() {
            DeValue::Array(array) if array.len() == length => Some(array),
            DeValue::Array(array) => {
                let message = format!("{what} must be {names}, not {} values", array.len());
                self.refuse(value.span(), message, format!("expected {names}"))
            }
            _ => self.wrong_type(value, what, names),
        }
    }

    /// The expression at a string or number. All problems in it are reported.
    pub fn expression(&mut self, value: &'a Value<'a>, purpose: &Use<'_>) -> Option<Built> {
        let number = match value.get_ref() {
            DeValue::String(text) => {
                let origin = self.origin(value, text);
                return self.parse_and_build(text, &origin, purpose);
            }
            DeValue::Integer(integer) => match integer.radix() {
                10 => integer.as_str().parse::<f64>().ok(),
                radix => i128::from_str_radix(integer.as_str(), radix)
                    .ok()
                    .map(|v| v as f64),
            },
            DeValue::Float(float) => float.as_str().parse::<f64>().ok(),
            _ => {
                return self.wrong_type(value, purpose.what, "a number or an expression in quotes");
            }
        };
        match number.filter(|v| v.is_finite()) {
            Some(v) => Some(Built {
                expr: self.graph.constant(v),
                kinds: super::scope::Kinds::NONE,
            }),
            None => self.refuse(
                value.span(),
                format!("{} is not finite", purpose.what),
                "no finite number",
            ),
        }
    }

    /// As [`Self::expression`], for text from anywhere.
    pub fn parse_and_build(
        &mut self,
        text: &str,
        origin: &Origin,
        purpose: &Use<'_>,
    ) -> Option<Built> {
        match parse_expression(text) {
            Ok(tree) => self.build(&tree, origin, purpose),
            Err(error) => {
                self.report(origin.syntax_problem(error));
                None
            }
        }
    }

    /// The two sides of a guard and the comparison between them.
    pub fn guard(
        &mut self,
        value: &'a Value<'a>,
        purpose: &Use<'_>,
    ) -> Option<(Id, super::lexer::Relation, Id)> {
        let DeValue::String(text) = value.get_ref() else {
            return self.wrong_type(value, purpose.what, "a comparison in quotes");
        };
        let origin = self.origin(value, text);
        match parse_guard(text) {
            Ok(guard) => self
                .build_guard(&guard, &origin, purpose)
                .map(|(a, b)| (a, guard.relation, b)),
            Err(error) => {
                self.report(origin.syntax_problem(error));
                None
            }
        }
    }

    /// Where the characters of a string value stand.
    pub fn origin(&self, value: &Value<'_>, text: &str) -> Origin {
        Origin::File {
            offsets: Offsets::of(self.text, &value.span(), text),
            whole: value.span(),
        }
    }

    /// A finite number, given as one or as an expression of parameters.
    pub fn number(&mut self, value: &'a Value<'a>, what: &str) -> Option<f64> {
        let built = self.expression(value, &Use::number(what))?;
        let number = self.graph.eval(&[built.expr], &self.values)[0];
        if number.is_finite() {
            return Some(number);
        }
        self.refuse(value.span(), format!("{what} is {number}"), "not finite")
    }

    /// A number that satisfies `rule`, which `wanted` says in words ("greater than 0").
    pub fn number_that(
        &mut self,
        value: &'a Value<'a>,
        what: &str,
        wanted: &str,
        rule: impl Fn(f64) -> bool,
    ) -> Option<f64> {
        let number = self.number(value, what)?;
        if rule(number) {
            return Some(number);
        }
        self.refuse(
            value.span(),
            format!("{what} must be {wanted}, not {}", plain(number)),
            format!("this is {}", plain(number)),
        )
    }

    /// A whole number of at least `least`.
    pub fn count(&mut self, value: &'a Value<'a>, what: &str, least: u32) -> Option<usize> {
        self.count_to(value, what, least, u32::MAX)
    }

    /// A whole number of at least `least` and at most `most`.
    pub fn count_to(
        &mut self,
        value: &'a Value<'a>,
        what: &str,
        least: u32,
        most: u32,
    ) -> Option<usize> {
        // The least is what matters, unless it is the most that is not kept.
        let wanted = match plain_number(value) {
            Some(v) if v > f64::from(most) => format!("a whole number from {least} to {most}"),
            _ => format!("a whole number of at least {least}"),
        };
        let fits = |v: f64| v.fract() == 0.0 && v >= f64::from(least) && v <= f64::from(most);
        self.number_that(value, what, &wanted, fits)
            .map(|v| v as usize)
    }

    /// A truth value.
    pub fn yes_or_no(&mut self, value: &'a Value<'a>, what: &str) -> Option<bool> {
        match value.get_ref() {
            DeValue::Boolean(value) => Some(*value),
            _ => self.refuse(
                value.span(),
                format!("{what} must be true or false"),
                "expected true or false",
            ),
        }
    }

    /// One of the named choices.
    pub fn choice<T: Copy>(
        &mut self,
        value: &'a Value<'a>,
        what: &str,
        choices: &[(&str, T)],
    ) -> Option<T> {
        let text = self.string(value, what)?;
        if let Some((_, choice)) = choices.iter().find(|(name, _)| *name == text) {
            return Some(*choice);
        }
        let names: Vec<&str> = choices.iter().map(|(n, _)| *n).collect();
        let help = did_you_mean(text, names.iter().copied())
            .unwrap_or_else(|| format!("known: {}", names.join(", ")));
        let message = format!("unknown {what} `{}`", shorten(text));
        self.report(Problem::at(value.span(), message, "not known").with_help(help));
        None
    }
}

/// A number that is written as one, not as an expression.
fn plain_number(value: &Value<'_>) -> Option<f64> {
    let text = match value.get_ref() {
        DeValue::Integer(number) => number.as_str(),
        DeValue::Float(number) => number.as_str(),
        _ => return None,
    };
    text.replace('_', "").parse().ok()
}
