//! Finite horizons against exact V: T to the last bit, long horizons by marching; states that need
//! no sweep.
//!
//! Bound: V has the error of the segments alone, which are integrated to 1e-12 relative to their
//! size; exact answers are met to 1e-12 relative.

use crate::common_oracles;
use crate::common_problems::linear::{Linear, diagonal, form};
use crate::common_problems::{Cart, manufactured};
use crate::common_values;

use common_values::{Swept, given, parse, scene};
use costate::backend::cpu::Cpu;
use costate::low_level::model::Model;
use costate::low_level::shooting::End;
use costate::low_level::sweep::Plan;
use costate::low_level::value::{self, Answers, Archive, Index, Request, march};
use nalgebra::DMatrix;
use std::path::PathBuf;
use std::process::{Command, Output};

const EXACT: f64 = 1e-12;
const HORIZONS: [f64; 4] = [0.1, 0.7, 1.3, 2.7];

/// A plan that is never swept.
/// Answers without a sweep.
fn solved(model: &Model, points: &[f64]) -> (Plan, Answers) {
    let plan = common_oracles::unswept(model);
    let mut solver = value::solver(&plan, &Cpu::new()).expect("the CPU compiles everything");
    let request = Request {
        points: points.to_vec(),
        ..Request::default()
    };
    let archive = Archive::new(&plan);
    let answers = value::solve(
        &plan,
        model,
        &mut solver,
        &archive,
        &request,
        &mut |_, _, _| {},
    )
    .expect("the CPU works");
    (plan, answers)
}

fn with_horizon(text: &str, time: f64) -> Model {
    parse(&text.replace("HORIZON", &format!("{time:?}")))
}

/// Asks for V at states (`n` each), from a sweep and without, and compares it with an exact one.
fn check(text: &str, points: &[f64], exact: impl Fn(f64, &[f64]) -> f64) {
    for time in HORIZONS {
        let model = with_horizon(text, time);
        let n = model.states.len();
        let swept = Swept::new(model.clone(), 300);
        for answers in [swept.points(points), solved(&model, points).1] {
            for (k, x) in points.chunks(n).enumerate() {
                let entry = given(&answers, k)
                    .unwrap_or_else(|| panic!("{x:?} is not solved for T = {time}"));
                assert_eq!(entry.path.horizon(), time, "the horizon at {x:?}");
                let v = exact(time, x);
                let error = (entry.value - v).abs() / v.abs();
                assert!(
                    error <= EXACT,
                    "V at {x:?}, T = {time}: {} not {v}: {error:.1e}",
                    entry.value
                );
            }
        }
    }
}

/// CUTEst, HAGER2 family: V = tanh(T) x^2 / 2.
const HAGER: &str = r#"
    states = { x = {} }
    controls = { u = {} }
    dynamics = { x = "0.5*x + u" }
    cost = { running = "0.5*(1.25*x^2 + x*u + u^2)", final_time = HORIZON, terminal = "0" }
    region = { x = [-2, 2] }
    shoot_out = { spacing = 0.05, samples = 20 }
"#;

#[test]
fn hager() {
    check(HAGER, &[1.0, -0.7, 1.9, 0.01], |time, x| {
        0.5 * time.tanh() * x[0] * x[0]
    });
}

#[test]
fn cart_to_rest() {
    for time in HORIZONS {
        let set = format!("{time:?}");
        let swept = Swept::new(scene("finite_horizon", &[("T", &set)]), 300);
        let points = [1.0, -0.5, -0.3, 1.2, 2.0, 2.0, 0.1, 0.0];
        let answers = swept.points(&points);
        for (k, x) in points.chunks(2).enumerate() {
            let exact = Cart { weight: 10.0 }.at(x, time).v;
            let entry = given(&answers, k).expect("solved");
            assert_eq!(entry.path.horizon(), time);
            assert!(
                (entry.value - exact).abs() <= EXACT * exact,
                "{} not {exact}",
                entry.value
            );
        }
    }
}

/// V = (1 + 0.3 sin c) w(x) with a clock c: a running cost that makes it the value for any T, with
/// V at the end as the terminal cost.
#[test]
fn manufactured_with_a_clock() {
    let text = r#"
        states = { x = {}, c = {} }
        controls = { u = {} }
        definitions = { g = "1 + 0.3*sin(c)", gc = "0.3*cos(c)", w = "0.5*x^2 + 1 - cos(x) + 0.1*x^4", wx = "x + sin(x) + 0.4*x^3" }
        dynamics = { x = "sin(x) + u", c = "1" }
        cost = { running = "-gc*w - g*wx*sin(x) + 0.5*(g*wx)^2 + 0.5*u^2", terminal = "g*w", final_time = HORIZON }
        region = { x = [-2, 2], c = [-0.1, 5] }
    "#;
    let points = [1.0, 0.0, -2.0, 0.0, 0.3, 0.0, 1.5, 0.5, 0.01, 0.0];
    check(text, &points, |_, x| {
        let w = 0.5 * x[0] * x[0] + 2.0 * (0.5 * x[0]).sin().powi(2) + 0.1 * x[0].powi(4);
        (1.0 + 0.3 * x[1].sin()) * w
    });
}

#[test]
fn manufactured_in_two_states() {
    let text = r#"
        states = { x = {}, y = {} }
        controls = { u = {} }
        definitions = { w = "0.5*x^2 + sin(0.5*x)^2 + 0.5*x*y + y^2 + 0.25*x^2*y^2", wx = "x + 0.5*sin(x) + 0.5*y + 0.5*x*y^2", wy = "0.5*x + 2*y + 0.5*x^2*y" }
        dynamics = { x = "y", y = "sin(x) - x*y + u" }
        cost = { running = "-wx*y - wy*(sin(x) - x*y) + 0.25*wy^2 + u^2", terminal = "w", final_time = HORIZON }
        region = { x = [-2, 2], y = [-2, 2] }
    "#;
    check(
        text,
        &[1.0, -0.5, -1.0, 1.0, 0.01, 0.0, 0.5, 1.2],
        |_, x| manufactured::value(x),
    );
}

#[test]
fn linear_quadratic_up_to_long_horizons() {
    let text = r#"
        states = { x = {}, y = {}, z = {} }
        controls = { u = {} }
        dynamics = { x = "y", y = "-2*x - 0.3*y + z + u", z = "0.5*x + 0.4*z + 0.5*u" }
        cost = { running = "0.5*(x^2 + 0.5*y^2 + 2*z^2 + u^2)", terminal = "0.5*(x^2 + 3*z^2)", final_time = HORIZON }
        region = { x = [-2, 2], y = [-2, 2], z = [-2, 2] }
    "#;
    let linear = Linear {
        a: DMatrix::from_row_slice(3, 3, &[0.0, 1.0, 0.0, -2.0, -0.3, 1.0, 0.5, 0.0, 0.4]),
        b: DMatrix::from_row_slice(3, 1, &[0.0, 1.0, 0.5]),
        q: diagonal(&[1.0, 0.5, 2.0]),
        r: diagonal(&[1.0]),
    };
    for time in [0.1, 0.7, 1.3, 2.7, 8.0, 20.0] {
        let points = [1.0, -0.5, 0.3, -1.0, 1.0, 1.0, 0.01, 0.0, -2.0];
        let (_, answers) = solved(&with_horizon(text, time), &points);
        let [p, _] = linear.with_time(diagonal(&[1.0, 0.0, 3.0]), time);
        for (k, x) in points.chunks(3).enumerate() {
            let exact = form(&p, x);
            let entry = given(&answers, k).expect("solved");
            assert_eq!(entry.path.horizon(), time);
            let error = (entry.value - exact).abs() / exact;
            assert!(
                error <= EXACT,
                "T = {time}: {} not {exact}: {error:.1e}",
                entry.value
            );
        }
    }
}

/// A path of the archive lasts as long as the horizon to the last bit, also where levels are no
/// multiples of anything.
#[test]
fn archived_paths_have_the_horizon() {
    // The longer the horizon, the fewer trajectories end near the region.
    let mut paths = 0;
    for time in HORIZONS {
        let swept = Swept::new(scene("finite_horizon", &[("T", &format!("{time:?}"))]), 100);
        let plan = &swept.plan;
        assert_eq!(*plan.run.levels.last().expect("levels"), time);
        let all = vec![[f64::NEG_INFINITY, f64::INFINITY]; 2];
        let index = Index::new(&swept.archive, &plan.widths, &all, plan.shoot_out.spacing);
        let end = End::new(&plan.system, None);
        let near = index.near(&[0.1, 0.2], f64::INFINITY, 40);
        paths += near.len();
        for (place, _) in near {
            let path = swept
                .archive
                .path(place, &end, 1.0, plan.segment_duration());
            assert_eq!(path.horizon(), time);
        }
    }
    assert!(paths > 40, "{paths} paths");
}

/// A sampled solution lasts as long as the horizon to the last bit, and nothing is left to pay at
/// its end.
#[test]
fn sampled_solutions_have_the_horizon() {
    let model = with_horizon(HAGER, 0.7);
    let (plan, answers) = solved(&model, &[1.0]);
    let mut solver = value::solver(&plan, &Cpu::new()).expect("the CPU compiles everything");
    let entry = given(&answers, 0).expect("solved");
    let block = value::sampled(&plan, &mut solver, &[entry], 11).expect("the CPU works");
    assert_eq!((block.t[0], block.t[10]), (-0.7, 0.0));
    // Segments are integrated in units of their own size: x comes back but for rounding.
    assert!(
        (block.x[0] - 1.0).abs() <= 2.0 * f64::EPSILON,
        "{}",
        block.x[0]
    );
    assert!((block.v[0] - entry.value).abs() <= EXACT * entry.value);
    assert!(block.v[10].abs() <= EXACT, "left: {}", block.v[10]);
}

const SATELLITE: &str = r#"
    title = "Rigid-body satellite"
    states = { phi = {}, theta = {}, psi = {}, w1 = {}, w2 = {}, w3 = {} }
    controls = { u1 = {}, u2 = {}, u3 = {} }
    [definitions]
    r1 = "cos(theta)*cos(psi) + cos(theta)*sin(psi) - sin(theta)"
    r2 = "sin(phi)*sin(theta)*cos(psi) - cos(phi)*sin(psi) + sin(phi)*sin(theta)*sin(psi) + cos(phi)*cos(psi) + cos(theta)*sin(phi)"
    r3 = "cos(phi)*sin(theta)*cos(psi) + sin(phi)*sin(psi) + cos(phi)*sin(theta)*sin(psi) - sin(phi)*cos(psi) + cos(theta)*cos(phi)"
    [dynamics]
    phi = "w1 + sin(phi)*tan(theta)*w2 + cos(phi)*tan(theta)*w3"
    theta = "cos(phi)*w2 - sin(phi)*w3"
    psi = "(sin(phi)*w2 + cos(phi)*w3)/cos(theta)"
    w1 = "(w3*r2 - w2*r3 + u1 + u2/20 + u3/10)/2"
    w2 = "(-w3*r1 + w1*r3 + u1/15 + u2 + u3/10)/3"
    w3 = "(w2*r1 - w1*r2 + u1/10 + u2/15 + u3)/4"
    [cost]
    running = "0.5*(phi^2 + theta^2 + psi^2) + 5*(w1^2 + w2^2 + w3^2) + 0.25*(u1^2 + u2^2 + u3^2)"
    terminal = "0.5*(phi^2 + theta^2 + psi^2 + w1^2 + w2^2 + w3^2)"
    final_time = 20.0
    [region]
    phi = [-1.0472, 1.0472]
    theta = [-1.0472, 1.0472]
    psi = [-1.0472, 1.0472]
    w1 = [-0.7854, 0.7854]
    w2 = [-0.7854, 0.7854]
    w3 = [-0.7854, 0.7854]
"#;

/// The field's standard problem, T = 20 (Nakamura-Zimmerer, Gong, Kang 2021, HJB_NN): published V,
/// known to 2e-7; alone and in company the same bits.
#[test]
fn satellite_marches_to_its_horizon() {
    const PUBLISHED: f64 = 2e-7;
    #[rustfmt::skip]
    let rows: [[f64; 7]; 5] = [
        [-0.0127598806425, -0.656604737426, 0.538703806638, -0.0966169724592, 0.651631340367, -0.11261208964, 2.32151666275],
        [0.911978343142, -0.123595332316, 0.620431785322, -0.104757263991, 0.713967308158, 0.48839619816, 6.51354641308],
        [-0.0857168309157, 0.632707321322, 0.602524711066, -0.598691837161, -0.385007603073, 0.712943388969, 7.02863867736],
        [0.971925704055, 0.969328593525, 0.0799622415437, 0.724955190011, -0.485261818798, -0.103988544525, 5.6769068584],
        [0.515703557126, 0.457311296129, 0.16959592917, 0.266988429037, -0.445147120206, -0.18096104943, 1.79290977504],
    ];
    let model = parse(SATELLITE);
    let plan = common_oracles::unswept(&model);
    let starts: Vec<Vec<f64>> = rows.iter().map(|r| r[..6].to_vec()).collect();
    let mut solver = value::solver(&plan, &Cpu::new()).expect("the CPU compiles everything");
    let together = march(&mut solver, &plan, &starts).expect("the CPU works");
    for (row, found) in rows.iter().zip(&together) {
        let (job, solved) = found.as_ref().expect("solved");
        assert_eq!(job.path.horizon(), 20.0);
        assert_eq!(job.path.start(), &row[..6]);
        let error = (solved.value - row[6]).abs() / row[6];
        assert!(error <= PUBLISHED, "{} not {}", solved.value, row[6]);
    }
    let alone = march(&mut solver, &plan, &starts[3..4]).expect("the CPU works");
    let (a, b) = (
        alone[0].as_ref().expect("solved"),
        together[3].as_ref().expect("solved"),
    );
    assert_eq!(a.1.value.to_bits(), b.1.value.to_bits());
    assert_eq!(a.0.path, b.0.path);
}

/// Uncontrolled, the state is infinite after 0.055: without a good guess nothing holds it for T =
/// 5. V is that of the infinite horizon but for exp(-2 T): V' = x^3 + x sqrt(x^4 + 1), integrated
/// here by Simpson's rule.
#[test]
fn a_state_that_escapes_is_held() {
    let text = r#"
        states = { x = {} }
        controls = { u = {} }
        dynamics = { x = "x^3 + u" }
        cost = { running = "0.5*(x^2 + u^2)", terminal = "0", final_time = HORIZON }
        region = { x = [-4, 4] }
    "#;
    let slope = |x: f64| x.powi(3) + x * (x.powi(4) + 1.0).sqrt();
    let points = [3.0, -1.0, 0.2];
    let (_, answers) = solved(&with_horizon(text, 18.0), &points);
    for (k, x) in points.iter().enumerate() {
        let count = 20_000;
        let h = x / f64::from(count);
        let exact: f64 = (0..count)
            .map(|q| {
                let a = f64::from(q) * h;
                h / 6.0 * (slope(a) + 4.0 * slope(a + 0.5 * h) + slope(a + h))
            })
            .sum();
        let entry = given(&answers, k).unwrap_or_else(|| panic!("{x} is not solved"));
        let error = (entry.value - exact).abs() / exact;
        assert!(
            error <= EXACT,
            "V({x}) = {} not {exact}: {error:.1e}",
            entry.value
        );
    }
}

/// A chain of tanks in `n` states, linear, with the quadratic cost of all of them; `ending` is its
/// horizon.
fn chain(n: usize, ending: &str, more: &str) -> String {
    let each = |f: &dyn Fn(usize) -> String| (0..n).map(f).collect::<Vec<_>>().join(", ");
    let neighbour = |i: usize| {
        if i > 0 {
            format!(" + x{}", i - 1)
        } else {
            String::new()
        }
    };
    format!(
        "states = {{ {} }}\ncontrols = {{ u = {{}} }}\ndynamics = {{ {} }}\ncost = {{ running = \"0.5*({} + u^2)\"{} }}\n\
         region = {{ {} }}\n{more}\n",
        each(&|i| format!("x{i} = {{}}")),
        each(&|i| format!(
            "x{i} = \"-2*x{i}{} + {}\"",
            neighbour(i),
            if i == 0 { "u" } else { "0" }
        )),
        (0..n)
            .map(|i| format!("x{i}^2"))
            .collect::<Vec<_>>()
            .join(" + "),
        ending,
        each(&|i| format!("x{i} = [-1, 1]")),
    )
}

fn at_rest(n: usize) -> String {
    let rest = (0..n)
        .map(|i| format!("x{i} = 0"))
        .collect::<Vec<_>>()
        .join(", ");
    format!("equilibrium = {{ {rest}, u = 0 }}")
}

fn linear_chain(n: usize) -> Linear {
    Linear {
        a: DMatrix::from_fn(n, n, |i, j| match (i, j) {
            (i, j) if i == j => -2.0,
            (i, j) if i == j + 1 => 1.0,
            _ => 0.0,
        }),
        b: DMatrix::from_fn(n, 1, |i, _| if i == 0 { 1.0 } else { 0.0 }),
        q: DMatrix::identity(n, n),
        r: diagonal(&[1.0]),
    }
}

/// More states than any sweep has: on both horizons, against the Riccati equation.
#[test]
fn fourteen_states_need_no_sweep() {
    let n = 14;
    let points: Vec<f64> = (0..3 * n)
        .map(|k| ((k * k + 3 * k) as f64 * 0.271).sin())
        .collect();
    let chained = linear_chain(n);
    // The rates are about -2: after 20 nothing is left to f64.
    for (ending, more, time) in [
        (", terminal = \"0\", final_time = 2.5", String::new(), 2.5),
        ("", at_rest(n), 20.0),
    ] {
        let model = parse(&chain(n, ending, &more));
        let (plan, answers) = solved(&model, &points);
        assert!(!plan.can_be_swept());
        let [p, _] = chained.with_time(DMatrix::zeros(n, n), time);
        for (k, x) in points.chunks(n).enumerate() {
            let exact = form(&p, x);
            let entry = given(&answers, k).expect("solved");
            // On the infinite horizon answers are asked to 1e-9 of a trajectory.
            let bound = if plan.local.is_some() { 1e-8 } else { EXACT };
            let error = (entry.value - exact).abs() / exact;
            assert!(error <= bound, "{} not {exact}: {error:.1e}", entry.value);
        }
    }
}

fn costate(name: &str, command: &str, scene: &str, csv: Option<&str>) -> (Output, PathBuf) {
    let folder =
        std::env::temp_dir().join(format!("costate-horizons-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let (file, points, out) = (
        folder.join("scene.toml"),
        folder.join("points.csv"),
        folder.join("out.h5"),
    );
    std::fs::write(&file, scene).unwrap();
    let mut asked = Command::new(env!("CARGO_BIN_EXE_costate"));
    asked
        .arg(command)
        .arg(&file)
        .args(["--backend", "cpu", "--json", "--out"])
        .arg(&out);
    if let Some(csv) = csv {
        std::fs::write(&points, csv).unwrap();
        asked.arg("--points").arg(&points);
    }
    (asked.output().unwrap(), out)
}

#[test]
fn sweeps_have_a_limit_that_is_said_with_the_way_out() {
    let sweep = "shoot_out = { spacing = 0.5, samples = 8 }";
    let ending = ", terminal = \"0\", final_time = 2.5";
    for (name, n, ending, more, words) in [
        (
            "finite",
            8,
            ending,
            sweep.to_owned(),
            "at most 7 on this horizon",
        ),
        (
            "infinite",
            11,
            "",
            format!("{}\nshoot_out = {{ value_max = 1.0 }}", at_rest(11)),
            "at most 10 on this horizon",
        ),
    ] {
        let scene = chain(n, ending, &more);
        let (done, out) = costate(name, "run", &scene, None);
        let text = String::from_utf8_lossy(&done.stderr).replace('\n', " ");
        assert_eq!(done.status.code(), Some(2), "{text}");
        for word in [words, "costate solve --points", &format!("{n} states")] {
            assert!(text.contains(word), "no `{word}` in {text}");
        }
        assert!(!out.exists());
        // The same scene's single states are solved; published values beside them are no error.
        let header: Vec<String> = (0..n).map(|i| format!("x{i}")).collect();
        let csv = format!(
            "{},V_published\n{}1.5\n",
            header.join(","),
            "0.5,".repeat(n)
        );
        let (done, out) = costate(name, "solve", &scene, Some(&csv));
        let text = String::from_utf8_lossy(&done.stderr).into_owned();
        assert_eq!(done.status.code(), Some(0), "{text}");
        assert!(text.contains("V_published"), "{text}");
        let summary: serde_json::Value = serde_json::from_slice(&done.stdout).unwrap();
        assert_eq!(summary["homotopy"]["status"]["converged"], 1, "{summary}");
        assert_eq!(summary["trajectories"], 0, "nothing is swept");
        assert!(out.exists());
    }
}
