//! `[events]` and `[simulation]`: what a simulation forward in time meets, how the state jumps
//! there, and what is to be simulated.

use super::build::Use;
use super::declare::Declared;
use super::lexer::is_identifier;
use super::mechanism::RATE;
use super::reader::{Reader, Section, Value};
use super::scope::Kinds;
use crate::diagnostics::{Problem, shorten};
use crate::expr::Id;
use crate::mechanism::{Articulated, Constraint, Mechanism, Posed};
use crate::model::{DEFAULT_EVENTS, DEFAULT_PHASE_SAMPLES, Event, Simulation, Start};
use rustc_hash::FxHashMap;
use toml::de::DeValue;

/// Events of one flight, and stored points of a phase, that a scene may ask for.
const MOST_EVENTS: u32 = 1_000_000;
const MOST_SAMPLES: u32 = 100_000;

/// States after an event, by name.
type After<'a> = FxHashMap<&'a str, Id>;

impl<'a> Reader<'a> {
    /// Events in the order of the file; `None` where one is wrong.
    pub fn events(
        &mut self,
        section: &Section<'a>,
        states: &[Declared<'a>],
        mechanism: Option<&Mechanism>,
    ) -> Option<Vec<Event>> {
        let mut all = Vec::new();
        for (name, span, value) in section.entries() {
            let what = format!("event `{}`", shorten(name));
            if !is_identifier(name) {
                let label = "letters, digits and _, not a digit first";
                self.refuse::<()>(span, format!("{what}: not a name"), label);
                all.push(None);
                continue;
            }
            let event = self.table(value, span, &what).and_then(|table| {
                self.check_keys(&table, "events");
                self.event(name, &what, &table, states, mechanism)
            });
            all.push(event);
        }
        all.into_iter().collect()
    }

    fn event(
        &mut self,
        name: &str,
        what: &str,
        table: &Section<'a>,
        states: &[Declared<'a>],
        mechanism: Option<&Mechanism>,
    ) -> Option<Event> {
        let Some(when) = table.get("when") else {
            let message = format!("{what} has no condition");
            let problem = Problem::at(table.span.clone(), message, "`when` is missing");
            self.report(
                problem.with_help("when = \"x <= 0\": the state jumps as soon as that comes true"),
            );
            return None;
        };
        // A guard is positive where its comparison holds; an event is met where it comes to hold.
        let met = self.condition(name, &format!("the `when` of {what}"), when)?;
        let ahead = self.graph.neg(met.condition.expr);
        let only = match table.get("where") {
            Some(only) => {
                let only = self.condition(name, &format!("the `where` of {what}"), only)?;
                Some(only.condition.expr)
            }
            None => None,
        };
        let ends = match table.get("ends") {
            Some(value) => self.yes_or_no(value, &format!("`ends` of {what}"))?,
            None => false,
        };
        let changes = ["collision", "relabel", "set"].map(|key| (key, table.get(key)));
        let given = changes.iter().find(|(_, value)| value.is_some());
        match (ends, given) {
            (true, Some((key, _))) => {
                let message = format!("{what} ends the simulation: the state does not jump");
                return self.refuse(table.key_span(key), message, "no use for this");
            }
            (false, None) => {
                let problem = Problem::at(
                    table.span.clone(),
                    format!("{what} changes nothing"),
                    "what happens there?",
                );
                let help = "set = { v = \"-0.8*v\" }, collision = [\"POINT\"], relabel = { a = \"b\", b = \"a\" }, or ends = true";
                self.report(problem.with_help(help));
                return None;
            }
            _ => {}
        }
        let map = match ends {
            true => None,
            false => Some(self.jump(what, table, states, mechanism)?),
        };
        Some(Event {
            name: name.to_owned(),
            ahead,
            only,
            map,
        })
    }

    /// The states after an event: a collision changes rates, then names change, and what is set is
    /// set at last. Expressions are of the states before all of it.
    fn jump(
        &mut self,
        what: &str,
        table: &Section<'a>,
        states: &[Declared<'a>],
        mechanism: Option<&Mechanism>,
    ) -> Option<Vec<Id>> {
        let symbols = states.iter().filter_map(|s| Some((s.name, s.symbol?)));
        let mut after: After<'a> = symbols.collect();
        if let Some(value) = table.get("collision") {
            self.collide(what, value, mechanism, &mut after)?;
        }
        let mut renamed = after.clone();
        if let Some(value) = table.get("relabel") {
            let table = self.table(value, value.span(), &format!("`relabel` of {what}"))?;
            self.relabel(what, &table, &after, &mut renamed)?;
        }
        if let Some(value) = table.get("set") {
            let table = self.table(value, value.span(), &format!("`set` of {what}"))?;
            self.entries_of(&table, states, "states");
            for (state, _, value) in table.entries() {
                let of = format!("`{}` after {what}", shorten(state));
                let purpose = Use {
                    what: &of,
                    allowed: Kinds::PARAMETER.and(Kinds::STATE),
                    rule: "parameters, states (as they are before the event) and definitions without controls",
                };
                let built = self.expression(value, &purpose)?;
                if let Some(entry) = renamed.get_mut(state) {
                    *entry = built.expr;
                }
            }
        }
        (states.iter())
            .map(|s| renamed.get(s.name).copied())
            .collect()
    }

    /// Rates after a plastic collision in which points come to rest; points that were held and are
    /// not named let go.
    fn collide(
        &mut self,
        what: &str,
        value: &'a Value<'a>,
        mechanism: Option<&Mechanism>,
        after: &mut After<'a>,
    ) -> Option<()> {
        let Some(mechanism) = mechanism else {
            if self.no_mechanism {
                return None;
            }
            let message = format!("{what}: only points of a [mechanism] collide");
            return self.refuse(value.span(), message, "no mechanism");
        };
        let DeValue::Array(names) = value.get_ref() else {
            let message = format!("the collision of {what} must be a list of points");
            return self.refuse(value.span(), message, "such as [\"foot\"]");
        };
        let mut constraints: Vec<Constraint> = Vec::new();
        for name in names {
            let known = self.string(name, &format!("a point of {what}"))?;
            let point = self.known_point(known, name.span(), &mechanism.points)?;
            constraints.extend(mechanism.axes(point));
        }
        if constraints.is_empty() {
            let message = format!("the collision of {what} names no point");
            return self.refuse(value.span(), message, "empty");
        }
        let g = &mut self.graph;
        let posed = Posed::new(g, &mechanism.tree, &mechanism.q, &mechanism.rates);
        if !self.are_independent(&posed, &constraints) {
            let message = format!(
                "the collision of {what} stops the same twice, or what cannot move: its impulses are not determined"
            );
            return self.refuse(value.span(), message, "remove a point");
        }
        let g = &mut self.graph;
        let articulated = Articulated::new(g, &posed.motion);
        let held = posed.held(g, &articulated, &constraints);
        let (rates, _) = held.collision(g, &mechanism.rates);
        for (body, rate) in mechanism.tree.bodies.iter().zip(rates) {
            if let Some(entry) = after.get_mut(format!("{}{RATE}", body.name).as_str()) {
                *entry = rate;
            }
        }
        Some(())
    }

    /// `relabel = { a = "b" }`: a becomes what b was, and its rate with it.
    fn relabel(
        &mut self,
        what: &str,
        table: &Section<'a>,
        after: &After<'a>,
        renamed: &mut After<'a>,
    ) -> Option<()> {
        for (to, span, value) in table.entries() {
            let from = self.string(value, &format!("`{}` of {what}", shorten(to)))?;
            let places = [(to, span), (from, value.span())];
            for (name, span) in places {
                if after.contains_key(name) {
                    continue;
                }
                let message = format!("{what}: `{}` is no state", shorten(name));
                let known = after.keys().copied();
                return self.unknown((name, span), message, "states are relabelled", known);
            }
            for tail in ["", RATE] {
                let (to, from) = (format!("{to}{tail}"), format!("{from}{tail}"));
                let value = after.get(from.as_str()).copied();
                if let (Some(value), Some(entry)) = (value, renamed.get_mut(to.as_str())) {
                    *entry = value;
                }
            }
        }
        Some(())
    }

    /// `[simulation]`; `reference` is where states are that `initial` does not name.
    pub fn simulation(
        &mut self,
        section: &Section<'a>,
        states: &[Declared<'a>],
        reference: Option<&[f64]>,
    ) -> Option<Simulation> {
        self.check_keys(section, "simulation");
        let initial = match section.get("initial") {
            Some(value) => {
                let table = self.table(value, section.key_span("initial"), "initial")?;
                self.start_axes(&table, states, reference, false)
            }
            None => reference.map(|r| r.iter().map(|x| Start::Fixed(*x)).collect()),
        };
        let time = match section.get("time") {
            Some(value) => {
                Some(self.number_that(value, "the simulated time", "greater than 0", |t| t > 0.0)?)
            }
            None => None,
        };
        let mut count =
            |key: &str, what: &str, (least, most), default: Option<usize>| match section.get(key) {
                Some(value) => self.count_to(value, what, least, most).map(Some),
                None => Some(default),
            };
        let events = count("events", "events", (1, MOST_EVENTS), Some(DEFAULT_EVENTS));
        let samples = count(
            "samples",
            "samples",
            (0, MOST_SAMPLES),
            Some(DEFAULT_PHASE_SAMPLES),
        );
        let cycle = count("cycle", "the events of a cycle", (1, 1000), None);
        let law = match section.get("law") {
            Some(value) => Some(self.string(value, "the law")?.to_owned()),
            None => None,
        };
        Some(Simulation {
            initial: initial?,
            time,
            events: events??,
            samples: samples??,
            law,
            cycle: cycle?,
            span: section.span.clone(),
        })
    }
}
