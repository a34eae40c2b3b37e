//! V on a grid by dynamic programming: a coarse second answer for up to four states, blind to
//! sheets, and first guesses for multiple shooting.
//!
//! A semi-Lagrangian scheme: `V(x) = min_u [cost of a step under u + V(where it ends)]`, with
//! values between nodes interpolated, and solved by policy iteration (infinite horizon) or backward
//! in time (finite). It needs no guess and knows nothing of extremals; so what it says of which
//! sheet is least does not rest on a search. The state is confined to the region and a margin: that
//! raises V where optimal trajectories would leave it. An error of interpolation of a few per cent
//! is in the nature of it.

mod cpu;
mod domain;
mod equations;
#[cfg(feature = "gpu")]
mod gpu;
mod greedy;
mod horizon;
mod lattice;
mod level;
mod stationary;

pub use lattice::{Axis, Lattice, MOST_STATES};

use crate::backend::{Backend, BackendError, Deadline};
use crate::hamiltonian::Hamiltonian;
use crate::model::Model;
use crate::shooting::End;
use crate::sweep::Plan;
use domain::Domain;
use equations::Equations;
use lattice::{Cell, interpolate, largest, slope};
use level::{Iteration, Level, Stride};
use std::time::{Duration, Instant};

/// Why there is no value on a grid.
#[derive(Debug, thiserror::Error)]
pub enum DpError {
    #[error("{states} states: values on a grid are for at most {MOST_STATES}")]
    TooManyStates { states: usize },
    #[error("values on a grid are for problems without disturbances")]
    Game,
    #[error("{given} numbers of nodes are given for {states} states")]
    Counts { given: usize, states: usize },
    #[error("the grid has no nodes, or the scene neither an equilibrium nor a terminal cost")]
    NoNodes,
    #[error("the time given ended before the initial time was reached")]
    OutOfTime,
    #[error(transparent)]
    Backend(#[from] BackendError),
}

/// Why a scene has no V on a grid; `place` is what asked for it.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    #[error(
        "{place}: the scene has disturbances, and V on a grid is for problems without (of a game no order of V says which sheet counts)"
    )]
    Game { place: String },
    #[error("{place}: the scene has {states} states, and V on a grid is for at most {MOST_STATES}")]
    TooManyStates { place: String, states: usize },
}

/// Refuses scenes that have no V on a grid.
///
/// # Errors
/// [`Refusal`].
pub fn refuse(model: &Model, place: &str) -> Result<(), Refusal> {
    let place = place.to_owned();
    let states = model.states.len();
    if model.is_game() {
        return Err(Refusal::Game { place });
    }
    if states > MOST_STATES {
        return Err(Refusal::TooManyStates { place, states });
    }
    Ok(())
}

/// How fine and how far the grid is.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Nodes along each axis, about: the reference becomes a node. Empty: by the number of states.
    pub nodes: Vec<usize>,
    /// Share of the usual numbers of nodes where none are given.
    pub share: f64,
    /// Widths of the region added on each side of axes that are not periodic.
    pub margin: f64,
    /// What the axes hold beside the region, before the margin, as deviations (see [`extent`]);
    /// empty: nothing.
    pub holds: Vec<[f64; 2]>,
    /// Seconds after which an infinite horizon's values are given as they are.
    pub budget_seconds: Option<f64>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            nodes: Vec::new(),
            share: 1.0,
            margin: 0.3,
            holds: Vec::new(),
            budget_seconds: None,
        }
    }
}

/// Where the iteration runs: on all cores in f64, or on the device of a GPU backend in f32.
#[derive(Clone, Copy)]
pub struct Device<'a>(Option<&'a dyn Backend>);

impl<'a> Device<'a> {
    /// All cores.
    pub fn cpu() -> Self {
        Self(None)
    }

    /// Where a backend computes.
    pub fn of(backend: &'a dyn Backend) -> Self {
        Self(Some(backend))
    }

    /// `cpu` or `gpu`.
    pub fn name(self) -> &'static str {
        if self.is_gpu() { "gpu" } else { "cpu" }
    }

    #[cfg(feature = "gpu")]
    fn is_gpu(self) -> bool {
        self.0.and_then(Backend::gpu).is_some()
    }

    #[cfg(not(feature = "gpu"))]
    fn is_gpu(self) -> bool {
        self.0.is_some_and(|backend| backend.name() == "gpu")
    }

    /// The device made ready for a scene.
    #[cfg(feature = "gpu")]
    fn runner(self, equations: &Equations) -> Result<Runner, DpError> {
        Ok(match self.0.and_then(Backend::gpu) {
            None => Runner::Cpu,
            Some(gpu) => Runner::Gpu(gpu::Kernels::new(gpu, equations)?),
        })
    }

    #[cfg(not(feature = "gpu"))]
    fn runner(self, _: &Equations) -> Result<Runner, DpError> {
        Ok(Runner::Cpu)
    }
}

/// From the least to the largest deviation of some states (`[state][n]`, absolute) along each axis.
pub fn extent(plan: &Plan, states: &[f64]) -> Vec<[f64; 2]> {
    let reference = &plan.system.reference;
    let along = |i: usize| {
        states
            .iter()
            .skip(i)
            .step_by(reference.len())
            .map(move |x| x - reference[i])
    };
    (0..reference.len())
        .map(|i| {
            along(i).fold([f64::INFINITY, f64::NEG_INFINITY], |[lo, hi], s| {
                [lo.min(s), hi.max(s)]
            })
        })
        .collect()
}

/// A device with what it needs for one scene.
enum Runner {
    Cpu,
    #[cfg(feature = "gpu")]
    Gpu(gpu::Kernels),
}

impl Runner {
    fn iteration<'a>(
        &'a self,
        level: &'a Level,
        equations: &'a Equations,
    ) -> Result<Box<dyn Iteration + 'a>, DpError> {
        match self {
            Runner::Cpu => Ok(Box::new(cpu::CpuIteration::new(level, equations))),
            #[cfg(feature = "gpu")]
            Runner::Gpu(kernels) => {
                Ok(Box::new(gpu::GpuIteration::new(kernels, level, equations)?))
            }
        }
    }
}

/// The time given.
struct Clock {
    begun: Instant,
    budget: Option<Duration>,
    deadline: Deadline,
}

impl Clock {
    fn new(seconds: Option<f64>, deadline: Deadline) -> Self {
        Self {
            begun: Instant::now(),
            budget: seconds.and_then(|s| Duration::try_from_secs_f64(s).ok()),
            deadline,
        }
    }

    fn is_over(&self) -> bool {
        let spent = |budget| self.begun.elapsed() > budget;
        self.budget.is_some_and(spent) || self.deadline.has_passed()
    }
}

/// A lattice with a value at each node (the last axis runs fastest).
#[derive(Clone, Debug)]
pub struct Grid {
    pub lattice: Lattice,
    pub values: Vec<f64>,
}

/// V on a grid; on a finite horizon at time 0.
pub struct GridValue {
    pub grid: Grid,
    /// Larger values mean that the equilibrium is not reached from there within the grid.
    pub reached_below: f64,
    /// `cpu` or `gpu`.
    pub backend: &'static str,
    /// What the relative changes of 99.9 % of the values stay below in each round of policy
    /// improvement, the coarse lattices' first; none on a finite horizon, which has no iteration.
    pub changes: Vec<f64>,
    pub seconds: f64,
    /// `[node][m]`: controls of the best steps.
    controls: Vec<f64>,
    /// Values at multiples of `slice_step`, where the horizon is finite.
    slices: Vec<Vec<f32>>,
    slice_step: f64,
    equations: Equations,
    end: End,
    /// Fixed controls that greedy steps try beside others.
    spread: Vec<Vec<f64>>,
    segment: f64,
    /// Periods of states whose copies are nodes of their own.
    lifted: Vec<Option<f64>>,
}

/// Solves for V on a grid.
///
/// # Errors
/// More than [`MOST_STATES`] states, a game, or a device that fails.
pub fn solve(
    model: &Model,
    hamiltonian: &Hamiltonian,
    plan: &Plan,
    options: &Options,
    device: Device<'_>,
) -> Result<GridValue, DpError> {
    if model.is_game() {
        return Err(DpError::Game);
    }
    let states = plan.system.states;
    if states > MOST_STATES {
        return Err(DpError::TooManyStates { states });
    }
    let equations = Equations::new(model, hamiltonian, &plan.system);
    let domain = Domain::new(plan, &equations, options)?;
    let clock = Clock::new(options.budget_seconds, plan.deadline);
    let runner = device.runner(&equations)?;
    let (solution, slices, slice_step) = match (&plan.local, &plan.system.terminal) {
        (Some(local), _) => {
            let solution = stationary::solve(&domain, &equations, local, &runner, &clock)?;
            (solution, Vec::new(), 0.0)
        }
        (None, Some(terminal)) => {
            let found = horizon::solve(&domain, &equations, terminal.time, &runner, &clock)?;
            (found.solution, found.values, found.step)
        }
        (None, None) => return Err(DpError::NoNodes),
    };
    let spread = level::spread(&level::ranges(&solution.controls, equations.controls));
    Ok(GridValue {
        grid: Grid {
            lattice: solution.lattice,
            values: solution.values,
        },
        reached_below: 0.5 * solution.ceiling,
        backend: device.name(),
        changes: solution.changes,
        seconds: clock.begun.elapsed().as_secs_f64(),
        controls: solution.controls,
        slices,
        slice_step,
        equations,
        end: End::new(&plan.system, plan.local.as_ref()),
        spread,
        segment: plan.segment_duration(),
        lifted: domain.lifted,
    })
}

impl std::fmt::Debug for GridValue {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let counts: Vec<usize> = self.grid.lattice.axes.iter().map(|a| a.count).collect();
        f.debug_struct("GridValue")
            .field("nodes", &counts)
            .finish_non_exhaustive()
    }
}

impl GridValue {
    /// V at a deviation from the reference: multilinear, bent by second differences along the axes;
    /// the least over the copies of a periodic state. `None` outside the grid and where a vertex of
    /// the cell is not reached.
    pub fn value(&self, s: &[f64]) -> Option<f64> {
        self.best_copy(s).map(|(_, v, _)| v)
    }

    /// dV/ds of the same.
    pub fn gradient(&self, s: &[f64]) -> Option<Vec<f64>> {
        self.best_copy(s).map(|(_, _, p)| p)
    }

    /// The copy of a state from which V is least, with V and dV/ds there.
    fn best_copy(&self, s: &[f64]) -> Option<(Vec<f64>, f64, Vec<f64>)> {
        let all = domain::copies(&self.grid.lattice, &self.lifted, s).into_iter();
        let known =
            all.filter_map(|copy| self.at(&self.grid.values, &copy).map(|(v, p)| (copy, v, p)));
        known.min_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// Value and gradient on one slice.
    fn at<T: Copy + Into<f64>>(&self, values: &[T], s: &[f64]) -> Option<(f64, Vec<f64>)> {
        let (lattice, most) = (&self.grid.lattice, self.reached_below);
        match lattice.states() {
            1 => in_cell::<1, T>(lattice, values, most, s),
            2 => in_cell::<2, T>(lattice, values, most, s),
            3 => in_cell::<3, T>(lattice, values, most, s),
            _ => in_cell::<4, T>(lattice, values, most, s),
        }
    }
}

fn in_cell<const N: usize, T: Copy + Into<f64>>(
    lattice: &Lattice,
    values: &[T],
    most: f64,
    s: &[f64],
) -> Option<(f64, Vec<f64>)> {
    let cell: Cell<N> = lattice.locate(s)?;
    if largest(values, &cell) >= most {
        return None;
    }
    // `most` is half of the ceiling.
    let bent_below = 2.0 * most * level::STEEP;
    let value = interpolate(values, &cell, bent_below);
    Some((value, slope(lattice, values, &cell, bent_below).to_vec()))
}
