//! Laws that follow another state's solution.

use super::{Expansion, Law, tangent};
use crate::backend::BackendError;
use crate::backend::cpu::Evaluator;
use crate::numeric::hermite::hermite;
use crate::program::Program;
use crate::shooting::{Path, Solver};
use crate::sweep::Plan;
use rayon::prelude::*;

/// Parts in which a solution's segments are divided: then they are about as long as the fastest
/// mode takes to grow by e.
pub const PIECES: usize = 3;
/// Singular value of a node's equations for p below which its slope is of no use: a fold is near.
const NEAR_FOLD: f64 = 1e-4;
/// Paths linearized at once.
const AT_ONCE: usize = 256;
/// A follower goes on by the local expansion where that is good to this share of V.
const ARRIVED: f64 = 1e-3;

/// A solution to be followed: nodes with what the sheet is like at them.
#[derive(Clone, Debug)]
pub struct Guide {
    states: usize,
    /// Time of each node.
    times: Vec<f64>,
    /// `[node][2n]`.
    nodes: Vec<f64>,
    /// Rates of the nodes by time, `[node][2n]`.
    rates: Vec<f64>,
    /// `[node][n x n]`; 0 where there is none.
    slopes: Vec<f64>,
    widths: Vec<f64>,
}

/// Slopes `dp/ds` (row-major) at the nodes of solutions, where they exist and no fold is near.
///
/// # Errors
/// Device failures only.
pub fn slopes(
    solver: &mut Solver,
    paths: &[&Path],
) -> Result<Vec<Vec<Option<Vec<f64>>>>, BackendError> {
    let mut all = Vec::with_capacity(paths.len());
    for part in paths.chunks(AT_ONCE) {
        let factors = solver.factors(part)?;
        let scales = &solver.scheme.equations.scales;
        let of_path = |(path, factors): (&&Path, Option<crate::shooting::Factors>)| {
            (0..=path.segments())
                .map(|node| factors.as_ref()?.slope_at(node, scales, NEAR_FOLD))
                .collect::<Vec<_>>()
        };
        all.par_extend(part.par_iter().zip(factors).map(of_path));
    }
    Ok(all)
}

/// Solutions with their slopes, ready to be followed: at their nodes and at the ends of as many
/// pieces of each segment.
///
/// # Errors
/// Device failures only.
pub fn guides(
    plan: &Plan,
    solver: &mut Solver,
    paths: &[&Path],
    pieces: usize,
) -> Result<Vec<Guide>, BackendError> {
    let between = solver.between_nodes(paths, pieces)?;
    let fine: Vec<Path> = (paths.iter().zip(&between))
        .map(|(path, between)| divided(path, between, pieces))
        .collect();
    let slopes = slopes(solver, &fine.iter().collect::<Vec<_>>())?;
    let system = &plan.system;
    let rates = Evaluator::new(&Program::lower(
        &system.graph,
        &system.inputs,
        &system.rate[..2 * system.states],
    ));
    Ok((fine.par_iter().zip(slopes))
        .map(|(path, slopes)| Guide::with_rates(path, &slopes, &plan.widths, &rates))
        .collect())
}

/// A path with the nodes between its own: those at the ends of `1 .. pieces - 1` parts of each
/// segment.
fn divided(path: &Path, between: &[f64], pieces: usize) -> Path {
    let mut fine = Path::new(path.node(0));
    let mut inner = between.chunks(path.width);
    for (k, duration) in path.durations.iter().enumerate() {
        let part = duration / pieces as f64;
        for node in inner.by_ref().take(pieces - 1) {
            fine.push(part, node);
        }
        fine.push(part, path.node(k + 1));
    }
    fine
}

impl Guide {
    /// A solution and the slopes at its nodes, without any nodes between: see [`guides`].
    pub fn new(plan: &Plan, path: &Path, slopes: &[Option<Vec<f64>>]) -> Self {
        let system = &plan.system;
        let rates = Evaluator::new(&Program::lower(
            &system.graph,
            &system.inputs,
            &system.rate[..2 * system.states],
        ));
        Self::with_rates(path, slopes, &plan.widths, &rates)
    }

    fn with_rates(
        path: &Path,
        slopes: &[Option<Vec<f64>>],
        widths: &[f64],
        rates: &Evaluator,
    ) -> Self {
        let n = widths.len();
        let mut times = vec![0.0];
        for duration in &path.durations {
            times.push(times[times.len() - 1] + duration);
        }
        // At a fold p is followed without feedback.
        let mut kept: Vec<f64> = Vec::with_capacity(slopes.len() * n * n);
        for slope in slopes {
            match slope {
                Some(slope) => kept.extend_from_slice(slope),
                None => kept.resize(kept.len() + n * n, 0.0),
            }
        }
        Self {
            states: n,
            times,
            rates: rates
                .eval(&path.nodes, 2 * n)
                .into_iter()
                .map(|r| -r)
                .collect(),
            nodes: path.nodes.clone(),
            slopes: kept,
            widths: widths.to_vec(),
        }
    }

    fn state(&self, node: usize) -> &[f64] {
        &self.nodes[2 * self.states * node..][..self.states]
    }

    fn segments(&self) -> usize {
        self.times.len() - 1
    }

    /// The sheet's tangent `(q, H)` at a place: a share of a segment.
    fn at(&self, segment: usize, share: f64) -> (Vec<f64>, Vec<f64>) {
        let n = self.states;
        if self.segments() == 0 {
            let (s, p) = self.nodes.split_at(n);
            return tangent(p, self.slopes.clone(), s);
        }
        let duration = self.times[segment + 1] - self.times[segment];
        let (a, b) = (2 * n * segment, 2 * n * (segment + 1));
        let x = share;
        let end = |i: usize| [self.nodes[i], self.rates[i]];
        let node: Vec<f64> = (0..2 * n)
            .map(|i| hermite(x, duration, end(a + i), end(b + i)))
            .collect();
        let slope = (0..n * n)
            .map(|q| {
                (1.0 - x) * self.slopes[segment * n * n + q]
                    + x * self.slopes[(segment + 1) * n * n + q]
            })
            .collect();
        tangent(&node[n..], slope, &node[..n])
    }

    /// The place at a time; `None` after the end.
    fn at_time(&self, t: f64) -> Option<(usize, f64)> {
        let last = self.times[self.segments()];
        if t > last * (1.0 + 1e-12) || self.segments() == 0 {
            return None;
        }
        let segment = self
            .times
            .partition_point(|begin| *begin <= t)
            .saturating_sub(1);
        let segment = segment.min(self.segments() - 1);
        let duration = self.times[segment + 1] - self.times[segment];
        Some((
            segment,
            ((t - self.times[segment]) / duration).clamp(0.0, 1.0),
        ))
    }

    /// The place of the polygon through the nodes that is nearest to a state, in widths.
    fn nearest(&self, s: &[f64]) -> (usize, f64) {
        let mut best = (0, 0.0, f64::INFINITY);
        for segment in 0..self.segments() {
            let (from, to) = (self.state(segment), self.state(segment + 1));
            let (mut along, mut length) = (0.0, 0.0);
            for (i, w) in self.widths.iter().enumerate() {
                let way = (to[i] - from[i]) / w;
                along += way * (s[i] - from[i]) / w;
                length += way * way;
            }
            let share = if length > 0.0 {
                (along / length).clamp(0.0, 1.0)
            } else {
                0.0
            };
            let distance: f64 = (self.widths.iter().enumerate())
                .map(|(i, w)| ((from[i] + share * (to[i] - from[i]) - s[i]) / w).powi(2))
                .sum();
            if distance < best.2 {
                best = (segment, share, distance);
            }
        }
        (best.0, best.1)
    }

    /// The periods, as a deviation, from this solution's start to the copy of a state that is
    /// nearest to it.
    pub fn turns(&self, s: &[f64], periods: &[Option<f64>]) -> Vec<f64> {
        (s.iter().zip(self.state(0)).zip(periods))
            .map(|((s, start), period)| {
                period.map_or(0.0, |period| ((s - start) / period).round() * period)
            })
            .collect()
    }
}

/// What both ways of following have in common.
struct Follower<'a> {
    guide: &'a Guide,
    /// Periods between the flight and the guide.
    turns: Vec<f64>,
    /// Near the equilibrium.
    local: Option<Expansion<'a>>,
}

impl<'a> Follower<'a> {
    fn new(plan: &'a Plan, guide: &'a Guide, start: &[f64]) -> Self {
        Self {
            turns: guide.turns(start, &plan.recurrent),
            guide,
            local: Expansion::new(plan),
        }
    }

    fn follow(
        &self,
        t: f64,
        s: &[f64],
        place: impl Fn(&[f64]) -> Option<(usize, f64)>,
    ) -> Option<(Vec<f64>, Vec<f64>)> {
        let there: Vec<f64> = s
            .iter()
            .zip(&self.turns)
            .map(|(s, turn)| s - turn)
            .collect();
        // To the equilibrium that the guide leads to: the nearest winding of it may lie behind a
        // guard.
        let near = |local: &Expansion<'_>| local.within_about(s, there.clone(), ARRIVED);
        if let Some(near) = self.local.as_ref().and_then(near) {
            return Some(near);
        }
        let Some((segment, share)) = place(&there) else {
            return self.local.as_ref()?.costate(t, s);
        };
        let (q, h) = self.guide.at(segment, share);
        // p = q + H (s - turns)
        Some(if self.turns.iter().all(|turn| *turn == 0.0) {
            (q, h)
        } else {
            tangent(&q, h, &self.turns)
        })
    }
}

/// Follows a solution by time: what it did after as long, corrected by the slope there. After its
/// end the local expansion.
pub struct AlongTime<'a>(Follower<'a>);

impl<'a> AlongTime<'a> {
    pub fn new(plan: &'a Plan, guide: &'a Guide, start: &[f64]) -> Self {
        Self(Follower::new(plan, guide, start))
    }
}

impl Law for AlongTime<'_> {
    fn costate(&self, t: f64, s: &[f64]) -> Option<(Vec<f64>, Vec<f64>)> {
        self.0.follow(t, s, |_| self.0.guide.at_time(t))
    }
}

/// Follows a solution by state: what it did where it was nearest, in widths. Of an infinite
/// horizon.
pub struct AlongState<'a>(Follower<'a>);

impl<'a> AlongState<'a> {
    pub fn new(plan: &'a Plan, guide: &'a Guide, start: &[f64]) -> Self {
        Self(Follower::new(plan, guide, start))
    }
}

impl Law for AlongState<'_> {
    fn costate(&self, t: f64, s: &[f64]) -> Option<(Vec<f64>, Vec<f64>)> {
        self.0
            .follow(t, s, |there| Some(self.0.guide.nearest(there)))
    }
}
