//! Whether the inequality held.

use super::{Cases, Certificate, Dissipation, DisturbanceKind, Law, Origin, Setting, TOLERANCE};
use crate::backend::Status;
use crate::closed_loop::Path;
use crate::numeric::quantile::nearest_rank;
use rayon::prelude::*;

/// One trajectory as far as V is known along it.
pub(super) struct Track {
    v0: f64,
    t: f64,
    /// E, W and V where it was last seen.
    last: [f64; 3],
    ratio: f64,
    violation: f64,
    /// Where the violation is largest: the deviation, and W + V(x(0)).
    at: Vec<f64>,
    budget: f64,
}

impl Track {
    pub fn new(v0: f64) -> Self {
        Self {
            v0,
            t: f64::NAN,
            last: [f64::NAN; 3],
            ratio: f64::NAN,
            violation: f64::NAN,
            at: Vec::new(),
            budget: f64::NAN,
        }
    }

    /// E, W and V at a time.
    pub fn see(&mut self, t: f64, balance: [f64; 3], s: &[f64]) {
        let [done, supplied, v] = balance;
        let budget = supplied + self.v0;
        (self.t, self.last) = (t, balance);
        // Of nothing, anything more than nothing is infinitely much.
        let of_budget = |part: f64| match budget > 0.0 {
            true => part / budget,
            false if part > 0.0 => f64::INFINITY,
            false => 0.0,
        };
        // `max` leaves NaN out.
        self.ratio = self.ratio.max(of_budget(done));
        // At the beginning it is V against itself.
        let violation = if t > 0.0 {
            of_budget(done + v - budget)
        } else {
            f64::NAN
        };
        if self.violation.is_nan() || violation > self.violation {
            (self.violation, self.budget) = (violation, budget);
            self.at = s.to_vec();
        }
    }
}

/// One law under all disturbances; every list is `[case]`, NaN where V is not known at the initial
/// state.
#[derive(Clone, Debug, Default)]
pub struct LawCheck {
    pub name: String,
    pub source: String,
    /// Integral of L(x, u, 0), up to `t_end`.
    pub done: Vec<f64>,
    /// Integral of L(x, u, 0) - L(x, u, w).
    pub supplied: Vec<f64>,
    pub v_end: Vec<f64>,
    /// Largest E/(W + V(x(0))) over the stored times.
    pub ratio: Vec<f64>,
    /// Largest (E + V(x(t)) - W - V(x(0)))/(W + V(x(0))) over the stored times.
    pub violation: Vec<f64>,
    /// Of a violation beyond [`TOLERANCE`], what the estimated errors of V at its place and the
    /// initial state explain; else NaN.
    pub explained: Vec<f64>,
    /// The last time at which V was known.
    pub t_end: Vec<f64>,
    pub status: Vec<i32>,
    /// Those of each kind that came closest, the closest first; `initial` is the case.
    pub paths: Vec<Path>,
    /// V along them.
    pub path_values: Vec<Vec<f64>>,
    /// Time taken, compilation not included.
    pub seconds: f64,
}

/// One kind of disturbance under one law.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Summary {
    pub kind: DisturbanceKind,
    pub count: usize,
    /// Those along which V is known beyond the beginning.
    pub judged: usize,
    /// Of these those that ended early, and are judged up to there.
    pub left: usize,
    pub median_ratio: f64,
    pub worst_ratio: f64,
    /// Ratios above 1 by more than [`TOLERANCE`]: the gain is not kept, whatever V is along the
    /// trajectory.
    pub exceeded: usize,
    pub worst_violation: f64,
    /// Violations beyond [`TOLERANCE`], and those beyond what errors of V explain besides.
    pub violated: usize,
    pub unexplained: usize,
}

impl LawCheck {
    pub(super) fn new(
        law: &Law,
        setting: &Setting<'_>,
        of: &Dissipation,
        certificate: &Certificate<'_>,
        tracks: &[Track],
        status: Vec<i32>,
    ) -> Self {
        let column = |get: fn(&Track) -> f64| -> Vec<f64> { tracks.iter().map(get).collect() };
        let reference = setting.model.reference();
        let explained = (tracks.par_iter().enumerate())
            .map(|(case, track)| {
                if track.violation <= TOLERANCE || track.at.is_empty() {
                    return f64::NAN;
                }
                let at: Vec<f64> = track.at.iter().zip(reference).map(|(s, r)| s + r).collect();
                let at_start = match of.origin[case] {
                    Origin::Interpolated => certificate.uncertainty(of.cases.state(case)),
                    _ => 0.0,
                };
                let error = certificate.uncertainty(&at) + at_start;
                error / track.budget
            })
            .collect();
        Self {
            name: law.name.clone(),
            source: law.source.clone(),
            done: column(|t| t.last[0]),
            supplied: column(|t| t.last[1]),
            v_end: column(|t| t.last[2]),
            ratio: column(|t| t.ratio),
            violation: column(|t| t.violation),
            t_end: column(|t| t.t),
            explained,
            status,
            ..Self::default()
        }
    }

    /// Cases of each kind with the largest ratios, at most `most` of each, by kind.
    pub(super) fn closest(&self, cases: &Cases, most: usize) -> Vec<usize> {
        let mut all = Vec::new();
        for (_, kind) in DisturbanceKind::ALL {
            let mut own = self.judged(cases, kind);
            own.sort_by(|a, b| self.ratio[*b].total_cmp(&self.ratio[*a]));
            all.extend(own.into_iter().take(most));
        }
        all
    }

    fn judged(&self, cases: &Cases, kind: DisturbanceKind) -> Vec<usize> {
        (0..cases.count())
            // Of one that ends at once nothing was seen.
            .filter(|k| {
                cases.kind[*k] == kind && !self.ratio[*k].is_nan() && !self.violation[*k].is_nan()
            })
            .collect()
    }

    /// By kind, those there are.
    pub fn summaries(&self, cases: &Cases) -> Vec<Summary> {
        let of = |kind: DisturbanceKind| {
            let own = self.judged(cases, kind);
            let mut ratios: Vec<f64> = own.iter().map(|k| self.ratio[*k]).collect();
            ratios.sort_by(f64::total_cmp);
            let violated: Vec<usize> = (own
                .iter()
                .copied()
                .filter(|k| self.violation[*k] > TOLERANCE))
            .collect();
            let explains = |k: &usize| self.violation[*k] <= TOLERANCE + self.explained[*k];
            let quantile = |share: f64| match ratios.is_empty() {
                true => f64::NAN,
                false => nearest_rank(&ratios, share),
            };
            Summary {
                kind,
                count: cases.kind.iter().filter(|k| **k == kind).count(),
                judged: own.len(),
                left: own
                    .iter()
                    .filter(|k| self.status[**k] != Status::Reached as i32)
                    .count(),
                median_ratio: quantile(0.5),
                worst_ratio: quantile(1.0),
                worst_violation: own
                    .iter()
                    .map(|k| self.violation[*k])
                    .fold(f64::NAN, f64::max),
                exceeded: ratios.iter().filter(|r| **r > 1.0 + TOLERANCE).count(),
                unexplained: violated.iter().filter(|k| !explains(k)).count(),
                violated: violated.len(),
            }
        };
        let all = DisturbanceKind::ALL.iter().map(|(_, kind)| of(*kind));
        all.filter(|s| s.count > 0).collect()
    }

    /// Whether the gain was kept by all, E <= W + V(x(0)) up to [`TOLERANCE`]; and what came of it
    /// in words.
    pub fn verdict(&self, cases: &Cases) -> (bool, String) {
        let all = self.summaries(cases);
        let sum = |of: fn(&Summary) -> usize| all.iter().map(of).sum::<usize>();
        let (judged, exceeded) = (sum(|s| s.judged), sum(|s| s.exceeded));
        let closest = all.iter().filter(|s| s.judged > 0);
        let Some(closest) = closest.max_by(|a, b| a.worst_ratio.total_cmp(&b.worst_ratio)) else {
            let text =
                "nothing could be judged: V is known at no initial state, or no further than there";
            return (false, text.to_owned());
        };
        let ratio = ratio_text(closest.worst_ratio);
        let gain = match exceeded {
            0 => format!("E <= W + V0 in all {judged}, no violation beyond {TOLERANCE:e}"),
            _ => format!("E <= W + V0 VIOLATED by {exceeded} of {judged}"),
        };
        let close = match closest.kind {
            DisturbanceKind::Worst => format!("the worst case comes closest (ratio {ratio})"),
            kind if all
                .iter()
                .any(|s| s.kind == DisturbanceKind::Worst && s.judged > 0) =>
            {
                format!(
                    "NOT the worst case but a {} disturbance comes closest (ratio {ratio})",
                    kind.name()
                )
            }
            _ => format!("largest ratio {ratio}"),
        };
        let worst = all
            .iter()
            .map(|s| s.worst_violation)
            .fold(f64::NAN, f64::max);
        let sharper = match (sum(|s| s.violated), sum(|s| s.unexplained)) {
            (0, _) => format!("nor with V(x(t)) beside E (largest {worst:.1e})"),
            (violated, 0) => format!(
                "with V(x(t)) beside E {violated} beyond it, at most {worst:.1e}, all within V's estimated errors"
            ),
            (violated, unexplained) => format!(
                "with V(x(t)) beside E {violated} beyond it, at most {worst:.1e}, of which V's estimated errors do not explain {unexplained}"
            ),
        };
        (exceeded == 0, format!("{gain}; {close}; {sharper}"))
    }
}

/// A ratio whose distance from 1 matters.
pub fn ratio_text(ratio: f64) -> String {
    const NEAR: f64 = 1e-3;
    let short = 1.0 - ratio;
    match short.abs() < NEAR {
        true if short < 0.0 => format!("1 + {:.1e}", -short),
        true => format!("1 - {short:.1e}"),
        false => format!("{ratio:.4}"),
    }
}
