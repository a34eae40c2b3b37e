//! A file as a whole: its sections, and the order in which they are read.

use super::closed_loop::LoopScope;
use super::declare::Declarations;
use super::document::Given;
use super::equations::Cost;
use super::equilibrium::{Equilibrium, Scene};
use super::feedback::law_names;
use super::hints;
use super::keys;
use super::mechanism::{Generated, Structure};
use super::parser::{parse_expression, parse_guard};
use super::reader::{Reader, Section};
use super::scope::Role;
use crate::diagnostics::Problem;
use crate::diagnostics::did_you_mean;
use crate::diagnostics::position;
use crate::diagnostics::shorten;
use crate::mechanism::Mechanism;
use crate::model::{
    Attenuation, ClosedLoop, Control, Dissipation, Feedback, Guard, Homotopy, Horizon, Integrator,
    Located, MapAim, MapGrid, Model, Report, Sheets, ShootOut, State, Study, Variable,
};
use crate::schema;
use rustc_hash::FxHashMap;
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

/// What a scene needs, to a file without any section.
const BEGINNING: &str = "the states, such as states = { x = {} }. A scene also needs controls = { u = {} }, dynamics = { x = \"-x + u\" }, \
    cost = { running = \"x^2 + u^2\" }, equilibrium = { x = 0, u = 0 } and region = { x = [-1, 1] }; all sections: docs/scene.md, or `costate reference scene`";

pub(super) type Sections<'a> = FxHashMap<&'static str, Section<'a>>;

/// The problem that a scene poses, as far as it could be read: what is `None` has been reported, or
/// its section is missing.
pub(super) struct Posed {
    pub states: Option<Vec<State>>,
    controls: Option<Vec<Control>>,
    disturbances: Option<Vec<Variable>>,
    dynamics: Option<Vec<Located>>,
    cost: Cost,
    guards: Vec<Guard>,
    pub region: Option<Vec<[f64; 2]>>,
    pub equilibrium: Option<Equilibrium>,
}

impl Posed {
    /// The point deviations are taken from.
    fn reference(&self) -> Option<Vec<f64>> {
        match &self.equilibrium {
            Some(at) => Some(at.x.iter().map(|p| p.value).collect()),
            None if self.cost.finite => self.region.as_ref().map(|r| {
                r.iter()
                    .map(|[lower, upper]| 0.5 * (lower + upper))
                    .collect()
            }),
            None => None,
        }
    }
}

/// What a mechanism comes to; nothing where the scene has none.
#[derive(Default)]
struct Moved {
    mechanism: Option<Mechanism>,
    /// Of its states, by name.
    rates: FxHashMap<String, Located>,
}

/// What a scene asks for without a closed loop, with the fields of a [`Model`].
pub(super) struct Settings {
    shoot_out: Option<ShootOut>,
    pub homotopy: Option<Homotopy>,
    map: Option<MapGrid>,
    map_aim: Option<MapAim>,
    sheets: Sheets,
    feedback: Vec<Feedback>,
    report: Option<Report>,
    integrator: Integrator,
    time_unit: Option<String>,
    cost_unit: Option<String>,
}

/// What a scene asks of closed loops, disturbances and parameters, with the fields of a [`Model`].
pub(super) struct Loops {
    attenuation: Option<Attenuation>,
    pub study: Option<Study>,
    pub dissipation: Option<Dissipation>,
    pub closed_loop: Option<ClosedLoop>,
}

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
        let mut sections = Sections::default();
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
                self.report(Problem::at(span, message, "not part of a scene").with_help(help));
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

    fn declarations(
        &mut self,
        sections: &Sections<'a>,
        generated: &'a Generated,
    ) -> Declarations<'a> {
        let parameters = self.declare(sections.get("parameters"), Role::Parameter);
        let states = self.declare_states(sections.get("states"), generated);
        let mut of = |name: &str, role| self.declare(sections.get(name), role);
        Declarations {
            parameters,
            states,
            controls: of("controls", Role::Control),
            disturbances: of("disturbances", Role::Disturbance),
            definitions: of("definitions", Role::Definition),
        }
    }

    /// What follows from a mechanism's bodies and joints, where the scene has one: the outer `None`
    /// where something is wrong with it.
    fn structure_of(
        &mut self,
        sections: &Sections<'a>,
        declared: &Declarations<'a>,
    ) -> Option<Option<Structure>> {
        let Some(section) = sections.get("mechanism") else {
            return Some(None);
        };
        let symbols = (declared.states.iter())
            .filter_map(|s| Some((s.name, s.symbol?)))
            .collect();
        let structure = self.structure(section, &symbols);
        self.no_mechanism = structure.is_none();
        structure.map(Some)
    }

    /// The mechanism with its forces, and the rates that follow.
    fn moved(
        &mut self,
        sections: &Sections<'a>,
        structure: Option<Option<Structure>>,
    ) -> Option<Moved> {
        let (structure, section) = match (structure?, sections.get("mechanism")) {
            (Some(structure), Some(section)) => (structure, section),
            _ => return Some(Moved::default()),
        };
        let (mechanism, rates) = self.mechanism(section, structure)?;
        Some(Moved {
            mechanism: Some(mechanism),
            rates,
        })
    }

    /// Reports the required sections that are missing.
    fn require_sections(&mut self, root: &DeTable<'_>, sections: &Sections<'a>) {
        // Who has nothing yet is told how to begin.
        let states = match sections.is_empty() {
            true => BEGINNING,
            false => "the states, in the order of the output's axes",
        };
        let mechanism = sections.contains_key("mechanism");
        if !mechanism {
            self.require(root, sections, "states", states);
        }
        self.require(root, sections, "controls", "the controls");
        // Where these are there, what they lack is reported entry by entry.
        for (name, what) in [
            ("dynamics", "the time derivative of each state"),
            ("cost", "the running cost"),
        ] {
            let follows = mechanism && name == "dynamics";
            if !follows && !sections.contains_key(name) {
                self.require(root, sections, name, what);
            }
        }
        self.require(
            root,
            sections,
            "region",
            "bounds [lower, upper] for each state",
        );
    }

    /// Everything, with an empty graph in the place of the reader's; `None` only after a report.
    pub(super) fn model(
        &mut self,
        root: &'a DeTable<'a>,
        generated: &'a Generated,
        file_name: &str,
        overrides: &[(String, Given)],
    ) -> Option<Model> {
        let (sections, title) = self.sections(root);
        self.require_sections(root, &sections);
        let declared = self.declarations(&sections, generated);
        let parameters = self.parameters(&declared.parameters, overrides);
        let structure = self.structure_of(&sections, &declared);
        // Forces may use definitions, and definitions the forces that hold points.
        let late = self.late(&declared.definitions);
        let definitions = || declared.definitions.iter().zip(&late);
        self.definitions(definitions().filter(|(_, late)| !**late).map(|(d, _)| d));
        let moved = self.moved(&sections, structure);
        self.definitions(definitions().filter(|(_, late)| **late).map(|(d, _)| d));
        let rates = moved.as_ref().map(|m| &m.rates);
        let (posed, notes) = self.posed(&sections, &declared, generated, rates);
        self.require_horizon(root, &sections, &posed.cost);
        let mechanism = moved.as_ref().and_then(|m| m.mechanism.as_ref());
        self.check_posed(&posed, mechanism);
        let reference = posed.reference();
        let events = match sections.get("events") {
            Some(section) => self.events(section, &declared.states, mechanism),
            None => Some(Vec::new()),
        };
        let settings = self.settings(&sections, &declared, &posed, reference.as_deref());
        // [closed_loop] comes last, for it brings names of its own.
        let loops = self.loops(&sections, &declared, &posed, reference.as_deref());
        let simulation = (sections.get("simulation"))
            .and_then(|s| self.simulation(s, &declared.states, reference.as_deref()));
        self.check_turns(&sections, &posed, (&settings, &loops));
        Some(Model {
            title: title.unwrap_or_else(|| stem(file_name)),
            file_name: file_name.to_owned(),
            text: self.text.to_owned(),
            overrides: (overrides.iter())
                .map(|(name, given)| (name.clone(), given.text()))
                .collect(),
            graph: Default::default(),
            parameters,
            states: posed.states?,
            controls: posed.controls?,
            disturbances: posed.disturbances?,
            dynamics: posed.dynamics?,
            mechanism: moved?.mechanism,
            horizon: horizon(&posed.cost, posed.equilibrium, reference)?,
            running: posed.cost.running?,
            region: posed.region?,
            guards: posed.guards,
            events: events?,
            simulation,
            shoot_out: settings.shoot_out,
            homotopy: settings.homotopy,
            map: settings.map,
            map_aim: settings.map_aim,
            sheets: settings.sheets,
            feedback: settings.feedback,
            report: settings.report,
            closed_loop: loops.closed_loop,
            dissipation: loops.dissipation,
            study: loops.study,
            attenuation: loops.attenuation,
            integrator: settings.integrator,
            time_unit: settings.time_unit,
            cost_unit: settings.cost_unit,
            notes: [std::mem::take(&mut self.notes), notes].concat(),
        })
    }

    /// The problem itself, and remarks on what of it is not used.
    fn posed(
        &mut self,
        sections: &Sections<'a>,
        declared: &Declarations<'a>,
        generated: &Generated,
        rates: Option<&FxHashMap<String, Located>>,
    ) -> (Posed, Vec<String>) {
        let mut states = self.states(&declared.states);
        let notes = match &mut states {
            Some(states) if declared.is_game() => forget_periods(states),
            _ => Vec::new(),
        };
        let posed = Posed {
            states,
            controls: self.controls(&declared.controls),
            disturbances: self.disturbances(&declared.disturbances),
            dynamics: match (sections.get("dynamics"), rates) {
                (None, _) if !sections.contains_key("mechanism") => None,
                (section, Some(rates)) => self.dynamics(section, &declared.states, rates),
                (_, None) => None,
            },
            cost: sections
                .get("cost")
                .map(|s| self.cost(s))
                .unwrap_or_default(),
            guards: sections
                .get("guards")
                .map(|s| self.guards(s))
                .unwrap_or_default(),
            region: sections
                .get("region")
                .filter(|s| s.entries().next().is_some())
                .and_then(|s| self.region(s, &declared.states)),
            equilibrium: sections.get("equilibrium").and_then(|s| {
                self.equilibrium(
                    s,
                    &declared.states,
                    &declared.controls,
                    &declared.disturbances,
                    generated,
                )
            }),
        };
        (posed, notes)
    }

    /// Reports what of the problem does not fit together: the equilibrium and the periods.
    fn check_posed(&mut self, posed: &Posed, mechanism: Option<&Mechanism>) {
        let (Some(all), Some(controls)) = (&posed.states, &posed.controls) else {
            return;
        };
        let (region, finite) = (posed.region.as_deref(), posed.cost.finite);
        let states: Vec<&Variable> = all.iter().map(|s| &s.variable).collect();
        if let Some(at) = &posed.equilibrium {
            self.check_equilibrium_range(at, &states, controls, region, finite);
        }
        let (Some(dynamics), Some(running), Some(disturbances)) =
            (&posed.dynamics, &posed.cost.running, &posed.disturbances)
        else {
            return;
        };
        let scene = Scene {
            mechanism,
            states: &states,
            controls,
            disturbances,
            dynamics,
            running,
            guards: &posed.guards,
            region,
            finite,
        };
        if let Some(at) = &posed.equilibrium {
            self.check_equilibrium(at, &scene);
        }
        // What is wrong already may be why something does not repeat.
        if self.problems.is_empty() {
            self.check_finite(&scene);
            self.check_periods(all, &scene);
        }
    }

    /// What is asked for without a closed loop; `reference` is the point deviations are taken from.
    fn settings(
        &mut self,
        sections: &Sections<'a>,
        declared: &Declarations<'a>,
        posed: &Posed,
        reference: Option<&[f64]>,
    ) -> Settings {
        let (region, finite) = (posed.region.as_deref(), posed.cost.finite);
        let game = declared.is_game();
        let shoot_out = sections
            .get("shoot_out")
            .and_then(|s| self.shoot_out(s, finite, game));
        let homotopy = sections
            .get("homotopy")
            .and_then(|s| self.homotopy(s, &declared.states, reference));
        let map = sections
            .get("map")
            .and_then(|s| self.map(s, &declared.states));
        if map.is_some() {
            self.check_map_axes(declared);
        }
        Settings {
            shoot_out,
            homotopy,
            map,
            map_aim: sections
                .get("map")
                .and_then(|s| self.map_aim(s, &declared.states, region, (finite, game))),
            sheets: sections
                .get("sheets")
                .map(|s| self.sheets(s))
                .unwrap_or_default(),
            feedback: sections
                .get("feedback")
                .map(|s| self.feedback(s, declared, region, finite))
                .unwrap_or_default(),
            report: sections
                .get("report")
                .and_then(|s| self.report_section(s, &declared.states, region)),
            integrator: self.integrator(sections.get("integrator")),
            time_unit: sections.get("time").and_then(|s| {
                self.check_keys(s, "time");
                self.unit(s)
            }),
            cost_unit: sections.get("cost").and_then(|s| self.unit(s)),
        }
    }

    /// Reports a state that has the name of one of the map's variables: it cannot be an axis of a
    /// grid.
    fn check_map_axes(&mut self, declared: &Declarations<'a>) {
        let mut states = declared.states.iter();
        if let Some(state) = states.find(|s| schema::MAP.reserves(s.name)) {
            let message = format!(
                "a state named `{}` cannot be an axis of [map], which has a variable of that name",
                state.name
            );
            let problem = Problem::at(state.span.clone(), message, "rename the state");
            self.report(
                problem.with_help("or remove [map], or give it `error` in place of a grid"),
            );
        }
    }

    /// What is asked of closed loops, and of the problem with other disturbances or parameters.
    fn loops(
        &mut self,
        sections: &Sections<'a>,
        declared: &Declarations<'a>,
        posed: &Posed,
        reference: Option<&[f64]>,
    ) -> Loops {
        let (region, cost) = (posed.region.as_deref(), &posed.cost);
        let scope = LoopScope {
            states: &declared.states,
            controls: &declared.controls,
            disturbances: &declared.disturbances,
            reference,
            region,
            final_time: cost.terminal.as_ref().map(|t| t.final_time),
            finite: cost.finite,
            fitted: sections.get("feedback").map(law_names).unwrap_or_default(),
        };
        Loops {
            attenuation: (sections.get("attenuation"))
                .and_then(|s| self.attenuation(s, declared, region, cost.finite)),
            study: sections.get("study").and_then(|s| self.study(s, &scope)),
            dissipation: sections
                .get("dissipation")
                .and_then(|s| self.dissipation(s, sections.get("closed_loop"), &scope)),
            closed_loop: sections
                .get("closed_loop")
                .and_then(|s| self.closed_loop(s, &scope)),
        }
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

/// In a game the lower of V(x) and V(x + period) is no value: an angle counts as it is written.
/// Returns a remark on each.
fn forget_periods(states: &mut [State]) -> Vec<String> {
    let mut notes = Vec::new();
    for state in states.iter_mut().filter(|s| s.period.is_some()) {
        state.period = None;
        notes.push(format!(
            "a game: the period of `{}` is not used, and the angle counts as it is written",
            state.variable.name
        ));
    }
    notes
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
