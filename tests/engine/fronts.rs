//! What a sweep covers: gaps between neighbours on fronts, the pendulum's known map, caps, guards,
//! other dimensions.

use crate::common_oracles;

use common_oracles::{Asked, F32, F64, Sweep, parse, scene};
use costate::low_level::model::Precision;
use costate::low_level::sweep::Far;

/// Gaps are judged in f32, in widths of the region: a few units of which the pendulum's fronts are
/// long.
const JUDGED: f64 = 16.0 * f32::EPSILON as f64;

/// Points of a planar front in the order of the curve.
struct Front {
    value: f64,
    /// `(x, p)` of each trajectory, in the order of all fronts; `None` where it has not come so
    /// far.
    points: Vec<Option<[f64; 4]>>,
}

/// Fronts of a sweep of two states.
fn fronts(sweep: &Sweep) -> Vec<Front> {
    let order = sweep.round_the_curve();
    (0..sweep.levels())
        .map(|k| Front {
            value: sweep.plan.run.levels[k],
            points: order
                .iter()
                .map(|i| {
                    let d = &sweep.raw.sample(*i, k)[1..5];
                    let x = &sweep.plan.system.reference;
                    (!d[0].is_nan()).then(|| [d[0] + x[0], d[1] + x[1], d[2], d[3]])
                })
                .collect(),
        })
        .collect()
}

/// Pairs of neighbours round the curve where both have come to the front.
fn neighbours(front: &Front) -> impl Iterator<Item = ([f64; 4], [f64; 4])> {
    let next = front.points.iter().cycle().skip(1);
    front
        .points
        .iter()
        .zip(next)
        .filter_map(|(a, b)| Some(((*a)?, (*b)?)))
}

/// The widest gap over all fronts, where the box around two neighbours meets the region (a periodic
/// state always does).
fn widest(sweep: &Sweep, region: &[[f64; 2]]) -> f64 {
    let mut widest = 0.0f64;
    for front in fronts(sweep) {
        for (a, b) in neighbours(&front) {
            let meets = (0..2).all(|i| {
                sweep.plan.periodic[i]
                    || (a[i].max(b[i]) >= region[i][0] && a[i].min(b[i]) <= region[i][1])
            });
            let gap = (0..2)
                .map(|i| (a[i] - b[i]).abs() / sweep.plan.widths[i])
                .fold(0.0, f64::max);
            if meets {
                widest = widest.max(gap);
            }
        }
    }
    widest
}

#[test]
fn neighbours_are_within_the_spacing() {
    for name in ["pendulum", "manufactured"] {
        for (asked, spacing) in [(F64, 0.05), (F64, 0.01), (F32, 0.05), (F32, 0.02)] {
            let mut model = scene(name, &[]);
            model.shoot_out.as_mut().expect("a sweep").spacing = spacing;
            let sweep = Sweep::of(&model, asked);
            let coverage = &sweep.report.coverage;
            assert_eq!(
                (coverage.uncovered, coverage.indistinguishable),
                (0, 0),
                "{name} is covered"
            );
            let gap = widest(&sweep, &model.region);
            println!(
                "{name} {}: {} trajectories, widest gap {gap:.4}",
                asked.precision.name(),
                sweep.count()
            );
            assert!(
                gap <= spacing + JUDGED,
                "{name}: a gap of {gap} at a spacing of {spacing}"
            );
            // Not many more seeds than gaps ask for.
            assert!(gap > 0.5 * spacing, "{name}: the widest gap is only {gap}");
        }
    }
}

#[test]
fn the_pendulum_reaches_what_the_thesis_shows() {
    let mut model = scene("pendulum", &[]);
    let shoot_out = model.shoot_out.as_mut().expect("a sweep");
    (shoot_out.value_max, shoot_out.samples) = (Some(184.0), 100);
    let sweep = Sweep::of(&model, F64);
    let last = fronts(&sweep).pop().expect("there are fronts");
    assert_eq!(last.value, 184.0);
    let points: Vec<[f64; 4]> = last
        .points
        .iter()
        .map(|p| p.expect("all come to the last front"))
        .collect();
    let least = points.iter().map(|p| p[0]).fold(f64::INFINITY, f64::min);
    let most = points
        .iter()
        .map(|p| p[1])
        .fold(f64::NEG_INFINITY, f64::max);
    println!("theta from {least:.3}, omega to {most:.3}");
    // Printed digits: half a unit of the last.
    assert!(
        (least + 8.9).abs() <= 0.05,
        "theta comes to {least}, -8.9 is known"
    );
    assert!(
        (most - 14.9).abs() <= 0.05,
        "omega comes to {most}, 14.9 is known"
    );
}

/// Where a front crosses omega = 0, going along it: theta, by the cubic through two neighbours with
/// the front's directions there (p is normal to it).
fn crossings(front: &Front) -> Vec<f64> {
    neighbours(front)
        .filter(|(a, b)| a[1].signum() != b[1].signum())
        .map(|(a, b)| {
            // theta as a function of omega: dtheta/domega = -p_omega / p_theta.
            let (slope_a, slope_b) = (-a[3] / a[2], -b[3] / b[2]);
            let h = b[1] - a[1];
            let q = -a[1] / h;
            let (m, n) = (1.0 - q, q);
            a[0] * m * m * (1.0 + 2.0 * n)
                + b[0] * n * n * (3.0 - 2.0 * n)
                + h * m * n * (m * slope_a - n * slope_b)
        })
        .collect()
}

/// Along omega = 0 both ways round cost the same at theta = 2.409, V = 183.9 (problems.md).
#[test]
fn both_sheets_of_the_pendulum_are_there() {
    let mut model = scene("pendulum", &[]);
    let shoot_out = model.shoot_out.as_mut().expect("a sweep");
    (shoot_out.value_max, shoot_out.samples, shoot_out.spacing) = (Some(190.0), 190, 0.01);
    let sweep = Sweep::of(&model, F64);
    let turn = std::f64::consts::TAU;
    // Theta at which each way round has each V: rising anticlockwise, falling clockwise.
    let mut ahead = Vec::new();
    let mut behind = Vec::new();
    for front in fronts(&sweep).iter().filter(|f| f.value > 150.0) {
        let found = crossings(front);
        let farthest = |sign: f64| {
            found
                .iter()
                .copied()
                .map(|t| sign * t)
                .fold(f64::NEG_INFINITY, f64::max)
                * sign
        };
        ahead.push((front.value, farthest(1.0)));
        behind.push((front.value, farthest(-1.0) + turn));
    }
    // The first V at which the two have met.
    let k = ahead
        .iter()
        .zip(&behind)
        .position(|(a, b)| a.1 >= b.1)
        .expect("the sheets meet");
    let (before, after) = (behind[k - 1].1 - ahead[k - 1].1, behind[k].1 - ahead[k].1);
    let share = before / (before - after);
    let value = ahead[k - 1].0 + share * (ahead[k].0 - ahead[k - 1].0);
    let theta = ahead[k - 1].1 + share * (ahead[k].1 - ahead[k - 1].1);
    println!("the sheets meet at theta = {theta:.4}, V = {value:.3}");
    // Printed digits: half a unit of the last.
    assert!((theta - 2.409).abs() <= 0.0005, "theta = {theta}");
    assert!((value - 183.9).abs() <= 0.05, "V = {value}");
}

#[test]
fn a_cap_leaves_gaps_and_says_so() {
    let mut model = scene("pendulum", &[]);
    let shoot_out = model.shoot_out.as_mut().expect("a sweep");
    (shoot_out.max_seeds, shoot_out.spacing) = (200, 0.02);
    let spacing = shoot_out.spacing;
    let sweep = Sweep::of(&model, F64);
    let coverage = &sweep.report.coverage;
    assert_eq!((sweep.count(), sweep.report.trajectories), (200, 200));
    assert!(coverage.uncovered > 0, "{coverage:?}");
    let gap = widest(&sweep, &model.region);
    assert!(gap > spacing, "there is a gap of {gap}");
    assert!(
        (coverage.widest - gap).abs() <= JUDGED * gap.max(1.0),
        "told {}, found {gap}",
        coverage.widest
    );
}

/// Where the front between two ends does not meet the region, although those beside it do, seeds
/// were put into the same two places in turns until there were no more (two pendulums, a spring
/// between them; found with 17,356 copies among 20,000 trajectories).
#[test]
fn seeds_do_not_go_round_in_a_circle() {
    let model = parse(
        r#"
        states = { a = {}, b = {}, c = {}, d = {} }
        controls = { u = { min = -4, max = 4 }, v = { min = -4, max = 4 } }
        dynamics = { a = "c", b = "d", c = "3*sin(a) - 0.5*(a - b) + u", d = "3*sin(b) + 0.5*(a - b) + v" }
        cost = { running = "(1 - cos(a)) + (1 - cos(b)) + 0.1*(c^2 + d^2) + 0.1*(u^2 + v^2) + 0.05*(a - b)^2" }
        equilibrium = { a = 0, b = 0, c = 0, d = 0, u = 0, v = 0 }
        region = { a = [-3, 3], b = [-3, 3], c = [-3, 3], d = [-3, 3] }
        shoot_out = { value_max = 10, spacing = 0.6, samples = 40, max_seeds = 6000 }
        "#,
    );
    let sweep = Sweep::of(&model, F64);
    let coverage = &sweep.report.coverage;
    assert_eq!((coverage.uncovered, coverage.indistinguishable), (0, 0));
    assert!(
        sweep.report.trajectories < 3500,
        "{} trajectories",
        sweep.report.trajectories
    );
}

/// Where guards cut the seeds' surface these follow its edge by seeds on it (pairs on either side took
/// 40,825 trajectories here), and what crowds all the same comes to an end.
#[test]
fn seeds_follow_a_guard() {
    let swept = |spacing: f64| {
        let model = parse(&format!(
            r#"
            states = {{ x = {{}}, v = {{}}, z = {{}}, w = {{}} }}
            controls = {{ a = {{}}, b = {{}} }}
            dynamics = {{ x = "v", v = "a", z = "w", w = "b" }}
            cost = {{ running = "0.5*a^2 + 0.5*b^2 + 0.1*x^2*z^2", terminal = "5*(x^2 + v^2 + z^2 + w^2)", final_time = 1.0 }}
            guards = {{ ball = "(x - 0.3)^2 + (z - 0.2)^2 + v^2 > 0.2" }}
            region = {{ x = [-1, 1], v = [-1, 1], z = [-1, 1], w = [-1, 1] }}
            shoot_out = {{ spacing = {spacing}, samples = 20, max_seeds = 1000000 }}
            "#
        ));
        let sweep = Sweep::of(&model, F64);
        let outside = (sweep.seeds.chunks_exact(9))
            .filter(|s| (s[0] - 0.3).powi(2) + (s[2] - 0.2).powi(2) + s[1].powi(2) < 0.2 - 1e-12);
        assert_eq!(outside.count(), 0);
        sweep.report
    };
    let report = swept(0.5);
    assert_eq!(report.coverage.gaps(), 0);
    assert!(report.trajectories < 22_000, "{}", report.trajectories);
    let report = swept(0.35);
    let coverage = &report.coverage;
    assert_eq!(coverage.gaps(), coverage.crowded);
    assert!(report.trajectories < 100_000, "{}", report.trajectories);
}

/// The guard R >= 0 of the compressor: nothing stored is outside, and the plane R = 0, which
/// trajectories cannot leave, is kept.
#[test]
fn stall_is_never_negative() {
    for asked in [F64, F32] {
        let mut model = scene("moore_greitzer", &[]);
        model.shoot_out.as_mut().expect("a sweep").max_seeds = 3000;
        let sweep = Sweep::of(&model, asked);
        let least = sweep
            .samples()
            .map(|s| s.x[2])
            .fold(f64::INFINITY, f64::min);
        assert!(least >= 0.0, "{}: R = {least:e}", asked.precision.name());
        let size = |i: usize| {
            (0..4)
                .map(|k| sweep.seeds[i * 9 + k].abs())
                .fold(0.0, f64::max)
        };
        let eps = asked.precision.epsilon();
        let on: Vec<usize> = (0..sweep.count())
            .filter(|i| sweep.seeds[i * 9 + 2] <= eps * size(*i))
            .collect();
        assert!(on.len() >= 20, "only {} seeds are on R = 0", on.len());
        let mut worst = 0.0f64;
        for i in &on {
            // Backward in time R'/R = sigma (Phi^2 - 1 + R): what is rounding at the seed grows by
            // the integral of that. Phi is monotone between samples but near its turns, for which a
            // factor e is left.
            let (mut exponent, mut t, mut flow) = (1.0, 0.0, 1.2f64);
            for k in 0..sweep.levels() {
                let sample = sweep.raw.sample(*i, k);
                if sample[0].is_nan() {
                    break;
                }
                let (next, stall) = (1.2 + sample[1], sample[3]);
                exponent += 4.0 * (flow.max(next).powi(2) - 1.0 + stall) * (sample[0] - t);
                (t, flow) = (sample[0], next);
                let bound = sweep.seeds[i * 9 + 2] * f64::exp(exponent);
                assert!(
                    stall <= bound,
                    "R = {stall:e} at level {k} of trajectory {i}, at most {bound:e}"
                );
                worst = worst.max(stall);
            }
        }
        println!(
            "{}: {} seeds on R = 0; R up to {worst:.1e}",
            asked.precision.name(),
            on.len()
        );
        assert!(
            !sweep.stored.status.contains(&(16 + 1)),
            "no trajectory meets R >= 0"
        );
    }
}

/// x' = -x^3 + u, L = (x^2 + u^2)/2: p = -x^3 + sqrt(x^6 + x^2).
const ONE_STATE: &str = r#"
[states]
x = {}
[controls]
u = {}
[dynamics]
x = "-x^3 + u"
[cost]
running = "0.5*(x^2 + u^2)"
[equilibrium]
x = 0
u = 0
[region]
x = [-2, 2]
[shoot_out]
value_max = 0.5
samples = 40
"#;

#[test]
fn one_state() {
    let model = parse(ONE_STATE);
    for asked in [F64, F32] {
        let sweep = Sweep::of(&model, asked);
        assert_eq!((sweep.count(), sweep.report.coverage.uncovered), (2, 0));
        assert!(
            sweep.stored.status.iter().all(|s| *s == 0),
            "both reach V = 0.5"
        );
        let signs: Vec<f64> = sweep.samples().map(|s| s.x[0].signum()).collect();
        assert!(
            signs.contains(&1.0) && signs.contains(&-1.0),
            "one on each side"
        );
        for s in sweep.samples() {
            let x = s.x[0];
            // x (sqrt(x^4 + 1) - x^2) without cancellation.
            let p = x / ((x.powi(4) + 1.0).sqrt() + x * x);
            assert!(
                (s.p[0] - p).abs() <= asked.promised() * p.abs(),
                "p = {} for {p} at {x}",
                s.p[0]
            );
            assert!((s.u[0] + p).abs() <= asked.promised() * p.abs());
        }
    }
}

/// Three states that do not touch each other, x' = a x + u, so V = sum of P_i x_i^2 / 2.
#[test]
fn three_states() {
    let rates = [1.0, 0.0, -0.5];
    let dynamics: Vec<String> = (0..3)
        .map(|i| format!("x{i} = \"({})*x{i} + u{i}\"", rates[i]))
        .collect();
    let text = format!(
        "[states]\nx0 = {{}}\nx1 = {{}}\nx2 = {{}}\n[controls]\nu0 = {{}}\nu1 = {{}}\nu2 = {{}}\n[dynamics]\n{}\n[cost]\n\
         running = \"0.5*(x0^2 + x1^2 + x2^2 + u0^2 + u1^2 + u2^2)\"\n[equilibrium]\nx0 = 0\nx1 = 0\nx2 = 0\nu0 = 0\nu1 = 0\nu2 = 0\n\
         [region]\nx0 = [-1, 1]\nx1 = [-1, 1]\nx2 = [-1, 1]\n[shoot_out]\nvalue_max = 0.3\nspacing = 0.2\nsamples = 20\n",
        dynamics.join("\n")
    );
    let model = parse(&text);
    for asked in [F64, F32] {
        let sweep = Sweep::of(&model, asked);
        let coverage = &sweep.report.coverage;
        assert_eq!((coverage.uncovered, coverage.indistinguishable), (0, 0));
        println!(
            "three states, {}: {} trajectories",
            asked.precision.name(),
            sweep.count()
        );
        let gains: Vec<f64> = rates.iter().map(|a| a + f64::hypot(*a, 1.0)).collect();
        for s in sweep.samples() {
            let v: f64 = s.x.iter().zip(&gains).map(|(x, p)| 0.5 * p * x * x).sum();
            assert!(
                (s.v - v).abs() <= asked.promised() * v,
                "V = {} for {v}",
                s.v
            );
        }
        // Every point of the last front is near a trajectory: its ellipsoid, in widths, looked at
        // in many directions.
        let last: Vec<&[f64]> = sweep
            .samples()
            .filter(|s| s.v == 0.3)
            .map(|s| s.x)
            .collect();
        assert_eq!(last.len(), sweep.count());
        let mut random = common_oracles::Random::new(21);
        for _ in 0..2000 {
            let d: Vec<f64> = (0..3).map(|_| random.normal()).collect();
            let v: f64 = d.iter().zip(&gains).map(|(x, p)| 0.5 * p * x * x).sum();
            let scale = (0.3 / v).sqrt();
            let target: Vec<f64> = d.iter().map(|x| x * scale).collect();
            let distance = |x: &[f64]| {
                x.iter()
                    .zip(&target)
                    .map(|(a, b)| (a - b).abs() / 2.0)
                    .fold(0.0, f64::max)
            };
            let nearest = last
                .iter()
                .map(|x| distance(x))
                .fold(f64::INFINITY, f64::min);
            // Corners of triangles with edges within the spacing are nearer than an edge to every
            // point of it.
            assert!(
                nearest <= 0.2,
                "{target:?} is {nearest} from all trajectories"
            );
        }
    }
}

/// The cap is kept however the precision, and f32 finds the same map as f64.
#[test]
fn both_precisions_find_the_same_map() {
    let model = scene("pendulum", &[]);
    let counts: Vec<usize> = [Precision::F64, Precision::F32]
        .map(|precision| {
            Sweep::of(
                &model,
                Asked {
                    precision,
                    rtol: 1e-6,
                },
            )
            .count()
        })
        .into_iter()
        .collect();
    // Decisions near the spacing go either way: one of some ten.
    assert!(
        counts[0].abs_diff(counts[1]) * 10 <= counts[0],
        "{counts:?}"
    );
}

/// Between guards, next to where a front ends, no gap is halved for ever: of a scene that has such
/// places a few thousand trajectories cover the fronts.
#[test]
fn fronts_that_end_at_guards_need_few_seeds() {
    let sweep = Sweep::of(&scene("moore_greitzer_unconstrained", &[]), F64);
    let coverage = &sweep.report.coverage;
    assert_eq!((coverage.uncovered, coverage.indistinguishable), (0, 0));
    assert!((5000..10_000).contains(&sweep.count()), "{}", sweep.count());
}

/// Where trajectories go far from one front to the next, or leave the region before the first one,
/// fronts are not covered although no gap is left on them.
#[test]
fn fronts_far_apart_are_not_covered() {
    let coverage = |value_max: f64, samples: usize| {
        let mut model = scene("pendulum", &[]);
        let shoot_out = model.shoot_out.as_mut().expect("a sweep");
        (shoot_out.value_max, shoot_out.samples) = (Some(value_max), samples);
        Sweep::of(&model, F64).report.coverage
    };
    let near = coverage(185.0, 200);
    assert_eq!((near.gaps(), near.steps.without), (0, 0));
    let step = near.steps.longest;
    assert!(step > 0.01 && step < 0.2, "{step}");
    assert_eq!(near.steps.far(), None);
    // Fewer fronts, further apart.
    let far = coverage(185.0, 8).steps;
    assert!(far.longest > 2.0 * step, "{}", far.longest);
    let none = coverage(1e9, 41);
    let all =
        matches!(none.steps.far(), Some(Far::Alone { trajectories, of, .. }) if trajectories == of);
    assert!(none.gaps() == 0 && all, "{:?}", none.steps);

    // Nearly all leave the region, or end at a guard, before the first front.
    for (margin, guards) in [
        (0, ""),
        (1, "guards = { a = \"x < 0.9\", b = \"x > -0.9\" }"),
    ] {
        let model = parse(&format!(
            r#"
            states = {{ x = {{}}, y = {{}} }}
            controls = {{ u = {{}}, w = {{}} }}
            dynamics = {{ x = "-x + u", y = "-y + w" }}
            cost = {{ running = "0.5*(0.1*x^2 + 100*y^2 + u^2 + 10*w^2)" }}
            equilibrium = {{ x = 0, y = 0, u = 0, w = 0 }}
            region = {{ x = [-1, 1], y = [-1, 1] }}
            shoot_out = {{ spacing = 0.2, samples = 10, value_max = 15, margin = {margin} }}
            {guards}
            "#
        ));
        let coverage = Sweep::of(&model, F64).report.coverage;
        assert_eq!(coverage.gaps(), 0);
        let alone = matches!(coverage.steps.far(), Some(Far::Alone { trajectories, .. }) if trajectories > 60);
        assert!(alone, "{:?}", coverage.steps);
    }
}
