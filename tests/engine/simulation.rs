//! Simulation forward in time: events located, jumps, orbits that come back, on both backends.

use costate::backend::Backend;
use costate::backend::cpu::Cpu;
use costate::low_level::hybrid::CycleError;
use costate::session::{ControlledBy, Simulated, SimulationOptions};
use costate::{Scene, Session};
use serde_json::Value;

fn scene(text: &str) -> Scene {
    Scene::parse(text, "scene.toml").unwrap_or_else(|e| panic!("{e}"))
}

/// Two states, a finite horizon, and what is added.
fn oscillator(dynamics: [&str; 2], rest: &str) -> Scene {
    scene(&format!(
        r#"
        states = {{ x = {{}}, v = {{}}, n = {{}} }}
        controls = {{ u = {{}} }}
        dynamics = {{ x = "{}", v = "{}", n = "0" }}
        cost = {{ running = "0.5*u^2", terminal = "x^2", final_time = 1 }}
        region = {{ x = [-2, 2], v = [-2, 2], n = [-2, 2] }}
        integrator = {{ rtol = 1e-12 }}
        {rest}
        "#,
        dynamics[0], dynamics[1]
    ))
}

fn simulated(scene: &Scene, from: &[f64], time: f64) -> Simulated {
    let options = SimulationOptions {
        time: Some(time),
        ..SimulationOptions::default()
    };
    Session::new(scene).simulate(Some(from), &options).unwrap()
}

fn compass_gait(slope: f64) -> Scene {
    let path = format!("{}/scenarios/compass_gait.toml", crate::ROOT);
    let set = [("slope".to_owned(), format!("{slope:?}"))];
    Scene::load_with(&path, &set).unwrap_or_else(|e| panic!("{e}"))
}

fn gaits() -> Vec<Value> {
    let all: Value = serde_json::from_str(include_str!("../data/compass_gait.json")).unwrap();
    all["cycles"]
        .as_object()
        .unwrap()
        .values()
        .cloned()
        .collect()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap()
}

#[test]
fn a_compass_gait_comes_back_to_itself() {
    for gait in gaits() {
        let scene = compass_gait(number(&gait["slope"]));
        let options = SimulationOptions::default();
        let session = Session::new(&scene);
        let cycle = session
            .cycles(None, 1, &options)
            .unwrap()
            .remove(0)
            .unwrap();
        assert!((cycle.period - number(&gait["period"])).abs() < 1e-10);
        // The file's angles are from the vertical, these from the slope's x axis, downward.
        let [stance, swing, stance_rate, swing_rate] = cycle.start[..] else {
            panic!("four states");
        };
        assert!((0.5 * (stance - swing) - number(&gait["half_interleg_angle"])).abs() < 1e-10);
        let right_angle = std::f64::consts::FRAC_PI_2;
        assert!((0.5 * (stance + swing) + right_angle).abs() < 1e-10);
        assert!((stance_rate - number(&gait["stance_rate_after_impact"])).abs() < 1e-9);
        assert!((swing_rate - number(&gait["swing_rate_after_impact"])).abs() < 1e-9);
        let mut sizes: Vec<f64> = cycle.multipliers.iter().map(|[a, b]| a.hypot(*b)).collect();
        assert!(
            sizes.pop().unwrap() < 1e-9,
            "states after a strike lie on a surface"
        );
        let published = gait["return_map_eigenvalue_moduli"].as_array().unwrap();
        for (size, other) in sizes.iter().zip(published.iter().rev()) {
            assert!((size - number(other)).abs() < 1e-9, "{size} {other}");
        }
        assert!(cycle.is_stable());

        // The state before the strike, and where flights go that begin beside it.
        let options = SimulationOptions {
            cycle: Some(0),
            ..options
        };
        let flown = session.simulate(Some(&cycle.start), &options).unwrap();
        let before = &flown.flights.jumps[0].before;
        let other = gait["state_before_impact"].as_array().unwrap();
        let slope = number(&gait["slope"]);
        for (k, (x, other)) in before.iter().zip(other).enumerate() {
            let turned = if k < 2 { slope - right_angle } else { 0.0 };
            assert!((x - turned - number(other)).abs() < 1e-9, "{x} {other}");
        }
        let beside: Vec<f64> = cycle.start.iter().map(|x| x * 1.002).collect();
        let many = SimulationOptions {
            events: Some(40),
            ..options
        };
        let flown = session.simulate(Some(&beside), &many).unwrap();
        for (x, end) in cycle.start.iter().zip(&flown.flights.last) {
            assert!((x - end).abs() < 1e-8, "{x} {end}");
        }
    }
}

#[test]
fn a_gait_on_a_device() {
    let scene = compass_gait(3f64.to_radians());
    let options = SimulationOptions {
        events: Some(5),
        ..SimulationOptions::default()
    };
    let gpu = crate::common::any_gpu();
    assert_eq!(gpu.name(), "gpu");
    let there = Session::on(&scene, Box::new(gpu))
        .simulate(None, &options)
        .unwrap();
    let here = Session::new(&scene).simulate(None, &options).unwrap();
    assert_eq!(there.flights.jumps.len(), 5);
    for (a, b) in there.flights.jumps.iter().zip(&here.flights.jumps) {
        assert!((a.t - b.t).abs() < 1e-9, "{} {}", a.t, b.t);
        for (x, y) in a.after.iter().zip(&b.after) {
            assert!((x - y).abs() < 1e-8, "{x} {y}");
        }
    }
    assert_eq!(there.flights.end, here.flights.end);
    assert_eq!(there.flights.samples.len(), here.flights.samples.len());
}

#[test]
fn a_ball_bounces_until_it_rests() {
    let ball = oscillator(
        ["v", "-9.81"],
        r#"events.floor = { when = "x <= 0", set = { v = "-0.5*v", n = "n + 1" } }"#,
    );
    let done = simulated(&ball, &[1.0, 0.0, 0.0], 10.0);
    let fall = (2.0f64 / 9.81).sqrt();
    let (mut t, mut speed) = (fall, 9.81 * fall);
    for (k, jump) in done.flights.jumps.iter().take(15).enumerate() {
        assert!((jump.t - t).abs() < 1e-11, "bounce {k}: {} {t}", jump.t);
        assert!((jump.before[1] + speed).abs() < 1e-10 * speed.max(1.0));
        assert!(jump.before[0].abs() < 1e-12);
        assert_eq!(jump.after[2], (k + 1) as f64);
        speed *= 0.5;
        t += 2.0 * speed / 9.81;
    }
    assert_eq!(done.status(0), "zeno");
    // fall (1 + 2 e/(1 - e)) with e = 0.5.
    assert!(
        (done.flights.t[0] - 3.0 * fall).abs() < 1e-7,
        "{}",
        done.flights.t[0]
    );

    // Energy falls as the coefficient says; points of a phase follow its parabola.
    let first: Vec<_> = done
        .flights
        .samples
        .iter()
        .filter(|s| s.phase == 0)
        .collect();
    assert_eq!(first.len(), 51);
    for sample in first {
        let exact = 1.0 - 0.5 * 9.81 * sample.t * sample.t;
        assert!((sample.x[0] - exact).abs() < 1e-11);
    }
}

#[test]
fn where_an_event_does_not_count_it_is_passed_by() {
    // x = cos t falls through 0 at pi/2 (n = 0) and 5 pi/2; n counts how often x rises through 0.
    let rest = r#"
        [events.rising]
        when = "x >= 0"
        set = { n = "n + 1" }
        [events.falling]
        when = "x <= 0"
        where = "n > 0.5"
        ends = true
    "#;
    let done = simulated(&oscillator(["v", "-x"], rest), &[1.0, 0.0, 0.0], 20.0);
    let pi = std::f64::consts::PI;
    let times: Vec<f64> = done.flights.jumps.iter().map(|j| j.t).collect();
    assert_eq!(
        times.len(),
        1,
        "true from the beginning is not met: {times:?}"
    );
    assert!((times[0] - 1.5 * pi).abs() < 1e-11);
    assert_eq!(done.status(0), "event_falling");
    assert!((done.flights.t[0] - 2.5 * pi).abs() < 1e-11);
    assert_eq!(done.flights.events, [1]);
    // Both phases, from their beginnings to their ends.
    let last = done.flights.samples.last().unwrap();
    assert_eq!((last.phase, last.t), (1, done.flights.t[0]));
}

#[test]
fn guards_end_a_flight() {
    let rest = "guards = { slow = \"v < 0.5\" }";
    let scene = oscillator(["v", "-x"], rest);
    let from = [1.0, 0.0, 0.0, 0.0, 0.9, 0.0];
    let done = simulated(&scene, &from, 20.0);
    // v = -sin t rises to 0.5 at 7 pi/6; the second flight begins outside.
    assert_eq!([done.status(0), done.status(1)], ["guard_slow"; 2]);
    let pi = std::f64::consts::PI;
    assert!((done.flights.t[0] - 7.0 * pi / 6.0).abs() < 1e-11);
    assert_eq!(done.flights.t[1], 0.0);
    assert_eq!(done.by_status()["guard_slow"], 2);
}

#[test]
fn a_law_controls() {
    let text = r#"
        states = { x = {}, v = {} }
        controls = { u = { min = -1, max = 1 } }
        dynamics = { x = "v", v = "u" }
        cost = { running = "0.5*(x^2 + v^2 + u^2)" }
        equilibrium = { x = 0, v = 0, u = 0 }
        region = { x = [-3, 3], v = [-3, 3] }
        integrator = { rtol = 1e-11 }
        [closed_loop]
        final_time = 5
        initial = { x = 1 }
        law.damped = { u = "-2*v - x" }
        [events.wall]
        when = "x <= 0"
        set = { v = "-v" }
    "#;
    let scene = scene(text);
    let session = Session::new(&scene);
    let options = |law: &str| SimulationOptions {
        time: Some(4.0),
        law: Some(ControlledBy::Law(law.to_owned())),
        ..SimulationOptions::default()
    };
    // x = (1 + t) e^-t is critically damped, and never at the wall.
    let damped = session
        .simulate(Some(&[1.0, 0.0]), &options("damped"))
        .unwrap();
    assert_eq!(damped.status(0), "time");
    assert!((damped.flights.last[0] - 5.0 * (-4.0f64).exp()).abs() < 1e-9);
    for (sample, u) in damped.flights.samples.iter().zip(&damped.u) {
        assert!((u - (-2.0 * sample.x[1] - sample.x[0])).abs() < 1e-12);
    }
    let unknown = session.simulate(None, &options("dampd")).unwrap_err();
    assert!(
        unknown.to_string().contains("known: damped, lqr"),
        "{unknown}"
    );
    let lqr = session
        .simulate(Some(&[1.0, 0.0]), &options("lqr"))
        .unwrap();
    assert_eq!(lqr.law.as_deref(), Some("lqr"));
    assert!(lqr.flights.last[0].abs() < 0.1);
    // Controls stay at the equilibrium's.
    let held = session
        .simulate(
            Some(&[1.0, -1.0]),
            &SimulationOptions {
                time: Some(2.5),
                ..SimulationOptions::default()
            },
        )
        .unwrap();
    assert_eq!(held.flights.jumps.len(), 1);
    assert!((held.flights.jumps[0].t - 1.0).abs() < 1e-12);
    assert!((held.flights.last[0] - 1.5).abs() < 1e-12);
    let endless = session.simulate(None, &SimulationOptions::default());
    assert!(endless.unwrap_err().to_string().contains("--time"));
}

#[test]
fn flights_are_alone() {
    let ball = oscillator(
        ["v", "-9.81"],
        r#"events.floor = { when = "x <= 0", set = { v = "-0.8*v" } }"#,
    );
    let starts: Vec<f64> = (0..40)
        .flat_map(|k| [0.2 + 0.05 * f64::from(k), 0.3 * f64::from(k % 5), 0.0])
        .collect();
    let all = simulated(&ball, &starts, 1.5);
    for (k, from) in starts.chunks(3).enumerate() {
        let one = simulated(&ball, from, 1.5);
        assert_eq!(
            one.flights.last,
            all.flights.last[3 * k..][..3],
            "flight {k}"
        );
        let own: Vec<f64> = (all.flights.jumps.iter())
            .filter(|j| j.flight == k)
            .map(|j| j.t)
            .collect();
        let alone: Vec<f64> = one.flights.jumps.iter().map(|j| j.t).collect();
        assert_eq!(own, alone);
    }
}

#[test]
fn every_method_locates() {
    let ball = oscillator(
        ["v", "-9.81 + x^3"],
        r#"events.floor = { when = "x <= 0", set = { v = "-v" } }"#,
    );
    let reference = simulated(&ball, &[0.8, 0.1, 0.0], 2.0);
    assert!(reference.flights.jumps.len() > 1);
    for method in ["tsit5", "dop853", "taylor"] {
        let options = SimulationOptions {
            time: Some(2.0),
            ..SimulationOptions::default()
        };
        let choices = costate::Choices {
            method: costate::Method::ALL
                .iter()
                .find(|(n, _)| *n == method)
                .map(|(_, m)| *m),
            rtol: Some(1e-10),
            ..costate::Choices::default()
        };
        let session = Session::on(&ball, Box::new(Cpu::new())).choosing(choices);
        let done = session.simulate(Some(&[0.8, 0.1, 0.0]), &options).unwrap();
        for (a, b) in done.flights.jumps.iter().zip(&reference.flights.jumps) {
            assert!((a.t - b.t).abs() < 1e-8, "{method}: {} {}", a.t, b.t);
        }
        assert_eq!(done.flights.jumps.len(), reference.flights.jumps.len());
    }
}

/// Conditions that are true only within a step of the integration.
#[test]
fn a_short_condition_is_not_missed() {
    let pi = std::f64::consts::PI;
    let counted = |dynamics: [&str; 2], when: &str, from: [f64; 3], time: f64| -> Vec<f64> {
        let rest = format!("[events.e]\nwhen = \"{when}\"\nset = {{ n = \"n + 1\" }}");
        let done = simulated(&oscillator(dynamics, &rest), &from, time);
        assert_eq!(
            done.status(0),
            "time",
            "{when}: {:?}",
            done.flights.jumps.last()
        );
        done.flights.jumps.iter().map(|j| j.t).collect()
    };
    let swing = ["v", "-x"];
    for depth in [0.5, 0.05, 0.01, 1e-3, 1e-4] {
        // cos t <= depth - 1 from acos(depth - 1) on, in each turn.
        let when = format!("x <= {depth} - 1");
        let found = counted(swing, &when, [1.0, 0.0, 0.0], 20.0);
        let first = (depth - 1.0f64).acos();
        assert_eq!(found.len(), 3, "{depth}: {found:?}");
        for (k, t) in found.iter().enumerate() {
            let exact = first + 2.0 * pi * k as f64;
            assert!((t - exact).abs() < 1e-9, "{depth}: {t} {exact}");
        }
    }
    assert_eq!(
        counted(swing, "x*v >= 0.49", [1.0, 0.0, 0.0], 62.8).len(),
        20
    );
    assert_eq!(
        counted(swing, "cos(20*x) <= -0.9", [1.0, 0.0, 0.0], 62.8).len(),
        120
    );
    let clock = ["1", "0"];
    for (when, count) in [
        ("sin(x) >= 0", 16),
        ("sin(x) >= 0.999", 16),
        ("sin(5*x) >= 0.5", 80),
        ("sin(50*x) >= 0.5", 796),
        ("abs(x - 12.345) <= 1e-5", 1),
    ] {
        let found = counted(clock, when, [-0.01, 0.0, 0.0], 100.0);
        assert_eq!(found.len(), count, "{when}");
    }
    // A condition that is only touched, or nearly, is not met.
    assert!(counted(swing, "x <= -1.0001", [1.0, 0.0, 0.0], 20.0).is_empty());
}

/// After an event its condition may stay true: it is met once.
#[test]
fn an_event_is_met_once() {
    // Brought to rest on the floor, which holds nothing.
    let floor = "[events.floor]\nwhen = \"x <= 0\"\nset = { v = 0, n = \"n + 1\" }";
    for height in [0.1, 0.37, 1.0, 1.7] {
        let done = simulated(&oscillator(["v", "-9.81"], floor), &[height, 0.0, 0.0], 2.0);
        assert_eq!(done.flights.jumps.len(), 1, "{height}");
        assert_eq!(done.status(0), "time");
    }
    // Two at once: each once.
    let both = "[events.a]\nwhen = \"x >= 1\"\nset = { n = \"n + 1\" }\n[events.b]\nwhen = \"v >= 2\"\nset = { n = \"n + 10\" }";
    let done = simulated(&oscillator(["1", "2"], both), &[0.0, 0.0, 0.0], 3.0);
    assert_eq!(done.flights.last[2], 11.0, "{:?}", done.flights.jumps);
    assert_eq!(done.status(0), "time");
    // True from the beginning, and on the surface from the beginning.
    let rising = "[events.up]\nwhen = \"x >= 0\"\nset = { n = \"n + 1\" }";
    let done = simulated(&oscillator(["v", "-x"], rising), &[0.0, 1.0, 0.0], 7.0);
    let times: Vec<f64> = done.flights.jumps.iter().map(|j| j.t).collect();
    assert_eq!(times.len(), 1, "{times:?}");
    assert!((times[0] - 2.0 * std::f64::consts::PI).abs() < 1e-9);
    // A condition without a value.
    let root = "[events.far]\nwhen = \"sqrt(x - 5) >= 1\"\nends = true";
    let done = simulated(&oscillator(["1", "0"], root), &[0.0, 0.0, 0.0], 20.0);
    assert_eq!(done.status(0), "no_condition");
    // Regular bounces for a long time are no accumulation.
    let elastic = "[events.floor]\nwhen = \"x <= 0\"\nset = { v = \"-v\" }";
    let options = SimulationOptions {
        time: Some(1e9),
        events: Some(100),
        samples: Some(0),
        ..SimulationOptions::default()
    };
    let ball = oscillator(["v", "-9.81"], elastic);
    let done = Session::new(&ball)
        .simulate(Some(&[1.0, 0.0, 0.0]), &options)
        .unwrap();
    assert_eq!(done.status(0), "events");
    let exact = 199.0 * (2.0f64 / 9.81).sqrt();
    assert!(
        (done.flights.t[0] - exact).abs() < 1e-7,
        "{} {exact}",
        done.flights.t[0]
    );
}

/// A Poincare section: the van der Pol oscillator's limit cycle.
#[test]
fn an_orbit_through_a_section() {
    let section = "[events.section]\nwhen = \"x >= 0\"\nset = { n = \"0\" }";
    let scene = oscillator(["v", "(1 - x^2)*v - x"], section);
    for guess in [[0.0, 2.0, 0.0], [0.5, 1.5, 0.0]] {
        let options = SimulationOptions {
            time: Some(30.0),
            ..SimulationOptions::default()
        };
        let found = Session::new(&scene)
            .cycles(Some(&guess), 1, &options)
            .unwrap();
        let cycle = found[0].as_ref().unwrap();
        assert!(
            (cycle.period - 6.6632868593).abs() < 1e-8,
            "{}",
            cycle.period
        );
        // exp of the integral of the divergence, 1 - x^2, along the orbit.
        assert!(
            (cycle.multipliers[0][0] - 8.6e-4).abs() < 5e-5,
            "{:?}",
            cycle.multipliers
        );
    }
}

/// A system at a relative tolerance, `(x, v, n)` from a state.
fn at_tolerance(scene: &Scene, rtol: f64, from: &[f64], time: f64) -> Simulated {
    let options = SimulationOptions {
        time: Some(time),
        ..SimulationOptions::default()
    };
    let choices = costate::Choices {
        rtol: Some(rtol),
        ..costate::Choices::default()
    };
    let session = Session::on(scene, Box::new(Cpu::new())).choosing(choices);
    session.simulate(Some(from), &options).unwrap()
}

/// Bounces that get lower and lower end in an accumulation, never below the floor.
#[test]
fn bounces_accumulate_at_any_tolerance() {
    for (restitution, floor) in [(0.3, 0.0), (0.7, 0.0), (0.7, -0.9), (0.9, 0.1)] {
        let events = format!(
            "[events.floor]\nwhen = \"x <= {floor}\"\nset = {{ v = \"-{restitution}*v\", n = \"n + 1\" }}"
        );
        let ball = oscillator(["v", "-9.81"], &events);
        let swing = oscillator(["v", "-9.81*cos(x)"], &events);
        let fall = (2.0 * (1.0 - floor) / 9.81f64).sqrt();
        let exact = fall * (1.0 + 2.0 * restitution / (1.0 - restitution));
        for rtol in [1e-4, 1e-6, 1e-9, 1e-12] {
            let case = format!("{restitution} from {floor}, rtol {rtol}");
            let done = at_tolerance(&ball, rtol, &[1.0, 0.0, 0.0], 30.0);
            assert_eq!(done.status(0), "zeno", "{case}");
            assert!((done.flights.last[0] - floor).abs() < rtol, "{case}");
            let t = done.flights.t[0];
            // Bounces are told from rest above these speeds, in f32 and in f64.
            let slowest = if rtol > 1e-5 { 6e-3 } else { 3e-7 };
            let rest = 2.0 * slowest / (9.81 * (1.0 - restitution));
            assert!((t - exact).abs() < rest + 3.0 * rtol, "{case}: {t} {exact}");
            let done = at_tolerance(&swing, rtol, &[1.0, 0.0, 0.0], 30.0);
            assert_eq!(done.status(0), "zeno", "{case}, a pendulum");
        }
    }
}

/// Two events on one surface, one for each direction: each crossing is one of them.
#[test]
fn both_ways_through_one_surface() {
    // Free above; below a spring, which gives back the speed.
    let events = r#"
        [events.down]
        when = "x <= 0"
        set = { n = 1 }
        [events.up]
        when = "x >= 0"
        where = "n > 0.5"
        set = { n = 0 }
    "#;
    let spring = oscillator(["v", "-9.81 - 1000*n*x"], events);
    for (height, speed) in [(1.0, 0.0), (1e-3, -1.0), (1e-3, -0.01)] {
        let options = SimulationOptions {
            time: Some(20.0),
            events: Some(12),
            ..SimulationOptions::default()
        };
        let done = Session::new(&spring)
            .simulate(Some(&[height, speed, 0.0]), &options)
            .unwrap();
        assert_eq!(done.status(0), "events", "{height} {speed}");
        let fastest = (speed * speed + 2.0 * 9.81 * height).sqrt();
        for (k, jump) in done.flights.jumps.iter().enumerate() {
            assert_eq!(jump.event, k % 2, "{height} {speed}: crossing {k}");
            let sign = if k % 2 == 0 { -1.0 } else { 1.0 };
            assert!((jump.before[1] - sign * fastest).abs() < 1e-8 * fastest.max(1.0));
        }
    }
}

/// An event that ends the flight does so whatever else happens at that moment.
#[test]
fn an_end_at_the_moment_of_another_event() {
    let turns = "[events.turns]\nwhen = \"x <= 0\"\nset = { v = \"-v\" }";
    let ends = "[events.last]\nwhen = \"x <= 0\"\nwhere = \"n > 0.5\"\nends = true";
    for (n, orders) in [(1.0, "event_last"), (0.0, "time")] {
        for rest in [format!("{turns}\n{ends}"), format!("{ends}\n{turns}")] {
            let ball = oscillator(["v", "-9.81"], &rest);
            let done = simulated(&ball, &[1.0, 0.0, n], 0.6);
            assert_eq!(done.status(0), orders, "{rest}");
        }
    }
    // Nobody knows whether an event counts.
    let unknown =
        "[events.e]\nwhen = \"x <= 0\"\nwhere = \"sqrt(n - 1) >= 0\"\nset = { v = \"-v\" }";
    let ball = oscillator(["v", "-9.81"], unknown);
    let done = simulated(&ball, &[1.0, 0.0, 0.0], 1.0);
    assert_eq!(done.status(0), "no_condition");
    assert_eq!(simulated(&ball, &[1.0, 0.0, 1.5], 0.6).status(0), "time");
}

/// A mechanism with the same cost for all.
fn mechanism(description: &str, region: &[&str]) -> Scene {
    let region: String = (region.iter())
        .map(|name| format!("{name} = [-9, 9]\n"))
        .collect();
    scene(&format!(
        "{description}\n[controls]\nu = {{}}\n[cost]\nrunning = \"u^2\"\nterminal = \"0\"\nfinal_time = 1\n[region]\n{region}"
    ))
}

/// A closed chain stays closed where a point of it strikes, and a point may strike along one
/// direction, or where it cannot move along the others.
#[test]
fn a_collision_leaves_joints_closed() {
    let five_bars = mechanism(
        r#"
        [mechanism]
        gravity = [0, -9.81]
        [mechanism.bodies]
        a = { joint = "revolute", mass = 1, shape = { rod = 0.5 } }
        b = { joint = "revolute", parent = "a", at = [0.5, 0], mass = 0.7, shape = { rod = 0.6 } }
        d = { joint = "revolute", at = [0.8, 0], mass = 1.2, shape = { rod = 0.5 } }
        c = { joint = "revolute", parent = "d", at = [0.5, 0], mass = 0.9, shape = { rod = 0.6 } }
        [mechanism.points]
        knee = { body = "b", at = [0.6, 0] }
        other = { body = "c", at = [0.6, 0] }
        [mechanism.contacts]
        knee = { with = "other" }
        [events.strike]
        when = "knee.y <= -0.9"
        collision = [{ point = "knee", along = "y" }]
        "#,
        &["a", "b", "d", "c", "a_rate", "b_rate", "d_rate", "c_rate"],
    );
    // Both knees at (0.4, -0.7): the angles of two legs of 0.5 and 0.6.
    let (x, y) = (0.4f64, -0.7f64);
    let (r, way) = (x.hypot(y), y.atan2(x));
    let bend = ((0.25 + r * r - 0.36) / r).clamp(-1.0, 1.0).acos();
    let a = way - bend;
    let b = (y - 0.5 * a.sin()).atan2(x - 0.5 * a.cos()) - a;
    let pi = std::f64::consts::PI;
    let from = [a, b, pi - a, -b, 0.0, 0.0, 0.0, 0.0];
    let options = SimulationOptions {
        time: Some(2.0),
        events: Some(1),
        ..SimulationOptions::default()
    };
    let done = Session::new(&five_bars)
        .simulate(Some(&from), &options)
        .unwrap();
    assert_eq!(done.status(0), "events");
    let jump = &done.flights.jumps[0];
    let at = costate::session::MechanismAt::new(&five_bars).unwrap();
    let [before, after] = [&jump.before, &jump.after].map(|x| at.at(x, &[0.0], &[]));
    assert!(before.points[0].velocity[1] < -1.0);
    assert!(after.points[0].velocity[1].abs() < 1e-12);
    for k in 0..2 {
        let gap = after.points[0].velocity[k] - after.points[1].velocity[k];
        assert!(gap.abs() < 1e-10, "the chain opens at {gap}");
    }
    // What is lost is orthogonal to what is left, by the mass matrix.
    let change: Vec<f64> = (0..4)
        .map(|i| jump.after[4 + i] - jump.before[4 + i])
        .collect();
    let product: f64 = (0..4)
        .flat_map(|i| (0..4).map(move |j| (i, j)))
        .map(|(i, j)| change[i] * before.mass_matrix[i][j] * jump.after[4 + j])
        .sum();
    assert!(product.abs() < 1e-12, "{product}");
    assert!(change.iter().any(|v| v.abs() > 0.1));

    let hopper = mechanism(
        r#"
        [mechanism]
        gravity = [0, -9.81]
        [mechanism.bodies]
        foot = { joint = "prismatic", axis = "y", mass = 0.5 }
        leg = { joint = "prismatic", axis = "y", parent = "foot", mass = 5, spring = 800, rest = 0.6 }
        [mechanism.points]
        toe = { body = "foot" }
        [events.touchdown]
        when = "toe.y <= 0"
        collision = ["toe"]
        "#,
        &["foot", "leg", "foot_rate", "leg_rate"],
    );
    let done = simulated(&hopper, &[0.5, 0.6, 0.0, 0.0], 0.4);
    let [_, _, foot, leg] = done.flights.jumps[0].after[..] else {
        panic!("four states");
    };
    // The foot stops; the mass goes on.
    assert!(foot.abs() < 1e-12 && (leg + (2.0 * 9.81 * 0.5f64).sqrt()).abs() < 1e-9);
}

/// A contact that an event breaks ends the flight: its forces would keep what is broken.
#[test]
fn a_contact_that_an_event_breaks() {
    let rod = |event: &str| {
        mechanism(
            &format!(
                r#"
                [mechanism]
                gravity = [0, -9.81]
                [mechanism.bodies]
                rod = {{ joint = "planar", mass = 1, shape = {{ rod = 1 }} }}
                [mechanism.points]
                pin = {{ body = "rod" }}
                tip = {{ body = "rod", at = [1, 0] }}
                [mechanism.contacts]
                pin = {{}}
                [events.strike]
                when = "tip.y <= -0.5"
                {event}
                "#
            ),
            &[
                "rod_x",
                "rod_y",
                "rod",
                "rod_x_rate",
                "rod_y_rate",
                "rod_rate",
            ],
        )
    };
    let from = [0.0; 6];
    for (event, ends) in [
        ("set = { rod_rate = \"-0.5*rod_rate\" }", "time"),
        ("collision = [\"pin\"]", "time"),
        ("set = { rod_x_rate = 1 }", "contact_lost"),
        ("collision = [\"tip\"]", "contact_lost"),
        (
            "collision = [\"tip\"]\nset = { rod_rate = \"rod_rate\" }",
            "contact_lost",
        ),
    ] {
        let done = simulated(&rod(event), &from, 0.6);
        assert_eq!(done.status(0), ends, "{event}");
        assert!(!done.flights.jumps.is_empty(), "{event}");
    }
    // With dependent coordinates no state can say so: what the collision makes of them is compared.
    let gait = std::fs::read_to_string(format!("{}/scenarios/compass_gait.toml", crate::ROOT));
    let limping = gait.unwrap().replace(
        "relabel = { stance = \"swing\", swing = \"stance\" }",
        "relabel = { stance = \"stance\", swing = \"swing\" }",
    );
    let scene = Scene::parse(&limping, "limping.toml").unwrap();
    let done = Session::new(&scene)
        .simulate(None, &SimulationOptions::default())
        .unwrap();
    assert_eq!(done.status(0), "contact_lost");
    // New names without a collision: the mechanism's velocities would change.
    let slipping = limping.replace("collision = [\"heel\"]\n", "").replace(
        "relabel = { stance = \"stance\", swing = \"swing\" }",
        "relabel = { stance = \"swing\", swing = \"stance\" }",
    );
    let scene = Scene::parse(&slipping, "slipping.toml").unwrap();
    let done = Session::new(&scene)
        .simulate(None, &SimulationOptions::default())
        .unwrap();
    assert_eq!(done.status(0), "contact_lost");
}

/// Equations that have a value nowhere are refused; those that have one somewhere are not.
#[test]
fn equations_need_values() {
    let text = |rate: &str, running: &str| {
        format!(
            "states = {{ x = {{}} }}\ncontrols = {{ u = {{ min = 1, max = 2 }} }}\ndynamics = {{ x = \"{rate} + u\" }}\n\
             cost = {{ running = \"{running} + u^2\", terminal = \"0\", final_time = 1 }}\nregion = {{ x = [-1, 1] }}\n"
        )
    };
    for (rate, running, words) in [
        (
            "log(-1 - x^2)",
            "0",
            "dx/dt is a finite number nowhere in the region",
        ),
        ("x", "asin(2 + x^2)", "the running cost is a finite"),
    ] {
        let error = Scene::parse(&text(rate, running), "scene.toml").unwrap_err();
        assert!(
            error.to_string().contains(words) || error.render(false).contains(words),
            "{error}"
        );
    }
    assert!(Scene::parse(&text("log(x)", "1/x"), "scene.toml").is_ok());
}

/// What is asked by `where` is asked at the event, and rounding does not decide what is so there.
#[test]
fn events_on_one_surface_are_told_apart() {
    // Bounces while it is fast; where it is slow it rests.
    let rests = "[events.bounce]\nwhen = \"x <= 0\"\nwhere = \"v < -0.01\"\nset = { v = \"-0.5*v\" }\n\
                 [events.rest]\nwhen = \"x <= 0\"\nwhere = \"v >= -0.01\"\nset = { v = 0, n = 1 }";
    let ball = oscillator(["v", "-9.81*(1 - n)"], rests);
    for rtol in [1e-4, 1e-6, 1e-12] {
        let done = at_tolerance(&ball, rtol, &[1.0, 0.0, 0.0], 3.0);
        assert_eq!(done.status(0), "time");
        let last = done.flights.jumps.last().unwrap();
        // 4.43 m/s halved nine times.
        assert_eq!(
            (last.event, done.flights.jumps.len()),
            (1, 10),
            "rtol {rtol}"
        );
        assert_eq!(done.flights.last[2], 1.0);
    }
    // Two thresholds next to each other: each in turn, without an end.
    for apart in [1e-4, 1e-11, 1e-13] {
        let relay = format!(
            "[events.high]\nwhen = \"x >= {apart}\"\nset = {{ n = -1 }}\n[events.low]\nwhen = \"x <= -{apart}\"\nset = {{ n = 1 }}"
        );
        let relay = oscillator(["n + 0.3", "0"], &relay);
        for from in [-0.5, -0.37, -1e-3] {
            let done = simulated(&relay, &[from, 0.0, 1.0], 3.0);
            assert!(
                done.flights.last[0].abs() <= 1.001 * apart + 1e-12,
                "{apart} from {from}"
            );
            let jumps = &done.flights.jumps;
            assert!(jumps.len() > 15 && jumps.iter().enumerate().all(|(k, j)| j.event == k % 2));
        }
    }
    // A second condition that is true all the time, and a guard that holds on the floor.
    let elastic = "[events.floor]\nwhen = \"x <= 0\"\nset = { v = \"-0.9*v\" }\n\
                   [events.above]\nwhen = \"x >= 0\"\nset = { n = \"n + 1\" }\n[guards]\ninside = \"x >= 0\"";
    let ball = oscillator(["v", "-9.81"], elastic);
    for height in [1.0, 0.37, 0.77] {
        let done = simulated(&ball, &[height, 0.0, 0.0], 3.0);
        assert_eq!(done.status(0), "time", "{height}");
        assert!(done.flights.jumps.len() > 2);
        assert_eq!(done.flights.last[2], 0.0, "{height}");
    }
}

/// A floor far from 0, where a height has few digits, and a flight that begins just above one.
#[test]
fn floors_that_are_high_or_near() {
    let floor = |at: f64, restitution: &str| {
        oscillator(
            ["v", "-9.81"],
            &format!("[events.floor]\nwhen = \"x <= {at}\"\nset = {{ v = \"{restitution}\" }}"),
        )
    };
    for at in [100.0, 3000.0, -1e4] {
        for rtol in [1e-6, 1e-12] {
            let done = at_tolerance(&floor(at, "-0.7*v"), rtol, &[at + 1.0, 0.0, 0.0], 10.0);
            assert_eq!(done.status(0), "zeno", "{at}, rtol {rtol}");
            let exact = (2.0f64 / 9.81).sqrt() * (1.0 + 1.4 / 0.3);
            assert!(
                (done.flights.t[0] - exact).abs() < 1e-4,
                "{at}: {}",
                done.flights.t[0]
            );
        }
        // Driven: 5 = 0.8*5 + 1, whatever the height is.
        let options = SimulationOptions {
            time: Some(20.0),
            ..SimulationOptions::default()
        };
        let driven = floor(at, "-0.8*v + 1");
        let cycle = Session::new(&driven)
            .cycles(Some(&[at, 4.0, 0.0]), 1, &options)
            .unwrap()
            .remove(0)
            .unwrap();
        assert!(
            (cycle.period - 10.0 / 9.81).abs() < 1e-8,
            "{at}: {}",
            cycle.period
        );
    }
    for height in [1e-5, 1e-9, 1e-11] {
        for rtol in [1e-3, 1e-6] {
            let done = at_tolerance(&floor(0.0, "-0.9*v"), rtol, &[height, -1.0, 0.0], 0.3);
            assert_eq!(done.flights.jumps.len(), 2, "{height}, rtol {rtol}");
        }
    }
}

/// A second condition just beyond a floor, or a guard, is not met while the ball bounces above it.
#[test]
fn a_surface_just_below_a_floor() {
    let floor = "[events.floor]\nwhen = \"x <= 0\"\nset = { v = \"-0.5*v\" }";
    for below in [1e-12, 3e-12, 1e-11, 3e-11, 1e-10, 1e-9, 1e-7] {
        let counted =
            format!("[events.below]\nwhen = \"x <= -{below:e}\"\nset = {{ n = \"n + 1\" }}");
        let ends = format!("[events.below]\nwhen = \"x <= -{below:e}\"\nends = true");
        let guard = format!("[guards]\nbelow = \"x >= -{below:e}\"");
        for other in [counted, ends, guard] {
            for first in [true, false] {
                let events = match first {
                    true => format!("{floor}\n{other}"),
                    false => format!("{other}\n{floor}"),
                };
                for height in [1.0, 0.37] {
                    let ball = oscillator(["v", "-9.81"], &events);
                    let done = simulated(&ball, &[height, 0.0, 0.0], 3.0);
                    assert_eq!(done.status(0), "zeno", "{events}");
                    assert_eq!(done.flights.last[2], 0.0, "{events}");
                }
            }
        }
    }
}

/// An equilibrium comes back as well, but is no orbit.
#[test]
fn an_equilibrium_is_no_orbit() {
    let section = "[events.section]\nwhen = \"v >= 0\"\nset = { n = \"n\" }";
    let scene = oscillator(["v", "0.1*(1 - x^2)*v - x"], section);
    let options = SimulationOptions {
        time: Some(60.0),
        ..SimulationOptions::default()
    };
    let found = |x: f64| {
        let mut all = Session::new(&scene)
            .cycles(Some(&[x, 0.0, 0.5]), 1, &options)
            .unwrap();
        all.remove(0)
    };
    for x in [-2.9, -1.5, 1.8, 2.5] {
        let cycle = found(x).unwrap();
        // A. Deprit and A. Schmidt's series: 2 pi (1 + mu^2/16 - 5 mu^4/3072 ...).
        let period = 2.0 * std::f64::consts::PI * (1.0 + 0.01 / 16.0 - 5e-4 / 3072.0);
        assert!((cycle.period - period).abs() < 1e-7, "{}", cycle.period);
        assert!(cycle.residual < 1e-10);
    }
    for x in [0.3, -0.1, 1e-3] {
        match found(x) {
            Err(CycleError::AtRest { state }) => assert!(state[0].abs() < 1e-6, "{state:?}"),
            other => panic!("{other:?}"),
        }
    }
}

/// What an impact adds to the speed is a little more, or less, than what is lost until the next.
#[test]
fn an_orbit_comes_back() {
    for gain in [1.0 - 1e-3, 1.0 - 1e-6, 1.0, 1.0 + 1e-6, 1.0 + 1e-4] {
        let section =
            format!("[events.section]\nwhen = \"x >= 0\"\nset = {{ v = \"{gain:?}*v\" }}");
        let scene = oscillator(["v", "-x"], &section);
        let options = SimulationOptions {
            time: Some(30.0),
            ..SimulationOptions::default()
        };
        let found = Session::new(&scene)
            .cycles(Some(&[0.0, 1.0, 0.0]), 1, &options)
            .unwrap();
        match &found[0] {
            // Each of a family.
            Ok(cycle) => {
                assert_eq!(gain, 1.0);
                assert!(cycle.residual < 1e-11);
                assert!(!cycle.is_stable() && !cycle.is_unstable());
            }
            Err(error) => assert_ne!(gain, 1.0, "{error:?}"),
        }
    }
}

/// Events that are passed by do not begin the phase again, and none is met twice.
#[test]
fn many_are_passed_by() {
    let late = "[events.a]\nwhen = \"x >= 0\"\nwhere = \"n >= 500\"\nset = { v = \"v\" }";
    let text = |precision: &str, rtol: f64| {
        scene(&format!(
            r#"
            states = {{ x = {{}}, v = {{}}, n = {{}} }}
            controls = {{ u = {{}} }}
            dynamics = {{ x = "v", v = "-x", n = "1" }}
            cost = {{ running = "0.5*u^2", terminal = "x^2", final_time = 1 }}
            region = {{ x = [-2, 2], v = [-2, 2], n = [0, 600] }}
            integrator = {{ rtol = {rtol:?}, precision = "{precision}" }}
            {late}
            "#
        ))
    };
    for (precision, rtol, near) in [("f64", 1e-9, 1e-6), ("f32", 1e-5, 2e-2)] {
        let scene = text(precision, rtol);
        let options = SimulationOptions {
            time: Some(520.0),
            ..SimulationOptions::default()
        };
        let done = Session::new(&scene)
            .simulate(Some(&[-1.0, 0.0, 0.0]), &options)
            .unwrap();
        let pi = std::f64::consts::PI;
        let times: Vec<f64> = done.flights.jumps.iter().map(|j| j.t).collect();
        // x = -cos t rises through 0 at pi/2 + 2 k pi.
        let exact: Vec<f64> = (0..100)
            .map(|k| 0.5 * pi + 2.0 * pi * f64::from(k))
            .filter(|t| *t >= 500.0 && *t <= 520.0)
            .collect();
        assert_eq!(times.len(), exact.len(), "{times:?}");
        for (t, exact) in times.iter().zip(exact) {
            assert!((t - exact).abs() < near, "{t} {exact}");
        }
    }
}

/// A guard holds on its surface: where a flight begins there and leads in it goes on.
#[test]
fn a_flight_begins_on_a_guard() {
    let ball = oscillator(["v", "-9.81"], "[guards]\nabove = \"x >= 0\"");
    for at in [0.0, 1e-13] {
        let up = simulated(&ball, &[at, 1.0, 0.0], 2.0);
        assert_eq!(up.status(0), "guard_above");
        assert!((up.flights.t[0] - 2.0 / 9.81).abs() < 1e-10);
        for speed in [0.0, -1.0] {
            let down = simulated(&ball, &[at, speed, 0.0], 2.0);
            assert_eq!(down.status(0), "guard_above");
            assert!(down.flights.t[0] < 1e-6, "{}", down.flights.t[0]);
        }
    }
}

/// What is located to the tolerance alone would be met again behind the event.
#[test]
fn a_crossing_is_met_once_at_any_tolerance() {
    let count = "[events.a]\nwhen = \"x <= 0.19\"\nset = { n = \"n + 0.01\" }";
    for method in ["taylor", "dop853", "tsit5"] {
        for rtol in [1e-3, 1e-4, 1e-6, 1e-9] {
            let scene = scene(&format!(
                r#"
                states = {{ x = {{}}, v = {{}}, n = {{}} }}
                controls = {{ u = {{}} }}
                dynamics = {{ x = "v", v = "-sin(3*x)", n = "0" }}
                cost = {{ running = "0.5*u^2", terminal = "x^2", final_time = 1 }}
                region = {{ x = [-2, 2], v = [-2, 2], n = [-2, 2] }}
                integrator = {{ rtol = {rtol:?}, method = "{method}", precision = "f64" }}
                {count}
                "#
            ));
            for x in [0.5, 0.71, 0.93] {
                let done = simulated(&scene, &[x, 0.0, 0.0], 40.0);
                let jumps = &done.flights.jumps;
                assert!(jumps.len() >= 4, "{method} {rtol}");
                for (a, b) in jumps.iter().zip(&jumps[1..]) {
                    assert!(b.t - a.t > 1.0, "{method} {rtol}: {} {}", a.t, b.t);
                }
                // On the surface to rounding, whatever the tolerance is.
                assert!(jumps.iter().all(|j| (j.before[0] - 0.19).abs() < 1e-14));
            }
        }
    }
}

/// Where flights that differ by their tolerance part within a phase.
#[test]
fn events_after_sensitive_motion_are_located() {
    let lorenz = scene(
        r#"
        states = { x = {}, y = {}, z = {} }
        controls = { u = {} }
        dynamics = { x = "10*(y - x)", y = "x*(28 - z) - y + u", z = "x*y - 8*z/3" }
        cost = { running = "0.5*u^2", terminal = "x^2", final_time = 1 }
        region = { x = [-20, 20], y = [-30, 30], z = [0, 50] }
        events = { high = { when = "x >= 15", set = { x = "x" } } }
        "#,
    );
    let mut met = 0;
    for rtol in [1e-6, 1e-9] {
        for x in [1.0, 2.0, 3.0, -4.0] {
            let done = at_tolerance(&lorenz, rtol, &[x, 2.0, 20.0], 60.0);
            assert_eq!(done.status(0), "time", "{rtol} {x}");
            let jumps = &done.flights.jumps;
            assert!(jumps.iter().all(|j| (j.before[0] - 15.0).abs() < 1e-12));
            met += jumps.len();
        }
    }
    // Once in three time units, about.
    assert!((80..300).contains(&met), "{met}");
    // Where they part altogether: still on the surface, and within the time.
    for x in [1.0, 2.5] {
        let done = at_tolerance(&lorenz, 1e-3, &[x, 2.0, 20.0], 150.0);
        assert!(done.flights.t[0] <= 150.0);
        let jumps = &done.flights.jumps;
        assert!(
            jumps
                .iter()
                .all(|j| (j.before[0] - 15.0).abs() < 1e-4 && j.t <= 150.0)
        );
    }
}

/// Those before it in the scene happen before the flight ends.
#[test]
fn three_events_at_one_moment() {
    let count = "[events.count]\nwhen = \"x <= 0\"\nset = { n = \"n + 1\" }\n";
    let floor = "[events.floor]\nwhen = \"x <= 0\"\nset = { v = \"-0.5*v\" }\n";
    let stop = "[events.stop]\nwhen = \"x <= 0\"\nends = true\n";
    for (events, met, fast) in [
        ([count, floor, stop].concat(), 1.0, false),
        ([floor, count, stop].concat(), 0.0, false),
        ([floor, stop, count].concat(), 0.0, false),
        ([stop, count, floor].concat(), 0.0, true),
        ([count, stop, floor].concat(), 1.0, true),
    ] {
        let done = simulated(&oscillator(["v", "-9.81"], &events), &[1.0, 0.0, 0.0], 3.0);
        assert_eq!(done.status(0), "event_stop", "{events}");
        assert_eq!(done.flights.last[2], met, "{events}");
        assert_eq!(done.flights.last[1] < -4.0, fast, "{events}");
    }
    // What an event asks for has come true at the same moment.
    let first = "[events.a]\nwhen = \"x >= 1\"\nset = { n = 1 }\n";
    let second = "[events.b]\nwhen = \"x >= 1\"\nwhere = \"n >= 1\"\nset = { n = \"n + 10\" }\n";
    let end = "[events.stop]\nwhen = \"x >= 1\"\nends = true\n";
    let events = [first, second, end].concat();
    let done = simulated(&oscillator(["1", "0"], &events), &[0.0, 0.0, 0.0], 3.0);
    assert_eq!((done.status(0), done.flights.last[2]), ("event_stop", 11.0));
}
