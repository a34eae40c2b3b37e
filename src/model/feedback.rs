//! `[feedback]`: a law to fit to optimal trajectories.

use super::{Guard, Span};

/// The function of a network's hidden units.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Activation {
    /// 1 / (1 + exp(-z))
    Logistic,
    Tanh,
}

impl Activation {
    pub const ALL: [(&'static str, Activation); 2] = [
        ("logistic", Activation::Logistic),
        ("tanh", Activation::Tanh),
    ];

    pub fn name(self) -> &'static str {
        Activation::ALL
            .iter()
            .find(|(_, a)| *a == self)
            .map_or("?", |(n, _)| n)
    }
}

/// What a law commands: a control, or a state that is to follow the command. The index among its
/// kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LawOutput {
    Control(usize),
    State(usize),
}

/// What is fitted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Target {
    /// Values of these, at least one.
    Law(Vec<LawOutput>),
    /// V; the law is u*(x, dV/dx).
    Value,
}

/// What the network's output is added to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Base {
    None,
    /// The linear-quadratic solution at the equilibrium. The network is made to vanish there: to
    /// first order in a law's value, to second order in V.
    Local,
}

/// One law of `[feedback]`.
#[derive(Clone, Debug)]
pub struct Feedback {
    /// `network` where the section is not divided into named laws.
    pub name: String,
    pub target: Target,
    /// States that the network sees, by index.
    pub inputs: Vec<usize>,
    /// Units of each hidden layer; none: an affine map.
    pub hidden: Vec<usize>,
    pub activation: Activation,
    pub base: Base,
    /// Data are taken from here: bounds of each state.
    pub bounds: Vec<[f64; 2]>,
    /// What else holds for states from which data are taken.
    pub conditions: Vec<Guard>,
    /// Data are taken up to this V.
    pub value_max: Option<f64>,
    /// Trainings from different random weights, of which the best counts.
    pub starts: usize,
    pub seed: u64,
    /// Most steps of a training.
    pub iterations: usize,
    /// Steps without an improvement on the validation set after which a training ends.
    pub patience: usize,
    /// Most samples of all three sets together.
    pub max_samples: usize,
    /// Whether dV/dx is fitted along with V.
    pub gradient: bool,
    /// Shares of the trajectories.
    pub validation: f64,
    pub test: f64,
    pub span: Span,
}
