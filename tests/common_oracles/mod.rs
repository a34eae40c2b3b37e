//! What the oracle tests share: scenes, sweeps on the CPU with everything they compute kept,
//! deterministic points.
#![allow(dead_code, reason = "each test file uses its part")]

pub mod numbers;

pub use crate::common_problems::parameter;

use costate::backend::{Backend, BackendError, Kernel, Run, Spec, Trajectories, cpu::Cpu};
use costate::low_level::hamiltonian::Hamiltonian;
use costate::low_level::model::{Method, Model, Precision};
use costate::low_level::sweep::{Choices, Plan, SweepReport, sweep};
use costate::low_level::trajectories::TrajectoryBlock;
use costate::low_level::value;
use std::path::Path;
use std::sync::{Arc, Mutex};

/// A shipped scene, with parameters set as by `--set`.
pub fn scene(name: &str, set: &[(&str, &str)]) -> Model {
    let path = Path::new(crate::ROOT)
        .join("scenarios")
        .join(name)
        .with_extension("toml");
    let set: Vec<_> = set
        .iter()
        .map(|(n, v)| ((*n).to_owned(), (*v).to_owned()))
        .collect();
    costate::low_level::scenario::load(&path, &set).unwrap_or_else(|e| panic!("{e}"))
}

/// A scene given as text.
pub fn parse(text: &str) -> Model {
    costate::low_level::scenario::parse(text, "test.toml", &[])
        .unwrap_or_else(|e| panic!("{}", e.render(false)))
}

/// A plan as single states are solved with where they need no sweep.
pub fn unswept(model: &Model) -> Plan {
    let choices = value::for_guesses(Choices::default(), model.states.len(), 0);
    Plan::new(model, &derive(model), &Cpu::new(), choices).expect("a plan")
}

pub fn derive(model: &Model) -> Hamiltonian {
    Hamiltonian::derive(model).unwrap_or_else(|problems| panic!("{problems:?}"))
}

/// What the accuracy of a run is asked as.
#[derive(Clone, Copy, Debug)]
pub struct Asked {
    pub precision: Precision,
    pub rtol: f64,
}

pub const F64: Asked = Asked {
    precision: Precision::F64,
    rtol: 1e-9,
};
pub const F32: Asked = Asked {
    precision: Precision::F32,
    rtol: 1e-6,
};

impl Asked {
    pub fn choices(self) -> Choices {
        Choices {
            precision: Some(self.precision),
            rtol: Some(self.rtol),
            ..Choices::default()
        }
    }

    /// Largest error that the project promises for this setting, relative to max(1, V) or to V.
    pub fn promised(self) -> f64 {
        match self.precision {
            Precision::F64 => 1e-8,
            Precision::F32 => 1e-4,
        }
    }
}

/// Batches of one kernel with their seeds.
type Calls = Arc<Mutex<Vec<(Vec<f64>, Trajectories)>>>;

/// A backend, with seeds and results of all batches kept.
struct Recorder {
    inner: Box<dyn Backend>,
    calls: Calls,
}

struct RecordingKernel {
    kernel: Box<dyn Kernel>,
    calls: Calls,
}

impl Backend for Recorder {
    fn name(&self) -> &'static str {
        self.inner.name()
    }
    fn adapter(&self) -> String {
        self.inner.adapter()
    }
    fn supports(&self, precision: Precision) -> bool {
        self.inner.supports(precision)
    }
    fn offers(&self, method: Method) -> bool {
        self.inner.offers(method)
    }

    fn compile(&self, spec: &Spec) -> Result<Box<dyn Kernel>, BackendError> {
        Ok(Box::new(RecordingKernel {
            kernel: self.inner.compile(spec)?,
            calls: self.calls.clone(),
        }))
    }
}

impl Kernel for RecordingKernel {
    fn integrate_into(
        &mut self,
        run: &Run,
        seeds: &[f64],
        to: &mut Trajectories,
    ) -> Result<(), BackendError> {
        self.kernel.integrate_into(run, seeds, to)?;
        self.calls
            .lock()
            .expect("no test thread panics with the lock")
            .push((seeds.to_vec(), to.clone()));
        Ok(())
    }

    fn preferred_batch(&self) -> usize {
        self.kernel.preferred_batch()
    }
}

/// A finished sweep.
pub struct Sweep {
    pub plan: Plan,
    pub report: SweepReport,
    /// `[trajectory][dim]`: `(s, p, V)` of all seeds.
    pub seeds: Vec<f64>,
    /// As integrated: deviations.
    pub raw: Trajectories,
    /// As stored.
    pub stored: TrajectoryBlock,
    pub n: usize,
    pub controls: usize,
}

/// One stored sample.
pub struct Sample<'a> {
    pub trajectory: usize,
    pub t: f64,
    pub x: &'a [f64],
    pub p: &'a [f64],
    pub u: &'a [f64],
    pub v: f64,
    pub h: f64,
}

impl Sweep {
    /// On the CPU.
    pub fn of(model: &Model, asked: Asked) -> Self {
        Self::on(Box::new(Cpu::new()), model, asked)
    }

    pub fn on(backend: Box<dyn Backend>, model: &Model, asked: Asked) -> Self {
        let hamiltonian = derive(model);
        let backend = Recorder {
            inner: backend,
            calls: Calls::default(),
        };
        let plan = Plan::new(model, &hamiltonian, &backend, asked.choices())
            .unwrap_or_else(|e| panic!("{e}"));
        let mut stored = TrajectoryBlock::default();
        let report = sweep(
            &plan,
            &backend,
            &mut |_, _| {},
            &mut |b: &TrajectoryBlock| -> Result<(), BackendError> {
                stored.count += b.count;
                stored.t.extend_from_slice(&b.t);
                stored.x.extend_from_slice(&b.x);
                stored.p.extend_from_slice(&b.p);
                stored.u.extend_from_slice(&b.u);
                stored.w.extend_from_slice(&b.w);
                stored.v.extend_from_slice(&b.v);
                stored.h.extend_from_slice(&b.h);
                stored.status.extend_from_slice(&b.status);
                stored.sheet.extend_from_slice(&b.sheet);
                stored.steps.extend_from_slice(&b.steps);
                stored.rejected.extend_from_slice(&b.rejected);
                stored
                    .hamiltonian_drift
                    .extend_from_slice(&b.hamiltonian_drift);
                Ok(())
            },
        );
        let report = report.unwrap_or_else(|e| panic!("{e}"));
        let mut seeds = Vec::new();
        let mut raw = Trajectories::default();
        for (s, r) in backend.calls.lock().expect("no thread is left").drain(..) {
            seeds.extend(s);
            raw.dim = r.dim;
            raw.levels = r.levels;
            raw.end.extend(r.end);
            raw.end_time.extend(r.end_time);
            raw.status.extend(r.status);
            raw.steps.extend(r.steps);
            raw.rejected.extend(r.rejected);
            raw.samples.extend(r.samples);
        }
        assert_eq!(raw.count(), stored.count, "everything integrated is stored");
        Self {
            n: model.states.len(),
            controls: model.controls.len(),
            plan,
            report,
            seeds,
            raw,
            stored,
        }
    }

    pub fn count(&self) -> usize {
        self.stored.count
    }

    pub fn levels(&self) -> usize {
        self.raw.levels
    }

    /// The stored samples that exist, as stored: per trajectory in order of rising t.
    pub fn samples(&self) -> impl Iterator<Item = Sample<'_>> {
        let (n, m, levels) = (self.n, self.controls, self.levels());
        (0..self.count() * levels)
            .filter(|i| !self.stored.t[*i].is_nan())
            .map(move |i| Sample {
                trajectory: i / levels,
                t: self.stored.t[i],
                x: &self.stored.x[i * n..(i + 1) * n],
                p: &self.stored.p[i * n..(i + 1) * n],
                u: &self.stored.u[i * m..(i + 1) * m],
                v: self.stored.v[i],
                h: self.stored.h[i],
            })
    }

    /// The same seeds again, in f64 with a given tolerance (and absolute tolerances in proportion).
    pub fn again(&self, rtol: f64) -> Trajectories {
        let mut spec = self.plan.spec.clone();
        spec.precision = Precision::F64;
        spec.method = Method::Tsit5;
        let mut run = self.plan.run.clone();
        // Scenes ask for atol = 1e-9 beside rtol = 1e-6 unless they say otherwise.
        run.atol.iter_mut().for_each(|a| *a *= rtol / 1e-6);
        run.rtol = rtol;
        run.max_steps = 1_000_000;
        let mut kernel = Cpu::new().compile(&spec).unwrap_or_else(|e| panic!("{e}"));
        kernel
            .integrate(&run, &self.seeds)
            .unwrap_or_else(|e| panic!("{e}"))
    }
}

/// Pseudo-random numbers, the same in every run (SplitMix64).
pub struct Random(u64);

impl Random {
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in `[lo, hi)`.
    pub fn within(&mut self, lo: f64, hi: f64) -> f64 {
        lo + (hi - lo) * (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Uniform in a box.
    pub fn point(&mut self, bounds: &[[f64; 2]]) -> Vec<f64> {
        bounds
            .iter()
            .map(|[lo, hi]| self.within(*lo, *hi))
            .collect()
    }

    /// About normal (a sum of uniforms), for directions.
    pub fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.within(0.0, 1.0)).sum::<f64>() - 6.0
    }
}

pub fn norm(x: &[f64]) -> f64 {
    x.iter().map(|x| x * x).sum::<f64>().sqrt()
}

pub fn dot(x: &[f64], y: &[f64]) -> f64 {
    x.iter().zip(y).map(|(x, y)| x * y).sum()
}

pub fn minus(x: &[f64], y: &[f64]) -> Vec<f64> {
    x.iter().zip(y).map(|(x, y)| x - y).collect()
}

/// Keeps the largest value seen (0 or more), whether a NaN was, and how many were seen.
#[derive(Clone, Copy, Debug, Default)]
pub struct Worst {
    pub worst: f64,
    pub seen: usize,
}

impl Worst {
    pub fn see(&mut self, value: f64) {
        self.seen += 1;
        // NaN stays once it is there.
        if value > self.worst || value.is_nan() {
            self.worst = value;
        }
    }

    /// Fails unless at least one value was seen and none above the bound.
    pub fn at_most(self, bound: f64, what: &str) {
        let Self { worst, seen } = self;
        println!("{what}: worst {worst:.2e} of {seen}, bound {bound:.0e}");
        assert!(seen > 0, "{what}: nothing was compared");
        assert!(
            worst <= bound,
            "{what}: worst {worst:.3e} is above {bound:.1e}"
        );
    }
}

impl Sweep {
    /// The trajectories of a scene of two states in order round the curve: that of their angle
    /// about the equilibrium on the first front, which is near enough to it to be seen from there.
    pub fn round_the_curve(&self) -> Vec<usize> {
        let angle = |i: &usize| {
            let sample = self.raw.sample(*i, 0);
            (sample[2] / self.plan.widths[1]).atan2(sample[1] / self.plan.widths[0])
        };
        let mut order: Vec<usize> = (0..self.count()).collect();
        assert!(
            self.n == 2 && order.iter().all(|i| angle(i).is_finite()),
            "all trajectories reach the first front"
        );
        order.sort_by(|a, b| angle(a).total_cmp(&angle(b)));
        order
    }
}
