//! Weights files: TOML with the keys `activation`, `inputs`, `output` (or `outputs`), and `W<i>`,
//! `b<i>` of each layer. The last layer of a single output may be a vector `w<i>` and a number
//! `b<i>`.

use super::network::{Activation, Layer, Network};
use crate::diagnostics::{Problem, ScenarioErrors, did_you_mean};
use crate::model::Span;
use nalgebra::{DMatrix, DVector};
use std::fmt::Write;
use std::path::PathBuf;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// Why a weights file gave no law.
#[derive(Debug, thiserror::Error)]
pub enum NetworkError {
    #[error("cannot read {path}: {source}", path = path.display())]
    Read {
        path: PathBuf,
        source: std::io::Error,
    },
    /// The contents are wrong: each problem with its place.
    #[error(transparent)]
    Contents(#[from] ScenarioErrors),
}

type Value<'a> = Spanned<DeValue<'a>>;

/// Reads values and collects what is wrong with them.
pub(super) struct Weights<'a> {
    pub root: &'a DeTable<'a>,
    pub problems: Vec<Problem>,
}

/// Parses `text` and gives it to `read`; the result counts only where nothing was wrong.
pub(super) fn read<T>(
    text: &str,
    file: &str,
    read: impl FnOnce(&mut Weights<'_>) -> Option<T>,
) -> Result<T, NetworkError> {
    let wrong = |problems| NetworkError::Contents(ScenarioErrors::new(file, text, problems));
    let (document, errors) = DeTable::parse_recoverable(text);
    if !errors.is_empty() {
        let at = |e: &toml::de::Error| e.span().unwrap_or(text.len()..text.len());
        let problems = errors
            .iter()
            .map(|e| Problem::at(at(e), format!("TOML: {}", e.message()), "here"));
        return Err(wrong(problems.collect()));
    }
    let mut weights = Weights {
        root: document.get_ref(),
        problems: Vec::new(),
    };
    match read(&mut weights) {
        Some(value) if weights.problems.is_empty() => Ok(value),
        _ => Err(wrong(weights.problems)),
    }
}

pub(super) fn read_network(text: &str, file: &str) -> Result<Network, NetworkError> {
    read(text, file, |weights| {
        for key in ["kind", "base", "clamp"] {
            if let Some((key, _)) = weights.root.get_key_value(key) {
                let message = format!("`{}` makes this more than a network", key.get_ref());
                weights.refuse::<()>(key.span(), message, "a fitted law");
            }
        }
        weights.network(&["kind", "base", "clamp"])
    })
}

impl<'a> Weights<'a> {
    pub fn refuse<T>(&mut self, span: Span, message: impl Into<String>, label: &str) -> Option<T> {
        self.problems.push(Problem::at(span, message, label));
        None
    }

    fn missing<T>(&mut self, key: &str, what: &str) -> Option<T> {
        self.problems.push(Problem {
            message: format!("`{key}` is missing: {what}"),
            span: None,
            label: String::new(),
            help: None,
        });
        None
    }

    /// The network in the root table, whose keys may also be `further`.
    pub fn network(&mut self, further: &[&str]) -> Option<Network> {
        let count = (1..).take_while(|i| self.layer_key(*i).is_some()).count();
        self.check_keys(count, further);
        let activation = self.activation();
        let inputs = self.names("inputs");
        let outputs = self.outputs();
        if count == 0 {
            return self.missing("W1", "the weights of the first layer");
        }
        let layers: Vec<Option<Layer>> = (1..=count).map(|i| self.layer(i, i == count)).collect();
        let layers: Vec<Layer> = layers.into_iter().collect::<Option<_>>()?;
        let (activation, inputs, outputs) = (activation?, inputs?, outputs?);
        self.check_sizes(&layers, inputs.len(), outputs.len())?;
        Some(Network {
            activation,
            inputs,
            outputs,
            layers,
        })
    }

    fn layer_key(&self, i: usize) -> Option<String> {
        [format!("W{i}"), format!("w{i}")]
            .into_iter()
            .find(|key| self.root.contains_key(key.as_str()))
    }

    fn check_keys(&mut self, layers: usize, further: &[&str]) {
        let mut known: Vec<String> = ["activation", "inputs", "output", "outputs"]
            .map(str::to_owned)
            .to_vec();
        known.extend((1..=layers).filter_map(|i| self.layer_key(i)));
        known.extend((1..=layers).map(|i| format!("b{i}")));
        let all = || {
            known
                .iter()
                .map(String::as_str)
                .chain(further.iter().copied())
        };
        for (key, _) in self.root.iter() {
            let name = key.get_ref().as_ref();
            if !all().any(|k| k == name) {
                let help = did_you_mean(name, all()).unwrap_or_else(|| {
                    format!("keys: activation, inputs, output, W1, b1, ... without a gap; here up to W{layers}")
                });
                let message = format!("unknown key `{name}` in a weights file");
                let problem = Problem::at(key.span(), message, "not a key here").with_help(help);
                self.problems.push(problem);
            }
        }
    }

    fn activation(&mut self) -> Option<Activation> {
        let Some(value) = self.root.get("activation") else {
            return self.missing("activation", "logistic or tanh");
        };
        let text = value.get_ref().as_str();
        let found = Activation::ALL.iter().find(|(name, _)| Some(*name) == text);
        match found {
            Some((_, activation)) => Some(*activation),
            None => self.refuse(
                value.span(),
                "the activation must be \"logistic\" or \"tanh\"",
                "not known",
            ),
        }
    }

    fn outputs(&mut self) -> Option<Vec<String>> {
        match (self.root.get("output"), self.root.get_key_value("outputs")) {
            (Some(_), Some((key, _))) => {
                self.refuse(key.span(), "both `output` and `outputs`", "one of the two")
            }
            (Some(value), None) => match value.get_ref().as_str() {
                Some(name) => Some(vec![name.to_owned()]),
                None => self.refuse(value.span(), "`output` must be a name", "expected a string"),
            },
            (None, _) => self.names("outputs"),
        }
    }

    /// A list of different names.
    pub fn names(&mut self, key: &str) -> Option<Vec<String>> {
        let Some(value) = self.root.get(key) else {
            return self.missing(key, "a list of names");
        };
        let DeValue::Array(array) = value.get_ref() else {
            return self.refuse(
                value.span(),
                format!("`{key}` must be a list of names"),
                "expected an array",
            );
        };
        let mut names: Vec<String> = Vec::new();
        for value in array.iter() {
            match value.get_ref().as_str() {
                Some(name) if names.iter().any(|n| n == name) => {
                    return self.refuse(
                        value.span(),
                        format!("`{name}` a second time"),
                        "every name once",
                    );
                }
                Some(name) => names.push(name.to_owned()),
                None => {
                    return self.refuse(
                        value.span(),
                        "a name must be a string",
                        "expected a string",
                    );
                }
            }
        }
        if names.is_empty() {
            return self.refuse(
                value.span(),
                format!("`{key}` is empty"),
                "at least one name",
            );
        }
        Some(names)
    }

    fn layer(&mut self, i: usize, last: bool) -> Option<Layer> {
        let key = self.layer_key(i)?;
        let value = self.root.get(key.as_str())?;
        let weights = if key.starts_with('W') {
            self.matrix(value, &key)
        } else if last {
            let row = self.vector(value, &key);
            row.map(|row| DMatrix::from_row_slice(1, row.len(), &row))
        } else {
            let message = format!(
                "only the last layer's weights may be a vector; `{key}` is followed by others"
            );
            return self.refuse(value.span(), message, "expected a matrix");
        };
        let name = format!("b{i}");
        let Some(value) = self.root.get(name.as_str()) else {
            return self.missing(&name, &format!("the biases that belong to {key}"));
        };
        let bias = match value.get_ref() {
            DeValue::Array(_) => self.vector(value, &name),
            _ => self.number(value, &name).map(|b| vec![b]),
        };
        let (weights, bias) = (weights?, bias?);
        if weights.nrows() != bias.len() {
            let message = format!(
                "{key} has {} rows, {name} {} values",
                weights.nrows(),
                bias.len()
            );
            return self.refuse(value.span(), message, "one bias a row");
        }
        Some(Layer {
            weights,
            bias: DVector::from_vec(bias),
        })
    }

    fn check_sizes(&mut self, layers: &[Layer], inputs: usize, outputs: usize) -> Option<()> {
        let mut width = (inputs, "inputs".to_owned());
        for (i, layer) in layers.iter().enumerate() {
            let key = self.layer_key(i + 1)?;
            if layer.weights.ncols() != width.0 {
                let message = format!(
                    "{key} has {} columns, but there are {} {}",
                    layer.weights.ncols(),
                    width.0,
                    width.1
                );
                let span = self.root.get(key.as_str())?.span();
                return self.refuse(span, message, "one column each");
            }
            width = (layer.weights.nrows(), format!("rows of {key}"));
        }
        if width.0 != outputs {
            let key = self.layer_key(layers.len())?;
            let span = self.root.get(key.as_str())?.span();
            return self.refuse(
                span,
                format!("{} {}, but {outputs} outputs", width.0, width.1),
                "one row an output",
            );
        }
        Some(())
    }

    /// A finite number.
    pub fn number(&mut self, value: &Value<'_>, what: &str) -> Option<f64> {
        let number = match value.get_ref() {
            DeValue::Integer(n) if n.radix() == 10 => n.as_str().parse::<f64>().ok(),
            DeValue::Float(n) => n.as_str().parse::<f64>().ok(),
            _ => None,
        };
        match number.filter(|n| n.is_finite()) {
            Some(number) => Some(number),
            None => self.refuse(
                value.span(),
                format!("{what} must hold finite numbers"),
                "not one",
            ),
        }
    }

    pub fn vector(&mut self, value: &Value<'_>, what: &str) -> Option<Vec<f64>> {
        match value.get_ref() {
            DeValue::Array(array) if !array.is_empty() => {
                array.iter().map(|v| self.number(v, what)).collect()
            }
            _ => self.refuse(
                value.span(),
                format!("{what} must be a list of numbers"),
                "expected an array",
            ),
        }
    }

    /// A matrix as a list of rows of one length.
    pub fn matrix(&mut self, value: &Value<'_>, what: &str) -> Option<DMatrix<f64>> {
        let DeValue::Array(array) = value.get_ref() else {
            return self.refuse(
                value.span(),
                format!("{what} must be a list of rows"),
                "expected an array",
            );
        };
        let mut rows: Vec<Vec<f64>> = Vec::new();
        for row in array.iter() {
            let numbers = self.vector(row, what)?;
            if rows
                .first()
                .is_some_and(|first| first.len() != numbers.len())
            {
                let message = format!(
                    "{what} has rows of {} and of {} numbers",
                    rows[0].len(),
                    numbers.len()
                );
                return self.refuse(row.span(), message, "another length");
            }
            rows.push(numbers);
        }
        let Some(first) = rows.first() else {
            return self.refuse(value.span(), format!("{what} is empty"), "at least one row");
        };
        Some(DMatrix::from_row_slice(
            rows.len(),
            first.len(),
            &rows.concat(),
        ))
    }
}

/// A list of numbers that is read back as the same numbers.
pub(super) fn vector_text(values: impl IntoIterator<Item = f64>) -> String {
    let texts: Vec<String> = values.into_iter().map(|v| format!("{v:?}")).collect();
    format!("[{}]", texts.join(", "))
}

/// A list of rows, one a line.
pub(super) fn matrix_text(matrix: &DMatrix<f64>) -> String {
    let rows = matrix
        .row_iter()
        .map(|row| vector_text(row.iter().copied()));
    let rows: Vec<String> = rows.collect();
    format!("[\n  {},\n]", rows.join(",\n  "))
}

pub(super) fn names_text(names: &[String]) -> String {
    let names: Vec<String> = names.iter().map(|n| quoted(n)).collect();
    format!("[{}]", names.join(", "))
}

/// A TOML string: JSON has the same escapes.
pub(super) fn quoted(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}

pub(super) fn write_network(net: &Network) -> String {
    let mut text = String::new();
    let mut line = |key: &str, value: String| {
        writeln!(text, "{key} = {value}").expect("a String takes any text");
    };
    line("activation", quoted(net.activation.name()));
    line("inputs", names_text(&net.inputs));
    match net.outputs.as_slice() {
        [one] => line("output", quoted(one)),
        several => line("outputs", names_text(several)),
    }
    for (i, layer) in net.layers.iter().enumerate() {
        let number = i + 1;
        if number == net.layers.len() && layer.bias.len() == 1 {
            line(
                &format!("w{number}"),
                vector_text(layer.weights.iter().copied()),
            );
            line(&format!("b{number}"), format!("{:?}", layer.bias[0]));
        } else {
            line(&format!("W{number}"), matrix_text(&layer.weights));
            line(
                &format!("b{number}"),
                vector_text(layer.bias.iter().copied()),
            );
        }
    }
    text
}
