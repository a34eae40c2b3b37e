//! `[feedback]`: one law in the section itself, or several in tables `[feedback.NAME]`.

use super::declare::{Declarations, Declared};
use super::keys::keys_of;
use super::lexer::is_identifier;
use super::reader::{Reader, Section, Value};
use crate::diagnostics::Problem;
use crate::diagnostics::shorten;
use crate::model::{Activation, Base, Feedback, Guard, LawOutput, Target};
use toml::de::DeValue;

/// Name of the law of an undivided section.
const ONLY: &str = "network";
/// Laws that there are without a fit.
const BUILT_IN: [&str; 2] = ["lqr", "map"];

const DEFAULT_HIDDEN: usize = 10;
const DEFAULT_STARTS: usize = 5;
/// Trainings of a law, at most.
const MOST_STARTS: u32 = 1000;
const DEFAULT_ITERATIONS: usize = 500;
const DEFAULT_PATIENCE: usize = 30;
const DEFAULT_MAX_SAMPLES: usize = 20_000;
const DEFAULT_SHARE: f64 = 0.15;
/// Units of a layer, and hidden layers.
const MOST_UNITS: usize = 1000;
const MOST_LAYERS: usize = 8;

#[derive(Clone, Copy, PartialEq)]
enum Fit {
    Law,
    Value,
}

/// Whether the section has a table a law.
fn is_divided(section: &Section<'_>) -> bool {
    let table = |v: &Value<'_>| matches!(v.get_ref(), DeValue::Table(_));
    let keys = keys_of("feedback");
    let mut entries = section.entries().peekable();
    entries.peek().is_some() && entries.all(|(key, _, value)| table(value) && !keys.contains(&key))
}

/// Names of the laws that the section asks for, right or wrong.
pub(super) fn law_names(section: &Section<'_>) -> Vec<String> {
    if is_divided(section) {
        section
            .entries()
            .map(|(name, ..)| name.to_owned())
            .collect()
    } else {
        vec![ONLY.to_owned()]
    }
}

impl<'a> Reader<'a> {
    /// All laws of `[feedback]`; `finite`: the horizon is.
    pub fn feedback(
        &mut self,
        section: &Section<'a>,
        declared: &Declarations<'a>,
        region: Option<&[[f64; 2]]>,
        finite: bool,
    ) -> Vec<Feedback> {
        if finite {
            let message =
                "[feedback] needs an infinite horizon: with a final time the law depends on time";
            self.report(Problem::at(section.span.clone(), message, "remove this"));
        }
        if !is_divided(section) {
            return self
                .law(ONLY, section, declared, region)
                .into_iter()
                .collect();
        }
        let mut laws = Vec::new();
        for (name, span, value) in section.entries() {
            if !is_identifier(name) || !Self::is_name(name) || BUILT_IN.contains(&name) {
                let message = format!("a law cannot be called `{}`", shorten(name));
                let help = format!(
                    "names of letters, digits and _, not {}",
                    BUILT_IN.join(" or ")
                );
                self.report(
                    Problem::at(span.clone(), message, "not a name for a law").with_help(help),
                );
            }
            if let Some(table) = self.table(value, span, &format!("[feedback.{}]", shorten(name))) {
                laws.extend(self.law(name, &table, declared, region));
            }
        }
        laws
    }

    /// One law; `None` where a problem of it has been reported, or the region is not known.
    fn law(
        &mut self,
        name: &str,
        section: &Section<'a>,
        declared: &Declarations<'a>,
        region: Option<&[[f64; 2]]>,
    ) -> Option<Feedback> {
        let before = self.problems.len();
        self.check_keys(section, "feedback");
        let fit = self.fit(section);
        let target = fit.and_then(|fit| self.target(section, fit, declared));
        let inputs = target
            .as_ref()
            .and_then(|t| self.inputs(section, t, declared));
        let bounds = self.bounds(section, &declared.states, region);
        let conditions = self.conditions(section);
        let [validation, test] = self.shares(section);
        let base = self.base(section, target.as_ref());
        let counted = |reader: &mut Self, key: &str, least, default| {
            let value = section.get(key);
            value
                .and_then(|v| reader.count(v, key, least))
                .unwrap_or(default)
        };
        let feedback = Feedback {
            name: name.to_owned(),
            hidden: self.hidden(section),
            activation: (section.get("activation"))
                .and_then(|v| self.choice(v, "activation", &Activation::ALL))
                .unwrap_or(Activation::Logistic),
            base,
            bounds: bounds.unwrap_or_default(),
            conditions,
            value_max: (section.get("value_max"))
                .and_then(|v| self.number_that(v, "value_max", "greater than 0", |v| v > 0.0)),
            starts: (section.get("starts"))
                .and_then(|v| self.count_to(v, "starts", 1, MOST_STARTS))
                .unwrap_or(DEFAULT_STARTS),
            seed: counted(self, "seed", 0, 0) as u64,
            iterations: counted(self, "iterations", 1, DEFAULT_ITERATIONS),
            patience: counted(self, "patience", 1, DEFAULT_PATIENCE),
            max_samples: counted(self, "max_samples", 10, DEFAULT_MAX_SAMPLES),
            gradient: self.gradient(section, fit),
            validation,
            test,
            span: section.span.clone(),
            target: target.unwrap_or(Target::Value),
            inputs: inputs.unwrap_or_default(),
        };
        // Without a region the states' bounds are unknown, which is reported elsewhere.
        (self.problems.len() == before && region.is_some()).then_some(feedback)
    }

    /// What is fitted; reported where the section does not say.
    fn fit(&mut self, section: &Section<'a>) -> Option<Fit> {
        match section.get("fit") {
            Some(value) => self.choice(value, "fit", &[("u", Fit::Law), ("V", Fit::Value)]),
            None => {
                let problem = Problem::at(
                    section.span.clone(),
                    format!("{} has no fit", section.name),
                    "`fit` is missing",
                );
                self.report(problem.with_help(
                    "add fit = \"u\" (the law itself) or fit = \"V\" (the value function)",
                ));
                None
            }
        }
    }

    /// Shares of the trajectories for validation and test.
    fn shares(&mut self, section: &Section<'a>) -> [f64; 2] {
        let shares = ["validation", "test"].map(|key| self.share(section, key));
        let [validation, test] = shares;
        if validation + test > 0.9 {
            let span = section.key_span("test");
            self.refuse::<()>(
                span,
                "validation and test leave less than a tenth for training",
                "too large together",
            );
        }
        shares
    }

    /// Strings of an array, or one string, with the values they come from.
    fn words(&mut self, value: &'a Value<'a>, what: &str) -> Option<Vec<(&'a str, &'a Value<'a>)>> {
        let values: Vec<&'a Value<'a>> = match value.get_ref() {
            DeValue::Array(array) => array.iter().collect(),
            _ => vec![value],
        };
        if values.is_empty() {
            return self.refuse(value.span(), format!("{what} is empty"), "at least one");
        }
        values
            .into_iter()
            .map(|v| self.string(v, what).map(|s| (s, v)))
            .collect()
    }

    fn target(
        &mut self,
        section: &Section<'a>,
        fit: Fit,
        declared: &Declarations<'a>,
    ) -> Option<Target> {
        let output = section.get("output");
        match (fit, output) {
            (Fit::Value, None) => return Some(Target::Value),
            (Fit::Value, Some(_)) => {
                let message = "output has no meaning with fit = \"V\": all controls follow from V";
                return self.refuse(section.key_span("output"), message, "remove this");
            }
            (Fit::Law, None) => {
                return Some(Target::Law(
                    (0..declared.controls.len())
                        .map(LawOutput::Control)
                        .collect(),
                ));
            }
            (Fit::Law, Some(_)) => {}
        }
        let mut outputs: Vec<LawOutput> = Vec::new();
        for (name, value) in self.words(output?, "output")? {
            let at = |list: &[Declared<'_>]| list.iter().position(|d| d.name == name);
            let found = at(&declared.controls).map(LawOutput::Control);
            let Some(found) = found.or_else(|| at(&declared.states).map(LawOutput::State)) else {
                let known = declared
                    .controls
                    .iter()
                    .chain(&declared.states)
                    .map(|d| d.name);
                let message = format!("`{}` is neither a control nor a state", shorten(name));
                return self.unknown((name, value.span()), message, "not known", known);
            };
            if outputs.contains(&found) {
                return self.refuse(
                    value.span(),
                    format!("output `{}` a second time", shorten(name)),
                    "once is enough",
                );
            }
            outputs.push(found);
        }
        Some(Target::Law(outputs))
    }

    fn inputs(
        &mut self,
        section: &Section<'a>,
        target: &Target,
        declared: &Declarations<'a>,
    ) -> Option<Vec<usize>> {
        let states = &declared.states;
        let commanded =
            |i: usize| matches!(target, Target::Law(list) if list.contains(&LawOutput::State(i)));
        let Some(value) = section.get("inputs") else {
            return Some((0..states.len()).filter(|i| !commanded(*i)).collect());
        };
        let mut inputs: Vec<usize> = Vec::new();
        for (name, value) in self.words(value, "inputs")? {
            let Some(i) = states.iter().position(|d| d.name == name) else {
                let message = format!("`{}` is not a state", shorten(name));
                let known = states.iter().map(|d| d.name);
                return self.unknown((name, value.span()), message, "not known", known);
            };
            if inputs.contains(&i) || commanded(i) {
                let reason = if commanded(i) {
                    "is the output"
                } else {
                    "a second time"
                };
                return self.refuse(
                    value.span(),
                    format!("input `{}` {reason}", shorten(name)),
                    "remove this",
                );
            }
            inputs.push(i);
        }
        if *target == Target::Value && inputs.len() < states.len() {
            return self.refuse(
                value.span(),
                "V is a function of all states",
                "a state is missing",
            );
        }
        Some(inputs)
    }

    fn hidden(&mut self, section: &Section<'a>) -> Vec<usize> {
        let Some(value) = section.get("hidden") else {
            return vec![DEFAULT_HIDDEN];
        };
        let values: Vec<&'a Value<'a>> = match value.get_ref() {
            DeValue::Array(array) if array.len() <= MOST_LAYERS => array.iter().collect(),
            _ => {
                let message = format!(
                    "hidden must be a list of at most {MOST_LAYERS} whole numbers, the units of each hidden layer"
                );
                self.refuse::<()>(value.span(), message, "expected a list");
                return Vec::new();
            }
        };
        let wanted = format!("a whole number from 1 to {MOST_UNITS}");
        let fits = |v: f64| v.fract() == 0.0 && v >= 1.0 && v <= MOST_UNITS as f64;
        let units = values
            .into_iter()
            .filter_map(|v| self.number_that(v, "a layer's number of units", &wanted, fits));
        units.map(|v| v as usize).collect()
    }

    fn base(&mut self, section: &Section<'a>, target: Option<&Target>) -> Base {
        let default = if target == Some(&Target::Value) {
            Base::Local
        } else {
            Base::None
        };
        let Some(value) = section.get("base") else {
            return default;
        };
        let choices = [("none", Base::None), ("local", Base::Local)];
        let base = self.choice(value, "base", &choices).unwrap_or(default);
        if let (Base::Local, Some(Target::Law(outputs))) = (base, target)
            && outputs.iter().any(|o| matches!(o, LawOutput::State(_)))
        {
            let message = "base = \"local\" is for controls: the local solution commands no states";
            self.refuse::<()>(value.span(), message, "write \"none\"");
        }
        base
    }

    fn bounds(
        &mut self,
        section: &Section<'a>,
        states: &[Declared<'a>],
        region: Option<&[[f64; 2]]>,
    ) -> Option<Vec<[f64; 2]>> {
        let region = region?;
        let mut bounds = region.to_vec();
        if let Some(value) = section.get("box") {
            let table = self.table(value, section.key_span("box"), "box")?;
            self.entries_of(&table, states, "states");
            for (state, bound) in states.iter().zip(&mut bounds) {
                if let Some(value) = table.get(state.name) {
                    *bound =
                        self.interval(value, &format!("the box of `{}`", shorten(state.name)))?;
                }
            }
        }
        Some(bounds)
    }

    fn conditions(&mut self, section: &Section<'a>) -> Vec<Guard> {
        let Some(value) = section.get("where") else {
            return Vec::new();
        };
        let values: Vec<&'a Value<'a>> = match value.get_ref() {
            DeValue::Array(array) => array.iter().collect(),
            _ => vec![value],
        };
        (values.into_iter())
            .filter_map(|v| {
                self.condition(
                    v.get_ref().as_str().unwrap_or(""),
                    "a condition of `where`",
                    v,
                )
            })
            .collect()
    }

    fn share(&mut self, section: &Section<'a>, key: &str) -> f64 {
        let value = section.get(key);
        let share = value
            .and_then(|v| self.number_that(v, key, "above 0 and below 1", |s| s > 0.0 && s < 1.0));
        share.unwrap_or(DEFAULT_SHARE)
    }

    fn gradient(&mut self, section: &Section<'a>, fit: Option<Fit>) -> bool {
        let Some(value) = section.get("gradient") else {
            return fit == Some(Fit::Value);
        };
        match (value.get_ref(), fit) {
            (DeValue::Boolean(_), Some(Fit::Law)) => {
                let message = "gradient has no meaning with fit = \"u\"";
                self.refuse::<()>(section.key_span("gradient"), message, "remove this");
                false
            }
            (DeValue::Boolean(gradient), _) => *gradient,
            _ => {
                self.refuse::<()>(
                    value.span(),
                    "gradient must be true or false",
                    "expected true or false",
                );
                false
            }
        }
    }
}
