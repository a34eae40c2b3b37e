//! Homotopy: from a solved state to a target along the line between them, in steps as long as Newton's method follows.

use crate::backend::BackendError;
use crate::shooting::{Factors, Failure, Goal, Job, Path, Solved, Solver};

/// Ways that are followed together.
const COHORT: usize = 4096;

/// One way from a path to a target. The path need not be a solution: it is tried as a guess for the target first.
#[derive(Clone, Debug)]
pub struct Approach {
    job: Job,
    from: Vec<f64>,
    to: Vec<f64>,
    /// Share of the way on which the job is solved; none before it is solved at all.
    at: Option<f64>,
    step: f64,
    /// Shortest step that is tried, as a share of the way.
    least: f64,
    failure: Option<Failure>,
    evaluations: u32,
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
            failure: None,
            evaluations: 0,
        }
    }

    /// From a solution.
    pub fn from_solution(path: Path, to: Vec<f64>, least: f64) -> Self {
        Self {
            at: Some(0.0),
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

    /// The next problem to try, and its share of the way.
    fn next(&self) -> (Job, f64) {
        let share = match self.at {
            // Whole first; when that failed, the guess's own state.
            None if self.step == 1.0 => 1.0,
            None => 0.0,
            Some(at) => (at + self.step).min(1.0),
        };
        (self.job.clone().toward(Goal::State(self.point(share))), share)
    }

    fn learn(&mut self, tried: Job, share: f64) {
        self.evaluations += tried.iterations - self.job.iterations;
        match tried.failure() {
            None => {
                // A path that needed no step halving may take longer ones.
                self.step = match self.at {
                    Some(_) => 2.0 * self.step,
                    None => self.step.min(0.5),
                };
                self.at = Some(share);
                self.job = tried;
            }
            Some(why) => {
                self.job.iterations = tried.iterations;
                if self.at.is_none() && self.step < 1.0 {
                    // Not even a solution at the guess's own state.
                    self.failure = Some(why);
                    return;
                }
                self.step *= 0.5;
                if self.step < self.least {
                    self.failure = Some(why);
                }
            }
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

/// Follows all ways at once.
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
    loop {
        let active: Vec<usize> = (0..ways.len()).filter(|i| ways[*i].is_active()).collect();
        if active.is_empty() {
            for way in ways {
                way.job.factors = Factors::default();
            }
            return Ok(());
        }
        let (mut jobs, shares): (Vec<Job>, Vec<f64>) = active.iter().map(|i| ways[*i].next()).unzip();
        solver.solve(&mut jobs)?;
        for ((i, job), share) in active.into_iter().zip(jobs).zip(shares) {
            ways[i].learn(job, share);
        }
    }
}
