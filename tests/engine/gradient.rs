//! p is the gradient of V: between samples of neighbouring trajectories, V changes by what p says.
//!
//! For two points a small distance d apart, `V(b) - V(a) - (p(a) + p(b))/2 . (b - a)` is of third
//! order in d exactly if p is the gradient of V; relative to `|p| d`, of second order. Otherwise it
//! does not fall with d. V is known on fronts to rounding, so nothing but p and x enters. Lengths
//! are in widths of the region.

use crate::common_oracles;

use common_oracles::{F64, Sweep, norm, scene};
use costate::low_level::model::Model;

/// Order of the relative defect.
const ORDER: f64 = 2.0;
/// Half an order either way, for the terms after the first.
const SLACK: f64 = 0.5;

/// At order 2 defect / d^2 is the same at half the distance, but for which pairs there are; at
/// order 1 it doubles.
const GROWTH: f64 = 1.5;

/// A sample: x, p (both in widths) and V.
struct Point {
    x: Vec<f64>,
    p: Vec<f64>,
    v: f64,
}

fn point(sweep: &Sweep, i: usize, k: usize) -> Option<Point> {
    let sample = &sweep.raw.sample(i, k)[1..];
    let (n, widths) = (sweep.n, &sweep.plan.widths);
    (!sample[0].is_nan()).then(|| Point {
        x: sample[..n].iter().zip(widths).map(|(s, w)| s / w).collect(),
        p: sample[n..2 * n]
            .iter()
            .zip(widths)
            .map(|(p, w)| p * w)
            .collect(),
        v: sample[2 * n],
    })
}

/// Distance of two points and their defect, relative to |p| times it. `scale` multiplies p: 1, or
/// something wrong.
fn defect(a: &Point, b: &Point, scale: f64) -> (f64, f64) {
    let dx: Vec<f64> = b.x.iter().zip(&a.x).map(|(b, a)| b - a).collect();
    let said: f64 = (0..dx.len())
        .map(|i| 0.5 * scale * (a.p[i] + b.p[i]) * dx[i])
        .sum();
    let d = norm(&dx);
    (d, (b.v - a.v - said).abs() / (norm(&a.p) * d))
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Medians of distance and defect.
fn medians(pairs: &[(f64, f64)]) -> (f64, f64) {
    (
        median(pairs.iter().map(|p| p.0).collect()),
        median(pairs.iter().map(|p| p.1).collect()),
    )
}

/// Defect over distance squared, which all but a twentieth of the pairs are below.
fn law(pairs: &[(f64, f64)]) -> f64 {
    let mut laws: Vec<f64> = pairs.iter().map(|(d, e)| e / (d * d)).collect();
    laws.sort_by(f64::total_cmp);
    laws[laws.len() * 19 / 20]
}

fn order(coarse: (f64, f64), fine: (f64, f64)) -> f64 {
    (coarse.1 / fine.1).ln() / (coarse.0 / fine.0).ln()
}

fn swept(model: &Model, finer: usize) -> Sweep {
    let mut model = model.clone();
    let shoot_out = model.shoot_out.as_mut().expect("a sweep");
    shoot_out.spacing = 0.03 / finer as f64;
    shoot_out.samples = 60 * finer;
    Sweep::of(&model, F64)
}

/// Pairs along fronts, and pairs along trajectories.
fn pairs(sweep: &Sweep, scale: f64) -> [Vec<(f64, f64)>; 2] {
    let order = sweep.round_the_curve();
    let mut along = [Vec::new(), Vec::new()];
    for (at, i) in order.iter().enumerate() {
        let next = order[(at + 1) % order.len()];
        for k in 0..sweep.levels() {
            let Some(a) = point(sweep, *i, k) else { break };
            along[0].extend(point(sweep, next, k).map(|b| defect(&a, &b, scale)));
            if k > 0 {
                along[1].extend(point(sweep, *i, k - 1).map(|b| defect(&a, &b, scale)));
            }
        }
    }
    along
}

fn planar(name: &str) {
    let model = scene(name, &[]);
    let (coarse, fine) = (swept(&model, 1), swept(&model, 2));
    for (k, what) in ["along fronts", "along trajectories"]
        .into_iter()
        .enumerate()
    {
        let (a, b) = (
            medians(&pairs(&coarse, 1.0)[k]),
            medians(&pairs(&fine, 1.0)[k]),
        );
        println!(
            "{name} {what}: defect {:.1e} at {:.1e}, {:.1e} at {:.1e}: order {:.2}",
            a.1,
            a.0,
            b.1,
            b.0,
            order(a, b)
        );
        assert!(
            (order(a, b) - ORDER).abs() <= SLACK,
            "{name} {what}: order {}",
            order(a, b)
        );
        // Nor do the pairs that are worst by this law get worse.
        let (before, after) = (law(&pairs(&coarse, 1.0)[k]), law(&pairs(&fine, 1.0)[k]));
        assert!(
            after <= GROWTH * before,
            "{name} {what}: defect / d^2 goes from {before:.1e} to {after:.1e}"
        );
    }
    // Along trajectories a p of the wrong length shows. (Along fronts it is the direction that
    // counts.)
    let wrong = order(
        medians(&pairs(&coarse, 1.01)[1]),
        medians(&pairs(&fine, 1.01)[1]),
    );
    assert!(wrong < ORDER - SLACK, "order {wrong} for a wrong p");
}

#[test]
fn pendulum() {
    planar("pendulum");
}

#[test]
fn manufactured() {
    planar("manufactured");
}

/// Four states, with a clamp: the nearest other trajectory on the same front, near ones against far
/// ones.
#[test]
fn compressor() {
    let mut model = scene("moore_greitzer", &[]);
    model.shoot_out.as_mut().expect("a sweep").max_seeds = 1500;
    let sweep = Sweep::of(&model, F64);
    let mut pairs = Vec::new();
    for k in (0..sweep.levels()).step_by(6) {
        let points: Vec<Point> = (0..sweep.count())
            .filter_map(|i| point(&sweep, i, k))
            .collect();
        for (i, a) in points.iter().enumerate() {
            let distance = |b: &Point| norm(&[0, 1, 2, 3].map(|c| b.x[c] - a.x[c]));
            let others = points
                .iter()
                .enumerate()
                .filter(|(j, _)| *j != i)
                .map(|(_, b)| b);
            if let Some(b) = others.min_by(|b, c| distance(b).total_cmp(&distance(c))) {
                pairs.push(defect(a, b, 1.0));
            }
        }
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let third = pairs.len() / 3;
    let (near, far) = (medians(&pairs[..third]), medians(&pairs[2 * third..]));
    println!(
        "compressor: {} pairs, defect {:.1e} at {:.1e}, {:.1e} at {:.1e}: order {:.2}",
        pairs.len(),
        near.1,
        near.0,
        far.1,
        far.0,
        order(far, near)
    );
    assert!(
        (order(far, near) - ORDER).abs() <= SLACK,
        "order {}",
        order(far, near)
    );
}
