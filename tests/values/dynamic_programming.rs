//! V on a grid against exact answers, its symmetries, and greedy paths, on the CPU and on any
//! adapter.

use crate::common;
use crate::common_oracles;
use crate::common_problems::{Cart, TwoWells, manufactured};

use common::any_gpu;
use common_oracles::{derive, parse, scene};
use costate::backend::cpu::Cpu;
use costate::low_level::dynamic_programming::{Device, DpError, GridValue, Options, solve};
use costate::low_level::model::Model;
use costate::low_level::sweep::{Choices, Plan, spread_over};

fn planned(model: &Model) -> Plan {
    let choices = Choices {
        unasked: true,
        ..Choices::default()
    };
    Plan::new(model, &derive(model), &Cpu::new(), choices).expect("the scene can be planned")
}

fn solved_on(model: &Model, options: &Options, device: Device<'_>) -> (Plan, GridValue) {
    let plan = planned(model);
    let value = solve(model, &derive(model), &plan, options, device).expect("the scene has a grid");
    (plan, value)
}

fn solved(model: &Model, options: &Options) -> (Plan, GridValue) {
    solved_on(model, options, Device::cpu())
}

/// So many nodes along each of two axes.
fn nodes(count: usize) -> Options {
    Options {
        nodes: vec![count; 2],
        ..Options::default()
    }
}

/// Median and 95 % quantile of sizes.
fn quantiles(mut sizes: Vec<f64>) -> (f64, f64) {
    assert!(!sizes.is_empty());
    sizes.sort_by(f64::total_cmp);
    let at = |q: f64| sizes[((sizes.len() - 1) as f64 * q) as usize];
    (at(0.5), at(0.95))
}

/// Relative errors of V over the region; infinite where the grid has no answer.
fn errors(plan: &Plan, value: &GridValue, exact: impl Fn(&[f64]) -> f64) -> Vec<f64> {
    let of = |s: Vec<f64>| {
        let (found, exact) = (value.value(&s).unwrap_or(f64::INFINITY), exact(&s));
        (found - exact).abs() / exact.abs().max(1e-3)
    };
    spread_over(&plan.region, 2000)
        .into_iter()
        .map(of)
        .collect()
}

/// What the flights of greedy paths from states over the region cost, relative to the grid's V,
/// less 1; sorted. A state without one counts as infinite.
fn flights(plan: &Plan, value: &GridValue, count: usize) -> Vec<f64> {
    let of = |s: Vec<f64>| match (value.value(&s), value.greedy(&s)) {
        (Some(v), Some((cost, _))) => cost / v - 1.0,
        _ => f64::INFINITY,
    };
    let mut list: Vec<f64> = spread_over(&plan.region, count)
        .into_iter()
        .map(of)
        .collect();
    list.sort_by(f64::total_cmp);
    list
}

/// V of the cart of `scenarios/finite_horizon.toml` with 2 s left.
fn cart_value(s: &[f64]) -> f64 {
    Cart { weight: 10.0 }.at(s, 2.0).v
}

fn wells_value(s: &[f64]) -> f64 {
    TwoWells::with(2.0).at(s).v
}

/// Measured with 101 x 101 nodes: see the figures beside the bounds.
#[test]
fn a_manufactured_value_is_met() {
    let (plan, value) = solved(&scene("manufactured", &[]), &nodes(101));
    let (median, most) = quantiles(errors(&plan, &value, manufactured::value));
    println!("manufactured: median {median:.1e}, 95 % {most:.1e}");
    assert!(
        median < 0.005 && most < 0.02,
        "median {median}, 95 % {most}"
    );
    let p = value.gradient(&[1.0, -0.5]).expect("inside");
    let exact = manufactured::at(&[1.0, -0.5]).p;
    for (p, exact) in p.iter().zip(exact) {
        assert!((p - exact).abs() < 0.02, "{p} {exact}");
    }
}

#[test]
fn a_linear_quadratic_value_is_met() {
    let model = parse(
        "states = { x = {}, v = {} }\ncontrols = { u = {} }\ndynamics = { x = \"v\", v = \"0.5*x + u\" }\n\
         cost = { running = \"0.5*(x^2 + v^2 + 0.5*u^2)\" }\nequilibrium = { x = 0, v = 0, u = 0 }\n\
         region = { x = [-1, 1], v = [-2, 2] }\n",
    );
    let (plan, value) = solved(&model, &nodes(81));
    let local = plan.local.as_ref().expect("an infinite horizon");
    let (median, most) = quantiles(errors(&plan, &value, |s| local.quadratic(s)));
    println!("linear-quadratic: median {median:.1e}, 95 % {most:.1e}");
    assert!(
        median < 0.002 && most < 0.01,
        "median {median}, 95 % {most}"
    );
}

/// One state, with the number of nodes that it gets by itself, and four: the quadratic V of the
/// Riccati equation is exact.
#[test]
fn one_and_four_states() {
    let scalar = parse(
        "states = { x = {} }\ncontrols = { u = {} }\ndynamics = { x = \"0.5*x + u\" }\n\
         cost = { running = \"0.5*(x^2 + u^2)\" }\nequilibrium = { x = 0, u = 0 }\nregion = { x = [-1, 1] }\n",
    );
    let cases = [
        (scalar, Vec::new(), 0.002, 0.01),
        (scene("linear_quadratic", &[]), vec![13; 4], 0.05, 0.15),
    ];
    for (model, nodes, median_bound, most_bound) in cases {
        let options = Options {
            nodes,
            ..Options::default()
        };
        let (plan, value) = solved(&model, &options);
        let local = plan.local.as_ref().expect("an infinite horizon");
        let (median, most) = quantiles(errors(&plan, &value, |s| local.quadratic(s)));
        println!(
            "{}: median {median:.1e}, 95 % {most:.1e}, {:.1} s",
            model.title, value.seconds
        );
        assert!(
            median < median_bound && most < most_bound,
            "median {median}, 95 % {most}"
        );
    }
}

/// V(x, v) = V(-x, -v); the problem of tried.md 2 with its two values by collocation.
const BALANCED: &str = "states = { x = {}, v = {} }\ncontrols = { u = {} }\ndynamics = { x = \"v\", v = \"7*sin(x) + u\" }\n\
     cost = { running = \"0.5*(0.8*x^2 + 0.4*v^2 + 2.7*u^2)\" }\nequilibrium = { x = 0, v = 0, u = 0 }\n\
     region = { x = [-4, 4], v = [-4, 4] }\n";

#[test]
fn a_symmetric_scene_stays_symmetric_and_many_sheets_do_no_harm() {
    let (plan, value) = solved(&parse(BALANCED), &nodes(121));
    for s in spread_over(&plan.region, 300) {
        let other: Vec<f64> = s.iter().map(|x| -x).collect();
        let (v, w) = (
            value.value(&s).expect("reached"),
            value.value(&other).expect("reached"),
        );
        // Candidates are tried in an order that is not symmetric: equal up to where the iteration
        // stops.
        assert!((v - w).abs() <= 2e-3 * v, "{s:?}: {v} {w}");
    }
    for (s, exact) in [([1.5, 1.0], 20.86786), ([-2.5, -2.5], 21.37833)] {
        let found = value.value(&s).expect("reached");
        assert!((found / exact - 1.0).abs() < 0.01, "{s:?}: {found} {exact}");
        let (cost, path) = value.greedy(&s).expect("a path");
        // A flown control is dearer than V, up to the integration's error and the local solution's
        // at the end.
        assert!(
            cost > exact * (1.0 - 1e-3) && cost < exact * 1.02,
            "{s:?}: {cost} {exact}"
        );
        assert_eq!(path.start(), s);
        assert!(
            plan.local
                .as_ref()
                .is_some_and(|local| local.quadratic(&path.last()[..2]) < 1e-3)
        );
    }
}

/// A pendulum whose cost is periodic, on a ring; and one whose cost counts turns, where a state is
/// as cheap as its best copy.
#[test]
fn periodic_axes_are_rings_or_turns() {
    let text = |cost: &str| {
        format!(
            "states = {{ a = {{ period = \"2*pi\" }}, w = {{}} }}\ncontrols = {{ u = {{}} }}\n\
             dynamics = {{ a = \"w\", w = \"sin(a) + u\" }}\n\
             cost = {{ running = \"0.5*({cost} + w^2 + u^2)\" }}\nequilibrium = {{ a = 0, w = 0, u = 0 }}\n\
             region = {{ a = [\"-pi\", \"pi\"], w = [-2, 2] }}\n"
        )
    };
    let turn = std::f64::consts::TAU;
    for (cost, ring) in [("2*(1 - cos(a))", true), ("a^2", false)] {
        let (_, value) = solved(&parse(&text(cost)), &nodes(101));
        assert_eq!(value.grid.lattice.axes[0].period.is_some(), ring, "{cost}");
        for s in [[1.0, 0.5], [3.0, -1.0], [3.1, 1.5]] {
            let v = value.value(&s).expect("reached");
            let copy = value.value(&[s[0] - turn, s[1]]).expect("reached");
            assert!((v - copy).abs() < 1e-9 * v, "{cost}, {s:?}: {v} {copy}");
            let (flown, path) = value.greedy(&s).expect("a path");
            assert!((flown / v - 1.0).abs() < 0.02, "{cost}, {s:?}: {flown} {v}");
            let turns = (path.start()[0] - s[0]) / turn;
            assert!((turns - turns.round()).abs() < 1e-9);
            assert!(
                path.last()[0].abs() < 0.1,
                "the path ends at the reference itself"
            );
        }
    }
}

/// On omega = 0 both ways round cost the same at theta = 2.409, V = 183.9.
#[test]
fn the_pendulum_of_two_ways_round() {
    let (plan, value) = solved(&scene("pendulum", &[]), &Options::default());
    let at = |theta: f64| value.value(&[theta + 1.5, 0.0]).expect("reached");
    assert!((at(2.409) / 183.9 - 1.0).abs() < 0.02, "{}", at(2.409));
    let flown = flights(&plan, &value, 60);
    let within = flown.iter().filter(|f| f.abs() < 0.02).count();
    assert!(
        within >= 57,
        "{within} of 60 flights cost what the grid says"
    );
    assert!(flown[0] > -0.02, "no flight is much cheaper: {}", flown[0]);
}

#[test]
fn finite_horizons_are_met() {
    let (plan, value) = solved(&scene("finite_horizon", &[]), &nodes(81));
    let (median, most) = quantiles(errors(&plan, &value, cart_value));
    println!("finite horizon: median {median:.1e}, 95 % {most:.1e}");
    assert!(
        median < 0.005 && most < 0.02,
        "median {median}, 95 % {most}"
    );
    let (cost, path) = value.greedy(&[1.0, 0.5]).expect("a path");
    assert!((path.horizon() - 2.0).abs() < 1e-12);
    let exact = cart_value(&[1.0, 0.5]);
    assert!(
        cost > exact * (1.0 - 1e-6) && cost < exact * 1.02,
        "{cost} {exact}"
    );

    let (plan, value) = solved(&scene("hopf_lax", &[]), &nodes(101));
    let (median, most) = quantiles(errors(&plan, &value, wells_value));
    println!("two wells: median {median:.1e}, 95 % {most:.1e}");
    assert!(
        median < 0.005 && most < 0.02,
        "median {median}, 95 % {most}"
    );
}

/// A reaction that runs away within a hundredth of the horizon: a step that a fixed number of
/// slices would give overshoots it to where nothing reacts any more. The references are another
/// program's.
#[test]
fn steps_are_short_where_rates_are_fast() {
    let data = std::path::Path::new(crate::ROOT).join("tests/data/least/tank");
    let model = costate::low_level::scenario::load(&data.with_extension("toml"), &[])
        .unwrap_or_else(|e| panic!("{e}"));
    let (plan, value) = solved(&model, &nodes(81));
    let mut reader =
        csv::Reader::from_path(data.with_extension("csv")).expect("the table is there");
    let mut compared = 0;
    for row in reader.records() {
        let row: Vec<f64> = row.unwrap().iter().map(|c| c.parse().unwrap()).collect();
        let s: Vec<f64> = row
            .iter()
            .zip(&plan.system.reference)
            .map(|(x, r)| x - r)
            .collect();
        let v = value.value(&s).expect("inside");
        assert!((v / row[2] - 1.0).abs() < 0.02, "{row:?}: {v}");
        compared += 1;
    }
    assert!(compared >= 5);
}

#[test]
fn greedy_paths_cost_what_v_says() {
    let (plan, value) = solved(&scene("manufactured", &[]), &nodes(101));
    let flown = flights(&plan, &value, 100);
    // The grid's V is above the flown cost by no more than its own error, and a greedy control is
    // nearly optimal.
    assert!(
        flown[0] > -0.01 && flown[99] < 0.02,
        "from {} to {}",
        flown[0],
        flown[99]
    );
    for s in spread_over(&plan.region, 100) {
        let (cost, _) = value.greedy(&s).expect("a path");
        // A flown control never costs less than V but for the end, where the local solution's V is
        // within 0.5 %.
        let exact = manufactured::value(&s);
        assert!(cost > exact * (1.0 - 0.005), "{s:?}: {cost} {exact}");
    }
}

#[test]
fn what_cannot_be_solved_is_refused() {
    let game = scene("pendulum_game", &[]);
    let refused = |model: &Model, options: &Options| {
        let plan = planned(model);
        solve(model, &derive(model), &plan, options, Device::cpu()).err()
    };
    assert!(matches!(
        refused(&game, &Options::default()),
        Some(DpError::Game)
    ));
    let wrong = Options {
        nodes: vec![11; 3],
        ..Options::default()
    };
    let error = refused(&scene("manufactured", &[]), &wrong);
    assert!(matches!(
        error,
        Some(DpError::Counts {
            given: 3,
            states: 2
        })
    ));
}

/// Why two grids do not agree.
#[derive(Debug, PartialEq)]
enum Difference {
    SameBackend,
    Lattice,
    Value { node: usize, a: f64, b: f64 },
}

/// Both iterations stop where a round changes values by 1e-4, from different roundings: ten times
/// that.
const AGREEMENT: f64 = 1e-3;

/// At the nodes in the region: at the lattice's border few steps stay inside, and which of them is
/// best hangs on rounding.
fn compare(region: &[[f64; 2]], a: &GridValue, b: &GridValue) -> Result<usize, Difference> {
    if a.backend == b.backend {
        return Err(Difference::SameBackend);
    }
    if a.grid.lattice != b.grid.lattice {
        return Err(Difference::Lattice);
    }
    let mut compared = 0;
    let inside = |node: &usize| {
        (a.grid.lattice.node(*node).iter().zip(region)).all(|(s, [lo, hi])| s >= lo && s <= hi)
    };
    for node in (0..a.grid.values.len()).filter(inside) {
        let (x, y) = (&a.grid.values[node], &b.grid.values[node]);
        let (x_known, y_known) = (*x < a.reached_below, *y < b.reached_below);
        if x_known != y_known
            || (x_known && ((x - y).is_nan() || (x - y).abs() > AGREEMENT * (x.abs() + 0.01)))
        {
            return Err(Difference::Value { node, a: *x, b: *y });
        }
        compared += usize::from(x_known);
    }
    Ok(compared)
}

/// The shader computes what the CPU does, in f32: an infinite horizon with a ring, one with bounds
/// and a guard, and a finite one.
#[test]
fn both_devices_agree() {
    let gpu = any_gpu();
    let guarded = "states = { x = {}, v = {} }\ncontrols = { u = { min = -2, max = 2 } }\n\
        dynamics = { x = \"v\", v = \"-x + x^3/6 + u\" }\ncost = { running = \"0.5*(x^2 + v^2 + u^2)\" }\n\
        equilibrium = { x = 0, v = 0, u = 0 }\nregion = { x = [-1, 1], v = [-1, 1] }\nguards = { low = \"v > -1.2\" }\n";
    let scenes = [
        (scene("pendulum_rest", &[]), 41),
        (parse(guarded), 31),
        (scene("finite_horizon", &[]), 31),
    ];
    for (model, count) in scenes {
        let (plan, host) = solved(&model, &nodes(count));
        let (_, device) = solved_on(&model, &nodes(count), Device::of(&gpu));
        assert_eq!((host.backend, device.backend), ("cpu", "gpu"));
        let compared = compare(&plan.region, &host, &device)
            .unwrap_or_else(|e| panic!("{}: {e:?}", model.title));
        assert!(compared > 100, "{compared} values compared");
        println!(
            "{}: {compared} values, cpu {:.2} s, gpu {:.2} s",
            model.title, host.seconds, device.seconds
        );
        // The comparison is worth something: it notices one value that is off, and one side
        // compared with itself.
        let node = host.grid.lattice.nearest(&[0.5, -0.5]).expect("inside");
        let mut perturbed = device;
        perturbed.grid.values[node] *= 1.0 + 3.0 * AGREEMENT;
        assert!(
            matches!(compare(&plan.region, &host, &perturbed), Err(Difference::Value { node: n, .. }) if n == node)
        );
        assert_eq!(
            compare(&plan.region, &host, &host),
            Err(Difference::SameBackend)
        );
    }
}

#[test]
#[ignore = "prints figures"]
fn probe() {
    let path = std::env::var("DP_SCENE").expect("DP_SCENE names a scene");
    let model =
        costate::low_level::scenario::load(path.as_ref(), &[]).unwrap_or_else(|e| panic!("{e}"));
    let number = |name: &str| std::env::var(name).ok();
    let mut options = Options::default();
    if let Some(nodes) = number("DP_NODES") {
        options.nodes = nodes.split(',').map(|x| x.parse().unwrap()).collect();
    }
    if let Some(margin) = number("DP_MARGIN") {
        options.margin = margin.parse().unwrap();
    }
    let (plan, value) = solved(&model, &options);
    println!(
        "nodes {:?} seconds {:.2} rounds {} changes {:?} ceiling {:.3e}",
        value
            .grid
            .lattice
            .axes
            .iter()
            .map(|a| a.count)
            .collect::<Vec<_>>(),
        value.seconds,
        value.changes.len(),
        value
            .changes
            .iter()
            .map(|c| (c * 1e5).round() / 1e5)
            .collect::<Vec<_>>(),
        value.reached_below
    );
    if path.contains("manufactured") {
        println!(
            "errors median, 95 %: {:?}",
            quantiles(errors(&plan, &value, manufactured::value))
        );
    }
    if path.contains("finite_horizon") {
        println!(
            "errors median, 95 %: {:?}",
            quantiles(errors(&plan, &value, cart_value))
        );
    }
    if path.contains("hopf_lax") {
        println!(
            "errors median, 95 %: {:?}",
            quantiles(errors(&plan, &value, wells_value))
        );
    }
    if let Some(points) = number("DP_AT") {
        for point in points.split(';') {
            let x: Vec<f64> = point.split(',').map(|x| x.parse().unwrap()).collect();
            let s: Vec<f64> = x
                .iter()
                .zip(&plan.system.reference)
                .map(|(x, r)| x - r)
                .collect();
            let begun = std::time::Instant::now();
            let greedy = value
                .greedy(&s)
                .map(|g| (g.0, g.1.segments(), g.1.horizon()));
            println!(
                "{x:?}: V {:?} greedy {greedy:?} in {:.3} s p {:?}",
                value.value(&s),
                begun.elapsed().as_secs_f64(),
                value.gradient(&s)
            );
        }
    }
    let mut ratios = Vec::new();
    let begun = std::time::Instant::now();
    let (mut known, mut flown) = (0, 0);
    for s in spread_over(&plan.region, 200) {
        let Some(v) = value.value(&s) else { continue };
        known += 1;
        let Some((cost, _)) = value.greedy(&s) else {
            continue;
        };
        flown += 1;
        ratios.push(cost / v - 1.0);
    }
    ratios.sort_by(f64::total_cmp);
    let at = |q: f64| ratios[((ratios.len() - 1) as f64 * q) as usize];
    println!(
        "known {known} flown {flown} of 200 in {:.2} s; flown / V - 1: least {:.4} 5 % {:.4} median {:.4} 95 % {:.4} most {:.4}",
        begun.elapsed().as_secs_f64(),
        at(0.0),
        at(0.05),
        at(0.5),
        at(0.95),
        at(1.0)
    );
}
