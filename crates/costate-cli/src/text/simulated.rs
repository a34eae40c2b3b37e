//! A simulation as text, and as JSON.

use super::counted;
use crate::common::columns::columns;
use costate::low_level::hybrid::{Cycle, CycleError};
use costate::low_level::model::Model;
use costate::session::{Simulated, end_name};
use serde_json::{Map, Value, json};
use std::path::Path;

/// Flights, and events of each, that are shown.
const MOST_FLIGHTS: usize = 10;
const MOST_EVENTS: usize = 12;

/// What a simulation came to.
pub struct Shown<'a> {
    pub model: &'a Model,
    pub simulated: &'a Simulated,
}

impl Shown<'_> {
    fn cycles(&self) -> Option<&[Result<Cycle, CycleError>]> {
        Some(&self.simulated.cycles.as_ref()?.found)
    }

    fn names(&self) -> impl Iterator<Item = &str> {
        let states = self.model.states.iter();
        states.map(|s| s.variable.name.as_str())
    }

    /// The name of an event that happened.
    fn event(&self, event: usize) -> &str {
        let name = &self.simulated.names[event];
        name.strip_prefix("event_").unwrap_or(name)
    }

    pub fn text(&self) -> String {
        let simulated = self.simulated;
        let count = simulated.flights.t.len();
        let mut lines = vec![format!(
            "{} simulated ({} {}, rtol {:e}), controls {}",
            counted(count, "flight"),
            simulated.method,
            simulated.precision.name(),
            simulated.rtol,
            match &simulated.law {
                Some(law) => format!("by law `{law}`"),
                None => "held".to_owned(),
            }
        )];
        for (k, found) in self.cycles().unwrap_or_default().iter().enumerate() {
            lines.push(self.cycle(k, found));
        }
        let ends = simulated.by_status();
        let ends: Vec<String> = ends
            .iter()
            .map(|(name, n)| format!("{name}: {n}"))
            .collect();
        lines.push(format!("how they ended: {}", ends.join(", ")));
        for flight in 0..count.min(MOST_FLIGHTS) {
            lines.push(self.flight(flight));
        }
        if count > MOST_FLIGHTS {
            let more = counted(count - MOST_FLIGHTS, "more flight");
            lines.push(format!("and {more}"));
        }
        lines.join("\n")
    }

    /// The table of a flight's events.
    fn flight(&self, flight: usize) -> String {
        let flights = &self.simulated.flights;
        let n = self.model.states.len();
        let numbers = |x: &[f64]| -> Vec<String> { x.iter().map(|v| number(*v, 9)).collect() };
        let row = |t: f64, what: &str, x: &[f64]| {
            [vec![what.to_owned(), number(t, 9)], numbers(x)].concat()
        };
        let head = ["".to_owned(), self.model.time_name().to_owned()];
        let mut rows = vec![
            head.into_iter()
                .chain(self.names().map(str::to_owned))
                .collect(),
            row(0.0, "begins", &self.simulated.initial[flight * n..][..n]),
        ];
        let first = flights.jumps.partition_point(|j| j.flight < flight);
        let last = flights.jumps.partition_point(|j| j.flight <= flight);
        let jumps = &flights.jumps[first..last];
        for jump in jumps.iter().take(MOST_EVENTS) {
            rows.push(row(jump.t, self.event(jump.event), &jump.before));
            rows.push(row(jump.t, "  after it", &jump.after));
        }
        if jumps.len() > MOST_EVENTS {
            let more = counted(jumps.len() - MOST_EVENTS, "more event");
            rows.push(vec![format!("{more} ...")]);
        }
        let end = format!("ends: {}", self.simulated.status(flight).replace('_', " "));
        rows.push(row(
            flights.t[flight],
            &end,
            &flights.last[flight * n..][..n],
        ));
        format!("\nflight {}\n{}", flight + 1, columns(&rows, &[0]))
    }

    fn cycle(&self, k: usize, found: &Result<Cycle, CycleError>) -> String {
        let which = match self.cycles().map_or(0, <[_]>::len) {
            1 => "orbit".to_owned(),
            _ => format!("orbit near state {}", k + 1),
        };
        match found {
            Ok(cycle) => {
                let x: Vec<String> = (self.names().zip(&cycle.start))
                    .map(|(name, x)| format!("{name} = {}", number(*x, 12)))
                    .collect();
                let multipliers: Vec<String> =
                    cycle.multipliers.iter().map(|m| complex(*m)).collect();
                format!(
                    "{which}: period {:.12}, {} (it comes back to within {:.1e}, after {})\n  begins at {}\n  multipliers {}",
                    cycle.period,
                    match (cycle.is_stable(), cycle.is_unstable()) {
                        (true, _) => "stable",
                        (_, true) => "unstable",
                        _ => "neither stable nor unstable",
                    },
                    cycle.residual,
                    counted(cycle.iterations, "iteration"),
                    x.join(", "),
                    multipliers.join(", ")
                )
            }
            Err(error) => format!("{which}: none found: {}", self.why(error)),
        }
    }

    fn why(&self, error: &CycleError) -> String {
        let state = |x: &[f64]| {
            let x: Vec<String> = (self.names().zip(x))
                .map(|(name, x)| format!("{name} = {}", number(*x, 6)))
                .collect();
            x.join(", ")
        };
        match error {
            CycleError::NoReturn { start, end } => {
                let end = end_name(&self.simulated.names, *end).replace('_', " ");
                let start = state(start);
                format!("a flight from {start} does not come back, but ends: {end}")
            }
            CycleError::AtRest { state: x } => format!(
                "what comes back is at rest, at {}; begin further from there",
                state(x)
            ),
            CycleError::Diverged { residual } => format!(
                "Newton's method on the return map does not converge (it comes back to within {residual:.1e} of the state)"
            ),
        }
    }

    pub fn json(&self, path: &Path, backend: &str, adapter: &str) -> Value {
        let (simulated, n) = (self.simulated, self.model.states.len());
        let flights = &simulated.flights;
        let state = |x: &[f64]| -> Value {
            let pairs = self
                .names()
                .zip(x)
                .map(|(name, x)| (name.to_owned(), json!(x)));
            Value::Object(pairs.collect::<Map<String, Value>>())
        };
        let mut jumps = flights.jumps.iter().peekable();
        let all: Vec<Value> = (0..flights.t.len())
            .map(|k| {
                let own = std::iter::from_fn(|| jumps.next_if(|j| j.flight == k));
                let events: Vec<Value> = own
                    .map(|j| {
                        json!({
                            "event": self.event(j.event), "t": j.t,
                            "before": state(&j.before), "after": state(&j.after),
                        })
                    })
                    .collect();
                json!({
                    "x0": state(&simulated.initial[k * n..][..n]),
                    "status": simulated.status(k),
                    "t_end": flights.t[k],
                    "x_end": state(&flights.last[k * n..][..n]),
                    "events": events,
                })
            })
            .collect();
        let cycles = self.cycles().map(|cycles| {
            let one = |found: &Result<Cycle, CycleError>| match found {
                Ok(cycle) => json!({
                    "x": state(&cycle.start), "period": cycle.period,
                    "multipliers": cycle.multipliers, "stable": cycle.is_stable(),
                    "residual": cycle.residual, "iterations": cycle.iterations,
                }),
                Err(error) => json!({ "none": self.why(error) }),
            };
            cycles.iter().map(one).collect::<Vec<Value>>()
        });
        json!({
            "title": self.model.title, "file": path.display().to_string(),
            "backend": backend, "adapter": adapter,
            "precision": simulated.precision.name(), "method": simulated.method,
            "rtol": simulated.rtol, "time": simulated.time, "law": simulated.law,
            "status": simulated.by_status(), "cycles": cycles, "flights": all,
            "steps": flights.steps, "rejected": flights.rejected,
        })
    }
}

/// Without the sign of a zero.
fn number(x: f64, digits: usize) -> String {
    let text = format!("{x:.digits$}");
    match text.strip_prefix('-') {
        Some(size) if size.bytes().all(|b| matches!(b, b'0' | b'.')) => size.to_owned(),
        _ => text,
    }
}

fn complex([re, im]: [f64; 2]) -> String {
    let size = re.hypot(im);
    match im.abs() > 1e-9 * size {
        true => format!(
            "{} {} {:.9} i (size {size:.9})",
            number(re, 9),
            if im < 0.0 { "-" } else { "+" },
            im.abs()
        ),
        false => number(re, 9),
    }
}
