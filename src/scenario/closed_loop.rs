//! `[closed_loop]`: which laws are simulated from where, and what is recorded.

use super::build::Use;
use super::declare::Declared;
use super::lexer::Relation;
use super::parser::{Ast, parse_expression};
use super::reader::{Reader, Section, Value};
use super::scope::{Entry, Kinds, Meaning, Role};
use super::settings::number_of;
use crate::diagnostics::Problem;
use crate::diagnostics::did_you_mean;
use crate::diagnostics::shorten;
use crate::expr::{Id, Kind};
use crate::model::{
    ClosedLoop, DEFAULT_CONVERGED, DEFAULT_LOOP_MARGIN, Extremum, Formula, GivenLaw, Located,
    OperatingSet, Outside, Record, Span, Start,
};
use crate::numeric::digits::plain;
use crate::schema;
use toml::de::DeValue;

/// Points at which quantities are recorded unless `samples` says otherwise.
const DEFAULT_SAMPLES: usize = 200;
/// Initial states of one evaluation.
const MOST_STATES: f64 = 1e7;
/// Laws that need no table of their own.
const BUILT_IN: [&str; 2] = ["map", "lqr"];
/// Updates of a law in one closed loop.
const MOST_UPDATES: f64 = 1e7;

/// What of the scene the section refers to.
pub(super) struct LoopScope<'s, 'a> {
    pub states: &'s [Declared<'a>],
    pub controls: &'s [Declared<'a>],
    pub disturbances: &'s [Declared<'a>],
    pub reference: Option<&'s [f64]>,
    pub region: Option<&'s [[f64; 2]]>,
    /// A finite horizon's.
    pub final_time: Option<f64>,
    pub finite: bool,
    /// Names of the laws that the scene fits.
    pub fitted: Vec<String>,
}

impl<'a> Reader<'a> {
    /// `[closed_loop]`; `None` where something in it is wrong.
    pub fn closed_loop(
        &mut self,
        section: &Section<'a>,
        scope: &LoopScope<'_, 'a>,
    ) -> Option<ClosedLoop> {
        self.check_keys(section, "closed_loop");
        let before = self.problems.len();
        let positive = |v: f64| v > 0.0;
        let mut positive_number = |key: &str| {
            let value = section.get(key)?;
            self.number_that(value, key, "greater than 0", positive)
        };
        let (given_time, track, converged) = (
            positive_number("final_time"),
            positive_number("track"),
            positive_number("converged"),
        );
        let (margin, period) = (positive_number("margin"), positive_number("period"));
        let outside = section
            .get("outside")
            .and_then(|v| self.choice(v, "outside", &Outside::ALL));
        let final_time = self.loop_time(section, given_time, scope);
        let samples = section.get("samples").and_then(|v| self.sample_count(v));
        if let (Some(period), Some(time)) = (period, final_time) {
            self.check_period(section, period, time, samples.unwrap_or(DEFAULT_SAMPLES));
        }
        let random = section
            .get("random")
            .and_then(|v| self.count_to(v, "random", 1, MOST_STATES as u32));
        let initial = self.starts(section, scope, random.is_some());
        let given = self.given_laws(section, scope);
        let names: Vec<&str> = given.iter().map(|g| g.name.as_str()).collect();
        let laws = section
            .get("laws")
            .and_then(|v| self.law_names(v, &names, scope));
        let records = section
            .get("record")
            .map(|v| self.records("closed_loop", section, v, scope));
        let records = records.unwrap_or_default();
        let sets = section.get("sets").map(|v| self.sets(section, v, &records));
        if self.problems.len() > before {
            return None;
        }
        Some(ClosedLoop {
            final_time: final_time?,
            samples: samples.unwrap_or(DEFAULT_SAMPLES),
            initial: initial?,
            random,
            laws,
            given,
            records,
            sets: sets.unwrap_or_default(),
            track,
            converged: converged.unwrap_or(DEFAULT_CONVERGED),
            margin: margin.unwrap_or(DEFAULT_LOOP_MARGIN),
            period,
            outside: outside.unwrap_or_default(),
            span: section.span.clone(),
        })
    }

    /// A law is updated at every sample at least, and not so often that a loop has no end.
    fn check_period(
        &mut self,
        section: &Section<'a>,
        period: f64,
        final_time: f64,
        samples: usize,
    ) {
        let between = final_time / samples as f64;
        let updates = final_time / period;
        let problem = |message: String, label: &str| {
            let span = section
                .get("period")
                .map_or(section.span.clone(), |v| v.span());
            Problem::at(span, message, label)
        };
        // Of thirds of a decimal number the last digit is rounded.
        if period > between * (1.0 + 1e-9) {
            let message =
                format!("the law is updated at every sample, and samples are {between:?} apart");
            let problem = problem(message, "longer than that");
            self.report(problem.with_help(format!(
                "leave period out, or take samples = {} at most",
                updates.max(1.0) as u64
            )));
        } else if updates > MOST_UPDATES {
            let message = format!(
                "{updates:.1e} updates of a closed loop; at most {MOST_UPDATES:.0e} are made"
            );
            self.report(problem(message, "too short"));
        }
    }

    fn loop_time(
        &mut self,
        section: &Section<'a>,
        given: Option<f64>,
        scope: &LoopScope<'_, 'a>,
    ) -> Option<f64> {
        match (section.get("final_time"), scope.finite) {
            (Some(_), true) => {
                let message = "the closed loop of a finite horizon ends with it";
                let problem = Problem::at(section.key_span("final_time"), message, "remove this");
                self.report(problem.with_help("the final time is that of [cost]"));
                None
            }
            (None, false) => {
                let message = "[closed_loop] has no final_time";
                let problem = Problem::at(section.span.clone(), message, "`final_time` is missing");
                self.report(
                    problem.with_help("add final_time = ..., how long each trajectory is followed"),
                );
                None
            }
            _ => given.or(scope.final_time),
        }
    }

    /// The entry `initial` of a section; without one, where states are drawn at random, the region.
    pub fn starts(
        &mut self,
        section: &Section<'a>,
        scope: &LoopScope<'_, 'a>,
        random: bool,
    ) -> Option<Vec<Start>> {
        let Some(value) = section.get("initial") else {
            if random {
                let ranges = scope.region?.iter().map(|[first, last]| Start::Range {
                    first: *first,
                    last: *last,
                    count: None,
                });
                return Some(ranges.collect());
            }
            let problem = Problem::at(
                section.span.clone(),
                "[closed_loop] has no initial states",
                "`initial` is missing",
            );
            let help = "add initial = { ... }, an axis [first, last, count] or a value for each state; or random = N";
            self.report(problem.with_help(help));
            return None;
        };
        let table = self.table(value, section.key_span("initial"), "initial")?;
        self.start_axes(&table, scope.states, scope.reference, random)
    }

    /// An axis, or a value, for each state; states not named are at the reference.
    pub fn start_axes(
        &mut self,
        table: &Section<'a>,
        states: &[Declared<'a>],
        reference: Option<&[f64]>,
        random: bool,
    ) -> Option<Vec<Start>> {
        self.entries_of(table, states, "states");
        let axes: Vec<Option<Start>> = (states.iter().enumerate())
            .map(|(i, state)| match table.get(state.name) {
                Some(value) => self.start(value, &shorten(state.name), random),
                None => reference.and_then(|r| r.get(i)).map(|x| Start::Fixed(*x)),
            })
            .collect();
        let axes = axes.into_iter().collect::<Option<Vec<_>>>()?;
        let points = axes.iter().map(|a| match a {
            Start::Range {
                count: Some(count), ..
            } => *count as f64,
            _ => 1.0,
        });
        let points: f64 = points.product();
        if !random && points > MOST_STATES {
            let message = format!(
                "{} initial states; at most {MOST_STATES:.0} are simulated at once",
                number_of(points)
            );
            return self.refuse(table.span.clone(), message, "too many states");
        }
        Some(axes)
    }

    fn start(&mut self, value: &'a Value<'a>, name: &str, random: bool) -> Option<Start> {
        let what = format!("the axis of `{name}`");
        let DeValue::Array(array) = value.get_ref() else {
            return self.number(value, &what).map(Start::Fixed);
        };
        let counted = array.len() != 2 || !random;
        let (shape, length) = if counted {
            ("[first, last, count]", 3)
        } else {
            ("[first, last]", 2)
        };
        let entries = self.array(value, &what, shape, length)?;
        let ends = (
            self.number(&entries[0], &what),
            self.number(&entries[1], &what),
        );
        let count = match entries.get(2) {
            Some(count) => Some(self.count(count, &format!("the count of {what}"), 2)?),
            None => None,
        };
        let (Some(first), Some(last)) = ends else {
            return None;
        };
        if first >= last {
            let (first, last) = (plain(first), plain(last));
            let message = format!("{what} is empty: {first} is not below {last}");
            return self.refuse(value.span(), message, "the lower end comes first");
        }
        Some(Start::Range { first, last, count })
    }

    fn given_laws(&mut self, section: &Section<'a>, scope: &LoopScope<'_, 'a>) -> Vec<GivenLaw> {
        let (value, span) = (section.get("law"), section.key_span("law"));
        let Some(table) = value.and_then(|v| self.table(v, span, "[closed_loop.law]")) else {
            return Vec::new();
        };
        let mut all = Vec::new();
        for (name, span, value) in table.entries() {
            if !Self::is_name(name) {
                let message = format!("a law cannot be called `{}`", shorten(name));
                self.report(Problem::at(span, message, "not a name for a law"));
                continue;
            }
            if BUILT_IN.contains(&name) || scope.fitted.iter().any(|f| f == name) {
                let message = format!("a law named `{}` is there already", shorten(name));
                self.report(Problem::at(span, message, "choose another name"));
                continue;
            }
            if let Some(formula) = self.formula(name, span.clone(), value, scope) {
                all.push(GivenLaw {
                    name: name.to_owned(),
                    formula,
                    span,
                });
            }
        }
        all
    }

    fn formula(
        &mut self,
        name: &str,
        span: Span,
        value: &'a Value<'a>,
        scope: &LoopScope<'_, 'a>,
    ) -> Option<Formula> {
        let what = format!("law `{}`", shorten(name));
        let table = self.table(value, span.clone(), &what)?;
        if let Some(file) = table.get("weights") {
            self.check_keys(&table, "closed_loop.law");
            let text = self.string(file, &format!("the weights of {what}"))?;
            return Some(Formula::Weights {
                file: text.to_owned(),
                span: file.span(),
            });
        }
        let outputs: Vec<Declared<'a>> =
            scope.controls.iter().chain(scope.states).cloned().collect();
        self.entries_of(&table, &outputs, "controls, and states to be commanded");
        let rule = "parameters, states and definitions without controls";
        let mut all = Vec::new();
        for (output, _, value) in table
            .entries()
            .filter(|(k, ..)| outputs.iter().any(|o| o.name == *k))
        {
            let purpose = Use {
                what: &format!("{what} for `{}`", shorten(output)),
                allowed: Kinds::PARAMETER.and(Kinds::STATE),
                rule,
            };
            let expr = self.expression(value, &purpose)?.expr;
            let span = value.span();
            all.push((output.to_owned(), Located { expr, span }));
        }
        if all.is_empty() {
            let problem = Problem::at(span, format!("{what} gives nothing"), "no expression in it");
            self.report(
                problem.with_help("add an expression a control, or weights = \"FILE.toml\""),
            );
            return None;
        }
        Some(Formula::Expressions(all))
    }

    /// The names of the laws to simulate, of which `given` are the scene's own.
    pub fn law_names(
        &mut self,
        value: &'a Value<'a>,
        given: &[&str],
        scope: &LoopScope<'_, 'a>,
    ) -> Option<Vec<(String, Span)>> {
        let DeValue::Array(array) = value.get_ref() else {
            let problem = Problem::at(
                value.span(),
                "laws must be a list of names",
                "expected [\"...\"]",
            );
            self.report(problem.with_help("laws of your own are defined in [closed_loop.law]"));
            return None;
        };
        let known: Vec<&str> = (BUILT_IN.iter().copied())
            .chain(scope.fitted.iter().map(String::as_str))
            .chain(given.iter().copied())
            .collect();
        let mut names = Vec::new();
        for entry in array.iter() {
            let name = self.string(entry, "the name of a law")?;
            if known.contains(&name) {
                names.push((name.to_owned(), entry.span()));
                continue;
            }
            let help = did_you_mean(name, known.iter().copied())
                .unwrap_or_else(|| format!("laws of this scene: {}", known.join(", ")));
            let message = format!("there is no law `{}`", shorten(name));
            self.report(Problem::at(entry.span(), message, "not known").with_help(help));
        }
        Some(names)
    }

    /// Recorded quantities of a section, `[closed_loop]` or `[study]`.
    pub fn records(
        &mut self,
        of: &str,
        section: &Section<'a>,
        value: &'a Value<'a>,
        scope: &LoopScope<'_, 'a>,
    ) -> Vec<Record> {
        let span = section.key_span("record");
        let Some(table) = self.table(value, span, &format!("[{of}.record]")) else {
            return Vec::new();
        };
        let mut all = Vec::new();
        for (name, span, value) in table.entries() {
            let states = scope.states.iter().chain(scope.controls);
            let own = match of {
                "study" => &schema::STUDY,
                _ => &schema::CLOSED_LOOP,
            };
            let taken = own.reserves(name)
                || states.into_iter().any(|d| d.name == name)
                || self.scope.get(name).is_some();
            if taken || !Self::is_name(name) {
                let message = format!("a recorded quantity cannot be named `{}`", shorten(name));
                let label = match taken {
                    true => "the name is taken, or none",
                    false => "not a name",
                };
                self.report(Problem::at(span, message, label));
                continue;
            }
            if let Some(record) = self.record(name, value) {
                all.push(record);
            }
        }
        all
    }

    fn record(&mut self, name: &str, value: &'a Value<'a>) -> Option<Record> {
        const CHOICES: [(&str, Extremum); 3] = [
            ("min", Extremum::Min),
            ("max", Extremum::Max),
            ("final", Extremum::Final),
        ];
        let what = format!("recorded quantity `{}`", shorten(name));
        let text = self.string(value, &what)?;
        let origin = self.origin(value, text);
        let mut tree = match parse_expression(text) {
            Ok(tree) => tree,
            Err(error) => {
                self.report(origin.syntax_problem(error));
                return None;
            }
        };
        let last = tree.pop();
        let call = match &last {
            Some(Ast::Call {
                function,
                arguments,
                ..
            }) if arguments.len() == 1 => CHOICES.iter().find(|(n, _)| n == function),
            _ => None,
        };
        let Some((_, extremum)) = call else {
            let message =
                format!("{what} must be min(...), max(...) or final(...) of one expression");
            self.report(origin.problem_of_all(message, "not one of these"));
            return None;
        };
        let purpose = Use {
            what: &what,
            allowed: Kinds::PARAMETER.and(Kinds::STATE).and(Kinds::CONTROL),
            rule: "parameters, states, controls and definitions of these",
        };
        let built = self.build(&tree, &origin, &purpose)?;
        Some(Record {
            name: name.to_owned(),
            extremum: *extremum,
            of: Located {
                expr: built.expr,
                span: value.span(),
            },
            text: text.to_owned(),
        })
    }

    fn sets(
        &mut self,
        section: &Section<'a>,
        value: &'a Value<'a>,
        records: &[Record],
    ) -> Vec<OperatingSet> {
        let span = section.key_span("sets");
        let Some(table) = self.table(value, span, "[closed_loop.sets]") else {
            return Vec::new();
        };
        // The recorded quantities are names in here, and nothing but numbers besides.
        let symbols: Vec<Id> = (records.iter())
            .map(|r| {
                let expr = self.graph.symbol(&r.name, Kind::State);
                let meaning = Meaning::Known {
                    expr,
                    kinds: Kinds::STATE,
                };
                let (role, span) = (Role::State, r.of.span.clone());
                self.scope.declare(
                    &r.name,
                    Entry {
                        role,
                        span,
                        meaning,
                    },
                );
                expr
            })
            .collect();
        for (name, span, _) in table.entries().filter(|(name, ..)| !Self::is_name(name)) {
            let message = format!("a set cannot be called `{}`", shorten(name));
            self.report(Problem::at(span, message, "not a name for a set"));
        }
        (table.entries())
            .filter_map(|(name, _, value)| self.set(name, value, records, &symbols))
            .collect()
    }

    fn set(
        &mut self,
        name: &str,
        value: &'a Value<'a>,
        records: &[Record],
        symbols: &[Id],
    ) -> Option<OperatingSet> {
        let what = format!("set `{}`", shorten(name));
        let purpose = Use {
            what: &what,
            allowed: Kinds::PARAMETER.and(Kinds::STATE),
            rule: "recorded quantities and numbers",
        };
        let (left, relation, right) = self.guard(value, &purpose)?;
        let record = |side: Id| symbols.iter().position(|s| *s == side);
        let (found, other, mirrored) = match (record(left), record(right)) {
            (Some(k), None) => (Some(k), right, false),
            (None, Some(k)) => (Some(k), left, true),
            _ => (None, left, false),
        };
        let fixed = |side: Id| {
            (self.graph.reachable(&[side]).into_iter()).all(|id| {
                self.graph
                    .as_symbol(id)
                    .is_none_or(|s| s.kind == Kind::Parameter)
            })
        };
        let Some(record) = found.filter(|_| fixed(other)) else {
            let names: Vec<&str> = records.iter().map(|r| r.name.as_str()).collect();
            let problem = Problem::at(
                value.span(),
                format!("{what} must compare one recorded quantity with a number"),
                "not such a comparison",
            );
            self.report(problem.with_help(format!("recorded: {}", names.join(", "))));
            return None;
        };
        let bound = self.graph.eval(&[other], &self.values)[0];
        if !bound.is_finite() {
            return self.refuse(
                value.span(),
                format!("the bound of {what} is {bound}"),
                "not finite",
            );
        }
        let above = matches!(relation, Relation::Greater | Relation::GreaterEqual);
        Some(OperatingSet {
            name: name.to_owned(),
            record,
            at_least: above != mirrored,
            bound,
            text: value.get_ref().as_str().unwrap_or_default().to_owned(),
        })
    }
}
