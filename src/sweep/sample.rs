//! A random sample of a sweep's trajectories, kept whole: what the run's error and stiffness are
//! told from.

use crate::backend::{Status, Trajectories};
use crate::numeric::random::random;
use std::collections::BTreeMap;

/// Trajectories kept at most, and at least where there are so many; between, one of this many.
const MOST: usize = 256;
const LEAST: usize = 64;
const ONE_OF: usize = 8;
/// Bytes that the kept trajectories may take.
const MOST_BYTES: usize = 64 << 20;

/// One trajectory as the backend gave it.
#[derive(Clone, Debug)]
pub struct Kept {
    /// Of the surface of seeds.
    pub parameter: Vec<f64>,
    pub seed: Vec<f64>,
    pub status: Status,
    pub steps: u32,
    pub end_time: f64,
    /// Components of the last point.
    pub end: Vec<f64>,
    /// `[level][1 + dim]`, NaN where a level was not passed.
    pub points: Vec<f64>,
}

/// Trajectories drawn at random, in random order. The choice depends on the seed and the
/// trajectories' numbers alone, not on batches.
#[derive(Clone, Debug, Default)]
pub struct Sample {
    pub kept: Vec<Kept>,
    pub dim: usize,
    pub levels: usize,
}

impl Sample {
    /// Levels that trajectory `i` has passed; they are passed in order.
    pub fn passed(&self, i: usize) -> usize {
        let width = 1 + self.dim;
        (self.kept[i].points.chunks_exact(width))
            .take_while(|p| !p[0].is_nan())
            .count()
    }

    /// Backward time and vector of trajectory `i` at a level.
    pub fn point(&self, i: usize, level: usize) -> &[f64] {
        let width = 1 + self.dim;
        &self.kept[i].points[level * width..][..width]
    }
}

/// Draws while a sweep goes on: each trajectory has a random number, those with the smallest ones
/// are kept.
#[derive(Clone, Debug)]
pub struct Sampler {
    seed: u64,
    most: usize,
    seen: u64,
    kept: BTreeMap<(u64, u64), Kept>,
}

impl Sampler {
    /// For trajectories of `bytes` each.
    pub fn new(seed: u64, bytes: usize) -> Self {
        Self {
            seed,
            most: (MOST_BYTES / bytes.max(1)).clamp(1, MOST),
            seen: 0,
            kept: BTreeMap::new(),
        }
    }

    /// Offers trajectory `i` of a batch.
    pub fn offer(&mut self, i: usize, batch: &Trajectories, seed: &[f64], parameter: &[f64]) {
        let key = (random(self.seed, self.seen), self.seen);
        self.seen += 1;
        if self.kept.len() >= self.most
            && self
                .kept
                .last_key_value()
                .is_some_and(|(last, _)| key > *last)
        {
            return;
        }
        let stride = batch.levels * (1 + batch.dim);
        let kept = Kept {
            parameter: parameter.to_vec(),
            seed: seed.to_vec(),
            status: batch.status[i],
            steps: batch.steps[i],
            end_time: batch.end_time[i],
            end: batch.end[i * batch.dim..][..batch.dim].to_vec(),
            points: batch.samples[i * stride..][..stride].to_vec(),
        };
        self.kept.insert(key, kept);
        if self.kept.len() > self.most {
            self.kept.pop_last();
        }
    }

    pub fn finish(self, dim: usize, levels: usize) -> Sample {
        let wanted = (self.seen as usize / ONE_OF).clamp(LEAST, MOST);
        Sample {
            kept: self.kept.into_values().take(wanted).collect(),
            dim,
            levels,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn draw(seed: u64, count: usize, batch: usize) -> Vec<u32> {
        let mut sampler = Sampler::new(seed, 100);
        let mut next = 0;
        while next < count {
            let size = batch.min(count - next);
            let trajectories = Trajectories {
                dim: 1,
                levels: 0,
                end: vec![0.0; size],
                end_time: vec![0.0; size],
                status: vec![Status::Reached; size],
                steps: (next..next + size).map(|k| k as u32).collect(),
                rejected: vec![0; size],
                lane_steps: 0,
                samples: Vec::new(),
            };
            (0..size).for_each(|i| sampler.offer(i, &trajectories, &[0.0], &[0.0]));
            next += size;
        }
        sampler.finish(1, 0).kept.iter().map(|k| k.steps).collect()
    }

    #[test]
    fn the_sample_depends_on_the_seed_alone() {
        let first = draw(1, 5000, 64);
        assert_eq!(first.len(), MOST);
        assert_eq!(first, draw(1, 5000, 17));
        assert_ne!(first, draw(2, 5000, 64));
        assert_eq!(draw(1, 10, 3).len(), 10);
        assert_eq!(draw(1, 300, 7).len(), LEAST);
    }

    /// Each tenth of the trajectories has about its share: 26 of 256, with a standard deviation of
    /// 4.7.
    #[test]
    fn the_sample_is_spread_evenly() {
        let drawn = draw(3, 5000, 64);
        for tenth in 0..10 {
            let share = drawn.iter().filter(|k| **k / 500 == tenth).count();
            assert!((7..=45).contains(&share), "{share} of tenth {tenth}");
        }
    }
}
