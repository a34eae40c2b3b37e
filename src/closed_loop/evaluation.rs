//! What came of a simulation: costs against V, shares, operating sets.

use super::Path;
use super::gathered::NOT_MERGED;
use super::sets::{Line, area, contour};
use super::{Initial, Setting};
use crate::backend::{Backend, Status};
use crate::model::{ClosedLoop, Extremum, Method, OperatingSet};
use crate::numeric::quantile::nearest_rank;
use crate::sweep::Numerics;
use std::collections::BTreeMap;

/// One law, from all initial states.
#[derive(Clone, Debug, Default)]
pub struct LawResult {
    pub name: String,
    pub source: String,
    /// `[initial]`: running cost up to the end, and what the linear solution (or the terminal cost)
    /// says is left; NaN where the trajectory ended early.
    pub cost: Vec<f64>,
    /// `[initial][record]`.
    pub records: Vec<f64>,
    pub converged: Vec<bool>,
    pub status: Vec<i32>,
    pub t_end: Vec<f64>,
    pub paths: Vec<Path>,
    /// Updates of a chart's law, and the share of them at which the chart had no answer.
    pub updates: usize,
    pub held: f64,
    /// `[initial]`: how many they were.
    pub fallback: Vec<u32>,
    /// Of a chart's law: how often states went between the host and a device, or the host waited
    /// for one.
    pub round_trips: usize,
    /// Time taken, compilation not included.
    pub seconds: f64,
}

/// Quantiles of J/V - 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    pub median: f64,
    pub p99: f64,
    pub worst: f64,
    /// Initial states they are of.
    pub count: usize,
}

/// An operating set under one law.
#[derive(Clone, Debug, Default)]
pub struct SetResult {
    /// Of the initial states.
    pub share: f64,
    /// In the units of the grid's two axes; NaN where it has not two.
    pub area: f64,
    pub lines: Vec<Line>,
}

/// All laws from the same initial states.
#[derive(Clone, Debug)]
pub struct Evaluation {
    pub initial: Initial,
    /// V at the initial states; NaN where not known.
    pub values: Vec<f64>,
    pub laws: Vec<LawResult>,
    /// `[law][set]`.
    pub sets: Vec<Vec<SetResult>>,
    pub backend: String,
    pub adapter: String,
    /// The section that was simulated.
    pub closed_loop: ClosedLoop,
    pub numerics: Numerics,
    /// Method of the map's law, whose legs are a period long.
    pub leg_method: Method,
    /// A trajectory has converged where the quadratic form of its last deviation is below this.
    pub converged_below: f64,
    /// What that form is of: of the local solution, or of widths of the region.
    pub metric: &'static str,
    /// Status codes and their meanings.
    pub status_flags: Vec<(i32, String)>,
    /// What the codes mean that occur.
    pub status_names: BTreeMap<i32, String>,
    /// Below this cost V is too small for J/V - 1 to say anything.
    least_value: f64,
}

impl Evaluation {
    pub(super) fn new(
        setting: &Setting<'_>,
        initial: Initial,
        values: Vec<f64>,
        laws: Vec<LawResult>,
        backend: &dyn Backend,
    ) -> Self {
        let scene = setting.closed_loop;
        let mut this = Self {
            sets: Vec::new(),
            backend: backend.name().to_owned(),
            adapter: backend.adapter(),
            closed_loop: scene.clone(),
            numerics: setting.numerics,
            leg_method: setting.leg_method,
            converged_below: scene.converged * setting.scale,
            metric: if setting.local {
                "local solution"
            } else {
                "widths of the region"
            },
            status_flags: setting.status_flags(),
            status_names: (laws.iter().flat_map(|l| &l.status))
                .map(|s| (*s, setting.status_name(*s)))
                .collect(),
            // What is left of the absolute tolerance.
            least_value: 1e3 * setting.numerics.atol * setting.value_scale,
            initial,
            values,
            laws,
        };
        this.sets = (this.laws.iter())
            .map(|law| scene.sets.iter().map(|set| this.set(law, set)).collect())
            .collect();
        this
    }

    /// A state is inside where its trajectory went to its end and the quantity keeps within the
    /// bound.
    fn set(&self, law: &LawResult, set: &OperatingSet) -> SetResult {
        let levels: Vec<f64> = (0..self.initial.count())
            .map(|i| {
                let value = law.records[i * self.closed_loop.records.len() + set.record];
                let room = if set.at_least {
                    value - set.bound
                } else {
                    set.bound - value
                };
                if law.status[i] == Status::Reached as i32 {
                    room
                } else {
                    f64::NAN
                }
            })
            .collect();
        let there = law.there();
        let share = levels.iter().filter(|l| **l >= 0.0).count() as f64 / there.max(1) as f64;
        match self.initial.axes.as_slice() {
            [(_, a), (_, b)] => SetResult {
                share,
                // Of a set that is known in part.
                area: match there == levels.len() {
                    true => area([a, b], &levels),
                    false => f64::NAN,
                },
                lines: contour([a, b], &levels),
            },
            _ => SetResult {
                share,
                area: f64::NAN,
                lines: Vec::new(),
            },
        }
    }

    /// J/V - 1 from each initial state; NaN where V is not known, or the trajectory did not
    /// converge.
    pub fn suboptimality(&self, law: &LawResult) -> Vec<f64> {
        (law.cost.iter().zip(&self.values).zip(&law.converged))
            .map(|((j, v), converged)| {
                if *converged && *v > self.least_value {
                    j / v - 1.0
                } else {
                    f64::NAN
                }
            })
            .collect()
    }

    /// Its quantiles; `None` where there is none.
    pub fn spread(&self, law: &LawResult) -> Option<Spread> {
        let mut known: Vec<f64> = self
            .suboptimality(law)
            .into_iter()
            .filter(|s| !s.is_nan())
            .collect();
        known.sort_by(f64::total_cmp);
        (!known.is_empty()).then(|| Spread {
            median: nearest_rank(&known, 0.5),
            p99: nearest_rank(&known, 0.99),
            worst: nearest_rank(&known, 1.0),
            count: known.len(),
        })
    }

    /// The worst of a record under a law: the lowest minimum, the highest maximum or last value;
    /// NaN where there is none.
    pub fn worst(&self, law: &LawResult, record: usize) -> f64 {
        let count = self.closed_loop.records.len();
        let values = law
            .records
            .iter()
            .skip(record)
            .step_by(count)
            .filter(|v| !v.is_nan());
        match self.closed_loop.records[record].extremum {
            Extremum::Min => values.copied().reduce(f64::min),
            Extremum::Max | Extremum::Final => values.copied().reduce(f64::max),
        }
        .unwrap_or(f64::NAN)
    }

    /// `41 reached, 3 guard_x`.
    pub fn status_text(&self, law: &LawResult) -> String {
        let counts = self.statuses(law);
        let parts: Vec<String> = counts
            .iter()
            .map(|(name, count)| format!("{count} {name}"))
            .collect();
        parts.join(", ")
    }

    /// How many trajectories ended how, by name.
    pub fn statuses(&self, law: &LawResult) -> BTreeMap<&str, usize> {
        let mut counts = BTreeMap::new();
        for status in &law.status {
            *counts
                .entry(self.status_names[status].as_str())
                .or_default() += 1;
        }
        counts
    }
}

impl LawResult {
    /// Initial states that were simulated: of a whole of some parts not all.
    pub fn there(&self) -> usize {
        self.status.iter().filter(|s| **s != NOT_MERGED).count()
    }

    /// Of the initial states that were simulated.
    pub fn share_converged(&self) -> f64 {
        self.converged.iter().filter(|c| **c).count() as f64 / self.there().max(1) as f64
    }

    /// Of every trajectory the updates without an answer of the chart; 0 of a law without one.
    pub fn fallbacks(&self) -> Vec<i32> {
        let own = self.fallback.iter().map(|k| *k as i32);
        own.chain(std::iter::repeat(0))
            .take(self.status.len())
            .collect()
    }

    /// Trajectories along which the chart had no answer somewhere.
    pub fn fell_back(&self) -> usize {
        self.fallback.iter().filter(|k| **k > 0).count()
    }

    /// Initial states a second.
    pub fn rate(&self) -> f64 {
        self.there() as f64 / self.seconds
    }
}
