//! The compressor's scenes in scenarios/hard, on both backends and in both precisions, against its
//! characteristics written by hand and integrated by another method in small steps: what is
//! expected of each scene stands at the top of its file.

use crate::common;
use crate::common_hard;
use crate::common_oracles;

use common::any_gpu;
use common_hard::{everywhere, hard};
use common_oracles::{Asked, F32, F64, Sample, Sweep, Worst, dot, parameter};
use costate::backend::{Backend, Status, cpu::Cpu};
use costate::low_level::model::{Model, Precision};
use costate::low_level::sweep::{Plan, Sampling, stiffness};

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
            2.0 * (x[0] - self.x0[0]) + p[0] * (1.5 - 1.5 * x[0] * x[0] - 3.0 * x[2]) + p[1]
                - 8.0 * x[0] * x[2] * p[2],
            2.0 * (x[1] - self.x0[1]) - p[0] - 0.5 * p[1] * x[3] / root,
            2.0 * x[2] - 3.0 * x[0] * p[0] + 4.0 * p[2] * (1.0 - x[0] * x[0] - 2.0 * x[2]),
            2.0 * (x[3] - self.x0[3]) - p[1] * root,
        ];
        f.iter()
            .map(|f| -f)
            .chain(slope)
            .chain([self.cost(x, v)])
            .collect()
    }

    /// Classical Runge-Kutta steps from a seed, to a backward time. In a step with a kink the error
    /// is of the second order in the step.
    fn integrate(&self, seed: &[f64], reference: &[f64], time: f64, steps: usize) -> Vec<f64> {
        let mut y: Vec<f64> = (0..4)
            .map(|i| seed[i] + reference[i])
            .chain(seed[4..9].iter().copied())
            .collect();
        let h = time / steps as f64;
        let moved = |y: &[f64], k: &[f64], h: f64| {
            y.iter().zip(k).map(|(y, k)| y + h * k).collect::<Vec<_>>()
        };
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
        // What 40000 steps of at most 5e-4 leave at a kink, h^2 times a jump of order 1 of the
        // second derivative, and accumulated rounding, are below this.
        const BY_HAND: f64 = 1e-6;
        let bound = asked.promised().max(BY_HAND);
        let mut e_v = Worst::default();
        let reference = &sweep.plan.system.reference;
        for i in (0..sweep.count()).step_by(sweep.count() / TRAJECTORIES) {
            let Some(last) = (0..sweep.levels())
                .rev()
                .find(|k| !sweep.raw.sample(i, *k)[0].is_nan())
            else {
                continue;
            };
            let sample = sweep.raw.sample(i, last);
            let y = self.integrate(&sweep.seeds[i * 9..][..9], reference, sample[0], STEPS);
            let x: Vec<f64> = (0..4)
                .map(|j| sample[1 + j] + reference[j] - y[j])
                .collect();
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
                    if sweep.plan.sampling == Sampling::Time {
                        h
                    } else {
                        0.0
                    },
                );
            }
            let terms = dot(s.p, &self.forward(s.x, s.u[0])).abs() + self.cost(s.x, s.u[0]);
            // H - H(end) relative to the terms that cancel in it, and to the largest V's cost where
            // these are small.
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
        // Long arcs at the bound: time between samples at it, of the trajectory that is there
        // longest.
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
        assert!(
            (rates.slowest.re - 4.0 * (1.0 - 1.02 * 1.02)).abs() < 1e-9,
            "{rates:?}"
        );
        assert!(
            !rates.hides_fronts() || asked.precision == Precision::F32,
            "{rates:?}"
        );
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
    let flag = sweep
        .plan
        .status_flags()
        .into_iter()
        .find(|(_, n)| n == name);
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
        assert!(
            sweep.report.by_status.keys().all(|k| !stopped.contains(k)),
            "{what}"
        );
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
        let smallest = sweep
            .samples()
            .map(|s| s.x[2])
            .filter(|r| *r > 0.0)
            .fold(1.0, f64::min);
        assert!(smallest < 1e-8, "{what}: R is never small");
    });
}

/// Seeds with R = 0 exactly: the trajectories stay there exactly, whatever the other states do.
#[test]
fn an_invariant_boundary_is_kept_exactly() {
    let model = hard("stall_to_zero");
    for asked in [F64, F32] {
        for backend in [
            Box::new(Cpu::new()) as Box<dyn Backend>,
            Box::new(any_gpu()),
        ] {
            let hamiltonian = common_oracles::derive(&model);
            let plan =
                Plan::new(&model, &hamiltonian, backend.as_ref(), asked.choices()).expect("a plan");
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
            let result = kernel
                .integrate(&plan.run, &seeds)
                .expect("the backend works");
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
