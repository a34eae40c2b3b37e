//! Device buffers of a kernel, kept from batch to batch, and reading them back.

use super::adapter::Device;
use crate::backend::BackendError;
use crate::model::Precision;
use wgpu::{Buffer, BufferUsages};

/// Sizes that the buffers follow from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    pub trajectories: usize,
    pub dim: usize,
    /// Reals of a trajectory's state.
    pub state: usize,
    /// Stored levels; 0 where samples are not kept.
    pub levels: usize,
    /// Reals of a sample.
    pub sample: usize,
    /// Reals of run settings.
    pub settings: usize,
    /// Bytes a real.
    pub real: usize,
}

impl Shape {
    pub fn state(&self) -> usize {
        self.state * self.trajectories * self.real
    }
    pub fn counters(&self) -> usize {
        4 * COUNTERS * self.trajectories
    }
    fn lists(&self) -> usize {
        2 * 4 * self.trajectories
    }
    pub fn ends(&self) -> usize {
        (self.dim + 1) * self.trajectories * self.real
    }
    pub fn samples(&self) -> usize {
        self.levels * self.sample * self.trajectories * self.real
    }

    /// The largest binding's bytes a trajectory.
    pub fn largest_share(&self) -> usize {
        let one = Self {
            trajectories: 1,
            ..*self
        };
        one.state().max(one.counters()).max(one.samples())
    }

    fn holds(&self, other: &Self) -> bool {
        self.trajectories >= other.trajectories
            && self.samples() >= other.samples()
            && self.settings >= other.settings
            && (self.dim, self.state, self.real, self.levels > 0)
                == (other.dim, other.state, other.real, other.levels > 0)
    }
}

/// The buffers, in the order of their bindings.
#[derive(Debug)]
pub struct Memory {
    shape: Shape,
    pub control: Buffer,
    pub settings: Buffer,
    pub state: Buffer,
    pub counters: Buffer,
    pub remaining: Buffer,
    pub ends: Buffer,
    pub samples: Option<Buffer>,
    /// Receives what is read back.
    staging: Buffer,
    pub bindings: wgpu::BindGroup,
}

/// Fields of the counters.
const COUNTERS: usize = 5;
/// Bytes of the control uniform.
pub const CONTROL: usize = 32;

impl Memory {
    pub fn new(device: &Device, layout: &wgpu::BindGroupLayout, shape: Shape) -> Self {
        let buffer = |label, size: usize, usage| {
            device.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some(label),
                size: size.next_multiple_of(16).max(16) as u64,
                usage,
                mapped_at_creation: false,
            })
        };
        let storage = BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC;
        let control = buffer("control", CONTROL, BufferUsages::UNIFORM | BufferUsages::COPY_DST);
        let settings = buffer("settings", shape.settings * shape.real, storage);
        let state = buffer("state", shape.state(), storage);
        let counters = buffer("counters", shape.counters(), storage);
        let lists = buffer("lists", shape.lists(), storage);
        let remaining = buffer("remaining", 4, storage);
        let ends = buffer("ends", shape.ends(), storage);
        let samples = (shape.levels > 0).then(|| buffer("samples", shape.samples(), storage));
        let all = padded(shape.counters()) + padded(shape.ends()) + padded(shape.samples());
        let staging = buffer("staging", all, BufferUsages::MAP_READ | BufferUsages::COPY_DST);
        let bound = [&control, &settings, &state, &counters, &lists, &remaining, &ends];
        let entries: Vec<wgpu::BindGroupEntry<'_>> = (bound.into_iter().chain(&samples).enumerate())
            .map(|(k, b)| wgpu::BindGroupEntry {
                binding: k as u32,
                resource: b.as_entire_binding(),
            })
            .collect();
        let bindings = device.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout,
            entries: &entries,
        });
        Self {
            shape,
            control,
            settings,
            state,
            counters,
            remaining,
            ends,
            samples,
            staging,
            bindings,
        }
    }

    /// Whether a batch of this shape fits these buffers.
    pub fn holds(&self, shape: &Shape) -> bool {
        self.shape.holds(shape)
    }

    /// Reads the leading bytes of buffers when what `encoder` holds is done; see [`read_back`].
    pub fn read<const N: usize, R>(
        &self,
        device: &Device,
        encoder: wgpu::CommandEncoder,
        wanted: [(&Buffer, usize); N],
        read: impl FnOnce([&[u8]; N]) -> R,
    ) -> Result<R, BackendError> {
        read_back(device, &self.staging, encoder, wanted, read)
    }
}

/// Ends what `encoder` holds with copies of the leading bytes of buffers, waits for all of it and hands the bytes to
/// `read`. The staging buffer has room for all of them, each padded to 16 bytes.
pub fn read_back<const N: usize, R>(
    device: &Device,
    staging: &Buffer,
    mut encoder: wgpu::CommandEncoder,
    wanted: [(&Buffer, usize); N],
    read: impl FnOnce([&[u8]; N]) -> R,
) -> Result<R, BackendError> {
    let mut at = 0;
    let places = wanted.map(|(buffer, bytes)| {
        encoder.copy_buffer_to_buffer(buffer, 0, staging, at as u64, bytes as u64);
        let place = at..at + bytes;
        at += padded(bytes);
        place
    });
    device.queue.submit([encoder.finish()]);
    let (tell, told) = std::sync::mpsc::channel();
    staging.map_async(wgpu::MapMode::Read, ..at as u64, move |outcome| {
        // Nobody waits any more where the receiver is gone.
        let _ = tell.send(outcome);
    });
    device.device.poll(wgpu::PollType::wait_indefinitely())?;
    device.check()?;
    told.recv()
        .map_err(|_| wgpu::BufferAsyncError)
        .and_then(|outcome| outcome)?;
    let outcome = staging.get_mapped_range(..at as u64).map(|view| {
        let bytes: &[u8] = &view;
        read(places.map(|place| &bytes[place]))
    });
    staging.unmap();
    outcome.map_err(|_| wgpu::BufferAsyncError.into())
}

/// Most bytes of device memory a binding is given: batches are split to stay below.
const LARGEST_BINDING: u64 = 256 << 20;

/// Bytes that one binding of this device is given at most.
pub fn binding_limit(device: &Device) -> u64 {
    let info = &device.info;
    info.max_binding.min(info.max_buffer / 2).min(LARGEST_BINDING)
}

/// Room for `bytes` such that what follows is aligned for any number.
fn padded(bytes: usize) -> usize {
    bytes.next_multiple_of(16)
}

/// Numbers as a buffer of the precision holds them.
pub fn reals(values: impl IntoIterator<Item = f64>, precision: Precision) -> Vec<u8> {
    match precision {
        Precision::F32 => values.into_iter().flat_map(|x| (x as f32).to_ne_bytes()).collect(),
        Precision::F64 => values.into_iter().flat_map(f64::to_ne_bytes).collect(),
    }
}
