//! What is integrated: trajectories of the scene's own sweep.

use super::variants::Steps;
use costate::backend::{BackendError, Kernel, Run, Spec, Status, Trajectories, batch_limit};
use costate::low_level::model::{Horizon, Method, Model, Precision};
use costate::low_level::sweep::Plan;
use std::time::Instant;

/// Seeds tried for each one wanted: where guards leave a small part of the seed surface.
const TRIES: usize = 64;

/// Why a scene gives no work.
#[derive(Debug, thiserror::Error)]
pub enum WorkError {
    #[error("only {found} of {tried} seeds tried lie inside the guards; {wanted} are wanted")]
    OutsideGuards {
        found: usize,
        tried: usize,
        wanted: usize,
    },
}

/// Seeds of a scene's sweep, and how far they are integrated.
pub struct Work {
    pub plan: Plan,
    /// Where the seeds lie on the seed surface, a unit vector or fractions of the box each.
    pub parameters: Vec<Vec<f64>>,
    /// `[trajectory][dim]`: deviations, adjoints, V (and arc length).
    pub seeds: Vec<f64>,
    /// Whether the points at all levels are kept, as the sweep does, or only the ends.
    pub store: bool,
}

/// One batch of everything.
#[derive(Clone, Debug, Default)]
pub struct Pass {
    /// From seeds on the host to results on the host (s).
    pub seconds: f64,
    /// In kernels alone (s), where the backend knows.
    pub kernel_seconds: Option<f64>,
    /// The leading trajectories, as many as were to be kept.
    pub kept: Trajectories,
    /// Trajectories by status, in the order of [`Status::ALL`].
    pub statuses: [usize; Status::ALL.len()],
    /// Accepted and rejected steps of all trajectories.
    pub steps: u64,
    pub rejected: u64,
    /// Steps that lanes were computed for; 0 where the backend does not tell.
    pub lane_steps: u64,
}

impl Work {
    /// `count` seeds of a plan, spread evenly over the seed surface; `seed` shifts them all.
    ///
    /// # Errors
    /// [`WorkError::OutsideGuards`] where hardly any part of the surface is inside the guards.
    pub fn new(
        plan: Plan,
        model: &Model,
        count: usize,
        seed: u64,
        store: bool,
    ) -> Result<Self, WorkError> {
        let mut work = Self {
            parameters: Vec::with_capacity(count),
            seeds: Vec::with_capacity(count * plan.spec.dim()),
            store,
            plan,
        };
        let sphere = matches!(model.horizon, Horizon::Infinite { .. });
        let mut even = Even::new(model.states.len(), sphere, seed);
        let most = count.saturating_mul(TRIES);
        let mut tried = 0;
        while work.parameters.len() < count && tried < most {
            tried += 1;
            let parameter = even.next_parameter();
            if let Some(seed) = work.seed(&parameter) {
                work.seeds.extend(seed);
                work.parameters.push(parameter);
            }
        }
        if work.parameters.len() < count {
            return Err(WorkError::OutsideGuards {
                found: work.parameters.len(),
                tried,
                wanted: count,
            });
        }
        Ok(work)
    }

    /// The integrated vector at a parameter; `None` outside the guards.
    pub fn seed(&self, parameter: &[f64]) -> Option<Vec<f64>> {
        let (_, seed, guarded) = self.plan.surface.placed(parameter.to_vec());
        guarded.inside.then(|| self.plan.start(&seed))
    }

    pub fn count(&self) -> usize {
        self.parameters.len()
    }

    /// Number of states.
    pub fn states(&self) -> usize {
        self.plan.system.states
    }

    /// What a kernel for this work is compiled for.
    pub fn spec(&self, method: Method, precision: Precision) -> Spec {
        Spec {
            method,
            precision,
            store: self.store,
            ..self.plan.spec.clone()
        }
    }

    /// The plan's run with other steps. Absolute tolerances keep their proportion to the relative
    /// one.
    pub fn run(&self, steps: Steps) -> Run {
        let mut run = self.plan.run.clone();
        if !self.store {
            // Between stored points bounds are looked at where steps end, which is not the same for
            // all methods.
            run.bounds.clear();
        }
        match steps {
            Steps::Tolerance(rtol) => {
                let share = rtol / run.rtol;
                run.atol.iter_mut().for_each(|a| *a *= share);
                run.rtol = rtol;
            }
            Steps::Fixed(step) => run.step = step,
        }
        run
    }

    /// Integrates `seeds` in batches as the sweep does; keeps the results of the first `keep`
    /// trajectories.
    ///
    /// # Errors
    /// Device failures.
    pub fn integrate(
        &self,
        kernel: &mut dyn Kernel,
        run: &Run,
        seeds: &[f64],
        keep: usize,
    ) -> Result<Pass, BackendError> {
        let dim = self.plan.spec.dim();
        let levels = if self.store { run.levels.len() } else { 0 };
        let mut pass = Pass {
            kernel_seconds: Some(0.0),
            ..Pass::default()
        };
        pass.kept.dim = dim;
        pass.kept.levels = levels;
        for part in seeds.chunks(batch_limit(dim, levels) * dim) {
            let begin = Instant::now();
            let batch = kernel.integrate(run, part)?;
            pass.seconds += begin.elapsed().as_secs_f64();
            pass.kernel_seconds = pass
                .kernel_seconds
                .zip(kernel.kernel_seconds())
                .map(|(a, b)| a + b);
            pass.count(&batch);
            pass.keep(&batch, keep);
        }
        Ok(pass)
    }
}

impl Pass {
    fn count(&mut self, batch: &Trajectories) {
        for ((status, _), count) in Status::ALL.iter().zip(&mut self.statuses) {
            *count += batch.status.iter().filter(|s| *s == status).count();
        }
        self.steps += batch.steps.iter().map(|s| u64::from(*s)).sum::<u64>();
        self.lane_steps += batch.lane_steps;
        self.rejected += batch.rejected.iter().map(|s| u64::from(*s)).sum::<u64>();
    }

    fn keep(&mut self, batch: &Trajectories, most: usize) {
        let kept = &mut self.kept;
        let more = most.saturating_sub(kept.count()).min(batch.count());
        kept.end.extend_from_slice(&batch.end[..more * batch.dim]);
        kept.end_time.extend_from_slice(&batch.end_time[..more]);
        kept.status.extend_from_slice(&batch.status[..more]);
        kept.steps.extend_from_slice(&batch.steps[..more]);
        kept.rejected.extend_from_slice(&batch.rejected[..more]);
        let width = batch.levels * (1 + batch.dim);
        kept.samples
            .extend_from_slice(&batch.samples[..more * width]);
    }
}

/// Points that cover a sphere or a box evenly, any number of them: the additive recurrence `x_k =
/// x_0 + k a (mod 1)`, with `a` from the root of `x^(d+1) = x + 1` (M. Roberts, "The unreasonable
/// effectiveness of quasirandom sequences", 2018), on a sphere as directions of normal deviates.
struct Even {
    states: usize,
    sphere: bool,
    at: Vec<f64>,
    step: Vec<f64>,
}

impl Even {
    fn new(states: usize, sphere: bool, seed: u64) -> Self {
        // Directions in a plane are one angle; in more dimensions a pair of numbers makes a pair of
        // deviates.
        let dimensions = match (sphere, states) {
            (false, n) => n,
            (true, 2) => 1,
            (true, n) => n.next_multiple_of(2),
        };
        let mut root = 1.5f64;
        for _ in 0..64 {
            root = (1.0 + root).powf(1.0 / (dimensions as f64 + 1.0));
        }
        Self {
            states,
            sphere,
            at: (0..dimensions).map(|i| shift(seed, i as u64)).collect(),
            step: (1..=dimensions).map(|i| root.powi(-(i as i32))).collect(),
        }
    }

    fn next_parameter(&mut self) -> Vec<f64> {
        for (x, step) in self.at.iter_mut().zip(&self.step) {
            *x = (*x + step).fract();
        }
        if !self.sphere {
            return self.at.clone();
        }
        let turn = std::f64::consts::TAU;
        if self.states == 2 {
            let (sine, cosine) = (turn * self.at[0]).sin_cos();
            return vec![cosine, sine];
        }
        // Box and Muller, A note on the generation of random normal deviates, Ann. Math. Statist.
        // 29 (1958).
        let mut direction: Vec<f64> = (self.at.chunks_exact(2))
            .flat_map(|pair| {
                let radius = (-2.0 * (1.0 - pair[0]).ln()).sqrt();
                let (sine, cosine) = (turn * pair[1]).sin_cos();
                [radius * cosine, radius * sine]
            })
            .take(self.states)
            .collect();
        let norm = direction
            .iter()
            .map(|x| x * x)
            .sum::<f64>()
            .sqrt()
            .max(f64::MIN_POSITIVE);
        direction.iter_mut().for_each(|x| *x /= norm);
        direction
    }
}

/// A number in [0, 1) for each dimension (SplitMix64); seed 0 too starts off the corners.
fn shift(seed: u64, dimension: u64) -> f64 {
    let mut z = (seed.wrapping_mul(0xbf58_476d_1ce4_e5b9))
        .wrapping_add((dimension + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every eighth of the circle, and every half-space of the sphere in five dimensions, gets its
    /// share.
    #[test]
    fn directions_are_even_and_of_length_one() {
        const COUNT: usize = 4096;
        let mut even = Even::new(2, true, 3);
        let mut octants = [0usize; 8];
        for _ in 0..COUNT {
            let d = even.next_parameter();
            let angle = d[1].atan2(d[0]).rem_euclid(std::f64::consts::TAU);
            octants[((angle / std::f64::consts::FRAC_PI_4) as usize).min(7)] += 1;
        }
        // An additive recurrence of one dimension is off by a few points however many there are.
        assert!(
            octants.iter().all(|n| n.abs_diff(COUNT / 8) <= 4),
            "{octants:?}"
        );
        let mut even = Even::new(5, true, 3);
        let mut halves = [0usize; 5];
        for _ in 0..COUNT {
            let d = even.next_parameter();
            assert!((d.iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-12);
            halves
                .iter_mut()
                .zip(&d)
                .for_each(|(h, x)| *h += usize::from(*x > 0.0));
        }
        // Half the deviation that random points would have: sqrt(4096)/2 = 32.
        assert!(
            halves.iter().all(|n| n.abs_diff(COUNT / 2) <= 32),
            "{halves:?}"
        );
    }

    #[test]
    fn another_seed_gives_other_points() {
        let first = |seed| Even::new(3, false, seed).next_parameter();
        assert_eq!(first(1), first(1));
        assert_ne!(first(1), first(2));
        assert!(first(0).iter().all(|x| (0.0..1.0).contains(x)));
    }
}
