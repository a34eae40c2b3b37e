//! Claims that are too high are undercut, and what undercuts leads to the least V.

use super::{COST_ERROR, fly_all, shot, solutions};
use crate::common_oracles::{Random, Worst};
use crate::common_values::{self, Swept, parse, scene};
use costate::low_level::shooting::{Goal, Job, Path};
use costate::low_level::value::flight::{Claim, Expansion, Flew, Law, Linear, Pilot, undercut};

#[test]
fn a_wrong_claim_is_undercut_and_a_right_one_is_not() {
    let swept = Swept::new(scene("pendulum_rest", &[]), 1000);
    let mut random = Random::new(11);
    // Far enough out for the scene's own laws to be too dear, and not so far that neighbours lie on
    // different sheets.
    let states: Vec<Vec<f64>> = (0..40)
        .map(|_| random.point(&[[1.0, 2.0], [0.5, 2.0]]))
        .collect();
    let near: Vec<Vec<f64>> = states
        .iter()
        .map(|s| vec![s[0] - 0.1, s[1] + 0.1])
        .collect();
    let solved = solutions(&swept, &[states.clone(), near].concat());
    let count = states.len();
    let claims = |factor: f64| -> Vec<Claim<'_>> {
        (solved.iter().enumerate())
            .map(|(k, (path, value))| Claim {
                value: value * if k < count { factor } else { 1.0 },
                path,
                neighbours: vec![(k + count) % (2 * count)],
            })
            .collect()
    };
    let (mut pilot, mut solver) = (Pilot::new(&swept.plan).expect("compiles"), swept.solver());
    let mut say = |factor| {
        undercut(&swept.plan, &mut pilot, &mut solver, &claims(factor), 3)
            .expect("the backend works")
    };
    for said in say(1.0) {
        assert_eq!(said.flown, 3);
        assert!(
            said.path.is_none(),
            "the right V is undercut by {:?}",
            said.law
        );
    }
    let said = say(1.1);
    let (mut followed, mut above) = (0, Worst::default());
    for (k, said) in said[..count].iter().enumerate() {
        let value = solved[k].1;
        assert!(said.cost >= value * (1.0 - COST_ERROR));
        above.see(said.cost / value - 1.0);
        followed += usize::from(said.law == Some(Flew::AlongState(k + count)));
        let path = said.path.as_ref().expect("undercut");
        assert!((path.start()[0] - states[k][0]).abs() < 1e-14);
        let found = shot(&swept, path).expect("the path is a good guess");
        assert!(
            (found - value).abs() <= 1e-8 * value,
            "{found} instead of {value}"
        );
    }
    println!("the cheapest flight of {followed} of {count} follows the neighbour");
    assert!(followed > count / 2, "{followed} follow the neighbour");
    // A neighbour's p is off by the third derivatives of V over a fiftieth of the region; the cost
    // by the square of that.
    above.at_most(1e-3, "cost over V - 1");
}

/// A cart and pole, its pole upright at th = 0.
const CART_POLE: &str = r#"
[parameters]
M = 1.0
m = 0.2
l = 0.5
g = 9.81
[states]
x = {}
th = { period = "2*pi" }
v = {}
om = {}
[controls]
F = {}
[definitions]
D = "M + m*sin(th)^2"
[dynamics]
x = "v"
th = "om"
v = "(F + m*sin(th)*(l*om^2 - g*cos(th)))/D"
om = "(-F*cos(th) - m*l*om^2*sin(th)*cos(th) + (M+m)*g*sin(th))/(l*D)"
[cost]
running = "0.5*(x^2 + 20*(1-cos(th)) + 0.1*v^2 + 0.1*om^2 + 0.1*F^2)"
[equilibrium]
x = 0
th = 0
v = 0
om = 0
F = 0
[region]
x = [-2, 2]
th = ["-pi", "pi"]
v = [-3, 3]
om = [-8, 8]
"#;

#[test]
fn a_pole_near_upright_is_balanced_for_less_than_by_a_full_turn() {
    let swept = Swept::new(parse(CART_POLE), 64);
    let linear = Linear::new(&swept.plan).expect("an infinite horizon");
    let expansion = Expansion::new(&swept.plan).expect("an infinite horizon");
    // V by direct collocation, to its digits; a solution that turns the pole round costs 10.4002
    // and 10.53.
    for (th, v, turned, digits) in [(0.3, 0.878709, 10.4002, 1e-6), (0.5, 2.8066, 10.53, 1e-4)] {
        for law in [&linear as &dyn Law, &expansion] {
            let flown = &fly_all(&swept, law, &[vec![0.0, th, 0.0, 0.0]])[0];
            println!("th = {th}: {:?} at {:.6}, V = {v}", flown.end, flown.cost);
            assert!(flown.cost >= v - digits && flown.cost < turned);
            let found = shot(&swept, flown.path.as_ref().expect("it came home"));
            assert!((found.expect("the path is a good guess") - v).abs() < digits);
        }
    }
}

/// Solved states of a balanced pendulum on a grid: paths and V, with the grid's neighbours of each.
struct Balanced {
    swept: Swept,
    states: Vec<[f64; 2]>,
    paths: Vec<Path>,
    values: Vec<f64>,
    neighbours: Vec<Vec<usize>>,
}

fn balanced(value_max: f64) -> Balanced {
    let text = format!(
        r#"
states = {{ x = {{}}, v = {{}} }}
controls = {{ u = {{}} }}
dynamics = {{ x = "v", v = "7*sin(x) + u" }}
cost = {{ running = "0.5*(0.8*x^2 + 0.4*v^2 + 2.7*u^2)" }}
equilibrium = {{ x = 0, v = 0, u = 0 }}
region = {{ x = [-4, 4], v = [-4, 4] }}
shoot_out = {{ value_max = {value_max}, spacing = 0.05, samples = 60 }}
"#
    );
    let swept = Swept::new(parse(&text), 1156);
    let axis = common_values::spaced(-4.0, 4.0, 17);
    let answers = swept.grid(vec![axis.clone(), axis.clone()]);
    let (mut states, mut paths, mut values) = (Vec::new(), Vec::new(), Vec::new());
    for target in 0..answers.targets.len() {
        let Some(entry) = answers.answer(target) else {
            continue;
        };
        let s = answers.targets.state(target);
        states.push([s[0], s[1]]);
        paths.push(entry.path.clone());
        values.push(entry.value);
    }
    let steps = |a: &[f64; 2], b: &[f64; 2]| ((a[0] - b[0]).abs() + (a[1] - b[1]).abs()) / 0.5;
    let neighbours = (states.iter())
        .map(|a| {
            (0..states.len())
                .filter(|b| (steps(a, &states[*b]) - 1.0).abs() < 0.1)
                .collect()
        })
        .collect();
    Balanced {
        swept,
        states,
        paths,
        values,
        neighbours,
    }
}

/// Flies, shoots from what undercuts, and again, until nothing undercuts; how many were undercut in
/// each round.
fn until_nothing_undercuts(balanced: &mut Balanced) -> Vec<usize> {
    let plan = &balanced.swept.plan;
    let (mut pilot, mut solver) = (Pilot::new(plan).expect("compiles"), balanced.swept.solver());
    let mut rounds = Vec::new();
    for _ in 0..20 {
        let claims: Vec<Claim<'_>> = (balanced
            .paths
            .iter()
            .zip(&balanced.values)
            .zip(&balanced.neighbours))
        .map(|((path, value), neighbours)| Claim {
            value: *value,
            path,
            neighbours: neighbours.clone(),
        })
        .collect();
        let said = undercut(plan, &mut pilot, &mut solver, &claims, 4).expect("the backend works");
        let mut places = Vec::new();
        let mut jobs = Vec::new();
        for (k, said) in said.iter().enumerate() {
            if let Some(path) = &said.path {
                places.push((k, said.cost));
                jobs.push(Job::new(path.clone(), Goal::State(path.start().to_vec())));
            }
        }
        solver.solve(&mut jobs).expect("the backend works");
        rounds.push(places.len());
        let mut better = 0;
        for ((k, cost), job) in places.into_iter().zip(jobs) {
            let Some(found) = job.solved().map(|s| s.value) else {
                continue;
            };
            if found < cost * (1.0 + COST_ERROR) {
                (balanced.values[k], balanced.paths[k]) = (found, job.path);
                better += 1;
            }
        }
        println!(
            "{} undercut, {better} of them solved for less",
            rounds[rounds.len() - 1]
        );
        if better == 0 {
            break;
        }
    }
    rounds
}

/// V of this scene is symmetric: whatever was undercut, in the end it is.
fn the_least_is_found(value_max: f64) {
    let mut balanced = balanced(value_max);
    let before = balanced.values.clone();
    let rounds = until_nothing_undercuts(&mut balanced);
    let (states, values) = (&balanced.states, &balanced.values);
    let mut asymmetry = Worst::default();
    for (a, v) in states.iter().zip(values) {
        if let Some(k) =
            (states.iter()).position(|b| (a[0] + b[0]).abs() + (a[1] + b[1]).abs() < 1e-9)
        {
            asymmetry.see((v - values[k]).abs() / v.max(1.0));
        }
    }
    let worst = before
        .iter()
        .zip(values)
        .map(|(b, v)| b / v)
        .fold(0.0, f64::max);
    println!(
        "sweep to {value_max}: {} states; undercut {rounds:?}; worst {worst:.2} times V",
        values.len()
    );
    asymmetry.at_most(1e-6, "asymmetry");
    // By direct collocation, to these digits.
    for (s, v) in [([1.5, 1.0], 20.86786), ([-2.5, -2.5], 21.37833)] {
        let k = states.iter().position(|x| *x == s);
        let found = values[k.expect("on the grid")];
        println!("V{s:?} = {found:.5}, right {v}");
        assert!((found - v).abs() < 2e-5);
    }
}

#[test]
fn flights_lead_to_the_least_v_of_a_balanced_pendulum() {
    the_least_is_found(50.0);
}

#[test]
#[ignore = "takes a minute"]
fn flights_lead_to_the_least_v_after_a_sweep_too_far() {
    the_least_is_found(100.0);
}
