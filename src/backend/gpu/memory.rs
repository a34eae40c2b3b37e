//! Device buffers and what binds them to pipelines; those of a kernel, kept from batch to batch;
//! reading back.

use super::adapter::Device;
use crate::backend::BackendError;
use crate::model::Precision;
use wgpu::{Buffer, BufferUsages};

/// A storage buffer with room for so many bytes.
pub fn storage(device: &Device, label: &'static str, bytes: usize) -> Buffer {
    buffer(
        device,
        label,
        bytes,
        BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC,
    )
}

/// A storage buffer with these bytes.
pub fn filled(device: &Device, label: &'static str, bytes: &[u8]) -> Buffer {
    let buffer = storage(device, label, bytes.len());
    device.queue.write_buffer(&buffer, 0, bytes);
    buffer
}

/// Room for what is read back.
pub fn staging(device: &Device, label: &'static str, bytes: usize) -> Buffer {
    buffer(
        device,
        label,
        bytes,
        BufferUsages::MAP_READ | BufferUsages::COPY_DST,
    )
}

pub fn buffer(device: &Device, label: &'static str, bytes: usize, usage: BufferUsages) -> Buffer {
    device.device.create_buffer(&wgpu::BufferDescriptor {
        label: Some(label),
        size: padded(bytes).max(16) as u64,
        usage,
        mapped_at_creation: false,
    })
}

/// What a binding is to kernels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Use {
    Uniform,
    Read,
    Written,
}

/// The layout of a group of buffers, in the order of their bindings.
pub fn layout(
    device: &Device,
    label: &'static str,
    uses: impl IntoIterator<Item = Use>,
) -> wgpu::BindGroupLayout {
    let entries: Vec<wgpu::BindGroupLayoutEntry> = (uses.into_iter().enumerate())
        .map(|(k, how)| wgpu::BindGroupLayoutEntry {
            binding: k as u32,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Buffer {
                ty: match how {
                    Use::Uniform => wgpu::BufferBindingType::Uniform,
                    how => wgpu::BufferBindingType::Storage {
                        read_only: how == Use::Read,
                    },
                },
                has_dynamic_offset: false,
                min_binding_size: None,
            },
            count: None,
        })
        .collect();
    (device.device).create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some(label),
        entries: &entries,
    })
}

/// Uses of so many storage buffers, of which these are written.
pub fn uses(count: usize, written: &[usize]) -> impl Iterator<Item = Use> + '_ {
    (0..count).map(|k| {
        if written.contains(&k) {
            Use::Written
        } else {
            Use::Read
        }
    })
}

/// Buffers bound in the order of their bindings, whole or only so many of their leading bytes.
pub fn bind<'a>(
    device: &Device,
    layout: &wgpu::BindGroupLayout,
    buffers: impl IntoIterator<Item = (&'a Buffer, Option<usize>)>,
) -> wgpu::BindGroup {
    let entries: Vec<wgpu::BindGroupEntry<'_>> = (buffers.into_iter().enumerate())
        .map(|(k, (buffer, bytes))| wgpu::BindGroupEntry {
            binding: k as u32,
            resource: wgpu::BindingResource::Buffer(wgpu::BufferBinding {
                buffer,
                offset: 0,
                size: bytes.and_then(|bytes| std::num::NonZeroU64::new(bytes as u64)),
            }),
        })
        .collect();
    device.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout,
        entries: &entries,
    })
}

/// The pipelines of a module's entry points.
pub fn pipelines<const N: usize>(
    device: &Device,
    groups: &[&wgpu::BindGroupLayout],
    module: &wgpu::ShaderModule,
    entries: [&'static str; N],
) -> [wgpu::ComputePipeline; N] {
    let groups: Vec<_> = groups.iter().copied().map(Some).collect();
    let layout = (device.device).create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: None,
        bind_group_layouts: &groups,
        ..Default::default()
    });
    let compile = |entry: &'static str| {
        (device.device).create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(entry),
            layout: Some(&layout),
            module,
            entry_point: Some(entry),
            compilation_options: Default::default(),
            cache: None,
        })
    };
    // Drivers take seconds to compile a long kernel, on one thread.
    std::thread::scope(|scope| {
        let compile = &compile;
        let others = entries.map(|entry| scope.spawn(move || compile(entry)));
        others.map(|handle| match handle.join() {
            Ok(pipeline) => pipeline,
            Err(panic) => std::panic::resume_unwind(panic),
        })
    })
}

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
    pub fn seeds(&self) -> usize {
        self.dim * self.trajectories * self.real
    }
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
    /// Where the host writes seeds that are copied to the state.
    seeds: Buffer,
    pub state: Buffer,
    pub counters: Buffer,
    pub remaining: Buffer,
    pub ends: Buffer,
    pub samples: Option<Buffer>,
    /// Sentinels, for the counters and the ends.
    sentinels: Buffer,
    /// Receives what is read back.
    staging: Buffer,
    pub bindings: wgpu::BindGroup,
}

/// Fields of the counters.
const COUNTERS: usize = 5;
/// Bytes of the control uniform.
const CONTROL: usize = 32;

impl Memory {
    pub fn new(device: &Device, layout: &wgpu::BindGroupLayout, shape: Shape) -> Self {
        let usage = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
        let control = buffer(device, "control", CONTROL, usage);
        let storage = |label, bytes| storage(device, label, bytes);
        let settings = storage("settings", shape.settings * shape.real);
        let usage = BufferUsages::MAP_WRITE | BufferUsages::COPY_SRC;
        let seeds = buffer(device, "seeds", shape.seeds(), usage);
        let state = storage("state", shape.state());
        let counters = storage("counters", shape.counters());
        let lists = storage("lists", shape.lists());
        let remaining = storage("remaining", 4);
        let ends = storage("ends", shape.ends());
        let samples = (shape.levels > 0).then(|| storage("samples", shape.samples()));
        let sentinels = filled(
            device,
            "sentinels",
            &vec![0xff; padded((4 * shape.trajectories).max(shape.ends()))],
        );
        let all = padded(shape.counters()) + padded(shape.ends()) + padded(shape.samples());
        let staging = staging(device, "staging", all);
        let bound = [
            &control, &settings, &state, &counters, &lists, &remaining, &ends,
        ];
        let bindings = bind(
            device,
            layout,
            bound.into_iter().chain(&samples).map(|b| (b, None)),
        );
        Self {
            shape,
            control,
            settings,
            seeds,
            state,
            counters,
            remaining,
            ends,
            samples,
            sentinels,
            staging,
            bindings,
        }
    }

    /// Puts sentinels where statuses and ends will be written: a slot that still holds one at the
    /// end was not written.
    pub fn blank(&self, encoder: &mut wgpu::CommandEncoder, statuses: usize, ends: usize) {
        for (buffer, bytes) in [(&self.counters, statuses), (&self.ends, ends)] {
            encoder.copy_buffer_to_buffer(&self.sentinels, 0, buffer, 0, bytes as u64);
        }
    }

    /// Hands over memory of the device for the seeds of a shape, `[component][trajectory]`; what is
    /// written there gets to the state with [`Self::seed`]. (A buffer of its own is kept for them:
    /// to make one for each batch takes longer than to fill it.)
    ///
    /// # Errors
    /// Device failures.
    pub fn write_seeds(
        &self,
        device: &Device,
        shape: &Shape,
        write: impl FnOnce(wgpu::WriteOnly<'_, [u8]>),
    ) -> Result<(), BackendError> {
        let bytes = shape.seeds() as u64;
        map(device, &self.seeds, wgpu::MapMode::Write, bytes)?;
        let mut view =
            (self.seeds.get_mapped_range_mut(..bytes)).map_err(|_| wgpu::BufferAsyncError)?;
        write(view.slice(..));
        drop(view);
        self.seeds.unmap();
        Ok(())
    }

    /// Copies the seeds to the state.
    pub fn seed(&self, encoder: &mut wgpu::CommandEncoder, shape: &Shape) {
        let bytes = shape.seeds() as u64;
        encoder.copy_buffer_to_buffer(&self.seeds, 0, &self.state, 0, bytes);
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

/// Ends what `encoder` holds with copies of the leading bytes of buffers, waits for all of it and
/// hands the bytes to `read`. The staging buffer has room for all of them, each padded to 16 bytes.
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
    map(device, staging, wgpu::MapMode::Read, at as u64)?;
    let outcome = staging.get_mapped_range(..at as u64).map(|view| {
        let bytes: &[u8] = &view;
        read(places.map(|place| &bytes[place]))
    });
    staging.unmap();
    outcome.map_err(|_| wgpu::BufferAsyncError.into())
}

/// Maps the leading bytes of a buffer, when all that was submitted is done.
fn map(
    device: &Device,
    buffer: &Buffer,
    mode: wgpu::MapMode,
    bytes: u64,
) -> Result<(), BackendError> {
    let (tell, told) = std::sync::mpsc::channel();
    buffer.map_async(mode, ..bytes, move |outcome| {
        // Nobody waits any more where the receiver is gone.
        let _ = tell.send(outcome);
    });
    device.device.poll(wgpu::PollType::wait_indefinitely())?;
    device.check()?;
    told.recv()
        .map_err(|_| wgpu::BufferAsyncError)
        .and_then(|outcome| outcome)?;
    Ok(())
}

/// Most bytes of device memory a binding is given: batches are split to stay below.
const LARGEST_BINDING: u64 = 256 << 20;

/// Bytes that one binding of this device is given at most.
pub fn binding_limit(device: &Device) -> u64 {
    let info = &device.info;
    info.max_binding
        .min(info.max_buffer / 2)
        .min(LARGEST_BINDING)
}

/// Storage buffers that an invocation of this device may read and write at most.
pub fn most_buffers(device: &Device) -> usize {
    device.device.limits().max_storage_buffers_per_shader_stage as usize
}

/// Room for `bytes` such that what follows is aligned for any number.
pub fn padded(bytes: usize) -> usize {
    bytes.next_multiple_of(16)
}

/// Numbers as a buffer of the precision holds them.
pub fn reals(values: impl IntoIterator<Item = f64>, precision: Precision) -> Vec<u8> {
    match precision {
        Precision::F32 => values
            .into_iter()
            .flat_map(|x| (x as f32).to_ne_bytes())
            .collect(),
        Precision::F64 => values.into_iter().flat_map(f64::to_ne_bytes).collect(),
    }
}
