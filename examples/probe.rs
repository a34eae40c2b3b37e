// Temporary: best-of time per setting on one thread.
use costate::backend::{Backend, By, Run, Spec, cpu::Cpu};
use costate::hamiltonian::{Hamiltonian, System};
use costate::model::{Method, Precision};
use costate::program::Program;
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let scene = args.get(1).map_or("pendulum", |s| s);
    let path = format!("{}/scenarios/{scene}.toml", env!("CARGO_MANIFEST_DIR"));
    let model = costate::scenario::load(path.as_ref(), &[]).unwrap();
    let hamiltonian = Hamiltonian::derive(&model).unwrap();
    let system = System::new(&hamiltonian, &model);
    let program = Program::lower(&system.graph, &system.inputs, &system.rate);
    let n = 2 * system.states + 1;
    let mut seeds = Vec::new();
    let count = 2048;
    let riccati = costate::local::Riccati::solve(&hamiltonian, &model).unwrap();
    for k in 0..count {
        let s: Vec<f64> = (0..system.states)
            .map(|i| 1e-3 * ((k as f64 + 0.5) * (i as f64 + 2.0).sqrt() * 1.7).sin())
            .collect();
        let s = nalgebra::DVector::from_vec(s);
        let p = &riccati.p * &s;
        seeds.extend(s.iter());
        seeds.extend(p.iter());
        seeds.push(0.5 * s.dot(&p));
    }
    for (method, precision, rtol) in [
        (Method::Tsit5, Precision::F64, 1e-6),
        (Method::Tsit5, Precision::F32, 1e-5),
        (Method::Dop853, Precision::F64, 1e-8),
        (Method::Taylor, Precision::F64, 1e-6),
        (Method::Taylor, Precision::F64, 1e-9),
        (Method::Taylor, Precision::F64, 1e-12),
        (Method::Taylor, Precision::F32, 1e-5),
    ] {
        let spec = Spec {
            rate: program.clone(),
            guards: None,
            kinks: None,
            method,
            precision,
            by: By::Time,
            store: false,
        };
        let run = Run {
            rtol,
            atol: vec![rtol; n],
            step: 0.0,
            max_steps: 100000,
            levels: vec![4.0],
            ceiling: None,
            bounds: vec![],
        };
        let mut kernel = Cpu::new().compile(&spec).unwrap();
        let t0 = std::time::Instant::now();
        let r = kernel.integrate(&run, &seeds).unwrap();
        let first = t0.elapsed().as_secs_f64();
        let mut best = f64::INFINITY;
        for _ in 0..60 {
            let t = std::time::Instant::now();
            kernel.integrate(&run, &seeds).unwrap();
            best = best.min(t.elapsed().as_secs_f64());
        }
        let steps: u32 = r.steps.iter().sum();
        let rejected: u32 = r.rejected.iter().sum();
        println!(
            "{} {} {rtol:e}: {:.0}/s a thread, {:.1} steps + {:.1}, {:.1} ns a step; first call {:.1} ms",
            method.name(),
            precision.name(),
            count as f64 / best,
            steps as f64 / count as f64,
            rejected as f64 / count as f64,
            1e9 * best / (steps + rejected) as f64,
            1e3 * first
        );
    }
}
