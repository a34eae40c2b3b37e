//! A law: a network, what is added to it, and what it means.

use super::network::Network;
use super::weights::{self, NetworkError, Weights, matrix_text, quoted, vector_text};
use crate::diagnostics::Problem;
use crate::expr::{Graph, Id};
use crate::hamiltonian::Hamiltonian;
use crate::model::Model;
use nalgebra::DMatrix;
use rustc_hash::FxHashMap;

/// What the output is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Meaning {
    /// Controls (or states that are to follow a command), before their bounds are applied.
    Law,
    /// V; the controls are u*(x, dV/dx).
    Value,
}

impl Meaning {
    /// As in the scene's `fit` and the weights file's `kind`.
    pub fn name(self) -> &'static str {
        match self {
            Meaning::Law => "u",
            Meaning::Value => "V",
        }
    }
}

/// `constant + linear d + 1/2 d' quadratic d` with `d` the inputs less `center`.
#[derive(Clone, Debug, PartialEq)]
pub struct Polynomial {
    pub center: Vec<f64>,
    /// One an output.
    pub constant: Vec<f64>,
    /// `outputs x inputs`.
    pub linear: DMatrix<f64>,
    /// Of the only output, symmetric; for V.
    pub quadratic: Option<DMatrix<f64>>,
}

/// A network with what is added to its outputs.
#[derive(Clone, Debug, PartialEq)]
pub struct Law {
    pub meaning: Meaning,
    pub network: Network,
    pub base: Option<Polynomial>,
}

/// A law as expressions of the states, with numbers for the parameters.
#[derive(Clone, Debug)]
pub struct ClosedForm {
    pub graph: Graph,
    /// All states, in the scene's order.
    pub x: Vec<Id>,
    /// What the law commands: names of controls or states.
    pub outputs: Vec<String>,
    /// Commands, within the scene's bounds on controls.
    pub commands: Vec<Id>,
    /// V and dV/dx, of a value function.
    pub value: Option<(Id, Vec<Id>)>,
    /// u*(x, p) of symbols p, which `commands` is at dV/dx; of a value function.
    pub optimal: Option<Optimal>,
}

/// Controls as functions of x and p.
#[derive(Clone, Debug)]
pub struct Optimal {
    pub p: Vec<Id>,
    pub commands: Vec<Id>,
}

/// Why a law does not fit a scene.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LawError {
    #[error("the law's input `{0}` is not a state of the scene")]
    Input(String),
    #[error("the law's output `{0}` is neither a control nor a state of the scene")]
    Output(String),
    #[error("a value function must have all states as inputs; `{0}` is missing")]
    Missing(String),
}

impl Polynomial {
    pub(super) fn eval(&self, x: &[f64], output: usize) -> f64 {
        let d: Vec<f64> = x.iter().zip(&self.center).map(|(x, c)| x - c).collect();
        let mut sum = self.constant[output];
        for (i, di) in d.iter().enumerate() {
            sum += self.linear[(output, i)] * di;
            if let Some(q) = &self.quadratic {
                let row: f64 = d.iter().enumerate().map(|(j, dj)| q[(i, j)] * dj).sum();
                sum += 0.5 * di * row;
            }
        }
        sum
    }

    /// The value of an output as an expression.
    fn expression(&self, graph: &mut Graph, x: &[Id], output: usize) -> Id {
        let mut terms = vec![graph.constant(self.constant[output])];
        let d: Vec<Id> = (x.iter().zip(&self.center))
            .map(|(x, c)| {
                let c = graph.constant(*c);
                graph.sub(*x, c)
            })
            .collect();
        for i in 0..d.len() {
            let slope = graph.constant(self.linear[(output, i)]);
            terms.push(graph.mul(slope, d[i]));
            let Some(q) = &self.quadratic else { continue };
            for j in 0..=i {
                let factor = if i == j { 0.5 * q[(i, i)] } else { q[(i, j)] };
                let factor = graph.constant(factor);
                let product = graph.mul(d[i], d[j]);
                terms.push(graph.mul(factor, product));
            }
        }
        graph.sum(&terms)
    }
}

impl Law {
    /// Reads a weights file: a plain network is a law.
    ///
    /// # Errors
    /// Everything that is wrong with it, with its places.
    pub fn from_toml(text: &str, file: &str) -> Result<Self, NetworkError> {
        weights::read(text, file, |weights| {
            let meaning = weights.meaning();
            let network = weights.network(&["kind", "base"])?;
            let (inputs, outputs) = (network.inputs.len(), network.outputs.len());
            if meaning == Some(Meaning::Value) && outputs != 1 {
                let problem = format!("kind = \"V\" has one output, not {outputs}");
                weights.problems.push(Problem::at(0..0, problem, ""));
            }
            let base = match weights.root.contains_key("base") {
                true => Some(weights.base(inputs, outputs)?),
                false => None,
            };
            Some(Self {
                meaning: meaning?,
                network,
                base,
            })
        })
    }

    /// Reads a weights file.
    ///
    /// # Errors
    /// Also where the file cannot be read.
    pub fn load(path: &std::path::Path) -> Result<Self, NetworkError> {
        let read = crate::files::read_text(path);
        let text = read.map_err(|source| NetworkError::Read {
            path: path.to_owned(),
            source,
        })?;
        Self::from_toml(&text, &path.display().to_string())
    }

    /// The weights file's text.
    pub fn to_toml(&self) -> String {
        let mut text = format!("kind = {}\n", quoted(self.meaning.name()));
        text += &self.network.to_toml();
        if let Some(base) = &self.base {
            text += "\n# Added to the network: constant + linear d + 1/2 d' quadratic d, d = inputs - center.\n[base]\n";
            text += &format!("center = {}\n", vector_text(base.center.iter().copied()));
            text += &format!(
                "constant = {}\n",
                vector_text(base.constant.iter().copied())
            );
            text += &format!("linear = {}\n", matrix_text(&base.linear));
            if let Some(quadratic) = &base.quadratic {
                text += &format!("quadratic = {}\n", matrix_text(quadratic));
            }
        }
        text
    }

    /// Outputs at a point of the inputs, before any bounds.
    pub fn eval(&self, x: &[f64]) -> Vec<f64> {
        let mut outputs = self.network.eval(x);
        if let Some(base) = &self.base {
            for (i, output) in outputs.iter_mut().enumerate() {
                *output += base.eval(x, i);
            }
        }
        outputs
    }

    /// The outputs as expressions of the inputs, before any bounds.
    pub fn expressions(&self, graph: &mut Graph, inputs: &[Id]) -> Vec<Id> {
        let outputs = self.network.expressions(graph, inputs);
        let Some(base) = &self.base else {
            return outputs;
        };
        let add = |(i, output)| {
            let rest = base.expression(graph, inputs, i);
            graph.add(output, rest)
        };
        outputs.into_iter().enumerate().map(add).collect()
    }

    /// The law in a scene: bounds on controls applied, and u* derived from a value function.
    ///
    /// # Errors
    /// [`LawError`] where the names are not those of the scene.
    pub fn closed_form(
        &self,
        model: &Model,
        hamiltonian: &Hamiltonian,
    ) -> Result<ClosedForm, LawError> {
        let mut graph = hamiltonian.graph.clone();
        let state = |name: &String| model.states.iter().position(|s| s.variable.name == *name);
        let inputs: Vec<usize> = (self.network.inputs.iter())
            .map(|name| state(name).ok_or_else(|| LawError::Input(name.clone())))
            .collect::<Result<_, _>>()?;
        let symbols: Vec<Id> = inputs.iter().map(|i| hamiltonian.x[*i]).collect();
        let outputs = self.expressions(&mut graph, &symbols);
        let mut closed = ClosedForm {
            x: hamiltonian.x.clone(),
            outputs: self.network.outputs.clone(),
            commands: Vec::new(),
            value: None,
            optimal: None,
            graph,
        };
        match self.meaning {
            Meaning::Law => closed.bounded(model, &outputs)?,
            Meaning::Value => {
                let missing = (0..model.states.len()).find(|i| !inputs.contains(i));
                if let Some(i) = missing {
                    return Err(LawError::Missing(model.states[i].variable.name.clone()));
                }
                closed.optimal(model, hamiltonian, outputs[0]);
            }
        }
        Ok(closed)
    }
}

impl ClosedForm {
    fn bounded(&mut self, model: &Model, outputs: &[Id]) -> Result<(), LawError> {
        for (name, &output) in self.outputs.iter().zip(outputs) {
            let control = model.controls.iter().find(|c| c.variable.name == *name);
            let known = control.is_some() || model.states.iter().any(|s| s.variable.name == *name);
            if !known {
                return Err(LawError::Output(name.clone()));
            }
            let mut command = output;
            if let Some(min) = control.and_then(|c| c.min) {
                let min = self.graph.constant(min);
                command = self.graph.max(command, min);
            }
            if let Some(max) = control.and_then(|c| c.max) {
                let max = self.graph.constant(max);
                command = self.graph.min(command, max);
            }
            self.commands.push(command);
        }
        Ok(())
    }

    fn optimal(&mut self, model: &Model, hamiltonian: &Hamiltonian, value: Id) {
        let graph = &mut self.graph;
        let numbers: FxHashMap<Id, Id> = (model.parameter_values().into_iter())
            .map(|(symbol, value)| (symbol, graph.constant(value)))
            .collect();
        let commands = graph.substitute(&hamiltonian.control, &numbers);
        let p: Vec<Id> = hamiltonian
            .x
            .iter()
            .map(|x| graph.diff(value, *x))
            .collect();
        let slopes = hamiltonian
            .p
            .iter()
            .copied()
            .zip(p.iter().copied())
            .collect();
        self.commands = graph.substitute(&commands, &slopes);
        self.outputs = model
            .controls
            .iter()
            .map(|c| c.variable.name.clone())
            .collect();
        self.value = Some((value, p));
        self.optimal = Some(Optimal {
            p: hamiltonian.p.clone(),
            commands,
        });
    }
}

impl Weights<'_> {
    fn meaning(&mut self) -> Option<Meaning> {
        let Some(value) = self.root.get("kind") else {
            return Some(Meaning::Law);
        };
        let all = [Meaning::Law, Meaning::Value];
        let text = value.get_ref().as_str();
        match all.into_iter().find(|m| Some(m.name()) == text) {
            Some(meaning) => Some(meaning),
            None => self.refuse(value.span(), "kind must be \"u\" or \"V\"", "not known"),
        }
    }

    /// The table `[base]`.
    fn base(&mut self, inputs: usize, outputs: usize) -> Option<Polynomial> {
        let (key, value) = self.root.get_key_value("base")?;
        let toml::de::DeValue::Table(table) = value.get_ref() else {
            return self.refuse(value.span(), "`base` must be a table", "expected a table");
        };
        for (key, _) in table.iter() {
            let known = ["center", "constant", "linear", "quadratic"];
            if !known.contains(&key.get_ref().as_ref()) {
                let message = format!("unknown key `{}` in [base]", key.get_ref());
                return self.refuse(key.span(), message, "not a key here");
            }
        }
        let mut sized = |name: &str, rows: usize, columns: usize| -> Option<DMatrix<f64>> {
            let Some(value) = table.get(name) else {
                return self.refuse(key.span(), format!("[base] has no {name}"), "missing here");
            };
            let matrix = if name == "linear" || name == "quadratic" {
                self.matrix(value, name)?
            } else {
                let row = self.vector(value, name)?;
                DMatrix::from_row_slice(1, row.len(), &row)
            };
            if matrix.shape() != (rows, columns) {
                let (r, c) = matrix.shape();
                let message = format!("{name} must be {rows} x {columns}, not {r} x {c}");
                return self.refuse(value.span(), message, "another size");
            }
            Some(matrix)
        };
        Some(Polynomial {
            center: sized("center", 1, inputs)?.as_slice().to_vec(),
            constant: sized("constant", 1, outputs)?.as_slice().to_vec(),
            linear: sized("linear", outputs, inputs)?,
            quadratic: match table.contains_key("quadratic") {
                true => Some(sized("quadratic", inputs, inputs)?),
                false => None,
            },
        })
    }
}
