//! The front door of the library: what a session gives in memory is what its run writes.

use costate::run::Provenance;
use costate::session::summary::RunSummary;
use costate::session::{Finished, Progress, Wanted};
use costate::{Scene, Session, SessionError, Stored};
use std::path::PathBuf;
use std::sync::Mutex;

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
    let session = Session::new(&scene).heard_by(&heard);
    let path = file("run.h5");
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
    let map = stored.value_map().unwrap();
    let here = map.at(&[0.3, -0.4]).lowest.unwrap();
    assert!((here.v - exact(0.3, -0.4)).abs() <= here.v_error.max(1e-9));
    let _ = std::fs::remove_dir_all(path.parent().unwrap());
}

#[test]
fn what_cannot_be_asked_is_refused_before_anything_is_written() {
    let text = TEXT.replace("homotopy = { x = [-0.5, 0.5, 3], v = 0.2 }\n", "");
    let scene = Scene::parse(&text.replace("map = { error = 1e-3 }\n", ""), "double.toml").unwrap();
    let session = Session::new(&scene);
    let path = file("refused/run.h5");
    let refused = session.run(&Wanted::homotopy(), &path, &Provenance::now());
    let error = refused.err().expect("no states to solve for");
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
