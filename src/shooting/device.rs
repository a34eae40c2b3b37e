//! Handing linear equations to a backend's eliminator, and guesses to its Newton's method.

use super::elimination::Factors;
use super::newton::{Elimination, Goal, Job, Linear, MOST_GROWTH, MOST_STEP, ROUGH, Scheme};
use super::path::Path;
use crate::backend::{
    Backend, BackendError, Deadline, Eliminator, Newton, NewtonSpec, Run, Shots, Spec, Systems,
};

/// Eliminates the equations of paths with `n` states, each with the wanted step of its first state,
/// in batches of about `most` bytes.
pub(super) fn eliminate(
    eliminator: &mut dyn Eliminator,
    n: usize,
    problems: Vec<(Linear, Vec<f64>)>,
    most: usize,
) -> Result<Vec<Elimination>, BackendError> {
    let mut done = Vec::with_capacity(problems.len());
    let mut problems = problems.into_iter().peekable();
    while problems.peek().is_some() {
        let mut systems = Systems {
            states: n,
            ..Systems::default()
        };
        let mut batch = Vec::new();
        while let Some((linear, wanted)) = problems
            .next_if(|(l, _)| batch.is_empty() || 8 * (systems.phi.len() + l.phi.len()) <= most)
        {
            systems
                .segments
                .push((linear.phi.len() / (4 * n * n)) as u32);
            systems.phi.extend_from_slice(&linear.phi);
            systems.defects.extend_from_slice(&linear.residual.defects);
            systems.end.extend_from_slice(&linear.residual.end);
            systems.hessian.extend_from_slice(&linear.residual.hessian);
            systems.wanted.extend(wanted);
            batch.push(linear.phi);
        }
        let result = eliminator.eliminate(&systems)?;
        let mut first = 0;
        for phi in batch {
            let nodes = first..first + phi.len() / (4 * n * n) + 1;
            first = nodes.end;
            let of =
                |list: &[f64], each: usize| list[nodes.start * each..nodes.end * each].to_vec();
            let steps = of(&result.steps, 2 * n);
            let regular = steps.iter().all(|x| x.is_finite());
            done.push(Elimination {
                factors: Factors::from_parts(
                    n,
                    phi,
                    of(&result.w, 2 * n * n),
                    of(&result.l, n * n),
                ),
                step: regular.then_some((steps, 0.0)),
            });
        }
    }
    Ok(done)
}

/// Newton's method on a backend, where it has one.
///
/// # Errors
/// What the backend refuses to compile.
pub(super) fn newton(
    backend: &dyn Backend,
    scheme: &Scheme,
    varied: Spec,
    runs: [Run; 2],
) -> Result<Option<Box<dyn Newton>>, BackendError> {
    let equations = &scheme.equations;
    backend.newton(&NewtonSpec {
        varied,
        runs,
        tolerances: [ROUGH.max(scheme.tolerance), scheme.tolerance],
        states: equations.states,
        columns: equations.columns,
        scales: equations.scales.clone(),
        most_growth: MOST_GROWTH,
        most_step: MOST_STEP,
    })
}

/// Times that the end's condition is linearized at most: it is not linear in the end's state, but that
/// moves little.
const LINEARIZATIONS: usize = 4;

/// Puts a device's solutions in place of the guesses of jobs with a given state, where it finds any;
/// of each whether it did, and its iterations. Batches have about `most` bytes of propagators.
///
/// # Errors
/// Device failures; [`BackendError::OutOfTime`].
pub(super) fn refine(
    newton: &mut dyn Newton,
    scheme: &Scheme,
    jobs: &mut [Job],
    (most, deadline): (usize, Deadline),
) -> Result<Vec<(bool, u32)>, BackendError> {
    let n = scheme.equations.states;
    let mut told = vec![(false, 0); jobs.len()];
    let mut paths: Vec<Option<Path>> = jobs.iter().map(|_| None).collect();
    let mut open: Vec<usize> = (0..jobs.len())
        .filter(|k| matches!(jobs[*k].goal, Goal::State(_)))
        .collect();
    for _ in 0..LINEARIZATIONS {
        let mut again = Vec::new();
        let mut rest = open.as_slice();
        while !rest.is_empty() {
            deadline.check()?;
            let mut shots = Shots::default();
            let fits = |shots: &Shots, k: usize| {
                let segments = shots.durations.len() + jobs[k].path.segments();
                shots.segments.is_empty() || 8 * 4 * n * n * segments <= most
            };
            let mut count = 0;
            while let Some(&k) = rest.get(count).filter(|k| fits(&shots, **k)) {
                let path = paths[k].as_ref().unwrap_or(&jobs[k].path);
                scheme.add_shot(&mut shots, path, &jobs[k].goal);
                count += 1;
            }
            let refined = newton.solve(&shots)?;
            let (now, later) = rest.split_at(count);
            let mut first = 0;
            for (place, &k) in now.iter().enumerate() {
                let mut path = jobs[k].path.clone();
                let nodes = first..first + path.nodes.len();
                first = nodes.end;
                told[k] = (refined.solved[place], told[k].1 + refined.iterations[place]);
                paths[k] = None;
                if !refined.solved[place] {
                    continue;
                }
                path.nodes.copy_from_slice(&refined.nodes[nodes]);
                if !scheme.ends_as_given(&path, &shots, place) {
                    again.push(k);
                }
                paths[k] = Some(path);
            }
            rest = later;
        }
        open = again;
        if open.is_empty() {
            break;
        }
    }
    // Their ends are still moving.
    for k in open {
        (told[k].0, paths[k]) = (false, None);
    }
    for (job, path) in jobs.iter_mut().zip(paths) {
        if let Some(path) = path {
            job.path = path;
        }
    }
    Ok(told)
}

impl Scheme {
    /// Adds a path with the end's condition at its end.
    fn add_shot(&self, shots: &mut Shots, path: &Path, goal: &Goal) {
        let Goal::State(goal) = goal else { return };
        let s = &path.last()[..self.equations.states];
        let at = self.end.at(s);
        shots.segments.push(path.segments() as u32);
        shots.nodes.extend_from_slice(&path.nodes);
        shots.durations.extend_from_slice(&path.durations);
        shots.goals.extend_from_slice(goal);
        shots.ends.extend_from_slice(s);
        shots.gradients.extend_from_slice(&at.gradient);
        let slope = self.equations.scaled_slope(&at.hessian);
        shots.hessians.extend(slope);
    }

    /// Whether the end's condition at a path's end is the one that was given, to the tolerance.
    fn ends_as_given(&self, path: &Path, shots: &Shots, place: usize) -> bool {
        let (n, scales) = (self.equations.states, &self.equations.scales);
        let s = &path.last()[..n];
        let gradient = self.end.at(s).gradient;
        let (ends, gradients) = (&shots.ends[place * n..], &shots.gradients[place * n..]);
        let slope = &shots.hessians[place * n * n..];
        let off = (0..n).map(|i| {
            let along: f64 = (0..n)
                .map(|j| slope[i * n + j] * (s[j] - ends[j]) / scales[j])
                .sum();
            ((gradient[i] - gradients[i]) / scales[n + i] - along).abs()
        });
        off.fold(0.0, f64::max) <= self.tolerance * path.size(scales)
    }
}
