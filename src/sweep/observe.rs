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

    /// Observes some trajectories of a batch, those from `first` on, on the calling thread.
    pub fn strip(
        &self,
        plan: &Plan,
        batch: &Trajectories,
        first: usize,
        to: &mut Strip<'_>,
        scratch: &mut Scratch,
    ) {
        let count = to.status.len();
        let (levels, dim) = (batch.levels, batch.dim);
        let width = self.controls + self.disturbances + 2;
        let samples = &batch.samples[first * levels * (1 + dim)..][..count * levels * (1 + dim)];
        let ends = &batch.end[first * dim..][..count * dim];
        scratch.values.resize(count * levels * width, 0.0);
        scratch.ends.resize(count * width, 0.0);
        if levels > 0 {
            (self.evaluator).fill(&samples[1..], 1 + dim, &mut scratch.values);
        }
        self.evaluator.fill(ends, dim, &mut scratch.ends);
        for i in 0..count {
            to.status[i] = self.status(plan, batch, first + i);
            let seen = One {
                samples: &samples[i * levels * (1 + dim)..][..levels * (1 + dim)],
                values: &scratch.values[i * levels * width..][..levels * width],
                end: &scratch.ends[i * width..][..width],
            };
            let (drift, scale) = self.drift(plan, &seen, levels);
            to.drift[i] = drift;
            to.relative[i] = drift / scale;
            if let Some(columns) = &mut to.columns {
                self.write(plan, &seen, dim, i, columns);
            }
        }
    }

    /// The largest change of H along a trajectory, and its largest running cost.
    fn drift(&self, plan: &Plan, seen: &One<'_>, levels: usize) -> (f64, f64) {
        let (h, width) = (self.controls + self.disturbances, seen.end.len());
        // On an infinite horizon H is 0 on the manifold; on a finite one it keeps the value it has
        // at the end.
        let reference = match plan.sampling {
            Sampling::Time if levels > 0 => seen.values[h],
            _ => 0.0,
        };
        let mut drift = (seen.end[h] - reference).abs();
        let mut scale = seen.end[h + 1].abs();
        for row in seen.values.chunks_exact(width).skip(plan.inner) {
            if !row[h].is_nan() {
                drift = drift.max((row[h] - reference).abs());
                scale = scale.max(row[h + 1].abs());
            }
        }
        (drift, scale)
    }

    /// Writes the samples of a trajectory, the `i`-th of its strip, in order of rising t.
    fn write(&self, plan: &Plan, seen: &One<'_>, dim: usize, i: usize, to: &mut Columns<'_>) {
        let (n, m, k) = (plan.system.states, self.controls, self.disturbances);
        let levels = plan.samples();
        let end_time = plan.system.terminal.as_ref().map_or(0.0, |t| t.time);
        let rows = (seen.samples.chunks_exact(1 + dim).rev())
            .zip(seen.values.chunks_exact(seen.end.len()).rev());
        for (at, (sample, values)) in (i * levels..(i + 1) * levels).zip(rows) {
            to.t[at] = end_time - sample[0];
            to.v[at] = sample[1 + 2 * n];
            to.h[at] = values[m + k];
            let (x, p) = (&mut to.x[at * n..][..n], &mut to.p[at * n..][..n]);
            for c in 0..n {
                x[c] = sample[1 + c] + plan.system.reference[c];
                p[c] = sample[1 + n + c];
            }
            to.u[at * m..][..m].copy_from_slice(&values[..m]);
            to.w[at * k..][..k].copy_from_slice(&values[m..m + k]);
        }
    }

    /// Makes a block fit a batch: all of it that is not written by strips.
    pub fn prepare(&self, plan: &Plan, batch: &Trajectories, block: &mut TrajectoryBlock) {
        let (n, count) = (plan.system.states, batch.count());
        let total = count * plan.samples();
        block.count = count;
        for (column, width) in [
            (&mut block.t, 1),
            (&mut block.x, n),
            (&mut block.p, n),
            (&mut block.u, self.controls),
            (&mut block.w, self.disturbances),
            (&mut block.v, 1),
            (&mut block.h, 1),
        ] {
            column.resize(total * width, 0.0);
        }
        let numbers = |from: &[u32], to: &mut Vec<i32>| {
            to.clear();
            to.extend(from.iter().map(|s| *s as i32));
        };
        numbers(&batch.steps, &mut block.steps);
        numbers(&batch.rejected, &mut block.rejected);
        block.sheet.clear();
        block.sheet.resize(count, NO_SHEET);
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

    /// The status code of a trajectory; a guard's own where one ended it. Where the equations end
    /// with a guard (a root of what the guard keeps positive) no step gets beyond it, and the
    /// trajectory stops at the boundary for want of a finite step: that is the guard's doing too.
    fn status(&self, plan: &Plan, batch: &Trajectories, i: usize) -> i32 {
        let status = batch.status[i];
        let stopped = matches!(status, Status::NotFinite | Status::StepFloor);
        if status != Status::Guard && !stopped {
            return status as i32;
        }
        if plan.is_folded(&batch.end[i * batch.dim..][..batch.dim]) {
            return FOLD_STATUS;
        }
        if let Some(guards) = &self.guards {
            let (guard, share) = nearest_guard(guards, batch, i);
            if status == Status::Guard || share <= AT_GUARD {
                return GUARD_STATUS + guard as i32;
            }
        }
        status as i32
    }
}

/// Where what is told of consecutive trajectories goes.
pub struct Strip<'b> {
    /// `[trajectory]`, as the rest.
    pub status: &'b mut [i32],
    pub drift: &'b mut [f64],
    /// The drift relative to the largest running cost.
    pub relative: &'b mut [f64],
    /// Their samples, where they are wanted.
    pub columns: Option<Columns<'b>>,
}

/// Columns of a [`TrajectoryBlock`], of some of its trajectories.
pub struct Columns<'b> {
    t: &'b mut [f64],
    x: &'b mut [f64],
    p: &'b mut [f64],
    u: &'b mut [f64],
    w: &'b mut [f64],
    v: &'b mut [f64],
    h: &'b mut [f64],
}

/// Memory that strips are observed in.
#[derive(Default)]
pub struct Scratch {
    values: Vec<f64>,
    ends: Vec<f64>,
}

/// One trajectory as it is observed.
struct One<'o> {
    samples: &'o [f64],
    /// `[level][u, w, H, L]`.
    values: &'o [f64],
    /// The same at its end.
    end: &'o [f64],
}

/// The columns of a block, cut for strips of so many trajectories each.
pub fn columns(
    block: &mut TrajectoryBlock,
    trajectories: usize,
) -> impl Iterator<Item = Columns<'_>> {
    let count = block.count.max(1);
    fn cut<'c>(
        column: &'c mut [f64],
        count: usize,
        trajectories: usize,
    ) -> impl FnMut() -> &'c mut [f64] {
        let mut parts = column.chunks_mut((column.len() / count * trajectories).max(1));
        move || parts.next().unwrap_or_default()
    }
    let strips = block.count.div_ceil(trajectories);
    let mut t = cut(&mut block.t, count, trajectories);
    let mut x = cut(&mut block.x, count, trajectories);
    let mut p = cut(&mut block.p, count, trajectories);
    let mut u = cut(&mut block.u, count, trajectories);
    let mut w = cut(&mut block.w, count, trajectories);
    let mut v = cut(&mut block.v, count, trajectories);
    let mut h = cut(&mut block.h, count, trajectories);
    (0..strips).map(move |_| Columns {
        t: t(),
        x: x(),
        p: p(),
        u: u(),
        w: w(),
        v: v(),
        h: h(),
    })
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
