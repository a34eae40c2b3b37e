//! Nodes and numbers of an ONNX graph, added one by one.

use super::messages::{self, DOUBLE, Extent, INT, INT64};
use nalgebra::DMatrix;
use prost::Message;

/// Of operators in use since 2021, which every current runtime has.
const OPSET: i64 = 13;
/// The file format's version that belongs to it.
const FORMAT: i64 = 7;

/// Name of a tensor.
pub(super) type Name = String;

/// A graph being written.
#[derive(Debug, Default)]
pub(super) struct Writer {
    graph: messages::Graph,
}

impl Writer {
    /// The result of an operator.
    pub fn op(&mut self, operator: &str, inputs: &[&str]) -> Name {
        self.with(operator, inputs, &[])
    }

    /// The same with integer attributes.
    pub fn with(&mut self, operator: &str, inputs: &[&str], attributes: &[(&str, i64)]) -> Name {
        let name = format!("t{}", self.graph.node.len());
        let attribute = |(name, i): &(&str, i64)| messages::Attribute {
            name: (*name).to_owned(),
            i: *i,
            kind: INT,
        };
        self.graph.node.push(messages::Node {
            input: inputs.iter().map(|i| (*i).to_owned()).collect(),
            output: vec![name.clone()],
            op_type: operator.to_owned(),
            attribute: attributes.iter().map(attribute).collect(),
        });
        name
    }

    /// `h W' + b` for `W` with one row an output.
    pub fn affine(&mut self, h: &str, weights: &DMatrix<f64>, bias: &[f64]) -> Name {
        let (weights, bias) = (self.matrix(weights), self.row(bias));
        self.with("Gemm", &[h, &weights, &bias], &[("transB", 1)])
    }

    /// Columns of a tensor `[batch, width]`, in the order of `places`.
    pub fn columns(&mut self, of: &str, places: &[usize], width: usize) -> Name {
        if places.iter().copied().eq(0..width) {
            return of.to_owned();
        }
        let places = self.initializer(messages::Tensor {
            dims: vec![places.len() as i64],
            data_type: INT64,
            int64_data: places.iter().map(|p| *p as i64).collect(),
            ..messages::Tensor::default()
        });
        self.with("Gather", &[of, &places], &[("axis", 1)])
    }

    /// A constant `[1, length]`.
    pub fn row(&mut self, values: &[f64]) -> Name {
        self.doubles(1, values.len(), values.to_vec())
    }

    pub fn matrix(&mut self, matrix: &DMatrix<f64>) -> Name {
        // nalgebra keeps columns together, ONNX rows.
        self.doubles(
            matrix.nrows(),
            matrix.ncols(),
            matrix.transpose().as_slice().to_vec(),
        )
    }

    fn doubles(&mut self, rows: usize, columns: usize, values: Vec<f64>) -> Name {
        self.initializer(messages::Tensor {
            dims: vec![rows as i64, columns as i64],
            data_type: DOUBLE,
            double_data: values,
            ..messages::Tensor::default()
        })
    }

    fn initializer(&mut self, tensor: messages::Tensor) -> Name {
        let name = format!("c{}", self.graph.initializer.len());
        self.graph.initializer.push(messages::Tensor {
            name: name.clone(),
            ..tensor
        });
        name
    }

    /// Gives a tensor the name of an output.
    pub fn named(&mut self, tensor: &str, name: &str) {
        self.graph.node.push(messages::Node {
            input: vec![tensor.to_owned()],
            output: vec![name.to_owned()],
            op_type: "Identity".to_owned(),
            attribute: Vec::new(),
        });
    }

    /// The file's bytes; inputs and outputs with their numbers of columns.
    pub fn model(
        mut self,
        name: &str,
        doc: &str,
        input: (&str, usize),
        outputs: &[(&str, usize)],
    ) -> Vec<u8> {
        let batch = Extent::Name("batch".to_owned());
        let columns = |width: usize| [batch.clone(), Extent::Value(width as i64)].map(Some);
        let info = |(name, width): (&str, usize)| messages::ValueInfo {
            name: name.to_owned(),
            kind: Some(messages::Type {
                tensor: Some(messages::TensorType {
                    elem_type: DOUBLE,
                    shape: Some(messages::Shape {
                        dim: columns(width)
                            .map(|extent| messages::Dimension { extent })
                            .to_vec(),
                    }),
                }),
            }),
        };
        self.graph.name = name.to_owned();
        self.graph.input = vec![info(input)];
        self.graph.output = outputs.iter().copied().map(info).collect();
        let model = messages::Model {
            ir_version: FORMAT,
            producer_name: "costate".to_owned(),
            producer_version: env!("CARGO_PKG_VERSION").to_owned(),
            doc_string: doc.to_owned(),
            graph: Some(self.graph),
            opset_import: vec![messages::OperatorSet {
                domain: String::new(),
                version: OPSET,
            }],
        };
        model.encode_to_vec()
    }
}
