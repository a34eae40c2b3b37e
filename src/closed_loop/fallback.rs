//! What the law of a chart does where the chart has no answer.

use super::charted::Wings;
use super::equations::set_chart;
use super::simulate::Ground;
use super::{Chart, Expansions};
use crate::backend::{BackendError, Run, Status, Trajectories};
use crate::model::Outside;

/// Ways from a state without an answer towards the reference point at which the chart is asked.
const INWARD: [f64; 7] = [0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7];
/// A search goes on for this many times the periods after which the first plan has come back, and these more.
const LONGER: usize = 4;
const AT_LEAST: usize = 4;

/// p that is held for some periods; then that of the nearest state known.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    p: Vec<f64>,
    left: usize,
}

impl Ground<'_> {
    /// Sets p where the chart has no answer; false where the trajectory is to end. `flying`: there is an answer before
    /// that may still be held.
    pub fn fall_back(
        &self,
        outside: Outside,
        chart: &dyn Chart,
        vector: &mut [f64],
        plan: Option<&mut Plan>,
        flying: bool,
        room: &mut Expansions,
    ) -> bool {
        match outside {
            Outside::Stop => false,
            Outside::Hold => flying,
            Outside::Local => self.by_local(vector) || flying,
            Outside::Nearest => self.by_nearest(chart, vector, room) || flying,
            Outside::Search => match plan.filter(|plan| plan.left > 0) {
                Some(plan) => {
                    plan.left -= 1;
                    hold(vector, &plan.p);
                    true
                }
                None => self.by_nearest(chart, vector, room) || flying,
            },
        }
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

    /// p of the nearest state that the chart knows, of those on the way from here, moved into the chart's region, to the
    /// reference point. It is held over the period: the slope of p there may say nothing of here.
    fn by_nearest(&self, chart: &dyn Chart, vector: &mut [f64], room: &mut Expansions) -> bool {
        let n = self.equations.states;
        let reference = &self.equations.reference;
        let mut from: Vec<f64> = vector[..n].iter().zip(reference).map(|(s, x)| s + x).collect();
        if !chart.clamp(&mut from) {
            return false;
        }
        for share in INWARD {
            let x: Vec<f64> = from.iter().zip(reference).map(|(a, b)| a + share * (b - a)).collect();
            chart.expansions(n, &x, room);
            if room.known[0] {
                hold(vector, &room.p[..n]);
                return true;
            }
        }
        false
    }

    /// A way back to where the chart has answers within a number of periods of a length, foretold with the equations themselves: p of the nearest state known, if that
    /// comes back within the periods left; else the cheapest of the plans that first hold a control at a bound of it, by its
    /// cost and V where it comes back.
    pub fn search(
        &self,
        wings: &mut Wings<'_>,
        run: &Run,
        periods: (usize, f64),
        chart: &dyn Chart,
        vector: &[f64],
        room: &mut Expansions,
    ) -> Result<Plan, BackendError> {
        let nearest = Plan { p: Vec::new(), left: 0 };
        let mut x: Vec<f64> = (vector.iter().zip(&self.equations.reference))
            .map(|(s, x)| s + x)
            .collect();
        if !chart.clamp(&mut x) {
            return Ok(nearest);
        }
        let first = std::slice::from_ref(&nearest);
        if self
            .cheapest(wings, run, periods, chart, vector, first, room)?
            .is_some()
        {
            return Ok(nearest);
        }
        let mut plans = Vec::new();
        for p in self.pushes(vector) {
            let lengths = std::iter::successors(Some(1usize), |k| Some(2 * k)).take_while(|k| *k < periods.0);
            plans.extend(lengths.map(|left| Plan { p: p.clone(), left }));
        }
        let best = self.cheapest(wings, run, periods, chart, vector, &plans, room)?;
        Ok(best.map_or(nearest, |k| plans.swap_remove(k)))
    }

    /// Which of some plans comes back at the least cost; `None` where none does.
    #[allow(clippy::too_many_arguments)]
    fn cheapest(
        &self,
        wings: &mut Wings<'_>,
        run: &Run,
        (periods, period_length): (usize, f64),
        chart: &dyn Chart,
        vector: &[f64],
        plans: &[Plan],
        room: &mut Expansions,
    ) -> Result<Option<usize>, BackendError> {
        let (n, dim, reference) = (self.equations.states, vector.len(), &self.equations.reference);
        let spent = vector[self.equations.cost()];
        let mut alive: Vec<(usize, Plan)> = plans.iter().cloned().enumerate().collect();
        let mut seeds: Vec<f64> = plans.iter().flat_map(|_| vector).copied().collect();
        let mut best: Option<(f64, usize)> = None;
        let mut last = periods;
        let mut flown = Trajectories::default();
        let began = room.t;
        for period in 0..periods {
            if alive.is_empty() || period > last {
                break;
            }
            room.t = began + period as f64 * period_length;
            for ((_, plan), vector) in alive.iter_mut().zip(seeds.chunks_exact_mut(dim)) {
                self.fall_back(Outside::Search, chart, vector, Some(plan), true, room);
            }
            wings.fly(run, &seeds, &mut flown)?;
            let x: Vec<f64> = (flown.end.chunks_exact(dim))
                .flat_map(|end| end[..n].iter().zip(reference).map(|(s, x)| s + x))
                .collect();
            // What is left of the cost, at the end of the period; `began` is the middle of the first.
            room.t += 0.5 * period_length;
            chart.expansions(n, &x, room);
            seeds.clear();
            let mut going = Vec::with_capacity(alive.len());
            for (j, (k, plan)) in alive.into_iter().enumerate() {
                let end = &flown.end[j * dim..][..dim];
                let cost = end[self.equations.cost()] - spent;
                if flown.status[j] != Status::Reached || best.is_some_and(|(least, _)| cost >= least) {
                    continue;
                }
                if !room.known[j] {
                    seeds.extend_from_slice(end);
                    going.push((k, plan));
                } else if best.is_none_or(|(least, _)| cost + room.v[j] < least) {
                    best = Some((cost + room.v[j], k));
                    last = last.min(LONGER * (period + 1) + AT_LEAST);
                }
            }
            alive = going;
        }
        room.t = began;
        Ok(best.map(|(_, k)| k))
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
