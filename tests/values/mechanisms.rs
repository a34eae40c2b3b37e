//! V of the mechanisms in `scenarios/`, against collocation by another program
//! (`tests/data/multibody_checks.json`).

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
