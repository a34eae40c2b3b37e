//! V of the mechanisms in `scenarios/`, against collocation by another program
//! (`tests/data/multibody_checks.json`).

use crate::common_values::{Swept, given, parse};
use costate::{Scene, Session};
use serde_json::Value;
use std::path::Path;

/// To which the values of the file were asked for; collocation on two meshes agrees to 2e-9.
const AGREES: f64 = 1e-7;

fn numbers(value: &Value) -> Vec<f64> {
    value
        .as_array()
        .unwrap()
        .iter()
        .map(|v| v.as_f64().unwrap())
        .collect()
}

/// Every extremal of the file is found, and nothing dearer than it is the answer.
fn check(file: &str, key: &str) -> Vec<f64> {
    let data: Value = serde_json::from_str(include_str!("../data/multibody_checks.json")).unwrap();
    let scene = Scene::load(Path::new(crate::ROOT).join("scenarios").join(file)).unwrap();
    let states = data["values"]["states"][key].as_array().unwrap();
    let x: Vec<f64> = states.iter().flat_map(|s| numbers(&s["x"])).collect();
    let solved = Session::new(&scene).solve(&x).unwrap();
    (states.iter().enumerate())
        .map(|(k, state)| {
            let wanted = state["V"].as_f64().unwrap();
            let near = |v: f64| (v - wanted).abs() <= AGREES * wanted;
            let all = solved.answers.of(solved.answers.targets.of_given[k]);
            let found = all.iter().find(|entry| near(entry.value));
            let values: Vec<f64> = all.iter().map(|entry| entry.value).collect();
            let found =
                found.unwrap_or_else(|| panic!("{file}, state {k}: {wanted} is not in {values:?}"));
            let size = numbers(&state["p"])
                .iter()
                .fold(0.0f64, |a, p| a.max(p.abs()));
            for (p, wanted) in found.p.iter().zip(numbers(&state["p"])) {
                assert!(
                    (p - wanted).abs() <= 1e-6 * size,
                    "{file}, state {k}: p {p} for {wanted}"
                );
            }
            let answer = solved.answer(k).expect("solved").value;
            assert!(
                answer <= wanted * (1.0 + AGREES),
                "{file}, state {k}: {answer}"
            );
            answer
        })
        .collect()
}

#[test]
fn a_double_pendulum_is_raised_on_either_side() {
    let least = check(
        "double_pendulum.toml",
        "double_pendulum_upright_two_torques",
    );
    // The file's second extremal is not the least: the other way up costs less.
    assert!(
        (least[1] - 37.212088764).abs() <= 1e-7 * least[1],
        "{least:?}"
    );
}

#[test]
fn a_pole_on_a_cart() {
    check("cart_pole_mechanism.toml", "cart_pole_upright");
}

#[test]
fn an_acrobot() {
    check("acrobot.toml", "acrobot_upright");
}

/// Three links upright.
const CHAIN: &str = r#"
    title = "Chain of three links"

    [mechanism]
    gravity = [0, -9.81]

    [mechanism.bodies]
    link = { chain = 3, joint = "revolute", at = [[0, 0], [0.5, 0], [0.5, 0]], mass = 1, com = [0.25, 0], inertia = "1/48" }

    [mechanism.forces]
    link1 = "u1"
    link2 = "u2"
    link3 = "u3"

    [controls]
    u1 = {}
    u2 = {}
    u3 = {}

    [cost]
    running = "0.5*((link1 - pi/2)^2 + link2^2 + link3^2 + link1_rate^2 + link2_rate^2 + link3_rate^2 + u1^2 + u2^2 + u3^2)"

    [equilibrium]
    link1 = "pi/2"
    link2 = 0
    link3 = 0
    u1 = 0
    u2 = 0
    u3 = 0

    [region]
    link1 = ["pi/2 - 1", "pi/2 + 1"]
    link2 = [-1, 1]
    link3 = [-1, 1]
    link1_rate = [-5, 5]
    link2_rate = [-5, 5]
    link3_rate = [-5, 5]
"#;

/// What one state of a grid leads to is handed on to the others and to their mirror images.
#[test]
fn many_extremals_of_a_chain() {
    let up = std::f64::consts::FRAC_PI_2;
    // The least that IPOPT found from six guesses (casadi, 160 steps of growing length over 8 s:
    // costs are off by at most 2e-4 of them), of link1, link2.
    let reached = [((-0.9, -0.8), 48.7552), ((-0.9, 0.8), 37.8647)];
    let swept = Swept::new(parse(CHAIN), 200);
    let fixed = || vec![0.0];
    let answers = swept.grid(vec![
        vec![up - 0.9, up + 0.9],
        vec![-0.8, 0.8],
        fixed(),
        fixed(),
        fixed(),
        fixed(),
    ]);
    assert_eq!(answers.solved(), 4);
    let value = |link1: f64, link2: f64| {
        let at = usize::from(link1 > 0.0) * 2 + usize::from(link2 > 0.0);
        let entry = given(&answers, at).expect("solved");
        let x = answers.targets.state(answers.targets.of_given[at]);
        assert!((x[0] - up - link1).abs() < 1e-12 && x[1] == link2, "{x:?}");
        entry.value
    };
    for ((link1, link2), reached) in reached {
        let (v, image) = (value(link1, link2), value(-link1, -link2));
        assert!(
            v <= reached,
            "{v} at {link1}, {link2}, and {reached} is known"
        );
        assert!((v - image).abs() <= 1e-8 * v, "{v}, its image {image}");
    }
    // Its trajectory is right: nothing flown costs less.
    assert!(answers.support.iter().all(|s| s.bound.is_none()));
}
