//! `[events]` and `[simulation]`: what a simulation forward in time meets, how the state jumps
//! there, and what is to be simulated.

use super::build::Use;
use super::declare::Declared;
use super::lexer::is_identifier;
use super::mechanism::RATE;
use super::reader::{Reader, Section};
use super::scope::Kinds;
use crate::diagnostics::{Problem, shorten};
use crate::expr::Id;
use crate::mechanism::Mechanism;
use crate::model::{DEFAULT_EVENTS, DEFAULT_PHASE_SAMPLES, Event, Kept, Simulation, Start};
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
        if self.kinds_of(met.condition.expr).within(Kinds::PARAMETER) {
            let message = format!("the `when` of {what} has no states: it never comes true");
            return self.refuse(when.span(), message, "always the same");
        }
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
        for (key, value) in &changes {
            if matches!(value.map(|v| v.get_ref()), Some(DeValue::Table(t)) if t.is_empty()) {
                let message = format!("`{key}` of {what} changes nothing");
                return self.refuse(table.key_span(key), message, "empty");
            }
        }
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
        let (map, kept) = match ends {
            true => (None, Vec::new()),
            false => {
                let (map, kept) = self.jump(what, table, states, mechanism)?;
                (Some(map), kept)
            }
        };
        Some(Event {
            name: name.to_owned(),
            ahead,
            only,
            map,
            kept,
        })
    }

    /// The states after an event: a collision changes rates, then names change, and what is set is
    /// set at last. Expressions are of the states before all of it. And what contacts keep.
    fn jump(
        &mut self,
        what: &str,
        table: &Section<'a>,
        states: &[Declared<'a>],
        mechanism: Option<&Mechanism>,
    ) -> Option<(Vec<Id>, Vec<Kept>)> {
        let symbols = states.iter().filter_map(|s| Some((s.name, s.symbol?)));
        let mut after: After<'a> = symbols.collect();
        let collision = match table.get("collision") {
            Some(value) => Some(self.collision(what, value, mechanism)?),
            None => None,
        };
        if let (Some(collision), Some(mechanism)) = (&collision, mechanism) {
            for (body, rate) in mechanism.tree.bodies.iter().zip(collision) {
                if let Some(entry) = after.get_mut(format!("{}{RATE}", body.name).as_str()) {
                    *entry = *rate;
                }
            }
        }
        let mut renamed = after.clone();
        if let Some(value) = table.get("relabel") {
            let table = self.table(value, value.span(), &format!("`relabel` of {what}"))?;
            self.relabel(what, &table, &after, &mut renamed)?;
        }
        let mut sets = false;
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
                let symbol = states
                    .iter()
                    .find(|s| s.name == state)
                    .and_then(|s| s.symbol);
                sets |= (mechanism.zip(symbol)).is_some_and(|(m, symbol)| m.moves(symbol));
            }
        }
        let kept = match mechanism {
            Some(mechanism) => {
                let of = (collision.as_deref(), &renamed);
                self.kept(mechanism, of, sets)
            }
            None => Vec::new(),
        };
        let map: Option<Vec<Id>> = (states.iter())
            .map(|s| renamed.get(s.name).copied())
            .collect();
        Some((map?, kept))
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
