//! Around a fold: continuation by pseudo-arclength (H. B. Keller, Numerical solution of bifurcation
//! and nonlinear eigenvalue problems, 1977) along the line between two neighbouring states.

use crate::backend::BackendError;
use crate::shooting::{Goal, Job, Path, Solved, Solver};

/// First step: the advance along the sheet that moves this share of the line.
const FIRST: f64 = 0.25;
const LEAST: f64 = 1e-5;
const GROW: f64 = 1.5;
/// Steps along a line.
const MOST_STEPS: usize = 80;
/// Steps that were too long: a sheet that ends without a fold is not worth more.
const MOST_FAILED: usize = 28;
/// Iterations by which a fold is located, and how well (share of the line's direction in the
/// tangent).
const LOCATE_STEPS: usize = 8;
const LOCATED: f64 = 1e-7;
/// Lines followed together.
const COHORT: usize = 1024;

/// A solution, and the neighbouring state (deviation) toward which its sheet is to be followed.
pub struct Edge {
    pub path: Path,
    pub to: Vec<f64>,
}

/// A point of a fold: where a sheet turns back along a line.
#[derive(Clone, Debug, PartialEq)]
pub struct Fold {
    /// State as a deviation, adjoint, V.
    pub s: Vec<f64>,
    pub p: Vec<f64>,
    pub value: f64,
}

/// What following an edge gave.
#[derive(Default)]
pub struct Found {
    pub folds: Vec<Fold>,
    /// The solution at which the sheet came back to where it began, or went on to the other end.
    pub at_start: Option<(Job, Solved)>,
    pub at_end: Option<(Job, Solved)>,
    pub evaluations: u32,
}

/// A point of the curve over the line: its solution, `(t, p scaled)` and the tangent there.
#[derive(Clone)]
struct Point {
    job: Job,
    at: Vec<f64>,
    tangent: Vec<f64>,
}

enum Stage {
    /// Steps on.
    Walk,
    /// Looks for the fold between two points, by the advance from the first.
    Locate {
        behind: Box<Point>,
        /// Advances at which the tangent leads on and back, with its share along the line.
        on: (f64, f64),
        back: (f64, f64),
        ahead: Box<Point>,
        left: usize,
    },
    /// Solves for the state at an end of the line.
    Arrive {
        at_start: bool,
    },
    Done,
}

struct Walker {
    origin: Vec<f64>,
    direction: Vec<f64>,
    now: Point,
    advance: f64,
    steps: usize,
    /// Steps that were too long.
    failed: usize,
    stage: Stage,
    found: Found,
}

/// Follows all edges at once.
///
/// # Errors
/// Device failures only.
pub fn around(solver: &mut Solver, edges: Vec<Edge>) -> Result<Vec<Found>, BackendError> {
    let mut found = Vec::with_capacity(edges.len());
    let mut edges = edges.into_iter().peekable();
    while edges.peek().is_some() {
        let part: Vec<Edge> = edges.by_ref().take(COHORT).collect();
        found.extend(together(solver, part)?);
    }
    Ok(found)
}

fn together(solver: &mut Solver, edges: Vec<Edge>) -> Result<Vec<Found>, BackendError> {
    let mut jobs: Vec<Job> = (edges.iter())
        .map(|e| Job::new(e.path.clone(), Goal::State(e.path.start().to_vec())))
        .collect();
    solver.solve(&mut jobs)?;
    solver.renew(&mut jobs)?;
    let scales = solver.scheme.equations.scales.clone();
    let mut walkers: Vec<Walker> = (jobs.into_iter().zip(edges))
        .map(|(job, edge)| Walker::new(job, &edge, &scales))
        .collect();
    loop {
        let mut active: Vec<usize> = Vec::new();
        let mut jobs: Vec<Job> = Vec::new();
        for (k, walker) in walkers.iter().enumerate() {
            if let Some(job) = walker.next() {
                active.push(k);
                jobs.push(job);
            }
        }
        if active.is_empty() {
            return Ok(walkers.into_iter().map(|w| w.found).collect());
        }
        solver.solve(&mut jobs)?;
        solver.renew(&mut jobs)?;
        for (k, job) in active.into_iter().zip(jobs) {
            walkers[k].learn(job, &scales);
        }
    }
}

impl Walker {
    fn new(job: Job, edge: &Edge, scales: &[f64]) -> Self {
        let origin = edge.path.start().to_vec();
        let direction: Vec<f64> = edge.to.iter().zip(&origin).map(|(b, a)| b - a).collect();
        let n = origin.len();
        let scaled: Vec<f64> = (0..n).map(|i| direction[i] / scales[i]).collect();
        let tangent = job
            .solved()
            .and_then(|_| job.factors.tangent(&scaled, None));
        let at = [&[0.0], scaled_adjoint(&job, scales).as_slice()].concat();
        let stage = if tangent.is_some() {
            Stage::Walk
        } else {
            Stage::Done
        };
        let tangent = tangent.unwrap_or_else(|| vec![0.0; n + 1]);
        Self {
            advance: FIRST / tangent[0].abs().max(1e-3),
            origin,
            direction,
            now: Point { job, at, tangent },
            steps: 0,
            failed: 0,
            stage,
            found: Found::default(),
        }
    }

    fn line(&self, from: &Point, advance: f64) -> Job {
        from.job.clone().toward(Goal::Line {
            origin: self.origin.clone(),
            direction: self.direction.clone(),
            tangent: from.tangent.clone(),
            from: from.at.clone(),
            advance,
        })
    }

    /// The next problem, if any.
    fn next(&self) -> Option<Job> {
        match &self.stage {
            Stage::Done => None,
            Stage::Walk => Some(self.line(&self.now, self.advance)),
            Stage::Locate {
                behind, on, back, ..
            } => Some(self.line(behind, between(*on, *back))),
            Stage::Arrive { at_start } => {
                let state = if *at_start {
                    self.origin.clone()
                } else {
                    self.origin
                        .iter()
                        .zip(&self.direction)
                        .map(|(a, d)| a + d)
                        .collect()
                };
                Some(self.now.job.clone().toward(Goal::State(state)))
            }
        }
    }

    fn learn(&mut self, job: Job, scales: &[f64]) {
        self.found.evaluations += job.iterations.saturating_sub(self.now.job.iterations);
        self.steps += 1;
        match std::mem::replace(&mut self.stage, Stage::Done) {
            Stage::Done => {}
            Stage::Arrive { at_start } => {
                if let Some(solved) = job.solved().cloned() {
                    let mut job = job;
                    job.factors = Default::default();
                    *(if at_start {
                        &mut self.found.at_start
                    } else {
                        &mut self.found.at_end
                    }) = Some((job, solved));
                }
            }
            Stage::Walk => self.walked(job, scales),
            Stage::Locate {
                behind,
                on,
                back,
                ahead,
                left,
            } => self.located(job, scales, behind, on, back, ahead, left),
        }
    }

    /// The point that a solved job is, its tangent going on from `before`.
    fn point(&self, mut job: Job, before: &Point, scales: &[f64]) -> Option<Point> {
        let n = self.origin.len();
        let t = job.solved()?.t;
        let scaled: Vec<f64> = (0..n).map(|i| self.direction[i] / scales[i]).collect();
        let tangent = job.factors.tangent(&scaled, Some(&before.tangent))?;
        job.iterations = 0;
        let at = [&[t], scaled_adjoint(&job, scales).as_slice()].concat();
        Some(Point { job, at, tangent })
    }

    fn walked(&mut self, job: Job, scales: &[f64]) {
        let next = self.point(job, &self.now, scales);
        // A tangent that turns sharply has jumped to another part of the curve, or the step is too
        // long to be sure.
        let turned = |next: &Point| {
            self.now
                .tangent
                .iter()
                .zip(&next.tangent)
                .map(|(a, b)| a * b)
                .sum::<f64>()
        };
        let Some(next) = next.filter(|next| turned(next) > 0.7) else {
            self.advance *= 0.5;
            self.failed += 1;
            let moves = self.advance * self.now.tangent[0].abs().max(1e-3);
            if self.steps < MOST_STEPS && self.failed < MOST_FAILED && moves > LEAST {
                self.stage = Stage::Walk;
            }
            return;
        };
        let (before, after) = (self.now.tangent[0], next.tangent[0]);
        if before > 0.0 && after <= 0.0 || before < 0.0 && after >= 0.0 {
            self.stage = Stage::Locate {
                behind: Box::new(self.now.clone()),
                on: (0.0, before),
                back: (self.advance, after),
                ahead: Box::new(next),
                left: LOCATE_STEPS,
            };
            return;
        }
        self.go_on(next);
    }

    /// From a point of the curve: on, or to the state at an end of the line that was passed.
    fn go_on(&mut self, next: Point) {
        let t = next.at[0];
        self.now = next;
        self.advance *= GROW;
        self.stage = if t >= 1.0 {
            Stage::Arrive { at_start: false }
        } else if t <= 0.0 {
            Stage::Arrive { at_start: true }
        } else if self.steps < MOST_STEPS {
            Stage::Walk
        } else {
            Stage::Done
        };
    }

    #[expect(clippy::too_many_arguments, reason = "the parts of one stage")]
    fn located(
        &mut self,
        job: Job,
        scales: &[f64],
        behind: Box<Point>,
        mut on: (f64, f64),
        mut back: (f64, f64),
        ahead: Box<Point>,
        left: usize,
    ) {
        let advance = between(on, back);
        if let Some(point) = self.point(job, &behind, scales) {
            let along = point.tangent[0];
            let done = along.abs() < LOCATED || left == 0;
            if done && let Some(solved) = point.job.solved() {
                self.found.folds.push(Fold {
                    s: point.job.path.start().to_vec(),
                    p: point.job.path.adjoint().to_vec(),
                    value: solved.value,
                });
                return self.go_on(*ahead);
            }
            if (along > 0.0) == (on.1 > 0.0) {
                on = (advance, along);
            } else {
                back = (advance, along);
            }
            if left > 0 {
                self.stage = Stage::Locate {
                    behind,
                    on,
                    back,
                    ahead,
                    left: left - 1,
                };
                return;
            }
        }
        self.go_on(*ahead);
    }
}

/// Where a straight line between two points passes 0, kept away from them.
fn between(a: (f64, f64), b: (f64, f64)) -> f64 {
    let q = a.1 / (a.1 - b.1);
    a.0 + q.clamp(1e-3, 1.0 - 1e-3) * (b.0 - a.0)
}

fn scaled_adjoint(job: &Job, scales: &[f64]) -> Vec<f64> {
    let n = scales.len() / 2;
    job.path
        .adjoint()
        .iter()
        .zip(&scales[n..])
        .map(|(p, s)| p / s)
        .collect()
}
