//! Published optimal control problems (`scenarios/published`), solved by the program as a user runs
//! it: V at every state of a scene's table is the value of `values.csv` (or of the table's own
//! column `V_published`) within the tolerance there.

use std::path::{Path, PathBuf};
use std::process::Command;

/// A state with the V that it must have.
struct Wanted {
    state: Vec<String>,
    value: f64,
    /// Relative to V; of another's published values, which were computed to an absolute tolerance,
    /// to 1 where V is less.
    tolerance: f64,
    published: bool,
}

fn folder() -> PathBuf {
    Path::new(crate::ROOT).join("scenarios/published")
}

/// Header and rows of a table there.
fn table(name: &str) -> (Vec<String>, Vec<Vec<String>>) {
    let mut reader = csv::Reader::from_path(folder().join(name)).expect("the table is there");
    let cells = |record: &csv::StringRecord| record.iter().map(str::to_owned).collect::<Vec<_>>();
    let header = cells(reader.headers().expect("a header"));
    let rows = reader
        .records()
        .map(|r| cells(&r.expect("as many cells as names")));
    (header, rows.collect())
}

fn number(text: &str) -> f64 {
    text.parse()
        .unwrap_or_else(|_| panic!("`{text}` is no number"))
}

/// The states of a scene with their values.
fn wanted(scene: &str) -> (Vec<String>, Vec<Wanted>) {
    let (mut names, rows) = table(&format!("{scene}.csv"));
    let own = names.iter().position(|n| n == "V_published");
    let (_, values) = table("values.csv");
    let values: Vec<&Vec<String>> = values.iter().filter(|row| row[0] == scene).collect();
    let wanted = (rows.into_iter().enumerate())
        .map(|(k, mut state)| {
            let of_row = |row: &&&Vec<String>| row[1] == "*" || row[1] == k.to_string();
            let row = values
                .iter()
                .find(of_row)
                .expect("a row of values.csv for each state");
            let value = match own {
                Some(column) => number(&state.remove(column)),
                None => number(&row[2]),
            };
            Wanted {
                state,
                value,
                tolerance: number(&row[3]),
                published: own.is_some(),
            }
        })
        .collect();
    names.retain(|n| n != "V_published");
    (names, wanted)
}

/// `points` of `costate solve --json` at some states of a scene.
fn solve(scene: &str, names: &[String], states: &[&[String]]) -> Vec<serde_json::Value> {
    let out =
        std::env::temp_dir().join(format!("costate-published-{scene}-{}", std::process::id()));
    std::fs::create_dir_all(&out).unwrap();
    let lines = [names]
        .into_iter()
        .chain(states.iter().copied())
        .map(|row| row.join(",") + "\n");
    std::fs::write(out.join("points.csv"), lines.collect::<String>()).unwrap();
    let done = Command::new(env!("CARGO_BIN_EXE_costate"))
        .args(["solve", "--backend", "cpu", "--json"])
        .arg(folder().join(format!("{scene}.toml")))
        .arg("--points")
        .arg(out.join("points.csv"))
        .arg("--out")
        .arg(out.join("out.h5"))
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success(), "{scene}: {text}");
    let told: serde_json::Value = serde_json::from_slice(&done.stdout).unwrap();
    std::fs::remove_dir_all(&out).unwrap();
    told["points"]
        .as_array()
        .expect("an answer for each state")
        .clone()
}

/// Solves a scene at every `stride`-th of its states.
fn check(scene: &str, stride: usize) {
    let (names, wanted) = wanted(scene);
    let wanted: Vec<&Wanted> = wanted.iter().step_by(stride).collect();
    let states: Vec<&[String]> = wanted.iter().map(|w| w.state.as_slice()).collect();
    let found = solve(scene, &names, &states);
    assert_eq!(found.len(), wanted.len());
    let mut wrong = String::new();
    for (w, point) in wanted.iter().zip(&found) {
        for (x, text) in point["x"].as_array().unwrap().iter().zip(&w.state) {
            assert_eq!(
                x.as_f64(),
                Some(number(text)),
                "answers come in the order of the states"
            );
        }
        let size = w.value.abs().max(if w.published { 1.0 } else { 0.0 });
        let off = |v: f64| (v - w.value).abs() / size;
        match point["V"].as_f64() {
            Some(v) if point["status"] == "converged" && off(v) <= w.tolerance => {}
            Some(v) => {
                wrong += &format!(
                    "  {:?}: {v}, not {}: off by {:.1e} ({})\n",
                    w.state,
                    w.value,
                    off(v),
                    point["status"]
                )
            }
            None => wrong += &format!("  {:?}: {}\n", w.state, point["status"]),
        }
    }
    let count = wrong.lines().count();
    assert!(
        wrong.is_empty(),
        "{scene}: {count} of {} states are wrong:\n{wrong}",
        wanted.len()
    );
}

#[test]
fn van_der_pol_of_bocop() {
    check("vdp_bocop", 1);
}

#[test]
fn van_der_pol_of_propt() {
    check("vdp_propt", 1);
}

#[test]
fn rayleigh() {
    check("rayleigh", 1);
}

#[test]
fn nagurka_of_order_6() {
    check("nagurka6", 1);
}

#[test]
fn hager() {
    check("hager", 1);
}

#[test]
fn f8_stall_recovery() {
    check("f8", 1);
}

#[test]
fn cart_and_pole_of_ppr() {
    check("cart_pole_ppr", 1);
}

/// A horizon of many time constants.
#[test]
fn satellite_to_time_20() {
    check("satellite", 1);
}

/// Ten states: no surface of seeds is needed to solve at single states.
#[test]
fn burgers_in_10_states() {
    check("burgers10", 1);
}

/// All extremals that are known over the state: the least, a local minimum, and one that is no
/// minimum.
#[test]
fn the_stirred_tank_has_three_extremals() {
    check("stirred_tank", 1);
    let (names, wanted) = wanted("stirred_tank");
    let found = solve("stirred_tank", &names, &[wanted[0].state.as_slice()]);
    let values: Vec<f64> = found[0]["V_sheets"]
        .as_array()
        .unwrap()
        .iter()
        .filter_map(serde_json::Value::as_f64)
        .collect();
    for extremal in [
        0.133_095_730_543_08,
        0.244_433_538_197_4,
        0.249_579_589_320_88,
    ] {
        let near = values.iter().any(|v| (v / extremal - 1.0).abs() <= 1e-8);
        assert!(near, "no extremal of V = {extremal} among {values:?}");
    }
}
