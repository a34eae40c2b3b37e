//! Newton steps on a transcribed problem, by a Riccati recursion. Where its Hessian is not convex,
//! less of the dynamics' curvature is taken, down to Gauss-Newton steps.

use super::stage::{Rates, Slopes, Steps, times};
use crate::backend::Deadline;
use crate::numeric::dense::{cholesky, solve_by_cholesky};

/// Weights of the barrier, in units of the control's own cost at its bound. Without bounds the last
/// one stands for all.
const BARRIERS: [f64; 5] = [1.0, 0.1, 1e-2, 1e-3, 1e-4];
/// Steps under each of them, and under the last one.
const STEPS: usize = 60;
const LAST_STEPS: usize = 200;
/// Step, in widths of the region, below which the next barrier is taken; and the last one is done.
const SMALL: f64 = 0.03;
const DONE: f64 = 1e-3;
/// A cost that changes by less than this share in so many steps is not followed further, once gaps
/// are closed.
const SETTLED: f64 = 1e-3;
const SETTLING: usize = 10;
/// Gaps, in widths, that count as closed.
const CLOSED: f64 = 1e-4;
/// Under so many of the barriers it shows where a guess leads; gaps that are larger after them are
/// not expected to close.
const BEGUN: usize = 2;
const OPEN: f64 = 1e-2;
/// Shares of the dynamics' curvature that are tried, until the problem is convex.
const SHARES: [f64; 5] = [1.0, 0.5, 0.25, 0.1, 0.0];
/// Multipliers of bounds stay within this factor of the barrier's slope.
const KEPT: f64 = 1e4;
/// Share of the way to its bound that a control may go at once.
const WITHIN: f64 = 0.98;
/// Times that a step is halved.
const HALVINGS: usize = 10;
/// The merit of closing a gap is this many times what closing it costs, or this share of what it
/// was before.
const MERIT: f64 = 1.5;
const FADING: f64 = 0.7;

/// Times of a transcribed problem, bounds and scales.
#[derive(Clone)]
pub(super) struct Transcription {
    pub step: f64,
    pub count: usize,
    pub widths: Vec<f64>,
    /// Controls where a guess begins.
    pub middle: Vec<f64>,
    /// Of the controls, infinite where there is none.
    pub bounds: Vec<[f64; 2]>,
    /// Hessian of V about the equilibrium, row by row.
    pub end: Vec<f64>,
    pub deadline: Deadline,
}

impl Transcription {
    fn is_bounded(&self) -> bool {
        self.bounds.iter().flatten().any(|b| b.is_finite())
    }
}

/// A trajectory that was found.
pub(super) struct Found {
    pub cost: f64,
    pub states: Vec<Vec<f64>>,
    pub adjoints: Vec<Vec<f64>>,
    /// `[step][m]`.
    pub controls: Vec<f64>,
}

/// A guess on its way to a trajectory.
pub(super) struct Descent<'a> {
    rates: &'a Rates,
    problem: &'a Transcription,
    /// `[node][n]` and `[step][m]`.
    x: Vec<f64>,
    u: Vec<f64>,
    steps: Steps,
    /// Adjoints at the nodes; none before the first step.
    p: Vec<f64>,
    /// Multipliers of the bounds below and above, `[step][m]`; 0 before the first step.
    duals: [Vec<f64>; 2],
    /// Penalty of the gaps' components, `[step][n]`.
    penalty: Vec<f64>,
    /// Second derivative of the running cost by each control, for the barrier; 0 without bounds.
    curvature: Vec<f64>,
}

/// Changes of states and controls, and the adjoints after them.
struct Change {
    x: Vec<f64>,
    u: Vec<f64>,
    p: Vec<f64>,
}

/// A Riccati recursion from the end on.
struct Recursion {
    n: usize,
    m: usize,
    /// Hessian and gradient of the cost to go at each node.
    hessians: Vec<f64>,
    gradients: Vec<f64>,
    /// The laws of the steps: changes of u where x does not change, and by x, `[step][m][n]`.
    constants: Vec<f64>,
    gains: Vec<f64>,
    /// Gradient and Hessian of the cost to go from a node, by its state and control.
    first: Vec<f64>,
    second: Vec<f64>,
    /// Room for the next node's Hessian times the dynamics' Jacobian, and for a step's law.
    product: Vec<f64>,
    by_control: Vec<f64>,
    law: Vec<f64>,
}

impl Recursion {
    fn new(n: usize, m: usize, count: usize) -> Self {
        let width = n + m;
        Self {
            n,
            m,
            hessians: vec![0.0; (count + 1) * n * n],
            gradients: vec![0.0; (count + 1) * n],
            constants: vec![0.0; count * m],
            gains: vec![0.0; count * m * n],
            first: vec![0.0; width],
            second: vec![0.0; width * width],
            product: vec![0.0; n * width],
            by_control: vec![0.0; m * m],
            law: vec![0.0; m * (n + 1)],
        }
    }

    /// The law of a step, and the cost to go from its node under it; none where it is not convex in
    /// the controls.
    #[inline]
    fn eliminate(&mut self, k: usize) -> Option<()> {
        let Self {
            n,
            m,
            ref first,
            ref second,
            ref mut hessians,
            ref mut gradients,
            ref mut constants,
            ref mut gains,
            ref mut by_control,
            ref mut law,
            ..
        } = *self;
        let width = n + m;
        // The law: m equations in n + 1 right-hand sides.
        for i in 0..m {
            let row = &second[(n + i) * width..][..width];
            by_control[i * m..][..m].copy_from_slice(&row[n..]);
            law[i * (n + 1)..][..n].copy_from_slice(&row[..n]);
            law[i * (n + 1) + n] = first[n + i];
        }
        cholesky(m, by_control)?;
        solve_by_cholesky(m, by_control, n + 1, law);
        for i in 0..m {
            let law = &law[i * (n + 1)..][..=n];
            constants[k * m + i] = -law[n];
            (0..n).for_each(|j| gains[(k * m + i) * n + j] = -law[j]);
        }
        for a in 0..n {
            let row = &mut hessians[(k * n + a) * n..][..n];
            row.copy_from_slice(&second[a * width..][..n]);
            let mut gradient = first[a];
            for i in 0..m {
                let (mixed, law) = (second[a * width + n + i], &law[i * (n + 1)..][..=n]);
                gradient -= mixed * law[n];
                (row.iter_mut().zip(law)).for_each(|(h, law)| *h -= mixed * law);
            }
            gradients[k * n + a] = gradient;
        }
        // Rounding must not make it unsymmetric.
        for a in 0..n {
            for b in 0..a {
                let mean = 0.5 * (hessians[(k * n + a) * n + b] + hessians[(k * n + b) * n + a]);
                hessians[(k * n + a) * n + b] = mean;
                hessians[(k * n + b) * n + a] = mean;
            }
        }
        Some(())
    }
}

impl<'a> Descent<'a> {
    pub fn new(rates: &'a Rates, problem: &'a Transcription, guess: &[Vec<f64>]) -> Option<Self> {
        let u = problem.middle.repeat(problem.count);
        Self::from(rates, problem, guess.concat(), u)
    }

    /// From states and controls.
    pub fn from(
        rates: &'a Rates,
        problem: &'a Transcription,
        x: Vec<f64>,
        u: Vec<f64>,
    ) -> Option<Self> {
        let steps = rates.steps(&x, &u, problem.step)?;
        let (n, m) = (rates.states, rates.controls);
        let first = rates.slopes(
            &rates.steps(&x[..2 * n], &u[..m], problem.step)?,
            problem.step,
            None,
        );
        let curvature = |i: usize| {
            let [lo, hi] = problem.bounds[i];
            let range = (hi - problem.middle[i]).min(problem.middle[i] - lo);
            if range.is_finite() {
                first.hessian(0)[(n + i) * (n + m + 1)] * range * range
            } else {
                0.0
            }
        };
        Some(Self {
            rates,
            problem,
            duals: [vec![0.0; u.len()], vec![0.0; u.len()]],
            penalty: vec![0.0; problem.count * n],
            curvature: (0..rates.controls).map(curvature).collect(),
            x,
            u,
            p: Vec::new(),
            steps,
        })
    }

    /// Steps until it shows what the guess leads to, if anywhere: under the first barriers, or
    /// without bounds until they are small.
    pub fn begin(&mut self) -> Option<()> {
        if !self.problem.is_bounded() {
            return self.descend(BARRIERS[BARRIERS.len() - 1], LAST_STEPS, SMALL);
        }
        for barrier in &BARRIERS[..BEGUN] {
            self.descend(*barrier, STEPS, SMALL)?;
        }
        (self.largest_gap() <= OPEN).then_some(())
    }

    /// What it leads to at last; `None` where that is nowhere.
    pub fn finish(mut self) -> Option<Found> {
        if self.problem.is_bounded() {
            for barrier in &BARRIERS[BEGUN..BARRIERS.len() - 1] {
                self.descend(*barrier, STEPS, SMALL)?;
            }
        }
        self.end()
    }

    fn end(mut self) -> Option<Found> {
        self.descend(BARRIERS[BARRIERS.len() - 1], LAST_STEPS, DONE)?;
        let rows = |v: &[f64]| v.chunks(self.rates.states).map(<[f64]>::to_vec).collect();
        (self.largest_gap() < CLOSED).then(|| Found {
            cost: self.cost_of(&self.x, &self.steps),
            states: rows(&self.x),
            adjoints: rows(&self.p),
            controls: self.u,
        })
    }

    /// The same as [`Self::finish`] from what is nearly a trajectory.
    pub fn mend(mut self) -> Option<Found> {
        if self.problem.is_bounded() {
            self.descend(BARRIERS[BARRIERS.len() - 2], STEPS, SMALL)?;
        }
        self.end()
    }

    /// Steps under a barrier, at most so many, until one is as small as that or the cost settles.
    fn descend(&mut self, barrier: f64, most: usize, small: f64) -> Option<()> {
        let mut costs = Vec::new();
        for step in 0..most {
            self.problem.deadline.check().ok()?;
            let change = self.change(barrier)?;
            let size = self.advance(&change, barrier);
            self.p = change.p;
            if size.is_none_or(|size| size <= small) {
                break;
            }
            costs.push(self.cost_of(&self.x, &self.steps));
            let settled = (step.checked_sub(SETTLING)).is_some_and(|before| {
                (costs[step] - costs[before]).abs() < SETTLED * costs[step].abs()
            });
            if settled && self.largest_gap() < CLOSED {
                break;
            }
        }
        Some(())
    }

    /// Cost as it is now.
    pub fn cost(&self) -> f64 {
        self.cost_of(&self.x, &self.steps)
    }

    /// Largest distance of the states at a time from those of another, in widths.
    pub fn apart(&self, other: &Self) -> f64 {
        let widths = self.problem.widths.iter().cycle();
        (self.x.iter().zip(&other.x).zip(widths))
            .map(|((a, b), width)| (a - b).abs() / width)
            .fold(0.0, f64::max)
    }

    /// In widths.
    fn largest_gap(&self) -> f64 {
        let widths = self.problem.widths.iter().cycle();
        let gaps = (0..self.steps.next.len())
            .zip(widths)
            .map(|(k, width)| self.gap(k).abs() / width);
        gaps.fold(0.0, f64::max)
    }

    /// A gap's component.
    fn gap(&self, k: usize) -> f64 {
        self.steps.next[k] - self.x[self.rates.states + k]
    }

    fn cost_of(&self, x: &[f64], steps: &Steps) -> f64 {
        let n = self.rates.states;
        let end = &x[self.problem.count * n..];
        let mut slope = vec![0.0; n];
        times(&self.problem.end, end, n, n, 1, &mut slope);
        let left: f64 = slope.iter().zip(end).map(|(p, s)| 0.5 * p * s).sum();
        steps.cost.iter().sum::<f64>() + left
    }

    /// Multiplier of a control's bound, whose slope the barrier says; on the side of its sign.
    fn dual(&self, control: usize, sign: f64, slope: f64) -> f64 {
        let dual = self.duals[usize::from(sign > 0.0)][control];
        if dual == 0.0 {
            slope
        } else {
            dual.clamp(slope / KEPT, slope * KEPT)
        }
    }

    /// Takes as much of the multipliers' step as keeps them positive (a primal-dual barrier).
    fn advance_duals(&mut self, change: &Change, barrier: f64) {
        let m = self.rates.controls;
        let mut share: f64 = 1.0;
        let mut changes = Vec::new();
        for (k, u) in self.u.chunks(m).enumerate() {
            for (i, room, sign, weight) in self.rooms(u, barrier) {
                let (control, slope) = (k * m + i, weight / room);
                let dual = self.dual(control, sign, slope);
                let by = slope - dual + sign * dual / room * change.u[control];
                if by < 0.0 {
                    share = share.min(-WITHIN * dual / by);
                }
                changes.push((control, sign, dual, by));
            }
        }
        for (control, sign, dual, by) in changes {
            self.duals[usize::from(sign > 0.0)][control] = dual + share * by;
        }
    }

    /// Controls' distances from bounds that the barrier keeps them from, with its weight: index,
    /// distance, sign of its slope.
    fn rooms<'b>(
        &'b self,
        u: &'b [f64],
        barrier: f64,
    ) -> impl Iterator<Item = (usize, f64, f64, f64)> + 'b {
        u.iter().enumerate().flat_map(move |(i, u)| {
            let [lo, hi] = self.problem.bounds[i];
            let weight = barrier * self.curvature[i];
            let both = [(i, u - lo, -1.0, weight), (i, hi - u, 1.0, weight)];
            both.into_iter()
                .filter(|(_, room, _, weight)| room.is_finite() && *weight > 0.0)
        })
    }

    fn merit(&self, x: &[f64], u: &[f64], steps: &Steps, barrier: f64) -> f64 {
        let (n, m) = (self.rates.states, self.rates.controls);
        let mut merit = self.cost_of(x, steps);
        for u in u.chunks(m) {
            merit -= self
                .rooms(u, barrier)
                .map(|(_, room, _, weight)| weight * room.ln())
                .sum::<f64>();
        }
        let gaps = steps.next.iter().zip(&x[n..]).zip(&self.penalty);
        merit
            + gaps
                .map(|((next, x), penalty)| penalty * (next - x).abs())
                .sum::<f64>()
    }

    /// The step that solves the linear-quadratic problem along the guess.
    fn change(&mut self, barrier: f64) -> Option<Change> {
        let n = self.rates.states;
        let slopes = self
            .rates
            .slopes(&self.steps, self.problem.step, self.p.get(n..));
        let shares = if self.p.is_empty() {
            &[0.0]
        } else {
            &SHARES[..]
        };
        let change = shares
            .iter()
            .find_map(|share| self.change_by(barrier, &slopes, *share))?;
        for (penalty, p) in self.penalty.iter_mut().zip(&change.p[n..]) {
            *penalty = (FADING * *penalty).max(MERIT * p.abs());
        }
        Some(change)
    }

    /// The step with a share of the dynamics' curvature; none where the problem is not convex.
    fn change_by(&self, barrier: f64, slopes: &Slopes, share: f64) -> Option<Change> {
        let (n, m, count) = (self.rates.states, self.rates.controls, self.problem.count);
        let mut recursion = Recursion::new(n, m, count);
        let end = &self.problem.end;
        recursion.hessians[count * n * n..].copy_from_slice(end);
        times(
            end,
            &self.x[count * n..],
            n,
            n,
            1,
            &mut recursion.gradients[count * n..],
        );
        for k in (0..count).rev() {
            self.expand(k, slopes, (barrier, share), &mut recursion);
            recursion.eliminate(k)?;
        }
        let change = self.forward(slopes, recursion);
        let finite = change.x.iter().chain(&change.u).all(|d| d.is_finite());
        finite.then_some(change)
    }

    /// The cost to go from a node as a function of its state and control: the step's own, that of
    /// the next node through the dynamics, and the barrier.
    #[inline]
    fn expand(
        &self,
        k: usize,
        at: &Slopes,
        (barrier, share): (f64, f64),
        recursion: &mut Recursion,
    ) {
        let (n, m) = (self.rates.states, self.rates.controls);
        let width = n + m;
        let Recursion {
            hessians,
            gradients,
            product,
            first,
            second,
            ..
        } = recursion;
        let hessian = &hessians[(k + 1) * n * n..][..n * n];
        first.copy_from_slice(at.gradient(k));
        second.copy_from_slice(at.hessian(k));
        for (second, curvature) in second.iter_mut().zip(at.curvature(k)) {
            *second += share * curvature;
        }
        let jacobian = at.jacobian(k);
        times(hessian, jacobian, n, n, width, product);
        for i in 0..n {
            let ahead = gradients[(k + 1) * n + i]
                + (0..n)
                    .map(|j| hessian[i * n + j] * self.gap(k * n + j))
                    .sum::<f64>();
            let row = &jacobian[i * width..][..width];
            for a in 0..width {
                first[a] += row[a] * ahead;
                for b in 0..width {
                    second[a * width + b] += row[a] * product[i * width + b];
                }
            }
        }
        for (i, room, sign, weight) in self.rooms(&self.u[k * m..][..m], barrier) {
            first[n + i] += sign * weight / room;
            second[(n + i) * (width + 1)] += self.dual(k * m + i, sign, weight / room) / room;
        }
    }

    /// The changes from the first node on, by the laws of the steps.
    fn forward(&self, slopes: &Slopes, recursion: Recursion) -> Change {
        let (n, m, count) = (self.rates.states, self.rates.controls, self.problem.count);
        let width = n + m;
        let Recursion {
            hessians,
            gradients,
            constants,
            gains,
            ..
        } = recursion;
        let mut change = Change {
            x: vec![0.0; (count + 1) * n],
            u: constants,
            p: gradients,
        };
        for k in 0..count {
            for i in 0..m {
                let gain = &gains[(k * m + i) * n..][..n];
                change.u[k * m + i] += (0..n).map(|j| gain[j] * change.x[k * n + j]).sum::<f64>();
            }
            for i in 0..n {
                let row = &slopes.jacobian(k)[i * width..][..width];
                let moved: f64 = (0..n).map(|j| row[j] * change.x[k * n + j]).sum();
                let driven: f64 = (0..m).map(|j| row[n + j] * change.u[k * m + j]).sum();
                change.x[(k + 1) * n + i] = moved + driven + self.gap(k * n + i);
            }
        }
        for k in 0..=count {
            for i in 0..n {
                let row = &hessians[(k * n + i) * n..][..n];
                change.p[k * n + i] += (0..n).map(|j| row[j] * change.x[k * n + j]).sum::<f64>();
            }
        }
        change
    }

    /// Takes as much of a step as makes the merit less; the whole step's size, none where there is
    /// no such part.
    fn advance(&mut self, change: &Change, barrier: f64) -> Option<f64> {
        let (n, m) = (self.rates.states, self.rates.controls);
        let mut share: f64 = 1.0;
        for (k, (u, du)) in self.u.iter().zip(&change.u).enumerate() {
            let [lo, hi] = self.problem.bounds[k % m];
            let room = if *du > 0.0 { hi - u } else { u - lo };
            if *du != 0.0 && room.is_finite() {
                share = share.min(WITHIN * room / du.abs());
            }
        }
        let now = self.merit(&self.x, &self.u, &self.steps, barrier);
        for _ in 0..HALVINGS {
            let moved = |a: &[f64], d: &[f64]| -> Vec<f64> {
                a.iter().zip(d).map(|(a, d)| a + share * d).collect()
            };
            let (x, u) = (moved(&self.x, &change.x), moved(&self.u, &change.u));
            if let Some(steps) = self.rates.steps(&x, &u, self.problem.step)
                && self.merit(&x, &u, &steps, barrier) < now
            {
                self.advance_duals(change, barrier);
                (self.x, self.u, self.steps) = (x, u, steps);
                let size = |(k, d): (usize, &f64)| (d / self.problem.widths[k % n]).abs();
                return Some(change.x.iter().enumerate().map(size).fold(0.0, f64::max));
            }
            share *= 0.5;
        }
        None
    }
}
