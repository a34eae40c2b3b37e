//! The iteration on the CPU: blocks of nodes in parallel, the scene's equations in vectors of
//! lanes. A node's result depends on the values before the call alone, so results do not depend on
//! blocks or threads.

use super::equations::Equations;
use super::lattice::{Lattice, by_states, interpolate, slope};
use super::level::{Candidate, Iteration, Level, last, middle, whole};
use crate::backend::BackendError;
use crate::backend::cpu::Evaluator;
use rayon::prelude::*;

/// Nodes of a block: one task of the evaluator.
const BLOCK: usize = 1024;

/// Best steps, one a node.
#[derive(Clone, Debug)]
struct Steps {
    /// `[node][m]`.
    control: Vec<f64>,
    /// `[node][n]`: where the step ends.
    foot: Vec<f64>,
    /// What the step costs itself; the level's ceiling where there is none.
    cost: Vec<f64>,
    /// With the value at its end.
    total: Vec<f64>,
}

impl Steps {
    fn new(nodes: usize, n: usize, m: usize, ceiling: f64) -> Self {
        Self {
            control: vec![0.0; nodes * m],
            foot: vec![0.0; nodes * n],
            cost: vec![ceiling; nodes],
            total: vec![ceiling; nodes],
        }
    }
}

pub(super) struct CpuIteration<'a> {
    level: &'a Level,
    equations: &'a Equations,
    motion: Evaluator,
    law: Evaluator,
    values: Vec<f64>,
    steps: Steps,
}

impl<'a> CpuIteration<'a> {
    pub fn new(level: &'a Level, equations: &'a Equations) -> Self {
        let nodes = level.lattice.len();
        let steps = Steps::new(nodes, equations.states, equations.controls, level.ceiling);
        Self {
            level,
            equations,
            motion: Evaluator::new(&equations.motion),
            law: Evaluator::new(&equations.law),
            values: vec![level.ceiling; nodes],
            steps,
        }
    }

    /// The steps under the controls `u` of the nodes from `first` on.
    fn fly(&self, first: usize, u: &[f64], to: &mut Steps) {
        let (equations, level) = (self.equations, self.level);
        let (n, m, width) = (equations.states, equations.controls, equations.width());
        let count = to.cost.len();
        let start = &level.points[first * n..][..count * n];
        let mut points = vec![0.0; count * (n + m)];
        for i in 0..count {
            points[i * (n + m)..][..n].copy_from_slice(&start[i * n..][..n]);
            points[i * (n + m) + n..][..m].copy_from_slice(&u[i * m..][..m]);
        }
        let k1 = self.motion.eval(&points, n + m);
        let times: Vec<f64> = (0..count)
            .map(|i| level.stride.duration(&level.lattice, &k1[i * width..][..n]))
            .collect();
        for i in 0..count {
            let s = &start[i * n..][..n];
            middle(
                s,
                &k1[i * width..],
                times[i],
                &mut points[i * (n + m)..][..n],
            );
        }
        let k2 = self.motion.eval(&points, n + m);
        for i in 0..count {
            let (s, to) = (&start[i * n..][..n], &mut points[i * (n + m)..][..n]);
            last(s, &k1[i * width..], &k2[i * width..], times[i], to);
        }
        let k3 = self.motion.eval(&points, n + m);
        to.control.copy_from_slice(u);
        for i in 0..count {
            let rows = [
                &k1[i * width..][..width],
                &k2[i * width..][..width],
                &k3[i * width..][..width],
            ];
            // The third row's point lies off the path, and its guards say nothing.
            let valid = rows[..2].iter().all(|r| equations.is_valid(r))
                && rows[2][..=n].iter().all(|x| x.is_finite());
            let step = |c: usize| whole(rows[0][c], rows[1][c], rows[2][c], times[i]);
            for c in 0..n {
                to.foot[i * n + c] = if valid {
                    start[i * n + c] + step(c)
                } else {
                    f64::NAN
                };
            }
            to.cost[i] = if valid { step(n) } else { level.ceiling };
        }
    }

    /// The controls of a candidate for the nodes from `first` on.
    fn propose<const N: usize>(
        &self,
        candidate: &Candidate,
        first: usize,
        present: &Steps,
        best: &Steps,
    ) -> Vec<f64> {
        let (level, m) = (self.level, self.equations.controls);
        let count = best.cost.len();
        match candidate {
            Candidate::Present => self.steps.control[first * m..][..count * m].to_vec(),
            Candidate::Linear => match &level.linear {
                Some(linear) => linear[first * m..][..count * m].to_vec(),
                None => best.control.clone(),
            },
            Candidate::Neighbour { axis, forward } => (first..first + count)
                .flat_map(|k| {
                    &self.steps.control[level.lattice.neighbour(k, *axis, *forward) * m..][..m]
                })
                .copied()
                .collect(),
            Candidate::Spread(k) => level.spread[*k].repeat(count),
            Candidate::Moved { control, by } => {
                let mut u = best.control.clone();
                for u in u.chunks_mut(m) {
                    u[*control] += by;
                    self.equations.bounded(u);
                }
                u
            }
            Candidate::Costate(share) => self.by_costate::<N>(*share, first, present),
        }
    }

    /// `u*(s, p)` with the gradient at a share of the present step.
    fn by_costate<const N: usize>(&self, share: f64, first: usize, present: &Steps) -> Vec<f64> {
        let (level, n) = (self.level, N);
        let count = present.cost.len();
        let mut points = vec![0.0; count * 2 * n];
        for i in 0..count {
            let s = &level.points[(first + i) * n..][..n];
            let foot = &present.foot[i * n..][..n];
            let (state, costate) = points[i * 2 * n..][..2 * n].split_at_mut(n);
            state.copy_from_slice(s);
            let mut place = [0.0; N];
            for c in 0..n {
                place[c] = s[c] + share * (foot[c] - s[c]);
            }
            if let Some(cell) = level.lattice.locate::<N>(&place) {
                costate.copy_from_slice(&slope(
                    &level.lattice,
                    &self.values,
                    &cell,
                    level.bent_below,
                ));
            }
        }
        self.law.eval(&points, 2 * n)
    }

    /// What steps cost with the values where they end.
    fn totals<const N: usize>(&self, steps: &mut Steps) {
        let (level, ceiling) = (self.level, self.level.ceiling);
        for (i, total) in steps.total.iter_mut().enumerate() {
            let cost = steps.cost[i];
            *total =
                total_of::<N>(level, &self.values, &steps.foot[i * N..][..N], cost).min(ceiling);
        }
    }

    /// The best steps of the nodes from `first` on.
    fn block<const N: usize>(&self, first: usize, count: usize, candidates: &[Candidate]) -> Steps {
        let (n, m) = (N, self.equations.controls);
        let fresh = || Steps::new(count, n, m, self.level.ceiling);
        let (mut best, mut present, mut trial) = (fresh(), fresh(), fresh());
        for candidate in candidates {
            let mut u = self.propose::<N>(candidate, first, &present, &best);
            for u in u.chunks_mut(m.max(1)) {
                self.equations.bounded(u);
            }
            self.fly(first, &u, &mut trial);
            self.totals::<N>(&mut trial);
            if *candidate == Candidate::Present {
                present.clone_from(&trial);
                best.clone_from(&trial);
                continue;
            }
            for i in 0..count {
                if trial.total[i] < best.total[i] {
                    best.total[i] = trial.total[i];
                    best.cost[i] = trial.cost[i];
                    best.foot[i * n..][..n].copy_from_slice(&trial.foot[i * n..][..n]);
                    best.control[i * m..][..m].copy_from_slice(&trial.control[i * m..][..m]);
                }
            }
        }
        best
    }

    fn every_block<const N: usize>(&self, candidates: &[Candidate]) -> Vec<Steps> {
        let nodes = self.level.lattice.len();
        (0..nodes.div_ceil(BLOCK))
            .into_par_iter()
            .map(|b| self.block::<N>(b * BLOCK, BLOCK.min(nodes - b * BLOCK), candidates))
            .collect()
    }

    /// The values after one evaluation of the policy.
    fn evaluated<const N: usize>(&self) -> Vec<f64> {
        let (level, ceiling) = (self.level, self.level.ceiling);
        let mut next = self.values.clone();
        next.par_chunks_mut(BLOCK)
            .enumerate()
            .for_each(|(b, chunk)| {
                for (j, value) in chunk.iter_mut().enumerate() {
                    let k = b * BLOCK + j;
                    if !level.known[k] {
                        let foot = &self.steps.foot[k * N..][..N];
                        *value = total_of::<N>(level, &self.values, foot, self.steps.cost[k])
                            .min(ceiling);
                    }
                }
            });
        next
    }
}

/// A step's cost with the value at its end.
#[inline]
fn total_of<const N: usize>(level: &Level, values: &[f64], foot: &[f64], cost: f64) -> f64 {
    let end = (level.lattice.locate::<N>(foot)).map_or(level.ceiling, |cell| {
        interpolate(values, &cell, level.bent_below)
    });
    cost + end
}

fn every_block<const N: usize>(
    iteration: &CpuIteration<'_>,
    candidates: &[Candidate],
) -> Vec<Steps> {
    iteration.every_block::<N>(candidates)
}

fn evaluated<const N: usize>(iteration: &CpuIteration<'_>) -> Vec<f64> {
    iteration.evaluated::<N>()
}

impl Iteration for CpuIteration<'_> {
    fn load(&mut self, values: &[f64], controls: &[f64]) -> Result<(), BackendError> {
        self.values.copy_from_slice(values);
        self.steps.control.copy_from_slice(controls);
        Ok(())
    }

    fn improve(&mut self, candidates: &[Candidate]) -> Result<(), BackendError> {
        let blocks = by_states!(self.level.lattice.states(), every_block(self, candidates));
        let (n, m) = (self.equations.states, self.equations.controls);
        for (b, block) in blocks.into_iter().enumerate() {
            let (first, count) = (b * BLOCK, block.cost.len());
            self.steps.control[first * m..][..count * m].copy_from_slice(&block.control);
            self.steps.foot[first * n..][..count * n].copy_from_slice(&block.foot);
            self.steps.cost[first..][..count].copy_from_slice(&block.cost);
            self.steps.total[first..][..count].copy_from_slice(&block.total);
        }
        Ok(())
    }

    fn accept(&mut self) -> Result<(), BackendError> {
        for (k, value) in self.values.iter_mut().enumerate() {
            if !self.level.known[k] {
                *value = self.steps.total[k];
            }
        }
        Ok(())
    }

    fn evaluate(&mut self, times: usize) -> Result<(), BackendError> {
        for _ in 0..times {
            self.values = by_states!(self.level.lattice.states(), evaluated(self));
        }
        Ok(())
    }

    fn values(&self) -> Result<Vec<f64>, BackendError> {
        Ok(self.values.clone())
    }

    fn controls(&self) -> Result<Vec<f64>, BackendError> {
        Ok(self.steps.control.clone())
    }
}

/// Points `[point][n]` of all nodes.
pub(super) fn points(lattice: &Lattice) -> Vec<f64> {
    (0..lattice.len()).flat_map(|k| lattice.node(k)).collect()
}
