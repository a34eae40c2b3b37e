//! Time as a further coordinate of a map, on a finite horizon.
//!
//! At every point of an extremal V(x, t) is the cost from there on; its slopes are p and dV/dt =
//! -H. Dynamics and cost do not depend on time, so the problem from (x, t) is that of a horizon of
//! T - t, and V(x, T) is the terminal cost.

use super::Work;
use super::tasks::Task;
use crate::backend::BackendError;
use crate::backend::cpu::{Cpu, Evaluator};
use crate::hamiltonian::Hamiltonian;
use crate::model::{Horizon, MapAim, Model};
use crate::program::Program;
use crate::shooting::{End, Path, Solver};
use crate::sweep::{Choices, Plan};
use crate::value::{Archive, ConjugatePoints, Track, TrackPoints, solver};
use std::collections::BTreeMap;

/// Times at which the first states are searched, in equal steps: each sets up a search of its own.
const FIRST_TIMES: usize = 4;
/// Coarsest step of times at which states are searched later, of the horizon.
const LEVELS: usize = 16;
/// Finest step of times at which states are searched, as a share of the horizon: of more times more
/// problems are set up.
const FINEST: f64 = 1.0 / 4096.0;
/// States whose remaining time is a smaller share of the horizon than this are at its end.
const AT_END: f64 = 1.0 / 4096.0;

/// The time axis of a map.
pub(super) struct TimeAxis {
    /// Final time.
    pub last: f64,
    energy: Evaluator,
    end: End,
    conjugate: ConjugatePoints,
    hamiltonian: Hamiltonian,
    /// The problems of shorter horizons, by the bits of their first time (times are not negative).
    shorter: BTreeMap<u64, Shorter>,
}

/// The problem from a later time on.
pub(super) struct Shorter {
    pub plan: Plan,
    pub model: Model,
    pub solver: Solver,
    pub archive: Archive,
}

impl TimeAxis {
    /// That of a map, if it has one.
    ///
    /// # Errors
    /// What the backend refuses to compile.
    pub fn of(plan: &Plan, model: &Model, aim: &MapAim) -> Result<Option<Self>, BackendError> {
        let system = &plan.system;
        let terminal = system.terminal.as_ref().filter(|_| aim.time && !plan.game);
        // What a plan was made of was derived.
        let (Some(terminal), Ok(hamiltonian)) = (terminal, Hamiltonian::derive(model)) else {
            return Ok(None);
        };
        let energy = Program::lower(
            &system.graph,
            &system.inputs,
            &[system.observer.hamiltonian],
        );
        Ok(Some(Self {
            last: terminal.time,
            energy: Evaluator::new(&energy),
            end: End::new(system, None),
            conjugate: ConjugatePoints::new(plan)?,
            hamiltonian,
            shorter: BTreeMap::new(),
        }))
    }

    /// When a path begins.
    pub fn begins(&self, path: &Path) -> f64 {
        (self.last - path.horizon()).max(0.0)
    }

    /// Tracks without those, of other sheets, that have a conjugate point: such a one is not even
    /// locally the least, and no sheet that may become it.
    pub fn unfolded(
        &mut self,
        tracks: Vec<Track>,
        others: &[bool],
    ) -> Result<Vec<Track>, BackendError> {
        let paths: Vec<&Path> = (tracks.iter().zip(others))
            .filter_map(|(t, other)| other.then_some(&t.path))
            .collect();
        let mut absent = self.conjugate.absent(&paths)?.into_iter();
        let stays = |(track, other): (Track, &bool)| {
            (!other || absent.next() == Some(true)).then_some(track)
        };
        Ok(tracks.into_iter().zip(others).filter_map(stays).collect())
    }

    /// dV/dt at nodes `(s, p)`.
    pub fn rates(&self, nodes: &[f64], width: usize) -> Vec<f64> {
        let mut all = self.energy.eval(nodes, width);
        all.iter_mut().for_each(|h| *h = -*h);
        all
    }

    pub fn is_at_end(&self, t: f64) -> bool {
        self.last - t < AT_END * self.last
    }

    /// `(s, p)` and V at the end of the horizon.
    pub fn at_end(&self, s: &[f64]) -> (Vec<f64>, f64) {
        let at = self.end.at(s);
        ([s, &at.gradient].concat(), at.value)
    }

    /// A time near `t` of few: about `coarse` apart.
    pub fn of_few(&self, t: f64, coarse: f64) -> f64 {
        let mut step = self.last / LEVELS as f64;
        while step > coarse.max(FINEST * self.last) {
            step *= 0.5;
        }
        ((t / step).round() * step).clamp(0.0, self.last)
    }

    /// The problem from a time on.
    pub fn from(
        &mut self,
        t: f64,
        plan: &Plan,
        model: &Model,
    ) -> Result<&mut Shorter, BackendError> {
        if !self.shorter.contains_key(&t.to_bits()) {
            let mut model = model.clone();
            if let Horizon::Finite { final_time, .. } = &mut model.horizon {
                *final_time = self.last - t;
            }
            let choices = Choices {
                rtol: Some(plan.rtol_asked),
                unasked: true,
                dispensable: true,
                ..Choices::default()
            };
            let plan = Plan::new(&model, &self.hamiltonian, &Cpu::new(), choices)
                .expect("what can be planned can be on a shorter horizon");
            let made = Shorter {
                solver: solver(&plan, &Cpu::new())?,
                archive: Archive::new(&plan),
                plan,
                model,
            };
            self.shorter.insert(t.to_bits(), made);
        }
        Ok(self.shorter.get_mut(&t.to_bits()).expect("it was made"))
    }
}

impl Work<'_, '_> {
    /// States one after the other, their times of few.
    pub(super) fn of_levels(&self, mut states: Vec<Vec<f64>>) -> Vec<f64> {
        if let Some(axis) = &self.axis {
            for x in &mut states {
                let t = x.last_mut().expect("time is the last");
                let times = FIRST_TIMES as f64;
                *t = (*t / axis.last * times).floor().min(times - 1.0) * axis.last / times;
            }
        }
        states.into_iter().flatten().collect()
    }

    /// Moves the time of a continuation task's state to one of few, which are as close as its cell
    /// is short.
    pub(super) fn to_few_times(&self, task: &Task, x: &mut [f64]) {
        let (Some(axis), Some(t)) = (&self.axis, x.last_mut()) else {
            return;
        };
        let few = axis.of_few(*t, self.extent_in_time(task));
        if !axis.is_at_end(few) {
            *t = few;
        }
    }

    /// How far a continuation task's cell reaches in time.
    fn extent_in_time(&self, task: &Task) -> f64 {
        let v = task.half.len();
        let n = self.frame.inverse_row(v - 1);
        n.iter().zip(&task.half).map(|(r, h)| (r * h).abs()).sum()
    }

    /// A state, without its time and as many periods away as a point of the cloud, and the path
    /// from that point to begin with.
    pub(super) fn way(&self, x: &[f64], from: u32) -> (Vec<f64>, Path) {
        let mut path = self.guess(from);
        let Some(axis) = &self.axis else {
            return (x.to_vec(), path);
        };
        let n = x.len() - 1;
        path.set_horizon(axis.last - x[n]);
        (x[..n].to_vec(), path)
    }

    /// Takes out continuation tasks to the end of the horizon: there nothing is solved.
    pub(super) fn take_ends(&mut self, tasks: &mut Vec<Task>) {
        let is_at_end = |e: &mut Task| {
            (self.axis.as_ref()).is_some_and(|axis| axis.is_at_end(e.x[e.x.len() - 1]))
        };
        let ends: Vec<Vec<f64>> = tasks.extract_if(.., is_at_end).map(|e| e.x).collect();
        self.add_ends(&ends);
    }

    /// Points at the end of the horizon, where V is the terminal cost, at states (with a time or
    /// without).
    pub(super) fn add_ends(&mut self, states: &[Vec<f64>]) {
        let Some(axis) = &self.axis else { return };
        let n = self.plan.system.states;
        let reference = &self.plan.system.reference;
        let mut found = TrackPoints {
            states: n,
            ..TrackPoints::default()
        };
        let mut tracks = Vec::new();
        // Any state, but of one with a period only the copies that are looked at.
        let bounds: Vec<[f64; 2]> = (self.farthest().into_iter().zip(&self.plan.periods))
            .map(|(bounds, period)| period.map_or([f64::NEG_INFINITY, f64::INFINITY], |_| bounds))
            .collect();
        for x in states {
            let s: Vec<f64> = x.iter().zip(reference).map(|(x, r)| x - r).collect();
            let (node, value) = axis.at_end(&s);
            if value > self.most_value() || !value.is_finite() {
                continue;
            }
            found.push(&node, value, (self.tracks.len() + tracks.len()) as u32, 0.0);
            tracks.push(Track {
                path: Path::new(&node),
                value,
                sheet: 0,
                whole: false,
            });
        }
        self.keep(tracks, found, (&bounds, &bounds));
    }
}
