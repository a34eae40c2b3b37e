//! A compiled kernel: its pipelines, and driving a batch through them.

use super::adapter::Device;
use super::clock::Clock;
use super::emit::{self, Emitter, Settings, WORKGROUP, stored};
use super::memory::{Memory, Shape, Use, binding_limit, layout, pipelines, reals};
use super::relay::GpuRelay;
use super::results::{self, Written};
use super::shader::{Fragment, Source, conditional};
use crate::backend::{BackendError, Kernel, Relay, Run, Spec, Surface, Trajectories, Variant};
use crate::integrator::Scheme;
use crate::model::Precision;
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use std::sync::Arc;
use std::time::Instant;

/// Seconds a dispatch should last at most: far below any driver's watchdog, long against the cost
/// of a dispatch.
pub(super) const DISPATCH_SECONDS: f64 = 0.1;
/// Loop iterations an invocation may spend in a dispatch. The most that Mesa's llvmpipe allows a
/// shader is 65535; a single step may add those of one event on top.
pub(super) const WORK: std::ops::RangeInclusive<f64> = 16.0..=16384.0;
/// Work of the first dispatch, before anything was measured.
pub(super) const FIRST_WORK: u32 = 64;

/// The two entry points of a module.
pub(super) struct Pipelines {
    pub start: wgpu::ComputePipeline,
    pub sweep: wgpu::ComputePipeline,
}

/// Operations of a Taylor step, which stand one behind the other: shader compilers take long over
/// more.
const MOST_WRITTEN_OUT: usize = 20_000;
/// A tolerance at which a kernel's text is looked at before any run.
const RTOL: f64 = 1e-6;

/// What kernels of a spec differ by: the degree of steps, which Taylor's method takes from the
/// tolerance, and the variant.
pub(super) type Key = (usize, Variant);

pub(super) struct GpuKernel {
    device: Arc<Device>,
    spec: Spec,
    layout: wgpu::BindGroupLayout,
    pipelines: FxHashMap<Key, Pipelines>,
    /// Bytes of their modules' texts.
    text: usize,
    memory: Option<Memory>,
    /// Attempted steps a second over all trajectories, as measured so far.
    speed: Option<f64>,
    clock: Option<Clock>,
    /// In the passes of the latest batch.
    seconds: f64,
}

/// The whole text of a kernel's module.
fn source(spec: &Spec, scheme: Scheme, variant: Variant) -> Result<Source, BackendError> {
    let mut fragments = integrator(&Emitter::new(spec, scheme, variant))?.to_vec();
    fragments.push(Fragment {
        name: "shaders/sweep.wgsl",
        text: include_str!("../../../shaders/sweep.wgsl").to_owned(),
    });
    Ok(Source::new(&fragments))
}

/// What all modules that integrate have in common.
///
/// # Errors
/// [`BackendError::TooLong`].
pub(super) fn integrator(emitter: &Emitter<'_>) -> Result<[Fragment; 5], BackendError> {
    let operations = emitter.written_out();
    if operations > MOST_WRITTEN_OUT {
        return Err(BackendError::TooLong {
            operations,
            limit: MOST_WRITTEN_OUT,
        });
    }
    let conditions = emitter.conditions();
    let mut block = conditional(include_str!("../../../shaders/block.wgsl"), &conditions);
    for (name, value) in emitter.names() {
        block = block.replace(name, &value);
    }
    Ok([
        Fragment {
            name: "constants",
            text: emitter.constants(),
        },
        Fragment {
            name: "shaders/real.wgsl",
            text: conditional(include_str!("../../../shaders/real.wgsl"), &conditions),
        },
        Fragment {
            name: "model",
            text: emitter.model(),
        },
        Fragment {
            name: "method",
            text: emitter.method(),
        },
        Fragment {
            name: "shaders/block.wgsl",
            text: block,
        },
    ])
}

/// The buffer of run settings, for these levels.
pub(super) fn settings(spec: &Spec, run: &Run, levels: &[f64]) -> Vec<f64> {
    let at = Settings::new(spec.dim(), run.variant());
    let mut list = vec![0.0; at.levels + levels.len().max(1)];
    list[at.rtol] = run.rtol;
    // An adaptive method has no fixed step, but may be given the first one.
    list[at.step] = match spec.method.adaptive() {
        true => run.first.unwrap_or(0.0),
        false => run.step,
    };
    list[at.ceiling] = run.ceiling.map_or(0.0, |(_, value)| value);
    list[at.last] = run.levels.last().copied().unwrap_or(0.0);
    list[at.atol..at.lower].copy_from_slice(&run.atol);
    for (c, [lower, upper]) in run.bounds.iter().enumerate() {
        list[at.lower + c] = *lower;
        list[at.upper + c] = *upper;
    }
    list[at.levels..at.levels + levels.len()].copy_from_slice(levels);
    list
}

impl GpuKernel {
    pub fn new(device: Arc<Device>, spec: Spec) -> Result<Self, BackendError> {
        // Variants differ by checks that are added to this one, Taylor steps by their order.
        let scheme = spec.method.scheme(RTOL);
        source(&spec, scheme, Variant::default())?.validate(device.info.f64_arithmetic)?;
        let layout = layout(&device, "kernel", bindings(spec.store));
        let clock = Clock::new(&device);
        device.check()?;
        Ok(Self {
            device,
            spec,
            layout,
            pipelines: FxHashMap::default(),
            text: 0,
            memory: None,
            speed: None,
            clock,
            seconds: 0.0,
        })
    }

    /// Makes the pipelines for a run where they are missing, and says which they are.
    pub(super) fn prepare(&mut self, run: &Run) -> Result<Key, BackendError> {
        let (scheme, variant) = (self.spec.method.scheme(run.rtol), run.variant());
        let key = (scheme.degree(), variant);
        if self.pipelines.contains_key(&key) {
            return Ok(key);
        }
        let source = source(&self.spec, scheme, variant)?;
        source.validate(self.device.info.f64_arithmetic)?;
        self.text += source.text.len();
        let device = &self.device.device;
        let descriptor = wgpu::ShaderModuleDescriptor {
            label: Some("kernel"),
            source: wgpu::ShaderSource::Wgsl(source.text.into()),
        };
        // SAFETY: the shader's loops are bounded by counters of their own, and its indices stay
        // within the buffers: trajectories below the stride that the buffers were sized for, levels
        // below their number.
        let module = unsafe {
            device.create_shader_module_trusted(descriptor, wgpu::ShaderRuntimeChecks::unchecked())
        };
        let [start, sweep] = pipelines(&self.device, &[&self.layout], &module, ["start", "sweep"]);
        self.device.check()?;
        self.pipelines.insert(key, Pipelines { start, sweep });
        Ok(key)
    }

    /// Levels the shader sees: all where they are stored, otherwise the last.
    fn levels<'a>(&self, run: &'a Run) -> &'a [f64] {
        if self.spec.store {
            &run.levels
        } else {
            &run.levels[run.levels.len().saturating_sub(1)..]
        }
    }

    /// Makes the buffers fit for a batch.
    ///
    /// # Errors
    /// Device failures.
    pub(super) fn allocate(&mut self, shape: Shape) -> Result<(), BackendError> {
        if self.memory.as_ref().is_some_and(|m| m.holds(&shape)) {
            return Ok(());
        }
        // Freed first: both need not fit.
        self.memory = None;
        self.memory = Some(Memory::new(&self.device, &self.layout, shape));
        self.device.check()
    }

    /// Buffers and pipelines, where they have been made.
    pub(super) fn made(&self, key: Key) -> Option<(&Memory, &Pipelines)> {
        self.memory.as_ref().zip(self.pipelines.get(&key))
    }

    /// Integrates as many trajectories as fit the device's bindings: those of the result from
    /// `first` on.
    ///
    /// # Errors
    /// Device failures, and results that were not written.
    fn part(
        &mut self,
        run: &Run,
        key: Key,
        seeds: &[f64],
        shape: Shape,
        first: usize,
        result: &mut Trajectories,
    ) -> Result<(), BackendError> {
        self.allocate(shape)?;
        let (Some(memory), Some(pipelines)) = (&self.memory, self.pipelines.get(&key)) else {
            return Err(BackendError::Unwritten { index: 0 });
        };
        let part = Part {
            kernel: self,
            memory,
            pipelines,
            run,
            shape,
        };
        part.upload(seeds)?;
        let (seconds, stamped) = part.sweep(self.seconds)?;
        part.fill(first, result)?;
        let those = first..first + shape.trajectories;
        let attempts: u64 = (result.steps[those.clone()].par_iter())
            .zip(&result.rejected[those])
            .map(|(taken, rejected)| u64::from(*taken) + u64::from(*rejected))
            .sum();
        self.seconds = stamped;
        self.speed = Some(attempts as f64 / seconds);
        Ok(())
    }

    /// Work of a first dispatch of `active` trajectories.
    fn work(&self, active: u32) -> u32 {
        self.speed.map_or(FIRST_WORK, |s| {
            bounded(s * DISPATCH_SECONDS / f64::from(active))
        })
    }
}

/// Trajectories of a batch that are integrated at once.
struct Part<'p> {
    kernel: &'p GpuKernel,
    memory: &'p Memory,
    pipelines: &'p Pipelines,
    run: &'p Run,
    shape: Shape,
}

impl Part<'_> {
    /// Writes settings and seeds to the device.
    ///
    /// # Errors
    /// Device failures.
    fn upload(&self, seeds: &[f64]) -> Result<(), BackendError> {
        let (kernel, memory) = (self.kernel, self.memory);
        let precision = kernel.spec.precision;
        let set = settings(&kernel.spec, self.run, kernel.levels(self.run));
        let set = reals(set, precision);
        (kernel.device.queue).write_buffer(&memory.settings, 0, &set);
        memory.write_seeds(&kernel.device, &self.shape, |to| match precision {
            Precision::F32 => by_component(seeds, self.shape.dim, to, |x| x as f32),
            Precision::F64 => by_component(seeds, self.shape.dim, to, |x| x),
        })
    }

    /// Dispatches until every trajectory has ended. Returns the seconds of all dispatches; and
    /// those by the device's clock, added to what `stamped` holds already.
    ///
    /// # Errors
    /// Device failures.
    fn sweep(&self, mut stamped: f64) -> Result<(f64, f64), BackendError> {
        let mut active = self.shape.trajectories as u32;
        let mut list = 0;
        let mut started = false;
        let mut work = self.kernel.work(active);
        let mut seconds = 0.0;
        while active > 0 {
            let before = Instant::now();
            let pass = self.pass(active, list, work, !started);
            let (left, in_pass) = self.wait(pass)?;
            stamped += in_pass.unwrap_or(0.0);
            started = true;
            // By the device's clock, for the first dispatch waits for the seeds; some drivers offer
            // one that stands still. At most this much was done, so the measured speed is at most
            // too high by what ended early.
            let elapsed = before.elapsed().as_secs_f64();
            let dispatch = in_pass.filter(|s| *s > 0.0).unwrap_or(elapsed);
            seconds += dispatch;
            work = bounded(
                f64::from(work) * (DISPATCH_SECONDS / dispatch).min(8.0) * f64::from(active)
                    / f64::from(left.max(1)),
            );
            active = left;
            list = 1 - list;
        }
        Ok((seconds, stamped))
    }

    /// A pass of so much work for those of a list that are active; the first one also starts them.
    fn pass(&self, active: u32, list: u32, work: u32, is_first: bool) -> wgpu::CommandEncoder {
        let (kernel, memory, shape) = (self.kernel, self.memory, self.shape);
        let (device, queue) = (&kernel.device.device, &kernel.device.queue);
        let (count, levels) = (shape.trajectories, kernel.levels(self.run).len() as u32);
        let control = [active, list, count as u32, work, self.run.max_steps, levels];
        queue.write_buffer(&memory.control, 0, bytemuck::cast_slice(&control));
        queue.write_buffer(&memory.remaining, 0, &[0; 4]);
        let mut encoder = device.create_command_encoder(&Default::default());
        if is_first {
            memory.seed(&mut encoder, &shape);
            memory.blank(&mut encoder, 4 * count, shape.ends());
        }
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                label: None,
                timestamp_writes: kernel.clock.as_ref().map(Clock::writes),
            });
            pass.set_bind_group(0, &memory.bindings, &[]);
            if is_first {
                pass.set_pipeline(&self.pipelines.start);
                pass.dispatch_workgroups(active.div_ceil(WORKGROUP), 1, 1);
            }
            pass.set_pipeline(&self.pipelines.sweep);
            pass.dispatch_workgroups(active.div_ceil(WORKGROUP), 1, 1);
        }
        encoder
    }

    /// Waits for a pass: how many trajectories have not ended, and the seconds of the pass, where
    /// the device has a clock.
    ///
    /// # Errors
    /// Device failures.
    fn wait(&self, mut pass: wgpu::CommandEncoder) -> Result<(u32, Option<f64>), BackendError> {
        let (device, memory) = (&self.kernel.device, self.memory);
        let count = |b: &[u8]| u32::from_ne_bytes([b[0], b[1], b[2], b[3]]);
        let remaining = (&memory.remaining, 4);
        let Some(clock) = &self.kernel.clock else {
            let left = memory.read(device, pass, [remaining], |[b]| count(b))?;
            return Ok((left, None));
        };
        let stamps = clock.resolve(&mut pass);
        let wanted = [remaining, (stamps, Clock::BYTES)];
        memory.read(device, pass, wanted, |[b, s]| {
            (count(b), Some(clock.seconds(s)))
        })
    }

    /// Reads what the device wrote into the result.
    ///
    /// # Errors
    /// Device failures, and results that were not written.
    fn fill(&self, first: usize, result: &mut Trajectories) -> Result<(), BackendError> {
        let (kernel, memory, shape) = (self.kernel, self.memory, self.shape);
        let device = &kernel.device;
        let encoder = device.device.create_command_encoder(&Default::default());
        let samples = memory.samples.as_ref().unwrap_or(&memory.ends);
        let wanted = [
            (&memory.counters, shape.counters()),
            (&memory.ends, shape.ends()),
            (samples, shape.samples()),
        ];
        memory.read(device, encoder, wanted, |[counters, ends, samples]| {
            let written = Written {
                counters,
                ends,
                samples,
            };
            results::fill(result, first, &kernel.spec, self.run, shape, &written)
        })?
    }
}

/// Writes vectors `[trajectory][component]` as `[component][trajectory]`, in numbers of a precision.
fn by_component<T: bytemuck::Pod>(
    seeds: &[f64],
    dim: usize,
    to: wgpu::WriteOnly<'_, [u8]>,
    number: impl Fn(f64) -> T + Sync,
) {
    /// Bytes written at once: memory of a device is slow to write in small parts.
    const BLOCK: usize = 1 << 14;
    let (count, numbers) = (seeds.len() / dim, BLOCK / size_of::<T>());
    let block = |first: usize, length: usize| -> Vec<T> {
        let (mut c, mut i) = (first / count, first % count);
        let next = |_| {
            let x = number(seeds[i * dim + c]);
            i += 1;
            if i == count {
                (c, i) = (c + 1, 0);
            }
            x
        };
        (0..length).map(next).collect()
    };
    let (blocks, mut rest) = to.into_chunks::<BLOCK>();
    let blocks: Vec<wgpu::WriteOnly<'_, [u8; BLOCK]>> = blocks.into_iter().collect();
    let whole = blocks.len() * numbers;
    blocks.into_par_iter().enumerate().for_each(|(k, to)| {
        let block = block(k * numbers, numbers);
        wgpu::WriteOnly::<[u8]>::from(to).copy_from_slice(bytemuck::cast_slice(&block));
    });
    rest.copy_from_slice(bytemuck::cast_slice(&block(whole, seeds.len() - whole)));
}

/// How a kernel uses its bindings: settings are read, the others written.
pub(super) fn bindings(samples: bool) -> impl Iterator<Item = Use> {
    let others = [Use::Written; 6]
        .into_iter()
        .take(if samples { 6 } else { 5 });
    [Use::Uniform, Use::Read].into_iter().chain(others)
}

fn bounded(work: f64) -> u32 {
    work.clamp(*WORK.start(), *WORK.end()) as u32
}

impl Kernel for GpuKernel {
    fn code_bytes(&self) -> Option<usize> {
        Some(self.text).filter(|bytes| *bytes > 0)
    }

    fn kernel_seconds(&self) -> Option<f64> {
        // Some drivers offer a clock that stands still.
        (self.clock.is_some() && self.seconds > 0.0).then_some(self.seconds)
    }

    fn relay(&self, run: &Run, surface: &Surface) -> Result<Option<Box<dyn Relay>>, BackendError> {
        let made = GpuRelay::new(Arc::clone(&self.device), &self.spec, run, surface)?;
        Ok(made.map(|relay| -> Box<dyn Relay> { Box::new(relay) }))
    }

    fn integrate_into(
        &mut self,
        run: &Run,
        seeds: &[f64],
        to: &mut Trajectories,
    ) -> Result<(), BackendError> {
        let dim = self.spec.dim();
        let count = seeds.len() / dim;
        let variant = run.variant();
        let levels = if self.spec.store { run.levels.len() } else { 0 };
        to.shape(count, dim, levels);
        self.seconds = 0.0;
        if count == 0 {
            return Ok(());
        }
        let key = self.prepare(run)?;
        let settings = Settings::new(dim, variant).levels + run.levels.len().max(1);
        let mut shape = Shape {
            trajectories: 1,
            dim,
            state: emit::state(&self.spec),
            levels,
            sample: 1 + stored(&self.spec).count(),
            settings,
            real: self.spec.precision.bytes(),
        };
        let limit = binding_limit(&self.device);
        let share = shape.largest_share() as u64;
        let groups = u64::from(
            self.device
                .device
                .limits()
                .max_compute_workgroups_per_dimension,
        );
        let most = (limit / share).min(groups * u64::from(WORKGROUP));
        if most == 0 {
            return Err(BackendError::TooLarge {
                bytes: share,
                limit,
            });
        }
        let most = most as usize;
        for (k, part) in seeds.chunks(most * dim).enumerate() {
            shape.trajectories = part.len() / dim;
            self.part(run, key, part, shape, k * most, to)?;
        }
        Ok(())
    }
}
