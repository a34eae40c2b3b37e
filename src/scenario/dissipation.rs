//! `[dissipation]`: which disturbances the certified gain is checked with.

use super::closed_loop::LoopScope;
use super::reader::{Reader, Section, Value};
use crate::diagnostics::Problem;
use crate::diagnostics::shorten;
use crate::model::Dissipation;
use toml::de::DeValue;

/// Disturbances under each law unless `disturbances` says otherwise.
const DEFAULT_DISTURBANCES: usize = 10_000;
/// The most of one check.
/// Points of all disturbances together, at most: their states are held in memory.
const MOST_POINTS: f64 = 1e8;
const MOST: u32 = 10_000_000;
/// Times at which the inequality is checked unless `samples` says otherwise.
const DEFAULT_SAMPLES: usize = 200;

impl<'a> Reader<'a> {
    /// `[dissipation]`; `None` where something in it is wrong. Laws of its own are those of
    /// `[closed_loop]`.
    pub fn dissipation(
        &mut self,
        section: &Section<'a>,
        closed_loop: Option<&Section<'a>>,
        scope: &LoopScope<'_, 'a>,
    ) -> Option<Dissipation> {
        self.check_keys(section, "dissipation");
        let before = self.problems.len();
        if scope.disturbances.is_empty() {
            let problem = Problem::at(
                section.span.clone(),
                "[dissipation] checks an L2 gain, and the scene has no disturbance",
                "nothing to check",
            );
            self.report(
                problem.with_help("declare disturbances in [disturbances], or remove this section"),
            );
        }
        if scope.finite {
            let message =
                "[dissipation] needs an infinite horizon: with a final time V depends on time too";
            self.report(Problem::at(
                section.span.clone(),
                message,
                "not with [cost] final_time",
            ));
        }
        let disturbances = section.get("disturbances").and_then(|v| {
            let wanted = format!("a whole number from 1 to {MOST}");
            let fits = |n: f64| n.fract() == 0.0 && (1.0..=f64::from(MOST)).contains(&n);
            self.number_that(v, "disturbances", &wanted, fits)
                .map(|n| n as usize)
        });
        let final_time = self.auto_or_positive(section, "final_time");
        let period = (section.get("period"))
            .and_then(|v| self.number_that(v, "period", "greater than 0", |v| v > 0.0));
        let samples = section.get("samples").and_then(|v| self.sample_count(v));
        let points = disturbances.unwrap_or(DEFAULT_DISTURBANCES) as f64
            * samples.unwrap_or(DEFAULT_SAMPLES) as f64;
        if points > MOST_POINTS {
            let message = format!(
                "{points:.1e} points of all disturbances together; at most {MOST_POINTS:.0e} are looked at"
            );
            let help = "fewer disturbances, or fewer samples";
            let problem = Problem::at(section.span.clone(), message, "too many");
            self.report(problem.with_help(help));
        }
        let amplitude = (section.get("amplitude").filter(|v| !is_auto(v)))
            .and_then(|v| self.amplitudes(v, section, scope));
        let frequencies =
            (section.get("frequencies").filter(|v| !is_auto(v))).and_then(|v| self.band(v));
        let initial = section
            .get("initial")
            .and_then(|_| self.starts(section, scope, false));
        let given: Vec<&str> = match closed_loop.and_then(|s| s.get("law")).map(|v| v.get_ref()) {
            Some(DeValue::Table(table)) => table.keys().map(|k| k.get_ref().as_ref()).collect(),
            _ => Vec::new(),
        };
        let laws = section
            .get("laws")
            .and_then(|v| self.law_names(v, &given, scope));
        (self.problems.len() == before).then(|| Dissipation {
            disturbances: disturbances.unwrap_or(DEFAULT_DISTURBANCES),
            final_time,
            amplitude,
            frequencies,
            laws,
            initial,
            samples: samples.unwrap_or(DEFAULT_SAMPLES),
            period,
            span: section.span.clone(),
        })
    }

    fn auto_or_positive(&mut self, section: &Section<'a>, key: &str) -> Option<f64> {
        let value = section.get(key).filter(|v| !is_auto(v))?;
        self.number_that(value, key, "greater than 0", |v| v > 0.0)
    }

    /// One number for all disturbances, or a table with one for each.
    fn amplitudes(
        &mut self,
        value: &'a Value<'a>,
        section: &Section<'a>,
        scope: &LoopScope<'_, 'a>,
    ) -> Option<Vec<f64>> {
        let positive = |v: f64| v > 0.0;
        if !matches!(value.get_ref(), DeValue::Table(_)) {
            let one = self.number_that(value, "amplitude", "greater than 0", positive)?;
            return Some(vec![one; scope.disturbances.len()]);
        }
        let table = self.table(value, section.key_span("amplitude"), "amplitude")?;
        self.entries_of(&table, scope.disturbances, "disturbances");
        let all: Vec<Option<f64>> = (scope.disturbances.iter())
            .map(|w| {
                let name = shorten(w.name);
                match table.get(w.name) {
                    Some(value) => self.number_that(
                        value,
                        &format!("the amplitude of `{name}`"),
                        "greater than 0",
                        positive,
                    ),
                    None => self.refuse(
                        table.span.clone(),
                        format!("disturbance `{name}` has no amplitude"),
                        "a number is missing",
                    ),
                }
            })
            .collect();
        all.into_iter().collect()
    }

    fn band(&mut self, value: &'a Value<'a>) -> Option<[f64; 2]> {
        let ends = self.array(value, "frequencies", "[lowest, highest]", 2)?;
        let positive = |v: f64| v > 0.0;
        let lowest = self.number_that(&ends[0], "the lowest frequency", "greater than 0", positive);
        let highest = self.number_that(
            &ends[1],
            "the highest frequency",
            "greater than 0",
            positive,
        );
        let (lowest, highest) = (lowest?, highest?);
        if lowest >= highest {
            let message = format!("frequencies are none: {lowest} is not below {highest}");
            return self.refuse(value.span(), message, "the lower end comes first");
        }
        Some([lowest, highest])
    }
}

/// `"auto"`, which is as good as leaving a key out.
fn is_auto(value: &Value<'_>) -> bool {
    value.get_ref().as_str() == Some("auto")
}
