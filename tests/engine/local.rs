//! The solution near the equilibrium: the Riccati equation, the higher terms of V, and the
//! refusals.

use crate::common_oracles;

use crate::common_problems::{Exact, manufactured};
use common_oracles::{Random, derive, norm, parse, scene};
use costate::low_level::hamiltonian::System;
use costate::low_level::local::{LocalError, LocalSolution, Riccati, SeedChoice};
use costate::low_level::model::{Model, SeedValue};
use nalgebra::{DMatrix, DVector};
use std::fmt::Write;

/// Largest residual of the Riccati equation relative to its terms that the project promises.
const RESIDUAL: f64 = 1e-10;

const INFINITE: [&str; 5] = [
    "pendulum",
    "moore_greitzer",
    "moore_greitzer_unconstrained",
    "linear_quadratic",
    "manufactured",
];

fn solve(model: &Model) -> Result<Riccati, LocalError> {
    Riccati::solve(&derive(model), model)
}

fn solved(model: &Model) -> Riccati {
    solve(model).unwrap_or_else(|e| panic!("{e}"))
}

/// A linear-quadratic problem by its matrices; R and Q diagonal.
#[derive(Clone, Debug)]
struct Linear {
    a: DMatrix<f64>,
    b: DMatrix<f64>,
    q: DVector<f64>,
    r: DVector<f64>,
    /// Half-widths of the region.
    region: DVector<f64>,
}

impl Linear {
    fn new(n: usize, a: &[f64], m: usize, b: &[f64], q: &[f64], r: &[f64]) -> Self {
        Self {
            a: DMatrix::from_row_slice(n, n, a),
            b: DMatrix::from_row_slice(n, m, b),
            q: DVector::from_column_slice(q),
            r: DVector::from_column_slice(r),
            region: DVector::from_element(n, 1.0),
        }
    }

    fn random(random: &mut Random, n: usize, m: usize) -> Self {
        Self {
            a: DMatrix::from_fn(n, n, |_, _| random.within(-1.0, 1.0)),
            b: DMatrix::from_fn(n, m, |_, _| random.within(-1.0, 1.0)),
            q: DVector::from_fn(n, |_, _| random.within(0.1, 2.0)),
            r: DVector::from_fn(m, |_, _| random.within(0.1, 2.0)),
            region: DVector::from_element(n, 1.0),
        }
    }

    /// The same with x = D z.
    fn in_units(&self, d: &DVector<f64>) -> Self {
        let scale = DMatrix::from_diagonal(d);
        let inverse = DMatrix::from_diagonal(&d.map(|x| 1.0 / x));
        Self {
            a: &inverse * &self.a * &scale,
            b: &inverse * &self.b,
            q: self.q.component_mul(d).component_mul(d),
            r: self.r.clone(),
            region: self.region.component_div(d),
        }
    }

    fn text(&self) -> String {
        let (n, m) = (self.a.nrows(), self.b.ncols());
        let mut t = String::from("[states]\n");
        let mut line = |s: String| writeln!(t, "{s}").expect("a String takes everything");
        (0..n).for_each(|i| line(format!("x{i} = {{}}")));
        line("[controls]".into());
        (0..m).for_each(|j| line(format!("u{j} = {{}}")));
        line("[dynamics]".into());
        for i in 0..n {
            let states = (0..n).map(|j| format!("({:e})*x{j}", self.a[(i, j)]));
            let controls = (0..m).map(|j| format!("({:e})*u{j}", self.b[(i, j)]));
            line(format!(
                "x{i} = \"{}\"",
                states.chain(controls).collect::<Vec<_>>().join(" + ")
            ));
        }
        line("[cost]".into());
        let states = (0..n).map(|i| format!("({:e})*x{i}^2", 0.5 * self.q[i]));
        let controls = (0..m).map(|j| format!("({:e})*u{j}^2", 0.5 * self.r[j]));
        line(format!(
            "running = \"{}\"",
            states.chain(controls).collect::<Vec<_>>().join(" + ")
        ));
        line("[equilibrium]".into());
        (0..n).for_each(|i| line(format!("x{i} = 0")));
        (0..m).for_each(|j| line(format!("u{j} = 0")));
        line("[region]".into());
        (0..n).for_each(|i| {
            line(format!(
                "x{i} = [{:e}, {:e}]",
                -self.region[i], self.region[i]
            ))
        });
        line("[shoot_out]\nvalue_max = 1.0".into());
        t
    }

    fn model(&self) -> Model {
        parse(&self.text())
    }

    /// `|A'P + PA - P B R^-1 B'P + Q|` relative to the terms.
    fn residual(&self, p: &DMatrix<f64>) -> f64 {
        let pb = p * &self.b;
        let gain = DMatrix::from_diagonal(&self.r.map(|r| 1.0 / r)) * pb.transpose();
        let q = DMatrix::from_diagonal(&self.q);
        let pa = p * &self.a;
        (pa.transpose() + &pa - &pb * &gain + &q).norm()
            / (2.0 * pa.norm() + (&pb * &gain).norm() + q.norm())
    }

    /// Checks the solution against the matrices alone.
    fn check(&self, what: &str) -> Riccati {
        let solution = solved(&self.model());
        let p = &solution.p;
        assert!(
            self.residual(p) <= RESIDUAL,
            "{what}: residual {:e}",
            self.residual(p)
        );
        assert!(
            (p - p.transpose()).norm() <= RESIDUAL * p.norm(),
            "{what}: P is symmetric"
        );
        assert!(p.clone().cholesky().is_some(), "{what}: P > 0");
        let gain = DMatrix::from_diagonal(&self.r.map(|r| 1.0 / r)) * self.b.transpose() * p;
        let closed = &self.a - &self.b * gain;
        assert!(
            (&closed - &solution.closed_loop).norm() <= RESIDUAL * closed.norm(),
            "{what}: A - B K"
        );
        assert!(
            closed.complex_eigenvalues().iter().all(|e| e.re < 0.0),
            "{what}: stable"
        );
        solution
    }
}

#[test]
fn residuals_of_the_shipped_scenes() {
    for name in INFINITE {
        let solution = solved(&scene(name, &[]));
        println!("{name}: residual {:.1e}", solution.residual);
        assert!(
            solution.residual <= RESIDUAL,
            "{name}: {:e}",
            solution.residual
        );
        assert!(solution.eigenvalues.iter().all(|e| e.re < 0.0), "{name}");
    }
}

#[test]
fn the_compressor_closed_loop_is_the_known_one() {
    // Printed digits: half a unit of the last.
    let known = [
        (-1.76, 0.0, 0.005),
        (-1.066, 0.0, 0.0005),
        (-0.82, -1.18, 0.005),
        (-0.82, 1.18, 0.005),
    ];
    let found = solved(&scene("moore_greitzer", &[])).eigenvalues;
    assert_eq!(found.len(), known.len());
    for (re, im, digits) in known {
        assert!(
            found
                .iter()
                .any(|e| (e.re - re).abs() <= digits && (e.im - im).abs() <= digits),
            "{re} + {im}i is not among {found:?}"
        );
    }
}

/// sigma (1 - Phi0^2) is uncontrollable: it must be among the closed loop's eigenvalues as it is.
#[test]
fn uncontrollable_modes_stay() {
    for (name, flow) in [
        ("moore_greitzer", "1.2"),
        ("moore_greitzer", "1.05"),
        ("moore_greitzer_unconstrained", "1.4"),
    ] {
        let solution = solved(&scene(name, &[("Phi0", flow)]));
        let flow: f64 = flow.parse().expect("a number");
        let rate = 4.0 * (1.0 - flow * flow);
        let nearest = solution
            .eigenvalues
            .iter()
            .map(|e| (e.re - rate).hypot(e.im))
            .fold(f64::INFINITY, f64::min);
        assert!(
            nearest <= RESIDUAL * rate.abs(),
            "{name} at {flow}: {rate} is missed by {nearest:e}"
        );
    }
    let coupled = Linear::new(
        3,
        &[-0.3, 0.0, 0.0, 0.4, 1.0, 0.2, 0.0, -0.5, 0.1],
        1,
        &[0.0, 1.0, 0.5],
        &[1.0; 3],
        &[1.0],
    );
    let found = coupled.check("a coupled uncontrollable mode").eigenvalues;
    assert!(
        found
            .iter()
            .any(|e| (e.re + 0.3).abs() <= RESIDUAL && e.im == 0.0),
        "-0.3 is not among {found:?}"
    );
}

#[test]
fn one_state_has_the_root_of_the_quadratic() {
    for (a, b, q, r) in [
        (1.0, 1.0, 1.0, 1.0),
        (-3.0, 0.5, 0.2, 2.0),
        (0.0, 1.0, 4.0, 1.0),
        (5.0, 0.1, 1e-3, 1.0),
    ] {
        let p = Linear::new(1, &[a], 1, &[b], &[q], &[r])
            .check("one state")
            .p[(0, 0)];
        let g = b * b / r;
        let exact = (a + f64::hypot(a, (g * q).sqrt())) / g;
        assert!(
            (p - exact).abs() <= RESIDUAL * exact,
            "a = {a}: {p} for {exact}"
        );
    }
}

#[test]
fn random_systems_of_many_states() {
    let mut random = Random::new(5);
    for (n, m) in [(2, 1), (3, 1), (6, 1), (6, 2), (8, 2), (12, 1), (12, 4)] {
        for trial in 0..3 {
            let linear = Linear::random(&mut random, n, m);
            let solution = linear.check(&format!("{n} states, {m} controls, number {trial}"));
            println!(
                "{n} states, {m} controls: residual {:.1e}",
                linear.residual(&solution.p)
            );
        }
    }
}

#[test]
fn units_do_not_matter() {
    let mut random = Random::new(9);
    for n in [2, 4, 6] {
        let linear = Linear::random(&mut random, n, 2);
        let plain = linear.check("plain");
        for trial in 0..3 {
            let d = DVector::from_fn(n, |_, _| {
                10f64.powi([-6, 0, 6][(random.bits() % 3) as usize])
            });
            let scaled = linear.in_units(&d);
            let found = solved(&scaled.model());
            // P in the new units is D P D; compared in the old ones.
            let back = DMatrix::from_fn(n, n, |i, j| found.p[(i, j)] / (d[i] * d[j]));
            let error = (&back - &plain.p).norm() / plain.p.norm();
            assert!(
                error <= RESIDUAL,
                "{n} states, number {trial}: P differs by {error:e}"
            );
            for (e, f) in plain.eigenvalues.iter().zip(&found.eigenvalues) {
                assert!((e - f).norm() <= 1e-8 * e.norm(), "{e} and {f}");
            }
        }
    }
}

#[test]
fn what_cannot_be_stabilized_is_refused_with_the_eigenvalue() {
    let unstable = Linear::new(
        2,
        &[0.75, 0.0, 0.0, -1.0],
        1,
        &[0.0, 1.0],
        &[1.0, 1.0],
        &[1.0],
    );
    match solve(&unstable.model()) {
        Err(e @ LocalError::NotStabilizable { .. }) => {
            assert!(e.to_string().contains("0.75"), "{e}")
        }
        other => panic!("{other:?}"),
    }
    // A pair: the numbers come with their imaginary parts.
    let pair = Linear::new(
        3,
        &[0.1, 2.0, 0.0, -2.0, 0.1, 0.0, 0.0, 0.0, -1.0],
        1,
        &[0.0, 0.0, 1.0],
        &[1.0; 3],
        &[1.0],
    );
    match solve(&pair.model()) {
        Err(e @ LocalError::NotStabilizable { .. }) => assert!(
            e.to_string().contains("0.1") && e.to_string().contains("2.000000i"),
            "{e}"
        ),
        other => panic!("{other:?}"),
    }
}

#[test]
fn the_compressor_at_the_peak_is_refused() {
    for name in ["moore_greitzer", "moore_greitzer_unconstrained"] {
        match solve(&scene(name, &[("Phi0", "1.0")])) {
            Err(
                LocalError::NotStabilizable { eigenvalue, .. }
                | LocalError::ImaginaryAxis { eigenvalue, .. },
            ) => {
                assert!(
                    eigenvalue.trim_start_matches('-').starts_with("0.000000"),
                    "{name}: {eigenvalue}"
                );
            }
            other => panic!("{name}: {other:?}"),
        }
    }
    // Beyond the peak the mode grows: 4 (1 - 0.9^2) = 0.76.
    match solve(&scene("moore_greitzer", &[("Phi0", "0.9")])) {
        Err(LocalError::NotStabilizable { eigenvalue, .. }) => {
            assert!(eigenvalue.starts_with("0.76"), "{eigenvalue}")
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn imaginary_axis_is_refused() {
    // Controllable, but the cost does not see the oscillation.
    let unseen = Linear::new(
        2,
        &[0.0, 1.5, -1.5, 0.0],
        1,
        &[0.0, 1.0],
        &[0.0, 0.0],
        &[1.0],
    );
    match solve(&unseen.model()) {
        Err(LocalError::ImaginaryAxis { eigenvalue, .. }) => {
            assert!(eigenvalue.contains("1.500000i"), "{eigenvalue}")
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_value_that_is_not_positive_is_refused() {
    // The second state decays by itself, costs nothing and moves nothing.
    let free = Linear::new(
        2,
        &[0.5, 0.0, 0.0, -1.0],
        1,
        &[1.0, 0.0],
        &[1.0, 0.0],
        &[1.0],
    );
    match solve(&free.model()) {
        Err(e @ LocalError::NotPositive { .. }) => assert!(e.to_string().contains("x1: "), "{e}"),
        other => panic!("{other:?}"),
    }
}

/// The local solution of a scene for an asked error of V.
fn local(
    model: &Model,
    asked: SeedValue,
    tolerance: f64,
    ceiling: f64,
) -> Result<LocalSolution, LocalError> {
    let hamiltonian = derive(model);
    let system = System::new(&hamiltonian, model);
    let riccati = Riccati::solve(&hamiltonian, model)?;
    LocalSolution::new(
        &system,
        model,
        riccati,
        SeedChoice {
            asked,
            tolerance,
            ceiling,
            outer: ceiling,
        },
    )
}

#[test]
fn a_seed_value_out_of_range_is_refused() {
    for name in INFINITE {
        let model = scene(name, &[]);
        match local(&model, SeedValue::Value(1e3), 1e-9, 2e3) {
            Err(LocalError::SeedTooLarge { value, reason }) => {
                assert_eq!(value, 1e3);
                assert!(reason.contains("V = "), "{reason}");
            }
            other => panic!("{name}: {:?}", other.map(|l| l.seed_value)),
        }
        let small = local(&model, SeedValue::Value(1e-5), 1e-9, 1.0)
            .unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(small.seed_value, 1e-5);
    }
}

/// Directions in the plane.
fn circle() -> impl Iterator<Item = [f64; 2]> {
    (0..64).map(|k| {
        let angle = std::f64::consts::TAU * f64::from(k) / 64.0;
        [angle.cos(), angle.sin()]
    })
}

#[test]
fn the_expansion_converges_with_its_order() {
    let model = scene("manufactured", &[]);
    // So small a tolerance that the highest degree is worth it.
    let local = local(&model, SeedValue::Auto, 1e-12, 1.0).unwrap_or_else(|e| panic!("{e}"));
    // This V is even, so after degree 6 the first term missed is of degree 8.
    assert_eq!(local.degree, 6);
    let (order_v, order_p) = (8.0, 7.0);
    let errors = |radius: f64| {
        circle().fold((0.0f64, 0.0f64), |(v, p), d| {
            let s = [radius * d[0], radius * d[1]];
            let found = local.at_state(&s);
            let Exact {
                v: exact, p: slope, ..
            } = manufactured::at(&s);
            assert!(
                (found[0] - s[0]).abs() + (found[1] - s[1]).abs() <= 8.0 * f64::EPSILON * radius,
                "s is s"
            );
            (
                v.max((found[4] - exact).abs()),
                p.max(norm(&[found[2] - slope[0], found[3] - slope[1]])),
            )
        })
    };
    let radii = [1.6, 0.8, 0.4];
    let found: Vec<_> = radii.map(errors).into_iter().collect();
    for pair in found.windows(2) {
        let (v, p) = (
            (pair[0].0 / pair[1].0).log2(),
            (pair[0].1 / pair[1].1).log2(),
        );
        println!("observed orders: V {v:.2}, p {p:.2}");
        // The next term is r^2/90 of this one: at r = 1.6 it takes 0.04 off the order.
        assert!(
            (v - order_v).abs() < 0.1 && (p - order_p).abs() < 0.1,
            "orders {v}, {p}"
        );
    }
}

/// H(s, dV/ds) of an expansion to degree d begins with degree d + 1, for every scene.
#[test]
fn the_expansion_solves_the_equation_to_its_order() {
    for name in INFINITE {
        let model = scene(name, &[]);
        let system = System::new(&derive(&model), &model);
        let value_max = model
            .shoot_out
            .as_ref()
            .and_then(|s| s.value_max)
            .expect("an infinite horizon");
        let local = local(&model, SeedValue::Auto, 1e-10 * value_max, 0.01 * value_max)
            .unwrap_or_else(|e| panic!("{name}: {e}"));
        let n = model.states.len();
        let mut random = Random::new(17);
        let directions: Vec<Vec<f64>> = (0..200)
            .map(|_| {
                let d: Vec<f64> = (0..n).map(|_| random.normal()).collect();
                d.iter().map(|x| x / norm(&d)).collect()
            })
            .collect();
        // From the seeds inward: there the first missing term is the largest.
        let residual = |shrink: f64| {
            let worst = directions.iter().map(|d| {
                let seed = local.seed(d);
                let s: Vec<f64> = seed[..n].iter().map(|s| shrink * s).collect();
                let p = &local.at_state(&s)[n..2 * n];
                system.eval(&[system.observer.hamiltonian], &s, p)[0].abs()
            });
            worst.fold(0.0, f64::max)
        };
        let (far, near) = (residual(1.0), residual(0.5));
        println!(
            "{name}: degree {}, seeds at V = {:.2e}, |H| {far:.1e} there, {near:.1e} half-way",
            local.degree, local.seed_value
        );
        // A linear system is solved by the quadratic V; only rounding of L is left.
        if near <= 100.0 * f64::EPSILON * local.seed_value {
            continue;
        }
        let order = (far / near).log2();
        // Half an order for the terms after the first.
        assert!(
            order >= local.degree as f64 + 0.5,
            "{name}: order {order} at degree {}",
            local.degree
        );
    }
}

/// The error that is told, and by which the seeds are placed, is that of V there.
#[test]
fn the_error_told_is_not_below_the_true_one() {
    /// The estimate is the largest term left out; all of them together may be this much larger.
    const LATER_TERMS: f64 = 1.5;
    let model = scene("manufactured", &[]);
    for tolerance in [1e-5, 1e-6, 1e-7, 1e-8, 1e-10, 1e-12, 1e-14] {
        let local =
            local(&model, SeedValue::Auto, tolerance, 1.0).unwrap_or_else(|e| panic!("{e}"));
        assert!(local.error <= tolerance, "{} for {tolerance}", local.error);
        let true_error = circle()
            .map(|d| {
                let seed = local.seed(&d);
                (seed[4] - manufactured::value(&seed)).abs()
            })
            .fold(0.0, f64::max);
        println!(
            "asked {tolerance:.0e}: degree {}, V = {:.2e}, told {:.1e}, true {true_error:.1e}",
            local.degree, local.seed_value, local.error
        );
        let rounding = 16.0 * f64::EPSILON * local.seed_value;
        assert!(
            true_error <= LATER_TERMS * local.error + rounding,
            "true {true_error:e}, told {:e}",
            local.error
        );
    }
}

/// A chain of integrators: its matrix is defective, and the QR iteration on it as it is stands
/// still.
#[test]
fn a_triple_integrator_is_solved() {
    let model = costate::low_level::scenario::parse(
        r#"
        states = { a = {}, b = {}, c = {} }
        controls = { u = {} }
        dynamics = { a = "b", b = "c", c = "u" }
        cost = { running = "0.5*(a^2 + u^2)" }
        equilibrium = { a = 0, b = 0, c = 0, u = 0 }
        region = { a = [-1, 1], b = [-1, 1], c = [-1, 1] }
        "#,
        "test.toml",
        &[],
    )
    .unwrap_or_else(|e| panic!("{}", e.render(false)));
    let hamiltonian = costate::low_level::hamiltonian::Hamiltonian::derive(&model).unwrap();
    let riccati = costate::low_level::local::Riccati::solve(&hamiltonian, &model).unwrap();
    // s^3 + 2 s^2 + 2 s + 1: -1 and -1/2 +- sqrt(3)/2 i.
    let mut real: Vec<f64> = riccati.eigenvalues.iter().map(|e| e.re).collect();
    real.sort_by(f64::total_cmp);
    for (found, exact) in real.iter().zip([-1.0, -0.5, -0.5]) {
        assert!((found - exact).abs() < 1e-9, "{real:?}");
    }
}
