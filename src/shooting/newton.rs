//! Damped Newton iterations over a batch of boundary value problems.
//!
//! One iteration of a problem integrates its segments with their variations, eliminates, and tries
//! the step. The trial is integrated without variations and its simplified correction (same matrix,
//! new residual) decides by the natural monotonicity test of P. Deuflhard (Newton Methods for
//! Nonlinear Problems, 2004, ch. 3): taken whole where it contracts fast, when further trials with
//! the same matrix follow; damped where it does not contract.

use super::elimination::{Factors, Start};
use super::end::End;
use super::equations::Equations;
use super::path::Path;

/// Trial steps below this share of Newton's are not tried: the target is then approached in shorter
/// steps.
const LEAST_DAMPING: f64 = 0.1;
/// Longest step in units of the path's size.
pub(super) const MOST_STEP: f64 = 1.0;
/// Relative size of the last correction of a solution that is only a point on the way, and of the
/// one after which segments are integrated to the full tolerance.
pub(super) const ROUGH: f64 = 1e-4;
/// Relative size of a correction from which on the error of rough segments may matter.
const NEAR: f64 = 1e-2;
/// Contraction with which an old matrix is kept.
const KEEP: f64 = 0.1;
/// Evaluations after which a problem is given up.
const MOST_ROUNDS: u32 = 40;
/// The same of a step along a line: a shorter one costs less than to wait.
const MOST_ROUNDS_LINE: u32 = 12;
/// Segments whose propagator has larger entries are split: a digit is lost for each power of ten.
pub(super) const MOST_GROWTH: f64 = 1e3;
/// Segments of a path above which none is split any more: such a path is mostly no solution, and
/// takes most of the time.
const MOST_SEGMENTS: usize = 1000;

/// What the first node has to meet.
#[derive(Clone, Debug)]
pub enum Goal {
    /// The state of the first node, as a deviation.
    State(Vec<f64>),
    /// A point of the line `origin + t * direction` (deviations), `advance` further along the
    /// sheet's `tangent` `(t, p scaled)` than the point `from` `(t, p scaled)`.
    Line {
        origin: Vec<f64>,
        direction: Vec<f64>,
        tangent: Vec<f64>,
        from: Vec<f64>,
        advance: f64,
    },
}

impl Goal {
    /// Rounds after which a job is given up.
    fn most_rounds(&self) -> u32 {
        match self {
            Goal::State(_) => MOST_ROUNDS,
            Goal::Line { .. } => MOST_ROUNDS_LINE,
        }
    }
}

/// Why a problem was not solved.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Failure {
    /// No step makes the residual smaller.
    Diverged,
    /// The linear equations are singular.
    Singular,
    /// A trajectory leaves the domain of the equations.
    NotFinite,
    /// A segment could not be integrated.
    Integration,
    /// Too many iterations.
    Iterations,
    /// The trajectory does not come near the equilibrium within the longest horizon.
    Horizon,
    /// The solver's deadline has passed.
    OutOfTime,
}

/// A solved problem.
#[derive(Clone, Debug)]
pub struct Solved {
    /// V at the first node.
    pub value: f64,
    /// `dp/ds` at the first node (row-major), where it exists.
    pub slope: Option<Vec<f64>>,
    /// Smallest singular value of the first node's equations for p: 0 on a fold, at most 1.
    pub fold: f64,
    /// The last correction, relative to the path's size: an estimate of the relative error of the
    /// nodes.
    pub residual: f64,
    /// Parameter of a line's point.
    pub t: f64,
}

/// One problem: its first guess, then its solution.
#[derive(Clone, Debug)]
pub struct Job {
    pub path: Path,
    pub goal: Goal,
    pub outcome: Option<Result<Solved, Failure>>,
    /// Evaluations: integrations of the whole path.
    pub iterations: u32,
    /// Whether a solution to a few digits will do: a point on the way to another.
    pub rough: bool,
    /// Whether segments are integrated to the full tolerance: not before the guess is good to some
    /// digits.
    pub(super) fine: bool,
    /// Elimination at (or near) `path`. Given along with a first guess it saves the first
    /// linearization.
    pub factors: Factors,
    pub(super) stage: Stage,
}

#[derive(Clone, Debug)]
pub(super) enum Stage {
    /// To be linearized.
    Linearize,
    /// A step to be tried.
    Try(Trial),
    Done,
}

#[derive(Clone, Debug)]
pub(super) struct Trial {
    pub(super) path: Path,
    t: f64,
    steps: Vec<f64>,
    /// Norm of the step and the share of it that is tried.
    norm: f64,
    damping: f64,
}

impl Job {
    pub fn new(path: Path, goal: Goal) -> Self {
        Self {
            path,
            goal,
            outcome: None,
            iterations: 0,
            rough: false,
            fine: false,
            factors: Factors::default(),
            stage: Stage::Linearize,
        }
    }

    /// The same problem's solution as the guess for another goal.
    pub fn toward(mut self, goal: Goal) -> Self {
        self.goal = goal;
        self.outcome = None;
        self.fine = false;
        self.stage = Stage::Linearize;
        self
    }

    pub fn solved(&self) -> Option<&Solved> {
        match &self.outcome {
            Some(Ok(s)) => Some(s),
            _ => None,
        }
    }

    pub fn failure(&self) -> Option<Failure> {
        match &self.outcome {
            Some(Err(f)) => Some(*f),
            _ => None,
        }
    }

    pub(super) fn fail(&mut self, why: Failure) {
        self.outcome = Some(Err(why));
        self.stage = Stage::Done;
    }
}

/// A path's segments after integration.
pub(super) struct Integrated {
    /// `[segment][2n]`, physical units.
    pub ends: Vec<f64>,
    pub costs: Vec<f64>,
    /// `[segment][2n x 2n]`, scaled; empty without variations.
    pub phi: Vec<f64>,
    pub failure: Option<Failure>,
}

/// Defects of a path, scaled.
pub(super) struct Residual {
    pub defects: Vec<f64>,
    pub end: Vec<f64>,
    pub hessian: Vec<f64>,
    /// V of the path, defects accounted for to first order.
    value: f64,
}

/// The linear equations at a path.
pub(super) struct Linear {
    /// `[segment][2n x 2n]`, scaled.
    pub phi: Vec<f64>,
    pub residual: Residual,
}

/// What an elimination gives.
pub(super) struct Elimination {
    pub factors: Factors,
    /// Steps of the nodes, and of a line's parameter; `None` where the equations are singular.
    pub step: Option<(Vec<f64>, f64)>,
}

/// The equations of a batch's problems, and the decisions of Newton's method on them.
#[derive(Clone, Debug)]
pub struct Scheme {
    pub equations: Equations,
    pub end: End,
    /// Relative size of the last correction.
    pub tolerance: f64,
    /// Duration of segments that are added where the end is not near enough to the equilibrium.
    pub duration: f64,
}

impl Scheme {
    /// A job that comes with its matrix needs no first linearization: its first step is the
    /// tangent's.
    pub fn begin(&self, job: &mut Job) {
        if matches!(job.stage, Stage::Done) {
            job.stage = Stage::Linearize;
        }
        if job.factors.is_empty() {
            return;
        }
        let n = self.equations.states;
        let defects = vec![0.0; job.path.segments() * 2 * n];
        let (factors, end) = (std::mem::take(&mut job.factors), vec![0.0; n]);
        if let Some((steps, t)) = self.step(&job.path, &job.goal, &factors, &defects, &end) {
            job.factors = factors;
            self.try_within(job, steps, t);
        }
    }

    /// Solves the linear equations for the path's goal: steps of the nodes, and of a line's
    /// parameter.
    fn step(
        &self,
        path: &Path,
        goal: &Goal,
        factors: &Factors,
        defects: &[f64],
        end: &[f64],
    ) -> Option<(Vec<f64>, f64)> {
        let n = self.equations.states;
        let scales = &self.equations.scales;
        match goal {
            Goal::State(s) => {
                let wanted = self.wanted(path, s);
                Some((factors.solve(defects, end, &Start::Step(&wanted))?, 0.0))
            }
            Goal::Line {
                origin,
                direction,
                tangent,
                from,
                advance,
            } => {
                // The step's parameter is that of the new point: the line's origin is the excess.
                let excess: Vec<f64> = (0..n)
                    .map(|i| (origin[i] - path.nodes[i]) / scales[i])
                    .collect();
                let scaled: Vec<f64> = (0..n).map(|i| direction[i] / scales[i]).collect();
                let so_far: f64 = (0..n)
                    .map(|i| tangent[1 + i] * (path.nodes[n + i] / scales[n + i] - from[1 + i]))
                    .sum();
                let start = Start::Line {
                    excess: &excess,
                    direction: &scaled,
                    along: tangent,
                    advance: advance - so_far + tangent[0] * from[0],
                };
                let mut steps = factors.solve(defects, end, &start)?;
                let t = steps.pop()?;
                Some((steps, t))
            }
        }
    }

    /// The scaled step of the first node's state to `s`.
    pub(super) fn wanted(&self, path: &Path, s: &[f64]) -> Vec<f64> {
        let scaled = path.start().iter().zip(&self.equations.scales);
        s.iter()
            .zip(scaled)
            .map(|(s, (z, scale))| (s - z) / scale)
            .collect()
    }

    /// Tries a step unless it leads far from where the equations were linearized: what is found
    /// there would be an accident.
    fn try_within(&self, job: &mut Job, steps: Vec<f64>, t: f64) {
        let norm = largest(&steps);
        let scales = &self.equations.scales;
        let shift = match &job.goal {
            Goal::State(s) => largest(&self.wanted(&job.path, s)),
            Goal::Line { advance, .. } => advance.abs(),
        };
        let most = MOST_STEP * job.path.size(scales).max(shift);
        if norm > most {
            return job.fail(Failure::Diverged);
        }
        self.try_step(job, steps, t, 1.0);
    }

    fn try_step(&self, job: &mut Job, steps: Vec<f64>, t: f64, damping: f64) {
        let norm = largest(&steps);
        job.stage = Stage::Try(Trial {
            path: job.path.moved(&steps, &self.equations.scales, damping),
            t,
            steps,
            norm,
            damping,
        });
    }

    /// Puts the matrix at the solution in place of the last one of the iterations.
    pub(super) fn renewed(&self, job: &mut Job, done: Integrated) {
        if done.failure.is_some() {
            return;
        }
        let residual = self.residual(&job.path, &done);
        job.factors = Factors::new(self.equations.states, done.phi, &residual.hessian);
        if let Some(Ok(solved)) = &mut job.outcome {
            (solved.slope, solved.fold) = job.factors.slope();
        }
    }

    /// The linear equations of a job whose segments have been integrated; `None` where that failed.
    pub(super) fn linear(&self, job: &mut Job, done: Integrated) -> Option<Linear> {
        job.iterations += 1;
        if let Some(why) = done.failure {
            job.fail(why);
            return None;
        }
        if job.iterations > job.goal.most_rounds() {
            job.fail(Failure::Iterations);
            return None;
        }
        let residual = self.residual(&job.path, &done);
        Some(Linear {
            phi: done.phi,
            residual,
        })
    }

    /// Eliminates a job's linear equations and solves them for its goal.
    pub(super) fn eliminate(&self, job: &Job, linear: Linear) -> Elimination {
        let Linear { phi, residual } = linear;
        let factors = Factors::new(self.equations.states, phi, &residual.hessian);
        let step = self.step(
            &job.path,
            &job.goal,
            &factors,
            &residual.defects,
            &residual.end,
        );
        Elimination { factors, step }
    }

    /// The step of a linearized job; or the segments that must be split first.
    pub(super) fn linearized(&self, job: &mut Job, eliminated: Elimination) -> Vec<usize> {
        job.factors = eliminated.factors;
        let long: Vec<usize> = (job.factors.growth().enumerate())
            .filter(|(_, g)| *g > MOST_GROWTH)
            .map(|(k, _)| k)
            .collect();
        if !long.is_empty() && job.path.segments() + long.len() <= MOST_SEGMENTS {
            return long;
        }
        match eliminated.step {
            Some((steps, t)) => self.try_within(job, steps, t),
            None => job.fail(Failure::Singular),
        }
        Vec::new()
    }

    /// Decides on a trial.
    pub(super) fn attempted(&self, job: &mut Job, done: &Integrated) {
        job.iterations += 1;
        let Stage::Try(trial) = std::mem::replace(&mut job.stage, Stage::Linearize) else {
            return;
        };
        let found = if done.failure.is_some() {
            None
        } else {
            let residual = self.residual(&trial.path, done);
            let step = self.step(
                &trial.path,
                &job.goal,
                &job.factors,
                &residual.defects,
                &residual.end,
            );
            step.map(|(steps, t)| (residual, steps, t))
        };
        let Some((residual, steps, t)) = found else {
            return self.damp(job, trial, done.failure.unwrap_or(Failure::Singular));
        };
        let norm = largest(&steps);
        let size = trial.path.size(&self.equations.scales);
        if trial.damping == 1.0 && norm <= ROUGH * size && !job.rough && !job.fine {
            // The matrix is good enough for what is left to do to the full tolerance.
            job.fine = true;
            job.path = trial.path;
            self.try_step(job, steps, t, 1.0);
            if let Stage::Try(trial) = &mut job.stage {
                // What the rough segments gave is no measure for the fine ones.
                trial.norm = f64::INFINITY;
            }
            return;
        }
        let tolerance = if job.rough {
            self.tolerance.max(ROUGH)
        } else {
            self.tolerance
        };
        if trial.damping == 1.0 && norm <= tolerance * size {
            // The correction counts: it is the last step.
            job.path = trial.path.moved(&steps, &self.equations.scales, 1.0);
            if !self.ends_well(job, residual.value) {
                return;
            }
            let (slope, fold) = job.factors.slope();
            job.outcome = Some(Ok(Solved {
                value: residual.value,
                slope,
                fold,
                residual: if size > 0.0 { norm / size } else { 0.0 },
                t,
            }));
            job.stage = Stage::Done;
            return;
        }
        let contracts = norm <= (1.0 - 0.5 * trial.damping) * trial.norm;
        if !contracts {
            return self.damp(job, trial, Failure::Diverged);
        }
        if job.iterations > job.goal.most_rounds() {
            return job.fail(Failure::Iterations);
        }
        job.path = trial.path;
        if trial.damping == 1.0 && norm <= KEEP * trial.norm {
            self.try_step(job, steps, t, 1.0);
        }
    }

    /// Whether a solved path's end lies where its condition holds; the path is made longer where it
    /// does not.
    fn ends_well(&self, job: &mut Job, value: f64) -> bool {
        let n = self.equations.states;
        let s = job.path.last()[..n].to_vec();
        if self.end.holds(&s, value) {
            return true;
        }
        let (nodes, durations) = self.end.tail(&s, value, self.duration);
        if durations.is_empty() || job.path.segments() + durations.len() > MOST_SEGMENTS {
            job.fail(Failure::Horizon);
            return false;
        }
        job.path.append(&nodes, &durations);
        job.stage = Stage::Linearize;
        false
    }

    /// Tries half of a step that does not contract.
    fn damp(&self, job: &mut Job, trial: Trial, why: Failure) {
        let damping = 0.5 * trial.damping;
        if damping < LEAST_DAMPING || job.iterations > job.goal.most_rounds() {
            // Near a solution it may be the rough segments that do not let the residual fall any
            // further.
            if !job.fine && trial.norm <= NEAR * trial.path.size(&self.equations.scales) {
                job.fine = true;
                return;
            }
            return job.fail(why);
        }
        self.try_step(job, trial.steps, trial.t, damping);
    }

    /// Defects, the end's condition and V of a path whose segments have been integrated.
    fn residual(&self, path: &Path, done: &Integrated) -> Residual {
        let n = self.equations.states;
        let (width, scales) = (2 * n, &self.equations.scales);
        let mut defects = Vec::with_capacity(done.ends.len());
        let mut value = 0.0;
        for (k, end) in done.ends.chunks(width).enumerate() {
            let next = path.node(k + 1);
            let gap: Vec<f64> = end.iter().zip(next).map(|(e, z)| e - z).collect();
            value += done.costs[k] + (0..n).map(|i| next[n + i] * gap[i]).sum::<f64>();
            defects.extend(gap.iter().zip(scales).map(|(g, s)| g / s));
        }
        let last = path.last();
        let at = self.end.at(&last[..n]);
        value += at.value;
        let end = (0..n)
            .map(|i| (at.gradient[i] - last[n + i]) / scales[n + i])
            .collect();
        let hessian = self.equations.scaled_slope(&at.hessian);
        Residual {
            defects,
            end,
            hessian,
            value,
        }
    }
}

fn largest(values: &[f64]) -> f64 {
    values.iter().fold(0.0, |a, x| a.max(x.abs()))
}
