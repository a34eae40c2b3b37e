//! A network as a function of its weights: outputs, slopes by the inputs, and the derivatives of
//! both by the weights.
//!
//! The weights are one list: layer by layer, first the matrix by rows, then the biases. Derivatives
//! by the weights are reverse sweeps; those of a slope sweep back through the tangents of the
//! forward pass: with `a = W h + b`, `a' = W h'`, `h = s(a)`, `h' = s'(a) a'`, adjoints `l` of h
//! and `m` of h' give those of a and a', `l s' + m s'' a'` and `m s'`.

use crate::model::Activation;

/// Sizes of the layers and the function of the hidden ones.
#[derive(Clone, Debug, PartialEq)]
pub struct Shape {
    /// Inputs, units of each hidden layer, outputs.
    pub sizes: Vec<usize>,
    pub activation: Activation,
}

/// What a pass through a network leaves for the ones after it; each list has one entry a layer, the
/// inputs first.
#[derive(Clone, Debug)]
pub struct Pass {
    values: Vec<Vec<f64>>,
    first: Vec<Vec<f64>>,
    second: Vec<Vec<f64>>,
    /// Tangents along the direction last asked for: of values, and of what goes into the hidden
    /// units.
    tangents: Vec<Vec<f64>>,
    into: Vec<Vec<f64>>,
    /// Adjoints of what goes into the units of a layer, and of its tangent.
    adjoint: Vec<Vec<f64>>,
    adjoint_tangent: Vec<Vec<f64>>,
}

/// `y = W x (+ y)` for W by rows.
fn product(weights: &[f64], x: &[f64], y: &mut [f64]) {
    for (row, y) in weights.chunks_exact(x.len()).zip(y) {
        *y += row.iter().zip(x).map(|(w, x)| w * x).sum::<f64>();
    }
}

/// `x = W' y`.
fn transposed(weights: &[f64], y: &[f64], x: &mut [f64]) {
    x.fill(0.0);
    for (row, y) in weights.chunks_exact(x.len()).zip(y) {
        x.iter_mut().zip(row).for_each(|(x, w)| *x += w * y);
    }
}

impl Shape {
    /// Layers of weights.
    fn layers(&self) -> usize {
        self.sizes.len() - 1
    }

    #[cfg(test)]
    pub fn inputs(&self) -> usize {
        self.sizes[0]
    }

    #[cfg(test)]
    pub fn outputs(&self) -> usize {
        self.sizes[self.layers()]
    }

    /// Number of weights and biases.
    pub fn parameters(&self) -> usize {
        self.sizes.windows(2).map(|s| (s[0] + 1) * s[1]).sum()
    }

    /// The matrices and biases of all layers, as places in the list: where the matrix begins, the
    /// biases begin and end.
    pub fn places(&self) -> Vec<[usize; 3]> {
        let mut at = 0;
        let place = |s: &[usize]| {
            let (begin, biases) = (at, at + s[0] * s[1]);
            at = biases + s[1];
            [begin, biases, at]
        };
        self.sizes.windows(2).map(place).collect()
    }

    pub fn pass(&self) -> Pass {
        let zeros: Vec<Vec<f64>> = self.sizes.iter().map(|s| vec![0.0; *s]).collect();
        Pass {
            values: zeros.clone(),
            first: zeros.clone(),
            second: zeros.clone(),
            tangents: zeros.clone(),
            into: zeros.clone(),
            adjoint: zeros.clone(),
            adjoint_tangent: zeros,
        }
    }

    /// The outputs at `x`.
    pub fn forward<'p>(&self, weights: &[f64], x: &[f64], pass: &'p mut Pass) -> &'p [f64] {
        pass.values[0].copy_from_slice(x);
        for (l, [begin, biases, end]) in self.places().into_iter().enumerate() {
            let (before, after) = pass.values.split_at_mut(l + 1);
            let h = &mut after[0];
            h.copy_from_slice(&weights[biases..end]);
            product(&weights[begin..biases], &before[l], h);
            if l + 1 < self.layers() {
                for (i, h) in h.iter_mut().enumerate() {
                    *h = self.activation.value(*h);
                    let (first, second) = self.activation.slopes(*h);
                    pass.first[l + 1][i] = first;
                    pass.second[l + 1][i] = second;
                }
            }
        }
        &pass.values[self.layers()]
    }

    /// Derivatives of the outputs by one input, at the last [`Self::forward`].
    pub fn slope<'p>(&self, weights: &[f64], input: usize, pass: &'p mut Pass) -> &'p [f64] {
        pass.tangents[0].fill(0.0);
        pass.tangents[0][input] = 1.0;
        for (l, [begin, biases, _]) in self.places().into_iter().enumerate() {
            let (before, after) = pass.tangents.split_at_mut(l + 1);
            let into = &mut pass.into[l + 1];
            into.fill(0.0);
            product(&weights[begin..biases], &before[l], into);
            after[0].copy_from_slice(into);
            if l + 1 < self.layers() {
                after[0]
                    .iter_mut()
                    .zip(&pass.first[l + 1])
                    .for_each(|(t, s)| *t *= s);
            }
        }
        &pass.tangents[self.layers()]
    }

    /// What goes into each hidden unit, layer by layer, and the length of its gradient by the
    /// inputs.
    pub fn arguments(&self, weights: &[f64], x: &[f64], pass: &mut Pass) -> Vec<(f64, f64)> {
        self.forward(weights, x, pass);
        let hidden = 1..self.layers();
        let mut units: Vec<(f64, f64)> = (pass.values[hidden.clone()].iter().flatten())
            .map(|h| (self.activation.argument(*h), 0.0))
            .collect();
        for input in 0..self.sizes[0] {
            self.slope(weights, input, pass);
            let slopes = pass.into[hidden.clone()].iter().flatten();
            units
                .iter_mut()
                .zip(slopes)
                .for_each(|(unit, s)| unit.1 += s * s);
        }
        units.iter_mut().for_each(|unit| unit.1 = unit.1.sqrt());
        units
    }

    /// Adds `factor` times the derivatives of an output by all weights to `row`, at the last
    /// [`Self::forward`].
    pub fn by_weights(
        &self,
        weights: &[f64],
        output: usize,
        factor: f64,
        pass: &mut Pass,
        row: &mut [f64],
    ) {
        let last = self.layers();
        pass.adjoint[last].fill(0.0);
        pass.adjoint[last][output] = factor;
        for (l, [begin, biases, end]) in self.places().into_iter().enumerate().rev() {
            let (before, after) = pass.adjoint.split_at_mut(l + 1);
            let adjoint = &after[0];
            let width = self.sizes[l];
            for (a, row) in adjoint
                .iter()
                .zip(row[begin..biases].chunks_exact_mut(width))
            {
                row.iter_mut()
                    .zip(&pass.values[l])
                    .for_each(|(r, h)| *r += a * h);
            }
            row[biases..end]
                .iter_mut()
                .zip(adjoint)
                .for_each(|(r, a)| *r += a);
            if l > 0 {
                transposed(&weights[begin..biases], adjoint, &mut before[l]);
                before[l]
                    .iter_mut()
                    .zip(&pass.first[l])
                    .for_each(|(a, s)| *a *= s);
            }
        }
    }

    /// The same for the derivative of an output by an input, at the last [`Self::slope`].
    pub fn slope_by_weights(
        &self,
        weights: &[f64],
        output: usize,
        factor: f64,
        pass: &mut Pass,
        row: &mut [f64],
    ) {
        let last = self.layers();
        pass.adjoint[last].fill(0.0);
        pass.adjoint_tangent[last].fill(0.0);
        pass.adjoint_tangent[last][output] = factor;
        for (l, [begin, biases, end]) in self.places().into_iter().enumerate().rev() {
            let (before, after) = pass.adjoint.split_at_mut(l + 1);
            let (before_tangent, after_tangent) = pass.adjoint_tangent.split_at_mut(l + 1);
            let (adjoint, tangent) = (&after[0], &after_tangent[0]);
            let width = self.sizes[l];
            let (h, h_tangent) = (&pass.values[l], &pass.tangents[l]);
            for ((a, t), row) in
                (adjoint.iter().zip(tangent)).zip(row[begin..biases].chunks_exact_mut(width))
            {
                for ((r, h), ht) in row.iter_mut().zip(h).zip(h_tangent) {
                    *r += a * h + t * ht;
                }
            }
            row[biases..end]
                .iter_mut()
                .zip(adjoint)
                .for_each(|(r, a)| *r += a);
            if l > 0 {
                let matrix = &weights[begin..biases];
                transposed(matrix, adjoint, &mut before[l]);
                transposed(matrix, tangent, &mut before_tangent[l]);
                for i in 0..self.sizes[l] {
                    let m = before_tangent[l][i];
                    before[l][i] =
                        before[l][i] * pass.first[l][i] + m * pass.second[l][i] * pass.into[l][i];
                    before_tangent[l][i] = m * pass.first[l][i];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::random::random;

    fn shapes() -> Vec<Shape> {
        let sizes: [&[usize]; 4] = [&[3, 2], &[2, 5, 1], &[3, 4, 3, 2], &[2, 3, 4, 3, 1]];
        let activations = [Activation::Logistic, Activation::Tanh];
        let all = activations.into_iter().flat_map(|activation| {
            sizes.map(|sizes| Shape {
                sizes: sizes.to_vec(),
                activation,
            })
        });
        all.collect()
    }

    /// Numbers in (-1, 1).
    fn numbers(count: usize, seed: u64) -> Vec<f64> {
        (0..count)
            .map(|i| random(seed, i as u64) as f64 / 2f64.powi(63) - 1.0)
            .collect()
    }

    /// Central differences with h = 1e-5 of values of about 1: rounding 1e-16/1e-5 and h^2 leave
    /// some 1e-10.
    const STEP: f64 = 1e-5;
    const TOLERANCE: f64 = 1e-9;

    fn moved(values: &[f64], i: usize, by: f64) -> Vec<f64> {
        let mut values = values.to_vec();
        values[i] += by;
        values
    }

    #[test]
    fn derivatives_are_those_of_finite_differences() {
        for (k, shape) in shapes().into_iter().enumerate() {
            let weights = numbers(shape.parameters(), k as u64);
            let x = numbers(shape.inputs(), 100 + k as u64);
            let mut pass = shape.pass();
            let mut output =
                |weights: &[f64], x: &[f64], o: usize| shape.forward(weights, x, &mut pass)[o];
            let mut other = shape.pass();
            let mut slope = |weights: &[f64], o: usize, d: usize| {
                shape.forward(weights, &x, &mut other);
                shape.slope(weights, d, &mut other)[o]
            };
            let mut pass = shape.pass();
            let mut compared = 0;
            for o in 0..shape.outputs() {
                let mut row = vec![0.0; shape.parameters()];
                shape.forward(&weights, &x, &mut pass);
                shape.by_weights(&weights, o, 1.0, &mut pass, &mut row);
                for (i, derivative) in row.iter().enumerate() {
                    let [up, down] = [STEP, -STEP].map(|h| output(&moved(&weights, i, h), &x, o));
                    assert!(
                        (derivative - (up - down) / (2.0 * STEP)).abs() < TOLERANCE,
                        "{shape:?}"
                    );
                }
                for d in 0..shape.inputs() {
                    let [up, down] = [STEP, -STEP].map(|h| output(&weights, &moved(&x, d, h), o));
                    shape.forward(&weights, &x, &mut pass);
                    let value = shape.slope(&weights, d, &mut pass)[o];
                    assert!(
                        (value - (up - down) / (2.0 * STEP)).abs() < TOLERANCE,
                        "{shape:?}"
                    );
                    let mut row = vec![0.0; shape.parameters()];
                    shape.slope_by_weights(&weights, o, 1.0, &mut pass, &mut row);
                    for (i, derivative) in row.iter().enumerate() {
                        let [up, down] = [STEP, -STEP].map(|h| slope(&moved(&weights, i, h), o, d));
                        assert!(
                            (derivative - (up - down) / (2.0 * STEP)).abs() < TOLERANCE,
                            "{shape:?}"
                        );
                        compared += 1;
                    }
                }
            }
            assert_eq!(
                compared,
                shape.outputs() * shape.inputs() * shape.parameters()
            );
        }
    }
}
