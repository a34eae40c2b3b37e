//! The integrators have the order they claim: their coefficients satisfy the conditions of rooted
//! trees, and errors of the compiled kernels fall accordingly.

use costate::backend::{Backend, By, Run, Spec, Status, Trajectories, cpu::Cpu};
use costate::low_level::expr::{Graph, Kind};
use costate::low_level::integrator::{DOP853, RK4, TSIT5, Tableau};
use costate::low_level::model::{Method, Precision};
use costate::low_level::program::Program;

/// Coefficients are printed with 15 digits or more.
const PRINTED: f64 = 1e-14;

/// A condition of order `order`: the weights' sum over `phi` is `1/density`.
struct Condition {
    order: i32,
    density: f64,
    phi: Vec<f64>,
}

/// The conditions of all rooted trees of up to five nodes (J. C. Butcher, Numerical Methods for
/// Ordinary Differential Equations, 3rd ed., section 315).
fn conditions(t: &Tableau) -> Vec<Condition> {
    let s = t.stages();
    let times = |v: &[f64]| -> Vec<f64> {
        (0..s)
            .map(|i| {
                if i == 0 {
                    0.0
                } else {
                    t.a[i - 1].iter().zip(v).map(|(a, v)| a * v).sum()
                }
            })
            .collect()
    };
    let product =
        |v: &[f64], w: &[f64]| -> Vec<f64> { v.iter().zip(w).map(|(v, w)| v * w).collect() };
    let one = vec![1.0; s];
    let c = times(&one);
    let c2 = product(&c, &c);
    let c3 = product(&c2, &c);
    let (ac, ac2, ac3) = (times(&c), times(&c2), times(&c3));
    let aac = times(&ac);
    let list = [
        (1, 1.0, one),
        (2, 2.0, c.clone()),
        (3, 3.0, c2.clone()),
        (3, 6.0, ac.clone()),
        (4, 4.0, c3.clone()),
        (4, 8.0, product(&c, &ac)),
        (4, 12.0, ac2.clone()),
        (4, 24.0, aac.clone()),
        (5, 5.0, product(&c3, &c)),
        (5, 10.0, product(&c2, &ac)),
        (5, 20.0, product(&ac, &ac)),
        (5, 15.0, product(&c, &ac2)),
        (5, 20.0, ac3),
        (5, 30.0, product(&c, &aac)),
        (5, 40.0, times(&product(&c, &ac))),
        (5, 60.0, times(&ac2)),
        (5, 120.0, times(&aac)),
    ];
    list.into_iter()
        .map(|(order, density, phi)| Condition {
            order,
            density,
            phi,
        })
        .collect()
}

/// Order up to which weights satisfy the conditions of a solution at fraction `q` of the step; 5 at
/// most.
fn order_of(t: &Tableau, weights: &[f64], q: f64) -> i32 {
    let mut order = 5;
    for c in conditions(t) {
        let terms: Vec<f64> = weights.iter().zip(&c.phi).map(|(b, p)| b * p).collect();
        let size: f64 = terms.iter().map(|x| x.abs()).sum();
        let defect = terms.iter().sum::<f64>() - q.powi(c.order) / c.density;
        if defect.abs() > PRINTED * size.max(1.0) {
            order = order.min(c.order - 1);
        }
    }
    order
}

fn solution(t: &Tableau) -> Vec<f64> {
    let mut b = t.a[t.a.len() - 1].to_vec();
    b.push(0.0);
    b
}

fn dense(t: &Tableau, q: f64) -> Vec<f64> {
    t.dense
        .iter()
        .map(|d| d.iter().enumerate().map(|(i, d)| d * basis(t, i, q)).sum())
        .collect()
}

/// Basis polynomial of the dense output.
fn basis(t: &Tableau, i: usize, q: f64) -> f64 {
    (0..t.degree())
        .map(|m| t.power(i, m) * q.powi(m as i32 + 1))
        .sum()
}

const FRACTIONS: [f64; 7] = [0.05, 0.2, 0.37, 0.5, 0.71, 0.9, 0.99];

#[test]
fn rk4_coefficients() {
    assert_eq!(order_of(&RK4, &solution(&RK4), 1.0), 4);
    for q in FRACTIONS {
        assert_eq!(order_of(&RK4, &dense(&RK4, q), q), 3, "dense output at {q}");
    }
    assert_eq!((RK4.order, RK4.adaptive(), RK4.stages()), (4, false, 5));
}

#[test]
fn tsit5_coefficients() {
    assert_eq!(order_of(&TSIT5, &solution(&TSIT5), 1.0), 5);
    let embedded: Vec<f64> = solution(&TSIT5)
        .iter()
        .zip(TSIT5.error)
        .map(|(b, e)| b - e)
        .collect();
    assert_eq!(order_of(&TSIT5, &embedded, 1.0), 4, "embedded solution");
    for q in FRACTIONS {
        assert_eq!(
            order_of(&TSIT5, &dense(&TSIT5, q), q),
            4,
            "dense output at {q}"
        );
    }
    assert_eq!(
        (TSIT5.order, TSIT5.adaptive(), TSIT5.stages()),
        (5, true, 7)
    );
}

/// Dense output meets the step's ends: the solution at 1 and, of RK4 and of Tsit5, the derivatives
/// at both.
#[test]
fn dense_output_joins_smoothly() {
    for t in [&RK4, &TSIT5] {
        let size = |j: usize| t.dense[j].iter().map(|d| d.abs()).sum::<f64>();
        for (j, (found, b)) in dense(t, 1.0).iter().zip(solution(t)).enumerate() {
            assert!(
                (found - b).abs() <= PRINTED * size(j).max(1.0),
                "stage {j} at 1: {found} for {b}"
            );
        }
        for (j, d) in t.dense.iter().enumerate() {
            let slope = d[0] + 2.0 * d[1] + 3.0 * d[2] + 4.0 * d[3];
            let last = j + 1 == t.stages();
            assert!(
                (slope - f64::from(u8::from(last))).abs() <= 4.0 * PRINTED * size(j).max(1.0),
                "slope {slope} of stage {j} at 1"
            );
            assert_eq!(d[0], f64::from(u8::from(j == 0)), "slope of stage {j} at 0");
        }
    }
}

/// y' = y c, s' = c, c' = -s: y = exp(sin t), s = sin t, c = cos t.
fn problem() -> Program {
    let mut g = Graph::new();
    let [y, s, c] = ["y", "s", "c"].map(|name| g.symbol(name, Kind::State));
    let rates = [g.mul(y, c), c, g.neg(s)];
    Program::lower(&g, &[y, s, c], &rates)
}

/// End of fixed-step runs; adaptive ones go on for longer, so that the first few steps, which start
/// small, do not count.
const END: f64 = 3.0;
const LONG: f64 = 30.0;

fn exact(t: f64) -> [f64; 3] {
    [t.sin().exp(), t.sin(), t.cos()]
}

struct Setting {
    method: Method,
    precision: Precision,
    step: f64,
    rtol: f64,
    by: By,
    levels: Vec<f64>,
}

fn integrate(s: &Setting) -> Trajectories {
    let spec = Spec {
        rate: problem(),
        guards: None,
        kinks: None,
        method: s.method,
        precision: s.precision,
        by: s.by,
        store: true,
    };
    let run = Run {
        rtol: s.rtol,
        atol: vec![s.rtol; 3],
        step: s.step,
        first: None,
        max_steps: 100_000,
        levels: s.levels.clone(),
        ceiling: None,
        bounds: Vec::new(),
    };
    let result = Cpu::new()
        .compile(&spec)
        .expect("it compiles")
        .integrate(&run, &exact(0.0))
        .expect("it runs");
    assert_eq!(result.status, [Status::Reached]);
    result
}

fn distance(y: &[f64], t: f64) -> f64 {
    y.iter()
        .zip(exact(t))
        .map(|(y, e)| (y - e).abs())
        .fold(0.0, f64::max)
}

/// Times between steps of any size used here, and the end.
fn times(end: f64) -> Vec<f64> {
    (1..=97).map(|k| f64::from(k) * end / 97.0).collect()
}

/// Slope of log error over log steps from the first to the last.
fn slope(points: &[(f64, f64)]) -> f64 {
    let (first, last) = (points[0], points[points.len() - 1]);
    (first.1 / last.1).ln() / (last.0 / first.0).ln()
}

/// Half an order, for the terms after the first.
const SLACK: f64 = 0.5;

#[test]
fn rk4_errors_fall_with_its_order() {
    let run = |halvings: i32, levels: Vec<f64>, precision| {
        let step = 0.25 / 2f64.powi(halvings);
        integrate(&Setting {
            method: Method::Rk4,
            precision,
            step,
            rtol: 1e-6,
            by: By::Time,
            levels,
        })
    };
    let (mut ends, mut between) = (Vec::new(), Vec::new());
    for halvings in 0..5 {
        let result = run(halvings, vec![END], Precision::F64);
        assert_eq!(result.end_time, [END]);
        ends.push((2f64.powi(halvings), distance(&result.end, END)));
        let result = run(halvings, times(END), Precision::F64);
        let worst = (0..97)
            .map(|k| distance(&result.sample(0, k)[1..], times(END)[k]))
            .fold(0.0, f64::max);
        between.push((2f64.powi(halvings), worst));
    }
    println!(
        "rk4: order {:.2} at the end, {:.2} between steps",
        slope(&ends),
        slope(&between)
    );
    assert!((slope(&ends) - 4.0).abs() <= SLACK);
    // One step's cubic interpolant is wrong by h^4.
    assert!((slope(&between) - 4.0).abs() <= SLACK);
    // In f32 the same, until rounding: a step's rounding is 1e-7.
    let coarse = distance(&run(0, vec![END], Precision::F32).end, END);
    assert!(
        (coarse / ends[0].1 - 1.0).abs() < 0.1,
        "{coarse:e} in f32, {:e} in f64",
        ends[0].1
    );
}

#[test]
fn tsit5_errors_fall_with_its_order() {
    let (mut ends, mut between) = (Vec::new(), Vec::new());
    for digits in [5, 6, 7, 8, 9, 10, 11] {
        let rtol = 10f64.powi(-digits);
        let mut setting = Setting {
            method: Method::Tsit5,
            precision: Precision::F64,
            step: 0.0,
            rtol,
            by: By::Time,
            levels: vec![LONG],
        };
        let result = integrate(&setting);
        // Each step within the tolerance, and errors of this problem hardly grow.
        assert!(distance(&result.end, LONG) <= f64::from(result.steps[0]) * 4.0 * rtol);
        ends.push((f64::from(result.steps[0]), distance(&result.end, LONG)));
        setting.levels = times(LONG);
        let result = integrate(&setting);
        let worst = (0..97)
            .map(|k| distance(&result.sample(0, k)[1..], times(LONG)[k]))
            .fold(0.0, f64::max);
        between.push((f64::from(result.steps[0]), worst));
    }
    println!(
        "tsit5: order {:.2} at the end, {:.2} between steps",
        slope(&ends),
        slope(&between)
    );
    // Steps follow the order-4 estimate, whose local error is of order 5; so is the interpolant's.
    assert!((slope(&ends) - 5.0).abs() <= SLACK);
    assert!((slope(&between) - 5.0).abs() <= SLACK);
}

/// The eighth order, at the end and, one lower at most, between steps; or more, before the leading
/// term rules.
#[test]
fn dop853_errors_fall_with_its_order() {
    let (mut ends, mut between) = (Vec::new(), Vec::new());
    for digits in [5, 6, 7, 8, 9, 10, 11] {
        let rtol = 10f64.powi(-digits);
        let setting = |levels| Setting {
            method: Method::Dop853,
            precision: Precision::F64,
            step: 0.0,
            rtol,
            by: By::Time,
            levels,
        };
        let result = integrate(&setting(vec![LONG]));
        assert!(distance(&result.end, LONG) <= f64::from(result.steps[0]) * 4.0 * rtol);
        ends.push((f64::from(result.steps[0]), distance(&result.end, LONG)));
        let result = integrate(&setting(times(LONG)));
        let worst = (0..97).map(|k| distance(&result.sample(0, k)[1..], times(LONG)[k]));
        between.push((f64::from(result.steps[0]), worst.fold(0.0, f64::max)));
    }
    let (at, inside) = (slope(&ends), slope(&between));
    println!("dop853: order {at:.2} at the end, {inside:.2} between steps");
    assert!(at >= 8.0 - SLACK, "{at} at the end");
    assert!(inside >= 7.0 - SLACK, "{inside} between steps");
}

#[test]
fn dop853_coefficients() {
    // The conditions of up to five nodes, at the end and on the way, where later stages take part.
    assert_eq!(order_of(&DOP853, &solution(&DOP853), 1.0), 5);
    let mut t = DOP853.a.to_vec();
    t.extend(DOP853.extra);
    let whole: &'static [&'static [f64]] = Vec::leak(t);
    let extended = Tableau { a: whole, ..DOP853 };
    for q in FRACTIONS {
        assert_eq!(
            order_of(&extended, &dense(&DOP853, q), q),
            5,
            "dense output at {q}"
        );
    }
}

/// Order and step of Taylor's method follow from the tolerance: errors stay in proportion to it,
/// and steps do not shrink with it.
#[test]
fn taylor_errors_fall_with_the_tolerance() {
    for (precision, digits) in [(Precision::F64, 4..=13), (Precision::F32, 3..=5)] {
        for digits in digits {
            let rtol = 10f64.powi(-digits);
            let result = integrate(&Setting {
                method: Method::Taylor,
                precision,
                step: 0.0,
                rtol,
                by: By::Time,
                levels: times(LONG),
            });
            let steps = f64::from(result.steps[0]);
            let worst = (0..97).map(|k| distance(&result.sample(0, k)[1..], times(LONG)[k]));
            let worst = worst
                .chain([distance(&result.end, LONG)])
                .fold(0.0, f64::max);
            println!("taylor, rtol {rtol:e}: {worst:.1e} after {steps} steps");
            assert!(worst <= steps * 4.0 * rtol, "{worst} at {rtol:e}");
            // The order grows with the tolerance's digits, so that the number of steps hardly does.
            assert!(steps <= 4.0 * LONG, "{steps} steps at {rtol:e}");
        }
    }
}

/// Levels of a component are met, at the right time: y = exp(sin t) rises until t = pi/2.
#[test]
fn levels_are_located() {
    let levels: Vec<f64> = (1..=40).map(|k| 1.0 + f64::from(k) * 0.04).collect();
    let methods = [Method::Tsit5, Method::Dop853, Method::Taylor];
    let settings = [(Precision::F64, 1e-10), (Precision::F32, 1e-6)];
    for (method, (precision, rtol)) in methods.into_iter().flat_map(|m| settings.map(|s| (m, s))) {
        let setting = Setting {
            method,
            precision,
            step: 0.0,
            rtol,
            by: By::Component(0),
            levels: levels.clone(),
        };
        let result = integrate(&setting);
        for (k, level) in levels.iter().enumerate() {
            let sample = result.sample(0, k);
            assert_eq!(sample[1], *level, "the level itself is stored");
            let t = level.ln().asin();
            // dy/dt is at least 0.5 here, so a tolerance in y is at most twice that in t, per step.
            let bound = f64::from(result.steps[0]) * 4.0 * rtol / 0.5;
            assert!(
                (sample[0] - t).abs() <= bound,
                "level {level} at {} for {t}",
                sample[0]
            );
            assert!(
                distance(&sample[1..], sample[0]) <= bound,
                "the point at level {level}"
            );
        }
        let last = if precision == Precision::F32 {
            f64::from(levels[39] as f32)
        } else {
            levels[39]
        };
        assert_eq!(result.end[0], last);
    }
}
