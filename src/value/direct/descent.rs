//! Newton steps on a transcribed problem, by a Riccati recursion. Where its Hessian is not convex,
//! less of the dynamics' curvature is taken, down to Gauss-Newton steps.

use super::stage::{Rates, Slopes, Steps, times};
use crate::backend::Deadline;
use crate::backend::cpu::Simd;
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
/// After the first of them parts of a step along the dynamics are not tried.
const ROLLED: usize = 5;
/// The merit of closing a gap is this many times what closing it costs, or this share of what it
/// was before.
const MERIT: f64 = 1.5;
const FADING: f64 = 0.7;
/// Steps of which less than this share is taken are damped more, and less where this share is: by a
/// factor; by a larger one where no share leads down.
const SHORT: f64 = 0.125;
const LONG: f64 = 0.5;
const DAMPED: f64 = 4.0;
const DAMPED_AT_LAST: f64 = 16.0;
const LEAST_DAMPING: f64 = 0.1;
const MOST_DAMPING: f64 = 1e6;
/// Share of what closing the gaps gains that the cost may rise by along a step.
const DOWN: f64 = 0.9;

/// Times of a transcribed problem, bounds and scales.
#[derive(Clone)]
pub(super) struct Transcription {
    /// Durations of the steps.
    pub steps: Vec<f64>,
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
    fn count(&self) -> usize {
        self.steps.len()
    }

    /// Of the nodes.
    pub fn times(&self) -> impl Iterator<Item = f64> + '_ {
        let first = std::iter::once(0.0);
        first.chain(self.steps.iter().scan(0.0, |t, step| {
            *t += step;
            Some(*t)
        }))
    }

    fn is_bounded(&self) -> bool {
        self.bounds.iter().flatten().any(|b| b.is_finite())
    }
}

/// A trajectory that was found.
#[derive(Clone)]
pub(super) struct Found {
    pub cost: f64,
    pub states: Vec<Vec<f64>>,
    pub adjoints: Vec<Vec<f64>>,
    /// `[step][m]`.
    pub controls: Vec<f64>,
    /// By which controls answer deviations of the state, `[step][m][n]`.
    pub gains: Vec<f64>,
    /// Durations of the steps.
    pub steps: Vec<f64>,
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
    /// What keeps steps short: Hessian of a running cost of the states' changes, as a share of V's
    /// about the equilibrium over the whole time.
    damping: f64,
    /// Which share of the dynamics' curvature served last.
    share: usize,
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
    /// The laws of the steps: changes of u where x does not change, and by x, `[step][m][n]`.
    constants: Vec<f64>,
    gains: Vec<f64>,
}

/// What a problem along a guess consists of beside its first derivatives.
struct Weights {
    barrier: f64,
    /// Of the dynamics' curvature.
    share: f64,
    /// Of V's Hessian about the equilibrium, for a unit of time.
    damping: f64,
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
    #[inline(always)]
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
        let u = problem.middle.repeat(problem.count());
        Self::from(rates, problem, guess.concat(), u)
    }

    /// From states and controls.
    pub fn from(
        rates: &'a Rates,
        problem: &'a Transcription,
        x: Vec<f64>,
        u: Vec<f64>,
    ) -> Option<Self> {
        let steps = rates.steps(&x, &u, &problem.steps)?;
        let (n, m) = (rates.states, rates.controls);
        let first = rates.slopes(
            &rates.steps(&x[..2 * n], &u[..m], &problem.steps[..1])?,
            &problem.steps[..1],
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
            damping: 0.0,
            share: 0,
            penalty: vec![0.0; problem.count() * n],
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
        if self.problem.is_bounded() {
            for barrier in &BARRIERS[..BEGUN] {
                self.descend(*barrier, STEPS, SMALL)?;
            }
        } else {
            self.descend(BARRIERS[BARRIERS.len() - 1], LAST_STEPS, SMALL)?;
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
        let gains = self.change(BARRIERS[BARRIERS.len() - 1])?.gains;
        let rows = |v: &[f64]| v.chunks(self.rates.states).map(<[f64]>::to_vec).collect();
        self.is_closed().then(|| Found {
            cost: self.cost_of(&self.x, &self.steps),
            states: rows(&self.x),
            adjoints: rows(&self.p),
            controls: self.u,
            gains,
            steps: self.problem.steps.clone(),
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
        for _ in 0..most {
            self.problem.deadline.check().ok()?;
            let change = self.change(barrier)?;
            let Some((size, share)) = self.advance(&change, barrier) else {
                self.damping = (DAMPED_AT_LAST * self.damping).max(LEAST_DAMPING);
                if self.damping > MOST_DAMPING {
                    break;
                }
                continue;
            };
            self.p = change.p;
            if size <= small && self.damping == 0.0 {
                break;
            }
            if share < SHORT {
                self.damping = (DAMPED * self.damping).max(LEAST_DAMPING);
            } else if share >= LONG {
                self.damping /= DAMPED;
                if self.damping < LEAST_DAMPING {
                    self.damping = 0.0;
                }
            }
            costs.push(self.cost_of(&self.x, &self.steps));
            let last = costs.len() - 1;
            let settled = (last.checked_sub(SETTLING)).is_some_and(|before| {
                (costs[last] - costs[before]).abs() < SETTLED * costs[last].abs()
            });
            if settled && self.is_closed() {
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

    /// Whether its gaps are closed.
    pub fn is_closed(&self) -> bool {
        self.largest_gap() < CLOSED
    }

    /// A gap's component.
    fn gap(&self, k: usize) -> f64 {
        self.steps.next[k] - self.x[self.rates.states + k]
    }

    fn cost_of(&self, x: &[f64], steps: &Steps) -> f64 {
        let n = self.rates.states;
        let end = &x[self.problem.count() * n..];
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
            .slopes(&self.steps, &self.problem.steps, self.p.get(n..));
        // Of the share that served last, a larger one may serve now.
        let first = if self.p.is_empty() {
            SHARES.len() - 1
        } else {
            self.share.saturating_sub(1)
        };
        let (share, change) = (first..SHARES.len())
            .find_map(|k| Some((k, self.change_by(barrier, &slopes, SHARES[k])?)))?;
        if !self.p.is_empty() {
            self.share = share;
        }
        for (penalty, p) in self.penalty.iter_mut().zip(&change.p[n..]) {
            *penalty = (FADING * *penalty).max(MERIT * p.abs());
        }
        // Where the problem is convex only between gaps that are closed the step may still lead up.
        let open: f64 = (self.penalty.iter().enumerate())
            .map(|(k, penalty)| penalty * self.gap(k).abs())
            .sum();
        let along = self.slope_along(&slopes, &change, barrier);
        if along > DOWN * open && open > 0.0 {
            let more = along / (DOWN * open);
            self.penalty.iter_mut().for_each(|penalty| *penalty *= more);
        }
        Some(change)
    }

    /// By how much the cost, the barrier's too, changes along a step, to first order.
    fn slope_along(&self, slopes: &Slopes, change: &Change, barrier: f64) -> f64 {
        let (n, m, count) = (self.rates.states, self.rates.controls, self.problem.count());
        let end = &self.x[count * n..];
        let mut slope = vec![0.0; n];
        times(&self.problem.end, end, n, n, 1, &mut slope);
        let mut along = dot(&slope, &change.x[count * n..]);
        for k in 0..count {
            let (by_state, by_control) = slopes.gradient(k).split_at(n);
            let du = &change.u[k * m..][..m];
            along += dot(by_state, &change.x[k * n..][..n]) + dot(by_control, du);
            along += (self.rooms(&self.u[k * m..][..m], barrier))
                .map(|(i, room, sign, weight)| sign * weight / room * du[i])
                .sum::<f64>();
        }
        along
    }

    /// The step with a share of the dynamics' curvature; none where the problem is not convex.
    fn change_by(&self, barrier: f64, slopes: &Slopes, share: f64) -> Option<Change> {
        let (n, m, count) = (self.rates.states, self.rates.controls, self.problem.count());
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
        let weights = Weights {
            barrier,
            share,
            damping: self.damping / self.problem.steps.iter().sum::<f64>(),
        };
        self.back_by(slopes, &weights, &mut recursion)?;
        let change = self.forward(slopes, recursion);
        let finite = change.x.iter().chain(&change.u).all(|d| d.is_finite());
        finite.then_some(change)
    }

    /// The laws of all steps, from the last one on.
    #[inline(always)]
    fn back(&self, slopes: &Slopes, weights: &Weights, recursion: &mut Recursion) -> Option<()> {
        for k in (0..self.problem.count()).rev() {
            self.expand(k, slopes, weights, recursion);
            recursion.eliminate(k)?;
        }
        Some(())
    }

    /// The same with the widest vectors there are.
    fn back_by(&self, slopes: &Slopes, weights: &Weights, recursion: &mut Recursion) -> Option<()> {
        match self.rates.simd {
            // SAFETY: the set was detected.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => unsafe { back_avx512(self, slopes, weights, recursion) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => unsafe { back_avx2(self, slopes, weights, recursion) },
            _ => self.back(slopes, weights, recursion),
        }
    }

    /// The cost to go from a node as a function of its state and control: the step's own, that of
    /// the next node through the dynamics, and the barrier.
    #[inline(always)]
    fn expand(&self, k: usize, at: &Slopes, weights: &Weights, recursion: &mut Recursion) {
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
            *second += weights.share * curvature;
        }
        let jacobian = at.jacobian(k);
        times(hessian, jacobian, n, n, width, product);
        for i in 0..n {
            let ahead = gradients[(k + 1) * n + i]
                + (0..n)
                    .map(|j| hessian[i * n + j] * self.gap(k * n + j))
                    .sum::<f64>();
            let row = &jacobian[i * width..][..width];
            let product = &product[i * width..][..width];
            for a in 0..width {
                first[a] += row[a] * ahead;
                let second = &mut second[a * width..][..width];
                for (second, product) in second[a..].iter_mut().zip(&product[a..]) {
                    *second += row[a] * product;
                }
            }
        }
        // It is symmetric: the rest is the same.
        for a in 0..width {
            for b in 0..a {
                second[a * width + b] = second[b * width + a];
            }
        }
        let damping = weights.damping * self.problem.steps[k];
        for i in 0..n {
            second[i * (width + 1)] += damping * self.problem.end[i * (n + 1)];
        }
        for (i, room, sign, weight) in self.rooms(&self.u[k * m..][..m], weights.barrier) {
            first[n + i] += sign * weight / room;
            second[(n + i) * (width + 1)] += self.dual(k * m + i, sign, weight / room) / room;
        }
    }

    /// The changes from the first node on, by the laws of the steps.
    fn forward(&self, slopes: &Slopes, recursion: Recursion) -> Change {
        let (n, m, count) = (self.rates.states, self.rates.controls, self.problem.count());
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
            u: constants.clone(),
            p: gradients,
            constants,
            gains,
        };
        for k in 0..count {
            for i in 0..m {
                let gain = &change.gains[(k * m + i) * n..][..n];
                change.u[k * m + i] += dot(gain, &change.x[k * n..][..n]);
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

    /// Takes as much of a step as makes the merit less; the whole step's size and the share of it,
    /// none where there is no such part.
    fn advance(&mut self, change: &Change, barrier: f64) -> Option<(f64, f64)> {
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
        for halving in 0..HALVINGS {
            let moved = |a: &[f64], d: &[f64]| -> Vec<f64> {
                a.iter().zip(d).map(|(a, d)| a + share * d).collect()
            };
            let straight = || Some((moved(&self.x, &change.x), moved(&self.u, &change.u)));
            let less = |(x, u): (Vec<f64>, Vec<f64>)| {
                let steps = self.rates.steps(&x, &u, &self.problem.steps)?;
                (self.merit(&x, &u, &steps, barrier) < now).then_some((x, u, steps))
            };
            let rolled = || match halving < ROLLED {
                true => self.rolled(change, share),
                false => None,
            };
            if let Some((x, u, steps)) =
                (straight().and_then(less)).or_else(|| rolled().and_then(less))
            {
                self.advance_duals(change, barrier);
                (self.x, self.u, self.steps) = (x, u, steps);
                let size = |(k, d): (usize, &f64)| (d / self.problem.widths[k % n]).abs();
                let size = change.x.iter().enumerate().map(size).fold(0.0, f64::max);
                return Some((size, share));
            }
            share *= 0.5;
        }
        None
    }

    /// A share of a step along the dynamics, by the steps' laws: gaps grow less by that share, and
    /// open nowhere else (Mastalli et al., Crocoddyl, ICRA 2020). None where a control leaves its
    /// bounds.
    fn rolled(&self, change: &Change, share: f64) -> Option<(Vec<f64>, Vec<f64>)> {
        let (n, m) = (self.rates.states, self.rates.controls);
        let mut x = vec![0.0; self.x.len()];
        let mut u = Vec::with_capacity(self.u.len());
        let (mut off, mut room) = (vec![0.0; n], Vec::new());
        x[..n].copy_from_slice(&self.x[..n]);
        for (k, step) in self.problem.steps.iter().enumerate() {
            let (at, next) = x[k * n..][..2 * n].split_at_mut(n);
            (0..n).for_each(|i| off[i] = at[i] - self.x[k * n + i]);
            for i in k * m..(k + 1) * m {
                let law = dot(&change.gains[i * n..][..n], &off);
                let control = self.u[i] + share * change.constants[i] + law;
                let [lo, hi] = self.problem.bounds[i % m];
                if !(lo < control && control < hi) {
                    return None;
                }
                u.push(control);
            }
            self.rates.step(at, &u[k * m..], *step, next, &mut room);
            for (i, next) in next.iter_mut().enumerate() {
                *next -= (1.0 - share) * self.gap(k * n + i);
            }
        }
        Some((x, u))
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn back_avx512(
    descent: &Descent<'_>,
    slopes: &Slopes,
    weights: &Weights,
    recursion: &mut Recursion,
) -> Option<()> {
    descent.back(slopes, weights, recursion)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn back_avx2(
    descent: &Descent<'_>,
    slopes: &Slopes,
    weights: &Weights,
    recursion: &mut Recursion,
) -> Option<()> {
    descent.back(slopes, weights, recursion)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario;

    /// A pendulum held upright against a constraint of its torque, from states that obey nothing.
    #[test]
    fn gaps_shrink_along_the_dynamics_and_close() {
        let text = r#"
            states = { a = {}, b = {} }
            controls = { u = { min = -6, max = 6 } }
            dynamics = { a = "b", b = "4*sin(a) + u" }
            cost = { running = "a^2 + 0.5*b^2 + 0.5*u^2" }
            equilibrium = { a = 0, b = 0, u = 0 }
            region = { a = [-1, 1], b = [-1, 1] }
            shoot_out = { value_max = 1 }
            "#;
        let model = scenario::parse(text, "test", &[]).expect("a scene");
        let rates = Rates::new(&model);
        let steps: Vec<f64> = (0..60)
            .map(|k| (0.02 * 1.05_f64.powi(k)).min(0.2))
            .collect();
        let problem = Transcription {
            widths: vec![1.0; 2],
            middle: vec![0.0],
            bounds: vec![[-6.0, 6.0]],
            end: vec![20.0, 5.0, 5.0, 3.0],
            deadline: Deadline::default(),
            steps,
        };
        let guess: Vec<Vec<f64>> = (problem.times())
            .map(|t| vec![0.5 * (-0.5 * t).exp(), (3.0 * t).sin() * (-t).exp()])
            .collect();
        let mut descent = Descent::new(&rates, &problem, &guess).expect("finite");
        let change = descent.change(1.0).expect("convex");
        let gaps = |x: &[f64], steps: &Steps| -> Vec<f64> {
            steps
                .next
                .iter()
                .zip(&x[2..])
                .map(|(next, x)| next - x)
                .collect()
        };
        let before = gaps(&descent.x, &descent.steps);
        for share in [1.0, 0.25] {
            let (x, u) = descent.rolled(&change, share).expect("within bounds");
            let steps = rates.steps(&x, &u, &problem.steps).expect("finite");
            for (after, before) in gaps(&x, &steps).iter().zip(&before) {
                let expected = (1.0 - share) * before;
                assert!((after - expected).abs() < 1e-12, "{after} for {expected}");
            }
        }
        descent.begin().expect("leads somewhere");
        let found = descent.finish().expect("ends");
        let last = &found.states[problem.count()];
        assert!(last.iter().all(|s| s.abs() < 1e-2), "not home: {last:?}");
        // By a difference of two trajectories: p is the slope of the cost, and gains are those of
        // the controls.
        let other = |a: f64| {
            let mut guess = found.states.clone();
            guess[0][0] = a;
            let mut other = Descent::new(&rates, &problem, &guess).expect("finite");
            other.begin().expect("leads somewhere");
            other.finish().expect("ends")
        };
        let eps = 1e-2;
        let (above, below) = (other(0.5 + eps), other(0.5 - eps));
        let slope = (above.cost - below.cost) / (2.0 * eps);
        let p = found.adjoints[0][0];
        assert!((slope - p).abs() < 1e-3 * p.abs(), "{slope} for {p}");
        let slope = (above.controls[0] - below.controls[0]) / (2.0 * eps);
        let gain = found.gains[0];
        assert!(
            (slope - gain).abs() < 0.01 * gain.abs(),
            "{slope} for {gain}"
        );
    }
}
