//! Homotopy: from a solved state to a target along the line between them, in steps as long as
//! Newton's method follows.

use crate::backend::BackendError;
use crate::shooting::{Factors, Failure, Goal, Job, Path, Solved, Solver};
use rayon::prelude::*;

/// Steps that a way may take for each halving of the shortest one.
const TRIES: f64 = 10.0;
/// Lengths of steps tried at once, each this much shorter than the one before.
const LENGTHS: i32 = 3;
const RATIO: f64 = 0.35;
/// Ways that are followed together.
const COHORT: usize = 4096;
/// Parts of them a thread, and segments of a part at least.
const PARTS: usize = 4;
const SEGMENTS: usize = 64;
/// A part of which no more than one in so many is left is done.
const LEFT: usize = 4;

/// One way from a path to a target. The path need not be a solution: it is tried as a guess for the
/// target first.
#[derive(Clone, Debug)]
pub struct Approach {
    job: Job,
    from: Vec<f64>,
    to: Vec<f64>,
    /// Share of the way on which the job is solved; none before it is solved at all.
    at: Option<f64>,
    step: f64,
    /// Shortest and longest step that is tried, as a share of the way.
    least: f64,
    longest: f64,
    failure: Option<Failure>,
    evaluations: u32,
    /// Steps tried so far, and the most.
    tries: u32,
    most: u32,
}

/// A target that was not reached.
#[derive(Clone, Debug)]
pub struct Unreached {
    pub failure: Failure,
    /// Share of the way that was covered, and the state there (deviation).
    pub share: f64,
    pub furthest: Vec<f64>,
    /// The solution there, if there is one.
    pub job: Option<Job>,
}

impl Approach {
    pub fn new(path: Path, to: Vec<f64>, least: f64) -> Self {
        let from = path.start().to_vec();
        Self {
            job: Job::new(path, Goal::State(to.clone())),
            from,
            to,
            at: None,
            step: 1.0,
            least,
            longest: 1.0,
            failure: None,
            evaluations: 0,
            tries: 0,
            most: (TRIES * least.recip().log2()).ceil() as u32,
        }
    }

    /// From a solution.
    pub fn from_solution(path: Path, to: Vec<f64>, least: f64) -> Self {
        Self {
            at: Some(0.0),
            ..Self::new(path, to, least)
        }
    }

    /// From a guess at its own state, in steps of at most a share of the way: without the leaps by
    /// which Newton's method may come to another sheet.
    pub fn along(path: Path, to: Vec<f64>, least: f64, longest: f64) -> Self {
        Self {
            step: longest,
            longest,
            ..Self::new(path, to, least)
        }
    }

    fn point(&self, share: f64) -> Vec<f64> {
        if share == 1.0 {
            return self.to.clone();
        }
        (self.from.iter().zip(&self.to))
            .map(|(a, b)| a + share * (b - a))
            .collect()
    }

    fn is_active(&self) -> bool {
        self.at != Some(1.0) && self.failure.is_none()
    }

    /// The next problems to try, with their shares of the way: the whole way first, then the
    /// guess's own state, then steps of several lengths at once, as a batch costs little more than
    /// its longest member.
    fn next(&self) -> Vec<(Job, f64)> {
        let shares = match self.at {
            None if self.step == 1.0 => vec![1.0],
            None => vec![0.0],
            Some(_) if self.step == 1.0 => vec![1.0],
            Some(at) => {
                let mut shares: Vec<f64> = (0..LENGTHS)
                    .map(|k| self.step * RATIO.powi(k))
                    .filter(|step| *step >= self.least)
                    .map(|step| (at + step).min(1.0))
                    .collect();
                shares.dedup();
                shares
            }
        };
        (shares.into_iter())
            .map(|share| {
                let mut job = self.job.clone().toward(Goal::State(self.point(share)));
                job.rough = share < 1.0;
                (job, share)
            })
            .collect()
    }

    /// Takes the furthest of the problems tried that was solved.
    fn learn(&mut self, tried: Vec<(Job, f64)>) {
        self.evaluations += tried.iter().map(|(job, _)| job.iterations).sum::<u32>();
        let last = tried.last().and_then(|(job, _)| job.failure());
        let count = tried.len() as i32;
        self.tries += 1;
        match tried.into_iter().find(|(job, _)| job.solved().is_some()) {
            Some((job, share)) => {
                let step = share - self.at.unwrap_or(0.0);
                self.step = match self.at {
                    Some(_) => 2.0 * step,
                    None => 0.5,
                }
                .min(self.longest);
                self.at = Some(share);
                self.job = job;
            }
            // Not even a solution at the guess's own state.
            None if self.at.is_none() && self.step < 1.0 => self.failure = last,
            None => {
                self.step *= if self.step == 1.0 {
                    0.5
                } else {
                    RATIO.powi(count)
                };
                if self.step < self.least {
                    self.failure = last.or(Some(Failure::Diverged));
                }
            }
        }
        if self.tries >= self.most && self.at != Some(1.0) && self.failure.is_none() {
            self.failure = last.or(Some(Failure::Iterations));
        }
        // Each step has its own budget.
        self.job.iterations = 0;
    }

    /// Evaluations used, and the solution at the target or how far it went.
    pub fn finish(mut self) -> (u32, Result<(Job, Solved), Box<Unreached>>) {
        let share = self.at.unwrap_or(0.0);
        let furthest = self.point(share);
        match (self.failure, self.job.outcome.take()) {
            (None, Some(Ok(solved))) => (self.evaluations, Ok((self.job, solved))),
            (failure, outcome) => (
                self.evaluations,
                Err(Box::new(Unreached {
                    failure: failure.unwrap_or(Failure::Diverged),
                    share,
                    furthest,
                    job: self.at.is_some().then(|| {
                        self.job.outcome = outcome;
                        self.job
                    }),
                })),
            ),
        }
    }
}

/// Follows all ways at once. At the solver's deadline it gives up those that are not done.
///
/// # Errors
/// Device failures only.
pub fn follow(solver: &mut Solver, ways: &mut [Approach]) -> Result<(), BackendError> {
    // Matrices are kept while a way is followed, so only so many are at once.
    for ways in ways.chunks_mut(COHORT) {
        follow_together(solver, ways)?;
    }
    Ok(())
}

fn follow_together(solver: &mut Solver, ways: &mut [Approach]) -> Result<(), BackendError> {
    let done = if solver.is_alone() {
        apart(solver, ways)
    } else {
        in_step(solver, ways)
    };
    match done {
        Err(BackendError::OutOfTime) => {
            for way in ways.iter_mut().filter(|way| way.is_active()) {
                way.failure = Some(Failure::OutOfTime);
            }
        }
        done => done?,
    }
    for way in ways {
        way.job.factors = Factors::default();
    }
    Ok(())
}

/// A way with the problems that it tries now.
type Trying<'w> = (&'w mut Approach, Vec<(Job, f64)>);

/// Parts of the ways, each on one thread, until most of a part are done; the others are shared out
/// anew, so that no thread is left with several long ones.
fn apart(solver: &mut Solver, ways: &mut [Approach]) -> Result<(), BackendError> {
    let mut open: Vec<Trying<'_>> = ways.iter_mut().map(|way| (way, Vec::new())).collect();
    while !open.is_empty() {
        let part = part_of(&open);
        match solver.apart(open.par_chunks_mut(part), each_by_itself) {
            Some(done) => done?,
            None => each_by_itself(solver, &mut open)?,
        }
        open.retain(|(way, tried)| way.is_active() || !tried.is_empty());
    }
    Ok(())
}

/// Ways that one thread follows together: as many as fill its lanes, and of many so many that all
/// threads are busy to the end.
fn part_of(ways: &[Trying<'_>]) -> usize {
    let segments: usize = ways.iter().map(|(way, _)| way.job.path.segments()).sum();
    let full = (SEGMENTS * ways.len()).div_ceil(segments.max(1));
    let share = ways.len().div_ceil(PARTS * rayon::current_num_threads());
    share.max(full).max(1)
}

/// Each way tries its next problems as soon as its last ones are decided, until most are done.
fn each_by_itself(solver: &mut Solver, ways: &mut [Trying<'_>]) -> Result<(), BackendError> {
    let enough = ways.len() / LEFT;
    loop {
        ways.par_iter_mut().for_each(|(way, tried)| {
            if !tried.is_empty() && is_decided(tried) {
                way.learn(std::mem::take(tried));
            }
            if tried.is_empty() && way.is_active() {
                *tried = way.next();
                tried
                    .iter_mut()
                    .for_each(|(job, _)| solver.scheme.begin(job));
            }
        });
        let is_open = |(way, tried): &&Trying<'_>| !tried.is_empty() || way.is_active();
        if ways.iter().filter(is_open).count() <= enough {
            return Ok(());
        }
        // All of what was begun may have failed at once: then there is nothing to do yet.
        solver.round(
            ways.iter_mut()
                .flat_map(|(_, tried)| tried)
                .map(|(job, _)| job),
        )?;
    }
}

/// Whether it is known which of the problems, the longest step first, is the furthest that is
/// solved: shorter ones need not be.
fn is_decided(tried: &[(Job, f64)]) -> bool {
    let open = (tried.iter()).find(|(job, _)| job.failure().is_none());
    open.is_none_or(|(job, _)| job.solved().is_some())
}

/// All ways try their next problems together: they are solved in batches of several kinds.
fn in_step(solver: &mut Solver, ways: &mut [Approach]) -> Result<(), BackendError> {
    loop {
        let active: Vec<usize> = (0..ways.len()).filter(|i| ways[*i].is_active()).collect();
        if active.is_empty() {
            return Ok(());
        }
        let mut owners = Vec::new();
        let mut shares = Vec::new();
        let mut jobs = Vec::new();
        for &i in &active {
            for (job, share) in ways[i].next() {
                owners.push(i);
                shares.push(share);
                jobs.push(job);
            }
        }
        solver.solve(&mut jobs)?;
        let mut tried = owners
            .into_iter()
            .zip(jobs.into_iter().zip(shares))
            .peekable();
        for i in active {
            let mut own = Vec::new();
            while let Some((_, one)) = tried.next_if(|(owner, _)| *owner == i) {
                own.push(one);
            }
            ways[i].learn(own);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn job(outcome: Option<Result<(), Failure>>) -> (Job, f64) {
        let mut job = Job::new(Path::new(&[0.0, 0.0]), Goal::State(vec![0.0]));
        job.outcome = outcome.map(|outcome| {
            outcome.map(|()| Solved {
                value: 0.0,
                slope: None,
                fold: 1.0,
                residual: 0.0,
                t: 0.0,
            })
        });
        (job, 0.5)
    }

    /// Of steps tried at once, the longest first, the furthest that is solved counts.
    #[test]
    fn shorter_steps_are_not_waited_for() {
        let [open, solved, failed] = [None, Some(Ok(())), Some(Err(Failure::Diverged))];
        for (steps, decided) in [
            (vec![open], false),
            (vec![solved], true),
            (vec![failed], true),
            (vec![solved, open, open], true),
            (vec![failed, solved, open], true),
            (vec![failed, failed, failed], true),
            (vec![open, solved, solved], false),
            (vec![failed, open, solved], false),
            (vec![failed, failed, open], false),
        ] {
            let tried: Vec<_> = steps.iter().map(|outcome| job(*outcome)).collect();
            assert_eq!(is_decided(&tried), decided, "{steps:?}");
        }
    }
}
