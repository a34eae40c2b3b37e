//! Levenberg-Marquardt with early stopping, from several random starts.
//!
//! The steps solve `(J'J + d I) s = -J'r` (in normalized variables, so one damping d fits all
//! weights); d follows the ratio of actual to predicted decrease (Nielsen 1999). The
//! `levenberg-marquardt` crate is not used: it keeps the whole Jacobian (residuals x weights) for a
//! QR factorization, and is bound to an older nalgebra.

use super::cholesky;
use super::regression::{Normal, Regression};
use super::shape::Shape;
use crate::backend::Deadline;
use crate::numeric::random::random;
use nalgebra::DVector;
use rayon::prelude::*;

/// First damping, relative to the largest diagonal entry of the normal matrix.
const FIRST_DAMPING: f64 = 1e-3;
/// A training that gains less than this relatively in `patience` steps has converged.
const STALLED: f64 = 1e-4;
/// Residuals of this size in normalized variables are rounding.
const ROUNDING: f64 = 1e-13;
/// Starts are trained on a part of the samples with at least so many residuals a weight, and the
/// best of them on all.
const A_WEIGHT: usize = 12;

/// How a training goes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rules {
    pub starts: usize,
    pub seed: u64,
    pub iterations: usize,
    pub patience: usize,
    /// Then the training is given up.
    pub deadline: Deadline,
}

/// A step that has been taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    pub start: usize,
    pub iteration: usize,
    /// Root mean squares of the normalized residuals.
    pub training: f64,
    pub validation: f64,
}

/// The best weights of a training.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Trained {
    pub start: usize,
    pub weights: Vec<f64>,
    /// Steps up to these weights.
    pub iterations: usize,
    pub training: f64,
    pub validation: f64,
}

/// Trains from all starts on a part of the samples, and the one best on the validation set on all.
/// Neither the order in which starts finish nor the number of threads changes it. `progress` is
/// called from all threads. `None` where the deadline came before.
pub(super) fn train(
    shape: &Shape,
    training: &Regression,
    validation: &Regression,
    rules: Rules,
    progress: &(dyn Fn(Step) + Sync),
) -> Option<Trained> {
    let stride = training.residuals() / (A_WEIGHT * shape.parameters());
    let part = (stride > 1).then(|| training.thinned(stride));
    let all: Vec<Option<Trained>> = (0..rules.starts)
        .into_par_iter()
        .map(|start| {
            let first = initial(shape, random(rules.seed, start as u64));
            let data = [part.as_ref().unwrap_or(training), validation];
            descend(shape, data, rules, (start, first), progress)
        })
        .collect();
    let all: Vec<Trained> = all.into_iter().collect::<Option<_>>()?;
    let best = all
        .into_iter()
        .min_by(|a, b| a.validation.total_cmp(&b.validation));
    let best = best.expect("there is at least one start");
    if part.is_none() {
        return Some(best);
    }
    let further = descend(
        shape,
        [training, validation],
        rules,
        (best.start, best.weights),
        progress,
    )?;
    Some(Trained {
        iterations: best.iterations + further.iterations,
        ..further
    })
}

/// A normally distributed number (Box and Muller).
fn normal(seed: u64, index: u64) -> f64 {
    let unit = |k| (random(seed, 2 * index + k) as f64 + 0.5) / 2f64.powi(64);
    (-2.0 * unit(0).ln()).sqrt() * (std::f64::consts::TAU * unit(1)).cos()
}

/// Random weights, so that what goes into the units is of the order of 1 and their centres are
/// spread over the data.
fn initial(shape: &Shape, seed: u64) -> Vec<f64> {
    let mut weights = vec![0.0; shape.parameters()];
    let last = shape.sizes.len() - 2;
    // A logistic unit is half as steep as tanh.
    let steep = match shape.activation {
        crate::model::Activation::Logistic => 2.0,
        crate::model::Activation::Tanh => 1.0,
    };
    for (l, [begin, biases, end]) in shape.places().into_iter().enumerate() {
        let size = if l < last { steep } else { 1.0 } / (shape.sizes[l] as f64).sqrt();
        (begin..biases).for_each(|i| weights[i] = size * normal(seed, i as u64));
        if l < last {
            (biases..end).for_each(|i| weights[i] = steep * normal(seed, i as u64));
        }
    }
    weights
}

/// Trains from a start's weights; `data` are for training and for validation. `None` where the
/// deadline came before.
fn descend(
    shape: &Shape,
    [training, validation]: [&Regression; 2],
    rules: Rules,
    (start, mut weights): (usize, Vec<f64>),
    progress: &(dyn Fn(Step) + Sync),
) -> Option<Trained> {
    let deadline = rules.deadline;
    let mean = |cost: f64, r: &Regression| (2.0 * cost / r.residuals().max(1) as f64).sqrt();
    let measured = |iterations: usize, weights: Vec<f64>, cost: f64| {
        let checked = validation.cost(shape, &weights, deadline)?;
        Some(Trained {
            start,
            validation: mean(checked, validation),
            training: mean(cost, training),
            iterations,
            weights,
        })
    };
    let mut equations = training.normal(shape, &weights, deadline)?;
    let mut damping = Damping::first(&equations);
    let mut best = measured(0, weights.clone(), equations.cost)?;
    let (mut since, mut before) = (0, f64::INFINITY);
    for iteration in 1..=rules.iterations {
        let moved = step(
            shape,
            (training, deadline),
            &weights,
            &equations,
            &mut damping,
        );
        let Some((moved, cost)) = moved else {
            deadline.check().ok()?;
            break;
        };
        let here = measured(iteration, moved, cost)?;
        weights.clone_from(&here.weights);
        progress(Step {
            start,
            iteration,
            training: here.training,
            validation: here.validation,
        });
        let trained = here.training;
        if here.validation < best.validation {
            if here.validation < (1.0 - STALLED) * before {
                (since, before) = (0, here.validation);
            }
            best = here;
        }
        since += 1;
        if since > rules.patience || trained < ROUNDING {
            break;
        }
        equations = training.normal(shape, &weights, deadline)?;
    }
    Some(best)
}

/// What is added to the diagonal, and by what it grows when a step does not help.
struct Damping {
    d: f64,
    growth: f64,
}

impl Damping {
    fn first(equations: &Normal) -> Self {
        let largest = equations.matrix.diagonal().amax();
        Self {
            d: FIRST_DAMPING * largest.max(f64::MIN_POSITIVE),
            growth: 2.0,
        }
    }
}

/// The next weights and their cost; none where no step is short enough to help, or the deadline
/// has passed.
fn step(
    shape: &Shape,
    (training, deadline): (&Regression, Deadline),
    weights: &[f64],
    equations: &Normal,
    damping: &mut Damping,
) -> Option<(Vec<f64>, f64)> {
    let largest = equations.matrix.diagonal().amax();
    while damping.d <= 1e10 * largest && !deadline.has_passed() {
        let mut matrix = equations.matrix.clone();
        (0..weights.len()).for_each(|i| matrix[(i, i)] += damping.d);
        if let Some(step) = cholesky::solve(matrix, &-&equations.gradient, deadline) {
            let moved: Vec<f64> = weights
                .iter()
                .zip(step.iter())
                .map(|(w, s)| w + s)
                .collect();
            let cost = training.cost(shape, &moved, deadline)?;
            let ratio = (equations.cost - cost) / predicted(&step, equations, damping.d);
            if cost < equations.cost && ratio > 0.0 {
                damping.d *= (1.0 - (2.0 * ratio - 1.0).powi(3)).max(1.0 / 3.0);
                damping.growth = 2.0;
                return Some((moved, cost));
            }
        }
        damping.d *= damping.growth;
        damping.growth *= 2.0;
    }
    None
}

/// Decrease of the cost that the linearized residuals promise.
fn predicted(step: &DVector<f64>, equations: &Normal, damping: f64) -> f64 {
    0.5 * (damping * step.norm_squared() - step.dot(&equations.gradient))
}
