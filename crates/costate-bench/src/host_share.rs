//! How much of a whole sweep's time is not the kernel's: seeds, fronts, transfers, writing.

use costate::backend::{Backend, BackendError, Eliminator, Kernel, Run, Spec, Trajectories};
use costate::low_level::model::{Method, Precision};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

/// Times within a backend (s).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Meter {
    /// In calls that integrate, transfers included.
    pub calls: f64,
    /// In kernels alone; what a backend does not know counts as its call.
    pub kernels: f64,
    pub compiling: f64,
}

/// A sweep from its plan to the finished file.
#[derive(Clone, Debug, PartialEq)]
pub struct HostShare {
    /// Index into the list of backends.
    pub device: usize,
    pub precision: Precision,
    pub trajectories: usize,
    /// All of it (s).
    pub wall_seconds: f64,
    /// The same sweep before, with nothing written (s): the two overlap.
    pub sweep_seconds: f64,
    /// In calls that write, and flushing the finished file to the disk (s).
    pub writing_seconds: f64,
    pub finishing_seconds: f64,
    pub times: Meter,
    /// Bytes of the file.
    pub bytes: u64,
}

impl HostShare {
    /// Share of the time that is not a kernel's.
    pub fn share(&self) -> f64 {
        1.0 - self.times.kernels / self.wall_seconds
    }
}

/// A backend that reads the clock.
pub struct Metered<'a> {
    inner: &'a dyn Backend,
    times: Arc<Mutex<Meter>>,
}

impl<'a> Metered<'a> {
    pub fn new(inner: &'a dyn Backend) -> Self {
        Self {
            inner,
            times: Arc::default(),
        }
    }

    pub fn times(&self) -> Meter {
        *self.times.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Backend for Metered<'_> {
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
    fn favours(&self, method: Method) -> bool {
        self.inner.favours(method)
    }
    fn compile(&self, spec: &Spec) -> Result<Box<dyn Kernel>, BackendError> {
        let begin = Instant::now();
        let kernel = self.inner.compile(spec)?;
        self.times
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .compiling += begin.elapsed().as_secs_f64();
        Ok(Box::new(MeteredKernel {
            kernel,
            times: Arc::clone(&self.times),
        }))
    }
    fn eliminator(
        &self,
        states: usize,
        precision: Precision,
    ) -> Result<Option<Box<dyn Eliminator>>, BackendError> {
        self.inner.eliminator(states, precision)
    }
    fn peak(&self, precision: Precision) -> Result<Option<f64>, BackendError> {
        self.inner.peak(precision)
    }
}

struct MeteredKernel {
    kernel: Box<dyn Kernel>,
    times: Arc<Mutex<Meter>>,
}

impl Kernel for MeteredKernel {
    fn integrate_into(
        &mut self,
        run: &Run,
        seeds: &[f64],
        to: &mut Trajectories,
    ) -> Result<(), BackendError> {
        let begin = Instant::now();
        self.kernel.integrate_into(run, seeds, to)?;
        let call = begin.elapsed().as_secs_f64();
        let mut times = self.times.lock().unwrap_or_else(PoisonError::into_inner);
        times.calls += call;
        times.kernels += self.kernel.kernel_seconds().unwrap_or(call);
        Ok(())
    }

    fn preferred_batch(&self) -> usize {
        self.kernel.preferred_batch()
    }

    fn kernel_seconds(&self) -> Option<f64> {
        self.kernel.kernel_seconds()
    }
}
