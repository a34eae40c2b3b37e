//! How long flights take, and how close to V those along neighbours come:
//! `cargo test --release --test flight -- --ignored --nocapture speed`.

use crate::common_oracles::Random;
use crate::common_values::{Swept, given, scene};
use costate::low_level::shooting::{Path, Solver};
use costate::low_level::value::Entry;
use costate::low_level::value::flight::{
    AlongState, AlongTime, Claim, Flight, Guide, Law, PIECES, Pilot, guides, undercut,
};
use std::time::Instant;

/// States a scene, and how far their neighbours are, in widths of the region.
const STATES: usize = 300;
const SPREAD: f64 = 0.02;
/// Claims flown from, and neighbours of each.
const CLAIMS: usize = 4000;
const NEIGHBOURS: usize = 4;

/// Solved states and, after all of them, their neighbours.
fn solved(swept: &Swept) -> Vec<Entry> {
    let plan = &swept.plan;
    let mut random = Random::new(1);
    let inner: Vec<[f64; 2]> = (plan.region.iter())
        .map(|[lo, hi]| [0.7 * lo + 0.3 * hi, 0.3 * lo + 0.7 * hi])
        .collect();
    let mut x: Vec<f64> = Vec::new();
    for _ in 0..STATES {
        let s = random.point(&inner);
        for shift in [0.0, SPREAD] {
            x.extend(
                (0..s.len()).map(|i| s[i] + plan.system.reference[i] + shift * plan.widths[i]),
            );
        }
    }
    let answers = swept.solve(&costate::low_level::value::Request {
        points: x,
        one_sheet: true,
        ..Default::default()
    });
    let both = |k: usize| {
        Some((
            given(&answers, 2 * k)?.clone(),
            given(&answers, 2 * k + 1)?.clone(),
        ))
    };
    let (states, near): (Vec<Entry>, Vec<Entry>) = (0..STATES).filter_map(both).unzip();
    [states, near].concat()
}

fn fly_from_all(name: &str, swept: &Swept, solver: &mut Solver, entries: &[Entry]) {
    let all = entries.len();
    let claims: Vec<Claim<'_>> = (0..CLAIMS)
        .map(|i| {
            let k = i % all;
            Claim {
                value: entries[k].value,
                path: &entries[k].path,
                neighbours: (0..NEIGHBOURS).map(|j| (k + all / 2 + j) % all).collect(),
            }
        })
        .collect();
    let mut pilot = Pilot::new(&swept.plan).expect("compiles");
    let clock = Instant::now();
    let said =
        undercut(&swept.plan, &mut pilot, solver, &claims, NEIGHBOURS).expect("the backend works");
    let seconds = clock.elapsed().as_secs_f64();
    let flown: usize = said.iter().map(|s| s.flown).sum();
    assert!(flown > CLAIMS * NEIGHBOURS, "all laws are flown");
    println!(
        "{name}: {CLAIMS} claims, {flown} flights in {seconds:.2} s ({:.0}/s), {} periods, {} steps; {} undercut",
        flown as f64 / seconds,
        pilot.periods,
        pilot.steps,
        said.iter().filter(|s| s.path.is_some()).count()
    );
}

/// Flies each state along its neighbour.
fn closeness(name: &str, swept: &Swept, entries: &[Entry], guides: &[Guide], by_state: bool) {
    let (plan, count) = (&swept.plan, entries.len() / 2);
    let laws: Vec<Box<dyn Law + '_>> = (0..count)
        .map(|i| -> Box<dyn Law + '_> {
            let (guide, start) = (&guides[i + count], entries[i].path.start());
            if by_state {
                Box::new(AlongState::new(plan, guide, start))
            } else {
                Box::new(AlongTime::new(plan, guide, start))
            }
        })
        .collect();
    let flights: Vec<Flight> = (laws.iter().zip(entries))
        .map(|(law, entry)| Flight {
            start: entry.path.start().to_vec(),
            law: law.as_ref(),
            ceiling: 2.0 * entry.value,
        })
        .collect();
    let flown = super::fly(swept, &flights);
    let mut above: Vec<f64> = flown
        .iter()
        .zip(entries)
        .map(|(f, e)| f.cost / e.value - 1.0)
        .collect();
    above.sort_by(f64::total_cmp);
    let at = |share: f64| above[((above.len() - 1) as f64 * share) as usize];
    println!(
        "{name}, by state {by_state}: {count} flights; cost over V - 1: least {:.1e}, median {:.1e}, 0.9 {:.1e}, most {:.1e}",
        at(0.0),
        at(0.5),
        at(0.9),
        at(1.0)
    );
    assert!(at(0.0) > -super::COST_ERROR && at(0.5) < 1e-3);
}

#[test]
#[ignore = "measures"]
fn speed() {
    for name in ["pendulum_rest", "moore_greitzer_map", "manufactured"] {
        let swept = Swept::new(scene(name, &[]), 2000);
        let entries = solved(&swept);
        assert!(entries.len() > 200, "{name}: {} solved", entries.len());
        let mut solver = swept.solver();
        fly_from_all(name, &swept, &mut solver, &entries);
        let paths: Vec<&Path> = entries.iter().map(|e| &e.path).collect();
        let guides = guides(&swept.plan, &mut solver, &paths, PIECES).expect("the backend works");
        for by_state in [true, false] {
            closeness(name, &swept, &entries, &guides, by_state);
        }
    }
}
