//! Whole sweeps of scenes whose value function is known everywhere, at every stored sample.
//!
//! Bounds: what the project promises for V, relative to V itself ([`Asked::promised`]). p is the
//! gradient of a V with that relative error over a front of that V's extent, so the same bound
//! holds for it relative to its length on that front; likewise u, relative to the largest on the
//! front.

use crate::{common_oracles, common_problems};

use common_oracles::{
    Asked, F32, F64, Random, Sample, Sweep, Worst, dot, minus, norm, parameter, scene,
};
use common_problems::linear::{Linear, form, quadratic};
use common_problems::{Cart, Exact, manufactured};
use costate::low_level::model::Model;

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

#[test]
fn linear_quadratic() {
    let model = scene("linear_quadratic", &[]);
    let (p, gain) = Linear::masses(&model).optimal();
    for asked in [F64, F32] {
        compare("linear_quadratic", &model, asked, |s| {
            quadratic(&p, &gain, s.x)
        });
    }
}

#[test]
fn manufactured() {
    let model = scene("manufactured", &[]);
    for asked in [F64, F32] {
        compare("manufactured", &model, asked, |s| manufactured::at(s.x));
    }
}

#[test]
fn finite_horizon() {
    let model = scene("finite_horizon", &[]);
    let (end, cart) = (parameter(&model, "T"), Cart::of(&model));
    for asked in [F64, F32] {
        compare("finite_horizon", &model, asked, |s| cart.at(s.x, end - s.t));
    }
}

/// The bounds are not met by anything: a state moved by a thousandth of its size is noticed.
#[test]
fn the_comparison_notices_a_wrong_state() {
    let model = scene("linear_quadratic", &[]);
    let (p, _) = Linear::masses(&model).optimal();
    let mut random = Random::new(1);
    for _ in 0..100 {
        let x = random.point(&model.region);
        let value = |x: &[f64]| form(&p, x);
        let moved: Vec<f64> = x.iter().map(|x| x * 1.001).collect();
        assert!((value(&moved) - value(&x)).abs() / value(&x) > F32.promised());
        assert!(dot(&x, &x) > 0.0);
    }
}
