//! Initial states of the closed loop: a grid, or random ones.

use super::{Chart, LoopError};
use crate::model::{ClosedLoop, Model, Start};
use crate::numeric::random::uniform;
use crate::value::{Grid, spaced};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

/// Picks along each of the first two axes of a grid (and of random states in all) that are kept
/// whole.
const PICKS: usize = 3;

/// Where the closed loop starts.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Initial {
    /// `[initial][state]`.
    pub x: Vec<f64>,
    pub states: usize,
    /// States that vary in the grid and their values; empty where states are random. The last axis
    /// varies fastest.
    pub axes: Vec<(usize, Vec<f64>)>,
    /// Of a part of all initial states those, by their place in it, whose trajectories are kept.
    pub kept_of_part: Option<Vec<usize>>,
}

impl Initial {
    /// The scene's initial states; `random` and `seed` replace its own.
    ///
    /// # Errors
    /// [`LoopError::NoRange`] where nothing varies that is to be drawn at random,
    /// [`LoopError::NoCount`].
    pub fn new(
        model: &Model,
        asked: &ClosedLoop,
        random: Option<usize>,
        seed: u64,
    ) -> Result<Self, LoopError> {
        match random.or(asked.random) {
            Some(count) => Self::random(asked, count, seed),
            None => Self::of_axes(model, &asked.initial),
        }
    }

    /// The grid of some axes, one a state.
    ///
    /// # Errors
    /// [`LoopError::NoCount`].
    pub fn of_axes(model: &Model, starts: &[Start]) -> Result<Self, LoopError> {
        let mut all: Vec<Vec<f64>> = Vec::new();
        let mut axes = Vec::new();
        for (i, start) in starts.iter().enumerate() {
            let values = match *start {
                Start::Fixed(x) => vec![x],
                Start::Range { count: None, .. } => {
                    let axis = model.states[i].variable.name.clone();
                    return Err(LoopError::NoCount { axis });
                }
                Start::Range {
                    first,
                    last,
                    count: Some(count),
                } => {
                    let values = spaced(first, last, count);
                    axes.push((i, values.clone()));
                    values
                }
            };
            all.push(values);
        }
        Ok(Self {
            states: all.len(),
            x: Grid { axes: all }.points(),
            axes,
            kept_of_part: None,
        })
    }

    /// Each state is a function of the seed and its number alone.
    fn random(asked: &ClosedLoop, count: usize, seed: u64) -> Result<Self, LoopError> {
        let n = asked.initial.len();
        if !asked
            .initial
            .iter()
            .any(|s| matches!(s, Start::Range { .. }))
        {
            return Err(LoopError::NoRange);
        }
        let x = (0..count * n)
            .map(|k| match asked.initial[k % n] {
                Start::Fixed(x) => x,
                Start::Range { first, last, .. } => {
                    first + (last - first) * uniform(seed, k as u64)
                }
            })
            .collect();
        Ok(Self {
            x,
            states: n,
            ..Self::default()
        })
    }

    pub fn count(&self) -> usize {
        self.x.len() / self.states.max(1)
    }

    pub fn state(&self, i: usize) -> &[f64] {
        &self.x[i * self.states..][..self.states]
    }

    /// Some of them, by their numbers, which rise. Kept are those that are kept of all.
    pub fn some(&self, numbers: &[usize]) -> Self {
        let kept = self.kept().into_iter();
        Self {
            x: (numbers.iter())
                .flat_map(|k| self.state(*k))
                .copied()
                .collect(),
            states: self.states,
            axes: Vec::new(),
            kept_of_part: Some(
                kept.filter_map(|k| numbers.binary_search(&k).ok())
                    .collect(),
            ),
        }
    }

    /// Lengths of the axes.
    pub fn counts(&self) -> Vec<usize> {
        self.axes.iter().map(|(_, values)| values.len()).collect()
    }

    /// Initial states whose trajectories are kept for pictures: the corners, sides' middles and
    /// middle of the first two axes, at the middle of others; of random states the first few.
    pub fn kept(&self) -> Vec<usize> {
        if let Some(kept) = &self.kept_of_part {
            return kept.clone();
        }
        if self.axes.is_empty() {
            return (0..self.count().min(PICKS * PICKS)).collect();
        }
        let counts = self.counts();
        let mut all = vec![0];
        for (k, count) in counts.iter().enumerate() {
            let picks: Vec<usize> = if k < 2 {
                (0..PICKS).map(|j| j * (count - 1) / (PICKS - 1)).collect()
            } else {
                vec![(count - 1) / 2]
            };
            all = (all.iter())
                .flat_map(|i| picks.iter().map(move |j| i * count + j))
                .collect();
        }
        all.sort_unstable();
        all.dedup();
        all
    }

    /// V of a chart at all of them; NaN where it has none.
    pub fn values(&self, chart: Option<&dyn Chart>) -> Vec<f64> {
        let Some(chart) = chart else {
            return vec![f64::NAN; self.count()];
        };
        (self.x.par_chunks(self.states))
            .map(|x| chart.local(x).map_or(f64::NAN, |local| local.v))
            .collect()
    }

    /// V at those of them that are among given states (`[state][n]`), to a rounding error in units
    /// of `widths`.
    pub fn looked_up(&self, states: &[f64], values: &[f64], widths: &[f64]) -> Vec<f64> {
        const SAME: f64 = 1e-9;
        let n = self.states;
        // By cells around the first coordinate: few share one.
        let key = |x: f64| (x / (widths[0] * 1e-6)).floor() as i64;
        let mut cells: FxHashMap<i64, Vec<usize>> = FxHashMap::default();
        for (k, x) in states.chunks_exact(n).enumerate() {
            cells.entry(key(x[0])).or_default().push(k);
        }
        let same = |a: &[f64], b: &[f64]| (0..n).all(|i| (a[i] - b[i]).abs() <= SAME * widths[i]);
        (self.x.chunks_exact(n))
            .map(|x| {
                let near = (-1..=1).flat_map(|d| cells.get(&(key(x[0]) + d)).into_iter().flatten());
                let found = near.copied().find(|k| same(x, &states[k * n..][..n]));
                found.map_or(f64::NAN, |k| values[k])
            })
            .collect()
    }
}
