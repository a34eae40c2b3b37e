//! How good a fitted law is on samples that it has not seen.

use super::law::ClosedForm;
use super::samples::{Samples, at_samples};
use crate::expr::Id;
use crate::hamiltonian::Hamiltonian;
use crate::model::Model;
use crate::numeric::quantile::nearest_rank as quantile;
use crate::program::Program;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

/// Errors of one quantity over samples. Differences are in absolute value.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Errors {
    /// Mean difference over the mean absolute value.
    pub mean: f64,
    /// Largest difference over the mean absolute value.
    pub max: f64,
    /// Mean difference over the range of the quantity (largest less smallest value).
    pub mean_of_range: f64,
}

/// What is reported of a law.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Quality {
    pub samples: usize,
    /// Of the outputs; of several the worst in each respect.
    pub u: Errors,
    pub v: Option<Errors>,
    /// Lengths of vectors in units of the region's widths.
    pub p: Option<Errors>,
    pub hjb: Option<Residual>,
    /// Of a law for controls.
    pub loss: Option<Loss>,
}

/// What a law's control loses at a state: `H(x, p, u_fit) - H(x, p, u*)` with the true p, the rate
/// at which cost is lost, relative to the running cost's scale.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Loss {
    /// The running cost L(x, u*) in the mean over the samples.
    pub scale: f64,
    pub mean: f64,
    pub q99: f64,
    pub max: f64,
    /// State of the largest.
    pub at: Vec<f64>,
    /// Box of the states with the largest hundredth, `[lower, upper]` of each state.
    pub worst: Vec<[f64; 2]>,
}

/// Quantiles of `|H(x, dV/dx)|` of a fitted V, relative to the running cost's scale.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Residual {
    /// The running cost L(x, u*) in the mean over the samples.
    pub scale: f64,
    pub median: f64,
    pub q90: f64,
    pub q99: f64,
    pub max: f64,
}

impl Errors {
    /// Of pairs (true, fitted).
    fn of(pairs: impl Iterator<Item = (f64, f64)>) -> Self {
        let (mut count, mut size, mut sum, mut max) = (0.0, 0.0, 0.0, 0.0f64);
        let (mut lowest, mut highest) = (f64::INFINITY, f64::NEG_INFINITY);
        for (truth, fitted) in pairs {
            let error = (truth - fitted).abs();
            count += 1.0;
            size += truth.abs();
            sum += error;
            max = if error.is_nan() {
                f64::NAN
            } else {
                max.max(error)
            };
            (lowest, highest) = (lowest.min(truth), highest.max(truth));
        }
        Self {
            mean: sum / size,
            max: max * count / size,
            mean_of_range: sum / count / (highest - lowest),
        }
    }

    fn worst(self, other: Self) -> Self {
        Self {
            mean: self.mean.max(other.mean),
            max: self.max.max(other.max),
            mean_of_range: self.mean_of_range.max(other.mean_of_range),
        }
    }
}

impl Quality {
    /// `model` is that of the data. `wanted` is what the law is to give: `[sample][output]`.
    pub fn of(
        form: &ClosedForm,
        model: &Model,
        hamiltonian: &Hamiltonian,
        data: &Samples,
        wanted: &[f64],
    ) -> Self {
        let n = data.states;
        let mut roots = form.commands.clone();
        let outputs = roots.len();
        if let Some((value, slopes)) = &form.value {
            roots.push(*value);
            roots.extend(slopes);
        }
        let program = Program::lower(&form.graph, &form.x, &roots);
        let rows: Vec<Vec<f64>> = data.x.par_chunks(n).map(|x| program.eval(x)).collect();
        let of_output = |o: usize| {
            let pairs = rows.iter().zip(wanted.chunks(outputs));
            Errors::of(pairs.map(|(row, wanted)| (wanted[o], row[o])))
        };
        let mut quality = Self {
            samples: data.len(),
            u: (0..outputs)
                .map(of_output)
                .reduce(Errors::worst)
                .unwrap_or_default(),
            ..Self::default()
        };
        quality.loss = Loss::of(form, model, hamiltonian, data, &rows);
        if form.value.is_none() {
            return quality;
        }
        quality.v = Some(Errors::of(
            data.v.iter().zip(&rows).map(|(v, row)| (*v, row[outputs])),
        ));
        let fitted: Vec<f64> = rows
            .iter()
            .flat_map(|row| row[outputs + 1..].to_vec())
            .collect();
        quality.p = Some(slope_errors(model, data, &fitted));
        // V is one function on the circle, of which each piece belongs to a number of rounds.
        let line = data.before_moving();
        let running = at_samples(model, hamiltonian, &[hamiltonian.running], line, &data.p);
        let scale = running.iter().map(|l| l.abs()).sum::<f64>() / running.len() as f64;
        let residual = at_samples(model, hamiltonian, &[hamiltonian.value], line, &fitted);
        let mut sorted: Vec<f64> = residual.iter().map(|h| h.abs() / scale).collect();
        sorted.sort_by(f64::total_cmp);
        quality.hjb = Some(Residual {
            scale,
            median: quantile(&sorted, 0.5),
            q90: quantile(&sorted, 0.9),
            q99: quantile(&sorted, 0.99),
            max: quantile(&sorted, 1.0),
        });
        quality
    }
}

impl Loss {
    /// `rows` begin with the law's outputs at the samples. A command for a state has no loss of its
    /// own.
    fn of(
        form: &ClosedForm,
        model: &Model,
        h: &Hamiltonian,
        data: &Samples,
        rows: &[Vec<f64>],
    ) -> Option<Self> {
        let control = |name: &String| model.controls.iter().position(|c| c.variable.name == *name);
        let controls: Vec<usize> = form.outputs.iter().map(control).collect::<Option<_>>()?;
        let mut graph = h.graph.clone();
        let mut known: FxHashMap<Id, Id> = (model.parameter_values().into_iter())
            .map(|(symbol, value)| (symbol, graph.constant(value)))
            .collect();
        let worst = graph.substitute(&h.disturbance, &known);
        known.extend(model.disturbances.iter().map(|w| w.symbol).zip(worst));
        let roots = graph.substitute(&[h.open], &known);
        let u = model.controls.iter().map(|c| c.variable.symbol);
        let inputs: Vec<Id> = h.x.iter().chain(&h.p).copied().chain(u).collect();
        let program = Program::lower(&graph, &inputs, &roots);
        let line = data.before_moving();
        let n = data.states;
        let running = at_samples(model, h, &[h.running], line, &data.p);
        let scale = running.iter().map(|l| l.abs()).sum::<f64>() / running.len() as f64;
        let lost = |k: usize| {
            let mut u = data.u_of(k).to_vec();
            let at = |u: &[f64]| program.eval(&[&line[k * n..][..n], data.p_of(k), u].concat())[0];
            let least = at(&u);
            controls
                .iter()
                .zip(&rows[k])
                .for_each(|(i, fitted)| u[*i] = *fitted);
            (at(&u) - least) / scale
        };
        let lost: Vec<f64> = (0..data.len()).into_par_iter().map(lost).collect();
        let largest = (0..lost.len()).max_by(|a, b| lost[*a].total_cmp(&lost[*b]))?;
        let mut sorted = lost.clone();
        sorted.sort_by(f64::total_cmp);
        let q99 = quantile(&sorted, 0.99);
        let mut worst = vec![[f64::INFINITY, f64::NEG_INFINITY]; n];
        for k in (0..lost.len()).filter(|k| lost[*k] >= q99) {
            for ([lower, upper], x) in worst.iter_mut().zip(data.x_of(k)) {
                (*lower, *upper) = (lower.min(*x), upper.max(*x));
            }
        }
        Some(Self {
            scale,
            mean: lost.iter().sum::<f64>() / lost.len() as f64,
            q99,
            max: lost[largest],
            at: data.x_of(largest).to_vec(),
            worst,
        })
    }
}

fn slope_errors(model: &Model, data: &Samples, fitted: &[f64]) -> Errors {
    let widths: Vec<f64> = model
        .region
        .iter()
        .map(|[lower, upper]| upper - lower)
        .collect();
    let n = data.states;
    let (mut size, mut sum, mut max, mut largest) = (0.0, 0.0, 0.0f64, 0.0f64);
    for (k, fitted) in fitted.chunks(n).enumerate() {
        let truth = data.p_of(k);
        let length = |of: &dyn Fn(usize) -> f64| {
            (0..n)
                .map(|i| (of(i) * widths[i]).powi(2))
                .sum::<f64>()
                .sqrt()
        };
        let (error, full) = (length(&|i| truth[i] - fitted[i]), length(&|i| truth[i]));
        size += full;
        sum += error;
        max = max.max(error);
        largest = largest.max(full);
    }
    let count = data.len() as f64;
    Errors {
        mean: sum / size,
        max: max * count / size,
        mean_of_range: sum / count / largest,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_by_hand() {
        let errors = Errors::of([(1.0, 1.1), (-3.0, -3.0), (2.0, 1.8)].into_iter());
        // Differences 0.1, 0, 0.2; mean size 2; range from -3 to 2.
        let expected = Errors {
            mean: 0.1 / 2.0,
            max: 0.2 / 2.0,
            mean_of_range: 0.1 / 5.0,
        };
        for (a, b) in [
            (errors.mean, expected.mean),
            (errors.max, expected.max),
            (errors.mean_of_range, expected.mean_of_range),
        ] {
            assert!((a - b).abs() < 1e-15, "{errors:?}");
        }
    }

    #[test]
    fn quantiles_by_hand() {
        let sorted = [1.0, 2.0, 3.0, 4.0];
        assert_eq!(
            [0.5, 0.75, 0.9, 1.0].map(|s| quantile(&sorted, s)),
            [2.0, 3.0, 4.0, 4.0]
        );
    }
}
