//! Sweeps of the scenes in scenarios/hard, on both backends and in both precisions: what is
//! expected of each stands at the top of its file. Oracles: exact V, p and u; the statuses that the
//! mathematics demands. The compressor's scenes are in tests/hard_compressor.rs, values at states
//! in tests/hard_states.rs.
//!
//! Bounds: what the project promises for V ([`Asked::promised`]), relative to V or to max(1, V).

use crate::common_hard;
use crate::common_oracles;
use crate::common_problems;

use common_hard::{everywhere, hard};
use common_oracles::{Asked, F32, F64, Sample, Sweep, Worst, dot, minus, norm, parameter, scene};
use common_problems::Exact;
use common_problems::linear::{Linear, diagonal, quadratic};
use costate::backend::{Run, Status};
use costate::low_level::model::Precision;
use costate::low_level::sweep::{Sampling, stiffness};
use nalgebra::DMatrix;

fn relative(error: f64, size: f64) -> f64 {
    if error == 0.0 { 0.0 } else { error / size }
}

/// p and u in units of the region's widths, so that states of different size count alike.
fn exact(sweep: &Sweep, asked: Asked, what: &str, right: impl Fn(&Sample) -> Exact) {
    let scaled = |p: &[f64]| {
        norm(
            &p.iter()
                .zip(&sweep.plan.widths)
                .map(|(p, w)| p * w)
                .collect::<Vec<_>>(),
        )
    };
    let (mut v, mut p, mut u) = (Worst::default(), Worst::default(), Worst::default());
    let largest = sweep
        .samples()
        .map(|s| norm(&right(&s).u))
        .fold(0.0, f64::max);
    // On a finite horizon V may be as small as it likes, and tolerances are absolute there: what is
    // a thousandth of the scene's is measured against that.
    let small = if sweep.plan.sampling == Sampling::Time {
        1e-3 * sweep.plan.value_scale
    } else {
        0.0
    };
    for s in sweep.samples() {
        let e = right(&s);
        v.see(relative((s.v - e.v).abs(), e.v + small));
        p.see(relative(scaled(&minus(s.p, &e.p)), scaled(&e.p) + small));
        u.see(relative(norm(&minus(s.u, &e.u)), largest));
    }
    v.at_most(asked.promised(), &format!("{what}: V"));
    p.at_most(asked.promised(), &format!("{what}: p"));
    u.at_most(asked.promised(), &format!("{what}: u"));
}

#[test]
fn cheap_control() {
    let model = hard("cheap_control");
    let root = parameter(&model, "r").sqrt();
    let p22 = root * (1.0 + 2.0 * root).sqrt();
    let p = DMatrix::from_row_slice(2, 2, &[(1.0 + 2.0 * root).sqrt(), root, root, p22]);
    let gain = p.rows(1, 1).into_owned() / (root * root);
    everywhere(&model, |sweep, asked, what| {
        exact(sweep, asked, what, |s| quadratic(&p, &gain, s.x));
        // The slow part of the fronts comes from seeds that no number tells apart: said before and
        // after.
        let rates = stiffness::separation(&sweep.plan).expect("an infinite horizon");
        assert!(
            rates.hides_fronts() && (rates.ratio - 1000.0).abs() < 1.0,
            "{what}: {rates:?}"
        );
        assert!(sweep.report.coverage.indistinguishable > 0, "{what}");
    });
}

#[test]
fn dear_control() {
    let model = hard("dear_control");
    let r = parameter(&model, "r");
    let p12 = r * (1.0 + (1.0 + 1.0 / r).sqrt());
    let p22 = (r * (2.0 * p12 + 1.0)).sqrt();
    let p = DMatrix::from_row_slice(2, 2, &[p12 * p22 / r - p22, p12, p12, p22]);
    let gain = p.rows(1, 1).into_owned() / r;
    everywhere(&model, |sweep, asked, what| {
        exact(sweep, asked, what, |s| quadratic(&p, &gain, s.x));
        assert_eq!(
            sweep.report.coverage.uncovered + sweep.report.coverage.indistinguishable,
            0,
            "{what}"
        );
        let rates = stiffness::separation(&sweep.plan).expect("an infinite horizon");
        assert!(
            !rates.hides_fronts() && rates.ratio < 1.1,
            "{what}: {rates:?}"
        );
    });
}

#[test]
fn long_horizon() {
    let model = hard("long_horizon");
    let (end, s) = (parameter(&model, "T"), parameter(&model, "s"));
    // P' = A'P + PA - P B B'P + I by time left, from s I; entries p11, p12, p22. Steps of 1e-3: the
    // error of order 4 is below 1e-10 even where P falls from 10.
    const STEP: f64 = 1e-3;
    let rate = |p: [f64; 3]| {
        [
            1.0 - p[1] * p[1],
            p[0] - p[1] * p[2],
            2.0 * p[1] + 1.0 - p[2] * p[2],
        ]
    };
    let moved =
        |p: [f64; 3], k: [f64; 3], h: f64| [p[0] + h * k[0], p[1] + h * k[1], p[2] + h * k[2]];
    let mut table = vec![[s, 0.0, s]];
    for _ in 0..(end / STEP).round() as usize {
        let p = table[table.len() - 1];
        let a = rate(p);
        let b = rate(moved(p, a, 0.5 * STEP));
        let c = rate(moved(p, b, 0.5 * STEP));
        let d = rate(moved(p, c, STEP));
        let mean = std::array::from_fn(|i| (a[i] + 2.0 * (b[i] + c[i]) + d[i]) / 6.0);
        table.push(moved(p, mean, STEP));
    }
    let stationary = table[table.len() - 1];
    assert!((stationary[0] - 3f64.sqrt()).abs() < 1e-9 && (stationary[1] - 1.0).abs() < 1e-9);
    everywhere(&model, |sweep, asked, what| {
        // Samples are at whole time units, which the table has.
        exact(sweep, asked, what, |sample| {
            let [a, b, c] = table[((end - sample.t) / STEP).round() as usize];
            let p = vec![
                a * sample.x[0] + b * sample.x[1],
                b * sample.x[0] + c * sample.x[1],
            ];
            Exact {
                v: 0.5 * dot(sample.x, &p),
                u: vec![-p[1]],
                p,
            }
        });
        let c = &sweep.report.coverage;
        assert!(
            c.uncovered + c.indistinguishable > 0,
            "{what}: claims to cover"
        );
        // At the largest growth of the region's widths, exp(0.866 * 60), all others have left.
        assert!(
            sweep
                .raw
                .status
                .iter()
                .filter(|s| **s == Status::Reached)
                .count()
                <= 2,
            "{what}"
        );
    });
}

#[test]
fn hidden_sheet() {
    let model = hard("hidden_sheet");
    let (k, turn) = (parameter(&model, "k"), parameter(&model, "turn"));
    let turned = |a: f64, b: f64| {
        [
            turn.cos() * a + turn.sin() * b,
            -turn.sin() * a + turn.cos() * b,
        ]
    };
    everywhere(&model, |sweep, asked, what| {
        exact(sweep, asked, what, |s| Exact {
            v: 0.5 * dot(s.x, s.x),
            p: s.x.to_vec(),
            u: s.x.iter().map(|x| -x).collect(),
        });
        // Along a trajectory y/x exp(-k x^2/2) is constant: the angle it had at the equilibrium.
        let angle = |x: &[f64]| {
            let [x, y] = turned(x[0], x[1]);
            (y / x) * (-0.5 * k * x * x).exp()
        };
        let last: Vec<Vec<f64>> = (0..sweep.count())
            .map(|i| sweep.raw.sample(i, sweep.levels() - 1)[1..3].to_vec())
            .collect();
        // The part of the outermost front beyond |x| = 2, on either side.
        let mut both_found = true;
        for side in [1.0, -1.0] {
            let mut there: Vec<f64> = (last.iter())
                .map(|x| turned(x[0], x[1]))
                .filter(|x| side * x[0] >= 2.0)
                .map(|x| x[1])
                .collect();
            there.sort_by(f64::total_cmp);
            let hidden = last
                .iter()
                .filter(|x| side * turned(x[0], x[1])[0] >= 2.0)
                .all(|x| angle(x).abs() < 1e-6);
            assert!(hidden, "{what}: it comes from 1e-6 rad");
            // y at the ends of that part: V = 2.2 at x = 2.
            let end = (4.4f64 - 4.0).sqrt();
            let widest = (there.windows(2).map(|w| w[1] - w[0])).fold(0.0, f64::max);
            let reach = there
                .first()
                .copied()
                .unwrap_or(end)
                .max(-there.last().copied().unwrap_or(-end));
            // Spacing is in widths of the region (4.4), along the turned axes; one gap may lie
            // across an end.
            let gap = 0.05 * 4.4 * 2f64.sqrt();
            let found = there.len() >= 5 && widest <= gap && reach <= -end + gap;
            both_found &= found;
            if asked.precision == Precision::F64 {
                assert!(
                    found,
                    "{what}: {} points, widest gap {widest}, from {reach}",
                    there.len()
                );
            }
        }
        let c = &sweep.report.coverage;
        match asked.precision {
            Precision::F64 => assert_eq!((c.uncovered, c.indistinguishable), (0, 0), "{what}"),
            // Whether f32 can tell such seeds apart is a matter of how they are rounded; a sweep
            // that counts no gap has found them.
            Precision::F32 => assert!(
                c.indistinguishable > 0 || (c.uncovered == 0 && both_found),
                "{what}: {c:?}, found: {both_found}"
            ),
        }
        // The linearization gives no hint.
        assert!(
            !stiffness::separation(&sweep.plan)
                .expect("an infinite horizon")
                .hides_fronts()
        );
    });
}

#[test]
fn state_sizes() {
    let model = hard("state_sizes");
    let q = |name| parameter(&model, name);
    let (a, b, x0, y0, r) = (q("a"), q("b"), q("x0"), q("y0"), q("r"));
    everywhere(&model, |sweep, asked, what| {
        assert_eq!(
            sweep.report.coverage.uncovered + sweep.report.coverage.indistinguishable,
            0,
            "{what}"
        );
        // From the deviations as integrated: x - x0 loses digits in the sum that is stored.
        let mut values = Worst::default();
        for i in 0..sweep.count() {
            for k in 0..sweep.levels() {
                let s = &sweep.raw.sample(i, k)[1..];
                let [x, y] = [s[0] / a, s[1] / b];
                let v = 0.5 * x * x
                    + (0.5 * x).sin().powi(2)
                    + 0.5 * x * y
                    + y * y
                    + 0.25 * x * x * y * y;
                values.see((s[4] - v).abs() / v);
            }
        }
        values.at_most(asked.promised(), &format!("{what}: V of deviations"));
        exact(sweep, asked, what, |s| {
            let [x, y] = [(s.x[0] - x0) / a, (s.x[1] - y0) / b];
            let v_y = 0.5 * x + 2.0 * y + 0.5 * x * x * y;
            Exact {
                v: 0.5 * x * x
                    + (0.5 * x).sin().powi(2)
                    + 0.5 * x * y
                    + y * y
                    + 0.25 * x * x * y * y,
                p: vec![(x + 0.5 * x.sin() + 0.5 * y + 0.5 * x * y * y) / a, v_y / b],
                u: vec![-v_y / r],
            }
        });
    });
}

#[test]
fn stiff_chain() {
    let model = hard("stiff_chain");
    let rates: Vec<f64> = (1..=6)
        .map(|i| parameter(&model, &format!("k{i}")))
        .collect();
    let weight = parameter(&model, "q");
    let chain = Linear {
        a: DMatrix::from_fn(6, 6, |i, j| match i.checked_sub(j) {
            Some(0) => -rates[i],
            Some(1) => rates[i],
            _ => 0.0,
        }),
        b: DMatrix::from_fn(6, 1, |i, _| if i == 0 { rates[0] } else { 0.0 }),
        q: diagonal(&[weight, weight, weight, weight, weight, 1.0]),
        r: diagonal(&[1.0]),
    };
    let (p, gain) = chain.optimal();
    everywhere(&model, |sweep, asked, what| {
        exact(sweep, asked, what, |s| quadratic(&p, &gain, s.x));
        let rates = stiffness::separation(&sweep.plan).expect("an infinite horizon");
        assert!(
            rates.hides_fronts() && (rates.fastest.re + 1000.0).abs() < 1.0,
            "{what}: {rates:?}"
        );
    });
}

#[test]
fn flat_cost() {
    let model = hard("flat_cost");
    let root = 2f64.sqrt();
    #[rustfmt::skip]
    let p = DMatrix::from_row_slice(3, 3, &[
        root, 1.0, 0.0,
        1.0, root, 0.0,
        0.0, 0.0, 0.5,
    ]);
    let gain = p.rows(1, 1).into_owned();
    everywhere(&model, |sweep, asked, what| {
        exact(sweep, asked, what, |s| quadratic(&p, &gain, s.x));
        assert_eq!(
            sweep.report.coverage.uncovered + sweep.report.coverage.indistinguishable,
            0,
            "{what}"
        );
    });
}

#[test]
fn blow_up() {
    let model = hard("blow_up");
    let horizon = parameter(&model, "T");
    // x(T) = c is infinite at T - ln(1 + 1/c^2)/2: within the horizon for c above this.
    let last = 1.0 / ((2.0 * horizon).exp() - 1.0).sqrt();
    everywhere(&model, |sweep, asked, what| {
        exact(sweep, asked, what, |s| Exact {
            v: 0.5 * dot(s.x, s.x),
            p: s.x.to_vec(),
            u: s.x.iter().map(|x| -x).collect(),
        });
        let mut blown = 0;
        for (i, (seed, status)) in sweep.seeds.chunks(5).zip(&sweep.raw.status).enumerate() {
            // Seeds next to the border may go either way within the tolerance.
            let c = seed[0].abs();
            if c > 1.01 * last {
                let failed = matches!(
                    status,
                    Status::StepFloor | Status::NotFinite | Status::StepLimit
                );
                // Near the singularity steps too small to be seen in t still move x, out of any
                // margin.
                let far = *status == Status::LeftRegion && sweep.raw.end[i * 5].abs() > 1e29;
                assert!(failed || far, "{what}: {c} {status:?}");
                blown += 1;
            } else if c < 0.99 * last {
                assert_eq!(*status, Status::Reached, "{what}: {c}");
            }
        }
        assert!(blown > 100, "{what}: {blown} blow up");
        // No sample after the time of blow-up.
        for i in 0..sweep.count() {
            let c = sweep.seeds[i * 5].abs();
            let time = 0.5 * (1.0 + 1.0 / (c * c)).ln();
            for k in 0..sweep.levels() {
                let t = sweep.raw.sample(i, k)[0];
                assert!(
                    t.is_nan() || t <= time * (1.0 + 10.0 * asked.rtol) + 1e-6,
                    "{what}: {t} after {time}"
                );
            }
        }
        assert!(
            stiffness::held_steps(&sweep.plan, &sweep.report.sample).is_none(),
            "{what}: a singularity is not stiffness"
        );
    });
}

/// A fast unstable mode that is in no trajectory: backward in time it decays, and holds the steps
/// at the boundary of stability. Exact: z stays unseen, V is that of the cart.
const HELD: &str = r#"
states = { x = {}, z = {} }
controls = { u = {} }
dynamics = { x = "u", z = "RATE*z" }
cost = { running = "0.5*(x^2 + u^2)", terminal = "0.5*x^2", final_time = 2.0 }
region = { x = [-1, 1], z = [-1, 1] }
shoot_out = { spacing = 0.5, samples = 20 }
"#;

#[test]
fn steps_held_by_stability_are_noticed() {
    for (rate, stiff) in [("1000", true), ("2", false)] {
        let model = common_oracles::parse(&HELD.replace("RATE", rate));
        for asked in [F64, F32, Asked { rtol: 1e-3, ..F64 }] {
            let sweep = Sweep::of(&model, asked);
            let held = stiffness::held_steps(&sweep.plan, &sweep.report.sample);
            assert_eq!(held.is_some(), stiff, "rate {rate} {asked:?}: {held:?}");
            if let Some(h) = held {
                assert!((h.rate - 1000.0).abs() < 1.0 && h.share > 0.9, "{h:?}");
                // Steps swing about the boundary, never far beyond.
                assert!(
                    h.product > 0.5 * h.boundary && h.product < 1.5 * h.boundary,
                    "{h:?}"
                );
            }
        }
    }
}

/// No word of stiffness where there is none, loose tolerances included.
#[test]
fn ordinary_scenes_are_not_called_stiff() {
    for name in [
        "pendulum",
        "moore_greitzer",
        "moore_greitzer_unconstrained",
        "manufactured",
        "finite_horizon",
    ] {
        let mut model = scene(name, &[]);
        model.shoot_out.as_mut().expect("a sweep").max_seeds = 500;
        for asked in [F64, F32, Asked { rtol: 1e-2, ..F64 }] {
            let sweep = Sweep::of(&model, asked);
            assert!(
                stiffness::held_steps(&sweep.plan, &sweep.report.sample).is_none(),
                "{name} {asked:?}"
            );
            assert!(
                !stiffness::separation(&sweep.plan).is_some_and(|s| s.hides_fronts()),
                "{name} {asked:?}"
            );
        }
    }
}

/// A run whose steps are too few for anything ends with the status that says so, and nothing after.
#[test]
fn a_step_limit_is_counted() {
    let mut model = hard("blow_up");
    model.integrator.max_steps = 20;
    everywhere(&model, |sweep, _, what| {
        let limited = sweep
            .raw
            .status
            .iter()
            .filter(|s| **s == Status::StepLimit)
            .count();
        assert!(limited > 0, "{what}");
        let Run { max_steps, .. } = sweep.plan.run;
        assert!(sweep.raw.steps.iter().all(|s| *s <= max_steps), "{what}");
    });
}
