//! A file as a whole: its sections, and the order in which they are read.

use super::closed_loop::LoopScope;
use super::declare::Declarations;
use super::document::Given;
use super::equations::Cost;
use super::equilibrium::{Equilibrium, Scene};
use super::feedback::law_names;
use super::hints;
use super::keys;
use super::parser::{parse_expression, parse_guard};
use super::reader::{Reader, Section};
use super::scope::Role;
use crate::diagnostics::Problem;
use crate::diagnostics::did_you_mean;
use crate::diagnostics::position;
use crate::diagnostics::shorten;
use crate::model::{Horizon, Model, Variable};
use crate::schema;
use std::collections::HashMap;
use std::path::Path;
use toml::de::{DeTable, DeValue};

/// Sections whose strings are expressions.
const EXPRESSIONS: [&str; 6] = [
    "parameters",
    "definitions",
    "dynamics",
    "cost",
    "equilibrium",
    "region",
];

type Sections<'a> = HashMap<&'static str, Section<'a>>;

impl<'a> Reader<'a> {
    /// What the TOML parser refused. One error a line: what follows on the same line is often a
    /// consequence.
    pub(super) fn toml_problems(&mut self, errors: &[toml::de::Error]) {
        let end = self.text.len();
        let mut errors: Vec<_> = errors
            .iter()
            .map(|e| (e.span().unwrap_or(end..end), e.message()))
            .collect();
        errors.sort_by_key(|(span, _)| span.start);
        let mut last = None;
        for (span, message) in errors {
            let between =
                &self.text.as_bytes()[last.unwrap_or(0).min(span.start)..span.start.min(end)];
            if last.is_none() || between.contains(&b'\n') {
                self.report(Problem::at(
                    span.clone(),
                    format!("TOML: {message}"),
                    "here",
                ));
            }
            last = Some(span.start);
        }
    }

    /// Syntax errors of the expressions in a file that is not good TOML: they do not depend on the
    /// rest.
    pub(super) fn expression_syntax(&mut self, root: &'a DeTable<'a>) {
        let bad_lines: Vec<usize> = self
            .problems
            .iter()
            .filter_map(|p| Some(position(self.text, p.span.as_ref()?.start).0))
            .collect();
        for (key, section) in root.iter() {
            let guards = key.get_ref() == "guards";
            let DeValue::Table(table) = section.get_ref() else {
                continue;
            };
            if !guards && !EXPRESSIONS.contains(&key.get_ref().as_ref()) {
                continue;
            }
            for (_, value) in table.iter() {
                let DeValue::String(text) = value.get_ref() else {
                    continue;
                };
                let span = value.span();
                let lines = position(self.text, span.start).0..=position(self.text, span.end).0;
                if bad_lines.iter().any(|l| lines.contains(l)) {
                    continue;
                }
                let error = if guards {
                    parse_guard(text).err()
                } else {
                    parse_expression(text).err()
                };
                if let Some(error) = error {
                    let origin = self.origin(value, text);
                    self.report(origin.syntax_problem(error));
                }
            }
        }
    }

    /// The sections of the file, and the title.
    fn sections(&mut self, root: &'a DeTable<'a>) -> (Sections<'a>, Option<String>) {
        let mut sections = Sections::new();
        let mut title = None;
        for (key, value) in root.iter() {
            let (name, span) = (key.get_ref().as_ref(), key.span());
            let known = keys::sections();
            if name == "title" {
                title = self.text_of_lines(value, "the title").map(str::to_owned);
            } else if let Some(known) = known.clone().find(|s| *s == name) {
                if let Some(section) = self.table(value, span, &format!("[{name}]")) {
                    sections.insert(known, section);
                }
            } else {
                let hint = hints::of_key("", name).map(str::to_owned);
                let help = hint
                    .or_else(|| did_you_mean(name, known.clone().chain(["title"])))
                    .unwrap_or_else(|| {
                        format!("sections: {}", known.collect::<Vec<_>>().join(", "))
                    });
                let message = match value.get_ref() {
                    DeValue::Table(_) => format!("unknown section [{}]", shorten(name)),
                    _ => format!("unknown key `{}` outside any section", shorten(name)),
                };
                self.report(Problem::at(span, message, "not part of a scenario").with_help(help));
            }
        }
        (sections, title)
    }

    /// Reports a required section that is missing, unless it is there with a wrong type (which has
    /// been reported).
    fn require(
        &mut self,
        root: &DeTable<'_>,
        sections: &Sections<'a>,
        name: &'static str,
        what: &str,
    ) {
        let message = match sections.get(name) {
            Some(section) if section.entries().next().is_none() => format!("[{name}] is empty"),
            None if !root.contains_key(name) => format!("section [{name}] is missing"),
            _ => return,
        };
        let span = sections.get(name).map(|s| s.span.clone());
        let help = Some(format!("it gives {what}"));
        self.report(Problem {
            message,
            span,
            label: "nothing in it".to_owned(),
            help,
        });
    }

    fn declarations(&mut self, sections: &Sections<'a>) -> Declarations<'a> {
        let mut of = |name: &str, role| self.declare(sections.get(name), role);
        Declarations {
            parameters: of("parameters", Role::Parameter),
            states: of("states", Role::State),
            controls: of("controls", Role::Control),
            disturbances: of("disturbances", Role::Disturbance),
            definitions: of("definitions", Role::Definition),
        }
    }

    /// Everything, with an empty graph in the place of the reader's; `None` only after a report.
    pub(super) fn model(
        &mut self,
        root: &'a DeTable<'a>,
        file_name: &str,
        overrides: &[(String, Given)],
    ) -> Option<Model> {
        let (sections, title) = self.sections(root);
        self.require(
            root,
            &sections,
            "states",
            "the states, in the order of the output's axes",
        );
        self.require(root, &sections, "controls", "the controls");
        // Where these are there, what they lack is reported entry by entry.
        for (name, what) in [
            ("dynamics", "the time derivative of each state"),
            ("cost", "the running cost"),
        ] {
            if !sections.contains_key(name) {
                self.require(root, &sections, name, what);
            }
        }
        self.require(
            root,
            &sections,
            "region",
            "bounds [lower, upper] for each state",
        );
        let declared = self.declarations(&sections);
        let parameters = self.parameters(&declared.parameters, overrides);
        self.definitions(&declared.definitions);
        let game = !declared.disturbances.is_empty();
        let mut notes = Vec::new();
        let mut states = self.states(&declared.states);
        // In a game the lower of V(x) and V(x + period) is no value: an angle counts as it is
        // written.
        if let (true, Some(states)) = (game, &mut states) {
            for state in states.iter_mut().filter(|s| s.period.is_some()) {
                state.period = None;
                notes.push(format!(
                    "a game: the period of `{}` is not used, and the angle counts as it is written",
                    state.variable.name
                ));
            }
        }
        let controls = self.controls(&declared.controls);
        let disturbances = self.disturbances(&declared.disturbances);
        let dynamics = sections
            .get("dynamics")
            .and_then(|s| self.dynamics(s, &declared.states));
        let cost = sections
            .get("cost")
            .map(|s| self.cost(s))
            .unwrap_or_default();
        let guards = sections
            .get("guards")
            .map(|s| self.guards(s))
            .unwrap_or_default();
        let region = sections
            .get("region")
            .filter(|s| s.entries().next().is_some())
            .and_then(|s| self.region(s, &declared.states));
        let equilibrium = sections.get("equilibrium").and_then(|s| {
            self.equilibrium(
                s,
                &declared.states,
                &declared.controls,
                &declared.disturbances,
            )
        });
        self.require_horizon(root, &sections, &cost);
        if let (Some(at), Some(states), Some(controls)) = (&equilibrium, &states, &controls) {
            let states: Vec<&Variable> = states.iter().map(|s| &s.variable).collect();
            self.check_equilibrium_range(at, &states, controls, region.as_deref(), cost.finite);
        }
        if let (Some(all), Some(controls), Some(dynamics), Some(running), Some(disturbances)) =
            (&states, &controls, &dynamics, &cost.running, &disturbances)
        {
            let states: Vec<&Variable> = all.iter().map(|s| &s.variable).collect();
            let scene = Scene {
                states: &states,
                controls,
                disturbances,
                dynamics,
                running,
                guards: &guards,
                region: region.as_deref(),
                finite: cost.finite,
            };
            if let Some(at) = &equilibrium {
                self.check_equilibrium(at, &scene);
            }
            // What is wrong already may be why something does not repeat.
            if self.problems.is_empty() {
                self.check_periods(all, &scene);
            }
        }
        let reference = reference(equilibrium.as_ref(), region.as_deref(), cost.finite);
        let shoot_out = sections
            .get("shoot_out")
            .and_then(|s| self.shoot_out(s, cost.finite, game));
        let homotopy = sections
            .get("homotopy")
            .and_then(|s| self.homotopy(s, &declared.states, reference.as_deref()));
        let map = sections
            .get("map")
            .and_then(|s| self.map(s, &declared.states));
        let clash = declared
            .states
            .iter()
            .find(|s| schema::MAP.reserves(s.name));
        if let (Some(state), true) = (clash, map.is_some()) {
            let message = format!(
                "a state named `{}` cannot be an axis of [map], which has a variable of that name",
                state.name
            );
            let problem = Problem::at(state.span.clone(), message, "rename the state");
            self.report(
                problem.with_help("or remove [map], or give it `error` in place of a grid"),
            );
        }
        let map_aim = sections.get("map").and_then(|s| {
            self.map_aim(s, &declared.states, region.as_deref(), (cost.finite, game))
        });
        let sheets = sections
            .get("sheets")
            .map(|s| self.sheets(s))
            .unwrap_or_default();
        let feedback = sections
            .get("feedback")
            .map(|s| self.feedback(s, &declared, region.as_deref(), cost.finite))
            .unwrap_or_default();
        let report = sections
            .get("report")
            .and_then(|s| self.report_section(s, &declared.states, region.as_deref()));
        let integrator = self.integrator(sections.get("integrator"));
        let time_unit = sections.get("time").and_then(|s| {
            self.check_keys(s, "time");
            self.unit(s)
        });
        let cost_unit = sections.get("cost").and_then(|s| self.unit(s));
        // [closed_loop] comes last, for it brings names of its own.
        let scope = LoopScope {
            states: &declared.states,
            controls: &declared.controls,
            disturbances: &declared.disturbances,
            reference: reference.as_deref(),
            region: region.as_deref(),
            final_time: cost.terminal.as_ref().map(|t| t.final_time),
            finite: cost.finite,
            fitted: sections.get("feedback").map(law_names).unwrap_or_default(),
        };
        let attenuation = (sections.get("attenuation"))
            .and_then(|s| self.attenuation(s, &declared, region.as_deref(), cost.finite));
        let study = sections.get("study").and_then(|s| self.study(s, &scope));
        let dissipation = sections
            .get("dissipation")
            .and_then(|s| self.dissipation(s, sections.get("closed_loop"), &scope));
        let closed_loop = sections
            .get("closed_loop")
            .and_then(|s| self.closed_loop(s, &scope));
        Some(Model {
            title: title.unwrap_or_else(|| stem(file_name)),
            file_name: file_name.to_owned(),
            text: self.text.to_owned(),
            overrides: (overrides.iter())
                .map(|(name, given)| (name.clone(), given.text()))
                .collect(),
            graph: Default::default(),
            parameters,
            states: states?,
            controls: controls?,
            disturbances: disturbances?,
            dynamics: dynamics?,
            horizon: horizon(&cost, equilibrium, reference)?,
            running: cost.running?,
            region: region?,
            guards,
            shoot_out,
            homotopy,
            map,
            map_aim,
            sheets,
            feedback,
            report,
            closed_loop,
            dissipation,
            study,
            attenuation,
            integrator,
            time_unit,
            cost_unit,
            notes,
        })
    }

    fn require_horizon(&mut self, root: &DeTable<'_>, sections: &Sections<'a>, cost: &Cost) {
        if cost.finite || root.contains_key("equilibrium") || !sections.contains_key("cost") {
            return;
        }
        let help = "infinite horizon: add [equilibrium] with all states and controls; finite horizon: add terminal and \
                    final_time to [cost]";
        let message = "the horizon is missing: neither [equilibrium] nor a final time";
        self.report(Problem {
            message: message.to_owned(),
            span: None,
            label: String::new(),
            help: Some(help.to_owned()),
        });
    }
}

/// The point deviations are taken from.
fn reference(
    equilibrium: Option<&Equilibrium>,
    region: Option<&[[f64; 2]]>,
    finite: bool,
) -> Option<Vec<f64>> {
    match equilibrium {
        Some(at) => Some(at.x.iter().map(|p| p.value).collect()),
        None if finite => region.map(|r| {
            r.iter()
                .map(|[lower, upper]| 0.5 * (lower + upper))
                .collect()
        }),
        None => None,
    }
}

fn horizon(
    cost: &Cost,
    equilibrium: Option<Equilibrium>,
    reference: Option<Vec<f64>>,
) -> Option<Horizon> {
    if cost.finite {
        let terminal = cost.terminal.clone()?;
        return Some(Horizon::Finite {
            terminal: terminal.terminal,
            final_time: terminal.final_time,
            reference: reference?,
        });
    }
    let at = equilibrium?;
    let u = at.u.iter().map(|p| p.value).collect();
    Some(Horizon::Infinite {
        x: reference?,
        u,
        span: at.span,
    })
}

fn stem(file_name: &str) -> String {
    Path::new(file_name).file_stem().map_or_else(
        || file_name.to_owned(),
        |s| s.to_string_lossy().into_owned(),
    )
}
