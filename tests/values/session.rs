//! The front door of the library: what a session gives in memory is what its run writes.

use costate::backend::Deadline;
use costate::low_level::value::{Evidence, PointStatus};
use costate::run::Provenance;
use costate::session::summary::RunSummary;
use costate::session::{Finished, Progress, Wanted};
use costate::{Scene, Session, SessionError, Stored};
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

const TEXT: &str = r#"
title = "Double integrator"
states = { x = { unit = "m" }, v = { unit = "m/s" } }
controls = { u = { unit = "m/s^2" } }
dynamics = { x = "v", v = "u" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-1, 1], v = [-1, 1] }
time = { unit = "s" }
cost = { running = "0.5*(x^2 + u^2)", unit = "J" }
shoot_out = { value_max = 1.0, spacing = 0.2, samples = 20 }
homotopy = { x = [-0.5, 0.5, 3], v = 0.2 }
map = { error = 1e-3 }
closed_loop = { final_time = 8, initial = { x = [-0.5, 0.5, 3], v = [-0.5, 0.5, 3] } }
"#;

/// A file in a folder that a test has to itself, and takes away in the end.
fn file(name: &str) -> PathBuf {
    let folder = std::env::temp_dir().join(format!("costate-session-{}", std::process::id()));
    folder.join(name)
}

/// `V = x'Px/2` with `P = [[sqrt(2), 1], [1, sqrt(2)]]`.
fn exact(x: f64, v: f64) -> f64 {
    0.5 * (2f64.sqrt() * (x * x + v * v) + 2.0 * x * v)
}

/// What a run told.
#[derive(Default)]
struct Heard(Mutex<Vec<&'static str>>);

impl Progress for Heard {
    fn finished(&self, part: Finished<'_>) {
        let part = match part {
            Finished::Solved(..) => "solved",
            Finished::ClosedLoop(_) => "closed loop",
            _ => "another",
        };
        self.0.lock().unwrap().push(part);
    }
}

#[test]
fn a_run_writes_what_the_scene_asks_for() {
    let scene = Scene::parse(TEXT, "double.toml").unwrap();
    let heard = Heard::default();
    let session = Session::new(&scene).with_progress(&heard);
    let path = file("whole/run.h5");
    let done = session
        .run(&Wanted::all(), &path, &Provenance::now())
        .unwrap();
    assert_eq!(*heard.0.lock().unwrap(), ["solved", "closed loop"]);

    // In memory: the states of [homotopy], the map, the loops.
    let answers = done.outcome.answers.as_ref().unwrap();
    assert_eq!(answers.targets.of_given.len(), 3);
    for &target in &answers.targets.of_given {
        let x = answers.targets.state(target);
        let value = answers.answer(target).unwrap().value;
        assert!((value - exact(x[0], x[1])).abs() < 1e-8, "{x:?}: {value}");
    }
    let loops = done.laws.closed_loop.as_ref().unwrap();
    for law in &loops.laws {
        assert_eq!(law.share_converged(), 1.0, "{}", law.name);
        let worst = loops.spread(law).unwrap().worst;
        assert!(
            (0.0..1e-3).contains(&(worst + 1e-6)),
            "{}: {worst:.2e}",
            law.name
        );
    }

    // In the file: the same summary, typed, and the same values.
    let stored = Stored::open(&path).unwrap();
    let summary: RunSummary = stored.run_summary().unwrap().unwrap();
    assert_eq!(summary, done.summary);
    assert_eq!(summary.homotopy.as_ref().unwrap().states, 3);
    assert!(summary.map.as_ref().unwrap().pieces > 0);
    let points = stored.points().unwrap().unwrap();
    for (x, value) in points.x.chunks(2).zip(&points.v) {
        assert!((value - exact(x[0], x[1])).abs() < 1e-8);
    }
    let unit = |group: &str, name: &str| {
        let group = stored.group(group).unwrap();
        group.attribute(Some(name), "units").unwrap_or_default()
    };
    assert_eq!(unit("trajectories", "t"), "s");
    assert_eq!(unit("trajectories", "V"), "J");
    assert_eq!(unit("trajectories", "H"), "J/s");
    assert_eq!(unit("closed_loop", "J"), "J");
    assert_eq!(unit("closed_loop_trajectories", "t"), "s");
    // The states have units of their own; the one control too.
    for (group, name) in [
        ("points", "x0"),
        ("closed_loop", "x0"),
        ("closed_loop_trajectories", "x"),
    ] {
        assert_eq!(unit(group, name), "see state_units", "{group}/{name}");
    }
    assert_eq!(unit("closed_loop_trajectories", "u"), "m/s^2");
    let map = stored.value_map().unwrap();
    let here = map.at(&[0.3, -0.4]).lowest.unwrap();
    assert!((here.v - exact(0.3, -0.4)).abs() <= here.v_error.max(1e-9));
    let _ = std::fs::remove_dir_all(path.parent().unwrap());
}

/// Asks to stop once so many states are solved.
struct StopAfter {
    states: usize,
    flag: &'static AtomicBool,
}

impl Progress for StopAfter {
    fn step(&self, what: &str) {
        let solved = what.split_once(" of ").and_then(|(n, _)| n.parse().ok());
        if solved.is_some_and(|n: usize| n >= self.states) {
            self.flag.store(true, Ordering::Relaxed);
        }
    }
}

#[test]
fn a_run_that_is_stopped_keeps_what_it_has() {
    static FLAG: AtomicBool = AtomicBool::new(false);
    let scene = Scene::load("scenarios/pendulum.toml").unwrap();
    let wanted = Wanted::homotopy();
    let whole = Session::new(&scene)
        .prepare(&wanted)
        .unwrap()
        .perform::<SessionError>(&mut |_| Ok(()))
        .unwrap();
    assert!(!whole.stopped);
    let whole = whole.answers.unwrap();

    let listener = StopAfter {
        states: 50,
        flag: &FLAG,
    };
    let path = file("stopped/run.h5");
    let stopped = Session::new(&scene)
        .until(Deadline::default().or_once(&FLAG))
        .with_progress(&listener)
        .run(&wanted, &path, &Provenance::now())
        .unwrap();
    assert!(stopped.outcome.stopped && stopped.summary.stopped);
    assert_eq!(stopped.path, path);
    let answers = stopped.outcome.answers.as_ref().unwrap();
    let (mut solved, mut open) = (0, 0);
    for target in 0..answers.targets.len() {
        // What was not done yet is neither an answer nor called least.
        assert_eq!(answers.evidence(target), Evidence::None);
        match answers.status(target) {
            PointStatus::Converged => {
                solved += 1;
                let value = answers.answer(target).unwrap().value;
                let same = whole
                    .of(target)
                    .iter()
                    .any(|e| (e.value - value).abs() < 1e-7 * value.abs().max(1.0));
                let least = whole.answer(target).map_or(f64::INFINITY, |e| e.value);
                assert!(same && value >= least - 1e-7 * value.abs(), "{value}");
            }
            PointStatus::OutOfTime => open += 1,
            status => assert_eq!(status, PointStatus::OutsideGuard),
        }
    }
    assert!(solved >= 50 && open > 0, "{solved} solved, {open} open");

    // In the file.
    let stored = Stored::open(&path).unwrap();
    assert!(stored.run_summary().unwrap().unwrap().stopped);
    let map = stored.map().unwrap().unwrap();
    let converged = map.status.iter().filter(|s| **s == 0).count();
    assert!(converged > 0 && converged < map.status.len(), "{converged}");

    // Sheets were not joined: nothing is interpolated between what was solved.
    let refused = stored.value_map().unwrap_err().to_string();
    assert!(refused.contains("its run was ended before"), "{refused}");

    // A second one is written beside what is there.
    let again = Session::new(&scene)
        .until(Deadline::default().or_once(&FLAG))
        .run(&wanted, &path, &Provenance::now())
        .unwrap();
    assert_eq!(again.path, file("stopped/run_stopped.h5"));
    assert!(again.path.exists());
    let answers = again.outcome.answers.unwrap();
    // Only the equilibrium needs no search.
    assert!(answers.solved() <= 1, "{}", answers.solved());
    let _ = std::fs::remove_dir_all(path.parent().unwrap());
}

/// Asks to stop when a map has its first cells.
struct StopAtCells(&'static AtomicBool);

impl Progress for StopAtCells {
    fn step(&self, what: &str) {
        if what.contains("cells") {
            self.0.store(true, Ordering::Relaxed);
        }
    }
}

/// A map that is ended early is what it was by then, with its bounds.
#[test]
fn a_map_that_is_stopped_is_kept() {
    static FLAG: AtomicBool = AtomicBool::new(false);
    let text = TEXT
        .replace("v = \"u\"", "v = \"sin(3*x) + u\"")
        .replace("map = { error = 1e-3 }", "map = { error = 1e-7 }");
    let scene = Scene::parse(&text, "swing.toml").unwrap();
    let listener = StopAtCells(&FLAG);
    let path = file("map/run.h5");
    let wanted = Wanted {
        map: true,
        ..Wanted::default()
    };
    let stopped = Session::new(&scene)
        .until(Deadline::default().or_once(&FLAG))
        .with_progress(&listener)
        .run(&wanted, &path, &Provenance::now())
        .unwrap();
    assert!(FLAG.load(Ordering::Relaxed) && stopped.summary.stopped);
    let made = stopped.outcome.mapped.as_ref().unwrap();
    assert!(made.spent && made.check.is_empty() && made.unmet.share > 0.0);

    let stored = Stored::open(&path).unwrap();
    let map = stored.value_map().unwrap();
    let states = [0.3, -0.4, -0.7, 0.2, 0.55, 0.6];
    let solved = Session::new(&scene).solve(&states).unwrap();
    let mut known = 0;
    for (k, x) in states.chunks(2).enumerate() {
        let v = solved.answer(k).unwrap().value;
        if let Ok(here) = map.at(x).lowest {
            known += 1;
            assert!((here.v - v).abs() <= here.v_error, "{x:?}: {} {v}", here.v);
        }
    }
    assert!(known > 0);
    let _ = std::fs::remove_dir_all(path.parent().unwrap());
}

/// Asks to stop when the pass is done.
struct StopBeforeLaws(&'static AtomicBool);

impl Progress for StopBeforeLaws {
    fn finished(&self, part: Finished<'_>) {
        if matches!(part, Finished::Solved(..)) {
            self.0.store(true, Ordering::Relaxed);
        }
    }
}

#[test]
fn laws_that_are_not_reached_are_left_out() {
    static FLAG: AtomicBool = AtomicBool::new(false);
    let scene = Scene::parse(TEXT, "double.toml").unwrap();
    let path = file("before_laws/run.h5");
    let done = Session::new(&scene)
        .until(Deadline::default().or_once(&FLAG))
        .with_progress(&StopBeforeLaws(&FLAG))
        .run(&Wanted::all(), &path, &Provenance::now())
        .unwrap();
    // The pass is whole, and in the file.
    assert!(!done.outcome.stopped && done.laws.stopped);
    assert!(done.laws.closed_loop.is_none());
    let stored = Stored::open(&path).unwrap();
    assert!(stored.group("closed_loop").is_none());
    let here = stored.value_map().unwrap().at(&[0.3, -0.4]).lowest.unwrap();
    assert!((here.v - exact(0.3, -0.4)).abs() <= here.v_error.max(1e-9));
    let _ = std::fs::remove_dir_all(path.parent().unwrap());
}

#[test]
fn states_that_are_no_numbers_are_refused() {
    let scene = Scene::parse(TEXT, "double.toml").unwrap();
    let session = Session::new(&scene);
    let refused = session.solve(&[0.1, 0.2, 0.3, f64::NAN]);
    assert!(matches!(
        refused,
        Err(SessionError::NotFinite {
            state: 1,
            component: 1
        })
    ));
    // At a deadline that has passed what is not solved is said to be out of time.
    let late = Session::new(&scene).until(Deadline::after(Duration::ZERO));
    let solved = late.solve(&[0.5, 0.25]).unwrap();
    assert!(solved.is_stopped());
    assert!(solved.answer(0).is_none());
    assert_eq!(solved.status(0), PointStatus::OutOfTime);
}

#[test]
fn a_stopped_sweep_has_gaps() {
    static FLAG: AtomicBool = AtomicBool::new(true);
    let scene = Scene::load("scenarios/pendulum.toml").unwrap();
    let swept = Session::new(&scene)
        .until(Deadline::default().or_once(&FLAG))
        .sweep()
        .unwrap();
    assert!(swept.report.stopped);
    assert!(swept.report.coverage.uncovered > 0);
    assert_eq!(swept.trajectories.count, swept.report.trajectories);
    let whole = Session::new(&scene).sweep().unwrap();
    assert!(!whole.report.stopped && whole.report.coverage.uncovered == 0);
    assert!(whole.report.trajectories > swept.report.trajectories);
}

#[test]
fn what_cannot_be_asked_is_refused_before_anything_is_written() {
    let text = TEXT.replace("homotopy = { x = [-0.5, 0.5, 3], v = 0.2 }\n", "");
    let scene = Scene::parse(&text.replace("map = { error = 1e-3 }\n", ""), "double.toml").unwrap();
    let session = Session::new(&scene);
    let path = file("refused/run.h5");
    let refused = session.run(&Wanted::homotopy(), &path, &Provenance::now());
    let error = refused.expect_err("no states to solve for");
    assert!(error.is_of_input(), "{error}");
    assert!(!path.exists());
    assert!(matches!(session.study(), Err(SessionError::NoStudy)));
    assert!(matches!(
        session.attenuation(),
        Err(SessionError::NoAttenuation)
    ));
    let wanted = Wanted {
        grid_guesses: true,
        ..Wanted::sweep()
    };
    assert!(matches!(
        session.prepare(&wanted),
        Err(SessionError::NoGridGuesses)
    ));
}

/// Recorded quantities are those of a whole trajectory, the part next to the equilibrium included:
/// `x'' = -x - sqrt(2) x'` falls from rest at x to `-exp(-pi) x`.
#[test]
fn a_study_records_up_to_the_equilibrium() {
    let study = r#"
[study]
vary = { start = [0.5, 0.05, 1e-4] }
from = { x = "start" }
[study.record]
undershoot = "min(x)"
overshoot = "max(x)"
braking = "min(u)"
end = "final(x)"
"#;
    let text = format!(
        "parameters = {{ start = 0.5 }}\n{}{study}",
        TEXT.trim_start()
    );
    let scene = Scene::parse(&text, "double.toml").unwrap();
    let rows = Session::new(&scene).study().unwrap();
    assert_eq!(rows.len(), 3);
    for row in rows {
        let start = row.parameters[0];
        let [undershoot, overshoot, braking, end] = row.records[..] else {
            panic!("four quantities are recorded");
        };
        // Between points an extremum is missed by the second order of their distance.
        let exact = -start * (-std::f64::consts::PI).exp();
        assert!(
            (undershoot / exact - 1.0).abs() < 1e-4,
            "{undershoot} {exact}"
        );
        assert_eq!(overshoot, start);
        assert!((braking / -start - 1.0).abs() < 1e-6, "{braking}");
        assert!(end.abs() < 2e-6 * start, "{end}");
    }
}
