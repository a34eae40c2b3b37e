//! The derived right-hand sides against ones written by hand. By hand: the dynamics f, the cost L
//! and the optimal control; H = p'f + L; and p' = -dH/dx at fixed control by dual numbers. What the
//! program derives symbolically, rewrites in deviations from the equilibrium and lowers to
//! registers must agree with that to rounding.

use crate::common_oracles;

use common_oracles::numbers::{Double, Dual, Number, Sized};
use common_oracles::{Random, derive, scene};
use costate::backend::cpu::{Cpu, Evaluator};
use costate::backend::{Backend, By, Run, Spec};
use costate::low_level::hamiltonian::System;
use costate::low_level::model::{Method, Model, Precision};
use costate::low_level::program::Program;

/// A system written by hand, with N states and one control.
trait ByHand<const N: usize> {
    fn equilibrium<T: Number>(&self) -> [T; N];
    fn dynamics<T: Number>(&self, x: &[T; N], u: T) -> [T; N];
    fn running<T: Number>(&self, x: &[T; N], u: T) -> T;
    /// Optimal control, bounds included.
    fn control<T: Number>(&self, x: &[T; N], p: &[T; N]) -> T;
    /// Whether the control is at a bound: 1, -1; else 0.
    fn saturated(&self, _: &[f64; N], _: &[f64; N]) -> i32 {
        0
    }

    fn hamiltonian<T: Number>(&self, x: &[T; N], p: &[T; N], u: T) -> T {
        let f = self.dynamics(x, u);
        (0..N).fold(self.running(x, u), |h, i| h + p[i] * f[i])
    }

    /// Derivatives of `(x, p, V)` by backward time.
    fn rates<T: Number>(&self, x: &[T; N], p: &[T; N]) -> Vec<T> {
        let u = self.control(x, p);
        let dual_x: [Dual<T, N>; N] = std::array::from_fn(|i| Dual::variable(x[i], i));
        let h = self.hamiltonian(&dual_x, &p.map(Dual::constant), Dual::constant(u));
        let mut rates: Vec<T> = self.dynamics(x, u).iter().map(|f| -*f).collect();
        rates.extend(h.d);
        rates.push(self.running(x, u));
        rates
    }
}

struct Pendulum;

impl Pendulum {
    const G: f64 = 9.81;
    const Q: f64 = 5.55;
    const R: f64 = 1.85;
    const ANGLE: f64 = -1.5;

    fn torque<T: Number>() -> T {
        T::of(Self::G) * T::of(Self::ANGLE).sin()
    }
}

impl ByHand<2> for Pendulum {
    fn equilibrium<T: Number>(&self) -> [T; 2] {
        [T::of(Self::ANGLE), T::of(0.0)]
    }
    fn dynamics<T: Number>(&self, x: &[T; 2], u: T) -> [T; 2] {
        [x[1], u - T::of(Self::G) * x[0].sin()]
    }
    fn running<T: Number>(&self, x: &[T; 2], u: T) -> T {
        let state = (x[0] - T::of(Self::ANGLE)).square() + x[1].square();
        T::of(0.5) * (T::of(Self::Q) * state + T::of(Self::R) * (u - Self::torque()).square())
    }
    fn control<T: Number>(&self, _: &[T; 2], p: &[T; 2]) -> T {
        Self::torque::<T>() - p[1] / T::of(Self::R)
    }
}

/// Facts of the compressor that both versions share.
struct Compressor {
    /// Slope of the cross term.
    c: f64,
}

impl Compressor {
    const SIGMA: f64 = 4.0;
    const SHUT_OFF: f64 = 0.1469;
    const FLOW: f64 = 1.2;

    fn characteristic<T: Number>(flow: T) -> T {
        T::of(Self::SHUT_OFF) + T::of(1.0) + T::of(1.5) * flow - T::of(0.5) * flow * flow * flow
    }
    fn pressure<T: Number>() -> T {
        Self::characteristic(T::of(Self::FLOW))
    }
    fn throttle<T: Number>() -> T {
        (T::of(Self::FLOW) + T::of(1.0)) / Self::pressure::<T>().sqrt()
    }
    fn gas<T: Number>(flow: T, pressure: T, stall: T, throttle: T) -> [T; 3] {
        [
            Self::characteristic(flow) - pressure - T::of(3.0) * flow * stall,
            flow + T::of(1.0) - throttle * pressure.sqrt(),
            T::of(Self::SIGMA) * stall * (T::of(1.0) - flow.square() - stall),
        ]
    }
    fn cost<T: Number>(&self, flow: T, pressure: T, stall: T, throttle: T) -> T {
        let flow = flow - T::of(Self::FLOW);
        let pressure = pressure - Self::pressure();
        flow.square()
            + (pressure - T::of(self.c) * flow).square()
            + stall.square()
            + (throttle - Self::throttle()).square()
    }
}

/// The throttle as a state, its rate bounded.
struct Limited(Compressor, f64);

impl ByHand<4> for Limited {
    fn equilibrium<T: Number>(&self) -> [T; 4] {
        [
            T::of(Compressor::FLOW),
            Compressor::pressure(),
            T::of(0.0),
            Compressor::throttle(),
        ]
    }
    fn dynamics<T: Number>(&self, x: &[T; 4], u: T) -> [T; 4] {
        let [a, b, c] = Compressor::gas(x[0], x[1], x[2], x[3]);
        [a, b, c, u]
    }
    fn running<T: Number>(&self, x: &[T; 4], u: T) -> T {
        self.0.cost(x[0], x[1], x[2], x[3]) + u.square()
    }
    fn control<T: Number>(&self, _: &[T; 4], p: &[T; 4]) -> T {
        (-p[3] / T::of(2.0)).clamped(self.1)
    }
    fn saturated(&self, _: &[f64; 4], p: &[f64; 4]) -> i32 {
        if p[3].abs() > 2.0 * self.1 {
            -p[3].signum() as i32
        } else {
            0
        }
    }
}

/// The throttle as the control.
struct Free(Compressor);

impl ByHand<3> for Free {
    fn equilibrium<T: Number>(&self) -> [T; 3] {
        [T::of(Compressor::FLOW), Compressor::pressure(), T::of(0.0)]
    }
    fn dynamics<T: Number>(&self, x: &[T; 3], u: T) -> [T; 3] {
        Compressor::gas(x[0], x[1], x[2], u)
    }
    fn running<T: Number>(&self, x: &[T; 3], u: T) -> T {
        self.0.cost(x[0], x[1], x[2], u)
    }
    fn control<T: Number>(&self, x: &[T; 3], p: &[T; 3]) -> T {
        Compressor::throttle::<T>() + p[1] * x[1].sqrt() / T::of(2.0)
    }
}

/// Random points of each comparison.
const POINTS: usize = 4000;

struct Case<'a, const N: usize, H> {
    name: &'a str,
    hand: H,
    model: Model,
    system: System,
    program: Program,
    /// Adjoints are drawn from `[-p, p]`.
    adjoints: [f64; N],
}

impl<'a, const N: usize, H: ByHand<N>> Case<'a, N, H> {
    fn new(name: &'a str, set: &[(&str, &str)], hand: H, adjoints: [f64; N]) -> Self {
        let model = scene(name, set);
        let system = System::new(&derive(&model), &model);
        let program = Program::lower(&system.graph, &system.inputs, &system.rate);
        Self {
            name,
            hand,
            model,
            system,
            program,
            adjoints,
        }
    }

    /// Random `(s, p)` over the region.
    fn draw(&self, random: &mut Random) -> Vec<f64> {
        let x = random.point(&self.model.region);
        let s = x.iter().zip(&self.system.reference).map(|(x, at)| x - at);
        s.chain(self.adjoints.map(|p| random.within(-p, p)))
            .collect()
    }

    /// Roundings on the way to one rate, by hand or derived: at most all operations, once each.
    fn roundings(&self, eps: f64) -> f64 {
        self.program.operations() as f64 * eps
    }

    fn point<T: Number>(&self, z: &[f64]) -> ([T; N], [T; N]) {
        let reference = &self.system.reference;
        (
            std::array::from_fn(|i| T::of(z[i]) + T::of(reference[i])),
            std::array::from_fn(|i| T::of(z[N + i])),
        )
    }

    fn everywhere(&self) {
        let mut random = Random::new(7);
        let points: Vec<f64> = (0..POINTS).flat_map(|_| self.draw(&mut random)).collect();
        let lanes = Evaluator::new(&self.program).eval(&points, 2 * N);
        let short: Vec<f64> = points.iter().map(|z| f64::from(*z as f32)).collect();
        let short_lanes = self.lanes_f32(&short, 2f64.powi(-42));
        let (mut worst, mut worst_f32) = (0.0f64, 0.0f64);
        let mut saturated = [0; 3];
        for k in 0..POINTS {
            let z = &points[k * 2 * N..][..2 * N];
            let (x, p) = self.point::<Sized>(z);
            saturated[(self
                .hand
                .saturated(&x.map(Number::value), &p.map(Number::value))
                + 1) as usize] += 1;
            let by_hand = self.hand.rates(&x, &p);
            let derived = self.program.eval(z);
            let width = 2 * N + 1;
            for (i, hand) in by_hand.iter().enumerate() {
                for rate in [derived[i], lanes[k * width + i]] {
                    let units = (rate - hand.v).abs() / (f64::EPSILON * hand.size);
                    worst = worst.max(units);
                    assert!(
                        units <= self.roundings(1.0),
                        "{}: rate {i} at {z:?} is {rate:e}, by hand {:e}",
                        self.name,
                        hand.v
                    );
                }
            }
            let (x, p) = self.point::<Sized>(&short[k * 2 * N..][..2 * N]);
            for (i, hand) in self.hand.rates(&x, &p).iter().enumerate() {
                let units = (short_lanes[k * width + i] - hand.v).abs()
                    / (f64::from(f32::EPSILON) * hand.size);
                worst_f32 = worst_f32.max(units);
                assert!(
                    units <= self.roundings(1.0),
                    "{}: f32 rate {i} is {units} units off",
                    self.name
                );
            }
        }
        println!(
            "{}: {} operations, worst {worst:.1} eps in f64, {worst_f32:.1} in f32; control low, free, high: {saturated:?}",
            self.name,
            self.program.operations()
        );
    }

    /// Rates at points `(s, p)` by the f32 lanes: one tiny step, in which further components that
    /// start at 0 take up h times the rates without losing digits to the values themselves. The
    /// step must be so short that rates change by less than f32 resolves; near the equilibrium,
    /// where they are proportional to the values, a longer one is.
    fn lanes_f32(&self, points: &[f64], step: f64) -> Vec<f64> {
        let twice = [self.system.rate.as_slice(), &self.system.rate].concat();
        let spec = Spec {
            rate: Program::lower(&self.system.graph, &self.system.inputs, &twice),
            guards: None,
            kinks: None,
            method: Method::Rk4,
            precision: Precision::F32,
            by: By::Time,
            store: false,
        };
        let dim = spec.dim();
        let run = Run {
            rtol: 1e-6,
            atol: vec![1.0; dim],
            step,
            first: None,
            max_steps: 10,
            levels: vec![step],
            ceiling: None,
            bounds: Vec::new(),
        };
        let seeds: Vec<f64> = points
            .chunks(2 * N)
            .flat_map(|z| {
                z.iter()
                    .copied()
                    .chain(std::iter::repeat_n(0.0, dim - 2 * N))
            })
            .collect();
        let mut kernel = Cpu::new()
            .compile(&spec)
            .expect("the CPU compiles anything");
        let result = kernel
            .integrate(&run, &seeds)
            .expect("the CPU does not fail");
        result
            .end
            .chunks(dim)
            .flat_map(|y| {
                y[2 * N + 1..]
                    .iter()
                    .map(|dy| dy / step)
                    .collect::<Vec<_>>()
            })
            .collect()
    }

    /// dH/dx with the control moving along (the envelope theorem, clamps included) by central
    /// differences.
    fn differences(&self) {
        let mut random = Random::new(11);
        for _ in 0..POINTS / 4 {
            let z = self.draw(&mut random);
            let (x, p) = self.point::<f64>(&z);
            let rates = self.program.eval(&z);
            let value = self
                .system
                .eval(&[self.system.observer.hamiltonian], &z[..N], &z[N..])[0];
            let sized = {
                let (x, p) = self.point::<Sized>(&z);
                self.hand.hamiltonian(&x, &p, self.hand.control(&x, &p))
            };
            let rounding = self.roundings(f64::EPSILON) * sized.size;
            assert!(
                (value - sized.v).abs() <= rounding,
                "{}: H is {value:e}, by hand {:e}",
                self.name,
                sized.v
            );
            for i in 0..N {
                // The step that balances truncation and rounding.
                let h = f64::EPSILON.cbrt() * (self.model.region[i][1] - self.model.region[i][0]);
                let slope = |h: f64| {
                    let at = |step: f64| {
                        let mut x = x;
                        x[i] += step;
                        self.hand.hamiltonian(&x, &p, self.hand.control(&x, &p))
                    };
                    (at(h) - at(-h)) / (2.0 * h)
                };
                let (fine, coarse) = (slope(h), slope(2.0 * h));
                // The error falls as h^2, so it is a third of what the two differ by.
                let bound = (coarse - fine).abs() + rounding / h;
                let error = (rates[N + i] - fine).abs();
                assert!(
                    error <= bound,
                    "{}: dH/dx{i} is {}, by differences {fine}",
                    self.name,
                    rates[N + i]
                );
                // Far from vacuous: several digits of the slope's own scale.
                assert!(
                    bound <= 1e-5 * sized.size / (x[i].abs() + 1e-2) + 1e-5,
                    "bound {bound:e}"
                );
            }
        }
    }

    /// Deviations of 1e-8 and less: rates to full relative accuracy, against 32 digits.
    fn near_the_equilibrium(&self) {
        let mut random = Random::new(13);
        let scales: Vec<f64> = (0..400).map(|k| 10f64.powi(-(k % 5) - 8)).collect();
        let points: Vec<f64> = scales
            .iter()
            .flat_map(|scale| {
                (0..2 * N)
                    .map(|_| f64::from((scale * random.within(-1.0, 1.0)) as f32))
                    .collect::<Vec<_>>()
            })
            .collect();
        let width = 2 * N + 1;
        let lanes = Evaluator::new(&self.program).eval(&points, 2 * N);
        let short = self.lanes_f32(&points, 2f64.powi(-30));
        let mut worst = [0.0f64; 3];
        for (k, z) in points.chunks(2 * N).enumerate() {
            let exact = |z: &[f64]| -> Vec<f64> {
                let at = self.hand.equilibrium::<Double>();
                let x = std::array::from_fn(|i| at[i] + Double::of(z[i]));
                let p = std::array::from_fn(|i| Double::of(z[N + i]));
                self.hand
                    .rates(&x, &p)
                    .into_iter()
                    .map(Number::value)
                    .collect()
            };
            // What each input alone contributes: rates of such small inputs are linear, L
            // quadratic.
            let mut size = vec![0.0; width];
            for j in 0..2 * N {
                let mut alone = vec![0.0; 2 * N];
                alone[j] = z[j];
                size.iter_mut()
                    .zip(exact(&alone))
                    .for_each(|(s, r)| *s += r.abs());
            }
            let derived = self.program.eval(z);
            for (i, exact) in exact(z).into_iter().enumerate() {
                let rates = [derived[i], lanes[k * width + i], short[k * width + i]];
                for ((rate, eps), worst) in rates
                    .into_iter()
                    .zip([f64::EPSILON, f64::EPSILON, f64::from(f32::EPSILON)])
                    .zip(&mut worst)
                {
                    let units = (rate - exact).abs() / (eps * size[i]);
                    *worst = worst.max(units);
                    assert!(
                        units <= self.roundings(1.0),
                        "{}: rate {i} near the equilibrium is {rate:e}, exactly {exact:e}",
                        self.name
                    );
                }
            }
        }
        println!(
            "{}: worst near the equilibrium, in eps: eval {:.1}, lanes {:.1}, f32 {:.1}",
            self.name, worst[0], worst[1], worst[2]
        );
    }

    fn all(&self) {
        self.everywhere();
        self.differences();
        self.near_the_equilibrium();
    }
}

#[test]
fn pendulum() {
    Case::new("pendulum", &[], Pendulum, [100.0, 50.0]).all();
}

#[test]
fn compressor_with_limited_throttle() {
    // |v| = |p_gamma| / 2 is above 0.1 for four fifths of these.
    for (c, set) in [(0.0, "0"), (1.0, "1"), (5.0, "5")] {
        let hand = Limited(Compressor { c }, 0.1);
        Case::new("moore_greitzer", &[("c", set)], hand, [1.0, 1.0, 1.0, 1.0]).all();
    }
    let fast = Limited(Compressor { c: 0.0 }, 0.4);
    Case::new(
        "moore_greitzer",
        &[("v_max", "0.4")],
        fast,
        [1.0, 1.0, 1.0, 1.0],
    )
    .all();
}

#[test]
fn compressor_with_free_throttle() {
    for (c, set) in [(0.0, "0"), (5.0, "5")] {
        Case::new(
            "moore_greitzer_unconstrained",
            &[("c", set)],
            Free(Compressor { c }),
            [1.0, 1.0, 1.0],
        )
        .all();
    }
}

/// The comparison is not blind: a slope wrong in the eleventh digit is seen in f64.
#[test]
fn the_comparison_notices_a_small_error() {
    let case = Case::new("pendulum", &[], Pendulum, [100.0, 50.0]);
    let z = case.draw(&mut Random::new(3));
    let (x, p) = case.point::<Sized>(&z);
    let hand = case.hand.rates(&x, &p)[2];
    let wrong = case.program.eval(&z)[2] * (1.0 + 1e-11);
    assert!((wrong - hand.v).abs() > case.roundings(f64::EPSILON) * hand.size);
}

#[test]
fn double_numbers_have_thirty_digits() {
    const DIGITS: f64 = 1e-30;
    let third = Double::of(1.0) / Double::of(3.0);
    assert!((third + third + third - Double::of(1.0)).value().abs() < DIGITS);
    let x = Double::of(-1.5) + third * Double::of(1e-8);
    assert!(
        (x.sin().square() + x.cos().square() - Double::of(1.0))
            .value()
            .abs()
            < DIGITS
    );
    assert!(
        (Double::of(2.0).sqrt().square() - Double::of(2.0))
            .value()
            .abs()
            < DIGITS
    );
}
