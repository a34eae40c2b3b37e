//! What the lattice lies over: the region, its margin, periods.

use super::equations::Equations;
use super::lattice::{Axis, Lattice, MOST_STATES};
use super::{DpError, Options};
use crate::sweep::{Plan, spread_over};

/// Nodes of an axis by the number of states, where all axes have as many.
const NODES: [f64; MOST_STATES] = [801.0, 201.0, 61.0, 27.0];
/// More nodes in all, as a factor, for an axis of three periods.
const LIFTED_NODES: f64 = 1.5;
/// How much more or less than the mean an axis may get, and its least number of nodes.
const UNEVEN: f64 = 2.0;
const LEAST_NODES: f64 = 11.0;
/// States at which the equations are looked at for their periods, and the difference that counts as
/// none.
const PROBES: usize = 64;
const SAME: f64 = 1e-8;

/// The box of a lattice.
pub(super) struct Domain {
    /// As deviations, with the margin.
    pub bounds: Vec<[f64; 2]>,
    /// Periods of axes that are closed to a ring.
    pub periods: Vec<Option<f64>>,
    /// Periods of states of which the axis has a copy on either side: the cost tells the copies
    /// apart, so that winding is part of the state.
    pub lifted: Vec<Option<f64>>,
    pub counts: Vec<usize>,
}

impl Domain {
    pub fn new(plan: &Plan, equations: &Equations, options: &Options) -> Result<Self, DpError> {
        let states = plan.system.states;
        let margin = options.margin.max(0.0);
        let mut domain = Self {
            bounds: Vec::new(),
            periods: Vec::new(),
            lifted: Vec::new(),
            counts: options.nodes.clone(),
        };
        for (i, period) in plan.periods.iter().enumerate() {
            let ring = period.filter(|period| is_invariant(plan, equations, i, *period));
            let lifted = period.filter(|_| ring.is_none());
            let added = lifted.unwrap_or(margin * plan.widths[i]);
            let [mut lo, mut hi] = plan.region[i];
            // Of a periodic state every copy is on the axis anyway.
            if let (Some(held), None) = (options.holds.get(i), period) {
                (lo, hi) = (lo.min(held[0]), hi.max(held[1]));
            }
            domain.bounds.push([lo - added, hi + added]);
            domain.periods.push(ring);
            domain.lifted.push(lifted);
        }
        if domain.counts.is_empty() {
            domain.counts = domain.spread_counts(plan, options.share);
        }
        if domain.counts.len() != states {
            return Err(DpError::Counts {
                given: domain.counts.len(),
                states,
            });
        }
        Ok(domain)
    }

    /// Nodes of each axis: where there is an equilibrium, more along axes that are longer in the
    /// metric of P. That tells about the equilibrium only: half-way, on a logarithmic scale,
    /// between equal numbers and equal errors there.
    fn spread_counts(&self, plan: &Plan, share: f64) -> Vec<usize> {
        let n = self.bounds.len();
        let turns = self.lifted.iter().flatten().count() as i32;
        let mean = share * NODES[n - 1] * LIFTED_NODES.powf(f64::from(turns) / n as f64);
        let lengths: Vec<f64> = (0..n)
            .map(|i| {
                let [lo, hi] = self.bounds[i];
                let span = self.periods[i].unwrap_or(hi - lo);
                let steepness = plan
                    .local
                    .as_ref()
                    .map_or(1.0, |local| local.riccati.p[(i, i)] * span * span);
                steepness.sqrt().sqrt()
            })
            .collect();
        let middle = lengths.iter().map(|l| l.ln()).sum::<f64>() / n as f64;
        let count =
            |l: &f64| (mean * (l.ln() - middle).exp().clamp(1.0 / UNEVEN, UNEVEN)).max(LEAST_NODES);
        // Odd, so that the reference is a node without one more.
        lengths
            .iter()
            .map(|l| count(l) as usize / 2 * 2 + 1)
            .collect()
    }

    /// The lattice with about these many nodes along each axis.
    pub fn lattice(&self, counts: &[usize]) -> Lattice {
        let axes = (self.bounds.iter().zip(counts).zip(&self.periods))
            .map(|((bounds, count), period)| Axis::new(*bounds, *count, *period))
            .collect();
        Lattice::new(axes)
    }
}

/// Whether dynamics, costs and guards are the same a period further along a state.
fn is_invariant(plan: &Plan, equations: &Equations, axis: usize, period: f64) -> bool {
    let n = equations.states;
    spread_over(&plan.region, PROBES).into_iter().all(|s| {
        let mut further = s.clone();
        further[axis] += period;
        let zero = vec![0.0; n];
        let u = equations.law.eval(&[s.as_slice(), &zero].concat());
        let motion = |s: &[f64]| equations.motion.eval(&[s, &u].concat());
        let terminal = |s: &[f64]| {
            equations
                .terminal
                .as_ref()
                .map_or(Vec::new(), |t| t.eval(&[s, &zero].concat()))
        };
        let all = |s: &[f64]| [motion(s), terminal(s)].concat();
        let same = |(a, b): (f64, f64)| {
            (a - b).abs() <= SAME * (1.0 + a.abs()) || (a.is_nan() && b.is_nan())
        };
        all(&s).into_iter().zip(all(&further)).all(same)
    })
}

/// The copies of a state on a lattice, by the periods of lifted axes.
pub(super) fn copies(lattice: &Lattice, lifted: &[Option<f64>], s: &[f64]) -> Vec<Vec<f64>> {
    let mut list = vec![s.to_vec()];
    for (i, period) in lifted.iter().enumerate() {
        let Some(period) = period else { continue };
        let axis = &lattice.axes[i];
        let (first, last) = (axis.at(0), axis.at(axis.count - 1));
        let (from, to) = (
            ((first - s[i]) / period).ceil(),
            ((last - s[i]) / period).floor(),
        );
        let turns = (0..).map(|k| from + f64::from(k)).take_while(|k| *k <= to);
        let moved = |(copy, k): (&Vec<f64>, f64)| {
            let mut copy = copy.clone();
            copy[i] += k * period;
            copy
        };
        list = turns
            .flat_map(|k| list.iter().map(move |copy| (copy, k)))
            .map(moved)
            .collect();
    }
    list
}
