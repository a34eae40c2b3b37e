//! Refinement of fronts: neighbours further apart than the spacing on any front get a seed between
//! them.
//!
//! A round is integrated as one batch or a few; of each batch what is reported and what neighbours
//! are compared by is computed in one parallel pass over its samples. Edges are judged, and new
//! seeds computed, in parallel; only the neighbourhoods themselves change one by one. What is to be
//! written goes to another thread, and memory comes back from there.

use super::caustic::FoldPoint;
use super::gaps::Gaps;
use super::neighbours::{Edge, Found, Neighbours, Vertex, Waiting, Waits};
use super::nodes::{Extent, Nodes, Place, Slot, State};
use super::observe::{self, Observed, Strip};
use super::parts::{First, SurfacePart};
use super::plan::Plan;
use super::sample::{Sample, Sampler};
use super::steps::Steps;
use super::surface::Guarded;
use crate::backend::cpu::{Simd, in_pool};
use crate::backend::{Backend, BackendError, Kernel, Status, Trajectories, batch_limit};
use crate::local::SeedScratch;
use crate::model::Precision;
use crate::trajectories::TrajectoryBlock;
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use std::collections::BTreeMap;
use std::sync::mpsc::{Receiver, SyncSender, channel, sync_channel};

/// Edges that are judged at once: between them the deadline is looked at. Of many states a round
/// has hundreds of thousands.
const JUDGED: usize = 1 << 15;
/// Seeds a round: enough to fill a device, few enough that what is open stays small.
const ROUND: usize = 8192;
/// Trajectories that are observed at once, whose samples stay near a core.
const STRIP: usize = 32;
/// Edges or seeds a task has at least.
const TASK: usize = 64;
/// Edges that are looked at for a round at most, where others come first in the simplices they lie in.
const LOOKED_AT: usize = 4 * ROUND;
/// Edges that may wait although the cap leaves them no seed: they are counted and forgotten only
/// where they are more than that.
const KEPT: usize = 1 << 17;
/// A vertex is in the middle of an edge when it is so near to it, in lengths of the edge. Triangles so
/// flat come of sides that are left: where the front between two ends does not meet the region although
/// the ones beside it do, halving those in turns would put seeds into the same places for ever.
const NEAR: f64 = 1.0 / 64.0;

/// A seed that a guard excludes is moved onto it when that is so near, likewise; up to so many
/// halvings one after the other, for each state.
const BESIDE: f64 = 0.3;
const MOVED: u16 = 4;
/// Seeds crowd where pairs have come of so many halvings one after the other, and those for each
/// state, and are as long as if half of these had shortened none.
const HALVINGS: u16 = 56;
const FOR_A_STATE: u16 = 4;

/// How well the fronts are covered.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Coverage {
    /// Neighbouring pairs further apart than the spacing for which the cap on seeds left no seed.
    pub uncovered: usize,
    /// Pairs still apart although no number of the precision lies between their seeds.
    pub indistinguishable: usize,
    /// Pairs still apart where seeds crowd, and more of them would leave others apart: at guards
    /// that cut the surface of seeds.
    pub crowded: usize,
    /// The widest gap left among these, as a fraction of the region's box.
    pub widest: f64,
    /// How far trajectories go from one front to the next.
    pub steps: Steps,
    /// Pairs looked at.
    pub pairs: usize,
    /// Seeds outside a guard, which were not swept.
    pub outside_guards: usize,
}

impl Coverage {
    /// Neighbouring pairs further apart than the spacing that remain.
    #[must_use]
    pub fn gaps(&self) -> usize {
        self.uncovered + self.indistinguishable + self.crowded
    }
}

/// What a sweep did.
#[derive(Clone, Debug, Default)]
pub struct SweepReport {
    pub trajectories: usize,
    /// How many more were swept that another part of the surface reports.
    pub borrowed: usize,
    /// Status code (see [`Plan::status_flags`]) and how many ended so.
    pub by_status: BTreeMap<i32, usize>,
    pub coverage: Coverage,
    /// Largest |H| (finite horizon: change of H) of each trajectory.
    pub drift: Vec<f64>,
    /// The same relative to the trajectory's largest running cost.
    pub relative_drift: Vec<f64>,
    pub steps: u64,
    pub rejected: u64,
    pub rounds: usize,
    /// Seconds in the backend.
    pub integrate_seconds: f64,
    /// Where trajectories have ended in folds of the manifold.
    pub folds: Vec<FoldPoint>,
    /// Some of the trajectories, drawn at random.
    pub sample: Sample,
    /// Whether it ended at its deadline, with gaps left.
    pub stopped: bool,
}

/// Told after each round: trajectories done, pairs that still wait for a seed.
pub type Progress<'a> = &'a mut (dyn FnMut(usize, usize) + Send);

/// Takes finished blocks; its memory is used again.
pub type Sink<'a, E> = &'a mut dyn FnMut(&TrajectoryBlock) -> Result<(), E>;

/// Told of each batch: its seeds and what became of them.
pub type Keep<'a> = &'a mut (dyn FnMut(&[f64], &Trajectories) + Send);

/// Sweeps a plan on a backend; finished trajectories go to `sink` in order, block by block.
///
/// # Errors
/// Failures of the backend, or of the sink (as its own error).
pub fn sweep<E: From<BackendError>>(
    plan: &Plan,
    backend: &dyn Backend,
    progress: Progress<'_>,
    sink: Sink<'_, E>,
) -> Result<SweepReport, E> {
    sweep_keeping(plan, backend, progress, &mut |_, _| {}, Some(sink))
}

/// [`sweep`], handing each batch to `keep` as the backend gave it. Without a sink no blocks are
/// made.
///
/// # Errors
/// As [`sweep`].
pub fn sweep_keeping<E: From<BackendError>>(
    plan: &Plan,
    backend: &dyn Backend,
    progress: Progress<'_>,
    keep: Keep<'_>,
    sink: Option<Sink<'_, E>>,
) -> Result<SweepReport, E> {
    let mut kernel = backend.compile(&plan.spec)?;
    let observed = Observed::new(plan);
    let mut fronts = Fronts::new(plan, &observed);
    let Some(sink) = sink else {
        in_pool(|| fronts.sweep(kernel.as_mut(), progress, keep, None))?;
        return Ok(fronts.finished());
    };
    std::thread::scope(|scope| {
        // One block waits while one is written: memory stays bounded when writing is slower.
        let (send, receive) = sync_channel::<TrajectoryBlock>(1);
        let (back, used) = channel();
        let worker = scope.spawn(move || {
            let written = Written { send, used };
            in_pool(move || {
                let swept = fronts.sweep(kernel.as_mut(), progress, keep, Some(&written));
                swept.map(|()| fronts.finished())
            })
        });
        let mut written = Ok(());
        for block in receive {
            written = sink(&block);
            if written.is_err() {
                break;
            }
            // Nobody takes it any more at the end.
            let _ = back.send(block);
        }
        let swept = match worker.join() {
            Ok(swept) => swept,
            Err(panic) => std::panic::resume_unwind(panic),
        };
        written?;
        Ok(swept?)
    })
}

/// Where blocks go, and come back from when they are written.
struct Written {
    send: SyncSender<TrajectoryBlock>,
    used: Receiver<TrajectoryBlock>,
}

/// What an edge turns out to need.
enum Verdict {
    /// An end has not been swept yet.
    Unknown,
    Settled,
    /// A seed between its ends: they are further apart than the spacing, or a guard's boundary
    /// (told as a gap of 1) lies between. With the halvings up to it.
    Apart(f32, u16),
}

/// An edge that may be split, and those that come first.
struct Turn {
    edge: Edge,
    gap: f32,
    first: Vec<(Edge, f32)>,
    /// Whether it is split in another round.
    held: bool,
}

impl Turn {
    fn new(edge: Edge, gap: f32, waits: Waits) -> Self {
        let held = waits == Waits::ForJudgement;
        let first = match waits {
            Waits::For(first) => first,
            Waits::No | Waits::ForJudgement => Vec::new(),
        };
        Self {
            edge,
            gap,
            first,
            held,
        }
    }
}

/// A seed half-way, or on the boundary of a guard.
#[derive(Clone, Copy, Default)]
struct Middle {
    guarded: Guarded,
    /// One of its neighbours is outside a guard.
    at_guard: bool,
    /// Whether the precision tells it from its neighbours.
    distinct: bool,
    /// A common neighbour of the ends that is so near takes its place; the distance squared.
    near: f64,
    /// Whether the halvings up to it have not made its neighbours nearer to each other.
    crowded: bool,
}

struct Fronts<'a> {
    plan: &'a Plan,
    observed: &'a Observed,
    /// By simplex of the first triangulation: whether it is swept.
    is_swept: Vec<bool>,
    neighbours: Neighbours,
    nodes: Nodes,
    gaps: Gaps,
    waiting: Waiting,
    /// Those that wait for others of the simplices they lie in.
    held: FxHashMap<Edge, f32>,
    deferred: Vec<Edge>,
    pending: Vec<Vertex>,
    /// Those that are pending here, and reported by another part of the surface.
    borrowed: Vec<Vertex>,
    /// Swept, but not compared with their neighbours yet.
    unjudged: usize,
    /// Whether a vertex was placed that will not be swept: its edges can be judged at once.
    placed_outside: bool,
    sampler: Sampler,
    /// What is told of each trajectory.
    status: Vec<i32>,
    /// Memory of batches, for the next one.
    seeds: Vec<f64>,
    batch: Trajectories,
    report: SweepReport,
}

impl<'a> Fronts<'a> {
    fn new(plan: &'a Plan, observed: &'a Observed) -> Self {
        let (simplices, mut parameters) = plan.surface.triangulation(plan.shoot_out.max_seeds);
        let first = First::new(&simplices, &parameters, plan.part);
        let bounds = (plan.region.iter().zip(&plan.widths).zip(&plan.periodic))
            .map(|(([lo, hi], w), periodic)| {
                if *periodic {
                    [f32::NEG_INFINITY, f32::INFINITY]
                } else {
                    [(lo / w) as f32, (hi / w) as f32]
                }
            })
            .collect();
        let n = plan.system.states;
        let mut this = Self {
            plan,
            observed,
            neighbours: Neighbours::new(&first),
            is_swept: first.is_swept,
            nodes: Nodes::new(n, parameters.first().map_or(n, Vec::len), plan.samples()),
            gaps: Gaps {
                bounds,
                spacing: plan.shoot_out.spacing,
                folds: plan.slope.is_some(),
                simd: Simd::detect(),
            },
            waiting: Waiting::default(),
            held: FxHashMap::default(),
            deferred: Vec::new(),
            pending: Vec::new(),
            borrowed: Vec::new(),
            unjudged: 0,
            placed_outside: false,
            sampler: Sampler::new(
                plan.seed,
                8 * (plan.run.levels.len() + 1) * (1 + plan.spec.dim()),
            ),
            status: Vec::new(),
            seeds: Vec::new(),
            batch: Trajectories::default(),
            report: SweepReport::default(),
        };
        for vertex in &first.vertices {
            let parameter = std::mem::take(&mut parameters[*vertex as usize]);
            let (parameter, seed, guarded) = plan.surface.placed(parameter);
            let middle = Middle {
                guarded,
                ..Middle::default()
            };
            this.place(&parameter, &seed, middle);
        }
        this
    }

    /// Integrates, judges and splits in turns, until there is nothing more to do.
    fn sweep(
        &mut self,
        kernel: &mut dyn Kernel,
        progress: Progress<'_>,
        keep: Keep<'_>,
        written: Option<&Written>,
    ) -> Result<(), BackendError> {
        loop {
            if !self.integrate(kernel, keep, written)? {
                // The writing side has stopped; it says why.
                return Ok(());
            }
            // Of many states judging takes longer than integrating.
            if self.is_stopped() {
                return Ok(());
            }
            self.judge()?;
            self.report.rounds += 1;
            progress(self.report.trajectories, self.waiting.len());
            if !self.next_round()? {
                return Ok(());
            }
        }
    }

    /// Enters a vertex, to be swept if it is inside the guards.
    fn place(&mut self, parameter: &[f64], seed: &[f64], middle: Middle) {
        let Middle {
            guarded, at_guard, ..
        } = middle;
        let state = if guarded.inside {
            State::Pending
        } else {
            self.placed_outside = true;
            State::Outside
        };
        let at = Place {
            state,
            boundary: at_guard || guarded.on_boundary,
        };
        let vertex = self.nodes.add(parameter, seed, at);
        match (guarded.inside, self.is_own(vertex)) {
            (true, true) => self.pending.push(vertex),
            (true, false) => self.borrowed.push(vertex),
            (false, own) => self.report.coverage.outside_guards += usize::from(own),
        }
    }

    /// Whether a vertex is reported here, not by another part of the surface that has it too.
    fn is_own(&self, vertex: Vertex) -> bool {
        self.plan.part == SurfacePart::WHOLE
            || self.is_swept[self.neighbours.root_of(vertex) as usize]
    }

    /// The same of an edge, once between two of its ends.
    fn is_own_edge(&self, edge: Edge) -> bool {
        self.plan.part == SurfacePart::WHOLE || self.is_swept[self.neighbours.root(edge) as usize]
    }

    /// Integrates what is pending; false where nobody takes the results any more.
    fn integrate(
        &mut self,
        kernel: &mut dyn Kernel,
        keep: Keep<'_>,
        written: Option<&Written>,
    ) -> Result<bool, BackendError> {
        let plan = self.plan;
        let dim = plan.spec.dim();
        let most = batch_limit(dim, plan.run.levels.len()).min(kernel.preferred_batch());
        let borrowed = std::mem::take(&mut self.borrowed);
        self.report.borrowed += borrowed.len();
        for vertices in borrowed.chunks(most) {
            self.integrate_some(kernel, vertices)?;
            let width = self.nodes.path_width();
            let batch = &self.batch;
            (self.nodes.sweep(vertices).par_iter_mut().enumerate())
                .with_min_len(TASK)
                .for_each_init(
                    || vec![0.0; width],
                    |path, (i, slot)| record(plan, batch, i, path, slot),
                );
        }
        let pending = std::mem::take(&mut self.pending);
        self.unjudged = pending.len();
        for vertices in pending.chunks(most) {
            self.integrate_some(kernel, vertices)?;
            for (i, v) in vertices.iter().enumerate() {
                let (seed, parameter) = (self.nodes.seed(*v), self.nodes.parameter(*v));
                self.sampler.offer(i, &self.batch, seed, parameter);
            }
            let block = written.map(|written| written.used.try_recv().unwrap_or_default());
            let block = self.observe(vertices, block);
            keep(&self.seeds, &self.batch);
            if let (Some(written), Some(block)) = (written, block)
                && written.send.send(block).is_err()
            {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Integrates vertices as one batch.
    fn integrate_some(
        &mut self,
        kernel: &mut dyn Kernel,
        vertices: &[Vertex],
    ) -> Result<(), BackendError> {
        let plan = self.plan;
        let dim = plan.spec.dim();
        self.seeds.resize(vertices.len() * dim, 0.0);
        let nodes = &self.nodes;
        (self.seeds.par_chunks_mut(dim).zip(vertices))
            .with_min_len(TASK)
            .for_each(|(to, v)| plan.start_into(nodes.seed(*v), to));
        let start = std::time::Instant::now();
        kernel.integrate_into(&plan.run, &self.seeds, &mut self.batch)?;
        self.report.integrate_seconds += start.elapsed().as_secs_f64();
        Ok(())
    }

    /// Tells what is reported of a batch, fills its block, and keeps what neighbours are compared
    /// by.
    fn observe(
        &mut self,
        vertices: &[Vertex],
        mut block: Option<TrajectoryBlock>,
    ) -> Option<TrajectoryBlock> {
        let (plan, batch, observed) = (self.plan, &self.batch, self.observed);
        let (count, first) = (vertices.len(), self.report.trajectories);
        let report = &mut self.report;
        self.status.clear();
        self.status.resize(count, 0);
        report.drift.resize(first + count, 0.0);
        report.relative_drift.resize(first + count, 0.0);
        let width = self.nodes.path_width();
        {
            let mut columns = block.as_mut().map(|block| {
                observed.prepare(plan, batch, block);
                observe::columns(block, STRIP)
            });
            let mut slots = self.nodes.sweep(vertices);
            let strips: Vec<(Strip<'_>, &mut [Slot<'_>])> = (self.status.chunks_mut(STRIP))
                .zip(report.drift[first..].chunks_mut(STRIP))
                .zip(report.relative_drift[first..].chunks_mut(STRIP))
                .zip(slots.chunks_mut(STRIP))
                .map(|(((status, drift), relative), slots)| {
                    let columns = columns.as_mut().and_then(Iterator::next);
                    let strip = Strip {
                        status,
                        drift,
                        relative,
                        columns,
                    };
                    (strip, slots)
                })
                .collect();
            let memory = || (observe::Scratch::default(), vec![0.0; width]);
            let seeds = &self.seeds;
            let steps = (strips.into_par_iter().enumerate())
                .map_init(memory, |(scratch, path), (k, (mut strip, slots))| {
                    observed.strip(plan, batch, k * STRIP, &mut strip, scratch);
                    let mut longest = Steps::default();
                    for (i, slot) in slots.iter_mut().enumerate() {
                        let i = k * STRIP + i;
                        record(plan, batch, i, path, slot);
                        longest = longest.and(Steps::of(plan, &seeds[i * batch.dim..], batch, i));
                    }
                    longest
                })
                .reduce(Steps::default, Steps::and);
            report.coverage.steps = report.coverage.steps.and(steps);
        }
        report.trajectories += count;
        report.steps += batch.steps.iter().map(|s| u64::from(*s)).sum::<u64>();
        report.rejected += batch.rejected.iter().map(|s| u64::from(*s)).sum::<u64>();
        for code in &self.status {
            *report.by_status.entry(*code).or_default() += 1;
        }
        (report.folds).extend(observed.folds(plan, batch, &self.status, first));
        if let Some(block) = &mut block {
            block.status.clone_from(&self.status);
            block.hamiltonian_drift.clear();
            (block.hamiltonian_drift).extend_from_slice(&report.drift[first..]);
        }
        block
    }

    /// Decides on all edges whose ends are known, and forgets the vertices that are done with; less
    /// where the time is over.
    fn judge(&mut self) -> Result<(), BackendError> {
        let mut edges = std::mem::take(&mut self.deferred);
        edges.extend(self.neighbours.take_fresh());
        // What lies together is read together.
        let neighbours = &self.neighbours;
        edges.par_sort_unstable_by_key(|e| (neighbours.root_of(e.1), e.1, e.0));
        for edges in edges.chunks(JUDGED) {
            if self.is_stopped() {
                return Ok(());
            }
            self.judge_some(edges);
        }
        self.unjudged = 0;
        self.placed_outside = false;
        for (edge, gap) in std::mem::take(&mut self.held) {
            let halvings = self.neighbours.halvings(edge);
            self.waiting.push(halvings, gap, edge);
        }
        self.drop_unaffordable();
        for vertex in self.neighbours.take_forgotten() {
            self.nodes.forget(vertex);
        }
        match self.nodes.failure() {
            None => Ok(()),
            Some(error) => Err(BackendError::SetAside(error)),
        }
    }

    fn judge_some(&mut self, edges: &[Edge]) {
        let this = &*self;
        let verdicts: Vec<(Verdict, [u32; 2])> = (edges.par_iter().with_min_len(TASK))
            .map_init(Default::default, |buffers, edge| {
                (this.verdict(*edge, buffers), this.neighbours.places(*edge))
            })
            .collect();
        for (&edge, (verdict, places)) in edges.iter().zip(verdicts) {
            match verdict {
                Verdict::Unknown => {
                    self.deferred.push(edge);
                    continue;
                }
                Verdict::Settled => self.neighbours.note_at(edge, places, Found::Settled),
                Verdict::Apart(gap, halvings) => {
                    self.neighbours.note_at(edge, places, Found::Apart(gap));
                    self.waiting.push(halvings, gap, edge);
                }
            }
            self.report.coverage.pairs += usize::from(self.is_own_edge(edge));
        }
    }

    fn verdict(&self, edge: Edge, [x, y]: &mut [Vec<f32>; 2]) -> Verdict {
        let Edge(a, b) = edge;
        // Nothing is forgotten that an open edge is at.
        let (Some(at_a), Some(at_b)) = (self.nodes.state(a), self.nodes.state(b)) else {
            return Verdict::Settled;
        };
        match (at_a, at_b) {
            (State::Pending, _) | (_, State::Pending) => Verdict::Unknown,
            (State::Outside, State::Outside) => Verdict::Settled,
            (State::Swept, State::Swept) => {
                let passed = (self.nodes.passed(a, x), self.nodes.passed(b, y));
                let (Some(a), Some(b)) = passed else {
                    return Verdict::Settled;
                };
                let gap = self.gaps.between(a, b);
                if f64::from(gap) > self.plan.shoot_out.spacing {
                    Verdict::Apart(gap, self.neighbours.halvings(edge))
                } else {
                    Verdict::Settled
                }
            }
            _ if self.nodes.is_on_boundary(a) || self.nodes.is_on_boundary(b) => Verdict::Settled,
            _ => Verdict::Apart(1.0, self.neighbours.halvings(edge)),
        }
    }

    /// Forgets edges that wait behind more others than the cap leaves seeds for.
    fn drop_unaffordable(&mut self) {
        let most = self.affordable();
        if self.waiting.len() <= KEPT.max(most + most / 8) {
            return;
        }
        for (edge, gap) in self.waiting.keep(KEPT.max(most)) {
            self.count_gap(edge, gap, |coverage| &mut coverage.uncovered);
            self.neighbours.settle(edge);
        }
    }

    /// Counts a gap that is left.
    fn count_gap(&mut self, edge: Edge, gap: f32, of: impl Fn(&mut Coverage) -> &mut usize) {
        let own = usize::from(self.is_own_edge(edge));
        let coverage = &mut self.report.coverage;
        *of(coverage) += own;
        if own > 0 {
            coverage.widest = coverage.widest.max(f64::from(gap));
        }
    }

    /// Splits waiting edges until the round is full; false when nothing is left to do, or no time.
    fn next_round(&mut self) -> Result<bool, BackendError> {
        loop {
            // Otherwise all new edges wait for a trajectory.
            if self.placed_outside {
                self.judge()?;
            }
            if self.is_stopped() {
                return Ok(false);
            }
            let mut looked_at = 0;
            while self.room() > 0 && looked_at < LOOKED_AT && !self.is_stopped() {
                let edges = self.choose(&mut looked_at);
                if edges.is_empty() {
                    break;
                }
                self.split(&edges);
            }
            let idle = self.pending.is_empty() && self.borrowed.is_empty();
            if idle && !self.held.is_empty() && self.room() > 0 {
                // Those that they waited for got no seed either.
                self.judge()?;
            } else if !self.placed_outside {
                return Ok(!idle);
            }
        }
    }

    /// Takes edges to be split at once, as many as the round has room for, in an order in which those
    /// that share a simplex come in their turn.
    fn choose(&mut self, looked_at: &mut usize) -> Vec<(Edge, f32)> {
        let (mut chosen, mut around) = (Vec::new(), Vec::new());
        let room = self.room();
        while chosen.len() < room && *looked_at < LOOKED_AT {
            let next = std::iter::from_fn(|| self.waiting.pop());
            let some: Vec<(Edge, f32)> = next.take(room - chosen.len()).collect();
            if some.is_empty() {
                break;
            }
            *looked_at += some.len();
            let neighbours = &self.neighbours;
            let waits: Vec<Waits> = (some.par_iter().with_min_len(TASK))
                .map_init(Vec::new, |around, (edge, gap)| {
                    neighbours.waits(*edge, *gap, around)
                })
                .collect();
            // Until they are split, what is chosen changes nothing of this.
            for ((edge, gap), waits) in some.into_iter().zip(waits) {
                *looked_at += self.take(Turn::new(edge, gap, waits), &mut chosen, &mut around);
            }
        }
        // What others waited for may be more than there is room for.
        for (edge, gap) in chosen.split_off(room.min(chosen.len())) {
            self.neighbours.note(edge, Found::Apart(gap));
            self.held.insert(edge, gap);
        }
        chosen
    }

    /// Takes an edge after those that it waits for, or holds it where these cannot be taken; how many
    /// these were.
    fn take(
        &mut self,
        turn: Turn,
        chosen: &mut Vec<(Edge, f32)>,
        around: &mut Vec<Vertex>,
    ) -> usize {
        let mut looked_at = 0;
        if !self.is_waiting(turn.edge) {
            return looked_at;
        }
        // The last one has its turn; the one before waits for it.
        let mut turns = vec![turn];
        while let Some(turn) = turns.last_mut() {
            let Turn { edge, gap, .. } = *turn;
            if let Some((other, gap)) = turn.first.pop() {
                if self.is_waiting(other) {
                    self.waiting
                        .take(self.neighbours.halvings(other), gap, other);
                    let waits = self.neighbours.waits(other, gap, around);
                    looked_at += 1;
                    turns.push(Turn::new(other, gap, waits));
                } else {
                    turn.held |= self.holds_up(other, edge);
                }
                continue;
            }
            if turn.held {
                self.held.insert(edge, gap);
            } else {
                self.neighbours.note(edge, Found::Chosen);
                chosen.push((edge, gap));
            }
            turns.pop();
            if let Some(waiting) = turns.last_mut() {
                waiting.held |= self.holds_up(edge, waiting.edge);
            }
        }
        looked_at
    }

    /// Whether an edge with a gap was neither taken for this round nor held for the next.
    fn is_waiting(&self, edge: Edge) -> bool {
        self.neighbours.found(edge) != Some(Found::Chosen) && !self.held.contains_key(&edge)
    }

    /// Whether one that comes first keeps another from being split with it: it is held too, or what
    /// comes of it comes first as well.
    fn holds_up(&self, first: Edge, other: Edge) -> bool {
        let fewer = self.neighbours.halvings(first) < self.neighbours.halvings(other);
        fewer || self.held.contains_key(&first)
    }

    /// Whether the deadline has passed, which is noted.
    fn is_stopped(&mut self) -> bool {
        self.report.stopped |= self.plan.deadline.has_passed();
        self.report.stopped
    }

    /// Seeds that the cap leaves.
    fn affordable(&self) -> usize {
        let placed = self.report.trajectories + self.pending.len();
        self.plan.shoot_out.max_seeds.saturating_sub(placed)
    }

    /// Seeds that fit the round.
    fn room(&self) -> usize {
        let pending = self.pending.len() + self.borrowed.len();
        ROUND.saturating_sub(pending).min(self.affordable())
    }

    /// Puts seeds between the ends of edges.
    fn split(&mut self, edges: &[(Edge, f32)]) {
        let n = self.plan.system.states;
        let (width, length) = (self.nodes.parameter_width(), 2 * n + 1);
        let mut parameters = vec![0.0; edges.len() * width];
        let mut seeds = vec![0.0; edges.len() * length];
        let this = &*self;
        let middles: Vec<Middle> = (edges.par_iter())
            .zip(parameters.par_chunks_mut(width))
            .zip(seeds.par_chunks_mut(length))
            .with_min_len(TASK)
            .map_init(Default::default, |scratch, ((edge, parameter), seed)| {
                this.middle(edge.0, (parameter, seed), scratch)
            })
            .collect();
        let found = (parameters.chunks_exact(width)).zip(seeds.chunks_exact(length));
        let mut around = Vec::new();
        for ((&(edge, gap), middle), (parameter, seed)) in edges.iter().zip(middles).zip(found) {
            // The way between the ends leads by that neighbour, to which both were compared.
            if middle.near > 0.0 && self.is_taken(edge, (parameter, middle.near), &mut around) {
                self.neighbours.settle(edge);
                continue;
            }
            if middle.distinct && !middle.crowded {
                self.neighbours.split(edge);
                self.place(parameter, seed, middle);
                continue;
            }
            // A boundary that coincides with its inner end leaves nothing between; a gap does.
            if middle.distinct || !middle.at_guard {
                self.count_gap(edge, gap, |coverage| match middle.distinct {
                    true => &mut coverage.crowded,
                    false => &mut coverage.indistinguishable,
                });
            }
            self.neighbours.settle(edge);
        }
    }

    /// Whether a common neighbour of an edge's ends is near a parameter, as the square of the distance
    /// says.
    fn is_taken(&self, edge: Edge, (at, near): (&[f64], f64), around: &mut Vec<Vertex>) -> bool {
        self.neighbours.around(edge, around);
        around.iter().any(|v| {
            square(at, self.nodes.parameter(*v)) < near && self.neighbours.is_beside(*v, edge)
        })
    }

    /// Computes the parameter and the seed between the ends of an edge.
    fn middle(
        &self,
        edge: Edge,
        (parameter, seed): (&mut [f64], &mut [f64]),
        scratch: &mut SeedScratch,
    ) -> Middle {
        let (surface, nodes) = (&self.plan.surface, &self.nodes);
        let [a, b] = self.neighbours.ends(edge);
        let outside = |v: Vertex| nodes.state(v) == Some(State::Outside);
        let (p, q) = (nodes.parameter(a), nodes.parameter(b));
        match (outside(a), outside(b)) {
            (false, true) => parameter.copy_from_slice(&surface.boundary(p, q)),
            (true, false) => parameter.copy_from_slice(&surface.boundary(q, p)),
            _ => surface.toward_into(p, q, 0.5, parameter),
        }
        let mut guarded = surface.place(parameter, seed, scratch);
        let crosses = outside(a) || outside(b);
        let mut at_guard = crosses;
        let depth = self.neighbours.halvings(edge).saturating_add(1);
        // A surface of seeds follows a guard by seeds on it, not by pairs on either side; but where
        // they crowd, one outside ends it.
        let moves = !crosses && !guarded.inside && depth <= MOVED * self.plan.system.states as u16;
        let long = square(p, q);
        let reach = BESIDE * long.sqrt();
        if let Some(moved) = moves
            .then(|| surface.onto_guard(parameter, reach))
            .flatten()
        {
            parameter.copy_from_slice(&moved);
            guarded = surface.place(parameter, seed, scratch);
            at_guard = true;
        }
        Middle {
            guarded,
            at_guard,
            near: if crosses { 0.0 } else { NEAR * NEAR * long },
            distinct: self.differ(seed, nodes.seed(a)) && self.differ(seed, nodes.seed(b)),
            crowded: depth > HALVINGS + FOR_A_STATE * self.plan.system.states as u16
                && long * f64::from(depth).exp2() > 1.0,
        }
    }

    /// Whether the kernel sees different states of two seeds.
    fn differ(&self, a: &[f64], b: &[f64]) -> bool {
        let n = self.plan.system.states;
        let single = self.plan.spec.precision == Precision::F32;
        let differ = |(x, y): (&f64, &f64)| match single {
            true => *x as f32 != *y as f32,
            false => x != y,
        };
        a[..n].iter().zip(&b[..n]).any(differ)
    }

    fn finished(mut self) -> SweepReport {
        let waiting: Vec<(Edge, f32)> = (self.waiting.iter())
            .chain(std::mem::take(&mut self.held))
            .collect();
        for (edge, gap) in waiting {
            self.count_gap(edge, gap, |coverage| &mut coverage.uncovered);
        }
        // Seeds that were placed and not swept or not judged, for want of time, leave gaps too.
        self.report.coverage.uncovered += self.pending.len() + self.unjudged;
        self.report.sample =
            (self.sampler).finish(self.plan.spec.dim(), self.plan.run.levels.len());
        self.report
    }
}

/// The square of the distance between two parameters.
fn square(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
}

/// Keeps what the neighbours of trajectory `i` of a batch are compared with; `path` is memory.
fn record(plan: &Plan, batch: &Trajectories, i: usize, path: &mut [f32], slot: &mut Slot<'_>) {
    let n = plan.system.states;
    let stride = path.len() / n;
    let mut passed = 0;
    for level in plan.inner..batch.levels {
        let sample = batch.sample(i, level);
        if sample[0].is_nan() {
            break;
        }
        for (k, (s, w)) in sample[1..=n].iter().zip(&plan.widths).enumerate() {
            path[k * stride + passed] = (s / w) as f32;
        }
        passed += 1;
    }
    let end = &batch.end[i * batch.dim..][..batch.dim];
    let fold = (batch.status[i] != Status::Reached && plan.is_folded(end))
        .then(|| (end[..n].iter().zip(&plan.widths)).map(|(s, w)| (s / w) as f32));
    let passed = Extent {
        levels: passed as u32,
        at_guard: batch.status[i] == Status::Guard,
    };
    slot.fill(path, passed, fold);
}
