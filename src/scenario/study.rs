//! `[study]`: the optimal trajectory from one state, for several values of parameters.

use super::closed_loop::LoopScope;
use super::reader::{Reader, Section, Value};
use super::scope::Role;
use crate::diagnostics::Problem;
use crate::diagnostics::did_you_mean;
use crate::diagnostics::shorten;
use crate::model::Study;
use crate::schema;
use toml::de::DeValue;

/// Variants of one study.
const MOST_VARIANTS: usize = 10_000;
/// Stored points of one trajectory.
const MOST_SAMPLES: usize = 100_000;
/// Stored points a trajectory unless `samples` says otherwise.
const DEFAULT_SAMPLES: usize = 200;

impl<'a> Reader<'a> {
    /// `[study]`; `None` where something in it is wrong.
    pub fn study(&mut self, section: &Section<'a>, scope: &LoopScope<'_, 'a>) -> Option<Study> {
        self.check_keys(section, "study");
        let before = self.problems.len();
        let vary = match section.get("vary") {
            Some(value) => self.varied(value, section),
            None => Vec::new(),
        };
        let from = self.study_state(section, scope);
        let samples = section.get("samples").and_then(|v| self.sample_count(v));
        let records = section
            .get("record")
            .map(|v| self.records("study", section, v, scope));
        let variants = vary
            .iter()
            .fold(1usize, |n, (_, values)| n.saturating_mul(values.len()));
        if variants > MOST_VARIANTS {
            let message =
                format!("{variants} variants; at most {MOST_VARIANTS} are studied at once");
            return self.refuse(section.key_span("vary"), message, "too many");
        }
        (self.problems.len() == before).then_some(())?;
        Some(Study {
            vary,
            from: from?,
            records: records.unwrap_or_default(),
            samples: samples.unwrap_or(DEFAULT_SAMPLES),
            span: section.span.clone(),
        })
    }

    /// Stored points of a trajectory.
    pub fn sample_count(&mut self, value: &'a Value<'a>) -> Option<usize> {
        let wanted = format!("a whole number from 2 to {MOST_SAMPLES}");
        let fits = |v: f64| v.fract() == 0.0 && (2.0..=MOST_SAMPLES as f64).contains(&v);
        self.number_that(value, "samples", &wanted, fits)
            .map(|v| v as usize)
    }

    fn varied(&mut self, value: &'a Value<'a>, section: &Section<'a>) -> Vec<(String, Vec<f64>)> {
        let Some(table) = self.table(value, section.key_span("vary"), "vary") else {
            return Vec::new();
        };
        let mut all = Vec::new();
        for (name, span, value) in table.entries() {
            if schema::STUDY.reserves(name) {
                let message = format!(
                    "a parameter named `{name}` cannot be varied: the table has a column of that name"
                );
                self.report(Problem::at(span, message, "rename the parameter"));
                continue;
            }
            if self
                .scope
                .get(name)
                .is_none_or(|e| e.role != Role::Parameter)
            {
                let names: Vec<&str> = self.scope.names(Some(Role::Parameter)).collect();
                let help = did_you_mean(name, names.iter().copied());
                let help = help.unwrap_or_else(|| format!("parameters: {}", names.join(", ")));
                let message = format!("`{}` is not a parameter", shorten(name));
                self.report(
                    Problem::at(span, message, "only parameters are varied").with_help(help),
                );
                continue;
            }
            let what = format!("the values of `{}`", shorten(name));
            let DeValue::Array(array) = value.get_ref() else {
                self.report(Problem::at(
                    value.span(),
                    format!("{what} must be a list"),
                    "expected [..., ...]",
                ));
                continue;
            };
            if array.is_empty() {
                self.report(Problem::at(
                    value.span(),
                    format!("{what} are none"),
                    "empty",
                ));
                continue;
            }
            let values: Vec<f64> = array.iter().filter_map(|v| self.number(v, &what)).collect();
            if values.len() == array.len() {
                all.push((name.to_owned(), values));
            }
        }
        all
    }

    fn study_state(
        &mut self,
        section: &Section<'a>,
        scope: &LoopScope<'_, 'a>,
    ) -> Option<Vec<f64>> {
        let Some(value) = section.get("from") else {
            let problem = Problem::at(
                section.span.clone(),
                "[study] has no state to start from",
                "`from` is missing",
            );
            self.report(problem.with_help(
                "add from = { ... }, a value a state; states not named: the equilibrium",
            ));
            return None;
        };
        let table = self.table(value, section.key_span("from"), "from")?;
        self.entries_of(&table, scope.states, "states");
        let values: Vec<Option<f64>> = (scope.states.iter().enumerate())
            .map(|(i, state)| match table.get(state.name) {
                Some(value) => {
                    self.number(value, &format!("`{}` to start from", shorten(state.name)))
                }
                None => scope.reference.and_then(|r| r.get(i)).copied(),
            })
            .collect();
        values.into_iter().collect()
    }
}
