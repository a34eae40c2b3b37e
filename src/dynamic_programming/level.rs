//! One lattice with everything that an iteration on it needs: what is known, how far a step goes,
//! which controls are tried.

use super::equations::Equations;
use super::lattice::Lattice;
use crate::backend::BackendError;

/// How long a node's step lasts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Stride {
    /// Until the state has moved by so many cells along some axis, at most `longest` units of time.
    Cells { cells: f64, longest: f64 },
    /// The same time for every node and control.
    Fixed(f64),
}

impl Stride {
    /// The duration of a step that begins with the rates `f`.
    #[inline]
    pub fn duration(self, lattice: &Lattice, f: &[f64]) -> f64 {
        match self {
            Stride::Fixed(time) => time,
            Stride::Cells { cells, longest } => {
                let speed = (f.iter().zip(&lattice.axes))
                    .fold(0.0f64, |most, (f, a)| most.max((f / a.step).abs()));
                longest.min(cells / speed)
            }
        }
    }
}

/// A lattice and the problem on it.
#[derive(Clone, Debug)]
pub(super) struct Level {
    pub lattice: Lattice,
    /// `[node][n]`: the nodes' states.
    pub points: Vec<f64>,
    /// Nodes whose value is given and stays.
    pub known: Vec<bool>,
    pub stride: Stride,
    /// What leaving the lattice or the guards costs, and the largest value of a node.
    pub ceiling: f64,
    /// `[node][m]`: the control of the linearization at each node, where there is an equilibrium.
    pub linear: Option<Vec<f64>>,
    /// `[control][m]`: a fixed set of controls over the range that matters.
    pub spread: Vec<Vec<f64>>,
    /// Width of the range that matters, one a control.
    pub ranges: Vec<f64>,
    /// Cells with larger values, beside those that nothing is known of, are interpolated linearly:
    /// monotone, so that what is not reached does not make its neighbours swing.
    pub bent_below: f64,
}

/// [`Level::bent_below`] as a share of the ceiling.
pub(super) const STEEP: f64 = 0.02;

/// One candidate control of a node. What is tried, and in which order, is the same on every device.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Candidate {
    /// The one the node has.
    Present,
    /// `u*(s, p)` with p the gradient so far along the present step.
    Costate(f64),
    Linear,
    /// That of the neighbour along an axis.
    Neighbour {
        axis: usize,
        forward: bool,
    },
    Spread(usize),
    /// The best so far, one component moved by this.
    Moved {
        control: usize,
        by: f64,
    },
}

/// Controls of the fixed set tried in one round.
const SPREAD_A_ROUND: usize = 2;
/// The first share of a control's range by which it is moved, and the ratio of the following ones.
const FIRST_MOVE: f64 = 0.25;
const NEXT_MOVE: f64 = 0.4;
/// Moves before the first one comes again.
const MOVES: usize = 6;

impl Level {
    /// The candidates of one round, the present control first.
    pub fn candidates(&self, round: usize) -> Vec<Candidate> {
        let (n, m) = (self.lattice.states(), self.ranges.len());
        let mut list = vec![
            Candidate::Present,
            Candidate::Costate(1.0),
            Candidate::Costate(0.5),
        ];
        list.extend(self.linear.iter().map(|_| Candidate::Linear));
        for forward in [false, true] {
            let axis = round % n;
            list.push(Candidate::Neighbour { axis, forward });
        }
        let count = self.spread.len();
        let tried = (0..SPREAD_A_ROUND.min(count)).map(|k| (round * SPREAD_A_ROUND + k) % count);
        list.extend(tried.map(Candidate::Spread));
        let control = round % m.max(1);
        let share = FIRST_MOVE * NEXT_MOVE.powi((round / m.max(1) % MOVES) as i32);
        for sign in [-1.0, 1.0] {
            if let Some(range) = self.ranges.get(control) {
                let by = sign * share * range;
                list.push(Candidate::Moved { control, by });
            }
        }
        list
    }
}

/// A device that iterates on a level. Values and controls stay there between calls.
pub(super) trait Iteration {
    /// Sets `[node]` values and `[node][m]` controls.
    fn load(&mut self, values: &[f64], controls: &[f64]) -> Result<(), BackendError>;
    /// Tries the candidates of a round at every node and keeps the best step, whose cost
    /// [`Self::accept`] or [`Self::evaluate`] bring into the values.
    fn improve(&mut self, candidates: &[Candidate]) -> Result<(), BackendError>;
    /// The values become what the best steps cost.
    fn accept(&mut self) -> Result<(), BackendError>;
    /// The same so many times, each time with the values before: the value of the present policy.
    fn evaluate(&mut self, times: usize) -> Result<(), BackendError>;
    fn values(&self) -> Result<Vec<f64>, BackendError>;
    fn controls(&self) -> Result<Vec<f64>, BackendError>;
}

/// Places of the fixed set along the range of each control, by the number of controls.
const LEVELS: [usize; 4] = [9, 5, 3, 3];

/// Controls spread over ranges: a grid of them, with the ends.
pub(super) fn spread(ranges: &[[f64; 2]]) -> Vec<Vec<f64>> {
    let count = LEVELS[ranges.len().clamp(1, LEVELS.len()) - 1];
    let mut list = vec![Vec::new()];
    // Of many controls only the first ones are spread; the others stay in the middle of their
    // ranges.
    for (k, [lo, hi]) in ranges.iter().enumerate() {
        let places = if k < LEVELS.len() { count } else { 1 };
        let at = |j: usize| {
            lo + (hi - lo) * (j as f64 + 0.5 * f64::from(places == 1)) / (places.max(2) - 1) as f64
        };
        list = (list.iter())
            .flat_map(|u: &Vec<f64>| (0..places).map(|j| [u.as_slice(), &[at(j)]].concat()))
            .collect();
    }
    list
}

/// Where Kutta's third-order method looks second.
pub(super) fn middle(s: &[f64], first: &[f64], time: f64, to: &mut [f64]) {
    for (i, x) in to.iter_mut().enumerate() {
        *x = s[i] + 0.5 * time * first[i];
    }
}

/// Where it looks last.
pub(super) fn last(s: &[f64], first: &[f64], second: &[f64], time: f64, to: &mut [f64]) {
    for (i, x) in to.iter_mut().enumerate() {
        *x = s[i] + time * (2.0 * second[i] - first[i]);
    }
}

/// How much a component changes in a step, from its three rates.
pub(super) fn whole(first: f64, second: f64, third: f64, time: f64) -> f64 {
    time * (first + 4.0 * second + third) / 6.0
}

impl Equations {
    /// A control within its bounds.
    pub fn bounded(&self, u: &mut [f64]) {
        for (u, [lo, hi]) in u.iter_mut().zip(&self.bounds) {
            *u = u.clamp(*lo, *hi);
        }
    }
}

/// The range of each control, one unit wide where there is none.
pub(super) fn ranges(controls: &[f64], m: usize) -> Vec<[f64; 2]> {
    let of = |c: usize| {
        let along = controls.iter().skip(c).step_by(m);
        let [lo, hi] = along.fold([f64::INFINITY, f64::NEG_INFINITY], |[lo, hi], u| {
            [lo.min(*u), hi.max(*u)]
        });
        if hi > lo {
            [lo, hi]
        } else {
            [lo - 0.5, lo + 0.5]
        }
    };
    (0..m).map(of).collect()
}
