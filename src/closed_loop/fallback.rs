//! What the law of a chart does where the chart has no answer.

use super::charted::Wings;
use super::equations::set_chart;
use super::simulate::Ground;
use super::{Chart, Expansions};
use crate::backend::{BackendError, Status, Trajectories};
use crate::model::Outside;

/// Ways from a state without an answer towards the reference point at which the chart is asked.
const INWARD: [f64; 7] = [0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7];
/// A search goes on for this many times the periods after which the first plan has come back, and
/// these more.
const LONGER: usize = 4;
const AT_LEAST: usize = 4;

/// p that is held for some periods; then that of the nearest state known.
#[derive(Clone, Debug, Default)]
pub(super) struct Plan {
    p: Vec<f64>,
    left: usize,
}

/// Legs that are left, and how long each is.
#[derive(Clone, Copy)]
pub(super) struct Rest {
    pub legs: usize,
    pub length: f64,
}

/// With what trajectories without an answer are helped, many at once.
pub(super) struct Help<'h, 'k> {
    pub outside: Outside,
    pub wings: &'h mut Wings<'k>,
    pub chart: &'h dyn Chart,
    pub room: &'h mut Expansions,
}

/// A plan on trial.
struct Trial {
    /// Number of the trajectory, and of the plan.
    of: usize,
    number: usize,
    plan: Plan,
    /// The period at which a shorter plan (of this number, the longer one having the next) leaves
    /// off holding p: until then they are one flight.
    parts: Option<usize>,
}

/// The cheapest plan of a trajectory that has come back.
#[derive(Clone, Copy, Default)]
struct Best {
    /// What it costs, and its number.
    plan: Option<(f64, usize)>,
    /// Periods after which no other one is waited for.
    last: usize,
}

/// Trajectories as plans for them begin.
#[derive(Clone, Copy)]
struct Begin<'b> {
    /// `[trajectory][dim]`.
    vectors: &'b [f64],
    dim: usize,
    /// Index of J.
    cost: usize,
}

impl<'b> Begin<'b> {
    fn vector(&self, of: usize) -> &'b [f64] {
        &self.vectors[of * self.dim..][..self.dim]
    }
}

/// Plans that are tried at once, period by period.
struct Trials<'b> {
    begin: Begin<'b>,
    alive: Vec<Trial>,
    /// Where each of these is: `[plan][dim]`.
    seeds: Vec<f64>,
    /// One a trajectory.
    best: Vec<Best>,
}

impl<'b> Trials<'b> {
    fn new(alive: Vec<Trial>, begin: Begin<'b>, periods: usize) -> Self {
        let best = Best {
            plan: None,
            last: periods,
        };
        Self {
            best: vec![best; begin.vectors.len() / begin.dim],
            seeds: (alive.iter())
                .flat_map(|t| begin.vector(t.of))
                .copied()
                .collect(),
            alive,
            begin,
        }
    }

    /// Parts from longer plans the shorter ones that leave off holding p at this period.
    fn part(&mut self, period: usize) {
        let dim = self.begin.dim;
        for j in 0..self.alive.len() {
            let trial = &mut self.alive[j];
            if trial.parts != Some(period) {
                continue;
            }
            let shorter = Trial {
                plan: Plan::default(),
                parts: None,
                ..*trial
            };
            trial.number += 1;
            trial.parts = Some(2 * period).filter(|k| *k < period + trial.plan.left);
            self.alive.push(shorter);
            self.seeds.extend_from_within(j * dim..(j + 1) * dim);
        }
    }

    /// Ends the plans that have come back in this period, where `left` tells the cost that is left,
    /// and those that failed or are dear already. The others are seeds of the next period.
    fn settle(&mut self, period: usize, flown: &Trajectories, left: impl Fn(usize) -> Option<f64>) {
        let Self {
            begin,
            alive,
            seeds,
            best,
        } = self;
        let (dim, cost) = (begin.dim, begin.cost);
        seeds.clear();
        let mut j = 0;
        alive.retain(|trial| {
            let (k, end) = (j, &flown.end[j * dim..][..dim]);
            j += 1;
            let best = &mut best[trial.of];
            let spent = end[cost] - begin.vector(trial.of)[cost];
            let dear = best.plan.is_some_and(|(least, _)| spent >= least);
            if flown.status[k] != Status::Reached || dear {
                return false;
            }
            let Some(left) = left(k) else {
                seeds.extend_from_slice(end);
                return true;
            };
            let whole = spent + left;
            if best.plan.is_none_or(|(least, _)| whole < least) {
                best.plan = Some((whole, trial.number));
                best.last = best.last.min(LONGER * (period + 1) + AT_LEAST);
            }
            false
        });
    }

    /// Ends the plans that are not waited for after this period.
    fn give_up(&mut self, period: usize) {
        let waited_for = |trial: &Trial| period < self.best[trial.of].last;
        if !self.alive.iter().all(waited_for) {
            let rows = self
                .alive
                .iter()
                .zip(self.seeds.chunks_exact(self.begin.dim));
            self.seeds = rows
                .filter(|(t, _)| waited_for(t))
                .flat_map(|(_, row)| row)
                .copied()
                .collect();
            self.alive.retain(waited_for);
        }
    }
}

impl Ground<'_> {
    /// Sets p of trajectories for which the chart has no answer; says of each whether it goes on.
    /// `flying`: there is an answer before that may still be held.
    pub fn fall_back(
        &self,
        help: &mut Help<'_, '_>,
        vectors: &mut [f64],
        plans: &mut [Plan],
        flying: &[bool],
    ) -> Vec<bool> {
        let dim = self.equations.dim();
        let mut helped = vec![false; flying.len()];
        match help.outside {
            Outside::Stop => return helped,
            Outside::Hold => {}
            Outside::Local => {
                for (vector, helped) in vectors.chunks_exact_mut(dim).zip(&mut helped) {
                    *helped = self.by_local(vector);
                }
            }
            Outside::Nearest | Outside::Search => {
                for ((vector, plan), helped) in
                    vectors.chunks_exact_mut(dim).zip(plans).zip(&mut helped)
                {
                    if plan.left > 0 {
                        plan.left -= 1;
                        hold(vector, &plan.p);
                        *helped = true;
                    }
                }
                self.by_nearest(help, vectors, &mut helped);
            }
        }
        helped
            .iter_mut()
            .zip(flying)
            .for_each(|(helped, flying)| *helped |= flying);
        helped
    }

    /// The law of the solution about the equilibrium, p = P s.
    fn by_local(&self, vector: &mut [f64]) -> bool {
        let n = self.equations.states;
        let Some(metric) = self.setting.local_metric() else {
            return false;
        };
        let (s, _) = self.setting.nearest(&vector[..n]);
        let hessian: Vec<f64> = (0..n * n).map(|k| metric[(k / n, k % n)]).collect();
        let p: Vec<f64> = (0..n)
            .map(|i| (0..n).map(|j| hessian[i * n + j] * s[j]).sum())
            .collect();
        set_chart(vector, &p, &hessian);
        true
    }

    /// p of the nearest state that the chart knows, of those on the way from here, moved into the
    /// chart's region, to the reference point, for the trajectories not yet helped. It is held over
    /// the period: the slope of p there may say nothing of here.
    fn by_nearest(&self, help: &mut Help<'_, '_>, vectors: &mut [f64], helped: &mut [bool]) {
        let (n, dim, reference) = (
            self.equations.states,
            self.equations.dim(),
            &self.equations.reference,
        );
        let (mut open, mut from, mut x) = (Vec::new(), Vec::new(), Vec::new());
        for (k, vector) in vectors
            .chunks_exact(dim)
            .enumerate()
            .filter(|(k, _)| !helped[*k])
        {
            let at = from.len();
            from.extend(vector[..n].iter().zip(reference).map(|(s, x)| s + x));
            if help.chart.clamp(&mut from[at..]) {
                open.push(k);
            } else {
                from.truncate(at);
            }
        }
        for share in INWARD {
            if open.is_empty() {
                return;
            }
            x.clear();
            for from in from.chunks_exact(n) {
                x.extend(from.iter().zip(reference).map(|(a, b)| a + share * (b - a)));
            }
            help.chart.slopes(n, &x, help.room);
            let room = &help.room;
            let (mut still, mut left) = (Vec::new(), Vec::new());
            for (j, (k, from)) in open.iter().zip(from.chunks_exact(n)).enumerate() {
                if room.known[j] {
                    hold(&mut vectors[k * dim..][..dim], &room.p[j * n..][..n]);
                    helped[*k] = true;
                } else {
                    still.push(*k);
                    left.extend_from_slice(from);
                }
            }
            (open, from) = (still, left);
        }
    }

    /// For each of some trajectories a way back to where the chart has answers, extrapolated with
    /// the equations themselves: p of the nearest state known, if that comes back within the
    /// periods left, or to the end of a finite horizon; else the cheapest of the plans that first
    /// hold a control at a bound of it, by its cost and V where it comes back. A period is a leg of
    /// the rest; the first one of each may be shorter.
    pub fn search(
        &self,
        help: &mut Help<'_, '_>,
        (rest, first): (Rest, &[f64]),
        vectors: &[f64],
    ) -> Result<Vec<Plan>, BackendError> {
        let (n, dim, reference) = (
            self.equations.states,
            self.equations.dim(),
            &self.equations.reference,
        );
        let count = vectors.len() / dim;
        let mut found = vec![Plan::default(); count];
        let bounded = |vector: &[f64]| {
            let mut x: Vec<f64> = vector[..n]
                .iter()
                .zip(reference)
                .map(|(s, x)| s + x)
                .collect();
            help.chart.clamp(&mut x)
        };
        let all: Vec<usize> = (0..count)
            .filter(|k| bounded(&vectors[k * dim..][..dim]))
            .collect();
        let nearest = (all.iter())
            .map(|k| Trial {
                of: *k,
                number: 0,
                plan: Plan::default(),
                parts: None,
            })
            .collect();
        let back = self.cheapest(help, (rest, first), vectors, nearest)?;
        let lost: Vec<usize> = all.into_iter().filter(|k| back[*k].is_none()).collect();
        let mut plans: Vec<Vec<Plan>> = vec![Vec::new(); count];
        let lengths =
            || std::iter::successors(Some(1usize), |k| Some(2 * k)).take_while(|k| *k < rest.legs);
        let mut trials = Vec::new();
        for k in &lost {
            for p in self.pushes(&vectors[k * dim..][..dim]) {
                if let Some(longest) = lengths().last() {
                    trials.push(Trial {
                        of: *k,
                        number: plans[*k].len(),
                        plan: Plan {
                            p: p.clone(),
                            left: longest,
                        },
                        parts: Some(1).filter(|k| *k < longest),
                    });
                }
                plans[*k].extend(lengths().map(|left| Plan { p: p.clone(), left }));
            }
        }
        let best = self.cheapest(help, (rest, first), vectors, trials)?;
        for k in lost {
            if let Some(j) = best[k] {
                found[k] = plans[k].swap_remove(j);
            }
        }
        Ok(found)
    }

    /// Which of the plans of each trajectory comes back at the least cost; `None` where none does.
    fn cheapest(
        &self,
        help: &mut Help<'_, '_>,
        (rest, first): (Rest, &[f64]),
        vectors: &[f64],
        plans: Vec<Trial>,
    ) -> Result<Vec<Option<usize>>, BackendError> {
        let (n, dim, reference) = (
            self.equations.states,
            self.equations.dim(),
            &self.equations.reference,
        );
        let begin = Begin {
            vectors,
            dim,
            cost: self.equations.cost(),
        };
        let mut trials = Trials::new(plans, begin, rest.legs);
        let (mut flown, mut x) = (Trajectories::default(), Vec::new());
        // The middle of the first period.
        let began = help.room.t;
        for period in 0..rest.legs {
            if trials.alive.is_empty() {
                break;
            }
            help.room.t = began + period as f64 * rest.length;
            trials.part(period);
            self.set_laws(help, &mut trials);
            let length = |j: usize| match period {
                0 => first[trials.alive[j].of],
                _ => rest.length,
            };
            help.wings.fly((&trials.seeds, dim), length, &mut flown)?;
            x.clear();
            for end in flown.end.chunks_exact(dim) {
                x.extend(end[..n].iter().zip(reference).map(|(s, x)| s + x));
            }
            // What is left of the cost, at the end of the period.
            help.room.t += 0.5 * rest.length;
            help.chart.slopes(n, &x, help.room);
            let room = &help.room;
            // At the end of a finite horizon nothing is to come back to.
            let terminal = (self.terminal.as_ref().filter(|_| period + 1 == rest.legs))
                .map(|t| t.eval(&flown.end, dim));
            let left = |k: usize| match &terminal {
                Some(terminal) => Some(terminal[k]),
                None => room.known[k].then(|| room.v[k]),
            };
            trials.settle(period, &flown, left);
            trials.give_up(period);
        }
        help.room.t = began;
        let best = trials.best.into_iter();
        Ok(best.map(|b| b.plan.map(|(_, k)| k)).collect())
    }

    /// Sets p of all plans on trial for their next period.
    fn set_laws(&self, help: &mut Help<'_, '_>, trials: &mut Trials<'_>) {
        let alive = &mut trials.alive;
        let mut plans: Vec<Plan> = alive
            .iter_mut()
            .map(|t| std::mem::take(&mut t.plan))
            .collect();
        let flying = vec![true; alive.len()];
        self.fall_back(help, &mut trials.seeds, &mut plans, &flying);
        alive
            .iter_mut()
            .zip(plans)
            .for_each(|(t, plan)| t.plan = plan);
    }

    /// Values of p under which one control after the other is at a bound of it, upper or lower.
    fn pushes(&self, vector: &[f64]) -> Vec<Vec<f64>> {
        /// Far beyond any bound, in units of what controls are without one.
        const FAR: f64 = 1e6;
        let (n, dim) = (self.equations.states, vector.len());
        let columns = self.equations.control_columns();
        let width = self.observer_width();
        let controls = |all: &[Vec<f64>]| -> Vec<Vec<f64>> {
            let rows: Vec<f64> = (all.iter())
                .flat_map(|p| {
                    let mut row = vector.to_vec();
                    hold(&mut row, p);
                    row
                })
                .collect();
            let seen = self.observer.eval(&rows, dim);
            seen.chunks_exact(width)
                .map(|row| row[columns.clone()].to_vec())
                .collect()
        };
        // How u depends on p about p = 0.
        let steps: Vec<f64> = (self.setting.widths.iter())
            .map(|w| 1e-6 * self.setting.value_scale / w)
            .collect();
        let mut places = vec![vec![0.0; n]; n + 1];
        (0..n).for_each(|i| places[i + 1][i] = steps[i]);
        let u = controls(&places);
        let mut pushes = Vec::new();
        for k in 0..columns.len() {
            let slope: Vec<f64> = (0..n).map(|i| (u[i + 1][k] - u[0][k]) / steps[i]).collect();
            let square: f64 = slope.iter().map(|c| c * c).sum();
            if square <= 0.0 || !square.is_finite() {
                continue;
            }
            for sign in [1.0, -1.0] {
                let far = |by: f64| -> Vec<f64> {
                    let scale = sign * by * (1.0 + u[0][k].abs()) / square;
                    slope.iter().map(|c| scale * c).collect()
                };
                // Without a bound u goes on with p.
                let at = controls(&[far(FAR), far(2.0 * FAR)]);
                if at[0][k] == at[1][k] {
                    pushes.push(far(FAR));
                }
            }
        }
        pushes
    }
}

/// p as it is at the state, held: without the slopes of the model `q + H s`.
pub(super) fn hold_here(vector: &mut [f64], n: usize) {
    let mut p = vector[n..2 * n].to_vec();
    let mut place = 2 * n;
    for i in 0..n {
        for j in i..n {
            p[i] += vector[place] * vector[j];
            if j != i {
                p[j] += vector[place] * vector[i];
            }
            place += 1;
        }
    }
    hold(vector, &p);
}

/// p that does not depend on the state.
fn hold(vector: &mut [f64], p: &[f64]) {
    let n = p.len();
    let triangle = n * (n + 1) / 2;
    vector[n..2 * n].copy_from_slice(p);
    vector[2 * n..2 * n + triangle].fill(0.0);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_held_is_p_at_the_state() {
        let (p, hessian) = ([0.3, -1.2], [2.0, 0.5, 0.5, 7.0]);
        // s, q, H's upper triangle, J.
        let mut vector = [0.7, -0.4, 0.0, 0.0, 0.0, 0.0, 0.0, 5.0];
        set_chart(&mut vector, &p, &hessian);
        hold_here(&mut vector, 2);
        assert!((0..2).all(|i| (vector[2 + i] - p[i]).abs() < 1e-15));
        assert_eq!(vector[4..], [0.0, 0.0, 0.0, 5.0]);
    }
}
