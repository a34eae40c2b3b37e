//! From a backend's samples to what is stored: x, t as they happen, u, w, H.

use super::caustic::{FoldPoint, Folds};
use super::plan::{AT_GUARD, FOLD_STATUS, GUARD_STATUS, Plan, Sampling};
use crate::backend::cpu::Evaluator;
use crate::backend::{Status, Trajectories};
use crate::program::Program;
use crate::trajectories::TrajectoryBlock;

/// Sheets are labelled when sheets are computed; a sweep leaves them open.
pub const NO_SHEET: i32 = -1;

/// Computes the reported quantities of a batch, in f64 from the stored states and adjoints.
pub struct Observed {
    evaluator: Evaluator,
    guards: Option<Evaluator>,
    folds: Option<Folds>,
    controls: usize,
    disturbances: usize,
}

impl Observed {
    pub fn new(plan: &Plan) -> Self {
        let o = &plan.system.observer;
        let running = plan.system.rate[2 * plan.system.states];
        let roots: Vec<_> = o
            .control
            .iter()
            .chain(&o.disturbance)
            .copied()
            .chain([o.hamiltonian, running])
            .collect();
        let program = Program::lower(&plan.system.graph, &plan.system.inputs, &roots);
        let guards: Vec<_> = plan.system.guards.iter().map(|g| g.expr).collect();
        let guards = (!guards.is_empty()).then(|| {
            Evaluator::new(&Program::lower(
                &plan.system.graph,
                &plan.system.inputs,
                &guards,
            ))
        });
        Self {
            evaluator: Evaluator::new(&program),
            guards,
            folds: Folds::new(plan),
            controls: o.control.len(),
            disturbances: o.disturbance.len(),
        }
    }

    /// The block to store, samples in order of rising t; and each trajectory's drift of H relative
    /// to its largest running cost.
    pub fn block(&self, plan: &Plan, batch: &Trajectories) -> (TrajectoryBlock, Vec<f64>) {
        let n = plan.system.states;
        let (count, levels, stride) = (batch.count(), batch.levels, 1 + batch.dim);
        let (m, k) = (self.controls, self.disturbances);
        let width = m + k + 2;
        let mut relative = Vec::with_capacity(count);
        let values = if levels == 0 {
            Vec::new()
        } else {
            self.evaluator.eval(&batch.samples[1..], stride)
        };
        let ends = self.evaluator.eval(&batch.end, batch.dim);
        let total = count * plan.samples();
        let mut block = TrajectoryBlock {
            count,
            t: Vec::with_capacity(total),
            x: Vec::with_capacity(total * n),
            p: Vec::with_capacity(total * n),
            u: Vec::with_capacity(total * m),
            w: Vec::with_capacity(total * k),
            v: Vec::with_capacity(total),
            h: Vec::with_capacity(total),
            status: self.statuses(plan, batch),
            sheet: vec![NO_SHEET; count],
            steps: batch.steps.iter().map(|s| *s as i32).collect(),
            rejected: batch.rejected.iter().map(|s| *s as i32).collect(),
            hamiltonian_drift: Vec::with_capacity(count),
        };
        let end_time = plan.system.terminal.as_ref().map_or(0.0, |t| t.time);
        for i in 0..count {
            let hamiltonian = |level: usize| values[(i * levels + level) * width + m + k];
            // On an infinite horizon H is 0 on the manifold; on a finite one it keeps the value it
            // has at the end.
            let reference = match plan.sampling {
                Sampling::Time if levels > 0 => hamiltonian(0),
                _ => 0.0,
            };
            let mut drift = (ends[i * width + m + k] - reference).abs();
            let mut scale = ends[i * width + m + k + 1].abs();
            for level in (plan.inner..levels).rev() {
                let sample = batch.sample(i, level);
                let row = &values[(i * levels + level) * width..][..width];
                let h = row[m + k];
                block.t.push(end_time - sample[0]);
                block.x.extend(
                    sample[1..=n]
                        .iter()
                        .zip(&plan.system.reference)
                        .map(|(s, x)| s + x),
                );
                block.p.extend_from_slice(&sample[1 + n..=2 * n]);
                block.v.push(sample[1 + 2 * n]);
                block.u.extend_from_slice(&row[..m]);
                block.w.extend_from_slice(&row[m..m + k]);
                block.h.push(h);
                if !h.is_nan() {
                    drift = drift.max((h - reference).abs());
                    scale = scale.max(row[m + k + 1].abs());
                }
            }
            block.hamiltonian_drift.push(drift);
            relative.push(drift / scale);
        }
        (block, relative)
    }

    /// The folds in which trajectories of a batch have ended, `status` being those of its block and
    /// `first` the index of its first trajectory.
    pub fn folds(
        &self,
        plan: &Plan,
        batch: &Trajectories,
        status: &[i32],
        first: usize,
    ) -> Vec<FoldPoint> {
        let Some(folds) = &self.folds else {
            return Vec::new();
        };
        (0..batch.count())
            .filter(|i| status[*i] == FOLD_STATUS)
            .filter_map(|i| folds.ahead(plan, batch, i, first + i))
            .collect()
    }

    /// Status codes; a guard's own where one ended the trajectory. Where the equations end with a
    /// guard (a root of what the guard keeps positive) no step gets beyond it, and the trajectory
    /// stops at the boundary for want of a finite step: that is the guard's doing too.
    fn statuses(&self, plan: &Plan, batch: &Trajectories) -> Vec<i32> {
        let stopped = |s: Status| matches!(s, Status::NotFinite | Status::StepFloor);
        let code = |i: usize, s: Status| match &self.guards {
            Some(guards) if s == Status::Guard || stopped(s) => {
                let (guard, share) = nearest_guard(guards, batch, i);
                if s == Status::Guard || share <= AT_GUARD {
                    GUARD_STATUS + guard as i32
                } else {
                    s as i32
                }
            }
            _ => s as i32,
        };
        let ended = |i: usize, s: Status| {
            let at = &batch.end[i * batch.dim..][..batch.dim];
            if (s == Status::Guard || stopped(s)) && plan.is_folded(at) {
                FOLD_STATUS
            } else {
                code(i, s)
            }
        };
        batch
            .status
            .iter()
            .enumerate()
            .map(|(i, s)| ended(i, *s))
            .collect()
    }
}

/// The guard that a trajectory has come nearest to at its end, by its value's share of the largest
/// along the trajectory (one that is 0 all along, an invariant boundary, is not met); with that
/// share. Of a trajectory without samples nothing is known but the end: the nearest value, and no
/// share.
fn nearest_guard(guards: &Evaluator, batch: &Trajectories, i: usize) -> (usize, f64) {
    let stride = 1 + batch.dim;
    let end = guards.eval(&batch.end[i * batch.dim..][..batch.dim], batch.dim);
    let passed: Vec<f64> = (0..batch.levels)
        .map(|k| batch.sample(i, k))
        .take_while(|s| !s[0].is_nan())
        .flatten()
        .copied()
        .collect();
    let least = |values: &dyn Fn(usize) -> f64| {
        (0..end.len())
            .map(|k| (k, values(k)))
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .unwrap_or((0, f64::INFINITY))
    };
    if passed.is_empty() {
        return (least(&|k| end[k].abs()).0, f64::INFINITY);
    }
    let along = guards.eval(&passed[1..], stride);
    least(&|k| {
        let largest = (along.iter().skip(k).step_by(end.len())).fold(0.0f64, |a, v| a.max(v.abs()));
        if largest > 0.0 {
            end[k].abs() / largest
        } else {
            f64::INFINITY
        }
    })
}
