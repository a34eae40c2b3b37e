//! V, p and u at states of the scenes in scenarios/hard: boundary value problems where shooting has
//! its limits.

use crate::common;
use crate::common_problems::{Exact, manufactured, parameter};
use crate::common_values;

use common::any_gpu;
use common_values::{Swept, given, largest, scene};
use costate::backend::{Backend, cpu::Cpu};
use costate::low_level::model::Model;
use costate::low_level::sweep::stiffness;
use costate::low_level::value::{self, Answers, Entry, Request};

/// What solutions are asked to: 1e-9 of the trajectory; ten times that for its parts.
const SOLVED: f64 = 1e-8;

fn hard(name: &str) -> Model {
    scene(&format!("hard/{name}"), &[])
}

fn both(
    model: &Model,
    seeds: usize,
    mut look: impl FnMut(&Swept, &dyn Fn(&[f64]) -> Answers, &str),
) {
    for backend in [
        Box::new(Cpu::new()) as Box<dyn Backend>,
        Box::new(any_gpu()),
    ] {
        let swept = Swept::on(model.clone(), backend.as_ref(), seeds);
        let solve = |points: &[f64]| {
            let mut solver =
                value::solver(&swept.plan, backend.as_ref()).expect("everything compiles");
            let request = Request {
                points: points.to_vec(),
                ..Request::default()
            };
            swept.solve_with(&mut solver, &request)
        };
        look(&swept, &solve, backend.name());
    }
}

fn solved<'a>(answers: &'a Answers, k: usize, what: &str) -> &'a Entry {
    given(answers, k).unwrap_or_else(|| {
        panic!(
            "{what}: state {k} is {:?}",
            answers.status(answers.targets.of_given[k])
        )
    })
}

/// H at every solution, relative to the running cost at the state where that is not small.
fn hamiltonians(swept: &Swept, answers: &Answers, what: &str) {
    let running = swept.plan.system.rate[2 * swept.plan.system.states];
    for e in &answers.entries {
        let cost = swept.plan.system.eval(&[running], e.path.start(), &e.p)[0].abs();
        // V and the rates set the scale at the equilibrium's level of cost.
        assert!(
            e.hamiltonian.abs() <= 100.0 * SOLVED * (cost + e.value.abs()),
            "{what}: H = {:e}",
            e.hamiltonian
        );
    }
}

/// p = dV/dx by central differences: the states are `x` and, for each state, one on either side of
/// it at `h` widths. Their error is of the second order; that with twice the distance has four
/// times as much, which leaves the fourth.
fn gradient(
    swept: &Swept,
    solve: &dyn Fn(&[f64]) -> Answers,
    x: &[f64],
    h: f64,
    bound: f64,
    what: &str,
) {
    let n = x.len();
    let mut points = x.to_vec();
    for i in 0..n {
        for step in [-2.0, -1.0, 1.0, 2.0] {
            let mut y = x.to_vec();
            y[i] += step * h * swept.plan.widths[i];
            points.extend(y);
        }
    }
    let answers = solve(&points);
    // Over a finite horizon H = -dV/dt is not 0.
    if swept.plan.system.terminal.is_none() {
        hamiltonians(swept, &answers, what);
    }
    let centre = solved(&answers, 0, what);
    let size = largest(centre.p.iter().zip(&swept.plan.widths).map(|(p, w)| p * w));
    for i in 0..n {
        let v = |k: usize| solved(&answers, 1 + 4 * i + k, what).value;
        let d = h * swept.plan.widths[i];
        let slope = (8.0 * (v(2) - v(1)) - (v(3) - v(0))) / (12.0 * d);
        let error = (slope - centre.p[i]).abs() * swept.plan.widths[i] / size;
        assert!(
            error <= bound,
            "{what}: dV/dx{i} is {slope}, p is {} ({error:.1e})",
            centre.p[i]
        );
    }
}

/// Bound of differences with h = 1e-3 widths: h^4 times fifth derivatives of order 1e3 in those
/// units, and SOLVED/h.
const GRADIENT: f64 = 2e-5;

#[test]
fn rate_saturation() {
    let model = hard("rate_saturation");
    let x0 = model.reference().to_vec();
    let v_max = parameter(&model, "v_max");
    both(&model, 1500, |swept, solve, what| {
        let x = [x0[0], x0[1], 0.2, x0[3]];
        let answers = solve(&x);
        let entry = solved(&answers, 0, what);
        hamiltonians(swept, &answers, what);
        // Time at the bound along the optimal trajectory.
        let mut solver = value::solver(&swept.plan, &Cpu::new()).expect("everything compiles");
        let block = value::sampled(&swept.plan, &mut solver, &[entry], 400).expect("the CPU works");
        let step = block.t[1] - block.t[0];
        let at_bound = block
            .u
            .iter()
            .filter(|u| (u.abs() - v_max).abs() <= 1e-6 * v_max)
            .count();
        assert!(
            at_bound as f64 * step > 1.0,
            "{what}: {} at the bound",
            at_bound as f64 * step
        );
        assert!(
            block.x.iter().skip(2).step_by(4).all(|r| *r >= 0.0),
            "{what}: R < 0"
        );
    });
    let swept = Swept::new(model, 1500);
    gradient(
        &swept,
        &|p| swept.points(p),
        &[x0[0] - 0.02, x0[1], 0.1, x0[3]],
        1e-3,
        GRADIENT,
        "rate saturation",
    );
}

#[test]
fn the_peak() {
    for name in ["near_peak", "peak_finite_horizon"] {
        let model = hard(name);
        let flow = parameter(&model, "Phi0");
        let pressure = parameter(&model, "Psi0");
        let throttle = parameter(&model, "gamma0");
        let swept = Swept::new(model, 1500);
        let x = [flow + 0.05, pressure - 0.02, 0.01, throttle + 0.01];
        gradient(&swept, &|p| swept.points(p), &x, 1e-3, GRADIENT, name);
    }
}

/// States on the invariant boundary and next to it.
#[test]
fn stall_at_zero() {
    let model = hard("stall_to_zero");
    let throttle = parameter(&model, "gamma0");
    both(&model, 1000, |swept, solve, what| {
        let mut points = Vec::new();
        for r in [0.0, 1e-12] {
            for (flow, pressure) in [(1.1, 1.9), (1.25, 2.1), (1.2, 1.95)] {
                points.extend([flow, pressure, r, throttle]);
            }
        }
        let answers = solve(&points);
        hamiltonians(swept, &answers, what);
        for k in 0..3 {
            let (a, b) = (solved(&answers, k, what), solved(&answers, k + 3, what));
            // V differs by p_R 1e-12, far below what solutions are asked to.
            assert!(
                (a.value - b.value).abs() <= SOLVED * a.value,
                "{what}: {} {}",
                a.value,
                b.value
            );
            // Newton's corrections leave roundings of p and the other states there, far below any R
            // of interest.
            let farthest = largest(a.path.nodes.chunks(8).map(|z| z[2]));
            assert!(farthest <= 1e-20, "{what}: R leaves 0 by {farthest:e}");
            assert!(b.path.nodes.chunks(8).all(|z| z[2] >= 0.0), "{what}: R < 0");
        }
    });
}

#[test]
fn upright_saddle() {
    let swept = Swept::new(hard("upright_saddle"), 4000);
    let pi = std::f64::consts::PI;
    let offsets = [0.0, 1e-6, 1e-3, 0.1];
    // Around the saddle, with enough states beside it that both ways round are known there.
    let mut thetas: Vec<f64> = offsets.iter().flat_map(|d| [pi - d, pi + d]).collect();
    thetas.extend((0..20).map(|k| 2.0 + 0.12 * f64::from(k)));
    let points: Vec<f64> = thetas.iter().flat_map(|t| [*t, 0.0]).collect();
    let answers = swept.points(&points);
    hamiltonians(&swept, &answers, "upright");
    for (k, d) in offsets.iter().enumerate() {
        let (a, b) = (
            solved(&answers, 2 * k, "below"),
            solved(&answers, 2 * k + 1, "above"),
        );
        assert!(
            (a.value - b.value).abs() <= SOLVED * a.value,
            "V({d}): {} {}",
            a.value,
            b.value
        );
        // The mirrored trajectory: from pi - d it falls toward 0, from pi + d toward 2 pi.
        if *d > 0.0 {
            assert!(
                (a.p[0] + b.p[0]).abs() <= 1e-6 * a.p[0].abs(),
                "p({d}): {:?} {:?}",
                a.p,
                b.p
            );
            assert!((a.u[0] + b.u[0]).abs() <= 1e-6 * a.u[0].abs().max(1e-3));
        }
    }
    // Exactly upright: two sheets of one V, opposite slopes.
    let both: Vec<&Entry> = answers.of(answers.targets.of_given[0]).iter().collect();
    assert!(both.len() >= 2, "{} sheets at pi", both.len());
    assert!((both[0].value - both[1].value).abs() <= SOLVED * both[0].value);
    assert!(
        (both[0].p[0] + both[1].p[0]).abs() <= 1e-6 * both[0].p[0].abs(),
        "a kink"
    );
    gradient(
        &swept,
        &|p| swept.points(p),
        &[pi - 0.1, 0.0],
        1e-4,
        GRADIENT,
        "upright",
    );
    // On the GPU too, nearest to the saddle.
    let swept = Swept::on(hard("upright_saddle"), &any_gpu(), 400);
    let mut solver = value::solver(&swept.plan, &any_gpu()).expect("everything compiles");
    let request = Request {
        points: vec![pi - 1e-6, 0.0],
        one_sheet: true,
        ..Request::default()
    };
    let on_gpu = swept.solve_with(&mut solver, &request);
    let (a, b) = (solved(&answers, 2, "cpu"), solved(&on_gpu, 0, "gpu"));
    // One sheet: it may be the other one, which costs the same to the distance from pi.
    assert!(
        (a.value - b.value).abs() <= 1e-5 * a.value,
        "{} {}",
        a.value,
        b.value
    );
}

#[test]
fn along_the_equal_cost_boundary() {
    let swept = Swept::new(hard("equal_cost"), 4000);
    let grid = swept.grid(vec![
        common_values::spaced(2.0, 2.8, 9),
        common_values::spaced(-0.5, 0.5, 5),
    ]);
    assert_eq!(grid.solved(), grid.targets.len());
    hamiltonians(&swept, &grid, "equal cost");
    for target in 0..grid.targets.len() {
        let here = grid.of(target);
        assert!(
            here.len() >= 2,
            "both ways round from {:?}",
            grid.targets.state(target)
        );
        assert!(here[0].value <= here[1].value);
    }
    assert!(
        grid.equal_cost.len() >= 5,
        "{} points",
        grid.equal_cost.len()
    );
    // States exactly on the boundary: both sheets, equal V, and a jump of u.
    let points: Vec<f64> = grid
        .equal_cost
        .iter()
        .flat_map(|e| e.point.x.clone())
        .collect();
    let more: Vec<f64> = (0..grid.targets.len())
        .flat_map(|t| grid.targets.state(t).to_vec())
        .collect();
    let on = swept.points(&[points, more].concat());
    for k in 0..grid.equal_cost.len() {
        let here = on.of(on.targets.of_given[k]);
        assert!(
            here.len() >= 2,
            "both sheets at {:?}",
            grid.equal_cost[k].point.x
        );
        assert!(
            (here[0].value - here[1].value).abs() <= SOLVED * here[0].value,
            "{} {}",
            here[0].value,
            here[1].value
        );
        assert!(
            (here[0].u[0] - here[1].u[0]).abs() > 10.0,
            "the torque jumps"
        );
    }
}

#[test]
fn control_cheap_and_dear_and_a_chain() {
    // cheap: rates -1 and -1000
    let model = hard("cheap_control");
    let root = parameter(&model, "r").sqrt();
    let p = [
        (1.0 + 2.0 * root).sqrt(),
        root,
        root * (1.0 + 2.0 * root).sqrt(),
    ];
    exact(&model, &[1.0, 0.0, -1.0, 20.0, 0.5, -40.0], 300, p, true);
    let model = hard("dear_control");
    let r = parameter(&model, "r");
    let p12 = r * (1.0 + (1.0 + 1.0 / r).sqrt());
    let p22 = (r * (2.0 * p12 + 1.0)).sqrt();
    exact(
        &model,
        &[1.0, 0.0, -1.0, 1.0, 0.5, -0.7],
        300,
        [p12 * p22 / r - p22, p12, p22],
        false,
    );
    // 60 time constants from the end: the stationary solution.
    let third = 3f64.sqrt();
    exact(
        &hard("long_horizon"),
        &[1.0, 0.0, -1.0, 1.0, 0.3, -0.7],
        500,
        [third, 1.0, third],
        false,
    );
}

/// Two states with `V = x'Px/2`, P by its upper triangle; whether solving them is called stiff.
fn exact(model: &Model, points: &[f64], seeds: usize, [a, b, c]: [f64; 3], stiff: bool) {
    both(model, seeds, |swept, solve, backend| {
        let what = format!("{} {backend}", model.title);
        let answers = solve(points);
        for (k, x) in points.chunks(2).enumerate() {
            let e = solved(&answers, k, &what);
            let p = [a * x[0] + b * x[1], b * x[0] + c * x[1]];
            let v = 0.5 * (p[0] * x[0] + p[1] * x[1]);
            assert!(
                (e.value - v).abs() <= SOLVED * v,
                "{what}: V = {}, not {v}",
                e.value
            );
            let size = largest([0, 1].map(|i| p[i] * swept.plan.widths[i]));
            for i in 0..2 {
                assert!(
                    (e.p[i] - p[i]).abs() * swept.plan.widths[i] <= SOLVED * size,
                    "{what}: {:?} not {p:?}",
                    e.p
                );
            }
        }
        let found = stiffness::segments(
            &swept.plan,
            answers.entries.iter().map(|e| e.path.segments()),
            0,
        );
        assert_eq!(found.is_some(), stiff, "{what}: {found:?}");
    });
}

#[test]
fn a_chain_is_solved_and_called_stiff() {
    let model = hard("stiff_chain");
    both(&model, 100, |swept, solve, what| {
        let answers = solve(&[0.5, 0.0, 0.0, 0.0, 0.0, 1.0]);
        let e = solved(&answers, 0, what);
        let x = [0.5, 0.0, 0.0, 0.0, 0.0, 1.0];
        let p = &swept
            .plan
            .local
            .as_ref()
            .expect("an infinite horizon")
            .riccati
            .p;
        // P itself is checked against Kleinman's iteration in tests/hard.rs.
        let v: f64 = (0..6)
            .map(|i| (0..6).map(|j| 0.5 * x[i] * p[(i, j)] * x[j]).sum::<f64>())
            .sum();
        assert!(
            (e.value - v).abs() <= SOLVED * v,
            "{what}: {} not {v}",
            e.value
        );
        let found = stiffness::segments(
            &swept.plan,
            answers.entries.iter().map(|e| e.path.segments()),
            0,
        );
        assert!(found.is_some(), "{what}");
    });
}

#[test]
fn states_of_different_size() {
    let model = hard("state_sizes");
    let x0 = model.reference().to_vec();
    both(&model, 300, |swept, solve, what| {
        let units = [[0.7, -0.4], [-0.9, 0.8], [0.1, 1.0]];
        let points: Vec<f64> = units
            .iter()
            .flat_map(|[x, y]| [x0[0] + 1e-6 * x, x0[1] + 1e6 * y])
            .collect();
        let answers = solve(&points);
        hamiltonians(swept, &answers, what);
        for (k, [x, y]) in units.iter().enumerate() {
            let Exact { v, p, .. } = manufactured::at(&[*x, *y]);
            let e = solved(&answers, k, what);
            assert!(
                (e.value - v).abs() <= SOLVED * v,
                "{what}: {} not {v}",
                e.value
            );
            assert!(
                (e.p[0] * 1e-6 - p[0]).abs() <= SOLVED && (e.p[1] * 1e6 - p[1]).abs() <= SOLVED,
                "{what}: {:?}",
                e.p
            );
        }
    });
}
