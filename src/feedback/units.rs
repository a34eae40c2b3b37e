//! How steep units are against how dense samples lie: between samples nothing holds a law.

use super::regression::Regression;
use super::shape::Shape;
use crate::model::Activation;
use rayon::prelude::*;

/// Samples whose neighbours are looked for.
const PROBES: usize = 512;
/// Share of them that have a neighbour within the spacing.
const WITHIN: f64 = 0.9;
/// A trained unit's transition is kept this much wider than the spacing.
const MARGIN: f64 = 1.1;

/// Arguments between which a unit does most of its rise (tanh: from -0.76 to 0.76).
fn transition(activation: Activation) -> f64 {
    match activation {
        Activation::Tanh => 2.0,
        // Half as steep.
        Activation::Logistic => 4.0,
    }
}

/// Distance (in normalized variables) within which nine of ten samples have one of another
/// trajectory; 0 where there is none.
pub(super) fn spacing(data: &Regression, trajectory: &[u32]) -> f64 {
    let n = data.inputs;
    let stride = trajectory.len().div_ceil(PROBES).max(1);
    let nearest = |k: usize| {
        let here = &data.x[k * n..][..n];
        (data.x.chunks(n).zip(trajectory))
            .filter(|(_, t)| **t != trajectory[k])
            .map(|(x, _)| {
                x.iter()
                    .zip(here)
                    .map(|(a, b)| (a - b) * (a - b))
                    .sum::<f64>()
            })
            .fold(f64::INFINITY, f64::min)
    };
    let probes: Vec<usize> = (0..trajectory.len()).step_by(stride).collect();
    let mut all: Vec<f64> = probes
        .into_par_iter()
        .map(nearest)
        .filter(|d| d.is_finite())
        .collect();
    all.sort_by(f64::total_cmp);
    if all.is_empty() {
        return 0.0;
    }
    crate::numeric::quantile::nearest_rank(&all, WITHIN).sqrt()
}

/// Largest length of a unit's input weights for which its transition is wider than the spacing;
/// none without hidden units.
pub(super) fn steepest(shape: &Shape, spacing: f64) -> Option<f64> {
    (shape.sizes.len() > 2 && spacing > 0.0)
        .then(|| transition(shape.activation) / (MARGIN * spacing))
}

/// Hidden units, of all layers together, whose transition is narrower than the spacing at a sample
/// that lies in it.
pub(super) fn narrow(shape: &Shape, weights: &[f64], data: &Regression, spacing: f64) -> usize {
    let hidden: usize = shape.sizes[1..shape.sizes.len() - 1].iter().sum();
    let n = data.inputs;
    let marked = |mut marks: (Vec<bool>, super::shape::Pass), x: &[f64]| {
        let units = shape.arguments(weights, x, &mut marks.1);
        for (mark, (argument, slope)) in marks.0.iter_mut().zip(units) {
            *mark |=
                argument.abs() <= slope * spacing && transition(shape.activation) < slope * spacing;
        }
        marks
    };
    let all = data
        .x
        .par_chunks(n)
        .fold(|| (vec![false; hidden], shape.pass()), marked)
        .map(|(marks, _)| marks)
        .reduce(
            || vec![false; hidden],
            |a, b| a.iter().zip(&b).map(|(a, b)| *a || *b).collect(),
        );
    all.iter().filter(|narrow| **narrow).count()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::Deadline;
    use crate::feedback::training::{Rules, train};

    /// A line of samples 0.1 apart, each its own trajectory.
    fn line() -> (Regression, Vec<u32>) {
        let data = Regression {
            inputs: 1,
            outputs: 1,
            x: (0..101).map(|k| 0.1 * f64::from(k) - 5.0).collect(),
            y: vec![0.0; 101],
            ..Regression::default()
        };
        (data, (0..101).collect())
    }

    #[test]
    fn spacing_is_to_other_trajectories() {
        let (data, mut trajectory) = line();
        assert!((spacing(&data, &trajectory) - 0.1).abs() < 1e-12);
        // In pairs: the nearest other one is still beside each.
        trajectory.iter_mut().for_each(|t| *t /= 2);
        assert!((spacing(&data, &trajectory) - 0.1).abs() < 1e-12);
        trajectory.fill(0);
        assert_eq!(spacing(&data, &trajectory), 0.0);
    }

    /// A jump between two samples makes a step of a unit, unless it is held.
    #[test]
    fn a_jump_in_the_data_makes_no_step() {
        let (mut data, trajectory) = line();
        data.y = data.x.iter().map(|x| (x + 0.05).signum()).collect();
        let shape = Shape {
            sizes: vec![1, 2, 1],
            activation: Activation::Tanh,
        };
        let rules = Rules {
            starts: 2,
            seed: 0,
            iterations: 300,
            patience: 300,
            deadline: Deadline::default(),
        };
        let spacing = spacing(&data, &trajectory);
        let trained = |data: &Regression| {
            let trained = train(&shape, data, data, rules, &|_| {}).unwrap();
            (narrow(&shape, &trained.weights, data, spacing), trained)
        };
        assert!(trained(&data).0 > 0);
        data.steepest = steepest(&shape, spacing);
        let (count, held) = trained(&data);
        assert_eq!(count, 0);
        let steep = held.weights[..2].iter().fold(0.0f64, |m, w| m.max(w.abs()));
        // At the bound, not far below it: the jump is there.
        assert!(steep > 0.5 / spacing && steep < 2.0 / spacing, "{steep}");
    }

    /// tanh(w x) rises over 2/w, a logistic unit over 4/w.
    #[test]
    fn a_step_between_samples_is_found() {
        let (data, trajectory) = line();
        let spacing = spacing(&data, &trajectory);
        for (activation, limit) in [(Activation::Tanh, 20.0), (Activation::Logistic, 40.0)] {
            let shape = Shape {
                sizes: vec![1, 2, 1],
                activation,
            };
            // Weights, biases, weights, bias: the second unit's transition lies outside the
            // samples.
            let narrow = |w: f64| {
                narrow(
                    &shape,
                    &[w, w, 0.0, 10.0 * w, 1.0, 1.0, 0.0],
                    &data,
                    spacing,
                )
            };
            assert_eq!(
                (narrow(0.99 * limit), narrow(1.01 * limit)),
                (0, 1),
                "{activation:?}"
            );
            let bound = steepest(&shape, spacing).unwrap();
            assert!(bound < limit && bound > 0.8 * limit);
        }
    }
}
