//! V, p and u at chosen states against answers known otherwise: exact ones, an independent
//! solver's, the invariants.
//!
//! Bounds: answers are asked to 1e-9 relative to the trajectory (segments to a tenth of it,
//! Newton's last correction), so V and p to 1e-8.

use crate::{common_problems, common_values};

use common_problems::linear::chain;
use common_problems::{Exact, manufactured};
use common_values::{Swept, given, largest, parse, scene, spaced};
use costate::low_level::value::PointStatus;

/// Ten times the tolerance of the answers: it is relative to a trajectory's largest component, not
/// to each one.
const PROMISED: f64 = 1e-8;

#[test]
fn manufactured_value_at_every_target() {
    let swept = Swept::new(scene("manufactured", &[]), 2000);
    // Targets as far as the border of the region, where V is beyond the sweep; some very near the
    // equilibrium.
    let mut axis = spaced(-1.0, 1.0, 9);
    axis.extend([-1e-3, -1e-6, 1e-9, 1e-4]);
    axis.sort_by(f64::total_cmp);
    let answers = swept.grid(vec![axis.clone(), axis]);
    assert_eq!(answers.solved(), answers.targets.len());
    assert_eq!(answers.sheets, 1);
    for target in 0..answers.targets.len() {
        let x = answers.targets.state(target);
        let entry = answers.answer(target).expect("solved");
        let Exact { v, p, u } = manufactured::at(x);
        assert!(
            (entry.value - v).abs() <= PROMISED * v,
            "V at {x:?}: {} not {v}",
            entry.value
        );
        let error = largest((0..2).map(|i| entry.p[i] - p[i]));
        assert!(
            error <= PROMISED * largest(p.iter().copied()),
            "p at {x:?}: {:?} not {p:?}",
            entry.p
        );
        assert!(
            (entry.u[0] - u[0]).abs() <= 2.0 * PROMISED * largest(p.iter().copied()),
            "u at {x:?}"
        );
    }
}

/// How many threads there are, and whether the caller is one of them, decides who follows which
/// ways, but not where these lead.
#[test]
fn threads_change_no_bit() {
    let swept = Swept::new(scene("pendulum", &[]), 300);
    let answers = || {
        let axes = vec![spaced(-1.5, 6.0, 12), spaced(-4.0, 4.0, 7)];
        let answers = swept.grid(axes);
        let bits = |v: &[f64]| v.iter().map(|v| v.to_bits()).collect::<Vec<u64>>();
        let entries = answers.entries.iter();
        let told: Vec<_> = entries
            .map(|e| {
                (
                    e.target,
                    e.sheet,
                    e.value.to_bits(),
                    bits(&e.p),
                    e.iterations,
                )
            })
            .collect();
        assert!(told.len() > 100, "{} solutions", told.len());
        (told, answers.support, answers.evaluations)
    };
    let outside = answers();
    for threads in [1, 2, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let within = pool.expect("threads can be started").install(answers);
        assert!(within == outside, "on {threads} threads");
    }
}

/// Eight states: a chain of four masses, with P from the Riccati equation, which tests/local.rs
/// checks on its own.
#[test]
fn eight_states() {
    let swept = Swept::new(parse(&chain(4, 0.0)), 300);
    let p = &swept
        .plan
        .local
        .as_ref()
        .expect("infinite horizon")
        .riccati
        .p;
    let points: Vec<f64> = (0..12 * 8)
        .map(|k| ((k * k + 3 * k) as f64 * 0.271).sin())
        .collect();
    let answers = swept.points(&points);
    for (k, x) in points.chunks(8).enumerate() {
        let x = nalgebra::DVector::from_column_slice(x);
        let exact = p * &x;
        let entry = given(&answers, k).expect("solved");
        let v = 0.5 * exact.dot(&x);
        assert!(
            (entry.value - v).abs() <= PROMISED * v,
            "V: {} not {v}",
            entry.value
        );
        let error = largest((0..8).map(|i| entry.p[i] - exact[i]));
        assert!(
            error <= PROMISED * exact.amax(),
            "p at point {k}: off by {error:e}"
        );
    }
}

#[test]
fn finite_horizon() {
    let swept = Swept::new(scene("finite_horizon", &[]), 2000);
    let (tau, s) = (2.0f64, 10.0f64);
    let of = |name: &str| {
        swept
            .model
            .parameters
            .iter()
            .find(|p| p.name == name)
            .expect("a parameter")
            .value
    };
    assert_eq!(
        (of("T"), of("s")),
        (tau, s),
        "the formula below is for these"
    );
    let region = swept.model.region.clone();
    let axes = region
        .iter()
        .map(|[lo, hi]| spaced(0.5 * lo, 0.5 * hi, 5))
        .collect();
    let answers = swept.grid(axes);
    for target in 0..answers.targets.len() {
        let x = answers.targets.state(target);
        let entry = answers.answer(target).expect("solved");
        let (y, v) = (x[0] + x[1] * tau, x[1]);
        let d = (tau.powi(3) / 3.0 + 1.0 / s) * (tau + 1.0 / s) - tau.powi(4) / 4.0;
        let (a, b, c) = (
            (tau + 1.0 / s) / d,
            -tau * tau / (2.0 * d),
            (tau.powi(3) / 3.0 + 1.0 / s) / d,
        );
        let (p_y, p_v) = (a * y + b * v, b * y + c * v);
        let (value, p) = (0.5 * (p_y * y + p_v * v), [p_y, p_y * tau + p_v]);
        assert!(
            (entry.value - value).abs() <= PROMISED * value.abs(),
            "V at {x:?}: {} not {value}",
            entry.value
        );
        let error = largest((0..2).map(|i| entry.p[i] - p[i]));
        assert!(error <= PROMISED * largest(p.iter().copied()), "p at {x:?}");
    }
}

/// V of 24 states of the compressor by collocation (scipy.solve_bvp); its own accuracy is 1e-4 or
/// 1e-6.
#[test]
fn compressor_agrees_with_an_independent_solver() {
    let text = include_str!("../data/mg_h2_points.csv");
    let rows: Vec<Vec<f64>> = (text.lines().skip(1))
        .map(|line| {
            line.split(',')
                .map(|x| x.parse().expect("a number"))
                .collect()
        })
        .collect();
    assert_eq!(rows.len(), 24);
    let swept = Swept::new(scene("moore_greitzer", &[]), 1024);
    let points: Vec<f64> = rows.iter().flat_map(|r| r[..4].to_vec()).collect();
    let answers = swept.points(&points);
    for (k, row) in rows.iter().enumerate() {
        let entry = given(&answers, k).unwrap_or_else(|| panic!("{:?} is not solved", &row[..4]));
        let error = (entry.value - row[4]).abs();
        assert!(
            error <= (1e-3 * row[4]).max(1e-6),
            "V at {:?}: {} not {}",
            &row[..4],
            entry.value,
            row[4]
        );
        let p = &row[5..9];
        let error = largest((0..4).map(|i| entry.p[i] - p[i]));
        assert!(error <= 1e-3 * largest(p.to_vec()), "p at {:?}", &row[..4]);
    }
}

/// States of a grid in four dimensions are reached from each other: in a few integrations of each
/// trajectory, counted, and to what they are alone.
#[test]
fn a_grid_in_four_states_takes_little_work() {
    /// Integrations of a whole trajectory a state, the search for cheaper ones and their flights
    /// left out: a solution from a near one takes five or six.
    const MOST_WORK: f64 = 9.0;
    let swept = Swept::new(scene("moore_greitzer", &[]), 1024);
    let axes = vec![
        spaced(1.1, 1.4, 5),
        spaced(1.7, 2.1, 5),
        spaced(0.0, 0.08, 3),
        spaced(1.45, 1.6, 3),
    ];
    let answers = swept.grid(axes);
    let count = answers.targets.len();
    assert_eq!(count, 225);
    assert_eq!(answers.solved(), count);
    assert_eq!(answers.sheets, 1);
    let work = answers.evaluations as f64 / count as f64;
    assert!(work <= MOST_WORK, "{work} integrations a state");
    let some: Vec<usize> = (0..count).step_by(37).collect();
    let points: Vec<f64> = (some.iter())
        .flat_map(|target| answers.targets.state(*target).to_vec())
        .collect();
    let alone = swept.points(&points);
    for (k, target) in some.into_iter().enumerate() {
        let (company, own) = (answers.answer(target), given(&alone, k));
        let (company, own) = (company.expect("solved"), own.expect("solved alone"));
        let x = answers.targets.state(target);
        let error = (company.value - own.value).abs();
        assert!(
            error <= PROMISED * own.value,
            "V at {x:?}: {} and alone {}",
            company.value,
            own.value
        );
        let error = largest((0..4).map(|i| company.p[i] - own.p[i]));
        assert!(error <= PROMISED * largest(own.p.to_vec()), "p at {x:?}");
    }
}

/// The dissertation's example: from (1.2, Psi_c(1.2), 0.12) with the throttle at rest.
#[test]
fn compressor_trajectory() {
    let swept = Swept::new(scene("moore_greitzer", &[]), 1024);
    let mut x = swept.model.reference().to_vec();
    x[2] = 0.12;
    let mut solver = swept.solver();
    let request = costate::low_level::value::Request {
        points: x,
        ..Default::default()
    };
    let answers = swept.solve_with(&mut solver, &request);
    let entry = given(&answers, 0).expect("solved");
    assert!((entry.value - 0.0533).abs() < 5e-5, "V = {}", entry.value);
    let block = costate::low_level::value::sampled(&swept.plan, &mut solver, &[entry], 2000)
        .expect("the CPU works");
    let along = |k: usize| block.x.iter().skip(k).step_by(4).copied();
    let lowest = along(1).fold(f64::INFINITY, f64::min);
    let highest = along(3).fold(f64::NEG_INFINITY, f64::max);
    let rate = largest(block.u.iter().copied());
    assert!((lowest - 1.975).abs() < 1e-3, "lowest Psi {lowest}");
    assert!((highest - 1.536).abs() < 1e-3, "highest gamma {highest}");
    // Known to three decimals.
    assert!((0.0715..0.0755).contains(&rate), "highest |gamma'| {rate}");
    // The trajectory is one: it ends at the equilibrium, V falls to nothing, H stays 0.
    assert!(
        largest((0..4).map(|k| block.x[block.x.len() - 4 + k] - swept.model.reference()[k])) < 1e-2
    );
    assert!(block.v[0] == entry.value && block.v[1999] < 1e-3 * entry.value);
    assert!(
        block.v.windows(2).all(|w| w[1] < w[0]),
        "V falls along the trajectory"
    );
    assert!(largest(block.h.iter().copied()) < 1e-8);
}

/// p is the gradient of V: central differences between targets.
#[test]
fn adjoints_are_differences_of_v() {
    for (name, centre, most) in [
        ("pendulum", vec![0.4, 3.0], 2000),
        ("moore_greitzer", vec![1.15, 1.9, 0.1, 1.5], 1024),
    ] {
        let swept = Swept::new(scene(name, &[]), most);
        let n = centre.len();
        let step: Vec<f64> = swept.plan.widths.iter().map(|w| 1e-3 * w).collect();
        let mut points = centre.clone();
        for i in 0..n {
            for sign in [-1.0, 1.0] {
                let mut x = centre.clone();
                x[i] += sign * step[i];
                points.extend(x);
            }
        }
        let answers = swept.points(&points);
        let at = |k: usize| {
            given(&answers, k).unwrap_or_else(|| panic!("{name}: point {k} is not solved"))
        };
        for i in 0..n {
            let difference = (at(2 + 2 * i).value - at(1 + 2 * i).value) / (2.0 * step[i]);
            let scale = largest((0..n).map(|j| at(0).p[j] * step[j])) / step[i];
            // Central differences over a thousandth of the region: a relative error of some 1e-6
            // V'''/V'.
            assert!(
                (difference - at(0).p[i]).abs() <= 1e-4 * scale,
                "{name}: dV/dx{i} {difference} not {}",
                at(0).p[i]
            );
        }
        let entry = at(0);
        let cost = swept.plan.system.eval(
            &[swept.plan.system.rate[2 * n]],
            entry.path.start(),
            &entry.p,
        )[0];
        assert!(
            entry.hamiltonian.abs() <= PROMISED * cost,
            "{name}: H = {:e}, L = {cost}",
            entry.hamiltonian
        );
    }
}

/// The states' order, duplicates and company do not change a bit.
#[test]
fn order_and_duplicates_do_not_matter() {
    let swept = Swept::new(scene("pendulum", &[]), 2000);
    let mut points: Vec<[f64; 2]> = (0..40)
        .map(|k| [-3.0 + 0.13 * f64::from(k), 4.0 * (f64::from(k) * 0.7).sin()])
        .collect();
    let flat = |p: &[[f64; 2]]| p.concat();
    let first = swept.points(&flat(&points));
    points.reverse();
    points.push(points[3]);
    points.push(points[17]);
    let second = swept.points(&flat(&points));
    for (k, x) in points.iter().enumerate() {
        let original = if k < 40 { 39 - k } else { [36, 22][k - 40] };
        let (a, b) = (given(&first, original), given(&second, k));
        let (a, b) = (a.expect("solved"), b.expect("solved"));
        assert_eq!(
            (a.value.to_bits(), a.sheet),
            (b.value.to_bits(), b.sheet),
            "{x:?}"
        );
        let bits = |p: &[f64]| p.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&a.p), bits(&b.p));
    }
}

/// `x' = x + u`, |u| <= 1: only |x| < 1 can be brought back.
#[test]
fn unreachable_targets_say_how_far_it_went() {
    let swept = Swept::new(
        parse(
            r#"
            states = { x = {} , y = {} }
            controls = { u = { min = -1, max = 1 }, v = {} }
            dynamics = { x = "x + u", y = "v" }
            cost = { running = "0.5*(x^2 + y^2 + u^2 + v^2)" }
            equilibrium = { x = 0, y = 0, u = 0, v = 0 }
            region = { x = [-2, 2], y = [-1, 1] }
            guards = { inside = "x < 1.9" }
            shoot_out = { value_max = 2.0, spacing = 0.1, samples = 40 }
            "#,
        ),
        2000,
    );
    let answers = swept.points(&[0.5, 0.2, 1.5, 0.0, -1.2, 0.5, 1.95, 0.0, 0.0, 0.0]);
    let status = |k: usize| answers.status(answers.targets.of_given[k]);
    assert_eq!(status(0), PointStatus::Converged);
    for k in [1, 2] {
        assert!(given(&answers, k).is_none(), "outside the reachable set");
        assert_ne!(status(k), PointStatus::Converged);
        let miss = answers.misses[answers.targets.of_given[k]]
            .as_ref()
            .expect("a reason");
        let furthest = miss.furthest.as_ref().expect("it went some way");
        assert!(
            furthest[0].abs() < 1.0 && furthest[0].abs() > 0.9,
            "furthest {furthest:?}"
        );
    }
    assert_eq!(status(3), PointStatus::OutsideGuard);
    // The equilibrium itself.
    let rest = given(&answers, 4).expect("solved");
    assert_eq!(
        (rest.value, &rest.p[..], &rest.u[..]),
        (0.0, &[0.0, 0.0][..], &[0.0, 0.0][..])
    );
}

/// Saturated arcs, Psi near 0, R at and near 0.
#[test]
fn compressor_at_its_limits() {
    let swept = Swept::new(scene("moore_greitzer", &[]), 1024);
    let g = swept.model.reference()[3];
    #[rustfmt::skip]
    let points = [
        1.3, 2.0, 0.0, g,      // no stall at all
        1.3, 2.0, 1e-12, g,
        1.3, 2.0, 1e-6, g,
        1.2, 2.1, 0.2, g,      // long saturation
        1.4, 0.3, 0.0, g,      // far below the pressures of the region
        1.2, -0.1, 0.0, g,     // no pressure
        1.2, 2.0, -0.01, g,    // negative stall
    ];
    let answers = swept.points(&points);
    let at = |k: usize| {
        given(&answers, k).unwrap_or_else(|| {
            panic!(
                "point {k}: {:?}",
                answers.status(answers.targets.of_given[k])
            )
        })
    };
    // V is differentiable in R up to R = 0: p_R tells the difference.
    for (k, r) in [(1, 1e-12), (2, 1e-6)] {
        let expected = at(0).value + at(0).p[2] * r;
        assert!(
            (at(k).value - expected).abs() <= 1e-8 * at(0).value,
            "R = {r:e}"
        );
    }
    assert!(at(3).u[0].abs() == 0.1, "saturated: {}", at(3).u[0]);
    assert!(at(4).value > at(0).value);
    for k in [5, 6] {
        assert_eq!(
            answers.status(answers.targets.of_given[k]),
            PointStatus::OutsideGuard
        );
    }
}

/// Forward integration from the right costate loses a digit each time the unstable modes grow
/// tenfold; nodes hold them.
#[test]
fn single_shooting_fails_where_multiple_shooting_holds() {
    use costate::low_level::shooting::{Goal, Job, Path};
    let swept = Swept::new(scene("pendulum", &[]), 2000);
    let mut solver = swept.solver();
    let target = [1.0 + 1.5, 0.0];
    let answers = swept.points(&[1.0, 0.0]);
    let entry = given(&answers, 0).expect("solved");
    let closed_loop = &swept
        .plan
        .local
        .as_ref()
        .expect("infinite horizon")
        .riccati
        .eigenvalues;
    let rate = closed_loop.iter().map(|e| e.norm()).fold(0.0, f64::max);
    println!(
        "horizon  forward error  bound 1e-10 exp(rate T)  multiple shooting's last correction, V's change"
    );
    for horizon in [5.0, 10.0, 20.0, 40.0, 80.0] {
        // One segment: the state it ends in should be the equilibrium, but for what is left after
        // this time.
        let mut single = Path::new(entry.path.node(0));
        single.push(horizon, entry.path.last());
        let (end, _) = solver.ends(&single).expect("the CPU works");
        let error = largest(end[..2].iter().copied());
        // The same horizon in segments.
        let mut path = entry.path.clone();
        while path.horizon() < horizon {
            path.push(1.0, &[0.0; 4]);
        }
        let mut jobs = vec![Job::new(path, Goal::State(target.to_vec()))];
        solver.solve(&mut jobs).expect("the CPU works");
        let solved = jobs[0]
            .solved()
            .unwrap_or_else(|| panic!("T = {horizon}: {:?}", jobs[0].failure()));
        let change = (solved.value - entry.value).abs() / entry.value;
        println!(
            "{horizon:7}  {error:12.3e}  {:23.3e}  {:.1e}, {change:.1e}",
            1e-10 * (rate * horizon).exp(),
            solved.residual
        );
        assert!(
            solved.residual <= 1e-9 && change <= PROMISED,
            "T = {horizon}"
        );
        if horizon <= 5.0 {
            assert!(error < 0.1, "still near at T = {horizon}: {error:e}");
        }
        if horizon >= 40.0 {
            assert!(
                error >= 1.0 || error.is_nan(),
                "forward integration cannot end at the equilibrium after T = {horizon}: {error:e}"
            );
        }
    }
}

/// A sweep and Newton iterations in f32 on a GPU end with answers in f64.
#[test]
fn gpu_drafts_end_as_f64_answers() {
    use costate::backend::gpu::{Gpu, Selection};
    use costate::low_level::model::Precision;
    let gpu = Gpu::open(&Selection::Any)
        .expect("an adapter")
        .expect("an adapter");
    for (name, axes) in [
        ("pendulum", vec![spaced(-3.0, 1.5, 4), spaced(-4.0, 5.0, 4)]),
        (
            "moore_greitzer",
            vec![vec![1.2, 1.3], vec![1.9, 2.1], vec![0.0, 0.1], vec![1.5]],
        ),
    ] {
        let mut model = scene(name, &[]);
        model.integrator.precision = Some(Precision::F32);
        let on_gpu = Swept::on(model, &gpu, 400);
        assert_eq!(on_gpu.plan.spec.precision, Precision::F32);
        let request = costate::low_level::value::Request {
            grids: vec![costate::low_level::value::Grid { axes: axes.clone() }],
            limits: vec![f64::INFINITY],
            one_sheet: true,
            ..Default::default()
        };
        let mut solver =
            costate::low_level::value::solver(&on_gpu.plan, &gpu).expect("the GPU compiles it");
        let drafted = on_gpu.solve_with(&mut solver, &request);
        let exact = Swept::new(scene(name, &[]), 400).solve(&request);
        assert_eq!(
            (drafted.solved(), exact.solved()),
            (drafted.targets.len(), exact.targets.len()),
            "{name}"
        );
        for target in 0..exact.targets.len() {
            let (a, b) = (
                drafted.answer(target).expect("solved"),
                exact.answer(target).expect("solved"),
            );
            assert!(
                (a.value - b.value).abs() <= PROMISED * b.value,
                "{name}: V {} not {}",
                a.value,
                b.value
            );
            assert!(
                largest((0..a.p.len()).map(|i| a.p[i] - b.p[i])) <= PROMISED * largest(b.p.clone()),
                "{name}: p"
            );
        }
    }
}

/// The compressor's variants, at states with saturated arcs and without.
#[test]
fn compressor_variants() {
    for set in [
        ("v_max", "0.2"),
        ("v_max", "10"),
        ("c", "1"),
        ("c", "5"),
        ("Phi0", "1.1"),
        ("Phi0", "1.3"),
        ("Phi0", "1.4"),
    ] {
        let swept = Swept::new(scene("moore_greitzer", &[set]), 600);
        let g = swept.model.reference()[3];
        let axes = vec![vec![1.1, 1.3], vec![1.7, 2.0], vec![0.0, 0.08], vec![g]];
        let answers = swept.grid(axes);
        assert_eq!(answers.solved(), 8, "{set:?}");
        assert_eq!(answers.sheets, 1, "{set:?}");
        for entry in &answers.entries {
            let cost =
                swept
                    .plan
                    .system
                    .eval(&[swept.plan.system.rate[8]], entry.path.start(), &entry.p)[0];
            // Ten times the tolerance, as a share of the terms of H, which cancel: L is one of
            // them.
            assert!(
                entry.hamiltonian.abs() <= 1e-7 * cost,
                "{set:?}: H = {:e}, L = {cost:e}",
                entry.hamiltonian
            );
        }
    }
}

const OSCILLATOR: &str = r#"
    states = { x = {}, v = {} }
    controls = { u = {} }
    dynamics = { x = "v", v = "-x + u" }
    cost = { running = "0.5*(x^2 + v^2 + u^2)" }
    equilibrium = { x = 0, v = 0, u = 0 }
    region = { x = [-1, 1], v = [-1, 1] }
    shoot_out = { value_max = 0.3, spacing = 0.1, samples = 20 }
"#;

/// The trajectory from (1, 0) dips to v = -0.6 between its nodes.
#[test]
fn a_guard_is_kept_between_nodes() {
    let swept = Swept::new(
        parse(&format!(
            "{OSCILLATOR}\nguards = {{ wall = \"v > -0.3\" }}\n"
        )),
        400,
    );
    let answers = swept.points(&[1.0, 0.0, 0.2, 0.0]);
    let status = |k: usize| answers.status(answers.targets.of_given[k]);
    assert_eq!(
        (status(0), status(1)),
        (PointStatus::LeavesGuard, PointStatus::Converged)
    );
}

/// Alone and far outside the sweep: V is quadratic there too.
#[test]
fn a_single_target_far_away_is_reached() {
    let swept = Swept::new(parse(OSCILLATOR), 400);
    let p = &swept
        .plan
        .local
        .as_ref()
        .expect("infinite horizon")
        .riccati
        .p;
    for scale in [3.0, 40.0] {
        let x = nalgebra::DVector::from_vec(vec![scale, -0.7 * scale]);
        let answers = swept.points(x.as_slice());
        let exact = 0.5 * (x.transpose() * p * &x)[0];
        let entry = given(&answers, 0).expect("solved");
        assert!(
            (entry.value - exact).abs() <= PROMISED * exact,
            "{} not {exact}",
            entry.value
        );
    }
}

/// An angle is the same angle any number of turns away.
#[test]
fn many_turns_away() {
    let swept = Swept::new(scene("pendulum_rest", &[]), 2000);
    let turns = [-50.0, -3.0, 0.0, 1.0, 50.0];
    let points: Vec<f64> = turns
        .iter()
        .flat_map(|k| [0.3 + k * std::f64::consts::TAU, 0.1])
        .collect();
    let answers = swept.points(&points);
    let value = |k: usize| given(&answers, k).expect("solved").value;
    for k in 0..turns.len() {
        // 300 rad are known to 6e-14.
        assert!(
            (value(k) - value(2)).abs() <= PROMISED * value(2),
            "{} turns: {}",
            turns[k],
            value(k)
        );
    }
}
