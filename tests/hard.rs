//! Sweeps of the scenes in scenarios/hard, on both backends and in both precisions: what is expected of each stands at the
//! top of its file. Oracles: exact V, p and u; equations written by hand and integrated by another method in small steps;
//! the statuses that the mathematics demands.
//!
//! Bounds: what the project promises for V ([`Asked::promised`]), relative to V or to max(1, V).

mod common;
mod common_oracles;

use common::any_gpu;
use common_oracles::{Asked, F32, F64, Sample, Sweep, Worst, dot, minus, norm, parameter, scene};
use costate::backend::{Backend, Run, Status, cpu::Cpu};
use costate::model::{Model, Precision};
use costate::sweep::{Plan, Sampling, stiffness};
use nalgebra::{DMatrix, DVector};

/// A scene in scenarios/hard.
fn hard(name: &str) -> Model {
    scene(&format!("hard/{name}"), &[])
}

/// Both backends, each in both precisions.
fn everywhere(model: &Model, mut look: impl FnMut(&Sweep, Asked, &str)) {
    for asked in [F64, F32] {
        for backend in [Box::new(Cpu::new()) as Box<dyn Backend>, Box::new(any_gpu())] {
            let what = format!("{} {} {}", model.title, backend.name(), asked.precision.name());
            let sweep = Sweep::on(backend, model, asked);
            nothing_is_padded(&sweep, &what);
            look(&sweep, asked, &what);
        }
    }
}

/// What is stored is finite up to a trajectory's end and NaN after it, and every trajectory is counted once.
fn nothing_is_padded(sweep: &Sweep, what: &str) {
    let levels = sweep.plan.samples();
    let mut points = 0;
    for i in 0..sweep.count() {
        // Rising t: what does not exist comes first.
        let t = &sweep.stored.t[i * levels..][..levels];
        let first = t.iter().take_while(|t| t.is_nan()).count();
        assert!(
            t[first..].iter().all(|t| t.is_finite()),
            "{what}: a hole in trajectory {i}"
        );
        points += levels - first;
    }
    for s in sweep.samples() {
        let all = s.x.iter().chain(s.p).chain(s.u).chain([&s.v, &s.h]);
        assert!(
            all.into_iter().all(|x| x.is_finite()),
            "{what}: not finite at t = {}",
            s.t
        );
    }
    assert!(points > 0, "{what}: nothing is stored");
    let counted: usize = sweep.report.by_status.values().sum();
    assert_eq!(counted, sweep.count(), "{what}: statuses");
}

/// V, p and u at a sample.
struct Exact {
    v: f64,
    p: Vec<f64>,
    u: Vec<f64>,
}

fn relative(error: f64, size: f64) -> f64 {
    if error == 0.0 { 0.0 } else { error / size }
}

/// p and u in units of the region's widths, so that states of different size count alike.
fn exact(sweep: &Sweep, asked: Asked, what: &str, right: impl Fn(&Sample) -> Exact) {
    let scaled = |p: &[f64]| norm(&p.iter().zip(&sweep.plan.widths).map(|(p, w)| p * w).collect::<Vec<_>>());
    let (mut v, mut p, mut u) = (Worst::default(), Worst::default(), Worst::default());
    let largest = sweep.samples().map(|s| norm(&right(&s).u)).fold(0.0, f64::max);
    // On a finite horizon V may be as small as it likes, and tolerances are absolute there: what is a thousandth of the
    // scene's is measured against that.
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

/// `V = x'Px/2`, `u = -R^-1 B'P x`.
fn quadratic(p: &DMatrix<f64>, gain: &DMatrix<f64>) -> impl Fn(&Sample) -> Exact {
    move |s| {
        let x = DVector::from_column_slice(s.x);
        let costate = p * &x;
        Exact {
            v: 0.5 * costate.dot(&x),
            u: (-(gain * &x)).as_slice().to_vec(),
            p: costate.as_slice().to_vec(),
        }
    }
}

/// The compressor's characteristics written by hand, in `(x, p, V)`, by backward time.
struct Compressor {
    x0: [f64; 4],
    v_max: f64,
}

impl Compressor {
    fn of(model: &Model) -> Self {
        let q = |name| parameter(model, name);
        assert_eq!((q("sigma"), q("beta")), (4.0, 1.0));
        Self {
            x0: [q("Phi0"), q("Psi0"), 0.0, q("gamma0")],
            v_max: q("v_max"),
        }
    }

    fn control(&self, p: &[f64]) -> f64 {
        (-0.5 * p[3]).clamp(-self.v_max, self.v_max)
    }

    fn cost(&self, x: &[f64], v: f64) -> f64 {
        (0..4).map(|i| (x[i] - self.x0[i]).powi(2)).sum::<f64>() + v * v
    }

    fn forward(&self, x: &[f64], v: f64) -> [f64; 4] {
        let characteristic = 1.1469 + 1.5 * x[0] - 0.5 * x[0].powi(3);
        [
            characteristic - x[1] - 3.0 * x[0] * x[2],
            x[0] + 1.0 - x[3] * x[1].sqrt(),
            4.0 * x[2] * (1.0 - x[0] * x[0] - x[2]),
            v,
        ]
    }

    fn hamiltonian(&self, x: &[f64], p: &[f64]) -> f64 {
        let v = self.control(p);
        dot(p, &self.forward(x, v)) + self.cost(x, v)
    }

    fn rate(&self, y: &[f64]) -> Vec<f64> {
        let (x, p) = (&y[..4], &y[4..8]);
        let v = self.control(p);
        let f = self.forward(x, v);
        let root = x[1].sqrt();
        // dH/dx: L's gradient and f's Jacobian transposed times p.
        let slope = [
            2.0 * (x[0] - self.x0[0]) + p[0] * (1.5 - 1.5 * x[0] * x[0] - 3.0 * x[2]) + p[1] - 8.0 * x[0] * x[2] * p[2],
            2.0 * (x[1] - self.x0[1]) - p[0] - 0.5 * p[1] * x[3] / root,
            2.0 * x[2] - 3.0 * x[0] * p[0] + 4.0 * p[2] * (1.0 - x[0] * x[0] - 2.0 * x[2]),
            2.0 * (x[3] - self.x0[3]) - p[1] * root,
        ];
        f.iter().map(|f| -f).chain(slope).chain([self.cost(x, v)]).collect()
    }

    /// Classical Runge-Kutta steps from a seed, to a backward time. In a step with a kink the error is of the second order
    /// in the step.
    fn integrate(&self, seed: &[f64], reference: &[f64], time: f64, steps: usize) -> Vec<f64> {
        let mut y: Vec<f64> = (0..4)
            .map(|i| seed[i] + reference[i])
            .chain(seed[4..9].iter().copied())
            .collect();
        let h = time / steps as f64;
        let moved = |y: &[f64], k: &[f64], h: f64| y.iter().zip(k).map(|(y, k)| y + h * k).collect::<Vec<_>>();
        for _ in 0..steps {
            let a = self.rate(&y);
            let b = self.rate(&moved(&y, &a, 0.5 * h));
            let c = self.rate(&moved(&y, &b, 0.5 * h));
            let d = self.rate(&moved(&y, &c, h));
            for i in 0..9 {
                y[i] += h / 6.0 * (a[i] + 2.0 * (b[i] + c[i]) + d[i]);
            }
        }
        y
    }

    /// A few trajectories against integration by hand, and H at all samples.
    fn check(&self, sweep: &Sweep, asked: Asked, what: &str) {
        const TRAJECTORIES: usize = 12;
        const STEPS: usize = 40_000;
        // What 40000 steps of at most 5e-4 leave at a kink, h^2 times a jump of order 1 of the second derivative, and
        // accumulated rounding, are below this.
        const BY_HAND: f64 = 1e-6;
        let bound = asked.promised().max(BY_HAND);
        let mut e_v = Worst::default();
        let reference = &sweep.plan.system.reference;
        for i in (0..sweep.count()).step_by(sweep.count() / TRAJECTORIES) {
            let Some(last) = (0..sweep.levels()).rev().find(|k| !sweep.raw.sample(i, *k)[0].is_nan()) else {
                continue;
            };
            let sample = sweep.raw.sample(i, last);
            let y = self.integrate(&sweep.seeds[i * 9..][..9], reference, sample[0], STEPS);
            let x: Vec<f64> = (0..4).map(|j| sample[1 + j] + reference[j] - y[j]).collect();
            let mean: Vec<f64> = (0..4).map(|j| 0.5 * (sample[5 + j] + y[4 + j])).collect();
            e_v.see((sample[9] - y[8] - dot(&mean, &x)).abs() / y[8].max(1.0));
        }
        e_v.at_most(bound, &format!("{what}: e_V against integration by hand"));
        // On a finite horizon H keeps the value it has at the end, the sample of latest t.
        let mut drift = Worst::default();
        let mut end = (usize::MAX, 0.0);
        let all: Vec<Sample> = sweep.samples().collect();
        for s in all.iter().rev() {
            let h = self.hamiltonian(s.x, s.p);
            if end.0 != s.trajectory {
                end = (
                    s.trajectory,
                    if sweep.plan.sampling == Sampling::Time { h } else { 0.0 },
                );
            }
            let terms = dot(s.p, &self.forward(s.x, s.u[0])).abs() + self.cost(s.x, s.u[0]);
            // H - H(end) relative to the terms that cancel in it, and to the largest V's cost where these are small.
            drift.see((h - end.1).abs() / (terms + 1e-2));
        }
        // H sees errors of p times x': tolerances of some hundred steps.
        drift.at_most(100.0 * asked.promised(), &format!("{what}: H by hand"));
    }
}

#[test]
fn rate_saturation() {
    let model = hard("rate_saturation");
    let by_hand = Compressor::of(&model);
    everywhere(&model, |sweep, asked, what| {
        by_hand.check(sweep, asked, what);
        // Long arcs at the bound: time between samples at it, of the trajectory that is there longest.
        let mut longest = 0.0f64;
        let (mut arc, mut before): (f64, Option<(usize, f64)>) = (0.0, None);
        for s in sweep.samples() {
            let at_bound = (s.u[0].abs() - by_hand.v_max).abs() <= 1e-6 * by_hand.v_max;
            arc = match before {
                Some((trajectory, t)) if at_bound && trajectory == s.trajectory => arc + s.t - t,
                _ => 0.0,
            };
            before = at_bound.then_some((s.trajectory, s.t));
            longest = longest.max(arc);
        }
        assert!(longest > 1.0, "{what}: at the bound for {longest} at most");
        assert!(
            stiffness::held_steps(&sweep.plan, &sweep.report.sample).is_none(),
            "{what} is not stiff"
        );
    });
}

#[test]
fn near_peak() {
    let model = hard("near_peak");
    let by_hand = Compressor::of(&model);
    everywhere(&model, |sweep, asked, what| {
        by_hand.check(sweep, asked, what);
        let rates = stiffness::separation(&sweep.plan).expect("an infinite horizon");
        // The uncontrollable mode: sigma (1 - Phi0^2).
        assert!((rates.slowest.re - 4.0 * (1.0 - 1.02 * 1.02)).abs() < 1e-9, "{rates:?}");
        assert!(!rates.hides_fronts() || asked.precision == Precision::F32, "{rates:?}");
        assert!(
            stiffness::held_steps(&sweep.plan, &sweep.report.sample).is_none(),
            "{what} is not stiff"
        );
    });
}

#[test]
fn peak_over_a_finite_horizon() {
    let model = hard("peak_finite_horizon");
    let by_hand = Compressor::of(&model);
    everywhere(&model, |sweep, asked, what| {
        by_hand.check(sweep, asked, what);
        assert!(sweep.raw.status.contains(&Status::Reached), "{what}");
    });
}

fn guarded(sweep: &Sweep, name: &str) -> usize {
    let flag = sweep.plan.status_flags().into_iter().find(|(_, n)| n == name);
    let (code, _) = flag.expect("the guard has a status");
    sweep.report.by_status.get(&code).copied().unwrap_or(0)
}

#[test]
fn pressure_to_zero() {
    let model = hard("pressure_to_zero");
    let by_hand = Compressor::of(&model);
    everywhere(&model, |sweep, asked, what| {
        by_hand.check(sweep, asked, what);
        assert!(sweep.samples().all(|s| s.x[1] > 0.0), "{what}: Psi <= 0");
        assert!(
            guarded(sweep, "guard_pressure_positive") > 0,
            "{what}: {:?}",
            sweep.report.by_status
        );
        assert_eq!(
            guarded(sweep, "guard_stall_not_negative"),
            0,
            "{what}: R = 0 is invariant"
        );
        // All ends have a reason: none merely stops.
        let stopped = [Status::NotFinite, Status::StepFloor, Status::StepLimit].map(|s| s as i32);
        assert!(sweep.report.by_status.keys().all(|k| !stopped.contains(k)), "{what}");
    });
    // Without the guard the domain of the square root is all that stops them.
    let mut model = hard("pressure_to_zero");
    model.guards.retain(|g| g.name != "pressure_positive");
    everywhere(&model, |sweep, _, what| {
        assert!(sweep.samples().all(|s| s.x[1] >= 0.0), "{what}: Psi < 0");
        let failed: usize = [Status::NotFinite, Status::StepFloor]
            .iter()
            .filter_map(|s| sweep.report.by_status.get(&(*s as i32)))
            .sum();
        assert!(failed > 0, "{what}: {:?}", sweep.report.by_status);
    });
}

#[test]
fn stall_to_zero() {
    let model = hard("stall_to_zero");
    let by_hand = Compressor::of(&model);
    everywhere(&model, |sweep, asked, what| {
        by_hand.check(sweep, asked, what);
        assert!(sweep.samples().all(|s| s.x[2] >= 0.0), "{what}: R < 0");
        let smallest = sweep.samples().map(|s| s.x[2]).filter(|r| *r > 0.0).fold(1.0, f64::min);
        assert!(smallest < 1e-8, "{what}: R is never small");
    });
}

/// Seeds with R = 0 exactly: the trajectories stay there exactly, whatever the other states do.
#[test]
fn an_invariant_boundary_is_kept_exactly() {
    let model = hard("stall_to_zero");
    for asked in [F64, F32] {
        for backend in [Box::new(Cpu::new()) as Box<dyn Backend>, Box::new(any_gpu())] {
            let hamiltonian = common_oracles::derive(&model);
            let plan = Plan::new(&model, &hamiltonian, backend.as_ref(), asked.choices()).expect("a plan");
            let local = plan.local.as_ref().expect("an infinite horizon");
            let size = (2.0 * local.seed_value).sqrt();
            let seeds: Vec<f64> = (0..64)
                .flat_map(|k| {
                    let angle = f64::from(k) * 0.7;
                    let lean = f64::from(k % 8) / 8.0;
                    let mut s = [angle.cos(), angle.sin() * (1.0 - lean), 0.0, lean];
                    let scale = size / local.quadratic(&s).sqrt() / 2f64.sqrt();
                    s.iter_mut().for_each(|x| *x *= scale);
                    local.at_state(&s)
                })
                .collect();
            let mut kernel = backend.compile(&plan.spec).expect("a kernel");
            let result = kernel.integrate(&plan.run, &seeds).expect("the backend works");
            let mut points = 0;
            for i in 0..result.count() {
                assert_eq!(result.end[i * 9 + 2], 0.0, "{} {:?}", backend.name(), asked);
                for k in 0..result.levels {
                    let sample = result.sample(i, k);
                    if !sample[0].is_nan() {
                        assert_eq!(sample[3], 0.0, "{} {:?} level {k}", backend.name(), asked);
                        points += usize::from(sample[1].abs() > 0.01);
                    }
                }
            }
            assert!(points > 100, "the other states move: {points}");
        }
    }
}

#[test]
fn cheap_control() {
    let model = hard("cheap_control");
    let root = parameter(&model, "r").sqrt();
    let p22 = root * (1.0 + 2.0 * root).sqrt();
    let p = DMatrix::from_row_slice(2, 2, &[(1.0 + 2.0 * root).sqrt(), root, root, p22]);
    let gain = p.rows(1, 1).into_owned() / (root * root);
    everywhere(&model, |sweep, asked, what| {
        exact(sweep, asked, what, quadratic(&p, &gain));
        // The slow part of the fronts comes from seeds that no number tells apart: said before and after.
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
        exact(sweep, asked, what, quadratic(&p, &gain));
        assert_eq!(
            sweep.report.coverage.uncovered + sweep.report.coverage.indistinguishable,
            0,
            "{what}"
        );
        let rates = stiffness::separation(&sweep.plan).expect("an infinite horizon");
        assert!(!rates.hides_fronts() && rates.ratio < 1.1, "{what}: {rates:?}");
    });
}

#[test]
fn long_horizon() {
    let model = hard("long_horizon");
    let (end, s) = (parameter(&model, "T"), parameter(&model, "s"));
    // P' = A'P + PA - P B B'P + I by time left, from s I; entries p11, p12, p22. Steps of 1e-3: the error of order 4 is
    // below 1e-10 even where P falls from 10.
    const STEP: f64 = 1e-3;
    let rate = |p: [f64; 3]| [1.0 - p[1] * p[1], p[0] - p[1] * p[2], 2.0 * p[1] + 1.0 - p[2] * p[2]];
    let moved = |p: [f64; 3], k: [f64; 3], h: f64| [p[0] + h * k[0], p[1] + h * k[1], p[2] + h * k[2]];
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
            let p = vec![a * sample.x[0] + b * sample.x[1], b * sample.x[0] + c * sample.x[1]];
            Exact {
                v: 0.5 * dot(sample.x, &p),
                u: vec![-p[1]],
                p,
            }
        });
        let c = &sweep.report.coverage;
        assert!(c.uncovered + c.indistinguishable > 0, "{what}: claims to cover");
        // At the largest growth of the region's widths, exp(0.866 * 60), all others have left.
        assert!(
            sweep.raw.status.iter().filter(|s| **s == Status::Reached).count() <= 2,
            "{what}"
        );
    });
}

#[test]
fn hidden_sheet() {
    let model = hard("hidden_sheet");
    let (k, turn) = (parameter(&model, "k"), parameter(&model, "turn"));
    let turned = |a: f64, b: f64| [turn.cos() * a + turn.sin() * b, -turn.sin() * a + turn.cos() * b];
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
            // Spacing is in widths of the region (4.4), along the turned axes; one gap may lie across an end.
            let gap = 0.05 * 4.4 * 2f64.sqrt();
            let found = there.len() >= 5 && widest <= gap && reach <= -end + gap;
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
            Precision::F32 => assert!(c.indistinguishable > 0, "{what}: f32 cannot tell such seeds apart"),
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
                let v = 0.5 * x * x + (0.5 * x).sin().powi(2) + 0.5 * x * y + y * y + 0.25 * x * x * y * y;
                values.see((s[4] - v).abs() / v);
            }
        }
        values.at_most(asked.promised(), &format!("{what}: V of deviations"));
        exact(sweep, asked, what, |s| {
            let [x, y] = [(s.x[0] - x0) / a, (s.x[1] - y0) / b];
            let v_y = 0.5 * x + 2.0 * y + 0.5 * x * x * y;
            Exact {
                v: 0.5 * x * x + (0.5 * x).sin().powi(2) + 0.5 * x * y + y * y + 0.25 * x * x * y * y,
                p: vec![(x + 0.5 * x.sin() + 0.5 * y + 0.5 * x * y * y) / a, v_y / b],
                u: vec![-v_y / r],
            }
        });
    });
}

#[test]
fn stiff_chain() {
    let model = hard("stiff_chain");
    let rates: Vec<f64> = (1..=6).map(|i| parameter(&model, &format!("k{i}"))).collect();
    let weight = parameter(&model, "q");
    let a = DMatrix::from_fn(6, 6, |i, j| match i.checked_sub(j) {
        Some(0) => -rates[i],
        Some(1) => rates[i],
        _ => 0.0,
    });
    let b = DMatrix::from_fn(6, 1, |i, _| if i == 0 { rates[0] } else { 0.0 });
    let q = DMatrix::from_fn(6, 6, |i, j| match (i == j, i) {
        (true, 5) => 1.0,
        (true, _) => weight,
        _ => 0.0,
    });
    // Kleinman's iteration from zero gain: Lyapunov equations of 36 unknowns.
    let identity = DMatrix::<f64>::identity(6, 6);
    let (mut p, mut gain) = (DMatrix::zeros(6, 6), DMatrix::zeros(1, 6));
    for _ in 0..30 {
        let closed = &a - &b * &gain;
        let operator = identity.kronecker(&closed.transpose()) + closed.transpose().kronecker(&identity);
        let right = -(&q + gain.transpose() * &gain);
        let x = operator.lu().solve(&DVector::from_column_slice(right.as_slice()));
        p = DMatrix::from_column_slice(6, 6, x.expect("a stable closed loop").as_slice());
        gain = b.transpose() * &p;
    }
    everywhere(&model, |sweep, asked, what| {
        exact(sweep, asked, what, quadratic(&p, &gain));
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
        exact(sweep, asked, what, quadratic(&p, &gain));
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
                let failed = matches!(status, Status::StepFloor | Status::NotFinite | Status::StepLimit);
                // Near the singularity steps too small to be seen in t still move x, out of any margin.
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

/// A fast unstable mode that is in no trajectory: backward in time it decays, and holds the steps at the boundary of
/// stability. Exact: z stays unseen, V is that of the cart.
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
                assert!(h.product > 0.5 * h.boundary && h.product < 1.5 * h.boundary, "{h:?}");
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
        let limited = sweep.raw.status.iter().filter(|s| **s == Status::StepLimit).count();
        assert!(limited > 0, "{what}");
        let Run { max_steps, .. } = sweep.plan.run;
        assert!(sweep.raw.steps.iter().all(|s| *s <= max_steps), "{what}");
    });
}
