//! Block elimination on the device: `shaders/elimination.wgsl`, one invocation a path.

use super::adapter::Device;
use super::emit::WORKGROUP;
use super::memory::{
    bind, binding_limit, layout, pipelines, read_back, reals, staging, storage, uses,
};
use super::shader::{Fragment, Source, conditional};
use super::text;
use crate::backend::{BackendError, Eliminated, Eliminator, Systems};
use crate::model::Precision;
use std::fmt::Write;
use std::ops::Range;
use std::sync::Arc;

/// Loop iterations an invocation may spend in a dispatch: half of what Mesa's llvmpipe allows a
/// shader.
const WORK: usize = 32768;

/// Sizes and places of things in the buffers, in reals.
#[derive(Clone, Copy, Debug)]
pub(super) struct Layout {
    n: usize,
    real: usize,
}

impl Layout {
    pub(super) fn new(n: usize, precision: Precision) -> Self {
        Self {
            n,
            real: precision.bytes(),
        }
    }

    /// Phi and the defect.
    pub(super) fn segment(self) -> usize {
        self.defect() + 2 * self.n
    }
    pub(super) fn defect(self) -> usize {
        4 * self.n * self.n
    }
    /// The end's residual, G, the s-part wanted.
    pub(super) fn condition(self) -> usize {
        self.wanted() + self.n
    }
    pub(super) fn wanted(self) -> usize {
        self.n + self.n * self.n
    }
    /// W, L, what the rows must give, the step.
    pub(super) fn node(self) -> usize {
        self.step() + 2 * self.n
    }
    fn lower(self) -> usize {
        2 * self.n * self.n
    }
    fn right(self) -> usize {
        3 * self.n * self.n
    }
    pub(super) fn step(self) -> usize {
        self.right() + self.n
    }

    /// Loop iterations of one node: the larger of those backward (product, Gram-Schmidt) and
    /// forward (the first node's equations, or a step).
    fn iterations(self) -> usize {
        let n = self.n;
        let backward = 8 * n * n * n + 12 * n * n + 8 * n;
        let forward = n * n * n + 12 * n * n + 8 * n;
        backward.max(forward)
    }

    /// Nodes an invocation takes in a dispatch; 0 where even one is too much.
    fn nodes(self) -> usize {
        WORK / self.iterations()
    }

    /// Bytes of the largest binding's share of a path.
    pub(super) fn share(self, segments: usize) -> usize {
        let reals = (segments * self.segment())
            .max((segments + 1) * self.node())
            .max(self.condition());
        reals * self.real
    }
}

/// The whole text of the module for `n` states.
fn source(layout: Layout, precision: Precision) -> Source {
    let n = layout.n;
    let mut constants = text::constants(precision);
    for (name, value) in [
        ("N", n),
        ("M", 2 * n),
        ("ROWS", 2 * n * n),
        ("SQUARE", n * n),
        ("SEGMENT", layout.segment()),
        ("DEFECT", layout.defect()),
        ("CONDITION", layout.condition()),
        ("HESSIAN", n),
        ("WANTED", layout.wanted()),
        ("NODE", layout.node()),
        ("LOWER", layout.lower()),
        ("RIGHT", layout.right()),
        ("STEP", layout.step()),
        ("NODES", layout.nodes()),
        ("WORKGROUP", WORKGROUP as usize),
    ] {
        let _ = writeln!(constants, "const {name}: u32 = {value}u;");
    }
    Source::new(&[
        Fragment {
            name: "constants",
            text: constants,
        },
        Fragment {
            name: "shaders/real.wgsl",
            text: conditional(
                include_str!("../../../shaders/real.wgsl"),
                &[text::condition(precision)],
            ),
        },
        Fragment {
            name: "shaders/elimination.wgsl",
            text: include_str!("../../../shaders/elimination.wgsl").to_owned(),
        },
    ])
}

pub(super) struct GpuEliminator {
    device: Arc<Device>,
    layout: Layout,
    precision: Precision,
    bindings: wgpu::BindGroupLayout,
    backward: wgpu::ComputePipeline,
    forward: wgpu::ComputePipeline,
    memory: Option<Memory>,
}

/// Device buffers, kept from batch to batch.
struct Memory {
    /// Buffers in the order of their bindings.
    buffers: [wgpu::Buffer; BINDINGS],
    staging: wgpu::Buffer,
    bytes: [usize; BINDINGS],
}

const BINDINGS: usize = 5;
/// The binding of the results.
const NODES: usize = 4;
/// Bindings that kernels write.
const WRITTEN: [usize; 2] = [1, NODES];

impl GpuEliminator {
    /// `None` where one node takes more loop iterations than a dispatch may.
    pub fn new(
        device: Arc<Device>,
        n: usize,
        precision: Precision,
    ) -> Result<Option<Self>, BackendError> {
        let sizes = Layout::new(n, precision);
        if n == 0 || sizes.nodes() == 0 {
            return Ok(None);
        }
        let source = source(sizes, precision);
        source.validate(device.info.f64_arithmetic)?;
        let bindings = layout(&device, "elimination", uses(BINDINGS, &WRITTEN));
        let descriptor = wgpu::ShaderModuleDescriptor {
            label: Some("elimination"),
            source: wgpu::ShaderSource::Wgsl(source.text.into()),
        };
        // SAFETY: the shader's loops have fixed bounds or those of the path's nodes, and its
        // indices stay within the buffers, which are bound with the sizes of the batch.
        let module = unsafe {
            (device.device)
                .create_shader_module_trusted(descriptor, wgpu::ShaderRuntimeChecks::unchecked())
        };
        let [backward, forward] =
            pipelines(&device, &[&bindings], &module, ["backward", "forward"]);
        device.check()?;
        Ok(Some(Self {
            device,
            layout: sizes,
            precision,
            bindings,
            backward,
            forward,
            memory: None,
        }))
    }

    /// Buffers bound for the pipelines, in the order of their bindings.
    pub fn bound(&self, buffers: [(&wgpu::Buffer, Option<usize>); BINDINGS]) -> wgpu::BindGroup {
        bind(&self.device, &self.bindings, buffers)
    }

    /// The pipelines, in the order in which each is to be dispatched for [`Self::rounds`].
    pub fn pipelines(&self) -> [&wgpu::ComputePipeline; 2] {
        [&self.backward, &self.forward]
    }

    /// Dispatches of each pipeline for paths of at most so many segments.
    pub fn rounds(&self, longest: u32) -> usize {
        (longest as usize + 1).div_ceil(self.layout.nodes())
    }

    /// What the buffers of a part of a batch hold before.
    fn contents(
        &self,
        systems: &Systems,
        paths: Range<usize>,
        first: usize,
    ) -> [Vec<u8>; BINDINGS] {
        let (layout, n, precision) = (self.layout, self.layout.n, self.precision);
        let lengths = &systems.segments[paths.clone()];
        let mut table = vec![n as u32, 0];
        let mut segments = 0;
        for length in lengths {
            table.extend([*length, segments]);
            segments += length;
        }
        let segments = segments as usize;
        let nodes = segments + lengths.len();
        let data = (first..first + segments).flat_map(|k| {
            let phi = &systems.phi[k * layout.defect()..][..layout.defect()];
            phi.iter()
                .chain(&systems.defects[k * 2 * n..][..2 * n])
                .copied()
        });
        let conditions = paths.flat_map(|i| {
            let hessian = &systems.hessian[i * n * n..][..n * n];
            let (end, wanted) = (&systems.end[i * n..][..n], &systems.wanted[i * n..][..n]);
            end.iter().chain(hessian).chain(wanted).copied()
        });
        // Sentinels: a slot that still holds one at the end was not written.
        [
            bytemuck::cast_slice(&table).to_vec(),
            vec![0; 8 * lengths.len()],
            reals(data, precision),
            reals(conditions, precision),
            vec![0xff; nodes * layout.node() * layout.real],
        ]
    }

    /// Eliminates the paths of a part of a batch; `first` is its first segment.
    fn part(
        &mut self,
        systems: &Systems,
        paths: Range<usize>,
        first: usize,
        result: &mut Eliminated,
    ) -> Result<(), BackendError> {
        let (layout, precision) = (self.layout, self.precision);
        let lengths = &systems.segments[paths.clone()];
        let contents = self.contents(systems, paths.clone(), first);
        let device = Arc::clone(&self.device);
        let sizes: [usize; BINDINGS] = std::array::from_fn(|k| contents[k].len().max(16));
        let fits = |m: &Memory| m.bytes.iter().zip(&sizes).all(|(has, needs)| has >= needs);
        if !self.memory.as_ref().is_some_and(fits) {
            // Freed first: both need not fit.
            self.memory = None;
            self.memory = Some(Memory::new(&device, sizes));
            device.check()?;
        }
        let Some(memory) = &self.memory else {
            return Err(BackendError::Unwritten { index: 0 });
        };
        for (buffer, content) in memory.buffers.iter().zip(&contents) {
            device.queue.write_buffer(buffer, 0, content);
        }
        // As large as the batch: the shader takes the number of paths from it.
        let sized = contents
            .iter()
            .map(|content| Some(content.len().max(layout.real)));
        let bindings = bind(&device, &self.bindings, memory.buffers.iter().zip(sized));
        let rounds = self.rounds(lengths.iter().copied().max().unwrap_or(0));
        let mut encoder = device.device.create_command_encoder(&Default::default());
        {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            pass.set_bind_group(0, &bindings, &[]);
            for pipeline in self.pipelines() {
                pass.set_pipeline(pipeline);
                for _ in 0..rounds {
                    pass.dispatch_workgroups((lengths.len() as u32).div_ceil(WORKGROUP), 1, 1);
                }
            }
        }
        let wanted = [(&memory.buffers[NODES], contents[NODES].len())];
        let first_node = first + paths.start;
        read_back(
            &device,
            &memory.staging,
            encoder,
            wanted,
            |[written]| match precision {
                Precision::F32 => unpack::<f32>(layout, written, first_node, result),
                Precision::F64 => unpack::<f64>(layout, written, first_node, result),
            },
        )?
    }
}

impl Memory {
    fn new(device: &Device, sizes: [usize; BINDINGS]) -> Self {
        Self {
            buffers: sizes.map(|size| storage(device, "elimination", size)),
            staging: staging(device, "elimination", sizes[NODES]),
            bytes: sizes,
        }
    }
}

/// Takes the nodes from `first` on apart.
fn unpack<T: bytemuck::Pod + Into<f64>>(
    layout: Layout,
    written: &[u8],
    first: usize,
    result: &mut Eliminated,
) -> Result<(), BackendError> {
    let unwritten = |slot: &[u8]| slot.iter().all(|byte| *byte == 0xff);
    if let Some(slot) = written.chunks_exact(layout.real).position(unwritten) {
        return Err(BackendError::Unwritten {
            index: first + slot / layout.node(),
        });
    }
    let n = layout.n;
    let nodes: &[T] = bytemuck::cast_slice(written);
    for (k, node) in nodes.chunks_exact(layout.node()).enumerate() {
        let put = |to: &mut [f64], from: usize, width: usize| {
            let to = &mut to[(first + k) * width..][..width];
            for (to, from) in to.iter_mut().zip(&node[from..]) {
                *to = (*from).into();
            }
        };
        put(&mut result.w, 0, 2 * n * n);
        put(&mut result.l, layout.lower(), n * n);
        put(&mut result.steps, layout.step(), 2 * n);
    }
    Ok(())
}

impl Eliminator for GpuEliminator {
    fn eliminate(&mut self, systems: &Systems) -> Result<Eliminated, BackendError> {
        let n = self.layout.n;
        let count = systems.segments.len();
        let nodes = systems
            .segments
            .iter()
            .map(|s| *s as usize + 1)
            .sum::<usize>();
        let mut result = Eliminated {
            w: vec![0.0; nodes * 2 * n * n],
            l: vec![0.0; nodes * n * n],
            steps: vec![0.0; nodes * 2 * n],
        };
        let limit = binding_limit(&self.device) as usize;
        let groups = self
            .device
            .device
            .limits()
            .max_compute_workgroups_per_dimension;
        let most_paths = groups as usize * WORKGROUP as usize;
        let (mut start, mut first) = (0, 0);
        while start < count {
            let (mut next, mut segments, mut bytes) = (start, 0, 0);
            while next < count && next - start < most_paths {
                let length = systems.segments[next] as usize;
                let share = self.layout.share(length);
                if share > limit {
                    return Err(BackendError::TooLarge {
                        bytes: share as u64,
                        limit: limit as u64,
                    });
                }
                if bytes + share > limit {
                    break;
                }
                bytes += share;
                segments += length;
                next += 1;
            }
            self.part(systems, start..next, first, &mut result)?;
            (start, first) = (next, first + segments);
        }
        Ok(result)
    }
}
