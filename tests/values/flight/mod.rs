//! Flights: their costs are upper bounds of V, exact where the law is, and undercut claims that are
//! too high.

mod claims;
use crate::common_oracles;
use crate::common_problems::{Cart, manufactured};
use crate::common_values;
mod speed;

use common_oracles::{Random, Worst, parameter};
use common_values::{Swept, given, parse, scene};
use costate::low_level::shooting::{Goal, Job, Path};
use costate::low_level::value::flight::{
    AlongState, AlongTime, At, Expansion, Flight, FlightEnd, Flown, Guide, Law, Linear, PIECES,
    Pilot, Site, Terminal, guides, slopes,
};

/// Error of a flown cost, relative to it: ten times the tolerance of a step.
pub const COST_ERROR: f64 = 1e-8;

/// States of the manufactured scene with V up to 2.4.
fn manufactured_states(count: usize) -> Vec<Vec<f64>> {
    let mut random = Random::new(7);
    std::iter::repeat_with(|| random.point(&[[-2.0, 2.0], [-2.0, 2.0]]))
        .filter(|s| manufactured::value(s) < 2.4)
        .take(count)
        .collect()
}

pub fn fly(swept: &Swept, flights: &[Flight<'_>]) -> Vec<Flown> {
    let mut pilot = Pilot::new(&swept.plan).expect("the CPU compiles everything");
    pilot.fly(flights).expect("the backend works")
}

pub fn fly_all(swept: &Swept, law: &dyn Law, states: &[Vec<f64>]) -> Vec<Flown> {
    let flights: Vec<Flight> = (states.iter())
        .map(|s| Flight {
            start: s.clone(),
            law,
            ceiling: f64::INFINITY,
        })
        .collect();
    fly(swept, &flights)
}

/// Solutions at states: paths and V. States are deviations from an equilibrium at 0.
pub fn solutions(swept: &Swept, states: &[Vec<f64>]) -> Vec<(Path, f64)> {
    let answers = swept.points(&states.concat());
    (0..states.len())
        .map(|k| given(&answers, k).expect("the scene is solved everywhere"))
        .map(|entry| (entry.path.clone(), entry.value))
        .collect()
}

fn guides_of(swept: &Swept, solved: &[(Path, f64)]) -> Vec<Guide> {
    let paths: Vec<&Path> = solved.iter().map(|(path, _)| path).collect();
    guides(&swept.plan, &mut swept.solver(), &paths, PIECES).expect("the backend works")
}

/// Multiple shooting from a flight's path at its start.
pub fn shot(swept: &Swept, path: &Path) -> Option<f64> {
    let mut jobs = [Job::new(path.clone(), Goal::State(path.start().to_vec()))];
    swept.solver().solve(&mut jobs).expect("the backend works");
    jobs[0].solved().map(|solved| solved.value)
}

#[test]
fn linear_law_of_a_linear_scene_costs_v() {
    let swept = Swept::new(scene("linear_quadratic", &[]), 64);
    let riccati = &swept.plan.local.as_ref().expect("an equilibrium").riccati;
    let mut random = Random::new(3);
    let states: Vec<Vec<f64>> = (0..100).map(|_| random.point(&swept.plan.region)).collect();
    let linear = Linear::new(&swept.plan).expect("an infinite horizon");
    let mut worst = Worst::default();
    for (s, flown) in states.iter().zip(fly_all(&swept, &linear, &states)) {
        assert_eq!(flown.end, FlightEnd::Home);
        let s = nalgebra::DVector::from_column_slice(s);
        let exact = 0.5 * (s.transpose() * &riccati.p * &s)[0];
        worst.see((flown.cost - exact).abs() / exact);
    }
    worst.at_most(COST_ERROR, "cost under the exact law");
}

#[test]
fn costs_are_upper_bounds_and_following_a_neighbour_is_nearly_optimal() {
    let swept = Swept::new(scene("manufactured", &[]), 400);
    let states = manufactured_states(120);
    let linear = Linear::new(&swept.plan).expect("an infinite horizon");
    let expansion = Expansion::new(&swept.plan).expect("an infinite horizon");
    // A neighbour a twentieth of the region's width away.
    let near: Vec<Vec<f64>> = states
        .iter()
        .map(|s| vec![0.95 * s[0] + 0.1, s[1] - 0.1])
        .collect();
    let solved = solutions(&swept, &near);
    let guides = guides_of(&swept, &solved);
    let by_time: Vec<AlongTime> = (guides.iter().zip(&states))
        .map(|(guide, s)| AlongTime::new(&swept.plan, guide, s))
        .collect();
    let by_state: Vec<AlongState> = (guides.iter().zip(&states))
        .map(|(guide, s)| AlongState::new(&swept.plan, guide, s))
        .collect();
    let sites: Vec<Site> = (solved.iter().zip(&near))
        .map(|((path, value), s)| Site {
            s: s.clone(),
            value: *value,
            p: path.adjoint().to_vec(),
            slope: Some(manufactured::hessian(s).to_vec()),
        })
        .collect();
    let at = At::new(&swept.plan, &sites).expect("sites");
    for (name, bound, law) in [
        ("linear", 1.5, None),
        ("expansion", 1.5, Some(&expansion as &dyn Law)),
        ("sites", 1.1, Some(&at as &dyn Law)),
    ] {
        let law = law.unwrap_or(&linear);
        check_bounds(name, &states, &fly_all(&swept, law, &states), bound);
    }
    let along = |laws: Vec<&dyn Law>| {
        let flights: Vec<Flight> = (laws.into_iter().zip(&states))
            .map(|(law, s)| Flight {
                start: s.clone(),
                law,
                ceiling: f64::INFINITY,
            })
            .collect();
        fly(&swept, &flights)
    };
    let flown = along(by_time.iter().map(|law| law as &dyn Law).collect());
    check_bounds("along, by time", &states, &flown, 1.01);
    let flown = along(by_state.iter().map(|law| law as &dyn Law).collect());
    check_bounds("along, by state", &states, &flown, 1.01);
}

/// Costs are at least V and at most `bound` times it.
fn check_bounds(name: &str, states: &[Vec<f64>], flown: &[Flown], bound: f64) {
    let (mut below, mut above) = (0.0f64, Worst::default());
    for (s, flown) in states.iter().zip(flown) {
        let exact = manufactured::value(s);
        assert_eq!(flown.end, FlightEnd::Home, "{name} from {s:?}");
        below = below.max((exact - flown.cost) / exact);
        above.see(flown.cost / exact);
    }
    println!("{name}: at most {below:.1e} below V");
    assert!(below <= COST_ERROR, "{name}: {below:.2e} below V");
    println!("{name}: cost at most V (1 + {:.1e})", above.worst - 1.0);
    above.at_most(bound, &format!("{name}: cost over V"));
}

#[test]
fn slopes_at_nodes_are_the_second_derivatives_of_v() {
    let swept = Swept::new(scene("manufactured", &[]), 400);
    let solved = solutions(&swept, &manufactured_states(10));
    let paths: Vec<&Path> = solved.iter().map(|(path, _)| path).collect();
    let found = slopes(&mut swept.solver(), &paths).expect("the backend works");
    let mut worst = Worst::default();
    for (path, slopes) in paths.iter().zip(&found) {
        assert_eq!(slopes.len(), path.segments() + 1);
        for (k, slope) in slopes.iter().enumerate() {
            let exact = manufactured::hessian(path.node(k));
            for (a, b) in slope.as_ref().expect("V is smooth").iter().zip(exact) {
                worst.see((a - b).abs());
            }
        }
    }
    // Segments integrated to 1e-6, entries of order 1, some of their errors amplified within a
    // segment.
    worst.at_most(1e-4, "entries of dp/ds");
}

#[test]
fn finite_horizon_costs_are_upper_bounds() {
    let model = scene("finite_horizon", &[]);
    let (end, cart) = (parameter(&model, "T"), Cart::of(&model));
    let swept = Swept::new(model, 200);
    let mut random = Random::new(5);
    let states: Vec<Vec<f64>> = (0..60)
        .map(|_| random.point(&[[-1.5, 1.5], [-1.5, 1.5]]))
        .collect();
    let near: Vec<Vec<f64>> = states
        .iter()
        .map(|s| vec![s[0] + 0.2, s[1] - 0.2])
        .collect();
    let guides = guides_of(&swept, &solutions(&swept, &near));
    assert!(Linear::new(&swept.plan).is_none());
    let terminal = Terminal::new(&swept.plan).expect("a finite horizon");
    let along: Vec<AlongTime> = (guides.iter().zip(&states))
        .map(|(guide, s)| AlongTime::new(&swept.plan, guide, s))
        .collect();
    let mut flights = Vec::new();
    for (s, along) in states.iter().zip(&along) {
        for law in [&terminal as &dyn Law, along] {
            flights.push(Flight {
                start: s.clone(),
                law,
                ceiling: f64::INFINITY,
            });
        }
    }
    let (mut below, mut above) = (0.0f64, Worst::default());
    for (s, flown) in states.iter().zip(fly(&swept, &flights).chunks(2)) {
        let exact = cart.at(s, end).v;
        for flown in flown {
            assert_eq!(flown.end, FlightEnd::Home);
            below = below.max((exact - flown.cost) / exact);
            let path = flown.path.as_ref().expect("it came home");
            assert_eq!(
                path.horizon(),
                end,
                "the guess is as long as the horizon, to the last bit"
            );
            assert_eq!(path.start(), s.as_slice());
        }
        above.see(flown[1].cost / exact);
    }
    assert!(below <= COST_ERROR, "{below:.2e} below V");
    println!(
        "along, by time: cost at most V (1 + {:.1e})",
        above.worst - 1.0
    );
    // The sheet is a plane at each time: what is followed is the optimal law, but for its
    // interpolation between nodes.
    above.at_most(1.0 + 1e-3, "along, by time: cost over V");
}

/// A pendulum with a weak motor.
const CLAMPED: &str = r#"
[states]
theta = { period = "2*pi" }
omega = {}
[controls]
u = { min = -3.0, max = 3.0 }
[dynamics]
theta = "omega"
omega = "-9.81*sin(theta) + u"
[cost]
running = "0.5*(theta_cost + omega^2 + 0.2*u^2)"
[definitions]
theta_cost = "10*(1 - cos(theta))"
[equilibrium]
theta = 0.0
omega = 0.0
u = 0.0
[region]
theta = ["-pi", "pi"]
omega = [-6.0, 6.0]
[shoot_out]
value_max = 40.0
spacing = 0.1
samples = 60
"#;

#[test]
fn clamped_controls_are_flown_through_their_kinks() {
    let swept = Swept::new(parse(CLAMPED), 1000);
    let states: Vec<Vec<f64>> = vec![
        vec![2.0, 0.0],
        vec![1.0, 3.0],
        vec![-1.5, -2.0],
        vec![0.2, 4.0],
    ];
    let near: Vec<Vec<f64>> = states
        .iter()
        .map(|s| vec![s[0] + 0.05, s[1] - 0.05])
        .collect();
    let (solved, followed) = (solutions(&swept, &states), solutions(&swept, &near));
    let guides = guides_of(&swept, &followed);
    let linear = Linear::new(&swept.plan).expect("an infinite horizon");
    let system = &swept.plan.system;
    let mut saturated = 0;
    for (k, s) in states.iter().enumerate() {
        let along = AlongState::new(&swept.plan, &guides[k], s);
        let flights = [&linear as &dyn Law, &along].map(|law| Flight {
            start: s.clone(),
            law,
            ceiling: f64::INFINITY,
        });
        let flown = fly(&swept, &flights);
        let value = solved[k].1;
        for flown in &flown {
            assert_eq!(flown.end, FlightEnd::Home);
            assert!(
                flown.cost >= value * (1.0 - COST_ERROR),
                "{} below {value}",
                flown.cost
            );
        }
        assert!(
            flown[1].cost <= 1.01 * value,
            "{} against {value}",
            flown[1].cost
        );
        let p = solved[k].0.adjoint();
        saturated += usize::from(system.eval(&system.observer.control, s, p)[0].abs() == 3.0);
    }
    assert!(saturated >= 2, "controls are at their bounds");
}

/// A pendulum whose cost repeats with the angle, as its dynamics do.
const SWINGING: &str = r#"
states = { theta = { period = "2*pi" }, omega = {} }
controls = { u = {} }
dynamics = { theta = "omega", omega = "-9.81*sin(theta) + u" }
cost = { running = "0.5*(10*(1 - cos(theta)) + omega^2 + u^2)" }
equilibrium = { theta = 0, omega = 0, u = 0 }
region = { theta = ["-pi", "pi"], omega = [-8, 8] }
shoot_out = { value_max = 20, spacing = 0.05, samples = 50 }
"#;

/// Where the cost is of the angle itself, another winding of the equilibrium costs: it is not home.
#[test]
fn another_winding_is_not_home_where_the_cost_tells_it_apart() {
    let swept = Swept::new(scene("pendulum_rest", &[]), 200);
    let linear = Linear::new(&swept.plan).expect("an infinite horizon");
    let turn = 2.0 * std::f64::consts::PI;
    let flown = fly_all(&swept, &linear, &[vec![0.3, 0.5], vec![0.3 + turn, 0.5]]);
    assert!(
        flown[1].cost > 10.0 * flown[0].cost,
        "{} {}",
        flown[0].cost,
        flown[1].cost
    );
}

#[test]
fn another_winding_of_the_equilibrium_is_home() {
    let swept = Swept::new(parse(SWINGING), 200);
    let linear = Linear::new(&swept.plan).expect("an infinite horizon");
    let turn = 2.0 * std::f64::consts::PI;
    let states = vec![
        vec![0.3, 0.5],
        vec![0.3 + turn, 0.5],
        vec![0.3 - 2.0 * turn, 0.5],
    ];
    let flown = fly_all(&swept, &linear, &states);
    for other in &flown[1..] {
        assert!((other.cost - flown[0].cost).abs() <= COST_ERROR * flown[0].cost);
        let path = other.path.as_ref().expect("it came home");
        assert!((path.start()[0] - 0.3).abs() <= 1e-14 && path.last()[0].abs() < 0.1);
    }
}

#[test]
fn a_flight_ends_at_its_ceiling_at_guards_and_where_the_law_ends() {
    struct Nothing;
    impl Law for Nothing {
        fn costate(&self, _: f64, _: &[f64]) -> Option<(Vec<f64>, Vec<f64>)> {
            None
        }
    }
    /// Costate 0: no control at all.
    struct Idle;
    impl Law for Idle {
        fn costate(&self, _: f64, s: &[f64]) -> Option<(Vec<f64>, Vec<f64>)> {
            Some((vec![0.0; s.len()], vec![0.0; s.len().pow(2)]))
        }
    }
    let text = CLAMPED.replace("[region]", "[guards]\nslow = \"omega > -4\"\n[region]");
    let swept = Swept::new(parse(&text), 200);
    let linear = Linear::new(&swept.plan).expect("an infinite horizon");
    let flight = |s: [f64; 2], law, ceiling| Flight {
        start: s.to_vec(),
        law,
        ceiling,
    };
    let flown = fly(
        &swept,
        &[
            flight([1.0, 0.0], &linear, 0.5),
            flight([1.0, 0.0], &Nothing, f64::INFINITY),
            flight([2.5, -3.9], &Idle, f64::INFINITY),
            flight([1.0, 0.0], &Idle, f64::INFINITY),
            flight([1.0, 0.0], &linear, f64::INFINITY),
            flight([0.0, -4.5], &linear, f64::INFINITY),
        ],
    );
    let ends: Vec<FlightEnd> = flown.iter().map(|f| f.end).collect();
    use FlightEnd::*;
    // Undamped, an idle pendulum swings for ever.
    assert_eq!(
        ends,
        [AboveCeiling, NoAnswer, LeftGuard, TimeUp, Home, LeftGuard]
    );
    for flown in flown.iter().filter(|f| f.end != Home) {
        assert!(flown.cost.is_infinite() && flown.path.is_none());
    }
}

#[test]
fn a_flight_does_not_depend_on_its_batch() {
    let swept = Swept::new(scene("manufactured", &[]), 64);
    let states = manufactured_states(67);
    let linear = Linear::new(&swept.plan).expect("an infinite horizon");
    let together = fly_all(&swept, &linear, &states);
    for k in [0, 1, 33, 66] {
        let alone = fly_all(&swept, &linear, &states[k..=k]);
        assert_eq!(alone[0].cost.to_bits(), together[k].cost.to_bits());
        assert_eq!(alone[0].path, together[k].path);
    }
}
