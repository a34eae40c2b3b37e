//! Cells whose trajectories turn between their levels, in parts: between levels near each other a
//! cell is no more bent than its division by seeds leaves it.

use super::cell::{Cell, Corners, OfSeeds, Place};
use super::{Cover, Open, STRAIGHT, holds};
use crate::backend::BackendError;
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use smallvec::SmallVec;
use std::collections::BTreeMap;

/// Parts of a cell.
const PARTS: usize = 8;
/// States are located in parts that, if bent so, may hold them.
const ABOUT: f64 = 0.2;

/// The trajectories of a cell's seeds between its levels.
pub(super) struct Close {
    /// A seed: its points `(t, s, p, V)`, where parts meet.
    traces: OfSeeds<Vec<f64>>,
    /// Numbers of a point.
    stride: usize,
    /// Of each part its corners, and bounds beyond which it holds no state.
    parts: Vec<(Corners, Bounds)>,
}

type Bounds = SmallVec<[[f64; 2]; 3]>;

/// Which of some leaves turn, and the trajectories of their seeds between levels.
pub(super) struct Closely {
    turn: Vec<bool>,
    /// By seed and level.
    traces: FxHashMap<(u32, usize), Vec<f64>>,
}

/// A part of a cell, and where in it a state lies.
pub(super) struct Part {
    /// The points `(t, s, p, V)` of its corners.
    pub points: Vec<Vec<f64>>,
    pub corners: Corners,
    /// Its share is that of the part.
    pub place: Place,
    /// Share of the way between the cell's levels.
    pub share: f64,
}

impl Part {
    /// `(t, s, p, V)` at its place.
    pub fn at_place(&self) -> Vec<f64> {
        let (weights, share) = (&self.place.weights, self.place.share);
        let mut mean = vec![0.0; self.points[0].len()];
        for (i, point) in self.points.iter().enumerate() {
            let layer = if i < weights.len() {
                1.0 - share
            } else {
                share
            };
            let weight = weights[i % weights.len()] * layer;
            (mean.iter_mut().zip(point)).for_each(|(m, x)| *m += weight * x);
        }
        mean
    }
}

impl Close {
    fn new(traces: OfSeeds<Vec<f64>>, stride: usize, widths: &[f64]) -> Self {
        let mut this = Self {
            traces,
            stride,
            parts: Vec::with_capacity(PARTS),
        };
        for part in 0..PARTS {
            let corners = Corners::of_points(&this.points(part), widths);
            let bounds = corners.bounds(widths.len(), ABOUT);
            this.parts.push((corners, bounds));
        }
        this
    }

    /// The part in which a state (in widths) lies, or of those about it the one that it is least
    /// outside.
    pub fn locate(&self, state: &[f64]) -> Option<Part> {
        let parts = (self.parts.iter().enumerate())
            .filter(|(_, (_, bounds))| holds(bounds, state))
            .filter_map(|(part, (corners, _))| {
                Some((part, corners, corners.locate(state, self.traces.len())?))
            });
        let nearest = parts.min_by(|a, b| a.2.outside.total_cmp(&b.2.outside));
        nearest.map(|(part, corners, place)| Part {
            points: self.points(part).iter().map(|p| p.to_vec()).collect(),
            corners: corners.clone(),
            share: (part as f64 + place.share) / PARTS as f64,
            place,
        })
    }

    /// The points of a part's corners.
    fn points(&self, part: usize) -> SmallVec<[&[f64]; 8]> {
        (part..=part + 1)
            .flat_map(|at| self.traces.iter().map(move |trace| self.point(trace, at)))
            .collect()
    }

    fn point<'t>(&self, trace: &'t [f64], at: usize) -> &'t [f64] {
        &trace[at * self.stride..(at + 1) * self.stride]
    }
}

impl Cover<'_> {
    /// What is to be seen at the leaves whose trajectories turn between their levels.
    ///
    /// # Errors
    /// Device failures only.
    pub(super) fn look_closely(&self, leaves: &[Open]) -> Result<Closely, BackendError> {
        let turn: Vec<bool> = leaves.par_iter().map(|leaf| self.turns(leaf)).collect();
        let mut of_level: BTreeMap<usize, Vec<u32>> = BTreeMap::new();
        for (leaf, _) in leaves.iter().zip(&turn).filter(|(_, turns)| **turns) {
            let seeds = of_level.entry(leaf.cell.level).or_default();
            seeds.extend(&leaf.cell.seeds);
        }
        let mut traces: FxHashMap<(u32, usize), Vec<f64>> = FxHashMap::default();
        let steps: Vec<_> = (of_level.into_par_iter())
            .map(|(level, mut seeds)| {
                seeds.sort_unstable();
                seeds.dedup();
                let traces = self.trace_step(level, &seeds)?;
                Ok((level, seeds, traces))
            })
            .collect::<Result<_, BackendError>>()?;
        for (level, seeds, of_level) in steps {
            traces.extend(seeds.into_iter().map(|seed| (seed, level)).zip(of_level));
        }
        Ok(Closely { turn, traces })
    }

    /// A leaf in parts, if its trajectories turn.
    pub(super) fn close(&self, closely: &Closely, leaf: usize, cell: &Cell) -> Option<Close> {
        let widths = &self.fan.plan.widths;
        if !closely.turn[leaf] {
            return None;
        }
        let traces = (cell.seeds.iter())
            .map(|seed| closely.traces.get(&(*seed, cell.level)).cloned())
            .collect::<Option<OfSeeds<Vec<f64>>>>()?;
        let stride = 2 + 2 * widths.len();
        let complete = traces.iter().all(|t| t.len() == (PARTS + 1) * stride);
        complete.then(|| Close::new(traces, stride, widths))
    }

    /// Whether a leaf's trajectories turn.
    fn turns(&self, leaf: &Open) -> bool {
        let seeds = leaf.cell.seeds.len();
        let longest = leaf.corners.longest(seeds, self.fan.plan.system.states).2;
        let stray = || self.stray(&leaf.cell, &leaf.corners, longest);
        self.stationary && leaf.corners.complete() && stray() > STRAIGHT
    }

    /// Points of trajectories from a level to the next one.
    fn trace_step(&self, level: usize, seeds: &[u32]) -> Result<Vec<Vec<f64>>, BackendError> {
        let (from, step) = (self.fan.along_to(level), self.fan.step(level));
        let levels: Vec<f64> = (usize::from(level == 0)..=PARTS)
            .map(|k| from + step * k as f64 / PARTS as f64)
            .collect();
        let starts: Vec<Vec<f64>> = seeds.iter().map(|seed| self.fan.start(*seed)).collect();
        let starts: Vec<&[f64]> = starts.iter().map(Vec::as_slice).collect();
        let mut traces = self.fan.traces(&starts, &levels)?;
        if level == 0 {
            for (trace, start) in traces.iter_mut().zip(&starts) {
                trace.splice(0..0, std::iter::once(0.0).chain(start.iter().copied()));
            }
        }
        Ok(traces)
    }
}
