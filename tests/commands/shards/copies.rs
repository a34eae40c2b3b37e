//! Sheets that are copies of each other by whole periods, over several blocks of states.

use super::done;
use crate::common_commands::{scenario, scratch};
use costate::low_level::result::Stored;
use std::fmt::Write;

/// States, and the same a period before and after them: of what starts at one of them as well as at
/// another the sheets have one number once periods are taken off.
#[test]
fn copies_have_one_number_across_blocks() {
    const COUNT: usize = 700;
    let folder = scratch("shards-copies");
    let mut text = "theta,omega\n".to_owned();
    for turns in [0.0, 1.0, -1.0] {
        for k in 0..COUNT {
            let at = |turn: f64, lo: f64, hi: f64| lo + (hi - lo) * (k as f64 * turn).fract();
            let theta = at(0.754_877_666, -4.0, 2.0) + turns * std::f64::consts::TAU;
            writeln!(text, "{theta:?},{:?}", at(0.569_840_29, -6.0, 6.0)).unwrap();
        }
    }
    std::fs::write(folder.join("states.csv"), text).unwrap();
    let scene = scenario("pendulum");
    let solve = ["solve", scene.to_str().unwrap(), "--points", "states.csv"];
    let how = ["--backend", "cpu", "--quiet", "--out", "all.h5"];
    done(&folder, &[&solve[..], &how].concat());

    let stored = Stored::open(folder.join("all.h5")).unwrap();
    let group = stored.group("points_sheets").unwrap();
    let value = group.f64("V").unwrap().values;
    let column = |name: &str| group.i32(name).unwrap().1;
    let (point, lifted, winding) = (column("point"), column("lifted_sheet"), column("winding"));
    let states = winding.len() / point.len();
    let mut of_state = vec![Vec::new(); COUNT];
    for (k, &point) in point.iter().enumerate() {
        let (state, copy) = (point as usize % COUNT, point as usize / COUNT);
        // Of each as if it had started in the middle one.
        let turns = winding[k * states] + [0, 1, -1][copy];
        of_state[state].push((turns, copy, value[k], lifted[k]));
    }
    let (mut pairs, mut differ) = (0, 0);
    for solutions in &of_state {
        for (k, a) in solutions.iter().enumerate() {
            for b in &solutions[..k] {
                let same = a.0 == b.0 && (a.2 - b.2).abs() < 1e-7 * a.2;
                if same && a.1 != b.1 {
                    pairs += 1;
                    differ += usize::from(a.3 != b.3);
                }
            }
        }
    }
    assert!(pairs > COUNT, "{pairs} copies");
    assert_eq!(differ, 0, "of {pairs} copies");
}
