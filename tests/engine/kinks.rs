//! Right-hand sides with kinks against an exact solution: adaptive steps end at the kinks, on both
//! backends.

use crate::common;

use common::{Side, Tolerance, any_gpu, compare};
use costate::backend::cpu::Cpu;
use costate::backend::{Backend, By, Run, Spec, Status, Trajectories};
use costate::low_level::expr::{Graph, Kind};
use costate::low_level::model::{Method, Precision};
use costate::low_level::program::Program;
use std::f64::consts::{FRAC_PI_3, PI, TAU};

/// How long trajectories are followed: some 6 kinks each.
const TIME: f64 = 6.0;
const COUNT: usize = 345;

/// A point on the unit circle pushes a cart, the push limited: `c' = -s, s' = c, z' = min(max(2c,
/// -1), 1)`.
fn spec(method: Method, precision: Precision, kinks: bool) -> Spec {
    let mut g = Graph::new();
    let inputs = [g.symbol("c", Kind::State), g.symbol("s", Kind::State)];
    let [c, s] = inputs;
    let (low, high, two) = (g.constant(-1.0), g.constant(1.0), g.constant(2.0));
    let dc = g.neg(s);
    let push = g.mul(two, c);
    let above = g.max(push, low);
    let limited = g.min(above, high);
    let roots = [dc, c, limited];
    let switches = g.kinks(&roots);
    assert_eq!(switches.len(), 2);
    Spec {
        rate: Program::lower(&g, &inputs, &roots),
        guards: None,
        kinks: kinks.then(|| Program::lower(&g, &inputs, &switches)),
        method,
        precision,
        by: By::Time,
        store: false,
    }
}

fn rtol(precision: Precision) -> f64 {
    match precision {
        Precision::F32 => 1e-5,
        Precision::F64 => 1e-10,
    }
}

fn run(precision: Precision) -> Run {
    let rtol = rtol(precision);
    Run {
        rtol,
        atol: vec![rtol; 3],
        step: 0.0,
        first: None,
        max_steps: 2000,
        levels: vec![TIME],
        ceiling: None,
        bounds: Vec::new(),
    }
}

fn angle(i: usize) -> f64 {
    TAU * i as f64 / COUNT as f64
}

fn seeds() -> Vec<f64> {
    (0..COUNT)
        .flat_map(|i| [angle(i).cos(), angle(i).sin(), 0.0])
        .collect()
}

/// Integral of `min(max(2 cos, -1), 1)` from 0 to an angle; whole turns give nothing.
fn integral(angle: f64) -> f64 {
    let a = angle.rem_euclid(TAU);
    // The integral from 0 to a half turn is symmetric about its middle.
    let quarter = |a: f64| {
        a.min(FRAC_PI_3)
            + if a > FRAC_PI_3 {
                2.0 * (a.sin() - FRAC_PI_3.sin())
            } else {
                0.0
            }
    };
    let half = |a: f64| {
        if a <= 0.5 * PI {
            quarter(a)
        } else {
            quarter(PI - a)
        }
    };
    if a <= PI { half(a) } else { -half(a - PI) }
}

/// Largest error of the end of any trajectory.
fn worst(result: &Trajectories) -> f64 {
    assert!(result.status.iter().all(|s| *s == Status::Reached));
    (0..COUNT)
        .flat_map(|i| {
            let (from, to) = (angle(i), angle(i) + TIME);
            let exact = [to.cos(), to.sin(), integral(to) - integral(from)];
            (0..3).map(move |c| (result.end[3 * i + c] - exact[c]).abs())
        })
        .fold(0.0, f64::max)
}

fn integrate(backend: &dyn Backend, spec: &Spec) -> Trajectories {
    backend
        .compile(spec)
        .and_then(|mut kernel| kernel.integrate(&run(spec.precision), &seeds()))
        .unwrap_or_else(|e| panic!("{}: {e}", backend.name()))
}

const METHODS: [Method; 3] = [Method::Tsit5, Method::Dop853, Method::Taylor];

/// Errors of all steps add up: at most the tolerance (relative and absolute) a step, and in f32 one
/// unit of rounding a step and stage on top.
fn allowed(precision: Precision, steps: u32) -> f64 {
    const STAGES: f64 = 12.0;
    f64::from(steps) * (2.0 * rtol(precision) + STAGES * precision.epsilon())
}

#[test]
fn steps_end_at_kinks() {
    let (cpu, gpu) = (Cpu::new(), any_gpu());
    let backends: [&dyn Backend; 2] = [&cpu, &gpu];
    for backend in backends {
        for method in METHODS.into_iter().filter(|m| backend.offers(*m)) {
            for precision in [Precision::F32, Precision::F64] {
                let case = format!("{} {method:?} {precision:?}", backend.name());
                let with = integrate(backend, &spec(method, precision, true));
                let without = integrate(backend, &spec(method, precision, false));
                let most = with.steps.iter().copied().max().unwrap_or(0);
                let (a, b) = (worst(&with), worst(&without));
                let attempts =
                    |t: &Trajectories| -> u32 { t.steps.iter().chain(&t.rejected).sum() };
                println!(
                    "{case}: error {a:.2e} in {} steps, {b:.2e} in {} without kinks; allowed {:.2e}",
                    attempts(&with),
                    attempts(&without),
                    allowed(precision, most)
                );
                assert!(a <= allowed(precision, most), "{case}: {a:e}");
                if precision == Precision::F64 {
                    assert!(b > 10.0 * a, "{case}: {b:e} without kinks, {a:e} with them");
                }
            }
        }
    }
}

#[test]
fn backends_agree_at_kinks() {
    let (cpu, gpu) = (Cpu::new(), any_gpu());
    for method in METHODS.into_iter().filter(|m| gpu.offers(*m)) {
        for precision in [Precision::F32, Precision::F64] {
            let spec = spec(method, precision, true);
            let (a, b) = (integrate(&cpu, &spec), integrate(&gpu, &spec));
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
            // Steps differ by rounding in their control: each side is within its tolerance. A kink
            // is met after some three refused steps, more or fewer by where the step before ended;
            // there are 6 on the way.
            let tolerance = Tolerance {
                relative: 10.0 * rtol(precision),
                absolute: 10.0 * rtol(precision),
                steps: |steps| 2 + 6 * 3 + steps / 4,
                loose: &[],
            };
            let agreement = compare(a, b, tolerance)
                .unwrap_or_else(|e| panic!("{method:?} {precision:?}: {e}"));
            println!(
                "{method:?} {precision:?}: {:.3} of the tolerance",
                agreement.worst
            );
        }
    }
}

/// The last step must not be stretched over a kink that lies just before the end.
#[test]
fn a_kink_just_before_the_end_is_met() {
    let kink = FRAC_PI_3;
    let backends: [&dyn Backend; 2] = [&Cpu::new(), &any_gpu()];
    for backend in backends {
        let spec = spec(Method::Dop853, Precision::F64, true);
        let mut kernel = backend.compile(&spec).unwrap();
        // Kinks at all shares of the last step from its first 10th to its last millionth.
        for exponent in 1..=60 {
            let gap = 10f64.powf(-0.1 * f64::from(exponent));
            let levels = vec![kink + gap * 0.01];
            let run = Run {
                levels,
                ..run(Precision::F64)
            };
            let result = kernel.integrate(&run, &[1.0, 0.0, 0.0]).unwrap();
            let end = kink + gap * 0.01;
            assert_eq!(
                result.status[0],
                Status::Reached,
                "{} gap {gap:e}",
                backend.name()
            );
            let error = (result.end[2] - integral(end)).abs();
            assert!(
                error <= allowed(Precision::F64, result.steps[0]),
                "{}: {error:e}",
                backend.name()
            );
        }
    }
}
