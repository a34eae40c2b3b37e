//! The sections with equations in states and controls: dynamics, cost, guards.

use super::build::Use;
use super::declare::Declared;
use super::lexer::Relation;
use super::reader::{Reader, Section, Value};
use super::scope::Kinds;
use crate::diagnostics::Problem;
use crate::diagnostics::did_you_mean;
use crate::diagnostics::shorten;
use crate::model::{Guard, Located};
use rustc_hash::FxHashMap;

/// Terminal cost with the time it is paid at.
#[derive(Clone, Debug)]
pub(super) struct Terminal {
    pub terminal: Located,
    pub final_time: f64,
}

/// `[cost]`.
#[derive(Clone, Debug, Default)]
pub(super) struct Cost {
    pub running: Option<Located>,
    pub terminal: Option<Terminal>,
    /// `final_time` or `terminal` stand in the file, right or wrong.
    pub finite: bool,
}

impl<'a> Reader<'a> {
    fn located(&mut self, value: &'a Value<'a>, purpose: &Use<'_>) -> Option<Located> {
        self.expression(value, purpose).map(|b| Located {
            expr: b.expr,
            span: value.span(),
        })
    }

    /// The entry of each state (or control) in a section, and a report for each entry of anything
    /// else.
    pub fn entries_of(&mut self, section: &Section<'a>, known: &[Declared<'a>], nouns: &str) {
        for (key, span, _) in section
            .entries()
            .filter(|(k, ..)| !known.iter().any(|d| d.name == *k))
        {
            let message = match self.scope.get(key) {
                Some(entry) => format!(
                    "`{key}` is {}; {} is for {nouns}",
                    entry.role.noun(),
                    section.name
                ),
                None => format!(
                    "unknown name `{}` in {}, which is for {nouns}",
                    shorten(key),
                    section.name
                ),
            };
            let help = did_you_mean(key, known.iter().map(|d| d.name));
            let problem = Problem {
                help,
                ..Problem::at(span, message, "not expected here")
            };
            self.report(problem);
        }
    }

    /// `[dynamics]`: the time derivative of each state; `None` where one is missing or wrong.
    ///
    /// `given` are the rates that follow from a mechanism, where there is one; without a section
    /// these must be all.
    pub fn dynamics(
        &mut self,
        section: Option<&Section<'a>>,
        states: &[Declared<'a>],
        given: &FxHashMap<String, Located>,
    ) -> Option<Vec<Located>> {
        if let Some(section) = section {
            self.entries_of(section, states, "states");
        }
        let mut all = Vec::with_capacity(states.len());
        for state in states {
            let value = section.and_then(|s| s.get(state.name));
            if let Some(rate) = given.get(state.name) {
                if let Some(value) = value {
                    let message = format!(
                        "the rate of `{}` follows from the mechanism",
                        shorten(state.name)
                    );
                    let problem = Problem::at(value.span(), message, "remove this");
                    self.report(problem.with_help("forces are written in [mechanism.forces]"));
                }
                all.push(Some(rate.clone()));
                continue;
            }
            let Some(value) = value else {
                let message = format!(
                    "state `{}` has no equation in [dynamics]",
                    shorten(state.name)
                );
                let help = format!("add {} = \"...\", its time derivative", shorten(state.name));
                self.report(
                    Problem::at(state.span.clone(), message, "declared here").with_help(help),
                );
                all.push(None);
                continue;
            };
            let what = format!("the dynamics of `{}`", shorten(state.name));
            let rule = "parameters, states, controls, disturbances and definitions";
            all.push(self.located(
                value,
                &Use {
                    what: &what,
                    allowed: Kinds::ALL,
                    rule,
                },
            ));
        }
        all.into_iter().collect()
    }

    /// `[cost]`.
    pub fn cost(&mut self, section: &Section<'a>) -> Cost {
        self.check_keys(section, "cost");
        let rule = "parameters, states, controls, disturbances and definitions";
        let running = match section.get("running") {
            Some(value) => self.located(
                value,
                &Use {
                    what: "the running cost",
                    allowed: Kinds::ALL,
                    rule,
                },
            ),
            None => {
                let problem = Problem::at(
                    section.span.clone(),
                    "[cost] has no running cost",
                    "`running` is missing",
                );
                self.report(problem.with_help("add running = \"...\", an expression"));
                None
            }
        };
        let terminal = section.get("terminal").map(|value| {
            let allowed = Kinds::PARAMETER.and(Kinds::STATE);
            let rule = "parameters, states and definitions without controls";
            self.located(
                value,
                &Use {
                    what: "the terminal cost",
                    allowed,
                    rule,
                },
            )
        });
        let final_time = section
            .get("final_time")
            .map(|value| self.number_that(value, "the final time", "greater than 0", |t| t > 0.0));
        let finite = terminal.is_some() || final_time.is_some();
        let terminal = match (terminal, final_time) {
            (Some(terminal), Some(time)) => {
                terminal.zip(time).map(|(terminal, final_time)| Terminal {
                    terminal,
                    final_time,
                })
            }
            (Some(_), None) => self.refuse(
                section.key_span("terminal"),
                "a terminal cost needs a final time",
                "no final_time with it",
            ),
            (None, Some(_)) => {
                let help = "add terminal = \"...\", an expression of the states; \"0\" for none";
                let message = "a final time needs a terminal cost";
                self.report(
                    Problem::at(
                        section.key_span("final_time"),
                        message,
                        "no terminal with it",
                    )
                    .with_help(help),
                );
                None
            }
            (None, None) => None,
        };
        Cost {
            running,
            terminal,
            finite,
        }
    }

    /// `[guards]`.
    pub fn guards(&mut self, section: &Section<'a>) -> Vec<Guard> {
        section
            .entries()
            .filter_map(|(name, _, value)| {
                self.condition(name, &format!("guard `{}`", shorten(name)), value)
            })
            .collect()
    }

    /// A comparison of expressions in the states; `what` is for messages.
    pub fn condition(&mut self, name: &str, what: &str, value: &'a Value<'a>) -> Option<Guard> {
        let allowed = Kinds::PARAMETER.and(Kinds::STATE);
        let rule = "parameters, states and definitions without controls";
        let (left, relation, right) = self.guard(
            value,
            &Use {
                what,
                allowed,
                rule,
            },
        )?;
        let expr = match relation {
            Relation::Less | Relation::LessEqual => self.graph.sub(right, left),
            Relation::Greater | Relation::GreaterEqual => self.graph.sub(left, right),
        };
        let strict = matches!(relation, Relation::Less | Relation::Greater);
        Some(Guard {
            name: name.to_owned(),
            condition: Located {
                expr,
                span: value.span(),
            },
            strict,
        })
    }
}
