//! Closed loops leg by leg on the device, which asks a map itself: `shaders/legs.wgsl`.

use super::adapter::Device;
use super::emit::{self, Emitter, Law, Settings, WORKGROUP};
use super::kernel::{DISPATCH_SECONDS, FIRST_WORK, WORK, bindings, integrator, settings};
use super::memory::{
    Use, bind, binding_limit, buffer, filled, layout, most_buffers, padded, pipelines, read_back,
    reals, staging, storage,
};
use super::shader::{Fragment, Source};
use super::{ASK, GIVEN, LOST, PAUSED};
use crate::backend::{BackendError, Course, Flown, Halt, Relay, Run, Spec, Status, Surface};
use crate::model::Precision;
use std::sync::Arc;
use std::time::Instant;
use wgpu::{Buffer, BufferUsages};

/// Fields of the counters.
const COUNTERS: usize = 6;
/// Bytes of the control uniform.
const CONTROL: usize = 48;
/// Storage buffers of the kernel: those of an integrator, and the map's.
const BUFFERS: usize = 9;
/// Dispatches that the host does not look between: also the shortest legs take two, to be flown and
/// to be found the last known.
const LEAST_REPEATS: f64 = 4.0;
const MOST_REPEATS: f64 = 64.0;
/// Results up to so many bytes are read whenever the host looks, so that short flights take one
/// look.
const READ_EARLY: usize = 1 << 20;
/// Bytes of what is told of the legs of a flight.
const TOLD: usize = 64 << 20;

/// Sizes that the buffers follow from.
#[derive(Clone, Copy, Debug, Default)]
struct Shape {
    trajectories: usize,
    /// Bytes of the traces.
    traces: usize,
}

#[derive(Debug)]
struct Memory {
    shape: Shape,
    control: Buffer,
    settings: Buffer,
    state: Buffer,
    counters: Buffer,
    lists: Buffer,
    remaining: Buffer,
    ends: Buffer,
    traces: Buffer,
    staging: Buffer,
    bindings: wgpu::BindGroup,
}

pub(super) struct GpuRelay {
    device: Arc<Device>,
    spec: Spec,
    layout: wgpu::BindGroupLayout,
    sweep: wgpu::ComputePipeline,
    gather: wgpu::ComputePipeline,
    /// The map's arrays.
    surface: wgpu::BindGroup,
    settings: usize,
    memory: Option<Memory>,
    /// Loop iterations a second over all trajectories, as measured so far.
    speed: Option<f64>,
}

impl GpuRelay {
    pub fn new(
        device: Arc<Device>,
        spec: &Spec,
        run: &Run,
        surface: &Surface,
    ) -> Result<Option<Self>, BackendError> {
        let contents = [
            reals(surface.reals.iter().copied(), spec.precision),
            bytemuck::cast_slice(&surface.words).to_vec(),
        ];
        let largest = contents.iter().map(Vec::len).max().unwrap_or(0) as u64;
        if most_buffers(&device) < BUFFERS || largest > binding_limit(&device) || spec.store {
            return Ok(None);
        }
        let law = Law {
            states: surface.states,
            last: surface.last,
        };
        let scheme = spec.method.scheme(run.rtol);
        let emitter = Emitter::new(spec, scheme, run.variant()).with_legs(law);
        let mut fragments = integrator(&emitter)?.to_vec();
        fragments.extend(surface.fragments.iter().cloned());
        fragments.push(Fragment {
            name: "shaders/legs.wgsl",
            text: include_str!("../../../shaders/legs.wgsl").to_owned(),
        });
        let source = Source::new(&fragments);
        source.validate(device.info.f64_arithmetic)?;
        let descriptor = wgpu::ShaderModuleDescriptor {
            label: Some("relay"),
            source: wgpu::ShaderSource::Wgsl(source.text.into()),
        };
        // SAFETY: the shader's loops are bounded by counters of their own or by the tables of the
        // map, whose tree has an end everywhere; its indices stay within the buffers: trajectories
        // below the stride and rows below the room that the buffers were sized for, places in the
        // map's arrays where these were packed.
        let module = unsafe {
            (device.device)
                .create_shader_module_trusted(descriptor, wgpu::ShaderRuntimeChecks::unchecked())
        };
        let own = layout(&device, "relay", bindings(true));
        let map = layout(&device, "map", [Use::Read; 2]);
        let [sweep, gather] = pipelines(&device, &[&own, &map], &module, ["sweep", "gather"]);
        let held = contents.map(|bytes| filled(&device, "map", &bytes));
        let surface = bind(&device, &map, held.iter().map(|b| (b, None)));
        device.check()?;
        Ok(Some(Self {
            settings: Settings::new(spec.dim(), run.variant()).levels + 1,
            device,
            spec: spec.clone(),
            layout: own,
            sweep,
            gather,
            surface,
            memory: None,
            speed: None,
        }))
    }

    /// Reals of a trajectory's state: that of an integrator, and its vector as the leg began.
    fn state(&self) -> usize {
        emit::state(&self.spec) + self.spec.dim()
    }

    fn memory(&self, shape: Shape) -> Memory {
        let (device, real) = (&*self.device, self.spec.precision.bytes());
        let count = shape.trajectories;
        let storage = |label, bytes| storage(device, label, bytes);
        let control = buffer(
            device,
            "control",
            CONTROL,
            BufferUsages::UNIFORM | BufferUsages::COPY_DST,
        );
        let settings = storage("settings", self.settings * real);
        let state = storage("state", self.state() * count * real);
        let counters = storage("counters", 4 * COUNTERS * count);
        let lists = storage("lists", 8 * count);
        let remaining = storage("remaining", 4);
        let ends = storage("ends", self.ends(count));
        let traces = storage("traces", shape.traces);
        let told = padded(4)
            + padded(4 * COUNTERS * count)
            + padded(self.ends(count))
            + padded(shape.traces);
        let staging = staging(
            device,
            "staging",
            told.max(padded(self.state() * count * real)),
        );
        let bound = [
            &control, &settings, &state, &counters, &lists, &remaining, &ends, &traces,
        ];
        let bindings = bind(device, &self.layout, bound.map(|b| (b, None)));
        Memory {
            shape,
            control,
            settings,
            state,
            counters,
            lists,
            remaining,
            ends,
            traces,
            staging,
            bindings,
        }
    }

    fn ends(&self, count: usize) -> usize {
        (self.spec.dim() + 1) * count * self.spec.precision.bytes()
    }

    /// Loop iterations of a submission in which so many trajectories are on their way.
    fn work(&self, active: u32) -> f64 {
        let first = f64::from(FIRST_WORK);
        self.speed.map_or(first, |speed| {
            bounded(speed * DISPATCH_SECONDS / f64::from(active))
        })
    }

    /// Legs of which there is room to tell.
    fn room(&self, course: &Course) -> usize {
        let first = course.first.iter().copied().min().unwrap_or(0) as usize;
        let left = course.legs.saturating_sub(first).max(1);
        let leg = course.traced * (self.spec.dim() + 1) * self.spec.precision.bytes();
        let most = TOLD.min(binding_limit(&self.device) as usize);
        (most / leg.max(1)).clamp(1, left)
    }

    /// Whether the device can hold, and dispatch, so much at once.
    ///
    /// # Errors
    /// [`BackendError::TooLarge`].
    fn check_size(&self, shape: Shape) -> Result<(), BackendError> {
        let (count, real) = (shape.trajectories, self.spec.precision.bytes());
        let bytes = (self.state() * count * real) as u64;
        let limit = binding_limit(&self.device);
        let groups = (self.device.device.limits()).max_compute_workgroups_per_dimension;
        if bytes.max(shape.traces as u64) > limit
            || count.div_ceil(WORKGROUP as usize) > groups as usize
        {
            return Err(BackendError::TooLarge { bytes, limit });
        }
        Ok(())
    }

    /// Makes the buffers at least so large.
    ///
    /// # Errors
    /// Device failures.
    fn allocate(&mut self, shape: Shape) -> Result<(), BackendError> {
        let holds = |m: &Memory| {
            m.shape.trajectories >= shape.trajectories && m.shape.traces >= shape.traces
        };
        if self.memory.as_ref().is_some_and(holds) {
            return Ok(());
        }
        // Freed first: both need not fit.
        let had = self.memory.take().map_or(Shape::default(), |m| m.shape);
        self.memory = Some(self.memory(Shape {
            trajectories: shape.trajectories.max(had.trajectories),
            traces: shape.traces.max(had.traces),
        }));
        self.device.check()
    }
}

fn bounded(work: f64) -> f64 {
    work.clamp(f64::from(FIRST_WORK), WORK.end() * MOST_REPEATS)
}

impl Relay for GpuRelay {
    fn fly(&mut self, run: &Run, course: &Course) -> Result<Flown, BackendError> {
        let (dim, count) = (self.spec.dim(), course.first.len());
        if count == 0 {
            return Ok(Flown::default());
        }
        let room = self.room(course);
        let shape = Shape {
            trajectories: count,
            traces: course.traced * room * (dim + 1) * self.spec.precision.bytes(),
        };
        self.check_size(shape)?;
        self.allocate(shape)?;
        let Some(memory) = &self.memory else {
            return Err(BackendError::Unwritten { index: 0 });
        };
        let flight = Flight {
            relay: self,
            memory,
            run,
            course,
            shape,
            room,
        };
        flight.upload();
        let (flown, speed) = flight.fly()?;
        self.speed = speed;
        Ok(flown)
    }
}

/// A course that is flown.
struct Flight<'f> {
    relay: &'f GpuRelay,
    memory: &'f Memory,
    run: &'f Run,
    course: &'f Course,
    shape: Shape,
    /// Legs of which there is room to tell.
    room: usize,
}

impl Flight<'_> {
    /// Writes settings, vectors and counters to the device.
    fn upload(&self) {
        let (spec, memory, course) = (&self.relay.spec, self.memory, self.course);
        let (queue, precision) = (&self.relay.device.queue, spec.precision);
        let (dim, count) = (spec.dim(), self.shape.trajectories);
        let set = settings(spec, self.run, &self.run.levels);
        queue.write_buffer(&memory.settings, 0, &reals(set, precision));
        let by_field = (0..dim).flat_map(|c| course.vectors.iter().skip(c).step_by(dim).copied());
        queue.write_buffer(&memory.state, 0, &reals(by_field, precision));
        let mut counters = vec![0u32; COUNTERS * count];
        for (i, given) in course.given.iter().enumerate() {
            counters[i] = if *given { GIVEN } else { ASK };
            counters[4 * count + i] = course.first[i];
        }
        queue.write_buffer(&memory.counters, 0, bytemuck::cast_slice(&counters));
        let all: Vec<u32> = (0..count as u32).collect();
        queue.write_buffer(&memory.lists, 0, bytemuck::cast_slice(&all));
        // Sentinels: a slot that still holds one at the end was not written.
        queue.write_buffer(&memory.ends, 0, &vec![0xff; self.relay.ends(count)]);
    }

    /// Submits work until no trajectory is on its way. Returns how they went, and the loop
    /// iterations a second over all trajectories as measured last.
    ///
    /// # Errors
    /// Device failures, and results that were not written.
    fn fly(&self) -> Result<(Flown, Option<f64>), BackendError> {
        let (mut active, mut list, mut waits) = (self.shape.trajectories as u32, 0u32, 0);
        let early = self.results().iter().map(|(_, bytes)| bytes).sum::<usize>() <= READ_EARLY;
        let mut flown = None;
        let mut work = self.relay.work(active);
        let mut speed = self.relay.speed;
        while active > 0 {
            let before = Instant::now();
            let submission = self.submission(active, list, work);
            let left;
            (left, flown) = self.wait(submission, early)?;
            waits += 1;
            let seconds = before.elapsed().as_secs_f64();
            if 2 * left >= active {
                // Where most went on this much was done; else the speed would be said to be higher
                // than it is.
                speed = Some(work * f64::from(active) / seconds);
            }
            let share = f64::from(active) / f64::from(left.max(1));
            work = bounded(work * (DISPATCH_SECONDS / seconds).min(4.0) * share.min(4.0));
            (active, list) = (left, 1 - list);
        }
        let mut flown = match flown {
            Some(flown) => flown,
            None => {
                waits += 1;
                self.read(self.encoder(), self.results(), |all| self.told(all))??
            }
        };
        flown.room = self.room;
        if flown.halt.contains(&Halt::Ended(Status::StepLimit)) {
            flown.begin = self.begin()?;
            waits += 1;
        }
        flown.waits = waits;
        Ok((flown, speed))
    }

    fn encoder(&self) -> wgpu::CommandEncoder {
        let device = &self.relay.device.device;
        device.create_command_encoder(&Default::default())
    }

    /// The dispatches of `work` loop iterations for those of a list that are on their way, and the
    /// gathering of who still is.
    fn submission(&self, active: u32, list: u32, work: f64) -> wgpu::CommandEncoder {
        let (queue, memory, course) = (&self.relay.device.queue, self.memory, self.course);
        let repeats = (work / WORK.end())
            .ceil()
            .clamp(LEAST_REPEATS, MOST_REPEATS);
        let control = [
            active,
            list,
            self.shape.trajectories as u32,
            (work / repeats).max(*WORK.start()) as u32,
            self.run.max_steps,
            1,
            course.legs as u32,
            self.room as u32,
            course.traced as u32,
        ];
        queue.write_buffer(&memory.control, 0, bytemuck::cast_slice(&control));
        queue.write_buffer(&memory.remaining, 0, &[0; 4]);
        let mut encoder = self.encoder();
        {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            pass.set_bind_group(0, &memory.bindings, &[]);
            pass.set_bind_group(1, &self.relay.surface, &[]);
            pass.set_pipeline(&self.relay.sweep);
            for _ in 0..repeats as u32 {
                pass.dispatch_workgroups(active.div_ceil(WORKGROUP), 1, 1);
            }
            pass.set_pipeline(&self.relay.gather);
            pass.dispatch_workgroups(active.div_ceil(WORKGROUP), 1, 1);
        }
        encoder
    }

    /// Waits for a submission: how many trajectories are still on their way, and with `early` the
    /// results, where none is.
    fn wait(
        &self,
        submission: wgpu::CommandEncoder,
        early: bool,
    ) -> Result<(u32, Option<Flown>), BackendError> {
        let number = |b: &[u8]| u32::from_ne_bytes([b[0], b[1], b[2], b[3]]);
        let remaining = (&self.memory.remaining, 4);
        if !early {
            let left = self.read(submission, [remaining], |[left]| number(left))?;
            return Ok((left, None));
        }
        let [counters, ends, rows] = self.results();
        let wanted = [remaining, counters, ends, rows];
        let (left, flown) = self.read(submission, wanted, |[left, counters, ends, rows]| {
            let left = number(left);
            (left, (left == 0).then(|| self.told([counters, ends, rows])))
        })?;
        Ok((left, flown.transpose()?))
    }

    /// Buffers with the results, and their bytes.
    fn results(&self) -> [(&Buffer, usize); 3] {
        let count = self.shape.trajectories;
        [
            (&self.memory.counters, 4 * COUNTERS * count),
            (&self.memory.ends, self.relay.ends(count)),
            (&self.memory.traces, self.shape.traces),
        ]
    }

    fn told(&self, [counters, ends, rows]: [&[u8]; 3]) -> Result<Flown, BackendError> {
        let spec = &self.relay.spec;
        let counters = bytemuck::cast_slice(counters);
        told(counters, ends, rows, spec.precision, spec.dim())
    }

    /// The vectors as the leg last begun began, `[trajectory][dim]`.
    fn begin(&self) -> Result<Vec<f64>, BackendError> {
        let (spec, count) = (&self.relay.spec, self.shape.trajectories);
        let (dim, precision) = (spec.dim(), spec.precision);
        let wanted = (
            &self.memory.state,
            self.relay.state() * count * precision.bytes(),
        );
        let state = self.read(self.encoder(), [wanted], |[state]| {
            numbers(state, precision)
        })?;
        let first = emit::state(spec);
        Ok((0..count * dim)
            .map(|k| state[(first + k % dim) * count + k / dim])
            .collect())
    }

    /// Reads the leading bytes of buffers when what `encoder` holds is done; see [`read_back`].
    fn read<const N: usize, R>(
        &self,
        encoder: wgpu::CommandEncoder,
        wanted: [(&Buffer, usize); N],
        read: impl FnOnce([&[u8]; N]) -> R,
    ) -> Result<R, BackendError> {
        let staging = &self.memory.staging;
        read_back(&self.relay.device, staging, encoder, wanted, read)
    }
}

/// Takes apart what the device wrote; see `shaders/legs.wgsl`.
fn told(
    counters: &[u32],
    ends: &[u8],
    rows: &[u8],
    precision: Precision,
    dim: usize,
) -> Result<Flown, BackendError> {
    let count = counters.len() / COUNTERS;
    let field = |k: usize| &counters[k * count..][..count];
    let unwritten = |slot: &[u8]| slot.iter().all(|byte| *byte == 0xff);
    if let Some(slot) = ends.chunks_exact(precision.bytes()).position(unwritten) {
        return Err(BackendError::Unwritten {
            index: slot % count,
        });
    }
    let halt = (field(0).iter().enumerate())
        .map(|(index, code)| match *code {
            LOST => Ok(Halt::Lost),
            PAUSED => Ok(Halt::Paused),
            code => (i32::try_from(code).ok().and_then(Status::from_code))
                .map(Halt::Ended)
                .ok_or(BackendError::Unwritten { index }),
        })
        .collect::<Result<_, _>>()?;
    let ends = numbers(ends, precision);
    Ok(Flown {
        end: (0..count * dim)
            .map(|k| ends[(k % dim) * count + k / dim])
            .collect(),
        time: ends[dim * count..].to_vec(),
        halt,
        leg: field(4).to_vec(),
        begun: field(5).to_vec(),
        rows: numbers(rows, precision),
        ..Flown::default()
    })
}

fn numbers(bytes: &[u8], precision: Precision) -> Vec<f64> {
    match precision {
        Precision::F32 => bytes
            .chunks_exact(4)
            .map(|b| f64::from(bytemuck::pod_read_unaligned::<f32>(b)))
            .collect(),
        Precision::F64 => bytes
            .chunks_exact(8)
            .map(bytemuck::pod_read_unaligned)
            .collect(),
    }
}
