//! Trajectories by direct optimization: guesses for states that nothing shows the extremals of.
//!
//! State and control are unknowns at all steps of a fixed time at once, so that a guess need not
//! obey the dynamics, and instability does not matter: Newton steps on the linear-quadratic problem
//! along the guess, whose gaps they close (multiple shooting: Bock and Plitt 1984; by a Riccati
//! recursion: Giftthaler, Neunert, Staeuble, Buchli and Diehl, IROS 2018). Bounds of controls are a
//! primal-dual logarithmic barrier that is lowered (Waechter and Biegler 2006).

mod descent;
mod mirrors;
mod stage;

use crate::backend::Deadline;
use crate::model::{Horizon, Model};
use crate::numeric::random::uniform;
use crate::shooting::{End, Path};
use crate::sweep::Plan;
use crate::value::flight::homeward;
use crate::value::survey::times;
use descent::{Descent, Found, Transcription};
use mirrors::Mirror;
use rayon::prelude::*;
use stage::Rates;

/// Length of the horizon in times of the slowest mode of the closed loop.
const HORIZON: f64 = 10.0;
/// Steps in the time of the fastest one, their least number, and their largest while all are as long.
const STEPS: f64 = 2.5;
const LEAST_STEPS: usize = 100;
const MOST_STEPS: usize = 400;
/// Where modes are further apart, steps grow by this factor: fast ones matter at first. Their longest
/// in the time of the fastest mode of the open loop: longer ones would not be stable.
const GROWTH: f64 = 1.05;
const STABLE: f64 = 1.0;
const MOST_GROWN: usize = 600;
/// Size of the box about the region's middle in which states lie that guesses go by.
const VIA: f64 = 1.6;
/// Share of the cost that may be left at the end of the horizon.
const LEFT: f64 = 0.05;
/// Share of the cost and of widths within which two guesses are on their way to one trajectory.
const ALIKE: f64 = 0.01;
/// Costs of at most this many times the least are about the same.
const ALIKE_COSTS: f64 = 1.03;
/// Parts into which steps are divided once more.
const LEAST_PARTS: usize = 2;
const MOST_PARTS: usize = 8;
/// By which sums of times may be off.
const ROUNDING: f64 = 1e-9;
/// Parts of a step in which controls are simulated, and how far from where the local solution is
/// good, in V, they may end; what is left costs at most this much more than the local V.
const FLOWN: u32 = 4;
const HOME: f64 = 2.0;
/// Share of the usual duration that its segments have.
const SHORT: f64 = 1.0 / 16.0;
/// What costs more than this many times the least is not followed to its end.
const DEAR: f64 = 3.0;

/// Numbers of guesses from which on they are a trajectory that was found, moved by a swing; its sizes,
/// in widths.
pub const MOVED_FROM: u64 = 1 << 33;
const MOVES: [f64; 3] = [0.05, 0.15, 0.4];

/// What is left of the distance from where a trajectory began, in the time of the slowest mode:
/// exp(-this). How many times as dear as what is known it may be once it is begun.
const HANDED: f64 = 1.0;
const WORTH: f64 = 1.3;

/// Numbers of guesses from which on they hold their controls at first, within this share of the way to
/// their bounds; and how far they may be carried, in widths.
pub const CARRIED_FROM: u64 = 1 << 32;
const CARRIED: f64 = 0.95;
const FAR: f64 = 3.0;

/// Trajectories of a scene, optimized directly.
pub struct Direct<'a> {
    plan: &'a Plan,
    rates: Rates,
    problem: Transcription,
    mirrors: Vec<Mirror>,
    /// Whether its steps grow.
    grows: bool,
    /// Time of the slowest mode.
    slow: f64,
    duration: f64,
}

/// A trajectory with what it costs.
#[derive(Clone)]
pub struct Optimized {
    pub cost: f64,
    pub path: Path,
    found: Found,
}

/// What a round of guesses led to.
#[derive(Default)]
pub struct Round {
    /// Each trajectory once.
    pub found: Vec<Optimized>,
    /// What each guess that led anywhere came to, about: trajectories that turned out to be like
    /// another one's, or far too dear, were not followed to their ends.
    pub costs: Vec<f64>,
}

impl Round {
    /// Whether all guesses lead to about the same cost.
    pub fn is_plain(&self) -> bool {
        let least = self.costs.iter().copied().fold(f64::INFINITY, f64::min);
        (self.costs.iter()).all(|cost| *cost <= times(ALIKE_COSTS, least))
    }
}

impl<'a> Direct<'a> {
    /// `None` where there is no equilibrium or no control, in a game, and where modes are too far
    /// apart.
    pub fn new(plan: &'a Plan, model: &Model, duration: f64) -> Option<Self> {
        let local = plan.local.as_ref().filter(|_| !plan.game)?;
        let Horizon::Infinite { u: middle, .. } = &model.horizon else {
            return None;
        };
        let modes = &local.riccati.eigenvalues;
        let slow = 1.0
            / modes
                .iter()
                .map(|e| e.re.abs())
                .fold(f64::INFINITY, f64::min);
        let fast = 1.0 / modes.iter().map(|e| e.norm()).fold(0.0, f64::max);
        let time = HORIZON * slow;
        if !time.is_finite() || model.controls.is_empty() {
            return None;
        }
        let rates = Rates::new(model);
        let open = rates.fastest(middle);
        let steps = mesh(time, fast, open)?;
        let grows = steps[0] < steps[steps.len() - 1];
        let problem = Transcription {
            steps,
            widths: plan.widths.clone(),
            middle: middle.clone(),
            bounds: (model.controls.iter())
                .map(|c| {
                    [
                        c.min.unwrap_or(f64::NEG_INFINITY),
                        c.max.unwrap_or(f64::INFINITY),
                    ]
                })
                .collect(),
            // Symmetric: by columns is by rows.
            end: local.riccati.p.as_slice().to_vec(),
            deadline: Deadline::default(),
        };
        Some(Self {
            plan,
            mirrors: mirrors::mirrors(&rates, &problem),
            rates,
            problem,
            grows,
            slow,
            duration,
        })
    }

    /// Leaves out what takes longer: whoever sets a deadline has to look at it afterwards.
    pub fn until(mut self, deadline: Deadline) -> Self {
        self.problem.deadline = deadline;
        self
    }

    /// What comes of guesses with these numbers from a state, a deviation, where it does not cost
    /// much more than `most`; `known` is a trajectory from there that moved guesses begin with.
    pub fn optimized(
        &self,
        s: &[f64],
        guesses: &[u64],
        most: f64,
        known: Option<&Optimized>,
        end: &End,
    ) -> Round {
        let copies = self.copies(s);
        let mut tried = Vec::new();
        for &k in guesses {
            if k >= MOVED_FROM {
                tried.extend(known.map(|known| (k, known.found.states[0].as_slice())));
            } else {
                tried.extend(copies.iter().map(|s| (k, s.as_slice())));
            }
        }
        let mut begun: Vec<(f64, Descent<'_>)> = (tried.into_par_iter())
            .filter_map(|(k, from)| {
                let mut descent = if k >= MOVED_FROM {
                    self.moved(known?, k)?
                } else {
                    let guess = match k.checked_sub(CARRIED_FROM) {
                        Some(k) => self.carried(from, k)?,
                        None => self.guess(from, k),
                    };
                    Descent::new(&self.rates, &self.problem, &guess)?
                };
                descent.begin()?;
                Some((descent.cost(), descent))
            })
            .collect();
        begun.sort_by(|a, b| a.0.total_cmp(&b.0));
        let Some(least) = begun.first().map(|(cost, _)| *cost) else {
            return Round::default();
        };
        let worth = times(DEAR, least.min(most));
        // Those that are on their way to the same trajectory, by the first of them.
        let mut ways: Vec<(f64, Descent<'_>, usize)> = Vec::new();
        let mut costs = Vec::new();
        for (cost, descent) in begun {
            if cost > worth {
                costs.push(cost);
                continue;
            }
            let is_like = |way: &(f64, Descent<'_>, usize)| {
                cost - way.0 <= ALIKE * way.0.abs() && descent.apart(&way.1) <= ALIKE
            };
            match ways.iter_mut().find(|way| is_like(way)) {
                Some(way) => way.2 += 1,
                None => ways.push((cost, descent, 1)),
            }
        }
        let finished: Vec<(Optimized, usize)> = (ways.into_par_iter())
            .filter_map(|(_, descent, times)| Some((self.shown(descent.finish()?, end)?, times)))
            .collect();
        let of_each = |(o, times): &(Optimized, usize)| std::iter::repeat_n(o.cost, *times);
        costs.extend(finished.iter().flat_map(of_each));
        Round {
            found: finished.into_iter().map(|(o, _)| o).collect(),
            costs,
        }
    }

    /// Whether the problem has mirrors.
    pub fn is_mirrored(&self) -> bool {
        !self.mirrors.is_empty()
    }

    /// Images of a state, a deviation, in the problem's mirrors, each with its mirror's number.
    pub fn images(&self, s: &[f64]) -> Vec<(usize, Vec<f64>)> {
        (self.mirrors.iter().enumerate())
            .map(|(k, mirror)| (k, mirror.of(s)))
            .collect()
    }

    /// A path's image in a mirror: it costs the same.
    pub fn image(&self, path: &Path, mirror: usize) -> Path {
        let mut path = path.clone();
        let signs = self.mirrors[mirror].states.iter().cycle();
        path.nodes
            .iter_mut()
            .zip(signs)
            .for_each(|(v, sign)| *v *= sign);
        path
    }

    /// The image of what was optimized, if it is a trajectory that costs the same.
    pub fn mirrored(&self, one: &Optimized, mirror: usize) -> Option<Optimized> {
        let found = self.mirrors[mirror].trajectory(&self.rates, &self.problem, &one.found)?;
        Some(Optimized {
            cost: one.cost,
            path: self.image(&one.path, mirror),
            found,
        })
    }

    /// A state and its copies by a period, as far as they may lead to the equilibrium at less cost.
    fn copies(&self, s: &[f64]) -> Vec<Vec<f64>> {
        let mut copies = vec![homeward(s, &self.plan.recurrent)];
        for (i, period) in self.plan.recurrent.iter().enumerate() {
            let Some(period) = period else { continue };
            for near in copies.clone() {
                let mut other = near;
                other[i] -= period.copysign(other[i]);
                copies.push(other);
            }
        }
        copies
    }

    /// States along a guess that holds its controls for a while before it decays: it goes where it is
    /// carried.
    fn carried(&self, s: &[f64], k: u64) -> Option<Vec<Vec<f64>>> {
        let number = |j: u64| uniform(k, j);
        let held: Vec<f64> = (self
            .problem
            .bounds
            .iter()
            .zip(&self.problem.middle)
            .zip(2u64..))
        .map(|((bounds, middle), j)| {
            let pick = (4.0 * number(j)) as usize;
            let [lo, hi] = bounds.map(|b| if b.is_finite() { b } else { *middle });
            let at = [0.0, 0.5, 1.0, number(100 + j)][pick.min(3)];
            middle + CARRIED * (lo + at * (hi - lo) - middle)
        })
        .collect();
        let time = self.slow * (0.1 + 1.5 * number(0));
        let rate = (1.0 + 3.0 * number(1)) / self.slow;
        let mut states = vec![s.to_vec()];
        let mut t = 0.0;
        for &step in &self.problem.steps {
            let last = &states[states.len() - 1];
            let next = if t < time {
                self.rates.steps(last, &held, &[step])?.next
            } else {
                last.iter().map(|s| s * (-rate * step).exp()).collect()
            };
            let near = |(s, width): (&f64, &f64)| s.is_finite() && s.abs() < FAR * width;
            if !next.iter().zip(&self.plan.widths).all(near) {
                return None;
            }
            states.push(next);
            t += step;
        }
        Some(states)
    }

    /// A trajectory that was found, moved by a swing that fades.
    fn moved(&self, known: &Optimized, k: u64) -> Option<Descent<'_>> {
        let number = |j: u64| uniform(k, j);
        let size = MOVES[(k % 3) as usize];
        let (decay, swing) = (0.3 + 2.0 * number(0), 12.0 * number(1));
        let amplitude: Vec<f64> = (self.plan.widths.iter().zip(2u64..))
            .map(|(width, j)| size * width * (2.0 * number(j) - 1.0))
            .collect();
        self.along(known, &amplitude, |t| {
            (-decay * t).exp() * (swing * t).sin()
        })
    }

    /// A trajectory that was found, moved in a direction by what a time, in that of the slowest mode,
    /// says.
    fn along(
        &self,
        known: &Optimized,
        direction: &[f64],
        by: impl Fn(f64) -> f64,
    ) -> Option<Descent<'_>> {
        let shares = self.problem.times().map(|t| by(t / self.slow));
        let x = (shares.zip(&known.found.states)).flat_map(|(share, state)| {
            (state.iter().zip(direction)).map(move |(s, d)| s + share * d)
        });
        let controls = known.found.controls.clone();
        Descent::from(&self.rates, &self.problem, x.collect(), controls)
    }

    /// What a trajectory from elsewhere comes to from a state, a deviation, if that costs not much
    /// more than `most`: at first it is moved there, by what fades.
    pub fn handed(&self, known: &Optimized, s: &[f64], most: f64, end: &End) -> Option<Optimized> {
        let from = known.found.states[0].iter();
        let apart: Vec<f64> = s.iter().zip(from).map(|(s, from)| s - from).collect();
        let apart = homeward(&apart, &self.plan.recurrent);
        let descent = self.along(known, &apart, |t| (-HANDED * t).exp())?;
        self.followed(descent, most, end)
    }

    /// What the states of a path come to, if that costs not much more than `most`.
    pub fn smoothed(&self, path: &Path, most: f64, end: &End) -> Option<Optimized> {
        let n = self.rates.states;
        let mut corners = vec![(0.0, path.start().to_vec())];
        for (k, duration) in path.durations.iter().enumerate() {
            let at = corners[k].0 + duration;
            corners.push((at, path.node(k + 1)[..n].to_vec()));
        }
        let guess: Vec<Vec<f64>> = self.problem.times().map(|t| between(&corners, t)).collect();
        self.followed(Descent::new(&self.rates, &self.problem, &guess)?, most, end)
    }

    /// What a guess comes to, if that costs not much more than `most`.
    fn followed(&self, mut descent: Descent<'_>, most: f64, end: &End) -> Option<Optimized> {
        descent.begin()?;
        if descent.cost() > times(WORTH, most) {
            return None;
        }
        self.shown(descent.finish()?, end)
    }

    /// States along a guess: ways to the equilibrium that decay, swing, or go by another state.
    fn guess(&self, s: &[f64], k: u64) -> Vec<Vec<f64>> {
        let n = s.len();
        let number = |j: u64| uniform(k, j);
        let times = self.problem.times().map(|t| t / self.slow);
        match k {
            0 | 1 => {
                let rate = [1.0, 4.0][k as usize];
                times
                    .map(|t| s.iter().map(|s| s * (-rate * t).exp()).collect())
                    .collect()
            }
            _ if k.is_multiple_of(3) => {
                let size = [0.1, 0.3, 0.6][(k / 3 % 3) as usize];
                let (decay, swing) = (0.3 + 2.0 * number(0), 12.0 * number(1));
                let amplitude: Vec<f64> = (0..n)
                    .map(|i| size * self.plan.widths[i] * (2.0 * number(2 + i as u64) - 1.0))
                    .collect();
                times
                    .map(|t| {
                        let bump = (-decay * t).exp() * (swing * t).sin();
                        (s.iter().zip(&amplitude))
                            .map(|(s, a)| s * (-2.0 * t).exp() + a * bump)
                            .collect()
                    })
                    .collect()
            }
            _ => {
                // By one or two states.
                let mut corners = vec![(0.0, s.to_vec())];
                for via in 0..k % 3 {
                    let draw = |j: u64| number(via * (1 + n as u64) + j);
                    let time = corners[via as usize].0 + HORIZON * (0.02 + 0.2 * draw(0));
                    let state = (0..n).map(|i| {
                        let [lo, hi] = self.plan.region[i];
                        0.5 * (lo + hi) + VIA * (draw(1 + i as u64) - 0.5) * (hi - lo)
                    });
                    corners.push((time, state.collect()));
                }
                let time = corners[corners.len() - 1].0 + HORIZON * (0.02 + 0.3 * number(1000));
                corners.push((time, vec![0.0; n]));
                times.map(|t| between(&corners, t)).collect()
            }
        }
    }

    /// What was found, as a guess: with shorter steps where they grow.
    fn shown(&self, found: Found, end: &End) -> Option<Optimized> {
        if self.grows {
            let fine = self.divided(&found, found.states.len() - 1, LEAST_PARTS);
            let shown =
                fine.and_then(|(fine, problem)| self.path(fine, &problem, self.duration, end));
            if let Some(shown) = shown {
                return Some(Optimized { found, ..shown });
            }
        }
        self.path(found, &self.problem, self.duration, end)
    }

    /// A trajectory with shorter steps, as long as it is on its way: what is narrow is passed at
    /// other costs, and controls switch at times between the steps. Its path has shorter segments:
    /// beside what is narrow trajectories part sooner than at the equilibrium.
    pub fn refined(&self, one: &Optimized, end: &End) -> Option<Optimized> {
        let on_its_way = self.arrival(&one.found.states);
        let parts = (self.problem.steps.len() / on_its_way.max(1)).clamp(LEAST_PARTS, MOST_PARTS);
        let parts = if self.grows { MOST_PARTS } else { parts };
        let (found, problem) = self.divided(&one.found, on_its_way, parts)?;
        self.path(found, &problem, SHORT * self.duration, end)
    }

    /// The first steps of a trajectory divided into parts, and optimized again.
    fn divided(&self, found: &Found, count: usize, parts: usize) -> Option<(Found, Transcription)> {
        let (states, controls) = (&found.states, &found.controls);
        let (n, m) = (self.rates.states, self.rates.controls);
        let parted = |step: &f64| std::iter::repeat_n(step / parts as f64, parts);
        let problem = Transcription {
            steps: (self.problem.steps[..count].iter())
                .flat_map(parted)
                .collect(),
            ..self.problem.clone()
        };
        let mut x: Vec<f64> = Vec::with_capacity((count * parts + 1) * n);
        let mut u = Vec::with_capacity(count * parts * m);
        for k in 0..count {
            let control = &controls[k * m..][..m];
            let mut at = states[k].clone();
            for _ in 0..parts {
                x.extend_from_slice(&at);
                u.extend_from_slice(control);
                let step = [self.problem.steps[k] / parts as f64];
                at = self.rates.steps(&at, control, &step)?.next;
            }
        }
        x.extend_from_slice(&states[count]);
        let found = Descent::from(&self.rates, &problem, x, u)?.mend()?;
        Some((found, problem))
    }

    /// What the controls of a trajectory cost where they are simulated, with what answers deviations
    /// from it; `None` where they do not lead home.
    pub fn attained(&self, one: &Optimized) -> Option<f64> {
        let (local, found) = (self.plan.local.as_ref()?, &one.found);
        let (n, m) = (self.rates.states, self.rates.controls);
        let (mut x, mut cost) = (found.states[0].clone(), 0.0);
        for (k, step) in found.steps.iter().enumerate() {
            for part in 0..FLOWN {
                let share = f64::from(part) / f64::from(FLOWN);
                let (before, after) = (&found.states[k], &found.states[k + 1]);
                let off = |j: usize| x[j] - before[j] - share * (after[j] - before[j]);
                let control = |i: usize| {
                    let gain = &found.gains[(k * m + i) * n..][..n];
                    let answer: f64 = (0..n).map(|j| gain[j] * off(j)).sum();
                    let [lo, hi] = self.problem.bounds[i];
                    (found.controls[k * m + i] + answer).clamp(lo, hi)
                };
                let u: Vec<f64> = (0..m).map(control).collect();
                let flown = self.rates.steps(&x, &u, &[step / f64::from(FLOWN)])?;
                cost += flown.cost[0];
                x = flown.next;
            }
        }
        let left = local.quadratic(&x);
        (left <= HOME * local.seed_value).then_some(cost + HOME * left)
    }

    /// The first node that is near the equilibrium; the last one where none is.
    fn arrival(&self, states: &[Vec<f64>]) -> usize {
        let is_near = |s: &Vec<f64>| {
            let local = self.plan.local.as_ref();
            local.is_some_and(|local| local.quadratic(s) <= local.seed_value)
        };
        states.iter().position(is_near).unwrap_or(states.len() - 1)
    }

    /// A path for the boundary value problem, in segments of at most this duration, if what was
    /// found comes home.
    fn path(
        &self,
        found: Found,
        problem: &Transcription,
        duration: f64,
        end: &End,
    ) -> Option<Optimized> {
        let local = self.plan.local.as_ref()?;
        let last = found.states.len() - 1;
        if local.quadratic(&found.states[last]) > LEFT * found.cost.abs() {
            return None;
        }
        let node = |k: usize| [found.states[k].as_slice(), &found.adjoints[k]].concat();
        let times: Vec<f64> = problem.times().collect();
        let mut path = Path::new(&node(0));
        let mut at = 0;
        // What is near the equilibrium follows the local solution.
        while at < last && local.quadratic(&found.states[at]) > local.seed_value {
            let until = times[at] + duration * (1.0 + ROUNDING);
            let next = (times.partition_point(|t| *t <= until) - 1).clamp(at + 1, last);
            path.push(times[next] - times[at], &node(next));
            at = next;
        }
        let (nodes, durations) = end.tail(&found.states[at], found.cost, self.duration);
        path.append(&nodes, &durations);
        Some(Optimized {
            cost: found.cost,
            path,
            found,
        })
    }
}

/// Durations of steps over a time, as the fastest mode of the closed loop wants them and that of the
/// open one allows; `None` where that would be too many.
fn mesh(time: f64, fast: f64, open: f64) -> Option<Vec<f64>> {
    let count = ((STEPS * time / fast).ceil()).max(LEAST_STEPS as f64);
    if count <= MOST_STEPS as f64 {
        return Some(vec![time / count; count as usize]);
    }
    let longest = (time / LEAST_STEPS as f64).min(STABLE * open);
    let mut steps = Vec::new();
    let (mut step, mut at) = ((fast / STEPS).min(longest), 0.0);
    while at < time && steps.len() < MOST_GROWN {
        steps.push(step);
        at += step;
        step = (GROWTH * step).min(longest);
    }
    (at >= time).then_some(steps)
}

/// The state at a time on straight ways between timed states; the last one after them.
fn between(corners: &[(f64, Vec<f64>)], t: f64) -> Vec<f64> {
    let last = corners.len() - 1;
    let next = corners
        .iter()
        .position(|(time, _)| *time > t)
        .unwrap_or(last)
        .max(1);
    let ((from, a), (to, b)) = (&corners[next - 1], &corners[next]);
    let share = ((t - from) / (to - from)).min(1.0);
    a.iter().zip(b).map(|(a, b)| a + share * (b - a)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_grow_where_modes_are_far_apart() {
        let even = mesh(10.0, 0.5, 0.3).expect("few");
        assert_eq!(even, vec![0.1; 100]);
        // A thousand steps as long as the first would be needed.
        let grown = mesh(6.0, 0.01, 0.05).expect("few enough");
        assert_eq!(grown[0], 0.004);
        assert!(grown.len() < 200, "{} steps", grown.len());
        let time: f64 = grown.iter().sum();
        assert!((6.0..6.05 + 1e-9).contains(&time), "{time}");
        assert!(grown.windows(2).all(|w| w[1] <= GROWTH * w[0]));
        assert!(grown.iter().all(|step| *step <= STABLE * 0.05));
        // The open loop itself is too fast.
        assert_eq!(mesh(10.0, 1e-4, 1e-4), None);
    }
}
