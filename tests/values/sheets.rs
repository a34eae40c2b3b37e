//! Sheets, folds and the equal-cost boundary against what is known of them.

use crate::common_problems::TwoWells;
use crate::common_problems::two_wells::Way;
use crate::common_values;

use common_values::{Swept, largest, scene, spaced};
use costate::low_level::value::{Grid, Request};

#[test]
fn a_fold_and_an_equal_cost_line_with_known_answers() {
    let swept = Swept::new(scene("hopf_lax", &[]), 4000);
    let exact = TwoWells::with(2.0);
    let answers = swept.grid(vec![spaced(-3.0, 3.0, 41), spaced(-1.0, 1.0, 5)]);
    assert_eq!(answers.solved(), answers.targets.len());
    let mut threefold = 0;
    for target in 0..answers.targets.len() {
        let [x, y] = answers.targets.state(target)[..] else {
            unreachable!()
        };
        let expected = exact.ways(x);
        let found = answers.of(target);
        assert_eq!(found.len(), expected.len(), "extremals at {x}");
        threefold += usize::from(found.len() == 3);
        let (other, slope) = exact.across(y);
        for (entry, Way { v, p, .. }) in found.iter().zip(&expected) {
            assert!(
                (entry.value - v - other).abs() < 1e-8,
                "V at {x}, {y}: {} not {}",
                entry.value,
                v + other
            );
            assert!((entry.p[0] - p).abs() < 1e-8 && (entry.p[1] - slope).abs() < 1e-8);
        }
    }
    assert!(threefold > 30, "{threefold} states with three extremals");
    // On the line of equal cost the ends are +-sqrt(k - 1/T).
    let jump = 2.0 * (exact.k - 1.0 / exact.left).sqrt() / exact.left;
    assert_eq!(answers.equal_cost.len(), 5);
    for e in &answers.equal_cost {
        assert!(
            (e.point.x[0] - exact.equal_cost()).abs() < 1e-8,
            "{:?}",
            e.point.x
        );
        assert!(e.point.difference <= 1e-6);
        assert!(
            ((e.u[0][0] - e.u[1][0]).abs() - jump).abs() < 1e-7
                && (e.u[0][1] - e.u[1][1]).abs() < 1e-8
        );
    }
    // One line through all of them, in order.
    let mut on_line: Vec<(i32, f64)> = answers
        .equal_cost
        .iter()
        .map(|e| (e.point.place, e.point.x[1]))
        .collect();
    on_line.sort_by_key(|p| p.0);
    assert!(answers.equal_cost.iter().all(|e| e.point.line == 0));
    let up = on_line[0].1 < on_line[1].1;
    assert!(
        on_line.windows(2).all(|w| (w[0].1 < w[1].1) == up),
        "{on_line:?}"
    );
    // Folds: dx/dy = 0, y = +-sqrt((k - 1/T)/3).
    let end = ((exact.k - 1.0 / exact.left) / 3.0).sqrt();
    assert!(!answers.folds.is_empty());
    for f in &answers.folds {
        let nearest = [exact.start(end), exact.start(-end)].map(|x| (f.s[0] - x).abs());
        // t along the line is of the second order in the tangent's share, 1e-7.
        assert!(nearest[0].min(nearest[1]) < 1e-9, "fold at {:?}", f.s);
    }
    let both = [end, -end].map(|y| {
        answers
            .folds
            .iter()
            .any(|f| (f.s[0] - exact.start(y)).abs() < 1e-9)
    });
    assert_eq!(both, [true, true]);
}

/// Going round either way costs the same from upright.
#[test]
fn a_symmetric_pendulum_is_torn_at_the_top() {
    let swept = Swept::new(scene("pendulum_rest", &[]), 4000);
    let answers = swept.grid(vec![spaced(-4.0, 4.0, 41), spaced(-0.5, 0.5, 3)]);
    let pi = std::f64::consts::PI;
    let on_axis: Vec<_> = answers
        .equal_cost
        .iter()
        .filter(|e| e.point.x[1] == 0.0)
        .collect();
    assert!(on_axis.len() >= 2, "both ends of the slice");
    for e in on_axis {
        assert!((e.point.x[0].abs() - pi).abs() < 1e-8, "{:?}", e.point.x);
        assert!(
            (e.u[0][0] + e.u[1][0]).abs() < 1e-6 * e.u[0][0].abs(),
            "the torques are opposite: {:?}",
            e.u
        );
    }
    // (theta, omega) -> (-theta, -omega).
    for target in 0..answers.targets.len() {
        let mirrored = answers.targets.len() - 1 - target;
        let (a, b) = (answers.answer(target), answers.answer(mirrored));
        let (a, b) = (a.expect("solved"), b.expect("solved"));
        assert!(
            (a.value - b.value).abs() <= 1e-8 * a.value.max(1e-300),
            "{:?}",
            answers.targets.state(target)
        );
    }
}

/// The dissertation's pendulum: two sheets cost the same on omega = 0 at theta = 2.41, V = 184.
#[test]
fn pendulum_crossing() {
    let swept = Swept::new(scene("pendulum", &[]), 4000);
    let answers = swept.grid(vec![spaced(-5.0, 3.5, 86), vec![0.0]]);
    assert_eq!(answers.solved(), answers.targets.len());
    let near = |x: f64| {
        answers
            .equal_cost
            .iter()
            .find(|e| (e.point.x[0] - x).abs() < 0.05)
    };
    let crossing = near(2.409).expect("a crossing");
    assert!(
        (crossing.point.x[0] - 2.409).abs() < 0.002 && (crossing.point.value - 183.9).abs() < 0.2
    );
    let other = near(2.409 - std::f64::consts::TAU).expect("the same point, a period back");
    assert!((other.point.x[0] - crossing.point.x[0] + std::f64::consts::TAU).abs() < 1e-8);
    // Both sheets of each crossing go on for a radian beyond it, and are smooth: V's differences
    // are p's means.
    for e in [crossing, other] {
        for sheet in e.point.sheets {
            let on: Vec<(f64, f64, f64)> = (0..answers.targets.len())
                .filter_map(|t| {
                    let entry = answers.of(t).iter().find(|e| e.sheet == sheet)?;
                    Some((answers.targets.state(t)[0], entry.value, entry.p[0]))
                })
                .collect();
            let reach = on
                .iter()
                .fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], s| {
                    [a.min(s.0), b.max(s.0)]
                });
            assert!(
                reach[0] <= e.point.x[0] - 1.0 && reach[1] >= e.point.x[0] + 1.0,
                "sheet {sheet}: {reach:?}"
            );
            for w in on.windows(2) {
                let h = w[1].0 - w[0].0;
                assert!((h - 0.1).abs() < 1e-9, "no gaps");
                let mean = 0.5 * (w[0].2 + w[1].2) * h;
                // The trapezium's error is h^3/12 of V'''; a jump to another sheet would be of the
                // size of V.
                assert!(
                    (w[1].1 - w[0].1 - mean).abs() < 0.05 * mean.abs() + 0.05,
                    "sheet {sheet} at {}",
                    w[0].0
                );
            }
        }
    }
}

/// States a period apart are one: they have the same solutions, each with one winding less, and on
/// the line these lie on one sheet, whatever the number of the way round.
#[test]
fn copies_by_whole_periods_lie_on_one_lifted_sheet() {
    const STEPS: usize = 32;
    let swept = Swept::new(scene("pendulum", &[]), 4000);
    let tau = std::f64::consts::TAU;
    let answers = swept.grid(vec![spaced(-tau, tau, 2 * STEPS + 1), vec![0.0]]);
    let highest = 370.0;
    let mut ways_round = std::collections::BTreeSet::new();
    for t in 0..=STEPS {
        for a in answers.of(t).iter().filter(|e| e.value <= highest) {
            let b = (answers.of(t + STEPS).iter()).find(|b| {
                b.winding[0] == a.winding[0] - 1 && (b.value - a.value).abs() <= 1e-8 * a.value
            });
            let b = b.unwrap_or_else(|| {
                panic!(
                    "no copy of V = {} at {:?}",
                    a.value,
                    answers.targets.state(t)
                )
            });
            assert_eq!(
                a.lifted,
                b.lifted,
                "V = {} at {:?}",
                a.value,
                answers.targets.state(t)
            );
            ways_round.insert((a.sheet, b.sheet));
        }
    }
    assert!(ways_round.iter().any(|(a, b)| a != b), "{ways_round:?}");
    assert!(
        answers.lifted < answers.sheets,
        "{} of {}",
        answers.lifted,
        answers.sheets
    );
    // Two solutions of one state are two sheets, unless they go round differently.
    for t in 0..answers.targets.len() {
        let mut places: Vec<_> = answers
            .of(t)
            .iter()
            .map(|e| (e.lifted, &e.winding))
            .collect();
        places.sort();
        assert!(
            places.windows(2).all(|w| w[0] != w[1]),
            "{:?}",
            answers.targets.state(t)
        );
    }
}

/// Single states several periods apart, with nothing between them.
#[test]
fn copies_far_apart_lie_on_one_lifted_sheet() {
    let swept = Swept::new(scene("pendulum_rest", &[]), 4000);
    let far = 2.9 + 2.0 * std::f64::consts::TAU;
    let answers = swept.solve(&Request {
        points: vec![2.9, 0.0, far, 0.0],
        ..Request::default()
    });
    let (near, far) = (
        answers.of(answers.targets.of_given[0]),
        answers.of(answers.targets.of_given[1]),
    );
    assert!(
        near.len() >= 2 && near.len() == far.len(),
        "{} and {}",
        near.len(),
        far.len()
    );
    for (a, b) in near.iter().zip(far) {
        assert!((a.value - b.value).abs() <= 1e-8 * a.value);
        assert_eq!(
            (a.lifted, a.winding[0]),
            (b.lifted, b.winding[0] + 2),
            "V = {}",
            a.value
        );
    }
    assert_eq!(answers.lifted, near.len());
}

/// A grid for /map besides one for /points: the same sheets have the same labels, and a limit
/// leaves far states out.
#[test]
fn a_map_shares_its_sheets_with_the_points() {
    let swept = Swept::new(scene("pendulum", &[]), 4000);
    let grids = vec![
        Grid {
            axes: vec![spaced(-5.0, 3.5, 43), vec![0.0]],
        },
        Grid {
            axes: vec![spaced(-3.9, 2.4, 22), spaced(-11.0, 14.0, 21)],
        },
    ];
    let answers = swept.solve(&Request {
        limits: vec![f64::INFINITY, 185.0],
        grids,
        ..Request::default()
    });
    let mut sheets_on_map = std::collections::BTreeSet::new();
    for k in 43..answers.targets.of_given.len() {
        let target = answers.targets.of_given[k];
        match answers.answer(target) {
            Some(e) => {
                sheets_on_map.insert(e.sheet);
            }
            None => assert_eq!(answers.status(target).name(), "above_value_max"),
        }
    }
    let on_slice: std::collections::BTreeSet<i32> = (0..43)
        .filter_map(|k| Some(answers.answer(answers.targets.of_given[k])?.sheet))
        .collect();
    assert!(
        on_slice.is_subset(&sheets_on_map),
        "{on_slice:?} {sheets_on_map:?}"
    );
    // Up to the cost asked for (twice the sweep's) there are four: straight home, one turn either
    // way, two turns.
    let asked = 370.0;
    let cheap: std::collections::BTreeSet<i32> = (answers.entries.iter())
        .filter(|e| e.value <= asked)
        .map(|e| e.sheet)
        .collect();
    assert!(cheap.len() <= 4, "{} sheets", cheap.len());
    // The boundary on the map: joined to lines, each step of which is within two cells.
    let widths = [6.3 / 21.0, 25.0 / 20.0];
    let mut lines: Vec<_> = answers
        .equal_cost
        .iter()
        .filter(|e| e.point.line >= 0)
        .collect();
    lines.sort_by_key(|e| (e.point.line, e.point.place));
    assert!(lines.len() > 20);
    for w in lines
        .windows(2)
        .filter(|w| w[0].point.line == w[1].point.line)
    {
        let far = largest((0..2).map(|i| (w[1].point.x[i] - w[0].point.x[i]) / widths[i]));
        assert!(far <= 1.0 + 1e-9 && w[1].point.place == w[0].point.place + 1);
    }
}
