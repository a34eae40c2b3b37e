//! Data of a fit: samples of optimal trajectories and solved states, selected, thinned and divided.

use crate::hamiltonian::Hamiltonian;
use crate::map::ValueMap;
use crate::model::{Feedback, Model};
use crate::numeric::random::random;
use crate::program::Program;
use crate::sweep::spread_over;
use crate::trajectories::{SolvedStates, SweptTrajectories};
use crate::value::nearest::{MOST_DIMENSIONS, index};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

/// Points of optimal trajectories.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Samples {
    /// Numbers of states and controls.
    pub states: usize,
    pub controls: usize,
    /// `[sample][state]`
    pub x: Vec<f64>,
    /// dV/dx, `[sample][state]`
    pub p: Vec<f64>,
    /// `[sample][control]`
    pub u: Vec<f64>,
    pub v: Vec<f64>,
    /// x before it was moved by periods: the cost of a state with a period may tell how often it
    /// has gone round. Empty where nothing was moved.
    pub unmoved: Vec<f64>,
    /// The trajectory of each; a solved state is one by itself.
    pub trajectory: Vec<u32>,
}

/// The three sets of a fit, no two of which share a trajectory.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sets {
    pub training: Samples,
    pub validation: Samples,
    pub test: Samples,
}

/// Counts of a selection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Selection {
    /// Samples that there were.
    pub offered: usize,
    /// Of them in the box, under the conditions.
    pub selected: usize,
    /// Of those of these that were looked at, not the cheapest solution at their state.
    pub not_optimal: usize,
    /// What was left after thinning.
    pub kept: usize,
}

/// Whether V is the value function at a state, rather than that of a dearer sheet; `None` where
/// that is not known.
pub type Optimality<'f> = dyn Fn(&[f64], f64) -> Option<bool> + Sync + 'f;

/// Samples among which dearer sheets are looked for: an evenly spread part of more.
const MOST_COMPARED: usize = 300_000;
/// So many times the samples wanted are looked at.
const SPARE: usize = 3;
/// Neighbours that a sample is compared with.
const NEIGHBOURS: usize = 12;
/// By so much of the largest V a sample must be dearer than what a neighbour foretells.
const DEARER: f64 = 1e-6;

impl Samples {
    pub fn len(&self) -> usize {
        self.v.len()
    }

    pub fn is_empty(&self) -> bool {
        self.v.is_empty()
    }

    /// All samples of swept trajectories, and all solved states; `states` and `controls` of the
    /// system.
    pub fn new(
        (states, controls): (usize, usize),
        swept: Option<&SweptTrajectories>,
        solved: Option<&SolvedStates>,
    ) -> Self {
        let mut samples = Samples {
            states,
            controls,
            ..Samples::default()
        };
        let mut trajectory = 0;
        if let Some(all) = swept {
            samples.extend(&all.x, &all.p, &all.u, &all.v);
            for _ in 0..all.count {
                samples
                    .trajectory
                    .extend(std::iter::repeat_n(trajectory, all.samples));
                trajectory += 1;
            }
        }
        if let Some(points) = solved {
            samples.extend(&points.x, &points.p, &points.u, &points.v);
            samples.trajectory.extend((trajectory..).take(points.count));
        }
        samples
    }

    /// With states spread over a box, at which a map to an error tells V, p and u: as many of
    /// `count` as it knows. Of the samples that there are those outside its region stay.
    pub fn with_map(&self, map: &ValueMap, bounds: &[[f64; 2]], count: usize) -> Self {
        let outside = |x: &[f64]| map.outside(x).is_some();
        let beside: Vec<usize> = (0..self.len()).filter(|k| outside(self.x_of(*k))).collect();
        let mut samples = self.take(&beside);
        let (n, m) = (self.states, self.controls);
        let mut spread = spread_over(bounds, count);
        spread.retain(|x| !outside(x));
        let spread = spread.concat();
        let told = map.many(&spread);
        // Each state is one by itself.
        let next = samples.trajectory.iter().max().map_or(0, |last| last + 1);
        for k in (0..told.v.len()).filter(|k| told.v[*k].is_finite()) {
            let (x, p, u) = (
                &spread[k * n..][..n],
                &told.p[k * n..][..n],
                &told.u[k * m..][..m],
            );
            samples.extend(x, p, u, &told.v[k..=k]);
            samples.trajectory.push(next + k as u32);
        }
        samples
    }

    fn extend(&mut self, x: &[f64], p: &[f64], u: &[f64], v: &[f64]) {
        self.x.extend_from_slice(x);
        self.p.extend_from_slice(p);
        self.u.extend_from_slice(u);
        self.v.extend_from_slice(v);
    }

    pub fn x_of(&self, k: usize) -> &[f64] {
        &self.x[k * self.states..][..self.states]
    }

    pub fn p_of(&self, k: usize) -> &[f64] {
        &self.p[k * self.states..][..self.states]
    }

    /// All x as they were before they were moved by periods.
    pub fn before_moving(&self) -> &[f64] {
        if self.unmoved.is_empty() {
            &self.x
        } else {
            &self.unmoved
        }
    }

    pub fn u_of(&self, k: usize) -> &[f64] {
        &self.u[k * self.controls..][..self.controls]
    }

    /// The samples with these numbers.
    pub fn take(&self, which: &[usize]) -> Samples {
        let mut taken = Samples {
            states: self.states,
            controls: self.controls,
            ..Samples::default()
        };
        for &k in which {
            taken.extend(self.x_of(k), self.p_of(k), self.u_of(k), &self.v[k..=k]);
            taken.trajectory.push(self.trajectory[k]);
            if !self.unmoved.is_empty() {
                taken
                    .unmoved
                    .extend(&self.unmoved[k * self.states..][..self.states]);
            }
        }
        taken
    }

    /// The samples that a law is fitted to: complete ones in its box and under its conditions
    /// (states with a period are moved into the box by whole periods), the cheapest solution at
    /// their state, at most `max_samples`, spread evenly. `scene` is the one with the law; `known`
    /// may tell which samples are optimal, and where it cannot, neighbours do.
    pub fn select(
        &self,
        scene: &Model,
        law: &Feedback,
        known: &Optimality<'_>,
    ) -> (Samples, Selection) {
        let mut counts = Selection {
            offered: self.len(),
            ..Selection::default()
        };
        let inside = self.inside(scene, law);
        counts.selected = inside.len();
        let spread = inside.take(&inside.thinned(&law.bounds, MOST_COMPARED, law.seed));
        // Some are left out, for which there are others then.
        let candidates = spread.thinned(&law.bounds, SPARE * law.max_samples, law.seed);
        let kept = spread.optimal(&candidates, &law.bounds, known);
        counts.not_optimal = candidates.len() - kept.len();
        let optimal = spread.take(&kept);
        let samples = optimal.take(&optimal.thinned(&law.bounds, law.max_samples, law.seed));
        counts.kept = samples.len();
        (samples, counts)
    }

    fn inside(&self, scene: &Model, law: &Feedback) -> Samples {
        let symbols: Vec<_> = scene.states.iter().map(|s| s.variable.symbol).collect();
        let mut graph = scene.graph.clone();
        let numbers = (scene.parameter_values().into_iter())
            .map(|(symbol, value)| (symbol, graph.constant(value)))
            .collect();
        let expressions: Vec<_> = law.conditions.iter().map(|c| c.condition.expr).collect();
        let conditions = graph.substitute(&expressions, &numbers);
        let program = Program::lower(&graph, &symbols, &conditions);
        let mut moved = self.clone();
        if scene.states.iter().any(|s| s.period.is_some()) {
            moved.unmoved = self.before_moving().to_vec();
        }
        let mut kept = Vec::new();
        for k in 0..self.len() {
            let x = &mut moved.x[k * self.states..][..self.states];
            for ((x, state), [lower, upper]) in x.iter_mut().zip(&scene.states).zip(&law.bounds) {
                if let Some(period) = state.period
                    && !(*lower..=*upper).contains(x)
                {
                    *x -= period * ((*x - lower) / period).floor();
                }
            }
            let x = &*x;
            let complete = [self.p_of(k), self.u_of(k), &self.v[k..=k], x];
            let complete = complete
                .iter()
                .all(|values| values.iter().all(|v| v.is_finite()));
            let within = x
                .iter()
                .zip(&law.bounds)
                .all(|(x, [lower, upper])| (lower..=upper).contains(&x));
            if !complete || !within || law.value_max.is_some_and(|max| self.v[k] > max) {
                continue;
            }
            let margins = program.eval(x);
            let holds = |(margin, condition): (&f64, &crate::model::Guard)| match condition.strict {
                true => *margin > 0.0,
                false => *margin >= 0.0,
            };
            if margins.iter().zip(&law.conditions).all(holds) {
                kept.push(k);
            }
        }
        moved.take(&kept)
    }

    /// Numbers of at most `most` samples, as evenly spread over the box as they can be: the box is
    /// divided into about so many cells, and cells give one sample each, in turn, as long as they
    /// have some.
    fn thinned(&self, bounds: &[[f64; 2]], most: usize, seed: u64) -> Vec<usize> {
        if self.len() <= most {
            return (0..self.len()).collect();
        }
        let divisions = (most as f64).powf(1.0 / self.states as f64).ceil().max(1.0);
        let cell = |k: usize| -> Vec<u32> {
            let along = self.x_of(k).iter().zip(bounds);
            let along = along.map(|(x, [lower, upper])| divisions * (x - lower) / (upper - lower));
            along
                .map(|place| place.clamp(0.0, divisions - 1.0) as u32)
                .collect()
        };
        let mut order: Vec<usize> = (0..self.len()).collect();
        order.sort_by_cached_key(|k| random(seed, *k as u64));
        let mut taken: FxHashMap<Vec<u32>, usize> = FxHashMap::default();
        let mut turns: Vec<(usize, usize)> = Vec::with_capacity(order.len());
        for (place, k) in order.iter().enumerate() {
            let turn = taken.entry(cell(*k)).or_default();
            turns.push((*turn, place));
            *turn += 1;
        }
        turns.sort_unstable();
        let mut kept: Vec<usize> = turns[..most]
            .iter()
            .map(|(_, place)| order[*place])
            .collect();
        kept.sort_unstable();
        kept
    }

    /// Which of the candidates are the cheapest solution at their state. Where `known` cannot tell,
    /// a sample is taken for dearer if a neighbour of another trajectory, extrapolated along its p,
    /// is cheaper by more than the bend of V between the two (the difference of their p) can be.
    fn optimal(
        &self,
        candidates: &[usize],
        bounds: &[[f64; 2]],
        known: &Optimality<'_>,
    ) -> Vec<usize> {
        let n = self.states;
        if self.is_empty() || n > MOST_DIMENSIONS {
            return candidates.to_vec();
        }
        let widths: Vec<f64> = bounds.iter().map(|[lower, upper]| upper - lower).collect();
        let scaled: Vec<f64> = (self.x.iter().enumerate())
            .map(|(i, x)| x / widths[i % n])
            .collect();
        let tree = index(&scaled, n);
        let slack = DEARER * self.v.iter().copied().fold(0.0, f64::max);
        let cheaper = |k: usize, other: usize| {
            let (mut rise, mut bend) = (0.0, 0.0);
            for i in 0..n {
                let dx = self.x_of(k)[i] - self.x_of(other)[i];
                rise += self.p_of(other)[i] * dx;
                bend += ((self.p_of(k)[i] - self.p_of(other)[i]) * dx).abs();
            }
            self.v[k] > self.v[other] + rise + bend + slack
        };
        (candidates.par_iter().copied())
            .filter(|&k| {
                if let Some(optimal) = known(self.x_of(k), self.v[k]) {
                    return optimal;
                }
                let near = tree.near(&scaled[k * n..][..n], f64::INFINITY, 4 * NEIGHBOURS);
                let others = near
                    .iter()
                    .filter(|(j, _)| self.trajectory[*j] != self.trajectory[k]);
                !others.take(NEIGHBOURS).any(|(j, _)| cheaper(k, *j))
            })
            .collect()
    }

    /// Divides whole trajectories between the sets by the law's shares, at random by its seed.
    /// Every set has at least one trajectory where there are three.
    pub fn split(&self, law: &Feedback) -> Sets {
        let mut trajectories = self.trajectory.clone();
        trajectories.sort_unstable();
        trajectories.dedup();
        trajectories.sort_by_cached_key(|t| random(law.seed ^ 0x5e75, u64::from(*t)));
        let count = trajectories.len() as f64;
        let share = |share: f64| ((share * count).round() as usize).max(1);
        let (validation, test) = (share(law.validation), share(law.test));
        let set: FxHashMap<u32, usize> = (trajectories.into_iter().enumerate())
            .map(|(i, t)| {
                (
                    t,
                    if i < validation {
                        1
                    } else {
                        2 * usize::from(i < validation + test)
                    },
                )
            })
            .collect();
        let of = |which: usize| {
            let members: Vec<usize> = (0..self.len())
                .filter(|k| set[&self.trajectory[*k]] == which)
                .collect();
            self.take(&members)
        };
        Sets {
            training: of(0),
            validation: of(1),
            test: of(2),
        }
    }
}

/// Evaluates expressions of (x, p) at all samples: `[sample][expression]`.
pub(super) fn at_samples(
    model: &Model,
    hamiltonian: &Hamiltonian,
    roots: &[crate::expr::Id],
    x: &[f64],
    p: &[f64],
) -> Vec<f64> {
    let mut graph = hamiltonian.graph.clone();
    let numbers = (model.parameter_values().into_iter())
        .map(|(symbol, value)| (symbol, graph.constant(value)))
        .collect();
    let roots = graph.substitute(roots, &numbers);
    let inputs: Vec<_> = hamiltonian
        .x
        .iter()
        .chain(&hamiltonian.p)
        .copied()
        .collect();
    let program = Program::lower(&graph, &inputs, &roots);
    let n = hamiltonian.states();
    let points: Vec<Vec<f64>> = (x.par_chunks(n).zip(p.par_chunks(n)))
        .map(|(x, p)| program.eval(&[x, p].concat()))
        .collect();
    points.concat()
}
