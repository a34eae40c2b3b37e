//! The GPU adapters of the machine. What is built without the feature `gpu` finds none, and says
//! why where one is asked for.

#[cfg(feature = "gpu")]
use super::gpu;
use super::{Backend, BackendError};

/// A GPU adapter as `costate adapters` shows it.
#[derive(Clone, Debug)]
pub struct AdapterInfo {
    pub name: String,
    /// Vulkan, Metal, Dx12 or Gl.
    pub api: String,
    /// The driver and its version, as far as it tells.
    pub driver: String,
    /// False for a software adapter such as llvmpipe.
    pub hardware: bool,
    /// Discrete, integrated, virtual, software or unknown.
    pub kind: &'static str,
    pub f64_arithmetic: bool,
    /// Largest storage buffer binding and largest buffer, bytes.
    pub max_binding: u64,
    pub max_buffer: u64,
}

/// As [`Backend::adapter`] names it.
impl std::fmt::Display for AdapterInfo {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} ({}, {})", self.name, self.api, self.kind)
    }
}

/// Which adapter to open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Selection {
    /// The best hardware adapter.
    Hardware,
    /// The best adapter, a software one where there is no other.
    Any,
    /// The one of this number in the list of [`adapters`], from 0; or the best one whose name contains
    /// this, whatever the case.
    Named(String),
}

/// All adapters, the best first.
#[must_use]
pub fn adapters() -> Vec<AdapterInfo> {
    #[cfg(feature = "gpu")]
    return gpu::adapters();
    #[cfg(not(feature = "gpu"))]
    return Vec::new();
}

/// Why there is no adapter, where [`adapters`] finds none.
#[must_use]
pub fn no_adapter() -> BackendError {
    match cfg!(feature = "gpu") {
        true => BackendError::NoAdapter,
        false => BackendError::NotBuilt,
    }
}

/// Opens an adapter; `None` where hardware was asked for and there is none.
///
/// # Errors
/// When no adapter fits the selection, or its device cannot be had.
pub fn open(selection: &Selection) -> Result<Option<Box<dyn Backend>>, BackendError> {
    #[cfg(feature = "gpu")]
    return Ok(gpu::Gpu::open(selection)?.map(|gpu| Box::new(gpu) as Box<dyn Backend>));
    #[cfg(not(feature = "gpu"))]
    return match selection {
        Selection::Hardware => Ok(None),
        Selection::Any | Selection::Named(_) => Err(no_adapter()),
    };
}
