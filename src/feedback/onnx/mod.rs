//! A law as an ONNX model in double precision: input `x` [batch, states]; outputs `u` [batch,
//! outputs], of a value function also `V` [batch, 1] and `p` [batch, states]. Bounds on controls
//! are applied.
//!
//! Layers are matrix products; u*(x, p) is written operation by operation on columns.

mod columns;
mod messages;
mod write;

use super::law::{ClosedForm, Law, Meaning};
use crate::model::{Activation, Model};
use nalgebra::DMatrix;
use write::{Name, Writer};

/// Why a law was not written as ONNX.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum OnnxError {
    #[error("ONNX runtimes have no `{0}` in double precision")]
    Function(&'static str),
}

/// The model's bytes. `form` is `law`'s in the scene `model`.
///
/// # Errors
/// [`OnnxError`] where the optimal control uses a function that ONNX runtimes do not have in double
/// precision.
pub fn onnx(name: &str, law: &Law, form: &ClosedForm, model: &Model) -> Result<Vec<u8>, OnnxError> {
    let mut w = Writer::default();
    let n = model.states.len();
    let places: Vec<usize> = (law.network.inputs.iter())
        .filter_map(|name| model.states.iter().position(|s| s.variable.name == *name))
        .collect();
    let inputs = w.columns("x", &places, n);
    let pass = outputs(&mut w, law, &inputs);
    let mut results = vec![("u", form.outputs.len())];
    match (&form.optimal, law.meaning) {
        (Some(optimal), Meaning::Value) => {
            let slopes = slopes(&mut w, law, &inputs, &pass);
            // From the order of the inputs to that of the states.
            let order: Vec<usize> = (0..n)
                .filter_map(|i| places.iter().position(|p| *p == i))
                .collect();
            let p = w.columns(&slopes, &order, n);
            let symbols = [(form.x.as_slice(), "x"), (optimal.p.as_slice(), p.as_str())];
            let u = columns::write(&mut w, &form.graph, &symbols, &optimal.commands)?;
            w.named(&u, "u");
            w.named(&pass.output, "V");
            w.named(&p, "p");
            results.extend([("V", 1), ("p", n)]);
        }
        _ => {
            let u = bounded(&mut w, form, model, &pass.output);
            w.named(&u, "u");
        }
    }
    let states: Vec<&str> = model
        .states
        .iter()
        .map(|s| s.variable.name.as_str())
        .collect();
    let doc = format!(
        "law `{name}` of: {}; x: {}; u: {}",
        model.title,
        states.join(", "),
        form.outputs.join(", ")
    );
    Ok(w.model(name, &doc, ("x", n), &results))
}

/// What the outputs leave for the slopes.
struct Pass {
    /// Values of the hidden layers.
    hidden: Vec<Name>,
    output: Name,
    /// Inputs less the base's centre.
    distance: Option<Name>,
}

/// The network's outputs and what is added to them, `[batch, outputs]`.
fn outputs(w: &mut Writer, law: &Law, inputs: &str) -> Pass {
    let (mut hidden, mut h) = (Vec::new(), inputs.to_owned());
    for (i, layer) in law.network.layers.iter().enumerate() {
        h = w.affine(&h, &layer.weights, layer.bias.as_slice());
        if i + 1 < law.network.layers.len() {
            let activation = match law.network.activation {
                Activation::Logistic => "Sigmoid",
                Activation::Tanh => "Tanh",
            };
            h = w.op(activation, &[&h]);
            hidden.push(h.clone());
        }
    }
    let mut pass = Pass {
        hidden,
        output: h,
        distance: None,
    };
    let Some(base) = &law.base else { return pass };
    let center = w.row(&base.center);
    let d = w.op("Sub", &[inputs, &center]);
    let linear = w.affine(&d, &base.linear, &base.constant);
    pass.output = w.op("Add", &[&pass.output, &linear]);
    if let Some(quadratic) = &base.quadratic {
        let quadratic = w.matrix(quadratic);
        let slope = w.op("MatMul", &[&d, &quadratic]);
        let products = w.op("Mul", &[&d, &slope]);
        let halves = w.matrix(&DMatrix::from_element(base.center.len(), 1, 0.5));
        let half = w.op("MatMul", &[&products, &halves]);
        pass.output = w.op("Add", &[&pass.output, &half]);
    }
    pass.distance = Some(d);
    pass
}

/// Derivatives of the only output by the inputs, `[batch, inputs]`: backward through the layers.
fn slopes(w: &mut Writer, law: &Law, inputs: &str, pass: &Pass) -> Name {
    let layers = &law.network.layers;
    let mut slope = w.matrix(&layers[layers.len() - 1].weights);
    for (layer, h) in layers.iter().zip(&pass.hidden).rev() {
        let one = w.row(&[1.0]);
        let by = match law.network.activation {
            Activation::Logistic => {
                let rest = w.op("Sub", &[&one, h]);
                w.op("Mul", &[h, &rest])
            }
            Activation::Tanh => {
                let square = w.op("Mul", &[h, h]);
                w.op("Sub", &[&one, &square])
            }
        };
        let into = w.op("Mul", &[&slope, &by]);
        let weights = w.matrix(&layer.weights);
        slope = w.op("MatMul", &[&into, &weights]);
    }
    if pass.hidden.is_empty() {
        // One row for every row of the batch.
        let zero = w.row(&[0.0]);
        let zeros = w.op("Mul", &[inputs, &zero]);
        slope = w.op("Add", &[&zeros, &slope]);
    }
    if let (Some(base), Some(d)) = (&law.base, &pass.distance) {
        let linear = w.row(base.linear.row(0).transpose().as_slice());
        slope = w.op("Add", &[&slope, &linear]);
        if let Some(quadratic) = &base.quadratic {
            let quadratic = w.matrix(quadratic);
            let bend = w.op("MatMul", &[d, &quadratic]);
            slope = w.op("Add", &[&slope, &bend]);
        }
    }
    slope
}

/// Outputs within the bounds of the controls they are.
fn bounded(w: &mut Writer, form: &ClosedForm, model: &Model, output: &str) -> Name {
    let control = |name: &String| model.controls.iter().find(|c| c.variable.name == *name);
    let bound = |of: fn(&crate::model::Control) -> Option<f64>, none: f64| -> Vec<f64> {
        let bounds = form
            .outputs
            .iter()
            .map(|name| control(name).and_then(of).unwrap_or(none));
        bounds.collect()
    };
    let lower = bound(|c| c.min, f64::NEG_INFINITY);
    let upper = bound(|c| c.max, f64::INFINITY);
    let mut u = output.to_owned();
    if lower.iter().any(|b| b.is_finite()) {
        let lower = w.row(&lower);
        u = w.op("Max", &[&u, &lower]);
    }
    if upper.iter().any(|b| b.is_finite()) {
        let upper = w.row(&upper);
        u = w.op("Min", &[&u, &upper]);
    }
    u
}
