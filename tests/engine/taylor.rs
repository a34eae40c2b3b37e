//! Taylor's method where series are treacherous: solutions that are polynomials, steps that begin
//! exactly on a kink or touch one, kinks crossed at tight tolerances.

use crate::common_oracles;

use common_oracles::parse;
use costate::backend::{Backend, BackendError, Trajectories, cpu::Cpu};
use costate::low_level::hamiltonian::Hamiltonian;
use costate::low_level::model::{Method, Precision};
use costate::low_level::sweep::{Choices, Plan, sweep_keeping};

/// A scene's seeds, and all of their samples by each method.
fn integrate(scene: &str, rtol: f64, methods: &[Method]) -> (Plan, Vec<Trajectories>) {
    let model = parse(scene);
    let hamiltonian = Hamiltonian::derive(&model).expect("the scene is in the class");
    let cpu = Cpu::new();
    let plan = |method| {
        let choices = Choices {
            method: Some(method),
            rtol: Some(rtol),
            precision: Some(Precision::F64),
            max_seeds: Some(400),
            ..Choices::default()
        };
        Plan::new(&model, &hamiltonian, &cpu, choices).expect("the scene can be swept")
    };
    let first = plan(Method::Tsit5);
    let mut seeds = Vec::new();
    let mut keep = |s: &[f64], _: &Trajectories| seeds.extend_from_slice(s);
    sweep_keeping::<BackendError>(&first, &cpu, &mut |_, _| {}, &mut keep, None)
        .expect("the CPU works");
    let results = (methods.iter())
        .map(|m| {
            let plan = plan(*m);
            let mut kernel = cpu.compile(&plan.spec).expect("it compiles");
            kernel.integrate(&plan.run, &seeds).expect("it runs")
        })
        .collect();
    (first, results)
}

/// Largest difference of two results at points that both have, relative to 1 or more; and how many
/// there are.
fn difference(a: &Trajectories, b: &Trajectories) -> (f64, usize) {
    let (mut worst, mut points) = (0.0f64, 0);
    for i in 0..a.count() {
        for level in 0..a.levels {
            let (x, y) = (a.sample(i, level), b.sample(i, level));
            if x[0].is_nan() || y[0].is_nan() {
                continue;
            }
            points += 1;
            for (x, y) in x.iter().zip(y) {
                worst = worst.max((x - y).abs() / y.abs().max(1.0));
            }
        }
    }
    (worst, points)
}

/// A limited control drives an integrator: the solution is a polynomial in time. On |x| <= 0.2, p =
/// x; beyond, H = 0 with u = -0.2 gives p = (x^2/2 + 0.02)/0.2.
#[test]
fn a_polynomial_solution() {
    let scene = "states = { x = {} }\ncontrols = { u = { min = -0.2, max = 0.2 } }\ndynamics = { x = \"u\" }\n\
                 cost = { running = \"0.5*(x^2+u^2)\" }\nequilibrium = { x = 0, u = 0 }\nregion = { x = [-1, 1] }\n\
                 shoot_out = { spacing = 0.2, samples = 30, value_max = 0.5 }\n";
    for rtol in [1e-4, 1e-7, 1e-10, 1e-13] {
        let (_, results) = integrate(scene, rtol, &[Method::Taylor]);
        let mut seen = 0;
        for i in 0..results[0].count() {
            for level in 0..results[0].levels {
                let s = results[0].sample(i, level);
                let (x, p, v) = (s[1].abs(), s[2].abs(), s[3]);
                if s[0].is_nan() {
                    continue;
                }
                seen += 1;
                let outer = |x: f64| (x * x * x / 6.0 + 0.02 * x) / 0.2;
                let (exact_p, exact_v) = if x <= 0.2 {
                    (x, 0.5 * x * x)
                } else {
                    ((0.5 * x * x + 0.02) / 0.2, 0.02 + outer(x) - outer(0.2))
                };
                let bound = 100.0 * rtol.max(1e-13);
                assert!(
                    (v - exact_v).abs() <= bound,
                    "rtol {rtol:e}: V = {v} at {x}, not {exact_v}"
                );
                assert!(
                    (p - exact_p).abs() <= bound,
                    "rtol {rtol:e}: p = {p} at {x}, not {exact_p}"
                );
            }
        }
        assert!(seen > 40, "{seen} samples");
    }
}

/// Steps that begin exactly on a kink, or touch it: seeds of a region symmetric about it.
#[test]
fn seeds_on_kinks() {
    let scenes = [
        // abs at its zero.
        "states = { x = {}, v = {} }\ncontrols = { u = {} }\ndynamics = { x = \"v\", v = \"-abs(x) + u\" }\n\
         cost = { running = \"0.5*u^2\", terminal = \"x^2 + v^2\", final_time = 2 }\nregion = { x = [-1, 1], v = [-1, 1] }\n\
         shoot_out = { spacing = 0.2, samples = 30, margin = 100 }\n",
        // Kinks away from zero, with a clamp.
        "states = { x = {}, y = {} }\ncontrols = { u = { min = -0.3, max = 0.3 } }\n\
         dynamics = { x = \"u\", y = \"abs(x + 0.5) - abs(x - 0.5)\" }\n\
         cost = { running = \"0.5*u^2\", terminal = \"x^2 + y^2\", final_time = 2 }\nregion = { x = [-1, 1], y = [-1, 1] }\n\
         shoot_out = { spacing = 0.2, samples = 30, margin = 100 }\n",
        // A clamp touched with zero slope where the trajectory begins.
        "states = { x = {}, v = {} }\ncontrols = { u = { min = -1, max = 1 } }\ndynamics = { x = \"v\", v = \"u\" }\n\
         cost = { running = \"0.5*(x^2 + v^2 + u^2)\", terminal = \"x^2 + v^2\", final_time = 3 }\n\
         region = { x = [-2, 2], v = [-2, 2] }\nshoot_out = { spacing = 0.2, samples = 30, margin = 100 }\n",
    ];
    for scene in scenes {
        let (_, results) = integrate(scene, 1e-10, &[Method::Taylor, Method::Dop853]);
        let (worst, points) = difference(&results[0], &results[1]);
        println!(
            "{worst:.1e} over {points} points: {}",
            scene.lines().nth(2).unwrap_or("")
        );
        // A step of either may begin within a kink's margin; each is within its tolerance, grown by
        // what these flows grow.
        assert!(
            points > 1000 && worst <= 1e-7,
            "{worst:e} over {points} points of\n{scene}"
        );
    }
}

/// Linear dynamics under a clamp in two dimensions, swept: no step jumps over what lies between.
#[test]
fn a_limited_double_integrator() {
    let scene = "states = { x = {}, v = {} }\ncontrols = { u = { min = -0.2, max = 0.2 } }\n\
                 dynamics = { x = \"v\", v = \"u\" }\ncost = { running = \"0.5*(x^2 + v^2 + u^2)\" }\n\
                 equilibrium = { x = 0, v = 0, u = 0 }\nregion = { x = [-1, 1], v = [-1, 1] }\n\
                 shoot_out = { spacing = 0.1, samples = 50, value_max = 1.0 }\n";
    for rtol in [1e-6, 1e-9, 1e-12] {
        let (_, results) = integrate(scene, rtol, &[Method::Taylor, Method::Dop853]);
        assert_eq!(results[0].status, results[1].status);
        let (worst, points) = difference(&results[0], &results[1]);
        assert!(
            points > 1000 && worst <= 1e3 * rtol,
            "{worst:e} over {points} points at {rtol:e}"
        );
    }
}

/// A kink of the dynamics near the equilibrium: seeds stay on its near side, where their series
/// holds. |H|, which sees seeds off the manifold, is then what the tolerance allows.
#[test]
fn seeds_stay_short_of_kinks() {
    let scene = "states = { x = {}, v = {} }\ncontrols = { u = {} }\n\
                 dynamics = { x = \"v\", v = \"-x + 0.5*abs(abs(x + 0.4) - 0.5) - 0.05 + u\" }\n\
                 cost = { running = \"0.5*(x^2 + v^2 + u^2)\" }\nequilibrium = { x = 0, v = 0, u = 0 }\n\
                 region = { x = [-1, 1], v = [-1, 1] }\nshoot_out = { spacing = 0.2, samples = 30, value_max = 1.0 }\n";
    for method in [Method::Taylor, Method::Tsit5] {
        let (plan, results) = integrate(scene, 1e-9, &[method]);
        let n = plan.system.states;
        let result = &results[0];
        let (mut worst, mut points) = (0.0f64, 0);
        for i in 0..result.count() {
            for level in 0..result.levels {
                let s = result.sample(i, level);
                if s[0].is_nan() {
                    continue;
                }
                let running = plan.system.rate[2 * n];
                let values = plan.system.eval(
                    &[plan.system.observer.hamiltonian, running],
                    &s[1..=n],
                    &s[1 + n..=2 * n],
                );
                worst = worst.max(values[0].abs() / values[1].abs());
                points += 1;
            }
        }
        println!(
            "{}: |H| {worst:.1e} of the running cost at {points} points",
            method.name()
        );
        assert!(
            points > 500 && worst < 1e-6,
            "{}: {worst:e} at {points} points",
            method.name()
        );
    }
}
