//! The arithmetic rate of a device, from `shaders/peak.wgsl`.

use super::adapter::Device;
use super::clock::Clock;
use super::emit::WORKGROUP;
use super::memory::{read_back, reals};
use super::shader::{Fragment, Source};
use crate::backend::BackendError;
use crate::model::Precision;
use std::time::Instant;
use wgpu::BufferUsages;

/// Loop iterations of an invocation; within what Mesa's llvmpipe allows a shader.
const ROUNDS: u32 = 1024;
/// Operations of a loop iteration: 8 chains of 4 multiply-adds, each of two.
const OPERATIONS: f64 = 64.0;
/// Invocations of the first dispatch. It is doubled until a dispatch lasts long enough to be
/// measured.
const FIRST: u32 = 64 * WORKGROUP;
/// A card of 50,000 lanes has work for many rounds of them.
const MOST: u32 = 1 << 22;
/// Seconds that a dispatch lasts at least, if that many invocations do.
const LONG: f64 = 0.02;
/// Dispatches of that length; the fastest counts, for others may share the device.
const REPEATS: usize = 4;

/// Floating-point operations a second (a multiply-add is two).
pub(super) fn peak(device: &Device, precision: Precision) -> Result<f64, BackendError> {
    let source = Source::new(&[
        Fragment {
            name: "constants",
            text: format!(
                "alias real = {};\nconst ROUNDS: u32 = {ROUNDS}u;\nconst WORKGROUP: u32 = {WORKGROUP}u;\n",
                precision.name()
            ),
        },
        Fragment {
            name: "shaders/peak.wgsl",
            text: include_str!("../../../shaders/peak.wgsl").to_owned(),
        },
    ]);
    source.validate(device.info.f64_arithmetic)?;
    let module = device
        .device
        .create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some("peak"),
            source: wgpu::ShaderSource::Wgsl(source.text.into()),
        });
    let pipeline = device
        .device
        .create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some("peak"),
            layout: None,
            module: &module,
            entry_point: Some("main"),
            compilation_options: Default::default(),
            cache: None,
        });
    device.check()?;
    let groups = device.device.limits().max_compute_workgroups_per_dimension;
    let most = MOST.min(groups.saturating_mul(WORKGROUP));
    let probe = Probe {
        device,
        precision,
        pipeline,
        clock: Clock::new(device),
    };
    let mut invocations = FIRST.min(most);
    let mut rate = 0.0f64;
    let mut long = 0;
    while long < REPEATS {
        let seconds = probe.seconds(invocations)?;
        if seconds < LONG && invocations < most {
            invocations = (invocations * 2).min(most);
        } else {
            rate = rate.max(f64::from(invocations) * f64::from(ROUNDS) * OPERATIONS / seconds);
            long += 1;
        }
    }
    Ok(rate)
}

struct Probe<'a> {
    device: &'a Device,
    precision: Precision,
    pipeline: wgpu::ComputePipeline,
    clock: Option<Clock>,
}

impl Probe<'_> {
    /// Seconds of a dispatch.
    fn seconds(&self, invocations: u32) -> Result<f64, BackendError> {
        let device = &self.device.device;
        // The factor below 1 keeps the chains finite.
        let values = [0.999, 1e-3]
            .into_iter()
            .chain((0..invocations).map(|i| f64::from(i % 7)));
        let bytes = reals(values, self.precision);
        let size = (bytes.len() as u64).next_multiple_of(16);
        let buffer = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("peak"),
            size,
            usage: BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        let staging = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("peak"),
            size: 64,
            usage: BufferUsages::MAP_READ | BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &self.pipeline.get_bind_group_layout(0),
            entries: &[wgpu::BindGroupEntry {
                binding: 0,
                resource: buffer.as_entire_binding(),
            }],
        });
        self.device.queue.write_buffer(&buffer, 0, &bytes);
        // What is written waits for the next submission, which is not to be timed with it.
        read_back(
            self.device,
            &staging,
            device.create_command_encoder(&Default::default()),
            [(&buffer, 16)],
            |_| (),
        )?;
        let before = Instant::now();
        let mut encoder = device.create_command_encoder(&Default::default());
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                label: None,
                timestamp_writes: self.clock.as_ref().map(Clock::writes),
            });
            pass.set_pipeline(&self.pipeline);
            pass.set_bind_group(0, &group, &[]);
            pass.dispatch_workgroups(invocations.div_ceil(WORKGROUP), 1, 1);
        }
        let stamped = match &self.clock {
            Some(clock) => {
                let stamps = clock.resolve(&mut encoder);
                read_back(
                    self.device,
                    &staging,
                    encoder,
                    [(stamps, Clock::BYTES)],
                    |[b]| clock.seconds(b),
                )?
            }
            None => {
                read_back(self.device, &staging, encoder, [(&buffer, 16)], |_| ())?;
                0.0
            }
        };
        let waited = before.elapsed().as_secs_f64();
        // A clock that stands still tells nothing.
        Ok(if stamped > 0.0 { stamped } else { waited })
    }
}
