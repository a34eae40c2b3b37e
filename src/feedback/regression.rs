//! The least-squares problem of a fit, in normalized variables: residuals, cost, and the normal
//! equations of a step.

use super::shape::{Pass, Shape};
use crate::backend::Deadline;
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

/// Parts into which the samples are divided: a fixed number, summed in order, so that results do
/// not depend on threads.
const PARTS: usize = 16;
/// Rows of the Jacobian that are multiplied at once.
const ROWS: usize = 256;
/// Columns of the normal matrix that are computed at once: of blocks above the diagonal none is.
const BLOCK: usize = 64;

/// Where the network is made to vanish, by subtracting its value there, and its slopes where
/// `slopes`.
#[derive(Clone, Debug)]
pub(super) struct Pinned {
    pub at: Vec<f64>,
    pub slopes: bool,
}

/// What a network is to reproduce.
#[derive(Clone, Debug, Default)]
pub(super) struct Regression {
    pub inputs: usize,
    pub outputs: usize,
    /// `[sample][input]`
    pub x: Vec<f64>,
    /// `[sample][output]`
    pub y: Vec<f64>,
    /// Of the only output by each input, `[sample][input]`; empty: not fitted.
    pub slopes: Vec<f64>,
    pub pinned: Option<Pinned>,
    /// Bound on the length of each first unit's weights: beyond it the cost rises steeply (see
    /// `units`).
    pub steepest: Option<f64>,
}

/// Values at the pinned place, and their derivatives by the weights.
struct Anchor {
    /// One an output.
    values: Vec<f64>,
    /// One an input, of the only output; empty where slopes are not pinned.
    slopes: Vec<f64>,
    value_rows: Vec<Vec<f64>>,
    slope_rows: Vec<Vec<f64>>,
}

/// `J'J`, `J'r` and half of `r'r`.
#[derive(Clone, Debug)]
pub(super) struct Normal {
    pub matrix: DMatrix<f64>,
    pub gradient: DVector<f64>,
    pub cost: f64,
}

impl Regression {
    pub fn samples(&self) -> usize {
        self.x.len() / self.inputs.max(1)
    }

    /// Number of residuals.
    pub fn residuals(&self) -> usize {
        self.y.len() + self.slopes.len()
    }

    fn anchor(&self, shape: &Shape, weights: &[f64], rows: bool) -> Option<Anchor> {
        let pinned = self.pinned.as_ref()?;
        let mut pass = shape.pass();
        let values = shape.forward(weights, &pinned.at, &mut pass).to_vec();
        let mut anchor = Anchor {
            values,
            slopes: Vec::new(),
            value_rows: Vec::new(),
            slope_rows: Vec::new(),
        };
        if rows {
            for output in 0..self.outputs {
                let mut row = vec![0.0; shape.parameters()];
                shape.by_weights(weights, output, 1.0, &mut pass, &mut row);
                anchor.value_rows.push(row);
            }
        }
        for input in 0..if pinned.slopes { self.inputs } else { 0 } {
            anchor
                .slopes
                .push(shape.slope(weights, input, &mut pass)[0]);
            if rows {
                let mut row = vec![0.0; shape.parameters()];
                shape.slope_by_weights(weights, 0, 1.0, &mut pass, &mut row);
                anchor.slope_rows.push(row);
            }
        }
        Some(anchor)
    }

    /// Residuals of a sample: outputs, then slopes.
    fn residual(
        &self,
        shape: &Shape,
        weights: &[f64],
        anchor: Option<&Anchor>,
        k: usize,
        pass: &mut Pass,
        out: &mut Vec<f64>,
    ) {
        out.clear();
        let x = &self.x[k * self.inputs..][..self.inputs];
        let y = &self.y[k * self.outputs..][..self.outputs];
        out.extend(
            shape
                .forward(weights, x, pass)
                .iter()
                .zip(y)
                .map(|(n, y)| n - y),
        );
        if let Some(anchor) = anchor {
            out.iter_mut()
                .zip(&anchor.values)
                .for_each(|(r, v)| *r -= v);
            let distance = x.iter().zip(self.pinned_at()).map(|(x, at)| x - at);
            out[0] -= distance
                .zip(&anchor.slopes)
                .map(|(d, s)| d * s)
                .sum::<f64>();
        }
        if !self.slopes.is_empty() {
            for input in 0..self.inputs {
                let pinned = anchor
                    .and_then(|a| a.slopes.get(input))
                    .copied()
                    .unwrap_or(0.0);
                let slope = shape.slope(weights, input, pass)[0];
                out.push(slope - pinned - self.slopes[k * self.inputs + input]);
            }
        }
    }

    fn pinned_at(&self) -> &[f64] {
        self.pinned.as_ref().map_or(&[], |p| &p.at)
    }

    /// Every `stride`-th sample.
    pub fn thinned(&self, stride: usize) -> Self {
        let take = |values: &[f64], width: usize| -> Vec<f64> {
            values
                .chunks(width.max(1))
                .step_by(stride)
                .flatten()
                .copied()
                .collect()
        };
        Self {
            x: take(&self.x, self.inputs),
            y: take(&self.y, self.outputs),
            slopes: take(&self.slopes, self.inputs),
            ..self.clone()
        }
    }

    /// Units of the first layer that are steeper than the bound: where their weights begin, the
    /// length of these, and the residual that stands for the excess. It weighs as all data together
    /// do.
    fn too_steep(&self, shape: &Shape, weights: &[f64]) -> Vec<(usize, f64, f64)> {
        let Some(steepest) = self.steepest else {
            return Vec::new();
        };
        let weight = (self.residuals() as f64).sqrt();
        let units = weights[..shape.places()[0][1]]
            .chunks(self.inputs)
            .enumerate();
        units
            .map(|(unit, row)| {
                let length = row.iter().map(|w| w * w).sum::<f64>().sqrt();
                (
                    unit * self.inputs,
                    length,
                    weight * (length / steepest - 1.0),
                )
            })
            .filter(|(.., excess)| *excess > 0.0)
            .collect()
    }

    fn parts(&self) -> Vec<std::ops::Range<usize>> {
        let samples = self.samples();
        let bound = |part: usize| part * samples / PARTS;
        (0..PARTS)
            .map(|part| bound(part)..bound(part + 1))
            .collect()
    }

    /// Half the sum of squares; `None` once the deadline has passed.
    pub fn cost(&self, shape: &Shape, weights: &[f64], deadline: Deadline) -> Option<f64> {
        let anchor = self.anchor(shape, weights, false);
        let part = |range: std::ops::Range<usize>| {
            let (mut pass, mut residual) = (shape.pass(), Vec::new());
            let mut sum = 0.0;
            for k in range {
                if k % ROWS == 0 {
                    deadline.check().ok()?;
                }
                self.residual(shape, weights, anchor.as_ref(), k, &mut pass, &mut residual);
                sum += residual.iter().map(|r| r * r).sum::<f64>();
            }
            Some(sum)
        };
        let sums = self.parts().into_par_iter().map(part);
        let sums: Vec<f64> = sums.collect::<Option<_>>()?;
        let excess = self.too_steep(shape, weights);
        Some(0.5 * (sums.iter().sum::<f64>() + excess.iter().map(|(.., r)| r * r).sum::<f64>()))
    }

    /// The normal equations of a Gauss-Newton step; `None` once the deadline has passed: of
    /// thousands of weights they take seconds.
    pub fn normal(&self, shape: &Shape, weights: &[f64], deadline: Deadline) -> Option<Normal> {
        let anchor = self.anchor(shape, weights, true);
        let parts: Vec<Normal> = (self.parts().into_par_iter())
            .map(|range| self.part((shape, weights), anchor.as_ref(), range, deadline))
            .collect::<Option<_>>()?;
        let size = shape.parameters();
        let mut total = Normal {
            matrix: DMatrix::zeros(size, size),
            gradient: DVector::zeros(size),
            cost: 0.0,
        };
        for part in parts {
            total.matrix += part.matrix;
            total.gradient += part.gradient;
            total.cost += part.cost;
        }
        for (begin, length, excess) in self.too_steep(shape, weights) {
            total.cost += 0.5 * excess * excess;
            // Of the residual by the unit's weights.
            let slope = (self.residuals() as f64).sqrt()
                / (self.steepest.unwrap_or(f64::INFINITY) * length);
            let row = begin..begin + self.inputs;
            for i in row.clone() {
                total.gradient[i] += slope * weights[i] * excess;
                for j in begin..=i {
                    total.matrix[(i, j)] += slope * slope * weights[i] * weights[j];
                }
            }
        }
        Some(total)
    }

    fn part(
        &self,
        (shape, weights): (&Shape, &[f64]),
        anchor: Option<&Anchor>,
        range: std::ops::Range<usize>,
        deadline: Deadline,
    ) -> Option<Normal> {
        let size = shape.parameters();
        let mut normal = Normal {
            matrix: DMatrix::zeros(size, size),
            gradient: DVector::zeros(size),
            cost: 0.0,
        };
        // One column a residual.
        let mut columns = DMatrix::zeros(size, ROWS);
        let (mut used, mut pass, mut residual) = (0, shape.pass(), Vec::new());
        let mut residuals = DVector::zeros(ROWS);
        for k in range {
            self.residual(shape, weights, anchor, k, &mut pass, &mut residual);
            for (i, r) in residual.iter().enumerate() {
                residuals[used] = *r;
                normal.cost += 0.5 * r * r;
                let column = &mut columns.as_mut_slice()[used * size..][..size];
                column.fill(0.0);
                self.row(shape, weights, anchor, k, i, &mut pass, column);
                used += 1;
                if used == ROWS {
                    deadline.check().ok()?;
                    normal.add(&columns, &residuals, used);
                    used = 0;
                }
            }
        }
        normal.add(&columns, &residuals, used);
        Some(normal)
    }

    /// Derivatives of residual `i` of sample `k` by the weights, after [`Self::residual`].
    #[allow(clippy::too_many_arguments, reason = "one sample's part of a sum")]
    fn row(
        &self,
        shape: &Shape,
        weights: &[f64],
        anchor: Option<&Anchor>,
        k: usize,
        i: usize,
        pass: &mut Pass,
        row: &mut [f64],
    ) {
        let subtract = |from: &mut [f64], what: &[f64], factor: f64| {
            from.iter_mut()
                .zip(what)
                .for_each(|(r, w)| *r -= factor * w);
        };
        if i < self.outputs {
            shape.by_weights(weights, i, 1.0, pass, row);
            if let Some(anchor) = anchor {
                subtract(row, &anchor.value_rows[i], 1.0);
                let x = &self.x[k * self.inputs..][..self.inputs];
                for ((slope, x), at) in anchor.slope_rows.iter().zip(x).zip(self.pinned_at()) {
                    subtract(row, slope, x - at);
                }
            }
        } else {
            let input = i - self.outputs;
            shape.slope(weights, input, pass);
            shape.slope_by_weights(weights, 0, 1.0, pass, row);
            if let Some(slope) = anchor.and_then(|a| a.slope_rows.get(input)) {
                subtract(row, slope, 1.0);
            }
        }
    }
}

impl Normal {
    /// Adds the residuals' columns of derivatives, of which `used` count. Above the diagonal blocks
    /// nothing is added.
    fn add(&mut self, columns: &DMatrix<f64>, residuals: &DVector<f64>, used: usize) {
        if used == 0 {
            return;
        }
        let size = self.gradient.len();
        let columns = columns.columns(0, used);
        let transposed = columns.transpose();
        for begin in (0..size).step_by(BLOCK) {
            let width = BLOCK.min(size - begin);
            let mut block = self.matrix.view_mut((begin, begin), (size - begin, width));
            let lower = columns.rows(begin, size - begin);
            block.gemm(1.0, &lower, &transposed.columns(begin, width), 1.0);
        }
        self.gradient
            .gemv(1.0, &columns, &residuals.rows(0, used), 1.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Activation;
    use crate::numeric::random::random;

    fn numbers(count: usize, seed: u64) -> Vec<f64> {
        (0..count)
            .map(|i| random(seed, i as u64) as f64 / 2f64.powi(63) - 1.0)
            .collect()
    }

    fn problems() -> Vec<(Shape, Regression)> {
        let pinned = |slopes| Pinned {
            at: vec![0.1, -0.2],
            slopes,
        };
        let choices = [
            (2, None, false),
            (1, None, true),
            (2, Some(pinned(false)), false),
            (1, Some(pinned(true)), true),
        ];
        let make = |(outputs, pinned, slopes): (usize, Option<Pinned>, bool)| {
            let samples = 70;
            let shape = Shape {
                sizes: vec![2, 4, 3, outputs],
                activation: Activation::Tanh,
            };
            let regression = Regression {
                inputs: 2,
                outputs,
                x: numbers(2 * samples, 1),
                y: numbers(outputs * samples, 2),
                slopes: if slopes {
                    numbers(2 * samples, 3)
                } else {
                    Vec::new()
                },
                pinned,
                steepest: None,
            };
            (shape, regression)
        };
        choices.into_iter().map(make).collect()
    }

    /// The gradient against central differences of the cost (about 100; h^2 and rounding leave
    /// 1e-8), and the lower triangle of the matrix against products of differences of residuals.
    #[test]
    fn normal_equations_are_those_of_finite_differences() {
        let h = 1e-5;
        for (shape, mut problem) in problems() {
            let weights = numbers(shape.parameters(), 9);
            // Two of the four units are beyond it.
            let mut lengths: Vec<f64> = weights[..8].chunks(2).map(|w| w[0].hypot(w[1])).collect();
            lengths.sort_by(f64::total_cmp);
            problem.steepest = Some(0.5 * (lengths[1] + lengths[2]));
            let never = Deadline::default();
            let normal = problem.normal(&shape, &weights, never).unwrap();
            let cost = problem.cost(&shape, &weights, never).unwrap();
            let over = Deadline::after(std::time::Duration::ZERO);
            assert!(problem.cost(&shape, &weights, over).is_none());
            assert!((normal.cost - cost).abs() < 1e-11 * cost);
            let all = |weights: &[f64]| -> Vec<f64> {
                let anchor = problem.anchor(&shape, weights, false);
                let (mut pass, mut residual, mut out) = (shape.pass(), Vec::new(), Vec::new());
                for k in 0..problem.samples() {
                    problem.residual(
                        &shape,
                        weights,
                        anchor.as_ref(),
                        k,
                        &mut pass,
                        &mut residual,
                    );
                    out.extend_from_slice(&residual);
                }
                let excess = problem.too_steep(&shape, weights);
                out.extend(
                    (0..4).map(|unit| excess.iter().find(|e| e.0 == 2 * unit).map_or(0.0, |e| e.2)),
                );
                out
            };
            let residuals = DVector::from_vec(all(&weights));
            assert_eq!(problem.too_steep(&shape, &weights).len(), 2);
            assert_eq!(residuals.len(), problem.residuals() + 4);
            let mut jacobian = DMatrix::zeros(residuals.len(), weights.len());
            for i in 0..weights.len() {
                let [up, down] = [h, -h].map(|h| {
                    let mut moved = weights.clone();
                    moved[i] += h;
                    DVector::from_vec(all(&moved))
                });
                jacobian.set_column(i, &((up - down) / (2.0 * h)));
            }
            let gradient = jacobian.transpose() * &residuals;
            assert!(
                (&gradient - &normal.gradient).amax() < 1e-7,
                "{}",
                (&gradient - &normal.gradient).amax()
            );
            let product = jacobian.transpose() * &jacobian;
            for i in 0..weights.len() {
                for j in 0..=i {
                    assert!((product[(i, j)] - normal.matrix[(i, j)]).abs() < 1e-7);
                }
            }
        }
    }
}
