//! The states of a map to an error, solved for elsewhere: what a round asks of others, as bytes.
//!
//! States that are reached from points near them are each a problem of its own
//! ([`solve_near`](crate::value::solve_near)): who solves for them, and in what company, changes no
//! bit. A search for all sheets is made in one place, as each state leads to those beside it: in
//! blocks of 64 states one of 1080 took seven times as long (six states).

mod ways;

pub(super) use ways::solved_by;

use crate::backend::{Backend, BackendError};
use crate::shooting::{Path, Solver};
use crate::sweep::Plan;
use crate::value::solver;
use prost::Message;

/// Tasks a worker and round: those that are quick take more of them.
const A_WORKER: usize = 4;

/// Who solves for the states of a map: processes elsewhere, each with a [`Worker`].
pub trait Workers: Sync {
    /// How many there are now.
    fn count(&self) -> usize;

    /// Has tasks done, each by [`Worker::work`] of any of them; the answers, in their order.
    ///
    /// # Errors
    /// Why they could not be done.
    fn work(&self, tasks: Vec<Vec<u8>>) -> Result<Vec<Vec<u8>>, String>;
}

/// Solves for states that the map of another process asks for.
pub struct Worker {
    plan: Plan,
    solver: Solver,
}

/// What a worker is asked for.
#[derive(Clone, PartialEq, Message)]
struct Task {
    /// Components of a node.
    #[prost(uint32, tag = "1")]
    width: u32,
    #[prost(message, required, tag = "2")]
    ways: ways::Task,
}

/// Nodes of a path, and the durations between them.
#[derive(Clone, PartialEq, Message)]
struct Way {
    #[prost(double, repeated, tag = "1")]
    nodes: Vec<f64>,
    #[prost(double, repeated, tag = "2")]
    durations: Vec<f64>,
}

impl Worker {
    /// For the maps of a plan.
    ///
    /// # Errors
    /// Device failures.
    pub fn new(plan: Plan, backend: &dyn Backend) -> Result<Self, BackendError> {
        let solver = solver(&plan, backend)?;
        Ok(Self { plan, solver })
    }

    /// Does a task.
    ///
    /// # Errors
    /// [`BackendError::Foreign`] for bytes that are no task; device failures.
    pub fn work(&mut self, task: &[u8]) -> Result<Vec<u8>, BackendError> {
        let foreign = || BackendError::Foreign {
            what: "a worker was given what is no task of this version",
        };
        let task = Task::decode(task).map_err(|_| foreign())?;
        if task.width as usize != 2 * self.plan.system.states {
            return Err(foreign());
        }
        task.ways.work(self)?.ok_or_else(foreign)
    }
}

/// Has tasks done.
fn done_by(
    workers: &dyn Workers,
    tasks: impl Iterator<Item = Task>,
) -> Result<Vec<Vec<u8>>, BackendError> {
    let tasks: Vec<Vec<u8>> = tasks.map(|task| task.encode_to_vec()).collect();
    let count = tasks.len();
    let done = (workers.work(tasks)).map_err(|why| BackendError::Workers { why })?;
    match done.len() == count {
        true => Ok(done),
        false => Err(foreign_answer()),
    }
}

fn foreign_answer() -> BackendError {
    BackendError::Foreign {
        what: "a worker has answered what is no answer of this version",
    }
}

impl Way {
    fn of(path: &Path) -> Self {
        Self {
            nodes: path.nodes.clone(),
            durations: path.durations.clone(),
        }
    }

    /// `None` where there are not as many nodes as durations ask for.
    fn into_path(self, width: usize) -> Option<Path> {
        (self.nodes.len() == width * (1 + self.durations.len())).then_some(Path {
            width,
            nodes: self.nodes,
            durations: self.durations,
        })
    }
}
