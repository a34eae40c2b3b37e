//! Backends integrate batches of trajectories: seeds in; end states, stored samples, status and
//! counters out.
//!
//! [`cpu`] and `gpu` (a feature) implement the same traits and never import each other. What a batch
//! does not ask for is not in its program: a [`Spec`] without guards or stored samples compiles to a
//! kernel without them.

pub mod adapters;
pub mod constants;
pub mod cpu;
pub mod flops;
#[cfg(feature = "gpu")]
pub mod gpu;

use crate::model::{Method, Precision};
use crate::program::Program;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// What a kernel is compiled for.
#[derive(Clone, Debug)]
pub struct Spec {
    /// Derivatives of the integrated vector; its inputs are the first `rate.inputs` components, its
    /// outputs all.
    pub rate: Program,
    /// Guard values of the same inputs, where the scene has guards.
    pub guards: Option<Guards>,
    /// Values of the same inputs at whose zeros the rate has a kink, where it has any: adaptive
    /// steps are made to end there, so that no step's error estimate is fooled by one inside.
    pub kinks: Option<Program>,
    pub method: Method,
    pub precision: Precision,
    /// The coordinate whose levels are sampled and end a trajectory.
    pub by: By,
    /// Whether the points at all levels are kept, or only the end.
    pub store: bool,
}

/// Guards of a [`Spec`]: outputs that must be positive (`strict`) or not negative.
#[derive(Clone, Debug)]
pub struct Guards {
    pub program: Program,
    pub strict: Vec<bool>,
}

/// The coordinate along a trajectory that its levels refer to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum By {
    /// Backward time.
    Time,
    /// A component of the integrated vector (V, or arc length).
    Component(usize),
}

impl Spec {
    /// Components of the integrated vector.
    pub fn dim(&self) -> usize {
        self.rate.outputs.len()
    }

    /// Whether a component never changes: its rate is the number 0.
    pub fn is_constant(&self, component: usize) -> bool {
        self.rate.code[self.rate.outputs[component] as usize] == crate::program::Instr::Const(0.0)
    }
}

/// What one batch is integrated with.
#[derive(Clone, Debug)]
pub struct Run {
    pub rtol: f64,
    /// Absolute tolerance a component.
    pub atol: Vec<f64>,
    /// Step of a fixed-step method.
    pub step: f64,
    /// Step that an adaptive Runge-Kutta method tries first, or the whole way where that is
    /// shorter; else it is chosen from the seed's size and speed. For short ways that one step may
    /// well take.
    pub first: Option<f64>,
    /// Attempted steps after which a trajectory is given up.
    pub max_steps: u32,
    /// Levels of the sampling coordinate, ascending; the last one ends a trajectory.
    pub levels: Vec<f64>,
    /// A trajectory also ends, as reached, where this component passes this value (not located).
    pub ceiling: Option<(usize, f64)>,
    /// `[lower, upper]` of the leading components; outside a trajectory has left the region. May be
    /// empty.
    pub bounds: Vec<[f64; 2]>,
}

/// What a run, beyond its [`Spec`], asks of generated code.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Variant {
    /// Leading components with bounds.
    pub bounds: usize,
    /// Component with a ceiling.
    pub ceiling: Option<usize>,
}

impl Run {
    pub fn variant(&self) -> Variant {
        Variant {
            bounds: self.bounds.len(),
            ceiling: self.ceiling.map(|(c, _)| c),
        }
    }
}

/// How a trajectory ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[repr(i32)]
pub enum Status {
    /// The last level was reached.
    Reached = 0,
    /// It left the region, its margin included.
    LeftRegion = 1,
    /// It met a guard.
    Guard = 2,
    /// The step size fell below its floor.
    StepFloor = 3,
    /// The step limit was used up.
    StepLimit = 4,
    /// No finite step could be taken.
    NotFinite = 5,
}

impl Status {
    /// Ends that say nothing about the problem but that the integration could not go on.
    pub const FAILURES: [Status; 3] = [Status::StepFloor, Status::StepLimit, Status::NotFinite];

    pub const ALL: [(Status, &'static str); 6] = [
        (Status::Reached, "reached"),
        (Status::LeftRegion, "left_region"),
        (Status::Guard, "guard"),
        (Status::StepFloor, "step_floor"),
        (Status::StepLimit, "step_limit"),
        (Status::NotFinite, "not_finite"),
    ];

    pub fn name(self) -> &'static str {
        Status::ALL
            .iter()
            .find(|(s, _)| *s == self)
            .map_or("?", |(_, n)| n)
    }

    /// The status with this number, as kernels write it.
    pub fn from_code(code: i32) -> Option<Self> {
        Status::ALL
            .iter()
            .map(|(s, _)| *s)
            .find(|s| *s as i32 == code)
    }
}

/// Result of one batch; trajectory-major. Values are f64 whatever the kernel's precision.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trajectories {
    /// Components of the integrated vector.
    pub dim: usize,
    /// Levels a trajectory; 0 where samples were not stored.
    pub levels: usize,
    /// `[trajectory][dim]`: the last point.
    pub end: Vec<f64>,
    /// Backward time of the last point.
    pub end_time: Vec<f64>,
    pub status: Vec<Status>,
    /// Accepted and rejected steps.
    pub steps: Vec<u32>,
    pub rejected: Vec<u32>,
    /// Steps that lanes were computed for, those with nothing to do included; 0 where the device
    /// does not tell.
    pub lane_steps: u64,
    /// `[trajectory][level][1 + dim]`: backward time and vector at each level; NaN where a level
    /// was not passed.
    pub samples: Vec<f64>,
}

impl Trajectories {
    /// Makes room for a batch. What is there is left as it is: a kernel writes all of it.
    pub(crate) fn shape(&mut self, count: usize, dim: usize, levels: usize) {
        self.dim = dim;
        self.levels = levels;
        self.lane_steps = 0;
        self.end.resize(count * dim, f64::NAN);
        self.end_time.resize(count, f64::NAN);
        self.status.resize(count, Status::NotFinite);
        self.steps.resize(count, 0);
        self.rejected.resize(count, 0);
        self.samples.resize(count * levels * (1 + dim), f64::NAN);
    }

    pub fn count(&self) -> usize {
        self.status.len()
    }

    /// Share of the lanes' steps that were steps of a trajectory; none where the device does not
    /// tell.
    pub fn occupancy(&self) -> Option<f64> {
        let taken: u64 = self
            .steps
            .iter()
            .chain(&self.rejected)
            .map(|s| u64::from(*s))
            .sum();
        (self.lane_steps > 0).then(|| taken as f64 / self.lane_steps as f64)
    }

    /// Backward time and vector of trajectory `i` at level `k`; the time is NaN where the level was
    /// not passed.
    pub fn sample(&self, i: usize, k: usize) -> &[f64] {
        let width = 1 + self.dim;
        let start = (i * self.levels + k) * width;
        &self.samples[start..start + width]
    }
}

/// Set-up and device failures; a trajectory that fails is a [`Status`], not an error.
#[derive(Debug, thiserror::Error)]
pub enum BackendError {
    #[error(
        "no GPU adapter was found (a software one such as Mesa's llvmpipe will do, or use --backend cpu)"
    )]
    NoAdapter,
    #[error("this was built without the feature `gpu`; use --backend cpu, or build it with `gpu`")]
    NotBuilt,
    #[error("no adapter's name contains `{wanted}`; found: {found}")]
    NoSuchAdapter { wanted: String, found: String },
    #[error("adapter `{adapter}` has no f64 arithmetic; use --precision f32 or --backend cpu")]
    NoF64 { adapter: String },
    #[cfg(feature = "gpu")]
    #[error("the adapter refused a device: {0}")]
    Device(#[from] wgpu::RequestDeviceError),
    #[error("generated shader does not validate, in {fragment} line {line}: {message}")]
    Shader {
        fragment: String,
        line: usize,
        message: String,
    },
    #[cfg(feature = "gpu")]
    #[error("GPU work was lost: {0}")]
    Lost(#[from] wgpu::PollError),
    #[cfg(feature = "gpu")]
    #[error("a GPU buffer could not be read: {0}")]
    Map(#[from] wgpu::BufferAsyncError),
    #[error("the GPU device reported: {message}")]
    Fault { message: String },
    #[error(
        "the equations take {operations} operations, and a GPU kernel at most {limit}; use --backend cpu"
    )]
    TooLong { operations: usize, limit: usize },
    /// Those that solve for the states of a map elsewhere could not.
    #[error("the workers that the states of the map were sent to have failed: {why}")]
    Workers {
        /// What they say.
        why: String,
    },
    /// Bytes of another version of the program, or of no program.
    #[error("{what}: the same version must be on all machines")]
    Foreign {
        /// Which.
        what: &'static str,
    },
    #[error("kernel output slot {index} was not written")]
    Unwritten { index: usize },
    #[error(
        "one trajectory of {bytes} bytes does not fit the adapter's limit of {limit} bytes a buffer; ask for fewer samples"
    )]
    TooLarge { bytes: u64, limit: u64 },
    #[error(
        "what a sweep had set aside in the directory for temporary files could not be read again: {0}"
    )]
    SetAside(std::io::Error),
    /// Work with a [`Deadline`] was given up; what it had found is lost.
    #[error("the time given is over")]
    OutOfTime,
}

impl BackendError {
    /// Whether what was asked for is at fault: no machine would do it.
    #[must_use]
    pub fn is_of_input(&self) -> bool {
        matches!(self, Self::NoSuchAdapter { .. })
    }
}

/// When work is given up: at an instant, or once a flag is set. Loops look at it where they hand
/// work to a device.
#[derive(Clone, Copy, Debug, Default)]
pub struct Deadline {
    end: Option<Instant>,
    stop: Option<&'static AtomicBool>,
}

impl Deadline {
    /// At this instant; never without one.
    #[must_use]
    pub fn at(end: Option<Instant>) -> Self {
        Self { end, stop: None }
    }

    /// When so much time has passed from now.
    #[must_use]
    pub fn after(time: Duration) -> Self {
        Self::at(Instant::now().checked_add(time))
    }

    /// So many seconds after an instant; `None` where that is more than a clock tells.
    #[must_use]
    pub fn instant(begin: Instant, seconds: f64) -> Option<Instant> {
        begin.checked_add(Duration::try_from_secs_f64(seconds).ok()?)
    }

    /// Once this is set, too.
    #[must_use]
    pub fn or_once(self, stop: &'static AtomicBool) -> Self {
        Self {
            stop: Some(stop),
            ..self
        }
    }

    /// Not later than at this instant.
    #[must_use]
    pub fn by(self, end: Option<Instant>) -> Self {
        let sooner = match (self.end, end) {
            (Some(a), Some(b)) => Some(a.min(b)),
            (a, b) => a.or(b),
        };
        Self {
            end: sooner,
            ..self
        }
    }

    /// Whether work is to be given up.
    #[must_use]
    pub fn has_passed(self) -> bool {
        self.end.is_some_and(|end| Instant::now() > end)
            || self.stop.is_some_and(|stop| stop.load(Ordering::Relaxed))
    }

    /// # Errors
    /// [`BackendError::OutOfTime`] once it has passed.
    pub fn check(self) -> Result<(), BackendError> {
        match self.has_passed() {
            true => Err(BackendError::OutOfTime),
            false => Ok(()),
        }
    }
}

/// Something that can compile kernels.
pub trait Backend: Send + Sync {
    /// `cpu` or `gpu`.
    fn name(&self) -> &'static str;
    /// The device, in words.
    fn adapter(&self) -> String;
    /// This device for what is no kernel, where it is a GPU.
    #[cfg(feature = "gpu")]
    fn gpu(&self) -> Option<&gpu::Gpu> {
        None
    }
    /// Whether kernels can ask a [`Surface`] themselves.
    fn asks_surfaces(&self) -> bool {
        false
    }
    /// Whether kernels of this precision can be made.
    fn supports(&self, precision: Precision) -> bool;
    /// Whether kernels of this method can be made.
    fn offers(&self, method: Method) -> bool;
    /// Whether this method may be chosen where none is asked for.
    fn favours(&self, method: Method) -> bool {
        self.offers(method)
    }
    /// Operations of a right-hand side up to which it is worth its compilation that a kernel does
    /// more at once.
    fn longest(&self) -> usize {
        12_000
    }
    /// # Errors
    /// When the precision is not supported or the generated code is refused.
    fn compile(&self, spec: &Spec) -> Result<Box<dyn Kernel>, BackendError>;
    /// Block elimination of multiple-shooting equations with `states` states on the device; `None`
    /// where the host is to do it.
    ///
    /// # Errors
    /// When the precision is not supported or the generated code is refused.
    fn eliminator(
        &self,
        states: usize,
        precision: Precision,
    ) -> Result<Option<Box<dyn Eliminator>>, BackendError> {
        let _ = (states, precision);
        Ok(None)
    }
    /// Newton's method for multiple shooting, on the device as a whole; `None` where the host is to
    /// lead it.
    ///
    /// # Errors
    /// When the precision is not supported or the generated code is refused.
    fn newton(&self, spec: &NewtonSpec) -> Result<Option<Box<dyn Newton>>, BackendError> {
        let _ = spec;
        Ok(None)
    }
    /// Floating-point operations a second that the device was measured to do (a multiply-add is
    /// two); `None` where that is not known.
    ///
    /// # Errors
    /// When the precision is not supported, and device failures.
    fn peak(&self, precision: Precision) -> Result<Option<f64>, BackendError> {
        let _ = precision;
        Ok(None)
    }
}

/// The linearized multiple-shooting equations of some paths (see [`crate::shooting::Factors`],
/// which is the reference and gives the formulas). All arrays row-major, in scaled units; segments
/// and nodes of the paths follow each other.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Systems {
    /// n; a node has 2n components.
    pub states: usize,
    /// Segments of each path; it has one node more.
    pub segments: Vec<u32>,
    /// `[segment][2n x 2n]`: propagators.
    pub phi: Vec<f64>,
    /// `[segment][2n]`.
    pub defects: Vec<f64>,
    /// `[path][n]`: the end's residual `g(s) - p`.
    pub end: Vec<f64>,
    /// `[path][n x n]`: `dg/ds` at the end.
    pub hessian: Vec<f64>,
    /// `[path][n]`: s-part of the first node's step.
    pub wanted: Vec<f64>,
}

/// What an elimination gives. A path whose equations are singular has steps that are not finite.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Eliminated {
    /// `[node][n x 2n]`: orthonormal rows.
    pub w: Vec<f64>,
    /// `[node][n x n]`: lower triangular.
    pub l: Vec<f64>,
    /// `[node][2n]`: Newton's steps.
    pub steps: Vec<f64>,
}

/// Eliminates batches of linearized equations on a device.
pub trait Eliminator: Send {
    /// A path's result does not depend on the others.
    ///
    /// # Errors
    /// Device failures only.
    fn eliminate(&mut self, systems: &Systems) -> Result<Eliminated, BackendError>;
}

/// The equations of paths, for Newton's method on a device.
#[derive(Clone, Debug)]
pub struct NewtonSpec {
    /// Segments with a group of variation columns each: `(y, D, r, columns)`, see
    /// [`crate::shooting::Equations`].
    pub varied: Spec,
    /// Settings of the integration, first for rough segments.
    pub runs: [Run; 2],
    /// Relative size of the last step with each of them.
    pub tolerances: [f64; 2],
    /// n, and variation columns of a group.
    pub states: usize,
    pub columns: usize,
    /// Scale of each component of a node.
    pub scales: Vec<f64>,
    /// Largest entry of a propagator, and longest step in units of the path's size: where they are
    /// exceeded the device gives the path up.
    pub most_growth: f64,
    pub most_step: f64,
}

impl NewtonSpec {
    /// Groups of columns of a segment.
    #[must_use]
    pub fn groups(&self) -> usize {
        2 * self.states / self.columns
    }
}

/// First guesses for boundary value problems with a given first state. Arrays row-major, in physical
/// units but for slopes; segments and nodes of the paths follow each other.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shots {
    /// Segments of each path; it has one node more.
    pub segments: Vec<u32>,
    /// `[node][2n]`: deviations and adjoints.
    pub nodes: Vec<f64>,
    /// `[segment]`.
    pub durations: Vec<f64>,
    /// `[path][n]`: the state of the first node.
    pub goals: Vec<f64>,
    /// `[path][n]`: a state near the last node's, the adjoint g that the end's condition has there,
    /// and `[path][n x n]` its slope `dg/ds`, scaled.
    pub ends: Vec<f64>,
    pub gradients: Vec<f64>,
    pub hessians: Vec<f64>,
}

/// What Newton's method on a device made of [`Shots`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Refined {
    /// `[node][2n]`, of paths that were not solved of no use.
    pub nodes: Vec<f64>,
    /// Whether each path met the tolerance, with the end's condition as it was given.
    pub solved: Vec<bool>,
    /// Iterations of each path.
    pub iterations: Vec<u32>,
}

/// Newton's method without damping over batches of paths on a device.
pub trait Newton: Send {
    /// A path's result does not depend on the others.
    ///
    /// # Errors
    /// Device failures only.
    fn solve(&mut self, shots: &Shots) -> Result<Refined, BackendError>;
}

/// A kernel on the calling thread, with a run: many short legs of few trajectories.
pub trait Legs: Sync {
    /// As [`Kernel::integrate`], bit by bit, without stored samples; `to` is overwritten and its
    /// memory used again.
    fn integrate(&self, seeds: &[f64], to: &mut Trajectories);
}

/// A value function as kernels on a device ask for it themselves: text with a function `chart`, and
/// the arrays that it reads (see `shaders/pieces.wgsl`).
#[derive(Debug)]
#[cfg_attr(not(feature = "gpu"), expect(dead_code, reason = "only a GPU asks it"))]
pub struct Surface {
    #[cfg(feature = "gpu")]
    pub(crate) fragments: Vec<gpu::shader::Fragment>,
    pub(crate) reals: Vec<f64>,
    pub(crate) words: Vec<u32>,
    /// States that it is a function of.
    pub(crate) states: usize,
    /// The last time at which it is asked, where time is an argument of it.
    pub(crate) last: Option<f64>,
}

/// Trajectories to be flown over legs of one length, each from the beginning of one of them; the
/// vector is `(s, q, H, ...)` with H's upper triangle row by row, and p = q + H s is set at the
/// beginning of each leg.
#[derive(Debug, Default)]
pub struct Course {
    /// Legs of a trajectory in all.
    pub legs: usize,
    /// `[trajectory][dim]`.
    pub vectors: Vec<f64>,
    /// The leg that each is at the beginning of.
    pub first: Vec<u32>,
    /// Whether q and H of that leg are those of the vector; else the surface is asked.
    pub given: Vec<bool>,
    /// Of how many, the first ones, the beginnings of legs are told.
    pub traced: usize,
}

/// Why a trajectory of a [`Course`] went no further.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Halt {
    /// With its last leg, or within the one told.
    Ended(Status),
    /// The surface has no answer at the beginning of the leg told.
    Lost,
    /// At the beginning of the leg told there was no room to tell of it.
    Paused,
}

/// How trajectories of a [`Course`] went.
#[derive(Debug, Default)]
pub struct Flown {
    /// `[trajectory][dim]`: where it halted.
    pub end: Vec<f64>,
    /// Since the beginning of the leg.
    pub time: Vec<f64>,
    pub halt: Vec<Halt>,
    pub leg: Vec<u32>,
    /// Legs begun.
    pub begun: Vec<u32>,
    /// `[trajectory][dim]`: as the leg last begun began; only where a trajectory met the step
    /// limit.
    pub begin: Vec<f64>,
    /// `[traced trajectory][leg of this flight][dim + 1]`: the vector as the leg began, and V,
    /// which is not a number where the law was given. What was not begun holds nothing.
    pub rows: Vec<f64>,
    /// Legs that `rows` has room for.
    pub room: usize,
    /// How often the host waited for the device.
    pub waits: usize,
}

/// Flies closed loops leg by leg on a device that asks the law's surface itself.
pub trait Relay: Send {
    /// Each trajectory up to its end, its first leg without an answer or as far as there is room.
    /// How one goes does not depend on the others.
    ///
    /// # Errors
    /// Device failures only.
    fn fly(&mut self, run: &Run, course: &Course) -> Result<Flown, BackendError>;
}

/// A compiled kernel.
pub trait Kernel: Send {
    /// Integrates `seeds` (`[trajectory][dim]`, f64 whatever the precision) as one batch. The
    /// caller bounds the batch (see [`batch_limit`]); a trajectory's result does not depend on the
    /// batch it is in. `to` is overwritten, and its memory used again.
    ///
    /// # Errors
    /// Device failures only.
    fn integrate_into(
        &mut self,
        run: &Run,
        seeds: &[f64],
        to: &mut Trajectories,
    ) -> Result<(), BackendError>;

    /// [`Kernel::integrate_into`], with memory of its own.
    ///
    /// # Errors
    /// Device failures only.
    fn integrate(&mut self, run: &Run, seeds: &[f64]) -> Result<Trajectories, BackendError> {
        let mut batch = Trajectories::default();
        self.integrate_into(run, seeds, &mut batch)?;
        Ok(batch)
    }

    /// The same kernel with memory of its own, for another thread; `None` of a device.
    fn fork(&self) -> Option<Box<dyn Kernel>> {
        None
    }

    /// Trajectories a batch from which on larger ones are no faster.
    fn preferred_batch(&self) -> usize {
        usize::MAX
    }

    /// The kernel for callers that spread trajectories over threads themselves, for one run; `None`
    /// of a device that takes a batch as a whole.
    fn legs<'k>(&'k mut self, run: &'k Run) -> Option<Box<dyn Legs + 'k>> {
        let _ = run;
        None
    }

    /// The same equations, leg by leg under the law of a surface (with the bounds of `run`); `None`
    /// of a device that does not ask itself, or for which the surface is too large.
    ///
    /// # Errors
    /// When the generated code is refused; device failures.
    fn relay(&self, run: &Run, surface: &Surface) -> Result<Option<Box<dyn Relay>>, BackendError> {
        let _ = (run, surface);
        Ok(None)
    }

    /// Bytes of generated code of what was compiled so far: machine code, or the text of shaders.
    /// `None` where nothing was generated.
    fn code_bytes(&self) -> Option<usize> {
        None
    }

    /// Seconds of the latest [`Kernel::integrate`] in which trajectories were computed: without
    /// transfers, waiting for a device and the host's own work. `None` where that is not known.
    fn kernel_seconds(&self) -> Option<f64> {
        None
    }
}

/// Trajectories a batch so that its results stay within about 64 MiB.
pub fn batch_limit(dim: usize, stored_levels: usize) -> usize {
    const BYTES: usize = 64 << 20;
    (BYTES / (8 * (dim + 1) * (stored_levels + 2))).clamp(1, 65536)
}
