//! Newton's iterations over many problems: the segments of all of them are one batch of a backend.

use super::device;
use super::elimination::Factors;
use super::newton::{Elimination, Failure, Goal, Integrated, Job, Linear, Scheme, Stage};
use super::path::Path;
use crate::backend::{
    Backend, BackendError, Deadline, Eliminator, Kernel, Newton, Run, Status, Trajectories,
};
use crate::model::{Method, Precision};
use rayon::prelude::*;
use std::ops::AddAssign;

/// Bytes of seeds or linear equations handed to a backend at once.
const BATCH_BYTES: usize = 32 << 20;
/// Tolerance of segments until a solution is good to some digits.
const ROUGH_RTOL: f64 = 1e-6;
/// Attempted steps a segment.
const SEGMENT_STEPS: u32 = 20_000;

/// What was done so far.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Work {
    /// Segments integrated with and without variations.
    pub varied: u64,
    pub plain: u64,
    /// Accepted steps of both.
    pub steps: u64,
    pub seconds_integrating: f64,
    pub seconds_eliminating: f64,
    pub rounds: u64,
}

impl AddAssign for Work {
    fn add_assign(&mut self, other: Self) {
        self.varied += other.varied;
        self.plain += other.plain;
        self.steps += other.steps;
        self.seconds_integrating += other.seconds_integrating;
        self.seconds_eliminating += other.seconds_eliminating;
        self.rounds += other.rounds;
    }
}

/// Ends `[segment][2n]` and costs of a path's segments.
pub type Ends = (Vec<f64>, Vec<f64>);

/// Solves batches of problems on a backend.
pub struct Solver {
    pub scheme: Scheme,
    plain: Box<dyn Kernel>,
    varied: Box<dyn Kernel>,
    /// Settings for rough and for fine segments.
    plain_runs: [Run; 2],
    varied_runs: [Run; 2],
    /// Eliminates on the device, where the backend does that.
    eliminator: Option<Box<dyn Eliminator>>,
    /// Iterates on the device as a whole, where the backend does that.
    newton: Option<Box<dyn Newton>>,
    pub work: Work,
    /// When it gives up: for those who can do without what they asked for.
    pub deadline: Deadline,
    /// Solves first, on another device or in another precision; what it finds are guesses here.
    draft: Option<Box<Solver>>,
    /// The last batch, whose memory the next one uses again.
    last: Trajectories,
    /// Solvers like this one, for parts of what it is to solve.
    forks: Vec<Solver>,
}

impl Solver {
    /// Segments are integrated to `rtol`; the scheme's tolerance should not be below it.
    ///
    /// # Errors
    /// What [`Backend::compile`] refuses.
    pub fn new(
        backend: &dyn Backend,
        precision: Precision,
        scheme: Scheme,
        rtol: f64,
    ) -> Result<Self, BackendError> {
        let method = Method::Dop853;
        let equations = &scheme.equations;
        let rtols = [rtol.max(ROUGH_RTOL), rtol];
        let varied = equations.varied_spec(method, precision);
        let varied_runs = rtols.map(|r| equations.varied_run(r, SEGMENT_STEPS));
        Ok(Self {
            plain: backend.compile(&equations.plain_spec(method, precision))?,
            varied: backend.compile(&varied)?,
            plain_runs: rtols.map(|r| equations.plain_run(r, SEGMENT_STEPS)),
            newton: device::newton(backend, &scheme, varied, varied_runs.clone())?,
            varied_runs,
            eliminator: backend.eliminator(equations.states, precision)?,
            scheme,
            work: Work::default(),
            deadline: Deadline::default(),
            draft: None,
            last: Trajectories::default(),
            forks: Vec::new(),
        })
    }

    /// A solver that does what this one does, on one more thread; `None` where it is a device's, or
    /// a draft comes first.
    fn fork(&self) -> Option<Self> {
        if self.draft.is_some() || self.eliminator.is_some() {
            return None;
        }
        Some(Self {
            scheme: self.scheme.clone(),
            plain: self.plain.fork()?,
            varied: self.varied.fork()?,
            plain_runs: self.plain_runs.clone(),
            varied_runs: self.varied_runs.clone(),
            eliminator: None,
            newton: None,
            work: Work::default(),
            deadline: self.deadline,
            draft: None,
            last: Trajectories::default(),
            forks: Vec::new(),
        })
    }

    /// Solves each part with a solver of its own, on all threads; `None` where there is this one
    /// only.
    pub fn apart<P: Send>(
        &mut self,
        parts: impl IndexedParallelIterator<Item = P>,
        solve: impl Fn(&mut Solver, P) -> Result<(), BackendError> + Sync,
    ) -> Option<Result<(), BackendError>> {
        let deadline = self.deadline;
        let mut forks = std::mem::take(&mut self.forks);
        while forks.len() < parts.len() {
            forks.push(self.fork()?);
        }
        let done = (parts.zip(&mut forks)).try_for_each(|(part, fork)| {
            fork.deadline = deadline;
            solve(fork, part)
        });
        for fork in &mut forks {
            self.work += std::mem::take(&mut fork.work);
        }
        self.forks = forks;
        Some(done)
    }

    /// This solver after a draft by another one.
    #[must_use]
    pub fn after(mut self, draft: Solver) -> Self {
        self.draft = Some(Box::new(draft));
        self
    }

    /// Solves all jobs that have no outcome yet. A job's result does not depend on the others.
    ///
    /// # Errors
    /// Device failures only; a problem that fails has its [`Failure`].
    pub fn solve(&mut self, jobs: &mut [Job]) -> Result<(), BackendError> {
        let Some(mut draft) = self.draft.take() else {
            return self.solve_here(jobs);
        };
        let drafted = draft.draft_of(jobs);
        self.draft = Some(draft);
        let drafted = drafted?;
        self.solve_here(jobs)?;
        // Each solver has a budget of its own; both count.
        for (k, iterations) in drafted {
            jobs[k].iterations += iterations;
        }
        Ok(())
    }

    /// Puts this solver's solutions in place of the jobs' guesses, where it finds any; the
    /// iterations of each.
    fn draft_of(&mut self, jobs: &mut [Job]) -> Result<Vec<(usize, u32)>, BackendError> {
        let open: Vec<usize> = (0..jobs.len())
            .filter(|k| jobs[*k].outcome.is_none() && matches!(jobs[*k].goal, Goal::State(_)))
            .collect();
        let mut drafts: Vec<Job> = (open.iter())
            .map(|k| Job::new(jobs[*k].path.clone(), jobs[*k].goal.clone()))
            .collect();
        let told: Vec<(bool, u32)> = if self.newton.is_some() {
            // What needs damping is left to the solver behind: it waits for no device.
            self.refine(&mut drafts)?
        } else {
            self.solve_here(&mut drafts)?;
            let told = drafts.iter().map(|d| (d.solved().is_some(), d.iterations));
            told.collect()
        };
        let mut iterations = Vec::with_capacity(open.len());
        for ((k, draft), (is_solved, took)) in open.into_iter().zip(drafts).zip(told) {
            iterations.push((k, took));
            if is_solved {
                jobs[k].path = draft.path;
                jobs[k].factors = Default::default();
            }
        }
        Ok(iterations)
    }

    /// Newton's method on the device alone, where it does that, without damping: of each job whether
    /// its path meets the tolerance now, and how many iterations it took. Jobs stay without an outcome,
    /// and those that are not solved as they were.
    ///
    /// # Errors
    /// Device failures only.
    pub fn refine(&mut self, jobs: &mut [Job]) -> Result<Vec<(bool, u32)>, BackendError> {
        let Some(newton) = &mut self.newton else {
            return Ok(vec![(false, 0); jobs.len()]);
        };
        let clock = std::time::Instant::now();
        let limits = (BATCH_BYTES, self.deadline);
        let refined = device::refine(newton.as_mut(), &self.scheme, jobs, limits)?;
        self.work.seconds_integrating += clock.elapsed().as_secs_f64();
        Ok(refined)
    }

    fn solve_here(&mut self, jobs: &mut [Job]) -> Result<(), BackendError> {
        for job in jobs.iter_mut().filter(|j| j.outcome.is_none()) {
            self.scheme.begin(job);
        }
        while self.round(jobs.iter_mut())? {}
        Ok(())
    }

    /// Whether problems are solved here alone, so that each may go on by itself: see
    /// [`Self::round`].
    pub fn is_alone(&self) -> bool {
        self.draft.is_none()
    }

    /// One step of Newton's method of all jobs that are not done; whether there were any. Each job
    /// must have begun (see [`Scheme::begin`]). What becomes of it does not depend on the others.
    ///
    /// # Errors
    /// Device failures only.
    pub fn round<'j>(
        &mut self,
        jobs: impl Iterator<Item = &'j mut Job>,
    ) -> Result<bool, BackendError> {
        let mut linearize: Vec<&mut Job> = Vec::new();
        let mut attempt: Vec<&mut Job> = Vec::new();
        for job in jobs {
            match job.stage {
                Stage::Linearize => linearize.push(job),
                Stage::Try(_) => attempt.push(job),
                Stage::Done => {}
            }
        }
        if linearize.is_empty() && attempt.is_empty() {
            return Ok(false);
        }
        self.work.rounds += 1;
        self.attempt(&mut attempt)?;
        self.linearize(&mut linearize)?;
        Ok(true)
    }

    fn linearize(&mut self, jobs: &mut [&mut Job]) -> Result<(), BackendError> {
        let done = {
            let paths: Vec<(&Path, bool)> = jobs.iter().map(|j| (&j.path, j.fine)).collect();
            self.integrate(&paths, true)?
        };
        let clock = std::time::Instant::now();
        let scheme = &self.scheme;
        let linear: Vec<Option<Linear>> = (jobs.par_iter_mut().zip(done))
            .map(|(job, done)| scheme.linear(job, done))
            .collect();
        let eliminated = self.eliminate(jobs, linear)?;
        let scheme = &self.scheme;
        let long: Vec<Vec<usize>> = (jobs.par_iter_mut().zip(eliminated))
            .map(|(job, eliminated)| {
                eliminated.map_or_else(Vec::new, |e| scheme.linearized(job, e))
            })
            .collect();
        self.work.seconds_eliminating += clock.elapsed().as_secs_f64();
        self.split(jobs, &long)
    }

    /// States and adjoints `[point][2n]` between the nodes of some paths, `pieces - 1` of them in
    /// each segment.
    ///
    /// # Errors
    /// Device failures only.
    pub fn between_nodes(
        &mut self,
        paths: &[&Path],
        pieces: usize,
    ) -> Result<Vec<Vec<f64>>, BackendError> {
        let parts: Vec<Path> = (paths.iter())
            .map(|path| {
                let mut part = Path {
                    width: path.width,
                    ..Path::default()
                };
                for (k, duration) in path.durations.iter().enumerate() {
                    for q in 1..pieces {
                        part.push(duration * q as f64 / pieces as f64, path.node(k));
                    }
                }
                part.nodes.extend_from_slice(path.last());
                part
            })
            .collect();
        let all: Vec<(&Path, bool)> = parts.iter().map(|p| (p, false)).collect();
        Ok(self
            .integrate(&all, false)?
            .into_iter()
            .map(|done| done.ends)
            .collect())
    }

    /// Ends `[segment][2n]` and costs of a path's segments.
    ///
    /// # Errors
    /// Device failures only; where a segment fails, what it ended with.
    pub fn ends(&mut self, path: &Path) -> Result<(Vec<f64>, Vec<f64>), BackendError> {
        let mut done = self.integrate(&[(path, true)], false)?;
        let done = done.swap_remove(0);
        Ok((done.ends, done.costs))
    }

    /// The same of many paths, to the rough tolerance or the full one; `None` where a segment
    /// fails.
    ///
    /// # Errors
    /// Device failures only.
    pub fn ends_of(
        &mut self,
        paths: &[&Path],
        fine: bool,
    ) -> Result<Vec<Option<Ends>>, BackendError> {
        let all: Vec<(&Path, bool)> = paths.iter().map(|p| (*p, fine)).collect();
        let done = self.integrate(&all, false)?;
        Ok(done
            .into_iter()
            .map(|d| d.failure.is_none().then_some((d.ends, d.costs)))
            .collect())
    }

    /// Eliminations at paths that are solutions, to the rough tolerance: for their slopes. `None`
    /// where a segment fails.
    ///
    /// # Errors
    /// Device failures only.
    pub fn factors(&mut self, paths: &[&Path]) -> Result<Vec<Option<Factors>>, BackendError> {
        let all: Vec<(&Path, bool)> = paths.iter().map(|p| (*p, false)).collect();
        let done = self.integrate(&all, true)?;
        let Scheme { equations, end, .. } = &self.scheme;
        let n = equations.states;
        Ok((paths.par_iter().zip(done))
            .map(|(path, done)| {
                let hessian = equations.scaled_slope(&end.at(&path.last()[..n]).hessian);
                done.failure
                    .is_none()
                    .then(|| Factors::new(n, done.phi, &hessian))
            })
            .collect())
    }

    /// Linearizes solved jobs at their solutions: the matrix left by the iterations is that of a
    /// guess.
    ///
    /// # Errors
    /// Device failures only.
    pub fn renew(&mut self, jobs: &mut [Job]) -> Result<(), BackendError> {
        let mut solved: Vec<&mut Job> = jobs.iter_mut().filter(|j| j.solved().is_some()).collect();
        let done = {
            let paths: Vec<(&Path, bool)> = solved.iter().map(|j| (&j.path, true)).collect();
            self.integrate(&paths, true)?
        };
        let scheme = &self.scheme;
        (solved.par_iter_mut().zip(done)).for_each(|(job, done)| scheme.renewed(job, done));
        Ok(())
    }

    /// Eliminates the jobs' equations: those of given states on the device where it does that,
    /// others here.
    fn eliminate(
        &mut self,
        jobs: &[&mut Job],
        mut linear: Vec<Option<Linear>>,
    ) -> Result<Vec<Option<Elimination>>, BackendError> {
        let scheme = &self.scheme;
        let mut eliminated: Vec<Option<Elimination>> = jobs.iter().map(|_| None).collect();
        if let Some(eliminator) = &mut self.eliminator {
            let (mut places, mut problems) = (Vec::new(), Vec::new());
            for (place, (job, linear)) in jobs.iter().zip(&mut linear).enumerate() {
                let Goal::State(s) = &job.goal else { continue };
                let Some(linear) = linear.take() else {
                    continue;
                };
                places.push(place);
                problems.push((linear, scheme.wanted(&job.path, s)));
            }
            let done = device::eliminate(
                eliminator.as_mut(),
                scheme.equations.states,
                problems,
                BATCH_BYTES,
            )?;
            for (place, done) in places.into_iter().zip(done) {
                eliminated[place] = Some(done);
            }
        }
        (jobs.par_iter().zip(linear).zip(&mut eliminated)).for_each(
            |((job, linear), eliminated)| {
                if let Some(linear) = linear {
                    *eliminated = Some(scheme.eliminate(job, linear));
                }
            },
        );
        Ok(eliminated)
    }

    /// Splits the given segments of each job's path in halves.
    fn split(&mut self, jobs: &mut [&mut Job], long: &[Vec<usize>]) -> Result<(), BackendError> {
        let halves: Vec<Path> = (jobs.iter().zip(long))
            .filter(|(_, long)| !long.is_empty())
            .map(|(job, long)| {
                let mut nodes = Vec::new();
                for &k in long {
                    nodes.extend_from_slice(job.path.node(k));
                }
                // A path of unconnected segments; the last node is not used.
                nodes.extend_from_slice(job.path.last());
                Path {
                    width: job.path.width,
                    nodes,
                    durations: long.iter().map(|k| 0.5 * job.path.durations[*k]).collect(),
                }
            })
            .collect();
        if halves.is_empty() {
            return Ok(());
        }
        let done = self.integrate(&halves.iter().map(|p| (p, true)).collect::<Vec<_>>(), false)?;
        let mut done = done.into_iter();
        for (job, long) in jobs
            .iter_mut()
            .zip(long)
            .filter(|(_, long)| !long.is_empty())
        {
            let Some(halves) = done.next() else { break };
            if let Some(why) = halves.failure {
                job.fail(why);
                continue;
            }
            job.path.split(long, &halves.ends);
            job.stage = Stage::Linearize;
        }
        Ok(())
    }

    fn attempt(&mut self, jobs: &mut [&mut Job]) -> Result<(), BackendError> {
        let done = {
            let paths: Vec<(&Path, bool)> = (jobs.iter())
                .filter_map(|j| match &j.stage {
                    Stage::Try(trial) => Some((&trial.path, j.fine)),
                    _ => None,
                })
                .collect();
            self.integrate(&paths, false)?
        };
        let clock = std::time::Instant::now();
        let scheme = &self.scheme;
        (jobs.par_iter_mut().zip(done)).for_each(|(job, done)| scheme.attempted(job, &done));
        self.work.seconds_eliminating += clock.elapsed().as_secs_f64();
        Ok(())
    }

    /// Integrates all segments of some paths, each to the full tolerance or not, as batches of
    /// bounded size.
    fn integrate(
        &mut self,
        paths: &[(&Path, bool)],
        varied: bool,
    ) -> Result<Vec<Integrated>, BackendError> {
        let of = |fine: bool| {
            paths
                .iter()
                .filter(move |p| p.1 == fine)
                .map(|p| p.0)
                .collect::<Vec<_>>()
        };
        let (rough, fine) = (of(false), of(true));
        let mut rough = self.integrate_alike(&rough, varied, false)?.into_iter();
        let mut fine = self.integrate_alike(&fine, varied, true)?.into_iter();
        let next = |is_fine: bool| if is_fine { fine.next() } else { rough.next() };
        Ok(paths.iter().map(|p| p.1).filter_map(next).collect())
    }

    fn integrate_alike(
        &mut self,
        paths: &[&Path],
        varied: bool,
        fine: bool,
    ) -> Result<Vec<Integrated>, BackendError> {
        self.deadline.check()?;
        let clock = std::time::Instant::now();
        let each = if varied {
            self.scheme.equations.varied_width() * self.scheme.equations.groups()
        } else {
            self.scheme.equations.plain_width()
        };
        let most = (BATCH_BYTES / (8 * each)).max(1);
        let mut done = Vec::with_capacity(paths.len());
        let mut first = 0;
        while first < paths.len() {
            let mut segments = 0;
            let mut next = first;
            while next < paths.len() && (next == first || segments + paths[next].segments() <= most)
            {
                segments += paths[next].segments();
                next += 1;
            }
            done.extend(self.batch(&paths[first..next], varied, fine)?);
            first = next;
        }
        self.work.seconds_integrating += clock.elapsed().as_secs_f64();
        Ok(done)
    }

    fn batch(
        &mut self,
        paths: &[&Path],
        varied: bool,
        fine: bool,
    ) -> Result<Vec<Integrated>, BackendError> {
        let seeds = self.scheme.seeds(paths, varied);
        let (kernel, run) = if varied {
            (&mut self.varied, &self.varied_runs[usize::from(fine)])
        } else {
            (&mut self.plain, &self.plain_runs[usize::from(fine)])
        };
        let result = &mut self.last;
        kernel.integrate_into(run, &seeds, result)?;
        self.work.steps += result.steps.iter().map(|s| u64::from(*s)).sum::<u64>();
        let groups = if varied {
            self.scheme.equations.groups()
        } else {
            1
        };
        let segments = result.count() / groups;
        if varied {
            self.work.varied += segments as u64;
        } else {
            self.work.plain += segments as u64;
        }
        let mut offsets = Vec::with_capacity(paths.len());
        let mut first = 0;
        for path in paths {
            offsets.push(first);
            first += path.segments();
        }
        let scheme = &self.scheme;
        Ok((paths.par_iter().zip(offsets))
            .map(|(path, first)| {
                let range = first * groups..(first + path.segments()) * groups;
                let width = result.dim;
                let ends = &result.end[range.start * width..range.end * width];
                scheme.integrated(ends, &result.status[range], varied)
            })
            .collect())
    }
}

impl Scheme {
    fn seeds(&self, paths: &[&Path], varied: bool) -> Vec<f64> {
        let n2 = 2 * self.equations.states;
        let segments: usize = paths.iter().map(|p| p.segments()).sum();
        let columns = self.equations.columns;
        let (groups, width) = if varied {
            (self.equations.groups(), self.equations.varied_width())
        } else {
            (1, self.equations.plain_width())
        };
        let mut seeds = vec![0.0; segments * groups * width];
        let mut rows = seeds.chunks_mut(width);
        for path in paths {
            for (k, duration) in path.durations.iter().enumerate() {
                let size = self.equations.size(path.node(k));
                for group in 0..groups {
                    let Some(row) = rows.next() else { return seeds };
                    for (y, z) in row.iter_mut().zip(path.node(k)) {
                        *y = z / size;
                    }
                    row[n2] = *duration;
                    row[n2 + 1] = size;
                    if varied {
                        for c in 0..columns {
                            row[n2 + 2 + c * n2 + group * columns + c] = 1.0;
                        }
                    }
                }
            }
        }
        seeds
    }

    fn integrated(&self, ends: &[f64], status: &[Status], varied: bool) -> Integrated {
        let n2 = 2 * self.equations.states;
        let scales = &self.equations.scales;
        let failure = status
            .iter()
            .find(|s| **s != Status::Reached)
            .map(|s| match s {
                Status::StepLimit | Status::StepFloor => Failure::Integration,
                _ => Failure::NotFinite,
            });
        let mut done = Integrated {
            ends: Vec::new(),
            costs: Vec::new(),
            phi: Vec::new(),
            failure,
        };
        if !varied {
            for row in ends.chunks(self.equations.plain_width()) {
                let size = row[n2 + 1];
                done.ends.extend(row[..n2].iter().map(|y| y * size));
                done.costs.push(row[n2 + 2] * size * size);
            }
            return done;
        }
        let (groups, columns, width) = (
            self.equations.groups(),
            self.equations.columns,
            self.equations.varied_width(),
        );
        let segments = ends.len() / (groups * width);
        done.costs = vec![0.0; segments];
        done.phi = vec![0.0; segments * n2 * n2];
        for (rows, phi) in ends
            .chunks(groups * width)
            .zip(done.phi.chunks_mut(n2 * n2))
        {
            done.ends
                .extend(rows[..n2].iter().map(|y| y * rows[n2 + 1]));
            for group in 0..groups {
                for c in 0..columns {
                    let j = group * columns + c;
                    for i in 0..n2 {
                        let value = rows[group * width + n2 + 2 + c * n2 + i];
                        phi[i * n2 + j] = value * scales[j] / scales[i];
                    }
                }
            }
        }
        done
    }
}
