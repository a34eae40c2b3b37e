//! Fitted laws: against problems whose answer is known, and their exports against the laws
//! themselves.

mod exports;
mod refusals;
mod support;

use crate::common_problems::{Exact, manufactured};
use costate::backend::Deadline;
use costate::low_level::feedback::{Data, FittedLaw, Law, Samples, fit};
use costate::low_level::hamiltonian::Hamiltonian;
use costate::low_level::model::{Feedback, Model};
use costate::low_level::numeric::random::random;
use std::path::Path;
use std::process::Command;
use support::{Points, output, scratch};

/// x'' = u with L = (x^2 + v^2 + u^2)/2: P = [[sqrt 3, 1], [1, sqrt 3]], K = [1, sqrt 3] (by hand
/// from the Riccati equation).
const DOUBLE_INTEGRATOR: &str = r#"
states = { x = {}, v = {} }
controls = { u = { min = -1.5 } }
dynamics = { x = "v", v = "u" }
cost = { running = "0.5*(x^2 + v^2 + u^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-1, 1], v = [-1, 1] }
"#;

fn scene(text: &str, feedback: &str) -> (Model, Hamiltonian) {
    let text = format!("{text}\n{feedback}");
    let model = costate::low_level::scenario::parse(&text, "scene.toml", &[])
        .unwrap_or_else(|e| panic!("{e}"));
    let hamiltonian = Hamiltonian::derive(&model).unwrap();
    (model, hamiltonian)
}

/// Samples in the box (-1, 1)^2, ten on each "trajectory", of a value function and its gradient and
/// control.
fn samples(count: usize, scale: f64, of: impl Fn([f64; 2]) -> (f64, [f64; 2], f64)) -> Samples {
    let mut samples = Samples {
        states: 2,
        controls: 1,
        ..Samples::default()
    };
    let unit = |k: u64| scale * (random(7, k) as f64 / 2f64.powi(63) - 1.0);
    for k in 0..count as u64 {
        let x = [unit(2 * k), unit(2 * k + 1)];
        let (v, p, u) = of(x);
        samples.x.extend(x);
        samples.p.extend(p);
        samples.u.push(u);
        samples.v.push(v);
        samples.trajectory.push(k as u32 / 10);
    }
    samples
}

fn linear_quadratic(count: usize) -> Samples {
    let r = 3f64.sqrt();
    // Within |u| <= 1 + sqrt 3 of the box the bound at -1.5 would act; data are taken where it does
    // not.
    samples(count, 0.5, |[x, v]| {
        let p = [r * x + v, x + r * v];
        (0.5 * (x * p[0] + v * p[1]), p, -p[1])
    })
}

fn unknown(_: &[f64], _: f64) -> Option<bool> {
    None
}

fn fitted(
    model: &Model,
    hamiltonian: &Hamiltonian,
    samples: &Samples,
    law: &Feedback,
) -> FittedLaw {
    let data = Data {
        model,
        hamiltonian,
        samples,
        known: &unknown,
        deadline: Deadline::default(),
    };
    fit(data, model, law, &|_| {}).unwrap_or_else(|e| panic!("{e}"))
}

#[test]
fn the_linear_law_is_found() {
    let text = r#"
        [feedback.affine]
        fit = "u"
        hidden = []
        [feedback.tanh]
        fit = "u"
        hidden = [6]
        activation = "tanh"
        starts = 2
        [feedback.local]
        fit = "u"
        base = "local"
        hidden = [3]
        starts = 1
    "#;
    let (model, hamiltonian) = scene(DOUBLE_INTEGRATOR, text);
    let data = linear_quadratic(600);
    let laws: Vec<FittedLaw> = (model.feedback.iter())
        .map(|law| fitted(&model, &hamiltonian, &data, law))
        .collect();
    // An affine map is the law itself. Six units of tanh in [-0.5, 0.5]^2 come within their
    // approximation error.
    for (law, bound) in laws.iter().zip([1e-12, 2e-4, 1e-8]) {
        assert!(
            law.quality.u.mean < bound,
            "{}: {:?}",
            law.name,
            law.quality.u
        );
        assert!(
            law.quality.u.max < 20.0 * bound,
            "{}: {:?}",
            law.name,
            law.quality.u
        );
    }
    let affine = &laws[0].law.network.layers[0];
    for (weight, expected) in affine.weights.iter().zip([-1.0, -3f64.sqrt()]) {
        assert!((weight - expected).abs() < 1e-12, "{weight} {expected}");
    }
    // Pinned: exactly the local law's value at the equilibrium, whatever the network does.
    assert!(laws[2].law.eval(&[0.0, 0.0])[0].abs() < 1e-15);
    // The scene's bound is applied: -K x at (1, 1) is -2.73.
    let form = &laws[0].form;
    let at = form.x.iter().copied().zip([1.0, 1.0]).collect();
    assert_eq!(form.graph.eval(&form.commands, &at), [-1.5]);
}

#[test]
fn the_quadratic_value_function_is_found() {
    let text = "feedback = { fit = \"V\", base = \"none\", hidden = [8], activation = \"tanh\", starts = 2 }";
    let (model, hamiltonian) = scene(text, DOUBLE_INTEGRATOR);
    let law = fitted(
        &model,
        &hamiltonian,
        &linear_quadratic(600),
        &model.feedback[0],
    );
    let (v, p) = (law.quality.v.unwrap(), law.quality.p.unwrap());
    // V itself is quadratic, which eight units only approximate; with the local solution nothing is
    // left to fit.
    assert!(v.mean < 1e-3 && p.mean < 1e-3, "{v:?} {p:?}");
    let text = "feedback = { fit = \"V\", hidden = [3], starts = 1 }";
    let (model, hamiltonian) = scene(text, DOUBLE_INTEGRATOR);
    let law = fitted(
        &model,
        &hamiltonian,
        &linear_quadratic(600),
        &model.feedback[0],
    );
    let quality = law.quality;
    assert!(
        quality.u.max < 1e-7 && quality.v.unwrap().max < 1e-7,
        "{quality:?}"
    );
    assert!(quality.hjb.unwrap().max < 1e-7, "{quality:?}");
}

/// Of H = ... + u^2/2 a control that is off by d loses d^2/2.
#[test]
fn the_loss_is_that_of_the_hamiltonian() {
    let text = "feedback = { fit = \"u\", hidden = [3], starts = 1, iterations = 4 }";
    let (model, hamiltonian) = scene(text, DOUBLE_INTEGRATOR);
    let data = linear_quadratic(600);
    let law = fitted(&model, &hamiltonian, &data, &model.feedback[0]);
    let test = data
        .select(&model, &model.feedback[0], &unknown)
        .0
        .split(&model.feedback[0])
        .test;
    let loss = law.quality.loss.unwrap();
    let places = || (0..test.len()).map(|k| (test.x_of(k), test.u_of(k)[0]));
    let running = |([x, v], u): ([f64; 2], f64)| 0.5 * (x * x + v * v + u * u);
    let scale = places()
        .map(|(x, u)| running(([x[0], x[1]], u)))
        .sum::<f64>()
        / test.len() as f64;
    let mut lost: Vec<(f64, &[f64])> = places()
        .map(|(x, u)| (0.5 * (law.law.eval(x)[0].max(-1.5) - u).powi(2) / scale, x))
        .collect();
    lost.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (largest, at) = lost[lost.len() - 1];
    // H is a sum of terms of about 1, of which 1e-16 is lost.
    let close = |a: f64, b: f64| (a - b).abs() < 1e-14 / scale;
    assert!(largest > 1e-6, "the law is not exact: {largest}");
    assert!(
        close(loss.max, largest) && close(loss.scale, scale),
        "{loss:?} {largest} {scale}"
    );
    assert!(
        close(
            loss.q99,
            lost[(0.99 * lost.len() as f64).ceil() as usize - 1].0
        ),
        "{loss:?}"
    );
    assert!(close(
        loss.mean,
        lost.iter().map(|l| l.0).sum::<f64>() / lost.len() as f64
    ));
    assert_eq!(loss.at, at);
    for ([lower, upper], x) in loss.worst.iter().zip(at) {
        assert!(lower <= x && x <= upper);
    }
}

/// V, its gradient and u of `scenarios/manufactured.toml`.
fn manufactured(x: [f64; 2]) -> (f64, [f64; 2], f64) {
    let Exact { v, p, u } = manufactured::at(&x);
    (v, [p[0], p[1]], u[0])
}

/// H(x, p) of that scene, by hand.
fn manufactured_h([x, y]: [f64; 2], p: [f64; 2]) -> f64 {
    let (_, q, _) = manufactured([x, y]);
    let (ax, ay) = (-x + y.sin(), x * y - 0.5 * x.sin());
    let rest = -(q[0] * ax + q[1] * ay) + q[1] * q[1] / (2.0 * 0.5);
    p[0] * ax + p[1] * ay - p[1] * p[1] / (2.0 * 0.5) + rest
}

#[test]
fn a_known_value_function_is_fitted_with_its_gradient() {
    let text = include_str!("../../../scenarios/manufactured.toml");
    let feedback = "[feedback]\nfit = \"V\"\nhidden = [14]\nactivation = \"tanh\"\nstarts = 2\niterations = 200\n\
                    box = { x = [-1, 1], y = [-1, 1] }";
    let (model, hamiltonian) = scene(text, feedback);
    let law = fitted(
        &model,
        &hamiltonian,
        &samples(2000, 1.0, manufactured),
        &model.feedback[0],
    );
    let (v, p, hjb) = (
        law.quality.v.unwrap(),
        law.quality.p.unwrap(),
        law.quality.hjb.unwrap(),
    );
    // The issue's aim for the residual; V and p are of that order.
    assert!(hjb.median < 1e-4, "{hjb:?}");
    assert!(
        v.mean < 1e-4 && p.mean < 3e-4 && law.quality.u.mean < 3e-4,
        "{v:?} {p:?} {:?}",
        law.quality.u
    );
    // The reports against the truth on a grid, p by differences of the law (h^2 and rounding: 1e-9)
    // and H by hand.
    let (h, mut worst, mut residuals) = (1e-4, 0.0f64, Vec::new());
    let (mut running, mut count) = (0.0, 0.0);
    for i in 0..21 {
        for j in 0..21 {
            let x = [-0.95 + 0.095 * f64::from(i), -0.95 + 0.095 * f64::from(j)];
            let (v, p, u) = manufactured(x);
            let at = |dx: f64, dy: f64| law.law.eval(&[x[0] + dx, x[1] + dy])[0];
            let fitted = [
                (at(h, 0.0) - at(-h, 0.0)) / (2.0 * h),
                (at(0.0, h) - at(0.0, -h)) / (2.0 * h),
            ];
            worst = worst.max((at(0.0, 0.0) - v).abs());
            residuals.push(manufactured_h(x, fitted).abs());
            // L = -p'f on the solution.
            let (ax, ay) = (-x[0] + x[1].sin(), x[0] * x[1] - 0.5 * x[0].sin());
            running += -(p[0] * ax + p[1] * (ay + u));
            count += 1.0;
        }
    }
    residuals.sort_by(f64::total_cmp);
    let median = residuals[residuals.len() / 2] / (running / count);
    assert!(median < 1e-4, "{median}");
    // The same law, other points: their medians are within a factor of three.
    assert!(
        (median / hjb.median).ln().abs() < 3f64.ln(),
        "{median} {hjb:?}"
    );
    assert!(worst < 1e-3, "{worst}");
    // Pinned to second order at the equilibrium.
    assert!(law.law.eval(&[0.0, 0.0])[0].abs() < 1e-13);
    let slope = (law.law.eval(&[1e-4, 0.0])[0] - law.law.eval(&[-1e-4, 0.0])[0]) / 2e-4;
    // Central differences: what is left is h^2 times a third derivative of order 1.
    assert!(slope.abs() < 1e-7, "{slope}");
}

#[test]
fn sets_share_no_trajectory_and_lose_no_sample() {
    let (model, _) = scene(
        DOUBLE_INTEGRATOR,
        "feedback = { fit = \"u\", validation = 0.2, test = 0.1 }",
    );
    let data = linear_quadratic(1000);
    let sets = data.split(&model.feedback[0]);
    let all = [&sets.training, &sets.validation, &sets.test];
    let trajectories = all.map(|s| {
        s.trajectory
            .iter()
            .copied()
            .collect::<std::collections::BTreeSet<u32>>()
    });
    assert_eq!(trajectories.each_ref().map(|t| t.len()), [70, 20, 10]);
    assert_eq!(
        trajectories
            .iter()
            .flatten()
            .collect::<std::collections::BTreeSet<_>>()
            .len(),
        100
    );
    assert_eq!(all.map(|s| s.len()).iter().sum::<usize>(), 1000);
}

#[test]
fn the_same_seed_gives_the_same_law_on_any_number_of_threads() {
    let feedback =
        "feedback = { fit = \"u\", hidden = [4], starts = 3, iterations = 40, max_samples = 300 }";
    let (model, hamiltonian) = scene(DOUBLE_INTEGRATOR, feedback);
    let data = linear_quadratic(900);
    let on = |threads: usize, seed: u64| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        let law = Feedback {
            seed,
            ..model.feedback[0].clone()
        };
        pool.install(|| fitted(&model, &hamiltonian, &data, &law).law)
    };
    let first = on(1, 0);
    assert_eq!(first, on(1, 0));
    assert_eq!(first, on(3, 0));
    assert_ne!(first, on(1, 1));
}

#[test]
fn samples_are_those_of_the_box_moved_by_periods() {
    let text = r#"
        states = { a = { period = "2*pi" }, w = {} }
        controls = { u = {} }
        dynamics = { a = "w", w = "sin(a) + u" }
        cost = { running = "0.5*(sin(a/2)^2 + w^2 + u^2)" }
        equilibrium = { a = 0, w = 0, u = 0 }
        region = { a = [-pi, pi], w = [-1, 1] }
        [feedback]
        fit = "u"
        box = { a = [-3, 3] }
        where = ["a + w > -2", "w <= 0.5"]
        value_max = 2
    "#
    .replace("[-pi, pi]", "[\"-pi\", \"pi\"]");
    let (model, _) = scene(&text, "");
    let turn = 2.0 * std::f64::consts::PI;
    let rows = [
        ([1.0 + turn, 0.1], 1.0, true),
        ([1.0 - 2.0 * turn, 0.1], 1.0, true),
        ([1.0, 0.6], 1.0, false),
        ([-2.5, 0.4], 1.0, false),
        ([3.1, 0.0], 1.0, false),
        ([1.0, 0.2], 2.5, false),
        ([1.0, f64::NAN], 1.0, false),
        ([0.5, -0.3], 0.3, true),
    ];
    let mut data = Samples {
        states: 2,
        controls: 1,
        ..Samples::default()
    };
    for (k, (x, v, _)) in rows.iter().enumerate() {
        data.x.extend(x);
        data.p.extend([0.0, 0.0]);
        data.u.push(0.0);
        data.v.push(*v);
        data.trajectory.push(k as u32);
    }
    let (selected, counts) = data.select(&model, &model.feedback[0], &|_, _| Some(true));
    let expected: Vec<u32> = (0..8).filter(|k| rows[*k as usize].2).collect();
    assert_eq!(selected.trajectory, expected);
    assert_eq!((counts.offered, counts.selected, counts.kept), (8, 3, 3));
    for k in 0..2 {
        // A period is taken off, which costs a few units in the last place of 4 pi.
        assert!((selected.x[2 * k] - 1.0).abs() < 1e-14, "{:?}", selected.x);
        assert_eq!(selected.before_moving()[2 * k], rows[k].0[0]);
    }
}

/// V = min(|x - a|^2, |x + a|^2)/2 with a = (1, 0): the dearer of two sheets that both cover the
/// box is no data.
#[test]
fn the_dearer_of_two_sheets_is_left_out() {
    let (model, _) = scene(DOUBLE_INTEGRATOR, "feedback = { fit = \"u\" }");
    let mut data = Samples {
        states: 2,
        controls: 1,
        ..Samples::default()
    };
    for sheet in [1.0, -1.0] {
        let one = samples(3000, 1.0, |[x, y]| {
            let d = [x - sheet, y];
            (0.5 * (d[0] * d[0] + d[1] * d[1]), d, 0.0)
        });
        // Other states on each sheet, and other trajectories.
        let shift = if sheet > 0.0 { 0 } else { 1000 };
        let (mut x, trajectory) = (one.x, one.trajectory);
        if sheet < 0.0 {
            x.chunks_mut(2).for_each(|x| x.swap(0, 1));
        }
        for (k, x) in x.chunks(2).enumerate() {
            let d = [x[0] - sheet, x[1]];
            data.x.extend(x);
            data.p.extend(d);
            data.v.push(0.5 * (d[0] * d[0] + d[1] * d[1]));
            data.u.push(0.0);
            data.trajectory.push(trajectory[k] + shift);
        }
    }
    let (kept, counts) = data.select(&model, &model.feedback[0], &unknown);
    assert_eq!(counts.selected, 6000);
    // Half of the samples are dearer. One within a neighbour's distance (0.03) of x = 0 cannot be
    // told from the others.
    let dearer = |k: usize| {
        let [x, y] = [kept.x[2 * k], kept.x[2 * k + 1]];
        let best = 0.5 * ((x.abs() - 1.0).powi(2) + y * y);
        kept.v[k] > best + 1e-12
    };
    let left: Vec<usize> = (0..kept.len()).filter(|k| dearer(*k)).collect();
    assert!(left.iter().all(|k| kept.x[2 * k].abs() < 0.1), "{left:?}");
    assert!(left.len() < 100, "{}", left.len());
    assert!(
        counts.not_optimal > 2850 && counts.not_optimal <= 3000,
        "{counts:?}"
    );
    // A word from elsewhere settles it.
    let exact =
        |x: &[f64], v: f64| Some(v <= 0.5 * ((x[0].abs() - 1.0).powi(2) + x[1] * x[1]) + 1e-12);
    let (_, counts) = data.select(&model, &model.feedback[0], &exact);
    assert_eq!(counts.not_optimal + counts.kept, 6000);
}

#[test]
fn thinning_spreads_the_data_over_the_box() {
    let (model, _) = scene(
        DOUBLE_INTEGRATOR,
        "feedback = { fit = \"u\", max_samples = 400 }",
    );
    // Nine tenths of the samples lie in a hundredth of the box.
    let near = samples(9000, 0.1, |x| (0.0, x, 0.0));
    let mut data = samples(1000, 1.0, |x| (0.0, x, 0.0));
    data.x.extend(&near.x);
    data.p.extend(&near.p);
    data.u.extend(&near.u);
    data.v.extend(&near.v);
    data.trajectory
        .extend(near.trajectory.iter().map(|t| t + 1000));
    let (kept, counts) = data.select(&model, &model.feedback[0], &|_, _| Some(true));
    assert_eq!((kept.len(), counts.kept), (400, 400));
    let crowded = kept
        .x
        .chunks(2)
        .filter(|x| x.iter().all(|x| x.abs() <= 0.1))
        .count();
    // Of 20 x 20 cells four lie in the crowded part wholly; some 8 % of the others are empty, which
    // gives it turns more.
    assert!(crowded < 60, "{crowded}");
}

#[test]
fn too_few_data_are_refused() {
    let (model, hamiltonian) = scene(
        DOUBLE_INTEGRATOR,
        "feedback = { fit = \"u\", where = \"x > 0.49\" }",
    );
    let samples = linear_quadratic(20);
    let data = Data {
        model: &model,
        hamiltonian: &hamiltonian,
        samples: &samples,
        known: &unknown,
        deadline: Deadline::default(),
    };
    let message = fit(data, &model, &model.feedback[0], &|_| {})
        .unwrap_err()
        .to_string();
    assert!(
        message.contains("law `network`: of 20 samples"),
        "{message}"
    );
}

/// The summary of `costate fit` on what a command makes of a scene.
fn fitted_by(command: &str, toml: &Path, out: &Path) -> serde_json::Value {
    let costate = || Command::new(env!("CARGO_BIN_EXE_costate"));
    let made = [command, "--backend", "cpu", "--quiet", "--out"];
    output(costate().args(made).arg(out).arg(toml));
    let summary = output(costate().args(["fit", "--json", "--quiet"]).arg(out));
    serde_json::from_str(&summary).unwrap()
}

/// The whole way: a sweep, `costate fit`, the group and the files.
#[test]
fn a_result_file_gets_its_laws() {
    let directory = scratch("file");
    let scene = format!(
        "{DOUBLE_INTEGRATOR}shoot_out = {{ value_max = 0.3, spacing = 0.1, samples = 20 }}\n[feedback]\nfit = \"u\"\nhidden = [4]\nstarts = 2\n"
    );
    let (toml, out) = (directory.join("scene.toml"), directory.join("result.h5"));
    std::fs::write(&toml, &scene).unwrap();
    let costate = || Command::new(env!("CARGO_BIN_EXE_costate"));
    let summary = fitted_by("run", &toml, &out);
    let law = &summary["laws"][0];
    // The bound acts nowhere up to V = 0.3, so the law is linear, which four logistic units
    // approximate.
    assert!(law["u_error"]["mean"].as_f64().unwrap() < 2e-3, "{law}");
    let points = Points::read(&out);
    assert_eq!(points.law, ["network"]);
    assert_eq!(points.error, law["u_error"]["mean"].as_f64().unwrap());
    assert_eq!(points.flops, law["flops"].as_f64().unwrap());
    let written = Law::load(&directory.join("result_network.toml")).unwrap();
    assert_eq!(Law::from_toml(&points.toml, "group").unwrap(), written);
    for extension in ["h", "onnx"] {
        assert!(
            directory
                .join(format!("result_network.{extension}"))
                .is_file()
        );
    }
    // A second fit takes the place of the first; the trajectories are still there.
    let other = directory.join("other.toml");
    std::fs::write(
        &other,
        scene
            .replace("hidden = [4]", "hidden = []")
            .replace("[feedback]", "[feedback.line]"),
    )
    .unwrap();
    let text = output(
        costate()
            .arg("fit")
            .arg(&out)
            .arg("--scene")
            .arg(&other)
            .args(["--seed", "3", "--starts", "1"]),
    );
    assert!(
        text.contains("law line: u: a 2-1 logistic network"),
        "{text}"
    );
    assert_eq!(Points::read(&out).law, ["line"]);
    assert!(
        costate::low_level::result::Stored::open(&out)
            .unwrap()
            .trajectories()
            .unwrap()
            .unwrap()
            .count
            > 3
    );
    // No law, and another problem.
    let fit = || {
        costate()
            .arg("fit")
            .arg(&out)
            .arg("--scene")
            .arg(&other)
            .output()
            .unwrap()
    };
    std::fs::write(&other, scene.split("[feedback]").next().unwrap()).unwrap();
    let refused = fit();
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("asks for no law"));
    std::fs::write(
        &other,
        scene.replace("{ x =", "{ y =").replace("x^2", "y^2"),
    )
    .unwrap();
    let refused = fit();
    assert_eq!(refused.status.code(), Some(2));
    assert!(
        String::from_utf8_lossy(&refused.stderr).contains("are not those of"),
        "{refused:?}"
    );
    std::fs::remove_dir_all(directory).unwrap();
}

/// A file with a map to an error and no sweep: samples are the map's, all over the box, under the
/// law's conditions.
#[test]
fn a_map_gives_the_samples_of_its_laws() {
    let directory = scratch("map");
    let text = include_str!("../../../scenarios/manufactured.toml");
    let (before, _) = text.split_once("[homotopy]").unwrap();
    let scene = format!(
        "{before}[map]\nerror = 1e-4\nfloor = 1e-3\ncheck = 1\nregion = {{ x = [-1.1, 1.1], y = [-1.1, 1.1] }}\n\
         [feedback]\nfit = \"V\"\nhidden = [10]\nactivation = \"tanh\"\nstarts = 1\niterations = 100\nmax_samples = 2000\n\
         box = {{ x = [-1, 1], y = [-1, 1] }}\nwhere = [\"x + y < 1\"]\n"
    );
    let (toml, out) = (directory.join("scene.toml"), directory.join("result.h5"));
    std::fs::write(&toml, &scene).unwrap();
    let summary = fitted_by("homotopy", &toml, &out);
    let sets = summary["laws"][0]["samples"].as_array().unwrap();
    assert_eq!(
        sets.iter().map(|s| s.as_u64().unwrap()).sum::<u64>(),
        2000,
        "{summary}"
    );
    let law = Law::load(&directory.join("result_network.toml")).unwrap();
    let (mut worst, mut count) = (0.0f64, 0);
    for k in 0..400 {
        let x = [
            f64::from(k % 20) / 10.0 - 0.95,
            f64::from(k / 20) / 10.0 - 0.95,
        ];
        if x[0] + x[1] < 1.0 {
            worst = worst.max((law.eval(&x)[0] - manufactured(x).0).abs());
            count += 1;
        }
    }
    println!("largest error of V at {count} states: {worst:.1e}");
    // V is up to 4.
    assert!(worst < 1e-2, "{worst}");
}
