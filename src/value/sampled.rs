//! The trajectories of solutions, sampled.

use super::solve::Entry;
use crate::backend::BackendError;
use crate::program::Program;
use crate::shooting::{Path, Solver};
use crate::sweep::Plan;
use crate::trajectories::TrajectoryBlock;

/// Status of a sampled solution, that of a trajectory which has reached its end.
const REACHED: i32 = crate::backend::Status::Reached as i32;

/// Solutions at `samples` times each, from the target to the end of the horizon, evenly spaced. On
/// an infinite horizon t = 0 is where the trajectory comes so near the equilibrium that the local
/// solution takes over.
///
/// # Errors
/// Device failures only.
pub fn sampled(
    plan: &Plan,
    solver: &mut Solver,
    entries: &[&Entry],
    samples: usize,
) -> Result<TrajectoryBlock, BackendError> {
    let observer = &plan.system.observer;
    let (n, m, k) = (
        plan.system.states,
        observer.control.len(),
        observer.disturbance.len(),
    );
    let roots = [
        observer.control.as_slice(),
        &observer.disturbance,
        &[observer.hamiltonian],
    ]
    .concat();
    let program = Program::lower(&plan.system.graph, &plan.system.inputs, &roots);
    let evaluator = crate::backend::cpu::Evaluator::new(&program);
    let mut block = TrajectoryBlock {
        count: entries.len(),
        ..TrajectoryBlock::default()
    };
    for entry in entries {
        let path = &entry.path;
        let places = Places::along(path, samples);
        let (points, costs) = solver.ends(&places.pieces)?;
        let cost_before = sums_before(&solver.ends(path)?.1);
        let values = evaluator.eval(&points, 2 * n);
        let width = m + k + 1;
        for q in 0..samples {
            let z = &points[q * 2 * n..][..2 * n];
            let row = &values[q * width..][..width];
            block.t.push(places.times[q]);
            block.x.extend(
                z[..n]
                    .iter()
                    .zip(&plan.system.reference)
                    .map(|(s, x)| s + x),
            );
            block.p.extend_from_slice(&z[n..]);
            block.u.extend_from_slice(&row[..m]);
            block.w.extend_from_slice(&row[m..m + k]);
            block.h.push(row[m + k]);
            let before = cost_before.get(places.segments[q]).copied();
            let spent = before.unwrap_or(0.0) + costs[q];
            block.v.push(entry.value - spent);
        }
        let drift = values
            .iter()
            .skip(m + k)
            .step_by(width)
            .fold(0.0f64, |a, h| a.max(h.abs()));
        block.status.push(REACHED);
        block.sheet.push(entry.sheet);
        block.steps.push(entry.iterations as i32);
        block.rejected.push(0);
        block.hamiltonian_drift.push(drift);
    }
    Ok(block)
}

/// Places on a path, evenly spaced in time.
struct Places {
    /// Unconnected segments, each from the node before a place up to it.
    pieces: Path,
    /// 0 at the end of the path.
    times: Vec<f64>,
    /// The segment of the path that each place is on.
    segments: Vec<usize>,
}

impl Places {
    fn along(path: &Path, samples: usize) -> Self {
        let horizon = path.horizon();
        let mut pieces = Path::new(path.node(0));
        pieces.nodes.clear();
        let mut times = Vec::with_capacity(samples);
        let mut segments = Vec::with_capacity(samples);
        let (mut segment, mut begins) = (0, 0.0);
        for q in 0..samples {
            // The last one is the end to the last bit.
            let t = if q > 0 && q + 1 == samples {
                horizon
            } else {
                horizon * q as f64 / (samples - 1).max(1) as f64
            };
            while segment + 1 < path.segments() && t > begins + path.durations[segment] {
                begins += path.durations[segment];
                segment += 1;
            }
            pieces.push((t - begins).max(0.0), path.node(segment));
            segments.push(segment);
            times.push(t - horizon);
        }
        pieces.nodes.extend_from_slice(path.last());
        Self {
            pieces,
            times,
            segments,
        }
    }
}

/// Of each number the sum of those before it.
fn sums_before(numbers: &[f64]) -> Vec<f64> {
    (numbers.iter())
        .scan(0.0, |sum, c| {
            let here = *sum;
            *sum += c;
            Some(here)
        })
        .collect()
}
