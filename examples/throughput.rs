//! Steps and trajectories a second of every backend, precision and method on the pendulum scene, interleaved.
//!
//! `cargo run --release --example throughput [repeats]`

use costate::backend::cpu::Cpu;
use costate::backend::gpu::{Gpu, Selection};
use costate::backend::{Backend, By, Run, Spec, Trajectories};
use costate::hamiltonian::{Hamiltonian, System};
use costate::model::{Method, Precision};
use costate::program::Program;
use costate::sweep::{Choices, Plan};
use std::time::Instant;

fn main() {
    let repeats: usize = std::env::args().nth(1).and_then(|a| a.parse().ok()).unwrap_or(3);
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/scenarios/pendulum.toml");
    let mut model = costate::scenario::load(path.as_ref(), &[]).expect("the scene is valid");
    model.integrator.step = Some(0.01);
    let hamiltonian = Hamiltonian::derive(&model).expect("the scene is in the class");
    let system = System::new(&hamiltonian, &model);
    let rate = Program::lower(&system.graph, &system.inputs, &system.rate);
    let mut backends: Vec<Box<dyn Backend>> = vec![Box::new(Cpu::new())];
    match Gpu::open(&Selection::Any) {
        Ok(Some(gpu)) => backends.push(Box::new(gpu)),
        other => eprintln!("no GPU: {:?}", other.err()),
    }
    let only = std::env::var("ONLY").unwrap_or_default();
    let pick = std::env::var("PICK").unwrap_or_default();
    for (precision, method) in [
        (Precision::F32, Method::Rk4),
        (Precision::F64, Method::Rk4),
        (Precision::F32, Method::Tsit5),
        (Precision::F64, Method::Tsit5),
    ] {
        let id = format!("{}-{}", precision.name(), method.name());
        if !pick.is_empty() && !id.contains(&pick) {
            continue;
        }
        // A fixed number of steps without events.
        let count = 4096;
        let steps = 2000;
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
            rtol: 1e-5,
            atol: vec![1e-6; 5],
            step: 1e-3,
            first: None,
            max_steps: steps,
            levels: vec![1e3],
            ceiling: None,
            bounds: Vec::new(),
        };
        let seeds: Vec<f64> = (0..count)
            .flat_map(|k| {
                let a = k as f64 * std::f64::consts::TAU / count as f64;
                [0.1 * a.cos(), 0.1 * a.sin(), 0.3 * a.cos(), 0.3 * a.sin(), 0.0]
            })
            .collect();
        // A sweep's batch: stored samples, bounds, levels.
        model.integrator.method = Some(method);
        let rtol = if precision == Precision::F32 { 1e-5 } else { 1e-8 };
        let plan = Plan::new(
            &model,
            &hamiltonian,
            backends[0].as_ref(),
            Choices {
                precision: Some(precision),
                rtol: Some(rtol),
                ..Choices::default()
            },
        )
        .expect("the scene can be swept");
        let fan: Vec<f64> = (0..count)
            .flat_map(|k| {
                let a = k as f64 * std::f64::consts::TAU / count as f64;
                plan.surface.seed(&[a.cos(), a.sin()])
            })
            .collect();
        let mut ends = plan.spec.clone();
        ends.store = false;
        for (what, spec, run, seeds) in [
            ("steps", &spec, &run, &seeds),
            ("ends", &ends, &plan.run, &fan),
            ("sweep", &plan.spec, &plan.run, &fan),
        ] {
            if !only.is_empty() && !only.contains(what) {
                continue;
            }
            if let Ok(list) = std::env::var("VARIANTS") {
                let files: Vec<&str> = list.split(',').collect();
                let mut kernels: Vec<_> = files.iter().map(|_| backends[1].compile(spec).unwrap()).collect();
                let mut times = vec![Vec::new(); files.len()];
                for repeat in 0..=repeats {
                    for (k, kernel) in kernels.iter_mut().enumerate() {
                        if files[k].is_empty() {
                            unsafe { std::env::remove_var("REPLACE") }
                        } else {
                            unsafe { std::env::set_var("REPLACE", files[k]) }
                        }
                        let clock = Instant::now();
                        kernel.integrate(run, seeds).unwrap();
                        if repeat > 0 {
                            times[k].push(clock.elapsed().as_secs_f64() * 1e3);
                        }
                    }
                }
                for (k, f) in files.iter().enumerate() {
                    let mut t = times[k].clone();
                    t.sort_by(f64::total_cmp);
                    let mut r: Vec<f64> = times[k].iter().zip(&times[0]).map(|(a, b)| a / b).collect();
                    r.sort_by(f64::total_cmp);
                    println!(
                        "{what} {id} {f:40}: least {:8.2} ms, median {:8.2} ms, median ratio to the first {:.3}",
                        t[0],
                        t[t.len() / 2],
                        r[r.len() / 2]
                    );
                }
                continue;
            }
            let mut kernels: Vec<_> = backends.iter().map(|b| b.compile(spec).expect("compiles")).collect();
            let mut best = vec![f64::INFINITY; kernels.len()];
            let mut spent = vec![0.0; kernels.len()];
            let mut first = vec![0.0; kernels.len()];
            let mut last: Vec<Trajectories> = vec![Trajectories::default(); kernels.len()];
            for repeat in 0..=repeats {
                for (k, kernel) in kernels.iter_mut().enumerate() {
                    let (clock, used) = (Instant::now(), cpu_seconds());
                    last[k] = kernel.integrate(run, seeds).expect("works");
                    let seconds = clock.elapsed().as_secs_f64();
                    if repeat > 0 {
                        spent[k] += (cpu_seconds() - used) / repeats as f64;
                    }
                    if repeat == 0 {
                        first[k] = seconds;
                    } else {
                        best[k] = best[k].min(seconds);
                    }
                }
            }
            for (k, b) in backends.iter().enumerate() {
                let attempts: f64 = last[k]
                    .steps
                    .iter()
                    .zip(&last[k].rejected)
                    .map(|(a, b)| f64::from(a + b))
                    .sum();
                println!(
                    "{what:6} {} {} {:5}: {:8.2} M steps/s, {:9.0} trajectories/s, {:6.1} steps each, best {:.2} ms, first {:.1} ms, {:.1} ns of CPU a step",
                    b.name(),
                    precision.name(),
                    method.name(),
                    attempts / best[k] / 1e6,
                    last[k].count() as f64 / best[k],
                    attempts / last[k].count() as f64,
                    best[k] * 1e3,
                    first[k] * 1e3,
                    spent[k] / attempts * 1e9,
                );
            }
        }
    }
}

/// Processor time of this process, all threads, where the system tells (to 10 ms).
fn cpu_seconds() -> f64 {
    let text = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = text.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let ticks = |k: usize| fields.get(k).and_then(|f| f.parse::<f64>().ok()).unwrap_or(f64::NAN);
    (ticks(11) + ticks(12)) / 100.0
}
