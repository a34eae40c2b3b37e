//! A trajectory's result is the same bits whatever batch it is in and however many threads work on
//! it.

use crate::common_oracles;

use common_oracles::{Asked, F32, F64, Sweep, scene};
use costate::backend::{Backend, Kernel, Run, Trajectories, cpu::Cpu};
use costate::low_level::model::{Method, Precision};

/// Sizes around a lane block's (64, 128), and an odd one.
const SIZES: [usize; 4] = [1, 63, 65, 345];
/// As many seeds as the largest batch: more than any block of lanes.
const SEEDS: usize = 345 + 63;

/// Everything about trajectory `i`, as bits.
fn row(t: &Trajectories, i: usize) -> Vec<u64> {
    let width = t.levels * (1 + t.dim);
    let numbers = t.end[i * t.dim..(i + 1) * t.dim]
        .iter()
        .chain([&t.end_time[i]])
        .chain(&t.samples[i * width..(i + 1) * width]);
    let counters = [
        t.status[i] as u64,
        u64::from(t.steps[i]),
        u64::from(t.rejected[i]),
    ];
    numbers.map(|x| x.to_bits()).chain(counters).collect()
}

struct Case {
    name: String,
    kernel: Box<dyn Kernel>,
    run: Run,
    seeds: Vec<f64>,
    dim: usize,
}

impl Case {
    fn new(name: &str, method: Method, asked: Asked, store: bool) -> Self {
        let mut model = scene(name, &[]);
        let shoot_out = model.shoot_out.as_mut().expect("the scene has a sweep");
        shoot_out.max_seeds = SEEDS;
        shoot_out.spacing = shoot_out.spacing.min(0.02);
        let sweep = Sweep::of(&model, asked);
        let mut spec = sweep.plan.spec.clone();
        let mut run = sweep.plan.run.clone();
        spec.method = method;
        spec.store = store;
        // Steps of about the size that the adaptive method takes.
        run.step = 0.02;
        let dim = spec.dim();
        assert!(
            sweep.seeds.len() >= SEEDS * dim,
            "{name} has {} seeds",
            sweep.seeds.len() / dim
        );
        Self {
            name: format!(
                "{name}, {}, {}, samples {store}",
                method.name(),
                asked.precision.name()
            ),
            kernel: Cpu::new()
                .compile(&spec)
                .expect("the CPU compiles anything"),
            run,
            seeds: sweep.seeds[..SEEDS * dim].to_vec(),
            dim,
        }
    }

    fn rows(&mut self, from: usize, count: usize) -> Vec<Vec<u64>> {
        let seeds = &self.seeds[from * self.dim..(from + count) * self.dim];
        let result = self
            .kernel
            .integrate(&self.run, seeds)
            .expect("the CPU does not fail");
        assert_eq!(result.count(), count);
        (0..count).map(|i| row(&result, i)).collect()
    }

    fn check(&mut self) {
        let all = self.rows(0, SEEDS);
        for size in SIZES {
            // Single ones from everywhere; of the others two, which overlap.
            let starts: Vec<usize> = if size == 1 {
                (0..SEEDS).step_by(29).collect()
            } else {
                vec![0, SEEDS - size]
            };
            for from in starts {
                for (i, row) in self.rows(from, size).into_iter().enumerate() {
                    assert!(
                        row == all[from + i],
                        "{}: trajectory {} in a batch of {size} from {from}",
                        self.name,
                        from + i
                    );
                }
            }
        }
        // Split as the sweep splits what is too large for one batch.
        for size in [63, 65] {
            let parts: Vec<_> = (0..SEEDS)
                .step_by(size)
                .flat_map(|from| self.rows(from, size.min(SEEDS - from)))
                .collect();
            assert!(parts == all, "{}: in batches of {size}", self.name);
        }
        for threads in [1, 2, 3] {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .expect("threads can be started");
            let rows = pool.install(|| self.rows(0, SEEDS));
            assert!(rows == all, "{}: on {threads} threads", self.name);
        }
    }
}

/// Lanes take the next trajectory when theirs ends, so that trajectories of very different length
/// keep them busy.
#[test]
fn lanes_stay_busy() {
    for name in ["pendulum", "moore_greitzer"] {
        for method in [Method::Tsit5, Method::Taylor] {
            let mut case = Case::new(name, method, F64, false);
            let seeds = case.seeds.repeat(4096 / SEEDS + 1);
            let result = case
                .kernel
                .integrate(&case.run, &seeds)
                .expect("the CPU does not fail");
            let (least, most) = result
                .steps
                .iter()
                .fold((u32::MAX, 0), |(a, b), s| (a.min(*s), b.max(*s)));
            let occupancy = result.occupancy().expect("the CPU tells");
            println!(
                "{}: {least} to {most} steps, {:.3} of the lanes' steps",
                case.name, occupancy
            );
            assert!(most > least, "{}: nothing to balance", case.name);
            // What is lost is the end of each chunk, where the last trajectories are alone.
            assert!(
                occupancy <= 1.0 && occupancy > 0.85,
                "{}: {occupancy}",
                case.name
            );
        }
    }
}

fn check(method: Method, asked: Asked) {
    // The second has guards and a clamp.
    for name in ["pendulum", "moore_greitzer"] {
        for store in [true, false] {
            Case::new(name, method, asked, store).check();
        }
    }
}

#[test]
fn tsit5_f64() {
    check(Method::Tsit5, F64);
}

#[test]
fn tsit5_f32() {
    check(Method::Tsit5, F32);
}

#[test]
fn taylor() {
    check(Method::Taylor, F64);
    check(Method::Taylor, F32);
}

#[test]
fn dop853() {
    check(Method::Dop853, F64);
}

#[test]
fn rk4_f64() {
    check(Method::Rk4, F64);
}

#[test]
fn rk4_f32() {
    check(Method::Rk4, F32);
}

/// Trajectories that end in all the ways there are, side by side with ones that go on.
#[test]
fn mixed_endings() {
    let mut case = Case::new("moore_greitzer", Method::Tsit5, F64, true);
    // Enough attempts for half of them.
    let result = case
        .kernel
        .integrate(&case.run, &case.seeds)
        .expect("the CPU does not fail");
    let mut attempts: Vec<u32> = result
        .steps
        .iter()
        .zip(&result.rejected)
        .map(|(s, r)| s + r)
        .collect();
    attempts.sort_unstable();
    case.run.max_steps = attempts[attempts.len() / 2];
    case.check();
    let result = case
        .kernel
        .integrate(&case.run, &case.seeds)
        .expect("the CPU does not fail");
    let kinds: std::collections::BTreeSet<_> = result.status.iter().collect();
    assert!(kinds.len() >= 3, "only {kinds:?}");
}

/// More trajectories than one task of the backend takes, and none.
#[test]
fn many_and_none() {
    let mut case = Case::new(
        "pendulum",
        Method::Tsit5,
        Asked {
            precision: Precision::F32,
            rtol: 1e-5,
        },
        false,
    );
    let all = case.rows(0, SEEDS);
    let copies = 50;
    let once = case.seeds.clone();
    case.seeds = once.repeat(copies);
    let many = case.rows(0, copies * SEEDS);
    assert!(
        many.iter()
            .enumerate()
            .all(|(i, row)| *row == all[i % SEEDS]),
        "repeated seeds give repeated rows"
    );
    assert!(case.rows(0, 0).is_empty());
}
