//! `[report]`, and constants written on the command line.

use super::build::{Origin, Use};
use super::declare::Declared;
use super::reader::{Reader, Section, Value};
use super::scope::{Entry, Kinds, Meaning, Role};
use crate::diagnostics::Problem;
use crate::diagnostics::did_you_mean;
use crate::diagnostics::shorten;
use crate::model::{Model, Report};
use crate::numeric::digits::plain;
use toml::de::{DeTable, DeValue};

impl<'a> Reader<'a> {
    /// `[report]`; `region` bounds the slice.
    pub fn report_section(
        &mut self,
        section: &Section<'a>,
        states: &[Declared<'a>],
        region: Option<&[[f64; 2]]>,
    ) -> Option<Report> {
        self.check_keys(section, "report");
        let before = self.problems.len();
        let levels = section
            .get("levels")
            .map_or_else(Vec::new, |v| self.levels(v));
        let axes = section
            .get("axes")
            .and_then(|v| self.report_axes(v, states));
        let mut slice = Vec::new();
        if let Some(value) = section.get("slice")
            && let Some(table) =
                self.table(value, section.key_span("slice"), "the slice of [report]")
        {
            self.entries_of(&table, states, "states");
            for (name, span, value) in table.entries() {
                let Some(k) = states.iter().position(|s| s.name == name) else {
                    continue;
                };
                let what = format!("the slice's `{}`", shorten(name));
                let Some(number) = self.number(value, &what) else {
                    continue;
                };
                if let Some([from, to]) = region.and_then(|r| r.get(k))
                    && !(number >= *from && number <= *to)
                {
                    let (number, from, to) = (plain(number), plain(*from), plain(*to));
                    let message =
                        format!("{what} is {number}, outside the region, which is {from} to {to}");
                    self.report(Problem::at(value.span(), message, "outside the region"));
                } else if axes.as_ref().is_some_and(|a| a.iter().any(|a| a == name)) {
                    let message =
                        format!("{what} is one of the picture's axes, and has no fixed value");
                    self.report(Problem::at(span, message, "an axis"));
                } else {
                    slice.push((name.to_owned(), number));
                }
            }
        }
        (self.problems.len() == before).then_some(Report {
            levels,
            slice,
            axes,
        })
    }

    fn levels(&mut self, value: &'a Value<'a>) -> Vec<f64> {
        let DeValue::Array(array) = value.get_ref() else {
            // A single one is good, too.
            return self.number(value, "the level").into_iter().collect();
        };
        array
            .iter()
            .filter_map(|v| self.number(v, "a level of [report]"))
            .collect()
    }

    fn report_axes(
        &mut self,
        value: &'a Value<'a>,
        states: &[Declared<'a>],
    ) -> Option<[String; 2]> {
        let names = self.array(value, "axes", "the names of two states", 2)?;
        let mut found = Vec::new();
        for name in names {
            let text = self.string(name, "an axis")?;
            if !states.iter().any(|s| s.name == text) {
                let message = format!(
                    "[report] has an axis `{}`, which is no state",
                    shorten(text)
                );
                let help = did_you_mean(text, states.iter().map(|s| s.name));
                self.report(Problem {
                    help,
                    ..Problem::at(name.span(), message, "not a state")
                });
                return None;
            }
            found.push(text.to_owned());
        }
        let [a, b] = <[String; 2]>::try_from(found).ok()?;
        if a == b {
            return self.refuse(
                value.span(),
                "the two axes of [report] are the same",
                "two different states",
            );
        }
        Some([a, b])
    }
}

/// The number that a text stands for: an expression of numbers and the scene's parameters.
///
/// # Errors
/// What is wrong with it, in words.
pub fn constant(text: &str, model: &Model) -> Result<f64, String> {
    let mut reader = Reader::new("");
    for parameter in &model.parameters {
        let expr = reader.graph.constant(parameter.value);
        let meaning = Meaning::Known {
            expr,
            kinds: Kinds::PARAMETER,
        };
        let role = Role::Parameter;
        reader.scope.declare(
            &parameter.name,
            Entry {
                role,
                span: 0..0,
                meaning,
            },
        );
    }
    let typed = shorten(text);
    let origin = Origin::CommandLine(typed.clone());
    let built = reader.parse_and_build(text, &origin, &Use::number("this"));
    let Some(built) = built else {
        let problem = reader
            .problems
            .first()
            .map_or_else(|| "not a number".to_owned(), |p| p.message.clone());
        let prefix = format!("--set {typed}: ");
        return Err(problem.strip_prefix(&prefix).unwrap_or(&problem).to_owned());
    };
    let number = reader.graph.eval(&[built.expr], &reader.values)[0];
    if number.is_finite() {
        Ok(number)
    } else {
        Err(format!("it is {number}"))
    }
}

/// Names and texts of a scene's definitions, as written; none where the text is no TOML.
pub fn definitions(text: &str) -> Vec<(String, String)> {
    let (document, errors) = DeTable::parse_recoverable(text);
    let section = document.get_ref().get("definitions");
    match section.map(|s| s.get_ref()) {
        Some(DeValue::Table(table)) if errors.is_empty() => entries(text, table),
        _ => Vec::new(),
    }
}

/// What a scene says of its mechanism, as written: `gravity`, `body NAME`, `point NAME` and so on.
pub fn mechanism(text: &str) -> Vec<(String, String)> {
    let (document, errors) = DeTable::parse_recoverable(text);
    let section = document.get_ref().get("mechanism");
    let Some(DeValue::Table(section)) = section.map(|s| s.get_ref()) else {
        return Vec::new();
    };
    let mut all = Vec::new();
    for (key, value) in section.iter().filter(|_| errors.is_empty()) {
        let key = key.get_ref().to_string();
        let noun = match key.as_str() {
            "bodies" => "body",
            "points" => "point",
            "contacts" => "contact",
            "forces" => "force",
            other => other,
        };
        match value.get_ref() {
            DeValue::Table(table) => {
                let own = entries(text, table).into_iter();
                all.extend(own.map(|(name, value)| (format!("{noun} {name}"), value)));
            }
            _ => all.push((key, written(text, value))),
        }
    }
    all
}

fn entries(text: &str, table: &DeTable<'_>) -> Vec<(String, String)> {
    table
        .iter()
        .map(|(k, v)| (k.get_ref().to_string(), written(text, v)))
        .collect()
}

/// A value as it is written; a table under a heading of its own on one line.
fn written(text: &str, value: &Value<'_>) -> String {
    match value.get_ref() {
        DeValue::String(s) => s.to_string(),
        DeValue::Table(table) => {
            let own = table.iter().map(|(k, v)| match v.get_ref() {
                DeValue::Table(_) => format!("{} = {}", k.get_ref(), written(text, v)),
                _ => format!(
                    "{} = {}",
                    k.get_ref(),
                    text.get(v.span()).unwrap_or_default()
                ),
            });
            format!("{{ {} }}", own.collect::<Vec<_>>().join(", "))
        }
        _ => text.get(value.span()).unwrap_or_default().to_owned(),
    }
}
