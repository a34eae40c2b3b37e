//! CPU against GPU: all trajectories of small systems, over precision, method and batch size.

use crate::common;

use common::{Mismatch, Side, Tolerance, any_gpu, compare};
use costate::backend::cpu::{Cpu, Simd};
use costate::backend::{Backend, By, Guards, Run, Spec, Status, Trajectories};
use costate::low_level::expr::{Fun, Graph, Id, Kind};
use costate::low_level::hamiltonian::{Hamiltonian, System};
use costate::low_level::model::{Method, Precision};
use costate::low_level::program::{Instr, Program};

/// A system with seeds on a curve around the origin.
struct Problem {
    name: &'static str,
    rate: Program,
    guards: Option<Guards>,
    /// Where the rate has kinks; met by the method of high order only, the others pass over those
    /// of these problems.
    kinks: Option<Program>,
    by: By,
    run: Run,
    /// Ways to end that are seen at the end of a step.
    loose: &'static [Status],
    /// Seed at an angle.
    seed: fn(f64) -> Vec<f64>,
}

impl Problem {
    fn spec(&self, method: Method, precision: Precision, store: bool) -> Spec {
        Spec {
            rate: self.rate.clone(),
            guards: self.guards.clone(),
            kinks: self
                .kinks
                .clone()
                .filter(|_| matches!(method, Method::Dop853 | Method::Taylor)),
            method,
            precision,
            by: self.by,
            store,
        }
    }

    fn seeds(&self, count: usize) -> Vec<f64> {
        (0..count)
            .flat_map(|i| (self.seed)(std::f64::consts::TAU * i as f64 / 345.0))
            .collect()
    }

    /// The run with tolerances a little above what the precision can give.
    fn run(&self, precision: Precision) -> Run {
        let rtol = rtol(precision);
        Run {
            rtol,
            atol: vec![1e-2 * rtol; self.rate.outputs.len()],
            ..self.run.clone()
        }
    }
}

fn rtol(precision: Precision) -> f64 {
    match precision {
        Precision::F32 => 1e-5,
        Precision::F64 => 1e-9,
    }
}

fn run(levels: Vec<f64>) -> Run {
    Run {
        rtol: 0.0,
        atol: Vec::new(),
        step: 0.02,
        first: None,
        max_steps: 2000,
        levels,
        ceiling: None,
        bounds: Vec::new(),
    }
}

/// x'' = -x with the integral of (x^2 + y^2)/2, sampled by that: neither guards nor bounds.
fn oscillator() -> Problem {
    let mut g = Graph::new();
    let (x, y) = (g.symbol("x", Kind::State), g.symbol("y", Kind::State));
    let dx = y;
    let dy = g.neg(x);
    let (xx, yy) = (g.powi(x, 2), g.powi(y, 2));
    let sum = g.add(xx, yy);
    let half = g.constant(0.5);
    let cost = g.mul(half, sum);
    Problem {
        name: "oscillator",
        rate: Program::lower(&g, &[x, y], &[dx, dy, cost]),
        guards: None,
        kinks: None,
        by: By::Component(2),
        run: run((1..=20).map(|k| 0.1 * f64::from(k)).collect()),
        loose: &[],
        seed: |a| {
            vec![
                (1.0 + 0.3 * a.sin()) * a.cos(),
                (1.0 + 0.3 * a.sin()) * a.sin(),
                0.0,
            ]
        },
    }
}

/// A damped pendulum run backward from around its rest by time, with a guard on the angle and
/// bounds on both.
fn pendulum() -> Problem {
    let mut g = Graph::new();
    let (q, w) = (g.symbol("q", Kind::State), g.symbol("w", Kind::State));
    let dq = g.neg(w);
    let s = g.unary(Fun::Sin, q);
    let c = g.unary(Fun::Cos, q);
    let damping = g.constant(0.4);
    let drag = g.mul(damping, w);
    let dw = g.add(s, drag);
    // Energy-like third component, to have one that no derivative depends on.
    let ws = g.mul(w, c);
    let one = g.constant(1.0);
    let de = g.add(ws, one);
    let limit = g.constant(2.0);
    let size = g.unary(Fun::Abs, q);
    let guard = g.sub(limit, size);
    let mut run = run((0..=24).map(|k| 0.25 * f64::from(k)).collect());
    // Leaving the region is seen at a step's end, so a bound must not be met there to rounding.
    run.bounds = vec![[-1.613, 3.0], [-4.0, 4.0]];
    Problem {
        name: "pendulum",
        rate: Program::lower(&g, &[q, w], &[dq, dw, de]),
        guards: Some(Guards {
            program: Program::lower(&g, &[q, w], &[guard]),
            strict: vec![true],
        }),
        kinks: None,
        by: By::Time,
        run,
        loose: &[Status::LeftRegion],
        seed: |a| vec![0.6 * a.cos() + 0.1, 0.6 * a.sin(), 0.0],
    }
}

/// Every primitive, in a system that stays bounded; sampled by arc length with a ceiling on time's
/// own component.
fn functions() -> Problem {
    let mut g = Graph::new();
    let (x, y) = (g.symbol("x", Kind::State), g.symbol("y", Kind::State));
    let constant = |g: &mut Graph, v: f64| g.constant(v);
    let call = |g: &mut Graph, f: Fun, a: Id| g.unary(f, a);
    let one = constant(&mut g, 1.0);
    let (xx, yy) = (g.powi(x, 2), g.powi(y, 2));
    let e = {
        let n = g.neg(xx);
        call(&mut g, Fun::Exp, n)
    };
    let at = call(&mut g, Fun::Atan, y);
    let log = {
        let u = g.add(one, yy);
        call(&mut g, Fun::Log, u)
    };
    let root = {
        let u = g.add(one, xx);
        call(&mut g, Fun::Sqrt, u)
    };
    let (lo, hi) = (constant(&mut g, -0.5), constant(&mut g, 0.5));
    let clamped = {
        let m = g.max(x, lo);
        g.min(m, hi)
    };
    let tanh = call(&mut g, Fun::Tanh, x);
    let small = call(&mut g, Fun::Log1p, xx);
    let grown = {
        let n = g.neg(yy);
        call(&mut g, Fun::Expm1, n)
    };
    let sine = call(&mut g, Fun::Sin, y);
    let third = constant(&mut g, 0.3);
    let terms = [g.mul(third, at), g.neg(tanh), g.mul(e, sine)];
    let dx = g.sum(&terms);
    // The clamp's and the absolute value's kinks are kept weak: an error estimate takes a step
    // across a kink for better than it is, and the two sides cross it at different places.
    let weak = constant(&mut g, 0.002);
    let terms = [
        g.neg(y),
        g.mul(weak, clamped),
        g.mul(third, log),
        g.mul(third, grown),
    ];
    let dy = g.sum(&terms);
    let speed = {
        let a = g.add(root, small);
        let v = call(&mut g, Fun::Abs, y);
        let v = g.mul(weak, v);
        g.add(a, v)
    };
    let mut run = run((1..=30).map(|k| 0.2 * f64::from(k)).collect());
    run.ceiling = Some((3, 4.0));
    let roots = [dx, dy, speed, one];
    let kinks = g.kinks(&roots);
    Problem {
        name: "functions",
        rate: Program::lower(&g, &[x, y], &roots),
        guards: None,
        kinks: Some(Program::lower(&g, &[x, y], &kinks)),
        by: By::Component(2),
        run,
        loose: &[Status::Reached],
        seed: |a| vec![1.5 * a.cos(), 1.2 * a.sin() + 0.4, 0.0, 0.0],
    }
}

fn problems() -> [Problem; 3] {
    [oscillator(), pendulum(), functions()]
}

fn integrate(backend: &dyn Backend, spec: &Spec, run: &Run, seeds: &[f64]) -> Trajectories {
    backend
        .compile(spec)
        .and_then(|mut k| k.integrate(run, seeds))
        .unwrap_or_else(|e| panic!("{}: {e}", backend.name()))
}

/// What the two sides may differ by.
fn tolerance(problem: &Problem, method: Method, precision: Precision) -> Tolerance {
    match method {
        // A fixed step: rounding, one unit a stage of up to 400 steps, grown by at most e^(0.4 * 6)
        // = 11 in the pendulum and located with a root search of a few units; random signs leave
        // about the root of the count.
        Method::Rk4 => {
            let unit = 2000.0 * precision.epsilon();
            Tolerance {
                relative: unit,
                absolute: unit,
                steps: |_| 0,
                loose: &[],
            }
        }
        // Steps that differ by rounding in the step control: each side is within its tolerance,
        // times the growth. In f32 the error estimate itself is known to 1 %, so now and then one
        // side rejects what the other accepts.
        Method::Tsit5 | Method::Dop853 | Method::Taylor => Tolerance {
            relative: 10.0 * rtol(precision),
            absolute: 10.0 * rtol(precision),
            steps: match (method, &problem.kinks) {
                // Weights of up to 43 in the stages bring their rounding near f32's tolerance: the
                // estimate is known to a factor of two or so.
                (Method::Dop853, None) => |steps| 2 + steps / 4,
                // A kink is met after some three refused steps, more or fewer; up to 6 are passed.
                (Method::Dop853, Some(_)) => |steps| 2 + 6 * 3 + steps / 4,
                _ => |steps| 2 + steps / 8,
            },
            loose: problem.loose,
        },
    }
}

const METHODS: [Method; 4] = [Method::Rk4, Method::Tsit5, Method::Dop853, Method::Taylor];
const PRECISIONS: [Precision; 2] = [Precision::F32, Precision::F64];

#[test]
fn gpu_agrees_with_cpu() {
    let (cpu, gpu) = (Cpu::new(), any_gpu());
    for problem in problems() {
        for method in METHODS {
            for precision in PRECISIONS {
                for store in [true, false] {
                    let spec = problem.spec(method, precision, store);
                    let run = problem.run(precision);
                    let mut kernel = gpu.compile(&spec).unwrap();
                    // Its estimate is half made of rounding, which decides on its steps and on
                    // where they leave the region.
                    let rough = method == Method::Dop853 && precision == Precision::F32;
                    for count in [1, 63, 65, 345] {
                        let seeds = problem.seeds(count);
                        let a = integrate(&cpu, &spec, &run, &seeds);
                        let b = kernel.integrate(&run, &seeds).unwrap();
                        let (a, b) = (
                            Side {
                                backend: cpu.name(),
                                result: &a,
                            },
                            Side {
                                backend: gpu.name(),
                                result: &b,
                            },
                        );
                        let case = format!(
                            "{} {method:?} {precision:?} store {store} count {count}",
                            problem.name
                        );
                        let mut allowed = tolerance(&problem, method, precision);
                        if rough {
                            allowed.steps = |_| u32::MAX;
                        }
                        match compare(a, b, allowed) {
                            Ok(agreement) => {
                                // Those that only just leave the region.
                                let most = if rough { count / 8 } else { count / 30 };
                                assert!(
                                    agreement.split <= most,
                                    "{case}: {} split",
                                    agreement.split
                                );
                                assert_eq!(
                                    store,
                                    agreement.samples > 0,
                                    "{case}: nothing was sampled"
                                );
                                println!(
                                    "{case}: {:.3} of the tolerance, {} values",
                                    agreement.worst, agreement.values
                                );
                            }
                            Err(e) => panic!("{case}: {e}"),
                        }
                    }
                }
            }
        }
    }
}

/// `x' = -((x + 0.3) - 0.3)`: a sum from which its constant is taken again is no rounding to an
/// integer, as it is in elementary functions.
#[test]
fn a_constant_added_and_taken_away() {
    let gpu = any_gpu();
    let rate = Program {
        inputs: 1,
        code: vec![
            Instr::Input(0),
            Instr::Const(0.3),
            Instr::Add(0, 1),
            Instr::Sub(2, 1),
            Instr::Neg(3),
        ],
        outputs: vec![4],
    };
    for method in METHODS {
        let spec = Spec {
            rate: rate.clone(),
            guards: None,
            kinks: None,
            method,
            precision: Precision::F64,
            by: By::Time,
            store: false,
        };
        let run = Run {
            rtol: 1e-9,
            atol: vec![1e-11],
            ..run(vec![1.0])
        };
        let end = integrate(&gpu, &spec, &run, &[0.75]).end[0];
        let exact = 0.75 * (-1.0f64).exp();
        assert!((end - exact).abs() < 1e-7, "{method:?}: {end} for {exact}");
    }
}

#[test]
fn compiled_steps_compute_the_bits_of_interpreted_ones() {
    let widest = Simd::detect();
    if crate::common::without_avx2(widest == Simd::Baseline) {
        return;
    }
    let interpreting = Cpu::interpreting(widest).expect("the set was detected");
    let compiling: Vec<Cpu> = (Simd::ALL.iter())
        .filter_map(|simd| Cpu::compiling(*simd))
        .collect();
    assert!(!compiling.is_empty(), "nothing is compiled here");
    for problem in problems() {
        for method in Method::ALL.map(|(_, m)| m) {
            for (precision, store) in [
                (Precision::F32, true),
                (Precision::F64, true),
                (Precision::F64, false),
            ] {
                let spec = Spec {
                    kinks: problem.kinks.clone(),
                    ..problem.spec(method, precision, store)
                };
                let (run, seeds) = (problem.run(precision), problem.seeds(77));
                let b = integrate(&interpreting, &spec, &run, &seeds);
                for compiling in &compiling {
                    let a = integrate(compiling, &spec, &run, &seeds);
                    let (name, on) = (problem.name, compiling.adapter());
                    let case = format!("{name} {method:?} {precision:?} store {store} on {on}");
                    assert_eq!(
                        (&a.status, &a.steps, &a.rejected),
                        (&b.status, &b.steps, &b.rejected),
                        "{case}"
                    );
                    let bits = |v: &[f64]| v.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
                    assert_eq!(bits(&a.end), bits(&b.end), "{case}: ends");
                    assert_eq!(bits(&a.samples), bits(&b.samples), "{case}: samples");
                }
            }
        }
    }
}

/// The interpreter without fused products, as on machines without AVX2, against the compiled steps.
#[test]
fn every_machine_computes_the_same_trajectories() {
    let baseline = Cpu::interpreting(Simd::Baseline).expect("any machine has it");
    for problem in problems() {
        for method in [Method::Tsit5, Method::Taylor] {
            let spec = problem.spec(method, Precision::F64, true);
            let (run, seeds) = (problem.run(Precision::F64), problem.seeds(77));
            let (a, b) = (
                integrate(&Cpu::new(), &spec, &run, &seeds),
                integrate(&baseline, &spec, &run, &seeds),
            );
            let (a, b) = (
                Side {
                    backend: "compiled",
                    result: &a,
                },
                Side {
                    backend: "baseline",
                    result: &b,
                },
            );
            let case = format!("{} {method:?}", problem.name);
            compare(a, b, tolerance(&problem, method, Precision::F64))
                .unwrap_or_else(|e| panic!("{case}: {e}"));
        }
    }
}

/// Taylor series, which only the CPU has, against Runge-Kutta steps: all samples, ends and times.
#[test]
fn taylor_agrees_with_runge_kutta() {
    for problem in problems() {
        for precision in PRECISIONS {
            let result = |method| {
                let spec = problem.spec(method, precision, true);
                integrate(
                    &Cpu::new(),
                    &spec,
                    &problem.run(precision),
                    &problem.seeds(345),
                )
            };
            let (a, b) = (result(Method::Taylor), result(Method::Dop853));
            let (a, b) = (
                Side {
                    backend: "taylor",
                    result: &a,
                },
                Side {
                    backend: "dop853",
                    result: &b,
                },
            );
            let case = format!("{} {precision:?}", problem.name);
            let allowed = Tolerance {
                // Their numbers of steps have nothing to do with each other.
                steps: |_| u32::MAX,
                ..tolerance(&problem, Method::Taylor, precision)
            };
            let agreement = compare(a, b, allowed).unwrap_or_else(|e| panic!("{case}: {e}"));
            assert!(agreement.samples > 0, "{case}: nothing was sampled");
            println!("{case}: {:.3} of the tolerance", agreement.worst);
        }
    }
}

#[test]
fn every_way_to_end_is_compared() {
    let gpu = any_gpu();
    let mut seen = Vec::new();
    for problem in problems() {
        for max_steps in [2000, 5] {
            let run = Run {
                first: None,
                max_steps,
                ..problem.run(Precision::F64)
            };
            let spec = problem.spec(Method::Tsit5, Precision::F64, false);
            seen.extend(integrate(&gpu, &spec, &run, &problem.seeds(345)).status);
        }
    }
    for status in [
        Status::Reached,
        Status::LeftRegion,
        Status::Guard,
        Status::StepLimit,
    ] {
        assert!(seen.contains(&status), "no trajectory ended as {status:?}");
    }
}

#[test]
fn comparator_catches_what_it_must() {
    let problem = oscillator();
    let spec = problem.spec(Method::Tsit5, Precision::F64, true);
    let result = integrate(
        &Cpu::new(),
        &spec,
        &problem.run(Precision::F64),
        &problem.seeds(65),
    );
    let allowed = tolerance(&problem, Method::Tsit5, Precision::F64);
    let against = |other: &Trajectories| {
        compare(
            Side {
                backend: "cpu",
                result: &result,
            },
            Side {
                backend: "gpu",
                result: other,
            },
            allowed,
        )
    };
    assert!(against(&result).is_ok());
    let same = compare(
        Side {
            backend: "cpu",
            result: &result,
        },
        Side {
            backend: "cpu",
            result: &result,
        },
        allowed,
    );
    assert_eq!(same.unwrap_err(), Mismatch::SameBackend("cpu".to_owned()));

    let perturbed = |change: &dyn Fn(&mut Trajectories)| {
        let mut other = result.clone();
        change(&mut other);
        against(&other).expect_err("a perturbed result passed")
    };
    // A little more than allowed, for values up to 2.
    let off = 1.5 * (allowed.absolute + 2.0 * allowed.relative);
    assert!(matches!(
        perturbed(&|t| t.end[64 * 3 + 1] += off),
        Mismatch::Value { trajectory: 64, .. }
    ));
    assert!(matches!(
        perturbed(&|t| *t.samples.last_mut().unwrap() -= off),
        Mismatch::Value { trajectory: 64, .. }
    ));
    assert!(matches!(
        perturbed(&|t| t.end_time[7] = f64::NAN),
        Mismatch::Value { trajectory: 7, .. }
    ));
    assert!(matches!(
        perturbed(&|t| t.status[3] = Status::Guard),
        Mismatch::Status { trajectory: 3, .. }
    ));
    assert!(matches!(
        perturbed(&|t| t.steps[5] += 20),
        Mismatch::Steps { trajectory: 5, .. }
    ));
    assert!(matches!(
        perturbed(&|t| t.samples[4 * 4] = f64::NAN),
        Mismatch::Passed { level: 4, .. }
    ));
    assert!(matches!(perturbed(&|t| t.levels -= 1), Mismatch::Shape));
}

/// The bits of a result; NaNs compare equal.
fn bits(t: &Trajectories, from: usize, to: usize) -> (Vec<u64>, Vec<Status>, Vec<u32>) {
    let width = t.levels * (1 + t.dim);
    let numbers = (t.end[from * t.dim..to * t.dim].iter())
        .chain(&t.end_time[from..to])
        .chain(&t.samples[from * width..to * width])
        .map(|x| if x.is_nan() { u64::MAX } else { x.to_bits() })
        .collect();
    let counters = t.steps[from..to]
        .iter()
        .chain(&t.rejected[from..to])
        .copied()
        .collect();
    (numbers, t.status[from..to].to_vec(), counters)
}

#[test]
fn results_do_not_depend_on_the_batch() {
    let gpu = any_gpu();
    for problem in problems() {
        for precision in PRECISIONS {
            let spec = problem.spec(Method::Tsit5, precision, true);
            let run = problem.run(precision);
            let seeds = problem.seeds(345);
            let dim = spec.dim();
            let whole = integrate(&gpu, &spec, &run, &seeds);
            let mut kernel = gpu.compile(&spec).unwrap();
            // Alone, in pieces, and again after other batches went through the same buffers.
            for (from, to) in [(0, 1), (344, 345), (0, 63), (63, 128), (128, 345), (0, 345)] {
                let part = kernel
                    .integrate(&run, &seeds[from * dim..to * dim])
                    .unwrap();
                let case = format!("{} {precision:?} {from}..{to}", problem.name);
                assert!(
                    bits(&part, 0, to - from) == bits(&whole, from, to),
                    "{case}: other bits than in the whole batch"
                );
            }
        }
    }
}

#[test]
fn an_empty_batch_is_empty() {
    let problem = oscillator();
    let spec = problem.spec(Method::Rk4, Precision::F32, true);
    assert_eq!(
        integrate(&any_gpu(), &spec, &problem.run(Precision::F32), &[]).count(),
        0
    );
}

/// Right-hand sides that are too long for a copy at each stage.
#[test]
fn long_equations_on_a_device() {
    const LINKS: usize = 12;
    let each = |line: &dyn Fn(usize) -> String| -> String { (1..=LINKS).map(line).collect() };
    let terms: Vec<String> = (1..=LINKS)
        .map(|k| format!("link{k}^2 + link{k}_rate^2 + u{k}^2"))
        .collect();
    let scene = format!(
        "[mechanism]\ngravity = [0, -9.81]\n[mechanism.bodies]\n\
         link = {{ chain = {LINKS}, joint = \"revolute\", at = [0.5, 0], mass = 1, shape = {{ rod = 0.5 }} }}\n\
         [mechanism.forces]\n{}[controls]\n{}[cost]\nrunning = \"0.5*({})\"\nterminal = \"0\"\nfinal_time = 1\n[region]\n{}",
        each(&|k| format!("link{k} = \"u{k}\"\n")),
        each(&|k| format!("u{k} = {{}}\n")),
        terms.join(" + "),
        each(&|k| format!("link{k} = [-3, 3]\nlink{k}_rate = [-3, 3]\n")),
    );
    let model = costate::low_level::scenario::parse(&scene, "chain.toml", &[]).unwrap();
    let hamiltonian = Hamiltonian::derive(&model).unwrap();
    let system = System::new(&hamiltonian, &model);
    let rate = Program::lower(&system.graph, &system.inputs, &system.rate);
    assert!(rate.operations() > 2000, "{}", rate.operations());
    let dim = rate.outputs.len();
    let seeds: Vec<f64> = (0..40 * dim)
        .map(|i| 0.2 * (1.0 + i as f64 * 0.7548776662).sin())
        .collect();
    let (cpu, gpu) = (Cpu::new(), any_gpu());
    for (method, store) in [(Method::Dop853, true), (Method::Rk4, false)] {
        let spec = Spec {
            rate: rate.clone(),
            guards: None,
            kinks: None,
            method,
            precision: Precision::F64,
            by: By::Time,
            store,
        };
        let run = Run {
            rtol: 1e-8,
            atol: vec![1e-8; dim],
            step: 1e-3,
            first: None,
            max_steps: 1000,
            levels: vec![0.01, 0.02],
            ceiling: None,
            bounds: Vec::new(),
        };
        let here = integrate(&cpu, &spec, &run, &seeds);
        let there = gpu.compile(&spec).unwrap().integrate(&run, &seeds).unwrap();
        assert_eq!(here.status, there.status);
        assert!(here.status.iter().all(|s| *s == Status::Reached));
        assert!(there.samples.len() == here.samples.len() && (store != here.samples.is_empty()));
        for (a, b) in here
            .end
            .iter()
            .zip(&there.end)
            .chain(here.samples.iter().zip(&there.samples))
        {
            assert!(
                (a - b).abs() < 1e-9 * a.abs().max(1.0),
                "{method:?}: {a} {b}"
            );
        }
    }
}

/// An adapter is opened by its number, or a part of its name; others are refused.
#[test]
fn an_adapter_has_a_number() {
    use costate::backend::adapters::{Selection, adapters};
    use costate::backend::gpu::Gpu;
    drop(any_gpu());
    let all = adapters();
    for (k, info) in all.iter().enumerate() {
        let open = Gpu::open(&Selection::Named(k.to_string()));
        let open = open.unwrap().expect("it is in the list");
        assert_eq!(open.info().name, info.name);
    }
    let none = Gpu::open(&Selection::Named((all.len() + 7_000_000).to_string()));
    assert!(none.is_err());
}
