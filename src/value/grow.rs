//! Solutions along a flown path: its end is solved for first, then ever more of it, back to its
//! start.
//!
//! A path that is nearly optimal, but too rough a guess as a whole, is followed from where little
//! of it is left. Adjoints of a part that is put in front are those that its states have, carried
//! backward from the solution behind it.

use crate::backend::BackendError;
use crate::program::Program;
use crate::shooting::{Goal, Job, Path, Solver};
use crate::sweep::Plan;

/// Parts of a segment in which adjoints are carried backward.
const PARTS: usize = 16;
/// Rounds at most; in each a part is put in front of every path that is not done.
const ROUNDS: usize = 48;
/// Share of a path that is solved for first.
const FIRST: usize = 4;

/// dp/dtau along a plan's trajectories.
pub fn adjoint_rate(plan: &Plan) -> Program {
    let (system, n) = (&plan.system, plan.system.states);
    Program::lower(&system.graph, &system.inputs, &system.rate[n..2 * n])
}

/// A path with the adjoints before its node `from` replaced by those that its states have, from
/// there backward: `dp/dtau = dH/dx`, whose rate is given.
pub fn with_adjoints(mut path: Path, from: usize, rate: &Program) -> Path {
    let n = path.width / 2;
    for k in (0..from).rev() {
        let step = path.durations[k] / PARTS as f64;
        let (before, after) = (path.node(k)[..n].to_vec(), path.node(k + 1).to_vec());
        let mut p = after[n..].to_vec();
        for part in 0..PARTS {
            let share = 1.0 - (part as f64 + 0.5) / PARTS as f64;
            let s = (0..n).map(|i| before[i] + share * (after[i] - before[i]));
            let at: Vec<f64> = s.chain(p.iter().copied()).collect();
            p.iter_mut()
                .zip(rate.eval(&at))
                .for_each(|(p, r)| *p += step * r);
        }
        path.nodes[k * 2 * n + n..(k + 1) * 2 * n].copy_from_slice(&p);
    }
    path
}

/// A path of which the part behind a node is solved.
struct Growing {
    flown: Path,
    /// The first node of the solved part, and its solution.
    from: usize,
    tail: Option<(Path, f64)>,
    /// Segments that are put in front next.
    length: usize,
}

/// The part of a path from one node to a later one, and another path behind it.
fn joined(path: &Path, first: usize, last: usize, tail: &Path) -> Path {
    let mut whole = Path::new(if first < last {
        path.node(first)
    } else {
        tail.node(0)
    });
    for k in first..last {
        let node = if k + 1 < last {
            path.node(k + 1)
        } else {
            tail.node(0)
        };
        whole.push(path.durations[k], node);
    }
    whole.append(&tail.nodes[tail.width..], &tail.durations);
    whole
}

impl Growing {
    fn new(flown: Path) -> Self {
        Self {
            from: flown.segments(),
            tail: None,
            length: (flown.segments() / FIRST).max(1),
            flown,
        }
    }

    fn is_active(&self) -> bool {
        self.from > 0 && self.length > 0
    }

    /// The node to be reached next.
    fn next(&self) -> usize {
        self.from.saturating_sub(self.length)
    }

    /// The next problem, with the adjoints as they are on the path and as carried backward.
    fn problems(&self, rate: &Program) -> [Job; 2] {
        let (first, n) = (self.next(), self.flown.width / 2);
        let end = Path::new(self.flown.last());
        let plain = joined(
            &self.flown,
            first,
            self.from,
            self.tail.as_ref().map_or(&end, |(path, _)| path),
        );
        let carried = with_adjoints(plain.clone(), self.from - first, rate);
        let goal = Goal::State(self.flown.node(first)[..n].to_vec());
        [carried, plain].map(|path| {
            let mut job = Job::new(path, goal.clone());
            job.rough = first > 0;
            job
        })
    }

    fn learn(&mut self, tried: [Job; 2]) -> u32 {
        let evaluations = tried.iter().map(|job| job.iterations).sum();
        let solved = (tried.into_iter())
            .find_map(|job| job.solved().map(|s| s.value).map(|value| (job.path, value)));
        match solved {
            Some(tail) => {
                self.from = self.next();
                self.tail = Some(tail);
                self.length *= 2;
            }
            None => self.length = self.length.min(self.from) / 2,
        }
        evaluations
    }
}

/// A solution with V, if there is one, and the evaluations that it took.
pub type Grown = (Option<(Path, f64)>, u32);

/// The solutions from the starts of flown paths with V, `None` where a path could not be followed
/// back to its start, and the evaluations of each.
///
/// # Errors
/// Device failures only.
pub fn grown(
    plan: &Plan,
    solver: &mut Solver,
    flown: Vec<Path>,
) -> Result<Vec<Grown>, BackendError> {
    let rate = adjoint_rate(plan);
    let mut all: Vec<(Growing, u32)> = flown
        .into_iter()
        .map(|path| (Growing::new(path), 0))
        .collect();
    for _ in 0..ROUNDS {
        let mut active: Vec<&mut (Growing, u32)> =
            all.iter_mut().filter(|(g, _)| g.is_active()).collect();
        if active.is_empty() {
            break;
        }
        let mut jobs: Vec<Job> = active.iter().flat_map(|(g, _)| g.problems(&rate)).collect();
        solver.solve(&mut jobs)?;
        let mut jobs = jobs.into_iter();
        for (growing, evaluations) in active.iter_mut().map(|a| &mut **a) {
            if let (Some(a), Some(b)) = (jobs.next(), jobs.next()) {
                *evaluations += growing.learn([a, b]);
            }
        }
    }
    Ok((all.into_iter())
        .map(|(growing, evaluations)| (growing.tail.filter(|_| growing.from == 0), evaluations))
        .collect())
}
