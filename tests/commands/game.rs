//! Games against what is known of them: V, folds, regions of validity, and minimal cost as their
//! limit.

use crate::common;
use crate::common_oracles;
use crate::common_values;

use common_values::{Swept, largest, parse, scene, spaced};
use costate::backend::{Backend, cpu::Cpu};
use costate::low_level::model::Precision;
use costate::low_level::sweep::{FOLD_STATUS, FoldPoint};
use costate::low_level::value::PointStatus;

use common_oracles::{Asked, F32, F64, Sweep, parameter};

/// `scenarios/folding_game.toml`: V, costate and fold of its first scalar game.
struct Folding {
    s: f64,
    e: f64,
    k: f64,
}

impl Folding {
    fn new(model: &costate::low_level::model::Model) -> Self {
        let of = |name: &str| parameter(model, name);
        Self {
            s: of("b").powi(2) / of("r") - of("gamma").powi(-2),
            e: of("e"),
            k: of("k"),
        }
    }

    fn z(&self, x: &[f64]) -> f64 {
        x[0] + self.k * x[1] * x[1]
    }

    fn value(&self, x: &[f64]) -> f64 {
        let (s, e, z) = (self.s, self.e, self.z(x));
        let power = |a: f64| a.powf(1.5);
        let first =
            (-0.5 * z * z + (power(1.0 + s + s * e * z * z) - power(1.0 + s)) / (3.0 * s * e)) / s;
        first + 0.5 * (2f64.sqrt() - 1.0) * x[1] * x[1]
    }

    /// |z| of the fold.
    fn fold(&self) -> f64 {
        ((-1.0 / self.s - 1.0) / self.e).sqrt()
    }
}

fn folding(backend: Box<dyn Backend>, asked: Asked) {
    let model = scene("folding_game", &[]);
    let exact = Folding::new(&model);
    let sweep = Sweep::on(backend, &model, asked);
    let mut worst = 0.0f64;
    let mut samples = 0;
    for sample in sweep.samples() {
        let size = exact.value(sample.x).max(1e-3);
        worst = worst.max((sample.v - exact.value(sample.x)).abs() / size);
        samples += 1;
    }
    println!(
        "{} {}: V within {worst:.2e} of {samples} samples",
        sweep.plan.spec.precision.name(),
        asked.rtol
    );
    assert!(
        samples > 1000 && worst <= asked.promised(),
        "V is off by {worst:e}"
    );
    // All trajectories that end in a fold end on the exact one; those that do not leave the region
    // along y.
    let folds = &sweep.report.folds;
    let off = largest(
        folds
            .iter()
            .map(|f| exact.z(&f.x).abs() / exact.fold() - 1.0),
    );
    let value =
        largest(folds.iter().map(|f| {
            f.value / exact.value(&[exact.fold() - exact.k * f.x[1].powi(2), f.x[1]]) - 1.0
        }));
    println!(
        "{} folds within {off:.2e}, their V within {value:.2e}",
        folds.len()
    );
    assert!(folds.len() > 20, "{} folds", folds.len());
    assert!(
        off <= asked.promised() && value <= asked.promised(),
        "{off:e}, {value:e}"
    );
    let folded = sweep
        .stored
        .status
        .iter()
        .filter(|s| **s == FOLD_STATUS)
        .count();
    assert_eq!(folded, folds.len());
    // The caustic is covered: within the region no two neighbouring points of it are further apart
    // than the spacing.
    for side in [1.0, -1.0] {
        let inside = |f: &&FoldPoint| {
            side * exact.z(&f.x) > 0.0 && f.x[0].abs() <= 1.5 && f.x[1].abs() <= 1.0
        };
        let mut along: Vec<f64> = folds.iter().filter(inside).map(|f| f.x[1]).collect();
        along.sort_by(f64::total_cmp);
        assert!(along[0] < -0.8 && along[along.len() - 1] > 0.8, "{along:?}");
        // In widths of the region; the caustic is steeper in y than in x.
        let gap = largest(along.windows(2).map(|y| (y[1] - y[0]) / 2.0));
        assert!(
            gap <= 1.01 * sweep.plan.shoot_out.spacing,
            "a gap of {gap} on the caustic"
        );
    }
}

#[test]
fn v_and_the_fold_are_exact_in_f64() {
    folding(Box::new(Cpu::new()), F64);
}

#[test]
fn v_and_the_fold_are_exact_in_f32() {
    folding(Box::new(Cpu::new()), F32);
}

#[test]
fn v_and_the_fold_are_exact_on_a_gpu() {
    folding(Box::new(common::any_gpu()), F32);
    folding(
        Box::new(common::any_gpu()),
        Asked {
            precision: Precision::F64,
            // Without Taylor's method on the device.
            rtol: 1e-9,
        },
    );
}

/// A state is valid exactly where the closed form says that the manifold lies over it.
#[test]
fn valid_states_are_those_before_the_fold() {
    let model = scene("folding_game", &[]);
    let exact = Folding::new(&model);
    let swept = Swept::new(model, 2000);
    let answers = swept.grid(vec![spaced(-1.5, 1.5, 25), spaced(-1.0, 1.0, 9)]);
    let (mut inside, mut outside) = (0, 0);
    for target in 0..answers.targets.len() {
        let x = answers.targets.state(target);
        let valid = exact.z(x).abs() < exact.fold();
        let status = answers.status(target);
        if valid {
            assert_eq!(status, PointStatus::Converged, "at {x:?}");
            let entry = answers.answer(target).expect("an answer");
            let expected = exact.value(x);
            assert!(
                (entry.value - expected).abs() <= 1e-8 * expected.max(1e-3),
                "V at {x:?}"
            );
            inside += 1;
        } else {
            assert_eq!(status, PointStatus::Fold, "at {x:?}");
            assert!(answers.answer(target).is_none());
            outside += 1;
        }
    }
    assert!(
        inside > 100 && outside > 30,
        "{inside} inside, {outside} outside"
    );
}

const SHEETS: &str = r#"
parameters = { T = 2.0, k = 2.0, slant = 0.1, r = 0.5, gamma = "sqrt(1/(1/r - 1))" }
states = { x = {} }
controls = { u = {} }
disturbances = { w = {} }
dynamics = { x = "u + w" }
cost = { running = "0.5*(r*u^2 - gamma^2*w^2)", terminal = "x^4/4 - k*x^2/2 + slant*x + 3", final_time = "T" }
region = { x = [-3, 3] }
shoot_out = { spacing = 0.02, samples = 8 }
integrator = { rtol = 1e-9 }
"#;

/// Straight characteristics x = y + T phi'(y), of which 1 - T phi'' < 0 have crossed others: with
/// 1/r - 1/gamma^2 = 1 they are those of a free particle. Where three lie over a state the two
/// without a fold are no value, though one is lower.
#[test]
fn where_sheets_overlap_there_is_no_value() {
    let model = parse(SHEETS);
    let swept = Swept::new(model, 4000);
    let answers = swept.grid(vec![spaced(-3.0, 3.0, 61)]);
    let (t, k, slant) = (2.0, 2.0, 0.1);
    let slope = |y: f64| y.powi(3) - k * y + slant;
    // The ends of characteristics on the folds, where 1 + T phi'' = 0, and the states there.
    let y = ((k - 1.0 / t) / 3.0f64).sqrt();
    let edge = |y: f64| y + t * slope(y);
    let (left, right) = (edge(y).min(edge(-y)), edge(y).max(edge(-y)));
    let (mut one, mut several) = (0, 0);
    for target in 0..answers.targets.len() {
        let x = answers.targets.state(target)[0];
        let found = answers.of(target);
        if x > left && x < right {
            assert_eq!(answers.status(target), PointStatus::SeveralSheets, "at {x}");
            assert_eq!(found.len(), 2, "sheets without a fold at {x}");
            assert!(answers.answer(target).is_none());
            several += 1;
        } else {
            assert_eq!(answers.status(target), PointStatus::Converged, "at {x}");
            assert_eq!(found.len(), 1, "sheets at {x}");
            one += 1;
        }
        for entry in found {
            // p is constant along: y = x - T p, and p = phi'(y).
            let y = x - t * entry.p[0];
            assert!((slope(y) - entry.p[0]).abs() < 1e-8, "an extremal at {x}");
            assert!(1.0 + t * (3.0 * y * y - k) > 0.0, "behind a fold at {x}");
        }
    }
    assert!(one > 20 && several > 10, "{one} and {several}");
}

/// Sheets of ever higher V lie over the states (swings about the hanging position and back), and
/// which of them are found depends on the sweep. The answer is that of the equilibrium's own sheet,
/// whoever else is asked for.
#[test]
fn other_sheets_do_not_change_the_answer() {
    let model = scene("pendulum_game", &[("gamma", "1.867499")]);
    let swept = Swept::new(model, 4000);
    let grid = swept.grid(vec![spaced(-3.9, 1.5, 10), spaced(-8.0, 13.0, 8)]);
    let several = (0..grid.targets.len())
        .filter(|t| grid.of(*t).len() > 1)
        .count();
    assert!(several > 0, "the scene has states with several sheets");
    let mut compared = 0;
    for target in (0..grid.targets.len()).step_by(7) {
        let x = grid.targets.state(target).to_vec();
        let alone = swept.points(&x);
        let only = alone.targets.of_given[0];
        assert_eq!(grid.status(target), alone.status(only), "at {x:?}");
        let (Some(a), Some(b)) = (grid.answer(target), alone.answer(only)) else {
            continue;
        };
        assert!(
            (a.value - b.value).abs() <= 1e-9 * a.value,
            "V at {x:?}: {} and {}",
            a.value,
            b.value
        );
        compared += 1;
    }
    assert!(compared > 8, "{compared} states");
}

/// Double integrator with w beside u: with S = 1/r - 1/gamma^2 the game Riccati equation is that of
/// minimal cost with control weight 1/S.
const DOUBLE_INTEGRATOR: &str = r#"
parameters = { q1 = 2.0, q2 = 0.5, r = 1.0, gamma = 1.25 }
states = { x = {}, v = {} }
controls = { u = {} }
disturbances = { w = {} }
dynamics = { x = "v", v = "u + w" }
cost = { running = "0.5*(q1*x^2 + q2*v^2 + r*u^2 - gamma^2*w^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-1, 1], v = [-1, 1] }
shoot_out = { value_max = 10, spacing = 0.05, samples = 100 }
integrator = { rtol = 1e-9 }
"#;

#[test]
fn a_linear_game_has_its_exact_matrix() {
    let model = parse(DOUBLE_INTEGRATOR);
    let s = 1.0 - 1.0 / 1.5625;
    let p12 = (2.0f64 / s).sqrt();
    let p22 = ((0.5 + 2.0 * p12) / s).sqrt();
    let p11 = p12 * p22 * s;
    let sweep = Sweep::of(&model, F64);
    let mut worst = 0.0f64;
    for sample in sweep.samples() {
        let [x, v] = sample.x[..] else { unreachable!() };
        let exact = 0.5 * (p11 * x * x + 2.0 * p12 * x * v + p22 * v * v);
        worst = worst.max((sample.v - exact).abs() / exact);
        // w* = p_v / gamma^2, u* = -p_v / r.
        let u = -(p12 * x + p22 * v);
        assert!((sample.u[0] - u).abs() <= 1e-7 * (1.0 + u.abs()));
    }
    let w = &sweep.stored.w;
    let ratio = largest(
        sweep
            .stored
            .u
            .iter()
            .zip(w)
            .filter(|(u, _)| u.abs() > 1e-3)
            .map(|(u, w)| w / u * 1.5625 + 1.0),
    );
    println!("V within {worst:.2e}");
    assert!(worst <= 1e-8 && ratio <= 1e-9, "{worst:e}, {ratio:e}");
    assert!(sweep.report.folds.is_empty(), "a linear game has no folds");
}

/// A resonance with little damping, which w drives as well as the control damps it: along the worst
/// case V rises in parts of every turn.
const RISING: &str = r#"
parameters = { gamma = 3.0 }
states = { x = {}, v = {} }
controls = { u = {} }
disturbances = { w = {} }
dynamics = { x = "v + w", v = "-4*x - 0.3*v + u + w" }
cost = { running = "0.5*(0.1*x^2 + v^2 + u^2 - gamma^2*w^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-1, 1], v = [-2, 2] }
shoot_out = { value_max = 10, spacing = 0.05, samples = 200 }
integrator = { rtol = 1e-9 }
"#;

/// Where V falls along the flow toward the equilibrium in some places and rises in others, seeds on
/// {V = c} would meet some trajectories twice. They lie on another ellipsoid; V on the trajectories
/// is 1/2 s'Ps all the same.
#[test]
fn v_may_rise_along_trajectories() {
    let sweep = Sweep::of(&parse(RISING), F64);
    let p = &sweep.plan.local.as_ref().expect("an equilibrium").riccati.p;
    let mut worst = 0.0f64;
    let mut last: Option<(usize, f64)> = None;
    let (mut rises, mut falls) = (0, 0);
    for sample in sweep.samples() {
        let x = nalgebra::DVector::from_column_slice(sample.x);
        let exact = 0.5 * x.dot(&(p * &x));
        worst = worst.max((sample.v - exact).abs() / exact);
        // Samples are in order of rising t.
        if let Some((trajectory, v)) = last
            && trajectory == sample.trajectory
        {
            *(if sample.v > v { &mut rises } else { &mut falls }) += 1;
        }
        last = Some((sample.trajectory, sample.v));
    }
    println!("{rises} rises, {falls} falls, V within {worst:.2e}");
    assert!(rises > 100 && falls > rises, "{rises} rises, {falls} falls");
    assert!(worst <= 1e-8, "V is off by {worst:e}");
    let coverage = &sweep.report.coverage;
    assert_eq!((coverage.uncovered, coverage.indistinguishable), (0, 0));
}

/// gamma without bound leaves minimal cost: the same V, p and u, to rounding.
#[test]
fn without_bound_on_the_gain_it_is_minimal_cost() {
    for (name, game, far, points) in [
        (
            "pendulum",
            "pendulum_game",
            ("gamma", "1e9"),
            vec![0.5, 2.0, -3.0, 5.0, 1.0, -4.0],
        ),
        (
            "moore_greitzer",
            "moore_greitzer_game",
            ("level", "1e9"),
            vec![
                1.2, 2.0, 0.05, 1.5, 1.25, 1.9, 0.02, 1.55, 1.15, 2.1, 0.01, 1.5244,
            ],
        ),
    ] {
        let h2 = Swept::new(scene(name, &[]), 2000);
        let game = Swept::new(scene(game, &[far]), 2000);
        let n = h2.model.states.len();
        let (a, b) = (h2.points(&points), game.points(&points));
        for k in 0..points.len() / n {
            let at = |answers: &costate::low_level::value::Answers| {
                let entry = common_values::given(answers, k).expect("an answer");
                (
                    entry.value,
                    entry.p.clone(),
                    entry.u.clone(),
                    entry.w.clone(),
                )
            };
            let ((va, pa, ua, _), (vb, pb, ub, w)) = (at(&a), at(&b));
            println!("{name} {k}: V {va} and {vb}");
            // Both are solved to 1e-9 or better by Newton's method from different guesses.
            assert!((va - vb).abs() <= 1e-10 * va, "V of {name}: {va} and {vb}");
            let far = |a: &[f64], b: &[f64]| largest(a.iter().zip(b).map(|(a, b)| a - b));
            let size = largest(pa.iter().copied());
            assert!(
                far(&pa, &pb) <= 1e-8 * size,
                "p of {name}: {pa:?} and {pb:?}"
            );
            assert!(far(&ua, &ub) <= 1e-8 * (1.0 + ua[0].abs()));
            assert!(w[0].abs() <= 1e-15 * size);
        }
    }
}

/// From the same seeds sampled by the same coordinate, a game without bound has the very digits of
/// minimal cost.
#[test]
fn the_limit_is_digit_for_digit() {
    for (name, game, far) in [
        ("pendulum", "pendulum_game", "gamma"),
        ("moore_greitzer", "moore_greitzer_game", "level"),
    ] {
        let game = scene(game, &[(far, "1e9")]);
        let mut model = scene(name, &[]);
        model.region = game.region.clone();
        model.shoot_out = game.shoot_out.clone();
        model.integrator = game.integrator.clone();
        model.states.iter_mut().for_each(|s| s.period = None);
        for m in [&mut model] {
            if let Some(shoot_out) = &mut m.shoot_out {
                shoot_out.sample_by = Some(costate::low_level::model::SampleBy::ArcLength);
                shoot_out.folds = true;
                shoot_out.max_seeds = 200;
            }
        }
        let mut game = game;
        if let Some(shoot_out) = &mut game.shoot_out {
            shoot_out.max_seeds = 200;
        }
        let asked = Asked {
            precision: Precision::F64,
            rtol: 1e-9,
        };
        let (a, b) = (Sweep::of(&model, asked), Sweep::of(&game, asked));
        let n = a.n;
        // Rounding may differ where terms of 1e-18 are added in another order; along trajectories
        // such differences grow, but on the manifold V stays a function of x.
        let (mut seeds, mut compared, mut worst, mut same) = (0, 0, 0.0f64, 0);
        for i in 0..a.count().min(b.count()) {
            let (v, width) = (2 * n, 2 * n + 1);
            // The first surface of seeds is the same, the seeds put between neighbours differ where
            // the two give up at different V.
            if a.seeds[i * a.raw.dim..][..width] != b.seeds[i * b.raw.dim..][..width] {
                break;
            }
            seeds += 1;
            for k in 0..a.levels() {
                let (x, y) = (&a.raw.sample(i, k)[1..], &b.raw.sample(i, k)[1..]);
                if x[0].is_nan() || y[0].is_nan() {
                    break;
                }
                let along: f64 = (0..n)
                    .map(|j| 0.5 * (x[n + j] + y[n + j]) * (x[j] - y[j]))
                    .sum();
                worst = worst.max((x[v] - y[v] - along).abs() / x[v]);
                same += usize::from(x[v] == y[v]);
                compared += 1;
            }
        }
        println!("{name}: {compared} samples, {same} with the same bits, V differs by {worst:.1e}");
        assert!(
            seeds >= 64 && compared > 500,
            "{seeds} seeds, {compared} samples"
        );
        assert!(worst <= 1e-12, "{name}: V differs by {worst:e}");
    }
}

/// The pendulum's game by hand: right-hand sides and variations written out, integrated by Runge's
/// classical method with a fixed small step. `det (dx/dt, dx/dseed)` changes sign where the sweep
/// says that the manifold folds.
#[test]
fn the_pendulum_folds_where_the_jacobian_vanishes() {
    let model = scene("pendulum_game", &[]);
    let sweep = Sweep::of(&model, F64);
    let (g, theta_f, q, r, gamma) = (9.81f64, -1.5f64, 5.55, 1.85, 3.0f64);
    let s = 1.0 / r - 1.0 / (gamma * gamma);
    // Backward in time: (theta, omega, p, q) and one variation of it.
    let rate = |z: &[f64; 8]| -> [f64; 8] {
        let [th, om, p1, p2, a, b, c, d] = *z;
        [
            -om,
            g * th.sin() - g * theta_f.sin() + s * p2,
            q * (th - theta_f) - p2 * g * th.cos(),
            q * om + p1,
            -b,
            g * th.cos() * a + s * d,
            (q + p2 * g * th.sin()) * a - g * th.cos() * d,
            q * b + c,
        ]
    };
    let step = |z: &[f64; 8], h: f64| -> [f64; 8] {
        let add = |a: &[f64; 8], b: &[f64; 8], c: f64| std::array::from_fn(|i| a[i] + c * b[i]);
        let k1 = rate(z);
        let k2 = rate(&add(z, &k1, 0.5 * h));
        let k3 = rate(&add(z, &k2, 0.5 * h));
        let k4 = rate(&add(z, &k3, h));
        std::array::from_fn(|i| z[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]))
    };
    let local = sweep.plan.local.as_ref().expect("an equilibrium");
    let mut checked = 0;
    for fold in sweep.report.folds.iter().take(6) {
        let start = &sweep.seeds[fold.trajectory * sweep.raw.dim..][..4];
        // A neighbouring seed on the local solution, off the flow's direction: across it.
        let rates = sweep
            .plan
            .system
            .eval(&sweep.plan.system.rate[..2], &start[..2], &start[2..]);
        let size = (start[0].powi(2) + start[1].powi(2)).sqrt();
        let norm = rates[0].hypot(rates[1]);
        let across = [-rates[1] / norm, rates[0] / norm];
        let h = 1e-5 * size;
        let at = |sign: f64| {
            local.at_state(&[
                start[0] + sign * h * across[0],
                start[1] + sign * h * across[1],
            ])
        };
        let (up, down) = (at(1.0), at(-1.0));
        let tangent: Vec<f64> = (0..4).map(|i| (up[i] - down[i]) / (2.0 * h)).collect();
        let mut z: [f64; 8] = [
            theta_f + start[0],
            start[1],
            start[2],
            start[3],
            tangent[0],
            tangent[1],
            tangent[2],
            tangent[3],
        ];
        let determinant = |z: &[f64; 8]| {
            let f = rate(z);
            f[0] * z[5] - f[1] * z[4]
        };
        let sign = determinant(&z).signum();
        let (h, mut t) = (2e-4, 0.0);
        let met = loop {
            let next = step(&z, h);
            if determinant(&next) * sign <= 0.0 {
                let (d0, d1) = (determinant(&z), determinant(&next));
                break t + h * d0 / (d0 - d1);
            }
            (z, t) = (next, t + h);
            assert!(
                t < 1.2 * -fold.t,
                "no sign change by t = {t}, where the fold is told at {}",
                fold.t
            );
        };
        println!("fold at t = {:.9}, by hand {:.9}", fold.t, -met);
        // Linear interpolation within a step of 2e-4, and the fourth-order method's own error.
        assert!((met + fold.t).abs() <= 1e-6, "{met} and {}", fold.t);
        checked += 1;
    }
    assert!(checked >= 4, "{checked} folds");
}

/// A folder of its own for a test, with the files given.
fn folder(name: &str, files: &[(&str, &str)]) -> std::path::PathBuf {
    let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("game_{name}"));
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("the target folder can be written");
    for (file, text) in files {
        std::fs::write(folder.join(file), text).expect("the target folder can be written");
    }
    folder
}

fn costate(folder: &std::path::Path, arguments: &str) -> (Option<i32>, String) {
    let done = std::process::Command::new(env!("CARGO_BIN_EXE_costate"))
        .current_dir(folder)
        .args(arguments.split(' '))
        .output()
        .expect("the program starts");
    let text = [done.stdout, done.stderr].concat();
    (
        done.status.code(),
        String::from_utf8_lossy(&text).into_owned(),
    )
}

/// Interpolation goes on smoothly behind a fold; H(x, p) = 0 has no solution there.
#[test]
fn the_value_map_ends_at_the_fold() {
    let text = std::fs::read_to_string(format!("{}/scenarios/folding_game.toml", crate::ROOT));
    let text = text
        .expect("the scene is there")
        .replace("[attenuation]\nparameter = \"gamma\"\n", "");
    let folder = folder("value", &[("scene.toml", &text)]);
    let (status, text) = costate(
        &folder,
        "run scene.toml --backend cpu --no-report --out out.h5",
    );
    assert_eq!(status, Some(0), "{text}");
    // The fold is at |x + 0.3 y^2| = 1.2663.
    let (status, text) = costate(
        &folder,
        "value out.h5 --at x=1.0,y=0 --at x=1.3,y=0 --at x=-1.35,y=0.1 --at x=1.0,y=1.0",
    );
    assert_eq!(status, Some(0), "{text}");
    assert_eq!(text.matches("not known").count(), 3, "{text}");
    assert!(text.contains("x = 1, y = 0\n  V = 0.461"), "{text}");
}

const OSCILLATOR: &str = r#"
parameters = { g = 2.0 }
states = { x = {}, v = {} }
controls = { u = {} }
disturbances = { w = {} }
dynamics = { x = "v", v = "-x - v + u + w" }
cost = { running = "0.5*(x^2 + v^2 + u^2 - g^2*w^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-1e9, 1e9], v = [-1e9, 1e9] }
attenuation = { parameter = "g" }
"#;

/// At g = 1 control and disturbance cancel and H_pp is 0: that must not be taken for an eigenvalue
/// on the axis, whatever the units.
#[test]
fn gamma_star_does_not_depend_on_where_the_search_begins() {
    let folder = folder("star", &[("scene.toml", OSCILLATOR)]);
    // With S = 1 - 1/g^2: lambda^4 + lambda^2 (1 - S) + 1 + S has a double root -(1 - S)/2 < 0 in
    // lambda^2 where (1 - S)^2 = 4 (1 + S), S = 3 - sqrt(12).
    let star = (1.0 / (12f64.sqrt() - 2.0)).sqrt();
    for g in ["2", "1", "0.9", "3.7"] {
        let (status, text) = costate(&folder, &format!("check scene.toml --set g={g}"));
        assert_eq!(status, Some(0), "{text}");
        assert!(
            text.contains(&format!("g* = {star:.9}")),
            "no {star:.9} in {text}"
        );
    }
}

/// A term linear in w makes a disturbance of the equilibrium itself worth its cost: it is none of
/// the game's.
#[test]
fn inputs_must_be_extremal_at_the_equilibrium() {
    for (what, name) in [("+ w", "disturbance is w"), ("+ 0.1*u", "control is u")] {
        let scene = OSCILLATOR.replace("- g^2*w^2)", &format!("- g^2*w^2) {what}"));
        let folder = folder("linear_term", &[("scene.toml", &scene)]);
        let (status, text) = costate(&folder, "attenuation scene.toml --out out.h5");
        assert_eq!(status, Some(2), "{text}");
        assert!(text.contains(name), "{text}");
        assert!(!folder.join("out.h5").exists());
    }
}
