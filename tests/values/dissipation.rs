//! The certified gain checked by simulation: where V is known exactly nothing violates it, what
//! certifies nothing is found out, and the numbers are those of an integrator that shares nothing
//! with the program.

use crate::common_loop;

use common_loop::{Asked, Scene, TIGHT, any_gpu, runge_kutta};
use costate::backend::{Backend, Status, cpu::Cpu};
use costate::low_level::closed_loop::dissipation::{
    Certificate, Dissipation, DisturbanceKind, LawCheck, TOLERANCE, check, flight,
};
use costate::low_level::closed_loop::{Chart, Expansion, Law, Laws, OUTSIDE_MAP};
use costate::low_level::model::Precision;
use costate::low_level::sweep::Choices;

/// A spring, a force and a disturbance beside it.
const SPRING: &str = r#"
parameters = { gamma = 1.2, k0 = "sqrt(3) - 1" }
states = { x = {}, v = {} }
controls = { u = {} }
disturbances = { w = {} }
dynamics = { x = "v", v = "-x + u + w" }
cost = { running = "0.5*(2*x^2 + v^2 + u^2) - 0.5*gamma^2*w^2" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-1, 1], v = [-1, 1] }
[closed_loop]
final_time = 1.0
initial = { x = [-1, 1, 3] }
[closed_loop.law]
h2 = { u = "-k0*x - sqrt(1 + 2*k0)*v" }
[dissipation]
samples = 50
"#;

/// P of the spring's game Riccati equation `A'P + PA + Q - (1 - 1/gamma^2) P B B'P = 0`, solved by
/// hand: p11, p12, p22.
fn spring_p(gamma: f64) -> [f64; 3] {
    let s = 1.0 - gamma.powi(-2);
    let p12 = ((1.0 + 2.0 * s).sqrt() - 1.0) / s;
    let p22 = ((2.0 * p12 + 1.0) / s).sqrt();
    [p22 * (1.0 + s * p12), p12, p22]
}

fn spring_v(p: [f64; 3], x: &[f64]) -> f64 {
    0.5 * p[0] * x[0] * x[0] + p[1] * x[0] * x[1] + 0.5 * p[2] * x[1] * x[1]
}

/// `[dissipation]` of a scene, under the laws named.
fn checked(
    scene: &Scene,
    names: &[&str],
    backend: &dyn Backend,
    asked: Asked,
    chart: Option<&dyn Chart>,
    seed: u64,
) -> Dissipation {
    let wanted = scene
        .model
        .dissipation
        .as_ref()
        .expect("the scene has [dissipation]");
    let laws = Laws::new(&scene.model, &scene.hamiltonian, None);
    let certificate = Certificate::of(&laws, chart, None).unwrap();
    let flight = flight(&scene.model, wanted, laws.riccati()).unwrap();
    let chosen: Vec<Law> = (names.iter())
        .map(|name| match *name {
            "lqr" => laws.lqr().unwrap(),
            "map" => laws.chart("map"),
            name => laws
                .given(flight.given.iter().find(|g| g.name == name).unwrap())
                .unwrap(),
        })
        .collect();
    let choices = Choices {
        precision: Some(asked.precision),
        rtol: Some(asked.rtol),
        method: asked.method,
        seed,
        ..Choices::default()
    };
    check(
        &laws,
        (wanted, &flight),
        &chosen,
        &certificate,
        backend,
        choices,
        &mut |_| {},
    )
    .unwrap_or_else(|e| panic!("{}: {e}", backend.name()))
}

fn same_cases(a: &Dissipation, b: &Dissipation) {
    let both = [a, b].map(|d| (&d.cases.kind, &d.cases.x0, &d.cases.waves));
    assert!(both[0] == both[1], "other disturbances");
}

fn tightly(scene: &Scene, names: &[&str], chart: Option<&dyn Chart>) -> Dissipation {
    checked(scene, names, &Cpu::new(), TIGHT, chart, 0)
}

fn with(text: &str, lines: &str) -> Scene {
    Scene::new(&text.replace("samples = 50", lines))
}

fn of_kind(d: &Dissipation, kind: DisturbanceKind) -> impl Iterator<Item = usize> + '_ {
    (0..d.cases.count()).filter(move |k| d.cases.kind[*k] == kind)
}

/// Errors of a trajectory's E and W are the tolerance's, some dozen steps.
const FEW_STEPS: f64 = 100.0;

/// Ten thousand disturbances: E + V(x(t)) <= W + V(x0) at all times, with equality under w*.
#[test]
fn nothing_violates_an_exact_value() {
    let scene = with(SPRING, "samples = 50\ndisturbances = 10000");
    let d = tightly(&scene, &["map", "lqr"], None);
    let p = spring_p(1.2);
    assert_eq!(d.cases.count(), 10_000);
    assert_eq!(d.value, "exact (linear scene)");
    for k in 0..d.cases.count() {
        let exact = spring_v(p, d.cases.state(k));
        assert!(
            (d.v0[k] - exact).abs() <= 1e-12 * (1.0 + exact),
            "V0 of {k}"
        );
    }
    for law in &d.laws {
        let (held, verdict) = law.verdict(&d.cases);
        println!("{}: {verdict}", law.name);
        assert!(held, "{verdict}");
        assert!(
            law.violation.iter().all(|v| *v <= FEW_STEPS * TIGHT.rtol),
            "{}",
            law.name
        );
        assert!(law.ratio.iter().all(|r| *r > 0.0 && *r < 1.0));
        assert!(law.status.iter().all(|s| *s == Status::Reached as i32));
        let mut worst = 0;
        for k in of_kind(&d, DisturbanceKind::Worst) {
            let budget = law.supplied[k] + d.v0[k];
            let rest = (law.done[k] + law.v_end[k] - budget) / budget;
            assert!(rest.abs() <= FEW_STEPS * TIGHT.rtol, "case {k}: {rest:e}");
            // All but exp(-16) of V is spent.
            assert!(law.ratio[k] > 1.0 - 1e-5, "case {k}: {}", law.ratio[k]);
            worst += 1;
        }
        assert_eq!(worst, 99, "once from each state but the equilibrium");
        assert!(
            verdict.contains("the worst case comes closest"),
            "{verdict}"
        );
    }
    let summaries = d.laws[0].summaries(&d.cases);
    assert_eq!(summaries.iter().map(|s| s.count).sum::<usize>(), 10_000);
    assert_eq!(summaries.iter().map(|s| s.judged).sum::<usize>(), 10_000);
}

/// The law that is optimal without a disturbance has a gain of at least sqrt(2) at the spring's own
/// frequency, which is above 1.2.
#[test]
fn a_law_that_is_not_good_enough_is_found_out() {
    let lines = "samples = 50\ndisturbances = 400\nfinal_time = 60\nfrequencies = [0.9, 1.1]\ninitial = { x = 0 }";
    let d = tightly(&with(SPRING, lines), &["h2", "map"], None);
    let (held, verdict) = d.laws[0].verdict(&d.cases);
    println!("{verdict}");
    assert!(!held && verdict.contains("VIOLATED"), "{verdict}");
    let sinusoidal = of_kind(&d, DisturbanceKind::Sinusoidal);
    let worst = sinusoidal.map(|k| d.laws[0].ratio[k]).fold(0.0, f64::max);
    // The gain's square over gamma^2, but for the beginning.
    assert!(worst > 1.2 && worst < 2.0 / 1.44 + 0.1, "{worst}");
    assert!(d.laws[1].verdict(&d.cases).0);
    // From the equilibrium w* = 0: the worst case is not among them.
    assert_eq!(of_kind(&d, DisturbanceKind::Worst).count(), 0);
    // Explained by an error of V it is not: V is exact.
    let summary = d.laws[0].summaries(&d.cases);
    assert!(summary.iter().all(|s| s.violated == s.unexplained));
    assert!(
        summary.iter().map(|s| s.exceeded).sum::<usize>() > 100,
        "{verdict}"
    );
}

/// V of another gamma certifies nothing of this one: the claim is too strong.
#[test]
fn a_value_that_certifies_nothing_is_found_out() {
    struct Other([f64; 3]);
    impl Chart for Other {
        fn local(&self, x: &[f64]) -> Option<Expansion> {
            let [a, b, c] = self.0;
            Some(Expansion {
                v: spring_v(self.0, x),
                p: vec![a * x[0] + b * x[1], b * x[0] + c * x[1]],
                hessian: vec![a, b, b, c],
            })
        }
        fn uncertainty(&self, _: &[f64]) -> f64 {
            0.0
        }
    }
    // With a bound far away the scene is no longer linear, and the chart is asked.
    let text = SPRING.replace(
        "controls = { u = {} }",
        "controls = { u = { min = -1e3, max = 1e3 } }",
    );
    let lines = "samples = 50\ndisturbances = 300\nfinal_time = 10";
    let scene = with(&text, lines);
    let good = tightly(&scene, &["map"], Some(&Other(spring_p(1.2))));
    assert_eq!(good.value, "of the value map");
    assert!(
        good.laws[0].verdict(&good.cases).0,
        "{}",
        good.laws[0].verdict(&good.cases).1
    );
    let too_much = tightly(&scene, &["map"], Some(&Other(spring_p(3.0))));
    let (held, verdict) = too_much.laws[0].verdict(&too_much.cases);
    assert!(!held, "{verdict}");
    // By the chart or by formula: the same trajectories.
    let formula = tightly(&with(SPRING, lines), &["map"], None);
    for k in 0..300 {
        let (a, b) = (good.laws[0].done[k], formula.laws[0].done[k]);
        assert!(
            (a - b).abs() <= FEW_STEPS * TIGHT.rtol * (1.0 + b),
            "case {k}: {a} {b}"
        );
    }
}

/// A few disturbances of each kind, integrated by hand with their w(t).
#[test]
fn the_balance_is_that_of_another_integrator() {
    let scene = with(
        SPRING,
        "samples = 20\ndisturbances = 40\nfinal_time = 6\namplitude = { w = 0.7 }",
    );
    let d = tightly(&scene, &["map"], None);
    let law = &d.laws[0];
    let (gamma, [_, p12, p22]) = (1.2f64, spring_p(1.2));
    for (_, kind) in DisturbanceKind::ALL {
        for k in of_kind(&d, kind).take(4) {
            let waves = &d.cases.waves[k];
            assert!(d.cases.amplitude[k].is_nan() || d.cases.amplitude[k] <= 0.7);
            let f = |y: &[f64]| {
                let push = p12 * y[0] + p22 * y[1];
                let w = match kind {
                    DisturbanceKind::Worst => push / gamma.powi(2),
                    _ => waves
                        .iter()
                        .map(|s| s.amplitude * (s.frequency * y[4] + s.phase).sin())
                        .sum(),
                };
                let done = 0.5 * (2.0 * y[0] * y[0] + y[1] * y[1] + push * push);
                vec![
                    y[1],
                    -y[0] - push + w,
                    done,
                    0.5 * gamma * gamma * w * w,
                    1.0,
                ]
            };
            let x = d.cases.state(k);
            let end = runge_kutta(&f, &[x[0], x[1], 0.0, 0.0, 0.0], 6.0, 20_000, &mut |_| {});
            let v_end = spring_v(spring_p(1.2), &end);
            for (what, mine, other) in [
                ("E", law.done[k], end[2]),
                ("W", law.supplied[k], end[3]),
                ("V", law.v_end[k], v_end),
            ] {
                assert!(
                    (mine - other).abs() <= 1e-8 * (1.0 + other),
                    "{what} of case {k}: {mine} {other}"
                );
            }
        }
    }
    // Kept whole, alone, they are what they were among all: results do not depend on the batch.
    for (path, values) in law.paths.iter().zip(&law.path_values) {
        let (k, last) = (path.initial, path.t.len() - 1);
        assert_eq!(
            (path.cost[last], path.supplied[last]),
            (law.done[k], law.supplied[k])
        );
        assert_eq!((path.t.len(), path.w.len(), values.len()), (21, 21, 21));
        assert!((values[last] - law.v_end[k]).abs() <= 1e-15);
    }
    assert_eq!(law.paths.len(), 6);
}

/// Costs with cross terms and other factors: the supply is L(x, u, 0) - L(x, u, w) whatever it is.
#[test]
fn factors_follow_the_scene() {
    let text = SPRING.replace(
        "0.5*(2*x^2 + v^2 + u^2) - 0.5*gamma^2*w^2",
        "2*x^2 + v^2 + u^2 + 0.3*x*w - gamma^2*w^2",
    );
    let d = tightly(
        &with(&text, "samples = 50\ndisturbances = 600"),
        &["map"],
        None,
    );
    let (held, verdict) = d.laws[0].verdict(&d.cases);
    assert!(held, "{verdict}");
    for k in of_kind(&d, DisturbanceKind::Worst) {
        let budget = d.laws[0].supplied[k] + d.v0[k];
        let rest = d.laws[0].done[k] + d.laws[0].v_end[k] - budget;
        assert!(
            rest.abs() <= FEW_STEPS * TIGHT.rtol * budget,
            "case {k}: {rest:e}"
        );
    }
}

/// V = (x^2 + y^2)/2 + x^4/4 solves the Isaacs equation of this scene.
fn manufactured() -> String {
    r#"
parameters = { gamma = 2 }
states = { x = {}, y = {} }
controls = { u = {} }
disturbances = { w = {} }
definitions = { vx = "x + x^3", vy = "y", a = "-x + y", b = "-x - y" }
dynamics = { x = "a + 0.5*w", y = "b + u + w" }
cost = { running = "-vx*a - vy*b + 0.5*vy^2 - (0.5*vx + vy)^2/(2*gamma^2) + 0.5*u^2 - 0.5*gamma^2*w^2" }
equilibrium = { x = 0, y = 0, u = 0 }
region = { x = [-1, 1], y = [-1, 1] }
[dissipation]
samples = 50
"#
    .to_owned()
}

struct Known {
    reach: f64,
}

impl Chart for Known {
    fn local(&self, x: &[f64]) -> Option<Expansion> {
        let (a, b) = (x[0], x[1]);
        (a.abs() <= self.reach && b.abs() <= self.reach).then(|| Expansion {
            v: 0.5 * (a * a + b * b) + 0.25 * a.powi(4),
            p: vec![a + a.powi(3), b],
            hessian: vec![1.0 + 3.0 * a * a, 0.0, 0.0, 1.0],
        })
    }
}

/// Under the chart's law u is held to the second order between updates: an error of u and w costs
/// its square, that is the fourth order of the way between updates.
#[test]
fn a_nonlinear_game_keeps_its_gain() {
    let scene = with(
        &manufactured(),
        "samples = 100\ndisturbances = 2000\nfinal_time = 10\nperiod = 0.01",
    );
    let d = tightly(&scene, &["map"], Some(&Known { reach: 3.0 }));
    let law = &d.laws[0];
    let (held, verdict) = law.verdict(&d.cases);
    println!("{verdict}");
    assert!(held, "{verdict}");
    assert!(
        verdict.contains("the worst case comes closest"),
        "{verdict}"
    );
    for k in of_kind(&d, DisturbanceKind::Worst) {
        let budget = law.supplied[k] + d.v0[k];
        let rest = (law.done[k] + law.v_end[k] - budget) / budget;
        assert!(rest.abs() <= 1e-7, "case {k}: {rest:e}");
    }
}

/// Judged as far as V is known, and counted.
#[test]
fn where_v_is_not_known_nothing_is_claimed() {
    let lines = "samples = 100\ndisturbances = 500\nfinal_time = 10\namplitude = 3\ninitial = { x = [-1, 1, 5], y = [-1, 1, 5] }";
    let d = tightly(
        &with(&manufactured(), lines),
        &["map"],
        Some(&Known { reach: 0.9 }),
    );
    let law = &d.laws[0];
    let (mut unknown, mut left) = (0, 0);
    for k in 0..500 {
        let inside = d.cases.state(k).iter().all(|x| x.abs() <= 0.9);
        assert_eq!(inside, !d.v0[k].is_nan());
        if !inside {
            assert!(law.ratio[k].is_nan() && law.violation[k].is_nan());
            assert_eq!(law.status[k], OUTSIDE_MAP);
            unknown += 1;
        } else if law.status[k] == OUTSIDE_MAP {
            assert!(law.t_end[k] < 10.0 && law.violation[k] <= TOLERANCE);
            left += 1;
        }
    }
    assert!(unknown > 50 && left > 20, "{unknown} {left}");
    let summaries = law.summaries(&d.cases);
    assert_eq!(
        summaries.iter().map(|s| s.judged).sum::<usize>(),
        500 - unknown
    );
    assert_eq!(summaries.iter().map(|s| s.left).sum::<usize>(), left);
    assert_eq!(d.statuses(law)["outside_map"], unknown + left);
}

#[test]
fn backends_and_precisions_agree() {
    let scene = with(SPRING, "samples = 20\ndisturbances = 200\nfinal_time = 8");
    let exact = tightly(&scene, &["map"], None);
    let nonlinear = with(
        &manufactured(),
        "samples = 50\ndisturbances = 100\nfinal_time = 5",
    );
    let chart = Known { reach: 3.0 };
    let charted = tightly(&nonlinear, &["map"], Some(&chart));
    let (cpu, gpu) = (Cpu::new(), any_gpu());
    let backends: [&dyn Backend; 2] = [&cpu, &gpu];
    for backend in backends {
        for (precision, rtol) in [(Precision::F32, 1e-5), (Precision::F64, 1e-8)] {
            let asked = Asked {
                precision,
                rtol,
                method: None,
            };
            let allowed = FEW_STEPS * rtol;
            for (scene, chart, reference) in [
                (&scene, None, &exact),
                (&nonlinear, Some(&chart as &dyn Chart), &charted),
            ] {
                let d = checked(scene, &["map"], backend, asked, chart, 0);
                same_cases(&d, reference);
                assert_eq!(d.numerics.precision, precision);
                let pairs = |of: fn(&LawCheck) -> &Vec<f64>| {
                    let both = of(&d.laws[0]).iter().zip(of(&reference.laws[0]));
                    both.map(|(a, b)| (a - b).abs() / (1.0 + b.abs()))
                        .fold(0.0, f64::max)
                };
                let worst = [
                    pairs(|l| &l.done),
                    pairs(|l| &l.supplied),
                    pairs(|l| &l.ratio),
                ];
                println!(
                    "{} {precision:?}: {worst:?} of {allowed:.0e}",
                    backend.name()
                );
                assert!(
                    worst.iter().all(|w| *w <= allowed),
                    "{} {precision:?}: {worst:?}",
                    backend.name()
                );
            }
        }
    }
}

/// The same seed gives the same disturbances and, with any number of threads, the same numbers.
#[test]
fn a_seed_and_nothing_else_decides() {
    let scene = with(SPRING, "samples = 20\ndisturbances = 3000\nfinal_time = 5");
    let all = tightly(&scene, &["map"], None);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    let alone = pool.install(|| tightly(&scene, &["map"], None));
    same_cases(&all, &alone);
    assert_eq!(all.laws[0].done, alone.laws[0].done);
    assert_eq!(all.laws[0].violation, alone.laws[0].violation);
    let other = checked(&scene, &["map"], &Cpu::new(), TIGHT, None, 1);
    assert_ne!(all.cases.x0, other.cases.x0);
    assert_ne!(all.cases.waves, other.cases.waves);
    // Kinds do not depend on the seed; frequencies are in the band.
    assert_eq!(all.cases.kind, other.cases.kind);
    let [low, high] = all.frequencies;
    let waves = || all.cases.waves.iter().flatten();
    assert!(waves().all(|w| (low..=high).contains(&w.frequency) && w.amplitude > 0.0));
    assert!(waves().count() > 10_000);
}
