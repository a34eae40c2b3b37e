//! The error that a run tells of itself, against the error that it has.

use crate::common_oracles;
use crate::common_problems::{Exact, manufactured};

use common_oracles::{Asked, F32, F64, Sweep, dot, minus, norm, scene};
use costate::low_level::local::Riccati;
use costate::low_level::model::{Method, Model, Precision};
use costate::low_level::sweep::accuracy::{self, Accuracy, PROMISE, SMALL};
use std::path::PathBuf;
use std::process::{Command, Output};

fn estimate(sweep: &Sweep) -> Accuracy {
    accuracy::estimate(&sweep.plan, &sweep.report.sample).unwrap_or_else(|e| panic!("{e}"))
}

/// Largest true errors of V, p and u over all stored samples, in the estimate's own measure.
fn truth(sweep: &Sweep, right: impl Fn(&[f64]) -> (f64, Vec<f64>, f64)) -> [f64; 3] {
    let plan = &sweep.plan;
    let scaled = |p: &[f64]| {
        norm(
            &p.iter()
                .zip(&plan.widths)
                .map(|(p, w)| p * w)
                .collect::<Vec<_>>(),
        )
    };
    let mut worst = [0.0f64; 3];
    let controls: Vec<f64> = sweep.samples().map(|s| right(s.x).2).collect();
    let range = controls.iter().copied().fold(f64::NEG_INFINITY, f64::max)
        - controls.iter().copied().fold(f64::INFINITY, f64::min);
    for s in sweep.samples() {
        let (v, p, u) = right(s.x);
        let here = [
            (s.v - v).abs() / (v + SMALL * plan.value_scale),
            scaled(&minus(s.p, &p)) / (scaled(&p) + SMALL * plan.value_scale),
            (s.u[0] - u).abs() / range,
        ];
        (0..3).for_each(|k| worst[k] = worst[k].max(here[k]));
    }
    worst
}

/// The sample may miss the worst trajectory, and the reference has errors of its own: a factor each
/// way.
const FACTOR: f64 = 4.0;
/// Below this the true error is the rounding of x as stored, which the estimate, from deviations,
/// does not see.
const ROUNDING: f64 = 1e-13;

/// The estimate begins at the run's own seeds. Their error, which is told beside it, may be a tenth
/// of rtol in V on the first front; in p it is larger by the degree of the first term left out
/// there, some 4 to 6.
const SEEDS: f64 = 0.6;

fn honest(name: &str, model: &Model, asked: Asked, right: impl Fn(&[f64]) -> (f64, Vec<f64>, f64)) {
    let sweep = Sweep::of(model, asked);
    let told = estimate(&sweep);
    let truth = truth(&sweep, right);
    let worst =
        [told.value, told.costate, told.control].map(|s| s.expect("something is compared").worst);
    println!("{name} {asked:?}: told {worst:.2?}, true {truth:.2?}");
    for k in 0..3 {
        assert!(
            worst[k] <= FACTOR * truth[k] + ROUNDING,
            "{name} {asked:?}: {k} is overstated: {worst:?} {truth:?}"
        );
        assert!(
            truth[k] <= FACTOR * worst[k] + SEEDS * asked.rtol + ROUNDING,
            "{name} {asked:?}: {k} is understated: {worst:?} {truth:?}"
        );
    }
    assert!(told.compared > 500 && told.sampled >= 64.min(sweep.count()));
    assert_eq!((told.differ, told.failed), (0, 0));
}

#[test]
fn the_estimate_is_near_the_true_error() {
    let model = scene("manufactured", &[]);
    for (precision, rtol) in [
        (Precision::F64, 1e-3),
        (Precision::F64, 1e-6),
        (Precision::F64, 1e-9),
        (Precision::F32, 1e-3),
        (Precision::F32, 1e-5),
        (Precision::F32, 1e-6),
    ] {
        honest("manufactured", &model, Asked { precision, rtol }, |x| {
            let Exact { v, p, u } = manufactured::at(x);
            (v, p, u[0])
        });
    }
    let model = scene("linear_quadratic", &[]);
    let p = Riccati::solve(&common_oracles::derive(&model), &model)
        .expect("a solution")
        .p;
    for (precision, rtol) in [
        (Precision::F64, 1e-4),
        (Precision::F64, 1e-8),
        (Precision::F32, 1e-5),
    ] {
        // P is checked in tests/exact.rs; u of the first control only: -p_v1 / (m1 r1).
        let asked = Asked { precision, rtol };
        let sweep = Sweep::of(&model, asked);
        let told = estimate(&sweep);
        let truth = truth(&sweep, |x| {
            let costate: Vec<f64> = (0..4)
                .map(|i| (0..4).map(|j| p[(i, j)] * x[j]).sum())
                .collect();
            (0.5 * dot(&costate, x), costate.clone(), -costate[1])
        });
        let worst = told.value.expect("something is compared").worst;
        println!("linear_quadratic {asked:?}: told {worst:.2e}, true {truth:.2?}");
        assert!(
            worst <= FACTOR * truth[0] + ROUNDING && truth[0] <= FACTOR * worst + ROUNDING,
            "{worst} {truth:?}"
        );
        // p is exact in a linear problem whatever the steps, but for rounding.
        let slope = told.costate.expect("p is compared").worst;
        assert!(
            slope <= FACTOR * truth[1] + 1e-3 * worst,
            "{slope} {truth:?}"
        );
    }
}

/// Another seed draws another sample, the same seed the same, whatever the batches were.
#[test]
fn equal_seeds_give_equal_estimates() {
    let model = scene("manufactured", &[]);
    let with = |seed: u64| {
        let hamiltonian = common_oracles::derive(&model);
        let backend = costate::backend::cpu::Cpu::new();
        let choices = costate::low_level::sweep::Choices {
            seed,
            ..F64.choices()
        };
        let plan = costate::low_level::sweep::Plan::new(&model, &hamiltonian, &backend, choices)
            .expect("a plan");
        let report = costate::low_level::sweep::sweep::<costate::backend::BackendError>(
            &plan,
            &backend,
            &mut |_, _| {},
            &mut |_| Ok(()),
        );
        let mut told =
            accuracy::estimate(&plan, &report.expect("a sweep").sample).expect("an estimate");
        told.seconds = 0.0;
        told
    };
    assert_eq!(with(5), with(5));
    assert_ne!(with(5), with(6));
}

#[test]
fn tolerances_in_reach_are_met() {
    for name in [
        "pendulum",
        "moore_greitzer",
        "linear_quadratic",
        "manufactured",
        "finite_horizon",
    ] {
        let mut model = scene(name, &[]);
        model.shoot_out.as_mut().expect("a sweep").max_seeds = 2000;
        for asked in [
            F64,
            F32,
            Asked { rtol: 1e-4, ..F32 },
            Asked { rtol: 1e-3, ..F64 },
        ] {
            let told = estimate(&Sweep::of(&model, asked));
            println!("{name} {asked:?}: {:?} of {:e}", told.value, told.bound);
            assert_eq!(told.met(), Some(true), "{name} {asked:?}: {told:?}");
            // The least the bound can be.
            assert!(
                told.bound >= PROMISE * asked.rtol && told.bound <= 1.01 * PROMISE * asked.rtol
            );
        }
    }
}

#[test]
fn a_bad_run_does_not_meet_its_tolerance() {
    // A fixed step that resolves nothing.
    for name in ["pendulum", "manufactured", "moore_greitzer"] {
        let mut model = scene(name, &[]);
        model.integrator.method = Some(Method::Rk4);
        model.integrator.step = Some(0.4);
        model.shoot_out.as_mut().expect("a sweep").max_seeds = 500;
        let told = estimate(&Sweep::of(&model, Asked { rtol: 1e-6, ..F64 }));
        println!("{name}: {told:?}");
        assert_eq!(told.met(), Some(false), "{name}: {told:?}");
        // The same with a step that is short enough.
        model.integrator.step = Some(0.002);
        let told = estimate(&Sweep::of(&model, Asked { rtol: 1e-6, ..F64 }));
        assert_eq!(told.met(), Some(true), "{name}: {told:?}");
    }
    // More than f32 can give.
    let told = estimate(&Sweep::of(
        &scene("pendulum", &[]),
        Asked { rtol: 1e-8, ..F32 },
    ));
    assert_eq!(told.met(), Some(false), "{told:?}");
    // Seeds that are wrong from the start.
    let mut model = scene("pendulum", &[]);
    model.shoot_out.as_mut().expect("a sweep").seed_value =
        costate::low_level::model::SeedValue::Value(0.9);
    let sweep = Sweep::of(&model, Asked { rtol: 1e-9, ..F64 });
    let seeds = sweep
        .plan
        .local
        .as_ref()
        .expect("an infinite horizon")
        .error;
    let told = estimate(&sweep);
    assert!(
        told.value.expect("something").worst >= 0.5 * seeds / sweep.plan.run.levels[0],
        "{told:?}"
    );
    assert_eq!(told.met(), Some(false), "{told:?}");
}

/// Trajectories that fail are neither errors nor good: what they have is compared, and they are
/// counted.
#[test]
fn failing_trajectories_do_not_fool_it() {
    let told = estimate(&Sweep::of(
        &scene("hard/blow_up", &[]),
        Asked { rtol: 1e-6, ..F64 },
    ));
    assert!(told.failed > told.sampled / 2, "{told:?}");
    assert_eq!(told.met(), Some(true), "{told:?}");
    // All fail before the first level: nothing is known, and that is not success.
    let mut model = scene("manufactured", &[]);
    model.integrator.max_steps = 1;
    let told = estimate(&Sweep::of(&model, F64));
    assert_eq!((told.failed, told.met()), (told.sampled, None), "{told:?}");
}

fn run(name: &str, arguments: &[&str]) -> (Output, PathBuf) {
    let out = std::env::temp_dir().join(format!(
        "costate-estimates-{name}-{}.h5",
        std::process::id()
    ));
    let done = Command::new(env!("CARGO_BIN_EXE_costate"))
        .current_dir(crate::ROOT)
        .args(["run", "--backend", "cpu", "--out"])
        .arg(&out)
        .args(arguments)
        .output()
        .expect("the program runs");
    (done, out)
}

fn json(done: &Output) -> serde_json::Value {
    serde_json::from_slice(&done.stdout)
        .unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&done.stderr)))
}

/// The summary, the JSON, the file and --seed.
#[test]
fn a_run_says_it() {
    let (done, out) = run(
        "met",
        &["scenarios/manufactured.toml", "--json", "--seed", "3"],
    );
    assert!(done.status.success());
    let told = json(&done);
    assert_eq!(told["error_met"], true, "{told}");
    assert!(
        told["error_estimate"]["V"]["max"]
            .as_f64()
            .expect("a number")
            < 3e-5
    );
    assert!(
        told["homotopy"]["error_estimate"]["V"]["max"]
            .as_f64()
            .expect("a number")
            < 1e-8
    );
    assert_eq!(told["stiffness"]["stiff"], false);
    let text = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(
        text.contains("error estimate (64 trajectories again") && !text.contains("note:"),
        "{text}"
    );
    let file = rust_hdf5::H5File::open(&out).expect("a file");
    let names = file.attr_names().expect("attributes");
    for name in [
        "error_estimate_V",
        "error_estimate_V_p99",
        "error_estimate_V_median",
        "error_estimate_p",
        "error_estimate_u",
        "error_estimate_trajectories",
        "error_asked",
        "error_met",
        "solved_error_estimate_V",
    ] {
        assert!(
            names.iter().any(|n| n == name),
            "{name} is not in {names:?}"
        );
    }
    drop(file);
    let estimate = |seed: &str| {
        let (done, _) = run(
            &format!("seed{seed}"),
            &["scenarios/manufactured.toml", "--json", "--seed", seed],
        );
        let mut told = json(&done)["error_estimate"].take();
        told["seconds"].take();
        told
    };
    assert_eq!(estimate("1"), estimate("1"));
    assert_ne!(estimate("1"), estimate("2"));
    let (done, _) = run(
        "notmet",
        &[
            "scenarios/pendulum.toml",
            "--precision",
            "f32",
            "--rtol",
            "1e-8",
            "--json",
        ],
    );
    assert!(done.status.success(), "a run with a warning is done");
    assert_eq!(json(&done)["error_met"], false);
    let text = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(text.contains("NOT met") && text.contains("f32"), "{text}");
    let (done, _) = run("quiet", &["scenarios/manufactured.toml", "--quiet"]);
    assert!(done.stdout.is_empty() && done.stderr.is_empty());
}

/// What is too stiff or cannot be answered is said, with the eigenvalues.
#[test]
fn hard_scenes_are_told_of() {
    let (done, _) = run("cheap", &["scenarios/hard/cheap_control.toml", "--json"]);
    let text = String::from_utf8_lossy(&done.stderr).into_owned();
    for words in [
        "-999.999500",
        "ratio 1000",
        "stiff",
        "segments",
        "NOT fully covered",
    ] {
        assert!(text.contains(words), "{words}: {text}");
    }
    let told = json(&done);
    assert_eq!(
        (
            &told["stiffness"]["stiff"],
            &told["stiffness"]["fronts_hidden"]
        ),
        (&true.into(), &true.into())
    );
    assert_eq!(told["error_met"], true);
    let refused = |arguments: &[&str], words: &str| {
        let (done, out) = run("refused", arguments);
        let text = String::from_utf8_lossy(&done.stderr).replace(['\n', '│'], " ");
        let text = text.split_whitespace().collect::<Vec<_>>().join(" ");
        assert_eq!(done.status.code(), Some(2), "{text}");
        assert!(text.contains(words), "{text}");
        assert!(!out.exists(), "a result was written");
    };
    refused(
        &["scenarios/hard/peak_infinite_horizon.toml"],
        "not stabilizable: its mode with eigenvalue 0.000000",
    );
    let flat = "scenarios/hard/flat_cost.toml";
    refused(
        &[flat, "--set", "q_x=0", "--set", "q_v=1"],
        "an eigenvalue on the imaginary axis, 0.000000",
    );
    refused(
        &[flat, "--set", "q_x=0", "--set", "d=1"],
        "an eigenvalue on the imaginary axis, 0.000000",
    );
    refused(&[flat, "--set", "coupling=0"], "not positive definite");
}
