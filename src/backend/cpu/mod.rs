//! The CPU backend: rayon over chunks of trajectories, SIMD lanes within a chunk, the instruction
//! set chosen at run time.

pub(crate) mod arithmetic;
mod block;
pub(crate) mod code;
mod decide;
mod evaluator;
mod jit;
pub(crate) mod lanes;
mod peak;
pub(crate) mod real;
mod routine;
pub(crate) mod steps;
mod taylor;

pub use evaluator::Evaluator;

use super::{Backend, BackendError, Kernel, Legs, Run, Spec, Trajectories, Variant};
use crate::model::Precision;
use block::{Compiled, Output};
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

/// Instruction sets the lanes are compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Simd {
    Baseline,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(not(target_arch = "x86_64"))]
    Neon,
}

impl Simd {
    /// All sets, the widest last, whether this machine has them or not.
    pub const ALL: &[Simd] = &[
        Simd::Baseline,
        #[cfg(target_arch = "x86_64")]
        Simd::Avx2,
        #[cfg(target_arch = "x86_64")]
        Simd::Avx512,
        #[cfg(not(target_arch = "x86_64"))]
        Simd::Neon,
    ];

    /// The widest set this machine has.
    pub fn detect() -> Self {
        let mut widest_first = Self::ALL.iter().rev().copied();
        widest_first
            .find(|simd| simd.is_here())
            .unwrap_or(Simd::Baseline)
    }

    /// Whether this machine has it.
    pub fn is_here(self) -> bool {
        match self {
            Simd::Baseline => true,
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => jit::Set::Avx2.is_here(),
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => jit::Set::Avx512.is_here(),
            #[cfg(not(target_arch = "x86_64"))]
            Simd::Neon => jit::Set::Neon.is_here(),
        }
    }

    pub fn name(self) -> &'static str {
        match self {
            Simd::Baseline => "baseline SIMD",
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => "AVX2",
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => "AVX-512",
            #[cfg(not(target_arch = "x86_64"))]
            Simd::Neon => "NEON",
        }
    }
}

/// Lanes a block: compiled code needs a few vectors' worth, with the working set in the first-level
/// cache; an interpreter needs more of them, to pay for decoding.
const LANES_F64: usize = 16;
const LANES_F32: usize = 32;
const LANES_INTERPRETED: usize = 64;
/// Trajectories a thread in a batch from which on lanes that have run dry at its end cost little.
const BATCH: usize = 1024;

/// The CPU backend.
#[derive(Clone, Debug)]
pub struct Cpu {
    simd: Simd,
    /// Whether equations become machine code.
    compile: bool,
    /// Whether some were interpreted all the same, since their code would be too long.
    too_long: Arc<AtomicBool>,
}

impl Cpu {
    pub fn new() -> Self {
        let simd = Simd::detect();
        Self::compiling(simd).unwrap_or(Self {
            simd,
            compile: false,
            too_long: Arc::default(),
        })
    }

    /// A backend restricted to an instruction set the machine has, which interprets the equations;
    /// `None` where the machine has not.
    pub fn interpreting(simd: Simd) -> Option<Self> {
        simd.is_here().then_some(Self {
            simd,
            compile: false,
            too_long: Arc::default(),
        })
    }

    /// A backend restricted to an instruction set, for which it compiles the equations; `None` where
    /// the machine has not, or lets no process make code.
    pub fn compiling(simd: Simd) -> Option<Self> {
        let works = simd != Simd::Baseline && simd.is_here() && jit_works();
        works.then_some(Self {
            simd,
            compile: true,
            too_long: Arc::default(),
        })
    }

    /// Lanes a block.
    fn lanes(&self, precision: Precision) -> usize {
        match precision {
            _ if !self.compile => LANES_INTERPRETED,
            Precision::F64 => LANES_F64,
            Precision::F32 => LANES_F32,
        }
    }
}

/// Whether machine code can be made and run here.
fn jit_works() -> bool {
    static WORKS: std::sync::LazyLock<bool> = std::sync::LazyLock::new(jit::works);
    *WORKS
}

impl Default for Cpu {
    fn default() -> Self {
        Self::new()
    }
}

impl Backend for Cpu {
    fn name(&self) -> &'static str {
        "cpu"
    }

    fn adapter(&self) -> String {
        let threads = rayon::current_num_threads();
        if !self.compile {
            return format!("CPU, {threads} threads, {}, interpreted", self.simd.name());
        }
        let partly = match self.too_long.load(Ordering::Relaxed) {
            true => ", some equations too long for that and interpreted",
            false => "",
        };
        let simd = self.simd.name();
        format!("CPU, {threads} threads, {simd}, compiled{partly}")
    }

    fn supports(&self, _: Precision) -> bool {
        true
    }

    fn offers(&self, _: crate::model::Method) -> bool {
        true
    }

    fn compile(&self, spec: &Spec) -> Result<Box<dyn Kernel>, BackendError> {
        Ok(Box::new(CpuKernel {
            spec: spec.clone(),
            backend: self.clone(),
            compiled: Arc::default(),
            seconds: None,
        }))
    }

    fn peak(&self, precision: Precision) -> Result<Option<f64>, BackendError> {
        Ok(Some(peak::peak(self.simd, precision)))
    }
}

/// Code by lanes, degree of steps and variant, made when first needed.
type Code = Mutex<FxHashMap<(usize, usize, Variant), Arc<Compiled>>>;

struct CpuKernel {
    spec: Spec,
    backend: Cpu,
    compiled: Arc<Code>,
    /// Of the latest batch, on the lanes.
    seconds: Option<f64>,
}

impl CpuKernel {
    fn compiled(&self, width: usize, run: &Run) -> Arc<Compiled> {
        let scheme = self.spec.method.scheme(run.rtol);
        let variant = run.variant();
        let (spec, compile) = (
            &self.spec,
            self.backend.compile.then_some(self.backend.simd),
        );
        let too_long = &self.backend.too_long;
        let mut all = self.compiled.lock().unwrap_or_else(PoisonError::into_inner);
        let code = (all.entry((width, scheme.degree(), variant))).or_insert_with(|| {
            let made = Compiled::new(spec, scheme, variant, compile, width);
            if compile.is_some() && !made.is_compiled() {
                too_long.store(true, Ordering::Relaxed);
            }
            Arc::new(made)
        });
        Arc::clone(code)
    }
}

impl Kernel for CpuKernel {
    fn legs<'k>(&'k mut self, run: &'k Run) -> Option<Box<dyn Legs + 'k>> {
        if self.spec.store {
            return None;
        }
        let backend = self.backend.clone();
        let compiled = self.compiled(backend.lanes(self.spec.precision), run);
        Some(Box::new(CpuLegs {
            compiled,
            run,
            backend,
        }))
    }

    fn kernel_seconds(&self) -> Option<f64> {
        self.seconds
    }

    fn code_bytes(&self) -> Option<usize> {
        let all = self.compiled.lock().unwrap_or_else(PoisonError::into_inner);
        Some(all.values().map(|code| code.bytes()).sum()).filter(|bytes| *bytes > 0)
    }

    fn fork(&self) -> Option<Box<dyn Kernel>> {
        Some(Box::new(CpuKernel {
            spec: self.spec.clone(),
            backend: self.backend.clone(),
            compiled: Arc::clone(&self.compiled),
            seconds: None,
        }))
    }

    fn preferred_batch(&self) -> usize {
        BATCH * rayon::current_num_threads()
    }

    fn integrate_into(
        &mut self,
        run: &Run,
        seeds: &[f64],
        to: &mut Trajectories,
    ) -> Result<(), BackendError> {
        let dim = self.spec.dim();
        let count = seeds.len() / dim;
        let levels = if self.spec.store { run.levels.len() } else { 0 };
        to.shape(count, dim, levels);
        if count == 0 {
            return Ok(());
        }
        let precision = self.spec.precision;
        let lanes = self.backend.lanes(precision);
        let backend = self.backend.clone();
        let compiled = self.compiled(lanes, run);
        // Chunks small enough to balance the load, large enough that draining lanes at their ends
        // costs little.
        let chunk = (count / (rayon::current_num_threads() * 4)).clamp(lanes, 8192);
        let width = levels * (1 + dim);
        // Without stored samples there is nothing to split; one chunk of an empty slice a task.
        let mut sample_chunks: Vec<&mut [f64]> = if width == 0 {
            (0..count.div_ceil(chunk)).map(|_| &mut [][..]).collect()
        } else {
            to.samples.chunks_mut(chunk * width).collect()
        };
        let begin = Instant::now();
        let lane_steps = AtomicU64::new(0);
        seeds
            .par_chunks(chunk * dim)
            .zip(to.end.par_chunks_mut(chunk * dim))
            .zip(to.end_time.par_chunks_mut(chunk))
            .zip(to.status.par_chunks_mut(chunk))
            .zip(to.steps.par_chunks_mut(chunk))
            .zip(to.rejected.par_chunks_mut(chunk))
            .zip(sample_chunks.par_iter_mut())
            .for_each(
                |((((((seeds, end), end_time), status), steps), rejected), samples)| {
                    let mut out = Output {
                        end,
                        end_time,
                        status,
                        steps,
                        rejected,
                        samples,
                    };
                    let job = Job {
                        kernel: &compiled,
                        run,
                        seeds,
                    };
                    let rounds = job.fly(precision, &backend, &mut out);
                    lane_steps.fetch_add(rounds * lanes as u64, Ordering::Relaxed);
                },
            );
        to.lane_steps = lane_steps.into_inner();
        self.seconds = Some(begin.elapsed().as_secs_f64());
        Ok(())
    }
}

/// A kernel's code with a run.
struct CpuLegs<'k> {
    compiled: Arc<Compiled>,
    run: &'k Run,
    backend: Cpu,
}

impl Legs for CpuLegs<'_> {
    fn integrate(&self, seeds: &[f64], to: &mut Trajectories) {
        let dim = self.compiled.spec.dim();
        let count = seeds.len() / dim;
        to.shape(count, dim, 0);
        let mut out = Output {
            end: &mut to.end,
            end_time: &mut to.end_time,
            status: &mut to.status,
            steps: &mut to.steps,
            rejected: &mut to.rejected,
            samples: &mut [],
        };
        let job = Job {
            kernel: &self.compiled,
            run: self.run,
            seeds,
        };
        let precision = self.compiled.spec.precision;
        let rounds = job.fly(precision, &self.backend, &mut out);
        to.lane_steps = rounds * self.backend.lanes(precision) as u64;
    }
}

/// One chunk of trajectories.
struct Job<'a> {
    kernel: &'a Compiled,
    run: &'a Run,
    seeds: &'a [f64],
}

impl Job<'_> {
    /// How many steps the block took.
    fn fly(
        &self,
        precision: Precision,
        &Cpu { simd, compile, .. }: &Cpu,
        out: &mut Output<'_>,
    ) -> u64 {
        match (precision, compile) {
            (Precision::F64, true) => self.dispatch::<f64, LANES_F64>(simd, out),
            (Precision::F32, true) => self.dispatch::<f32, LANES_F32>(simd, out),
            (Precision::F64, false) => self.dispatch::<f64, LANES_INTERPRETED>(simd, out),
            (Precision::F32, false) => self.dispatch::<f32, LANES_INTERPRETED>(simd, out),
        }
    }

    /// The same for lanes of one type and number.
    fn dispatch<T: real::Real, const W: usize>(&self, simd: Simd, out: &mut Output<'_>) -> u64 {
        match simd {
            Simd::Baseline => self.integrate::<T, W, false>(out),
            // SAFETY: the features were detected when the backend was made.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => unsafe { avx2::<T, W>(self, out) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => unsafe { avx512::<T, W>(self, out) },
            #[cfg(not(target_arch = "x86_64"))]
            Simd::Neon => self.integrate::<T, W, true>(out),
        }
    }

    #[inline(always)]
    fn integrate<T: real::Real, const W: usize, const FMA: bool>(
        &self,
        out: &mut Output<'_>,
    ) -> u64 {
        block::integrate::<T, W, FMA>(self.kernel, self.run, self.seeds, out)
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2<T: real::Real, const W: usize>(job: &Job<'_>, out: &mut Output<'_>) -> u64 {
    job.integrate::<T, W, true>(out)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
fn avx512<T: real::Real, const W: usize>(job: &Job<'_>, out: &mut Output<'_>) -> u64 {
    job.integrate::<T, W, true>(out)
}

/// Stack of a thread that computes: what a main thread has, twice.
const STACK: usize = 16 << 20;

/// Does some work on a thread of the pool that computes. From another thread every parallel loop
/// wakes the pool, and what waits for it sleeps: of many short loops that is a third of the time.
pub fn in_pool<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    // It may be there already.
    let _ = rayon::ThreadPoolBuilder::new()
        .stack_size(STACK)
        .build_global();
    rayon::scope(|_| work())
}
