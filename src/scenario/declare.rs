//! The sections that declare names: parameters, states, controls, disturbances, definitions.

use super::build::{Built, Origin, Use};
use super::document::Given;
use super::hints;
use super::lexer::is_identifier;
use super::mechanism::Generated;
use super::parser::{Ast, parse_expression};
use super::reader::{Reader, Section, Value};
use super::scope::{Entry, Kinds, Meaning, Role, reserved};
use crate::diagnostics::Problem;
use crate::diagnostics::did_you_mean;
use crate::diagnostics::shorten;
use crate::expr::{Id, Kind};
use crate::model::{Control, Parameter, Span, State, Variable};
use crate::numeric::digits::plain;
use rustc_hash::FxHashMap;

/// A declared name with its value in the file.
#[derive(Clone, Debug)]
pub(super) struct Declared<'a> {
    pub name: &'a str,
    pub span: Span,
    pub value: &'a Value<'a>,
    /// The symbol; a definition has none.
    pub symbol: Option<Id>,
}

/// All declared names, in the file's order.
#[derive(Clone, Debug, Default)]
pub(super) struct Declarations<'a> {
    pub parameters: Vec<Declared<'a>>,
    pub states: Vec<Declared<'a>>,
    pub controls: Vec<Declared<'a>>,
    pub disturbances: Vec<Declared<'a>>,
    pub definitions: Vec<Declared<'a>>,
}

impl Declarations<'_> {
    /// Whether there is a disturbance, which plays against the controls.
    pub fn is_game(&self) -> bool {
        !self.disturbances.is_empty()
    }
}

impl<'a> Reader<'a> {
    /// Enters the names of a section into the scope. A bad name is reported and entered
    /// nevertheless, so that its uses are not reported as well.
    pub fn declare(&mut self, section: Option<&Section<'a>>, role: Role) -> Vec<Declared<'a>> {
        let entries = section
            .map(|s| s.entries().collect::<Vec<_>>())
            .unwrap_or_default();
        entries
            .into_iter()
            .map(|(name, span, value)| self.declare_one(name, span, value, role))
            .collect()
    }

    /// Enters the states: those of the mechanism, which the section may describe, and its others.
    pub fn declare_states(
        &mut self,
        section: Option<&Section<'a>>,
        generated: &'a Generated,
    ) -> Vec<Declared<'a>> {
        let mut declared = Vec::new();
        for state in &generated.states {
            let described =
                section.and_then(|s| Some((s.key_span(&state.name), s.get(&state.name)?)));
            let (span, value) = match described {
                Some((span, value)) => (span, value),
                None => (state.span.clone(), &generated.empty),
            };
            declared.push(self.declare_one(&state.name, span, value, Role::State));
        }
        let entries = section.into_iter().flat_map(Section::entries);
        for (name, span, value) in entries.filter(|(name, ..)| !generated.contains(name)) {
            declared.push(self.declare_one(name, span, value, Role::State));
        }
        declared
    }

    fn declare_one(
        &mut self,
        name: &'a str,
        span: Span,
        value: &'a Value<'a>,
        role: Role,
    ) -> Declared<'a> {
        self.check_name(name, &span);
        let kind = match role {
            Role::Parameter => Some(Kind::Parameter),
            Role::State => Some(Kind::State),
            Role::Control => Some(Kind::Control),
            Role::Disturbance => Some(Kind::Disturbance),
            Role::Definition | Role::Quantity => None,
        };
        let symbol = kind.map(|kind| self.graph.symbol(name, kind));
        if let Some(first) = self.scope.get(name) {
            let line = crate::diagnostics::position(self.text, first.span.start).0;
            let message = format!("`{name}` is already {} (line {line})", first.role.noun());
            self.report(
                Problem::at(span.clone(), message, "declared a second time")
                    .with_help("every name once"),
            );
        } else {
            let meaning = match (role, symbol) {
                (Role::State | Role::Control | Role::Disturbance, Some(expr)) => Meaning::Known {
                    expr,
                    kinds: role.kinds(),
                },
                _ => Meaning::Later,
            };
            self.scope.declare(
                name,
                Entry {
                    role,
                    span: span.clone(),
                    meaning,
                },
            );
        }
        Declared {
            name,
            span,
            value,
            symbol,
        }
    }

    fn check_name(&mut self, name: &str, span: &Span) {
        if !is_identifier(name) {
            let message = format!(
                "`{}` cannot be a name",
                shorten(&name.escape_debug().to_string())
            );
            let help =
                "a name has letters a to z, A to Z, digits and _, and does not begin with a digit";
            self.report(Problem::at(span.clone(), message, "not a name").with_help(help));
        } else if reserved().any(|r| r == name) {
            let what = if name == "pi" {
                "the number pi"
            } else {
                "a function"
            };
            let message = format!("`{name}` is {what}, and cannot be declared");
            self.report(Problem::at(span.clone(), message, "a reserved name"));
        }
    }

    /// Evaluates the parameters in order, with the definitions given on the command line in place
    /// of the file's.
    pub fn parameters(
        &mut self,
        declared: &[Declared<'a>],
        overrides: &[(String, Given)],
    ) -> Vec<Parameter> {
        let mut replaced: FxHashMap<&str, &Given> = FxHashMap::default();
        for (name, value) in overrides {
            if declared.iter().any(|d| d.name == name) {
                replaced.insert(name, value);
            } else {
                self.unknown_override(name, &value.text());
            }
        }
        declared
            .iter()
            .filter_map(|d| self.parameter(d, replaced.get(d.name).copied()))
            .collect()
    }

    fn unknown_override(&mut self, name: &str, value: &str) {
        let (name, typed) = (shorten(name), shorten(&format!("{name}={value}")));
        let message = match self.scope.get(&name) {
            Some(entry) => format!(
                "--set {typed}: `{name}` is {}, not a parameter",
                entry.role.noun()
            ),
            None => format!("--set {typed}: there is no parameter `{name}`"),
        };
        let help = did_you_mean(&name, self.scope.names(Some(Role::Parameter)));
        self.report(Problem {
            message,
            span: None,
            label: String::new(),
            help,
        });
    }

    /// The node of a number; a negative one is made as the parser makes it, so that graphs do not
    /// depend on how it was given.
    fn number_built(&mut self, number: f64) -> Built {
        let size = self.graph.constant(number.abs());
        let expr = if number.is_sign_negative() {
            self.graph.neg(size)
        } else {
            size
        };
        Built {
            expr,
            kinds: Kinds::NONE,
        }
    }

    /// What a parameter is replaced by. `inf` and `nan`, which other programs take for numbers, are
    /// refused as such, not as unknown names.
    fn given_built(
        &mut self,
        name: &str,
        text: &str,
        (origin, purpose): (&Origin, &Use<'_>),
    ) -> Option<Built> {
        let Some(hint) = hints::of_no_number(text) else {
            return self.parse_and_build(text, origin, purpose);
        };
        let typed = shorten(&format!("{name}={text}"));
        self.report(Problem {
            message: format!("--set {typed}: {} is a finite number", purpose.what),
            span: None,
            label: String::new(),
            help: Some(hint.to_owned()),
        });
        None
    }

    fn parameter(
        &mut self,
        declared: &Declared<'a>,
        replacement: Option<&Given>,
    ) -> Option<Parameter> {
        let name = declared.name;
        let what = format!("parameter `{}`", shorten(name));
        let purpose = Use {
            what: &what,
            allowed: Kinds::PARAMETER,
            rule: "numbers and earlier parameters",
        };
        self.scope.set(name, Role::Parameter, Meaning::Current);
        let command_line = replacement.map(|given| {
            let typed = Origin::CommandLine(shorten(&format!("{name}={}", given.text())));
            (given, typed)
        });
        let built = match &command_line {
            Some((Given::Text(text), origin)) => self.given_built(name, text, (origin, &purpose)),
            Some((Given::Number(number), _)) => Some(self.number_built(*number)),
            None => self.expression(declared.value, &purpose),
        };
        let value = built.and_then(|b| {
            let value = self.graph.eval(&[b.expr], &self.values)[0];
            if !value.is_finite() {
                let origin = match command_line {
                    Some((_, origin)) => origin,
                    None => self.origin(declared.value, ""),
                };
                self.report(origin.problem_of_all(format!("{what} is {value}"), "not finite"));
            }
            value.is_finite().then_some(value)
        });
        let Some((value, symbol)) = value.zip(declared.symbol) else {
            self.scope.set(name, Role::Parameter, Meaning::Broken);
            return None;
        };
        self.values.insert(symbol, value);
        self.scope.set(
            name,
            Role::Parameter,
            Meaning::Known {
                expr: symbol,
                kinds: Kinds::PARAMETER,
            },
        );
        Some(Parameter {
            name: name.to_owned(),
            symbol,
            value,
        })
    }

    /// The definitions that use what is known only later, by themselves or by others.
    pub fn late(&self, declared: &[Declared<'a>]) -> Vec<bool> {
        let mut quantities = self.scope.names(Some(Role::Quantity));
        let is_later =
            |name: &str| (self.scope.get(name)).map(|e| e.meaning) == Some(Meaning::Later);
        if !quantities.any(is_later) {
            return vec![false; declared.len()];
        }
        let mut late: Vec<&str> = Vec::new();
        let is_quantity = |name: &str| {
            let entry = self.scope.get(name);
            entry.is_some_and(|e| e.role == Role::Quantity && e.meaning == Meaning::Later)
        };
        declared
            .iter()
            .map(|d| {
                let text = d.value.get_ref().as_str().unwrap_or_default();
                let tree = parse_expression(text).unwrap_or_default();
                let is_late = tree.iter().any(|ast| {
                    matches!(ast, Ast::Name(name, _) if is_quantity(name) || late.contains(name))
                });
                if is_late {
                    late.push(d.name);
                }
                is_late
            })
            .collect()
    }

    /// Builds definitions in order.
    pub fn definitions<'d>(&mut self, declared: impl Iterator<Item = &'d Declared<'a>>)
    where
        'a: 'd,
    {
        for d in declared {
            let what = format!("definition `{}`", shorten(d.name));
            let rule = "everything but definitions further down";
            self.scope.set(d.name, Role::Definition, Meaning::Current);
            let built = self.expression(
                d.value,
                &Use {
                    what: &what,
                    allowed: Kinds::ALL,
                    rule,
                },
            );
            let meaning = built.map_or(Meaning::Broken, |b| Meaning::Known {
                expr: b.expr,
                kinds: b.kinds,
            });
            self.scope.set(d.name, Role::Definition, meaning);
        }
    }

    /// Reads what the file says about the states; `None` where anything is wrong.
    pub fn states(&mut self, declared: &[Declared<'a>]) -> Option<Vec<State>> {
        all(declared.iter().map(|d| self.state(d)).collect())
    }

    fn state(&mut self, declared: &Declared<'a>) -> Option<State> {
        let what = format!("state `{}`", shorten(declared.name));
        let section = self.table(declared.value, declared.span.clone(), &what)?;
        self.check_keys(&section, "states");
        let variable = self.variable(declared, &section)?;
        let period = section.get("period").and_then(|v| {
            let what = format!("the period of {what}");
            self.number_that(v, &what, "greater than 0", |p| p > 0.0)
        });
        Some(State { variable, period })
    }

    /// Reads what the file says about the controls; `None` where anything is wrong.
    pub fn controls(&mut self, declared: &[Declared<'a>]) -> Option<Vec<Control>> {
        all(declared.iter().map(|d| self.control(d)).collect())
    }

    fn control(&mut self, declared: &Declared<'a>) -> Option<Control> {
        let what = format!("control `{}`", shorten(declared.name));
        let section = self.table(declared.value, declared.span.clone(), &what)?;
        self.check_keys(&section, "controls");
        let variable = self.variable(declared, &section)?;
        let mut bound = |key: &str| {
            section
                .get(key)
                .and_then(|v| self.number(v, &format!("the {key} of {what}")))
        };
        let (min, max) = (bound("min"), bound("max"));
        let spans = [section.get("min"), section.get("max")].map(|v| v.map(|v| v.span()));
        let bounds_span = match spans {
            [Some(a), Some(b)] => Some(a.start.min(b.start)..a.end.max(b.end)),
            [a, b] => a.or(b),
        };
        if let (Some(min), Some(max), Some(span)) = (min, max, section.get("max").map(|v| v.span()))
            && min >= max
        {
            let (min, max) = (plain(min), plain(max));
            let message = format!("the max of {what} must be above its min, but {max} <= {min}");
            self.report(Problem::at(span, message, format!("min is {min}")));
        }
        Some(Control {
            variable,
            min,
            max,
            bounds_span,
        })
    }

    /// Reads what the file says about the disturbances; `None` where anything is wrong.
    pub fn disturbances(&mut self, declared: &[Declared<'a>]) -> Option<Vec<Variable>> {
        all(declared.iter().map(|d| self.disturbance(d)).collect())
    }

    fn disturbance(&mut self, declared: &Declared<'a>) -> Option<Variable> {
        let what = format!("disturbance `{}`", shorten(declared.name));
        let section = self.table(declared.value, declared.span.clone(), &what)?;
        self.check_keys(&section, "disturbances");
        self.variable(declared, &section)
    }

    /// The unit that a section names.
    pub fn unit(&mut self, section: &Section<'a>) -> Option<String> {
        let value = section.get("unit")?;
        let what = format!("the unit of {}", section.name);
        self.label(value, &what).map(str::to_owned)
    }

    fn variable(&mut self, declared: &Declared<'a>, section: &Section<'a>) -> Option<Variable> {
        let mut text = |key: &str| {
            let what = format!("the {key} of {}", section.name);
            section
                .get(key)
                .and_then(|v| self.label(v, &what))
                .map(str::to_owned)
        };
        let (unit, long_name) = (text("unit"), text("long_name"));
        let (name, symbol, span) = (
            declared.name.to_owned(),
            declared.symbol?,
            declared.span.clone(),
        );
        Some(Variable {
            name,
            unit,
            long_name,
            symbol,
            span,
        })
    }
}

/// All or nothing, once everything has been read (and its problems reported).
fn all<T>(items: Vec<Option<T>>) -> Option<Vec<T>> {
    items.into_iter().collect()
}
