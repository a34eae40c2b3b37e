//! The iteration on a GPU in f32: `shaders/dynamic_programming.wgsl` joined with the scene's
//! programs as generated text.

use super::equations::Equations;
use super::level::{Candidate, Iteration, Level, Stride};
use crate::backend::BackendError;
use crate::backend::gpu::adapter::Device;
use crate::backend::gpu::emit::WORKGROUP;
use crate::backend::gpu::memory::{
    bind, binding_limit, layout, pipelines, read_back, staging, storage, uses,
};
use crate::backend::gpu::shader::{Fragment, Source, conditional};
use crate::backend::gpu::{Gpu, text};
use crate::model::Precision;
use crate::program::Program;
use std::fmt::Write;
use std::sync::Arc;

const BINDINGS: usize = 8;
/// Bindings that kernels write.
const WRITTEN: [usize; 3] = [2, 4, 5];
/// Integers up to which f32 holds them all: the shader reads numbers of nodes as such.
const MOST_NODES: usize = 1 << f32::MANTISSA_DIGITS;
/// Candidates of a round at most.
const MOST_CANDIDATES: usize = 64;
/// Bytes of a candidate.
const CANDIDATE: usize = 16;
/// Dispatches that wait in one submission at most.
const DISPATCHES: usize = 8;

/// The kernels of a scene.
pub(super) struct Kernels {
    device: Arc<Device>,
    layout: wgpu::BindGroupLayout,
    improve: wgpu::ComputePipeline,
    accept: wgpu::ComputePipeline,
    evaluate: wgpu::ComputePipeline,
}

impl Kernels {
    /// # Errors
    /// A shader that the device refuses.
    pub fn new(gpu: &Gpu, equations: &Equations) -> Result<Self, BackendError> {
        let device = gpu.device();
        let source = source(equations);
        source.validate(device.info.f64_arithmetic)?;
        let layout = layout(&device, "dynamic programming", uses(BINDINGS, &WRITTEN));
        let module = device
            .device
            .create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some("dynamic programming"),
                source: wgpu::ShaderSource::Wgsl(source.text.into()),
            });
        let [improve, accept, evaluate] = pipelines(
            &device,
            &[&layout],
            &module,
            ["improve", "accept", "evaluate"],
        );
        device.check()?;
        Ok(Self {
            device,
            layout,
            improve,
            accept,
            evaluate,
        })
    }
}

pub(super) struct GpuIteration<'a> {
    kernels: &'a Kernels,
    device: &'a Device,
    nodes: usize,
    controls: usize,
    /// Two of each: read from and written to by turns, the present one first.
    values: [wgpu::Buffer; 2],
    policy: [wgpu::Buffer; 2],
    steps: wgpu::Buffer,
    known: wgpu::Buffer,
    given: wgpu::Buffer,
    candidates: wgpu::Buffer,
    staging: wgpu::Buffer,
}

impl<'a> GpuIteration<'a> {
    /// # Errors
    /// A lattice too large for the device.
    pub fn new(
        kernels: &'a Kernels,
        level: &Level,
        equations: &Equations,
    ) -> Result<Self, BackendError> {
        let device = &*kernels.device;
        let (n, m, nodes) = (equations.states, equations.controls, level.lattice.len());
        let largest = 4 * nodes * (n + 2).max(m);
        let limit = binding_limit(device);
        let groups = device.device.limits().max_compute_workgroups_per_dimension as usize;
        if largest as u64 > limit
            || nodes.div_ceil(WORKGROUP as usize) > groups
            || nodes > MOST_NODES
        {
            return Err(BackendError::TooLarge {
                bytes: largest as u64,
                limit,
            });
        }
        let buffer = |size: usize| storage(device, "dynamic programming", size);
        let staging = staging(device, "dynamic programming", 4 * nodes * m.max(1));
        let given: Vec<f32> = given(level, nodes * m).map(|x| x as f32).collect();
        let known: Vec<u32> = level.known.iter().map(|k| u32::from(*k)).collect();
        let this = Self {
            kernels,
            device,
            nodes,
            controls: m,
            values: [buffer(4 * nodes), buffer(4 * nodes)],
            policy: [buffer(4 * nodes * m), buffer(4 * nodes * m)],
            steps: buffer(4 * nodes * (n + 2)),
            known: buffer(4 * nodes),
            given: buffer(4 * given.len()),
            candidates: buffer(CANDIDATE * MOST_CANDIDATES),
            staging,
        };
        let write =
            |buffer: &wgpu::Buffer, bytes: &[u8]| device.queue.write_buffer(buffer, 0, bytes);
        write(&this.given, bytemuck::cast_slice(&given));
        write(&this.known, bytemuck::cast_slice(&known));
        // Sentinels: a slot that still holds one was not written.
        write(&this.values[1], &vec![0xff; 4 * nodes]);
        write(&this.policy[1], &vec![0xff; 4 * nodes * m]);
        write(&this.steps, &vec![0xff; 4 * nodes * (n + 2)]);
        Ok(this)
    }

    /// Runs a kernel once over all nodes, so many candidates being bound.
    fn dispatch(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        pipeline: &wgpu::ComputePipeline,
        candidates: usize,
    ) {
        let buffers = [
            &self.candidates,
            &self.values[0],
            &self.values[1],
            &self.policy[0],
            &self.policy[1],
            &self.steps,
            &self.known,
            &self.given,
        ];
        // As large as the list: the shader takes the number of candidates from it.
        let size = |k: usize| (k == 0).then_some(CANDIDATE * candidates.max(1));
        let sized = buffers
            .into_iter()
            .enumerate()
            .map(|(k, buffer)| (buffer, size(k)));
        let bindings = bind(self.device, &self.kernels.layout, sized);
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, &bindings, &[]);
        pass.dispatch_workgroups((self.nodes as u32).div_ceil(WORKGROUP), 1, 1);
    }

    fn read(&self, buffer: &wgpu::Buffer, count: usize) -> Result<Vec<f64>, BackendError> {
        let encoder = self
            .device
            .device
            .create_command_encoder(&Default::default());
        read_back(
            self.device,
            &self.staging,
            encoder,
            [(buffer, 4 * count)],
            |[bytes]| {
                let numbers: &[f32] = bytemuck::cast_slice(bytes);
                match numbers.iter().position(|x| x.to_bits() == u32::MAX) {
                    Some(index) => Err(BackendError::Unwritten { index }),
                    None => Ok(numbers.iter().map(|x| f64::from(*x)).collect()),
                }
            },
        )?
    }

    fn submit(&self, encoder: wgpu::CommandEncoder) -> Result<(), BackendError> {
        self.device.queue.submit([encoder.finish()]);
        self.device
            .device
            .poll(wgpu::PollType::wait_indefinitely())?;
        self.device.check()
    }
}

impl Iteration for GpuIteration<'_> {
    fn load(&mut self, values: &[f64], controls: &[f64]) -> Result<(), BackendError> {
        let write = |buffer: &wgpu::Buffer, numbers: &[f64]| {
            let numbers: Vec<f32> = numbers.iter().map(|x| *x as f32).collect();
            self.device
                .queue
                .write_buffer(buffer, 0, bytemuck::cast_slice(&numbers));
        };
        write(&self.values[0], values);
        write(&self.policy[0], controls);
        Ok(())
    }

    fn improve(&mut self, candidates: &[Candidate]) -> Result<(), BackendError> {
        let list: Vec<[u32; 4]> = candidates.iter().map(packed).collect();
        self.device
            .queue
            .write_buffer(&self.candidates, 0, bytemuck::cast_slice(&list));
        let mut encoder = self
            .device
            .device
            .create_command_encoder(&Default::default());
        self.dispatch(&mut encoder, &self.kernels.improve, list.len());
        self.policy.swap(0, 1);
        self.submit(encoder)
    }

    fn accept(&mut self) -> Result<(), BackendError> {
        let mut encoder = self
            .device
            .device
            .create_command_encoder(&Default::default());
        self.dispatch(&mut encoder, &self.kernels.accept, 1);
        self.values.swap(0, 1);
        self.submit(encoder)
    }

    fn evaluate(&mut self, times: usize) -> Result<(), BackendError> {
        for first in (0..times).step_by(DISPATCHES) {
            let mut encoder = self
                .device
                .device
                .create_command_encoder(&Default::default());
            for _ in first..times.min(first + DISPATCHES) {
                self.dispatch(&mut encoder, &self.kernels.evaluate, 1);
                self.values.swap(0, 1);
            }
            self.submit(encoder)?;
        }
        Ok(())
    }

    fn values(&self) -> Result<Vec<f64>, BackendError> {
        self.read(&self.values[0], self.nodes)
    }

    fn controls(&self) -> Result<Vec<f64>, BackendError> {
        self.read(&self.policy[0], self.nodes * self.controls)
    }
}

/// A candidate as the shader reads it: kind, index, direction, the bits of an f32.
fn packed(candidate: &Candidate) -> [u32; 4] {
    let bits = |x: f64| (x as f32).to_bits();
    match *candidate {
        Candidate::Present => [0, 0, 0, 0],
        Candidate::Costate(share) => [1, 0, 0, bits(share)],
        Candidate::Linear => [2, 0, 0, 0],
        Candidate::Neighbour { axis, forward } => [3, axis as u32, u32::from(forward), 0],
        Candidate::Spread(k) => [4, k as u32, 0, 0],
        Candidate::Moved { control, by } => [5, control as u32, 0, bits(by)],
    }
}

/// The level's settings in the order of `load_settings`, the linearization's controls (zeros where
/// there is none), the fixed set.
fn given(level: &Level, count: usize) -> impl Iterator<Item = f64> + '_ {
    let axes = &level.lattice.axes;
    let (cells, longest) = match level.stride {
        Stride::Cells { cells, longest } => (cells, longest),
        // No speed is as high as this.
        Stride::Fixed(time) => (f64::from(f32::MAX), time),
    };
    let numbers = [
        level.ceiling,
        cells,
        longest,
        level
            .bent_below
            .clamp(f64::from(f32::MIN), f64::from(f32::MAX)),
        level.lattice.len() as f64,
    ];
    let linear = level.linear.iter().flatten().copied();
    let missing = if level.linear.is_some() { 0 } else { count };
    (axes.iter().map(|a| a.first))
        .chain(axes.iter().map(|a| a.step))
        .chain(axes.iter().map(|a| a.count as f64))
        .chain(level.lattice.strides().iter().map(|s| *s as f64))
        .chain(axes.iter().map(|a| f64::from(u8::from(a.period.is_some()))))
        .chain(numbers)
        .chain(linear)
        .chain(std::iter::repeat_n(0.0, missing))
        .chain(level.spread.iter().flatten().copied())
}

/// Settings beside those of the axes, of which each has five.
const NUMBERS: usize = 5;

/// The whole text of a scene's module.
fn source(equations: &Equations) -> Source {
    Source::new(&[
        Fragment {
            name: "constants",
            text: constants(equations),
        },
        Fragment {
            name: "shaders/real.wgsl",
            text: conditional(include_str!("../../shaders/real.wgsl"), &["F32"]),
        },
        Fragment {
            name: "model",
            text: model(equations),
        },
        Fragment {
            name: "shaders/dynamic_programming.wgsl",
            text: include_str!("../../shaders/dynamic_programming.wgsl").to_owned(),
        },
    ])
}

fn real(x: f64) -> String {
    text::literal(x, Precision::F32)
}

fn constants(equations: &Equations) -> String {
    let mut out = text::constants(Precision::F32);
    let (n, m) = (equations.states, equations.controls);
    for (name, value) in [
        ("N", n),
        ("M", m),
        ("WIDTH", equations.width()),
        ("GUARDS", equations.strict.len()),
        ("SETTINGS", 5 * n + NUMBERS),
        ("WORKGROUP", WORKGROUP as usize),
    ] {
        let _ = writeln!(out, "const {name}: u32 = {value}u;");
    }
    // Beyond any lattice, and finite.
    let _ = writeln!(out, "const NOWHERE: f32 = {};", real(1e30));
    // Private variables: constants cannot be indexed by variables everywhere.
    let mut table = |name: &str, kind: &str, list: Vec<String>| {
        let (count, all) = (list.len(), list.join(", "));
        let _ = writeln!(
            out,
            "var<private> {name}: array<{kind}, {count}> = array<{kind}, {count}>({all});"
        );
    };
    let bounds = &equations.bounds;
    table(
        "lower_bound",
        "f32",
        bounds.iter().map(|b| real(b[0])).collect(),
    );
    table(
        "upper_bound",
        "f32",
        bounds.iter().map(|b| real(b[1])).collect(),
    );
    // An array has one element at least.
    let strict = equations
        .strict
        .iter()
        .chain(equations.strict.is_empty().then_some(&false));
    table(
        "guard_strict",
        "u32",
        strict.map(|s| format!("{}u", u32::from(*s))).collect(),
    );
    out
}

/// The programs, and functions that call them with arrays.
fn model(equations: &Equations) -> String {
    let mut out = String::new();
    let (n, m) = (equations.states, equations.controls);
    let programs: [(&str, &Program, usize, usize); 2] = [
        ("motion", &equations.motion, m, equations.width()),
        ("law", &equations.law, n, m),
    ];
    for (name, program, second, outputs) in programs {
        let (inputs, output) = (format!("{name}_inputs"), format!("{name}_outputs"));
        text::structure(&mut out, &inputs, n + second);
        text::structure(&mut out, &output, outputs);
        out += &text::function(name, program, &output, Precision::F32).replacen(
            "x: Inputs",
            &format!("x: {inputs}"),
            1,
        );
        let arguments: Vec<String> = (0..n)
            .map(|i| format!("s[{i}]"))
            .chain((0..second).map(|i| format!("z[{i}]")))
            .collect();
        let fields: Vec<String> = (0..outputs).map(|k| format!("v.c{k}")).collect();
        let _ = write!(
            out,
            "fn {name}_at(s: array<f32, {n}>, z: array<f32, {second}>) -> array<f32, {outputs}> {{\n    \
             let v = {name}({inputs}({}));\n    return array<f32, {outputs}>({});\n}}\n",
            arguments.join(", "),
            fields.join(", ")
        );
    }
    out
}
