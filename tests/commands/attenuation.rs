//! The smallest level of attenuation: gamma* against exact values and an independent method, the
//! search on functions made up, the region of a scalar game in closed form, and the refusals.

use costate::Scene;
use costate::backend::cpu::Cpu;
use costate::low_level::attenuation::{Covering, Outcome, Sought, linear, search, smallest};
use costate::low_level::local::{Cause, LinearAttenuation, LocalError, Riccati};
use costate::low_level::result::Stored;
use costate::low_level::sweep::Choices;
use costate::low_level::value::PointStatus;
use nalgebra::{Complex, DMatrix};
use std::convert::Infallible;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// What the project promises of gamma*.
const STAR: f64 = 1e-8;

/// A linear-quadratic game x' = A x + B u + E w, L = 1/2 (x'Qx + r u'u - gamma^2 w'w), with its
/// region's half-widths.
struct Game {
    a: DMatrix<f64>,
    b: DMatrix<f64>,
    e: DMatrix<f64>,
    q: DMatrix<f64>,
    r: f64,
    own: f64,
    half: Vec<f64>,
}

impl Game {
    fn new(n: usize, a: &[f64], b: &[f64], e: &[f64], r: f64, own: f64) -> Self {
        Self {
            a: DMatrix::from_row_slice(n, n, a),
            b: DMatrix::from_row_slice(n, b.len() / n, b),
            e: DMatrix::from_row_slice(n, e.len() / n, e),
            q: DMatrix::identity(n, n),
            r,
            own,
            half: vec![1.0; n],
        }
    }

    fn text(&self) -> String {
        let (n, m, k) = (self.a.nrows(), self.b.ncols(), self.e.ncols());
        let names = |letter: &str, count: usize| {
            (0..count)
                .map(|i| format!("{letter}{i}"))
                .collect::<Vec<_>>()
        };
        let (x, u, w) = (names("x", n), names("u", m), names("w", k));
        let declared = |all: &[String]| {
            all.iter()
                .map(|v| format!("{v} = {{}}\n"))
                .collect::<String>()
        };
        let sum = |row: Vec<f64>, of: &[String]| {
            let terms: Vec<String> = row
                .iter()
                .zip(of)
                .map(|(c, v)| format!("({c:?})*{v}"))
                .collect();
            terms.join(" + ")
        };
        let row = |m: &DMatrix<f64>, i: usize| m.row(i).iter().copied().collect::<Vec<f64>>();
        let rates: String = (0..n)
            .map(|i| {
                let parts = [
                    sum(row(&self.a, i), &x),
                    sum(row(&self.b, i), &u),
                    sum(row(&self.e, i), &w),
                ];
                format!("{} = \"{}\"\n", x[i], parts.join(" + "))
            })
            .collect();
        let square = |all: &[String]| {
            all.iter()
                .map(|v| format!("{v}^2"))
                .collect::<Vec<_>>()
                .join(" + ")
        };
        let states: Vec<String> = (0..n)
            .flat_map(|i| (0..n).map(move |j| (i, j)))
            .map(|(i, j)| format!("({:?})*x{i}*x{j}", self.q[(i, j)]))
            .collect();
        let zero = |all: &[String]| all.iter().map(|v| format!("{v} = 0\n")).collect::<String>();
        let region: String = x
            .iter()
            .zip(&self.half)
            .map(|(v, h)| format!("{v} = [{:?}, {h:?}]\n", -h))
            .collect();
        format!(
            "[parameters]\ngamma = {:?}\n[states]\n{}[controls]\n{}[disturbances]\n{}[dynamics]\n{rates}[cost]\n\
             running = \"0.5*({} + {:?}*({}) - gamma^2*({}))\"\n[equilibrium]\n{}{}[region]\n{region}[attenuation]\n\
             parameter = \"gamma\"\n",
            self.own,
            declared(&x),
            declared(&u),
            declared(&w),
            states.join(" + "),
            self.r,
            square(&u),
            square(&w),
            zero(&x),
            zero(&u),
        )
    }

    fn star(&self) -> LinearAttenuation {
        let scene = scene(&self.text());
        linear(&scene, scene.model.attenuation.as_ref().unwrap()).unwrap_or_else(|e| panic!("{e}"))
    }

    /// The Hamiltonian matrix has the eigenvalue i omega exactly where gamma^2 is an eigenvalue of
    /// W = E'F*Q (I + F B B'/r F*Q)^-1 F E, F = (i omega - A)^-1. The largest over omega.
    fn on_axis(&self) -> f64 {
        let n = self.a.nrows();
        let complex = |m: &DMatrix<f64>| m.map(|v| Complex::new(v, 0.0));
        let (a, b, e, q) = (
            complex(&self.a),
            complex(&self.b),
            complex(&self.e),
            complex(&self.q),
        );
        let largest = |omega: f64| {
            let f = (DMatrix::identity(n, n) * Complex::new(0.0, omega) - &a)
                .try_inverse()
                .unwrap();
            let fq = f.adjoint() * &q;
            let inner =
                DMatrix::identity(n, n) + &f * &b * b.adjoint() * &fq / Complex::new(self.r, 0.0);
            let w = e.adjoint() * &fq * inner.try_inverse().unwrap() * &f * &e;
            ((&w + w.adjoint()) * Complex::new(0.5, 0.0))
                .symmetric_eigenvalues()
                .max()
        };
        let step = 0.005;
        let best = (0..8000)
            .map(|k| step * f64::from(k))
            .max_by(|x, y| largest(*x).total_cmp(&largest(*y)))
            .unwrap();
        let (mut lo, mut hi) = ((best - step).max(0.0), best + step);
        for _ in 0..80 {
            let (c, d) = (hi - 0.618 * (hi - lo), lo + 0.618 * (hi - lo));
            if largest(c) > largest(d) {
                hi = d
            } else {
                lo = c
            }
        }
        largest(0.5 * (lo + hi)).sqrt()
    }
}

fn scene(text: &str) -> Scene {
    Scene::parse(text, "game.toml").unwrap_or_else(|e| panic!("{e}\n{text}"))
}

fn riccati(text: &str, gamma: f64) -> Result<Riccati, LocalError> {
    let scene = scene(text).with(&[("gamma", gamma)]).unwrap();
    Riccati::solve(&scene.hamiltonian, &scene.model)
}

fn agrees(found: &LinearAttenuation, exact: f64, cause: Cause) {
    for value in [found.star, found.hamiltonian] {
        let error = (value / exact - 1.0).abs();
        assert!(error < STAR, "{value} is not {exact}: relative {error:.1e}");
    }
    assert_eq!(found.cause, cause);
    println!(
        "gamma* {:.15}, exact {exact:.15}, relative error {:.1e}, of the Hamiltonian matrix {:.1e}",
        found.star,
        (found.star / exact - 1.0).abs(),
        (found.hamiltonian / exact - 1.0).abs()
    );
}

#[test]
fn stable_scalar_meets_the_axis() {
    for (a, b, r, own) in [
        (-1.0, 0.5, 1.0, 2.0),
        (-3.0, 2.0, 0.1, 0.01),
        (-0.2, 0.0, 1.0, 100.0),
    ] {
        let exact = f64::hypot(a, b / f64::sqrt(r)).recip();
        agrees(
            &Game::new(1, &[a], &[b], &[1.0], r, own).star(),
            exact,
            Cause::Axis,
        );
    }
}

#[test]
fn unstable_scalar_becomes_unbounded() {
    for (a, b, r, own) in [
        (1.0f64, 0.5f64, 1.0f64, 5.0),
        (0.3, -2.0, 0.1, 0.1),
        (20.0, 1.0, 3.0, 1.0),
    ] {
        let exact = r.sqrt() / b.abs();
        let game = Game::new(1, &[a], &[b], &[1.0], r, own);
        agrees(&game.star(), exact, Cause::Unbounded);
        assert!(riccati(&game.text(), exact * (1.0 + 1e-6)).is_ok());
        // Below it there is a stabilizing solution, which is negative.
        let below = riccati(&game.text(), exact * (1.0 - 1e-6));
        assert!(
            matches!(below, Err(LocalError::BelowAttenuation { .. })),
            "{below:?}"
        );
    }
}

#[test]
fn units_do_not_matter() {
    let mut game = Game::new(
        2,
        &[0.0, 1.0, 2.0, 0.5],
        &[0.0, 1.0],
        &[0.0, 1.0],
        4.0,
        10.0,
    );
    agrees(&game.star(), 2.0, Cause::Unbounded);
    // The same in other units: x = D z.
    let d = [1e6, 1e-4];
    for i in 0..2 {
        for j in 0..2 {
            game.a[(i, j)] *= d[j] / d[i];
            game.q[(i, j)] *= d[i] * d[j];
        }
        game.b[(i, 0)] /= d[i];
        game.e[(i, 0)] /= d[i];
        game.half[i] /= d[i];
    }
    agrees(&game.star(), 2.0, Cause::Unbounded);
    // Another region, to which the program scales.
    game.half = vec![10.0 / d[0], 0.1 / d[1]];
    agrees(&game.star(), 2.0, Cause::Unbounded);
}

#[test]
fn double_integrator_with_a_matched_disturbance() {
    for r in [1.0f64, 0.04, 25.0] {
        let found = Game::new(2, &[0.0, 1.0, 0.0, 0.0], &[0.0, 1.0], &[0.0, 1.0], r, 3.0).star();
        // Both happen at once there.
        agrees(&found, r.sqrt(), found.cause);
    }
}

#[test]
fn random_games_of_four_states() {
    let mut state = 7u64;
    let mut random = || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1u64 << 53) as f64 * 2.0 - 1.0
    };
    let mut causes = [0, 0];
    for _ in 0..12 {
        let mut draw = |count: usize| (0..count).map(|_| random()).collect::<Vec<f64>>();
        let mut game = Game::new(4, &draw(16), &draw(8), &draw(8), 0.5, 3.0);
        for i in 0..4 {
            game.a[(i, i)] -= 0.8;
        }
        let (found, axis) = (game.star(), game.on_axis());
        if found.cause == Cause::Axis {
            agrees(&found, axis, Cause::Axis);
            causes[0] += 1;
            continue;
        }
        causes[1] += 1;
        assert!(
            found.difference() < STAR && found.star > axis,
            "{found:?}, {axis}"
        );
        let text = game.text();
        let above = riccati(&text, found.star * (1.0 + 1e-4)).unwrap_or_else(|e| panic!("{e}"));
        assert!(
            above.p.amax() > 100.0,
            "P is large just above gamma*: {}",
            above.p
        );
        let below = riccati(&text, found.star * (1.0 - 1e-4));
        // A little below, eigenvalues may meet on the axis, too.
        let refused = matches!(
            below,
            Err(LocalError::BelowAttenuation { .. } | LocalError::ImaginaryAxis { .. })
        );
        assert!(refused, "{below:?}");
    }
    println!("axis, unbounded: {causes:?}");
    assert!(
        causes[0] > 0 && causes[1] > 0,
        "both causes are met: {causes:?}"
    );
}

#[test]
fn what_has_no_gamma_star() {
    let text = Game::new(1, &[-1.0], &[0.5], &[1.0], 1.0, 2.0).text();
    let of = |text: &str| {
        let scene = scene(text);
        linear(&scene, scene.model.attenuation.as_ref().unwrap())
    };
    let ranged = |range: &str| of(&format!("{text}range = {range}\n"));
    // gamma* = 0.894...
    let found = ranged("[1, 3]").unwrap();
    assert_eq!((found.star, found.cause), (1.0, Cause::None));
    let error = ranged("[0.1, 0.5]").unwrap_err().to_string();
    assert!(
        error.contains("no solution at any level of attenuation from 0.1 to 0.5"),
        "{error}"
    );
    let gain = text.replace("gamma^2*", "(1/gamma)^2*");
    let error = of(&format!("{gain}range = [0.1, 10]\n"))
        .unwrap_err()
        .to_string();
    assert!(error.contains("no solution at any level"), "{error}");
    let error = of(&text.replace("gamma = 2.0", "gamma = -2.0"))
        .unwrap_err()
        .to_string();
    assert!(error.contains("is not above 0"), "{error}");
    // Neither smaller nor larger is easier throughout.
    let bump = text.replace("gamma^2*", "(2.5 - (gamma - 2)^2)*");
    let error = of(&format!("{bump}range = [0.6, 3.4]\n"))
        .unwrap_err()
        .to_string();
    assert!(error.contains("no solution"), "{error}");
    let wave = text.replace("gamma^2*", "(1.3 + sin(gamma))*");
    let error = of(&format!("{wave}range = [4, 16]\n"))
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("a larger value of the parameter must be easier"),
        "{error}"
    );
    // The disturbance does not reach the cost: nothing stops P.
    let harmless = Game::new(
        2,
        &[-1.0, 0.0, 0.0, -1.0],
        &[1.0, 0.0],
        &[0.0, 1.0],
        1.0,
        2.0,
    );
    let mut harmless = harmless;
    harmless.q[(1, 1)] = 0.0;
    assert_eq!(harmless.star().cause, Cause::None);
}

/// Ten states, of which so many are valid.
fn ten(valid: usize) -> Outcome {
    let status = (0..10).map(|k| {
        if k < valid {
            PointStatus::Converged
        } else {
            PointStatus::Fold
        }
    });
    Outcome {
        status: status.collect(),
        v: vec![0.0; 10],
        folds: Vec::new(),
        failure: None,
    }
}

const SOUGHT: Sought = Sought {
    star: 1.0,
    allowed: false,
    own: 4.0,
    top: None,
    tolerance: 1e-3,
};

fn searched(
    sought: Sought,
    valid: impl Fn(f64) -> usize,
) -> (costate::low_level::attenuation::Search, Vec<f64>) {
    let mut evaluate = |value: f64| Ok::<_, Infallible>(ten(valid(value)));
    search(&sought, &[], &mut evaluate).unwrap()
}

#[test]
fn the_search_brackets_a_monotone_coverage() {
    let (found, levels) = searched(SOUGHT, |v| {
        (10.0 * (v - 1.0) / (std::f64::consts::E - 1.0)).min(10.0) as usize
    });
    let Covering::Smallest { lower, upper } = found.covering else {
        panic!("{:?}", found.covering)
    };
    assert!(lower < std::f64::consts::E && upper >= std::f64::consts::E && upper / lower <= 1.001);
    assert!(found.monotone && found.covering_below().is_empty());
    assert!(
        found.rows.len() >= 12 && found.rows.last().unwrap().value > 1.4 * upper,
        "a real curve"
    );
    assert_eq!(
        found.first_failing().unwrap().failing(),
        [(PointStatus::Fold, 1)]
    );
    assert!(
        levels.len() == 3 && levels[0] > 1.0 && levels[0] < 1.2 && levels[2] == 4.0,
        "{levels:?}"
    );
    assert!(
        levels
            .iter()
            .all(|l| found.rows.iter().any(|r| r.value == *l))
    );
}

#[test]
fn the_search_tells_what_is_not_monotone() {
    // Covered above 2, and between 1.2 and 1.5.
    let (found, _) = searched(SOUGHT, |v| {
        if v > 2.0 || (1.2..1.5).contains(&v) {
            10
        } else {
            7
        }
    });
    let Covering::Smallest { lower, upper } = found.covering else {
        panic!("{:?}", found.covering)
    };
    assert!(lower <= 2.0 && upper > 2.0, "from {upper} on all cover");
    assert!(!found.monotone && !found.covering_below().is_empty());
}

#[test]
fn the_search_tells_what_is_never_covered() {
    let (found, levels) = searched(SOUGHT, |_| 6);
    assert_eq!(
        found.covering,
        Covering::Never {
            top: 256.0,
            coverage: 0.6
        }
    );
    assert_eq!((found.smallest(), levels.len()), (None, 3));
    let (found, _) = searched(
        Sought {
            top: Some(9.0),
            ..SOUGHT
        },
        |_| 6,
    );
    assert_eq!(
        found.covering,
        Covering::Never {
            top: 9.0,
            coverage: 0.6
        }
    );
}

#[test]
fn the_search_ends_at_gamma_star() {
    let (found, _) = searched(SOUGHT, |_| 10);
    assert_eq!(found.covering, Covering::All { upper: 1.001 });
    let range = Sought {
        allowed: true,
        top: Some(9.0),
        ..SOUGHT
    };
    let (found, _) = searched(range, |_| 10);
    assert_eq!(found.covering, Covering::All { upper: 1.0 });
}

/// x' = -x + b u + w, L = 1/2 (x^2 + e x^4 + r u^2 - g^2 w^2). With S = b^2/r - 1/g^2 < 0 the
/// manifold p = x (-1 + sqrt(1 + S (1 + e x^2)))/S folds at x^2 = (-1/S - 1)/e.
const SCALAR: &str = r#"
parameters = { gamma = 2.0, b = 0.5, r = 1.0, e = 1.0 }
states = { x = {} }
controls = { u = {} }
disturbances = { w = {} }
dynamics = { x = "-x + b*u + w" }
cost = { running = "0.5*(x^2 + e*x^4 + r*u^2 - gamma^2*w^2)" }
equilibrium = { x = 0, u = 0 }
region = { x = [-1, 1] }
attenuation = { parameter = "gamma", tolerance = 1e-4, states = { x = [-1, 1, 21] } }
"#;

#[test]
fn the_region_of_a_scalar_game() {
    let found = smallest(&scene(SCALAR), &Cpu::new(), Choices::default(), &mut |_| {}).unwrap();
    agrees(&found.linear, 1.25f64.sqrt().recip(), Cause::Axis);
    let exact = 0.75f64.sqrt().recip();
    let Covering::Smallest { lower, upper } = found.search.covering else {
        panic!("{:?}", found.search.covering)
    };
    assert!(
        lower <= exact && exact <= upper * (1.0 + 1e-6) && upper / lower <= 1.0 + 1e-4,
        "{lower} {exact} {upper}"
    );
    println!("smallest covering: {lower:.6} to {upper:.6}, exact {exact:.6}");
    for row in &found.search.rows {
        let s = 0.25 - row.value.powi(-2);
        let fold = if s < 0.0 {
            (-1.0 / s - 1.0).max(0.0).sqrt()
        } else {
            f64::INFINITY
        };
        for ((x, status), v) in found
            .grid
            .points()
            .iter()
            .zip(&row.outcome.status)
            .zip(&row.outcome.v)
        {
            // Within this distance of the fold either is right.
            if (x.abs() - fold).abs() > 1e-3 {
                assert_eq!(
                    *status == PointStatus::Converged,
                    x.abs() < fold,
                    "gamma {}, x {x}",
                    row.value
                );
            }
            if v.is_finite() && s != 0.0 {
                // V = int_0^x p.
                let f =
                    |x: f64| (-0.5 * x * x + (1.0 + s * (1.0 + x * x)).powf(1.5) / (3.0 * s)) / s;
                let exact = f(*x) - f(0.0);
                assert!(
                    (v - exact).abs() < 1e-8 * (1.0 + exact),
                    "gamma {}, x {x}: {v}, {exact}",
                    row.value
                );
            }
        }
    }
}

fn folder(name: &str) -> PathBuf {
    let path =
        std::env::temp_dir().join(format!("costate-attenuation-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&path).unwrap();
    path
}

fn costate(command: &str, scene: &Path, more: &[&str]) -> Output {
    let mut all = Command::new(env!("CARGO_BIN_EXE_costate"));
    all.arg(command).arg(scene).args(more).output().unwrap()
}

#[test]
fn a_level_below_gamma_star_is_refused() {
    let folder = folder("refused");
    let out = folder.join("out.h5");
    let points = folder.join("points.csv");
    std::fs::write(&points, "x\n0.5\n").unwrap();
    let named = folder.join("named.toml");
    std::fs::write(&named, SCALAR.replace("gamma = 2.0", "gamma = 0.8")).unwrap();
    let anonymous = folder.join("anonymous.toml");
    let no_section: String = SCALAR
        .lines()
        .filter(|l| !l.starts_with("attenuation"))
        .map(|l| format!("{l}\n"))
        .collect();
    std::fs::write(&anonymous, no_section.replace("gamma = 2.0", "gamma = 0.8")).unwrap();
    let (out_text, points) = (out.display().to_string(), points.display().to_string());
    let to = ["--out", out_text.as_str()];
    let all: [(&str, Vec<&str>); 6] = [
        ("run", to.to_vec()),
        ("shoot-out", to.to_vec()),
        ("homotopy", to.to_vec()),
        ("attenuation", to.to_vec()),
        ("solve", [&to[..], &["--points", &points]].concat()),
        ("check", Vec::new()),
    ];
    for (command, more) in &all {
        for (scene, words) in [
            (
                &named,
                [
                    "gamma = 0.8 is not above gamma* = 0.8944271910",
                    "named.toml:2:24",
                ],
            ),
            (
                &anonymous,
                ["below what the linearization allows", "[attenuation]"],
            ),
        ] {
            if scene == &anonymous && *command == "attenuation" {
                continue;
            }
            let done = costate(command, scene, more);
            let text = String::from_utf8_lossy(&done.stderr).replace("\n  ", " ");
            assert_eq!(done.status.code(), Some(2), "{command}: {text}");
            for part in words {
                assert!(text.contains(part), "{command}: {part} is not in\n{text}");
            }
            assert!(
                done.stdout.is_empty() && !out.exists(),
                "{command} wrote something"
            );
        }
    }
    // A value that is not the file's has no place in it.
    std::fs::write(&named, SCALAR).unwrap();
    let done = costate("run", &named, &["--set", "gamma=0.5", "--out", &out_text]);
    let text = String::from_utf8_lossy(&done.stderr).replace("\n  ", " ");
    assert_eq!(done.status.code(), Some(2), "{text}");
    assert!(
        text.contains("--set gamma=0.5")
            && text.contains("0.8944271910")
            && !text.contains("named.toml:"),
        "{text}"
    );
    let done = costate("attenuation", &anonymous, &["--set", "gamma=2"]);
    let text = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.code(), Some(2), "{text}");
    assert!(text.contains("no [attenuation]"), "{text}");
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn the_command_and_its_file() {
    let folder = folder("command");
    let (scene, out) = (folder.join("scene.toml"), folder.join("out.h5"));
    std::fs::write(
        &scene,
        SCALAR.replace("tolerance = 1e-4", "tolerance = 1e-2, levels = [1.0, 1.5]"),
    )
    .unwrap();
    let out_text = out.display().to_string();
    let done = costate(
        "attenuation",
        &scene,
        &["--out", &out_text, "--backend", "cpu", "--json"],
    );
    let text = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(done.status.success(), "{text}");
    let json: serde_json::Value = serde_json::from_slice(&done.stdout).unwrap();
    assert_eq!(
        (json["cause"].as_str(), json["covered"].as_str()),
        (Some("axis"), Some("smallest"))
    );
    crate::common_commands::in_schema(&out);
    let stored = Stored::open(&out).unwrap();
    let group = stored.group("attenuation").unwrap();
    let values = group.f64("value").unwrap().values;
    assert_eq!(values.len(), json["curve"].as_array().unwrap().len());
    assert!(values.is_sorted() && values.contains(&1.0) && values.contains(&1.5));
    assert_eq!(
        group.f64("star").unwrap().values,
        [json["star"].as_f64().unwrap()]
    );
    let (shape, counts) = group.i32("states").unwrap();
    assert_eq!(shape, [values.len(), PointStatus::ALL.len()]);
    assert!(counts.chunks(shape[1]).all(|c| c.iter().sum::<i32>() == 21));
    let regions = stored.group("attenuation_regions").unwrap();
    assert_eq!(regions.f64("level").unwrap().values, [1.0, 1.5]);
    let (v, (shape, status)) = (regions.f64("V").unwrap(), regions.i32("status").unwrap());
    assert_eq!(
        (v.shape.as_slice(), shape.as_slice()),
        (&[2, 21][..], &[2, 21][..])
    );
    assert!(
        v.values
            .iter()
            .zip(&status)
            .all(|(v, s)| v.is_finite() == (*s == 0))
    );
    assert!(status[..21].iter().any(|s| *s != 0) && status[21..].iter().all(|s| *s == 0));
    for picture in [
        "out_coverage.svg",
        "out_coverage.png",
        "out_validity.svg",
        "out_validity.png",
    ] {
        assert!(folder.join(picture).exists(), "{picture}");
    }
    // As a part of a run, and on its page.
    let text = std::fs::read_to_string(&scene).unwrap();
    std::fs::write(&scene, text + "shoot_out = { value_max = 0.3 }\n").unwrap();
    let ran = folder.join("run.h5");
    let done = costate(
        "run",
        &scene,
        &[
            "--out",
            &ran.display().to_string(),
            "--backend",
            "cpu",
            "--json",
        ],
    );
    let text = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(done.status.success(), "{text}");
    let json: serde_json::Value = serde_json::from_slice(&done.stdout).unwrap();
    assert!(json["attenuation"]["smallest_covering"].is_f64(), "{json}");
    crate::common_commands::in_schema(&ran);
    assert!(Stored::open(&ran).unwrap().has("attenuation_regions"));
    let page = std::fs::read_to_string(folder.join("run_report.html")).unwrap();
    for part in [
        "id=\"coverage\"",
        "id=\"validity\"",
        "0.89443 of the linearization",
    ] {
        assert!(page.contains(part), "{part}");
    }
    let done = costate("check", &scene, &[]);
    let text = String::from_utf8_lossy(&done.stdout).into_owned();
    assert!(text.contains("gamma* = 0.894427191"), "{text}");
    // A level that cannot be is told before anything is solved.
    std::fs::write(&scene, SCALAR.replace("tolerance = 1e-4", "levels = [0.5]")).unwrap();
    let none = folder.join("none.h5");
    let done = costate(
        "attenuation",
        &scene,
        &["--out", &none.display().to_string()],
    );
    let text = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.code(), Some(2), "{text}");
    assert!(
        text.contains("level 0.5") && text.contains("0.8944271910") && !none.exists(),
        "{text}"
    );
    std::fs::remove_dir_all(folder).unwrap();
}
