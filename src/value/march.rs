//! Finite horizons by continuation in the horizon: from one so short that the state hardly moves to
//! the scene's.
//!
//! Longer guesses are made in two ways, both tried at once: all durations stretched, or time spent
//! where the path moves slowest, which is what a long horizon adds to a path that rests near a
//! turnpike (R. Dorfman, P. Samuelson, R. Solow, Linear Programming and Economic Analysis, 1958,
//! ch. 12).

use super::approach::{Approach, follow};
use super::extremal::Extremal;
use super::survey::{Miss, PointStatus, Survey};
use crate::backend::BackendError;
use crate::program::Program;
use crate::shooting::{Failure, Goal, Job, Path, Solved, Solver};
use crate::sweep::Plan;

/// The first horizon: within it the state moves by about this share of its size.
const FIRST: f64 = 0.25;
/// Segments of the first path.
const FIRST_SEGMENTS: usize = 8;
/// Shorter first horizons that are tried at once, each this share of the one before, and how many
/// times.
const SHORTER: f64 = 1.0 / 8.0;
const FIRST_LENGTHS: usize = 3;
const FIRST_ROUNDS: usize = 4;
/// The factor `exp(step)` by which the horizon grows at first, at most, and at least.
const STEP: f64 = std::f64::consts::LN_2;
const MOST_STEP: f64 = 2.0 * STEP;
const LEAST_STEP: f64 = 1e-3;
/// A step that has failed is tried again at this share.
const RATIO: f64 = 0.4;
/// Rounds of steps.
const MOST_ROUNDS: u32 = 120;
/// All of the horizon that is left is spent at the slowest point at once where its state moves by
/// less than this share of the path's size in that time.
const AT_REST: f64 = 0.5;
/// Values nearer to each other than this, relative to the larger, may be one: points on the way are
/// solved to a few digits.
const SAME_VALUE: f64 = 1e-2;
/// The second way begins at this share of the deviation, and its shortest step as a share of the
/// way.
const SMALL: f64 = 1.0 / 16.0;
const SHORT: f64 = 1.0 / 1024.0;
/// States of a system from which on both ways are taken: there is no other search.
const MANY_STATES: usize = 4;
/// Marches that go on together.
const COHORT: usize = 1024;

/// What comes of one state: the problem with its path, and its solution.
pub type Marched = Result<(Job, Solved), Failure>;

/// Solves a finite-horizon plan's boundary value problem from each of some states (deviations, n
/// each): by continuation in the horizon, and where that fails by continuation from a state near
/// the reference point. What comes of a state does not depend on the others. On an infinite horizon
/// every state fails with [`Failure::Horizon`].
///
/// # Errors
/// Device failures only.
pub fn march(
    solver: &mut Solver,
    plan: &Plan,
    starts: &[Vec<f64>],
) -> Result<Vec<Marched>, BackendError> {
    let Some(terminal) = &plan.system.terminal else {
        return Ok(starts.iter().map(|_| Err(Failure::Horizon)).collect());
    };
    let field = Field::new(plan, solver, terminal.time);
    let mut found = Vec::with_capacity(starts.len());
    for part in starts.chunks(COHORT) {
        let mut here = lengthened(solver, &field, part)?;
        from_nearer(solver, &field, part, &mut here)?;
        found.extend(here);
    }
    Ok(found)
}

/// As [`march`], by the second way alone: from a state near the reference point.
///
/// # Errors
/// Device failures only.
pub fn march_from_nearer(
    solver: &mut Solver,
    plan: &Plan,
    starts: &[Vec<f64>],
) -> Result<Vec<Marched>, BackendError> {
    let mut found: Vec<Marched> = starts.iter().map(|_| Err(Failure::Horizon)).collect();
    let Some(terminal) = &plan.system.terminal else {
        return Ok(found);
    };
    let field = Field::new(plan, solver, terminal.time);
    for (part, found) in starts.chunks(COHORT).zip(found.chunks_mut(COHORT)) {
        from_nearer(solver, &field, part, found)?;
    }
    Ok(found)
}

/// Adds the marched solution of every target without a winding to a survey; nothing on an infinite
/// horizon.
pub(super) fn add_marched(
    survey: &mut Survey<'_>,
    solver: &mut Solver,
) -> Result<(), BackendError> {
    if survey.plan.system.terminal.is_none() {
        return Ok(());
    }
    let targets: Vec<usize> = (0..survey.targets.len())
        .filter(|t| {
            survey.misses[*t]
                .as_ref()
                .is_none_or(|m| m.status != PointStatus::OutsideGuard)
        })
        .collect();
    let starts: Vec<Vec<f64>> = targets.iter().map(|t| survey.state(*t, 0)).collect();
    let mut found = march(solver, survey.plan, &starts)?;
    let mut owners = targets.clone();
    if survey.targets.states >= MANY_STATES {
        found.extend(march_from_nearer(solver, survey.plan, &starts)?);
        owners.extend(targets);
    }
    let paths: Vec<&Path> = found.iter().flatten().map(|(job, _)| &job.path).collect();
    let mut valid = survey.valid(solver, &paths)?.into_iter();
    for (target, outcome) in owners.into_iter().zip(found) {
        let Ok((job, solved)) = outcome else { continue };
        survey.evaluations += u64::from(job.iterations);
        if valid.next() == Some(true) {
            survey.add(Extremal {
                target,
                winding: 0,
                iterations: job.iterations,
                path: job.path,
                solved,
            });
        } else {
            survey.misses[target] = Some(Miss {
                status: PointStatus::LeavesGuard,
                furthest: Some(survey.targets.state(target).to_vec()),
                left: 0.0,
                cut: Some(job.path),
            });
        }
    }
    Ok(())
}

/// How fast states and adjoints change.
struct Field {
    /// Backward rates of `(s, p)`.
    rate: Program,
    scales: Vec<f64>,
    /// The scene's horizon, and the longest segment of a guess.
    time: f64,
    segment: f64,
}

impl Field {
    fn new(plan: &Plan, solver: &Solver, time: f64) -> Self {
        let system = &plan.system;
        Self {
            rate: Program::lower(
                &system.graph,
                &system.inputs,
                &system.rate[..2 * system.states],
            ),
            scales: solver.scheme.equations.scales.clone(),
            time,
            segment: plan.segment_duration(),
        }
    }

    /// Largest scaled component of the rate at a node; infinite where it is not defined.
    fn speed(&self, node: &[f64]) -> f64 {
        let rates = self.rate.eval(node);
        let speed = rates.iter().zip(&self.scales).map(|(r, s)| (r / s).abs());
        speed.fold(
            0.0,
            |a, x| if x.is_nan() { f64::INFINITY } else { a.max(x) },
        )
    }
}

/// One state on its way to the scene's horizon.
struct March {
    start: Vec<f64>,
    /// The solution for the horizon reached; none at first.
    job: Option<Job>,
    at: f64,
    /// Before the first solution the longest horizon to try next; then ln of the factor.
    step: f64,
    rounds: u32,
    evaluations: u32,
    outcome: Option<Marched>,
}

/// Continuation in the horizon of all states together.
fn lengthened(
    solver: &mut Solver,
    field: &Field,
    starts: &[Vec<f64>],
) -> Result<Vec<Marched>, BackendError> {
    let mut marches: Vec<March> = starts
        .iter()
        .map(|s| March::new(solver, field, s))
        .collect();
    loop {
        let (mut owners, mut horizons, mut jobs) = (Vec::new(), Vec::new(), Vec::new());
        for (owner, march) in marches
            .iter()
            .enumerate()
            .filter(|(_, m)| m.outcome.is_none())
        {
            for (path, horizon) in march.guesses(solver, field) {
                let mut job = Job::new(path, Goal::State(march.start.clone()));
                job.rough = horizon < field.time;
                owners.push(owner);
                horizons.push(horizon);
                jobs.push(job);
            }
        }
        if jobs.is_empty() {
            let unfinished = Err(Failure::Diverged);
            return Ok(marches
                .into_iter()
                .map(|m| m.outcome.unwrap_or_else(|| unfinished.clone()))
                .collect());
        }
        solver.solve(&mut jobs)?;
        let mut tried: Vec<Vec<(f64, Job)>> = marches.iter().map(|_| Vec::new()).collect();
        for ((owner, horizon), job) in owners.into_iter().zip(horizons).zip(jobs) {
            tried[owner].push((horizon, job));
        }
        for (march, tried) in marches.iter_mut().zip(tried).filter(|(_, t)| !t.is_empty()) {
            march.learn(field, tried);
        }
    }
}

impl March {
    fn new(solver: &Solver, field: &Field, start: &[f64]) -> Self {
        let node = [start, &solver.scheme.end.at(start).gradient].concat();
        let size = Path::new(&node).size(&field.scales);
        let first = FIRST * size / field.speed(&node);
        Self {
            start: start.to_vec(),
            job: None,
            at: 0.0,
            // A state at rest stays there for any time.
            step: if first.is_nan() {
                field.time
            } else {
                first.min(field.time)
            },
            rounds: 0,
            evaluations: 0,
            outcome: None,
        }
    }

    /// The next guesses with their horizons.
    fn guesses(&self, solver: &Solver, field: &Field) -> Vec<(Path, f64)> {
        let Some(job) = &self.job else {
            let lengths = (0..FIRST_LENGTHS).map(|k| self.step * SHORTER.powi(k as i32));
            let node = [
                self.start.as_slice(),
                &solver.scheme.end.at(&self.start).gradient,
            ]
            .concat();
            return lengths
                .map(|length| (constant(&node, length), length))
                .collect();
        };
        let mut guesses = Vec::new();
        let slowest = field.slowest(&job.path);
        let left = field.time - self.at;
        let size = job.path.size(&field.scales);
        if field.speed(job.path.node(slowest)) * left <= AT_REST * size {
            guesses.push((
                waiting(&job.path, slowest, field.time, field.segment),
                field.time,
            ));
        }
        let horizon = field.time.min(self.at * self.step.exp());
        if horizon < field.time || guesses.is_empty() {
            guesses.push((waiting(&job.path, slowest, horizon, field.segment), horizon));
        }
        let mut stretched = job.path.clone();
        stretched.set_horizon(horizon);
        guesses.push((stretched, horizon));
        guesses
    }

    /// Takes the longest horizon that was solved; of two paths for it the one that costs less.
    fn learn(&mut self, field: &Field, tried: Vec<(f64, Job)>) {
        self.rounds += 1;
        self.evaluations += tried.iter().map(|(_, job)| job.iterations).sum::<u32>();
        let why = tried.iter().find_map(|(_, job)| job.failure());
        let shortest = tried
            .iter()
            .map(|(horizon, _)| *horizon)
            .fold(f64::INFINITY, f64::min);
        let mut best: Option<(f64, f64, Job)> = None;
        for (horizon, job) in tried {
            let Some(value) = job.solved().map(|s| s.value) else {
                continue;
            };
            let better = best.as_ref().is_none_or(|(known, least, _)| {
                let cheaper = least - value > SAME_VALUE * least.abs().max(value.abs());
                horizon > *known || (horizon == *known && cheaper)
            });
            if better {
                best = Some((horizon, value, job));
            }
        }
        match best {
            Some((horizon, _, mut job)) if horizon == field.time => {
                job.iterations = self.evaluations;
                self.outcome = job
                    .outcome
                    .take()
                    .map(|solved| solved.map(|solved| (job, solved)));
            }
            Some((horizon, _, mut job)) => {
                let step = if self.job.is_none() {
                    STEP
                } else {
                    2.0 * (horizon / self.at).ln()
                };
                self.step = step.min(MOST_STEP);
                self.at = horizon;
                // Of no use for another horizon.
                job.factors = Default::default();
                self.job = Some(job);
            }
            None if self.job.is_none() => self.step = SHORTER * shortest,
            None => self.step *= RATIO,
        }
        let beginning = self.job.is_none() && self.rounds >= FIRST_ROUNDS as u32;
        let small = self.job.is_some() && self.step < LEAST_STEP;
        if self.outcome.is_none() && (beginning || small || self.rounds >= MOST_ROUNDS) {
            self.outcome = Some(Err(why.unwrap_or(Failure::Diverged)));
        }
    }
}

impl Field {
    /// The node at which a path moves slowest.
    fn slowest(&self, path: &Path) -> usize {
        let speeds = (0..=path.segments()).map(|k| (k, self.speed(path.node(k))));
        speeds
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .map_or(0, |(k, _)| k)
    }
}

/// A path that stays where it begins.
fn constant(node: &[f64], horizon: f64) -> Path {
    let mut path = Path::new(node);
    for _ in 0..FIRST_SEGMENTS {
        path.push(horizon / FIRST_SEGMENTS as f64, node);
    }
    path.set_horizon(horizon);
    path
}

/// A path made longer by waiting at one of its nodes.
fn waiting(path: &Path, at: usize, horizon: f64, segment: f64) -> Path {
    let left = horizon - path.horizon();
    let count = (left / segment).ceil().max(1.0) as usize;
    let mut longer = Path::new(path.node(0));
    for k in 0..=path.segments() {
        if k > 0 {
            longer.push(path.durations[k - 1], path.node(k));
        }
        if k == at {
            (0..count).for_each(|_| longer.push(left / count as f64, path.node(k)));
        }
    }
    longer.set_horizon(horizon);
    longer
}

/// The second way, for states that the first has not solved: a state a little off the reference
/// point is solved by the first, and continued to the state asked for.
fn from_nearer(
    solver: &mut Solver,
    field: &Field,
    starts: &[Vec<f64>],
    found: &mut [Marched],
) -> Result<(), BackendError> {
    let open: Vec<usize> = (0..starts.len()).filter(|k| found[*k].is_err()).collect();
    if open.is_empty() {
        return Ok(());
    }
    let near: Vec<Vec<f64>> = (open.iter())
        .map(|k| starts[*k].iter().map(|s| SMALL * s).collect())
        .collect();
    let begun = lengthened(solver, field, &near)?;
    let (mut owners, mut ways) = (Vec::new(), Vec::new());
    for (k, begun) in open.into_iter().zip(begun) {
        if let Ok((job, _)) = begun {
            owners.push(k);
            ways.push(Approach::from_solution(job.path, starts[k].clone(), SHORT));
        }
    }
    follow(solver, &mut ways)?;
    solver.deadline.check()?;
    for (k, way) in owners.into_iter().zip(ways) {
        if let (evaluations, Ok((mut job, solved))) = way.finish() {
            job.iterations = evaluations;
            found[k] = Ok((job, solved));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::cpu::Cpu;
    use crate::hamiltonian::Hamiltonian;
    use crate::sweep::Choices;

    const PENDULUM: &str = r#"
        states = { th = {}, om = {} }
        controls = { u = {} }
        dynamics = { th = "om", om = "sin(th) + u" }
        cost = { running = "0.5*(th^2 + om^2 + u^2)", terminal = "0.5*(th^2 + om^2)", final_time = 5.0 }
        region = { th = [-2, 2], om = [-2, 2] }
    "#;

    fn plan() -> Plan {
        let model = crate::scenario::parse(PENDULUM, "test.toml", &[]).expect("a scene");
        let hamiltonian = Hamiltonian::derive(&model).expect("a Hamiltonian");
        let choices = Choices {
            unasked: true,
            dispensable: true,
            ..Choices::default()
        };
        Plan::new(&model, &hamiltonian, &Cpu::new(), choices).expect("a plan")
    }

    /// Both ways lead to the same solutions, with all of the horizon.
    #[test]
    fn the_second_way_agrees_with_the_first() {
        let plan = plan();
        let mut solver =
            crate::value::solver(&plan, &Cpu::new()).expect("the CPU compiles everything");
        let starts = [
            vec![0.5, 0.2],
            vec![-1.0, 1.0],
            vec![1.8, 0.3],
            vec![0.0, 0.0],
        ];
        let first = march(&mut solver, &plan, &starts).expect("the CPU works");
        let field = Field::new(&plan, &solver, 5.0);
        let mut second: Vec<_> = starts.iter().map(|_| Err(Failure::Diverged)).collect();
        from_nearer(&mut solver, &field, &starts, &mut second).expect("the CPU works");
        for (start, (first, second)) in starts.iter().zip(first.iter().zip(&second)) {
            let ((a, first), (b, second)) = (
                first.as_ref().expect("solved"),
                second.as_ref().expect("solved"),
            );
            assert_eq!((a.path.horizon(), b.path.horizon()), (5.0, 5.0));
            assert_eq!(
                (a.path.start(), b.path.start()),
                (start.as_slice(), start.as_slice())
            );
            // Segments are integrated to 1e-12.
            assert!(
                (first.value - second.value).abs() <= 1e-11 * first.value,
                "{} {}",
                first.value,
                second.value
            );
        }
    }

    #[test]
    fn a_longer_path_waits_where_it_is_told_to() {
        let mut path = Path::new(&[0.0, 1.0]);
        path.push(0.5, &[1.0, 2.0]);
        path.push(0.25, &[2.0, 3.0]);
        let longer = waiting(&path, 1, 1.75, 0.4);
        assert_eq!(longer.horizon(), 1.75);
        assert_eq!(longer.segments(), 5);
        assert_eq!(
            longer.nodes,
            [0.0, 1.0, 1.0, 2.0, 1.0, 2.0, 1.0, 2.0, 1.0, 2.0, 2.0, 3.0]
        );
        let kept = [longer.durations[0], longer.durations[4]];
        assert_eq!(kept, [0.5, 0.25]);
    }
}
