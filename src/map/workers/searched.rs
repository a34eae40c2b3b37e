//! States that are searched for all sheets, in blocks.

use super::ways::Missed;
use super::{A_WORKER, Way, Worker, Workers, done_by, foreign_answer};
use crate::backend::BackendError;
use crate::shooting::Solver;
use crate::sweep::Plan;
use crate::value::blocks::{cut, size};
use crate::value::{
    Answers, Archive, Common, Entry, Progress, Request, Support, Targets, solve_targets,
};
use prost::Message;

/// States of a block are so many times fewer than where states are all that is wanted: a round of a
/// map has few.
const FEWER: usize = 4;

/// States that are searched together.
pub struct Block {
    /// Their numbers among those that were asked for, and they themselves.
    pub numbers: Vec<usize>,
    pub x: Vec<f64>,
}

impl Block {
    /// States (absolute), cut into blocks.
    pub fn cut(plan: &Plan, on_device: bool, x: &[f64]) -> Vec<Self> {
        let n = plan.system.states;
        let blocks = cut(x, n, &plan.widths, size(plan, on_device) / FEWER);
        let block = |numbers: Vec<usize>| Self {
            x: (numbers.iter())
                .flat_map(|k| &x[k * n..][..n])
                .copied()
                .collect(),
            numbers,
        };
        blocks.into_iter().map(|b| block(b.members)).collect()
    }

    /// Searches for all sheets at their states.
    pub fn search(
        &self,
        common: &Common<'_>,
        (solver, archive): (&mut Solver, &Archive),
        value_max: Option<f64>,
        progress: Progress<'_>,
    ) -> Result<Answers, BackendError> {
        let request = Request {
            points: self.x.clone(),
            value_max,
            ..Request::default()
        };
        let targets = self.targets(common.plan());
        solve_targets(common, solver, archive, (targets, &request), progress)
    }

    fn targets(&self, plan: &Plan) -> Targets {
        Targets::new(plan.system.states, &[], &[], &self.x, &plan.widths)
    }
}

/// Some blocks.
#[derive(Clone, PartialEq, Message)]
pub(super) struct Task {
    /// V up to which sheets are followed.
    #[prost(double, optional, tag = "1")]
    value_max: Option<f64>,
    #[prost(message, repeated, tag = "2")]
    blocks: Vec<States>,
}

#[derive(Clone, PartialEq, Message)]
struct States {
    #[prost(double, repeated, tag = "1")]
    x: Vec<f64>,
}

#[derive(Clone, PartialEq, Message)]
struct Done {
    #[prost(message, repeated, tag = "1")]
    blocks: Vec<Found>,
}

/// What was found at the different states of a block, in their order.
#[derive(Clone, PartialEq, Message)]
struct Found {
    #[prost(message, repeated, tag = "1")]
    targets: Vec<OfTarget>,
    /// Of a game with an equilibrium.
    #[prost(bool, tag = "2")]
    has_principal: bool,
    #[prost(bool, tag = "3")]
    is_crowded: bool,
    #[prost(uint64, tag = "4")]
    sheets: u64,
    #[prost(uint64, tag = "5")]
    lifted: u64,
}

#[derive(Clone, PartialEq, Message)]
struct OfTarget {
    #[prost(message, repeated, tag = "1")]
    entries: Vec<OfEntry>,
    #[prost(message, optional, tag = "2")]
    miss: Option<Missed>,
    /// Which of the entries is on the sheet of the equilibrium.
    #[prost(uint32, optional, tag = "3")]
    principal: Option<u32>,
    #[prost(message, required, tag = "4")]
    support: OfSupport,
}

#[derive(Clone, PartialEq, Message)]
struct OfSupport {
    #[prost(uint32, tag = "1")]
    starts: u32,
    #[prost(uint32, tag = "2")]
    flights: u32,
    #[prost(double, tag = "3")]
    covered_to: f64,
    #[prost(double, optional, tag = "4")]
    bound: Option<f64>,
    #[prost(double, optional, tag = "5")]
    flown: Option<f64>,
}

#[derive(Clone, PartialEq, Message)]
struct OfEntry {
    #[prost(message, required, tag = "1")]
    path: Way,
    #[prost(double, tag = "2")]
    value: f64,
    #[prost(int32, tag = "3")]
    sheet: i32,
    #[prost(int32, tag = "4")]
    lifted: i32,
    #[prost(int32, repeated, tag = "5")]
    winding: Vec<i32>,
    #[prost(double, repeated, tag = "6")]
    p: Vec<f64>,
    #[prost(double, repeated, tag = "7")]
    u: Vec<f64>,
    #[prost(double, repeated, tag = "8")]
    w: Vec<f64>,
    #[prost(double, tag = "9")]
    hamiltonian: f64,
    #[prost(uint32, tag = "10")]
    iterations: u32,
    #[prost(double, tag = "11")]
    residual: f64,
    /// Empty where there is none.
    #[prost(double, repeated, tag = "12")]
    slope: Vec<f64>,
    #[prost(double, tag = "13")]
    fold: f64,
}

impl Task {
    /// Does it; `None` where it is none.
    pub fn work(self, worker: &mut Worker) -> Result<Option<Vec<u8>>, BackendError> {
        let Worker {
            plan,
            model,
            archive,
            solver,
        } = worker;
        let n = plan.system.states;
        let common = Common::new(plan, model);
        let mut blocks = Vec::new();
        for States { x } in self.blocks {
            if x.is_empty() || !x.len().is_multiple_of(n) {
                return Ok(None);
            }
            let block = Block {
                numbers: (0..x.len() / n).collect(),
                x,
            };
            let with = (&mut *solver, &*archive);
            let answers = block.search(&common, with, self.value_max, &mut |_, _, _| {})?;
            blocks.push(Found::of(&answers));
        }
        Ok(Some(Done { blocks }.encode_to_vec()))
    }
}

/// Has blocks searched by workers, as [`Block::search`] does it here; `None` where that is not worth
/// while.
///
/// # Errors
/// [`BackendError::Workers`], [`BackendError::Foreign`].
pub fn searched_by(
    workers: &dyn Workers,
    plan: &Plan,
    blocks: &[Block],
    value_max: Option<f64>,
) -> Result<Option<Vec<Answers>>, BackendError> {
    let count = workers.count();
    if blocks.len() < 2 || count == 0 {
        return Ok(None);
    }
    let width = 2 * plan.system.states;
    let of_task = blocks.len().div_ceil(A_WORKER * count);
    let task = |blocks: &[Block]| super::Task {
        width: width as u32,
        ways: None,
        searched: Some(Task {
            value_max,
            blocks: (blocks.iter())
                .map(|block| States { x: block.x.clone() })
                .collect(),
        }),
    };
    let mut found = Vec::with_capacity(blocks.len());
    for answer in done_by(workers, blocks.chunks(of_task).map(task))? {
        let done = Done::decode(answer.as_slice()).map_err(|_| foreign_answer())?;
        for one in done.blocks {
            let block = blocks.get(found.len()).ok_or_else(foreign_answer)?;
            found.push(one.into_answers(plan, block).ok_or_else(foreign_answer)?);
        }
    }
    match found.len() == blocks.len() {
        true => Ok(Some(found)),
        false => Err(foreign_answer()),
    }
}

impl Found {
    fn of(answers: &Answers) -> Self {
        let principal = answers.principal.as_ref();
        let target = |t: usize| OfTarget {
            entries: answers.of(t).iter().map(OfEntry::of).collect(),
            miss: answers.misses[t].as_ref().map(Missed::of),
            principal: principal
                .and_then(|p| p[t])
                .map(|e| (e - answers.first[t]) as u32),
            support: OfSupport::of(&answers.support[t]),
        };
        Self {
            targets: (0..answers.targets.len()).map(target).collect(),
            has_principal: principal.is_some(),
            is_crowded: answers.is_crowded,
            sheets: answers.sheets as u64,
            lifted: answers.lifted as u64,
        }
    }

    /// `None` where it is not as this version writes it.
    fn into_answers(self, plan: &Plan, block: &Block) -> Option<Answers> {
        let targets = block.targets(plan);
        if targets.len() != self.targets.len() {
            return None;
        }
        let mut answers = Answers {
            game: plan.game,
            is_crowded: self.is_crowded,
            sheets: self.sheets as usize,
            lifted: self.lifted as usize,
            first: vec![0],
            targets,
            ..Answers::default()
        };
        let mut principal = Vec::new();
        for (number, target) in self.targets.into_iter().enumerate() {
            let (from, count) = (answers.entries.len(), target.entries.len());
            let of_entry = target.principal.map(|e| e as usize);
            if of_entry.is_some_and(|e| e >= count) {
                return None;
            }
            principal.push(of_entry.map(|e| from + e));
            for entry in target.entries {
                answers.entries.push(entry.into_entry(plan, number)?);
            }
            answers.first.push(answers.entries.len());
            answers.misses.push(match target.miss {
                Some(miss) => Some(miss.into_miss(2 * plan.system.states)?),
                None => None,
            });
            answers.support.push(target.support.into_support());
        }
        answers.principal = self.has_principal.then_some(principal);
        Some(answers)
    }
}

impl OfSupport {
    fn of(support: &Support) -> Self {
        Self {
            starts: support.starts,
            flights: support.flights,
            covered_to: support.covered_to,
            bound: support.bound,
            flown: support.flown,
        }
    }

    fn into_support(self) -> Support {
        Support {
            starts: self.starts,
            flights: self.flights,
            covered_to: self.covered_to,
            bound: self.bound,
            flown: self.flown,
        }
    }
}

impl OfEntry {
    fn of(entry: &Entry) -> Self {
        Self {
            path: Way::of(&entry.path),
            value: entry.value,
            sheet: entry.sheet,
            lifted: entry.lifted,
            winding: entry.winding.clone(),
            p: entry.p.clone(),
            u: entry.u.clone(),
            w: entry.w.clone(),
            hamiltonian: entry.hamiltonian,
            iterations: entry.iterations,
            residual: entry.residual,
            slope: entry.slope.clone().unwrap_or_default(),
            fold: entry.fold,
        }
    }

    fn into_entry(self, plan: &Plan, target: usize) -> Option<Entry> {
        let n = plan.system.states;
        (self.p.len() == n).then_some(())?;
        Some(Entry {
            target,
            sheet: self.sheet,
            lifted: self.lifted,
            winding: self.winding,
            value: self.value,
            p: self.p,
            u: self.u,
            w: self.w,
            hamiltonian: self.hamiltonian,
            iterations: self.iterations,
            residual: self.residual,
            slope: Some(self.slope).filter(|slope| !slope.is_empty()),
            fold: self.fold,
            path: self.path.into_path(2 * n)?,
        })
    }
}
