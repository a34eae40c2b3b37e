//! Feedforward networks: layers of affine maps with an elementwise function between them.

use crate::expr::{Fun, Graph, Id};
pub use crate::model::Activation;
use nalgebra::{DMatrix, DVector};

impl Activation {
    /// Its value, for any z.
    pub fn value(self, z: f64) -> f64 {
        match self {
            // Neither overflows nor loses digits where exp(-z) would.
            Activation::Logistic => 0.5 + 0.5 * (0.5 * z).tanh(),
            Activation::Tanh => z.tanh(),
        }
    }

    /// What it has this value of; infinite where the unit is saturated to rounding.
    pub fn argument(self, value: f64) -> f64 {
        match self {
            Activation::Logistic => (value / (1.0 - value)).ln(),
            Activation::Tanh => value.atanh(),
        }
    }

    /// First and second derivative, from the value.
    pub fn slopes(self, value: f64) -> (f64, f64) {
        match self {
            Activation::Logistic => {
                let first = value * (1.0 - value);
                (first, first * (1.0 - 2.0 * value))
            }
            Activation::Tanh => {
                let first = 1.0 - value * value;
                (first, -2.0 * value * first)
            }
        }
    }
}

/// `z = weights h + bias`.
#[derive(Clone, Debug, PartialEq)]
pub struct Layer {
    /// One row a unit, one column an input of the layer.
    pub weights: DMatrix<f64>,
    pub bias: DVector<f64>,
}

/// `y = W_k s(... s(W_1 x + b_1) ...) + b_k`, with the activation s in all but the last layer.
#[derive(Clone, Debug, PartialEq)]
pub struct Network {
    pub activation: Activation,
    /// What each input is: names of states.
    pub inputs: Vec<String>,
    pub outputs: Vec<String>,
    /// At least one; the sizes fit each other, the inputs and the outputs.
    pub layers: Vec<Layer>,
}

impl Network {
    /// Reads a weights file's text; `file` is for messages.
    ///
    /// # Errors
    /// Everything that is wrong with it, with its places. A law with a part beside the network
    /// (`[base]`), or of a value function, is refused: that is a [`Law`](super::Law).
    pub fn from_toml(text: &str, file: &str) -> Result<Self, super::NetworkError> {
        super::weights::read_network(text, file)
    }

    /// The weights file's text.
    pub fn to_toml(&self) -> String {
        super::weights::write_network(self)
    }

    /// Outputs at one point.
    ///
    /// # Panics
    /// When `x` has not one value an input.
    pub fn eval(&self, x: &[f64]) -> Vec<f64> {
        assert_eq!(x.len(), self.inputs.len(), "one value an input");
        let mut h = DVector::from_column_slice(x);
        for (i, layer) in self.layers.iter().enumerate() {
            h = &layer.weights * &h + &layer.bias;
            if i + 1 < self.layers.len() {
                h.apply(|z| *z = self.activation.value(*z));
            }
        }
        h.as_slice().to_vec()
    }

    /// The outputs as expressions of `inputs`.
    ///
    /// # Panics
    /// When `inputs` has not one node an input.
    pub fn expressions(&self, graph: &mut Graph, inputs: &[Id]) -> Vec<Id> {
        assert_eq!(inputs.len(), self.inputs.len(), "one node an input");
        let mut h = inputs.to_vec();
        for (i, layer) in self.layers.iter().enumerate() {
            h = (0..layer.bias.len())
                .map(|row| {
                    let mut terms = vec![graph.constant(layer.bias[row])];
                    for (column, &input) in h.iter().enumerate() {
                        let weight = graph.constant(layer.weights[(row, column)]);
                        terms.push(graph.mul(weight, input));
                    }
                    graph.sum(&terms)
                })
                .collect();
            if i + 1 < self.layers.len() {
                h = h.into_iter().map(|z| self.unit(graph, z)).collect();
            }
        }
        h
    }

    fn unit(&self, graph: &mut Graph, z: Id) -> Id {
        match self.activation {
            Activation::Tanh => graph.unary(Fun::Tanh, z),
            Activation::Logistic => {
                let half = graph.constant(0.5);
                let argument = graph.mul(half, z);
                let tanh = graph.unary(Fun::Tanh, argument);
                let scaled = graph.mul(half, tanh);
                graph.add(half, scaled)
            }
        }
    }

    /// Number of weights and biases.
    pub fn parameters(&self) -> usize {
        self.layers
            .iter()
            .map(|l| l.weights.len() + l.bias.len())
            .sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::expr::Kind;
    use rustc_hash::FxHashMap;

    const PRINTED: &str = include_str!("../../scenarios/hardt_network.toml");

    fn printed() -> Network {
        Network::from_toml(PRINTED, "hardt_network.toml").unwrap()
    }

    /// With sigma = 4, beta = 1 the printed law is 1.5239 at Phi0 = 1.2 (the weights are printed to
    /// four decimals).
    #[test]
    fn the_printed_law_at_the_equilibrium() {
        let (phi, psi_c0) = (1.2_f64, 0.1469);
        let psi = psi_c0 + 1.0 + 1.5 * phi - 0.5 * phi.powi(3);
        let gamma = printed().eval(&[phi, psi, 0.0]);
        assert_eq!(gamma.len(), 1);
        assert!((gamma[0] - 1.5239).abs() < 5e-5, "{gamma:?}");
    }

    #[test]
    fn a_file_is_read_back_as_it_was() {
        let net = printed();
        assert_eq!(Network::from_toml(&net.to_toml(), "again").unwrap(), net);
        assert_eq!((net.parameters(), net.layers.len()), (51, 2));
    }

    #[test]
    fn expressions_are_the_network() {
        for activation in [Activation::Logistic, Activation::Tanh] {
            let net = Network {
                activation,
                ..printed()
            };
            let mut graph = Graph::new();
            let inputs: Vec<_> = net
                .inputs
                .iter()
                .map(|n| graph.symbol(n, Kind::State))
                .collect();
            let outputs = net.expressions(&mut graph, &inputs);
            for x in [[1.2, 2.0, 0.0], [1.0, 1.6, 0.12], [-40.0, 300.0, 7.0]] {
                let values: FxHashMap<_, _> = inputs.iter().copied().zip(x).collect();
                let (by_graph, by_matrices) = (graph.eval(&outputs, &values)[0], net.eval(&x)[0]);
                // Sums of ten terms of about 10, added in another order.
                assert!(
                    (by_graph - by_matrices).abs() < 1e-13,
                    "{by_graph} {by_matrices}"
                );
            }
        }
    }

    #[test]
    fn slopes_are_derivatives() {
        let h = 1e-4;
        for activation in [Activation::Logistic, Activation::Tanh] {
            for z in [-3.0, -0.4, 0.0, 1.7] {
                let f = |z| activation.value(z);
                assert!((activation.argument(f(z)) - z).abs() < 1e-13);
                let (first, second) = activation.slopes(f(z));
                // Central differences: h^2 times the next derivatives, which are below 8.
                assert!((first - (f(z + h) - f(z - h)) / (2.0 * h)).abs() < 1e-7);
                assert!((second - (f(z + h) - 2.0 * f(z) + f(z - h)) / (h * h)).abs() < 1e-6);
            }
            assert_eq!(activation.value(1e6), 1.0);
            assert_eq!(
                activation.value(-1e6),
                if activation == Activation::Tanh {
                    -1.0
                } else {
                    0.0
                }
            );
        }
    }
}
