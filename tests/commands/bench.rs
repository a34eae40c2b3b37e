//! `costate bench`: the errors it reports against an exact value function, the table as its readers
//! see it, refusals. Times are only looked at for being there: a test says nothing about speed.

use crate::common_commands::checked_by;
use crate::common_oracles;

use common_oracles::{derive, dot, scene};
use costate::backend::Backend;
use costate::backend::cpu::Cpu;
use costate::low_level::model::{Method, Model, Precision};
use costate::low_level::sweep::{Choices, Plan};
use costate_bench::errors::{Meter, compare};
use costate_bench::reference::{Reference, Slopes, points};
use costate_bench::{Options, Steps, Wanted, Work, measure};
use nalgebra::{DMatrix, DVector};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn work(model: &Model, count: usize, store: bool) -> Work {
    let choices = Choices {
        precision: Some(Precision::F64),
        ..Choices::default()
    };
    let plan =
        Plan::new(model, &derive(model), &Cpu::new(), choices).unwrap_or_else(|e| panic!("{e}"));
    Work::new(plan, model, count, 0, store).unwrap_or_else(|e| panic!("{e}"))
}

/// P of a linear-quadratic scene, where `V = x'Px/2` everywhere.
fn exact(work: &Work) -> DMatrix<f64> {
    work.plan
        .local
        .as_ref()
        .expect("an infinite horizon")
        .riccati
        .p
        .clone()
}

/// V and p at a state.
fn on_manifold(p: &DMatrix<f64>, x: &[f64]) -> (f64, Vec<f64>) {
    let costate = p * DVector::from_column_slice(x);
    (
        0.5 * dot(x, costate.as_slice()),
        costate.as_slice().to_vec(),
    )
}

/// What the neighbours tell of dp/dx, where it is P. Their differences keep about six digits
/// ([`reference`]).
const SLOPE_DIGITS: f64 = 1e-5;

#[test]
fn slopes_of_a_quadratic_value_function_are_its_matrix() {
    let model = scene("linear_quadratic", &[]);
    let work = work(&model, 40, true);
    let meter = Meter::new(&work);
    let reference = Reference::new(&work, &meter, Method::Tsit5, 40).unwrap();
    let slopes = Slopes::new(&work, &reference, 40).unwrap();
    let (p, w) = (exact(&work), &work.plan.widths);
    let (n, levels) = (work.states(), reference.result.levels);
    let largest = (0..n * n)
        .map(|k| (p[(k / n, k % n)] * w[k / n] * w[k % n]).abs())
        .fold(0.0, f64::max);
    let mut known = 0;
    for i in 0..slopes.count {
        for level in 0..levels {
            let Some(slope) = slopes.at(i, level) else {
                continue;
            };
            known += 1;
            for (k, s) in slope.iter().enumerate() {
                let (a, b) = (k / n, k % n);
                let error = (s - w[a] * p[(a, b)] * w[b]).abs() / largest;
                assert!(
                    error < SLOPE_DIGITS,
                    "trajectory {i}, level {level}: off by {error:e}"
                );
            }
        }
    }
    assert_eq!(known, reference.samples(), "every sample has a slope");
}

/// Results of known errors: moved along the manifold, off it in V, off it in p.
#[test]
fn only_errors_off_the_manifold_are_counted() {
    let model = scene("linear_quadratic", &[]);
    let work = work(&model, 30, true);
    let meter = Meter::new(&work);
    let reference = Reference::new(&work, &meter, Method::Tsit5, 30).unwrap();
    let slopes = Slopes::new(&work, &reference, 30).unwrap();
    let (p, n) = (exact(&work), work.states());
    let itself = compare(&work, &meter, &reference, Some(&slopes), &reference.result);
    assert_eq!(
        (itself.value.worst, itself.costate.worst, itself.compared),
        (0.0, 0.0, 1.0)
    );

    // A ten-thousandth further out along the manifold: of V <= 1 this leaves 1e-8 V, of p nothing
    // but the slopes' digits.
    const MOVED: f64 = 1e-4;
    let change = |shift: f64, v: f64, costate: f64| {
        let mut result = reference.result.clone();
        for sample in result.samples.chunks_mut(1 + result.dim) {
            let x: Vec<f64> = sample[1..=n].iter().map(|x| x * (1.0 + shift)).collect();
            let (value, slope) = on_manifold(&p, &x);
            sample[1..=n].copy_from_slice(&x);
            sample[1 + n..=2 * n].copy_from_slice(&slope);
            sample[1 + n] += costate;
            sample[1 + 2 * n] = value + v;
        }
        compare(&work, &meter, &reference, Some(&slopes), &result)
    };
    let along = change(MOVED, 0.0, 0.0);
    assert!(along.value.worst < 1.1 * MOVED * MOVED, "{:?}", along.value);
    assert!(
        along.value.worst > 0.9 * MOVED * MOVED,
        "V reaches 1, and so does its curvature"
    );
    assert!(
        along.costate.worst < MOVED * SLOPE_DIGITS * 10.0,
        "{:?}",
        along.costate
    );
    // All samples have V <= 1.
    let off = change(MOVED, 1e-3, 0.0);
    assert!(
        (off.value.median / 1e-3 - 1.0).abs() < 1e-4 && (off.value.worst / 1e-3 - 1.0).abs() < 1e-4
    );
    // p is taken in units of cost: times the region's width, 2 here; relative to max(1, |p|).
    let off = change(0.0, 0.0, 1e-3);
    assert!(
        off.costate.worst <= 2e-3 * 1.001 && off.costate.worst > 0.2e-3,
        "{:?}",
        off.costate
    );
    // H changes by p' of the first component, x1' = v1: seen too.
    assert!(off.hamiltonian.worst > 1e-6);

    // A result with holes is not complete; one that failed is counted.
    let mut holes = reference.result.clone();
    let width = holes.levels * (1 + holes.dim);
    holes.samples[..3 * width].fill(f64::NAN);
    let found = compare(&work, &meter, &reference, None, &holes);
    assert!((found.compared - 0.9).abs() < 1e-12 && found.failed == 0 && !found.complete());
    let mut failed = reference.result.clone();
    failed.status[4] = costate::backend::Status::StepFloor;
    // It came as far as its reference: nothing is lost.
    let found = compare(&work, &meter, &reference, None, &failed);
    assert!(found.failed == 0 && found.complete() && found.compared == 1.0);
    let row = 1 + failed.dim;
    let last = (4 * failed.levels + failed.levels - 1) * row;
    failed.samples[last..last + row].fill(f64::NAN);
    let found = compare(&work, &meter, &reference, None, &failed);
    assert!(found.failed == 1 && !found.complete());
    // Nor is one right that goes on where its reference has ended.
    let mut ended = Reference::new(&work, &meter, Method::Tsit5, 30).unwrap();
    let first = (4 * failed.levels + failed.levels - 4) * row;
    ended.result.samples[first..first + 4 * row].fill(f64::NAN);
    let found = compare(&work, &meter, &ended, None, &reference.result);
    assert!(found.failed == 1 && !found.complete());
}

/// e_V of an integration against the true error of V at the states reached: they differ by the
/// seeds' rounding, the reference's error and the second order of the distance along the manifold,
/// all far below the error itself here.
#[test]
fn the_reported_error_is_the_true_one() {
    let model = scene("linear_quadratic", &[]);
    let work = work(&model, 100, true);
    let meter = Meter::new(&work);
    let reference = Reference::new(&work, &meter, Method::Dop853, 100).unwrap();
    let p = exact(&work);
    let n = work.states();
    let mut kernel = Cpu::new()
        .compile(&work.spec(Method::Tsit5, Precision::F64))
        .unwrap();
    let run = work.run(Steps::Tolerance(1e-4));
    let pass = work
        .integrate(kernel.as_mut(), &run, &work.seeds, usize::MAX)
        .unwrap();
    let result = points(pass.kept);
    let reported = compare(&work, &meter, &reference, None, &result)
        .value
        .worst;
    let truth = (result
        .samples
        .chunks(1 + result.dim)
        .filter(|s| !s[0].is_nan()))
    .map(|s| (s[1 + 2 * n] - on_manifold(&p, &s[1..=n]).0).abs() / s[1 + 2 * n].max(1.0))
    .fold(0.0, f64::max);
    assert!(truth > 1e-7, "an error to speak of: {truth:e}");
    assert!(
        (reported / truth - 1.0).abs() < 0.05,
        "reported {reported:e}, true {truth:e}"
    );
    assert!(
        pass.kernel_seconds
            .is_some_and(|s| s > 0.0 && s <= pass.seconds)
    );
}

#[test]
fn ends_and_finite_horizons_have_errors_too() {
    let model = scene("finite_horizon", &[]);
    for store in [true, false] {
        let work = work(&model, 50, store);
        let backends: Vec<Box<dyn Backend>> = vec![Box::new(Cpu::new())];
        let options = Options {
            wanted: Wanted {
                precisions: vec![Precision::F64],
                methods: vec![Method::Tsit5],
                tolerances: vec![1e-3, 1e-7],
            },
            repeats: 2,
            budget: 1e3,
        };
        let bench =
            measure(&work, &backends, &options, &mut |_| {}).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!((bench.rows.len(), bench.rounds), (2, 2));
        for row in &bench.rows {
            assert!(row.errors.complete() && row.seconds.len() == 2);
            let e = &row.errors;
            assert!(
                e.value.worst.is_finite()
                    && e.costate.worst.is_finite()
                    && e.hamiltonian.worst.is_finite()
            );
            assert_eq!(row.statuses.iter().sum::<usize>(), 50);
        }
        // The right-hand side is linear with a nilpotent matrix: a method of order 5 makes no error
        // but rounding.
        assert!(bench.rows.iter().all(|r| r.errors.value.worst < 1e-12));
    }
}

/// More time than there is: what was begun is done once, and what was not is said.
#[test]
fn a_small_budget_measures_what_it_can() {
    let model = scene("pendulum", &[]);
    let work = work(&model, 64, true);
    let backends: Vec<Box<dyn Backend>> = vec![Box::new(Cpu::new())];
    let options = Options {
        wanted: Wanted::default(),
        repeats: 50,
        budget: 1e-6,
    };
    let bench = measure(&work, &backends, &options, &mut |_| {}).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(bench.rounds, 1);
    assert_eq!(
        bench.rows.len(),
        2 * Method::ALL.len(),
        "the roughest of each series"
    );
    assert_eq!(
        bench.missing.len(),
        bench.rows.len(),
        "the rest of each series is named"
    );
    assert!(
        bench.missing.iter().all(|m| m.why.contains("budget")),
        "{:?}",
        bench.missing
    );
}

fn folder(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("costate-bench-{name}-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&path);
    std::fs::create_dir_all(&path).unwrap();
    path
}

fn scenario(name: &str) -> PathBuf {
    Path::new(crate::ROOT).join("scenarios").join(name)
}

fn bench(scene: &Path, out: &Path, options: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_costate"))
        .arg("bench")
        .arg(scene)
        .arg("--out")
        .arg(out)
        .args(options)
        .output()
        .unwrap()
}

fn summary(done: &Output) -> serde_json::Value {
    assert_eq!(
        done.status.code(),
        Some(0),
        "{}",
        String::from_utf8_lossy(&done.stderr)
    );
    serde_json::from_slice(&done.stdout).unwrap()
}

/// Every backend there is, as a user runs it; the file as xarray's engines see it.
#[test]
fn the_table_opens_in_xarray_and_agrees_with_the_summary() {
    let folder = folder("table");
    let out = folder.join("sub/table.h5");
    let options = "--json --backend cpu,gpu --trajectories 200 --repeats 3 --rtol 1e-3,1e-5,1e-7 --error 2e-2 --host-share=60";
    let done = bench(
        &scenario("pendulum.toml"),
        &out,
        &options.split(' ').collect::<Vec<_>>(),
    );
    let summary = summary(&done);
    std::fs::write(folder.join("summary.json"), &done.stdout).unwrap();
    let rows = summary["rows"].as_array().unwrap();
    let backends: Vec<&str> = rows
        .iter()
        .map(|r| r["backend"].as_str().unwrap())
        .collect();
    assert!(
        backends.contains(&"cpu") && backends.contains(&"gpu"),
        "{backends:?}"
    );
    for method in Method::ALL {
        assert!(
            rows.iter().any(|r| r["method"] == method.0),
            "no {}",
            method.0
        );
    }
    // A wanted error that every method reaches has a recommendation, and one that holds.
    let wanted = summary["recommended"].as_array().unwrap();
    let loose = wanted.iter().find(|w| w["error"] == 2e-2).unwrap();
    assert!(loose["variant"]["errors"]["e_V"]["worst"].as_f64().unwrap() <= 2e-2);
    let text = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(
        text.contains("[integrator]") && text.contains("for V to 2e-2"),
        "{text}"
    );
    assert_eq!(summary["host_share"][0]["trajectories"], 60);
    let mut left: Vec<_> = std::fs::read_dir(out.parent().unwrap())
        .unwrap()
        .map(|e| e.unwrap().file_name())
        .collect();
    left.sort();
    assert_eq!(left, ["table.h5", "table.svg"], "nothing else is left");

    checked_by("check_bench.py", &[&out, &folder.join("summary.json")]);
}

/// The lines that are recommended are a scenario's: a run with them is accepted and uses them.
#[test]
fn what_is_recommended_can_be_run() {
    let folder = folder("recommended");
    let out = folder.join("bench.h5");
    let options = "--json --backend cpu --trajectories 100 --repeats 1 --rtol 1e-6 --method tsit5 --precision f64";
    let summary = summary(&bench(
        &scenario("linear_quadratic.toml"),
        &out,
        &options.split(' ').collect::<Vec<_>>(),
    ));
    let lines: Vec<&str> = (summary["recommended"][0]["integrator"]
        .as_array()
        .unwrap()
        .iter())
    .map(|l| l.as_str().unwrap())
    .collect();
    let text = std::fs::read_to_string(scenario("linear_quadratic.toml")).unwrap();
    assert!(!text.contains("[integrator]"));
    let file = folder.join("scene.toml");
    std::fs::write(&file, format!("{text}\n{}\n", lines.join("\n"))).unwrap();
    let done = Command::new(env!("CARGO_BIN_EXE_costate"))
        .args(["shoot-out", "--backend", "cpu", "--json"])
        .arg(&file)
        .arg("--out")
        .arg(folder.join("run.h5"))
        .output()
        .unwrap();
    let run: serde_json::Value = serde_json::from_slice(&done.stdout).unwrap();
    assert_eq!(
        (&run["rtol"], &run["precision"], &run["method"]),
        (&1e-6.into(), &"f64".into(), &"tsit5".into())
    );
    assert_eq!(run["atol"], summary["recommended"][0]["variant"]["atol"]);
}

/// The same seeds give the same errors, to the last bit; others do not.
#[test]
fn a_bench_is_reproducible() {
    let folder = folder("again");
    let errors = |seed: &str| {
        let options = format!(
            "--json --backend cpu --trajectories 80 --repeats 1 --rtol 1e-4 --method tsit5 --seed {seed}"
        );
        let out = folder.join("bench.h5");
        let done = bench(
            &scenario("pendulum.toml"),
            &out,
            &options.split(' ').collect::<Vec<_>>(),
        );
        let rows = summary(&done)["rows"].clone();
        rows.as_array()
            .unwrap()
            .iter()
            .map(|r| r["errors"].clone())
            .collect::<Vec<_>>()
    };
    assert_eq!(errors("1"), errors("1"));
    assert_ne!(errors("1"), errors("2"));
}

const GAME: &str = r#"
states = { x = {} }
controls = { u = {} }
disturbances = { w = {} }
dynamics = { x = "x + u + w" }
cost = { running = "0.5*(x^2 + u^2 - 0.25*w^2)" }
equilibrium = { x = 0, u = 0 }
region = { x = [-1, 1] }
shoot_out = { value_max = 1.0 }
"#;

#[test]
fn what_cannot_be_measured_is_refused_and_nothing_is_written() {
    let folder = folder("refused");
    let game = folder.join("game.toml");
    std::fs::write(&game, GAME).unwrap();
    let pendulum = scenario("pendulum.toml");
    let out = folder.join("out.h5");
    for (scene, options, status, words) in [
        (&pendulum, "--method euler", 2, "the methods are rk4, tsit5"),
        (&pendulum, "--trajectories 0", 2, "whole number"),
        (&pendulum, "--rtol 2", 2, "relative tolerance"),
        (&pendulum, "--budget -3", 2, "seconds, above 0"),
        (&pendulum, "--repeats 0", 2, "--repeats"),
        (&pendulum, "--backend abacus", 2, "possible values"),
        (&pendulum, "--set no_such=1", 2, "no_such"),
        (&pendulum, "--host-share=many", 2, "whole number"),
        (&game, "--backend cpu", 2, "attenuation"),
        (
            &folder.join("absent.toml"),
            "--backend cpu",
            2,
            "absent.toml",
        ),
        (
            &pendulum,
            "--backend gpu --adapter no-such-adapter",
            2,
            "no-such-adapter",
        ),
        // Nothing that f32 can resolve.
        (
            &pendulum,
            "--backend cpu --precision f32 --method tsit5 --rtol 1e-9",
            1,
            "nothing is left to measure",
        ),
    ] {
        let done = bench(scene, &out, &options.split(' ').collect::<Vec<_>>());
        let text = String::from_utf8_lossy(&done.stderr).into_owned();
        assert_eq!(done.status.code(), Some(status), "{options}: {text}");
        assert!(text.contains(words), "{options}: no `{words}` in: {text}");
        assert!(done.stdout.is_empty(), "{options}");
        let left = std::fs::read_dir(&folder).unwrap().count();
        assert_eq!(left, 1, "{options}: something beside the scene is left");
    }
    // The picture would take the table's name.
    let done = bench(&pendulum, &folder.join("table.svg"), &["--backend", "cpu"]);
    let text = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(
        done.status.code() == Some(2) && text.contains("name the table .h5"),
        "{text}"
    );
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1);
}

/// A scene that asks for no sweep has trajectories all the same.
#[test]
fn a_scene_without_a_sweep_is_measured_over_its_region() {
    let folder = folder("unasked");
    let file = folder.join("scene.toml");
    std::fs::write(
        &file,
        GAME.replace("disturbances = { w = {} }\n", "")
            .replace(" + w", "")
            .replace(" - 0.25*w^2", "")
            .replace("shoot_out = { value_max = 1.0 }\n", ""),
    )
    .unwrap();
    let out = folder.join("out.h5");
    let options =
        "--json --backend cpu --trajectories 10 --repeats 1 --rtol 1e-6 --method tsit5 --ends";
    let summary = summary(&bench(&file, &out, &options.split(' ').collect::<Vec<_>>()));
    // One state: p = (1 + sqrt 2) x exactly, and the flow alone tells the slope.
    let errors = &summary["rows"]
        .as_array()
        .unwrap()
        .iter()
        .find(|r| r["precision"] == "f64")
        .unwrap()["errors"];
    assert!(
        errors["e_V"]["worst"].as_f64().unwrap() < 1e-5
            && errors["e_p"]["worst"].as_f64().unwrap() < 1e-5
    );
    assert_eq!(errors["compared"], 1.0);
}
