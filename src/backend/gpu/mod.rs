//! The GPU backend: WGSL compute shaders through wgpu, one invocation a trajectory.
//!
//! A kernel's module is joined from `shaders/real.wgsl` (elementary functions),
//! `shaders/block.wgsl` (the integrator), `shaders/sweep.wgsl` (whole trajectories) or
//! `shaders/legs.wgsl` (legs whose law a map in pieces gives) and generated text (constants, the
//! model, the method's stages). `shaders/elimination.wgsl` eliminates the linear equations of
//! multiple shooting, one invocation a path; `shaders/newton_segments.wgsl` and
//! `shaders/newton_paths.wgsl` make whole iterations of Newton's method of both.

pub(crate) mod adapter;
mod clock;
mod elimination;
pub(crate) mod emit;
mod kernel;
pub(crate) mod memory;
mod newton;
mod peak;
mod recorded;
mod relay;
mod results;
pub(crate) mod shader;
#[cfg(test)]
mod tests;
pub(crate) mod text;

pub use super::adapters::{AdapterInfo, Selection};
pub(super) use adapter::adapters;

use super::{Backend, BackendError, Eliminator, Kernel, Newton, NewtonSpec, Spec};
use crate::model::{Method, Precision};
use adapter::Device;
use std::sync::Arc;

/// Counters' status of a trajectory on its way, of one whose step has an event, and of one that no
/// invocation has touched.
const RUNNING: u32 = u32::MAX - 1;
const EVENT: u32 = u32::MAX - 2;
const UNWRITTEN: u32 = u32::MAX;
/// Of legs whose law a chart gives: about to ask for it, about to begin with one that is given,
/// without an answer, and at the end of what the flight has room for.
const ASK: u32 = u32::MAX - 3;
const GIVEN: u32 = u32::MAX - 4;
const LOST: u32 = u32::MAX - 5;
const PAUSED: u32 = u32::MAX - 6;
const ON_LEGS: [(&str, u32); 4] = [
    ("ASK", ASK),
    ("GIVEN", GIVEN),
    ("LOST", LOST),
    ("PAUSED", PAUSED),
];

/// The GPU backend: an open device.
#[derive(Clone, Debug)]
pub struct Gpu {
    device: Arc<Device>,
}

impl Gpu {
    /// Opens an adapter; `None` where hardware was asked for and there is none.
    ///
    /// # Errors
    /// When no adapter fits the selection, or its device cannot be had.
    pub fn open(selection: &Selection) -> Result<Option<Self>, BackendError> {
        Ok(Device::open(selection)?.map(|device| Self {
            device: Arc::new(device),
        }))
    }

    pub(crate) fn require(&self, precision: Precision) -> Result<(), BackendError> {
        if self.device.supports(precision) {
            return Ok(());
        }
        Err(BackendError::NoF64 {
            adapter: self.device.info.name.clone(),
        })
    }

    /// The open device.
    pub(crate) fn device(&self) -> Arc<Device> {
        Arc::clone(&self.device)
    }

    /// The adapter behind the device.
    pub fn info(&self) -> &AdapterInfo {
        &self.device.info
    }
}

/// Operations of one right-hand side that are given to a shader compiler.
const MOST_OPERATIONS: usize = 12_000;
/// Operations up to which more variation columns in a kernel are worth their compilation.
const LONGEST: usize = 3_000;

impl Backend for Gpu {
    fn name(&self) -> &'static str {
        "gpu"
    }

    fn adapter(&self) -> String {
        self.device.info.to_string()
    }

    fn gpu(&self) -> Option<&Gpu> {
        Some(self)
    }

    fn asks_surfaces(&self) -> bool {
        true
    }

    fn supports(&self, precision: Precision) -> bool {
        self.device.supports(precision)
    }

    fn offers(&self, _: Method) -> bool {
        true
    }

    /// Taylor steps were not measured on a card: registers may be too few for them.
    fn favours(&self, method: Method) -> bool {
        method != Method::Taylor
    }

    fn longest(&self) -> usize {
        LONGEST
    }

    fn compile(&self, spec: &Spec) -> Result<Box<dyn Kernel>, BackendError> {
        self.require(spec.precision)?;
        // Shader compilers recurse over long straight-line code, and take minutes over it.
        let operations = spec.rate.operations() + spec.kinks.as_ref().map_or(0, |k| k.operations());
        if operations > MOST_OPERATIONS {
            return Err(BackendError::TooLong {
                operations,
                limit: MOST_OPERATIONS,
            });
        }
        Ok(Box::new(kernel::GpuKernel::new(
            Arc::clone(&self.device),
            spec.clone(),
        )?))
    }

    fn eliminator(
        &self,
        states: usize,
        precision: Precision,
    ) -> Result<Option<Box<dyn Eliminator>>, BackendError> {
        self.require(precision)?;
        let made = elimination::GpuEliminator::new(Arc::clone(&self.device), states, precision)?;
        Ok(made.map(|e| -> Box<dyn Eliminator> { Box::new(e) }))
    }

    fn newton(&self, spec: &NewtonSpec) -> Result<Option<Box<dyn Newton>>, BackendError> {
        self.require(spec.varied.precision)?;
        let made = newton::GpuNewton::new(Arc::clone(&self.device), spec)?;
        Ok(made.map(|n| -> Box<dyn Newton> { Box::new(n) }))
    }

    fn peak(&self, precision: Precision) -> Result<Option<f64>, BackendError> {
        self.require(precision)?;
        peak::peak(&self.device, precision).map(Some)
    }
}
