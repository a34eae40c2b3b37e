//! Planar chains of N links: operations, time to compile, size of the code, and time of one state on
//! one core, of forward dynamics and of the bicharacteristics x', p'. One JSON line a size.
//!
//! `cargo bench --bench mechanisms -- [gpu] [N ...]` (default: 2 3 5 7 10 15 20 25 30; `gpu` adds
//! what the adapter's compiler takes). A state's time is that of fixed steps of rk4, four right-hand
//! sides each, its sums included, in batches of 4096 on one thread; the least of seven.

use costate::backend::cpu::Cpu;
use costate::backend::gpu::{Gpu, Selection};
use costate::backend::{Backend, By, Kernel, Run, Spec, Status};
use costate::low_level::expr::{Graph, Id};
use costate::low_level::hamiltonian::{Hamiltonian, System};
use costate::low_level::model::{Method, Model, Precision};
use costate::low_level::program::Program;
use costate::low_level::scenario;
use std::time::Instant;

const BATCH: usize = 4096;
const REPEATS: usize = 7;

/// A chain of equal rods with a torque in each joint.
fn chain(links: usize) -> Model {
    let each = |line: &dyn Fn(usize) -> String| -> String { (1..=links).map(line).collect() };
    let text = format!(
        "[mechanism]\ngravity = [0, -9.81]\n[mechanism.bodies]\n\
         link = {{ chain = {links}, joint = \"revolute\", at = [0.5, 0], mass = 1, shape = {{ rod = 0.5 }} }}\n\
         [mechanism.forces]\n{}[controls]\n{}[cost]\nrunning = \"{}\"\nterminal = \"0\"\nfinal_time = 1\n[region]\n{}",
        each(&|k| format!("link{k} = \"u{k}\"\n")),
        each(&|k| format!("u{k} = {{}}\n")),
        (1..=links)
            .map(|k| format!("0.5*(link{k}^2 + link{k}_rate^2 + u{k}^2)"))
            .collect::<Vec<_>>()
            .join(" + "),
        each(&|k| format!("link{k} = [-3, 3]\nlink{k}_rate = [-3, 3]\n")),
    );
    scenario::parse(&text, "chain.toml", &[]).unwrap_or_else(|e| panic!("{e}"))
}

/// What is measured: a right-hand side, and how many of its components change.
struct Work {
    rate: Program,
    dim: usize,
}

/// `(q, q', u) -> (q', q'', 0)`.
fn forward(model: &Model) -> Work {
    let mut graph: Graph = model.graph.clone();
    let x = model.states.iter().map(|s| s.variable.symbol);
    let u = model.controls.iter().map(|c| c.variable.symbol);
    let inputs: Vec<Id> = x.chain(u).collect();
    let zero = graph.constant(0.0);
    let mut rate: Vec<Id> = model.dynamics.iter().map(|f| f.expr).collect();
    rate.resize(inputs.len(), zero);
    Work {
        rate: Program::lower(&graph, &inputs, &rate),
        dim: inputs.len(),
    }
}

/// `(x, p) -> (x', p', V')`, the optimal controls inside.
fn adjoint(model: &Model) -> Work {
    let hamiltonian = Hamiltonian::derive(model).expect("the scene is in the class");
    let system = System::new(&hamiltonian, model);
    Work {
        rate: Program::lower(&system.graph, &system.inputs, &system.rate),
        dim: system.rate.len(),
    }
}

impl Work {
    fn spec(&self, precision: Precision) -> Spec {
        Spec {
            rate: self.rate.clone(),
            guards: None,
            kinks: None,
            method: Method::Rk4,
            precision,
            by: By::Time,
            store: false,
        }
    }

    /// Near an equilibrium of nothing: values of about a tenth.
    fn seeds(&self) -> Vec<f64> {
        (0..BATCH * self.dim)
            .map(|i| 0.1 * (1.0 + i as f64 * 0.7548776662).sin())
            .collect()
    }

    fn run(steps: usize, dim: usize) -> Run {
        Run {
            rtol: 1e-6,
            atol: vec![1e-6; dim],
            step: 1e-6,
            first: None,
            max_steps: steps as u32 + 1,
            levels: vec![1e-6 * steps as f64],
            ceiling: None,
            bounds: Vec::new(),
        }
    }

    /// Seconds of a batch with so many steps.
    fn seconds(&self, kernel: &mut dyn Kernel, steps: usize) -> f64 {
        let (run, seeds) = (Self::run(steps, self.dim), self.seeds());
        let begun = Instant::now();
        let flown = kernel.integrate(&run, &seeds).expect("the backend works");
        let seconds = begun.elapsed().as_secs_f64();
        let all = |s: &Status| *s == Status::Reached;
        assert!(flown.status.iter().all(all), "a trajectory failed");
        seconds
    }

    /// Operations, milliseconds to compile, bytes of code, microseconds a state.
    fn measure(&self, backend: &dyn Backend, precision: Precision) -> String {
        let begun = Instant::now();
        let compiled = backend.compile(&self.spec(precision));
        let mut kernel = match compiled {
            Ok(kernel) => kernel,
            Err(error) => return format!("{{\"refused\": \"{error}\"}}"),
        };
        // Kernels are compiled when they are first used; one step of a batch takes next to nothing.
        self.seconds(kernel.as_mut(), 1);
        let compile = begun.elapsed().as_secs_f64();
        let (few, many) = (8, 40);
        let least = |kernel: &mut dyn Kernel, steps: usize| {
            let all = (0..REPEATS).map(|_| self.seconds(kernel, steps));
            all.fold(f64::INFINITY, f64::min)
        };
        let both = least(kernel.as_mut(), many) - least(kernel.as_mut(), few);
        let states = (BATCH * 4 * (many - few)) as f64;
        let bytes = kernel
            .code_bytes()
            .map_or("null".to_owned(), |b| b.to_string());
        format!(
            "{{\"operations\": {}, \"compile_ms\": {:.2}, \"code_bytes\": {bytes}, \"us\": {:.5}}}",
            self.rate.operations(),
            1e3 * compile,
            1e6 * both / states
        )
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let mut sizes: Vec<usize> = arguments.iter().filter_map(|a| a.parse().ok()).collect();
    if sizes.is_empty() {
        sizes = vec![2, 3, 5, 7, 10, 15, 20, 25, 30];
    }
    let gpu = match arguments.iter().any(|a| a == "gpu") {
        true => Gpu::open(&Selection::Any).expect("an adapter"),
        false => None,
    };
    let one = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .expect("a thread");
    for links in sizes {
        let begun = Instant::now();
        let model = chain(links);
        let forward = forward(&model);
        let adjoint = adjoint(&model);
        let derive = begun.elapsed().as_secs_f64();
        let mut parts = vec![
            format!("\"links\": {links}"),
            format!("\"derive_ms\": {:.2}", 1e3 * derive),
        ];
        for (name, work) in [("forward", &forward), ("adjoint", &adjoint)] {
            for precision in [Precision::F64, Precision::F32] {
                let found = one.install(|| work.measure(&Cpu::new(), precision));
                parts.push(format!("\"{name}_{}\": {found}", precision.name()));
            }
            if let Some(gpu) = &gpu {
                let precision = Precision::F32;
                let found = work.measure(gpu, precision);
                parts.push(format!("\"{name}_gpu_{}\": {found}", precision.name()));
            }
        }
        println!("{{{}}}", parts.join(", "));
    }
}
