//! Whole sweeps of scenes whose value function is known everywhere, at every stored sample.
//!
//! Bounds: what the project promises for V, relative to V itself ([`Asked::promised`]). p is the
//! gradient of a V with that relative error over a front of that V's extent, so the same bound
//! holds for it relative to its length on that front; likewise u, relative to the largest on the
//! front.

use crate::common_oracles;

use common_oracles::{
    Asked, F32, F64, Random, Sample, Sweep, Worst, dot, minus, norm, parameter, scene,
};
use costate::low_level::model::Model;
use nalgebra::{DMatrix, DVector};

/// V, p and u at a state and, for a finite horizon, time left.
struct Exact {
    v: f64,
    p: Vec<f64>,
    u: Vec<f64>,
}

/// An error relative to a size; none is none, of nothing too (a trajectory that rests at the
/// origin).
fn relative(error: f64, size: f64) -> f64 {
    if error == 0.0 { 0.0 } else { error / size }
}

fn compare(name: &str, model: &Model, asked: Asked, exact: impl Fn(&Sample) -> Exact) {
    let sweep = Sweep::of(model, asked);
    let coverage = &sweep.report.coverage;
    assert_eq!(
        (coverage.uncovered, coverage.indistinguishable),
        (0, 0),
        "{name} is covered"
    );
    let (mut v, mut p, mut u) = (Worst::default(), Worst::default(), Worst::default());
    let mut where_v = (0.0, 0.0);
    let mut count = 0;
    for s in sweep.samples() {
        let e = exact(&s);
        let error = relative((s.v - e.v).abs(), e.v);
        if error > v.worst {
            where_v = (s.v, s.t);
        }
        v.see(error);
        p.see(relative(norm(&minus(s.p, &e.p)), norm(&e.p)));
        u.see(relative(
            norm(&minus(s.u, &e.u)),
            norm(&e.u).max(norm(&e.p)),
        ));
        count += 1;
    }
    assert!(
        count >= sweep.count() * sweep.levels() / 2,
        "{name}: only {count} samples of {} trajectories",
        sweep.count()
    );
    let what = |q| {
        format!(
            "{name} {} rtol {:e}: {q}",
            asked.precision.name(),
            asked.rtol
        )
    };
    println!(
        "{} trajectories, {count} samples; worst V at V = {:.3e}, t = {:.3}",
        sweep.count(),
        where_v.0,
        where_v.1
    );
    v.at_most(asked.promised(), &what("V"));
    p.at_most(asked.promised(), &what("p"));
    u.at_most(asked.promised(), &what("u"));
}

/// A, B, Q, R of the two masses, by hand.
fn masses(model: &Model) -> [DMatrix<f64>; 4] {
    let q = |name| parameter(model, name);
    let (m1, m2, k, kc, d) = (q("m1"), q("m2"), q("k"), q("kc"), q("d"));
    #[rustfmt::skip]
    let a = DMatrix::from_row_slice(4, 4, &[
        0.0, 1.0, 0.0, 0.0,
        -(k + kc) / m1, -d / m1, kc / m1, 0.0,
        0.0, 0.0, 0.0, 1.0,
        kc / m2, 0.0, -(k + kc) / m2, -d / m2,
    ]);
    let b = DMatrix::from_row_slice(4, 2, &[0.0, 0.0, 1.0 / m1, 0.0, 0.0, 0.0, 0.0, 1.0 / m2]);
    let weights = DMatrix::from_diagonal(&DVector::from_vec(vec![
        q("q_x"),
        q("q_v"),
        q("q_x"),
        q("q_v"),
    ]));
    let effort = DMatrix::from_diagonal(&DVector::from_vec(vec![q("r1"), q("r2")]));
    [a, b, weights, effort]
}

/// Kleinman's iteration (IEEE Trans. Automatic Control 13, 1968) from zero gain, which a stable A
/// allows.
fn kleinman([a, b, q, r]: &[DMatrix<f64>; 4]) -> (DMatrix<f64>, DMatrix<f64>) {
    let n = a.nrows();
    let identity = DMatrix::<f64>::identity(n, n);
    let mut gain = DMatrix::zeros(b.ncols(), n);
    let mut p = DMatrix::zeros(n, n);
    for _ in 0..30 {
        let closed = a - b * &gain;
        // closed'P + P closed = -(Q + gain'R gain), as a linear system of n^2 unknowns.
        let operator =
            identity.kronecker(&closed.transpose()) + closed.transpose().kronecker(&identity);
        let right = -(q + gain.transpose() * r * &gain);
        let x = operator
            .lu()
            .solve(&DVector::from_column_slice(right.as_slice()))
            .expect("a stable closed loop");
        p = DMatrix::from_column_slice(n, n, x.as_slice());
        gain = r.clone().try_inverse().expect("R > 0") * b.transpose() * &p;
    }
    let residual = a.transpose() * &p + &p * a - &p * b * &gain + q;
    // The operator's condition is about 10 here: 16 unknowns, some hundred roundings.
    assert!(
        residual.norm() < 1e-13 * p.norm(),
        "Kleinman's iteration converges"
    );
    (p, gain)
}

#[test]
fn linear_quadratic() {
    let model = scene("linear_quadratic", &[]);
    let (p, gain) = kleinman(&masses(&model));
    for asked in [F64, F32] {
        compare("linear_quadratic", &model, asked, |s| {
            let x = DVector::from_column_slice(s.x);
            let costate = &p * &x;
            Exact {
                v: 0.5 * costate.dot(&x),
                u: (-(&gain * &x)).as_slice().to_vec(),
                p: costate.as_slice().to_vec(),
            }
        });
    }
}

#[test]
fn manufactured() {
    let model = scene("manufactured", &[]);
    let r = parameter(&model, "r");
    for asked in [F64, F32] {
        compare("manufactured", &model, asked, |s| {
            let [x, y] = [s.x[0], s.x[1]];
            // (1 - cos x)/2 without cancellation.
            let v =
                0.5 * x * x + (0.5 * x).sin().powi(2) + 0.5 * x * y + y * y + 0.25 * x * x * y * y;
            let p = vec![
                x + 0.5 * x.sin() + 0.5 * y + 0.5 * x * y * y,
                0.5 * x + 2.0 * y + 0.5 * x * x * y,
            ];
            Exact {
                v,
                u: vec![-p[1] / r],
                p,
            }
        });
    }
}

#[test]
fn finite_horizon() {
    let model = scene("finite_horizon", &[]);
    let (end, s) = (parameter(&model, "T"), parameter(&model, "s"));
    for asked in [F64, F32] {
        compare("finite_horizon", &model, asked, |sample| {
            let tau = end - sample.t;
            let (y, v) = (sample.x[0] + sample.x[1] * tau, sample.x[1]);
            let d = (tau.powi(3) / 3.0 + 1.0 / s) * (tau + 1.0 / s) - tau.powi(4) / 4.0;
            let (a, b, c) = (
                (tau + 1.0 / s) / d,
                -tau * tau / (2.0 * d),
                (tau.powi(3) / 3.0 + 1.0 / s) / d,
            );
            // V = (a y^2 + 2 b y v + c v^2)/2 and dy/dx = 1, dy/dv = tau.
            let (p_y, p_v) = (a * y + b * v, b * y + c * v);
            let p = vec![p_y, p_y * tau + p_v];
            Exact {
                v: 0.5 * (p_y * y + p_v * v),
                u: vec![-p[1]],
                p,
            }
        });
    }
}

/// The bounds are not met by anything: a state moved by a thousandth of its size is noticed.
#[test]
fn the_comparison_notices_a_wrong_state() {
    let model = scene("linear_quadratic", &[]);
    let (p, _) = kleinman(&masses(&model));
    let mut random = Random::new(1);
    for _ in 0..100 {
        let x = random.point(&model.region);
        let value = |x: &[f64]| {
            let x = DVector::from_column_slice(x);
            0.5 * (x.transpose() * &p * &x)[0]
        };
        let moved: Vec<f64> = x.iter().map(|x| x * 1.001).collect();
        assert!((value(&moved) - value(&x)).abs() / value(&x) > F32.promised());
        assert!(dot(&x, &x) > 0.0);
    }
}
