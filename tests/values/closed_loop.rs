//! Closed loops against exact solutions, hand-written integrators, and each other on both backends.

use crate::common_loop;
use crate::common_problems::linear::{Linear, diagonal, form};
use crate::common_problems::manufactured::{self, Known};

use common_loop::{Asked, Scene, TIGHT, any_gpu, runge_kutta};
use costate::backend::{Backend, Status, cpu::Cpu};
use costate::low_level::closed_loop::{Chart, Expansion, Initial, LawResult, OUTSIDE_MAP};
use costate::low_level::model::Precision;
use costate::low_level::sweep::GUARD_STATUS;
use nalgebra::{DMatrix, Vector2};

/// A spring and a force. Everything about it is known by matrices.
const SPRING: &str = r#"
states = { x = {}, v = {} }
controls = { u = {} }
dynamics = { x = "v", v = "-x + u" }
cost = { running = "0.5*(2*x^2 + v^2 + u^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-1, 1], v = [-1, 1] }
[closed_loop]
final_time = 8.0
samples = 40
initial = { x = [-1, 1, 5], v = [-1, 1, 5] }
[closed_loop.law]
detuned = { u = "-0.3*x - 0.4*v" }
[closed_loop.record]
x_end = "final(x)"
v_end = "final(v)"
"#;

/// Its matrices.
fn spring() -> Linear {
    Linear {
        a: DMatrix::from_row_slice(2, 2, &[0.0, 1.0, -1.0, 0.0]),
        b: DMatrix::from_row_slice(2, 1, &[0.0, 1.0]),
        q: diagonal(&[2.0, 1.0]),
        r: diagonal(&[1.0]),
    }
}

/// P and the optimal gain.
fn optimum() -> (DMatrix<f64>, DMatrix<f64>) {
    spring().optimal_from(DMatrix::from_row_slice(1, 2, &[1.0, 1.0]))
}

/// Errors of the end are the tolerance's, some dozen steps; J's remainder is exact for the optimal
/// law.
const FEW_STEPS: f64 = 100.0;

#[test]
fn the_linear_law_is_the_exponential_and_costs_v() {
    let scene = Scene::new(SPRING);
    let result = scene.tightly("lqr");
    let (Linear { a, b, .. }, (p, gain)) = (spring(), optimum());
    let flow = ((a - b * gain) * 8.0).exp();
    let allowed = FEW_STEPS * TIGHT.rtol;
    let initial = scene.initial();
    for i in 0..initial.count() {
        let x = initial.state(i);
        let end = &flow * Vector2::new(x[0], x[1]);
        for c in 0..2 {
            let error = (result.records[2 * i + c] - end[c]).abs();
            assert!(error <= allowed, "end from {x:?}: {error:e}");
        }
        let error = (result.cost[i] - form(&p, x)).abs();
        assert!(
            error <= allowed * (1.0 + form(&p, x)),
            "cost from {x:?}: {error:e}"
        );
        assert!(result.converged[i] && result.status[i] == 0);
    }
}

/// 1/2 d'Pd at t = 60 is below 1e-11 of the start: J is the Lyapunov equation's.
#[test]
fn a_detuned_gain_costs_what_the_lyapunov_equation_says() {
    let scene = Scene::new(&SPRING.replace("final_time = 8.0", "final_time = 60.0"));
    let gain = DMatrix::from_row_slice(1, 2, &[0.3, 0.4]);
    let (s, (p, _)) = (spring().cost(&gain), optimum());
    let initial = scene.initial();
    let values: Vec<f64> = (0..initial.count())
        .map(|i| form(&p, initial.state(i)))
        .collect();
    let cpu = Cpu::new();
    let e = scene.evaluate(
        &cpu,
        TIGHT,
        &["detuned"],
        initial,
        None,
        Some(values.clone()),
    );
    let suboptimality = e.suboptimality(&e.laws[0]);
    for i in 0..e.initial.count() {
        let x = e.initial.state(i);
        if x == [0.0, 0.0] {
            assert!(suboptimality[i].is_nan(), "V = 0 says nothing");
            continue;
        }
        let exact = form(&s, x) / values[i] - 1.0;
        assert!(exact > 0.01, "this gain is not optimal");
        assert!(
            (suboptimality[i] - exact).abs() <= 10.0 * FEW_STEPS * TIGHT.rtol,
            "{x:?}"
        );
    }
    let spread = e.spread(&e.laws[0]).unwrap();
    assert_eq!(spread.count, 24);
    assert!(spread.median <= spread.p99 && spread.p99 <= spread.worst);
}

/// The scene `manufactured`, whose V is known everywhere.
fn manufactured_scene() -> String {
    let text =
        std::fs::read_to_string(format!("{}/scenarios/manufactured.toml", crate::ROOT)).unwrap();
    text + r#"
[closed_loop]
final_time = 15.0
samples = 60
initial = { x = [-1, 1, 7], y = [-1, 1, 7] }
[closed_loop.law]
exact = { u = "-V_y/r" }
[closed_loop.record]
least_x = "min(x)"
"#
}

fn largest_excess(result: &LawResult, initial: &Initial) -> f64 {
    assert!(result.converged.iter().all(|c| *c));
    (0..initial.count())
        .map(|i| (result.cost[i] - manufactured::value(initial.state(i))).abs())
        .fold(0.0, f64::max)
}

#[test]
fn the_optimal_law_costs_v_as_an_expression_and_as_a_chart() {
    let scene = Scene::new(&manufactured_scene());
    let cpu = Cpu::new();
    let e = scene.evaluate(
        &cpu,
        TIGHT,
        &["exact", "map"],
        scene.initial(),
        Some(&Known),
        None,
    );
    let exact = largest_excess(&e.laws[0], &e.initial);
    assert!(exact <= FEW_STEPS * TIGHT.rtol * 10.0, "{exact:e}");
    // V of the chart at the initial states.
    for i in 0..e.initial.count() {
        assert_eq!(e.values[i], manufactured::value(e.initial.state(i)));
    }
    // Legs of their own lengths lose no more than they may.
    let own = largest_excess(&e.laws[1], &e.initial);
    assert!(own <= 30.0 * TIGHT.rtol, "{own:e}");
    // Between updates u is off by the square of the way since the last, J by the square of that:
    // the fourth power of the period. An eighth at least for half of it.
    let excess = |period: &str| {
        let finer = Scene::new(
            &manufactured_scene()
                .replace("samples = 60", &format!("samples = 60\nperiod = {period}")),
        );
        let finer = finer.evaluate(&cpu, TIGHT, &["map"], scene.initial(), Some(&Known), None);
        largest_excess(&finer.laws[0], &e.initial)
    };
    let [coarse, fine, finest] = ["0.25", "0.125", "0.0625"].map(excess);
    println!(
        "excess {exact:.1e} as an expression, {own:.1e}; {coarse:.1e}, {fine:.1e}, {finest:.1e} as a chart"
    );
    assert!(
        fine <= coarse / 8.0 && finest <= fine / 8.0,
        "{coarse:e} {fine:e} {finest:e}"
    );
    assert!(finest <= 1e-4, "{finest:e}");
}

/// A bounded force, against an integrator written here. Its error at a kink is the second order of
/// its step, 1e-4.
#[test]
fn saturation_is_applied_inside_the_dynamics() {
    let text = SPRING
        .replace("u = {} }", "u = { min = -0.3, max = 0.2 } }")
        .replace(
            "detuned = { u = \"-0.3*x - 0.4*v\" }",
            "hard = { u = \"-2*x - 3*v\" }",
        )
        .replace(
            "v_end = \"final(v)\"",
            "v_end = \"final(v)\"\nmost = \"max(u)\"\nleast = \"min(v + u)\"",
        );
    let scene = Scene::new(&text);
    let result = scene.tightly("hard");
    let law = |y: &[f64]| (-2.0 * y[0] - 3.0 * y[1]).clamp(-0.3, 0.2);
    let f = |y: &[f64]| {
        let u = law(y);
        vec![
            y[1],
            -y[0] + u,
            0.5 * (2.0 * y[0] * y[0] + y[1] * y[1] + u * u),
        ]
    };
    let initial = scene.initial();
    const ALLOWED: f64 = 1e-7;
    for i in 0..initial.count() {
        let x = initial.state(i);
        let (mut most, mut least) = (f64::NEG_INFINITY, f64::INFINITY);
        let end = runge_kutta(&f, &[x[0], x[1], 0.0], 8.0, 80_000, &mut |y| {
            most = most.max(law(y));
            least = least.min(y[1] + law(y));
        });
        let expected = [end[0], end[1], most, least];
        for c in 0..4 {
            let error = result.records[4 * i + c] - expected[c];
            // At a kink the reference, which has only its steps' ends, misses a step's way.
            let missed = if c == 3 { 2e-4 } else { 0.0 };
            assert!(
                error <= ALLOWED && error >= -ALLOWED - missed,
                "record {c} from {x:?}: {error:e}"
            );
        }
        // What is left at the end is the local solution's.
        let rest = form(&optimum().0, &end[..2]);
        assert!(
            (result.cost[i] - end[2] - rest).abs() <= ALLOWED,
            "cost from {x:?}"
        );
    }
}

/// A valve g that moves no faster than 0.4, commanded by a function of the other state.
const VALVE: &str = r#"
states = { x = {}, g = {} }
controls = { rate = { min = -0.4, max = 0.4 } }
dynamics = { x = "-0.5*x + sin(x) - g", g = "-0.1*g + 2*rate" }
cost = { running = "x^2 + g^2 + rate^2" }
equilibrium = { x = 0, g = 0, rate = 0 }
region = { x = [-1, 1], g = [-1, 1] }
[closed_loop]
final_time = 6.0
samples = 60
track = 7.0
initial = { x = [-1, 1, 5], g = [-1, 1, 5] }
[closed_loop.law]
commanded = { g = "1.5*x + 0.2*x^2" }
itself = { g = "1.2*x + 0.1*g" }
[closed_loop.record]
x_end = "final(x)"
g_end = "final(g)"
fastest = "max(abs(rate))"
"#;

#[test]
fn a_commanded_state_is_followed_within_the_rate_limit() {
    let scene = Scene::new(VALVE);
    let initial = scene.initial();
    let dx = |x: f64, g: f64| -0.5 * x + x.sin() - g;
    // With the command's own rate where it depends on other states alone, else without.
    type Control<'c> = &'c dyn Fn(f64, f64) -> f64;
    let laws: [(&str, Control<'_>); 2] = [
        ("commanded", &|x, g| {
            let (command, slope) = (1.5 * x + 0.2 * x * x, 1.5 + 0.4 * x);
            (slope * dx(x, g) + 7.0 * (command - g) + 0.1 * g) / 2.0
        }),
        ("itself", &|x, g| {
            (7.0 * (1.2 * x + 0.1 * g - g) + 0.1 * g) / 2.0
        }),
    ];
    for (name, law) in laws {
        let result = scene.tightly(name);
        let mut limited = 0;
        for i in 0..initial.count() {
            let x = initial.state(i);
            let u = |y: &[f64]| law(y[0], y[1]).clamp(-0.4, 0.4);
            let f = |y: &[f64]| vec![dx(y[0], y[1]), -0.1 * y[1] + 2.0 * u(y)];
            let mut fastest = 0.0f64;
            let end = runge_kutta(&f, x, 6.0, 60_000, &mut |y| {
                fastest = fastest.max(u(y).abs())
            });
            let expected = [end[0], end[1], fastest];
            for c in 0..3 {
                let error = (result.records[3 * i + c] - expected[c]).abs();
                assert!(error <= 1e-7, "{name}, record {c} from {x:?}: {error:e}");
            }
            limited += usize::from(fastest == 0.4);
            assert!(fastest <= 0.4);
        }
        assert!(limited > 0, "{name}: some start far from the command");
    }
}

/// A swing without a force, sampled coarsely: extrema of smooth quantities and of ones with kinks,
/// all known.
#[test]
fn extrema_are_found_between_samples() {
    let text = SPRING
        .replace("final_time = 8.0", "final_time = 7.0")
        .replace("samples = 40", "samples = 20")
        .replace("detuned = { u = \"-0.3*x - 0.4*v\" }", "free = { u = \"0\" }")
        .replace(
            "x_end = \"final(x)\"\nv_end = \"final(v)\"",
            "a = \"max(x)\"\nb = \"min(v)\"\nc = \"min(abs(x - 0.1*v))\"\nd = \"max(abs(x))\"\ne = \"min(x*v)\"\nf = \"max(exp(x))\"",
        );
    let scene = Scene::new(&text);
    let result = scene.tightly("free");
    let initial = scene.initial();
    for i in 0..initial.count() {
        let x = initial.state(i);
        let r = x[0].hypot(x[1]);
        let exact = [r, -r, 0.0, r, -0.5 * r * r, r.exp()];
        for c in 0..6 {
            let error = (result.records[6 * i + c] - exact[c]).abs();
            assert!(
                error <= FEW_STEPS * TIGHT.rtol * 3.0,
                "quantity {c} from {x:?}: {error:e}"
            );
        }
    }
}

const PRECISIONS: [Asked; 2] = [
    Asked {
        precision: Precision::F32,
        rtol: 1e-5,
        method: None,
    },
    Asked {
        precision: Precision::F64,
        rtol: 1e-8,
        method: None,
    },
];

/// Errors grow while the valve is at its limit, and J is a sum of many: as for single steps, times
/// the steps.
#[test]
fn backends_and_precisions_agree() {
    let (cpu, gpu) = (Cpu::new(), any_gpu());
    let backends: [&dyn Backend; 2] = [&cpu, &gpu];
    let scene = Scene::new(VALVE);
    let exact = scene.tightly("commanded");
    let known =
        Scene::new(&manufactured_scene().replace("samples = 60", "samples = 60\nperiod = 0.05"));
    for backend in backends {
        for asked in PRECISIONS {
            let case = format!("{} {:?}", backend.name(), asked.precision);
            let allowed = FEW_STEPS * asked.rtol.max(4.0 * asked.precision.epsilon());
            let e = scene.evaluate(
                backend,
                asked,
                &["commanded", "lqr"],
                scene.initial(),
                None,
                None,
            );
            let law = &e.laws[0];
            assert_eq!(law.status, exact.status, "{case}");
            assert_eq!(law.converged, exact.converged, "{case}");
            let pairs = law
                .records
                .iter()
                .zip(&exact.records)
                .chain(law.cost.iter().zip(&exact.cost));
            let worst = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            println!("{case}: {worst:.1e} of {allowed:.0e}");
            assert!(worst <= allowed, "{case}: {worst:e}");

            let e = known.evaluate(
                backend,
                asked,
                &["map"],
                known.initial(),
                Some(&Known),
                None,
            );
            let excess = largest_excess(&e.laws[0], &e.initial);
            assert!(excess <= allowed.max(1e-4), "{case}: chart {excess:e}");
        }
    }
}

fn part(initial: &Initial, range: std::ops::Range<usize>) -> Initial {
    Initial {
        x: initial.x[range.start * initial.states..range.end * initial.states].to_vec(),
        ..initial.clone()
    }
}

/// Bit for bit the same alone, in a few, and in all.
#[test]
fn results_do_not_depend_on_the_batch() {
    let text = manufactured_scene().replace("initial = {", "random = 345\ninitial = {");
    let scene = Scene::new(&text);
    let asked = PRECISIONS[1];
    let all = scene.initial();
    assert_eq!(all.count(), 345);
    let (cpu, gpu) = (Cpu::new(), any_gpu());
    let backends: [&dyn Backend; 2] = [&cpu, &gpu];
    for backend in backends {
        let whole = scene.evaluate(
            backend,
            asked,
            &["exact", "map"],
            all.clone(),
            Some(&Known),
            None,
        );
        for range in [0..1, 17..80, 200..265] {
            let some = part(&all, range.clone());
            let e = scene.evaluate(backend, asked, &["exact", "map"], some, Some(&Known), None);
            for (part, whole) in e.laws.iter().zip(&whole.laws) {
                assert_eq!(part.cost, whole.cost[range.clone()], "{}", backend.name());
                assert_eq!(
                    part.records,
                    whole.records[range.clone()],
                    "{}",
                    backend.name()
                );
                assert_eq!(part.t_end, whole.t_end[range.clone()], "{}", backend.name());
            }
        }
    }
    // Drawn by number and seed: fewer are the first of more.
    let closed_loop = scene.model.closed_loop.as_ref().unwrap();
    let draw = |count, seed| Initial::new(&scene.model, closed_loop, Some(count), seed).unwrap();
    assert_eq!(draw(10, 0).x, all.x[..20]);
    assert_ne!(draw(10, 1).x, all.x[..20]);
    assert!(all.x.iter().all(|x| (-1.0..1.0).contains(x)));
}

/// Growth x' = x + u: with u = 0 it is exp, which meets a guard or a bound at a known time.
#[test]
fn every_trajectory_has_a_status() {
    let text = r#"
states = { x = {} }
controls = { u = {} }
dynamics = { x = "x + u" }
cost = { running = "x^2 + u^2" }
equilibrium = { x = 0, u = 0 }
region = { x = [-1, 1] }
guards = { upper = "x < 1.5" }
[closed_loop]
final_time = 5.0
samples = 50
margin = 1.0
initial = { x = [-1, 1, 3] }
law = { none = { u = "0" }, held = { u = "-2*x" } }
record = { highest = "max(x)", lowest = "min(x)" }
sets = { low = "highest <= 1.2" }
"#;
    let scene = Scene::new(text);
    let (cpu, gpu) = (Cpu::new(), any_gpu());
    let backends: [&dyn Backend; 2] = [&cpu, &gpu];
    for backend in backends {
        let e = scene.evaluate(
            backend,
            PRECISIONS[1],
            &["none", "held", "lqr"],
            scene.initial(),
            None,
            None,
        );
        let none = &e.laws[0];
        assert_eq!(
            none.status,
            [Status::LeftRegion as i32, 0, GUARD_STATUS],
            "{}",
            backend.name()
        );
        let counts = e.statuses(none);
        assert_eq!(
            counts["left_region"] + counts["reached"] + counts["guard_upper"],
            3
        );
        assert!(
            (none.t_end[2] - 1.5f64.ln()).abs() < 1e-6,
            "{}",
            none.t_end[2]
        );
        // Seen at the end of a step: left at 3, not much later.
        assert!(none.t_end[0] >= 3f64.ln() && none.t_end[0] < 5.0);
        assert!(none.cost[0].is_nan() && none.cost[2].is_nan() && none.cost[1] == 0.0);
        assert_eq!(none.converged, [false, true, false]);
        // Recorded up to the end.
        assert!((none.records[4] - 1.5).abs() < 1e-6);
        assert_eq!(e.laws[1].status, [0; 3]);
        // A trajectory that ended early is in no set.
        let share = |law: usize| e.sets[law][0].share;
        assert_eq!((share(0), share(1)), (1.0 / 3.0, 1.0));
        assert!((e.laws[1].records[4] - 1.0).abs() < 1e-12);
    }
}

/// A chart that ends at x = 0.5: trajectories that start beyond it have their own status at once.
#[test]
fn where_the_chart_ends_the_trajectory_ends() {
    struct Bounded;
    impl Chart for Bounded {
        fn local(&self, x: &[f64]) -> Option<Expansion> {
            Known.local(x).filter(|_| x[0] < 0.5)
        }
    }
    let scene = Scene::new(&manufactured_scene());
    let cpu = Cpu::new();
    let e = scene.evaluate(
        &cpu,
        PRECISIONS[1],
        &["map"],
        scene.initial(),
        Some(&Bounded),
        None,
    );
    let law = &e.laws[0];
    let outside: Vec<usize> = (0..e.initial.count())
        .filter(|i| e.initial.state(*i)[0] >= 0.5)
        .collect();
    assert!(outside.len() == 14);
    for i in outside {
        assert_eq!((law.status[i], law.t_end[i]), (OUTSIDE_MAP, 0.0));
        assert!(law.cost[i].is_nan() && e.values[i].is_nan() && !law.converged[i]);
    }
    assert_eq!(
        e.statuses(law)["outside_map"],
        law.status.iter().filter(|s| **s == OUTSIDE_MAP).count()
    );
}

/// A chart of a box, with an edge that is known.
struct Boxed;

impl Boxed {
    const EDGE: f64 = 0.5;
}

impl Chart for Boxed {
    fn local(&self, x: &[f64]) -> Option<Expansion> {
        Known
            .local(x)
            .filter(|_| x.iter().all(|x| x.abs() <= Self::EDGE))
    }

    fn clamp(&self, x: &mut [f64]) -> bool {
        x.iter_mut()
            .for_each(|x| *x = x.clamp(-Self::EDGE, Self::EDGE));
        true
    }
}

/// Each policy does what it says where a chart ends, and what it did is counted.
#[test]
fn outside_a_chart_the_law_goes_on_as_it_was_told() {
    let cpu = Cpu::new();
    let fly = |outside: &str| {
        let text = manufactured_scene().replace(
            "samples = 60",
            &format!("samples = 60\nperiod = 0.05\noutside = \"{outside}\""),
        );
        let scene = Scene::new(&text);
        let e = scene.evaluate(
            &cpu,
            PRECISIONS[1],
            &["map"],
            scene.initial(),
            Some(&Boxed),
            None,
        );
        let inside: Vec<bool> = (0..e.initial.count())
            .map(|i| e.initial.state(i).iter().all(|x| x.abs() <= Boxed::EDGE))
            .collect();
        (inside, e.laws[0].clone())
    };
    for outside in ["stop", "hold"] {
        let (inside, law) = fly(outside);
        for (i, inside) in inside.iter().enumerate() {
            // From inside V falls, and no trajectory from there leaves the box for good.
            if !inside {
                assert_eq!(
                    (law.status[i], law.t_end[i], law.fallback[i]),
                    (OUTSIDE_MAP, 0.0, 1)
                );
            }
        }
    }
    for outside in ["nearest", "search", "lqr"] {
        let (inside, law) = fly(outside);
        assert!(law.converged.iter().all(|c| *c), "{outside}");
        let outer = inside.iter().filter(|inside| !**inside).count();
        assert!(law.fell_back() >= outer);
        for (i, inside) in inside.iter().enumerate() {
            assert!(*inside || law.fallback[i] > 0);
        }
        let updates: u32 = law.fallback.iter().sum();
        assert!((law.held - f64::from(updates) / (law.status.len() * 300) as f64).abs() < 1e-12);
        // No law costs less than V; these know V inside, and go there without haste.
        for i in 0..law.cost.len() {
            let v = manufactured::value(&[law_start(i, 0), law_start(i, 1)]);
            assert!(
                law.cost[i] >= v - 1e-3 * (1.0 + v) && law.cost[i] <= 1.5 * v + 1e-3,
                "{outside} {i}"
            );
        }
    }
}

/// The grid of starts of the manufactured scene.
fn law_start(i: usize, state: usize) -> f64 {
    let place = if state == 0 { i / 7 } else { i % 7 };
    -1.0 + place as f64 / 3.0
}

/// A pendulum that its law alone drops: beyond its range the nearest known p pushes the wrong way
/// round. The search finds that holding the control at a bound leads back.
#[test]
fn a_search_finds_the_way_back() {
    // x' = v, v' = x + u with |u| <= 1: what is known is a box about 0, and the nearest p is that
    // of its corner.
    let text = r#"
states = { x = {}, v = {} }
controls = { u = { min = -1, max = 1 } }
dynamics = { x = "v", v = "-0.2*x + u" }
cost = { running = "0.5*(x^2 + v^2 + u^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-6, 6], v = [-6, 6] }
[closed_loop]
final_time = 40.0
samples = 200
margin = 4.0
outside = "POLICY"
initial = { x = [3, 5, 3], v = [-1, 1, 3] }
"#;
    /// p points away from the equilibrium at the edge of what is known: the nearest p pumps energy
    /// in.
    struct Misleading;
    impl Chart for Misleading {
        fn local(&self, x: &[f64]) -> Option<Expansion> {
            let inside = x.iter().all(|x| x.abs() <= 2.0);
            let edge = x.iter().any(|x| x.abs() >= 1.9);
            let sign = if edge { -1.0 } else { 1.0 };
            inside.then(|| Expansion {
                v: x[0] * x[0] + x[1] * x[1],
                p: vec![sign * (2.0 * x[0] + x[1]), sign * (2.0 * x[1] + x[0])],
                hessian: vec![2.0, 1.0, 1.0, 2.0]
                    .into_iter()
                    .map(|h| sign * h)
                    .collect(),
            })
        }
        fn clamp(&self, x: &mut [f64]) -> bool {
            x.iter_mut().for_each(|x| *x = x.clamp(-2.0, 2.0));
            true
        }
    }
    let cpu = Cpu::new();
    let home = |policy: &str| {
        let scene = Scene::new(&text.replace("POLICY", policy));
        let e = scene.evaluate(
            &cpu,
            PRECISIONS[1],
            &["map"],
            scene.initial(),
            Some(&Misleading),
            None,
        );
        assert!(
            e.laws[0].fell_back()
                >= 9 - e.laws[0]
                    .status
                    .iter()
                    .filter(|s| **s == OUTSIDE_MAP)
                    .count()
        );
        e.laws[0].converged.iter().filter(|c| **c).count()
    };
    let (nearest, search) = (home("nearest"), home("search"));
    println!("home by the nearest p: {nearest} of 9, by a search: {search}");
    assert!(search > nearest);
}

/// Parts on threads of their own and a batch as a whole give the same bits, whatever the number of
/// trajectories.
#[test]
fn a_flight_under_a_chart_does_not_depend_on_its_company() {
    let text = manufactured_scene().replace(
        "initial = { x = [-1, 1, 7], y = [-1, 1, 7] }",
        "initial = { x = [-1, 1, 23], y = [-1, 1, 15] }",
    );
    let scene = Scene::new(&text);
    let cpu = Cpu::new();
    let all = scene.initial();
    let e = scene.evaluate(
        &cpu,
        PRECISIONS[1],
        &["map"],
        all.clone(),
        Some(&Boxed),
        None,
    );
    for i in [0, 1, 63, 172, 344] {
        let one = Initial {
            x: all.state(i).to_vec(),
            axes: Vec::new(),
            ..all.clone()
        };
        let alone = scene.evaluate(&cpu, PRECISIONS[1], &["map"], one, Some(&Boxed), None);
        assert_eq!(alone.laws[0].cost[0].to_bits(), e.laws[0].cost[i].to_bits());
        assert_eq!(
            alone.laws[0].records[0].to_bits(),
            e.laws[0].records[i].to_bits()
        );
        assert_eq!(alone.laws[0].fallback[0], e.laws[0].fallback[i]);
    }
}

/// The set of starts from which the free swing stays within 0.8 is a disk.
#[test]
fn an_operating_set_has_its_area() {
    let text = SPRING
        .replace("final_time = 8.0", "final_time = 7.0")
        .replace("[-1, 1, 5], v = [-1, 1, 5]", "[-1, 1, 41], v = [-1, 1, 31]")
        .replace("detuned = { u = \"-0.3*x - 0.4*v\" }", "free = { u = \"0*x\" }")
        .replace(
            "x_end = \"final(x)\"\nv_end = \"final(v)\"",
            "reach = \"max(abs(x))\"\n[closed_loop.sets]\nnear = \"reach <= 0.8\"\nfar = \"1.0 - 0.2 <= reach\"",
        );
    let scene = Scene::new(&text);
    let cpu = Cpu::new();
    let e = scene.evaluate(&cpu, PRECISIONS[1], &["free"], scene.initial(), None, None);
    let (near, far) = (&e.sets[0][0], &e.sets[0][1]);
    let disk = std::f64::consts::PI * 0.64;
    // Second order in the spacing, 0.067.
    assert!((near.area - disk).abs() < 0.01, "{}", near.area);
    assert!((near.area + far.area - 4.0).abs() < 1e-9);
    assert!((near.share - disk / 4.0).abs() < 0.05);
    assert_eq!(near.lines.len(), 1);
    assert!(
        near.lines[0]
            .iter()
            .all(|p| (p[0].hypot(p[1]) - 0.8).abs() < 0.005)
    );
}

/// A finite horizon: J is the running cost to its end and the terminal cost there; there is nothing
/// to converge to.
#[test]
fn a_finite_horizon_ends_with_its_terminal_cost() {
    let text = r#"
states = { x = {} }
controls = { u = {} }
dynamics = { x = "u" }
cost = { running = "0.5*u^2", terminal = "2*x^2", final_time = 3.0 }
region = { x = [-1, 1] }
[closed_loop]
initial = { x = [-1, 1, 5] }
law = { held = { u = "-x" } }
"#;
    let scene = Scene::new(text);
    let result = scene.tightly("held");
    let initial = scene.initial();
    for i in 0..initial.count() {
        let x = initial.state(i)[0];
        let e = (-6.0f64).exp();
        let exact = x * x * (0.25 * (1.0 - e) + 2.0 * e);
        assert!(
            (result.cost[i] - exact).abs() <= FEW_STEPS * TIGHT.rtol,
            "{x}"
        );
        assert!(result.converged[i]);
    }
}

/// Whether an angle has gone round is seen modulo its period.
#[test]
fn a_turn_is_no_distance() {
    let text = r#"
states = { a = { period = "2*pi" } }
controls = { u = {} }
dynamics = { a = "-sin(a) + u" }
cost = { running = "sin(a)^2 + (1 - cos(a))^2 + u^2" }
equilibrium = { a = 0, u = 0 }
region = { a = [-1, 8] }
[closed_loop]
final_time = 20.0
initial = { a = [-1, 8, 4] }
law = { none = { u = "0" } }
"#;
    let scene = Scene::new(text);
    let result = scene.tightly("none");
    assert_eq!(result.converged, [true; 4]);
}

/// A band without answers is bridged with the last one.
#[test]
fn a_gap_in_the_chart_is_bridged() {
    struct Gapped;
    impl Chart for Gapped {
        fn local(&self, x: &[f64]) -> Option<Expansion> {
            Known
                .local(x)
                .filter(|_| !(0.2..0.3).contains(&x[0].hypot(x[1])))
        }
    }
    let scene =
        Scene::new(&manufactured_scene().replace("samples = 60", "samples = 60\nperiod = 0.05"));
    let all = scene.initial();
    // Not those that start in it.
    let starts: Vec<f64> = (0..all.count())
        .map(|i| all.state(i))
        .filter(|x| x[0].hypot(x[1]) > 0.4)
        .flatten()
        .copied()
        .collect();
    let initial = Initial {
        x: starts,
        axes: Vec::new(),
        ..all
    };
    let cpu = Cpu::new();
    let e = scene.evaluate(
        &cpu,
        PRECISIONS[1],
        &["map"],
        initial.clone(),
        Some(&Gapped),
        None,
    );
    assert!(e.laws[0].held > 0.0 && e.laws[0].held < 0.2);
    let excess = largest_excess(&e.laws[0], &e.initial);
    // V is of the third order beyond the last answer, at most 0.15 away: J to the square of 0.02.
    assert!(excess < 1e-3, "{excess:e}");
    let e = scene.evaluate(&cpu, PRECISIONS[1], &["map"], initial, Some(&Known), None);
    assert_eq!(e.laws[0].held, 0.0);
}
