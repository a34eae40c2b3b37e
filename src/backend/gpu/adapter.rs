//! Finding adapters and opening a device on one.

use crate::backend::BackendError;
use crate::backend::adapters::{AdapterInfo, Selection};
use crate::model::Precision;
use std::sync::{Arc, Mutex, PoisonError};
use wgpu::{Backend as Api, Backends, DeviceType};

/// What f64 kernels need: 64-bit integers too, to take numbers apart.
const F64: wgpu::Features = wgpu::Features::SHADER_F64.union(wgpu::Features::SHADER_INT64);

/// All adapters, the best first.
pub(crate) fn adapters() -> Vec<AdapterInfo> {
    enumerate(Backends::all()).iter().map(describe).collect()
}

fn enumerate(backends: Backends) -> Vec<wgpu::Adapter> {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    descriptor.backends = backends;
    descriptor.flags = wgpu::InstanceFlags::empty();
    let mut list = pollster::block_on(wgpu::Instance::new(descriptor).enumerate_adapters(backends));
    // Beside another API OpenGL is the same device over again, and it may be offered in a version
    // without compute shaders (NVIDIA's is), which no flag tells.
    let is_gl = |a: &wgpu::Adapter| a.get_info().backend == Api::Gl;
    if list.iter().any(|a| !is_gl(a)) {
        list.retain(|a| !is_gl(a));
    }
    list.sort_by_key(rank);
    list
}

fn describe(adapter: &wgpu::Adapter) -> AdapterInfo {
    let (info, limits) = (adapter.get_info(), adapter.limits());
    AdapterInfo {
        name: info.name,
        api: format!("{:?}", info.backend),
        driver: format!("{} {}", info.driver, info.driver_info)
            .trim()
            .to_owned(),
        hardware: info.device_type != DeviceType::Cpu,
        kind: match info.device_type {
            DeviceType::DiscreteGpu => "discrete",
            DeviceType::IntegratedGpu => "integrated",
            DeviceType::VirtualGpu => "virtual",
            DeviceType::Cpu => "software",
            DeviceType::Other => "unknown",
        },
        f64_arithmetic: adapter.features().contains(F64),
        max_binding: limits.max_storage_buffer_binding_size,
        max_buffer: limits.max_buffer_size,
    }
}

/// Smaller is better.
fn rank(adapter: &wgpu::Adapter) -> (bool, bool, u8, u8) {
    let info = adapter.get_info();
    let api = u8::from(info.backend == Api::Gl);
    let kind = match info.device_type {
        DeviceType::DiscreteGpu => 0,
        DeviceType::IntegratedGpu => 1,
        DeviceType::VirtualGpu => 2,
        DeviceType::Other => 3,
        DeviceType::Cpu => 4,
    };
    (
        info.device_type == DeviceType::Cpu,
        !adapter.features().contains(F64),
        api,
        kind,
    )
}

/// An open device with what kernels need to know of it.
#[derive(Debug)]
pub(crate) struct Device {
    pub device: wgpu::Device,
    pub queue: wgpu::Queue,
    pub info: AdapterInfo,
    faults: Arc<Mutex<Option<String>>>,
}

impl Device {
    /// `None` where hardware was asked for and there is none.
    pub fn open(selection: &Selection) -> Result<Option<Self>, BackendError> {
        // GL only where nothing better is found: its loader may print to the terminal.
        let mut found = enumerate(Backends::PRIMARY);
        if !found.iter().any(|a| accepts(selection, a)) {
            found.extend(enumerate(Backends::GL));
        }
        if found.is_empty() && *selection != Selection::Hardware {
            return Err(BackendError::NoAdapter);
        }
        let numbered = match selection {
            Selection::Named(text) => text.parse::<usize>().ok().and_then(|k| found.get(k)),
            _ => None,
        };
        let named = || found.iter().find(|a| accepts(selection, a));
        let Some(adapter) = numbered.or_else(named) else {
            return match selection {
                Selection::Named(wanted) => {
                    let names: Vec<String> = found.iter().map(|a| a.get_info().name).collect();
                    Err(BackendError::NoSuchAdapter {
                        wanted: wanted.clone(),
                        found: names.join(", "),
                    })
                }
                _ => Ok(None),
            };
        };
        let info = describe(adapter);
        // Time stamps are for figures only: a device without them does.
        let clock = adapter.features() & wgpu::Features::TIMESTAMP_QUERY;
        let (device, queue) =
            pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
                label: Some("costate"),
                required_features: if info.f64_arithmetic {
                    F64 | clock
                } else {
                    clock
                },
                required_limits: adapter.limits(),
                ..Default::default()
            }))?;
        let faults = Arc::new(Mutex::new(None));
        let keep = Arc::clone(&faults);
        let note = move |message: String| {
            // The first message tells the cause; later ones its consequences.
            keep.lock()
                .unwrap_or_else(PoisonError::into_inner)
                .get_or_insert(message);
        };
        let note_lost = note.clone();
        device.on_uncaptured_error(Arc::new(move |e: wgpu::Error| note(e.to_string())));
        device.set_device_lost_callback(move |reason, message| {
            if reason != wgpu::DeviceLostReason::Destroyed {
                note_lost(format!("device lost: {message}"));
            }
        });
        Ok(Some(Self {
            device,
            queue,
            info,
            faults,
        }))
    }

    /// The first error since the last check.
    pub fn check(&self) -> Result<(), BackendError> {
        match self
            .faults
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .take()
        {
            Some(message) => Err(BackendError::Fault { message }),
            None => Ok(()),
        }
    }

    pub fn supports(&self, precision: Precision) -> bool {
        precision == Precision::F32 || self.info.f64_arithmetic
    }
}

fn accepts(selection: &Selection, adapter: &wgpu::Adapter) -> bool {
    let info = adapter.get_info();
    match selection {
        Selection::Hardware => info.device_type != DeviceType::Cpu,
        Selection::Any => true,
        Selection::Named(part) => info.name.to_lowercase().contains(&part.to_lowercase()),
    }
}
