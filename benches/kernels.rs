//! Criterion benches: right-hand side, step and sweep of the pendulum scene, for each backend
//! found, precision and method.
//!
//! `cargo bench --bench kernels` (a GPU adapter, software included, is benched where there is one).
//! Throughput is in right-hand sides, attempted steps and trajectories a second.

use costate::backend::cpu::{Cpu, Evaluator};
use costate::backend::gpu::{Gpu, Selection};
use costate::backend::{Backend, BackendError, By, Run, Spec};
use costate::low_level::hamiltonian::{Hamiltonian, System};
use costate::low_level::model::{Method, Model, Precision};
use costate::low_level::program::Program;
use costate::low_level::sweep::{Choices, Plan, sweep};
use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use std::hint::black_box;

const POINTS: usize = 4096;
const STEPS: usize = 64;

fn scene() -> (Model, Hamiltonian) {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/scenarios/pendulum.toml");
    let mut model =
        costate::low_level::scenario::load(path.as_ref(), &[]).expect("the scene is valid");
    model.integrator.step = Some(0.01);
    let hamiltonian = Hamiltonian::derive(&model).expect("the scene is in the class");
    (model, hamiltonian)
}

fn backends() -> Vec<Box<dyn Backend>> {
    let mut list: Vec<Box<dyn Backend>> = vec![Box::new(Cpu::new())];
    match Gpu::open(&Selection::Any) {
        Ok(Some(gpu)) => list.push(Box::new(gpu)),
        _ => eprintln!("no GPU adapter: only the CPU is benched"),
    }
    list
}

/// Points on the seed ellipsoid and beyond: `(s, p, V)`.
fn points() -> Vec<f64> {
    (0..POINTS)
        .flat_map(|k| {
            let angle = k as f64 * std::f64::consts::TAU / POINTS as f64;
            [
                0.5 * angle.cos(),
                1.5 * angle.sin(),
                angle.cos(),
                3.0 * angle.sin(),
                1.0,
            ]
        })
        .collect()
}

fn right_hand_side(c: &mut Criterion) {
    let (model, hamiltonian) = scene();
    let system = System::new(&hamiltonian, &model);
    let evaluator = Evaluator::new(&Program::lower(&system.graph, &system.inputs, &system.rate));
    let points = points();
    let mut group = c.benchmark_group("right_hand_side");
    group.throughput(Throughput::Elements(POINTS as u64));
    group.bench_function("cpu/f64", |b| {
        b.iter(|| evaluator.eval(black_box(&points), 5))
    });
    group.finish();
}

/// A fixed number of steps of every trajectory. One step of rk4 is four right-hand sides, one of
/// tsit5 six.
fn step(c: &mut Criterion) {
    let (model, hamiltonian) = scene();
    let system = System::new(&hamiltonian, &model);
    let rate = Program::lower(&system.graph, &system.inputs, &system.rate);
    let points = points();
    let mut group = c.benchmark_group("step");
    group.throughput(Throughput::Elements((POINTS * STEPS) as u64));
    for backend in backends() {
        for (precision, method) in combinations(backend.as_ref()) {
            let spec = Spec {
                rate: rate.clone(),
                guards: None,
                kinks: None,
                method,
                precision,
                by: By::Time,
                store: false,
            };
            let run = Run {
                rtol: 1e-6,
                atol: vec![1e-6; 5],
                step: 1e-3,
                first: None,
                max_steps: STEPS as u32,
                levels: vec![1e3],
                ceiling: None,
                bounds: Vec::new(),
            };
            let mut kernel = backend.compile(&spec).expect("the kernel compiles");
            let name = format!("{}/{}", backend.name(), precision.name());
            group.bench_function(BenchmarkId::new(name, method.name()), |b| {
                b.iter(|| {
                    kernel
                        .integrate(black_box(&run), &points)
                        .expect("the backend works")
                })
            });
        }
    }
    group.finish();
}

fn combinations(backend: &dyn Backend) -> Vec<(Precision, Method)> {
    [Precision::F32, Precision::F64]
        .into_iter()
        .filter(|p| backend.supports(*p))
        .flat_map(|p| [(p, Method::Rk4), (p, Method::Tsit5)])
        .collect()
}

fn whole_sweep(c: &mut Criterion) {
    let (mut model, hamiltonian) = scene();
    let mut group = c.benchmark_group("sweep");
    group.sample_size(10);
    for backend in backends() {
        for (precision, method) in combinations(backend.as_ref()) {
            model.integrator.method = Some(method);
            let choices = Choices {
                precision: Some(precision),
                ..Choices::default()
            };
            let plan = Plan::new(&model, &hamiltonian, backend.as_ref(), choices)
                .expect("the scene can be swept");
            let go = || {
                let mut quiet = |_: usize, _: usize| {};
                sweep::<BackendError>(&plan, backend.as_ref(), &mut quiet, &mut |_| Ok(()))
                    .expect("the sweep ends")
            };
            group.throughput(Throughput::Elements(go().trajectories as u64));
            let name = format!("{}/{}", backend.name(), precision.name());
            group.bench_function(BenchmarkId::new(name, method.name()), |b| b.iter(go));
        }
    }
    group.finish();
}

criterion_group!(benches, right_hand_side, step, whole_sweep);
criterion_main!(benches);
