//! Refinement of fronts: neighbours further apart than the spacing on any front get a seed between
//! them.

use super::caustic::FoldPoint;
use super::complex::{Complex, Edge, Vertex, Waiting};
use super::observe::Observed;
use super::plan::Plan;
use super::sample::{Sample, Sampler};
use crate::backend::{Backend, BackendError, Kernel, Status, Trajectories, batch_limit};
use crate::model::Precision;
use crate::trajectories::TrajectoryBlock;
use rayon::prelude::*;
use std::collections::{BTreeMap, HashMap};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

/// Edges that are judged at once: between them the deadline is looked at. Of many states a round
/// has hundreds of thousands.
const JUDGED: usize = 1 << 15;
/// Seeds a round: enough to fill a device, few enough that what is open stays small.
const ROUND: usize = 8192;

/// How well the fronts are covered.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Coverage {
    /// Neighbouring pairs further apart than the spacing for which the cap on seeds left no seed.
    pub uncovered: usize,
    /// Pairs still apart although no number of the precision lies between their seeds.
    pub indistinguishable: usize,
    /// The widest gap left among these, as a fraction of the region's box.
    pub widest: f64,
    /// Pairs looked at.
    pub pairs: usize,
    /// Seeds outside a guard, which were not swept.
    pub outside_guards: usize,
}

/// What a sweep did.
#[derive(Clone, Debug, Default)]
pub struct SweepReport {
    pub trajectories: usize,
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
pub type Progress<'a> = &'a mut dyn FnMut(usize, usize);

/// What is kept of a vertex while it has open edges.
struct Node {
    parameter: Vec<f64>,
    /// `(s, p, V)`.
    seed: Vec<f64>,
    state: NodeState,
    /// On the boundary of a guard: nothing is between it and an outside neighbour.
    boundary: bool,
}

enum NodeState {
    Pending,
    /// Outside a guard: not swept.
    Outside,
    Swept(Swept),
}

struct Swept {
    /// Deviations in widths of the region at each level passed.
    path: Vec<f32>,
    /// The same where the trajectory has ended in a fold.
    fold: Option<Vec<f32>>,
}

/// What an edge turns out to need.
enum Verdict {
    /// An end has not been swept yet.
    Unknown,
    Settled,
    /// Further apart than the spacing.
    Gap(f32),
    /// A guard's boundary lies between.
    Boundary,
}

struct Fronts<'a> {
    plan: &'a Plan,
    complex: Complex,
    nodes: HashMap<Vertex, Node>,
    waiting: Waiting,
    deferred: Vec<Edge>,
    pending: Vec<Vertex>,
    /// Swept, but not compared with their neighbours yet.
    unjudged: usize,
    /// The region in its own widths; endless along periodic states, whose every period meets it
    /// somewhere.
    bounds: Vec<[f32; 2]>,
    sampler: Sampler,
    report: SweepReport,
}

/// Sweeps a plan on a backend; finished trajectories go to `sink` in order, block by block.
///
/// # Errors
/// Failures of the backend, or of the sink (as its own error).
pub fn sweep<E: From<BackendError> + Send>(
    plan: &Plan,
    backend: &dyn Backend,
    progress: Progress<'_>,
    sink: Sink<'_, E>,
) -> Result<SweepReport, E> {
    sweep_keeping(plan, backend, progress, &mut |_, _| {}, sink)
}

/// Takes finished blocks; on a thread of its own.
pub type Sink<'a, E> = &'a mut (dyn FnMut(TrajectoryBlock) -> Result<(), E> + Send);

/// Told of each batch: its seeds and what became of them.
pub type Keep<'a> = &'a mut dyn FnMut(&[f64], &Trajectories);

/// [`sweep`], handing each batch to `keep` as the backend gave it.
///
/// # Errors
/// As [`sweep`].
pub fn sweep_keeping<E: From<BackendError> + Send>(
    plan: &Plan,
    backend: &dyn Backend,
    progress: Progress<'_>,
    keep: Keep<'_>,
    sink: Sink<'_, E>,
) -> Result<SweepReport, E> {
    let mut kernel = backend.compile(&plan.spec)?;
    let observed = Observed::new(plan);
    let mut fronts = Fronts::new(plan);
    std::thread::scope(|scope| {
        // What is reported of a batch is computed while the next one is prepared and integrated;
        // memory stays bounded.
        let (send, receive) = sync_channel::<Trajectories>(1);
        let observer = scope.spawn(move || observe(plan, &observed, receive, sink));
        let finished = loop {
            match fronts.integrate(kernel.as_mut(), keep, &send) {
                Ok(true) => {}
                // The observer has stopped; it says why.
                Ok(false) => break Ok(()),
                Err(e) => break Err(e),
            }
            // Of many states judging takes longer than integrating.
            if fronts.is_stopped() {
                break Ok(());
            }
            fronts.judge();
            fronts.report.rounds += 1;
            progress(fronts.report.trajectories, fronts.waiting.len());
            if !fronts.next_round() {
                break Ok(());
            }
        };
        drop(send);
        let seen = match observer.join() {
            Ok(seen) => seen?,
            Err(panic) => std::panic::resume_unwind(panic),
        };
        finished?;
        let mut report = fronts.finished();
        (report.drift, report.relative_drift, report.by_status) =
            (seen.drift, seen.relative_drift, seen.by_status);
        report.folds = seen.folds;
        Ok(report)
    })
}

/// What the trajectories of a sweep are told by.
#[derive(Default)]
struct Seen {
    drift: Vec<f64>,
    relative_drift: Vec<f64>,
    by_status: BTreeMap<i32, usize>,
    folds: Vec<FoldPoint>,
}

/// Hands on what is reported of each batch.
fn observe<E>(
    plan: &Plan,
    observed: &Observed,
    batches: Receiver<Trajectories>,
    sink: Sink<'_, E>,
) -> Result<Seen, E> {
    let mut seen = Seen::default();
    for batch in batches {
        let (block, relative) = observed.block(plan, &batch);
        seen.folds
            .extend(observed.folds(plan, &batch, &block.status, seen.drift.len()));
        seen.drift.extend_from_slice(&block.hamiltonian_drift);
        seen.relative_drift.extend(relative);
        for code in &block.status {
            *seen.by_status.entry(*code).or_default() += 1;
        }
        sink(block)?;
    }
    Ok(seen)
}

impl<'a> Fronts<'a> {
    fn new(plan: &'a Plan) -> Self {
        let (complex, parameters) = plan.surface.triangulation(plan.shoot_out.max_seeds);
        let bounds = (plan.region.iter().zip(&plan.widths).zip(&plan.periodic))
            .map(|(([lo, hi], w), periodic)| {
                if *periodic {
                    [f32::NEG_INFINITY, f32::INFINITY]
                } else {
                    [(lo / w) as f32, (hi / w) as f32]
                }
            })
            .collect();
        let mut this = Self {
            plan,
            complex,
            nodes: HashMap::new(),
            waiting: Waiting::default(),
            deferred: Vec::new(),
            pending: Vec::new(),
            unjudged: 0,
            bounds,
            sampler: Sampler::new(
                plan.seed,
                8 * (plan.run.levels.len() + 1) * (1 + plan.spec.dim()),
            ),
            report: SweepReport::default(),
        };
        for (v, parameter) in parameters.into_iter().enumerate() {
            let parameter = plan.surface.nudged(parameter);
            let seed = plan.surface.seed(&parameter);
            this.place(v as Vertex, parameter, seed, false);
        }
        this
    }

    /// Enters a vertex, to be swept if it is inside the guards.
    fn place(&mut self, vertex: Vertex, parameter: Vec<f64>, seed: Vec<f64>, boundary: bool) {
        let inside = self.plan.surface.inside(&seed);
        let boundary = boundary || (inside && self.plan.surface.on_boundary(&seed));
        let state = if inside {
            self.pending.push(vertex);
            NodeState::Pending
        } else {
            self.report.coverage.outside_guards += 1;
            NodeState::Outside
        };
        self.nodes.insert(
            vertex,
            Node {
                parameter,
                seed,
                state,
                boundary,
            },
        );
    }

    /// Integrates what is pending; false where nobody takes the results any more.
    fn integrate(
        &mut self,
        kernel: &mut dyn Kernel,
        keep: Keep<'_>,
        done: &SyncSender<Trajectories>,
    ) -> Result<bool, BackendError> {
        let plan = self.plan;
        let dim = plan.spec.dim();
        let pending = std::mem::take(&mut self.pending);
        self.unjudged = pending.len();
        for vertices in pending.chunks(batch_limit(dim, plan.run.levels.len())) {
            let mut seeds = Vec::with_capacity(vertices.len() * dim);
            for v in vertices {
                seeds.extend(plan.start(&self.nodes[v].seed));
            }
            let start = std::time::Instant::now();
            let batch = kernel.integrate(&plan.run, &seeds)?;
            self.report.integrate_seconds += start.elapsed().as_secs_f64();
            for (i, v) in vertices.iter().enumerate() {
                let node = &self.nodes[v];
                self.sampler.offer(i, &batch, &node.seed, &node.parameter);
            }
            self.record(vertices, &batch);
            keep(&seeds, &batch);
            if done.send(batch).is_err() {
                return Ok(false);
            }
        }
        Ok(true)
    }

    fn record(&mut self, vertices: &[Vertex], batch: &Trajectories) {
        let n = self.plan.system.states;
        for (i, v) in vertices.iter().enumerate() {
            let mut path = Vec::new();
            for k in self.plan.inner..batch.levels {
                let sample = batch.sample(i, k);
                if sample[0].is_nan() {
                    break;
                }
                path.extend(
                    sample[1..=n]
                        .iter()
                        .zip(&self.plan.widths)
                        .map(|(s, w)| (s / w) as f32),
                );
            }
            path.shrink_to_fit();
            let end = &batch.end[i * batch.dim..][..batch.dim];
            let fold =
                (batch.status[i] != Status::Reached && self.plan.is_folded(end)).then(|| {
                    let scaled = end[..n]
                        .iter()
                        .zip(&self.plan.widths)
                        .map(|(s, w)| (s / w) as f32);
                    scaled.collect()
                });
            if let Some(node) = self.nodes.get_mut(v) {
                node.state = NodeState::Swept(Swept { path, fold });
            }
            self.report.trajectories += 1;
            self.report.steps += u64::from(batch.steps[i]);
            self.report.rejected += u64::from(batch.rejected[i]);
        }
    }

    /// Decides on all edges whose ends are known, and forgets the vertices that are done with; less
    /// where the time is over.
    fn judge(&mut self) {
        let mut edges = std::mem::take(&mut self.deferred);
        edges.extend(self.complex.take_fresh());
        for edges in edges.chunks(JUDGED) {
            if self.is_stopped() {
                return;
            }
            self.judge_some(edges);
        }
        self.unjudged = 0;
        let complex = &self.complex;
        self.nodes.retain(|v, _| complex.is_open(*v));
    }

    fn judge_some(&mut self, edges: &[Edge]) {
        let verdicts: Vec<Verdict> = edges.par_iter().map(|e| self.verdict(*e)).collect();
        for (&edge, verdict) in edges.iter().zip(verdicts) {
            let root = self.complex.root(edge).unwrap_or(0);
            let (gap, known) = match verdict {
                Verdict::Unknown => {
                    self.deferred.push(edge);
                    (None, false)
                }
                Verdict::Settled => {
                    self.complex.settle(edge);
                    (None, true)
                }
                Verdict::Gap(gap) => (Some(gap), true),
                Verdict::Boundary => (Some(1.0), true),
            };
            self.report.coverage.pairs += usize::from(known);
            if let Some(gap) = gap {
                self.waiting.push(root, gap, edge);
            }
        }
    }

    fn verdict(&self, edge: Edge) -> Verdict {
        let (Some(a), Some(b)) = (self.nodes.get(&edge.0), self.nodes.get(&edge.1)) else {
            return Verdict::Settled;
        };
        match (&a.state, &b.state) {
            (NodeState::Swept(x), NodeState::Swept(y)) => {
                let front = self.widest_gap(&x.path, &y.path);
                let gap = front.max(self.gap_on_caustic(x, y));
                if f64::from(gap) > self.plan.shoot_out.spacing {
                    Verdict::Gap(gap)
                } else {
                    Verdict::Settled
                }
            }
            (NodeState::Pending, _) | (_, NodeState::Pending) => Verdict::Unknown,
            (NodeState::Outside, NodeState::Outside) => Verdict::Settled,
            _ if a.boundary || b.boundary => Verdict::Settled,
            _ => Verdict::Boundary,
        }
    }

    /// Widest gap over the fronts that both trajectories reach, where the piece of front between
    /// them may meet the region.
    fn widest_gap(&self, a: &[f32], b: &[f32]) -> f32 {
        let n = self.plan.system.states;
        let mut widest = 0.0f32;
        for (x, y) in a.chunks_exact(n).zip(b.chunks_exact(n)) {
            if self.may_meet_region(x, y) {
                let gap = x
                    .iter()
                    .zip(y)
                    .map(|(x, y)| (x - y).abs())
                    .fold(0.0, f32::max);
                widest = widest.max(gap);
            }
        }
        widest
    }

    /// Whether a piece of front between two states (in widths of the region) may lie in the region.
    fn may_meet_region(&self, x: &[f32], y: &[f32]) -> bool {
        (x.iter().zip(y).zip(&self.bounds))
            .all(|((x, y), [lo, hi])| x.max(*y) >= *lo && x.min(*y) <= *hi)
    }

    /// Gap between the folds that neighbours end in. Where one of them goes on, or its fold is
    /// elsewhere although they have come close together, the caustic has an end between them, and
    /// the gap is closed when they are `CLOSE`.
    fn gap_on_caustic(&self, a: &Swept, b: &Swept) -> f32 {
        const CLOSE: f64 = 1.0 / 32.0;
        let n = self.plan.system.states;
        if self.plan.slope.is_none() {
            return 0.0;
        }
        let distance = |x: &[f32], y: &[f32]| {
            x.iter()
                .zip(y)
                .map(|(x, y)| (x - y).abs())
                .fold(0.0, f32::max)
        };
        let last = a.path.len().min(b.path.len());
        let apart = if last < n {
            f32::INFINITY
        } else {
            distance(&a.path[last - n..last], &b.path[last - n..last])
        };
        if f64::from(apart) <= CLOSE * self.plan.shoot_out.spacing {
            return 0.0;
        }
        // What the longer one passes alone may lie in the region although the shorter one ends
        // outside.
        let longer = if a.path.len() > b.path.len() {
            &a.path
        } else {
            &b.path
        };
        let alone = || {
            longer[last..]
                .chunks_exact(n)
                .any(|x| self.may_meet_region(x, x))
        };
        match (&a.fold, &b.fold) {
            (Some(x), Some(y)) if self.may_meet_region(x, y) || alone() => distance(x, y),
            // Any gap above the spacing will do.
            (Some(x), None) | (None, Some(x)) if self.may_meet_region(x, x) || alone() => 1.0,
            // One has left for good, the other comes back.
            (None, None) if alone() => 1.0,
            _ => 0.0,
        }
    }

    /// Splits waiting edges until the round is full; false when nothing is left to do, or no time.
    fn next_round(&mut self) -> bool {
        loop {
            self.judge();
            if self.is_stopped() {
                return false;
            }
            if self.is_full() || self.waiting.is_empty() {
                return !self.pending.is_empty();
            }
            while !self.is_full()
                && !self.plan.deadline.has_passed()
                && let Some((edge, gap)) = self.waiting.pop()
            {
                self.split(edge, gap);
            }
        }
    }

    /// Whether the deadline has passed, which is noted.
    fn is_stopped(&mut self) -> bool {
        self.report.stopped |= self.plan.deadline.has_passed();
        self.report.stopped
    }

    fn is_full(&self) -> bool {
        let swept = self.report.trajectories + self.pending.len();
        self.pending.len() >= ROUND || swept >= self.plan.shoot_out.max_seeds
    }

    fn split(&mut self, edge: Edge, gap: f32) {
        let surface = &self.plan.surface;
        let (Some(a), Some(b)) = (self.nodes.get(&edge.0), self.nodes.get(&edge.1)) else {
            return;
        };
        let outside = |n: &Node| matches!(n.state, NodeState::Outside);
        let boundary = outside(a) || outside(b);
        let parameter = match (outside(a), outside(b)) {
            (false, true) => surface.boundary(&a.parameter, &b.parameter),
            (true, false) => surface.boundary(&b.parameter, &a.parameter),
            _ => surface.between(&a.parameter, &b.parameter),
        };
        let parameter = surface.nudged(parameter);
        let seed = surface.seed(&parameter);
        let middle = self.rounded(&seed);
        if middle == self.rounded(&a.seed) || middle == self.rounded(&b.seed) {
            // A boundary that coincides with its inner end leaves nothing between; a gap does.
            if !boundary {
                self.report.coverage.indistinguishable += 1;
                self.report.coverage.widest = self.report.coverage.widest.max(f64::from(gap));
            }
            self.complex.settle(edge);
            return;
        }
        if let Some(vertex) = self.complex.split(edge) {
            self.place(vertex, parameter, seed, boundary);
        }
    }

    /// The seed's state as the kernel sees it.
    fn rounded(&self, seed: &[f64]) -> Vec<f64> {
        let round = |x: &f64| {
            if self.plan.spec.precision == Precision::F32 {
                f64::from(*x as f32)
            } else {
                *x
            }
        };
        seed[..self.plan.system.states].iter().map(round).collect()
    }

    fn finished(mut self) -> SweepReport {
        // Seeds that were placed and not swept or not judged, for want of time, leave gaps too.
        let left = self.pending.len() + self.unjudged;
        self.report.coverage.uncovered = self.waiting.len() + left;
        self.report.coverage.widest = self
            .report
            .coverage
            .widest
            .max(f64::from(self.waiting.widest()));
        self.report.sample =
            (self.sampler).finish(self.plan.spec.dim(), self.plan.run.levels.len());
        self.report
    }
}
