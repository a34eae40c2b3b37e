//! Solving for states block by block.

use super::{Block, Bounds, Gathering, Joined, Seam, Wanting, cut, join, size};
use crate::backend::cpu::Cpu;
use crate::backend::{Backend, BackendError};
use crate::model::Model;
use crate::shooting::Solver;
use crate::sweep::Plan;
use crate::value::archive::Archive;
use crate::value::solve::{Answers, Common, Request, may_need_sweep, solve_targets, solver};
use crate::value::survey::Progress;
use crate::value::targets::Whole;

/// The states of a request, cut into blocks.
pub struct Blocks<'r> {
    pub request: &'r Request,
    pub whole: Whole<'r>,
    pub blocks: Vec<Block>,
    boxes: Vec<Bounds>,
}

/// What was found for some blocks.
pub struct Found {
    pub answers: Answers,
    /// The block of each of the states given that are among the answers'.
    pub block_of: Vec<usize>,
    /// The number that the sheet of each entry has within its block.
    pub sheet_within: Vec<i32>,
    /// What each block tells others; and of each whether it was searched to the end, and how many
    /// states it has.
    pub seams: Vec<Seam>,
    pub is_done: Vec<bool>,
    pub states: Vec<usize>,
}

/// A sweep for first guesses, made when a block first lacks them.
pub type Sweep<'s, E> = &'s mut dyn FnMut(&mut Archive) -> Result<(), E>;

/// What is found by now is kept, now and then.
pub trait Keeper {
    /// Whether it is time to.
    fn is_due(&self) -> bool;

    /// Keeps what was found for these blocks.
    fn keep(&mut self, own: &[usize], found: Found);
}

/// Keeps nothing.
pub struct NoKeeper;

impl Keeper for NoKeeper {
    fn is_due(&self) -> bool {
        false
    }

    fn keep(&mut self, _own: &[usize], _found: Found) {}
}

impl<'r> Blocks<'r> {
    pub fn new(plan: &Plan, backend: &dyn Backend, request: &'r Request) -> Self {
        let states = plan.system.states;
        let whole = Whole::new(states, &request.grids, &request.limits, &request.points);
        let most = size(plan, backend.name() != "cpu");
        let blocks = cut(whole.x(), states, &plan.widths, most);
        let boxes = (blocks.iter())
            .map(|block| block.bounds(whole.x(), states))
            .collect();
        Self {
            blocks,
            boxes,
            request,
            whole,
        }
    }

    /// How many states are in some of the blocks.
    fn count(&self, own: &[usize]) -> usize {
        own.iter().map(|k| self.blocks[*k].members.len()).sum()
    }

    /// Solves for the states of some blocks, and joins their sheets if they are all there are.
    ///
    /// # Errors
    /// Device failures, and those of the sweep.
    pub fn solve<E: From<BackendError>>(
        &self,
        (plan, model): (&Plan, &Model),
        solver: &mut Solver,
        backend: &dyn Backend,
        (archive, mut sweep): (&Archive, Option<Sweep<'_, E>>),
        (own, keeper): (&[usize], &mut dyn Keeper),
        progress: Progress<'_>,
    ) -> Result<Found, E> {
        let common = Common::new(plan, model);
        let sweep = &mut sweep;
        let mut swept: Option<Archive> = None;
        let mut gathering = Gathering::new(&self.whole, plan, (&self.request.grids, &self.boxes));
        let (mut before, count) = (0, self.count(own));
        for (done, &number) in own.iter().enumerate() {
            let block = &self.blocks[number];
            let part = || self.whole.part(&block.members, &plan.widths);
            let mut shown =
                |what: &str, done: usize, _: usize| progress(what, before + done, count);
            if self.request.partial && solver.deadline.check().is_err() {
                let none = Answers::out_of_time(plan, part());
                gathering.add(number, block, none, self.request);
                continue;
            }
            let asked = (part(), self.request);
            let mut found = solve_targets(&common, solver, archive, asked, &mut shown)?;
            // What nothing has led to may have a swept trajectory near it.
            let may = sweep.is_some() && may_need_sweep(plan) && !found.stopped;
            if may && found.lacks_guesses() {
                if let (None, Some(sweep)) = (&swept, sweep.as_mut()) {
                    let mut made = Archive::new(plan);
                    sweep(&mut made)?;
                    swept = Some(made);
                }
                let archive = swept.as_ref().unwrap_or(archive);
                found =
                    solve_targets(&common, solver, archive, (part(), self.request), &mut shown)?;
            }
            before += block.members.len();
            let is_cut = found.stopped;
            gathering.add(number, block, found, self.request);
            if !is_cut && done + 1 < own.len() && keeper.is_due() {
                let so_far = gathering.clone();
                let seams = so_far.seams();
                let joined = self.joined((plan, model), solver, backend, seams, false)?;
                keeper.keep(&own[..=done], so_far.finish(joined));
            }
        }
        if let ([_], [_]) = (own, self.blocks.as_slice()) {
            return Ok(gathering.alone());
        }
        let is_whole = own.len() == self.blocks.len();
        let joined = self.joined((plan, model), solver, backend, gathering.seams(), is_whole)?;
        Ok(gathering.finish(joined))
    }

    /// Joins blocks: in f64 on the CPU, wherever they were solved.
    fn joined(
        &self,
        (plan, model): (&Plan, &Model),
        here: &mut Solver,
        backend: &dyn Backend,
        seams: &[Seam],
        is_whole: bool,
    ) -> Result<Joined, BackendError> {
        let wanting = match is_whole {
            true => Wanting::of(plan, model, self.request),
            // All is looked at once more when all are there.
            false => Wanting::of(plan, model, self.request).in_no_time(),
        };
        let grids = &self.request.grids;
        let mut other = match backend.name() {
            "cpu" => None,
            _ => Some(solver(plan, &Cpu::new())?),
        };
        let on = other.as_mut().unwrap_or(here);
        match join(plan, on, seams, grids, wanting) {
            Err(BackendError::OutOfTime) if self.request.partial => {
                join(plan, on, seams, grids, wanting.in_no_time())
            }
            joined => joined,
        }
    }
}
