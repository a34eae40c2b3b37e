//! Laws, closed loops and levels of attenuation in numbers.
#![allow(missing_docs, reason = "fields whose name says what they are")]

use super::finite;
use crate::attenuation::{Attenuated, Covering, Row};
use crate::closed_loop::Evaluation;
use crate::closed_loop::dissipation::Dissipation;
use crate::feedback::{Errors, Exports, Fitted, FittedLaw};
use crate::local::{Cause, LinearAttenuation};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;

fn owned(counts: BTreeMap<&str, usize>) -> BTreeMap<String, usize> {
    let all = counts.into_iter();
    all.map(|(name, n)| (name.to_owned(), n)).collect()
}

/// Closed loops of several laws from the same initial states.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EvaluationSummary {
    pub file: String,
    pub initial_states: usize,
    pub backend: String,
    pub adapter: String,
    /// Initial states at which V is known.
    pub values_known: usize,
    pub laws: Vec<LawSummary>,
}

/// A law in the closed loop.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LawSummary {
    pub name: String,
    pub source: String,
    pub share_converged: f64,
    /// J/V - 1.
    pub suboptimality: Option<Suboptimality>,
    /// The worst of each recorded quantity.
    pub worst: BTreeMap<String, Option<f64>>,
    /// The operating sets of the scene.
    pub sets: BTreeMap<String, SetSummary>,
    pub statuses: BTreeMap<String, usize>,
    /// Share of the updates at which the map had no answer.
    pub held: f64,
    /// Trajectories with such updates.
    pub fell_back: usize,
    pub seconds: f64,
    pub states_per_second: Option<f64>,
}

/// Quantiles of J/V - 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Suboptimality {
    pub median: f64,
    pub p99: f64,
    pub max: f64,
    /// Initial states they are of.
    pub count: usize,
}

/// An operating set.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SetSummary {
    /// Share of the initial states inside.
    pub share: f64,
    pub area: Option<f64>,
}

impl EvaluationSummary {
    /// `file` is where the evaluation is.
    #[must_use]
    pub fn new(e: &Evaluation, file: &Path) -> Self {
        let laws = e.laws.iter().zip(&e.sets).map(|(law, sets)| LawSummary {
            name: law.name.clone(),
            source: law.source.clone(),
            share_converged: law.share_converged(),
            suboptimality: e.spread(law).map(|s| Suboptimality {
                median: s.median,
                p99: s.p99,
                max: s.worst,
                count: s.count,
            }),
            worst: (e.closed_loop.records.iter().enumerate())
                .map(|(k, record)| (record.name.clone(), finite(e.worst(law, k))))
                .collect(),
            sets: (e.closed_loop.sets.iter().zip(sets))
                .map(|(set, r)| {
                    let (share, area) = (r.share, finite(r.area));
                    (set.name.clone(), SetSummary { share, area })
                })
                .collect(),
            statuses: owned(e.statuses(law)),
            held: law.held,
            fell_back: law.fell_back(),
            seconds: law.seconds,
            states_per_second: finite(law.rate()),
        });
        Self {
            file: file.display().to_string(),
            initial_states: e.initial.count(),
            backend: e.backend.clone(),
            adapter: e.adapter.clone(),
            values_known: e.values.iter().filter(|v| !v.is_nan()).count(),
            laws: laws.collect(),
        }
    }
}

/// The dissipation inequality, checked by simulation.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DissipationSummary {
    pub disturbances: usize,
    pub final_time: f64,
    /// Where V is from.
    pub value_function: &'static str,
    pub frequencies: [f64; 2],
    pub backend: String,
    pub adapter: String,
    pub precision: &'static str,
    pub rtol: f64,
    pub laws: Vec<LawCheckSummary>,
}

/// A law under all disturbances.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LawCheckSummary {
    pub name: String,
    pub source: String,
    pub held: bool,
    pub verdict: String,
    pub kinds: BTreeMap<&'static str, KindSummary>,
    pub statuses: BTreeMap<String, usize>,
    pub seconds: f64,
}

/// A law under disturbances of one kind.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct KindSummary {
    pub count: usize,
    pub judged: usize,
    pub left: usize,
    pub median_ratio: Option<f64>,
    pub worst_ratio: Option<f64>,
    pub worst_violation: Option<f64>,
    pub exceeded: usize,
    pub violated: usize,
    pub unexplained: usize,
}

impl DissipationSummary {
    #[must_use]
    pub fn new(d: &Dissipation) -> Self {
        let laws = d.laws.iter().map(|law| {
            let (held, verdict) = law.verdict(&d.cases);
            let kinds = law.summaries(&d.cases).into_iter().map(|s| {
                let row = KindSummary {
                    count: s.count,
                    judged: s.judged,
                    left: s.left,
                    median_ratio: finite(s.median_ratio),
                    worst_ratio: finite(s.worst_ratio),
                    worst_violation: finite(s.worst_violation),
                    exceeded: s.exceeded,
                    violated: s.violated,
                    unexplained: s.unexplained,
                };
                (s.kind.name(), row)
            });
            LawCheckSummary {
                name: law.name.clone(),
                source: law.source.clone(),
                held,
                verdict,
                kinds: kinds.collect(),
                statuses: owned(d.statuses(law)),
                seconds: law.seconds,
            }
        });
        Self {
            disturbances: d.cases.count(),
            final_time: d.final_time,
            value_function: d.value,
            frequencies: d.frequencies,
            backend: d.backend.clone(),
            adapter: d.adapter.clone(),
            precision: d.numerics.precision.name(),
            rtol: d.numerics.rtol,
            laws: laws.collect(),
        }
    }
}

/// A fitted law.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FittedSummary {
    pub name: String,
    /// What the network gives: V, or the controls.
    pub kind: &'static str,
    pub outputs: Vec<String>,
    pub parameters: usize,
    pub flops: f64,
    /// Of the training, validation and test sets.
    pub samples: [usize; 3],
    pub trajectories: [usize; 3],
    pub not_optimal: usize,
    pub u_error: ErrorsSummary,
    #[serde(rename = "V_error")]
    pub value_error: Option<ErrorsSummary>,
    pub p_error: Option<ErrorsSummary>,
    pub hjb_residual: Option<ResidualSummary>,
    pub loss: Option<LossSummary>,
    pub narrow_units: usize,
    pub training_residual: f64,
    pub validation_residual: f64,
    pub iterations: usize,
    pub starts: usize,
    pub seed: u64,
    pub seconds: f64,
    pub files: Vec<String>,
    pub without_onnx: Option<String>,
}

/// Errors on the test set, relative to the mean size or to the range.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ErrorsSummary {
    pub mean: Option<f64>,
    pub max: Option<f64>,
    pub mean_of_range: Option<f64>,
}

impl From<&Errors> for ErrorsSummary {
    fn from(e: &Errors) -> Self {
        Self {
            mean: finite(e.mean),
            max: finite(e.max),
            mean_of_range: finite(e.mean_of_range),
        }
    }
}

/// Quantiles of |H(x, dV/dx)| relative to the running cost.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ResidualSummary {
    pub running_cost_scale: f64,
    pub median: f64,
    pub q90: f64,
    pub q99: f64,
    pub max: f64,
}

/// What a law's control loses, relative to the running cost.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LossSummary {
    pub running_cost_scale: f64,
    pub mean: f64,
    pub q99: f64,
    pub max: f64,
    /// State of the largest.
    pub at: Vec<f64>,
    /// Box of the states with the largest hundredth.
    pub worst: Vec<[f64; 2]>,
}

impl FittedSummary {
    /// One a law, in their order.
    #[must_use]
    pub fn all(fitted: &Fitted, exports: &[Exports]) -> Vec<Self> {
        let laws = fitted.laws.iter().zip(exports);
        laws.map(|(law, files)| Self::new(law, files)).collect()
    }

    #[must_use]
    pub fn new(l: &FittedLaw, exports: &Exports) -> Self {
        let q = &l.quality;
        Self {
            name: l.name.clone(),
            kind: l.law.meaning.name(),
            outputs: l.form.outputs.clone(),
            parameters: l.parameters,
            flops: l.flops,
            samples: l.sets,
            trajectories: l.trajectories,
            not_optimal: l.selection.not_optimal,
            u_error: (&q.u).into(),
            value_error: q.v.as_ref().map(Into::into),
            p_error: q.p.as_ref().map(Into::into),
            hjb_residual: q.hjb.map(|h| ResidualSummary {
                running_cost_scale: h.scale,
                median: h.median,
                q90: h.q90,
                q99: h.q99,
                max: h.max,
            }),
            loss: q.loss.as_ref().map(|e| LossSummary {
                running_cost_scale: e.scale,
                mean: e.mean,
                q99: e.q99,
                max: e.max,
                at: e.at.clone(),
                worst: e.worst.clone(),
            }),
            narrow_units: l.narrow_units,
            training_residual: l.residuals[0],
            validation_residual: l.residuals[1],
            iterations: l.iterations,
            starts: l.starts,
            seed: l.seed,
            seconds: l.seconds,
            files: (exports.files.iter())
                .map(|f| f.display().to_string())
                .collect(),
            without_onnx: exports.without_onnx.clone(),
        }
    }
}

/// The smallest level of attenuation of a linearization.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LinearSummary {
    pub star: f64,
    /// The same from the Hamiltonian matrix.
    pub star_hamiltonian: f64,
    pub difference: f64,
    pub cause: &'static str,
    /// Whether the search ended above it.
    pub at_or_below: bool,
}

impl From<&LinearAttenuation> for LinearSummary {
    fn from(linear: &LinearAttenuation) -> Self {
        Self {
            star: linear.star,
            star_hamiltonian: linear.hamiltonian,
            difference: linear.difference(),
            cause: linear.cause.name(),
            at_or_below: linear.cause == Cause::None,
        }
    }
}

/// The smallest levels of attenuation of a scene.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AttenuationSummary {
    #[serde(flatten)]
    pub linear: LinearSummary,
    pub parameter: String,
    /// The scene's own value.
    pub own: f64,
    /// States at which coverage is judged.
    pub states: usize,
    /// `smallest`, `all` or `never`.
    pub covered: &'static str,
    pub smallest_covering: Option<f64>,
    pub bracket: [Option<f64>; 2],
    pub first_failing: Option<BTreeMap<String, usize>>,
    pub monotone: bool,
    pub covering_below: Vec<f64>,
    pub levels: Vec<f64>,
    pub curve: Vec<LevelSummary>,
}

/// A level of the curve.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LevelSummary {
    pub value: f64,
    pub coverage: f64,
    pub valid: usize,
    pub wanted: usize,
    pub failing: BTreeMap<String, usize>,
    pub failure: Option<String>,
}

impl AttenuationSummary {
    #[must_use]
    pub fn new(found: &Attenuated) -> Self {
        let (covered, bracket) = match found.search.covering {
            Covering::Smallest { lower, upper } => ("smallest", [Some(lower), Some(upper)]),
            Covering::All { upper } => ("all", [None, Some(upper)]),
            Covering::Never { top, .. } => ("never", [Some(top), None]),
        };
        let counts = |r: &Row| -> BTreeMap<String, usize> {
            let failing = r.failing();
            let named = failing.iter().map(|(s, n)| (s.name().to_owned(), *n));
            named.collect()
        };
        let row = |r: &Row| LevelSummary {
            value: r.value,
            coverage: r.coverage(),
            valid: r.valid(),
            wanted: r.wanted(),
            failing: counts(r),
            failure: r.outcome.failure.as_ref().map(ToString::to_string),
        };
        Self {
            linear: (&found.linear).into(),
            parameter: found.parameter.clone(),
            own: found.own,
            states: found.grid.len(),
            covered,
            smallest_covering: found.search.smallest(),
            bracket,
            first_failing: found.search.first_failing().map(counts),
            monotone: found.search.monotone,
            covering_below: found.search.covering_below(),
            levels: found.levels.clone(),
            curve: found.search.rows.iter().map(row).collect(),
        }
    }
}
