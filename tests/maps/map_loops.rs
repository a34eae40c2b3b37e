//! Closed loops under the law of a map in pieces on a GPU, which asks the map itself: against the
//! CPU, and against problems whose J is V by hand.

use crate::common_commands;
use crate::common_loop;
use crate::common_problems::manufactured;

use common_commands::{costate, done, scratch, sections_of};
use common_loop::{Asked, Scene, any_gpu};
use costate::backend::{Backend, cpu::Cpu};
use costate::low_level::closed_loop::LawResult;
use costate::low_level::map::ValueMap;
use costate::low_level::model::Precision;
use costate::low_level::result::Stored;
use costate::low_level::scenario::PROBLEM_SECTIONS;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

const F64: Asked = Asked {
    precision: Precision::F64,
    rtol: 1e-8,
    method: None,
};

fn folder() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| scratch("map-loops"))
}

/// A scene, and its map.
struct Mapped {
    scene: Scene,
    map: ValueMap,
}

impl Mapped {
    fn new(name: &str, text: &str) -> Self {
        let path = folder().join(format!("{name}.toml"));
        let out = path.with_extension("h5");
        std::fs::write(&path, text).unwrap();
        if !out.exists() {
            let arguments: [&dyn AsRef<OsStr>; 6] =
                [&"homotopy", &path, &"--backend", &"cpu", &"--out", &out];
            done(costate(&arguments));
        }
        Self {
            scene: Scene::new(text),
            map: Stored::open(&out).unwrap().value_map().unwrap(),
        }
    }

    /// The same map under other settings of the closed loop.
    fn under(&mut self, text: &str) {
        self.scene = Scene::new(text);
    }

    fn fly(&self, backend: &dyn Backend, asked: Asked) -> LawResult {
        let e = self.scene.evaluate(
            backend,
            asked,
            &["map"],
            self.scene.initial(),
            Some(&self.map),
            None,
        );
        assert_eq!(e.backend, backend.name());
        e.laws.into_iter().next().unwrap()
    }

    fn legs(&self) -> usize {
        let scene = self.scene.model.closed_loop.as_ref().unwrap();
        let a_sample = scene.final_time / scene.samples as f64;
        let updates = scene
            .period
            .map_or(1, |p| (a_sample / p - 1e-9).ceil() as usize);
        scene.samples * updates
    }
}

/// The largest difference of J, records, paths and times, relative to their size, of trajectories
/// that ended alike; and how many did not.
fn difference(a: &LawResult, b: &LawResult) -> (f64, usize) {
    assert_eq!(
        (a.status.len(), a.records.len()),
        (b.status.len(), b.records.len())
    );
    let records = a.records.len() / a.status.len().max(1);
    let (mut most, mut unlike) = (0.0f64, 0);
    let mut where_most = String::new();
    let mut see = |a: &[f64], b: &[f64], what: &str| {
        assert_eq!(a.len(), b.len());
        for (a, b) in a.iter().zip(b) {
            assert_eq!(a.is_nan(), b.is_nan(), "{what}: {a} {b}");
            if !a.is_nan() && (a - b).abs() / (1.0 + a.abs()) > most {
                where_most = format!("{what}: {a} {b}");
                most = most.max((a - b).abs() / (1.0 + a.abs()));
            }
        }
    };
    let same = |i: usize| a.status[i] == b.status[i] && a.fallback[i] == b.fallback[i];
    for i in 0..a.status.len() {
        if !same(i) {
            unlike += 1;
            continue;
        }
        see(&a.cost[i..=i], &b.cost[i..=i], "J");
        see(&a.t_end[i..=i], &b.t_end[i..=i], "end time");
        let own = i * records..(i + 1) * records;
        see(&a.records[own.clone()], &b.records[own], "records");
    }
    assert_eq!(a.paths.len(), b.paths.len());
    for (p, q) in a
        .paths
        .iter()
        .zip(&b.paths)
        .filter(|(p, _)| same(p.initial))
    {
        assert_eq!(p.initial, q.initial);
        for (p, q, what) in [(&p.t, &q.t, "t"), (&p.x, &q.x, "x"), (&p.u, &q.u, "u")] {
            see(p, q, what);
        }
    }
    println!("largest: {where_most}");
    (most, unlike)
}

/// A mass pushed by a force, at a cost of which P is known by hand.
const MASS: &str = r#"
states = { x = {}, v = {} }
controls = { u = {} }
dynamics = { x = "v", v = "u" }
cost = { running = "0.5*(x^2 + v^2 + u^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-2, 2], v = [-2, 2] }
"#;

/// A map with these lines, and closed loops with those, of which a quantity is recorded.
fn map_and_loop(map: &str, closed_loop: &str, record: &str) -> String {
    format!(
        "[map]\n{map}\ncheck = 1\n[closed_loop]\n{closed_loop}\n[closed_loop.record]\n{record}\n"
    )
}

/// J of the optimal law is `1/2 x'Px` with P = [[root 3, 1], [1, root 3]]. That p is linear in x is
/// within the law's model, so a period costs nothing: what is left is the map's error of p, whose
/// square costs, and the integrator's.
#[test]
fn a_linear_quadratic_loop_costs_v() {
    let text = MASS.to_owned()
        + &map_and_loop(
            "error = 1e-6\nfloor = 1e-3",
            "final_time = 10.0\nsamples = 40\nperiod = 0.05\ninitial = { x = [-1.2, 1.2, 7], v = [-1.2, 1.2, 7] }",
            "fastest = \"max(v)\"",
        );
    let mapped = Mapped::new("mass", &text);
    let gpu = any_gpu();
    let result = mapped.fly(&gpu, F64);
    let initial = mapped.scene.initial();
    let root = 3f64.sqrt();
    let mut worst = 0.0f64;
    for i in 0..initial.count() {
        let x = initial.state(i);
        let v = 0.5 * root * (x[0] * x[0] + x[1] * x[1]) + x[0] * x[1];
        if v == 0.0 {
            continue;
        }
        assert!(result.converged[i] && result.status[i] == 0 && result.fallback[i] == 0);
        worst = worst.max((result.cost[i] / v - 1.0).abs());
    }
    println!(
        "J/V - 1 at most {worst:e}, {} round trips",
        result.round_trips
    );
    // The map's error of V relative to V.
    assert!(worst <= 1e-6, "{worst:e}");
    let trips = result.round_trips;
    assert!(
        trips * 8 <= mapped.legs(),
        "{trips} round trips of {} legs",
        mapped.legs()
    );
    let on_cpu = mapped.fly(&Cpu::new(), F64);
    assert_eq!(on_cpu.round_trips, 0);
    let (most, unlike) = difference(&on_cpu, &result);
    // Both sides' steps agree to rounding; over 200 legs of a stable loop these errors die out.
    assert!(unlike == 0 && most <= 1e-11, "{most:e} {unlike}");
    // The comparison sees a tenth of what rtol allows.
    let mut wrong = result;
    wrong.cost[3] += 0.1 * F64.rtol * (1.0 + wrong.cost[3]);
    assert!(difference(&on_cpu, &wrong).0 > 1e-10);
}

/// A nonlinear problem with exact V, pieces and the local solution.
#[test]
fn a_nonlinear_loop_costs_v() {
    let text = sections_of("manufactured", |section| {
        !["shoot_out", "homotopy"].contains(&section)
    }) + &map_and_loop(
        "error = 1e-4\nfloor = 1e-3",
        "final_time = 15.0\nsamples = 60\nperiod = 0.05\ninitial = { x = [-1, 1, 9], y = [-1, 1, 9] }",
        "least_x = \"min(x)\"",
    );
    let mapped = Mapped::new("manufactured", &text);
    let initial = mapped.scene.initial();
    let pieces = |x: &[f64]| {
        mapped
            .map
            .without_errors(x)
            .lowest
            .is_ok_and(|v| v.in_pieces)
    };
    assert!(
        (0..initial.count())
            .filter(|i| pieces(initial.state(*i)))
            .count()
            > initial.count() / 2
    );
    let (gpu, cpu) = (any_gpu(), mapped.fly(&Cpu::new(), F64));
    let f32 = Asked {
        precision: Precision::F32,
        rtol: 1e-5,
        method: None,
    };
    for (asked, allowed, close) in [(F64, 2e-4, 1e-10), (f32, 4e-4, 2e-4)] {
        let result = mapped.fly(&gpu, asked);
        let mut worst = 0.0f64;
        for i in 0..initial.count() {
            let x = initial.state(i);
            let v = manufactured::value(x);
            assert!(result.status[i] == 0 && result.fallback[i] == 0, "{x:?}");
            if v > 0.0 {
                worst = worst.max((result.cost[i] / v - 1.0).abs());
            }
        }
        let (most, unlike) = difference(&cpu, &result);
        println!(
            "{}: J/V - 1 at most {worst:e}; CPU and GPU differ by {most:e}; {} round trips of {} legs, {:.0} loops/s (CPU {:.0})",
            asked.precision.name(),
            result.round_trips,
            mapped.legs(),
            result.rate(),
            cpu.rate(),
        );
        assert!(worst <= allowed && unlike == 0 && most <= close);
        assert!(result.round_trips * 8 <= mapped.legs());
    }
}

/// Where the map has no answer each policy does what it does on the CPU, round trip by round trip,
/// for those it has none for.
#[test]
fn what_is_outside_the_map_is_left_to_the_policies() {
    let text = |outside: &str| {
        sections_of("pendulum", |section| PROBLEM_SECTIONS.contains(&section))
            + &map_and_loop(
                "error = 1e-2\nfloor = 1e-1\nstates = 300\nvalue_max = 60",
                &format!(
                    "final_time = 6.0\nsamples = 30\nperiod = 0.05\noutside = \"{outside}\"\n\
                     initial = {{ theta = [-3.9, 2.4, 7], omega = [-8.0, 8.0, 7] }}"
                ),
                "highest_torque = \"max(abs(u))\"",
            )
    };
    let (gpu, cpu) = (any_gpu(), Cpu::new());
    let mut mapped = Mapped::new("pendulum", &text("stop"));
    for outside in ["stop", "hold", "nearest", "search", "lqr"] {
        mapped.under(&text(outside));
        // Loops that a held p drives away multiply what steps err by: by how much, the CPU tells at
        // another tolerance.
        let asked = F64;
        let finer = mapped.fly(
            &cpu,
            Asked {
                rtol: 0.3 * F64.rtol,
                ..F64
            },
        );
        let (a, b) = (mapped.fly(&cpu, asked), mapped.fly(&gpu, asked));
        let (most, unlike) = difference(&a, &b);
        let helped = a.fallback.iter().filter(|k| **k > 0).count();
        println!(
            "{outside}: {helped} of {} helped, differ by {most:e}, {unlike} unlike; {} round trips of {} legs",
            a.status.len(),
            b.round_trips,
            mapped.legs()
        );
        assert!(helped > 0 && helped < a.status.len());
        let (own, _) = difference(&a, &finer);
        assert!(
            unlike == 0 && most <= 3.0 * own.max(F64.rtol),
            "{most:e} {unlike}"
        );
    }
}

/// V(x, t) is a quadratic function of x known by hand; its law flown on the device costs it.
#[test]
fn a_map_with_time_is_asked_at_its_time() {
    let text = sections_of("finite_horizon", |section| {
        !["shoot_out", "homotopy", "map"].contains(&section)
    }) + &map_and_loop(
        "error = 1e-4\nfloor = 1e-2",
        "samples = 20\nperiod = 0.02\ninitial = { x = [-1, 1, 5], v = [-1, 1, 5] }",
        "",
    );
    let mapped = Mapped::new("finite_horizon", &text);
    assert!(mapped.map.time().is_some());
    let (a, b) = (mapped.fly(&Cpu::new(), F64), mapped.fly(&any_gpu(), F64));
    let (most, unlike) = difference(&a, &b);
    println!(
        "differ by {most:e}; {} round trips of {} legs",
        b.round_trips,
        mapped.legs()
    );
    assert!(unlike == 0 && most <= 1e-10);
    assert!(b.round_trips * 8 <= mapped.legs());
    // V = 1/2 z'(W + I/s)^-1 z where z = e^(FT) x, and 1/2 d'W^-1 d is the least effort that moves
    // the end by d.
    let (last, s) = (2.0f64, 10.0);
    let initial = mapped.scene.initial();
    for i in 0..initial.count() {
        let x = initial.state(i);
        let z = [x[0] + last * x[1], x[1]];
        let m = [
            last.powi(3) / 3.0 + 1.0 / s,
            last * last / 2.0,
            last + 1.0 / s,
        ];
        let det = m[0] * m[2] - m[1] * m[1];
        let v = 0.5 * (m[2] * z[0] * z[0] - 2.0 * m[1] * z[0] * z[1] + m[0] * z[1] * z[1]) / det;
        if v > 1e-2 {
            assert!(
                (b.cost[i] / v - 1.0).abs() <= 1e-3,
                "{x:?}: {} {v}",
                b.cost[i]
            );
        }
    }
}
