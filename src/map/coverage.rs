//! How far a cheaper sheet can be excluded at a state: what the sweep's fronts covered, and what
//! was searched.

use super::{Known, ValueMap};
use crate::backend::Status;
use crate::sweep::{Far, Plan, Sampling};
use crate::trajectories::SweptTrajectories;

/// What a value's being the least rests on. The error estimate covers no sheet that was not found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Coverage {
    /// The local solution about the equilibrium.
    Local,
    /// Fronts without gaps up to this V: no sheet as cheap lies over the state, at the sweep's
    /// spacing.
    Covered,
    /// Solved states alone: each was searched for sheets on its own, and no front shows that there
    /// is no other.
    Searched,
    /// Swept trajectories between which there are gaps at this V, or a map whose first states were
    /// not all searched for want of a budget: a cheaper sheet may have been missed.
    Uncovered,
    /// A map in pieces, checked with fresh states that were searched for all sheets.
    Checked,
}

impl Coverage {
    /// All, with their code and name in files.
    pub const ALL: [(Coverage, i32, &'static str); 5] = [
        (Coverage::Local, 0, "local"),
        (Coverage::Covered, 1, "covered"),
        (Coverage::Searched, 2, "searched"),
        (Coverage::Uncovered, 3, "uncovered"),
        (Coverage::Checked, 4, "checked"),
    ];

    pub fn code(self) -> i32 {
        Self::ALL
            .iter()
            .find(|(c, ..)| *c == self)
            .map_or(-1, |(_, code, _)| *code)
    }

    pub fn name(self) -> &'static str {
        Self::ALL
            .iter()
            .find(|(c, ..)| *c == self)
            .map_or("", |(.., name)| *name)
    }
}

/// What the sweep of a file covered.
#[derive(Clone, Debug, PartialEq)]
pub struct Fronts {
    /// Whether the file has swept trajectories.
    pub swept: bool,
    /// Whether states of the file were solved: those of a file of interpolated values were not.
    pub searched: bool,
    /// Gaps wider than the spacing that remained, and the widest, in widths of the region.
    pub gaps: u64,
    pub widest: f64,
    /// Whether fronts lie too far apart to tell of what is between them.
    pub far: Option<Far>,
    /// Whether parts of the sweep are not in the file.
    pub lacks: bool,
    /// Whether trajectories that end outside the region are not swept: on a finite horizon.
    pub end_inside: bool,
    /// Trajectories whose integration failed.
    pub failed: u64,
    /// V below which there are no gaps; minus infinity where it is not known.
    pub below: f64,
}

impl Fronts {
    /// Of what is known; where that tells nothing of the sweep nothing counts as covered.
    pub(super) fn new(known: &Known, plan: &Plan) -> Self {
        let mut this = Self {
            swept: known.swept.as_ref().is_some_and(|t| t.count > 0),
            searched: known.searched,
            gaps: known.sweep.gaps.unwrap_or(u64::MAX),
            widest: known.sweep.widest,
            far: known.sweep.far,
            lacks: known.sweep.lacks,
            end_inside: plan.sampling == Sampling::Time,
            failed: known.sweep.failed,
            below: f64::NEG_INFINITY,
        };
        if let Some(swept) = known
            .swept
            .as_ref()
            .filter(|_| !this.are_covered() && this.far.is_none() && !this.lacks)
        {
            this.below = covered_below(swept, plan).unwrap_or(f64::NEG_INFINITY);
        }
        this
    }

    /// Whether fronts up to this V have no gaps.
    pub(super) fn cover(&self, v: f64) -> bool {
        self.swept && (self.are_covered() || v <= self.below)
    }

    fn are_covered(&self) -> bool {
        self.gaps == 0 && self.failed == 0 && self.far.is_none() && !self.end_inside && !self.lacks
    }
}

/// V below which neighbouring trajectories are nowhere further apart than the spacing. Of two
/// states with an equilibrium, where the seeds lie on a closed curve about it and neighbours follow
/// from the angle; else it is not known.
fn covered_below(swept: &SweptTrajectories, plan: &Plan) -> Option<f64> {
    let n = plan.system.states;
    if n != 2
        || plan.local.is_none()
        || plan.sampling == Sampling::Time
        || swept.count < 3
        || swept.samples < 2
    {
        return None;
    }
    let at = |trajectory: usize, sample: usize| -> [f64; 2] {
        let k = (trajectory * swept.samples + sample) * n;
        [0, 1].map(|i| (swept.x[k + i] - plan.system.reference[i]) / plan.widths[i])
    };
    // Time runs forward in a file: the last samples lie next to the equilibrium.
    let last = swept.samples - 1;
    let mut around: Vec<(f64, usize)> = (0..swept.count)
        .map(|t| (at(t, last)[1].atan2(at(t, last)[0]), t))
        .filter(|(angle, _)| angle.is_finite())
        .collect();
    around.sort_by(|a, b| a.0.total_cmp(&b.0));
    let bounds: Vec<[f64; 2]> = (0..n)
        .map(|i| match plan.periods[i] {
            // Every period of a periodic state meets the region somewhere.
            Some(_) => [f64::NEG_INFINITY, f64::INFINITY],
            None => plan.region[i].map(|s| s / plan.widths[i]),
        })
        .collect();
    // Levels are stored as they were reached; what rounding adds to the spacing is no gap.
    let spacing = plan.shoot_out.spacing * (1.0 + 1e-3);
    let mut below = f64::INFINITY;
    for (k, &(_, a)) in around.iter().enumerate() {
        let b = around[(k + 1) % around.len()].1;
        let v = |sample: usize| {
            swept.v[a * swept.samples + sample].min(swept.v[b * swept.samples + sample])
        };
        let open = |sample: &usize| {
            let (x, y) = (at(a, *sample), at(b, *sample));
            (0..n).all(|i| x[i].max(y[i]) >= bounds[i][0] && x[i].min(y[i]) <= bounds[i][1])
                && (0..n).any(|i| (x[i] - y[i]).abs() > spacing)
        };
        // Between the front before and that one the gap has opened.
        if let Some(sample) = (0..=last).rev().find(open) {
            below = below.min(if sample == last { 0.0 } else { v(sample + 1) });
        }
    }
    // Where a trajectory failed, what lies beyond is not covered.
    let failed = around.iter().filter(|(_, t)| {
        Status::FAILURES
            .iter()
            .any(|f| *f as i32 == swept.status[*t])
    });
    for &(_, t) in failed {
        let row = &swept.v[t * swept.samples..(t + 1) * swept.samples];
        below = below.min(
            row.iter()
                .copied()
                .filter(|v| v.is_finite())
                .fold(0.0, f64::max),
        );
    }
    Some(below)
}

impl ValueMap {
    /// What the sweep of the file covered.
    pub fn fronts(&self) -> &Fronts {
        &self.fronts
    }

    /// What a value's being the least rests on, of which all sites that were used are solved states
    /// or not.
    pub(super) fn coverage(&self, v: f64, solved: bool) -> Coverage {
        match self.fronts.cover(v) {
            true => Coverage::Covered,
            false if self.fronts.searched && (solved || !self.fronts.swept) => Coverage::Searched,
            false => Coverage::Uncovered,
        }
    }
}
