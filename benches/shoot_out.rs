//! The pendulum shooting-out work that other tools are measured on: seeds on `s'Ps/2 = 1e-4` at
//! equal angles, integrated 4 time units backward, end states kept; error against f64 at the
//! tightest tolerance by another method.
//!
//! `cargo bench --bench shoot_out -- [SEEDS] [cpu|gpu|sets] [van_der_pol] [f32|f64] [few]` prints one
//! JSON line a setting: backend, precision, method, rtol, n, seconds (median, from seeds on the
//! host to results on the host), kernel_seconds (of the median pass, by the device's clock, where
//! it has one), traj_per_s, max_rel_err, median_rel_err.
//!
//! `van_der_pol` is the case that CuBIE publishes: x'' = (1 - x^2) x' - x over 20 time units, here
//! from states spread over [-2, 2] x [-2, 2]. `few` leaves out settings that no table needs, and
//! `sets` runs the CPU once for each set of instructions that it can compile for.

use costate::backend::cpu::{Cpu, Simd};
use costate::backend::gpu::{Gpu, Selection};
use costate::backend::{Backend, By, Kernel, Run, Spec, Status};
use costate::low_level::expr::{Graph, Kind};
use costate::low_level::hamiltonian::{Hamiltonian, System};
use costate::low_level::local::Riccati;
use costate::low_level::model::{Method, Precision};
use costate::low_level::program::Program;
use std::time::Instant;

const REPEATS: usize = 7;

/// What is integrated.
struct Case {
    rate: Program,
    time: f64,
    seeds: Vec<f64>,
    /// What is added to the first component of an end before errors are taken of it.
    shift: f64,
}

impl Case {
    /// `(s, p, V)` of the scene, from an ellipsoid about the equilibrium at theta = -1.5.
    fn pendulum(count: usize) -> Self {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/scenarios/pendulum.toml");
        let model =
            costate::low_level::scenario::load(path.as_ref(), &[]).expect("the scene is valid");
        let hamiltonian = Hamiltonian::derive(&model).expect("the scene is in the class");
        let riccati = Riccati::solve(&hamiltonian, &model).expect("the scene has a local solution");
        let system = System::new(&hamiltonian, &model);
        Self {
            rate: Program::lower(&system.graph, &system.inputs, &system.rate),
            time: 4.0,
            seeds: seeds(&riccati, count),
            shift: -1.5,
        }
    }

    fn van_der_pol(count: usize) -> Self {
        let mut graph = Graph::new();
        let (x, v) = (
            graph.symbol("x", Kind::State),
            graph.symbol("v", Kind::State),
        );
        let (one, square) = (graph.constant(1.0), graph.powi(x, 2));
        let damping = graph.sub(one, square);
        let push = graph.mul(damping, v);
        let rate = graph.sub(push, x);
        // Irrational rotations spread points evenly, whatever their number.
        let spread = |k: usize, by: f64| 4.0 * (0.5 + k as f64 * by).fract() - 2.0;
        let (a, b) = (0.754_877_666_246_692_8, 0.569_840_290_998_053_3);
        Self {
            rate: Program::lower(&graph, &[x, v], &[v, rate]),
            time: 20.0,
            seeds: (0..count)
                .flat_map(|k| [spread(k, a), spread(k, b)])
                .collect(),
            shift: 0.0,
        }
    }

    fn dim(&self) -> usize {
        self.rate.outputs.len()
    }
}

fn main() {
    let args: Vec<String> = std::env::args()
        .skip(1)
        .filter(|a| !a.starts_with("--"))
        .collect();
    let count: usize = args.iter().find_map(|a| a.parse().ok()).unwrap_or(4096);
    let asked = |name: &str| args.iter().any(|a| a == name);
    let case = match asked("van_der_pol") {
        true => Case::van_der_pol(count),
        false => Case::pendulum(count),
    };
    println!("# {} operations a right-hand side", case.rate.operations());

    // Two references by different methods; each method is measured against the other one.
    let reference = |method| {
        Work::new(&Cpu::new(), &case, method, Precision::F64, 1e-15, 0.0)
            .run(&case)
            .0
    };
    let (by_taylor, by_dop853) = (reference(Method::Taylor), reference(Method::Dop853));
    println!(
        "# the references differ by {:.1e}",
        errors(&by_taylor, &by_dop853, case.dim())[count - 1]
    );
    let mut settings: Vec<(Method, Precision, f64, f64)> = Vec::new();
    for method in [Method::Tsit5, Method::Dop853, Method::Taylor] {
        for rtol in [
            1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12, 1e-13, 1e-14,
        ] {
            if method != Method::Tsit5 || rtol >= 1e-9 {
                settings.push((method, Precision::F64, rtol, 0.0));
            }
        }
        for rtol in [1e-2, 1e-3, 1e-4, 1e-5, 1e-6] {
            settings.push((method, Precision::F32, rtol, 0.0));
        }
    }
    for steps in [50.0, 100.0, 400.0] {
        settings.push((Method::Rk4, Precision::F64, 1e-6, case.time / steps));
        settings.push((Method::Rk4, Precision::F32, 1e-6, case.time / steps));
    }
    settings.retain(|(method, precision, rtol, step)| {
        let precisely = asked(precision.name()) || !(asked("f32") || asked("f64"));
        let worth = *step == 0.0 && (*method != Method::Tsit5 || *rtol >= 1e-8) && *rtol < 1e-2;
        precisely && (worth || !asked("few"))
    });
    let mut backends: Vec<Box<dyn Backend>> = Vec::new();
    if asked("sets") {
        for cpu in Simd::ALL.iter().filter_map(|simd| Cpu::compiling(*simd)) {
            backends.push(Box::new(cpu));
        }
    } else if asked("cpu") || !asked("gpu") {
        backends.push(Box::new(Cpu::new()));
    }
    if asked("gpu") {
        let gpu = Gpu::open(&Selection::Any).expect("an adapter opens");
        backends.push(Box::new(
            gpu.expect("there is an adapter, a software one included"),
        ));
    }
    for backend in &backends {
        for &(method, precision, rtol, step) in &settings {
            if !backend.offers(method) || !backend.supports(precision) {
                continue;
            }
            let mut work = Work::new(backend.as_ref(), &case, method, precision, rtol, step);
            // The first run compiles what a driver compiles late; it is not counted.
            let mut end = work.run(&case).0;
            let mut times = Vec::new();
            for _ in 0..REPEATS {
                let (values, seconds) = work.run(&case);
                times.push((seconds, work.kernel.kernel_seconds()));
                end = values;
            }
            times.sort_by(|a, b| a.0.total_cmp(&b.0));
            let (seconds, kernel) = times[REPEATS / 2];
            let reference = if method == Method::Taylor {
                &by_dop853
            } else {
                &by_taylor
            };
            let errors = errors(&end, reference, case.dim());
            println!(
                "{{\"backend\": \"{}\", \"adapter\": \"{}\", \"precision\": \"{}\", \"method\": \"{}\", \"setting\": \"{}\", \"n\": {count}, \"seconds\": {seconds:.6}, \"kernel_seconds\": {}, \"traj_per_s\": {:.0}, \"max_rel_err\": {:.2e}, \"median_rel_err\": {:.2e}}}",
                backend.name(),
                backend.adapter(),
                precision.name(),
                method.name(),
                if step > 0.0 {
                    format!("steps={}", case.time / step)
                } else {
                    format!("rtol={rtol:e}")
                },
                kernel.map_or("null".to_owned(), |s| format!("{s:.6}")),
                count as f64 / seconds,
                errors[count - 1],
                errors[count / 2],
            );
        }
    }
}

/// Relative errors of the trajectories' ends, ascending.
fn errors(end: &[f64], reference: &[f64], dim: usize) -> Vec<f64> {
    let one = |(y, r): (&[f64], &[f64])| {
        let each = y
            .iter()
            .zip(r)
            .map(|(y, r)| (y - r).abs() / r.abs().max(1.0));
        each.fold(0.0, f64::max)
    };
    let mut errors: Vec<f64> = end
        .chunks(dim)
        .zip(reference.chunks(dim))
        .map(one)
        .collect();
    errors.sort_by(f64::total_cmp);
    errors
}

/// `(s, p, V)` on the quadratic ellipsoid at equal angles in coordinates where P is the identity.
fn seeds(riccati: &Riccati, count: usize) -> Vec<f64> {
    let c: f64 = 1e-4;
    let eigen = riccati.p.clone().symmetric_eigen();
    let mut seeds = Vec::new();
    for k in 0..count {
        let angle = std::f64::consts::TAU * k as f64 / count as f64;
        let z = nalgebra::DVector::from_vec(vec![
            angle.cos() / eigen.eigenvalues[0].sqrt(),
            angle.sin() / eigen.eigenvalues[1].sqrt(),
        ]);
        let s = &eigen.eigenvectors * z * (2.0 * c).sqrt();
        let p = &riccati.p * &s;
        seeds.extend([s[0], s[1], p[0], p[1], c]);
    }
    seeds
}

/// One setting of the work.
struct Work {
    kernel: Box<dyn Kernel>,
    run: Run,
}

impl Work {
    fn new(
        backend: &dyn Backend,
        case: &Case,
        method: Method,
        precision: Precision,
        rtol: f64,
        step: f64,
    ) -> Self {
        let spec = Spec {
            rate: case.rate.clone(),
            guards: None,
            kinks: None,
            method,
            precision,
            by: By::Time,
            store: false,
        };
        let run = Run {
            rtol,
            atol: vec![rtol; case.dim()],
            step,
            first: None,
            max_steps: 1_000_000,
            levels: vec![case.time],
            ceiling: None,
            bounds: Vec::new(),
        };
        Self {
            kernel: backend.compile(&spec).expect("the kernel compiles"),
            run,
        }
    }

    /// Absolute end states, and the seconds from seeds on the host to results on the
    /// host.
    fn run(&mut self, case: &Case) -> (Vec<f64>, f64) {
        let start = Instant::now();
        let result = self
            .kernel
            .integrate(&self.run, &case.seeds)
            .expect("the backend works");
        let seconds = start.elapsed().as_secs_f64();
        assert!(
            result.status.iter().all(|s| *s == Status::Reached),
            "all trajectories reach the end"
        );
        let mut end = result.end;
        end.chunks_mut(case.dim()).for_each(|y| y[0] += case.shift);
        (end, seconds)
    }
}
