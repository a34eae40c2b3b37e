//! Newton's method for multiple shooting, all of it on the device: segments are integrated with their
//! variations by the kernel that does it elsewhere, `shaders/elimination.wgsl` eliminates, and
//! `shaders/newton_segments.wgsl` and `shaders/newton_paths.wgsl` stand between. Iterations are
//! submitted several at a time; in between nothing is read back.

use super::adapter::Device;
use super::elimination::{GpuEliminator, Layout};
use super::emit::{self, Settings, WORKGROUP};
use super::kernel::{GpuKernel, Pipelines, WORK, settings};
use super::memory::{
    Shape, bind, binding_limit, layout, most_buffers, pipelines, read_back, reals, staging,
    storage, uses,
};
use super::shader::{Fragment, Source, conditional};
use super::text::{self, literal};
use crate::backend::{BackendError, Newton, NewtonSpec, Refined, Run, Shots, Status};
use crate::model::Precision;
use std::fmt::Write;
use std::ops::Range;
use std::sync::Arc;

/// Iterations that are submitted at once, and submissions of them at most: the first one to the rough
/// tolerance.
const ITERATIONS: usize = 4;
const SUBMISSIONS: usize = 5;
/// Loop iterations that an invocation may spend on a path: half of what Mesa's llvmpipe allows.
const MOST_ON_PATH: usize = 32768;

/// Codes of verdicts.
const OPEN: u32 = 0;
const SOLVED: u32 = 1;
const FAILED: u32 = 2;

/// Buffers of its own, in the order of their bindings on both sides.
const SEGMENTS_SIDE: usize = 8;
const SEGMENTS_WRITTEN: [usize; 4] = [3, 4, 5, 7];
const PATHS_SIDE: usize = 8;
const PATHS_WRITTEN: [usize; 5] = [1, 2, 4, 6, 7];

pub(super) struct GpuNewton {
    device: Arc<Device>,
    spec: NewtonSpec,
    kernel: GpuKernel,
    eliminator: GpuEliminator,
    layout: Layout,
    segments_side: Side<3>,
    paths_side: Side<2>,
    memory: Option<Memory>,
}

/// The pipelines over segments, or over paths.
struct Side<const K: usize> {
    layout: wgpu::BindGroupLayout,
    pipelines: [wgpu::ComputePipeline; K],
}

impl<const K: usize> Side<K> {
    fn new(
        device: &Device,
        spec: &NewtonSpec,
        text: String,
        (buffers, written): (usize, &[usize]),
        entries: [&'static str; K],
    ) -> Result<Self, BackendError> {
        let source = Source::new(&[
            Fragment {
                name: "constants",
                text: constants(spec),
            },
            Fragment {
                name: "shaders/real.wgsl",
                text: conditional(
                    include_str!("../../../shaders/real.wgsl"),
                    &[text::condition(spec.varied.precision)],
                ),
            },
            Fragment {
                name: "shaders/newton",
                text,
            },
        ]);
        source.validate(device.info.f64_arithmetic)?;
        let layout = layout(device, "newton", uses(buffers, written));
        let descriptor = wgpu::ShaderModuleDescriptor {
            label: Some("newton"),
            source: wgpu::ShaderSource::Wgsl(source.text.into()),
        };
        // SAFETY: loops have the bounds of the path's nodes or of a node's components, and indices
        // stay within the buffers, which are bound with the sizes of the batch.
        let module = unsafe {
            (device.device)
                .create_shader_module_trusted(descriptor, wgpu::ShaderRuntimeChecks::unchecked())
        };
        let pipelines = pipelines(device, &[&layout], &module, entries);
        Ok(Self { layout, pipelines })
    }
}

/// The generated constants of both modules.
fn constants(spec: &NewtonSpec) -> String {
    let precision = spec.varied.precision;
    let n = spec.states;
    let places = Layout::new(n, precision);
    let mut constants = text::constants(precision);
    for (name, value) in [
        ("N", n),
        ("M", 2 * n),
        ("GROUPS", spec.groups()),
        ("SEGMENT", places.segment()),
        ("DEFECT", places.defect()),
        ("CONDITION", places.condition()),
        ("HESSIAN", n),
        ("WANTED", places.wanted()),
        ("NODE", places.node()),
        ("STEP", places.step()),
        ("OPEN", OPEN as usize),
        ("SOLVED", SOLVED as usize),
        ("FAILED", FAILED as usize),
        ("REACHED", Status::Reached as usize),
        ("WORKGROUP", WORKGROUP as usize),
    ] {
        let _ = writeln!(constants, "const {name}: u32 = {value}u;");
    }
    for (name, value) in [("GROWTH", spec.most_growth), ("MOST_STEP", spec.most_step)] {
        let value = literal(value, precision);
        let _ = writeln!(constants, "const {name}: real = {value};");
    }
    constants
}

/// Device buffers, kept from batch to batch.
struct Memory {
    room: [usize; OWN],
    table: wgpu::Buffer,
    nodes: wgpu::Buffer,
    given: wgpu::Buffer,
    verdicts: wgpu::Buffer,
    model: wgpu::Buffer,
    segments: wgpu::Buffer,
    conditions: wgpu::Buffer,
    eliminated: wgpu::Buffer,
    progress: wgpu::Buffer,
    norms: wgpu::Buffer,
    staging: wgpu::Buffer,
}

const OWN: usize = 10;

impl Memory {
    fn new(device: &Device, room: [usize; OWN]) -> Self {
        let [
            table,
            nodes,
            given,
            verdicts,
            model,
            segments,
            conditions,
            eliminated,
            progress,
            norms,
        ] = room.map(|bytes| storage(device, "newton", bytes));
        Self {
            table,
            nodes,
            given,
            verdicts,
            model,
            segments,
            conditions,
            eliminated,
            progress,
            norms,
            staging: staging(device, "newton", room[1] + room[3] + 32),
            room,
        }
    }
}

impl GpuNewton {
    /// `None` where the device cannot bind so many buffers, or one node takes more loop iterations
    /// than a dispatch may.
    pub fn new(device: Arc<Device>, spec: &NewtonSpec) -> Result<Option<Self>, BackendError> {
        let precision = spec.varied.precision;
        let eliminator = GpuEliminator::new(Arc::clone(&device), spec.states, precision)?;
        let Some(eliminator) = eliminator.filter(|_| most_buffers(&device) >= SEGMENTS_SIDE) else {
            return Ok(None);
        };
        let segments_side = Side::new(
            &device,
            spec,
            include_str!("../../../shaders/newton_segments.wgsl").to_owned(),
            (SEGMENTS_SIDE, &SEGMENTS_WRITTEN),
            ["prepare", "leave_out", "collect"],
        )?;
        let paths_side = Side::new(
            &device,
            spec,
            include_str!("../../../shaders/newton_paths.wgsl").to_owned(),
            (PATHS_SIDE, &PATHS_WRITTEN),
            ["open", "update"],
        )?;
        device.check()?;
        Ok(Some(Self {
            kernel: GpuKernel::new(Arc::clone(&device), spec.varied.clone())?,
            layout: Layout::new(spec.states, precision),
            device,
            spec: spec.clone(),
            eliminator,
            segments_side,
            paths_side,
            memory: None,
        }))
    }

    /// What the integrator's buffers follow from.
    fn shape(&self, segments: usize) -> Shape {
        let varied = &self.spec.varied;
        let run = &self.spec.runs[0];
        Shape {
            trajectories: segments * self.spec.groups(),
            dim: varied.dim(),
            state: emit::state(varied),
            levels: 0,
            sample: 1 + emit::stored(varied).count(),
            settings: Settings::new(varied.dim(), run.variant()).levels + run.levels.len().max(1),
            real: varied.precision.bytes(),
        }
    }

    /// Bytes of the largest binding's share of a path.
    fn share(&self, segments: usize) -> usize {
        let integrated = self.shape(1).largest_share() * segments * self.spec.groups();
        integrated.max(self.layout.share(segments))
    }

    /// Whether a path is short enough for one invocation.
    fn takes(&self, segments: usize) -> bool {
        (segments + 1) * 4 * self.spec.states <= MOST_ON_PATH
            && self.share(segments) as u64 <= binding_limit(&self.device)
    }

    /// What the host puts into the buffers, in the order of [`Memory`], and their sizes: the device
    /// fills the others.
    fn contents(
        &self,
        shots: &Shots,
        paths: &Range<usize>,
        at: [usize; 2],
    ) -> ([Option<Vec<u8>>; OWN], [usize; OWN]) {
        let (spec, n) = (&self.spec, self.spec.states);
        let precision = spec.varied.precision;
        let lengths = &shots.segments[paths.clone()];
        let count = lengths.iter().sum::<u32>() as usize;
        let mut table = vec![n as u32, 0];
        let mut first = 0;
        for length in lengths {
            table.extend([*length, first]);
            first += length;
        }
        let owners = (lengths.iter().zip(0u32..))
            .flat_map(|(length, path)| std::iter::repeat_n(path, *length as usize));
        table.extend(owners);
        let nodes = &shots.nodes[at[1] * 2 * n..][..(count + lengths.len()) * 2 * n];
        let durations = &shots.durations[at[0]..][..count];
        let given = spec.scales.iter().chain(durations).copied();
        let of_path = paths.clone().flat_map(|i| {
            let lists = [&shots.ends, &shots.gradients, &shots.goals];
            lists
                .into_iter()
                .flat_map(move |list| list[i * n..][..n].iter().copied())
        });
        // The tolerance is set later.
        let model = std::iter::once(0.0)
            .chain(spec.scales.iter().copied())
            .chain(of_path);
        let conditions = paths.clone().flat_map(|i| {
            let nothing = || std::iter::repeat_n(0.0, n);
            let hessian = shots.hessians[i * n * n..][..n * n].iter().copied();
            nothing().chain(hessian).chain(nothing())
        });
        let real = precision.bytes();
        let contents = [
            Some(bytemuck::cast_slice(&table).to_vec()),
            Some(reals(nodes.iter().copied(), precision)),
            Some(reals(given, precision)),
            Some(vec![0; 8 * lengths.len()]),
            Some(reals(model, precision)),
            None,
            Some(reals(conditions, precision)),
            None,
            None,
            None,
        ];
        let mut bytes = contents.each_ref().map(|c| c.as_ref().map_or(0, Vec::len));
        bytes[5] = count * self.layout.segment() * real;
        bytes[7] = (count + lengths.len()) * self.layout.node() * real;
        bytes[8] = 8 * lengths.len();
        bytes[9] = lengths.len() * real;
        (contents, bytes)
    }

    /// Iterates the paths of a part of a batch, whose first segment and node are at `at`.
    fn part(
        &mut self,
        shots: &Shots,
        paths: Range<usize>,
        at: [usize; 2],
        result: &mut Refined,
    ) -> Result<(), BackendError> {
        let (contents, bytes) = self.contents(shots, &paths, at);
        let lengths = &shots.segments[paths.clone()];
        let segments = lengths.iter().sum::<u32>() as usize;
        let shape = self.shape(segments);
        let key = self.kernel.prepare(&self.spec.runs[0])?;
        self.kernel.allocate(shape)?;
        let room = bytes.map(|bytes| bytes.max(16));
        let fits = |m: &Memory| m.room.iter().zip(&room).all(|(has, needs)| has >= needs);
        if !self.memory.as_ref().is_some_and(fits) {
            self.memory = None;
            self.memory = Some(Memory::new(&self.device, room));
            self.device.check()?;
        }
        let (Some(own), Some(integrator)) = (&self.memory, self.kernel.made(key)) else {
            return Err(BackendError::Unwritten { index: paths.start });
        };
        let part = Part {
            newton: self,
            own,
            integrator,
            paths: lengths.len() as u32,
            segments: segments as u32,
            longest: lengths.iter().copied().max().unwrap_or(0),
            bytes,
        };
        part.upload(&contents, shape);
        let precision = self.spec.varied.precision;
        for k in 0..SUBMISSIONS {
            // What may go on from the rough tolerance needs no look.
            let stage = usize::from(k > 0);
            part.set(&self.spec.runs[stage], self.spec.tolerances[stage]);
            let encoder = part.iterations(k <= 1);
            if k == 0 {
                self.device.queue.submit([encoder.finish()]);
                continue;
            }
            let (nodes, verdicts) = part.read(encoder)?;
            let verdicts: &[u32] = bytemuck::cast_slice(&verdicts);
            let is_open = verdicts.chunks_exact(2).any(|v| v[0] == OPEN);
            if is_open && k + 1 < SUBMISSIONS {
                continue;
            }
            for verdict in verdicts.chunks_exact(2) {
                result.solved.push(verdict[0] == SOLVED);
                result.iterations.push(verdict[1]);
            }
            match precision {
                Precision::F32 => (result.nodes).extend(
                    bytemuck::cast_slice::<u8, f32>(&nodes)
                        .iter()
                        .map(|x| f64::from(*x)),
                ),
                Precision::F64 => {
                    result.nodes.extend_from_slice(bytemuck::cast_slice(&nodes));
                }
            }
            break;
        }
        Ok(())
    }
}

/// Paths of a batch that are iterated together.
struct Part<'p> {
    newton: &'p GpuNewton,
    own: &'p Memory,
    integrator: (&'p super::memory::Memory, &'p Pipelines),
    paths: u32,
    segments: u32,
    /// Segments of the longest path.
    longest: u32,
    /// Bytes in use of each buffer of [`Memory`].
    bytes: [usize; OWN],
}

impl Part<'_> {
    fn upload(&self, contents: &[Option<Vec<u8>>; OWN], shape: Shape) {
        let (queue, own) = (&self.newton.device.queue, self.own);
        let buffers = [
            &own.table,
            &own.nodes,
            &own.given,
            &own.verdicts,
            &own.model,
            &own.segments,
            &own.conditions,
            &own.eliminated,
            &own.progress,
            &own.norms,
        ];
        for (buffer, content) in buffers.into_iter().zip(contents) {
            if let Some(content) = content {
                queue.write_buffer(buffer, 0, content);
            }
        }
        let run = &self.newton.spec.runs[0];
        let count = shape.trajectories as u32;
        let control = [count, 0, count, *WORK.end() as u32, run.max_steps, 1];
        queue.write_buffer(
            &self.integrator.0.control,
            0,
            bytemuck::cast_slice(&control),
        );
    }

    /// Sets the tolerances of segments and of the paths for what is submitted next.
    fn set(&self, run: &Run, tolerance: f64) {
        let (newton, precision) = (self.newton, self.newton.spec.varied.precision);
        let set = reals(settings(&newton.spec.varied, run, &run.levels), precision);
        let queue = &newton.device.queue;
        queue.write_buffer(&self.integrator.0.settings, 0, &set);
        queue.write_buffer(&self.own.model, 0, &reals([tolerance], precision));
    }

    /// Some iterations of all paths; `opens` begins a stage.
    fn iterations(&self, opens: bool) -> wgpu::CommandEncoder {
        let (newton, own, (memory, integrator)) = (self.newton, self.own, self.integrator);
        let device = &newton.device;
        let [
            table,
            nodes,
            given,
            verdicts,
            model,
            segments,
            conditions,
            eliminated,
            progress,
            norms,
        ] = self.bytes.map(Some);
        let over_segments = bind(
            device,
            &newton.segments_side.layout,
            [
                (&own.table, table),
                (&own.nodes, nodes),
                (&own.given, given),
                (&own.verdicts, verdicts),
                (&memory.state, None),
                (&memory.counters, None),
                (&memory.ends, None),
                (&own.segments, segments),
            ],
        );
        let over_paths = bind(
            device,
            &newton.paths_side.layout,
            [
                (&own.table, table),
                (&own.nodes, nodes),
                (&own.verdicts, verdicts),
                (&own.model, model),
                (&own.conditions, conditions),
                (&own.eliminated, eliminated),
                (&own.progress, progress),
                (&own.norms, norms),
            ],
        );
        let elimination = newton.eliminator.bound([
            (&own.table, table),
            (&own.progress, progress),
            (&own.segments, segments),
            (&own.conditions, conditions),
            (&own.eliminated, eliminated),
        ]);
        let groups = |count: u32| count.div_ceil(WORKGROUP);
        let lanes = groups(self.segments * newton.spec.groups() as u32);
        let paths = groups(self.paths);
        let [prepare, leave_out, collect] = &newton.segments_side.pipelines;
        let [open, update] = &newton.paths_side.pipelines;

        let mut encoder = device.device.create_command_encoder(&Default::default());
        for k in 0..ITERATIONS {
            encoder.clear_buffer(&memory.remaining, 0, None);
            let mut pass = encoder.begin_compute_pass(&Default::default());
            let mut over = |pipeline, bindings, count| {
                pass.set_pipeline(pipeline);
                pass.set_bind_group(0, bindings, &[]);
                pass.dispatch_workgroups(count, 1, 1);
            };
            if opens && k == 0 {
                over(open, &over_paths, paths);
            }
            over(prepare, &over_segments, lanes);
            over(&integrator.start, &memory.bindings, lanes);
            over(leave_out, &over_segments, lanes);
            over(&integrator.sweep, &memory.bindings, lanes);
            over(collect, &over_segments, lanes);
            for pipeline in newton.eliminator.pipelines() {
                for _ in 0..newton.eliminator.rounds(self.longest) {
                    over(pipeline, &elimination, paths);
                }
            }
            over(update, &over_paths, paths);
        }
        encoder
    }

    /// Nodes and verdicts when what `encoder` holds is done.
    ///
    /// # Errors
    /// Device failures.
    fn read(&self, encoder: wgpu::CommandEncoder) -> Result<(Vec<u8>, Vec<u8>), BackendError> {
        let wanted = [
            (&self.own.nodes, self.bytes[1]),
            (&self.own.verdicts, self.bytes[3]),
        ];
        let device = &self.newton.device;
        read_back(
            device,
            &self.own.staging,
            encoder,
            wanted,
            |[nodes, verdicts]| (nodes.to_vec(), verdicts.to_vec()),
        )
    }
}

impl Newton for GpuNewton {
    fn solve(&mut self, shots: &Shots) -> Result<Refined, BackendError> {
        let mut result = Refined::default();
        let limit = binding_limit(&self.device) as usize;
        let limits = self.device.device.limits();
        let most = limits.max_compute_workgroups_per_dimension as usize * WORKGROUP as usize;
        let count = shots.segments.len();
        let n2 = 2 * self.spec.states;
        let mut start = 0;
        // First segment and node of the part.
        let mut at = [0, 0];
        while start < count {
            let length = |i: usize| shots.segments[i] as usize;
            if !self.takes(length(start)) {
                let nodes = &shots.nodes[at[1] * n2..][..(length(start) + 1) * n2];
                result.nodes.extend_from_slice(nodes);
                result.solved.push(false);
                result.iterations.push(0);
                at = [at[0] + length(start), at[1] + length(start) + 1];
                start += 1;
                continue;
            }
            let (mut next, mut segments, mut bytes) = (start, 0, 0);
            while next < count && self.takes(length(next)) {
                let share = self.share(length(next));
                let lanes = (segments + length(next)) * self.spec.groups();
                if next > start && (bytes + share > limit || lanes > most) {
                    break;
                }
                bytes += share;
                segments += length(next);
                next += 1;
            }
            self.part(shots, start..next, at, &mut result)?;
            at = [at[0] + segments, at[1] + segments + next - start];
            start = next;
        }
        Ok(result)
    }
}
